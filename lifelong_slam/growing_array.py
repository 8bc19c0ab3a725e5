"""Arrays that grow for as long as a run goes."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

_ROOM = 1024  # rows to begin with; it is doubled when they have come


class GrowingArray:
    """Rows of a kind, kept in one block that they are appended to.

    What a run leaves behind for ever is kept like this: a small array for each scan, among all that a scan
    takes for a moment, would keep a page of memory each from being given back.
    """

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Start without rows.

        Args:
            shape: of one row.
            dtype: of its elements.
        """
        self._room: NDArray[Any] = np.empty((_ROOM, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray[Any]:
        """(N, *shape) view of all rows so far."""
        return self._room[: self._count]

    def append(self, row: ArrayLike) -> None:
        """Add a row."""
        self.extend(np.asarray(row)[None])

    def extend(self, rows: NDArray[Any]) -> None:
        """Add (M, *shape) rows."""
        count = self._count + len(rows)
        if count > len(self._room):
            room = np.empty((2 * count, *self._room.shape[1:]), self._room.dtype)
            room[: self._count] = self.rows
            self._room = room
        self._room[self._count : count] = rows
        self._count = count
