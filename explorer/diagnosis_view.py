"""The tab of the missing effect: last diagnosis, changes of the model, and how the error falls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.session import Days, ExplorerSession
from inflight.figures import (
    Section,
    SectionBody,
    candidate_table,
    change_tables,
    entries_html,
    error_figure,
    found_effects_html,
    gain_change_figure,
    html_table,
    ledger_table,
    paragraph,
    separating_blocks_html,
    short_name,
    unique_labels,
    unscorable_list,
    verdict_strip,
)

Fields = Mapping[str, Any]
_NOTE = (
    "Gain is the part of the mean square that a candidate alone takes off days not used in the fit, with "
    "its 95 % interval; the grey bar behind it is the best placebo, a channel shifted in time, which "
    "explains by chance. p counts all candidates and forms that were tried."
)


class DiagnosisView:
    """The missing effect; every button does what the verb of the same name does.

    Parameters
    ----------
    session : ExplorerSession
    changed : callable
        Called when the model has another version.
    """

    title = "The missing effect"

    def __init__(self, session: ExplorerSession, changed: Callable[[], None]) -> None:
        self._session, self._notify = session, changed
        self._overview: ComparisonOverview | None = None
        self._days: Days | None = None
        self._diagnosis_pane, self._model_pane = JobPane(session.background), JobPane(session.background)
        self._versions = pn.Column(sizing_mode="stretch_width")
        self._diagnose = pn.widgets.Button(name="Diagnose this span", button_type="primary")
        self._figures = pn.widgets.Button(name="All figures of this diagnosis")
        self._candidate = pn.widgets.Select(name="Candidate", options=[], width=330)
        self._other = pn.widgets.TextInput(
            name="or a channel, an effect, an entry", placeholder="scale_drift", width=230
        )
        self._add = pn.widgets.Button(name="Add", button_type="primary", align="end")
        self._undo = pn.widgets.Button(name="Undo", align="end")
        self._own = pn.widgets.Select(name="Effect of the model", options=[], width=230)
        self._drop = pn.widgets.Button(name="Drop", align="end")
        for button, work in (
            (self._diagnose, self._begin_diagnosis),
            (self._figures, self._begin_figures),
            (self._add, lambda: self._change("add", self._other.value.strip() or self._candidate.value)),
            (self._undo, lambda: self._change("undo", "")),
            (self._drop, lambda: self._change("drop", self._own.value)),
        ):
            button.on_click(lambda event, work=work: work())
        self.panel = pn.Column(
            pn.Row(self._diagnose, self._figures),
            pn.Row(self._candidate, self._other, self._add, self._own, self._drop, self._undo),
            self._model_pane.panel,
            self._diagnosis_pane.panel,
            self._versions,
            sizing_mode="stretch_width",
        )

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show the last diagnosis of a comparison and the versions of its model."""
        self._overview, self._days = overview, days
        self._show_diagnosis(self._session.last_diagnosis(overview.comparison))
        self._show_model()

    # The last diagnosis.

    def _begin_diagnosis(self) -> None:
        if self._overview is None or self._days is None:
            self._diagnosis_pane.put(panes.hint("The archive is empty: 'inflight ingest' fills it."))
            return
        comparison, days = self._overview.comparison, self._days
        self._diagnosis_pane.begin(
            "Diagnosis",
            lambda progress: self._session.diagnose(comparison, days, progress),
            self._diagnosed,
        )

    def _diagnosed(self, fields: Fields) -> pn.viewable.Viewable:
        self._list_candidates(fields)
        return panes.sections(diagnosis_sections(fields))

    def _begin_figures(self) -> None:
        if self._overview is None:
            return
        comparison = self._overview.comparison
        self._diagnosis_pane.begin(
            "All figures",
            lambda progress: self._session.figures_of_diagnosis(comparison, progress),
            panes.sections,
        )

    def _show_diagnosis(self, fields: Fields | None) -> None:
        self._figures.disabled = fields is None
        if fields is None:
            self._candidate.options = []
            self._diagnosis_pane.put(panes.hint("There is no diagnosis yet: diagnose a span."))
        else:
            self._diagnosis_pane.put(self._diagnosed(fields))

    def _list_candidates(self, fields: Fields) -> None:
        """List the found effects first, then the ranking."""
        self._figures.disabled = False
        names = [one["name"] for one in fields["effects"]]
        names += [one["name"] for one in fields["candidates"] if not one["placebo"]]
        unique = list(dict.fromkeys(names))
        labels = unique_labels([short_name(name) for name in unique])
        self._candidate.options = dict(zip(labels, unique, strict=True))
        if unique:
            self._candidate.value = unique[0]

    # The model.

    def _change(self, verb: str, effect: str | None) -> None:
        if self._overview is None:
            return
        if verb != "undo" and not effect:
            self._model_pane.put(panes.hint(f"Choose what to {verb} first."))
            return
        comparison = self._overview.comparison
        self._other.value = ""
        self._model_pane.begin(
            f"{verb} {effect}".strip(),
            lambda progress: self._session.change(comparison, verb, effect or "", progress),
            lambda change: self._changed(),
        )

    def _changed(self) -> pn.viewable.Viewable:
        self._notify()
        assert self._overview is not None
        self._show_versions()
        # The diagnosis shown is of the model before.
        self._show_diagnosis(self._session.last_diagnosis(self._overview.comparison))
        return _change_pane(self._session.changes[self._overview.comparison])

    def _show_model(self) -> None:
        assert self._overview is not None
        changes = self._session.changes[self._overview.comparison]
        self._model_pane.put(*([_change_pane(changes)] if changes else []))
        self._show_versions()

    def _show_versions(self) -> None:
        assert self._overview is not None
        versions, effects = self._session.versions(self._overview.comparison)
        self._own.options = effects
        self._versions.objects = [panes.section(*version_section(versions))]


def diagnosis_sections(fields: Fields) -> list[Section]:
    """Return the sections of a stored diagnosis: fields of `Diagnosis.as_json`, and ``asked``."""
    strip = verdict_strip(
        fields["verdict"], fields["sentence"], fields["residual"], fields["remaining"]["verdict"]
    )
    rivals = {one["name"]: one["rivals"] for one in fields["effects"]}
    table = candidate_table(fields["candidates"], {}, rivals)
    unscorable = unscorable_list(fields["unscorable"])
    return [
        (
            "Verdict",
            [
                _span_and_model(fields),
                strip,
                *entries_html(fields),
                *found_effects_html(fields),
                *separating_blocks_html(fields),
            ],
            [],
        ),
        (
            "Candidates",
            [paragraph(_NOTE, kind="quiet"), table, unscorable],
            [gain_change_figure(fields["candidates"])],
        ),
        ("Steps of the search", [ledger_table(fields["rounds"])], []),
    ]


def _span_and_model(fields: Fields) -> str:
    """Return the span and the model of a diagnosis as text."""
    asked, model = fields.get("asked") or {}, fields["model"]
    ends = []
    if asked.get("start"):
        ends.append(f"from {asked['start']}")
    if asked.get("end"):
        ends.append(f"to {np.datetime64(asked['end'], 'D') - 1}")
    version = f" version {model['version']}" if model.get("version") else ""
    span = f"Days {' '.join(ends)}" if ends else "All days"
    samples = fields["blocks"].get("samples")
    count = f", {samples} samples" if samples else ""
    text = paragraph(f"{span}{count}, model {model.get('name')}{version}.", kind="quiet")
    if not fields.get("stale"):
        return text
    return text + paragraph(
        f" It is of model version {model['version']}; in use is {fields['stale']}, which may have what is "
        "named here already. 'Diagnose this span', or inflight diagnose, makes it anew.",
        bold="Not of the model in use.",
    )


def _change_pane(changes: Sequence[Fields]) -> pn.viewable.Viewable:
    """Return the last change and its figure side by side."""
    paragraphs, figures = change_section(changes)
    return pn.Row(*map(pn.pane.Bokeh, figures), panes.text(*paragraphs), sizing_mode="stretch_width")


def change_section(changes: Sequence[Fields]) -> SectionBody:
    """Return what the page's last change did, and how the error fell with all of them.

    Parameters
    ----------
    changes : sequence of mapping
        As `Revision.as_json`, in the order they were made; at least one.
    """
    note = paragraph(
        "Products and tables are those of the model before until 'inflight reprocess' makes them anew; a new "
        "diagnosis says what is still missing."
    )
    return [*change_tables(changes[-1]), note], [error_figure(changes)]


def _before_and_after(change: Fields | None, key: str) -> str:
    """Return both sizes of what a version did; empty of one that nothing is known of."""
    both = (change or {}).get(key)
    return f"{both[0]:.4g} to {both[1]:.4g}" if both and None not in both else ""


def version_section(versions: Sequence[Fields]) -> SectionBody:
    """Return every version of the workspace's models, newest first.

    Parameters
    ----------
    versions : sequence of mapping
        As `inflight.tasks.models.ModelHistory.items`.
    """
    rows = [
        (
            str(one["version"]),
            one["name"],
            "in use" if one["used"] else "",
            str(one["parent"] or ""),
            one["message"],
            *(_before_and_after(one["change"], key) for key in ("held_out_nT", "above_floor_nT")),
            str(one["created"])[:16].replace("T", " "),
        )
        for one in reversed(versions)
    ]
    head = ["version", "model", "", "from", "what was done"]
    head += ["residual of days not used in the fit, nT", "above the noise, nT", "UTC"]
    table = (
        html_table(head, rows) if rows else paragraph("None is saved yet: in use is the mission's own file.")
    )
    return [paragraph("", bold="Versions of the model"), table], []
