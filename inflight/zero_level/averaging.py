r"""Averages over whole turns and whole samples (Hedgecock's rule), and which averages of a delivery are not.

In despun axes a field fixed to the spacecraft, or an offset in the spin plane, turns once a spin. The mean of
N samples T_s apart leaves the part :math:`|\sin(\pi N T_s/T) / (N \sin(\pi T_s/T))|` of it
(`remaining_part`): five whole spins of 1 s leave a third when they are sampled every 1.5 s, because 3.33
samples are no whole number. `check_averaging` tells what an averaging time leaves, `whole_average` chooses
one, `average_spans` takes the means.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.time import SECOND, Int64
from inflight.zero_level.intervals import Bools

#: An average that leaves more than this part of a turning field is no average over spins. Derived: 2 nT of
#: spin-plane offset leave 0.1 nT, the accuracy sought.
TOLERANCE = 0.05


class AveragingWarning(UserWarning):
    """An average leaves part of the field that turns with the spacecraft."""


def remaining_part(spin_period: float, sampling: float, samples: int) -> float:
    """Return which part of a field that turns with the spin the mean of some samples leaves, 0 to 1.

    Parameters
    ----------
    spin_period, sampling : float
        s.
    samples : int
        In the mean.
    """
    angle = np.pi * sampling / spin_period
    below = samples * np.sin(angle)
    if abs(below) < 1e-12 * samples:
        return 1.0  # every sample at the same phase
    return float(abs(np.sin(samples * angle) / below))


@dataclass(frozen=True)
class AveragingRule:
    """How an averaging time fits the spin and the samples.

    Attributes
    ----------
    spins, samples : float
        In an average.
    remaining : float
        Largest part of a turning field that stays.
    """

    spins: float
    samples: float
    remaining: float

    @property
    def kept(self) -> bool:
        """Whether no more than `TOLERANCE` stays."""
        return self.remaining <= TOLERANCE

    def summary(self) -> str:
        """Return what stays and why, in words."""
        parts = [
            f"{number:.3f} {name}"
            for number, name in ((self.spins, "spins"), (self.samples, "samples"))
            if abs(number - round(number)) > 1e-6
        ]
        why = f" ({' and '.join(parts)})" if parts else ""
        return f"averages leave {100 * self.remaining:.1f} % of a field that turns with the spacecraft{why}"


def check_averaging(
    spin_period: float, sampling: float, averaging: float, *, strict: bool = False
) -> AveragingRule:
    """Check an averaging time against spin and samples; warn when a turning field stays.

    Parameters
    ----------
    spin_period, sampling, averaging : float
        s.
    strict : bool
        Raise in place of warning.

    Raises
    ------
    CalibrationError
        Periods that are not positive, or, if strict, an average that leaves more than
        `TOLERANCE`.
    """
    if min(spin_period, sampling, averaging) <= 0 or averaging < sampling:
        raise CalibrationError(
            f"spin {spin_period:g} s, samples {sampling:g} s, averages {averaging:g} s found: no averages",
            remedy="give positive times, averages no shorter than samples",
        )
    samples = averaging / sampling
    low = int(np.floor(samples + 1e-9))
    counts = {low, low if abs(samples - low) < 1e-6 else low + 1}
    rule = AveragingRule(
        averaging / spin_period, samples, max(remaining_part(spin_period, sampling, one) for one in counts)
    )
    if not rule.kept:
        remedy = "take a whole multiple of both the spin period and the sampling time"
        if strict:
            raise CalibrationError(rule.summary(), remedy=remedy)
        warnings.warn(f"{rule.summary()}; {remedy}", AveragingWarning, stacklevel=2)
    return rule


def whole_average(spin_period: float, sampling: float, wanted: float) -> int:
    """Return how many samples to average, so that whole turns and whole samples fit; at least 1.

    The number nearest to the wanted time is taken of which no more than `TOLERANCE` of a turning field stays,
    within half and twice that time; where there is none, the one that leaves least.

    Parameters
    ----------
    spin_period, sampling, wanted : float
        s.
    """
    first, last = max(int(0.5 * wanted / sampling), 1), max(int(2.0 * wanted / sampling), 1)
    counts = np.arange(first, last + 1)
    left = np.array([remaining_part(spin_period, sampling, int(count)) for count in counts])
    kept = left <= TOLERANCE
    if not kept.any():
        return int(counts[np.argmin(left)])
    apart = np.where(kept, np.abs(counts - wanted / sampling), np.inf)
    return int(counts[np.argmin(apart)])


def delivered_rule(spin_period: float, averaging: float, sampling: float | None) -> AveragingRule:
    """Return what means leave of a turning field that a delivery was averaged to.

    Parameters
    ----------
    spin_period, averaging : float
        s.
    sampling : float, optional
        Of the readings they are means of, s; as good as continuous when absent.
    """
    if sampling is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AveragingWarning)
            return check_averaging(spin_period, sampling, averaging)
    return AveragingRule(averaging / spin_period, 1.0, float(abs(np.sinc(averaging / spin_period))))


def average_spans(
    tt2000: Int64, field: Floats, averaging: float, good: Bools | None = None, coverage: float = 1.0
) -> tuple[Int64, Floats]:
    """Return middles and means of successive spans of a despun field.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (time,)
        Rising.
    field : ndarray, shape (time, 3)
        nT, despun.
    averaging : float
        s; see `check_averaging`.
    good : ndarray of bool, shape (time,), optional
    coverage : float
        Spans with fewer than this part of the samples that fit are NaN: a hole in a span breaks the rule.

    Returns
    -------
    tt2000 : ndarray of int64, shape (span,)
    mean : ndarray, shape (span, 3)
    """
    use = np.isfinite(field).all(axis=1) & (True if good is None else good)
    length = round(averaging * SECOND)
    span = (tt2000 - tt2000[0]) // length
    size = int(span[-1]) + 1
    count = np.bincount(span[use], minlength=size)
    sums = np.stack([np.bincount(span[use], column, minlength=size) for column in field[use].T], axis=1)
    cadence = float(np.median(np.diff(tt2000)))
    edges = np.ceil(np.arange(size + 1) * length / cadence - 0.5)
    kept = (count >= np.maximum(coverage * np.diff(edges), 1))[:, None]
    mean = np.divide(sums, count[:, None], out=np.full_like(sums, np.nan), where=kept)
    return tt2000[0] + np.arange(size) * length + length // 2, mean
