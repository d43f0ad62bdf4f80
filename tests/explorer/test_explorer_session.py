"""What the page does is what the verbs do: the same numbers, versions and errors."""

import numpy as np
import pytest
from heated_mission import HEATER_FIELD

import inflight.explorer.session as session_module
from inflight.catalog import Catalog
from inflight.errors import CatalogError, ModelError
from inflight.explorer.diagnosis_view import diagnosis_sections
from inflight.explorer.loop_state import IN_MODEL, LoopState, candidate_rows
from inflight.explorer.loop_view import ledger
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.traces import thin_trace
from inflight.tasks.analysis import compare, last_diagnosis, open_workbench
from inflight.time import to_tt2000

DAYS = Days(np.datetime64("2024-03-01"), np.datetime64("2024-03-04"))
EFFECT = "channel_field(heater_current)"


def nobody(stage: str, done: int, total: int) -> None:
    """Take progress that nobody watches."""


@pytest.fixture
def session(workspace):
    made = ExplorerSession(workspace, workers=1)
    yield made
    made.close()


def test_the_residual_is_that_of_the_verb_and_is_measured_once(session, workspace, monkeypatch):
    told = compare(Catalog(workspace.root), workspace.mission(), *DAYS.bounds()).as_json()
    parts = dict(session.compare("main", DAYS, nobody))
    paragraphs, figures = parts["Residual"]()
    assert f"{told['residual']['after_nT']:.4f}" in "".join(paragraphs)
    assert len(figures) == 3

    def refuse(*arguments):
        raise AssertionError("measured again")

    monkeypatch.setattr("inflight.explorer.session.measure_comparison", refuse)
    assert [heading for heading, _ in session.compare("main", DAYS, nobody)] == list(parts)
    with pytest.raises(AssertionError, match="measured again"):
        session.compare("main", Days(DAYS.first, DAYS.first), nobody)


def test_a_span_without_products_is_told_as_by_the_verb(session):
    with pytest.raises(CatalogError, match="no published days in the span"):
        session.compare("main", Days(np.datetime64("2030-01-01"), np.datetime64("2030-01-02")), nobody)


def test_the_effect_is_found_added_and_taken_back(session, workspace):
    found = session.diagnose("main", DAYS, nobody)
    assert found["verdict"] == "FOUND"
    assert last_diagnosis(workspace)["effects"] == found["effects"]
    headings = [heading for heading, _, _ in diagnosis_sections(session.last_diagnosis("main"))]
    assert headings == ["Verdict", "Candidates", "Steps of the search"]

    rows = candidate_rows(found)
    assert (rows[0].name, rows[0].words) == (EFFECT, "a field that follows heater_current")
    tried = session.preview("main", EFFECT, nobody)
    assert tried["coefficients"]
    # What is drawn of it is what is told, and the heater, taken off, is no noise any more.
    seen = session.before_after()
    sizes = [float(np.sqrt(np.mean(one[seen.good] ** 2))) for one in (seen.before, seen.after)]
    assert sizes == pytest.approx(tried["error"]["in_sample_nT"], rel=1e-3)
    assert tried["error"]["noise_floor_nT"] == pytest.approx(0.05 * np.sqrt(2), rel=0.01)
    assert found["residual"]["noise_floor_nT"] == pytest.approx(0.05 * np.sqrt(2), rel=0.01)
    assert len(session.versions("main")[0]) == 1

    added = session.change("main", "add", EFFECT, nobody)
    before, after = added["error"]["held_out_nT"]
    assert after < 0.5 * before
    assert tried["error"]["held_out_nT"] == pytest.approx([before, after])
    assert session.stale_products("main") == 4
    # What the heater makes of the residual is its field along the measured one.
    made, seen = session.contributions(), session.before_after()
    (values,) = (one for name, one in made.effects.items() if "heater_current" in name)
    truth = seen.series.direction()[:, 0] @ HEATER_FIELD * seen.series["heater_current"] / 1000
    assert np.abs(values - truth)[seen.good].max() < 0.05
    # What was found is in the model now: the diagnosis is of the one before, and says so.
    stale = session.last_diagnosis("main")
    assert stale["stale"].endswith("version 2")
    assert "Not of the model in use." in "".join(diagnosis_sections(stale)[0][1])
    versions, effects = session.versions("main")
    assert [one["used"] for one in versions] == [False, True]
    assert len(effects) == 2
    own = [row.name for row in candidate_rows(stale, effects) if row.reason == IN_MODEL]
    assert own == [EFFECT]
    state, step = LoopState(stale, versions, "model version 2", 4, 4).sentences()
    assert "at the noise floor" in state
    assert step.startswith("Reprocess")

    undone = session.change("main", "undo", "", nobody)
    assert undone["error"]["held_out_nT"] == pytest.approx([after, before])
    assert "stale" not in session.last_diagnosis("main")
    assert session.stale_products("main") == 0
    assert "add channel_field(heater_current)" in ledger(session.versions("main")[0])


def test_figures_and_page_of_a_diagnosis_made_here_take_no_second_search(session, workspace, monkeypatch):
    session.diagnose("main", DAYS, nobody)
    searched = []
    own = session_module.diagnose_span
    monkeypatch.setattr(
        session_module, "diagnose_span", lambda *given, **how: searched.append(1) or own(*given, **how)
    )
    sections = session.figures_of_diagnosis("main", nobody)
    assert "What each cause would make" in [heading for heading, _, _ in sections]
    page = session.write_report("main", nobody)
    whole = page.read_bytes()
    assert searched == []
    # Another session has no search, and the page all the same.
    other = ExplorerSession(workspace, workers=1)
    assert other.write_report("main", nobody).read_bytes() == whole
    assert searched == []
    # What is held of a workbench takes its place, and the other way round.
    session.preview("main", EFFECT, nobody)
    assert session._searched is None
    assert [heading for heading, _, _ in session.figures_of_diagnosis("main", nobody)] == [
        heading for heading, _, _ in sections
    ]
    assert searched == [1]
    assert session._bench is None
    other.close()


def test_what_is_drawn_in_time_goes_down_to_samples_with_their_flags(session):
    first, last = to_tt2000(np.array(["2024-03-02T06:00", "2024-03-02T18:00"], dtype="datetime64[us]"))
    samples = session.samples("main", int(first), int(last), 10_000)
    assert samples.tt2000.size == 720
    day = Catalog(session.workspace.root).current("l2/field", "2024-03-02")
    flag = Catalog(session.workspace.root).read(day, ["flag"])["flag"].values[360:1080]
    assert ((samples.flags == "") == (flag == 0)).all()
    assert session.samples("main", int(first), int(last), 1000) is None
    # Thinned, no extreme is lost, and a gap stays one.
    residual = samples.residual.copy()
    residual[300:400] = np.nan
    curve = (samples.tt2000, residual, residual, residual)
    time, mean, low, high = thin_trace(*curve, int(first), int(last), 50)
    assert time.size <= 50
    assert (np.nanmin(low), np.nanmax(high)) == (np.nanmin(residual), np.nanmax(residual))
    assert np.isnan(mean[(time > samples.tt2000[315]) & (time < samples.tt2000[384])]).all()


def test_a_step_of_the_model_is_drawn_as_an_event(session):
    assert session.events("main") == []
    session.change("main", "add", "offset_step@2024-03-03", nobody)
    (event,) = session.events("main")
    assert np.datetime64(int(event.ms), "ms") == np.datetime64("2024-03-03")
    assert event.end_ms == event.ms
    assert "offset_step" in event.text


def test_a_change_from_the_command_line_is_noticed(session, workspace):
    added = session.change("main", "add", EFFECT, nobody)
    # As 'inflight undo' does it, in another process.
    elsewhere = open_workbench(workspace).undo()
    assert elsewhere.model.version == added["model"]["version"] + 1
    again = session.change("main", "add", EFFECT, nobody)
    assert again["model"]["parent"] == elsewhere.model.version
    assert again["error"]["held_out_nT"] == pytest.approx(added["error"]["held_out_nT"])


def test_a_change_that_cannot_be_made_changes_nothing(session):
    before = session.versions("main")
    with pytest.raises(ModelError):
        session.change("main", "add", "no_such_effect", nobody)
    assert session.versions("main") == before


def test_tables_are_shown_with_values_and_errors(session):
    sections = {heading: (text, figures) for heading, text, figures in session.tables("main", nobody)}
    _, figures = sections["Parameters over days"]
    assert len(figures) == 3
    assert "±" in "".join(sections["Values"][0])
