"""Planar graphs, edges alone and damaged files; test_run_folder_graph.py has spatial ones."""

import gtsam
import numpy as np
import pytest
from g2o_support import IN_PLANE, gtsam_optimum, laps

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import exp, log
from lifelong_slam.graph.edges import chain, reverse
from lifelong_slam.graph.reduction import LoadedGraph
from lifelong_slam.io.g2o import read_g2o, write_g2o
from lifelong_slam.io.g2o_format import planar_poses
from lifelong_slam.result import Edge, GraphSnapshot

PLANE = np.ix_([2, 3, 4], [2, 3, 4])  # rotation, x, y
ACROSS = np.ix_([2, 3, 4], [0, 1, 5])


@pytest.mark.parametrize("planar", [True, False])
def test_a_graph_comes_back_as_it_was_written(tmp_path, planar):
    graph, _ = laps(planar=planar)
    write_g2o(tmp_path / "a.g2o", graph, planar)
    back = read_g2o(tmp_path / "a.g2o")
    assert back.planar == planar
    assert back.poses.keys() == graph.poses.keys()
    for i, pose in graph.poses.items():
        np.testing.assert_allclose(back.poses[i], pose, atol=1e-12)
    for ours, theirs in zip(back.edges, graph.edges, strict=True):
        assert (ours.source, ours.target, ours.kind) == (theirs.source, theirs.target, theirs.kind)
        np.testing.assert_allclose(ours.T_source_target, theirs.T_source_target, atol=1e-12)
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9, atol=1e-15)


def test_gtsam_reads_the_same_planar_graph(tmp_path):
    graph, _ = laps(planar=True)
    edge = graph.edges[0]
    covariance = edge.covariance.copy()
    covariance[PLANE] = [[4e-5, 1e-5, -2e-5], [1e-5, 3e-4, 5e-5], [-2e-5, 5e-5, 6e-4]]
    tilted = Edge(edge.source, edge.target, edge.T_source_target, covariance, edge.kind)
    write_g2o(tmp_path / "a.g2o", GraphSnapshot(graph.poses, [tilted]), planar=True)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), False)
    assert values.size() == len(graph.poses)
    pose = values.atPose2(7)
    np.testing.assert_allclose([pose.x(), pose.y()], graph.poses[7][:2, 3], atol=1e-12)
    order = np.ix_([3, 4, 2], [3, 4, 2])  # Pose2 has x y theta
    found = factors.at(0).noiseModel().covariance()
    np.testing.assert_allclose(found, covariance[order], rtol=1e-9)


def test_reads_what_gtsam_writes_of_a_planar_graph(tmp_path):
    graph, _ = laps(planar=True)
    write_g2o(tmp_path / "ours.g2o", graph, planar=True)
    read = gtsam.readG2o(str(tmp_path / "ours.g2o"), False)
    gtsam.writeG2o(*read, str(tmp_path / "theirs.g2o"))
    back = read_g2o(tmp_path / "theirs.g2o")
    assert [edge.kind for edge in back.edges] == [edge.kind for edge in graph.edges]
    for i, pose in graph.poses.items():
        np.testing.assert_allclose(back.poses[i], pose, atol=1e-4)


@pytest.mark.parametrize("planar", [True, False])
def test_the_optimum_is_that_of_gtsam(tmp_path, planar):
    """GTSAM optimises planar files with Pose2, we with Pose3: the third dimension changes nothing."""
    graph, _ = laps(planar=planar)
    write_g2o(tmp_path / "a.g2o", graph, planar)
    ours = LoadedGraph(read_g2o(tmp_path / "a.g2o"))
    ours.optimise()
    half, poses = gtsam_optimum(tmp_path / "a.g2o", spatial=not planar)
    assert half > 1
    assert ours.chi_square() / 2 == pytest.approx(half, rel=1e-6)
    for i, pose in ours.poses().items():
        np.testing.assert_allclose(pose, poses[i], atol=1e-4)


def test_what_lies_out_of_the_plane_stays_apart_from_it():
    graph, _ = laps(planar=True)
    first, second = graph.edges[:2]
    for edge in (reverse(first), chain(first, second)):
        assert not edge.covariance[ACROSS].any()
        assert not log(edge.T_source_target)[IN_PLANE == 0].any()


def test_without_vertices_poses_are_chained_along_odometry(tmp_path):
    """The loop closure 3 -> 0 disagrees, and the one to vertex 9 is the only way there."""
    (tmp_path / "a.g2o").write_text(
        "EDGE_SE2 3 0 5 5 5 1 0 0 1 0 1\n"
        "EDGE_SE2 0 1 1 0 1.5707963267948966 1 0 0 1 0 1\n"
        "EDGE_SE2 2 1 -1 0 0 1 0 0 1 0 1\n"
        "EDGE_SE2 2 3 1 0 0 1 0 0 1 0 1\n"
        "EDGE_SE2 3 9 0 -1 0 1 0 0 1 0 1 # loop\n"
        "EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n"
    )
    graph = read_g2o(tmp_path / "a.g2o")
    positions = np.array([graph.poses[i][:2, 3] for i in (0, 1, 2, 3, 9)])
    np.testing.assert_allclose(positions, [[0, 0], [1, 0], [1, 1], [1, 2], [2, 2]], atol=1e-12)
    loops = {(edge.source, edge.target) for edge in graph.edges if edge.kind == "loop"}
    assert loops == {(3, 0), (2, 1), (3, 9)}


def test_a_line_of_comment_names_the_kind_of_the_edges_after_it(tmp_path):
    vertices = "".join(f"VERTEX_SE2 {i} 0 0 0\n" for i in range(4))
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0 {UNIT}" for i in range(3)]
    text = f"{vertices}{edges[0]}\n# loop\n{edges[1]}\n{edges[2]} # odometry\n"
    (tmp_path / "a.g2o").write_text(text)
    kinds = [edge.kind for edge in read_g2o(tmp_path / "a.g2o").edges]
    assert kinds == ["odometry", "loop", "odometry"]


def test_what_is_neither_vertex_nor_edge_is_skipped(tmp_path):
    (tmp_path / "a.g2o").write_text(
        "# made by hand\n\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nVERTEX_SE2 4 1 2 3\nFIX 4\n"
    )
    graph = read_g2o(tmp_path / "a.g2o")
    np.testing.assert_allclose(graph.poses[4], planar_poses(np.array([[1.0, 2.0, 3.0]]))[0])


TWO = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"
UNIT = "1 0 0 1 0 1"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("VERTEX_SE2 0 1 2\n", "line 1: VERTEX_SE2 needs 4 fields, not 3"),
        ("VERTEX_SE2 a 1 2 3\n", "line 1: not a valid VERTEX_SE2"),
        ("VERTEX_SE2 0 1 2 x\n", "line 1: not a valid VERTEX_SE2"),
        ("VERTEX_SE2 0 1 2 nan\n", "line 1: .* finite"),
        ("VERTEX_SE2 -1 1 2 3\n", "line 1: .* count from 0"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0\n", "line 1: a quaternion must not be zero"),
        (TWO + "VERTEX_SE2 1 1 0 0\n", "line 3: vertex 1 is in line 2 already"),
        (TWO + "VERTEX_SE3:QUAT 2 0 0 0 0 0 0 1\n", "line 3: .* another dimension"),
        (TWO + "VERTEX_XY 2 0 0\n", "line 3: VERTEX_XY can't be read"),
        (TWO + f"EDGE_SE2 0 2 1 0 0 {UNIT}\n", "line 3: there is no vertex 2"),
        (TWO + f"EDGE_SE2 0 0 1 0 0 {UNIT}\n", "line 3: an edge from vertex 0 to itself"),
        (TWO + f"EDGE_SE2 0 1 1 inf 0 {UNIT}\n", "line 3: .* finite"),
        (TWO + "EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", "line 3: EDGE_SE2 needs 11 fields, not 10"),
        (TWO + "EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0\n", "line 3: .* positive definite"),
        (TWO + "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 0\n", "line 3: .* positive definite"),
        (TWO + "EDGE_SE2 0 1 1 0 0 1 2 0 1 0 1\n", "line 3: .* positive definite"),
        (f"EDGE_SE2 0 1 1 0 0 {UNIT}\nEDGE_SE2 3 4 1 0 0 {UNIT}\n", "2 others, such as 3"),
    ],
)
def test_a_damaged_file_is_named_with_its_line(tmp_path, content, message):
    (tmp_path / "bad.g2o").write_text(content)
    with pytest.raises(SourceError, match=rf"bad\.g2o.*{message}"):
        read_g2o(tmp_path / "bad.g2o")


def test_a_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "bad.g2o").write_bytes(bytes(range(256)))
    with pytest.raises(SourceError, match="no text"):
        read_g2o(tmp_path / "bad.g2o")


def test_a_graph_that_cannot_be_written_leaves_the_old_file(tmp_path):
    graph, _ = laps(planar=True)
    write_g2o(tmp_path / "a.g2o", graph, planar=True)
    before = (tmp_path / "a.g2o").read_bytes()
    edge = Edge(0, 1, exp(np.zeros(6)), np.zeros((6, 6)), "odometry")
    with pytest.raises(ValueError, match="singular"):
        write_g2o(tmp_path / "a.g2o", GraphSnapshot(graph.poses, [edge]), planar=True)
    assert (tmp_path / "a.g2o").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.g2o"]
