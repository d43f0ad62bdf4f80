"""Where the diagnosis of a spinning spacecraft begins, the fit to folded samples, is found from afar."""

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.simulate.spinning import SpinningSettings
from inflight.spin import fit_folded_samples, spinning_sensor_of
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import plan_pass
from inflight.tasks.archive import ingest, load_samples, simulate


# In a field of 6 nT. From 0, whole steps to the last two overshoot, the next ones more, and none comes back.
@pytest.mark.parametrize("offset", [(3.5, -4.5, 1.9), (-9.0, 7.0, 3.0), (28.0, -36.0, 15.0)])
def test_offsets_as_large_as_the_field_are_found(tmp_path, offset):
    made = Workspace.create(tmp_path / "w", "imp8")
    settings = SpinningSettings(
        craft="imp8",
        days=1,
        seed=4,
        without=("zero_drift",),
        overrides={"offset": list(offset), "gain_ratio": 0.9993},
    )
    simulate(settings, made.data, workers=1)
    cat, mission = Catalog(made.root), made.mission()
    ingest(cat, mission, made.data)
    planned = plan_pass(cat, mission, DiagnoseSettings())
    plan = planned.plan
    found = spinning_sensor_of(plan.model).parameters
    np.testing.assert_allclose(found["offset"].value[:2, 0], offset[:2], atol=0.02, rtol=3e-3)
    np.testing.assert_allclose(found["gain_ratio"].value[0, 0], 0.9993, atol=3e-4)
    # Nothing but noise is left, 0.03 nT a sample and 0.05 nT a digit.
    samples = [
        load_samples(cat, mission, plan.model, day, list(plan.needs), planned.index, geometry=False)
        for day in plan.days
    ]
    fitted = fit_folded_samples(plan.model, samples)
    assert fitted.before < 0.02
    assert np.all(np.abs(fitted.value - _values(plan.model, fitted.names)) < 0.2 * fitted.sigma)


def _values(model, names):
    entry = spinning_sensor_of(model)
    return np.array([entry.parameters[name].value[index, 0] for name, index in names])
