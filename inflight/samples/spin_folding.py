"""A day of a spinning sensor folded into synthetic turns: what repeats with the spin, in few samples.

Takes native samples with their spin phase; makes samples at even phases, one synthetic turn an interval, with
weights that fall with natural noise (Plaschke et al. 2019, section 5, choose intervals of a hundred turns).

The field outside turns with the spin in the sensor and changes slowly; what the sensor and the spacecraft add
is fixed in the body. In each interval of many turns the slow change of the outside field is removed
in payload axes, and a Fourier sum of the phase is fitted to the rest. Its values at even phases are
the interval's *synthetic turn*: readings of a sensor that turned once in a steady field. Spin tones of any
effect, and of any channel that repeats with the spin, are kept as they are; natural changes are not.

`fourier_sums` fits the sums of all turns or intervals at once: the normal equations of ``exp(i h phase)`` are
Fourier sums of the phase alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.compiled import compiled
from inflight.errors import SamplesError
from inflight.flags import UNUSABLE, Flag
from inflight.time import SECOND, Int64, day_bounds, day_of, to_utc

if TYPE_CHECKING:
    import xarray as xr

Complex = npt.NDArray[np.complex128]

#: Phases of a synthetic turn, and the highest harmonic it holds, of fields in the body and of channels alike.
SECTORS, FOLD_ORDER = 12, 4

#: Bumped by hand when the numbers of folded samples change.
FOLDING_VERSION = 3

_TWO_PI = 2.0 * np.pi

#: Median of absolute deviations to a standard deviation, of a normal distribution.
_TO_SIGMA = 1.4826


@dataclass(frozen=True, kw_only=True)
class FoldingSettings:
    """How turns are folded.

    Attributes
    ----------
    worst_condition : float
        A group is solved when its normal equations are this far from singular: with gaps they may be.
        Assumed.
    turns : int
        Turns an interval should hold (Plaschke et al. 2019, section 5).
    lengths_s : tuple of int
        Seconds intervals may last: such as divide a day, with whole seconds from phase to phase.
    quiet_nT : float
        Weights are 1 where natural noise at the spin is below this, nT, and fall with its square above it:
        no magnetometer in space measures its spin's tone better than this in a few minutes. Assumed.
    groups : int
        Natural noise is what so many groups of an interval's turns, about, differ by. Assumed: the tones of
        eight turns reach an eighth of the spin's frequency to either side.
    fewest_turns : int
        Of fewer turns in a group only the first two harmonics are fitted. Assumed.
    harmonics_power : float
        Power of all harmonics up to the fifth over that of these two. Derived: of nature's spectrum (f^-5/3).
    neighbour_turns : float
        Turns whose means are this much of a turn apart are neighbours. Assumed.
    least_share : float
        An interval is used with this part of its samples. Assumed.
    turn_order : int
        Harmonics of one turn's fit: offsets are at the first in payload axes, gains at the second.
    outlier : float
        A sample is an outlier when it is this many sigma from its turn's fit, by the median of the day's
        deviations. Assumed.
    """

    worst_condition: float = 1e6
    turns: int = 100
    lengths_s: tuple[int, ...] = tuple(
        length for length in range(SECTORS, 21_601, SECTORS) if 86_400 % length == 0
    )
    quiet_nT: float = 1e-3  # noqa: N815 (a unit)
    groups: int = 12
    fewest_turns: int = 4
    harmonics_power: float = 1.25
    neighbour_turns: float = 1.6
    least_share: float = 0.5
    turn_order: int = 2
    outlier: float = 8.0


FOLDING_SETTINGS = FoldingSettings()


@dataclass(frozen=True)
class FourierSums:
    """Complex Fourier sums, one a group of samples.

    Attributes
    ----------
    coefficients : ndarray of complex, shape (group, 2 H + 1, column)
        Of exp(i h phase), h from -H to H; NaN where a group has too few samples.
    count : ndarray, shape (group,)
        Samples used.
    """

    coefficients: Complex
    count: Floats

    @property
    def mean(self) -> Complex:
        """The part without phase; (group, column)."""
        return np.asarray(self.coefficients[:, self.coefficients.shape[1] // 2])

    def at(self, phase: Floats) -> Complex:
        """Return the sums at phases (point,), the same for all groups; (group, point, column)."""
        order = self.coefficients.shape[1] // 2
        waves = np.exp(1j * np.outer(phase, np.arange(-order, order + 1)))
        return np.asarray(np.einsum("ph,ghc->gpc", waves, self.coefficients))

    def along(self, phase: Floats, group: npt.NDArray[np.int64]) -> Complex:
        """Return each sample's value of its own group's sum; (time, column)."""
        order = self.coefficients.shape[1] // 2
        wave = np.exp(1j * phase)[:, None]
        out = self.coefficients[group, 2 * order]
        for place in range(2 * order - 1, -1, -1):
            out = out * wave + self.coefficients[group, place]
        return np.asarray(out * np.conj(wave) ** order)


def fourier_sums(
    values: Complex,
    phase: Floats,
    group: npt.NDArray[np.int64],
    groups: int,
    order: int,
    good: npt.NDArray[np.bool_],
) -> FourierSums:
    """Fit Fourier sums of the phase to each group of samples, by least squares.

    The normal equations of exp(i h phase) are Fourier sums of the phase alone, so that a day's turns cost a
    few sums over its samples and one batch of small systems.

    Parameters
    ----------
    values : ndarray of complex, shape (time, column)
    phase : ndarray, shape (time,)
        Radians.
    group : ndarray of int, shape (time,)
        Group of each sample, below `groups`.
    order : int
        Highest harmonic H.
    good : ndarray of bool, shape (time,)
        Samples to be used.
    """
    sums, right = _sums_of_groups(np.ascontiguousarray(values), phase, group, groups, order, good)
    return FourierSums(_solve_sums(sums, right, order), sums[:, 0].real.copy())


@compiled
def _sums_of_groups(
    values: Complex,
    phase: Floats,
    group: npt.NDArray[np.int64],
    groups: int,
    order: int,
    good: npt.NDArray[np.bool_],
) -> tuple[Complex, Complex]:  # pragma: no cover
    """Return each group's sums of the waves and of the values times them, as for `fourier_sums`.

    Returns
    -------
    sums : ndarray of complex, shape (group, 2 H + 1)
        Of exp(i h phase), h from 0 to 2 H.
    right : ndarray of complex, shape (group, 2 H + 1, column)
        Of the values times exp(-i h phase), h from -H to H.
    """
    sums = np.zeros((groups, 2 * order + 1), dtype=np.complex128)
    right = np.zeros((groups, 2 * order + 1, values.shape[1]), dtype=np.complex128)
    for i in range(phase.size):
        if not good[i]:
            continue
        wave, angle = complex(np.cos(phase[i]), np.sin(phase[i])), complex(1.0, 0.0)
        of_sums, of_right = sums[group[i]], right[group[i]]
        for harmonic in range(2 * order + 1):
            of_sums[harmonic] += angle
            if harmonic <= order:
                for column in range(values.shape[1]):
                    of_right[order + harmonic, column] += values[i, column] * np.conj(angle)
                    if harmonic > 0:
                        of_right[order - harmonic, column] += values[i, column] * angle
            angle = angle * wave
    return sums, right


def _solve_sums(sums: Complex, right: Complex, order: int) -> Complex:
    """Solve the groups' normal equations; NaN where they are nearly singular."""
    size = 2 * order + 1
    difference = np.arange(size)[None, :] - np.arange(size)[:, None]
    gram = sums[:, np.abs(difference)]
    gram = np.where(difference[None] < 0, np.conj(gram), gram)
    out = np.full(right.shape, np.nan + 0j)
    count, worst = sums[:, 0].real, FOLDING_SETTINGS.worst_condition
    # No eigenvalue is farther from the number of samples than this (Gershgorin): in an unbroken turn that is
    # little, and only the eigenvalues of the others have to be known.
    reach = 2.0 * np.abs(sums[:, 1:]).sum(axis=1)
    sound = (count >= size) & ((count - reach) * worst > count + reach)
    doubt = np.flatnonzero((count >= size) & ~sound)
    if doubt.size:
        spread = np.linalg.eigvalsh(gram[doubt])
        sound[doubt] = spread[:, 0] * worst > spread[:, -1]
    if sound.any():
        out[sound] = np.linalg.solve(gram[sound], right[sound])
    return out


@dataclass(frozen=True)
class Folding:
    """How a day is folded.

    Attributes
    ----------
    interval_ns : int
        Length of an interval.
    sectors : int
        Samples of a synthetic turn.
    """

    interval_ns: int
    sectors: int = SECTORS

    @classmethod
    def of_period(cls, spin_ns: int, turns: int = FOLDING_SETTINGS.turns) -> Folding:
        """Return the folding whose intervals hold about so many turns and divide a day."""
        length = turns * spin_ns / SECOND
        return cls(min(FOLDING_SETTINGS.lengths_s, key=lambda one: abs(np.log(one / length))) * SECOND)

    def keep(self, values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return rows of folded samples less their interval's mean, which the outside field decides.

        A linear filter, the same for residuals and columns; NaN where a sample is not good.

        Parameters
        ----------
        values : ndarray, shape (time, ...)
        stamps : ndarray of int64, shape (time,)
            TT2000 of the folded samples.
        good : ndarray of bool, shape (time,)
        """
        flat = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
        used = good & np.isfinite(flat).all(axis=1)
        interval = (
            (stamps - day_bounds(day_of(stamps[:1])[0])[0]) // self.interval_ns if stamps.size else stamps
        )
        starts = np.flatnonzero(np.diff(interval, prepend=interval[:1] - 1))
        lengths = np.diff(starts, append=interval.size)
        count = np.add.reduceat(used.astype(np.float64), starts) if starts.size else np.zeros(0)
        total = np.add.reduceat(np.where(used[:, None], flat, 0.0), starts, axis=0) if starts.size else flat
        with np.errstate(invalid="ignore", divide="ignore"):
            out = flat - np.repeat(total / count[:, None], lengths, axis=0)
        out[~used] = np.nan
        return out.reshape(np.shape(values))

    def steady(self, field: Floats, phase: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return the field of each interval as it would be without spin tones; (time, 3) nT, turning axes.

        Parameters
        ----------
        field : ndarray, shape (time, 3)
            Folded, axes that turn with the spacecraft.
        phase : ndarray, shape (time,)
            Rad.
        """
        c, s = np.cos(phase), np.sin(phase)
        payload = np.column_stack(
            [c * field[:, 0] - s * field[:, 1], s * field[:, 0] + c * field[:, 1], field[:, 2]]
        )
        mean = payload - self.keep(payload, stamps, good)
        return np.column_stack([c * mean[:, 0] + s * mean[:, 1], c * mean[:, 1] - s * mean[:, 0], mean[:, 2]])

    @property
    def cadence_ns(self) -> int:
        """Distance of the folded samples."""
        return self.interval_ns // self.sectors

    @property
    def phases(self) -> Floats:
        """Phases of a synthetic turn, rad; (sector,)."""
        return (np.arange(self.sectors) + 0.5) * _TWO_PI / self.sectors


def fold_spins(samples: xr.Dataset, folding: Folding, span: tuple[int, int]) -> xr.Dataset:
    """Fold native samples of a turning sensor into synthetic turns.

    Parameters
    ----------
    samples : xarray.Dataset
        Aligned, with `vector` (time, axis) nT, `spin_phase` (time) rad, unwrapped, `tt2000`, `flag`; every
        other variable along time is folded with its own sums.
    folding : Folding
    span : tuple of int
        TT2000 bounds of the day.

    Returns
    -------
    xarray.Dataset
        Like samples, one turn an interval, evenly spaced; `spin_phase` within a turn. Intervals with less
        than half of their samples are flagged and NaN; `weight` falls with the natural noise of an interval.

    Raises
    ------
    SamplesError
        When the samples have no phase.
    """
    import xarray as xr

    if "spin_phase" not in samples:
        raise SamplesError(
            "the samples have no spin phase",
            channel="spin_phase",
            remedy="name a channel of kind 'sun_pulse' or 'spin_phase' in the mission YAML",
        )
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    phase = np.asarray(samples["spin_phase"].values, dtype=np.float64)
    day = _Day(stamps, phase, folding, span)
    field, good = day.field(samples)
    made: dict[str, xr.Variable] = {"vector": xr.Variable(("time", "axis"), field, samples["vector"].attrs)}
    for name in samples.data_vars:
        if name not in _OWN and samples[name].dims[:1] == ("time",):
            made[str(name)] = day.channel(samples[name], good)
    return day.to_dataset(made, samples["spin_phase"].attrs)


def fold_series(
    values: Floats, stamps: Int64, phase: Floats, folding: Folding, span: tuple[int, int]
) -> Floats:
    """Return a channel on the synthetic turns of a day, (time, ...), as `fold` has it of its own.

    Parameters
    ----------
    values : ndarray, shape (sample, ...)
    stamps, phase : ndarray, shape (sample,)
        TT2000, and the spin's phase there, rad.
    folding : Folding
    span : tuple of int
        TT2000 bounds of the day.
    """
    import xarray as xr

    day = _Day(stamps, phase, folding, span)
    series = xr.DataArray(values, dims=("time", "component")[: np.ndim(values)])
    return np.asarray(day.channel(series, day.known).values, dtype=np.float64)


_OWN = ("vector", "spin_phase", "tt2000", "flag", "weight")


class _Day:
    """Stamps and phases of a day's samples, and the intervals they lie in."""

    def __init__(self, stamps: Int64, phase: Floats, folding: Folding, span: tuple[int, int]) -> None:
        self.stamps, self.phase, self.folding, self.span = stamps, phase, folding, span
        self.intervals = max(1, -(-(span[1] - span[0]) // folding.interval_ns))
        self.noise = np.zeros(self.intervals)
        self.interval = np.clip((stamps - span[0]) // folding.interval_ns, 0, self.intervals - 1)
        self.known = np.isfinite(phase)
        turn = np.floor(np.where(self.known, phase, 0.0) / _TWO_PI).astype(np.int64)
        # Turns count on where the phase is not known, and start anew with each interval.
        turn = np.maximum.accumulate(np.where(self.known, turn, turn[self.known].min(initial=0)))
        self.turn = np.unique(turn, return_inverse=True)[1].astype(np.int64)

    @property
    def turns(self) -> int:
        return int(self.turn[-1]) + 1 if self.turn.size else 0

    def field(self, samples: xr.Dataset) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """Return the synthetic turns of the reading, (time, axis), and which native samples made them."""
        raw = np.asarray(samples["vector"].values, dtype=np.float64)
        bad = np.uint32(UNUSABLE & ~Flag.CHANNEL_MISSING)
        flag = np.asarray(samples["flag"].values)
        good = self.known & np.isfinite(raw).all(axis=1) & ((flag & bad) == 0)
        good &= ~self._in_bad_interval(flag)
        wheel = np.exp(1j * np.where(self.known, self.phase, 0.0))
        # In payload axes the outside field hardly turns; along the axis it never did.
        payload = np.column_stack([(raw[:, 0] + 1j * raw[:, 1]) * wheel, raw[:, 2]])
        payload[~good] = 0.0
        good = good & ~self._outlying(payload, good)
        slow = self._slow_change(payload, good)
        steady = payload - (slow - self._interval_means(slow, good)[self.interval])
        good = good & np.isfinite(steady).all(axis=1)
        found = fourier_sums(
            np.where(good[:, None], steady, 0.0),
            np.where(self.known, self.phase, 0.0),
            self.interval,
            self.intervals,
            FOLD_ORDER + 1,
            good,
        )
        # A harmonic k in the body is k + 1 in payload axes across the spin axis.
        for place, harmonic in enumerate(range(-FOLD_ORDER - 1, FOLD_ORDER + 2)):
            if not -FOLD_ORDER <= harmonic - 1 <= FOLD_ORDER:
                found.coefficients[:, place, 0] = 0.0
            if abs(harmonic) > FOLD_ORDER:
                found.coefficients[:, place, 1] = 0.0
        folded = self._sectors(found, good)
        back = np.exp(-1j * np.tile(self.folding.phases, self.intervals))
        plane = folded[:, 0] * back
        self.noise = self._natural_noise(steady, good)
        return np.column_stack([plane.real, plane.imag, folded[:, 1].real]), good

    def _in_bad_interval(self, flag: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
        """Return the samples of intervals in which the phase jumps or the sensor was saturated; (time,).

        Turns on both sides of a jump are not of one phase, and those of a full sensor lack their tops.
        """
        hit = np.zeros(self.intervals, dtype=bool)
        jump = np.uint32(Flag.PHASE_JUMP | Flag.NO_PHASE)
        hit[self.interval[((flag & jump) == jump) | ((flag & np.uint32(Flag.SATURATED)) != 0)]] = True
        return np.asarray(hit[self.interval])

    def _natural_noise(self, steady: Complex, good: npt.NDArray[np.bool_]) -> Floats:
        """Return what nature adds to the rows, nT rms, by how groups of turns differ; (interval,).

        Nature's spectrum falls steeply: tones of single turns, which reach from half the spin's frequency to
        twice it, hold more of it than the tones of an interval do. Groups of several turns reach less far.
        """
        modulus = np.abs(steady[:, 0])
        rows = np.column_stack([steady[:, 1].real, np.where(np.isfinite(modulus), modulus, 0.0)])
        rows[~good] = 0.0
        first, last = np.zeros(self.turns, dtype=np.int64), np.zeros(self.turns, dtype=np.int64)
        last[self.turn], first[self.turn[::-1]] = self.interval, self.interval[::-1]
        used = np.bincount(first[np.unique(self.turn[good])], minlength=self.intervals)
        size = max(1, int(used.max(initial=0)) // FOLDING_SETTINGS.groups)
        # A single turn's samples may be too few for all harmonics.
        few = size < FOLDING_SETTINGS.fewest_turns
        order = FOLDING_SETTINGS.turn_order if few else FOLD_ORDER
        group = self.turn // size
        groups = -(-self.turns // size)
        phase = np.where(self.known, self.phase, 0.0)
        sums = fourier_sums(rows.astype(np.complex128), phase, group, groups, order, good)
        tones = sums.coefficients[:, order + 1 :].reshape(groups, -1)
        # Half the square of what changes from group to group: tones that grow with the field change slowly.
        change = 0.5 * np.sum(np.abs(np.diff(tones, axis=0)) ** 2, axis=1)
        begun, ended = first[::size], last[np.minimum(size * np.arange(1, groups + 1), self.turns) - 1]
        # Each interval has a mean of its own: a group that lies in two is none.
        known = np.isfinite(change) & (begun[:-1] == ended[1:])
        place = begun[:-1][known]
        count = np.bincount(place, minlength=self.intervals).astype(np.float64)
        power = FOLDING_SETTINGS.harmonics_power if few else 1.0
        with np.errstate(invalid="ignore", divide="ignore"):
            total = np.bincount(place, change[known], self.intervals) / count
            # Twice the real part of each tone, on average over two rows.
            return np.asarray(np.sqrt(power * total * size / used))

    def _outlying(self, payload: Complex, good: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return which samples are far from their own turn's fit."""
        fit = self._fit_turns(payload, good)
        off = np.abs(payload - fit.along(self.phase, self.turn)).max(axis=1)
        usual = np.median(off[good & np.isfinite(off)]) if good.any() else 0.0
        # An outlier also pulls its turn's fit: its neighbours must not go with it.
        around = np.full(self.turns, np.nan)
        finite = good & np.isfinite(off)
        np.fmax.at(around, self.turn[finite], off[finite])
        worst = off >= np.where(np.isfinite(around), around, np.inf)[self.turn] * (1.0 - 1e-12)
        return np.asarray(finite & worst & (off > FOLDING_SETTINGS.outlier * _TO_SIGMA * max(usual, 1e-6)))

    def _fit_turns(self, values: Complex, good: npt.NDArray[np.bool_]) -> FourierSums:
        phase = np.where(self.known, self.phase, 0.0)
        return fourier_sums(values, phase, self.turn, self.turns, FOLDING_SETTINGS.turn_order, good)

    def _slow_change(self, values: Complex, good: npt.NDArray[np.bool_]) -> Complex:
        """Return the change that is slower than the spin: a smooth line through the turns' means."""
        means = self._fit_turns(values, good).mean
        phase = np.where(good, self.phase, 0.0)
        count = np.bincount(self.turn[good], minlength=self.turns)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.bincount(self.turn[good], phase[good], self.turns) / count
        there = np.isfinite(means).all(axis=1) & np.isfinite(centre)
        if there.sum() < 4:
            return np.full(values.shape, np.nan + 0j)
        knots = centre[there]
        line = scipy.interpolate.CubicSpline(knots, means[there], axis=0)
        after = np.searchsorted(knots, phase)
        inside = (after > 0) & (after < knots.size)
        after = np.clip(after, 1, knots.size - 1)
        # Beyond the ends, and next to a missing turn, the line is a guess.
        known = inside & (knots[after] - knots[after - 1] < FOLDING_SETTINGS.neighbour_turns * _TWO_PI)
        out = np.asarray(line(np.where(known, phase, knots[0])))
        out[~known] = np.nan
        return out

    def _interval_means(self, values: Complex, good: npt.NDArray[np.bool_]) -> Complex:
        """Return the means of values (time, column) over each interval; (interval, column)."""
        used = good & np.isfinite(values).all(axis=1)
        count = np.bincount(self.interval[used], minlength=self.intervals)
        out = np.empty((self.intervals, values.shape[1]), dtype=np.complex128)
        with np.errstate(invalid="ignore", divide="ignore"):
            for column in range(values.shape[1]):
                real, imaginary = (
                    np.bincount(self.interval[used], part[used], self.intervals)
                    for part in (values[:, column].real, values[:, column].imag)
                )
                out[:, column] = (real + 1j * imaginary) / count
        return out

    def _sectors(self, found: FourierSums, good: npt.NDArray[np.bool_]) -> Complex:
        """Return sums at the phases of a synthetic turn, one after another; (time, column)."""
        usual = self.folding.interval_ns / max(1.0, float(np.median(np.diff(self.stamps))))
        values = found.at(self.folding.phases)
        values[found.count < FOLDING_SETTINGS.least_share * usual] = np.nan
        return np.asarray(values.reshape(-1, values.shape[2]))

    def channel(self, series: xr.DataArray, good: npt.NDArray[np.bool_]) -> xr.Variable:
        """Return a channel on the synthetic turns: its interval's mean, and what goes with the spin."""
        import xarray as xr

        values = np.asarray(series.values, dtype=np.float64)
        flat = values.reshape(values.shape[0], -1)
        known = good & np.isfinite(flat).all(axis=1)
        complex_values = np.where(known[:, None], flat, 0.0).astype(np.complex128)
        slow = self._slow_change(complex_values, known)
        steady = complex_values - (slow - self._interval_means(slow, known)[self.interval])
        usable = known & np.isfinite(steady).all(axis=1)
        phase = np.where(self.known, self.phase, 0.0)
        found = fourier_sums(
            np.where(usable[:, None], steady, 0.0), phase, self.interval, self.intervals, FOLD_ORDER, usable
        )
        out = self._sectors(found, usable).real
        return xr.Variable(series.dims, out.reshape(-1, *values.shape[1:]), series.attrs)

    def to_dataset(self, made: dict[str, xr.Variable], phase_attrs: dict[str, object]) -> xr.Dataset:
        """Return the folded samples with stamps, phases and flags."""
        import xarray as xr

        count = self.intervals * self.folding.sectors
        step = self.folding.cadence_ns
        stamps = self.span[0] + step // 2 + step * np.arange(count, dtype=np.int64)
        inside = stamps < self.span[1]
        lost = ~np.isfinite(made["vector"].values).all(axis=1)
        noise = np.repeat(self.noise, self.folding.sectors)
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = np.minimum(1.0, (FOLDING_SETTINGS.quiet_nT / noise) ** 2)
        flag = np.where(lost, np.uint32(Flag.VECTOR_MISSING), np.uint32(0)).astype(np.uint32)
        phases = np.tile(self.folding.phases, self.intervals)
        made |= {
            "spin_phase": xr.Variable("time", phases, phase_attrs),
            "tt2000": xr.Variable("time", stamps),
            "flag": xr.Variable("time", flag),
            "noise": xr.Variable("time", noise, {"units": "nT"}),
            "weight": xr.Variable("time", np.where(lost | ~np.isfinite(weight), 0.0, weight)),
        }
        return xr.Dataset(made, coords={"time": to_utc(stamps)}).isel(time=inside)
