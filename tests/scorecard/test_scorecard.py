"""The scorecard: what is obtained is worked out when asked, and the verdict follows from it."""

import dataclasses
import inspect
import json
import re
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from inflight.cli import main
from inflight.errors import SettingsError
from inflight.mission_fit import crosstalk
from inflight.scorecard import (
    SECTIONS,
    Estimate,
    PublishedFigure,
    ScorecardResult,
    SimulatedDays,
    ToleranceInterval,
    figures,
    registry,
    run_scorecard,
    select_figures,
)
from inflight.scorecard import recovered_fields as fields_module
from inflight.scorecard import scalar_calibration as scalar_module
from inflight.scorecard import spacecraft_fields as spacecraft_module

#: What is printed and geometry does not bear out.
CONTRADICTED = {
    "lag.xz",
    "day-night.duty",
    "day-night.daytime",
    "day-night.full-sun",
    "day-night.xz",
    "imp8.slope-errors",
    "signs.azimuth",
    "signs.phase",
    "spin-averages.five-one",
}


#: What the command prints of each figure.
KEYS = {"id", "source", "published", "obtained", "tolerance", "basis", "verdict"}
BASES = {"derived", "recovered_from_injection", "measured", "needs_mission_data"}
VERDICTS = {"reproduced", "contradicted", "not reproducible", "needs data"}

#: Recovered figures in which nothing is put in: that an estimator finds nothing is what they say.
NOTHING_PUT_IN = {
    "jump.continuous",
    "themis-c.offset-sheath",
    "themis-c.gains-elsewhere",
    "themis-c.elevation-elsewhere",
}
#: Numbers of a figure that its data hardly tell: by their sigma, they could be nominal. Along y, which the
#: field's direction hardly has on a polar orbit; and the law's factor, which geometry gives.
WEAK = {
    "solar.difference-recovered": {1},
    "panels.recovered": {1, 4},
    "torquer.recovered": {1, 5},
    "z-offset.regression": {0},
    "imp8.slopes-recovered": {0, 1},
}


#: Simulated days that the figures share, as in one run of the scorecard.
SCENE = SimulatedDays()


@pytest.fixture(scope="module")
def reports() -> dict[str, ScorecardResult]:
    # Of the processor, not of the clock: what else the machine does is no matter of the scorecard.
    begun = time.process_time()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "SimulatedDays", lambda: SCENE)
        found = {report.figure.id: report for report in run_scorecard()}
    assert time.process_time() - begun < 60.0
    return found


def test_the_command_prints_the_promised_shape_for_every_figure(reports, monkeypatch, capsys):
    """``inflight figures --json``, with the figures that were worked out already."""
    monkeypatch.setattr("inflight.scorecard.run_scorecard", lambda *_: list(reports.values()))
    with pytest.raises(SystemExit) as left:
        main(["figures", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert left.value.code in (0, None)
    assert told["command"] == "figures"
    assert [one["id"] for one in told["figures"]] == [one.id for one in figures()]
    for one in told["figures"]:
        assert set(one) >= KEYS
        assert one["basis"] in BASES
        assert one["verdict"] in VERDICTS
        assert (one["obtained"] is None) == (one["verdict"] in ("needs data", "not reproducible"))
    counted = sum(sum(verdicts.values()) for verdicts in told["verdicts"].values())
    assert counted == len(told["figures"])


def test_every_figure_has_its_own_id_and_a_section_that_is_there():
    ids = [figure.id for figure in figures()]
    assert len(ids) == len(set(ids))
    assert {figure.section for figure in figures()} == set(SECTIONS)


def test_the_printed_figures_that_geometry_contradicts_are_these(reports):
    assert {name for name, report in reports.items() if report.verdict == "contradicted"} == CONTRADICTED
    assert all(reports[name].figure.printed for name in CONTRADICTED)


@pytest.mark.parametrize("figure", figures(), ids=lambda figure: figure.id)
def test_the_verdict_follows_from_obtained_and_tolerance(reports, figure):
    report = reports[figure.id]
    if report.obtained is None:
        assert report.verdict == "needs data"
        assert figure.basis == "needs_mission_data"
        assert "tried" in figure.why
        return
    several = np.atleast_1d(report.obtained)
    published = np.atleast_1d(figure.published)
    if isinstance(figure.tolerance, ToleranceInterval):
        near = np.all((several >= figure.tolerance.low) & (several <= figure.tolerance.high))
    else:
        near = np.all(np.abs(several - published) <= np.array(figure.tolerance))
    assert report.verdict == ("reproduced" if near else "contradicted")


@pytest.mark.parametrize("figure", [one for one in figures() if one.obtain], ids=lambda figure: figure.id)
def test_a_figure_can_be_contradicted(reports, figure):
    """Another published value, far from what is obtained, must not be reproduced."""
    obtained = np.atleast_1d(reports[figure.id].obtained)
    away = tuple((3.0 * np.abs(obtained) + 1e3).tolist())
    tolerance = (
        ToleranceInterval(away[0], 2 * away[0])
        if isinstance(figure.tolerance, ToleranceInterval)
        else figure.tolerance
    )
    moved = dataclasses.replace(figure, published=away, tolerance=tolerance)
    assert ScorecardResult(moved, reports[figure.id].obtained).verdict == "contradicted"


@pytest.mark.parametrize(
    "figure",
    [one for one in figures() if one.basis == "recovered_from_injection" and one.id not in NOTHING_PUT_IN],
    ids=lambda figure: figure.id,
)
def test_an_estimator_that_returns_nominal_values_fails(reports, figure):
    report = reports[figure.id]
    assert dataclasses.replace(report, obtained=figure.nominal).verdict == "contradicted"
    if report.sigma is not None:
        away = np.abs(np.subtract(figure.nominal, figure.published)) / report.sigma
        assert set(np.flatnonzero(away < 4.0)) == WEAK.get(figure.id, set())


def test_a_sigma_that_is_too_large_or_too_small_does_not_help():
    """The written tolerance holds whatever an estimator states, and what it states holds within it."""

    def verdict(value, sigma):
        return figure(obtain=lambda scene: Estimate.of(value, sigma)).report(SCENE).verdict

    assert verdict(1.05, 0.02) == "reproduced"
    assert verdict(1.05, 0.01) == "contradicted"
    assert verdict(1.2, 10.0) == "contradicted"
    assert verdict(1.0, float("nan")) == "contradicted"


def test_obtained_values_come_from_formulas_not_from_the_published_ones(reports):
    for figure in figures():
        if figure.obtain:
            moved = dataclasses.replace(
                figure, published=tuple(1.0 + 2.0 * np.atleast_1d(figure.published)), tolerance=0.0
            )
            assert moved.report(SCENE).obtained == reports[figure.id].obtained


def test_a_wrong_sign_in_cross_talk_changes_the_verdicts(monkeypatch):
    right = crosstalk.regression_coefficients
    monkeypatch.setattr(crosstalk, "regression_coefficients", lambda *arguments: -right(*arguments))
    verdicts = {report.figure.id: report.verdict for report in run_scorecard(["lag", "bias"])}
    assert verdicts["lag.xz-exact"] == verdicts["bias.scale-factors"] == "contradicted"
    assert verdicts["lag.correlation"] == "reproduced"


def test_a_wrong_power_in_the_dipole_changes_the_verdict(monkeypatch):
    right = spacecraft_module.dipole_split
    wrong = lambda one, near, far: right(one, near[0] ** (2 / 3), far[0] ** (2 / 3))  # noqa: E731
    monkeypatch.setattr(spacecraft_module, "dipole_split", wrong)
    assert run_scorecard(["dipole.split"])[0].verdict == "contradicted"


def test_a_lost_sign_in_the_linear_form_changes_the_verdict(monkeypatch):
    right = scalar_module.fit_difference

    def without_offsets(reading, scalar, passes=1):
        found = right(reading, scalar, passes)
        return np.concatenate([found[:6], -found[6:]])

    figure = next(one for one in figures() if one.id == "difference-form.one-pass")
    assert figure.report(SCENE).verdict == "reproduced"
    monkeypatch.setattr(scalar_module, "fit_difference", without_offsets)
    assert figure.report(SimulatedDays()).verdict == "contradicted"


def test_what_figures_share_is_made_once():
    made, scene = [], SimulatedDays()

    def costly(of, number):
        made.append(number)
        return number * 2

    assert [scene.cached(costly, 3), scene.cached(costly, 3), scene.cached(costly, 4)] == [6, 6, 8]
    assert made == [3, 4]


def figure(**changes) -> PublishedFigure:
    plain = PublishedFigure(
        id="a.b",
        section="residual",
        what="a number",
        unit="nT",
        source="somewhere",
        published=1.0,
        tolerance=0.1,
        basis="derived",
        why="because",
    )
    return dataclasses.replace(plain, **changes)


def test_what_was_tried_is_an_injection_that_is_there():
    """A figure that needs the mission's data names the figures in which its numbers were put in."""
    ids = {one.id: one for one in figures()}
    for one in figures():
        if one.basis == "needs_mission_data":
            told = set(re.findall(r"[a-z-]+\.[a-z-]+", one.why))
            named = [name for name in ids if name in told]
            assert named, one.id
            assert all(ids[name].basis == "recovered_from_injection" for name in named), one.id


def test_an_estimator_that_loses_the_sign_is_contradicted(monkeypatch):
    right = fields_module.fit_step

    def wrong(epochs):
        fit = right(epochs).fit
        return SimpleNamespace(fit=SimpleNamespace(value=-fit.value, sigma=fit.sigma))

    monkeypatch.setattr(fields_module, "fit_step", wrong)
    assert run_scorecard(["camera.recovered"])[0].verdict == "contradicted"


def test_a_figure_whose_source_says_too_little_is_not_reproducible():
    assert figure().report(SCENE).verdict == "not reproducible"
    assert figure(basis="needs_mission_data").report(SCENE).verdict == "needs data"


@pytest.mark.parametrize(
    ("obtained", "verdict"),
    [(1.1, "reproduced"), (1.11, "contradicted"), (0.9, "reproduced"), (float("nan"), "contradicted")],
)
def test_the_tolerance_is_a_distance_its_end_included(obtained, verdict):
    found = figure(tolerance=0.1 + 1e-12, obtain=lambda scene: obtained).report(SCENE)
    assert found.verdict == verdict


def test_several_numbers_must_all_agree_and_be_as_many():
    several = figure(published=(1.0, 2.0), tolerance=(0.1, 0.01))
    assert (
        dataclasses.replace(several, obtain=lambda scene: (1.05, 2.0)).report(SCENE).verdict == "reproduced"
    )
    assert (
        dataclasses.replace(several, obtain=lambda scene: (1.05, 2.1)).report(SCENE).verdict == "contradicted"
    )
    assert dataclasses.replace(several, obtain=lambda scene: 1.0).report(SCENE).verdict == "contradicted"
    with pytest.raises(SettingsError, match="tolerances"):
        figure(published=(1.0, 2.0), tolerance=(0.1, 0.1, 0.1))


def test_a_recovered_figure_without_a_recovery_is_refused():
    with pytest.raises(SettingsError, match="nothing obtains"):
        figure(basis="recovered_from_injection")


def test_figures_are_selected_by_id_beginning_and_section():
    assert [one.id for one in select_figures(["lag.xz"])] == ["lag.xz"]
    assert {one.id.split(".")[0] for one in select_figures(["lag", "bias"])} == {"lag", "bias"}
    assert {one.section for one in select_figures(section="residual")} == {"residual"}
    with pytest.raises(SettingsError, match="no figure 'la'"):
        select_figures(["la"])
    with pytest.raises(SettingsError, match="no section"):
        select_figures(section="9")


def test_no_figure_is_a_constant():
    """A function that obtains a value calls something; a literal would be a stored result."""
    for one in figures():
        if one.obtain is not None:
            function = getattr(one.obtain, "func", one.obtain)
            names = set(function.__code__.co_names) | set(inspect.signature(function).parameters)
            assert function.__code__.co_names, f"{one.id}: {names}"


def test_the_reference_page_names_every_figure():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "figures.md").read_text(encoding="utf-8")
    assert [one.id for one in figures() if f"`{one.id}`" not in page] == []
    assert all(f"`{section}`" in page for section in SECTIONS)
