"""Gradiometers: the outboard sensor's stray field as a matrix times the difference of both sensors.

Takes readings in which the spacecraft's field changes; makes a `Gradiometer` of one of five forms, its
correction of readings with an error, and its variables of a table.

A dipole on the boom's axis makes ``k`` times its inboard field at the outboard sensor, so that the ambient
field is ``B = (B_out - k B_in) / (1 - k)`` and the stray field at the outboard sensor ``k / (1 - k) d`` with
``d = B_in - B_out`` (Ness et al. 1971). Units off the axis have other factors: in general the stray field is
a matrix times ``d``. Its forms are one ratio, one for each axis, the strongest directions of ``d``
(`principal`), the matrix of a dipole whose place is fitted, and the full matrix. The principal directions are
those of Constantinescu et al. (2020), here of weighted contrasts with the sensors' white noise taken out.

What of ``d`` is ambient field, let in by sensors that are not aligned or scaled alike, is fitted with the
matrix (`mixing`) and subtracted before: otherwise the field that is measured would be changed in proportion
to itself. The matrix takes the noise of ``d`` to the outboard sensor, too. `wiener_shrink` therefore divides
the difference into bands of time scale and keeps of each, locally, as much as exceeds the noise (James and
Stein's ``1 - c N / P``): a step keeps its edge, a quiet hour adds no noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.correction import UNKNOWN, Correction
from inflight.dual.geometry import (
    Body,
    dipole_matrix,
    fit_place,
    matrices_of_any_boom,
    matrix_prior,
    matrix_spread,
)
from inflight.dual.mixing import (
    ELEMENTS,
    DifferenceNoise,
    Mixing,
    SecondMoments,
    difference_noise,
    fit_mixing,
    second_moments,
    usable_cells,
)
from inflight.dual.noise import noise_floor
from inflight.dual.readings import Cells, Readings, cells_of
from inflight.errors import CalibrationError, SettingsError

#: Forms of the matrix, from the fewest parameters to the most.
FORMS = ("ratio", "axes", "dipole", "principal", "matrix")


@dataclass(frozen=True, kw_only=True)
class GradiometerSettings:
    """Numbers of the fit of a gradiometer.

    Attributes
    ----------
    leak_sigma : float
        Prior standard deviation of an element of the leak. Assumed: one per cent is a poor calibration.
    fewest_samples : int
        Good samples that a fit needs. Assumed.
    hidden_share : float
        Part of the units' spread that one matrix leaves and no regression shows, where all three axes of the
        difference are in use. Derived: six units are taken for usual, of which a matrix fits three
        (tests/dual/test_hard_cases.py).
    band_scales : int
        Scales, an octave each, of a band whose own matrix is compared. Assumed.
    held_variance : float
        Part of the weighted variance of the difference that the principal directions hold. Assumed.
    """

    leak_sigma: float = 0.01
    fewest_samples: int = 256
    hidden_share: float = 0.5
    band_scales: int = 2
    held_variance: float = 0.99


@dataclass(frozen=True, kw_only=True)
class ShrinkSettings:
    """Numbers of the shrinkage of the difference's noise.

    Attributes
    ----------
    least_power : float
        Power over that of the noise below which nothing is kept of a band: c of James and Stein's rule.
        Assumed.
    stretch : int
        A band's power is a mean over so many of its own lengths. Assumed.
    slowest : int
        The slowest band is of this part of the record; what is slower is kept: one eighth. Assumed.
    """

    least_power: float = 2.0
    stretch: int = 4
    slowest: int = 8


GRADIOMETER_SETTINGS = GradiometerSettings()
SHRINK_SETTINGS = ShrinkSettings()


@dataclass(frozen=True, kw_only=True)
class Gradiometer:
    """A fitted gradiometer: ``stray at the outboard sensor = matrix e``, ``e = d - leak B``.

    Attributes
    ----------
    form : str
        One of `FORMS`.
    mixing : Mixing
        The matrix in this form, and the leak.
    covariance : ndarray, shape (9, 9)
        Of the elements of the matrix, row by row: of the mean over units and of their scatter, as the
        regression shows it and as geometry predicts it.
    value, value_covariance : ndarray, shape (parameter,), (parameter, parameter)
        The parameters of the form.
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
    leak_sigma: float = GRADIOMETER_SETTINGS.leak_sigma,
) -> Gradiometer:
    """Fit a gradiometer of one form; as `fit_forms`."""
    return fit_forms(readings, (form,), body, leak_sigma)[form]


def fit_forms(
    readings: Readings,
    forms: Sequence[str] = FORMS,
    body: Body | None = None,
    leak_sigma: float = GRADIOMETER_SETTINGS.leak_sigma,
) -> dict[str, Gradiometer]:
    """Fit gradiometers to readings in which the spacecraft's field changes.

    Parameters
    ----------
    readings : Readings
    forms : sequence of str
        Of `FORMS`.
    body : Body, optional
        Where sensors and units are, spacecraft axes. Where given, it is the prior of every form; ``dipole``
        needs it.
    leak_sigma : float
        Prior standard deviation of the elements of the leak: how well the two sensors are aligned
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
    if good.sum() < GRADIOMETER_SETTINGS.fewest_samples:
        raise CalibrationError(
            f"{good.sum()} samples with both sensors found, "
            f"at least {GRADIOMETER_SETTINGS.fewest_samples} needed",
            remedy="take a longer span",
        )
    all_cells = cells_of(readings.outboard[good], readings.difference[good])
    floor = noise_floor(all_cells, readings.difference[good], readings.noise)
    noise = difference_noise(all_cells, floor, leak_sigma)
    cells = usable_cells(all_cells, noise)
    prior = matrix_prior(matrices_of_any_boom() if body is None else body.matrices)
    mixing = fit_mixing(cells, noise, prior, leak_sigma)
    moments = second_moments(cells, mixing, noise)
    value, covariance = moments.solve(ELEMENTS, prior)
    mixing = replace(mixing, matrix=value.reshape(3, 3))
    full = Gradiometer(
        form="matrix",
        mixing=mixing,
        covariance=covariance + moments.scatter(mixing.matrix) * np.eye(9),
        value=value,
        value_covariance=covariance,
        noise=noise.covariance,
    )
    hidden = _hidden_spread(full, moments, body) + _between_scales(full, all_cells, cells, noise, prior)
    found = {}
    for form in forms:
        fitted = full if form == full.form else as_form(full, moments, form, prior, body)
        found[form] = replace(fitted, covariance=fitted.covariance + hidden)
    return found


def _hidden_spread(full: Gradiometer, moments: SecondMoments, body: Body | None) -> Floats:
    """Return the units' spread that no regression shows, as a covariance of the matrix's elements; (9, 9).

    A matrix fits three units with directions of their own. What more of them make in addition is uncorrelated
    with the difference as a whole, like ambient field: only geometry bounds it.
    """
    if len(_held_directions(moments, full.noise)) < 3:
        return np.zeros((9, 9))
    if body is None:
        return GRADIOMETER_SETTINGS.hidden_share * matrix_spread(full.matrix)
    return np.asarray(GRADIOMETER_SETTINGS.hidden_share * np.cov(body.matrices.reshape(-1, 9).T))


def _between_scales(
    full: Gradiometer, all_cells: Cells, cells: Cells, noise: DifferenceNoise, prior: tuple[Floats, Floats]
) -> Floats:
    """Return the scatter of matrices of single bands of scale, as a covariance of its elements; (9, 9).

    The matrix is that of the units on whose scales the ambient field is quiet; those that change slowly may
    stand elsewhere. Each band's own matrix shows it, beyond its error; bands count as the difference has
    power in them. A variance of every element makes three times as much power.
    """
    scatter = total = 0.0
    scales = np.unique(cells.scale)
    for band in np.array_split(scales, max(len(scales) // GRADIOMETER_SETTINGS.band_scales, 1)):
        here = all_cells.select(np.isin(all_cells.scale, band))
        share = np.unique(here.scale).size * here.count / here.count.sum() / (2.0 * here.scale)
        power = np.einsum("c,cij->ij", share, here.covariance[:, 3:, 3:])
        own = second_moments(cells.select(np.isin(cells.scale, band)), full.mixing, noise)
        value, covariance = own.solve(ELEMENTS, prior)
        away = (value - full.matrix.ravel()).reshape(3, 3)
        found = float(np.einsum("ki,ij,kj->", away, power, away))
        stated = float(np.einsum("kikj,ij->", covariance.reshape(3, 3, 3, 3), power))
        scatter += max(found - stated, 0.0)
        total += float(np.trace(power))
    return np.asarray(scatter / (3.0 * max(total, 1e-300)) * np.eye(9))


def as_form(
    full: Gradiometer,
    moments: SecondMoments,
    form: str,
    prior: tuple[Floats, Floats],
    body: Body | None = None,
) -> Gradiometer:
    """Return another form of a fitted full matrix, from the moments it was fitted to.

    That of a dipole is the matrix at the place that fits best; its slope is linearised there.
    """
    facts: dict[str, float | list[float]] = {}
    if form == "dipole" and body is not None:
        value, basis = fit_place(body, moments.whitened(full.matrix, moments.excess(full.matrix)))
        matrix = dipole_matrix(body.positions, value)
        at_place = moments.whitened(matrix, moments.excess(matrix))
        design = np.einsum("kij,pkj->pki", at_place.design, basis).reshape(3, 9)
        covariance = np.linalg.inv(design @ design.T + np.diag(body.spread**-2))
        facts = {"place_m": value.tolist(), "sigma_m": np.sqrt(np.diag(covariance)).tolist()}
        return _with_matrix(full, moments, form, matrix, (basis, value, covariance), facts)
    if form == "principal":
        directions = _held_directions(moments, full.noise)
        basis = np.einsum("ki,rj->krij", np.eye(3), directions).reshape(-1, 3, 3)
        facts = {"directions": float(len(directions))}
    elif form == "ratio":
        basis = np.eye(3)[None]
    else:
        basis = np.einsum("ki,kj->kij", np.eye(3), np.eye(3))
    value, covariance = moments.solve(basis, prior)
    if form == "ratio":
        # stray = k / (1 - k) d
        sigma = float(np.sqrt(covariance[0, 0])) / (1.0 + float(value[0])) ** 2
        facts = {"ratio": float(value[0] / (1.0 + value[0])), "sigma": sigma}
    matrix = np.einsum("p,pij->ij", value, basis)
    return _with_matrix(full, moments, form, matrix, (basis, value, covariance), facts)


def _with_matrix(
    full: Gradiometer,
    moments: SecondMoments,
    form: str,
    matrix: Floats,
    fitted: tuple[Floats, Floats, Floats],
    facts: dict[str, float | list[float]],
) -> Gradiometer:
    """Return a form by its matrix and `fitted`: basis or slope, value and covariance of its parameters."""
    basis, value, covariance = fitted
    flat = basis.reshape(len(basis), 9)
    return Gradiometer(
        form=form,
        mixing=replace(full.mixing, matrix=matrix),
        covariance=flat.T @ covariance @ flat + moments.scatter(matrix) * np.eye(9),
        value=value,
        value_covariance=covariance,
        noise=full.noise,
        facts=facts,
    )


def _held_directions(moments: SecondMoments, noise: Floats) -> Floats:
    """Return the fewest principal directions that hold nearly all of the difference's weighted variance."""
    square = moments.square.sum(axis=(0, 1))
    directions = principal_directions(square, noise)
    power = np.einsum("ri,ij,rj->r", directions, square, directions)
    held = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return directions[: int(np.searchsorted(held, GRADIOMETER_SETTINGS.held_variance)) + 1]


def principal_directions(square: Floats, noise: Floats) -> Floats:
    """Return the directions of the difference in the order of their variance over that of the noise.

    Parameters
    ----------
    square : ndarray, shape (3, 3)
        Sum of squares of the difference, its noise taken out.
    noise : ndarray, shape (3, 3)
        Covariance of the difference's noise, nT^2.

    Returns
    -------
    ndarray, shape (3, 3)
        Row r is what the difference is projected on for source r. Projections on different rows are
        uncorrelated in stray field and in noise.
    """
    level = np.trace(noise) / 3.0
    root = np.linalg.cholesky(noise + 1e-6 * max(level, 1e-12) * np.eye(3))
    inverse = np.linalg.inv(root)
    whitened = inverse @ square @ inverse.T
    _, vector = np.linalg.eigh(0.5 * (whitened + whitened.T))
    # Projection of the whitened difference: v^T root^-1 d.
    return np.asarray(vector[:, ::-1].T @ inverse)


def correction_by_gradiometer(gradiometer: Gradiometer, readings: Readings) -> Correction:
    """Return the correction of the outboard sensor by a gradiometer, with its error.

    The median of the correction is zero: what is constant in the difference may be offsets of the sensors.

    Parameters
    ----------
    gradiometer : Gradiometer
    readings : Readings
        Other ones than it was fitted to, or the same.
    """
    good = readings.good
    count = len(readings)
    field = np.full((count, 3), np.nan)
    covariance = np.full((count, 3, 3), np.nan)
    if good.any():
        stray = gradiometer.stray(readings)[good]
        kept, variance = wiener_shrink(stray, gradiometer.noise)
        kept -= np.median(kept, axis=0)
        matrix, outboard = gradiometer.matrix, readings.outboard[good]
        field[good] = kept @ matrix.T
        # Noise that was kept, the matrix's error on the difference, and the leak's on the ambient field.
        noise = matrix @ gradiometer.noise @ matrix.T
        error = variance[:, None, None] * noise + covariance_of_product(gradiometer.covariance, kept)
        ambient = outboard - np.median(outboard, axis=0)
        covariance[good] = error + covariance_of_product(gradiometer.leak_effect, ambient)
    return Correction(
        field=field,
        covariance=covariance,
        state=np.full(count, UNKNOWN, dtype=np.int64),
        probability=np.full(count, np.nan),
        flag=np.zeros(count, dtype=np.uint32),
        method="gradiometer",
        reason=f"gradiometer of form '{gradiometer.form}'",
    )


def wiener_shrink(series: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Return a series less what is no more than white noise in each band, and the rest's error.

    Parameters
    ----------
    series : ndarray, shape (time, axis)
        nT, finite.
    noise : ndarray, shape (axis, axis)
        Covariance of its white noise, nT^2.

    Returns
    -------
    kept : ndarray, shape (time, axis)
    variance : ndarray, shape (time,)
        Of the error of `kept`, in units of `noise`.
    """
    # Rows of white noise of size one.
    whiten = np.linalg.pinv(np.linalg.cholesky(noise + 1e-9 * max(float(np.trace(noise)), 1e-18) * np.eye(3)))
    smooth, width = series, 1
    kept, variance = np.zeros_like(series), np.zeros(len(series))
    while 2 * width + 1 <= max(len(series) // SHRINK_SETTINGS.slowest, 1):
        wider = 2 * width + 1
        slower = scipy.ndimage.uniform_filter1d(series, wider, axis=0, mode="nearest")
        band = smooth - slower
        level = 1.0 / width - 1.0 / wider
        power = np.mean((band @ whiten.T) ** 2, axis=1)
        around = (
            scipy.ndimage.uniform_filter1d(
                power, min(SHRINK_SETTINGS.stretch * wider, len(series)), mode="nearest"
            )
            / level
        )
        share = np.clip(1.0 - SHRINK_SETTINGS.least_power / np.maximum(around, 1e-12), 0.0, 1.0)
        kept += share[:, None] * band
        variance += level * (share + (1.0 - share) ** 2 * np.clip(around - 1.0, 0.0, None))
        smooth, width = slower, wider
    return kept + smooth, variance + 1.0 / width


def covariance_of_product(covariance: Floats, vectors: Floats) -> Floats:
    """Return the covariance of a matrix times vectors, from that of its elements.

    Parameters
    ----------
    covariance : ndarray, shape (9, 9)
        Of the elements, row by row.
    vectors : ndarray, shape (time, 3)

    Returns
    -------
    ndarray, shape (time, 3, 3)
    """
    by_element = covariance.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    products = (vectors[:, :, None] * vectors[:, None, :]).reshape(-1, 9)
    return np.asarray(products @ by_element.T).reshape(-1, 3, 3)


#: What the variables' names begin with.
_NAME = "gradiometer_"

_MATRIX, _ELEMENTS = ("axis", "other"), ("element", "other_element")


def gradiometer_to_dataset(gradiometer: Gradiometer, readings: Readings) -> xr.Dataset:
    """Return a gradiometer as variables of a table.

    Parameters
    ----------
    readings : Readings
        Those it was fitted to: their median is where its correction is zero.
    """
    mixing = gradiometer.mixing
    arrays = {
        "matrix": (_MATRIX, mixing.matrix, {"units": "1"}),
        "leak": (_MATRIX, mixing.leak, {"units": "1"}),
        "noise": (_MATRIX, gradiometer.noise, {"units": "nT2"}),
        "leak_covariance": (_ELEMENTS, mixing.leak_covariance, {"units": "1"}),
        "covariance": (_ELEMENTS, gradiometer.covariance, {"units": "1"}),
        "middle": (("axis",), _median_stray(gradiometer, readings), {"units": "nT"}),
    }
    attrs = {f"{_NAME}share": float(mixing.share), f"{_NAME}form": gradiometer.form}
    return xr.Dataset({_NAME + name: one for name, one in arrays.items()}, attrs=attrs)


def has_gradiometer(table: xr.Dataset) -> bool:
    """Return True when a table holds a gradiometer."""
    return f"{_NAME}matrix" in table


def gradiometer_from_dataset(table: xr.Dataset) -> Gradiometer:
    """Return the gradiometer of a table, of form ``matrix``."""
    stored = {
        name: np.asarray(table[_NAME + name].values)
        for name in ("matrix", "leak", "noise", "leak_covariance", "covariance")
    }
    share = float(table.attrs[f"{_NAME}share"])
    return Gradiometer(
        form="matrix",
        mixing=Mixing(stored["matrix"], stored["leak"], stored["leak_covariance"], share),
        covariance=stored["covariance"],
        value=stored["matrix"].ravel(),
        value_covariance=stored["covariance"],
        noise=stored["noise"],
    )


def correction_by_stored_gradiometer(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction of a table's gradiometer; its constant is that of the whole table."""
    gradiometer = gradiometer_from_dataset(table)
    found = correction_by_gradiometer(gradiometer, readings)
    if not readings.good.any():
        return found
    away = _median_stray(gradiometer, readings) - np.asarray(table[f"{_NAME}middle"].values)
    return replace(found, field=found.field + gradiometer.matrix @ away)


def _median_stray(gradiometer: Gradiometer, readings: Readings) -> Floats:
    return np.asarray(np.median(gradiometer.stray(readings)[readings.good], axis=0))
