"""Verbs of ``catalog`` about what is valid when: ``certify``, ``history``, ``context`` and the rest."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.catalog import SHOWN_DAYS
from inflight.cli.catalog import group as catalog_group
from inflight.cli.command import Command, text_table, verb

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Catalog, NamedContext, TableRecord, Validity
    from inflight.tasks.pipelines import AffectedDay, ComparisonState

group = typer.Typer(
    help="Name what products are calibrated with: mission file, model, and which table is valid when.",
    no_args_is_help=True,
)
TableArgument = Annotated[
    str, typer.Argument(metavar="NAME[:NUMBER]", help="Table, such as main-window:12 (or the newest).")
]
FromOption = Annotated[
    str | None,
    typer.Option("--start", help="First instant, UTC date or time (default: its own)", show_default=False),
]
ToOption = Annotated[
    str | None,
    typer.Option(
        "--end", help="First instant behind it, UTC date or time (default: its own)", show_default=False
    ),
]
ByOption = Annotated[str, typer.Option("--by", help="Who answers for it.")]
ReasonOption = Annotated[str, typer.Option("--reason", help="Why; kept with the act.")]


@verb(catalog_group, "certify")
def certify(
    command: Command,
    name: TableArgument,
    *,
    start: FromOption = None,
    end: ToOption = None,
    by: ByOption,
    reason: ReasonOption,
    supersede: Annotated[
        bool, typer.Option("--supersede", help="End what other tables of the name have there.")
    ] = False,
) -> None:
    """State that a calibration table is valid in a span, in a person's name and for a reason."""
    catalog, record = _table(command, name)
    first, last = _bounds(start, end)
    first, last = record.start if first is None else first, record.end if last is None else last
    _require_said(by, reason)
    catalog.certify(record.id, first, last, supersede=supersede, author=by, reason=reason)
    _tell_validity(command, "certify", catalog, record)


@verb(catalog_group, "decertify")
def decertify(
    command: Command,
    name: TableArgument,
    *,
    start: FromOption = None,
    end: ToOption = None,
    by: ByOption,
    reason: ReasonOption,
) -> None:
    """State that a calibration table is not valid in a span any more; one cut in the middle is split."""
    catalog, record = _table(command, name)
    _require_said(by, reason)
    catalog.decertify(record.id, *_bounds(start, end), author=by, reason=reason)
    _tell_validity(command, "decertify", catalog, record)


def _table(command: Command, name: str) -> tuple[Catalog, TableRecord]:
    from inflight.tasks import find_table

    catalog = command.open_catalog()
    return catalog, find_table(catalog, name.removeprefix("tables/"))


def _bounds(start: str | None, end: str | None) -> tuple[int | None, int | None]:
    from inflight.time import parse_utc, to_tt2000

    first, last = (None if text is None else int(to_tt2000(parse_utc(text))) for text in (start, end))
    return first, last


def _require_said(by: str, reason: str) -> None:
    from inflight.errors import SettingsError

    if not by.strip() or not reason.strip():
        raise SettingsError(
            "a change of validity needs a person and a reason", remedy="say both: --by NAME --reason WHY"
        )


def _tell_validity(command: Command, act: str, catalog: Catalog, record: TableRecord) -> None:
    (after,) = [one for one in catalog.tables(record.name) if one.id == record.id]
    valid = [_span_fields((record.id, first, last)) for _, first, last in after.certified]

    def show(console: Console) -> None:
        spans = ", ".join(f"{one['start']} to {one['end']}" for one in valid) or "nowhere"
        console.print(f"table {record.name}:{record.id} is valid {spans}", soft_wrap=True, markup=False)
        console.print("what was made with it stays as it is; 'inflight catalog history' lists what was done")

    items = [{"table": f"{record.name}:{record.id}", "valid": valid}]
    command.emit({"command": f"catalog {act}", "items": items}, show)


def _span_fields(validity: Validity) -> dict[str, Any]:
    from inflight.time import utc_text

    number, start, end = validity
    return {"table": number, "start": utc_text(start), "end": utc_text(end)}


@verb(catalog_group, "history")
def history(
    command: Command,
    name: Annotated[str | None, typer.Argument(help="Only tables of this name, such as main-window.")] = None,
) -> None:
    """List what was done to the validity of calibration tables: when, by whom and why."""
    from inflight.catalog import after_act
    from inflight.time import utc_text

    valid: dict[tuple[str, str | None], list[Validity]] = {}
    items: list[dict[str, Any]] = []
    for act in command.open_catalog().certification_acts(name and name.removeprefix("tables/")):
        before = valid.get((act.name, act.context), [])
        after = valid[act.name, act.context] = after_act(before, act)
        items.append(
            {
                "created": act.created[:19],
                "act": act.act,
                "table": f"{act.name}:{act.table}",
                "start": utc_text(act.start),
                "end": utc_text(act.end),
                "context": act.context,
                "by": act.author,
                "run": act.run,
                "reason": act.reason,
                "became": _what_became(act.name, before, after),
            }
        )

    def show(console: Console) -> None:
        if not items:
            console.print("no table was certified")
            return
        rows = [
            [
                *(one["created"][:16], one["act"], one["table"], one["start"][:16], one["end"][:16]),
                # A run's id holds what it did.
                one["by"] or str(one["run"]).split("-")[1],
                *(one["reason"], ", ".join(one["became"])),
            ]
            for one in items[-SHOWN_DAYS:]
        ]
        columns = ("when", "act", "table", "from", "to", "by", "reason", "and so")
        console.print(text_table(columns, rows))
        if len(items) > SHOWN_DAYS:
            console.print(f"the last {SHOWN_DAYS} of {len(items)}; --json lists all")

    command.emit({"command": "catalog history", "items": items}, show)


def _what_became(name: str, before: Sequence[Validity], after: Sequence[Validity]) -> list[str]:
    """Tell which validities were there before an act and are not after it: shortened, split or ended."""
    told = []
    for number, start, end in before:
        parts = [one for one in after if one[0] == number and start <= one[1] and one[2] <= end]
        if (number, start, end) not in after:
            told.append(f"{name}:{number} {('ended', 'shortened', 'split')[min(len(parts), 2)]}")
    return told


# --- contexts ----------------------------------------------------------------------------------------------


@verb(group, "list")
def list_contexts(command: Command) -> None:
    """List named contexts."""
    catalog = command.open_catalog()
    items = [
        _context_fields(catalog, list(named))
        for _, named in groupby(catalog.named_contexts(), key=lambda one: one.name)
    ]

    def show(console: Console) -> None:
        if not items:
            console.print("no context has a name; next: inflight catalog context make NAME --by WHO")
            return
        columns = ("name", "comparisons", "as of", "by", "reason", "releases")
        rows = [
            [
                one["name"],
                ", ".join(one["comparisons"]),
                one["as_of"],
                one["by"],
                one["reason"],
                ", ".join(one["releases"]),
            ]
            for one in items
        ]
        console.print(text_table(columns, rows))

    command.emit({"command": "catalog context list", "items": items}, show)


def _context_fields(catalog: Catalog, named: Sequence[NamedContext]) -> dict[str, Any]:
    first = named[0]
    return {
        "name": first.name,
        "comparisons": {one.comparison: one.context for one in named},
        "as_of": first.as_of[:19],
        "created": first.created[:19],
        "by": first.author,
        "reason": first.reason,
        "releases": catalog.releases_of_context(first.name),
    }


@verb(group, "show")
def show_context(
    command: Command,
    name: Annotated[str, typer.Argument(help="Of the context; 'now' is what is in use.")],
) -> None:
    """Show what a context pins: of each comparison the model, and which table is valid when."""
    from inflight.tasks.pipelines import states_of

    catalog = command.open_catalog()
    states = states_of(catalog, name)
    named = _context_fields(catalog, catalog.named_contexts(name)) if name != "now" else {"name": name}
    fields = {**named, "comparisons": {key: _state_fields(state) for key, state in states.items()}}

    def show(console: Console) -> None:
        if by := named.get("by"):
            why = f": {named['reason']}" if named["reason"] else ""
            console.print(f"{name}, as of {named['as_of']}, by {by}{why}", soft_wrap=True, markup=False)
        _print_states(console, states)
        if releases := named.get("releases"):
            console.print(f"released: {', '.join(releases)}", markup=False)

    command.emit({"command": "catalog context show", "items": [fields]}, show)


def _state_fields(state: ComparisonState) -> dict[str, Any]:
    pinned = state.pinned
    return {
        "context": pinned.id or None,
        "model": {"name": pinned.model_name, "version": pinned.model_version},
        "product_table": state.table,
        "run": state.run.id,
        "tables": {table: [_span_fields(one) for one in spans] for table, spans in pinned.tables.items()},
        "left_out": {table: list(numbers) for table, numbers in state.left_out.items()},
    }


def _print_states(console: Console, states: Mapping[str, ComparisonState]) -> None:
    from inflight.tasks import model_label

    for comparison, state in states.items():
        label = model_label(state.pinned.model_name, state.pinned.model_version)
        console.print(
            f"{comparison}: model {label}; products take {state.table}", soft_wrap=True, markup=False
        )
        rows = [
            [f"{table}:{number}", *list(_span_fields((number, start, end)).values())[1:]]
            for table, spans in state.pinned.tables.items()
            for number, start, end in spans
        ]
        console.print(text_table(("table", "valid from", "to"), rows))
        for table, numbers in state.left_out.items():
            listed = ", ".join(f"{table}:{number}" for number in numbers)
            text = f"  left out, made with another version of the model: {listed}"
            console.print(text, soft_wrap=True, markup=False)


@verb(group, "make")
def make(
    command: Command,
    name: Annotated[str, typer.Argument(help="Of the new context, such as flight-2005.")],
    *,
    as_of: Annotated[
        str | None,
        typer.Option(
            metavar="DATE",
            help="Take what was valid and in use then, UTC date (that day included) or time (default: now)",
            show_default=False,
        ),
    ] = None,
    by: ByOption,
    reason: ReasonOption = "",
) -> None:
    """Give what products are calibrated with a name: mission file, model, and which table is valid when."""
    from inflight.tasks.pipelines import make_context

    catalog = command.open_catalog()
    states = make_context(catalog, name, as_of=as_of, author=by, reason=reason)
    fields = {
        **_context_fields(catalog, catalog.named_contexts(name)),
        "comparisons": {key: _state_fields(state) for key, state in states.items()},
    }

    def show(console: Console) -> None:
        _print_states(console, states)
        console.print(f"next: inflight catalog affected --to {name}, inflight reprocess --context {name}")

    command.emit({"command": "catalog context make", "items": [fields]}, show)


@verb(group, "remove")
def remove(command: Command, name: Annotated[str, typer.Argument(help="Of the context.")]) -> None:
    """Forget the name of a context that no release was made in; its products stay."""
    command.open_catalog().remove_context(name)
    command.emit(
        {"command": "catalog context remove", "items": [{"name": name}]},
        lambda console: console.print(f"context {name} is forgotten", markup=False),
    )


@verb(catalog_group, "affected")
def affected(
    command: Command,
    *,
    before: Annotated[
        str, typer.Option("--from", metavar="CONTEXT", help="A named context, or now: what is in use.")
    ] = "now",
    after: Annotated[str, typer.Option("--to", metavar="CONTEXT", help="The same.")] = "now",
) -> None:
    """Tell which products a change of context touches, and why; nothing is calibrated."""
    from inflight.errors import SettingsError
    from inflight.tasks.pipelines import affected_days

    if before == after:
        raise SettingsError(
            f"--from and --to are both {before}", remedy="name two: 'inflight catalog context list'"
        )
    found = affected_days(command.open_catalog(), before, after)
    items = [
        {"dataset": one.dataset, "day": str(one.day), "version": one.version, "reasons": list(one.reasons)}
        for one in found
    ]
    counts = Counter(reason for one in found for reason in one.reasons)
    fields = {"from": before, "to": after, "days": len(found), "reasons": dict(counts), "items": items}

    def show(console: Console) -> None:
        if not found:
            console.print(f"no product has other values with {after} than with {before}", markup=False)
            return
        console.print(text_table(("dataset", "first", "last", "days", "why"), _spans(found)[:SHOWN_DAYS]))
        spans = len(_spans(found))
        more = (
            f"; the first {SHOWN_DAYS} of {spans} spans, --json lists every day" if spans > SHOWN_DAYS else ""
        )
        console.print(f"days: {len(found)}{more}")
        if after != "now":
            console.print(f"next: inflight reprocess --context {after}", markup=False)

    command.emit({"command": "catalog affected", **fields}, show)


def _spans(found: Sequence[AffectedDay]) -> list[list[str]]:
    """Return days that follow one another for the same reasons as one row."""
    rows: list[list[str]] = []
    for one in found:
        day, why = str(one.day), "; ".join(one.reasons)
        if rows and rows[-1][0] == one.dataset and rows[-1][4] == why:
            follows = dt.date.fromisoformat(rows[-1][2]) + dt.timedelta(days=1)
            if str(follows) == day:
                rows[-1][2], rows[-1][3] = day, str(int(rows[-1][3]) + 1)
                continue
        rows.append([one.dataset, day, day, "1", why])
    return rows
