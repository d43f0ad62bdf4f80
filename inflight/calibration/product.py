"""Level-2 fields of a day: the calibrated field, its corrections apart, uncertainty and quality.

Takes aligned samples, a model and a calibration table; makes the Dataset of a day's product.

What is left of the residual may be given to the vector as a term of its own, last of all (Yin 2010,
eq. 3.7): ``B' = (1 - dB'/|B|) B`` with dB' the residual low-passed at a period of 80 s. It makes vector
and scalar agree on slow scales whatever the cause, and so hides errors: its size is part of the product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
import xarray as xr
from scipy import interpolate, linalg, signal

from inflight.arrays import Floats
from inflight.calibration.scalar import Reference, sensor_reading, usable_samples
from inflight.effects import field_strength
from inflight.errors import ModelError, SamplesError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.frames import latitude_longitude, rotate, to_nec
from inflight.lsq import BIWEIGHT_WIDTH, robust_sigma
from inflight.model import Model
from inflight.time import SECOND, Int64, to_utc, usual_step


@dataclass(frozen=True, kw_only=True)
class ClosureSettings:
    """How the residual's slow part is filtered.

    Attributes
    ----------
    fewest_samples : int
        Samples a period at least; assumed.
    most_samples : int
        Samples a period at most before the residual is averaged for the filter; assumed.
    shortest : float
        A stretch of fewer periods has no slow part; assumed.
    gap : float
        A gap longer than this part of a period ends a stretch; assumed.
    edge : float
        Samples this near the end of a stretch, in periods, are an edge; assumed.
    """

    fewest_samples: int = 8
    most_samples: int = 100
    shortest: float = 2.0
    gap: float = 0.5
    edge: float = 2.0


CLOSURE = ClosureSettings()


#: Period at which the filter passes half of the amplitude, s.
FILTER_PERIOD_S = 80.0

#: Order of the difference that the filter holds small: it passes 1 / (1 + (f/fc)^6).
ORDER = 3


@dataclass(frozen=True)
class Distribution:
    """The last term of a product and what it removes.

    Attributes
    ----------
    correction : ndarray, shape (time, 3)
        Term to subtract from the vector, nT; 0 where it was not done.
    slow : ndarray, shape (time,)
        dB', nT; NaN where it was not done.
    sigma : ndarray, shape (time,)
        Standard deviation of dB' by the residual's own fast noise, nT.
    left : ndarray, shape (time,)
        dB - dB', the residual of B', nT.
    edge : ndarray of bool, shape (time,)
        Within two periods of the end of a stretch: the filter leans to one side there.
    done : ndarray of bool, shape (time,)
        False in stretches shorter than two periods, and in gaps.
    period, cadence : float
        s.
    """

    correction: Floats
    slow: Floats
    sigma: Floats
    left: Floats
    edge: np.ndarray
    done: np.ndarray
    period: float
    cadence: float

    @property
    def rms(self) -> float:
        """Rms of the term along the field, nT: how much it hides."""
        return float(np.sqrt(np.mean(self.slow[self.done] ** 2))) if self.done.any() else float("nan")

    @property
    def rms_remaining(self) -> float:
        """Rms residual of B', nT."""
        known = self.done & np.isfinite(self.left)
        return float(np.sqrt(np.mean(self.left[known] ** 2))) if known.any() else float("nan")

    def summary(self) -> str:
        """Return as a sentence how much was distributed."""
        share = float(np.mean(self.done))
        return (
            f"{self.rms:.3f} nT rms of the residual were distributed along the field on "
            f"{100 * share:.1f} % of the samples; {self.rms_remaining:.3f} nT are left, "
            f"faster than {self.period:g} s"
        )

    def table(self) -> xr.Dataset:
        """Return the sizes: dim parameter."""
        names = ["rms_distributed", "rms_left", "share_done", "share_edge"]
        values = [self.rms, self.rms_remaining, float(self.done.mean()), float(self.edge.mean())]
        return xr.Dataset(
            {
                "value": ("parameter", np.array(values)),
                "sigma": ("parameter", np.array([*self._sigmas(), 0.0, 0.0])),
                "units": ("parameter", np.array(["nT", "nT", "1", "1"])),
            },
            coords={"parameter": names},
            attrs={"period_s": self.period, "told": self.summary()},
        )

    def _sigmas(self) -> tuple[float, float]:
        """Return standard deviations of the two rms: what filtered noise alone leaves of chance."""
        slow = int(self.done.sum()) * self.cadence / self.period
        fast = int(self.done.sum())
        return self.rms / np.sqrt(2 * max(slow, 1.0)), self.rms_remaining / np.sqrt(2 * max(fast, 1))


def distribute(
    field: Floats,
    residual: Floats,
    tt2000: Int64,
    good: np.ndarray | None = None,
    period: float = FILTER_PERIOD_S,
) -> Distribution:
    """Return the term that distributes the slow part of the residual along the field.

    The filter minimises ``sum w (dB - dB')^2 + lambda sum (third difference of dB')^2``: zero phase, no
    window, gaps have weight zero. It passes ``1/(1 + (f/fc)^6)`` of the amplitude, as a Butterworth
    filter of third order run forwards and backwards does, and carries parabolas to the ends unharmed.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Corrected vector, nT.
    residual : ndarray, shape (time,)
        dB = |B| - F, nT; NaN where missing.
    tt2000 : ndarray of int64, shape (time,)
        Rising; at equal steps but for gaps.
    good : ndarray of bool, shape (time,), optional
        Samples the filter may use; others get its value, and keep their own rest.
    period : float
        s, where half of the amplitude is passed.

    Raises
    ------
    SamplesError
        When the cadence is too slow for the period, or stamps do not rise.
    """
    step = np.diff(tt2000)
    cadence = usual_step(tt2000, 0) / SECOND
    if step.size == 0 or np.any(step <= 0):
        raise SamplesError("stamps do not rise", remedy="align the samples first")
    if period < CLOSURE.fewest_samples * cadence:
        raise SamplesError(
            f"samples every {cadence:g} s have no low-pass at {period:g} s",
            remedy=f"use a period of at least {CLOSURE.fewest_samples * cadence:g} s",
        )
    use = np.isfinite(residual) & (True if good is None else good)
    slow, sigma = np.full(residual.size, np.nan), np.full(residual.size, np.nan)
    edge = np.zeros(residual.size, dtype=bool)
    place = np.rint((tt2000 - tt2000[0]) / (cadence * SECOND)).astype(np.int64)
    for first, last in _stretches(place, use, CLOSURE.gap * period / cadence):
        if (place[last] - place[first]) * cadence < CLOSURE.shortest * period:
            continue
        span = slice(first, last + 1)
        slow[span], sigma[span] = _filtered(place[span], residual[span], use[span], period / cadence)
        near = np.minimum(place[span] - place[first], place[last] - place[span]) * cadence
        edge[span] = near < CLOSURE.edge * period
    strength = np.linalg.norm(field, axis=1)
    done = np.isfinite(slow) & np.isfinite(strength) & (strength > 0)
    term = np.where(done, np.divide(slow, strength, out=np.zeros_like(slow), where=done), 0.0)
    correction = np.where(done[:, None], term[:, None] * np.nan_to_num(field), 0.0)
    return Distribution(correction, slow, sigma, residual - slow, edge, done, period, cadence)


def _stretches(place: Int64, use: np.ndarray, longest: float) -> list[tuple[int, int]]:
    """Return first and last index of runs of used samples without a gap longer than so many steps."""
    index = np.flatnonzero(use)
    if index.size == 0:
        return []
    cuts = np.flatnonzero(np.diff(place[index]) > longest)
    firsts, lasts = np.append(0, cuts + 1), np.append(cuts, index.size - 1)
    return [(int(index[first]), int(index[last])) for first, last in zip(firsts, lasts, strict=True)]


def _filtered(place: Int64, residual: Floats, use: np.ndarray, period: float) -> tuple[Floats, Floats]:
    """Return the slow part of a stretch and its standard deviation; (time,). `period` is in steps."""
    bins = max(1, int(period // CLOSURE.most_samples))
    count = int(place[-1] - place[0]) // bins + 1
    cell = (place - place[0]) // bins
    weight = np.bincount(cell[use], minlength=count).astype(np.float64)
    total = np.bincount(cell[use], weights=residual[use], minlength=count).astype(np.float64)
    smooth = whittaker(total, weight, period / bins, bins)
    centre = np.arange(count) * bins + 0.5 * (bins - 1)
    at = (place - place[0]).astype(np.float64)
    slow = smooth[cell] if bins == 1 else np.asarray(interpolate.CubicSpline(centre, smooth)(at))
    white = float(np.std((residual - slow)[use]))
    ends = np.minimum(at, at[-1] - at) / bins
    gain = edge_gain(round(period / bins))
    noise = white * gain[np.minimum(ends.astype(np.int64), gain.size - 1)] / np.sqrt(bins)
    return slow, noise


def whittaker(total: Floats, weight: Floats, period: float, full: float = 1.0) -> Floats:
    """Return the smooth series of a weighted one; (time,).

    Parameters
    ----------
    total, weight : ndarray, shape (time,)
        Sum of the values and number of them at each step; both 0 in a gap.
    period : float
        Steps, where half the amplitude is passed.
    full : float
        Weight of a step without a gap.
    """
    size = weight.size
    stiffness = full / (2.0 * np.sin(np.pi / period)) ** (2 * ORDER)
    stencil = np.array([(-1.0) ** k for k in range(ORDER + 1)]) * [1, 3, 3, 1]
    band = np.zeros((ORDER + 1, size))
    rows = size - ORDER
    for i in range(ORDER + 1):
        for j in range(i + 1):
            # Row i - j below the diagonal, column j of every difference that reaches it.
            band[i - j, j : j + rows] += stiffness * stencil[i] * stencil[j]
    band[0] += weight
    return np.asarray(linalg.solveh_banded(band, total, lower=True))


@lru_cache(maxsize=8)
def edge_gain(period: int) -> Floats:
    """Return the standard deviation of filtered unit white noise at so many steps from an end; (step,)."""
    size = 6 * period
    unit = np.eye(size)
    columns = np.stack([whittaker(one, np.ones(size), period) for one in unit], axis=1)
    return np.asarray(np.linalg.norm(columns[: size // 2], axis=1))


def filter_gain(period: Floats, at: float = FILTER_PERIOD_S, cadence: float = 1.0) -> Floats:
    """Return the part of the amplitude that the filter passes at periods, s (same shape)."""
    ratio = np.sin(np.pi * cadence / np.asarray(period)) / np.sin(np.pi * cadence / at)
    return np.asarray(1.0 / (1.0 + ratio ** (2 * ORDER)))


def remaining_band_rms(found: Distribution, band: tuple[float, float]) -> float:
    """Return the rms of the residual of B' between two periods (s), nT, from whole done stretches.

    Raises
    ------
    SamplesError
        When no stretch is twice as long as the longer period.
    """
    long, short = max(band), min(band)
    known = found.done & np.isfinite(found.left)
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    powers, sizes = [], []
    for first, last in zip(bounds[::2], bounds[1::2], strict=True):
        if (last - first) * found.cadence < 2 * long:
            continue
        frequency, density = signal.periodogram(found.left[first:last], fs=1 / found.cadence, window="hann")
        inside = (frequency >= 1 / long) & (frequency <= 1 / short)
        powers.append(float(density[inside].sum() * frequency[1]))
        sizes.append(last - first)
    if not sizes:
        raise SamplesError(f"no stretch of {2 * long:g} s without a gap", remedy="ask for shorter periods")
    return float(np.sqrt(np.average(powers, weights=sizes)))


_VECTOR, _SCALAR = ("time", "axis"), ("time",)

_Variables = dict[str, tuple[tuple[str, ...], Floats, dict[str, object]]]


@dataclass(frozen=True)
class Parameters:
    """The nine parameters that hold for a day, and how sure they are; physical units."""

    value: Floats
    covariance: Floats
    all_determined: bool
    noise: float


def level2(
    model: Model,
    samples: xr.Dataset,
    parameters: Parameters,
    raw: Model,
    widening: Floats | None = None,
    distribute: bool | None = None,
) -> xr.Dataset:
    """Return the level-2 product of one day.

    Parameters
    ----------
    model : Model
        Bound to the calibration table that holds.
    samples : xarray.Dataset
        Aligned raw samples: `vector`, `scalar`, channels; `attitude` (time, quaternion) and
        `position` (time, axis) when they exist.
    parameters : Parameters
        For uncertainties and flags.
    raw : Model
        The pre-flight model, for the residual before calibration.
    widening : ndarray, shape (time, axis), optional
        What missing channels add to the variance, nT^2, sensor axes: see `inflight.model.substitution`.
    distribute : bool, optional
        The slow part of the residual, laid along the field (Yin 2010, eq. 3.7): True takes it out, False
        only tells it, None leaves it out. It hides what the model does not know; its size is in the product.

    Returns
    -------
    xarray.Dataset
        `field_sensor`, `field_spacecraft`, `field_nec` (time, axis) nT; `scalar` (time) nT;
        `residual`, `residual_preflight` (time) nT, |B_vector| - F; ``correction_<effect>`` nT, what
        was taken out (vector sensors: orthogonal axes of the sensor; scalar sensors: along the
        field); ``correction_distribution`` (time, axis) nT, sensor axes, when asked for, with
        attribute `applied`; `uncertainty` (time, axis) nT, 1 sigma, sensor axes, NaN where a missing
        channel makes it unknown; `flag` (time) uint32;
        `latitude`, `longitude` when the position is known.
    """
    found = model.corrected(samples)
    light = cast("xr.Dataset", found)
    field, scalar = (np.asarray(found[name].values) for name in ("field", "scalar"))
    residual = field_strength(light) - scalar
    reading = sensor_reading(model, samples)
    flag = _quality(samples, reading, field, scalar, residual, parameters)
    spread = _distribution(field, residual, samples, flag) if distribute is not None else None
    if spread is not None and distribute:
        field = field - spread.correction
    sensor = next(entry.sensor for entry in model.effects if entry.sensor.role == "vector")
    body = rotate(field, np.asarray(sensor.orientation))
    before, sigma = raw.residual(samples)[:, 0], _widened(_uncertainty(reading, parameters), widening)
    variables: _Variables = {
        "field_sensor": (_VECTOR, field, _told("calibrated field", "sensor")),
        "field_spacecraft": (_VECTOR, body, _told("calibrated field", "spacecraft")),
        "scalar": (_SCALAR, scalar, _told("calibrated field strength of the scalar sensor")),
        "residual": (_SCALAR, residual, _told("|B_vector| - F after calibration")),
        "residual_preflight": (_SCALAR, before, _told("|B_vector| - F with the pre-flight model")),
        "uncertainty": (_VECTOR, sigma, _told("one sigma", "sensor")),
    }
    variables |= _corrections(model, light, spread, distribute)
    flag = _geometry(variables, samples, body, flag)
    return _product(variables, flag, samples, model.comparison)


def _corrections(
    model: Model, corrected: xr.Dataset, spread: Distribution | None, distribute: bool | None
) -> _Variables:
    """Return what was taken out of the readings, effect by effect, and what distributes the residual."""
    out: _Variables = {}
    for name, term in model.correction_terms(corrected).items():
        told = _told(f"taken out of the reading: {name}", "sensor" if term.ndim == 2 else "")
        out[f"correction_{name}"] = (_VECTOR if term.ndim == 2 else _SCALAR, term, told)
    if spread is not None:
        told = _told("slow part of the residual along the field (Yin 2010, eq. 3.7)", "sensor")
        told |= {"applied": "yes" if distribute else "no", "period_s": spread.period, "rms_nT": spread.rms}
        out["correction_distribution"] = (_VECTOR, spread.correction, told)
    return out


def _product(
    variables: _Variables,
    flag: np.ndarray[tuple[int], np.dtype[np.uint32]],
    samples: xr.Dataset,
    comparison: str,
) -> xr.Dataset:
    masks, names = flag_meanings()
    told = {"flag_masks": masks, "flag_meanings": names}
    stamps = (_SCALAR, samples["tt2000"].values, {"units": "ns", "scale": "TT2000"})
    return xr.Dataset(
        {**variables, "flag": (_SCALAR, flag, told), "tt2000": stamps},
        coords={"axis": ["x", "y", "z"]},
        attrs={"comparison": comparison},
    )


def _distribution(
    field: Floats, residual: Floats, samples: xr.Dataset, flag: np.ndarray[tuple[int], np.dtype[np.uint32]]
) -> Distribution | None:
    """Return what (3.7) would take out; None where samples are too slow for its filter."""
    good = (flag & np.uint32(UNUSABLE | Flag.OUTLIER)) == 0
    try:
        return distribute(field, residual, np.asarray(samples["tt2000"].values), good)
    except SamplesError:
        return None


def _told(what: str, frame: str = "") -> dict[str, object]:
    told: dict[str, object] = {"units": "nT", "long_name": what}
    return told | {"frame": frame} if frame else told


def _quality(
    samples: xr.Dataset,
    reading: Floats,
    field: Floats,
    scalar: Floats,
    residual: Floats,
    known: Parameters,
) -> np.ndarray[tuple[int], np.dtype[np.uint32]]:
    flag = samples["flag"].values.astype(np.uint32)
    missing = np.uint32(Flag.VECTOR_MISSING | Flag.SCALAR_MISSING)
    lost = ~(np.isfinite(reading.sum(axis=1)) & np.isfinite(field.sum(axis=1)) & np.isfinite(scalar))
    flag[lost & (flag & missing == 0)] |= np.uint32(Flag.CHANNEL_MISSING)
    good = usable_samples(samples, reading, field, scalar) & np.isfinite(residual)
    if good.any():
        # Half the weight of the biweight is lost at this many sigmas.
        half = BIWEIGHT_WIDTH * np.sqrt(1.0 - np.sqrt(0.5))
        centre = float(np.median(residual[good]))
        wide = half * robust_sigma(residual[good] - centre, floor=1e-6)
        flag[good & (np.abs(residual - centre) > wide)] |= np.uint32(Flag.OUTLIER)
    if not known.all_determined:
        flag |= np.uint32(Flag.PRIOR_PARAMETERS)
    return flag


def _uncertainty(reading: Floats, known: Parameters) -> Floats:
    """Propagate the parameters' covariance and the residual's noise; (time, axis) nT, sensor axes.

    B = K (E - E0): a row of K and the offsets enter each component.
    """
    cos = np.cos(np.deg2rad(known.value[3:6]))
    slope = -np.sin(np.deg2rad(known.value[3:6])) * np.pi / 180.0
    k = known.value[:3]
    e = reading - known.value[6:]
    one = np.ones(len(e))
    # (parameters of the row, their derivatives): x has scale, two angles and three offsets.
    rows = (
        (
            [0, 3, 4, 6, 7, 8],
            [e[:, 0], slope[0] * e[:, 1], slope[1] * e[:, 2], -k[0] * one, -cos[0] * one, -cos[1] * one],
        ),
        ([1, 5, 7, 8], [e[:, 1], slope[2] * e[:, 2], -k[1] * one, -cos[2] * one]),
        ([2, 8], [e[:, 2], -k[2] * one]),
    )
    out = np.empty_like(e)
    for axis, (index, parts) in enumerate(rows):
        derivative = np.stack(parts, axis=1)
        covariance = known.covariance[np.ix_(index, index)]
        out[:, axis] = np.einsum("ti,ij,tj->t", derivative, covariance, derivative, optimize=True)
    return np.sqrt(np.maximum(out, 0.0) + known.noise**2)


def _widened(sigma: Floats, variance: Floats | None) -> Floats:
    return sigma if variance is None else np.sqrt(sigma**2 + variance)


def _geometry(
    variables: _Variables,
    samples: xr.Dataset,
    body: Floats,
    flag: np.ndarray[tuple[int], np.dtype[np.uint32]],
) -> np.ndarray[tuple[int], np.dtype[np.uint32]]:
    """Add NEC axes, latitude and longitude as far as attitude and position are there."""
    position = None
    if "position" in samples:
        position = np.asarray(samples["position"].values, dtype=np.float64)
        latitude, longitude = latitude_longitude(position)
        variables["latitude"] = (_SCALAR, latitude, {"units": "deg", "long_name": "geocentric latitude"})
        variables["longitude"] = (_SCALAR, longitude, {"units": "deg", "long_name": "longitude"})
    if "attitude" not in samples:
        return flag | np.uint32(Flag.NO_ATTITUDE)
    attitude = np.asarray(samples["attitude"].values, dtype=np.float64)
    frame = str(samples["attitude"].attrs.get("frame", ""))
    nec = to_nec(body, attitude, position, frame)
    variables["field_nec"] = (_VECTOR, nec, _told("calibrated field", "nec"))
    lost = np.uint32(Flag.NO_ATTITUDE) * ~np.isfinite(nec.sum(axis=1))
    return np.asarray(flag | lost.astype(np.uint32), dtype=np.uint32)


def day_parameters(table: xr.Dataset, tt2000: int, reference: Reference) -> Parameters:
    """Return what a calibration table says of an instant.

    Raises
    ------
    ModelError
        When no interval of the table holds the instant.
    """
    inside = (table["start"].values <= tt2000) & (tt2000 < table["end"].values)
    if not inside.any():
        raise ModelError(
            f"the calibration table holds nothing at {to_utc(tt2000)}",
            remedy="reprocess the span with its table",
        )
    row = table.isel(interval=int(np.flatnonzero(inside)[-1])).sel(
        parameter=reference.columns, other=reference.columns
    )
    free = reference.sigma > 0
    return Parameters(
        np.asarray(row["value"].values, dtype=np.float64),
        np.asarray(row["covariance"].values, dtype=np.float64),
        bool(np.all(row["determined"].values[free])),
        _noise(table, row),
    )


def _noise(table: xr.Dataset, row: xr.Dataset) -> float:
    """Return the noise that holds; the median of the others' where an interval's own data tell none."""
    after = table["after"].values
    own, known = float(row["after"]), after[np.isfinite(after)]
    return own if np.isfinite(own) or not known.size else float(np.median(known))
