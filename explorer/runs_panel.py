"""What makes products: a form that plans the work, and every run with its progress and its log."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import pandas as pd
import panel as pn

from inflight.explorer import panes
from inflight.explorer.background import BackgroundJob, duration_text
from inflight.explorer.job_pane import JobPane
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.work import InOwnProcess, WorkPlan, WorkRequest
from inflight.figures import html_table, paragraph
from inflight.flows import ScheduledFlow
from inflight.tasks import RunProgress

#: Runs listed, and how often they are read, ms.
_LISTED, _REFRESH_MS = 50, 1500
#: How far a backfill stands behind other work, as the form calls it.
_PRIORITIES = {"after live days": 10, "last of all": 19, "at once": 0}
_TABLE_STYLE = """
.tabulator .tabulator-row .tabulator-cell, .tabulator .tabulator-header .tabulator-col {
  font-size: 13px; padding: 3px 5px; white-space: normal !important; height: auto !important }
.tabulator .tabulator-col:not([tabulator-field]) { display: none !important }
.tabulator .tabulator-tableholder { overflow-x: hidden !important }
"""
_LOG_STYLE = "white-space:pre-wrap;overflow-wrap:anywhere;font:12px/1.45 ui-monospace,monospace;margin:0"
_COLUMNS = {"began": 92, "what": None, "state": 68, "days": None, "took": 84}


class RunsPanel:
    """The form, the plan, and the runs with their logs.

    Parameters
    ----------
    session : ExplorerSession
    finished : callable
        Called when what was begun here has ended.
    """

    def __init__(self, session: ExplorerSession, finished: Callable[[], None]) -> None:
        self._session, self._notify = session, finished
        self._comparison = "main"
        self._plan: WorkPlan | None = None
        #: What this page shows the progress of.
        self._work: InOwnProcess | None = None
        self._runs: list[RunProgress] = []
        self._selected = ""
        self._seen: dict[str, tuple[dt.datetime, int]] = {}
        self._refresher: Any = None
        self._schedule_pane = JobPane(session.figure_background)
        self._make_form()
        self._make_runs()
        self.panel = pn.Column(
            panes.text(paragraph("", bold="What makes it")),
            pn.Row(self._verb, self._first, self._last, sizing_mode="stretch_width"),
            pn.Row(self._version, self._maturity, self._formats, sizing_mode="stretch_width"),
            pn.Row(self._reason, self._priority, sizing_mode="stretch_width"),
            pn.Row(self._ask, self._start, self._stop),
            self._plan_pane.panel,
            self._work_pane.panel,
            panes.text(paragraph(" Times are UTC.", bold="Runs")),
            self._table,
            self._log,
            self._schedule_pane.panel,
            styles={"flex": "1 1 0", "min-width": "0"},
            sizing_mode="stretch_width",
        )

    def _make_form(self) -> None:
        self._verb = pn.widgets.Select(name="What", options=["Reprocess", "Backfill", "Release"], width=130)
        self._first = pn.widgets.DatePicker(name="From", width=130)
        self._last = pn.widgets.DatePicker(name="to, included", width=130)
        self._version = pn.widgets.TextInput(name="Version", placeholder="1.0", width=130)
        self._maturity = pn.widgets.Select(
            name="Maturity",
            options=["quick-look", "preliminary", "definitive"],
            value="preliminary",
            width=130,
        )
        self._formats = pn.widgets.CheckBoxGroup(
            name="Formats", options=["zarr", "cdf", "netcdf"], value=["zarr"], inline=True, align="end"
        )
        self._reason = pn.widgets.TextInput(
            name="Reason", placeholder="kept with the run", sizing_mode="stretch_width"
        )
        self._priority = pn.widgets.Select(name="Priority", options=list(_PRIORITIES), width=150)
        self._ask = pn.widgets.Button(name="Plan", button_type="primary")
        self._start = pn.widgets.Button(name="Start", button_type="primary", disabled=True)
        self._stop = pn.widgets.Button(name="Stop", disabled=True)
        self._plan_pane = JobPane(self._session.figure_background)
        self._work_pane = JobPane(self._session.background)
        self._ask.on_click(lambda event: self._begin_plan())
        self._start.on_click(lambda event: self._begin_work())
        self._stop.on_click(lambda event: self._work.stop() if self._work else None)
        # A plan is of what was asked for then.
        for widget in (
            self._verb,
            self._first,
            self._last,
            self._version,
            self._maturity,
            self._formats,
            self._reason,
            self._priority,
        ):
            widget.param.watch(lambda event: self._forget_plan(), "value")
        self._arrange()

    def _make_runs(self) -> None:
        self._table = pn.widgets.Tabulator(
            pd.DataFrame(columns=list(_COLUMNS), dtype=str),
            disabled=True,
            show_index=False,
            selectable=1,
            sortable=False,
            formatters={name: {"type": "html"} for name in _COLUMNS},
            widths={name: width for name, width in _COLUMNS.items() if width},
            layout="fit_columns",
            height=300,
            sizing_mode="stretch_width",
            stylesheets=[_TABLE_STYLE],
            margin=(5, 10),
        )
        self._table.param.watch(lambda event: self._select(event.new), "selection")
        self._log = pn.pane.HTML("", sizing_mode="stretch_width", margin=(5, 10))

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show a comparison; the form takes up its span, unless days were chosen in it."""
        self._comparison = overview.comparison
        for picker, end in ((self._first, "first"), (self._last, "last")):
            if picker.value is None and days is not None:
                picker.value = dt.date.fromisoformat(str(getattr(days, end)))
        if self._session.begun and not self._work_pane.is_busy:
            work, job = self._session.begun[-1]
            if not job.is_finished:
                self._follow(work, job)
        self._refresh()
        self._schedule_pane.begin("Schedule", self._session.schedule, schedule_pane)
        pn.state.onload(self._begin_to_refresh)

    # The plan.

    def _arrange(self) -> None:
        """Show the options that what is chosen takes."""
        released = self._verb.value == "Release"
        for widget in (self._first, self._last):
            widget.visible = not released
        for widget in (self._version, self._maturity, self._formats):
            widget.visible = released
        self._priority.visible = self._verb.value == "Backfill"
        self._reason.name = "Notes" if released else "Reason"

    def _forget_plan(self) -> None:
        self._plan, self._start.disabled = None, True
        self._plan_pane.put()
        self._arrange()

    def _request(self) -> WorkRequest:
        verb, reason = self._verb.value.lower(), self._reason.value.strip()
        if verb == "release":
            return WorkRequest(
                "release",
                reason=reason,
                version=self._version.value.strip(),
                formats=tuple(self._formats.value),
                maturity=self._maturity.value,
            )
        first, last = self._first.value, self._last.value
        return WorkRequest(
            verb,
            str(first) if first else None,
            str(last + dt.timedelta(days=1)) if last else None,
            self._session.reprocess_settings(self._comparison),
            reason,
            _PRIORITIES[self._priority.value] if verb == "backfill" else 0,
        )

    def _begin_plan(self) -> None:
        request = self._request()
        self._start.disabled = True
        self._plan_pane.begin("Plan", lambda progress: self._session.plan(request, progress), self._planned)

    def _planned(self, plan: WorkPlan) -> pn.viewable.Viewable:
        self._plan = plan
        self._start.disabled = bool(plan.objections)
        objections = [
            panes.error({"message": one["message"], "remedy": one.get("remedy", "")})
            for one in plan.objections
        ]
        return pn.Column(log_pane(plan.lines), *objections, sizing_mode="stretch_width")

    # The work.

    def _begin_work(self) -> None:
        if self._plan is None:
            return
        request = self._plan.request
        self._forget_plan()
        self._follow(*self._session.begin_work(request))

    def _follow(self, work: InOwnProcess, job: BackgroundJob) -> None:
        self._work, self._stop.disabled = work, False
        self._work_pane.follow(job, lambda report: self._finished(work.request, report))

    def _finished(self, request: WorkRequest, report: Mapping[str, Any]) -> pn.viewable.Viewable:
        self._work, self._stop.disabled = None, True
        self._selected = report["run"] or self._selected
        self._refresh()
        self._notify()
        return panes.text(*outcome_lines(request, report))

    # The runs.

    def _begin_to_refresh(self) -> None:
        if self._refresher is None:
            self._refresher = pn.state.add_periodic_callback(self._refresh, period=_REFRESH_MS)

    def _refresh(self) -> None:
        """Show the runs as the catalog has them now; only what changed is sent to the browser."""
        self._stop.disabled = not self._work_pane.is_busy
        self._runs = self._session.runs(_LISTED)
        frame = pd.DataFrame([self._row(one) for one in self._runs], columns=list(_COLUMNS))
        if not frame.equals(self._table.value):
            self._table.value = frame
            ids = [one.record.id for one in self._runs]
            chosen = [ids.index(self._selected)] if self._selected in ids else []
            if self._table.selection != chosen:
                self._table.selection = chosen
        self._show_log()

    def _row(self, one: RunProgress) -> dict[str, str]:
        record = one.record
        what = escape(record.kind)
        if one.reason:
            what += f"<br><small>{escape(one.reason)}</small>"
        failed = f"<br><small>{one.failed} failed</small>" if one.failed else ""
        return {
            "began": record.started[:16].replace("T", " "),
            "what": what,
            "state": escape(record.state),
            "days": f"{escape(one.days_text())}{failed}",
            "took": f"{duration_text(one.seconds)}{self._remaining(one)}",
        }

    def _remaining(self, one: RunProgress) -> str:
        """Return rate and remaining time of the stage a run is in, since this page saw the stage begin."""
        if one.record.state != "running" or not one.planned or not one.done:
            return ""
        stage, done = list(one.done.items())[-1]
        key, now = f"{one.record.id} {stage}", dt.datetime.now(dt.UTC)
        begun, first = self._seen.setdefault(key, (now, done))
        rate = (done - first) / max((now - begun).total_seconds(), 1e-3)
        if rate <= 0 or done >= one.planned:
            return ""
        return f"<br><small>{rate:.2g}/s, {duration_text((one.planned - done) / rate)} left</small>"

    def _select(self, selection: Sequence[int]) -> None:
        if selection and selection[0] < len(self._runs):
            self._selected = self._runs[selection[0]].record.id
            self._show_log()

    def _show_log(self) -> None:
        lines = self._session.run_log(self._selected) if self._selected else []
        text = log_html(lines) if lines else "<small>Choose a run to see its log.</small>"
        if text != self._log.object:
            self._log.object = text


def outcome_lines(request: WorkRequest, report: Mapping[str, Any]) -> list[str]:
    """Return what work that is finished has made, as paragraphs."""
    days, verb = report["days"], request.verb
    if verb == "release":
        where = ", ".join(report["outputs"])
        return [paragraph(f" {days['done']} days, in {where}.", bold=f"{request.name} is made.")]
    told = f" {days['done']} days made, {days['unchanged']} unchanged, {days['failed']} failed."
    lines: list[str] = [paragraph(told, bold=f"{request.name} is finished.")]
    if report["run"]:
        lines.append(paragraph(f"Its log is below: {report['run']}.", kind="quiet"))
    problems = [one for one in report["problems"] if one["message"]]
    for one in problems[:5]:
        place = f"{one['day']}: " if one["day"] else ""
        todo = f" What to do: {one['remedy']}" if one["remedy"] else ""
        lines.append(paragraph(f"{place}{one['message']}.{todo}"))
    if len(problems) > 5:
        lines.append(paragraph(f"... and {len(problems) - 5} more, in the log.", kind="quiet"))
    return lines


def schedule_pane(found: Sequence[ScheduledFlow]) -> pn.viewable.Viewable:
    """Return what a Prefect server runs by itself, as a table; nothing where it runs nothing."""
    if not found:
        return panes.text()
    rows = [
        (
            one.name,
            "switched off" if one.paused else one.schedule or "on request",
            "" if one.paused else _minute(one.next_run),
            " ".join(filter(None, (one.last_state, _minute(one.last_run)))) or "none yet",
        )
        for one in found
    ]
    heads = ["flow", "when", "next", "last run"]
    return panes.text(
        paragraph(" What the Prefect server runs of this workspace by itself.", bold="Schedule"),
        html_table(heads, rows, kind="wide told"),
    )


def _minute(time: str) -> str:
    return time[:16].replace("T", " ")


def log_html(lines: Sequence[str]) -> str:
    """Return lines as they are, folded where the window ends."""
    return f'<pre style="{_LOG_STYLE}">{escape(chr(10).join(lines))}</pre>'


def log_pane(lines: Sequence[str]) -> pn.viewable.Viewable:
    """Return a pane of `log_html`."""
    return pn.pane.HTML(log_html(lines), sizing_mode="stretch_width", margin=(5, 10))
