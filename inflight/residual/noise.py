"""The size of a residual, its noise floor, and the scatter of the daily parameters behind it.

Takes a residual at equal steps, or a table of daily parameters; makes `ResidualStatistics`, `NoiseFloor` and
`ParameterScatter`.

The noise floor is the white level of the residual, measured from its own fast part, whatever its slow part
does: the record is divided into the longest segments that its gaps leave whole; their mean spectrum between a
tenth of the Nyquist frequency and the Nyquist frequency is a white level plus a part that falls with the
square of the frequency; lines above that are not used. The white level is carried to the whole
band, and to a slower working cadence where one is stated. Segments with gaps are not bridged here, as those
of `inflight.residual.spectrum` are: a bridge would lower the level.

An effect that is missing from the model drives the parameters that resemble it: their scatter from day to day
then exceeds their stated standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import MAD_TO_SIGMA
from inflight.residual.spectrum import hann_power
from inflight.time import SECOND

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class NoiseSettings:
    """How a noise floor is measured, and a scatter of parameters.

    Attributes
    ----------
    band : float
        The white level is read above this part of the Nyquist frequency. Assumed.
    lengths : tuple of int
        Lengths of segments that are tried, longest first, samples.
    segments, fewest_segments : int
        Segments a record must give, and of the shortest length. Assumed.
    enough : float
        A length is long enough when its whole segments hold this part of the readings. Assumed.
    fewest : int
        Fewest readings of a level. Assumed.
    mixed : int
        Neighbouring frequencies that a Hann window mixes into one. Derived: half its main lobe.
    outlier : float
        Readings this many sigmas from the mean of their neighbours are not used. Assumed.
    loud : float
        Segments whose power is this many times the usual one are not used. Assumed.
    groups : int
        Groups of segments the interval is taken from.
    wide : float
        Half-width of the interval in standard deviations: 95 % of Student's distribution of `groups`.
    shared : float
        What neighbouring groups hide by sharing samples. Assumed.
    lines : float
        Standard deviations of a frequency's mean power beyond which it is a line. Assumed.
    fewest_days : int
        Fewest days of a scatter.
    """

    band: float = 0.1
    lengths: tuple[int, ...] = (4096, 2048, 1024, 512, 256, 128, 64, 32, 16)
    segments: int = 8
    fewest_segments: int = 3
    enough: float = 0.5
    fewest: int = 64
    mixed: int = 2
    outlier: float = 8.0
    loud: float = 9.0
    groups: int = 20
    wide: float = 2.09
    shared: float = 1.1
    lines: float = 5.0
    fewest_days: int = 3


NOISE_SETTINGS = NoiseSettings()


@dataclass(frozen=True)
class NoiseFloor:
    """White level of a residual as an rms at the working cadence, nT, with its 95 % interval."""

    level_nT: float  # noqa: N815, the unit is spelt as in the JSON
    low_nT: float  # noqa: N815
    high_nT: float  # noqa: N815
    samples: int = 0

    @property
    def sigma_nT(self) -> float:  # noqa: N802
        """Standard deviation of the level, nT."""
        return (self.high_nT - self.low_nT) / (2 * NOISE_SETTINGS.wide)


#: Size of a residual in parts of its noise floor that is at it; assumed.
AT_FLOOR = 1.05
NO_FLOOR = NoiseFloor(float("nan"), float("nan"), float("nan"))


def noise_floor(
    residual: Floats, cadence: float, working: float | None = None, *, alone: bool = True
) -> NoiseFloor:
    """Measure the white level of a residual; gaps, outliers, lines and slow structure do not raise it.

    Parameters
    ----------
    residual : ndarray, shape (time,)
        nT, at equal steps; NaN where it is missing.
    cadence : float
        Seconds between samples.
    working : float, optional
        Seconds of the means that the level refers to; the cadence itself when absent. White
        noise falls with the square root of the samples in a mean.
    alone : bool
        Measure the interval, too, which takes ten times as long; not needed of one of many spans, whose
        scatter tells it (`join_floors`).

    Returns
    -------
    NoiseFloor
        NaN for a record too short or too broken: fewer than 64 readings, or too few stretches of
        16 without a gap.
    """
    values = _without_outliers(np.asarray(residual, dtype=np.float64))
    power = _segment_powers(values)
    if power is None:
        return NO_FLOOR
    variance, sigma = _level_and_sigma(power) if alone else (_white(power.mean(axis=0), power.shape[0]), 0.0)
    mean_of = max(1.0, working / cadence) if working else 1.0
    reach = NOISE_SETTINGS.wide * sigma
    edges = np.maximum([variance, variance - reach, variance + reach], 0.0) / mean_of
    level, low, high = (float(edge) for edge in np.sqrt(edges))
    return NoiseFloor(level, low, high, int(np.isfinite(values).sum()))


def join_floors(floors: Sequence[NoiseFloor]) -> NoiseFloor:
    """Return the level of several spans together: the mean of their variances, by their readings.

    The interval comes from the scatter between spans when there are at least eight, else from theirs.
    """
    known = [floor for floor in floors if np.isfinite(floor.level_nT)]
    if not known:
        return NO_FLOOR
    weight = np.array([max(floor.samples, 1) for floor in known], dtype=np.float64)
    weight /= weight.sum()
    each = np.array([floor.level_nT for floor in known]) ** 2
    variance = float(weight @ each)
    if len(known) >= NOISE_SETTINGS.segments:
        sigma = float(np.sqrt(np.sum(weight**2 * (each - variance) ** 2) / (1.0 - np.sum(weight**2))))
    else:
        own = np.array([2.0 * floor.level_nT * floor.sigma_nT for floor in known])
        sigma = float(np.sqrt(np.sum((weight * own) ** 2)))
    low, high = np.sqrt(
        np.maximum([variance - NOISE_SETTINGS.wide * sigma, variance + NOISE_SETTINGS.wide * sigma], 0.0)
    )
    return NoiseFloor(float(np.sqrt(variance)), float(low), float(high), sum(f.samples for f in known))


def floor_of_rows(
    residual: Floats, good: npt.NDArray[np.bool_], stamps: npt.NDArray[np.int64], *, alone: bool = True
) -> NoiseFloor:
    """Return the white level of a residual of one or several rows a sample, all rows together.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        nT.
    good : ndarray of bool, shape (sample,)
    stamps : ndarray of int64, shape (sample,)
        TT2000, at any spacing: gaps stay gaps.
    alone : bool
        As `noise_floor` takes it.
    """
    step = float(np.median(np.diff(stamps))) / SECOND if stamps.size > 1 else 1.0
    place = np.rint((stamps - stamps[0]) / (step * SECOND)).astype(np.int64)
    found = []
    for row in residual.T:
        even = np.full(int(place[-1]) + 1, np.nan)
        even[place[good]] = row[good]
        found.append(noise_floor(even, step, alone=alone))
    return join_floors(found)


def floor_of_parts(
    residual: Floats,
    good: npt.NDArray[np.bool_],
    stamps: npt.NDArray[np.int64],
    parts: Sequence[slice],
) -> NoiseFloor:
    """Return the white level of parts of a residual together; arrays are those of `floor_of_rows`."""
    floors: list[NoiseFloor] = []
    # The scatter between many parts tells the interval; of few each has to bring its own.
    for alone in (False, True):
        floors = [floor_of_rows(residual[at], good[at], stamps[at], alone=alone) for at in parts]
        if sum(math.isfinite(one.level_nT) for one in floors) >= NOISE_SETTINGS.segments:
            break
    return join_floors(floors)


def _without_outliers(values: Floats) -> Floats:
    """Return the values with NaN where one differs from both its neighbours by far more than is usual."""
    if values.size < 3:
        return values
    away = np.full(values.size, np.nan)
    away[1:-1] = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    known = np.isfinite(away)
    if not known.any():
        return values
    usual = MAD_TO_SIGMA * float(np.median(np.abs(away[known])))
    # Readings so coarse that most do not change have no usual distance; their steps are no outliers.
    usual = usual if usual > 0 else float(np.std(away[known]))
    return np.where(known & (np.abs(away) > NOISE_SETTINGS.outlier * usual), np.nan, values)


def _segment_powers(values: Floats) -> Floats | None:
    """Return the two-sided power of whole segments, white noise of variance v giving v; (segment, frequency).

    Frequencies run from zero to Nyquist. None when there are too few segments of any length.
    """
    finite = np.isfinite(values)
    count = int(finite.sum())
    if count < NOISE_SETTINGS.fewest:
        return None
    sums = np.concatenate([[0], np.cumsum(finite)])
    for length in NOISE_SETTINGS.lengths:
        stride = length // 2 if length > 64 else length // 4
        starts = np.arange(0, max(finite.size - length + 1, 0), stride)
        # Where segments without a gap begin.
        whole = starts[sums[starts + length] - sums[starts] == length]
        spans = whole.size * stride / length
        shortest = length == NOISE_SETTINGS.lengths[-1]
        long_enough = shortest or whole.size * stride >= NOISE_SETTINGS.enough * count
        if spans >= (NOISE_SETTINGS.fewest_segments if shortest else NOISE_SETTINGS.segments) and long_enough:
            parts = np.lib.stride_tricks.sliding_window_view(values, length)[whole]
            power = hann_power(parts, 1.0)
            # Segments with a burst in them are left out.
            loud = power[:, _first(power) :].mean(axis=1)
            usual = float(np.median(loud))
            return power[loud <= NOISE_SETTINGS.loud * usual] if usual > 0 else power
    return None


def _first(power: Floats) -> int:
    """Return the first frequency that neither the slow part nor the window's width touches."""
    last = int(power.shape[1]) - 1
    return min(max(math.ceil(NOISE_SETTINGS.band * last), 1) + NOISE_SETTINGS.mixed, last - 1)


def _level_and_sigma(power: Floats) -> tuple[float, float]:
    """Return the white variance and its standard deviation, nT^2, from the segments' powers.

    The deviation is the jackknife's over groups of neighbouring segments.
    """
    groups = np.array_split(power, min(NOISE_SETTINGS.groups, max(2, power.shape[0] // 4)))
    sums = np.array([part.sum(axis=0) for part in groups])
    counts = np.array([part.shape[0] for part in groups], dtype=np.float64)
    total, number = sums.sum(axis=0), counts.sum()
    level = _white(total / number, number)
    without = np.array(
        [_white((total - one) / (number - n), number - n) for one, n in zip(sums, counts, strict=True)]
    )
    factor = (len(groups) - 1) / len(groups)
    return level, NOISE_SETTINGS.shared * float(np.sqrt(factor * np.sum((without - without.mean()) ** 2)))


def _white(power: Floats, segments: float) -> float:
    """Return the white part of a mean spectrum: what does not fall with the square of the frequency."""
    band = slice(_first(power[None]), power.size - 1)
    frequency = np.linspace(0.0, 1.0, power.size)[band]
    seen = power[band]
    usual = float(np.median(seen))
    model = np.full_like(seen, usual)
    if not usual > 0:
        return float(seen.mean())
    # A frequency may scatter by this much: half the overlapping segments count.
    most = 1.0 + NOISE_SETTINGS.lines / np.sqrt(max(0.5 * segments, 1.0))
    shapes = np.stack([np.ones_like(frequency), frequency**-2.0], axis=1)
    part = np.array([model[0], 0.0])
    for _ in range(4):
        kept = seen <= most * model
        part = np.linalg.lstsq(shapes[kept] / model[kept, None], seen[kept] / model[kept])[0]
        model = np.maximum(shapes @ part, 0.1 * usual)
    return max(float(part[0]), 0.0)


@dataclass(frozen=True, kw_only=True)
class ResidualStatistics:
    """Size of a residual, nT, over its finite samples."""

    count: int
    mean: float
    std: float
    rms: float
    robust: float
    least: float
    largest: float

    def as_json(self) -> dict[str, float | int]:
        """Return the fields by name."""
        return asdict(self)


#: The size of nothing.
NO_STATISTICS = ResidualStatistics(
    count=0,
    **dict.fromkeys(("mean", "std", "rms", "robust", "least", "largest"), float("nan")),
)


def above_floor(rms: float, floor: float) -> float:
    """Return the rms of what is in a residual beside its noise, nT; all of it where there is no floor."""
    return math.sqrt(max(rms**2 - floor**2, 0.0)) if math.isfinite(floor) else rms


def is_at_floor(rms: float, floor: float) -> bool:
    """Return True for a residual within five percent of its noise floor, nT; False where there is none."""
    return math.isfinite(floor) and rms <= AT_FLOOR * floor


def residual_statistics(residual: Floats) -> ResidualStatistics:
    """Return the size of a residual (time,) in nT; NaN are left out."""
    finite = residual[np.isfinite(residual)]
    if finite.size == 0:
        return NO_STATISTICS
    middle = np.median(finite)
    return ResidualStatistics(
        count=int(finite.size),
        mean=float(finite.mean()),
        std=float(finite.std()),
        rms=float(np.sqrt(np.mean(finite**2))),
        robust=float(MAD_TO_SIGMA * np.median(np.abs(finite - middle))),
        least=float(finite.min()),
        largest=float(finite.max()),
    )


def merge_statistics(sizes: Sequence[ResidualStatistics]) -> ResidualStatistics:
    """Return the size of several residuals together; the robust sigma is the median of theirs."""
    filled = [one for one in sizes if one.count]
    if not filled:
        return NO_STATISTICS
    count = np.array([one.count for one in filled], dtype=np.float64)
    mean = float(np.sum(count * [one.mean for one in filled]) / count.sum())
    square = float(np.sum(count * [one.rms**2 for one in filled]) / count.sum())
    # From the parts' own spreads: the square less the squared mean cancels where the mean is large.
    spread = float(np.sum(count * [one.std**2 + (one.mean - mean) ** 2 for one in filled]) / count.sum())
    return ResidualStatistics(
        count=int(count.sum()),
        mean=mean,
        std=float(np.sqrt(spread)),
        rms=float(np.sqrt(square)),
        robust=float(np.median([one.robust for one in filled])),
        least=min(one.least for one in filled),
        largest=max(one.largest for one in filled),
    )


@dataclass(frozen=True, kw_only=True)
class ParameterScatter:
    """Scatter of one parameter over the days that determine it by themselves.

    Attributes
    ----------
    std, sigma : float
        Standard deviation over the days, and the rms of their stated ones, in `unit`.
    ratio : float
        std / sigma: about 1 when the model is complete.
    sigma_ratio : float
        Standard deviation of the ratio if it were 1.
    days : int
        How many days.
    """

    name: str
    unit: str
    std: float
    sigma: float
    ratio: float
    sigma_ratio: float
    days: int

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


def daily_scatter(
    daily: xr.Dataset, start: int | None = None, end: int | None = None
) -> list[ParameterScatter]:
    """Return the scatter of each parameter of a daily calibration table.

    Parameters
    ----------
    daily : xarray.Dataset
        Table with dims interval, parameter: `value`, `sigma`, `determined`, `start`, `units`.
    start, end : int, optional
        Half-open TT2000 span of the intervals taken.

    Returns
    -------
    list of ParameterScatter
        In the table's order; NaN where fewer than three days determine a parameter.
    """
    begin = daily["start"].values
    inside = np.ones(begin.size, dtype=bool)
    inside &= begin >= start if start is not None else True
    inside &= begin < end if end is not None else True
    rows = own_estimates(daily.isel(interval=np.flatnonzero(inside)))
    found, nan = [], float("nan")
    for index in range(daily.sizes["parameter"]):
        one = rows.isel(parameter=index)
        known = one["determined"].values & np.isfinite(one["sigma"].values) & np.isfinite(one["value"].values)
        days = int(known.sum())
        std = sigma = ratio = error = nan
        if days >= NOISE_SETTINGS.fewest_days:
            std = float(np.std(one["value"].values[known], ddof=1))
            sigma = float(np.sqrt(np.mean(one["sigma"].values[known] ** 2)))
            ratio = std / sigma if sigma > 0 else nan
            error = float(1.0 / np.sqrt(2 * (days - 1)))
        found.append(
            ParameterScatter(
                name=str(one["parameter"].values),
                unit=str(one["units"].values) if "units" in one else "",
                std=std,
                sigma=sigma,
                ratio=ratio,
                sigma_ratio=error,
                days=days,
            )
        )
    return found


def own_estimates(daily: xr.Dataset) -> xr.Dataset:
    """Return a table with each interval's own estimates where it holds values that are kept from others.

    A table of a turning sensor has them as `own`, `own_sigma`: see `inflight.tasks.pipelines.spin.tables`.
    """
    if "own" not in daily:
        return daily
    estimated = np.isfinite(daily["own_sigma"].values)
    dims = daily["value"].dims
    return daily.assign(
        value=(dims, daily["own"].values),
        sigma=(dims, daily["own_sigma"].values),
        determined=(dims, estimated),
    )
