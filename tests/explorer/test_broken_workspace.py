"""A workspace that cannot be read shows what to do about it, and no traceback."""

import panel as pn
import pytest

from inflight.explorer.page import open_page
from inflight.explorer.session import ExplorerSession


def shown(template) -> str:
    """Return all text of a page."""
    return " ".join(str(one.object) for part in template.main for one in part.select(pn.pane.HTML))


def without_mission(root):
    (root / "mission.yaml").unlink()
    return "mission.yaml", "inflight new MISSION DIR"


def with_a_wrong_mission(root):
    text = (root / "mission.yaml").read_text(encoding="utf-8")
    (root / "mission.yaml").write_text(text.replace("comparisons:", "comparisonss:"), encoding="utf-8")
    return "mission.yaml", "comparisonss"


def with_a_damaged_database(root):
    for one in root.glob("catalog.db*"):
        one.unlink()
    (root / "catalog.db").write_bytes(b"no database" * 1000)
    return "catalog.db", "What to do"


def with_code(root):
    text = (root / "mission.yaml").read_text(encoding="utf-8")
    text = text.replace("comparisons:", "effects: [effects/heater.py]\ncomparisons:", 1)
    (root / "mission.yaml").write_text(text, encoding="utf-8")
    (root / "effects").mkdir()
    (root / "effects/heater.py").write_text(f"open({str(root / 'was-run')!r}, 'w')\n", encoding="utf-8")
    return "effects/heater.py", "--allow-code"


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("spoil", [without_mission, with_a_wrong_mission, with_a_damaged_database, with_code])
def test_a_page_of_a_broken_workspace_says_what_to_do(workspace, spoil, capsys):
    session = ExplorerSession(workspace, workers=1)
    try:
        parts = spoil(workspace.root)
        text = shown(open_page(session))
    finally:
        session.close()
    for part in (*parts, "What to do"):
        assert part in text
    assert "unexpected" not in text
    assert not (workspace.root / "was-run").exists()
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_who_allows_it_has_the_effects_of_the_workspace_in_python(workspace):
    with_code(workspace.root)
    session = ExplorerSession(workspace, workers=1, allow_code=True)
    open_page(session)
    session.close()
    assert (workspace.root / "was-run").exists()
