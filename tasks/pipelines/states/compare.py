"""Compare of two sensors on one boom: by how far the field steps where the spacecraft switches.

The steps of the corrected field are held against those of the measured one and against the field where
nothing switches; what is left is regressed on housekeeping. The page shows steps, states, units, before and
after.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
    before_after_figure,
    bullet_list,
    correction_figure,
    difference_figure,
    html_table,
    switching_steps_figure,
    timeline_figure,
)
from inflight.mission import Mission
from inflight.tasks.pipelines.base import CompareResult, TextLine, scalar_channels
from inflight.tasks.pipelines.states.tables import (
    channel_changes,
    constant_changes,
    constant_sentences,
    joined_signs,
    unit_signs,
)
from inflight.tasks.report import Progress
from inflight.time import SECOND, Int64, to_utc, usual_step

#: Points of a curve that a browser can draw.
_POINTS = 20_000

#: Said where nothing switched.
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
    """What a comparison keeps of a day: its switchings, its stretches, a thin series."""

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
    """

    comparison: str
    context: str
    days: list[DualDayRows]
    fails_where: list[tuple[ResidualStep, str]]
    tables: list[xr.Dataset]
    path: Path | None = None

    def joined(self, name: str) -> Floats:
        """Return an array of all days, (switching, axis)."""
        return np.concatenate([getattr(one, name) for one in self.days])

    @property
    def signs(self) -> Floats:
        """Which units are switched at each switching of all days; (switching, number of unit)."""
        return joined_signs([one.signs for one in self.days])

    @property
    def constants(self) -> list[dict[str, str]]:
        """Where the constant part of the field becomes another."""
        return constant_changes({one.day.day: one.constant for one in self.days})

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON; a residual is a step's rms component, nT."""
        before, after, floor = (rms_of_steps(self.joined(name)) for name in ("before", "after", "quiet"))
        known = bool(np.isfinite(before))
        return {
            "command": "compare",
            "run": "",
            "context": self.context,
            "comparison": self.comparison,
            "kind": "dual",
            "residual": {
                "what": "step of the outboard field where the spacecraft switches, rms of a component",
                "before_nT": before,
                "after_nT": after,
                "noise_floor_nT": floor,
                "switchings": int(sum(len(one.at) for one in self.days)),
                "note": "" if known else _NO_SWITCHING,
            },
            "by_day": [told_of_day(one) for one in self.days],
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
                "told": verdict_told(self),
            },
            "path": str(self.path) if self.path else "",
        }

    def summary(self) -> list[TextLine]:
        """Return how far the field steps at switchings, before and after, and what is left."""
        fields = self.as_json()
        residual = fields["residual"]
        if residual["note"]:
            out = [TextLine(residual["note"])]
        else:
            out = [TextLine(f"{residual['what']} ({residual['switchings']} switchings):")]
            for name, label in (("before", "as measured"), ("after", "corrected"), ("noise_floor", "floor")):
                out.append(TextLine(f"  {label:<12} {residual[f'{name}_nT']:8.3f} nT", "bold"))
        out += [TextLine(f"  {told}") for told in fields["verdict"]["told"]]
        return out + [TextLine(f"  {failing['sentence']}") for failing in fields["fails_where"]]


def compare_dual(
    cat: Catalog, mission: Mission, comparison: str, days: Sequence[Day], tell: Progress
) -> CompareResult[DualCompareReport]:
    """Measure what is left at the switchings of published products.

    Parameters
    ----------
    days : sequence of Day
        Of the products.
    tell : callable
        Called with (stage, done, total).
    """
    rows = []
    tables: dict[int, xr.Dataset] = {}
    for done, day in enumerate(days):
        tell("compare", done, len(days))
        table = cat.table(f"{comparison}-states", str(day.day))
        tables.setdefault(int(table.attrs["table_id"]), table)
        rows.append(day_rows(cat, mission, day, table, thin=max(1, 86_400 * len(days) // _POINTS)))
    tell("compare", len(days), len(days))
    report = DualCompareReport(comparison, days[-1].context or "", rows, [], list(tables.values()))
    report.fails_where = sorted(
        fails_where(report, mission), key=lambda one: -float(np.abs(one[0].value / one[0].sigma).max())
    )
    title = f"{mission.mission}: two sensors on one boom, {days[0].day} to {days[-1].day}"
    return CompareResult(report, title, states_parts(report))


def day_rows(cat: Catalog, mission: Mission, day: Day, table: xr.Dataset, thin: int) -> DualDayRows:
    """Return what is kept of a day; every `thin`-th sample is drawn."""
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
    """Yield what the steps that are left go with, and its unit: states, units, currents."""
    steps = report.joined("after")
    at = Switchings(
        *(
            np.concatenate([getattr(one.at, name) for one in report.days])
            for name in ("last", "first", "before", "after", "room")
        )
    )
    floor = rms_of_steps(report.joined("quiet"))
    for one in residual_steps_by_state(at, steps):
        if one.is_clear:
            yield one, "nT"
    signs = report.signs
    for unit in range(signs.shape[1]):
        found = regress_steps(f"unit {unit}", steps, signs[:, unit])
        if found is not None and found.is_clear:
            yield found, "nT"
    known = scalar_channels(mission)
    for name in sorted({name for one in report.days for name in one.changes}):
        change = np.concatenate([one.changes.get(name, np.full(len(one.at), np.nan)) for one in report.days])
        found = regress_steps(name, steps, change)
        # A change of noise alone makes a slope of any size: it must matter at the channel's usual change.
        usual = float(np.nanmax(np.abs(change), initial=0.0))
        if found is not None and found.is_clear and np.abs(found.value).max() * usual > floor:
            yield found, f"nT/{known[name][2].unit if name in known else 'unit'}"


def told_of_day(one: DualDayRows) -> dict[str, Any]:
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
        ("Steps at switchings", lambda: (_residual_text(report), _step_figures(report))),
        ("Where it fails", lambda: (_fails_text(report), [])),
        ("States", lambda: (_states_text(report), _state_figures(report))),
        ("Units", lambda: (_units_text(report), [])),
        ("Before and after", lambda: ([], _series_figures(report))),
    ]


def _residual_text(report: DualCompareReport) -> list[str]:
    rows = [
        (
            one["day"],
            one["method"] if one["applied"] == "yes" else "none",
            str(one["switchings"]),
            *(_number(one[name]) for name in ("before_nT", "after_nT", "noise_floor_nT")),
            _verdict(of_day) if one["applied"] == "yes" else "left as measured, see below",
        )
        for one, of_day in ((told_of_day(one), one) for one in report.days)
    ]
    head = ("day", "method", "switchings", "as measured, nT", "corrected, nT", "floor, nT", "verdict")
    told = [
        "The ambient field does not know when the spacecraft switches. Without a stray field it steps "
        "there no more than elsewhere: that is the floor. A constant error is not in these numbers.",
        "A correction is judged on stretches that it was not learnt from (held out). The slope tells how "
        "much of what it takes off is in the outboard reading: one where it is right.",
        html_table(head, rows, kind="wide told"),
    ]
    if not np.isfinite(report.joined("before")).any():
        told.append("Nothing switched in the span between readings: there are no steps to draw.")
    # What speaks against each correction that was tried, for the days of one reason.
    listed = [
        bullet_list(reason.replace("+-", "±").split("; "), before=f"{_days_told(days)} left as measured:")
        for (applied, reason), days in _reasons(report).items()
        if applied != "yes"
    ]
    sentences = [_sentence(one) for one in constant_sentences(report.constants)]
    return [*told, bullet_list([*listed, *sentences])] if listed or sentences else told


def _verdict(one: DualDayRows) -> str:
    """Return why a day is corrected; its method has a column of its own."""
    return one.reason.removeprefix(f"{one.method}: ").replace("+-", "±")


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else "none"


def verdict_told(report: DualCompareReport) -> list[str]:
    """Return which days are corrected or left alone and why, and where the field may step by a constant."""
    told = [
        f"{_days_told(days)}: {'corrected' if applied == 'yes' else 'LEFT AS MEASURED'}, {reason}."
        for (applied, reason), days in _reasons(report).items()
        if reason
    ]
    return told + [_sentence(one) for one in constant_sentences(report.constants)]


def _reasons(report: DualCompareReport) -> dict[tuple[str, str], list[str]]:
    """Return the days by whether they are corrected and why."""
    days: dict[tuple[str, str], list[str]] = {}
    for one in report.days:
        days.setdefault((one.applied, one.reason), []).append(str(one.day.day))
    return days


def _days_told(days: list[str]) -> str:
    return days[0] if len(days) == 1 else f"{len(days)} days from {days[0]} to {days[-1]}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _step_figures(report: DualCompareReport) -> list[Any]:
    parts = report.joined("difference"), report.joined("before"), report.joined("after")
    return [switching_steps_figure(*parts, axis) for axis in range(3)] if np.isfinite(parts[1]).any() else []


def _fails_text(report: DualCompareReport) -> list[str]:
    if not report.fails_where:
        return ["No state, unit or current goes with what is left at the switchings, by four sigma."]
    return [bullet_list([one.sentence(unit) for one, unit in report.fails_where], ordered=True)]


def _states_text(report: DualCompareReport) -> list[str]:
    """Return the states: how long and how often each held, its units, its difference and its correction."""
    seconds: dict[int, float] = {}
    times: dict[int, int] = {}
    for one in report.days:
        for state, begin, end in zip(
            one.stretches.state.tolist(), one.stretches.begin, one.stretches.end, strict=True
        ):
            seconds[state] = seconds.get(state, 0.0) + float(end - begin) / SECOND
            times[state] = times.get(state, 0) + 1
    known = _of_states(report.tables)
    rows = [
        (
            {-1: "unknown", -2: "transient"}.get(state, str(state)),
            *known.get(state, ("", "", "")),
            str(times.get(state, 0)),
            f"{seconds.get(state, 0.0) / 3600.0:.2f}",
        )
        for state in sorted({*seconds, *known})
    ]
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


def _of_states(tables: Sequence[xr.Dataset]) -> dict[int, tuple[str, str, str]]:
    """Return units on, difference and outboard field of each state, as text, from the last table with it."""
    return {
        int(number): (
            _units_on(table, at),
            _vector(table["centre"].values[at]),
            _vector(
                table["correction"].values[at],
                np.sqrt(np.clip(np.diag(table["covariance"].values[at]), 0.0, None)),
            ),
        )
        for table in tables
        for at, number in enumerate(table["number"].values)
        if np.isfinite(table["centre"].values[at]).all()
    }


def _units_on(table: xr.Dataset, row: int) -> str:
    on = table["unit_number"].values[table["occupancy"].values[row] > 0.5]
    return ", ".join(str(unit) for unit in sorted(on.tolist())) or "none"


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
    names = sorted({name for one in report.days for name in one.changes})
    changes = {
        name: np.concatenate([one.changes.get(name, np.full(len(one.at), np.nan)) for one in report.days])
        for name in names
    }
    rows = []
    for one in match_channels_to_units(signs, changes):
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
    parts = [one.stretches for one in report.days]
    begin, end, state, sure, mean = (
        np.concatenate([getattr(one, name) for one in parts])
        for name in ("begin", "end", "state", "probability", "difference")
    )
    settled = (state != -2) & np.isfinite(mean).all(axis=1)
    known = {
        int(number): (table["centre"].values[at], _spread(table, at))
        for table in report.tables
        for at, number in enumerate(table["number"].values)
    }
    planes = [difference_figure(mean[settled], state[settled], known, plane) for plane in PLANES]
    return [*planes, timeline_figure(to_utc(begin), to_utc(end), state, sure)]


def _spread(table: xr.Dataset, row: int) -> Floats:
    """Return the covariance of a state's points: of its centre and of their scatter beyond noise; nT^2."""
    scatter = float(table.attrs["scatter"]) ** 2
    return np.asarray(table["centre_covariance"].values[row] + scatter * np.eye(3))


def _series_figures(report: DualCompareReport) -> list[Any]:
    time = to_utc(np.concatenate([one.stamps for one in report.days]))
    outboard, field = report.joined("outboard"), report.joined("field")
    both = [before_after_figure(time, outboard, field, axis) for axis in range(3)]
    return [*both, correction_figure(time, outboard - field)]
