"""Whether a new estimate should replace the value in use, each parameter on its own.

An update that is no better known than what it replaces, or that moves it by less than its own error, only
adds jitter (Plaschke et al. 2019, sections 6 and 8).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.spin.equation import SPIN_RELATED, UNITS, TwelveParameters

Verdict = Literal["update", "confirm", "keep"]
#: A change counts from this many standard deviations on.
SIGNIFICANCE = 3.0
#: A value is known well better with this part of the other's error. Of two that are known alike the
#: difference scatters by more than the error of one: every thirtieth would be replaced by noise.
WELL_BETTER = 0.5


@dataclass(frozen=True)
class Decision:
    """What becomes of one parameter.

    Attributes
    ----------
    name : str
    present, present_sigma, new, sigma : float
        Value in use, its uncertainty, and the new estimate with its own.
    verdict : {"update", "confirm", "keep"}
        Take the new value; keep the value and believe it better; keep both.
    reason : str
    """

    name: str
    present: float
    present_sigma: float
    new: float
    sigma: float
    verdict: Verdict
    reason: str

    @property
    def value(self) -> float:
        """The value from now on."""
        return self.new if self.verdict == "update" else self.present

    @property
    def value_sigma(self) -> float:
        """Its uncertainty: a confirmed value is known as well as the new one says, and where that lies."""
        if self.verdict == "update":
            return self.sigma
        if self.verdict == "confirm":
            return min(self.present_sigma, float(np.hypot(self.sigma, self.new - self.present)))
        return self.present_sigma


@dataclass(frozen=True)
class Updates:
    """Decisions in the order of `SPIN_RELATED`, and the parameters they lead to."""

    decisions: tuple[Decision, ...]
    parameters: TwelveParameters

    def of(self, name: str) -> Decision:
        """Return the decision on one parameter."""
        return self.decisions[SPIN_RELATED.index(name)]

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, what they came from and why by ``parameter``."""
        one = "parameter"
        numbers = {
            name: (one, [getattr(each, name) for each in self.decisions])
            for name in ("present", "present_sigma", "new", "verdict", "reason")
        }
        return xr.Dataset(
            {
                "value": (one, [each.value for each in self.decisions]),
                "sigma": (one, [each.value_sigma for each in self.decisions]),
                "new_sigma": (one, [each.sigma for each in self.decisions]),
                **numbers,
            },
            coords={one: list(SPIN_RELATED), "units": (one, [UNITS[name] for name in SPIN_RELATED])},
        )


def decide_updates(
    value: Floats,
    sigma: Floats,
    present: TwelveParameters,
    present_sigma: Mapping[str, float],
    significance: float = SIGNIFICANCE,
) -> Updates:
    """Decide which of the eight parameters to replace.

    Parameters
    ----------
    value, sigma : ndarray, shape (8,)
        New estimates in the order of `SPIN_RELATED`; sigma infinite for what was not determined.
    present : TwelveParameters
        In use.
    present_sigma : mapping of str to float
        Their uncertainties by name; what is not named is not known at all.
    significance : float
        A value is replaced where it differs by more than this many of the new sigma and the new one is known
        well better, or where the two contradict each other beyond both errors.
    """
    old = present.spin_related()
    made = [
        decide_one(
            name,
            (float(old[at]), float(present_sigma.get(name, np.inf))),
            (float(value[at]), float(sigma[at])),
            significance,
        )
        for at, name in enumerate(SPIN_RELATED)
    ]
    changed = {one.name: one.new for one in made if one.verdict == "update"}
    return Updates(tuple(made), present.changed(changed))


def decide_one(
    name: str, old: tuple[float, float], new: tuple[float, float], significance: float = SIGNIFICANCE
) -> Decision:
    """Return the decision on one parameter from (value, sigma) in use and found."""
    sigma = new[1]
    if not (np.isfinite(sigma) and np.isfinite(new[0])):
        return Decision(name, *old, *new, "keep", "the record does not tell it")
    change, better = abs(new[0] - old[0]), sigma < old[1]
    told = f"differs by {change / sigma:.1f} sigma" if sigma > 0.0 else f"differs by {change:.3g}"
    if change > significance * sigma and sigma < WELL_BETTER * old[1]:
        return Decision(name, *old, *new, "update", f"{told}, and is known well better than the value in use")
    if change > significance * float(np.hypot(sigma, old[1])):
        return Decision(name, *old, *new, "update", f"{told}, more than both uncertainties allow")
    if better:
        return Decision(name, *old, *new, "confirm", f"{told}: a new value would only add jitter")
    reason = f"{told} but is known no better than the value in use: it would only add jitter"
    return Decision(name, *old, *new, "keep", reason)
