"""Compare of two sensors on one boom: by how far the field steps where the spacecraft switches.

The steps of the corrected field are compared with those of the measured one and with the field where nothing
switches; what remains is regressed on states, units and housekeeping. The page shows steps, states, units,
and the field before and after.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.dual import (
    ResidualStep,
    Switchings,
    match_channels_to_units,
    quiet_steps,
    quietest_width,
    regress_steps,
    residual_steps_by_state,
    rms_of_steps,
    steps_across,
    switchings,
)
from inflight.figures import (
    PLANES,
    LazySection,
    SectionBody,
    before_after_figure,
    bullet_list,
    correction_figure,
    difference_figure,
    html_table,
    switching_steps_figure,
    timeline_figure,
)
from inflight.mission import Mission
from inflight.plumbing import Finding
from inflight.progress import Progress, tell_each
from inflight.tasks.pipelines.base import CompareResult, TextLine, plumbing_lines, scalar_channels
from inflight.tasks.pipelines.two_sensor.tables import (
    channel_changes,
    concatenate_changes,
    concatenate_signs,
    constant_changes,
    constant_sentences,
    unit_signs,
)
from inflight.time import SECOND, Int64, to_utc, usual_step

#: Points of a curve that a browser can draw.
_POINTS = 20_000

_NO_SWITCHING = "nothing switched in the span, so that its steps tell nothing of the correction"


@dataclass(frozen=True)
class Stretches:
    """Stretches of one state.

    Attributes
    ----------
    begin, end : ndarray of int64, shape (stretch,)
        TT2000; a stretch ends one step after its last sample.
    state : ndarray of int64, shape (stretch,)
    probability : ndarray, shape (stretch,)
    difference : ndarray, shape (stretch, axis)
        Mean ``B_in - B_out``, nT; NaN without a reading.
    """

    begin: Int64
    end: Int64
    state: Int64
    probability: Floats
    difference: Floats


@dataclass(frozen=True)
class DualDayRows:
    """What a comparison keeps of a day.

    Attributes
    ----------
    method, applied, reason, constant : str
        Attributes of the product.
    at : Switchings
    before, after, difference : ndarray, shape (switching, axis)
        Steps of the outboard reading, of the corrected field and of the difference of both sensors, nT.
    quiet : ndarray, shape (time, axis)
        Steps of the corrected field where nothing switches, nT.
    signs : ndarray, shape (switching, unit)
        See `unit_signs`.
    changes : mapping of str to ndarray
        See `channel_changes`.
    stretches : Stretches
    stamps, outboard, field : ndarray
        A thinned series of outboard reading and corrected field.
    """

    day: Day
    method: str
    applied: str
    reason: str
    constant: str
    at: Switchings
    before: Floats
    after: Floats
    quiet: Floats
    difference: Floats
    signs: Floats
    changes: Mapping[str, Floats]
    stretches: Stretches
    stamps: Int64
    outboard: Floats
    field: Floats


@dataclass
class DualCompareReport:
    """What `compare_dual` found.

    Attributes
    ----------
    tables : list of Dataset
        Tables of states that hold in the span, each once, oldest first.
    path : Path, optional
        Of the page, when one was written.
    plumbing : sequence of Finding
        Faults of units, clocks, axes and channels of the span.
    """

    comparison: str
    context: str
    days: list[DualDayRows]
    fails_where: list[tuple[ResidualStep, str]]
    tables: list[xr.Dataset]
    path: Path | None = None
    plumbing: Sequence[Finding] = ()

    def concatenated(self, name: str) -> Floats:
        """Return an array of all days, such as (switching, axis)."""
        return np.concatenate([getattr(day, name) for day in self.days])

    @property
    def signs(self) -> Floats:
        """Which units are switched at each switching of all days; (switching, number of unit)."""
        return concatenate_signs([day.signs for day in self.days])

    @property
    def stretches(self) -> Stretches:
        """The stretches of all days."""
        names = (one.name for one in fields(Stretches))
        return Stretches(
            *(np.concatenate([getattr(day.stretches, name) for day in self.days]) for name in names)
        )

    @property
    def changes(self) -> dict[str, Floats]:
        """How housekeeping changed at each switching of all days, by channel; (switching,)."""
        return concatenate_changes([day.changes for day in self.days], [len(day.at) for day in self.days])

    @property
    def by_reason(self) -> dict[tuple[str, str], list[str]]:
        """The days, by whether they are corrected and why."""
        days: dict[tuple[str, str], list[str]] = {}
        for one in self.days:
            days.setdefault((one.applied, one.reason), []).append(str(one.day.day))
        return days

    @property
    def constants(self) -> list[dict[str, str]]:
        """Where the constant part of the field becomes another."""
        return constant_changes({one.day.day: one.constant for one in self.days})

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON; a residual is a step's rms component, nT."""
        sizes = (rms_of_steps(self.concatenated(name)) for name in ("before", "after", "quiet"))
        before, after, floor = sizes
        known = bool(np.isfinite(before))
        return {
            "command": "compare",
            "run": "",
            "context": self.context,
            "comparison": self.comparison,
            "kind": "dual",
            "plumbing": [dict(one.as_json()) for one in self.plumbing],
            "residual": {
                "what": "step of the outboard field where the spacecraft switches, rms of a component",
                "before_nT": before,
                "after_nT": after,
                "noise_floor_nT": floor,
                "switchings": int(sum(len(one.at) for one in self.days)),
                "note": "" if known else _NO_SWITCHING,
            },
            "by_day": [day_fields(one) for one in self.days],
            "fails_where": [
                {
                    "coordinate": one.coordinate,
                    "amplitude_nT": float(np.abs(one.value).max()),
                    "sigma_nT": float(one.sigma[np.argmax(np.abs(one.value))]),
                    "sentence": one.sentence(unit),
                }
                for one, unit in self.fails_where
            ],
            "constant_changes": self.constants,
            "verdict": {
                "applied": sorted({one.applied for one in self.days}),
                "reasons": sorted({one.reason for one in self.days if one.reason}),
                "told": verdict_sentences(self),
            },
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return how far the field steps at switchings before and after, and what the rest depends on."""
        content = self.as_json()
        residual = content["residual"]
        if residual["note"]:
            out = [TextLine(residual["note"])]
        else:
            out = [TextLine(f"{residual['what']} ({residual['switchings']} switchings):")]
            for name, label in (("before", "as measured"), ("after", "corrected"), ("noise_floor", "floor")):
                out.append(TextLine(f"  {label:<12} {residual[f'{name}_nT']:8.3f} nT", "bold"))
        out += [TextLine(f"  {sentence}") for sentence in content["verdict"]["told"]]
        out += [TextLine(f"  {failing['sentence']}") for failing in content["fails_where"]]
        return plumbing_lines(self.plumbing) + out


def compare_dual(
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], progress: Progress
) -> CompareResult[DualCompareReport]:
    """Measure the steps of published products at switchings.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    progress : callable
        Called with (stage, done, total).
    """
    rows = []
    tables: dict[int, xr.Dataset] = {}
    for day in tell_each(progress, "compare", days):
        table = cat.table(f"{comparison}-states", str(day.day))
        tables.setdefault(int(table.attrs["table_id"]), table)
        rows.append(day_rows(cat, mission, day, table, thin=max(1, 86_400 * len(days) // _POINTS)))
    report = DualCompareReport(comparison, days[-1].context or "", rows, [], list(tables.values()))
    report.fails_where = sorted(
        fails_where(report, mission), key=lambda one: -float(np.abs(one[0].value / one[0].sigma).max())
    )
    title = f"{mission.mission}: two sensors on one boom, {days[0].day} to {days[-1].day}"
    return CompareResult(report, title, states_parts(report))


def day_rows(cat: Catalog, mission: Mission, day: Day, table: xr.Dataset, thin: int) -> DualDayRows:
    """Return what is kept of a day; one of `thin` samples is drawn."""
    product = cat.read(day, with_time=False)
    stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
    state = np.asarray(product["state"].values, dtype=np.int64)
    outboard, field = (
        np.asarray(product[name].values, dtype=np.float64) for name in ("outboard", "field_spacecraft")
    )
    difference = np.asarray(product["inboard"].values, dtype=np.float64) - outboard
    at = switchings(state, stamps, usual_step(stamps, SECOND))
    width = quietest_width(field, at)
    thinned = slice(None, None, thin)
    return DualDayRows(
        day,
        str(product.attrs["method"]),
        str(product.attrs["applied"]),
        str(product.attrs["reason"]),
        str(product.attrs.get("constant", "")),
        at,
        steps_across(outboard, at, width),
        steps_across(field, at, width),
        quiet_steps(field, at, width),
        steps_across(difference, at, width),
        unit_signs(table, at),
        channel_changes(cat, mission, day.day, stamps[at.last], stamps[at.first]),
        stretches_of(state, product["probability"].values, difference, stamps, usual_step(stamps, SECOND)),
        stamps[thinned],
        outboard[thinned],
        field[thinned],
    )


def stretches_of(
    state: Int64, probability: Floats, difference: Floats, stamps: Int64, step: int
) -> Stretches:
    """Return the stretches of one state each; samples without a reading count in none of the means."""
    edges = np.flatnonzero(np.diff(state)) + 1
    first = np.concatenate([[0], edges]).astype(np.int64)
    last = np.concatenate([edges, [state.size]]).astype(np.int64)
    good: npt.NDArray[np.bool_] = np.asarray(np.isfinite(difference).all(axis=1))
    counts = np.add.reduceat(good.astype(np.float64), first)
    counts = np.where(counts > 0.0, counts, np.nan)
    mean = np.add.reduceat(np.where(good[:, None], difference, 0.0), first, axis=0) / counts[:, None]
    sure = np.asarray(probability, dtype=np.float64)[first]
    return Stretches(stamps[first], stamps[last - 1] + step, state[first], sure, mean)


def fails_where(report: DualCompareReport, mission: Mission) -> Iterator[tuple[ResidualStep, str]]:
    """Yield what the remaining steps depend on, with its unit: states, units, currents."""
    steps = report.concatenated("after")
    at = Switchings(
        *(
            np.concatenate([getattr(one.at, name) for one in report.days])
            for name in ("last", "first", "before", "after", "room")
        )
    )
    floor = rms_of_steps(report.concatenated("quiet"))
    for one in residual_steps_by_state(at, steps):
        if one.is_clear:
            yield one, "nT"
    signs = report.signs
    for unit in range(signs.shape[1]):
        found = regress_steps(f"unit {unit}", steps, signs[:, unit])
        if found is not None and found.is_clear:
            yield found, "nT"
    known = scalar_channels(mission)
    for name, change in report.changes.items():
        found = regress_steps(name, steps, change)
        # A change of noise alone makes a slope of any size: it must matter at the channel's usual change.
        usual = float(np.nanmax(np.abs(change), initial=0.0))
        if found is not None and found.is_clear and np.abs(found.value).max() * usual > floor:
            yield found, f"nT/{known[name][2].unit if name in known else 'unit'}"


def day_fields(one: DualDayRows) -> dict[str, Any]:
    """Return a day's steps before and after, and what was applied, as plain fields."""
    return {
        "day": str(one.day.day),
        "version": one.day.version,
        "before_nT": rms_of_steps(one.before),
        "after_nT": rms_of_steps(one.after),
        "noise_floor_nT": rms_of_steps(one.quiet),
        "switchings": len(one.at),
        "applied": one.applied,
        "method": one.method,
    }


def states_parts(report: DualCompareReport) -> list[LazySection]:
    """Return everything that is shown of two sensors, as the page and the explorer have it."""
    return [
        ("Steps at switchings", lambda: _steps(report)),
        ("Where it fails", lambda: (_failures_text(report), [])),
        ("States", lambda: (_states_text(report), _state_figures(report))),
        ("Units", lambda: (_units_text(report), [])),
        ("Before and after", lambda: _before_and_after(report)),
    ]


def _steps(report: DualCompareReport) -> SectionBody:
    """Return the steps of each day, and why a day is corrected or not."""
    rows = []
    for one in report.days:
        content, corrected = day_fields(one), one.applied == "yes"
        # The method has a column of its own.
        reason = one.reason.removeprefix(f"{one.method}: ").replace("+-", "±")
        sizes = (content[name] for name in ("before_nT", "after_nT", "noise_floor_nT"))
        rows.append(
            (
                content["day"],
                one.method if corrected else "none",
                str(content["switchings"]),
                *(f"{size:.4f}" if np.isfinite(size) else "none" for size in sizes),
                reason if corrected else "left as measured, see below",
            )
        )
    head = ("day", "method", "switchings", "as measured, nT", "corrected, nT", "floor, nT", "verdict")
    text = [
        "The ambient field does not know when the spacecraft switches. Without a stray field it steps "
        "there no more than elsewhere: that is the floor. A constant error is not in these numbers.",
        "A correction is judged on stretches that it was not learnt from (held out). The slope tells how "
        "much of what it takes off is in the outboard reading: one where it is right.",
        html_table(head, rows, kind="wide told"),
    ]
    difference, before, after = (report.concatenated(name) for name in ("difference", "before", "after"))
    switched = bool(np.isfinite(before).any())
    if not switched:
        text.append("Nothing switched in the span between readings: there are no steps to draw.")
    # What speaks against each correction that was tried, for the days of one reason.
    listed: list[str] = [
        bullet_list(reason.replace("+-", "±").split("; "), before=f"{_name_days(days)} left as measured:")
        for (applied, reason), days in report.by_reason.items()
        if applied != "yes"
    ]
    listed += [_capitalised(sentence) for sentence in constant_sentences(report.constants)]
    if listed:
        text.append(bullet_list(listed))
    axes = range(3) if switched else ()
    return text, [switching_steps_figure(difference, before, after, axis) for axis in axes]


def verdict_sentences(report: DualCompareReport) -> list[str]:
    """Return which days are corrected or left alone and why, and where the field may step by a constant."""
    sentences = [
        f"{_name_days(days)}: {'corrected' if applied == 'yes' else 'LEFT AS MEASURED'}, {reason}."
        for (applied, reason), days in report.by_reason.items()
        if reason
    ]
    return sentences + [_capitalised(sentence) for sentence in constant_sentences(report.constants)]


def _name_days(days: list[str]) -> str:
    return days[0] if len(days) == 1 else f"{len(days)} days from {days[0]} to {days[-1]}"


def _capitalised(sentence: str) -> str:
    return f"{sentence[:1].upper()}{sentence[1:]}."


def _failures_text(report: DualCompareReport) -> list[str]:
    if not report.fails_where:
        return ["No state, unit or current goes with what is left at the switchings, by four sigma."]
    return [bullet_list([one.sentence(unit) for one, unit in report.fails_where], ordered=True)]


def _states_text(report: DualCompareReport) -> list[str]:
    """Return the states: how long and how often each held, its units, its difference and its correction."""
    known = {
        int(number): _state_cells(table, row)
        for table in report.tables
        for row, number in enumerate(table["number"].values)
        if np.isfinite(table["centre"].values[row]).all()
    }
    stretches, rows = report.stretches, []
    for state in sorted({*stretches.state.tolist(), *known}):
        held = stretches.state == state
        hours = float(np.sum((stretches.end - stretches.begin)[held] / SECOND)) / 3600.0
        name = {-1: "unknown", -2: "transient"}.get(state, str(state))
        rows.append((name, *known.get(state, ("", "", "")), str(int(held.sum())), f"{hours:.2f}"))
    head = ("state", "units on", "difference x, y, z (nT)", "outboard x, y, z (nT)", "stretches", "hours")
    return [
        "A state is what is switched on together. It has one place in the space of the difference of both "
        "sensors (inboard less outboard); its field at the outboard sensor is relative to that of one state. "
        "A unit is what is switched as one. Numbers stay from window to window; fields are those of the last "
        "window that knew the state.",
        "Points are stretches between switchings, ellipses two standard deviations of a state's points. "
        "Points move away from their ellipse where the difference drifts.",
        html_table(head, rows, kind="wide told"),
    ]


def _state_cells(table: xr.Dataset, row: int) -> tuple[str, str, str]:
    """Return units on, difference and outboard field of a state as text."""
    on = sorted(table["unit_number"].values[table["occupancy"].values[row] > 0.5].tolist())
    error = np.sqrt(np.clip(np.diag(table["covariance"].values[row]), 0.0, None))
    return (
        ", ".join(map(str, on)) or "none",
        _vector(table["centre"].values[row]),
        _vector(table["correction"].values[row], error),
    )


def _vector(value: Floats, sigma: Floats | None = None) -> str:
    if sigma is None:
        return ", ".join(f"{one:+.2f}" for one in value)
    return ", ".join(f"{one:+.2f} ± {error:.2f}" for one, error in zip(value, sigma, strict=True))


def _units_text(report: DualCompareReport) -> list[str]:
    """Return the units whose sums make the states, and the channels behind them."""
    signs = report.signs
    known = {
        int(unit): (table, row)
        for table in report.tables
        for row, unit in enumerate(table["unit_number"].values)
    }
    if not signs.shape[1]:
        return ["There are no units: nothing was seen to switch by itself."]
    rows = []
    for one in match_channels_to_units(signs, report.changes):
        if one.unit not in known:
            continue
        table, row = known[one.unit]
        error = np.sqrt(np.clip(np.diag(table["unit_covariance"].values[row]), 0.0, None))
        rows.append(
            (
                str(one.unit),
                " or ".join(one.channels) or "a unit without housekeeping",
                str(one.switchings),
                _vector(table["unit"].values[row]),
                _vector(table["unit_correction"].values[row], error),
                one.reason,
            )
        )
    head = (
        "unit",
        "switches with",
        "switchings",
        "difference x, y, z (nT)",
        "outboard x, y, z (nT)",
        "why no channel",
    )
    return [html_table(head, rows, kind="wide told")]


def _state_figures(report: DualCompareReport) -> list[Any]:
    stretches = report.stretches
    state, mean = stretches.state, stretches.difference
    settled = (state != -2) & np.isfinite(mean).all(axis=1)
    # Centre of each state's points and their covariance, nT^2: of the centre, and their scatter beyond noise.
    known = {}
    for table in report.tables:
        scatter = float(table.attrs["scatter"]) ** 2 * np.eye(3)
        for row, number in enumerate(table["number"].values):
            spread = np.asarray(table["centre_covariance"].values[row] + scatter)
            known[int(number)] = (table["centre"].values[row], spread)
    planes = [difference_figure(mean[settled], state[settled], known, plane) for plane in PLANES]
    return [
        *planes,
        timeline_figure(to_utc(stretches.begin), to_utc(stretches.end), state, stretches.probability),
    ]


def _before_and_after(report: DualCompareReport) -> SectionBody:
    time = to_utc(report.concatenated("stamps"))
    outboard, field = report.concatenated("outboard"), report.concatenated("field")
    both = [before_after_figure(time, outboard, field, axis) for axis in range(3)]
    return [], [*both, correction_figure(time, outboard - field)]
