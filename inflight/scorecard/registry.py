"""All figures in order, and the selection of some.

A new figure is one `Figure(...)` in the tuple of its module; a new module is one line in `_MODULES`.
"""

from __future__ import annotations

from collections.abc import Sequence

from inflight.errors import SettingsError
from inflight.progress import Progress, silent, tell_each
from inflight.scorecard import (
    continuous_parameters,
    day_and_night,
    recovered_fields,
    recovered_parameters,
    recovered_residual,
    residual,
    scalar_calibration,
    spacecraft_fields,
    spin_angles,
    spin_tones,
    two_sensors,
    zero_levels,
)
from inflight.scorecard.figure import PublishedFigure, ScorecardResult
from inflight.scorecard.scene import SimulatedDays

#: Sections and what they are about, in order.
SECTIONS = {
    "scalar-calibration": "Scalar calibration of a vector magnetometer (Yin 2010, chapter 2)",
    "continuous-parameters": "Continuous parameters (Yin 2010, chapter 3)",
    "spacecraft-fields": "Fields of the spacecraft (Yin 2010, section 3.4)",
    "residual": "What the residual tells (Yin 2010, chapter 4)",
    "spin": "Calibration from the spin (Farrell et al. 1995, Plaschke et al. 2019)",
    "two-sensors": "States of a spacecraft with two sensors (Venus Express)",
    "zero-level": "Zero levels from nature's statistics (Hedgecock; IMP-8 and Helios)",
}
_MODULES = (
    scalar_calibration,
    continuous_parameters,
    spacecraft_fields,
    residual,
    day_and_night,
    recovered_parameters,
    recovered_fields,
    recovered_residual,
    spin_angles,
    spin_tones,
    two_sensors,
    zero_levels,
)


def figures() -> tuple[PublishedFigure, ...]:
    """Return every figure, section by section."""
    order = list(SECTIONS)
    every = [figure for module in _MODULES for figure in module.FIGURES]
    return tuple(sorted(every, key=lambda figure: order.index(figure.section)))


def select_figures(only: Sequence[str] = (), section: str | None = None) -> tuple[PublishedFigure, ...]:
    """Return some figures.

    Parameters
    ----------
    only : sequence of str
        Ids, or beginnings of ids up to a dot: ``lag`` selects ``lag.xz``. All when empty.
    section : str, optional
        Key of `SECTIONS`.

    Raises
    ------
    SettingsError
        When there is no such section, or an id selects nothing.
    """
    if section is not None and section not in SECTIONS:
        raise SettingsError(f"there is no section {section!r}", remedy=f"choose one of {', '.join(SECTIONS)}")
    found = [figure for figure in figures() if section in (None, figure.section)]
    for wanted in only:
        if not any(_selects(wanted, figure) for figure in found):
            raise SettingsError(
                f"there is no figure {wanted!r}",
                remedy=f"choose of {', '.join(figure.id for figure in found)}",
            )
    return tuple(figure for figure in found if not only or any(_selects(one, figure) for one in only))


def _selects(wanted: str, figure: PublishedFigure) -> bool:
    return figure.id == wanted or figure.id.startswith(f"{wanted}.")


def run_scorecard(
    only: Sequence[str] = (), section: str | None = None, progress: Progress = silent
) -> list[ScorecardResult]:
    """Work out figures, now: what several need is made once.

    Parameters
    ----------
    only, section
        As `select_figures` takes them.
    progress : callable, optional
        Called with ("figures", done, total).
    """
    scene = SimulatedDays()
    return [figure.report(scene) for figure in tell_each(progress, "figures", select_figures(only, section))]
