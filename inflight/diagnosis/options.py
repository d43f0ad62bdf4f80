"""What a search chooses from: options, rules they are taken by, their scores, and the ledger of rounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis.changes import Change
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.scoring import Index, Scores

#: An effect of which the calibration leaves less than this part cannot be told from the calibration.
LEAST_KEPT = 1e-3
#: An effect of its usual size that explains less than so many times a row's variance could not be seen: three
#: sigma, of residuals correlated over several rows.
_CLEAR = 50.0
#: Part of a column that the calibration leaves, from which on it is no matter of the calibration.
_OWN = 0.05


@dataclass(frozen=True)
class Rules:
    """When a candidate is taken, and what counts as a rival.

    Attributes
    ----------
    t, gain, p : float
        Held-out t and gain at least, family-wise p at most, of an addition.
    keep_t, keep_gain : float
        Of an effect that stays when the others are there.
    rival_t : float
        Rivals lose to the winner by less than this t.
    draws, seed : int
        Flips of signs.
    rounds : int
        Additions at most.
    blocks : int
        Fewest independent blocks a verdict is given from.
    """

    t: float = 3.0
    gain: float = 0.01
    p: float = 0.05
    keep_t: float = 3.0
    keep_gain: float = 0.005
    rival_t: float = 2.0
    draws: int = 2000
    seed: int = 0
    rounds: int = 8
    blocks: int = 20

    def shown(self, scores: Scores, p: Floats) -> npt.NDArray[np.bool_]:
        """Return which candidates gain enough, surely enough, placebos aside."""
        return (scores.t > self.t) & (scores.gain > self.gain) & (p < self.p)

    def standing(self, worth: tuple[float, float]) -> float:
        """Return how far (gain, t) of an effect are above what keeps it: it stays from 1 on."""
        gain, t = worth
        return min(gain / self.keep_gain, t / self.keep_t)


@dataclass(frozen=True, eq=False)
class Option:
    """Something that can be added to the model: a candidate of the library, or a change in time."""

    name: str
    mechanism: str
    family: str
    columns: tuple[str, ...]
    channels: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()
    lag_s: float = 0.0
    agnostic: bool = False
    placebo: bool = False
    change: Change | None = None
    lag_sigma_s: float | None = None

    @property
    def interleaved(self) -> bool:
        """True when blocks around those held out must be among the fitted (see `Change`)."""
        return self.change is not None and self.change.interleaved


@dataclass
class Table:
    """Scores of all options in one round; arrays over options, by form."""

    options: list[Option]
    scores: dict[str, Scores]
    p: dict[str, Floats]
    beats_placebo: dict[str, Floats]

    def light(self) -> Table:
        """Return the table without what was fitted to folds, which holds on to gigabytes of evidence."""
        return replace(self, scores={form: one.light() for form, one in self.scores.items()})

    def passing(self, rules: Rules) -> dict[str, np.ndarray]:
        """Return, a form, which options may be added."""
        real = np.array([not option.placebo for option in self.options], dtype=bool)
        raw = self.scores["raw"]
        # What only a filtered form shows must at least show the right way in the residual itself.
        agreed = {
            "raw": real,
            "within": real & (raw.t > 0),
            "white": real & (raw.gain > 0.5 * rules.gain) & (raw.t > 1),
        }
        return {
            form: agreed[form]
            & rules.shown(self.scores[form], self.p[form])
            & (self.beats_placebo[form] > rules.t)
            for form in self.scores
        }


@dataclass(frozen=True)
class Round:
    """One addition or removal, for the ledger."""

    number: int
    action: str
    name: str
    family: str
    gain: float
    t: float
    p: float
    form: str

    def as_json(self) -> dict[str, object]:
        """Return the fields by name."""
        return dict(vars(self))


def is_seen(
    raw: Evidence, form: Evidence, columns: Sequence[str], base: Index, usual: Floats, variance: float
) -> bool:
    """Return True when an effect of its usual size would stand out of what the calibration leaves.

    Parameters
    ----------
    raw, form : Evidence
        Before and after the calibration was absorbed.
    columns : sequence of str
        Of the effect.
    base : ndarray of int
        Columns of the calibration that the effect may share a constant with.
    usual : ndarray, shape (column,)
        Usual size of each column.
    variance : float
        Of a row, nT^2.
    """
    whole = np.diag(raw.centred(raw.index(columns), base))
    left = np.diag(form.total)[form.index(columns)]
    kept = np.where(whole > 0, left / np.where(whole > 0, whole, 1.0), 0.0)
    # What the calibration hardly touches is seen or not by the data; of what it nearly takes over, the
    # usual size says whether the rest can be.
    own = np.diag(raw.total)[raw.index(columns)]
    clear = left > _OWN * own
    clear |= left * usual[: len(left)] ** 2 > _CLEAR * variance
    return bool(np.any((kept >= LEAST_KEPT) & clear))
