"""The ledger: what the rounds did, with what settings, on what data, and how each step is undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from inflight.figures.naming import short_name
from inflight.figures.page import html_table


def ledger_table(rounds: Sequence[Mapping[str, Any]]) -> str:
    """Return the rounds as HTML; each with the command that takes its effect out again."""
    if not rounds:
        return "<p>No round took anything.</p>"
    head = (
        "round",
        "what",
        "effect",
        "family",
        "gain",
        "t",
        "p",
        "seen in",
        "in the model",
        "take out again",
    )
    rows = [
        (
            str(one["number"]),
            str(one["action"]),
            short_name(str(one["name"])),
            str(one["family"]).replace("_", " "),
            f"{one['gain']:.3g}",
            f"{one['t']:.1f}",
            f"{one['p']:.2g}",
            str(one["form"]),
            f'inflight add "{one["name"]}"' if one["action"] != "drop" else "",
            "inflight undo" if one["action"] != "drop" else "",
        )
        for one in rounds
    ]
    return f'<div style="overflow-x:auto">{html_table(head, rows)}</div>'


def facts_list(facts: Mapping[str, Any]) -> str:
    """Return settings, seed, hashes and versions as a list that can be copied."""
    items = "".join(
        f"<tr><td>{escape(name)}</td><td style='text-align:left'><code>{escape(str(value))}</code></td></tr>"
        for name, value in facts.items()
        if value not in ("", None)
    )
    return f"<table>{items}</table>"
