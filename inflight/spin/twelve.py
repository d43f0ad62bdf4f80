"""One table of all twelve parameters, with where each came from.

The spin tells eight of them. The offset along the spin axis comes from nature's statistics, gains and the
turn about the spin axis from the ground or from a model of the Earth's field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.spin.equation import NAMES, SPIN_RELATED, UNITS, TwelveParameters
from inflight.spin.update import Updates

#: What a value came from where nothing else is said.
GROUND, SPIN = "ground", "spin"


@dataclass(frozen=True)
class Known:
    """A value from elsewhere: `value` and `sigma` in the parameter's unit, and `source`, such as a method."""

    value: float
    sigma: float
    source: str


@dataclass(frozen=True)
class TwelveTable:
    """The twelve parameters in the order of `NAMES`.

    Attributes
    ----------
    value, sigma : ndarray, shape (12,)
    source : tuple of 12 str
        ``ground``, ``spin``, or the method that was given.
    determined : ndarray of bool, shape (12,)
        False for what remains at its ground value.
    """

    value: Floats
    sigma: Floats
    source: tuple[str, ...]
    determined: npt.NDArray[np.bool_]

    @property
    def parameters(self) -> TwelveParameters:
        """The values as parameters of the calibration equation."""
        return TwelveParameters.of_values(self.value)

    def sigmas(self) -> dict[str, float]:
        """Return the uncertainties by name."""
        return dict(zip(NAMES, self.sigma.tolist(), strict=True))

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `source` and `determined` by ``parameter``."""
        one = "parameter"
        return xr.Dataset(
            {
                "value": (one, self.value),
                "sigma": (one, self.sigma),
                "source": (one, list(self.source)),
                "determined": (one, self.determined),
            },
            coords={one: list(NAMES), "units": (one, [UNITS[name] for name in NAMES])},
        )


def join_twelve(
    spin: tuple[Floats, Floats, TwelveParameters],
    ground: TwelveParameters,
    ground_sigma: Mapping[str, float],
    others: Mapping[str, Known] | None = None,
    updates: Updates | None = None,
) -> TwelveTable:
    """Join the spin's eight parameters with the axial offset and what the ground knows.

    The spin sees the part of all offsets that lies in the spin plane, ``C O``: estimates of offsets 1 and 2
    hold for the third offset used beside them. Where another one is put in, the two move along, and its
    uncertainty is theirs by the same slope.

    Parameters
    ----------
    spin : tuple of (ndarray (8,), ndarray (8,), TwelveParameters)
        Values, sigmas (infinite for what is not determined) and parameters of an estimate.
    ground : TwelveParameters
        Before flight, or of the table before.
    ground_sigma : mapping of str to float
        By name; what is not named is not known at all.
    others : mapping of str to Known, optional
        The spin-axis offset ``offset[3]`` in the unit of the readings, and whatever else is known better than
        on the ground: gains, rotation.
    updates : Updates, optional
        Where given, its verdicts and values are taken instead of those of `spin`.

    Raises
    ------
    CalibrationError
        A name that is no parameter, or one that the spin tells.
    """
    others = others or {}
    wrong = sorted(name for name in others if name not in NAMES or name in SPIN_RELATED)
    if wrong:
        raise CalibrationError(
            f"{wrong} cannot be joined", remedy=f"take of {sorted(set(NAMES) - set(SPIN_RELATED))}"
        )
    value, sigma = ground.values(), np.array([ground_sigma.get(name, np.inf) for name in NAMES])
    source = [GROUND] * len(NAMES)
    for name, known in others.items():
        at = NAMES.index(name)
        value[at], sigma[at], source[at] = known.value, known.sigma, known.source
    found, errors, parameters = spin
    for order, name in enumerate(SPIN_RELATED):
        at = NAMES.index(name)
        one = updates.of(name) if updates else None
        if np.isfinite(errors[order]) and (one is None or one.verdict != "keep"):
            value[at] = one.value if one else found[order]
            sigma[at] = one.value_sigma if one else errors[order]
            source[at] = SPIN
    _move_along(value, sigma, source, parameters)
    determined = np.array([each != GROUND for each in source])
    return TwelveTable(value, sigma, tuple(source), determined)


def along_axial(parameters: TwelveParameters) -> Floats:
    """Return by how much offsets 1 and 2 move with the third, so that what the spin sees stays; (2,)."""
    matrix = parameters.matrix()
    return np.asarray(-np.linalg.solve(matrix[:2, :2], matrix[:2, 2]))


def _move_along(value: Floats, sigma: Floats, source: list[str], parameters: TwelveParameters) -> None:
    """Move offsets 1 and 2 to the third offset now in the table, in place."""
    third = NAMES.index("offset[3]")
    slope = along_axial(parameters)
    error = sigma[third] if np.isfinite(sigma[third]) else 0.0
    for at in range(2):
        row = NAMES.index(f"offset[{at + 1}]")
        if source[row] == SPIN:
            value[row] += slope[at] * (value[third] - parameters.offset[2])
            sigma[row] = float(np.hypot(sigma[row], slope[at] * error))
