"""Units and axes of two fields that should be the same one.

`unit_findings` asks whether one of them is a power of ten of the other, `axes_findings` whether the columns
of a vector have wrong names or signs, against another vector or the main field.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.instruments import Channel
from inflight.mission import Instrument
from inflight.plumbing.findings import Finding, Remedy, channel_path
from inflight.plumbing.records import (
    PLUMBING_SETTINGS,
    Choice,
    Record,
    Survey,
    choose,
    plain,
    typical_squares,
)
from inflight.time import Int64
from inflight.units import factor_and_offset

#: Powers of ten by which numbers are wrong: prefixes, and decimal points that moved.
POWERS = (-9, -6, -5, -3, -2, -1, 1, 2, 3, 5, 6, 9)

#: Units that files give fields, currents, voltages, powers and lengths in.
_FILE_UNITS = (
    "T",
    "mT",
    "uT",
    "nT",
    "pT",
    "A",
    "mA",
    "uA",
    "V",
    "mV",
    "uV",
    "km",
    "m",
    "deg",
    "rad",
    "K",
    "degC",
)

AXES = ("x", "y", "z")


class Turn(NamedTuple):
    """A signed permutation: axis i is really ``sign[i]`` times what is archived as axis ``order[i]``."""

    order: tuple[int, int, int]
    sign: tuple[int, int, int]

    def of(self, values: Floats) -> Floats:
        """Return the vectors (row, axis) as they really are."""
        return np.asarray(values[:, self.order] * np.asarray(self.sign, dtype=np.float64))

    @property
    def matrix(self) -> Floats:
        """The turn as a matrix."""
        return np.asarray(np.eye(3)[list(self.order)] * np.asarray(self.sign, dtype=np.float64)[:, None])

    @property
    def names(self) -> tuple[str, str, str]:
        """What the archived axes x, y and z really are."""
        found = {self.order[i]: ("-" if self.sign[i] < 0 else "") + AXES[i] for i in range(3)}
        return found[0], found[1], found[2]

    @property
    def words(self) -> str:
        """The turn in plain words, of ``its axes``."""
        if self.order == (0, 1, 2):
            turned = [axis for axis, sign in zip(AXES, self.sign, strict=True) if sign < 0]
            axes = " and ".join(turned) if len(turned) < 3 else "x, y and z"
            return f"axis {axes} is reversed" if len(turned) == 1 else f"axes {axes} are reversed"
        moved = [AXES[i] for i in range(3) if self.order[i] != i]
        if len(moved) == 2 and min(self.sign) > 0:
            return f"axes {' and '.join(moved)} are exchanged"
        return f"what is called x, y, z is really {', '.join(self.names)}"

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes that are wrong."""
        return tuple(AXES[i] for i in range(3) if self.order[i] != i or self.sign[i] < 0)


#: All signed permutations but that which changes nothing.
TURNS = tuple(
    Turn((order[0], order[1], order[2]), (sign[0], sign[1], sign[2]))
    for order in itertools.permutations(range(3))
    for sign in itertools.product((1, -1), repeat=3)
    if (order, sign) != ((0, 1, 2), (1, 1, 1))
)


def axes_remedies(name: str, instrument: Instrument, turn: Turn) -> list[Remedy]:
    """Return the lines that name a field's columns rightly, or turn its sensor where a rotation does it."""
    line = axes_line(name, "field", instrument.channels["field"], AXES, turn.names)
    found = [Remedy(f"the columns of '{name}' have wrong names or signs", (line,))]
    if np.linalg.det(turn.matrix) > 0:
        old = scipy.spatial.transform.Rotation.from_quat(instrument.orientation)
        new = old * scipy.spatial.transform.Rotation.from_matrix(turn.matrix)
        numbers = np.round(new.as_quat(canonical=True), 9) + 0.0
        value = f"[{', '.join(plain(one) for one in numbers)}]"
        found.append(
            Remedy(f"'{name}' is mounted so turned", ((("instruments", name, "orientation"), value),))
        )
    return found


def axes_line(
    instrument: str, channel: str, entry: Channel, archived: Sequence[str], really: Sequence[str]
) -> tuple[tuple[str, ...], str]:
    """Return the line that names a file's columns by what its archived axes really are."""
    known = dict(zip(archived, really, strict=True))
    labels = []
    for label in entry.axes or archived:
        name = known[label.removeprefix("-")]
        negative = label.startswith("-") != name.startswith("-")
        labels.append(("-" if negative else "") + name.removeprefix("-"))
    return channel_path(instrument, channel, "axes"), f"[{', '.join(labels)}]"


def unit_remedies(record: Record, factor: float) -> list[Remedy]:
    """Return the lines that multiply a channel's numbers, by a unit of the file where one does that."""
    entry, home = record.entry, (record.instrument, record.channel)
    for name in _FILE_UNITS:
        if _is_factor(name, entry, factor):
            words = f"the numbers of '{record.channel}' of '{record.instrument}' are in {name}"
            return [Remedy(words, ((channel_path(*home, "file_unit"), name),))]
    words = f"the numbers of '{record.channel}' of '{record.instrument}' are to be multiplied by {factor:g}"
    return [Remedy(words, ((channel_path(*home, "factor"), plain(entry.factor * factor)),))]


def _is_factor(unit: str, entry: Channel, factor: float) -> bool:
    """Return True when numbers in this unit, instead of the stated one, are so many times as large."""
    try:
        stated = factor_and_offset(entry.file_unit or entry.unit, entry.unit)[0]
        return bool(np.isclose(factor_and_offset(unit, entry.unit)[0], factor * stated, rtol=1e-6))
    except ValueError:
        return False


def magnitude(values: Floats) -> Floats:
    """Return the length of vectors (row, axis), and scalars (row,) as they are."""
    return values if values.ndim == 1 else np.asarray(np.linalg.norm(values, axis=1))


def paired(first: Record, second: Record) -> tuple[Int64, Floats, Floats]:
    """Return stamps of the slower record, thinned, and both records there."""
    slower = max(first, second, key=lambda one: one.cadence_ns)
    stamps = slower.thinned(PLUMBING_SETTINGS.rows)
    return stamps, first.at(stamps), second.at(stamps)


def unit_findings(survey: Survey, main_field: Mapping[str, Floats] | None = None) -> list[Finding]:
    """Return whether one of two fields is a power of ten of the other.

    Parameters
    ----------
    main_field : mapping of str to ndarray, optional
        Strength of each field by role over that of the main field, (row,): tells which of both is wrong.
    """
    first, second = survey.fields.values()
    stamps, one, other = paired(first, second)
    if one.ndim == other.ndim == 2:
        one, other = _same_variation(survey, one, other)
    size_one, size_other = magnitude(one), magnitude(other)
    trials = {power: typical_squares(size_one - 10.0**power * size_other) for power in POWERS}
    found = choose(typical_squares(size_one - size_other), trials)
    if found is None or found.rivals:
        return []
    if found.after > PLUMBING_SETTINGS.unit_tolerance * float(np.nanmedian(np.abs(size_one))):
        return []
    factor = 10.0**found.name
    faults = {second.name: factor, first.name: 1.0 / factor}
    ratio = {name: float(np.nanmedian(values)) for name, values in (main_field or {}).items()}
    told = {
        name: one
        for name, one in faults.items()
        if name not in ratio or abs(np.log10(ratio[name] * one)) < 0.3
    }
    records = {one.name: one for one in (first, second)}
    remedies = [
        remedy for name, one in (told or faults).items() for remedy in unit_remedies(records[name], one)
    ]
    guilty = records[next(iter(told or faults))]
    words = (
        f"The field of '{first.instrument}' is {factor:g} times that of '{second.instrument}': "
        f"the unit of {'one of them' if len(remedies) > 1 else f'{guilty.instrument!r}'} is wrong"
    )
    return [finding_of("unit", words, guilty, stamps, found, remedies)]


def _same_variation(survey: Survey, one: Floats, other: Floats) -> tuple[Floats, Floats]:
    """Return what changes in the first vector, and what the second one makes of it with a gain of one.

    Offsets of two fluxgates may exceed the field, and their axes may differ in any way.
    """
    good = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    if np.count_nonzero(good) < PLUMBING_SETTINGS.blocks:
        return one[:, 0], other[:, 0]
    first, second = one - np.mean(one[good], axis=0), other - np.mean(other[good], axis=0)
    turn = np.linalg.lstsq(second[good], first[good], rcond=None)[0]
    predicted = second @ turn
    gain = float(np.sqrt(np.sum(predicted[good] ** 2) / max(np.sum(second[good] ** 2), 1e-300)))
    axis = int(np.argmax(np.var(first[good], axis=0)))
    return first[:, axis], predicted[:, axis] / (gain or 1.0)


def axes_findings(survey: Survey) -> list[Finding]:
    """Return whether the columns of one of two vectors have wrong names or signs."""
    first, second = survey.fields.values()
    stamps, *values = paired(first, second)
    mounted = {
        record.name: Mounted(record, one, survey.mission.instruments[record.instrument])
        for record, one in zip((first, second), values, strict=True)
    }
    return axes_against(stamps, mounted.pop(first.name), mounted)


def axes_against(
    stamps: Int64,
    field: Floats | Mounted,
    mounted: Mapping[str, Mounted],
    rival: Mapping[str, tuple[Floats, Remedy]] | None = None,
) -> list[Finding]:
    """Return whether columns of vectors have wrong names or signs.

    Parameters
    ----------
    stamps : ndarray of int64, shape (row,)
    field : ndarray, shape (row, 3), or Mounted
        What is right, in the spacecraft's axes, or the other vector, which may be wrong, too.
    mounted : mapping of str to Mounted
        The vector that may be wrong, by its record's name.
    rival : mapping, optional
        The field under other conventions of the attitude, and the lines that state these.
    """
    rival = rival or {}
    ((name, vector),) = mounted.items()
    right = field.stated if isinstance(field, Mounted) else field
    trials: dict[tuple[str, Turn | str], Floats] = {
        (name, turn): typical_squares(difference(right, vector.under(turn))) for turn in TURNS
    }
    if isinstance(field, Mounted):
        mounted = {**mounted, field.record.name: field}
        trials |= {
            (field.record.name, turn): typical_squares(difference(field.under(turn), vector.stated))
            for turn in TURNS
        }
    for convention, (other, _) in rival.items():
        trials["attitude", convention] = typical_squares(difference(other, vector.stated))
    found = choose(typical_squares(difference(right, vector.stated)), trials)
    return [] if found is None else [_axes_finding(found, mounted, stamps, rival)]


class Mounted(NamedTuple):
    """A vector reading (row, axis), turned into the spacecraft's axes as stated or with other names."""

    record: Record
    values: Floats
    instrument: Instrument

    @property
    def stated(self) -> Floats:
        """As the mission states it; (row, axis)."""
        return self._turned(self.values)

    def under(self, turn: Turn) -> Floats:
        """With the columns that a turn says; (row, axis)."""
        return self._turned(turn.of(self.values))

    def _turned(self, values: Floats) -> Floats:
        if self.record.entry.frame not in (None, "sensor"):
            return values
        rotation = scipy.spatial.transform.Rotation.from_quat(self.instrument.orientation)
        return np.asarray(values @ rotation.as_matrix().T)


def difference(one: Floats, other: Floats) -> Floats:
    """Return what one vector leaves of another, both less their typical values, with one positive gain."""
    good = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    if not good.any():
        return np.full_like(one, np.nan)
    first, second = one - np.median(one[good], axis=0), other - np.median(other[good], axis=0)
    gain = np.sum(first[good] * second[good]) / max(float(np.sum(second[good] ** 2)), 1e-300)
    return np.asarray(first - max(gain, 0.0) * second)


def _axes_finding(
    found: Choice[tuple[str, Turn | str]],
    mounted: Mapping[str, Mounted],
    stamps: Int64,
    rival: Mapping[str, tuple[Floats, Remedy]],
) -> Finding:
    remedies: list[Remedy] = []
    for name, how in (found.name, *found.rivals):
        if isinstance(how, Turn):
            record = mounted[name].record
            remedies += axes_remedies(record.instrument, mounted[name].instrument, how)
        else:
            remedies.append(rival[how][1])
    name, how = found.name
    record = mounted[name if name in mounted else next(iter(mounted))].record
    if isinstance(how, Turn):
        words, axes = f"Axes of '{record.instrument}': {how.words}", how.axes
    else:
        words, axes = f"The attitude is not what the mission states: {rival[how][1].words}", ()
    return finding_of("axes" if axes else "attitude", words, record, stamps, found, remedies, axes)


def finding_of(
    fault: str,
    words: str,
    record: Record,
    stamps: Int64,
    found: Choice,  # type: ignore[type-arg]
    remedies: Sequence[Remedy],
    axes: tuple[str, ...] = (),
) -> Finding:
    """Return what a choice says of a record."""
    return Finding(
        fault=fault,
        words=words,
        instrument=record.instrument,
        channel=record.channel,
        start=int(stamps[0]),
        end=int(stamps[-1]),
        how_sure=found.how_sure,
        p=found.p,
        before=found.before,
        after=found.after,
        axes=axes,
        remedies=tuple(remedies),
    )
