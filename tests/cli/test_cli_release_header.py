"""What a released file says of itself: with what it was made, also where a table was chosen by hand."""

import cdflib
import h5py
import numpy as np
import pytest
from tiny_mission import TINY_START, make_tiny_workspace

from inflight.catalog import Catalog
from inflight.flags import Flag
from inflight.serve import Collection

RELEASE_KEYS = """\
acknowledgement: Made up for tests
release:
  source_name: TINY>A tiny mission
  project: Test>Tests of the calibration
  discipline: Space Physics>Ionospheric Science
  pi_name: Somebody
  pi_affiliation: Somewhere
  rules_of_use: Tests only
"""
FIRST = np.datetime64(TINY_START, "D")
LATER = str(FIRST + 4)


@pytest.fixture
def with_chosen_table(inflight, tmp_path):
    """A workspace of six days, of which four taught the tables and two took the span's by hand."""
    root = make_tiny_workspace(tmp_path / "tiny", days=6)
    mission = root / "mission.yaml"
    mission.write_text(mission.read_text("utf-8") + RELEASE_KEYS, "utf-8")
    for command in (
        ["ingest"],
        ["reprocess", "--end", LATER, "--table", "daily"],
        ["reprocess", "--start", LATER, "--use-table", "main-span"],
    ):
        told = inflight(*command, "-w", root, "--no-prefect")
        assert told.code == 0, told.err
    return root


def test_the_header_of_every_format_names_table_and_origin_as_used(inflight, with_chosen_table):
    root = with_chosen_table
    formats = ("--format", "zarr", "--format", "cdf", "--format", "netcdf")
    assert inflight("release", "1.0", "-w", root, "--no-prefect", *formats).code == 0
    catalog, folder = Catalog(root), root / "releases" / "1.0"
    (table,) = [one for one in catalog.tables("main-span") if one.certified]
    values = catalog.table_by_id(table.id).isel(interval=0)["value"].values.tolist()
    chosen = f"main-span:{table.key[:12]}"
    stem = f"*field*{LATER.replace('-', '')}*"
    (cdf,), (netcdf,) = folder.rglob(f"{stem}.cdf"), folder.rglob(f"{stem}.nc")
    stated = cdflib.CDF(cdf).globalattsget()
    assert stated["Calibration_table"] == [f"{chosen}, learnt 2024-03-01 to 2024-03-05, extrapolated"]
    assert stated["Calibration_model"] == ["tiny-ideal version 1"]
    assert stated["Calibration_method"][0].startswith("scalar, ")
    lines = stated["Calibration_coefficients"]
    assert len(lines) == 9
    assert all(line.endswith(f": table {chosen}, data") for line in lines)
    assert [float(line.split(" = ")[1].split()[0]) for line in lines] == pytest.approx(values, rel=1e-9)
    with h5py.File(netcdf) as file:
        assert file.attrs["calibration_table"] == stated["Calibration_table"][0]
        assert file.attrs["calibration_coefficients"] == "; ".join(lines)
    released = Catalog(folder).read_day("l2/field", LATER)
    assert released.attrs["calibration_coefficients"] == lines
    # A day that its own table calibrated says so.
    own = Catalog(folder).read_day("l2/field", TINY_START)
    assert own.attrs["calibration_table"].startswith("main-daily:")
    assert own.attrs["calibration_table"].endswith("learnt 2024-03-01 to 2024-03-02")


def test_quality_and_uncertainty_of_extrapolated_days_reach_files_and_clients(inflight, with_chosen_table):
    root = with_chosen_table
    formats = ("--format", "cdf", "--format", "netcdf", "--format", "zarr")
    assert inflight("release", "1.0", "-w", root, "--no-prefect", *formats).code == 0
    expected, folder = Catalog(root).read_day("l2/field", LATER), root / "releases" / "1.0"
    assert (expected["flag"].values & Flag.EXTRAPOLATED).all()
    stem = f"*field*{LATER.replace('-', '')}*"
    (cdf,), (netcdf,) = folder.rglob(f"{stem}.cdf"), folder.rglob(f"{stem}.nc")
    file = cdflib.CDF(cdf)
    assert f"{int(Flag.EXTRAPOLATED)} extrapolated" in file.varattsget("flag")["VAR_NOTES"]
    np.testing.assert_array_equal(file.varget("uncertainty"), expected["uncertainty"])
    with h5py.File(netcdf) as opened:
        np.testing.assert_array_equal(opened["flag"], expected["flag"])
        np.testing.assert_array_equal(opened["uncertainty"], expected["uncertainty"])
    served = Collection.open(folder).find("tiny/1.0/l2/field")
    info = {one["name"]: one for one in served.info(list(served.parameters.values()))["parameters"]}
    assert "extrapolated" in info["flag"]["x_flag_meanings"]
    parameters = [served.parameters["flag"], served.parameters["uncertainty"]]
    blocks = list(served.blocks(int(expected["tt2000"][0]), int(expected["tt2000"][-1]) + 1, parameters))
    flag, uncertainty = (np.concatenate([block[1][place] for block in blocks]) for place in (0, 1))
    assert (flag & Flag.EXTRAPOLATED).all()
    np.testing.assert_array_equal(uncertainty, expected["uncertainty"])
