"""A published figure, what the software obtains for it, and the verdict that follows from the two.

Each module of the scorecard has its entries in `FIGURES`. They are made by three shorthands for ``Figure``,
by what the obtained value rests on: ``derived``, ``recovered`` and ``needs_data``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from inflight.arrays import Floats
from inflight.errors import SettingsError
from inflight.scorecard.scene import SimulatedDays

EvidenceKind = Literal["derived", "recovered_from_injection", "measured", "needs_mission_data"]
Agreement = Literal["reproduced", "contradicted", "not reproducible", "needs data"]
#: Why a figure is reproduced that was put into simulated data and given back.
RECOVERED = "The estimator returns what was put in: this proves it, not the figure."
#: A number, or several that belong together.
Value = float | tuple[float, ...]
#: Own sigmas by which a recovered value may be off: one of 16,000 right ones is further.
OWN_SIGMAS = 4.0


@dataclass(frozen=True)
class Estimate:
    """Values that an estimator returned, with the sigma that it states of each.

    Attributes
    ----------
    value, sigma : tuple of float
    """

    value: tuple[float, ...]
    sigma: tuple[float, ...]

    @classmethod
    def of(cls, value: Floats | float, sigma: Floats | float) -> Estimate:
        """Return an estimate of arrays of any shape, or of numbers."""
        return cls(*(tuple(np.ravel(one).tolist()) for one in (value, sigma)))

    @classmethod
    def mean(cls, each: Sequence[Estimate]) -> Estimate:
        """Return the mean of independent estimates."""
        sigma = np.sqrt(np.sum(np.square([one.sigma for one in each]), axis=0)) / len(each)
        return cls.of(np.mean([one.value for one in each], axis=0), sigma)

    def part(self, which: slice) -> Estimate:
        """Return some of the values."""
        return Estimate(self.value[which], self.sigma[which])

    def times(self, factor: float) -> Estimate:
        """Return the estimate in another unit, or at another place."""
        return Estimate.of(factor * np.array(self.value), abs(factor) * np.array(self.sigma))


@dataclass(frozen=True)
class ToleranceInterval:
    """An interval as tolerance: the obtained value must lie in it, its ends included."""

    low: float
    high: float


#: Largest distance of each obtained number from the published one, or where it must lie.
Tolerance = float | tuple[float, ...] | ToleranceInterval


@dataclass(frozen=True, kw_only=True)
class PublishedFigure:
    """One figure of the literature; nothing of it is an obtained value.

    Attributes
    ----------
    id : str
        Short and stable: ``--only`` selects by it, or by its beginning.
    section : str
        Key of `inflight.scorecard.SECTIONS`.
    what : str
        What the number is, without its value.
    unit : str
    source : str
        Where it is printed, or what makes one expect it when `printed` is False.
    published : float or tuple of float
        As the source prints it.
    tolerance : float, tuple of float or Within
        The source's own error or last digit, else the scatter over days or seeds.
    basis : str
        What the obtained value rests on, see `EvidenceKind`.
    why : str
        One sentence on the verdict.
    obtain : callable, optional
        Function of the `SimulatedDays` that works the value out; None when it cannot be. With an `Estimate`,
        each value must also lie within `OWN_SIGMAS` of the sigma that its estimator states.
    nominal : float or tuple of float, optional
        What an estimator returns that learns nothing from the data: the ground's value, no field, no shift.
        It must not be reproduced. For figures recovered from an injection.
    printed : bool
        Whether the source prints the number; otherwise it is what theory or geometry makes one expect.
    """

    id: str
    section: str
    what: str
    unit: str
    source: str
    published: Value
    tolerance: Tolerance
    basis: EvidenceKind
    why: str
    obtain: Callable[[SimulatedDays], Value | Estimate] | None = None
    nominal: Value | None = None
    printed: bool = True

    def __post_init__(self) -> None:
        if self.basis in ("recovered_from_injection", "measured") and self.obtain is None:
            raise SettingsError(
                f"figure '{self.id}' is {self.basis} but nothing obtains it", remedy="give 'obtain'"
            )
        if isinstance(self.tolerance, tuple) and len(self.tolerance) != len(_as_tuple(self.published)):
            raise SettingsError(
                f"figure '{self.id}' has {len(_as_tuple(self.published))} numbers and "
                f"{len(self.tolerance)} tolerances",
                remedy="give one, or as many",
            )

    def report(self, scene: SimulatedDays) -> ScorecardResult:
        """Work the figure out."""
        obtained = self.obtain(scene) if self.obtain else None
        if isinstance(obtained, Estimate):
            return ScorecardResult(self, obtained.value, obtained.sigma)
        if isinstance(obtained, tuple):
            obtained = tuple(float(one) for one in obtained)
        elif obtained is not None:
            obtained = float(obtained)
        return ScorecardResult(self, obtained)


@dataclass(frozen=True)
class ScorecardResult:
    """A figure and what was obtained just now; the verdict follows from both."""

    figure: PublishedFigure
    obtained: Value | None
    sigma: tuple[float, ...] | None = None

    @property
    def verdict(self) -> Agreement:
        """Return the verdict.

        ``needs data`` and ``not reproducible`` (the source does not say enough) where nothing can be
        obtained; ``reproduced`` when every number lies within its tolerance; else ``contradicted``.
        """
        if self.obtained is None:
            return "needs data" if self.figure.basis == "needs_mission_data" else "not reproducible"
        return "reproduced" if self._agrees(_as_tuple(self.obtained)) else "contradicted"

    def _agrees(self, obtained: tuple[float, ...]) -> bool:
        published, tolerance = _as_tuple(self.figure.published), self.figure.tolerance
        if isinstance(tolerance, ToleranceInterval):
            return all(tolerance.low <= one <= tolerance.high for one in obtained)
        if len(obtained) != len(published):
            return False
        reach = tolerance if isinstance(tolerance, tuple) else (tolerance,) * len(published)
        if self.sigma is not None:
            # Of a NaN, the minimum is one: a sigma that is not there holds nothing.
            reach = tuple(np.minimum(reach, OWN_SIGMAS * np.array(self.sigma)).tolist())
        # A number that is not there is not near to anything: NaN compares as False.
        return all(
            abs(one - other) <= far for one, other, far in zip(obtained, published, reach, strict=True)
        )

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name; an interval of tolerance is an object with ``low`` and ``high``."""
        figure, tolerance = self.figure, self.figure.tolerance
        if isinstance(tolerance, ToleranceInterval):
            within: Any = {"low": tolerance.low, "high": tolerance.high}
        else:
            within = tolerance
        return {
            "id": figure.id,
            "section": figure.section,
            "what": figure.what,
            "unit": figure.unit,
            "source": figure.source,
            "printed": figure.printed,
            "published": figure.published,
            "obtained": self.obtained,
            "sigma": self.sigma,
            "tolerance": within,
            "basis": figure.basis,
            "verdict": self.verdict,
            "why": figure.why,
        }


def _as_tuple(value: Value) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)
