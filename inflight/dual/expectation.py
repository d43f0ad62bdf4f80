"""What geometry lets expect of a correction, before the outboard reading is asked.

All units stand in the spacecraft's body. Each place in it takes the difference of both sensors to the
outboard sensor by a matrix of its own; none of them makes a stray field that a correction of about the right
size would not lower. What is not a spacecraft's field in the difference is set against it: white noise, what
the sensors wander by themselves, and ambient field that leaks in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.bands import without_noise
from inflight.dual.correction import Correction
from inflight.dual.expected import Expected
from inflight.dual.moments import Noise
from inflight.dual.readings import Readings
from inflight.dual.scales import Cells, cells_of, contrasts, running_sums, scales_of
from inflight.dual.slow_part import slow_part
from inflight.dual.wander import DRAWS, DRIFT, TAIL, drift_in, wandering
from inflight.time import SECOND

#: The longest blocks are this part of the record; cells that tell the quiet level of a scale.
_LONGEST, _QUIET_CELLS = 2, 6
#: Blocks of switchings are at most this part of the record.
_QUICK = 64
_QUIET = 0.25
#: Draws of the sensors' wandering for each place: chances of one in a thousand are told from some hundreds of
#: draws that held-out readings leave.
_TURNS = 60
#: Part of the drift of both sensors that is the outboard one's: two straight lines, each as likely to rise as
#: to fall; mean and standard deviation.
_OUTBOARD = (0.5, 0.5)
#: Parts of the record that corrections are cut at, and the narrowest such width, samples.
CUTS, _NARROWEST = (4, 8, 16, 32, 64, 128, 256), 8


@dataclass(frozen=True)
class Lost:
    """What of the difference is no stray field: flicker noise, drift, ambient field that leaks in.

    Attributes
    ----------
    part : ndarray, shape (place, turn)
        Of the difference's power.
    added : ndarray, shape (place, turn)
        What the outboard sensor's own noise n adds to the error: the difference holds -n, and a correction
        M d of power P adds <n M n> / P.
    """

    part: Floats
    added: Floats

    def apart(self) -> Lost:
        """Return the same with other turns: what it is tells nothing of those that had them."""
        return Lost(np.roll(self.part, 1, axis=1), np.roll(self.added, 1, axis=1))

    def less(self, slope: Floats) -> Floats:
        """Return what is left of slopes (place, 1); (place, turn).

        Where the correction is against the units' field, it is no merit that it is for a sensor's noise: that
        would be the inboard reading in the outboard one's place.
        """
        return np.asarray(slope * (1.0 - self.part) - np.abs(slope) * self.added)


@dataclass(frozen=True)
class Expectation:
    """What is known before the outboard reading is asked.

    Attributes
    ----------
    readings : Readings
    matrices : ndarray, shape (place, 3, 3)
        What takes the difference to the outboard sensor, for places all over the body.
    stray : ndarray, shape (time, axis)
        The difference without what it holds of the ambient field, nT; NaN where a sensor is missing.
    noise : Noise
        Its white noise, and how much of that is the outboard sensor's.
    leak_covariance : ndarray, shape (9, 9)
        Of what is not known of the leak.
    units : str
        Where the units are taken to stand.
    drift : float
        How far the sensors drift apart by themselves in an hour, nT.
    """

    readings: Readings
    matrices: Floats
    stray: Floats
    noise: Noise
    leak_covariance: Floats
    units: str = "all units in the body"
    drift: float = DRIFT

    def of(self, correction: Correction) -> Expected:
        """Return what to expect of a correction of the readings.

        What comes and goes with the states has the slope of the switchings on all scales: of what the
        sensors wander by themselves it holds as much as comes into means over each state.
        """
        good = self.readings.good
        taken, state = np.nan_to_num(correction.field[good], nan=0.0), correction.state[good]
        stray, both = self._clear, self._difference
        stepped, both_stepped = by_state(state, taken), by_state(state, both)
        cells = cells_of(self.readings.outboard[good], stray, stepped, taken - stepped, longest=_LONGEST)
        quick = cells.part(cells.scale <= max(len(taken) // _QUICK, 1))
        switched = self._slopes(quick, slice(6, 9))[:, None]
        if np.any(state >= 0):
            # How much of it comes into the states' means, their quick scales do not tell of the slow rest.
            lost_stepped = {scale: one.apart() for scale, one in self._lost(both_stepped).items()}
            lost = self._lost(both - both_stepped, most=self._quiet)
        else:
            lost = lost_stepped = self._lost_without_states
        scales = np.unique(cells.scale)
        power, slope = np.zeros(scales.size), []
        for place, scale in enumerate(scales.tolist()):
            here = cells.part(cells.scale == scale)
            total, *parts = _powers(here)
            power[place] = total / (2.0 * float(scale))
            rest = lost[scale].less(self._slopes(here, slice(9, 12))[:, None])
            slope.append((lost_stepped[scale].less(switched) * parts[0] + rest * parts[1]) / total)
        # What changes more slowly than any contrast.
        power[-1] = max(float(np.var(taken, axis=0).sum() - power[:-1].sum()), 0.0)
        drawn = np.reshape(slope, (scales.size, -1))
        passed = np.array([self._passed[scale] for scale in scales.tolist()])
        # States follow the outboard reading's own steps.
        leak = None if correction.method == "states" else self._leaks.reshape(-1, 3, 3)
        return Expected(scales, power, drawn, _kept(taken, scales, self.readings), leak, passed)

    @cached_property
    def _clear(self) -> Floats:
        """The stray part of the difference without white noise where both sensors are; (time, axis), nT.

        Less noise is left in it than was taken out of the stray field: slopes are rather larger.
        """
        return without_noise(self.stray[self.readings.good], self.noise.covariance)[0]

    @cached_property
    def _passed(self) -> dict[int, float]:
        """Part of the difference's changes that is not taken for noise, by scale."""
        sums = running_sums(np.concatenate([self.stray[self.readings.good], self._clear], axis=1))
        found = {}
        for scale in scales_of(len(sums) - 1, _LONGEST):
            whole, clear = np.split(contrasts(sums, scale)[0], 2, axis=1)
            found[scale] = float(np.sum(whole * clear)) / max(float(np.sum(whole**2)), 1e-300)
        return found

    @cached_property
    def _difference(self) -> Floats:
        """The stray part of the difference, and what else may be in it; (time, column), nT.

        Columns: three axes of the stray part, three of white noise that was left in it, three of the ambient
        field, and the size at the outboard sensor of a line and of draws of a walk and of flicker noise.
        """
        readings, good = self.readings, self.readings.good
        count = int(good.sum())
        noise = self.noise.covariance
        white = np.random.default_rng(6).multivariate_normal(np.zeros(3), noise, count)
        far = drift_in((readings.stamps[-1] - readings.stamps[0]) / SECOND, self.drift)
        own = wandering(count)
        drift, flicker = (np.sqrt(self._size(one)) for one in (far**2 * np.eye(3), noise))
        wander = drift * own.line, drift * own.walk, flicker * own.flicker
        left = without_noise(white, noise)[0]
        return np.column_stack([self._clear, left, readings.outboard[good], *wander])

    @cached_property
    def _turns(self) -> Floats:
        """How large white noise, line, walk and flicker noise are beside what is usual, in power.

        (4, place, turn).
        """
        shape = (4, len(self.matrices), _TURNS)
        return np.asarray(np.random.default_rng(2).standard_t(TAIL, shape) ** 2)

    @cached_property
    def _outboard(self) -> Floats:
        """Parts of white noise, line, walk and flicker noise that are the outboard sensor's.

        (4, place, turn).
        """
        drawn = np.random.default_rng(3).normal(*_OUTBOARD, size=(4, *self._turns.shape[1:]))
        drawn[[0, 3]] = self.noise.share
        return drawn

    @cached_property
    def _leaks(self) -> Floats:
        """Ambient field in a correction by an error of the leak; (place, turn, axis, axis)."""
        random = np.random.default_rng(7)
        shape = self._turns.shape[1:]
        drawn = random.multivariate_normal(np.zeros(9), self.leak_covariance, shape, method="eigh")
        return np.asarray(np.einsum("ki,...ij->...kj", self._middle, drawn.reshape(*shape, 3, 3)))

    @cached_property
    def _lost_without_states(self) -> dict[int, Lost]:
        return self._lost(self._difference, most=self._quiet)

    def _lost(self, both: Floats, most: Mapping[int, float] | None = None) -> dict[int, Lost]:
        """Return by scale what of the difference is no stray field.

        Parameters
        ----------
        both : ndarray, shape (time, column)
            As `_difference`, or a part of it.
        most : mapping, optional
            The largest power of drift and of flicker noise by scale, nT^2.
        """
        sums, found = running_sums(both), {}
        for scale in scales_of(len(both), _LONGEST):
            values = contrasts(sums, scale)[0]
            stray, white, ambient = (
                values[:, rows].T @ values[:, rows] / len(values)
                for rows in (slice(0, 3), slice(3, 6), slice(6, 9))
            )
            line, *others = np.mean(values[:, 9:] ** 2, axis=0)
            walk, flicker = np.reshape(others, (2, DRAWS)).mean(axis=1)
            usual = np.array([self._size(white), line, walk, flicker])
            own = usual[:, None, None] * self._turns
            if most is not None:
                # What is left of white noise comes in bursts; the rest goes on all the time.
                own[1:] = np.minimum(own[1:], most[scale])
            leaks = self._passed[scale] * self._leaks
            through = np.einsum("ptki,ij,ptkj->pt", leaks, ambient, leaks)
            lost = np.concatenate([own, through[None]]) / max(self._size(stray), 1e-300)
            lost /= np.maximum(lost.sum(axis=0), 1.0)
            added = np.sum(self._outboard * lost[:4], axis=0) / self._factor
            found[scale] = Lost(lost.sum(axis=0), added)
        return found

    @cached_property
    def _quiet(self) -> dict[int, float]:
        """Power of the difference in quiet stretches, by scale: sensors wander all the time. nT^2."""
        cells = cells_of(self._difference[:, :3], longest=_LONGEST)
        found = {}
        for scale in np.unique(cells.scale).tolist():
            size = [self._size(one) for one in cells.covariance[cells.scale == scale]]
            found[scale] = float(np.quantile(size, _QUIET)) if len(size) >= _QUIET_CELLS else np.inf
        return found

    def _slopes(self, cells: Cells, part: slice) -> Floats:
        """Return the slopes of what matrices make of the difference on a part of the correction; (place,)."""
        across = np.einsum("c,cij->ij", cells.count, cells.covariance[:, 3:6, part])
        total = float(np.einsum("c,cii->", cells.count, cells.covariance[:, part, part]))
        return np.asarray(np.einsum("pji,ij->p", self.matrices, across) / max(total, 1e-300))

    @cached_property
    def _middle(self) -> Floats:
        """The mean matrix."""
        return np.asarray(self.matrices.mean(axis=0))

    @property
    def _factor(self) -> float:
        """Size of the mean matrix."""
        return float(np.sqrt(np.sum(self._middle**2) / 3.0))

    def _size(self, covariance: Floats) -> float:
        """Return the power at the outboard sensor of a covariance of the difference (3, 3)."""
        return float(np.einsum("ki,ij,kj->", self._middle, covariance, self._middle))


def _powers(cells: Cells) -> list[float]:
    """Return the power of a correction in contrasts, and of its parts with states and without, nT^2."""
    taken = cells.covariance[:, 6:, 6:].reshape(-1, 2, 3, 2, 3)
    parts = taken.sum(axis=(1, 3)), taken[:, 0, :, 0], taken[:, 1, :, 1]
    return [max(float(np.einsum("c,cii->", cells.count, one) / cells.count.sum()), 1e-300) for one in parts]


def _kept(
    taken: Floats, scales: npt.NDArray[np.int64], readings: Readings
) -> dict[float, tuple[Floats, Floats]]:
    """Return what is left on each scale of a correction's good rows when slow parts are left alone."""
    found = {}
    for width in (len(taken) // part for part in CUTS):
        if width < _NARROWEST:
            break
        sums = running_sums(np.concatenate([taken, taken - slow_part(taken, width)], axis=1))
        product, square = np.ones((2, scales.size))
        for place, scale in enumerate(scales.tolist()):
            whole, quick = np.split(contrasts(sums, scale)[0], 2, axis=1)
            power = max(float(np.sum(whole**2)), 1e-300)
            product[place] = float(np.sum(quick * whole)) / power
            square[place] = float(np.sum(quick**2)) / power
        found[width * readings.step / SECOND] = product, square
    return found


def by_state(state: npt.NDArray[np.int64], values: Floats) -> Floats:
    """Return the part of values (time, column) that is the same whenever a state comes again."""
    told = np.flatnonzero(state >= 0)
    if not told.size:
        return np.zeros_like(values)
    # While a state passes or is unknown that before it goes on: no steps are made that nobody took.
    last = np.maximum(np.searchsorted(told, np.arange(state.size), side="right") - 1, 0)
    _, place = np.unique(state[told], return_inverse=True)
    count = np.bincount(place)
    mean = [np.bincount(place, column[told]) / count for column in values.T]
    return np.asarray(np.stack(mean, axis=1)[place[last]])
