"""A day of solar wind, ACE: zero offsets put in are recovered; their scatter falls with the hours used."""

import cdflib
import numpy as np
import pytest
from injections import REAL

from inflight.scorecard.zero_level_studies import PUBLISHED, scatter_with_hours
from inflight.zero_level import Intervals, combine_methods, davis_smith
from inflight.zero_level.methods import davis_smith_as_published, wang_pan

FOLDER = REAL / "ace-mfi-h0-20230102"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the folder of real measurements is absent: {FOLDER}"),
]
LENGTH = 900.0


@pytest.fixture(scope="module")
def record():
    field = np.asarray(cdflib.CDF(next(FOLDER.glob("*.cdf"))).varget("BGSEc"), dtype=np.float64)
    return 700_000_000 * 10**9 + np.arange(len(field)) * 16 * 10**9, field


@pytest.fixture(scope="module")
def as_delivered(record):
    times, field = record
    return combine_methods(Intervals.of(times, field, LENGTH))


def test_the_day_as_delivered_has_a_zero_level_of_a_tenth_of_a_nanotesla(as_delivered, record_property):
    record_property("told", as_delivered.summary())
    assert as_delivered.agrees
    assert as_delivered.kinds.alfvenic.mean() > 0.7
    assert np.abs(as_delivered.estimate.value).max() < 0.2
    assert as_delivered.estimate.sigma.max() < 0.07


@pytest.mark.parametrize("offset", [(1.0, -2.0, 1.5), (-1.0, 2.0, -1.5), (0.3, 0.3, -0.3)])
def test_an_offset_put_in_is_found_on_top_of_it(record, as_delivered, offset):
    times, field = record
    found = combine_methods(Intervals.of(times, field + np.array(offset), LENGTH))
    assert found.agrees
    moved = found.estimate.value - as_delivered.estimate.value
    # What is selected may differ by an interval: a small part of the error.
    np.testing.assert_allclose(moved, offset, atol=0.3 * float(found.estimate.sigma.max()))


def test_an_offset_that_turns_with_the_spacecraft_is_found_in_its_axes(record):
    times, field = record
    phase = 2 * np.pi * np.arange(times.size) / 23.7
    cos, sin = np.cos(phase), np.sin(phase)
    body = np.stack([cos * field[:, 0] + sin * field[:, 1], cos * field[:, 1] - sin * field[:, 0]], axis=1)
    turned = np.column_stack([body, field[:, 2]]) + np.array([1.0, -2.0, 1.5])
    found = davis_smith_as_published(Intervals.of(times, turned, LENGTH))
    np.testing.assert_allclose(found.solution[:2], [1.0, -2.0], atol=0.05)


def test_the_scatter_falls_with_the_root_of_the_hours(record, as_delivered, record_property):
    times, field = record
    intervals = Intervals.of(times, field, LENGTH)
    hours = np.array([5.0, 20.0, 40.0])
    for method in (davis_smith, wang_pan):
        found = scatter_with_hours(
            intervals, method, as_delivered.kinds.alfvenic, hours, np.random.default_rng(0), draws=30
        )
        size = np.sqrt(np.mean(found.scatter**2, axis=1))
        record_property(found.method, [round(float(one), 3) for one in size])
        assert np.all(found.determined_part > 0.5)
        assert size[0] / size[2] == pytest.approx(np.sqrt(8.0), rel=0.5)
        assert size[1] < PUBLISHED[0][1]
        assert size[2] < PUBLISHED[1][1]
