"""The files of a bag: which ones are its parts, and what else lies beside them."""

import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.natural_order import natural_order
from lifelong_slam.sources.unfinished_db3 import is_unfinished

_log = logging.getLogger(__name__)

_KINDS = ((".bag", ".bag.active"), (".mcap",), (".db3",))
_METADATA = "metadata.yaml"
_BAG_NAME = re.compile(r"(?P<series>.+?)(_\d+)?\.(bag|mcap|db3)(?P<rest>\.\w+)*")


def bag_paths(path: Path) -> list[Path]:
    """Return what a reader is given: one file, a ROS 2 folder, or the parts of a bag.

    Parts that a folder's metadata.yaml doesn't list, as a killed recorder leaves them, are among
    them. Other bag files in a folder are named in a warning. Files that are unfinished come as such.

    Raises:
        SourceError: there is no such path, or no bag in it.
    """
    if not path.exists():
        raise SourceError(f"no such file or folder: {path}")
    if path.is_file():
        if path.stat().st_size == 0:
            raise SourceError(f"{path} is empty (0 bytes): there is no recording in it")
        return [path]
    if (path / _METADATA).is_file():
        return _of_folder(path)
    if parts := _parts(path):
        _log_left_out(path, [part.name for part in parts])
        return parts
    raise SourceError(f"{path} holds no bag: expected *.bag, *.mcap, or metadata.yaml with *.db3")


def storage_files(paths: Iterable[Path]) -> list[Path]:
    """Return the files that hold messages: those of a folder, or the paths themselves."""
    files = []
    for path in paths:
        files += _parts(path) if path.is_dir() else [path]
    return files


def _of_folder(folder: Path) -> list[Path]:
    """Return the folder itself; or its files, where some belong to it unlisted or are unfinished."""
    listed, compressed = _listed(folder)
    if not listed or not all((folder / name).is_file() for name in listed):
        return [folder]  # all parts are read as those of a damaged recording
    series = {_series(name) for name in listed}
    own = [p for p in _parts(folder) if p.name in listed or _series(p.name) in series]
    unlisted = [part.name for part in own if part.name not in listed]
    if compressed or not (unlisted or any(map(is_unfinished, own))):
        _log_left_out(folder, listed)
        return [folder]
    if unlisted:
        _log.warning("%s: %s read as well, not in %s", folder, ", ".join(unlisted), _METADATA)
    _log_left_out(folder, [part.name for part in own])
    return own


def _listed(folder: Path) -> tuple[list[str], bool]:
    """Return the files that a folder's metadata lists, and whether they are compressed."""
    try:
        content: Any = yaml.safe_load((folder / _METADATA).read_text())
        information = content["rosbag2_bagfile_information"]
        names = [Path(name).name for name in information["relative_file_paths"]]
        mode = str(information.get("compression_mode") or "none").lower()
    except Exception as error:  # damaged metadata are reported by the reader
        _log.debug("%s: %s", folder / _METADATA, error)
        return [], False
    return names, mode != "none"


def _log_left_out(folder: Path, read: Iterable[str]) -> None:
    """Warn of the bag files in a folder, compressed ones as well, that aren't read."""
    names = {file.name for file in folder.iterdir() if file.is_file()} - set(read)
    if left := sorted(name for name in names if _BAG_NAME.fullmatch(name)):
        _log.warning(
            "%s: not read: %s (of another recording or format, or compressed: unpack it)",
            *(folder, ", ".join(left)),
        )


def _parts(folder: Path) -> list[Path]:
    """Return the bag files in a folder, of the first kind that is there.

    A ROS 1 recorder that was killed leaves its last part as ``.bag.active``.
    """
    files = sorted((file for file in folder.iterdir() if file.is_file()), key=natural_order)
    kinds = ([file for file in files if file.name.endswith(kind)] for kind in _KINDS)
    return next((parts for parts in kinds if parts), [])


def _series(name: str) -> str:
    """Return a bag file's name without its number and what follows."""
    match = _BAG_NAME.fullmatch(name)
    return match["series"] if match else name
