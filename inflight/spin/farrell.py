"""Sensor angles and zero levels from spin fits (Farrell et al. 1995), and the bending of a boom.

Takes: spin fits of a triad (`inflight.spin.fits.fit_spins`): constants C0 and phasors ``Z = C2 - i C1`` of
sensors 1 and 2 (spin plane) and 3 (spin axis). Makes (`calibrate_farrell`): `FarrellFit`, elevations, tilt,
azimuth difference, gain ratio and zero levels with their covariance; `SensorAngles`, whose `remove` turns
readings into apparent fields; and (`measure_boom_bending`) the azimuth of an outer from an inner triad.

Directions, eqs. (2) to (20), to first order; `SensorAngles.matrix` is exact::

    R1 = (1, dph1, dth1),  R2 = (-dph2, 1, dth2),  R3 = (dth3 cos ph3, dth3 sin ph3, 1)

Slope/Intercept: C0 of sensor 1 or 2 against that of sensor 3; the slope is the elevation dth, the intercept
the zero level (eq. 23) only where O3 is known: it is ``O1 - dth1 O3``. An elevation is the slope of nT
against nT, ``slope / S3`` of nT against counts (eq. 34), ``slope S1 / S3`` of counts against counts.

Beta/Phi: Z3 against Z1 gives the tilt and its azimuth (eqs. 24, 25); Z2 against Z1 the total phase
``90 deg + dph2 - dph1`` (eq. 31). Only differences of azimuths show; dph1 comes from before the flight.

Misprints of the paper, corrected here: (13) begins with *minus* dph2 Bsp cos wt; (24) has the reversed sign:
``ph3 - dph1 = arg(Z3 / Z1)``; (31) has its ratio inverted and its sign reversed:
``90 deg + dph2 - dph1 = arg(Z2 / Z1)``; (32) has the wrong sign, (33) the right one; (35) after (32, 33)
counts dph^2 twice.

Lines have errors along both axes (Fuller 1987, section 1.2), local weights, and scores that are correlated in
time. Bending (section VI, Fig. 6): both triads see one spin-plane field, the outer one turned by the bend,
``dph = arg(Z1_out / Z1_in)``; what the field does between two spins is in both and cancels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.lsq import (
    BIWEIGHT_RMS_FACTOR,
    MAD_TO_SIGMA,
    biweight,
    biweight_slope,
    long_run_covariance,
    sigma_of_mean,
)
from inflight.spin.fits import SpinFits
from inflight.time import DAY, SECOND, Int64, utc_text

Complexes = npt.NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class FarrellSettings:
    """Numbers of the fits of lines to spin fits.

    Attributes
    ----------
    least_determinant : float
        Three directions whose determinant is smaller lie nearly in a plane and are not inverted. Assumed.
    around : int
        Fits around each whose median residual is its scatter: regions differ by orders of magnitude. Assumed.
    rounds : int
        Rounds of weights and line. Assumed.
    quiet_percent : float
        Part of the fits, those of least residual, that gives the noise of the instrument: the field only adds
        to it. Assumed.
    most_noise : float
        A line is refused when noise makes more than this part of the variance along x. Assumed.
    fewest : int
        Fits that a line or a window needs. Assumed.
    own_scatter : int
        Points of a window from which on its own scatter gives the error of its mean; with fewer that of the
        whole span is taken. Assumed.
    spins : int
        Spins that are averaged before lines are fitted. Within one spin a compressed field changes along all
        axes at once, and what it does near the spin period leaks into both constants: a slope that no angle
        has, half a sigma for an hour of single spins. Over several spins the leak of the one and the mean of
        the other have no frequency in common. Measured: docs/science/farrell.md.
    seen : float
        Sigmas of a tilt from which on its azimuth is given. Level of significance: 0.3 %.
    """

    least_determinant: float = 0.05
    around: int = 101
    rounds: int = 8
    quiet_percent: float = 10.0
    most_noise: float = 0.5
    fewest: int = 10
    own_scatter: int = 30
    spins: int = 8
    seen: float = 3.0


FARRELL_SETTINGS = FarrellSettings()

#: Parameters of a `FarrellFit` in order, and their units.
NAMES = ("elevation_1", "elevation_2", "tilt_x", "tilt_y", "azimuth_2 - azimuth_1", "gain_ratio")

UNITS = ("rad", "rad", "rad", "rad", "rad", "1")


@dataclass(frozen=True)
class SensorAngles:
    """Directions of the sensors in apparent axes, and their zero levels; angles in radians.

    Attributes
    ----------
    elevation : ndarray, shape (2,)
        Of sensors 1 and 2 out of the spin plane, towards +Z.
    azimuth : ndarray, shape (2,)
        Of sensor 1 from XA and of sensor 2 from YA, both positive in the sense from XA to YA.
    tilt, tilt_azimuth : float
        Of sensor 3 from the spin axis, and the azimuth from XA it is tilted towards.
    zero : ndarray, shape (3,)
        Zero levels, nT: what the sensors read in no field.
    """

    elevation: Floats = field(default_factory=lambda: np.zeros(2))
    azimuth: Floats = field(default_factory=lambda: np.zeros(2))
    tilt: float = 0.0
    tilt_azimuth: float = 0.0
    zero: Floats = field(default_factory=lambda: np.zeros(3))

    def matrix(self) -> Floats:
        """Return the directions R1, R2, R3 as rows, exact; (3, 3)."""
        out = np.empty((3, 3))
        azimuth = self.azimuth + np.array([0.0, np.pi / 2])
        flat = np.cos(self.elevation)
        out[:2, 0], out[:2, 1] = flat * np.cos(azimuth), flat * np.sin(azimuth)
        out[:2, 2] = np.sin(self.elevation)
        aside = np.sin(self.tilt)
        out[2] = aside * np.cos(self.tilt_azimuth), aside * np.sin(self.tilt_azimuth), np.cos(self.tilt)
        return out

    def disturb(self, fields: Floats) -> Floats:
        """Return what the sensors read in apparent fields (time, 3), nT."""
        return np.asarray(_vectors(fields) @ self.matrix().T + self.zero)

    def remove(self, readings: Floats) -> Floats:
        """Return apparent fields (time, 3), nT, from readings, by the exact inverse of [R1; R2; R3].

        Raises
        ------
        CalibrationError
            When the three directions lie in a plane.
        """
        matrix = self.matrix()
        if abs(float(np.linalg.det(matrix))) < FARRELL_SETTINGS.least_determinant:
            raise CalibrationError(
                f"the three sensors' directions are nearly in one plane: {matrix.round(3).tolist()}",
                remedy="see the angles and their sigmas before they are used",
            )
        return np.asarray((_vectors(readings) - self.zero) @ np.linalg.inv(matrix).T)

    def remove_first_order(self, readings: Floats, *, azimuth: bool = False, second: bool = False) -> Floats:
        """Return apparent fields by the steps of IMP-8, as a check on the exact inverse.

        The zero levels and ``dth Bz`` leave sensors 1 and 2, ``dth3 Bsp cos(ph3 - sg)`` leaves sensor 3, with
        ``sg = atan2(B2, B1)`` (eqs. 26, 27, 30; here each sample's own Bz, not the fit's C0).

        Parameters
        ----------
        readings : ndarray, shape (time, 3)
            nT.
        azimuth : bool
            Also B1 - dph1 B2 and B2 + dph2 B1 (eq. 32 with its sign reversed, and eq. 33).
        second : bool
            Also ``e B`` (eq. 35), with e of the elevation alone where `azimuth` is taken out: e with dph in
            it after (32) and (33) counts dph^2 twice.
        """
        one, two, three = (_vectors(readings) - self.zero).T
        x, y = one - self.elevation[0] * three, two - self.elevation[1] * three
        strength, angle = np.hypot(x, y), np.arctan2(y, x)
        z = three - self.tilt * strength * np.cos(self.tilt_azimuth - angle)
        if azimuth:
            x, y = x - self.azimuth[0] * y, y + self.azimuth[1] * x
        if second:
            turned = 0.0 if azimuth else 1.0
            share = 0.5 * (self.elevation**2 + turned * self.azimuth**2)
            x, y, z = x * (1.0 + share[0]), y * (1.0 + share[1]), z * (1.0 + 0.5 * self.tilt**2)
        return np.stack([x, y, z], axis=1)


def _vectors(given: Floats) -> Floats:
    if given.ndim != 2 or given.shape[1] != 3:
        raise SamplesError(f"vectors of shape {given.shape} found", remedy="give (time, 3)")
    return given


def azimuth_between(fits: SpinFits, first: int, second: int) -> npt.NDArray[np.float64]:
    """Return the azimuth of one sensor from another at every fit, radians in (-pi, pi]; (fit,).

    ``arg(Z_second / Z_first) = atan2(C1, C2) of the first - atan2(C1, C2) of the second``: eqs. (24) and (31)
    with their signs reversed, and the ratio of (31) the right way up.
    """
    phasor = fits.phasor
    return np.asarray(np.angle(phasor[:, second] * np.conj(phasor[:, first])))


@dataclass(frozen=True, kw_only=True)
class Line:
    """A regression through zero after each group's own mean is taken off (or none is).

    Attributes
    ----------
    slope : complex
        Real for real data.
    scores : ndarray, shape (fit,)
        What each fit adds to the slope's error; their long-run covariance is the slope's.
    weight : ndarray, shape (fit,)
    residual : ndarray, shape (fit,)
        Along y.
    reliability : float
        Part of the weighted variance along x that is no noise.
    plain : complex
        Slope without regard of the errors along x, biased towards zero.
    """

    slope: complex
    scores: Complexes
    weight: Floats
    residual: Complexes
    reliability: float
    plain: complex


def fit_line(
    x: Complexes | Floats,
    y: Complexes | Floats,
    noise: Floats,
    group: Int64 | None = None,
) -> Line:
    """Fit ``y = slope x (+ a constant for each group)`` where x has errors of known variance.

    The variance of the noise is taken off the sum of squares along x (Fuller 1987, section 1.2): with the
    scatter along y found from the residual, this is the line that York's and Deming's equations give, without
    their iteration.

    Parameters
    ----------
    x, y : ndarray, shape (fit,)
        Real or complex, finite.
    noise : ndarray, shape (fit,)
        Variance of x, both parts together.
    group : ndarray of int64, shape (fit,), optional
        Number from 0 of the group of each fit, which has its own constant; none has one when absent.

    Raises
    ------
    CalibrationError
        Too few fits, or an x that hardly changes.
    """
    if x.size < FARRELL_SETTINGS.fewest:
        raise CalibrationError(
            f"{x.size} whole spin fits found, at least {FARRELL_SETTINGS.fewest} needed",
            remedy="take a longer span",
        )
    z, v = np.asarray(x, dtype=np.complex128), np.asarray(y, dtype=np.complex128)
    weight, kept, slope_weight = np.ones(x.size), 1.0, np.ones(x.size)
    for turn in range(FARRELL_SETTINGS.rounds):
        across, along = _centred(v, weight, group), _centred(z, weight, group)
        square = float(np.sum(weight * np.abs(along) ** 2))
        error = kept * float(np.sum(weight * noise))
        cross = complex(np.sum(weight * np.conj(along) * across))
        if not square > 0 or error > FARRELL_SETTINGS.most_noise * square:
            total = max(float(weight.sum()), 1e-300)
            raise CalibrationError(
                f"what the line is fitted along changes by {np.sqrt(square / total):.3g} nT rms over {x.size}"
                f" fits, and {np.sqrt(error / total):.3g} nT of that is noise",
                remedy="take a span in which the field changes more, or fits of more spins",
            )
        slope = cross / (square - error)
        residual = across - slope * along
        if turn < FARRELL_SETTINGS.rounds - 1:
            weight, slope_weight = _robust_weights(residual, real=np.isrealobj(x))
            # Residuals that are all noise along x keep what the biweight keeps of a Gaussian's variance.
            total = float(np.sum(weight * np.abs(residual) ** 2))
            part = abs(slope) ** 2 * float(np.sum(weight * noise)) / total if total > 0 else 0.0
            kept = 1.0 - min(part, 1.0) * (1.0 - BIWEIGHT_RMS_FACTOR**2)
    # Weights follow the residuals: the slope answers by more than with fixed weights.
    response = float(np.sum(slope_weight * np.abs(along) ** 2)) / square
    scores = weight * (np.conj(along) * residual + slope * kept * noise) / (square - error) / response
    return Line(
        slope=slope,
        scores=np.asarray(scores),
        weight=weight,
        residual=np.asarray(residual),
        reliability=1.0 - error / square,
        plain=cross / square,
    )


def _centred(values: Complexes, weight: Floats, group: Int64 | None) -> Complexes:
    """Return values less the weighted mean of their group."""
    if group is None:
        return values
    return np.asarray(values - group_means(values, weight, group)[group])


def group_means(values: Complexes, weight: Floats, group: Int64) -> Complexes:
    """Return the weighted mean of each group; groups are numbered from 0."""
    total = np.bincount(group, weight)
    parts = [np.bincount(group, weight * part) for part in (values.real, values.imag)]
    return np.asarray((parts[0] + 1j * parts[1]) / np.where(total > 0, total, np.nan))


def _robust_weights(residual: Complexes, *, real: bool) -> tuple[Floats, Floats]:
    """Return the weights of fits by the scatter around each, and the slope of weight times residual.

    The scatter is that of the differences of neighbours: by residuals from zero, fits of a drifting sensor
    that happen to be near the line would draw it to themselves.
    """
    step = np.abs(np.diff(residual, prepend=residual[:1] + residual[0] - residual[1]))
    scatter = MAD_TO_SIGMA / np.sqrt(2.0) * _median_around(step)
    scatter = np.maximum(scatter, np.percentile(scatter, FARRELL_SETTINGS.quiet_percent))
    size = np.abs(residual)
    usual = np.maximum(MAD_TO_SIGMA * _median_around(size), scatter)
    known = usual > 0
    scaled = np.divide(size, usual, out=np.zeros_like(size), where=known)
    base = np.divide(1.0, scatter**2, out=np.ones_like(size), where=scatter > 0)
    weight = base * biweight(scaled)
    slope_weight = base * biweight_slope(scaled)
    if not real:
        # In a plane the weight changes along the residual only.
        slope_weight = 0.5 * (weight + slope_weight)
    most = float(weight.max())
    return (weight / most, slope_weight / most) if most > 0 else (np.ones(size.size), np.ones(size.size))


def _median_around(values: Floats) -> Floats:
    return np.asarray(
        scipy.ndimage.median_filter(
            values, min(FARRELL_SETTINGS.around, 2 * (values.size // 2) - 1), mode="nearest"
        )
    )


def instrument_noise(fits: SpinFits) -> Floats:
    """Return the noise of one reading by the residual of the quietest fits; (component,).

    Every fit's residual also holds fluctuations of the field; these are no error of C0, which is the mean of
    the field there was. The tenth of the fits with the least residual give the noise of the instrument, or an
    upper bound of it.
    """
    freedom = fits.count - fits.value.shape[-1]
    known = fits.determined & (freedom > 0)
    rms = np.where(known, fits.rms, np.nan)
    out = np.zeros(rms.shape[1])
    for k in range(rms.shape[1]):
        own = rms[known[:, k], k]
        if own.size:
            usual = float(np.median(freedom[known[:, k], k]))
            level = np.sqrt(scipy.stats.chi2.ppf(FARRELL_SETTINGS.quiet_percent / 100.0, usual) / usual)
            out[k] = float(np.percentile(own, FARRELL_SETTINGS.quiet_percent)) / level
    return out


@dataclass(frozen=True, kw_only=True)
class Points:
    """Means of neighbouring fits, what the lines are fitted to; arrays along ``point``, nT.

    Attributes
    ----------
    start, end : ndarray of int64, shape (point,)
        TT2000 of the first and of the last reading.
    constant, phasor : ndarray, shape (point, component)
    noise : ndarray, shape (point, component, coefficient)
        Variances by the instrument's noise.
    relative_sigma : ndarray, shape (component,)
        Relative standard deviation of these.
    """

    start: Int64
    end: Int64
    constant: Floats
    phasor: Complexes
    noise: Floats
    relative_sigma: Floats

    @property
    def time(self) -> Int64:
        """Middles, TT2000; (point,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)

    @classmethod
    def of(cls, fits: SpinFits, unit: Floats, spins: int) -> Points:
        """Return the means of fits over about `spins` spins, less where that leaves too few points.

        Parameters
        ----------
        fits : SpinFits
            Whole ones.
        unit : ndarray, shape (component,)
            nT per unit of the fits.
        spins : int
        """
        together = max(1, min(spins // fits.spins, len(fits) // (2 * FARRELL_SETTINGS.fewest)))
        block = fits.turn // (together * fits.spins)
        first = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
        count = np.diff(np.append(first, len(fits)))
        # Half a block leaks as much as its fits alone.
        kept = 2 * count >= together
        number = count.reshape(-1, 1)
        constant = np.add.reduceat(fits.constant * unit, first) / number
        phasor = np.add.reduceat(np.asarray(fits.phasor * unit), first) / number
        noise = np.add.reduceat(noise_variance(fits), first) / number[..., None] ** 2 * unit[:, None] ** 2
        start, end = fits.start[first], fits.end[first + count - 1]
        return cls(
            start=start[kept],
            end=end[kept],
            constant=constant[kept],
            phasor=np.asarray(phasor[kept], dtype=np.complex128),
            noise=noise[kept],
            relative_sigma=noise_uncertainty(fits),
        )


def noise_uncertainty(fits: SpinFits) -> Floats:
    """Return the relative standard deviation of the squares of `instrument_noise`; (component,)."""
    part = FARRELL_SETTINGS.quiet_percent / 100.0
    out = np.zeros(fits.value.shape[1])
    for k in range(out.size):
        freedom = (fits.count[:, k] - fits.value.shape[-1])[fits.determined[:, k]]
        usual = float(np.median(freedom)) if freedom.size else 0.0
        if usual > 0:
            place = float(scipy.stats.chi2.ppf(part, usual))
            spread = np.sqrt(part * (1.0 - part) / freedom.size) / scipy.stats.chi2.pdf(place, usual)
            out[k] = float(spread) / place
    return out


def noise_variance(fits: SpinFits) -> Floats:
    """Return the coefficients' variances by the instrument's noise alone; (fit, component, coefficient)."""
    noise = instrument_noise(fits)
    variance = np.einsum("fkpp->fkp", fits.covariance)
    unit = np.divide(
        variance, fits.rms[..., None] ** 2, out=np.zeros_like(variance), where=fits.rms[..., None] > 0
    )
    return np.asarray(unit * noise[None, :, None] ** 2)


@dataclass(frozen=True, kw_only=True)
class Intercepts:
    """Zero levels of the spin-plane sensors, one row a window.

    Attributes
    ----------
    start, end : ndarray of int64, shape (window,)
        TT2000 of the first and after the last reading.
    intercept : ndarray, shape (window, 2)
        nT: ``O1 - dth1 O3``.
    zero, sigma : ndarray, shape (window, 2)
        nT: the zero level with what is known of O3, and its standard deviation.
    common : ndarray, shape (window, 2)
        Part of `sigma` that all windows share with the slope's error: by how much the zero level moves for
        one sigma of the slope.
    spin_axis_zero : tuple of float
        O3 and its sigma, nT; (0, NaN) when nothing is known of it.
    """

    start: Int64
    end: Int64
    intercept: Floats
    zero: Floats
    sigma: Floats
    common: Floats
    spin_axis_zero: tuple[float, float]

    @property
    def time(self) -> Int64:
        """Middles of the windows, TT2000; (window,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)

    def summary(self) -> str:
        """Return the last window's zero levels in words."""
        both = " and ".join(
            f"{value:+.3f} +- {sigma:.3f} nT"
            for value, sigma in zip(self.zero[-1], self.sigma[-1], strict=True)
        )
        name = "zero levels" if np.isfinite(self.spin_axis_zero[1]) else "intercepts (O3 not known)"
        return f"{name} {both}" + (f" in the last of {len(self.zero)} windows" if len(self.zero) > 1 else "")

    def against(self, preflight: Floats, preflight_sigma: float = 0.0) -> ZeroDrift:
        """Return how the zero levels have moved since before the flight, and their rate.

        Parameters
        ----------
        preflight : ndarray, shape (2,)
            Zero levels of sensors 1 and 2 before the flight, nT.
        preflight_sigma : float
            Their standard deviation, nT.
        """
        before = np.asarray(preflight, dtype=np.float64)
        if before.shape != (2,):
            raise SamplesError(f"{before.size} zero levels found", remedy="give those of sensors 1 and 2")
        rate, rate_sigma = np.full((2, 2), np.nan)
        days = (self.time - self.time[0]) / DAY
        for k in range(2 if len(self.zero) > 2 else 0):
            own = self.sigma[:, k] ** 2 - self.common[:, k] ** 2
            if not np.all(own > 0):
                raise CalibrationError("a zero level without scatter", remedy="give fits of real readings")
            away = days - np.average(days, weights=1.0 / own)
            part = away / own / np.sum(away**2 / own)
            rate[k] = part @ self.zero[:, k]
            residual = self.zero[:, k] - np.average(self.zero[:, k], weights=1.0 / own) - rate[k] * away
            # Where zero levels scatter by more than their errors, the rate's error grows with the scatter.
            freedom = days.size - 2
            excess = max(float(np.sum(residual**2 / own)) / freedom, 1.0)
            wide = float(scipy.stats.t.ppf(0.8413, freedom))
            rate_sigma[k] = np.hypot(wide * np.sqrt(part**2 @ own * excess), part @ self.common[:, k])
        return ZeroDrift(
            levels=self,
            preflight=before,
            change=self.zero - before,
            change_sigma=np.hypot(self.sigma, preflight_sigma),
            rate=rate,
            rate_sigma=rate_sigma,
        )


@dataclass(frozen=True, kw_only=True)
class ZeroDrift:
    """Zero levels against those from before the flight; arrays (window, 2) or (2,), nT and nT a day.

    `rate` is NaN with fewer than three windows.
    """

    levels: Intercepts
    preflight: Floats
    change: Floats
    change_sigma: Floats
    rate: Floats
    rate_sigma: Floats

    def summary(self) -> str:
        """Return what has moved, in words, sensor by sensor."""
        when = utc_text(int(self.levels.time[-1]))
        rows = []
        for k in range(2):
            text = f"sensor {k + 1}: {self.change[-1, k]:+.3f} +- {self.change_sigma[-1, k]:.3f} nT"
            text += f" from before the flight to {when}"
            if np.isfinite(self.rate[k]):
                text += f", {self.rate[k]:+.4f} +- {self.rate_sigma[k]:.4f} nT a day"
            rows.append(text)
        return "; ".join(rows)


def find_intercepts(
    points: Points,
    lines: list[Line],
    slope_sigma: Floats,
    group: Int64,
    spin_axis_zero: tuple[float, float] | None,
) -> Intercepts:
    """Return every window's intercepts from the lines of both sensors.

    Parameters
    ----------
    points : Points
    lines : list of Line
        Of sensors 1 and 2 against sensor 3.
    slope_sigma : ndarray, shape (2,)
    group : ndarray of int64, shape (point,)
        Window of each point.
    spin_axis_zero : tuple of float, optional
        O3 and its sigma, nT.
    """
    known = (0.0, float("nan")) if spin_axis_zero is None else spin_axis_zero
    windows, constant = int(group[-1]) + 1, points.constant
    shape = (windows, 2)
    intercept, own, common = np.empty(shape), np.empty(shape), np.empty(shape)
    for k, line in enumerate(lines):
        means = group_means(constant[:, k] + 1j * constant[:, 2], line.weight, group)
        slope = line.slope.real
        intercept[:, k] = means.real - slope * means.imag
        common[:, k] = (known[0] - means.imag) * slope_sigma[k]
        own[:, k] = _errors_of_means(line, group, windows)
    slopes = np.array([line.slope.real for line in lines])
    sigma = np.sqrt(own**2 + common**2 + (slopes * np.nan_to_num(known[1])) ** 2)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [group.size]])
    return Intercepts(
        start=points.start[edges[:-1]],
        end=points.end[edges[1:] - 1] + 1,
        intercept=intercept,
        zero=intercept + slopes * known[0],
        sigma=sigma,
        common=common,
        spin_axis_zero=known,
    )


def _errors_of_means(line: Line, group: Int64, windows: int) -> Floats:
    """Return the standard deviation of each window's mean residual, with its correlation in time."""
    residual, weight = line.residual.real, line.weight
    edges = np.searchsorted(group, np.arange(windows + 1))
    # Scaled so that the mean of a window's entries is its weighted mean.
    mean_weight = np.bincount(group, weight) / np.bincount(group)
    parts = residual * weight / mean_weight[group]
    whole = sigma_of_mean(parts) * np.sqrt(parts.size)
    return np.array(
        [
            sigma_of_mean(parts[a:b]) if b - a >= FARRELL_SETTINGS.own_scatter else whole / np.sqrt(b - a)
            for a, b in pairwise(edges)
        ]
    )


@dataclass(frozen=True, kw_only=True)
class FarrellFit:
    """Angles, gain ratio and zero levels from the tones and constants of a span of spin fits.

    Attributes
    ----------
    value : ndarray, shape (6,)
        In order of `NAMES`. The tilt's components are along azimuth 0 and 90 degrees from sensor 1's own
        azimuth; ``gain_ratio`` is that of sensor 2 to sensor 1.
    covariance : ndarray, shape (6, 6)
        From the scatter of the fits and its correlation in time.
    intercepts : Intercepts
        Of sensors 1 and 2, nT, for every window.
    plain_slope : ndarray, shape (2,)
        Slopes of plain regression, which noise of sensor 3 draws to zero.
    reliability : ndarray, shape (2,)
        Part of the variance of sensor 3's constants that is no noise.
    azimuth_1 : tuple of float
        Azimuth of sensor 1 from before the flight and its sigma, radians.
    used : int
        Fits.
    span : tuple of int
        TT2000, half-open.
    """

    value: Floats
    covariance: Floats
    intercepts: Intercepts
    plain_slope: Floats
    reliability: Floats
    azimuth_1: tuple[float, float]
    used: int
    span: tuple[int, int]

    @property
    def sigma(self) -> Floats:
        """Standard deviations; (6,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def tilt(self) -> tuple[float, float]:
        """Tilt of sensor 3 and its sigma, radians; never negative, and too large where it is but noise."""
        size, along = self._polar()
        return size, float(np.sqrt(along @ self.covariance[2:4, 2:4] @ along))

    @property
    def tilt_azimuth(self) -> tuple[float, float]:
        """Azimuth from XA that sensor 3 is tilted towards, and its sigma, radians; NaN below three sigma."""
        size, along = self._polar()
        across = np.array([-along[1], along[0]])
        sigma = float(np.sqrt(across @ self.covariance[2:4, 2:4] @ across))
        if size < FARRELL_SETTINGS.seen * sigma:
            return float("nan"), float("nan")
        azimuth = float(np.arctan2(self.value[3], self.value[2])) + self.azimuth_1[0]
        return (azimuth + np.pi) % (2 * np.pi) - np.pi, float(np.hypot(sigma / size, self.azimuth_1[1]))

    def _polar(self) -> tuple[float, Floats]:
        size = float(np.hypot(self.value[2], self.value[3]))
        return size, self.value[2:4] / size if size > 0 else np.array([1.0, 0.0])

    def angles(self, window: int = -1) -> SensorAngles:
        """Return the directions and zero levels of a window; sensor 3's zero as it was given."""
        azimuth = self.azimuth_1[0] + np.array([0.0, self.value[4]])
        towards = float(np.arctan2(self.value[3], self.value[2])) + self.azimuth_1[0]
        zero = np.append(self.intercepts.zero[window], self.intercepts.spin_axis_zero[0])
        return SensorAngles(self.value[:2].copy(), azimuth, self.tilt[0], towards, zero)

    def spin_related(self, sensitivity: Floats, window: int = -1) -> tuple[Floats, Floats]:
        """Return the eight parameters of Plaschke et al. (2019) that go with the directions found.

        Sensor 3 and the projection of sensor 1 across it are the axes of the sensor package there.

        Parameters
        ----------
        sensitivity : ndarray, shape (3,)
            nT per unit of the readings, as the fit was given.
        window : int
            Whose zero levels are taken.

        Returns
        -------
        value, covariance : ndarray, shape (8,) and (8, 8)
            In the order of `inflight.spin.SPIN_RELATED`; offsets in the unit of the readings.
        """
        unit = np.asarray(sensitivity, dtype=np.float64)

        def eight(given: Floats) -> Floats:
            azimuth = np.array([0.0, given[4]])
            tilt = float(np.hypot(given[2], given[3])), float(np.arctan2(given[3], given[2]))
            one, two, three = SensorAngles(given[:2], azimuth, *tilt).matrix()
            across = [side - (side @ three) * three for side in (one, two)]
            x = across[0] / np.linalg.norm(across[0])
            y = np.cross(three, x)
            between = np.arctan2(across[1] @ y, across[1] @ x) - np.pi / 2
            elevation = [np.arcsin(-(side @ three)) for side in (one, two)]
            axis = [np.arcsin(x[2]), np.arctan2(y[2], three[2])]
            flat = np.cos(given[:2])
            gain = np.sqrt(given[5] * unit[0] / unit[1] * flat[0] / flat[1])
            return np.array([gain, *elevation, between, *axis, *(given[6:] / unit[:2])])

        levels, slope_sigma = self.intercepts, self.sigma[:2]
        given = np.concatenate([self.value, levels.zero[window]])
        spread = np.zeros((given.size, given.size))
        spread[:6, :6] = self.covariance
        spread[6:, 6:] = np.diag(levels.sigma[window] ** 2)
        for k in (0, 1):
            spread[k, 6 + k] = spread[6 + k, k] = levels.common[window, k] * slope_sigma[k]
        steps = np.diag([1e-6] * 6 + [1e-3] * 2)
        slopes = np.stack(
            [(eight(given + step) - eight(given - step)) / (2.0 * step.max()) for step in steps], axis=1
        )
        return eight(given), np.asarray(slopes @ spread @ slopes.T)

    def summary(self) -> str:
        """Return the angles in degrees and the zero levels in nT, in words."""
        degrees, sigma = np.rad2deg(self.value), np.rad2deg(self.sigma)
        parts = [f"{NAMES[i]} {degrees[i]:+.4f} +- {sigma[i]:.4f} deg" for i in range(5)]
        parts.append(f"gain ratio {self.value[5]:.6f} +- {self.sigma[5]:.6f}")
        return "; ".join([*parts, self.intercepts.summary()])


def calibrate_farrell(
    fits: SpinFits,
    *,
    sensitivity: Floats | None = None,
    spins: int = FARRELL_SETTINGS.spins,
    window: float | None = None,
    azimuth_1: tuple[float, float] = (0.0, 0.0),
    spin_axis_zero: tuple[float, float] | None = None,
) -> FarrellFit:
    """Find elevations, tilt, total phase and zero levels from spin fits.

    Parameters
    ----------
    fits : SpinFits
        Three components: sensors 1, 2 (spin plane) and 3 (spin axis).
    sensitivity : ndarray, shape (3,), optional
        nT per unit of the fits; 1 for nT. With counts an elevation is ``slope S1 / S3``, not eq. (34)'s.
    spins : int
        Fits are averaged over this many spins before lines are fitted, less when there are few.
    window : float, optional
        Days of one zero level: each window has its own intercepts, all have the same angles. One for the
        whole span when absent; a drift within a window goes into its scatter.
    azimuth_1 : tuple of float
        Azimuth of sensor 1 from XA and its sigma, radians: from before the flight, the spin does not show it.
    spin_axis_zero : tuple of float, optional
        Zero level of sensor 3 and its sigma, nT. An intercept is ``O1 - dth1 O3``, the zero level only
        where O3 is known.

    Raises
    ------
    CalibrationError
        With too few fits, or a Bz or Bsp that hardly changes against the noise.
    """
    if fits.value.shape[1] != 3:
        raise SamplesError(f"fits of {fits.value.shape[1]} sensors found, 3 needed", remedy="give the triad")
    # While the field jumps, neither its mean nor its tone is one of the spin's.
    whole = fits.select(np.asarray(fits.determined.all(axis=1) & ~fits.changing.any(axis=1)))
    if len(whole) < FARRELL_SETTINGS.fewest:
        raise CalibrationError(
            f"{len(whole)} of {len(fits)} spin fits are whole, at least {FARRELL_SETTINGS.fewest} needed",
            remedy="take a longer span, or see why the phase or the readings are missing",
        )
    unit = np.ones(3) if sensitivity is None else np.asarray(sensitivity, dtype=np.float64)
    points = Points.of(whole, unit, spins)
    constant, phasor, noise = points.constant, points.phasor, points.noise
    group = _windows(points.time, window)
    lines = [fit_line(constant[:, 2], constant[:, k], noise[:, 2, 0], group) for k in (0, 1)]
    both = noise[..., 1] + noise[..., 2]
    tilt = fit_line(phasor[:, 0], phasor[:, 2], both[:, 0])
    turned = fit_line(phasor[:, 0], phasor[:, 1], both[:, 0])
    # |Z2| / |Z1| without the noise in either, and each point's part in its error.
    square = np.abs(phasor[:, :2]) ** 2 - both[:, :2]
    mean = np.sum(turned.weight[:, None] * square, axis=0)
    ratio = float(np.sqrt(mean[1] / mean[0]))
    scores = 0.5 * ratio * turned.weight * (square[:, 1] / mean[1] - square[:, 0] / mean[0])
    value, covariance = _six_parameters(lines, tilt, turned, (ratio, scores))
    # Both slopes use one estimate of the noise of sensor 3.
    shared = np.array([line.slope.real * (1.0 / line.reliability - 1.0) for line in lines])
    covariance[:2, :2] += np.outer(shared, shared) * points.relative_sigma[2] ** 2
    slope_sigma = np.sqrt(np.diag(covariance)[:2])
    intercepts = find_intercepts(points, lines, slope_sigma, group, spin_axis_zero)
    return FarrellFit(
        value=value,
        covariance=covariance,
        intercepts=intercepts,
        plain_slope=np.array([line.plain.real for line in lines]),
        reliability=np.array([line.reliability for line in lines]),
        azimuth_1=azimuth_1,
        used=len(whole),
        span=(int(whole.start[0]), int(whole.end[-1]) + 1),
    )


def _windows(time: Int64, window: float | None) -> Int64:
    """Return the number of the window of each point, from 0; `window` in days."""
    if window is None:
        return np.zeros(time.size, dtype=np.int64)
    if not window > 0:
        raise SamplesError(f"a window of {window:g} d found", remedy="take more than 0")
    number = (time - time[0]) // np.int64(round(window * 86_400 * SECOND))
    return np.asarray(np.unique(number, return_inverse=True)[1], dtype=np.int64)


def _six_parameters(
    lines: list[Line], tilt: Line, turned: Line, ratio: tuple[float, Floats]
) -> tuple[Floats, Floats]:
    """Return the six parameters and their covariance from the scores of all lines together.

    Exact where the angles are not small: slope = sin dth1 / cos th3, |Z3| / |Z1| = sin th3 / cos dth1.
    """
    slopes = np.array([line.slope.real for line in lines])
    size = abs(tilt.slope)
    # The two equations, solved for squares: sin^2 th3 = k^2 (1 - m^2) / (1 - k^2 m^2).
    sine = size * np.sqrt((1.0 - slopes[0] ** 2) / (1.0 - (size * slopes[0]) ** 2))
    if not sine < 1.0:
        raise CalibrationError(
            f"sensor 3 sees {size:.2f} of the spin tone of sensor 1",
            remedy="see which sensor is along the spin",
        )
    angle = float(np.arcsin(sine))
    # Over the size of k: sensor 3 in the middle of its noise has none.
    stretch = angle / size if size > 0 else 1.0
    direction = complex(tilt.slope) * stretch
    elevation = np.arcsin(slopes * np.cos(angle))
    total = complex(turned.slope) / 1j
    value = np.array([*elevation, direction.real, direction.imag, np.angle(total), ratio[0]])
    phase_scores = (turned.scores / turned.slope).imag
    scores = np.stack(
        [
            *(line.scores.real for line in lines),
            stretch * tilt.scores.real,
            stretch * tilt.scores.imag,
            phase_scores,
            ratio[1],
        ],
        axis=1,
    )
    return value, long_run_covariance(scores)


@dataclass(frozen=True, kw_only=True)
class BoomBending:
    """Azimuth of the outer triad from the inner one in windows of time.

    Attributes
    ----------
    start, end : ndarray of int64, shape (window,)
        TT2000.
    value, sigma : ndarray, shape (window,)
        Radians, positive from XA to YA, less `mounted`.
    mounted : float
        Difference of the azimuths as mounted, radians.
    fits : ndarray of int64, shape (window,)
        Spin fits of both triads in each window.
    """

    start: Int64
    end: Int64
    value: Floats
    sigma: Floats
    mounted: float
    fits: Int64

    @property
    def time(self) -> Int64:
        """Middles of the windows, TT2000; (window,)."""
        return np.asarray(self.start + (self.end - self.start) // 2)


def measure_boom_bending(
    outer: SpinFits, inner: SpinFits, *, window: float | None = None, mounted: float = 0.0
) -> BoomBending:
    """Return the bend of the boom by the spin phase of its outer against its inner magnetometer.

    Parameters
    ----------
    outer, inner : SpinFits
        Of both triads, of the same phase; their first component is sensor 1. Fits of the same turns are
        compared.
    window : float, optional
        Days of one value; the whole span when absent.
    mounted : float
        Azimuth of the outer sensor 1 from the inner one before the flight, radians.

    Raises
    ------
    CalibrationError
        When a window has fewer than ten spins with both.
    """
    if outer.spins != inner.spins:
        raise SamplesError(
            f"fits of {outer.spins} and of {inner.spins} spins found", remedy="fit both over as many"
        )
    _, a, b = np.intersect1d(outer.turn, inner.turn, return_indices=True)
    good = outer.determined[a, 0] & inner.determined[b, 0]
    a, b = a[good], b[good]
    if a.size < FARRELL_SETTINGS.fewest:
        raise CalibrationError(
            f"{a.size} spins have fits of both magnetometers, at least {FARRELL_SETTINGS.fewest} needed",
            remedy="take a longer span, or see whether both were fitted against one phase",
        )
    noise = noise_variance(inner)[b, 0, 1:3].sum(axis=-1)
    line = fit_line(inner.phasor[b, 0], outer.phasor[a, 0], noise)
    # One window's angle is that of its weighted sum of Z_in* Z_out.
    product = line.weight * np.conj(inner.phasor[b, 0]) * outer.phasor[a, 0]
    step = np.zeros(a.size) if window is None else (outer.time[a] - outer.time[a][0]) // round(window * DAY)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(step)) + 1, [a.size]])
    value, sigma = np.empty((2, edges.size - 1))
    for place, (low, high) in enumerate(pairwise(edges)):
        if high - low < FARRELL_SETTINGS.fewest:
            raise CalibrationError(
                f"a window has {high - low} spins with both magnetometers, "
                f"at least {FARRELL_SETTINGS.fewest} needed",
                remedy="take longer windows",
            )
        total = product[low:high].mean()
        value[place] = np.angle(total)
        sigma[place] = sigma_of_mean((product[low:high] * np.conj(total)).imag / abs(total) ** 2)
    turned = (value - mounted + np.pi) % (2 * np.pi) - np.pi
    starts, ends = outer.start[a][edges[:-1]], outer.end[a][edges[1:] - 1] + 1
    return BoomBending(
        start=starts, end=ends, value=turned, sigma=sigma, mounted=mounted, fits=np.diff(edges)
    )
