"""Instruments that stamp the start of what they average, or are late: found, and mended by the mission."""

import numpy as np
import pytest
from tiny_mission import TINY_START, TINY_YAML

from inflight.catalog import Catalog, Workspace
from inflight.diagnosis.stamps import stamp_readings
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.tasks.analysis import DiagnoseSettings, diagnose
from inflight.tasks.archive import ingest
from inflight.tasks.archive.ingestion import content_key
from inflight.tasks.archive.inputs import averaging_by_role
from inflight.time import SECOND

DAYS = [str(day) for day in np.datetime64(TINY_START, "D") + np.arange(2)]
#: The scalar sensor averages over 10 s and stamps its start; the filter of the other is late.
OVER, DELAY = 10.0, 2.0
SAID = {
    "absolute": "averaging: 10 s, stamp: start",
    "turning": "delay: 2 s",
}


def tiny(**said):
    """Return the tiny mission's YAML with keys of its instruments."""
    text = TINY_YAML.replace("cadence: 60 s", "cadence: 10 s")
    for name, keys in said.items():
        lines = "".join(f"    {key.strip()}\n" for key in keys.split(","))
        text = text.replace(f"  {name}:\n", f"  {name}:\n{lines}")
    return text


def strength(seconds, wave):
    """Return the field's size, with a quick wave that a mean over 10 s is less of, nT."""
    turn = 2 * np.pi * seconds
    return 9_000 + 800 * np.sin(turn / 21_600) + wave * np.sin(turn / 200)


def vector(seconds, wave, turn):
    """Return the field at the vector sensor, which turns once in `turn` seconds; (time, axis) nT."""
    angle, tilt = 2 * np.pi * seconds / turn, 1.4 * np.sin(2 * np.pi * seconds / 50_000)
    direction = np.stack([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)], axis=1)
    return direction * strength(seconds, wave)[:, None]


def deliver(folder, wave, noise, turn, seed=4, jitter=0.0):
    """Write the days as two instruments of different habits stamp them.

    Parameters
    ----------
    jitter : float
        Of a field that both instruments read and one of them, which averages, does not, nT.
    """
    rng = np.random.default_rng(seed)
    parts = (np.arange(50) + 0.5) / 50 * OVER
    folder.mkdir(parents=True, exist_ok=True)
    for number, day in enumerate(DAYS):
        stamps = np.datetime64(day, "s") + 10 * np.arange(8640)
        seconds = 86_400.0 * number + 10.0 * np.arange(8640)
        mean = strength(seconds[:, None] + parts, wave).mean(axis=1) + rng.normal(0, noise, 8640)
        reading = (
            vector(seconds - DELAY, wave, turn)
            + np.array([20.0, -10.0, 5.0])
            + rng.normal(0, noise, (8640, 3))
        )
        if jitter:
            # It comes and goes from sample to sample: hardly anything of it is in a rate.
            quick = jitter * (-1.0) ** np.arange(8640) * (1.0 + 0.1 * rng.normal(0.0, 1.0, 8640))
            reading += quick[:, None] * reading / np.linalg.norm(reading, axis=1, keepdims=True)
        name = day.replace("-", "")
        rows = [f"{t}," + ",".join(f"{v:.3f}" for v in row) for t, row in zip(stamps, reading, strict=True)]
        (folder / f"turning_{name}.csv").write_text("time,x,y,z\n" + "\n".join(rows) + "\n", encoding="utf-8")
        rows = [f"{t},{v:.3f}" for t, v in zip(stamps, mean, strict=True)]
        (folder / f"absolute_{name}.csv").write_text("time,f\n" + "\n".join(rows) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def slow(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stamps") / "delivered"
    deliver(folder, 0.0, 0.03, 1_500)
    return folder


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stamps") / "delivered"
    deliver(folder, 10.0, 0.01, 11_000)
    return folder


def said(delivered, folder, **keys):
    """Return what is said of the delivery, with keys in the mission."""
    folder.mkdir()
    (folder / "tiny.yaml").write_text(tiny(**keys), encoding="utf-8")
    made = Workspace.create(folder / "w", folder / "tiny.yaml")
    cat = Catalog(made.root)
    assert ingest(cat, made.mission(), delivered).exit_code == 0
    return diagnose(
        cat, made.mission(), *(DAYS[0], str(np.datetime64(DAYS[-1]) + 1)), DiagnoseSettings(draws=200)
    )


def test_stamps_left_unsaid_are_found_as_a_clock_that_is_off(slow, tmp_path):
    """The vector's stamps are 2 s late and the scalar's 5 s early: 7 s are between them."""
    found = said(slow, tmp_path / "a")
    clock = next(one for one in found.effects if one.family == "clock")
    assert clock.name == "time_shift"
    assert clock.coefficients[0].value == pytest.approx(-7.0, abs=0.2)
    assert clock.stamp_readings == ()


def test_noise_of_the_field_takes_nothing_off_a_clock_that_is_off(tmp_path):
    """With 0.3 nT of noise the rate of the field has 3 % of its square too much: -7 s was -6.8 +- 0.02."""
    pulls = []
    for seed in range(6):
        deliver(tmp_path / f"{seed}", 0.0, 0.3, 1_500, seed)
        found = said(tmp_path / f"{seed}", tmp_path / f"w{seed}")
        clock = next(one for one in found.effects if one.name == "time_shift")
        (number,) = clock.coefficients
        assert clock.noise_of == "field"
        assert clock.noise_part == pytest.approx(0.028, abs=0.003)
        assert number.sigma < 0.05
        assert not clock.turned_over_by
        pulls.append((number.value + 7.0) / number.sigma)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_what_is_no_white_noise_is_not_taken_off_a_clock(tmp_path):
    """One instrument alone sees what changes from sample to sample: as noise it would fill a rate."""
    deliver(tmp_path / "data", 0.0, 0.03, 1_500, jitter=0.5)
    found = said(tmp_path / "data", tmp_path / "w")
    clock = next(one for one in found.effects if one.name == "time_shift")
    (number,) = clock.coefficients
    assert clock.noise_of == "field"
    assert abs(number.value + 7.0) < 2.0 * number.sigma
    assert number.value == pytest.approx(-7.0, abs=0.1)


def test_half_of_an_averaging_is_told_beside_the_clock(slow, tmp_path):
    found = said(slow, tmp_path / "a", turning=SAID["turning"])
    clock = next(one for one in found.effects if one.name == "time_shift")
    assert clock.coefficients[0].value == pytest.approx(-5.0, abs=0.1)
    assert "half of absolute's spacing of 10 s, as if its stamps were the start of it" in found.sentence
    assert "(instruments: {absolute: {stamp: start, averaging: 10 s}})" in found.sentence


def test_with_stamps_averaging_and_delay_stated_only_noise_is_left(quick, tmp_path):
    found = said(quick, tmp_path / "a", **SAID)
    assert found.verdict == "NOTHING_LEFT"
    # Noise of 0.01 nT at both; the mean of the vector has a little less.
    assert found.residual["held_out_before_nT"] < 0.0142


def test_without_the_same_averaging_the_quick_wave_stays(quick, tmp_path):
    """A mean over 10 s leaves 99.6 % of a wave of 200 s: 0.03 nT rms of it are in the difference."""
    found = said(
        quick, tmp_path / "a", turning=f"{SAID['turning']}, averaging: 10 s", absolute=SAID["absolute"]
    )
    assert found.residual["held_out_before_nT"] > 0.025


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("stamp: begin, averaging: 60 s", "'start', 'centre' or 'end'"),
        ("stamp: start", "'stamp: start' needs 'averaging'"),
        ("averaging: -1 s", "'averaging' must not be negative"),
        ("delay: -1 s", "'delay' must not be negative"),
        ("delay: soon", "'soon' is no duration"),
    ],
)
def test_a_bad_statement_is_refused_with_its_line(keys, message):
    with pytest.raises(MissionError, match=message) as caught:
        Mission.parse(tiny(absolute=keys))
    assert "absolute" in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "seconds"),
    [
        ("averaging: 10 s", 0.0),
        ("averaging: 10 s, stamp: start", 5.0),
        ("averaging: 10 s, stamp: end", -5.0),
        ("averaging: 10 s, stamp: end, delay: 250 ms", -5.25),
    ],
)
def test_a_reading_belongs_to_the_middle_of_its_averaging_less_its_delay(keys, seconds):
    plain, mission = Mission.parse(tiny()), Mission.parse(tiny(absolute=keys))
    instrument = mission.instruments["absolute"]
    assert instrument.moment_ns == round(seconds * SECOND)
    # Archived days are made anew where their stamps change, and only there.
    both = [content_key(one.files("absolute"), one.instruments["absolute"]) for one in (plain, mission)]
    assert (both[0] == both[1]) == (seconds == 0.0)


def test_the_less_averaged_instrument_is_averaged_by_what_it_lacks():
    mission = Mission.parse(tiny(absolute="averaging: 50 s", turning="averaging: 30 s"))
    assert averaging_by_role(mission, "main") == {"vector": 40 * SECOND, "scalar": 0}


@pytest.mark.parametrize(
    ("seconds", "sigma", "words"),
    [
        (-30.2, 0.3, ("half of absolute's averaging of 60 s, as if its stamps were the start",)),
        (30.2, 0.3, ("half of absolute's averaging of 60 s, as if its stamps were the end",)),
        (12.0, 0.3, ("turning's delay of 12 s",)),
        (20.0, 0.3, ()),
        (30.0, 20.0, ()),
        (30.0, 0.0, ()),
    ],
)
def test_a_shift_is_read_as_what_stamps_would_make_and_as_nothing_else(seconds, sigma, words):
    mission = Mission.parse(tiny(absolute="averaging: 60 s", turning="delay: 12 s"))
    found = stamp_readings(mission, "main", seconds, sigma)
    assert len(found) == len(words)
    assert all(one.startswith(word) for one, word in zip(found, words, strict=True))
