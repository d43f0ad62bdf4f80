"""A day of a dataset: its samples with flags, its versions side by side, what it was made from."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup

from inflight.catalog import Catalog, Day, DayChange, components, measured_changes
from inflight.figures import Section, day_picture, facts_table, html_table, paragraph
from inflight.flags import UNUSABLE, Flag
from inflight.tasks import failure_lines, in_plain_words, panels_of_day
from inflight.time import day_bounds

#: Attributes of a product that say what it was made with, as the page calls them.
_MADE_WITH = {
    "calibration_method": "method",
    "calibration_model": "model",
    "calibration_table": "table",
    "typical_values": "stand-ins",
}


def product_day_sections(cat: Catalog, dataset: str, day: np.datetime64) -> list[Section]:
    """Return what there is of a day: the day itself, its versions, and what it was made from.

    Raises
    ------
    IntegrityError
        When its store is damaged.
    """
    found = cat.days(dataset, day)
    if not found:
        text = f"The catalog has nothing of {dataset} on {day}."
        return [("The day", [paragraph(text)], [])]
    revisions = cat.revisions(dataset, day)
    sections: list[Section] = [("The day", _day(cat, found[0]), [])]
    if revisions:
        picture = _drawing(
            cat.lineage_graph(found[0], "up").svg(), f"{_file_name(found[0])}-made-from", scaled=False
        )
        sections += [("Versions", _versions(cat, revisions), []), ("Made from", [picture], [])]
    return sections


def _day(cat: Catalog, day: Day) -> list[str]:
    """Return state, numbers, flags and picture of a day."""
    if day.state != "published":
        lines = list(failure_lines(day)) if day.state == "failed" else [day.message]
        return [
            paragraph("", bold=f"{day.dataset} {day.day}: {in_plain_words(day.state)}"),
            *map(paragraph, lines),
        ]
    dataset = cat.read(day, with_time=False)
    facts = {
        "version": day.version,
        "samples": f"{day.count}" + ("" if day.coverage is None else f", {day.coverage:.1%} of the day's"),
        **{words: str(dataset.attrs.get(name, "")) for name, words in _MADE_WITH.items()},
        "made by run": day.run,
        "remark": day.message,
    }
    parts: list[str] = [paragraph("", bold=f"{day.dataset} {day.day}"), facts_table(facts)]
    if "tt2000" not in dataset:
        return parts
    flags = dataset["flag"].values if "flag" in dataset else np.zeros(dataset["tt2000"].size, np.uint32)
    counted = [(bit, int(np.count_nonzero(flags & np.uint32(bit)))) for bit in Flag if bit]
    rows = [
        (str(bit.name).lower().replace("_", " "), f"{count}", f"{count / flags.size:.2%}")
        for bit, count in counted
        if count
    ]
    if panels := panels_of_day(dataset):
        start, end = day_bounds(day.day)
        part = (dataset["tt2000"].values - start) / (end - start)
        unusable = (flags & np.uint32(UNUSABLE)) != 0
        picture = day_picture(f"{day.dataset} {day.day} {day.version}", part, panels, unusable)
        parts.append(_drawing(picture, _file_name(day), scaled=True))
    parts.append(
        html_table(["flag", "samples", "part"], rows)
        if rows
        else paragraph("No sample carries a flag.", kind="quiet")
    )
    return parts


def _drawing(picture: str, name: str, *, scaled: bool) -> Markup:
    """Return an SVG of the project's own templates, in the width there is or to be scrolled."""
    width = "max-width:100%;height:auto" if scaled else "max-width:none"
    drawn = picture[picture.index("<svg ") :].replace("<svg ", f'<svg style="{width}" ', 1)
    address = f"data:image/svg+xml;base64,{b64encode(picture.encode()).decode()}"
    link = f'<a class="quiet" download="{name}.svg" href="{address}">Save as SVG</a>'
    return Markup(f'<div style="overflow-x:auto">{drawn}</div>{link}')


def _file_name(day: Day) -> str:
    return f"{day.dataset.replace('/', '-')}-{day.day}-{day.version}"


def day_table(cat: Catalog, dataset: str, day: np.datetime64) -> str:
    """Return the samples of a day as CSV, components in columns of their own; times are ISO 8601, UTC.

    Raises
    ------
    CatalogError
        When the day has no samples.
    """
    read = cat.read_day(dataset, day)
    columns: dict[str, np.ndarray] = {}
    for name in map(str, read.variables):
        values = read[name].values
        if read[name].dims == ("time",):
            columns[name] = values
        elif read[name].dims[:1] == ("time",) and values.ndim == 2:
            parts = components(read[name], read)
            columns |= {f"{name}_{part}": values[:, at] for at, part in enumerate(parts)}
    return str(pd.DataFrame(columns).to_csv(index=False))


def _versions(cat: Catalog, revisions: Sequence[Day]) -> list[str]:
    """Return the versions of a day side by side, each with what changed against the one before."""
    runs = {one.id: one for one in cat.runs()}
    columns = []
    for before, day in zip([None, *revisions], revisions, strict=False):
        run = runs.get(day.run)
        context = cat.context(day.context) if day.context else None
        change = _change(cat, before, day)
        columns.append(
            {
                "made": run.started[:16].replace("T", " ") if run else "",
                "reason": str(run.settings.get("reason", "")) if run else "",
                "model": f"{context.model_name} {context.model_version}" if context else "",
                "table": ", ".join(sorted(_tables(cat, day))),
                "samples": f"{day.count}",
                "residual after, nT rms": _size(day, "after_nT"),
                **{f"change: {name}": text for name, text in change.items()},
            }
        )
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = [[name, *(column.get(name, "") for column in columns)] for name in names]
    rows = [row for row in rows if any(row[1:])]
    heads = ["", *(day.version for day in revisions)]
    note = (
        "Changes are rms and largest against the version before it; of vectors, of the length of the change."
    )
    parts: list[str] = [html_table(heads, rows, kind="wide told scrolled")]
    return [*parts, paragraph(note, kind="quiet")] if len(revisions) > 1 else parts


def _change(cat: Catalog, before: Day | None, day: Day) -> Mapping[str, str]:
    """Return what changed from a version to the next, by variable."""
    if before is None:
        return {}
    gone = [one.version for one in (before, day) if not one.segment or not _is_there(cat, one)]
    if gone:
        return {"values": f"the values of {', '.join(gone)} are not kept"}
    changes: list[DayChange] = list(measured_changes(cat.workspace, [before], [day]))
    if not changes or not changes[0].variables:
        return {"values": "none"}
    return {
        f"{one.variable}, {one.units}": f"{one.rms:.3g}, at most {one.largest:.3g}"
        for one in changes[0].variables
    }


def _is_there(cat: Catalog, day: Day) -> bool:
    return (cat.workspace / day.segment).exists()


def _tables(cat: Catalog, day: Day) -> set[str]:
    """Return the tables that a day was made from, with their numbers."""
    names = {f"table:{one.id}": f"{one.name}:{one.id}" for one in cat.tables()}
    parents = (edge.parent for edge in cat.lineage(day) if edge.child == day.id)
    return {names[parent] for parent in parents if parent in names}


def _size(day: Day, name: str) -> str:
    value = day.report.get(name)
    return f"{value:.4g}" if isinstance(value, float) else ""
