"""The mission with two fluxgates through the whole chain: three comparisons, one code."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.errors import MissionError
from inflight.flags import UNUSABLE
from inflight.mission import Mission
from inflight.mission_fit.two_fluxgates import corners, fit_relation
from inflight.simulate import Parameters, SimulationSettings
from inflight.simulate.second_fluxgate import as_second
from inflight.tasks import current_model, preflight_model
from inflight.tasks.analysis import DiagnoseSettings, compare
from inflight.tasks.analysis.diagnosis import diagnose
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.archive.simulated_deliveries import CHAMP
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.intercalibration import relation_report

MISSIONS = Path(__file__).parents[2] / "missions"
NAME = "champ-two-fluxgates"
#: Fields that no pre-flight model describes are left out, but for a star camera's of twice the usual size.
SETTINGS = SimulationSettings(
    days=3,
    cadence=10,
    second_fluxgate=True,
    without=("solar_array", "battery", "heater", "remanent"),
    overrides={"camera_field": [0.6, -0.6, 2.0]},
)


@pytest.fixture(scope="module")
def champ(tmp_path_factory) -> Workspace:
    """Three days at a coarse cadence, both fluxgates calibrated against the scalar sensor."""
    folder = tmp_path_factory.mktemp("two")
    source = folder / "missions"
    shutil.copytree(MISSIONS, source)
    yaml = source / f"{NAME}.yaml"
    yaml.write_text(
        yaml.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 10 s"), encoding="utf-8"
    )
    made = Workspace.create(folder / "w", yaml)
    simulate(SETTINGS, made.data, workers=1)
    catalog, mission = Catalog(made.root), made.mission()
    assert ingest(catalog, mission, made.data).exit_code == 0
    for comparison in ("main", "second"):
        report = reprocess(catalog, mission, settings=ReprocessSettings(comparison=comparison))
        assert report.exit_code == 0
        assert report.extra["residual"]["before_nT"] > 20
        assert report.extra["residual"]["after_nT"] < 0.2
    return made


def products(workspace: Workspace, comparison: str) -> xr.Dataset:
    return (
        Catalog(workspace.root).open("l2/field" if comparison == "main" else f"l2/field-{comparison}").load()
    )


def common(workspace: Workspace) -> tuple[xr.Dataset, xr.Dataset]:
    """Products of both fluxgates at the stamps on which both, and the scalar sensor, measured."""
    main, second = products(workspace, "main"), products(workspace, "second")
    both = [one.isel(time=(one["flag"].values & np.uint32(UNUSABLE)) == 0) for one in (main, second)]
    first, other = xr.align(*both, join="inner")
    return first, other


def test_each_comparison_begins_with_its_own_model(champ):
    catalog, mission = Catalog(champ.root), champ.mission()
    names = [current_model(catalog, mission, name).model.name for name in ("main", "second", "between")]
    assert names == ["champ-preflight", "champ-second-preflight", "champ-between-preflight"]


def test_the_second_fluxgate_gets_its_own_nine_parameters(champ):
    truth = xr.open_dataset(CHAMP.truth_path(champ.data, SETTINGS.day_list[1]), engine="h5netcdf").attrs
    for comparison, key in (("main", "nine_parameters"), ("second", "nine_parameters_second")):
        table = Catalog(champ.root).table(f"{comparison}-window", str(SETTINGS.day_list[1])).isel(interval=0)
        expected = np.concatenate([np.ravel(part) for part in json.loads(truth[key]).values()])
        off = np.abs(table["value"].values - expected)
        # What the pre-flight models do not know: the camera's field, and errors of the torquers' fields.
        assert off[:3].max() < 2e-5
        assert off[3:6].max() < 0.005
        assert off[6:].max() < 1.2
        assert table["determined"].values[[0, 1, 2, 6, 8]].all()


def test_compare_measures_the_second_comparison_too(champ):
    report = compare(Catalog(champ.root), champ.mission(), comparison="second")
    assert report.comparison == "second"
    assert report.after.rms < 0.2
    assert report.floor.level_nT == pytest.approx(np.hypot(0.08, 0.04), rel=0.1)


def test_the_turn_of_one_against_the_other_follows_from_their_products(champ):
    main, second = common(champ)
    fields = [np.asarray(one["field_spacecraft"].values) for one in (main, second)]
    table = fit_relation(*fields, main["tt2000"].values).table()
    # The angles of a sensor are known to some arcseconds from three days.
    assert np.abs(table["value"].values[:3] - Parameters().second_rotation).max() < 0.004
    assert np.abs(table["value"].values[9:]).max() < 0.6
    assert table.attrs["rms_nT"] == pytest.approx(0.08 * np.sqrt(2), rel=0.1)
    parts = corners(
        main["residual"].values,
        second["residual"].values,
        main["tt2000"].values,
        np.linalg.norm(fields[0], axis=1) - np.linalg.norm(fields[1], axis=1),
    )
    # Rounding of the products, and the readings of the scalar sensor corrected along two directions.
    assert parts.closure < 0.01


def test_diagnose_finds_between_the_fluxgates_what_is_nearer_to_one_of_them(champ):
    found = diagnose(
        Catalog(champ.root),
        champ.mission(),
        settings=DiagnoseSettings(comparison="between", rounds=1, draws=300),
    ).as_json()
    (effect,) = found["effects"]
    assert effect["channels"] == ["camera_current"]
    told = dict(zip("xyz", effect["coefficients"], strict=True))
    parameters = SETTINGS.parameters
    expected = np.array(parameters.camera_field) - np.array(as_second(parameters).camera_field)
    for axis, value in zip("xyz", expected / 1000, strict=True):
        assert abs(told[axis]["value"] - value) < 4 * told[axis]["sigma"]


def test_a_model_of_another_comparison_is_refused_where_it_is_stated(champ, tmp_path):
    copy = tmp_path / "w"
    shutil.copytree(champ.root, copy, ignore=shutil.ignore_patterns("stores", "data"))
    text = champ.mission().text.replace("champ-second-preflight", "champ-preflight")
    with pytest.raises(MissionError, match=r"comparisons\.second\.preflight.*comparison 'main'"):
        preflight_model(Catalog(copy), Mission.parse(text), "second")
    text = champ.mission().text.replace("models/champ-second-preflight", "models/gone")
    with pytest.raises(MissionError, match=r"comparisons\.second\.preflight: there is no file"):
        preflight_model(Catalog(copy), Mission.parse(text), "second")


def test_the_workspace_holds_every_model_its_comparisons_name(champ):
    assert champ.mission().companions == [
        "models/champ-preflight.yaml",
        "models/champ-second-preflight.yaml",
        "models/champ-between-preflight.yaml",
    ]
    assert all((champ.root / name).is_file() for name in champ.mission().companions)


def test_reprocess_of_the_two_against_each_other_makes_tables_and_says_there_is_no_product(champ):
    catalog, mission = Catalog(champ.root), champ.mission()
    settings = ReprocessSettings(comparison="between")
    report = reprocess(catalog, mission, settings=settings)
    assert report.exit_code == 0
    assert report.days["done"] == SETTINGS.days
    assert "calibrate nothing" in report.extra["note"]
    assert not report.extra["left_out"]
    assert not catalog.days("l2/field-between")
    for name in ("relation", "relation-daily", "corners"):
        assert catalog.tables(f"between-{name}")[-1].certified, name
    table = catalog.table_by_id(catalog.tables("between-relation")[-1].id)
    main, second = common(champ)
    fields = [np.asarray(one["field_spacecraft"].values) for one in (main, second)]
    whole = fit_relation(*fields, main["tt2000"].values).table()
    # Days by themselves leave out other samples than all at once.
    assert np.abs(table["value"].values - whole["value"].values).max() < 0.2 * whole["sigma"].values.max()
    assert np.abs(table["value"].values[:3] - Parameters().second_rotation).max() < 0.004
    daily = catalog.table_by_id(catalog.tables("between-relation-daily")[-1].id)
    assert daily.sizes["interval"] == SETTINGS.days
    parts = catalog.table_by_id(catalog.tables("between-corners")[-1].id)
    assert parts.attrs["closure_nT"] < 0.01
    told = relation_report(catalog, mission, "between", champ.root / "between.html")
    assert len(told["sections"]["relation"]["items"]) == 12
    assert (champ.root / "between.html").read_text(encoding="utf-8").count("data-root-id") == 6
    again = reprocess(catalog, mission, settings=settings)
    assert again.days["unchanged"] == SETTINGS.days
    assert len(catalog.tables("between-relation")) == 1


def test_a_comparison_whose_sensor_nothing_calibrates_says_so(champ):
    text = champ.mission().text
    start, end = text.index("  second: {"), text.index("  between: {")
    with pytest.raises(MissionError, match="no scalar comparison calibrates 'fgm2'"):
        reprocess(
            Catalog(champ.root),
            Mission.parse(text[:start] + text[end:]),
            settings=ReprocessSettings(comparison="between"),
        )
