"""A value that is told of a real record is that of its samples, whatever the cadence of the search."""

import pytest
from injections import OBSERVATORY
from real_workspaces import workspace

from inflight.catalog import Catalog
from inflight.tasks.analysis import DiagnoseSettings, diagnose
from inflight.tasks.archive import ingest

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not OBSERVATORY.is_dir(), reason=f"real measurements are absent: {OBSERVATORY}"),
]


def test_a_clock_shift_is_the_same_at_each_cadence_of_the_search(tmp_path):
    """A rate in means of 10 s is too small for what is quicker: values made from it were 2.4 sigma larger."""
    known = workspace(tmp_path / "w", "conrad")
    cat, mission = Catalog(known.root), known.mission()
    ingest(cat, mission, OBSERVATORY)
    told = []
    for cadence_s in (10.0, 3.0, 1.0):
        (effect,) = diagnose(cat, mission, settings=DiagnoseSettings(cadence_s=cadence_s)).effects
        (shift,) = effect.coefficients
        assert effect.name == "time_shift"
        assert (effect.cadence_s, effect.noise_of) == (1.0, "field")
        told.append(shift)
    native = told[-1]
    assert all(abs(one.value - native.value) < 0.1 * native.sigma for one in told)
    assert [one.sigma for one in told] == pytest.approx([native.sigma] * 3, rel=0.05)
