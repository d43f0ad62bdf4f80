"""A picture of what leads to what: boxes in columns, from left to right, joined by curves; without scripts.

In go boxes and arrows between them; out comes an SVG as text, always the same for the same boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from textwrap import shorten

from inflight.figures.text import render

#: Width and height of a box, gaps between columns and between boxes, pixels, and letters on a line.
_WIDTH, _HEIGHT, _GAP, _SPACE, _LETTERS = 250, 66, 70, 16, 38
#: Height that a curve takes which passes a column.
_PASS = 12
_MARGIN, _HEAD = 20, 50
#: Times that the boxes are put in the order of their neighbours.
_SWEEPS = 4


@dataclass(frozen=True)
class Box:
    """A box: its title, what it is, a line of text, its border's colour; `tip` is shown under the mouse."""

    title: str
    kind: str
    text: str
    colour: str
    tip: str = ""
    marked: bool = False


@dataclass(frozen=True)
class Arrow:
    """From box to box, by their places; `text` is shown at its middle."""

    start: int
    end: int
    text: str = ""


def graph_picture(title: str, boxes: Sequence[Box], arrows: Sequence[Arrow]) -> str:
    """Return boxes and arrows as an SVG; every arrow goes to the right, but for one that closes a circle."""
    layers = _layers(len(boxes), arrows)
    columns: list[list[int]] = [[] for _ in range(max(layers, default=0) + 1)]
    for node, layer in enumerate(layers):
        columns[layer].append(node)
    paths = []
    count = len(boxes)
    for arrow in arrows:
        between = range(layers[arrow.start] + 1, layers[arrow.end])
        # A curve keeps a place of its own in each column that it passes.
        passed = list(range(count, count + len(between)))
        count += len(passed)
        for layer, node in zip(between, passed, strict=True):
            columns[layer].append(node)
        paths.append([arrow.start, *passed, arrow.end])
    _order(columns, paths)
    heights = [_HEIGHT if node < len(boxes) else _PASS for node in range(count)]
    tall = max(_length(column, heights) for column in columns)
    middle, left = [0.0] * count, [0] * count
    for layer, column in enumerate(columns):
        top = _HEAD + (tall - _length(column, heights)) / 2
        for node in column:
            middle[node] = top + heights[node] / 2
            left[node] = _MARGIN + layer * (_WIDTH + _GAP)
            top += heights[node] + _SPACE
    drawn = [
        {
            "x": left[node],
            "y": f"{middle[node] - _HEIGHT / 2:.1f}",
            "title": shorten(box.title, _LETTERS - 4, placeholder="…"),
            "kind": shorten(box.kind, _LETTERS, placeholder="…"),
            "text": _cut(box.text),
            "tip": box.tip or f"{box.title}: {box.text}",
            "colour": box.colour,
            "marked": box.marked,
        }
        for node, box in enumerate(boxes)
    ]
    curves = [
        {
            "path": _curve([(left[node], middle[node], node < len(boxes)) for node in path]),
            "text": arrow.text,
            "x": left[path[1]] - 4,
            "y": f"{middle[path[1]] - 5:.1f}",
        }
        for path, arrow in zip(paths, arrows, strict=True)
    ]
    return (
        str(
            render(
                "graph.svg",
                title=title,
                boxes=drawn,
                curves=curves,
                width=2 * _MARGIN + len(columns) * _WIDTH + (len(columns) - 1) * _GAP,
                height=f"{_HEAD + tall + _MARGIN:.0f}",
                box=(_WIDTH, _HEIGHT),
            )
        )
        + "\n"
    )


def _layers(count: int, arrows: Sequence[Arrow]) -> list[int]:
    """Return the column of each box: one behind the last of those that lead to it."""
    layers = [0] * count
    for _ in range(count):
        moved = False
        for arrow in arrows:
            # A circle would push its boxes on for ever: no column lies behind the last box.
            if arrow.start != arrow.end and layers[arrow.end] <= layers[arrow.start] < count - 1:
                layers[arrow.end] = layers[arrow.start] + 1
                moved = True
        if not moved:
            break
    # Inputs stand directly before what they lead to.
    for node in sorted(range(count), key=lambda one: -layers[one]):
        ends = [layers[arrow.end] for arrow in arrows if arrow.start == node]
        if ends and min(ends) > layers[node]:
            layers[node] = min(ends) - 1
    return layers


def _order(columns: list[list[int]], paths: Sequence[Sequence[int]]) -> None:
    """Put the boxes of each column in the order of the mean place of their neighbours (Sugiyama 1981)."""
    before: dict[int, list[int]] = {}
    after: dict[int, list[int]] = {}
    for path in paths:
        for one, other in pairwise(path):
            before.setdefault(other, []).append(one)
            after.setdefault(one, []).append(other)
    for sweep in range(_SWEEPS):
        neighbours = (before, after)[sweep % 2]
        place = {node: at / max(len(column), 1) for column in columns for at, node in enumerate(column)}
        for column in columns if sweep % 2 == 0 else reversed(columns):
            mean = {
                node: sum(place[one] for one in near) / len(near)
                if (near := neighbours.get(node))
                else place[node]
                for node in column
            }
            column.sort(key=lambda node: (mean[node], place[node]))
            place |= {node: at / max(len(column), 1) for at, node in enumerate(column)}


def _length(column: Sequence[int], heights: Sequence[int]) -> float:
    return sum(heights[node] + _SPACE for node in column) - _SPACE if column else 0


def _cut(text: str) -> list[str]:
    """Return a text on at most two lines."""
    words, lines = text.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) >= _LETTERS and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return [shorten(" ".join(part), _LETTERS + 2, placeholder="…") for part in (lines[:1], lines[1:]) if part]


def _curve(points: Sequence[tuple[int, float, bool]]) -> str:
    """Return a smooth path from the right side of the first box to the left side of the last one."""
    (x, y, _), *rest = points
    x += _WIDTH
    path = f"M{x},{y:.1f}"
    for left, middle, is_box in rest:
        half = (left - x) / 2
        path += f"C{x + half:.0f},{y:.1f} {left - half:.0f},{middle:.1f} {left - 6 * is_box},{middle:.1f}"
        x, y = left, middle
        if not is_box:
            path += f"H{left + _WIDTH}"
            x += _WIDTH
    return path
