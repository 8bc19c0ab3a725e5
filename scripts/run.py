"""Run a SLAM system on a recording and leave a run folder: `python scripts/run.py --help`.

Exit status: 0 done; 1 a bug; 2 bad input or settings, said in one line on stderr; 3 done and written, but
the verdict on the run is that it is doubtful or lost, for reasons that are said; 130 stopped by SIGINT or
SIGTERM, with what was mapped until then written (unless it was aborted by a second one).
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from command import BAD_INPUT, CONF, DOUBTFUL, INTERRUPTED, KNOWN_ERRORS, plain
from console import fail, scan_progress, show_results
from eval.evaluation import make_settings
from eval.run import evaluate_run
from lifelong_slam.assessment import Status, assess
from lifelong_slam.config import build, check_value
from lifelong_slam.errors import ConfigError
from lifelong_slam.mapping.session import MapSession
from lifelong_slam.overrides import check_overrides, quote_paths
from lifelong_slam.provenance import describe_run, seed_everything
from lifelong_slam.run_folder import link_reference_map, write_run
from lifelong_slam.runner import RunRecord, ViewerObserver, run, stop_on_signals
from lifelong_slam.slam import LifelongSlam
from lifelong_slam.sources.source import Source, Surveyed
from lifelong_slam.systems.system import System
from lifelong_slam.viewer import StubViewer

FILES_OF_THE_START = {".hydra", "run.log", "run.rrd"}


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")  # type: ignore[untyped-decorator]
def job(config: DictConfig) -> None:
    """Do one run, in the folder that Hydra made for it."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        record = slam(config, folder)
    except KNOWN_ERRORS as error:
        discard_if_empty(folder)
        fail(error)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # the sweep's other jobs go on, and the sweep as a whole fails
        raise SystemExit(BAD_INPUT) from error
    except KeyboardInterrupt:
        discard_if_empty(folder)
        raise
    if record.interrupted:
        print("Stopped early: the run folder holds what was mapped until then.", file=sys.stderr)
        raise SystemExit(INTERRUPTED)
    if assess(record).status is not Status.GOOD:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise DoubtfulRunError(folder)  # as above
        raise SystemExit(DOUBTFUL)


class DoubtfulRunError(Exception):
    """A run of a sweep that was written, but whose verdict isn't that it is good."""


def slam(config: DictConfig, folder: Path) -> RunRecord:
    """Run SLAM, write and evaluate the run folder, show the results."""
    with stop_on_signals() as stop:
        seed_everything(check_value("seed", config.seed, int))
        settings = make_settings(plain(part(config, "eval")))
        max_range = check_value("sensor.max_range", part(config, "sensor").max_range, float)
        system = build(part(config, "system"))  # before recording a scenario, which takes a while
        source = build(part(config, "scenario"))
        viewer = build(part(config, "viewer"))
        observers = [] if isinstance(viewer, StubViewer) else [ViewerObserver(viewer, system)]
        try:
            with map_session(config, system, source), scan_progress(len(source)) as progress:
                record = run(source, system, [progress, *observers], stop, max_range=max_range)
        finally:
            viewer.close()
        write_run(folder, record, source.reference(), source.T_base_sensor)
        link_reference_map(folder, source.surface_path if isinstance(source, Surveyed) else None)
        metrics = evaluate_run(folder, settings, run_info(config.seed, record))
        show_results(record, metrics, folder)
    return record


def part(config: DictConfig, group: str) -> DictConfig:
    """Return the config of a group, which `~group` on the command line may have removed."""
    node = config.get(group)
    if not isinstance(node, DictConfig):
        raise ConfigError(f"nothing is chosen for {group}: give {group}=...")
    return node


@contextmanager
def map_session(config: DictConfig, system: System, source: Source) -> Iterator[None]:
    """Have the system go on from the map file that is asked for, and keep it open meanwhile."""
    mode = check_value("mode", config.mode, Literal["map", "localize"])
    if config.map is None:
        if mode == "localize":
            raise ConfigError("mode=localize needs a map to localise in: give map=FILE")
        yield
        return
    if not isinstance(system, LifelongSlam):
        raise ConfigError(f"map={config.map}: only system=lifelong keeps a map file")
    with MapSession.open(
        Path(check_value("map", config.map, str)),
        mode,
        sensor=str(config.sensor.name),
        T_base_sensor=source.T_base_sensor,
        voxel_size=system.voxel_size,
        source=str(HydraConfig.get().runtime.choices.scenario),
        config=OmegaConf.to_yaml(config),
    ) as session:
        system.begin(session)
        yield


def run_info(seed: int, record: RunRecord) -> dict[str, Any]:
    """Put together section `run` of metrics.json."""
    hydra_config = HydraConfig.get()
    verdict = assess(record)
    return {
        **describe_run([*hydra_config.overrides.task], seed),
        "choices": {g: str(c) for g, c in hydra_config.runtime.choices.items() if "/" not in g},
        "interrupted": record.interrupted,
        "wall_seconds": record.wall_seconds,
        "scans_per_second": record.scans_per_second,
        "peak_rss_mb": record.peak_rss_mb,
        "mean_rss_mb": record.mean_rss_mb,
        "cpu_percent": record.cpu_percent,
        "verdict": {"status": verdict.status.value, "reasons": [*verdict.reasons]},
        "input": record.counts,
        "system": record.result.counts,
    }


def discard_if_empty(folder: Path) -> None:
    """Remove a run folder that holds nothing but what a run starts with."""
    if folder.is_dir() and {path.name for path in folder.iterdir()} <= FILES_OF_THE_START:
        shutil.rmtree(folder)
        with suppress(OSError):
            folder.parent.rmdir()  # only if it is empty


def check_command_line() -> None:
    """Refuse overrides that don't fit, before Hydra makes any folder."""
    arguments = get_args_parser().parse_args()
    if arguments.config_path is None:
        more = Path(arguments.config_dir) if arguments.config_dir else None
        if more and not more.is_dir():
            raise ConfigError(f"no such folder of configs: {more}")
        check_overrides(CONF, arguments.overrides, arguments.config_name or "config", more)


def prepare_launcher() -> None:
    """Have the processes of a launcher find the modules beside this one, and draw no bars."""
    if any(argument.startswith("hydra/launcher=") for argument in sys.argv[1:]):
        paths = [str(Path(__file__).resolve().parent), os.environ.get("PYTHONPATH")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        os.environ["TERM"] = "dumb"


def main() -> int:
    """Run one job or a sweep, and turn whatever went wrong into one line and an exit status."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # have Hydra raise errors instead of printing them
    try:
        sys.argv[1:] = quote_paths(sys.argv[1:])
        check_command_line()
        prepare_launcher()
        job()
    except OSError as error:
        fail(ConfigError(f"can't make the run folder: {error}; choose one with hydra.run.dir=F"))
        return BAD_INPUT
    except KNOWN_ERRORS as error:
        fail(error)
        return BAD_INPUT
    except DoubtfulRunError:
        return DOUBTFUL
    except KeyboardInterrupt:
        print("Aborted.", file=sys.stderr)
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
