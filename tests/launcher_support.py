"""Sources for jobs that a launcher runs in processes of its own."""

import os
import time
from pathlib import Path

from run_support import ListSource, scans

PATIENCE = 120.0  # seconds


class MeetingSource(ListSource):
    """Yields scans once as many processes as it is told have asked for theirs."""

    def __init__(self, count: int, processes: int, folder: str):
        super().__init__(scans(count)[:count])
        self.processes = processes
        self.folder = Path(folder)

    def __iter__(self):
        (self.folder / str(os.getpid())).touch()
        end = time.monotonic() + PATIENCE
        while len(list(self.folder.iterdir())) < self.processes:
            if time.monotonic() > end:
                raise OSError("the other jobs don't run at the same time in other processes")
            time.sleep(0.05)
        yield from self.scans
