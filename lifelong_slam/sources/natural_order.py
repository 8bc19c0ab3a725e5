"""File names in the order that people expect."""

import re
from pathlib import Path


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that puts ``scan2`` before ``scan10``."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]
