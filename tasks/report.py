"""What a run did, and errors: as text for a person and as fields for other programs.

`RunReport` is the outcome of every verb that makes something: which days were planned and what became of
them, what went wrong and what to do about it, where the outputs are. `exit_code` follows from it.
`error_fields` returns any error as the command line and the page show it.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflight.errors import InflightError, SettingsError

if TYPE_CHECKING:
    from rich.console import Console


#: What can become of a planned day, in the order it is shown.
DAY_COUNTS = ("planned", "done", "unchanged", "failed", "no_work")

#: What a person reads for the machine's words; the JSON has these.
_PLAIN = {
    "no_work": "nothing to do",
    "repeatable": "same again until you fix it",
    "transient": "may pass by itself",
    "partial": "part of it",
}

#: Problems shown to a person before the rest is only counted.
SHOWN_PROBLEMS = 12

#: Findings of days that are there, of one kind, that are told as one line from so many on; their counts.
_ALIKE = 3
_COUNT = re.compile(r"\b\d+(?= (?:samples|rows|readings))")

SHOWN_OUTPUTS = 3

DONE, FAILED, USAGE, DAYS_MISSING = 0, 1, 2, 3


@dataclass(frozen=True)
class RunReport:
    """The outcome of one run.

    Parameters
    ----------
    command : str
        The verb: ``ingest``, ``reprocess``, ...
    run, context : str
        Ids in the catalog; empty where the verb has none.
    days : mapping of str to int
        Number of days by `DAY_COUNTS`; absent ones count as 0.
    problems : list of dict
        ``day``, ``channel``, ``cause``, ``remedy`` and ``message`` of everything that went wrong.
    outputs : list of str
        Paths of what was made, relative to the workspace where they lie in it.
    extra : dict
        Further fields of the JSON that belong to one verb alone.
    """

    command: str
    run: str = ""
    context: str = ""
    days: Mapping[str, int] = field(default_factory=dict)
    problems: list[dict[str, str]] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = set(self.days) - set(DAY_COUNTS)
        if unknown:
            raise ValueError(f"a report counts {DAY_COUNTS}, not {sorted(unknown)}")
        object.__setattr__(self, "days", {name: int(self.days.get(name, 0)) for name in DAY_COUNTS})

    @property
    def exit_code(self) -> int:
        """0 done; 1 nothing came out though something failed; 3 done, with days missing.

        A problem of cause ``partial`` is one of a day that is there.
        """
        harmless = ("no_work", "partial")
        troubled = self.days["failed"] > 0 or any(item.get("cause") not in harmless for item in self.problems)
        if not troubled:
            return DONE
        return DAYS_MISSING if self.days["done"] + self.days["unchanged"] > 0 else FAILED

    def followed_by(self, later: RunReport, command: str) -> RunReport:
        """Return one report of two steps: the later one's, with the problems of both.

        What the first step did with its own days stands under its name in `extra`, because days of the
        archive and days of products are not the same days.
        """
        first = {self.command: {"run": self.run, "days": dict(self.days)}}
        return replace(
            later,
            command=command,
            problems=[*self.problems, *later.problems],
            outputs=[*self.outputs, *later.outputs],
            extra={**later.extra, **first},
        )

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON (INTERFACES "Command line")."""
        return {
            "command": self.command,
            "run": self.run,
            "context": self.context,
            "days": dict(self.days),
            "problems": [problem("", "") | item for item in self.problems],
            "outputs": list(self.outputs),
            **self.extra,
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> RunReport:
        """Return the report that `as_json` wrote; flows return plain fields, which survive any store."""
        known = {"command", "run", "context", "days", "problems", "outputs"}
        return cls(
            **{name: fields[name] for name in known if name in fields},
            extra={name: value for name, value in fields.items() if name not in known},
        )


def problem(
    cause: str, message: str, *, day: object = "", channel: str = "", remedy: str = ""
) -> dict[str, str]:
    """Return one entry of `RunReport.problems`."""
    return {"day": str(day), "channel": channel, "cause": cause, "remedy": remedy, "message": message}


def no_work_problems(no_work: Mapping[Any, str]) -> list[dict[str, str]]:
    """Return days without a measurement as entries of `RunReport.problems`: day -> what is missing."""
    return [
        problem("no_work", message, day=day, remedy="ingest the day's files")
        for day, message in no_work.items()
    ]


def problem_of(error: InflightError, day: str = "") -> dict[str, str]:
    """Return an error as one entry of `RunReport.problems`."""
    message = f"{error.file}: {error.message}" if error.file else error.message
    return problem(error.cause, message, day=error.day or day, channel=error.channel, remedy=error.remedy)


def in_one_line(problems: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """Return problems, small findings of one kind (cause ``partial``) on several days as one of them all.

    Its ``day`` says of how many days it is, and its message has the sum of their samples.
    """
    alike: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for item in problems:
        plain = _COUNT.sub("#", item.get("message", ""))
        key = (item.get("cause", ""), item.get("instrument", ""), item.get("channel", ""), plain)
        alike.setdefault(key, []).append(item)
    out: list[dict[str, str]] = []
    for (cause, *_), same in alike.items():
        if cause != "partial" or len(same) < _ALIKE:
            out += [dict(item) for item in same]
            continue
        counts = [_COUNT.findall(one["message"]) for one in same]
        sums = [sum(map(int, each)) for each in zip(*counts, strict=True)]
        texts = _COUNT.split(same[0]["message"])
        message = "".join(f"{text}{count}" for text, count in zip(texts, [*sums, ""], strict=True))
        out.append({**same[0], "day": f"{len(same)} days", "message": message})
    return out


def print_report(report: RunReport, console: Console, details: bool = False) -> None:
    """Print a report for a person: one line of counts, a short table of problems, the outputs.

    Small findings of one kind on many days are one line, unless `details` are asked for.
    """
    from rich.markup import escape
    from rich.table import Table

    counts = ", ".join(f"{count} {in_plain_words(name)}" for name, count in report.days.items() if count)
    # Each instrument delivers its own days.
    what = "instruments' days" if report.command == "ingest" else "days"
    console.print(f"[bold]{report.command}[/bold]: {what} {counts or 'none'}", highlight=False)
    problems = report.problems if details else in_one_line(report.problems)
    shown = len(problems) if details else SHOWN_PROBLEMS
    if problems:
        table = Table(box=None, pad_edge=False)
        for name in ("day", "where", "cause", "what was found", "what to do"):
            table.add_column(name, overflow="fold", no_wrap=name in ("day", "cause"))
        for item in problems[:shown]:
            whole = problem("", "") | item
            where = ".".join(part for part in (item.get("instrument", ""), whole["channel"]) if part)
            row = (whole["day"], where, in_plain_words(whole["cause"]), whole["message"], whole["remedy"])
            table.add_row(*map(escape, row))
        console.print(table)
    if len(problems) > shown:
        console.print(f"... and {len(problems) - shown} more; --details lists all", highlight=False)
    if residual := report.extra.get("residual"):
        before, after = residual["before_nT"], residual["after_nT"]
        console.print(f"  residual {before:.3f} nT before, {after:.3f} nT after (rms)", highlight=False)
    for path in report.outputs[:SHOWN_OUTPUTS]:
        console.print(f"  {path}", highlight=False, soft_wrap=True)
    if len(report.outputs) > SHOWN_OUTPUTS:
        console.print(f"  ... and {len(report.outputs) - SHOWN_OUTPUTS} more", highlight=False)


def in_plain_words(name: str) -> str:
    """Return what a person reads for a machine's name of a count, a cause or a column."""
    return _PLAIN.get(name, name.replace("_", " "))


def to_json(fields: Mapping[str, Any]) -> str:
    """Return JSON text of a report; numbers that are not finite become null, numpy values plain ones."""
    return json.dumps(_plain(fields), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not float("-inf") < value < float("inf"):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def error_fields(error: Exception) -> Mapping[str, str]:
    """Return ``kind``, ``message``, ``remedy``, ``file``, ``channel`` and ``day`` of any error.

    One that is not an `InflightError` is a defect of the software, and the message says so.
    """
    error = as_settings_error(error)
    if isinstance(error, InflightError):
        return error.as_json()
    return {
        "kind": type(error).__name__,
        "message": f"unexpected error: {error}" if str(error) else f"unexpected {type(error).__name__}",
        "remedy": "this is a defect; run again with --debug and report what it prints",
        "file": "",
        "channel": "",
        "day": "",
    }


def as_settings_error(error: Exception) -> Exception:
    """Return pydantic's error about an option as a `SettingsError`; every other error as it is."""
    details = getattr(error, "errors", None)
    if type(error).__name__ != "ValidationError" or not callable(details):
        return error
    messages = []
    for item in details():
        place = ".".join(map(str, item["loc"])) or "settings"
        message = item["msg"].removeprefix("Value error, ")
        if item["type"].startswith("date_"):
            message = f"{str(item['input'])!r} is no date; write YYYY-MM-DD, as in 2024-03-01"
        messages.append(f"{place}: {message}")
    return SettingsError("; ".join(messages), remedy="correct the option and run the command again")


def location_of(fields: Mapping[str, str]) -> str:
    """Return where an error happened, ``file: day ..., channel '...'``; empty when nothing is known."""
    day = f"day {fields['day']}" if fields.get("day") else ""
    channel = f"channel '{fields['channel']}'" if fields.get("channel") else ""
    named = ", ".join(part for part in (day, channel) if part)
    return ": ".join(part for part in (fields.get("file", ""), named) if part)


def write_page(output: Path, page: str) -> None:
    """Write a page whole, by one rename; nothing unfinished stays where that fails."""
    output.parent.mkdir(parents=True, exist_ok=True)
    unfinished = output.with_name(f".{output.name}.{os.getpid()}.part")
    try:
        unfinished.write_text(page, encoding="utf-8")
        unfinished.replace(output)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
