"""What the commands share: where configs are, which errors are the user's to mend, exit statuses."""

import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from console import fail
from eval.errors import EvalError
from lifelong_slam.errors import LifelongSlamError

CONF = Path(__file__).resolve().parent.parent / "conf"
KNOWN_ERRORS = (LifelongSlamError, EvalError, HydraException, OmegaConfBaseException, OSError)
INCOMPLETE, BAD_INPUT, DOUBTFUL, INTERRUPTED = 1, 2, 3, 130


def run_command(
    work: Callable[[Sequence[str]], None],
    arguments: Sequence[str] | None,
    usage: str | None,
    when_stopped: str,
    level: int = logging.INFO,
) -> int:
    """Do a command's work, turn whatever went wrong into one line, and return the exit status.

    Args:
        work: takes the arguments.
        arguments: those of the process if None.
        usage: printed instead if they ask for help.
        when_stopped: said when Ctrl-C ends the work.
        level: from which on messages are shown.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & {*arguments}:
        print(usage)
        return 0
    logging.basicConfig(level=level, format="%(message)s", stream=sys.stderr)
    try:
        work(arguments)
    except KNOWN_ERRORS as error:
        fail(error)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(when_stopped, file=sys.stderr)
        return INTERRUPTED
    return 0


def plain(config: DictConfig) -> dict[str, Any]:
    """Return a config as dictionaries, lists and values."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
