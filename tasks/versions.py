"""The versions of a workspace's models: found by name, listed with the one in use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from inflight.catalog import Catalog, ModelRecord
from inflight.effects.naming import did_you_mean
from inflight.errors import CatalogError, SettingsError
from inflight.mission import Mission
from inflight.tasks.models import find_model


def comparison_of(mission: Mission, named: str | None) -> str:
    """Return the comparison that is named, else ``main``, else the mission's first.

    Raises
    ------
    SettingsError
        When the mission has no such comparison.
    """
    name = named or ("main" if "main" in mission.comparisons else next(iter(mission.comparisons), "main"))
    if name not in mission.comparisons:
        raise SettingsError(
            f"comparison: the mission has no {name!r}{did_you_mean(name, mission.comparisons)}",
            remedy=f"it has {', '.join(mission.comparisons) or 'none'}",
        )
    return name


@dataclass(frozen=True)
class Version:
    """A text of a model, and what the catalog knows of it."""

    name: str
    version: int
    text: str
    record: ModelRecord | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """Name, version and parent; version and parent are None for a model not used yet."""
        parent = self.record.parent if self.record else None
        return {"name": self.name, "version": self.version or None, "parent": parent}

    @property
    def told(self) -> str:
        """How a person calls it."""
        return f"{self.name} version {self.version}" if self.version else f"{self.name}, not used yet"


class Versions:
    """The models of a workspace; nothing is saved by looking at them."""

    def __init__(self, cat: Catalog, mission: Mission, comparison: str = "main") -> None:
        self._cat = cat
        used = find_model(cat, mission, comparison)
        self._records = {(record.name, record.version): record for record in self._cat.models()}
        self.used = self._version(used.model.name, used.version, used.text)

    def _version(self, name: str, version: int, text: str) -> Version:
        return Version(name, version, text, self._records.get((name, version)))

    def named(self, text: str | None) -> Version:
        """Return the version a person names: its number, a name's newest, or ``name:number``."""
        if text is None:
            return self.used
        name, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        if not number.isdigit():
            name, number = text, ""
        name = name or self.used.name
        known = [key for key in self._records if key[0] == name and number in ("", str(key[1]))]
        if not known:
            listed = [f"{one}:{version}" for one, version in self._records]
            names = [one for one, _ in self._records]
            raise CatalogError(
                f"there is no model {text!r}{did_you_mean(text, [*listed, *names])}",
                remedy=f"the catalog has {', '.join(listed) or 'none yet; reprocess saves the first'}",
            )
        return self._version(*self._cat.model_text(*known[-1]))

    def items(self) -> list[dict[str, Any]]:
        """Return every version, oldest first, with a mark at the one in use."""
        return [
            {
                "name": record.name,
                "version": record.version,
                "parent": record.parent,
                "message": record.message,
                "created": record.created,
                "sha256": record.sha256,
                "used": key == (self.used.name, self.used.version),
            }
            for key, record in self._records.items()
        ]
