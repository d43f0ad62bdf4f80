"""Channels that the model uses, judged by its coefficients: units, axes, others in their place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from inflight.arrays import Floats
from inflight.model import Model, rows_of
from inflight.plumbing.clocks import left_by, quadratic_columns, with_constant
from inflight.plumbing.fields import AXES, TURNS, Turn, axes_line, finding_of, unit_remedies
from inflight.plumbing.findings import Finding, Remedy, channel_path
from inflight.plumbing.records import PLUMBING_SETTINGS, Choice, Record, Survey, choose, typical_squares

if TYPE_CHECKING:
    import xarray as xr

#: Powers of ten between units of currents and voltages.
_POWERS = (-6, -3, 3, 6)

#: Units of currents and voltages, but for their prefix.
_SCALED = ("A", "V", "W")

#: A channel in another unit (power of ten), with other names of its axes, or another channel in its place.
Instead = int | Turn | str


def coefficient_findings(survey: Survey, model: Model, samples: xr.Dataset) -> list[Finding]:
    """Return the channels of the model that agree far better in another unit, or exchanged.

    The model's coefficients are taken as right; what a calibration fits anew is taken out of each residual.

    Parameters
    ----------
    samples : xarray.Dataset
        Aligned samples of the comparison with the channels of its model, thinned.
    """
    if survey.kind not in ("scalar", "dual"):
        return []
    used = {channel for entry in model.effects for channel in entry.effect.channels} & set(survey.channels)
    records = [survey.channels[name] for name in sorted(used & set(map(str, samples)))]
    records = [one for one in records if one.kind not in ("attitude", "position")]
    trials = {
        (record.name, how): left_by_model(model, changed, survey.kind)
        for record in records
        for how, changed in _changed_samples(survey, record, samples).items()
    }
    # All in one ranking: where something is wrong, many changes take off a part of it.
    # A physical effect that is missing is taken up by many a change of a channel, but not nearly whole.
    stated, part = left_by_model(model, samples, survey.kind), PLUMBING_SETTINGS.part_left_by_model
    found = choose(stated, trials, part) if trials else None
    return [] if found is None else [_coefficient_finding(survey, samples, found)]


def _changed_samples(survey: Survey, record: Record, samples: xr.Dataset) -> Mapping[Instead, xr.Dataset]:
    """Return the samples with a channel in other units, of other axes, and others in its place."""
    held = samples[record.name]
    values = np.asarray(held.values, dtype=np.float64)
    changed: dict[Instead, Floats] = {}
    if record.entry.unit[-1] in _SCALED:
        changed |= {power: values * 10.0**power for power in _POWERS}
    if record.entry.axis_names == AXES:
        changed |= {turn: turn.of(values) for turn in TURNS}
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    for name, other in survey.channels.items():
        same = other.values.ndim == record.values.ndim and other.entry.unit == record.entry.unit
        if name != record.name and same and other.instrument == record.instrument:
            changed[name] = other.at(stamps - record.entry.lag)
    return {how: samples.assign({record.name: held.copy(data=one)}) for how, one in changed.items()}


def left_by_model(model: Model, samples: xr.Dataset, kind: str) -> Floats:
    """Return the typical squares of what model and calibration leave; (block,) nT^2."""
    rows = rows_of(model, samples)
    residual = np.where(rows.good[:, None], rows.residual, np.nan)
    if kind == "dual":
        return typical_squares(left_by(with_constant(np.asarray(samples["outboard"].values)), residual))
    reading = np.asarray(samples["vector"].values, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        columns = quadratic_columns(reading)(reading) / np.linalg.norm(reading, axis=1, keepdims=True)
    return typical_squares(left_by(columns, residual[:, 0]))


def _coefficient_finding(survey: Survey, samples: xr.Dataset, found: Choice[tuple[str, Instead]]) -> Finding:
    remedies: list[Remedy] = []
    for name, how in (found.name, *found.rivals):
        one = survey.channels[name]
        if isinstance(how, Turn):
            line = axes_line(one.instrument, one.channel, one.entry, AXES, how.names)
            remedies.append(Remedy(f"of '{name}' {how.words}", (line,)))
        elif isinstance(how, int):
            remedies += unit_remedies(one, 10.0**how)
        else:
            remedies.append(exchanged(one, survey.channels[how]))
    name, best = found.name
    record = survey.channels[name]
    label = f"'{record.channel}' of '{record.instrument}'"
    if isinstance(best, Turn):
        fault, words = "axes", f"Of {label} {best.words}"
    elif isinstance(best, int):
        fault, words = "unit", f"{label} is to be multiplied by {10.0**best:g}: its unit is wrong"
    else:
        fault, words = "exchanged", f"{label} and '{survey.channels[best].channel}' are exchanged"
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    words += ", by the model's coefficients"
    axes = best.axes if isinstance(best, Turn) else ()
    return finding_of(fault, words, record, stamps, found, remedies, axes)


def exchanged(one: Record, other: Record) -> Remedy:
    """Return the lines that exchange where two channels of an instrument stand in its files."""
    lines = []
    for record, source in ((one, other), (other, one)):
        for key in ("variable", "variables", "column"):
            value = getattr(source.entry, key)
            if value != getattr(record.entry, key):
                text = (
                    f"[{', '.join(value)}]"
                    if isinstance(value, list)
                    else "null"
                    if value is None
                    else str(value)
                )
                lines.append((channel_path(record.instrument, record.channel, key), text))
    return Remedy(f"'{one.channel}' and '{other.channel}' are exchanged", tuple(lines))
