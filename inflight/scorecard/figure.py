"""A published figure, what the software obtains for it, and the verdict that follows from the two.

Each module of the scorecard has its entries in `FIGURES`. They are made by three shorthands for ``Figure``,
by what the obtained value rests on: ``derived``, ``recovered`` and ``needs_data``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from inflight.errors import SettingsError
from inflight.scorecard.scene import SimulatedDays

EvidenceKind = Literal["derived", "recovered_from_injection", "measured", "needs_mission_data"]
Agreement = Literal["reproduced", "contradicted", "not reproducible", "needs data"]
#: Why a figure is reproduced that was put into simulated data and given back.
RECOVERED = "The estimator returns what was put in: this proves it, not the figure."
#: A number, or several that belong together.
Value = float | tuple[float, ...]


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
        Function of the `SimulatedDays` that works the value out; None when it cannot be.
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
    obtain: Callable[[SimulatedDays], Value] | None = None
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
            "tolerance": within,
            "basis": figure.basis,
            "verdict": self.verdict,
            "why": figure.why,
        }


def _as_tuple(value: Value) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)
