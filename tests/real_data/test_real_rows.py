"""Rows of real comparisons: two sensors on one boom, two variometers, and fields of one's own put in."""

import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from injections import OBSERVATORY, following, inject, observatory, observatory_with, step

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.model import Model, ResidualDefinition, rows_of
from inflight.samples import slow_response
from inflight.tasks import current_model
from inflight.tasks.archive import ArchiveIndex, channels_by_name, ingest, load_samples, needs_of

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not REAL.is_dir(), reason=f"the folder of real measurements {REAL} is absent"),
]


def taken(root, mission, folder, instruments=None):
    """Return a catalog and the mission after the set came in."""
    known = Workspace.create(root, mission).mission()
    cat = Catalog(root)
    ingest(cat, known, REAL / folder, instruments)
    return cat, known


def all_samples(cat, mission, comparison, channels=()):
    """Return the model and every day's samples."""
    model = current_model(cat, mission, comparison).model
    needs = needs_of(mission, model, extra=channels)
    index = ArchiveIndex.of(cat, needs)
    return model, [load_samples(cat, mission, model, day, needs, index) for day in index.complete_days(needs)]


@pytest.fixture(scope="module")
def boom(tmp_path_factory):
    cat, mission = taken(tmp_path_factory.mktemp("goes") / "w", "goes16", "goes16-mag-ib-ob")
    model, (samples,) = all_samples(cat, mission, "main", list(channels_by_name(mission)))
    return mission, model, samples


def test_two_sensors_on_a_boom_differ_by_the_field_of_their_spacecraft(boom):
    """The data's own check: inboard less outboard in spacecraft axes is the negative of (6.4, 38.6, 58.2)."""
    _, model, samples = boom
    rows = rows_of(model, samples)
    assert rows.good.mean() > 0.999
    np.testing.assert_allclose(rows.residual[rows.good].mean(axis=0), [-6.42, -38.55, -58.21], atol=0.01)
    means = rows.residual[rows.good][: 20 * 1790].reshape(-1, 20, 3).mean(axis=1)
    np.testing.assert_allclose(means.std(axis=0), [0.13, 0.49, 0.27], atol=0.03)


def test_every_channel_of_the_boom_is_in_the_samples(boom):
    mission, _, samples = boom
    kinds = {"quaternion": "attitude"}
    for name in channels_by_name(mission):
        series = samples[kinds.get(name, name)]
        seen = np.isfinite(series.values.reshape(len(series), -1)).all(axis=1).mean()
        # The attitude's own clock is 300 s late in the file: the first five minutes have none.
        assert seen > (0.9 if name == "quaternion" else 0.999), name
    assert samples["solar_array_current_1"].attrs["kind"] == "solar_current"
    assert float(samples["solar_array_current_1"].std()) > 10.0


def test_a_field_at_the_inboard_sensor_only_changes_the_rows_as_told(boom):
    _, model, samples = boom
    clean = samples.isel(time=slice(1000, 3000))
    added = following(clean, "solar_array_current_1", 0.05, along=(1.0, -1.0, 0.5))
    before, after = rows_of(model, clean), rows_of(model, inject(clean, added, "inboard"))
    expected = np.einsum("tra,ta->tr", before.directions["inboard"], added.field)
    np.testing.assert_allclose(after.residual - before.residual, expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(expected.std(axis=0)), 0.05, rtol=1e-6)


def test_both_vector_instruments_are_held_against_the_proton_magnetometer(tmp_path):
    cat, mission = taken(tmp_path / "w", "wik-cobenzl", "wik-cobenzl-2011", ["didd", "lemi025", "pmag"])
    spread = {}
    for comparison in ("main", "variometer"):
        model, days = all_samples(cat, mission, comparison)
        rows = [rows_of(model, samples) for samples in days]
        good = np.concatenate([one.good for one in rows])
        residual = np.concatenate([one.residual for one in rows])[good, 0]
        assert len(days) == 30
        # A wild reading of the proton magnetometer takes half an hour with it: the low pass reaches so far.
        assert 0.85 < good.mean() < 0.95
        assert abs(np.median(residual)) < 4.0
        spread[comparison] = np.median(np.abs(residual - np.median(residual)))
    assert spread["main"] < spread["variometer"] < 0.6


needs_observatory = pytest.mark.skipif(
    not OBSERVATORY.is_dir(), reason=f"the folder of real measurements is absent: {OBSERVATORY}"
)


@pytest.fixture(scope="module")
def pillar():
    """The observatory's record and its model as delivered."""
    mission = Mission.parse((ROOT / "missions" / "conrad.yaml").read_text(encoding="utf-8"))
    record = observatory().assign(flag=("time", np.zeros(345_600, dtype=np.uint32)))
    return Model("as delivered", "conrad", "main", (), layout=ResidualDefinition.of(mission)), record


@needs_observatory
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("lag_s", [0.0, 600.0])
def test_what_is_put_in_follows_its_channel_with_the_stated_size(pillar, sign, lag_s):
    model, record = pillar
    added = following(record, "electronics_temperature", 0.2 * sign, along=(0.5, 0.0, 1.0), lag_s=lag_s)
    assert np.linalg.norm(added.field.std(axis=0)) == pytest.approx(0.2)
    cause = slow_response(record["electronics_temperature"].values, 1.0, lag_s) if lag_s else None
    cause = record["electronics_temperature"].values if cause is None else cause
    later = slice(int(8 * lag_s), None)
    expected = (cause - cause.mean())[:, None] * added.truth["vector"]
    difference = (added.field - expected)[later]
    assert np.abs(difference - difference.mean(axis=0)).max() < 2e-3
    before, after = rows_of(model, record), rows_of(model, inject(record, added))
    change = (after.residual - before.residual)[:, 0]
    seen = np.einsum("ta,ta->t", before.directions["lemi"][:, 0], added.field)
    np.testing.assert_allclose(change[before.good], seen[before.good], atol=1e-5)


@needs_observatory
def test_a_step_goes_through_files_and_the_whole_way_in(tmp_path):
    def make(record: xr.Dataset):
        return [step(record, int(record["tt2000"].values[200_000]), 1.5, along=(0.0, 0.0, -1.0))]

    workspace, data = observatory_with(tmp_path / "w", make)
    cat, mission = Catalog(workspace.root), workspace.mission()
    assert ingest(cat, mission, data).problems == []
    ours = cat.open("l1/lemi").load()
    delivered = observatory()
    np.testing.assert_array_equal(ours["tt2000"], delivered["tt2000"])
    change = ours["field"].values - delivered["vector"].values
    assert np.abs(change[:200_000]).max() == 0.0
    np.testing.assert_allclose(change[200_000:], np.broadcast_to([0.0, 0.0, -1.5], (145_600, 3)), atol=1e-9)
    np.testing.assert_array_equal(cat.open("l1/gp20s3")["field"].values, delivered["scalar"].values)
