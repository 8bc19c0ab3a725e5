"""The cells of `campaigns.py`, their outcomes, and the tables that these make."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from statistics import fmean
from typing import Any

import numpy as np
from throughput import OURS, facts, markdown, system_overrides

from eval.comparison.published import SCENARIOS, published_trajectory

LOOP, LOOP_SENSOR = "loop", "vls128"
TITLES = {"mae_m": "MAE", "rmse_m": "RMSE", "max_m": "Maximum error"}
FIGURES = ("mae_m", "max_m")  # of Table 5.1
_FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Cell:
    """One run: what is mapped, by which system.

    Attributes:
        scenario: a choice of conf/scenario that is simulated.
        sensor: a choice of conf/sensor.
        system: a choice of conf/system.
        seed: of the world.
        laps: of a closed route.
    """

    scenario: str
    sensor: str
    system: str
    seed: int
    laps: int = 1

    def overrides(self) -> list[str]:
        """Return what `scripts/run.py` would be called with."""
        laps = [f"scenario.laps={self.laps}"] if self.laps > 1 else []
        choices = [f"scenario={self.scenario}", f"sensor={self.sensor}"]
        return [*choices, *system_overrides(self.system), f"scenario.seed={self.seed}", *laps]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The errors of a cell in metres, or why there are none.

    Attributes:
        cell: what was run.
        scans: poses that were compared.
        length_m: length of the true path along them.
        mae_m: mean position error.
        rmse_m: root of the mean squared position error.
        max_m: largest position error.
        loops: loop closures in the final graph.
        error: why the cell failed, or nothing.
    """

    cell: Cell
    scans: int = 0
    length_m: float = float("nan")
    mae_m: float = float("nan")
    rmse_m: float = float("nan")
    max_m: float = float("nan")
    loops: int = 0
    error: str = ""

    def row(self) -> dict[str, Any]:
        """Return one flat row for CSV and JSON."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "cell"}
        return asdict(self.cell) | values


class Table:
    """Outcomes by what was run."""

    def __init__(self, outcomes: Sequence[Outcome]) -> None:
        """Index the outcomes."""
        self.outcomes = list(outcomes)
        cells = [outcome.cell for outcome in outcomes]
        self.scenarios = _distinct(cell.scenario for cell in cells)
        self.sensors = _distinct(cell.sensor for cell in cells)
        self.systems = _distinct(cell.system for cell in cells)
        self.seeds = _distinct(cell.seed for cell in cells)
        self._by_cell = {(c.scenario, c.sensor, c.system, c.seed): o for c, o in self._pairs()}

    def values(self, metric: str, scenario: str, sensor: str, system: str) -> list[float]:
        """Return a metric for every seed that there is an outcome for; NaN where it failed."""
        keys = [(scenario, sensor, system, seed) for seed in self.seeds]
        return [getattr(self._by_cell[key], metric) for key in keys if key in self._by_cell]

    def only(self, keep: Callable[[Cell], bool]) -> "Table":
        """Return the table of some of the cells."""
        return Table([outcome for cell, outcome in self._pairs() if keep(cell)])

    def _pairs(self) -> Iterator[tuple[Cell, Outcome]]:
        return ((outcome.cell, outcome) for outcome in self.outcomes)


def report(outcomes: Sequence[Outcome], arguments: Sequence[str], limit: int | None = None) -> str:
    """Return all tables in Markdown, with what they depend on."""
    table = Table(outcomes)
    campaigns = table.only(lambda cell: cell.scenario in SCENARIOS)
    loop = table.only(lambda cell: cell.scenario not in SCENARIOS)
    parts = ["# Trajectory errors on the simulated campaigns", facts("campaigns.py", arguments)]
    if limit is not None:
        parts += [
            f"Only the first {limit} scans of each: not to be held against what is published."
        ]
    if campaigns.outcomes:
        first = campaigns.only(lambda cell: cell.seed == campaigns.seeds[0])
        for metric in FIGURES:
            title = f"## {TITLES[metric]} in metres, world seed {first.seeds[0]}"
            parts += [title, published_table(first, metric)]
        parts += [summary(campaigns)]
    if len(campaigns.seeds) > 1:
        seeds = ", ".join(map(str, campaigns.seeds))
        parts += [f"## MAE in metres over world seeds {seeds}: mean (min .. max)"]
        parts += [spread_table(campaigns, "mae_m")]
    if loop.outcomes:
        laps = loop.outcomes[0].cell.laps
        parts += [f"## Errors in metres on {laps} laps of loop, {LOOP_SENSOR}", loop_table(loop)]
    return "\n\n".join(parts)


def published_table(table: Table, metric: str) -> str:
    """Return a table of Table 5.1's shape: a row a scenario, and for each sensor all systems."""
    header = ["Scenario"]
    for sensor in table.sensors:
        header += [f"{sensor}: published", *table.systems]
    rows = []
    for scenario in table.scenarios:
        row = [scenario]
        for sensor in table.sensors:
            row.append(_metres(published(metric, scenario, sensor), digits=2))
            row += [_metres(table.values(metric, scenario, sensor, s)) for s in table.systems]
        rows.append(row)
    return markdown(header, rows)


def published(metric: str, scenario: str, sensor: str) -> list[float]:
    """Return the figure of Table 5.1, if it has one for the sensor."""
    figure = published_trajectory(metric, scenario, sensor)
    return [] if figure is None else [figure]


def spread_table(table: Table, metric: str) -> str:
    """Return a row for each scenario and sensor: mean, least and greatest over the seeds."""
    rows = [
        [scenario, sensor]
        + [_spread(table.values(metric, scenario, sensor, system)) for system in table.systems]
        for scenario, sensor in product(table.scenarios, table.sensors)
    ]
    return markdown(["Scenario", "Sensor", *table.systems], rows)


def loop_table(table: Table) -> str:
    """Return a row for each seed and system, with the number of loop closures."""
    rows = [
        [str(o.cell.seed), o.cell.system, f"{o.length_m:.0f}"]
        + [_metres([getattr(o, metric)]) for metric in TITLES]
        + [str(o.loops)]
        for o in table.outcomes
    ]
    return markdown(["Seed", "System", "Path", *TITLES.values(), "Loop closures"], rows)


def summary(table: Table) -> str:
    """Count the cells, of all seeds, in which our MAE is below what it is measured by."""
    lines = []
    for name, others, factor in (
        ("below the published figure", _published_values, 1.0),
        ("at most half the published figure", _published_values, 0.5),
        *((f"no worse than {s}", _values_of(s), 1.0) for s in table.systems if s != OURS),
    ):
        pairs = list(_beside(table, others))
        if pairs:
            count = sum(ours <= factor * other for ours, other in pairs if ours < np.inf)
            lines.append(f"- MAE of {OURS} {name}: {count} of {len(pairs)} cells")
    return "\n".join(lines)


_Others = Callable[[Table, str, str], list[float]]


def _published_values(table: Table, scenario: str, sensor: str) -> list[float]:
    return published("mae_m", scenario, sensor) * len(table.seeds)


def _values_of(system: str) -> _Others:
    return lambda table, scenario, sensor: table.values("mae_m", scenario, sensor, system)


def _beside(table: Table, others: _Others) -> Iterator[tuple[float, float]]:
    """Yield our MAE beside another in each cell; a cell that failed counts as the worst."""
    for scenario, sensor in product(table.scenarios, table.sensors):
        ours = table.values("mae_m", scenario, sensor, OURS)
        theirs = others(table, scenario, sensor)
        for pair in zip(ours, theirs, strict=False):  # a system that is still to run has none
            mine, other = (np.inf if np.isnan(value) else value for value in pair)
            yield mine, other


def _metres(values: list[float], digits: int = 3) -> str:
    if not values:
        return ""
    return _FAILED if np.isnan(values[0]) else f"{values[0]:.{digits}f}"


def _spread(values: list[float]) -> str:
    """Return mean and range, and how many failed."""
    good = [value for value in values if not np.isnan(value)]
    failed = f" {len(values) - len(good)} {_FAILED}" if len(good) < len(values) else ""
    if not good:
        return failed.strip()
    return f"{fmean(good):.3f} ({min(good):.3f} .. {max(good):.3f}){failed}"


def _distinct(values: Iterator[Any]) -> list[Any]:
    return list(dict.fromkeys(values))
