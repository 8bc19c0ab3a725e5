"""Does the map follow the place? Sessions of `scenario=seasons` into one map file, against the truth.

    python benchmarks/seasons.py --out DIR [--sessions 4] [--measure-only]
                                 [--gone 0.1] [--entered 0.8] [key=value ...]

Further `key=value` arguments are overrides as `scripts/run.py` takes them. For k = 1, 2, ... it runs

    python scripts/run.py scenario=seasons scenario.session=k sensor=vls128 map=DIR/seasons.map

with the run folder DIR/session_k, and measures that run's map.ply. `--measure-only` takes run folders
that are there already. DIR gets seasons.md and seasons.json.

How it is counted:

- All is compared in the world's frame. The map's frame is found once, by laying the trajectory of
  session 1 on its truth (Kabsch, all poses), and holds for all sessions: a session that is put in the
  wrong place shows, in the first table and in all others.
- An object's surface is what the sensor saw of it: the spots where beams returned from it, in any
  sweep of its stay, in voxels of 0.2 m; voxels with less than 5 returns, or more than 30 m from the
  route, are left out: further away the map doesn't look for changes.
- A visit is a session. The change itself happens between two; n visits since the change means that the
  n-th session after it has been mapped.
- *Gone*: of the voxels that were in the map (a point within 0.2 m) after the last session that the
  object stood there, and that lie more than 0.3 m off every true surface of today, the share that
  still has a map point within 0.2 m.
- *New*: of the voxels seen since the object came, and that lie more than 0.3 m off every true surface
  of the session before it came, the share with a map point within 0.2 m.
- *Stayed*: the same share for what has been there since session 1, as a yardstick for *new*.
- Objects with less than 10 such voxels are left out. A share is the mean over objects.
- Accuracy: distances of map points to the true surface of the session, all triangles of it.
  Completeness: share of the voxels of that surface, as far as visible and within 30 m of the route,
  with a map point within 0.2 m.
"""

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from change import (
    Array,
    Change,
    ChangeMeter,
    MapScore,
    ObjectScore,
    Surface,
    Visit,
    mean_shares,
    score_map,
    visits_needed,
)
from throughput import compose_config, facts, markdown, portable

from eval.alignment import kabsch
from eval.errors import EvalError
from eval.files import atomic_path, write_json
from eval.map_files import read_map
from lifelong_slam.config import build
from lifelong_slam.errors import ConfigError, LifelongSlamError, SourceError
from lifelong_slam.geometry import transform
from lifelong_slam.provenance import describe_run
from lifelong_slam.simulation.movables import read_movables
from lifelong_slam.simulation.recorder import MOVABLES_NAME, SURFACE_NAME, TRUTH_NAME, WORLD_NAME
from lifelong_slam.trajectory import Trajectory, read_tum

RUN = Path(__file__).resolve().parents[1] / "scripts" / "run.py"
KINDS = ("car", "box", "leaves")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and measure all sessions, print and write the tables, return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parse(arguments)
    try:
        maps, objects = _measure_sessions(options)
    except (LifelongSlamError, EvalError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    text = report(maps, objects, arguments, options.gone, options.entered)
    _write(options, maps, objects, text, arguments)
    print(text)
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of runs and tables")
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--measure-only", action="store_true", help="take the runs that are there")
    parser.add_argument("--gone", type=float, default=0.1, help="share that counts as gone")
    parser.add_argument("--entered", type=float, default=0.8, help="share that counts as entered")
    parser.add_argument("overrides", nargs="*", help="key=value, as scripts/run.py takes them")
    options = parser.parse_args(arguments)
    if options.sessions < 1:
        parser.error("--sessions must be at least 1")
    return options


def _measure_sessions(options: argparse.Namespace) -> tuple[list[MapScore], list[ObjectScore]]:
    map_file = options.out / "seasons.map"
    if map_file.exists() and not options.measure_only:
        raise ConfigError(f"{map_file} is there already: remove it, or give --measure-only")
    meter = ChangeMeter()
    maps: list[MapScore] = []
    objects: list[ObjectScore] = []
    for session in range(1, options.sessions + 1):
        choice = ["scenario=seasons", f"scenario.session={session}", "sensor=vls128"]
        folder = options.out / f"session_{session}"
        if not options.measure_only:
            _run([*choice, *options.overrides, f"map={map_file}", f"hydra.run.dir={folder}"])
        visit = load_visit(build(compose_config([*choice, *options.overrides]).scenario).folder)
        trajectory = within(read_tum(folder / "trajectory.tum"), visit.reference)
        if session == 1:
            T_world_map = laid_on(trajectory, visit.reference)
        points = transform(T_world_map, read_map(folder / "map.ply").astype(np.float64))
        moved = Trajectory(trajectory.stamps, T_world_map @ trajectory.poses)
        maps.append(score_map(session, visit, points, moved))
        objects += meter.measure(visit, points)
    return maps, objects


def _run(overrides: list[str]) -> None:
    command = [sys.executable, str(RUN), *overrides]
    # What the run shows goes to stderr: on stdout there is Markdown only.
    if subprocess.run(command, stdout=sys.stderr, check=False).returncode:
        raise ConfigError(f"this run failed: python scripts/run.py {shlex.join(overrides)}")


def load_visit(folder: Path) -> Visit:
    """Read the truth in a campaign's folder.

    Raises:
        SourceError: a file is missing or malformed.
    """
    mesh = o3d.io.read_triangle_mesh(folder / WORLD_NAME)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    surface = Surface(corners, read_map(folder / SURFACE_NAME).astype(np.float64))
    return Visit(read_movables(folder / MOVABLES_NAME), surface, read_tum(folder / TRUTH_NAME))


def within(trajectory: Trajectory, reference: Trajectory) -> Trajectory:
    """Return the part of a trajectory that its reference covers.

    Raises:
        SourceError: there is none.
    """
    first, last = reference.stamps[[0, -1]]
    chosen = (trajectory.stamps >= first) & (trajectory.stamps <= last)
    if not chosen.any():
        raise SourceError("the trajectory has no pose within the time of the session's truth")
    return Trajectory(trajectory.stamps[chosen], trajectory.poses[chosen])


def laid_on(trajectory: Trajectory, reference: Trajectory) -> Array:
    """Return T_world_map (4, 4), which lays a trajectory on its reference."""
    target = reference.at(trajectory.stamps)[:, :3, 3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3], _ = kabsch(trajectory.positions, target)
    return T


def report(
    maps: Sequence[MapScore],
    objects: Sequence[ObjectScore],
    arguments: Sequence[str],
    gone: float,
    entered: float,
) -> str:
    """Return all tables in Markdown, with what they depend on."""
    parts = ["# How the map follows the place", facts("seasons.py", arguments)]
    parts += ["## The whole map after each session", map_table(maps)]
    titles: dict[Change, str] = {
        "gone": "Gone: mean share of an object's voxels still in the map, by visits since",
        "new": "New: mean share of an object's voxels in the map, by visits since",
        "stayed": "There since session 1: mean share of an object's voxels in the map, by visits",
    }
    for change, title in titles.items():
        parts += [f"## {title}", change_table(objects, change)]
    parts += ["## Visits needed", needed_table(objects, gone, entered)]
    return "\n\n".join(parts)


def map_table(maps: Sequence[MapScore]) -> str:
    """Return a row for each session."""
    header = (
        "Session", "Points", "Trajectory RMSE, m", "Accuracy, mean m", "within 0.1 m",
        "within 0.2 m", "Completeness, 0.2 m",
    )  # fmt: skip
    rows = [
        (
            str(m.session), f"{m.points:,}", f"{m.trajectory_rmse_m:.3f}",
            f"{m.accuracy_mean_m:.3f}", f"{m.accuracy_10cm:.3f}", f"{m.accuracy_20cm:.3f}",
            f"{m.completeness_20cm:.3f}",
        )
        for m in maps
    ]  # fmt: skip
    return markdown(header, rows)


def change_table(objects: Sequence[ObjectScore], change: Change) -> str:
    """Return a row for each kind, a column for each number of visits: share (objects)."""
    visits = sorted({s.visits for s in objects if s.change == change})
    rows = []
    for kind in KINDS:
        shares = mean_shares(objects, change, kind)
        cells = [(change, kind, n) for n in visits]
        counts = [sum((s.change, s.kind, s.visits) == cell for s in objects) for cell in cells]
        named = [f"{shares[n]:.3f} ({c})" if c else "" for n, c in zip(visits, counts, strict=True)]
        rows.append([kind, *named])
    return markdown(["Kind", *map(str, visits)], rows)


def needed_table(objects: Sequence[ObjectScore], gone: float, entered: float) -> str:
    """Return for each kind after how many visits it is gone, and has entered."""
    rows = [
        [kind]
        + [
            _visits(visits_needed(objects, change, kind, threshold), objects, change, kind)
            for change, threshold in _thresholds(gone, entered)
        ]
        for kind in KINDS
    ]
    header = ["Kind", f"gone (at most {gone:g} left)", f"entered (at least {entered:g} there)"]
    return markdown(header, rows)


def _thresholds(gone: float, entered: float) -> tuple[tuple[Change, float], tuple[Change, float]]:
    return ("gone", gone), ("new", entered)


def _visits(needed: int | None, objects: Sequence[ObjectScore], change: Change, kind: str) -> str:
    if needed is not None:
        return f"after {needed}"
    most = max(mean_shares(objects, change, kind), default=0)
    return f"not after {most}" if most else "none changed"


def _write(
    options: argparse.Namespace,
    maps: Sequence[MapScore],
    objects: Sequence[ObjectScore],
    text: str,
    arguments: Sequence[str],
) -> None:
    """Write the tables and all that they are made of."""
    needed = {
        change: {kind: visits_needed(objects, change, kind, limit) for kind in KINDS}
        for change, limit in _thresholds(options.gone, options.entered)
    }
    content: dict[str, Any] = {
        "run": describe_run(portable(arguments), 0),
        "thresholds": {"gone": options.gone, "entered": options.entered},
        "visits_needed": needed,
        "maps": [asdict(m) for m in maps],
        "objects": [asdict(o) for o in objects],
    }
    write_json(options.out / "seasons.json", content)
    with atomic_path(options.out / "seasons.md") as path:
        path.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main())
