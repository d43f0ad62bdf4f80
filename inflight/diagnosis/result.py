"""The result of a diagnosis: what was found, how sure it is, what remains, and the sentence about it.

Takes numbers and names from `inflight.diagnosis.verdict`; makes records that print themselves as JSON
(`Diagnosis.as_json`) and one or two sentences (`sentence`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, sqrt
from typing import Any, Literal

import numpy as np

from inflight.diagnosis.words import fall_text, numbers_text, quantity, what_it_is
from inflight.residual import above_floor, format_period

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


@dataclass(frozen=True, kw_only=True)
class Turn:
    """A choice that turns an effect over.

    Attributes
    ----------
    choice : str
        In words that follow "fragile:", such as ``with blocks of twice the length``.
    rival : str
        What explains more then; empty when the values move.
    t : float
        By which the rival leaves less, or the largest movement of a value, in sigmas.
    """

    choice: str
    rival: str = ""
    t: float = 0.0

    @property
    def words(self) -> str:
        """What happens, in words."""
        if self.rival:
            return f"{self.choice} {self.rival} explains more (t = {self.t:.1f})"
        return f"{self.choice} its values are {self.t:.1f} sigma away"

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return dict(vars(self))


@dataclass(frozen=True, kw_only=True)
class FoundEffect:
    """An effect the search took: values with errors, significance, and rivals.

    `status` is that of its `Entry`, `first_in_nT` what it explains without the others (rms). `cadence_s` is
    that of the samples its coefficients were estimated from; `cadence_shift` by how many sigmas of that fit
    the search's own cadence puts the one furthest from them (None where both are one); sigmas reach so far.
    `model_effects` are the effects of the model that use its channel already, or are of its kind. `said` is
    what it does in words, where family and channels do not say it. `left_follows` is what of the same or of
    related channels is left still follows: the effect may stand in for another form. `instead` is what alone
    does as well as it and other effects together. `stamp_readings` are
    what a clock error may be instead. `command` is what mends a number that the model holds. `turned_over_by`
    are choices of numbers that give another answer. Noise of `noise_of`, a channel or the field, made the
    values smaller by `noise_part` at most; it is in them no more. `shares_line`: it has the period of the
    line that is left, too.
    """

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
    cadence_s: float = 0.0
    cadence_shift: float | None = None
    status: Status = "sure"
    first_in_nT: float | None = None  # noqa: N815 (a unit)
    model_effects: tuple[str, ...] = ()
    said: str = ""
    left_follows: str = ""
    instead: str = ""
    stamp_readings: tuple[str, ...] = ()
    turned_over_by: tuple[Turn, ...] = ()
    noise_of: str | None = None
    noise_part: float | None = None
    command: str = ""
    shares_line: bool = False

    def as_json(self) -> dict[str, Any]:
        """Return the fields as the command line prints them."""
        facts = dict(vars(self))
        facts["coefficients"] = [dict(vars(one)) for one in self.coefficients]
        facts["turned_over_by"] = [one.as_json() for one in self.turned_over_by]
        facts["beats_placebo"] = bool(self.placebo_t > 3.0)
        return facts


#: What each verdict means to somebody who reads it for the first time.
MEANING: dict[Verdict, str] = {
    "FOUND": "the largest effect is beyond doubt, and nothing else explains it as well",
    "CONFOUNDED": (
        "the largest effect is there, but causes look alike, or change with blocks and cadence: these data "
        "cannot tell them apart"
    ),
    "NOT_IDENTIFIABLE": "something is there; these data cannot say what",
    "UNKNOWN_EFFECT": "most of what is there no effect of the library explains",
    "NOTHING_LEFT": "only noise remains",
}

#: A verdict in the words of a heading: what a person reads in its place.
HEADING: dict[Verdict, str] = {
    "FOUND": "found: the largest cause is beyond doubt",
    "CONFOUNDED": "found, but causes look alike",
    "NOT_IDENTIFIABLE": "something is there; these data cannot say what",
    "UNKNOWN_EFFECT": "something is there that no effect of the library explains",
    "NOTHING_LEFT": "only noise remains",
}

#: How sure an entry is: of its cause; that something is there, with rivals named, or with as much left that
#: no effect explains, or with another answer where numbers are chosen otherwise; hardly; without a cause.
Status = Literal["sure", "rivals", "stand-in", "fragile", "weak", "unknown"]


#: The same in words.
HOW_SURE: dict[Status, str] = {
    "sure": "sure",
    "rivals": "something is there; causes look alike",
    "stand-in": "something is there; it may stand in for a part of what is left",
    "fragile": "something is there; another choice of numbers turns it over",
    "weak": "weak: hardly more than chance",
    "unknown": "sure; no cause in the library",
}


#: The same as a sentence, where an entry's own words do not say it.
_SURE_SENTENCE: dict[Status, str] = {
    "sure": "Sure: nothing else explains it as well",
    "stand-in": "As much is left that has no cause: it may stand in for a part of that",
    "weak": "Weak: hardly more than chance",
    "unknown": "No effect of the library is its cause",
}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One thing that is in the residual: an effect that was taken, or what remains after them all.

    Attributes
    ----------
    name : str
        Of the effect; ``what is left`` of what remains.
    words : str
        What it is, for a physicist.
    status : str
        ``sure``: this cause, and nothing else explains it as well. ``rivals``: something is there, and these
        data cannot tell which of several causes. ``stand-in``: what is left is as large and has no shape of
        its own: both may be one cause, which the library lacks. ``fragile``: with other blocks, folds or
        another cadence another cause explains more, or its values are elsewhere. ``weak``: were its gain one
        sigma smaller, it would not have been taken. ``unknown``: something is there, and no effect of the
        library is its cause.
    takes_off_nT : float
        Rms of what it alone explains when all others are in the model, or of the structure that is left; nT.
    first_in_nT : float or None
        Rms of what it explains without the others, nT.
    last_in_gain, last_in_t : float or None
        Part of the mean square it takes off with all others in the model, on days not used in the fit.
    rivals : tuple of str
    command : str
        What acts on it; empty when nothing has to be done.
    followed : bool
        Published products follow it already, though the model does not.
    """

    name: str
    words: str
    status: Status
    takes_off_nT: float  # noqa: N815 (a unit)
    first_in_nT: float | None = None  # noqa: N815 (a unit)
    last_in_gain: float | None = None
    last_in_t: float | None = None
    rivals: tuple[str, ...] = ()
    command: str = ""
    followed: bool = False

    @property
    def verdict(self) -> Verdict:
        """The machine name of what it says when it leads."""
        names: dict[Status, Verdict] = {
            "sure": "FOUND",
            "rivals": "CONFOUNDED",
            "stand-in": "CONFOUNDED",
            "fragile": "CONFOUNDED",
            "weak": "NOT_IDENTIFIABLE",
            "unknown": "UNKNOWN_EFFECT",
        }
        return names[self.status]

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name, and `status` in words."""
        sure = HOW_SURE[self.status] + ("; the products follow it" if self.followed else "")
        return {**vars(self), "how_sure": sure}


#: Name of the entry of what remains after everything that was taken.
LEFT = "what is left"
#: Name of the entry of scale factors that change steadily, which a fit of all days follows by itself.
SCALE_DRIFT = "scale_drift"


@dataclass(frozen=True, kw_only=True)
class Signature:
    """Signature of an effect that is in no library.

    `amplitude_nT` and `amplitudes` (by axis, with sigma) of a period are half of peak to peak of the folded
    curve; `steps` (by axis, with sigma) of one that switches are what it adds while it is on. Of what is too
    fast for the search, `amplitude_nT` is the rms; `faster_than_s` and `periods_s` (shortest, longest)
    bound it. Of a unit without housekeeping `switchings` counts how often two sensors saw it switch.
    `added_by` is what ``inflight add`` takes to put it into the model as an empirical effect; empty of what
    no term describes.
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
    added_by: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return dict(vars(self))


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Verdict of a span and everything it rests on.

    Attributes
    ----------
    verdict : str
        Of the leading entry; of the residual itself when nothing is in it.
    entries : tuple of Entry
        Everything that is in the residual, the largest first.
    sentence : str
        One or two sentences for a physicist.
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
        ``verdict`` and ``signature`` of what remains after the effects.
    residual : dict
        Sizes before and after, held out, and the noise floor with its interval; nT at the cadence of
        the comparison. ``shadow_edges_nT`` is what was fitted at the edges of the Earth's shadow, which
        are known to some kilometres, beside what follows it. ``uncorrected`` lists channels of the
        effects and the part of the record each is missing in: sizes are of the other rows.
    rounds : tuple of dict
        Ledger of additions and removals.
    candidates : tuple of dict
        The ranked table, best first.
    refined : tuple of dict
        Parameters of the model that the data moved within what was known of them.
    in_time : tuple of dict
        How each parameter of the calibration depends on time: ``form`` constant, drift, steps or irregular,
        and what it takes off of blocks held out, every k-th of them and in runs.
    blocks : dict
        Number and length of the blocks, how many of them are independent, and the few that hold nearly all
        of the residual's square.
    outliers : dict
        Samples that the Gram blocks skip: how many, and when the first bursts of them were.
    plumbing : tuple of dict
        Faults of units, clocks, axes and channels (`inflight.plumbing.Finding`), told before all else.
    """

    verdict: Verdict
    sentence: str
    entries: tuple[Entry, ...]
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
    in_time: tuple[dict[str, Any], ...] = ()
    plumbing: tuple[Mapping[str, Any], ...] = ()

    @property
    def headline(self) -> str:
        """What leads, and how sure that is, in one sentence."""
        if self.plumbing:
            return f"Mend the data first: {self.plumbing[0]['sentence']}."
        if not self.entries:
            return self.sentence.partition(". ")[0].rstrip(".") + "."
        lead = self.entries[0]
        text = f"{lead.words[0].upper()}{lead.words[1:]}"
        if lead.name == LEFT and lead.status == "weak":
            return f"Something is there, {lead.takes_off_nT:.2g} nT rms, but {lead.words}."
        # What other causes do as well, and what turns an answer over, stands in its words.
        told = ("stand in for", "parts of one cause")
        is_told = lead.status in ("rivals", "fragile") or any(one in lead.words for one in told)
        more = "" if is_told else f". {_SURE_SENTENCE[lead.status]}"
        return f"{text}{more}."

    def after_plumbing(self, found: Sequence[Mapping[str, Any]]) -> Diagnosis:
        """Return the diagnosis with faults of plumbing at its head: physics waits until they are mended."""
        if not found:
            return self
        faults = " ".join(f"{one['sentence']}." for one in found)
        text = f"Mend the data first. {faults} Until then what follows is not to be trusted. {self.sentence}"
        return replace(self, plumbing=tuple(found), sentence=text)

    def with_products(self, trend: str) -> Diagnosis:
        """Return the diagnosis with a drift of the scale factors as nothing to add, where products follow it.

        Parameters
        ----------
        trend : str
            Kind of the trend that the products' scale factors have; empty of products without one. The
            search itself fits one value a window of days.
        """
        if not trend or all(one.name != SCALE_DRIFT for one in self.entries):
            return self
        entries = tuple(
            replace(one, command="", followed=True) if one.name == SCALE_DRIFT else one
            for one in self.entries
        )
        text = (
            f"{self.sentence} The published products follow the drift of the scale factors already: they are "
            f"of a fit of all days with a {trend} trend."
        )
        return replace(self, entries=entries, sentence=text)

    def as_json(self) -> dict[str, Any]:
        """Return the result as the command line prints it: plain numbers, null where there is none."""
        facts = {
            name: value
            for name, value in vars(self).items()
            if name not in ("entries", "effects", "signature", "remaining", "context", "run")
        }
        facts["meaning"] = MEANING[self.verdict]
        facts["headline"] = self.headline
        facts["entries"] = [one.as_json() for one in self.entries]
        facts["effects"] = [one.as_json() for one in self.effects]
        facts["signature"] = self.signature.as_json() if self.signature else None
        remaining = self.remaining.get("signature")
        facts["remaining"] = {
            "verdict": self.remaining["verdict"],
            "signature": remaining.as_json() if remaining is not None else None,
        }
        whole: dict[str, Any] = plain_json(
            {"command": "diagnose", "run": self.run, "context": self.context, **facts}
        )
        return whole


def plain_json(value: Any) -> Any:
    """Return a value as JSON has it; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain_json(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain_json(value.tolist())
    if isinstance(value, np.generic):
        return plain_json(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


@dataclass(frozen=True, kw_only=True)
class SentenceSettings:
    """What a sentence mentions.

    Attributes
    ----------
    sigmas : float
        Sigmas from which an axis is named: three.
    spans, rivals : int
        Spans of blocks, and rivals, that are listed; assumed.
    large_part : float
        Part of the smallest effect, or of the noise floor, that is a large part of it; assumed.
    missing : float
        Part of a record that lacks a channel from which on it is mentioned; assumed.
    related : float
        Correlation with a cause that nobody recorded that a channel of the same period may have; assumed.
    """

    sigmas: float = 3.0
    spans: int = 4
    rivals: int = 4
    large_part: float = 0.5
    missing: float = 0.01
    related: float = 0.95


SENTENCE_SETTINGS = SentenceSettings()

#: Mechanisms that are mentioned when the data could not have shown them.
MECHANISMS = ("bias", "induced", "remanent", "soft_iron", "heading")


def sentence(facts: Mapping[str, Any]) -> str:
    """Return what a diagnosis means, in one or two sentences."""
    residual = facts["residual"]
    floor = residual["noise_floor_nT"]
    held_out = fall_text(residual["held_out_before_nT"], residual["held_out_after_nT"])
    noise = f"{floor:.3g} nT" if isfinite(floor) else "unknown"
    sizes = f"residual {held_out} nT on days not used in the fit, noise floor {noise}"
    bursts = _burst_text(facts.get("outliers", {})) + _lost_text(facts["blocks"].get("lost", {}))
    entries = ranked_entries(facts)
    parts = [entry.words for entry in entries if entry.name != LEFT]
    if parts:
        rest = next((entry for entry in entries if entry.name == LEFT and entry.status == "unknown"), None)
        text = "; ".join(parts)
        if rest is not None and entries[0] is rest:
            text = (
                f"Most of what is there no effect of the library explains: {rest.words}, "
                f"{rest.takes_off_nT:.3g} nT rms; beside it, {text} ({sizes})."
            )
        else:
            text = f"{text[0].upper()}{text[1:]} ({sizes})."
            text += f" Something is left, {rest.takes_off_nT:.3g} nT rms: {rest.words}." if rest else ""
        text += _substitute_text(facts) if rest else ""
        text += _gap_text(residual.get("uncorrected", ()))
        return text + bursts + _empirical_text(facts)
    # Whole mechanisms that these data cannot show, whether they are there or not.
    names = [str(one["name"]) for one in facts.get("unscorable", ())]
    hidden = ", ".join(name.replace("_", " ") for name in names if name in MECHANISMS)
    not_shown = f" These data could not have shown: {hidden}." if hidden else ""
    return (
        {
            "NOTHING_LEFT": lambda: f"{_noise_text(residual)} ({sizes}).{not_shown}",
            "NOT_IDENTIFIABLE": lambda: f"Something is there, but {why_not_identifiable(facts)} ({sizes}).",
            "UNKNOWN_EFFECT": lambda: (
                f"No effect of the library explains it: {_signature_text(facts['signature'])} ({sizes})."
            ),
        }[facts["remaining"]]()
        + bursts
        + _empirical_text(facts)
    )


def _empirical_text(facts: Mapping[str, Any]) -> str:
    """Return which effects the model holds for what they look like: their causes are still to be found."""
    names = facts.get("empirical", ())
    return f" In the model without a known cause: {', '.join(names)}." if names else ""


def ranked_entries(facts: Mapping[str, Any]) -> tuple[Entry, ...]:
    """Return everything that is in the residual, the largest first; what is left comes last when unsure."""
    found = [
        Entry(
            name=one.name,
            words=_effect_text(one),
            status=one.status,
            takes_off_nT=one.rms_nT,
            first_in_nT=one.first_in_nT,
            last_in_gain=one.gain,
            last_in_t=one.t,
            rivals=one.rivals,
            command=one.command or f'inflight add "{one.name}"',
        )
        for one in facts["effects"]
    ]
    found += _wrong_numbers(facts)
    size = _size_left(facts["residual"], facts["signature"]) if facts["remaining"] != "NOTHING_LEFT" else 0.0
    sharing = {one.name for one in facts["effects"] if one.shares_line}
    found = _mark_stand_ins(found, size, _has_own_shape(facts["signature"]), sharing)
    found.sort(key=lambda one: -one.takes_off_nT)
    if facts["remaining"] == "NOTHING_LEFT":
        return tuple(found)
    sure = facts["remaining"] == "UNKNOWN_EFFECT"
    left = Entry(
        name=LEFT,
        words=_signature_text(facts["signature"]) if sure else why_not_identifiable(facts),
        status="unknown" if sure else "weak",
        takes_off_nT=size,
        command=_command_left(facts["signature"]) if sure else "inflight compare",
    )
    place = sum(one.takes_off_nT >= left.takes_off_nT for one in found) if sure else len(found)
    return (*found[:place], left, *found[place:])


def _mark_stand_ins(
    found: Sequence[Entry], left_nT: float, has_own_shape: bool, sharing: set[str]
) -> list[Entry]:
    """Return the entries, those that may be parts of what has no cause told as such.

    Without a cause are what is left, shapes and what is weak; not how the calibration changes in time. An
    effect that explains no more than they do may be a part of them; but a line, a fast band or a unit that
    switches is no slow effect's. An effect that has the period of the line itself (`sharing`) may be a part
    unless it explains so much more that its channel would be nearly the cause's own.
    """
    without = [
        one for one in found if one.status in ("unknown", "weak") and not one.name.startswith("wander(")
    ]
    known = sum(one.takes_off_nT**2 for one in without)
    size = sqrt(known + (0.0 if has_own_shape else left_nT**2))
    # A channel of correlation r with the cause explains r / sqrt(1 - r^2) of what it leaves.
    related = SENTENCE_SETTINGS.related / sqrt(1.0 - SENTENCE_SETTINGS.related**2) * left_nT
    return [
        replace(one, status="stand-in")
        if one.status == "sure"
        and 0 < one.takes_off_nT <= (max(size, related) if one.name in sharing else size)
        else one
        for one in found
    ]


def _has_own_shape(signature: Signature | None) -> bool:
    """Return True when what is left is a line, a fast band or a unit that switches: no slow effect is."""
    return signature is not None and bool(
        signature.period_s or signature.faster_than_s or signature.switchings
    )


def _command_left(signature: Signature | None) -> str:
    """Return the command that puts what is left into the model for what it looks like, or looks at it."""
    if signature is None or not signature.added_by:
        return "inflight compare"
    return f"inflight add {signature.added_by}"


def _wrong_numbers(facts: Mapping[str, Any]) -> list[Entry]:
    """Return the parameters of the model that data moved further than what was stated of them allows."""
    parameters: dict[str, list[Mapping[str, Any]]] = {}
    for one in facts.get("refined", ()):
        parameters.setdefault(str(one["name"]).partition("[")[0], []).append(one)
    found = []
    for name, components in parameters.items():
        wrong = [one for one in components if one["wrong"]]
        if not wrong:
            continue
        worst = max(wrong, key=lambda one: abs(one["moved"]) / one["known"])
        times = abs(worst["moved"]) / worst["known"]
        instead = [one["instead_of"] for one in wrong if one.get("instead_of")]
        rivals = tuple(
            dict.fromkeys([*instead, *(other for one in wrong for other in one.get("rivals", ()))])
        )
        found.append(
            Entry(
                name=name,
                words=(
                    f"a number of the model's own, {worst['name']}, off by {worst['moved']:.3g} +- "
                    f"{worst['sigma']:.2g}, {times:.1f} times the sigma it states{_rivals_text(rivals)}"
                ),
                # What stands beside it may have moved it, as long as something is left.
                status="rivals" if rivals else "sure" if facts["remaining"] == "NOTHING_LEFT" else "weak",
                rivals=rivals,
                takes_off_nT=float(wrong[0]["rms_nT"]),
                command=f"inflight refit {name}",
            )
        )
    return found


def _size_left(residual: Mapping[str, Any], signature: Signature | None) -> float:
    """Return the rms of what is left above the noise, nT: its slow structure, or what its signature is."""
    size = float(residual.get("structure_nT") or 0.0)
    if signature is None or signature.amplitude_nT is None:
        return size
    # Half of peak to peak of a sine, a whole step of what switches, an rms of what is fast.
    part = 0.5 if signature.switchings else sqrt(0.5) if signature.period_s else 1.0
    known = signature.faster_than_s or signature.switchings or signature.period_s
    return max(size, min(part * signature.amplitude_nT, _above_noise(residual))) if known else size


def _above_noise(residual: Mapping[str, Any]) -> float:
    """Return the rms that is left above the noise floor, nT; all that is left where there is no floor."""
    return above_floor(float(residual["held_out_after_nT"]), float(residual["noise_floor_nT"]))


def _substitute_text(facts: Mapping[str, Any]) -> str:
    """Return a caution about the smallest effect when as much structure remains as a large part of it."""
    if not facts["effects"]:
        return ""
    smallest = min(facts["effects"], key=lambda one: one.rms_nT)
    left = float(facts["residual"].get("structure_nT") or 0.0)
    switches = facts["signature"] is not None and facts["signature"].switchings
    if switches or not left > SENTENCE_SETTINGS.large_part * smallest.rms_nT:
        return ""
    return (
        f" Slow structure of {left:.3g} nT is left, and {smallest.name} takes off {smallest.rms_nT:.3g} nT: "
        "it may stand in for part of a cause that is missing."
    )


def _noise_text(residual: Mapping[str, float]) -> str:
    floor = residual["noise_floor_nT"]
    more = residual["held_out_after_nT"] ** 2 - floor**2
    if more > (SENTENCE_SETTINGS.large_part * floor) ** 2:
        return (
            f"Nothing is left that has structure, and yet {more**0.5:.3g} nT rms beyond the white level: "
            "wild readings, or something faster than the search"
        )
    return "Nothing is left to explain: the residual is noise"


def why_not_identifiable(facts: Mapping[str, Any]) -> str:
    """Return why no cause can be named: a short span, few blocks with information, little of it."""
    blocks, fewest = facts["blocks"], facts.get("fewest", 0)
    if blocks.get("by_length", blocks["independent"]) < fewest:
        return f"these data are too short to say what: {blocks['independent']:.0f} independent blocks"
    if blocks["independent"] < fewest:
        holding = blocks.get("holding", [])
        few = f"{len(holding)} of {blocks['count']}" if holding else "a few"
        when = f": {_span_text(holding)}" if holding else ""
        return f"{few} blocks hold nearly all of the residual's square{when}"
    return "its structure is not beyond doubt"


def _span_text(blocks: Sequence[Mapping[str, Any]]) -> str:
    """Return when blocks are, adjacent ones as one span, the first few of them."""
    spans: list[list[str]] = []
    for one in blocks:
        if spans and spans[-1][1] == one["start"]:
            spans[-1][1] = one["end"]
        else:
            spans.append([one["start"], one["end"]])
    texts = [f"{_minute(start)} to {_minute(end)}" for start, end in spans[: SENTENCE_SETTINGS.spans]]
    return "; ".join(texts) + ("; ..." if len(spans) > SENTENCE_SETTINGS.spans else "")


def _minute(utc: str) -> str:
    return utc[:16].replace("T", " ")


def _burst_text(outliers: Mapping[str, Any]) -> str:
    """Return a sentence about bursts; empty when there were none."""
    count = outliers.get("burst_count", 0)
    if not count:
        return ""
    what = "A burst" if count == 1 else f"{count} bursts"
    first = outliers["bursts"][0]
    when = f"{'' if count == 1 else 'the first '}{_minute(first['start'])} to {_minute(first['end'])}"
    size = f"{_percent(outliers['share'])} of the samples ({when})"
    if outliers["kept"]:
        return f" {what} of wild readings hold{'s' if count == 1 else ''} {size}, too many to be left out."
    return f" {what} of wild readings, {size}, {'was' if count == 1 else 'were'} left out."


def _lost_text(days: Mapping[str, str]) -> str:
    """Return how many days could not be taken in, and why the first of them; nothing where all were."""
    if not days:
        return ""
    first, reason = next(iter(days.items()))
    return f" {len(days)} {'day' if len(days) == 1 else 'days'} could not be taken in: {first}, {reason}."


def _gap_text(channels: Sequence[Mapping[str, Any]]) -> str:
    """Return which part of the record lacks the channels of what was taken; nothing when it is little."""
    parts = [
        f"{_percent(one['part'])} for want of {one['channel']}"
        for one in channels
        if one["part"] >= SENTENCE_SETTINGS.missing
    ]
    if not parts:
        return ""
    return f" Part of the record could not be corrected, {', '.join(parts)}; the sizes are those of the rest."


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g}%"


def _effect_text(effect: FoundEffect) -> str:
    if effect.said:
        text = f"{effect.said}, {effect.rms_nT:.3g} nT rms"
        return text + _stamp_text(effect) + _rivals_text(effect.rivals) if effect.command else text
    text = what_it_is(effect.name, effect.channels, effect.family)
    if effect.at:
        times = [one.rstrip("Z").removesuffix(":00").replace("T", " ") for one in effect.at]
        text += f" {'from' if len(times) > 1 else 'at'} {' to '.join(times)} UTC"
        text += f" +- {format_period(effect.at_sigma_s)}" if effect.at_sigma_s else ""
    if effect.lag_s > 0:
        error = f" +- {effect.lag_sigma_s:.2g}" if effect.lag_sigma_s else ""
        text += f" with a lag of {effect.lag_s:.4g}{error} s"
    numbers = numbers_text(effect.coefficients)
    text += f" ({numbers})" if numbers else ""
    text += f", {effect.rms_nT:.3g} nT rms"
    if effect.model_effects:
        own = " and ".join(effect.model_effects)
        text += f", beside {own} of the model, whose numbers or response may be what is wrong"
    if effect.left_follows:
        means = "its form is nearly right" if effect.status == "sure" else "it may stand in for another form"
        text += f"; what is left follows {effect.left_follows}, so that {means}"
    if effect.instead:
        text += f"; this and others may be parts of one cause: {effect.instead} does as well alone"
    if effect.turned_over_by:
        text += f"; fragile: {effect.turned_over_by[0].words}"
    return text + _stamp_text(effect) + _rivals_text(effect.rivals)


def _stamp_text(effect: FoundEffect) -> str:
    """Return what a clock that is off may be instead."""
    if not effect.stamp_readings:
        return ""
    number, readings = effect.coefficients[0], " or ".join(effect.stamp_readings)
    return f"; {number.value:.3g} +- {number.sigma:.2g} s may also be {readings}"


def _rivals_text(rivals: Sequence[str]) -> str:
    few = ", ".join(rivals[: SENTENCE_SETTINGS.rivals])
    return f", which these data cannot tell from {few}" if rivals else ""


def _signature_text(signature: Signature | None) -> str:
    if signature is None:
        return "structure without a clear shape"
    if signature.switchings:
        return _unit_text(signature)
    if signature.period_s:
        text = f"it repeats every {signature.period_s:.5g} s {_axes_text(signature)}"
        return text + _shape_text(signature)
    if signature.faster_than_s:
        return _fast_text(signature)
    return _hint_text(signature)


def _unit_text(signature: Signature) -> str:
    often = "once" if signature.switchings == 1 else f"{signature.switchings} times"
    steps = [
        f"{quantity(size, sigma, 'nT')} on {name}" for name, (size, sigma) in signature.steps.items() if sigma
    ]
    return (
        f"a unit without housekeeping was seen to switch {often}, which steps the difference of both sensors "
        f"by {', '.join(steps)}; no channel changes with it; the level is free at each of its switchings, so "
        "that no residual told here has its steps: what is left is beside them"
    )


def _axes_text(signature: Signature) -> str:
    """Return the axes a period stands out on, the clearest first, with half of peak to peak on each."""
    main = signature.axis
    if main is None:
        return f"along the field, {signature.amplitude_nT:.3g} nT, half of peak to peak"
    others = [
        name
        for name, (size, sigma) in signature.amplitudes.items()
        if name != main and size > SENTENCE_SETTINGS.sigmas * sigma > 0
    ]
    sizes = {name: signature.amplitudes[name][0] for name in others}
    sizes = {main: float(signature.amplitude_nT or 0.0)} | sizes
    listed = [f"{name} ({size:.3g} nT)" for name, size in sizes.items()]
    return f"on ax{'i' if len(listed) == 1 else 'e'}s {' and '.join(listed)}, half of peak to peak"


def _shape_text(signature: Signature) -> str:
    if signature.shape not in ("sine", "square", "pulse"):
        return ""
    text = f", like a {signature.shape} wave"
    if signature.duty is None or not signature.steps:
        return text
    steps = [
        f"{size:+.3g} nT on {name}"
        for name, (size, sigma) in sorted(signature.steps.items(), key=lambda one: one[0] != signature.axis)
        if name == signature.axis or abs(size) > SENTENCE_SETTINGS.sigmas * sigma > 0
    ]
    return f"{text}, on {signature.duty:.0%} of the time: {' and '.join(steps)}"


def _fast_text(signature: Signature) -> str:
    """Return a description of something too fast for the search, and of its slow part."""
    if signature.periods_s is not None:
        short, long = signature.periods_s
        text = f"something with periods of {short:.3g} to {long:.3g} s, not steady enough for a line"
    else:
        text = f"something faster than {format_period(signature.faster_than_s or 0.0)}"
    text += f", about {signature.amplitude_nT:.3g} nT rms"
    return f"{text}; of its slow part, {_hint_text(signature)}" if signature.channel else text


def _hint_text(signature: Signature) -> str:
    if signature.channel:
        text = f"it looks most like something that follows {signature.channel}"
        return (
            text
            + (f" with a lag of {signature.lag_s:.3g} s" if signature.lag_s else "")
            + ", but not beyond doubt"
        )
    if signature.gain:
        kind = (signature.shape or "").replace("_", " ")
        gain = f"which takes {signature.gain:.0%} off days not used in the fit"
        return f"it looks most like a {kind} ({gain}), but not beyond doubt"
    return f"slow structure of {signature.amplitude_nT:.3g} nT without a shape"


def stop_reason(facts: Mapping[str, Any], most: int, ran_out: bool) -> str:
    """Return why the rounds ended."""
    if most == 0:
        return "no rounds were asked for"
    if ran_out:
        return f"the limit of {most} additions was reached; raise it to go on"
    if facts["remaining"] == "NOTHING_LEFT":
        return "what is left is noise"
    if facts["remaining"] == "NOT_IDENTIFIABLE":
        return f"what is left cannot be told: {why_not_identifiable(facts)}"
    return (
        "no candidate is beyond doubt: the gain on days not used in the fit, sign flips and placebos must "
        "all agree"
    )
