"""What geometry lets expect of a correction, before the outboard reading is asked.

All units stand in the spacecraft's body. Each place in it takes the difference of both sensors to the
outboard sensor by a matrix of its own; none of them makes a stray field that a correction of about the right
size would not lower. What is not a spacecraft's field in the difference is set against it: white noise, what
the sensors wander by themselves, and ambient field that leaks in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from inflight.arrays import Floats
from inflight.dual.correction import WHOLE, Correction, Part, slow_part
from inflight.dual.moments import Noise
from inflight.dual.readings import Readings
from inflight.dual.scales import Cells, cells_of, contrasts
from inflight.dual.wander import DRIFT, drift_in, drift_of_contrast, flicker_of_contrast, wanderings
from inflight.time import SECOND

#: The longest blocks are this part of the record; cells that tell the quiet level of a scale.
_LONGEST, _QUIET_CELLS = 2, 6
#: Blocks of switchings are at most this part of the record.
_QUICK = 64
_QUIET = 0.25
#: Slopes of several units on one scale differ by so much from those of one.
SCATTER = 0.2
#: Draws of the sensors' wandering for each place.
_TURNS = 5
#: Part of the drift of both sensors that is the outboard one's: two straight lines, each as likely to rise as
#: to fall; mean and standard deviation.
_OUTBOARD = (0.5, 0.5)
#: Sensors differ in how far they drift: the size is Student's t of so many degrees of freedom.
_TAIL = 3.0
#: Parts of the record that corrections are cut at, and the narrowest such width, samples.
CUTS, _NARROWEST = (4, 8, 16, 32, 64, 128, 256), 8
#: Chance below which held-out readings are not of units in the body.
_REFUTED = 1e-6


@dataclass(frozen=True)
class Seen:
    """Slopes of held-out outboard readings on a correction, scale by scale.

    Attributes
    ----------
    scale : ndarray of int64, shape (scale,)
    slope, variance : ndarray, shape (scale,)
    """

    scale: npt.NDArray[np.int64]
    slope: Floats
    variance: Floats


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
        By the width in samples that a correction is cut at, see `Correction.quicker`: its product with the
        whole correction on each scale, and its square, beside `power`; each (scale,).
    """

    scale: npt.NDArray[np.int64]
    power: Floats
    slope: Floats
    kept: Mapping[int, tuple[Floats, Floats]]

    @property
    def whole(self) -> Floats:
        """Slope over all scales in each draw; (draw,)."""
        return np.asarray(self.power @ self.slope / max(float(self.power.sum()), 1e-300))

    def misfit(self, seen: Seen) -> Floats:
        """Return the sum of squares of what held-out readings say less what is expected, (draw,)."""
        _, own, other = np.intersect1d(self.scale, seen.scale, return_indices=True)
        variance = seen.variance[other] + SCATTER**2
        away = self.slope[own] - seen.slope[other, None]
        return np.asarray(np.sum(away**2 / variance[:, None], axis=0))

    def refuted_by(self, seen: Seen) -> bool:
        """Whether no place in the body makes what held-out readings say."""
        return bool(seen.scale.size) and float(chi2.sf(self.misfit(seen).min(), seen.scale.size)) < _REFUTED

    def benefit(self, part: Part) -> Floats:
        """Return the fall of the mean square error on each scale by a part of the correction; (scale, draw)."""
        product, square = self.kept[part.width] if part.width else (1.0, 1.0)
        fall = 2.0 * part.share * np.multiply(product, self.power)[:, None] * self.slope
        return np.asarray(fall - part.share**2 * np.multiply(square, self.power)[:, None])

    def chance_of_harm(self, seen: Seen, part: Part = WHOLE) -> float:
        """Return the probability that taking off a part makes the error larger, after held-out readings."""
        return float(self.weights(seen) @ (self.benefit(part).sum(axis=0) <= 0.0))

    def mean_benefit(self, seen: Seen, part: Part = WHOLE) -> float:
        """Return the fall of the mean square error by taking off a part, after held-out readings, nT^2."""
        return float(self.benefit(part).sum(axis=0) @ self.weights(seen))

    def quick_benefit(self, seen: Seen, part: Part = WHOLE) -> float:
        """Return the part of `mean_benefit` on the scales that are seen, nT^2.

        On slower ones it is not told how much of a correction is the sensors' own.
        """
        own = np.isin(self.scale, seen.scale)
        return float(self.benefit(part)[own].sum(axis=0) @ self.weights(seen))

    def away(self, seen: Seen, share: float) -> float:
        """Return how far the slope is from a share, rms, after held-out readings."""
        return float(np.sqrt(self.weights(seen) @ (self.whole - share) ** 2))

    def weights(self, seen: Seen) -> Floats:
        """Return how likely each draw is after held-out readings; (draw,)."""
        misfit = self.misfit(seen)
        weight = np.exp(-0.5 * (misfit - misfit.min()))
        return np.asarray(weight / weight.sum())


@dataclass(frozen=True)
class Expectation:
    """What is known before the outboard reading is asked.

    Attributes
    ----------
    matrices : ndarray, shape (place, 3, 3)
        What takes the difference to the outboard sensor, for places all over the body.
    stray : ndarray, shape (time, axis)
        The difference without white noise and what it holds of the ambient field, nT; NaN where a sensor is
        missing. Less noise is left in it than was taken out of the stray field: slopes are rather larger.
    noise : Noise
        Its white noise, and how much of that is the outboard sensor's.
    leak_covariance : ndarray, shape (9, 9)
        Of what is not known of the leak.
    units : str
        Where the units are taken to stand.
    drift : float
        How far the sensors drift apart by themselves in an hour, nT.
    """

    matrices: Floats
    stray: Floats
    noise: Noise
    leak_covariance: Floats
    units: str = "all units in the body"
    drift: float = DRIFT

    def of(self, readings: Readings, correction: Correction) -> Expected:
        """Return what to expect of a correction of the same readings.

        What comes and goes with the states is stray field: its slope is that of the switchings on all scales,
        because what the sensors wander between two of them is in neither. The rest may be the sensors' own.
        """
        good = readings.good
        field = np.nan_to_num(correction.field[good], nan=0.0)
        stepped = _by_state(field, correction.state[good])
        cells = cells_of(
            readings.outboard[good], self.stray[good], stepped, field - stepped, longest=_LONGEST
        )
        number = int(good.sum())
        # How large noise, drift and leak are beside what is usual of them, in power.
        random = np.random.default_rng(2)
        shape = (len(self.matrices), _TURNS)
        turns = random.normal(size=(4, *shape))
        turns[1] = random.standard_t(_TAIL, shape)
        turns[:3] **= 2
        turns[3] = _OUTBOARD[0] + _OUTBOARD[1] * turns[3]
        scales = np.unique(cells.scale)
        quick = self._slopes(cells.part(cells.scale <= max(number // _QUICK, 1)), slice(6, 9))[:, None]
        follow = self._in_states(readings, correction.state[good])
        power, slope = np.zeros(scales.size), np.zeros((scales.size, len(self.matrices), _TURNS))
        for place, scale in enumerate(scales.tolist()):
            here = cells.part(cells.scale == scale)
            taken = here.covariance[:, 6:, 6:].reshape(-1, 2, 3, 2, 3)
            total, *parts = (
                max(float(np.einsum("c,cii->", here.count, one)), 1e-300)
                for one in (taken.sum(axis=(1, 3)), taken[:, 0, :, 0], taken[:, 1, :, 1])
            )
            power[place] = total / here.count.sum() / (2.0 * float(scale))
            others = self._slopes(here, slice(9, 12))[:, None]
            lost = self._lost(self._usual(here, readings), turns, self._size(here.covariance[:, 3:6, 3:6]), here)
            rest = _without(others, *lost)
            by_state = quick
            if follow is not None:
                wander = follow(scale) * here.count.sum()
                part = np.clip(np.einsum("k,kpt->pt", wander, turns[:3]) / parts[0], 0.0, 1.0)
                share = (wander[0] * turns[0] * self.noise.share + wander[1] * turns[1] * turns[3]) / parts[0]
                share = np.clip(share, -1, 1)
                by_state = _without(quick, part, share / self._factor)
            slope[place] = (by_state * parts[0] + rest * parts[1]) / total
        # What changes more slowly than any contrast.
        power[-1] += max(float(np.var(field, axis=0).sum() - power.sum()), 0.0)
        return Expected(scales, power, slope.reshape(scales.size, -1), _kept(field, scales))

    @property
    def _factor(self) -> float:
        """Size of the mean matrix."""
        return float(np.sqrt(np.sum(self.matrices.mean(axis=0) ** 2) / 3.0))

    def _in_states(self, readings: Readings, state):
        """Return what of the sensors' wandering and the leak comes into means of the states."""
        if not np.any(state >= 0):
            return None
        good = readings.good
        count = int(good.sum())
        drift_size = drift_in((readings.stamps[-1] - readings.stamps[0]) / SECOND, self.drift)
        drift, flicker = wanderings(count)
        made = _by_state(np.column_stack([flicker, drift, readings.outboard[good]]), state)
        noise, one = self._size(self.noise.covariance[None])[0], self._size(np.eye(3)[None])[0]
        leak = self.leak_covariance.reshape(3, 3, 3, 3)

        def follow(scale: int):
            values = contrasts(made, scale)[0]
            square = np.mean(values**2, axis=0)
            line_and_walk = square[4] + square[5:9].mean()
            ambient = values[:, 9:].T @ values[:, 9:] / len(values)
            through = self._size(np.einsum("iajb,ab->ij", leak, ambient)[None])[0]
            return np.array([noise * square[:4].mean(), one * drift_size**2 * line_and_walk, through])

        return follow

    def _slopes(self, cells: Cells, part: slice) -> Floats:
        """Return the slopes of what matrices make of the difference on a part of the correction; (place,)."""
        across = np.einsum("c,cij->ij", cells.count, cells.covariance[:, 3:6, part])
        total = float(np.einsum("c,cii->", cells.count, cells.covariance[:, part, part]))
        return np.asarray(np.einsum("pji,ij->p", self.matrices, across) / max(total, 1e-300))

    def _usual(self, cells: Cells, readings: Readings) -> Floats:
        """Return the usual power of flicker noise, drift, and ambient field that leaks in; (3,)."""
        power = self._size(cells.covariance[:, 3:6, 3:6])
        count, block = int(readings.good.sum()), int(cells.scale[0])
        drift = drift_in((readings.stamps[-1] - readings.stamps[0]) / SECOND, self.drift)
        leak = self.leak_covariance.reshape(3, 3, 3, 3)
        through = self._size(np.einsum("iajb,cab->cij", leak, cells.covariance[:, :3, :3]))
        return np.array([
            self._size(self.noise.covariance[None])[0] * flicker_of_contrast(block, count),
            self._size(np.eye(3)[None])[0] * drift_of_contrast(block, count, drift),
            float(cells.count @ through) / cells.count.sum(),
        ])

    def _lost(self, usual: Floats, turns: Floats, power, cells: Cells) -> tuple[Floats, Floats]:
        """Return which part of the difference is no stray field, and what that adds; each (place, turn).

        Flicker noise, drift of the offsets, and ambient field that leaks in: `turns` (4, place, turn) times
        what is usual of them, and the outboard sensor's part of the drift. Of that sensor's own noise n the
        difference holds -n: the correction M d of power P adds to the error by <n M n> / P, a part of the
        lost power over M.
        """
        total = max(float(cells.count @ power), 1e-300)
        # Sensors wander all the time: no more than in a quiet stretch.
        most = float(np.quantile(power, _QUIET)) if len(cells) >= _QUIET_CELLS else np.inf
        here = cells.count.sum()
        parts = [np.minimum(one * turn, most) * here for one, turn in zip(usual[:2], turns[:2], strict=True)]
        parts.append(turns[2] * usual[2] * here)
        lost = np.array(parts) / total
        lost /= np.maximum(lost.sum(axis=0), 1.0)
        outboard = self.noise.share * lost[0] + turns[3] * lost[1]
        return np.asarray(lost.sum(axis=0)), np.asarray(outboard / self._factor)

    def _size(self, covariance: Floats) -> Floats:
        """Return the power at the outboard sensor of covariances of the difference (cell, 3, 3)."""
        middle = self.matrices.mean(axis=0)
        return np.asarray(np.einsum("ki,cij,kj->c", middle, covariance, middle))


def _without(slope: Floats, lost: Floats, added: Floats) -> Floats:
    """Return the slope of a part of which something is lost.

    Where the correction is against the units' field, it is no merit that it is for a sensor's noise: that
    would be the inboard reading in the outboard one's place.
    """
    return np.asarray(slope * (1.0 - lost) - np.abs(slope) * added)


def _kept(field: Floats, scales: npt.NDArray[np.int64]) -> dict[int, tuple[Floats, Floats]]:
    """Return what is left of a correction on each scale when it is cut at each of the widths."""
    widths = [len(field) // part for part in CUTS if len(field) // part >= _NARROWEST]
    cut = np.stack([field, *(field - slow_part(field, width) for width in widths)], axis=2)
    product, square = np.ones((2, scales.size, len(widths) + 1))
    for place, scale in enumerate(scales.tolist()):
        values = contrasts(cut.reshape(len(cut), -1), scale)[0].reshape(-1, *cut.shape[1:])
        power = max(float(np.sum(values[:, :, 0] ** 2)), 1e-300)
        product[place] = np.einsum("tak,ta->k", values, values[:, :, 0]) / power
        square[place] = np.sum(values**2, axis=(0, 1)) / power
    return {width: (product[:, k + 1], square[:, k + 1]) for k, width in enumerate(widths)}


def _by_state(values: Floats, state: npt.NDArray[np.int64]) -> Floats:
    """Return the part of values (time, column) that is the same whenever a state comes again.

    What sensors do by themselves does not come and go with a state: only the rest may be that.
    """
    told = np.flatnonzero(state >= 0)
    if not told.size:
        return np.zeros_like(values)
    # While a state passes or is unknown that before it goes on: no steps are made that nobody took.
    last = np.maximum(np.searchsorted(told, np.arange(state.size), side="right") - 1, 0)
    _, place = np.unique(state[told], return_inverse=True)
    count = np.bincount(place)
    columns = range(values.shape[1])
    mean = np.stack([np.bincount(place, values[told, column]) / count for column in columns], axis=1)
    return np.asarray(mean[place[last]])
