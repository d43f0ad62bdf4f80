"""What a comparison keeps of days: means of short spans, sizes, histograms, spectra; one block at a time.

In go the products of days and the archive behind them, out comes a `BlockDigest`: small, and a function of
these days only, so that the catalog can keep it (`kept_digests`). No figures are imported here: Dask
processes run it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.design import BIN_SETTINGS
from inflight.flags import UNUSABLE, Flag
from inflight.frames import direction_of
from inflight.lsq import MAD_TO_SIGMA
from inflight.mission import Mission
from inflight.residual import (
    SERIES,
    NoiseFloor,
    ResidualStatistics,
    SpectrumSum,
    add_power,
    as_drawn,
    noise_floor,
    residual_statistics,
    stretch_power,
)
from inflight.tasks.pipelines.base import Sources, Spans, rows_of_day
from inflight.time import DAY, SECOND, Int64, usual_step

if TYPE_CHECKING:
    import xarray as xr

#: Raised by hand when the numbers of a digest change; it is part of the key of what is kept.
DIGEST_VERSION = 3

#: What is read of a product.
_VARIABLES = ("residual_preflight", "residual", "flag", "field_sensor")

#: Powers of two, in nT, of the least width of a histogram's bins, and beyond which values are not drawn.
_LEAST_WIDTH, _FARTHEST = -18, 17

#: Bins of one width for each power of two, as a power of two: what is drawn has at most 128 on either side.
_BINS = 6

Power = dict[tuple[int, float], SpectrumSum]


@dataclass(frozen=True)
class DayNumbers:
    """Numbers of one day: sizes before and after, the noise floor, samples left out, outliers, rows.

    `clear` is the rms after calibration without outliers, nT, and `samples` how many those are.
    """

    before: ResidualStatistics
    after: ResidualStatistics
    floor: NoiseFloor
    clear: float
    samples: int
    skipped: int
    outliers: int
    rows: int

    def as_list(self) -> list[float]:
        """Return all of it as numbers in one order."""
        parts = (one for part in (self.before, self.after, self.floor) for one in vars(part).values())
        counts = (self.samples, self.skipped, self.outliers, self.rows)
        return [*map(float, parts), self.clear, *map(float, counts)]

    @classmethod
    def of_list(cls, values: Sequence[float]) -> DayNumbers:
        """Return what `as_list` gave the numbers of."""
        names = [one.name for one in fields(ResidualStatistics)][1:]
        size = 1 + len(names)
        before, after = (
            ResidualStatistics(count=int(part[0]), **dict(zip(names, part[1:], strict=True)))
            for part in (values[:size], values[size : 2 * size])
        )
        level, low, high, whites, clear, *counts = values[2 * size :]
        return cls(before, after, NoiseFloor(level, low, high, int(whites)), clear, *map(int, counts))


@dataclass(frozen=True)
class BlockDigest:
    """What is kept of the products of some days.

    Attributes
    ----------
    rows : dict of str to ndarray, shape (row,)
        Means over short spans, as `rows_of_day`, of all days.
    days : list of DayNumbers
    power_before, power : dict
        Sums of the days' spectra by the length of their stretches; before only as fine as it is drawn.
    counts : ndarray of int64, shape (2, bin)
        Histograms before and after, each about its day's mean; bins as `bins_of`.
    """

    rows: dict[str, Floats]
    days: list[DayNumbers]
    power_before: Power
    power: Power
    counts: Int64

    def as_dataset(self) -> xr.Dataset:
        """Return it as arrays with one block each, as the catalog stores them."""
        import xarray as xr

        spectra = {"before": self.power_before, "after": self.power}
        grids = {
            name: [
                [one.step, one.frequency.size, one.stretches, one.square.tolist()] for one in power.values()
            ]
            for name, power in spectra.items()
        }
        arrays = {
            "rows": (("block", "column", "row"), np.stack(list(self.rows.values()))),
            "days": (("block", "day", "number"), np.array([one.as_list() for one in self.days])),
            "counts": (("block", "state", "bin"), self.counts),
        }
        for name, power in spectra.items():
            joined = [one.total for one in power.values()] or [np.zeros((len(SERIES), 0))]
            arrays[f"power_{name}"] = (
                ("block", "series", f"frequency_{name}"),
                np.concatenate(joined, axis=1),
            )
        return xr.Dataset(
            {name: (dims, values[None]) for name, (dims, values) in arrays.items()},
            attrs={"columns": list(self.rows), "grids": grids},
        )

    @classmethod
    def of_dataset(cls, kept: xr.Dataset) -> BlockDigest:
        """Return what `as_dataset` made."""
        spectra: dict[str, Power] = {}
        for name, grids in kept.attrs["grids"].items():
            spectra[name], begin, total = {}, 0, kept[f"power_{name}"].values[0]
            for step, size, stretches, square in grids:
                # As numpy makes them: whole multiples of the first one.
                frequency = np.arange(1, size + 1) * step
                part = SpectrumSum(frequency, total[:, begin : begin + size], stretches, np.array(square))
                add_power(spectra[name], part)
                begin += size
        return cls(
            dict(zip(kept.attrs["columns"], kept["rows"].values[0], strict=True)),
            [DayNumbers.of_list(one) for one in kept["days"].values[0].tolist()],
            spectra["before"],
            spectra["after"],
            kept["counts"].values[0],
        )


def digest_block(
    cat: Catalog, mission: Mission, comparison: str, sources: Sources, days: Sequence[Day], length: float
) -> BlockDigest:
    """Read the products of days one after the other and return what is kept of them.

    Parameters
    ----------
    sources : Sources
        Archive days behind them.
    length : float
        Of the short spans, s.
    """
    rows: list[Mapping[str, Floats]] = []
    numbers: list[DayNumbers] = []
    power_before: Power = {}
    power: Power = {}
    counts = np.zeros((2, bin_edges().size - 1), dtype=np.int64)
    for day in days:
        product = cat.read(day, _VARIABLES, with_time=False)
        stamps, flag = np.asarray(product["tt2000"].values, dtype=np.int64), product["flag"].values
        good = (flag & np.uint32(UNUSABLE)) == 0
        states = [np.where(good, product[name].values, np.nan) for name in _VARIABLES[:2]]
        sizes = [residual_statistics(values) for values in states]
        counts += [
            count_bins(values[np.isfinite(values)] - size.mean)
            for values, size in zip(states, sizes, strict=True)
        ]
        # Outliers belong to the size of the residual, but would hide its structure.
        clear = ~((flag & np.uint32(Flag.OUTLIER)).astype(bool) & _is_far(states[1]))
        before, after = (np.where(clear, values, np.nan) for values in states)
        direction = direction_of(product["field_sensor"].values)
        floor = _add_spectra(stamps, (before, after), direction, (power_before, power))
        spans = Spans.of(stamps, length)
        rows.append(rows_of_day(cat, mission, comparison, sources, product, before, after, spans))
        kept = after[np.isfinite(after)]
        counted = kept.size, int((~good).sum()), int((good & ~clear).sum()), int(rows[-1]["tt2000"].size)
        rms = float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0
        numbers.append(DayNumbers(sizes[0], sizes[1], floor, rms, *counted))
    for one in power_before.values():
        one.total = as_drawn(one.total)
    joined = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    return BlockDigest(joined, numbers, power_before, power, counts)


def _is_far(residual: Floats) -> npt.NDArray[np.bool_]:
    """Return which values stand out of a day's as far as what a search leaves out as spikes.

    A fit lays aside more, the tails of the noise with it: without these, residual and noise floor would be
    smaller here than where the model is searched.
    """
    known = residual[np.isfinite(residual)]
    if not known.size:
        return np.zeros(residual.shape, dtype=bool)
    away = np.abs(residual - np.median(known))
    return np.asarray(away > BIN_SETTINGS.spike * MAD_TO_SIGMA * np.nanmedian(away))


def _add_spectra(
    stamps: Int64, states: tuple[Floats, Floats], direction: Floats, sums: tuple[Power, Power]
) -> NoiseFloor:
    """Add a day's spectra before and after to the sums, and return its noise floor after.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    states : tuple of ndarray, shape (time,)
        Residual before and after, nT; NaN where it is not to be used, which makes gaps of missing rows.
    direction : ndarray, shape (time, 3)
        Of the field.
    """
    step = usual_step(stamps, SECOND)
    slot = np.round((stamps - stamps[0]) / step).astype(np.int64)
    # One row a series: what follows goes along time.
    grid = np.full((5, int(slot[-1]) + 1), np.nan)
    grid[:, slot] = [*states, *direction.T]
    cadence = step / SECOND
    # Only whole days share their frequencies: a day with a leap second, or begun late, is cut or padded.
    whole = np.full((5, max(DAY // step, 1)), np.nan)
    count = min(whole.shape[1], grid.shape[1])
    whole[:, :count] = grid[:, :count]
    for power, residual in zip(sums, whole[:2], strict=True):
        add_power(power, stretch_power(residual, whole[2:].T, cadence))
    return noise_floor(grid[1], cadence)


def bin_edges() -> Floats:
    """Return the lower edges of the magnitudes' bins and the last upper one, nT.

    The bins of each power of two are of one width, so that those of any wider power of two are sums of them,
    whatever the residual of other days: a day's histogram depends on the day only.
    """
    octaves = np.arange(_LEAST_WIDTH + _BINS, _FARTHEST)
    part = np.arange(2**_BINS) / 2**_BINS
    inner = part * 2.0 ** (_LEAST_WIDTH + _BINS)
    outer = (2.0**octaves)[:, None] * (1.0 + part)
    magnitude = np.concatenate([inner, outer.ravel(), [2.0**_FARTHEST]])
    return np.concatenate([-magnitude[:0:-1], magnitude])


def count_bins(values: Floats) -> Int64:
    """Return how many values, nT, lie in each bin of `bin_edges`; far ones are not counted."""
    half, magnitude = (bin_edges().size - 1) // 2, np.abs(values)
    # Of a magnitude f * 2**e with f from a half to one: the octave's number, and the place in it.
    part, octave = np.frexp(magnitude)
    octave = octave.astype(np.int64) - (_LEAST_WIDTH + _BINS + 1)
    place = (2 ** (_BINS + 1) * part).astype(np.int64) + octave * 2**_BINS
    small = magnitude < 2.0 ** (_LEAST_WIDTH + _BINS)
    place[small] = magnitude[small] * 2.0**-_LEAST_WIDTH
    place = np.where(values < 0, half - 1 - place, half + place)
    return np.bincount(place[(place >= 0) & (place < 2 * half)], minlength=2 * half)


def drawn_histogram(counts: Int64, half_width: float, bins: int) -> tuple[Floats, Floats]:
    """Return edges, nT, and counts (..., bin) of at most so many bins of one width over +- `half_width`."""
    width = float(2.0 ** np.ceil(np.log2(2.0 * half_width / bins)))
    reach = int(np.ceil(half_width / width))
    middle = 0.5 * (bin_edges()[:-1] + bin_edges()[1:])
    place = np.floor(middle / width).astype(np.int64) + reach
    shown = (place >= 0) & (place < 2 * reach)
    out = np.stack([np.bincount(place[shown], row[shown], 2 * reach) for row in counts]).astype(np.float64)
    return np.arange(-reach, reach + 1, dtype=np.float64) * width, out
