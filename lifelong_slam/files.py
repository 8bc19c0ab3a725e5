"""Atomic files: a crash leaves either the old file or the whole new one."""

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_path(path: Path, exclusive: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it becomes `path` on success, goes on failure.

    Args:
        path: replaced if it is there.
        exclusive: don't replace it.

    Raises:
        FileExistsError: it is there, and mustn't be replaced.
        OSError: it can't be written; the error names it.
    """
    with _naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent
        )
        os.close(handle)
        temporary = Path(name)
        temporary.unlink()  # some writers refuse a file that exists
        try:
            yield temporary
            if exclusive:
                _rename_to_new(temporary, path)
            else:
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


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing bytes that replaces `path` only once it is complete and on disk."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def write_what_fits(writers: Iterable[Callable[[], object]]) -> list[OSError]:
    """Call each of several writers; return the errors of those that can't, as when the disk is full."""
    errors = []
    for write in writers:
        try:
            write()
        except OSError as error:
            errors.append(error)
    return errors


def set_aside(path: Path) -> Path:
    """Rename a file to the first of NAME.1, NAME.2 and so on that is free, and return that."""
    names = (path.with_name(f"{path.name}.{number}") for number in count(1))
    return path.rename(next(name for name in names if not name.exists()))


def _rename_to_new(source: Path, target: Path) -> None:
    """Rename a file where no other may be; of several processes that do so one succeeds."""
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError as error:  # no hard links here, as on exFAT: nothing keeps others out
        if target.exists():
            raise FileExistsError(f"{target} is there already") from error
        source.rename(target)
