"""The Earth's main field from spherical harmonic coefficients: the IGRF, or a file in the SHC format.

In go Earth-fixed positions and times, out comes the field there (`MainField.at`). The IGRF's coefficients,
the reader of SHC files and the Legendre functions are those of ``ppigrf``; only the sums are written here,
because its own evaluation raises to a power and calls pandas for every point and costs five times as much.

`along_orbit` gives the field at many stamps from few positions, as an orbit file has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.errors import MissionError
from inflight.time import DAY, SECOND, Int64, day_bounds, to_utc

#: The model that comes with the software.
IGRF = "igrf"

#: Reference radius of the coefficients, km (IGRF and every model in the SHC format).
_RADIUS = 6371.2

#: Spacing of the places at which an orbit's field is summed, ns: a cubic between them is right to pT for
#: degree 13, and to 0.02 nT for degree 110.
_STEP = 10 * SECOND

#: An orbit is not followed across a gap of more of its own steps than this; assumed.
_MOST_STEPS = 5


@dataclass(frozen=True, eq=False)
class MainField:
    """Coefficients of a model of the main field.

    Attributes
    ----------
    name : str
        ``igrf``, or the name of the file.
    epochs : ndarray, shape (epoch,)
        Days since 1970 (UTC).
    g, h : ndarray, shape (epoch, term)
        Schmidt semi-normalised, nT; linear between epochs, and constant outside them.
    degree, order : ndarray of int, shape (term,)
    """

    name: str
    epochs: Floats
    g: Floats
    h: Floats
    degree: Int64
    order: Int64

    @classmethod
    def of(cls, name: str, folder: Path = Path()) -> MainField:
        """Return the IGRF, or the model of a file in the SHC format; read once.

        Files with splines in time, as CHAOS has, list enough epochs that straight lines between them are
        right to 0.02 nT.

        Raises
        ------
        MissionError
            When there is no such file, or it is no SHC file.
        """
        if name == IGRF:
            return _read(None, 0)
        path = folder / name
        if not path.is_file():
            raise MissionError(
                f"there is no file {name!r} with the coefficients of a field model",
                file="mission.yaml",
                remedy=f"put it (SHC format) beside mission.yaml, or take 'model: {IGRF}', which needs none",
            )
        return _read(path, path.stat().st_mtime_ns)

    def at(self, position: Floats, tt2000: Int64) -> Floats:
        """Return the field at positions and times.

        Parameters
        ----------
        position : ndarray, shape (time, 3)
            km, itrf; NaN gives NaN.
        tt2000 : ndarray of int64, shape (time,)

        Returns
        -------
        ndarray, shape (time, 3)
            nT, itrf.
        """
        out = np.full(position.shape, np.nan)
        days = to_utc(tt2000).astype("datetime64[D]")
        known = np.isfinite(position).all(axis=1) & (np.linalg.norm(position, axis=1) > 0.5 * _RADIUS)
        for day in np.unique(days[known]):
            rows = np.flatnonzero(known & (days == day))
            start, end = day_bounds(day)
            out[rows] = self.on_day(position[rows], day, (tt2000[rows] - start) / (end - start))
        return out

    def on_day(self, position: Floats, day: np.datetime64, part: Floats) -> Floats:
        """Return the field at positions (time, 3), km itrf, at parts (time,) of a UTC day; nT, itrf.

        The model is summed at both ends of the day and blended, as it is linear in time itself.
        """
        x, y, z = position.T
        # At a pole itself every direction across is as good.
        across = np.maximum(np.hypot(x, y), 1e-9)
        radius = np.hypot(across, z)
        sin_t, cos_t, sin_p, cos_p = across / radius, z / radius, y / across, x / across
        theta, phi = np.arctan2(across, z), np.arctan2(y, x)
        ends = self._synthesis(radius, theta, phi, day.astype(np.float64) + np.array([0.0, 1.0]))
        up, south, east = (both[:, 0] + part * (both[:, 1] - both[:, 0]) for both in ends)
        level = up * sin_t + south * cos_t
        return np.column_stack(
            [level * cos_p - east * sin_p, level * sin_p + east * cos_p, up * cos_t - south * sin_t]
        )

    def along_orbit(self, position: Floats, position_tt2000: Int64, tt2000: Int64) -> Floats:
        """Return the field at stamps, from positions of an orbit at stamps of its own.

        Parameters
        ----------
        position : ndarray, shape (place, 3)
            km, itrf; rows with NaN are left out.
        position_tt2000 : ndarray of int64, shape (place,)
            Rising.
        tt2000 : ndarray of int64, shape (time,)
            Rising.

        Returns
        -------
        ndarray, shape (time, 3)
            nT, itrf; NaN beyond the orbit's ends and within gaps of it.
        """
        out = np.full((tt2000.size, 3), np.nan)
        known = np.isfinite(position).all(axis=1)
        position, places = position[known], position_tt2000[known]
        if places.size < 4 or not tt2000.size:
            return out
        steps = np.diff(places)
        runs = np.split(np.arange(places.size), np.flatnonzero(steps > _MOST_STEPS * np.median(steps)) + 1)
        for run in (run for run in runs if run.size >= 4):
            first, last = (int(places[at]) for at in (run[0], run[-1]))
            inside = np.flatnonzero((first <= tt2000) & (tt2000 <= last))
            if not inside.size:
                continue
            low, high = max(first, int(tt2000[inside[0]]) - _STEP), min(last, int(tt2000[inside[-1]]) + _STEP)
            nodes = np.linspace(low, high, max(4, -(-(high - low) // _STEP) + 1)).astype(np.int64)
            follow = scipy.interpolate.CubicSpline((places[run] - first) / SECOND, position[run])
            field = self.at(follow((nodes - first) / SECOND), nodes)
            seconds = (nodes - first) / SECOND
            out[inside] = scipy.interpolate.CubicSpline(seconds, field)((tt2000[inside] - first) / SECOND)
        return out

    def dipole_coefficients(self, days: Floats) -> Floats:
        """Return g11, h11 and g10 at days since 1970; (time, 3) nT."""
        first = self.degree == 1
        terms = [(self.g, 1), (self.h, 1), (self.g, 0)]
        return np.stack(
            [
                np.interp(days, self.epochs, values[:, first & (self.order == order)][:, 0])
                for values, order in terms
            ],
            axis=1,
        )

    def _synthesis(
        self, radius: Floats, theta: Floats, phi: Floats, days: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Up, south and east components, nT, each (time, day); angles in rad, radius in km."""
        from ppigrf.ppigrf import get_legendre

        degree, order = self.degree, self.order
        g, h = (np.array([np.interp(days, self.epochs, one) for one in both.T]) for both in (self.g, self.h))
        legendre, slope = get_legendre(np.degrees(theta), list(zip(degree, order, strict=True)))
        orders = np.arange(order.max() + 1) * phi[:, None]
        cosine, sine = np.cos(orders)[:, order], np.sin(orders)[:, order]
        powers = (_RADIUS / radius[:, None]) ** (np.arange(degree.max() + 1) + 2)
        legendre, slope = legendre * powers[:, degree], slope * powers[:, degree]
        rising, falling = legendre * cosine, legendre * sine
        weight, turns = (degree + 1)[:, None], order[:, None]
        return (
            rising @ (weight * g) + falling @ (weight * h),
            -(slope * cosine) @ g - (slope * sine) @ h,
            (falling @ (turns * g) - rising @ (turns * h)) / np.sin(theta)[:, None],
        )


@lru_cache(maxsize=4)
def _read(path: Path | None, changed: int) -> MainField:
    """Read a file of coefficients as it was changed last; that of the IGRF when None."""
    del changed
    from ppigrf.ppigrf import read_shc

    try:
        g, h = read_shc() if path is None else read_shc(str(path))
    except (OSError, ValueError, AssertionError, KeyError, IndexError, UnboundLocalError) as error:
        raise MissionError(
            f"is no file of spherical harmonic coefficients (SHC): {error}",
            file=str(path),
            remedy="take the file of the core field as its authors publish it, ending in .shc",
        ) from None
    degree, order = np.array(list(g.columns), dtype=np.int64).T
    epochs = g.index.to_numpy().astype("datetime64[ns]").astype(np.float64) / DAY
    return MainField(
        IGRF if path is None else path.name,
        epochs,
        g.to_numpy(np.float64),
        h[g.columns].to_numpy(np.float64),
        degree,
        order,
    )
