"""Pages of runs: what they say, and that nothing in them leads outside."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from report_support import array, some_evidence, some_verdicts, unpacked

from eval import plots
from eval.evaluation import Verdict
from eval.metrics.metric import Curve, Plot
from eval.report import charts, views
from eval.report.encoding import pack, plotly_js, thin
from eval.report.page import Page
from eval.report.run_report import write_run_report

NASTY = "</script><script>window.hacked = true</script><img src=x onerror='window.hacked = true'>"


def written(path, evidence, verdicts, config=""):
    write_run_report(path, evidence, verdicts, config)
    return path.read_text()


@given(
    arrays(float, st.integers(0, 400), elements=st.sampled_from([np.nan, -2.0, 0.0, 1.0, 3.0])),
    st.integers(4, 60),
)
def test_thinned_curves_keep_extremes_ends_and_gaps(values, limit):
    kept = thin(values, limit)
    assert len(kept) <= max(limit, 0)
    assert (np.diff(kept) > 0).all()
    if len(values):
        assert kept[0] == 0 or not np.isnan(values[kept]).all()
        assert kept[-1] == len(values) - 1
        assert np.isnan(values[kept]).any() == np.isnan(values).any()
        finite = values[~np.isnan(values)]
        if len(finite):
            chosen = values[kept]
            assert np.nanmin(chosen) == finite.min()
            assert np.nanmax(chosen) == finite.max()


@given(arrays(float, (7, 3), elements=st.floats(-1e7, 1e7) | st.just(np.nan) | st.just(np.inf)))
def test_packed_arrays_come_back_as_precisely_as_can_be_drawn(values):
    (typed,) = unpacked(f'<script type="application/gzip">{pack(values)}</script>')
    finite = np.isfinite(values)
    back = array(typed)
    assert (np.isfinite(back) == finite).all()
    spread = np.ptp(values[finite]) if finite.any() else 0
    assert np.abs(back[finite] - values[finite]).max(initial=0) <= 1e-5 * spread


def test_large_coordinates_keep_their_centimetres():
    easting = 691_000 + np.linspace(0, 1, 101)
    (typed,) = unpacked(f'<script type="application/gzip">{pack(easting)}</script>')
    assert np.allclose(array(typed), easting, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.021594, "0.02159"),
        (1234.56, "1,235"),
        (69.0, "69"),
        (0.0, "0"),
        (np.float32(0.5), "0.5000"),
        (1e-7, "1.000e-07"),
        (np.int64(12345), "12,345"),
        (-np.inf, "-\N{INFINITY}"),
        (np.nan, "\N{EN DASH}"),
        (None, "\N{EN DASH}"),
        (True, "yes"),
        ([1.0, None], "[1, \N{EN DASH}]"),
    ],
)
def test_values_are_shown_with_four_digits(value, shown):
    assert charts.show(value) == shown


def test_tables_group_the_headers_of_rows_and_columns():
    columns = pd.MultiIndex.from_product([["MAE", "max"], ["bosch", "velodyne"]])
    index = pd.MultiIndex.from_tuples([("A", 0), ("A", 1), ("B", 0)], names=["scenario", "seed"])
    html = charts.table(pd.DataFrame(np.arange(12.0).reshape(3, 4), index, columns))
    assert re.findall(r'colspan="(\d)"[^>]*>(\w+)<', html)[:2] == [("2", "MAE"), ("2", "max")]
    assert re.findall(r'rowspan="(\d)">(\w+)<', html)[:2] == [("2", "A"), ("1", "0")]
    assert html.count(">A<") == 1
    assert html.count('<td class="number">') == 12


def test_tables_align_text_and_numbers():
    frame = pd.DataFrame(
        {
            "name": ["one", "2nd"],
            "error": [0.1, None],
            "text": ["0.3 ± 0.1", "1 ★"],
            "some": ["0.7", ""],
            "none": ["", ""],
        }
    )
    html = charts.table(frame)
    assert "<td>one</td>" in html
    assert '<td class="number">\N{EN DASH}</td>' in html
    assert '<td class="number">0.3 ± 0.1</td>' in html
    assert '<td class="number">0.7</td>' in html
    assert '<td class="number"></td>' in html
    assert "<td></td>" in html
    assert 'scope="row"' not in html


def test_headline_figures_say_which_way_is_better():
    cards = [
        charts.Card("Error", 0.5, "m", "How far off.", True),
        charts.Card("F-score", None, "", "How complete.", False, "there is no reference"),
        charts.Card("Vertices", 69.0, "", "How many.", None),
    ]
    html = charts.figures(cards)
    assert html.count("less is better") == html.count("more is better") == 1
    for words in ("How far off.", "there is no reference", ">0.5000 <", ">69<"):
        assert words in html


def test_a_run_report_has_every_part(tmp_path):
    evidence = some_evidence()
    html = written(tmp_path / "report.html", evidence, some_verdicts(evidence), "seed: 7\n")
    for words in (
        "Scenario E · bosch · lifelong",
        "0.1235",  # headline
        "the path is nearly a straight line",  # warning
        "F score: the reference map is empty",  # reason
        "What position_error tells. Less is better.",
        "percentiles_m / 95",
        "machine / cpu",
        "seed: 7",
    ):
        assert words in html
    titles = re.findall(r"<h4>(.*?)</h4>\s*<div class=\"tools\"", html)
    assert titles == [
        "Trajectories",
        "Height profile",
        "Error along the path",
        "Position error over time",
        "Map by its distance to the reference",
        "Time per stage",
    ]


def test_without_reference_a_run_report_shows_path_and_heights(tmp_path):
    evidence = some_evidence(reference=False)
    verdicts = [Verdict(v.metric, None, "there is no reference") for v in some_verdicts(evidence)]
    html = written(tmp_path / "report.html", evidence, verdicts)
    assert "Error along the path" not in html
    assert "Position error, Map distance, F score, Time per scan: there is no reference" in html
    trajectories, _, heights = unpacked(html)
    composed, loops, estimate = trajectories["data"][:3]
    named = [trace.get("name") for trace in (composed, loops, estimate)]
    assert named == ["composed edges", "loop closures", "estimate"]
    assert composed["line"]["color"] != loops["line"]["color"]
    assert np.nanmax(array(heights["data"][0]["z"])) > 1


def test_on_paper_closures_and_composed_edges_are_named_and_told_apart():
    evidence = some_evidence()
    figure = plots.trajectory(evidence.estimate, evidence.comparison, evidence.graph)
    drawn = {line.get_label(): line.get_color() for line in figure.axes[0].lines}
    assert drawn["1 loop closure"] != drawn["1 composed edge"]


@pytest.mark.parametrize("points", [0, 1])
def test_maps_without_extent_have_a_view(tmp_path, points):
    evidence = some_evidence(points=points)
    html = written(tmp_path / "report.html", evidence, some_verdicts(evidence))
    assert ("The map is empty." in html) == (points == 0)


def test_evidence_without_run_takes_its_title_from_the_folder(tmp_path):
    html = written(tmp_path / "drive" / "report.html", some_evidence(run={}), [])
    assert "<h1>drive</h1>" in html


def test_map_cells_show_the_mean_distance():
    points = np.array([[0, 0, 5], [0.01, 0, 7], [40, 10, 6]], dtype=np.float32).repeat(1000, axis=0)
    (spec,) = unpacked(views.map_by_distance(points, np.array([0.1, 0.3, 0.5]).repeat(1000)))
    cells = array(spec["data"][0]["z"])
    assert sorted(cells[np.isfinite(cells)]) == pytest.approx([0.2, 0.5])


def test_stacked_curves_are_thinned_at_the_same_places():
    x = np.arange(20_000.0)
    rng = np.random.default_rng(0)
    curves = tuple(Curve(name, x, rng.random(len(x))) for name in "ab")
    (spec,) = unpacked(charts.chart(Plot("t", "x", "y", curves, stacked=True)))
    first, second = (array(trace["x"]) for trace in spec["data"])
    assert len(first) <= 5000
    assert (first == second).all()


def test_a_single_peak_does_not_flatten_a_stack():
    y = np.full(1000, 10.0)
    y[1] = 4000
    html = charts.chart(Plot("t", "scan", "time [ms]", (Curve("a", np.arange(1000.0), y),), True))
    (spec,) = unpacked(html)
    assert spec["layout"]["yaxis"]["range"][1] < 20
    assert "Peaks of up to 4,000" in html


def test_charts_tell_those_who_cannot_see_them_what_they_show():
    curves = (Curve("a", np.arange(3.0), np.array([1.0, np.nan, 2.5])),)
    html = charts.chart(Plot("Error", "time [s]", "error [m]", curves))
    assert 'aria-label="Error: error [m] over time [s]. a: 1 to 2.500."' in html


def test_names_are_escaped_wherever_they_come_from(tmp_path):
    evidence = some_evidence(run={"choices": {"scenario": NASTY}, NASTY: NASTY})
    verdicts = some_verdicts(evidence)
    verdicts.append(Verdict(verdicts[0].metric, None, NASTY))
    html = written(tmp_path / "report.html", evidence, verdicts, f"name: {NASTY}")
    assert "<img" not in html
    assert "<script>window" not in html
    curve = Curve(NASTY, np.arange(2.0), np.arange(2.0))
    chart = charts.chart(Plot(NASTY, NASTY, NASTY, (curve, curve)))
    (spec,) = unpacked(chart)
    assert "<" not in spec["data"][0]["name"]
    assert "<" not in spec["layout"]["xaxis"]["title"]["text"]
    assert "<img" not in chart


def test_pages_refer_to_nothing_outside(tmp_path):
    evidence = some_evidence()
    html = written(tmp_path / "report.html", evidence, some_verdicts(evidence))
    text = re.sub(r'<script type="application/gzip".*?</script>', "", html)
    assert not re.findall(r"https?:|//\w", text)
    assert all(
        link.startswith(("#", "data:")) for link in re.findall(r'(?:src|href)="(.*?)"', text)
    )
    assert "@import" not in html
    assert "url(" not in html
    assert "default-src 'none'" in html


def test_pages_are_small_however_long_the_run(tmp_path):
    count = 100_000
    x = np.linspace(0, 1, count)
    rng = np.random.default_rng(0)
    curves = tuple(Curve(str(i), x, rng.random(count)) for i in range(6))
    points = rng.normal(size=(300_000, 3)).astype(np.float32) * 50
    blocks = [charts.chart(Plot("t", "x", "y", curves)) for _ in range(10)]
    page = Page("long").add("all", "", *blocks, views.map_by_height(points))
    page.write(tmp_path / "report.html")
    assert len(plotly_js()) < 2.5e6
    assert (tmp_path / "report.html").stat().st_size < 8e6


def test_pages_are_the_same_each_time(tmp_path):
    evidence = some_evidence()
    pages = [
        written(tmp_path / "run" / name, evidence, some_verdicts(evidence)) for name in ("a", "b")
    ]
    assert pages[0] == pages[1]
