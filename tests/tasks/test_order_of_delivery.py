"""The archive, the products and the verdict do not depend on the order in which days were delivered."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from heated_mission import HEATED_DAYS, deliver_heated_day, heater_field, make_heated_workspace

from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import DiagnoseSettings, diagnose
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import ReprocessSettings, reprocess

SEARCH = DiagnoseSettings(draws=100, rounds=1)
SPAN = ReprocessSettings(table="span", batch_days=2)
ARCHIVE, PRODUCTS = ("l1/turning", "l1/absolute", "l1/power"), ("equations/main/base", "l2/field")
FORWARD, BACKWARD = [[day] for day in HEATED_DAYS], [[day] for day in reversed(HEATED_DAYS)]


def deliver_day(folder: Path, day: str) -> None:
    """Write the files of a day."""
    deliver_heated_day(folder, day, heater_field)


def delivered(
    root: Path,
    deliveries: Sequence[Sequence[str]],
    *,
    deliver: Callable[[Path, str], None] = deliver_day,
    used: bool = False,
) -> Workspace:
    """Return a workspace that took in one delivery after the other; `used` after each of them."""
    place = make_heated_workspace(root, days=())
    for days in deliveries:
        for day in days:
            deliver(place.data, day)
        ingest(Catalog(root), place.mission(), place.data)
        if used:
            verdict(place)
    return place


def verdict(place: Workspace) -> dict:
    """Make products and a diagnosis; return the diagnosis but for its run."""
    cat, mission = Catalog(place.root), place.mission()
    assert reprocess(cat, mission, settings=SPAN).exit_code == 0
    return diagnose(cat, mission, settings=SEARCH).as_json() | {"run": ""}


def contents(place: Workspace, *names: str) -> dict[tuple[str, str], tuple]:
    """Return what is published of datasets by dataset and day: key, report and the bytes of each variable."""
    cat, found = Catalog(place.root), {}
    for day in (day for name in names for day in cat.days(name, states=("published",))):
        data = cat.read_day(day.dataset, day.day)
        values = {name: (one.dims, one.values.tobytes(), one.attrs) for name, one in data.variables.items()}
        found[day.dataset, str(day.day)] = day.key, day.report, data.attrs, values
    return found


def tables(place: Workspace) -> dict[str, str]:
    """Return the sha256 of every file of the tables that are valid."""
    return {
        one.name: (place.root / one.segment / "MANIFEST.sha256").read_text(encoding="utf-8")
        for one in Catalog(place.root).tables()
        if one.certified
    }


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    """Contents, tables and verdict of a mission whose days were delivered all together."""
    place = delivered(tmp_path_factory.mktemp("order") / "at-once", [HEATED_DAYS])
    said = verdict(place)
    return contents(place, *ARCHIVE, *PRODUCTS), tables(place), said


@pytest.mark.parametrize("order", [FORWARD, BACKWARD], ids=["forward", "backward"])
def test_days_give_the_same_archive_products_and_verdict_in_any_order(order, at_once, tmp_path):
    place = delivered(tmp_path / "mission", order)
    said = verdict(place)
    assert said == at_once[2]
    assert contents(place, *ARCHIVE, *PRODUCTS) == at_once[0]
    assert tables(place) == at_once[1]
    assert said["verdict"] == "FOUND"
    assert len(at_once[0]) == len(HEATED_DAYS) * len((*ARCHIVE, *PRODUCTS))


def test_products_and_verdicts_made_between_deliveries_do_not_change_later_ones(at_once, tmp_path):
    first, second, third, fourth = HEATED_DAYS
    place = delivered(tmp_path / "mission", [[first, second, fourth], [third]], used=True)
    assert verdict(place) == at_once[2]
    assert contents(place, *ARCHIVE, *PRODUCTS) == at_once[0]
    assert tables(place) == at_once[1]


def deliver_into_the_next_day(folder: Path, day: str) -> None:
    """Write files of a day that end ten minutes into the next one, as the next day's own files begin."""
    following = str(np.datetime64(day, "D") + 1)
    deliver_heated_day(folder / "next", following, heater_field)
    deliver_heated_day(folder, day, heater_field)
    for path in folder.glob(f"*_{day.replace('-', '')}.csv"):
        later = folder / "next" / path.name.replace(day.replace("-", ""), following.replace("-", ""))
        rows = later.read_text(encoding="utf-8").splitlines(keepends=True)
        path.write_text(path.read_text(encoding="utf-8") + "".join(rows[1:11]), encoding="utf-8")
    shutil.rmtree(folder / "next")


def test_files_that_reach_into_the_next_day_give_the_same_archive_in_any_order(tmp_path):
    found = []
    for name, order in (("at-once", [HEATED_DAYS]), ("forward", FORWARD), ("backward", BACKWARD)):
        place = delivered(tmp_path / name, order, deliver=deliver_into_the_next_day)
        found.append(contents(place, *ARCHIVE))
    assert found[1] == found[0]
    assert found[2] == found[0]
    # Every day, and the ten minutes after the last.
    assert len(found[0]) == (len(HEATED_DAYS) + 1) * len(ARCHIVE)
