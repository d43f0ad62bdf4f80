"""Properties that hold for any sequence of operations."""

import shutil
import tempfile
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from catalog_cases import days_from, samples, state_url, table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy.exc import IntegrityError as DatabaseRefusal

from inflight.catalog import Catalog, DayData, validities, write_segment
from inflight.catalog.schema import CertificationRow
from inflight.errors import CatalogError, ValidityError
from inflight.time import to_tt2000

BOUNDS = st.tuples(st.integers(0, 20), st.integers(0, 20)).filter(lambda span: span[0] != span[1]).map(sorted)
BOTH_DATABASES = True
SCOPES = st.sampled_from([None, "a", "b"])
DAYS = days_from("2005-12-30", 4)


class InSqlite(RuleBasedStateMachine):
    """A catalog of its own for each sequence of operations; subclasses say where its database is."""

    def open_catalog(self):
        self.folder = Path(tempfile.mkdtemp())
        self.database = self.make_database()
        self.catalog = Catalog(self.folder)

    def make_database(self):
        return nullcontext()

    def teardown(self):
        if hasattr(self, "folder"):
            self.database.__exit__(None, None, None)
            shutil.rmtree(self.folder)


class Validity(InSqlite):
    """Certifying tables in any order, compared with a dictionary of instants."""

    @initialize()
    def begin(self):
        self.open_catalog()
        with self.catalog.run("calibrate") as run:
            self.tables = [
                run.stage_table("offsets", table(value), start=0, end=20) for value in (1.0, 2.0, 3.0)
            ]
        self.truth = {}

    @rule(number=st.integers(0, 2), bounds=BOUNDS, scope=SCOPES, supersede=st.booleans())
    def certify(self, number, bounds, scope, supersede):
        start, end = bounds
        taken = [at for at in range(start, end) if (scope, at) in self.truth]
        if taken and not supersede:
            with pytest.raises(ValidityError):
                self.catalog.certify(self.tables[number], start, end, scope)
            return
        self.catalog.certify(self.tables[number], start, end, scope, supersede=supersede)
        self.truth |= {(scope, at): self.tables[number] for at in range(start, end)}

    @rule(number=st.integers(0, 2), bounds=BOUNDS, scope=SCOPES)
    def decertify(self, number, bounds, scope):
        start, end = bounds
        held = [at for at in range(start, end) if self.truth.get((scope, at)) == self.tables[number]]
        try:
            self.catalog.decertify(self.tables[number], start, end, scope, author="A", reason="r")
        except ValidityError:
            assert not held
        for at in held:
            del self.truth[scope, at]

    @invariant()
    def validities_are_those_of_the_model_and_never_overlap(self):
        seen = {}
        for record in self.catalog.tables():
            for scope, start, end in record.certified:
                for at in range(start, end):
                    assert (scope, at) not in seen, "two tables are valid at one time"
                    seen[scope, at] = record.id
        assert seen == self.truth
        acts = self.catalog.certification_acts()
        for scope in (None, "a", "b"):
            replayed = validities(acts, scope).get("offsets", [])
            told = {(scope, at): table for table, start, end in replayed for at in range(start, end)}
            assert told == {place: table for place, table in self.truth.items() if place[0] == scope}

    @precondition(lambda self: (None, 5) in self.truth)
    @rule()
    def the_valid_table_is_found(self):
        assert self.catalog.table("offsets", 5).attrs["table_id"] == self.truth[None, 5]


TestValidity = Validity.TestCase
TestValidity.settings = settings(max_examples=6, stateful_step_count=10, deadline=None)


class Revisions(InSqlite):
    """Staging, publishing, failing and raising the baseline in any order."""

    @initialize()
    def begin(self):
        self.open_catalog()
        self.published = {}  # (day, version) -> seed
        self.given = set()
        self.current = {}
        self.seed = 0

    @rule(days=st.sets(st.integers(0, 2), min_size=1), publishes=st.booleans(), fails=st.booleans())
    def run(self, days, publishes, fails):
        self.seed += 1
        try:
            with self.catalog.run("test") as run:
                data = [DayData(DAYS[day], samples(DAYS[day], step_s=21600, seed=self.seed)) for day in days]
                run.attach(write_segment(self.folder, run.id, "l1/fgm", data))
                for day in run.publish() if publishes else []:
                    assert (day.day, day.version) not in self.given, "a version was given out twice"
                    self.given.add((day.day, day.version))
                    self.published[day.day, day.version] = self.seed
                    self.current[day.day] = self.seed
                if fails:
                    raise KeyError("stop")
        except KeyError:
            pass

    @rule()
    def raise_baseline(self):
        self.catalog.set_baseline(self.catalog.baseline + 1)

    @rule(past=st.booleans())
    def collect_garbage(self, past):
        listed = self.catalog.gc(past=past)
        assert self.catalog.gc(dry_run=False, past=past) == listed
        freed = [one for found in listed for one in found.revisions]
        old = {
            place: seed for place, seed in self.published.items() if past and seed != self.current[place[0]]
        }
        # A store goes when none of its days is needed.
        for place in old:
            if f"{place[0]} {place[1]}" in freed:
                del self.published[place]
        assert len(freed) == len(set(freed)) <= len(old)

    @invariant()
    def every_revision_ever_published_reads_as_it_was(self):
        for (day, version), seed in self.published.items():
            found = self.catalog.read_day("l1/fgm", day, ["field"], version=version)
            np.testing.assert_array_equal(found["field"], samples(day, step_s=21600, seed=seed)["field"])

    @invariant()
    def the_present_view_is_the_last_publication(self):
        for day, seed in self.current.items():
            found = self.catalog.read_day("l1/fgm", day, ["field"])
            np.testing.assert_array_equal(found["field"], samples(day, step_s=21600, seed=seed)["field"])


TestRevisions = Revisions.TestCase
TestRevisions.settings = settings(max_examples=6, stateful_step_count=6, deadline=None)


@pytest.mark.parametrize("machine", [Validity, Revisions])
def test_the_same_sequences_hold_in_postgresql(postgres_server, template, machine):
    class InPostgres(machine):
        def make_database(self):
            database = postgres_server.database(template)
            state_url(self.folder, postgres_server.url(database.__enter__()))
            return database

    few = settings(max_examples=2, stateful_step_count=5, deadline=None)
    run_state_machine_as_test(InPostgres, settings=few)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Four days, the second with a leap second, irregular and regular, in two segments."""
    catalog = Catalog(tmp_path_factory.mktemp("archive"))
    data = [DayData(day, samples(day, step_s=977, jitter=index % 2 == 0)) for index, day in enumerate(DAYS)]
    with catalog.run("ingest") as run:
        for part in (data[:3], data[3:]):
            run.attach(write_segment(catalog.workspace, run.id, "l1/fgm", part))
        run.publish()
    whole = xr.concat(
        [item.dataset for item in data], "time", data_vars="minimal", coords="minimal", compat="equals"
    )
    return catalog, whole


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edges=st.tuples(st.integers(-3600, 5 * 86400), st.integers(-3600, 5 * 86400)).map(sorted))
def test_any_span_is_the_days_joined_and_cut(archive, edges):
    catalog, whole = archive
    start, stop = (DAYS[0].astype("datetime64[s]") + np.timedelta64(edge, "s") for edge in edges)
    first, last = to_tt2000(np.array([start, stop], "datetime64[ns]"))
    keep = (whole["tt2000"].values >= first) & (whole["tt2000"].values < last)
    try:
        opened = catalog.open("l1/fgm", slice(start, stop))
    except CatalogError:
        assert not keep.any()
        return
    xr.testing.assert_identical(opened.drop_vars("time").compute(), whole.isel(time=keep))


def test_the_database_itself_refuses_validities_that_overlap(catalog):
    """The last guard, should a writer ever forget to look."""
    with catalog.run("calibrate") as run:
        made = run.stage_table("offsets", table(), start=0, end=20)
    catalog.certify(made, 0, 10)
    with catalog._database._writing.connect() as connection, pytest.raises(DatabaseRefusal, match="overlap"):
        connection.execute(
            CertificationRow.__table__.insert().values(
                table_id=made, name="offsets", context="", start=9, end=12
            )
        )
