"""Sections of a diagnosis's report: each a heading, text that needs no script, and figures."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from inflight.diagnosis.diagnosis import Diagnosis, Signature
from inflight.diagnosis.findings import lag_profile
from inflight.diagnosis.material import Material
from inflight.diagnosis.pictures import Seen, along_field, epoch, heat_maps, sizes_of
from inflight.diagnosis.responses import responses
from inflight.diagnosis.search import Search
from inflight.diagnosis.signature import Periodogram, fold, periodogram
from inflight.diagnosis.tradeoffs import cross_talk, shifts_of, trials, waterfall
from inflight.diagnosis.unknown import known_periods
from inflight.figures.candidates import candidate_table, drop_figure, unscorable_list
from inflight.figures.crosstalk import cross_talk_figure, shift_table, strongest_pairs
from inflight.figures.found import telling
from inflight.figures.heatmap import heat_map_figures
from inflight.figures.lagprofile import lag_figure
from inflight.figures.naming import short_name
from inflight.figures.page import Section
from inflight.figures.periodogram import periodogram_figures
from inflight.figures.residual import daily_figure, histogram_figure
from inflight.figures.response import (
    along_field_figures,
    epoch_figure,
    fold_figure,
    response_figures,
    response_key,
)
from inflight.figures.waterfall import order_figure, waterfall_figure
from inflight.lines import drawn_periods, told_period
from inflight.lines import known_periods as named_periods
from inflight.time import SECOND, to_utc

#: Channels whose response is drawn, beside those of found effects; and found effects drawn one by one.
_CHANNELS, _EFFECTS = 6, 6
_STATES = ("before", "after")

# Fails here.


def fails_here(seen: Seen) -> Section:
    """Return heat maps, and the residual against the field's direction."""
    plots = [plot for one in heat_maps(seen) for plot in heat_map_figures(one, seen.changed)]
    note = [
        "Vertical bands follow the orbit (an eclipse: edges that move with the season), horizontal ones are "
        "days or steps. The calibration is fitted before and after; both share one scale of colours."
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


def follows(seen: Seen, found: Diagnosis) -> Section:
    """Return the responses to the channels of found effects and of the best candidates."""
    found_ones = responses(seen, _channels(seen, found))
    note = (
        "Field along each sensor axis that would make the residual follow the channel, fitted bin by bin, "
        "one scale a channel. Bars are one sigma between blocks; the grey band is what the same channel "
        "explains at six other times, so only what leaves it counts. Branches that part and meet again are "
        "a loop: hysteresis or a lag."
    )
    plots = [plot for one in found_ones for plot in response_figures(one)]
    return "What it follows", [f'<p class="quiet">{escape(note)}</p>', response_key()] if plots else [], plots


def _channels(seen: Seen, found: Diagnosis) -> list[str]:
    """Return the channels of found effects, then those of the best candidates."""
    there = [name for name in seen.series.channels if seen.series[name].ndim == 1]
    own = [name for one in found.effects for name in one.channels if name in there]
    others = [name for one in found.candidates if not one["placebo"] for name in one["channels"]]
    more = [name for name in dict.fromkeys(others) if name in there and name not in own]
    return [*dict.fromkeys(own), *more[:_CHANNELS]]


def spectrum(seen: Seen, material: Material) -> Section:
    """Return the periodograms along each axis before and after."""
    after = _periodogram(seen, material, seen.after)
    before = _periodogram(seen, material, seen.before) if seen.changed else None
    if after is None:
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
    weight = np.where(seen.good, series["weight"], 0.0)
    known, turned = np.nan_to_num(values), np.nan_to_num(series.direction())
    if not turned.any():
        # A platform's residual has no direction of its own: its spectrum stands in the first place.
        turned[:, :, 0] = 1.0
    return periodogram(series.tt2000, known, turned, weight, known_periods(material))


# Which effect.


def which_effect(search: Search, material: Material, found: Diagnosis) -> Section:
    """Return the table of candidates and how their gains fall."""
    names = [str(one["name"]) for one in found.candidates if not one["placebo"]]
    rivals = {one.name: one.rivals for one in found.effects}
    note = (
        "Gain is the part of the mean square that a candidate alone takes off blocks it was not fitted to, "
        "with its 95 % interval; the grey bar behind it is the best placebo, a channel shifted in time, "
        "which explains by chance. p is family-wise over all candidates and forms. Values are those of the "
        "candidate alone."
    )
    text = [
        f'<p class="quiet">{escape(note)}</p>',
        candidate_table(found.candidates, trials(search, material, names), rivals),
        unscorable_list(found.unscorable),
    ]
    return "Which effect", [one for one in text if one], [drop_figure(found.candidates)]


# The error falls.


def error_falls(seen: Seen, search: Search, material: Material, found: Diagnosis) -> Section:
    """Return the held-out error step by step, daily sizes and distributions."""
    told = found.residual
    floor = tuple(float(told[f"noise_floor_{end}"]) for end in ("nT", "low_nT", "high_nT"))
    steps = waterfall(search, material)
    start, end = float(told["held_out_before_nT"]), float(told["held_out_after_nT"])
    sizes = sizes_of(seen)
    states = _STATES if seen.changed else ("now", "now")
    plots = [
        waterfall_figure(steps, start, end, (floor[0], floor[1], floor[2])),
        *([order_figure(steps, start)] if len(steps) > 1 else []),
        daily_figure(to_utc(sizes.day), sizes.rms["before"], sizes.rms["after"], float("nan"), states),
        histogram_figure(sizes.edges, sizes.counts["before"], sizes.counts["after"], states),
    ]
    note = (
        "Steps of the error are held out, and what a step removes depends on what was there before it: "
        "effects that share what they explain remove much when taken first and little when taken last. "
        f"Daily sizes and the distribution are those of means of {seen.series.step_s:g} s, "
        "so they lie below the sizes at the native cadence."
    )
    return "How the error falls", [f'<p class="quiet">{escape(note)}</p>'], plots


def shapes(seen: Seen, search: Search, found: Diagnosis) -> Section:
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


def stands_for(search: Search, found: Diagnosis) -> Section:
    """Return the correlations of parameters, and what ignored effects do to the calibration."""
    talk = cross_talk(search)
    if not talk.names:
        return "What stands for what", [], []
    shifts = [
        shift
        for option, one, told in zip(search.accepted, found.effects, found.as_json()["effects"], strict=True)
        for shift in shifts_of(search, option, one.coefficients)
        if shift.coefficient in {value["name"] for value in telling(told["coefficients"])}
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
