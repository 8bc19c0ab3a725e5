"""Look into a saved map: `python scripts/map.py --help`.

Exit status: 0 done, or no problems found; 1 `check` found problems; 2 bad input, said in one line on
stderr.
"""

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from console import fail
from lifelong_slam.errors import LifelongSlamError, MapError
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.map_export import export_map, static_points
from lifelong_slam.mapping.saved_map import SavedMap, Session
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.scan import NANOSECONDS

PROBLEMS, BAD_INPUT = 1, 2


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line says and return the exit status."""
    options = parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except OSError as error:
        fail(error)
    except LifelongSlamError as error:
        named = str(options.file) in str(error)
        fail(error if named else MapError(f"{options.file}: {error}"))
    return BAD_INPUT


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    top = argparse.ArgumentParser(
        description="Tell what is in a map that scripts/run.py saved with map=FILE, write it as"
        " standard files, or check it. The map itself is never changed."
    )
    commands = top.add_subparsers(required=True, metavar="info|export|check")

    tell = commands.add_parser("info", help="sessions, graph, scans, points and extent")
    tell.add_argument("file", type=Path, metavar="FILE", help="saved map")
    tell.add_argument("--json", action="store_true", help="as JSON")
    tell.set_defaults(command=info)

    write = commands.add_parser("export", help="write points, graph, trajectory or occupancy grid")
    write.add_argument("file", type=Path, metavar="FILE", help="saved map")
    write.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="its ending says what: .ply or .pcd static points, .g2o pose graph, .tum pose of the base"
        " at every scan ever taken, .yaml occupancy grid for ROS's map_server (with a .pgm beside it)",
    )
    write.add_argument(
        "--session",
        type=int,
        metavar="N",
        help="only what session N added (default: all sessions that are located in the map)",
    )
    write.add_argument(
        "--resolution",
        type=cell_size,
        default=0.2,
        metavar="M",
        help="cells of the occupancy grid in metres (default: %(default)s)",
    )
    write.set_defaults(command=export)

    look = commands.add_parser("check", help="list what is wrong; exit status 1 if anything is")
    look.add_argument("file", type=Path, metavar="FILE", help="saved map")
    look.set_defaults(command=check)
    return top


def cell_size(text: str) -> float:
    """Read a length from 1 cm to 10 m."""
    value = float(text)
    if not 0.01 <= value <= 10:
        raise argparse.ArgumentTypeError(f"must lie between 0.01 and 10 m, not {text}")
    return value


def info(options: argparse.Namespace) -> int:
    """Show what is in a map."""
    facts = describe(load(options.file)) | {"size_bytes": options.file.stat().st_size}
    if options.json:
        print(json.dumps(facts, indent=2))
    else:
        show(facts)
    return 0


def export(options: argparse.Namespace) -> int:
    """Write a map as a standard file."""
    saved = load(options.file)
    if options.session is not None:
        saved = saved.of_sessions([options.session])
    elif away := [session.id for session in saved.sessions if not session.located]:
        print(
            f"Sessions that are not located in the map are left out: {away}."
            " --session N writes one of them, in a frame of its own.",
            file=sys.stderr,
        )
        saved = saved.of_sessions([session.id for session in saved.sessions if session.located])
    export_map(saved, options.out, options.resolution)
    print(f"Written: {options.out}")
    return 0


def check(options: argparse.Namespace) -> int:
    """List what is wrong with a map."""
    problems = check_map(options.file)
    for problem in problems:
        print(problem)
    if not problems:
        print("No problems found.")
    return PROBLEMS if problems else 0


def load(path: Path) -> SavedMap:
    """Read a map."""
    with MapStore.open(path, read_only=True) as store:
        return store.load()


def describe(saved: SavedMap) -> dict[str, Any]:
    """Return what is in a map, as plain numbers and text."""
    points = static_points(saved)
    used = saved.graph().edges
    sessions = [describe_session(saved, session) for session in saved.sessions]
    return {
        "sensor": saved.info.sensor,
        "created": iso_time(saved.info.created),
        "version": saved.info.version,
        "sessions": sessions,
        "vertices": len(saved.keyframes),
        "removed_keyframes": len(saved.removals),
        "edges": {
            "odometry": sum(edge.kind == "odometry" for edge in used),
            "loop": sum(edge.kind == "loop" for edge in used),
            "composed": sum(edge.kind == "composed" for edge in used),
            "rejected": len(saved.rejected),
        },
        "scans": sum(session["scans"] for session in sessions),
        "path_length_m": sum(session["path_length_m"] for session in sessions),
        "voxel_size_m": saved.info.voxel_size,
        "map_points": len(points),
        "extent_m": [points.min(axis=0).tolist(), points.max(axis=0).tolist()]
        if len(points)
        else None,
    }


def describe_session(saved: SavedMap, session: Session) -> dict[str, Any]:
    """Return what is in a session, as plain numbers and text."""
    part = saved.of_sessions([session.id])
    trajectory = part.trajectory()
    stamps = trajectory.stamps
    return {
        "id": session.id,
        "started": iso_time(session.started),
        "source": session.source,
        "finished": session.finished,
        "located": session.located,
        "scans": len(trajectory),
        "duration_s": float(stamps[-1] - stamps[0]) / NANOSECONDS if len(stamps) else 0.0,
        "path_length_m": trajectory.length,
        "vertices": len(part.keyframes),
    }


def iso_time(nanoseconds: int) -> str:
    """Return a time to the second, UTC."""
    return datetime.fromtimestamp(nanoseconds // NANOSECONDS, UTC).isoformat()


def show(facts: dict[str, Any]) -> None:
    """Print what is in a map as two tables."""
    console = Console(markup=False)
    sessions = Table(box=None, pad_edge=False)
    for column in ("Session", "Started", "Source", "State"):
        sessions.add_column(column)
    for column in ("Scans", "Time", "Path", "Vertices"):
        sessions.add_column(column, justify="right")
    for session in facts["sessions"]:
        state = "finished" if session["finished"] else "not finished"
        sessions.add_row(
            str(session["id"]),
            session["started"],
            session["source"],
            state if session["located"] else f"{state}, not located",
            f"{session['scans']:,}",
            f"{session['duration_s']:.0f} s",
            f"{session['path_length_m']:.1f} m",
            str(session["vertices"]),
        )
    console.print(sessions)
    console.print()
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in rows(facts):
        table.add_row(name, value)
    console.print(table)


def rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return names and values of what holds for the whole map."""
    edges, extent = facts["edges"], facts["extent_m"]
    size = (
        " x ".join(f"{high - low:.1f}" for low, high in zip(*extent, strict=True)) if extent else ""
    )
    return [
        ("Pose graph", f"{facts['vertices']} vertices, {facts['removed_keyframes']} removed"),
        (
            "Edges",
            f"{edges['odometry']} odometry, {edges['loop']} loop, {edges['composed']} composed,"
            f" {edges['rejected']} rejected",
        ),
        ("Scans", f"{facts['scans']:,} on {facts['path_length_m']:.1f} m"),
        ("Map", f"{facts['map_points']:,} points, one in {facts['voxel_size_m']:g} m"),
        ("Extent", f"{size} m" if extent else "none"),
        ("Sensor", facts["sensor"]),
        ("Made", f"{facts['created']} by lifelong_slam {facts['version']}"),
        ("Size", f"{facts['size_bytes'] / 1e6:.1f} MB"),
    ]


if __name__ == "__main__":
    sys.exit(main())
