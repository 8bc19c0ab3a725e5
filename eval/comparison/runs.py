"""Finds run folders, reads what a comparison needs of them, and counts those that are missing.

A run folder is one that `scripts/run.py` leaves, alone or as a job of a multirun: `metrics.json`, and in
`.hydra` the composed config, the overrides of the command line and Hydra's own config. A folder with
nothing but `metrics.json` will do; its choices are then taken from there.
"""

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from itertools import islice, product
from pathlib import Path
from typing import Any, TypeVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel

from eval.errors import FileError, readable
from eval.files import read_json, read_yaml_text

T = TypeVar("T")

_Vector = tuple[float, float, float]
_SWEEP = "multirun.yaml"
_PREVIOUS = ".previous"  # where a run puts what an earlier one left in its folder
_NO_FOLDER = "it left no folder: it failed or was not started"
_MOST_JOBS = 100_000  # of a multirun


class _Headline(BaseModel):
    title: str
    unit: str | None
    less_is_better: bool | None


class _Alignment(BaseModel):
    method: str
    rotation: tuple[_Vector, _Vector, _Vector]
    translation_m: _Vector
    scale: float


class _Section(BaseModel):
    headlines: dict[str, _Headline] = {}
    alignment: _Alignment | None = None


class _Metrics(BaseModel):
    """What comparisons read of metrics.json, to be checked; see `docs/metrics.md`."""

    run: dict[str, Any] = {}
    trajectory: _Section = _Section()
    map: _Section = _Section()
    graph: _Section = _Section()
    resources: _Section = _Section()


@dataclass(frozen=True)
class Run:
    """A run that has been finished and evaluated.

    Attributes:
        folder: where it lies.
        overrides: of its command line, value by key; an override that removes something has the value None.
        choices: of the config groups, by group.
        config: as composed; empty where it wasn't kept.
        metrics: the content of metrics.json.
    """

    folder: Path
    overrides: Mapping[str, str | None]
    choices: Mapping[str, str]
    config: DictConfig
    metrics: Mapping[str, Any]

    def setting(self, key: str) -> str | None:
        """Return what a key of the command line was set to, by the command line or by default."""
        if key in self.choices:
            return self.choices[key]
        try:
            value = OmegaConf.select(self.config, key)
        except (OmegaConfBaseException, RecursionError):  # it refers to what is only there in a run
            value = None
        return self.overrides.get(key) if value is None else str(value)

    @property
    def is_bare(self) -> bool:
        """Whether nothing is known of how it was made: it stands for itself."""
        return not self.choices and not self.overrides

    @cached_property
    def seeds(self) -> tuple[tuple[str, str | None], ...]:
        """The seeds on the command line, of SLAM (`seed`) or of the world (`scenario.seed`)."""
        keys = sorted(key for key in self.overrides if is_seed(key))
        return tuple((key, self.setting(key)) for key in keys)

    def figure(self, section: str, *keys: str) -> float | None:
        """Return a number of metrics.json; None where it has none."""
        value: Any = self.metrics.get(section)
        for key in keys:
            value = value.get(key) if isinstance(value, Mapping) else None
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return float(value) if is_number and abs(value) <= sys.float_info.max else None


@dataclass(frozen=True, slots=True)
class Missing:
    """A run that has no figures to compare.

    Attributes:
        name: its folder, or the command line of a job that left none.
        reason: why, as far as it can be seen.
    """

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class Runs:
    """What was found.

    Attributes:
        finished: in the order of their folders.
        missing: failed, killed or stopped early, or done again later with the same settings.
    """

    finished: tuple[Run, ...]
    missing: tuple[Missing, ...] = ()


def find_runs(roots: Sequence[Path]) -> Runs:
    """Read all runs in and below some folders.

    Raises:
        FileError: a folder isn't there, or there is no finished run.
    """
    for root in roots:
        if not root.is_dir():
            raise FileError(f"no such folder of runs: {root}")
    finished: list[Run] = []
    missing: list[Missing] = []
    for folder in _unique(folder for root in roots for folder in _run_folders(root)):
        found = read_run(folder)
        if isinstance(found, Run):
            finished.append(found)
        else:
            missing.append(found)
    for sweep in _unique(file for root in roots for file in sorted(_below(root, _SWEEP))):
        missing += _jobs_without_folder(sweep)
    newest, earlier = _newest(finished)
    if not newest:
        names = "; ".join(f"{m.name}: {m.reason}" for m in missing)
        where = ", ".join(map(str, roots))
        raise FileError(f"no finished run below {where}{': ' + names if names else ''}")
    return Runs(newest, (*missing, *earlier))


def read_run(folder: Path) -> Run | Missing:
    """Read a run folder, or say why there is nothing to compare."""
    path = folder / "metrics.json"
    if not path.is_file():
        return Missing(str(folder), "it has no metrics.json: it failed, was killed, or still runs")
    try:
        with readable(folder, "run folder"):
            metrics = read_json(path)
            _Metrics.model_validate(metrics)
            info = metrics.get("run", {})
            hydra = _load(folder / ".hydra" / "hydra.yaml")
            choices = OmegaConf.select(hydra, "hydra.runtime.choices") or info.get("choices", {})
            lines = _lines(folder / ".hydra" / "overrides.yaml", info.get("command_line", []))
            config = _load(folder / ".hydra" / "config.yaml")
            groups = {str(g): str(c) for g, c in choices.items() if "/" not in str(g)}
            overrides = _overrides(lines)
    except (FileError, OSError) as error:
        return Missing(str(folder), f"it can't be read: {' '.join(str(error).split())}")
    if config and info.get("id") != config.get("run_id"):
        return Missing(str(folder), "config and metrics.json are of different runs")
    if info.get("interrupted"):
        return Missing(str(folder), "it was stopped early")
    return Run(folder, overrides, groups, config, metrics)


def is_seed(key: str) -> bool:
    """Tell whether a setting only says which random numbers are drawn."""
    return key.rpartition(".")[2] == "seed"


def differing(runs: Sequence[Run]) -> list[str]:
    """Return the keys of command lines, seeds apart, whose settings aren't the same in all runs."""
    keys = _unique(key for run in runs for key in run.overrides if not is_seed(key))
    return [key for key in keys if len({run.setting(key) for run in runs}) > 1]


def _run_folders(root: Path) -> Iterator[Path]:
    with_metrics = {file.parent for file in _below(root, "metrics.json")}
    with_config = {file.parent.parent for file in _below(root, ".hydra/hydra.yaml")}
    yield from sorted(with_metrics | with_config, key=_natural)


def _below(root: Path, pattern: str) -> Iterator[Path]:
    """Yield the files below a folder that fit a pattern, but for those of runs that were set aside."""
    for file in root.rglob(pattern):
        if not any(part.startswith(_PREVIOUS) for part in file.relative_to(root).parts):
            yield file


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort 10_... after 9_..."""
    heads = [part.partition("_")[0] for part in path.parts]
    return [
        (int(head) if head.isdecimal() else -1, part)
        for head, part in zip(heads, path.parts, strict=True)
    ]


def _load(file: Path) -> DictConfig:
    config = _yaml(file) if file.is_file() else OmegaConf.create()
    if not isinstance(config, DictConfig):
        raise ValueError(f"{file} is no mapping")
    return config


def _lines(file: Path, otherwise: Sequence[str]) -> list[str]:
    return [str(line) for line in (_yaml(file) if file.is_file() else otherwise)]


def _yaml(file: Path) -> Any:
    return OmegaConf.load(StringIO(read_yaml_text(file)))


def _overrides(lines: Sequence[str]) -> dict[str, str | None]:
    """Return value by key of lines such as `scenario=A`, `+a.b=1` or `~viewer`."""
    split = [line.partition("=") for line in lines]
    return {key.lstrip("+~"): None if key.startswith("~") else value for key, _, value in split}


def _jobs_without_folder(sweep: Path) -> list[Missing]:
    """Name the jobs of a multirun that didn't leave a folder: `run.py` removes what failed at once."""
    try:
        with readable(sweep, "multirun's config"):
            jobs = _jobs(_load(sweep))
            configs = _below(sweep.parent, ".hydra/hydra.yaml")
            there = {int(_load(file).hydra.job.num) for file in configs}
    except (FileError, OSError) as error:
        text = " ".join(str(error).split())
        return [Missing(str(sweep), f"the jobs of this multirun can't be counted: {text}")]
    return [
        Missing(
            f"{sweep.parent}, job {number}: {' '.join(lines)}",
            "it left no folder: it failed or was not started",
        )
        for number, lines in enumerate(jobs)
        if number not in there
    ]


def _jobs(config: DictConfig) -> list[tuple[str, ...]]:
    """Return the command line of each job of a multirun, as Hydra's basic sweeper numbers them."""
    params = OmegaConf.select(config, "hydra.sweeper.params") or {}
    lines = [f"{key}={value}" for key, value in params.items()]
    lines += [str(line) for line in config.hydra.overrides.task]
    values = []
    for override in OverridesParser.create().parse_overrides(lines):
        if override.is_sweep_override():
            key = override.get_key_element()
            swept = islice(override.sweep_string_iterator(), _MOST_JOBS + 1)
            values.append([f"{key}={value}" for value in swept])
        else:
            values.append([str(override.input_line)])
    if math.prod(map(len, values)) > _MOST_JOBS:
        raise ValueError(f"it has more than {_MOST_JOBS} jobs")
    return list(product(*values))


def _newest(runs: Sequence[Run]) -> tuple[tuple[Run, ...], list[Missing]]:
    """Keep the newest of runs with the same settings, which would count twice; name the others."""
    keys = sorted({key for run in runs for key in run.overrides} | {"seed", "scenario.seed"})
    by_settings: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        settings = (tuple(sorted(run.choices.items())), *(run.setting(key) for key in keys))
        key = (run.folder,) if run.is_bare else settings
        by_settings.setdefault(key, []).append(run)
    newest = {id(max(alike, key=_written)) for alike in by_settings.values()}
    earlier = [run for run in runs if id(run) not in newest]
    return (
        tuple(run for run in runs if id(run) in newest),
        [Missing(str(r.folder), "a newer run with the same settings counts") for r in earlier],
    )


def _written(run: Run) -> float:
    return (run.folder / "metrics.json").stat().st_mtime


def _unique(items: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(items))
