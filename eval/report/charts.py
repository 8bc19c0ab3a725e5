"""Blocks of a page: charts, tables, headline figures, warnings and text.

A block is HTML that is safe to put into a page as it is. A chart carries its data with it and is drawn by
report.js when the page opens. Colours are the names of custom properties in style.css, such as
`--estimate`, so that charts follow the page into dark mode and onto paper.
"""

import html
import numbers
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from eval.metrics.metric import Curve, Plot
from eval.report.encoding import POINTS, pack, thin

Array = NDArray[np.float64]

ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
THINNED = f"Drawn with at most {POINTS:,} points a line; the extremes of each stretch are kept."
_DASH = "\N{EN DASH}"
# A cell that may stand in a column of numbers: a number, whatever follows it, a dash, or nothing.
_NUMBER = re.compile(rf"[-+±]?[\d.]*\d|{_DASH}?$")
_CURVES = 6  # colours in style.css
_NAMED = {"estimate": "--estimate", "reference": "--reference"}


@dataclass(frozen=True, slots=True)
class Card:
    """A headline figure.

    Attributes:
        title: of a few words.
        value: None if it couldn't be measured.
        unit: an empty string for a count or a ratio.
        meaning: one sentence.
        less_is_better: None if neither is.
        note: what else to know, such as a published value or why there is none.
    """

    title: str
    value: float | None
    unit: str
    meaning: str
    less_is_better: bool | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Drawing:
    """A chart in the words of plotly.js.

    Attributes:
        title: a line that names what is shown.
        description: what somebody who can't see it should know.
        traces: of plotly.js; those with a `name` can be switched off in the legend.
        layout: of plotly.js.
        caption: what a reader should know about how it was drawn.
        aspect: height over width.
    """

    title: str
    description: str
    traces: Sequence[dict[str, Any]]
    layout: dict[str, Any]
    caption: str = ""
    aspect: float = 0.45


def draw(drawing: Drawing) -> Markup:
    """Return an interactive chart: zoom, pan, hover, reset, curves to switch off."""
    spec = {"data": drawing.traces, "layout": drawing.layout}
    return _render("drawing", drawing=drawing, legend=_legend(drawing.traces), data=pack(spec))


def chart(plot: Plot) -> Markup:
    """Return a chart of curves."""
    thinned, is_thinned = _thin_curves(plot)
    unit = text(_unit(plot.y_label))
    traces = [
        {
            "type": "scatter",
            "mode": "lines" if len(curve.x) > 1 else "markers",
            "name": text(curve.name),
            "x": curve.x,
            "y": np.nan_to_num(curve.y) if plot.stacked else curve.y,
            "line": {"color": colour, "width": 0.5 if plot.stacked else 1.7},
            "marker": {"color": colour},
            "hovertemplate": f"%{{y:.4~g}}{unit}",
            **({"stackgroup": "whole"} if plot.stacked else {}),
        }
        for curve, colour in zip(thinned, _colours(plot.curves), strict=True)
    ]
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": text(plot.x_label)}, "hoverformat": ".6~g"},
        "yaxis": {"title": {"text": text(plot.y_label)}, "rangemode": _range_mode(plot.curves)},
        "hovermode": "x unified",
    }
    captions = [THINNED] if is_thinned else []
    if plot.stacked and (cut := _peaks_to_cut(plot)):
        top, peak = cut
        layout["yaxis"]["range"] = [0, top]
        captions.append(f"Peaks of up to {show(peak)} lie above; Reset shows them.")
    return draw(Drawing(plot.title, _describe(plot), traces, layout, " ".join(captions)))


def table(frame: pd.DataFrame, caption: str = "") -> Markup:
    """Return a table; headers of several levels are grouped.

    Args:
        frame: cells are texts, numbers (shown with four digits), None or NaN (shown as a dash). An index
            that isn't just a count becomes the headers of the rows.
        caption: what the table shows.
    """
    texts = [[show(cell) for cell in row] for row in frame.itertuples(index=False, name=None)]
    named = not isinstance(frame.index, pd.RangeIndex)
    corner = ["" if name is None else name for name in frame.index.names] if named else []
    columns = _spans(frame.columns)
    headers = _spans(frame.index) if named else [[] for _ in texts]
    return _render(
        "table",
        levels=list(zip(*columns, strict=True)),
        corner=corner,
        rows=list(zip(headers, texts, strict=True)),
        numeric=[
            any(column) and all(map(_NUMBER.match, column)) for column in zip(*texts, strict=True)
        ],
        caption=caption,
    )


def figures(cards: Iterable[Card]) -> Markup:
    """Return headline figures, each with its unit, what it means, and whether less is better."""
    return _render("figures", cards=list(cards), show=show)


def warnings(title: str, sentences: Iterable[str]) -> Markup:
    """Return sentences that a reader must not miss; nothing if there are none."""
    return _notice("warnings", title, sentences)


def notes(title: str, sentences: Iterable[str]) -> Markup:
    """Return sentences that are good to know; nothing if there are none."""
    return _notice("notes", title, sentences)


def group(heading: str, sentence: str, *blocks: Markup) -> Markup:
    """Return blocks under a heading below that of a section."""
    return _render("group", heading=heading, sentence=sentence, blocks=blocks)


def fold(summary: str, *blocks: Markup) -> Markup:
    """Return blocks that open on a click."""
    return _render("fold", summary=summary, blocks=blocks)


def code(listing: str) -> Markup:
    """Return text as it is, in a box of its own."""
    return _render("code", listing=listing)


def show(value: Any) -> str:
    """Return a value for people: numbers with four digits, a dash for None and NaN."""
    if _missing(value):
        return _DASH
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, numbers.Integral):
        return f"{value:,}"
    if isinstance(value, numbers.Real):
        return _digits(float(value))
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(show(item) for item in value) + "]"
    return str(value)


def text(words: str) -> str:
    """Return words for a chart, whose library reads a little HTML."""
    return html.escape(words, quote=False)


def _notice(kind: str, title: str, sentences: Iterable[str]) -> Markup:
    sentences = list(sentences)
    return _render("notice", kind=kind, title=title, sentences=sentences) if sentences else Markup()


def _render(macro: str, **arguments: Any) -> Markup:
    module = ENVIRONMENT.get_template("blocks.html").module
    return Markup(getattr(module, macro)(**arguments))


def _spans(labels: pd.Index) -> list[list[tuple[str, int]]]:
    """Return for each label its text on each level, and how many labels it stands for.

    That is 0 where the label before has the same text there and above. Labels on the lowest level stand
    for themselves.
    """
    keys = [key if isinstance(key, tuple) else (key,) for key in labels]
    spans = [[(str(part), 1) for part in key] for key in keys]
    for level in range(labels.nlevels - 1):
        first = 0
        for _, same in groupby(keys, key=lambda key: key[: level + 1]):
            count = len(list(same))
            for i in range(first, first + count):
                spans[i][level] = (spans[i][level][0], count if i == first else 0)
            first += count
    return spans


def _legend(traces: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return name and colour of each trace that has a name; none if there is nothing to tell apart."""
    named = [trace for trace in traces if "name" in trace]
    if len(named) < 2:
        return []
    return [
        (html.unescape(t["name"]), t["line" if "line" in t else "marker"]["color"]) for t in named
    ]


def _thin_curves(plot: Plot) -> tuple[list[Curve], bool]:
    """Return curves with few enough samples to draw, and whether any were left out."""
    whole = np.sum([curve.y for curve in plot.curves], axis=0) if plot.stacked else None
    thinned = []
    for curve in plot.curves:
        kept = thin(np.asarray(curve.y if whole is None else whole, dtype=float))
        thinned.append(Curve(curve.name, np.asarray(curve.x)[kept], np.asarray(curve.y)[kept]))
    return thinned, any(
        len(few.x) < len(all_.x) for few, all_ in zip(thinned, plot.curves, strict=True)
    )


def _colours(curves: Sequence[Curve]) -> list[str]:
    """Return the colour of each curve: a fixed one for well-known names, the next one for others."""
    return [
        _NAMED.get(curve.name, f"--curve-{number % _CURVES}") for number, curve in enumerate(curves)
    ]


def _range_mode(curves: Iterable[Curve]) -> str:
    """Show zero where it doesn't hide the curves."""
    values = np.concatenate([np.asarray(curve.y, dtype=float) for curve in curves])
    values = values[np.isfinite(values)]
    near = values.size > 0 and values.min() >= 0 and values.min() < 0.7 * values.max()
    return "tozero" if near else "normal"


def _peaks_to_cut(plot: Plot) -> tuple[float, float] | None:
    """Return where the axis should end and the peak, if a few peaks would flatten all the rest."""
    whole = np.sum([np.nan_to_num(curve.y) for curve in plot.curves], axis=0)
    if len(whole) == 0:
        return None
    usual, peak = 1.3 * float(np.percentile(whole, 99)), float(whole.max())
    return (usual, peak) if peak > 3 * usual > 0 else None


def _describe(plot: Plot) -> str:
    """Say in words what the curves do."""
    words = [f"{plot.title}: {plot.y_label} over {plot.x_label}."]
    for curve in plot.curves:
        values = np.asarray(curve.y, dtype=float)
        values = values[np.isfinite(values)]
        extent = f"{show(values.min())} to {show(values.max())}" if values.size else "no values"
        words.append(f"{curve.name}: {extent}.")
    return " ".join(words)


def _unit(label: str) -> str:
    """Return the unit that a label ends with in brackets, after a space, or nothing."""
    return f" {label[:-1].rpartition('[')[2]}" if label.endswith("]") and "[" in label else ""


def _digits(value: float) -> str:
    if np.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value.is_integer() and abs(value) < 1e9:
        return f"{value:,.0f}"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.3e}"
    decimals = max(0, 3 - int(np.floor(np.log10(abs(value)))))
    return f"{value:,.{decimals}f}"


def _missing(value: Any) -> bool:
    return value is None or value is pd.NA or (isinstance(value, numbers.Real) and value != value)
