"""Channels made from channels: a difference, a slow response, a play (backlash), a product; each has a name.

A derived name may stand wherever a channel's name may:

``battery_current@lag=600s``
    First-order low-pass response with a time constant of 600 s and unit gain.
``boom_temperature@width=2``
    Play operator of full width 2, in the channel's unit: the simplest hysteresis.
``boom_temperature@about=21.5``
    What the channel is above 21.5, in its unit.
``heater_current@delay=20s``
    What the channel was 20 s ago; with a minus, what it will be.
``solar_current~3``
    Third placebo: the channel shifted in time. Only a search makes it; no model may name it.
``solar_current*boom_temperature``
    Product; each factor may carry a response or a play: ``a@lag=600s*b``.

With several, the difference comes first, then delay, response and play: ``a@lag=600s@width=2`` is the play of
the response.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from inflight.arrays import Floats
from inflight.compiled import compiled
from inflight.errors import ModelError
from inflight.time import DAY, GAP, SECOND, parse_duration


@dataclass(frozen=True, kw_only=True)
class ResponseSettings:
    """How slow responses are made.

    Attributes
    ----------
    history : float
        Earlier data that a response needs, in time constants: ``exp(-8)``, what came before counts for 0.03 %
        (derived).
    long_gap : float
        A gap longer than this many time constants makes a response start anew (assumed).
    usual_step_of : int
        Steps the usual one is taken from, for speed.
    """

    history: float = 8.0
    long_gap: float = 3.0
    usual_step_of: int = 2000


RESPONSE_SETTINGS = ResponseSettings()

#: Version of how a play is made: it enters the keys of what is made from one.
PLAY_VERSION = 2

_PART = re.compile(r"^(?P<channel>[^@~*]+)(?P<options>(?:@\w+=[^@~*]+)*)(?:~(?P<placebo>[1-9]\d*))?$")

_OPTION = re.compile(r"@(\w+)=([^@~*]+)")

_REMEDY = (
    "write a channel, 'channel@lag=600s', 'channel@delay=20s', 'channel@width=2', 'channel@about=20', "
    "or a product with '*'"
)

#: Options of a factor that may have either sign.
_SIGNED = frozenset({"about", "delay"})


@dataclass(frozen=True)
class ChannelFactor:
    """One factor of a derived channel.

    Attributes
    ----------
    channel : str
        Name of the channel it is made from.
    lag_s : float
        Time constant of the response, seconds; 0 for none.
    width : float
        Full width of the play, in the channel's unit; 0 for none.
    placebo : int
        Number of the placebo, from 1; 0 for the channel itself.
    about : float
        What is taken off the channel first, in its unit.
    delay_s : float
        By how much it is late, seconds; negative when it leads.
    text : str
        The part as it was written; it does not count in comparisons.
    """

    channel: str
    lag_s: float = 0.0
    width: float = 0.0
    placebo: int = 0
    about: float = 0.0
    delay_s: float = 0.0
    text: str = field(default="", compare=False)

    @property
    def name(self) -> str:
        """Name as written, or the shortest equal one."""
        if self.text:
            return self.text
        about = f"@about={self.about:.12g}" if self.about else ""
        delay = f"@delay={self.delay_s:.12g}s" if self.delay_s else ""
        lag = f"@lag={self.lag_s:.12g}s" if self.lag_s else ""
        width = f"@width={self.width:.12g}" if self.width else ""
        return f"{self.channel}{about}{delay}{lag}{width}{f'~{self.placebo}' if self.placebo else ''}"

    @property
    def is_plain(self) -> bool:
        """True when the part is the channel itself."""
        return not (self.lag_s or self.width or self.placebo or self.about or self.delay_s)

    @property
    def history_s(self) -> float:
        """Seconds of earlier data it needs: eight lags, a day for a play, and what it is late by."""
        past = RESPONSE_SETTINGS.history * self.lag_s + (DAY / SECOND if self.width else 0.0)
        return past + max(self.delay_s, 0.0)

    def of(self, values: Floats, step_s: float | Floats) -> Floats:
        """Return what is made of a channel: difference, delay, response, play; (time,) or (time, axis).

        It is in the channel's unit.

        Parameters
        ----------
        values : ndarray, shape (time,) or (time, axis)
            The channel.
        step_s : float or ndarray, shape (time - 1,)
            Seconds between samples.
        """
        above = values - self.about if self.about else values
        late = delayed(above, step_s, self.delay_s) if self.delay_s else above
        slow = slow_response(late, step_s, self.lag_s) if self.lag_s else late
        return play(slow, self.width) if self.width else slow


@dataclass(frozen=True)
class DerivedChannel:
    """A channel as the product of its parts; one part is no product."""

    parts: tuple[ChannelFactor, ...]

    @property
    def name(self) -> str:
        """Name of the whole."""
        return "*".join(part.name for part in self.parts)

    @property
    def is_plain(self) -> bool:
        """True when it is just a channel."""
        return len(self.parts) == 1 and self.parts[0].is_plain


@lru_cache(maxsize=4096)
def parse_channel(name: str) -> DerivedChannel:
    """Read the name of a channel, derived or not.

    Raises
    ------
    ModelError
        When it is no such name.
    """
    return DerivedChannel(tuple(_parse_factor(text, name) for text in name.split("*")))


def _parse_factor(text: str, name: str) -> ChannelFactor:
    """Read one factor of the derived channel `name`."""
    match = _PART.match(text.strip())
    if match is None:
        raise ModelError(f"{name!r} names no channel", channel=name, remedy=_REMEDY)
    options: dict[str, float] = {}
    for key, value in _OPTION.findall(match["options"]):
        if key not in ("lag", "delay", "width", "about") or key in options:
            raise ModelError(f"{name!r} has no use for '@{key}={value}'", channel=name, remedy=_REMEDY)
        try:
            size = parse_duration(value) / SECOND if key in ("lag", "delay") else float(value)
        except ValueError as error:
            raise ModelError(f"{name!r}: {error}", channel=name, remedy=_REMEDY) from None
        if not np.isfinite(size) or (key not in _SIGNED and size <= 0):
            raise ModelError(
                f"{name!r}: '{key}' must be {'finite' if key in _SIGNED else 'positive'}",
                channel=name,
                remedy=_REMEDY,
            )
        options[key] = size
    return ChannelFactor(
        match["channel"].strip(),
        options.get("lag", 0.0),
        options.get("width", 0.0),
        int(match["placebo"] or 0),
        options.get("about", 0.0),
        options.get("delay", 0.0),
        text.strip(),
    )


def base_channels(name: str) -> tuple[str, ...]:
    """Return the channels a name is made from, each once, in the order they are named.

    Raises
    ------
    ModelError
        When it is no channel's name.
    """
    return tuple(dict.fromkeys(part.channel for part in parse_channel(name).parts))


def history_s(name: str) -> float:
    """Return the seconds of earlier data a derived channel needs before its first sample."""
    return max(part.history_s for part in parse_channel(name).parts)


def channel_product(factors: Sequence[Floats]) -> Floats:
    """Return the product of channels; (time,), or (time, axis) when one of them is a vector.

    Raises
    ------
    ModelError
        When vectors of unequal length meet.
    """
    widths = {factor.shape[1] for factor in factors if factor.ndim == 2}
    if len(widths) > 1:
        raise ModelError(
            f"channels of {' and '.join(map(str, sorted(widths)))} components have no product",
            remedy="multiply a vector by channels of one number a time",
        )
    shaped = [factor[:, None] if widths and factor.ndim == 1 else factor for factor in factors]
    out = shaped[0].copy() if shaped[0].ndim == max(part.ndim for part in shaped) else shaped[0]
    for factor in shaped[1:]:
        out = out * factor
    return out


def derive_channel(name: str, channels: Mapping[str, Floats], step_s: float | Floats) -> Floats:
    """Return a derived channel from channels on one time base.

    Parameters
    ----------
    name : str
        The derived name.
    channels : mapping of str to ndarray
        (time,) or (time, axis) by name.
    step_s : float or ndarray, shape (time - 1,)
        Seconds between samples.

    Returns
    -------
    ndarray, shape (time,) or (time, axis)

    Raises
    ------
    ModelError
        When a channel is not there, or the name asks for a placebo.
    """
    derived = parse_channel(name)
    for part in derived.parts:
        if part.channel not in channels:
            raise ModelError(f"{name!r} needs a channel that is not there", channel=part.channel)
        if part.placebo:
            raise ModelError(f"{name!r} is a placebo", channel=name, remedy="only a search makes placebos")
    return channel_product([part.of(channels[part.channel], step_s) for part in derived.parts])


def delayed(values: Floats, step_s: float | Floats, delay_s: float) -> Floats:
    """Return what a channel was some time ago, with straight lines between its samples.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        The channel; NaN where it is missing, and where a sample that is needed is.
    step_s : float or ndarray, shape (time - 1,)
        Seconds between samples.
    delay_s : float
        By how much it is late; negative when it leads. Beyond the ends the outer samples hold.

    Returns
    -------
    ndarray
        Same shape and unit.
    """
    count = max(values.shape[0] - 1, 0)
    steps = np.broadcast_to(np.asarray(step_s, dtype=np.float64), (count,))
    seconds = np.concatenate([[0.0], np.cumsum(steps)])
    flat = np.asarray(values, dtype=np.float64).reshape(values.shape[0], -1)
    late = [np.interp(seconds - delay_s, seconds, column) for column in flat.T]
    return np.stack(late, axis=-1).reshape(values.shape) if values.size else np.array(flat)


def slow_response(values: Floats, step_s: float | Floats, lag_s: float) -> Floats:
    """Return the first-order response ``lag dy/dt + y = c`` of a channel, exact between its samples.

    The channel runs straight from sample to sample, so that the response of a coarse series agrees
    with that of a fine one. The first sample is taken as the steady state. Samples that are missing
    stay missing; the response runs on across them, and starts anew after more than three time constants.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        The channel; NaN where it is missing.
    step_s : float or ndarray, shape (time - 1,)
        Seconds between samples.
    lag_s : float
        Time constant; 0 returns the channel.

    Returns
    -------
    ndarray
        Same shape and unit.

    Raises
    ------
    ValueError
        When the time constant is negative, or the steps do not fit the values.
    """
    if lag_s < 0:
        raise ValueError(f"a time constant of {lag_s} s makes no response; it must not be negative")
    if lag_s == 0:
        return np.array(values, dtype=np.float64)
    count = max(values.shape[0] - 1, 0)
    steps = np.broadcast_to(np.asarray(step_s, dtype=np.float64), (count,))
    series = np.ascontiguousarray(np.asarray(values, dtype=np.float64).reshape(values.shape[0], -1))
    usual = float(np.median(steps[: RESPONSE_SETTINGS.usual_step_of])) if count else 0.0
    longest = max(RESPONSE_SETTINGS.long_gap * lag_s, GAP * usual)
    found = _respond(series, np.ascontiguousarray(steps), float(lag_s), longest)
    return np.asarray(found).reshape(values.shape)


@compiled
def _respond(values: Floats, steps: Floats, lag: float, longest: float) -> Floats:  # pragma: no cover
    out = np.full_like(values, np.nan)
    for column in range(values.shape[1]):
        state, previous, elapsed, known = 0.0, 0.0, 0.0, False
        # An even series has one step: its exponential is the larger part of the work.
        step, decay = -1.0, 0.0
        for i in range(values.shape[0]):
            if i > 0:
                elapsed += steps[i - 1]
            now = values[i, column]
            if not np.isfinite(now):
                continue
            if not known or elapsed > longest:
                state = now
            elif elapsed > 0.0:
                # Solution for an input that is a straight line: it lags by the slope times the lag.
                if elapsed != step:
                    step, decay = elapsed, np.exp(-elapsed / lag)
                delay = (now - previous) / elapsed * lag
                state = now - delay + (state - previous + delay) * decay
            previous, elapsed, known = now, 0.0, True
            out[i, column] = state
    return out


def play(values: Floats, width: float) -> Floats:
    """Return the play (backlash) of a channel: it follows only when pushed by half the width.

    Where it stands at first is not known before the channel has moved by the whole width. Until then it
    stands still, at the one place from which the channel never pushes it; of a channel that never moves so
    far, in the middle of its range. A later start of the same record then stands at nearly the same place.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        The channel; NaN are passed over and stay NaN.
    width : float
        Full width of the play, in the channel's unit; 0 returns the channel.

    Returns
    -------
    ndarray
        Same shape and unit; never further than half the width from the channel.

    Raises
    ------
    ValueError
        When the width is negative.
    """
    if width < 0:
        raise ValueError(f"a play of width {width} makes no sense; it must not be negative")
    series = np.ascontiguousarray(np.asarray(values, dtype=np.float64).reshape(values.shape[0], -1))
    return np.asarray(_play(series, 0.5 * float(width))).reshape(values.shape)


@compiled
def _play(values: Floats, half: float) -> Floats:  # pragma: no cover
    out = np.full_like(values, np.nan)
    for column in range(values.shape[1]):
        low, high = np.inf, -np.inf
        for i in range(values.shape[0]):
            now = values[i, column]
            if not np.isfinite(now):
                continue
            below, above = min(low, now), max(high, now)
            if above - below > 2.0 * half and high >= low:
                # The side that is not pushed is where the width begins.
                low, high = (low, low + 2.0 * half) if now > high else (high - 2.0 * half, high)
                break
            low, high = below, above
        state = 0.5 * (low + high)
        for i in range(values.shape[0]):
            now = values[i, column]
            if not np.isfinite(now):
                continue
            state = min(max(state, now - half), now + half)
            out[i, column] = state
    return out
