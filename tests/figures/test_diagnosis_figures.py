"""Figures of a diagnosis say what they were given, survive what is missing, escape what they are told."""

import json
import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from bokeh.embed import json_item
from bokeh.models import BoxAnnotation, ColorBar, Span, VBar

from inflight.diagnosis import (
    HEADING,
    MEANING,
    CalibrationBias,
    CrossTalk,
    ErrorContribution,
    HeatMap,
    LagProfile,
    Trial,
)
from inflight.figures import (
    along_field_figures,
    axis_spectrum_figures,
    candidate_table,
    cross_talk_figure,
    epoch_figure,
    error_figure,
    facts_list,
    fold_figure,
    gain_change_figure,
    heat_map_figures,
    lag_figure,
    ledger_table,
    order_figure,
    response_figures,
    response_legend,
    shift_table,
    short_name,
    short_parameter,
    strongest_pairs,
    unique_labels,
    unscorable_list,
    verdict_strip,
    waterfall_figure,
)
from inflight.figures.diagnosis import explained
from inflight.figures.residual import DIVERGING
from inflight.figures.style import bare_parameter
from inflight.residual import Curve, FieldResponse, SpectrumSum, find_lines
from inflight.time import day_bounds

NAN = float("nan")


def written(plot):
    """Return a figure as a browser gets it; it fails where something cannot be written."""
    return json.dumps(json_item(plot))


def data_of(plot, *names):
    """Return the columns of the first renderer that has all of them."""
    for renderer in plot.renderers:
        found = renderer.data_source.data
        if set(names) <= set(found):
            return [np.asarray(found[name]) for name in names]
    raise AssertionError(f"no renderer has {names}")


class _Balanced(HTMLParser):
    """Fails on a tag that is closed without having been opened, and remembers what is open at the end."""

    EMPTY = frozenset({"br", "rect", "line", "text/"})

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> was never opened"
        assert self.open.pop() == tag


def whole(html):
    """Return HTML after making sure that every element in it is closed."""
    parser = _Balanced()
    parser.feed(html)
    assert parser.open == []
    return html


# Verdict.


def sizes(before=0.2, after=0.1, floor=0.09, low=0.089, high=0.091):
    return {
        "held_out_before_nT": before,
        "held_out_after_nT": after,
        "noise_floor_nT": floor,
        "noise_floor_low_nT": low,
        "noise_floor_high_nT": high,
    }


@pytest.mark.parametrize("verdict", sorted(MEANING))
def test_the_strip_says_verdict_meaning_and_sizes_without_a_script(verdict):
    html = whole(verdict_strip(verdict, "First; second <b>.", sizes(), "NOTHING_LEFT"))
    for told in (
        HEADING[verdict],
        "only noise",
        "0.2 nT",
        "0.1 nT",
        "0.09 nT",
        "0.089 to 0.091, 95 %",
        "&lt;b&gt;",
    ):
        assert told in html
    assert "<script" not in html
    # Machine names stay in the JSON.
    assert verdict not in html
    assert "NOTHING_LEFT" not in html


def test_explained_is_the_part_of_the_mean_square_above_the_floor():
    assert explained(sizes(before=5.0, after=3.0, floor=3.0)) == pytest.approx(1.0)
    assert explained(sizes(before=5.0, after=5.0, floor=3.0)) == pytest.approx(0.0)
    assert explained(sizes(before=5.0, after=4.0, floor=3.0)) == pytest.approx(9 / 16)
    assert np.isnan(explained(sizes(before=3.0, after=3.0, floor=3.0)))


@pytest.mark.parametrize("missing", [None, NAN])
def test_the_strip_admits_an_unknown_floor(missing):
    html = whole(verdict_strip("NOTHING_LEFT", "", sizes(floor=missing, low=missing, high=missing), "x"))
    assert "unknown" in html
    assert "nan" not in html.replace("nant", "")


# Maps.


def heat_map(before, after):
    span = (day_bounds(np.datetime64("2024-03-01"))[0], day_bounds(np.datetime64("2024-03-03"))[1])
    return HeatMap("orbit_phase", "deg", span, 360.0, np.array(before), np.array(after))


def test_maps_before_and_after_share_one_scale_that_is_symmetric():
    plots = heat_map_figures(heat_map([[1.0, -2.0], [NAN, 0.5]], [[0.1, 0.0], [NAN, 0.0]]))
    mappers = [plot.renderers[0].glyph.color_mapper for plot in plots]
    assert mappers[0].low == mappers[1].low == -mappers[0].high == -mappers[1].high
    assert 1.0 < mappers[0].high <= 2.0
    assert len([item for item in plots[1].right if isinstance(item, ColorBar)]) == 1
    assert [written(plot) for plot in plots]


def test_a_map_of_nothing_is_drawn():
    assert [written(plot) for plot in heat_map_figures(heat_map([[NAN, NAN]], [[NAN, NAN]]))]


def test_the_axis_of_a_map_is_in_utc():
    plot = heat_map_figures(heat_map([[1.0]], [[1.0]]))[0]
    start = np.datetime64("2024-03-01", "ms").astype(float)
    assert plot.y_range.start == start
    assert plot.y_range.end == pytest.approx(start + 3 * 86_400_000.0)


def test_the_colours_diverge_from_the_lightest_in_the_middle():
    light = [sum(int(colour[i : i + 2], 16) for i in (1, 3, 5)) for colour in DIVERGING]
    assert np.argmax(light) == len(DIVERGING) // 2
    assert len(DIVERGING) % 2 == 1


# Responses.


def curve(label="all", mean=(0.0, 1.0), sigma=(0.1, 0.1)):
    return Curve(label, np.array([1.0, 2.0]), np.array(mean), np.array(sigma))


def response(branches=("rising", "falling"), mean=(0.0, 1.0)):
    found = {name: [curve(name, mean)] * 3 for name in branches}
    found["after"] = [curve("after", (0.0, 0.0))] * 3
    envelope = [np.array([-0.2, -0.2])] * 3, [np.array([0.2, 0.2])] * 3
    low, high = envelope
    return FieldResponse(
        channel="heater",
        unit="mA",
        axes=("x", "y", "z"),
        branches=found,
        centre=np.array([1.0, 2.0]),
        low=low,
        high=high,
    )


@pytest.mark.parametrize("branches", [("rising", "falling"), ("all",)])
def test_a_response_has_a_figure_an_axis_on_one_scale_with_its_unit(branches):
    plots = response_figures(response(branches))
    assert len(plots) == 3
    assert len({(plot.y_range.start, plot.y_range.end) for plot in plots}) == 1
    assert all("(mA)" in plot.xaxis[0].axis_label for plot in plots)
    assert all(written(plot) for plot in plots)
    for colour in re.findall(r"color:(#\w+)", response_legend()):
        assert len(colour) == 7


@pytest.mark.parametrize("mean", [(NAN, NAN), (NAN, 1.0)])
def test_a_response_with_empty_bins_is_drawn(mean):
    assert [written(plot) for plot in response_figures(response(mean=mean))]


def test_a_response_stands_out_only_beyond_chance():
    assert response(mean=(0.0, 1.0)).stands_out(2)
    assert not response(mean=(0.0, 0.3)).stands_out(2)


def test_day_and_night_have_marks_of_their_own():
    found = {"before": [curve("day"), curve("night")], "after": [curve("day"), curve("night")]}
    plots = along_field_figures(found)
    assert [written(plot) for plot in plots]
    marks = {r.glyph.marker for r in plots[0].renderers if hasattr(r.glyph, "marker")}
    assert len(marks) == 2
    assert (plots[0].y_range.start, plots[0].y_range.end) == (plots[1].y_range.start, plots[1].y_range.end)
    assert along_field_figures({}) == []


def test_events_and_folds_are_drawn():
    assert "step" in written(epoch_figure("step", {"before": curve(), "after": curve()}))
    assert "41 min" in written(fold_figure("41 min", np.ones((24, 3)), np.full((24, 3), np.inf)))


# Spectra.


def spectrum_with(peak):
    """Return a spectrum with one peak along z, at a frequency's place without zero."""
    frequency = np.linspace(0, 0.025, 1001)[1:]
    total = np.ones((4, 1000))
    total[3, peak - 1] = 100.0
    return SpectrumSum(frequency, 4.0 * total, 4, 4.0 * np.ones(4))


def unexplained_peaks(found, known, axis):
    """Return the places of the lines that nothing known explains and that an axis shows."""
    lines = [
        line for line in find_lines(found, known) if line.is_new and np.isfinite(line.amplitude[1 + axis])
    ]
    return [round(1.0 / line.period_s / found.step) for line in lines]


def test_a_peak_that_nothing_explains_is_marked_with_its_period():
    found, known = spectrum_with(peak=20), {"orbit": 5580.0}
    assert unexplained_peaks(found, known, axis=2) == [20]
    assert unexplained_peaks(found, known, axis=0) == []
    plots = axis_spectrum_figures(found, found, known, find_lines(found, known))
    assert "2e+03 s" in written(plots[2]) or "33.3 min" in written(plots[2])
    assert "unknown period" not in written(plots[0])
    assert all("orbit" in written(plot) for plot in plots)


def test_a_peak_at_a_known_period_is_not_marked():
    assert unexplained_peaks(spectrum_with(peak=20), {"switch": 2000.0}, axis=2) == []


# Candidates.


def candidate(name, gain, placebo=False, now=0.0, t=10.0):
    return {
        "name": name,
        "family": "solar",
        "channels": ("solar_current",),
        "placebo": placebo,
        "gain": gain,
        "t": t,
        "p": 0.0005,
        "placebo_t": 4.0,
        "gain_now": now,
    }


ROWS = [
    candidate("channel_field(solar_current)@lag=40s", 0.5),
    candidate("channel_field(<heater>)", 0.3, now=0.4),
    candidate("channel_field(camera~1)", 0.2, placebo=True),
]


def test_the_table_shows_what_was_taken_its_rivals_and_the_placebo_behind_the_bar():
    trial = Trial(0.25, 1.5, (("coefficient[x]", 2.0, 0.1, "nT/A"),))
    html = whole(
        candidate_table(ROWS, {ROWS[0]["name"]: trial}, {ROWS[0]["name"]: ("channel_field(<heater>)",)})
    )
    for told in (
        "solar_current, lag 40 s",
        "taken",
        "or &lt;heater&gt;",
        "x +2.00 +- 0.10 nT/A",
        "50.0%",
        "0.25",
    ):
        assert told in html
    assert "camera~1" not in html, "a placebo is no candidate"
    bars = [float(width) for width in re.findall(r'<rect x="0" y="\d+" width="([\d.]+)"', html)]
    ghost, gain = bars[0], bars[1]
    assert ghost / gain == pytest.approx(0.2 / 0.5, rel=0.01)
    assert "<heater>" not in html


def test_the_interval_of_a_gain_is_two_standard_errors():
    html = candidate_table([candidate("a", 0.5, t=10.0)], {}, {})
    bar = float(re.search(r'height="8"', html) and re.search(r'width="([\d.]+)" height="8"', html)[1])
    low, high = (float(re.search(rf'{end}="([\d.]+)"', html)[1]) for end in ("x1", "x2"))
    assert (low / bar, high / bar) == (pytest.approx(0.8, abs=0.01), pytest.approx(1.2, abs=0.01))


def test_no_candidates_and_no_reasons_are_said():
    assert "No candidate" in candidate_table([], {}, {})
    assert unscorable_list([]) == ""
    assert written(gain_change_figure([]))


def test_what_cannot_be_scored_is_listed_with_its_reason():
    html = whole(unscorable_list([{"name": "a<", "reason": "still"}, {"name": "b", "reason": "still"}]))
    assert "a&lt;, b: still" in html


def test_the_drop_plot_tells_falling_from_rising():
    plot = gain_change_figure(ROWS)
    assert written(plot)
    labels = {item.label.value for item in plot.legend[0].items}
    assert {"after (falls)", "after (rises)", "best placebo"} <= labels
    assert "camera" not in " ".join(plot.y_range.factors)


# Steps, lags, cross-talk, ledger.


STEPS = [
    ErrorContribution("day_night", "day_night", 0.2, 0.12, 0.02, 0.01),
    ErrorContribution("drift", "ageing", 0.12, 0.1, 0.001, 0.004),
]


def test_the_waterfall_goes_from_as_found_to_now_left_over_the_floor():
    plot = waterfall_figure(STEPS, 0.2, 0.1, (0.09, 0.089, 0.091))
    assert written(plot)
    assert plot.x_range.factors[0] == "as found"
    assert plot.x_range.factors[-1] == "now left"
    before, after = data_of(plot, "before", "after")
    np.testing.assert_allclose(before[1:], after[:-1])
    (band,) = [item for item in plot.center if isinstance(item, BoxAnnotation)]
    assert (band.bottom, band.top) == (0.089, 0.091)
    assert plot.y_range.start == 0.0


def test_the_waterfall_of_nothing_and_of_no_floor():
    plot = waterfall_figure([], 0.1, 0.1, (NAN, NAN, NAN))
    assert written(plot)
    assert not [item for item in plot.center if isinstance(item, BoxAnnotation | Span)]


def test_order_is_told_in_nt_not_in_parts_that_sum_to_more_than_the_whole():
    first, turn, last = data_of(order_figure(STEPS), "first", "turn", "last")
    np.testing.assert_allclose(first, np.sqrt([0.02, 0.001]))
    np.testing.assert_allclose(turn, np.sqrt([0.04 - 0.0144, 0.0144 - 0.01]))
    np.testing.assert_allclose(last, np.sqrt([0.01, 0.004]))


@pytest.mark.parametrize(("best", "sigma"), [(100.0, 5.0), (10.0, 40.0), (0.0, 0.0)])
def test_a_lag_profile_is_drawn_wherever_its_best_lag_lies(best, sigma):
    lags = np.array([0.0, 10.0, 100.0, 1000.0])
    text = written(
        lag_figure(
            "channel_field(heater)@lag=120s", LagProfile(lags, np.array([4.0, 3, 2, 5]), best, sigma), 100
        )
    )
    assert "heater: " in text
    assert ("no lag is best" in text) is (best == 0.0)


TALK = CrossTalk(
    ("vector_sensor.offset[x]", "remanent.vector[x]", "day_night.vector[x]", "day_night.vector[y]"),
    ("calibration", "model", "found", "found"),
    np.array([[1.0, 0.2, -0.9, 0.0], [0.2, 1, 0.1, 0], [-0.9, 0.1, 1, 0.99], [0, 0, 0.99, 1]]),
)


def test_the_strongest_pairs_are_between_effects_and_signed():
    told = strongest_pairs(TALK, most=1)
    assert told == ["day_night vector x with offset x: -0.90"]
    assert written(cross_talk_figure(TALK))
    assert written(cross_talk_figure(CrossTalk((), (), np.zeros((0, 0)))))


def test_shifts_are_told_in_the_units_of_the_calibration():
    shifts = {"v.scale_factor[x]": 1e-6, "v.misalignment[xy]": 1 / 3600, "v.offset[x]": 0.5}
    html = whole(shift_table([CalibrationBias("day_night", "vector[z]", "nT", 0.6, shifts)]))
    for told in ("(ppm)", "(arcsec)", "(nT)", "+1<", "+0.5<", "day_night vector z = 0.6 nT"):
        assert told in html
    assert shift_table([]) == ""


def test_the_ledger_says_how_each_step_is_undone():
    step = {"number": 1, "action": "add", "name": "day_night", "family": "day_night", "gain": 0.7, "t": 20.0}
    html = whole(ledger_table([step | {"p": 0.0005, "form": "raw"}]))
    assert 'inflight add "day_night"' in unescape(html)
    assert "inflight undo" in html
    assert "No round" in ledger_table([])
    assert whole(facts_list({"seed": 0, "run": "", "none": None})).count("<tr>") == 1


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("channel_field(battery_current)@lag=40s", "battery_current, lag 40 s"),
        ("channel_rate(t)", "rate of t"),
        ("hysteresis(t)@width=2.89e+03", "hysteresis(t), width 2890"),
        ("offset_step@2005-01-28T00:00:00.000000000", "offset_step 2005-01-28"),
        (
            "clock_episode@2005-01-01T00:00:00/2005-01-16T12:00:00",
            "clock_episode 2005-01-01 to 2005-01-16 12:00",
        ),
        ("day_night", "day_night"),
    ],
)
def test_names_are_shortened(name, said):
    assert short_name(name) == said


def test_parameters_are_shortened_and_labels_stay_distinct():
    assert short_parameter("vector_sensor.scale_factor[x]") == "scale x"
    assert short_parameter("scale_drift.vector_sensor.scale_factor[z]") == "scale_drift scale z"
    assert short_parameter("channel_field(heater).coefficient[y]") == "heater y"
    assert bare_parameter("seconds") == "seconds"
    assert len(set(unique_labels(["a", "a", "b", "a"]))) == 4


def test_the_error_falls_from_version_to_version_and_what_is_tried_stands_last():
    sizes = {"held_out_nT": [0.2, 0.1], "in_sample_nT": [0.19, 0.09], "noise_floor_nT": 0.08}
    change = {"command": "", "effect": "add day_night", "model": {"version": 2, "parent": 1}, "error": sizes}
    more = sizes | {"held_out_nT": [0.1, 0.09]}
    trial = {"command": "try", "effect": "try scale_drift", "model": {"version": 2}, "error": more}
    plot = error_figure([change], trial)
    assert plot.x_range.factors == ["1: as found", "2: day_night", "try: scale_drift"]
    bars = [one for one in plot.renderers if isinstance(one.glyph, VBar) and "after" in one.data_source.data]
    drawn = [list(one.data_source.data[end]) for one in bars for end in ("before", "after")]
    assert drawn == [[0.2], [0.1], [0.1], [0.09]]
    assert [one.location for one in plot.center if isinstance(one, Span)] == [0.08]
