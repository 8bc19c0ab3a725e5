"""Viewers: the stub, and Rerun recordings read back."""

import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from lifelong_slam.config import build
from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import exp
from lifelong_slam.result import Edge, GraphSnapshot
from lifelong_slam.viewer import RerunViewer, StubViewer

CONF = "conf/viewer"


def drive(viewer, scans=5, points=1000):
    rng = np.random.default_rng(0)
    for i in range(scans):
        pose = exp(np.array([0, 0, 0.1 * i, float(i), 0, 0]))
        edge = Edge(0, 1, np.eye(4), np.eye(6), "odometry")
        loop, composed = (Edge(1, 0, np.eye(4), np.eye(6), k) for k in ("loop", "composed"))
        graph = GraphSnapshot({0: np.eye(4), 1: pose}, [edge, loop, composed]) if i == 3 else None
        viewer.update(
            1_700_000_000_000_000_000 + i * 10**8, pose, rng.normal(size=(points, 3)), graph
        )
    viewer.close()


def test_stub_ignores_everything():
    drive(StubViewer())


def test_recording_holds_poses_scans_path_and_graph(tmp_path):
    pytest.importorskip("rerun")
    path = tmp_path / "deep" / "run.rrd"
    drive(RerunViewer(str(path), max_points=100))
    data = path.read_bytes()
    assert data[:3] == b"RRF"
    for entity in (
        "/map/sensor/scan",
        "/map/path/00000",
        "/map/graph/keyframes",
        "/map/graph/loop",
        "/map/graph/composed",
    ):
        assert entity.encode() in data


def test_scans_are_thinned(tmp_path):
    pytest.importorskip("rerun")
    sizes = []
    for name, most in (("thin", 100), ("full", 100_000)):
        drive(RerunViewer(str(tmp_path / name), max_points=most), points=20_000)
        sizes.append((tmp_path / name).stat().st_size)
    assert sizes[0] < 0.2 * sizes[1]


def test_empty_scans_are_survived(tmp_path):
    pytest.importorskip("rerun")
    drive(RerunViewer(str(tmp_path / "a.rrd")), points=0)


def test_a_long_path_is_recorded_in_pieces(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.setattr("lifelong_slam.viewer._PIECE", 3)
    drive(RerunViewer(str(tmp_path / "a.rrd")), scans=7)
    assert b"/map/path/00002" in (tmp_path / "a.rrd").read_bytes()


def test_without_rerun_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install 'lifelong-slam\[rerun\]'"):
        RerunViewer(str(tmp_path / "a.rrd"))
    assert list(tmp_path.iterdir()) == []


def test_configs_build(tmp_path):
    root = Path(__file__).parents[1] / CONF
    assert isinstance(build(OmegaConf.load(root / "none.yaml")), StubViewer)
    config = OmegaConf.load(root / "rerun.yaml")
    config.path = str(tmp_path / "a.rrd")
    pytest.importorskip("rerun")
    viewer = build(config)
    assert isinstance(viewer, RerunViewer)
    viewer.close()
