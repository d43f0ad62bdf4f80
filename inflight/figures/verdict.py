"""The verdict strip: what was found, in words and on one scale from nothing to the residual as it was."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from inflight.figures.style import AFTER, BEFORE, REFERENCE

#: What each verdict means to somebody who reads the page for the first time.
MEANING = {
    "FOUND": "beyond doubt, and nothing else explains it as well",
    "CONFOUNDED": "something is there; these data cannot tell all rivals apart",
    "NOT_IDENTIFIABLE": "something is there; the record is too short to say what",
    "UNKNOWN_EFFECT": "something is there that no effect of the library explains",
    "NOTHING_LEFT": "the residual is noise",
}
_COLOURS = {
    "FOUND": "#1b6e4b",
    "CONFOUNDED": "#8a5a00",
    "NOT_IDENTIFIABLE": "#555555",
    "UNKNOWN_EFFECT": "#a01830",
    "NOTHING_LEFT": AFTER,
}
_WIDTH, _LEFT, _RIGHT = 1080, 10, 1070


def explained(residual: Mapping[str, Any]) -> float:
    """Return which part of the held-out mean square above the noise floor the found effects explain."""
    before, after, floor = _sizes(residual)
    above = before**2 - floor**2
    return (before**2 - after**2) / above if above > 0.05 * floor**2 else np.nan


def verdict_strip(verdict: str, sentence: str, residual: Mapping[str, Any], remaining: str) -> str:
    """Return HTML that needs no script: verdict, sentence, sizes, and a scale of them.

    Parameters
    ----------
    residual : mapping
        As `Diagnosis.residual`; nT.
    remaining : str
        Verdict on what is left.
    """
    colour = _COLOURS.get(verdict, REFERENCE)
    part = explained(residual)
    told = [
        ("residual now", _told(residual["held_out_before_nT"])),
        ("with what was found", _told(residual["held_out_after_nT"])),
        (f"noise floor ({_interval(residual)})", _told(residual["noise_floor_nT"])),
        ("explained of what is above it", "nothing is above it" if np.isnan(part) else f"{part:.0%}"),
        ("what is left", remaining),
    ]
    cells = "".join(
        f'<div style="margin-right:1.6rem"><div class="quiet">{escape(name)}</div>'
        f'<div style="font-size:1.15rem;font-weight:600">{escape(value)}</div></div>'
        for name, value in told
    )
    return (
        f'<div style="border-left:8px solid {colour};padding:.6rem 1rem;background:#f6f6f4">'
        f'<div><span style="background:{colour};color:#fff;padding:.15rem .6rem;border-radius:4px;'
        f'font-weight:700;letter-spacing:.03em">{escape(verdict)}</span> '
        f'<span class="quiet">{escape(MEANING.get(verdict, ""))}</span></div>'
        f'<p style="font-size:1.02rem;margin:.6rem 0;max-width:66rem">{_lines(sentence)}</p>'
        f'<div style="display:flex;flex-wrap:wrap">{cells}</div>{_scale(residual)}</div>'
    )


def _sizes(residual: Mapping[str, Any]) -> list[float]:
    """Return the size before, after, and of the noise floor; NaN for none."""
    names = ("held_out_before_nT", "held_out_after_nT", "noise_floor_nT")
    return [np.nan if residual[name] is None else float(residual[name]) for name in names]


def _lines(sentence: str) -> str:
    """Return a sentence of several findings with each on a line of its own."""
    return "<br>".join(escape(part) for part in sentence.replace("; ", ";\n").split("\n"))


def _told(value: float | None) -> str:
    return f"{value:.4g} nT" if value is not None and np.isfinite(value) else "unknown"


def _interval(residual: Mapping[str, Any]) -> str:
    low, high = residual.get("noise_floor_low_nT"), residual.get("noise_floor_high_nT")
    if low is None or high is None or not np.isfinite(low) or not np.isfinite(high):
        return "no interval"
    return f"{low:.4g} to {high:.4g}, 95 %"


def _scale(residual: Mapping[str, Any]) -> str:
    """Return a horizontal scale with the residual before and after and the noise floor's interval."""
    before, after, floor = _sizes(residual)
    most = float(np.nanmax([before, after, floor, 0.0]))
    if not np.isfinite(most) or most <= 0:
        return ""

    def at(value: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * value / (1.05 * most)

    parts = [
        f'<rect x="{_LEFT}" y="8" width="{at(before) - _LEFT:.1f}" height="7" fill="{BEFORE}"/>',
        f'<rect x="{_LEFT}" y="18" width="{at(after) - _LEFT:.1f}" height="7" fill="{AFTER}"/>',
        f'<text x="{_LEFT + 4}" y="38" font-size="11" fill="#555">rms held out, linear from 0: '
        "brown before, blue after, dashed line and grey band the noise floor</text>",
    ]
    if np.isfinite(floor):
        low, high = (float(residual.get(f"noise_floor_{end}_nT") or floor) for end in ("low", "high"))
        wide = max(at(high) - at(low), 1.0)
        parts.append(
            f'<rect x="{at(low):.1f}" y="2" width="{wide:.1f}" height="26" fill="#777" opacity=".35"/>'
            f'<line x1="{at(floor):.1f}" x2="{at(floor):.1f}" y1="0" y2="28" stroke="#333" '
            'stroke-dasharray="3 2"/>'
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH} 42" style="width:100%;margin-top:.5rem" role="img" '
        f'aria-label="residual before, after and noise floor">{"".join(parts)}</svg>'
    )
