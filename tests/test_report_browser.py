"""Reports as headless Chromium shows them: quiet, offline, with controls that work."""

import re
import shutil
import time

import numpy as np
import pytest
from comparison_support import errors, write_run, write_trajectories
from report_support import some_evidence, some_verdicts

from eval.comparison.report import write_report
from eval.comparison.runs import find_runs
from eval.comparison.tables import make_tables
from eval.evaluation import Verdict
from eval.report.run_report import write_run_report

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install .[dev]")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's package chromium")

NASTY = "<img src=x onerror='window.hacked = true'><script>window.hacked = true</script>"
CHART = ".drawing:has(h4:text-is('Position error over time'))"
SCREEN = {"width": 1000, "height": 800}
FROM_ABOVE = ".drawing:has(h4:text-is('Trajectories'))"


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    evidence = some_evidence(run={"choices": {"scenario": NASTY}})
    verdicts = some_verdicts(evidence)
    verdicts.append(Verdict(verdicts[0].metric, None, NASTY))
    write_run_report(path, evidence, verdicts, f"name: {NASTY}\nlong: {'x' * 500}\n")
    return path.as_uri()


@pytest.fixture(scope="module")
def shared(browser, report):
    return opened(browser, report)


@pytest.fixture
def page(shared):
    """The page as it opens; drawing it takes seconds, so it is put back rather than opened again."""
    yield shared
    shared.set_viewport_size(SCREEN)
    shared.emulate_media(color_scheme="light")
    for pressed in shared.locator(".tools [aria-pressed=true]").all():
        pressed.click()
    for reset in shared.locator("[data-act=reset]").all():
        reset.click()


def opened(browser, address, **options):
    page = browser.new_page(**{"viewport": SCREEN, **options})
    page.messages, page.requests = [], []
    page.on("console", lambda message: page.messages.append(message.text))
    page.on("pageerror", lambda error: page.messages.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    page.goto(address)
    page.wait_for_selector("html[data-ready]", timeout=60_000)
    return page


def ranges(page, figure=CHART):
    """Return what a chart shows: the ends of its x and y axis."""
    plot = page.locator(f"{figure} .plot")
    return plot.evaluate("plot => [plot.layout.xaxis.range, plot.layout.yaxis.range].flat()")


def wait_until(condition, seconds=10):
    """Wait for the browser; pages forbid the strings that playwright's own waiting evaluates."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


def background(page):
    return page.locator(f"{CHART} .plot").evaluate("plot => plot.layout.paper_bgcolor")


def press(page, control, figure=CHART):
    page.locator(f"{figure} [data-act={control}]").click()


def middle(page, figure=CHART):
    """Scroll to a chart and return where its middle is on the screen."""
    area = page.locator(f"{figure} .nsewdrag")
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_reports_open_without_errors_or_requests(page, report):
    assert page.messages == []
    assert page.requests == [report]


def test_every_chart_is_drawn(page):
    drawings = page.locator(".drawing")
    assert drawings.count() == 6
    for i in range(drawings.count()):
        assert drawings.nth(i).locator(".plot .main-svg").count() > 0
        assert (
            drawings.nth(i).locator(".plot :is(.scatterlayer .trace, .heatmaplayer image)").count()
        )


def test_names_run_nothing(page):
    assert page.evaluate("window.hacked") is None
    assert NASTY in page.locator("h1").inner_text()


def test_gaps_in_curves_stay_gaps(page):
    assert page.locator(f"{CHART} .js-line").count() == 2 * 2  # curves, pieces of each


def test_buttons_zoom_and_reset(page):
    low, high, *_ = whole = ranges(page)
    press(page, "in")
    assert ranges(page)[:2] == pytest.approx([low + (high - low) / 4, high - (high - low) / 4])
    press(page, "out")
    assert ranges(page) == pytest.approx(whole)
    press(page, "in")
    press(page, "reset")
    assert ranges(page) == pytest.approx(whole)


def test_keys_zoom_move_and_reset(page):
    whole = ranges(page)
    page.locator(f"{CHART} .plot").focus()
    page.keyboard.press("+")
    zoomed = ranges(page)
    assert zoomed[1] - zoomed[0] == pytest.approx((whole[1] - whole[0]) / 2)
    page.keyboard.press("ArrowRight")
    assert ranges(page)[0] > zoomed[0]
    page.keyboard.press("0")
    assert ranges(page) == pytest.approx(whole)


def test_dragging_zooms_or_moves(page):
    whole = ranges(page)
    x, y = middle(page)

    def drag():
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 150, y + 60, steps=4)
        page.mouse.up()

    drag()
    zoomed = ranges(page)
    assert zoomed[1] - zoomed[0] < 0.5 * (whole[1] - whole[0])
    press(page, "reset")
    press(page, "drag")
    drag()
    moved = ranges(page)
    assert moved[0] < whole[0]
    assert moved[1] - moved[0] == pytest.approx(whole[1] - whole[0])


def test_the_wheel_scrolls_the_page_and_zooms_with_ctrl(page):
    page.mouse.move(*middle(page))
    whole, top = ranges(page), page.evaluate("scrollY")
    page.mouse.wheel(0, 40)
    wait_until(lambda: page.evaluate("scrollY") > top)
    assert ranges(page) == whole
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)
    page.keyboard.up("Control")
    wait_until(lambda: ranges(page)[1] < whole[1])


def test_hovering_tells_values(page):
    page.mouse.move(*middle(page))
    label = page.locator(f"{CHART} .hoverlayer").get_by_text("reference")
    label.wait_for()
    assert re.search(r"reference : [\d.]+ m", label.text_content())
    x, y = middle(page, FROM_ABOVE)
    dot = page.locator(f"{FROM_ABOVE} .scatterlayer .point").last.bounding_box()
    page.mouse.move(x, y)
    page.mouse.move(dot["x"] + 5, dot["y"] + 5)
    page.locator(f"{FROM_ABOVE} .hoverlayer").get_by_text("end").wait_for()


def test_the_legend_hides_curves(page):
    lines = page.locator(f"{CHART} .js-line")
    button = page.locator(f"{CHART} .legend button").first
    assert lines.count() == 4
    button.click()
    assert lines.count() == 2
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    assert lines.count() == 4


def test_charts_are_saved_as_images(page):
    with page.expect_download() as saved:
        press(page, "save")
    assert saved.value.suggested_filename == "Position_error_over_time.png"
    assert page.messages == []


def test_maps_and_paths_have_one_scale(page):
    plot = page.locator(f"{FROM_ABOVE} .plot")
    width, height = plot.evaluate("p => [p._fullLayout.xaxis._length, p._fullLayout.yaxis._length]")
    low_x, high_x, low_y, high_y = ranges(page, FROM_ABOVE)
    assert (high_x - low_x) / width == pytest.approx((high_y - low_y) / height, rel=0.01)


@pytest.mark.parametrize("width", [360, 768, 1440])
def test_nothing_is_wider_than_the_screen(page, width):
    page.set_viewport_size({"width": width, "height": 800})
    widths = "p => [p.querySelector('.main-svg').width.baseVal.value, p.clientWidth]"
    for plot in page.locator(".plot").all():
        wait_until(lambda plot=plot: abs(np.diff(plot.evaluate(widths))) < 2)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    tools = page.locator(f"{CHART} .tools").bounding_box()
    assert tools["x"] + tools["width"] <= width


def test_charts_follow_the_system_into_the_dark_and_keep_their_zoom(page):
    bright = background(page)
    press(page, "in")
    zoomed = ranges(page)
    page.emulate_media(color_scheme="dark")
    wait_until(lambda: background(page) != bright)
    assert brightness(background(page)) < 60 < 200 < brightness(bright)
    assert ranges(page) == pytest.approx(zoomed)


def test_a_button_switches_between_light_and_dark(page):
    button = page.locator("#theme")
    bright = background(page)
    button.click()
    assert brightness(background(page)) < 60
    assert button.inner_text() == "Light"
    button.click()
    assert background(page) == bright


@pytest.mark.slow
def test_paper_is_light_without_controls_and_cuts_nothing(browser, report):
    page = opened(browser, report, color_scheme="dark", viewport={"width": 1440, "height": 900})
    page.evaluate(
        """addEventListener("beforeprint", () => {
            const plots = [...document.querySelectorAll(".plot")];
            window.onPaper = {
                widths: plots.map((p) => p.querySelector(".main-svg").width.baseVal.value),
                backgrounds: plots.map((p) => p.layout.paper_bgcolor),
            };
        })"""
    )
    pdf = page.pdf(format="A4")
    assert pdf.startswith(b"%PDF")
    seen = page.evaluate("window.onPaper")
    millimetre = 96 / 25.4
    assert 0 < max(seen["widths"]) <= 178 * millimetre
    assert all(brightness(colour) > 200 for colour in seen["backgrounds"])
    page.emulate_media(media="print", color_scheme="dark")
    page.wait_for_selector("html[data-paper]")
    assert not page.locator(".tools button, #theme").first.is_visible()
    assert page.locator(f"{CHART} .legend button").first.is_visible()
    page.emulate_media(media="screen", color_scheme="dark")
    page.wait_for_selector("html:not([data-paper])")
    assert brightness(background(page)) < 60
    page.close()


def test_without_scripts_numbers_and_tables_are_there(browser, report):
    page = browser.new_page(java_script_enabled=False)
    page.goto(report)
    assert page.get_by_text("Charts need JavaScript").is_visible()
    assert page.locator(".value", has_text="0.1235").is_visible()
    assert page.get_by_text("error: 0.").is_visible()
    assert not page.locator(".tools").first.is_visible()
    page.close()


def test_phones_scroll_over_charts(browser, report):
    page = opened(
        browser, report, has_touch=True, is_mobile=True, viewport={"width": 390, "height": 800}
    )
    assert page.locator(f"{CHART} .plot").evaluate("plot => plot.layout.dragmode") is False
    press(page, "drag")
    assert page.locator(f"{CHART} .plot").evaluate("plot => plot.layout.dragmode") == "pan"
    page.close()


def test_comparisons_are_quiet_and_fit_a_phone(browser, tmp_path):
    """Paths whose labels ask for more room on a phone, and for less when they have it."""
    for width, height in [(25, 25), (33, 33), (35, 23.1), (50, 50), (70, 46.2), (80, 40)]:
        folder = write_run(tmp_path / f"{width}", [f"scenario.laps={width}"], errors(0.1))
        path = [[0, 0, 0], [0.3 * width, height, 0], [width, 0.4 * height, 0]]
        write_trajectories(folder, np.array(path))
    runs = find_runs([tmp_path])
    write_report(tmp_path / "report.html", runs, make_tables(runs.finished))
    address = (tmp_path / "report.html").as_uri()
    page = opened(browser, address, is_mobile=True, viewport={"width": 390, "height": 800})
    assert page.locator(".plot .scatterlayer").count() == 6
    assert (page.messages, page.requests) == ([], [address])
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.close()


def brightness(colour):
    red, green, blue = (float(part) for part in re.findall(r"[\d.]+", colour)[:3])
    return 0.3 * red + 0.6 * green + 0.1 * blue
