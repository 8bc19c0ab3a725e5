"""Planar graphs, edges alone and damaged files; test_run_folder_graph.py has spatial ones."""

import gtsam
import numpy as np
import pytest
from g2o_support import IN_PLANE, gtsam_optimum, laps

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import exp, invert, log, to_quaternion
from lifelong_slam.graph.edges import chain, reverse
from lifelong_slam.graph.reduction import loaded
from lifelong_slam.io.g2o import read_g2o, write_g2o
from lifelong_slam.io.g2o_format import planar_poses
from lifelong_slam.result import Edge, GraphSnapshot, Prior

PLANE = np.ix_([2, 3, 4], [2, 3, 4])  # rotation, x, y
ACROSS = np.ix_([2, 3, 4], [0, 1, 5])


@pytest.mark.parametrize("planar", [True, False])
def test_a_graph_comes_back_as_it_was_written(tmp_path, planar):
    graph, _ = laps(planar=planar)
    write_g2o(tmp_path / "a.g2o", graph)
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
    write_g2o(tmp_path / "a.g2o", GraphSnapshot(graph.poses, [tilted], planar=True))
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), False)
    assert values.size() == len(graph.poses)
    pose = values.atPose2(7)
    np.testing.assert_allclose([pose.x(), pose.y()], graph.poses[7][:2, 3], atol=1e-12)
    order = np.ix_([3, 4, 2], [3, 4, 2])  # Pose2 has x y theta
    found = factors.at(0).noiseModel().covariance()
    np.testing.assert_allclose(found, covariance[order], rtol=1e-9)


def test_reads_what_gtsam_writes_of_a_planar_graph(tmp_path):
    graph, _ = laps(planar=True)
    write_g2o(tmp_path / "ours.g2o", graph)
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
    write_g2o(tmp_path / "a.g2o", graph)
    ours = loaded(read_g2o(tmp_path / "a.g2o"))
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
    assert loops == {(3, 0), (1, 2), (3, 9)}


def test_a_line_of_comment_names_the_kind_of_the_edges_after_it(tmp_path):
    vertices = "".join(f"VERTEX_SE2 {i} 0 0 0\n" for i in range(4))
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0 {UNIT}" for i in range(3)]
    text = (
        f"{vertices}{edges[0]}\n# loop\n{edges[1]}\n{edges[2]} # odometry\n{edges[2]} # composed\n"
    )
    (tmp_path / "a.g2o").write_text(text)
    kinds = [edge.kind for edge in read_g2o(tmp_path / "a.g2o").edges]
    assert kinds == ["odometry", "loop", "odometry", "composed"]


def test_what_is_neither_vertex_nor_edge_is_skipped(tmp_path):
    (tmp_path / "a.g2o").write_text(
        "# made by hand\n\nPARAMS_SE2OFFSET 0 0 0 0\nVERTEX_SE2 4 1 2 3\nROBOTLASER1 0 1 2\n"
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
        (f"VERTEX_SE2 {2**63} 1 2 3\n", "line 1: .* below 2.63"),
        ("VERTEX_SE2 0 1,5 2 3\n", "line 1: VERTEX_SE2 has a decimal comma .1,5.: .* points"),
        (TWO + "FIX 2\n", "line 3: there is no vertex 2"),
        (TWO + "FIX\n", "line 3: not a valid FIX"),
        (TWO + "FIX one\n", "line 3: not a valid FIX"),
        (TWO + f"EDGE_PRIOR_SE2 2 0 0 0 {UNIT}\n", "line 3: there is no vertex 2"),
        (TWO + f"EDGE_PRIOR_SE2 1 0 0 {UNIT}\n", "line 3: EDGE_PRIOR_SE2 needs 10 fields, not 9"),
        (TWO + f"EDGE_SE3_PRIORXYZ 1 0 0 0 {UNIT}\n", "line 3: .* another dimension"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0\n", "line 1: a quaternion must not be zero"),
        (TWO + "VERTEX_SE2 1 1 0 0\n", "line 3: vertex 1 is in line 2 already"),
        (TWO + "VERTEX_SE3:QUAT 2 0 0 0 0 0 0 1\n", "line 3: .* another dimension"),
        (TWO + "VERTEX_SWITCH 2 1\n", "line 3: VERTEX_SWITCH can't be read"),
        (TWO + f"EDGE_SE2 0 2 1 0 0 {UNIT}\n", "line 3: there is no vertex 2"),
        (TWO + f"EDGE_SE2 0 0 1 0 0 {UNIT}\n", "line 3: an edge from vertex 0 to itself"),
        (TWO + f"EDGE_SE2 0 1 1 inf 0 {UNIT}\n", "line 3: .* finite"),
        (TWO + "EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", "line 3: EDGE_SE2 needs 11 fields, not 10"),
        (TWO + "EDGE_SE2 0 1 1 0 0 nan 0 0 1 0 1\n", "line 3: .* finite"),
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
    write_g2o(tmp_path / "a.g2o", graph)
    before = (tmp_path / "a.g2o").read_bytes()
    edge = Edge(0, 1, exp(np.zeros(6)), np.zeros((6, 6)), "odometry")
    with pytest.raises(ValueError, match="singular"):
        write_g2o(tmp_path / "a.g2o", GraphSnapshot(graph.poses, [edge], planar=True))
    assert (tmp_path / "a.g2o").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.g2o"]


def write(tmp_path, *lines):
    path = tmp_path / "a.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_edges_from_the_newer_vertex_to_the_older_are_odometry_as_well(tmp_path):
    graph, _ = laps()
    turned = [reverse(edge) if edge.kind == "odometry" else edge for edge in graph.edges]
    write_g2o(tmp_path / "a.g2o", GraphSnapshot(graph.poses, turned))
    lines = (tmp_path / "a.g2o").read_text().splitlines()
    back = read_g2o(write(tmp_path, *(line for line in lines if line[0] != "#")))
    assert [edge.kind for edge in back.edges] == [edge.kind for edge in graph.edges]


@pytest.mark.parametrize("planar", [True, False])
def test_fixed_vertices_priors_and_kinds_come_back(tmp_path, planar):
    graph, truth = laps(planar=planar)
    first = graph.edges[0]
    composed = Edge(3, 9, first.T_source_target, first.covariance, "composed")
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6)) * 0.1
    covariance = first.covariance if planar else A @ A.T + 0.01 * np.eye(6)
    priors = tuple(Prior(i, truth[i], covariance) for i in (8, 30))
    whole = GraphSnapshot(graph.poses, [*graph.edges, composed], (4, 40), priors, planar)
    write_g2o(tmp_path / "a.g2o", whole)
    back = read_g2o(tmp_path / "a.g2o")
    assert back.fixed == (4, 40)
    assert [edge.kind for edge in back.edges] == [edge.kind for edge in whole.edges]
    for ours, theirs in zip(back.priors, priors, strict=True):
        assert ours.vertex == theirs.vertex
        np.testing.assert_allclose(ours.T_map_vertex, theirs.T_map_vertex, atol=1e-9)
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9, atol=1e-12)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), not planar)
    assert values.size() == len(graph.poses)
    assert factors.size() == len(whole.edges)  # it skips what it doesn't know


def test_a_prior_is_of_the_sensor_that_its_offset_puts_on_the_vertex(tmp_path):
    """Its squared error is that of g2o's definition, Z^-1 T O, for small errors."""
    rng = np.random.default_rng(4)
    T, offset = exp(rng.normal(size=6)), exp(rng.normal(size=6))
    A = rng.normal(size=(6, 6))
    information = A @ A.T + np.eye(6)
    error = 1e-4 * rng.normal(size=6)
    Z = T @ offset @ exp(-error)

    def numbers(pose):
        return " ".join(map(repr, [*pose[:3, 3].tolist(), *to_quaternion(pose).tolist()]))

    upper = " ".join(map(repr, information[np.triu_indices(6)].tolist()))
    path = write(
        tmp_path,
        f"EDGE_SE3_PRIOR 0 7 {numbers(Z)} {upper}",
        f"PARAMS_SE3OFFSET 7 {numbers(offset)}",
        f"VERTEX_SE3:QUAT 0 {numbers(T)}",
    )
    (prior,) = read_g2o(path).priors
    ours = log(invert(prior.T_map_vertex) @ T)
    theirs = error[[3, 4, 5, 0, 1, 2]]  # translation first
    expected = theirs @ information @ theirs
    assert ours @ np.linalg.solve(prior.covariance, ours) == pytest.approx(expected, rel=1e-3)


def test_a_prior_whose_offset_is_missing_is_of_the_vertex(tmp_path, caplog):
    upper = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
    path = write(
        tmp_path,
        "VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1",
        f"EDGE_SE3_PRIOR 5 5 1 2 3 0 0 0 1 {upper}",
    )
    (prior,) = read_g2o(path).priors
    np.testing.assert_allclose(prior.T_map_vertex[:3, 3], [1, 2, 3])
    assert "PARAMS_SE3OFFSET 5 is missing" in caplog.text


@pytest.mark.parametrize(
    ("tag", "ids", "planar"),
    [
        ("EDGE_PRIOR_SE2_XY", "0", True),
        ("EDGE_SE3_XYZPRIOR", "0 0", False),
        ("EDGE_SE3_PRIORXYZ", "0", False),
        ("EDGE_POINTXYZ_PRIOR", "0", False),
    ],
)
def test_a_prior_of_a_position_holds_the_position_alone(tmp_path, tag, ids, planar):
    """It costs what its information says, whichever way the vertex looks, and turning is free."""
    vertex = "VERTEX_SE2 0 1 2 0.7" if planar else "VERTEX_SE3:QUAT 0 1 2 0 0.1 0.2 0.3 0.9"
    known = "4 1 9" if planar else "4 1 0 9 0 25"
    measured = "1.1 2.3" if planar else "1.1 2.3 0.2"
    graph = read_g2o(write(tmp_path, vertex, f"{tag} {ids} {measured} {known}"))
    (prior,) = graph.priors
    information = np.linalg.inv(prior.covariance)
    error = log(invert(prior.T_map_vertex) @ graph.poses[0])
    cost = 4 * 0.1**2 + 9 * 0.3**2 + 2 * 0.1 * 0.3 + (0 if planar else 25 * 0.2**2)
    assert error @ information @ error == pytest.approx(cost, rel=1e-6)
    turned = log(
        invert(prior.T_map_vertex) @ prior.T_map_vertex @ exp(np.array([0, 0, 1.0, 0, 0, 0]))
    )
    assert turned @ information @ turned < 1e-4


def test_priors_that_cannot_be_used_are_left_out_with_a_warning(tmp_path, caplog):
    path = write(tmp_path, TWO, f"EDGE_SE2 0 1 1 0 0 {UNIT}", *2 * ["EDGE_SE2_PRIORVEC 0 1 0"])
    graph = read_g2o(path)
    assert (len(graph.edges), graph.priors) == (1, ())
    assert "2 lines EDGE_SE2_PRIORVEC are left out" in caplog.text


def test_fix_needs_poses_to_hold(tmp_path, caplog):
    graph = read_g2o(write(tmp_path, "FIX 1", f"EDGE_SE2 0 1 1 0 0 {UNIT}"))
    assert graph.fixed == ()
    assert "FIX isn't used" in caplog.text
    assert read_g2o(write(tmp_path, TWO, "FIX 1 0")).fixed == (0, 1)


@pytest.mark.parametrize(
    "line",
    [
        "VERTEX_XY 2 0 0",
        "VERTEX_TRACKXYZ 2 0 0 0",
        "EDGE_SE2_XY 0 1 1 0 1 0 1",
        "EDGE_SE3_TRACKXYZ 0 1 0 1 0 0 1 0 0 1 0 1",
        "EDGE_BEARING_SE2_XY 0 1 1 1",
        "VERTEX_PLANE 4 0 0 1 0",
        "EDGE_PROJECT_XYZ2UV 0 1 2 3 1 0 1",
    ],
)
def test_landmarks_are_refused_in_a_line_that_says_what_to_do(tmp_path, line):
    tag = line.split()[0]
    message = rf"a\.g2o, line 4: {tag} belongs to a graph with landmarks.*: marginalise"
    with pytest.raises(SourceError, match=message) as error:
        read_g2o(write(tmp_path, TWO, line))
    assert "\n" not in str(error.value)


def test_what_an_edge_does_not_know_hardly_counts(tmp_path, caplog):
    """One knows nothing of y, one has a negative eigenvalue (3 and -1), one knows nothing at all."""
    path = write(
        tmp_path,
        TWO.strip(),
        f"EDGE_SE2 0 1 1 0 0 {UNIT}",
        "EDGE_SE2 0 1 1 0 0 4 0 0 0 0 9 # loop",
        "EDGE_SE2 0 1 1 0 0 1 2 0 1 0 4 # loop",
        "EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0 # loop",
        "EDGE_SE2 0 1 1 0 0 -4 0 0 1 0 1 # loop",
    )
    graph = read_g2o(path)
    assert len(graph.edges) == 3
    assert "2 of 5 edges, the first in line 6, have no information and are left out" in caplog.text
    assert "2 of 5 edges, the first in line 4, isn't positive definite" in caplog.text
    rows = np.ix_([3, 4, 2], [3, 4, 2])
    flat, indefinite = (np.linalg.inv(edge.covariance[rows]) for edge in graph.edges[1:])
    np.testing.assert_allclose(flat, np.diag([4, 4e-6, 9]), rtol=1e-6, atol=1e-9)
    # 3 (1, 1) (1, 1)^T / 2 is what is positive of the second.
    np.testing.assert_allclose(indefinite, [[1.5, 1.5, 0], [1.5, 1.5, 0], [0, 0, 4]], atol=1e-5)
    for edge in graph.edges:
        assert np.linalg.eigvalsh(edge.covariance)[0] > 0


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ("4e-2 0 0 0 0 1e8", [4e-2, 4e-8, 1e8]),  # a sharp heading makes no claim about y
        ("1e8 0 0 0 0 -1e-3", [1e8, 100, 100]),  # nothing is known of the heading
    ],
)
def test_what_an_edge_does_not_know_is_measured_by_what_it_knows_of_the_kind(
    tmp_path, known, expected
):
    (edge,) = read_g2o(write(tmp_path, TWO, f"EDGE_SE2 0 1 1 0 0 {known}")).edges
    variances = np.diag(edge.covariance)[[3, 4, 2]]  # x, y, heading
    np.testing.assert_allclose(1 / variances, expected, rtol=1e-6)


def test_information_that_is_definite_is_taken_as_it_is(tmp_path, caplog):
    read_g2o(write(tmp_path, TWO, "EDGE_SE2 0 1 1 0 0 1e6 0 0 1e-4 0 1e6"))
    assert not caplog.records
