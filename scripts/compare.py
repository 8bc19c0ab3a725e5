"""Put the figures of runs side by side, and beside the published ones.

    python scripts/run.py -m scenario=A,B,C,D,E,F sensor=bosch,velodyne
    python scripts/compare.py runs=multirun/2026-01-31/12-00-00
    python scripts/compare.py runs=[outputs/first,multirun/2026-01-31] out=report

Every run folder in and below the named folders is taken in. Settings:

    runs=DIR             a run folder, a multirun folder, or any folder above such; several as [DIR,DIR]
    out=DIR              where the results go; default: `comparison` in the first of the folders

Tables: the trajectory errors of each scenario and sensor (Tables 5.1 and 5.2 of the published campaigns),
the distances between the maps of its two sensors in both directions (Table 5.3; runs that differ in the
sensor alone make a pair), and the headlines of all metrics by the settings in which the runs differ. Runs
that differ in their seeds alone (seed=, scenario.seed=) give mean and 95 % confidence interval. Runs that
failed, were stopped early or were repeated later are named, not compared.

Files in `out`: comparison.md, comparison.tex (booktabs, multirow), a CSV file for each table, report.html.
The tables are printed as well.

Exit status: 0 done; 2 bad input or settings, said in one line; 130 stopped by Ctrl-C.
"""

import csv
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from command import run_command
from eval.comparison.report import write_report
from eval.comparison.runs import find_runs
from eval.comparison.tables import make_tables
from eval.comparison.writing import markdown, write_tables
from lifelong_slam.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Settings:
    """What the command line can say; see the top of this file."""

    runs: list[Path]
    out: Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare runs and return the exit status."""
    return run_command(compare, arguments, __doc__, "Stopped: nothing is written.")


def compare(arguments: Sequence[str]) -> None:
    """Read the runs, write tables and report, print the tables."""
    settings = parse(arguments)
    runs = find_runs(settings.runs)
    tables = make_tables(runs.finished)
    write_tables(settings.out, tables, runs.missing)
    write_report(settings.out / "report.html", runs, tables)
    print(markdown(tables, runs.missing))
    print(f"Written to: {settings.out}")


def parse(arguments: Sequence[str]) -> Settings:
    """Return the checked settings.

    Raises:
        ConfigError: an argument is no setting, no runs are named, or a value has the wrong type.
    """
    known = [*Settings.__annotations__]
    given = dict.fromkeys(known, "")
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise ConfigError(f"can't read the settings: '{argument}' is not key=value")
        if key not in known:
            raise ConfigError(f"there is no setting '{key}'.{did_you_mean(key, known)} See --help")
        given[key] = value
    runs = _folders(given["runs"])
    return Settings(runs, Path(given["out"]) if given["out"] else runs[0] / "comparison")


def _folders(named: str) -> list[Path]:
    """Return the folders that ``DIR`` or ``[DIR,DIR]`` names; quotes keep a comma within a name."""
    if named in ("", "[]"):
        raise ConfigError("no runs are named: give runs=DIR; see --help")
    if Path(named).exists() or not (named.startswith("[") and named.endswith("]")):
        return [Path(named)]
    names = next(csv.reader([named[1:-1]], skipinitialspace=True))
    return [Path(name) for name in names]


if __name__ == "__main__":
    sys.exit(main())
