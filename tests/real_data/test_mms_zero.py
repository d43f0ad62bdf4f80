"""Two hours around the magnetosheath, MMS 1 (16 Hz): compressions and rotations, which tell no zero level."""

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


def test_two_hours_tell_no_zero_level_however_well_methods_agree(as_delivered, record_property):
    record_property("told", as_delivered.summary())
    assert as_delivered.agrees
    assert as_delivered.kinds.compressional.sum() > 30
    for one in as_delivered.methods:
        assert np.all(np.abs(one.value)[one.determined] < 3 * one.sigma[one.determined])
    # Other offsets in the cube of the bound are as likely.
    assert not as_delivered.estimate.determined.any()
    assert "are not refused" in as_delivered.estimate.reasons[-1]


def test_each_method_moves_by_an_offset_put_in(record, as_delivered):
    times, field = record
    offset = np.array([0.5, -0.5, 0.5])
    found = combine_methods(Intervals.of(times, field + offset, LENGTH))
    assert not found.estimate.determined.any()
    assert [one.method for one in found.methods] == [one.method for one in as_delivered.methods]
    for one, before in zip(found.methods, as_delivered.methods, strict=True):
        both = one.determined & before.determined
        assert both.sum() >= 2
        np.testing.assert_allclose((one.value - before.value)[both], offset[both], atol=0.05)
