"""The walks of the architecture name functions that stand in the files they name."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ("docs/architecture.md", "docs/architecture-walks/two-sensors.md")
STEPS = [
    (page, row)
    for page in PAGES
    for row in re.findall(r"^\| \d+ \|.*\|$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
]
FILES = [path for top in ("inflight", "catalog", "tasks") for path in (ROOT / top).rglob("*.py")]


def found(files, page):
    """Return the source of the files that a cell names: by the end of their paths."""
    names = re.findall(r"`([\w/]+\.py)`", files)
    here = [path for name in names for path in FILES if path.as_posix().endswith(f"/{name}")]
    assert len({path.name for path in here}) == len({Path(name).name for name in names}), (page, files)
    return "\n".join(path.read_text(encoding="utf-8") for path in here)


@pytest.mark.parametrize(("page", "row"), STEPS, ids=[row.split("|")[2].strip()[:40] for _, row in STEPS])
def test_what_a_step_names_stands_where_it_says(page, row):
    _, _, _, functions, files, _ = row.split("|")
    source = found(files, page)
    for name in re.findall(r"`([A-Za-z_.]+)`", functions):
        assert re.search(rf"^\s*(def|class) {name.rpartition('.')[2]}\b", source, re.MULTILINE), (name, files)


def test_the_walks_have_all_their_steps():
    assert len(STEPS) > 35
