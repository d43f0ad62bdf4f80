"""The history of a model: which version its evidence was made at, and which one came before the last change.

History only grows. Going back is a version like any other, whose text is an older one's.
"""

from __future__ import annotations

from inflight.catalog import Catalog, ModelRecord
from inflight.errors import CatalogError, ModelError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.models import UsedModel

#: How the message of a version begins that is an older one again.
UNDO = "undo"


def version_of(cat: Catalog, mission: Mission, like: UsedModel, version: int) -> UsedModel:
    """Return another version of a model, made with the effects' files as they are now."""
    name = like.model.name
    text = cat.model_text(name, version)[2]
    return UsedModel(Model.parse(text, mission, f"{name} version {version}", like.model.own), version, text)


def evidence_root(cat: Catalog, mission: Mission, current: UsedModel) -> tuple[UsedModel, Mission] | None:
    """Return the nearest version with evidence, the present one or one it came from, and its mission.

    The mission is the text the evidence was made with: naming another file with effects changes
    nothing of what was made before. None when no version has evidence.
    """
    dataset = f"equations/{current.model.comparison}/library"
    contexts = {day.context for day in cat.days(dataset, states=("published",))} - {None}
    versions = {}
    for record in (cat.context(str(one)) for one in contexts):
        before = mission if record.mission_text == mission.text else Mission.parse(record.mission_text)
        if record.model_name == current.model.name and _measures_as(before, mission):
            versions[record.model_version] = before
    records = _records(cat, current)
    at: int | None = current.version
    while at is not None:
        if at in versions:
            used = current if at == current.version else version_of(cat, mission, current, at)
            return used, versions[at]
        at = records[at].parent
    return None


def _measures_as(one: Mission, other: Mission) -> bool:
    """Return True when two missions differ in nothing but words and the files of a user's own effects."""
    words = {"effects", "description", "acknowledgement"}
    return one is other or one.model_dump(exclude=words) == other.model_dump(exclude=words)


def before_last(cat: Catalog, mission: Mission, current: UsedModel) -> UsedModel:
    """Return the version before the last change; one that was taken back does not count.

    Raises
    ------
    ModelError
        When nothing was changed.
    """
    records = _records(cat, current)
    parent = _before(records, current.version)
    if parent is None:
        raise ModelError(
            f"version {current.version} of model '{current.model.name}' is where it began",
            remedy="'inflight model history' lists the versions; there is nothing to take back",
        )
    return version_of(cat, mission, current, parent)


def _before(records: dict[int, ModelRecord], version: int) -> int | None:
    return records[_meant(records, version)].parent


def _meant(records: dict[int, ModelRecord], version: int) -> int:
    """Return the version that a version is again: itself, unless it takes something back."""
    record = records[version]
    if record.parent is None or not record.message.startswith(UNDO):
        return version
    found = _before(records, record.parent)
    if found is None:
        raise CatalogError(
            f"version {version} takes back version {record.parent}, before which there is none",
            remedy="the history of the model is damaged: 'inflight catalog verify'",
        )
    return _meant(records, found)


def _records(cat: Catalog, current: UsedModel) -> dict[int, ModelRecord]:
    return {one.version: one for one in cat.models() if one.name == current.model.name}
