"""The explorer in a real browser: found by clicks, added, seen to fall, taken back; nothing asked outside."""

import signal
from urllib.parse import urlsplit

import pytest
from heated_mission import make_heated_workspace
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog
from inflight.tasks.pipelines import reprocess

#: What the figure of the falling error has drawn: bars by change, and the noise floor.
_ERROR = """(() => {
  const models = Bokeh.documents.flatMap((one) => [...one._all_models.values()]);
  const plot = models.filter((one) => one.type === 'Figure' && one.title.text.startsWith('The error,'));
  const bars = plot.at(-1).renderers.filter((one) => one.glyph && one.glyph.type === 'VBar');
  const values = (one, name) => [...(one.data_source.data.get?.(name) ?? one.data_source.data[name] ?? [])];
  const found = Object.fromEntries(bars.flatMap((one) =>
    values(one, 'change').map((name, at) => [name, values(one, 'after')[at]])));
  const floor = plot.at(-1).center.find((one) => one.type === 'Span');
  return {bars: found, floor: floor ? floor.location : null} })()"""


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    """Four calibrated days with the field of a heater that no model knows."""
    made = make_heated_workspace(tmp_path_factory.mktemp("heated") / "heated")
    reprocess(Catalog(made.root), made.mission())
    return made.root


@pytest.fixture(scope="module")
def address(serve, heated):
    return serve(heated).url


def outside(requests: list[str]) -> list[str]:
    """Return addresses that are neither of this machine nor within the page."""
    inside = ("data", "blob", "about", "chrome")
    parts = [urlsplit(one) for one in requests]
    return [one.geturl() for one in parts if one.scheme not in inside and one.hostname != "127.0.0.1"]


def test_the_missing_effect_is_found_tried_added_and_taken_back_by_clicks(browser, address, heated):
    browser.open(address)
    browser.wait_for_text("Residual of products of model version 1", 120)
    browser.press("button", "Diagnose this span")
    browser.wait_for_text("Try what is missing: a field that follows heater_current", 180)
    browser.press("button", "Try")
    browser.wait_for_text("Tried; nothing is saved.", 120)
    tried = browser.evaluate(_ERROR)
    assert len(Catalog(heated).models()) == 1
    browser.press("button", "Add")
    browser.wait_for_text("from version 1: add channel_field(heater_current)", 120)
    added = browser.evaluate(_ERROR)
    # The drawn error is where it was tried, and at the noise floor, from which the heater was taken off, too.
    assert added["bars"]["2: heater_current"] == pytest.approx(tried["bars"]["try: heater_current"])
    assert 0.97 * added["floor"] < added["bars"]["2: heater_current"] < 1.05 * added["floor"]
    browser.wait_for_text("4 of 4 days of products are of another model")
    browser.press("button", "Reprocess")
    browser.wait_for_text("4 days made anew", 120)
    assert "of another model" not in browser.text()
    browser.press("button", "Undo")
    browser.wait_for_text("undo version 2: back to version 1", 120)
    assert browser.evaluate(_ERROR)["bars"]["3: undo"] > 2 * added["floor"]
    browser.press(".bk-tab", "Tables")
    browser.wait_for_text("Circles are each day's own values", 120)
    browser.wait_for("pick('canvas').length > 2")
    assert outside(browser.requests) == []
    assert browser.complaints == []
    assert [one.state for one in Catalog(heated).runs("diagnose")] == ["done"]


def test_a_link_shows_the_same_view_and_days_dragged_over_are_shown_alone(browser, address):
    browser.open(f"{address}?tab=the-loop&channel=boom_temperature&candidate=scale_drift&first=2024-03-01")
    browser.wait_for_text("Drag over days of the map", 120)
    browser.wait_for("pick('select').some((one) => one.value === 'boom_temperature')")
    assert browser.evaluate("pick('input').some((one) => one.value === 'scale_drift')")
    browser.wait_for("location.search.includes('last=2024-03-04')")
    left, top, width, height = browser.evaluate(
        "(() => { const one = pick('canvas').find((one) => one.clientWidth > 200).getBoundingClientRect();"
        " return [one.left, one.top, one.width, one.height] })()"
    )
    # The second and third of four days, from below.
    x, places = left + 0.4 * width, (top + 0.35 * height, top + 0.55 * height)
    browser.drag((x, places[0]), (x, places[1]))
    browser.wait_for("location.search.includes('first=2024-03-02')")
    browser.wait_for("location.search.includes('last=2024-03-03')")


def test_an_error_is_told_with_what_to_do_and_the_page_goes_on(browser, address):
    browser.open(address)
    browser.wait_for("window.pick && pick('input').some((one) => one.placeholder.startsWith('a channel'))")
    browser.evaluate(
        "(() => { const one = pick('input').find((one) => one.placeholder.startsWith('a channel'));"
        " one.value = 'no_such_effect'; one.dispatchEvent(new Event('change')) })()"
    )
    browser.press("button", "Add")
    browser.wait_for_text("What to do:", 180)
    assert "no_such_effect" in browser.text()
    browser.press(".bk-tab", "Model against measurement")
    browser.wait_for_text("Noise floor", 120)


def test_an_empty_workspace_says_what_to_do_first(serve, browser, tmp_path):
    browser.open(serve(make_tiny_workspace(tmp_path / "tiny")).url)
    browser.wait_for_text("inflight ingest")


def test_ctrl_c_ends_the_server_without_an_error(serve, tmp_path):
    served = serve(make_tiny_workspace(tmp_path / "tiny"))
    assert served.told["command"] == "explore"
    served.process.send_signal(signal.SIGINT)
    _, complaints = served.process.communicate(timeout=60)
    assert served.process.returncode == 0, complaints
    assert "Traceback" not in complaints
