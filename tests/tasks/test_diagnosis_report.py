"""The report of a diagnosis: a page that stands alone, and the aggregates it is drawn from."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from tiny_mission import TINY_START, TINY_YAML, tiny_readings

from inflight.catalog import Catalog, Workspace
from inflight.design.columns import BurstSettings
from inflight.diagnosis import (
    HEADING,
    BeforeAfter,
    Features,
    Series,
    along_field,
    before_after,
    calibration_biases,
    cross_talk,
    entry_curves,
    error_waterfall,
    heat_maps,
    number_curves,
    responses,
    rival_curves,
    run_search,
    sizes_of,
    superposed_epoch,
    trials,
)
from inflight.diagnosis.figure_data import VIEW_SETTINGS
from inflight.dual import JumpAttribution
from inflight.errors import CatalogError
from inflight.tasks import current_model
from inflight.tasks.analysis import DiagnoseSettings, report
from inflight.tasks.analysis import diagnosis_page as diagnosis_page_module
from inflight.tasks.analysis.diagnosis import begin_search, diagnosis_data, make_pass
from inflight.tasks.analysis.diagnosis_page import diagnosis_page, imitations, unit_figures
from inflight.tasks.archive import ingest
from inflight.time import DAY, SECOND, day_bounds

THANKS = "Thanks to <everyone> & all"
DAYS = [str(day) for day in np.datetime64(TINY_START, "D") + np.arange(12)]
#: What the hidden effect adds along z for each mA of the heater, nT, and its current.
HIDDEN, CURRENT = 0.02, 100.0
SETTINGS = DiagnoseSettings(draws=200, rounds=2)


def heater(times):
    """Current of a heater that switches every 53 minutes or so, mA."""
    minutes = (times - np.datetime64("2024-01-01", "s")).astype(float) / 60.0
    return np.where(np.sin(2 * np.pi * minutes / 106.0) > 0.2, CURRENT, 0.0)


def deliver(folder, day, hidden=HIDDEN):
    """Write one day of both instruments; the heater's field acts on the vector sensor."""
    times, reading, scalar = tiny_readings(day)
    current = heater(times)
    reading = reading + np.outer(current, [0.0, 0.0, hidden])
    folder.mkdir(parents=True, exist_ok=True)
    stamp = day.replace("-", "")
    rows = [
        f"{t}," + ",".join(f"{v:.3f}" for v in row) + f",{c:.1f}"
        for t, row, c in zip(times, reading, current, strict=True)
    ]
    (folder / f"turning_{stamp}.csv").write_text("time,x,y,z,heater\n" + "\n".join(rows) + "\n")
    rows = [f"{t},{value:.3f}" for t, value in zip(times, scalar, strict=True)]
    (folder / f"absolute_{stamp}.csv").write_text("time,f\n" + "\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A workspace with twelve days in the archive and a heater that nobody told the model of."""
    folder = tmp_path_factory.mktemp("hidden")
    channel = "heater_current: {variable: heater, unit: mA, kind: current}"
    yaml = TINY_YAML.replace("variables: [x, y, z], unit: nT}", "variables: [x, y, z], unit: nT}, " + channel)
    (folder / "tiny.yaml").write_text(yaml + f"acknowledgement: '{THANKS}'\n", encoding="utf-8")
    workspace = Workspace.create(folder / "tiny", folder / "tiny.yaml")
    for day in DAYS:
        deliver(workspace.data, day)
    assert ingest(Catalog(workspace.root), workspace.mission(), workspace.data).exit_code == 0
    return workspace


@pytest.fixture(scope="module")
def steps():
    """What was told while the report was made: (stage, done, total)."""
    return []


@pytest.fixture(scope="module")
def made(place, steps, tmp_path_factory):
    """The report of all days."""
    output = tmp_path_factory.mktemp("page") / "deep" / "report.html"
    how = {"settings": SETTINGS, "progress": lambda *step: steps.append(step)}
    return report(place, output, **how)


@pytest.mark.usefixtures("made")
def test_blocks_that_are_loaded_and_sections_of_the_page_are_told(steps):
    stages = list(dict.fromkeys(stage for stage, _, _ in steps))
    assert stages.index("pass") < stages.index("blocks") < stages.index("search") < stages.index("sections")
    # Blocks are read in two forms, a day each.
    assert [step for step in steps if step[0] == "blocks"][:26] == [
        ("blocks", done, len(DAYS)) for done in range(len(DAYS) + 1)
    ] * 2
    assert [step for step in steps if step[0] == "sections"] == [("sections", done, 10) for done in range(11)]


@pytest.fixture(scope="module")
def searched(place):
    """A search that has taken what it found, with what a verdict needs."""
    prepared = make_pass(Catalog(place.root), place.mission(), None, None, SETTINGS)
    search, data = begin_search(prepared, SETTINGS), diagnosis_data(prepared, place.mission())
    found, search = run_search(search, data)
    return search, data, found


class _Told(HTMLParser):
    """Collects a page's text outside scripts and styles, and what its tags make a browser load."""

    def __init__(self):
        super().__init__()
        self.text, self.loads, self._skip = [], [], 0

    def handle_starttag(self, tag, attrs):
        self._skip += tag in {"script", "style"}
        self.loads += [value for name, value in attrs if name in {"src", "href", "srcset", "data"}]

    def handle_endtag(self, tag):
        self._skip -= tag in {"script", "style"}

    def handle_data(self, data):
        if not self._skip:
            self.text.append(data)


def told(page):
    parser = _Told()
    parser.feed(page)
    return " ".join(" ".join(parser.text).split()), parser.loads


def test_the_page_tells_the_verdict_without_scripts_and_loads_nothing(made):
    text, loads = told(made.path.read_text(encoding="utf-8"))
    assert loads == []
    assert HEADING[made.fields["verdict"]] in text
    assert "heater_current" in text
    for word in made.fields["sentence"].split():
        assert word in text
    for heading in (
        "Where it fails",
        "Which effect",
        "How the error falls",
        "What stands for what",
        "What each cause would make",
        "Steps of the search",
    ):
        assert heading in text
    assert THANKS in text
    assert "<everyone>" not in made.path.read_text(encoding="utf-8")


def test_the_hidden_heater_is_what_the_page_is_about(made):
    assert [one["channels"] for one in made.fields["effects"]] == [["heater_current"]]
    coefficients = made.fields["effects"][0]["coefficients"]
    (along_z,) = [one for one in coefficients if one["name"].endswith("[z]")]
    assert abs(along_z["value"] - HIDDEN) < 4 * along_z["sigma"]
    fields = made.as_json()
    assert fields["command"] == "report"
    assert fields["path"] == str(made.path)
    assert json.dumps(fields)


def test_a_rival_is_drawn_in_the_place_of_the_cause_it_rivals(searched):
    search, data, _ = searched
    (taken,) = search.accepted
    others = [one for one in search.options if one.change is None and one.name != taken.name]
    rival = next(one for one in others if "heater_current" in one.channels)
    seen = before_after(search, data)
    named = [{"name": taken.name}, {"name": rival.name}, {"name": "sensor.offset[x]"}]
    (own,) = entry_curves(search, data, seen)
    (instead,) = rival_curves(search, data, seen, named)
    assert (instead.name, instead.instead_of) == (rival.name, taken.name)
    assert own.instead_of == ""
    # This one is no rival in truth: what it leaves says so.
    assert np.std(instead.left) > 3 * np.std(own.left)


def test_a_wrong_number_of_the_model_is_drawn_before_and_after_its_change(searched):
    search, data, _ = searched
    seen = before_after(search, data)
    (heater,) = search.accepted
    term = search.library.by_key[heater.terms[0]]
    # As if the heater's field were a number that the model holds.
    library = replace(search.library, refined=[term])
    held = replace(search, library=library, accepted=())
    name = term.columns[0].partition("[")[0]
    (drawn,) = number_curves(held, data, seen, [{"name": f"{name}[x]", "wrong": True}])
    assert drawn.name == name
    assert np.corrcoef(drawn.measured, drawn.made)[0, 1] > 0.95
    assert np.std(drawn.left) < 0.2 * np.std(drawn.measured)
    assert not number_curves(held, data, seen, [{"name": f"{name}[x]", "wrong": False}])


def test_a_unit_without_housekeeping_is_drawn_with_all_its_steps(searched):
    data = searched[1]
    size, stamps = np.array([19.0, -4.0, 2.0]), 10**12 * np.arange(1, 6)
    steps = np.outer([1, -1, 1, -1, 1], size)
    steps[4] = (0.0, 7.0, 0.0)
    switched = JumpAttribution(stamps, stamps, np.zeros(5, dtype=bool), steps, 0.1)
    (figure,) = unit_figures(replace(data, switched=switched))
    drawn = [one.data_source.data["y"] for one in figure.renderers if hasattr(one.glyph, "marker")]
    assert [list(one) for one in drawn] == [[each] * 4 for each in size]
    assert not unit_figures(data)


def test_the_report_names_the_version_that_the_catalog_has(made, place):
    used = current_model(Catalog(place.root), place.mission(), "main")
    assert made.as_json()["model"]["version"] == used.version == 1


def test_the_page_is_written_whole_and_small(made):
    assert [path.name for path in made.path.parent.iterdir()] == ["report.html"]
    assert made.path.stat().st_size < 4_000_000


def numbers_of(page):
    """Return how many numbers the embedded figures hold: of buffers, and of plain lists."""
    arrays = re.findall(r'"type":"ndarray".*?"shape":\[([0-9,]+)\],"dtype"', page)
    lists = re.findall(r"\[([-0-9.e,]+)\]", re.sub(r'"data":"[^"]*"', "", page[page.index("docs_json = ") :]))
    return sum(int(np.prod([int(n) for n in one.split(",")])) for one in arrays) + sum(
        one.count(",") + 1 for one in lists
    )


def test_all_figures_together_hold_few_numbers(made):
    page = made.path.read_text(encoding="utf-8")
    assert 1_000 < numbers_of(page) < 50_000


def test_nothing_to_work_on_is_said_and_nothing_is_written(place, tmp_path):
    with pytest.raises(CatalogError):
        report(place, tmp_path / "none.html", "2001-01-01", "2001-01-05")
    assert list(tmp_path.iterdir()) == []


def test_a_real_browser_draws_the_page_without_an_error_and_without_a_network(made, tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or chrome on the path")
    picture = tmp_path / "page.png"
    done = subprocess.run(
        [
            browser,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=8000",
            "--window-size=1250,1500",
            f"--screenshot={picture}",
            made.path.resolve().as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert any("document idle" in line for line in console), done.stderr[-2000:]
    assert [line for line in console if "INFO:CONSOLE" not in line or "rror" in line] == []
    assert picture.stat().st_size > 50_000


# A search that took nothing, or too little, still has a page.


def test_a_search_without_rounds_has_a_page(place):
    settings = SETTINGS.model_copy(update={"rounds": 0})
    prepared = make_pass(Catalog(place.root), place.mission(), None, None, settings)
    search, data = begin_search(prepared, settings), diagnosis_data(prepared, place.mission())
    found, search = run_search(search, data)
    text, _ = told(diagnosis_page(search, data, found, settings))
    assert "No effect was added" in text
    assert "No round took anything" in text


def test_a_span_of_two_days_has_a_page(place, tmp_path):
    made = report(place, tmp_path / "two.html", str(DAYS[0]), str(DAYS[2]), SETTINGS)
    text, _ = told(made.path.read_text(encoding="utf-8"))
    assert HEADING[made.fields["verdict"]] in text


def test_bursts_that_hold_too_much_stay_in_evidence_of_their_own(place, monkeypatch):
    """Both are made once: asking again makes neither anew."""
    monkeypatch.setattr("inflight.tasks.analysis.diagnosis.BURST_SETTINGS", BurstSettings(largest_share=-1.0))
    kept, again = (make_pass(Catalog(place.root), place.mission(), None, None, SETTINGS) for _ in range(2))
    assert kept.loaded.outliers.kept
    assert kept.run
    assert not again.run
    monkeypatch.undo()
    plain = make_pass(Catalog(place.root), place.mission(), None, None, SETTINGS)
    assert not plain.loaded.outliers.kept
    assert not plain.run


# Steps, cross-talk, trials.


def test_the_steps_of_the_waterfall_join_and_end_at_the_held_out_error(searched):
    search, data, found = searched
    steps = error_waterfall(search, data)
    assert [step.name for step in steps] == [option.name for option in search.accepted]
    assert steps[0].before == pytest.approx(found.residual["held_out_before_nT"])
    assert steps[-1].after == pytest.approx(found.residual["held_out_after_nT"])
    for one, following in pairwise(steps):
        assert one.after == following.before
    # The first one was taken first, the last one last.
    assert steps[0].first_in == pytest.approx(steps[0].removed)
    assert steps[-1].last_in == pytest.approx(steps[-1].removed)


def test_looking_changes_nothing(searched):
    search, data, _ = searched
    before = list(search.accepted)
    search.with_accepted([])
    error_waterfall(search, data)
    trials(search, data, [option.name for option in search.options])
    assert list(search.accepted) == before


def test_correlations_are_correlations(searched):
    search, _, found = searched
    talk = cross_talk(search)
    assert talk.correlation.shape == (len(talk.names), len(talk.names))
    np.testing.assert_allclose(talk.correlation, talk.correlation.T, atol=1e-9)
    assert np.abs(talk.correlation).max() <= 1.0
    assert talk.groups.count("calibration") == 9
    assert talk.groups.count("found") == sum(len(one.coefficients) for one in found.effects)


def test_a_shift_is_straight_in_the_coefficient(searched):
    search, _, found = searched
    option, values = search.accepted[0], found.effects[0].coefficients
    once = calibration_biases(search, option, values)
    twice = calibration_biases(search, option, [replace(one, value=2.0 * one.value) for one in values])
    for one, other in zip(once, twice, strict=True):
        assert {name: 2.0 * by for name, by in one.shifts.items()} == pytest.approx(other.shifts)


def test_shifts_are_those_of_the_effect_whose_coefficients_they_are(searched, monkeypatch):
    search, _, found = searched
    (taken,), (effect,) = search.accepted, found.effects
    # A second one of fewer columns is taken later and, the larger of the two, told first.
    other = next(one for one in search.options if len(one.columns) == 1 and one.change is None)
    second = replace(effect, name=other.name, coefficients=effect.coefficients[:1])
    both, asked = search.with_accepted([taken, other]), []
    monkeypatch.setattr(
        diagnosis_page_module,
        "calibration_biases",
        lambda search, option, values: asked.append((option.name, len(values))) or [],
    )
    imitations(both, replace(found, effects=(second, effect)))
    assert asked == [(other.name, 1), (taken.name, len(effect.coefficients))]


def test_a_trial_of_what_was_taken_has_its_value(searched):
    search, data, found = searched
    name = search.accepted[0].name
    values = {value[0]: value[1] for value in trials(search, data, [name])[name].values}
    taken = {one.name: one for one in found.effects[0].coefficients}
    for axis, one in taken.items():
        assert abs(values[axis] - one.value) < 5 * one.sigma + 1e-9


# Aggregates of a series of one's own.


def series_of(days, step_s, channels, residual, seed=0):
    """Return what was seen of a record whose field direction turns at random; functions of seconds."""
    start = day_bounds(np.datetime64("2024-03-01"))[0]
    tt2000 = start + np.arange(0, days * DAY, int(step_s * SECOND))
    seconds = (tt2000 - start) / SECOND
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=(tt2000.size, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    made = {name: np.asarray(one(seconds), dtype=float) for name, one in channels.items()}
    y = residual(seconds, direction, made) + generator.normal(0, 0.01, tt2000.size)
    names = ("seconds", "residual", "weight", "field", "direction:v", *made)
    widths = (1, 1, 1, 3, 3, *(1 for _ in made))
    columns = [seconds % 86_400.0, y, np.ones_like(y), 5e4 * direction, direction, *made.values()]
    values = np.concatenate([one.reshape(len(y), -1) for one in columns], axis=1)
    block = ((tt2000 - start) // DAY).astype(np.int64)
    features = Features(names, widths, ("1",) * len(names), ("v",), 1)
    series = Series(np.asarray(tt2000, dtype=np.int64), values, block, features)
    return BeforeAfter(series, y[:, None], 0.1 * y[:, None], block)


def wave(seconds):
    return 20.0 + 5.0 * np.sin(2 * np.pi * seconds / 5_000.0)


def test_the_response_to_a_channel_is_the_field_that_follows_it():
    seen = series_of(8, 60, {"t": wave}, lambda s, u, c: u[:, 1] * 0.2 * (c["t"] - 20.0))
    (found,) = responses(seen, ["t"])
    for branch in ("rising", "falling"):
        along_y = found.branches[branch][1]
        slope = np.polyfit(along_y.centre, along_y.mean, 1)[0]
        assert slope == pytest.approx(0.2, abs=0.005)
        assert np.nanmax(np.abs(found.branches[branch][0].mean)) < 5 * np.nanmax(
            found.branches[branch][0].sigma
        )
    assert found.stands_out(1)
    assert not found.stands_out(0)


def test_a_lagged_effect_opens_a_loop_between_the_branches():
    def late(s, u, c):
        return u[:, 2] * 0.2 * (wave(s - 600.0) - 20.0)

    (found,) = responses(series_of(8, 60, {"t": wave}, late), ["t"])
    apart = found.branches["falling"][2].mean - found.branches["rising"][2].mean
    middle = len(apart) // 2
    expected = 2 * 0.2 * 5.0 * np.sin(2 * np.pi * 600.0 / 5_000.0)
    assert apart[middle] == pytest.approx(expected, rel=0.1)


def test_where_the_field_does_not_turn_the_response_is_along_the_field():
    seen = series_of(8, 60, {"t": wave}, lambda s, u, c: 0.2 * (c["t"] - 20.0))
    seen.series.values[:, seen.series.features.place("direction:v")] = [0.6, 0.0, 0.8]
    (found,) = responses(seen, ["t"])
    assert found.axes == ("B",)
    assert found.stands_out(0)
    assert along_field(seen) == {}


def test_channels_that_do_not_vary_have_no_response():
    seen = series_of(8, 600, {"still": lambda s: 0 * s}, lambda s, u, c: u[:, 0])
    assert responses(seen, ["still"]) == []


def test_a_field_fixed_by_day_is_a_line_of_its_own_against_the_field():
    seen = series_of(
        8, 60, {"sunlit": lambda s: (s % 5_000.0) < 3_000.0}, lambda s, u, c: 0.4 * u[:, 2] * c["sunlit"]
    )
    day, night = along_field(seen)["before"]
    known = np.isfinite(day.mean)
    assert np.polyfit(day.centre[known], day.mean[known], 1)[0] == pytest.approx(0.4, abs=0.01)
    assert np.nanmax(np.abs(night.mean)) < 0.01
    assert np.all(day.sigma[known] < 0.01)


def test_maps_find_the_phase_and_keep_gaps_open():
    turn = {"orbit_phase": lambda s: (s / 5_580.0 * 360.0) % 360.0}
    seen = series_of(6, 60, turn, lambda s, u, c: np.where(c["orbit_phase"] > 180.0, 1.0, -1.0))
    seen.series.values[:1440, seen.series.features.place("weight")] = 0.0
    (found,) = heat_maps(seen)
    assert (found.coordinate, found.reach, found.before.shape) == (
        "orbit_phase",
        360.0,
        (6, VIEW_SETTINGS.map_columns),
    )
    assert np.isnan(found.before[0]).all()
    assert np.nanmax(found.before[1:, : VIEW_SETTINGS.map_columns // 2 - 1]) < -0.9
    assert np.nanmin(found.before[1:, VIEW_SETTINGS.map_columns // 2 + 1 :]) > 0.9
    np.testing.assert_allclose(found.after[1:], 0.1 * found.before[1:])


@pytest.mark.parametrize(("days", "step_s"), [(3000, 3600.0), (0.01, 1.0), (1, 10.0)])
def test_maps_and_sizes_stay_small_whatever_the_span(days, step_s):
    seen = series_of(days, step_s, {}, lambda s, u, c: u[:, 0])
    (found,) = heat_maps(seen)
    assert found.before.shape[0] <= VIEW_SETTINGS.map_rows
    assert np.isfinite(found.before).any()
    sizes = sizes_of(seen)
    assert sizes.day.size <= 1000
    assert sizes.counts["before"].sum() == pytest.approx(len(seen.before), rel=0.01)


def test_an_epoch_shows_a_step_at_its_time():
    seen = series_of(10, 600, {}, lambda s, u, c: np.where(s > 4 * 86_400, 0.5, 0.0))
    found = superposed_epoch(seen, int(seen.series.tt2000[0]) + 4 * DAY)["before"]
    assert np.nanmax(np.abs(found.mean[found.centre < -0.3])) < 0.05
    assert np.nanmin(found.mean[found.centre > 0.3]) > 0.45


def test_thinning_keeps_samples_together():
    seen = series_of(2, 60, {"t": wave}, lambda s, u, c: u[:, 0])
    thin = seen.thinned(1000)
    assert len(thin.before) <= 1000
    np.testing.assert_array_equal(thin.before[:, 0], thin.series["residual"])
