"""Magneto-torquers: their coefficients from the band of their modulation, and the body's remanent field.

*Band* (Yin 2010, 3.4.3, eq. 3.5). Takes residual, direction and currents; makes the matrix of nT/A.
Torquer currents alternate with a period of 20 s; hardly anything else in the residual does. With
``dB' = |B_v| - |B_s|`` corrected by matrices that are wrong by D_v and D_s, ``dB' = e.((D_v - D_s) I)``
plus noise. The power of ``dB' - sum a_jk e_j I_k`` between 0.045 and 0.055 Hz is a square in a, so its
least value has a closed form: the normal equations of real and imaginary parts of the transforms of
``e_j I_k`` and dB'. No window is used: neighbouring frequencies then stay independent in white noise,
and the leakage of the currents' own slow part is the same in columns and residual.

Signs. The fitted ``a = D_v - D_s`` is the difference of the sensors, as everywhere. When the vector
sensor's matrix is right, the scalar sensor's is corrected by *adding* ``D_s = -a``: the residual then
becomes ``dB(alpha' + D) = dB' + e.(D I)``. The thesis prints a minus there, which doubles the error.

*Remanent field* (Yin 2010, section 3.4.4). Takes daily mean currents; makes the body's field.
Torquers hold the attitude against the torque on the body's own magnetic moment, so over a whole cycle
of local time their mean moment is the body's with the other sign. The body's moment makes the field
``B = eta (0, mean I_y, mean I_z)`` at the scalar sensor. Eta is positive although the moments cancel,
because the torquers' own field per ampere is negative there across the boom (-10.7 and -11.6 nT/A), and
7.1 nT/A is 0.66 and 0.61 of that: the body's moment is 1.16 times farther from the sensor than the
coils. Along the boom the sign of the factor would turn; the mean I_x is taken as 0. The field is
subtracted *with* the torquers' own and *instead of* a constant remanent field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from inflight.arrays import Floats
from inflight.effects import AXES
from inflight.errors import CalibrationError, SamplesError, SettingsError
from inflight.lsq import (
    MAD_TO_SIGMA,
    SOLVER_SETTINGS,
    ClusteredFit,
    biweight,
    robust_sigma,
    solve_clusters,
    student_sigma,
    window_means,
)
from inflight.mission_fit.superposed_epochs import in_order_of_time
from inflight.time import GAP, SECOND, Int64, day_bounds, day_of, usual_step


@dataclass(frozen=True, kw_only=True)
class TorquerSettings:
    """How the robust mean of days settles, and when a running mean has its whole window.

    Attributes
    ----------
    passes : int
        Passes of the biweights; assumed.
    whole : float
        A window is whole from this coverage on: rounding of the weights of its days.
    most_share : float
        Share of the weight above which a day's residual is no longer scaled up for its pull on the mean;
        assumed.
    fewest_pairs : int
        Fewest pairs of covered days that show by how much the mean changes over a lag; assumed.
    """

    passes: int = 10
    whole: float = 0.999
    most_share: float = 0.9
    fewest_pairs: int = 3


TORQUER_SETTINGS = TorquerSettings()


@dataclass(frozen=True, kw_only=True)
class SpectraSettings:
    """How the spectrum of each instrument is made, and when a line of the torquers is seen in it.

    Attributes
    ----------
    length : float
        Of a segment, s; its inverse is the resolution (assumed: four lines' width in the band).
    flanks : tuple
        Hz, where the spectrum beside the band is taken; assumed.
    sure : float
        Sigmas above which a line is seen; assumed.
    """

    length: float = 400.0
    flanks: tuple[tuple[float, float], tuple[float, float]] = ((0.025, 0.0425), (0.0575, 0.085))
    sure: float = 3.0


SPECTRA_SETTINGS = SpectraSettings()

#: Hz, around the 20 s of the modulation.
TORQUER_BAND_HZ = (0.045, 0.055)

#: Columns e_j I_k: axis of the field, then coil.
COLUMNS = tuple(f"{axis}{coil}" for axis in AXES for coil in AXES)


def band_equations(
    stamps: Int64,
    residual: Floats,
    direction: Floats,
    current: Floats,
    *,
    band: tuple[float, float] = TORQUER_BAND_HZ,
    longest: float = 3600.0,
    shortest: float = 400.0,
    order: int = 1,
) -> xr.Dataset:
    """Return the Gram matrix of the band for each stretch of samples without a gap; small enough to store.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, rising, at one cadence but for gaps.
    residual : ndarray, shape (time,)
        dB, nT; NaN where it is missing.
    direction : ndarray, shape (time, 3)
        e = B/F, sensor axes.
    current : ndarray, shape (time, 3)
        Torquer currents, A, at the times of the residual.
    band : (float, float)
        Hz.
    longest, shortest : float
        Stretches are cut to at most the one and dropped below the other, s. A stretch is a cluster.
    order : int
        Order of the polynomial that is removed from columns and residual of a stretch. A line is enough
        while the residual follows the orbit by less than 1 nT; more leaks into the band and raises
        its level (3 nT: by 45 %), which order 5 prevents.

    Returns
    -------
    xarray.Dataset
        dims segment, column, other (= column): `gram` nT^2 with the residual last, scaled so that white
        noise of variance s^2 a sample leaves s^2 a row; `rows` (segment), two a frequency; `start`, `end`
        TT2000, `day`.

    Raises
    ------
    SamplesError
        The cadence is too slow for the band, or no stretch is long enough.
    """
    cadence = usual_step(stamps) / SECOND if stamps.size > 1 else np.inf
    if 0.5 / cadence <= band[1]:
        raise SamplesError(
            f"samples every {cadence:g} s do not hold {band[1]:g} Hz",
            remedy="take the torquer currents and the residual at the magnetometers' own cadence",
        )
    # The columns e_j I_k and the residual; (10, time), nT A and nT.
    rows = np.empty((10, residual.size))
    for row, (axis, coil) in enumerate(product(range(3), repeat=2)):
        np.multiply(direction[:, axis], current[:, coil], out=rows[row])
    rows[9] = residual
    grams, counts, ends = [], [], []
    for part in _stretches(stamps, np.isfinite(rows.sum(axis=0)), cadence, longest, shortest):
        both = _band_transform(part.stop - part.start, cadence, *band, order) @ rows[:, part].T
        if both.shape[0]:
            grams.append(both.T @ both)
            counts.append(both.shape[0])
            ends.append((stamps[part.start], stamps[part.stop - 1]))
    if not grams:
        raise SamplesError(
            f"no stretch of {shortest:g} s without a gap in {stamps.size} samples",
            remedy="take another span, or lower 'shortest' (at least two periods of the band's width)",
        )
    start, end = np.array(ends, dtype=np.int64).T
    names = [*COLUMNS, "residual"]
    return xr.Dataset(
        {
            "gram": (("segment", "column", "other"), np.array(grams), {"units": "nT2"}),
            "rows": ("segment", np.array(counts, dtype=np.float64)),
            "start": ("segment", start, {"scale": "TT2000"}),
            "end": ("segment", end, {"scale": "TT2000"}),
            "day": ("segment", day_of(start).astype("datetime64[D]").astype(np.int64)),
        },
        coords={"column": names, "other": names},
        attrs={"band_low_Hz": band[0], "band_high_Hz": band[1], "cadence_s": cadence},
    )


def _stretches(
    stamps: Int64,
    good: np.ndarray[tuple[int], np.dtype[np.bool_]],
    cadence: float,
    longest: float,
    shortest: float,
) -> list[slice]:
    """Return parts without a gap, cut into equal pieces of at most `longest` seconds."""
    index = np.flatnonzero(good)
    if not index.size:
        return []
    gap = (np.diff(index) > 1) | (np.diff(stamps[index]) > GAP * cadence * SECOND)
    found = []
    for run in np.split(index, np.flatnonzero(gap) + 1):
        pieces = max(1, int(np.ceil(run.size * cadence / longest)))
        edges = np.linspace(run[0], run[-1] + 1, pieces + 1).astype(np.int64)
        found += [slice(int(low), int(high)) for low, high in pairwise(edges)]
    return [part for part in found if (part.stop - part.start) * cadence >= shortest]


@lru_cache(maxsize=8)
def _band_transform(count: int, cadence: float, low: float, high: float, order: int) -> Floats:
    """Return the matrix that removes the drift and gives real and imaginary parts in the band; (row, time).

    Scaled so that its rows keep the variance of white noise. Only the band is computed, and removing the
    drift from the waves once is the same as removing it from every series.
    """
    # A frequency on the edge of the band belongs to it, whatever rounding says.
    first = int(np.ceil(low * count * cadence - 1e-6))
    last = int(np.floor(high * count * cadence + 1e-6))
    # A wave passes the same angles as the first one, in another order.
    index = np.outer(np.arange(first, last + 1), np.arange(count)) % count
    angle = 2.0 * np.pi * np.arange(count) / count
    waves = np.concatenate([np.cos(angle)[index], -np.sin(angle)[index]]) * np.sqrt(2.0 / count)
    drift, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), order))
    return np.asarray(waves - (waves @ drift) @ drift.T)


@dataclass(frozen=True)
class TorquerFit:
    """Correction of the torquer matrices, vector minus scalar sensor.

    Attributes
    ----------
    fit : ClusteredFit
        nT/A, in the order of `COLUMNS`.
    start, end : int
        TT2000.
    """

    fit: ClusteredFit
    start: int
    end: int

    @property
    def value(self) -> Floats:
        """``D_vector - D_scalar``, nT/A; (axis, coil). What the residual follows after correction."""
        return self.fit.value.reshape(3, 3)

    @property
    def sigma(self) -> Floats:
        """Standard deviation, nT/A; (axis, coil)."""
        return self.fit.sigma.reshape(3, 3)

    @property
    def retained(self) -> Floats:
        """Part of each column that the others do not explain; (axis, coil). Row y is weak: e_y is small."""
        return self.fit.retained.reshape(3, 3)

    @property
    def for_scalar(self) -> Floats:
        """What the scalar sensor's matrix lacks when the vector sensor's is right, nT/A; (axis, coil)."""
        return -self.value

    @property
    def level(self) -> float:
        """Noise in the band as the standard deviation of a sample of white noise, nT."""
        return float(np.sqrt(self.fit.variance))

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `retained` (axis, coil) and `covariance`."""
        dims = ("axis", "coil")
        covariance = self.fit.covariance.reshape(3, 3, 3, 3)
        return xr.Dataset(
            {
                "value": (dims, self.value, {"units": "nT/A", "at": "difference"}),
                "sigma": (dims, self.sigma, {"units": "nT/A"}),
                "retained": (dims, self.retained),
                "covariance": ((*dims, "other_axis", "other_coil"), covariance, {"units": "nT2/A2"}),
                "start": ((), self.start, {"scale": "TT2000"}),
                "end": ((), self.end, {"scale": "TT2000"}),
            },
            coords={"axis": list(AXES), "coil": list(AXES)},
            attrs={"clusters": self.fit.clusters, "rows": self.fit.rows, "level_nT": self.level},
        )


def concat_band_equations(parts: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the stored equations of several days together, in order of time."""
    return in_order_of_time(parts, "segment", "start")


def fit_band(equations: xr.Dataset, *, by: str = "segment") -> TorquerFit:
    """Solve for all nine coefficients; nothing is known of them beforehand.

    Parameters
    ----------
    equations : xarray.Dataset
        Of `band_equations`, one day or all of them.
    by : str
        What is a cluster of the covariance: ``segment``, or ``day``, with no sigma below that of segments.

    Raises
    ------
    CalibrationError
        Fewer than five clusters, or a coil without current in the band.
    """
    gram, rows = equations["gram"].values, equations["rows"].values
    if by == "day":
        _, which = np.unique(equations["day"].values, return_inverse=True)
        total = np.zeros((int(which.max()) + 1, *gram.shape[1:]))
        np.add.at(total, which, gram)
        gram, rows = total, np.bincount(which, weights=rows)
    fit = solve_clusters(gram, rows)
    if by == "day":
        # Few days, with nine numbers: along one of them their scatter may be small by chance.
        stretches = solve_clusters(equations["gram"].values, equations["rows"].values)
        wider = np.maximum(stretches.sigma / fit.sigma, 1.0)
        fit = replace(fit, covariance=fit.covariance * np.outer(wider, wider))
    return TorquerFit(fit, int(equations["start"].values.min()), int(equations["end"].values.max()))


def daily_fits(equations: xr.Dataset) -> xr.Dataset:
    """Return each day's own fit; days with too few stretches are left out and counted.

    Returns
    -------
    xarray.Dataset
        dims day, axis, coil: `value`, `sigma` nT/A, `retained`; `start`, `end` (day); attribute
        ``days_left_out``.
    """
    gram, rows, start, end, day = (equations[name].values for name in ("gram", "rows", "start", "end", "day"))
    fits, kept, short = [], [], 0
    for this in np.unique(day):
        part = np.flatnonzero(day == this)
        if part.size < SOLVER_SETTINGS.fewest_clusters:
            short += 1
            continue
        fit = solve_clusters(gram[part], rows[part])
        fits.append(TorquerFit(fit, int(start[part].min()), int(end[part].max())))
        kept.append(int(this))
    if not fits:
        raise SamplesError(
            f"{short} days found, none with {SOLVER_SETTINGS.fewest_clusters} stretches of samples",
            remedy="lower 'longest' when the equations are made, or fit all days together",
        )
    first = fits[0].table().drop_vars("covariance")
    series = {str(name): np.array([getattr(fit, str(name)) for fit in fits]) for name in first.data_vars}
    return xr.Dataset(
        {name: (("day", *first[name].dims), values, first[name].attrs) for name, values in series.items()},
        coords={"day": kept, **first.coords},
        attrs={"days_left_out": short},
    )


def robust_mean(daily: xr.Dataset) -> xr.Dataset:
    """Return the robust mean of daily values, component by component, with the error of their scatter.

    Days weigh with their own variance and Tukey's biweight about the mean, from the weighted median
    on. The error is that of the scatter between days, whatever their own errors are. Few days may agree by
    chance in one component: the scatter over their errors, of all nine together, counts as nine more days.

    Parameters
    ----------
    daily : xarray.Dataset
        Of `daily_fits`.

    Returns
    -------
    xarray.Dataset
        dims axis, coil: `value`, `sigma`, `median` nT/A, `scatter` (robust standard deviation of a
        day over its sigma: 1 when the days differ by their errors).
    """
    value, sigma = (daily[name].values.reshape(daily.sizes["day"], -1) for name in ("value", "sigma"))
    if len(value) < SOLVER_SETTINGS.fewest_clusters:
        raise SamplesError(
            f"{len(value)} days, at least {SOLVER_SETTINGS.fewest_clusters} needed for the error of a mean",
            remedy="take more days",
        )
    columns = [_biweight_mean(value[:, i], sigma[:, i]) for i in range(9)]
    dims = ("axis", "coil")
    mean, error, formal, scatter = (np.array(part).reshape(3, 3) for part in zip(*columns, strict=True))
    days, ratio = len(value), (error / formal) ** 2
    ratio = ((days - 1) * ratio + ratio.size * ratio.mean()) / (days - 1 + ratio.size)
    error = student_sigma(days + ratio.size) * formal * np.sqrt(ratio)
    return xr.Dataset(
        {
            "value": (dims, mean, {"units": "nT/A", "at": "difference"}),
            "sigma": (dims, error, {"units": "nT/A"}),
            "median": (dims, np.median(value, axis=0).reshape(3, 3), {"units": "nT/A"}),
            "scatter": (dims, scatter),
        },
        coords={"axis": list(AXES), "coil": list(AXES)},
        attrs={"days": len(value)},
    )


def _biweight_mean(value: Floats, sigma: Floats) -> tuple[float, float, float, float]:
    """Return mean, its error by the scatter and by `sigma`, and the scatter, of (day,) of one component."""
    own = 1.0 / np.maximum(sigma, 0.5 * np.median(sigma)) ** 2
    order = np.argsort(value)
    share = np.cumsum(own[order]) / own.sum()
    mean = float(value[order][np.searchsorted(share, 0.5)])
    for _ in range(TORQUER_SETTINGS.passes):
        standardised = (value - mean) * np.sqrt(own)
        scatter = robust_sigma(standardised, floor=1e-12)
        weight = own * biweight(standardised / scatter)
        mean = float(weight @ value / weight.sum())
    # A day that weighs much pulls the mean to itself: its residual is scaled to its size without the pull.
    share = weight / weight.sum()
    residual = (value - mean) / (1.0 - np.minimum(share, TORQUER_SETTINGS.most_share))
    error, formal = np.sqrt(np.sum((share * residual) ** 2)), np.sqrt(np.sum(share**2 / own))
    return mean, float(error), float(formal), scatter


def band_spectra(
    stamps: Int64,
    residual: Floats,
    direction: Floats,
    current: Floats,
    value: Floats,
    *,
    length: float = 2000.0,
) -> xr.Dataset:
    """Return the spectra of dB before and after ``e.(value I)`` is subtracted.

    Parameters
    ----------
    stamps, residual, direction, current
        As for `band_equations`.
    value : ndarray, shape (3, 3)
        ``D_vector - D_scalar``, nT/A.
    length : float
        Seconds of a stretch; its inverse is the resolution.

    Returns
    -------
    xarray.Dataset
        `before`, `after` (frequency) nT^2/Hz, one-sided, with a Hann window, which nothing is fitted
        with; attribute ``segments``.
    """
    cadence = usual_step(stamps) / SECOND
    cleaned = residual - np.einsum("tj,jk,tk->t", direction, value, current)
    both = np.stack([residual, cleaned])
    count = round(length / cadence)
    total, segments = np.zeros((2, count // 2 + 1)), 0
    for part in _stretches(stamps, np.isfinite(both).all(axis=0), cadence, np.inf, length):
        frequency, power = _segment_spectra(both[:, part], cadence, count)
        total, segments = total + power.sum(axis=1), segments + power.shape[1]
    if not segments:
        raise SamplesError(f"no stretch of {length:g} s without a gap", remedy="lower 'length'")
    units = {"units": "nT2/Hz"}
    return xr.Dataset(
        {name: ("frequency", total[i] / segments, units) for i, name in enumerate(("before", "after"))},
        coords={"frequency": ("frequency", frequency, {"units": "Hz"})},
        attrs={"segments": segments, "cadence_s": cadence},
    )


def _segment_spectra(values: Floats, cadence: float, count: int) -> tuple[Floats, Floats]:
    """Return frequencies (Hz) and spectra of segments of so many samples, half of each the next one's too.

    Values are (series, time), spectra (series, segment, frequency). All at once: `scipy.signal.welch` takes
    segments of one series one after the other, and averages them.
    """
    segments = sliding_window_view(values, count, axis=1)[:, :: count - count // 2]
    frequency, power = scipy.signal.welch(
        segments, 1.0 / cadence, "hann", count, 0, detrend=_without_line, axis=-1
    )
    return frequency, power


def _without_line(values: Floats) -> Floats:
    """Return series (..., time) less the straight line through each.

    As `scipy.signal.detrend`, which solves least squares for each stretch: a fiftieth of its time.
    """
    time = np.arange(values.shape[-1]) - 0.5 * (values.shape[-1] - 1)
    level = values - values.mean(axis=-1, keepdims=True)
    return np.asarray(level - (level @ time / (time @ time))[..., None] * time)


def instrument_spectra(stamps: Int64, vector: Floats, scalar: Floats) -> xr.Dataset:
    """Return the spectrum of each instrument's field about the torquers' band (Yin 2010, Fig. 3.12).

    First differences take the orbit's slow part out before the transform, and their gain is taken out of the
    spectrum again: it is that of the field.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, rising, at one cadence but for gaps.
    vector, scalar : ndarray, shape (time,)
        |B| of the corrected vector and the corrected scalar reading, nT; NaN where missing.

    Returns
    -------
    xarray.Dataset
        dim row: `frequency` Hz; `vector`, `scalar` nT^2/Hz, one-sided; `segments` that were averaged, half of
        each shared with the next.

    Raises
    ------
    SamplesError
        The cadence is too slow for the band, or no stretch is long enough.
    """
    settings, cadence = SPECTRA_SETTINGS, usual_step(stamps) / SECOND if stamps.size > 1 else np.inf
    if 0.5 / cadence <= settings.flanks[1][1]:
        raise SamplesError(
            f"samples every {cadence:g} s do not hold {settings.flanks[1][1]:g} Hz",
            remedy="take the readings at the magnetometers' own cadence",
        )
    both, count = np.stack([vector, scalar]), round(settings.length / cadence)
    total, segments = np.zeros((2, count // 2 + 1)), 0
    for part in _stretches(stamps, np.isfinite(both.sum(axis=0)), cadence, np.inf, settings.length + cadence):
        frequency, power = _segment_spectra(np.diff(both[:, part], axis=1), cadence, count)
        total, segments = total + power.sum(axis=1), segments + power.shape[1]
    if not segments:
        raise SamplesError(f"no stretch of {settings.length:g} s without a gap", remedy="take another span")
    kept = (frequency >= settings.flanks[0][0]) & (frequency <= settings.flanks[1][1])
    power = (total / segments / np.maximum(2.0 * np.sin(np.pi * frequency * cadence), 1e-12) ** 2)[:, kept]
    rows = {"frequency": frequency[kept], "vector": power[0], "scalar": power[1]}
    rows["segments"] = np.full(int(kept.sum()), float(segments))
    return xr.Dataset({f"{name}": ("row", values) for name, values in rows.items()})


def torquer_lines(days: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return what each instrument holds in the torquers' band above the spectrum beside it.

    The neighbours' course, a power of the frequency above white noise, is bent in a diagram of logarithms: a
    parabola is fitted in the flanks.

    Parameters
    ----------
    days : sequence of Dataset
        Of `instrument_spectra`; those of other frequencies than the first are left out.

    Returns
    -------
    xarray.Dataset
        dims sensor (vector, scalar), frequency: `power`, `beside` nT^2/Hz; of each sensor `excess` nT^2 and
        `excess_sigma`, `value` nT rms (the root, 0 where it is negative) and `sigma`.

    Raises
    ------
    SamplesError
        When there is no day.
    """
    if not days:
        raise SamplesError(
            "no day has torquer currents and readings faster than 5 s for a spectrum of each instrument",
            remedy="see the channel's missing days, and the cadence",
        )
    settings, frequency = SPECTRA_SETTINGS, np.asarray(days[0]["frequency"].values)
    same = [day for day in days if np.array_equal(day["frequency"].values, frequency)]
    weight = np.array([float(day["segments"].values[0]) for day in same])
    power = np.array([[day[name].values for name in ("vector", "scalar")] for day in same])
    power = np.einsum("d,dsf->sf", weight, power) / weight.sum()
    low, high = TORQUER_BAND_HZ
    band = (frequency >= low) & (frequency <= high)
    flank = np.any([(frequency >= first) & (frequency <= last) for first, last in settings.flanks], axis=0)
    away = np.log(frequency / np.mean(TORQUER_BAND_HZ))
    columns = np.vander(away, 3)
    inverse = np.linalg.inv(columns[flank].T @ columns[flank])
    course = inverse @ columns[flank].T @ np.log(power[:, flank]).T
    beside = np.exp(columns @ course).T
    misfit = (np.log(power / beside)[:, flank] ** 2).sum(axis=1) / (flank.sum() - columns.shape[1])
    step = float(frequency[1] - frequency[0])
    excess = ((power - beside)[:, band]).sum(axis=1) * step
    # Hann windows that overlap by half: 1.056 of independent ones (Welch 1967), and neighbours share 4/9.
    shared = 1.0 + 8.0 / 9.0
    chance = (power[:, band] ** 2).sum(axis=1) * shared * 1.056 / weight.sum()
    moved = beside[:, band] @ columns[band]
    of_course = misfit * shared * np.einsum("si,ij,sj->s", moved, inverse, moved)
    sigma = np.sqrt(chance + of_course) * step
    value = np.sqrt(np.maximum(excess, 0.0))
    each = ("sensor", "frequency")
    return xr.Dataset(
        {
            "power": (each, power, {"units": "nT2/Hz"}),
            "beside": (each, beside, {"units": "nT2/Hz"}),
            "excess": ("sensor", excess, {"units": "nT2"}),
            "excess_sigma": ("sensor", sigma, {"units": "nT2"}),
            "value": ("sensor", value, {"units": "nT"}),
            # The root's error from that of the square, also where the square is near zero.
            "sigma": ("sensor", np.sqrt(value**2 + sigma) - value, {"units": "nT"}),
        },
        coords={"sensor": ["vector", "scalar"], "frequency": ("frequency", frequency, {"units": "Hz"})},
        attrs={"days": len(same), "told": _which_sensor(excess, sigma, value)},
    )


def _which_sensor(excess: Floats, sigma: Floats, value: Floats) -> str:
    """Return which sensor's torquer correction is wrong, in a sentence."""
    seen, least = excess > SPECTRA_SETTINGS.sure * sigma, SPECTRA_SETTINGS.sure * float(np.hypot(*sigma))
    if not seen.any():
        return "neither instrument has a line of the torquers: what their matrices lack is below the noise"
    if abs(excess[0] - excess[1]) < least:
        return "both instruments have a line of the torquers, of one size"
    more = ("vector", "scalar")[int(np.argmax(excess))]
    return f"the torquer matrix of the {more} sensor lacks more: its line is {value.max():.3g} nT rms"


#: nT/A at the scalar sensor, from the test on ground (Yin 2010: 0.0071 nT/mA).
ETA = 7.1

#: Days of the running mean: the local time falls by 24 h.
CURRENT_WINDOW_DAYS = 260.0

#: How a value came about; codes of `FilledRunningMean.state`.
MEAN_STATES = ("whole", "partial", "interpolated", "held")


@dataclass(frozen=True)
class FilledRunningMean:
    """Running mean of daily means; every day from the first to the last has a value.

    Attributes
    ----------
    day : ndarray of int64, shape (day,)
        Days since 1970-01-01.
    value, sigma : ndarray, shape (day, 3)
        A.
    coverage : ndarray, shape (day,)
        Part of the window around the day that has data, in [0, 1].
    state : ndarray of int8, shape (day,)
        Codes of `MEAN_STATES`: *whole* window; *partial*, the mean of what is there; *interpolated*
        between days with enough coverage; *held* at the nearest such day, at the ends of the record.
    daily : ndarray, shape (day, 3)
        The daily means, A; NaN where there are none.
    window : float
        Days.
    """

    day: Int64
    value: Floats
    sigma: Floats
    coverage: Floats
    state: npt.NDArray[np.int8]
    daily: Floats
    window: float

    @property
    def sentence(self) -> str:
        """How many days have a whole, partial, interpolated or held mean."""
        count = {name: int(np.sum(self.state == code)) for code, name in enumerate(MEAN_STATES)}
        states = ", ".join(f"{number} {name}" for name, number in count.items() if number)
        return f"running mean of {self.window:g} d over {self.day.size} days: {states}"

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma` (interval, axis) A, `coverage` and `state`, one interval a day."""
        dims = ("interval", "axis")
        bounds = np.array([day_bounds(np.datetime64(int(day), "D")) for day in self.day], dtype=np.int64)
        days = xr.Dataset(
            {
                "start": ("interval", bounds[:, 0], {"scale": "TT2000"}),
                "end": ("interval", bounds[:, 1], {"scale": "TT2000"}),
            },
            coords={"axis": list(AXES)},
        )
        return days.assign(
            value=(dims, self.value, {"units": "A"}),
            sigma=(dims, self.sigma, {"units": "A"}),
            daily=(dims, self.daily, {"units": "A"}),
            coverage=("interval", self.coverage),
            state=("interval", self.state, {"flag_meanings": " ".join(MEAN_STATES)}),
        )


def filled_running_mean(
    day: Int64, value: Floats, count: Floats, *, window: float = CURRENT_WINDOW_DAYS, least: float = 0.9
) -> FilledRunningMean:
    """Return the centred running mean of daily mean currents, filled on the days that have none.

    Parameters
    ----------
    day : ndarray of int64, shape (given,)
        Days since 1970-01-01, each once, in any order; days may be missing.
    value : ndarray, shape (given, 3)
        Daily means of the torquer currents, A; NaN for none.
    count : ndarray, shape (given,)
        Samples behind each. A day weighs by them, at most like a usual day.
    window : float
        Days; the days at its ends weigh by the part of them inside.
    least : float
        Part of the window that must have data. Below it nothing is averaged: such days are
        interpolated, or held at the ends, with a sigma that grows as the mean itself changes.

    Returns
    -------
    FilledRunningMean
        `sigma` holds the scatter of days, ``(1 - coverage)`` times the spread of the daily values in
        the window (the missing part may be any part of the local time's cycle), and the change of the
        mean over the time to the nearest day with a mean.

    Raises
    ------
    SamplesError
        Shapes differ, a day is given twice, or nowhere is the window covered.
    """
    daily, weight = _daily_values(day, value, count)
    first = int(np.min(day))
    means = window_means(daily, weight, window)
    mean, spread, coverage = means.mean, means.spread, means.coverage
    good = coverage >= least
    if not good.any():
        raise SamplesError(
            f"the window of {window:g} d has at most {coverage.max():.0%} of its days within {len(daily)}; "
            f"{least:.0%} needed",
            remedy="take a longer span, a shorter window, or lower 'least'",
        )
    # The scatter that neighbouring days do not share; not the long-run variance of
    # `parameters.running_mean`: what they share repeats with the local time, and the window removes it.
    steps = np.abs(np.diff(daily, axis=0))
    steps = steps[np.isfinite(steps).all(axis=1)]
    scatter = MAD_TO_SIGMA * np.median(steps, axis=0) / np.sqrt(2.0) if len(steps) else np.zeros(3)
    sigma = np.hypot(
        scatter / np.sqrt(np.maximum(means.weight, 1e-12))[:, None], (1.0 - coverage)[:, None] * spread
    )
    state = np.where(coverage >= TORQUER_SETTINGS.whole, 0, 1).astype(np.int8)
    mean, sigma, state = _fill_uncovered(mean, sigma, state, good, spread[good].max(axis=0))
    days = first + np.arange(daily.shape[0], dtype=np.int64)
    return FilledRunningMean(days, mean, sigma, coverage, state, daily, window)


def _daily_values(day: Int64, value: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return daily values (day, 3) and weights (day,) with no day left out."""
    given = np.asarray(day, dtype=np.int64)
    if np.shape(value) != (given.size, 3) or np.shape(count) != given.shape or not given.size:
        raise SamplesError(
            f"days have shape {given.shape}, values {np.shape(value)}, counts {np.shape(count)}",
            remedy="give one mean of three currents and one count a day",
        )
    if np.unique(given).size != given.size:
        raise SamplesError("a day is given twice", remedy="join the parts of a day first")
    place = given - given.min()
    daily = np.full((int(place.max()) + 1, 3), np.nan)
    daily[place] = value
    weight = np.zeros(daily.shape[0])
    weight[place] = count
    weight = np.where(np.isfinite(daily).all(axis=1), weight, 0.0)
    if not np.any(weight > 0):
        raise SamplesError("no day has a mean current", remedy="take days with torquer currents")
    return daily, np.minimum(weight / np.median(weight[weight > 0]), 1.0)


def _fill_uncovered(
    mean: Floats,
    sigma: Floats,
    state: npt.NDArray[np.int8],
    good: npt.NDArray[np.bool_],
    unknown: Floats,
) -> tuple[Floats, Floats, npt.NDArray[np.int8]]:
    """Interpolate and hold where the window was not covered; sigma grows as the mean can have changed."""
    known = np.flatnonzero(good)
    index = np.arange(good.size)
    filled = np.stack([np.interp(index, known, mean[known, i]) for i in range(3)], axis=1)
    width = np.stack([np.interp(index, known, sigma[known, i]) for i in range(3)], axis=1)
    after = np.clip(np.searchsorted(known, index), 0, known.size - 1)
    before = np.clip(np.searchsorted(known, index, side="right") - 1, 0, known.size - 1)
    away = np.minimum(np.abs(index - known[before]), np.abs(index - known[after]))
    change = _rms_change(mean, good, int(away.max()), unknown)[away]
    outside = (index < known[0]) | (index > known[-1])
    return filled, np.hypot(width, change), np.where(good, state, np.where(outside, 3, 2)).astype(np.int8)


def _rms_change(mean: Floats, good: npt.NDArray[np.bool_], longest: int, unknown: Floats) -> Floats:
    """Return by how much (rms) the running mean changes over 0, 1, ... `longest` days; (day + 1, 3).

    Beyond the lags that the covered days show it grows in proportion; with none it is `unknown`.
    """
    change = np.zeros((longest + 1, 3))
    measured = 0
    for lag in range(1, longest + 1):
        both = good[lag:] & good[:-lag]
        if both.sum() >= TORQUER_SETTINGS.fewest_pairs:
            change[lag] = np.sqrt(np.mean((mean[lag:][both] - mean[:-lag][both]) ** 2, axis=0))
            measured = lag
        else:
            change[lag] = change[measured] * lag / measured if measured else unknown
    return change


def remanent_field(mean: FilledRunningMean, *, eta: float = ETA, eta_sigma: float = 0.0) -> xr.Dataset:
    """Return the body's remanent field at the scalar sensor, one interval a day.

    Parameters
    ----------
    mean : FilledRunningMean
    eta, eta_sigma : float
        nT/A at the scalar sensor.

    Returns
    -------
    xarray.Dataset
        dims interval, axis: `value`, `sigma` nT at the scalar sensor, spacecraft axes: added to its
        reading as e.value, subtracted with the torquers' own field; `covariance` (interval, axis, other);
        `coverage`, `state`, `start`, `end`.
    """
    across = np.array([0.0, 1.0, 1.0])
    current, spread = mean.value * across, mean.sigma * across
    # Eta is common to both components.
    covariance = eta**2 * np.einsum("ti,ij->tij", spread**2, np.eye(3))
    covariance = covariance + eta_sigma**2 * np.einsum("ti,tj->tij", current, current)
    dims = ("interval", "axis")
    return (
        mean.table()
        .drop_vars("daily")
        .assign(
            value=(dims, eta * current, {"units": "nT", "at": "scalar"}),
            sigma=(dims, np.sqrt(np.einsum("tii->ti", covariance)), {"units": "nT"}),
            covariance=((*dims, "other"), covariance, {"units": "nT2"}),
            eta=((), eta, {"units": "nT/A"}),
        )
    )


@dataclass(frozen=True)
class EtaFit:
    """How the residual follows the mean torquer current.

    Attributes
    ----------
    fit : ClusteredFit
        Constant field x, y, z of the residual (nT), then the difference below.
    blocks : float
        Days of a cluster.
    """

    fit: ClusteredFit
    blocks: float

    @property
    def difference(self) -> float:
        """Eta at the vector sensor minus eta at the scalar sensor, nT/A: all that dB determines."""
        return float(self.fit.value[3])

    @property
    def difference_sigma(self) -> float:
        """Standard deviation, nT/A."""
        return float(self.fit.sigma[3])

    def at_scalar(self, vector_over_scalar: float) -> tuple[float, float]:
        """Return eta at the scalar sensor and its sigma, nT/A.

        Parameters
        ----------
        vector_over_scalar : float
            The body's field at the vector sensor over that at the scalar sensor: ``(r_s/r_v)^3`` for
            a dipole on the boom's axis, 2.5625 for 4.75 and 6.5 m.

        Raises
        ------
        SettingsError
            For 1: the difference then holds nothing of the field.
        """
        share = vector_over_scalar - 1.0
        if abs(share) < 1e-6:
            raise SettingsError("both sensors see the same field", remedy="take eta from ground tests")
        return self.difference / share, self.difference_sigma / abs(share)


def fit_remanence_factor(
    day: Int64, gram: Floats, rows: Floats, mean: FilledRunningMean, *, block: int = 60
) -> EtaFit:
    """Fit dB to ``e.(0, mean I_y, mean I_z)`` and a constant field.

    A constant remanent field looks like an offset of the vector sensor, so only the change of the mean
    current determines it, and only while the offsets are held constant. A drift of theirs of the same
    course is not separated. Days whose running mean was interpolated or held are left out. The error of the
    running mean itself, which lasts for a window, is in the sigma.

    Parameters
    ----------
    day : ndarray of int64, shape (given,)
        Days since 1970-01-01.
    gram : ndarray, shape (given, 4, 4)
        Of [e_x, e_y, e_z | dB], dB in nT, of each day.
    rows : ndarray, shape (given,)
        Samples behind each.
    mean : FilledRunningMean
    block : int
        Days of a cluster: at least three times the correlation time of the residual's slow errors.

    Raises
    ------
    CalibrationError
        The mean current does not change, or there are too few days.
    """
    place = np.asarray(day) - mean.day[0]
    inside = (place >= 0) & (place < mean.day.size)
    inside[inside] = mean.state[place[inside]] < 2
    chosen = place[inside]
    if not chosen.size:
        raise CalibrationError("no day has a running mean of its own", remedy="take a longer span")
    current = mean.value[chosen] * [0.0, 1.0, 1.0]
    centre = current.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((current - centre) ** 2, axis=1))))
    if spread <= 1e-9 * max(float(np.linalg.norm(centre)), 1e-12):
        raise CalibrationError(
            "the mean torquer current does not change: eta is not told from an offset",
            remedy="take a longer span, or eta from ground tests",
        )
    weights = np.zeros((chosen.size, 5, 4))
    weights[:, [0, 1, 2, 4], [0, 1, 2, 3]] = 1.0
    # In units of the current's own change, so that the system is as well scaled as it can be.
    weights[:, 3, :3] = (current - centre) / spread
    wide = weights @ np.asarray(gram)[inside] @ weights.transpose(0, 2, 1)
    _, which = np.unique((chosen - chosen[0]) // block, return_inverse=True)
    total = np.zeros((int(which.max()) + 1, 5, 5))
    np.add.at(total, which, wide)
    fit = solve_clusters(total, np.bincount(which, weights=np.asarray(rows)[inside]).astype(np.float64))
    scale = np.array([1.0, 1.0, 1.0, 1.0 / spread])
    covariance = fit.covariance * np.outer(scale, scale)
    of_mean = float(np.sqrt(np.mean(np.sum(mean.sigma[chosen][:, 1:] ** 2, axis=1)) / 2.0))
    independent = max(1.0, chosen.size / mean.window)
    covariance[3, 3] += (fit.value[3] / spread * of_mean / spread) ** 2 / independent
    return EtaFit(
        ClusteredFit(
            fit.value * scale,
            covariance,
            fit.retained,
            fit.determined,
            fit.variance,
            fit.clusters,
            fit.rows,
        ),
        float(block),
    )
