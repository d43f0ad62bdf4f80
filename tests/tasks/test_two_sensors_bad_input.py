"""Deliveries of two sensors that are not as they should be: flagged or refused, told, and harmless."""

import numpy as np
import pytest
from bad_boom import BAD, CADENCE, CHOSEN, GOOD, boom, copied, deliver, errors, product, reference_stray, work

from inflight.catalog import Catalog
from inflight.flags import Flag
from inflight.tasks.analysis import compare
from inflight.tasks.pipelines import reprocess
from inflight.tasks.pipelines.two_sensor.day import still_axes
from inflight.time import SECOND

HALF = CADENCE * SECOND // 2


def field_of(instruments, name):
    return instruments[name]["B_RAW"].values.copy()


def put(instruments, name, values):
    data = instruments[name]
    instruments[name] = data.assign(B_RAW=(data["B_RAW"].dims, values))


def half_a_cadence_apart(instruments):
    data = instruments["ib"]
    instruments["ib"] = data.assign(Epoch=(data["Epoch"].dims, data["Epoch"].values + HALF))


def full_inboard(instruments):
    values = field_of(instruments, "ib")
    put(instruments, "ib", np.minimum(values, [np.inf, np.inf, np.quantile(values[:, 2], 0.6)]))


def nan_runs(instruments):
    inboard, outboard = field_of(instruments, "ib"), field_of(instruments, "ob")
    inboard[3000:4200], inboard[6000, 1], outboard[8000:8300] = np.nan, np.nan, np.nan
    put(instruments, "ib", inboard)
    put(instruments, "ob", outboard)


def fills(instruments):
    """A fill value that the file declares, and one that it does not."""
    values = field_of(instruments, "ob")
    values[3000:3300], values[3300:3600] = -1e31, 99999.9
    put(instruments, "ob", values)


def rows_twice(instruments):
    for name in ("ib", "ob"):
        rows = np.sort(np.concatenate([np.arange(instruments[name].sizes["record"]), np.arange(1000, 1100)]))
        instruments[name] = instruments[name].isel(record=rows)


def exchanged(instruments):
    instruments["ib"], instruments["ob"] = instruments["ob"], instruments["ib"]


def dies(name, row):
    def spoil(instruments):
        values = field_of(instruments, name)
        values[row:] = values[row]
        put(instruments, name, values)

    return spoil


def sticks(name, row):
    def spoil(instruments):
        values = field_of(instruments, name)
        values[row:, 1] = values[row, 1]
        put(instruments, name, values)

    return spoil


def slower(instruments):
    instruments["ib"] = instruments["ib"].isel(record=slice(None, None, 5))


def thirty_samples(instruments):
    for name in ("ib", "ob"):
        instruments[name] = instruments[name].isel(record=slice(5000, 5030))


#: Name -> what is done, the flag that must be there and on how many samples at least, what is told.
CASES = {
    "half a cadence": (half_a_cadence_apart, Flag.GOOD, 0, ""),
    "full": (full_inboard, Flag.STILL, 3000, ""),
    "axis sticks": (sticks("ib", 5000), Flag.STILL, 5700, ""),
    "nan": (nan_runs, Flag.VECTOR_MISSING, 1500, ""),
    "fill": (fills, Flag.VECTOR_MISSING | Flag.OUT_OF_RANGE, 600, ""),
    "twice": (rows_twice, Flag.GOOD, 0, ""),
    "exchanged": (exchanged, Flag.GOOD, 0, "the sensor called outboard sees more"),
    "dies": (dies("ib", 5000), Flag.STILL, 5700, ""),
    "slower": (slower, Flag.GOOD, 0, ""),
    "short": (thirty_samples, Flag.NOT_CORRECTED, 30, ""),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two good days, reprocessed."""
    return boom(tmp_path_factory.mktemp("bad"))


@pytest.fixture(scope="module")
def one_day(tmp_path_factory):
    """The first of them alone, reprocessed."""
    return boom(tmp_path_factory.mktemp("one"), (GOOD,))


@pytest.fixture(scope="module", params=CASES)
def spoilt(request, whole, tmp_path_factory):
    """The mission with its second day delivered anew, with one kind of fault."""
    made = copied(whole, tmp_path_factory.mktemp("bad") / request.param.replace(" ", "-"))
    deliver(made, BAD, CASES[request.param][0])
    taken, report = work(made)
    assert taken.days["failed"] == 0
    return request.param, made, report


def test_no_day_is_lost_and_the_fault_is_flagged_or_told(spoilt):
    case, made, report = spoilt
    _, flag, count, told = CASES[case]
    # The day before is made anew, too: what switches near midnight is looked for on both sides of it.
    assert (report.days["done"], report.days["unchanged"], report.exit_code) == (2, 0, 0)
    data = product(made)
    assert np.count_nonzero(data["flag"].values & np.uint32(flag)) >= count
    problems = [one for one in report.problems if one["day"] == str(BAD)]
    assert bool(problems) == bool(told)
    for one in problems:
        assert told in one["message"]
        assert one["remedy"]


def test_the_field_is_never_worse_than_it_was_measured(spoilt):
    case, made, _ = spoilt
    data = product(made)
    told = errors(
        data,
        between=case == "half a cadence",
        constant=reference_stray(made, data),
        mean_of=5 if case == "slower" else 1,
    )
    known = np.isfinite(told["field_spacecraft"]).all(axis=1)
    before, after = (np.sqrt(np.mean(told[name][known] ** 2)) for name in ("outboard", "field_spacecraft"))
    assert after <= before
    raw = (told["flag"] & np.uint32(Flag.NOT_CORRECTED)) != 0
    stated = known & np.isfinite(told["sigma"]).all(axis=1)
    assert not (stated & raw).any()
    if stated.any():
        off = np.abs(told["relative"][stated])
        # Errors of four units along three axes: few numbers, which many samples share.
        assert np.mean(off < 2.0 * told["sigma"][stated]) > 0.8


def test_the_page_can_be_made_of_any_of_them(spoilt, tmp_path):
    _, made, _ = spoilt
    fields = compare(Catalog(made.root), made.mission(), output=tmp_path / "page.html").as_json()
    assert [one["day"] for one in fields["by_day"]] == [str(GOOD), str(BAD)]


@pytest.mark.parametrize(("name", "called"), [("ib", "'inboard'"), ("ob", "'outboard'")])
def test_a_dead_sensor_is_told_and_nothing_is_made_of_it(whole, tmp_path, name, called):
    made = copied(whole, tmp_path / "dead")
    before = product(made)
    deliver(made, BAD, dies(name, 0))
    _, report = work(made)
    assert (report.days["failed"], report.days["unchanged"], report.exit_code) == (1, 0, 3)
    (problem,) = report.problems
    assert called in problem["message"]
    assert "one and the same value" in problem["message"]
    assert problem["cause"] != "bug"
    assert product(made).equals(before)


@pytest.mark.parametrize("name", ["ib", "ob"])
def test_a_day_that_one_sensor_has_not_is_told(one_day, tmp_path, name):
    made = copied(one_day, tmp_path / "one")
    deliver(made, BAD, lambda instruments: instruments.pop(name))
    taken, _ = work(made)
    assert taken.days["failed"] == 0
    report = reprocess(Catalog(made.root), made.mission(), str(GOOD), str(BAD + 1), CHOSEN)
    assert (report.days["unchanged"], report.days["no_work"]) == (1, 1)
    (problem,) = report.problems
    assert problem["day"] == str(BAD)
    assert "no measurements of" in problem["message"]


def test_a_stuck_axis_is_told_and_nothing_is_made_of_it(whole, tmp_path):
    made = copied(whole, tmp_path / "stuck")
    before = product(made)
    deliver(made, BAD, sticks("ob", 0))
    _, report = work(made)
    (problem,) = report.problems
    assert report.days["failed"] == 1
    assert "'outboard'" in problem["message"]
    assert "along y" in problem["message"]
    assert product(made).equals(before)


def test_still_readings_are_told_from_a_quiet_field_on_coarse_steps():
    rng = np.random.default_rng(5)
    moving = np.cumsum(rng.normal(0.0, 0.05, (1000, 3)), axis=0)
    coarse = np.round(rng.normal(0.0, 0.05, (1000, 3)) / 0.5) * 0.5
    coarse[:400] = 0.0
    # Both read a field that hardly moves: that the coarse one stays the same is right.
    quiet = rng.normal(0.0, 0.05, (1000, 3))
    coarse[500] = 0.5
    assert not still_axes(coarse, quiet).any()
    # Nor is noise of the other sensor a move.
    assert not still_axes(coarse, 10.0 * quiet).any()
    stuck = moving + rng.normal(0.0, 0.02, moving.shape)
    stuck[300:700, 1] = stuck[300, 1]
    found = still_axes(stuck, moving)
    assert np.flatnonzero(found[:, 1]).tolist() == list(range(300, 700))
    assert not found[:, [0, 2]].any()
    assert not still_axes(moving, stuck).any()


def test_a_sensor_that_changes_its_range_is_not_still():
    rng = np.random.default_rng(6)
    field = np.cumsum(rng.normal(0.0, 0.02, (20_000, 3)), axis=0) + rng.normal(0.0, 0.01, (20_000, 3))
    coarse = np.round(field / 0.01) * 0.01
    coarse[10_000:] = np.round(field[10_000:] / 2.0) * 2.0
    assert not still_axes(coarse, field).any()
