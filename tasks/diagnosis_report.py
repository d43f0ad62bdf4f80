"""The report of a diagnosis: one HTML file that needs nothing but itself."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from inflight import __version__
from inflight.catalog import Catalog
from inflight.diagnosis.diagnosis import Diagnosis, Signature
from inflight.diagnosis.pictures import (
    Seen,
    along_field,
    epoch,
    heat_maps,
    responses,
    seen_of,
    sizes_of,
)
from inflight.diagnosis.search import Search
from inflight.diagnosis.signature import Periodogram, fold, periodogram
from inflight.diagnosis.tradeoffs import cross_talk, shifts_of, trials, waterfall
from inflight.diagnosis.verdict import Material, conclude, known_periods, lag_profile
from inflight.figures.candidates import candidate_table, drop_figure, unscorable_list
from inflight.figures.crosstalk import cross_talk_figure, shift_table, strongest_pairs
from inflight.figures.heatmap import heat_map_figures
from inflight.figures.lagprofile import lag_figure
from inflight.figures.ledger import facts_list, ledger_table
from inflight.figures.naming import short_name
from inflight.figures.page import html_page, html_table
from inflight.figures.periodogram import periodogram_figures
from inflight.figures.residual import daily_figure, histogram_figure
from inflight.figures.response import along_field_figures, epoch_figure, fold_figure, response_figures
from inflight.figures.verdict import verdict_strip
from inflight.figures.waterfall import waterfall_figure
from inflight.lines import drawn_periods, told_period
from inflight.lines import known_periods as named_periods
from inflight.mission import Mission
from inflight.tasks.diagnose import DiagnoseSettings, material_of, prepare, search_of
from inflight.tasks.report import Progress
from inflight.time import SECOND, DayLike, to_utc

#: Channels whose response is drawn, beside those of found effects; and found effects drawn one by one.
_CHANNELS, _EFFECTS = 6, 6
_STATES = ("before", "after")

Section = tuple[str, list[str], list[Any]]


@dataclass(frozen=True)
class DiagnosisReport:
    """A diagnosis and the page that shows it."""

    diagnosis: Diagnosis
    path: Path

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        told = self.diagnosis.as_json()
        names = ("run", "context", "comparison", "model", "verdict", "sentence", "residual", "remaining")
        effects = [{"name": one["name"], "family": one["family"]} for one in told["effects"]]
        return (
            {"command": "report", "path": str(self.path)}
            | {name: told[name] for name in names}
            | {"effects": effects}
        )


def report(
    cat: Catalog,
    mission: Mission,
    output: Path,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> DiagnosisReport:
    """Diagnose a span and write the page of it; evidence that is there already is not made again.

    Parameters
    ----------
    output : Path
        Where the page goes; written whole, by one rename.
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    client : distributed.Client, optional
        The pass runs on it.
    progress : callable, optional
        Called with (stage, done, total).

    Raises
    ------
    MissionError, ModelError, CatalogError, CalibrationError
        As `inflight.tasks.diagnose.diagnose` raises them.
    """
    settings = settings or DiagnoseSettings()
    tell = progress or (lambda stage, done, total: None)
    made = prepare(cat, mission, start, end, settings, client=client, progress=progress)
    tell("search", 0, 1)
    search, material = search_of(made, settings), material_of(made, mission)
    found = conclude(search, material)
    tell("search", 1, 1)
    tell("report", 0, 1)
    facts = {"evidence key": made.plan.key, "days that failed": made.days_failed or None}
    page = diagnosis_page(search, material, found, settings, facts)
    output.parent.mkdir(parents=True, exist_ok=True)
    unfinished = output.with_name(f".{output.name}.part")
    unfinished.write_text(page, encoding="utf-8")
    unfinished.replace(output)
    tell("report", 1, 1)
    return DiagnosisReport(found, output)


def diagnosis_page(
    search: Search,
    material: Material,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any] | None = None,
) -> str:
    """Return the page of a finished search as HTML.

    Parameters
    ----------
    search : Search
        As `conclude` left it.
    facts : mapping, optional
        More lines of the ledger.
    """
    seen = seen_of(search, material)
    raw = search.raw
    first, last = (np.datetime_as_string(to_utc(int(edge)), "D") for edge in (raw.start[0], raw.end[-1] - 1))
    told = found.as_json()
    strip = verdict_strip(found.verdict, found.sentence, told["residual"], told["remaining"]["verdict"])
    sections: list[Section] = [
        ("Verdict", [strip, *_effects(found), *_rivals(found)], []),
        _fails_here(seen),
        _follows(seen, found),
        _spectrum(seen, material),
        _which(search, material, found),
        _falls(seen, search, material, found),
        _shapes(seen, search, found),
        _stands_for(search, found),
        _ledger(search, material, found, settings, facts or {}),
    ]
    name = f"{material.mission.mission}: what is missing from the model, {first} to {last}"
    kept = [section for section in sections if section[1] or section[2]]
    return html_page(name, kept, material.mission.acknowledgement)


# Verdict.


def _effects(found: Diagnosis) -> list[str]:
    """Return the found effects with all their values as a table."""
    if not found.effects:
        return [f"<p>No effect was added: {escape(found.stopped)}.</p>", *_signature(found)]
    head = ("found", "family", "value ± sigma", "at", "gain", "t", "p", "retained", "W/k", "rms, nT")
    rows = []
    for one in found.effects:
        for place, value in enumerate(one.coefficients):
            own = (short_name(one.name), one.family.replace("_", " ")) if place == 0 else ("", "")
            numbers = (
                f"{one.gain:.1%}",
                f"{one.t:.1f}",
                f"{one.flip_p:.2g}",
                f"{one.retained:.2g}",
                f"{one.consistency:.1f}" if one.consistency is not None else "",
                f"{one.rms_nT:.3g}",
            )
            said = f"{value.name} {value.value:.4g} ± {value.sigma:.2g} {value.unit}"
            rows.append((*own, said, value.at, *(numbers if place == 0 else ("",) * len(numbers))))
    note = (
        "Gain, t and family-wise p are held out, against the model without the effect; retained is the part "
        "of its variance that no other parameter explains; W/k compares raw and within-day values, and large "
        "ones hint at a wrong form."
    )
    stopped = f"The rounds ended: {found.stopped}."
    return [
        html_table(head, rows),
        f'<p class="quiet">{escape(note)} {escape(stopped)}</p>',
        *_signature(found),
    ]


def _signature(found: Diagnosis) -> list[str]:
    left: Signature | None = found.remaining.get("signature")
    if left is None:
        return []
    parts = [
        ("period", f"{told_period(left.period_s)}" if left.period_s else ""),
        ("axis", left.axis or ""),
        ("shape", left.shape or ""),
        ("amplitude", f"{left.amplitude_nT:.3g} nT" if left.amplitude_nT else ""),
        ("channel", left.channel or ""),
        ("lag", told_period(left.lag_s) if left.lag_s else ""),
        ("duty", f"{left.duty:.2f}" if left.duty is not None else ""),
    ]
    said = ", ".join(f"{name} {value}" for name, value in parts if value)
    return [f"<p><b>Signature of what is left:</b> {escape(said)}</p>"]


def _rivals(found: Diagnosis) -> list[str]:
    if not found.confusion_set:
        return []
    out = []
    if found.separating:
        rows = [
            (
                " / ".join(short_name(name) for name in one["rivals"]),
                f"{one['start'][:16]} to {one['end'][:16]}",
                f"{one['difference_nT']:.2g}",
            )
            for one in found.separating
        ]
        out.append("<p>What would tell the rivals apart: the blocks in which they differ most.</p>")
        out.append(html_table(("rivals", "block (UTC)", "difference, nT rms"), rows))
    return out


# Fails here.


def _fails_here(seen: Seen) -> Section:
    plots = [plot for one in heat_maps(seen) for plot in heat_map_figures(one)]
    note = [
        "Vertical bands follow the orbit (an eclipse: edges that move with the season), horizontal ones are "
        "days or steps. Both maps share one scale of colours; the calibration is fitted in both."
    ]
    if not seen.is_scalar:
        note.append(f"The residual has several rows; row {'xyz'[seen.row]}, the largest, is drawn.")
    along = along_field(seen)
    if along:
        note.append(
            "Against the field's direction a field fixed in the sensor is a straight line: two lines are "
            "two offsets."
        )
    return (
        "Where it fails",
        [f'<p class="quiet">{escape(" ".join(note))}</p>'],
        plots + along_field_figures(along),
    )


def _follows(seen: Seen, found: Diagnosis) -> Section:
    found_ones = responses(seen, _channels(seen, found))
    note = (
        "Field along each sensor axis that would make the residual follow the channel, fitted bin by bin, "
        "one scale a channel. Bars are one sigma between blocks; the grey band is what the same channel explains "
        "at six other times, so only what leaves it counts; dotted is what is left after the found effects. "
        "Branches that part and meet again are a loop: hysteresis or a lag."
    )
    plots = [plot for one in found_ones for plot in response_figures(one)]
    return "What it follows", [f'<p class="quiet">{escape(note)}</p>'] if plots else [], plots


def _channels(seen: Seen, found: Diagnosis) -> list[str]:
    """Return the channels of found effects, then those of the best candidates."""
    there = [name for name in seen.series.channels if seen.series[name].ndim == 1]
    own = [name for one in found.effects for name in one.channels if name in there]
    others = [name for one in found.candidates if not one["placebo"] for name in one["channels"]]
    more = [name for name in dict.fromkeys(others) if name in there and name not in own]
    return [*dict.fromkeys(own), *more[:_CHANNELS]]


def _spectrum(seen: Seen, material: Material) -> Section:
    before, after = (_periodogram(seen, material, values) for values in (seen.before, seen.after))
    if before is None or after is None:
        return "Spectrum along each axis", [], []
    stated = {name: period / SECOND for name, period in material.mission.periods.items()}
    known = drawn_periods(named_periods(stated, None))
    note = (
        "The residual times the field's direction: a field along one axis shows at its own period there. "
        "Grey dotted periods are known; a red one stands beyond chance and nothing known explains it."
    )
    return (
        "Spectrum along each axis",
        [f'<p class="quiet">{escape(note)}</p>'],
        periodogram_figures(before, after, known),
    )


def _periodogram(seen: Seen, material: Material, values: np.ndarray) -> Periodogram | None:
    series = seen.series
    return periodogram(series.tt2000, values, series.direction(), series["weight"], known_periods(material))


# Which effect.


def _which(search: Search, material: Material, found: Diagnosis) -> Section:
    names = [str(one["name"]) for one in found.candidates if not one["placebo"]]
    rivals = {one.name: one.rivals for one in found.effects}
    note = (
        "Gain is the part of the mean square that a candidate alone takes off blocks it was not fitted to, "
        "with its 95 % interval; the grey bar behind it is the best placebo, a channel shifted in time, which "
        "explains by chance. p is family-wise over all candidates and forms. Values are those of the "
        "candidate alone."
    )
    text = [
        f'<p class="quiet">{escape(note)}</p>',
        candidate_table(found.candidates, trials(search, material, names), rivals),
        unscorable_list(found.unscorable),
    ]
    return "Which effect", [one for one in text if one], [drop_figure(found.candidates)]


# The error falls.


def _falls(seen: Seen, search: Search, material: Material, found: Diagnosis) -> Section:
    told = found.residual
    floor = tuple(float(told[f"noise_floor_{end}"]) for end in ("nT", "low_nT", "high_nT"))
    steps = waterfall(search, material)
    start, end = float(told["held_out_before_nT"]), float(told["held_out_after_nT"])
    sizes = sizes_of(seen)
    plots = [
        waterfall_figure(steps, start, end, (floor[0], floor[1], floor[2])),
        daily_figure(
            to_utc(sizes.day),
            sizes.rms["before"],
            sizes.rms["after"],
            float("nan"),
            _STATES,
        ),
        histogram_figure(sizes.edges, sizes.counts["before"], sizes.counts["after"], _STATES),
    ]
    note = (
        "All of the first figure is held out. Black bars reach from where the error would fall to if the "
        "effect were taken first to where it would fall to if it were taken last. Daily sizes and the "
        f"distribution are those of means of {seen.series.step_s:g} s, so they lie below the sizes at the native cadence."
    )
    return "How the error falls", [f'<p class="quiet">{escape(note)}</p>'], plots


def _shapes(seen: Seen, search: Search, found: Diagnosis) -> Section:
    """Lag profiles of responses, epochs of events, and the fold of a period that is left."""
    plots: list[Any] = []
    rows = float(search.forms["raw"].count.sum())
    for option in search.accepted[:_EFFECTS]:
        profile = lag_profile(search, option)
        if profile is not None:
            plots.append(lag_figure(option.name, profile, rows))
        if option.change is not None:
            plots += [epoch_figure(short_name(option.name), epoch(seen, when)) for when in option.change.at]
    left: Signature | None = found.remaining.get("signature")
    if left is not None and left.period_s:
        plots.append(_folded(seen, left.period_s))
    note = "The best lag lies between those of the bank; its error is a jackknife over folds of blocks."
    return "Form of what was found", [f'<p class="quiet">{escape(note)}</p>'] if plots else [], plots


def _folded(seen: Seen, period: float) -> Any:
    good, series = seen.good, seen.series
    rows = seen.after.shape[1]
    seconds = np.repeat((series.tt2000[good] - series.tt2000[0]) / SECOND, rows)
    y, u = seen.after[good].reshape(-1), series.direction()[good].reshape(-1, 3)
    return fold_figure(told_period(period), *fold(seconds, y, u, period))


# Cross-talk.


def _stands_for(search: Search, found: Diagnosis) -> Section:
    talk = cross_talk(search)
    if not talk.names:
        return "What stands for what", [], []
    shifts = [
        shift
        for option, one in zip(search.accepted, found.effects, strict=True)
        for shift in shifts_of(search, option, one.coefficients)
    ]
    text = [
        '<p class="quiet">Correlations of errors, the whole span as one calibration interval: pairs near '
        "+1 or -1 are one parameter to these data.</p>"
    ]
    pairs = strongest_pairs(talk)
    if pairs:
        text.append(f"<p>Strongest of what was found: {escape('; '.join(pairs))}.</p>")
    if shifts:
        text.append(
            "<p>What each found coefficient does to the calibration when it is there but ignored (straight "
            "in the coefficient; the whole span as one interval):</p>"
        )
        text.append(shift_table(shifts))
    return "What stands for what", text, [cross_talk_figure(talk)]


# Ledger.


def _ledger(
    search: Search,
    material: Material,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any],
) -> Section:
    y = search.raw.residuals[search.residual]
    data = hashlib.sha256(np.ascontiguousarray(search.raw.gram[:, :, y]).tobytes()).hexdigest()
    rules = search.rules
    listed = {
        "mission": material.mission.mission,
        "comparison": found.comparison,
        "model": f"{found.model.get('name')} version {found.model.get('version')}",
        "blocks": f"{found.blocks['count']} of {found.blocks['length_s'] / 3600.0:.3g} h, "
        f"{found.blocks['independent']:.0f} of them independent",
        "cadence of the search": f"{material.cadence_s:g} s",
        "settings": ", ".join(f"{name}={value}" for name, value in settings.model_dump().items()),
        "rules": f"t > {rules.t:g}, gain > {rules.gain:g}, family-wise p < {rules.p:g}, "
        f"over the best placebo t > {rules.t:g}",
        "seed of the sign flips": rules.seed,
        "sha256 of the data's products with the residual": data,
        "run": found.run,
        "context": found.context,
        "software": f"inflight {__version__}",
        **facts,
    }
    note = (
        "The search changes nothing: 'inflight add' puts an effect into a new version of the model, "
        "'inflight undo' returns to the version before it, 'inflight drop' takes out any effect."
    )
    text = [ledger_table(found.rounds), facts_list(listed), f'<p class="quiet">{escape(note)}</p>']
    return "Ledger", text, []
