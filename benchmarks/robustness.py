"""How many wrong loop closures does the vote bear, beside GTSAM's GNC and plain least squares?

    python benchmarks/robustness.py --data $GRAPHS --out outputs/robustness
    python benchmarks/robustness.py --windows 0-300,500-800 --shares 10,30 --seeds 1,2 --sigmas 0.333
    python benchmarks/robustness.py --files kitti_05_alpha_0.25.g2o:kitti_05_GT.g2o,...

Windows of successive vertices are cut out of a graph whose closures are true, and closures that claim two
random vertices to be in one place are added, as sure of themselves as a true one, as a share of all
closures. Each graph is solved from the poses in its file by

- odometry: without any closure,
- least squares: with all of them,
- GNC: GTSAM's GncLMOptimizer, truncated least squares, 99 %, odometry known to be right,
- ours: the vote of `lifelong_slam/graph/robust.py`.

The bar is the error with the true closures alone (APE: RMSE after alignment). `--sigmas 0.333` states
standard deviations of odometry a third as large as the file does. With `--files`, pairs of graph and
truth, graphs are solved as they are, in place of windows. Seconds are CPU time of one process.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import TypeVar

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from throughput import facts, markdown

from eval.files import atomic_path, write_json
from eval.vertices import Array, rmse, vertex_distances
from lifelong_slam.geometry import exp
from lifelong_slam.graph.closure_problem import ClosureProblem, Trusted
from lifelong_slam.graph.reduction import loaded
from lifelong_slam.graph.robust import fitted
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.io.graph_truth import read_truth
from lifelong_slam.provenance import describe_run
from lifelong_slam.result import Edge, GraphSnapshot

WINDOWS = (
    "0-300",
    "500-800",
    "1000-1300",
    "1500-1800",
    "2000-2300",
    "2500-2800",
    "3000-3300",
    "0-800",
)
SHARES = (2.0, 5.0, 10.0, 20.0, 30.0)
METHODS = ("odometry", "least squares", "GNC", "ours")
FACTORS = (1.3, 1.5)
T = TypeVar("T")
_MATCH_SIGMA = 0.5  # m, of the place that a wrong closure claims


@dataclass(frozen=True, slots=True)
class Row:
    """One graph.

    Attributes:
        window: vertices.
        share: of wrong closures in percent of all.
        seed: that they were drawn with.
        closures: all of them.
        wrong: those that aren't true.
        bar: metres, APE with the true ones alone.
        ape: metres, by method.
        accepted: wrong closures that were let in, by method.
        left_out: true closures that weren't, by method.
        objective: of the vote, of the closures let in by method, and of the true ones.
        seconds: CPU time by method.
    """

    window: str
    share: float
    seed: int
    closures: int
    wrong: int
    bar: float
    ape: dict[str, float]
    accepted: dict[str, int]
    left_out: dict[str, int]
    objective: dict[str, float]
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True)
class FileRow:
    """One graph from a file.

    Attributes:
        name: of the file.
        closures: in it.
        accepted: closures that were let in, by method.
        ape: metres, by method.
        objective: of the vote, by method.
        seconds: CPU time by method.
    """

    name: str
    closures: int
    accepted: dict[str, int]
    ape: dict[str, float]
    objective: dict[str, float]
    seconds: dict[str, float]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables and write them, the rows and a plot."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(arguments)
    files = []
    for graph, truth in options.files:
        files.append(measure_file(graph, truth))
        print(f"{graph.stem}: done", file=sys.stderr, flush=True)
    rows = [] if options.files else measure_windows(options)
    print(report(arguments, rows, files))
    if options.out:
        write(options.out, arguments, rows, files)
    return 0


def measure_windows(options: argparse.Namespace) -> list[Row]:
    """Solve all windows with all shares of wrong closures and all seeds."""
    graph = read_g2o(options.data / f"{options.graph}.g2o")
    truth = read_truth(options.data / f"{options.graph}_groundtruth.txt", graph.poses)
    rows: list[Row] = []
    for window, share, seed in product(options.windows, options.shares, options.seeds):
        clean = cut(graph, window, options.sigmas)
        rows.append(measure(clean, truth, window, share, seed))
        print(one_line(rows[-1]), file=sys.stderr, flush=True)
    return rows


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    top = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--data", type=Path, default=Path("../shared/data/pose_graphs"))
    top.add_argument("--out", type=Path)
    top.add_argument("--graph", default="manhattan3500")
    top.add_argument("--windows", type=_list(str), default=WINDOWS)
    top.add_argument("--shares", type=_list(float), default=SHARES)
    top.add_argument("--seeds", type=_list(int), default=(1, 2, 3, 4, 5))
    top.add_argument("--sigmas", type=float, default=1.0)
    top.add_argument("--files", type=_list(_pair), default=[])
    return top


def _list(kind: Callable[[str], T]) -> Callable[[str], list[T]]:
    return lambda text: [kind(part) for part in text.split(",")]


def _pair(text: str) -> tuple[Path, Path]:
    graph, _, truth = text.partition(":")
    return Path(graph), Path(truth)


def cut(graph: GraphSnapshot, window: str, sigmas: float) -> GraphSnapshot:
    """Return the vertices of a window and the edges among them, odometry's sigmas times a factor."""
    first, end = map(int, window.split("-"))
    inside = range(first, end)
    edges = [edge for edge in graph.edges if edge.source in inside and edge.target in inside]
    scaled = [
        replace(edge, covariance=sigmas**2 * edge.covariance) if edge.kind == "odometry" else edge
        for edge in edges
    ]
    poses = {vertex: T for vertex, T in graph.poses.items() if vertex in inside}
    return replace(graph, poses=poses, edges=scaled)


def measure(
    clean: GraphSnapshot, truth: Mapping[int, Array], window: str, share: float, seed: int
) -> Row:
    """Solve a graph with wrong closures by all methods."""
    odometry, true = by_kind(clean)
    wrong = list(wrong_closures(clean, true[0], round(len(true) * share / (100 - share)), seed))
    closures = [*true, *wrong]
    chosen, seconds = choices(clean, odometry, closures)
    right = set(range(len(true)))
    ape = {name: error(clean, odometry, closures, chosen[name], truth) for name in METHODS}
    goals = {
        name: vote_objective(clean, odometry, closures, accepted)
        for name, accepted in (*chosen.items(), ("true", right))
    }
    return Row(
        window,
        share,
        seed,
        len(closures),
        len(wrong),
        error(clean, odometry, closures, right, truth),
        ape,
        {name: len(chosen[name] - right) for name in ape},
        {name: len(right - chosen[name]) for name in ape},
        goals,
        seconds,
    )


def measure_file(graph: Path, truth: Path) -> FileRow:
    """Solve a graph from a file, whatever its closures are, by all methods."""
    whole = read_g2o(graph)
    poses = read_truth(truth, whole.poses)
    odometry, closures = by_kind(whole)
    chosen, seconds = choices(whole, odometry, closures)
    ape = {name: error(whole, odometry, closures, chosen[name], poses) for name in METHODS}
    goals = {name: vote_objective(whole, odometry, closures, chosen[name]) for name in METHODS}
    return FileRow(
        graph.stem,
        len(closures),
        {name: len(chosen[name]) for name in METHODS},
        ape,
        goals,
        seconds,
    )


def by_kind(graph: GraphSnapshot) -> tuple[list[Edge], list[Edge]]:
    """Return odometry, and the other edges."""
    odometry = [edge for edge in graph.edges if edge.kind == "odometry"]
    return odometry, [edge for edge in graph.edges if edge.kind != "odometry"]


def choices(
    graph: GraphSnapshot, odometry: Sequence[Edge], closures: Sequence[Edge]
) -> tuple[dict[str, set[int]], dict[str, float]]:
    """Return the closures that each method lets in, by index, and the CPU time of those that choose."""
    whole = replace(graph, edges=[*odometry, *closures])
    chosen: dict[str, set[int]] = {"odometry": set(), "least squares": set(range(len(closures)))}
    seconds = {}
    for name, method in (("GNC", by_gnc), ("ours", by_vote)):
        start = time.process_time()
        chosen[name] = method(whole, len(odometry))
        seconds[name] = time.process_time() - start
    return chosen, seconds


def error(
    graph: GraphSnapshot,
    odometry: Sequence[Edge],
    closures: Sequence[Edge],
    accepted: set[int],
    truth: Mapping[int, Array],
) -> float:
    """Return the APE in metres with some closures, by index, at the best optimum from several starts."""
    used = [closures[k] for k in sorted(accepted)]
    trusting = loaded(replace(graph, edges=[*odometry, *used]), robust=False)
    trusting.optimise()
    poses = trusting.poses()
    return rmse(vertex_distances(poses, truth, poses, graph.planar))


def wrong_closures(graph: GraphSnapshot, like: Edge, count: int, seed: int) -> Iterator[Edge]:
    """Yield closures that claim two random vertices to be in one place."""
    rng = np.random.default_rng(seed)
    ids = sorted(graph.poses)
    for _ in range(count):
        i, j = np.sort(rng.choice(len(ids), 2, replace=False))
        x, y = rng.normal(0, _MATCH_SIGMA, 2)
        turn = exp(np.array([0, 0, rng.uniform(-np.pi, np.pi), 0, 0, 0]))
        turn[:2, 3] = x, y
        yield Edge(ids[i], ids[max(j, i + 1)], turn, like.covariance, "loop")


def by_vote(graph: GraphSnapshot, odometry: int) -> set[int]:
    """Return the closures that our vote lets in."""
    ours = loaded(graph)
    ours.optimise(reconsider=True)
    rejected = {id(edge) for edge in ours.rejected}
    return {k for k, edge in enumerate(graph.edges[odometry:]) if id(edge) not in rejected}


def by_gnc(graph: GraphSnapshot, odometry: int) -> set[int]:
    """Return the closures that GTSAM's graduated non-convexity lets in, from the better of two starts."""
    first = min(graph.poses)
    factors = gtsam.NonlinearFactorGraph()
    factors.push_back(
        gtsam.PriorFactorPose2(
            first, pose2(graph.poses[first]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
        )
    )
    for edge in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance[np.ix_([3, 4, 2], [3, 4, 2])])
        motion = pose2(edge.T_source_target)
        factors.push_back(gtsam.BetweenFactorPose2(edge.source, edge.target, motion, noise))
    values = gtsam.Values()
    for vertex, T in graph.poses.items():
        values.insert(vertex, pose2(T))
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(odometry + 1)))
    optimiser = gtsam.GncLMOptimizer(factors, values, params)
    optimiser.setInlierCostThresholdsAtProbability(0.99)
    optimiser.optimize()
    weights = np.asarray(optimiser.getWeights())[odometry + 1 :]
    return set(np.flatnonzero(weights >= 0.5).tolist())


def pose2(T: Array) -> gtsam.Pose2:
    """Return a (4, 4) pose in the plane."""
    return gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))


def vote_objective(
    graph: GraphSnapshot, odometry: Sequence[Edge], closures: Sequence[Edge], accepted: set[int]
) -> float:
    """Return what the vote would call a choice of closures, by index: the best from several starts."""
    trusted = Trusted(odometry, [min(graph.poses)])
    problem = ClosureProblem(graph.poses, trusted, closures, graph.planar)
    starts = [problem.values(graph.poses), problem.chained(graph.poses)]
    return fitted(problem, [(accepted, start) for start in starts]).objective


def one_line(row: Row) -> str:
    """Return how one graph went."""
    errors = ", ".join(f"{name} {row.ape[name]:.3f}" for name in METHODS)
    return (
        f"{row.window}, {row.share:g} %, seed {row.seed}: {row.wrong} of {row.closures} wrong,"
        f" bar {row.bar:.3f} m; {errors}; ours {row.seconds['ours']:.1f} s, GNC {row.seconds['GNC']:.1f} s,"
        f" wrong in {row.accepted['ours']}, true out {row.left_out['ours']}"
    )


def report(arguments: Sequence[str], rows: Sequence[Row], files: Sequence[FileRow]) -> str:
    """Return the tables as Markdown."""
    tables = ([by_share(rows)] if rows else []) + ([by_file(files)] if files else [])
    return "\n\n".join([facts("robustness.py", arguments), *tables])


def by_share(rows: Sequence[Row]) -> str:
    """Return the table of windows over the shares of wrong closures."""
    header = ["wrong %", "graphs"]
    header += [f"{name}: within {factor} of the bar" for name in METHODS[1:] for factor in FACTORS]
    header += ["ours: worse than odometry", "ours: worse objective than GNC"]
    header += ["GNC s", "ours s", "ours s at most"]
    lines = []
    for share in sorted({row.share for row in rows}):
        group = [row for row in rows if row.share == share]
        line = [f"{share:g}", str(len(group))]
        for name, factor in product(METHODS[1:], FACTORS):
            within = np.mean([row.ape[name] <= factor * row.bar for row in group])
            line.append(f"{100 * within:.0f} %")
        line.append(str(sum(row.ape["ours"] > row.ape["odometry"] for row in group)))
        line.append(str(sum(row.objective["ours"] > row.objective["GNC"] + 1e-2 for row in group)))
        line += [f"{np.mean([row.seconds[name] for row in group]):.2f}" for name in ("GNC", "ours")]
        line.append(f"{max(row.seconds['ours'] for row in group):.2f}")
        lines.append(line)
    return markdown(header, lines)


def by_file(files: Sequence[FileRow]) -> str:
    """Return the table of graphs from files."""
    header = ["graph", "closures", "GNC: in", "ours: in"]
    header += [f"APE {name}" for name in METHODS]
    header += ["objective GNC", "objective ours", "GNC s", "ours s"]
    lines = [
        [
            row.name,
            str(row.closures),
            *(str(row.accepted[name]) for name in METHODS[2:]),
            *(f"{row.ape[name]:.3f}" for name in METHODS),
            *(f"{row.objective[name]:.1f}" for name in METHODS[2:]),
            *(f"{row.seconds[name]:.2f}" for name in METHODS[2:]),
        ]
        for row in files
    ]
    return markdown(header, lines)


def write(
    folder: Path, arguments: Sequence[str], rows: Sequence[Row], files: Sequence[FileRow]
) -> None:
    """Write the report, the rows and the plot."""
    with atomic_path(folder / "robustness.md") as path:
        path.write_text(report(arguments, rows, files) + "\n")
    write_json(
        folder / "robustness.json",
        {
            "run": describe_run(arguments, seed=0),
            "windows": [asdict(row) for row in rows],
            "files": [asdict(row) for row in files],
        },
    )
    if rows:
        with atomic_path(folder / "robustness.png") as path:
            plot(rows, path)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Draw the error over the share of wrong closures, in multiples of the bar: dots and their median."""
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    shares = sorted({row.share for row in rows})
    for k, name in enumerate(METHODS):
        ratios = [
            [row.ape[name] / row.bar for row in rows if row.share == share] for share in shares
        ]
        offset = (k - 1.5) * 0.15
        line = axes.plot(
            np.arange(len(shares)) + offset, [np.median(r) for r in ratios], label=name
        )
        for i, values in enumerate(ratios):
            at = np.full(len(values), i + offset)
            axes.plot(at, values, ".", color=line[0].get_color(), alpha=0.4)
    axes.axhline(1.3, color="grey", linewidth=0.8, linestyle="--", label="1.3 times the bar")
    axes.set(
        xticks=range(len(shares)),
        xticklabels=[f"{share:g} %" for share in shares],
        yscale="log",
        xlabel="wrong closures, of all",
        ylabel="APE, in multiples of the bar",
    )
    figure.legend(loc="outside upper center", ncols=5)
    figure.savefig(path, dpi=150, format="png")
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
