"""The facts that make a run repeatable: versions, commit, machine, seed, command line."""

import os
import platform
import random
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from lifelong_slam.errors import ConfigError

PACKAGES = (
    "lifelong-slam",
    "evo",
    "gtsam",
    "hydra-core",
    "kiss-icp",
    "kiss-slam",
    "map-closures",
    "numpy",
    "open3d",
    "rosbags",
    "scipy",
    "small-gicp",
)


def describe_run(overrides: Sequence[str], seed: int) -> dict[str, Any]:
    """Return what to keep with a run's results; no host, user or folder names."""
    return {
        "command_line": [_without_folders(override) for override in overrides],
        "seed": seed,
        "git_commit": git_commit(Path(__file__).parent),
        "python": platform.python_version(),
        "packages": {name: version for name in PACKAGES if (version := _version(name))},
        "machine": {
            "system": f"{platform.system()} {platform.machine()}",
            "cpu": _cpu_model(),
            "cores": os.cpu_count(),
            "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        },
    }


def seed_everything(seed: int) -> None:
    """Seed the generators that this package and those it calls draw from.

    Raises:
        ConfigError: the seed isn't one that they all take.
    """
    if not 0 <= seed < 2**31:
        raise ConfigError(f"seed must lie between 0 and {2**31 - 1}, not {seed}")
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - others' code may use the global generator
    import open3d

    open3d.utility.random.seed(seed)


def git_commit(folder: Path) -> str | None:
    """Return the commit checked out in a folder, with `+` where files differ; None without git."""
    try:
        _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)  # ours, not a stranger's
        commit = _git(folder, "rev-parse", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}{'+' if changed else ''}"


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if sys.platform == "linux" and cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _without_folders(override: str) -> str:
    """Keep the file name of a path, and leave out where it lies."""
    key, equals, value = override.partition("=")
    is_path = "/" in value and not key.endswith("topic")
    return f"{key}{equals}{Path(value.strip(chr(34) + chr(39))).name}" if is_path else override
