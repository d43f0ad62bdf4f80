"""A user's own effects in files: found, refused with file and line, kept apart, and made anew by workers."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
from effect_cases import MISSION, SENSORS, true_samples

from inflight.effects import EffectSource, effect_class, known_effects
from inflight.errors import InflightError, ModelError
from inflight.model import Model, make_effect

GOOD = """\
from inflight import Effect, Parameter

GAIN = 2.0


class Leak(Effect):
    \"\"\"A leak.\"\"\"

    channels = ("solar_current",)
    strength = Parameter("nT/A", axes=("x", "y", "z"), sigma=1.0)

    def field(self, samples, values, sensor):
        return GAIN * self.channel(samples, "A")[:, None] * values["strength"]
"""
ENTRY = {"effect": "leak", "sensor": "fgm", "strength": [1.0, -2.0, 3.0]}
TEXT = """\
model: m
mission: champ
effects:
  - {effect: leak, sensor: fgm, strength: [1.0, -2.0, 3.0]}
"""


def test_an_effect_of_a_file_acts_like_one_of_the_library():
    own = (EffectSource("effects/leak.py", GOOD),)
    model = Model.parse(TEXT, MISSION, own=own)
    truth = true_samples(0)
    raw = model.disturb(truth)
    added = 2e-3 * truth["solar_current"].values[:, None] * np.array([1.0, -2.0, 3.0])
    assert np.allclose(raw["vector"].values - truth["vector"].values, added, rtol=0, atol=1e-9)
    assert np.allclose(model.correct(raw)["vector"].values, truth["vector"].values, rtol=0, atol=1e-9)
    assert f"source: {own[0].sha}" in model.text
    assert Model.parse(model.text, MISSION, own=own).text == model.text


def test_a_changed_file_is_another_model():
    before, after = (
        Model.parse(TEXT, MISSION, own=(EffectSource("effects/leak.py", text),))
        for text in (GOOD, GOOD.replace("2.0", "3.0"))
    )
    assert before.sha != after.sha
    assert [change["key"] for change in before.changes(after)] == ["source"]


def test_two_missions_with_a_class_of_one_name_keep_their_own():
    truth = true_samples(0)
    texts = GOOD, GOOD.replace("GAIN = 2.0", "GAIN = -5.0")
    models = [Model.parse(TEXT, MISSION, own=(EffectSource("effects/leak.py", text),)) for text in texts]
    added = [model.disturb(truth)["vector"].values - truth["vector"].values for model in models]
    assert np.allclose(added[1], -2.5 * added[0])
    with pytest.raises(ModelError, match="no effect 'leak'"):
        effect_class("leak")


def test_a_mission_s_own_effect_wins_over_the_library_for_that_mission_only():
    own = (EffectSource("mine.py", GOOD.replace("Leak", "Remanent")),)
    assert known_effects(own)["remanent"].source is own[0]
    assert known_effects()["remanent"].source is None


def test_the_file_runs_once_for_each_text(monkeypatch):
    monkeypatch.setattr(sys, "_runs", 0, raising=False)
    source = EffectSource("once.py", "import sys\nsys._runs += 1\n" + GOOD)
    kinds = {source.classes()["leak"], EffectSource("once.py", source.text).classes()["leak"]}
    assert len(kinds) == 1
    assert sys._runs == 1


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = 1\nclass A(:\n", "line 2: not Python"),
        ("x = 1\n\ny = 1 / 0\n", "line 3: ZeroDivisionError"),
        ("import no_such_module_at_all\n", "line 1: ModuleNotFoundError"),
        ("from inflight import Effect\n", "defines no effect"),
        ("from inflight import Effect\nclass Idle(Effect):\n    pass\n", "Idle says nothing"),
        (
            "from inflight import Effect\nclass Half(Effect):\n    correct = len\n",
            "only one of 'correct' and 'disturb'",
        ),
        (GOOD.replace("strength", "sensor"), "calls a parameter sensor"),
        (GOOD.replace("strength", "drive"), "calls a parameter drive"),
    ],
)
def test_a_wrong_file_is_refused_by_name_line_and_remedy(text, told):
    with pytest.raises(ModelError, match=told) as caught:
        EffectSource("effects/wrong.py", text).classes()
    assert caught.value.file == "effects/wrong.py"
    assert caught.value.remedy


def test_two_files_that_define_one_name_are_refused():
    with pytest.raises(ModelError, match=r"two\.py: effect 'leak' is defined in one\.py too"):
        known_effects((EffectSource("one.py", GOOD), EffectSource("two.py", GOOD)))


def test_a_model_names_the_file_that_is_wrong():
    with pytest.raises(InflightError, match=r"my\.yaml: effects/wrong\.py: line 1"):
        Model.parse(TEXT, MISSION, "my.yaml", (EffectSource("effects/wrong.py", "1 / 0"),))


def test_an_effect_reaches_another_process(tmp_path):
    """As on a Dask worker: nothing but the pickle is known there."""
    entry = make_effect(ENTRY, SENSORS, (EffectSource("effects/leak.py", GOOD),), MISSION)
    path = tmp_path / "effect.pickle"
    path.write_bytes(pickle.dumps([entry, entry]))
    there = (
        "import pickle, sys\n"
        f"one, two = pickle.load(open({str(path)!r}, 'rb'))\n"
        "assert type(one.effect) is type(two.effect)\n"
        "print(one.name, type(one.effect).source.sha, one.parameters['strength'].value.tolist())\n"
    )
    done = subprocess.run([sys.executable, "-c", there], capture_output=True, text=True, check=True)
    assert done.stdout.split()[:2] == ["leak", entry.effect.source.sha]
    assert "[[1.0], [-2.0], [3.0]]" in done.stdout


def test_effects_of_the_library_are_pickled_with_their_options():
    entry = {"effect": "tone", "sensor": "fgm", "period": "20 s", "order": 2}
    effect = make_effect(entry, SENSORS, mission=MISSION).effect
    again = pickle.loads(pickle.dumps(effect))
    assert again.given == effect.given
    assert again.parameters() == effect.parameters()
