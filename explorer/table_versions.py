"""Versions of calibration tables: where each holds, and what changed from one to another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import panel as pn
from markupsafe import Markup

from inflight.calibration import TableChanges
from inflight.catalog import Catalog, TableRecord
from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane
from inflight.explorer.overview import ComparisonOverview, owner_of_table
from inflight.explorer.session import ExplorerSession
from inflight.figures import changes_picture, html_table, paragraph, table_change_panels
from inflight.mission import Mission
from inflight.time import utc_text

#: Tables listed, the newest ones.
_LISTED = 40


class TableVersions:
    """The tables of a comparison with their validity, and two of them side by side.

    Parameters
    ----------
    session : ExplorerSession
    """

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._records: list[TableRecord] = []
        self._list = pn.Column(sizing_mode="stretch_width")
        self._before = pn.widgets.Select(name="Before", options=[], width=220)
        self._after = pn.widgets.Select(name="After", options=[], width=220)
        self._compare = pn.widgets.Button(name="Compare", align="end")
        self._pane = JobPane(session.figure_background)
        self._before.param.watch(lambda event: self._offer(), "value")
        self._compare.on_click(lambda event: self._begin())
        self._choice = pn.Row(self._before, self._after, self._compare)
        self.panel = pn.Column(self._list, self._choice, self._pane.panel, sizing_mode="stretch_width")

    def show(self, overview: ComparisonOverview) -> None:
        """List the tables of a comparison; the newest two of one name are chosen."""
        cat, mission = self._session.cat, self._session.mission()
        self._records = tables_of(cat, mission, overview.comparison)
        self._list.objects = [panes.text(*list_of_tables(cat, self._records))] if self._records else []
        whole = [one for one in self._records if not one.damaged]
        # Of most names there is one table: those with two come first.
        names = [one.name for one in whole]
        several = [_label(one) for one in reversed(whole) if names.count(one.name) > 1]
        self._choice.visible = bool(several)
        self._pane.put()
        first = next((label for label in several if _label(self._newest(label)) != label), None)
        self._before.param.update(options=several, value=first)
        self._offer()

    def _newest(self, label: str) -> TableRecord:
        return [one for one in self._records if one.name == label.rpartition(":")[0]][-1]

    def _offer(self) -> None:
        """Offer the other tables of the name that was chosen, the newest one first."""
        label = self._before.value
        if not label:
            return
        name = label.rpartition(":")[0]
        others = [_label(one) for one in reversed(self._records) if one.name == name and _label(one) != label]
        self._after.param.update(options=others, value=others[0] if others else None)

    def _begin(self) -> None:
        old, new = self._before.value, self._after.value
        if old and new:
            self._pane.begin(
                f"{old} to {new}",
                lambda progress: self._session.table_changes(old, new, progress),
                lambda found: panes.text(*told_changes(f"{old} to {new}", found)),
            )


def tables_of(cat: Catalog, mission: Mission, comparison: str) -> list[TableRecord]:
    """Return the records of a comparison's tables, the oldest first."""
    return [one for one in cat.tables() if owner_of_table(one.name, mission) == comparison]


def list_of_tables(cat: Catalog, records: Sequence[TableRecord]) -> list[str]:
    """Return tables with where they hold, who made and who approved them, the newest first."""
    runs = {one.id: one for one in cat.runs()}
    rows = []
    for one in list(reversed(records))[:_LISTED]:
        run = runs.get(one.run)
        model = cat.context(one.context) if one.context else None
        rows.append(
            (
                _label(one),
                run.started[:16].replace("T", " ") if run else "",
                f"{model.model_name} {model.model_version}" if model else "",
                _span(one.start, one.end),
                _validity(one),
                ", ".join(dict.fromkeys(person for person, _, _ in one.approved)),
            )
        )
    heads = ["table", "made, UTC", "model", "learnt from", "holds", "approved by"]
    more = len(records) - len(rows)
    return [
        html_table(heads, rows, kind="wide told scrolled"),
        *([paragraph(f"... and {more} older ones: inflight catalog history", kind="quiet")] if more else []),
    ]


def told_changes(title: str, found: TableChanges) -> list[str]:
    """Return what changed from one table to another: a row each parameter, and a picture over time."""
    rows = [
        (
            one.parameter,
            f"{one.largest:+.4g}",
            f"{one.rms:.4g}",
            "" if one.unit == "1" else one.unit,
            utc_text(one.at)[:16].replace("T", " "),
            "" if np.isnan(one.sigmas) else f"{one.sigmas:.2f}",
            "" if np.isnan(one.field) else f"{one.field:.3g}",
        )
        for one in found.rows()
    ]
    if not rows:
        return [paragraph(" The parameters of both have the same values.", bold=title)]
    heads = ["parameter", "largest", "rms", "unit", "from", "largest, sigmas", "rms in the field, nT"]
    parts: list[str] = [paragraph("", bold=title), html_table(heads, rows, kind="wide")]
    for what, names in (("gained", found.gained), ("lost", found.lost)):
        if names:
            parts.append(paragraph(f"parameters {what}: {', '.join(names)}"))
    together = found.field_rms()
    text = f"Sigmas: the change over the larger sigma of both. In a field of {found.strength:.0f} nT."
    if np.isfinite(together):
        text += f" All together {together:.3g} nT rms over time and directions."
    picture = changes_picture(f"{title}: changes; the band is one sigma", table_change_panels(found))
    return [*parts, paragraph(text, kind="quiet"), Markup(picture[picture.index("<svg ") :])]


def _label(one: TableRecord) -> str:
    return f"{one.name}:{one.id}"


def _span(start: int, end: int) -> str:
    return f"{utc_text(start)[:10]} to {utc_text(end)[:10]}"


def _validity(one: TableRecord) -> str:
    if one.damaged:
        return "its store is gone"
    spans = [_span(start, end) for _, start, end in one.certified]
    return ", ".join(spans) or ("taken back by a person" if one.decertified else "nowhere any more")
