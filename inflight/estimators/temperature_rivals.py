"""Which temperature it is that the scale factors follow, if any: judged on blocks that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.equations import NormalEquations
from inflight.estimators.clusters import mean_of_clusters
from inflight.estimators.coil_temperature import PRIOR, coefficients_of, left_of_each, solved
from inflight.estimators.rows import NINE

#: A rival is no worse than the best while it is within this many sigmas of it.
_TIE = 2.0


@dataclass(frozen=True)
class TemperatureRival:
    """A temperature judged on blocks that were not fitted; `score` is the rms left, nT."""

    channel: str
    score: float
    behind: float
    behind_sigma: float

    @property
    def ties(self) -> bool:
        """True when held-out blocks do not tell it from the best."""
        return self.behind <= _TIE * self.behind_sigma


@dataclass(frozen=True)
class TemperatureChoice:
    """Temperatures, and none, on held-out blocks; the best first."""

    rivals: tuple[TemperatureRival, ...]

    @classmethod
    def of_table(cls, table: xr.Dataset) -> TemperatureChoice:
        """Return the choice that a table was made of."""
        rows = zip(
            *(table[name].values.tolist() for name in ("channel", "value", "behind", "sigma")), strict=True
        )
        return cls(tuple(TemperatureRival(*row) for row in rows))

    def told(self) -> str:
        """Say which is best, and which are tied with it."""
        best, *others = self.rivals
        ties = [one.channel for one in others if one.ties]
        worse = [
            f"{one.channel} ({one.behind / one.behind_sigma:.1f} sigma)" for one in others if not one.ties
        ]
        told = f"{best.channel} leaves least of held-out blocks"
        told += f"; tied with it: {', '.join(ties)}" if ties else ""
        return told + (f"; worse: {', '.join(worse)}" if worse else "")

    def table(self) -> xr.Dataset:
        """Return the scores: dim channel."""
        rows = self.rivals
        return xr.Dataset(
            {
                "value": ("channel", np.array([one.score for one in rows]), {"units": "nT"}),
                "behind": ("channel", np.array([one.behind for one in rows]), {"units": "nT2"}),
                "sigma": ("channel", np.array([one.behind_sigma for one in rows]), {"units": "nT2"}),
                "tied": ("channel", np.array([one.ties for one in rows])),
            },
            coords={"channel": [one.channel for one in rows]},
            attrs={"told": self.told()},
        )


#: The rival that has no temperature at all.
NONE = "none"


def compare_temperatures(
    equations: NormalEquations,
    channels: Sequence[str],
    *,
    folds: int = 5,
    each: Sequence[str] = NINE,
    prior: tuple[float, float, float] = PRIOR,
) -> TemperatureChoice:
    """Judge temperatures, and none, by what they leave of contiguous blocks that were not fitted.

    Parameters
    ----------
    equations : NormalEquations
        With the columns of every channel, each at a lag of its own.
    channels : sequence of str
    folds : int
        Contiguous parts of the span.
    each, prior
        As for `fit_coil`; the columns of `each` are fitted in held-out blocks too, alike for all rivals.

    Raises
    ------
    CalibrationError
        When training blocks are fewer than five.
    """
    squares: dict[str, Floats] = {}
    count = np.asarray(equations.dataset["count"].values, dtype=np.float64)
    for channel in channels:
        gram, rows = left_of_each(equations, channel, each)
        squares.setdefault(NONE, gram[:, -1, -1] / rows)
        squares[channel] = _held_out(gram, rows, channel, folds, prior) / rows
    which = np.arange(len(count))
    whole = {name: float(np.average(one, weights=count)) for name, one in squares.items()}
    best = min(whole, key=lambda name: whole[name])
    rivals = []
    for name in sorted(whole, key=lambda name: whole[name]):
        behind, sigma = mean_of_clusters(squares[name] - squares[best], count, which)
        rivals.append(TemperatureRival(name, float(np.sqrt(whole[name])), behind, sigma))
    return TemperatureChoice(tuple(rivals))


def _held_out(
    gram: Floats, count: Floats, channel: str, folds: int, prior: tuple[float, float, float]
) -> Floats:
    """Return the sum of squares of each block at the fit of the other folds; (block,) nT^2."""
    out = np.empty(len(gram))
    for part in np.array_split(np.arange(len(gram)), folds):
        rest = np.delete(np.arange(len(gram)), part)
        fit = solved(gram[rest], count[rest], channel, 0.0, 0.0, prior).fit
        at = np.append(coefficients_of(fit.value)[0], 1.0)
        out[part] = np.einsum("i,bij,j->b", at, gram[part], at)
    return out
