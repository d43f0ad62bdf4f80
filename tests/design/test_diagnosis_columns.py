"""Columns of candidates against the model's exact chain, and of the calibration against its own Jacobian."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from effect_cases import MISSION, PREFLIGHT, SENSORS, true_samples

from inflight.calibration import PARAMETER_SCALE, kernel_scale, matrix_parameters
from inflight.calibration.residual_loops import _fill
from inflight.design import DesignRows, Term, design_gram, design_matrix, sensor_matrices, term_of
from inflight.design.columns import term_columns
from inflight.lsq import gram_of
from inflight.model import Model, make_effect, rows_of

#: Effects whose column is taken of one evaluation, and such inside an instrument's equation.
ADDITIVE = [
    ("channel_field", {"channel": "solar_current", "sensor": "fgm"}),
    ("channel_field", {"channel": "solar_current", "sensor": "ovm"}),
    ("day_night", {"sensor": "fgm"}),
    ("remanent", {"sensor": "fgm"}),
    ("remanent", {"sensor": "ovm"}),
    ("torquer", {"channel": "torquer_current", "sensor": "fgm"}),
    ("hysteresis", {"channel": "coil_temperature", "width": 2, "sensor": "fgm"}),
    ("tone", {"period": "37.3 s", "sensor": "fgm"}),
]
DIFFERENCED = [
    ("nonlinearity", {"sensor": "fgm"}),
    ("temperature", {"channel": "coil_temperature", "sensor": "fgm"}),
    ("channel_scale", {"channel": "coil_temperature", "sensor": "fgm"}),
    ("channel_angle", {"channel": "coil_temperature", "sensor": "fgm"}),
    ("cross_talk", {"sensor": "fgm"}),
    ("scalar_bias", {"sensor": "ovm"}),
    ("time_shift", {"sensor": "ovm"}),
    ("induced", {"sensor": "ovm"}),
]


#: Part of a parameter's step that the exact chain is moved by: of a channel in mA a whole one is 10 000 nT.
SMALL = 1e-3


@pytest.fixture(scope="module")
def flown():
    """The pre-flight model, raw samples it explains, and their rows at full cadence.

    Without its time shift, which hears of a field at the vector sensor through dF/dt: these samples are
    drawn one by one, and change by thousands of nT from second to second.
    """
    model = Model.parse(PREFLIGHT, MISSION).drop("time_shift")
    samples = model.disturb(true_samples())
    return model, samples, rows_at(model, samples)


def rows_at(model, samples):
    native = rows_of(model, samples)
    corrected = model.correct(samples)
    held = samples.assign(
        field=(("time", "axis"), native.field, {"units": "nT"}), field_direction=corrected["field_direction"]
    )
    turn = sensor_matrices(model, int(samples["tt2000"].values[0]))
    return DesignRows(held, native.residual, native.directions, turn, np.ones(len(native.residual)))


def exact_columns(model, samples, entry, parameters):
    """Return the central differences of the residual of the whole chain; (time, row, column)."""
    name = entry.name
    out = []
    for key in parameters:
        kind = entry.effect.parameters()[key]
        for index in range(kind.size):
            moved = []
            for sign in (1.0, -1.0):
                timed = entry.parameters[key]
                value = timed.value.copy()
                value[index] += sign * kind.step * SMALL
                own = entry.with_parameters({**entry.parameters, key: replace(timed, value=value)})
                moved.append(
                    (model.replace(own) if name in names(model) else model.add(own)).residual(samples)
                )
            out.append((moved[0] - moved[1]) / (2.0 * SMALL))
    return np.stack(out, axis=-1)


def names(model):
    return [entry.name for entry in model.effects]


@pytest.mark.parametrize(("label", "options"), [*ADDITIVE, *DIFFERENCED])
def test_columns_are_the_changes_of_the_exact_residual(flown, label, options):
    model, samples, rows = flown
    entry = make_effect({"effect": label, "name": "tried", **options}, SENSORS, (), MISSION)
    term = term_of(entry, "tried")
    found = term_columns(term, rows)
    expected = exact_columns(model, samples, entry, term.parameters)
    assert found.shape == expected.shape
    for column, exact in zip(np.moveaxis(found, -1, 0), np.moveaxis(expected, -1, 0), strict=True):
        assert rms(column - exact) < 1e-3 * rms(exact)


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_the_columns_of_an_effect_that_follows_the_field_are_made_from_the_reading(flown):
    """Beside the sensor's equation alone: what stands before it changes the field that is followed."""
    model, samples, _ = flown
    alone = replace(model, effects=(model.effect("vector_sensor"),))
    entry = make_effect({"effect": "eddy", "name": "tried", "sensor": "fgm"}, SENSORS, (), MISSION)
    term = term_of(entry, "tried")
    found = term_columns(term, rows_at(alone, samples))
    expected = exact_columns(alone, samples, entry, term.parameters)
    assert rms(found - expected) < 1e-3 * rms(expected)


def test_the_nine_columns_are_the_calibrations_own(flown):
    model, samples, rows = flown
    entry = model.effect("vector_sensor")
    values = np.concatenate(
        [entry.parameters[key].value[:, 0] for key in ("scale_factor", "misalignment", "offset")]
    )
    term = Term("vector_sensor", entry, ("scale_factor", "misalignment", "offset"), (1.0,) * 9)
    # Only the sensor's equation: what stands before it is nothing, what stands behind it adds nothing.
    alone = replace(model, effects=(entry,))
    rows = rows_at(alone, samples)
    found = term_columns(term, rows)[:, 0]
    reading = np.asarray(samples["vector"].values, dtype=np.float64)
    scalar = np.asarray(samples["scalar"].values, dtype=np.float64)
    expected = np.empty((len(reading), 10))
    theta, scale = matrix_parameters(values), kernel_scale(values)
    _fill(expected, theta, reading, np.zeros((1, 3)), scalar, np.inf, scale, 0)
    np.testing.assert_allclose(term.scale, PARAMETER_SCALE)
    size = np.abs(expected[:, :9]).max(axis=0)
    assert np.all(np.abs(found - expected[:, :9]) < 1e-6 * size)
    np.testing.assert_allclose(rows.residual[:, 0], expected[:, 9], atol=1e-6)


def test_a_column_says_what_a_change_of_the_parameter_does_to_the_residual(flown):
    """A stray field that is taken out lowers |B|: the sign of all columns."""
    _, _, rows = flown
    entry = make_effect({"effect": "remanent", "name": "tried", "sensor": "fgm"}, SENSORS, (), MISSION)
    found = term_columns(term_of(entry, "tried"), rows)[:, 0]
    field = rows.samples["field"].values
    np.testing.assert_allclose(found, -field / np.linalg.norm(field, axis=1, keepdims=True), atol=1e-9)
    bias = make_effect({"effect": "scalar_bias", "sensor": "ovm"}, SENSORS, (), MISSION)
    np.testing.assert_allclose(term_columns(term_of(bias, "bias"), rows), 1.0)


def test_an_injected_effect_leaves_minus_its_columns_times_its_size(flown):
    """y + X d is the residual after a change d: what is hidden is what must be added to the model."""
    model, _, rows = flown
    entry = make_effect(
        {"effect": "channel_field", "name": "hidden", "channel": "solar_current", "sensor": "fgm"},
        SENSORS,
        (),
        MISSION,
    )
    value = np.array([[2e-5], [-1e-5], [3e-5]])
    timed = replace(entry.parameters["coefficient"], value=value)
    read = model.add(entry.with_parameters({"coefficient": timed})).disturb(true_samples())
    # The scalar sensor hears of the changed direction only to second order.
    left = model.residual(read)[:, 0]
    columns = term_columns(term_of(entry, "hidden"), rows)[:, 0]
    np.testing.assert_allclose(left, -columns @ value[:, 0], atol=2e-3 * np.abs(left).max())


def test_missing_values_and_rows_without_weight_are_nought(flown):
    _, samples, rows = flown
    channel = np.array(samples["solar_current"].values, dtype=float)
    channel[10:20] = np.nan
    held = rows.samples.assign(solar_current=("time", channel, samples["solar_current"].attrs))
    weight = rows.weight.copy()
    weight[30:40] = 0.0
    entry = make_effect(
        {"effect": "channel_field", "channel": "solar_current", "sensor": "fgm"}, SENSORS, (), MISSION
    )
    found = design_matrix([term_of(entry, "tried")], replace(rows, samples=held, weight=weight))
    assert not found[10:20].any()
    assert not found[30:40].any()
    assert found[40:].any()
    assert isinstance(rows.samples, xr.Dataset)


def test_no_terms_are_no_columns(flown):
    _, _, rows = flown
    assert design_matrix([], rows).shape == (*rows.residual.shape, 0)


@pytest.mark.parametrize("fraction", [1.0, 0.5])
def test_products_made_a_stretch_at_a_time_are_those_of_all_columns_together(flown, fraction, monkeypatch):
    """Gaps of a channel, samples without weight, weights below one, a term's span, parts of any length."""
    _, samples, rows = flown
    channel = np.array(samples["solar_current"].values, dtype=float)
    channel[10:20] = np.nan
    held = rows.samples.assign(solar_current=("time", channel, samples["solar_current"].attrs))
    weight = np.where(np.arange(len(rows.weight)) % 7 == 0, fraction, rows.weight)
    weight[30:40] = 0.0
    residual = np.random.default_rng(3).normal(size=rows.residual.shape)
    rows = replace(rows, samples=held, weight=weight, residual=residual)
    entries = [
        make_effect({"effect": name, **options}, SENSORS, (), MISSION)
        for name, options in (*ADDITIVE[:4], *DIFFERENCED[:3])
    ]
    terms = [term_of(entry, f"tried{place}") for place, entry in enumerate(entries)]
    stamps = rows.samples["tt2000"].values
    terms[0] = replace(terms[0], span=(int(stamps[15]), int(stamps[45])))
    monkeypatch.setattr("inflight.design.columns._AT_ONCE", 13)
    parts = [slice(0, 37), slice(37, len(stamps))]
    made = gram_of(design_matrix(terms, rows), rows.residual[:, :, None], weight, parts)
    size = np.sqrt(np.einsum("pii->pi", made))
    error = np.abs(design_gram(terms, rows, parts) - made) / (size[:, :, None] * size[:, None, :] + 1e-300)
    assert error.max() < 1e-12
    assert size.all()
