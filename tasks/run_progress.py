"""What the catalog knows of runs: how far each is, and its log as text.

In go the records of runs and of their days; out come `RunProgress` and the lines of `run_log`. Nothing is
kept twice: the log of a run is written from its days, their failures and its report when somebody reads it.
"""

from __future__ import annotations

import datetime as dt
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from inflight.catalog import Catalog, Day, RunRecord
from inflight.tasks.report import in_plain_words, location_of

#: Settings of a run that its log tells elsewhere.
_TOLD = ("reason", "days_planned")
#: Failed days of a dataset that are told one by one.
_SHOWN = 40


@dataclass(frozen=True)
class RunProgress:
    """How far a run is.

    Attributes
    ----------
    record : RunRecord
    counts : mapping
        Days by dataset and state.
    seconds : float
        Since it began, or that it took.
    """

    record: RunRecord
    counts: Mapping[str, Mapping[str, int]]
    seconds: float

    @property
    def planned(self) -> int | None:
        """Days to do, as the run stated them; None of runs that state none."""
        found = self.record.settings.get("days_planned")
        return None if found is None else int(found)

    @property
    def done(self) -> Mapping[str, int]:
        """Days made so far by dataset, failed ones among them, in the order they are made in."""
        made = ("verified", "published", "failed", "no_work", "freed")
        order = sorted(self.counts, key=lambda name: (not name.startswith("equations/"), name))
        return {name: sum(self.counts[name].get(state, 0) for state in made) for name in order}

    @property
    def failed(self) -> int:
        """Days that failed."""
        return sum(states.get("failed", 0) for states in self.counts.values())

    @property
    def reason(self) -> str:
        """Why it was run, as who began it said."""
        return str(self.record.settings.get("reason", ""))

    def days_text(self) -> str:
        """Return the days done of days to do, by dataset."""
        of = "" if self.planned is None or self.record.state != "running" else f" of {self.planned}"
        short = {name: re.sub("^(equations|comparison)/", "", name) for name in self._shown()}
        told = [f"{short[name]}: {count}{of}" for name, count in self._shown().items()]
        return ", ".join(told) or (f"0{of}" if of else "")

    def _shown(self) -> Mapping[str, int]:
        """Return products and measurements alone, if there are any: nobody asks for statistics."""
        if self.record.state == "running":
            return self.done
        return {name: count for name, count in self.done.items() if "equations/" not in name} or self.done


def runs_progress(cat: Catalog, last: int, kind: str | None = None) -> list[RunProgress]:
    """Return how far the last runs are, the newest first.

    Parameters
    ----------
    last : int
        So many.
    kind : str, optional
        Only runs of this kind.
    """
    records = cat.runs(kind, last)[::-1]
    counts = cat.run_counts([record.id for record in records])
    return [RunProgress(record, counts[record.id], _seconds(record)) for record in records]


def _seconds(record: RunRecord) -> float:
    ended = dt.datetime.fromisoformat(record.ended) if record.ended else dt.datetime.now(dt.UTC)
    # The end is kept in whole seconds.
    return max((ended - dt.datetime.fromisoformat(record.started)).total_seconds(), 0.0)


def run_log(cat: Catalog, record: RunRecord) -> list[str]:
    """Return the log of a run, line by line: what it was asked, what became of its days, how it ended."""
    settings = {name: value for name, value in record.settings.items() if name not in _TOLD}
    lines = [f"{_clock(record.started)}  {record.kind} begins: {record.id}"]
    if reason := record.settings.get("reason"):
        lines.append(f"reason: {reason}")
    lines += [f"{name}: {_plain(value)}" for name, value in settings.items() if value not in (None, "", [])]
    if (planned := record.settings.get("days_planned")) is not None:
        lines.append(f"{planned} days to do")
    for name, days in groupby(cat.days_of_run(record.id), key=lambda day: day.dataset):
        lines += _of_dataset(name, list(days))
    report = (cat.run_report(record.id) or {}).get("report") or {}
    lines += [f"remark: {one}" for one in report.get("warnings", ())]
    if record.state == "running":
        lines.append(f"running for {_seconds(record):.0f} s")
    else:
        cause = f" ({in_plain_words(record.cause)})" if record.cause else ""
        lines.append(f"{_clock(str(record.ended))}  {record.state}{cause} after {_seconds(record):.0f} s")
    if record.message:
        lines.append(record.message)
    return lines


def _of_dataset(name: str, days: Sequence[Day]) -> Iterator[str]:
    """Yield what became of the days of one dataset: how many of each kind, then each failure."""
    counts = Counter(day.state for day in days)
    told = ", ".join(f"{count} {in_plain_words(state)}" for state, count in counts.items())
    span = f"{days[0].day} to {days[-1].day}" if len(days) > 1 else str(days[0].day)
    lines = f"{name}: {told}; {span}"
    versions = sorted({day.version for day in days if day.version})
    yield f"{lines}; {', '.join(versions)}" if versions else lines
    failed = [day for day in days if day.state == "failed"]
    for day in failed[:_SHOWN]:
        yield from failure_lines(day)
    if len(failed) > _SHOWN:
        yield f"  ... and {len(failed) - _SHOWN} more"


def failure_lines(day: Day) -> Iterator[str]:
    """Yield why a day failed, and what to do, as far as the catalog knows."""
    found = {"message": day.message, "day": str(day.day), **(day.report.get("problem") or {})}
    cause = f" ({in_plain_words(day.cause)})" if day.cause else ""
    yield f"  {location_of({'file': '', 'channel': '', **found})}: failed{cause}: {found['message']}"
    if found.get("remedy"):
        yield f"    What to do: {found['remedy']}"


def _clock(stamp: str) -> str:
    """Return a time of the catalog (ISO 8601, UTC) without its parts of a second."""
    return stamp[:19].replace("T", " ")


def _plain(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
