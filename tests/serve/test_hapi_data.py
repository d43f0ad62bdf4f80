"""What a client of HAPI reads is what the catalog opens."""

import gzip
import itertools

import numpy as np
import pytest
from serve_cases import DAYS, ID, SPAN, from_binary, from_csv, samples, split_header

from inflight.catalog import Catalog
from inflight.serve.times import parse_time
from inflight.time import day_bounds, in_leap_second, to_utc


@pytest.fixture(scope="module")
def opened(workspace):
    """What the catalog opens of the release; variables that are not on all days, one by one."""
    return (
        Catalog(workspace)
        .open(
            "l2/field",
            release="1.0",
            variables=[name for name in samples(DAYS[0]).data_vars if name != "step"],
        )
        .compute()
    )


def expected(opened, name):
    values = opened[name].values
    if name == "flag":
        return values.view(np.int32)
    return np.char.encode(values, "utf-8") if name == "mode" else values


@pytest.mark.parametrize("form", ["csv", "binary"])
def test_records_are_what_the_catalog_opens(ask, opened, form):
    info = ask("info").json()
    answer = ask("data", **SPAN, format=form)
    assert answer.status_code == 200
    records = from_binary(answer.content, info) if form == "binary" else from_csv(answer.text, info)
    assert records.size == opened.sizes["time"] > 600
    for name in (
        "field_nec",
        "field_sensor",
        "uncertainty",
        "flag",
        "mode",
        "counter",
        "small",
        "tensor",
        "temperature",
    ):
        np.testing.assert_array_equal(records[name], expected(opened, name), err_msg=name)
    labels = np.char.add(np.datetime_as_string(to_utc(opened["tt2000"].values)), "Z").astype("S")
    leaping = in_leap_second(opened["tt2000"].values)
    assert leaping.sum() == 2
    np.testing.assert_array_equal(records["Time"][~leaping], labels[~leaping])
    assert records["Time"][leaping].tolist() == [
        b"2005-12-31T23:59:60.000000000Z",
        b"2005-12-31T23:59:60.500000000Z",
    ]
    assert (records["Time"][1:] > records["Time"][:-1]).all()


def test_what_is_not_on_all_days_is_fill_on_the_others(ask, opened):
    info = ask("info").json()
    fills = {item["name"]: item["fill"] for item in info["parameters"]}
    assert (fills["correction_heater"], fills["step"], fills["flag"]) == ("NaN", "-2147483648", None)
    early = opened["tt2000"].values < day_bounds(DAYS[2])[0]
    for form, read in (
        ("binary", lambda a: from_binary(a.content, info)),
        ("csv", lambda a: from_csv(a.text, info)),
    ):
        records = read(ask("data", **SPAN, format=form))
        np.testing.assert_array_equal(np.isnan(records["correction_heater"]), early)
        np.testing.assert_array_equal(records["correction_heater"][~early], opened["temperature"][~early])
        np.testing.assert_array_equal(records["step"] == -(2**31), ~early)
        assert records["step"][0] == -50


def test_csv_has_nan_as_the_fill_says_and_texts_quoted_where_they_must_be(ask):
    lines = ask("data", **SPAN, parameters="field_nec,mode").text.splitlines()
    assert lines[0].split(",")[2] == "NaN"
    assert lines[1].endswith(',"a, ""quoted"" one"')
    assert lines[2].endswith(",nan")
    numbers = ask("data", **SPAN, parameters="field_nec").text
    assert numbers.splitlines()[0].split(",")[2] == "NaN"
    assert "nan" not in numbers
    assert numbers.endswith("\n")
    assert not numbers.endswith("\n\n")


@pytest.mark.parametrize(
    ("asked", "columns"),
    [
        ("", None),
        ("Time", ["Time"]),
        ("flag", ["Time", "flag"]),
        ("Time,field_nec,temperature", ["Time", "field_nec", "temperature"]),
    ],
)
def test_parameters_are_a_subset_in_order_with_the_time_first(ask, asked, columns):
    whole = from_binary(ask("data", **SPAN, format="binary").content, ask("info").json())
    info = ask("info", parameters=asked).json()
    assert columns is None or [item["name"] for item in info["parameters"]] == columns
    part = from_binary(ask("data", **SPAN, parameters=asked, format="binary").content, info)
    for name in part.dtype.names:
        np.testing.assert_array_equal(part[name], whole[name])


@pytest.mark.parametrize("form", ["csv", "binary"])
def test_the_header_is_info_with_the_format_and_the_data_follow(ask, form):
    query = {**SPAN, "parameters": "flag", "format": form}
    header, rest = split_header(ask("data", **query, include="header").content)
    assert header.pop("format") == form
    assert header == ask("info", parameters="flag").json()
    assert rest == ask("data", **query).content


@pytest.mark.parametrize(
    ("start", "stop"),
    [
        ("2005-12-30", "2005-12-31"),
        ("2005-364T12:00Z", "2005-365T06:30:00.5Z"),
        ("2005-12-31T23:59:58Z", "2006-01-01T00:10Z"),
        ("2005-12-31T23:59:60Z", "2006-01Z"),
        ("2005-12-31T23:59:60.25Z", "2005-12-31T23:59:60.75Z"),
        ("2005-12-30T24:00Z", "2006-01-03T24:00:00Z"),
        ("2005-12-31T23:59:59.500000001Z", "2005-12-31T23:59:60.0000000001Z"),
    ],
)
def test_a_span_is_cut_exactly_and_half_open(ask, opened, start, stop):
    low, high = parse_time(start), parse_time(stop)
    chosen = (opened["tt2000"].values >= low) & (opened["tt2000"].values < high)
    info = ask("info", parameters="field_nec").json()
    answer = ask("data", start=start, stop=stop, parameters="field_nec", format="binary")
    records = from_binary(answer.content, info)
    assert chosen.any()
    np.testing.assert_array_equal(records["field_nec"], opened["field_nec"].values[chosen])


def test_neighbouring_spans_join_to_the_whole(ask):
    ends = [
        "2005-12-30",
        "2005-12-30T07",
        "2005-12-31T23:59:60.2",
        "2006-01-02",
        "2006-01-03T01",
        "2006-01-04",
    ]
    parts = [ask("data", start=a, stop=b).text for a, b in itertools.pairwise(ends)]
    assert all(part for part in parts[:3])
    assert "".join(parts) == ask("data", **SPAN).text


def test_the_names_of_hapi_2_are_taken(client, ask):
    query = {"id": ID, "time.min": SPAN["start"], "time.max": SPAN["stop"]}
    assert client.get("/hapi/data", query).text == ask("data", **SPAN).text
    assert client.get("/hapi/info", params={"id": ID}).json() == ask("info").json()


def test_no_data_is_told_by_code_and_an_empty_body(ask):
    span = {"start": "2006-01-02", "stop": "2006-01-03"}
    assert ask("data", **span).content == b""
    header, rest = split_header(ask("data", **span, include="header").content)
    assert header["status"] == {"code": 1201, "message": "OK - no data for time range"}
    assert rest == b""


def test_a_client_that_unpacks_gets_packed_data(client):
    query = {"dataset": ID, **SPAN}
    plain = client.get("/hapi/data", query)
    assert "content-encoding" not in plain.headers
    packed = client.get("/hapi/data", query, headers={"Accept-Encoding": "gzip, deflate"})
    assert packed.headers["content-encoding"] == "gzip"
    assert len(packed.content) < 0.6 * len(plain.content)
    assert gzip.decompress(packed.content) == plain.content


@pytest.fixture
def reads(monkeypatch):
    """What catalogs read from now on: (day, variable)."""
    told, real = [], Catalog.read_variable

    def read_variable(catalog, day, name):
        told.append((str(day.day), name))
        return real(catalog, day, name)

    monkeypatch.setattr(Catalog, "read_variable", read_variable)
    return told


def test_days_are_read_one_at_a_time_as_they_are_sent(client, reads):
    query, seen = {"dataset": ID, **SPAN}, []
    client.get("/hapi/info", {"dataset": ID})
    reads.clear()

    def note(body):
        seen.append((body[:10].decode(), sorted({day for day, _ in reads})))

    assert client.get("/hapi/data", query, on_body=note).status_code == 200
    days = [str(day) for day in DAYS]
    # When a part is sent, nothing of a later day was read.
    assert seen == [(day, days[: index + 1]) for index, day in enumerate(days)]


def test_only_days_and_variables_asked_for_are_read(client, ask, reads):
    ask("info")
    reads.clear()
    ask("data", start="2005-12-31T01Z", stop="2005-12-31T02Z", parameters="flag")
    assert reads == [("2005-12-31", "tt2000"), ("2005-12-31", "flag")]


def test_a_day_of_many_samples_is_sent_in_parts(client, ask, monkeypatch):
    query = {"dataset": ID, **SPAN, "parameters": "field_nec,temperature"}
    whole = client.get("/hapi/data", query).content
    monkeypatch.setattr("inflight.serve.datasets.CELLS_PER_BLOCK", 70)
    parts = []
    assert client.get("/hapi/data", query, on_body=parts.append).content == whole
    assert max(part.count(b"\n") for part in parts) == 70 // 5


def test_head_tells_the_same_and_reads_nothing(client, reads):
    query = {"dataset": ID, **SPAN}
    got = client.get("/hapi/data", query)
    reads.clear()
    head = client.head("/hapi/data", query)
    assert (head.status_code, head.headers) == (200, got.headers)
    assert reads == []
    assert client.head("/hapi/data", {**query, "stop": "nonsense"}).status_code == 400
    for endpoint in ("about", "capabilities", "catalog"):
        assert client.head(f"/hapi/{endpoint}").headers == client.get(f"/hapi/{endpoint}").headers


def test_the_bits_of_a_word_are_told_apart(ask):
    flag = next(item for item in ask("info").json()["parameters"] if item["name"] == "flag")
    meanings = dict(zip(flag["x_flag_masks"], flag["x_flag_meanings"], strict=True))
    assert (meanings[1], meanings[8]) == ("vector_missing", "leap_second")
    assert flag["units"] is None
