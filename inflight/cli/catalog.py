"""Verbs of ``catalog``: ``list``, ``show``, ``gaps``, ``runs``, ``log``, ``diff``, ``verify``, ``gc`` ..."""

from __future__ import annotations

import dataclasses
import datetime as dt
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.command import Command, TextTable, text_table, verb
from inflight.cli.diagnosis_text import with_error
from inflight.cli.processing import EndOption, StartOption

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

    from inflight.calibration import TableChanges
    from inflight.catalog import Catalog, Day, DayChange, RunRecord

group = typer.Typer(help="Look into the catalog, and repair it.", no_args_is_help=True)
#: Datasets that hold neither measurements nor products: equations, and what is kept of comparisons.
_OWN = ("comparison/", "equations/")
#: Attributes of a table that are no result.
_HASHES = ("comparison", "kind", "model", "made_from", "fitted_model")
#: What numbers of a calibration table are called, where their names do not say it.
_CALLED = {
    "learnt_start": "learnt from",
    "learnt_end": "up to",
    "blocks": "days with data",
    "count": "samples",
    "before": "residual with the prior values, nT rms",
    "after": "residual with these values, nT rms",
    "directions": "combinations that the data determine",
    "inflation": "squares of errors are larger than those of white noise by a factor of",
    "source": "told by",
}
SvgOption = Annotated[
    Path | None, typer.Option("--svg", help="Draw it into this file.", metavar="FILE", show_default=False)
]
#: Days shown to a person; --json lists all.
SHOWN_DAYS = 40


@verb(group, "list")
def list_datasets(command: Command) -> None:
    """List datasets, tables and models: what there is, for which days, in which version."""
    catalog = command.open_catalog()
    items = catalog.inventory()
    tables = [_table_fields(record) for record in catalog.tables()]

    def show(console: Console) -> None:
        if not items:
            console.print("The catalog is empty. Next: inflight ingest")
            return
        columns = ("dataset", "first", "last", "days", "failed", "no_work", "coverage")
        console.print(_table(columns, [item for item in items if not _is_own(item["dataset"])]))
        if own := [item["dataset"] for item in items if _is_own(item["dataset"])]:
            console.print(
                f"kept to be quick next time: {', '.join(own)} (--json tells of them, too)", soft_wrap=True
            )
        if tables:
            console.print(
                f"calibration tables: {len(tables)} ({', '.join(sorted({t['name'] for t in tables}))})"
            )
        if not tables:
            console.print("next: inflight reprocess")
        else:
            console.print("next: inflight compare    (one dataset day by day: inflight catalog show DATASET)")

    command.emit({"command": "catalog list", "items": items, "tables": tables}, show)


@verb(group, "show")
def show_dataset(
    command: Command,
    name: Annotated[str, typer.Argument(help="Dataset (l2/field), table or lineage id (day:12).")],
    *,
    start: StartOption = None,
    end: EndOption = None,
) -> None:
    """Show the days of a dataset, the validity of a table, or what something was made from."""
    catalog = command.open_catalog()
    columns, items = _items_of(catalog, name, slice(start, end))
    if name.startswith("l2/"):
        # What no release holds yet is quick-look.
        known = catalog.maturities(name)
        items = [item | {"maturity": known.get(item["id"], "quick-look")} for item in items]
        columns = (*columns[:3], "maturity", *columns[3:])
    certified = [item["id"] for item in items if item.get("certified")]
    values = catalog.table_by_id(certified[-1]) if certified and not command.json else None

    def show(console: Console) -> None:
        # A day without a message shows what its report states.
        shown = [
            item
            if item.get("message") or "report" not in item
            else item | {"message": _summary_of_report(item["report"])}
            for item in items[:SHOWN_DAYS]
        ]
        console.print(_table(columns, shown))
        if len(items) > SHOWN_DAYS:
            console.print(f"... and {len(items) - SHOWN_DAYS} more; --json lists all")
        if values is not None:
            _print_values(console, values)
            console.print(f"\nwho certified it when, and why: inflight catalog history {name}", markup=False)

    command.emit({"command": "catalog show", "name": name, "items": items}, show)


def _print_values(console: Console, table: xr.Dataset) -> None:
    """Print the newest interval of a calibration table: single numbers, then what goes by parameter or state.

    Vectors by axis share a cell; matrices, such as the covariance, are left to Python.
    """
    last = table.isel(interval=-1) if "interval" in table.dims else table
    count = table.sizes.get("interval", 1)
    which = f" (the last of {count} intervals)" if count > 1 else ""
    edges = [last[edge] for edge in ("start", "end") if edge in last and not last[edge].dims]
    span = f" from {' to '.join(_utc(int(edge)) for edge in edges)}" if edges else ""
    console.print(f"\nvalues{span}{which}")
    for name, text in last.attrs.items():
        if isinstance(text, str) and text and text[0] not in "{[" and name not in _HASHES:
            console.print(f"  {_in_words(name)}: {text}", soft_wrap=True, markup=False)
    names = [str(name) for name in (*last.coords, *last.data_vars)]
    names = [name for name in names if name not in last.dims or last[name].ndim > 1]
    names = [name for name in names if name not in ("start", "end") and not _is_error(last, name)]
    # How much parameters change with time is for the uncertainty of samples that taught no table.
    names = [name for name in names if "lag" not in last[name].dims]
    order = list(_CALLED)
    names.sort(key=lambda name: order.index(name) if name in order else -1)
    for name in (one for one in names if not last[one].dims):
        if text := _value_text(last, name, ()):
            unit = last[name].attrs.get("units", "")
            unit = "" if unit in ("", "1") else f" {unit}"
            console.print(
                f"  {_CALLED.get(name, _in_words(name))}: {text}{unit}", soft_wrap=True, markup=False
            )
    shapes = {name: last[name].dims for name in names if last[name].dims}
    rows_of = {name: dims[0] for name, dims in shapes.items() if dims[1:] in ((), ("axis",))}
    for dim in dict.fromkeys(rows_of.values()):
        _print_rows(console, last, str(dim), [name for name, own in rows_of.items() if own == dim])
    if rest := [name for name in shapes if name not in rows_of]:
        text = f"in Python, by Catalog.table(name, at), too: {', '.join(rest)}"
        console.print(text, soft_wrap=True, markup=False)


def _print_rows(console: Console, table: xr.Dataset, dim: str, names: Sequence[str]) -> None:
    """Print what a table holds by one dimension: a row each parameter, state or method."""
    # The value and its unit first, sentences last.
    names = sorted(names, key=lambda name: {"value": 0, "units": 1, "reason": 3}.get(name, 2))
    labelled = dim in table.coords and table[dim].ndim == 1
    keys = (
        [str(key) for key in table[dim].values] if labelled else [str(at) for at in range(table.sizes[dim])]
    )
    if dim == "parameter":
        keys = [key.rpartition(".")[2] for key in keys]
    rows = []
    for at, key in enumerate(keys):
        cells = []
        for name in names:
            deep = table[name].dims[1:]
            places = [(at, axis) for axis in range(table.sizes["axis"])] if deep else [(at,)]
            cells.append(" ".join(_value_text(table, name, place) for place in places))
        rows.append([key, *cells])
    heads = [_in_words(dim)]
    for name in names:
        unit = table[name].attrs.get("units", "")
        heads.append(_CALLED.get(name, _in_words(name)) + (f", {unit}" if unit not in ("", "1") else ""))
    folded = [head for head, name in zip(heads[1:], names, strict=True) if table[name].dtype.kind == "U"]
    console.print(text_table(heads, rows, folded=folded))


def _in_words(name: str) -> str:
    """Return the name of a variable without its underscores."""
    return name.replace("_", " ")


def _error_of(name: str) -> str:
    """Return what the error of a variable is called in a table."""
    return "sigma" if name == "value" else f"{name.removesuffix('_value')}_sigma"


def _is_error(table: xr.Dataset, name: str) -> bool:
    return name in {_error_of(str(one)) for one in table.data_vars}


def _value_text(table: xr.Dataset, name: str, at: tuple[int, ...]) -> str:
    """Return one value of a table as a person reads it, with the digits that its error leaves."""
    import numpy as np

    value, error, facts = table[name].values[at], _error_of(name), table[name].attrs
    if facts.get("scale") == "TT2000":
        return _utc(int(value))
    if "flag_meanings" in facts and "flag_masks" not in facts:
        return str(facts["flag_meanings"].split()[int(value)])
    if isinstance(value, np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, np.floating) or not np.isfinite(value):
        return "" if isinstance(value, np.floating) else str(value)
    if error in table and table[error].dims == table[name].dims and np.isfinite(table[error].values[at]):
        return " ± ".join(with_error(float(value), float(table[error].values[at])))
    return f"{value:.0f}" if value == round(value) and abs(value) < 1e15 else f"{value:.4g}"


def _is_own(dataset: str) -> bool:
    """Return True for what the software keeps to be quick: no measurement, no product."""
    return dataset.startswith(_OWN)


def _items_of(catalog: Catalog, name: str, span: slice) -> tuple[tuple[str, ...], list[dict[str, Any]]]:
    from inflight.errors import CatalogError

    if ":" in name:
        names = {f"context:{one.context}": one.name for one in catalog.named_contexts()}
        ids = [key for key, known in names.items() if known == name.removeprefix("context:")]
        found = dict.fromkeys(edge for one in ids or [name] for edge in catalog.lineage(one))
        edges = [_plain_fields(edge) | {"named": names.get(edge.parent, "")} for edge in found]
        # A file, a model and a context are where lineage begins; days and tables are made from something.
        if not edges and name.partition(":")[0] not in ("file", "model", "context"):
            raise CatalogError(
                f"the catalog does not know what {name!r} was made from",
                remedy="'inflight catalog show DATASET --json' gives the 'id' of each day",
            )
        return tuple(edges[0]) if edges else ("parent", "child"), edges
    table = name.removeprefix("tables/")
    tables = [_table_fields(record) for record in catalog.tables(table)]
    if tables:
        return ("id", "name", "valid", "approved_by", "run"), tables
    days = [_day_fields(day) for day in catalog.days(name, span)]
    if not days:
        raise CatalogError(
            f"there is neither a dataset nor a table {name!r} with days in the span",
            remedy="'inflight catalog list' names them",
        )
    return ("day", "state", "version", "coverage", "count", "cause", "message"), days


def _summary_of_report(report: Mapping[str, Any]) -> str:
    """Return what a day's report states: missing samples, gaps, dropped rows, or a field not corrected."""
    parts = []
    if report.get("applied") == "no":
        parts.append(f"left as measured: {report.get('reason', '')}")
    for name, channel in report.get("channels", {}).items():
        if channel.get("gaps"):
            start, _, most = max(channel["gaps"], key=lambda gap: gap[2])
            parts.append(
                f"{name}: {channel['gap_samples']} of {channel['expected']} samples missing in "
                f"{channel['gap_count']} gaps, most {most} from {start[11:19]}"
            )
    parts += [
        f"{count} {why.replace('_', ' ')} dropped" for why, count in (report.get("dropped") or {}).items()
    ]
    return "; ".join(parts)


@verb(group, "lineage")
def lineage(
    command: Command,
    name: Annotated[
        str,
        typer.Argument(
            help="l2/field@2005-01-10, main-window:4, a delivered file, release:1.0, model:2, context:NAME "
            "or a lineage id (day:12)."
        ),
    ],
    *,
    up: Annotated[bool, typer.Option("--up", help="Only what it was made from.")] = False,
    down: Annotated[bool, typer.Option("--down", help="Only what was made from it.")] = False,
    svg: SvgOption = None,
) -> None:
    """Show what something was made from and what was made from it, both ways to the end."""
    graph = command.open_catalog().lineage_graph(name, "both" if up == down else "up" if up else "down")
    if svg is not None:
        svg.write_text(graph.svg(), "utf-8")
    nodes = [_plain_fields(node) | {"text": node.text} for node in graph.nodes]
    for node in nodes:
        node["items"] = [_plain_fields(item) for item in node["items"]]
    links = [
        {
            "parent": link.parent,
            "child": link.child,
            "parents": [item.id for item in link.parents],
            "children": [item.id for item in link.children],
        }
        for link in graph.links
    ]

    def show(console: Console) -> None:
        console.print(graph.text(), markup=False, soft_wrap=True)
        if svg is not None:
            console.print(f"drawn: {svg}", markup=False, soft_wrap=True)

    command.emit({"command": "catalog lineage", "name": graph.name, "nodes": nodes, "links": links}, show)


@verb(group, "approve")
def approve(
    command: Command,
    name: Annotated[
        str, typer.Argument(metavar="NAME[:NUMBER]", help="Table, such as main-window:12 (or the newest).")
    ],
    *,
    by: Annotated[str, typer.Option(help="Who answers for it.")],
    note: Annotated[str, typer.Option(help="What was checked.")] = "",
) -> None:
    """Approve a calibration table in a person's name: a definitive release takes no other."""
    from inflight.tasks import find_table

    catalog = command.open_catalog()
    record = find_table(catalog, name.removeprefix("tables/"))
    catalog.approve(record.id, by, note)
    (approved,) = [one for one in catalog.tables(record.name) if one.id == record.id]

    def show(console: Console) -> None:
        who = ", ".join(dict.fromkeys(person for person, _, _ in approved.approved))
        console.print(f"table {record.name}:{record.id} is approved by {who}", markup=False)

    command.emit({"command": "catalog approve", "items": [_table_fields(approved)]}, show)


@verb(group, "verify")
def verify(
    command: Command,
    name: Annotated[str | None, typer.Argument(help="Only this dataset.")] = None,
) -> None:
    """Hash every published store against its manifest; exit 1 when something is damaged."""
    catalog = command.open_catalog()
    if name is not None:
        _require_known(catalog, name)
    with command.progress() as progress:
        faults = catalog.verify(name, progress)

    def show(console: Console) -> None:
        if faults:
            console.print(_table(("item", "fault", "path"), faults))
            console.print("Next: inflight catalog repair")
        else:
            console.print("every published store is whole")

    command.emit({"command": "catalog verify", "items": [], "faults": faults}, show)
    if faults:
        raise typer.Exit(1)


def _require_known(catalog: Catalog, name: str) -> None:
    """Refuse a name that nothing is known of: it would be reported as whole and without gaps."""
    from inflight.errors import CatalogError

    tables = sorted({f"tables/{record.name}" for record in catalog.tables()})
    known = [*catalog.dataset_names(), *tables]
    if name not in known:
        raise CatalogError(
            f"there is no dataset {name!r}", remedy=f"the catalog has {', '.join(known) or 'nothing yet'}"
        )


@verb(group, "repair")
def repair(
    command: Command,
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what is damaged.")] = False,
) -> None:
    """Take damaged stores out of use, so that ingest and reprocess make their days and tables again."""
    with command.progress() as progress:
        found = command.open_catalog().repair(dry_run, progress)
    items = [_plain_fields(repaired) for repaired in found]

    def show(console: Console) -> None:
        if not items:
            console.print("every published store is whole: nothing to repair")
            return
        rows = []
        for item in items:
            days = item["days"]
            span = f"{days[0]} to {days[-1]} ({len(days)})" if days else ""
            rows.append(item | {"files": item["files"][0], "days": span})
        console.print(_table(("item", "path", "files", "days"), rows))
        console.print(
            "Next: inflight ingest, then inflight reprocess" if not dry_run else "nothing was changed"
        )

    command.emit({"command": "catalog repair", "dry_run": dry_run, "items": items}, show)


@verb(group, "gaps")
def gaps(
    command: Command,
    name: Annotated[str | None, typer.Argument(help="Only this dataset.")] = None,
    *,
    start: StartOption = None,
    end: EndOption = None,
) -> None:
    """List the days that are missing or failed, with the cause the catalog knows."""
    from inflight.time import day_range

    catalog = command.open_catalog()
    span = slice(start, end)
    if name is not None:
        _require_known(catalog, name)
    # What is kept of several days stands at the first of them: no other day is missing there.
    known = catalog.dataset_names()
    names = [name] if name else [one for one in known if not _is_own(one)]
    items = []
    for dataset in names:
        # From the first to the last day of a dataset.
        days = {day.day: day for day in catalog.days(dataset, span)}
        for date in day_range(min(days), max(days) + 1) if days else ():
            day = days.get(date)
            if day is None:
                absent = {"dataset": dataset, "day": str(date), "state": "absent", "cause": "", "message": ""}
                items.append(absent)
            elif day.state != "published":
                items.append({"dataset": dataset, **_day_fields(day)})

    never = [] if name else _never_delivered(command, names)
    items = never + items

    def show(console: Console) -> None:
        if items:
            console.print(_table(("dataset", "day", "state", "cause", "message"), items[:SHOWN_DAYS]))
            if len(items) > SHOWN_DAYS:
                console.print(f"... and {len(items) - SHOWN_DAYS} more; --json lists all")
            console.print("next: put the files of these days there, then inflight ingest, inflight reprocess")
        else:
            console.print("no gaps")

    command.emit({"command": "catalog gaps", "items": items, "faults": []}, show)


def _never_delivered(command: Command, known: Sequence[str]) -> list[dict[str, Any]]:
    """Return an entry for each instrument of which the archive has no day at all."""
    message = "nothing was ever taken in; next: inflight ingest"
    return [
        {"dataset": f"l1/{name}", "day": "all", "state": "absent", "cause": "no_work", "message": message}
        for name in command.open_workspace().mission().instruments
        if f"l1/{name}" not in known
    ]


def _day_fields(day: Day) -> dict[str, Any]:
    return _plain_fields(day) | {"day": str(day.day)}


def _utc(tt2000: int) -> str:
    from inflight.time import to_utc

    return str(to_utc(tt2000).astype("datetime64[s]"))


def _table_fields(record: Any) -> dict[str, Any]:
    fields = _plain_fields(record)
    fields |= {"start": _utc(record.start), "end": _utc(record.end)}
    spans = [f"{_utc(start)} to {_utc(end)}" for _, start, end in record.certified]
    people = ", ".join(dict.fromkeys(person for person, _, _ in record.approved))
    return fields | {"valid": ", ".join(spans) or "not certified", "approved_by": people}


@verb(group, "runs")
def runs(
    command: Command,
    kind: Annotated[str | None, typer.Argument(help="Only runs of this kind, such as reprocess.")] = None,
) -> None:
    """List what was run: when, how long, how it ended, and the reason that was given."""
    items = [_run_fields(record) for record in command.open_catalog().runs(kind)]

    def show(console: Console) -> None:
        if not items:
            console.print(f"there is no run{f' of kind {kind!r}' if kind else ''}")
            return
        columns = ("run", "kind", "state", "started", "seconds", "reason", "message")
        rows = [
            one | {"started": one["started"][:16], "seconds": _seconds(one)} for one in items[-SHOWN_DAYS:]
        ]
        console.print(_table(columns, rows))
        if len(items) > SHOWN_DAYS:
            console.print(f"the last {SHOWN_DAYS} of {len(items)} runs; --json lists all")

    command.emit({"command": "catalog runs", "items": items}, show)


@verb(group, "log")
def log(
    command: Command,
    run: Annotated[
        str | None,
        typer.Argument(help="Of 'catalog runs', or how it begins (default: the last).", show_default=False),
    ] = None,
) -> None:
    """Show the log of a run: what it was asked to do, what became of its days, errors with what to do."""
    from inflight.errors import CatalogError
    from inflight.tasks import run_log

    catalog = command.open_catalog()
    found = [record for record in catalog.runs() if record.id.startswith(run or "")]
    if not found:
        raise CatalogError(f"there is no run {run or ''}", remedy="'inflight catalog runs' lists them")
    lines = run_log(catalog, found[-1])

    def show(console: Console) -> None:
        for line in lines:
            console.print(line, soft_wrap=True, markup=False)

    command.emit({"command": "catalog log", "run": found[-1].id, "lines": lines}, show)


def _run_fields(record: RunRecord) -> dict[str, Any]:
    reason = str(record.settings.get("reason", ""))
    return {"run": record.id, **_plain_fields(record), "settings": dict(record.settings), "reason": reason}


def _seconds(item: Mapping[str, Any]) -> str:
    if not item["ended"]:
        return ""
    spent = dt.datetime.fromisoformat(item["ended"]) - dt.datetime.fromisoformat(item["started"])
    return f"{spent.total_seconds():.0f}"


@verb(group, "diff")
def diff(
    command: Command,
    before: Annotated[
        str,
        typer.Argument(
            help="A release, such as 1.0; model:2, the products of that version; now; or a table, "
            "such as main-window:4."
        ),
    ],
    after: Annotated[
        str, typer.Argument(help="The same (of tables: the newest of the name).", show_default=True)
    ] = "now",
    *,
    datasets: Annotated[
        list[str] | None,
        typer.Option("--dataset", help="Only datasets like this; may be repeated (default: l2/*)"),
    ] = None,
    strength: Annotated[
        float, typer.Option(help="Field in which changes of a table are told in nT, nT.")
    ] = 50_000.0,
    svg: SvgOption = None,
) -> None:
    """Tell what differs between two releases or versions, day by day, or between two calibration tables."""
    catalog = command.open_catalog()
    name = before.removeprefix("tables/").partition(":")[0]
    if name in {record.name for record in catalog.tables()}:
        _table_diff(command, catalog, (before, name if after == "now" else after), strength, svg)
        return
    with command.progress() as progress:
        found = list(catalog.differences(before, after, datasets or ["l2/*"], progress))
    items = [_change_fields(one) for one in found]
    if svg is not None:
        svg.write_text(_picture_of_days(f"{before} to {after}", found), "utf-8")

    def show(console: Console) -> None:
        if not found:
            console.print(f"{before} and {after} have the same days with the same values")
            return
        rows = []
        for one in found[:SHOWN_DAYS]:
            row = {"dataset": one.dataset, "day": one.day, "change": one.kind}
            if part := one.main:
                sizes = {"rms": f"{part.rms:.4g}", "largest": f"{part.largest:.4g}"}
                row |= _plain_fields(part) | sizes
            rows.append(row)
        columns = ("dataset", "day", "change", "variable", "units", "rms", "largest", "samples")
        console.print(_table(columns, rows))
        count = Counter(one.kind for one in found)
        parts = ", ".join(f"{number} {kind}" for kind, number in sorted(count.items()))
        console.print(
            f"{parts}; --json lists all variables of all days, vectors by the length of their change"
        )

    command.emit({"command": "catalog diff", "before": before, "after": after, "items": items}, show)


def _table_diff(
    command: Command, catalog: Catalog, names: tuple[str, str], strength: float, svg: Path | None
) -> None:
    """Tell what differs between two calibration tables, parameter by parameter."""
    from inflight.calibration import table_changes
    from inflight.tasks import find_table

    old, new = (find_table(catalog, name.removeprefix("tables/")) for name in names)
    labels = [f"{one.name}:{one.id}" for one in (old, new)]
    found = table_changes(catalog.table_by_id(old.id), catalog.table_by_id(new.id), strength)
    rows = found.rows()
    if svg is not None:
        svg.write_text(_picture_of_table(" to ".join(labels), found), "utf-8")
    fields = {
        "before": labels[0],
        "after": labels[1],
        "start": _utc(int(found.start[0])),
        "end": _utc(int(found.end[-1])),
        "spans": len(found.start),
        "strength": strength,
        "field": found.field_rms(),
        "gained": list(found.gained),
        "lost": list(found.lost),
        "items": [_plain_fields(one) | {"at": _utc(one.at)} for one in rows],
    }

    def show(console: Console) -> None:
        console.print(f"{' and '.join(labels)}, {fields['start']} to {fields['end']}", soft_wrap=True)
        for what, names_of in (("gained", found.gained), ("lost", found.lost)):
            if names_of:
                console.print(f"parameters {what}: {', '.join(names_of)}", markup=False, soft_wrap=True)
        if not rows:
            console.print("the parameters of both have the same values")
            return
        numbers = [
            [
                one.parameter,
                f"{one.rms:.4g}",
                f"{one.largest:+.4g}",
                "" if one.unit == "1" else one.unit,
                _utc(one.at),
                "" if one.sigmas != one.sigmas else f"{one.sigmas:.2f}",
                "" if one.field != one.field else f"{one.field:.3g}",
            ]
            for one in rows
        ]
        heads = ("parameter", "rms", "largest", "unit", "from", "largest, sigmas", "rms in the field, nT")
        console.print(text_table(heads, numbers))
        if fields["field"] == fields["field"]:
            console.print(
                f"all of them together: {fields['field']:.3g} nT rms over time and directions of a field of "
                f"{strength:.0f} nT (--strength)",
                soft_wrap=True,
            )
        console.print("sigmas: the change over the larger sigma of both tables", soft_wrap=True)

    command.emit({"command": "catalog diff", **fields}, show)


def _picture_of_table(title: str, found: TableChanges) -> str:
    from inflight.errors import CatalogError
    from inflight.figures import changes_picture, table_change_panels

    panels = table_change_panels(found)
    if not panels:
        raise CatalogError("no values differ: there is nothing to draw", remedy="leave out --svg")
    return changes_picture(f"{title}: changes; the band is one sigma", panels)


def _picture_of_days(title: str, changes: Sequence[DayChange]) -> str:
    import numpy as np

    from inflight.errors import CatalogError
    from inflight.figures import ChangePanel, changes_picture

    series: dict[tuple[str, str, str], list[tuple[np.datetime64, float]]] = {}
    for one in changes:
        if part := one.main:
            series.setdefault((one.dataset, part.variable, part.units), []).append((one.day, part.rms))
    if not series:
        raise CatalogError("no values differ: there is nothing to draw", remedy="leave out --svg")
    panels = []
    for (dataset, variable, units), points in series.items():
        days = np.array([day for day, _ in points])
        values = np.array([rms for _, rms in points])
        panels.append(ChangePanel(f"{dataset}: {variable}, rms of the day", units, days, days + 1, values))
    return changes_picture(f"{title}: changes of days", panels)


def _change_fields(change: DayChange) -> dict[str, Any]:
    return {
        "dataset": change.dataset,
        "day": str(change.day),
        "kind": change.kind,
        "before": change.before.version if change.before else "",
        "after": change.after.version if change.after else "",
        "variables": [_plain_fields(part) for part in change.variables],
        "gained": list(change.gained),
        "lost": list(change.lost),
    }


@verb(group, "gc")
def collect_garbage(
    command: Command,
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what would be removed.")] = False,
    past: Annotated[
        bool,
        typer.Option(
            "--past",
            help="Also past revisions and tables that no release, no named context, no newest version and "
            "nothing these were made from needs.",
        ),
    ] = False,
) -> None:
    """Remove what nothing refers to: stores of runs that failed, releases that were killed.

    What is or ever was published, and what a release holds, stays; with --past only what is needed does.
    """
    with command.progress() as progress:
        found = command.open_catalog().gc(dry_run, past=past, progress=progress)
    items = [_plain_fields(one) | {"MB": one.bytes / 1e6} for one in found]
    counts = {
        "folders": len(found),
        "revisions": sum(len(one.revisions) for one in found),
        "tables": sum(len(one.tables) for one in found),
        "bytes": sum(one.bytes for one in found),
    }

    def show(console: Console) -> None:
        if not items:
            console.print("everything that is stored is in use")
            return
        rows = [one | {key: len(one[key]) for key in ("revisions", "tables")} for one in items[:SHOWN_DAYS]]
        console.print(_table(("path", "item", "revisions", "tables", "MB"), rows))
        if len(items) > SHOWN_DAYS:
            console.print(f"... and {len(items) - SHOWN_DAYS} more; --json lists all")
        console.print(
            f"{'would be' if dry_run else 'were'} removed: {counts['bytes'] / 1e6:.1f} MB; past revisions of "
            f"days: {counts['revisions']}, tables: {counts['tables']}, folders: {counts['folders']}",
            soft_wrap=True,
        )

    command.emit({"command": "catalog gc", "dry_run": dry_run, "counts": counts, "items": items}, show)


@verb(group, "move")
def move(
    command: Command,
    address: Annotated[
        str,
        typer.Argument(
            help="postgresql://USER@HOST/DATABASE, an empty one; sqlite, back into the workspace.",
            metavar="URL",
        ),
    ],
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only look whether it can be moved, and count.")
    ] = False,
) -> None:
    """Move the catalog into a PostgreSQL database that several machines can write to, or back."""
    from inflight.catalog import CATALOG_VARIABLE, move_catalog

    root = command.open_workspace().root.resolve()
    with command.progress() as progress:
        moved = move_catalog(root, address, dry_run=dry_run, progress=progress)
    fields = _plain_fields(moved) | {"rows": dict(moved.rows)}

    def show(console: Console) -> None:
        items = [{"table": name, "rows": count} for name, count in moved.rows.items() if count]
        console.print(_table(("table", "rows"), items))
        count = sum(moved.rows.values())
        if not moved.done:
            console.print(f"{count} rows would be moved; nothing was changed")
            return
        console.print(f"{count} rows moved and compared, from {moved.source}", soft_wrap=True)
        console.print(f"the catalog is now in {moved.target}", soft_wrap=True)
        if os.environ.get(CATALOG_VARIABLE):
            console.print(f"next: {CATALOG_VARIABLE} is set and goes first: change it, on all machines")
        elif address != "sqlite":
            console.print("next: its password, if it has one, into PGPASSWORD or ~/.pgpass")

    command.emit({"command": "catalog move", **fields}, show)


def _plain_fields(record: Any) -> dict[str, Any]:
    if hasattr(record, "_asdict"):
        return dict(record._asdict())
    return {item.name: getattr(record, item.name) for item in dataclasses.fields(record)}


def _table(columns: tuple[str, ...], items: list[dict[str, Any]]) -> TextTable:
    from inflight.tasks import in_plain_words

    def cell(name: str, value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3f}"
        text = "" if value is None else str(value)
        return in_plain_words(text) if name in ("state", "cause") else text

    rows = ([cell(name, item.get(name, "")) for name in columns] for item in items)
    return text_table([in_plain_words(name) for name in columns], rows)
