"""What a change of the model did: residual before and after, and which other parameters moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from inflight.diagnosis.refit import Fitted
from inflight.model import Model, ModelEffect
from inflight.tasks.models import UsedModel

#: A parameter's uncertainty that changes by this factor tells of cross-talk made or removed.
_CROSS_TALK = 1.5


@dataclass
class Revision:
    """What a change of the model did.

    Attributes
    ----------
    command, effect : str
        What was asked for.
    model : UsedModel
        The new version.
    parent : int
        The version before.
    in_sample, held_out : tuple of float
        Residual before and after, nT rms at the cadence of the comparison.
    moved : list of dict
        Other parameters that moved, or whose uncertainty did.
    values : list of dict
        The effect's own numbers, when one was added.
    """

    command: str
    effect: str
    model: UsedModel
    parent: int
    in_sample: tuple[float, float]
    held_out: tuple[float, float]
    moved: list[dict[str, Any]]
    values: list[dict[str, Any]] = field(default_factory=list)
    run: str = ""
    context: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": self.command,
            "run": self.run,
            "context": self.context,
            "effect": self.effect,
            "model": {"name": self.model.model.name, "version": self.model.version, "parent": self.parent},
            "error": {"in_sample_nT": list(self.in_sample), "held_out_nT": list(self.held_out)},
            "moved": self.moved,
            "coefficients": self.values,
        }


def moved(before: Fitted, after: Fitted, units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the parameters of two fits that moved by more than a sigma, or whose sigma did.

    Parameters
    ----------
    units : mapping of str to str
        By the model's names.

    Returns
    -------
    list of dict
        ``parameter``, ``by``, ``sigma`` (after), ``sigma_before``, ``unit`` and ``why``: moved, cross-talk
        made or cross-talk removed. The calibration's parameters are means over its intervals.
    """
    found = []
    for was, now, was_sigma, sigma in (
        (before.value, after.value, before.sigma, after.sigma),
        (before.base_value, after.base_value, before.base_sigma, after.base_sigma),
    ):
        for name in (name for name in was if name in now):
            by = now[name] - was[name]
            why = _why(by, was_sigma[name], sigma[name])
            if why:
                plain = name.removeprefix("model:")
                told = {"parameter": plain, "by": by, "sigma": sigma[name], "sigma_before": was_sigma[name]}
                found.append(told | {"unit": units.get(plain, ""), "why": why})
    return sorted(found, key=lambda one: -abs(one["by"]) / max(one["sigma_before"], 1e-300))


def _why(by: float, was: float, now: float) -> str:
    if now > _CROSS_TALK * was:
        return "cross-talk made"
    if was > _CROSS_TALK * now:
        return "cross-talk removed"
    return "moved" if abs(by) > min(was, now) else ""


def numbers(model: Model, entries: Sequence[ModelEffect]) -> list[dict[str, Any]]:
    """Return the fitted numbers of some of a model's effects: name, value, sigma and unit."""
    return [
        {
            "name": name,
            "value": float(value),
            "sigma": float(sigma),
            # The growth of a trend is per day, as additions write it.
            "unit": timed.parameter.unit + ("/d" if name.endswith("*b") else ""),
        }
        for entry in entries
        for timed in model.effect(entry.name).parameters.values()
        for name, value, sigma in zip(timed.columns, timed.value.ravel(), timed.sigma.ravel(), strict=True)
        if 0 < sigma < np.inf
    ]
