"""Draw the pictures of README and documentation from a workspace that ``make demo`` has made.

Run ``.venv/bin/python docs/make_pictures.py demo``; a Chromium on the path turns the page into a PNG.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import compare, report

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
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


def main(folder: str) -> None:
    """Write docs/images/demo.png and report.png from the comparison and the diagnosis of a workspace."""
    workspace = Workspace.open(folder)
    images = Path(__file__).parent / "images"
    images.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        page = Path(scratch) / "compare.html"
        compare(Catalog(workspace.root), workspace.mission(), output=page)
        screenshot(page, images / "demo.png", 1200, 820)
        page = Path(scratch) / "report.html"
        report(Catalog(workspace.root), workspace.mission(), page)
        screenshot(page, images / "report.png", 1240, 1420)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "demo")
