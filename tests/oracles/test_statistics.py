"""Statistics against statsmodels."""

import numpy as np
import pytest
from statsmodels.stats.multitest import multipletests

from inflight.mission_fit.parameter_series import holm


@pytest.mark.parametrize("seed", range(5))
def test_chances_among_many_are_those_of_statsmodels(seed):
    chance = np.random.default_rng(seed).uniform(0.0, 0.2, 12)
    np.testing.assert_allclose(holm(chance), multipletests(chance, method="holm")[1], rtol=1e-12)
