"""Reduce a pose graph from a g2o file to fewer vertices, and tell what that changes.

    python scripts/prune.py graph=in.g2o out=out.g2o pruning=geometry keep=0.33
    python scripts/prune.py graph=in.g2o truth=truth.g2o pruning=chow_liu json=figures.json

SE(2) and SE(3) graphs are read; a file without vertices is chained from its edges. The graph is optimised,
pruned, and optimised again. Settings, with their defaults in conf/prune.yaml:

    graph=FILE           g2o file; edges between a vertex and the next, whichever way round, are odometry,
                         unless a comment says otherwise: a line `# odometry`, `# loop` or `# composed`
                         before them (docs/pruning.md has the rule, and what else a file may hold)
    out=FILE             g2o file to write what is left to, of the same dimension
    pruning=geometry     none, geometry, decimate, random, chow_liu or dense, of conf/pruning;
                         pruning.KEY=VALUE changes a setting of it
    keep=0.3333          share of the vertices that stay
    truth=FILE           true poses, for the error (APE: RMSE after alignment, in the plane if the graph
                         is): g2o, edges between true poses (EDGE2, EDGE3), or TUM, a row for each vertex;
                         vertices that it lacks or that no edge reaches aren't judged
    robust=true          let loop closures vote, and leave out those that don't fit; false trusts them all
    json=FILE            write the figures
    seed=0               of pruning=random
    sensor.field_of_view=360  degrees, and sensor.vertex_spacing=1 in metres: with a narrow field of view,
                         two vertices in one place that look half of it apart count as one spacing apart

Exit status: 0 done; 2 bad input or settings, said in one line; 130 stopped by Ctrl-C.
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from command import CONF, run_command
from eval.files import write_json
from eval.vertices import Array, rmse, vertex_distances
from lifelong_slam.config import build, check_value, one_line
from lifelong_slam.errors import ConfigError
from lifelong_slam.graph.reduction import Reduction, State, reduce
from lifelong_slam.io.g2o import read_g2o, write_g2o
from lifelong_slam.io.graph_truth import read_truth
from lifelong_slam.overrides import compose_checked
from lifelong_slam.provenance import describe_run, seed_everything
from lifelong_slam.result import GraphSnapshot

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Settings:
    """What the command line can say besides the pruning method; see the top of this file."""

    graph: str
    out: str | None
    keep: float
    truth: str | None
    robust: bool
    json: str | None
    seed: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Reduce a graph and return the exit status."""
    return run_command(work, arguments, __doc__, "Stopped: nothing is written.")


def work(arguments: Sequence[str]) -> None:
    """Do what the command line says, and show what it changes."""
    config = compose_checked(CONF, arguments, "prune")
    show(prune(parse(config), config, arguments))


def parse(config: DictConfig) -> Settings:
    """Return the checked settings.

    Raises:
        ConfigError: there is no input, or a value has the wrong type.
    """
    types = Settings.__annotations__
    if not config.get("pruning"):
        raise ConfigError("nothing is chosen for pruning: give pruning=...")
    if OmegaConf.is_missing(config, "graph"):
        raise ConfigError("graph has no value: give a g2o file with graph=...")
    return Settings(**{key: check_value(key, config.get(key), types[key]) for key in types})


def prune(settings: Settings, config: DictConfig, arguments: Sequence[str]) -> dict[str, Any]:
    """Read, reduce and write a graph, and return the figures."""
    seed_everything(settings.seed)
    pruning = build(config.pruning)
    graph = read_g2o(Path(settings.graph))
    judged = sorted(set(graph.poses) - isolated(graph))
    truth = read_truth(Path(settings.truth), judged) if settings.truth else None
    try:
        result = reduce(graph, pruning, settings.keep, settings.robust)
    except RuntimeError as error:  # GTSAM's, of numbers that it can't solve for
        raise ConfigError(f"{settings.graph} can't be optimised: {one_line(error)}") from error
    if settings.out:
        if not result.complete:
            raise ConfigError(
                "this method leaves factors over many vertices, which a g2o file can't hold:"
                " choose another one, or leave out= away"
            )
        write_g2o(Path(settings.out), result.graph)
    facts = {
        "run": describe_run(arguments, settings.seed),
        "planar": graph.planar,
        **figures(result, judged, truth, graph.planar),
        "pruning": dict(pruning.counts),
    }
    if settings.json:
        write_json(Path(settings.json), facts)
    return facts


def isolated(graph: GraphSnapshot) -> set[int]:
    """Return the vertices of which nothing is measured, after a warning if there are any."""
    alone = set(graph.poses) - {end for edge in graph.edges for end in (edge.source, edge.target)}
    alone -= {*graph.fixed, *(prior.vertex for prior in graph.priors)}
    if alone:
        logger.warning(
            "no edges lead to %d of %d vertices, such as %d: they stay where they are and aren't judged",
            len(alone),
            len(graph.poses),
            min(alone),
        )
    return alone


def figures(
    result: Reduction, judged: list[int], truth: dict[int, Array] | None, planar: bool
) -> dict[str, Any]:
    """Return what the states of a reduction are like, and how far the last is from the optimum.

    Args:
        result: the reduction.
        judged: the vertices that figures are about, without regard to the truth.
        truth: true poses (4, 4) of vertices, those that are judged by it.
        planar: the graph is.
    """
    among = set(judged)
    stay = [vertex for vertex in result.pruned.vertices if vertex in among]

    def ape(poses: dict[int, Array], vertices: list[int]) -> float | None:
        known = [vertex for vertex in vertices if truth and vertex in truth]
        return rmse(vertex_distances(poses, truth, known, planar)) if truth and known else None

    def of_state(state: State) -> dict[str, Any]:
        return {
            "vertices": len(state.vertices),
            "edges": state.edges,
            "loops": state.loops,
            "composed": state.composed,
            "rejected": state.rejected,
            "chi_square": state.chi_square,
            "seconds": state.seconds,
            "ape_staying_m": ape(state.poses, stay),
            "ape_all_m": ape(state.poses, judged),
        }

    optimum, pruned = result.optimum.poses, result.pruned.poses
    return {
        "states": {name: of_state(getattr(result, name)) for name in ("read", "optimum", "pruned")},
        "moved_staying_m": float(vertex_distances(pruned, optimum, stay, planar).mean()),
        "moved_all_m": float(vertex_distances(pruned, optimum, judged, planar).mean()),
    }


def show(facts: dict[str, Any]) -> None:
    """Print the figures as a table."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for column in ("as read", "optimised", "pruned"):
        table.add_column(column, justify="right")
    states = facts["states"].values()
    for name, key, form in _ROWS:
        values = [state[key] for state in states]
        if values[0] is not None:
            table.add_row(name, *(format(value, form) for value in values))
    console = Console(markup=False)
    console.print(table)
    console.print(
        f"Mean distance from the optimum: {facts['moved_staying_m']:.4f} m (vertices that stay),"
        f" {facts['moved_all_m']:.4f} m (all)",
        soft_wrap=True,
    )
    if facts["pruning"]:
        counts = (f"{count} {name}" for name, count in facts["pruning"].items())
        console.print(f"Of what was tried: {', '.join(counts)}", soft_wrap=True)


_ROWS = (
    ("Vertices", "vertices", "d"),
    ("Edges", "edges", "d"),
    ("Loop closures", "loops", "d"),
    ("Composed edges", "composed", "d"),
    ("Rejected", "rejected", "d"),
    ("Chi-square", "chi_square", ".2f"),
    ("APE, vertices that stay [m]", "ape_staying_m", ".4f"),
    ("APE, all vertices [m]", "ape_all_m", ".4f"),
    ("Seconds", "seconds", ".1f"),
)


if __name__ == "__main__":
    sys.exit(main())
