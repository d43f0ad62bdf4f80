"""What a diagnosis found, as tables: effects with their values, rivals, the signature of what is left.

All of it is made from the fields that a diagnosis keeps, so that one that was made before is shown like a
fresh one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from inflight.figures.naming import bare_parameter, short_name
from inflight.figures.page import html_table
from inflight.lines import told_period

Fields = Mapping[str, Any]
#: Coefficients of an effect that are printed.
_COEFFICIENTS = 6


def found_effects(fields: Fields) -> list[str]:
    """Return the found effects with all their values as a table, and the signature of what is left.

    Parameters
    ----------
    fields : mapping
        As `Diagnosis.as_json`.
    """
    signature = _signature(fields["remaining"]["signature"])
    if not fields["effects"]:
        return [f"<p>No effect was added: {escape(fields['stopped'])}.</p>", *signature]
    head = ("found", "family", "value ± sigma", "at", "gain", "t", "p", "retained", "W/k", "rms, nT")
    rows = [row for one in fields["effects"] for row in _rows(one, len(head))]
    note = (
        "Gain, t and family-wise p are held out, against the model without the effect; retained is the part "
        "of its variance that no other parameter explains; W/k compares raw and within-day values, and large "
        "ones hint at a wrong form."
    )
    stopped = f"The rounds ended: {fields['stopped']}."
    return [
        html_table(head, rows),
        f'<p class="quiet">{escape(note)} {escape(stopped)}</p>',
        *signature,
    ]


def _rows(one: Fields, width: int) -> list[tuple[str, ...]]:
    """Return one row a value; effect, family and how it stands in the first of them."""
    shown = telling(one["coefficients"])
    rows: list[tuple[str, ...]] = []
    numbers: tuple[str, ...] = (
        _told(one["gain"], ".1%"),
        _told(one["t"], ".1f"),
        _told(one["flip_p"], ".2g"),
        _told(one["retained"], ".2g"),
        _told(one["consistency"], ".1f"),
        _told(one["rms_nT"], ".3g"),
    )
    own = (short_name(one["name"]), str(one["family"]).replace("_", " "))
    for value in shown:
        size = f"{_told(value['value'], '.4g')} ± {_told(value['sigma'], '.2g')} {value['unit']}"
        rows.append((*own, f"{bare_parameter(value['name'])} {size}", value["at"], *numbers))
        own, numbers = ("", ""), ("",) * len(numbers)
    if len(shown) < len(one["coefficients"]):
        hidden = len(one["coefficients"]) - len(shown)
        rows.append(("", "", f"and {hidden} less significant ones", *[""] * (width - 3)))
    return rows


def _told(value: float | None, how: str) -> str:
    return "" if value is None else format(value, how)


def telling(coefficients: Sequence[Fields]) -> list[Fields]:
    """Return the most significant coefficients in their own order; a field of many has too many to print."""
    ordered = sorted(
        coefficients, key=lambda one: -abs(one["value"] or 0.0) / max(one["sigma"] or 0.0, 1e-300)
    )
    kept = {one["name"] for one in ordered[:_COEFFICIENTS]}
    return [one for one in coefficients if one["name"] in kept]


def _signature(left: Fields | None) -> list[str]:
    if left is None:
        return []
    period, lag, duty = left["period_s"], left["lag_s"], left["duty"]
    parts = [
        ("period", told_period(period) if period else ""),
        ("axis", left["axis"] or ""),
        ("shape", left["shape"] or ""),
        ("half of peak to peak" if period else "amplitude", _nanotesla(left["amplitude_nT"])),
        *(
            (f"step on {name}", f"{_told(size, '+.3g')} ± {_told(sigma, '.2g')} nT")
            for name, (size, sigma) in left["steps"].items()
        ),
        ("periods", " to ".join(told_period(one) for one in left["periods_s"] or ())),
        ("channel", left["channel"] or ""),
        ("lag", told_period(lag) if lag else ""),
        ("duty", f"{duty:.2f}" if duty is not None else ""),
    ]
    said = ", ".join(f"{name} {value}" for name, value in parts if value)
    return [f"<p><b>Signature of what is left:</b> {escape(said)}</p>"]


def _nanotesla(size: float | None) -> str:
    return f"{size:.3g} nT" if size else ""


def rivals_apart(fields: Fields) -> list[str]:
    """Return the blocks in which rivals differ most, as a table; nothing without rivals."""
    if not fields["confusion_set"] or not fields["separating"]:
        return []
    pairs: dict[str, list[Fields]] = {}
    for one in fields["separating"]:
        pairs.setdefault(" / ".join(short_name(name) for name in one["rivals"]), []).append(one)
    rows = [
        (
            pair,
            ", ".join(one["start"][:16].replace("T", " ") for one in blocks),
            f"{max(one['difference_nT'] for one in blocks):.2g}",
        )
        for pair, blocks in pairs.items()
    ]
    return [
        "<p>What would tell the rivals apart: the blocks in which they differ most.</p>",
        html_table(("rivals", "blocks that begin (UTC)", "largest difference, nT rms"), rows),
    ]
