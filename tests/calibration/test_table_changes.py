"""What changed between two tables: a known change comes out in its unit, in sigmas and in nT."""

import numpy as np
import pytest
import xarray as xr

from inflight.calibration import table_changes
from inflight.errors import CalibrationError
from inflight.time import DAY

NAMES = [
    *(f"vector.scale_factor[{axis}]" for axis in "xyz"),
    *(f"vector.misalignment[{pair}]" for pair in ("xy", "xz", "yz")),
    *(f"vector.offset[{axis}]" for axis in "xyz"),
]
SIGMA = np.repeat([1e-5, 1e-3, 0.5], 3)


def table_of(edges, sigma=SIGMA, names=NAMES):
    """A table with rows between edges in days, all nominal."""
    count = len(edges) - 1
    value = np.broadcast_to(np.repeat([1.0, 90.0, 0.0], 3), (count, 9)).copy()
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), value),
            "sigma": (("interval", "parameter"), np.broadcast_to(sigma, (count, 9)).copy()),
            "units": ("parameter", np.repeat(["1", "deg", "nT"], 3)),
            "start": ("interval", DAY * np.array(edges[:-1])),
            "end": ("interval", DAY * np.array(edges[1:])),
        },
        coords={"parameter": names},
    )


def test_a_known_change_is_told_in_its_unit_in_sigmas_and_in_nt():
    before, after = table_of([0, 1, 2, 3, 4]), table_of([1, 4, 5], 2 * SIGMA)
    # Of the second day alone, and of all days that both hold.
    before["value"][1, 6] = -3.0
    after["value"][:, 0] = 1.0001
    after["value"][:, 5] = 90.0 - 0.01
    found = table_changes(before, after, strength=30_000.0)
    assert (found.start / DAY).tolist() == [1, 2, 3]
    rows = {one.parameter: one for one in found.rows()}
    assert set(rows) == {NAMES[0], NAMES[5], NAMES[6]}
    assert list(rows)[-1] == NAMES[6]
    offset, scale, angle = (rows[name] for name in (NAMES[6], NAMES[0], NAMES[5]))
    assert (offset.largest, offset.at, offset.unit) == (3.0, DAY, "nT")
    assert offset.rms == pytest.approx(np.sqrt(3.0))
    assert [one.sigmas for one in (offset, scale, angle)] == pytest.approx([3.0, 5.0, 5.0])
    # One axis holds a third of the square of a field from all directions.
    assert scale.field == pytest.approx(3.0 * np.sqrt(1 / 3), rel=1e-6)
    assert angle.field == pytest.approx(30_000 * np.deg2rad(0.01) * np.sqrt(1 / 3), rel=1e-6)
    # A constant and what goes with the field, and what lies in different axes, are independent.
    assert found.field[1] == pytest.approx(np.sqrt(3.0 + angle.field**2), rel=1e-6)
    assert found.field[0] == pytest.approx(np.sqrt(3.0 + angle.field**2 + 9.0), rel=1e-3)


def test_parameters_that_come_and_go_are_named():
    later = ["other[x]", *NAMES[1:]]
    found = table_changes(table_of([0, 1]), table_of([0, 1], names=later))
    assert (found.gained, found.lost, found.rows()) == (("other[x]",), (NAMES[0],), [])
    # Eight of the nine tell no field.
    assert np.isnan(found.field).all()


@pytest.mark.parametrize(
    ("after", "match"),
    [
        (table_of([1, 2]), "no common time"),
        (table_of([0, 1], names=[f"other {name}" for name in NAMES]), "share no parameter"),
        (xr.Dataset(attrs={"kind": "states"}), "of kind 'states' has no values"),
    ],
)
def test_tables_that_cannot_be_compared_are_refused(after, match):
    with pytest.raises(CalibrationError, match=match):
        table_changes(table_of([0, 1]), after)
