"""Slope/Intercept and Beta/Phi: sensor angles and zero levels from spin fits (Farrell et al. 1995, V).

The constants of the spin-plane sensors against that of the spin-axis sensor: the slope is the elevation, the
intercept the zero level (eq. 23). The phasor of the spin-axis sensor against that of sensor 1: the tilt and
its azimuth (eqs. 24 and 25, with the sign of 24 reversed). That of sensor 2 against sensor 1: the total phase
(eq. 31, reversed). Only differences of azimuths show; that of sensor 1 comes from before the flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.estimators.longrun import long_run_covariance
from inflight.spin.angles import SensorAngles
from inflight.spin.fits import SpinFits
from inflight.spin.regression import FEWEST, Complexes, Line, Points, fit_line
from inflight.spin.zero_levels import Intercepts, intercepts_of
from inflight.time import SECOND, Int64

NAMES = ("elevation_1", "elevation_2", "tilt_x", "tilt_y", "azimuth_2 - azimuth_1", "gain_ratio")
UNITS = ("rad", "rad", "rad", "rad", "rad", "1")
#: Within one spin a field that is compressed changes along all axes at once, and what it does near the spin
#: period leaks into both constants: a slope that no angle has, half a sigma for an hour of single spins.
#: Over several spins the leak of the one and the mean of the other have no frequency in common.
SPINS = 8
#: The azimuth of a tilt is told when the tilt is this many sigmas.
_SEEN = 3.0


@dataclass(frozen=True)
class FarrellFit:
    """What the tones and constants of a span of spin fits tell.

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
        if size < _SEEN * sigma:
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

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `covariance` and `units` along ``parameter``, and the zero levels."""
        table = xr.Dataset(
            {
                "value": ("parameter", self.value),
                "sigma": ("parameter", self.sigma),
                "covariance": (("parameter", "other"), self.covariance),
                "units": ("parameter", np.array(UNITS)),
                "start": ((), np.int64(self.span[0]), {"scale": "TT2000"}),
                "end": ((), np.int64(self.span[1]), {"scale": "TT2000"}),
            },
            coords={"parameter": list(NAMES), "other": list(NAMES)},
            attrs={
                "fits": self.used,
                "azimuth_1": self.azimuth_1[0],
                "azimuth_1_sigma": self.azimuth_1[1],
            },
        )
        return table.merge(self.intercepts.table().rename({"value": "zero", "sigma": "zero_sigma"}))

    def told(self) -> str:
        """Say the angles in degrees and the zero levels in nT."""
        degrees, sigma = np.rad2deg(self.value), np.rad2deg(self.sigma)
        parts = [f"{NAMES[i]} {degrees[i]:+.4f} +- {sigma[i]:.4f} deg" for i in range(5)]
        parts.append(f"gain ratio {self.value[5]:.6f} +- {self.sigma[5]:.6f}")
        return "; ".join([*parts, self.intercepts.told()])


def farrell(
    fits: SpinFits,
    *,
    sensitivity: Floats | None = None,
    spins: int = SPINS,
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
    whole = fits.where(np.asarray(fits.determined.all(axis=1) & ~fits.changing.any(axis=1)))
    if len(whole) < FEWEST:
        raise CalibrationError(
            f"{len(whole)} of {len(fits)} spin fits are whole, at least {FEWEST} needed",
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
    value, covariance = _joined(lines, tilt, turned, _gain_ratio(phasor, both, turned.weight))
    # Both slopes lean on one estimate of the noise of sensor 3.
    leaning = np.array([line.slope.real * (1.0 / line.reliability - 1.0) for line in lines])
    covariance[:2, :2] += np.outer(leaning, leaning) * points.doubt[2] ** 2
    slope_sigma = np.sqrt(np.diag(covariance)[:2])
    intercepts = intercepts_of(points, lines, slope_sigma, group, spin_axis_zero)
    span = int(whole.start[0]), int(whole.end[-1]) + 1
    plain = np.array([line.plain.real for line in lines])
    sure = np.array([line.reliability for line in lines])
    return FarrellFit(value, covariance, intercepts, plain, sure, azimuth_1, len(whole), span)


def _windows(time: Int64, window: float | None) -> Int64:
    if window is None:
        return np.zeros(time.size, dtype=np.int64)
    if not window > 0:
        raise SamplesError(f"a window of {window:g} d found", remedy="take more than 0")
    number = (time - time[0]) // np.int64(round(window * 86_400 * SECOND))
    return np.asarray(np.unique(number, return_inverse=True)[1], dtype=np.int64)


def _gain_ratio(phasor: Complexes, noise: Floats, weight: Floats) -> tuple[float, Floats]:
    """Return |Z2| / |Z1| without the noise in either, and each fit's part in its error."""
    square = np.abs(phasor[:, :2]) ** 2 - noise[:, :2]
    mean = np.sum(weight[:, None] * square, axis=0)
    ratio = float(np.sqrt(mean[1] / mean[0]))
    scores = 0.5 * ratio * weight * (square[:, 1] / mean[1] - square[:, 0] / mean[0])
    return ratio, scores


def _joined(
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
