import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inflight.catalog.readers import NameSpan, find_files, parse_name
from inflight.instruments import Files
from inflight.time import day_bounds


def files(*patterns: str) -> Files:
    return Files(pattern=list(patterns), reader="cdf", time="Epoch")


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


@pytest.mark.parametrize(
    ("pattern", "name", "first", "last"),
    [
        ("a/b_{day:%Y%m%d}_v*.cdf", "a/b_20240229_v02.cdf", "2024-02-29", "2024-03-01"),
        ("didd/{day:%b%d%y}.WIK", "didd/SEP0111.WIK", "2011-09-01", "2011-09-02"),
        ("didd/{day:%b%d%y}.WIK", "DIDD/sep3011.wik", "2011-09-30", "2011-10-01"),
        ("t_{end:%d.%m.%Y}.txt", "t_7.03.2012.txt", None, "2012-03-08"),
        ("m_{start:%Y%j}.nc", "m_2024366.nc", "2024-12-31", None),
        ("{day:%Y}/{day:%m}/x_{day:%Y%m%d}.cdf", "2024/05/x_20240511.cdf", "2024-05-11", "2024-05-12"),
        ("x_{start:%Y%m%d}_{end:%Y%m%d}.cdf", "x_20240509_20240512.cdf", "2024-05-09", "2024-05-13"),
    ],
)
def test_names_tell_their_span(pattern, name, first, last):
    span = parse_name(name, files(pattern)).span
    assert span.start == (None if first is None else day_bounds(first)[0])
    assert span.end == (None if last is None else day_bounds(last)[0])


def test_a_time_of_day_in_a_name_ends_with_its_own_second():
    span = parse_name("s20170414T192400Z.nc", files("s{start:%Y%m%dT%H%M%S}Z.nc")).span
    assert span.start == day_bounds("2017-04-14")[0] + (19 * 3600 + 24 * 60) * 10**9
    span = parse_name("e20170414T192459Z.nc", files("e{end:%Y%m%dT%H%M%S}Z.nc")).span
    assert span.end == day_bounds("2017-04-14")[0] + (19 * 3600 + 25 * 60) * 10**9


@pytest.mark.parametrize(
    "name", ["b_20230231.cdf", "b_2023013.cdf", "b_20230101.cdf.tmp", "c/b_20230101.cdf"]
)
def test_names_that_are_no_date_or_elsewhere_do_not_match(name):
    assert parse_name(name, files("b_{day:%Y%m%d}.cdf")) is None


def test_contradicting_dates_in_one_name_do_not_match():
    assert parse_name("2023/x_20240511.cdf", files("{day:%Y}/x_{day:%Y%m%d}.cdf")) is None


def test_the_last_version_in_natural_order_wins_and_the_others_are_reported(tmp_path):
    touch(tmp_path, "f_20200101_v9.cdf", "f_20200101_v10.cdf", "f_20200101_v2.cdf", "f_20200102_v1.cdf")
    found, superseded = find_files(tmp_path, files("f_{day:%Y%m%d}_v*.cdf"))
    assert [file.name for file in found] == ["f_20200101_v10.cdf", "f_20200102_v1.cdf"]
    assert superseded == {
        "f_20200101_v9.cdf": "f_20200101_v10.cdf",
        "f_20200101_v2.cdf": "f_20200101_v10.cdf",
    }


def test_files_without_a_date_never_supersede_each_other(tmp_path):
    touch(tmp_path, "part_a.npz", "part_b.npz")
    found, superseded = find_files(tmp_path, files("part_*.npz"))
    assert len(found) == 2
    assert not superseded


def test_several_patterns_and_folders_are_found_in_order_of_time(tmp_path):
    touch(tmp_path, "late/x_20200105.cdf", "y_20200103.cdf", "late/deep/x_20200101.cdf", "z.txt")
    found, _ = find_files(tmp_path, files("**/x_{day:%Y%m%d}.cdf", "y_{day:%Y%m%d}.cdf"))
    assert [file.name for file in found] == [
        "late/deep/x_20200101.cdf",
        "y_20200103.cdf",
        "late/x_20200105.cdf",
    ]


def test_an_absent_folder_holds_no_files(tmp_path):
    assert find_files(tmp_path, files("nowhere/x_{day:%Y%m%d}.cdf")) == ([], {})


@given(st.dates(min_value=np.datetime64("1972-01-02").item(), max_value=np.datetime64("2068-12-31").item()))
@pytest.mark.parametrize("layout", ["%Y%m%d", "%b%d%y", "%Y_%j", "%d.%m.%Y"])
def test_a_day_written_into_a_name_is_read_back(layout, day):
    if layout == "%b%d%y" and not 1972 <= day.year <= 2068:
        return
    span = parse_name(f"x{day.strftime(layout)}.cdf", files(f"x{{day:{layout}}}.cdf")).span
    assert span == NameSpan(*day_bounds(day))


def test_parts_of_one_day_are_all_used_and_only_versions_supersede(tmp_path):
    for name in ("f_20240507_part1_v1.cdf", "f_20240507_part2_v1.cdf", "f_20240507_part2_v2.cdf"):
        (tmp_path / name).touch()
    found, superseded = find_files(tmp_path, files("f_{day:%Y%m%d}_*_v*.cdf"))
    assert [one.name for one in found] == ["f_20240507_part1_v1.cdf", "f_20240507_part2_v2.cdf"]
    assert superseded == {"f_20240507_part2_v1.cdf": "f_20240507_part2_v2.cdf"}


@pytest.mark.parametrize(
    "pattern", ["f_{day:%Y%m%d}*.cdf", "f_{day:%Y%m%d}T??.cdf", "f_{day:%Y%m%d}_hour*.cdf"]
)
def test_a_wildcard_that_is_no_version_never_hides_a_file(tmp_path, pattern):
    for hour in ("T00", "T01", "_hour00", "_hour01"):
        (tmp_path / f"f_20240507{hour}.cdf").touch()
    found, superseded = find_files(tmp_path, files(pattern))
    assert len(found) in (2, 4)
    assert not superseded
