"""One simulated day of a spinning spacecraft: what it delivers, and the truth behind it."""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy
import xarray as xr

from inflight.simulate.defects import cut_gaps
from inflight.simulate.grid import Float, Int64, Sampling
from inflight.simulate.mission import SimulatedDay, delivery
from inflight.simulate.randomness import generator
from inflight.simulate.spinning import ambient, attitude, sensor
from inflight.simulate.spinning.settings import SpinningSettings
from inflight.time import SECOND, DayLike, as_day, day_bounds

#: Seconds between temperatures, and how long before the day heat balances start.
_SLOW, _WARM_UP = 10, 24_000
#: Temperatures the sensor relaxes to in light and in shadow, degC, and the relaxation time, s.
_WARM, _COLD, _RELAX = 12.0, -45.0, 2400.0
#: Slow variation of the phase about a steady turn: amplitude, rad, and period, s.
_SWING, _SWING_S = 0.4, 40_000.0
#: The coil is driven in runs of so many seconds, every so many.
_COIL_ON, _COIL_EVERY = 9_000.0, 26_000.0
_FALSE_S = 0.37


def simulate_spinning_day(settings: SpinningSettings, day: DayLike) -> SimulatedDay:
    """Return one day of a simulated spinning mission, the same whatever other days are asked for.

    Parameters
    ----------
    settings : SpinningSettings
        The mission; what drifts counts from its `start`.
    day : date, str or datetime64
        UTC.

    Returns
    -------
    SimulatedDay
        Instruments ``fgm``: FGM_RAW (record, axis) nT, T_SENSOR degC, FGM_FLAG; ``sun``: SPIN_PERIOD s at
        every sun pulse; ``hk``: I_COIL, I_SOL mA; ``slow``: T_ELECTRONICS degC, SHADOW; ``orb``: POS_GSE
        km and ``att``: SPIN_AXIS (record, 2) deg, right ascension and declination of date (both only with
        an orbit). Truth: FIELD (record, axis) nT in payload axes, PHASE rad (unwrapped from the day's
        begin), OFFSET (record, axis) nT.
    """
    scene = _Scene(settings, as_day(day))
    instruments = {
        "fgm": scene.magnetometer(),
        "sun": scene.pulses(),
        "hk": scene.currents(),
        "slow": scene.slow(),
    }
    if scene.parameters.apogee > 0.0:
        instruments["orb"] = scene.orbit()
        instruments["att"] = scene.spin_axis()
    return SimulatedDay(scene.day, instruments, scene.truth())


class _Scene:
    """Everything about one day, each part computed once when first needed."""

    def __init__(self, settings: SpinningSettings, day: np.datetime64) -> None:
        self.settings, self.parameters, self.effects = settings, settings.parameters, settings.effects
        self.day, self.number = day, int(day.astype(np.int64))
        self.start, self.end = day_bounds(day)
        self.first = day_bounds(np.datetime64(settings.start, "D"))[0] / SECOND
        self.times = Sampling.of_span(self.start, self.end, round(self.parameters.cadence * SECOND))

    def _random(self, stream: str) -> np.random.Generator:
        return generator(self.settings.seed, stream, self.number)

    def _phase(self, seconds: Float) -> Float:
        """Return the angle of the body from the Sun, rad."""
        since = seconds - self.first
        swing = _SWING * np.sin(2.0 * np.pi * since / _SWING_S)
        return np.asarray(2.0 * np.pi * since / self.parameters.spin_period + swing)

    @cached_property
    def phase(self) -> Float:
        return self._phase(self.times.seconds)

    @cached_property
    def field(self) -> Float:
        """Ambient field, payload axes."""
        seconds = self.times.seconds
        place = ambient.position(seconds, self.parameters)
        return ambient.field(seconds, place, self.settings.seed, self.number, self.parameters)

    @cached_property
    def _heat(self) -> tuple[Float, Float, np.ndarray]:
        """Seconds, temperature of the sensor and shadow every ten seconds from the warm-up on."""
        steps = np.arange(-_WARM_UP, (self.end - self.start) // SECOND + _SLOW, _SLOW)
        seconds = np.asarray(self.start / SECOND + steps, dtype=np.float64)
        dark = ambient.in_shadow(ambient.position(seconds, self.parameters))
        target = np.where(dark, _COLD, _WARM) + 3.0 * np.sin(2.0 * np.pi * (seconds - self.first) / 30_000.0)
        keep = np.exp(-_SLOW / _RELAX)
        warm, _ = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], target, zi=np.array([keep * target[0]]))
        return seconds, np.asarray(warm), dark

    @cached_property
    def warm(self) -> Float:
        """Temperature of the sensor less the reference, K, at the samples."""
        seconds, warm, _ = self._heat
        return np.asarray(
            np.interp(self.times.seconds, seconds, warm) - self.parameters.reference_temperature
        )

    @cached_property
    def shadow(self) -> np.ndarray:
        seconds, _, dark = self._heat
        return np.asarray(dark[np.searchsorted(seconds, self.times.seconds, side="right") - 1])

    @cached_property
    def coil(self) -> Float:
        """Current of the coil that is driven at the spin, A."""
        on = np.mod(self.times.seconds - self.first, _COIL_EVERY) < _COIL_ON
        return np.asarray(on * self.parameters.torquer_current * np.tanh(3.0 * np.cos(self.phase + 0.7)))

    @cached_property
    def array(self) -> Float:
        """Current of an array of four flat panels around the body, A."""
        around = self.phase[:, None] + 0.5 * np.pi * np.arange(4)
        return np.asarray(1.6 * (~self.shadow) * np.clip(np.cos(around), 0.0, None).sum(axis=1))

    @cached_property
    def offsets(self) -> Float:
        return sensor.zero(self.times.seconds, self.warm, self.first, self.parameters, self.effects)

    @cached_property
    def body_field(self) -> Float:
        """Field at the sensor in the turning body, with what the spacecraft adds."""
        out = sensor.apparent(self.field, self.phase)
        if "torquer" in self.effects:
            # nT for an ampere times ten: a field of its own size at the usual current.
            out = out + self.coil[:, None] / self.parameters.torquer_current * self.parameters.torquer_field
        if "solar_array" in self.effects:
            out = out + self.array[:, None] * self.parameters.array_field
        return out

    def magnetometer(self) -> xr.Dataset:
        """What the magnetometer delivers."""
        p, defects = self.parameters, self.settings.defects
        elapsed = self.number - int(np.datetime64(self.settings.start, "D").astype(np.int64))
        moved = "manoeuvre" in self.effects and elapsed >= p.manoeuvre_day
        turn = np.asarray(p.manoeuvre_turn) if moved else np.zeros(2)
        raw = np.empty_like(self.body_field)
        for inside, more in self._turned_at_perigee():
            rows = sensor.projection(p, self.effects, turn + more)
            own = self.body_field[inside], rows, self.offsets[inside], self.warm[inside]
            raw[inside] = sensor.reading(*own, p, self.effects)
        raw = raw + p.noise * self._random("magnetometer").standard_normal(raw.shape)
        if "spikes" in defects:
            hit = self._random("spikes").random(len(raw)) < 2e-4
            raw[hit] += 40.0
        if "saturation" in defects:
            raw = np.clip(raw, -p.range, p.range)
        raw = np.rint(raw / p.resolution) * p.resolution
        warm = self.warm + p.reference_temperature
        data = delivery(
            self.times.tt2000,
            FGM_RAW=raw,
            T_SENSOR=np.rint(warm / 0.02) * 0.02,
            FGM_FLAG=np.zeros(len(raw), dtype=np.uint8),
        )
        return cut_gaps(data, self.start, self._random("gaps")) if "gaps" in defects else data

    def _turned_at_perigee(self) -> list[tuple[slice, Float]]:
        """Return the samples between perigees, and by how much the spin axis is turned there, rad."""
        if "perigee_turn" not in self.effects or self.parameters.apogee <= 0.0:
            return [(slice(None), np.zeros(2))]
        orbit = np.floor(ambient.orbits(self.times.seconds, self.parameters)).astype(np.int64)
        edges = [0, *(np.flatnonzero(np.diff(orbit)) + 1).tolist(), orbit.size]
        turn = np.asarray(self.parameters.perigee_turn)
        return [(slice(a, b), turn * (orbit[a] % 2)) for a, b in pairwise(edges)]

    def pulses(self) -> xr.Dataset:
        """What the Sun sensor delivers: a pulse a turn in light, and none in the shadow."""
        stamps = self._pulse_times()
        seconds, _, dark = self._heat
        lit = ~dark[np.searchsorted(seconds, stamps / SECOND, side="right") - 1]
        period = np.gradient(stamps / SECOND)
        stamps, period = stamps[lit], period[lit]
        random = self._random("pulses")
        if "missing_pulses" in self.settings.defects:
            kept = random.random(stamps.size) > 0.02
            stamps, period = stamps[kept], period[kept]
        if "false_pulses" in self.settings.defects:
            false = stamps[random.random(stamps.size) < 0.003] + round(_FALSE_S * SECOND)
            order = np.argsort(np.concatenate([stamps, false]), kind="stable")
            period = np.concatenate([period, np.full(false.size, _FALSE_S)])[order]
            stamps = np.concatenate([stamps, false])[order]
        return delivery(stamps, SPIN_PERIOD=np.rint(period * 1e5) / 1e5)

    def _pulse_times(self) -> Int64:
        """Return when the Sun is seen, TT2000 to a microsecond: Newton's method turns the phase round."""
        p = self.parameters
        seconds = np.array([self.start, self.end]) / SECOND
        first, last = (self._phase(seconds) + p.pulse_angle) / (2.0 * np.pi)
        turns = np.arange(np.ceil(first), np.ceil(last))
        guess = seconds[0] + (turns - first) * p.spin_period
        for _ in range(6):
            off = self._phase(guess) + p.pulse_angle - 2.0 * np.pi * turns
            guess = guess - off * p.spin_period / (2.0 * np.pi)
        stamps = np.rint(guess * 1e6).astype(np.int64) * 1000
        return np.asarray(stamps[(stamps >= self.start) & (stamps < self.end)], dtype=np.int64)

    def currents(self) -> xr.Dataset:
        """Currents as recorded, mA, at the samples of the magnetometer."""
        return delivery(
            self.times.tt2000, I_COIL=np.rint(1e4 * self.coil) / 10.0, I_SOL=np.rint(1e3 * self.array)
        )

    def slow(self) -> xr.Dataset:
        """Temperatures and shadow every ten seconds."""
        seconds, _, dark = self._heat
        stamps = Sampling.of_span(self.start, self.end, _SLOW * SECOND).tt2000
        inside = slice(_WARM_UP // _SLOW, _WARM_UP // _SLOW + stamps.size)
        box = 20.0 + 4.0 * np.sin(2.0 * np.pi * (seconds - self.first) / 21_000.0)
        return delivery(
            stamps,
            T_ELECTRONICS=np.rint(box[inside] / 0.02) * 0.02,
            SHADOW=dark[inside].astype(np.uint8),
        )

    def orbit(self) -> xr.Dataset:
        """Position every minute, km."""
        times = Sampling.of_span(self.start, self.end, 60 * SECOND)
        return delivery(times.tt2000, POS_GSE=ambient.position(times.seconds, self.parameters))

    def spin_axis(self) -> xr.Dataset:
        """Direction of the spin axis every ten minutes."""
        stamps = Sampling.of_span(self.start, self.end, 600 * SECOND).tt2000
        return delivery(stamps, SPIN_AXIS=attitude.spin_direction(stamps, self.parameters))

    def truth(self) -> xr.Dataset:
        """The truth, which the calibration never reads."""
        begin = float(self._phase(np.array([self.start / SECOND]))[0])
        truth = delivery(
            self.times.tt2000,
            FIELD=self.field,
            PHASE=self.phase - 2.0 * np.pi * np.floor(begin / (2.0 * np.pi)),
            OFFSET=self.offsets,
        )
        return truth.assign_attrs(self.settings.truth_attributes(self.day))
