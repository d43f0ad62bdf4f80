"""Zero levels from the command line: of a sensor in the wind, and as the constant part of two sensors."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag
from inflight.simulate.dual import DualSettings
from inflight.tasks.analysis import compare
from inflight.tasks.archive import simulate
from inflight.tasks.archive.simulated_deliveries import VENUS_EXPRESS

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"
PLAIN = ("--no-prefect", "--workers", 1)
OFFSET = (3.2, -4.1, 1.7)
#: Only the zero level is wrong: no unit is on, and no offset drifts.
QUIET = ("transmitter", "spectrometer", "camera", "survival_heater", "offset_drift", "thermal_drift")
COMPARISONS = """  zero: {kind: zero_level, vector: outboard, step: 2 h}
  short: {kind: zero_level, vector: outboard, interval: 2 h}
"""


def make(folder, without, comparisons=COMPARISONS, seed=31, days=1, **overrides):
    """A day at 10 s of the simulated boom, delivered to a workspace that is still to ingest it."""
    source = folder.parent / f"{folder.name}.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 10 s")
    source.write_text(text.replace("release:\n", f"{comparisons}release:\n"), encoding="utf-8")
    made = Workspace.create(folder, source)
    numbers = {"cadence": 10.0, "offset_outboard": list(OFFSET), **overrides}
    simulate(DualSettings(days=days, seed=seed, without=without, overrides=numbers), made.data, workers=1)
    return made


def errors(made, dataset):
    """Return the mean error of the field of a day's product, its stated sigma, nT (axis,), and itself."""
    cat = Catalog(made.root)
    (day,) = cat.days(dataset, states=("published",))
    product = cat.read(day, with_time=False)
    with xr.open_dataset(VENUS_EXPRESS.truth_path(made.data, day.day), engine="h5netcdf") as truth:
        stamps, field = truth["Epoch"].values.astype(np.int64), truth["FIELD"].values
    rows = np.clip(np.searchsorted(product["tt2000"].values, stamps), 0, product.sizes["time"] - 1)
    there = product["tt2000"].values[rows] == stamps
    error = (product["field_spacecraft"].values[rows] - field)[there]
    sigma = np.nanmedian(product["uncertainty"].values, axis=0)
    return np.nanmean(error, axis=0), sigma, product


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    return make(tmp_path_factory.mktemp("zero") / "w", QUIET)


def test_a_mission_in_which_only_the_zero_level_is_wrong_goes_through_the_verbs(inflight, quiet, tmp_path):
    root = quiet.root
    assert inflight("ingest", *PLAIN, "-w", root).code == 0
    told = inflight("reprocess", "--comparison", "zero", *PLAIN, "--json", "-w", root)
    assert told.code == 0
    assert told.json["days"]["done"] == 1
    (level,) = told.json["zero_levels"]
    assert level["not_determined"] == []
    assert level["fails"] == []
    assert {"davis-smith", "wang-pan", "minimum correlation"} <= set(level["method"][10:-1].split(", "))
    # What the methods share counts once: they are worth less than independent data.
    assert all(1.0 < one < 3.0 for one in level["sigma_over_independent"])
    error, sigma, product = errors(quiet, "l2/field-zero")
    assert np.all(np.abs(error) < 3.0 * sigma)
    assert sigma.max() < 0.2 < 1.7 <= np.abs(OFFSET).min()
    assert "zero-window:" in product.attrs["calibration_table"]
    assert told.json["residual"]["after_nT"] < 0.6 * told.json["residual"]["before_nT"]
    again = inflight("reprocess", "--comparison", "zero", *PLAIN, "--json", "-w", root)
    assert again.json["days"] == {**told.json["days"], "done": 0, "unchanged": 1}
    page = tmp_path / "zero.html"
    shown = inflight("compare", "--comparison", "zero", "--output", page, "-w", root)
    assert shown.code == 0
    for words in (
        "the field turns, varies by",
        "fluctuations are rotations",
        "holds",
        "share intervals",
    ):
        assert words in shown.out
    for words in ("Zero levels", "Each method by itself", "What the methods assume", "Steps of 2 h"):
        assert words in page.read_text(encoding="utf-8")
    steps: list[tuple[str, int, int]] = []
    compare(Catalog(root), quiet.mission(), comparison="zero", progress=lambda *step: steps.append(step))
    assert steps == [("sections", done, 4) for done in range(5)]
    tables = inflight("chain", "--comparison", "zero", "--json", "-w", root).json
    value, wide = (np.array([one[name] for one in tables["steps"]]) for name in ("value_nT", "sigma_nT"))
    known = np.array([one["determined"] for one in tables["steps"]]).all(axis=1)
    assert known.sum() >= 6
    pull = ((value - OFFSET) / wide)[known]
    assert np.mean(np.abs(pull) < 2.0) > 0.8
    # A step is no more than a result: far less certain than the window.
    assert np.all(np.median(wide[known], axis=0) > 1.5 * sigma)


def test_a_span_with_too_few_intervals_says_so_and_states_what_was_known_before(inflight, quiet):
    root = quiet.root
    assert inflight("ingest", *PLAIN, "-w", root).code == 0
    told = inflight("reprocess", "--comparison", "short", *PLAIN, "-w", root)
    assert told.code == 0
    assert "12 intervals of 7200 s, at least 24 needed" in told.out + told.err
    error, sigma, product = errors(quiet, "l2/field-short")
    np.testing.assert_allclose(sigma, 10.0 / np.sqrt(3.0), rtol=1e-3)
    np.testing.assert_allclose(error, OFFSET, atol=0.01)
    assert np.all(product["flag"].values & np.uint32(Flag.PRIOR_PARAMETERS))
    assert "within 10 nT of 0 nT" in product.attrs["zero_level"]


def test_a_field_that_hardly_turns_tells_no_zero_level_or_one_that_holds(inflight, tmp_path):
    made = make(tmp_path / "w", QUIET, turning=0.02)
    assert inflight("ingest", *PLAIN, "-w", made.root).code == 0
    told = inflight("reprocess", "--comparison", "zero", *PLAIN, "--json", "-w", made.root)
    assert told.code == 0
    (level,) = told.json["zero_levels"]
    assert level["not_determined"]
    assert level["reason"]
    # Where a method tells an axis, the test of what it assumes is told with it.
    assert not level["method"].startswith("combined") or "the field turns (all) FAILS" in str(level["fails"])
    error, sigma, _ = errors(made, "l2/field-zero")
    assert np.all(np.abs(error) < 3.0 * sigma)


ROLLING = """mission: rolling
description: A spacecraft that rolls its only magnetometer about z
instruments:
  mag:
    role: vector
    cadence: 15 s
    files: {pattern: "mag_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variables: [x, y, z], unit: nT}}
comparisons:
  main: {kind: zero_level, vector: mag, turns: true, methods: [minimum correlation]}
"""


def test_a_spacecraft_that_rolls_its_sensor_has_its_zero_level_by_the_method_asked_for(inflight, tmp_path):
    """A wind whose direction and size vary apart for hours, in axes that turn about z in 15 minutes."""
    source, generator = tmp_path / "rolling.yaml", np.random.default_rng(3)
    source.write_text(ROLLING, encoding="utf-8")
    made = Workspace.create(tmp_path / "w", source)
    count = 86400 // 15
    smooth = np.exp(-(((np.arange(-60, 61)) / 12.0) ** 2))
    noise = np.stack([np.convolve(one, smooth, "same") for one in generator.normal(size=(4, count))], axis=1)
    noise /= noise.std(axis=0)
    direction = np.array([0.6, -0.5, 0.4]) + 0.4 * noise[:, :3]
    field = 6.0 * np.exp(0.1 * noise[:, 3:]) * direction / np.linalg.norm(direction, axis=1)[:, None]
    phase = 2.0 * np.pi * np.arange(count) / 60.0
    x = np.cos(phase) * field[:, 0] + np.sin(phase) * field[:, 1]
    y = np.cos(phase) * field[:, 1] - np.sin(phase) * field[:, 0]
    truth = np.stack([x, y, field[:, 2]], axis=1)
    reading = truth + OFFSET + 0.02 * generator.normal(size=truth.shape)
    times = np.datetime64("2024-03-01", "s") + 15 * np.arange(count)
    rows = [f"{at}," + ",".join(f"{one:.4f}" for one in row) for at, row in zip(times, reading, strict=True)]
    made.data.mkdir(parents=True, exist_ok=True)
    (made.data / "mag_20240301.csv").write_text("time,x,y,z\n" + "\n".join(rows) + "\n", encoding="utf-8")
    assert inflight("ingest", *PLAIN, "-w", made.root).code == 0
    told = inflight("reprocess", *PLAIN, "--json", "-w", made.root)
    assert told.code == 0
    (level,) = told.json["zero_levels"]
    assert level["not_determined"] == []
    assert level["method"] == "combined (minimum correlation)"
    product = Catalog(made.root).read_day("l2/field", "2024-03-01")
    error = np.nanmean(product["field_sensor"].values - truth, axis=0)
    sigma = np.nanmedian(product["uncertainty"].values, axis=0)
    assert np.all(np.abs(error) < 3.0 * sigma)
    assert sigma.max() < 0.2


@pytest.mark.slow
def test_the_constant_part_of_two_sensors_becomes_known_by_a_zero_level_of_their_product(inflight, tmp_path):
    comparisons = "  zero: {kind: zero_level, vector: outboard, product: main}\n"
    made = make(tmp_path / "w", ("offset_drift", "thermal_drift"), comparisons)
    root = made.root
    refused = inflight("reprocess", "--comparison", "zero", *PLAIN, "-w", root)
    assert refused.code != 0
    assert "no day has a product of 'main'" in refused.err + refused.out
    assert inflight("ingest", *PLAIN, "-w", root).code == 0
    first = inflight("reprocess", *PLAIN, "-w", root)
    assert "no zero level yet: run 'inflight reprocess --comparison zero'" in first.out + first.err
    error, _, product = errors(made, "l2/field")
    assert np.abs(error).max() > 2.0
    assert (product.attrs["constant_known"], product.attrs["constant"]) == ("no", "relative to state 0")
    assert inflight("reprocess", "--comparison", "zero", *PLAIN, "-w", root).code == 0
    second = inflight("reprocess", *PLAIN, "--json", "-w", root)
    assert second.json["days"]["done"] == 1
    error, sigma, product = errors(made, "l2/field")
    assert np.all(np.abs(error) < 3.0 * sigma)
    assert np.abs(error).max() < 0.3
    assert product.attrs["constant_known"] == "yes"
    assert "zero level of zero-window:" in second.json["windows"][0]["constant"]
    # Both are at rest: the level is put back before it is looked for again.
    for comparison in ("zero", "main"):
        again = inflight("reprocess", "--comparison", comparison, *PLAIN, "--json", "-w", root)
        assert again.json["days"]["done"] == 0, comparison
    other, _, _ = errors(made, "l2/field-zero")
    np.testing.assert_allclose(other, error, atol=1e-3)
    assert inflight("release", "1.0", "--no-prefect", "-w", root).code == 0
    remade = inflight("reprocess", "--as-of", "1.0", "--json", "-w", root)
    assert remade.json["days"] == {"planned": 2, "done": 2, "unchanged": 0, "failed": 0, "no_work": 0}
