"""`align`: channels of unequal cadence on one time base, without inventing data across gaps.

Each channel is resampled on the base by one of three stated methods (attribute ``resampling``):

exact
    The base's stamps are among the channel's: values are picked (but never from a faster field).
band_limited
    A field whose own cadence is as fast or faster: Kaiser-windowed sinc, low-passed at the base's
    Nyquist frequency when the base is slower. All samples under the window must be there, and none
    of them rejected by its own instrument.
linear
    Everything else: between two samples no further apart than one and a half cadences.

A field that is averaged (attribute ``average_ns``) is resampled at a few moments of that time, whose weighted
sum is the mean of what was resampled. A target without the samples it needs is NaN. `Series` holds a channel
as plain arrays, `PlainSamples` samples as plain variables, for code that reads thousands of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats, finite_rows
from inflight.errors import SamplesError
from inflight.flags import Flag
from inflight.time import GAP, Int64, in_leap_second, to_utc

if TYPE_CHECKING:
    import xarray as xr

#: Roles that hold fields: they are interpolated band-limited, the rest linearly.
FIELD_ROLES = ("vector", "scalar", "inboard", "outboard")


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """How channels are resampled on a time base.

    Attributes
    ----------
    lobes : float
        Half-width of the sinc window in lobes; with `kaiser_beta` the stop band lies below -100 dB (derived).
    kaiser_beta : float
        Parameter of the Kaiser window.
    same_stamp : float
        Stamps closer than this part of a cadence are the same stamp: at 1 s and 40 nT/s, the fastest field of
        a low orbit, an error of less than a picotesla (derived).
    same_cadence : float
        Cadences that differ by less than this part are the same cadence (assumed).
    usual_step_of : int
        Stamps the usual distance is taken from, for speed.
    moments : int
        Moments that a mean is made of, beyond one for each radian of the fastest wave there is: so the
        Gauss-Legendre rule is exact to 1e-7 (derived).
    """

    lobes: float = 16
    kaiser_beta: float = 10.0
    same_stamp: float = 2e-5
    same_cadence: float = 1e-3
    usual_step_of: int = 2001
    moments: int = 3


ALIGNMENT_SETTINGS = AlignmentSettings()

_REJECTED = Flag.INSTRUMENT_FLAG | Flag.OUT_OF_RANGE

_MISSING = dict.fromkeys(("vector", "inboard", "outboard"), Flag.VECTOR_MISSING)
_MISSING["scalar"] = Flag.SCALAR_MISSING


@dataclass(frozen=True)
class Series:
    """A channel at its own stamps.

    Attributes
    ----------
    values : ndarray, shape (time,) or (time, component)
    stamps : ndarray of int64, shape (time,)
        TT2000. Channels of one instrument may hold the same array: what follows from it is worked out once.
    attrs : mapping
        With `cadence_ns`, `lag_ns` and `units`; `average_ns` of a field that is averaged so long around
        each time asked for.
    flag : ndarray of uint32, shape (time,), optional
        The instrument's own.
    """

    values: npt.NDArray[Any]
    stamps: Int64
    attrs: Mapping[Any, Any]
    flag: npt.NDArray[np.uint32] | None = None

    @classmethod
    def of(cls, name: str, array: xr.DataArray) -> Series:
        """Return it from an array with the coordinate `tt2000`, and `flag` where there is one.

        Raises
        ------
        SamplesError
            When it has no stamps.
        """
        if "tt2000" not in array.coords:
            raise SamplesError(
                "the channel has no stamps", channel=name, remedy="give it a coordinate 'tt2000'"
            )
        flag = np.asarray(array["flag"].values, dtype=np.uint32) if "flag" in array.coords else None
        return cls(array.values, np.asarray(array["tt2000"].values, dtype=np.int64), array.attrs, flag)


def align(
    channels: Mapping[str, xr.DataArray | Series], base: str | Int64, lags: Mapping[str, int] | None = None
) -> xr.Dataset:
    """Put channels on one time base; the only maker of samples.

    Parameters
    ----------
    channels : mapping of str to DataArray or Series
        By name in the samples (roles such as `vector`, `scalar`, and housekeeping names); dims
        (time,) or (time, axis), a coordinate `tt2000` (time) int64, attributes `cadence_ns` and
        `units`; attribute `lag_ns` is the channel's own lag. A coordinate `flag` is carried along.
    base : str or ndarray of int64
        Channel whose stamps carry the samples, or the stamps themselves (TT2000, increasing).
    lags : mapping of str to int, optional
        Lags in nanoseconds that replace the channels' own. With a positive lag the value at t is
        the channel's at ``t - lag``: the field follows its channel.

    Returns
    -------
    xarray.Dataset
        dims time (UTC index), axis; every channel, `tt2000`, `flag` (uint32) and `weight`.

    Raises
    ------
    SamplesError
        When stamps are not increasing or a channel lacks its stamps.
    """
    import xarray as xr

    lags = lags or {}
    known = {name: one if isinstance(one, Series) else Series.of(name, one) for name, one in channels.items()}
    stamps = known[base].stamps if isinstance(base, str) else np.asarray(base, dtype=np.int64)
    if isinstance(base, str):
        _require_increase(base, stamps)
    places = _Places(stamps)
    flag = np.where(in_leap_second(stamps), np.uint32(Flag.LEAP_SECOND), np.uint32(0)).astype(np.uint32)
    variables: dict[str, xr.Variable] = {}
    for name, series in known.items():
        lag = int(lags.get(name, series.attrs.get("lag_ns", 0)))
        values, method = _resample(name, series, places, lag)
        if name in _MISSING:
            own = _flags_at(series, places.target(lag))
            # A reading in another range is there: it is no more than left out.
            lost = ~finite_rows(values) & (own & np.uint32(Flag.OTHER_RANGE) == 0)
            flag[lost] |= np.uint32(_MISSING[name])
            if name == "scalar":
                # No place near the Earth or in the solar wind has no field: the instrument failed.
                flag[values <= 0] |= np.uint32(Flag.OUT_OF_RANGE)
            flag |= own
        attrs = {**series.attrs, "lag_ns": lag, "resampling": method}
        # `axis` belongs to vectors of three, other components get a dimension of their own.
        component = "axis" if values.ndim > 1 and values.shape[1] == 3 else f"{name}_component"
        # Each axis as one run of memory: arithmetic with one number an axis is then several times as fast.
        values = np.asfortranarray(values) if name in FIELD_ROLES else values
        variables[name] = xr.Variable(("time", component)[: values.ndim], values, attrs)
    variables["tt2000"] = xr.Variable("time", stamps)
    variables["flag"] = xr.Variable("time", flag)
    variables["weight"] = xr.Variable("time", (flag & ~np.uint32(Flag.LEAP_SECOND) == 0).astype(np.float64))
    return xr.Dataset(variables, coords={"time": to_utc(stamps)})


def _require_increase(name: str, stamps: Int64) -> None:
    if stamps.size > 1 and np.any(np.diff(stamps) <= 0):
        raise SamplesError("stamps do not increase", channel=name, remedy="ingest sorts and merges stamps")


#: Where targets are among stamps, and which of them are there; None when they run between them.
_Picked = tuple[Int64, npt.NDArray[np.bool_]] | None


@dataclass
class _Places:
    """Where the samples' stamps are among those of channels: worked out once for an instrument's channels.

    Attributes
    ----------
    base : ndarray of int64, shape (time,)
        Stamps of the samples, TT2000.
    """

    base: Int64
    _targets: dict[int, Int64] = field(default_factory=dict)
    _slices: dict[tuple[int, int], slice | None] = field(default_factory=dict)
    _picked: dict[tuple[int, int, int], _Picked] = field(default_factory=dict)

    def target(self, lag: int) -> Int64:
        """Return the times asked for of channels with a lag, ns."""
        if lag not in self._targets:
            self._targets[lag] = self.base - lag
        return self._targets[lag]

    def slice_of(self, name: str, stamps: Int64, lag: int) -> slice | None:
        """Return where the targets are among the stamps when they are a stretch of them, else None.

        Raises
        ------
        SamplesError
            When the stamps, those of a channel, do not increase.
        """
        key = (id(stamps), lag)
        if key not in self._slices:
            _require_increase(name, stamps)
            self._slices[key] = _slice_of(stamps, self.target(lag))
        return self._slices[key]

    def picked(self, stamps: Int64, lag: int, cadence: int) -> _Picked:
        """Return where the targets are among the stamps, or None when they run between them."""
        key = (id(stamps), lag, cadence)
        if key not in self._picked:
            self._picked[key] = _pick(stamps, self.target(lag), cadence)
        return self._picked[key]


def _resample(name: str, series: Series, places: _Places, lag: int) -> tuple[Floats, str]:
    """Return values at the targets, (time,) or (time, axis), and the method used."""
    values = np.asarray(series.values, dtype=np.float64)
    if series.attrs.get("kind") == "attitude" and values.ndim == 2 and values.shape[1] == 4:
        plain = Series(continuous_sign(values), series.stamps, series.attrs)
        found, method = _resample_values(name, plain, places, lag)
        x, y, z, w = found.T
        return found / np.sqrt(x * x + y * y + z * z + w * w)[:, None], method
    return _resample_values(name, replace(series, values=values), places, lag)


def _averaged(name: str, series: Series, places: _Places, lag: int) -> tuple[Floats, str]:
    """Return means over the time that a field is to be averaged, centred on the targets."""
    over, target = int(series.attrs["average_ns"]), places.target(lag)
    cadence = int(series.attrs.get("cadence_ns", 0)) or _usual_step(series.stamps)
    # The fastest wave that resampling passes turns by so many radians in half of the time.
    radians = 0.5 * np.pi * over / max(cadence, _usual_step(target))
    moments, weights = np.polynomial.legendre.leggauss(ALIGNMENT_SETTINGS.moments + int(np.ceil(radians)))
    plain = replace(series, attrs={key: value for key, value in series.attrs.items() if key != "average_ns"})
    total: Floats = np.zeros((target.size, *series.values.shape[1:]))
    methods = []
    for moment, weight in zip(0.5 * over * moments, 0.5 * weights, strict=True):
        values, method = _resample_values(name, plain, _Places(target + round(moment)), 0)
        total += weight * values
        methods.append(method)
    return total, next((method for method in methods if method != "exact"), "exact")


def continuous_sign(quaternion: Floats) -> Floats:
    """Return the same rotations with signs that do not jump: q and -q turn alike but do not average."""
    valid = np.isfinite(quaternion).all(axis=1)
    flips = np.einsum("ij,ij->i", quaternion[valid][1:], quaternion[valid][:-1]) < 0
    sign = np.ones(len(quaternion))
    sign[valid] = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))[: valid.sum()]
    return quaternion * sign[:, None]


def _resample_values(name: str, series: Series, places: _Places, lag: int) -> tuple[Floats, str]:
    """Resample values from stamps to targets by the method that fits name and cadence."""
    if name in FIELD_ROLES and series.attrs.get("average_ns"):
        return _averaged(name, series, places, lag)
    from inflight.samples.interpolation import linear, sinc  # compiled: who only plans does not wait for it

    values, stamps, target = series.values, series.stamps, places.target(lag)
    same = places.slice_of(name, stamps, lag)
    if same is not None:
        return values[same], "exact"
    shape = (target.size, *values.shape[1:])
    if stamps.size == 0:
        return np.full(shape, np.nan), "none"
    cadence = int(series.attrs.get("cadence_ns", 0)) or _usual_step(stamps)
    base_step = _usual_step(target)
    is_field = name in FIELD_ROLES
    # A faster field is low-passed even where stamps coincide: picking would fold its noise into the band.
    faster = is_field and target.size > 1 and cadence < base_step * (1 - ALIGNMENT_SETTINGS.same_cadence)
    picked = None if faster else places.picked(stamps, lag, cadence)
    if picked is not None:
        index, there = picked
        chosen = values.take(index, axis=0)
        if not there.all():
            chosen[~there] = np.nan
        return chosen, "exact"
    wide = values.reshape(values.shape[0], -1)
    own_flags = _own_flags(series)
    if own_flags is not None:
        # A reading its own instrument rejects would spread under the window to good ones.
        wide = np.where((own_flags & np.uint32(_REJECTED) != 0)[:, None], np.nan, wide)
    if is_field and cadence <= base_step * (1 + ALIGNMENT_SETTINGS.same_cadence):
        cutoff = min(1.0, cadence / base_step)
        found = sinc(
            stamps,
            wide,
            target,
            float(cadence),
            cutoff,
            ALIGNMENT_SETTINGS.lobes,
            ALIGNMENT_SETTINGS.kaiser_beta,
        )
        return found.reshape(shape), "band_limited"
    return linear(stamps, wide, target, GAP * cadence).reshape(shape), "linear"


def _usual_step(stamps: Int64) -> int:
    """Return the median distance of neighbours, of the first ones: gaps are rare."""
    return int(np.median(np.diff(stamps[: ALIGNMENT_SETTINGS.usual_step_of]))) if stamps.size > 1 else 1


def _slice_of(stamps: Int64, target: Int64) -> slice | None:
    """Return where the targets are among the stamps when they are a stretch of them, else None."""
    first = int(np.searchsorted(stamps, target[0])) if target.size else 0
    stretch = slice(first, first + target.size)
    return stretch if np.array_equal(stamps[stretch], target) else None


def _pick(stamps: Int64, target: Int64, cadence: int) -> tuple[Int64, npt.NDArray[np.bool_]] | None:
    """Return where the targets are among the stamps, or None when they run between them."""
    from inflight.samples.interpolation import nearest

    # A target in a gap of the channel has no stamp near it and cannot decide.
    same = ALIGNMENT_SETTINGS.same_stamp * cadence
    between = 0.5 * cadence * (1 + ALIGNMENT_SETTINGS.same_cadence)
    index, there, all_picked = nearest(stamps, target, same, between)
    return (index, there) if all_picked else None


def _flags_at(series: Series, target: Int64) -> npt.NDArray[np.uint32]:
    """Return the instrument's own flags at the targets: those of the samples on both sides."""
    out = np.zeros(target.size, dtype=np.uint32)
    own = _own_flags(series)
    if own is None:
        return out
    stamps = series.stamps
    cadence = int(series.attrs.get("cadence_ns", 0)) or _usual_step(stamps)
    same = int(ALIGNMENT_SETTINGS.same_stamp * cadence)
    left = np.searchsorted(stamps, target + same, side="right") - 1
    on_stamp = (left >= 0) & (target - stamps[np.clip(left, 0, None)] <= same)
    for index in (left, np.where(on_stamp, left, left + 1)):
        near = np.clip(index, 0, stamps.size - 1)
        near_enough = (near == index) & (np.abs(stamps[near] - target) < GAP * cadence)
        out[near_enough] |= own[near[near_enough]]
    return out


def _own_flags(series: Series) -> npt.NDArray[np.uint32] | None:
    """Return the flags a series carries, or None when there are none."""
    return series.flag if series.flag is not None and series.flag.any() else None


class PlainSamples(dict[str, "xr.Variable"]):
    """Variables by name, with as much of a Dataset's interface as effects and sensor chains use."""

    @classmethod
    def of(cls, dataset: xr.Dataset | PlainSamples) -> PlainSamples:
        """Return the variables of a Dataset, or the samples themselves."""
        if isinstance(dataset, PlainSamples):
            return dataset
        return cls({str(name): variable for name, variable in dataset.variables.items()})

    @property
    def sizes(self) -> dict[str, int]:
        """Length of each dimension."""
        return {"time": int(self["tt2000"].size)}

    def isel(self, time: slice) -> PlainSamples:
        """Return some consecutive samples."""
        return PlainSamples({name: variable[time] for name, variable in self.items()})

    def assign(self, variables: dict[str, Any] | None = None, **more: Any) -> PlainSamples:
        """Return the samples with some variables added: (dims, values, attributes) each."""
        import xarray as xr

        added = (variables or {}) | more
        return PlainSamples(self | {name: xr.Variable(*one) for name, one in added.items()})

    def drop_vars(self, names: list[str], errors: str = "raise") -> PlainSamples:
        """Return the samples without some variables."""
        return PlainSamples({name: variable for name, variable in self.items() if name not in names})
