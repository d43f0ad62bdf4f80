"""What every catalog does, whatever database is behind it: subclass and give a `catalog` fixture."""

from __future__ import annotations

import datetime as dt
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from catalog_cases import days_from, delivered, publish, samples, table
from catalog_contract_reading import ReadingContract

from inflight.catalog import Catalog, DayData, NamedContext, idempotency_key, validities, write_segment
from inflight.errors import CatalogError, ContentError, IntegrityError, ValidityError
from inflight.time import day_bounds

DAYS = days_from("2005-12-30", 4)  # the second one ends with a leap second
NAME = "l1/fgm"


class RunContract:
    def test_days_are_unseen_until_published_and_then_have_versions(self, catalog):
        with catalog.run("ingest", {"batch": 4}) as run:
            segment = write_segment(
                catalog.workspace, run.id, NAME, [DayData(day, samples(day)) for day in DAYS]
            )
            attached = run.attach(segment)
            assert [(day.state, day.version) for day in attached] == [("verified", "")] * 4
            assert catalog.current(NAME, DAYS[0]) is None
            published = run.publish()
        assert [(day.day, day.state, day.version) for day in published] == [
            (day, "published", "v01.00") for day in DAYS
        ]
        assert catalog.days(NAME) == published
        assert catalog.current(NAME, "2005-12-30") == published[0]

    def test_leaving_without_publishing_leaves_the_view_unchanged(self, catalog):
        publish(catalog, NAME, DAYS)
        before = catalog.days(NAME)
        with catalog.run("reprocess") as run:
            run.stage(NAME, samples(DAYS[0], seed=1), day=DAYS[0])
        assert catalog.days(NAME) == before

    @pytest.mark.parametrize(
        ("error", "cause"),
        [
            (ValueError("bad"), "bug"),
            (ContentError("no such variable"), "repeatable"),
            (OSError("lost"), "transient"),
            (KeyboardInterrupt(), "transient"),
        ],
    )
    def test_a_run_that_raises_is_recorded_as_failed_with_its_cause(self, catalog, error, cause):
        def fail():
            with catalog.run("reprocess") as run:
                run.record(NAME, DAYS[0], "running")
                raise error

        with pytest.raises(type(error)):
            fail()
        (recorded,) = catalog.runs()
        assert (recorded.state, recorded.cause) == ("failed", cause)
        assert type(error).__name__ in recorded.message
        (day,) = catalog.days(NAME)
        assert (day.state, day.cause) == ("failed", cause)

    def test_publishing_again_makes_new_revisions_and_old_ones_stay_readable(self, catalog):
        for seed in range(3):
            publish(catalog, NAME, DAYS, seed=seed)
        assert {day.version for day in catalog.days(NAME)} == {"v01.02"}
        for seed in range(3):
            opened = catalog.read_day(NAME, DAYS[2], version=f"v01.{seed:02d}")
            expected = samples(DAYS[2], seed=seed)
            np.testing.assert_array_equal(opened["field"], expected["field"])
        with pytest.raises(CatalogError, match=r"v01\.03"):
            catalog.read_day(NAME, DAYS[2], version="v01.03")

    def test_a_clock_set_back_mixes_and_loses_nothing_and_times_keep_their_order(self, catalog, monkeypatch):
        back = dt.timedelta(0)
        for module in ("database", "runs"):
            clock = f"inflight.catalog.{module}.present_time"
            monkeypatch.setattr(clock, lambda: dt.datetime.now(dt.UTC) + back)
        for seed, hours in enumerate((0, -5, -29, 1)):
            with catalog.run("reprocess", {"seed": seed}) as run:
                # Set back while the run is under way; another process opens the catalog then.
                back = dt.timedelta(hours=hours)
                Catalog(catalog.workspace)
                run.stage(NAME, samples(DAYS[0], seed=seed), day=DAYS[0])
                made = run.stage_table("offsets", table(float(seed)), start=0, end=10)
                run.publish(certify=[(made, 0, 10, None)], supersede=True)
            catalog.save_model("m", f"effects: [{seed}]")
        found = catalog.runs()
        assert [one.settings["seed"] for one in found] == [0, 1, 2, 3]
        assert [one.state for one in found] == ["done"] * 4
        assert sorted(one.id[:15] for one in found) == [one.id[:15] for one in found]
        took = [
            dt.datetime.fromisoformat(one.ended) - dt.datetime.fromisoformat(one.started) for one in found
        ]
        assert all(dt.timedelta(0) < one < dt.timedelta(minutes=1) for one in took)
        assert catalog.rate("reprocess").seconds > 0
        assert [day.version for day in catalog.revisions(NAME)] == ["v01.00", "v01.01", "v01.02", "v01.03"]
        np.testing.assert_array_equal(
            catalog.read_day(NAME, DAYS[0])["field"], samples(DAYS[0], seed=3)["field"]
        )
        assert [one.created for one in catalog.models()] == sorted(one.created for one in catalog.models())
        # What was valid by then is told in the order in which it was done.
        acts = catalog.certification_acts()
        assert [act.table for act in acts] == [1, 2, 3, 4]
        for at, act in enumerate(acts):
            before = catalog.certification_acts(until=dt.datetime.fromisoformat(act.created))
            assert before == acts[:at]

    def test_the_baseline_leads_the_version_and_never_goes_back(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        catalog.set_baseline(2)
        publish(catalog, NAME, DAYS[:1])
        publish(catalog, NAME, DAYS[:1])
        assert catalog.current(NAME, DAYS[0]).version == "v02.01"
        with pytest.raises(CatalogError, match="lower"):
            catalog.set_baseline(1)

    def test_a_day_of_the_same_key_is_not_published_twice(self, catalog):
        publish(catalog, NAME, DAYS, key="k")
        with catalog.run("ingest") as run:
            run.stage(NAME, samples(DAYS[0]), day=DAYS[0], key=f"k-{DAYS[0]}")
            run.stage(NAME, samples(DAYS[1], seed=5), day=DAYS[1], key="other")
            published = run.publish()
        assert [(day.day, day.version) for day in published] == [(DAYS[1], "v01.01")]
        assert catalog.current(NAME, DAYS[0]).version == "v01.00"

    def test_one_failing_certification_publishes_nothing(self, catalog):
        with catalog.run("calibrate") as run:
            first = run.stage_table("offsets", table(), start=0, end=10)
            catalog.certify(first, 0, 10)
            second = run.stage_table("offsets", table(2.0), start=5, end=15)
            run.stage(NAME, samples(DAYS[0]), day=DAYS[0])
            with pytest.raises(ValidityError):
                run.publish(certify=[(second, 5, 15, None)])
            assert catalog.current(NAME, DAYS[0]) is None
            run.publish(certify=[(second, 5, 15, None)], supersede=True)
        assert catalog.current(NAME, DAYS[0]) is not None
        assert catalog.table("offsets", 7)["value"].values[0, 0] == 2.0

    def test_a_store_damaged_before_publication_stops_it(self, catalog):
        with catalog.run("ingest") as run:
            day = run.stage(NAME, samples(DAYS[0]), day=DAYS[0])
            (catalog.workspace / day.segment / "MANIFEST.sha256").write_text("")
            with pytest.raises(IntegrityError):
                run.publish()
        assert catalog.current(NAME, DAYS[0]) is None

    def test_a_message_that_quotes_a_broken_file_is_recorded(self, catalog):
        with catalog.run("ingest") as run:
            run.record(NAME, DAYS[0], "failed", "repeatable", "bad header '\0\1'", {"head": "\0"})
        (day,) = catalog.days(NAME)
        assert day.message.startswith("bad header '")
        assert day.report == {"head": "\0"}

    def test_states_of_days_are_recorded_and_listed(self, catalog):
        with catalog.run("ingest") as run:
            run.record(NAME, DAYS[0], "planned")
            run.record(NAME, DAYS[0], "failed", "repeatable", "file is cut", report={"coverage": 0.1})
            run.record(NAME, DAYS[1], "no_work", "no_work", "nothing delivered")
            run.stage(NAME, samples(DAYS[2]), day=DAYS[2])
            run.publish()
        states = [(day.state, day.cause) for day in catalog.days(NAME)]
        assert states == [("failed", "repeatable"), ("no_work", "no_work"), ("published", "")]
        assert [day.day for day in catalog.days(NAME, states=["failed"])] == [DAYS[0]]
        assert [day.day for day in catalog.days(NAME, time=slice(DAYS[1], DAYS[2]))] == [DAYS[1]]

    def test_a_failure_is_listed_until_the_day_is_published_after_it(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        with catalog.run("reprocess") as run:
            run.record(NAME, DAYS[0], "failed", "bug", "division")
        assert catalog.days(NAME)[0].state == "published"
        assert [day.message for day in catalog.days(NAME, states=["failed"])] == ["division"]
        publish(catalog, NAME, DAYS[:1], seed=1)
        assert catalog.days(NAME, states=["failed"]) == []

    @pytest.mark.parametrize(("state", "cause"), [("published", ""), ("failed", ""), ("failed", "weather")])
    def test_a_state_or_cause_that_does_not_exist_is_refused(self, catalog, state, cause):
        with catalog.run("ingest") as run, pytest.raises(CatalogError):
            run.record(NAME, DAYS[0], state, cause)

    def test_a_verified_day_of_an_ended_run_is_adopted_by_its_key(self, catalog):
        with catalog.run("ingest") as dead:
            dead.stage(
                NAME, samples(DAYS[0]), day=DAYS[0], key="k", parents=["file:1"], report={"coverage": 1.0}
            )
        with catalog.run("ingest") as run:
            run.record(NAME, DAYS[0], "planned")
            assert run.adopt(NAME, DAYS[0], "other") is None
            assert run.adopt(NAME, DAYS[0], "") is None
            adopted = run.adopt(NAME, DAYS[0], "k")
            run.publish()
        assert adopted.state == "verified"
        current = catalog.current(NAME, DAYS[0])
        assert (current.run, current.key, current.report) == (run.id, "k", {"coverage": 1.0})
        assert [edge.parent for edge in catalog.lineage(current)] == ["file:1"]
        xr.testing.assert_equal(catalog.read_day(NAME, DAYS[0]).drop_vars("time"), samples(DAYS[0]))

    def test_a_day_of_a_live_run_is_not_adopted(self, catalog):
        with catalog.run("ingest") as alive:
            alive.stage(NAME, samples(DAYS[0]), day=DAYS[0], key="k")
            with catalog.run("ingest") as run:
                assert run.adopt(NAME, DAYS[0], "k") is None

    def test_a_damaged_day_is_not_adopted(self, catalog):
        with catalog.run("ingest") as dead:
            day = dead.stage(NAME, samples(DAYS[0]), day=DAYS[0], key="k")
        (catalog.workspace / day.segment / "flag" / "c.0").unlink()
        with catalog.run("ingest") as run:
            assert run.adopt(NAME, DAYS[0], "k") is None

    def test_a_run_restages_a_day_until_it_has_published_it(self, catalog):
        with catalog.run("ingest") as run:
            run.stage(NAME, samples(DAYS[0]), day=DAYS[0])
            run.stage(NAME, samples(DAYS[0], seed=1), day=DAYS[0])
            run.publish()
            with pytest.raises(CatalogError, match="already published"):
                run.stage(NAME, samples(DAYS[0], seed=2), day=DAYS[0])
        expected = samples(DAYS[0], seed=1)
        np.testing.assert_array_equal(catalog.read_day(NAME, DAYS[0])["field"], expected["field"])

    def test_keys_depend_on_everything_but_the_order_of_inputs(self):
        key = idempotency_key("l2/field", "2005-01-01", 1, "c", ["a", "b"])
        assert key == idempotency_key("l2/field", np.datetime64("2005-01-01"), 1, "c", ["b", "a"])
        others = [
            idempotency_key("l2/flag", "2005-01-01", 1, "c", ["a", "b"]),
            idempotency_key("l2/field", "2005-01-02", 1, "c", ["a", "b"]),
            idempotency_key("l2/field", "2005-01-01", 2, "c", ["a", "b"]),
            idempotency_key("l2/field", "2005-01-01", 1, None, ["a", "b"]),
            idempotency_key("l2/field", "2005-01-01", 1, "c", ["ab"]),
        ]
        assert len({key, *others}) == 6


class TableContract:
    def staged(self, catalog, *values):
        with catalog.run("calibrate") as run:
            return [run.stage_table("offsets", table(value), start=0, end=100) for value in values]

    def value_at(self, catalog, at, context=None):
        return float(catalog.table("offsets", at, context)["value"].values[0, 0])

    def test_a_table_holds_in_its_half_open_validity_only(self, catalog):
        one, two = self.staged(catalog, 1.0, 2.0)
        catalog.certify(one, 0, 50)
        catalog.certify(two, 50, 100)
        assert [self.value_at(catalog, at) for at in (0, 49, 50, 99)] == [1.0, 1.0, 2.0, 2.0]
        assert catalog.table("offsets", 50).attrs["table_id"] == two
        for at in (-1, 100):
            with pytest.raises(CatalogError, match="no table 'offsets'"):
                catalog.table("offsets", at)

    def test_an_overlap_names_both_tables_and_changes_nothing(self, catalog):
        one, two = self.staged(catalog, 1.0, 2.0)
        catalog.certify(one, 0, 50)
        with pytest.raises(ValidityError, match=rf"table {two} .* table {one},"):
            catalog.certify(two, 49, 60)
        with pytest.raises(ValidityError):
            catalog.certify(two, 60, 60)
        assert [record.certified for record in catalog.tables("offsets")] == [((None, 0, 50),), ()]

    def test_superseding_ends_the_older_validity_and_keeps_what_is_left(self, catalog):
        one, two, three = self.staged(catalog, 1.0, 2.0, 3.0)
        catalog.certify(one, 0, 100)
        catalog.certify(two, 20, 40, supersede=True)
        assert [self.value_at(catalog, at) for at in (0, 19, 20, 39, 40, 99)] == [1, 1, 2, 2, 1, 1]
        catalog.certify(three, 0, 100, supersede=True)
        assert {self.value_at(catalog, at) for at in range(0, 100, 5)} == {3.0}

    def test_contexts_have_validities_of_their_own_and_go_first(self, catalog):
        one, two, three = self.staged(catalog, 1.0, 2.0, 3.0)
        version = catalog.save_model("m", "effects: []")
        context = catalog.save_context("mission", "m", version, {"offsets": [(two, 0, 100)]})
        catalog.certify(one, 0, 100)
        assert self.value_at(catalog, 5) == 1.0
        assert self.value_at(catalog, 5, context) == 2.0
        catalog.certify(three, 0, 50, context)
        assert self.value_at(catalog, 5, context) == 3.0
        assert self.value_at(catalog, 5) == 1.0

    def test_what_is_done_to_validities_is_kept_and_tells_what_held_when(self, catalog):
        one, two = self.staged(catalog, 1.0, 2.0)
        catalog.certify(one, 0, 100, author="A. Person", reason="first light")
        (first,) = catalog.certification_acts("offsets")
        assert (first.author, first.reason, first.run) == ("A. Person", "first light", None)
        catalog.certify(two, 20, 40, supersede=True, author="B", reason="torquer")
        catalog.decertify(one, 60, 70, author="B", reason="eclipse")
        by_name = {record.id: record.certified for record in catalog.tables("offsets")}
        assert by_name == {one: ((None, 0, 20), (None, 40, 60), (None, 70, 100)), two: ((None, 20, 40),)}
        with pytest.raises(CatalogError, match="no table 'offsets'"):
            catalog.table("offsets", 65)
        acts = catalog.certification_acts()
        assert [(act.act, act.table, act.start, act.end, act.reason) for act in acts] == [
            ("certify", one, 0, 100, "first light"),
            ("certify", two, 20, 40, "torquer"),
            ("decertify", one, 60, 70, "eclipse"),
        ]
        assert validities(acts) == {"offsets": [(one, 0, 20), (two, 20, 40), (one, 40, 60), (one, 70, 100)]}
        later = dt.datetime.fromisoformat(acts[1].created)
        assert validities(catalog.certification_acts(until=later)) == {"offsets": [(one, 0, 100)]}
        with pytest.raises(ValidityError, match="not valid"):
            catalog.decertify(two, 60, 70, author="B", reason="mistaken")

    def test_what_a_run_certifies_is_kept_with_the_run_and_its_reason(self, catalog):
        with catalog.run("calibrate", {"reason": "new attitude"}) as run:
            made = run.stage_table("offsets", table(), start=0, end=10)
            run.publish(certify=[(made, 0, 10, None)])
        (act,) = catalog.certification_acts()
        assert (act.run, act.reason, act.author) == (run.id, "new attitude", "")

    def test_a_person_takes_no_validity_from_days_of_a_release(self, catalog):
        span = day_bounds(DAYS[0])[0], day_bounds(DAYS[3])[1]
        with catalog.run("reprocess") as run:
            one, two = (run.stage_table("offsets", table(value), start=0, end=1) for value in (1.0, 2.0))
            for day in DAYS[:2]:
                run.stage("l2/field", samples(day), day=day, parents=[f"table:{one}"])
            run.publish(certify=[(one, *span, None)])
        catalog.release("1.0", datasets=["l2/*"])
        later = day_bounds(DAYS[2])[0]
        who = {"author": "A", "reason": "drift"}
        with pytest.raises(ValidityError, match=r"release 1\.0 has 2005-12-31"):
            catalog.decertify(one, later - 1, None, **who)
        with pytest.raises(ValidityError, match=r"release 1\.0"):
            catalog.certify(two, *span, supersede=True, **who)
        catalog.decertify(one, later, **who)
        catalog.certify(two, later, span[1], **who)
        with catalog.run("reprocess") as run:  # what the next release is made with
            run.publish(certify=[(two, *span, None)], supersede=True)
        assert catalog.table("offsets", span[0]).attrs["table_id"] == two

    def test_a_table_is_read_by_time_or_by_id(self, catalog):
        (one,) = self.staged(catalog, 1.5)
        start, end = day_bounds("2005-01-01")
        catalog.certify(one, start, end)
        expected = table(1.5).assign_attrs(table_id=one)
        xr.testing.assert_identical(catalog.table("offsets", "2005-01-01T12:00:00Z"), expected)
        xr.testing.assert_identical(catalog.table_by_id(one), expected)
        with pytest.raises(CatalogError):
            catalog.table_by_id(99)
        with pytest.raises(CatalogError, match="99"):
            catalog.certify(99, 0, 1)


class RegistryContract:
    def test_models_are_versioned_and_identical_text_keeps_its_version(self, catalog):
        first = catalog.save_model("champ", "a: 1")
        second = catalog.save_model("champ", "a: 2", parent=first, message="more")
        assert (first, second, catalog.save_model("champ", "a: 1")) == (1, 2, 1)
        assert catalog.model_text("champ") == ("champ", 2, "a: 2")
        assert catalog.model_text("champ", 1) == ("champ", 1, "a: 1")
        catalog.save_model("other", "b: 1")
        assert catalog.model_text() == ("other", 1, "b: 1")
        assert [(record.name, record.version, record.parent) for record in catalog.models()] == [
            ("champ", 1, None),
            ("champ", 2, 1),
            ("other", 1, None),
        ]
        with pytest.raises(CatalogError, match="champ 2"):
            catalog.model_text("champ", 7)
        with pytest.raises(CatalogError, match="no version 9"):
            catalog.save_model("champ", "a: 3", parent=9)

    def test_a_context_pins_what_it_names_and_its_id_is_its_content(self, catalog):
        version = catalog.save_model("champ", "a: 1")
        with catalog.run("calibrate") as run:
            offsets = run.stage_table("offsets", table(), start=0, end=1)
        one = catalog.save_context("mission: champ", "champ", version, {"offsets": ((offsets, 0, 1),)})
        assert one == catalog.save_context(
            "mission: champ", "champ", version, {"offsets": ((offsets, 0, 1),)}
        )
        assert one != catalog.save_context("mission: champ", "champ", version, {})
        record = catalog.context(one)
        assert (record.mission_text, record.model_name, record.tables) == (
            "mission: champ",
            "champ",
            {"offsets": ((offsets, 0, 1),)},
        )
        for name, pinned in (("none", {}), ("champ", {"offsets": [(99, 0, 1)]})):
            with pytest.raises(CatalogError):
                catalog.save_context("mission", name, version, pinned)

    def test_a_context_pins_tables_by_time_and_has_a_name(self, catalog):
        version = catalog.save_model("champ", "a: 1")
        with catalog.run("calibrate") as run:
            one, two = (run.stage_table("offsets", table(value), start=0, end=20) for value in (1.0, 2.0))
        pinned = {"offsets": [(one, 0, 10), (two, 10, 20)]}
        made = catalog.save_context("mission: champ", "champ", version, pinned)
        catalog.certify(one, 10, 30)  # which is not in the context
        assert [catalog.table("offsets", at, made).attrs["table_id"] for at in (9, 10)] == [one, two]
        with pytest.raises(CatalogError, match="no table 'offsets'"):
            catalog.table("offsets", 20, made)
        member = NamedContext(
            name="", comparison="main", context=made, run=run.id, author="A", reason="r", as_of="", created=""
        )
        catalog.name_contexts("flight", [member])
        with pytest.raises(CatalogError, match="there already"):
            catalog.name_contexts("flight", [member])
        (named,) = catalog.named_contexts("flight")
        assert (named.name, named.context, named.run, named.author) == ("flight", made, run.id, "A")
        with pytest.raises(CatalogError, match="did you mean 'flight'"):
            catalog.named_contexts("fligt")
        with catalog.run("reprocess", {}, made) as run:
            run.stage("l2/field", samples(DAYS[0]), day=DAYS[0])
            run.publish()
        catalog.release("1.0", datasets=["l2/*"])
        assert catalog.releases_of_context("flight") == ["1.0"]
        with pytest.raises(CatalogError, match=r"release 1\.0"):
            catalog.remove_context("flight")
        catalog.name_contexts("other", [replace(member, context=catalog.save_context("m", "champ", 1, {}))])
        catalog.remove_context("other")
        assert [one.name for one in catalog.named_contexts()] == ["flight"]

    def test_delivered_files_count_once_their_days_are_published(self, catalog):
        def take(sha256, *, publishing):
            with catalog.run("ingest") as run:
                catalog.record_files(run, [delivered(run, sha256, DAYS[0], dropped=1)])
                if publishing:
                    run.publish()
            return run.id

        take("1" * 64, publishing=False)
        assert catalog.files("fgm") == {}
        take("1" * 64, publishing=True)
        last = take("2" * 64, publishing=True)
        record = catalog.files("fgm")["a.cdf"]
        assert (record.sha256, record.size, record.mtime_ns, record.run) == ("2" * 64, 10, 123, last)
        assert (record.days, record.report) == (("2005-12-30",), {"dropped": 1})
        assert catalog.files("ovm") == {}

    def test_lineage_leads_from_product_to_file_and_back(self, catalog):
        version = catalog.save_model("champ", "a: 1")
        context = catalog.save_context("mission: champ", "champ", version, {})
        with catalog.run("ingest") as run:
            catalog.record_files(run, [delivered(run, "1" * 64)])
            raw = run.stage(NAME, samples(DAYS[0]), day=DAYS[0], parents=["file:" + "1" * 64])
            run.publish()
        with catalog.run("reprocess", {}, context) as run:
            product = run.stage("l2/field", samples(DAYS[0]), day=DAYS[0], parents=[raw])
            run.publish()
        up = {(edge.parent, edge.child) for edge in catalog.lineage(product)}
        assert up == {
            (raw.id, product.id),
            (f"context:{context}", product.id),
            ("model:champ@1", f"context:{context}"),
            ("file:" + "1" * 64, raw.id),
        }
        assert [edge.child for edge in catalog.lineage("file:" + "1" * 64, up=False)] == [raw.id, product.id]
        for named in ("a.cdf", "file:" + "1" * 64, NAME, product.id, "model:1", f"context:{context[:8]}"):
            graph = catalog.lineage_graph(named)
            found = {node.kind: node.text for node in graph.nodes if node.side != "here"}
            assert found.get("product", "2005-12-30 v01.00") == "2005-12-30 v01.00"
            assert {"product", "archive", "delivered files", "model", "context"} >= set(found), named
            assert graph.edges
        assert catalog.verify() == []


class UpkeepContract:
    def test_verify_names_every_damaged_file_of_what_is_in_use(self, catalog):
        publish(catalog, NAME, DAYS)
        with catalog.run("ingest") as run:
            catalog.record_files(run, [delivered(run, "abc")])
        assert catalog.verify() == []
        chunk = catalog.workspace / catalog.current(NAME, DAYS[0]).segment / "flag" / "c.0"
        chunk.write_bytes(b"nonsense")
        (fault,) = catalog.verify()
        assert fault["item"] == NAME
        assert fault["path"].endswith("flag/c.0")
        assert catalog.verify("l1/other") == []

    def test_verify_tells_a_parent_that_does_not_exist(self, catalog):
        publish(catalog, NAME, DAYS)
        assert [fault["item"] for fault in catalog.verify()] == ["file:abc"]

    def test_garbage_is_what_nothing_refers_to(self, catalog):
        publish(catalog, NAME, DAYS, key="k")
        with catalog.run("ingest") as run:
            superseded = run.stage(NAME, samples(DAYS[0]), day=DAYS[0], key="old")
        with catalog.run("ingest") as run:
            waiting = run.stage("l1/ovm", samples(DAYS[0]), day=DAYS[0], key="new")
        publish(catalog, NAME, DAYS, seed=1)
        orphan = write_segment(catalog.workspace, "nobody", NAME, [DayData(DAYS[0], samples(DAYS[0]))])
        half = "stores/nobody/half.zarr"
        (catalog.workspace / half).mkdir()
        expected = sorted([superseded.segment, orphan.path, half])
        assert sorted(one.path for one in catalog.gc()) == expected
        assert (catalog.workspace / orphan.path).exists()
        assert sorted(one.path for one in catalog.gc(dry_run=False)) == expected
        assert not any((catalog.workspace / path).exists() for path in expected)
        assert (catalog.workspace / waiting.segment).exists()
        assert catalog.gc() == []
        catalog.read_day(NAME, DAYS[0], version="v01.00")

    def test_past_revisions_go_unless_a_release_a_context_or_lineage_needs_them(self, catalog):
        catalog.save_model("m", "a: 1")
        context = catalog.save_context("mission", "m", 1, {})

        def product(seed, *parents, made_in=None):
            with catalog.run("reprocess", {}, made_in) as run:
                made = run.stage_table("offsets", table(seed), start=0, end=10, parents=parents)
                parts = [f"table:{made}", *parents]
                run.stage("l2/field", samples(DAYS[0], seed=seed), day=DAYS[0], parents=parts)
                (day,) = run.publish(certify=[(made, 0, 10, None)], supersede=True)
            return made, day

        raw = []
        for seed in range(3):
            with catalog.run("ingest") as run:
                run.stage(NAME, samples(DAYS[0], seed=seed), day=DAYS[0], parents=["model:m@1"])
                raw += run.publish()
        first, released = product(0, raw[0].id)  # of the first measurements, which a release holds
        catalog.release("1.0", datasets=["l2/*"])
        second, past = product(1, raw[2].id)
        third, named = product(2, raw[2].id, made_in=context)
        member = NamedContext(
            name="",
            comparison="main",
            context=context,
            run=named.run,
            author="A",
            reason="",
            as_of="",
            created="",
        )
        catalog.name_contexts("flight", [member])
        fourth, newest = product(3, raw[2].id)
        assert catalog.gc() == []
        (tables,) = [[one for one in catalog.tables() if one.id == second]]
        expected = {raw[1].segment: NAME, past.segment: "l2/field", tables[0].segment: "tables/offsets"}
        listed = catalog.gc(past=True)
        assert {one.path: one.item for one in listed} == expected
        assert all(one.bytes > 0 for one in listed)
        assert [one.revisions for one in listed if one.item == NAME] == [("2005-12-30 v01.01",)]
        with catalog.run("reprocess"), pytest.raises(CatalogError, match="under way"):
            catalog.gc(dry_run=False, past=True)
        assert catalog.gc(dry_run=False, past=True) == listed
        assert not any((catalog.workspace / path).exists() for path in expected)
        assert catalog.gc(past=True) == []
        assert catalog.verify() == []
        for day in (released, named, newest):
            assert catalog.read(day)["field"].size
        assert [catalog.table_by_id(number)["value"].values[0, 0] for number in (first, third, fourth)] == [
            0,
            2,
            3,
        ]
        assert [one.damaged for one in catalog.tables("offsets")] == [False, True, False, False]
        assert [day.version for day in catalog.revisions("l2/field")] == ["v01.00", "v01.02", "v01.03"]
        with pytest.raises(CatalogError, match="freed"):
            catalog.read_day("l2/field", DAYS[0], version=past.version)
        assert product(4, raw[2].id)[1].version == "v01.04"  # a version is never given out twice

    def test_what_a_live_run_writes_is_no_garbage(self, catalog):
        with catalog.run("ingest") as run:
            write_segment(catalog.workspace, run.id, NAME, [DayData(DAYS[0], samples(DAYS[0]))])
            assert catalog.gc(dry_run=False) == []

    def test_the_inventory_tells_span_gaps_failures_and_versions(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        publish(catalog, NAME, DAYS[3:])
        publish(catalog, NAME, DAYS[3:], seed=1)
        with catalog.run("ingest") as run:
            run.record(NAME, DAYS[1], "failed", "repeatable", "cut")
        (item,) = catalog.inventory()
        assert catalog.dataset_names() == [NAME]
        assert (item["dataset"], item["first"], item["last"]) == (NAME, "2005-12-30", "2006-01-02")
        assert (item["days"], item["failed"], item["gaps"]) == (2, 1, ["2005-12-31", "2006-01-01"])
        assert item["versions"] == {"v01.00": 1, "v01.01": 1}

    def test_opening_twice_changes_nothing(self, catalog):
        publish(catalog, NAME, DAYS)
        assert Catalog(catalog.workspace).days(NAME) == catalog.days(NAME)


class CatalogContract(RunContract, ReadingContract, TableContract, RegistryContract, UpkeepContract):
    """All of it."""
