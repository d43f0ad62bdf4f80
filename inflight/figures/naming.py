"""Short names for places too narrow for whole ones."""

from __future__ import annotations

import re
from collections.abc import Sequence

from inflight.lines import told_period

_FIELD = re.compile(r"channel_(field|rate|scale)\((?P<channel>.*)\)(?P<rest>(@.*)?)$")
_LAG = re.compile(r"@lag=([0-9.e+-]+)s")
_WIDTH = re.compile(r"@width=([0-9.e+-]+)")
_STAMP = re.compile(r"([@/])(\d{4}-\d\d-\d\d)T(\d\d:\d\d)(:\d\d)?[0-9.]*")
_WORDS = {"scale_factor": "scale", "misalignment": "angle", "coefficient": ""}
_KIND = {"field": "", "rate": "rate of ", "scale": "scale by "}


def short_name(name: str) -> str:
    """Return the name of a candidate as a person says it: ``battery_current, lag 40 s``."""
    found = _FIELD.match(name)
    said = f"{_KIND[found[1]]}{found['channel']}{found['rest']}" if found else name
    said = _LAG.sub(lambda lag: f", lag {told_period(float(lag[1]))}", said)
    said = _WIDTH.sub(lambda width: f", width {float(width[1]):g}", said)
    return _STAMP.sub(_told_stamp, said)


def _told_stamp(stamp: re.Match[str]) -> str:
    """Return a time with as much of the clock as it needs."""
    seconds = stamp[4] if stamp[4] not in (None, ":00") else ""
    clock = f" {stamp[3]}{seconds}" if seconds or stamp[3] != "00:00" else ""
    return f"{' ' if stamp[1] == '@' else ' to '}{stamp[2]}{clock}"


def short_parameter(name: str) -> str:
    """Return a parameter without the name of a lone sensor, its effect's name shortened."""
    effect, _, parameter = name.rpartition(".")
    parameter = bare_parameter(parameter)
    if effect in ("", "vector_sensor"):
        return parameter
    drift = effect.split(".")
    if len(drift) > 1 and drift[-1] == "vector_sensor":
        return f"{short_name(drift[0])} {parameter}"
    return f"{short_name(effect)} {parameter}"


def bare_parameter(name: str) -> str:
    """Return ``scale_factor[x]`` as ``scale x``, and a coefficient as its axis alone."""
    kind, _, axis = name.partition("[")
    return f"{_WORDS.get(kind, kind)} {axis.rstrip(']')}".strip() or kind


def distinct(names: Sequence[str]) -> list[str]:
    """Return the names, those that come again with marks that are not seen: axes of names want each once."""
    return [name + "\u200b" * list(names[:place]).count(name) for place, name in enumerate(names)]
