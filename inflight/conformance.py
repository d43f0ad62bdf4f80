"""Shared by the suites that check a plug-in: run every check, collect the faults, report them together.

See `inflight.effects.check_effect` and `inflight.catalog.readers.check_reader`.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from inflight.errors import ConformanceError


@dataclass
class Faults:
    """Faults of a plug-in, as sentences that each name what to mend."""

    found: list[str] = field(default_factory=list)

    def collect(self, check: Callable[..., Iterable[str]], *given: Any, where: str = "") -> None:
        """Run a check, which yields faults; an exception in it is a fault, too.

        Parameters
        ----------
        check : callable
            Its name, in words, begins each fault.
        where : str
            The case that is checked.
        """
        label = str(check.__name__).strip("_").replace("_", " ") + (f" ({where})" if where else "")
        try:
            for fault in check(*given):
                self.found.append(f"{label}: {fault}")
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            raised = f"raised {type(error).__name__}: {error}"
            self.found.append(f"{label}: {raised} (in {at.name}, line {at.lineno}); mend that first")

    def require_none(self, name: str, page: str) -> None:
        """Raise `ConformanceError` with all faults of a plug-in; `page` explains what it promises."""
        if self.found:
            listed = "\n".join(f"- {fault}" for fault in self.found)
            plural = "s" if len(self.found) > 1 else ""
            raise ConformanceError(
                f"{name} fails {len(self.found)} check{plural}:\n{listed}",
                remedy=f"{page} says what is promised",
            )
