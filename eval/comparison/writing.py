"""Writes the tables of a comparison: Markdown to read, LaTeX to print, CSV to go on from."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from eval.comparison.runs import Missing
from eval.comparison.table import Table
from eval.files import atomic_path, plain_cell

# What LaTeX's own fonts have no letter for.
_LATEX = {"±": r"$\pm$", "→": r"$\rightarrow$", "²": r"$^2$"}


def write_tables(folder: Path, tables: Sequence[Table], missing: Sequence[Missing]) -> None:
    """Write `comparison.md` and `comparison.tex` with all tables, and each of them as a CSV file.

    Raises:
        OSError: the folder can't be made or written to.
    """
    _write(folder / "comparison.md", markdown(tables, missing))
    _write(folder / "comparison.tex", latex(tables))
    for table in tables:
        frame = table.numbers().map(plain_cell).rename(columns=plain_cell)
        text = frame.to_csv(index=False, lineterminator="\n")
        _write(folder / f"{table.name}.csv", text)


def markdown(tables: Iterable[Table], missing: Sequence[Missing]) -> str:
    """Return all tables with their notes, and what is in none of them."""
    parts = ["# Comparison of runs"]
    for table in tables:
        title = _plain(table.title)
        parts += [f"## {title}", _markdown_table(table), _bullets(table.notes)]
    if missing:
        parts += [
            f"## Not in the tables: {len(missing)}",
            _bullets([f"{run.name}: {run.reason}" for run in missing]),
        ]
    return "\n\n".join(parts) + "\n"


def latex(tables: Iterable[Table]) -> str:
    """Return all tables as LaTeX floats; they need the packages booktabs and multirow."""
    return "% needs \\usepackage{booktabs,multirow}\n" + "\n".join(map(_latex_table, tables))


def _markdown_table(table: Table) -> str:
    frame = table.text(flat=True)
    cells = _marked(frame, table.best(), "**{}**")
    escaped = [
        [_plain(text).replace("|", "\\|") for text in row] for row in [[*frame.columns], *cells]
    ]
    widths = [max(3, *map(len, column)) for column in zip(*escaped, strict=True)]
    named = len(table.index)
    rule = ["-" * w if i < named else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
    lines = [
        [t.ljust(w) if i < named else t.rjust(w) for i, (t, w) in enumerate(zip(r, widths, strict=True))]
        for r in escaped
    ]  # fmt: skip
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], rule, *lines[1:]])


def _latex_table(table: Table) -> str:
    frame = table.text()
    marks = np.where(table.best(), "textbf:--rwrap;", "")
    style = frame.style.format(escape="latex").format_index(escape="latex", axis=1).hide(axis=0)
    style = style.apply(lambda _: pd.DataFrame(marks, frame.index, frame.columns), axis=None)
    text = style.to_latex(
        hrules=True,
        position="htbp",
        position_float="centering",
        caption=table.title,
        label=f"tab:{table.name}",
        column_format="l" * len(table.index) + "r" * len(table.columns),
        multicol_align="c",
    )
    for letter, command in _LATEX.items():
        text = text.replace(letter, command)
    return text


def _marked(frame: pd.DataFrame, best: NDArray[np.bool_], mark: str) -> list[list[str]]:
    return [
        [mark.format(text) if marked else text for text, marked in zip(row, marks, strict=True)]
        for row, marks in zip(frame.to_numpy().tolist(), best.tolist(), strict=True)
    ]


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {_plain(line)}" for line in lines)


def _plain(text: str) -> str:
    """Return text in one line that Markdown doesn't take for HTML."""
    return " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;")


def _write(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text)
