"""What the two sensors read: the true field through every cause, the nine parameters, noise, outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .causes import Cause, World
from .response import ornstein

#: Step of the delivered readings, nT.
RESOLUTION = 0.001


@dataclass(frozen=True)
class Nine:
    """Scale factors and upper triangle of K, offsets: ``B = K (E - E0)`` (Yin 2010, eq. 2.5)."""

    scale_factor: np.ndarray
    misalignment: np.ndarray
    offset: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Nine:
        """Return parameters as real sensors have them."""
        return cls(1 + rng.normal(0, 2e-3, 3), 90 + rng.normal(0, 0.04, 3), rng.normal(0, 20.0, 3))

    def matrix(self) -> np.ndarray:
        """Return K, (3, 3)."""
        c = np.cos(np.deg2rad(self.misalignment))
        k = np.diag(self.scale_factor)
        k[0, 1], k[0, 2], k[1, 2] = c
        return k


@dataclass(frozen=True)
class Noise:
    """White noise of a component and of the scalar reading, red noise of a component; nT."""

    vector: float
    scalar: float
    red: float = 0.0
    outliers: float = 0.0

    @property
    def size(self) -> float:
        """White noise of the residual, nT."""
        return float(np.hypot(self.vector, self.scalar))


@dataclass(frozen=True)
class Readings:
    """`vector` (time, 3) and `scalar` (time,) nT; `noise` in the residual (time,) nT; `outlier` (time,)."""

    vector: np.ndarray
    scalar: np.ndarray
    noise: np.ndarray
    outlier: np.ndarray


def read(
    world: World, causes: Sequence[Cause], nine: Nine, noise: Noise, rng: np.random.Generator
) -> Readings:
    """Return both readings with all causes in them."""
    vector = _vector(world, causes, nine)
    scalar = _scalar(world, causes)
    count = scalar.size
    white, other = rng.normal(0, noise.vector, (count, 3)), rng.normal(0, noise.scalar, count)
    if noise.red:
        step = world.track.step
        white += np.stack([ornstein(rng, count, step, 900.0, noise.red) for _ in range(3)], axis=1)
    seen = np.einsum("ta,ta->t", world.direction, white) - other
    outlier = rng.random(count) < noise.outliers
    spikes = rng.choice([-1, 1], outlier.sum()) * np.exp(
        rng.uniform(np.log(3.0), np.log(800.0), outlier.sum())
    )
    hit = np.flatnonzero(outlier)
    at_scalar = rng.random(hit.size) < 0.5
    vector, scalar = vector + white, scalar + other
    scalar[hit[at_scalar]] += spikes[at_scalar]
    vector[hit[~at_scalar], rng.integers(0, 3, (~at_scalar).sum())] += spikes[~at_scalar]
    return Readings(_quantised(vector), _quantised(scalar), seen, outlier)


def _vector(world: World, causes: Sequence[Cause], nine: Nine) -> np.ndarray:
    """Return the noiseless vector reading: stray fields, K with its ageing, temperature, bend, offsets."""
    field = world.field + sum(c.field_vector for c in causes if c.field_vector is not None)
    k = nine.matrix()
    # Angles that grow have the axes read more of each other's field.
    angle = nine.misalignment + sum(c.angle for c in causes if c.angle is not None) + np.zeros((1, 3))
    xy, xz, yz = np.cos(np.deg2rad(angle)).T
    aged = 1 + sum(c.ageing for c in causes if c.ageing is not None) + np.zeros((1, 3))
    e = np.empty_like(field)
    e[:, 2] = field[:, 2] / (k[2, 2] * aged[:, 2])
    e[:, 1] = (field[:, 1] - yz * e[:, 2]) / (k[1, 1] * aged[:, 1])
    e[:, 0] = (field[:, 0] - xy * e[:, 1] - xz * e[:, 2]) / (k[0, 0] * aged[:, 0])
    e = e / (1 - sum(c.gain for c in causes if c.gain is not None))
    bends = [c.bend for c in causes if c.bend is not None]
    if bends:
        quadratic, cubic = sum(bends)
        straight = e.copy()
        for _ in range(6):
            e = straight - e * e * (quadratic + cubic * e)
    return e + nine.offset + sum(c.offset for c in causes if c.offset is not None)


def _scalar(world: World, causes: Sequence[Cause]) -> np.ndarray:
    """Return the noiseless scalar reading."""
    strays = [c.field_scalar for c in causes if c.field_scalar is not None]
    strength = np.linalg.norm(world.field + sum(strays), axis=1) if strays else world.strength.copy()
    for cause in causes:
        if cause.shift is not None:
            strength = strength - cause.shift * world.rate
        if cause.bias is not None:
            strength = strength + cause.bias
    return strength


def _quantised(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.round(values / RESOLUTION) * RESOLUTION)
