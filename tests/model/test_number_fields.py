"""What one sigma of a number does to the corrected field is the difference of two corrections."""

import numpy as np
import pytest
from effect_cases import PLACES, entry_of, model_of, true_samples

from inflight.model import correct_plain, number_fields

#: Sizes of a change: large enough to be told from rounding.
_SIGMA = 1e-3


def as_array(change, count):
    return np.stack([np.zeros(count) if one is None else one for one in change], axis=1)


def corrected(effects, samples):
    return np.asarray(correct_plain(effects, samples)["field"].values)


@pytest.mark.parametrize("time", ["constant", "linear"])
@pytest.mark.parametrize("name", sorted(name for name, place in PLACES.items() if place[0] == "fgm"))
def test_a_number_changes_the_field_as_two_corrections_differ(name, time):
    generator, samples = np.random.default_rng(7), true_samples()
    ahead = [] if name == "vector_sensor" else [entry_of("vector_sensor", generator)]
    # What adds a field stands behind the sensor's equation, all else before it.
    model = model_of(entry_of(name, generator, time), *ahead)
    if model.effects[0].is_additive:
        model = model_of(*ahead, entry_of(name, generator, time))
    place = next(place for place, entry in enumerate(model.effects) if entry.effect.label() == name)
    entry, before = model.effects[place], corrected(model.effects, samples)
    columns = {
        column: float(value)
        for timed in entry.parameters.values()
        for column, value in zip(timed.columns, timed.value.ravel(), strict=True)
    }
    found = number_fields(model.effects, samples, dict.fromkeys(columns, _SIGMA))
    assert set(found) == set(columns)
    for column, value in columns.items():
        moved = list(model.effects)
        moved[place] = entry.with_columns({column: value + _SIGMA}, {})
        expected = corrected(moved, samples) - before
        # A change below a tenth of a picotesla is none.
        np.testing.assert_allclose(
            as_array(found[column], len(before)), expected, rtol=1e-6, atol=1.01e-4, err_msg=column
        )


@pytest.mark.parametrize("name", ["torquer", "channel_field", "sun_direction_field"])
def test_where_a_channel_is_missing_only_these_samples_have_no_change(name):
    generator, samples = np.random.default_rng(3), true_samples()
    for channel in ("torquer_current", "solar_current", "sun_direction"):
        samples[channel].values[10:20] = np.nan
    model = model_of(entry_of("vector_sensor", generator), entry_of(name, generator))
    columns = [column for timed in model.effects[1].parameters.values() for column in timed.columns]
    found = number_fields(model.effects, samples, dict.fromkeys(columns, 1.0))
    changes = np.stack([as_array(found[column], samples.sizes["time"]) for column in columns])
    assert np.isfinite(changes).all()
    assert not changes[:, 10:20].any()
    assert changes[:, 20:].any()


def test_between_the_samples_it_is_computed_at_a_change_is_drawn_straight():
    samples = true_samples(count=6000)
    # A field as smooth as an orbit's: 1440 samples and more are all that is asked of it.
    turn = np.linspace(0, 2 * np.pi, 6000)
    samples["vector"].values[:] = 30_000 * np.stack([np.cos(turn), np.sin(turn), np.cos(turn + 1)], axis=1)
    model = model_of(entry_of("nonlinearity", np.random.default_rng(1)))
    entry, before = model.effects[0], corrected(model.effects, samples)
    column = entry.parameters["quadratic"].columns[0]
    size = 1e-9
    found = as_array(number_fields(model.effects, samples, {column: size})[column], 6000)
    moved = entry.with_columns({column: float(entry.parameters["quadratic"].value[0, 0]) + size}, {})
    expected = corrected([moved], samples) - before
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
