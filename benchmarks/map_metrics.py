"""Nearest-neighbour distances between two large maps, both ways, beside Open3D.

    python benchmarks/map_metrics.py [--points 10000000] [--repeats 3] [--order scan]

Ours is `eval.nearest.mutual_distances`, theirs `PointCloud.compute_point_cloud_distance`, once from each
map to the other. How it is made fair:

- Each measurement has a process of its own, in which the maps lie in memory before the clock starts: as
  float32 arrays for ours, as Open3D's own clouds for theirs, so that its conversion isn't counted.
- The two take turns, in the other order in each repeat; ratios are taken within a repeat. Both use all
  cores where they can.
- The maps show one town: rolling ground, walls, clutter such as trees and cars, and one stray point in
  a hundred. Both are samples of the same surfaces, with noise of 2 cm; the second lacks a tenth of the
  town. In order `scan` points come street by street, as from a drive; `random` is how a hash map of
  voxels leaves them.
- Memory is the largest resident set while measuring, above that of the process with the maps loaded.
- The distances of both must agree to a micrometre in mean and maximum.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from throughput import facts, markdown, worker

from eval.nearest import mutual_distances

Array = NDArray[np.float64]
Cloud = NDArray[np.float32]

OURS, OPEN3D = "ours", "open3d"
_SYSTEMS = (OURS, OPEN3D)
_BLOCK = 30.0  # metres from one street to the next
_HOUSE = 20.0  # metres, edge of a building
_POINTS_PER_BLOCK = 100_000
_NOISE = 0.02  # metres


@dataclass(frozen=True, slots=True)
class Timing:
    """One measurement of both directions.

    Attributes:
        seconds: wall time.
        cpu_seconds: processor time of all threads.
        memory_mb: largest resident set above that with the maps alone.
        means: mean distance each way, in metres.
        largest: largest distance each way, in metres.
    """

    seconds: float
    cpu_seconds: float
    memory_mb: float
    means: tuple[float, float]
    largest: tuple[float, float]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark, print its figures as Markdown, return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=10_000_000, help="of each map")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--order", choices=("scan", "random"), default="scan")
    options = parser.parse_args(arguments)
    timings: dict[str, list[Timing]] = {system: [] for system in _SYSTEMS}
    for repeat in range(options.repeats):
        for system in _SYSTEMS[:: 1 if repeat % 2 == 0 else -1]:
            with worker() as process:
                timing = process.submit(measure, system, options.points, options.order).result()
            print(f"repeat {repeat + 1}: {system} {timing.seconds:.1f} s", file=sys.stderr)
            timings[system].append(timing)
    print(f"## Map distances: two maps of {options.points:,} points, order {options.order}\n")
    print(table(timings), "\n")
    print(facts("map_metrics.py", arguments))
    if not agree([timing for runs in timings.values() for timing in runs]):
        print("error: the distances differ", file=sys.stderr)
        return 1
    return 0


def measure(system: str, count: int, order: str) -> Timing:
    """Make the maps and measure their distances in this process."""
    first, second = town(count, 1, order), town(count, 2, order)
    second = second[second[:, 0] < 0.9 * second[:, 0].max()]
    distances = mutual_distances
    if system == OPEN3D:
        first, second, distances = _to_open3d(first), _to_open3d(second), _by_open3d
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before, cpu, start = _resident("VmRSS"), time.process_time(), time.perf_counter()
    there, back = distances(first, second)
    seconds, spent = time.perf_counter() - start, time.process_time() - cpu
    return Timing(
        seconds,
        spent,
        _resident("VmHWM") - before,
        (float(np.mean(there)), float(np.mean(back))),
        (float(np.max(there)), float(np.max(back))),
    )


def town(count: int, seed: int, order: str) -> Cloud:
    """Return (N, 3) points of a town whose size grows with their number.

    Args:
        count: N.
        seed: of what is random about this map; the town is the same for all.
        order: of the points, `scan` or `random`.
    """
    rng = np.random.Generator(np.random.SFC64(seed))
    blocks = max(1, round((count / _POINTS_PER_BLOCK) ** 0.5))
    walls, clutter, stray = (int(share * count) for share in (0.35, 0.09, 0.01))
    side = blocks * _BLOCK
    parts = [
        _on_ground(rng.random((count - walls - clutter - stray, 2)) * side),
        _on_walls(walls, blocks, rng),
        _in_clutter(clutter, side, rng),
        rng.random((stray, 3)) * [side, side, 40.0],
    ]
    points = np.vstack(parts).astype(np.float32)
    points += rng.standard_normal(points.shape, np.float32) * np.float32(_NOISE)
    streets = np.floor(points[:, :2] / _BLOCK) @ [blocks, 1]
    return points[np.argsort(streets, kind="stable") if order == "scan" else rng.permutation(count)]


def _on_ground(xy: Array) -> Array:
    """Put (N, 2) places on rolling ground."""
    return np.column_stack([xy, 2 * np.sin(xy[:, 0] / 40) + 1.5 * np.cos(xy[:, 1] / 55)])


def _on_walls(count: int, blocks: int, rng: np.random.Generator) -> Array:
    """Spread points over the walls of a building in each block, 10 m high."""
    edge, along = rng.integers(0, 4, count), rng.random(count, np.float32)
    turned, far = edge % 2 == 0, edge // 2
    x, y = np.where(turned, along, far), np.where(turned, far, along)
    corners = rng.integers(0, blocks, (count, 2)) * _BLOCK + (_BLOCK - _HOUSE) / 2
    return np.column_stack([np.column_stack([x, y]) * _HOUSE + corners, 10 * rng.random(count)])


def _in_clutter(count: int, side: float, rng: np.random.Generator) -> Array:
    """Gather points into blobs of the size of a tree or a car, one for each 36 square metres."""
    places = np.floor(rng.random((count, 2)) * side / 6) * 6 + 3
    return np.column_stack([places, np.full(count, 1.5)]) + rng.normal(size=(count, 3))


def _to_open3d(points: Any) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))


def _by_open3d(first: Any, second: Any) -> tuple[Any, Any]:
    there = first.compute_point_cloud_distance(second)
    return np.asarray(there), np.asarray(second.compute_point_cloud_distance(first))


def _resident(field: str) -> float:
    """Return VmRSS, the memory resident now, or VmHWM, its peak, in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(field))


def table(timings: dict[str, list[Timing]]) -> str:
    """Return the medians of each system, and the ratio of theirs to ours within a repeat."""
    ratios = [b.seconds / a.seconds for a, b in zip(*timings.values(), strict=True)]
    rows = [
        (
            system,
            f"{median(t.seconds for t in runs):.1f}",
            f"{median(t.cpu_seconds for t in runs):.1f}",
            f"{max(t.memory_mb for t in runs):.0f}",
            " / ".join(f"{mean:.4f}" for mean in runs[0].means),
        )
        for system, runs in timings.items()
    ]
    header = (
        "System",
        "Both ways, s",
        "CPU, s",
        "Memory above the maps, MB",
        "Mean distances, m",
    )
    spread = f"{min(ratios):.2f} .. {max(ratios):.2f}"
    return f"{markdown(header, rows)}\n\n{median(ratios):.2f} times as fast ({spread})"


def agree(timings: Sequence[Timing]) -> bool:
    """Tell whether all measurements found the same distances, to a micrometre."""
    figures = np.array([t.means + t.largest for t in timings])
    return bool(np.ptp(figures, axis=0).max() < 1e-6)


if __name__ == "__main__":
    sys.exit(main())
