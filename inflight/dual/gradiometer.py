"""The outboard sensor's stray field from the difference of both sensors: Ness et al. (1971), and beyond it.

A dipole on the boom's axis makes ``k`` times its inboard field at the outboard sensor, so that the ambient
field is ``B = (B_out - k B_in) / (1 - k)`` and the stray field at the outboard sensor ``k / (1 - k) d`` with
``d = B_in - B_out``. Units off the axis have other factors: in general the stray field is a matrix times
``d``. Its forms are one ratio, one for each axis, the strongest directions of ``d`` (`principal`), the
matrix of a dipole whose place is fitted, and the full matrix.

What of ``d`` is ambient field, let in by sensors that are not aligned or scaled alike, is fitted beside the
matrix (`mixing`) and taken out before: otherwise the field that is measured would be changed in proportion
to itself. What of ``d`` is the sensors' noise is not taken over: `bands` weighs it on each time scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from inflight.arrays import Floats
from inflight.dual.mixing import Mixing, fit_mixing, moments_of, noise_of, usable_cells
from inflight.dual.moments import ELEMENTS, Moments, Noise
from inflight.dual.noise_floor import noise_floor
from inflight.dual.places import (
    Body,
    dipole_matrix,
    fit_place,
    known_from,
    matrices_of_any_boom,
    spread_at,
)
from inflight.dual.principal import principal_directions
from inflight.dual.readings import Readings
from inflight.dual.scales import Cells, cells_of
from inflight.errors import CalibrationError, SettingsError

#: Forms of the matrix, from the fewest numbers to the most.
FORMS = ("ratio", "axes", "dipole", "principal", "matrix")
#: Standard deviation of an element of the leak before anything is seen: a percent is a poor calibration.
LEAK_SIGMA = 0.01
_FEWEST = 256
#: Part of the units' spread that one matrix leaves and no regression shows, where all three axes of the
#: difference are in use: six units are taken for usual, of which a matrix fits three.
_UNSEEN = 0.5
#: Scales, an octave each, of a band that is asked for a matrix of its own.
_BAND = 2
#: Part of the weighted variance of the difference that the principal directions must hold.
_HELD = 0.99


@dataclass(frozen=True)
class Gradiometer:
    """A fitted gradiometer: ``stray at the outboard sensor = matrix e``, ``e = d - leak B``.

    Attributes
    ----------
    form : str
        One of `FORMS`.
    mixing : Mixing
        The matrix in this form, and the leak.
    covariance : ndarray, shape (9, 9)
        Of the elements of the matrix, row by row: of the mean over units and of their scatter, that which
        shows and that which geometry lets expect.
    value, value_covariance : ndarray, shape (parameter,), (parameter, parameter)
        The numbers of the form.
    noise : ndarray, shape (3, 3)
        Covariance of the white noise of the difference, nT^2.
    facts : mapping
        Of ``ratio``: k and its sigma. Of ``dipole``: the place and its sigma, m. Of ``principal``:
        directions.
    """

    form: str
    mixing: Mixing
    covariance: Floats
    value: Floats
    value_covariance: Floats
    noise: Floats
    facts: Mapping[str, float | list[float]] = field(default_factory=dict)

    @property
    def matrix(self) -> Floats:
        """What takes the stray part of the difference to the outboard sensor; (3, 3)."""
        return self.mixing.matrix

    @property
    def leak(self) -> Floats:
        """Share of the ambient field in the difference; (3, 3)."""
        return self.mixing.leak

    @property
    def leak_effect(self) -> Floats:
        """Covariance of the elements of matrix times leak, row by row; (9, 9)."""
        wide = np.kron(self.matrix, np.eye(3))
        return np.asarray(wide @ self.mixing.leak_covariance @ wide.T)

    def stray(self, readings: Readings) -> Floats:
        """Return the difference without what it holds of the ambient field; (time, axis), nT."""
        both = np.concatenate([readings.outboard, readings.difference], axis=1)
        return np.asarray(both @ self.mixing.stray_rows().T)


def fit_gradiometer(
    readings: Readings,
    form: str = "matrix",
    body: Body | None = None,
    leak_sigma: float = LEAK_SIGMA,
) -> Gradiometer:
    """Fit a gradiometer of one form; as `fit_forms`."""
    return fit_forms(readings, (form,), body, leak_sigma)[form]


def fit_forms(
    readings: Readings,
    forms: Sequence[str] = FORMS,
    body: Body | None = None,
    leak_sigma: float = LEAK_SIGMA,
) -> dict[str, Gradiometer]:
    """Fit gradiometers to readings in which the spacecraft's field changes.

    Parameters
    ----------
    readings : Readings
    forms : sequence of str
        Of `FORMS`.
    body : Body, optional
        Where sensors and units are, spacecraft axes. Where given, every form starts from what geometry says;
        ``dipole`` needs it.
    leak_sigma : float
        Standard deviation of the elements of the leak before the fit: how well the two sensors are aligned
        and scaled to each other. 0 when they are perfect.

    Raises
    ------
    SettingsError
        For an unknown form, or a dipole without a body.
    CalibrationError
        With fewer than 256 good samples.
    """
    if unknown := set(forms) - set(FORMS):
        raise SettingsError(
            f"form '{min(unknown)}' of a gradiometer", remedy=f"choose from {', '.join(FORMS)}"
        )
    if "dipole" in forms and body is None:
        raise SettingsError(
            "a dipole has no place", remedy="say where the sensors' positions and the spacecraft's body are"
        )
    good = readings.good
    if good.sum() < _FEWEST:
        raise CalibrationError(
            f"{good.sum()} samples with both sensors found, at least {_FEWEST} needed",
            remedy="take a longer span",
        )
    every = cells_of(readings.outboard[good], readings.difference[good])
    noise = noise_of(every, noise_floor(every, readings.difference[good], readings.noise), leak_sigma)
    cells = usable_cells(every, noise)
    prior = known_from(matrices_of_any_boom() if body is None else body.matrices)
    mixing = fit_mixing(cells, noise, prior, leak_sigma)
    told = moments_of(cells, mixing, noise)
    value, covariance = told.solve(ELEMENTS, prior)
    mixing = replace(mixing, matrix=value.reshape(3, 3))
    scatter = told.scatter(mixing.matrix) * np.eye(9)
    full = Gradiometer("matrix", mixing, covariance + scatter, value, covariance, noise.covariance)
    made = {form: full if form == full.form else as_form(full, told, form, prior, body) for form in forms}
    unseen = _unseen(full, told, body) + _between_scales(full, every, cells, noise, prior)
    return {form: replace(one, covariance=one.covariance + unseen) for form, one in made.items()}


def _unseen(full: Gradiometer, told: Moments, body: Body | None) -> Floats:
    """Return the units' spread that no regression shows, as a covariance of the matrix's elements; (9, 9).

    A matrix fits three units with directions of their own. What more of them make beside it is uncorrelated
    with the difference as a whole, like ambient field: only geometry tells how large it may be.
    """
    if len(_held_directions(told, full.noise)) < 3:
        return np.zeros((9, 9))
    if body is None:
        return _UNSEEN * spread_at(full.matrix)
    return np.asarray(_UNSEEN * np.cov(body.matrices.reshape(-1, 9).T))


def _between_scales(
    full: Gradiometer, every: Cells, cells: Cells, noise: Noise, prior: tuple[Floats, Floats]
) -> Floats:
    """Return what matrices of single bands of scale scatter by, as a covariance of its elements; (9, 9).

    The matrix is that of the units whose scales the ambient field leaves alone; those that change slowly may
    stand elsewhere. Each band's own matrix tells so, beyond its error, where that is small enough; bands
    count as the difference has power in them. A variance of every element makes three times as much power.
    """
    scatter = total = 0.0
    scales = np.unique(cells.scale)
    for band in np.array_split(scales, max(len(scales) // _BAND, 1)):
        here = every.part(np.isin(every.scale, band))
        share = np.unique(here.scale).size * here.count / here.count.sum() / (2.0 * here.scale)
        power = np.einsum("c,cij->ij", share, here.covariance[:, 3:, 3:])
        own = moments_of(cells.part(np.isin(cells.scale, band)), full.mixing, noise)
        value, covariance = own.solve(ELEMENTS, prior)
        away = (value - full.matrix.ravel()).reshape(3, 3)
        found = float(np.einsum("ki,ij,kj->", away, power, away))
        stated = float(np.einsum("kikj,ij->", covariance.reshape(3, 3, 3, 3), power))
        scatter += max(found - stated, 0.0)
        total += float(np.trace(power))
    return np.asarray(scatter / (3.0 * max(total, 1e-300)) * np.eye(9))


def as_form(
    full: Gradiometer, told: Moments, form: str, prior: tuple[Floats, Floats], body: Body | None = None
) -> Gradiometer:
    """Return another form of a fitted full matrix, from the moments it was fitted to."""
    if form == "dipole" and body is not None:
        return _as_dipole(full, told, body)
    facts: dict[str, float | list[float]] = {}
    if form == "principal":
        directions = _held_directions(told, full.noise)
        basis = np.einsum("ki,rj->krij", np.eye(3), directions).reshape(-1, 3, 3)
        facts = {"directions": float(len(directions))}
    elif form == "ratio":
        basis = np.eye(3)[None]
    else:
        basis = np.einsum("ki,kj->kij", np.eye(3), np.eye(3))
    value, covariance = told.solve(basis, prior)
    if form == "ratio":
        # stray = k / (1 - k) d
        sigma = float(np.sqrt(covariance[0, 0])) / (1.0 + float(value[0])) ** 2
        facts = {"ratio": float(value[0] / (1.0 + value[0])), "sigma": sigma}
    return _with_matrix(
        full, told, form, np.einsum("p,pij->ij", value, basis), (basis, value, covariance), facts
    )


def _with_matrix(
    full: Gradiometer,
    told: Moments,
    form: str,
    matrix: Floats,
    fitted: tuple[Floats, Floats, Floats],
    facts: dict[str, float | list[float]],
) -> Gradiometer:
    basis, value, covariance = fitted
    flat = basis.reshape(len(basis), 9)
    return Gradiometer(
        form,
        replace(full.mixing, matrix=matrix),
        flat.T @ covariance @ flat + told.scatter(matrix) * np.eye(9),
        value,
        covariance,
        full.noise,
        facts,
    )


def _held_directions(told: Moments, noise: Floats) -> Floats:
    """Return the fewest principal directions that hold nearly all of the difference's weighted variance."""
    square = told.square.sum(axis=(0, 1))
    directions = principal_directions(square, noise)
    power = np.einsum("ri,ij,rj->r", directions, square, directions)
    held = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return directions[: int(np.searchsorted(held, _HELD)) + 1]


def _as_dipole(full: Gradiometer, told: Moments, body: Body) -> Gradiometer:
    place, slope = fit_place(body, told.whitened(full.matrix, told.excess(full.matrix)))
    matrix = dipole_matrix(body.positions, place)
    at_place = told.whitened(matrix, told.excess(matrix))
    design = np.einsum("kij,pkj->pki", at_place.design, slope).reshape(3, 9)
    covariance = np.linalg.inv(design @ design.T + np.diag(body.spread**-2))
    sigma = np.sqrt(np.diag(covariance))
    facts: dict[str, float | list[float]] = {"place_m": place.tolist(), "sigma_m": sigma.tolist()}
    return _with_matrix(full, told, "dipole", matrix, (slope, place, covariance), facts)
