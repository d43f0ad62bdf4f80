"""Which model a workspace uses, as its pre-flight file changes."""

from inflight.catalog import Catalog, Workspace
from inflight.tasks import current_model

TEXT = """model: start
mission: champ
comparison: main
effects:
  - effect: vector_sensor
    sensor: fgm
    offset: {time: block, value: OFFSET, sigma: 10.0}
    scale_factor: {time: block, sigma: 0.001}
    misalignment: {time: block, sigma: 0.01}
"""


def used(workspace, offset):
    text = TEXT.replace("OFFSET", str(offset))
    (workspace.root / "models" / "champ-preflight.yaml").write_text(text, encoding="utf-8")
    found = current_model(Catalog(workspace.root), workspace.mission())
    return found.version, float(found.model.effect("vector_sensor").parameters["offset"].value[0, 0])


def test_the_model_follows_the_file_and_an_old_text_put_back_is_the_old_model(tmp_path):
    workspace = Workspace.create(tmp_path / "workspace", "champ")
    first = used(workspace, 5.0)
    assert used(workspace, 9.0) == (first[0] + 1, 9.0)
    assert used(workspace, 5.0) == first


def test_a_version_made_from_the_files_text_goes_before_it(tmp_path):
    workspace = Workspace.create(tmp_path / "workspace", "champ")
    version, _ = used(workspace, 5.0)
    catalog = Catalog(workspace.root)
    derived = current_model(catalog, workspace.mission()).model.text.replace("5.0", "7.0")
    newer = catalog.save_model("start", derived, parent=version, message="offset moved")
    assert used(workspace, 5.0) == (newer, 7.0)
