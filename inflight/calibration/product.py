"""Level-2 fields of a day: the calibrated field, its corrections apart, uncertainty and quality.

Takes aligned samples, a model and a calibration table; makes the Dataset of a day's product.

The remaining residual may be subtracted from the vector as a term of its own, last of all (Yin 2010,
eq. 3.7, `distribute_residual`): ``B' = (1 - dB'/|B|) B`` with dB' the residual low-passed at a period of
80 s. It makes vector and scalar agree on slow scales whatever the cause, and so hides errors: its size is
part of the product.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats, finite_rows
from inflight.calibration.extrapolation import LEARNT, change_outside
from inflight.calibration.scalar import ParameterPrior, sensor_reading, usable_samples
from inflight.calibration.table import noise_of_rows
from inflight.effects import field_strength
from inflight.errors import ModelError, SamplesError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.frames import latitude_longitude, rotate, to_nec
from inflight.lsq import BIWEIGHT_WIDTH, robust_sigma
from inflight.model import (
    FieldChange,
    Model,
    delay_number,
    instrument_variance,
    number_fields,
    place_variance,
    table_variance,
)
from inflight.time import SECOND, Int64, to_utc, usual_step


@dataclass(frozen=True, kw_only=True)
class ClosureSettings:
    """How the residual's slow part is filtered.

    Attributes
    ----------
    order : int
        Order of the difference that the filter keeps small: it passes ``1 / (1 + (f/fc)^6)``.
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

    order: int = 3
    fewest_samples: int = 8
    most_samples: int = 100
    shortest: float = 2.0
    gap: float = 0.5
    edge: float = 2.0


CLOSURE_SETTINGS = ClosureSettings()


#: Period at which the filter passes half of the amplitude, s.
FILTER_PERIOD_S = 80.0


@dataclass(frozen=True)
class ResidualCorrection:
    """The last term of a product and what it removes.

    Attributes
    ----------
    correction : ndarray, shape (time, 3)
        Term to subtract from the vector, nT; 0 where it is not valid.
    slow : ndarray, shape (time,)
        dB', nT; NaN where it is not valid.
    sigma : ndarray, shape (time,)
        Standard deviation of dB' by the residual's own fast noise, nT.
    remaining : ndarray, shape (time,)
        dB - dB', the residual of B', nT.
    edge : ndarray of bool, shape (time,)
        Within two periods of the end of a stretch: the filter is one-sided there.
    valid : ndarray of bool, shape (time,)
        False in stretches shorter than two periods, and in gaps.
    period, cadence : float
        s.
    """

    correction: Floats
    slow: Floats
    sigma: Floats
    remaining: Floats
    edge: np.ndarray
    valid: np.ndarray
    period: float
    cadence: float

    @property
    def rms(self) -> float:
        """Rms of the term along the field, nT: how much it hides."""
        return float(np.sqrt(np.mean(self.slow[self.valid] ** 2))) if self.valid.any() else float("nan")

    @property
    def rms_remaining(self) -> float:
        """Rms residual of B', nT."""
        known = self.valid & np.isfinite(self.remaining)
        return float(np.sqrt(np.mean(self.remaining[known] ** 2))) if known.any() else float("nan")

    def summary(self) -> str:
        """Return as a sentence how much was distributed."""
        share = float(np.mean(self.valid))
        return (
            f"{self.rms:.3f} nT rms of the residual were distributed along the field on "
            f"{100 * share:.1f} % of the samples; {self.rms_remaining:.3f} nT are left, "
            f"faster than {self.period:g} s"
        )

    def table(self) -> xr.Dataset:
        """Return the sizes: dim parameter."""
        names = ["rms_distributed", "rms_left", "share_done", "share_edge"]
        # What filtered noise alone leaves of chance: one value a period, and one a sample.
        count = int(self.valid.sum())
        slow, fast = max(count * self.cadence / self.period, 1.0), max(count, 1)
        sigma = [self.rms / np.sqrt(2 * slow), self.rms_remaining / np.sqrt(2 * fast), 0.0, 0.0]
        values = [self.rms, self.rms_remaining, float(self.valid.mean()), float(self.edge.mean())]
        return xr.Dataset(
            {
                "value": ("parameter", np.array(values)),
                "sigma": ("parameter", np.array(sigma)),
                "units": ("parameter", np.array(["nT", "nT", "1", "1"])),
            },
            coords={"parameter": names},
            attrs={"period_s": self.period, "told": self.summary()},
        )


def distribute_residual(
    field: Floats,
    residual: Floats,
    tt2000: Int64,
    good: np.ndarray | None = None,
    period: float = FILTER_PERIOD_S,
) -> ResidualCorrection:
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
        Samples the filter may use; the others get its value, too.
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
    if period < CLOSURE_SETTINGS.fewest_samples * cadence:
        raise SamplesError(
            f"samples every {cadence:g} s have no low-pass at {period:g} s",
            remedy=f"use a period of at least {CLOSURE_SETTINGS.fewest_samples * cadence:g} s",
        )
    use = np.isfinite(residual) & (True if good is None else good)
    slow, sigma = np.full(residual.size, np.nan), np.full(residual.size, np.nan)
    edge = np.zeros(residual.size, dtype=bool)
    place = np.rint((tt2000 - tt2000[0]) / (cadence * SECOND)).astype(np.int64)
    index = np.flatnonzero(use)
    gaps = np.flatnonzero(np.diff(place[index]) > CLOSURE_SETTINGS.gap * period / cadence)
    for stretch in np.split(index, gaps + 1) if index.size else ():
        first, last = int(stretch[0]), int(stretch[-1])
        if (place[last] - place[first]) * cadence < CLOSURE_SETTINGS.shortest * period:
            continue
        span = slice(first, last + 1)
        slow[span], sigma[span] = _low_pass(place[span], residual[span], use[span], period / cadence)
        near = np.minimum(place[span] - place[first], place[last] - place[span]) * cadence
        edge[span] = near < CLOSURE_SETTINGS.edge * period
    strength = np.linalg.norm(field, axis=1)
    valid = np.isfinite(slow) & np.isfinite(strength) & (strength > 0)
    share = np.divide(slow, strength, out=np.zeros_like(slow), where=valid)
    correction = np.where(valid[:, None], share[:, None] * np.nan_to_num(field), 0.0)
    return ResidualCorrection(correction, slow, sigma, residual - slow, edge, valid, period, cadence)


def _low_pass(place: Int64, residual: Floats, use: np.ndarray, period: float) -> tuple[Floats, Floats]:
    """Return the slow part of a stretch and its standard deviation; (time,). `period` is in steps."""
    bins = max(1, int(period // CLOSURE_SETTINGS.most_samples))
    count = int(place[-1] - place[0]) // bins + 1
    cell = (place - place[0]) // bins
    weight = np.bincount(cell[use], minlength=count).astype(np.float64)
    total = np.bincount(cell[use], weights=residual[use], minlength=count).astype(np.float64)
    smooth = whittaker(total, weight, period / bins, bins)
    centre = np.arange(count) * bins + 0.5 * (bins - 1)
    steps = (place - place[0]).astype(np.float64)
    slow = smooth[cell] if bins == 1 else np.asarray(scipy.interpolate.CubicSpline(centre, smooth)(steps))
    white = float(np.std((residual - slow)[use]))
    ends = np.minimum(steps, steps[-1] - steps) / bins
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
    order, size = CLOSURE_SETTINGS.order, weight.size
    stiffness = full / (2.0 * np.sin(np.pi / period)) ** (2 * order)
    stencil = (-1.0) ** np.arange(order + 1) * scipy.special.binom(order, np.arange(order + 1))
    band = np.zeros((order + 1, size))
    rows = size - order
    for i in range(order + 1):
        for j in range(i + 1):
            # Row i - j below the diagonal, column j of every difference that reaches it.
            band[i - j, j : j + rows] += stiffness * stencil[i] * stencil[j]
    band[0] += weight
    return np.asarray(scipy.linalg.solveh_banded(band, total, lower=True))


@lru_cache(maxsize=8)
def edge_gain(period: int) -> Floats:
    """Return the standard deviation of filtered unit white noise at so many steps from an end; (step,)."""
    size = 6 * period
    columns = np.stack([whittaker(impulse, np.ones(size), period) for impulse in np.eye(size)], axis=1)
    return np.asarray(np.linalg.norm(columns[: size // 2], axis=1))


#: Samples whose uncertainties are computed at once.
_AT_ONCE = 8192

_VECTOR, _SCALAR = ("time", "axis"), ("time",)

_Variables = dict[str, tuple[tuple[str, ...], Floats, dict[str, object]]]
_Flags = npt.NDArray[np.uint32]

#: Of each component which parameters it depends on, and its derivatives by them, (parameter, term): sums of
#: the terms of `_terms_of`.
_Slopes = list[tuple[list[int], Floats]]


@dataclass(frozen=True)
class JointNumbers:
    """Numbers of the vector sensor's other effects whose errors move the nine parameters, too.

    Attributes
    ----------
    sigma : mapping of str to float
        By name; physical units.
    shift : ndarray, shape (number, 9)
        Covariance of the nine with each in units of its sigma.
    correlation : ndarray, shape (number, number)
    """

    sigma: Mapping[str, float]
    shift: Floats
    correlation: Floats

    @classmethod
    def of(cls, interval: xr.Dataset, columns: Sequence[int]) -> JointNumbers | None:
        """Return those of a row of a table; None where it has none."""
        if "number_shift" not in interval:
            return None
        names = interval["number"].values.tolist()
        return cls(
            dict(zip(names, interval["number_sigma"].values.tolist(), strict=True)),
            interval["number_shift"].values[:, columns],
            interval["number_correlation"].values if "number_correlation" in interval else np.eye(len(names)),
        )

    def variance(self, slopes: _Slopes, terms: Floats, fields: Mapping[str, FieldChange]) -> Floats:
        """Return what the numbers add to the variance of the field that the nine have; (axis, time) nT^2.

        With D what the nine do to the field, F what one sigma of each number does and S the shifts it is
        ``2 D S^T F + F R F``: below zero where the nine make good what a number does.

        Parameters
        ----------
        slopes, terms
            As `_derivatives` and `_terms_of`.
        fields : mapping of str to tuple
            As `inflight.model.number_fields`.
        """
        out = np.zeros((len(slopes), terms.shape[1]))
        for axis, (index, slope) in enumerate(slopes):
            changes = {place: fields[name][axis] for place, name in enumerate(self.sigma) if name in fields}
            own = {place: one for place, one in changes.items() if one is not None}
            places = list(own)
            shift = 2.0 * self.shift[places][:, index] @ slope
            correlation = self.correlation[np.ix_(places, places)].T
            # A row for each number, of some hours: what is summed lies together, and near the processor.
            for start in range(0, terms.shape[1] if own else 0, _AT_ONCE):
                some = slice(start, start + _AT_ONCE)
                moved = np.array([one[some] for one in own.values()])
                change = shift @ terms[:, some]
                change += correlation @ moved
                np.einsum("nt,nt->t", change, moved, out=out[axis, some])
        return out


@dataclass(frozen=True)
class DayParameters:
    """The nine parameters that hold for a day, with their covariance; physical units.

    Samples outside `learnt`, the span that taught them (half-open TT2000, None for any time), are flagged,
    and there parameters may have changed by `change` (one sigma): see `inflight.calibration.extrapolation`.
    What `joint` says is not in the covariance, but for the part of the nine.
    """

    value: Floats
    covariance: Floats
    all_determined: bool
    noise: float
    learnt: tuple[int, int] | None = None
    change: Floats | None = None
    joint: JointNumbers | None = None


def level2(
    model: Model,
    samples: xr.Dataset,
    parameters: DayParameters,
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
    parameters : DayParameters
        For uncertainties and flags.
    raw : Model
        The pre-flight model, for the residual before calibration.
    widening : ndarray, shape (time, axis), optional
        What missing channels add to the variance, nT^2, sensor axes: see `inflight.model.substitution`.
    distribute : bool, optional
        The slow part of the residual along the field (Yin 2010, eq. 3.7): True subtracts it, False only
        states it, None leaves it out. It hides what the model lacks; its size is in the product.

    Returns
    -------
    xarray.Dataset
        `field_sensor`, `field_spacecraft`, `field_nec` (time, axis) nT; `scalar` (time) nT;
        `residual`, `residual_preflight` (time) nT, |B_vector| - F; ``correction_<effect>`` nT, what
        was subtracted (vector sensors: orthogonal axes of the sensor; scalar sensors: along the
        field); `before_stray_field` (time, axis) nT, spacecraft axes, the calibrated field with these terms
        of the vector sensor still in, where it is their sum (`Model.before_corrections`);
        ``correction_distribution`` (time, axis) nT, sensor axes, when asked for, with attribute `applied`;
        `uncertainty` (time, axis) nT, 1 sigma, sensor axes, with what the sensor's orientation and clock are
        known to; NaN where a missing channel makes it unknown; `flag` (time) uint32;
        `latitude`, `longitude` when the position is known.
    """
    corrected = cast("xr.Dataset", model.corrected(samples))
    field, scalar = (np.asarray(corrected[name].values) for name in ("field", "scalar"))
    residual = field_strength(corrected) - scalar
    reading = sensor_reading(model, samples)
    flag = _quality_flag(samples, reading, field, scalar, residual, parameters)
    distribution = None
    if distribute is not None:
        good = (flag & np.uint32(UNUSABLE | Flag.OUTLIER)) == 0
        with suppress(SamplesError):  # samples may be too slow for the filter
            distribution = distribute_residual(field, residual, np.asarray(samples["tt2000"].values), good)
    if distribution is not None and distribute:
        field = field - distribution.correction
    sensor = next(entry.sensor for entry in model.effects if entry.sensor.role == "vector")
    orientation = np.asarray(sensor.orientation)
    body = rotate(field, orientation)
    before = raw.residual(samples)[:, 0]
    stamps_of = np.asarray(samples["tt2000"].values)
    numbers = parameters.joint.sigma if parameters.joint else {}
    late = delay_number(sensor)
    fields = number_fields(model.effects, samples, numbers)
    if late in numbers and len(field) > 1:
        rate = np.nan_to_num(np.gradient(field, stamps_of / SECOND, axis=0))
        fields[late] = tuple(-numbers[late] * rate.T)
    variance = _variance(reading, parameters, fields) + place_variance(model.effects, corrected)
    variance += table_variance(model.effects, corrected)
    variance += instrument_variance(sensor, field, stamps_of, clock=late not in fields)
    if parameters.change is not None:
        outside = flag & np.uint32(Flag.EXTRAPOLATED) > 0
        variance[outside] += _effect_of_change(reading[outside], parameters) ** 2
    sigma = np.sqrt(variance if widening is None else variance + widening)
    variables: _Variables = {
        "field_sensor": (_VECTOR, field, _attributes("calibrated field", "sensor")),
        "field_spacecraft": (_VECTOR, body, _attributes("calibrated field", "spacecraft")),
        "scalar": (_SCALAR, scalar, _attributes("calibrated field strength of the scalar sensor")),
        "residual": (_SCALAR, residual, _attributes("|B_vector| - F after calibration")),
        "residual_preflight": (_SCALAR, before, _attributes("|B_vector| - F with the pre-flight model")),
        "uncertainty": (_VECTOR, sigma, _attributes("one sigma", "sensor")),
    }
    terms = model.correction_terms(corrected)
    before_terms = model.before_corrections(corrected, terms)
    if before_terms is not None:
        attributes = _attributes("calibrated field, nothing of the spacecraft's taken out", "spacecraft")
        variables["before_stray_field"] = (_VECTOR, rotate(before_terms, orientation), attributes)
    for name, term in terms.items():
        dims, frame = (_VECTOR, "sensor") if term.ndim == 2 else (_SCALAR, "")
        attributes = _attributes(f"taken out of the reading: {name}", frame)
        variables[f"correction_{name}"] = (dims, term, attributes)
    if distribution is not None:
        attributes = _attributes("slow part of the residual along the field (Yin 2010, eq. 3.7)", "sensor")
        attributes["applied"] = "yes" if distribute else "no"
        attributes |= {"period_s": distribution.period, "rms_nT": distribution.rms}
        variables["correction_distribution"] = (_VECTOR, distribution.correction, attributes)
    flag = _add_geometry(variables, samples, body, flag)
    masks, names = flag_meanings()
    stamps = (_SCALAR, samples["tt2000"].values, {"units": "ns", "scale": "TT2000"})
    return xr.Dataset(
        {
            **variables,
            "flag": (_SCALAR, flag, {"flag_masks": masks, "flag_meanings": names}),
            "tt2000": stamps,
        },
        coords={"axis": ["x", "y", "z"]},
        attrs={"comparison": model.comparison},
    )


def _attributes(long_name: str, frame: str = "") -> dict[str, object]:
    attributes: dict[str, object] = {"units": "nT", "long_name": long_name}
    return attributes | {"frame": frame} if frame else attributes


def _quality_flag(
    samples: xr.Dataset,
    reading: Floats,
    field: Floats,
    scalar: Floats,
    residual: Floats,
    known: DayParameters,
) -> _Flags:
    """Return the samples' flags with those of missing channels, outliers and parameters from a prior."""
    flag = samples["flag"].values.astype(np.uint32)
    missing = np.uint32(Flag.VECTOR_MISSING | Flag.SCALAR_MISSING | Flag.OTHER_RANGE)
    lost = ~(finite_rows(reading) & finite_rows(field) & np.isfinite(scalar))
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
    if known.learnt is not None:
        stamps = samples["tt2000"].values
        inside = (known.learnt[0] <= stamps) & (stamps < known.learnt[1])
        flag[~inside] |= np.uint32(Flag.EXTRAPOLATED)
    return flag


def _variance(reading: Floats, known: DayParameters, fields: Mapping[str, FieldChange]) -> Floats:
    """Propagate the covariance of all parameters and the residual's noise; (time, axis) nT^2, sensor axes.

    `fields` are those of one sigma of each number beside the nine (`inflight.model.number_fields`).
    """
    terms, slopes = _terms_of(reading, known), _derivatives(known)
    own = np.stack([slope.T @ known.covariance[np.ix_(index, index)] @ slope for index, slope in slopes])
    out = np.einsum("akt,kt->at", own @ terms, terms)
    if known.joint is not None:
        out += known.joint.variance(slopes, terms, fields)
    return np.asarray((np.maximum(out, 0.0) + known.noise**2).T)


def _effect_of_change(reading: Floats, known: DayParameters) -> Floats:
    """Return what changes of all parameters together may do to the field; (time, axis) nT, sensor axes."""
    assert known.change is not None
    terms = _terms_of(reading, known)
    parts = [known.change[index] @ np.abs(slope @ terms) for index, slope in _derivatives(known)]
    return np.stack(parts, axis=1)


def _terms_of(reading: Floats, known: DayParameters) -> Floats:
    """Return what the derivatives of the field are sums of: the reading without its offsets, and one."""
    return np.vstack([(reading - known.value[6:]).T, np.ones(len(reading))])


def _derivatives(known: DayParameters) -> _Slopes:
    """Return of each component which parameters it depends on, and its derivatives by these.

    B = K (E - E0): a row of K and the offsets enter each component.
    """
    cos = np.cos(np.deg2rad(known.value[3:6]))
    slope = -np.sin(np.deg2rad(known.value[3:6])) * np.pi / 180.0
    k, (x, y, z, one) = known.value[:3], np.eye(4)
    # x has scale, two angles and three offsets.
    rows = (
        ([0, 3, 4, 6, 7, 8], [x, slope[0] * y, slope[1] * z, -k[0] * one, -cos[0] * one, -cos[1] * one]),
        ([1, 5, 7, 8], [y, slope[2] * z, -k[1] * one, -cos[2] * one]),
        ([2, 8], [z, -k[2] * one]),
    )
    return [(index, np.stack(parts)) for index, parts in rows]


def _add_geometry(variables: _Variables, samples: xr.Dataset, body: Floats, flag: _Flags) -> _Flags:
    """Add NEC axes, latitude and longitude where attitude and position are known; return the flags."""
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
    variables["field_nec"] = (_VECTOR, nec, _attributes("calibrated field", "nec"))
    lost = np.uint32(Flag.NO_ATTITUDE) * ~finite_rows(nec)
    return np.asarray(flag | lost.astype(np.uint32), dtype=np.uint32)


def day_parameters(
    table: xr.Dataset, tt2000: int, reference: ParameterPrior, span: tuple[int, int] | None = None
) -> DayParameters:
    """Return the nine parameters of a calibration table at an instant.

    They are extrapolated where the half-open TT2000 `span`, the instant alone without one, is not within the
    one they were learnt from. The noise is that of the interval, or the median of the others' where its own
    data do not determine it.

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
    row = int(np.flatnonzero(inside)[-1])
    places = {name: place for place, name in enumerate(table["parameter"].values.tolist())}
    columns = [places[name] for name in reference.columns]
    free = reference.sigma > 0
    interval = table.isel(interval=row)
    change = change_outside(interval, table, span or (tt2000, tt2000), reference.columns)
    return DayParameters(
        np.array(table["value"].values[row, columns], dtype=np.float64),
        np.array(table["covariance"].values[row][np.ix_(columns, columns)], dtype=np.float64),
        bool(np.all(table["determined"].values[row, columns][free])),
        float(noise_of_rows(table)[row]),
        None if change is None else (int(interval[LEARNT[0]]), int(interval[LEARNT[1]])),
        change,
        JointNumbers.of(interval, columns),
    )
