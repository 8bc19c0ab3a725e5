"""How long `scripts/evaluate.py` takes on two long trajectories, beside evo's own commands.

    python benchmarks/trajectory_metrics.py [--poses 100000] [--repeats 5]

Makes a drive of 10 Hz and a disturbed copy of it seen from another frame, as TUM files, and runs in turn,
each as a process of its own that reads both files:

- evaluate: all metrics of a trajectory, printed.
- evaluate out=: also metrics.json, plots, report.html and the archive for `evo_res`.
- evo_ape: the translation alone, aligned, with its archive.
- evo, all: the commands of evo that give what it can of the same figures: `evo_ape` of translation and
  rotation, and `evo_rpe` of both over 1 m, 10 m and 1 s. KITTI's errors, errors by axis, percentiles and
  coverage it doesn't have.

Seconds are medians, ratios are medians of those of each turn. Both find the same RMSE, or the exit status
is 1.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from throughput import facts, markdown

ROOT = Path(__file__).resolve().parent.parent
_RATE = 10.0  # Hz
_ARCHIVE = "evo_ape.zip"
_SAME = 1e-6  # metres

Commands = Sequence[Sequence[str]]


class Seconds(NamedTuple):
    """What commands took, one after the other."""

    cpu: float
    wall: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark, print its figures, and return whether the figures agree."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--poses", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_trajectories(folder, options.poses)
        rows = commands()
        for chosen in rows.values():  # so that all find their files and modules in memory
            measure(chosen, folder)
        turns = [
            {name: measure(c, folder) for name, c in rows.items()} for _ in range(options.repeats)
        ]
        ours, evos = found_rmse(folder)
    rmse = f"RMSE: {ours:.6f} m, evo {version('evo')} {evos:.6f} m"
    print(report(turns, options.poses), "", rmse, "", sep="\n")
    print(facts(Path(__file__).name, arguments))
    return 0 if abs(ours - evos) < _SAME else 1


def write_trajectories(folder: Path, count: int) -> None:
    """Write b.tum, a drive of about a metre a pose, and a.tum, the same with noise and turned."""
    rng = np.random.default_rng(0)
    stamps = 1.6e9 + np.arange(count) / _RATE
    yaw = 0.02 * np.cumsum(rng.normal(size=count))
    steps = np.column_stack([np.cos(yaw), np.sin(yaw), 0.05 * np.sin(stamps / 50)])
    angles = np.column_stack([yaw, 0.02 * np.sin(yaw), 0.01 * np.cos(yaw)])
    positions, rotations = np.cumsum(steps, axis=0), Rotation.from_euler("zyx", angles)
    turn = Rotation.from_rotvec([0.1, -0.2, 1.0])
    noise, wobble = rng.normal(size=(2, count, 3)) * np.array([0.1, 0.01])[:, None, None]
    estimate = turn.apply(positions + noise), turn * rotations * Rotation.from_rotvec(wobble)
    for name, (p, R) in (("a.tum", estimate), ("b.tum", (positions, rotations))):
        np.savetxt(folder / name, np.column_stack([stamps, p, R.as_quat()]), fmt="%.9f")


def commands() -> dict[str, Commands]:
    """Return what is run, by the name of its row."""
    evaluate = [sys.executable, str(ROOT / "scripts" / "evaluate.py")]
    evaluate += ["estimate=a.tum", "reference=b.tum"]
    ape, rpe = (
        [str(Path(sys.executable).with_name(name)), "tum", "b.tum", "a.tum", "-a", "--no_warnings"]
        for name in ("evo_ape", "evo_rpe")
    )
    deltas = (["-d", "1", "-u", "m"], ["-d", "10", "-u", "m"], ["-d", f"{_RATE:g}", "-u", "f"])
    translation = [*ape, "--save_results", _ARCHIVE]
    others = [[*rpe, "--pairs_from_reference", *delta] for delta in deltas]
    turned = [[*command, "-r", "angle_deg"] for command in (ape, *others)]
    return {
        "evaluate": [evaluate],
        "evaluate out=": [[*evaluate, "out=out"]],
        "evo_ape": [translation],
        "evo, all": [translation, *others, *turned],
    }


def measure(chosen: Commands, folder: Path) -> Seconds:
    """Run commands one after the other in a folder, which is also the home of evo's settings."""
    (folder / _ARCHIVE).unlink(missing_ok=True)  # evo would ask before it replaces it
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    for command in chosen:
        environment = {**os.environ, "HOME": str(folder)}
        subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Seconds(cpu, time.perf_counter() - start)


def found_rmse(folder: Path) -> tuple[float, float]:
    """Return the RMSE that we found, and evo's."""
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    with zipfile.ZipFile(folder / _ARCHIVE) as archive:
        statistics = json.loads(archive.read("stats.json"))
    return metrics["trajectory"]["rmse_m"], statistics["rmse"]


def report(turns: Sequence[dict[str, Seconds]], poses: int) -> str:
    """Return the table of seconds, and of ratios to evo's."""
    header = (f"{poses:,} poses", "CPU s", "wall s", "wall / evo_ape", "wall / evo, all")
    rows = []
    for name in turns[0]:
        cpu, wall = (median(turn[name][i] for turn in turns) for i in range(2))
        ratios = (
            median(turn[name].wall / turn[other].wall for turn in turns)
            for other in ("evo_ape", "evo, all")
        )
        rows.append((name, f"{cpu:.2f}", f"{wall:.2f}", *(f"{ratio:.2f}" for ratio in ratios)))
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
