"""Mutated files: small ones of every format that is read, and what each reader makes of them.

A reader has to refuse a file in one line, or to read it; within 2 s of processor time and 500 MB.
Each file is read by a process of its own, so that one that is aborted does no harm.
"""

import contextlib
import json
import logging
import os
import random
import resource
import shutil
import signal
import sqlite3
import struct
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import zstandard
from numpy.typing import NDArray
from omegaconf import OmegaConf
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from command import CONF, plain  # scripts/command.py
from eval.comparison.runs import find_runs
from eval.comparison.tables import make_tables
from eval.errors import EvalError
from eval.evaluation import evaluate, make_settings
from eval.evidence_files import EvidenceFiles, read_evidence
from eval.relations import read_relations
from eval.run import run_files
from eval.trajectory_files import read_trajectory
from lifelong_slam.errors import LifelongSlamError
from lifelong_slam.geometry import exp
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.io.graph_truth import read_truth
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.saved_map import MapUpdate, Scans
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.result import Edge
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.folder import FolderSource

MOST_SECONDS, MOST_BYTES = 2.0, 500_000_000
REFUSALS = (LifelongSlamError, EvalError, OSError)
_READ, _REFUSED, _TRACEBACK = range(3)  # exit statuses of a reader's process
_LIMITS = {resource.RLIMIT_CPU: 5, resource.RLIMIT_AS: 8 << 30, resource.RLIMIT_CORE: 0}
_PATIENCE = 30  # seconds of wall time after which a reader that waits is ended
_STAMP = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes:
        name: for the table.
        write: a sound one into an empty folder, and returns the file to mutate.
        read: takes that file.
    """

    name: str
    write: Callable[[Path], Path]
    read: Callable[[Path], object]


@dataclass
class Outcome:
    """What became of the mutated files of a format.

    Attributes:
        counts: ``read``, ``refused``, ``traceback``, ``abort``, ``hang``, ``slow`` and ``large``.
        escaped: the first line of what went wrong, with the seed of the file.
    """

    counts: Counter[str] = field(default_factory=Counter)
    escaped: list[str] = field(default_factory=list)


# --- mutations


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to four pieces of damage."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(_text_damage if _is_text(data) else _damage)(bytearray(data), rng)
    return data


def _is_text(data: bytes) -> bool:
    return not data.translate(None, bytes(range(9, 14)) + bytes(range(32, 127)))


def _cut(data: bytearray, rng: random.Random) -> bytes:
    return bytes(data[: rng.randrange(len(data) + 1)])


def _flip(data: bytearray, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 3, 30))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _blow_up(data: bytearray, rng: random.Random) -> bytes:
    """Put a large, small or negative number where one may be; mostly into the head or the tail."""
    form = rng.choice(("<H", "<I", "<Q", "<f", "<d", ">I"))
    size = struct.calcsize(form)
    if len(data) < size:
        return bytes(data)
    near = min(400, len(data) - size)
    place = rng.choice((rng.randint(0, near), rng.randint(0, len(data) - size)))
    if form[1] in "fd":
        value: float = rng.choice((0.0, -1.0, 1e30, float("nan"), float("inf")))
    else:
        most = 256**size - 1
        value = rng.choice((0, 1, most, most >> 1, most >> 8, (most >> 1) + 1, 10**7 & most))
    struct.pack_into(form, data, place, value)
    return bytes(data)


def _splice(data: bytearray, rng: random.Random) -> bytes:
    """Take a piece out, or repeat it."""
    first, last = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    last = min(last, first + 4000)
    return bytes(data[:first] + data[first:last] * rng.choice((0, 2, 5)) + data[last:])


def _another_word(data: bytearray, rng: random.Random) -> bytes:
    """Put something else in the place of a word of text."""
    words = bytes(data).split(b" ")
    words[rng.randrange(len(words))] = rng.choice(_WORDS)
    return b" ".join(words)


def _another_number(data: bytearray, rng: random.Random) -> bytes:
    digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()]
    if not digits:
        return bytes(data)
    place = rng.choice(digits)
    return bytes(data[:place]) + rng.choice(_WORDS) + bytes(data[place + 1 :])


_WORDS = (
    b"1e400", b"-1e400", b"nan", b"inf", b"-1", b"0", b"9" * 30, b"9" * 5000, b"1e30", b"\xff\xfe",
    b"[" * 3000, b"{" * 3000, b"null", b'"x"', b"", b"\n", b"#", b"*a", b"&a [*a]", b"1.5", b"${a}",
    b"2001-99-99", b"!!python/object:os.system", b"4000000000", b"x" * 100_000, b"\0", b",", b":",
)  # fmt: skip
_damage = (_cut, _flip, _flip, _blow_up, _blow_up, _blow_up, _splice)
_text_damage = (
    _cut,
    _flip,
    _splice,
    _another_word,
    _another_word,
    _another_number,
    _another_number,
)


# --- running


def fuzz(form: Format, seconds: float, seed: int, most: int = 10**9) -> Outcome:
    """Read mutated files of a format for a while, `most` of them at most."""
    outcome = Outcome()
    with tempfile.TemporaryDirectory() as name:
        sound = Path(name) / "sound"
        sound.mkdir()
        file = form.write(sound)
        status, said = attempt(form.read, file)[:2]
        if status != "read":
            raise RuntimeError(f"a sound {form.name} is {status}: {said}")
        until = time.monotonic() + seconds
        number = 0
        while time.monotonic() < until and number < most:
            number += 1
            folder = Path(name) / "mutated"
            shutil.copytree(sound, folder)
            mutated = folder / file.relative_to(sound)
            _write_mutated(mutated, random.Random(f"{form.name} {seed} {number}"))
            kinds, said = attempt(form.read, mutated)
            outcome.counts[kinds] += 1
            if kinds not in ("read", "refused"):
                outcome.escaped.append(f"{form.name} seed {seed} number {number}: {kinds}: {said}")
            shutil.rmtree(folder)
    return outcome


def _write_mutated(file: Path, rng: random.Random) -> None:
    if file.suffix == ".map" and rng.random() < 0.7:
        _mutate_blob(file, rng)
    else:
        file.write_bytes(mutate(file.read_bytes(), rng))


def _mutate_blob(file: Path, rng: random.Random) -> None:
    """Mutate a blob of a saved map so that its checksum is right."""
    table, column = rng.choice(
        (("features", "points"), ("scans", "poses"), ("submaps", "voxels"), ("places", "points"))
    )
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        query = f"SELECT rowid, {column} FROM {table} ORDER BY rowid LIMIT 1"
        row, blob = database.execute(query).fetchone()
        plain = mutate(zstandard.ZstdDecompressor().decompress(blob[4:]), rng)
        data = zstandard.ZstdCompressor().compress(plain)
        sealed = struct.pack("<I", zlib.crc32(data)) + data
        database.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (sealed, row))


def attempt(read: Callable[[Path], object], file: Path) -> tuple[str, str]:
    """Read a file in a process of its own.

    Returns:
        What became of it: ``read``, ``refused`` (by an error that names a file), ``traceback``,
        ``abort``, ``hang``, ``slow`` or ``large``; and the error's text.
    """
    ours, theirs = os.pipe()
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    child = os.fork()
    if child == 0:
        os.close(ours)
        _read_and_exit(read, file, theirs)
    os.close(theirs)
    with os.fdopen(ours, errors="replace") as pipe:
        said = pipe.read().strip()
    _, status, used = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGALRM:
        return "hang", f"more than {_PATIENCE} s {said}"
    if code == -signal.SIGXCPU or used.ru_utime + used.ru_stime > MOST_SECONDS:
        return "slow", f"{used.ru_utime + used.ru_stime:.1f} s {said}"
    if code not in (_READ, _REFUSED, _TRACEBACK):
        return "abort", f"status {code} {said}"
    if used.ru_maxrss * 1000 > max(MOST_BYTES, base * 1000 + MOST_BYTES / 4):
        return "large", f"{used.ru_maxrss / 1000:.0f} MB {said}"
    return ("read", "refused", "traceback")[code], said


def _read_and_exit(read: Callable[[Path], object], file: Path, pipe: int) -> None:
    """Read a file within limits, say in a line what came of it, and end the process."""
    code = _TRACEBACK
    for kind, limit in _LIMITS.items():
        resource.setrlimit(kind, (limit, limit))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_PATIENCE)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    logging.disable()
    try:
        read(file)
        code = _READ
    except REFUSALS as error:
        code = _REFUSED
        if not _names_a_file(error):
            code = _TRACEBACK
        os.write(pipe, f"{type(error).__name__}: {error}"[:300].encode())
    except BaseException as error:
        os.write(pipe, f"{type(error).__name__}: {error}"[:300].encode())
    finally:
        os._exit(code)


def _names_a_file(error: BaseException) -> bool:
    return bool(getattr(error, "filename", None)) or os.sep in str(error)


# --- sound files and their readers


def _points(count: int = 300) -> NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return rng.normal(0, 10, (count, 3)).astype(np.float32)


def _cloud(stamp: int, ros1: bool) -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types = store.types
    time_type = types["builtin_interfaces/msg/Time"]
    extra = {"seq": 0} if ros1 else {}
    header = types["std_msgs/msg/Header"](
        stamp=time_type(*divmod(stamp, 10**9)), frame_id="lidar", **extra
    )
    make_field = types["sensor_msgs/msg/PointField"]
    points = _points()
    message = types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=1,
        width=len(points),
        fields=[make_field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    return bytes(serialize(message, "sensor_msgs/msg/PointCloud2"))


def _ros1_bag(compression: Ros1Writer.CompressionFormat | None) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        store = get_typestore(Stores.ROS1_NOETIC)
        writer = Ros1Writer(folder / "drive.bag")
        if compression is not None:
            writer.set_compression(compression)
        with writer:
            topic = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
            for i in range(4):
                writer.write(topic, _STAMP + i * 10**8, _cloud(_STAMP + i * 10**8, ros1=True))
        return folder / "drive.bag"

    return write


def _ros2_bag(plugin: StoragePlugin, packed: bool) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        store = get_typestore(Stores.ROS2_HUMBLE)
        writer = Ros2Writer(folder / "drive", version=9, storage_plugin=plugin)
        if packed:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            topic = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
            for i in range(4):
                writer.write(topic, _STAMP + i * 10**8, _cloud(_STAMP + i * 10**8, ros1=False))
        return next(f for f in (folder / "drive").iterdir() if f.suffix in (".db3", ".mcap"))

    return write


def _metadata(folder: Path) -> Path:
    _ros2_bag(StoragePlugin.SQLITE3, packed=False)(folder)
    return folder / "drive" / "metadata.yaml"


def _read_bag(file: Path) -> None:
    for _ in clean(BagSource(str(file)), InputCounts()):
        pass


def _read_bag_folder(file: Path) -> None:
    _read_bag(file.parent)


def _read_poses_of_bag(file: Path) -> None:
    read_trajectory(file)


def _pose_bag(folder: Path) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    writer = Ros1Writer(folder / "poses.bag")
    writer.set_compression(Ros1Writer.CompressionFormat.BZ2)
    with writer:
        topic = writer.add_connection("/pose", "geometry_msgs/msg/Pose", typestore=store)
        for i in range(20):
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](float(i), 0.0, 0.0),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            )
            raw = store.serialize_ros1(pose, "geometry_msgs/msg/Pose")
            writer.write(topic, _STAMP + i * 10**8, raw)
    return folder / "poses.bag"


def _pcd(kind: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        points = _points()
        fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        size = f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\n"
        head = f"VERSION .7\n{fields}{size}DATA {kind}\n"
        if kind == "ascii":
            body = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points).encode()
        elif kind == "binary":
            body = points.tobytes()
        else:
            plain = points.T.tobytes()
            pieces = (plain[i : i + 32] for i in range(0, len(plain), 32))
            packed = b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)
            body = struct.pack("<II", len(packed), len(plain)) + packed
        (folder / "scan.pcd").write_bytes(head.encode() + body)
        return folder / "scan.pcd"

    return write


def _ply(kind: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        points = _points()
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        head = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
        rows = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points).encode()
        body = rows if kind == "ascii" else points.tobytes()
        (folder / "scan.ply").write_bytes(head.encode() + body)
        return folder / "scan.ply"

    return write


def _bin(folder: Path) -> Path:
    np.pad(_points(), ((0, 0), (0, 1))).tofile(folder / "scan.bin")
    return folder / "scan.bin"


def _las(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        data = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
        data.x, data.y, data.z = _points().T
        data.write(str(folder / name))
        return folder / name

    return write


def _read_scans(file: Path) -> None:
    for _ in clean(FolderSource(str(file.parent)), InputCounts()):
        pass


def _read_scans_with(key: str) -> Callable[[Path], None]:
    def read(file: Path) -> None:
        settings: dict[str, Any] = {key: str(file)}
        source = FolderSource(str(file.parent / "scans"), **settings)
        source.reference()
        for _ in source:
            pass

    return read


def _scans_and(name: str, text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "scans").mkdir()
        for i in range(3):
            np.zeros((10, 4), "<f4").tofile(folder / "scans" / f"{i}.bin")
        (folder / name).write_text(text)
        return folder / name

    return write


def _judge_map(file: Path) -> None:
    _judge(EvidenceFiles(map=file, reference_map=file))


def _judge_trajectory(file: Path) -> None:
    _judge(EvidenceFiles(estimate=file, reference=file))


def _judge(files: EvidenceFiles) -> None:
    """Ask all metrics, as `scripts/evaluate.py` does."""
    config = OmegaConf.create({"eval": OmegaConf.load(CONF / "eval" / "default.yaml")})
    settings = make_settings(plain(config)["eval"])
    evaluate(read_evidence(files), settings.metrics)


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return write


def _grid(folder: Path) -> Path:
    (folder / "g.pgm").write_bytes(b"P5 4 4 255\n" + bytes(range(0, 160, 10)))
    text = "image: g.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
    (folder / "g.yaml").write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.2\n")
    return folder / "g.yaml"


def _image(folder: Path) -> Path:
    return _grid(folder).with_suffix(".pgm")


def _judge_grid(file: Path) -> None:
    path = file.with_suffix(".yaml")
    _judge(EvidenceFiles(grid=path, reference_grid=path))


def _run_file(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / ".hydra").mkdir()
        _ply("ascii")(folder).rename(folder / "map.ply")
        for each in ("trajectory.tum", "reference.tum"):
            (folder / each).write_text(_TUM)
        (folder / "pose_graph.g2o").write_text(_G2O)
        columns = "stamp,odometry_ms,loop_ms,optimise_ms,prune_ms,vertices,edges,rss_mb"
        rows = "".join(f"{i * 0.1:.1f},50,1,0,0,{i + 1},{i},300,0,99\n" for i in range(3))
        (folder / "timeline.csv").write_text(f"{columns},child_rss_mb,cpu_percent\n{rows}")
        headline = {"title": "Error", "unit": "m", "less_is_better": True, "value": 0.1}
        axes = np.eye(3).tolist()
        alignment = {"method": "se3", "rotation": axes, "translation_m": [0, 0, 0], "scale": 1.0}
        sections: dict[str, dict[str, object]] = {
            key: {"headlines": {"error": headline}} for key in ("trajectory", "map", "graph")
        }
        sections["trajectory"]["alignment"] = alignment
        sections["run"] = {"seed": 0, "interrupted": False}
        (folder / "metrics.json").write_text(json.dumps(sections, indent=1))
        (folder / ".hydra/config.yaml").write_text("seed: 0\nscenario:\n  name: A\n  laps: 1\n")
        (folder / ".hydra/overrides.yaml").write_text("- scenario=A\n- scenario.laps=1\n")
        (folder / ".hydra/hydra.yaml").write_text(
            "hydra:\n  job:\n    num: 0\n  runtime:\n    choices:\n      scenario: A\n"
        )
        return folder / name

    return write


def _judge_run(file: Path) -> None:
    _judge(run_files(file.parent))


def _compare(file: Path) -> None:
    from eval.comparison.report import write_report

    folder = file.parent.parent if file.parent.name == ".hydra" else file.parent
    runs = find_runs([folder])
    write_report(folder / "report.html", runs, make_tables(runs.finished))


def keyframe(session: int, i: int, points: int = 100, first: int = 0) -> MapUpdate:
    """Return what the i-th keyframe of a straight drive adds to a map, where `first` began the session."""
    rng, step = np.random.default_rng(i), np.array([0, 0, 0.1, 2.0, 0, 0])
    T, cloud = exp(i * step), _points(points)
    stamps = _STAMP + i * 10**9 + np.arange(4) * 10**8
    voxels: dict[str, NDArray[np.generic]] = {
        "keys": np.sort(rng.choice(2**62, points, replace=False)),
        "means": cloud,
        "weights": np.ones(points, np.uint8),
        "scores": np.ones(points, np.int8),
    }
    edge = Edge(i - 1, i, exp(step), np.eye(6), "loop" if i == first else "odometry")
    return MapUpdate(
        keyframes=[Keyframe(i, session, _STAMP + i * 10**9, T, np.eye(6), 2.0 * i, cloud, cloud)],
        poses={i: T},
        edges={i: edge} if i else {},
        scans=[Scans(session, i, stamps, np.tile(np.eye(4), (4, 1, 1)))],
        submaps={i: voxels},
        places={i: cloud},
    )


def new_map(path: Path) -> MapStore:
    """Make a map without sessions and open it for writing."""
    return MapStore.create(path, "hdl64", np.eye(4), 0.2)


def _write_map(folder: Path) -> Path:
    """Write a map of one session, with something in each table but those of removed keyframes."""
    with new_map(folder / "place.map") as store:
        session = store.begin_session("drive", "seed: 0\n")
        for i in range(4):
            store.write(keyframe(session, i))
        store.end_session(session)
    return folder / "place.map"


def _read_map_file(file: Path) -> None:
    from map import describe, show  # scripts/map.py

    check_map(file)
    with MapStore.open(file, read_only=True) as store:
        saved = store.load()
    saved.voxels()
    show(describe(saved) | {"size_bytes": 0})


_TUM = "".join(f"{i * 0.1:.1f} {i} {i * i / 9:.3f} 0 0 0 0 1\n" for i in range(30))
_KITTI = "".join(f"1 0 0 {i} 0 1 0 {i * i / 9:.3f} 0 0 1 0\n" for i in range(3))
_EUROC = "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n" + "".join(
    f"{_STAMP + i * 10**8},{i},0,0,1,0,0,0\n" for i in range(30)
)
_INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
_G2O = "".join(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1\n" for i in range(3)) + "".join(
    f"EDGE_SE3:QUAT {i} {i + 1} 1 0 0 0 0 0 1 {_INFORMATION}\n" for i in range(2)
)
_TORO = "".join(f"EDGE2 {i} {i + 1} 1 0 0.1 1 0 1 1 0 0\n" for i in range(3))

FORMATS = (
    Format("ROS 1 bag", _ros1_bag(None), _read_bag),
    Format("ROS 1 bag, bz2", _ros1_bag(Ros1Writer.CompressionFormat.BZ2), _read_bag),
    Format("ROS 1 bag, lz4", _ros1_bag(Ros1Writer.CompressionFormat.LZ4), _read_bag),
    Format("ROS 2 bag", _ros2_bag(StoragePlugin.SQLITE3, False), _read_bag_folder),
    Format("ROS 2 metadata.yaml", _metadata, _read_bag_folder),
    Format("MCAP", _ros2_bag(StoragePlugin.MCAP, False), _read_bag),
    Format("MCAP, zstd", _ros2_bag(StoragePlugin.MCAP, True), _read_bag),
    Format("bag of poses", _pose_bag, _read_poses_of_bag),
    *(Format(f"PCD scans, {k}", _pcd(k), _read_scans) for k in ("ascii", "binary")),
    Format("PCD scans, compressed", _pcd("binary_compressed"), _read_scans),
    *(Format(f"PLY scans, {k}", _ply(k), _read_scans) for k in ("ascii", "binary_little_endian")),
    Format("BIN scans", _bin, _read_scans),
    Format("times", _scans_and("times.txt", "0.0\n0.1\n0.2\n"), _read_scans_with("times")),
    Format("reference poses", _scans_and("poses.txt", _KITTI), _read_scans_with("poses")),
    *(Format(f"PCD map, {k}", _pcd(k), _judge_map) for k in ("ascii", "binary")),
    Format("PCD map, compressed", _pcd("binary_compressed"), _judge_map),
    Format("PLY map, ascii", _ply("ascii"), _judge_map),
    Format("PLY map, binary", _ply("binary_big_endian"), _judge_map),
    Format("LAS map", _las("map.las"), _judge_map),
    Format("LAZ map", _las("map.laz"), _judge_map),
    Format("grid's YAML", _grid, _judge_grid),
    Format("grid's PGM", _image, _judge_grid),
    Format("TUM trajectory", _text("a.tum", _TUM), _judge_trajectory),
    Format("KITTI trajectory", _text("a.kitti", _KITTI), _judge_trajectory),
    Format("EuRoC trajectory", _text("a.csv", _EUROC), _judge_trajectory),
    Format("relations", _text("a.relations", "0 1 1 0 0 0 0 0.1\n" * 9), read_relations),
    Format("g2o graph", _text("a.g2o", _G2O), read_g2o),
    Format("true poses, TORO", _text("a.graph", _TORO), lambda f: read_truth(f, range(4))),
    Format("timeline.csv", _run_file("timeline.csv"), _judge_run),
    Format("pose_graph.g2o", _run_file("pose_graph.g2o"), _judge_run),
    Format("metrics.json", _run_file("metrics.json"), _compare),
    Format("config.yaml", _run_file(".hydra/config.yaml"), _compare),
    Format("overrides.yaml", _run_file(".hydra/overrides.yaml"), _compare),
    Format("hydra.yaml", _run_file(".hydra/hydra.yaml"), _compare),
    Format("saved map", _write_map, _read_map_file),
)


def fuzz_all(seconds: float, seed: int) -> Iterator[tuple[str, Outcome]]:
    """Read mutated files of all formats, for an equal time each; yield names and outcomes."""
    for form in FORMATS:
        yield form.name, fuzz(form, seconds / len(FORMATS), seed)
