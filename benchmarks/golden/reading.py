"""Reading what a record holds into one form: named values, without what differs from run to run.

What is left out, and why, stands here and nowhere else.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

#: Keys of printed objects that differ between two runs of the same software.
LEFT_OUT = frozenset(
    {
        "created",  # when a version of a model was saved
    }
)
#: The same, by the whole path in what a command printed: elsewhere the word means something else.
LEFT_OUT_PATHS = frozenset(
    {
        "printed.seconds",  # how long the demo took
    }
)
#: What differs inside texts, by what it is. Ids of runs hold the time of day and a random part, and so do the
#: folders named after them; Bokeh draws a uuid for each figure. Fingerprints (of a model's text, of all that
#: a day was made from) follow how a thing is written down, not what it says; what they are made from is
#: compared itself.
_MASKS = (
    (re.compile(r"\b\d{8}T\d{6}-[a-z]+-[0-9a-f]{8}\b"), "<run>"),
    (re.compile(r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b"), "<uuid>"),
    # With a letter in it: a run of digits is a number, or a time.
    (re.compile(r"\b(?=[0-9]*[a-f])[0-9a-f]{16,64}\b"), "<hash>"),
)
#: Working stores of the software: how it keeps its equations is its own affair.
_OWN_STORES = ("equations/",)


@dataclass
class Figure:
    """What a reader sees of one figure: its words in order, and its numbers."""

    words: list[str] = field(default_factory=list)
    numbers: list[np.ndarray] = field(default_factory=list)


@dataclass
class Page:
    """Lines of text, and the figures in order."""

    lines: list[str]
    figures: list[Figure]


@dataclass
class Table:
    """One dataset: arrays by name, their dimensions, and the attributes of all."""

    values: dict[str, np.ndarray]
    dims: dict[str, list[str]]
    attributes: dict[str, Any]

    def unit(self, name: str) -> str:
        """Return the unit of a variable, empty when none is stated."""
        return str(self.attributes.get(name, {}).get("units", ""))


def masked(text: str) -> str:
    """Return a text with ids of runs, fingerprints and uuids named by what they are."""
    for pattern, name in _MASKS:
        text = pattern.sub(name, text)
    return text


def without_the_run(value: Any, path: str = "") -> Any:
    """Return a printed object without what differs from run to run."""
    if isinstance(value, dict):
        masked_entries = {}
        for key, held in value.items():
            inside = f"{path}.{key}".lstrip(".")
            if key not in LEFT_OUT and inside not in LEFT_OUT_PATHS:
                masked_entries[masked(key)] = without_the_run(held, inside)
        return masked_entries
    if isinstance(value, list):
        return [without_the_run(held, f"{path}[]") for held in value if not _is_own_store(held)]
    return masked(value) if isinstance(value, str) else value


def _is_own_store(value: Any) -> bool:
    return isinstance(value, dict) and str(value.get("dataset", "")).startswith(_OWN_STORES)


def read_json(path: Path) -> Any:
    """Return what a command printed."""
    return without_the_run(json.loads(path.read_text(encoding="utf-8")))


def read_table(path: Path) -> Table:
    """Return a dataset that `export` wrote."""
    with zipfile.ZipFile(path) as archive:
        about = json.loads(archive.read("about.json"))
        values = {}
        for name in archive.namelist():
            if name.endswith(".npy"):
                with archive.open(name) as file:
                    values[name.removesuffix(".npy")] = np.lib.format.read_array(file, allow_pickle=False)
    stored = about["variables"]
    attributes = {name: without_the_run(stored[name]["attributes"]) for name in sorted(stored)}
    own = without_the_run(about["attributes"])
    return Table(values, {name: stored[name]["dims"] for name in stored}, {"": own} | attributes)


# --- pages ---------------------------------------------------------------------------------------------

_SCRIPT = re.compile(r"<(script|style)\b[^>]*>.*?</\1>", re.DOTALL)
_TAG = re.compile(r"<[^>]+>")
_BREAK = re.compile(r"</?(?:p|div|tr|li|h\d|table|summary|title|section|ol|ul)\b[^>]*>")
_DOCUMENT = re.compile(r"const docs_json = '(.*?)';\n", re.DOTALL)
#: Attributes of a figure that are words a reader sees.
_WORDS = ("text", "axis_label", "title")
_GZIP = b"\x1f\x8b"


def read_page(path: Path) -> Page:
    """Return the text of a page, and what its figures show."""
    source = path.read_text(encoding="utf-8")
    figures = [_figure(json.loads(_unescaped(found))) for found in _DOCUMENT.findall(source)]
    body = _BREAK.sub("\n", _SCRIPT.sub("", source).replace("\n", " "))
    lines = (masked(" ".join(html.unescape(_TAG.sub(" ", line)).split())) for line in body.split("\n"))
    return Page([line for line in lines if line], figures)


def _unescaped(text: str) -> str:
    """Undo what a JavaScript string adds to JSON."""
    return text.replace("\\'", "'").replace("\\\\", "\\")


def _figure(document: Any) -> Figure:
    figure = Figure()
    for key, value in _walk(document, ""):
        if isinstance(value, np.ndarray):
            figure.numbers.append(value)
        elif key in _WORDS and isinstance(value, str):
            figure.words.append(masked(value))
    return figure


def _walk(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Yield words and arrays of a Bokeh document in its order."""
    if isinstance(value, dict):
        if value.get("type") == "ndarray":
            yield key, _decoded(value)
        elif value.get("type") == "value" and key == "label":
            yield "text", value.get("value")
        else:
            for name, held in value.items():
                yield from _walk(held, name)
    elif isinstance(value, list):
        numbers = [one for one in value if isinstance(one, int | float)]
        if value and len(numbers) == len(value):
            yield key, np.asarray(value, dtype=np.float64)
        elif value and all(isinstance(one, str) for one in value):
            yield from (("text", one) for one in value)
        else:
            for held in value:
                yield from _walk(held, key)
    else:
        yield key, value


def _decoded(held: dict[str, Any]) -> np.ndarray:
    """Return an array of a Bokeh document."""
    inside = held["array"]
    if isinstance(inside, list):
        return np.asarray(inside, dtype=np.float64 if held["dtype"] != "object" else str)
    raw = inside["data"] if isinstance(inside, dict) else inside
    data = base64.b64decode(raw)
    data = gzip.decompress(data) if data.startswith(_GZIP) else data
    return np.frombuffer(data, dtype=held["dtype"]).reshape(held["shape"])
