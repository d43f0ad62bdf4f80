"""What the tables of a spinning sensor contain: fields for the command line's JSON, and one page.

Takes `SpinResults` (the tables and their days), makes `Part` sections: the twelve parameters, what each day
decided, the estimates of sub-intervals, zero levels, and the spin phase.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight import __version__
from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.figures import (
    correlation_figure,
    estimates_figure,
    html_page,
    html_table,
    parameter_change_figure,
    parameter_days_figure,
    uncertainty_figure,
    zero_drift_figure,
    zero_methods_figure,
)
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.spin import PARAMETER_NAMES, PARAMETER_UNITS, SPIN, SPIN_RELATED
from inflight.tasks.pipelines.base import Part
from inflight.tasks.pipelines.spin.tables import TABLES, SpinResults
from inflight.tasks.report import write_page
from inflight.time import DAY, day_of, to_utc
from inflight.units import with_error
from inflight.zero_level import COMBINED_METHODS

#: Days with an update, and days of phase, that the page lists.
_SHOWN = 40


def spin_report(
    cat: Catalog, mission: Mission, comparison: str, output: Path | None = None
) -> dict[str, Any]:
    """Return the fields of a spin comparison's tables, and write the page when a path is given.

    Raises
    ------
    CatalogError
        When none is published.
    """
    found = SpinResults.of(cat, mission, comparison)
    parts = spin_table_parts(found)
    if output is not None:
        title = f"{mission.mission}: calibration by the spin, {found.span[0]} to {found.span[1]}"
        footer = f"{len(found.records)} days; inflight {__version__}. {mission.acknowledgement}"
        write_page(
            output, html_page(title, [(part.heading, part.text, part.plots) for part in parts], footer)
        )
    return {
        "command": "chain",
        "comparison": comparison,
        "span": found.span,
        "days": len(found.records),
        "tables": {name: f"{comparison}-{name}" for name in TABLES},
        "sections": {part.key: part.fields | {"absent": part.absent} for part in parts},
        "path": str(output) if output else "",
    }


def spin_table_parts(found: SpinResults) -> list[Part]:
    """Return everything that is shown of a turning sensor's tables."""
    return [_parameters(found), _days(found), _estimates(found), _zero_levels(found), _phase(found)]


def _parameters(found: SpinResults) -> Part:
    part = Part("twelve", "The twelve parameters")
    table = found.tables["window"]
    part.fields = {"items": _items(table.isel(interval=-1)), "intervals": int(table.sizes["interval"])}
    rows = [
        (
            one["name"],
            one["unit"],
            with_error(one["preflight"], one["preflight_sigma"]),
            with_error(one["value"], one["sigma"]),
            f"{one['conditional_sigma']:.1g}" if one["origin"] == SPIN else "",
            one["origin"],
            one["decision"] or "as on the ground",
            one["reason"],
        )
        for one in part.fields["items"]
    ]
    part.add_text(
        f"The newest of {table.sizes['interval']} windows: what is in use, where it came from, and what the "
        "window's own estimate decided. The error in use is the whole one: gains, rotation and third offset "
        "leave no tone, and their errors are in it. For given values of these the tones know a parameter "
        "better: decisions rest on that error."
    )
    head = ("parameter", "unit", "pre-flight", "in use", "error by tones", "from", "decision", "why")
    part.text.append(html_table(head, rows, kind="wide told"))
    ground = [one["name"] for one in part.fields["items"] if one["origin"] == "ground"]
    part.fields["ground"] = ground
    named = ", ".join(ground) or "none"
    part.add_text(f"These remain at their ground values: {named}. The spin tells nothing of them.")
    return part


def _items(row: xr.Dataset) -> list[dict[str, Any]]:
    """Return one interval's parameters by name."""
    keys = ("preflight", "preflight_sigma", "value", "sigma", "conditional_sigma", "own", "own_sigma")
    columns = ("prior", "prior_sigma", *keys[2:])
    if "conditional_sigma" not in row:
        # A table from before there was one.
        row = row.assign(conditional_sigma=row["sigma"])
    return [
        {"name": name, "unit": PARAMETER_UNITS[name]}
        | {key: float(row[column].values[at]) for key, column in zip(keys, columns, strict=True)}
        | {key: str(row[key].values[at]) for key in ("origin", "decision", "reason")}
        for at, name in enumerate(PARAMETER_NAMES)
    ]


def _days(found: SpinResults) -> Part:
    part = Part("days", "What each day decided")
    table = found.tables["daily"]
    days = [_begin(start) for start in table["start"].values.tolist()]
    items = [{"day": day} | one for at, day in enumerate(days) for one in _items(table.isel(interval=at))]
    part.fields = {"items": [one for one in items if one["decision"]]}
    update = [one for one in part.fields["items"] if one["decision"] == "update"]
    later = [one for one in update if one["day"] != days[0]]
    decisions = sum(one["day"] != days[0] for one in part.fields["items"])
    part.add_text(
        f"{len(later)} of {decisions} decisions after the first day replace a value; the "
        "rest would only add jitter, or the day does not tell. Each parameter keeps its "
        "value (red) until a day's own estimate warrants another."
    )
    rows = [
        (one["day"], one["name"], with_error(one["own"], one["own_sigma"]), one["unit"], one["reason"])
        for one in later[-_SHOWN:]
    ]
    if rows:
        head = ("day", "replaced", "by", "unit", "why")
        part.text.append(html_table(head, rows, kind="wide told"))
    part.plots.append(parameter_days_figure(table, found.selected))
    if table.sizes["interval"] > 1:
        part.plots.append(parameter_change_figure(table))
    return part


def _begin(start: int) -> str:
    """Return the day of an interval, with the time where a perigee begins it."""
    text = str(to_utc(start))
    return text[:10] if text[11:16] == "00:00" else f"{text[:10]} {text[11:16]}"


def _estimates(found: SpinResults) -> Part:
    part = Part("estimates", "Selection against joint estimate")
    cloud = found.cloud
    value, sigma = _joint_estimate(found.days)
    if not len(cloud.start):
        part.add_absent("Estimates of sub-intervals", "no day has any")
        return part
    rows, part.fields["items"] = _selection_and_joint(found, value, sigma)
    part.add_text(
        "Each point is a sub-interval, against its own uncertainty: from neighbouring frequencies and, of "
        "offsets and elevations, from the variability of selected estimates of what is held (Plaschke et al. "
        "2019, 5.4, 5.5). The error of the joint estimate is that of its fit: noise, overlap, scatter. The "
        "dotted line is the threshold, red points are chosen and the blue line is their mean; dashed is the "
        "joint estimate of all days. Both assume that nothing changed over the span; offsets go with the "
        "pre-flight offset along the spin axis."
    )
    head = ("parameter", "unit", "pre-flight", "selection", "joint", "apart, sigma", "chosen", "threshold")
    part.text.append(html_table(head, rows))
    covariances = np.array([day["covariance"].values[0] for day in found.days])
    errors = np.sqrt(np.maximum(np.einsum("dii->di", covariances), 1e-300))
    correlation = np.mean(covariances / (errors[:, :, None] * errors[:, None, :]), axis=0)
    part.plots += [estimates_figure(cloud, (value, sigma)), correlation_figure(correlation)]
    part.plots.append(uncertainty_figure(cloud))
    return part


def _selection_and_joint(
    found: SpinResults, value: Floats, sigma: Floats
) -> tuple[list[tuple[str, ...]], list[dict[str, Any]]]:
    """Return the selection's and the joint estimate's values as rows of a table, and as JSON."""
    cloud, table = found.cloud, found.tables["daily"]
    rows: list[tuple[str, ...]] = []
    items: list[dict[str, Any]] = []
    for at, name in enumerate(SPIN_RELATED):
        prior = float(table["prior"].values[PARAMETER_NAMES.index(name)])
        spread = float(table["prior_sigma"].values[PARAMETER_NAMES.index(name)])
        count = int(cloud.chosen[:, at].sum())
        apart = abs(cloud.value[at] - value[at]) / float(np.hypot(cloud.sigma[at], sigma[at]))
        items.append(
            {
                "name": name,
                "unit": PARAMETER_UNITS[name],
                "selection": float(cloud.value[at]),
                "selection_sigma": float(cloud.sigma[at]),
                "joint": float(value[at]),
                "joint_sigma": float(sigma[at]),
                "chosen": count,
                "threshold": float(cloud.threshold[at]),
            }
        )
        selection = with_error(cloud.value[at], cloud.sigma[at]) if count else "none chosen"
        rows.append(
            (
                name,
                PARAMETER_UNITS[name],
                with_error(prior, spread),
                selection,
                with_error(value[at], sigma[at]),
                f"{apart:.1f}" if count else "",
                f"{count} of {int(np.isfinite(cloud.estimate[:, at]).sum())}",
                f"{cloud.threshold[at]:.2g}" if count else "",
            )
        )
    return rows, items


def _joint_estimate(days: list[xr.Dataset]) -> tuple[Floats, Floats]:
    """Return the mean of the days' joint estimates and its error, widened where they scatter; (8,)."""
    value = np.array([day["value"].values[0] for day in days])
    weight = np.array([day["sigma"].values[0] for day in days]) ** -2.0
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.sum(weight * np.where(weight > 0.0, value, 0.0), axis=0) / total
    free = np.maximum((weight > 0.0).sum(axis=0) - 1, 1)
    excess = np.sum(weight * np.where(weight > 0.0, value - mean, 0.0) ** 2, axis=0) / free
    return mean, np.sqrt(np.maximum(excess, 1.0) / total)


def _zero_levels(found: SpinResults) -> Part:
    part = Part("zero_level", "Zero levels")
    zero = found.tables["zero-level"]
    days = [str(one)[:10] for one in day_of(zero["start"].values)]
    items: list[dict[str, Any]] = []
    for at, day in enumerate(days):
        row = zero.isel(interval=at)
        each = {
            name: {"value": float(value), "sigma": float(sigma), "intervals": int(used)}
            for name, value, sigma, used in zip(
                COMBINED_METHODS,
                *(row[f"method_{one}"].values for one in ("value", "sigma", "used")),
                strict=True,
            )
            if np.isfinite(sigma)
        }
        text = {key: str(row[key].values) for key in ("method", "reason")}
        numbers = {key: float(row[key]) for key in ("value", "sigma")}
        items.append({"from": day, "intervals": int(row["intervals"]), "methods": each} | text | numbers)
    rates = _offset_drift(found.tables["daily"])
    part.fields = {
        "items": items,
        "drift": {
            name: {"nT_per_day": rate, "sigma": sigma, "sentence": f"{with_error(rate, sigma)} nT a day"}
            for name, (rate, sigma) in rates.items()
        },
    }
    part.add_text(
        "Offsets 1 and 2 come from the spin; the third, along the spin axis, from nature's own statistics in "
        "each window, by every method on the intervals of 15 minutes that suit it; days of a window share it."
    )
    head = ("window from", "combined", *COMBINED_METHODS, "intervals")
    rows = []
    for one in items:
        combined = with_error(one["value"], one["sigma"]) if np.isfinite(one["sigma"]) else "not told"
        methods = [one["methods"].get(name) for name in COMBINED_METHODS]
        cells = [
            f"{with_error(own['value'], own['sigma'])} ({own['intervals']})" if own else "not told"
            for own in methods
        ]
        rows.append((one["from"], combined, *cells, str(one["intervals"])))
    part.text.append(html_table(head, rows))
    part.plots += [zero_drift_figure(found.tables["daily"], rates), zero_methods_figure(zero)]
    return part


def _offset_drift(table: xr.Dataset) -> dict[str, tuple[float, float]]:
    """Return the drift of offsets 1 and 2, nT a day, with its error; none of fewer than three days."""
    out = {}
    time = (table["start"].values // 2 + table["end"].values // 2) / DAY
    for name in ("offset[1]", "offset[2]"):
        at = PARAMETER_NAMES.index(name)
        value, sigma = table["own"].values[:, at], table["own_sigma"].values[:, at]
        known = np.isfinite(sigma)
        if known.sum() < 3:
            continue
        weight = sigma[known] ** -2.0
        when = time[known] - np.average(time[known], weights=weight)
        spread = float(np.sum(weight * when**2))
        middle = np.average(value[known], weights=weight)
        rate = float(np.sum(weight * when * (value[known] - middle)) / spread)
        residual = value[known] - middle - rate * when
        excess = max(1.0, float(np.sum(weight * residual**2)) / (known.sum() - 2))
        out[name] = (rate, float(np.sqrt(excess / spread)))
    return out


def _phase(found: SpinResults) -> Part:
    part = Part("phase", "Phase of the spin")
    items: list[dict[str, Any]] = []
    products = {product.day: product for product in found.products}
    for record in found.records:
        # A day without a product still has its estimates.
        product = products.get(record.day)
        flag = np.empty(0, np.uint32) if product is None else found.cat.read(product, ["flag"])["flag"].values
        items.append(
            {
                "day": str(record.day),
                "told": str(record.report.get("phase", "")),
                "sub_intervals": str(record.report.get("told", "")),
                "bridged": _share(flag, Flag.PHASE_BRIDGED),
                "jump": _share(flag, Flag.PHASE_JUMP),
                "lost": _share(flag, Flag.NO_PHASE),
            }
        )
    part.fields = {"items": items}
    rows = [
        (
            one["day"],
            *(
                f"{100.0 * one[name]:.2f}" if np.isfinite(one[name]) else "no product"
                for name in ("bridged", "jump", "lost")
            ),
            one["told"],
            one["sub_intervals"],
        )
        for one in items[-_SHOWN:]
    ]
    head = ("day", "bridged, %", "at a jump, %", "no phase, %", "what the phase tells", "sub-intervals")
    part.text.append(html_table(head, rows, kind="wide told"))
    return part


def _share(flag: np.ndarray, which: Flag) -> float:
    """Return the part of samples that carry a flag; NaN without any."""
    return float(np.mean((flag & np.uint32(which)) != 0)) if flag.size else float("nan")
