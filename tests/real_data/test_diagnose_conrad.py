"""What is said of a real observatory as delivered, and of fields and clock faults of one's own put into it.

The field there hardly turns, so of a field put in only the part along the mean field is seen: values are
judged along that direction.
"""

import numpy as np
import pytest
from injections import OBSERVATORY, following, inject, observatory, step
from real_workspaces import along, diagnosed, observatory_workspace

from inflight.time import SECOND

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not OBSERVATORY.is_dir(), reason=f"real measurements are absent: {OBSERVATORY}"),
]
#: A channel of one's own, recorded with the real ones: a heater's current, on and off at random.
HEATER = {"heater_current": "{variable: heater_current, unit: A, kind: current}"}
HOUR = 3600 * SECOND
#: Injected fields are so many times what stands out by three sigma.
TIMES = 5.0


def heater(samples: int) -> np.ndarray:
    """Return a current of on and off times between a quarter of an hour and two hours; (samples,) A."""
    generator = np.random.default_rng(5)
    current, at = np.zeros(samples), 0
    while at < samples:
        lasting, pause = generator.integers(900, 7200, 2)
        current[at : at + lasting] = generator.uniform(0.5, 1.5)
        at += int(lasting + pause)
    return current


@pytest.fixture(scope="module")
def record():
    delivered = observatory()
    return delivered.assign(heater_current=("time", heater(delivered.sizes["time"])))


@pytest.fixture(scope="module")
def direction(record):
    mean = record["vector"].values.mean(axis=0)
    return mean / np.linalg.norm(mean)


@pytest.fixture(scope="module")
def say(record, tmp_path_factory):
    """Return a function that puts injections in and returns what is said."""

    def make(*injections, clock="[]"):
        held = record
        for injection in injections:
            held = inject(held, injection)
        root = tmp_path_factory.mktemp("conrad") / "workspace"
        return diagnosed(*observatory_workspace(root, held, HEATER, clock))

    return make


@pytest.fixture(scope="module")
def delivered(say):
    return say()


def smallest(delivered, option: str, direction: np.ndarray) -> float:
    """Return what would stand out by three sigma along the field, as `detectable_amplitude` has it."""
    return 3.0 * along(delivered.search, delivered.option(option), direction, before=True)[1]


def test_temperatures_that_hardly_move_are_not_blamed(delivered, record):
    assert np.ptp(record["sensor_temperature"].values) < 0.04
    assert np.ptp(record["electronics_temperature"].values) < 0.14
    assert "temperature" not in delivered.families
    assert not delivered.channels & {"sensor_temperature", "electronics_temperature", "heater_current"}
    assert delivered.ratio <= 1.0


def test_the_axes_of_a_field_that_follows_a_temperature_are_said_to_be_unknown(delivered, direction):
    """One direction is seen: along it some nT/K would show, of a single axis tens of nT/K would not."""
    from inflight.diagnosis.stepwise import detectable_amplitude

    option = delivered.option("channel_field(electronics_temperature)")
    each = detectable_amplitude(delivered.search, option)
    assert each.min() > 20.0 * smallest(delivered, option.name, direction)


def test_two_instruments_whose_clocks_differ_are_found_out(delivered, record):
    """The residual follows dF/dt on every disturbed day: a regression of one's own gives 0.17 to 0.18 s."""
    vector, scalar = record["vector"].values, record["scalar"].values
    strength = np.linalg.norm(vector, axis=1)
    columns = np.column_stack([np.gradient(strength), np.ones(len(vector)), vector - vector.mean(axis=0)])
    good = np.isfinite(scalar)
    own = np.linalg.lstsq(columns[good], (strength - scalar)[good], rcond=None)[0][0]
    assert -0.19 < own < -0.16
    found = delivered.effect("clock")
    assert found is not None
    assert found.coefficients[0].value == pytest.approx(own, abs=0.03)
    assert delivered.ratio < 0.9


def test_a_field_that_follows_a_temperature_is_found(delivered, say, record, direction):
    name = "channel_field(electronics_temperature)"
    size = TIMES * smallest(delivered, name, direction) * float(record["electronics_temperature"].std())
    put_in = following(record, "electronics_temperature", size, along=direction)
    said = say(put_in)
    assert said.diagnosis.verdict in ("FOUND", "CONFOUNDED")
    assert "temperature" in said.families
    assert said.ratio < 0.8
    if name in said.names:
        value, sigma = along(said.search, said.option(name), direction)
        assert abs(value - put_in.truth["vector"] @ direction) < 3.0 * sigma


def test_a_field_that_follows_a_current_slowly_is_found_with_its_lag(delivered, say, record, direction):
    name = "channel_field(heater_current)@lag=1000s"
    size = TIMES * smallest(delivered, name, direction) * float(record["heater_current"].std())
    put_in = following(record, "heater_current", size, along=direction, lag_s=600.0)
    said = say(put_in)
    found = said.effect("current")
    assert found is not None
    assert found.channels == ("heater_current",)
    assert found.lag_s == pytest.approx(600.0, rel=0.1)
    value, sigma = along(said.search, said.option(found.name), direction)
    # The lag in use differs from the true one by some percent, and so does the size.
    assert abs(value - put_in.truth["vector"] @ direction) < 3.0 * sigma + 0.05 * abs(value)


def test_a_step_is_found_at_its_hour(say, record, direction):
    at = int(record["tt2000"].values[0]) + int(30.37 * HOUR)
    said = say(step(record, at, 0.15, along=direction))
    steps = [one for one in said.diagnosis.effects if one.name.startswith(("bias_step", "offset_step"))]
    assert len(steps) == 1
    when = np.datetime64(steps[0].at[0].rstrip("Z"))
    begin = np.datetime64("2024-05-09T00:00:00")
    assert abs((when - begin) / np.timedelta64(1, "s") - 30.37 * 3600) <= 3600
    if steps[0].family == "bias":
        found = steps[0].coefficients[0]
        # A field more at the vector sensor is a bias less at the scalar one.
        assert abs(-found.value - 0.15) < 3.0 * found.sigma


def test_a_step_of_a_clock_is_found(say):
    said = say(clock="[{offset: 0 s}, {since: 2024-05-11T00:00:00Z, offset: 500 ms}]")
    found = said.effect("clock")
    assert found is not None
    assert found.at[0].startswith(("2024-05-10T2", "2024-05-11T0"))
