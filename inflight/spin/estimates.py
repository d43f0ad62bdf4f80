"""The eight spin-related parameters from each sub-interval alone, each with its own uncertainty.

Four pairs follow one after the other (Plaschke et al. 2019, section 5): the spin axis from the spin tone of
Bz; gain ratio and azimuth from the modulus at twice the spin; and from the modulus at the spin either the
spin-plane offsets or the elevation angles. That tone is `O + Ba (sP - dth)`: the axial field Ba says which
of the two a sub-interval is good for, and the uncertainties say it in numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.spin.block_sums import SERIES
from inflight.spin.equation import NAMES, SPIN_RELATED, UNITS, TwelveParameters
from inflight.spin.harmonics import SpinTones
from inflight.spin.layout import Bools
from inflight.time import Int64

#: The pairs in the order they are determined in, and for each which tones show it.
PAIRS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "spin axis": ("spin_axis[x]", "spin_axis[y]"),
        "gain ratio and azimuth": ("gain_ratio", "azimuth"),
        "offsets": ("offset[1]", "offset[2]"),
        "elevations": ("elevation[1]", "elevation[2]"),
    }
)
#: Rows of the equations of a sub-interval: Bz and modulus at the spin, modulus at twice the spin.
_ROWS = {"spin axis": slice(0, 2), "gain ratio and azimuth": slice(4, 6)}
_SPIN_ROWS = slice(2, 4)
#: Step of the derivative of the coupling matrix; its error is of second order.
_STEP = 1e-6


@dataclass(frozen=True)
class SpinEquations:
    """What the tones of every sub-interval demand: ``residual + design @ change = 0``.

    Attributes
    ----------
    residual : ndarray, shape (sub, 6)
        cos and sin of Bz at the spin, of the modulus at the spin, of the modulus at twice the spin; nT.
    design : ndarray, shape (sub, 6, 8)
        Derivatives by `SPIN_RELATED`.
    noise : ndarray, shape (sub, 6)
        Standard deviation of the residual by natural fluctuations, nT.
    """

    residual: Floats
    design: Floats
    noise: Floats


@dataclass(frozen=True)
class SpinEstimates:
    """Estimates of the eight parameters from single sub-intervals.

    Attributes
    ----------
    start, end : ndarray of int64, shape (sub,)
        TT2000.
    value : ndarray, shape (sub, 8)
        In the order of `SPIN_RELATED`; NaN where a sub-interval gives none.
    sigma : ndarray, shape (sub, 8)
        Standard deviation by natural fluctuations alone, the other pairs held.
    uncertainty : ndarray, shape (sub, 8)
        As published (table 2): the larger neighbouring amplitude over the field, with what the uncertainty of
        the other pairs adds. 1.7 times `sigma` in white noise.
    sensitivity : ndarray, shape (sub, 8, 8)
        By how much an estimate moves where a parameter held is raised by 1; 0 within a pair.
    usable : ndarray of bool, shape (sub,)
    parameters : TwelveParameters
        Held while these were made.
    spread : mapping of str to float
        Uncertainty of spin axis, offsets and elevations that went into `uncertainty`.
    blocks : int
        As in `SpinTones`.
    """

    start: Int64
    end: Int64
    value: Floats
    sigma: Floats
    uncertainty: Floats
    sensitivity: Floats
    usable: Bools
    parameters: TwelveParameters
    spread: Mapping[str, float]
    blocks: int

    def of(self, name: str) -> tuple[Floats, Floats]:
        """Return values and published uncertainties (sub,) of one parameter."""
        at = SPIN_RELATED.index(name)
        return self.value[:, at], self.uncertainty[:, at]

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma` and `uncertainty` by ``sub_interval`` and ``parameter``."""
        dims = ("sub_interval", "parameter")
        return xr.Dataset(
            {
                "value": (dims, self.value),
                "sigma": (dims, self.sigma),
                "uncertainty": (dims, self.uncertainty),
                "usable": ("sub_interval", self.usable),
                "start": ("sub_interval", self.start, {"scale": "TT2000"}),
                "end": ("sub_interval", self.end, {"scale": "TT2000"}),
            },
            coords={
                "parameter": list(SPIN_RELATED),
                "units": ("parameter", [UNITS[name] for name in SPIN_RELATED]),
            },
            attrs={f"spread of {name}": value for name, value in self.spread.items()},
        )


def spin_equations(tones: SpinTones) -> SpinEquations:
    """Return the linear equations of every sub-interval at the parameters of its tones.

    Derivatives are those of the exact equation (9): with ``B = C (R - O)``, ``dB/dp = (dC/dp) C^-1 B`` and
    ``dB/dO = -C``; the modulus changes by ``u dBx + v dBy``.
    """
    axial, plane = _derivatives(tones.parameters)
    first, second = tones.tones[:, :2], tones.tones[:, 2:]
    z, m = SERIES.index("z"), SERIES.index("m")
    residual = np.concatenate([first[..., z], first[..., m], second[..., m]], axis=1)
    design = np.concatenate([first @ axial.T, first @ plane.T, second @ plane.T], axis=1)
    return SpinEquations(residual, design, np.repeat(tones.noise, 2, axis=1))


def _derivatives(parameters: TwelveParameters) -> tuple[Floats, Floats]:
    """Return derivatives of Bz and of the modulus as sums of `SERIES`; both (8, series)."""
    at = {name: index for index, name in enumerate(SERIES)}
    axial, plane = (np.zeros((len(SPIN_RELATED), len(SERIES))) for _ in range(2))
    matrix = parameters.matrix()
    for row, name in enumerate(SPIN_RELATED):
        if name.startswith("offset"):
            column = matrix[:, NAMES.index(name) - NAMES.index("offset[1]")]
            plane[row, [at["u"], at["v"]]] = -column[:2]
            continue
        value = parameters.values()[NAMES.index(name)]
        up, down = (parameters.changed({name: value + way * _STEP}).matrix() for way in (1.0, -1.0))
        turn = (up - down) / (2.0 * _STEP) @ np.linalg.inv(matrix)
        axial[row, :3] = turn[2]
        # u By = v Bx, and v By = m - u Bx.
        plane[row, at["xu"]] = turn[0, 0] - turn[1, 1]
        plane[row, at["m"]] = turn[1, 1]
        plane[row, at["xv"]] = turn[0, 1] + turn[1, 0]
        plane[row, [at["zu"], at["zv"]]] = turn[0, 2], turn[1, 2]
    return axial, plane


def estimate_pairs(tones: SpinTones, spread: Mapping[str, float]) -> SpinEstimates:
    """Return what each sub-interval says of each pair, the others held.

    Parameters
    ----------
    tones : SpinTones
    spread : mapping of str to float
        Uncertainty of the pairs ``spin axis`` and ``elevations`` (rad) and ``offsets`` (nT) held.
    """
    equations = spin_equations(tones)
    count = tones.start.size
    value, sigma = (np.full((count, len(SPIN_RELATED)), np.nan) for _ in range(2))
    sensitivity = np.zeros((count, len(SPIN_RELATED), len(SPIN_RELATED)))
    present = tones.parameters.spin_related()
    for pair, names in PAIRS.items():
        rows = _ROWS.get(pair, _SPIN_ROWS)
        columns = [SPIN_RELATED.index(name) for name in names]
        change, own, moved = _solve(equations, rows, columns)
        value[:, columns] = present[columns] + change
        sigma[:, columns] = own
        moved[:, :, columns] = 0.0
        sensitivity[:, columns] = moved
    lost = ~tones.usable
    value[lost], sigma[lost] = np.nan, np.nan
    return SpinEstimates(
        tones.start,
        tones.end,
        value,
        sigma,
        published_uncertainty(tones, spread),
        sensitivity,
        tones.usable & np.isfinite(value).all(axis=1),
        tones.parameters,
        MappingProxyType(dict(spread)),
        tones.blocks,
    )


def _solve(equations: SpinEquations, rows: slice, columns: list[int]) -> tuple[Floats, Floats, Floats]:
    """Return the change (sub, 2) that removes two tones, its sigma, and its slopes by all parameters."""
    design = equations.design[:, rows, columns]
    scale = np.linalg.norm(design, axis=(1, 2), keepdims=True)
    known = np.isfinite(scale[:, 0, 0]) & (
        np.abs(np.linalg.det(np.nan_to_num(design))) > 1e-6 * scale[:, 0, 0] ** 2
    )
    safe = np.where(known[:, None, None], design, np.eye(2))
    inverse = np.linalg.inv(safe)
    inverse[~known] = np.nan
    change = -np.einsum("sij,sj->si", inverse, equations.residual[:, rows])
    own = np.sqrt(np.einsum("sij,sj->si", inverse**2, equations.noise[:, rows] ** 2))
    return change, own, -inverse @ equations.design[:, rows]


def published_uncertainty(tones: SpinTones, spread: Mapping[str, float]) -> Floats:
    """Return the uncertainties of table 2 of Plaschke et al. (2019); (sub, 8).

    ``Fa/Bp``, ``F2p/Bp``, ``2 F2p/Bp`` with the least modulus, ``Fp + Ba (dsigma + dth)`` with the largest
    and ``(Fp + dO)/Ba + dsigma`` with the least size of Bz.
    """
    axial, spin, double = tones.amplitude.T
    least = np.maximum(tones.least_modulus, 1e-12)
    angle = spread["spin axis"]
    offset = spin + tones.largest_axial * (angle + spread["elevations"])
    elevation = (spin + spread["offsets"]) / np.maximum(tones.least_axial, 1e-12) + angle
    by_name = {"gain_ratio": double / least, "azimuth": 2.0 * double / least}
    by_name |= {f"spin_axis[{axis}]": axial / least for axis in "xy"}
    by_name |= {f"offset[{axis}]": offset for axis in "12"}
    by_name |= {f"elevation[{axis}]": elevation for axis in "12"}
    found = np.stack([by_name[name] for name in SPIN_RELATED], axis=1)
    found[~tones.usable] = np.nan
    return found
