"""From scores to a verdict: rounds, rivals, values, what is left, and the words for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from inflight.diagnosis.closer import look_closer
from inflight.diagnosis.diagnosis import Diagnosis, FoundEffect, Signature, Verdict
from inflight.diagnosis.findings import candidates, confusion, effect, lag_profile, refined, unscorable
from inflight.diagnosis.left import structure_of
from inflight.diagnosis.material import (
    Material,
    effective_blocks,
    held_out,
    left_of,
    native_rms,
    of_known_rows,
)
from inflight.diagnosis.refine import refine
from inflight.diagnosis.rounds import WEAK, polish, run, settle
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.second import look_again
from inflight.diagnosis.standing import Standing
from inflight.diagnosis.unknown import Unknown, known_periods, look_at
from inflight.diagnosis.words import sentence, stopped

#: A search that leaves no more than so many times as much explains as much.
_AS_MUCH = 1.003

__all__ = ["Material", "conclude", "held_out", "known_periods", "lag_profile"]


def conclude(search: Search, material: Material) -> Diagnosis:
    """Run the rounds and say what they mean."""
    first = search.table().light()
    last = _rounds(search, material, first) if search.rules.rounds else first
    standings = sorted(settle(search, partial(refine, search, material)), key=lambda one: -one.gain)
    if standings:
        last = search.table().light()
    effects = tuple(effect(search, material, one) for one in standings)
    seen = of_known_rows(search, material)
    left = left_of(search, seen)
    blocks = effective_blocks(search, seen, left)
    unknown = look_at(search, seen, last, left, structure_of(seen.series, left))
    remaining = _remaining(unknown, blocks["independent"], search.rules.blocks)
    verdict = _verdict(effects, standings, remaining)
    residual = _sizes(search, seen, unknown)
    signature = unknown.signature if remaining == "UNKNOWN_EFFECT" else None
    own = signature if verdict != "UNKNOWN_EFFECT" or not effects else _of_shape(effects[0])
    told: dict[str, Any] = {
        "effects": effects,
        "signature": signature,
        "residual": residual,
        "remaining": remaining,
        "blocks": blocks,
        "outliers": material.outliers.as_json(),
        "unscorable": unscorable(search),
        "fewest": search.rules.blocks,
    }
    rivals, separating = confusion(search, standings)
    return Diagnosis(
        verdict,
        sentence(told),
        effects,
        rivals,
        separating,
        told["unscorable"],
        own if verdict == "UNKNOWN_EFFECT" else None,
        {"verdict": remaining, "signature": signature},
        residual,
        tuple(one.as_json() for one in search.rounds),
        candidates(search, first, last),
        refined(search),
        blocks,
        stopped(told, search.rules.rounds, search.ran_out),
        material.model.comparison,
        {"name": material.model.name, "version": material.model.version},
        material.context,
        material.run,
        told["outliers"],
    )


def _sizes(search: Search, material: Material, unknown: Unknown) -> dict[str, Any]:
    """Return the sizes of the residual, nT at the cadence of the comparison, all of the same rows."""
    nothing = search.as_found()
    return {
        "before_nT": native_rms(material, nothing),
        "after_nT": native_rms(material, search),
        "held_out_before_nT": held_out(nothing, material),
        "held_out_after_nT": held_out(search, material),
        # A record without a fast part, filtered or rounded away, tells no floor.
        "noise_floor_nT": unknown.floor.level_nT or float("nan"),
        "noise_floor_low_nT": unknown.floor.low_nT,
        "noise_floor_high_nT": unknown.floor.high_nT,
        "structure_nT": unknown.structure.rms_nT,
        "structure_t": unknown.structure.t,
        "uncorrected": material.gaps.as_json() if material.gaps else [],
    }


def _rounds(search: Search, material: Material, first: Table) -> Table:
    """Run the rounds, again with products when something is left, and from shapes if need be."""
    refiner, closer = partial(refine, search, material), partial(look_closer, search, material)
    last = run(search, refiner=refiner, closer=closer)
    known = of_known_rows(search, material)
    left = left_of(search, known)
    seen = look_at(search, known, last, left, structure_of(known.series, left))
    more = len(search.accepted) < search.rules.rounds and (seen.is_sure or search.accepted)
    if more and look_again(search, material, [first, last], seen.is_sure):
        last = run(search, refiner=refiner, closer=closer)
    if _stands_in(search):
        last = _from_shapes(search, material, last, partial(run, search, refiner=refiner, closer=closer))
    polish(search, refiner)
    return last


def _stands_in(search: Search) -> bool:
    """Return True when named causes were taken and yet shapes that name none had to complete them.

    Either both are there, or the named ones together stand in for something that no effect here describes.
    """
    shapes = [one for one in search.accepted if _is_shape(one)]
    return bool(shapes) and len(search.accepted) > len(shapes) and len(search.accepted) > 2


def _from_shapes(search: Search, material: Material, last: Table, again: Callable[..., Table]) -> Table:
    """Search anew with shapes first; keep it when fewer effects explain as much, else what was found."""
    before = held_out(search, material)
    kept = search.accepted, search.rounds, search.banned, search.dropped, search.ran_out
    search.accepted, search.rounds, search.banned, search.dropped = [], [], set(), set()
    search.recut()
    other = again(shapes_first=True)
    if len(search.accepted) < len(kept[0]) and held_out(search, material) <= _AS_MUCH * before:
        return other
    search.accepted, search.rounds, search.banned, search.dropped, search.ran_out = kept
    search.recut()
    return last


def _verdict(effects: tuple[FoundEffect, ...], standings: list[Standing], remaining: Verdict) -> Verdict:
    """Return the verdict about the residual as found."""
    if not effects:
        return remaining
    if any(one.rivals or one.retained < WEAK for one in effects):
        return "CONFOUNDED"
    # The largest of them first: where it names no cause, nor do the smaller ones name the cause of most.
    return "UNKNOWN_EFFECT" if _is_shape(standings[0].option) else "FOUND"


def _is_shape(option: Option) -> bool:
    """Return True for what was taken for its shape and names no cause."""
    return option.agnostic or option.family == "unknown"


def _of_shape(effect: FoundEffect) -> Signature:
    """Return the signature of an effect that was taken for its shape and names no cause."""
    return Signature(
        channel="*".join(effect.channels) or None,
        lag_s=effect.lag_s,
        axis=effect.axes[0] if len(effect.axes) == 1 else None,
        shape=effect.name,
        amplitude_nT=effect.rms_nT,
        gain=effect.gain,
    )


def _remaining(unknown: Unknown, independent: float, fewest: int) -> Verdict:
    """Return what is to be said of what is left."""
    if not unknown.is_there:
        return "NOTHING_LEFT"
    return "UNKNOWN_EFFECT" if unknown.is_sure and independent >= fewest else "NOT_IDENTIFIABLE"
