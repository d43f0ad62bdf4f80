"""Named contexts: made of what a workspace's products are calibrated with, and what a change of one touches.

In goes the catalog, and a time or two names; out come `NamedContext` records, or the days that come out
otherwise with the second context, each with its reasons. Nothing is calibrated here: `reprocess` does that
with the context named in its settings.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from inflight.catalog import (
    Catalog,
    ContextRecord,
    NamedContext,
    RunRecord,
    TableRecord,
    Validity,
    validities,
)
from inflight.errors import CatalogError, SettingsError
from inflight.tasks.models import model_label
from inflight.tasks.pipelines.base import ReprocessSettings, UsedTable, pinned_name, pinned_tables, product_of

#: Stands for what is in use now, in the place of a name.
NOW: Final = "now"
#: Names of contexts, as they stand in headers and on command lines.
_NAME: Final = re.compile(r"[A-Za-z][\w.-]*")


@dataclass(frozen=True, kw_only=True)
class ComparisonState:
    """What the products of a comparison are calibrated with.

    Attributes
    ----------
    pinned : ContextRecord
        Its id is empty when it is not saved.
    run : RunRecord
        The reprocessing that its mission file, model and choices are from.
    left_out : dict of str to list of int
        Valid tables that were made with another version of the model, by name.
    """

    pinned: ContextRecord
    run: RunRecord
    left_out: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def settings(self) -> ReprocessSettings:
        """The choices of the run."""
        stated = self.run.settings
        return ReprocessSettings(
            **{key: stated[key] for key in ReprocessSettings.model_fields if key in stated}
        )

    @property
    def table(self) -> str:
        """Name of the table that products take."""
        return pinned_name(self.pinned.tables, self.settings)


@dataclass(frozen=True, kw_only=True)
class AffectedDay:
    """A published day whose values depend on which of two contexts it is made in.

    Attributes
    ----------
    dataset : str
    day : datetime64[D]
    version : str
        Of the published revision.
    reasons : tuple of str
        What differs, such as ``table main-window:3 -> main-window:7``.
    """

    dataset: str
    day: np.datetime64
    version: str
    reasons: tuple[str, ...]


def make_context(
    cat: Catalog, name: str, *, as_of: str | None = None, author: str, reason: str = ""
) -> dict[str, ComparisonState]:
    """Give what products are calibrated with a name, or what they were calibrated with at some time.

    Of each comparison: mission file, model and choices of the last reprocessing, and the tables that are
    valid and were made with that model.

    Parameters
    ----------
    as_of : str, optional
        UTC date, that day included, or date and time; now when absent.

    Returns
    -------
    dict of str to ComparisonState
        By comparison.

    Raises
    ------
    SettingsError
        When the name or the time is none.
    CatalogError
        When the name is taken, or no table was valid.
    """
    if not _NAME.fullmatch(name) or name == NOW:
        raise SettingsError(
            f"{name!r} is no name of a context",
            remedy="write a letter, then letters, digits, '.', '_' or '-'",
        )
    if not author.strip():
        raise SettingsError("a context needs an author", remedy="say who: --by NAME")
    until = None if as_of is None else _instant(as_of)
    states = states_at(cat, until)
    if not states:
        when = f" as of {as_of}" if as_of else ""
        raise CatalogError(
            f"no calibration table is valid{when}", remedy="'inflight reprocess' makes and certifies tables"
        )
    named = [
        NamedContext(
            name=name,
            comparison=comparison,
            context=cat.save_context(
                state.pinned.mission_text,
                state.pinned.model_name,
                state.pinned.model_version,
                state.pinned.tables,
            ),
            run=state.run.id,
            author=author.strip(),
            reason=reason,
            as_of=(until or dt.datetime.now(dt.UTC)).isoformat(timespec="seconds"),
            created="",
        )
        for comparison, state in states.items()
    ]
    cat.name_contexts(name, named)
    return states


def states_at(cat: Catalog, until: dt.datetime | None = None) -> dict[str, ComparisonState]:
    """Return what products are calibrated with before an instant, or now, by comparison."""
    runs = {
        str(run.settings["comparison"]): run
        for run in cat.runs("reprocess")
        if run.state == "done"
        and run.context is not None
        and not run.settings.get("context")
        and (until is None or dt.datetime.fromisoformat(run.started) < until)
    }
    valid = validities(cat.certification_acts(until=until))
    records = {record.id: record for record in cat.tables()}
    shas = {(one.name, one.version): one.sha256 for one in cat.models()}
    contexts: dict[str, ContextRecord] = {}

    def sha_of(table: TableRecord) -> str:
        if table.context is None:
            return ""
        if table.context not in contexts:
            contexts[table.context] = cat.context(table.context)
        made_in = contexts[table.context]
        return shas[made_in.model_name, made_in.model_version]

    found = {}
    for comparison, run in runs.items():
        made_in = cat.context(str(run.context))
        sha = shas[made_in.model_name, made_in.model_version]
        own = {name: spans for name, spans in valid.items() if _comparison_of(name, runs) == comparison}
        pinned, left_out = dict[str, list[Validity]](), dict[str, list[int]]()
        for name, spans in own.items():
            for span in spans:
                if sha_of(records[span[0]]) == sha:
                    pinned.setdefault(name, []).append(span)
                elif span[0] not in left_out.setdefault(name, []):
                    left_out[name].append(span[0])
        if pinned:
            record = ContextRecord(
                "", made_in.mission_text, made_in.model_name, made_in.model_version, pinned
            )
            left = {name: numbers for name, numbers in left_out.items() if numbers}
            found[comparison] = ComparisonState(pinned=record, run=run, left_out=left)
    return found


def states_of(cat: Catalog, name: str) -> dict[str, ComparisonState]:
    """Return what a named context pins, or what is in use ``now``, by comparison.

    Raises
    ------
    CatalogError
        When there is no such name.
    """
    if name == NOW:
        return states_at(cat)
    named, runs = cat.named_contexts(name), {run.id: run for run in cat.runs("reprocess")}
    return {
        one.comparison: ComparisonState(pinned=cat.context(one.context), run=runs[one.run]) for one in named
    }


def affected_days(cat: Catalog, before: str, after: str) -> list[AffectedDay]:
    """Return the published products that come out otherwise in another context; none is made.

    Parameters
    ----------
    before, after : str
        Names of contexts, or ``now``.

    Raises
    ------
    CatalogError
        When there is no such name.
    """
    old, new = states_of(cat, before), states_of(cat, after)
    shas = {(one.name, one.version): one.sha256 for one in cat.models()}
    out = []
    for comparison in sorted(old.keys() | new.keys()):
        days = cat.days(product_of(comparison), states=("published",))
        states = old.get(comparison), new.get(comparison)
        reasons = _reasons_for_all(states, (before, after), shas)
        taken = [_tables_of_days(cat, state, [day.day for day in days]) for state in states]
        for day in days:
            one, other = (used.get(day.day) for used in taken)
            own = list(reasons)
            if (one and one[1].inputs) != (other and other[1].inputs):
                own.append(f"table {one[0] if one else 'none'} -> {other[0] if other else 'none'}")
            if own:
                out.append(
                    AffectedDay(dataset=day.dataset, day=day.day, version=day.version, reasons=tuple(own))
                )
    return out


def _reasons_for_all(
    states: tuple[ComparisonState | None, ComparisonState | None],
    names: tuple[str, str],
    shas: Mapping[tuple[str, int], str],
) -> list[str]:
    """Return what differs between two states whatever the day."""
    one, other = states
    if one is None or other is None:
        return [f"not in {names[0] if one is None else names[1]}"]
    reasons = []
    models = [(state.pinned.model_name, state.pinned.model_version) for state in (one, other)]
    if shas[models[0]] != shas[models[1]]:
        reasons.append(f"model {model_label(*models[0])} -> {model_label(*models[1])}")
    if one.pinned.mission_text != other.pinned.mission_text:
        reasons.append("mission file")
    return reasons


def _tables_of_days(
    cat: Catalog, state: ComparisonState | None, days: Sequence[np.datetime64]
) -> dict[np.datetime64, tuple[str, UsedTable]]:
    """Return the table that each day takes in a state, with its name and number."""
    if state is None:
        return {}
    spans = state.pinned.tables.get(state.table, ())
    used = pinned_tables(cat, spans, days, state.settings.distribute)
    return {day: (f"{state.table}:{one.number}", one) for day, one in used.items()}


def _comparison_of(table: str, comparisons: Mapping[str, object]) -> str | None:
    """Return the comparison that a table is of: the longest whose name it begins with."""
    own = [name for name in comparisons if table.startswith(f"{name}-")]
    return max(own, key=len, default=None)


def _instant(text: str) -> dt.datetime:
    """Return the instant before which something was done, for one who names a day or a time."""
    try:
        found = dt.datetime.fromisoformat(text)
    except ValueError:
        raise SettingsError(
            f"{text!r} is no UTC date or time", remedy="write 2005-01-31 or 2005-01-31T12:00:00"
        ) from None
    found = found.replace(tzinfo=dt.UTC) if found.tzinfo is None else found.astimezone(dt.UTC)
    return found + dt.timedelta(days=1) if len(text) == len("2005-01-31") else found
