"""What is left of public pose graphs when two thirds of their vertices are removed, by each method?

    python benchmarks/pose_graphs.py [--data ../shared/data/pose_graphs] [--out outputs/pose_graphs]
                                     [--graphs intel,...] [--methods geometry,...] [--seeds 0,1,2]

Each graph is read from its g2o file and optimised with robust loop closures: the first table. From there
on each method works on the same graph, of that optimum and without the closures that were outvoted. It
removes two thirds of the vertices, and what is left is optimised again, so that the figures tell what the
pruned graph itself knows: the second table. Removed vertices follow those that stay.

- APE: RMSE of positions in metres against the truth, aligned in SE(2) or SE(3). Its ratio compares the same
  vertices in the pruned and in the unpruned graph.
- Moved: mean distance of the vertices from the unpruned optimum in metres, aligned likewise.
- Seconds: for pruning and the optimisation after it.

`dense` has few edges and many factors over many vertices; both are counted as edges.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from throughput import facts, markdown

from eval.files import atomic_path, write_json
from eval.vertices import Array, rmse, vertex_distances
from lifelong_slam.config import build
from lifelong_slam.graph.pruning import NoPruning, Pruning
from lifelong_slam.graph.reduction import Reduction, reduce
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.io.graph_truth import read_truth
from lifelong_slam.overrides import compose_checked
from lifelong_slam.provenance import describe_run, seed_everything
from lifelong_slam.result import GraphSnapshot

CONF = Path(__file__).resolve().parent.parent / "conf"
KEEP = 1 / 3
_KITTI = "kitti_00_GT.g2o"
GRAPHS = {
    "intel": None,
    "manhattan3500": "manhattan3500_groundtruth.txt",
    "sphere2500": "sphere2500_groundtruth.txt",
    "kitti_00_odom_GT_LC": _KITTI,
    "kitti_00_alpha_1.00": _KITTI,
    "kitti_00_alpha_0.50": _KITTI,
    "kitti_00_alpha_0.25": _KITTI,
    "kitti_00_alpha_0.00": _KITTI,
}
METHODS = ("geometry", "decimate", "random", "chow_liu", "dense")


@dataclass(frozen=True, slots=True)
class Whole:
    """A graph before pruning.

    Attributes:
        graph: name.
        vertices: in it.
        edges: in use.
        loops: loop closures in use.
        rejected: those that were outvoted.
        chi_square: of the edges in use.
        ape_read: metres, of the poses in the file, or chained along odometry if it has none.
        ape: metres, at the optimum.
        seconds: for the optimisation.
    """

    graph: str
    vertices: int
    edges: int
    loops: int
    rejected: int
    chi_square: float
    ape_read: float | None
    ape: float | None
    seconds: float


@dataclass(frozen=True, slots=True)
class Pruned:
    """A graph after pruning; see the top of this file.

    Attributes:
        graph: name.
        method: of conf/pruning, with its seed if it draws.
        vertices: that stay.
        edges: in use, and factors over many vertices.
        rejected: loop closures that were outvoted after pruning.
        chi_square: of the edges in use.
        ape: metres, of the vertices that stay.
        ape_ratio: to that of the same vertices unpruned.
        ape_ratio_all: the same of all vertices.
        moved: metres, of the vertices that stay.
        moved_all: metres, of all vertices.
        seconds: for pruning and optimisation.
    """

    graph: str
    method: str
    vertices: int
    edges: int
    rejected: int
    chi_square: float
    ape: float | None
    ape_ratio: float | None
    ape_ratio_all: float | None
    moved: float
    moved_all: float
    seconds: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, and write them after every graph."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(arguments)
    wholes: list[Whole] = []
    rows: list[Pruned] = []
    for name in options.graphs:
        graph, truth = read(options.data, name)
        result = reduce(graph, NoPruning(), keep=1.0)
        wholes.append(whole(name, result, truth, graph.planar))
        print(f"{name}: optimised", file=sys.stderr)
        for method, pruning in prunings(options.methods, options.seeds):
            pruned = reduce(result.graph, pruning, KEEP)
            rows.append(compare(name, method, pruned, truth, graph.planar))
            print(f"{name}, {method}: done", file=sys.stderr)
        if options.out:
            write(options.out, arguments, wholes, rows)
    print(report(arguments, wholes, rows))
    return 0


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    top = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    top.add_argument("--data", type=Path, default=Path("../shared/data/pose_graphs"))
    top.add_argument("--out", type=Path)
    top.add_argument("--graphs", type=lambda text: text.split(","), default=list(GRAPHS))
    top.add_argument("--methods", type=lambda text: text.split(","), default=list(METHODS))
    top.add_argument(
        "--seeds", type=lambda text: [int(s) for s in text.split(",")], default=[0, 1, 2]
    )
    return top


def read(folder: Path, name: str) -> tuple[GraphSnapshot, dict[int, Array] | None]:
    """Read a graph and, if there is one, its truth."""
    graph = read_g2o(folder / f"{name}.g2o")
    truth = GRAPHS.get(name)
    return graph, read_truth(folder / truth, graph.poses) if truth else None


def prunings(methods: Sequence[str], seeds: Sequence[int]) -> Iterator[tuple[str, Pruning]]:
    """Yield the methods by name, and `random` once for each seed."""
    for method in methods:
        for seed in seeds if method == "random" else seeds[:1]:
            seed_everything(seed)
            lines = ["graph=", f"pruning={method}", f"seed={seed}"]
            name = f"{method} {seed}" if method == "random" else method
            yield name, build(compose_checked(CONF, lines, "prune").pruning)


def whole(name: str, result: Reduction, truth: dict[int, Array] | None, planar: bool) -> Whole:
    """Return the figures of an unpruned graph."""
    state = result.optimum
    return Whole(
        name,
        len(state.vertices),
        state.edges,
        state.loops,
        state.rejected,
        state.chi_square,
        ape(result.read.poses, truth, state.vertices, planar),
        ape(state.poses, truth, state.vertices, planar),
        state.seconds,
    )


def compare(
    name: str, method: str, result: Reduction, truth: dict[int, Array] | None, planar: bool
) -> Pruned:
    """Return the figures of a pruned graph."""
    state, optimum = result.pruned, result.optimum
    stay, every = state.vertices, optimum.vertices

    def ratio(vertices: list[int]) -> float | None:
        unpruned = ape(optimum.poses, truth, vertices, planar)
        ours = ape(state.poses, truth, vertices, planar)
        return ours / unpruned if ours and unpruned else None

    def moved(vertices: list[int]) -> float:
        return float(vertex_distances(state.poses, optimum.poses, vertices, planar).mean())

    return Pruned(
        name,
        method,
        len(stay),
        state.edges,
        state.rejected,
        state.chi_square,
        ape(state.poses, truth, stay, planar),
        ratio(stay),
        ratio(every),
        moved(stay),
        moved(every),
        state.seconds,
    )


def ape(
    poses: dict[int, Array], truth: dict[int, Array] | None, vertices: list[int], planar: bool
) -> float | None:
    """Return the RMSE against the truth, if there is one."""
    return rmse(vertex_distances(poses, truth, vertices, planar)) if truth else None


def write(
    folder: Path, arguments: Sequence[str], wholes: Sequence[Whole], rows: Sequence[Pruned]
) -> None:
    """Write the report and the figures."""
    with atomic_path(folder / "pose_graphs.md") as path:
        path.write_text(report(arguments, wholes, rows) + "\n")
    write_json(
        folder / "pose_graphs.json",
        {
            "run": describe_run(arguments, seed=0),
            "keep": KEEP,
            "unpruned": [asdict(row) for row in wholes],
            "pruned": [asdict(row) for row in rows],
        },
    )


def report(arguments: Sequence[str], wholes: Sequence[Whole], rows: Sequence[Pruned]) -> str:
    """Return the tables as Markdown."""
    unpruned = markdown(
        ["graph", "vertices", "edges", "loops", "rejected", "chi2", "APE read", "APE", "s"],
        [[cell(value) for value in asdict(row).values()] for row in wholes],
    )
    heads = ["graph", "method", "vertices", "edges", "rejected", "chi2"]
    heads += ["APE", "APE ratio", "APE ratio, all", "moved", "moved, all", "s"]
    pruned = markdown(heads, [[cell(value) for value in asdict(row).values()] for row in rows])
    return "\n\n".join([facts("pose_graphs.py", arguments), unpruned, pruned])


def cell(value: str | int | float | None) -> str:
    """Return a figure as the tables show it."""
    if isinstance(value, float):
        return f"{value:.4f}" if value < 10 else f"{value:.1f}"
    return "" if value is None else str(value)


if __name__ == "__main__":
    sys.exit(main())
