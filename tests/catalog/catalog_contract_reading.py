"""What every catalog gives to readers, whatever database is behind it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import xarray as xr
from catalog_cases import days_from, publish, samples

from inflight.catalog import DayData, write_segment
from inflight.errors import CatalogError
from inflight.time import day_bounds, to_tt2000, to_utc

DAYS = days_from("2005-12-30", 4)  # the second one ends with a leap second
NAME = "l1/fgm"


class ReadingContract:
    def test_a_span_opens_lazily_indexed_by_utc(self, catalog):
        publish(catalog, NAME, DAYS[:2])
        publish(catalog, NAME, DAYS[2:])
        opened = catalog.open(NAME)
        assert all(opened[name].chunks for name in ("field", "temperature", "flag"))
        expected = xr.concat(
            [samples(day) for day in DAYS], "time", data_vars="minimal", coords="minimal", compat="equals"
        )
        assert opened.indexes["time"].is_monotonic_increasing
        np.testing.assert_array_equal(opened["time"].values, to_utc(expected["tt2000"].values))
        xr.testing.assert_identical(opened.drop_vars("time").compute(), expected)

    @pytest.mark.parametrize("jitter", [False, True])
    @pytest.mark.parametrize(
        ("start", "stop"),
        [
            ("2005-12-30T06:05", "2006-01-01T12:00"),
            ("2005-12-31T23:59:50", "2006-01-01"),
            (None, "2005-12-31"),
            ("2006-01-02", None),
        ],
    )
    def test_a_span_is_cut_exactly_and_half_open(self, catalog, start, stop, jitter):
        with catalog.run("ingest") as run:
            data = [DayData(day, samples(day, jitter=jitter)) for day in DAYS]
            run.attach(write_segment(catalog.workspace, run.id, NAME, data))
            run.publish()
        every = np.concatenate([item.dataset["tt2000"].values for item in data])
        keep = np.ones(every.size, bool)
        if start:
            keep &= every >= to_tt2000(np.datetime64(start, "ns"))
        if stop:
            keep &= every < to_tt2000(np.datetime64(stop, "ns"))
        opened = catalog.open(NAME, slice(start, stop), variables=["field"])
        np.testing.assert_array_equal(opened["tt2000"].values, every[keep])
        fields = np.concatenate([item.dataset["field"].values for item in data])
        np.testing.assert_array_equal(opened["field"].values, fields[keep])

    def test_one_day_reads_eagerly_and_equals_the_lazy_one(self, catalog):
        publish(catalog, NAME, DAYS)
        for day in DAYS:
            eager = catalog.read_day(NAME, day)
            assert not any(variable.chunks for variable in eager.variables.values())
            xr.testing.assert_identical(eager, catalog.open(NAME, day).compute())

    def test_chosen_variables_come_with_their_times(self, catalog):
        publish(catalog, NAME, DAYS)
        assert set(catalog.read_day(NAME, DAYS[0], ["flag"]).variables) == {"flag", "tt2000", "time"}
        assert set(catalog.open(NAME, variables=["flag"]).variables) == {"flag", "tt2000", "time"}
        for read in (
            lambda: catalog.read_day(NAME, DAYS[0], ["fild"]),
            lambda: catalog.open(NAME, variables=["fild"]),
        ):
            with pytest.raises(CatalogError, match="fild"):
                read()

    def test_what_is_not_there_is_told(self, catalog):
        with pytest.raises(CatalogError, match="none"):
            catalog.open("l1/none")
        publish(catalog, NAME, DAYS)
        with pytest.raises(CatalogError, match="l1/fgm"):
            catalog.open("l1/fgn")
        with pytest.raises(CatalogError, match="no published days"):
            catalog.open(NAME, slice("2010-01-01", "2010-02-01"))
        with pytest.raises(CatalogError, match="2010-01-01"):
            catalog.read_day(NAME, "2010-01-01")
        for span in (slice("2006-01-02", "2006-01-01"), slice("a", None), slice(None, None, 2)):
            with pytest.raises(CatalogError):
                catalog.open(NAME, span)

    def test_a_channel_absent_on_some_days_is_nan_there(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        with catalog.run("ingest") as run:
            run.stage(NAME, samples(DAYS[1]).drop_vars("temperature"), day=DAYS[1])
            run.publish()
        opened = catalog.open(NAME)["temperature"].compute()
        assert np.isnan(opened.values[opened["time"].values >= DAYS[1]]).all()
        assert np.isfinite(opened.values[opened["time"].values < DAYS[1]]).all()

    def test_a_change_of_unit_inside_a_span_is_refused(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        other = samples(DAYS[1])
        other["field"].attrs["units"] = "uT"
        with catalog.run("ingest") as run:
            run.stage(NAME, other, day=DAYS[1])
            run.publish()
        with pytest.raises(CatalogError, match="units"):
            catalog.open(NAME)
        assert catalog.open(NAME, DAYS[1])["field"].attrs["units"] == "uT"

    def test_long_spans_have_a_lazy_time_without_an_index(self, catalog, monkeypatch):
        from inflight.catalog import opening

        publish(catalog, NAME, DAYS)
        indexed = catalog.open(NAME)
        monkeypatch.setattr(opening, "INDEX_LIMIT", 100)
        lazy = catalog.open(NAME)
        assert "time" not in lazy.indexes
        np.testing.assert_array_equal(lazy["time"].values, indexed["time"].values)
        np.testing.assert_array_equal(lazy["tt2000"].values, indexed["tt2000"].values)

    def test_blocks_open_along_block_and_belong_to_the_span_they_start_in(self, catalog):
        with catalog.run("calibrate") as run:
            for day in DAYS:
                edges = np.linspace(*day_bounds(day), 5).astype(np.int64)
                dataset = xr.Dataset(
                    {
                        "gram": (("block", "column"), np.ones((4, 2))),
                        "start": ("block", edges[:-1]),
                        "end": ("block", edges[1:]),
                    }
                )
                run.stage("equations/main/base", dataset, day=day)
            run.publish()
        opened = catalog.open("equations/main/base", slice("2005-12-30T12:00", "2005-12-31T01:00"))
        assert opened.sizes["block"] == 3
        assert catalog.open("equations/main/base").sizes["block"] == 16

    def test_the_newest_revision_of_a_context_is_read(self, catalog):
        version = catalog.save_model("m", "effects: []")
        contexts = [catalog.save_context(text, "m", version, {}) for text in ("one", "two")]
        for seed, context in enumerate([*contexts, contexts[0]]):
            publish(catalog, "l2/field", DAYS[:1], seed=seed, context=context)
        for context, seed in ((None, 2), (contexts[0], 2), (contexts[1], 1)):
            opened = catalog.open("l2/field", context=context)
            np.testing.assert_array_equal(opened["field"], samples(DAYS[0], seed=seed)["field"])

    def test_a_catalog_travels_to_another_process_as_its_folder(self, catalog):
        publish(catalog, NAME, DAYS[:1])
        arrived = pickle.loads(pickle.dumps(catalog))
        assert arrived.days(NAME) == catalog.days(NAME)
        opened = pickle.loads(pickle.dumps(catalog.open(NAME)))
        np.testing.assert_array_equal(opened["field"], samples(DAYS[0])["field"])
        # The next task of the same process finds it open, and what was published since.
        publish(catalog, NAME, DAYS[1:2])
        assert pickle.loads(pickle.dumps(catalog)) is arrived
        assert arrived.days(NAME) == catalog.days(NAME)

    def test_an_unpublished_day_is_read_by_its_record(self, catalog):
        with catalog.run("ingest") as run:
            day = run.stage(NAME, samples(DAYS[0]), day=DAYS[0])
            np.testing.assert_array_equal(catalog.read(day)["field"], samples(DAYS[0])["field"])
            with pytest.raises(CatalogError, match="no data"):
                catalog.read(run.record(NAME, DAYS[1], "failed", "bug", "x"))
