"""The tab of the last diagnosis, with everything it says."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.session import Days, ExplorerSession
from inflight.figures import (
    Section,
    candidate_table,
    entries_html,
    found_effects_html,
    gain_change_figure,
    ledger_table,
    paragraph,
    separating_blocks_html,
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
    """The last diagnosis whole: verdict, candidates, steps of the search, and all figures of it.

    Parameters
    ----------
    session : ExplorerSession
    """

    title = "Diagnosis"

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._comparison = ""
        self._pane = JobPane(session.background)
        self._figures = pn.widgets.Button(name="All figures of this diagnosis")
        self._figures.on_click(lambda event: self._begin_figures())
        self._report = pn.widgets.Button(name="Report as a page of its own")
        self._report.on_click(lambda event: self._begin_report())
        self._model = pn.widgets.FileDownload(label="Model as YAML", callback=self._model_text, auto=True)
        buttons = pn.Row(self._figures, self._report, self._model)
        self.panel = pn.Column(buttons, self._pane.panel, sizing_mode="stretch_width")

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show the last diagnosis of a comparison, of whichever days it is."""
        del days
        self._comparison = overview.comparison
        fields = self._session.last_diagnosis(overview.comparison)
        self._figures.disabled = self._report.disabled = fields is None
        self._model.filename = self._session.model_file(self._comparison)[0]
        if fields is None:
            self._pane.put(panes.hint("There is no diagnosis yet: 'The loop' makes one."))
        else:
            self._pane.put(panes.sections(diagnosis_sections(fields)))

    def _begin_figures(self) -> None:
        comparison = self._comparison
        self._pane.begin(
            "All figures",
            lambda progress: self._session.figures_of_diagnosis(comparison, progress),
            panes.sections,
        )

    def _begin_report(self) -> None:
        comparison = self._comparison
        self._pane.begin(
            "Report",
            lambda progress: self._session.write_report(comparison, progress),
            lambda page: pn.Column(
                panes.text(paragraph(f" {page}", bold="The report is written:")),
                pn.widgets.FileDownload(file=str(page), label=f"Download {page.name}"),
            ),
        )

    def _model_text(self) -> io.StringIO:
        self._model.filename, text = self._session.model_file(self._comparison)
        return io.StringIO(text)


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
