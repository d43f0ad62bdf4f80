"""Workspaces of real measurements, as delivered or with something put in, and what `diagnose` says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from injections import _ELEMENTS, _OTHERS, ROOT

from inflight.catalog import Catalog, Workspace
from inflight.diagnosis import Diagnosis, ModelColumns, Search, run_search
from inflight.diagnosis.result import FoundEffect
from inflight.diagnosis.search import Option
from inflight.diagnosis.stepwise import joint_fit
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import begin_search, diagnosis_data, make_pass
from inflight.tasks.archive import ingest


@dataclass(frozen=True)
class Diagnosed:
    """What was said, and the search that said it."""

    search: Search
    diagnosis: Diagnosis

    @property
    def names(self) -> list[str]:
        """Names of the effects found."""
        return [one.name for one in self.diagnosis.effects]

    @property
    def channels(self) -> set[str]:
        """Channels of the effects found."""
        return {channel for one in self.diagnosis.effects for channel in one.channels}

    @property
    def families(self) -> set[str]:
        """Families of effects found and of all that cannot be told from them."""
        return {one.family for one in self.diagnosis.effects} | {
            str(one["family"]) for one in self.diagnosis.confusion_set
        }

    @property
    def ratio(self) -> float:
        """Held-out rms after all that was taken over that of the untouched model."""
        residual = self.diagnosis.residual
        return residual["held_out_after_nT"] / residual["held_out_before_nT"]

    def effect(self, family: str) -> FoundEffect | None:
        """Return the effect found of a family, the first of several."""
        return next((one for one in self.diagnosis.effects if one.family == family), None)

    def option(self, name: str) -> Option:
        """Return an option of the search by its name."""
        known = [*self.search.accepted, *self.search.options]
        return next(one for one in known if one.name == name)


def workspace(root: Path, mission: str, changes: Mapping[str, str] | None = None) -> Workspace:
    """Return a workspace of a shipped mission; passages of its YAML to replace must be there once."""
    text = (ROOT / "missions" / f"{mission}.yaml").read_text(encoding="utf-8")
    for old, new in (changes or {}).items():
        assert text.count(old) == 1, f"missions/{mission}.yaml no longer says {old!r} once"
        text = text.replace(old, new)
    models = root.parent / f"{root.name}-yaml" / "models"
    models.mkdir(parents=True)
    for preflight in (ROOT / "missions" / "models").glob(f"{mission}*.yaml"):
        (models / preflight.name).write_text(preflight.read_text(encoding="utf-8"), encoding="utf-8")
    source = models.parent / f"{mission}.yaml"
    source.write_text(text, encoding="utf-8")
    return Workspace.create(root, source)


def diagnosed(
    known: Workspace,
    data: Path | None,
    comparison: str = "main",
    days: tuple[str | None, str | None] = (None, None),
    instruments: Sequence[str] | None = None,
    cadence_s: float | None = None,
) -> Diagnosed:
    """Ingest some days of the data unless they are there already, and diagnose a comparison of them."""
    mission, cat = known.mission(), Catalog(known.root)
    if data is not None:
        ingest(cat, mission, data, instruments, *days)
    settings = DiagnoseSettings(comparison=comparison, draws=500, cadence_s=cadence_s)
    made = make_pass(cat, mission, *days, settings)
    search = begin_search(made, settings)
    found, search = run_search(search, diagnosis_data(made, mission))
    return Diagnosed(search, found)


def observatory_workspace(
    root: Path, record: xr.Dataset, extra: Mapping[str, str] | None = None, clock: str = "[]"
) -> tuple[Workspace, Path]:
    """Return a workspace whose delivered file holds a changed record of the Conrad observatory.

    Parameters
    ----------
    extra : mapping of str to str
        Channels of the record that the mission does not know -> their entries in its YAML.
    clock : str, optional
        Steps of the scalar instrument's clock, as its files' `clock_offset`.
    """
    extra = extra or {}
    temperature = "      electronics_temperature: {variable: Temperature2, unit: degC, kind: temperature}\n"
    known = workspace(
        root,
        "conrad",
        {
            "wic_lemi036_gp20s3_1s_{start:%Y%m%d}_{end:%Y%m%d}.cdf": "observatory.npz",
            "reader: cdf\n": "reader: npz\n      time_unit: tt2000\n",
            "files: {same_as: lemi}": f"files: {{same_as: lemi, clock_offset: {clock}}}",
            temperature: temperature + "".join(f"      {name}: {entry}\n" for name, entry in extra.items()),
        },
    )
    source = root.parent / f"{root.name}-data"
    source.mkdir(parents=True)
    columns = dict(zip(_ELEMENTS, record["vector"].values.T, strict=True))
    columns |= {variable: record[name].values for name, variable in _OTHERS.items()}
    columns |= {name: record[name].values for name in extra}
    np.savez(source / "observatory.npz", DataTimes=record["tt2000"].values, **columns)
    return known, source


def along(search: Search, option: Option, direction: np.ndarray, before: bool = False) -> tuple[float, float]:
    """Return the sum of an effect's axes along a direction and its sigma, physical units.

    A field that hardly turns shows its own direction only: no axis is known by itself.

    Parameters
    ----------
    before : bool
        The sigma is that of the scatter around the model without the effect: a third of what `detectable`
        would say of this direction.
    """
    evidence, y = search.forms["raw"], search.y()
    columns = evidence.index(option.columns)[:3]
    present = search.present("raw", option)
    both = ModelColumns(
        np.append(present.columns, columns), np.append(present.precision, np.zeros(3)), present.variance
    )
    if before:
        value, covariance = joint_fit(evidence, both, y)
    else:
        value, covariance = joint_fit(evidence, search.present(), y)
        both = search.present()
    place = [int(np.flatnonzero(both.columns == column)[0]) for column in columns]
    weight = direction * evidence.scale[columns]
    return float(weight @ value[place]), float(np.sqrt(weight @ covariance[np.ix_(place, place)] @ weight))
