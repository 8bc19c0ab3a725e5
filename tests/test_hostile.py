"""Files that are damaged or made to harm are refused in a line that names them, soon and in little memory.

Each is read by a process of its own, with limits; see benchmarks/fuzzing.py.
"""

import bz2
import importlib
import json
import struct
import sys
from pathlib import Path

import laspy
import lz4.frame
import numpy as np
import pytest
import zstandard
from comparison_support import errors, write_run
from map_support import new_map
from mcap.writer import CompressionType, Writer

from eval.comparison.runs import Missing, read_run
from eval.errors import FileError
from eval.files import read_json, read_timeline, read_yaml_text
from eval.grid import read_grid
from eval.map_files import read_map
from eval.trajectory_files import read_trajectory
from formats.bounded import Inflater, inflate, most_plain
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.folder import FolderSource
from lifelong_slam.sources.text_files import read_times

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
fuzzing = importlib.import_module("fuzzing")

HUGE = 400_000_000


def assert_refused(read, path, name=None):
    """Read a file in another process; it must be refused by name."""
    what, said = fuzzing.attempt(read, path)
    assert what == "refused", said
    assert (name or path.name) in said


# --- decompression


def packed(compression, size, block=bytes(10_000_000)):
    """Return so many zeros, compressed without ever being in memory."""
    if compression == "lz4":
        packer = lz4.frame.LZ4FrameCompressor()
        head, last = packer.begin(), packer.flush
    else:
        packer = (
            bz2.BZ2Compressor()
            if compression == "bz2"
            else zstandard.ZstdCompressor().compressobj()
        )
        head, last = b"", packer.flush
    return head + b"".join(packer.compress(block) for _ in range(size // len(block))) + last()


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_what_was_compressed_comes_back(compression):
    plain = np.random.default_rng(0).integers(0, 9, 100_000).astype(np.uint8).tobytes()
    data = {"bz2": bz2, "lz4": lz4.frame, "zstd": zstandard}[compression].compress(plain)
    assert inflate(data, compression, len(plain)) == plain
    assert inflate(data, compression) == plain
    cut = inflate(data[: len(data) // 2], compression, len(plain))
    assert plain.startswith(cut)
    with pytest.raises(ValueError, match="hold more than"):
        inflate(data, compression, len(plain) - 1)
    with pytest.raises(ValueError, match=r"\w"):
        inflate(b"garbage" * 10, compression, len(plain))


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_bomb_is_refused_before_and_while_it_goes_off(compression):
    data = packed(compression, HUGE if compression == "lz4" else 100_000_000)
    with pytest.raises(ValueError, match="claim to hold 10000000000000"):
        inflate(data, compression, 10**13)
    with pytest.raises(ValueError, match="hold more than 1000"):
        inflate(data, compression, 1000)
    if len(data) < 1_000_000:
        with pytest.raises(ValueError, match="hold more than"):
            inflate(data, compression)


def test_chunks_share_what_their_file_can_hold():
    data, size = packed("zstd", 20_000_000), 20_000_000
    inflater = Inflater(1000)
    assert len(inflater(data, "zstd", size)) == size
    with pytest.raises(ValueError, match="the chunks before"):
        inflater(data, "zstd", size)
    assert inflater(b"plain", "none", 10**12) == b"plain"


def test_an_unknown_compression_is_named():
    with pytest.raises(ValueError, match="'rar' is no known compression"):
        inflate(b"", "rar", 0)


# --- bags


def ros1_record(fields, data):
    parts = [key.encode() + b"=" + value for key, value in fields.items()]
    head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def ros1_chunks(compression, declared, *chunks):
    fields = {
        "op": b"\x05",
        "compression": compression.encode(),
        "size": struct.pack("<I", declared),
    }
    return b"#ROSBAG V2.0\n" + b"".join(ros1_record(fields, data) for data in chunks)


def mcap_chunks(compression, declared, *chunks):
    name = compression.encode()
    bodies = (
        struct.pack("<QQQII", 0, 1, declared, 0, len(name)) + name + struct.pack("<Q", len(c)) + c
        for c in chunks
    )
    head = b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<QII", 8, 0, 0)
    return head + b"".join(b"\x06" + struct.pack("<Q", len(body)) + body for body in bodies)


def read_bag(path):
    list(BagSource(str(path)))


@pytest.mark.parametrize("read", [read_bag, read_trajectory])
@pytest.mark.parametrize("declared", [100, HUGE, 30_000_000])
@pytest.mark.parametrize(
    ("name", "compression", "make"),
    [
        ("a.bag", "bz2", ros1_chunks),
        ("a.bag", "lz4", ros1_chunks),
        ("a.mcap", "zstd", mcap_chunks),
        ("a.mcap", "lz4", mcap_chunks),
    ],
)
def test_chunks_that_unpack_to_more_than_a_recording_can(
    tmp_path, name, compression, make, declared, read
):
    data = packed(compression, 40_000_000)
    (tmp_path / name).write_bytes(make(compression, declared, *[data] * 20))
    assert_refused(read, tmp_path / name)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_an_indexed_chunk_that_unpacks_to_hundreds_of_megabytes(tmp_path, compression):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=HUGE)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"uint8[] data")
        channel = writer.register_channel("/points", "cdr", schema)
        writer.add_message(channel, 0, bytes(HUGE // 2), 0)
        writer.finish()
    assert_refused(read_bag, path)


def test_a_connection_that_is_cut(tmp_path):
    about = struct.pack("<I", 200) + b"type=sensor_msgs/PointCloud2"
    connection = ros1_record({"op": b"\x07", "conn": bytes(4), "topic": b"/points"}, about)
    (tmp_path / "a.bag").write_bytes(ros1_chunks("none", len(connection), connection))
    assert_refused(read_bag, tmp_path / "a.bag")


# --- clouds


def pcd(kind, points, body):
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {points}\nDATA {kind}\n"
    return head.encode() + body


def ply(kind, points, body, more=""):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {kind} 1.0\n{more}element vertex {points}\n{axes}end_header\n"
    return head.encode() + body


CLOUDS = {
    "text.pcd": lambda n: pcd("ascii", n, b"1 2 3\n"),
    "binary.pcd": lambda n: pcd("binary", n, bytes(48)),
    "packed.pcd": lambda n: pcd(
        "binary_compressed", n, struct.pack("<II", 20, 2**32 - 1) + bytes(48)
    ),
    "bomb.pcd": lambda n: pcd(
        "binary_compressed", n, struct.pack("<II", 600_000, 48) + b"\xe0\xff\x00" * 200_000
    ),
    "text.ply": lambda n: ply("ascii", n, b"1 2 3\n"),
    "binary.ply": lambda n: ply("binary_little_endian", n, bytes(48)),
    "before.ply": lambda n: ply(
        "binary_big_endian", 4, bytes(48), f"element face {n}\nproperty list int int i\n"
    ),
}


@pytest.mark.parametrize("count", [-1, 5, 10**9, 10**20, int("9" * 400)])
@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_that_declare_more_points_than_they_have(tmp_path, name, count):
    path = tmp_path / name
    path.write_bytes(CLOUDS[name](count))
    assert_refused(read_map, path)
    assert_refused(lambda path: list(FolderSource(str(path.parent))), path)


def las(path, form, place, value):
    data = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
    data.x = data.y = data.z = np.arange(50.0)
    data.write(str(path))
    raw = bytearray(path.read_bytes())
    struct.pack_into(form, raw, place, value)
    path.write_bytes(raw)


@pytest.mark.parametrize(
    ("form", "place", "value"),
    [
        ("<Q", 247, 4 * 10**9),
        ("<Q", 247, 2**64 - 1),
        ("<I", 100, 2**32 - 1),
        ("<I", 243, 2**32 - 1),
        ("<Q", 235, 2**63),
        ("<H", 94, 0),
        ("<I", 96, 2**32 - 1),
    ],
)
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_that_declares_more_than_it_has(tmp_path, name, form, place, value):
    las(tmp_path / name, form, place, value)
    if place == 235:  # where extended records begin, of which there are none
        assert len(read_map(tmp_path / name)) == 50
    else:
        assert_refused(read_map, tmp_path / name)


# --- text


@pytest.mark.parametrize(
    "line", ["1e400", "nan", "inf", "9" * 5000, "1e15", "9999-01-01 00:00:00", "\0"]
)
def test_times_that_are_none(tmp_path, line):
    (tmp_path / "times.txt").write_text(f"0.1\n{line}\n")
    assert_refused(read_times, tmp_path / "times.txt", "times.txt, line 2")


GRID = (
    "image: g.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
    "occupied_thresh: 0.65\nfree_thresh: 0.2\n"
)
LAUGHS = "a: &a [x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "more", [LAUGHS, "a: " + "[" * 5000, "a: " + "[" * 100 + "]" * 100, "d: 2001-99-99"]
)
def test_yaml_that_harms(tmp_path, more):
    (tmp_path / "g.pgm").write_bytes(b"P5 2 2 255\n\0\0\0\0")
    (tmp_path / "g.yaml").write_text(GRID)
    read_grid(tmp_path / "g.yaml")
    (tmp_path / "g.yaml").write_text(f"{GRID}{more}\n")
    assert_refused(read_grid, tmp_path / "g.yaml")


@pytest.mark.parametrize("size", ["9" * 5000 + " 2", "999999999 999999999", "-1 4", "0 0"])
def test_images_of_impossible_size(tmp_path, size):
    (tmp_path / "g.yaml").write_text(GRID)
    (tmp_path / "g.pgm").write_bytes(f"P5 {size} 255\n".encode() + bytes(4))
    if size != "0 0":
        assert_refused(read_grid, tmp_path / "g.yaml", "g.pgm")


@pytest.mark.parametrize("cell", [b"\xff\xfe", b"9" * 200_000, b'"', b"x", b""])
def test_timelines_that_are_no_tables_of_numbers(tmp_path, cell):
    (tmp_path / "timeline.csv").write_bytes(b"stamp,ms\n0.1,5\n0.2," + cell + b"\n")
    assert_refused(read_timeline, tmp_path / "timeline.csv")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 100_000, "[]", "", '{"a": ' + "9" * 5000 + "}"]
)
def test_json_that_is_no_object(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text)
    assert_refused(read_json, tmp_path / "metrics.json")


@pytest.mark.parametrize(
    "metrics",
    [
        {"trajectory": 5},
        {"trajectory": {"headlines": []}},
        {"trajectory": {"headlines": {"a": {"title": [], "unit": "m", "less_is_better": True}}}},
        {"trajectory": {"alignment": {"method": "se3"}}},
        {
            "trajectory": {
                "alignment": {"method": "se3", "rotation": [[1]], "translation_m": 3, "scale": 1}
            }
        },
        {"run": []},
    ],
)
def test_metrics_of_another_form_are_a_run_that_cannot_be_read(tmp_path, metrics):
    write_run(tmp_path, ["scenario=A"], errors(0.1))
    assert not isinstance(read_run(tmp_path), Missing)
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    assert "can't be read" in read_run(tmp_path).reason


@pytest.mark.parametrize("name", ["config", "hydra", "overrides"])
def test_a_config_that_multiplies_is_a_run_that_cannot_be_read(tmp_path, name):
    write_run(tmp_path, ["scenario=A"], errors(0.1))
    (tmp_path / ".hydra" / f"{name}.yaml").write_text(LAUGHS)
    found = read_run(tmp_path)
    assert "aliases" in found.reason


def test_a_multirun_of_billions_of_jobs_is_not_counted(tmp_path):
    write_run(tmp_path / "0", ["scenario=A"], errors(0.1))
    task = "['seed=range(0,1000000000)', 'x=1,2']"
    (tmp_path / "multirun.yaml").write_text(
        f"hydra: {{overrides: {{task: {task}}}, sweeper: {{}}}}\n"
    )
    assert fuzzing.attempt(lambda path: fuzzing.find_runs([path]), tmp_path) == ("read", "")


def test_plain_yaml_passes(tmp_path):
    (tmp_path / "a.yaml").write_text("a: [1, {b: 2}]\n")
    assert read_yaml_text(tmp_path / "a.yaml") == "a: [1, {b: 2}]\n"
    with pytest.raises(FileError, match="no such YAML"):
        read_yaml_text(tmp_path / "b.yaml")


# --- saved maps: the checksums are right


def sealed(data):
    return struct.pack("<I", fuzzing.zlib.crc32(data)) + data


def blob(header, data=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    plain = struct.pack("<I", len(text)) + text + data
    return sealed(zstandard.compress(plain))


BLOBS = {
    "bomb": lambda: sealed(packed("zstd", HUGE)),
    "claim": lambda: sealed(
        zstandard.compress(b"x")[:4] + b"\xe0" + struct.pack("<Q", 10**15) + b"\1\0\0"
    ),
    "objects": lambda: blob({"codes": ["|O", [1]], "low": ["<i8", [3]]}, bytes(64)),
    "nothing": lambda: blob({}),
    "list": lambda: blob([1, 2]),
    "deep": lambda: blob(b"[" * 100_000),
    "short": lambda: sealed(zstandard.compress(b"ab")),
    "long header": lambda: sealed(zstandard.compress(struct.pack("<I", 2**32 - 1) + b"{}")),
    "another": lambda: blob({"a": ["<f4", [1]]}, bytes(4)),
    "flat": lambda: blob({"stamps": ["<i8", [1]], "xi": ["<f8", [6]]}, bytes(56)),
    "large shape": lambda: blob({"low": ["<i8", [3]], "codes": ["<i8", [2**62]]}, bytes(64)),
    "negative shape": lambda: blob({"low": ["<i8", [3]], "codes": ["<i8", [-1]]}, bytes(64)),
    "empty": lambda: b"",
}


@pytest.mark.parametrize("name", BLOBS)
@pytest.mark.parametrize(
    "column", ["features.points", "scans.poses", "submaps.voxels", "vertices.T_map"]
)
def test_blobs_of_saved_maps_that_hold_something_else(tmp_path, column, name):
    path, (table, field) = tmp_path / "place.map", column.split(".")
    new_map(path)
    with fuzzing.contextlib.closing(fuzzing.sqlite3.connect(path)) as db, db:
        if table == "submaps":
            db.execute("INSERT INTO submaps VALUES (0, x'00')")
        where = f"WHERE rowid = (SELECT min(rowid) FROM {table})"
        db.execute(f"UPDATE {table} SET {field} = ? {where}", (BLOBS[name](),))

    def load(path):
        with fuzzing.MapStore.open(path, read_only=True) as store:
            store.load()

    assert_refused(load, path)
    (problem, *_) = fuzzing.check_map(path)
    assert problem.startswith(f"{table} ")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ("CREATE VIEW more AS SELECT * FROM map", "more"),
        ("CREATE TRIGGER t AFTER INSERT ON map BEGIN DELETE FROM map; END", "t"),
        ("CREATE TABLE loose (a)", "loose"),
        ("ALTER TABLE map ADD COLUMN large BLOB AS (zeroblob(1000000000))", "map.large"),
    ],
)
def test_a_map_with_what_no_map_has(tmp_path, change, name):
    new_map(tmp_path / "place.map")
    with fuzzing.contextlib.closing(fuzzing.sqlite3.connect(tmp_path / "place.map")) as db:
        db.execute(change)
    assert_refused(fuzzing.check_map, tmp_path / "place.map", f"it has '{name}'")


# --- mutated files


@pytest.mark.slow
@pytest.mark.parametrize("form", fuzzing.FORMATS, ids=lambda form: form.name)
def test_mutated_files_are_read_or_refused(form):
    outcome = fuzzing.fuzz(form, seconds=60, seed=0, most=8)
    assert outcome.escaped == []
    assert sum(outcome.counts.values()) == 8


def test_limits_leave_room_for_what_compresses_well():
    assert most_plain(0) > 30_000_000
    assert most_plain(10**6) > 10**8


@pytest.mark.slow
def test_the_benchmark_counts_kills_and_torn_logs():
    faults = importlib.import_module("faults")
    found = faults.measure(0.1, 0, ["kills", "torn"])
    assert all(each.tries for each in found)
    assert faults.table(found).count("\n") == 3
