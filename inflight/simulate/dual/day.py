"""One simulated day of two sensors on one boom: what is delivered, and the truth behind it.

The ambient field is solar wind; to it each sensor adds the dipole fields of the units that are on, its offset
and noise. All random numbers follow from seed, stream and day, so that a day does not depend on others.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import xarray as xr

from inflight.simulate.defects import cut_gaps
from inflight.simulate.dipole import dipole_field
from inflight.simulate.dual.settings import DualSettings
from inflight.simulate.dual.switching import (
    NEW_UNIT,
    UNITS,
    Calendar,
    Unit,
    align_switchings,
    six_states,
    switched_part,
)
from inflight.simulate.grid import Float, Int64, Sampling
from inflight.simulate.mission import SimulatedDay, delivery
from inflight.simulate.randomness import drift, generator
from inflight.simulate.spinning import SpinningParameters, solar_wind
from inflight.time import DAY, SECOND, DayLike, as_day, day_bounds

#: Seconds between currents and between temperatures.
_CURRENTS, _SLOW = 8, 60
_VALVE_S = 2.0
#: Where the valve and the leads of the array are, m; the usual current of the array, mA.
_VALVE, _ARRAY, _ARRAY_CURRENT = (0.1, -0.1, -0.2), (0.0, 0.5, -0.4), 6000.0
#: Names of the delivered currents.
_CHANNELS = {"transmitter": "I_TX", "spectrometer": "I_SPEC", "camera": "I_CAM"}


def simulate_dual_day(settings: DualSettings, day: DayLike) -> SimulatedDay:
    """Return one day of a simulated mission, the same whatever other days are simulated.

    Parameters
    ----------
    settings : DualSettings
        The mission; ageing and drift begin at its `start`.
    day : date, str or datetime64
        UTC.

    Returns
    -------
    SimulatedDay
        Instruments ``ib``, ``ob``: B_RAW (record, axis) nT, sensor axes, and FLAG; ``hk``: I_TX, I_SPEC,
        I_CAM, I_ARRAY mA; ``slow``: T_BODY degC; while the ambient field is known ``mon``: B (record,
        axis) nT, spacecraft axes. Truth: FIELD, STRAY_IN, STRAY_OUT, OFFSET_IN, OFFSET_OUT (record, axis)
        nT, spacecraft axes; STATE (record): a bit for each unit in order that is on, or the number of the
        published state.
    """
    scene = _Scene(settings, as_day(day))
    instruments = {
        "ib": scene.magnetometer("inboard"),
        "ob": scene.magnetometer("outboard"),
        "hk": scene.currents(),
        "slow": scene.slow(),
    }
    if "monitor" in settings.effects and scene.number - scene.first < settings.parameters.monitor_days:
        instruments["mon"] = scene.monitor()
    return SimulatedDay(scene.day, instruments, scene.truth())


class _Scene:
    """Everything about one day, each part computed once when first needed."""

    def __init__(self, settings: DualSettings, day: np.datetime64) -> None:
        self.settings, self.parameters, self.effects = settings, settings.parameters, settings.effects
        self.day, self.number = day, int(day.astype(np.int64))
        self.first = int(np.datetime64(settings.start, "D").astype(np.int64))
        self.start, self.end = day_bounds(day)
        self.times = Sampling.of_span(self.start, self.end, round(self.parameters.cadence * SECOND))
        self.since = (self.times.tt2000 - self.start) / SECOND
        self.calendar = Calendar(settings.seed, self.first, self.parameters.commissioning)

    def _random(self, stream: str) -> np.random.Generator:
        return generator(self.settings.seed, stream, self.number)

    @cached_property
    def field(self) -> Float:
        """Ambient field, spacecraft axes."""
        p = self.parameters
        nature = SpinningParameters(field=p.field, turning=p.turning, compression=p.compression)
        return solar_wind(self.times.seconds, self.settings.seed, self.number, nature)

    @cached_property
    def units(self) -> tuple[Unit, ...]:
        """Units that may be on this day; none where the six published states are flown."""
        if "six_states" in self.effects:
            return ()
        known = tuple(unit for unit in UNITS if unit.name in self.effects)
        late = self.number >= self.first + self.parameters.new_unit_day
        return (*known, NEW_UNIT) if "new_unit" in self.effects and late else known

    @cached_property
    def _switchings(self) -> dict[str, tuple[bool, Float]]:
        units = [unit for unit in self.units if unit is not NEW_UNIT]
        out = {
            unit.name: self.calendar.switchings(unit, place, len(units), self.number)
            for place, unit in enumerate(units)
        }
        if NEW_UNIT in self.units:
            out[NEW_UNIT.name] = self.calendar.switchings(NEW_UNIT, 0, 10**6, self.number)
        if "simultaneous" in self.effects and {"camera", "spectrometer"} <= set(out):
            begins, times = out["camera"]
            out["camera"] = begins, align_switchings(times, out["spectrometer"][1])
        return out

    def _on(self, unit: Unit, seconds: Float, rise: float) -> Float:
        return switched_part(seconds, *self._switchings[unit.name], rise)

    @cached_property
    def states(self) -> Int64:
        """The published state at each sample."""
        chosen, begins = self.calendar.states(len(six_states()[0]), self.number)
        return np.asarray(chosen[np.searchsorted(begins, self.since, side="right") - 1])

    def _array_current(self, seconds: Float) -> Float:
        """Current of the array, mA: a daily swing and slow noise."""
        absolute = self.start / SECOND + seconds
        slow = drift(absolute, self.settings.seed, "array", (0.05,), periods=(1800.0, 40_000.0))[:, 0]
        swing = 0.1 * np.sin(2.0 * np.pi * absolute / (DAY / SECOND))
        return np.asarray(_ARRAY_CURRENT * (1.0 + swing + slow))

    def stray(self, sensor: str) -> Float:
        """What the spacecraft adds at a sensor, nT, spacecraft axes."""
        place = self.parameters.inboard if sensor == "inboard" else self.parameters.outboard
        out = np.zeros((self.since.size, 3))
        growth = 1.0
        if "ageing" in self.effects:
            growth += self.parameters.ageing * (self.number - self.first)
        for unit in self.units:
            part = self._on(unit, self.since, self.parameters.rise)
            out += growth * part[:, None] * unit.field_at(place)
        if "six_states" in self.effects:
            out += six_states()[0 if sensor == "inboard" else 1][self.states]
        if "valve" in self.effects:
            driven = np.sort(
                self._random("valve").uniform(0.0, DAY / SECOND, round(self.parameters.valve_switches))
            )
            last = self.since - np.concatenate([[-np.inf], driven])[np.searchsorted(driven, self.since)]
            out += (last < _VALVE_S)[:, None] * dipole_field(_VALVE, self.parameters.valve_moment, place)
        if "array_current" in self.effects:
            strength = self._array_current(self.since) / _ARRAY_CURRENT
            out += strength[:, None] * dipole_field(_ARRAY, self.parameters.array_moment, place)
        return out

    def _temperature(self, seconds: Float) -> Float:
        """Temperature of the body, degC."""
        absolute = self.start / SECOND + seconds
        slow = drift(absolute, self.settings.seed, "body", (1.5,), periods=(20_000.0, 400_000.0))[:, 0]
        return np.asarray(24.0 + 2.5 * np.sin(2.0 * np.pi * absolute / (DAY / SECOND)) + slow)

    def offset(self, sensor: str) -> Float:
        """Reading of a sensor in zero field, nT, spacecraft axes."""
        p = self.parameters
        out = np.zeros((self.since.size, 3))
        if "offset" in self.effects:
            out += p.offset_inboard if sensor == "inboard" else p.offset_outboard
        if "offset_drift" in self.effects:
            size, seconds = (p.offset_drift,) * 3, self.times.seconds
            out += drift(seconds, self.settings.seed, f"{sensor} offset", size, periods=(40_000.0, 1e6))
        if "thermal_drift" in self.effects and sensor == "inboard":
            out += (self._temperature(self.since) - 24.0)[:, None] * p.thermal_drift
        return out

    def magnetometer(self, sensor: str) -> xr.Dataset:
        """What a sensor delivers, in its own axes."""
        p = self.parameters
        inner = sensor == "inboard"
        reading = self.field + self.stray(sensor) + self.offset(sensor)
        noise = p.noise_inboard if inner else p.noise_outboard
        if inner:
            angle = np.deg2rad(p.turned + (p.misalignment if "misalignment" in self.effects else 0.0))
            c, s = np.cos(angle), np.sin(angle)
            reading = np.asarray(reading @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        random = self._random(sensor)
        reading = reading + noise * random.standard_normal(reading.shape)
        if "spikes" in self.settings.defects:
            reading[random.random(len(reading)) < 2e-4] += 5.0
        reading = np.rint(reading / p.resolution) * p.resolution
        data = delivery(self.times.tt2000, B_RAW=reading, FLAG=np.zeros(len(reading), dtype=np.uint8))
        gaps = "gaps" in self.settings.defects
        return cut_gaps(data, self.start, self._random(f"{sensor} gaps")) if gaps else data

    def monitor(self) -> xr.Dataset:
        """What a spacecraft nearby measures of the ambient field, spacecraft axes."""
        noise = self._random("monitor").standard_normal(self.field.shape)
        return delivery(self.times.tt2000, B=self.field + self.parameters.noise_monitor * noise)

    def currents(self) -> xr.Dataset:
        """Currents of the units whose housekeeping is delivered, mA, and of the array."""
        times = Sampling.of_span(self.start, self.end, _CURRENTS * SECOND)
        since = (times.tt2000 - self.start) / SECOND
        random = self._random("currents")
        out = {"I_ARRAY": np.rint(self._array_current(since))}
        for unit in UNITS:
            if unit.name not in _CHANNELS or unit.name in self.settings.hide:
                continue
            on = self._on(unit, since, 0.0) if unit in self.units else np.zeros(since.size)
            amount = unit.current * on + 2.0 * random.standard_normal(since.size) + 20.0
            out[_CHANNELS[unit.name]] = np.rint(amount)
        return delivery(times.tt2000, **out)

    def slow(self) -> xr.Dataset:
        """Temperature of the body every minute."""
        times = Sampling.of_span(self.start, self.end, _SLOW * SECOND)
        warm = self._temperature((times.tt2000 - self.start) / SECOND)
        return delivery(times.tt2000, T_BODY=np.rint(warm / 0.02) * 0.02)

    def truth(self) -> xr.Dataset:
        """The truth, which is not delivered to the processing."""
        states = self.states if "six_states" in self.effects else np.zeros(self.since.size, dtype=np.int64)
        for unit in self.units:
            on = self._on(unit, self.since, 0.0) > 0
            states = states + (on.astype(np.int64) << (*UNITS, NEW_UNIT).index(unit))
        truth = delivery(
            self.times.tt2000,
            FIELD=self.field,
            STRAY_IN=self.stray("inboard"),
            STRAY_OUT=self.stray("outboard"),
            OFFSET_IN=self.offset("inboard"),
            OFFSET_OUT=self.offset("outboard"),
            STATE=states,
        )
        return truth.assign_attrs(self.settings.truth_attributes(self.day))
