"""Statistics and pictures of the pruning ablation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.ablation import (
    COLUMNS,
    Run,
    extrapolate,
    map_error,
    position_rmse,
    rows,
    summarise,
)
from eval.ablation_plots import PANELS, overview, save, single
from eval.statistics import spread

HOURS = np.array([0.5, 1.0, 1.5, 2.0, 2.5])
RNG = np.random.default_rng(0)
PLACES = RNG.uniform(-10, 10, (50, 3))


def made_run(method, wrong=0.0, seed=0, positions=PLACES, **curves):
    """Return a run whose curves are one everywhere but for those given."""
    ones = {column: np.ones(len(HOURS)) for column in COLUMNS} | {"hours": HOURS}
    return Run(
        method, wrong, seed, ones | {k: np.asarray(v, float) for k, v in curves.items()}, positions
    )


def test_spread_is_the_textbook_confidence_interval():
    # Student's t with 2 degrees of freedom: 4.3027; standard error 1 / sqrt(3).
    figures = spread([1.0, 2.0, 3.0])
    assert figures["mean"] == 2.0
    assert figures["std"] == 1.0
    assert figures["ci95"] == pytest.approx([2 - 4.302653 / np.sqrt(3), 2 + 4.302653 / np.sqrt(3)])


def test_a_single_value_has_no_spread():
    assert spread([3.0]) == {"mean": 3.0, "std": None, "ci95": None, "values": [3.0]}


def test_the_fit_continues_linear_and_quadratic_growth_exactly():
    seconds = 2 * HOURS + 3 * HOURS**2
    measured = np.where(HOURS > 1.5, np.nan, seconds)
    assert extrapolate(HOURS, measured) == pytest.approx(seconds)


def test_the_fit_leaves_what_was_measured_alone_and_never_falls():
    measured = np.array([5.0, 5.5, 7.0, np.nan, np.nan])
    filled = extrapolate(HOURS, measured)
    assert np.array_equal(filled[:3], measured[:3])
    assert filled[4] > filled[3] > 0


def test_errors_are_free_of_where_the_map_lies():
    R = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    moved = PLACES @ R.T + [5, 6, 7]
    assert map_error(moved, PLACES) == pytest.approx(0, abs=1e-12)
    assert position_rmse(moved, PLACES) == pytest.approx(0, abs=1e-12)


def test_errors_of_a_stretched_square_are_as_computed_by_hand():
    square = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    stretched = square * [1.1, 1.0, 1.0]  # no rigid motion can undo it
    assert map_error(stretched, square) == pytest.approx(0.1)
    assert position_rmse(stretched, square) == pytest.approx(0.1)


def test_comparisons_are_made_seed_by_seed():
    runs = [
        made_run("none", seed=0, ape_m=[1, 1, 1, 1, 1.0], back_end_s=[1, 2, 3, 4, 100.0]),
        made_run("none", seed=1, ape_m=[1, 1, 1, 1, 2.0], back_end_s=[1, 2, 3, 4, 200.0]),
        made_run("geometry", seed=0, ape_m=[1, 1, 1, 1, 1.5], back_end_s=[1, 1, 1, 1, 2.0]),
        made_run("geometry", seed=1, ape_m=[1, 1, 1, 1, 4.0], back_end_s=[1, 1, 1, 1, 2.0]),
        made_run("geometry", wrong=0.1, seed=1, ape_m=[1, 1, 1, 1, 5.0]),
    ]
    none, geometry, wrong = summarise(runs)
    assert "ape" not in none["compared"]
    assert geometry["compared"]["ape"]["values"] == [1.5, 2.0]
    assert geometry["compared"]["speed_up"]["values"] == [50.0, 100.0]
    assert geometry["final"]["ape_m"]["mean"] == 2.75
    assert wrong["compared"]["ape_of_wrong"]["values"] == [1.25]
    assert "speed_up" not in wrong["compared"]  # no unpruned run with as many wrong closures


def test_growth_is_that_since_a_fifth_of_the_run():
    (entry,) = summarise(
        [made_run("none", vertices=[100, 200, 300, 400, 500], cells=[4, 4, 5, 5, 6])]
    )
    assert entry["compared"]["vertices"]["mean"] == 5.0
    assert entry["compared"]["cells"]["mean"] == 1.5


def test_fitted_rows_are_marked():
    table = rows([made_run("none", back_end_s=[1, 4, np.nan, np.nan, np.nan])])
    assert [row["back_end_fitted"] for row in table] == [False, False, True, True, True]
    assert np.isfinite([row["back_end_s"] for row in table]).all()
    assert table[0]["hours"] == 0.5


def test_the_fitted_part_is_drawn_dashed_and_each_method_has_one_label():
    runs = [
        made_run("none", seed=0, back_end_s=[1, 4, 9, np.nan, np.nan]),
        made_run("none", seed=1, back_end_s=[1, 4, np.nan, np.nan, np.nan]),
        made_run("geometry", seed=0),
        made_run("geometry", seed=1),
    ]
    (axes,) = single(runs, next(p for p in PANELS if p.column == "back_end_s")).axes
    lines = {line.get_label(): line for line in axes.lines}
    assert set(lines) == {"none", "none, fitted", "geometry"}
    assert lines["none"].get_xdata().tolist() == [0.5, 1.0]  # as far as both seeds were measured
    assert lines["none, fitted"].get_xdata()[0] == 1.0
    assert len(overview(runs, "title").axes) == len(PANELS)


def test_pictures_are_saved_as_png_and_svg(tmp_path):
    save(single([made_run("none")], PANELS[0]), tmp_path / "wrong0.1_vertices")
    assert (tmp_path / "wrong0.1_vertices.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "wrong0.1_vertices.svg").read_text()
