"""The page in a real browser: it loads without a complaint, draws its plots, and switches particles."""

import os
import shutil

import pytest
from results_folder import NAMES

CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (set CHROMIUM to its path)"),
]
SIZES = {"desktop": (1280, 900), "phone": (360, 740)}
DRAWN = """id => {
  const canvases = [];
  const search = (root) => root.querySelectorAll("*").forEach((one) => {
    if (one.tagName === "CANVAS") canvases.push(one);
    if (one.shadowRoot) search(one.shadowRoot);
  });
  search(document.getElementById(id));
  return canvases.map((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const colours = new Set();
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] > 200) colours.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
    }
    return colours.size;
  });
}"""
POINTS = "Bokeh.documents[0].get_model_by_name('points').data"
RANGE = "(() => { const r = Bokeh.documents[0].get_model_by_name('curve').x_range; return r.end - r.start; })()"

MIDDLE_POINT = """() => {
  const model = (name) => Bokeh.documents[0].get_model_by_name(name);
  const { el, frame } = Bokeh.index.find_one_by_id(model("curve").id);
  const { displacement, force } = model("points").data;
  const middle = force.length >> 1;
  const { x, y } = el.getBoundingClientRect();
  return [x + frame.x_scale.compute(displacement[middle]), y + frame.y_scale.compute(force[middle])];
}"""


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as play:
        opened = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def file(page, tmp_path_factory):
    """The page, an attack among the names of its particles."""
    target = tmp_path_factory.mktemp("shown") / "report.html"
    target.write_text(page, encoding="utf-8")
    return target


@pytest.fixture(params=SIZES)
def tab(request, browser, file):
    """The page, opened in a window of some size; it must not have complained by the end."""
    width, height = SIZES[request.param]
    phone = request.param == "phone"
    context = browser.new_context(
        viewport={"width": width, "height": height}, is_mobile=phone, has_touch=phone, offline=True
    )
    tab = context.new_page()
    complaints = []
    tab.on("console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("dialog", lambda dialog: (complaints.append("a script of the data ran"), dialog.dismiss()))
    tab.on("request", lambda r: complaints.append(r.url) if not r.url.startswith(("file:", "data:", "blob:")) else None)
    tab.goto(file.as_uri())
    tab.wait_for_selector("#interactive[data-ready]", timeout=60_000)
    tab.wait_for_timeout(300)
    yield tab
    context.close()
    assert complaints == []


def test_plots_are_drawn_and_nothing_sticks_out(tab):
    for root in ("chart-curve", "chart-residual"):
        assert max(tab.evaluate(DRAWN, root)) > 20  # an empty canvas has a handful of colours
    inside = tab.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    assert inside, "the page is wider than the window"
    assert tab.evaluate("[...document.images].every(one => one.complete && one.naturalWidth > 0)")
    small = tab.evaluate(
        "[...document.querySelectorAll('main p, main li, main td, main button, main select')]"
        ".filter(one => one.offsetParent && parseFloat(getComputedStyle(one).fontSize) < 13).length"
    )
    assert small == 0


def test_particles_switch_by_list_by_button_and_by_keyboard(tab):
    def label():
        return tab.evaluate(f"{POINTS}.particle[0]")

    first = label()
    assert first in tab.text_content("#particle-facts")
    assert tab.is_disabled("#previous")
    tab.select_option("#particle", "1")
    assert label() == NAMES[1]
    assert NAMES[1] in tab.text_content("#particle-facts")
    tab.click("#previous")
    assert label() == first
    tab.focus("#particle")
    tab.keyboard.press("ArrowDown")
    assert label() == NAMES[1]
    tab.keyboard.press("End")
    assert label() == NAMES[3]
    assert "not used" in tab.text_content("#particle-facts")
    assert tab.is_disabled("#next")


def test_zoom_in_and_back_by_keyboard(tab):
    whole = tab.evaluate(RANGE)
    for button, factor in (("#zoom-in", 0.6), ("#zoom-out", 1.0), ("#zoom-in", 0.6), ("#zoom-reset", 1.0)):
        tab.focus(button)
        tab.keyboard.press("Enter")
        assert tab.evaluate(RANGE) == pytest.approx(factor * whole)


def test_pointing_at_a_dot_tells_particle_and_segment(tab):
    tab.select_option("#particle", "2")
    tab.locator("#chart-curve").scroll_into_view_if_needed()
    tab.wait_for_timeout(300)
    x, y = tab.evaluate(MIDDLE_POINT)
    for near in (4, 0):  # it has to move to be noticed
        tab.mouse.move(x - near, y)
    tip = tab.locator(".bk-Tooltip", has_text="segment")
    tip.wait_for(timeout=5000)
    assert tip.get_by_text(NAMES[2]).is_visible()
    assert tip.get_by_text("particle:").count() == 1  # one point, not all that lie there


def test_on_paper_everything_is_unfolded(tab, tmp_path):
    tab.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert tab.evaluate("document.querySelectorAll('details:not([open])').length") == 0
    tab.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert tab.evaluate("document.querySelectorAll('details[open]').length") == 0
    tab.emulate_media(media="print")
    assert tab.is_hidden("#interactive")
    assert tab.is_visible("#diagnostics")
