"""Days and months with the offset of calendar months along the spin axis; months are closed by themselves."""

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.flows import run_without_prefect
from inflight.simulate.spinning import SpinningSettings
from inflight.spin import PARAMETER_NAMES
from inflight.tasks.archive import simulate
from inflight.tasks.pipelines.base.tables import month_edges
from inflight.time import day_bounds

pytestmark = pytest.mark.slow
AXIAL = list(PARAMETER_NAMES).index("offset[3]")
TRUTH = SpinningSettings(craft="imp8").parameters.offset[2]
MARCH, APRIL = np.datetime64("2012-03-01"), np.datetime64("2012-04-01")


def settings(days):
    return SpinningSettings(craft="imp8", start="2012-03-29", days=days, seed=8, without=("zero_drift",))


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Three days of March, closed with the day after; then two of April, calibrated daily."""
    made = Workspace.create(tmp_path_factory.mktemp("months") / "imp8", "imp8")
    simulate(settings(4), made.data, workers=1)
    march = run_without_prefect("monthly", made, {"month": "2012-03"}, workers=1)
    simulate(settings(5), made.data, workers=1)
    run_without_prefect("ingest", made, {}, workers=1)
    daily = run_without_prefect("reprocess", made, {"settings": {"table": "daily"}}, workers=1)
    return made, march, daily


def versions(workspace):
    days = Catalog(workspace.root).days("l2/field", states=("published",))
    return {str(day.day): (day.version, day.key) for day in days}


def test_a_month_is_closed_with_what_came_late_and_days_of_the_next_do_not_touch_it(closed):
    _, march, daily = closed
    assert march.days["done"] == 3
    assert march.extra["ingest"]["days"]["done"] > 0
    assert daily.days["unchanged"] == 3
    assert daily.days["done"] == 2


def test_each_month_has_its_own_offset_along_the_axis_within_its_error(closed):
    table = Catalog(closed[0].root).table("main-zero-level-monthly", "2012-04-01")
    np.testing.assert_array_equal(table["start"].values, [day_bounds(day)[0] for day in (MARCH, APRIL)])
    assert table["end"].values[0] == table["start"].values[1]
    pulls = (table["value"].values - TRUTH) / table["sigma"].values
    assert np.isfinite(table["sigma"].values).all()
    assert np.abs(pulls).max() < 4.0


def test_a_month_that_agrees_with_the_one_before_keeps_its_offset(closed):
    """A new value within the errors of both would only make products step at the month's edge."""
    cat = Catalog(closed[0].root)
    zero = cat.table("main-zero-level-monthly", "2012-04-01")
    value, sigma = zero["value"].values, zero["sigma"].values
    assert abs(value[1] - value[0]) < 3.0 * np.hypot(*sigma)
    daily, monthly = (cat.table(f"main-{kind}", "2012-04-01") for kind in ("daily", "monthly"))
    assert daily.sizes["interval"] == 5
    assert monthly.sizes["interval"] == 2
    for table in (daily, monthly):
        month = (table["start"].values >= day_bounds(APRIL)[0]).astype(int)
        own, decision = (table[name].values[:, AXIAL] for name in ("own", "decision"))
        np.testing.assert_array_equal(own, value[month])
        np.testing.assert_array_equal(table["own_sigma"].values[:, AXIAL], sigma[month])
        np.testing.assert_array_equal(table["value"].values[:, AXIAL], value[0])
        assert decision[0] == "update"
        assert set(decision[1:]) <= {"confirm", "keep"}
        # The month's own offset bounds the error of the one that is kept.
        most = np.minimum(sigma[0], np.hypot(sigma, value - value[0]))[month]
        assert np.all(table["sigma"].values[:, AXIAL] <= most * (1.0 + 1e-9))


def test_a_month_closed_again_costs_nothing(closed):
    before = versions(closed[0])
    again = run_without_prefect("monthly", closed[0], {"month": "2012-03"}, workers=1)
    assert again.days["unchanged"] == 3
    assert again.days["done"] == 0
    assert versions(closed[0]) == before


def test_products_may_take_the_months_own_twelve(closed):
    report = run_without_prefect("reprocess", closed[0], {"settings": {"table": "monthly"}}, workers=1)
    assert report.days["done"] == 5
    assert report.extra["residual"]["after_nT"] < 0.05


def test_months_have_their_own_length():
    edges = month_edges(np.datetime64("2012-02-10"), np.datetime64("2012-02-29"))
    assert edges == [np.datetime64("2012-02-01"), np.datetime64("2012-03-01")]
