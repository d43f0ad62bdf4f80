"""A published calibration as truth for the chain, and beside it our own scalar fit."""

import os
from pathlib import Path

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.model import Model
from inflight.tasks.archive import ArchiveIndex, ingest, load_samples, needs_of
from inflight.tasks.pipelines import ReprocessSettings, reprocess

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
FOLDER = REAL / "usgs-bou-201601"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the folder of real measurements is absent: {FOLDER}"),
]


@pytest.fixture(scope="module")
def boulder(tmp_path_factory):
    root = tmp_path_factory.mktemp("boulder") / "workspace"
    mission = Workspace.create(root, "usgs-bou").mission()
    cat = Catalog(root)
    ingest(cat, mission, FOLDER)
    text = (ROOT / "missions" / "models" / "usgs-bou-published.yaml").read_text(encoding="utf-8")
    return cat, mission, Model.parse(text, mission)


def corrected(boulder):
    """Published values and ours, over the month: (X, Y, Z) and F."""
    cat, mission, model = boulder
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    days = index.complete_days(needs)
    ours = [model.correct(load_samples(cat, mission, model, day, needs, index)) for day in days]
    field = np.concatenate([one["field"].values for one in ours])
    scalar = np.concatenate([one["scalar"].values for one in ours])
    span = slice(str(days[0]), str(days[-1] + 1))
    vector = cat.open("l1/adjusted", time=span)["field"].values
    total = cat.open("l1/adjusted_total_field", time=span)["field"].values
    assert len(vector) == len(field)
    return field, scalar, vector, total


def test_the_published_matrix_gives_the_published_field_to_its_rounding(boulder):
    field, scalar, vector, total = corrected(boulder)
    both = np.isfinite(field).all(axis=1) & np.isfinite(vector).all(axis=1)
    assert both.sum() > 40_000
    assert np.abs(field - vector)[both].max() < 0.02
    both = np.isfinite(scalar) & np.isfinite(total)
    assert both.sum() > 40_000
    assert np.abs(scalar - total)[both].max() < 0.02


def test_our_scalar_fit_leaves_less_than_the_published_calibration_because_it_is_made_to(
    boulder, record_property
):
    """Published |B| - F: -6.555 +- 0.202 nT, a difference of piers that its vector calibration keeps.

    Our own: 0.001 +- 0.167 nT. A scalar fit takes the mean out by construction; only the
    spreads may be compared.
    """
    field, scalar, _, _ = corrected(boulder)
    published = np.linalg.norm(field, axis=1) - scalar
    published = published[np.isfinite(published)]
    assert published.mean() == pytest.approx(-6.55, abs=0.02)
    assert published.std() == pytest.approx(0.20, abs=0.02)
    cat, mission, _ = boulder
    report = reprocess(cat, mission, settings=ReprocessSettings(table="span"))
    assert report.days["failed"] == 0
    residual = cat.open("l2/field", variables=["residual"])["residual"].values
    residual = residual[np.isfinite(residual)]
    record_property("own_mean_nT", float(residual.mean()))
    record_property("own_std_nT", float(residual.std()))
    assert report.extra["residual"]["before_nT"] > 500
    assert abs(residual.mean()) < 0.05
    assert residual.std() < 0.25
