"""Errors as they are told to a person: by the command line and by the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from inflight.errors import InflightError, SettingsError


def told_error(error: Exception) -> Mapping[str, str]:
    """Return ``kind``, ``message``, ``remedy``, ``file``, ``channel`` and ``day`` of any error.

    One that is not an `InflightError` is a defect of the software, and told as one.
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
    """Return pydantic's complaint about an option as ours; every other error as it is."""
    complaints = getattr(error, "errors", None)
    if type(error).__name__ != "ValidationError" or not callable(complaints):
        return error
    told = "; ".join(_complaint(item) for item in complaints())
    return SettingsError(told, remedy="correct the option and run the command again")


def _complaint(item: Mapping[str, Any]) -> str:
    place = ".".join(map(str, item["loc"])) or "settings"
    if item["type"].startswith("date_"):
        return f"{place}: {str(item['input'])!r} is no date; write YYYY-MM-DD, as in 2024-03-01"
    return f"{place}: {item['msg'].removeprefix('Value error, ')}"


def place_of(fields: Mapping[str, str]) -> str:
    """Return where an error happened, ``file: day ..., channel '...'``; empty when nothing is known."""
    day = f"day {fields['day']}" if fields.get("day") else ""
    channel = f"channel '{fields['channel']}'" if fields.get("channel") else ""
    named = ", ".join(part for part in (day, channel) if part)
    return ": ".join(part for part in (fields.get("file", ""), named) if part)
