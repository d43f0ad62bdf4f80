"""Products of a spinning spacecraft in gse and gsm: simulated truth, and what is said without an attitude."""

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.errors import SamplesError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.simulate.spinning import SpinningSettings, ambient, attitude
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.archive.inputs import axis_of
from inflight.tasks.archive.simulated_deliveries import SPINNING
from inflight.tasks.pipelines import reprocess
from inflight.time import SECOND, to_tt2000

SETTINGS = SpinningSettings(craft="themis", days=1, seed=3)
DAY = np.datetime64("2012-03-01")


@pytest.fixture(scope="module")
def themis(tmp_path_factory):
    """One day's workspace, made from all deliveries."""
    made = Workspace.create(tmp_path_factory.mktemp("frames") / "themis", "themis")
    simulate(SETTINGS, made.data, workers=1)
    cat, mission = Catalog(made.root), made.mission()
    ingest(cat, mission, made.data)
    assert reprocess(cat, mission).days["done"] == 1
    return made


def product_of(workspace):
    cat = Catalog(workspace.root)
    return cat.read(cat.days("l2/field", states=("published",))[0])


def again(workspace, folder, old, new):
    """Another workspace of the same deliveries, with a passage of the mission's file replaced."""
    text = workspace.mission().text
    assert text.count(old) == 1
    models = folder / "yaml" / "models"
    models.mkdir(parents=True)
    name = "themis-preflight.yaml"
    (models / name).write_text((workspace.root / "models" / name).read_text(encoding="utf-8"))
    source = folder / "yaml" / "themis.yaml"
    source.write_text(text.replace(old, new), encoding="utf-8")
    made = Workspace.create(folder / "again", source)
    cat, mission = Catalog(made.root), made.mission()
    ingest(cat, mission, workspace.data)
    reprocess(cat, mission)
    return made


def test_the_product_is_the_simulated_field_in_gse_and_gsm(themis):
    """The simulator turns by angles, from the spin axis to sidereal time; the product by vectors."""
    product = product_of(themis)
    truth = xr.open_dataset(SPINNING[SETTINGS.craft].truth_path(themis.data, DAY), decode_times=False)
    stamps = truth["Epoch"].values
    at = np.searchsorted(product["tt2000"].values, stamps)
    axes = attitude.payload_axes(ambient.position(stamps / SECOND, SETTINGS.parameters), SETTINGS.parameters)
    gse = attitude.to_gse(truth["FIELD"].values, axes)
    size = np.linalg.norm(gse, axis=1)
    for name, expected in (("gse", gse), ("gsm", attitude.to_gsm(gse, stamps))):
        field = product[f"field_{name}"]
        assert field.attrs["frame"] == name
        off = np.linalg.norm(field.values[at] - expected, axis=1)
        # The field's own error, that of the offset along the axis, and a hundredth of a degree.
        own = np.linalg.norm(product["field_payload"].values[at] - truth["FIELD"].values, axis=1)
        assert np.all(off < own + 2e-4 * size)
    assert not (product["flag"].values & np.uint32(Flag.NO_ATTITUDE)).any()


def test_without_an_axis_there_are_payload_axes_alone_and_a_flag(themis, tmp_path):
    product = product_of(again(themis, tmp_path, "    spin_axis: spin_axis\n", ""))
    assert "field_payload" in product
    assert not {"field_gse", "field_gsm"} & set(product.variables)
    assert (product["flag"].values & np.uint32(Flag.NO_ATTITUDE)).all()
    delivered = product_of(themis)["field_payload"].values
    np.testing.assert_array_equal(product["field_payload"].values, delivered)


def test_an_axis_that_is_stated_holds_from_its_time_on(themis, tmp_path):
    """Right ascension and declination, by hand, from noon: the same field as with the delivered axis."""
    stamps = np.array([to_tt2000(np.datetime64("2012-03-01T18:00", "ns"))], dtype=np.int64)
    right, up = attitude.spin_direction(stamps, SETTINGS.parameters)[0]
    stated = f"    spin_axis: {{since: 2012-03-01T12:00:00Z, frame: gei, direction: [{right}, {up}]}}\n"
    product = product_of(again(themis, tmp_path, "    spin_axis: spin_axis\n", stated))
    lost = (product["flag"].values & np.uint32(Flag.NO_ATTITUDE)) > 0
    later = product["time"].values >= np.datetime64("2012-03-01T12:00")
    np.testing.assert_array_equal(lost, ~later)
    assert np.isnan(product["field_gse"].values[~later]).all()
    delivered = product_of(themis)
    off = np.linalg.norm(product["field_gsm"].values - delivered["field_gsm"].values, axis=1)[later]
    # The axis stays in gse, which turns by a degree a day: a quarter of it in six hours.
    size = np.linalg.norm(delivered["field_gsm"].values, axis=1)[later]
    assert np.all(off < np.deg2rad(0.3) * size)


def test_a_channel_of_another_kind_is_no_axis(themis):
    text = themis.mission().text.replace("spin_axis: spin_axis", "spin_axis: shadow")
    with pytest.raises(SamplesError, match="'shadow'"):
        axis_of(Mission.parse(text), "main")
