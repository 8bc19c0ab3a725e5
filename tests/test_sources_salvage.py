import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sources_support import FORMATS, START, assert_same, storage_file, sweeps, write_bag

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.recording import open_recording
from lifelong_slam.sources.salvage import SalvagedRecording

COUNT = 12
POINTS = 12_000  # so that a bag has several chunks
LOST = {"ros1_bz2": 7, "db3": 3}  # at most, to a cut; bz2 gives nothing of a block in part


@dataclass
class Bag:
    kind: str
    path: Path = field(repr=False)
    data: bytes = field(repr=False)
    scans: list = field(repr=False)

    def cut(self, folder, share):
        return self.changed(folder, self.data[: int(share * len(self.data))])

    def changed(self, folder, data):
        path = folder / storage_file(self.path).name
        path.write_bytes(data)
        return path


_SLOW = {"ros1_bz2": [pytest.mark.slow]}


@pytest.fixture(scope="module", params=[pytest.param(k, marks=_SLOW.get(k, [])) for k in FORMATS])
def bag(request, tmp_path_factory):
    kind = request.param
    path = write_bag(tmp_path_factory.mktemp(kind), kind, sweeps(kind, COUNT, POINTS))
    return Bag(kind, path, storage_file(path).read_bytes(), list(BagSource(str(path))))


def scans_or_error(path):
    """Return the scans of a damaged bag, and the message if nothing could be read."""
    try:
        return list(BagSource(str(path))), None
    except SourceError as error:
        return [], str(error)


def test_salvage_of_an_intact_bag_equals_normal_reading(bag):
    path = bag.path
    normal, salvaged = open_recording(path), SalvagedRecording([storage_file(path)])
    assert salvaged.topics == dict(normal.topics)
    for topic in normal.topics:
        assert list(salvaged.messages(topic)) == list(normal.messages(topic))
        raw = next(iter(normal.messages(topic)))[1]
        a, b = normal.deserialize(raw, topic), salvaged.deserialize(raw, topic)
        np.testing.assert_array_equal(a.data, b.data)
        assert a.header.stamp.sec == b.header.stamp.sec == START // 10**9


@pytest.mark.parametrize("share", [0.35, 0.6, 0.9])
def test_a_cut_bag_gives_what_is_whole(bag, tmp_path, share, caplog):
    if bag.kind == "ros1_bz2" and share == 0.35:
        pytest.skip("its first chunk is not whole")
    source = BagSource(str(bag.cut(tmp_path, share)))
    salvaged = list(source)
    assert_same(salvaged, bag.scans[: len(salvaged)])
    assert source.unreadable <= 1
    assert len(salvaged) >= int(share * COUNT) - LOST.get(bag.kind, 1)
    warnings = [r.message for r in caplog.records if "cut short or damaged" in r.message]
    assert len(warnings) == 1
    assert f"{len(source)} whole messages on 1 topics" in warnings[0]


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.floats(0, 1, exclude_max=True))
def test_cut_anywhere_gives_a_prefix_or_a_clear_error(bag, tmp_path, share):
    path = bag.cut(tmp_path, share)
    scans, error = scans_or_error(path)
    assert_same(scans, bag.scans[: len(scans)])
    if error:
        assert str(path) in error
        assert "\n" not in error
        assert share < 0.5


@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.integers(0, 2**31))
def test_noise_in_the_middle_never_crashes(bag, tmp_path, seed):
    rng = np.random.default_rng(seed)
    dirty = bytearray(bag.data)
    start = int(rng.integers(0, len(dirty)))
    dirty[start : start + 200] = rng.bytes(len(dirty[start : start + 200]))
    scans, error = scans_or_error(bag.changed(tmp_path, bytes(dirty)))
    assert len(scans) <= COUNT
    assert "\n" not in (error or "")


@pytest.mark.parametrize(("kind", "width"), [("ros1_bz2", 1000), ("mcap_zstd", 150_000)])
def test_a_corrupt_chunk_in_an_indexed_bag_costs_only_itself(tmp_path, kind, width, caplog):
    path = write_bag(tmp_path, kind, sweeps(kind, COUNT, 25_000))
    stamps = [s.stamp for s in BagSource(str(path))]
    file = storage_file(path)
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + width] = b"\xff" * width
    file.write_bytes(data)
    source = BagSource(str(path))
    out = [s.stamp for s in source]
    assert COUNT - 8 <= len(out) < COUNT
    assert set(out) <= set(stamps)
    assert out[-1] == stamps[-1]
    assert "is damaged" in caplog.text


def test_an_active_ros1_bag_has_no_index_yet(tmp_path):
    path = write_bag(tmp_path, "ros1", sweeps("ros1", COUNT, POINTS))
    data = path.read_bytes()
    active = tmp_path / "recording.bag.active"
    active.write_bytes(data[: int(0.8 * len(data))])
    assert len(list(BagSource(str(active)))) >= 8


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.txt"])
@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "is empty"), (b"no bag at all\n" * 100, "is not a ROS 1 bag, ROS 2 bag or MCAP")],
)
def test_files_that_are_no_bags(tmp_path, name, content, reason):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SourceError, match=reason) as caught:
        BagSource(str(path))
    assert "\n" not in str(caught.value)


def test_no_such_file(tmp_path):
    with pytest.raises(SourceError, match="no such file or folder"):
        BagSource(str(tmp_path / "none.bag"))


def test_folder_without_a_bag(tmp_path):
    with pytest.raises(SourceError, match="holds no bag"):
        BagSource(str(tmp_path))


@pytest.mark.parametrize("kind", ["db3", "mcap"])
@pytest.mark.parametrize("metadata", ["", "rosbag2_bagfile_information: {version: 5}", "{["])
def test_broken_metadata_does_not_hide_the_scans(tmp_path, kind, metadata, caplog):
    path = write_bag(tmp_path, kind, sweeps(kind))
    (path / "metadata.yaml").write_text(metadata)
    caplog.set_level(logging.WARNING)
    assert len(list(BagSource(str(path)))) == COUNT
    assert "cut short or damaged" in caplog.text
