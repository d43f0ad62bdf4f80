"""Effects whose values over time are a stored table: which table, and the entry of the model that takes it.

In goes what `inflight add` was given; out comes an entry whose parameters of time ``table`` name one table
for good, by its key (`stored_entry`). What a reprocessing finds later changes no model: `inflight set` takes
the newest table. The tables are those of the whole-mission fit; any other by axis and interval serves, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from inflight.catalog import Catalog
from inflight.diagnosis import parse_entry
from inflight.errors import CatalogError
from inflight.mission import Mission, sensors_of
from inflight.tasks.models import find_table
from inflight.tasks.pipelines.base import table_label

#: Entries by the name that a user adds them by; tables without the comparison.
STORED_EFFECTS: dict[str, dict[str, Any]] = {
    # Yin (2010), eq. 3.6: what an offset along z of the vector sensor makes of the residual's spread.
    "z_offset": {"effect": "remanent", "vector": {"time": "table", "table": "z-offset"}},
    # 3.4.4; CHAMP's test on ground told 7.1 nT/A at the scalar sensor. Of another body nothing is known. At
    # the scalar sensor alone a fit would give it the difference, whose sign is the other one.
    "remanent_moment": {
        "effect": "remanent_moment",
        "eta": {"unit": "nT/A", "value": 0.0, "sigma": 20.0},
        "current": {"time": "table", "table": "torquer-mean"},
    },
}

_REMEDY = "'inflight reprocess --table continuous' makes it; 'inflight chain' says why one is not there"


def stored_entry(
    cat: Catalog, mission: Mission, comparison: str, effect: str | Mapping[str, Any]
) -> dict[str, Any] | None:
    """Return the entry of an effect that takes a stored table; None of any other effect.

    Parameters
    ----------
    effect : str or mapping
        A name of `STORED_EFFECTS`, or an entry of the model; what it leaves out is as there.

    Raises
    ------
    CatalogError
        When the table is not there.
    """
    given = parse_entry(effect)
    entry = dict(given) if isinstance(given, Mapping) else {"effect": given}
    known = STORED_EFFECTS.get(str(entry["effect"]))
    if known is not None:
        entry = {**known, "name": entry["effect"], **entry, "effect": known["effect"]}
        sensors = sensors_of(mission, comparison).values()
        own = next((one.name for one in sensors if one.role == "vector"), None)
        entry = {**entry, "sensor": entry.get("sensor", own)}
    stored = {key: one for key, one in entry.items() if isinstance(one, Mapping) and "table" in one}
    stored = {key: one for key, one in stored.items() if one.get("time") == "table"}
    pins = {
        key: {**one, "table": pinned_table(cat, mission, comparison, str(one["table"]))}
        for key, one in stored.items()
    }
    return {**entry, **pins} if pins else None


def pinned_table(cat: Catalog, mission: Mission, comparison: str, named: str) -> str:
    """Return the name and key of a table, the newest of its name where no key is stated.

    Raises
    ------
    CatalogError
        When there is none; the message says what it is made from and how.
    """
    full = named if named.startswith(f"{comparison}-") else f"{comparison}-{named}"
    try:
        return table_label(find_table(cat, full))
    except CatalogError as error:
        kinds = {channel.kind for _, _, channel in mission.channel_instruments()}
        lacks = full.endswith("torquer-mean") and "torquer_current" not in kinds
        why = "; the mission has no channel of kind torquer_current, which it is made from" if lacks else ""
        remedy = "state the currents of the torquers in the mission file" if lacks else _REMEDY
        raise CatalogError(f"{error.message}{why}", remedy=remedy) from None
