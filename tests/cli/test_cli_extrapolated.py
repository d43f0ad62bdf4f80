"""Days calibrated with a table that was not learnt from them: flagged, and as uncertain as they are wrong."""

import numpy as np
import pytest
from tiny_mission import TINY_GAIN, TINY_OFFSET, TINY_START, deliver_tiny_day, make_tiny_workspace, tiny_field

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag

#: Days that teach the table, and days it is applied to.
TAUGHT, LATER = 8, 6

FIRST = np.datetime64(TINY_START, "D")
SPLIT = str(FIRST + TAUGHT)

#: How a sensor ages: the part of `AGED_GAIN` and `AGED_OFFSET` at each time, days.
AGEING = {"steadily": lambda t: t / 20.0, "slower and slower": lambda t: np.log1p(t / 4.0)}
AGED_GAIN, AGED_OFFSET = np.array([2e-4, -1.5e-4, 1e-4]), np.array([3.0, -2.0, 4.0])


def aged_workspace(root, ageing, days=TAUGHT + LATER):
    """Make a workspace of a sensor that ages all the time."""
    make_tiny_workspace(root, days=0)
    folder = Workspace.open(root).data
    for number in range(days):
        age = AGEING[ageing](number + np.arange(1440)[:, None] / 1440.0)
        deliver_tiny_day(
            folder, str(FIRST + number), 0, TINY_OFFSET + AGED_OFFSET * age, TINY_GAIN + AGED_GAIN * age
        )
    return root


def within(product, sigma):
    """Return the part of the samples whose components are all within two of these sigmas of the truth."""
    return float(np.mean(np.all(np.abs(product["field_sensor"].values - tiny_field()) < 2.0 * sigma, axis=1)))


@pytest.mark.parametrize("ageing", sorted(AGEING))
@pytest.mark.parametrize("table", ["span", "window", "continuous"])
def test_later_days_are_flagged_and_within_their_uncertainty(inflight, tmp_path, ageing, table):
    root = aged_workspace(tmp_path / "ageing", ageing)
    assert inflight("ingest", "-w", root, "--no-prefect").code == 0
    teach = ("reprocess", "-w", root, "--no-prefect", "--end", SPLIT, "--window-days", 2)
    assert inflight(*teach, "--table", table).code == 0
    told = inflight("reprocess", "-w", root, "--no-prefect", "--start", SPLIT, "--use-table", f"main-{table}")
    assert told.code == 0, told.err
    catalog = Catalog(root)
    taught = [catalog.read_day("l2/field", FIRST + number) for number in range(TAUGHT)]
    later = [catalog.read_day("l2/field", FIRST + TAUGHT + number) for number in range(LATER)]
    assert not any((one["flag"].values & Flag.EXTRAPOLATED).any() for one in taught)
    assert all((one["flag"].values & Flag.EXTRAPOLATED).all() for one in later)
    # What the same table states within its span is far too small for the days behind it.
    stated = np.mean([one["uncertainty"].values for one in taught], axis=0)
    assert all(within(one, one["uncertainty"].values) > 0.95 for one in later)
    assert within(later[-1], stated) < 0.5
    # Wide enough, and no wider than tells something.
    error = np.sqrt(np.mean((later[-1]["field_sensor"].values - tiny_field()) ** 2))
    assert np.sqrt(np.mean(later[-1]["uncertainty"].values ** 2)) < 10 * error


def test_a_day_that_teaches_is_made_again_without_the_flag(inflight, tmp_path):
    root = aged_workspace(tmp_path / "ageing", "steadily", TAUGHT + 1)
    inflight("ingest", "-w", root, "--no-prefect")
    inflight("reprocess", "-w", root, "--no-prefect", "--end", SPLIT, "--table", "span")
    inflight("reprocess", "-w", root, "--no-prefect", "--start", SPLIT, "--use-table", "main-span")
    catalog = Catalog(root)
    assert (catalog.read_day("l2/field", SPLIT)["flag"].values & Flag.EXTRAPOLATED).all()
    # Which table holds then is what products took.
    used = catalog.table("main-span", SPLIT)
    assert used.attrs["table_id"] == catalog.table("main-span", TINY_START).attrs["table_id"]
    assert inflight("reprocess", "-w", root, "--no-prefect", "--table", "span").code == 0
    product = catalog.read_day("l2/field", SPLIT)
    assert not (product["flag"].values & Flag.EXTRAPOLATED).any()


def test_a_table_that_is_not_there_or_does_not_fit_is_refused_with_what_there_is(inflight, tiny_workspace):
    inflight("ingest", "-w", tiny_workspace, "--no-prefect")
    inflight("reprocess", "-w", tiny_workspace, "--no-prefect")
    with_table = ("reprocess", "-w", tiny_workspace, "--no-prefect", "--use-table")
    absent = inflight(*with_table, "main-span:77", "--json")
    assert absent.code == 1
    assert "main-span:" in absent.json["error"]["remedy"]
    assert inflight(*with_table, "main-span", "--table", "daily").code == 2
    assert inflight(*with_table, "main-spam").code == 2
