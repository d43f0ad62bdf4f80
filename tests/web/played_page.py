"""Does what a page of documentation says: writes and runs its blocks, and clicks what its sentences name.

A sentence is an instruction when it has one of the forms of `_FORMS`: what is slanted must be shown, what is
bold is pressed, opened, chosen or filled, or it is wrong. Nothing that a reader is told goes untried.
"""

import contextlib
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from chromium import Chromium

#: Forms of instructions, by what is done with what they name.
_FORMS = {
    "write_file": r"^```\w+ (?P<name>[\w.]+)\n(?P<text>.*?)^```$",
    "run_commands": r"^```sh\n(?P<text>.*?)^```$",
    "take_picture": r"^!\[[^]]*\]\((?P<name>[^)]+)\)",
    "press": r"[Pp]ress\s+\*\*(?P<name>[^*]+)\*\*",
    "open_tab": r"[Oo]pen the\s+tab\s+\*\*(?P<name>[^*]+)\*\*",
    "choose_row": r"[Cc]hoose\s+the\s+row\s+\*\*(?P<name>[^*]+)\*\*",
    "fill": r"([Cc]hoose|[Ww]rite)\s+`(?P<text>[^`]+)`\s+(in|into)\s+\*\*(?P<name>[^*]+)\*\*",
    "drag": r"[Dd]rag over the right half of the \*\*(?P<name>map|curve)\*\*",
    "read": r"(?<!\*)\*(?P<text>[^*]+)\*(?!\*)",
}
_FLAGS = re.MULTILINE | re.DOTALL
_ALL = re.compile(
    "|".join(
        f"(?P<{name}>{form.replace('?P<name>', '').replace('?P<text>', '')})" for name, form in _FORMS.items()
    ),
    _FLAGS,
)
#: A button that is held for 0.3 s before the mouse moves is no drag, and a busy machine is slow: times tried.
_DRAGS = 6
#: Clicks the first row of a table that has a text.
_ROW = """(() => { const found = window.pick && pick('.tabulator-row').find(
    (one) => one.textContent.includes(TEXT));
  if (found) found.querySelector('.tabulator-cell').click(); return Boolean(found) })()"""


class PlayedPage:
    """A page of documentation that is done from its beginning to its end.

    Parameters
    ----------
    browser : Chromium
    folder : Path
        Where its commands run.
    serve : callable
        Serves a workspace and returns the address of its page.
    picture : callable
        Called with the name of each picture, when the page of the browser shows what the picture does.
    """

    def __init__(
        self,
        browser: Chromium,
        folder: Path,
        serve: Callable[[Path], str],
        picture: Callable[[str], None] = lambda name: None,
    ) -> None:
        self._browser, self._folder, self._serve, self.take_picture = browser, folder, serve, picture
        self.done: list[str] = []

    def play(self, text: str) -> None:
        """Do what a page says; `done` has the forms of what was done.

        Raises
        ------
        AssertionError
            When the browser does not show what the page says, or a sentence has no known form.
        """
        rest = re.findall(r"\*[^*\n]+\*", _ALL.sub("", text))
        assert not rest, f"no instruction has {rest}"
        for found in _ALL.finditer(text):
            form = next(name for name in _FORMS if found.group(name) is not None)
            named = re.match(_FORMS[form], found.group(), _FLAGS)
            assert named is not None
            getattr(self, form)(**named.groupdict())
            self.done.append(form)

    def write_file(self, name: str, text: str) -> None:
        """Write a block that has the name of a file."""
        (self._folder / name).write_text(text, encoding="utf-8")

    def run_commands(self, text: str) -> None:
        """Run the lines of a block; `inflight explore` opens the page."""
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            if words[:2] == ["inflight", "explore"]:
                self._browser.open(self._serve(self._folder / words[-1]))
                continue
            if words[0] == "inflight":
                words[:1] = [sys.executable, "-c", "from inflight.cli import main; main()"]
                words += ["--no-prefect"] if words[3] in ("ingest", "reprocess") else []
            elif words[0] == "python":
                words[0] = sys.executable
            found = subprocess.run(words, check=False, cwd=self._folder, capture_output=True, text=True)
            assert found.returncode == 0, f"{line}: {found.stdout}{found.stderr}"

    def press(self, name: str) -> None:
        """Press a button."""
        self._browser.press("button", name)

    def open_tab(self, name: str) -> None:
        """Open a tab of the page."""
        self._browser.press(".bk-tab", name)

    def choose_row(self, name: str) -> None:
        """Click a row of a table."""
        self._browser.wait_for(_ROW.replace("TEXT", json.dumps(name)))

    def fill(self, text: str, name: str) -> None:
        """Write or choose something in a widget."""
        self._browser.fill(name, text)

    def drag(self, name: str) -> None:
        """Drag the mouse over the right half of a figure of the left column, again when it was too slow."""
        for _ in range(_DRAGS):
            left, top, width, height = self._browser.place_of(name)
            self._browser.drag(*((left + part * width, top + 0.4 * height) for part in (0.5, 0.8)))
            with contextlib.suppress(AssertionError):
                self._browser.wait_for_text("Selected:", 5)
                return
        raise AssertionError(f"nothing is selected by dragging over the {name}")

    def read(self, text: str) -> None:
        """Wait until the page shows a text; three dots stand for anything."""
        form = ".*?".join(re.escape(part) for part in " ".join(text.split()).split("..."))
        self._browser.wait_for(
            f"window.allText && new RegExp({json.dumps(form)}).test(window.allText())", 120
        )
