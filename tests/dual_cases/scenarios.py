"""Random two-sensor cases with known truth: units as dipoles in a body, an ambient field, two sensors.

No correction of `inflight.dual` is used: the truth is dipoles and random numbers. The ranges were fixed
before any correction was tried on them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from inflight.arrays import Floats
from inflight.dual import Body, Readings
from inflight.time import SECOND

#: What makes the stray field; `null` has none.
FAMILIES = ("steps", "drift", "tones", "torquers", "mixed", "null")
SHARES = (0.34, 0.11, 0.11, 0.11, 0.19, 0.14)
#: Units stand within this part of the inboard sensor's distance, on each axis.
_BODY = 0.3
AMBIENTS = ("quiet", "turbulent", "discontinuities")


@dataclass(frozen=True)
class Case:
    """A case and its truth; fields in nT, spacecraft axes."""

    seed: int
    family: str
    ambient_kind: str
    readings: Readings
    ambient: Floats  # (time, axis)
    stray: Floats  # (time, axis), at the outboard sensor
    noise_rms: float  # of the outboard sensor, white and coloured
    ratio: float  # size of the units' field at the outboard over that at the inboard sensor
    cadence: float  # s
    body: Body  # where the sensors are, and the box in which all units stand
    facts: dict[str, float] = field(default_factory=dict)

    @property
    def stray_rms(self) -> float:
        """Size of the part of the stray field that changes, a component."""
        return float(np.sqrt(np.mean(np.var(self.stray, axis=0))))

    @property
    def exceeds(self) -> bool:
        """Whether the changing stray field is larger than the outboard sensor's noise."""
        return self.stray_rms > self.noise_rms


def make_case(seed: int, family: str | None = None) -> Case:
    """Make one case from its seed alone; the family may be chosen."""
    random = np.random.default_rng([20_260, seed])
    chosen = str(random.choice(FAMILIES, p=SHARES))
    family = chosen if family is None else family
    cadence = float(random.choice([0.1, 0.2, 0.5, 1.0]))
    count = int(random.integers(6_000, 20_000))
    kind = str(random.choice(AMBIENTS, p=[0.4, 0.35, 0.25]))
    ambient = _ambient(random, count, cadence, kind)
    stray_in, stray_out, body, ratio = _stray(random, count, cadence, family)
    noise_out, noise_in, coloured, drift = _noises(random, count)
    leak = _leak(random)
    outboard = ambient + stray_out + noise_out + random.normal(0.0, 1.0, 3)
    inboard = ambient @ (np.eye(3) + leak).T + stray_in + noise_in + random.normal(0.0, 1.0, 3)
    keep = _gaps(random, count, inboard, outboard)
    stamps = (np.arange(count) * cadence * SECOND).astype(np.int64)[keep] + 700_000_000 * SECOND
    readings = Readings(stamps, inboard[keep], outboard[keep])
    noise = float(np.sqrt(np.mean(np.var(noise_out, axis=0))))
    facts = {"leak": float(np.abs(leak).max()), "coloured": coloured, "offset_drift": drift}
    return Case(
        seed, family, kind, readings, ambient[keep], stray_out[keep], noise, ratio, cadence, body, facts
    )


def _ambient(random: np.random.Generator, count: int, cadence: float, kind: str) -> Floats:
    """Return a mean field and red noise; with jumps of its own for `discontinuities`."""
    size = _log(random, 0.05, 1.0) if kind == "quiet" else _log(random, 0.5, 8.0)
    slope = random.uniform(1.5, 2.2) if kind == "quiet" else random.uniform(1.4, 1.8)
    whole = size * coloured_noise(random, count, slope) + random.normal(0.0, 20.0, 3)
    if kind == "turbulent":  # the level itself comes and goes
        whole *= 1.0 + 0.5 * np.sin(2 * np.pi * np.arange(count)[:, None] / count * random.integers(1, 6))
    if kind == "discontinuities":
        for place in random.integers(0, count, int(random.integers(4, 30))):
            width = max(float(random.exponential(3.0 / cadence)), 0.5)
            rise = 0.5 * (1.0 + np.tanh((np.arange(count) - place) / width))
            whole += rise[:, None] * random.normal(0.0, 2.0 * size, 3)
    return whole


def coloured_noise(random: np.random.Generator, count: int, slope: float) -> Floats:
    """Return noise whose power falls with this power of frequency; (count, 3), rms 1."""
    frequency = np.fft.rfftfreq(2 * count)
    spectrum = random.normal(size=(3, frequency.size)) + 1j * random.normal(size=(3, frequency.size))
    spectrum[:, 1:] *= frequency[1:] ** (-slope / 2)
    spectrum[:, 0] = 0.0
    series = np.fft.irfft(spectrum, axis=1)[:, :count].T
    return np.asarray(series / series.std())


def _stray(
    random: np.random.Generator, count: int, cadence: float, family: str
) -> tuple[Floats, Floats, Body, float]:
    """Return the stray field at both sensors, where everything is, and the ratio of its sizes."""
    ratio = random.uniform(0.05, 0.7)
    far = random.uniform(1.0, 6.0)
    near = far * ratio ** (1.0 / 3.0)
    sensors = np.array([[near, 0.0, 0.0], [far, 0.0, 0.0]])
    inboard, outboard = np.zeros((count, 3)), np.zeros((count, 3))
    size = _log(random, 0.03, 10.0)
    for series in _currents(random, count, cadence, family):
        place = random.uniform(-_BODY, _BODY, 3) * near
        moment = random.normal(size=3)
        fields = [_dipole(sensor - place, moment) for sensor in sensors]
        scale = size * random.lognormal(0.0, 0.5) / np.linalg.norm(fields[1])
        inboard += scale * series[:, None] * fields[0]
        outboard += scale * series[:, None] * fields[1]
    return inboard, outboard, Body(sensors, np.zeros(3), np.full(3, _BODY * near)), ratio


def _dipole(place: Floats, moment: Floats) -> Floats:
    distance = np.linalg.norm(place)
    unit = place / distance
    return np.asarray((3.0 * unit * (unit @ moment) - moment) / distance**3)


def _currents(random: np.random.Generator, count: int, cadence: float, family: str) -> list[Floats]:
    """Return the current of each unit, about 1 in size."""
    makers = {"steps": _switched, "drift": _drifting, "tones": _tone, "torquers": _torquer}
    if family == "null":
        return []
    if family != "mixed":
        return [makers[family](random, count, cadence) for _ in range(int(random.integers(1, 6)))]
    parts = [_switched(random, count, cadence) for _ in range(int(random.integers(1, 5)))]
    others = random.choice(["drift", "tones", "torquers"], size=int(random.integers(1, 4)))
    return parts + [_log(random, 0.1, 1.0) * makers[str(one)](random, count, cadence) for one in others]


def _switched(random: np.random.Generator, count: int, cadence: float) -> Floats:
    """Return 0 and 1 in turn, dwelling a random time."""
    dwell = _log(random, 60.0, count / 4)
    lengths = 10 + random.exponential(dwell, 2 + int(3 * count / dwell)).astype(np.int64)
    turns = np.searchsorted(np.cumsum(lengths), np.arange(count), side="right") + random.integers(2)
    level = (turns % 2).astype(np.float64)
    if random.random() < 0.3:  # a heater's current settles
        answer = np.exp(-np.arange(60) / 8.0)
        level = np.convolve(level, answer / answer.sum(), mode="full")[:count]
    return level


def _drifting(random: np.random.Generator, count: int, cadence: float) -> Floats:
    if random.random() < 0.5:
        return coloured_noise(random, count, 2.0)[:, 0]
    time = np.arange(count) / count
    return np.asarray(1.5 * np.exp(-time / random.uniform(0.1, 0.6)) + random.normal() * time)


def _tone(random: np.random.Generator, count: int, cadence: float) -> Floats:
    frequency = _log(random, 0.003, 0.4)  # of the sampling frequency
    phase = 2 * np.pi * frequency * np.arange(count) + random.uniform(0, 2 * np.pi)
    wander = np.cumsum(random.normal(0.0, _log(random, 1e-4, 1e-2), count))
    return np.asarray(np.sin(phase + wander))


def _torquer(random: np.random.Generator, count: int, cadence: float) -> Floats:
    """Return a slow sine given in pulses of a duty cycle, with pauses."""
    period = int(random.integers(10, 60))
    wanted = np.sin(
        2 * np.pi * np.arange(count) / (count / random.uniform(1.0, 6.0)) + random.uniform(0, 6.3)
    )
    on = (np.arange(count) % period) < np.abs(wanted) * period
    return np.asarray(np.where(on, np.sign(wanted), 0.0))


def _noises(random: np.random.Generator, count: int) -> tuple[Floats, Floats, float, float]:
    """Return the noise of the outboard and the inboard sensor, its coloured share, the drift of offsets."""
    level = _log(random, 0.005, 0.1)
    levels = level, level * _log(random, 0.5, 4.0)
    share = float(random.choice([0.0, _log(random, 0.2, 1.0)], p=[0.6, 0.4]))
    out, near = (
        one * (random.normal(size=(count, 3)) + share * coloured_noise(random, count, 1.0)) for one in levels
    )
    drift = float(random.choice([0.0, _log(random, 0.01, 0.2)], p=[0.7, 0.3]))
    rise = np.linspace(-1.0, 1.0, count)[:, None]
    out, near = (one + drift * rise * random.uniform(-1.0, 1.0, 3) for one in (out, near))
    return out, near, share, drift


def _leak(random: np.random.Generator) -> Floats:
    """Return what the inboard sensor's angles and scale factors do to the ambient field."""
    size = float(random.choice([0.0, _log(random, 3e-4, 1e-2)], p=[0.3, 0.7]))
    x, y, z = size * random.normal(size=3)
    turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(turn + 0.5 * size * np.diag(random.normal(size=3)))


def _gaps(random: np.random.Generator, count: int, inboard: Floats, outboard: Floats) -> np.ndarray:
    """Return which stamps there are; single readings of one sensor become NaN."""
    keep = np.ones(count, dtype=bool)
    if random.random() < 0.5:
        return keep
    for place in random.integers(0, count, int(random.integers(1, 8))):
        keep[place : place + int(random.integers(1, 200))] = False
    for place in random.integers(0, count, int(random.integers(0, 20))):
        (inboard if random.random() < 0.5 else outboard)[place : place + int(random.integers(1, 20))] = np.nan
    return keep


def _log(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))
