"""The paper's way to one set of parameters: the most accurate estimates, averaged, until nothing moves.

Estimates below a threshold of uncertainty are averaged (Plaschke et al. 2019, sections 5.2 to 5.5), pair by
pair: spin axis, gain ratio and azimuth, offsets, elevations. What a pair changes is passed on to the next by
the derivatives of its estimates; then the record is corrected anew and all is estimated again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.estimators.longrun import sigma_of_mean
from inflight.spin.equation import SPIN_RELATED, UNITS, TwelveParameters
from inflight.spin.estimates import PAIRS, SpinEstimates, estimate_pairs
from inflight.spin.layout import Bools, Layout
from inflight.spin.start import first_tones, next_tones
from inflight.time import Int64

Statistic = Literal["mean", "median"]
#: Uncertainties of a sensor never calibrated in flight: gains to 0.1 %, angles to 1 deg (Plaschke et al.
#: 2019, section 7), offsets unknown beside any field the sensor is flown for.
UNKNOWN: Mapping[str, float] = {
    name: 1e-3 if "gain" in name else 100.0 if UNITS[name] == "nT" else np.deg2rad(1.0)
    for name in SPIN_RELATED
}
#: A mean is made of at least this many estimates.
FEWEST = 5
#: Passes over the record, rounds over the pairs within one, and the change that ends them, in sigmas.
_PASSES, _ROUNDS, _SETTLED = 8, 20, 0.1


@dataclass(frozen=True)
class Selection:
    """One value of each of the eight parameters from selected estimates.

    Attributes
    ----------
    value, sigma : ndarray, shape (8,)
        Means in the order of `SPIN_RELATED`, the present value where nothing was selected. Sigma is theirs:
        natural fluctuations, overlap and memory of the estimates, uncertainty of the pairs held; infinite
        where nothing was selected.
    scatter : ndarray, shape (8,)
        Standard deviation of the selected estimates, the paper's "error".
    threshold : ndarray, shape (8,)
        Largest uncertainty selected.
    chosen : ndarray of bool, shape (sub, 8)
    how : tuple of 8 str
        How the threshold came about, or why nothing was selected.
    estimates : SpinEstimates
        Of the last pass.
    parameters : TwelveParameters
        With the values put in that are known better than the present ones.
    passes : int
    settled : bool
        True when the last pass changed nothing beyond a tenth of its sigma.
    """

    value: Floats
    sigma: Floats
    scatter: Floats
    threshold: Floats
    chosen: Bools
    how: tuple[str, ...]
    estimates: SpinEstimates
    parameters: TwelveParameters
    passes: int
    settled: bool

    @property
    def determined(self) -> Bools:
        """Which parameters the record told; (8,)."""
        return np.isfinite(self.sigma)

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `scatter`, `threshold`, `count` and `how` by ``parameter``."""
        one = "parameter"
        return xr.Dataset(
            {
                "value": (one, self.value),
                "sigma": (one, self.sigma),
                "scatter": (one, self.scatter),
                "threshold": (one, self.threshold),
                "count": (one, self.chosen.sum(axis=0)),
                "determined": (one, self.determined),
                "how": (one, list(self.how)),
            },
            coords={one: list(SPIN_RELATED), "units": (one, [UNITS[name] for name in SPIN_RELATED])},
            attrs={"passes": self.passes, "settled": int(self.settled)},
        )


def choose(uncertainty: Floats, wanted: float | None = None, fewest: int = FEWEST) -> tuple[Bools, str]:
    """Choose the estimates to average.

    Parameters
    ----------
    uncertainty : ndarray, shape (sub,)
        NaN for none.
    wanted : float, optional
        Estimates below it are chosen. When absent, as many of the best as make the expected error of their
        mean, ``sqrt(sum u^2) / k``, smallest.
    fewest : int

    Returns
    -------
    chosen : ndarray of bool, shape (sub,)
        None at all where fewer than `fewest` are good enough.
    how : str
    """
    known = np.where(np.isfinite(uncertainty) & (uncertainty > 0.0), uncertainty, np.inf)
    order = np.argsort(known, kind="stable")
    ranked = known[order]
    count = int(np.isfinite(ranked).sum())
    none = np.zeros(known.size, dtype=np.bool_)
    if count < fewest:
        return none, f"{count} estimates, at least {fewest} needed"
    if wanted is not None:
        chosen = known < wanted
        if chosen.sum() < fewest:
            return (
                none,
                f"{int(chosen.sum())} below {wanted:.3g}, at least {fewest} needed; best {ranked[0]:.2g}",
            )
        return chosen, f"{int(chosen.sum())} below the accuracy wanted, {wanted:.3g}"
    expected = np.sqrt(np.cumsum(ranked[:count] ** 2)) / np.arange(1, count + 1)
    best = fewest + int(np.argmin(expected[fewest - 1 :]))
    none[order[:best]] = True
    return none, f"best {best} of {count}, up to {ranked[best - 1]:.2g}: least expected error of the mean"


def calibrate_by_selection(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: Layout,
    present: TwelveParameters,
    present_sigma: Mapping[str, float] | None = None,
    *,
    wanted: Mapping[str, float] | None = None,
    statistic: Statistic = "mean",
) -> Selection:
    """Determine the eight parameters by selected estimates, corrected and estimated again until settled.

    Parameters
    ----------
    readings, phase, stamps, layout
        As for `spin_tones`.
    present : TwelveParameters
        Where to begin; what is not determined keeps its value.
    present_sigma : mapping of str to float, optional
        Uncertainties of the present values by name; `UNKNOWN` where absent. A parameter moves only where the
        selected estimates know it better.
    wanted : mapping of str to float, optional
        Accuracy of an estimate by name; automatic where absent (see `choose`).
    statistic : {"mean", "median"}

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    known = np.array([{**UNKNOWN, **(present_sigma or {})}[name] for name in SPIN_RELATED])
    if statistic not in ("mean", "median"):
        raise CalibrationError(f"no statistic is called '{statistic}'", remedy="take 'mean' or 'median'")
    held, scatter, parameters = known.copy(), known.copy(), present
    tones = first_tones(readings, phase, stamps, layout, present)
    settled, passes = False, 0
    while not settled and passes < _PASSES:
        if passes:
            tones = next_tones(readings, phase, stamps, layout, tones, parameters)
        passes += 1
        estimates = estimate_pairs(tones, _spread(scatter))
        found = _Rounds(estimates, known, held, scatter, wanted or {}, statistic)
        found.run()
        parameters, held, scatter = found.put_in(), found.held, found.scatter
        moved = parameters.spin_related() - tones.parameters.spin_related()
        settled = bool(np.all(np.abs(moved) <= _SETTLED * found.sigma))
    return Selection(
        found.mean,
        found.sigma,
        found.spread,
        found.threshold,
        found.chosen,
        tuple(found.how),
        estimates,
        parameters,
        passes,
        settled,
    )


def _spread(scatter: Floats) -> dict[str, float]:
    """Return the uncertainty of the pairs held that the published uncertainties need."""
    return {
        pair: float(max(scatter[SPIN_RELATED.index(name)] for name in names)) for pair, names in PAIRS.items()
    }


class _Rounds:
    """Rounds over the pairs on the estimates of one pass, the parameters moving by their derivatives."""

    def __init__(
        self,
        estimates: SpinEstimates,
        known: Floats,
        held: Floats,
        scatter: Floats,
        wanted: Mapping[str, float],
        statistic: Statistic,
    ) -> None:
        self.estimates, self.known, self.wanted, self.statistic = estimates, known, wanted, statistic
        self.held, self.scatter = held.copy(), scatter.copy()
        self.begin = estimates.parameters.spin_related()
        self.value = self.begin.copy()
        self.mean = self.value.copy()
        self.sigma = np.full(self.value.size, np.inf)
        self.spread = np.full(self.value.size, np.nan)
        self.threshold = np.full(self.value.size, np.nan)
        self.chosen = np.zeros(estimates.value.shape, dtype=np.bool_)
        self.how = [""] * self.value.size
        for at, name in enumerate(SPIN_RELATED):
            chosen, self.how[at] = choose(estimates.uncertainty[:, at], wanted.get(name))
            self.chosen[:, at] = chosen & estimates.usable
            if chosen.any():
                self.threshold[at] = float(estimates.uncertainty[chosen, at].max())

    def run(self) -> None:
        """Go round until no pair moves another."""
        for _ in range(_ROUNDS):
            before = self.value.copy()
            for names in PAIRS.values():
                for at in [SPIN_RELATED.index(name) for name in names]:
                    self._average(at)
            if np.all(np.abs(self.value - before) <= 0.01 * np.minimum(self.sigma, self.known)):
                break

    def _average(self, at: int) -> None:
        """Average the chosen estimates of one parameter, moved to where the others are now."""
        chosen = self.chosen[:, at]
        if not chosen.any():
            return
        slopes = self.estimates.sensitivity[chosen, at]
        values = self.estimates.value[chosen, at] + slopes @ (self.value - self.begin)
        middle = float(np.median(values) if self.statistic == "median" else values.mean())
        common = float(np.sqrt(np.sum((slopes.mean(axis=0) * self.held) ** 2)))
        own = self._own_sigma(np.flatnonzero(chosen), at, values)
        sigma = float(np.hypot(own, common))
        self.mean[at], self.sigma[at], self.spread[at] = middle, sigma, float(values.std(ddof=1))
        if sigma < self.known[at]:
            self.value[at], self.held[at] = middle, sigma
            self.scatter[at] = max(self.spread[at], sigma)

    def _own_sigma(self, where: npt.NDArray[np.intp], at: int, values: Floats) -> float:
        """Return the sigma of the mean by fluctuations: of sub-intervals that overlap and may remember."""
        own = np.zeros(len(self.chosen))
        own[where] = self.estimates.sigma[where, at]
        total = float(np.sum(own**2))
        for apart in range(1, min(self.estimates.blocks, own.size)):
            total += 2.0 * (1.0 - apart / self.estimates.blocks) * float(np.sum(own[apart:] * own[:-apart]))
        sigma = max(np.sqrt(total) / where.size, sigma_of_mean(values))
        # The median of Gaussian numbers scatters by more than their mean.
        return float(sigma * (np.sqrt(0.5 * np.pi) if self.statistic == "median" else 1.0))

    def put_in(self) -> TwelveParameters:
        """Return the parameters with the values found."""
        return self.estimates.parameters.changed(
            {name: float(self.value[at]) for at, name in enumerate(SPIN_RELATED)}
        )
