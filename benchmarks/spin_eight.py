"""The eight spin-related parameters of a day at 4 Hz, against reading the day and against a loop.

``python -m benchmarks spin_eight`` prints it: 28,800 spins of 3 s, three components and the phase, stored
as the archive stores them (integers with the instrument's resolution, delta, blosc-zstd). The loop makes the
tones of each sub-interval by ``numpy.linalg.lstsq`` and their derivatives by differences. Rivals take turns,
and processor times count, because the machine may be shared.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from scipy.linalg import block_diag
from zarr.codecs import BloscCodec
from zarr.codecs.numcodecs import Delta

from benchmarks.measured import Row, table
from inflight.arrays import Floats
from inflight.spin import (
    SPIN_RELATED,
    BlockLayout,
    CalibrationParameters,
    calibrate_by_selection,
    cut_into_blocks,
    estimate_jointly,
    measure_tones,
    spin_equations,
)
from inflight.threads import one_thread
from inflight.time import SECOND, Int64

_CADENCE, _PERIOD, _SAMPLES = 0.25, 3.0, 345_600
#: Smallest steps of the stored numbers: 1 pT, 1e-7 rad.
_STEP_NT, _STEP_RAD = 1e-3, 1e-7
#: Sub-intervals the loop takes, and its step of differences.
_LOOPED, _STEP = 40, 1e-6
#: In use, and a week later.
_PRESENT = CalibrationParameters(1.001, 1.0, 1.0, (1e-3, -2e-3), 5e-4, (1e-3, 2e-3), 0.0, (1.0, -2.0, 3.0))
_TRUTH = CalibrationParameters(
    1.00102, 1.0, 1.0, (1e-3, -2e-3), 5e-4, (1.02e-3, 2e-3), 0.0, (1.05, -2.0, 3.0)
)


def readings_of_a_day(seed: int = 1) -> tuple[Floats, Floats, Int64]:
    """Return readings (time, 3), phase and stamps of a day: half in 8 nT, half rising to 3000 nT."""
    generator = np.random.default_rng(seed)
    seconds = np.arange(_SAMPLES) * _CADENCE
    phase = 2.0 * np.pi * seconds / _PERIOD
    size = 8.0 * np.exp(6.0 * np.clip(seconds / seconds[-1] - 0.5, 0.0, None) * 2.0)
    walk = np.cumsum(generator.normal(size=(_SAMPLES, 3)), axis=0) * 2e-3
    plane, axial = size + walk[:, 0], 0.7 * size + walk[:, 1]
    angle = phase - 0.3 - 0.02 * walk[:, 2]
    field = np.column_stack([plane * np.cos(angle), -plane * np.sin(angle), axial])
    return _TRUTH.disturb(field), phase, (seconds * SECOND).astype(np.int64)


def store(folder: Path, readings: Floats, phase: Floats, stamps: Int64) -> None:
    """Write a day much as the archive does."""
    group = zarr.open_group(folder, mode="w-", zarr_format=3)
    for name, values in (
        ("field", np.rint(readings / _STEP_NT).astype("i4")),
        ("phase", np.rint(phase / _STEP_RAD).astype("i8")),
        ("tt2000", stamps),
    ):
        rows = (values.shape[0], 1) if values.ndim == 2 else values.shape
        array = group.create_array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            chunks=rows,
            filters=[Delta(dtype=values.dtype.str)],
            compressors=[BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")],
        )
        array[...] = values


def read(folder: Path) -> tuple[Floats, Floats, Int64]:
    """Read and decode it."""
    group = zarr.open_group(folder, mode="r")
    field, phase, stamps = (np.asarray(group[name][...]) for name in ("field", "phase", "tt2000"))
    return field * _STEP_NT, phase * _STEP_RAD, stamps


def loop(
    readings: Floats, phase: Floats, layout: BlockLayout, parameters: CalibrationParameters, subs: int
) -> tuple[Floats, Floats]:
    """Return the tones (sub, 6) of Bz and modulus and their derivatives (sub, 6, 8), some sub-intervals."""
    tones, slopes = np.empty((subs, 6)), np.empty((subs, 6, len(SPIN_RELATED)))
    start, stop = layout.over_blocks(layout.start), layout.over_blocks(layout.stop)
    for sub in range(subs):
        shapes = _shapes(phase, zip(start[sub], stop[sub], strict=True))
        own = readings[start[sub, 0] : stop[sub, -1]]
        tones[sub] = _tones(own, shapes, parameters)
        for at, name in enumerate(SPIN_RELATED):
            value = parameters.spin_related()[at]
            up, down = (parameters.changed({name: value + way * _STEP}) for way in (1.0, -1.0))
            slopes[sub, :, at] = (_tones(own, shapes, up) - _tones(own, shapes, down)) / (2.0 * _STEP)
    return tones, slopes


def _shapes(phase: Floats, blocks: Iterable[tuple[int, int]]) -> Floats:
    """Return a line for each block and the tones of all; (sample, 2 block + 4)."""
    parts = [phase[low:high] for low, high in blocks]
    angle = np.concatenate(parts)
    lines = [block_diag(*(np.ones((one.size, 1)) for one in parts))]
    lines.append(block_diag(*((one - one.mean())[:, None] for one in parts)))
    return np.column_stack([*lines, *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))])


def _tones(readings: Floats, shapes: Floats, parameters: CalibrationParameters) -> Floats:
    field = parameters.correct(readings)
    both = np.column_stack([field[:, 2], np.hypot(field[:, 0], field[:, 1])])
    tones = np.linalg.lstsq(shapes, both, rcond=None)[0][-4:]
    return np.concatenate([tones[:2, 0], tones[:, 1]])


def taking_turns(rivals: Mapping[str, Callable[[], object]], rounds: int = 9) -> dict[str, list[float]]:
    """Return the processor times of each of some works, s."""
    took: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(rounds):
        for name, work in rivals.items():
            begun = time.process_time()
            work()
            took[name].append(time.process_time() - begun)
    return took


def spin_eight_rows() -> list[Row]:
    """Return what was measured: processor times, a row each."""
    readings, phase, stamps = readings_of_a_day()
    with one_thread(), tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "day"
        store(folder, readings, phase, stamps)
        day = read(folder)
        layout = cut_into_blocks(*day)
        joint = estimate_jointly(*day, layout, _PRESENT)
        chosen = calibrate_by_selection(*day, layout, _PRESENT)
        took = taking_turns(
            {
                "reading and decoding it": lambda: read(folder),
                "cutting into sub-intervals": lambda: cut_into_blocks(*day),
                "one pass of all tones": lambda: measure_tones(*day, layout, _PRESENT),
                f"joint estimate, {joint.passes} passes": lambda: estimate_jointly(
                    *day, cut_into_blocks(*day), _PRESENT
                ),
                f"selection, {chosen.passes} passes": lambda: calibrate_by_selection(
                    *day, cut_into_blocks(*day), _PRESENT
                ),
            }
        )
        tones, slopes = loop(*day[:2], layout, _PRESENT, _LOOPED)
        slow = taking_turns({"loop": lambda: loop(*day[:2], layout, _PRESENT, _LOOPED)}, 3)["loop"]
        found = spin_equations(measure_tones(*day, layout, _PRESENT))
    apart = [
        float(np.abs(one[:_LOOPED] - other).max() / np.abs(other).max())
        for one, other in ((found.residual, tones), (found.design, slopes))
    ]
    against: dict[str, Any] = {
        "floor_s": float(np.median(took["reading and decoding it"])),
        "floor": "a day at 4 Hz: read and decoded; processor times",
        "naive_s": float(np.median(slow)) * layout.count / _LOOPED,
        "naive": f"a day at 4 Hz: one pass by a loop of lstsq, from {_LOOPED} sub-intervals; largest "
        f"difference of tones {apart[0]:.0e}, of derivatives {apart[1]:.0e} of the largest",
    }
    print(f"a day at 4 Hz, 28,800 spins, {joint.tones.summary()}", flush=True)
    return [Row(what=f"a day at 4 Hz: {name}", seconds=spent, **against) for name, spent in took.items()]


if __name__ == "__main__":
    print("\n".join(table(spin_eight_rows())))
