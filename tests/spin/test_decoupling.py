"""A change of the spin axis touches its two parameters alone (Plaschke et al. 2019, section 2)."""

import numpy as np
import pytest
import xarray as xr
from eight_cases import TRUTH, by_joint, two_fields

from inflight.figures import correlation_figure, parameter_change_figure
from inflight.spin import PARAMETER_NAMES, SPIN_RELATED

AT = {name: index for index, name in enumerate(SPIN_RELATED)}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("name", ["spin_axis[x]", "spin_axis[y]"])
def test_a_turn_of_the_spin_axis_moves_its_own_parameter_only(name, sign):
    record = two_fields(11, hours=0.7)
    turned = TRUTH.changed({name: float(TRUTH.spin_related()[AT[name]]) + sign * 2e-3})
    before, after = (by_joint(record, one.disturb(record.field), TRUTH) for one in (TRUTH, turned))
    moved = after.value - before.value
    assert moved[AT[name]] == pytest.approx(sign * 2e-3, abs=0.5 * after.sigma[AT[name]])
    others = [at for at in range(8) if at != AT[name]]
    # Nature is the same in both records: what is left is second order.
    assert (np.abs(moved[others]) < 0.5 * after.sigma[others]).all()


def test_a_turn_of_the_sensor_moves_elevations_and_not_the_spin_axis():
    record = two_fields(12, hours=0.7)
    turned = TRUTH.changed({"elevation[1]": TRUTH.elevation[0] + 2e-3})
    before, after = (by_joint(record, one.disturb(record.field), TRUTH) for one in (TRUTH, turned))
    moved = (after.value - before.value) / after.sigma
    assert abs(moved[AT["elevation[1]"]]) > 20.0
    assert (np.abs(moved[[AT["spin_axis[x]"], AT["spin_axis[y]"]]]) < 0.5).all()


def test_the_figures_show_what_moved_and_what_goes_together():
    record = two_fields(13, hours=0.7)
    turned = TRUTH.changed({"spin_axis[x]": TRUTH.spin_axis[0] + 2e-3})
    found = [by_joint(record, one.disturb(record.field), TRUTH) for one in (TRUTH, turned)]
    places = [PARAMETER_NAMES.index(name) for name in SPIN_RELATED]
    own, sigma = np.full((2, 12), np.nan), np.full((2, 12), np.inf)
    for row, one in enumerate(found):
        own[row, places], sigma[row, places] = one.value, one.sigma
    dims = ("interval", "parameter")
    table = xr.Dataset(
        {"own": (dims, own), "own_sigma": (dims, sigma)},
        coords={"parameter": [f"spinning_sensor.{name}" for name in PARAMETER_NAMES]},
    )
    bars = parameter_change_figure(table).renderers[0].data_source.data
    height = dict(zip(SPIN_RELATED, next(value for key, value in bars.items() if key == "top"), strict=True))
    assert abs(height["spin_axis[x]"]) > 5.0
    assert max(abs(size) for name, size in height.items() if name != "spin_axis[x]") < 1.0
    size = np.sqrt(np.diag(found[0].covariance))
    correlation = found[0].covariance / np.outer(size, size)
    drawn = correlation_figure(correlation).renderers[0].data_source.data["size"]
    assert np.allclose(np.reshape(drawn, (8, 8)), correlation)
    assert abs(correlation[AT["offset[1]"], AT["elevation[1]"]]) > 0.1
