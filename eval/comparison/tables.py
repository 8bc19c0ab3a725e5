"""The tables of a comparison: Tables 5.1 to 5.3 of paper 000, and one of all headline figures."""

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, permutations

from eval.comparison.maps import DistanceSummary, compare_maps
from eval.comparison.published import (
    SENSORS,
    SOURCE,
    published_map,
    published_trajectory,
)
from eval.comparison.runs import Run, differing
from eval.comparison.table import OURS, PUBLISHED, Cell, Column, Table
from eval.errors import EvalError
from eval.metrics.metric import Section

_log = logging.getLogger(__name__)

_LESS = "Less is better."
_CAMPAIGN = f"Published: {SOURCE}; another car and place, so it says which size of error to expect."
_SPREAD = "Several seeds: mean ± half width of its 95 % confidence interval (Student's t)."
_ALIGNED = (
    "Each map is moved into the reference's frame by aligning the poses of its trajectory first."
)
_UNALIGNED = (
    "without a reference for both, the maps are compared in the frames of their first scans."
)
# Title and digits of our figure.
_ERRORS = {"mae_m": ("MAE [m]", 3), "max_m": ("Max. [m]", 3), "mse_m2": ("MSE [m²]", 4)}


# What trajectories and pruning are compared by besides the headlines: section and key in metrics.json.
_EXTRAS = {
    Column(("RMSE [m]",), None, True): ("trajectory", "rmse_m"),
    Column(("Max. error [m]",), None, True): ("trajectory", "max_m"),
    Column(("Edges",), None): ("graph", "edges"),
    Column(("Loop closures",), None): ("graph", "loop_edges"),
}


class Groups:
    """Runs by what their command lines chose.

    Attributes:
        runs: all of them.
        scenarios: in the order of their names.
        sensors: those of the published campaigns first.
        keys: other settings that aren't the same in all runs, seeds apart.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        """Look at what differs."""
        self.runs = runs
        self.scenarios = sorted({scenario_of(run) for run in runs})
        self.sensors = sorted({sensor_of(run) for run in runs}, key=_sensor_order)
        self.keys = [key for key in differing(runs) if key not in ("scenario", "sensor")]

    def variant(self, run: Run) -> str:
        """Return the other settings of a run, as on a command line."""
        settings = ((key, run.setting(key)) for key in self.keys)
        return " ".join(f"{key}={value}" for key, value in settings if value is not None)

    def rows(self) -> dict[tuple[str, str], list[Run]]:
        """Return the runs of each scenario and variant."""
        rows: dict[tuple[str, str], list[Run]] = {}
        for run in sorted(self.runs, key=lambda run: self.scenarios.index(scenario_of(run))):
            rows.setdefault((scenario_of(run), self.variant(run)), []).append(run)
        return rows

    def index(self) -> tuple[str, ...]:
        """Return the headings of a row's key."""
        return ("Scenario", "Settings") if self.keys else ("Scenario",)


def make_tables(runs: Sequence[Run]) -> list[Table]:
    """Return all tables that the runs have figures for.

    The maps of each scenario are read and compared, which takes a while.
    """
    groups = Groups(runs)
    tables = [
        trajectory_table(groups, "5.1", "Trajectory: MAE and maximum error", ("mae_m", "max_m")),
        trajectory_table(groups, "5.2", "Trajectory: MSE", ("mse_m2",)),
        map_table(groups),
        headline_table(runs),
    ]
    return [table for table in tables if table.rows and table.columns]


def trajectory_table(groups: Groups, number: str, title: str, figures: Sequence[str]) -> Table:
    """Return a row a scenario, and for each sensor the figures, published and ours.

    Args:
        groups: of runs.
        number: of the published table.
        title: of a few words.
        figures: keys of section `trajectory` in metrics.json.
    """
    columns: list[Column] = []
    cells: list[list[Cell]] = []  # by column
    rows = groups.rows()
    for sensor in groups.sensors:
        for figure in figures:
            values = [_published(published_trajectory(figure, key[0], sensor)) for key in rows]
            ours = [
                Cell.of([r.figure("trajectory", figure) for r in runs if sensor_of(r) == sensor])
                for runs in rows.values()
            ]
            title_of, digits = _ERRORS[figure]
            if any(cell.count for cell in ours):
                heading = (sensor, title_of)
                columns += [
                    Column((*heading, PUBLISHED), 2),
                    Column((*heading, OURS), digits, True),
                ]
                cells += [values, ours]
    name = f"table_{number.replace('.', '_')}"
    notes = (
        f"Position errors after Kabsch alignment. {_LESS}",
        _CAMPAIGN,
        *_about_seeds(groups.runs),
    )
    return _table(groups, name, f"Table {number}. {title}", notes, rows, columns, cells)


def map_table(groups: Groups) -> Table:
    """Return a row a scenario: distances between the maps of its sensors, in each direction.

    Runs that differ in the sensor alone make a pair.
    """
    notes: list[str] = []
    distances: dict[tuple[str, str], _ByDirection] = {}
    for key, runs in groups.rows().items():
        found = _map_distances(" ".join(key).strip(), runs, notes)
        if found:
            distances[key] = found
    columns: list[Column] = []
    cells: list[list[Cell]] = []
    for source, target in permutations(sorted(groups.sensors, key=_sensor_order, reverse=True), 2):
        for figure, title in (("hausdorff_m", "Hausdorff [m]"), ("mean_m", "Mean [m]")):
            ours = [
                Cell.of([getattr(d, figure) for d in found.get((source, target), [])])
                for found in distances.values()
            ]
            if any(cell.count for cell in ours):
                heading = (f"{source} → {target}", title)
                columns += [Column((*heading, PUBLISHED), 2), Column((*heading, OURS), 3, True)]
                values = (published_map(figure, key[0], source, target) for key in distances)
                cells += [[*map(_published, values)], ours]
    notes = [
        "From each point of one map to the nearest point of the other: the largest distance"
        f" (directional Hausdorff) and the mean. {_LESS}",
        _CAMPAIGN,
        *_about_seeds(groups.runs),
        *dict.fromkeys(notes),
    ]
    title = "Table 5.3. Distances between the maps of two sensors"
    return _table(groups, "table_5_3", title, tuple(notes), distances, columns, cells)


def headline_table(runs: Sequence[Run]) -> Table:
    """Return a row for each choice of settings with the headlines of all metrics, the best ones marked.

    Runs compete with those on the same scans: the same scenario with the same settings.
    """
    keys = sorted(differing(runs), key=lambda key: not key.startswith("scenario"))
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(_row(run, keys), []).append(run)
    scans = [key for key in keys if key.startswith("scenario")]
    order = sorted(groups, key=lambda settings: settings[: len(scans)])
    figures = {run.folder: _figures(run) for run in runs}
    known = dict.fromkeys(column for found in figures.values() for column in found)
    columns = [
        column
        for column in sorted(known, key=_EXTRAS.__contains__)
        if any(found.get(column) is not None for found in figures.values())
    ]
    return Table(
        "headlines",
        "All runs: headline figures",
        ("The best figure on each scenario is marked.", *_about_seeds(runs)),
        tuple(keys) or ("runs",),
        tuple(columns),
        {
            row: [
                Cell.of([figures[r.folder].get(column) for r in groups[row]]) for column in columns
            ]
            for row in order
        },
        contest=len(scans),
    )


def scenario_of(run: Run) -> str:
    """Return the scenario, or what stands for it in a folder that was not made by `run.py`."""
    return run.setting("scenario") or run.folder.name


def sensor_of(run: Run) -> str:
    """Return the sensor."""
    return run.setting("sensor") or "sensor"


def _row(run: Run, keys: Sequence[str]) -> tuple[str, ...]:
    """Return what the row of a run begins with: its settings, or its name if it has none."""
    if run.is_bare:
        return (run.folder.name, *[""] * (len(keys) - 1))
    return tuple(run.setting(key) or "" for key in keys) or ("all",)


def _figures(run: Run) -> dict[Column, float | None]:
    """Return the headlines of a run's metrics, in their order, and the extras."""
    figures = {}
    for section in Section:
        for name, known in run.metrics.get(section, {}).get("headlines", {}).items():
            heading = f"{known['title']} [{known['unit']}]" if known["unit"] else known["title"]
            column = Column((heading,), None, known["less_is_better"])
            figures[column] = run.figure(section, "headlines", name, "value")
    return figures | {column: run.figure(*keys) for column, keys in _EXTRAS.items()}


_ByDirection = dict[tuple[str, str], list[DistanceSummary]]


def _map_distances(name: str, runs: Sequence[Run], notes: list[str]) -> _ByDirection:
    """Compare the maps of runs that differ in the sensor and the seeds alone, seed by seed."""
    found: _ByDirection = defaultdict(list)
    pairs = list(_pairs(runs))
    if not pairs:
        sensors = ", ".join(sorted({sensor_of(run) for run in runs}))
        notes.append(f"{name}: no maps of two sensors with the same settings, only of {sensors}.")
    for first, second in pairs:
        _log.info("comparing maps: %s, %s and %s", name, sensor_of(first), sensor_of(second))
        try:
            pair = compare_maps(first, second)
        except EvalError as error:
            notes.append(f"{name}: maps not compared: {error}.")
            continue
        notes.append(_ALIGNED if pair.aligned else f"{name}: {_UNALIGNED}")
        found[sensor_of(first), sensor_of(second)].append(pair.there)
        found[sensor_of(second), sensor_of(first)].append(pair.back)
    return found


def _pairs(runs: Sequence[Run]) -> Iterator[tuple[Run, Run]]:
    by_seeds: dict[tuple[tuple[str, str | None], ...], list[Run]] = {}
    for run in runs:
        by_seeds.setdefault(run.seeds, []).append(run)
    for alike in by_seeds.values():
        for first, second in combinations(alike, 2):
            if sensor_of(first) != sensor_of(second):
                yield first, second


def _table(
    groups: Groups,
    name: str,
    title: str,
    notes: tuple[str, ...],
    keys: Iterable[tuple[str, str]],
    columns: Sequence[Column],
    cells: Sequence[Sequence[Cell]],
) -> Table:
    """Put columns of cells together, without those that nothing was published for."""
    filled = [i for i, column in enumerate(cells) if any(cell.count for cell in column)]
    index = groups.index()
    return Table(
        name,
        title,
        notes,
        index,
        tuple(columns[i] for i in filled),
        {key[: len(index)]: [cells[i][k] for i in filled] for k, key in enumerate(keys)},
    )


def _published(value: float | None) -> Cell:
    return Cell.of([value])


def _about_seeds(runs: Sequence[Run]) -> tuple[str, ...]:
    return (_SPREAD,) if len({run.seeds for run in runs}) > 1 else ()


def _sensor_order(sensor: str) -> tuple[int, str]:
    return (SENSORS.index(sensor) if sensor in SENSORS else len(SENSORS), sensor)
