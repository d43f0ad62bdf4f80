"""Errors of the whole project: what was found, what was expected, what to do.

Every error carries the fields that the command line prints with ``--json``; a message names file,
channel and day wherever they are known.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` with the known name most like a wrong one, else nothing."""
    import difflib

    by_plain = {one.lower(): one for one in known}
    alike = difflib.get_close_matches(name.lower(), list(by_plain), n=1, cutoff=0.6)
    return f"; did you mean '{by_plain[alike[0]]}'?" if alike else ""


class InflightError(Exception):
    """Base of all errors raised on purpose.

    Parameters
    ----------
    message : str
        What was found and what was expected.
    remedy : str
        What the user can do about it.
    file, channel, day : str
        Where it happened, as far as known.
    """

    #: Which of the catalog's causes a failed day gets (no_work, repeatable, partial, bug, transient).
    cause = "repeatable"

    def __init__(
        self, message: str, *, remedy: str = "", file: str = "", channel: str = "", day: str = ""
    ) -> None:
        super().__init__(message)
        self.message, self.remedy, self.file, self.channel, self.day = message, remedy, file, channel, day

    def __str__(self) -> str:
        place = ": ".join(
            text
            for text in (
                self.file,
                f"day {self.day}" if self.day else "",
                f"channel '{self.channel}'" if self.channel else "",
            )
            if text
        )
        text = f"{place}: {self.message}" if place else self.message
        return f"{text}; {self.remedy}" if self.remedy else text

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle whole, because errors travel from Dask workers."""
        return _rebuild, (type(self), self.__dict__)

    def as_json(self) -> dict[str, str]:
        """Return the fields of the command line's error object."""
        return {
            "kind": type(self).__name__,
            "message": self.message,
            "remedy": self.remedy,
            "file": self.file,
            "channel": self.channel,
            "day": self.day,
        }


def _rebuild(kind: type[InflightError], state: dict[str, Any]) -> InflightError:
    error = kind(state["message"])
    error.__dict__.update(state)
    return error


class MissionError(InflightError, ValueError):
    """A mission YAML is wrong: `file` and the message name line and key."""


class ModelError(InflightError, ValueError):
    """A model is inconsistent, or asks for a channel or sensor that is not there."""


class SamplesError(InflightError, ValueError):
    """Samples are missing, misaligned or carry the wrong unit or shape."""


class ReadError(InflightError, OSError):
    """A delivered file cannot be read: truncated, empty, or of another format."""


class ContentError(InflightError, ValueError):
    """A delivered file was read, but a variable, unit or shape is not what the mission YAML says."""


class ClashError(ContentError):
    """Two deliveries give different values for one time."""


class CatalogError(InflightError, RuntimeError):
    """The catalog cannot do what was asked: unknown dataset, overlapping validity, damaged store."""


class ValidityError(CatalogError, ValueError):
    """Two certified tables of one name would be valid at one time."""


class IntegrityError(CatalogError, OSError):
    """A store does not match its manifest, or was not written whole."""


class StorageError(CatalogError, OSError):
    """The disk refused a write; nothing was published."""

    cause = "transient"


class WorkerError(InflightError, RuntimeError):
    """The processes that did the work ended before it was done."""

    cause = "transient"


class WorkspaceError(CatalogError, FileNotFoundError):
    """The folder is no workspace, or already is one."""


class SettingsError(InflightError, ValueError):
    """Parameters of a run make no sense together or for this mission."""


class ConformanceError(InflightError, AssertionError):
    """A plug-in does not keep its contract; the message lists every failed check and what to mend."""


class CalibrationError(InflightError, ArithmeticError):
    """A fit cannot be made from the data given."""


class TooLittleError(CalibrationError):
    """A record is too short or too quiet to determine what is asked for; it is not contradicted."""
