import json
import pickle
import shutil

import numpy as np
import pytest
import xarray as xr
import zarr
from catalog_cases import days_from, samples, table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from store_cases import unfinished_stores

from inflight.catalog import DayData, segments, write_segment, write_table
from inflight.catalog.encoding import encode
from inflight.catalog.manifest import manifest_faults, write_manifest
from inflight.catalog.stores import open_store
from inflight.errors import ContentError, IntegrityError
from inflight.time import TT2000_FILL, day_bounds

DAYS = days_from("2005-12-30", 3)  # the second one ends with a leap second


def written(workspace, days, **options):
    segment = write_segment(workspace, "run", "l1/fgm", days, **options)
    return segment, open_store(str(workspace / segment.path))


def day_back(store, segment, index):
    row = segment.rows[index]
    return store.dataset_of_day(index, list(store.variables), row.start, row.stop)


@pytest.mark.parametrize("portable", [False, True])
def test_days_come_back_identical_with_attributes_and_coordinates(tmp_path, portable):
    data = [DayData(day, samples(day, step_s=60 * (1 + index))) for index, day in enumerate(DAYS)]
    segment, store = written(tmp_path, data, portable=portable)
    for index, item in enumerate(data):
        xr.testing.assert_identical(day_back(store, segment, index), item.dataset)


def in_the_first_layout(folder, target):
    """Write a store as versions before layout 2 did: a folder for each place, a chunk for each component."""
    new = zarr.open_group(folder, mode="r")
    described = {**new.attrs["inflight"], "layout": 1}
    old = zarr.create_group(target, attributes={**new.attrs, "inflight": described})
    for name, array in new.arrays():
        copied = old.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunks=array.chunks,
            filters=array.filters,
            compressors=array.compressors,
            fill_value=array.fill_value,
            attributes=dict(array.attrs),
            dimension_names=array.metadata.dimension_names,
        )
        copied[...] = array[...]
    zarr.consolidate_metadata(target)
    write_manifest(target)
    return open_store(str(target))


def test_days_of_the_first_layout_are_read_as_they_were(tmp_path):
    data = [DayData(day, samples(day, step_s=60 * (1 + index))) for index, day in enumerate(DAYS)]
    segment, store = written(tmp_path, data)
    old = in_the_first_layout(tmp_path / segment.path, tmp_path / "old")
    assert (tmp_path / "old" / "field" / "c" / "2" / "1").is_file()
    assert (old.variables["field"].in_file, store.variables["field"].in_file) == (1, 3)
    for index, item in enumerate(data):
        xr.testing.assert_identical(day_back(old, segment, index), item.dataset)


def test_a_layout_of_a_later_version_is_an_error_that_says_so(tmp_path):
    segment, _ = written(tmp_path, [DayData(DAYS[0], samples(DAYS[0]))])
    folder = tmp_path / segment.path
    text = (folder / "zarr.json").read_text().replace('"layout": 2', '"layout": 3')
    (folder / "zarr.json").write_text(text)
    (folder / "MANIFEST.sha256").unlink()
    write_manifest(folder)
    with pytest.raises(IntegrityError, match="layout 3, this version reads up to 2"):
        open_store(str(folder))


def test_the_components_of_a_vector_are_chunks_of_one_file(tmp_path):
    data = [DayData(day, samples(day)) for day in DAYS]
    segment, store = written(tmp_path, data)
    folder = tmp_path / segment.path
    assert sorted(path.name for path in (folder / "field").glob("c*")) == ["c.0.0", "c.1.0", "c.2.0"]
    plain = zarr.open_group(folder, mode="r")["field"]
    assert (plain.chunks, plain.shards) == ((store.chunk, 1), (store.chunk, 3))
    portable, _ = written(tmp_path, data, portable=True)
    assert len(list((tmp_path / portable.path / "field").glob("c*"))) == 9


def test_what_xarray_copies_of_a_store_is_what_is_in_it(tmp_path):
    """It hands the codecs on: those of Zarr have to undo what they do."""
    segment, _ = written(tmp_path, [DayData(day, samples(day)) for day in DAYS])
    with xr.open_zarr(tmp_path / segment.path, consolidated=True, zarr_format=3) as opened:
        whole = opened.load()
        whole.to_zarr(tmp_path / "copy", zarr_format=3)
    with xr.open_zarr(tmp_path / "copy", zarr_format=3) as copied:
        xr.testing.assert_equal(copied.load(), whole)
    assert len(list((tmp_path / "copy" / "field").rglob("c*"))) > 0


def test_days_of_a_small_array_are_one_chunk_where_it_is_made_again(tmp_path):
    data = [DayData(day, samples(day, step_s=600 * (1 + index))) for index, day in enumerate(DAYS)]
    segment, store = written(tmp_path, data, quick=True)
    folder = tmp_path / segment.path
    assert [path.name for path in (folder / "field").glob("c*")] == ["c.0.0"]
    for index, item in enumerate(data):
        xr.testing.assert_identical(day_back(store, segment, index), item.dataset)
    (folder / "field" / "c.0.0").write_bytes(b"")
    with pytest.raises(IntegrityError, match="chunk cannot be read") as caught:
        day_back(store, segment, 1)
    assert caught.value.day == str(DAYS[1])


def test_days_of_a_large_array_are_chunks_of_their_own(tmp_path, monkeypatch):
    data = [DayData(day, samples(day)) for day in DAYS]
    monkeypatch.setattr(segments, "SMALL_ARRAY", 3 * 145 * 8)
    segment, store = written(tmp_path, data, quick=True)
    chunks = {name: len(list((tmp_path / segment.path / name).glob("c*"))) for name in store.variables}
    assert (chunks["tt2000"], chunks["temperature"], chunks["field"]) == (1, 1, 3)
    xr.testing.assert_identical(day_back(store, segment, 1), data[1].dataset)


def test_each_day_is_one_chunk_of_the_longest_days_length_and_the_rest_is_fill(tmp_path):
    data = [
        DayData(day, samples(day, step_s=step)) for day, step in zip(DAYS, (3600, 1800, 7200), strict=True)
    ]
    segment, _ = written(tmp_path, data)
    group = zarr.open_group(tmp_path / segment.path, mode="r")
    assert group["tt2000"].chunks == (49,)  # 48 half hours and the leap second's own sample
    assert [(row.start, row.stop) for row in segment.rows] == [(0, 24), (49, 98), (98, 110)]
    assert (group["tt2000"][24:49] == TT2000_FILL).all()
    assert (group["field"][24:49] == np.iinfo(np.int32).min).all()
    assert np.isnan(group["temperature"][24:49]).all()


def test_rows_tell_day_times_count_and_spacing(tmp_path):
    data = [DayData(DAYS[1], samples(DAYS[1]), "key", ("file:1",), {"coverage": 0.5})]
    segment, _ = written(tmp_path, data)
    (row,) = segment.rows
    times = data[0].dataset["tt2000"].values
    assert (row.day, row.key, row.count, row.step_ns) == (DAYS[1], "key", 145, 600 * 10**9)
    assert (row.first_tt2000, row.last_tt2000) == (times[0], times[-1])
    assert row.parents == ("file:1",)
    assert row.report == {"coverage": 0.5}
    assert pickle.loads(pickle.dumps(segment)) == segment


def test_coverage_follows_from_the_cadence_when_the_report_has_none(tmp_path):
    dataset = samples(DAYS[0]).isel(time=slice(0, 72)).assign_attrs(cadence_ns=600 * 10**9)
    segment, _ = written(tmp_path, [DayData(DAYS[0], dataset)])
    assert segment.rows[0].report["coverage"] == 0.5


def test_plain_zarr_and_xarray_read_the_same_values(tmp_path):
    data = [DayData(DAYS[0], samples(DAYS[0]))]
    segment, store = written(tmp_path, data, portable=True)
    opened = xr.open_zarr(tmp_path / segment.path, consolidated=True, zarr_format=3)
    field = data[0].dataset["field"].values
    np.testing.assert_allclose(opened["field"].values, field, rtol=1e-15, atol=0)
    np.testing.assert_array_equal(opened["tt2000"].values, data[0].dataset["tt2000"].values)
    codecs = json.loads((tmp_path / segment.path / "field" / "zarr.json").read_text())["codecs"]
    assert [codec["name"] for codec in codecs] == ["bytes", "blosc"]
    assert not any(variable.delta for variable in store.variables.values())


def test_equal_input_gives_equal_bytes_and_never_replaces_a_store(tmp_path):
    data = [DayData(day, samples(day)) for day in DAYS]
    one, other = (write_segment(tmp_path, "run", "l1/fgm", data) for _ in range(2))
    assert one.sha256 == other.sha256
    assert one.path != other.path
    assert unfinished_stores(tmp_path) == []


def test_values_off_the_resolution_are_stored_as_they_are_and_noted(tmp_path):
    dataset = samples(DAYS[0])
    dataset["field"][3, 0] = 0.0123
    segment, store = written(tmp_path, [DayData(DAYS[0], dataset)])
    assert "field" in segment.notes[0]
    assert "0.01" in segment.notes[0]
    xr.testing.assert_identical(day_back(store, segment, 0), dataset)


@given(
    quanta=hnp.arrays(np.int64, st.integers(1, 50), elements=st.integers(-(2**40), 2**40)),
    resolution=st.sampled_from([1e-4, 0.001, 0.01, 0.1, 0.25, 0.3, 1.0, 2.5, 7.0, 1 / 3]),
    missing=st.data(),
)
def test_packing_returns_every_multiple_of_the_resolution(quanta, resolution, missing):
    steps = round(1 / resolution)
    decimal = resolution <= 1 and abs(steps * resolution - 1) < 1e-12
    values = quanta / steps if decimal else quanta * resolution
    gaps = missing.draw(hnp.arrays(bool, values.shape))
    values[gaps] = np.nan
    encoding, stored = encode("x", [values], {"resolution": resolution})
    assert encoding.kind == "packed"
    assert encoding.stored == ("int32" if np.abs(quanta[~gaps]).max(initial=0) < 2**31 - 1 else "int64")
    np.testing.assert_array_equal(encoding.decode(stored[0]), values)


def test_the_largest_integer_of_four_bytes_is_stored_in_eight():
    encoding, stored = encode("x", [np.array([2147483.647, -2147483.646])], {"resolution": 0.001})
    assert (encoding.stored, stored[0].tolist()) == ("int64", [2147483647, -2147483646])


@given(hnp.arrays(st.sampled_from([np.float32, np.float64]), st.integers(1, 40)))
def test_any_float_survives_whatever_resolution_is_claimed(values):
    encoding, stored = encode("x", [values], {"resolution": 0.01})
    back = encoding.decode(stored[0])
    assert back.dtype == values.dtype
    np.testing.assert_allclose(back, values, rtol=1e-9, atol=0, equal_nan=True)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    counts=st.lists(st.integers(0, 30), min_size=1, max_size=4),
    dtype=st.sampled_from(["f4", "f8", "i2", "i8", "u1", "u4", "?", "U3", "c16", "datetime64[ns]"]),
    seed=st.integers(0, 99),
)
def test_variables_of_any_kind_and_days_of_any_length_come_back(tmp_path, counts, dtype, seed):
    rng = np.random.default_rng(seed)
    data = []
    for day, count in zip(days_from("2005-01-01", len(counts)), counts, strict=True):
        values = rng.integers(0, 2, (count, 2)).astype("i8").astype(dtype)
        times = day_bounds(day)[0] + np.sort(rng.choice(86400, count, replace=False)).astype(np.int64) * 10**9
        data.append(DayData(day, xr.Dataset({"tt2000": ("time", times), "x": (("time", "pair"), values)})))
    segment, store = written(tmp_path, data)
    for index, item in enumerate(data):
        np.testing.assert_array_equal(day_back(store, segment, index)["x"].values, item.dataset["x"].values)
        assert day_back(store, segment, index)["x"].dtype.kind == item.dataset["x"].dtype.kind
    shutil.rmtree(tmp_path / segment.path)


def test_blocks_of_normal_equations_are_stored_by_day(tmp_path):
    data = []
    for index, day in enumerate(DAYS):
        start, end = day_bounds(day)
        edges = np.linspace(start, end, index + 2).astype(np.int64)
        data.append(
            DayData(
                day,
                xr.Dataset(
                    {
                        "gram": (
                            ("block", "column", "other"),
                            np.random.default_rng(index).normal(size=(index + 1, 4, 4)),
                        ),
                        "start": ("block", edges[:-1]),
                        "end": ("block", edges[1:]),
                        "scale": ("column", np.arange(4.0)),
                    },
                    coords={"column": list("abcd"), "other": list("abcd")},
                ),
            )
        )
    segment, store = written(tmp_path, data)
    for index, item in enumerate(data):
        xr.testing.assert_identical(day_back(store, segment, index), item.dataset)


def test_blocks_of_no_columns_come_back_and_are_no_files(tmp_path):
    start, end = day_bounds(DAYS[0])
    nothing = xr.Dataset(
        {
            "estimate": (("block", "column"), np.empty((1, 0))),
            "start": ("block", [start]),
            "end": ("block", [end]),
        }
    )
    segment, store = written(tmp_path, [DayData(DAYS[0], nothing)])
    xr.testing.assert_identical(day_back(store, segment, 0), nothing)
    assert not list((tmp_path / segment.path / "estimate").glob("c*"))


def test_tables_come_back_identical(tmp_path):
    segment = write_table(tmp_path, "run", "tables/offsets", table())
    store = open_store(str(tmp_path / segment.path))
    xr.testing.assert_identical(store.dataset_of_day(0, list(store.variables), 0, 0), table())


def wrong(change):
    dataset = samples(DAYS[0])
    return [DayData(DAYS[0], change(dataset))]


def unsorted(dataset):
    return dataset.isel(time=slice(None, None, -1))


def shifted(dataset):
    return dataset.assign(tt2000=dataset["tt2000"] + 3600 * 10**9)


def with_object_attribute(dataset):
    dataset["field"].attrs["maker"] = object()
    return dataset


@pytest.mark.parametrize(
    ("days", "told"),
    [
        ([], "at least one day"),
        (wrong(unsorted), "does not increase"),
        (wrong(shifted), "6 of 144 samples lie outside"),
        (wrong(lambda dataset: dataset.drop_vars("tt2000")), "'tt2000'"),
        (wrong(lambda dataset: dataset.transpose("axis", "other", "time")), "'time' first"),
        (wrong(lambda dataset: dataset.isel(time=0)), "expected one of"),
        (wrong(with_object_attribute), "variable 'field'"),
        (wrong(lambda dataset: dataset.rename(flag="../flag")), "no name of a variable"),
        ([DayData(DAYS[0], samples(DAYS[0]))] * 2, "twice"),
        (
            [DayData(DAYS[0], samples(DAYS[0])), DayData(DAYS[1], samples(DAYS[1]).drop_vars("flag"))],
            "'flag'",
        ),
        (
            [
                DayData(DAYS[0], samples(DAYS[0])),
                DayData(DAYS[1], samples(DAYS[1]).assign(rotation=(("axis", "other"), np.ones((3, 3))))),
            ],
            "differs between days",
        ),
    ],
)
def test_days_that_make_no_segment_are_refused_and_leave_nothing(tmp_path, days, told):
    with pytest.raises(ContentError, match=told):
        write_segment(tmp_path, "run", "l1/fgm", days)
    assert not list(tmp_path.rglob("*.zarr"))
    assert not list(tmp_path.rglob("zarr.json"))


def test_units_may_not_change_inside_a_segment_but_other_attributes_may(tmp_path):
    one, other = samples(DAYS[0]), samples(DAYS[1])
    other["field"].attrs["source"] = "spare sensor"
    other.attrs["mission"] = "another"
    segment, store = written(tmp_path, [DayData(DAYS[0], one), DayData(DAYS[1], other)])
    xr.testing.assert_identical(day_back(store, segment, 0), one)
    xr.testing.assert_identical(day_back(store, segment, 1), other)
    other["field"].attrs["units"] = "uT"
    with pytest.raises(ContentError, match="units"):
        written(tmp_path, [DayData(DAYS[0], one), DayData(DAYS[1], other)])


@pytest.mark.parametrize("name", ["", "../l1", "l1//fgm", "l1/f m", "/l1"])
def test_dataset_names_that_could_leave_the_workspace_are_refused(tmp_path, name):
    with pytest.raises(ContentError, match="no dataset name"):
        write_segment(tmp_path, "run", name, [DayData(DAYS[0], samples(DAYS[0]))])


def test_a_missing_or_cut_chunk_is_an_error_and_not_fill(tmp_path):
    segment, store = written(tmp_path, [DayData(day, samples(day)) for day in DAYS])
    chunk = tmp_path / segment.path / "temperature" / "c.1"
    whole = chunk.read_bytes()
    chunk.unlink()
    with pytest.raises(IntegrityError, match="temperature"):
        day_back(store, segment, 1)
    chunk.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(IntegrityError, match="temperature"):
        day_back(store, segment, 1)
    day_back(store, segment, 0)


def test_the_manifest_finds_changed_missing_and_added_files(tmp_path):
    segment, _ = written(tmp_path, [DayData(day, samples(day)) for day in DAYS])
    folder = tmp_path / segment.path
    assert manifest_faults(folder, segment.sha256) == []
    chunk = folder / "flag" / "c.0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\x00\x01")
    (folder / "flag" / "c.1").unlink()
    (folder / "extra").write_text("")
    faults = dict(manifest_faults(folder, segment.sha256))
    assert sorted(faults) == ["extra", "flag/c.0", "flag/c.1"]
    assert manifest_faults(folder, "0" * 64)[0][0] == "MANIFEST.sha256"


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda found, name: found | {name: (found[name][0], np.zeros_like(found[name][1]))}, "an array"),
        (lambda found, name: found | {name: ({}, found[name][1])}, "attributes"),
        (lambda found, name: {key: value for key, value in found.items() if key != name}, "variables"),
    ],
)
def test_what_reads_back_differently_is_not_made_visible(tmp_path, monkeypatch, spoil, told):
    honest = segments.read_with_zarr
    monkeypatch.setattr(segments, "read_with_zarr", lambda *given: spoil(honest(*given), "field"))
    with pytest.raises(IntegrityError, match=f"{told} reads? back differently"):
        write_segment(tmp_path, "run", "l1/fgm", [DayData(DAYS[0], samples(DAYS[0]))])
    assert not any((tmp_path / "stores").iterdir())
