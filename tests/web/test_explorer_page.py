"""The explorer in a real browser: found by clicks, added, seen to fall, taken back; nothing asked outside."""

import signal
from urllib.parse import urlsplit

import pytest
from heated_mission import make_heated_workspace
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog
from inflight.tasks.pipelines import reprocess


@pytest.fixture
def heated(tmp_path):
    """Four calibrated days with the field of a heater that no model knows."""
    made = make_heated_workspace(tmp_path / "heated")
    reprocess(Catalog(made.root), made.mission())
    return made.root


def outside(requests: list[str]) -> list[str]:
    """Return addresses that are neither of this machine nor within the page."""
    inside = ("data", "blob", "about", "chrome")
    parts = [urlsplit(one) for one in requests]
    return [one.geturl() for one in parts if one.scheme not in inside and one.hostname != "127.0.0.1"]


def test_the_missing_effect_is_found_added_and_taken_back_by_clicks(serve, browser, heated):
    browser.open(serve(heated).url)
    browser.wait_for_text("Noise floor", 120)
    browser.wait_for("pick('canvas').length > 2")
    browser.press(".bk-tab", "The missing effect")
    browser.wait_for_text("There is no diagnosis yet")
    browser.press("button", "Diagnose this span")
    browser.wait_for_text("the largest cause is beyond doubt", 180)
    browser.wait_for_text("follows heater_current")
    browser.press("button", "Add")
    browser.wait_for_text("from version 1: add channel_field(heater_current)", 120)
    shown = browser.text()
    sizes = shown.split("Residual on days not used in the fit ")[1].split(" nT")[0]
    before, after = (float(one) for one in sizes.split(" to "))
    assert after < 0.5 * before
    assert "version 2" in shown.split("Comparison")[1].split("Model against")[0]
    browser.press("button", "Undo")
    browser.wait_for_text("undo version 2: back to version 1", 120)
    browser.press(".bk-tab", "Tables")
    browser.wait_for_text("Circles are each day's own values", 120)
    browser.wait_for("pick('canvas').length > 2")
    assert outside(browser.requests) == []
    assert browser.complaints == []
    assert [one.state for one in Catalog(heated).runs("diagnose")] == ["done"]


def test_an_error_is_told_with_what_to_do_and_the_page_goes_on(serve, browser, heated):
    browser.open(serve(heated).url)
    browser.press(".bk-tab", "The missing effect")
    browser.wait_for_text("or a channel, an effect, an entry")
    browser.evaluate(
        "(() => { const one = pick('input').find((one) => one.placeholder === 'scale_drift');"
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
    assert browser.complaints == []


def test_ctrl_c_ends_the_server_without_an_error(serve, tmp_path):
    served = serve(make_tiny_workspace(tmp_path / "tiny"))
    assert served.told["command"] == "explore"
    served.process.send_signal(signal.SIGINT)
    _, complaints = served.process.communicate(timeout=60)
    assert served.process.returncode == 0, complaints
    assert "Traceback" not in complaints
