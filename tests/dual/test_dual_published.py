"""How a published field was made of two sensors comes back within its errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from inflight.errors import CalibrationError
from inflight.time import SECOND
from tests.real_data.published_states import relation_to_published


def record(seed, k=0.8, seconds=3600, noise=0.02, stray=1.0):
    """A product of 1 Hz made of two sensors in axes of their own; its noise is coloured."""
    random = np.random.default_rng(seed)
    stamps = np.arange(seconds, dtype=np.int64) * SECOND
    slow = np.cumsum(random.normal(size=(seconds, 6)), axis=0) / np.sqrt(seconds)
    ambient = 20.0 * slow[:, :3] + [60.0, -20.0, 90.0]
    source = stray * slow[:, 3:] + 5.0
    r_out, r_in = Rotation.random(2, random_state=seed)
    outer = r_out.inv().apply(ambient + source * k / (1.0 + k))
    inner = r_in.inv().apply(ambient + source)
    errors = np.zeros((seconds, 3))
    for row in range(1, seconds):
        errors[row] = 0.8 * errors[row - 1] + 0.6 * noise * random.normal(size=3)
    return stamps, inner, outer, ambient + errors + [0.1, -0.2, 0.3], (k, r_out, r_in)


def test_coefficient_rotations_and_constant_come_back_within_their_errors():
    pulls = []
    for seed in range(25):
        stamps, inner, outer, published, (k, r_out, r_in) = record(seed)
        found = relation_to_published(stamps, inner, outer, published)
        turn_out = Rotation.from_matrix(found.outboard @ r_out.inv().as_matrix()).as_rotvec()
        turn_in = Rotation.from_matrix(found.inboard @ r_in.inv().as_matrix()).as_rotvec()
        pulls.append(
            np.concatenate(
                [
                    [(found.coefficient - k) / found.coefficient_sigma],
                    turn_out / found.outboard_sigma,
                    turn_in / found.inboard_sigma,
                    (found.constant - [0.1, -0.2, 0.3]) / found.constant_sigma,
                ]
            )
        )
    inside = np.mean(np.abs(pulls) < 1.0)
    assert 0.5 < inside < 0.85
    assert np.mean(np.abs(pulls) < 3.0) > 0.97


def test_missing_readings_and_gaps_change_little():
    stamps, inner, outer, published, (k, *_) = record(3)
    kept = np.ones(stamps.size, dtype=bool)
    kept[900:1300] = False
    outer[2000:2050] = np.nan
    found = relation_to_published(stamps[kept], inner[kept], outer[kept], published[kept])
    assert abs(found.coefficient - k) < 4 * found.coefficient_sigma
    assert found.distance_ratio_cubed == pytest.approx(1 + 1 / found.coefficient)


def test_a_short_record_is_refused():
    stamps, inner, outer, published, _ = record(1, seconds=300)
    with pytest.raises(CalibrationError, match="stretches"):
        relation_to_published(stamps, inner, outer, published)
