"""The waveform of what repeats in a residual: its exact period, its field by phase, its shape.

Takes a residual, the direction of the field and the frequency of a line; makes a `Waveform`: the period
that explains most of the whole record, the field along each axis folded by its phase, and whether that is a
sine, a square wave with its duty, a pulse or something else. The field in a phase is the least-squares
solution b of ``y = u . b`` over the samples of that phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats


@dataclass(frozen=True, kw_only=True)
class WaveformSettings:
    """How a waveform is measured and named.

    Attributes
    ----------
    phases : int
        Phases a period is folded into. Assumed: a duty is known to a twenty-fourth.
    least_seen : float
        Directions of the field that hold less than this part of the strongest one's square are not seen.
        Assumed.
    search : float
        Half-width of the search for the exact frequency, in resolutions of the spectrum. Assumed.
    most_samples : int
        Samples of that search at most, which bounds its time.
    harmonics : int
        Harmonics that are fitted in it.
    sine, sine_noise : float
        A curve is a sine when no harmonic exceeds this part of the first, or this many times its noise.
        Assumed.
    level : float
        A curve has two levels when the rest is below this part of its variance. Assumed.
    square : tuple of float
        Duties of a square wave; beyond, it is a pulse. Assumed.
    """

    phases: int = 24
    least_seen: float = 3e-3
    search: float = 1.2
    most_samples: int = 60_000
    harmonics: int = 2
    sine: float = 0.15
    sine_noise: float = 2.5
    level: float = 0.15
    square: tuple[float, float] = (0.25, 0.75)


WAVEFORM_SETTINGS = WaveformSettings()


@dataclass(frozen=True, kw_only=True)
class Waveform:
    """What repeats, folded at its period.

    Attributes
    ----------
    period_s, period_sigma_s : float
        Seconds.
    axis : int or None
        The axis along which it stands out most; None where the field hardly turns and no axis is known.
    shape : str
        ``sine``, ``square``, ``pulse`` or ``other``.
    duty : float or None
        Part of the period above the middle.
    amplitude : float
        Half of peak to peak along `axis`, or along the seen direction; nT.
    amplitudes : ndarray, shape (axis, 2)
        Half of peak to peak along each axis, and its sigma, nT; empty without an axis.
    steps : ndarray, shape (axis, 2)
        What a switch adds along each axis while it is on, and its sigma, nT; empty of another shape.
    part : float
        Part of the residual's square that it explains.
    """

    period_s: float
    period_sigma_s: float
    axis: int | None
    shape: str
    duty: float | None
    amplitude: float
    amplitudes: Floats
    steps: Floats
    part: float


def waveform_of(
    seconds: Floats,
    residual: Floats,
    direction: Floats,
    frequency: float,
    spread: float,
    settings: WaveformSettings = WAVEFORM_SETTINGS,
) -> Waveform:
    """Return the waveform of a line.

    Where the field hardly turns, only the field's own direction is seen, and no axis is named.

    Parameters
    ----------
    seconds : ndarray, shape (sample,)
        Measured samples only.
    residual, direction : ndarray, shape (sample, row), (sample, row, 3)
        nT; what a field makes of each row.
    frequency, spread : float
        Where the line was seen, and the resolution it was seen with; Hz.
    """
    y, u = residual.reshape(-1), direction.reshape(-1, 3)
    time = np.repeat(seconds, residual.shape[1])
    own, vectors = np.linalg.eigh(u.T @ u)
    seen = vectors[:, own > settings.least_seen * own[-1]]
    best = _refined(time, y, u @ seen, frequency, spread, settings)
    curve, sigma = fold_by_period(time, y, u @ seen, 1.0 / best, settings)
    whole, errors = curve @ seen.T, np.sqrt(sigma**2 @ (seen.T**2))
    amplitude = np.ptp(curve, axis=0) / 2.0
    clear = amplitude / np.maximum(np.sqrt(np.mean(sigma**2, axis=0)), 1e-12)
    main, axis = int(np.argmax(clear)), None
    amplitudes = np.column_stack([np.ptp(whole, axis=0) / 2.0, np.sqrt(np.mean(errors**2, axis=0))])
    steps, size = np.zeros((0, 2)), float(amplitude[main])
    if seen.shape[1] == 3:
        axis = int(np.argmax(amplitudes[:, 0] / np.maximum(amplitudes[:, 1], 1e-12)))
        size = float(amplitudes[axis, 0])
        shape, duty = classify_waveform(whole[:, axis], errors[:, axis], settings)
        if shape in ("square", "pulse"):
            steps = steps_of(whole, errors, axis)
    else:
        shape, duty = classify_waveform(curve[:, main], sigma[:, main], settings)
    # The error of the frequency of a sine in white noise is sqrt(6) / (pi T) over its signal to noise.
    span, strength = float(time[-1] - time[0]), float(clear[main]) * np.sqrt(settings.phases / 2.0)
    explained = _explained(time, y, u @ seen, best, settings.harmonics)
    return Waveform(
        period_s=1.0 / best,
        period_sigma_s=float(best**-2 / (np.pi * max(span, 1.0 / best)) * np.sqrt(6.0) / max(strength, 1.0)),
        axis=axis,
        shape=shape,
        duty=duty,
        amplitude=size,
        amplitudes=amplitudes if axis is not None else np.zeros((0, 2)),
        steps=steps,
        part=explained / max(float(y @ y), 1e-300),
    )


def _explained(seconds: Floats, y: Floats, u: Floats, frequency: float, harmonics: int) -> float:
    """Return the sum of squares that a field at a frequency and its harmonics explains, nT^2."""
    angle = 2.0 * np.pi * frequency * seconds
    waves = [f(k * angle) for k in range(1, harmonics + 1) for f in (np.cos, np.sin)]
    columns = np.concatenate([u * wave[:, None] for wave in waves], axis=1)
    gram = columns.T @ columns
    right = columns.T @ y
    return float(right @ np.linalg.lstsq(gram, right, rcond=1e-10)[0])


def _refined(
    seconds: Floats, y: Floats, u: Floats, frequency: float, spread: float, settings: WaveformSettings
) -> float:
    """Return the frequency that explains most over the whole record, in steps that keep the phase."""
    span = max(seconds[-1] - seconds[0], 1.0 / frequency)
    if seconds.size > settings.most_samples:
        step = seconds.size // settings.most_samples + 1
        seconds, y, u = seconds[::step], y[::step], u[::step]
    reach = settings.search * spread
    low, high = max(frequency - reach, 0.2 * frequency), frequency + reach
    best = frequency
    for _ in range(2):
        grid = np.linspace(low, high, int(np.clip((high - low) * span * 4.0, 21, 161)))
        values = np.array([_explained(seconds, y, u, float(one), settings.harmonics) for one in grid])
        best = float(grid[int(np.argmax(values))])
        width = grid[1] - grid[0]
        low, high = best - width, best + width
    return best


def fold_by_period(
    seconds: Floats, y: Floats, u: Floats, period: float, settings: WaveformSettings = WAVEFORM_SETTINGS
) -> tuple[Floats, Floats]:
    """Return the field along each axis by phase, its median taken off, and its error; (phase, axis), nT.

    Parameters
    ----------
    seconds, y : ndarray, shape (sample,)
        Time and residual, nT.
    u : ndarray, shape (sample, axis)
        What a field along each axis makes of the residual.
    period : float
        Seconds.
    """
    count = settings.phases
    phase = ((seconds % period) / period * count).astype(np.int64) % count
    curve, sigma = np.zeros((count, u.shape[1])), np.full((count, u.shape[1]), np.inf)
    noise = float(np.var(y))
    for place in range(count):
        inside = phase == place
        gram = u[inside].T @ u[inside]
        if inside.sum() > 6:
            curve[place] = np.linalg.lstsq(gram, u[inside].T @ y[inside], rcond=1e-10)[0]
            sigma[place] = np.sqrt(noise * np.diag(np.linalg.pinv(gram)))
    return curve - np.median(curve, axis=0), sigma


def classify_waveform(
    curve: Floats, sigma: Floats, settings: WaveformSettings = WAVEFORM_SETTINGS
) -> tuple[str, float | None]:
    """Return whether a folded curve is a sine, a square wave with its duty, or another shape.

    Parameters
    ----------
    curve, sigma : ndarray, shape (phase,)
        nT.
    """
    waves = np.abs(np.fft.rfft(curve))[1:6]
    finite = np.isfinite(sigma)
    noise = float(np.sqrt(np.mean(sigma[finite] ** 2) * curve.size)) if finite.any() else 0.0
    if waves[1:].max() < max(settings.sine * waves[0], settings.sine_noise * noise):
        return "sine", None
    low, high = np.quantile(curve, [0.1, 0.9])
    on = curve > 0.5 * (low + high)
    levels = np.where(on, curve[on].mean() if on.any() else 0.0, curve[~on].mean() if (~on).any() else 0.0)
    rest = float(np.mean((curve - levels) ** 2))
    whole = float(np.var(curve))
    # By levels, not by phases: a phase in which it switches belongs to both.
    height = np.median(curve[on]) - np.median(curve[~on]) if on.any() and not on.all() else 0.0
    duty = float(np.clip(np.mean(curve - np.median(curve[~on])) / height, 0.0, 1.0)) if height > 0 else 0.0
    if rest < settings.level * whole + noise**2 / curve.size:
        return ("square" if settings.square[0] <= duty <= settings.square[1] else "pulse"), duty
    return "other", duty


def steps_of(curve: Floats, sigma: Floats, main: int) -> Floats:
    """Return what a switch adds along each axis while it is on, and its sigma; (axis, 2) nT.

    Parameters
    ----------
    curve, sigma : ndarray, shape (phase, axis)
    main : int
        The axis that shows when it is on: where the curve is above its middle.

    Returns
    -------
    ndarray
        Empty, (0, 2), when the curve never switches.
    """
    low, high = np.quantile(curve[:, main], [0.1, 0.9])
    on = curve[:, main] > 0.5 * (low + high)
    if on.all() or not on.any():
        return np.zeros((0, 2))
    # A phase in which it switches belongs to neither level: medians leave it out.
    height = np.median(curve[on], axis=0) - np.median(curve[~on], axis=0)
    error = np.sqrt(np.mean(sigma**2, axis=0) * (0.5 * np.pi) * (1.0 / on.sum() + 1.0 / (~on).sum()))
    return np.column_stack([height, error])
