"""The tutorial's own effect, from the page into a workspace and through the whole chain."""

import re
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from tiny_mission import TINY_YAML, deliver_tiny_day

from inflight.catalog import Catalog, Workspace
from inflight.effects import known_effects
from inflight.errors import MissionError, ModelError
from inflight.flows import dask_client, run_without_prefect
from inflight.flows.cluster import SCHEDULER_VARIABLE
from inflight.mission import sensors_of
from inflight.model import make_effect
from inflight.tasks import current_model, find_model
from inflight.tasks.models import effect_sources

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "how-to" / "own-effect.md").read_text(encoding="utf-8")
DAYS = ("2024-03-01", "2024-03-02")
HOUSEKEEPING = """\
  power:
    role: housekeeping
    cadence: 60 s
    files: {pattern: "power_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      heater_current: {variable: heater, unit: mA, kind: heater}
      boom_temperature: {variable: boom, unit: degC, kind: temperature}
comparisons:"""
MODEL = """\
model: with-heater
mission: tiny
effects:
  - effect: vector_sensor
    sensor: turning
    scale_factor: {time: block, sigma: 0.002}
    misalignment: {time: block, sigma: 0.05}
    offset: {time: block, sigma: 50}
"""


def block(language: str, number: int = 0) -> str:
    """A code block of the page."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)[number]


def housekeeping(day: str) -> tuple[np.ndarray, np.ndarray]:
    """Heater current (mA) and boom temperature (degC) of a day, a sample a minute."""
    minutes = np.arange(1440)
    return 500.0 * (minutes % 90 < 40), np.round(8 + 6 * np.sin(2 * np.pi * minutes / 700), 2)


@pytest.fixture
def workspace(tmp_path) -> Workspace:
    """The tiny mission with a heater, and what the page says put in place; nothing ingested."""
    source = tmp_path / "tiny.yaml"
    named = block("yaml") + "preflight: models/start.yaml\n"
    source.write_text(TINY_YAML.replace("comparisons:", HOUSEKEEPING) + named, encoding="utf-8")
    path = re.search(r"`(effects/\w+\.py)`", PAGE)[1]
    for name, text in {path: block("python"), "models/start.yaml": MODEL + block("yaml", 1)}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    made = Workspace.create(tmp_path / "workspace", source)
    for day in DAYS:
        deliver_heated_day(made.data, day)
    return made


def deliver_heated_day(folder: Path, day: str) -> None:
    """A day of the tiny mission whose vector sensor reads the heater's field, too."""
    heater, boom = housekeeping(day)
    added = (heater / 1000 * (boom < 10.0))[:, None] * np.array([4.0, 0.0, -2.0])
    deliver_tiny_day(folder, day)
    path = folder / f"turning_{day.replace('-', '')}.csv"
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for row, more in zip(rows[1:], added, strict=True):
        row[1:] = [f"{float(value) + extra:.3f}" for value, extra in zip(row[1:], more, strict=True)]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")
    stamps = [row[0] for row in rows[1:]]
    lines = [f"{t},{i},{c}" for t, i, c in zip(stamps, heater, boom, strict=True)]
    text = "time,heater,boom\n" + "\n".join(lines) + "\n"
    (folder / f"power_{day.replace('-', '')}.csv").write_text(text, encoding="utf-8")


def test_the_tutorial_s_effect_is_about_ten_lines():
    lines = [line for line in block("python").splitlines() if line.strip()]
    assert len(lines) <= 10


@pytest.fixture
def one_worker(monkeypatch):
    """A Dask process that all steps of a test share, started before the effect's file was read."""
    with dask_client(1) as client:
        monkeypatch.setenv(SCHEDULER_VARIABLE, str(client.scheduler.address))
        yield


@pytest.mark.usefixtures("one_worker")
def test_the_tutorial_s_effect_goes_through_the_chain_and_its_workers(workspace):
    for name in ("ingest", "reprocess"):
        assert run_without_prefect(name, workspace, {}).exit_code == 0
    cat = Catalog(workspace.root)
    day = cat.read_day("l2/field", DAYS[1])
    heater, boom = housekeeping(DAYS[1])
    expected = (heater / 1000 * (boom < 10.0))[:, None] * np.array([4.0, 0.0, -2.0])
    assert np.allclose(day["correction_cold_heater"].values, expected, rtol=0, atol=2e-3)
    # Without the effect the readings' own noise, 0.05 nT each, would be exceeded more than tenfold.
    assert float(day["residual"].std()) < 0.1
    changed(workspace, "10.0", "9.0")
    again = run_without_prefect("reprocess", workspace, {})
    assert again.as_json()["days"]["done"] == 2, "a changed effect makes the days anew"


def changed(workspace, *texts):
    path = workspace.root / "effects" / "heater.py"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(*texts), encoding="utf-8")


def test_a_changed_file_is_a_step_of_the_history_and_the_old_text_the_old_model(workspace):
    cat, mission = Catalog(workspace.root), workspace.mission()
    first = current_model(cat, mission)
    derived = first.model.with_values({"cold_heater.strength[x]": 7.0})
    second = cat.save_model(derived.name, derived.text, parent=first.version, message="refit")
    assert current_model(cat, mission).version == second
    changed(workspace, "10.0", "9.0")
    third = current_model(cat, mission)
    assert (third.version, cat.models()[-1].parent) == (second + 1, second)
    assert cat.models()[-1].message == "effects/heater.py changed"
    assert third.model.effect("cold_heater").parameters["strength"].value[0, 0] == 7.0
    assert current_model(cat, mission).version == third.version, "asked again, nothing is new"
    changed(workspace, "9.0", "10.0")
    assert current_model(cat, mission).version == second


def test_looking_at_a_model_saves_nothing(workspace):
    cat = Catalog(workspace.root)
    assert find_model(cat, workspace.mission()).version == 0
    assert cat.models() == []


def test_two_workspaces_keep_their_own_effects(workspace, tmp_path):
    cat, mission = Catalog(workspace.root), workspace.mission()
    own = effect_sources(cat, mission)
    assert "cold_heater" in known_effects(own)
    assert "cold_heater" not in known_effects()
    with pytest.raises(ModelError, match="no effect 'cold_heater'"):
        make_effect({"effect": "cold_heater"}, sensors_of(mission))


def test_a_file_that_is_gone_or_no_text_is_told(workspace):
    path = workspace.root / "effects" / "heater.py"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MissionError, match=r"effects/heater\.py' is no text"):
        current_model(Catalog(workspace.root), workspace.mission())
    path.unlink()
    with pytest.raises(MissionError, match=r"effects/heater\.py' is not there.*put it into the workspace"):
        current_model(Catalog(workspace.root), workspace.mission())


REFERENCE = (DOCS / "reference" / "effects.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("label", sorted(known_effects()))
def test_the_reference_lists_each_effect_with_parameters_and_options(label):
    row = next((line for line in REFERENCE.splitlines() if line.startswith(f"| `{label}` |")), "")
    kind = known_effects()[label]
    for name in (*kind.parameters(), *kind.option_names()):
        assert f"`{name}`" in row, f"docs/reference/effects.md: {label} lacks {name}"


def test_the_reference_lists_no_effect_that_is_not_there():
    assert set(re.findall(r"^\| `(\w+)` \| [\w ]+ \| (?:vector|scalar|either) \|", REFERENCE, re.M)) == set(
        known_effects()
    )


def test_the_reference_s_example_is_a_model():
    from inflight.catalog import shipped_missions
    from inflight.mission import Mission

    mission = Mission.parse(shipped_missions()["champ"].read_text(encoding="utf-8"))
    text = re.search(r"^```yaml\n(.*?)^```", REFERENCE, flags=re.MULTILINE | re.DOTALL)[1]
    entry = YAML(typ="safe").load(text)[0]
    made = make_effect(entry, sensors_of(mission), mission=mission)
    assert made.parameters["coefficient"].value.shape == (3, 2)
