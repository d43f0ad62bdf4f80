"""The main field where the spacecraft was, in its own axes: what positions and attitudes say of the fields.

`Orbit` holds the field of the IGRF along the orbit; it gives the clocks further pairs (`orbit_pairs`), tells
axes of a vector and conventions of the attitude (`orbit_axes`), and the unit of positions
(`position_findings`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.frames import (
    EARTH_RADIUS,
    itrf_to_spacecraft,
    position_in_itrf,
)
from inflight.main_field import IGRF, MainField
from inflight.plumbing.clocks import Pair, left_by, linear_pair, scalar_pair, with_constant
from inflight.plumbing.fields import (
    POWERS,
    Mounted,
    axes_against,
    axes_line,
    finding_of,
    magnitude,
    unit_remedies,
)
from inflight.plumbing.findings import Finding, Remedy, channel_path
from inflight.plumbing.records import PLUMBING_SETTINGS, Record, Survey, choose, typical_squares
from inflight.samples import continuous_sign
from inflight.time import SECOND, Int64
from inflight.units import factor_and_offset

#: Other conventions of the attitude, in words, and what the archived x, y, z and w of a quaternion then are.
_CONVENTIONS = {
    "inverse": ("the quaternion turns the other way", ("-x", "-y", "-z", "w")),
    "scalar first": ("the quaternion's scalar part comes first", ("w", "x", "y", "z")),
    "scalar first, inverse": (
        "the quaternion's scalar part comes first, and it turns the other way",
        ("w", "-x", "-y", "-z"),
    ),
    "scalar last": ("the quaternion's scalar part comes last", ("y", "z", "w", "x")),
    "scalar last, inverse": (
        "the quaternion's scalar part comes last, and it turns the other way",
        ("-y", "-z", "w", "-x"),
    ),
}

#: Frames that an attitude may be towards.
_FRAMES = ("itrf", "nec", "gcrf")

#: Spacing of the positions at which the main field is computed: between them it is linear within some nT.
_STEP_NS = 20 * SECOND

#: Seconds between the lags at which it is tried.
_STEP_S = 5


@dataclass(frozen=True)
class Orbit:
    """The main field along the orbit, nT, itrf; with the attitude where there is one."""

    position: Record
    field: Record
    places: Record
    attitude: Record | None

    @classmethod
    def of(cls, survey: Survey) -> Orbit | None:
        """Return it; None without positions near the Earth."""
        position = survey.of_kind("position", ("itrf", "gcrf"))
        if position is None:
            return None
        stamps = position.stamps[:: max(1, _STEP_NS // position.cadence_ns)]
        fixed = _fixed(position, stamps, _kilometres(position))
        if not _is_near(fixed):
            return None
        step = max(_STEP_NS, position.cadence_ns)
        places = replace(position, stamps=stamps, values=fixed, cadence_ns=step)
        field = replace(places, values=MainField.of(IGRF).at(fixed, stamps), name="main field")
        attitude = survey.of_kind("attitude", _FRAMES)
        return cls(
            position, field, places, attitude and replace(attitude, values=continuous_sign(attitude.values))
        )

    @property
    def strength(self) -> Record:
        """Strength of the main field, nT."""
        return replace(self.field, values=np.linalg.norm(self.field.values, axis=1))

    def in_spacecraft(self, stamps: Int64, lag_ns: int = 0, convention: str = "") -> Floats:
        """Return the field in the spacecraft's axes; (row, 3) nT.

        By the attitude read at another time, in another convention, or towards another frame.
        """
        assert self.attitude is not None
        field, quaternion = self.field.at(stamps), self.attitude.at(stamps + lag_ns)
        frame = self.attitude.entry.frame or ""
        if convention in _FRAMES:
            frame = convention
        elif convention:
            names = _CONVENTIONS[convention][1]
            really = {name.removeprefix("-"): k for k, name in enumerate(names)}
            signs = [-1.0 if names[really[axis]].startswith("-") else 1.0 for axis in "xyzw"]
            quaternion = quaternion[:, [really[axis] for axis in "xyzw"]] * signs
        return itrf_to_spacecraft(field, quaternion, frame, self.places.at(stamps), stamps)


def _kilometres(position: Record) -> float:
    return factor_and_offset(position.entry.unit, "km")[0]


def _fixed(position: Record, stamps: Int64, factor: float) -> Floats:
    """Return positions in km, itrf."""
    return position_in_itrf(position.at(stamps) * factor, position.entry.frame or "itrf", stamps)


def _is_near(fixed: Floats) -> bool:
    """Return True for positions where the main field is nearly all there is."""
    radius = float(np.nanmedian(np.linalg.norm(fixed, axis=1))) if np.isfinite(fixed).any() else np.nan
    return bool(0.99 * EARTH_RADIUS <= radius <= PLUMBING_SETTINGS.main_field_radii * EARTH_RADIUS)


def orbit_pairs(survey: Survey, orbit: Orbit) -> list[Pair]:
    """Return pairs of each field with the position, and of each vector with the attitude."""
    vectors = [one for one in survey.fields.values() if one.values.ndim == 2]
    pairs = [
        scalar_pair(orbit.strength, one, _STEP_S)
        if one.values.ndim == 2
        else linear_pair(one, orbit.strength, step_s=_STEP_S)
        for one in survey.fields.values()
    ]
    if orbit.attitude is None:
        return pairs
    for vector in vectors:
        stamps = vector.thinned(PLUMBING_SETTINGS.rows // 2)
        reading = vector.at(stamps)

        def residual(lag_ns: int, stamps: Int64 = stamps, reading: Floats = reading) -> Floats:
            return left_by(with_constant(orbit.in_spacecraft(stamps, lag_ns)), reading)

        # A vector that is late is late for the position, too.
        pairs.append(Pair(vector, orbit.attitude, stamps, residual, _STEP_S, clears=False))
    return pairs


def orbit_axes(survey: Survey, orbit: Orbit) -> list[Finding]:
    """Return whether a vector's axes are wrong, or the attitude's convention, by the main field."""
    if orbit.attitude is None:
        return []
    out = []
    for role, vector in survey.fields.items():
        if vector.values.ndim == 1:
            continue
        stamps = vector.thinned(PLUMBING_SETTINGS.rows)
        mounted = Mounted(vector, vector.at(stamps), survey.mission.instruments[vector.instrument])
        rival = {
            name: (orbit.in_spacecraft(stamps, convention=name), _convention_remedy(orbit.attitude, name))
            for name in (*_CONVENTIONS, *_FRAMES)
            if name != orbit.attitude.entry.frame
        }
        out += axes_against(stamps, orbit.in_spacecraft(stamps), {role: mounted}, rival)
    return out


def _convention_remedy(attitude: Record, convention: str) -> Remedy:
    if convention in _FRAMES:
        line = (channel_path(attitude.instrument, attitude.channel, "frame"), convention)
        return Remedy(f"the quaternion is towards {convention}", (line,))
    words, really = _CONVENTIONS[convention]
    return Remedy(words, (axes_line(attitude.instrument, attitude.channel, attitude.entry, "xyzw", really),))


def field_ratios(survey: Survey, orbit: Orbit) -> dict[str, Floats]:
    """Return each field's strength over that of the main field, by the record's name."""
    out = {}
    for record in survey.fields.values():
        values = record.at(orbit.field.stamps)
        out[record.name] = magnitude(values) / orbit.strength.values
    return out


def lone_unit_findings(survey: Survey, orbit: Orbit) -> list[Finding]:
    """Return whether the only field of a comparison is a power of ten of the main field."""
    record = next(iter(survey.fields.values()))
    stamps, strength = orbit.field.stamps, orbit.strength.values
    size = magnitude(record.at(stamps))
    trials = {power: typical_squares(size - 10.0**power * strength) for power in POWERS}
    found = choose(typical_squares(size - strength), trials)
    if found is None or found.rivals:
        return []
    factor = 10.0**found.name
    words = (
        f"The field of '{record.instrument}' is {factor:g} times that of the Earth: its unit is not "
        f"{record.entry.unit}"
    )
    remedies = list(unit_remedies(record, 1.0 / factor))
    return [finding_of("unit", words, record, stamps, found, remedies)]


def position_findings(survey: Survey) -> list[Finding]:
    """Return whether the position is in another unit than stated: the main field there is then none."""
    position = survey.of_kind("position", ("itrf", "gcrf"))
    record = next(iter(survey.fields.values()))
    if position is None or not np.isfinite(position.values).any():
        return []
    stamps = position.thinned(PLUMBING_SETTINGS.rows // 2)
    factor = _kilometres(position)
    if _is_near(_fixed(position, stamps, factor)):
        return []
    values = record.at(stamps)
    size = magnitude(values)
    trials: Mapping[float, Floats] = {
        one: typical_squares(size - np.linalg.norm(MainField.of(IGRF).at(fixed, stamps), axis=1))
        for one in (*(10.0**power for power in POWERS), EARTH_RADIUS)
        if _is_near(fixed := _fixed(position, stamps, factor * one))
    }
    found = choose(typical_squares(size), trials)
    if found is None:
        return []
    words = f"'{position.channel}' of '{position.instrument}' is not in {position.entry.unit}"
    remedies = [one for name in (found.name, *found.rivals) for one in unit_remedies(position, name)]
    return [finding_of("unit", words, position, stamps, found, remedies)]
