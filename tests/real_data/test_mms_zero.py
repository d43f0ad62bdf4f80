"""Two hours around the magnetosheath, MMS 1 (16 Hz): compressions and rotations; offsets put in are found."""

import numpy as np
import pytest
from injections import REAL

from inflight.zero_level import Intervals, combine_methods

FOLDER = REAL / "mms1-fgm-srvy-20190601"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the folder of real measurements is absent: {FOLDER}"),
]
LENGTH = 60.0


@pytest.fixture(scope="module")
def record():
    held = np.load(next(FOLDER.glob("*.npz")))
    seconds = held["unix_time_s"] - held["unix_time_s"][0]
    return 700_000_000 * 10**9 + (seconds * 1e9).astype(np.int64), held["B_GSM_nT"]


@pytest.fixture(scope="module")
def as_delivered(record):
    return combine_methods(Intervals.of(*record, LENGTH))


def test_the_record_as_delivered_has_no_zero_level_that_two_hours_could_tell(as_delivered, record_property):
    record_property("told", as_delivered.summary())
    assert as_delivered.agrees
    assert as_delivered.kinds.compressional.sum() > 30
    told = as_delivered.estimate.determined
    assert told.any()
    assert np.all(np.abs(as_delivered.estimate.value[told]) < 3 * as_delivered.estimate.sigma[told])


@pytest.mark.parametrize("offset", [(0.5, -0.5, 0.5), (1.0, -2.0, 1.5)])
def test_an_offset_put_in_is_found_or_said_to_be_doubtful(record, as_delivered, offset):
    times, field = record
    found = combine_methods(Intervals.of(times, field + np.array(offset), LENGTH))
    moved = found.estimate.value - as_delivered.estimate.value
    both = found.estimate.determined & as_delivered.estimate.determined
    assert both.any()
    sigma = np.hypot(found.estimate.sigma, as_delivered.estimate.sigma)
    assert np.all(np.abs(moved - offset)[both] < 2 * sigma[both])
