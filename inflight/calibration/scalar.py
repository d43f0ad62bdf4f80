"""Scalar calibration of one block: robust Gauss-Newton for the nine parameters of a vector sensor.

Takes readings of vector and scalar sensor, the reference and prior of the nine; makes a `BlockFit`:
values, covariance and the Gram matrix that later sums are made of.

Residual ``r = |B| - F`` with ``B = K (E - E0) - S`` (Yin 2010, eqs. 2.5, 2.6); S holds the additive
fields corrected after the sensor's equation, see `remove_other_effects`. Its derivatives with respect to the
entries of K are ``e_i (E - E0)_j`` and to E0 ``-K^T e``, with e = B/|B|. The loops of `residual_loops`
work with the nine numbers (K_xx, K_yy, K_zz, K_xy, K_xz, K_yz, E0_x, E0_y, E0_z), everything else with the
parameters of the effect ``vector_sensor``: scale factors, angles (deg), offsets (nT).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats, finite_rows
from inflight.effects import VectorSensor, with_field
from inflight.errors import CalibrationError, ModelError
from inflight.flags import UNUSABLE
from inflight.lsq import (
    BIWEIGHT_RMS_FACTOR,
    BIWEIGHT_WIDTH,
    SOLVER_SETTINGS,
    Solution,
    bartlett_kernel,
    posterior,
    posterior_covariance,
    robust_sigma,
    shift_reference,
    solve,
)
from inflight.model import Model, ModelEffect, at_all_sensors, component_names, correct_plain
from inflight.samples import PlainSamples

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class ScalarSettings:
    """How the iteration of a block's nine parameters goes and ends.

    Attributes
    ----------
    sub_block_s : float
        Seconds of a sub-block of a day: 72 a day; assumed.
    sub_blocks : int
        Sub-blocks of a day, for the covariance: 20 minutes each.
    fewest_sub_blocks : int
        Fewest sub-blocks of a shorter block: more would be too short to show correlation over minutes;
        assumed.
    bartlett : int
        Residuals are taken as correlated over this many sub-blocks; assumed.
    nonlinear_nT : float
        The equations are linearised at the reference itself when the linearisation error of the fit is
        larger, nT; assumed.
    most_passes : int
        Passes at most; assumed.
    edge_pass : int
        A direction at the edge of what the data determine could come and go for ever: from this pass on the
        edge rises; assumed.
    edge_rise : float
        Factor a pass by which it rises, until the direction stays at its prior; assumed.
    settled : float
        The iteration ends when no parameter moves by more than so many of its sigmas: a lengthened step
        leaves a thousandth of itself to the next, also with outliers; measured.
    plain : float
        Data that know every direction so many times better than the prior need no directions; assumed.
    long : int
        Blocks of more samples begin with some of them; assumed.
    thin : int
        They begin with every so manyth sample; assumed.
    scale_samples : int
        Samples that the residual's scale is taken from; assumed.
    """

    sub_block_s: float = 1200.0
    sub_blocks: int = 72
    fewest_sub_blocks: int = 12
    bartlett: int = 3
    nonlinear_nT: float = 1e-4  # noqa: N815 (a unit)
    most_passes: int = 25
    edge_pass: int = 5
    edge_rise: float = 1.5
    settled: float = 10.0
    plain: float = 1e3
    long: int = 20_000
    thin: int = 8
    scale_samples: int = 10_000


SCALAR_SETTINGS = ScalarSettings()

#: Physical size of one scaled unit: 10 ppm, a thousandth of a degree, 1 nT.
PARAMETER_SCALE = np.array([1e-5] * 3 + [1e-3] * 3 + [1.0] * 3)

PARAMETER_GROUPS = ("scale_factor", "misalignment", "offset")

PARAMETER_UNITS = ("1",) * 3 + ("deg",) * 3 + ("nT",) * 3


@dataclass(frozen=True)
class ParameterPrior:
    """Where the fit starts and what is known beforehand, physical units; shape (9,) each."""

    value: Floats
    sigma: Floats
    name: str = "vector_sensor"

    @property
    def columns(self) -> list[str]:
        """Names of the nine columns, ``vector_sensor.scale_factor[x]`` and so on."""
        parameters = VectorSensor.parameters()
        return [
            name
            for part in PARAMETER_GROUPS
            for name in component_names(f"{self.name}.{part}", parameters[part])
        ]


def vector_sensor_of(model: Model) -> ModelEffect:
    """Return the model's nine-parameter effect.

    Raises
    ------
    ModelError
        When the model has none, or more than one.
    """
    found = [entry for entry in model.effects if isinstance(entry.effect, VectorSensor)]
    if len(found) != 1:
        raise ModelError(
            f"model '{model.name}' has {len(found)} effects 'vector_sensor', a scalar calibration needs one",
            remedy="add one to the model YAML",
        )
    return found[0]


def reference_of(model: Model, tt2000: int) -> ParameterPrior:
    """Return values and prior sigmas of the nine parameters at a time; those no block fits get sigma 0.

    A parameter that is free but constant, or a function of time, is refined over the whole span (see
    `inflight.diagnosis`); a block's own fit keeps it.

    Raises
    ------
    ModelError
        When a block's own parameter has an infinite sigma.
    """
    entry = vector_sensor_of(model)
    timed = [entry.parameters[part] for part in PARAMETER_GROUPS]
    own = [part.free and part.time == "block" for part in timed]
    for part, is_own in zip(timed, own, strict=True):
        if is_own and not np.all(np.isfinite(part.sigma)):
            raise ModelError(
                f"'{part.key}' is fitted once a block and its sigma is {part.sigma[:, 0].tolist()}",
                remedy="give a finite sigma, however wide",
            )
    value = np.concatenate([part.at(tt2000) for part in timed])
    sigma = np.concatenate(
        [part.sigma[:, 0] if is_own else np.zeros(3) for part, is_own in zip(timed, own, strict=True)]
    )
    return ParameterPrior(value, sigma, entry.name)


def remove_other_effects(model: Model, samples: xr.Dataset) -> tuple[Floats, Floats, Floats]:
    """Take everything but the nine parameters out of the readings.

    Returns
    -------
    reading : ndarray, shape (time, 3)
        What enters the sensor's equation, nT.
    additive : ndarray, shape (time, 3) or (1, 3)
        Fields to be subtracted behind it, nT, orthogonal sensor axes.
    scalar : ndarray, shape (time,)
        Corrected scalar field at the reference parameters, nT.

    Raises
    ------
    ModelError
        When an effect behind ``vector_sensor`` is not additive.
    """
    own = vector_sensor_of(model)
    known = PlainSamples.of(samples)
    light, times = cast("xr.Dataset", known), known["tt2000"].values
    reading = sensor_reading(model, samples)
    additive = np.zeros((1, 3))
    acting = at_all_sensors(model.effects)
    entries = [entry for entry in acting if entry.sensor.role == "vector"]
    for entry in entries[entries.index(own) + 1 :]:
        if not entry.effect.is_additive:
            raise ModelError(
                f"effect '{entry.name}' stands behind '{own.name}' but does not only add a field",
                remedy="list it before the vector_sensor",
            )
        additive = additive + entry.effect.field(light, entry.values(times), entry.sensor)
    field = own.effect.correct(reading, light, own.values(times), own.sensor) - additive
    # With the field given, and no vector reading to make it from, only the scalar sensor is corrected.
    seen = with_field(cast("xr.Dataset", known.drop_vars(["vector"])), field)
    scalar = correct_plain(
        [entry for entry in acting if entry.sensor.role == "scalar"], cast("PlainSamples", seen)
    )
    return reading, additive, np.asarray(scalar["scalar"].values, dtype=np.float64)


def sensor_reading(model: Model, samples: xr.Dataset) -> Floats:
    """Return what enters the equation of the model's vector sensor; (time, 3) nT."""
    own = vector_sensor_of(model)
    known = PlainSamples.of(samples)
    light, times = cast("xr.Dataset", known), known["tt2000"].values
    reading = np.asarray(known["vector"].values, dtype=np.float64)
    entries = [entry for entry in at_all_sensors(model.effects) if entry.sensor.role == "vector"]
    for entry in entries[: entries.index(own)]:
        reading = entry.effect.correct(reading, light, entry.values(times), entry.sensor)
    return reading


def usable_samples(
    samples: xr.Dataset, reading: Floats, additive: Floats, scalar: Floats
) -> npt.NDArray[np.bool_]:
    """Return which samples may enter a fit; (time,)."""
    good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
    finite = finite_rows(reading) & np.isfinite(scalar) & finite_rows(additive)
    return np.asarray(good & finite & (scalar > 0))


def matrix_parameters(value: Floats) -> Floats:
    """Return the kernel's parameters (9,) of physical ones (9,): angles in degrees become entries of K."""
    return np.concatenate([value[:3], np.cos(np.deg2rad(value[3:6])), value[6:]])


def kernel_scale(value: Floats) -> Floats:
    """Return the change of the kernel's parameters (9,) by one scaled unit, at physical ones (9,)."""
    scale = PARAMETER_SCALE.copy()
    scale[3:6] *= -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    return scale


def linearisation_error(value: Floats, reference: Floats, strength: float) -> float:
    """Return the linearisation error of the residual between two sets of parameters; nT.

    A change dB of the corrected field across the field's direction lengthens it by dB^2 / 2 B; a
    change of all scale factors alike is along the field and has none.

    Parameters
    ----------
    value, reference : ndarray, shape (9,)
        Physical units.
    strength : float
        Field strength, nT.
    """
    change = matrix_parameters(value) - matrix_parameters(reference)
    change[:3] -= change[:3].mean()
    across = float(np.hypot(np.linalg.norm(change[:6]) * strength, np.linalg.norm(change[6:])))
    return across**2 / (2.0 * strength)


@dataclass(frozen=True)
class BlockFit:
    """One block's fit and the normal equations it leaves behind.

    Attributes
    ----------
    value, sigma : ndarray, shape (9,)
        Scale factors (1), misalignment angles (deg), offsets (nT).
    covariance : ndarray, shape (9, 9)
        Physical units.
    solution : Solution
        The same, scaled, with what is determined.
    gram : ndarray, shape (10, 10)
        Robustly weighted Gram matrix of [columns | residual], its residual expressed at the
        reference; scaled columns, nT^2.
    scatter : ndarray, shape (9, 9)
        Scatter of the sub-blocks' scores.
    linearised_at : ndarray, shape (9,)
        Where the rows were linearised, physical units.
    count : float
        Sum of the weights.
    used : int
        Samples in the fit.
    sigma_residual : float
        Robust standard deviation the weights were made with, nT.
    before, after : float
        Rms residual at the reference (robustly weighted) and at the fit (as if Gaussian), nT.
    passes : int
        Gauss-Newton passes made.
    """

    value: Floats
    sigma: Floats
    covariance: Floats
    solution: Solution
    gram: Floats
    scatter: Floats
    linearised_at: Floats
    count: float
    used: int
    sigma_residual: float
    before: float
    after: float
    passes: int


def sub_block_count(seconds: float) -> int:
    """Return into how many sub-blocks so many seconds of used samples are cut: one for 20 minutes."""
    return int(
        np.clip(
            seconds / SCALAR_SETTINGS.sub_block_s,
            SCALAR_SETTINGS.fewest_sub_blocks,
            SCALAR_SETTINGS.sub_blocks,
        )
    )


def fit_block(
    reading: Floats,
    additive: Floats,
    scalar: Floats,
    good: npt.NDArray[np.bool_],
    reference: ParameterPrior,
    prior: ParameterPrior | None = None,
    sub_blocks: int = SCALAR_SETTINGS.sub_blocks,
) -> BlockFit:
    """Fit nine parameters to one block.

    Parameters
    ----------
    reading, additive, scalar : ndarray
        As `remove_other_effects` returns them, nT.
    good : ndarray of bool, shape (time,)
        Samples to use.
    reference : Reference
        Start of the iteration, and what the normal equations are expressed at.
    prior : Reference, optional
        What is known beforehand; the reference when absent.
    sub_blocks : int
        Number of spans whose scores are independent, for the covariance.

    Raises
    ------
    CalibrationError
        When fewer samples are usable than parameters, or the iteration does not settle.
    """
    used = int(good.sum())
    if used <= PARAMETER_SCALE.size + 1:
        raise CalibrationError(
            f"{used} usable samples for nine parameters", remedy="see the day's coverage and flags"
        )
    prior = prior or reference
    data = _Data.of(reading, additive, scalar, good, sub_blocks)
    value, passes = reference.value, 0
    for part in (data.thinned(), data):
        for step in range(SCALAR_SETTINGS.most_passes):
            least = SOLVER_SETTINGS.min_information * SCALAR_SETTINGS.edge_rise ** max(
                0, step - SCALAR_SETTINGS.edge_pass
            )
            found = _gauss_newton_pass(part, value, prior, passes > 0, least)
            before, value, passes = value, found.value, passes + 1
            largest = SCALAR_SETTINGS.settled * np.maximum(found.sigma, 1e-12 * PARAMETER_SCALE)
            settled = passes > 1 and np.all(np.abs(value - before) <= largest)
            if settled and linearisation_error(value, before, data.strength) <= SCALAR_SETTINGS.nonlinear_nT:
                break
        else:
            raise CalibrationError(
                f"the fit did not settle in {passes} passes", remedy="look at the day's residual for faults"
            )
    return _block_fit(found, data, reference, prior, used, passes)


def empty_block(reference: ParameterPrior, prior: ParameterPrior) -> BlockFit:
    """Return the fit of a block without data: every parameter stays at its prior, and the sums are 0."""
    nan, parameters = float("nan"), prior.value.size
    gram, scatter = np.zeros((parameters + 1, parameters + 1)), np.zeros((parameters, parameters))
    centre, spread = (prior.value - reference.value) / PARAMETER_SCALE, prior.sigma / PARAMETER_SCALE
    return BlockFit(
        prior.value,
        prior.sigma,
        np.diag(prior.sigma**2),
        solve(gram, scatter, 0.0, centre, spread),
        gram,
        scatter,
        reference.value,
        count=0.0,
        used=0,
        sigma_residual=nan,
        before=nan,
        after=nan,
        passes=0,
    )


@dataclass(frozen=True)
class _Data:
    """The usable samples of a block, without holes, and the sub-blocks they fall in."""

    e: Floats
    s: Floats
    f: Floats
    edges: npt.NDArray[np.int64]
    strength: float

    @classmethod
    def of(
        cls, reading: Floats, additive: Floats, scalar: Floats, good: npt.NDArray[np.bool_], sub_blocks: int
    ) -> _Data:
        from inflight.calibration.residual_loops import compress

        # Cut by used samples, not by rows: hours of gaps are no sub-blocks.
        edges = np.linspace(0, int(good.sum()), max(sub_blocks, 1) + 1).astype(np.int64)
        many = np.ascontiguousarray(additive, dtype=np.float64)
        e, f = np.ascontiguousarray(reading), np.ascontiguousarray(scalar)
        if good.all():
            return cls(e, many, f, edges, float(np.median(f[::64])))
        e, many, f = compress(e, many, f, good)
        return cls(e, many, f, edges, float(np.median(f[::64])))

    def thinned(self) -> _Data:
        """Every eighth sample of a long block: it brings the fit near its end at an eighth of the cost."""
        if self.f.size < SCALAR_SETTINGS.long:
            return self
        s = self.s[:: SCALAR_SETTINGS.thin] if self.s.shape[0] > 1 else self.s
        e, f = self.e[:: SCALAR_SETTINGS.thin], self.f[:: SCALAR_SETTINGS.thin]
        return _Data(
            np.ascontiguousarray(e),
            np.ascontiguousarray(s),
            np.ascontiguousarray(f),
            -(-self.edges // SCALAR_SETTINGS.thin),
            self.strength,
        )

    def sigma(self, value: Floats) -> float:
        """Robust standard deviation of the residual, from some evenly spread samples; nT."""
        from inflight.calibration.residual_loops import residuals

        step = max(1, self.f.size // SCALAR_SETTINGS.scale_samples)
        s = self.s[::step] if self.s.shape[0] > 1 else self.s
        residual = residuals(matrix_parameters(value), self.e[::step], s, self.f[::step])
        return robust_sigma(residual, floor=1e-6)


@dataclass(frozen=True)
class _Pass:
    """One Gauss-Newton pass: where it was linearised, where it leads, and its equations."""

    here: Floats
    value: Floats
    sigma: Floats
    blocks: Floats
    count: float
    bread: float
    sigma_residual: float


def _gauss_newton_pass(
    data: _Data, value: Floats, prior: ParameterPrior, weighted: bool, edge: float
) -> _Pass:
    """Make one pass.

    The step is lengthened by `bread`, the ratio of the weights to their slope: weights follow the
    residual, so that a plain step with fixed weights falls short by a tenth.
    """
    from inflight.calibration.residual_loops import grams

    sigma = data.sigma(value) if weighted else float("inf")
    blocks, count, slopes = grams(
        matrix_parameters(value),
        data.e,
        data.s,
        data.f,
        BIWEIGHT_WIDTH * sigma,
        kernel_scale(value),
        data.edges,
    )
    bread = count / slopes if slopes > 0.2 * count else 1.0
    gram = blocks.sum(axis=0)
    centre, spread = (prior.value - value) / PARAMETER_SCALE, prior.sigma / PARAMETER_SCALE
    step, covariance, least = posterior(gram, count, centre, spread)
    if least < SCALAR_SETTINGS.plain:
        # Weak directions need their true weight, or the iteration moves along them without end.
        solution = solve(gram, score_scatter(blocks, step, spread), count, centre, spread, edge)
        step, covariance, bread = solution.value, solution.covariance, 1.0
    sigmas = np.sqrt(np.diag(covariance)) * PARAMETER_SCALE
    return _Pass(value, value + step * bread * PARAMETER_SCALE, sigmas, blocks, count, bread, sigma)


def score_scatter(blocks: Floats, change: Floats, prior_sigma: Floats) -> Floats:
    """Return the long-run scatter of the sub-blocks' scores after a change; (9, 9), scaled.

    Bartlett's kernel over `ScalarSettings.bartlett` sub-blocks (Newey and West 1987). The scores of a fit
    sum to nearly zero, which makes the plain estimate too small; the factor that makes it right for white
    residuals follows from the sub-blocks' own Gram matrices.
    """
    matrices = blocks[:, :-1, :-1]
    scores = blocks[:, :-1, -1] + matrices @ change
    kernel = bartlett_kernel(len(blocks), SCALAR_SETTINGS.bartlett)
    scatter = scores.T @ kernel @ scores
    total = matrices.sum(axis=0)
    covariance = posterior_covariance(total, prior_sigma)
    # What each pair of sub-blocks shares through the fitted parameters, summed with the kernel.
    leverage = covariance @ matrices
    flat = leverage.reshape(len(blocks), -1)
    lost = float(np.sum(kernel * (flat @ leverage.transpose(0, 2, 1).reshape(len(blocks), -1).T)))
    known = float(np.trace(covariance @ total))
    kept = 1.0 - lost / known if known > 0 else 1.0
    return np.asarray(scatter / max(kept, 0.1))


def _block_fit(
    found: _Pass, data: _Data, reference: ParameterPrior, prior: ParameterPrior, used: int, passes: int
) -> BlockFit:
    """Solve the last pass with the scatter of its scores; express its equations at the reference."""
    gram = found.blocks.sum(axis=0)
    centre, spread = (prior.value - found.here) / PARAMETER_SCALE, prior.sigma / PARAMETER_SCALE
    near, _, _ = posterior(gram, found.count, centre, spread)
    scatter = score_scatter(found.blocks, near, spread) * found.bread**2
    solution = solve(gram, scatter, found.count, centre, spread)
    value = found.here + (solution.value + (found.bread - 1.0) * near) * PARAMETER_SCALE
    value = np.where(solution.moved, value, prior.value)
    # Fits that determine every parameter lie close together, so that their own linearisations agree;
    # others move far along what they do not determine, and need a common one.
    determined = bool(np.all(solution.determined | (prior.sigma <= 0)))
    error = linearisation_error(value, reference.value, data.strength)
    if determined or error <= SCALAR_SETTINGS.nonlinear_nT:
        gram = shift_reference(gram, (reference.value - found.here) / PARAMETER_SCALE)
        linearised_at = found.here
    else:
        from inflight.calibration.residual_loops import gram_at, residuals

        # With the weights of the last pass.
        r = residuals(matrix_parameters(found.here), data.e, data.s, data.f)
        root = np.maximum(1.0 - (r / (BIWEIGHT_WIDTH * found.sigma_residual)) ** 2, 0.0)
        theta, scale = matrix_parameters(reference.value), kernel_scale(reference.value)
        gram = np.asarray(gram_at(theta, data.e, data.s, data.f, root, scale))
        linearised_at = reference.value
    covariance = solution.covariance * np.outer(PARAMETER_SCALE, PARAMETER_SCALE)
    return BlockFit(
        value,
        np.sqrt(np.diag(covariance)),
        covariance,
        solution,
        gram,
        scatter,
        linearised_at,
        found.count,
        used,
        found.sigma_residual,
        before=float(np.sqrt(gram[-1, -1] / found.count)),
        after=float(np.sqrt(solution.variance)) / BIWEIGHT_RMS_FACTOR,
        passes=passes,
    )
