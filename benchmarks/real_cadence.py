"""Whether what `diagnose` says of real records depends on choices of numbers: cadence, and where stamps fall.

Each record is diagnosed at the cadence that is chosen for its length, at the cadence of its own samples, at
three and at ten times that. Then the instrument that carries the comparison is delivered anew, resampled at
moments that lie 0.3 of its spacing later, and stamped late by 0.3 more, which its `delay` in the mission
states: nothing physical is changed by it. ``python -m benchmarks real_cadence`` prints the table.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from benchmarks.coil_temperature import ROOT
from inflight.catalog import Catalog, Workspace
from inflight.diagnosis import Diagnosis
from inflight.diagnosis.result import LEFT
from inflight.errors import InflightError, ReadError
from inflight.mission import Mission
from inflight.samples import Series, align
from inflight.tasks.analysis import DiagnoseSettings, Workbench
from inflight.tasks.archive import ArchiveIndex, Need, base_role, channel_needs, channel_series, ingest
from inflight.time import SECOND

#: Part of its spacing by which the moments of an instrument are moved, and again its stamps.
SHIFT = 0.3
#: Cadences of the search, in those of the samples.
TIMES = (1, 3, 10)
_CHOSEN, _MOVED = "as chosen", f"stamps moved by {SHIFT:g}"


@dataclass(frozen=True, kw_only=True)
class Record:
    """A real record: its mission, comparison and folder, days (all of them when empty), instruments."""

    mission: str
    folder: str
    comparison: str = "main"
    days: tuple[str | None, str | None] = (None, None)
    instruments: tuple[str, ...] | None = None

    @property
    def name(self) -> str:
        """Mission and comparison."""
        return f"{self.mission} {self.comparison}"


_SEPTEMBER = ("2011-09-01", "2011-10-01")
#: Those of tests/real_data.
RECORDS = (
    Record(mission="conrad", folder="conrad-wic-storm-may2024"),
    Record(mission="wik-cobenzl", folder="wik-cobenzl-2011", days=_SEPTEMBER),
    Record(mission="wik-cobenzl", folder="wik-cobenzl-2011", comparison="variometer", days=_SEPTEMBER),
    Record(mission="goes16", folder="goes16-mag-ib-ob"),
    Record(mission="usgs-bou", folder="usgs-bou-201601"),
    Record(mission="magnav-tl", folder="magnav-tl"),
)


@dataclass(frozen=True, kw_only=True)
class Said:
    """What was said of a record in one way of looking at it; `problem` where nothing was."""

    record: str
    variant: str
    cadence_s: float = np.nan
    found: Diagnosis | None = None
    problem: str = ""

    @cached_property
    def leading(self) -> list[tuple[str, str, float]]:
        """Name, status and size (nT) of the two largest entries."""
        entries = self.found.entries if self.found else ()
        return [(one.name, one.status, one.takes_off_nT) for one in entries[:2]]

    @property
    def value(self) -> str:
        """Coefficients of the largest effect, with sigmas."""
        effects = {one.name: one for one in (self.found.effects if self.found else ())}
        first = next((effects[name] for name, _, _ in self.leading if name in effects), None)
        numbers = first.coefficients[:3] if first else ()
        return ", ".join(f"{one.value:.4g} ± {one.sigma:.2g} {one.unit}" for one in numbers)

    def apart(self, other: Said) -> float:
        """Return how far the values of the largest effect are from another's, in this one's sigmas."""
        both = [{one.name: one for one in said.found.effects} if said.found else {} for said in (self, other)]
        name = next((name for name, _, _ in self.leading if name != LEFT), "")
        if not all(name in one for one in both):
            return np.nan
        here, there = (one[name].coefficients for one in both)
        moved = [abs(a.value - b.value) / a.sigma for a, b in zip(here, there, strict=False) if a.sigma > 0]
        return max(moved, default=np.nan)


def real_cadence(real: Path) -> Iterator[Said]:
    """Return what is said of each record that is in a folder, one way of looking after the other."""
    for record in RECORDS:
        if not (real / record.folder).is_dir():
            yield Said(record=record.name, variant=_CHOSEN, problem="no such folder")
            continue
        with tempfile.TemporaryDirectory() as scratch:
            yield from _of_record(record, real / record.folder, Path(scratch))


def _of_record(record: Record, data: Path, scratch: Path) -> Iterator[Said]:
    text = (ROOT / "missions" / f"{record.mission}.yaml").read_text(encoding="utf-8")
    known = _workspace(scratch / "as-delivered", record, text)
    mission, cat = known.mission(), Catalog(known.root)
    _ingest(cat, mission, data, record)
    entry = mission.comparisons[record.comparison]
    native_s = max(mission.instruments[name].cadence for name in entry.instruments().values()) / SECOND
    first = _said(record, _CHOSEN, cat, mission)
    yield first
    # In a band nothing but the samples' own cadence is of use.
    for times in TIMES if entry.kind != "platform" else ():
        if not np.isclose(times * native_s, first.cadence_s):
            yield _said(record, f"{times} x native", cat, mission, times * native_s)
    moved = _workspace(scratch / "moved", record, _moved(record, cat, mission, text, data, scratch / "data"))
    try:
        _ingest(Catalog(moved.root), moved.mission(), scratch / "data", record)
        yield _said(record, _MOVED, Catalog(moved.root), moved.mission())
    except InflightError as error:
        yield Said(record=record.name, variant=_MOVED, problem=str(error))


def _ingest(cat: Catalog, mission: Mission, data: Path, record: Record) -> None:
    """Take in a record; days without one of its fields are left out, as the records have some.

    Raises
    ------
    ReadError
        When nothing could be taken in of a field.
    """
    report = ingest(cat, mission, data, record.instruments, *record.days)
    for name in mission.comparisons[record.comparison].instruments().values():
        if not cat.days(f"l1/{name}"):
            said = "; ".join(one["message"] for one in report.problems[:1])
            raise ReadError(f"nothing of '{name}' could be taken in: {said}", remedy="see the first problem")


def _workspace(root: Path, record: Record, text: str) -> Workspace:
    """Return a workspace of a mission's text, with its models."""
    beside = root.with_name(f"{root.name}-yaml")
    shutil.copytree(ROOT / "missions" / "models", beside / "models")
    (beside / f"{record.mission}.yaml").write_text(text, encoding="utf-8")
    return Workspace.create(root, beside / f"{record.mission}.yaml")


def _said(
    record: Record, variant: str, cat: Catalog, mission: Mission, cadence_s: float | None = None
) -> Said:
    settings = DiagnoseSettings(comparison=record.comparison, cadence_s=cadence_s)
    said = Said(record=record.name, variant=variant, cadence_s=cadence_s or np.nan)
    try:
        made = Workbench(cat, mission, *record.days, settings, fresh=True).examine()
    except InflightError as error:
        return replace(said, problem=str(error))
    return replace(said, found=made.found, cadence_s=made.data.cadence_s)


def _moved(record: Record, cat: Catalog, mission: Mission, text: str, data: Path, folder: Path) -> str:
    """Deliver the instrument that carries the comparison at other moments; return the mission for it."""
    folder.mkdir()
    for one in data.iterdir():
        (folder / one.name).symlink_to(one.resolve())
    name = mission.comparisons[record.comparison].instruments()[base_role(mission, record.comparison)]
    own = mission.instruments[name]
    by = round(SHIFT * own.cadence)
    needs = [
        Need(name=name, instrument=name, channel="field", cadence_ns=own.cadence),
        *(need for need in channel_needs(mission) if need.instrument == name),
    ]
    index = ArchiveIndex.of(cat, needs)
    pieces: dict[str, list[Any]] = {}
    for dataset, day in sorted(index.days):
        stamps = np.asarray(cat.read(index.days[dataset, day], ["tt2000"])["tt2000"].values) + by
        series = {need.channel: channel_series(cat, need, day, index) for need in needs}
        # A field is resampled band-limited under the name of a role.
        roles = {"vector" if key == "field" else key: _plain(one) for key, one in series.items() if one}
        samples = align(roles, stamps)
        pieces.setdefault("tt2000", []).append(stamps + by)
        for key in roles:
            pieces.setdefault("field" if key == "vector" else key, []).append(samples[key].values)
    np.savez(folder / "moved.npz", **{key: np.concatenate(parts) for key, parts in pieces.items()})
    return _text_of_moved(text, name, by)


def _plain(series: Series) -> Series:
    """Return a series with values that interpolation takes, and no lag."""
    attrs = {**series.attrs, "lag_ns": 0}
    return replace(series, values=np.asarray(series.values, dtype=np.float64), attrs=attrs)


def _text_of_moved(text: str, name: str, by: int) -> str:
    """Return a mission's text that reads one instrument from the file of moved samples."""
    yaml = YAML()
    tree = yaml.load(text)
    own = tree["instruments"][name]
    for other in tree["instruments"].values():
        if other is not own and other["files"].get("same_as") == name:
            other["files"] = {**own["files"], **{k: v for k, v in other["files"].items() if k != "same_as"}}
    own["files"] = {"pattern": "moved.npz", "reader": "npz", "time": "tt2000", "time_unit": "tt2000"}
    own["delay"] = f"{by} ns"
    for key, channel in own["channels"].items():
        axes = [axis.removeprefix("-") for axis in channel.get("axes", ())]
        size = len(channel.get("variables", ()))
        for gone in ("variables", "variable", "column", "axes", "fill", "file_unit", "factor", "resolution"):
            channel.pop(gone, None)
        channel["variable"] = key
        if axes or size == 3:
            channel["axes"] = sorted(axes) or ["x", "y", "z"]
    out = io.StringIO()
    yaml.dump(tree, out)
    return out.getvalue()


def table(said: list[Said]) -> list[str]:
    """Return the lines of the table, as Markdown; sigmas are from the first row of a record."""
    out = [
        "| record | variant | cadence (s) | verdict | two largest entries | largest effect | sigmas off |",
        "|---|---|---|---|---|---|---|",
    ]
    first: dict[str, Said] = {}
    for one in said:
        start = first.setdefault(one.record, one)
        if one.found is None:
            out.append(f"| {one.record} | {one.variant} | - | - | {one.problem} | - | - |")
            continue
        entries = "; ".join(f"{name}, {status}, {size:.3g} nT" for name, status, size in one.leading)
        off = start.apart(one) if one is not start else np.nan
        how_far = "-" if np.isnan(off) else f"{off:.1f}"
        cells = [
            one.record,
            one.variant,
            f"{one.cadence_s:g}",
            one.found.verdict,
            entries,
            one.value,
            how_far,
        ]
        out.append(f"| {' | '.join(cells)} |")
    return out
