"""Two sensors in trouble: cases that break what the held-out decision assumes, one thing at a time.

Independent of `tests.dual_cases`: another ambient field, other units, and no dipole code in common. Each
maker takes a random generator and returns a case with its truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.dual import Body, Candidates, HeldOutDecision, Readings, choose_correction
from inflight.time import SECOND

#: Samples of a case, and the sensors' distances from the middle of the body, m.
COUNT = 4000
NEAR, FAR = 1.0, 1.8
REACH = 0.35
#: From this ratio of the errors after and before on a correction made a case worse.
WORSE = 1.02


@dataclass(frozen=True)
class Hard:
    """A case and its truth; fields in nT, one row a sample."""

    inboard: Floats
    outboard: Floats
    ambient: Floats
    stray: Floats  # at the outboard sensor
    cadence: float = 1.0  # s
    body: Body | None = None

    @property
    def readings(self) -> Readings:
        stamps = (np.arange(len(self.ambient)) * self.cadence * SECOND).astype(np.int64)
        return Readings(stamps + 600_000_000 * SECOND, self.inboard, self.outboard)


@dataclass(frozen=True)
class Outcome:
    """Errors of a case before and after the decision, without their constants, nT a component."""

    before: float
    after: float
    error_over_sigma: float  # rms error of the correction over its rms sigma; NaN where none is applied
    decision: HeldOutDecision

    @property
    def ratio(self) -> float:
        return self.after / self.before

    @property
    def applied(self) -> bool:
        return self.decision.chosen != "none"


def outcome(case: Hard) -> Outcome:
    """Decide on a case and compare with the truth."""
    readings = case.readings
    candidates = Candidates(readings, case.body)
    decision = choose_correction(readings, candidates.fit, candidates.priors)
    good, found = readings.good, decision.correction
    before = _size((readings.outboard - case.ambient)[good])
    after = _size((found.corrected(readings.outboard) - case.ambient)[good])
    known = found.known & good
    error_over_sigma = float("nan")
    if found.applied and known.any():
        error_over_sigma = _size((found.field - case.stray)[known]) / float(
            np.sqrt(np.mean(found.sigma[known] ** 2))
        )
    return Outcome(before, after, error_over_sigma, decision)


def _size(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.var(values, axis=0)))) if len(values) else float("nan")


def body() -> Body:
    return Body(np.array([[NEAR, 0.0, 0.0], [FAR, 0.0, 0.0]]), np.zeros(3), np.full(3, REACH))


def wandering(random: np.random.Generator, count: int, size: float) -> Floats:
    """Return a sum of fields that forget after 3, 30 and 300 samples and so on, and a constant."""
    whole = np.zeros((count, 3))
    memory = 3.0
    while memory < 2 * count:
        keep = np.exp(-1.0 / memory)
        steps = random.normal(0.0, np.sqrt(1.0 - keep**2), (count, 3))
        value = random.normal(size=3)
        for row in range(count):
            value = keep * value + steps[row]
            whole[row] += value * memory**0.33
        memory *= 10.0
    return np.asarray(size * whole / whole.std() + random.normal(0.0, 15.0, 3))


def square_wave(random: np.random.Generator, count: int) -> Floats:
    """Return 0 and 1 in turn with dwells of a share of the record."""
    dwell = count / random.uniform(6.0, 60.0)
    edges = np.cumsum(5 + random.exponential(dwell, 300))
    return ((np.searchsorted(edges, np.arange(count)) + random.integers(2)) % 2).astype(np.float64)


def magnet(place: Floats, moment: Floats, sensor: Floats) -> Floats:
    """Return the field of two opposite poles 2 mm apart, in units of 1/m^3 of the moment."""
    axis = 1e-3 * moment / np.linalg.norm(moment)
    total = np.zeros(3)
    for sign in (1.0, -1.0):
        away = sensor - place - sign * axis
        total += sign * away / np.linalg.norm(away) ** 3
    return np.asarray(total * np.linalg.norm(moment) / 2e-3)


def loop(corners: Floats, sensor: Floats) -> Floats:
    """Return the field of a closed polygon of current (corner, axis), Biot and Savart in short pieces."""
    total = np.zeros(3)
    for first, last in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        cuts = np.linspace(first, last, 41)
        middle, piece = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts, axis=0)
        away = sensor - middle
        total += np.sum(np.cross(piece, away) / np.linalg.norm(away, axis=1)[:, None] ** 3, axis=0)
    return total


Fields = tuple[Floats, Floats]


def units(
    random: np.random.Generator,
    count: int,
    size: float,
    place: Callable[[np.random.Generator], Floats],
) -> Fields:
    """Return the field of one to four switched magnets at both sensors; `size` nT at the outboard."""
    sensors = body().positions
    both = np.zeros((2, count, 3))
    for _ in range(int(random.integers(1, 5))):
        where, moment = place(random), random.normal(size=3)
        fields = np.array([magnet(where, moment, sensor) for sensor in sensors])
        both += size / np.linalg.norm(fields[1]) * square_wave(random, count)[:, None] * fields[:, None, :]
    return both[0], both[1]


def inside(random: np.random.Generator) -> Floats:
    return random.uniform(-REACH, REACH, 3)


def case(
    random: np.random.Generator,
    stray: Fields | None = None,
    count: int = COUNT,
    ambient: Floats | None = None,
    size: float | None = None,
) -> Hard:
    """Return an ordinary case: white noise of 5 to 50 pT, an ambient field of 0.1 to 5 nT."""
    if ambient is None:
        ambient = wandering(random, count, 10.0 ** random.uniform(-1.0, 0.7))
    if stray is None:
        chosen = 10.0 ** random.uniform(-1.5, 0.8) if size is None else size
        stray = units(random, count, chosen, inside)
    noise = 10.0 ** random.uniform(-2.3, -1.3)
    near, far = (noise * random.lognormal(0.0, 0.4) * random.normal(size=(count, 3)) for _ in range(2))
    return Hard(ambient + stray[0] + near, ambient + stray[1] + far, ambient, stray[1], body=body())


def nothing(count: int = COUNT) -> Fields:
    return np.zeros((count, 3)), np.zeros((count, 3))


def ordinary(random: np.random.Generator) -> Hard:
    return case(random)


def outside_the_body(random: np.random.Generator) -> Hard:
    """Units beside or behind the body that was told, 1 to 2.5 times its size away."""

    def place(random: np.random.Generator) -> Floats:
        away = random.normal(size=3)
        away[0] = -abs(away[0])
        return np.asarray(away / np.linalg.norm(away) * REACH * random.uniform(1.2, 2.5))

    return case(random, units(random, COUNT, 10.0 ** random.uniform(-1.5, 0.8), place))


def beside_the_outboard_sensor(random: np.random.Generator) -> Hard:
    """One unit at the far end of the boom: stronger at the outboard sensor than at the inboard one."""

    def place(random: np.random.Generator) -> Floats:
        return np.array([FAR + 0.3, 0.0, 0.0]) + random.uniform(-0.25, 0.25, 3)

    return case(random, units(random, COUNT, 10.0 ** random.uniform(-1.5, 0.8), place))


def between_the_sensors(random: np.random.Generator) -> Hard:
    """One unit on the boom between both sensors, such as a hinge or a heater."""

    def place(random: np.random.Generator) -> Floats:
        along = random.uniform(NEAR + 0.1, FAR - 0.1)
        return np.array([along, 0.0, 0.0]) + random.uniform(-0.15, 0.15, 3)

    return case(random, units(random, COUNT, 10.0 ** random.uniform(-1.5, 0.8), place))


def solar_array(random: np.random.Generator) -> Hard:
    """A current loop some metres long beside the body, outside of what was told."""
    width, length = random.uniform(0.4, 1.2), random.uniform(1.0, 4.0)
    root = np.array([random.uniform(-0.5, 0.3), 0.4, random.uniform(-0.3, 0.3)])
    if random.random() < 0.5:
        root[1] = -0.4 - length
    tilt = random.uniform(0.0, np.pi)
    across = width * np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    along = np.array([0.0, length, 0.0])
    corners = np.array([root, root + along, root + along + across, root + across])
    fields = np.array([loop(corners, sensor) for sensor in body().positions])
    fields *= 10.0 ** random.uniform(-1.5, 0.8) / np.linalg.norm(fields[1])
    current = 1.0 + 0.3 * np.sin(np.arange(COUNT) / random.uniform(50.0, 2000.0))
    current = current * (1.0 - square_wave(random, COUNT) * random.uniform(0.0, 1.0))
    return case(random, (current[:, None] * fields[0], current[:, None] * fields[1]))


def dead_inboard(random: np.random.Generator) -> Hard:
    """The inboard sensor gives noise and a constant: the difference is minus the ambient field."""
    made = case(random)
    return replace(made, inboard=random.normal(0.0, 10.0 ** random.uniform(-2.0, 0.5), made.inboard.shape))


def dead_outboard(random: np.random.Generator) -> Hard:
    """The outboard sensor gives noise and a constant."""
    made = case(random)
    noise = random.normal(0.0, 10.0 ** random.uniform(-2.0, 0.5), made.outboard.shape)
    return replace(made, outboard=noise)


def weak_inboard(random: np.random.Generator) -> Hard:
    """The inboard sensor's gain has fallen to a part of itself."""
    made = case(random)
    return replace(made, inboard=made.inboard * random.uniform(0.1, 0.9))


def gain_of_inboard(random: np.random.Generator) -> Hard:
    """One axis or all axes of the inboard sensor are 5 per cent off."""
    made = case(random, nothing() if random.random() < 0.5 else None)
    gain = np.ones(3)
    gain[slice(None) if random.random() < 0.5 else random.integers(3)] += 0.05 * random.choice([-1, 1])
    return replace(made, inboard=made.inboard * gain)


def crosstalk(random: np.random.Generator) -> Hard:
    """Each axis of the inboard sensor holds 3 per cent of the others."""
    made = case(random, nothing() if random.random() < 0.5 else None)
    return replace(made, inboard=made.inboard @ (np.eye(3) + random.normal(0.0, 0.03, (3, 3))))


def late_by(samples: float) -> Callable[[np.random.Generator], Hard]:
    """Return the maker of cases whose inboard sensor is late, under a lively ambient field."""

    def made(random: np.random.Generator) -> Hard:
        ambient = wandering(random, COUNT, 10.0 ** random.uniform(-0.3, 1.0))
        one = case(random, nothing() if random.random() < 0.5 else None, ambient=ambient)
        rows = np.arange(COUNT) - samples * random.choice([-1.0, 1.0])
        late = np.column_stack([np.interp(rows, np.arange(COUNT), axis) for axis in one.inboard.T])
        return replace(one, inboard=late)

    return made


def slow_inboard(random: np.random.Generator) -> Hard:
    """The inboard sensor is filtered: it follows with a time constant of 2 to 20 samples."""
    one = case(random, nothing() if random.random() < 0.5 else None)
    keep = np.exp(-1.0 / random.uniform(2.0, 20.0))
    out = one.inboard.copy()
    for row in range(1, len(out)):
        out[row] = keep * out[row - 1] + (1.0 - keep) * out[row]
    return replace(one, inboard=out)


def warm_day(random: np.random.Generator) -> Hard:
    """Offsets of one or both sensors follow the temperature: a daily sine of 0.5 nT, half to two days."""
    made = case(random, nothing() if random.random() < 0.7 else None)
    days = random.uniform(0.5, 2.0)
    phase = random.uniform(0.0, 2 * np.pi)
    wave = np.sin(2 * np.pi * days * np.arange(COUNT) / COUNT + phase)[:, None]
    which = random.integers(3)
    near, far = (0.5 * wave * random.normal(0.0, 1.0, 3) / np.sqrt(3.0) for _ in range(2))
    inboard = made.inboard + (near if which != 1 else 0.0)
    outboard = made.outboard + (far if which != 0 else 0.0)
    return replace(made, inboard=inboard, outboard=outboard, cadence=days * 86400.0 / COUNT)


def storm(random: np.random.Generator) -> Hard:
    """An ambient field that is quiet for most of the record and then thirty times as lively."""
    calm = wandering(random, COUNT, 0.1)
    wild = wandering(random, COUNT, 3.0) - calm.mean(axis=0)
    start = int(random.uniform(0.5, 0.9) * COUNT)
    ambient = calm + np.where(np.arange(COUNT) > start, 1.0, 0.0)[:, None] * (wild - wild[start])
    made = case(random, nothing() if random.random() < 0.3 else None, ambient=ambient)
    return replace(made, inboard=made.inboard @ (np.eye(3) + random.normal(0.0, 0.005, (3, 3))))


def turning(random: np.random.Generator) -> Hard:
    """A field of 20 nT that turns in the spacecraft's axes; sensors misaligned by half a degree."""
    phase = 2 * np.pi * np.arange(COUNT) / random.uniform(50.0, 3000.0)
    ambient = 20.0 * np.column_stack([0.3 * np.cos(phase), np.sin(phase), np.cos(phase)])
    ambient += wandering(random, COUNT, 0.3)
    made = case(random, nothing() if random.random() < 0.5 else None, ambient=ambient)
    return replace(made, inboard=made.inboard @ (np.eye(3) + random.normal(0.0, 0.01, (3, 3))))


def torquers_follow_the_field(random: np.random.Generator) -> Hard:
    """Moments that answer to the change of the field, as a detumbling controller commands them."""
    phase = 2 * np.pi * np.arange(COUNT) / random.uniform(500.0, 3000.0)
    ambient = 30.0 * np.column_stack([0.4 * np.cos(phase + 1.0), np.sin(phase), np.cos(phase)])
    ambient += wandering(random, COUNT, 0.3)
    moment = -np.gradient(ambient, axis=0)
    moment /= np.abs(moment).max()
    where = inside(random)
    each = np.array([[magnet(where, e, sensor) for e in np.eye(3)] for sensor in body().positions])
    each *= 10.0 ** random.uniform(-1.0, 1.0) / np.linalg.norm(each[1])
    return case(random, (moment @ each[0], moment @ each[1]), ambient=ambient)


def ten_minutes(random: np.random.Generator) -> Hard:
    return case(random, nothing(600) if random.random() < 0.3 else None, count=600)


def axis_stuck(random: np.random.Generator) -> Hard:
    """One axis of the inboard sensor stands at one value."""
    made = case(random)
    made.inboard[:, random.integers(3)] = random.normal(0.0, 20.0)
    return made


def axes_exchanged(random: np.random.Generator) -> Hard:
    """Two axes of the inboard sensor are exchanged, or one has the wrong sign."""
    made = case(random)
    turned = made.inboard[:, [1, 0, 2]] if random.random() < 0.5 else made.inboard * [1.0, -1.0, 1.0]
    return replace(made, inboard=turned)


def coarse(random: np.random.Generator) -> Hard:
    """Readings in steps of 0.1 nT."""
    made = case(random)
    return replace(made, inboard=np.round(made.inboard, 1), outboard=np.round(made.outboard, 1))


def walking_offsets(random: np.random.Generator) -> Hard:
    """No stray field; the offset of one sensor walks, twice as far as `wander.DRIFT` says of both."""
    made = case(random, nothing())
    far = 0.06 * np.sqrt(COUNT / 3600.0)
    walk = np.cumsum(random.normal(0.0, far / np.sqrt(COUNT), (COUNT, 3)), axis=0)
    if random.random() < 0.5:
        return replace(made, inboard=made.inboard + walk)
    return replace(made, outboard=made.outboard + walk)


def jumping_offset(random: np.random.Generator) -> Hard:
    """No stray field; the offset of one sensor jumps to and fro like a unit that is switched."""
    made = case(random, nothing())
    walk = square_wave(random, COUNT)[:, None] * random.normal(0.0, 0.2, 3)
    if random.random() < 0.5:
        return replace(made, inboard=made.inboard + walk)
    return replace(made, outboard=made.outboard + walk)


MAKERS: dict[str, Callable[[np.random.Generator], Hard]] = {
    "ordinary": ordinary,
    "outside the body": outside_the_body,
    "beside the outboard sensor": beside_the_outboard_sensor,
    "between the sensors": between_the_sensors,
    "solar array": solar_array,
    "dead inboard": dead_inboard,
    "dead outboard": dead_outboard,
    "weak inboard": weak_inboard,
    "gain": gain_of_inboard,
    "crosstalk": crosstalk,
    "half a sample late": late_by(0.5),
    "slow inboard": slow_inboard,
    "warm day": warm_day,
    "storm": storm,
    "turning": turning,
    "torquers follow the field": torquers_follow_the_field,
    "ten minutes": ten_minutes,
    "axis stuck": axis_stuck,
    "axes exchanged": axes_exchanged,
    "coarse": coarse,
    "walking offsets": walking_offsets,
    "jumping offset": jumping_offset,
}


def make(name: str, seed: int) -> Hard:
    """Make a case of its name and seed; every other one is told nothing of positions."""
    made = MAKERS[name](np.random.default_rng([7, seed, len(name), sum(map(ord, name))]))
    return made if seed % 2 == 0 else replace(made, body=None)
