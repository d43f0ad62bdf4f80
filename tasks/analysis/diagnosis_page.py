"""The page of a diagnosis: one HTML file that needs no network.

Takes a finished search with its data (`Examined`); makes sections, each a heading, text that needs no script,
and figures (`diagnosis_sections`), and the page of them (`report`): where the residual fails, what it
follows, which effect explains it, how the error falls, which parameters imitate each other, the ledger.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from inflight import __version__
from inflight.catalog import Workspace
from inflight.diagnosis import (
    BeforeAfter,
    Diagnosis,
    DiagnosisData,
    Search,
    Signature,
    along_field,
    before_after,
    calibration_biases,
    cross_talk,
    entry_curves,
    error_waterfall,
    heat_maps,
    lag_profile,
    number_curves,
    periods_of,
    residual_lines,
    responses,
    rival_curves,
    sizes_of,
    superposed_epoch,
    trials,
)
from inflight.figures import (
    Section,
    along_field_figures,
    axis_spectrum_figures,
    candidate_table,
    cross_talk_figure,
    daily_figure,
    entries_html,
    entry_figure,
    epoch_figure,
    facts_list,
    fold_figure,
    found_effects_html,
    gain_change_figure,
    heat_map_figures,
    histogram_figure,
    html_page,
    lag_figure,
    ledger_table,
    most_significant,
    order_figure,
    paragraph,
    response_figures,
    response_legend,
    separating_blocks_html,
    shift_table,
    short_name,
    strongest_pairs,
    unit_steps_figure,
    unscorable_list,
    verdict_strip,
    waterfall_figure,
)
from inflight.progress import Progress, silent, tell_each
from inflight.residual import drawn_periods, fold_by_period, format_period
from inflight.tasks.analysis.diagnosis import Examined
from inflight.tasks.analysis.kept_diagnosis import (
    DiagnosisReport,
    asked_alike,
    keep_report,
    last_diagnosis,
)
from inflight.tasks.analysis.revise import diagnose_span
from inflight.tasks.analysis.settings import DiagnoseSettings
from inflight.tasks.report import write_page
from inflight.time import SECOND, to_utc

#: Channels whose response is drawn, other than those of found effects; and found effects drawn one by one.
_CHANNELS, _EFFECTS = 6, 6

_STATES = ("before", "after")

# Fails here.


def where_it_fails(seen: BeforeAfter) -> Section:
    """Return heat maps, and the residual against the field's direction."""
    plots = [plot for one in heat_maps(seen) for plot in heat_map_figures(one, seen.changed)]
    note = [
        "Vertical bands follow the orbit (an eclipse: edges that move with the season), horizontal ones are "
        "days or steps. The calibration is fitted before and after; both share one scale of colours."
    ]
    if not seen.is_scalar:
        note.append(f"The residual has three components; {'xyz'[seen.row]}, the largest, is drawn.")
    along = along_field(seen)
    if along:
        note.append(
            "Against the field's direction a field fixed in the sensor is a straight line: two lines are "
            "two offsets."
        )
    return (
        "Where it fails",
        [paragraph(" ".join(note), kind="quiet")],
        plots + along_field_figures(along),
    )


def what_each_makes(seen: BeforeAfter, search: Search, data: DiagnosisData, found: Diagnosis) -> Section:
    """Return a figure of each effect that was found: what is measured, what it makes, and what is left."""
    curves = [*entry_curves(search, data, seen), *number_curves(search, data, seen, found.refined)]
    rivals = rival_curves(search, data, seen, found.confusion_set) if curves else []
    note = (
        "One figure an effect, the strongest first. Points are what is measured with everything else in the "
        "model, the line is what the effect would make with the numbers found, and the dotted line what is "
        "left with it in the model. Were the effect what is there, the points lie on the line and what is "
        "left is flat; points that leave the line say that its form is another one. Fields along an axis are "
        "drawn less their mean. Of a number that the model holds the line is what its change makes."
    )
    if rivals:
        note += (
            " Then come causes that cannot be told from these, each in the place of its rival: where their "
            "figures look alike, these data do not tell which it is."
        )
    left, unit = left_figures(seen, found), unit_figures(data)
    text = [paragraph(note, kind="quiet")] if curves else []
    if left:
        text.append(paragraph("What is left is drawn folded by the period it repeats with.", kind="quiet"))
    if unit:
        note = (
            "Points of a unit without housekeeping are the steps of the difference at its switchings with "
            "the sign of switching on: those of one unit lie on its lines. The level is free at each of "
            "them, so that the residual has none of the steps."
        )
        text.append(paragraph(note, kind="quiet"))
    drawn = [entry_figure(one) for one in [*curves, *rivals]]
    return "What each cause would make", text, [*drawn, *left, *unit]


def what_it_follows(seen: BeforeAfter, found: Diagnosis) -> Section:
    """Return the responses to the channels of found effects and of the best candidates."""
    # Channels of found effects, then those of the best candidates.
    there = [name for name in seen.series.channels if seen.series[name].ndim == 1]
    own = [name for one in found.effects for name in one.channels if name in there]
    others = [name for one in found.candidates if not one["placebo"] for name in one["channels"]]
    more = [name for name in dict.fromkeys(others) if name in there and name not in own]
    channels = [*dict.fromkeys(own), *more[:_CHANNELS]]
    note = (
        "Field along each sensor axis that would make the residual follow the channel, fitted bin by bin, "
        "one scale a channel. Bars are one sigma between blocks; the grey band is what the same channel "
        "explains at six other times, so only what leaves it counts. Branches that part and meet again are "
        "a loop: hysteresis or a lag."
    )
    plots = [plot for one in responses(seen, channels) for plot in response_figures(one)]
    return "What it follows", [paragraph(note, kind="quiet"), response_legend()] if plots else [], plots


def spectrum(seen: BeforeAfter, data: DiagnosisData) -> Section:
    """Return the spectra along each axis before and after, with their lines."""
    known = periods_of(data)
    after, lines = residual_lines(seen.series, np.where(seen.good[:, None], seen.after, np.nan), known)
    before = None
    if seen.changed:
        before, _ = residual_lines(seen.series, np.where(seen.good[:, None], seen.before, np.nan), known)
    if after is None:
        return "Spectrum along each axis", [], []
    note = (
        "The residual times the field's direction: a field along one axis shows at its own period there. "
        "Grey dotted periods are known; a red one stands beyond chance and nothing known explains it."
    )
    return (
        "Spectrum along each axis",
        [paragraph(note, kind="quiet")],
        axis_spectrum_figures(before, after, drawn_periods(known), lines),
    )


# Which effect.


def which_effect(search: Search, data: DiagnosisData, found: Diagnosis) -> Section:
    """Return the table of candidates and how their gains fall."""
    names = [str(one["name"]) for one in found.candidates if not one["placebo"]]
    rivals = {one.name: one.rivals for one in found.effects}
    note = (
        "Gain is the part of the mean square that a candidate alone takes off days not used in the fit, "
        "with its 95 % interval; the grey bar behind it is the best placebo, a channel shifted in time, "
        "which explains by chance. p counts all candidates and forms that were tried. Values are those of "
        "the candidate alone."
    )
    text = [
        paragraph(note, kind="quiet"),
        candidate_table(found.candidates, trials(search, data, names), rivals),
        unscorable_list(found.unscorable),
    ]
    return "Which effect", [one for one in text if one], [gain_change_figure(found.candidates)]


# The error falls.


def error_falls(seen: BeforeAfter, search: Search, data: DiagnosisData, found: Diagnosis) -> Section:
    """Return the held-out error step by step, daily sizes and distributions."""
    sizes_nt = found.residual
    floor = tuple(float(sizes_nt[f"noise_floor_{end}"]) for end in ("nT", "low_nT", "high_nT"))
    steps = error_waterfall(search, data)
    start, end = float(sizes_nt["held_out_before_nT"]), float(sizes_nt["held_out_after_nT"])
    sizes = sizes_of(seen)
    states = _STATES if seen.changed else ("now", "now")
    plots = [
        waterfall_figure(steps, start, end, (floor[0], floor[1], floor[2])),
        *([order_figure(steps)] if len(steps) > 1 else []),
        daily_figure(to_utc(sizes.day), sizes.rms["before"], sizes.rms["after"], float("nan"), states),
        histogram_figure(sizes.edges, sizes.counts["before"], sizes.counts["after"], states),
    ]
    note = (
        "Steps of the error are those on days not used in the fit, and what a step removes depends on what "
        "was there before it: "
        "effects that share what they explain remove much when taken first and little when taken last. "
        f"Daily sizes and the distribution are those of means of {seen.series.step_s:g} s, "
        "so they lie below the sizes at the native cadence."
    )
    return "How the error falls", [paragraph(note, kind="quiet")], plots


def shapes(seen: BeforeAfter, search: Search, found: Diagnosis) -> Section:
    """Lag profiles of responses, and epochs of events."""
    plots: list[Any] = []
    rows = float(search.forms["raw"].count.sum())
    for option in search.accepted[:_EFFECTS]:
        profile = lag_profile(search, option)
        if profile is not None:
            plots.append(lag_figure(option.name, profile, rows))
        if option.change is not None:
            plots += [
                epoch_figure(short_name(option.name), superposed_epoch(seen, when))
                for when in option.change.at
            ]
    note = "The best lag lies between those of the bank; its error is a jackknife over folds of blocks."
    return "Form of what was found", [paragraph(note, kind="quiet")] if plots else [], plots


def left_figures(seen: BeforeAfter, found: Diagnosis) -> list[Any]:
    """Return what is left folded by the period it repeats with; nothing when it has none."""
    signature: Signature | None = found.remaining.get("signature")
    if signature is None or not signature.period_s:
        return []
    good, series = seen.good, seen.series
    seconds = np.repeat((series.tt2000[good] - series.tt2000[0]) / SECOND, seen.after.shape[1])
    y, u = seen.after[good].reshape(-1), series.direction()[good].reshape(-1, 3)
    curve = fold_by_period(seconds, y, u, signature.period_s)
    return [fold_figure(format_period(signature.period_s), *curve)]


def unit_figures(data: DiagnosisData) -> list[Any]:
    """Return the steps at each switching of the busiest unit without housekeeping, if there is one."""
    if data.switched is None or not data.switched.unexplained:
        return []
    own, steps = data.switched.switchings_of_first()
    mean, sigma, _ = data.switched.units[0]
    return [unit_steps_figure(to_utc(data.switched.first[own]), steps, data.switched.scatter, mean, sigma)]


# Cross-talk.


def imitations(search: Search, found: Diagnosis) -> Section:
    """Return the correlations of parameters, and what ignored effects do to the calibration."""
    talk = cross_talk(search)
    if not talk.names:
        return "What stands for what", [], []
    # A search has them in the order they were taken, its result the largest first.
    options = {option.name: option for option in search.accepted}
    shifts = [
        shift
        for one, fields in zip(found.effects, found.as_json()["effects"], strict=True)
        for shift in calibration_biases(search, options[one.name], one.coefficients)
        if shift.coefficient in {value["name"] for value in most_significant(fields["coefficients"])}
    ]
    text: list[str] = [
        paragraph(
            "Correlations of errors, the whole span as one calibration interval: pairs near +1 or -1 are one "
            "parameter to these data.",
            kind="quiet",
        )
    ]
    pairs = strongest_pairs(talk)
    if pairs:
        text.append(paragraph(f"Strongest of what was found: {'; '.join(pairs)}."))
    if shifts:
        text.append(
            paragraph(
                "What each found coefficient does to the calibration when it is there but ignored (straight "
                "in the coefficient; the whole span as one interval):"
            )
        )
        text.append(shift_table(shifts))
    return "What stands for what", text, [cross_talk_figure(talk)]


def report(
    workspace: Workspace,
    output: Path,
    start: str | None = None,
    end: str | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> DiagnosisReport:
    """Diagnose a span as `diagnose_span` does, and write the page of it.

    Verdict and page are kept: `diagnose_if_unchanged` and `report_if_unchanged` return them while they would
    be the same. A last diagnosis of another span, or with other settings, stays the last one. Gram blocks
    that are there already are not made again.

    Parameters
    ----------
    output : Path
        Where the page goes; written whole, by one rename.
    start, end, settings, client, progress
        As of `diagnose_span`.

    Raises
    ------
    InflightError
        As `diagnose_span`.
    OSError
        When there is no place for the page; the verdict is kept all the same.
    """
    settings = settings or DiagnoseSettings()
    last = last_diagnosis(workspace, settings.comparison)
    keep = last is None or asked_alike(last.get("asked") or {}, start, end, settings)
    searched = list[tuple[Examined, Mapping[str, Any]]]()

    def finished(examined: Examined, asked: Mapping[str, Any]) -> None:
        searched.append((examined, asked))

    how: Any = {"client": client, "progress": progress, "finished": finished}
    diagnose_span(workspace, start, end, settings, search=True, keep=keep, **how)
    return write_report(workspace, output, *searched[0], progress or silent)


def write_report(
    workspace: Workspace,
    output: Path,
    examined: Examined,
    asked: Mapping[str, Any],
    progress: Progress = silent,
) -> DiagnosisReport:
    """Write the page of a finished search, and keep of which search it is.

    Parameters
    ----------
    asked : mapping
        Of `inflight.tasks.analysis.asked_of`, before the search.

    Raises
    ------
    OSError
        When there is no place for the page.
    """
    page = diagnosis_page(*examined, progress)
    write_page(output, page)
    written = DiagnosisReport(examined.found.as_json(), output)
    keep_report(workspace, written, page, asked)
    return written


def diagnosis_page(
    search: Search,
    data: DiagnosisData,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> str:
    """Return the page of a finished search as HTML; parameters are those of `diagnosis_sections`."""
    raw = search.raw
    first, last = (np.datetime_as_string(to_utc(int(edge)), "D") for edge in (raw.start[0], raw.end[-1] - 1))
    name = f"{data.mission.mission}: what is missing from the model, {first} to {last}"
    sections = diagnosis_sections(search, data, found, settings, facts, progress)
    return html_page(name, sections, data.mission.acknowledgement)


def diagnosis_sections(
    search: Search,
    data: DiagnosisData,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> list[Section]:
    """Return everything that is shown of a finished search.

    Parameters
    ----------
    search : Search
        As `run_search` left it.
    facts : mapping, optional
        More lines of the ledger.
    progress : callable, optional
        Called with ("sections", done, total).
    """
    fields = found.as_json()
    strip = verdict_strip(found.verdict, found.sentence, fields["residual"], fields["remaining"]["verdict"])
    seen = before_after(search, data)
    text = [strip, *entries_html(fields), *found_effects_html(fields), *separating_blocks_html(fields)]
    makers: list[Callable[[], Section]] = [
        lambda: ("Verdict", text, []),
        lambda: what_each_makes(seen, search, data, found),
        lambda: where_it_fails(seen),
        lambda: what_it_follows(seen, found),
        lambda: spectrum(seen, data),
        lambda: which_effect(search, data, found),
        lambda: error_falls(seen, search, data, found),
        lambda: shapes(seen, search, found),
        lambda: imitations(search, found),
        lambda: _ledger(search, data, found, settings, facts or {}),
    ]
    sections = [make() for make in tell_each(progress, "sections", makers)]
    return [section for section in sections if section[1] or section[2]]


# Ledger.


def _ledger(
    search: Search,
    data: DiagnosisData,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any],
) -> Section:
    y = search.raw.residuals[search.residual]
    digest = hashlib.sha256(np.ascontiguousarray(search.raw.rows(np.array([y]))[:, 0]).tobytes()).hexdigest()
    rules = search.rules
    listed = {
        "mission": data.mission.mission,
        "comparison": found.comparison,
        "model": f"{found.model.get('name')} version {found.model.get('version')}",
        "blocks": f"{found.blocks['count']} of {found.blocks['length_s'] / 3600.0:.3g} h, "
        f"{found.blocks['independent']:.0f} of them independent",
        "samples left out": _outlier_text(found.outliers),
        "cadence of the search": f"{data.cadence_s:g} s",
        "settings": ", ".join(f"{name}={value}" for name, value in settings.model_dump().items()),
        "rules": f"t > {rules.t:g}, gain > {rules.gain:g}, family-wise p < {rules.p:g}, "
        f"over the best placebo t > {rules.t:g}",
        "seed of the sign flips": rules.seed,
        "sha256 of the data's products with the residual": digest,
        "run": found.run,
        "context": found.context,
        "software": f"inflight {__version__}",
        **facts,
    }
    note = (
        "The search changes nothing: 'inflight add' puts an effect into a new version of the model, "
        "'inflight undo' returns to the version before it, 'inflight drop' takes out any effect."
    )
    text = [ledger_table(found.rounds), facts_list(listed), paragraph(note, kind="quiet")]
    return "Steps of the search", text, []


def _outlier_text(outliers: Mapping[str, Any]) -> str:
    """Return how many samples are not in the Gram blocks, and when the first bursts of them were."""
    if not outliers:
        return "none"
    text = f"{outliers['samples']}, {outliers['spikes']} of them single"
    if not outliers["burst_count"]:
        return text
    kept = ", kept because they hold too much of the span" if outliers["kept"] else ""
    first = [
        f"{one['start']} to {one['end']} ({one['times_usual']:.0f} times the usual scatter)"
        for one in outliers["bursts"]
    ]
    more = "; ..." if len(first) < outliers["burst_count"] else ""
    return f"{text}; {outliers['burst_count']} bursts{kept}: {'; '.join(first)}{more}"
