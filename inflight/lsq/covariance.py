"""HAC, jackknife, sandwich.

Uncertainty of sums of scores that are correlated in time.

How sure a gain is: whether each block gains what the other blocks promise.

Blocks differ in what they can tell: a storm's hours tell of a clock, an eclipse season of the arrays. A
gain that lies in few blocks looks like scatter to a plain mean over its error. A true effect foretells
where its gain must lie, so each block's gain is held against what the others' make of its promise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, stdtr, stdtrit

from inflight.arrays import Floats
from inflight.lsq.gram_blocks import Evidence

#: Correlations below this many times sqrt(log10(n)/n) are chance (Politis and White 2004), and how many of
#: them in a row end the memory.
_CHANCE, _IN_A_ROW = 2.0, 5

#: Lags at most, as a part of the record.
_LONGEST = 0.15

#: The variance of a sum is never taken as smaller than this part of that of uncorrelated scores.
_LEAST = 0.5

#: The correction for what a fit takes out of its own scores is at most this.
_MOST_LOST = 0.5


def autocorrelation(series: Floats, lags: int) -> Floats:
    """Return the correlations of each column at lags 0 to `lags`; (lag, column)."""
    centred = series - series.mean(axis=0)
    size = 1 << (2 * len(series) - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: lags + 1]
    return np.asarray(np.divide(products, products[0], out=np.zeros_like(products), where=products[0] > 0))


def memory_of(series: Floats) -> npt.NDArray[np.int64]:
    """Return after how many steps each column of (block, column) has forgotten itself; (column,)."""
    blocks = len(series)
    most = max(int(_LONGEST * blocks), 1)
    correlation = np.abs(autocorrelation(series, min(most + _IN_A_ROW, blocks - 1)))
    small = correlation < _CHANCE * np.sqrt(np.log10(max(blocks, 10)) / blocks)
    # Beyond the last lag nothing is known, and nothing speaks against a run.
    ahead = np.ones((most + _IN_A_ROW, small.shape[1]), dtype=np.bool_)
    ahead[: len(small) - 1] = small[1 : most + _IN_A_ROW + 1]
    quiet = np.lib.stride_tricks.sliding_window_view(ahead, _IN_A_ROW, axis=0)[:most].all(axis=-1)
    return np.asarray(np.where(quiet.any(axis=0), quiet.argmax(axis=0), most), dtype=np.int64)


def long_run_covariance(scores: Floats, functions: float = 1.0) -> Floats:
    """Return the covariance of a sum of scores, with their correlation in time.

    A flat-topped kernel (Politis and Romano 1995) over twice the memory that the scores themselves show
    (Politis and White 2004): days that remember for a month beneath their own white noise count as that,
    which a first-order memory does not see.

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        In order of time.
    functions : float
        How many functions of time were fitted to each kind of score: a fit hides some of its own noise.

    Returns
    -------
    ndarray, shape (column, column)
        Grows with the number of blocks; zero for fewer than two.
    """
    blocks = len(scores)
    if blocks < 2:
        return np.zeros((scores.shape[1],) * 2)
    centred = scores - scores.mean(axis=0)
    white = centred.T @ centred
    size = np.sqrt(np.diag(white))
    size = np.where(size > 0, size, 1.0)
    unit, plain = centred / size, white / np.outer(size, size)
    total = plain
    width = 2 * int(memory_of(centred).max())
    kernel = np.clip(2.0 * (1.0 - np.arange(1, width + 1) / (width + 1)), 0.0, 1.0)
    if width:
        # What the kernel makes of all earlier blocks, at once: a product a lag would take a second.
        size_of = 1 << (blocks + width).bit_length()
        spectrum = np.fft.rfft(np.append(0.0, kernel), size_of)[:, None] * np.fft.rfft(unit, size_of, axis=0)
        shared = unit.T @ np.fft.irfft(spectrum, size_of, axis=0)[:blocks]
        total = total + shared + shared.T
    lost = min(functions * (1.0 + 2.0 * kernel.sum()) / blocks, _MOST_LOST)
    return np.asarray(_no_smaller(total, plain) * np.outer(size, size) / (1.0 - lost))


def _no_smaller(total: Floats, white: Floats) -> Floats:
    """Return a covariance without directions far below what uncorrelated scores have: these are chance."""
    own, vectors = np.linalg.eigh(white)
    kept = own > 1e-10 * own.max()
    root = vectors[:, kept] * np.sqrt(own[kept])
    inverse = vectors[:, kept] / np.sqrt(own[kept])
    ratio, turn = np.linalg.eigh(inverse.T @ total @ inverse)
    spread = root @ turn
    return np.asarray((spread * np.maximum(ratio, _LEAST)) @ spread.T)


def sigma_of_mean(series: Floats) -> float:
    """Return the standard deviation of the mean of a correlated series (block,); NaN are left out."""
    known = series[np.isfinite(series)]
    if known.size < 2:
        return float("nan")
    return float(np.sqrt(long_run_covariance(known[:, None])[0, 0]) / known.size)


Index = npt.NDArray[np.int64]

#: Probability beyond which a t of three lies when there are many blocks: few are held to the same.
_BEYOND = float(ndtr(-3.0))


def hac_t(difference: Floats, active: npt.NDArray[np.bool_] | None = None) -> Floats:
    """Return mean over standard error of series; (series,), errors with Bartlett's kernel over blocks.

    Parameters
    ----------
    difference : ndarray, shape (block, series)
    active : ndarray of bool, shape (block, series), optional
        Blocks that tell anything: an effect that lasts a week is judged by that week.
    """
    used = np.ones(difference.shape, dtype=bool) if active is None else active
    count = np.maximum(used.sum(axis=0), 1)
    summed = np.where(used, difference, 0.0).sum(axis=0)
    centred = np.where(used, difference - summed / count, 0.0)
    error = np.sqrt(_long_run(centred) * count / np.maximum(count - 1, 1))
    return np.where((error > 0) & (count > 2), summed / np.where(error > 0, error, 1.0), 0.0)


def promised_t(gained: Floats, promised: Floats, active: npt.NDArray[np.bool_]) -> Floats:
    """Return total gain over its error, by what each block gains beside its part of the promise; (series,).

    With promises e_b and gains d_b, block b alone misses by d_b - e_b sum'(d) / sum'(e), the sums over all
    other blocks; the error is the root of the sum of their squares, with Bartlett's kernel over neighbours.
    As many blocks as (sum e)^2 / sum e^2 bear the gain out: with few, t is lowered so that three lies at the
    same probability of Student's distribution.

    Parameters
    ----------
    gained, promised : ndarray, shape (block, series)
        Held-out gain, and the square of what the effect fitted elsewhere contributes.
    active : ndarray of bool, shape (block, series)
        Blocks that tell anything.
    """
    t, freedom = _promised(gained, promised, active)
    few = np.where(freedom > 0.1, -3.0 / stdtrit(np.maximum(freedom, 0.1), _BEYOND), 0.0)
    return np.asarray(few * t)


def promised_p(gained: Floats, promised: Floats, active: npt.NDArray[np.bool_]) -> Floats:
    """Return the probability that chance gains so much where it is promised (Student); (series,).

    Parameters
    ----------
    gained, promised, active : ndarray, shape (block, series)
        As in `promised_t`.
    """
    t, freedom = _promised(gained, promised, active)
    return np.where(freedom > 0.1, stdtr(np.maximum(freedom, 0.1), -t), 1.0)


def _promised(gained: Floats, promised: Floats, active: npt.NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return total gain over its error and the degrees of freedom of that error; (series,) each."""
    count = active.sum(axis=0)
    gains = np.where(active, gained, 0.0)
    whole = np.sum(gains, axis=0)
    part = np.where(active, promised, 0.0)
    foretold = np.sum(part, axis=0)
    # Nothing foretold, nothing gained: each block then promises the same.
    part = np.where(foretold > 0, part, active)
    share = part / np.maximum(np.sum(part, axis=0), 1e-300)
    missed = (gains - whole * share) / np.maximum(1.0 - share, 1e-12)
    error = np.sqrt(_long_run(missed))
    freedom = 1.0 / np.maximum(np.sum(share**2, axis=0), 1e-300) - 1.0
    return np.where((error > 0) & (count > 2), whole / np.where(error > 0, error, 1.0), 0.0), freedom


def _long_run(series: Floats) -> Floats:
    """Return the sum of squares with Bartlett's weights of neighbours' products; (series,)."""
    variance = np.sum(series**2, axis=0)
    reach = max(1, int(4.0 * (len(series) / 100.0) ** (2.0 / 9.0)))
    total = variance.copy()
    for lag in range(1, min(reach, len(series) - 1) + 1):
        weight = 1.0 - lag / (reach + 1.0)
        total += 2.0 * weight * np.sum(series[lag:] * series[:-lag], axis=0)
    # Few blocks can look anticorrelated by chance; that must not make them more certain.
    return np.asarray(np.maximum(total, variance))


@dataclass
class Fits:
    """What was fitted to all folds but one, fold after fold, to set candidates against each other.

    Parameters
    ----------
    evidence : Evidence
    present : ndarray of int
        Columns of the model.
    candidates : list of ndarray of int
        Columns of each candidate.
    """

    evidence: Evidence
    present: Index
    candidates: list[Index]
    folds: list[tuple[Index, Floats, list[Floats]]] = field(default_factory=list)

    def begin(self, fold: Index, own: Floats) -> None:
        """Begin a fold: its blocks, and the projection (present, column) of the others."""
        self.folds.append((fold, own, [np.empty(0)] * len(self.candidates)))

    def keep(self, positions: Sequence[int] | Index, gamma: Floats) -> None:
        """Keep the values (candidate, k) of some candidates in the fold begun last."""
        fitted = self.folds[-1][2]
        for place, values in zip(positions, gamma, strict=True):
            fitted[int(place)] = values

    def apart(self, one: int, other: int) -> Floats | None:
        """Return the sum of squares between two candidates' contributions; (block,), None if one is not here.

        When one of the two is the truth, it is what each block is expected to prefer it by.
        """
        if max(one, other) >= len(self.candidates):
            return None
        first, second = self.candidates[one], self.candidates[other]
        columns = np.concatenate([self.present, first, second])
        out = np.zeros(len(self.evidence))
        for fold, own, fitted in self.folds:
            own_one = own[:, first] @ fitted[one]
            own_other = own[:, second] @ fitted[other]
            values = np.concatenate([own_other - own_one, fitted[one], -fitted[other]])
            blocks = self.evidence.gram[fold[:, None, None], columns[:, None], columns]
            out[fold] = np.einsum("i,bij,j->b", values, blocks, values)
        return np.maximum(out, 0.0)
