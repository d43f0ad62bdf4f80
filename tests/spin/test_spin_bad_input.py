"""Deliveries of a spinning mission that are not as they should be: handled, flagged, told, harmless."""

import shutil

import numpy as np
import pytest
import xarray as xr
from bad_spin import BAD, SETTINGS, at, deliver, mission_of, product, truth_of, without

from inflight.catalog import Catalog, Workspace
from inflight.errors import CalibrationError
from inflight.flags import UNUSABLE, Flag
from inflight.spin import PARAMETER_NAMES, SPIN_RELATED
from inflight.tasks.archive import ingest
from inflight.tasks.archive.simulated_deliveries import SPINNING
from inflight.tasks.pipelines import reprocess
from inflight.time import SECOND

LATE = SECOND // 3
WORST = UNUSABLE | Flag.NO_PHASE
EIGHT = [PARAMETER_NAMES.index(name) for name in SPIN_RELATED]


def pulses_gone(begin, end):
    def spoil(instruments):
        instruments["sun"] = without(instruments["sun"], begin, end)

    return spoil


def pulses_late(begin, end):
    def spoil(instruments):
        stamps = instruments["sun"]["Epoch"].values.copy()
        stamps[(stamps >= at(begin)) & (stamps < at(end))] += LATE
        instruments["sun"] = instruments["sun"].assign(Epoch=("record", stamps))

    return spoil


def false_pulses(instruments):
    sun = instruments["sun"]
    false = np.random.default_rng(1).integers(at(0.0), at(9.0), 900)
    stamps = np.sort(np.concatenate([sun["Epoch"].values, false]))
    instruments["sun"] = xr.Dataset(
        {"Epoch": ("record", stamps), "SPIN_PERIOD": ("record", np.full(stamps.size, 2.5871))}
    )


def rows_twice(instruments):
    for name in ("sun", "fgm"):
        data = instruments[name]
        rows = np.sort(np.concatenate([np.arange(data.sizes["record"]), np.arange(1000, 1100)]))
        instruments[name] = data.isel(record=rows)


def fill_and_nan(instruments):
    field = instruments["fgm"]["FGM_RAW"].values.copy()
    field[5000:5400] = -1e31
    field[9500, 1] = np.nan
    period = instruments["sun"]["SPIN_PERIOD"].values.copy()
    period[100:105] = np.nan
    instruments["fgm"] = instruments["fgm"].assign(FGM_RAW=(("record", "axis"), field))
    instruments["sun"] = instruments["sun"].assign(SPIN_PERIOD=("record", period))


def one_nan(instruments):
    field = instruments["fgm"]["FGM_RAW"].values.copy()
    field[9500, 1] = np.nan
    instruments["fgm"] = instruments["fgm"].assign(FGM_RAW=(("record", "axis"), field))


def full_sensor(instruments):
    """Let the field rise for an hour beyond what the sensor can read."""
    field, stamps = instruments["fgm"]["FGM_RAW"].values.copy(), instruments["fgm"]["Epoch"].values
    risen = (stamps > at(5.0)) & (stamps < at(6.0))
    field[risen] = np.clip(1.6 * field[risen], -12.0, 12.0)
    instruments["fgm"] = instruments["fgm"].assign(FGM_RAW=(("record", "axis"), field))


def no_pulses(instruments):
    del instruments["sun"]


def two_pulses(instruments):
    instruments["sun"] = instruments["sun"].isel(record=slice(2))


#: Name -> what is done, what replaces text of the YAML, flags that must be there, what is told.
CASES = {
    "minutes": (pulses_gone(3.0, 3.1), {}, Flag.PHASE_BRIDGED, "139 Sun pulses missing"),
    "first minutes": (pulses_gone(0.0, 0.1), {}, Flag.NO_PHASE, "lie beyond the first or last Sun pulse"),
    "hours": (pulses_gone(2.0, 7.0), {}, Flag.NO_PHASE, "6958 Sun pulses missing"),
    "false": (false_pulses, {}, Flag.GOOD, "900 spurious Sun pulses dropped"),
    "twice": (rows_twice, {}, Flag.GOOD, ""),
    "fill": (fill_and_nan, {}, Flag.VECTOR_MISSING, "5 Sun pulses missing"),
    "nan": (one_nan, {}, Flag.VECTOR_MISSING, ""),
    "full": (
        full_sensor,
        {"[-1000, 1000]": "[-12, 12]"},
        Flag.SATURATED,
        "stand at an end of the sensor's range",
    ),
    "period": (None, {"spin: 2.5871 s": "spin: 5.2 s"}, Flag.GOOD, "stated spin period of 5.2 s is wrong"),
    "slow": (None, {"spin: 2.5871 s": "spin: 1.7 s"}, Flag.GOOD, "stated spin period of 1.7 s is wrong"),
    "jumps": (pulses_late(4.0, 4.5), {}, Flag.PHASE_JUMP, "jumps by +46.38 degrees"),
    "one jump": (pulses_late(4.0, 9.0), {}, Flag.PHASE_JUMP, "jumps by +46.38 degrees"),
    "no pulses": (no_pulses, {}, Flag.NO_PHASE, "nothing tells the phase"),
    "two pulses": (two_pulses, {}, Flag.NO_PHASE, "nothing tells the phase"),
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The window's table of the mission as it should be."""
    cat, mission, _ = mission_of(tmp_path_factory.mktemp("bad") / "plain")
    report = reprocess(cat, mission)
    assert not report.problems
    return cat.table("main-window", str(BAD)).isel(interval=0).load()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a function: a mission with one kind of fault, reprocessed, made when first asked for."""
    ready = {}

    def case(name):
        if name not in ready:
            spoil, instead, *_ = CASES[name]
            folder = tmp_path_factory.mktemp("bad") / name.replace(" ", "-")
            cat, mission, taken = mission_of(folder, spoil, instead)
            assert taken.days["failed"] == 0
            ready[name] = cat, reprocess(cat, mission)
        return ready[name]

    return case


@pytest.fixture(scope="module", params=CASES)
def spoilt(request, made):
    """A mission with one kind of fault, reprocessed: its case, catalog and report."""
    return request.param, *made(request.param)


def test_no_day_is_lost_and_the_fault_is_flagged_and_told(spoilt):
    case, cat, report = spoilt
    *_, flag, told = CASES[case]
    assert report.days["done"] == 2
    assert report.exit_code == 0
    data = product(cat)
    assert (data["flag"].values & np.uint32(flag)).any() == bool(flag)
    if told:
        entries = [one for one in report.problems if told in one["message"]]
        assert entries[-1]["day"] == str(BAD)
        assert entries[-1]["remedy"]
        assert case == "no pulses" or "20120302" in entries[-1]["message"]
    else:
        assert report.problems == []


def test_the_parameters_are_those_of_the_mission_without_the_fault(spoilt, plain):
    _, cat, _ = spoilt
    table = cat.table("main-window", str(BAD)).isel(interval=0)
    off = table["value"].values - plain["value"].values
    sigma = np.maximum(table["sigma"].values, plain["sigma"].values)
    assert np.all(np.abs(off[EIGHT]) < 2.5 * sigma[EIGHT]), off / sigma
    third = PARAMETER_NAMES.index("offset[3]")
    assert abs(off[third]) < 2.5 * sigma[third]


def test_the_field_that_is_given_is_right_where_no_flag_speaks_against_it(spoilt):
    case, cat, _ = spoilt
    data = product(cat)
    turning, payload = truth_of(data)
    flag = data["flag"].values
    sane = (flag & np.uint32(UNUSABLE)) == 0
    if case == "full":
        sane &= (data["tt2000"].values < at(5.0)) | (data["tt2000"].values >= at(6.0))
    spread = SETTINGS.parameters.noise + 4.0 * np.nanmedian(data["uncertainty"].values, axis=0)
    off = data["field_sensor"].values - turning
    assert np.all(np.sqrt(np.mean(off[sane] ** 2, axis=0)) < 1.2 * spread)
    known = sane & ((flag & np.uint32(WORST | Flag.PHASE_JUMP)) == 0)
    off = data["field_payload"].values - payload
    if known.any():
        assert np.all(np.sqrt(np.mean(off[known] ** 2, axis=0)) < 1.2 * spread)
    assert np.isnan(data["field_payload"].values[(flag & np.uint32(Flag.NO_PHASE)) != 0, :2]).all()


def test_jumps_that_come_back_leave_the_field_right(made):
    cat, _ = made("jumps")
    data = product(cat)
    _, payload = truth_of(data)
    flag = data["flag"].values
    moved = ((flag & np.uint32(Flag.PHASE_JUMP)) != 0) & ((flag & np.uint32(Flag.NO_PHASE)) == 0)
    assert 5400 < moved.sum() < 5800
    off = data["field_payload"].values[moved] - payload[moved]
    assert np.sqrt(np.mean(off**2)) < 0.05


def test_a_jump_that_stays_is_in_doubt_on_both_sides(made):
    cat, report = made("one jump")
    assert ((product(cat)["flag"].values & np.uint32(Flag.PHASE_JUMP)) != 0).all()
    assert "nothing tells which side of it is right" in report.problems[0]["remedy"]


def test_a_mission_that_nothing_tells_the_phase_of_is_refused(tmp_path):
    cat, mission, _ = mission_of(tmp_path / "none", no_pulses)
    with pytest.raises(CalibrationError, match="no day of the span tells anything"):
        reprocess(cat, mission, BAD, BAD + 1)


def test_pulses_of_a_clock_that_runs_slow_are_held_against_the_field(tmp_path):
    def slow(instruments):
        stamps = instruments["sun"]["Epoch"].values
        drifted = at(0.0) + ((stamps - at(0.0)) * 1.0003).astype(np.int64)
        instruments["sun"] = instruments["sun"].assign(Epoch=("record", drifted))

    cat, mission, _ = mission_of(tmp_path / "slow", slow)
    report = reprocess(cat, mission)
    assert any("the phase is WRONG" in one["message"] for one in report.problems if one["day"] == str(BAD))


def test_a_damaged_file_of_pulses_leaves_the_field_in_turning_axes(tmp_path):
    cat, mission, _ = mission_of(tmp_path / "damaged")
    path = SPINNING["imp8"].path(tmp_path / "damaged" / "data", "sun", BAD)
    path.write_bytes(path.read_bytes()[:4000])
    taken = ingest(cat, mission, tmp_path / "damaged" / "data")
    assert taken.days["failed"] == 1
    assert "imp8_sun_20120302" in taken.problems[0]["message"]
    report = reprocess(cat, mission)
    assert report.days["failed"] == 0


def test_pulses_that_come_late_are_taken_in_and_the_day_is_made_anew(made, tmp_path):
    folder = tmp_path / "late"
    shutil.copytree(made("no pulses")[0].workspace, folder)
    cat, mission = Catalog(folder), Workspace.open(folder).mission()
    assert np.isnan(product(cat)["field_payload"].values).any()
    deliver(folder / "data")
    assert ingest(cat, mission, folder / "data").days["failed"] == 0
    report = reprocess(cat, mission)
    assert not report.problems
    assert np.isfinite(product(cat)["field_payload"].values).all()
