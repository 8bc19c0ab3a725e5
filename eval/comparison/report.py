"""The page of a comparison: its tables, and the paths of its runs over each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from numpy.typing import NDArray

from eval.comparison.maps import trajectory_alignment
from eval.comparison.runs import Run, Runs, differing
from eval.comparison.table import Table
from eval.comparison.tables import scenario_of
from eval.report.charts import THINNED, draw, table, text
from eval.report.encoding import POINTS, thin
from eval.report.page import Page
from eval.report.views import from_above
from eval.trajectory_files import read_tum

Array = NDArray[np.float64]

_PATH = "trajectory.tum"
_BEST = " ★"
_COLOURS = 6  # curves in the report's style


def write_report(path: Path, runs: Runs, tables: Sequence[Table]) -> None:
    """Write the page of a comparison, one file that needs no network, replacing it as a whole.

    Raises:
        FileError: a trajectory of a run is malformed.
    """
    page = Page("Comparison of runs", f"{len(runs.finished)} runs")
    for each in tables:
        notes = [*each.notes, *([f"The mark is{_BEST}."] if each.best().any() else [])]
        page.add(each.title, " ".join(notes), table(marked(each)))
    with_paths = [run for run in runs.finished if (run.folder / _PATH).is_file()]
    for alike in _on_the_same_scans(with_paths):
        page.add(_heading(alike), "Each moved onto the reference, if there is one.", paths(alike))
    if runs.missing:
        frame = pd.DataFrame([(run.name, run.reason) for run in runs.missing])
        frame.columns = pd.Index(["Run", "Why"])
        page.add("Not in the tables", "Runs without figures to compare.", table(frame))
    page.write(path)


def marked(table: Table) -> pd.DataFrame:
    """Return a table's text with a mark behind the best figures."""
    frame = table.text()
    marks = np.where(table.best(), _BEST, "")
    return frame + pd.DataFrame(marks, frame.index, frame.columns)


def paths(runs: Sequence[Run]) -> Markup:
    """Overlay the paths of runs on the same scans, seen from above, each named by its settings."""
    keys = differing(runs)
    traces, shapes = [], []
    reference = runs[0].folder / "reference.tum"
    if reference.is_file():
        line = {"color": "--reference", "width": 5}
        shapes.append(read_tum(reference).positions_xyz)
        traces.append(_trace(shapes[0], "reference", line))
    for number, run in enumerate(runs):
        positions = read_tum(run.folder / _PATH).positions_xyz
        alignment = trajectory_alignment(run)
        moved = positions if alignment is None else alignment.move(positions)
        name = " ".join(f"{key}={run.setting(key)}" for key in keys) or run.folder.name
        line = {"color": f"--curve-{number % _COLOURS}", "width": 2}
        shapes.append(moved)
        traces.append(_trace(moved, name, line))
    words = f"Paths of {len(runs)} runs from above."
    return draw(from_above("Paths", words, traces, np.concatenate(shapes), THINNED))


def _trace(positions: Array, name: str, line: dict[str, Any]) -> dict[str, Any]:
    kept = np.union1d(*(thin(positions[:, axis], POINTS // 2) for axis in (0, 1)))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": text(name),
        "x": positions[kept, 0],
        "y": positions[kept, 1],
        "line": line,
        "hovertemplate": "%{x:.2f}, %{y:.2f} m",
    }


def _on_the_same_scans(runs: Sequence[Run]) -> list[list[Run]]:
    """Return the runs by scenario and its settings, its seed among them."""
    keys = sorted({key for run in runs for key in run.overrides if key.startswith("scenario.")})
    alike: dict[tuple[str | None, ...], list[Run]] = {}
    for run in runs:
        key = (scenario_of(run), *(run.setting(key) for key in keys))
        alike.setdefault(key, []).append(run)
    return [alike[key] for key in sorted(alike, key=str)]


def _heading(runs: Sequence[Run]) -> str:
    keys = sorted({key for run in runs for key in run.overrides if key.startswith("scenario.")})
    settings = [f"{key}={runs[0].setting(key)}" for key in keys]
    return " ".join([f"Trajectories: scenario {scenario_of(runs[0])}", *settings])
