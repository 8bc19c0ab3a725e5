"""What lies beside a bag: logs of a killed recorder, parts that nothing lists, other recordings."""

import hashlib
import shutil
import sqlite3
from contextlib import closing

import pytest
from mcap.writer import Writer as McapWriter
from sources_support import (
    CLOUD,
    ROS1,
    START,
    assert_same,
    cloud_message,
    storage_file,
    sweep,
    sweeps,
    write_bag,
)

from lifelong_slam.errors import SourceError, TopicError
from lifelong_slam.sources.bag import BagSource

COUNT = 12


def killed(folder, checkpointed, messages=None, name="bag"):
    """The file of a bag whose latest sweeps are in its write-ahead log, without metadata.yaml."""
    whole = storage_file(write_bag(folder, "db3", messages or sweeps("db3", COUNT), name))
    live = folder / "live.db3"
    shutil.move(whole, live)
    with closing(sqlite3.connect(live, isolation_level=None)) as database:
        rows = database.execute("SELECT * FROM messages ORDER BY id").fetchall()
        database.execute("DELETE FROM messages")
        database.execute("VACUUM")
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        for i, row in enumerate(rows):
            if i == checkpointed:
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
        for suffix in ("", "-wal", "-shm"):
            shutil.copy(f"{live}{suffix}", f"{whole}{suffix}")
    live.unlink()
    (whole.parent / "metadata.yaml").unlink()
    return whole


def contents(folder):
    return {file.name: hashlib.sha256(file.read_bytes()).digest() for file in folder.iterdir()}


def whole_scans(folder):
    return list(BagSource(str(write_bag(folder, "db3", sweeps("db3", COUNT), "whole"))))


@pytest.mark.parametrize("checkpointed", [0, 4, COUNT - 1])
@pytest.mark.parametrize("shm", [True, False])
def test_write_ahead_log_of_a_killed_recorder(tmp_path, checkpointed, shm, caplog):
    file = killed(tmp_path, checkpointed)
    if not shm:
        file.with_name(file.name + "-shm").unlink()
    before = contents(file.parent)
    for path in (file.parent, file):
        source = BagSource(str(path))
        assert len(source) == COUNT
        assert_same(source, whole_scans(tmp_path / path.suffix.strip(".")))
    assert contents(file.parent) == before
    assert f"read together with {file.name}-wal" in caplog.text
    assert "damaged" not in caplog.text


def test_write_ahead_log_of_a_last_part_that_metadata_does_not_list(tmp_path):
    messages = sweeps("db3", COUNT)
    folder = write_bag(tmp_path, "db3", messages[:5], "rec_0")
    last = killed(tmp_path, 2, messages[5:], "rec_1")
    for file in last.parent.iterdir():
        shutil.move(file, folder)
    before = contents(folder)
    assert_same(BagSource(str(folder)), whole_scans(tmp_path))
    assert contents(folder) == before


def test_log_in_a_folder_with_metadata(tmp_path):
    file = killed(tmp_path, 4)
    other = killed(tmp_path, 2, name="other")
    metadata = write_bag(tmp_path / "whole", "db3", sweeps("db3", 4)) / "metadata.yaml"
    for source in (metadata, other, other.with_name(other.name + "-wal")):
        shutil.copy(source, file.parent)
    assert_same(BagSource(str(file.parent)), whole_scans(tmp_path / "same"))


def test_rollback_journal_of_a_killed_recorder(tmp_path):
    """What was being written when the recorder was killed is undone."""
    live = storage_file(write_bag(tmp_path, "db3", sweeps("db3", COUNT, 4000)))
    folder = tmp_path / "killed"
    folder.mkdir()
    with closing(sqlite3.connect(live, isolation_level=None)) as database:
        database.execute("PRAGMA cache_size = 2")
        database.execute("BEGIN")
        database.execute("UPDATE messages SET data = zeroblob(length(data))")
        for suffix in ("", "-journal"):
            shutil.copy(f"{live}{suffix}", folder)
        database.execute("ROLLBACK")
    before = contents(folder)
    assert_same(BagSource(str(folder)), BagSource(str(live)))
    assert contents(folder) == before


@pytest.mark.parametrize("content", [b"\0" * 5000, b"", None])
def test_log_that_is_not_the_bags_own(tmp_path, content, caplog):
    path = write_bag(tmp_path, "db3", sweeps("db3", COUNT))
    log = storage_file(path).with_name(storage_file(path).name + "-wal")
    if content is None:
        (tmp_path / "other").mkdir()
        content = killed(tmp_path / "other", 4).with_name("bag.db3-wal").read_bytes()
    log.write_bytes(content)
    assert_same(BagSource(str(path)), whole_scans(tmp_path))


def test_no_room_for_a_copy(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    file = killed(tmp_path, 4)
    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(SourceError, match=r"bag.db3-wal.*No space left.*TMPDIR"):
        BagSource(str(file))


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_parts_that_metadata_does_not_list_are_read(tmp_path, kind, caplog):
    messages = sweeps(kind, COUNT)
    path = write_bag(tmp_path, kind, messages[:5], "rec_0")
    for name, some in (("rec_1", messages[5:9]), ("rec_10", messages[9:])):
        shutil.copy(storage_file(write_bag(tmp_path, kind, some, name)), path)
    source = BagSource(str(path))
    assert [s.stamp for s in source] == [m[2] for m in messages]
    assert f"rec_1.{kind}, rec_10.{kind} read as well, not in metadata.yaml" in caplog.text


@pytest.mark.parametrize("metadata", [True, False])
def test_what_is_no_part_is_named(tmp_path, metadata, caplog):
    path = write_bag(tmp_path, "mcap", sweeps("mcap", COUNT), "rec_0")
    others = ["another.db3", "rec_1.mcap.zstd"]
    if metadata:
        others += ["run.bag", "town.mcap"]
    else:
        (path / "metadata.yaml").unlink()
    for name in (*others, "notes.txt"):
        (path / name).write_bytes(b"whatever")
    assert len(list(BagSource(str(path)))) == COUNT
    assert f"not read: {', '.join(others)} (" in caplog.text
    assert "notes" not in caplog.text


def test_nothing_is_said_of_a_whole_recording(tmp_path, caplog):
    for kind in ("db3", "mcap", "mcap_zstd"):
        assert len(BagSource(str(write_bag(tmp_path, kind, sweeps(kind, 2), kind)))) == 2
    assert not caplog.records


def test_last_part_of_a_killed_ros1_recorder(tmp_path):
    messages = sweeps("ros1", COUNT, 12_000)
    write_bag(tmp_path, "ros1", messages[:4], "drive_0")
    last = write_bag(tmp_path, "ros1", messages[4:], "drive_1")
    data = last.read_bytes()
    last.unlink()
    last.with_name("drive_1.bag.active").write_bytes(data[: int(0.8 * len(data))])
    stamps = [s.stamp for s in BagSource(str(tmp_path))]
    assert stamps == [m[2] for m in messages[: len(stamps)]]
    assert len(stamps) >= 8


def write_mcap(path, profile, schema, encoding, messages, definition=b"", **options):
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile=profile, library="test")
        schema_encoding = "ros1msg" if encoding == "ros1" else encoding
        number = writer.register_schema(schema, schema_encoding, definition)
        channel = writer.register_channel("/lidar", encoding, number)
        for time, data in messages:
            writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def ros1_messages():
    definition, _ = ROS1.generate_msgdef(CLOUD)
    clouds = [
        (START + i, bytes(ROS1.serialize_ros1(cloud_message(sweep(i), START + i, True), CLOUD)))
        for i in range(COUNT)
    ]
    return clouds, definition.encode()


@pytest.mark.parametrize("chunked", [True, False])
def test_ros1_messages_in_a_whole_mcap_are_nothing_to_warn_of(tmp_path, chunked, caplog):
    clouds, definition = ros1_messages()
    schema = "sensor_msgs/PointCloud2"
    path = tmp_path / "a.mcap"
    write_mcap(path, "ros1", schema, "ros1", clouds, definition, use_chunking=chunked)
    assert [s.stamp for s in BagSource(str(path))] == [time for time, _ in clouds]
    assert not caplog.records
    path.write_bytes(path.read_bytes()[:-1000])
    assert list(BagSource(str(path)))
    assert "cut short or damaged" in caplog.text


@pytest.mark.parametrize("profile", ["", "ros2"])
@pytest.mark.parametrize(
    ("schema", "encoding"),
    [("foxglove.PointCloud", "protobuf"), ("sensor_msgs/msg/PointCloud2", "json")],
)
def test_messages_of_other_kinds_are_named(tmp_path, profile, schema, encoding, caplog):
    path = write_mcap(tmp_path / "a.mcap", profile, schema, encoding, [(START, b"\x08\x01" * 50)])
    for topic in (None, "/lidar"):
        with pytest.raises(TopicError) as caught:
            BagSource(str(path), topic)
        message = str(caught.value)
        assert f"/lidar ({schema} in {encoding}, 1 messages)" in message
        assert f"messages in {encoding} can't be read" in message
        assert "\n" not in message
    assert not caplog.records
