"""All tests of plumbing over a survey, the surest findings first (`find_faults`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from inflight.model import Model
from inflight.plumbing.channels import angle_findings, stale_findings, temperature_findings
from inflight.plumbing.clocks import Pair, clock_findings, linear_pair, scalar_pair
from inflight.plumbing.coefficients import coefficient_findings
from inflight.plumbing.fields import axes_findings, unit_findings
from inflight.plumbing.findings import Finding
from inflight.plumbing.orbit import (
    Orbit,
    field_ratios,
    lone_unit_findings,
    orbit_axes,
    orbit_pairs,
    position_findings,
)
from inflight.plumbing.records import Survey

if TYPE_CHECKING:
    import xarray as xr


def find_faults(
    survey: Survey, model: Model | None = None, samples: xr.Dataset | None = None
) -> tuple[Finding, ...]:
    """Return faults of plumbing: units, clocks, axes, exchanged channels, stale readings.

    Parameters
    ----------
    survey : Survey
        Channels of some days.
    model, samples : optional
        The present model and thinned samples of its comparison: its coefficients judge the channels it uses.

    Returns
    -------
    tuple of Finding
        Those with one explanation first.
    """
    found = [
        finding
        for record in survey.records
        for test in (stale_findings, temperature_findings, angle_findings)
        for finding in test(record)
    ]
    found += field_faults(survey)
    # A channel of another unit, or of fields with another clock or unit, is told once.
    if model is not None and samples is not None and not any(one.fault in ("unit", "clock") for one in found):
        found += coefficient_findings(survey, model, samples)
    found.sort(key=lambda one: (not one.sure, one.p))
    # What mends it is the same: one fault, which two fields show.
    return tuple({tuple(remedy.text for remedy in one.remedies): one for one in reversed(found)}.values())[
        ::-1
    ]


def field_faults(survey: Survey) -> list[Finding]:
    """Return faults that two fields show against each other, or one against the main field."""
    known = sum(bool(np.isfinite(one.values).any()) for one in survey.fields.values())
    alone = survey.kind == "field_model"
    if survey.kind not in ("scalar", "dual", "platform", "field_model") or known < (1 if alone else 2):
        return []
    orbit = Orbit.of(survey)
    found = position_findings(survey)
    if not alone:
        found += unit_findings(survey, field_ratios(survey, orbit) if orbit else None)
    elif orbit is not None:
        found += lone_unit_findings(survey, orbit)
    clocks = clock_findings(survey.mission, pairs_of(survey, orbit))
    found += clocks
    if clocks:
        # With a wrong clock every axis looks wrong.
        return found
    if orbit is not None:
        found += orbit_axes(survey, orbit)
    if survey.kind == "dual" and not any(one.fault == "axes" for one in found):
        found += axes_findings(survey)
    return found


def pairs_of(survey: Survey, orbit: Orbit | None) -> list[Pair]:
    """Return the pairs of records that tell of one field: both instruments, and each with the orbit."""
    fields = survey.fields
    if survey.kind == "dual":
        pairs = [linear_pair(fields["inboard"], fields["outboard"])]
    elif survey.kind == "field_model":
        pairs = []
    else:
        pairs = [scalar_pair(fields["scalar"], fields["vector"])]
    return pairs + (orbit_pairs(survey, orbit) if orbit is not None else [])
