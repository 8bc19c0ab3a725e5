"""The one family of errors that evaluation raises on purpose, each with one line of text."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_LONGEST = 200  # characters of a parser's words, which may quote the file


class EvalError(Exception):
    """Base class of all errors raised on purpose by eval."""


class FileError(EvalError):
    """A file to be judged is missing, unreadable or not what its name says."""


class AssociationError(EvalError):
    """Estimate and reference have too little in common to be compared."""


class AlignmentError(EvalError):
    """The alignment asked for is unknown or has no solution."""


class EvidenceError(EvalError):
    """The evidence lacks what a metric asks of it."""


class MetricError(EvalError):
    """A metric can't be made from its settings, or breaks the contract of `eval.metrics.metric`."""


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a parser raises into a FileError that names the file.

    Damaged files break their parsers in any way: each has its own errors, and those of Python for
    numbers too large and brackets too deep.

    Args:
        path: of the file.
        what: it should be, such as ``LAS file``.
    """
    try:
        yield
    except FileError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename:
            raise  # it isn't the content
        reason = " ".join(str(error).split())[:_LONGEST] or type(error).__name__
        raise FileError(f"{path} is not a whole {what}: {reason}") from error
