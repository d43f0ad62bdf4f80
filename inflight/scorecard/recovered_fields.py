"""Published fields of the spacecraft, put into days with noise and given back by the estimators (Yin 2010).

Tolerances are the source's printed errors, or three times the scatter that the windows of the estimators,
the directions of the field and the noise put in make one expect, written down before anything was recovered.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import FILTER_PERIOD_S, distribute_residual
from inflight.dipole import dipole_split
from inflight.effects import panel_weights_at
from inflight.mission_fit import (
    band_equations,
    concat_band_equations,
    concat_epochs,
    daily_fits,
    extract_epochs,
    filled_running_mean,
    fit_remanence_factor,
    fit_step,
    robust_mean,
    select_panel_model,
)
from inflight.residual import find_steps
from inflight.scorecard import continuous_parameters
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure
from inflight.scorecard.scene import DAYS, MJD_ZERO, SimulatedDays
from inflight.scorecard.spacecraft_fields import CAMERA, CHANGE, CHANGE_ERROR, PANELS, SCALAR, VECTOR
from inflight.simulate import Parameters, Sampling, mean_current, torquer_currents
from inflight.simulate import mjd as mjd_of_seconds
from inflight.time import SECOND, Int64

SECTION = "spacecraft-fields"
#: What the vector and the scalar sensor see of a difference of 1 between them.
_SPLIT = dipole_split((1.0, 1.0, 1.0), VECTOR, SCALAR).factor
#: Noise of a sample a second, nT, and what follows the orbit beside it: once and three times a turn, nT.
_NOISE, _SLOW = 0.09, (0.3, 0.1)
#: Times each day is repeated with other noise and other moments.
_REPEATS, _BAND_REPEATS = 2, 3
#: Three times the inverse of the band's information of so many days, nT/A, row by row.
_BAND_SCATTER = (0.042, 0.148, 0.044, 0.162, 0.588, 0.164, 0.028, 0.103, 0.031)
#: Currents between which the array switches, A; of the camera, A; s between switches, and s they last.
_SUN, _DAZZLED, _EVERY, _LASTS = (10.5, 3.0), 0.4, 5000.0, 1500.0
#: Time constant of a switch, s: 10.5 A fall to 3 A within 15 s.
_SETTLES = 5.0
#: Eta, nT/A, and the days, scatter of daily means (A), part that turns with the local time (A), slow errors
#: of the residual (nT, for 20 days) of its injection (chosen).
_ETA, _ETA_DAYS, _ETA_SCATTER, _ETA_TURN, _ETA_SLOW = 7.1, 2500, 0.002, 0.010, 0.005
_ETA_SEEDS = 4
#: Tones put in to find which the low-pass halves, s.
_TONES = np.array([70.0, 75.0, 80.0, 85.0, 90.0])


@dataclass(frozen=True)
class FastDay:
    """One of `DAYS` every second: TT2000, seconds, the field's direction (time, 3), the node's local time."""

    stamps: Int64
    seconds: Floats
    direction: Floats
    local_time: float


def fast_day(scene: SimulatedDays, mjd: int) -> FastDay:
    """Return a day of the scene every second; the field turns smoothly between its samples."""
    day = scene.day(mjd)
    slow = 30.0 * np.arange(len(day.direction))
    seconds = np.arange(0.0, slow[-1])
    direction = scipy.interpolate.CubicSpline(slow, day.direction)(seconds)
    stamps = day.span[0] + (seconds * SECOND).astype(np.int64)
    return FastDay(
        stamps, seconds, direction / np.linalg.norm(direction, axis=1, keepdims=True), day.local_time
    )


def _switched(day: FastDay, random: np.random.Generator) -> Floats:
    """Return 0 and 1 with a switch every 5000 s or so, settling with 5 s; (time,)."""
    out = np.zeros(day.seconds.size)
    for moment in np.arange(300.0, day.seconds[-1] - _LASTS - 600.0, _EVERY) + random.uniform(0, 2500):
        for at, sign in ((moment, 1.0), (moment + _LASTS, -1.0)):
            since = np.clip(day.seconds - at, 0.0, None)
            out += sign * (1.0 - np.exp(-since / _SETTLES))
    return out


def _disturbed(day: FastDay, field: Floats, random: np.random.Generator) -> Floats:
    """Return dB of a field (time, 3) at the vector sensor, with what follows the orbit and noise, nT."""
    turn = 2.0 * np.pi * day.seconds / 5560.0
    orbit = _SLOW[0] * np.sin(turn + 1.0) + _SLOW[1] * np.sin(3.0 * turn)
    noise = _NOISE * random.standard_normal(turn.size)
    return np.asarray(np.einsum("ti,ti->t", day.direction, field) + orbit + noise)


def _epochs(day: FastDay, residual: Floats, current: Floats, name: str) -> xr.Dataset:
    """Return the superposed epochs of a current, whose steps are found in housekeeping every 10 s."""
    samples = xr.Dataset(
        {
            "tt2000": ("time", day.stamps),
            "field": (("time", "axis"), 40_000.0 * day.direction),
            name: ("time", current, {"units": "A"}),
        }
    )
    steps = find_steps(day.stamps[::10], np.rint(current[::10] / 0.005) * 0.005)
    return extract_epochs(samples, residual, steps, channel=name)


def _arrays(scene: SimulatedDays, both: bool) -> tuple[xr.Dataset, Floats]:
    """Return epochs of the solar current and the local time of each, `both` panels in turn or the first."""
    parts, hours = [], []
    for mjd in DAYS:
        day = scene.cached(fast_day, mjd)
        share = panel_weights_at(np.array([day.local_time])) if both else np.array([[1.0, 0.0]])
        coefficient = (share @ np.reshape(PANELS, (2, 3)))[0] / _SPLIT[0]
        for repeat in range(_REPEATS):
            random = np.random.default_rng([21, mjd, repeat])
            current = _SUN[0] + (_SUN[1] - _SUN[0]) * _switched(day, random)
            residual = _disturbed(day, current[:, None] * coefficient, random)
            parts.append(_epochs(day, residual, current, "solar_current"))
            hours.append(np.full(parts[-1].sizes["epoch"], day.local_time))
    # Days in order of time, as the epochs are when they are joined.
    return concat_epochs(parts), np.concatenate(hours)


def difference_of_array(scene: SimulatedDays) -> Estimate:
    """Return the field of the first panel at the vector sensor less that at the scalar sensor, nT/A."""
    epochs, _ = _arrays(scene, both=False)
    found = fit_step(epochs).fit
    return Estimate.of(found.value, found.sigma)


def both_panels(scene: SimulatedDays) -> Estimate:
    """Return both panels' fields at the vector sensor: the fitted differences, split as a dipole's; nT/A."""
    epochs, hours = _arrays(scene, both=True)
    model = next(one for one in select_panel_model(epochs, hours).models if one.name == "two_panels")
    return Estimate.of(*(_SPLIT[0] * one for one in (model.value, model.sigma)))


def field_of_camera(scene: SimulatedDays) -> Estimate:
    """Return the change of dB along z of the camera's current, nT/mA."""
    parts = []
    for mjd in DAYS:
        day, random = scene.cached(fast_day, mjd), np.random.default_rng([22, mjd])
        current = _DAZZLED * _switched(day, random)
        field = current[:, None] * np.array([0.0, 0.0, 1e3 * CAMERA])
        parts.append(_epochs(day, _disturbed(day, field, random), current, "camera_current"))
    found = fit_step(concat_epochs(parts)).fit
    return Estimate.of(found.value[2], found.sigma[2]).times(1e-3)


def change_of_matrix(scene: SimulatedDays) -> Estimate:
    """Return what the scalar sensor's torquer matrix lacks: robust mean of daily fits, row by row, nT/A."""
    parts = []
    for mjd in DAYS:
        day = scene.cached(fast_day, mjd)
        times = Sampling.of_span(int(day.stamps[0]), int(day.stamps[-1]) + SECOND, SECOND)
        for seed in range(_BAND_REPEATS):
            current = torquer_currents(times, Parameters(), 10 + seed, mjd)
            # F lacks e.(change I): it stays in dB = |B| - F with a minus.
            field = -current @ np.reshape(CHANGE, (3, 3)).T
            residual = _disturbed(day, field, np.random.default_rng([23, mjd, seed]))
            parts.append(band_equations(day.stamps, residual, day.direction, current))
    found = robust_mean(daily_fits(concat_band_equations(parts)))
    return Estimate.of(-found["value"].values, found["sigma"].values)


def eta(scene: SimulatedDays) -> Estimate:
    """Return the mean over seeds of eta at the scalar sensor, fitted to dB on the mean currents, nT/mA."""
    over = _SPLIT[0] / _SPLIT[1]
    grams = np.array([scene.day(mjd).direction.T @ scene.day(mjd).direction for mjd in DAYS])
    count = float(len(scene.day(DAYS[0]).direction))
    days = np.arange(_ETA_DAYS)
    day = int((MJD_ZERO + 204).astype(np.int64)) + days
    seconds = (204.5 + days - mjd_of_seconds(np.zeros(1))[0]) * 86_400.0
    current = mean_current(seconds, Parameters())
    turn = 2.0 * np.pi * days / 260.5
    turning = current + _ETA_TURN * np.column_stack([np.sin(turn), np.cos(turn), np.sin(2 * turn)])
    found = []
    for seed in range(_ETA_SEEDS):
        random = np.random.default_rng([14, seed])
        daily = turning + _ETA_SCATTER * random.standard_normal(turning.shape)
        slow = _ETA_SLOW * random.standard_normal((_ETA_DAYS // 20 + 1, 3))[days // 20]
        field = _ETA * (over - 1.0) * current * [0.0, 1.0, 1.0] + [0.3, -0.2, 0.1] + slow
        gram = _grams_with(grams[days % len(grams)], field, count, random)
        mean = filled_running_mean(day, daily, np.full(_ETA_DAYS, 86_400.0))
        fit = fit_remanence_factor(day, gram, np.full(_ETA_DAYS, count), mean)
        found.append(Estimate.of(*fit.at_scalar(over)).times(1e-3))
    return Estimate.mean(found)


def _grams_with(own: Floats, field: Floats, count: float, random: np.random.Generator) -> Floats:
    """Return Gram matrices of [e | dB] for dB = e.field + noise, from those of e (day, 3, 3)."""
    root = np.linalg.cholesky(own)
    noise = _NOISE * np.einsum("dij,dj->di", root, random.standard_normal(field.shape))
    out = np.zeros((len(own), 4, 4))
    out[:, :3, :3] = own
    out[:, :3, 3] = out[:, 3, :3] = np.einsum("dij,dj->di", own, field) + noise
    out[:, 3, 3] = np.einsum("di,dij,dj->d", field, own, field) + 2.0 * np.sum(field * noise, axis=1)
    out[:, 3, 3] += _NOISE**2 * count
    return out


def half_passed(scene: SimulatedDays) -> float:
    """Return the period that the distribution of the residual passes by half, from tones with noise, s."""
    day = scene.cached(fast_day, DAYS[0])
    field, passed = 40_000.0 * day.direction, []
    for period in _TONES:
        wave = np.exp(2j * np.pi * day.seconds / period)
        noise = _NOISE * np.random.default_rng([15, int(period)]).standard_normal(wave.size)
        slow = distribute_residual(field, wave.real + noise, day.stamps).slow
        passed.append(2.0 * np.abs(np.mean(slow * wave.conj())))
    return float(np.interp(0.5, passed, _TONES))


def distributed(scene: SimulatedDays) -> tuple[float, float]:
    """Return the rms of what is distributed of slow residual and noise, and of what is left, nT."""
    day = scene.cached(fast_day, DAYS[0])
    residual = _disturbed(day, np.zeros_like(day.direction), np.random.default_rng(16))
    found = distribute_residual(40_000.0 * day.direction, residual, day.stamps)
    return found.rms, found.rms_remaining


recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)

FIGURES = (
    recovered(
        id="solar.difference-recovered",
        what="A_fg - A_ov of the first panel from steps of the current between 10.5 and 3 A, x, y, z",
        unit="nT/A",
        source="Fig. 3.6 over the split of section 3.4.1, Yin 2010; the thesis prints none",
        published=tuple(one / _SPLIT[0] for one in PANELS[:3]),
        # Three times the inverse of the columns' information, 0.042 nT a step, 476 steps; e_y is 0.15 rms.
        tolerance=(0.0014, 0.0051, 0.0010),
        obtain=difference_of_array,
        nominal=(0.0, 0.0, 0.0),
        printed=False,
    ),
    recovered(
        id="panels.recovered",
        what="fields of both side panels at the vector sensor, from such steps at seven local times",
        unit="nT/A",
        source="Yin 2010, Fig. 3.6, read off",
        published=PANELS,
        # The same with both panels, times the split's 1.64.
        tolerance=(0.0035, 0.0136, 0.0024, 0.0038, 0.0145, 0.0026),
        obtain=both_panels,
        nominal=(0.0,) * 6,
        why="The estimator returns what was put in; along y, which e hardly has, steps tell little.",
    ),
    recovered(
        id="camera.recovered",
        what="change of dB along z per current of the star camera, from steps of 400 mA",
        unit="nT/mA",
        source="Yin 2010, section 3.4.2, printed without an axis",
        published=CAMERA,
        # Three times the inverse of the column's information, 238 steps.
        tolerance=2.4e-5,
        obtain=field_of_camera,
        nominal=0.0,
    ),
    recovered(
        id="torquer.recovered",
        what="change of the torquer matrix of the scalar sensor, row by row, from 21 days' band of 0.05 Hz",
        unit="nT/A",
        source="Yin 2010, section 3.4.3",
        published=tuple(CHANGE.ravel().tolist()),
        # The printed errors, or the scatter of these days where it is larger.
        tolerance=tuple(max(pair) for pair in zip(CHANGE_ERROR, _BAND_SCATTER, strict=True)),
        obtain=change_of_matrix,
        nominal=(0.0,) * 9,
        why="The estimator returns what was put in, sign included: this proves it, not the matrix.",
    ),
    recovered(
        id="remanent.eta-recovered",
        what="eta from dB of 2500 days on the 260-day means of the torquer currents",
        unit="nT/mA",
        source="Yin 2010, section 3.4.4",
        published=_ETA / 1e3,
        # Days scatter by 2 mA, the mean current changes by 2.5 mA rms: 2 % of a mission, 1 % of four.
        tolerance=0.0002,
        obtain=eta,
        nominal=0.0,
    ),
    recovered(
        id="distribution.period",
        section=continuous_parameters.SECTION,
        what="period that the distribution of the residual passes by half, from tones with noise",
        unit="s",
        source="Yin 2010, eq. 3.7",
        published=FILTER_PERIOD_S,
        # Noise 0.02 s, and both ends of the day.
        tolerance=0.2,
        obtain=half_passed,
        nominal=float("inf"),
        why="A filter of zero phase whose name the thesis does not print.",
    ),
    recovered(
        id="distribution.size",
        section=continuous_parameters.SECTION,
        what="rms distributed of a residual of 0.224 nT that follows the orbit, and rms of the noise left",
        unit="nT",
        source="theory of a low-pass 1/(1 + (f/fc)^6) on 0.09 nT of noise; the thesis prints none",
        published=(0.2240, 0.0886),
        tolerance=(0.002, 0.0007),
        obtain=distributed,
        nominal=(0.0, 0.24),
        printed=False,
        why="It takes what is slow, whatever the cause, and 3 % of the noise's power.",
    ),
)
