"""Scalar calibration of one block: exact robust Gauss-Newton on scaled normal equations.

The nine parameters are those of the effect ``vector_sensor``. Everything else the model holds is
taken out of the readings first: `split_chain` gives the reading that enters the sensor's equation,
the additive fields behind it and the corrected scalar field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.calibration.nine import WIDTH, grams, residuals
from inflight.calibration.robust import BIWEIGHT_WIDTH, biweight, robust_sigma
from inflight.calibration.solution import Solution, solve
from inflight.effects.base import Floats
from inflight.effects.vector_sensor import VectorSensor
from inflight.errors import CalibrationError, ModelError
from inflight.flags import Flag
from inflight.model import Model, ModelEffect
from inflight.model.timed import component_names

#: Physical size of one scaled unit: 10 ppm, a thousandth of a degree, 1 nT.
SCALE = np.array([1e-5] * 3 + [1e-3] * 3 + [1.0] * 3)
PARTS = ("scale_factor", "misalignment", "offset")
UNITS = ("1",) * 3 + ("deg",) * 3 + ("nT",) * 3
#: Sub-blocks of a block, for the covariance: 20 minutes of a day.
SUB_BLOCKS = 72
#: Residuals are taken as correlated over this many sub-blocks.
BARTLETT = 3
#: The equations are linearised at the reference itself when the fit bends the residual by more, nT.
BEND = 1e-4
_MAX_PASSES = 25
#: The iteration ends when no parameter moves by more than this part of its sigma.
_SETTLED = 0.05
#: Flags that take a sample out of the fit.
UNUSABLE = Flag.VECTOR_MISSING | Flag.SCALAR_MISSING | Flag.CHANNEL_MISSING | Flag.OUT_OF_RANGE
UNUSABLE |= Flag.INSTRUMENT_FLAG


@dataclass(frozen=True)
class Reference:
    """Where the fit starts and what is known beforehand, physical units; shape (9,) each."""

    value: Floats
    sigma: Floats
    name: str = "vector_sensor"

    @property
    def columns(self) -> list[str]:
        """Names of the nine columns, ``vector_sensor.scale_factor[x]`` and so on."""
        parameters = VectorSensor.parameters()
        return [name for part in PARTS for name in component_names(f"{self.name}.{part}", parameters[part])]


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
        Robustly weighted Gram matrix of [columns | residual], linearised at the fit, its residual
        expressed at the reference; scaled columns, nT^2.
    scatter : ndarray, shape (9, 9)
        Scatter of the sub-blocks' scores.
    count : float
        Sum of the weights.
    used : int
        Samples in the fit.
    weight : ndarray, shape (time,)
        Robust weights, 0 where unused.
    before, after : float
        Robustly weighted rms residual at the reference and at the fit, nT.
    passes : int
        Gauss-Newton passes made.
    """

    value: Floats
    sigma: Floats
    covariance: Floats
    solution: Solution
    gram: Floats
    scatter: Floats
    count: float
    used: int
    weight: Floats
    before: float
    after: float
    passes: int


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


def reference_of(model: Model, tt2000: int) -> Reference:
    """Return values and prior sigmas of the nine parameters at a time; fixed ones get sigma 0."""
    entry = vector_sensor_of(model)
    timed = [entry.parameters[part] for part in PARTS]
    value = np.concatenate([part.at(tt2000) for part in timed])
    sigma = np.concatenate([part.sigma[:, 0] if part.free else np.zeros(3) for part in timed])
    return Reference(value, sigma, entry.name)


def split_chain(model: Model, samples: xr.Dataset) -> tuple[Floats, Floats, Floats]:
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
    times = samples["tt2000"].values
    reading = np.asarray(samples["vector"].values, dtype=np.float64)
    entries = [entry for entry in model.effects if entry.sensor.role == "vector"]
    place = entries.index(own)
    for entry in entries[:place]:
        reading = entry.effect.correct(reading, samples, entry.values(times), entry.sensor)
    corrected = model.correct(samples)
    additive = np.zeros((1, 3))
    for entry in entries[place + 1 :]:
        if not entry.effect.is_additive:
            raise ModelError(
                f"effect '{entry.name}' stands behind '{own.name}' but does not only add a field",
                remedy="list it before the vector_sensor",
            )
        additive = additive + entry.effect.field(corrected, entry.values(times), entry.sensor)
    return reading, additive, np.asarray(corrected["scalar"].values, dtype=np.float64)


def usable(samples: xr.Dataset, reading: Floats, additive: Floats, scalar: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples may enter a fit; (time,)."""
    good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
    finite = np.isfinite(reading.sum(axis=1)) & np.isfinite(scalar) & np.isfinite(additive.sum(axis=1))
    return np.asarray(good & finite & (scalar > 0))


def fit_block(
    reading: Floats,
    additive: Floats,
    scalar: Floats,
    good: npt.NDArray[np.bool_],
    reference: Reference,
    prior: Reference | None = None,
    sub_blocks: int = SUB_BLOCKS,
) -> BlockFit:
    """Fit nine parameters to one block.

    Parameters
    ----------
    reading, additive, scalar : ndarray
        As `split_chain` returns them, nT.
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
    if used <= WIDTH:
        raise CalibrationError(
            f"{used} usable samples for nine parameters", remedy="see the day's coverage and flags"
        )
    e = np.ascontiguousarray(np.where(good[:, None], reading, 1.0))
    s = np.ascontiguousarray(np.where(np.isfinite(additive), additive, 0.0))
    f = np.where(good, scalar, 1.0)
    edges = np.linspace(0, f.size, max(sub_blocks, 1) + 1).astype(np.int64)
    weight = good.astype(np.float64)
    prior = prior or reference
    value, sigma_r = reference.value, 0.0
    for passes in range(1, _MAX_PASSES + 1):
        if passes > 1:
            r = residuals(_theta(value), e, s, f)
            sigma_r = robust_sigma(r[good], floor=1e-6)
            weight = np.where(good, biweight(r, sigma_r), 0.0)
        blocks = grams(_theta(value), e, s, f, weight, _kernel_scale(value), edges)
        found = _settle(blocks, weight, value, prior)
        value = value + found.step * SCALE
        if passes > 1 and np.all(np.abs(found.step) <= _SETTLED * np.maximum(found.solution.sigma, 1e-12)):
            return _finish(found, weight, value, reference, prior, used, passes, sigma_r, e, s, f, good)
    raise CalibrationError(
        f"the fit did not settle in {_MAX_PASSES} passes", remedy="look at the day's residual for faults"
    )


@dataclass(frozen=True)
class _Pass:
    solution: Solution
    step: Floats
    gram: Floats
    scatter: Floats


def _theta(value: Floats) -> Floats:
    """Physical parameters to the kernel's (angles to entries of K)."""
    return np.concatenate([value[:3], np.cos(np.deg2rad(value[3:6])), value[6:]])


def _kernel_scale(value: Floats) -> Floats:
    """Change of the kernel's parameters by one scaled unit."""
    scale = SCALE.copy()
    scale[3:6] *= -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    return scale


def _settle(blocks: Floats, weight: Floats, value: Floats, known: Reference) -> _Pass:
    """Solve one pass; scores of the sub-blocks are taken at its solution."""
    gram = blocks.sum(axis=0)
    prior = (known.value - value) / SCALE
    prior_sigma = known.sigma / SCALE
    count = float(weight.sum())
    still = np.zeros((WIDTH - 1, WIDTH - 1))
    first = solve(gram, still, count, prior, prior_sigma)
    scatter = score_scatter(blocks, first.value, prior_sigma)
    solution = solve(gram, scatter, count, prior, prior_sigma)
    return _Pass(solution, solution.value, gram, scatter)


def score_scatter(blocks: Floats, change: Floats, prior_sigma: Floats) -> Floats:
    """Return the long-run scatter of the sub-blocks' scores after a change; (9, 9), scaled.

    Bartlett's kernel over `BARTLETT` sub-blocks (Newey and West 1987). The scores of a fit sum to
    nearly zero, which makes the plain estimate too small; the factor that makes it right for white
    residuals follows from the sub-blocks' own Gram matrices.
    """
    matrices = blocks[:, :-1, :-1]
    scores = blocks[:, :-1, -1] + matrices @ change
    lag = np.abs(np.subtract.outer(np.arange(len(blocks)), np.arange(len(blocks))))
    kernel = np.maximum(0.0, 1.0 - lag / (BARTLETT + 1.0))
    scatter = scores.T @ kernel @ scores
    total = matrices.sum(axis=0)
    unit = prior_sigma[:, None] * prior_sigma[None, :]
    steadied = np.linalg.pinv(total * unit + np.eye(change.size), hermitian=True) * unit
    smoothed = np.einsum("bc,cij->bij", kernel, matrices)
    absorbed = np.einsum("bij,jk,bkl->il", matrices, steadied, smoothed)
    known = float(np.trace(steadied @ total))
    kept = 1.0 - float(np.trace(steadied @ absorbed)) / known if known > 0 else 1.0
    return np.asarray(scatter / max(kept, 0.1))


def _finish(
    found: _Pass,
    weight: Floats,
    value: Floats,
    reference: Reference,
    prior: Reference,
    used: int,
    passes: int,
    sigma_r: float,
    e: Floats,
    s: Floats,
    f: Floats,
    good: npt.NDArray[np.bool_],
) -> BlockFit:
    """Collect the result; normal equations are expressed at the reference."""
    bread = _bread_ratio(residuals(_theta(value), e, s, f)[good], sigma_r)
    scatter = found.scatter * bread**2
    count = float(weight.sum())
    here = value - found.step * SCALE
    solution = solve(found.gram, scatter, count, (prior.value - here) / SCALE, prior.sigma / SCALE)
    if bend(value, reference.value, float(np.median(f[good]))) > BEND:
        whole = np.array([0, f.size])
        gram = grams(_theta(reference.value), e, s, f, weight, _kernel_scale(reference.value), whole)[0]
    else:
        gram = shift_reference(found.gram, (reference.value - here) / SCALE)
    to_physical = np.outer(SCALE, SCALE)
    covariance = solution.covariance * to_physical
    return BlockFit(
        value,
        np.sqrt(np.diag(covariance)),
        covariance,
        solution,
        gram,
        scatter,
        count,
        used,
        weight,
        before=float(np.sqrt(gram[-1, -1] / count)),
        after=float(np.sqrt(solution.variance)),
        passes=passes,
    )


def _bread_ratio(r: Floats, sigma: float) -> float:
    """Return mean weight over mean slope of the biweight's psi: the sandwich's bread is the slope."""
    u = np.minimum((r / (BIWEIGHT_WIDTH * sigma)) ** 2, 1.0)
    slope = float(np.mean((1.0 - u) * (1.0 - 5.0 * u)))
    return float(np.mean((1.0 - u) ** 2)) / slope if slope > 0.2 else 1.0


def bend(value: Floats, reference: Floats, strength: float) -> float:
    """Return by how much the residual bends between two sets of parameters; nT.

    A change dB of the corrected field across the field's direction lengthens it by dB^2 / 2 B.
    """
    change = np.abs(_theta(value) - _theta(reference))
    across = float(np.hypot(np.linalg.norm(change[:6]) * strength, np.linalg.norm(change[6:])))
    return across**2 / (2.0 * strength)


def shift_reference(gram: Floats, change: Floats) -> Floats:
    """Express the residual column after a scaled change of the parameters: y becomes ``y + X change``."""
    turn = np.eye(gram.shape[0])
    turn[-1, :-1] = change
    return np.asarray(turn @ gram @ turn.T)
