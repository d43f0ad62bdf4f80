"""Solar wind and magnetosheath of MMS 1, spun again with known angles: are they found within their sigmas?"""

import os
from pathlib import Path

import numpy as np
import pytest
from farrell_cases import TURN, sensors, truth_of

from inflight.spin import calibrate_farrell, check_period, fit_spins, respin
from inflight.time import SECOND

ROOT = Path(__file__).parents[2]
FOLDER = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
FILE = FOLDER / "mms1-fgm-srvy-20190601" / "mms1_fgm_srvy_l2_gsm_20190601T2300_20190602T0100.npz"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FILE.exists(), reason=f"no real measurements at {FILE}"),
]


def turned(seed):
    """A rotation: another direction of the spin axis in the same field."""
    axes = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return axes * np.sign(np.linalg.det(axes))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("period", [3.0, 20.0])
def test_known_angles_are_found_in_a_real_field_that_is_spun_again(period, sign):
    with np.load(FILE) as held:
        seconds, field = held["unix_time_s"], held["B_GSM_nT"][:, :3]
    stamps = np.rint((seconds - seconds[0]) * SECOND).astype(np.int64)
    phase = TURN * (seconds - seconds[0]) / period
    angles, pulls = sensors(sign), []
    for seed in range(6):
        readings = angles.disturb(respin(field @ turned(seed).T, phase))
        found = calibrate_farrell(fit_spins(stamps, readings, phase), spin_axis_zero=(0.0, 0.0))
        zero = (found.intercepts.zero[0] - angles.zero[:2]) / found.intercepts.sigma[0]
        pulls.append([*(found.value - truth_of(angles)) / found.sigma, *zero])
    assert np.abs(pulls).max() < 4.0
    # Orientations of one field are not independent: half within one sigma is the least to ask.
    assert np.mean(np.abs(pulls) < 1) > 0.45
    assert check_period(stamps, readings, phase).agrees
    assert not check_period(stamps, readings, 1.02 * phase).agrees
