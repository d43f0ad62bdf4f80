"""What the loop's page says: the state and the next step in one sentence, and candidates in words.

Takes a stored diagnosis and the versions of the model; makes plain text and rows, without widgets.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from inflight.diagnosis import LEFT, what_it_is
from inflight.figures import short_name, signature_facts
from inflight.residual import is_at_floor

Fields = Mapping[str, Any]
#: Gain that is left, in parts of the gain before, of a candidate that what was found explains; assumed.
_EXPLAINED = 0.1
#: Candidates told to resemble a signature at most, and the least part of the mean square they take off.
_NEAREST, _RESEMBLES = 3, 0.01
#: Why an effect of the model is not tried.
IN_MODEL = "in the model already"
#: Chance of a gain by chance that is no finding; stated.
_CHANCE = 0.05


@dataclass(frozen=True)
class CandidateRow:
    """A candidate as the table shows it.

    Attributes
    ----------
    name : str
        As `inflight add` takes it.
    words : str
        What it is.
    size_nT : float or None
        Rms it takes off days not used in the fit, alone; nT.
    sure : str
        How sure it is, in words.
    rivals : tuple of str
        What explains as much.
    reason : str
        Why it cannot be tried; empty when it can.
    """

    name: str
    words: str
    size_nT: float | None  # noqa: N815 (a unit)
    sure: str
    rivals: tuple[str, ...] = ()
    reason: str = ""


def candidate_rows(fields: Fields, effects: Sequence[str] = ()) -> list[CandidateRow]:
    """Return found effects first, then the ranking by size, then what cannot be tried.

    Parameters
    ----------
    fields : mapping
        As `Diagnosis.as_json`.
    effects : sequence of str
        Names of the model's own: they cannot be tried again.
    """
    scored = {one["name"]: one for one in fields["candidates"] if not one["placebo"]}
    parts = {one["name"]: one for one in [*fields["effects"], *scored.values()]}
    rows = []
    for entry in fields["entries"]:
        if entry["name"] not in parts:
            continue
        one = parts[entry["name"]]
        rows.append(
            CandidateRow(
                entry["name"],
                _words(one),
                entry["takes_off_nT"],
                entry["how_sure"],
                tuple(short_name(rival) for rival in entry["rivals"]),
            )
        )
    found = {row.name for row in rows}
    for name, one in sorted(scored.items(), key=lambda item: -item[1]["gain"]):
        if name not in found:
            size = one.get("takes_off_nT") if one["gain"] > 0 else 0.0
            rows.append(CandidateRow(name, _words(one), size, _sureness(one, bool(found))))
    known = set(effects)
    own = [replace(row, reason=IN_MODEL) for row in rows if _entry_name(row.name) in known]
    dead = [
        CandidateRow(one["name"], _words(one), None, "", reason=one["reason"]) for one in fields["unscorable"]
    ]
    return [row for row in rows if _entry_name(row.name) not in known] + own + dead


@dataclass(frozen=True)
class SignatureCard:
    """What is left that no effect of the library explains.

    Attributes
    ----------
    words : str
        What it looks like, and how sure that is.
    facts : tuple of (str, str)
        Period, axes, shape, size, lag: name and value.
    resembles : tuple of str
        Candidates that come nearest, with the part of the mean square each would take off; none was taken.
    effect : str
        What `inflight add` takes to put it into the model as an empirical effect; empty of what no term
        describes.
    """

    words: str
    facts: tuple[tuple[str, str], ...]
    resembles: tuple[str, ...]
    effect: str


def signature_card(fields: Fields, effects: Sequence[str] = ()) -> SignatureCard | None:
    """Return the signature of what a diagnosis leaves; None where only noise is left, or nothing is known.

    Parameters
    ----------
    fields : mapping
        As `Diagnosis.as_json`.
    effects : sequence of str
        Names of the model's own: what describes the signature is not added again.
    """
    signature = fields["remaining"]["signature"]
    if signature is None or fields["remaining"]["verdict"] == "NOTHING_LEFT":
        return None
    left = next((one for one in fields["entries"] if one["name"] == LEFT), None)
    words = f"{left['words']} ({left['how_sure']})" if left else "it is there, and these data hardly show it"
    effect = signature["added_by"].strip('"')
    if not effect and signature["channel"]:
        lag = f"@lag={signature['lag_s']:.4g}s" if signature["lag_s"] else ""
        effect = f"channel_field({signature['channel']}){lag}"
    if {_entry_name(effect), effect.partition("(")[0]} & set(effects):
        return None
    found = {one["name"] for one in fields["effects"]}
    near = [
        one
        for one in fields["candidates"]
        if not one["placebo"] and one["name"] not in found and one["gain_now"] > _RESEMBLES
    ]
    near.sort(key=lambda one: -one["gain_now"])
    resembles = tuple(f"{_words(one)} ({one['gain_now']:.0%})" for one in near[:_NEAREST])
    return SignatureCard(words, tuple(signature_facts(signature)), resembles, effect)


def _entry_name(candidate: str) -> str:
    """Return what the model calls a candidate that was added."""
    return re.sub(r"\W+", "_", candidate).strip("_")


def _words(one: Fields) -> str:
    """Return what a candidate is in words; what makes it a certain one of several follows in brackets."""
    words = what_it_is(one["name"], one["channels"], one["family"])
    _, at, rest = short_name(one["name"]).partition(", ")
    if not at and "@" in one["name"]:
        _, at, rest = short_name(one["name"]).partition(" ")
    return f"{words} ({rest})" if rest else words


def _sureness(one: Fields, found: bool) -> str:
    """Return how sure a candidate is that was not taken."""
    if one["gain"] <= 0 or one["p"] is None or one["p"] > _CHANCE:
        return "chance"
    if found and one["gain_now"] < _EXPLAINED * one["gain"]:
        return "explained by what was found"
    return f"{'not taken, ' if found else ''}p {one['p']:.1g}"


@dataclass(frozen=True)
class LoopState:
    """Where a comparison stands in the loop.

    Attributes
    ----------
    diagnosis : mapping or None
        The last one, as `ExplorerSession.last_diagnosis`.
    versions : sequence of mapping
        As `inflight.tasks.models.ModelHistory.items`.
    model : str
        Name and version of the model in use.
    stale_products, products : int
        Days that another model made; all days.
    instead : str
        What to do of a comparison that cannot be diagnosed; empty where it can.
    """

    diagnosis: Fields | None
    versions: Sequence[Fields]
    model: str
    stale_products: int
    products: int
    instead: str = ""

    @property
    def changes(self) -> list[dict[str, Any]]:
        """Versions that changed the residual, as `Revision.as_json` has a change."""
        return [
            {
                "command": "",
                "effect": one["message"],
                "model": {"name": one["name"], "version": one["version"], "parent": one["parent"]},
                "error": one["change"],
            }
            for one in self.versions
            if one["change"]
        ]

    @property
    def sizes(self) -> tuple[float | None, float | None]:
        """Residual of days not used in the fit with the model in use, and the noise floor; nT."""
        used = next((one for one in self.versions if one["used"]), None)
        if used is not None and used["change"]:
            change = used["change"]
            return change["held_out_nT"][1], change.get("noise_floor_nT")
        if self.diagnosis is not None and "stale" not in self.diagnosis:
            residual = self.diagnosis["residual"]
            return residual["held_out_before_nT"], residual["noise_floor_nT"]
        return None, None

    def sentences(self) -> tuple[str, str]:
        """Return the state and the next step."""
        size, floor = self.sizes
        state = f"{self.model[:1].upper()}{self.model[1:]}"
        if size is not None:
            state += f" leaves {size:.4g} nT rms of days not used in the fit"
            at = "at" if floor and is_at_floor(size, floor) else "above"
            state += f", {at} the noise floor of {floor:.4g} nT." if floor else ", and has no noise floor."
        elif self.instead:
            state += " is in use."
        else:
            state += ": what it leaves of days not used in a fit has not been measured yet."
        if self.stale_products:
            state += f" {self.stale_products} of {self.products} days of products are of another model."
        return state, self._next_step(size, floor)

    def _next_step(self, size: float | None, floor: float | None) -> str:
        found = self.diagnosis
        reprocess = "Reprocess: products of the model in use. " if self.stale_products else ""
        if self.instead or found is None:
            return f"{reprocess}{self.instead}" if self.instead else "Diagnose: it ranks what may be missing."
        if "stale" in found:
            if size and floor and is_at_floor(size, floor):
                return f"{reprocess}Diagnose: it confirms that nothing is left."
            return "Diagnose again: what is ranked here was measured with another model."
        named = next((one for one in found["entries"] if one["command"]), None)
        if named is not None:
            return f"Try what is missing: {named['words']} ({named['how_sure']}). Then Add it."
        if found["verdict"] == "NOTHING_LEFT":
            return reprocess or "nothing, what is left is noise."
        return str(found.get("headline") or found["sentence"])
