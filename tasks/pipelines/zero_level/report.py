"""What is told of zero levels: each window with its methods and tests, and how the field's size varies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.mission import ZeroLevelComparison
from inflight.tasks.pipelines.base import TextLine, with_unit
from inflight.time import to_utc
from inflight.zero_level import AXES

if TYPE_CHECKING:
    import xarray as xr

    from inflight.plumbing import Finding


def combine_variations(reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the rms variation of the size of several days, by their intervals; empty without any."""
    known = [one for one in reports if one.get("turning_intervals")]
    total = sum(one["turning_intervals"] for one in known)
    return {
        name: float(np.sqrt(sum(one["turning_intervals"] * one[name] ** 2 for one in known) / total))
        for name in ("before_nT", "after_nT")
        if total
    }


def describe_row(row: xr.Dataset, entry: ZeroLevelComparison) -> str:
    """Return a zero level in words: each axis with its error, the methods, and what is not told."""
    return "; ".join(f"{axis} {sentence}" for axis, sentence in _axes(row, entry).items())


def _axes(row: xr.Dataset, entry: ZeroLevelComparison) -> dict[str, str]:
    """Return of each axis its zero level with its error, or that nothing tells it."""
    value, sigma, known = (row[name].values for name in ("value", "sigma", "determined"))
    return {
        axis: "not asked for"
        if axis not in entry.axes
        else with_unit(float(value[at]), float(sigma[at]), "nT")
        if known[at]
        else f"not told, within {entry.bound:g} nT of {entry.start[at]:g} nT"
        for at, axis in enumerate(AXES)
    }


def rows_as_json(table: xr.Dataset, entry: ZeroLevelComparison) -> list[dict[str, Any]]:
    """Return the rows of a table of zero levels as plain fields."""
    out = []
    for at in range(table.sizes["interval"]):
        row = table.isel(interval=at)
        known = row["determined"].values.astype(bool)
        shared = row["sigma"].values / np.where(known, row["independent_sigma"].values, np.nan)
        out.append(
            {
                "start": str(to_utc(int(row["start"])))[:10],
                "end": str(to_utc(int(row["end"])))[:10],
                "value_nT": [
                    float(v) if k else None for v, k in zip(row["value"].values, known, strict=True)
                ],
                "sigma_nT": row["sigma"].values.tolist(),
                "wander_nT": row["wander"].values.tolist(),
                "sigma_over_independent": [float(one) if np.isfinite(one) else None for one in shared],
                "sentence": _axes(row, entry),
                "method": str(row["method"].values),
                "kinds": dict(zip(table["kind"].values.tolist(), row["kinds"].values.tolist(), strict=True)),
                "not_determined": [axis for axis in entry.axes if not known[AXES.index(axis)]],
                "reason": str(row["reason"].values),
                "assumptions": [str(one) for one in row["assumption_text"].values if str(one)],
                "fails": [
                    str(text)
                    for text, holds, used, size in zip(
                        *(row[f"assumption_{name}"].values for name in ("text", "holds", "used", "value")),
                        strict=True,
                    )
                    if used and np.isfinite(size) and not holds
                ],
                "basis": str(row["basis"].values),
                "constant": str(row["constant"].values),
            }
        )
    return out


def level_lines(comparison: str, levels: Sequence[Mapping[str, Any]]) -> list[TextLine]:
    """Return the zero levels as a person reads them, the newest window with its tests."""
    lines = [TextLine(f"{comparison}: zero levels of {len(levels)} windows", "bold")]
    for one in levels:
        axes = ", ".join(f"{axis} {text}" for axis, text in one["sentence"].items())
        lines.append(TextLine(f"  {one['start']} to {one['end']}: {axes}; {one['method']}"))
        if one["not_determined"]:
            lines.append(TextLine(f"    {one['reason']}"))
        lines += [TextLine(f"    {text}") for text in one["fails"]]
    if levels:
        ratio = [one for one in levels[-1]["sigma_over_independent"] if one is not None]
        lines += [TextLine(f"  {text}", "dim") for text in levels[-1]["assumptions"]]
        if ratio:
            lines.append(
                TextLine(
                    f"  the methods share intervals: the joint error is {np.mean(ratio):.1f} times that of "
                    "independent data",
                    "dim",
                )
            )
    return lines


@dataclass
class ZeroLevelReport:
    """What `compare` found; `path` is the page, when one was written."""

    comparison: str
    by_day: list[dict[str, Any]]
    levels: list[dict[str, Any]]
    path: Path | None = None
    plumbing: Sequence[Finding] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": "compare",
            "comparison": self.comparison,
            "plumbing": [dict(one.as_json()) for one in self.plumbing],
            "residual": combine_variations(self.by_day),
            "by_day": self.by_day,
            "zero_levels": self.levels,
            "fails_where": [text for one in self.levels for text in one["fails"]],
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return what a person reads."""
        size = combine_variations(self.by_day)
        first = (
            f"the field's size, where the field turns, varies by {size['before_nT']:.3f} nT rms as measured, "
            f"by {size['after_nT']:.3f} nT without the zero level"
            if size
            else "no interval in which the field turns: nothing shows how well the zero level fits"
        )
        return [TextLine(first, "bold"), *level_lines(self.comparison, self.levels)]


def variation_html(report: ZeroLevelReport) -> str:
    """Return how much the field's size varies on each day where the field turns."""
    from inflight.figures import html_table

    rows = [
        (day["day"], day["turning_intervals"], f"{day['before_nT']:.3f}", f"{day['after_nT']:.3f}")
        for day in report.by_day
        if day.get("turning_intervals")
    ]
    head = (
        "day",
        "intervals in which it turns",
        "variation of the size as measured, nT",
        "without the zero level, nT",
    )
    return html_table(head, rows) if rows else "No interval of the span is one in which the field turns."


def method_rows(row: xr.Dataset) -> list[tuple[str, ...]]:
    """Return what each method says in a window by itself, one row a method."""
    out = []
    for at, name in enumerate(row["method_name"].values):
        value, sigma = row["method_value"].values[at], row["method_sigma"].values[at]
        cells = [
            with_unit(float(v), float(s), "nT") if np.isfinite(v) and np.isfinite(s) else "-"
            for v, s in zip(value, sigma, strict=True)
        ]
        out.append(
            (str(name), str(int(row["method_used"].values[at])), *cells, str(row["method_reason"].values[at]))
        )
    return out


def step_rows(steps: xr.Dataset) -> list[tuple[str, ...]]:
    """Return the zero level of each step, one row a step."""
    rows = []
    for one in steps_as_json(steps):
        parts = zip(one["value_nT"], one["sigma_nT"], one["determined"], strict=True)
        rows.append((one["start"][:16], *(with_unit(v, s, "nT") if k else "-" for v, s, k in parts)))
    return rows


def steps_as_json(steps: xr.Dataset | None) -> list[dict[str, Any]]:
    """Return the zero levels of steps as plain fields; none without a table."""
    if steps is None:
        return []
    return [
        {
            "start": str(to_utc(int(steps["start"].values[at])))[:19],
            "value_nT": steps["value"].values[at].tolist(),
            "sigma_nT": steps["sigma"].values[at].tolist(),
            "determined": steps["determined"].values[at].astype(bool).tolist(),
        }
        for at in range(steps.sizes["interval"])
    ]
