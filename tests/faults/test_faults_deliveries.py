"""Every kind of bad delivery through the command line: a clear complaint, and the other days published."""

import json

import pytest
from bad_deliveries import BAD_DAYS, BAD_YAML, FAULTS, GOOD_DAYS, ZERO_SCALAR, deliver

from inflight.catalog import Catalog, Workspace
from inflight.cli import main
from inflight.flows import dask_client
from inflight.flows.cluster import SCHEDULER_VARIABLE

#: Days whose deliveries can be read, the one with a scalar field of zero among them.
READABLE = [*GOOD_DAYS, next(day for day, fault in BAD_DAYS.items() if fault is ZERO_SCALAR)]


def command(capsys, *arguments):
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return left.value.code, capsys.readouterr().out


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    (folder / "faulty.yaml").write_text(BAD_YAML, encoding="utf-8")
    place = Workspace.create(folder / "faulty", folder / "faulty.yaml")
    for day in [*GOOD_DAYS, *BAD_DAYS]:
        deliver(place.data, day)
    for day, fault in BAD_DAYS.items():
        fault.make(place.data, day)
    return place.root


@pytest.fixture(scope="module", autouse=True)
def scheduler():
    """One Dask process for all commands."""
    with dask_client(1) as client, pytest.MonkeyPatch.context() as patch:
        patch.setenv(SCHEDULER_VARIABLE, str(client.scheduler.address))
        yield


def complaint(problems, day):
    (problem,) = [problem for problem in problems if problem["day"] == day]
    return problem


def assert_clear(problem, fault, day):
    """Assert that a complaint names file, channel, day, what was found and what to do."""
    assert fault.file.format(day.replace("-", "")) in problem["message"]
    assert problem["channel"] == fault.channel
    assert fault.found in problem["message"]
    assert fault.remedy in problem["remedy"]
    assert problem["cause"] == "repeatable"


def test_each_bad_delivery_is_named_and_the_other_days_are_published(workspace, capsys):
    code, printed = command(capsys, "ingest", "--no-prefect", "--json", "-w", workspace)
    told = json.loads(printed)
    assert code == 3
    assert told["days"]["failed"] == len(FAULTS) == len(told["problems"])
    for day, fault in BAD_DAYS.items():
        if fault is not ZERO_SCALAR:
            problem = complaint(told["problems"], day)
            assert_clear(problem, fault, day)
            assert problem["instrument"] == fault.instrument
    catalog = Catalog(workspace)
    for name in ("turning", "absolute"):
        missing = {day for day, fault in BAD_DAYS.items() if fault.instrument == name}
        missing -= set(READABLE)
        there = {str(day.day) for day in catalog.days(f"l1/{name}", states=["published"])}
        assert there == {*GOOD_DAYS, *BAD_DAYS} - missing
    assert catalog.verify() == []


def test_reprocess_makes_the_days_that_can_be_and_says_what_is_wrong_with_the_rest(workspace, capsys):
    command(capsys, "ingest", "--no-prefect", "--json", "-w", workspace)
    code, printed = command(capsys, "reprocess", "--no-prefect", "--json", "-w", workspace)
    told = json.loads(printed)
    assert code == 3
    assert told["days"] == {"planned": 12, "done": 2, "unchanged": 0, "failed": 1, "no_work": 9}
    zero = READABLE[-1]
    problem = complaint(told["problems"], zero)
    assert_clear(problem, ZERO_SCALAR, zero)
    for day, fault in BAD_DAYS.items():
        if day != zero:
            assert fault.instrument in complaint(told["problems"], day)["message"]
    catalog = Catalog(workspace)
    assert [str(day.day) for day in catalog.days("l2/field", states=["published"])] == GOOD_DAYS
    assert catalog.verify() == []


def test_a_person_reads_the_same(workspace, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    code, printed = command(capsys, "ingest", "--no-prefect", "-w", workspace)
    assert code == 3
    folded = "".join(printed.split())
    for day, fault in BAD_DAYS.items():
        if fault is not ZERO_SCALAR:
            assert day in printed
            assert fault.file.format(day.replace("-", "")) in folded
