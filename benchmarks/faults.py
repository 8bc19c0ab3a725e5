"""What is lost, and what escapes, when processes are killed, disks are full and files are damaged?

- *Kills.* Writers of a map, and whole runs with ``map=``, are killed (SIGKILL) at random moments. Lost is a
  keyframe that was reported as written and isn't in the map afterwards.
- *Torn writes.* The log of a map that was being written is cut anywhere, or ends in garbage, as after a
  loss of power. Transactions at the end may be missing, those before may not.
- *Full disks.* Writers and runs on a file system of some hundred kilobytes (a tmpfs of its own; needs
  ``unshare`` to be allowed).
- *Mutated files.* See benchmarks/fuzzing.py.

Escaped is a map that `check` finds fault with, a traceback, an abort, more than 2 s of processor time
or more than 500 MB for a small file. Exit status: 0 nothing lost or escaped; 1 something did, listed in
a line each.

    python benchmarks/faults.py [--minutes 4] [--seed 0] [--json faults.json]
"""

import argparse
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from fuzzing import FORMATS, fuzz, keyframe, new_map
from throughput import markdown

from eval.errors import EvalError
from eval.files import read_json, write_json
from lifelong_slam.errors import LifelongSlamError
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.provenance import describe_run

ROOT = Path(__file__).resolve().parents[1]
SHARES = {"kills": 0.15, "runs": 0.25, "torn": 0.05, "full": 0.15, "fuzz": 0.4}  # of the time
_SESSION = 8  # keyframes
_MOST_KEYFRAMES = 200  # of a map, or else each check takes longer
_HEADER, _LONG_LOG = 32, 300_000  # bytes of an SQLite log, the latter with some keyframes in it
_LINE = "error: "


@dataclass
class Faults:
    """Tries of one kind of fault.

    Attributes:
        name: of the fault.
        tries: how often it was made.
        what: became of it, by a word for it.
        lost: keyframes or files that had been written.
        escaped: a line for each that was not handled.
    """

    name: str
    tries: int = 0
    what: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    escaped: list[str] = field(default_factory=list)

    def count(self, word: str) -> None:
        """Note what became of a try."""
        self.what[word] = self.what.get(word, 0) + 1


# --- kills of a writer, and what is left of its log


def write_map(path: Path, pipe: int | None = None) -> None:
    """Write short sessions to a map without an end, and to a pipe a byte for each keyframe written."""
    if not path.exists():
        new_map(path).close()
    while True:
        with MapStore.open(path) as store:
            first = store.load().next_keyframe
            session = store.begin_session("short", "")
            for i in range(first, first + _SESSION):
                store.write(keyframe(session, i, 1000, first))
                if pipe is not None:
                    os.write(pipe, b".")
            store.end_session(session)


def killed_writer(path: Path, seconds: float, faults: Faults) -> int:
    """Kill a writer after a while; return how many keyframes it said to have written."""
    ours, theirs = os.pipe()
    child = multiprocessing.get_context("fork").Process(target=write_map, args=(path, theirs))
    child.start()
    os.close(theirs)
    time.sleep(seconds)
    child.kill()
    child.join()
    if child.exitcode != -signal.SIGKILL:
        faults.escaped.append(f"{faults.name}: it ended by itself with {child.exitcode}")
    with os.fdopen(ours, "rb") as pipe:
        return len(pipe.read())


def kills(folder: Path, seconds: float, rng: random.Random) -> list[Faults]:
    """Kill the writers of a map again and again, and begin another one now and then."""
    faults = Faults("a map's writer is killed", what={"keyframes written": 0, "maps": 0})
    total = _MOST_KEYFRAMES
    for _ in tries(seconds):
        if total >= _MOST_KEYFRAMES:
            faults.count("maps")
            path, total = folder / str(faults.what["maps"]) / "place.map", 0
            path.parent.mkdir()
        faults.tries += 1
        written = killed_writer(path, rng.uniform(0.01, 0.6), faults)
        faults.what["keyframes written"] += written
        there = keyframes_of(path, faults) if path.exists() else 0
        faults.lost += max(0, total + written - there)
        total = there
    return [faults]


def torn(folder: Path, seconds: float, rng: random.Random) -> list[Faults]:
    """Cut the log of a killed writer, or let it end in garbage."""
    faults, path = Faults("the log of a killed map is torn"), folder / "place.map"
    log = path.with_name("place.map-wal")
    while not log.exists() or log.stat().st_size < _LONG_LOG:
        killed_writer(path, 1.0, faults)
    whole, sound = path.read_bytes(), log.read_bytes()
    before = _restored(path, whole, None, faults)
    for _ in tries(seconds):
        kept = sound[: rng.randrange(_HEADER, len(sound))]
        there = _restored(path, whole, kept + rng.randbytes(rng.choice((0, 0, 100, 5000))), faults)
        faults.tries += 1
        faults.lost += max(0, before - there)
        faults.count("with keyframes of the log" if there > before else "without")
    return [faults]


def _restored(path: Path, content: bytes, log: bytes | None, faults: Faults) -> int:
    """Return how many keyframes a map of this content has, with a log beside it or without one."""
    for file in path.parent.glob("place.map*"):
        file.unlink()
    path.write_bytes(content)
    if log is not None:
        path.with_name("place.map-wal").write_bytes(log)
    return keyframes_of(path, faults)


def keyframes_of(path: Path, faults: Faults) -> int:
    """Return how many keyframes a map has; what is wrong with it has escaped."""
    try:
        problems = check_map(path)
        with MapStore.open(path, read_only=True) as store:
            count = store.load().next_keyframe
    except LifelongSlamError as error:
        faults.escaped.append(f"{faults.name}: {error}")
        return 0
    faults.escaped += [f"{faults.name}: {problem}" for problem in problems[:1]]
    return count


# --- runs


def run_command(folder: Path) -> list[str]:
    """Return the command line of a small run with a map file."""
    return [
        *(
            sys.executable,
            str(ROOT / "scripts" / "run.py"),
            "scenario=folder",
            "sensor=solid_state",
        ),
        *(f"scenario.path={folder / 'scans'}", f"map={folder / 'disk' / 'place.map'}"),
        f"hydra.run.dir={folder / 'disk' / 'run'}",
    ]


def write_scans(folder: Path) -> None:
    """Write scans of a room, from a sensor that moves along it."""
    rng, scans = np.random.default_rng(0), folder / "scans"
    scans.mkdir()
    walls = rng.uniform(-1, 1, (20_000, 3)) * [20, 8, 2]
    walls[:10_000, 1] = np.sign(walls[:10_000, 1]) * 8
    walls[10_000:, 0] = np.sign(walls[10_000:, 0]) * 20
    for i in range(40):
        points = np.pad(walls - [0.15 * i, 0, 0], ((0, 0), (0, 1)))
        points.astype("<f4").tofile(scans / f"{i:03}.bin")


def killed_runs(folder: Path, seconds: float, rng: random.Random) -> list[Faults]:
    """Kill runs that go on in one map; a run folder has whole files only."""
    faults = Faults("a run with map= is killed")
    write_scans(folder)
    longest = 0.0
    for _ in tries(seconds):
        shutil.rmtree(folder / "disk" / "run", ignore_errors=True)
        faults.tries += 1
        started = time.monotonic()
        process = subprocess.Popen(
            run_command(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            process.wait(rng.uniform(0.2, 1.0) * longest if longest else None)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        longest = longest or time.monotonic() - started  # the first may end
        faults.count("killed" if process.returncode == -signal.SIGKILL else "ended")
        if (folder / "disk" / "place.map").exists():
            keyframes_of(folder / "disk" / "place.map", faults)
        check_run_folder(folder / "disk" / "run", faults)
    return [faults]


def check_run_folder(run: Path, faults: Faults) -> None:
    """Check that whatever is in a run folder is whole."""
    try:
        if (run / "metrics.json").exists():
            read_json(run / "metrics.json")
            faults.count("with metrics.json")
    except EvalError as error:
        faults.escaped.append(f"{faults.name}: {error}")
    for file in run.glob("*.tum"):
        if not file.read_text().endswith("\n"):
            faults.escaped.append(f"{faults.name}: {file} is cut")


# --- full disks


def full(folder: Path, seconds: float, rng: random.Random) -> list[Faults]:
    """Let writers and runs come to the end of a disk."""
    writers, runs = Faults("disk full: a map's writer"), Faults("disk full: a run with map=")
    write_scans(folder)
    for _ in tries(seconds / 2):
        command = [sys.executable, __file__, "--write-map", str(folder / "disk" / "place.map")]
        fill_disk(folder, rng.randint(100, 2000), command, writers)
    for _ in tries(seconds / 2):
        fill_disk(folder, rng.randint(60, 1000), run_command(folder), runs)
    return [writers, runs]


def fill_disk(folder: Path, kilobytes: int, command: list[str], faults: Faults) -> None:
    """Run a command whose folder `disk` is a file system of so many kilobytes, and keep what is there."""
    disk, kept = folder / "disk", folder / "kept"
    disk.mkdir(exist_ok=True)
    shutil.rmtree(kept, ignore_errors=True)
    script = 'mount -t tmpfs -o "size=$1k" tmpfs "$2" || exit 99; d=$2; k=$3; shift 3; "$@"; s=$?;'
    script += ' cp -r "$d" "$k"; exit $s'
    outcome = subprocess.run(
        [
            "unshare",
            "-rm",
            "sh",
            "-c",
            script,
            "sh",
            str(kilobytes),
            str(disk),
            str(kept),
            *command,
        ],
        capture_output=True,
        text=True,
        errors="replace",
    )
    if outcome.returncode == 99:
        faults.what["no tmpfs can be mounted here"] = 1
        return
    faults.tries += 1
    said = outcome.stderr.strip().splitlines() or [""]
    faults.count(f"exit status {outcome.returncode}")
    if outcome.returncode and ("Traceback" in outcome.stderr or not said[-1].startswith(_LINE)):
        faults.escaped.append(f"{faults.name}, {kilobytes} kB: {said[-1]}")
    if (kept / "place.map").exists():
        keyframes_of(kept / "place.map", faults)


# --- all of them


def tries(seconds: float) -> Iterator[int]:
    """Count while there is time, once at least."""
    until, number = time.monotonic() + seconds, 0
    while number == 0 or time.monotonic() < until:
        yield number
        number += 1


def mutated(_: Path, seconds: float, rng: random.Random) -> list[Faults]:
    """Read mutated files of each format."""
    found = []
    for form in FORMATS:
        outcome = fuzz(form, seconds / len(FORMATS), rng.randrange(2**32))
        counts = dict(sorted(outcome.counts.items()))
        found.append(
            Faults(f"mutated: {form.name}", sum(counts.values()), counts, 0, outcome.escaped)
        )
    return found


PARTS: dict[str, Callable[[Path, float, random.Random], list[Faults]]] = {
    "kills": kills,
    "runs": killed_runs,
    "torn": torn,
    "full": full,
    "fuzz": mutated,
}


def measure(minutes: float, seed: int, parts: list[str]) -> list[Faults]:
    """Make all faults for their share of the time."""
    whole = sum(SHARES[part] for part in parts)
    found = []
    for part in parts:
        with tempfile.TemporaryDirectory() as folder:
            rng = random.Random(f"{part} {seed}")
            found += PARTS[part](Path(folder), 60 * minutes * SHARES[part] / whole, rng)
    return found


def table(found: list[Faults]) -> str:
    """Return a Markdown table of counts."""
    rows = [
        (
            each.name,
            str(each.tries),
            ", ".join(f"{count} {word}" for word, count in each.what.items()),
            str(each.lost),
            str(len(each.escaped)),
        )
        for each in found
    ]
    return markdown(("fault", "tries", "of them", "lost", "escaped"), rows)


def main() -> int:
    """Make faults, print the table and what escaped."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=4.0, help="in all (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parts", nargs="+", choices=[*PARTS], default=[*PARTS])
    parser.add_argument("--json", type=Path, help="write the counts")
    parser.add_argument("--write-map", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.write_map:
        return _write_until_full(given.write_map)
    found = measure(given.minutes, given.seed, given.parts)
    print(table(found))
    for each in found:
        print("".join(f"{line}\n" for line in each.escaped), end="")
    if given.json:
        about = describe_run(sys.argv[1:], given.seed)
        write_json(given.json, {"run": about, "faults": [asdict(each) for each in found]})
    return int(any(each.lost or each.escaped for each in found))


def _write_until_full(path: Path) -> int:
    try:
        write_map(path)
    except LifelongSlamError as error:
        print(f"{_LINE}{error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
