"""Pose graphs as g2o files, against GTSAM's reader, writer and arithmetic."""

import gtsam
import numpy as np
import pytest
from run_folder_support import T_BASE_SENSOR, some_graph

from lifelong_slam.errors import SourceError
from lifelong_slam.io.g2o import read_g2o, write_g2o
from lifelong_slam.result import Edge, GraphSnapshot
from lifelong_slam.run_folder import graph_to_base


def gtsam_error(graph):
    """Half the sum of squared, whitened errors as GTSAM itself computes it."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in graph.poses.items():
        values.insert(i, gtsam.Pose3(pose))
    for edge in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        measured = gtsam.Pose3(edge.T_source_target)
        factors.add(gtsam.BetweenFactorPose3(edge.source, edge.target, measured, noise))
    return factors.error(values)


def test_gtsam_reads_the_same_graph(tmp_path):
    expected = graph_to_base(some_graph(np.random.default_rng(6)), T_BASE_SENSOR)
    write_g2o(tmp_path / "a.g2o", expected)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    assert values.size() == len(expected.poses)
    for i, pose in expected.poses.items():
        np.testing.assert_allclose(values.atPose3(i).matrix(), pose, atol=1e-12)
    for k, edge in enumerate(expected.edges):
        factor = factors.at(k)
        assert factor.keys() == [edge.source, edge.target]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_source_target, atol=1e-12)
        covariance = factor.noiseModel().covariance()
        np.testing.assert_allclose(covariance, edge.covariance, rtol=1e-9, atol=1e-12)
    assert factors.error(values) == pytest.approx(gtsam_error(expected), rel=1e-9)


def test_moving_a_graph_to_the_base_keeps_its_error():
    graph = some_graph(np.random.default_rng(7))
    moved = graph_to_base(graph, T_BASE_SENSOR)
    assert gtsam_error(moved) == pytest.approx(gtsam_error(graph), rel=1e-9)


def test_own_reader_gives_back_what_was_written(tmp_path):
    graph = some_graph(np.random.default_rng(8))
    write_g2o(tmp_path / "a.g2o", graph)
    back = read_g2o(tmp_path / "a.g2o")
    assert [(e.source, e.target, e.kind) for e in back.edges] == [
        (e.source, e.target, e.kind) for e in graph.edges
    ]
    for i, pose in graph.poses.items():
        np.testing.assert_allclose(back.poses[i], pose, atol=1e-12)
    for ours, theirs in zip(back.edges, graph.edges, strict=True):
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9, atol=1e-12)


def test_own_reader_agrees_with_gtsams_writer(tmp_path):
    graph = some_graph(np.random.default_rng(9))
    write_g2o(tmp_path / "ours.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "ours.g2o"), True)
    gtsam.writeG2o(factors, values, str(tmp_path / "theirs.g2o"))
    back = read_g2o(tmp_path / "theirs.g2o")
    assert {e.kind for e in back.edges if e.target == e.source + 1} == {"odometry"}
    assert sum(e.kind == "loop" for e in back.edges) == 2  # inferred: the file does not say
    for ours, theirs in zip(back.edges, graph.edges, strict=True):
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-3, atol=1e-5)


def test_singular_covariance_is_refused(tmp_path):
    edge = Edge(0, 1, np.eye(4), np.zeros((6, 6)), "odometry")
    with pytest.raises(ValueError, match="singular"):
        write_g2o(tmp_path / "a.g2o", GraphSnapshot({0: np.eye(4), 1: np.eye(4)}, [edge]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content", ["VERTEX_SE3:QUAT 0 1 2\n", "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 5 5\n"]
)
def test_malformed_graph_is_named(tmp_path, content):
    (tmp_path / "bad.g2o").write_text(content)
    with pytest.raises(SourceError, match=r"bad\.g2o"):
        read_g2o(tmp_path / "bad.g2o")
