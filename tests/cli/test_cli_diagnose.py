"""The missing effect by the command line: found, added, dropped, taken back, told to people and programs."""

import csv
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from heated_mission import make_heated_workspace
from tiny_mission import TINY_YAML

from inflight.catalog import Catalog, Workspace
from inflight.cli.diagnosis_text import _next_step, only_moves_with
from inflight.explorer.diagnosis_view import diagnosis_sections
from inflight.explorer.session import ExplorerSession
from inflight.tasks.analysis import last_diagnosis
from inflight.tasks.analysis.diagnosis import diagnose
from inflight.tasks.models import current_model

EFFECT = "channel_field(heater_current)"


@pytest.fixture(scope="module")
def heated(tmp_path_factory) -> Workspace:
    """A workspace with a heater's field hidden, and evidence of its library; copied, never changed."""
    made = make_heated_workspace(tmp_path_factory.mktemp("heated") / "heated")
    diagnose(Catalog(made.root), made.mission())
    return made


@pytest.fixture
def root(heated, tmp_path):
    shutil.copytree(heated.root, tmp_path / "copy")
    return tmp_path / "copy"


def test_diagnose_prints_the_fields_of_a_diagnosis_and_keeps_them(inflight, root):
    told = inflight("diagnose", "--no-prefect", "--json", "-w", root)
    assert told.code == 0
    found = told.json
    wanted = diagnose(Catalog(root), Workspace.open(root).mission()).as_json()
    assert set(found) == set(wanted)
    assert (found["command"], found["verdict"], found["effects"]) == (
        "diagnose",
        "FOUND",
        wanted["effects"],
    )
    kept = last_diagnosis(Workspace.open(root))
    assert kept.pop("asked")["settings"]["comparison"] == "main"
    assert kept == found
    assert not list((root / "reports").glob("*.part"))


def test_diagnose_tells_a_person_what_was_found_and_what_to_type_next(inflight, root):
    told = inflight("diagnose", "--no-prefect", "--rounds", 1, "-w", root).out
    for part in (
        "found: the largest cause is beyond doubt",
        "A field that follows heater_current (",
        "nT/A on x",
        "noise floor",
        "model tiny-ideal version 1",
    ):
        assert part in told
    assert "(placebo: shifted in time)" not in told
    more = inflight("diagnose", "--no-prefect", "--rounds", 1, "--details", "-w", root).out
    for part in ("nT/mA", "(placebo: shifted in time)", "why it stopped"):
        assert part in more
    assert f'next: inflight add "{EFFECT}"' in told


def test_add_drop_and_undo_are_versions_with_errors_before_and_after(inflight, root):
    added = inflight("add", EFFECT, "--json", "-w", root).json
    assert added["command"] == "add"
    assert added["model"] == {"name": "tiny-ideal", "version": 2, "parent": 1}
    before, after = added["error"]["held_out_nT"]
    assert after < 0.3 * before
    assert {"parameter", "by", "sigma", "unit"} <= set(added["moved"][0])
    dropped = inflight("drop", "channel_field_heater_current", "--json", "-w", root).json
    assert dropped["error"]["held_out_nT"] == pytest.approx([after, before])
    undone = inflight("undo", "--json", "-w", root).json
    assert undone["model"] == {"name": "tiny-ideal", "version": 4, "parent": 3}
    assert undone["error"]["held_out_nT"] == pytest.approx([before, after])
    items = inflight("model", "history", "--json", "-w", root).json["items"]
    assert [item["used"] for item in items] == [False, False, False, True]
    assert "back to version 2" in items[-1]["message"]


def test_an_added_effect_is_told_to_a_person(inflight, root, tmp_path):
    entry = tmp_path / "entry.yaml"
    entry.write_text("- {effect: channel_field, name: leak, channel: heater_current}\n", encoding="utf-8")
    told = inflight("add", entry, "-w", root).out
    assert "tiny-ideal version 2: add channel_field(heater_current)" in told
    assert "on days not used in the fit" in told
    assert "leak.coefficient[x]" in told
    assert "vector_sensor.offset[x]" in told
    assert "inflight reprocess" in told


def test_an_effect_added_alone_says_that_the_diagnosis_has_other_numbers_with_all_it_found(inflight, root):
    inflight("diagnose", "--no-prefect", "--rounds", 1, "-w", root)
    path = root / "reports" / "diagnosis-main.json"
    kept = json.loads(path.read_text("utf-8"))
    told = next(one for one in kept["effects"] if one["name"] == EFFECT)
    # As if it had been fitted with another current that goes with it.
    told["coefficients"][0]["value"] += 20.0 * told["coefficients"][0]["sigma"]
    kept["effects"].append(told | {"name": "channel_field(battery_current)"})
    path.write_text(json.dumps(kept), encoding="utf-8")
    shown = inflight("add", EFFECT, "-w", root).out
    assert f"the diagnosis has {told['coefficients'][0]['name']} " in shown
    assert "with channel_field(battery_current) beside it" in shown
    assert "inflight undo, then inflight auto" in shown


def test_a_drift_that_the_products_follow_is_nothing_to_add(root):
    found = diagnose(Catalog(root), Workspace.open(root).mission())
    drift = replace(found.entries[0], name="scale_drift", command='inflight add "scale_drift"')
    effects = (replace(found.effects[0], name="scale_drift"),)
    plain = replace(found, entries=(drift,), effects=effects)
    assert _next_step(plain.as_json()).startswith('next: inflight add "scale_drift"')
    followed = plain.with_products("linear").as_json()
    assert "follow the drift of the scale factors already" in followed["sentence"]
    assert followed["entries"][0]["how_sure"].endswith("the products follow it")
    assert "add" not in _next_step(followed).replace("nothing to add", "")


def test_a_wrong_number_is_told_and_fitted_anew(inflight, root):
    """The number is off by ten of its sigmas: freed, it is right again, and what is left is noise."""
    inflight("add", EFFECT, "--json", "-w", root)
    place = Workspace.open(root)
    cat, mission = Catalog(place.root), place.mission()
    model = current_model(cat, mission).model
    entry = model.effect("channel_field_heater_current")
    timed = entry.parameters["coefficient"]
    wrong = replace(timed, value=timed.value + 30.0 * timed.sigma)
    wrong_model = model.replace(entry.with_parameters({"coefficient": wrong}))
    cat.save_model(wrong_model.name, wrong_model.text, 2, "a typing error", new_version=True)
    told = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    (found,) = (one for one in told["entries"] if one["name"] == "channel_field_heater_current.coefficient")
    assert found["command"] == "inflight refit channel_field_heater_current.coefficient"
    refitted = inflight(*found["command"].split()[1:], "--json", "-w", root).json
    before, after = refitted["error"]["held_out_nT"]
    assert after < 0.9 * before
    value = current_model(cat, mission).model.effect(entry.name).parameters["coefficient"].value
    assert np.all(np.abs(value - timed.value) < 4 * timed.sigma)
    assert inflight("diagnose", "--no-prefect", "--json", "-w", root).json["verdict"] == "NOTHING_LEFT"
    assert inflight("refit", "coefficient", "-w", root).code == 1


def test_days_that_taught_a_number_are_counted_once(inflight, root):
    """Fitted twice from the same days, a number is known no better."""
    inflight("add", EFFECT, "--json", "-w", root)
    place = Workspace.open(root)

    def stated():
        model = current_model(Catalog(place.root), place.mission()).model
        return model.effect("channel_field_heater_current").parameters["coefficient"].sigma

    first = stated()
    inflight("refit", "channel_field_heater_current.coefficient", "--json", "-w", root)
    inflight("refit", "--json", "-w", root)
    np.testing.assert_allclose(stated(), first, rtol=0.05)


def test_auto_saves_what_it_found_and_the_next_one_finds_nothing(inflight, root):
    told = inflight("auto", "--no-prefect", "--json", "-w", root).json
    assert (told["command"], [one["effect"] for one in told["versions"]]) == ("auto", [f"auto: add {EFFECT}"])
    assert told["stopped"]
    again = inflight("auto", "--no-prefect", "--workers", 1, "-w", root)
    assert again.code == 0
    assert "only noise remains" in again.out
    assert last_diagnosis(Workspace.open(root))["model"]["version"] == 2


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("add", "chanel_field(heater_current)"), 1, "did you mean 'channel_field(heater_current)'"),
        (("drop", "heater"), 1, "has no effect 'heater'"),
        (("undo",), 1, "where it began"),
        (("add", "nowhere.yaml"), 2, "nowhere.yaml"),
        (("diagnose", "--comparison", "mian"), 2, "did you mean 'main'"),
        (("diagnose", "--no-prefect", "--start", "2030-01-01"), 1, "no day of the span"),
        (("diagnose", "--no-prefect", "--start", "soon"), 2, "is no date"),
    ],
)
def test_wrong_commands_are_answered_with_what_is_wrong(inflight, root, arguments, code, message):
    told = inflight(*arguments, "--json", "-w", root)
    assert told.code == code
    assert message in told.json["error"]["message"]
    assert told.json["error"]["remedy"]


def test_a_comparison_without_rows_is_refused(inflight, tmp_path):
    (tmp_path / "spin.yaml").write_text(
        TINY_YAML.replace(
            "{kind: scalar, vector: turning, scalar: absolute}", "{kind: spin, vector: turning}"
        ),
        encoding="utf-8",
    )
    made = Workspace.create(tmp_path / "spin", tmp_path / "spin.yaml")
    told = inflight("diagnose", "--json", "-w", made.root)
    assert told.code == 2
    assert "kind 'spin'" in told.json["error"]["message"]


def test_help_does_not_wait_for_what_it_does_not_need():
    code = """
import json, sys
from inflight.cli import main
try:
    main(["add", "--help"])
except SystemExit:
    heavy = ("prefect", "bokeh", "numba", "xarray", "dask")
    print(json.dumps([name for name in heavy if name in sys.modules]))
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(told.stdout.splitlines()[-1]) == []


def test_who_changes_a_model_does_not_wait_for_what_compiles_loops():
    code = (
        "import sys, inflight.tasks.analysis.revise; print('numba' in sys.modules, 'prefect' in sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["False", "False"]


def test_a_wrong_lag_is_told_set_and_taken_back(inflight, root):
    """The model's heater acts late, and the data's at once: the lag is set to what the data say."""
    entry = "{effect: channel_field, name: leak, channel: heater_current, lag: 900 s}"
    inflight("add", entry, "--json", "-w", root)
    cat, mission = Catalog(root), Workspace.open(root).mission()
    added = current_model(cat, mission).model
    leak = added.effect("leak")
    assert leak.effect.given["lag"] == "900 s"
    refused = inflight("add", "leak.lag", "-w", root)
    assert refused.code == 1
    found = inflight("set", "leak.lag=0s", "--json", "-w", root).json
    before, after = found["error"]["held_out_nT"]
    assert after < 0.9 * before
    assert found["effect"] == "set leak.lag=0s"
    assert current_model(cat, mission).model.effect("leak").effect.channels == ("heater_current",)
    assert inflight("diagnose", "--no-prefect", "--json", "-w", root).json["verdict"] == "NOTHING_LEFT"
    undone = inflight("undo", "--json", "-w", root).json
    assert current_model(cat, mission).model.effect("leak").effect.given["lag"] == "900 s"
    # One model has one residual, whichever way led to it.
    assert undone["error"]["held_out_nT"] == pytest.approx([after, before], rel=0.01)
    inflight("set", "leak.lag=0s", "--json", "-w", root)
    worse = inflight("set", "leak.lag=5000s", "-w", root).out
    assert "more is left with this than before. next: inflight undo" in worse
    assert inflight("set", "leak.lag", "-w", root).code == 1
    assert inflight("set", "leak.log=3s", "-w", root).code == 1


#: What a person does not read: names of the machine, and words of the search's own.
MACHINE_WORDS = (
    "held out",
    "held-out",
    "ledger",
    "ghost",
    "no_work",
    "no work",
    "repeatable",
    "confounded",
    "nothing_left",
    "not_identifiable",
    "unknown_effect",
    "retained",
)


def test_the_loop_tells_each_step_the_next_one_and_never_what_is_stale(inflight, root):
    """What a newcomer does, in order; every page and line in plain words."""
    plain = ("--no-prefect", "-w", root)
    told = [inflight("reprocess", *plain).out]
    assert "next: inflight compare" in told[-1]
    told.append(inflight("compare", "-w", root).out)
    assert "next: inflight diagnose" in told[-1]
    told.append(inflight("diagnose", *plain).out)
    assert f'next: inflight add "{EFFECT}"' in told[-1]
    told.append(inflight("compare", "-w", root).out)
    assert "the diagnosis of model version 1: A field that follows heater_current" in told[-1]
    assert f'next: inflight add "{EFFECT}"' in told[-1]
    told.append(inflight("report", "-w", root).out)
    assert told[-1].startswith("found: the largest cause is beyond doubt")
    assert f'next: inflight add "{EFFECT}"' in told[-1]
    told.append(inflight("add", EFFECT, "-w", root).out)
    assert "next: inflight reprocess, then inflight compare" in told[-1]
    stale = inflight("compare", "-w", root).out
    assert "these products are of model version 1; in use is version 2. next: inflight reprocess" in stale
    session = ExplorerSession(Workspace.open(root))
    shown = session.last_diagnosis("main")
    session.close()
    assert shown["stale"] == "tiny-ideal version 2"
    assert "Not of the model in use." in "".join(diagnosis_sections(shown)[0][1])
    told.append(inflight("reprocess", *plain).out)
    told.append(inflight("compare", "-w", root).out)
    assert "The residual is at its noise floor" in told[-1]
    assert "it could be" not in told[-1]
    assert "next: inflight release VERSION" in told[-1]
    told.append(inflight("model", "history", "-w", root).out)
    assert "next: inflight" in told[-1]
    twice = inflight("add", EFFECT, "-w", root)
    assert twice.code == 1
    assert f"the model has {EFFECT} already" in twice.err
    told.append(inflight("release", "1.0", *plain).out)
    folder = root / "releases" / "1.0"
    notes = (folder / "RELEASE_NOTES.md").read_text("utf-8")
    for heading in ("## Data", "## Metadata", "## Interface", "## Known problems"):
        assert heading in notes
    assert "model tiny-ideal version 2" in notes
    assert "the diagnosis is of model version 1, the products are of 2" in notes
    assert "The residual is at its noise floor" in (folder / "validation" / "VALIDATION.md").read_text(
        "utf-8"
    )
    assert {path.suffix for path in (folder / "tables").iterdir()} == {".zarr", ".csv", ".cdf"}
    with (folder / "gaps.csv").open(encoding="utf-8") as stream:
        gaps = list(csv.DictReader(stream))
    assert {row["gaps"] for row in gaps} == {"0"}
    assert all(int(row["samples"]) > 0 for row in gaps)
    days = len(list((folder / "calendar" / "l2-field").rglob("*.svg")))
    assert days == inflight("catalog", "show", "l2/field", "--json", "-w", root).out.count('"published"')
    pages = {
        name: (root / "reports" / f"{name}-main.html").read_text("utf-8") for name in ("compare", "report")
    }
    for heading in (
        "How the error falls, each day",
        "What each change took off",
        "left above the noise floor",
    ):
        assert heading in pages["compare"]
    for heading in ("What each cause would make", "what it would make", "Steps of the search"):
        assert heading in pages["report"]
    read = [re.sub(r"<script.*?</script>|<[^>]+>", " ", page, flags=re.DOTALL) for page in pages.values()]
    for text in (*told, *read):
        found = [word for word in MACHINE_WORDS if word in text.lower()]
        assert not found, text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("drop", "heter"), "has no effect 'heter'"),
        (("refit", "nothing"), "has no number 'nothing'"),
        (("set", "turning.nothing=3s"), "has no number"),
        (("set", "nothing"), "sets no number"),
        (("undo",), "where it began"),
        (("release", "1 0"), "is no release version"),
        (("release", "1.0"), "nothing is published that matches"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(
    inflight, heated, tmp_path, monkeypatch, arguments, message
):
    def work(*arguments, **options):
        raise AssertionError("no work may begin")

    monkeypatch.setattr("inflight.tasks.analysis.revise.make_pass", work)
    monkeypatch.setattr("inflight.flows.run_with_prefect", work)
    empty = Workspace.create(tmp_path / "empty", heated.mission_file).root
    told = inflight(*arguments, "--json", "-w", empty if arguments[0] == "release" else heated.root)
    assert told.code == 1
    assert message in told.json["error"]["message"]


def test_what_only_moves_with_a_cause_is_told_as_that():
    found = {
        "effects": [{"channels": ["heater_current"]}],
        "candidates": [{"placebo": False, "channels": ["coil"], "gain_now": 0.3}],
        "remaining": {"verdict": "UNKNOWN_EFFECT"},
    }
    assert only_moves_with(found, ["heater_current", "coil"]) == ""
    found["candidates"][0]["gain_now"] = 0.001
    assert only_moves_with(found, ["heater_current", "coil"]).startswith(
        "coil only moves with heater_current"
    )
    found["remaining"]["verdict"] = "NOTHING_LEFT"
    assert "orbit phase and coil only move" in only_moves_with(found, ["orbit phase", "coil"])
    assert only_moves_with({**found, "effects": []}, ["coil"]) == ""
