"""Spin fits: C0 + C1 sin + C2 cos over one or several spins; despun fields.

Takes: times, readings of any components and the spin phase. Makes (`fit_spins`): `SpinFits`, the coefficients
of Farrell et al. (1995), eq. (22), of every whole number of turns, against the phase instead of the time, so
that neither a spin rate that changes nor uneven samples do harm; all fits of a record at once. Normal
equations of three (with twice the spin five) unknowns are summed in one pass; a fit with an outlying reading
is made again with Huber's and then biweight weights.

`despin` turns axes that spin into axes that do not (eq. 1), `respin` back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.lsq import BIWEIGHT_RMS_FACTOR
from inflight.spin.kernels import fill_sine_cosine, fit_plain, fit_weighted
from inflight.time import Int64, utc_text

TURN = 2.0 * np.pi

#: Names of the coefficients; those of twice the spin come last.
COEFFICIENTS = ("C0", "C1", "C2", "S2", "D2")


@dataclass(frozen=True, kw_only=True)
class SpinFitSettings:
    """When a spin fit is determined, and when it is made again with weights.

    Attributes
    ----------
    least_spread : float
        A fit is determined when the determinant of its normal equations is this part of that of evenly spread
        phases. Derived: readings of half a turn have 0.1, of three quarters 0.65 (without twice the spin).
    outlier : float
        A fit is made again when a reading is this many sigmas off. Level of significance: one in 16 000.
    most_out : float
        When more than this part of a fit's readings would be down-weighted, the field has changed and all are
        kept. Assumed.
    around : int
        The usual residual of a fit is that of the group of this many fits it is in. Assumed.
    quartile : float
        Percentile of their rms that is taken. Derived: outliers in two thirds of the fits do not raise it.
    """

    least_spread: float = 0.1
    outlier: float = 4.0
    most_out: float = 0.25
    around: int = 31
    quartile: float = 25.0


SPIN_FIT_SETTINGS = SpinFitSettings()


@dataclass(frozen=True, kw_only=True)
class SpinFits:
    """Spin fits in order of time.

    Attributes
    ----------
    time, start, end : ndarray of int64, shape (fit,)
        TT2000 of the middle, of the first and of the last reading.
    turn : ndarray of int64, shape (fit,)
        Number of the first turn since phase zero.
    value : ndarray, shape (fit, component, coefficient)
        C0, C1, C2 and, with two harmonics, S2 and D2 (sin and cos of twice the phase), in the field's unit;
        NaN where the readings do not determine them.
    covariance : ndarray, shape (fit, component, coefficient, coefficient)
        From the fit's own residual, taken as white: it holds for the instrument's noise. Fluctuations of the
        field are larger near the spin than far above it; `inflight.spin.farrell` takes them from the
        scatter between fits.
    rms : ndarray, shape (fit, component)
        Residual per degree of freedom.
    count, outliers : ndarray of int64, shape (fit, component)
        Readings, and those of them that have less than half their weight.
    changing : ndarray of bool, shape (fit, component)
        The field changed too much for outliers to be found: every reading counts.
    spins : int
        Turns of one fit.
    unit : str
    """

    time: Int64
    start: Int64
    end: Int64
    turn: Int64
    value: Floats
    covariance: Floats
    rms: Floats
    count: Int64
    outliers: Int64
    changing: npt.NDArray[np.bool_]
    spins: int = 1
    unit: str = "nT"

    def __len__(self) -> int:
        return int(self.time.size)

    @property
    def determined(self) -> npt.NDArray[np.bool_]:
        """Where the readings determine a fit; (fit, component)."""
        return np.asarray(np.isfinite(self.value[..., 0]))

    @property
    def whole(self) -> SpinFits:
        """The fits that are determined in every component."""
        return self.select(np.asarray(self.determined.all(axis=1)))

    @property
    def constant(self) -> Floats:
        """C0; (fit, component)."""
        return np.asarray(self.value[..., 0])

    @property
    def phasor(self) -> npt.NDArray[np.complex128]:
        """``Z = C2 - i C1``: a sensor at the azimuth ``ph`` sees ``Bsp exp(i (ph - psi))``.

        Shape (fit, component).
        """
        return np.asarray(self.value[..., 2] - 1j * self.value[..., 1])

    @property
    def double(self) -> npt.NDArray[np.complex128]:
        """``D2 - i S2``, the phasor of twice the spin; (fit, component)."""
        if self.value.shape[-1] < len(COEFFICIENTS):
            raise SamplesError("the fits hold no twice the spin", remedy="fit with harmonics=2")
        return np.asarray(self.value[..., 4] - 1j * self.value[..., 3])

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the coefficients; (fit, component, coefficient)."""
        return np.asarray(np.sqrt(np.einsum("fkpp->fkp", self.covariance)))

    def select(self, chosen: npt.NDArray[np.bool_]) -> SpinFits:
        """Return some of the fits; `chosen` has shape (fit,)."""
        kept: dict[str, Any] = {
            name: part[chosen] for name, part in self.__dict__.items() if isinstance(part, np.ndarray)
        }
        return replace(self, **kept)

    def summary(self) -> str:
        """Return in one sentence what was fitted and what was not."""
        whole = int(self.determined.all(axis=1).sum())
        text = f"{len(self)} fits of {self.spins} spin{'s' if self.spins > 1 else ''}, {whole} of them whole"
        text += f", {int(self.outliers.sum())} outlying readings left out"
        changing = int(self.changing.any(axis=1).sum())
        return text + (f", {changing} fits while the field changed" if changing else "")


def fit_spins(
    stamps: Int64,
    field: Floats,
    phase: Floats,
    *,
    good: npt.NDArray[np.bool_] | None = None,
    spins: int = 1,
    harmonics: int = 1,
    robust: bool = True,
    unit: str = "nT",
) -> SpinFits:
    """Fit C0 + C1 sin(phase) + C2 cos(phase) to every whole number of turns (Farrell 1995, eq. 22).

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, rising; uneven sampling and gaps allowed.
    field : ndarray, shape (time, component)
        Readings in nT or counts; NaN where a component is missing.
    phase : ndarray, shape (time,)
        Unwrapped spin phase, radians, never falling; NaN where it is not known.
    good : ndarray of bool, shape (time,), optional
        False leaves a sample out.
    spins : int
        Turns of one fit.
    harmonics : int
        1, or 2 for sin and cos of twice the phase too.
    robust : bool
        Down-weight outlying readings; False is plain least squares.
    unit : str

    Returns
    -------
    SpinFits

    Raises
    ------
    SamplesError
        Shapes that differ, a phase that falls, or settings that make no sense.
    CalibrationError
        When no fit at all is determined.
    """
    if field.ndim != 2 or stamps.shape != phase.shape or field.shape[:1] != stamps.shape:
        raise SamplesError(
            f"times have shape {stamps.shape}, the phase {phase.shape}, the field {field.shape}",
            remedy="give (time,), (time,) and (time, component)",
        )
    if spins < 1 or harmonics not in {1, 2}:
        raise SamplesError(
            f"fits of {spins} spins with {harmonics} harmonics asked for", remedy="at least 1 spin; 1 or 2"
        )
    kept = np.isfinite(phase) if good is None else np.isfinite(phase) & good
    if not kept.all():
        stamps, field, phase = stamps[kept], field[kept], phase[kept]
    if not stamps.size:
        raise CalibrationError(
            f"none of {kept.size} samples has a phase", remedy="see what the phase's flags say"
        )
    if np.any(np.diff(phase) < 0):
        raise SamplesError("the spin phase falls", remedy="unwrap it; it grows with time by definition")
    turn = np.floor(phase * (1.0 / (TURN * spins))).astype(np.int64)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(turn)) + 1, [turn.size]])
    sine, cosine = np.empty(phase.size), np.empty(phase.size)
    fill_sine_cosine(np.asarray(phase, dtype=np.float64), sine, cosine)
    samples = sine, cosine, np.ascontiguousarray(field, dtype=np.float64)
    sums = _Sums.of_shape(edges.size - 1, field.shape[1], 2 * harmonics + 1)
    out = (sums.value, sums.inverse, sums.variance, sums.count, sums.largest, sums.spread)
    fit_plain(samples[0], samples[1], samples[2], edges, *out)
    if robust:
        _refit_outliers(sums, samples, edges)
    return _result(stamps, turn * spins, edges, sums, spins, unit)


@dataclass(frozen=True, kw_only=True)
class _Sums:
    """Results of the pass over all samples; the first two dims are fit, component."""

    value: Floats
    inverse: Floats
    variance: Floats
    count: Int64
    largest: Floats
    spread: Floats
    outliers: Int64
    changing: npt.NDArray[np.bool_]

    @classmethod
    def of_shape(cls, fits: int, components: int, unknowns: int) -> _Sums:
        """Return arrays to be filled."""
        shape = (fits, components)
        return cls(
            value=np.empty((*shape, unknowns)),
            inverse=np.empty((*shape, unknowns, unknowns)),
            variance=np.empty(shape),
            count=np.empty(shape, dtype=np.int64),
            largest=np.empty(shape),
            spread=np.empty(shape),
            outliers=np.zeros(shape, dtype=np.int64),
            changing=np.zeros(shape, dtype=np.bool_),
        )


def _refit_outliers(sums: _Sums, samples: tuple[Floats, Floats, Floats], edges: Int64) -> None:
    """Fit those again that hold an outlying reading, with weights; in place."""
    scale = _scale_around(sums.variance, sums.count - sums.value.shape[-1])
    outlying = (sums.largest > SPIN_FIT_SETTINGS.outlier * scale) & (
        sums.spread >= SPIN_FIT_SETTINGS.least_spread
    )
    places = np.argwhere(outlying)
    if not places.size:
        return
    sine, cosine, field = samples
    now, inverse, found = fit_weighted(sine, cosine, field, edges, places, scale, sums.value)
    size = now.shape[1]
    spread, total, kept, out = found.T
    f, k = places.T
    taken = (spread >= SPIN_FIT_SETTINGS.least_spread) & (
        out <= SPIN_FIT_SETTINGS.most_out * sums.count[f, k]
    )
    taken &= kept > size + 1.0
    sums.changing[f[~taken], k[~taken]] = True
    f, k = f[taken], k[taken]
    sums.value[f, k], sums.inverse[f, k], sums.spread[f, k] = now[taken], inverse[taken], spread[taken]
    sums.outliers[f, k] = out[taken].astype(np.int64)
    sums.variance[f, k] = total[taken] / (kept[taken] - size) / BIWEIGHT_RMS_FACTOR**2


def _scale_around(variance: Floats, freedom: Int64) -> Floats:
    """Return the usual residual around each fit, from the quieter fits of its group; (fit, component)."""
    around = SPIN_FIT_SETTINGS.around
    known = (freedom > 0) & np.isfinite(variance)
    rms = np.sqrt(np.where(known, variance, 0.0))
    out = np.empty_like(rms)
    for k in range(rms.shape[1]):
        own = known[:, k]
        if not own.any():
            out[:, k] = np.inf
            continue
        usual = float(np.median(freedom[own, k]))
        level = np.sqrt(scipy.stats.chi2.ppf(SPIN_FIT_SETTINGS.quartile / 100.0, usual) / usual)
        # Fits that are not known take their neighbours'; nobody uses them.
        filled = np.interp(np.arange(rms.shape[0]), np.flatnonzero(own), rms[own, k])
        groups = max(filled.size // around, 1)
        low = [
            np.percentile(filled[: groups * around].reshape(groups, -1), SPIN_FIT_SETTINGS.quartile, axis=1)
        ]
        if filled.size > groups * around:
            low.append(np.percentile(filled[-around:], [SPIN_FIT_SETTINGS.quartile]))
        out[:, k] = np.repeat(np.concatenate(low), around)[: filled.size] / level
    return out


def _result(stamps: Int64, turn: Int64, edges: Int64, sums: _Sums, spins: int, unit: str) -> SpinFits:
    known = (sums.spread >= SPIN_FIT_SETTINGS.least_spread) & (sums.count > sums.value.shape[-1])
    if not known.any():
        raise CalibrationError(
            f"none of {known.shape[0]} spins from {utc_text(int(stamps[0]))} has readings spread over"
            f" the turn (at most {int(sums.count.max())} a fit)",
            remedy="fit more spins at once, or look at the spin period and the gaps",
        )
    value = np.where(known[..., None], sums.value, np.nan)
    covariance = sums.inverse * sums.variance[..., None, None]
    covariance[~known] = np.nan
    start, end = stamps[edges[:-1]], stamps[edges[1:] - 1]
    rms = np.where(known, np.sqrt(sums.variance), np.nan)
    return SpinFits(
        time=start + (end - start) // 2,
        start=start,
        end=end,
        turn=turn[edges[:-1]],
        value=value,
        covariance=covariance,
        rms=rms,
        count=sums.count,
        outliers=sums.outliers,
        changing=sums.changing,
        spins=spins,
        unit=unit,
    )


def despin(field: Floats, phase: Floats) -> Floats:
    """Turn apparent vectors into payload axes: XP towards the Sun in the spin plane, ZP the spin axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        nT, apparent axes (they spin).
    phase : ndarray, shape (time,)
        Angle of XA from XP towards YP, radians; NaN gives NaN in the spin plane only.

    Returns
    -------
    ndarray, shape (time, 3)
        nT, payload axes.
    """
    return _rotated(field, phase)


def respin(field: Floats, phase: Floats) -> Floats:
    """Turn payload vectors (time, 3) into apparent axes: the inverse of `despin`."""
    return _rotated(field, -phase)


def _rotated(field: Floats, angle: Floats) -> Floats:
    """Return vectors (time, 3) rotated about the third axis."""
    if field.ndim != 2 or field.shape[1] != 3 or angle.shape != field.shape[:1]:
        raise SamplesError(
            f"a field of shape {field.shape} and a phase of shape {angle.shape} found",
            remedy="give (time, 3) and (time,)",
        )
    cosine, sine = np.cos(angle), np.sin(angle)
    out = np.empty_like(field, dtype=np.float64)
    out[:, 0] = cosine * field[:, 0] - sine * field[:, 1]
    out[:, 1] = sine * field[:, 0] + cosine * field[:, 1]
    out[:, 2] = field[:, 2]
    return out
