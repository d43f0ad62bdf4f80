"""Scalar calibration of one block: exact robust Gauss-Newton on scaled normal equations.

The nine parameters are those of the effect ``vector_sensor``. Everything else the model holds is
taken out of the readings first, see `inflight.calibration.sensor.split_chain`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.calibration.nine import WIDTH, compress, gram_elsewhere, grams, residuals
from inflight.calibration.robust import BIWEIGHT_WIDTH, WEIGHTED_RMS, robust_sigma
from inflight.calibration.sensor import SCALE, Reference, bend, kernel_parameters, kernel_scale
from inflight.calibration.solution import MIN_INFORMATION, Solution, posterior, solve
from inflight.errors import CalibrationError

#: Sub-blocks of a block, for the covariance: 20 minutes of a day.
SUB_BLOCKS = 72
#: Fewest sub-blocks of a shorter block: more would be too short to show correlation over minutes.
FEWEST_SUB_BLOCKS = 12
_SUB_BLOCK_S = 1200.0
#: Residuals are taken as correlated over this many sub-blocks.
BARTLETT = 3
#: The equations are linearised at the reference itself when the fit bends the residual by more, nT.
BEND = 1e-4
_MAX_PASSES = 25
#: A direction at the edge of what the data determine could come and go for ever: from this turn on the
#: edge rises by this factor a turn, until the direction stays at its prior.
_EDGE_TURN, _EDGE_RISE = 5, 1.5
#: The iteration ends when no parameter moves by more than this many of its sigmas: a lengthened step
#: leaves a thousandth of itself to the next, also with outliers (measured).
_SETTLED = 10.0
#: Data that know every direction so many times better than the prior are solved without ado.
_PLAIN = 1e3
#: Longer blocks begin with every `_THIN`-th sample; the residual's scale is taken from so many.
_LONG, _THIN, _SCALE_SAMPLES = 20_000, 8, 10_000


@dataclass(frozen=True)
class BlockFit:
    """One block's fit and the normal equations it leaves behind.

    Attributes
    ----------
    value, sigma : ndarray, shape (9,)
        Scale factors (1), misalignment angles (deg), offsets (nT).
    covariance : ndarray, shape (9, 9)
        Physical units.
    solution : Solution
        The same, scaled, with what is determined.
    gram : ndarray, shape (10, 10)
        Robustly weighted Gram matrix of [columns | residual], its residual expressed at the
        reference; scaled columns, nT^2.
    scatter : ndarray, shape (9, 9)
        Scatter of the sub-blocks' scores.
    linearised_at : ndarray, shape (9,)
        Where the rows were linearised, physical units.
    count : float
        Sum of the weights.
    used : int
        Samples in the fit.
    sigma_residual : float
        Robust standard deviation the weights were made with, nT.
    before, after : float
        Rms residual at the reference (robustly weighted) and at the fit (as if Gaussian), nT.
    passes : int
        Gauss-Newton passes made.
    """

    value: Floats
    sigma: Floats
    covariance: Floats
    solution: Solution
    gram: Floats
    scatter: Floats
    linearised_at: Floats
    count: float
    used: int
    sigma_residual: float
    before: float
    after: float
    passes: int


def sub_blocks_for(seconds: float) -> int:
    """Return into how many sub-blocks so many seconds of used samples are cut: one for 20 minutes."""
    return int(np.clip(seconds / _SUB_BLOCK_S, FEWEST_SUB_BLOCKS, SUB_BLOCKS))


def fit_block(
    reading: Floats,
    additive: Floats,
    scalar: Floats,
    good: npt.NDArray[np.bool_],
    reference: Reference,
    prior: Reference | None = None,
    sub_blocks: int = SUB_BLOCKS,
) -> BlockFit:
    """Fit nine parameters to one block.

    Parameters
    ----------
    reading, additive, scalar : ndarray
        As `split_chain` returns them, nT.
    good : ndarray of bool, shape (time,)
        Samples to use.
    reference : Reference
        Start of the iteration, and what the normal equations are expressed at.
    prior : Reference, optional
        What is known beforehand; the reference when absent.
    sub_blocks : int
        Number of spans whose scores are independent, for the covariance.

    Raises
    ------
    CalibrationError
        When fewer samples are usable than parameters, or the iteration does not settle.
    """
    used = int(good.sum())
    if used <= WIDTH:
        raise CalibrationError(
            f"{used} usable samples for nine parameters", remedy="see the day's coverage and flags"
        )
    prior = prior or reference
    data = _Data.of(reading, additive, scalar, good, sub_blocks)
    value, passes = reference.value, 0
    for part in (data.thinned(), data):
        for turn in range(_MAX_PASSES):
            least = MIN_INFORMATION * _EDGE_RISE ** max(0, turn - _EDGE_TURN)
            found = _pass(part, value, prior, passes > 0, least)
            moved, value, passes = found.value - value, found.value, passes + 1
            settled = np.all(np.abs(moved) <= _SETTLED * np.maximum(found.sigma, 1e-12 * SCALE))
            if passes > 1 and settled and bend(value, value - moved, data.strength) <= BEND:
                break
        else:
            raise CalibrationError(
                f"the fit did not settle in {passes} passes", remedy="look at the day's residual for faults"
            )
    return _finish(found, data, reference, prior, used, passes)


def empty_block(reference: Reference, prior: Reference) -> BlockFit:
    """Return the fit of a block that says nothing: everything stays at its prior, and nothing is added up."""
    nan, parameters = float("nan"), prior.value.size
    gram, scatter = np.zeros((parameters + 1, parameters + 1)), np.zeros((parameters, parameters))
    centre, spread = (prior.value - reference.value) / SCALE, prior.sigma / SCALE
    return BlockFit(
        prior.value,
        prior.sigma,
        np.diag(prior.sigma**2),
        solve(gram, scatter, 0.0, centre, spread),
        gram,
        scatter,
        reference.value,
        count=0.0,
        used=0,
        sigma_residual=nan,
        before=nan,
        after=nan,
        passes=0,
    )


@dataclass(frozen=True)
class _Data:
    """The usable samples of a block, without holes, and the sub-blocks they fall in."""

    e: Floats
    s: Floats
    f: Floats
    edges: npt.NDArray[np.int64]
    strength: float

    @classmethod
    def of(
        cls, reading: Floats, additive: Floats, scalar: Floats, good: npt.NDArray[np.bool_], sub_blocks: int
    ) -> _Data:
        # Cut by used samples, not by rows: hours of gaps are no sub-blocks.
        edges = np.linspace(0, int(good.sum()), max(sub_blocks, 1) + 1).astype(np.int64)
        many = np.ascontiguousarray(additive, dtype=np.float64)
        e, f = np.ascontiguousarray(reading), np.ascontiguousarray(scalar)
        if good.all():
            return cls(e, many, f, edges, float(np.median(f[::64])))
        e, many, f = compress(e, many, f, good)
        return cls(e, many, f, edges, float(np.median(f[::64])))

    def thinned(self) -> _Data:
        """Every eighth sample of a long block: it brings the fit near its end at an eighth of the cost."""
        if self.f.size < _LONG:
            return self
        s = self.s[::_THIN] if self.s.shape[0] > 1 else self.s
        e, f = self.e[::_THIN], self.f[::_THIN]
        return _Data(
            np.ascontiguousarray(e),
            np.ascontiguousarray(s),
            np.ascontiguousarray(f),
            -(-self.edges // _THIN),
            self.strength,
        )

    def sigma(self, value: Floats) -> float:
        """Robust standard deviation of the residual, from some evenly spread samples; nT."""
        step = max(1, self.f.size // _SCALE_SAMPLES)
        s = self.s[::step] if self.s.shape[0] > 1 else self.s
        some = residuals(kernel_parameters(value), self.e[::step], s, self.f[::step])
        return robust_sigma(some, floor=1e-6)


@dataclass(frozen=True)
class _Pass:
    """One Gauss-Newton pass: where it was linearised, where it leads, and its equations."""

    here: Floats
    value: Floats
    sigma: Floats
    blocks: Floats
    count: float
    bread: float
    sigma_residual: float


def _pass(data: _Data, value: Floats, prior: Reference, weighted: bool, edge: float) -> _Pass:
    """Make one pass.

    The step is lengthened by `bread`, the ratio of the weights to their slope: weights follow the
    residual, so that a plain step with fixed weights falls short by a tenth.
    """
    sigma = data.sigma(value) if weighted else float("inf")
    blocks, count, slopes = grams(
        kernel_parameters(value),
        data.e,
        data.s,
        data.f,
        BIWEIGHT_WIDTH * sigma,
        kernel_scale(value),
        data.edges,
    )
    bread = count / slopes if slopes > 0.2 * count else 1.0
    gram = blocks.sum(axis=0)
    centre, spread = (prior.value - value) / SCALE, prior.sigma / SCALE
    step, covariance, least = posterior(gram, count, centre, spread)
    if least < _PLAIN:
        # Weak directions need their true weight, or the iteration runs along them for nothing.
        solution = solve(gram, score_scatter(blocks, step, spread), count, centre, spread, edge)
        step, covariance, bread = solution.value, solution.covariance, 1.0
    sigmas = np.sqrt(np.diag(covariance)) * SCALE
    return _Pass(value, value + step * bread * SCALE, sigmas, blocks, count, bread, sigma)


def score_scatter(blocks: Floats, change: Floats, prior_sigma: Floats) -> Floats:
    """Return the long-run scatter of the sub-blocks' scores after a change; (9, 9), scaled.

    Bartlett's kernel over `BARTLETT` sub-blocks (Newey and West 1987). The scores of a fit sum to
    nearly zero, which makes the plain estimate too small; the factor that makes it right for white
    residuals follows from the sub-blocks' own Gram matrices.
    """
    matrices = blocks[:, :-1, :-1]
    scores = blocks[:, :-1, -1] + matrices @ change
    lag = np.abs(np.subtract.outer(np.arange(len(blocks)), np.arange(len(blocks))))
    kernel = np.maximum(0.0, 1.0 - lag / (BARTLETT + 1.0))
    scatter = scores.T @ kernel @ scores
    total = matrices.sum(axis=0)
    unit = prior_sigma[:, None] * prior_sigma[None, :]
    steadied = np.linalg.pinv(total * unit + np.eye(change.size), hermitian=True) * unit
    # What each pair of sub-blocks shares through the fitted parameters, summed with the kernel.
    turned = steadied @ matrices
    flat = turned.reshape(len(blocks), -1)
    absorbed = float(np.sum(kernel * (flat @ turned.transpose(0, 2, 1).reshape(len(blocks), -1).T)))
    known = float(np.trace(steadied @ total))
    kept = 1.0 - absorbed / known if known > 0 else 1.0
    return np.asarray(scatter / max(kept, 0.1))


def _finish(
    found: _Pass, data: _Data, reference: Reference, prior: Reference, used: int, passes: int
) -> BlockFit:
    """Solve the last pass with the scatter of its scores; express its equations at the reference."""
    gram = found.blocks.sum(axis=0)
    centre, spread = (prior.value - found.here) / SCALE, prior.sigma / SCALE
    near, _, _ = posterior(gram, found.count, centre, spread)
    scatter = score_scatter(found.blocks, near, spread) * found.bread**2
    solution = solve(gram, scatter, found.count, centre, spread)
    value = found.here + (solution.value + (found.bread - 1.0) * near) * SCALE
    value = np.where(solution.moved, value, prior.value)
    # Fits that are sure of every parameter lie close together, so that their own linearisations agree;
    # others run along what they do not know, and need a common one.
    sure = bool(np.all(solution.determined | (prior.sigma <= 0)))
    if sure or bend(value, reference.value, data.strength) <= BEND:
        gram, linearised_at = shift_reference(gram, (reference.value - found.here) / SCALE), found.here
    else:
        gram, linearised_at = _gram_at(reference.value, data, found), reference.value
    covariance = solution.covariance * np.outer(SCALE, SCALE)
    return BlockFit(
        value,
        np.sqrt(np.diag(covariance)),
        covariance,
        solution,
        gram,
        scatter,
        linearised_at,
        found.count,
        used,
        found.sigma_residual,
        before=float(np.sqrt(gram[-1, -1] / found.count)),
        after=float(np.sqrt(solution.variance)) / WEIGHTED_RMS,
        passes=passes,
    )


def _gram_at(reference: Floats, data: _Data, found: _Pass) -> Floats:
    """Return the Gram matrix linearised at a far reference, with the weights of the last pass."""
    r = residuals(kernel_parameters(found.here), data.e, data.s, data.f)
    root = np.maximum(1.0 - (r / (BIWEIGHT_WIDTH * found.sigma_residual)) ** 2, 0.0)
    theta, scale = kernel_parameters(reference), kernel_scale(reference)
    return np.asarray(gram_elsewhere(theta, data.e, data.s, data.f, root, scale))


def shift_reference(gram: Floats, change: Floats) -> Floats:
    """Express the residual column after a scaled change of the parameters: y becomes ``y + X change``.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Gram matrix of [X | y], scaled columns, nT^2.
    change : ndarray, shape (parameter,)
        Scaled.
    """
    turn = np.eye(gram.shape[0])
    turn[-1, :-1] = change
    return np.asarray(turn @ gram @ turn.T)
