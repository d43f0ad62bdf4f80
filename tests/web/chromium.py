"""A real browser for tests: headless Chromium, spoken to in its own protocol."""

import itertools
import json
import os
import shutil
import subprocess
import sys
import time
import urllib.request
from base64 import b64decode
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
#: Nothing of the browser's own may go out: what does is the page's.
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--window-size=1500,1100",
    "--remote-debugging-port=0",
)
#: Seconds without a change after which a page rests.
_STILL_S = 3.0
#: Elements of widgets live in shadow roots: these find text and things to click in all of them.
_DEEP = """
window.everything = function* (root) {
  for (const one of (root || document).querySelectorAll('*')) {
    yield one; if (one.shadowRoot) yield* window.everything(one.shadowRoot) } };
window.shown = (one) => one.getClientRects().length > 0;
window.allText = () => { const parts = [];
  for (const one of window.everything()) if (window.shown(one) && !['STYLE', 'SCRIPT'].includes(one.tagName))
    for (const child of one.childNodes) if (child.nodeType === 3) parts.push(child.data);
  return parts.join(' ').replace(/\\s+/g, ' ') };
window.pick = (selector) => [...window.everything()].filter(
  (one) => one.matches(selector) && window.shown(one));
window.fill = (label, value) => { const found = window.pick('label').find(
  (one) => one.textContent.trim() === label); if (!found) return false;
  const input = found.getRootNode().querySelector('select, input');
  if (input._flatpickr) input._flatpickr.setDate(value, true); else { input.value = value;
    for (const kind of ['input', 'change']) input.dispatchEvent(new Event(kind)) } return true };
window.press = (selector, label) => { const found = window.pick(selector).filter(
  (one) => one.textContent.trim() === label && !one.disabled);
  if (found.length) found[0].click(); return found.length };
"""
#: Left, top, width and height of the first figure of the left column, or of the first below what it is drawn
#: against; pixels of the page. A curve of what was chosen before is none: its own axis tells. Models of the
#: page tell nothing: their order changes when the page has rested for half a minute.
_PLACE = """(() => { const top = (one) => one.getBoundingClientRect().top;
  const select = pick('select').find((one) => one.getBoundingClientRect().left < 200 && top(one) > 250);
  const below = FIGURE === 'curve' ? top(select) : 0;
  const views = [...Bokeh.index.query((one) => one.model.type === 'Figure' && shown(one.el))];
  const found = views.map((view) => [view, view.el.getBoundingClientRect()])
    .filter(([view, box]) => box.width > 200 && box.left < 200 && box.top > below)
    .sort((one, other) => one[1].top - other[1].top)[0];
  if (!found) return null;
  const [view, box] = found, label = view.model.below[0].axis_label || '';
  if (FIGURE === 'curve' && label.split(' (')[0] !== select.value) return null;
  return [box.left, box.top, box.width, box.height] })()"""


def find_chromium() -> str | None:
    """Return the path of a browser of this family; None without one."""
    given = os.environ.get("INFLIGHT_CHROMIUM")
    return given or next((path for name in NAMES if (path := shutil.which(name))), None)


class Chromium:
    """One page of a browser with a profile of its own; `requests` has every address it asked for."""

    def __init__(self, program: str, profile: Path) -> None:
        self._log = (profile.parent / "chromium.log").open("w")
        command = [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=self._log, stderr=self._log)
        self._number = itertools.count(1)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._socket = connect(self._address(profile), max_size=None, compression=None, ping_interval=None)
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=_DEEP)

    def _address(self, profile: Path) -> str:
        """Return the address of the page's socket as soon as the browser has one."""
        told = profile / "DevToolsActivePort"
        for _ in range(600):
            if self._process.poll() is not None:
                log = (profile.parent / "chromium.log").read_text()
                raise RuntimeError(f"the browser ended: {log[-2000:]}")
            if told.is_file() and (lines := told.read_text().splitlines()):
                with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json/list") as answer:
                    pages = [one for one in json.load(answer) if one["type"] == "page"]
                if pages:
                    return str(pages[0]["webSocketDebuggerUrl"])
            time.sleep(0.1)
        raise RuntimeError("the browser did not answer within a minute")

    def call(self, method: str, **parameters: Any) -> Any:
        """Ask the browser for something and return its answer; take note of what happens meanwhile."""
        return self._answer(method, self._ask(method, parameters))

    def _ask(self, method: str, parameters: dict[str, Any]) -> int:
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        return number

    def _answer(self, method: str, number: int) -> Any:
        while True:
            told = json.loads(self._socket.recv(timeout=120))
            if told.get("id") == number:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']}")
                return told["result"]
            self._note(told)

    def _note(self, told: dict[str, Any]) -> None:
        given = told.get("params", {})
        if told.get("method") == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif told.get("method") == "Network.webSocketCreated":
            self.requests.append(given["url"])
        elif told.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(given["exceptionDetails"])[:500])
        elif told.get("method") == "Runtime.consoleAPICalled" and given["type"] == "error":
            self.complaints.append(json.dumps(given["args"])[:500])

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def text(self) -> str:
        """Return all text that is shown."""
        return str(self.evaluate("window.allText ? window.allText() : ''"))

    def wait_for(self, expression: str, seconds: float = 120.0, *, pause: float = 0.1) -> Any:
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := self.evaluate(expression):
                return value
            time.sleep(pause)
        shown = self.text()[:1500]
        raise AssertionError(f"{expression} is not true after {seconds} s; the page shows: {shown}")

    def wait_for_text(self, text: str, seconds: float = 120.0) -> None:
        """Wait until a text is shown."""
        self.wait_for(f"window.allText && window.allText().includes({json.dumps(text)})", seconds)

    def press(self, selector: str, label: str) -> None:
        """Click the first thing of a kind that has a label, as soon as it is shown and can be used."""
        self.wait_for(f"window.press && window.press({json.dumps(selector)}, {json.dumps(label)})")

    def fill(self, label: str, value: str) -> None:
        """Choose or type a value in the widget that has a label, as soon as it is shown."""
        self.wait_for(f"window.fill && window.fill({json.dumps(label)}, {json.dumps(value)})")

    def fill_placeholder(self, placeholder: str, value: str) -> None:
        """Type a value into the input that asks for it by what stands in it, as soon as it is shown."""
        found = f"pick('input').find((one) => one.placeholder.startsWith({json.dumps(placeholder)}))"
        self.wait_for(f"window.pick && {found} !== undefined")
        self.evaluate(
            f"(() => {{ const one = {found}; one.value = {json.dumps(value)};"
            " one.dispatchEvent(new Event('change')) })()"
        )

    def place_of(self, figure: str) -> list[float]:
        """Return left, top, width and height of the `map` or the `curve`, as soon as it stands still."""
        was = None
        while (now := self.wait_for(_PLACE.replace("FIGURE", json.dumps(figure)))) != was:
            was = now
            time.sleep(0.5)
        return list(now)

    def rest(self) -> None:
        """Wait until nothing moves any more: no text changes, the mouse is away from all figures."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=2, y=2)
        was, since = "", time.monotonic()
        while time.monotonic() - since < _STILL_S:
            time.sleep(0.2)
            if (now := self.text()) != was:
                was, since = now, time.monotonic()

    def look(self, width: int, height: int, *, dark: bool = False, zoom: float = 1.0) -> None:
        """Make the page so many pixels wide and high, dark for a reader who asks for that; then zoom in."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=zoom,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at a place, move to another, and let go; pixels of what is shown.

        All is asked for at once: a button that is held too long is no drag.
        """
        asked, method = [], "Input.dispatchMouseEvent"
        for kind, part, pressed in (
            ("mousePressed", 0.0, 1),
            *(("mouseMoved", step / 6, 1) for step in range(1, 7)),
            ("mouseReleased", 1.0, 0),
        ):
            x, y = (one + part * (other - one) for one, other in zip(begin, end, strict=True))
            how = {"button": "left", "buttons": pressed, "clickCount": 1}
            asked.append(self._ask(method, {"type": kind, "x": x, "y": y, **how}))
        for number in asked:
            self._answer(method, number)

    def key(self, name: str, *, shift: bool = False) -> None:
        """Press and release a key: ``Tab``, ``Enter``, ``ArrowDown``, a blank."""
        text = {"Enter": "\r", " ": " "}.get(name)
        codes = {"Tab": 9, "Enter": 13, " ": 32, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39}
        code = codes.get(name, 40)
        how = {"key": name, "windowsVirtualKeyCode": code, "modifiers": 8 * shift}
        with_text = {"text": text} if text else {}
        kind = "keyDown" if text else "rawKeyDown"
        self.call("Input.dispatchKeyEvent", type=kind, **how, **with_text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **how)

    def click(self, place: tuple[float, float]) -> None:
        """Press and release the mouse at a place; pixels of what is shown."""
        how = {"x": place[0], "y": place[1], "button": "left", "clickCount": 1}
        for kind, pressed in (("mousePressed", 1), ("mouseReleased", 0)):
            self.call("Input.dispatchMouseEvent", type=kind, buttons=pressed, **how)

    def screenshot(self, path: Path) -> None:
        """Write what is shown as PNG."""
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """End the browser that was started here."""
        try:
            self.call("Browser.close")
        except Exception:
            self._process.kill()
        self._process.wait(30)
        self._log.close()


class Served:
    """A running `inflight explore`."""

    def __init__(self, root: Path) -> None:
        code = "from inflight.cli import main; main()"
        command = [sys.executable, "-c", code, "explore", "--json", "--workers", "1", "-w", str(root)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        told = ""
        while not told.endswith("}\n"):
            line = self.process.stdout.readline()
            assert line, self.process.stderr.read()
            told += line
        self.told = json.loads(told)
        self.url = self.told["url"]
