"""One sentence a physicist would say."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from inflight.diagnosis.diagnosis import FoundEffect, Signature
from inflight.lines import told_period


def sentence(told: Mapping[str, Any]) -> str:
    """Return what a diagnosis means, in one or two sentences."""
    residual = told["residual"]
    sizes = (
        f"held-out residual {residual['held_out_before_nT']:.3g} -> {residual['held_out_after_nT']:.3g} nT, "
        f"noise floor {_size(residual['noise_floor_nT'])}"
    )
    parts = [_of_effect(effect) for effect in told["effects"]]
    if parts:
        text = "; ".join(parts)
        text = f"{text[0].upper()}{text[1:]} ({sizes})."
        if told["remaining"] == "UNKNOWN_EFFECT":
            text += f" Something is left: {_of_signature(told['signature'])}."
        return text
    return {
        "NOTHING_LEFT": lambda: f"Nothing is left to explain: the residual is noise ({sizes}).",
        "NOT_IDENTIFIABLE": lambda: (
            "Something is there, but these data are too short to say what: "
            f"{told['blocks']['independent']:.0f} independent blocks ({sizes})."
        ),
        "UNKNOWN_EFFECT": lambda: (
            f"No effect of the library explains it: {_of_signature(told['signature'])} ({sizes})."
        ),
    }[told["remaining"]]()


def _size(nanotesla: float) -> str:
    return f"{nanotesla:.3g} nT" if isfinite(nanotesla) else "unknown"


def _article(word: str) -> str:
    return f"an {word}" if word[0] in "aeiou" else f"a {word}"


def _of_effect(effect: FoundEffect) -> str:
    what = f"{_article(effect.family.replace('_', ' '))} effect"
    cause = f" that follows {' and '.join(effect.channels)}" if effect.channels else ""
    if effect.at:
        times = [one.rstrip("Z").removesuffix(":00").replace("T", " ") for one in effect.at]
        cause += f" from {' to '.join(times)}"
        cause += f" +- {told_period(effect.at_sigma_s)}" if effect.at_sigma_s else ""
    lag = f" with a lag of {effect.lag_s:.3g} s" if effect.lag_s > 0 else ""
    axes = f" on {', '.join(effect.axes)}" if effect.axes else ""
    text = f"{what}{cause}{lag}{axes}, {effect.rms_nT:.3g} nT rms ({effect.name})"
    if effect.rivals:
        text += f", which these data cannot tell from {', '.join(effect.rivals[:4])}"
    return text


def _of_signature(signature: Signature | None) -> str:
    if signature is None:
        return "structure without a clear shape"
    if signature.period_s:
        where = f"on axis {signature.axis}" if signature.axis else "along the field"
        text = f"it repeats every {signature.period_s:.5g} s {where}, {signature.amplitude_nT:.3g} nT"
        return text + (
            f", like a {signature.shape} wave" if signature.shape in ("sine", "square", "pulse") else ""
        )
    if signature.channel:
        text = f"it looks most like something that follows {signature.channel}"
        return (
            text
            + (f" with a lag of {signature.lag_s:.3g} s" if signature.lag_s else "")
            + ", but not beyond doubt"
        )
    if signature.gain:
        kind = (signature.shape or "").replace("_", " ")
        return f"it looks most like a {kind} (held-out gain {signature.gain:.0%}), but not beyond doubt"
    return f"slow structure of {signature.amplitude_nT:.3g} nT without a shape"


def stopped(told: Mapping[str, Any], rounds: int, most: int) -> str:
    """Return why the rounds ended."""
    if most == 0:
        return "no rounds were asked for"
    if rounds >= most:
        return f"the limit of {most} additions was reached; raise it to go on"
    if told["remaining"] == "NOTHING_LEFT":
        return "what is left is noise"
    if told["remaining"] == "NOT_IDENTIFIABLE":
        return "too few independent blocks to tell causes apart"
    return "no candidate is beyond doubt: held-out gain, sign flips and placebos must all agree"
