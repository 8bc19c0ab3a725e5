"""Reads the standard files that SLAM systems leave behind, and writes the verdict."""

import csv
import json
import math
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from eval.errors import FileError, readable
from eval.text_table import is_number

Timeline = dict[str, NDArray[np.float64]]

_AXES = {"VERTEX_SE3:QUAT": 3, "VERTEX_SE2": 2}  # coordinates of a vertex's position
_FORMULA = ("=", "+", "-", "@")
_CONTROL = re.compile(r"[\x00-\x1f]+")  # line breaks and tabs among them
_KINDS = ("odometry", "loop", "composed")
_DEEPEST = 50  # levels of YAML
_MOST_GROWTH = 10_000  # by which interpolations may multiply a text


@dataclass(frozen=True, slots=True)
class GraphSketch:
    """What a picture or a count needs of a pose graph.

    Attributes:
        positions: (V, 3) positions of the vertices in metres.
        edges: (E, 2) indices into `positions`.
        is_loop: (E,) whether an edge closes a loop.
        is_composed: (E,) whether it is made of several measurements, loop closures among them.
    """

    positions: NDArray[np.float64]
    edges: NDArray[np.int64]
    is_loop: NDArray[np.bool_]
    is_composed: NDArray[np.bool_]


def read_graph(path: Path) -> GraphSketch:
    """Read vertices and edges of a g2o file, SE(3) or SE(2); FIX lines and priors are skipped.

    Comments ``# odometry``, ``# loop`` and ``# composed`` name the kind of edges: on a line of their own
    of those after it, at the end of an edge's line of that edge. Without them, an edge between vertices
    that follow each other by id counts as odometry and any other as a loop closure.

    Raises:
        FileError: the file is missing, or a line is malformed.
    """
    _require(path, "pose graph")
    positions: dict[int, list[float]] = {}
    edges: list[tuple[int, int, str]] = []
    kind = ""
    with readable(path, "pose graph"):
        lines = path.read_text().splitlines()
    for number, line in enumerate(lines, 1):
        content, _, comment = line.partition("#")
        tag, *fields = content.split() or [""]
        named = comment.strip() if comment.strip() in _KINDS else kind
        try:
            if tag in _AXES:
                place = [float(field) for field in fields[1 : 1 + _AXES[tag]]]
                positions[int(fields[0])] = [*place, 0.0][:3]
            elif tag in ("EDGE_SE3:QUAT", "EDGE_SE2"):
                edges.append((int(fields[0]), int(fields[1]), named))
            elif not tag:
                kind = named
        except (ValueError, IndexError) as error:
            raise FileError(f"{path}, line {number}: not a valid {tag}") from error
    return _sketch(path, positions, edges)


def read_timeline(path: Path) -> Timeline:
    """Read a CSV file of numbers into one (N,) array a column.

    Raises:
        FileError: the file is missing, has no header, or a cell is not a number.
    """
    _require(path, "timeline")
    with readable(path, "table of numbers"), path.open(newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
        values = np.array([[float(cell) for cell in row] for row in rows])
        values = values.reshape(len(rows), len(header))
    return {name: values[:, i] for i, name in enumerate(header)}


def plain_cell(value: Any) -> Any:
    """Return a cell for a CSV file that no spreadsheet takes for a formula, and no reader for two rows.

    Text that begins as a formula does gets a quote in front, as OWASP recommends; numbers stay as they are.
    """
    if not isinstance(value, str):
        return value
    text = _CONTROL.sub(" ", value).strip()
    if not text.startswith(_FORMULA) or is_number(text):
        return text
    return f"'{text}"


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        FileError: the file is missing, no JSON, or something else than an object.
    """
    _require(path, "JSON")
    with readable(path, "JSON file"):
        value = json.loads(path.read_text())
        if not isinstance(value, dict):
            raise ValueError("it holds no object")
        return value


def read_yaml_text(path: Path) -> str:
    """Read the text of a YAML file that has no aliases, by which a few lines can hold millions of items.

    Nor is it nested deeper than any settings are, which would be more than a parser can take, or refers
    to itself by interpolations (``${a}${a}``) that multiply.

    Raises:
        FileError: the file is missing, no YAML, or has either.
    """
    _require(path, "YAML")
    with readable(path, "YAML file"):
        text = path.read_text()
        depth, growth = 0, 1
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("it has aliases, which no settings need")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.ScalarEvent):
                growth *= max(event.value.count("${"), 1)
            if growth > _MOST_GROWTH:
                raise ValueError("it has interpolations that multiply")
            if depth > _DEEPEST:
                raise ValueError(f"it is nested deeper than {_DEEPEST} levels")
        return text


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON (NaN and infinity become null), replacing the file as a whole."""
    text = json.dumps(_strict(value), indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it replaces `path` on success, goes on failure.

    Raises:
        OSError: it can't be written; the error names it.
    """
    with _naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent
        )
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Have errors name a file, where they name none, as when the disk is full, or the temporary one."""
    try:
        yield
    except OSError as error:
        if error.filename is None or Path(error.filename).name.startswith(f".{path.stem}-"):
            error.filename = str(path)
        raise


def _strict(value: Any) -> Any:
    """Turn NumPy's scalars and arrays, paths and non-finite numbers into what JSON can say."""
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple | set):
        return [_strict(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value if value is None else str(value)


def _sketch(
    path: Path, positions: dict[int, list[float]], edges: list[tuple[int, int, str]]
) -> GraphSketch:
    ids = sorted(positions)
    index = {vertex: i for i, vertex in enumerate(ids)}
    unknown = {v for source, target, _ in edges for v in (source, target)} - index.keys()
    if unknown:
        raise FileError(f"{path}: edges refer to {len(unknown)} vertices that are not there")
    pairs = np.array([(index[s], index[t]) for s, t, _ in edges], dtype=np.int64).reshape(-1, 2)
    named = np.array([kind for *_, kind in edges], dtype="U8")
    is_loop = np.where(named == "", np.abs(pairs[:, 1] - pairs[:, 0]) != 1, named == "loop")
    points = np.array([positions[i] for i in ids], dtype=np.float64).reshape(-1, 3)
    return GraphSketch(points, pairs, is_loop, named == "composed")


def _require(path: Path, what: str) -> None:
    if not path.is_file():
        raise FileError(f"no such {what} file: {path}")
