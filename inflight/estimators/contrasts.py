"""Contrasts: weighted sums of samples around a step that are blind to drift and give 1 for the step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import robust_sigma
from inflight.errors import SamplesError
from inflight.geometry import direction_of
from inflight.time import Int64
from inflight.units import factor_and_offset

Chosen = npt.NDArray[np.bool_]
#: Samples of the residual this many robust sigmas off the fitted drift and step are left out.
_OUTLIER = 6.0
#: A column whose part that the others do not make is smaller than this part of its square is one of theirs.
_NOTHING = 1e-24
#: Places of the orbit kept with each epoch where the samples know them.
_PLACES = ("local_time", "orbit_phase", "latitude", "sunlit", "sun_direction")


@dataclass(frozen=True)
class Series:
    """The samples as arrays, missing ones NaN."""

    stamps: Int64
    residual: Floats
    direction: Floats
    currents: Floats
    names: tuple[str, ...]
    units: tuple[str, ...]
    places: dict[str, Floats]

    @classmethod
    def of(cls, samples: xr.Dataset, residual: Floats, names: tuple[str, ...]) -> Series:
        """Return the arrays of samples, residual and channels; what has weight 0 is missing.

        Raises
        ------
        SamplesError
            A variable is missing or has another shape.
        """
        missing = [name for name in ("tt2000", "field", *names) if name not in samples]
        if missing:
            raise SamplesError(f"samples have no {missing}", remedy="align these channels first")
        count = samples.sizes["time"]
        values = np.asarray(residual, dtype=np.float64)
        if values.shape != (count,):
            raise SamplesError(f"the residual has shape {values.shape}, ({count},) expected")
        if "weight" in samples:
            values = np.where(samples["weight"].values > 0, values, np.nan)
        field = np.asarray(samples["field"].values, dtype=np.float64)
        direction = direction_of(field)
        found = [in_amperes(_one_current(samples[name])) for name in names]
        places = {name: samples[name].values.astype(np.float64) for name in _PLACES if name in samples}
        return cls(
            np.asarray(samples["tt2000"].values, dtype=np.int64),
            values,
            direction,
            np.column_stack([series for series, _ in found]),
            names,
            tuple(unit for _, unit in found),
            places,
        )

    def part(self, start: int, end: int) -> slice:
        """Return the samples in a half-open span."""
        return slice(*(int(i) for i in np.searchsorted(self.stamps, [start, end])))


def _one_current(series: xr.DataArray) -> xr.DataArray:
    """Return the channel, which must be one number a time."""
    if series.ndim != 1:
        raise SamplesError(
            f"has dims {series.dims}, one current expected", channel=str(series.name), remedy="take one axis"
        )
    return series


def in_amperes(series: xr.DataArray) -> tuple[Floats, str]:
    """Return a channel (time, ...) in A where it is a current, else as it is, and its unit."""
    unit = str(series.attrs.get("units", "1"))
    try:
        factor, offset = factor_and_offset(unit, "A")
    except ValueError:
        return series.values.astype(np.float64), unit
    return factor * series.values.astype(np.float64) + offset, "A"


@dataclass(frozen=True)
class Contrast:
    """Weights over some samples that are blind to drift and give 1 for the shape."""

    weight: Floats
    drift: Floats
    basis: Floats
    used: Floats

    @classmethod
    def of(cls, drift: Floats, shape: Floats) -> Contrast | None:
        """Return the contrast for a shape (time,) against a drift (time, part); None where it is drift."""
        basis = _orthonormal(drift)
        own = shape - (basis @ shape) @ basis
        power = float(own @ own)
        if shape.size < drift.shape[1] + 3 or power <= 1e-9 * float(shape @ shape):
            return None
        return cls(own / power, drift, basis, shape)

    def residual(self, values: Floats) -> Floats:
        """Return what drift and shape leave of values; (time,)."""
        left = self._without_shape(values)
        return np.asarray(left - (self.basis @ left) @ self.basis)

    def common(self, values: Floats) -> Floats:
        """Return the coefficients of the drift in values; (part,)."""
        return np.asarray(np.linalg.lstsq(self.drift, self._without_shape(values))[0])

    def _without_shape(self, values: Floats) -> Floats:
        return np.asarray(values - float(self.weight @ values) * self.used)


def _orthonormal(drift: Floats) -> Floats:
    """Return an orthonormal basis of a few columns (time, part) as rows; zeros for what adds nothing.

    Gram and Schmidt, twice: for a few columns of a hundred samples a library's call costs more than its work.
    """
    basis = np.zeros((drift.shape[1], len(drift)))
    for place, column in enumerate(drift.T):
        rest, own = column, basis[:place]
        for _ in range(2):
            rest = rest - (own @ rest) @ own
        power = float(rest @ rest)
        if power > _NOTHING * float(column @ column):
            basis[place] = rest / np.sqrt(power)
    return basis


def robust_contrast(
    drift: Floats, values: Floats, shape: Floats, usable: Chosen
) -> tuple[Contrast, Chosen, float] | None:
    """Return the contrast without outliers, the samples kept, and the noise of one."""
    kept = usable
    contrast = Contrast.of(drift[kept], shape[kept])
    for _ in range(3):
        if contrast is None:
            return None
        left = contrast.residual(values[kept])
        limit = _OUTLIER * robust_sigma(left)
        far = np.abs(left) > max(limit, 1e-12)
        if not far.any():
            break
        kept = kept.copy()
        kept[np.flatnonzero(kept)[far]] = False
        contrast = Contrast.of(drift[kept], shape[kept])
    if contrast is None:
        return None
    left = contrast.residual(values[kept])
    freedom = max(left.size - drift.shape[1] - 1, 1)
    return contrast, kept, float(np.sqrt(np.sum(left**2) / freedom))
