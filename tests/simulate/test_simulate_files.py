"""Delivered files: exact times, complete or absent, resumable, and no truth among them."""

import json
import time
import warnings

import cdflib
import numpy as np
import pytest
import xarray as xr

import inflight.tasks.archive.simulated_deliveries as simulated_days
from inflight.errors import CatalogError, StorageError
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.archive import simulate
from inflight.tasks.archive.simulated_deliveries import CHAMP, INSTRUMENTS
from inflight.time import as_day, day_bounds

SMALL = SimulationSettings(start="2005-01-03", days=2, cadence=10, hide=("day_night",))


@pytest.fixture(scope="module")
def delivered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("delivered")
    return folder, simulate(SMALL, folder, workers=1)


def hashes(folder):
    return {
        path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def test_every_instrument_and_day_has_its_file(delivered):
    folder, paths = delivered
    expected = [CHAMP.path(folder, name, day) for day in SMALL.day_list for name in INSTRUMENTS]
    assert paths == expected
    assert paths[0].relative_to(folder).as_posix() == "fgm/champ_fgm_20050103_v01.cdf"


def test_files_read_back_as_simulated(delivered):
    folder, _ = delivered
    day = SMALL.day_list[0]
    for name, data in simulate_day(SMALL, day).instruments.items():
        file = cdflib.CDF(CHAMP.path(folder, name, day))
        for variable, series in data.items():
            found = file.varget(variable)
            if variable == "Epoch":
                assert found.dtype == np.int64
                assert np.array_equal(found, series.values)
            else:
                assert found == pytest.approx(series.values, rel=1e-6 if found.dtype == np.float32 else 0)


@pytest.mark.parametrize("day", ["2005-12-31", "2008-12-31"])
def test_a_leap_second_is_delivered_with_its_exact_time(tmp_path, day):
    wanted = SimulationSettings(start=day, days=1, defects=())
    simulate(wanted, tmp_path, workers=1)
    epoch = cdflib.CDF(CHAMP.path(tmp_path, "fgm", as_day(day))).varget("Epoch")
    start, end = day_bounds(day)
    assert epoch.size == 86401
    assert (epoch[0], epoch[-1]) == (start, end - 1_000_000_000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert str(cdflib.cdfepoch.encode(epoch[-1])).startswith(f"{day}T23:59:60")


def test_variables_carry_the_attributes_a_reader_needs(delivered):
    folder, _ = delivered
    file = cdflib.CDF(CHAMP.path(folder, "fgm", SMALL.day_list[0]))
    attributes = file.varattsget("FGM_RAW")
    assert attributes["UNITS"] == "nT"
    assert attributes["DEPEND_0"] == "Epoch"
    assert attributes["FILLVAL"] == 99999.9
    assert attributes["VALIDMIN"] == -65000.0
    assert attributes["VAR_TYPE"] == "data"
    assert list(np.ravel(file.varget(attributes["LABL_PTR_1"]))) == ["FGM_RAW_x", "FGM_RAW_y", "FGM_RAW_z"]
    assert file.varattsget("Epoch")["VAR_TYPE"] == "support_data"
    for name in ("T_CSC", "T_ADC"):
        assert file.varattsget(name)["UNITS"] == "degC"
    assert file.globalattsget()["Logical_file_id"][0] == "champ_fgm_20050103_v01"


def test_truth_stands_apart_and_no_delivery_tells_of_it(delivered):
    folder, paths = delivered
    assert not [path for path in paths if "truth" in path.parts]
    for path in paths:
        content = path.read_bytes()
        for word in (b"truth", b"day_night", b"SUNLIT", b"STRAY"):
            assert word not in content
    with xr.open_dataset(CHAMP.truth_path(folder, SMALL.day_list[0]), engine="h5netcdf") as truth:
        assert json.loads(truth.attrs["hidden"]) == ["day_night"]
        assert truth.sizes["record"] == 8640
    settings = json.loads((folder / "truth" / "settings.json").read_text())
    assert settings["truth"]["parameters"]["time_shift"] == 0.015


def test_neither_processes_nor_the_clock_change_a_byte(delivered, tmp_path):
    folder, _ = delivered
    time.sleep(1.1)
    told = []
    simulate(SMALL, tmp_path, workers=2, progress=lambda *news: told.append(news))
    assert told == [(0, 2), (1, 2), (2, 2)]
    serial, parallel = hashes(folder), hashes(tmp_path)
    assert serial.keys() == parallel.keys()
    for path, content in serial.items():
        if path.suffix == ".cdf":
            assert content == parallel[path], path


def test_a_stopped_run_is_completed_and_whole_days_are_kept(delivered, tmp_path, monkeypatch):
    folder, _ = delivered
    real, calls = simulated_days.write_cdf, []

    def fail_on_the_ninth(path, source, instrument, data, day):
        calls.append(instrument)
        if len(calls) == 9:
            path.write_bytes(b"half a file")
            raise OSError(28, "No space left on device")
        real(path, source, instrument, data, day)

    monkeypatch.setattr(simulated_days, "write_cdf", fail_on_the_ninth)
    with pytest.raises(StorageError, match="No space left"):
        simulate(SMALL, tmp_path, workers=1)
    assert not list(tmp_path.rglob("*partial*"))
    assert not CHAMP.path(tmp_path, "tq", SMALL.day_list[1]).exists()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*20050103*")}
    assert len(kept) == 7
    monkeypatch.setattr(simulated_days, "write_cdf", real)
    simulate(SMALL, tmp_path, workers=1)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert hashes(tmp_path).keys() == hashes(folder).keys()


def test_a_longer_span_may_follow_but_other_settings_may_not(delivered):
    folder, _ = delivered
    longer = SMALL.model_copy(update={"days": 1, "start": SMALL.start})
    assert len(simulate(longer, folder, workers=1)) == len(INSTRUMENTS)
    with pytest.raises(CatalogError, match="other seed"):
        simulate(SMALL.model_copy(update={"seed": 99}), folder, workers=1)
