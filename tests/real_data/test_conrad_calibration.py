"""The real observatory: the whole chain, what it can determine, and days it has not seen."""

import os
from pathlib import Path

import numpy as np
import pytest

from inflight.calibration import (
    NormalEquations,
    describe_directions,
    matrix_parameters,
    reference_of,
    remove_other_effects,
    usable_samples,
)
from inflight.calibration.residual_loops import residuals
from inflight.catalog import Catalog, Workspace
from inflight.tasks import current_model
from inflight.tasks.archive import ArchiveIndex, ingest, load_samples, needs_of
from inflight.tasks.pipelines import ReprocessSettings, load_equations, reprocess

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
FOLDER = REAL / "conrad-wic-storm-may2024"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the folder of real measurements is absent: {FOLDER}"),
]


class Observatory:
    """The workspace after ingest and reprocess, with what the tests ask of it."""

    def __init__(self, root: Path) -> None:
        self.mission = Workspace.create(root, "conrad").mission()
        self.cat = Catalog(root)
        self.ingested = ingest(self.cat, self.mission, FOLDER)
        self.report = reprocess(self.cat, self.mission, settings=ReprocessSettings(table="span"))
        self.model = current_model(self.cat, self.mission).model
        self.days = self.cat.days("equations/main/base", states=("published",))
        self.equations = load_equations(self.cat, self.days)
        self.prior = reference_of(self.model, int(self.equations.dataset["start"].values[0]))

    def residual(self, index: int, value: np.ndarray) -> np.ndarray:
        """|B| - F of one day at nine parameters; nT."""
        needs = needs_of(self.mission, self.model)
        samples = load_samples(
            self.cat, self.mission, self.model, self.days[index].day, needs, ArchiveIndex.of(self.cat, needs)
        )
        reading, additive, scalar = remove_other_effects(self.model, samples)
        good = usable_samples(samples, reading, additive, scalar)
        return residuals(matrix_parameters(value), reading[good], additive, scalar[good])


@pytest.fixture(scope="module")
def observatory(tmp_path_factory) -> Observatory:
    return Observatory(tmp_path_factory.mktemp("conrad") / "workspace")


def test_four_days_go_through_the_whole_chain(observatory):
    assert observatory.ingested.days["done"] == 8
    assert observatory.report.days == {"planned": 4, "done": 4, "unchanged": 0, "failed": 0, "no_work": 0}


def test_the_residual_falls_from_the_pier_difference_to_the_noise(observatory):
    residual = observatory.report.extra["residual"]
    assert residual["before_nT"] == pytest.approx(11.72, abs=0.01)
    untouched = observatory.cat.open("l2/field", variables=["residual_preflight"])[
        "residual_preflight"
    ].values
    assert residual["after_nT"] < np.nanstd(untouched), "removing the mean alone would do as well"
    product = observatory.cat.open("l2/field", variables=["residual"])
    assert float(np.nanstd(product["residual"].values)) == pytest.approx(residual["after_nT"], rel=0.05)


def test_no_single_parameter_is_claimed_where_the_field_hardly_turns(observatory):
    tables = {record.name: observatory.cat.table_by_id(record.id) for record in observatory.cat.tables()}
    for table in tables.values():
        assert not table["determined"].values.any()
        assert (table["sigma"].values > 0.2 * table["prior_sigma"].values).all()
    whole = observatory.equations.at(observatory.prior.value).solve(observatory.prior.sigma)
    told = describe_directions(whole, observatory.equations.columns)
    assert 1 <= len(told) <= 5, told
    assert "scale_factor[z]" in told[0], "the field is mostly along z"


@pytest.mark.parametrize("held", range(4))
def test_a_day_not_fitted_is_no_worse_than_untouched(observatory, held, record_property):
    """Std of the held-out residual over the untouched one's: 0.968, 0.938, 0.883, 1.018.

    With the mean in it the ratios are 0.994, 0.961, 0.915, 1.185: the mean drifts by 0.014 nT on the
    last day, which three days before cannot tell. That stricter reading is recorded, not met.
    """
    rest = [index for index in range(4) if index != held]
    three = NormalEquations(observatory.equations.dataset.isel(block=rest)).at(observatory.prior.value)
    value, _ = three.physical(three.solve(observatory.prior.sigma, observatory.prior.value))
    after = observatory.residual(held, value)
    untouched = observatory.residual(held, observatory.prior.value)
    strict = float(np.sqrt(np.mean(after**2)) / untouched.std())
    record_property("std_ratio", float(after.std() / untouched.std()))
    record_property("rms_ratio", strict)
    assert after.std() <= 1.02 * untouched.std()
