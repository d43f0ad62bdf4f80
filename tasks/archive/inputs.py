"""What samples are made from: needed channels, and the archived days that hold them.

A `Need` is one series of the samples with its instrument, channel and history. An `ArchiveIndex` lists the
published days of some needs: read once, and sent to workers, which open no database.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.effects import NO_CAUSE, position_channel
from inflight.errors import CatalogError, SamplesError
from inflight.frames import GEOMETRY
from inflight.mission import Mission
from inflight.model import Model
from inflight.samples import FIELD_ROLES, ChannelFactor, base_channels, parse_channel
from inflight.time import DAY, SECOND, DayLike, is_within

#: Name of the spin's phase in samples.
SPIN_PHASE = "spin_phase"

#: Name of the need of the channel with the direction of the spin axis; samples do not hold it.
SPIN_AXIS = "spin_axis"

#: Name of the need of the channel that tells a comparison's measuring range; samples do not hold it.
RANGE = "measuring_range"

#: Name of the known ambient field in samples.
AMBIENT = "ambient"


@dataclass(frozen=True, kw_only=True)
class InputSettings:
    """How far samples reach beyond their own day, and what is kept in memory.

    Attributes
    ----------
    margin_cadences : int
        Samples kept of the neighbouring days, so that filters and lags run on across midnight (derived from
        the width of `inflight.samples.AlignmentSettings`).
    least_coverage : float
        A channel's typical value comes from its own day when this part of it is known, else from other days
        (assumed).
    typical_value_days : int
        Other days are searched this far on both sides (assumed).
    readings_per_turn : int
        A channel resolves the spin with this many readings a turn (derived: twice the second harmonic).
    cached_arrays, cached_bytes : int
        Arrays that `inflight.tasks.archive.samples.cached_readings` keeps in a thread, and what they hold:
        channels and stamps of some three days; of a vector faster than some 60 Hz less than two, so that
        neighbouring days are read again (assumed).
    cached_days : int
        Days kept by `inflight.tasks.archive.channels.ChannelReader`: a day, its history, and those of
        placebos (assumed).
    """

    margin_cadences: int = 40
    least_coverage: float = 0.1
    typical_value_days: int = 15
    readings_per_turn: int = 4
    cached_arrays: int = 72
    cached_bytes: int = 512 * 2**20
    cached_days: int = 12


INPUT_SETTINGS = InputSettings()


@dataclass(frozen=True, kw_only=True)
class Need:
    """One series the samples hold: its name there, and the instrument and channel it comes from.

    Attributes
    ----------
    part : ChannelFactor, optional
        What is made of the channel: a slow response or a play, which need earlier data.
    products : tuple of str
        Products of channels that the series is a factor of.
    smooth_ns : int
        Readings are averaged over this long, centred.
    average_ns : int
        A field is averaged over this long where it is resampled: see `averaging_by_role`.
    around_ns : int
        A day's product is made from samples that reach so far into its neighbours: see `with_surroundings`.
    replaceable : bool
        A typical value may replace the channel where it is missing: see `replaceable_needs`.
    """

    name: str
    instrument: str
    channel: str
    cadence_ns: int
    lag_ns: int = 0
    part: ChannelFactor | None = None
    products: tuple[str, ...] = ()
    smooth_ns: int = 0
    average_ns: int = 0
    around_ns: int = 0
    replaceable: bool = False

    @property
    def dataset(self) -> str:
        """Name of the instrument's archive dataset."""
        return f"l1/{self.instrument}"

    @property
    def history_ns(self) -> int:
        """How much earlier data the series is made from, in addition to its margin."""
        return round(self.part.history_s * SECOND) if self.part else 0

    @property
    def days_before(self) -> int:
        """Days before its own that a day of the series is made from."""
        return max(1, -(-(self.history_ns + self.margin_ns) // DAY))

    @property
    def margin_ns(self) -> int:
        """How much of the neighbouring days a day is made with."""
        around = abs(self.lag_ns) + self.smooth_ns + self.average_ns + self.around_ns
        return INPUT_SETTINGS.margin_cadences * self.cadence_ns + around


def channels_by_name(mission: Mission) -> dict[str, tuple[str, str]]:
    """Return name in the samples -> (instrument, channel).

    A name that several instruments use is written ``instrument.channel``; the plain name then
    means none of them.
    """
    plain = [name for _, name, _ in mission.channel_instruments()]
    return {
        (name if plain.count(name) == 1 else f"{instrument}.{name}"): (instrument, name)
        for instrument, name, _ in mission.channel_instruments()
    }


def require_days(
    index: ArchiveIndex, needs: Sequence[Need], start: DayLike | None, end: DayLike | None
) -> list[np.datetime64]:
    """Return the days of a half-open span of UTC days on which every instrument measured.

    Raises
    ------
    CatalogError
        When there is none.
    """
    days = [day for day in index.complete_days(needs) if is_within(day, start, end)]
    if not days:
        raise CatalogError(
            "the archive has no day of the span on which every instrument measured",
            remedy="ingest the files first; 'inflight catalog list' shows what is there",
        )
    return days


def evenly_spread(days: Sequence[np.datetime64], most: int) -> list[np.datetime64]:
    """Return some days at most, first and last among them: what a survey reads."""
    places = np.linspace(0, len(days) - 1, min(most, len(days))).round().astype(int)
    return [days[place] for place in np.unique(places)]


def needs_of(mission: Mission, model: Model, extra: Iterable[str] = ()) -> list[Need]:
    """Return what the samples of a model's comparison are made from.

    Parameters
    ----------
    extra : iterable of str
        More channels by name, derived ones too; those the mission has not are skipped.

    Raises
    ------
    SamplesError
        When the model uses a channel the mission has not, or a placebo.
    """
    roles = mission.comparisons[model.comparison].instruments()
    average = averaging_by_role(mission, model.comparison)
    needs = [
        Need(
            name=role,
            instrument=name,
            channel="field",
            cadence_ns=mission.instruments[name].cadence,
            average_ns=average[role],
        )
        for role, name in roles.items()
    ]
    for needed_by in (clock_of, axis_of, ambient_of, range_of):
        needs += needed_by(mission, model.comparison)
    known = _Names(mission)
    used = {channel for entry in model.effects for channel in entry.effect.channels}
    if unknown := {base for name in used for base in known.bases(name)} - known.all:
        raise SamplesError(
            f"the model uses channels the mission has not: {', '.join(sorted(unknown))}",
            remedy=f"the mission has {', '.join(sorted(known.all))}",
        )
    if mission.comparisons[model.comparison].kind == "field_model":
        used |= set(geometry_channels(mission))
    names = used | {name for name in extra if set(known.bases(name)) <= known.all}
    return needs + known.needs(names)


def averaging_by_role(mission: Mission, comparison: str) -> dict[str, int]:
    """Return how long each field of a comparison is averaged before it meets the other one, ns.

    Where one instrument's readings are means over `b` and the other's over `a < b`, the latter are averaged
    over ``sqrt(b^2 - a^2)``: then both weigh the field with the same second moment in time. This is exact
    for ``a = 0``, else to the fourth order of frequency times `b`: at frequencies of ``1 / (4 b)`` and
    ``1 / (2 b)`` the two gains differ by at most 0.1 and 2.2 %. A spin comparison has one instrument, and of
    a platform's vector only the direction counts: nothing is averaged there.
    """
    entry = mission.comparisons[comparison]
    own = {role: mission.instruments[name].averaging for role, name in entry.instruments().items()}
    longest = max(own.values()) if entry.kind in ("scalar", "dual") else 0
    return {role: round(np.sqrt(max(0.0, float(longest) ** 2 - float(a) ** 2))) for role, a in own.items()}


def replaceable_needs(mission: Mission, model: Model, needs: Iterable[Need]) -> list[Need]:
    """Return needs, those marked whose typical value may stand in: what the model's effects are made from.

    Attitudes and positions have no typical value, and measured fields are not replaced.
    """
    used = {
        part.name
        for entry in model.effects
        for name in entry.effect.channels
        for part in parse_channel(name).parts
    }
    used |= {channel for entry in model.effects for channel in entry.effect.channels}
    out = []
    for need in needs:
        kind = mission.instruments[need.instrument].channels[need.channel].kind
        typical = need.channel != "field" and kind not in NO_CAUSE
        out.append(replace(need, replaceable=typical and need.name in used))
    return out


def with_surroundings(
    mission: Mission, models: Iterable[Model], needs: Iterable[Need], least_s: float = 0.0
) -> list[Need]:
    """Return needs of a day whose product is made with as much of its neighbours as its effects look at.

    Parameters
    ----------
    models : iterable of Model
        Of one comparison; the farthest-reaching counts.
    least_s : float
        What is filtered besides reaches so far, s.
    """
    needs = list(needs)
    reach = 0.0
    for model in models:
        role = base_role(mission, model.comparison)
        cadence = next(need.cadence_ns for need in needs if need.name == role) / SECOND
        # One effect's field is made from what the others have corrected.
        reach = max(reach, sum(entry.effect.reach_s(cadence) for entry in model.effects))
    around = int(np.ceil((reach + least_s) * SECOND))
    return [replace(need, around_ns=around) for need in needs]


def geometry_channels(mission: Mission) -> list[str]:
    """Return the names of attitude and position channels, which products use when they exist."""
    return [
        name
        for name, (instrument, channel) in channels_by_name(mission).items()
        if mission.instruments[instrument].channels[channel].kind in ("attitude", "position")
    ]


def channel_needs(mission: Mission) -> tuple[Need, ...]:
    """Return one need for every channel of the mission."""
    return tuple(_need_of(mission, name) for name in channels_by_name(mission))


def clock_of(mission: Mission, comparison: str) -> list[Need]:
    """Return the channel with the spin phase of a spin comparison; none for others.

    Raises
    ------
    SamplesError
        When the mission has no such channel, or several and the comparison names none.
    """
    entry = mission.comparisons[comparison]
    if entry.kind != "spin":
        return []
    found = [
        name
        for name, (instrument, channel) in channels_by_name(mission).items()
        if mission.instruments[instrument].channels[channel].kind in ("sun_pulse", "spin_phase")
        and entry.phase in (None, name)
    ]
    if len(found) != 1:
        listed = f" by the name {entry.phase!r}" if entry.phase else f": {', '.join(found)}" if found else ""
        raise SamplesError(
            f"{len(found)} channels tell the phase of the spin{listed}",
            remedy="give one channel the kind 'sun_pulse' or 'spin_phase' and name it as the 'phase'",
        )
    return [replace(_need_of(mission, found[0]), name=SPIN_PHASE)]


def axis_of(mission: Mission, comparison: str) -> list[Need]:
    """Return the channel with the spin axis of a spin comparison; none where there is none.

    Raises
    ------
    SamplesError
        When the comparison names a channel the mission has not, or one of another kind.
    """
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or not isinstance(entry.spin_axis, str):
        return []
    home = channels_by_name(mission).get(entry.spin_axis)
    if home is None or mission.instruments[home[0]].channels[home[1]].kind != "spin_axis":
        raise SamplesError(
            f"no channel of kind 'spin_axis' has the name {entry.spin_axis!r}",
            remedy="name one as the 'spin_axis' of the comparison, or state frame and direction there",
        )
    return [replace(_need_of(mission, entry.spin_axis), name=SPIN_AXIS)]


def ambient_of(mission: Mission, comparison: str) -> list[Need]:
    """Return the known ambient field of a dual comparison; none where there is none."""
    entry = mission.comparisons[comparison]
    if entry.kind != "dual" or entry.ambient is None:
        return []
    return [
        Need(
            name=AMBIENT,
            instrument=entry.ambient,
            channel="field",
            cadence_ns=mission.instruments[entry.ambient].cadence,
        )
    ]


def range_of(mission: Mission, comparison: str) -> list[Need]:
    """Return the channel that tells the range of a scalar comparison; none where it states no range."""
    entry = mission.comparisons[comparison]
    if entry.kind != "scalar" or entry.range is None:
        return []
    homes = channels_by_name(mission)
    (name,) = (one for one, home in homes.items() if entry.range.channel in (one, home[1], ".".join(home)))
    return [replace(_need_of(mission, name), name=RANGE)]


class _Names:
    """The names a model may use of a mission: its channels, what geometry adds, what is made of both."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.homes = channels_by_name(mission)
        self.all = set(self.homes) | (set(GEOMETRY) if position_channel(mission) else set())

    def bases(self, name: str) -> tuple[str, ...]:
        """Return the channels a name is made from; a channel of the mission may be called anything."""
        return (name,) if name in self.homes else base_channels(name)

    def needs(self, names: Iterable[str]) -> list[Need]:
        """Return the series that names are made from, each once, in the order of their names."""
        found: dict[str, Need] = {}
        for name in sorted(names):
            parts = (ChannelFactor(name),) if name in self.homes else parse_channel(name).parts
            for part in parts:
                for need in self.needs_of_part(part, (name,) if len(parts) > 1 else ()):
                    before = found.get(need.name)
                    products = (*before.products, *need.products) if before else need.products
                    found[need.name] = replace(need, products=products)
        return [found[name] for name in sorted(found)]

    def needs_of_part(self, part: ChannelFactor, products: tuple[str, ...]) -> list[Need]:
        """Return the series a part is made from; what geometry adds comes from position and attitude."""
        if part.placebo:
            raise SamplesError(
                f"'{part.name}' is a placebo, which only a search makes", remedy="drop it from the model"
            )
        if part.channel in self.homes:
            return [_need_of(self.mission, part.channel, None if part.is_plain else part, products)]
        needs = [_need_of(self.mission, name, None, products) for name in geometry_channels(self.mission)]
        if not part.is_plain:
            position = _need_of(self.mission, position_channel(self.mission), part, products)
            needs.append(replace(position, name=part.name))
        return needs


def _need_of(
    mission: Mission, name: str, part: ChannelFactor | None = None, products: tuple[str, ...] = ()
) -> Need:
    """Return the need of one channel; `part` is what is made of it."""
    instrument, channel = channels_by_name(mission)[name]
    described = mission.instruments[instrument].channels[channel]
    return Need(
        name=part.name if part else name,
        instrument=instrument,
        channel=channel,
        cadence_ns=mission.instruments[instrument].cadence,
        lag_ns=described.lag,
        part=part,
        products=products,
        smooth_ns=described.smooth,
    )


def base_role(mission: Mission, comparison: str) -> str:
    """Return the role whose stamps carry the samples: the stated one, else the slowest instrument."""
    entry = mission.comparisons[comparison]
    roles = entry.instruments()
    if entry.base:
        return next(role for role, name in roles.items() if name == entry.base)
    return max(roles, key=lambda role: mission.instruments[roles[role]].cadence)


_DAY = np.timedelta64(1, "D")


@dataclass(frozen=True)
class ArchiveIndex:
    """The published days of the archive that some needs are made from; no database behind it.

    Attributes
    ----------
    days : mapping of (dataset, day) to Day
        What is there.
    before : int
        Days before its own that a day's samples are made from.
    replaceable : tuple of Need
        Those whose typical value is taken where they are missing.
    """

    days: Mapping[tuple[str, np.datetime64], Day]
    before: int = 1
    replaceable: tuple[Need, ...] = ()

    @classmethod
    def of(cls, cat: Catalog, needs: Sequence[Need], time: slice | None = None) -> ArchiveIndex:
        """Read the index from the catalog, one query a dataset."""
        return cls(
            {
                (name, day.day): day
                for name in sorted({need.dataset for need in needs})
                for day in cat.days(name, time, states=("published",))
            },
            max((need.days_before for need in needs), default=1),
            tuple(need for need in needs if need.replaceable),
        )

    def get(self, need: Need, day: np.datetime64) -> Day | None:
        """Return the published day a need is read from."""
        return self.days.get((need.dataset, day))

    def around(self, days: Sequence[np.datetime64]) -> ArchiveIndex:
        """Return the part some days need, their neighbours included: what a worker is sent."""
        near = {day + step * _DAY for day in days for step in range(-self.before, 2)}
        others = {
            (one.dataset, one.day)
            for need in self.replaceable
            for day in days
            for one in self.typical_days(need, day)
        }
        return ArchiveIndex(
            {key: day for key, day in self.days.items() if key[1] in near or key in others},
            self.before,
            self.replaceable,
        )

    def typical_days(self, need: Need, day: np.datetime64) -> list[Day]:
        """Return the days that a channel's typical value comes from: the day itself, else the nearest two.

        One before and one after, at most `INPUTS.typical_value_days` away; none when there is none. A day
        that hardly has the channel counts only when no other does.
        """

        def coverage(source: Day) -> float:
            """Return the part of a day with values; 1 where the archive does not state it."""
            channels = source.report.get("channels", {})
            return float(channels.get(need.channel, {}).get("coverage", 1.0))

        far = INPUT_SETTINGS.typical_value_days + 1
        for least in (INPUT_SETTINGS.least_coverage, np.finfo(float).tiny):
            for sides in ((range(1),), (range(-1, -far, -1), range(1, far))):
                found = []
                for side in sides:
                    there = (self.get(need, day + step * _DAY) for step in side)
                    good = (one for one in there if one is not None and coverage(one) >= least)
                    found += list(itertools.islice(good, 1))
                if found:
                    return found
        return []

    def complete_days(self, needs: Sequence[Need]) -> list[np.datetime64]:
        """Return the days on which every field is there."""
        sets = [
            {day for name, day in self.days if name == need.dataset}
            for need in needs
            if need.name in FIELD_ROLES
        ]
        return sorted(set.intersection(*sets)) if sets else []

    def sources(self, needs: Sequence[Need], day: np.datetime64, base: Need) -> list[Day]:
        """Return the archive days one day's samples are made from, in a fixed order."""
        found = []
        before = [need.days_before for need in needs]
        near = {step: day + step * _DAY for step in range(-max(before, default=0), 2)}
        for need, earliest in zip(needs, before, strict=True):
            steps = range(1) if self.shares_stamps(need, base, day) else range(-earliest, 2)
            found += [self.get(need, near[step]) for step in steps]
            if need.replaceable:
                found += self.typical_days(need, day)
        unique = {source.id: source for source in found if source is not None}
        return [unique[key] for key in sorted(unique)]

    def shares_stamps(self, need: Need, base: Need, day: np.datetime64) -> bool:
        """Return True when a series has the base's stamps, and a day of it needs none of its neighbours.

        The phase of the spin and its axis always run on over midnight.
        """
        own, other = self.get(need, day), self.get(base, day)
        if own is None or other is None:
            return True
        if need.lag_ns or need.part or need.smooth_ns or need.average_ns or need.around_ns:
            return False
        if need.name in (SPIN_PHASE, SPIN_AXIS):
            return False
        if need.cadence_ns != base.cadence_ns:
            return False
        return (own.first_tt2000 - other.first_tt2000) % need.cadence_ns == 0
