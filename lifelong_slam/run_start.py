"""Makes a run folder one run's own: its config and its results, and nothing of another run beside them."""

import fcntl
import logging
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from lifelong_slam.errors import ConfigError
from lifelong_slam.files import atomic_write
from lifelong_slam.run_folder import (
    MAP,
    MAP_BAG,
    POSE_GRAPH,
    REFERENCE,
    REFERENCE_MAP,
    TIMELINE,
    TRAJECTORY,
    TRAJECTORY_BAG,
    link_reference_map,
)

_log = logging.getLogger(__name__)

CONFIG = ".hydra"
PREVIOUS = ".previous"
_RESULTS = (  # metrics.json first, without which no run counts as whole
    *("metrics.json", "report.html", "plots", "evo_ape.zip", TRAJECTORY, TRAJECTORY_BAG, REFERENCE),
    *(MAP, MAP_BAG, REFERENCE_MAP, POSE_GRAPH, TIMELINE),
)
_TEMPORARY = re.compile(  # as `lifelong_slam.files` and `eval.files` name them
    "|".join(rf"\.{Path(n).stem}-\w{{8}}{re.escape(Path(n).suffix)}" for n in _RESULTS)
)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder; the lock ends with the process, however that ends.

    Raises:
        ConfigError: another run is in it.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ConfigError(
            f"another run is at work in {folder}: choose a folder by hydra.run.dir=F"
        ) from error


def set_results_aside(folder: Path) -> None:
    """Move what an earlier run left to a folder of its own in this one, which has been claimed.

    Only the latest is kept. What a killed run left half-written goes, as does a config without results.
    """
    for path in folder.iterdir():
        if _TEMPORARY.fullmatch(path.name):
            path.unlink()
    found = [path for name in _RESULTS if os.path.lexists(path := folder / name)]
    aside = folder / f"{PREVIOUS}-new"  # where there is one, a run was killed as it did this
    if not found and not aside.exists():
        shutil.rmtree(folder / CONFIG, ignore_errors=True)
        return
    aside.mkdir(exist_ok=True)
    for path in [*found, folder / CONFIG]:
        _move(path, aside / path.name)
    shutil.rmtree(folder / PREVIOUS, ignore_errors=True)
    aside.rename(folder / PREVIOUS)
    _log.warning("%s had results of an earlier run: they are in %s now", folder, PREVIOUS)


def _move(path: Path, target: Path) -> None:
    """Move a file or folder, if it is there; a link still leads where it did."""
    if path.is_symlink():
        link_reference_map(target.parent, path)
        path.unlink()
    elif path.exists():
        path.rename(target)


def write_config(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the configs of a run by name, to where Hydra would.

    Hydra does so at once, while another run may be at work in the folder.
    """
    for name, text in texts.items():
        with atomic_write(folder / CONFIG / name) as file:
            file.write(text.encode())
