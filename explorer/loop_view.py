"""The loop on one page: where it fails, which effect is missing, and the error falling when it is added."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import pandas as pd
import panel as pn

from inflight.diagnosis import BeforeAfter
from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane
from inflight.explorer.loop_state import (
    CandidateRow,
    LoopState,
    SignatureCard,
    candidate_rows,
    signature_card,
)
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.residual_rows import ResidualRows
from inflight.explorer.residual_view import ResidualView, fit_figure
from inflight.explorer.session import Contributions, Days, ExplorerSession
from inflight.explorer.time_view import TimeView
from inflight.explorer.view_state import ViewState
from inflight.figures import (
    change_tables,
    error_figure,
    html_table,
    paragraph,
)

Fields = Mapping[str, Any]
pn.extension("tabulator")

_THIRD = {"flex": "1 1 0", "min-width": "0"}
_TWO_THIRDS = {"flex": "2 1 0", "min-width": "0"}
_HEADING = {"margin": "0 10px"}
#: Heights of the figure, of the table, and of an effect's numbers at most, pixels.
_ERROR, _TABLE, _NUMBERS = 340, 520, 280
_TABLE_STYLE = """
.tabulator .tabulator-row .tabulator-cell, .tabulator .tabulator-header .tabulator-col {
  font-size: 13px; padding: 4px 6px; white-space: normal !important; height: auto !important }
.tabulator .tabulator-tableholder { overflow-x: hidden !important }
"""
_GREY, _CHIP = "#6b6b6b", "#8a5a00"


class LoopView:
    """Compare, find the missing effect, add it and see the error fall, on one page.

    Parameters
    ----------
    session : ExplorerSession
    state : ViewState
        Channel and candidate chosen are kept in it.
    changed : callable
        Called when the model or the products have another version.
    select : callable
        Called with the days that were selected in a figure; None for the default span.
    """

    title = "The loop"

    def __init__(
        self,
        session: ExplorerSession,
        state: ViewState,
        changed: Callable[[], None],
        select: Callable[[Days | None], None],
    ) -> None:
        self._session, self._state = session, state
        self._notify = changed
        self._overview: ComparisonOverview | None = None
        self._days: Days | None = None
        self._rows: list[CandidateRow] = []
        self._loop: LoopState | None = None
        self._sentence = pn.pane.HTML("", sizing_mode="stretch_width", margin=(4, 10))
        self._time = TimeView(session, state)
        self._residual = ResidualView(session, state, select, self._time.go_to, self._show_in_time)
        self._left = (_heading("Where it fails"), *self._residual.parts)
        self._make_middle()
        self._make_right()
        left, middle, right = (
            pn.Column(*parts, styles=_THIRD, sizing_mode="stretch_width")
            for parts in (self._left, self._middle, self._right)
        )
        # What goes on in time has the width of two columns.
        both = pn.Row(middle, right, sizing_mode="stretch_width")
        wide = pn.Column(both, self._time.panel, styles=_TWO_THIRDS, sizing_mode="stretch_width")
        self.panel = pn.Column(
            self._sentence, pn.Row(left, wide, sizing_mode="stretch_width"), sizing_mode="stretch_width"
        )

    def _show_in_time(self, rows: ResidualRows | None, are_products: bool) -> None:
        if rows is None or self._overview is None:
            self._time.clear()
        else:
            self._time.show(self._overview.comparison, rows, are_products)

    def _make_middle(self) -> None:
        self._diagnosis_pane = JobPane(self._session.background)
        self._diagnose = pn.widgets.Button(name="Diagnose this span", button_type="primary")
        self._diagnose.on_click(lambda event: self._begin_diagnosis())
        self._card = pn.Column(sizing_mode="stretch_width")
        self._card_shown: SignatureCard | None = None
        self._middle = (
            _heading("Which effect is missing"),
            self._diagnose,
            self._card,
            self._diagnosis_pane.panel,
        )

    def _make_right(self) -> None:
        self._model_pane, self._seen_pane = (JobPane(self._session.background) for _ in range(2))
        self._error, self._versions, self._numbers = (
            pn.Column(sizing_mode="stretch_width") for _ in range(3)
        )
        # What is told of a change, and its numbers.
        self._told_text, self._numbers_text = panes.text(), panes.text()
        # A field of many coefficients must not push away what goes on in time.
        self._numbers.objects = [self._numbers_text]
        self._numbers.styles = {"max-height": f"{_NUMBERS}px", "overflow-y": "auto"}
        self._other = pn.widgets.TextInput(
            name="Effect",
            placeholder="a channel, an effect, an entry, or = a formula of channels",
            sizing_mode="stretch_width",
        )
        self._own = pn.widgets.Select(name="Effect of the model", options=[], sizing_mode="stretch_width")
        self._try, self._add, self._undo, self._drop, self._reprocess = (
            pn.widgets.Button(name=name, button_type=kind, align="end")
            for name, kind in (
                ("Try", "default"),
                ("Add", "primary"),
                ("Undo", "default"),
                ("Drop", "default"),
                ("Reprocess", "default"),
            )
        )
        verbs = {"try": self._try, "add": self._add, "drop": self._drop, "undo": self._undo}
        for verb, button in verbs.items():
            button.on_click(lambda event, verb=verb: self._change(verb))
        self._reprocess.on_click(lambda event: self._begin_reprocessing())
        self._other.param.watch(lambda event: self._state.param.update(candidate=event.new.strip()), "value")
        self._right = (
            _heading("The error falls"),
            pn.Row(self._other, self._try, self._add, self._undo, sizing_mode="stretch_width"),
            self._error,
            self._model_pane.panel,
            self._seen_pane.panel,
            pn.Row(self._own, self._drop, self._reprocess, sizing_mode="stretch_width"),
            self._versions,
            self._numbers,
        )

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show a comparison and a span."""
        if self._overview is None or self._overview.comparison != overview.comparison:
            self._time.show_contributions(None)
        self._overview, self._days = overview, days
        self._other.value = self._state.candidate
        self._residual.show(overview, days)
        diagnosis = self._show_diagnosis()
        self._model_pane.put(panes.retell(self._told_text))
        panes.retell(self._numbers_text)
        self._show_model()
        if diagnosis is not None:
            self._model_pane.begin(
                "Reads the equations of the last diagnosis",
                lambda progress: self._session.open_contributions(overview.comparison, progress),
                self._opened,
            )

    def _opened(self, made: Contributions | None) -> pn.viewable.Viewable:
        self._time.show_contributions(made)
        return panes.retell(self._told_text)

    # Which effect.

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
        self._notify()
        self._show_model()
        return self._candidates(fields)

    def _show_diagnosis(self) -> Fields | None:
        assert self._overview is not None
        fields = self._session.last_diagnosis(self._overview.comparison)
        instead = self._session.instead_of_diagnosis(self._overview.comparison)
        self._diagnose.disabled = bool(instead)
        if fields is None:
            self._show_card(None)
            told = (
                f"Nothing is ranked here: {instead}"
                if instead
                else "Nothing is ranked yet: diagnose this span."
            )
            self._diagnosis_pane.put(panes.hint(told))
        else:
            self._diagnosis_pane.put(self._candidates(fields))
        return fields

    def _candidates(self, fields: Fields) -> pn.viewable.Viewable:
        assert self._overview is not None
        effects = self._session.versions(self._overview.comparison)[1]
        self._rows = candidate_rows(fields, effects)
        names = [row.name for row in self._rows if not row.reason]
        dead = {row.name for row in self._rows} - set(names)
        named = [one["name"] for one in fields["entries"] if one["name"] in names]
        if not self._other.value or self._other.value in dead:
            self._other.value = named[0] if named else ""
        self._show_card(signature_card(fields, effects))
        table = candidate_widget(self._rows)
        if self._other.value in names:
            table.selection = [names.index(self._other.value)]
        table.param.watch(lambda event: self._chosen(event.new), "selection")
        parts = [] if not fields.get("stale") else [panes.hint(_of_another_model(fields))]
        return pn.Column(*parts, table, sizing_mode="stretch_width")

    def _show_card(self, card: SignatureCard | None) -> None:
        """Show what is left without a name; what is shown already stays, buttons and all."""
        if card != self._card_shown:
            self._card.objects = [] if card is None else self._signature_parts(card)
            self._card_shown = card

    def _signature_parts(self, card: SignatureCard) -> list[pn.viewable.Viewable]:
        """Return what is known of what has no name, with what puts it into the model."""
        facts = [*card.facts, *(("resembles", one) for one in card.resembles)]
        text = panes.text(
            paragraph(f" {card.words}", bold="The library has no name for what is left:"),
            html_table(["signature", ""], facts, kind="wide told"),
        )
        if not card.effect:
            return [text]
        try_it = pn.widgets.Button(name="Try it")
        add_it = pn.widgets.Button(name="Add as an empirical term", button_type="primary")
        try_it.on_click(lambda event: self._change("try", card.effect))
        add_it.on_click(lambda event: self._change("add", card.effect, empirical=True))
        return [text, pn.Row(try_it, add_it)]

    def _chosen(self, selection: Sequence[int]) -> None:
        if selection and not self._rows[selection[0]].reason:
            self._other.value = self._rows[selection[0]].name
            self._residual.follow(self._other.value)

    # The error falls.

    def _change(self, verb: str, effect: str = "", *, empirical: bool = False) -> None:
        """Try, add, drop or undo; what is tried or added is what is written, unless it is named."""
        if self._overview is None:
            return
        written = {"undo": "", "drop": self._own.value or ""}.get(verb, self._other.value.strip())
        effect = effect or written
        if verb != "undo" and not effect:
            self._model_pane.put(panes.hint(f"Choose what to {verb} first."))
            return
        comparison, channel = self._overview.comparison, self._residual.channel
        if verb == "try":
            self._model_pane.begin(
                f"Try {effect}",
                lambda progress: self._session.preview(comparison, effect, progress),
                self._tried,
                lambda change: self._show_change(effect, change, channel, trial=True),
            )
        else:
            self._model_pane.begin(
                f"{verb} {effect}".strip(),
                lambda progress: self._session.change(
                    comparison, verb, effect, progress, empirical=empirical
                ),
                self._changed,
                lambda change: self._show_change(effect, change, channel),
            )

    def _tried(self, change: Fields) -> pn.viewable.Viewable:
        why = change["not_justified"]
        doubt = f" These data do not speak for it: {why}." if why else ""
        return self._told(paragraph(f" Add keeps it.{doubt}", bold="Tried; nothing is saved."), change)

    def _changed(self, change: Fields) -> pn.viewable.Viewable:
        self._show_model()
        return self._told(change_tables(change)[0], change)

    def _show_change(self, effect: str, change: Fields, channel: str, *, trial: bool = False) -> None:
        """Draw what a change does: the error, and on the left the residual against the effect's channel.

        Its numbers are there by now: what is drawn follows them. `channel` was drawn when it was asked for.
        """
        if trial:
            self._draw_error(change)
        else:
            self._notify()
            # The diagnosis shown is of the model before.
            self._show_diagnosis()

        def seen(found: tuple[BeforeAfter | None, Contributions | None]) -> pn.viewable.Viewable:
            floor = change["error"]["noise_floor_nT"]
            what = str(change["effect"])
            self._residual.show_change(found[0], effect, what, floor, earlier=channel)
            if not trial:
                self._time.show_contributions(found[1])
            return panes.text()

        self._seen_pane.begin(
            "Residual before and after",
            lambda progress: (self._session.before_after(), self._session.contributions()),
            seen,
        )

    def _told(self, sentence: str, change: Fields) -> pn.viewable.Viewable:
        """Return a sentence on a change; its numbers stand below the versions."""
        told = panes.retell(self._told_text, sentence)
        _, *tables = change_tables(change)
        panes.retell(self._numbers_text, *tables)
        return told

    def _begin_reprocessing(self) -> None:
        if self._overview is None:
            return
        comparison = self._overview.comparison
        self._model_pane.begin(
            "Reprocess",
            lambda progress: self._session.reprocess(comparison, progress),
            self._reprocessed,
        )

    def _reprocessed(self, report: Fields) -> pn.viewable.Viewable:
        self._notify()
        assert self._overview is not None
        self._residual.show(self._overview, self._days)
        self._show_model()
        days = report["days"]
        return panes.text(f"Reprocessed: {days['done']} days made anew, {days['unchanged']} unchanged.")

    def _show_model(self) -> None:
        """Show the state, the error with every version of the model, and the versions."""
        assert self._overview is not None
        comparison = self._overview.comparison
        versions, effects = self._session.versions(comparison)
        used = next((f"{one['name']} version {one['version']}" for one in versions if one["used"]), "")
        self._loop = LoopState(
            self._session.last_diagnosis(comparison),
            versions,
            used or self._overview.model,
            self._session.stale_products(comparison),
            self._overview.products,
            self._session.instead_of_diagnosis(comparison),
        )
        self._sentence.object = panes.sentence(*self._loop.sentences())
        self._own.param.update(options=effects, value=effects[-1] if effects else None)
        self._undo.disabled = len(versions) < 2
        self._drop.disabled = not effects
        self._reprocess.button_type = "warning" if self._loop.stale_products else "default"
        self._versions.objects = [panes.text(ledger(versions))]
        self._draw_error()

    def _draw_error(self, trial: Fields | None = None) -> None:
        """Draw how the error fell with every version, and with what is tried."""
        assert self._loop is not None
        drawn, floor = self._loop.changes, self._loop.sizes[1]
        if drawn or trial:
            plot = error_figure(drawn, trial, float(floor) if floor else float("nan"))
            self._error.objects = [panes.picture(fit_figure(plot, _ERROR))]
        else:
            text = "The model has not been changed yet: Try shows what the chosen effect would take off."
            self._error.objects = [panes.text(paragraph(text, kind="quiet"))]


def ledger(versions: Sequence[Fields]) -> str:
    """Return every version of the model, newest first, as a narrow table.

    Parameters
    ----------
    versions : sequence of mapping
        As `inflight.tasks.models.ModelHistory.items`.
    """
    rows = [
        (
            f"{one['version']}{' (in use)' if one['used'] else ''}",
            _after(one["change"]),
            one["message"],
        )
        for one in reversed(versions)
    ]
    if not rows:
        return paragraph("No version is saved yet: in use is the mission's own file.", kind="quiet")
    return html_table(["version", "left, nT", "what was done"], rows, kind="wide told")


def _after(change: Fields | None) -> str:
    both = (change or {}).get("held_out_nT")
    return f"{both[1]:.4g}" if both and both[1] is not None else ""


def candidate_widget(rows: Sequence[CandidateRow]) -> pn.widgets.Tabulator:
    """Return the ranked table; a row that can be tried can be selected."""
    frame = pd.DataFrame(
        {
            "effect": [_cell(row) for row in rows],
            "nT": ["" if row.size_nT is None else f"{row.size_nT:.2g}" for row in rows],
        }
    )
    return pn.widgets.Tabulator(
        frame,
        disabled=True,
        show_index=False,
        selectable=1,
        selectable_rows=lambda shown: [at for at, row in enumerate(rows) if not row.reason],
        formatters={"effect": {"type": "html"}},
        titles={"effect": "effect", "nT": "nT rms"},
        text_align={"nT": "right"},
        widths={"nT": 94},
        sortable=False,
        header_tooltips={"nT": "what it takes off days not used in the fit, alone"},
        layout="fit_columns",
        height=_TABLE,
        sizing_mode="stretch_width",
        stylesheets=[_TABLE_STYLE],
        margin=(5, 10),
    )


def _cell(row: CandidateRow) -> str:
    """Return what the table shows of a candidate as HTML."""
    words = escape(row.words)
    if row.reason:
        return f"<span style='color:{_GREY}'>{words}<br><small>{escape(row.reason)}</small></span>"
    chip = f"border:1px solid {_CHIP};color:{_CHIP};border-radius:8px;padding:0 5px"
    chips = "".join(f" <small style='{chip}'>or {escape(rival)}</small>" for rival in row.rivals)
    return f"<span title='{escape(row.name)}'>{words}</span><br><small>{escape(row.sure)}</small>{chips}"


def _of_another_model(fields: Fields) -> str:
    return (
        f"This ranking is of model version {fields['model']['version']}; in use is {fields['stale']}, which "
        "may have what is named here already."
    )


def _heading(text: str) -> pn.viewable.Viewable:
    return panes.text(paragraph("", bold=text))
