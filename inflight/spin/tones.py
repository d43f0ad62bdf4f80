"""Tones at the spin and at twice the spin, of Bz and of the spin-plane modulus, with their natural noise.

Takes: readings, spin phase, blocks (`inflight.spin.intervals`) and the parameters the readings are corrected
with. Makes (`measure_tones`): `SpinTones`, the tones of every sub-interval with their noise, and the same
tones of the derivatives of Bz and the modulus by each parameter: estimates then need no more of the samples.

The field is not despun (Plaschke et al. 2019, section 5.3). In each block a line is taken out, and the tones
are fitted to the rest, so that gaps and uneven sampling do no harm; for whole, evenly sampled spins they are
the paper's Fourier components ``(2/N) sum x exp(-i w t)``, without a window. The noise is that of
neighbouring frequencies: 85, 115 and 185, 215 % of the spin's over whole sub-intervals, as published, and
nearer ones in each block. ``F2p``, ``Fp`` and ``Fa`` of table 2 are the larger of two neighbours.

From pass to pass (`initial_tones`, `updated_tones`): where offsets are as large as the field, spins are
averaged first; after a small step only the tones of Bz and the modulus are made anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError, TooLittleError
from inflight.spin.equation import CalibrationParameters
from inflight.spin.intervals import BLOCK_SETTINGS, BlockLayout, Bools
from inflight.spin.kernels import LINES, NEIGHBOURS, SERIES, TONES, M, U, V, Z, sum_blocks, sum_tones
from inflight.time import Int64


def block_sums(
    readings: Floats, phase: Floats, layout: BlockLayout, parameters: CalibrationParameters
) -> tuple[Floats, Floats, Floats]:
    """Return the sums of all blocks.

    (block, 6, column) of lines and tones times all columns, (block, 16, 2) of neighbouring frequencies times
    Bz and modulus, and (block, 5): samples, covered phase, least modulus, least and largest size of Bz.
    """
    count = layout.start.size
    inner = np.empty((count, LINES + TONES, LINES + TONES + NEIGHBOURS + len(SERIES)))
    sums = inner, np.empty((count, NEIGHBOURS, 2)), np.empty((count, 5))
    record = np.asarray(readings, dtype=np.float64), np.asarray(phase, dtype=np.float64), layout.good
    sum_blocks(*record, _blocks(layout), _correction(parameters), layout.settings.distances, sums)
    return sums


def tone_sums(
    readings: Floats, phase: Floats, layout: BlockLayout, parameters: CalibrationParameters
) -> Floats:
    """Return sums of lines and tones times themselves, Bz and modulus; (block, 6, 8)."""
    inner = np.empty((layout.start.size, LINES + TONES, LINES + TONES + 2))
    record = np.asarray(readings, dtype=np.float64), np.asarray(phase, dtype=np.float64), layout.good
    sum_tones(*record, _blocks(layout), _correction(parameters), inner)
    return inner


def _blocks(layout: BlockLayout) -> tuple[Int64, Int64, float]:
    return layout.start, layout.stop, layout.settings.turn


def _correction(parameters: CalibrationParameters) -> tuple[Floats, Floats]:
    return parameters.matrix(), np.array(parameters.offset)


def _slopes(inner: Floats, known: Bools) -> Floats:
    """Return the lines (block, 2, column) through all columns of the blocks."""
    gram = np.where(known[:, None, None], inner[:, :LINES, :LINES], np.eye(LINES))
    return np.asarray(np.linalg.solve(gram, inner[:, :LINES]))


def without_lines(inner: Floats, known: Bools) -> Floats:
    """Return the sums (block, 4, column) of tones times the columns without their line in each block."""
    crossed = inner[:, :LINES, LINES : LINES + TONES].transpose(0, 2, 1)
    tones = inner[:, LINES:] - crossed @ _slopes(inner, known)
    return np.where(known[:, None, None], tones, 0.0)[:, :, LINES:]


def neighbours_without_lines(inner: Floats, neighbours: Floats, known: Bools) -> Floats:
    """Return the sums (block, 16, 2) of neighbours times Bz and modulus without their line."""
    both = _slopes(inner, known)[:, :, [Z - len(SERIES), M - len(SERIES)]]
    near = slice(LINES + TONES, -len(SERIES))
    rest = neighbours - inner[:, :LINES, near].transpose(0, 2, 1) @ both
    return np.where(known[:, None, None], rest, 0.0)


@dataclass(frozen=True, kw_only=True)
class ToneLimits:
    """Limits of tones.

    Attributes
    ----------
    small : float
        Derivatives hold while the field changes by less than this part. Assumed.
    coherent : float
        The direction of the field must keep this much of its turn with the phase: less is another period.
        Assumed.
    large : float
        Above this part of the field an offset makes the modulus too nonlinear for one linear step. Assumed.
    low : float
        Part of the sub-intervals, those of least axial field, in which elevations matter least. Assumed.
    covered : float
        Part of a block that samples must cover for a line of its own. Assumed.
    """

    small: float = 0.01
    coherent: float = 0.5
    large: float = 0.2
    low: float = 0.25
    covered: float = 0.1


TONE_LIMITS = ToneLimits()

#: Why a sub-interval below that is left out.
NOT_TURNING = "not turning with the phase"


@dataclass(frozen=True, kw_only=True)
class SpinTones:
    """Tones of every sub-interval at some parameters; sub-intervals without any are NaN.

    Attributes
    ----------
    start, end : ndarray of int64, shape (sub,)
        TT2000 of the first and the last sample.
    tones : ndarray, shape (sub, 4, series)
        cos and sin at the spin, cos and sin at twice the spin, of `SERIES`, nT (or 1).
    noise : ndarray, shape (sub, 3)
        Standard deviation that natural fluctuations give to cos or sin of Bz and of the modulus at the spin
        and of the modulus at twice the spin, nT: from all neighbouring frequencies.
    amplitude : ndarray, shape (sub, 3)
        Fa, Fp, F2p of Plaschke et al. (2019): the larger of the two neighbours' amplitudes, nT.
    least_modulus, least_axial, largest_axial : ndarray, shape (sub,)
        min Bp, min and max of the size of Bz, nT.
    filled : ndarray, shape (sub,)
        Part of the spins that samples cover.
    coherence : ndarray, shape (sub,)
        1 where the field turns with the phase, 0 where it does not.
    mean : ndarray, shape (sub, 2)
        Bx and By averaged over the spins, nT: a first guess of large offsets.
    excluded : tuple of (str, ndarray of bool of shape (sub,))
        Why sub-intervals are left out.
    known : ndarray of bool, shape (block,)
        Blocks with samples enough for a line of their own.
    parameters : CalibrationParameters
    blocks : int
        A sub-interval shares blocks with this many before and after, itself included.
    """

    start: Int64
    end: Int64
    tones: Floats
    noise: Floats
    amplitude: Floats
    least_modulus: Floats
    least_axial: Floats
    largest_axial: Floats
    filled: Floats
    coherence: Floats
    mean: Floats
    excluded: tuple[tuple[str, Bools], ...]
    known: Bools
    parameters: CalibrationParameters
    blocks: int

    @property
    def usable(self) -> Bools:
        """Sub-intervals that are not left out; (sub,)."""
        bad = np.zeros(self.start.size, dtype=np.bool_)
        for _, hit in self.excluded:
            bad |= hit
        return ~bad

    def summary(self) -> str:
        """Return how many sub-intervals there are and why some are left out."""
        lost = ", ".join(f"{int(hit.sum())} {name}" for name, hit in self.excluded if hit.any())
        return f"{int(self.usable.sum())} of {self.start.size} sub-intervals" + (f"; {lost}" if lost else "")


def measure_tones(
    readings: Floats, phase: Floats, stamps: Int64, layout: BlockLayout, parameters: CalibrationParameters
) -> SpinTones:
    """Return the tones of a record under some parameters.

    Parameters
    ----------
    readings : ndarray, shape (time, 3)
        Temperature-corrected, sensor axes, nT.
    phase : ndarray, shape (time,)
        Unwrapped spin phase, rad.
    stamps : ndarray of int64, shape (time,)
        TT2000.
    layout : BlockLayout
        From `cut_into_blocks` of the same record.
    parameters : CalibrationParameters
        The readings are corrected with these.
    """
    inner, neighbours, levels = block_sums(readings, phase, layout, parameters)
    settings = layout.settings
    covered = levels[:, 1] / settings.turn
    # The step from one block to the next is in neither.
    filled = np.minimum(layout.over_blocks(covered).mean(axis=1) * (1.0 + 0.5 / settings.spins), 1.0)
    enough = filled >= settings.filled
    known = covered > TONE_LIMITS.covered
    rest = without_lines(inner, known), neighbours_without_lines(inner, neighbours, known)
    windows = [layout.over_blocks(one) for one in rest]
    summed = windows[0].sum(axis=1)
    gram = np.where(enough[:, None, None], summed[:, :, :TONES], np.eye(TONES))
    tones = np.linalg.solve(gram, summed[:, :, -len(SERIES) :])
    # The neighbours' sums without the tones themselves.
    crossed = windows[0][..., TONES : -len(SERIES)]
    residual = windows[1] - np.einsum("sbte,std->sbed", crossed, tones[:, :, [Z, M]])
    count = layout.over_blocks(levels[:, 0]).sum(axis=1)
    noise, amplitude = _noise(residual, np.maximum(count, 1.0))
    coherence = 0.5 * np.hypot(tones[:, 0, U] - tones[:, 1, V], tones[:, 1, U] + tones[:, 0, V])
    low, high = layout.over_blocks(layout.start)[:, 0], layout.over_blocks(layout.stop)[:, -1]
    nan = np.where(enough, 0.0, np.nan)
    return SpinTones(
        start=stamps[np.minimum(low, stamps.size - 1)],
        end=stamps[np.maximum(high - 1, 0)],
        tones=tones + nan[:, None, None],
        noise=noise + nan[:, None],
        amplitude=amplitude + nan[:, None],
        least_modulus=layout.over_blocks(levels[:, 2]).min(axis=1) + nan,
        least_axial=layout.over_blocks(levels[:, 3]).min(axis=1) + nan,
        largest_axial=layout.over_blocks(levels[:, 4]).max(axis=1) + nan,
        filled=filled,
        coherence=coherence + nan,
        mean=layout.over_blocks(inner[:, 0, -len(SERIES) :][:, :2]).sum(axis=1)
        / np.maximum(count, 1.0)[:, None]
        + nan[:, None],
        excluded=(
            ("too few samples", ~enough),
            *layout.excluded(),
            (NOT_TURNING, enough & (coherence < TONE_LIMITS.coherent)),
        ),
        known=known,
        parameters=parameters,
        blocks=settings.blocks,
    )


def corrected_tones(
    readings: Floats, phase: Floats, layout: BlockLayout, before: SpinTones, parameters: CalibrationParameters
) -> SpinTones:
    """Return tones of Bz and of the modulus under other parameters, and all else as it was before.

    A third of the work of `measure_tones`. Derivatives and noise change by the relative change of the field
    only: for small steps (see `is_small_step`) they hold.

    Parameters
    ----------
    readings, phase, layout
        As for `measure_tones`.
    before : SpinTones
        Of the same record and layout.
    parameters : CalibrationParameters
    """
    sums = tone_sums(readings, phase, layout, parameters)
    lost = np.isnan(before.tones[:, 0, Z])
    rest = without_lines(sums, before.known)
    summed = layout.over_blocks(rest).sum(axis=1)
    gram = np.where(lost[:, None, None], np.eye(TONES), summed[:, :, :TONES])
    tones = before.tones.copy()
    tones[:, :, [Z, M]] = np.linalg.solve(gram, summed[:, :, TONES:])
    tones[lost] = np.nan
    return replace(before, tones=tones, parameters=parameters)


def is_small_step(before: SpinTones, parameters: CalibrationParameters) -> bool:
    """Return True when new parameters change the field by less than 1 %, the spin-plane offsets included."""
    turned = np.abs(parameters.matrix() @ np.linalg.inv(before.parameters.matrix()) - np.eye(3)).max()
    shifted = np.abs(np.subtract(parameters.offset, before.parameters.offset)).max()
    least = before.least_modulus[before.usable]
    if not least.size:
        return False
    return bool(turned < TONE_LIMITS.small and shifted < TONE_LIMITS.small * float(np.median(least)))


def _noise(residual: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return noise and amplitudes (sub, 3) from the neighbours in each block; (sub, block, 16, 2).

    The far neighbours are taken over the sub-interval, the near ones in its blocks, whose squares add up
    whichever way they are turned: of two blocks 4 and 8 squares for a variance instead of the paper's 4.
    """
    far, near, amplitude = [], [], []
    # tone, distance, side, cos or sin
    shaped = residual.reshape(*residual.shape[:2], 2, 2, 2, 2, 2)
    for tone, series in ((0, 0), (0, 1), (1, 1)):
        one = shaped[:, :, tone, ..., series]
        whole = (one[:, :, 0].sum(axis=1) ** 2).sum(axis=2)  # sub, side
        amplitude.append(np.sqrt(whole.max(axis=1)))
        far.append(0.25 * whole.sum(axis=1))
        near.append(0.25 * (one[:, :, 1] ** 2).sum(axis=(1, 2, 3)))
    blocks = residual.shape[1]
    square = (np.stack(far, axis=1) + blocks * np.stack(near, axis=1)) / (1 + blocks)
    half = 0.5 * count[:, None]
    return np.sqrt(square) / half, np.stack(amplitude, axis=1) / half


def check_turning(found: SpinTones, readings: Floats, phase: Floats, layout: BlockLayout) -> None:
    """Check that the field turns with the phase and that there is something to fit.

    Raises
    ------
    CalibrationError
        The field does not turn with the phase.
    TooLittleError
        No sub-interval is usable.
    """
    turning, others = np.zeros((2, found.start.size), dtype=np.bool_)
    for name, hit in found.excluded:
        if name == NOT_TURNING:
            turning = hit
        else:
            others |= hit
    judged = int((~others).sum())
    if turning.sum() > 0.5 * judged > 0:
        ratio = turn_ratio(found.parameters.correct(readings), phase, layout.good)
        raise CalibrationError(
            f"the field does not turn with the phase in {int(turning.sum())} of {judged} sub-intervals: "
            f"it turns by {ratio:.5f} of the phase",
            remedy="look at the spin period, the Sun pulses, the direction of the spin and the offsets",
        )
    if not found.usable.any():
        raise TooLittleError(
            f"no sub-interval is usable: {found.summary()}",
            remedy="take a longer span, fewer spins a sub-interval, or look at flags and exclusions",
        )


def turn_ratio(field: Floats, phase: Floats, good: Bools) -> float:
    """Return by how much the field turns in the spin plane while the phase turns by 1; the median of samples.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Spin-aligned axes, nT.
    phase : ndarray, shape (time,)
        rad.
    good : ndarray of bool, shape (time,)
    """
    angle = np.arctan2(-field[good, 1], field[good, 0])
    turned = np.diff(angle)
    turned = (turned + np.pi) % (2.0 * np.pi) - np.pi
    step = np.diff(phase[good])
    use = (step > 0.0) & (step < BLOCK_SETTINGS.widest_step)
    return float(np.median(turned[use] / step[use])) if use.any() else float("nan")


def initial_tones(
    readings: Floats, phase: Floats, stamps: Int64, layout: BlockLayout, present: CalibrationParameters
) -> SpinTones:
    """Return tones at the present parameters, the offsets guessed anew where they are large.

    Averaged over whole spins a steady field leaves the offsets alone in the spin plane, linear in them.

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    tones = measure_tones(readings, phase, stamps, layout, present)
    kept = np.isfinite(tones.mean).all(axis=1)
    for name, hit in tones.excluded:
        if name != NOT_TURNING:
            kept &= ~hit
    if kept.any():
        axial = np.where(kept, tones.largest_axial, np.inf)
        low = axial <= np.quantile(axial[kept], TONE_LIMITS.low)
        mean = np.median(tones.mean[low], axis=0)
        cross = np.median(np.hypot(*tones.tones[low, :2, SERIES.index("x")].T))
        if np.hypot(*mean) > TONE_LIMITS.large * cross:
            plane = np.linalg.solve(present.matrix(), np.array([mean[0], mean[1], 0.0]))
            moved = {f"offset[{at + 1}]": present.offset[at] + float(plane[at]) for at in range(2)}
            tones = measure_tones(readings, phase, stamps, layout, present.changed(moved))
    check_turning(tones, readings, phase, layout)
    return tones


def updated_tones(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: BlockLayout,
    before: SpinTones,
    parameters: CalibrationParameters,
) -> SpinTones:
    """Return tones at new parameters: all of them, or after a small step those of Bz and modulus alone."""
    if is_small_step(before, parameters):
        return corrected_tones(readings, phase, layout, before, parameters)
    return measure_tones(readings, phase, stamps, layout, parameters)
