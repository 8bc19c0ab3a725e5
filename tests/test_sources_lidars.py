"""Several LiDARs on one topic."""

import numpy as np
import pytest
from sources_support import CLOUD, PERIOD, START, cloud_message, static_transforms, write_bag

from lifelong_slam.errors import TopicError
from lifelong_slam.geometry import invert, transform
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import UNREADABLE, InputCounts, clean

TF = "tf2_msgs/msg/TFMessage"
NO_TURN, ABOUT = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
MOUNTS = {
    "front": ((1.2, 0.0, 0.5), NO_TURN),
    "rear": ((-1.2, 0.0, 0.5), ABOUT),
    "left": ((0.0, 0.7, 0.8), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))),
}
COUNT = 12


def T_base(frame):
    T = np.eye(4)
    (T[:3, 3], (_, _, z, w)) = MOUNTS[frame]
    c, s = w * w - z * z, 2 * z * w
    T[:2, :2] = [[c, -s], [s, c]]
    return T


def seen(frame, index):
    """What a LiDAR sees, (N, 3) in the frame of base."""
    return np.random.default_rng([index, *frame.encode()]).uniform(-20, 20, (30, 3))


def sweep_of(frame, index, stamp, name=None, arrival=None):
    points = transform(invert(T_base(frame)), seen(frame, index)).astype(np.float32)
    columns = dict(zip("xyz", points.T.copy(), strict=True))
    columns["t"] = np.linspace(0, 0.04e9, len(points)).astype(np.uint32)
    message = cloud_message(columns, stamp, frame=name or frame)
    return ("/lidar", CLOUD, (arrival or stamp) + 10_000_000, message)


def links(frames=tuple(MOUNTS), slash=""):
    return [("base_link", slash + f, *MOUNTS[f]) for f in frames]


def turn_by_turn(lags, count=COUNT, late=None):
    """Sweeps of LiDARs that begin `lags` turns after each turn's start; some arrive late."""
    messages = [
        sweep_of(f, i, stamp, arrival=stamp + round((late or {}).get(f, 0) * PERIOD))
        for i in range(count)
        for f, lag in lags.items()
        for stamp in [START + i * PERIOD + round(lag * PERIOD)]
    ]
    return sorted(messages, key=lambda m: m[2])


def bag(folder, messages, transforms=None):
    transforms = links() if transforms is None else transforms
    tf = ("/tf_static", TF, START - 1, static_transforms(transforms))
    return str(write_bag(folder, "mcap", [tf, *messages]))


def in_base(source, scan):
    return transform(source.T_base_sensor, scan.points)


@pytest.mark.parametrize(
    "lags",
    [
        {"front": 0, "rear": 0.5},
        {"rear": 0, "front": 0.1},
        {"front": 0, "rear": 0},
        {"front": 0, "rear": 0.003},
        {"front": 0, "left": 0.33, "rear": 0.67},
        {"front": 0, "left": 0, "rear": 0.5},
    ],
)
def test_sweeps_of_a_turn_make_one_scan_in_the_frame_of_base(tmp_path, lags, caplog):
    caplog.set_level("INFO")
    source = BagSource(bag(tmp_path, turn_by_turn(lags)))
    counts = InputCounts()
    scans = list(clean(source, counts))
    assert counts == InputCounts(read=COUNT, used=COUNT)
    for i, scan in enumerate(scans):
        assert scan.stamp == START + i * PERIOD
        expected = np.concatenate([seen(f, i) for f in lags])
        np.testing.assert_allclose(in_base(source, scan), expected, atol=1e-5)
        times = np.concatenate([np.linspace(0, 0.04, 30) + 0.1 * lag for lag in lags.values()])
        np.testing.assert_allclose(scan.offsets, times, atol=1e-7)
    sweeps = COUNT * len(lags)
    assert f"{sweeps} of {sweeps} sweeps used" in caplog.text


@pytest.mark.parametrize("late", [0.3, 0.6, 0.8])
def test_no_sweep_of_a_lidar_with_delay_is_lost(tmp_path, late):
    path = bag(tmp_path, turn_by_turn({"front": 0, "rear": 0.5}, late={"rear": late}))
    source = BagSource(path)
    counts = InputCounts()
    points = np.concatenate([in_base(source, scan) for scan in clean(source, counts)])
    assert len(points) == 2 * COUNT * 30
    assert not counts.skipped


def test_a_lost_sweep_does_not_shift_the_turns(tmp_path):
    messages = turn_by_turn({"front": 0, "rear": 0})
    del messages[10]
    scans = list(BagSource(bag(tmp_path, messages)))
    assert [s.stamp for s in scans] == [START + i * PERIOD for i in range(COUNT)]
    assert [len(s.points) for s in scans] == [60] * 5 + [30] + [60] * (COUNT - 6)


@pytest.mark.parametrize("every", [2, 3])
def test_lidars_of_different_rates(tmp_path, every):
    """What belongs together by time stays together, and nothing is lost."""
    messages = turn_by_turn({"front": 0, "rear": 0.02}, 24)
    messages = [m for k, m in enumerate(messages) if k % 2 == 0 or k // 2 % every == 0]
    counts = InputCounts()
    source = BagSource(bag(tmp_path, messages))
    scans = list(clean(source, counts))
    assert sum(len(s.points) for s in scans) == 30 * len(messages)
    assert not counts.skipped
    assert max(np.ptp(s.offsets) for s in scans) < 0.15


def test_recordings_of_a_few_sweeps_a_second(tmp_path):
    messages = [
        sweep_of(f, i, START + i * 5 * PERIOD) for i in range(COUNT) for f in ("front", "rear")
    ]
    assert [len(s.points) for s in BagSource(bag(tmp_path, messages))] == [60] * COUNT


def test_frames_with_a_leading_slash(tmp_path):
    messages = [
        sweep_of("rear" if i % 2 else "front", i, START + i * PERIOD // 2, name)
        for i, name in enumerate(["/front", "rear", "front", "/rear"] * 3)
    ]
    source = BagSource(bag(tmp_path, messages, links(["front"]) + links(["rear"], "/")))
    assert [len(s.points) for s in source] == [60] * 6


def test_points_that_are_no_returns_stay_out_of_the_joined_scan(tmp_path):
    messages = turn_by_turn({"front": 0, "rear": 0})
    for _, _, _, message in messages:
        message.data[: message.point_step - 4] = 0  # x, y, z
    source = BagSource(bag(tmp_path, messages))
    scan = next(iter(source))
    assert len(scan.points) == 59
    assert np.count_nonzero(~scan.points.any(axis=1)) == 1  # the front one's, for cropping


@pytest.mark.parametrize("known", [["front"], ["rear"], []])
def test_lidars_whose_relation_is_unknown_are_named(tmp_path, known):
    path = bag(tmp_path, turn_by_turn({"front": 0, "rear": 0.5}), links(known))
    with pytest.raises(TopicError, match=r"'front'.*'rear'.*scenario.frame=") as caught:
        BagSource(path)
    assert "\n" not in str(caught.value)
    for frame in ("front", "/rear"):
        source = BagSource(path, frame=frame)
        name = frame.lstrip("/")
        counts = InputCounts()
        for i, scan in enumerate(clean(source, counts)):
            local = in_base(source, scan) if name in known else transform(T_base(name), scan.points)
            np.testing.assert_allclose(local, seen(name, i), atol=1e-5)
        assert counts == InputCounts(read=COUNT, used=COUNT)


def test_frame_that_no_cloud_is_in(tmp_path):
    path = bag(tmp_path, turn_by_turn({"front": 0, "rear": 0.5}))
    with pytest.raises(TopicError, match=r"frame 'frnt'.*Did you mean 'front'.*front, rear"):
        BagSource(path, frame="frnt")


def test_clouds_that_name_no_frame_are_left_out_where_others_do(tmp_path):
    messages = turn_by_turn({"front": 0})
    messages[0][3].header.frame_id = ""
    source = BagSource(bag(tmp_path, messages))
    counts = InputCounts()
    assert len(list(clean(source, counts))) == COUNT - 1
    assert counts.skipped == {UNREADABLE: 1}


def test_sweeps_of_one_lidar_are_never_joined(tmp_path):
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, COUNT)
    stamps = [START + round((i + jitter[i]) * PERIOD) for i in range(COUNT)]
    messages = [sweep_of("front", i, stamp) for i, stamp in enumerate(stamps)]
    messages.insert(0, sweep_of("front", 0, START - PERIOD))
    messages[0][3].header.frame_id = ""
    assert [s.stamp for s in BagSource(bag(tmp_path, messages))] == stamps


@pytest.mark.parametrize("known", [True, False])
def test_a_lidar_that_begins_later(tmp_path, known, caplog):
    messages = turn_by_turn({"front": 0, "rear": 0}, 40)
    messages = [m for k, m in enumerate(messages) if k % 2 == 0 or k > 60]
    source = BagSource(bag(tmp_path, messages, links(["front", "rear"] if known else ["front"])))
    lengths = [len(s.points) for s in source]
    assert lengths == [30] * 30 + [60 if known else 30] * 10
    assert source.unreadable == (0 if known else 10)
    assert ("'rear' to 'front'" in caplog.text) != known


def test_one_lidar_whose_frame_is_renamed(tmp_path):
    messages = turn_by_turn({"front": 0}, 40)
    for message in messages[30:]:
        message[3].header.frame_id = "new"
    source = BagSource(bag(tmp_path, messages, [*links(), ("front", "new", (0.0,) * 3, NO_TURN)]))
    assert [s.stamp for s in source] == [START + i * PERIOD for i in range(40)]
