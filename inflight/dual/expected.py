"""The slopes of the stray field on a correction: as expected, as readings show them, and after both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from inflight.arrays import Floats
from inflight.dual.slow_part import WHOLE, Part

#: Slopes of several units on one scale differ by so much from those of one.
SCATTER = 0.2
#: Chance below which held-out readings are not of units in the body.
_REFUTED = 1e-6
#: Least part of a scale that passes as no noise.
_PASSED = 0.01


@dataclass(frozen=True)
class Seen:
    """Slopes of held-out outboard readings on a correction, scale by scale.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    slope, variance : ndarray, shape (scale,)
    ambient : ndarray, shape (scale, axis, axis)
        How much the slope changes with ambient field in the correction, a part of each axis of the field (the
        second axis here) in each of the correction (the first).
    """

    scale: npt.NDArray[np.int64]
    slope: Floats
    variance: Floats
    ambient: Floats

    @classmethod
    def nothing(cls) -> Seen:
        """Return what readings say that say nothing."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class Expected:
    """What geometry lets expect of one correction, for units at many places and sensors that wander.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    power : ndarray, shape (scale,)
        Mean square that the correction has there, nT^2 summed over axes.
    slope : ndarray, shape (scale, draw)
        Of the stray field on the correction.
    kept : mapping
        By the seconds of a `Part`: the product of the part with the whole correction on each scale, and its
        square, beside `power`; each (scale,).
    leak : ndarray, shape (draw, axis, axis), optional
        Ambient field that is in the correction because its fitted leak is not right.
    passed : ndarray, shape (scale,), optional
        Part g of the difference that is not taken for noise on each scale. By James and Stein's rule signal P
        in noise N leaves g = (P - N) / (P + N), and P / (g (P + N)) = (1 + g) / 2 g is the signal's slope.
    """

    scale: npt.NDArray[np.int64]
    power: Floats
    slope: Floats
    kept: Mapping[float, tuple[Floats, Floats]] = field(default_factory=dict)
    leak: Floats | None = None
    passed: Floats | float = 1.0

    def after(self, seen: Seen) -> Posterior:
        """Return what to expect after held-out readings."""
        return Posterior(self, seen)

    def parts(self, part: Part) -> tuple[Floats, Floats]:
        """Return the product of a part with the whole correction, and its square; each (scale,), nT^2."""
        product, square = self.kept[part.seconds] if part.seconds else (1.0, 1.0)
        return np.asarray(part.share * product * self.power), np.asarray(part.share**2 * square * self.power)

    def benefit(self, part: Part, scales: npt.NDArray[np.bool_] | slice = slice(None)) -> Floats:
        """Return the fall of the mean square error by a part of the correction; (draw,), nT^2."""
        product, square = self.parts(part)
        return np.asarray(2.0 * product[scales] @ self.slope[scales] - square[scales].sum())


@dataclass(frozen=True)
class Posterior:
    """What to expect of a correction after held-out readings."""

    expected: Expected
    seen: Seen

    @cached_property
    def misfit(self) -> Floats:
        """The sum of squares of what held-out readings say less what is expected, (draw,)."""
        expected, seen = self.expected, self.seen
        _, own, other = np.intersect1d(expected.scale, seen.scale, return_indices=True)
        variance = seen.variance[other] + SCATTER**2
        passed = np.broadcast_to(expected.passed, expected.scale.shape)[own, None]
        slope, found = expected.slope[own], seen.slope[other, None]
        if expected.leak is not None:
            # The outboard reading goes with its own ambient field: that looks like stray field.
            found = found - passed * np.einsum("dij,sij->sd", expected.leak, seen.ambient[other])
        # What was taken for noise may be stray field: the correction is then too small by so much.
        most = slope * (1.0 + passed) / (2.0 * np.maximum(passed, _PASSED))
        away = found - np.clip(found, np.minimum(slope, most), np.maximum(slope, most))
        return np.asarray(np.sum(away**2 / variance[:, None], axis=0))

    @cached_property
    def weights(self) -> Floats:
        """How likely each draw is; (draw,)."""
        weight = np.exp(-0.5 * (self.misfit - self.misfit.min()))
        return np.asarray(weight / weight.sum())

    @property
    def refuted(self) -> bool:
        """Whether no place in the body makes what held-out readings say."""
        count = self.seen.scale.size
        return bool(count) and float(chi2.sf(self.misfit.min(), count)) < _REFUTED

    @cached_property
    def draws(self) -> float:
        """How many draws of the same weight tell as much."""
        return 1.0 / float(np.sum(self.weights**2))

    def chance_of_harm(self, part: Part = WHOLE) -> float:
        """Return the probability that taking off a part makes the error larger.

        It is not less than one in so many draws as are left: where hardly one is, nothing is sure.
        """
        harm = float(self.weights @ (self.expected.benefit(part) <= 0.0))
        return min(harm + 1.0 / self.draws, 1.0)

    def benefit(self, part: Part = WHOLE) -> float:
        """Return the mean fall of the mean square error by taking off a part, nT^2."""
        return float(self.expected.benefit(part) @ self.weights)

    def quick_benefit(self, part: Part = WHOLE) -> float:
        """Return the part of `benefit` on the scales that are seen, nT^2.

        On slower ones it is not told how much of a correction is the sensors' own.
        """
        own = np.isin(self.expected.scale, self.seen.scale)
        return float(self.expected.benefit(part, own) @ self.weights)

    def away(self, part: Part = WHOLE) -> float:
        """Return how far a part's share is from the slope of the stray field on it, rms.

        Both without what is slow: that of the stray field is left alone, too.
        """
        _, square = self.expected.parts(part)
        slope = square @ self.expected.slope / max(float(square.sum()), 1e-300)
        return float(np.sqrt(self.weights @ (slope - part.share) ** 2))
