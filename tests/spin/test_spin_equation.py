"""The calibration equation of spinning spacecraft holds its signs and inverts exactly."""

import numpy as np
import pytest
from eight_cases import axis_angles
from hypothesis import given
from hypothesis import strategies as st

from inflight.errors import CalibrationError
from inflight.spin import PARAMETER_NAMES, PARAMETER_UNITS, SPIN_RELATED, CalibrationParameters

angles = st.floats(-0.2, 0.2)
gains = st.floats(0.8, 1.25)
offsets = st.floats(-1e3, 1e3)
twelve = st.builds(
    CalibrationParameters,
    gains, gains, gains, st.tuples(angles, angles), angles, st.tuples(angles, angles), angles,
    st.tuples(offsets, offsets, offsets),
)  # fmt: skip


@given(twelve)
def test_correcting_undoes_disturbing(parameters):
    fields = np.random.default_rng(1).normal(size=(20, 3)) * 1e4
    assert np.allclose(parameters.correct(parameters.disturb(fields)), fields, atol=1e-8)
    assert CalibrationParameters.from_values(parameters.values()) == parameters


@given(twelve)
def test_the_spin_axis_lies_where_its_two_angles_say(parameters):
    sx, sy = parameters.spin_axis
    axis = np.array([np.sin(sx), np.cos(sx) * np.sin(sy), np.cos(sx) * np.cos(sy)])
    assert np.allclose(parameters.factors()[1] @ axis, [0, 0, 1], atol=1e-14)


def test_small_errors_disturb_as_the_linear_equations_say():
    """Equations (16) to (19) of the paper, for every parameter of either sign."""
    field = np.array([[300.0, -200.0, 500.0]])
    bx, by, bz = field[0]
    expected = {
        "gain_ratio": (-bx, by, 0),
        "spin_plane_gain": (-bx, -by, 0),
        "axial_gain": (0, 0, -bz),
        "elevation[1]": (-bz, 0, 0),
        "elevation[2]": (0, -bz, 0),
        "azimuth": (0, -bx, 0),
        "spin_axis[x]": (bz, 0, -bx),
        "spin_axis[y]": (0, bz, -by),
        "rotation": (by, -bx, 0),
        "offset[1]": (1, 0, 0),
        "offset[2]": (0, 1, 0),
        "offset[3]": (0, 0, 1),
    }
    assert set(expected) == set(PARAMETER_NAMES)
    for name, change in expected.items():
        for step in (1e-6, -1e-6):
            value = step + (1.0 if "gain" in name else 0.0)
            found = CalibrationParameters().changed({name: value}).disturb(field) - field
            assert np.allclose(found[0] / step, change, rtol=1e-5, atol=1e-2), name


def test_eight_parameters_are_those_of_the_paper():
    assert len(SPIN_RELATED) == 8
    assert set(PARAMETER_NAMES) - set(SPIN_RELATED) == {
        "spin_plane_gain",
        "axial_gain",
        "rotation",
        "offset[3]",
    }
    assert PARAMETER_UNITS["offset[2]"] == "nT"
    assert PARAMETER_UNITS["gain_ratio"] == "1"
    assert PARAMETER_UNITS["azimuth"] == "rad"


def test_a_name_nobody_knows_is_refused():
    with pytest.raises(CalibrationError, match="offset_1"):
        CalibrationParameters().changed({"offset_1": 3.0})
    with pytest.raises(CalibrationError, match="12 needed"):
        CalibrationParameters.from_values([1.0, 2.0])


def test_a_moved_spin_axis_changes_every_angle_of_the_sensor_axes_but_two_parameters_here():
    before = CalibrationParameters(
        1.001, 1.0, 1.0, (0.01, -0.008), 0.006, (0.004, -0.003), 0.02, (1.0, 2.0, 3.0)
    )
    after = before.changed({"spin_axis[x]": 0.012, "spin_axis[y]": 0.006})
    moved = [
        name for name, a, b in zip(PARAMETER_NAMES, before.values(), after.values(), strict=True) if a != b
    ]
    assert moved == ["spin_axis[x]", "spin_axis[y]"]
    old, new = (axis_angles(one.matrix()) for one in (before, after))
    assert np.all(np.abs(new[0] - old[0]) > 1e-4)
    assert np.all(np.abs(new[1] - old[1]) > 1e-5)
    assert np.allclose(new[2], old[2], rtol=1e-12)
