"""The whole pipeline, as configured for users, on real recordings where they are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import PoseTrajectory3D
from hydra import compose, initialize_config_dir

from lifelong_slam.config import build
from lifelong_slam.runner import run

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data") / "lidar3d"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.data,
    pytest.mark.skipif(
        not DATA.is_dir(), reason=f"{DATA} is not there (LIFELONG_SLAM_DATA names the data folder)"
    ),
]


def slam(*overrides):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = compose("config", overrides=[*overrides])
        source = build(config.scenario)
        return run(source, build(config.system)), source


def to_evo(trajectory):
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps / 1e9)


@pytest.mark.parametrize(("session", "target"), [("1", 0.20), ("2", 0.30)])
def test_a_hand_held_session_closes_its_loop(session, target):
    folder = DATA / f"hku_session_{session}"
    record, source = slam(
        "scenario=folder",
        "sensor=solid_state",
        f"scenario.path={folder / 'scans'}",
        f"scenario.times={folder / 'times.txt'}",
        f"scenario.poses={folder / 'odom_poses.txt'}",
    )
    reference, estimate = to_evo(source.reference()), to_evo(record.result.trajectory)
    estimate.align(reference)
    error = APE(PoseRelation.translation_part)
    error.process_data((reference, estimate))
    assert error.get_statistic(StatisticsType.rmse) < target
    closed = [edge for edge in record.result.graph.edges if edge.kind != "odometry"]
    assert closed
    assert record.result.counts["loop by place: accepted"] > 0


def test_a_drive_without_point_times_has_its_length():
    record, _ = slam(
        "scenario=bag",
        "sensor=hdl64",
        f"scenario.path={DATA / 'kitti_2011_09_26_drive_0005.bag'}",
    )
    assert record.counts["used"] == 154
    assert record.result.trajectory.length == pytest.approx(71.5, abs=1.0)
    assert np.isfinite(record.result.map_points).all()
