"""A current that both sensors see: the residual is at the noise, the vector wrong until the place is told."""

import numpy as np
import pytest

from benchmarks.archive import simulated_workspace
from docs.figures.stray_fields import MODEL, SETTINGS, TrueError

#: The mission of the page, of which nothing but the battery's field is wrong; its source is at the origin.
DAYS = 2
MISSION = SETTINGS.model_copy(update={"days": DAYS})
NOISE = float(np.hypot(SETTINGS.vector_noise, SETTINGS.scalar_noise))


@pytest.mark.slow
def test_the_vector_is_right_once_it_is_told_where_the_current_flows(inflight, tmp_path):
    cat = simulated_workspace(tmp_path / "champ", DAYS, settings=MISSION, workers=1)
    root = cat.workspace
    (root / "models" / "champ-preflight.yaml").write_text(MODEL, encoding="utf-8")

    here = ("--workers", 1, "-w", root)

    def reprocessed():
        assert inflight("reprocess", "--no-prefect", *here).code == 0
        return TrueError.of(cat, MISSION)

    before = reprocessed()
    added = inflight("add", "{effect: channel_field, name: battery, channel: battery_current}", *here)
    assert "battery.dipole=" in " ".join(added.out.split())
    apart = reprocessed()
    # The two sensors agree, and the vector is still wrong by what the scalar one saw: no uncertainty has it.
    assert before.residual > 5 * NOISE
    assert apart.residual == pytest.approx(NOISE, rel=0.03)
    assert (apart.mean > 5 * apart.stated)[[0, 2]].all()

    refused = inflight("set", "battery.dipole=here", *here)
    assert refused.code == 1
    assert "0.3 0 0.1 +- 0.2" in " ".join((refused.out + refused.err).split())
    inflight("set", "battery.dipole=0 0 0.5 +- 0.5", *here)
    beside = reprocessed()
    inflight("set", "battery.dipole=0 0 0 +- 0.5", *here)
    right = reprocessed()
    for told in (beside, right):
        assert told.residual == pytest.approx(NOISE, rel=0.03)
        assert (told.mean < told.stated).all()
    # Half a metre off the axis turns the field of z into x by a fifth of what it is; no better is stated.
    assert (beside.mean < 0.4 * apart.mean)[[0, 2]].all()
    assert 0.1 < beside.mean[0] < beside.stated[0] < 3 * beside.mean[0]
    assert (right.mean < 0.03).all()
    shown = inflight("model", "show", "-w", root).out
    assert "battery: a dipole at 0, 0, 0 m" in " ".join(shown.split())

    # Back: the coefficients are those of the difference again, the product's field as it was.
    inflight("set", "battery.dipole=none", *here)
    np.testing.assert_allclose(reprocessed().mean, apart.mean, rtol=0.02)
