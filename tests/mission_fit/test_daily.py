"""Each day's own parameters after the fit of all days: injected in equations, with both signs."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from inflight.calibration import NormalEquations
from inflight.errors import CalibrationError
from inflight.lsq import RESIDUAL
from inflight.mission_fit import daily_parameters, fit_trends, make_trend
from inflight.tasks.pipelines.mission_fit.tables import faults_of, faults_table, stated_periods
from inflight.time import DAY, day_bounds

NINE = [f"vector_sensor.p[{index}]" for index in range(9)]
SHIFT = "time_shift.seconds"
COLUMNS = [*NINE, SHIFT, "battery.coefficient[x]"]
ROWS, DAYS, NOISE = 300, 40, 0.1


@dataclass
class Truth:
    """Parameters (day, column) and the equations that hold them, all linearised at zero."""

    value: np.ndarray
    equations: NormalEquations


def mission(seed: int = 0, own: np.ndarray | None = None, memory: int = 1, alike: bool = False) -> Truth:
    """Make days whose noise is white for `memory` rows; `own` (day, column) is added to common values.

    With `alike`, the last column is hardly told from the first, and what is known of it is off by 0.05."""
    random = np.random.default_rng(seed)
    common = random.standard_normal(len(COLUMNS))
    value = np.broadcast_to(common, (DAYS, len(COLUMNS))).copy()
    value += 0.0 if own is None else own
    if alike:
        value[:, -1] = 0.05 * random.standard_normal()
    grams = []
    for row in value:
        x = random.standard_normal((ROWS, len(COLUMNS)))
        if memory > 1:
            x = np.repeat(x[::memory], memory, axis=0)[:ROWS]
        if alike:
            x[:, -1] = x[:, 0] + 1e-3 * x[:, -1]
        noise = np.repeat(random.standard_normal(ROWS // memory + 1), memory)[:ROWS]
        rows = np.column_stack([x, NOISE * noise - x @ row])
        grams.append(rows.T @ rows)
    bounds = np.array([day_bounds(np.datetime64("2005-01-01") + day) for day in range(DAYS)])
    names, cube = [*COLUMNS, RESIDUAL], np.array(grams)
    dataset = xr.Dataset(
        {
            "gram": (("block", "column", "other"), cube),
            "scatter": (("block", "column", "other"), np.zeros_like(cube)),
            "reference": (("block", "column"), np.zeros(cube.shape[:2])),
            "start": ("block", bounds[:, 0]),
            "end": ("block", bounds[:, 1]),
            "count": ("block", np.full(DAYS, float(ROWS))),
            "scale": ("column", np.ones(len(names))),
        },
        coords={"column": names, "other": names},
    )
    return Truth(value, NormalEquations(dataset))


def daily(truth: Truth, names: list[str], last: float = 10.0) -> xr.Dataset:
    fit = fit_trends(
        truth.equations,
        dict.fromkeys(NINE[:3], make_trend("linear", truth.equations.middle)),
        np.append(np.full(len(COLUMNS) - 1, 10.0), last),
        units=dict.fromkeys(COLUMNS, "s"),
    )
    return daily_parameters(truth.equations, SimpleNamespace(fit=fit, kind="linear"), names)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_shift_of_one_day_is_found_on_that_day_alone(sign):
    own = np.zeros((DAYS, len(COLUMNS)))
    own[7, COLUMNS.index(SHIFT)] = sign * 0.2
    table = daily(mission(own=own), [SHIFT])
    away = (table["value"] - table["continuous"]).sel(parameter=SHIFT).values
    sigma = table["sigma"].sel(parameter=SHIFT).values
    assert away[7] == pytest.approx(sign * 0.2, abs=5 * sigma[7])
    assert np.abs(np.delete(away / sigma, 7)).max() < 5
    assert list(table["parameter"].values) == [*NINE, SHIFT]


def test_errors_of_what_days_take_from_the_fit_of_all_days_are_in_theirs():
    pulls = []
    for seed in range(12):
        truth = mission(seed, alike=True)
        table = daily(truth, [SHIFT], last=0.05).isel(parameter=0)
        pulls.append((table["value"].values - truth.value[:, 0]) / table["sigma"].values)
        # Days differ by less than that.
        assert (table["own_sigma"] < 0.3 * table["sigma"]).all()
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.5


@pytest.mark.parametrize("memory", [1, 6])
def test_stated_errors_cover_the_truth_also_when_noise_is_correlated(memory):
    inside = []
    for seed in range(6):
        truth = mission(seed, memory=memory)
        table = daily(truth, [SHIFT])
        pulls = (table["value"].values - truth.value[:, :10]) / table["sigma"].values
        inside.append(np.abs(pulls) < 1)
    assert 0.60 < np.mean(inside) < 0.76


def test_empty_days_tell_nothing_and_disturb_nobody():
    truth = mission()
    data = truth.equations.dataset
    gram, count = data["gram"].values.copy(), data["count"].values.copy()
    gram[3], count[3] = 0.0, 0.0
    empty = NormalEquations(data.assign(gram=data["gram"].copy(data=gram), count=("block", count)))
    table = daily(Truth(truth.value, empty), [SHIFT])
    assert np.isnan(table["value"].values[3]).all()
    assert not table["determined"].values[3].any()
    assert table["determined"].values[4:].all()


def test_a_name_that_is_no_column_is_refused():
    with pytest.raises(CalibrationError, match="no parameter 'clock'"):
        daily(mission(), ["clock"])


def test_a_span_of_wrong_clock_is_one_fault_with_its_days():
    own = np.zeros((DAYS, len(COLUMNS)))
    own[20:24, COLUMNS.index(SHIFT)] = -0.15
    table = daily(mission(own=own), [SHIFT])
    found, _ = faults_of(table)
    staged = faults_table(table)
    assert len(found.faults) == 1
    assert found.faults[0].shift == pytest.approx(-0.15, abs=5 * found.faults[0].sigma)
    np.testing.assert_array_equal(np.flatnonzero(staged["fault"].values), [20, 21, 22, 23])
    assert "MJD" in staged.attrs["told"]


def test_no_time_shift_says_what_the_model_lacks():
    with pytest.raises(CalibrationError, match="no time shift") as raised:
        faults_of(daily(mission(), []))
    assert "time_shift" in raised.value.remedy


def test_a_mission_s_period_that_is_known_already_is_named_once():
    periods = {"orbit": 5580 * 10**9, "local_time": round(260.5 * DAY), "season": 90 * DAY}
    named = stated_periods(SimpleNamespace(periods=periods))
    assert list(named) == ["130 d", "local_time, 260.5 d", "365 d", "season, 90 d"]
