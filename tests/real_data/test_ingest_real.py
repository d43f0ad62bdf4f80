"""Every real set comes in through its YAML alone and equals an independent reading of its files."""

import gzip
import os
from pathlib import Path

import cdflib
import h5py
import numpy as np
import pytest
import scipy.io

from inflight.catalog import Catalog
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.tasks.archive import ingest

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
FOLDERS = {
    "conrad": "conrad-wic-storm-may2024",
    "usgs-bou": "usgs-bou-201601",
    "ace": "ace-mfi-h0-20230102",
    "mms1": "mms1-fgm-srvy-20190601",
    "magnav-tl": "magnav-tl",
    "goes16": "goes16-mag-ib-ob",
    "goes16-l2": "goes16-mag-ib-ob",
    "wik-cobenzl": "wik-cobenzl-2011",
}
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not REAL.is_dir(), reason=f"the folder of real measurements {REAL} is absent"),
]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Return a function that ingests a mission once and gives (catalog, report, data folder)."""
    done = {}

    def take(name, instruments=None):
        if name not in done:
            mission = Mission.parse((ROOT / "missions" / f"{name}.yaml").read_text(encoding="utf-8"), name)
            cat = Catalog(tmp_path_factory.mktemp(name))
            data = REAL / FOLDERS[name]
            done[name] = (cat, ingest(cat, mission, data, instruments), data)
        return done[name]

    return take


def opened(cat, name):
    return cat.open(f"l1/{name}").load()


def stamps(dataset):
    return [str(stamp)[:23] for stamp in dataset.time.values[[0, -1]]]


@pytest.mark.parametrize("name", [name for name in FOLDERS if name != "wik-cobenzl"])
def test_whole_set_comes_in_without_a_problem_and_only_once(taken, name):
    cat, report, data = taken(name)
    assert report.problems == []
    assert report.days["done"] == report.days["planned"] > 0
    mission = Mission.parse((ROOT / "missions" / f"{name}.yaml").read_text(encoding="utf-8"), name)
    again = ingest(cat, mission, data)
    assert again.run == ""
    assert again.days["unchanged"] == report.days["planned"]
    assert cat.verify() == []


def test_conrad(taken):
    cat, _, data = taken("conrad")
    vector, scalar = opened(cat, "lemi"), opened(cat, "gp20s3")
    cdf = cdflib.CDF(data / "wic_lemi036_gp20s3_1s_20240509_20240512.cdf")
    np.testing.assert_array_equal(vector.tt2000, cdf.varget("DataTimes"))
    for index, element in enumerate("HEZ"):
        np.testing.assert_array_equal(vector.field[:, index], cdf.varget(f"GeomagneticField{element}"))
    np.testing.assert_array_equal(scalar.field, cdf.varget("GeomagneticFieldS"))
    np.testing.assert_array_equal(vector.sensor_temperature, cdf.varget("Temperature1"))
    assert stamps(vector) == ["2024-05-09T00:00:00.000", "2024-05-12T23:59:59.000"]
    assert int(np.isnan(scalar.field).sum()) == 2
    assert (scalar.flag.values[np.isnan(scalar.field)] == Flag.SCALAR_MISSING).all()
    difference = np.linalg.norm(vector.field, axis=1) - scalar.field.values
    assert abs(np.nanmean(difference) - 11.72) < 0.005


def test_usgs_bou(taken):
    cat, _, data = taken("usgs-bou")
    for name, total, suffix in (
        ("variation", "total_field", "vmin"),
        ("adjusted", "adjusted_total_field", "adj"),
    ):
        with gzip.open(data / f"BOU201601{suffix}.min.gz", "rt") as stream:
            rows = [line.split() for line in stream if line.startswith("2016-")]
        vector, scalar = opened(cat, name), opened(cat, total)
        values = np.array([[float(number) for number in row[3:]] for row in rows])
        values[np.isin(values, (99999.0, 88888.0))] = np.nan
        np.testing.assert_array_equal(vector.field, values[:, :3])
        np.testing.assert_array_equal(scalar.field, values[:, 3])
        assert [str(stamp)[:16] for stamp in vector.time.values] == [f"{row[0]}T{row[1][:5]}" for row in rows]
    assert vector.field.attrs["resolution"] == 0.01
    raw = np.linalg.norm(opened(cat, "variation").field, axis=1) - opened(cat, "total_field").field.values
    assert -550 < np.nanmedian(raw) < -530


def test_ace_with_r_variables_and_epoch(taken):
    cat, _, data = taken("ace")
    vector = opened(cat, "mag")
    cdf = cdflib.CDF(data / "ac_h0_mfi_20230102_v07.cdf")
    np.testing.assert_array_equal(vector.field, cdf.varget("BGSEc"))
    assert vector.field.dtype == np.float32
    assert vector.sizes["time"] == 5400
    expected = cdflib.cdfepoch.to_datetime(cdf.varget("Epoch")).astype("datetime64[ns]")
    np.testing.assert_array_equal(vector.time, expected)
    assert (vector.flag == 0).all()
    np.testing.assert_array_equal(opened(cat, "orbit").position, cdf.varget("SC_pos_GSE"))


def test_mms1(taken):
    cat, _, data = taken("mms1")
    vector = opened(cat, "fgm")
    with np.load(next(data.glob("*.npz"))) as archive:
        np.testing.assert_array_equal(vector.field, archive["B_GSM_nT"])
        exact = np.array([int(second * 2**32) * 10**9 // 2**32 for second in archive["unix_time_s"][:200]])
    assert np.abs(vector.time.values[:200].astype("datetime64[ns]").astype(np.int64) - exact).max() <= 1
    assert vector.sizes["time"] == 115199
    assert len(cat.days("l1/fgm")) == 2


def test_magnav(taken):
    cat, _, data = taken("magnav-tl")
    held = scipy.io.loadmat(data / "test_data_TL.mat")["TL_data"][0, 0]
    vector, scalar = opened(cat, "flux_a"), opened(cat, "mag_1")
    expected = np.hstack([held[f"flux_a_{axis}"] for axis in "xyz"])
    np.testing.assert_array_equal(vector.field, expected)
    np.testing.assert_array_equal(scalar.field, held["mag_1_uc"][:, 0])
    assert np.unique(np.diff(vector.tt2000)).tolist() == [100_000_000]


def test_goes16_level_1b(taken):
    cat, _, data = taken("goes16")
    inboard, outboard, power = opened(cat, "inboard"), opened(cat, "outboard"), opened(cat, "housekeeping")
    with h5py.File(next(data.glob("OR_MAG*.nc"))) as file:
        order = np.argsort(file["IB_time"][...].ravel(), kind="stable")
        np.testing.assert_array_equal(inboard.field, file["IB_data"][...].reshape(-1, 3)[order])
        np.testing.assert_array_equal(outboard.field, file["OB_data"][...].reshape(-1, 3)[order])
        reports = np.argsort(file["IB_time"][:, 0], kind="stable")
        for group in range(4):
            np.testing.assert_array_equal(
                power[f"solar_array_current_{group + 1}"], file["solar_array_current"][...][reports, group]
            )
        positions = np.stack([file[f"ECEF_{axis}"][...] for axis in "XYZ"], axis=1)[reports]
        seconds = file["IB_time"][...].ravel()[order]
    np.testing.assert_array_equal(opened(cat, "orbit").position, positions)
    assert stamps(inboard) == ["2017-02-12T14:59:59.900", "2017-02-12T15:59:59.800"]
    assert inboard.sizes["time"] == 36000
    label = (inboard.time.values - np.datetime64("2000-01-01T12:00:00")) / np.timedelta64(1, "s")
    assert np.abs(label - seconds).max() < 1e-6
    quaternion = opened(cat, "attitude").quaternion.values
    assert quaternion.shape == (3598, 4)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-6)
    day = cat.current("l1/inboard", "2017-02-12")
    assert day.report["unsorted"] == 99


def test_goes16_orientations_bring_both_sensors_into_one_frame(taken):
    from scipy.spatial.transform import Rotation

    cat, *_ = taken("goes16")
    mission = Mission.parse((ROOT / "missions" / "goes16.yaml").read_text(encoding="utf-8"))
    product = opened(cat, "product").field.values.astype(float)
    turned = [
        Rotation.from_quat(mission.instruments[name].orientation).apply(
            opened(cat, name).field.values.astype(float)
        )
        for name in ("inboard", "outboard")
    ]
    k = 1.0729
    residual = product - ((1 + k) * turned[1] - k * turned[0])
    means = residual[: len(residual) // 20 * 20].reshape(-1, 20, 3).mean(axis=1)
    assert np.sqrt(np.mean((means - means.mean(axis=0)) ** 2)) < 0.02
    assert np.abs(means.mean(axis=0)).max() < 0.1


def test_goes16_level_2_minutes(taken):
    cat, report, data = taken("goes16-l2")
    rows = []
    for path in sorted(data.glob("d?_magn*.nc")):
        with h5py.File(path) as file:
            rows.append(np.column_stack([file["time_ib"][...], file["b_ib_sensor"][...]]))
    expected = np.concatenate(rows)
    expected = expected[np.argsort(expected[:, 0], kind="stable")]
    inboard = opened(cat, "inboard")
    np.testing.assert_array_equal(inboard.field, expected[:, 1:])
    assert report.days["no_work"] == 3 * 39
    assert cat.current("l1/inboard", "2017-04-14").coverage < 0.01


@pytest.fixture(scope="module")
def wik(taken):
    return taken("wik-cobenzl", ["didd", "didd_total_field", "lemi025", "pmag", "vault"])


def test_wik_didd(wik):
    cat, report, data = wik
    assert report.problems == []
    vector, scalar = opened(cat, "didd"), opened(cat, "didd_total_field")
    lines = [
        line.split()
        for day in range(1, 31)
        for line in (data / "didd" / f"SEP{day:02d}11.WIK").read_text().splitlines()[1:]
    ]
    values = np.array([[float(number) for number in line[2:]] for line in lines])
    np.testing.assert_array_equal(vector.field, values[:, :3])
    np.testing.assert_array_equal(scalar.field, values[:, 3])
    assert vector.sizes["time"] == 43200
    assert stamps(vector) == ["2011-09-01T00:00:00.000", "2011-09-30T23:59:00.000"]


def test_wik_lemi_stamps_are_moved_to_the_minute(wik):
    cat, _, data = wik
    vector = opened(cat, "lemi025")
    first = (data / "lemi025" / "20110901v.min").read_text().splitlines()[13].split()
    assert first[:2] == ["2011-08-31", "23:59:47.000"]
    assert stamps(vector) == ["2011-09-01T00:00:00.000", "2011-09-30T23:59:00.000"]
    np.testing.assert_array_equal(vector.field[0], [float(number) for number in first[3:6]])


def test_wik_proton_magnetometer(wik):
    cat, _, data = wik
    scalar = opened(cat, "pmag")
    lines = [line for path in sorted((data / "pmag").glob("*.txt")) for line in path.read_text().splitlines()]
    assert scalar.sizes["time"] == len(lines) - 6
    excursion = cat.current("l1/pmag", "2011-09-02").report["dropped"]
    assert excursion == {"clock_excursion": 6}
    # The file of the 22nd begins with two rows of the 21st.
    twenty_first = cat.read_day("l1/pmag", "2011-09-21")
    assert [str(stamp)[11:19] for stamp in _utc(twenty_first)[-2:]] == ["23:59:47", "23:59:57"]
    np.testing.assert_array_equal(twenty_first.field[-2:], [48525.2, 48524.9])
    outside = int((scalar.flag.values & Flag.OUT_OF_RANGE != 0).sum())
    assert outside == sum(float(line.split()[1].replace(",", ".")) < 48400 for line in lines)


def _utc(dataset):
    from inflight.time import to_utc

    return to_utc(dataset.tt2000.values)


def test_wik_loggers_clock_keeps_time_and_the_instruments_does_not(wik):
    """What the mission YAML says of the two clocks: lag of the best fit to F of the dIdD, early and late."""
    cat, *_ = wik
    scalar, reference = opened(cat, "pmag"), opened(cat, "didd_total_field")
    seconds = scalar.tt2000.values / 1e9
    lags = []
    for part in (slice(0, 86400), slice(172800, None)):
        lags.append(_best_lag(seconds[part], scalar.field.values[part], reference))
    assert all(0 <= lag <= 10 for lag in lags)
    assert abs(lags[0] - lags[1]) <= 3


def _best_lag(seconds, values, reference):
    good = np.isfinite(values)
    seconds, values = seconds[good], values[good]
    minutes = reference.tt2000.values / 1e9
    inside = (minutes > seconds[0] + 60) & (minutes < seconds[-1] - 60)
    minutes, truth = minutes[inside], reference.field.values[inside]
    total = np.concatenate([[0.0], np.cumsum(values - 48500)])

    def misfit(lag):
        low, high = (np.searchsorted(seconds + lag, minutes + edge) for edge in (-30, 30))
        full = high - low >= 5
        step = np.diff((total[high] - total[low])[full] / (high - low)[full] - truth[full])
        return np.mean(np.clip(step, -3, 3) ** 2)

    return min(range(-60, 61, 2), key=misfit)


def test_wik_temperature_logger(wik):
    cat, _, data = wik
    vault = opened(cat, "vault")
    rows = [
        line.split(",")
        for path in (data / "temp").glob("Schacht*.txt")
        for line in path.read_text(encoding="latin-1").splitlines()[1:]
        if line
    ]
    assert vault.sizes["time"] == len(rows)
    expected = {row[1]: float(row[2]) for row in rows}
    shown = [
        f"{stamp[8:10]}/{stamp[5:7]}/{stamp[:4]} {stamp[11:19]}" for stamp in vault.time.values.astype(str)
    ]
    assert [expected[text] for text in shown] == vault.temperature.values.tolist()
