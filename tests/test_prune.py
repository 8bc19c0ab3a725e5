"""scripts/prune.py as a user meets it, and the parts that it is made of."""

import importlib
import json
import os
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from g2o_support import gtsam_optimum, laps

import prune
from eval.vertices import rmse, vertex_distances
from lifelong_slam.errors import ConfigError, SourceError
from lifelong_slam.geometry import exp, invert, log, to_quaternion
from lifelong_slam.graph.edges import reverse
from lifelong_slam.graph.initialisation import best_start, chordal
from lifelong_slam.graph.marginalisation import Dense, StarMesh
from lifelong_slam.graph.pruning import NoPruning, Pruner
from lifelong_slam.graph.reduction import loaded, reduce
from lifelong_slam.graph.selection import Geometry
from lifelong_slam.io.g2o import read_g2o, write_g2o
from lifelong_slam.io.g2o_format import planar_poses
from lifelong_slam.io.graph_truth import read_truth
from lifelong_slam.result import Edge, GraphSnapshot, Prior

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
robustness = importlib.import_module("robustness")
DATA = ROOT / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data") / "pose_graphs"
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"{DATA} is not there (LIFELONG_SLAM_DATA names the data folder)"
)
CASES = DATA.parents[1] / "cases" / "graphs"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is not there")
GEOMETRY = Pruner(Geometry(1.0), StarMesh())


@pytest.fixture
def cli(capsys):
    """Run scripts/prune.py's main; return its status, stdout and stderr."""

    def call(*arguments):
        status = prune.main([str(argument) for argument in arguments])
        return status, *capsys.readouterr()

    return call


def write_laps(folder, **settings):
    """Write laps as a g2o file, with the truth as another one, and return their paths."""
    graph, truth = laps(**settings)
    write_g2o(folder / "in.g2o", graph)
    write_g2o(folder / "truth.g2o", GraphSnapshot(truth, [], planar=graph.planar))
    return folder / "in.g2o", folder / "truth.g2o"


def test_a_part_that_only_closures_set_aside_lead_to_is_held_where_it_is():
    """Two drives that nothing but a closure ties together; without it each must have its own gauge."""
    step = np.eye(4)
    step[0, 3] = 1.0
    covariance = 1e-4 * np.eye(6)
    poses = {i: np.eye(4) for i in (0, 1, 10, 11)}
    edges = [Edge(i, i + 1, step, covariance, "odometry") for i in (0, 10)]
    graph = loaded(GraphSnapshot(poses, [*edges, Edge(1, 10, step, covariance, "loop")]))
    assert graph.component(0) == {0, 1, 10, 11}
    graph._rejected = set(graph._loops)
    assert graph.component(0) == {0, 1}
    graph._solve(set())
    np.testing.assert_allclose(graph.pose(1), step, atol=1e-6)
    np.testing.assert_allclose(graph.pose(11), step, atol=1e-6)


@pytest.mark.parametrize("planar", [True, False])
def test_reduces_a_file_and_tells_what_that_changed(cli, tmp_path, planar):
    graph, truth = write_laps(tmp_path, planar=planar)
    out, figures = tmp_path / "out.g2o", tmp_path / "figures.json"
    status, shown, _ = cli(
        f"graph={graph}", f"out={out}", f"truth={truth}", f"json={figures}", "keep=0.4"
    )
    assert status == 0
    assert "Chi-square" in shown
    facts = json.loads(figures.read_text())
    read, optimum, pruned = (facts["states"][name] for name in ("read", "optimum", "pruned"))
    assert (read["vertices"], optimum["vertices"], pruned["vertices"]) == (60, 60, 24)
    assert read["edges"] == optimum["edges"] == 99
    assert optimum["chi_square"] == pytest.approx(
        2 * gtsam_optimum(graph, spatial=not planar)[0], rel=1e-6
    )
    assert optimum["ape_all_m"] < 0.5 * read["ape_all_m"]
    assert pruned["ape_staying_m"] < 1.3 * optimum["ape_staying_m"]
    assert facts["moved_all_m"] < 0.5 * optimum["ape_all_m"]
    assert facts["pruning"] == {
        "removals checked": 1,
        "removals undone": 0,
        "removals refused": 0,
    }
    assert "1 removals checked, 0 removals undone, 0 removals refused" in shown
    written, values = gtsam.readG2o(str(out), not planar)
    assert (values.size(), written.size()) == (24, pruned["edges"])
    assert 2 * written.error(values) == pytest.approx(pruned["chi_square"], rel=1e-3)
    assert read_g2o(out).planar == planar


def test_a_written_graph_can_be_reduced_again(cli, tmp_path):
    graph, _ = write_laps(tmp_path, planar=True)
    for keep, left in ((0.5, 30), (0.5, 15)):
        out = tmp_path / f"{left}.g2o"
        assert cli(f"graph={graph}", f"out={out}", f"keep={keep}")[0] == 0
        assert len(read_g2o(out).poses) == left
        graph = out


def test_without_pruning_the_optimum_comes_back(cli, tmp_path):
    graph, _ = write_laps(tmp_path)
    cli(f"graph={graph}", f"out={tmp_path / 'out.g2o'}", "pruning=none")
    _, poses = gtsam_optimum(graph, spatial=True)
    for i, pose in read_g2o(tmp_path / "out.g2o").poses.items():
        np.testing.assert_allclose(pose, poses[i], atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["keep=0"], "above 0 and at most 1"),
        (["keep=1.01"], "above 0 and at most 1"),
        (["keep=some"], "keep: .* valid number"),
        (["keep=0.2,0.3"], "'keep=0.2,0.3'"),
        (["kep=0.3"], "Did you mean 'keep'"),
        (["pruning=geometri"], "Did you mean 'geometry'"),
        (["pruning.marginalisation.arms=many"], "arms: .* valid integer"),
        (["graph=missing.g2o"], "no such pose graph: missing.g2o"),
        (["truth=missing.tum"], "no such file"),
        (["pruning=dense"], "can't hold"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(
    cli, tmp_path, arguments, message
):
    graph, _ = write_laps(tmp_path, count=2)
    out = tmp_path / "out.g2o"
    out.write_text("old")
    status, shown, said = cli(f"graph={graph}", f"out={out}", *arguments)
    assert (status, shown) == (2, "")
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    with pytest.raises(AssertionError, match=message):  # shows the line if it doesn't match
        raise AssertionError(errors[0])
    assert out.read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"in.g2o", "truth.g2o", "out.g2o"}


def test_the_input_must_be_named(cli):
    status, _, said = cli("keep=0.5")
    assert status == 2
    assert "graph=" in said


@pytest.mark.parametrize("planar", [True, False])
def test_the_middle_of_a_chain_becomes_the_sum_of_its_edges(planar):
    graph, _ = laps(planar=planar, count=2)
    first, second = graph.edges[:2]
    chain = GraphSnapshot({i: graph.poses[i] for i in range(3)}, [first, second])
    result = reduce(chain, GEOMETRY, keep=2 / 3)
    (edge,) = result.graph.edges
    assert (edge.source, edge.target, edge.kind) == (0, 2, "odometry")
    assert result.pruned.chi_square == pytest.approx(0, abs=1e-9)
    T = first.T_source_target @ second.T_source_target
    np.testing.assert_allclose(edge.T_source_target, T, atol=1e-9)
    A = np.asarray(gtsam.Pose3(invert(second.T_source_target)).AdjointMap())
    expected = A @ first.covariance @ A.T + second.covariance
    np.testing.assert_allclose(edge.covariance, expected, rtol=1e-9, atol=1e-15)


def test_a_graph_whose_vertices_say_nothing_finds_its_optimum():
    """From poses that are all the same, where Levenberg-Marquardt alone ends in another minimum."""
    graph, truth = laps(seed=4)
    nowhere = GraphSnapshot(dict.fromkeys(graph.poses, np.eye(4)), graph.edges)
    alone = loaded(nowhere, robust=False)
    alone.optimise()
    result = reduce(nowhere, NoPruning(), keep=1.0)
    assert alone.chi_square() == pytest.approx(result.optimum.chi_square, rel=1e-6)
    assert rmse(vertex_distances(result.optimum.poses, truth, truth)) < 0.2


def test_wrong_closures_neither_choose_the_start_nor_bend_the_map():
    graph, truth = laps(seed=1, planar=True, wrong=10)
    assert best_start(graph) is graph.poses
    robust = reduce(graph, GEOMETRY, keep=0.4)
    trusting = reduce(graph, GEOMETRY, keep=0.4, robust=False)
    assert (robust.optimum.rejected, trusting.optimum.rejected) == (10, 0)
    for state, least, most in ((robust, 0.0, 0.1), (trusting, 1.0, np.inf)):
        error = rmse(vertex_distances(state.pruned.poses, truth, truth, planar=True))
        assert least < error < most


def test_the_chordal_start_is_exact_where_measurements_are():
    graph, truth = laps()
    exact = [
        Edge(e.source, e.target, invert(truth[e.source]) @ truth[e.target], e.covariance, e.kind)
        for e in graph.edges
    ]
    for i, pose in chordal(GraphSnapshot(graph.poses, exact)).items():
        np.testing.assert_allclose(pose, truth[i], atol=1e-6)


def test_parts_without_any_edge_between_them_are_each_held():
    graph, _ = laps(count=2)
    shifted = {i + 100: pose for i, pose in graph.poses.items()}
    more = [
        Edge(e.source + 100, e.target + 100, e.T_source_target, e.covariance, e.kind)
        for e in graph.edges
    ]
    both = GraphSnapshot(graph.poses | shifted, graph.edges + more)
    result = reduce(both, GEOMETRY, keep=0.5)
    single = reduce(graph, NoPruning(), keep=1.0)
    assert len(result.pruned.vertices) == 40
    assert {0, 100} <= set(result.pruned.vertices)
    for i, pose in single.optimum.poses.items():
        np.testing.assert_allclose(result.optimum.poses[i], pose, atol=1e-6)
        np.testing.assert_allclose(result.optimum.poses[i + 100], pose, atol=1e-6)


def test_sessions_that_only_closures_join_stay_where_the_file_puts_them():
    """The second session has no odometry from the first: true closures hold it, wrong ones lose."""
    graph, truth = laps(count=2, wrong=3, seed=2)
    edges = [edge for edge in graph.edges if (edge.source, edge.target) != (19, 20)]
    odometry = [edge.kind for edge in edges].count("odometry")
    result = reduce(GraphSnapshot(truth, edges), GEOMETRY, keep=0.5)
    assert odometry == 38
    assert result.optimum.rejected == 3
    assert rmse(vertex_distances(result.pruned.poses, truth, truth)) < 0.1


def test_dense_factors_make_a_reduction_incomplete():
    graph, _ = laps(count=2)
    assert not reduce(graph, Pruner(Geometry(1.0), Dense()), keep=0.5).complete
    assert reduce(graph, GEOMETRY, keep=0.5).complete


def test_a_graph_without_edges_is_refused():
    with pytest.raises(ConfigError, match="no edges"):
        reduce(GraphSnapshot({}, []), GEOMETRY, keep=0.5)


def test_distances_in_the_plane_see_that_a_map_is_mirrored():
    _, truth = laps(planar=True)
    lopsided = {i: pose for i, pose in truth.items() if i in (0, 3, 4, 11, 12, 13)}
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    mirrored = {i: mirror @ pose @ mirror for i, pose in lopsided.items()}
    assert rmse(vertex_distances(mirrored, lopsided, lopsided, planar=True)) > 0.5
    assert rmse(vertex_distances(mirrored, lopsided, lopsided)) < 1e-9


def test_distances_do_not_depend_on_the_frame():
    _, truth = laps()
    shift = exp(np.array([0.3, -0.2, 2.0, 10.0, 20.0, 30.0]))
    moved = {i: shift @ pose for i, pose in truth.items()}
    moved[5] = moved[5] @ exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e-6]))
    distances = vertex_distances(moved, truth, truth)
    assert distances.argmax() == 5
    assert distances[5] == pytest.approx(1e-6, rel=0.1)


def test_truth_is_read_from_every_kind_of_file(tmp_path):
    _, truth = laps(count=2)
    write_g2o(tmp_path / "vertices.g2o", GraphSnapshot(truth, []))
    edges = [Edge(i, i + 1, invert(truth[i]) @ truth[i + 1], np.eye(6), "loop") for i in range(39)]
    write_g2o(tmp_path / "edges.g2o", GraphSnapshot({}, edges))
    with (tmp_path / "edges.txt").open("w") as file:
        for edge in edges:
            T = edge.T_source_target
            rpy = gtsam.Rot3(T[:3, :3]).rpy()
            row = " ".join(repr(float(value)) for value in [*T[:3, 3], *rpy])
            file.write(f"EDGE3 {edge.source} {edge.target} {row} 1 0 0\n")
    with (tmp_path / "rows.tum").open("w") as file:
        file.write("# stamp x y z qx qy qz qw\n")
        for i, T in truth.items():
            row = [0.1 * i, *T[:3, 3], *to_quaternion(T)]
            file.write(" ".join(repr(float(value)) for value in row) + "\n")
    for name in ("vertices.g2o", "edges.g2o", "edges.txt", "rows.tum"):
        poses = read_truth(tmp_path / name, truth)
        for i, pose in truth.items():
            np.testing.assert_allclose(poses[i], pose, atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty"),
        ("EDGE2 0 1 1 0\n", "line 1: not a valid EDGE2"),
        ("EDGE2 0 1 1 0 0\nEDGE2 5 6 1 0 0\n", "such as 5"),
        ("VERTEX_SE2 2 1 2 3\n", "lacks 2 of 2 vertices, such as 0"),
        ("0.0 1 2 3 0 0 0 1\n", "1 rows for 2 vertices"),
    ],
)
def test_truth_that_does_not_fit_is_refused(tmp_path, content, message):
    (tmp_path / "truth.txt").write_text(content)
    with pytest.raises(SourceError, match=rf"truth\.txt.*{message}"):
        read_truth(tmp_path / "truth.txt", [0, 1])


@pytest.mark.parametrize("ratio", [1e9, 1e11])
def test_edges_that_hardly_know_the_attitude_have_a_start(ratio):
    graph, _ = laps(planar=True)
    loose = np.diag([1e-6 * ratio] * 3 + [1e-6] * 3)
    edges = [Edge(e.source, e.target, e.T_source_target, loose, e.kind) for e in graph.edges]
    poses = chordal(GraphSnapshot(graph.poses, edges))
    assert np.isfinite(list(poses.values())).all()
    result = reduce(GraphSnapshot(graph.poses, edges), NoPruning(), keep=1.0)
    assert result.optimum.chi_square < result.read.chi_square


def held_optimum(graph, start):
    """GTSAM's own optimum, fixed vertices being equality constraints: (4, 4) poses by vertex."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in start.items():
        values.insert(i, gtsam.Pose3(pose))
    for e in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        T = gtsam.Pose3(e.T_source_target)
        factors.push_back(gtsam.BetweenFactorPose3(e.source, e.target, T, noise))
    for prior in graph.priors:
        noise = gtsam.noiseModel.Gaussian.Covariance(prior.covariance)
        T = gtsam.Pose3(prior.T_map_vertex)
        factors.push_back(gtsam.PriorFactorPose3(prior.vertex, T, noise))
    for i in graph.fixed:
        factors.push_back(gtsam.NonlinearEqualityPose3(i, gtsam.Pose3(graph.poses[i])))
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    return {i: found.atPose3(i).matrix() for i in start}


def odometry_alone(graph):
    return [edge for edge in graph.edges if edge.kind == "odometry"]


def pose_errors(poses, expected):
    return [np.abs(log(invert(expected[i]) @ poses[i])).max() for i in expected]


@pytest.mark.parametrize("start", ["as driven", "nowhere"])
def test_fixed_vertices_hold_their_part_where_the_file_has_them(start):
    graph, truth = laps()
    shift = exp(np.array([0.1, 0.2, 2.0, 50.0, -20.0, 3.0]))
    truth = {i: shift @ pose for i, pose in truth.items()}
    fixed = (7, 30, 59)
    guess = graph.poses if start == "as driven" else dict.fromkeys(graph.poses, np.eye(4))
    poses = guess | {i: truth[i] for i in fixed}
    snapshot = GraphSnapshot(poses, odometry_alone(graph), fixed)
    result = reduce(snapshot, GEOMETRY, keep=0.3)
    expected = held_optimum(snapshot, truth)
    assert max(pose_errors(result.optimum.poses, expected)) < 1e-4
    for state in (result.optimum, result.pruned):
        assert max(pose_errors(state.poses, {i: truth[i] for i in fixed})) < 1e-6
    assert set(fixed) <= set(result.pruned.vertices)
    assert len(result.pruned.vertices) == 18
    assert result.graph.fixed == fixed


@pytest.mark.parametrize("start", ["as driven", "nowhere"])
def test_priors_pull_their_part_to_where_they_measured_it(start):
    """The map frame of the priors is far from that of the file's poses, as with UTM coordinates."""
    graph, truth = laps(planar=True)
    shift = exp(np.array([0.0, 0.0, 2.5, 0.0, 0.0, 0.0]))
    shift[:3, 3] = [4.5e5, 5.4e6, 120.0]
    rng = np.random.default_rng(3)
    covariance = np.diag([0.1] * 3 + [0.2] * 3) ** 2
    priors = tuple(
        Prior(i, shift @ truth[i] @ exp(0.05 * rng.normal(size=6)), covariance)
        for i in range(0, 60, 7)
    )
    guess = graph.poses if start == "as driven" else dict.fromkeys(graph.poses, np.eye(4))
    snapshot = GraphSnapshot(guess, graph.edges, priors=priors)
    result = reduce(snapshot, GEOMETRY, keep=0.3)
    expected = held_optimum(snapshot, {i: shift @ pose for i, pose in truth.items()})
    assert max(pose_errors(result.optimum.poses, expected)) < 1e-3
    assert max(pose_errors(result.pruned.poses, expected)) < 0.05
    assert {prior.vertex for prior in priors} <= set(result.pruned.vertices)
    assert result.graph.priors == priors
    assert result.complete


@pytest.mark.parametrize("turn", [0.0, 2.5, 3.1])
@pytest.mark.parametrize("planar", [True, False])
def test_priors_of_positions_put_a_graph_where_they_measured_it(tmp_path, planar, turn):
    """Their map is turned and far away: the attitude at the start says nothing."""
    path, _ = write_laps(tmp_path, planar=planar)
    _, truth = laps(planar=planar)
    shift = exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))
    shift[:3, 3] = [4.5e5, 5.4e6, 0.0 if planar else 120.0]
    rng = np.random.default_rng(1)
    with path.open("a") as file:
        for i in range(0, 60, 7):
            x, y, z = (shift @ truth[i])[:3, 3] + 0.1 * rng.normal(size=3)
            file.write(
                f"EDGE_PRIOR_SE2_XY {i} {x} {y} 100 0 100\n"
                if planar
                else f"EDGE_SE3_PRIORXYZ {i} {x} {y} {z} 100 0 0 100 0 100\n"
            )
    result = reduce(read_g2o(path), NoPruning(), keep=1.0).optimum
    assert result.rejected == 0
    errors = [np.linalg.norm((result.poses[i] - shift @ truth[i])[:3, 3]) for i in truth]
    assert rmse(np.array(errors)) < 0.1


def test_a_part_without_priors_stays_where_it_is():
    graph, _ = laps(count=1)
    far = exp(np.array([0.0, 0.0, 0.0, 100.0, 0.0, 0.0]))
    others = {i + 100: far @ pose for i, pose in graph.poses.items()}
    more = [
        Edge(e.source + 100, e.target + 100, e.T_source_target, e.covariance, e.kind)
        for e in graph.edges
    ]
    prior = Prior(10, graph.poses[10] @ far, 1e-4 * np.eye(6))
    both = GraphSnapshot(graph.poses | others, graph.edges + more, priors=(prior,))
    poses = reduce(both, NoPruning(), keep=1.0).optimum.poses
    assert max(pose_errors(poses, others)) < 1e-6
    assert max(pose_errors(poses, {10: prior.T_map_vertex})) < 1e-6


def test_fixed_vertices_and_priors_are_written_back(cli, tmp_path, caplog):
    caplog.set_level("INFO")
    graph, truth = laps(planar=True)
    priors = (Prior(33, truth[33], graph.edges[0].covariance),)
    given = GraphSnapshot(graph.poses | {12: truth[12]}, graph.edges, (12,), priors, planar=True)
    write_g2o(tmp_path / "in.g2o", given)
    ends = [f"graph={tmp_path / 'in.g2o'}", f"out={tmp_path / 'out.g2o'}"]
    assert cli(*ends, "keep=0.3")[0] == 0
    assert "60 vertices (1 fixed), 99 edges, 1 priors" in caplog.text
    back = read_g2o(tmp_path / "out.g2o")
    assert back.fixed == (12,)
    np.testing.assert_allclose(back.poses[12], truth[12], atol=1e-6)
    assert [prior.vertex for prior in back.priors] == [33]


def unnamed(path):
    """Take the comments that name kinds out of a file."""
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line.partition("#")[0] for line in lines) + "\n")


@pytest.mark.parametrize("closures", ["true and wrong", "wrong"])
def test_graphs_written_from_new_to_old_are_reduced_as_others_are(cli, tmp_path, caplog, closures):
    """The name of each edge's kind is gone as well: all that tells them apart is where they lead."""
    graph, truth = laps(seed=1, planar=True, wrong=10)
    loops = [edge for edge in graph.edges if edge.kind == "loop"]
    odometry = [reverse(edge) for edge in reversed(odometry_alone(graph))]
    chosen = loops if closures == "true and wrong" else loops[-10:]
    path = tmp_path / "in.g2o"
    write_g2o(path, GraphSnapshot(graph.poses, [*odometry, *chosen]))
    write_g2o(tmp_path / "truth.g2o", GraphSnapshot(truth, []))
    unnamed(path)
    out, figures = tmp_path / "out.g2o", tmp_path / "figures.json"
    ends = [f"graph={path}", f"truth={tmp_path / 'truth.g2o'}", f"out={out}", f"json={figures}"]
    assert cli(*ends)[0] == 0
    read, optimum, pruned = json.loads(figures.read_text())["states"].values()
    assert (read["loops"], read["edges"]) == (len(chosen), 59 + len(chosen))
    assert optimum["rejected"] == 10
    assert pruned["ape_all_m"] == pytest.approx(optimum["ape_all_m"], abs=0.05)
    lost = "10 of 10 loop closures are rejected, and only odometry is left"
    assert (lost in caplog.text) == (closures == "wrong")


def test_pruning_makes_composed_edges_and_no_closures(cli, tmp_path):
    path, _ = write_laps(tmp_path)
    out, figures = tmp_path / "out.g2o", tmp_path / "figures.json"
    _, shown, _ = cli(f"graph={path}", f"out={out}", f"json={figures}", "keep=0.3")
    read, optimum, pruned = json.loads(figures.read_text())["states"].values()
    assert (read["loops"], optimum["loops"], optimum["composed"]) == (40, 40, 0)
    assert pruned["loops"] < 40
    assert pruned["composed"] > 10
    (row,) = (line for line in shown.splitlines() if line.startswith("Composed edges"))
    assert row.split()[2:] == ["0", "0", str(pruned["composed"])]
    kinds = [edge.kind for edge in read_g2o(out).edges]
    assert kinds.count("composed") == pruned["composed"]
    assert kinds.count("loop") == pruned["loops"]


def test_each_part_that_outvoted_closures_led_to_keeps_a_vertex():
    """Else its last vertex would be removed, which no edge says anything about."""
    step = exp(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    ids = [*range(8), *range(20, 28)]
    edges = [Edge(i, i + 1, step, np.eye(6), "odometry") for i in ids if i not in (7, 27)]
    edges.append(Edge(7, 20, step, np.eye(6), "loop"))
    graph = loaded(GraphSnapshot(dict.fromkeys(ids, np.eye(4)), edges))
    graph._rejected = set(graph._loops)
    graph._solve(set())
    GEOMETRY.reduce(graph, 1)
    assert graph.vertices == [0, 20]


def test_what_no_edge_reaches_stays_and_is_not_judged(cli, tmp_path, caplog):
    graph, _ = laps(planar=True)
    plain, figures, out = (tmp_path / name for name in ("plain.json", "f.json", "out.g2o"))
    path, true = write_laps(tmp_path, planar=True)
    cli(f"graph={path}", f"truth={true}", f"json={plain}", "pruning=none")
    lone = planar_poses(np.array([[500.0, 5.0, 1.0]]))[0]
    write_g2o(path, GraphSnapshot(graph.poses | {1000: lone}, graph.edges))
    ends = [f"graph={path}", f"truth={true}", f"json={figures}", f"out={out}"]
    assert cli(*ends, "keep=0.4")[0] == 0
    assert "no edges lead to 1 of 61 vertices, such as 1000" in caplog.text
    (_, alone, _), (_, optimum, pruned) = (
        json.loads(file.read_text())["states"].values() for file in (plain, figures)
    )
    assert optimum["ape_all_m"] == pytest.approx(alone["ape_all_m"], rel=1e-6)
    assert pruned["vertices"] == 24
    np.testing.assert_allclose(read_g2o(out).poses[1000], lone, atol=1e-12)


def test_vertices_that_the_truth_lacks_are_not_judged(cli, tmp_path, caplog):
    _, truth = laps(planar=True)
    path, true = write_laps(tmp_path, planar=True)
    known = {i: pose for i, pose in truth.items() if i >= 15}
    write_g2o(true, GraphSnapshot(known, []))
    figures = tmp_path / "f.json"
    ends = [f"graph={path}", f"truth={true}", f"json={figures}"]
    assert cli(*ends, "pruning=none")[0] == 0
    assert "lacks 15 of 60 vertices, such as 0: the other 45 are judged" in caplog.text
    _, optimum, _ = json.loads(figures.read_text())["states"].values()
    _, poses = gtsam_optimum(path, spatial=False)
    expected = rmse(vertex_distances(poses, known, known, planar=True))
    assert optimum["ape_all_m"] == pytest.approx(expected, abs=1e-4)


def test_two_robots_with_symbols_for_ids_are_told_apart(cli, tmp_path):
    graph, _ = laps(count=2)
    robots = [ord(letter) << 56 for letter in "ab"]
    poses = {first + i: pose for first in robots for i, pose in graph.poses.items()}
    edges = [
        Edge(first + e.source, first + e.target, e.T_source_target, e.covariance, e.kind)
        for first in robots
        for e in graph.edges
    ]
    meeting = Edge(robots[0] + 39, robots[1], invert(graph.poses[39]), edges[0].covariance, "loop")
    path, out, figures = (tmp_path / name for name in ("in.g2o", "out.g2o", "f.json"))
    write_g2o(path, GraphSnapshot(poses, [meeting, *edges]))
    unnamed(path)
    assert cli(f"graph={path}", f"out={out}", f"json={figures}", "keep=0.5")[0] == 0
    read, _, pruned = json.loads(figures.read_text())["states"].values()
    assert (read["edges"], read["loops"]) == (2 * 59 + 1, 2 * 20 + 1)
    assert pruned["vertices"] == len(read_g2o(out).poses) == 40


def test_a_graph_whose_edges_do_not_know_everything_is_reduced(cli, tmp_path, caplog):
    """A third of the edges, odometry among them, say nothing of z, or claim less than nothing."""
    path, true = write_laps(tmp_path)
    lines = path.read_text().splitlines()
    edges = [i for i, line in enumerate(lines) if line.startswith("EDGE")]
    for k, i in enumerate(edges[::3]):
        fields = lines[i].split()
        fields[10 + 11] = "0.0" if k % 2 else "-3.0"  # the information of z
        lines[i] = " ".join(fields)
    path.write_text("\n".join(lines) + "\n")
    out, figures = tmp_path / "out.g2o", tmp_path / "f.json"
    ends = [f"graph={path}", f"truth={true}", f"out={out}", f"json={figures}"]
    assert cli(*ends, "keep=0.4")[0] == 0
    assert caplog.text.count("isn't positive definite") == 1
    assert "33 of 99 edges" in caplog.text
    _, optimum, pruned = json.loads(figures.read_text())["states"].values()
    assert optimum["rejected"] == 0
    assert optimum["ape_all_m"] < 0.3
    assert pruned["ape_all_m"] < 1.3 * optimum["ape_all_m"]
    back = read_g2o(out)
    assert np.isfinite([edge.covariance for edge in back.edges]).all()


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "half"), [("intel", 22.502), ("manhattan3500", 73.039), ("sphere2500", 675.701)]
)
def test_public_graphs_reach_the_optimum_of_gtsam(name, half):
    path = DATA / f"{name}.g2o"
    graph = read_g2o(path)
    expected, poses = gtsam_optimum(path, spatial=not graph.planar)
    assert expected == pytest.approx(half, abs=1e-3)
    state = reduce(graph, NoPruning(), keep=1.0).optimum
    assert state.rejected == 0
    assert state.chi_square / 2 == pytest.approx(half, abs=1e-3)
    assert vertex_distances(state.poses, poses, poses, graph.planar).max() < 0.02


@needs_data
@pytest.mark.data
def test_every_true_edge_of_the_sphere_agrees_with_the_chained_truth():
    """So that the order of roll, pitch and yaw is right: half of the edges aren't in the chain."""
    graph = read_g2o(DATA / "sphere2500.g2o")
    path = DATA / "sphere2500_groundtruth.txt"
    truth = read_truth(path, graph.poses)
    errors = []
    for line in path.read_text().splitlines():
        _, source, target, *numbers = line.split()
        x, y, z, roll, pitch, yaw = map(float, numbers[:6])
        T = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([x, y, z])).matrix()
        errors.append(log(invert(T) @ invert(truth[int(source)]) @ truth[int(target)]))
    assert len(errors) == 4949
    assert np.abs(errors).max() < 1e-2


@needs_data
@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("manhattan3500", "manhattan3500_groundtruth.txt"),
        ("sphere2500", "sphere2500_groundtruth.txt"),
        ("intel", None),
    ],
)
def test_public_graphs_keep_their_accuracy_with_a_third_of_their_vertices(name, truth):
    graph = read_g2o(DATA / f"{name}.g2o")
    result = reduce(graph, GEOMETRY, keep=1 / 3)
    stay, pruned, optimum = result.pruned.vertices, result.pruned.poses, result.optimum.poses
    assert len(stay) == round(len(graph.poses) / 3)
    if truth is None:
        assert vertex_distances(pruned, optimum, stay, graph.planar).mean() < 0.03
    else:
        true = read_truth(DATA / truth, graph.poses)
        apes = [rmse(vertex_distances(p, true, stay, graph.planar)) for p in (pruned, optimum)]
        assert apes[0] < 1.1 * apes[1]


@needs_data
@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("strictness", ["1.00", "0.25"])
def test_wrong_closures_of_a_real_drive_are_rejected(strictness):
    graph = read_g2o(DATA / f"kitti_00_alpha_{strictness}.g2o")
    truth = read_truth(DATA / "kitti_00_GT.g2o", graph.poses)
    result = reduce(graph, GEOMETRY, keep=1 / 3)
    for state in (result.optimum, result.pruned):
        assert rmse(vertex_distances(state.poses, truth, truth, planar=True)) < 2.2


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(("window", "share"), [("0-300", 10), ("500-800", 30), ("1000-1300", 20)])
def test_of_a_public_graph_with_wrong_closures_only_the_true_ones_count(window, share):
    graph = robustness.cut(read_g2o(DATA / "manhattan3500.g2o"), window, sigmas=1.0)
    truth = read_truth(DATA / "manhattan3500_groundtruth.txt", graph.poses)
    row = robustness.measure(graph, truth, window, share, seed=7)
    assert row.wrong > 5
    assert row.ape["ours"] <= 1.3 * row.bar < row.ape["odometry"]
    assert row.ape["least squares"] > 10 * row.bar


@needs_cases
@pytest.mark.data
@pytest.mark.parametrize(
    ("drive", "strictness", "most"),
    [("05", "0.25", 2.7), ("02", "0.25", 5.8), ("02", "0.50", 5.8), ("02", "1.00", 5.8)],
)
def test_true_closures_of_a_real_drive_are_found_among_many_wrong_ones(drive, strictness, most):
    graph = read_g2o(CASES / f"kitti_{drive}_alpha_{strictness}.g2o")
    truth = read_truth(CASES / f"kitti_{drive}_GT.g2o", graph.poses)
    poses = reduce(graph, NoPruning(), keep=1.0).optimum.poses
    assert rmse(vertex_distances(poses, truth, truth, planar=True)) < most


@needs_cases
@pytest.mark.data
def test_all_true_closures_of_a_very_long_corridor_come_in():
    """From odometry Levenberg-Marquardt ends in a minimum of 770; the error's frame is GTSAM's."""
    state = reduce(read_g2o(CASES / "MIT.g2o"), NoPruning(), keep=1.0).optimum
    assert (state.loops, state.rejected) == (20, 0)
    assert state.chi_square == pytest.approx(41.207, abs=0.01)


@needs_cases
@pytest.mark.data
@pytest.mark.slow
def test_a_graph_that_claims_to_know_little_stays_where_it_is_when_pruned():
    result = reduce(read_g2o(CASES / "parking-garage.g2o"), GEOMETRY, keep=0.33)
    stay = result.pruned.vertices
    moved = vertex_distances(result.pruned.poses, result.optimum.poses, stay)
    assert len(stay) == pytest.approx(0.33 * 1661, abs=1)
    assert moved.mean() < 0.3
