"""A model revised: what was hidden is added, dropped, taken back; products follow; history only grows."""

import shutil

import numpy as np
import pytest
from heated_mission import (
    HEATED_DAYS,
    HEATER_FIELD,
    heater_field,
    housekeeping,
    make_heated_workspace,
    nothing,
)
from scipy.signal import lfilter
from tiny_mission import TINY_START, tiny_readings

from inflight.catalog import Catalog, Workspace
from inflight.errors import ModelError, SettingsError
from inflight.tasks import current_model
from inflight.tasks.analysis import DiagnoseSettings, Workbench, compare, diagnosis, gram_pass
from inflight.tasks.analysis.diagnosis import plan_pass
from inflight.tasks.pipelines import reprocess

#: What both instruments of the tiny mission read at random, as the residual shows it, nT.
NOISE = 0.05 * np.sqrt(2)
#: The heater's field as ground tests would have told it.
PREFLIGHT = """\
model: tested
mission: tiny
effects:
  - effect: vector_sensor
    sensor: turning
    scale_factor: {time: block, sigma: 0.002}
    misalignment: {time: block, sigma: 0.05}
    offset: {time: block, sigma: 50}
  - effect: channel_field
    name: leak
    sensor: turning
    channel: heater_current
    coefficient: {unit: nT/A, value: [2.0, 0.0, -1.5], %s}
"""
OWN = """\
from inflight import Effect, Parameter


class ColdHeater(Effect):
    family = "current"
    channels = ("heater_current", "boom_temperature")
    strength = Parameter("nT/A", axes=("x", "y", "z"), sigma=20.0)

    def field(self, samples, values, sensor):
        cold = self.channel(samples, "degC", 1) < 10.0
        return (self.channel(samples, "A") * cold)[:, None] * values["strength"]
"""


def days_since_start(day: str) -> np.ndarray:
    """Days from the start of the record; (time, 1)."""
    passed = (np.datetime64(day) - np.datetime64(TINY_START)) / np.timedelta64(1, "D")
    return passed + np.arange(1440)[:, None] / 1440


def lagged(day: str, reading: np.ndarray) -> np.ndarray:
    """The heater's field through a response of 400 s, from the record's start."""
    before = [one for one in HEATED_DAYS if one <= day]
    current = np.concatenate([housekeeping(one)[0] for one in before]) / 1000
    share = 1 - np.exp(-60 / 400)
    # Between two readings the current is taken as their mean.
    start = [current[0] * (1 - share / 2)]
    slow = lfilter([share / 2, share / 2], [1, share - 1], current, zi=start)[0]
    return slow[-1440:, None] * HEATER_FIELD


def offset_step(day: str, reading: np.ndarray) -> np.ndarray:
    """The third day on, an offset of 1.5 nT on x."""
    return np.array([1.5, 0.0, 0.0]) * (days_since_start(day) >= 2)


def offset_step_within_a_block(day: str, reading: np.ndarray) -> np.ndarray:
    """From 07:23 of the third day on, the same."""
    return np.array([1.5, 0.0, 0.0]) * (days_since_start(day) >= 2 + (7 * 60 + 23) / 1440)


def bias_episode_within_blocks(day: str, reading: np.ndarray) -> np.ndarray:
    """From 05:10 of the second to 11:40 of the third day the scalar sensor reads 0.6 nT more."""
    t = days_since_start(day)
    return 0.6 * ((t >= 1 + (5 * 60 + 10) / 1440) & (t < 2 + (11 * 60 + 40) / 1440))


def offset_drift(day: str, reading: np.ndarray) -> np.ndarray:
    """An offset that grows by 0.8 nT/d on z."""
    return np.array([0.0, 0.0, 0.8]) * (days_since_start(day) - 2)


def scale_drift(day: str, reading: np.ndarray) -> np.ndarray:
    """A reading of y that grows by 20 ppm/d."""
    return reading * np.array([0.0, 2e-5, 0.0]) * (days_since_start(day) - 2)


def scale_step(day: str, reading: np.ndarray) -> np.ndarray:
    """The third day on, y reads 40 ppm more."""
    return reading * np.array([0.0, 4e-5, 0.0]) * (days_since_start(day) >= 2)


def angle_step(day: str, reading: np.ndarray) -> np.ndarray:
    """The third day on, the angle of x and z is larger by 0.003 deg: x reads less of z."""
    return sheared_by(0.003, reading) * (days_since_start(day) >= 2)


def angle_episode(day: str, reading: np.ndarray) -> np.ndarray:
    """The same for the second and third day."""
    return sheared_by(0.003, reading) * ((days_since_start(day) >= 1) & (days_since_start(day) < 3))


def angle_drift(day: str, reading: np.ndarray) -> np.ndarray:
    """The same angle, growing by 0.001 deg/d."""
    return sheared_by(0.001, reading) * (days_since_start(day) - 2)


def sheared_by(degrees: float, reading: np.ndarray) -> np.ndarray:
    """What a reading gains by a larger angle of x and z; (time, axis) nT."""
    return np.deg2rad(degrees) * reading[:, [2]] * np.array([1.0, 0.0, 0.0])


def bias_episode(day: str, reading: np.ndarray) -> np.ndarray:
    """The scalar sensor reads 0.6 nT more on the second and third day."""
    return 0.6 * ((days_since_start(day) >= 1) & (days_since_start(day) < 3))


def bias_drift(day: str, reading: np.ndarray) -> np.ndarray:
    """The scalar sensor's bias grows by 0.4 nT/d."""
    return 0.4 * (days_since_start(day) - 2)


def clock_drift(day: str, reading: np.ndarray) -> np.ndarray:
    """The scalar sensor's clock is slow by 0.3 s more each day: it reads an earlier field."""
    # The tiny mission's field steps at midnight; there the formula counts that the effect takes its rate by.
    whole = np.concatenate([tiny_readings(one)[2] for one in HEATED_DAYS])
    rate = np.gradient(whole, 60.0)
    rate[2:-2] = (8.0 * (whole[3:-1] - whole[1:-3]) - (whole[4:] - whole[:-4])) / (12 * 60.0)
    mine = rate.reshape(len(HEATED_DAYS), -1)[HEATED_DAYS.index(day)]
    return np.reshape(-0.3 * mine * (days_since_start(day)[:, 0] - 2), reading.shape)


@pytest.fixture(scope="module")
def heated(tmp_path_factory) -> Workspace:
    """A workspace with a heater's field hidden, and evidence of its library; copied, never changed."""
    made = make_heated_workspace(tmp_path_factory.mktemp("heated") / "heated")
    Workbench(Catalog(made.root), made.mission())
    return made


@pytest.fixture
def workspace(heated, tmp_path) -> Workspace:
    shutil.copytree(heated.root, tmp_path / "copy")
    return Workspace.open(tmp_path / "copy")


@pytest.fixture
def bench(workspace) -> Workbench:
    return Workbench(Catalog(workspace.root), workspace.mission())


def residual_of_products(workspace: Workspace) -> float:
    report = reprocess(Catalog(workspace.root), workspace.mission())
    assert report.exit_code == 0
    return report.extra["residual"]["after_nT"]


def test_adding_the_hidden_effect_recovers_its_numbers_and_the_noise(bench):
    told = bench.add("channel_field(heater_current)").as_json()
    values = {one["name"][-2]: (one["value"], one["sigma"], one["unit"]) for one in told["coefficients"]}
    for axis, truth in zip("xyz", HEATER_FIELD, strict=True):
        value, sigma, unit = values[axis]
        assert unit == "nT/mA"
        assert abs(value - truth / 1000) < 3 * sigma < 1e-4
    before, after = told["error"]["held_out_nT"]
    assert before > 4 * NOISE
    assert after == pytest.approx(NOISE, rel=0.03)
    assert told["error"]["in_sample_nT"][1] <= after
    assert (told["model"]["version"], told["model"]["parent"]) == (2, 1)


def test_what_the_offset_had_taken_over_is_told(bench):
    told = bench.add("heater_current").as_json()
    moved = {one["parameter"]: one for one in told["moved"]}
    # The residual sees an axis as far as the field lies along it: the mean is weighted by that.
    along = np.concatenate([tiny_readings(day)[1] for day in HEATED_DAYS]) ** 2
    current = np.concatenate([housekeeping(day)[0] for day in HEATED_DAYS]) / 1000
    for axis, field in zip("xz", HEATER_FIELD[[0, 2]], strict=True):
        mean = np.average(current, weights=along[:, "xyz".index(axis)])
        one = moved[f"vector_sensor.offset[{axis}]"]
        assert one["by"] == pytest.approx(-field * mean, abs=0.03)
        assert one["unit"] == "nT"
        assert one["sigma"] < abs(one["by"]) / 10


def test_the_products_use_the_new_model_and_again_the_old_one(workspace, bench):
    before = residual_of_products(workspace)
    assert before > 4 * NOISE
    bench.add("heater_current")
    assert residual_of_products(workspace) == pytest.approx(NOISE, rel=0.03)
    bench.undo()
    assert residual_of_products(workspace) == pytest.approx(before, rel=1e-6)


@pytest.mark.parametrize(
    ("hidden", "scalar", "name", "effect"),
    [
        (lagged, nothing, "channel_field(heater_current)", "channel_field"),
        (offset_step, nothing, "offset_step@2024-03-03", "offset_step"),
        (offset_step_within_a_block, nothing, "offset_step@2024-03-03T07:23", "offset_step"),
        (offset_drift, nothing, "offset_drift", "affine"),
        (scale_drift, nothing, "scale_drift", "affine"),
        (scale_step, nothing, "scale_step@2024-03-03", "scale_step"),
        (angle_step, nothing, "angle_step@2024-03-03", "angle_step"),
        (angle_episode, nothing, "angle_episode@2024-03-02/2024-03-04", "angle_episode"),
        (angle_drift, nothing, "angle_drift", "affine"),
        (nothing, bias_drift, "bias_drift", "scalar_bias"),
        (nothing, clock_drift, "clock_drift", "time_shift"),
        (
            nothing,
            bias_episode_within_blocks,
            "bias_episode@2024-03-02T05:10/2024-03-03T11:40",
            "bias_step",
        ),
        (nothing, bias_episode, "bias_episode@2024-03-02/2024-03-04", "bias_step"),
    ],
)
def test_whatever_is_added_takes_the_products_to_the_noise(tmp_path, hidden, scalar, name, effect):
    made = make_heated_workspace(tmp_path / "made", hidden, scalar)
    cat, mission = Catalog(made.root), made.mission()
    bench = Workbench(cat, mission)
    told = bench.add(name).as_json()
    assert told["error"]["held_out_nT"][0] > 1.5 * NOISE
    assert told["error"]["held_out_nT"][1] == pytest.approx(NOISE, rel=0.05)
    # What does more than add a field stands before the nine parameters.
    first = effect.startswith(("affine", "scale", "angle"))
    entry = current_model(cat, mission).model.effects[0 if first else -1]
    assert entry.effect.label() == effect
    if effect.startswith("angle"):
        found = entry.parameters["change"]
        assert np.all(np.abs(found.value[:, 0] - [0.0, 0.003, 0.0]) < 4 * found.sigma[:, 0])
        assert found.sigma[1, 0] < 0.0003
    assert residual_of_products(made) == pytest.approx(NOISE, rel=0.05)
    again = Workbench(cat, mission)
    assert [one.name for one in again.additions] or effect == "bias_step"
    fitted = again._fit(*again._fit_setup(again.additions, again.dropped), again.additions)
    assert np.sqrt(fitted.held_out) == pytest.approx(told["error"]["held_out_nT"][1], rel=0.02)


def test_auto_puts_a_step_into_the_model_at_its_moment(tmp_path):
    made = make_heated_workspace(tmp_path / "made", offset_step_within_a_block)
    cat, mission = Catalog(made.root), made.mission()
    found, steps = Workbench(cat, mission).auto()
    (one,) = found.effects
    told = np.datetime64(one.at[0].rstrip("Z"))
    off = abs(told - np.datetime64("2024-03-03T07:23")) / np.timedelta64(1, "s")
    assert off < 3 * one.at_sigma_s < 600
    added = current_model(cat, mission).model.effects[-1]
    assert added.effect.label() == "offset_step"
    assert np.datetime64(added.effect.given["at"].rstrip("Z")) == told
    assert steps[-1].held_out[1] == pytest.approx(found.residual["held_out_after_nT"], rel=0.01)
    assert steps[-1].held_out[1] == pytest.approx(NOISE, rel=0.05)
    assert residual_of_products(made) == pytest.approx(NOISE, rel=0.05)
    again = Workbench(cat, mission)
    fitted = again._fit(*again._fit_setup(again.additions, again.dropped), again.additions)
    assert np.sqrt(fitted.held_out) == pytest.approx(steps[-1].held_out[1], rel=0.02)


def test_a_lag_between_those_of_the_bank_is_found(tmp_path):
    made = make_heated_workspace(tmp_path / "made", lagged)
    bench = Workbench(Catalog(made.root), made.mission())
    bench.add("channel_field(heater_current)@lag=240s")
    given = bench.current.model.effect("channel_field_heater_current").effect.given
    assert float(given["lag"].removesuffix(" s")) == pytest.approx(400, rel=0.1)
    bench.undo()
    stated = bench.add("{effect: channel_field, channel: heater_current, lag: 900 s}")
    entry = bench.current.model.effect("channel_field_heater_current")
    assert entry.effect.given["lag"] == "900 s", "a lag that is stated is kept"
    assert stated.held_out[1] > 1.2 * NOISE


def test_history_only_grows_and_undo_goes_further_back_each_time(workspace, bench):
    cat, mission = Catalog(workspace.root), workspace.mission()
    texts = [bench.current.text]
    for effect in ("heater_current", "boom_temperature"):
        bench.add(effect)
        texts.append(bench.current.text)
    for version, text in ((4, texts[1]), (5, texts[0])):
        assert bench.undo().model.version == version
        used = current_model(cat, mission)
        assert (used.version, used.text) == (version, text)
    with pytest.raises(ModelError, match="where it began"):
        bench.undo()
    bench.add("heater_current")
    assert current_model(cat, mission).version == 6, "the same addition again is a new version"
    assert bench.current.text == texts[1]
    assert [record.parent for record in cat.models()] == [None, 1, 2, 3, 4, 5]


def test_a_dropped_effect_leaves_the_residual_it_had_explained(bench):
    first = bench.add("heater_current")
    bench.add("boom_temperature")
    gone = bench.drop("channel_field_heater_current")
    assert gone.held_out[1] == pytest.approx(first.held_out[0], rel=0.02)
    names = [entry.name for entry in bench.current.model.effects]
    assert names == ["vector_sensor", "channel_field_boom_temperature"]


@pytest.mark.parametrize("known", ["sigma: [1.0e-4, 1.0e-4, 1.0e-4]", "free: false"])
def test_an_effect_of_the_pre_flight_model_can_be_dropped_and_comes_back(workspace, known):
    (workspace.root / "models").mkdir(exist_ok=True)
    (workspace.root / "models" / "start.yaml").write_text(PREFLIGHT % known, encoding="utf-8")
    text = (workspace.root / "mission.yaml").read_text(encoding="utf-8")
    (workspace.root / "mission.yaml").write_text(text + "preflight: models/start.yaml\n", encoding="utf-8")
    cat, mission = Catalog(workspace.root), Workspace.open(workspace.root).mission()
    bench = Workbench(cat, mission)
    gone = bench.drop("leak")
    assert gone.held_out[0] == pytest.approx(NOISE, rel=0.03)
    assert gone.held_out[1] > 4 * NOISE
    assert Workbench(cat, mission).dropped == ["leak"]
    back = bench.undo()
    assert back.held_out[1] == pytest.approx(gone.held_out[0], rel=1e-6)
    assert [entry.name for entry in current_model(cat, mission).model.effects] == ["vector_sensor", "leak"]


def test_a_new_session_goes_on_where_the_last_one_was(workspace, bench):
    bench.add("heater_current")
    alone = Workbench(Catalog(workspace.root), workspace.mission())
    assert (alone.made.run, alone.root.version, alone.current.version) == ("", 1, 2)
    alone.add("boom_temperature")
    bench.undo()
    bench.add("heater_current")
    bench.add("boom_temperature")
    assert alone.current.text == bench.current.text


def test_a_record_that_is_the_same_is_not_surveyed_again(workspace, bench, monkeypatch):
    read = []
    fitted = gram_pass._fitted_value
    monkeypatch.setattr(gram_pass, "_fitted_value", lambda *given: read.append(given) or fitted(*given))
    cat, mission = Catalog(workspace.root), workspace.mission()
    first = plan_pass(cat, mission, DiagnoseSettings())
    assert not read
    # Days that were delivered again are.
    monkeypatch.setattr(diagnosis, "_surveyed", lambda *given: "other revisions")
    again = plan_pass(cat, mission, DiagnoseSettings())
    assert len(read) == 1
    assert (again.plan.key, again.plan.model.text) == (first.plan.key, first.plan.model.text)


def test_an_effect_of_ones_own_is_added_by_a_pass_of_its_columns(workspace):
    (workspace.root / "effects").mkdir()
    (workspace.root / "effects" / "heater.py").write_text(OWN, encoding="utf-8")
    text = (workspace.root / "mission.yaml").read_text(encoding="utf-8")
    (workspace.root / "mission.yaml").write_text(text + "effects: [effects/heater.py]\n", encoding="utf-8")
    cat, mission = Catalog(workspace.root), Workspace.open(workspace.root).mission()
    told = []
    bench = Workbench(cat, mission, progress=lambda *step: told.append(step))
    assert not [step for step in told if step[0] == "pass"], "the library's evidence is not made again"
    bench.add("heater_current")
    bench.add("cold_heater")
    steps = [step[1:] for step in told if step[0] == "pass"]
    assert steps[-1] == (4, 4)
    # Half the truth is enough to tell the two apart: the heater's field does not ask for the cold.
    own = bench.current.model.effect("cold_heater").parameters["strength"]
    assert own.parameter.unit == "nT/A"
    assert np.all(np.abs(own.value) < 4 * own.sigma)
    told.clear()
    again = Workbench(cat, mission, progress=lambda *step: told.append(step))
    again.drop("cold_heater")
    assert not [step for step in told if step[0] == "pass"], "what was made is kept"


def test_auto_saves_a_version_an_effect_and_says_why_it_stopped(workspace):
    cat, mission = Catalog(workspace.root), workspace.mission()
    found, steps = Workbench(cat, mission, fresh=True).auto()
    assert [one.name for one in found.effects] == ["channel_field(heater_current)"]
    assert [step.effect for step in steps] == ["auto: add channel_field(heater_current)"]
    assert found.stopped
    assert steps[-1].held_out[1] == pytest.approx(found.residual["held_out_after_nT"], rel=0.01)
    assert [record.message for record in cat.models()] == ["pre-flight model", steps[0].effect]
    again, more = Workbench(cat, mission, fresh=True).auto()
    assert (again.verdict, more) == ("NOTHING_LEFT", [])


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("channel_rate(heater_current)@lag=300s", "heater_current@lag=300s"),
        ("channel_field(heater_current*boom_temperature)", "heater_current*boom_temperature"),
        ("channel_field(heater_current@lag=90s*boom_temperature)", "heater_current@lag=90s*boom_temperature"),
    ],
)
def test_an_effect_is_added_by_the_name_a_search_gave_it(workspace, name, channel):
    bench = Workbench(Catalog(workspace.root), workspace.mission(), fresh=True)
    bench.add(name)
    assert bench.current.model.effects[-1].effect.given["channel"] == channel


def test_auto_saves_a_lag_that_only_the_search_made(tmp_path):
    """The bank has 240 and 1000 s; the model gets the lag itself, and explains what the search explained."""
    workspace = make_heated_workspace(tmp_path / "lagged", lagged)
    cat = Catalog(workspace.root)
    found, steps = Workbench(cat, workspace.mission()).auto()
    (effect,) = found.effects
    assert effect.lag_s == pytest.approx(400, rel=0.05)
    assert [step.effect for step in steps] == [f"auto: add {effect.name}"]
    assert steps[-1].held_out[1] == pytest.approx(found.residual["held_out_after_nT"], rel=0.01)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("heater_curent", "did you mean 'heater_current'"),
        ("channel_fild(heater_current)", "did you mean 'channel_field"),
        ("channel_field", "may be 2 things"),
        ("{effect: channel_field, channel: heater}", "did you mean 'heater_current'"),
        ("{effect: channel_field", "no YAML"),
        ("offset_step@soon", "soon"),
    ],
)
def test_a_name_that_is_no_candidate_is_answered_with_what_was_meant(bench, name, meant):
    with pytest.raises(ModelError, match=meant):
        bench.add(name)
    assert bench.current.version == 1


def test_what_the_calibration_fits_cannot_be_dropped(bench):
    with pytest.raises(ModelError, match="every calibration fits"):
        bench.drop("vector_sensor")
    with pytest.raises(ModelError, match="has no effect 'heater'"):
        bench.drop("heater")


def test_the_hidden_field_is_what_the_heater_makes():
    assert heater_field(HEATED_DAYS[0], np.zeros((1440, 3))).max() == pytest.approx(1.0)


def test_what_the_model_has_already_is_refused_and_its_numbers_stay(bench):
    bench.add("channel_field(heater_current)")
    before = bench.current
    for again in (
        "channel_field(heater_current)",
        "heater_current",
        "{effect: channel_field, channel: heater_current}",
    ):
        with pytest.raises(ModelError, match="already, as 'channel_field_heater_current'") as refused:
            bench.add(again)
        assert "inflight refit channel_field_heater_current.coefficient" in refused.value.remedy
    assert bench.current.version == before.version
    # Another response of the same channel is another effect, where it is asked for by its lag.
    assert bench.add("channel_field(heater_current)@lag=400s").model.version == before.version + 1


def test_what_these_data_cannot_tell_from_the_model_is_refused_with_the_reason(bench):
    bench.add("offset_drift")
    with pytest.raises(ModelError, match="cannot tell offset_drift from offset_drift"):
        bench.add("offset_drift")


def test_an_addition_that_data_do_not_speak_for_is_told_as_not_justified(bench):
    assert not bench.add("channel_field(heater_current)").not_justified
    idle = bench.add("channel_field(boom_temperature)")
    assert "nothing within their errors" in idle.not_justified
    assert idle.as_json()["error"]["held_out_nT"][1] == pytest.approx(NOISE, rel=0.03)


def test_each_version_keeps_what_it_did_to_the_residual(workspace, bench):
    added = bench.add("channel_field(heater_current)")
    records = Catalog(workspace.root).models()
    assert records[0].change is None
    kept = records[-1].change
    assert kept["held_out_nT"] == list(added.held_out)
    assert kept["days"] == len(HEATED_DAYS)
    before, after = kept["above_floor_nT"]
    assert after < 0.1 * before


def test_compare_sets_the_model_of_today_beside_the_one_before(workspace, bench):
    cat, mission = Catalog(workspace.root), workspace.mission()
    first = residual_of_products(workspace)
    alone = compare(cat, mission).as_json()
    assert alone["against"] is None
    assert alone["model_version"] == 1
    bench.add("heater_current")
    residual_of_products(workspace)
    page = workspace.root / "compare.html"
    told = compare(cat, mission, output=page)
    fields = told.as_json()
    assert fields["model_version"] == 2
    # The row of the pre-flight model is that of the pre-flight model, whatever was added since.
    assert fields["residual"]["before_nT"] == alone["residual"]["before_nT"]
    assert fields["against"]["rms"] == alone["residual"]["without_outliers_nT"]
    assert fields["against"]["rms"] == pytest.approx(first, rel=0.02)
    assert fields["against"]["message"] == "add channel_field(heater_current)"
    assert fields["residual"]["above_floor_nT"] < 0.2 * fields["against"]["above_floor"]
    lines = [line.text for line in told.summary()]
    assert any("model version 1" in line for line in lines)
    assert any("left above the noise floor" in line and "->" in line for line in lines)
    assert "model version 1" in page.read_text(encoding="utf-8")
    bench.undo()
    residual_of_products(workspace)
    assert compare(cat, mission, against=1).as_json()["against"]["rms"] == fields["against"]["rms"]
    with pytest.raises(SettingsError, match="no product of the span was made with version 7"):
        compare(cat, mission, against=7)
