"""One simulated day: what each instrument delivers, and the truth behind it."""

from __future__ import annotations

import json
from functools import cached_property

import numpy as np
import scipy
import xarray as xr

from inflight.simulate import fluxgate, overhauser
from inflight.simulate.defects import apply_defects
from inflight.simulate.field import external_field, main_field
from inflight.simulate.grid import Float, Grid, Sampling, interpolate
from inflight.simulate.mission import SimulatedDay, delivery
from inflight.simulate.orbit import EARTH_RADIUS, Geometry, geometry, node_local_time, sunlight
from inflight.simulate.parameters import Parameters
from inflight.simulate.power import Currents, currents, switched
from inflight.simulate.randomness import generator
from inflight.simulate.second_fluxgate import as_second, in_second_axes, second_effects
from inflight.simulate.settings import SimulationSettings
from inflight.simulate.stray import Pair, stray_fields
from inflight.simulate.thermal import temperatures
from inflight.simulate.torquers import torquer_currents
from inflight.time import SECOND, DayLike, as_day, day_bounds

#: Seconds before the day at which heat and charge balances start, about four orbits.
_WARM_UP = 24_000
_SLOW, _ATTITUDE = 10, 5


def simulate_day(settings: SimulationSettings, day: DayLike) -> SimulatedDay:
    """Return one day of a simulated mission.

    Parameters
    ----------
    settings : SimulationSettings
        The mission; `start` and `days` do not matter here.
    day : date, str or datetime64
        Any UTC day after MJD 196 (2000-07-15); 86 401 s when a leap second ends it.

    Returns
    -------
    SimulatedDay
        The same whatever other days are asked for, byte for byte. `instruments` are fgm, ovm, tq, hk,
        att, orb, and fgm2 when asked for, with the variables of the delivered files; one whose day is
        missing is not in it. `truth` holds ``FIELD`` (record, axis) and ``STRENGTH`` of the ambient field
        at the stamp, ``STRAY_VECTOR``, ``STRAY_SCALAR`` (record, axis) the spacecraft's field at the
        sensors, all nT in spacecraft axes; ``T_EFF`` degC that acts on the coil, ``SUNLIT``, ``I_PANEL``
        (record, panel) A; among its attributes the nine parameters at noon. With a second fluxgate also
        ``STRAY_SECOND``, spacecraft axes, and its nine parameters.
    """
    scene = _Scene(settings, as_day(day))
    instruments = {
        "fgm": scene.fluxgate(),
        "ovm": scene.overhauser(),
        "tq": scene.torquer_channel(),
        "hk": scene.housekeeping(),
        "att": scene.attitude(),
        "orb": scene.orbit(),
    }
    if settings.second_fluxgate:
        instruments["fgm2"] = scene.second_fluxgate()
    damaged = apply_defects(instruments, settings.defects, settings.seed, scene.number)
    return SimulatedDay(scene.day, damaged, scene.truth())


class _Scene:
    """Everything about one day, each part computed once when first needed."""

    def __init__(self, settings: SimulationSettings, day: np.datetime64) -> None:
        self.settings, self.parameters, self.effects = settings, settings.parameters, settings.effects
        self.seed, self.day, self.number = settings.seed, day, int(day.astype(np.int64))
        self.start, self.end = day_bounds(day)
        self.times = self._every(settings.cadence)
        self.wide = Grid.covering(self.start - _WARM_UP * SECOND, self.end)

    def _every(self, cadence: int) -> Sampling:
        return Sampling.of_span(self.start, self.end, cadence * SECOND)

    def _noise(self, stream: str, size: tuple[int, ...], sigma: float) -> Float:
        return sigma * generator(self.seed, stream, self.number).standard_normal(size)

    @cached_property
    def geometry(self) -> Geometry:
        return geometry(self.wide, self.parameters, self.seed)

    @cached_property
    def field_nodes(self) -> tuple[Grid, Float]:
        """Ambient field in spacecraft axes on the nodes of the day."""
        grid = Grid.covering(self.start - SECOND, self.end)
        part = self.wide.part(grid)
        field = main_field(self.geometry.position[part], grid.seconds, self.day)
        field = field + np.asarray(self.parameters.steady_field)
        if "external_field" in self.effects:
            field = field + external_field(grid, self.seed, self.settings.external_field)
        return grid, np.einsum("nij,nj->ni", self.geometry.axes[part], field)

    def field(self, times: Sampling) -> Float:
        """Ambient field, nT, spacecraft axes, shape (time, 3)."""
        grid, nodes = self.field_nodes
        return interpolate(nodes, grid, times)

    @cached_property
    def _history(self) -> tuple[Float, Float, Float]:
        """Seconds, Sun in spacecraft axes and its light every second from the warm-up on."""
        times = Sampling.of_span(self.start - _WARM_UP * SECOND, self.end, SECOND)
        seen = np.column_stack([self.geometry.sun, self.geometry.zenith])
        dense = interpolate(seen, self.wide, times)
        radius = float(np.linalg.norm(self.geometry.position[-1]))
        return times.seconds, dense[:, :3], sunlight(dense[:, 3], radius)

    @cached_property
    def _power(self) -> Currents:
        """Currents every second from the warm-up on."""
        return currents(*self._history, parameters=self.parameters, seed=self.seed, cadence=1.0)

    def power(self, cadence: int) -> Currents:
        """Currents of the day every `cadence` seconds."""
        return Currents(*(series[_WARM_UP::cadence] for series in vars(self._power).values()))

    @cached_property
    def light(self) -> Float:
        """Visible fraction of the Sun at the stamps of the magnetometers."""
        return self._history[2][_WARM_UP :: self.settings.cadence]

    @cached_property
    def temperatures(self) -> tuple[Float, Float, Float]:
        """Temperatures of the coil's sensor, of the coil that acts, and of the electronics."""
        seconds, sun, light = (series[::_SLOW] for series in self._history)
        coil, electronics = temperatures(sun, light, self._power.heater[::_SLOW], float(_SLOW))
        now = self.times.seconds
        lag = self.parameters.temperature_lag if "temperature_lag" in self.effects else 0.0
        recorded, acting = np.interp(now, seconds, coil), np.interp(now - lag, seconds, coil)
        return recorded, acting, np.interp(now, seconds, electronics)

    @cached_property
    def torquer(self) -> Float:
        """Torquer currents at the stamps of the magnetometers, A."""
        return torquer_currents(self.times, self.parameters, self.seed, self.number)

    @cached_property
    def stray(self) -> Pair:
        """Field of the spacecraft at vector and scalar sensor."""
        flow = self.power(self.settings.cadence)
        vector, scalar = stray_fields(self.times.seconds, flow, self.torquer, self.parameters, self.effects)
        # The extra effects that are a field at the vector sensor alone.
        extra, parameters = np.zeros((self.times.count, 3)), self.parameters
        if "day_night" in self.effects:
            extra += self.light[:, None] * parameters.day_night_field
        if "unrecorded_heater" in self.effects:
            on = switched(
                self.times.seconds, parameters.unrecorded_heater_period, parameters.unrecorded_heater_duty
            )
            extra += on[:, None] * parameters.unrecorded_heater_field
        if "eddy" in self.effects:
            rate = (self.field(self.times.shifted(0.5)) - self.field(self.times.shifted(-0.5))) / 1.0
            extra += rate * parameters.eddy_time
        return vector + extra, scalar

    def fluxgate(self) -> xr.Dataset:
        """What the vector instrument delivers."""
        field = self.field(self.times) + self.stray[0]
        return self._fluxgate(field, self.parameters, self.effects, "")

    @cached_property
    def stray_second(self) -> Float:
        """Field of the spacecraft at the second fluxgate."""
        flow, parameters = self.power(self.settings.cadence), as_second(self.parameters)
        return stray_fields(self.times.seconds, flow, self.torquer, parameters, self.effects)[0]

    def second_fluxgate(self) -> xr.Dataset:
        """What the second vector instrument delivers."""
        field = in_second_axes(self.field(self.times) + self.stray_second, self.parameters)
        return self._fluxgate(field, as_second(self.parameters), second_effects(self.effects), "second ")

    def _fluxgate(
        self, field: Float, parameters: Parameters, effects: frozenset[str], stream: str
    ) -> xr.Dataset:
        """What a vector instrument in a field, its own axes, delivers; `stream` begins its noises' names."""
        recorded, acting, electronics = self.temperatures
        seconds, settings = self.times.seconds, self.settings
        sensed = fluxgate.reading(
            field,
            fluxgate.scale_factors(seconds, parameters, effects),
            fluxgate.thermal_factors(acting, electronics, parameters, effects),
            fluxgate.offsets(seconds, acting, parameters, effects, self.seed),
            parameters=parameters,
            effects=effects,
        )
        sensed += self._noise(f"{stream}fluxgate", sensed.shape, settings.vector_noise)
        shape = (self.times.count,)
        coil = recorded + self._noise(f"{stream}coil thermistor", shape, 0.003)
        converter = electronics + self._noise(f"{stream}adc thermistor", shape, 0.003)
        return delivery(
            self.times.tt2000,
            FGM_RAW=_rounded(sensed, settings.resolution),
            T_CSC=_rounded(coil, 0.01),
            T_ADC=_rounded(converter, 0.01),
            FGM_FLAG=np.zeros(shape, dtype=np.uint8),
        )

    def overhauser(self) -> xr.Dataset:
        """What the scalar instrument delivers."""
        seconds, settings, effects = self.times.seconds, self.settings, self.effects
        delay = overhauser.sampling_delay(float(seconds[0]), self.parameters, effects)
        seen = overhauser.strength(
            self.field(self.times.shifted(-delay)), self.stray[1], self.parameters, effects
        )
        ratio = overhauser.oscillator_ratio(
            seconds, self.temperatures[2], self.parameters, effects, self.seed
        )
        sensed = overhauser.reading(seen, ratio, self.parameters, effects, float(settings.cadence))
        sensed += self._noise("overhauser", sensed.shape, settings.scalar_noise)
        return delivery(
            self.times.tt2000, F=_rounded(sensed, settings.resolution), F_OSC_RATIO=_rounded(ratio, 1e-10)
        )

    def torquer_channel(self) -> xr.Dataset:
        """Torquer currents as recorded, mA."""
        return delivery(self.times.tt2000, I_TQ=_rounded(1e3 * self.torquer, 0.1))

    def housekeeping(self) -> xr.Dataset:
        """Currents of the power system as recorded, mA."""
        flow = self.power(_SLOW)
        return delivery(
            self._every(_SLOW).tt2000,
            I_SOL=_rounded(1e3 * flow.solar, 5.0),
            I_BAT=_rounded(1e3 * flow.battery, 5.0),
            I_CAM=_rounded(1e3 * flow.camera, 1.0),
            I_HTR=_rounded(1e3 * flow.heater, 1.0),
        )

    def attitude(self) -> xr.Dataset:
        """Quaternion x, y, z, w that turns spacecraft axes into itrf, as the star camera gives it."""
        times = self._every(_ATTITUDE)
        nodes = _continuous(
            scipy.spatial.transform.Rotation.from_matrix(self.geometry.axes.swapaxes(1, 2)).as_quat()
        )
        turn = scipy.spatial.transform.Rotation.from_quat(interpolate(nodes, self.wide, times))
        sigma = np.radians(self.parameters.attitude_noise / 3600.0)
        noise = scipy.spatial.transform.Rotation.from_rotvec(self._noise("attitude", (times.count, 3), sigma))
        return delivery(times.tt2000, Q=_rounded(_continuous((turn * noise).as_quat()), 1e-7))

    def orbit(self) -> xr.Dataset:
        """Position in itrf, km."""
        times = self._every(_SLOW)
        return delivery(
            times.tt2000, POS_ITRF=_rounded(interpolate(self.geometry.position, self.wide, times), 1e-5)
        )

    def truth(self) -> xr.Dataset:
        """The truth, which no processing of the deliveries may read."""
        field = self.field(self.times)
        truth = delivery(
            self.times.tt2000,
            FIELD=field,
            STRENGTH=np.sqrt(np.einsum("ij,ij->i", field, field)),
            STRAY_VECTOR=self.stray[0],
            STRAY_SCALAR=self.stray[1],
            T_EFF=self.temperatures[1],
            SUNLIT=self.light,
        )
        truth["I_PANEL"] = ("record", "panel"), self.power(self.settings.cadence).panels
        if self.settings.second_fluxgate:
            truth["STRAY_SECOND"] = ("record", "axis"), self.stray_second
            truth.attrs["nine_parameters_second"] = self._nine(as_second(self.parameters))
        radius = float(np.linalg.norm(self.geometry.position[-1]))
        return truth.assign_attrs(
            self.settings.truth_attributes(self.day),
            nine_parameters=self._nine(self.parameters),
            altitude_km=radius - EARTH_RADIUS,
            node_local_time_h=float(node_local_time(self.times.seconds[:1], self.parameters)[0]),
        )

    def _nine(self, parameters: Parameters) -> str:
        """Return the nine parameters at noon as JSON."""
        noon = (self.start + self.end) / 2 / SECOND
        return json.dumps(fluxgate.nine_parameters(noon, parameters, self.effects))


def _continuous(quaternions: Float) -> Float:
    """Return the same turns with signs that do not jump; shape (time, 4)."""
    flips = np.sign(np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]))
    signs = np.concatenate([[1.0], np.cumprod(flips)])
    return np.asarray(quaternions * signs[:, None])


def _rounded(values: Float, step: float) -> Float:
    """Return values as multiples of a smallest step; 0 leaves them."""
    if step == 0.0:
        return values
    # A division by a whole number gives the double nearest to the decimal, a product would not.
    return np.rint(values / step) * step if step >= 1.0 else np.rint(values / step) / round(1.0 / step)
