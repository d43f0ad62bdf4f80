"""The eight spin-related parameters (Plaschke et al. 2019): from each sub-interval, selected, joint, refined.

Takes: readings, spin phase, times and blocks of a record, with the parameters in use. Makes:

- `estimate_pairs`: `SpinEstimates`, every sub-interval's own estimates with their uncertainties. Four pairs
  follow one after the other (section 5): the spin axis from the spin tone of Bz; gain ratio and azimuth from
  the modulus at twice the spin; from the modulus at the spin either the spin-plane offsets or the elevations.
  That tone is ``O + Ba (sP - dth)`` (eq. 21, which needs ``By = -Bp sin wt``): the axial field Ba decides
  which of the two a sub-interval determines.
- `calibrate_by_selection`: `Selection`, the paper's way: estimates below a threshold of uncertainty are
  averaged (sections 5.2 to 5.5), pair by pair; what a pair changes is passed on to the next by the
  derivatives of its estimates; then the record is corrected anew and all is estimated again, until nothing
  moves.
- `estimate_jointly`: `JointEstimate`, all eight from all sub-intervals at once, each weighted by its own
  noise. Sub-intervals of different Ba separate offsets from elevations in one linear system; what they cannot
  separate is in the covariance. Nothing is selected; outlying tones are down-weighted.
- `fit_folded_samples`: `SpinFit`, the same parameters of a `Model`, fitted to folded samples by robust
  weighted least squares with everything else of the model held.

The uncertainties are those of table 2, with the *least* modulus for gain ratio and azimuth, the *largest*
size of Bz for the offsets and the *least* for the elevations; in white noise they are 1.7 standard
deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects import SpinningSensor
from inflight.errors import CalibrationError
from inflight.lsq import biweight, biweight_slope, long_run_covariance, sigma_of_mean
from inflight.model import Model, ModelEffect, rows_of
from inflight.spin.equation import PARAMETER_NAMES, PARAMETER_UNITS, SPIN_RELATED, CalibrationParameters
from inflight.spin.intervals import BlockLayout, Bools
from inflight.spin.kernels import SERIES
from inflight.spin.tones import SpinTones, initial_tones, updated_tones
from inflight.time import Int64

#: The pairs in the order they are determined in, and for each which tones show it.
PAIRS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "spin axis": ("spin_axis[x]", "spin_axis[y]"),
        "gain ratio and azimuth": ("gain_ratio", "azimuth"),
        "offsets": ("offset[1]", "offset[2]"),
        "elevations": ("elevation[1]", "elevation[2]"),
    }
)

#: Rows of the equations of a sub-interval: Bz and modulus at the spin, modulus at twice the spin.
_ROWS = {"spin axis": slice(0, 2), "gain ratio and azimuth": slice(4, 6)}

_SPIN_ROWS = slice(2, 4)

#: Step of the derivative of the coupling matrix; its error is of second order.
_STEP = 1e-6


@dataclass(frozen=True)
class SpinEquations:
    """Linear equations of the tones of every sub-interval: ``residual + design @ change = 0``.

    Attributes
    ----------
    residual : ndarray, shape (sub, 6)
        cos and sin of Bz at the spin, of the modulus at the spin, of the modulus at twice the spin; nT.
    design : ndarray, shape (sub, 6, 8)
        Derivatives by `SPIN_RELATED`.
    noise : ndarray, shape (sub, 6)
        Standard deviation of the residual by natural fluctuations, nT.
    """

    residual: Floats
    design: Floats
    noise: Floats


@dataclass(frozen=True, kw_only=True)
class SpinEstimates:
    """Estimates of the eight parameters from single sub-intervals.

    Attributes
    ----------
    start, end : ndarray of int64, shape (sub,)
        TT2000.
    value : ndarray, shape (sub, 8)
        In the order of `SPIN_RELATED`; NaN where a sub-interval gives none.
    sigma : ndarray, shape (sub, 8)
        Standard deviation by natural fluctuations alone, the other pairs held.
    uncertainty : ndarray, shape (sub, 8)
        As published (table 2): the larger neighbouring amplitude over the field, with what the uncertainty of
        the other pairs adds. 1.7 times `sigma` in white noise.
    sensitivity : ndarray, shape (sub, 8, 8)
        By how much an estimate moves where a parameter held is raised by 1; 0 within a pair.
    usable : ndarray of bool, shape (sub,)
    parameters : CalibrationParameters
        Held while these were made.
    spread : mapping of str to float
        Uncertainty of spin axis, offsets and elevations that went into `uncertainty`.
    blocks : int
        As in `SpinTones`.
    """

    start: Int64
    end: Int64
    value: Floats
    sigma: Floats
    uncertainty: Floats
    sensitivity: Floats
    usable: Bools
    parameters: CalibrationParameters
    spread: Mapping[str, float]
    blocks: int

    def of(self, name: str) -> tuple[Floats, Floats]:
        """Return values and published uncertainties (sub,) of one parameter."""
        at = SPIN_RELATED.index(name)
        return self.value[:, at], self.uncertainty[:, at]


def spin_equations(tones: SpinTones) -> SpinEquations:
    """Return the linear equations of every sub-interval at the parameters of its tones.

    Derivatives are those of the exact equation (9): with ``B = C (R - O)``, ``dB/dp = (dC/dp) C^-1 B`` and
    ``dB/dO = -C``; the modulus changes by ``u dBx + v dBy``.
    """
    place = {name: index for index, name in enumerate(SERIES)}
    # Derivatives of Bz and of the modulus as sums of `SERIES`: (8, series).
    axial, plane = np.zeros((2, len(SPIN_RELATED), len(SERIES)))
    parameters, matrix = tones.parameters, tones.parameters.matrix()
    for row, name in enumerate(SPIN_RELATED):
        if name.startswith("offset"):
            column = matrix[:, PARAMETER_NAMES.index(name) - PARAMETER_NAMES.index("offset[1]")]
            plane[row, [place["u"], place["v"]]] = -column[:2]
            continue
        value = parameters.values()[PARAMETER_NAMES.index(name)]
        up, down = (parameters.changed({name: value + way * _STEP}).matrix() for way in (1.0, -1.0))
        turn = (up - down) / (2.0 * _STEP) @ np.linalg.inv(matrix)
        axial[row, :3] = turn[2]
        # u By = v Bx, and v By = m - u Bx.
        plane[row, place["xu"]] = turn[0, 0] - turn[1, 1]
        plane[row, place["m"]] = turn[1, 1]
        plane[row, place["xv"]] = turn[0, 1] + turn[1, 0]
        plane[row, [place["zu"], place["zv"]]] = turn[0, 2], turn[1, 2]
    first, second = tones.tones[:, :2], tones.tones[:, 2:]
    z, m = place["z"], place["m"]
    residual = np.concatenate([first[..., z], first[..., m], second[..., m]], axis=1)
    design = np.concatenate([first @ axial.T, first @ plane.T, second @ plane.T], axis=1)
    return SpinEquations(residual, design, np.repeat(tones.noise, 2, axis=1))


def estimate_pairs(tones: SpinTones, spread: Mapping[str, float]) -> SpinEstimates:
    """Return the estimates of each pair from each sub-interval, the others held.

    Parameters
    ----------
    tones : SpinTones
    spread : mapping of str to float
        Uncertainty of the pairs ``spin axis`` and ``elevations`` (rad) and ``offsets`` (nT) held.
    """
    equations = spin_equations(tones)
    count = tones.start.size
    value, sigma = (np.full((count, len(SPIN_RELATED)), np.nan) for _ in range(2))
    sensitivity = np.zeros((count, len(SPIN_RELATED), len(SPIN_RELATED)))
    present = tones.parameters.spin_related()
    for pair, names in PAIRS.items():
        rows = _ROWS.get(pair, _SPIN_ROWS)
        columns = [SPIN_RELATED.index(name) for name in names]
        design = equations.design[:, rows, columns]
        size = np.linalg.norm(design, axis=(1, 2))
        known = np.isfinite(size) & (np.abs(np.linalg.det(np.nan_to_num(design))) > 1e-6 * size**2)
        inverse = np.linalg.inv(np.where(known[:, None, None], design, np.eye(2)))
        inverse[~known] = np.nan
        value[:, columns] = present[columns] - np.einsum("sij,sj->si", inverse, equations.residual[:, rows])
        variance = np.einsum("sij,sj->si", inverse**2, equations.noise[:, rows] ** 2)
        sigma[:, columns] = np.sqrt(variance)
        slopes = -inverse @ equations.design[:, rows]
        slopes[:, :, columns] = 0.0
        sensitivity[:, columns] = slopes
    lost = ~tones.usable
    value[lost], sigma[lost] = np.nan, np.nan
    return SpinEstimates(
        start=tones.start,
        end=tones.end,
        value=value,
        sigma=sigma,
        uncertainty=published_uncertainty(tones, spread),
        sensitivity=sensitivity,
        usable=tones.usable & np.isfinite(value).all(axis=1),
        parameters=tones.parameters,
        spread=MappingProxyType(dict(spread)),
        blocks=tones.blocks,
    )


def published_uncertainty(tones: SpinTones, spread: Mapping[str, float]) -> Floats:
    """Return the uncertainties of table 2 of Plaschke et al. (2019); (sub, 8).

    ``Fa/Bp``, ``F2p/Bp``, ``2 F2p/Bp`` with the least modulus, ``Fp + Ba (dsigma + dth)`` with the largest
    and ``(Fp + dO)/Ba + dsigma`` with the least size of Bz.
    """
    axial, spin, double = tones.amplitude.T
    least = np.maximum(tones.least_modulus, 1e-12)
    angle = spread["spin axis"]
    offset = spin + tones.largest_axial * (angle + spread["elevations"])
    elevation = (spin + spread["offsets"]) / np.maximum(tones.least_axial, 1e-12) + angle
    by_name = {"gain_ratio": double / least, "azimuth": 2.0 * double / least}
    by_name |= {f"spin_axis[{axis}]": axial / least for axis in "xy"}
    by_name |= {f"offset[{axis}]": offset for axis in "12"}
    by_name |= {f"elevation[{axis}]": elevation for axis in "12"}
    found = np.stack([by_name[name] for name in SPIN_RELATED], axis=1)
    found[~tones.usable] = np.nan
    return found


Statistic = Literal["mean", "median"]

#: Uncertainties of a sensor never calibrated in flight: gains to 0.1 %, angles to 1 deg (Plaschke et al.
#: 2019, section 7), offsets unknown against any field the sensor is flown for.
UNCALIBRATED_SIGMA: Mapping[str, float] = {
    name: 1e-3 if "gain" in name else 100.0 if PARAMETER_UNITS[name] == "nT" else np.deg2rad(1.0)
    for name in SPIN_RELATED
}


@dataclass(frozen=True, kw_only=True)
class SelectionSettings:
    """Numbers of the selection of estimates.

    Attributes
    ----------
    fewest : int
        A mean is made of at least this many estimates. Assumed.
    passes, rounds : int
        Most passes over the record, and rounds over the pairs within one. Assumed.
    settled : float
        A pass that changes every value by less than this many sigmas is the last. Assumed.
    """

    fewest: int = 5
    passes: int = 8
    rounds: int = 20
    settled: float = 0.1


SELECTION_SETTINGS = SelectionSettings()


@dataclass(frozen=True, kw_only=True)
class Selection:
    """One value of each of the eight parameters from selected estimates.

    Attributes
    ----------
    value, sigma : ndarray, shape (8,)
        Means in the order of `SPIN_RELATED`, the present value where nothing was selected. Sigma is theirs:
        natural fluctuations, overlap and correlation in time of the estimates, uncertainty of the pairs held;
        infinite where nothing was selected.
    scatter : ndarray, shape (8,)
        Standard deviation of the selected estimates, the paper's "error".
    threshold : ndarray, shape (8,)
        Largest uncertainty selected.
    chosen : ndarray of bool, shape (sub, 8)
    reasons : tuple of 8 str
        How the threshold came about, or why nothing was selected.
    estimates : SpinEstimates
        Of the last pass.
    parameters : CalibrationParameters
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
    reasons: tuple[str, ...]
    estimates: SpinEstimates
    parameters: CalibrationParameters
    passes: int
    settled: bool

    @property
    def determined(self) -> Bools:
        """Parameters that the record determines; (8,)."""
        return np.isfinite(self.sigma)


def choose_estimates(
    uncertainty: Floats, accuracy: float | None = None, fewest: int = SELECTION_SETTINGS.fewest
) -> tuple[Bools, str]:
    """Choose the estimates to average.

    Parameters
    ----------
    uncertainty : ndarray, shape (sub,)
        NaN for none.
    accuracy : float, optional
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
    if accuracy is not None:
        chosen = known < accuracy
        if chosen.sum() < fewest:
            return (
                none,
                f"{int(chosen.sum())} below {accuracy:.3g}, at least {fewest} needed; best {ranked[0]:.2g}",
            )
        return chosen, f"{int(chosen.sum())} below the accuracy wanted, {accuracy:.3g}"
    expected = np.sqrt(np.cumsum(ranked[:count] ** 2)) / np.arange(1, count + 1)
    best = fewest + int(np.argmin(expected[fewest - 1 :]))
    none[order[:best]] = True
    return none, f"best {best} of {count}, up to {ranked[best - 1]:.2g}: least expected error of the mean"


def calibrate_by_selection(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: BlockLayout,
    present: CalibrationParameters,
    present_sigma: Mapping[str, float] | None = None,
    *,
    accuracy: Mapping[str, float] | None = None,
    statistic: Statistic = "mean",
) -> Selection:
    """Determine the eight parameters by selected estimates, corrected and estimated again until settled.

    Parameters
    ----------
    readings, phase, stamps, layout
        As for `measure_tones`.
    present : CalibrationParameters
        Where to begin; what is not determined keeps its value.
    present_sigma : mapping of str to float, optional
        Uncertainties of the present values by name; `UNCALIBRATED_SIGMA` where absent. A parameter moves only
        where the selected estimates know it better.
    accuracy : mapping of str to float, optional
        Accuracy of an estimate by name; automatic where absent (see `choose_estimates`).
    statistic : {"mean", "median"}

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    known = np.array([{**UNCALIBRATED_SIGMA, **(present_sigma or {})}[name] for name in SPIN_RELATED])
    if statistic not in ("mean", "median"):
        raise CalibrationError(f"no statistic is called '{statistic}'", remedy="take 'mean' or 'median'")
    held, scatter, parameters = known.copy(), known.copy(), present
    tones = initial_tones(readings, phase, stamps, layout, present)
    settled, passes = False, 0
    while not settled and passes < SELECTION_SETTINGS.passes:
        if passes:
            tones = updated_tones(readings, phase, stamps, layout, tones, parameters)
        passes += 1
        estimates = estimate_pairs(tones, uncertainty_of_pairs(scatter))
        found = _PairwiseAverages(estimates, known, held, scatter, accuracy or {}, statistic)
        found.run()
        parameters, held, scatter = found.parameters(), found.held, found.scatter
        moved = parameters.spin_related() - tones.parameters.spin_related()
        settled = bool(np.all(np.abs(moved) <= SELECTION_SETTINGS.settled * found.sigma))
    return Selection(
        value=found.mean,
        sigma=found.sigma,
        scatter=found.spread,
        threshold=found.threshold,
        chosen=found.chosen,
        reasons=tuple(found.reasons),
        estimates=estimates,
        parameters=parameters,
        passes=passes,
        settled=settled,
    )


def variability_of_selected(estimates: SpinEstimates, known: Floats) -> Floats:
    """Return the standard deviation of the estimates that `choose_estimates` selects; (8,).

    This is the uncertainty of a parameter that is held while others are estimated (Plaschke et al. 2019,
    sections 5.4 and 5.5): what single sub-intervals scatter by, not the error of their mean. `known` (8,)
    where nothing is selected.
    """
    out = known.copy()
    for at in range(out.size):
        chosen, _ = choose_estimates(
            np.where(np.isfinite(estimates.value[:, at]), estimates.uncertainty[:, at], np.nan)
        )
        if chosen.any():
            out[at] = float(estimates.value[chosen, at].std(ddof=1))
    return out


def uncertainty_of_pairs(scatter: Floats) -> dict[str, float]:
    """Return the uncertainty of the pairs held that the published uncertainties need."""
    return {
        pair: float(max(scatter[SPIN_RELATED.index(name)] for name in names)) for pair, names in PAIRS.items()
    }


class _PairwiseAverages:
    """Rounds over the pairs on the estimates of one pass, the parameters moving by their derivatives."""

    def __init__(
        self,
        estimates: SpinEstimates,
        known: Floats,
        held: Floats,
        scatter: Floats,
        accuracy: Mapping[str, float],
        statistic: Statistic,
    ) -> None:
        self.estimates, self.known, self.accuracy, self.statistic = estimates, known, accuracy, statistic
        self.held, self.scatter = held.copy(), scatter.copy()
        self.begin = estimates.parameters.spin_related()
        self.value = self.begin.copy()
        self.mean = self.value.copy()
        self.sigma = np.full(self.value.size, np.inf)
        self.spread = np.full(self.value.size, np.nan)
        self.threshold = np.full(self.value.size, np.nan)
        self.chosen = np.zeros(estimates.value.shape, dtype=np.bool_)
        self.reasons = [""] * self.value.size
        for at, name in enumerate(SPIN_RELATED):
            chosen, self.reasons[at] = choose_estimates(estimates.uncertainty[:, at], accuracy.get(name))
            self.chosen[:, at] = chosen & estimates.usable
            if chosen.any():
                self.threshold[at] = float(estimates.uncertainty[chosen, at].max())

    def run(self) -> None:
        """Average pair after pair until no pair moves another."""
        for _ in range(SELECTION_SETTINGS.rounds):
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
        # Natural fluctuations of the mean; sub-intervals overlap and may be correlated.
        alone, blocks = np.where(chosen, self.estimates.sigma[:, at], 0.0), self.estimates.blocks
        total = float(np.sum(alone**2))
        for apart in range(1, min(blocks, alone.size)):
            total += 2.0 * (1.0 - apart / blocks) * float(np.sum(alone[apart:] * alone[:-apart]))
        own = max(np.sqrt(total) / values.size, sigma_of_mean(values))
        if self.statistic == "median":
            # The median of Gaussian numbers scatters by more than their mean.
            own *= np.sqrt(0.5 * np.pi)
        sigma = float(np.hypot(own, common))
        self.mean[at], self.sigma[at], self.spread[at] = middle, sigma, float(values.std(ddof=1))
        if sigma < self.known[at]:
            self.value[at], self.held[at] = middle, sigma
            self.scatter[at] = max(self.spread[at], sigma)

    def parameters(self) -> CalibrationParameters:
        """Return the parameters with the values found."""
        return self.estimates.parameters.changed(
            {name: float(self.value[at]) for at, name in enumerate(SPIN_RELATED)}
        )


#: The three tones of a sub-interval: each is one pair of rows.
_PAIR = 2

#: The median of the length of two Gaussian numbers of sigma 1: sqrt(2 ln 2).
_MEDIAN_LENGTH = 1.1774100225154747


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """Numbers of the joint estimate.

    Attributes
    ----------
    passes, rounds : int
        Most passes over the record, and rounds of weights within one. Assumed.
    settled : float
        A pass that changes every value by less than this many sigmas is the last. Assumed.
    singular : float
        Directions with less than this part of the information of the best one are not determined. Derived:
        the resolution of the arithmetic, with room.
    """

    passes: int = 8
    rounds: int = 30
    settled: float = 0.1
    singular: float = 1e-12


JOINT_SETTINGS = JointSettings()


@dataclass(frozen=True, kw_only=True)
class JointEstimate:
    """The eight parameters and their covariance from all sub-intervals.

    Attributes
    ----------
    value, sigma : ndarray, shape (8,)
        In the order of `SPIN_RELATED`; sigma is infinite where the record determines nothing.
    covariance : ndarray, shape (8, 8)
        Rows and columns of what is not determined are NaN.
    robust_weight : ndarray, shape (sub, 3)
        1 for a tone (Bz, modulus, modulus at twice the spin) that counts wholly, 0 for one that does not.
    excess : ndarray, shape (3,)
        Residual tones over their own noise: 1 where natural fluctuations explain them.
    tones : SpinTones
        Of the last pass.
    parameters : CalibrationParameters
        With the values put in.
    passes : int
    settled : bool
        True when the last pass changed nothing beyond a tenth of its sigma.
    """

    value: Floats
    sigma: Floats
    covariance: Floats
    robust_weight: Floats
    excess: Floats
    tones: SpinTones
    parameters: CalibrationParameters
    passes: int
    settled: bool

    @property
    def determined(self) -> Bools:
        """Parameters that the record determines; (8,)."""
        return np.isfinite(self.sigma)

    def correlation(self, one: str, other: str) -> float:
        """Return the correlation of the errors of two parameters."""
        a, b = SPIN_RELATED.index(one), SPIN_RELATED.index(other)
        return float(self.covariance[a, b] / (self.sigma[a] * self.sigma[b]))


def estimate_jointly(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: BlockLayout,
    present: CalibrationParameters,
    present_sigma: Mapping[str, float] | None = None,
) -> JointEstimate:
    """Determine the eight parameters from all sub-intervals together.

    Parameters
    ----------
    readings, phase, stamps, layout
        As for `measure_tones`.
    present : CalibrationParameters
        Where to begin; also the values of what the record does not determine.
    present_sigma : mapping of str to float, optional
        Knowledge that is put in as one more measurement of the parameters named.

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    tones = initial_tones(readings, phase, stamps, layout, present)
    given = np.array([(present_sigma or {}).get(name, np.inf) for name in SPIN_RELATED], dtype=np.float64)
    prior = _Prior(present.spin_related(), 1.0 / given**2)
    parameters, settled, passes = tones.parameters, False, 0
    while not settled and passes < JOINT_SETTINGS.passes:
        if passes:
            tones = updated_tones(readings, phase, stamps, layout, tones, parameters)
        passes += 1
        fit = _fit_tones(spin_equations(tones), tones, prior)
        new = tones.parameters.spin_related() + fit.change
        parameters = tones.parameters.changed(dict(zip(SPIN_RELATED, new.tolist(), strict=True)))
        settled = bool(np.all(np.abs(fit.change) <= JOINT_SETTINGS.settled * fit.sigma))
    return JointEstimate(
        value=new,
        sigma=fit.sigma,
        covariance=fit.covariance,
        robust_weight=fit.robust_weight,
        excess=fit.excess,
        tones=tones,
        parameters=parameters,
        passes=passes,
        settled=settled,
    )


@dataclass(frozen=True)
class _Prior:
    """Knowledge beforehand: values and inverse variances (8,), 0 for none."""

    value: Floats
    weight: Floats


@dataclass(frozen=True)
class _Fit:
    """Change of the parameters with its error; see `JointEstimate`."""

    change: Floats
    sigma: Floats
    covariance: Floats
    robust_weight: Floats
    excess: Floats


def _fit_tones(equations: SpinEquations, tones: SpinTones, prior: _Prior) -> _Fit:
    """Solve the whitened system with robust weights."""
    usable = tones.usable & np.isfinite(equations.residual).all(axis=1)
    size = np.maximum(np.abs(tones.least_modulus), 1.0)[:, None]
    noise = np.maximum(equations.noise, 1e-12 * size)
    use = usable[:, None]
    design = np.where(use[..., None], equations.design / noise[..., None], 0.0)
    target = np.where(use, -equations.residual / noise, 0.0)
    unit = np.sqrt(np.maximum((design**2).sum(axis=(0, 1)) + prior.weight, 1e-300))
    design = design / unit
    information = prior.weight / unit**2
    shift = information * (prior.value - tones.parameters.spin_related()) * unit
    robust_weight = np.ones((len(target), target.shape[1] // _PAIR))
    change = np.zeros(unit.size)
    for _ in range(JOINT_SETTINGS.rounds):
        weight = np.repeat(robust_weight, _PAIR, axis=1)
        normal = _crossed(design, design * weight[..., None]) + np.diag(information)
        eigenvalue, vectors = np.linalg.eigh(normal)
        kept = eigenvalue > JOINT_SETTINGS.singular * max(float(eigenvalue.max()), 1e-300)
        inverse = (vectors[:, kept] / eigenvalue[kept]) @ vectors[:, kept].T
        # Parameters that lie wholly in the directions kept.
        determined = (vectors[:, ~kept] ** 2).sum(axis=1) < 1e-6
        new = inverse @ (_flat(design).T @ (weight * target).ravel() + shift)
        moved, change = float(np.abs(new - change).max()), new
        residual = target - design @ change
        length = np.hypot(residual[:, 0::2], residual[:, 1::2])
        excess = np.median(length[usable], axis=0) / _MEDIAN_LENGTH
        scaled = length / _noise_factor(excess, int(usable.sum()))
        robust_weight = np.where(use, biweight(scaled), 0.0)
        if moved < 1e-3 * float(np.sqrt(np.max(np.diag(inverse)))):
            break
    weight = np.repeat(robust_weight, _PAIR, axis=1)
    covariance = _covariance(design, residual, weight, scaled, information, excess, tones.blocks)
    covariance = covariance / np.outer(unit, unit)
    covariance[~determined, :], covariance[:, ~determined] = np.nan, np.nan
    sigma = np.sqrt(np.where(determined, np.diag(covariance), np.inf))
    return _Fit(np.where(determined, change / unit, 0.0), sigma, covariance, robust_weight, excess)


def _flat(rows: Floats) -> Floats:
    """Return equations (sub, row, parameter) one after the other."""
    return rows.reshape(-1, rows.shape[-1])


def _crossed(one: Floats, other: Floats) -> Floats:
    """Return the sum of products of equations (sub, row, parameter); a matrix product, not a loop."""
    return np.asarray(_flat(one).T @ _flat(other))


def _noise_factor(excess: Floats, count: int) -> Floats:
    """Return by what factor the stated noise is too small, beyond chance in `count` tones; (3,).

    The median of n lengths of two Gaussian numbers has a relative error of ``0.61 / sqrt(n)``; half of them
    overlap.
    """
    return np.where(excess > 1.0 + 2.0 * 0.61 / np.sqrt(max(0.5 * count, 1.0)), excess, 1.0)


def _covariance(
    design: Floats,
    residual: Floats,
    weight: Floats,
    scaled: Floats,
    prior: Floats,
    excess: Floats,
    blocks: int,
) -> Floats:
    """Return the covariance by the stated noise and by the scores themselves, whichever is larger.

    Sub-intervals that share a part of their blocks share that part of their noise. Scores show what the
    stated noise does not: lines at the spin, fluctuations that keep their phase.
    """
    # A tone's influence changes by the slope along its length and by the weight across it.
    slope = 0.5 * (np.maximum(biweight_slope(scaled), 0.0) + biweight(scaled))
    slope = np.repeat(slope, _PAIR, axis=1) * (weight > 0.0)
    bread = np.linalg.pinv(_crossed(design, design * slope[..., None]) + np.diag(prior), hermitian=True)
    wide = _noise_factor(excess, int((weight.max(axis=1) > 0.0).sum()))
    noisy = design * (weight * np.repeat(wide, _PAIR))[..., None]
    stated = _crossed(noisy, noisy) + np.diag(prior)
    for apart in range(1, min(blocks, len(noisy))):
        shared = _crossed(noisy[apart:], noisy[:-apart])
        stated += (1.0 - apart / blocks) * (shared + shared.T)
    scores = (design * (weight * residual)[..., None]).sum(axis=1)
    seen = long_run_covariance(scores) + np.diag(prior)
    leverage = ((noisy @ bread) * design).sum(axis=(1, 2))
    # The kernel of the long-run covariance reaches over twice the overlap: so many fewer independent scores.
    independent = float(leverage.sum()) ** 2 / max(float(np.sum(leverage**2)), 1e-300) / (2.0 * blocks)
    # The largest eigenvalue that covariances of so few scores have by chance (Marchenko and Pastur 1967).
    chance = (1.0 + np.sqrt(len(prior) / max(independent, 1.0))) ** 2
    # The stated covariance, larger where that of the scores is by more than chance.
    own, vectors = np.linalg.eigh(stated)
    kept = own > 1e-12 * own.max()
    root, inverse = vectors[:, kept] * np.sqrt(own[kept]), vectors[:, kept] / np.sqrt(own[kept])
    ratio, basis = np.linalg.eigh(inverse.T @ seen @ inverse)
    spread = root @ basis
    larger = (spread * np.where(ratio > chance, ratio, 1.0)) @ spread.T
    return np.asarray(bread @ larger @ bread)


@dataclass(frozen=True, kw_only=True)
class FoldedFitSettings:
    """Numbers of the fit to folded samples.

    Attributes
    ----------
    rounds : int
        Most rounds of linearisation and weights. Assumed.
    settled : float
        A round that changes every value by less than this many sigmas is the last. Assumed.
    parts : tuple of float
        Parts of a change that are tried. Offsets as large as the field bend the modulus so much that the
        whole change overshoots: the one that leaves least is taken.
    alike : float
        Parts that leave so little more, relative, leave as little. Assumed.
    """

    rounds: int = 20
    settled: float = 0.05
    parts: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)
    alike: float = 1e-3


FOLDED_FIT_SETTINGS = FoldedFitSettings()


@dataclass(frozen=True, kw_only=True)
class SpinFit:
    """Fitted values of a spinning sensor.

    Attributes
    ----------
    names : tuple of (str, int)
        Parameter and component of each value.
    value, sigma : ndarray, shape (parameter,)
        In the parameters' own units.
    covariance : ndarray, shape (parameter, parameter)
    model : Model
        With the values, constant in time, put in.
    before, after : float
        Weighted rms of the rows, nT.
    """

    names: tuple[tuple[str, int], ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    model: Model
    before: float
    after: float


def spinning_sensor_of(model: Model) -> ModelEffect | None:
    """Return the model's spinning sensor; None when it has none."""
    return next((entry for entry in model.effects if isinstance(entry.effect, SpinningSensor)), None)


def free_parameters(entry: ModelEffect) -> tuple[tuple[str, int], ...]:
    """Return names and components of the free parameters that show in the spin's tones."""
    return tuple(
        (name, index)
        for name, indices in SpinningSensor.SPIN_RELATED.items()
        if entry.parameters[name].free
        for index in indices
    )


def with_constant_values(
    model: Model, entry: ModelEffect, names: Sequence[tuple[str, int]], value: Floats
) -> Model:
    """Return a model whose spinning sensor has values, constant in time."""
    parameters = dict(entry.parameters)
    for (name, index), number in zip(names, value, strict=True):
        old = parameters[name]
        numbers = old.value[:, :1].copy() if old.table is None else old.at(0)[:, None]
        numbers[index] = number
        parameters[name] = replace(old, time="constant", value=numbers, sigma=old.sigma[:, :1], table=None)
    return model.replace(replace(entry, parameters=parameters))


def fit_folded_samples(model: Model, samples: Sequence[xr.Dataset]) -> SpinFit:
    """Fit the free ones of the eight parameters to folded samples by robust weighted least squares.

    Parameters
    ----------
    model : Model
        With a spinning sensor; its values are the start, its sigmas the prior.
    samples : sequence of Dataset
        Folded: see `inflight.samples.spin_folding.fold_spins`.

    Raises
    ------
    CalibrationError
        When there is nothing to fit to.
    """
    entry = spinning_sensor_of(model)
    if entry is None:
        raise CalibrationError("the model has no spinning_sensor", remedy="add one to the model")
    names = free_parameters(entry)
    kinds = SpinningSensor.parameters()
    middle = int(np.median(np.concatenate([one["tt2000"].values for one in samples])))
    start = np.array([entry.parameters[name].at(middle)[index] for name, index in names])
    stated = np.array([float(entry.parameters[name].sigma[index, 0]) for name, index in names])
    sigma = np.where(np.isfinite(stated), stated, [kinds[name].sigma for name, _ in names])
    steps = np.array([kinds[name].step for name, _ in names])

    def rows_at(values: Floats) -> tuple[Floats, Floats, Floats]:
        return _rows(with_constant_values(model, entry, names, values), samples)

    value, rows = start, rows_at(start)
    before = _rms(*rows[:2])
    for _ in range(FOLDED_FIT_SETTINGS.rounds):
        residual, base, interval = rows
        columns = np.stack(
            [rows_at(value + step)[0] - rows_at(value - step)[0] for step in np.diag(steps)], axis=1
        ) / (2.0 * steps)
        weight = base * _interval_weights(residual, base, interval)
        change, covariance = _solve_robustly(columns, residual, weight, interval, (start - value), sigma)
        tried = [value + part * change for part in FOLDED_FIT_SETTINGS.parts]
        found = [rows_at(one) for one in tried]
        left = np.array([_rms(one[0], weight) for one in found])
        # Where the rows do not tell, the prior does: the largest part.
        best = int(np.argmax(left <= (1.0 + FOLDED_FIT_SETTINGS.alike) * left.min()))
        value, rows = tried[best], found[best]
        if np.all(np.abs(change) <= FOLDED_FIT_SETTINGS.settled * np.sqrt(np.diag(covariance))):
            break
    return SpinFit(
        names=names,
        value=value,
        sigma=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        model=with_constant_values(model, entry, names, value),
        before=before,
        after=_rms(*rows[:2]),
    )


def _rows(model: Model, samples: Sequence[xr.Dataset]) -> tuple[Floats, Floats, Floats]:
    """Return residuals, weights and intervals of all rows, one after another."""
    assert model.layout is not None
    assert model.layout.folding is not None
    length, parts = model.layout.folding.interval_ns, []
    for one in samples:
        rows = rows_of(model, one)
        weight = np.where(rows.good, np.asarray(one["weight"].values), 0.0)
        interval = one["tt2000"].values // length
        wide = rows.residual.shape[1]
        filled = np.where(rows.good[:, None], np.nan_to_num(rows.residual), 0.0)
        parts.append((filled.ravel(), np.repeat(weight, wide), np.repeat(interval, wide)))
    residual, weights, intervals = (np.concatenate(one) for one in zip(*parts, strict=True))
    if not np.any(weights > 0):
        raise CalibrationError(
            "no interval of the days looked at is usable",
            remedy="see 'inflight catalog gaps', the sun pulses and the flags of the deliveries",
        )
    return residual, weights, intervals


def _rms(residual: Floats, weight: Floats) -> float:
    return float(np.sqrt(np.sum(weight * residual**2) / max(np.sum(weight), 1e-300)))


def _interval_weights(residual: Floats, weight: Floats, interval: Floats) -> Floats:
    """Return the robust weight of each row: intervals whose tones stand out are down-weighted."""
    own, place = np.unique(interval, return_inverse=True)
    square = np.bincount(place, weight * residual**2, own.size)
    total = np.bincount(place, weight > 0, own.size)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.sqrt(square / total)
    usual = np.nanmedian(size[total > 0])
    scaled = np.where(np.isfinite(size), size / max(float(usual), 1e-12), 0.0)
    return np.asarray(biweight(scaled)[place])


def _solve_robustly(
    columns: Floats, residual: Floats, weight: Floats, interval: Floats, from_prior: Floats, sigma: Floats
) -> tuple[Floats, Floats]:
    """Return the change of the values and their covariance, by the scores of the intervals."""
    gram = (columns * weight[:, None]).T @ columns
    scale = float(np.sum(weight * residual**2)) / max(int(np.sum(weight > 0)), 1)
    prior = np.diag(scale / sigma**2)
    bread = np.linalg.inv(gram + prior)
    change = bread @ (-(columns * weight[:, None]).T @ residual + prior @ from_prior)
    after = residual + columns @ change
    own, place = np.unique(interval, return_inverse=True)
    scores = np.zeros((own.size, columns.shape[1]))
    np.add.at(scores, place, columns * (weight * after)[:, None])
    meat = scores.T @ scores * own.size / max(own.size - columns.shape[1], 1) + scale * prior
    return change, bread @ meat @ bread
