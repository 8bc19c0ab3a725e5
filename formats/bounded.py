"""Limits for what a file may claim: no size that it declares is believed, none may exhaust memory.

A file of some kilobytes can declare, or unpack to, any number of gigabytes. Sensor data shrink by a
factor of two to ten when they are compressed, so what grows by a hundred is no recording.
"""

import bz2
from collections.abc import Callable
from io import BytesIO

import zstandard
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

_ALWAYS = 1 << 25  # bytes that anything may unpack to, such as a chunk of black images
_RATIO = 100  # of plain to compressed bytes beyond that
_PLAIN = ("", "none")  # names for no compression


def most_plain(compressed: int) -> int:
    """Return how many bytes so many compressed ones may unpack to."""
    return _ALWAYS + _RATIO * compressed


def check_plausible(plain: int, compressed: int) -> None:
    """Check the size that compressed data declare.

    Raises:
        ValueError: no sensor data are compressed as much.
    """
    if plain > most_plain(compressed):
        raise ValueError(
            f"{compressed} compressed bytes claim to hold {plain}: that is damage, or made to harm"
        )


def inflate(data: bytes, compression: str, size: int | None = None) -> bytes:
    """Decompress as far as the data go, into `size` bytes at most.

    Args:
        data: bz2, or frames of lz4 or zstandard; its end may be missing.
        compression: ``bz2``, ``lz4``, ``zstd``, or ``none`` or nothing for plain data.
        size: bytes that the data declare to hold; without it, what is plausible.

    Raises:
        ValueError: the compression is unknown, the data are corrupt, the size isn't plausible, or
            there is more than declared.
    """
    if compression in _PLAIN:
        return data
    if compression not in _INFLATERS:
        raise ValueError(f"{compression!r} is no known compression")
    if size is not None:
        check_plausible(size, len(data))
    most = most_plain(len(data)) if size is None else size
    try:
        plain = _INFLATERS[compression](data, most + 1)
    except (OSError, RuntimeError, EOFError, zstandard.ZstdError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    if len(plain) > most:
        raise ValueError(f"{len(data)} compressed bytes hold more than {most}: damaged")
    return plain


class Inflater:
    """Decompresses the chunks of one file, all together into no more than it can plausibly hold."""

    def __init__(self, size: int) -> None:
        """Take the size of the file in bytes."""
        self._left = most_plain(size)

    def __call__(self, data: bytes, compression: str, size: int) -> bytes:
        """Decompress as `inflate` does.

        Raises:
            ValueError: as there, or the chunks before left no room.
        """
        if compression in _PLAIN:
            return data
        if size > self._left:
            raise ValueError("the chunks before hold as much as the file plausibly can")
        self._left -= size
        return inflate(data, compression, size)


def _inflate_bz2(data: bytes, most: int) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, most)


def _inflate_lz4(data: bytes, most: int) -> bytes:
    return bytes(LZ4FrameDecompressor().decompress(data, max_length=most))


def _inflate_zstd(data: bytes, most: int) -> bytes:
    with zstandard.ZstdDecompressor().stream_reader(
        BytesIO(data), read_across_frames=True
    ) as stream:
        return bytes(stream.read(most))


_INFLATERS: dict[str, Callable[[bytes, int], bytes]] = {
    "bz2": _inflate_bz2,
    "lz4": _inflate_lz4,
    "zstd": _inflate_zstd,
}
