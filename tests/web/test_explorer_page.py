"""The explorer in a real browser: found by clicks, added, seen to fall, taken back; nothing asked outside."""

import re
import signal
import time
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import numpy as np
import pytest
from chromium import Chromium, find_chromium
from heated_mission import deliver_heated_day, heater_field, make_heated_workspace
from tiny_mission import make_tiny_workspace
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import diagnose_span, last_diagnosis
from inflight.tasks.pipelines import reprocess

#: What the last figure with a title like one has drawn: ys of its marks by what they are called.
_CURVES = """(() => {
  const models = Bokeh.documents.flatMap((one) => [...one._all_models.values()]);
  const plot = models.filter((one) => one.type === 'Figure' && one.title.text.startsWith('TITLE')).at(-1);
  const marks = plot ? plot.renderers.filter((one) => one.name) : [];
  const values = (one, name) => [...(one.data_source.data.get?.(name) ?? one.data_source.data[name] ?? [])];
  return Object.fromEntries(marks.map((one) => [one.name, [values(one, 'x'), values(one, 'y')]])) })()"""
#: What the figure of the falling error has drawn: bars by change, and the noise floor.
_ERROR = """(() => {
  const models = Bokeh.documents.flatMap((one) => [...one._all_models.values()]);
  const plot = models.filter((one) => one.type === 'Figure' && one.title.text.startsWith('The error,'));
  if (!plot.length) return {bars: {}, floor: null};
  const bars = plot.at(-1).renderers.filter((one) => one.glyph && one.glyph.type === 'VBar');
  const values = (one, name) => [...(one.data_source.data.get?.(name) ?? one.data_source.data[name] ?? [])];
  const found = Object.fromEntries(bars.flatMap((one) =>
    values(one, 'change').map((name, at) => [name, values(one, 'after')[at]])));
  const floor = plot.at(-1).center.find((one) => one.type === 'Span');
  return {bars: found, floor: floor ? floor.location : null} })()"""

#: Uses the tool of a kind of the calendar, as a click does.
_EXPORT = """(() => {
  const models = Bokeh.documents.flatMap((one) => [...one._all_models.values()]);
  const tools = models.filter((one) => one.description === 'Save as KIND');
  tools.at(-1).callback.execute(tools.at(-1), {}) })()"""

#: Chooses the last day of the calendar, as a click does.
_CLICKED = """(() => {
  const models = Bokeh.documents.flatMap((one) => [...one._all_models.values()]);
  const cells = models.filter((one) => one.type === 'ColumnDataSource' && one.columns().includes('why'));
  cells.at(-1).selected.indices = [4] })()"""

#: Lets every figure ask for a layout and for its picture; counts layouts, and styles that figures ask for.
_COUNTED = """(() => {
  const figures = [...Bokeh.index.query((one) => one.model.type === 'Figure')];
  let root = figures[0]; while (root.parent) root = root.parent;
  const lay_out = root.update_layout, ask = CSSStyleDeclaration.prototype.getPropertyValue;
  window.laid_out = window.asked = 0;
  root.update_layout = function () { window.laid_out += 1; return lay_out.call(this) };
  CSSStyleDeclaration.prototype.getPropertyValue = function (name) {
    window.asked += name.startsWith('--bk-'); return ask.call(this, name) };
  for (const figure of figures) { figure.invalidate_layout(); figure.request_repaint() }
  return figures.length })()"""
#: Counts figures drawn without a height: observers are told of sizes when a page is about to be drawn.
_FLAT = """(() => { window.flat = window.sizes_seen = 0;
  const told = new ResizeObserver((sizes) => { for (const one of sizes) {
    window.sizes_seen += 1; window.flat += one.target.isConnected && one.contentRect.height === 0 } });
  const look = () => {
    for (const one of Bokeh.index.query((one) => one.model.type === 'Figure')) told.observe(one.el);
    requestAnimationFrame(look) };
  look() })()"""


def heater_and_tone(day, reading):
    """The field of a heater, and 0.4 nT on z that repeat every 41 min and follow no channel."""
    start = (np.datetime64(day) - np.datetime64("2024-03-01")) / np.timedelta64(1, "s")
    phase = 2 * np.pi * (start + 60.0 * np.arange(1440)) / 2460.0
    return heater_field(day, reading) + 0.4 * np.sin(phase)[:, None] * np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    """Four calibrated days with the field of a heater that no model knows, and one that no library has."""
    made = make_heated_workspace(tmp_path_factory.mktemp("heated") / "heated", heater_and_tone)
    reprocess(Catalog(made.root), made.mission())
    return made.root


@pytest.fixture(scope="module")
def address(serve, heated):
    return serve(heated).url


@pytest.fixture
def diagnosed(heated):
    """The same workspace with a diagnosis: that of a test before, or one made for it."""
    if last_diagnosis(Workspace.open(heated), "main") is None:
        diagnose_span(Workspace.open(heated))
    return heated


def drawn_error(browser, change):
    """Return what the figure of the error has drawn, as soon as a change is in it."""
    there = f"Object.keys(found.bars).some((one) => one.startsWith('{change}'))"
    return browser.wait_for(f"((found) => {there} && found)({_ERROR})")


def outside(requests: list[str]) -> list[str]:
    """Return addresses that are neither of this machine nor within the page."""
    inside = ("data", "blob", "about", "chrome")
    parts = [urlsplit(one) for one in requests]
    return [one.geturl() for one in parts if one.scheme not in inside and one.hostname != "127.0.0.1"]


def test_the_missing_effect_is_found_tried_added_and_taken_back_by_clicks(browser, address, heated):
    browser.open(address)
    browser.wait_for_text("Residual of products of model version 1", 240)
    browser.press("button", "Diagnose this span")
    browser.wait_for_text("Try what is missing: a field that follows heater_current", 300)
    # What the library lacks is told beside it, and can be added for what it looks like.
    browser.wait_for_text("The library has no name for what is left:")
    browser.wait_for_text("period 41 min axis z shape sine")
    assert re.search(r"shape sine .* on z 0\.[34]\d* ± ", browser.text())
    browser.press("button", "Try")
    browser.wait_for_text("Tried; nothing is saved.", 240)
    tried = drawn_error(browser, "try: heater_current")
    assert len(Catalog(heated).models()) == 1
    # On the left the field along x that follows the heater is there before, and gone after.
    browser.wait_for_text("Residual before and after: try channel_field(heater_current).")
    drawn = _CURVES.replace("TITLE", "heater_current: field along x")
    curves = browser.wait_for(f"((found) => 'after' in found && found)({drawn})")
    assert np.ptp(curves["all"][1]) == pytest.approx(1.0, abs=0.05)
    assert np.ptp(curves["after"][1]) < 0.02
    button = "window.pick('button').find((one) => one.textContent.trim() === 'Add as an empirical term')"
    assert browser.wait_for(f"(window.held = {button}) !== undefined")
    browser.press("button", "Add")
    browser.wait_for_text("from version 1: add channel_field(heater_current)", 240)
    added = drawn_error(browser, "2: heater_current")
    assert added["bars"]["2: heater_current"] == pytest.approx(tried["bars"]["try: heater_current"])
    assert added["bars"]["2: heater_current"] > 2 * added["floor"]
    # What follows an addition leaves a button alone that may be pressed meanwhile.
    browser.wait_for_text("Residual before and after: add channel_field(heater_current).")
    assert browser.evaluate("window.held.isConnected")
    browser.press("button", "Add as an empirical term")
    browser.wait_for_text("from version 2: add tone", 240)
    added = drawn_error(browser, "3: tone")
    browser.wait_for("!window.allText().includes('Add as an empirical term')")
    # The drawn error is at the noise floor, from which what was added was taken off, too.
    (last,) = (size for name, size in added["bars"].items() if name.startswith("3: tone"))
    assert 0.97 * added["floor"] < last < 1.05 * added["floor"]
    browser.wait_for_text("4 of 4 days of products are of another model")
    browser.press("button", "Reprocess")
    browser.wait_for_text("4 days made anew", 240)
    assert "of another model" not in browser.text()
    browser.press("button", "Undo")
    browser.wait_for_text("undo version 3: back to version 2", 240)
    assert drawn_error(browser, "4: undo")["bars"]["4: undo"] > 2 * added["floor"]
    # Each effect of the model in use has a row below what is left.
    browser.press(".bk-tab", "Model against measurement")
    browser.press(".bk-tab", "In time")
    stack = _CURVES.replace("TITLE", "What is left, and what each effect")
    rows = browser.wait_for(f"((found) => 'residual' in found && found)({stack})")
    places = {name: round(np.nanmean(np.array(y, dtype=float))) for name, (_, y) in rows.items()}
    assert places["residual"] == 0
    assert sorted(places.values(), reverse=True) == [-place for place in range(len(rows))]
    assert places["channel_field_heater_current"] < 0
    browser.press(".bk-tab", "Tables")
    browser.wait_for_text("Circles are each day's own values", 240)
    browser.wait_for("pick('canvas').length > 2")
    assert outside(browser.requests) == []
    assert browser.complaints == []
    # A column that no library has takes a pass of its own.
    assert [one.state for one in Catalog(heated).runs("diagnose")] == ["done", "done"]


def test_a_link_shows_the_same_view_and_days_dragged_over_are_shown_alone(browser, address):
    browser.open(f"{address}&tab=the-loop&channel=boom_temperature&candidate=scale_drift&first=2024-03-01")
    browser.wait_for_text("Drag over the map", 240)
    browser.wait_for("pick('select').some((one) => one.value === 'boom_temperature')")
    assert browser.evaluate("pick('input').some((one) => one.value === 'scale_drift')")
    browser.wait_for("location.search.includes('last=2024-03-04')")
    # What is dragged over in a curve restricts all pictures, until it is cleared.
    left, top, width, height = browser.place_of("curve")
    ends = [(left + part * width, top + 0.4 * height) for part in (0.5, 0.8)]
    browser.drag(*ends)
    browser.wait_for_text("Selected: boom_temperature")
    told = re.search(r"\((\d+) of (\d+) rows", browser.text())
    assert 0 < int(told[1]) < 0.7 * int(told[2])
    browser.wait_for("location.search.includes('select=boom_temperature')")
    low, high = re.search(r"boom_temperature (\S+) to (\S+) degC", browser.text()).groups()
    drawn = _CURVES.replace("TITLE", "boom_temperature: rms")
    places = f"Object.values({drawn}).flatMap((one) => one[0])"
    browser.wait_for(f"{places}.every((one) => {low} <= one && one <= {high})")
    browser.press("button", "Clear selection")
    browser.wait_for("!location.search.includes('select=boom')")
    browser.wait_for("!window.allText().includes('Selected:')")
    # A day that is clicked is seen down to its samples.
    left, top, width, height = browser.place_of("map")
    browser.click((left + 0.4 * width, top + 0.35 * height))
    browser.wait_for("location.search.includes('zoom=2024-03-03T00%3A00%3A00~2024-03-04')")
    browser.wait_for_text("2024-03-03T00:00 to 2024-03-04T00:00 UTC: samples.")
    # The second and third of four days, from below.
    x, places = left + 0.4 * width, (top + 0.35 * height, top + 0.55 * height)
    browser.drag((x, places[0]), (x, places[1]))
    browser.wait_for("location.search.includes('first=2024-03-02')")
    browser.wait_for("location.search.includes('last=2024-03-03')")


def test_what_changes_at_once_is_laid_out_once_before_it_is_seen_and_no_style_is_asked_for(browser, address):
    browser.open(f"{address}&tab=the-loop&channel=boom_temperature")
    browser.wait_for_text("Drag over the map", 240)
    browser.place_of("curve")
    browser.rest()
    assert browser.evaluate(_COUNTED) > 3
    browser.wait_for("window.laid_out > 0")
    time.sleep(0.2)
    assert browser.evaluate("[window.laid_out, window.asked]") == [1, 0]
    # Figures that replace others are as high as they will be when the page is drawn.
    browser.evaluate(_FLAT)
    browser.fill("Residual against", "local time")
    browser.place_of("curve")
    browser.rest()
    assert browser.evaluate("[window.sizes_seen > 6, window.flat]") == [True, 0]


def test_figures_that_were_replaced_are_let_go_and_those_shown_follow_the_zoom(browser, address):
    browser.open(f"{address}&tab=the-loop&channel=boom_temperature")
    browser.wait_for_text("Drag over the map", 240)
    browser.place_of("curve")
    browser.evaluate("window.before = pick('canvas').map((one) => new WeakRef(one)); null")
    browser.fill("Residual against", "local time")
    browser.place_of("curve")
    # Bokeh looks for what is no longer shown when nothing has changed for half a minute: not waited for.
    browser.evaluate("Bokeh.documents.forEach((one) => one._recompute_all_models())")
    gone = "before.filter((one) => !one.deref()).length"
    until = time.monotonic() + 20.0
    while not browser.evaluate(gone) and time.monotonic() < until:
        time.sleep(0.2)
        browser.call("HeapProfiler.collectGarbage")
    # The curve and the axes; the map stays.
    assert 2 <= browser.evaluate(gone) < browser.evaluate("before.length")
    wide = "pick('canvas').filter((one) => one.clientWidth > 200)"
    sharp = f"{wide}.every((one) => Math.abs(one.width / one.clientWidth - ZOOM) < 0.01)"
    assert browser.evaluate(f"{wide}.length") > 2
    try:
        browser.look(1280, 900)
        browser.place_of("curve")
        assert browser.evaluate(sharp.replace("ZOOM", "1"))
        browser.look(1280, 900, zoom=2.0)
        # What a browser says when its reader zooms, and not when a test does.
        browser.evaluate("visualViewport.dispatchEvent(new Event('resize'))")
        browser.wait_for(sharp.replace("ZOOM", "2"), 20)
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")


def focused(browser, selector):
    """Press Tab until something of a kind has the focus; return how it is outlined."""
    active = """(() => { let one = document.activeElement;
      while (one?.shadowRoot?.activeElement) one = one.shadowRoot.activeElement;
      return one?.matches(SELECTOR) ? one.style.outline || 'none' : null })()"""
    active = active.replace("SELECTOR", repr(selector))
    for _ in range(80):
        browser.key("Tab")
        if browser.evaluate(active):
            # The ring is drawn after the key was taken.
            time.sleep(0.1)
            return browser.evaluate(active)
    raise AssertionError(f"Tab does not reach {selector}")


def test_tables_and_figures_are_used_by_the_keyboard(browser, address, diagnosed):
    browser.open(f"{address}&tab=the-loop&channel=boom_temperature")
    browser.wait_for_text("Drag over the map", 240)
    browser.wait_for("pick('.tabulator-row').length > 3")
    browser.place_of("curve")
    # A cross is moved over the map, and Enter clicks the day below it.
    assert "solid" in focused(browser, ".bk-events")
    browser.key("ArrowUp", shift=True)
    browser.key("Enter")
    browser.wait_for("location.search.includes('zoom=2024-03-0')")
    # The next figure is the curve: blanks begin and end a brush.
    assert "solid" in focused(browser, ".bk-events")
    browser.key(" ")
    for _ in range(3):
        browser.key("ArrowRight", shift=True)
    browser.key(" ")
    browser.wait_for("location.search.includes('select=boom_temperature')")
    assert "solid" in focused(browser, ".tabulator-tableholder")
    for _ in range(2):
        browser.key("ArrowDown")
    browser.key("Enter")
    chosen = "pick('.tabulator-row').findIndex((one) => one.matches('.tabulator-selected'))"
    browser.wait_for(f"{chosen} > 0")
    browser.wait_for("location.search.includes('candidate=')")


def test_two_browsers_do_not_disturb_each_other(browser, address, diagnosed, tmp_path):
    """Each tries an effect of its own at the same time, on a part of its own."""
    other = Chromium(find_chromium(), tmp_path / "profile")
    try:
        for one, effect in ((browser, "scale_drift"), (other, "boom_temperature")):
            one.open(f"{address}&tab=the-loop&candidate={effect}")
        for one in (browser, other):
            one.wait_for_text("Drag over the map", 120)
            one.wait_for("pick('.tabulator-row').length > 3")
        other.fill("Only where", "boom_temperature=5~9")
        for one in (browser, other):
            one.press("button", "Try")
        for one, effect in ((browser, "scale_drift"), (other, "boom_temperature")):
            one.wait_for_text("Tried; nothing is saved.", 120)
            tried = [name for name in drawn_error(one, "try:")["bars"] if name.startswith("try")]
            # Its lag, where it has one, stands behind its name.
            assert [name.partition(", lag")[0] for name in tried] == [f"try: {effect}"]
        other.wait_for_text("Selected: boom_temperature 5 to 9 degC")
        assert "Selected:" not in browser.text()
        assert "select=" not in browser.evaluate("location.search")
        assert other.complaints == []
    finally:
        other.close()


def test_who_has_no_token_is_shown_how_to_get_it_and_nothing_else(address):
    place = urlsplit(address)
    root, token = f"http://{place.netloc}", place.query.partition("=")[2]

    def status(path: str, **headers: str) -> tuple[int, str]:
        try:
            with urllib.request.urlopen(urllib.request.Request(root + path, headers=headers)) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    cookie = f"inflight-{place.port}="
    for path in ("/", "/?token=wrong", "/static/js/bokeh.min.js", "/autoload.js", "/no-such-page"):
        code, page = status(path, Cookie=f"{cookie}wrong")
        assert (code, "inflight explore --no-token" in page) == (403, True), path
        assert "tiny" not in page
    assert status("/", Cookie=f"{cookie}{token}")[0] == 200
    socket = f"ws://{place.netloc}/ws"
    with pytest.raises(InvalidStatus) as refused:
        connect(socket, subprotocols=["bokeh", "anything"], origin=root)
    assert refused.value.response.status_code == 403
    # Who has it is let in, and asked for the session of a page.
    known = connect(socket, origin=root, additional_headers={"Cookie": f"{cookie}{token}"})
    with known, pytest.raises(ConnectionClosed):
        known.recv(timeout=10)


def test_an_error_is_told_with_what_to_do_and_the_page_goes_on(browser, address):
    browser.open(address)
    browser.fill_placeholder("a channel", "no_such_effect")
    browser.press("button", "Add")
    browser.wait_for_text("What to do:", 300)
    assert "no_such_effect" in browser.text()
    browser.press(".bk-tab", "Model against measurement")
    browser.wait_for_text("Noise floor", 240)


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


def test_a_backfill_is_planned_started_and_seen_to_finish(browser, address, heated, tmp_path):
    """The fifth day is delivered late; another page shows the run, and answers meanwhile."""
    deliver_heated_day(Workspace.open(heated).data, "2024-03-05", heater_field)
    browser.open(f"{address}&tab=products-and-runs")
    browser.wait_for_text("Click one to see it.", 240)
    browser.fill("What", "Backfill")
    browser.fill("Reason", "delivered late")
    browser.fill("to, included", "2024-03-05")
    browser.press("button", "Plan")
    browser.wait_for_text("files were delivered that are not in the archive")
    assert browser.evaluate("pick('button').find((one) => one.textContent.trim() === 'Stop').disabled")
    runs = len(Catalog(heated).runs())
    browser.press("button", "Start")
    browser.wait_for_text("Backfill 2024-03-01 to 2024-03-05: ")
    browser.press(".bk-tab", "Diagnosis")
    browser.wait_for_text("All figures of this diagnosis", 10)
    browser.press(".bk-tab", "Products and runs")
    browser.wait_for_text("Backfill 2024-03-01 to 2024-03-05 is finished.", 240)
    assert "5 days made, 0 unchanged, 0 failed" in browser.text()
    assert [one.kind for one in Catalog(heated).runs()[runs:]] == ["ingest", "reprocess"]
    # Its log, and the day it made.
    browser.wait_for_text("reason: delivered late")
    browser.wait_for_text("l2/field: 5 published; 2024-03-01 to 2024-03-05")
    browser.wait_for_text("quick-look 5")
    # A day that is clicked is shown, with its versions.
    browser.evaluate(_CLICKED)
    browser.wait_for_text("l2/field 2024-03-05")
    browser.wait_for("location.search.includes('day=2024-03-05')")
    browser.press(".bk-tab", "Made from")
    browser.wait_for("pick('svg').some((one) => one.textContent.includes('Lineage of l2/field'))")
    # What is drawn can be taken away.
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    for kind in ("SVG", "CSV"):
        browser.evaluate(_EXPORT.replace("KIND", kind))
    name = "l2-field-2024-03-01-to-2024-03-05"
    end = time.monotonic() + 30
    while not (tmp_path / f"{name}.svg").exists() or not (tmp_path / f"{name}.csv").exists():
        assert time.monotonic() < end
        time.sleep(0.1)
    table = (tmp_path / f"{name}.csv").read_text(encoding="utf-8")
    assert re.search(r"65,2024,2024-03-05,quick-look,v01\.00; (100\.0|99\.\d)% of the samples", table)
    assert (tmp_path / f"{name}.svg").read_text(encoding="utf-8").startswith("<svg")
    assert browser.complaints == []
