"""What one kind of case is made of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Scenario:
    """One kind of case; a seed draws everything else.

    `hidden` names causes of `causes.CAUSE_SETTINGS`; `orbit` is one of `case.ORBITS`; `attitude`
    one of `orbit.ATTITUDES` or empty for any; `size` is the range of the contribution the nine
    parameters leave, in tenths of the noise (a gain of 1 % is what is called detectable). `wrong` names a
    cause that the model knows by wrong numbers, off by that size; where `held`, it states no sigma of them.
    `number` is one of `held.draw_held`: an effect the model knows by a wrong lag, width, delay or reference.
    """

    name: str
    hidden: tuple[str, ...] = ()
    days: int = 30
    verdicts: tuple[str, ...] = ("FOUND", "CONFOUNDED")
    orbit: str = "any"
    attitude: str = ""
    decoys: int = 6
    size: tuple[float, float] = (3.0, 20.0)
    known: int = 2
    opaque: bool = False
    kinds: bool = True
    cadences: bool = False
    gaps: float = 0.002
    outliers: float = 0.0
    red: float = 0.0
    near_copy: bool = False
    files: bool = False
    wrong: str = ""
    number: str = ""
    held: bool = False
