"""Delivered files by the patterns of a mission YAML, and the dates and versions in their names.

A pattern is a path below the data folder with ``*`` and ``?`` (within one folder level) and date fields
``{day:%Y%m%d}``, ``{start:...}``, ``{end:...}``; upper and lower case are the same. A wildcard behind
``v``, ``r``, ``rev``, ``ver`` or ``version`` is a version: of files whose names carry a date and differ in
it alone, the last in natural order (v9 before v10) is the newest, the others are superseded. Files that
differ in another wildcard are parts of a delivery: all of them are used.
"""

from __future__ import annotations

import datetime as dt
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import lru_cache
from pathlib import Path

import numpy as np

from inflight.instruments import Files
from inflight.time import DAY, SECOND, as_day, to_tt2000, to_utc

_DIRECTIVE = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    "m": r"\d{1,2}",
    "d": r"\d{1,2}",
    "j": r"\d{3}",
    "H": r"\d{2}",
    "M": r"\d{2}",
    "S": r"\d{2}",
    "b": r"[a-z]{3}",
    "B": r"[a-z]+",
}
_TOKEN = re.compile(r"\{(day|start|end):([^{}]*)\}|(\*\*/|\*|\?)")
_VERSION_MARK = re.compile(r"(?:^|[_.\-/])(?:v|r|rev|ver|version)$", re.IGNORECASE)
#: Names that are compared with a pattern that matches nothing, at most, and how alike one must be; assumed.
_NAMES_COMPARED, _ALIKE = 5000, 0.6
#: What the last directive of a date leaves open: a file "of 1 May" ends when the day does.
_LENGTH = {"H": 3600 * SECOND, "M": 60 * SECOND, "S": SECOND}


@dataclass(frozen=True)
class NameSpan:
    """The half-open TT2000 span a file's name states; None where it states none."""

    start: int | None = None
    end: int | None = None

    @property
    def day(self) -> np.datetime64 | None:
        """The UTC day the name gives, its first one."""
        inside = self.start if self.start is not None else None if self.end is None else self.end - 1
        return None if inside is None else as_day(str(to_utc(inside)))


@dataclass(frozen=True)
class Delivered:
    """One delivered file: its path below the data folder, and what its name states."""

    name: str
    span: NameSpan
    #: Equal for versions of one delivery; empty when the name carries no date.
    family: tuple[str, ...]
    #: Natural order of what the wildcards matched.
    version: tuple[tuple[int, int, str], ...]


@dataclass(frozen=True)
class _Compiled:
    regex: re.Pattern[str]
    root: str
    #: For each group: a field and a directive, ("*", "") or, for a wildcard that is a version, ("v", "").
    groups: tuple[tuple[str, str], ...]


@lru_cache(maxsize=256)
def _compile(pattern: str) -> _Compiled:
    groups: list[tuple[str, str]] = []
    text, at = "", 0
    for token in _TOKEN.finditer(pattern):
        text += re.escape(pattern[at : token.start()])
        before, at = at, token.end()
        field, layout, wildcard = token.groups()
        if wildcard:
            text += {"**/": "((?:.*/)?)", "*": "([^/]*)", "?": "([^/])"}[wildcard]
            mark = pattern[before : token.start()]
            is_version = bool(_VERSION_MARK.search(mark)) or (not mark and groups[-1:] == [("v", "")])
            groups.append(("v" if is_version else "*", ""))
        else:
            text += _layout_regex(layout)
            groups += [(field, directive) for directive in re.findall(r"%(.)", layout)]
    text += re.escape(pattern[at:])
    first = _TOKEN.search(pattern)
    root = os.path.dirname(pattern[: first.start()] if first else pattern)  # noqa: PTH120  part of a pattern
    return _Compiled(re.compile(text, re.IGNORECASE), root, tuple(groups))


def _layout_regex(layout: str) -> str:
    """Return the regex of a strftime layout; a day or month may have one digit only where it stands alone."""
    text, pieces = "", re.split(r"(%.)", layout)
    for index, piece in enumerate(pieces):
        if index % 2 == 0:
            text += re.escape(piece)
            continue
        crowded = index > 1 and pieces[index - 1] == ""
        crowded = crowded or (pieces[index + 1] == "" and index + 2 < len(pieces))
        known = _DIRECTIVE[piece[1]]
        text += f"({known.replace('{1,2}', '{2}') if crowded else known})"
    return text


def parse_name(name: str, files: Files) -> Delivered | None:
    """Return what the name of a file states: span, family, version; None when no pattern matches it.

    The name is a path below the data folder, with ``/``.

    A name whose digits are no date (``20230231``) does not match.
    """
    for number, pattern in enumerate(files.pattern or []):
        compiled = _compile(pattern)
        match = compiled.regex.fullmatch(name)
        if not match:
            continue
        dates: dict[str, list[tuple[str, str]]] = {}
        wild: dict[str, list[str]] = {"*": [], "v": []}
        for (field, directive), text in zip(compiled.groups, match.groups(), strict=True):
            if field in wild:
                wild[field].append(text)
            elif (directive, text) not in (texts := dates.setdefault(field, [])):
                texts.append((directive, text))
        try:
            span = _span(dates)
        except ValueError:
            continue
        dated = [
            f"{field}{directive}{text.lower()}" for field, texts in dates.items() for directive, text in texts
        ]
        family = (str(number), *dated, *(text.lower() for text in wild["*"])) if dated else ()
        return Delivered(name, span, family, tuple(part for text in wild["v"] for part in natural_key(text)))
    return None


def find_files(data: Path, files: Files) -> tuple[list[Delivered], dict[str, str]]:
    """Return the newest versions of all files that match, in order of time, and which name superseded which.

    Parameters
    ----------
    data : Path
        Folder that the patterns start from.
    files : Files
        The instrument's files, with `pattern` set.
    """
    return newest_versions(
        found for name in sorted(_walk(data, files)) if (found := parse_name(name, files)) is not None
    )


def folder_of_delivery(path: Path, files: Files) -> Path | None:
    """Return the folder that a file's path below it matches a pattern from; None when no pattern does."""
    for pattern in files.pattern or []:
        depth = len(Path(pattern).parts)
        folders = path.parents[:depth] if "**" not in pattern else path.parents
        for folder in reversed(folders):
            if parse_name(path.relative_to(folder).as_posix(), files) is not None:
                return folder
    return None


def nearest_names(data: Path, files: Files, most: int = 3) -> list[str]:
    """Return the names below a folder that are most like what no file matches: the patterns."""
    wanted = [_TOKEN.sub("", pattern) for pattern in files.pattern or []]
    names = [
        (Path(folder).relative_to(data) / name).as_posix()
        for folder, _, found in os.walk(data)
        for name in found
        if not name.startswith(".")
    ]

    def likeness(name: str) -> float:
        plain = re.sub(r"\d{4,}", "", name)
        return max(SequenceMatcher(None, plain, one).ratio() for one in wanted)

    ranked = sorted(names[:_NAMES_COMPARED], key=lambda name: (-likeness(name), name)) if wanted else []
    return [name for name in ranked[:most] if likeness(name) > _ALIKE]


def pattern_for(name: str) -> str:
    """Return a pattern that a file's name matches: its date by ``{day}``, its version by ``*``.

    Empty when the name has no date of eight digits, with or without dashes or a day of the year.
    """
    for text, form in (
        (r"(?<!\d)(?:19|20)\d{6}(?!\d)", "%Y%m%d"),
        (r"(?<!\d)(?:19|20)\d{2}-\d{2}-\d{2}(?!\d)", "%Y-%m-%d"),
        (r"(?<!\d)(?:19|20)\d{5}(?!\d)", "%Y%j"),
    ):
        if (found := re.search(text, name)) is not None:
            dated = f"{name[: found.start()]}{{day:{form}}}{name[found.end() :]}"
            return re.sub(r"_v[\d.]*\d", "_v*", dated)
    return ""


def newest_versions(found: Iterable[Delivered]) -> tuple[list[Delivered], dict[str, str]]:
    """Keep the last version of each family; return them in order of time, and old name -> new name."""
    newest: dict[tuple[str, ...], Delivered] = {}
    superseded: dict[str, str] = {}
    for file in found:
        key = file.family or (file.name,)
        other = newest.get(key)
        if other is None:
            newest[key] = file
            continue
        old, new = sorted((other, file), key=lambda each: (each.version, each.name))
        superseded = {name: new.name if by == old.name else by for name, by in superseded.items()}
        superseded[old.name], newest[key] = new.name, new

    def place(each: Delivered) -> tuple[int, tuple[tuple[int, int, str], ...]]:
        stated = [at for at in (each.span.start, each.span.end) if at is not None]
        return stated[0] if stated else -(2**63), natural_key(each.name)

    return sorted(newest.values(), key=place), superseded


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key under which v9 comes before v10."""
    return tuple(
        (1, int(part), part) if part.isdigit() else (0, 0, part.lower())
        for part in re.split(r"(\d+)", text)
        if part
    )


def _walk(data: Path, files: Files) -> Iterator[str]:
    """Yield the paths below the data folder that some pattern could match, each once."""
    roots = {_compile(pattern).root for pattern in files.pattern or []}
    seen: set[str] = set()
    for root in sorted(roots):
        for folder, _, names in os.walk(data / root):
            below = Path(folder).relative_to(data).as_posix()
            for name in names:
                path = name if below == "." else f"{below}/{name}"
                if path not in seen:
                    seen.add(path)
                    yield path


def _span(found: dict[str, list[tuple[str, str]]]) -> NameSpan:
    if "day" in found:
        return NameSpan(*_interval(found["day"]))
    start = _interval(found["start"])[0] if "start" in found else None
    end = _interval(found["end"])[1] if "end" in found else None
    return NameSpan(start, end)


def _interval(texts: list[tuple[str, str]]) -> tuple[int, int]:
    """Return the TT2000 span of one date in a name; a directive that states two values is no date."""
    directives = [directive for directive, _ in texts]
    if len(set(directives)) != len(directives):
        raise ValueError(f"two dates in one name: {texts}")
    stamp = dt.datetime.strptime(
        " ".join(text for _, text in texts), " ".join(f"%{directive}" for directive in directives)
    )
    start = int(to_tt2000(np.datetime64(stamp, "ns")))
    finest = next((directive for directive in "SMH" if directive in directives), "")
    if finest:
        return start, start + _LENGTH[finest]
    return start, int(to_tt2000(np.datetime64(stamp, "ns") + np.timedelta64(DAY, "ns")))
