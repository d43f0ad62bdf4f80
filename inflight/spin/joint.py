"""All eight parameters from all sub-intervals at once, each weighted by its own noise.

Offsets and elevations share one tone, ``O + Ba (sP - dth)``; sub-intervals of different axial field Ba tell
them apart in one linear system, with the correlation that is left in the covariance. Nothing is selected: a
sub-interval counts by the noise its own neighbouring frequencies show, and gross ones lose their say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import biweight, biweight_slope
from inflight.estimators.longrun import long_run_covariance
from inflight.spin.equation import SPIN_RELATED, UNITS, TwelveParameters
from inflight.spin.estimates import SpinEquations, spin_equations
from inflight.spin.harmonics import SpinTones
from inflight.spin.layout import Bools, Layout
from inflight.spin.start import first_tones, next_tones
from inflight.time import Int64

#: Passes over the record, rounds of weights, and the change that ends both, in sigmas.
_PASSES, _TURNS, _SETTLED = 8, 30, 0.1
#: The three tones of a sub-interval: each is one pair of rows.
_PAIR = 2
#: The median of the length of two Gaussian numbers of sigma 1.
_MEDIAN_LENGTH = 1.1774100225154747
#: Directions that the data tell less than this part of the best are not determined.
_SINGULAR = 1e-12


@dataclass(frozen=True)
class JointEstimate:
    """The eight parameters and their covariance from all sub-intervals.

    Attributes
    ----------
    value, sigma : ndarray, shape (8,)
        In the order of `SPIN_RELATED`; sigma is infinite where the record tells nothing.
    covariance : ndarray, shape (8, 8)
        Rows and columns of what is not determined are NaN.
    say : ndarray, shape (sub, 3)
        1 for a tone (Bz, modulus, modulus at twice the spin) that counts wholly, 0 for one that does not.
    excess : ndarray, shape (3,)
        Size of the tones left over their own noise: 1 where natural fluctuations explain them.
    tones : SpinTones
        Of the last pass.
    parameters : TwelveParameters
        With the values put in.
    passes : int
    settled : bool
        True when the last pass changed nothing beyond a tenth of its sigma.
    """

    value: Floats
    sigma: Floats
    covariance: Floats
    say: Floats
    excess: Floats
    tones: SpinTones
    parameters: TwelveParameters
    passes: int
    settled: bool

    @property
    def determined(self) -> Bools:
        """Which parameters the record told; (8,)."""
        return np.isfinite(self.sigma)

    def correlation(self, one: str, other: str) -> float:
        """Return the correlation of the errors of two parameters."""
        a, b = SPIN_RELATED.index(one), SPIN_RELATED.index(other)
        return float(self.covariance[a, b] / (self.sigma[a] * self.sigma[b]))

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `covariance` and `determined` by ``parameter``."""
        one = "parameter"
        return xr.Dataset(
            {
                "value": (one, self.value),
                "sigma": (one, self.sigma),
                "covariance": ((one, "other_parameter"), self.covariance),
                "determined": (one, self.determined),
            },
            coords={
                one: list(SPIN_RELATED),
                "other_parameter": list(SPIN_RELATED),
                "units": (one, [UNITS[name] for name in SPIN_RELATED]),
            },
            attrs={
                "passes": self.passes,
                "settled": int(self.settled),
                "sub_intervals": self.tones.told(),
                "excess": self.excess.tolist(),
            },
        )


def joint_estimate(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: Layout,
    present: TwelveParameters,
    present_sigma: Mapping[str, float] | None = None,
) -> JointEstimate:
    """Determine the eight parameters from all sub-intervals together.

    Parameters
    ----------
    readings, phase, stamps, layout
        As for `spin_tones`.
    present : TwelveParameters
        Where to begin; also the values of what the record does not tell.
    present_sigma : mapping of str to float, optional
        Knowledge that is put in as one more measurement of the parameters named.

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    tones = first_tones(readings, phase, stamps, layout, present)
    known = _Known.of(present, present_sigma or {})
    parameters, settled, passes = tones.parameters, False, 0
    while not settled and passes < _PASSES:
        if passes:
            tones = next_tones(readings, phase, stamps, layout, tones, parameters)
        passes += 1
        fit = _fit(spin_equations(tones), tones, known)
        new = tones.parameters.spin_related() + fit.change
        parameters = tones.parameters.changed(dict(zip(SPIN_RELATED, new.tolist(), strict=True)))
        settled = bool(np.all(np.abs(fit.change) <= _SETTLED * fit.sigma))
    return JointEstimate(
        new, fit.sigma, fit.covariance, fit.say, fit.excess, tones, parameters, passes, settled
    )


@dataclass(frozen=True)
class _Known:
    """Knowledge beforehand: values and inverse variances (8,), 0 for none."""

    value: Floats
    weight: Floats

    @classmethod
    def of(cls, present: TwelveParameters, sigma: Mapping[str, float]) -> _Known:
        given = np.array([sigma.get(name, np.inf) for name in SPIN_RELATED], dtype=np.float64)
        return cls(present.spin_related(), 1.0 / given**2)


@dataclass(frozen=True)
class _Fit:
    change: Floats
    sigma: Floats
    covariance: Floats
    say: Floats
    excess: Floats


def _fit(equations: SpinEquations, tones: SpinTones, known: _Known) -> _Fit:
    """Solve the whitened system with robust weights."""
    usable = tones.usable & np.isfinite(equations.residual).all(axis=1)
    size = np.maximum(np.abs(tones.least_modulus), 1.0)[:, None]
    noise = np.maximum(equations.noise, 1e-12 * size)
    use = usable[:, None]
    design = np.where(use[..., None], equations.design / noise[..., None], 0.0)
    target = np.where(use, -equations.residual / noise, 0.0)
    unit = np.sqrt(np.maximum((design**2).sum(axis=(0, 1)) + known.weight, 1e-300))
    design = design / unit
    prior = known.weight / unit**2
    shift = prior * (known.value - tones.parameters.spin_related()) * unit
    say = np.ones((len(target), target.shape[1] // _PAIR))
    change = np.zeros(unit.size)
    for _ in range(_TURNS):
        weight = np.repeat(say, _PAIR, axis=1)
        inverse, told = _inverse(_crossed(design, design * weight[..., None]) + np.diag(prior))
        new = inverse @ (_flat(design).T @ (weight * target).ravel() + shift)
        moved, change = float(np.abs(new - change).max()), new
        left = target - design @ change
        say, excess, pull = _weights(left, usable)
        if moved < 1e-3 * float(np.sqrt(np.max(np.diag(inverse)))):
            break
    covariance = _covariance(design, left, np.repeat(say, _PAIR, axis=1), pull, prior, excess, tones.blocks)
    covariance = covariance / np.outer(unit, unit)
    covariance[~told, :], covariance[:, ~told] = np.nan, np.nan
    sigma = np.sqrt(np.where(told, np.diag(covariance), np.inf))
    return _Fit(np.where(told, change / unit, 0.0), sigma, covariance, say, excess)


def _flat(rows: Floats) -> Floats:
    """Return equations (sub, row, parameter) one after the other."""
    return rows.reshape(-1, rows.shape[-1])


def _crossed(one: Floats, other: Floats) -> Floats:
    """Return the sum of products of equations (sub, row, parameter); a matrix product, not a loop."""
    return np.asarray(_flat(one).T @ _flat(other))


def _inverse(normal: Floats) -> tuple[Floats, Bools]:
    """Return the inverse over what is told, and which parameters lie wholly in it."""
    size, turn = np.linalg.eigh(normal)
    kept = size > _SINGULAR * max(float(size.max()), 1e-300)
    inverse = (turn[:, kept] / size[kept]) @ turn[:, kept].T
    return inverse, (turn[:, ~kept] ** 2).sum(axis=1) < 1e-6


def _weights(left: Floats, usable: Bools) -> tuple[Floats, Floats, Floats]:
    """Return the say of each tone (sub, 3), the excess over its noise (3,), and its pull."""
    length = np.hypot(left[:, 0::2], left[:, 1::2])
    excess = np.median(length[usable], axis=0) / _MEDIAN_LENGTH
    pull = length / _widened(excess, int(usable.sum()))
    return np.where(usable[:, None], biweight(pull), 0.0), excess, pull


def _widened(excess: Floats, count: int) -> Floats:
    """Return by how much the noise stated is too small, beyond what chance makes of `count` tones; (3,).

    The median of n lengths of two Gaussian numbers has a relative error of ``0.61 / sqrt(n)``; half of them
    overlap.
    """
    return np.where(excess > 1.0 + 2.0 * 0.61 / np.sqrt(max(0.5 * count, 1.0)), excess, 1.0)


def _covariance(
    design: Floats,
    left: Floats,
    weight: Floats,
    pull: Floats,
    prior: Floats,
    excess: Floats,
    blocks: int,
) -> Floats:
    """Return the covariance by the noise stated and by the scores themselves, whichever is larger.

    Sub-intervals that share a part of their blocks share that part of their noise. Scores know what the
    noise stated does not: lines at the spin, fluctuations that keep their phase.
    """
    # A tone gives way by the slope along its length and by the weight across it.
    slope = 0.5 * (np.maximum(biweight_slope(pull), 0.0) + biweight(pull))
    slope = np.repeat(slope, _PAIR, axis=1) * (weight > 0.0)
    bread = np.linalg.pinv(_crossed(design, design * slope[..., None]) + np.diag(prior), hermitian=True)
    wide = _widened(excess, int((weight.max(axis=1) > 0.0).sum()))
    pushed = design * (weight * np.repeat(wide, _PAIR))[..., None]
    stated = _crossed(pushed, pushed) + np.diag(prior)
    for apart in range(1, min(blocks, len(pushed))):
        shared = _crossed(pushed[apart:], pushed[:-apart])
        stated += (1.0 - apart / blocks) * (shared + shared.T)
    scores = (design * (weight * left)[..., None]).sum(axis=1)
    seen = long_run_covariance(scores) + np.diag(prior)
    lever = ((pushed @ bread) * design).sum(axis=(1, 2))
    # The kernel of the long-run covariance reaches over twice the overlap, and sees so many fewer scores.
    alike = float(lever.sum()) ** 2 / max(float(np.sum(lever**2)), 1e-300) / (2.0 * blocks)
    # The largest eigenvalue that covariances of so few scores have by chance (Marchenko and Pastur 1967).
    chance = (1.0 + np.sqrt(len(prior) / max(alike, 1.0))) ** 2
    return np.asarray(bread @ _larger(stated, seen, chance) @ bread)


def _larger(one: Floats, other: Floats, chance: float) -> Floats:
    """Return a covariance, larger where another is by more than a factor that is chance."""
    own, vectors = np.linalg.eigh(one)
    kept = own > 1e-12 * own.max()
    root, inverse = vectors[:, kept] * np.sqrt(own[kept]), vectors[:, kept] / np.sqrt(own[kept])
    ratio, turn = np.linalg.eigh(inverse.T @ other @ inverse)
    spread = root @ turn
    return np.asarray((spread * np.where(ratio > chance, ratio, 1.0)) @ spread.T)
