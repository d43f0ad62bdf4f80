"""The eight spin-related parameters of a day at 4 Hz, against reading the day.

``python -m benchmarks.spin_eight`` prints both: 28,800 spins of 3 s, three components and the phase, stored
as the archive stores them (integers with the instrument's resolution, delta, blosc-zstd).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zarr
from threadpoolctl import threadpool_limits
from zarr.codecs import BloscCodec
from zarr.codecs.numcodecs import Delta

from inflight.arrays import Floats
from inflight.spin.equation import TwelveParameters
from inflight.spin.harmonics import spin_tones
from inflight.spin.joint import joint_estimate
from inflight.spin.layout import lay_out
from inflight.spin.selection import calibrate_by_selection
from inflight.time import SECOND, Int64

_CADENCE, _PERIOD, _SAMPLES = 0.25, 3.0, 345_600
#: Smallest steps of the stored numbers: 1 pT, 1e-7 rad.
_STEP_NT, _STEP_RAD = 1e-3, 1e-7
#: In use, and a week later.
_PRESENT = TwelveParameters(1.001, 1.0, 1.0, (1e-3, -2e-3), 5e-4, (1e-3, 2e-3), 0.0, (1.0, -2.0, 3.0))
_TRUTH = TwelveParameters(1.00102, 1.0, 1.0, (1e-3, -2e-3), 5e-4, (1.02e-3, 2e-3), 0.0, (1.05, -2.0, 3.0))


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
    """Write a day as the archive does."""
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


def fastest(work: Callable[[], object], repeats: int = 9) -> float:
    """Return the processor time of the fastest of some runs, ms: others on the machine do not count."""
    spent = []
    for _ in range(repeats):
        begun = time.process_time()
        work()
        spent.append(time.process_time() - begun)
    return 1e3 * min(spent)


def spin_eight() -> list[str]:
    """Return the lines to print."""
    readings, phase, stamps = readings_of_a_day()
    with threadpool_limits(1), tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "day"
        store(folder, readings, phase, stamps)
        day = read(folder)
        layout = lay_out(*day)
        joint = joint_estimate(*day, layout, _PRESENT)
        chosen = calibrate_by_selection(*day, layout, _PRESENT)
        floor = fastest(lambda: read(folder))
        cut = fastest(lambda: lay_out(*day))
        once = fastest(lambda: spin_tones(*day, layout, _PRESENT))
        whole = fastest(lambda: joint_estimate(*day, lay_out(*day), _PRESENT), 5)
        picked = fastest(lambda: calibrate_by_selection(*day, lay_out(*day), _PRESENT), 5)
    return [
        f"a day at 4 Hz, 28,800 spins, {joint.tones.told()}",
        f"reading and decoding it    {floor:8.1f} ms",
        f"cutting into sub-intervals {cut:8.1f} ms",
        f"one pass of all tones      {once:8.1f} ms, {once / floor:.1f} times the reading",
        f"joint estimate, {joint.passes} passes   {whole:8.1f} ms, {whole / floor:.1f} times the reading",
        f"selection, {chosen.passes} passes        {picked:8.1f} ms, {picked / floor:.1f} times the reading",
    ]


if __name__ == "__main__":
    print("\n".join(spin_eight()))
