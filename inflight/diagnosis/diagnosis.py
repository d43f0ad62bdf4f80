"""The result of a diagnosis: what was found, how sure it is, what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Verdict = Literal["FOUND", "CONFOUNDED", "NOT_IDENTIFIABLE", "UNKNOWN_EFFECT", "NOTHING_LEFT"]


@dataclass(frozen=True)
class Coefficient:
    """One number of an effect; `at` is a sensor, or ``difference`` of vector and reference."""

    name: str
    value: float
    sigma: float
    unit: str
    at: str

    @property
    def stands_out(self) -> bool:
        """True when it is three sigma from nothing."""
        return abs(self.value) > 3.0 * self.sigma > 0


@dataclass(frozen=True)
class FoundEffect:
    """An effect the search took, and how it stands."""

    name: str
    family: str
    channels: tuple[str, ...]
    axes: tuple[str, ...]
    coefficients: tuple[Coefficient, ...]
    gain: float
    t: float
    flip_p: float
    retained: float
    lag_s: float
    lag_sigma_s: float | None
    placebo_t: float
    consistency: float | None
    rms_nT: float  # noqa: N815 (a unit)
    rivals: tuple[str, ...] = ()
    at: tuple[str, ...] = ()
    at_sigma_s: float | None = None
    entries: tuple[Mapping[str, Any], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the fields as the command line prints them."""
        told = dict(vars(self))
        told["coefficients"] = [dict(vars(one)) for one in self.coefficients]
        told["beats_placebo"] = bool(self.placebo_t > 3.0)
        return told


@dataclass(frozen=True)
class Signature:
    """What an effect nobody knows looks like.

    `amplitude_nT` and `amplitudes` (by axis, with sigma) of a period are half of peak to peak of the folded
    curve; `steps` (by axis, with sigma) of one that switches are what it adds while it is on. Of what is too
    fast for the search, `amplitude_nT` is the rms; `faster_than_s` and `periods_s` (shortest, longest)
    bound it. Of a unit without housekeeping `switchings` tells how often two sensors saw it switch.
    """

    period_s: float | None = None
    channel: str | None = None
    lag_s: float | None = None
    axis: str | None = None
    shape: str | None = None
    amplitude_nT: float | None = None  # noqa: N815 (a unit)
    period_sigma_s: float | None = None
    duty: float | None = None
    amplitudes: Mapping[str, Sequence[float]] = field(default_factory=dict)
    gain: float | None = None
    steps: Mapping[str, Sequence[float]] = field(default_factory=dict)
    faster_than_s: float | None = None
    periods_s: tuple[float, float] | None = None
    switchings: int | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return dict(vars(self))


@dataclass(frozen=True)
class Diagnosis:
    """Verdict of a span and everything it rests on.

    Attributes
    ----------
    verdict : str
        About the residual as found.
    sentence : str
        What a physicist would say.
    effects : tuple of FoundEffect
        What the rounds took.
    confusion_set : tuple of dict
        When confounded: each effect's rivals with the t by which they lose.
    separating : tuple of dict
        Blocks or events in which the rivals differ most.
    unscorable : tuple of dict
        What these data cannot show, and why.
    signature : Signature or None
        Of an effect that is in no library.
    remaining : dict
        ``verdict`` and ``signature`` of what is left after the effects.
    residual : dict
        Sizes before and after, held out, and the noise floor with its interval; nT at the cadence of
        the comparison. ``uncorrected`` lists channels of the effects and the part of the record each is
        missing in: sizes are of the other rows.
    rounds : tuple of dict
        Ledger of additions and removals.
    candidates : tuple of dict
        The ranked table, best first.
    refined : tuple of dict
        Parameters of the model that the data moved within what was known of them.
    blocks : dict
        Number and length of the blocks, how many of them are independent, and the few that hold nearly all
        of the residual's square.
    outliers : dict
        Samples the evidence leaves out: how many, and when the first bursts of them were.
    """

    verdict: Verdict
    sentence: str
    effects: tuple[FoundEffect, ...]
    confusion_set: tuple[dict[str, Any], ...]
    separating: tuple[dict[str, Any], ...]
    unscorable: tuple[dict[str, Any], ...]
    signature: Signature | None
    remaining: dict[str, Any]
    residual: dict[str, Any]
    rounds: tuple[dict[str, Any], ...]
    candidates: tuple[dict[str, Any], ...]
    refined: tuple[dict[str, Any], ...]
    blocks: dict[str, Any]
    stopped: str = ""
    comparison: str = "main"
    model: dict[str, Any] = field(default_factory=dict)
    context: str = ""
    run: str = ""
    outliers: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the result as the command line prints it: plain numbers, null where there is none."""
        told = {
            name: value
            for name, value in vars(self).items()
            if name not in ("effects", "signature", "remaining", "context", "run")
        }
        told["effects"] = [one.as_json() for one in self.effects]
        told["signature"] = self.signature.as_json() if self.signature else None
        left = self.remaining.get("signature")
        told["remaining"] = {
            "verdict": self.remaining["verdict"],
            "signature": left.as_json() if left is not None else None,
        }
        whole: dict[str, Any] = plain(
            {"command": "diagnose", "run": self.run, "context": self.context, **told}
        )
        return whole


def plain(value: Any) -> Any:
    """Return a value as JSON has it; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
