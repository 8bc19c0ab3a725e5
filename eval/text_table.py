"""Reads the tables of numbers that trajectories and relations come as."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eval.errors import FileError, readable

Array = NDArray[np.float64]

LARGEST = 1e20  # of what can be measured: nanoseconds since 1970 are 1e18


def read_table(
    path: Path,
    kind: str,
    columns: int,
    delimiter: str | None = None,
    chosen: Sequence[int] | None = None,
) -> Array:
    """Read rows of numbers, all of them finite; `#` starts a comment, one heading may come first.

    Args:
        path: a text file.
        kind: what the file should be, for messages.
        columns: how many there are; with a delimiter, how many to read of maybe more.
        delimiter: between columns; without one, white space.
        chosen: which columns to read, in this order, with a delimiter; None takes the first ones.

    Returns:
        (N, columns) numbers, or as many as are chosen; at least one row.

    Raises:
        FileError: the file is missing, empty or malformed, or holds NaN.
    """
    skip, row = first_row(path, kind)
    found = len(row.split(delimiter))
    if found < columns or (delimiter is None and found > columns):
        raise FileError(f"{path} is not a {kind}: {found} columns instead of {columns}")
    with readable(path, kind):
        rows = np.loadtxt(
            path,
            delimiter=delimiter,
            skiprows=skip,
            usecols=(chosen or range(columns)) if delimiter else None,
            ndmin=2,
            encoding="utf-8-sig",
        )
    check_finite(str(path), rows)
    return rows


def first_row(path: Path, kind: str) -> tuple[int, str]:
    """Return how many lines of comments and headings come first, and the row of numbers after them.

    Raises:
        FileError: the file is missing or empty, or is not text.
    """
    if not path.is_file():
        raise FileError(f"no such {kind}: {path}")
    heading = False
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file):
                row = line.strip()
                if not row or row.startswith("#"):
                    continue
                if heading or any(map(is_number, row.replace(",", " ").split())):
                    return number, row
                heading = True
    except UnicodeDecodeError as error:
        raise FileError(f"{path} is not a {kind}: it is not text") from error
    raise FileError(f"{path} is not a {kind}: it holds no numbers")


def heading_of(path: Path, rows: int) -> str:
    """Return the last line that isn't empty of so many at the start of a file, or nothing."""
    with path.open(encoding="utf-8-sig") as file:
        lines = [line.strip() for line in islice(file, rows)]
    return next((line for line in reversed(lines) if line), "")


def check_finite(where: str, rows: Array) -> None:
    """Raise FileError if (N, K) rows hold NaN, infinity or numbers above `LARGEST`."""
    bad = ~(np.abs(rows) <= LARGEST).all(axis=1)
    if bad.any():
        raise FileError(
            f"{where}: {int(bad.sum())} of {len(rows)} rows hold NaN or infinity, or numbers above"
            f" {LARGEST:g},"
            f" first row {int(np.argmax(bad)) + 1}"
        )


def is_number(text: str) -> bool:
    """Tell whether a text is a number as Python reads one."""
    try:
        float(text)
    except ValueError:
        return False
    return True
