"""What goes with a release beside the data: notes on what changed, validation, and a calendar of pictures.

`write_documents` is called by the catalog with the folder of a release and its contents (`ReleaseContents`).
It writes ``changes.csv`` with pictures, ``gaps.csv``, ``missing.csv``, ``validation/`` and ``calendar/``, and
returns lines of RELEASE_NOTES.md. All of it is written from what the catalog and the workspace know.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import (
    Catalog,
    ContextRecord,
    Day,
    DayChange,
    Workspace,
    components,
    measured_changes,
)
from inflight.errors import InflightError
from inflight.figures import (
    THUMBNAIL_BINS,
    CalendarDay,
    Panel,
    by_day_picture,
    calendar_page,
    day_picture,
    ranges,
)
from inflight.flags import UNUSABLE, Flag
from inflight.progress import Progress, silent, tell_each
from inflight.tasks.missing_spans import joined_spans, missing_spans, span_of_absent_day
from inflight.time import GAP, SECOND, day_bounds, usual_step

if TYPE_CHECKING:
    import xarray as xr

    from inflight.catalog import ReleaseContents

#: Days of a kind that are listed by name in the notes; `changes.csv` and `days.csv` have all.
_LISTED = 5


def write_documents(
    workspace: Workspace, folder: Path, contents: ReleaseContents, progress: Progress = silent
) -> list[str]:
    """Write what goes with a release into its folder and return the lines of its notes.

    Parameters
    ----------
    workspace : Workspace
    folder : Path
        Of the release, not yet visible.
    contents : ReleaseContents
    progress : callable, optional
        Called with (stage, done, total).
    """
    catalog = Catalog(workspace.root)
    changes = _write_changes(workspace, folder, contents, progress)
    checked = _write_validation(workspace, catalog, folder, contents, progress)
    _write_calendars(catalog, folder, contents, progress)
    return [
        *_data_notes(contents, changes),
        *_metadata_notes(catalog, contents),
        *_interface_notes(contents, changes),
        *_known_problems(contents, checked),
    ]


# What changed.


def _write_changes(
    workspace: Workspace, folder: Path, contents: ReleaseContents, progress: Progress
) -> list[DayChange]:
    """Write which days changed since the release before, and by how much; nothing for the first one."""
    if contents.previous is None:
        return []
    changes = list(measured_changes(workspace.root, contents.previous.days, contents.days, progress))
    with (folder / "changes.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(
            ("dataset", "day", "change", "variable", "units", "rms", "largest", "samples", "before", "now")
        )
        for one in changes:
            head = one.dataset, one.day, one.kind
            versions = tuple(day.version if day else "" for day in (one.before, one.after))
            for part in one.variables or (None,):
                numbers = (
                    ("", "", "", "", "")
                    if part is None
                    else (part.variable, part.units, f"{part.rms:.6g}", f"{part.largest:.6g}", part.samples)
                )
                writer.writerow((*head, *numbers, *versions))
    _draw_changes(folder, contents, changes)
    return changes


def _draw_changes(folder: Path, contents: ReleaseContents, changes: Sequence[DayChange]) -> None:
    for dataset, group in groupby(changes, key=lambda one: one.dataset):
        main = [(one.day, part) for one in group if (part := one.main) is not None]
        if main:
            (folder / "changes").mkdir(exist_ok=True)
            first = main[0][1]
            previous = contents.previous.version if contents.previous else ""
            picture = by_day_picture(
                f"{dataset}: change of {first.variable} since release {previous}, rms of the day",
                first.units,
                [day for day, _ in main],
                np.array([part.rms for _, part in main]),
                float("nan"),
            )
            (folder / "changes" / f"{dataset.replace('/', '-')}.svg").write_text(picture, "utf-8")


def _data_notes(contents: ReleaseContents, changes: Sequence[DayChange]) -> Iterator[str]:
    yield from ("## Data", "")
    for name, group in groupby(contents.days, key=lambda day: day.dataset):
        days = list(group)
        missing = sum(day.dataset == name for day in contents.absent)
        span = f"{days[0].day} to {days[-1].day}"
        yield f"- `{name}`: {len(days)} days from {span}, {missing} between them missing"
    yield ""
    if contents.previous is None:
        yield from ("This is the first release of this archive.", "")
        return
    rule = contents.next_version()
    yield (
        f"Against release {contents.previous.version} (`changes.csv` lists each day and variable, `changes/` "
        "draws them; vectors by the length of their change):"
    )
    yield ""
    if not changes:
        yield "- no day was added, removed or changed"

    def kind_of(one: DayChange) -> tuple[str, str]:
        return one.dataset, one.kind

    for (name, kind), some in groupby(sorted(changes, key=kind_of), key=kind_of):
        changed = list(some)
        sizes = [part for one in changed if (part := one.main) is not None]
        by = ""
        if sizes:
            worst = max(sizes, key=lambda part: part.rms)
            by = (
                f"; `{worst.variable}` by {np.median([part.rms for part in sizes]):.3g} {worst.units} rms in "
                f"the middle day, {worst.rms:.3g} in the worst; at most by "
                f"{max(part.largest for part in sizes):.3g}"
            )
        elif kind == "changed":
            by = "; made anew, with the same values"
        yield f"- `{name}`: {_days_in_words([one.day for one in changed])} {kind}{by}"
    yield ""
    own = contents.request.version
    if rule and rule != own:
        yield f"By the rule of versions (README.md) this release would be {rule}; it was called {own}."
        yield ""


def _days_in_words(days: Sequence[np.datetime64]) -> str:
    if len(days) == 1:
        return f"1 day ({days[0]})"
    return f"{len(days)} days ({min(days)} to {max(days)})"


# Metadata and interface.


def _metadata_notes(catalog: Catalog, contents: ReleaseContents) -> Iterator[str]:
    """Yield which model and mission file made the products, and what of both changed."""
    yield from ("## Metadata", "")
    now, previous = _contexts(catalog, contents.days), contents.previous
    before = _contexts(catalog, previous.days) if previous else {}
    if not now:
        yield "- the products name no model"
    for name, (context, days) in now.items():
        model = f"{context.model_name} version {context.model_version}"
        text = f"- `{name}`: model {model}, context `{context.id[:12]}`"
        others = len(days) - 1
        text += f", and {others} other contexts before it" if others else ""
        if previous and name in before:
            old = before[name][0]
            if old.model_version != context.model_version:
                text += f"; release {previous.version} had version {old.model_version}"
            if old.mission_text != context.mission_text:
                text += "; the mission file changed"
        yield text
    yield ""


def _contexts(catalog: Catalog, days: Sequence[Day]) -> dict[str, tuple[ContextRecord, set[str]]]:
    """Return by dataset the context of its last day, and the ids of all contexts of its days."""
    out = {}
    for name, group in groupby(days, key=lambda day: day.dataset):
        named = [day.context for day in group if day.context is not None]
        if named:
            out[name] = catalog.context(named[-1]), set(named)
    return out


def _interface_notes(contents: ReleaseContents, changes: Sequence[DayChange]) -> Iterator[str]:
    """Yield how the files are written, and variables that came or went."""
    yield from ("## Interface", "")
    yield f"- written as {', '.join(contents.request.formats)}; README.md says how each is read"
    for what, found in (
        ("new", Counter((one.dataset, name) for one in changes for name in one.gained)),
        ("no longer there", Counter((one.dataset, name) for one in changes for name in one.lost)),
    ):
        for (dataset, name), count in sorted(found.items()):
            yield f"- `{dataset}`: variable `{name}` is {what} in {count} days"
    yield ""


def _known_problems(contents: ReleaseContents, checked: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what a user should know: missing days by cause, and what is left in the residual."""
    yield from ("## Known problems", "")
    told = False
    for (name, cause), group in groupby(
        sorted(contents.absent, key=lambda day: (day.dataset, day.cause, day.day)),
        key=lambda day: (day.dataset, day.cause),
    ):
        days = list(group)
        why = next((day.message for day in days if day.message), "")
        listed = ", ".join(str(day.day) for day in days[:_LISTED])
        more = ", ..." if len(days) > _LISTED else ""
        yield f"- `{name}`: {len(days)} days missing ({cause or 'unknown'}): {listed}{more}" + (
            f"; {why}" if why else ""
        )
        told = True
    for one in checked:
        for problem in one["problems"]:
            yield f"- {one['comparison']}: {problem}"
            told = True
    if not told:
        yield "- none known"


# Validation.


def _write_validation(
    workspace: Workspace, catalog: Catalog, folder: Path, contents: ReleaseContents, progress: Progress
) -> list[dict[str, Any]]:
    """Write residual, noise floor and verdict of each comparison whose product is released."""
    released = {day.dataset for day in contents.days}
    mission = workspace.mission()
    checked = [
        one
        for name in mission.comparisons
        if (one := _validated(workspace, catalog, name, released, progress)) is not None
    ]
    if not checked:
        return []
    place = folder / "validation"
    place.mkdir()
    lines = [f"# Validation of release {contents.request.version}", ""]
    for one in checked:
        lines += [f"## {one['comparison']}", "", *one["lines"], ""]
        by_day = one.pop("by_day", [])
        sizes = np.array([np.nan if day["after_nT"] is None else day["after_nT"] for day in by_day])
        if np.isfinite(sizes).any():
            name = f"{one['comparison']}-by-day.svg"
            picture = by_day_picture(
                f"{one['comparison']}: residual of each day",
                "nT rms",
                [np.datetime64(day["day"], "D") for day in by_day],
                sizes,
                float(one["residual"].get("noise_floor_nT") or np.nan),
            )
            (place / name).write_text(picture, "utf-8")
            lines += [f"![residual of each day]({name})", ""]
    (place / "VALIDATION.md").write_text("\n".join(lines), "utf-8")
    facts = [{key: value for key, value in one.items() if key != "lines"} for one in checked]
    text = json.dumps(facts, indent=1, sort_keys=True)
    (place / "validation.json").write_text(text + "\n", "utf-8")
    return checked


def _validated(
    workspace: Workspace, catalog: Catalog, comparison: str, released: set[str], progress: Progress
) -> dict[str, Any] | None:
    """Return what is known of a comparison as facts and as lines; None when its product is not released."""
    from inflight.tasks.analysis import last_diagnosis, measure_comparison
    from inflight.tasks.pipelines import product_of

    mission = workspace.mission()
    if product_of(comparison) not in released:
        return None
    out: dict[str, Any] = {"comparison": comparison, "residual": {}, "problems": [], "lines": []}
    lines, problems = out["lines"], out["problems"]
    try:
        told = measure_comparison(catalog, mission, comparison=comparison, progress=progress).report.as_json()
    except InflightError as error:
        problems.append(f"no comparison could be made: {error.message}")
        lines.append(f"No comparison could be made: {error.message}.")
        return out
    out |= {
        "residual": told["residual"],
        "model_version": told.get("model_version"),
        "by_day": told.get("by_day", []),
        "at_noise_floor": told.get("at_noise_floor"),
    }
    lines += [
        "| | nT |",
        "|---|---|",
        *(
            f"| {key.removesuffix('_nT').replace('_', ' ')} | {value:.4g} |"
            for key, value in told["residual"].items()
            if isinstance(value, float)
        ),
        "",
    ]
    if told.get("at_noise_floor"):
        lines.append("The residual is at its noise floor: nothing that it follows reaches a tenth of it.")
    else:
        lines += [f"- {one['sentence']}" for one in told.get("fails_where", [])[:3]]
    found = last_diagnosis(workspace, comparison)
    if found is None:
        problems.append("the missing effect was not looked for (inflight diagnose)")
        lines.append("The missing effect was not looked for.")
        return out
    version = found["model"]["version"]
    held = found["residual"]
    out["diagnosis"] = {
        key: found[key] for key in ("verdict", "headline", "entries", "residual", "model")
    } | {"start": found["blocks"].get("start"), "end": found["blocks"].get("end")}
    lines += [
        "",
        f"Diagnosis of model version {version}, {found['blocks'].get('start', '')} to "
        f"{found['blocks'].get('end', '')}: "
        f"{found['headline']}",
        f"On days not used in the fit: {held['held_out_before_nT']:.4g} nT, "
        f"{held['held_out_after_nT']:.4g} nT with all of that; noise floor {held['noise_floor_nT']:.4g} nT.",
    ]
    if told.get("model_version") not in (None, 0, version):
        problems.append(
            f"the diagnosis is of model version {version}, the products are of {told['model_version']}: what "
            "is left in them was not looked for (inflight diagnose)"
        )
        return out
    for entry in found["entries"]:
        left = f"{entry['takes_off_nT']:.2g} nT rms are left in the residual"
        problems.append(f"{left} ({entry['how_sure']}): {entry['words']}")
    return out


# Pictures.


def _write_calendars(catalog: Catalog, folder: Path, contents: ReleaseContents, progress: Progress) -> None:
    """Write for each product a page a year with a thumbnail a day, and a picture of each day.

    Each day is read once: what is missing of it goes into ``gaps.csv``, and from when to when into
    ``missing.csv``.
    """
    pages: dict[str, list[str]] = {}
    missing = []
    spans = [span_of_absent_day(day) for day in contents.absent]
    products = [day for day in contents.days if day.dataset.startswith("l2/")]
    each = tell_each(progress, "pictures", products)
    for (name, year), group in groupby(each, key=lambda day: (day.dataset, str(day.day)[:4])):
        place = folder / "calendar" / name.replace("/", "-")
        what, cells = "", {}
        for day in group:
            dataset = catalog.read(day, with_time=False)
            if "tt2000" not in dataset:
                continue
            missing.append(_missing_of_day(day, dataset))
            spans += missing_spans(day, dataset)
            if panels := panels_of_day(dataset):
                what = f"{panels[-1].title} {panels[-1].names[0]}".strip()
                cells[day.day] = _drawn_day(place, day, dataset, panels, contents.request.version)
        if cells:
            absent = [one for one in contents.absent if one.dataset == name and str(one.day)[:4] == year]
            cells |= {one.day: CalendarDay(one.cause or one.state) for one in absent}
            (place / f"{year}.html").write_text(calendar_page(f"{name}, {year}", what, cells), "utf-8")
            pages.setdefault(name, []).append(year)
    _write_rows(folder / "gaps.csv", missing)
    _write_rows(folder / "missing.csv", [one.row() for one in joined_spans(spans)])
    if pages:
        lines = ["# Pictures", ""]
        for name, years in pages.items():
            links = (f"[{year}]({name.replace('/', '-')}/{year}.html)" for year in years)
            lines.append(f"- {name}: {', '.join(links)}")
        (folder / "calendar" / "README.md").write_text("\n".join(lines) + "\n", "utf-8")


def _drawn_day(
    place: Path, day: Day, dataset: xr.Dataset, panels: Sequence[Panel], version: str
) -> CalendarDay:
    """Write the picture of a day and return what the calendar shows of it."""
    start, end = day_bounds(day.day)
    part = (dataset["tt2000"].values - start) / (end - start)
    flags = dataset["flag"].values if "flag" in dataset else np.zeros(part.size, dtype=np.uint32)
    target = place / str(day.day)[:4] / f"{day.day}.svg"
    target.parent.mkdir(parents=True, exist_ok=True)
    title = f"{day.dataset} {day.day} {day.version}, release {version}"
    target.write_text(day_picture(title, part, panels, (flags & np.uint32(UNUSABLE)) != 0), "utf-8")
    covered = "" if day.coverage is None else f", {day.coverage:.1%} there"
    low, high = ranges(part, panels[-1].values[:, 0], THUMBNAIL_BINS)
    link = f"{target.parent.name}/{target.name}"
    return CalendarDay(f"{day.version}, {day.count} samples{covered}", link, low, high)


def _missing_of_day(day: Day, dataset: xr.Dataset) -> dict[str, object]:
    """Return what is missing of a day: gaps between its samples, values that are not there, flags by kind."""
    start, end = day_bounds(day.day)
    stamps = dataset["tt2000"].values
    step = usual_step(stamps, end - start)
    # From midnight to midnight: a day that begins late has a gap, too.
    apart = np.diff(np.concatenate([[start - step], stamps, [end]]))
    wide = apart[apart > GAP * step]
    fields = [name for name in map(str, dataset.data_vars) if name.startswith("field")]
    lost = {
        name: int(np.sum(~np.isfinite(dataset[name].values).reshape(stamps.size, -1).all(axis=1)))
        for name in fields[:1]
    }
    flags = dataset["flag"].values if "flag" in dataset else np.zeros(stamps.size, dtype=np.uint32)
    return {
        "dataset": day.dataset,
        "day": str(day.day),
        "samples": stamps.size,
        "gaps": wide.size,
        "gaps_s": round(float((wide - step).sum()) / SECOND, 3),
        "longest_gap_s": round(float((wide - step).max(initial=0)) / SECOND, 3),
        "without_field": next(iter(lost.values()), 0),
        **{str(bit.name).lower(): int(np.count_nonzero(flags & np.uint32(bit))) for bit in Flag if bit},
    }


def _write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows as CSV; no file without any."""
    if rows:
        with path.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def panels_of_day(dataset: xr.Dataset) -> list[Panel]:
    """Return the curves of a day's product: its field, in Earth's axes if it has them, and the residual."""
    in_time = [str(name) for name, array in dataset.data_vars.items() if array.dims[:1] == ("time",)]
    fields = sorted(
        (name for name in in_time if name.startswith("field")),
        key=lambda name: (not name.endswith("nec"), name),
    )
    out = []
    for name in [*fields[:1], *(one for one in in_time if one == "residual")]:
        array = dataset[name]
        values = np.asarray(array.values, dtype=np.float64).reshape(array.shape[0], -1)
        parts = components(array, dataset) if array.ndim > 1 else [""]
        out.append(Panel(name.replace("_", " "), str(array.attrs.get("units", "")), parts, values))
    return out
