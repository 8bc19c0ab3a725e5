"""The one family of errors that this package raises on purpose.

Each message is one line that says what was wrong and what would be right; scripts print it and exit
with a non-zero status. Anything else that escapes is a bug.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class LifelongSlamError(Exception):
    """Base class of all errors raised on purpose by lifelong_slam."""


class ConfigError(LifelongSlamError):
    """A configuration names an unknown key or holds a value of the wrong kind."""


class SourceError(LifelongSlamError):
    """A source of scans is missing, unreadable or of the wrong type."""


class TopicError(SourceError):
    """A recording lacks the topic asked for, or the topic has the wrong message type."""


class MapError(LifelongSlamError):
    """A saved map is missing, damaged, in use, of another kind, or doesn't hold what is asked for."""


class IncompleteError(LifelongSlamError):
    """A run came to its end, but not all that it leaves behind could be written."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `` Did you mean 'x'?`` for the known name nearest to `name`, or an empty string."""
    close = get_close_matches(name, sorted(known), n=1)
    return f" Did you mean '{close[0]}'?" if close else ""
