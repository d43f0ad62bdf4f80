"""Draw the pictures of README and documentation from a workspace that ``make demo`` has made.

Run ``.venv/bin/python docs/make_pictures.py demo``; a Chromium on the path turns the page into a PNG. With
``explorer`` in place of a folder it does what the tutorial of the page says, and keeps what is then shown.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from inflight.catalog import Catalog, Workspace
from inflight.figures import bullet_list, html_page
from inflight.tasks.analysis import measure_comparison, report

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
#: Width and height of the pictures of the page, pixels.
_EXPLORER_SIZE = 1440, 1180
_QUIET = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--virtual-time-budget=8000",
]


def screenshot(page: Path, picture: Path, width: int, height: int) -> None:
    """Turn a page into a PNG of so many pixels.

    Raises
    ------
    SystemExit
        When there is no browser.
    """
    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"no browser on the path; looked for {', '.join(_BROWSERS)}")
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser,
                *_QUIET,
                f"--user-data-dir={profile}",
                f"--window-size={width},{height}",
                f"--screenshot={picture.resolve()}",
                page.resolve().as_uri(),
            ],
            check=True,
            capture_output=True,
        )


def fall_page(workspace: Workspace) -> str:
    """Return a page of how the error of the demo's month falls: by day and in the spectrum.

    Raises
    ------
    SystemExit
        When nothing was added to the model yet.
    """
    found = measure_comparison(Catalog(workspace.root), workspace.mission())
    compared, sections = found.report, {heading: figures for heading, _, figures in found.sections()}
    if compared.earlier is None:
        sys.exit("nothing was added to the model yet: run 'make demo' to its end")
    before, floor = compared.earlier, compared.floor.level_nT
    lines = [
        f"calibrated, the cause not known yet: {before.rms:.3f} nT, of which noise is {floor:.3f} nT",
        f"diagnose names the cause, and it is put into the model: {before.message}",
        f"with it: {compared.clear:.3f} nT; above the noise {before.above_floor:.2g} nT became "
        f"{compared.above_floor:.2g} nT",
    ]
    pair = [sections["Residual"][0], sections["Spectrum"][0]]
    title = "A simulated month with a hidden cause: found, added, and the error falls to the noise"
    return html_page(title, [("", [bullet_list(lines)], pair)])


def explorer_pictures() -> None:
    """Write the pictures of docs/tutorial-explorer.md, as the page shows them when the tutorial says so."""
    docs = Path(__file__).parent
    sys.path.append(str(docs.parent / "tests" / "web"))
    from chromium import Chromium, Served, find_chromium
    from played_page import PlayedPage

    program = find_chromium()
    if program is None:
        sys.exit("no Chromium is on the path; install it, or name one by INFLIGHT_CHROMIUM")
    servers: list[Served] = []

    def serve(root: Path) -> str:
        servers.append(Served(root))
        return servers[-1].url

    def keep(name: str) -> None:
        browser.rest()
        browser.screenshot(docs / name)

    with tempfile.TemporaryDirectory() as scratch:
        browser = Chromium(program, Path(scratch) / "profile")
        try:
            browser.look(*_EXPLORER_SIZE)
            text = (docs / "tutorial-explorer.md").read_text(encoding="utf-8")
            PlayedPage(browser, Path(scratch), serve, keep).play(text)
        finally:
            browser.close()
            for one in servers:
                one.process.kill()
                one.process.communicate(timeout=30)


def main(folder: str) -> None:
    """Write docs/images/demo.png and report.png from the comparison and the diagnosis of a workspace."""
    if folder == "explorer":
        explorer_pictures()
        return
    workspace = Workspace.open(folder)
    images = Path(__file__).parent / "images"
    images.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        page = Path(scratch) / "fall.html"
        page.write_text(fall_page(workspace), encoding="utf-8")
        screenshot(page, images / "demo.png", 1190, 470)
        page = Path(scratch) / "report.html"
        report(workspace, page)
        screenshot(page, images / "report.png", 1240, 1420)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "demo")
