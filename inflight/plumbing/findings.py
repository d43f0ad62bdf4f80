"""What a test of plumbing tells: the fault in plain words, how sure it is, the YAML lines that mend it.

A `Finding` holds all of it, a `Remedy` the lines; `Remedy.applied` puts them into a mission's text.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ruamel.yaml import YAML

from inflight.mission import Mission
from inflight.time import utc_text


@dataclass(frozen=True)
class Remedy:
    """Lines of a mission YAML that mend a fault.

    Attributes
    ----------
    words : str
        What is the case when it is the right one.
    lines : tuple of (tuple of str, str)
        Keys from the outermost in, and the value as YAML writes it.
    """

    words: str
    lines: tuple[tuple[tuple[str, ...], str], ...]

    @property
    def text(self) -> str:
        """The lines with their keys joined by points."""
        return "; ".join(f"{'.'.join(path)}: {value}" for path, value in self.lines)

    def applied(self, text: str) -> str:
        """Return a mission's YAML text with the lines in it."""
        yaml = YAML(typ="rt")
        tree = yaml.load(text)
        for path, value in self.lines:
            node: Any = tree
            for key in path[:-1]:
                node = node.setdefault(key, {})
            node[path[-1]] = YAML(typ="safe").load(value)
        out = io.StringIO()
        yaml.dump(tree, out)
        return out.getvalue()


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault of plumbing.

    Attributes
    ----------
    fault : str
        ``unit``, ``clock``, ``axes``, ``attitude``, ``exchanged`` or ``stale``.
    words : str
        What is wrong: instrument, channel, axes.
    instrument, channel : str
        Of the likeliest explanation.
    axes : tuple of str
    start, end : int
        TT2000 of the first and last sample that shows it.
    how_sure : str
        How much better the data agree, against what scatter.
    p : float
        Chance of it in a record without a fault.
    before, after : float
        The number that shows it, as stated and mended.
    unit : str
        Of these.
    remedies : tuple of Remedy
        The likeliest first; all others explain the data as well.
    """

    fault: str
    words: str
    instrument: str
    channel: str
    start: int
    end: int
    how_sure: str
    p: float
    before: float
    after: float
    unit: str = "nT"
    axes: tuple[str, ...] = ()
    remedies: tuple[Remedy, ...] = ()

    @property
    def sure(self) -> bool:
        """True when one explanation is left."""
        return len(self.remedies) == 1

    @property
    def sentence(self) -> str:
        """What is wrong, how sure that is, and the lines that mend it."""
        span = f"{utc_text(self.start)[:16]} to {utc_text(self.end)[:16]}"
        text = f"{self.words} ({span}): {self.how_sure}."
        if not self.remedies:
            return text
        if self.sure:
            return f"{text} Line of the mission YAML that mends it: {self.remedies[0].text}"
        rest = "; or, ".join(f"if {one.words}: {one.text}" for one in self.remedies)
        return f"{text} These data cannot tell which, and so which line of the mission YAML mends it: {rest}"

    def as_json(self) -> Mapping[str, Any]:
        """Return the fields as the command line prints them."""
        return {
            **{name: value for name, value in vars(self).items() if name != "remedies"},
            "start": utc_text(self.start),
            "end": utc_text(self.end),
            "sure": self.sure,
            "sentence": self.sentence,
            "remedies": [{"words": one.words, "yaml": one.text} for one in self.remedies],
        }


def channel_path(instrument: str, channel: str, *keys: str) -> tuple[str, ...]:
    """Return the keys of an entry of a channel."""
    return ("instruments", instrument, "channels", channel, *keys)


def clock_lines(mission: Mission, instrument: str, seconds: float) -> tuple[tuple[tuple[str, ...], str], ...]:
    """Return the lines that add seconds to the stamps of an instrument, and of no other one."""
    lines = []
    for name, one in mission.instruments.items():
        present = mission.files(name).clock_offset
        own = name == instrument
        # Who takes this instrument's files takes its clock, too, unless it states one.
        if own or (one.files.same_as == instrument and "clock_offset" not in one.files.model_fields_set):
            steps = [(step.since, step.offset / 1e9 + (seconds if own else 0.0)) for step in present]
            steps = steps or [(None, seconds if own else 0.0)]
            if len(steps) == 1 and steps[0][0] is None:
                value = f"{steps[0][1]:.10g} s"
            else:
                listed = [
                    (f"since: {utc_text(since)}, " if since is not None else "") + f"offset: {offset:.10g} s"
                    for since, offset in steps
                ]
                value = "[" + ", ".join(f"{{{one}}}" for one in listed) + "]"
            lines.append((("instruments", name, "files", "clock_offset"), value))
    return tuple(sorted(lines, key=lambda line: line[0][1] != instrument))
