"""Fields of one's own, added to real measurements: the truth is known, the noise and the rest are real.

An injection is made from the record it goes into and says what it is made of. It goes into samples in
memory (`inject`), or into the observatory's delivered file, from which a whole workspace is made
(`observatory_with`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cdflib
import numpy as np
import xarray as xr
from scipy import signal

from inflight.catalog import Workspace

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))
OBSERVATORY = REAL / "conrad-wic-storm-may2024"
#: Variables of the observatory's file, by their names in the mission's YAML.
_ELEMENTS = ("GeomagneticFieldH", "GeomagneticFieldE", "GeomagneticFieldZ")
_OTHERS = {
    "scalar": "GeomagneticFieldS",
    "sensor_temperature": "Temperature1",
    "electronics_temperature": "Temperature2",
}


@dataclass(frozen=True)
class Injection:
    """A field in the axes of the reading it is added to, and the truth about it.

    Attributes
    ----------
    field : ndarray, shape (time, 3)
        nT.
    truth : mapping
        ``kind``; ``vector`` (3,), nT per unit of the channel, or of the step; ``channel``, ``lag_s``, ``at``.
    """

    field: np.ndarray
    truth: Mapping[str, Any]


def following(
    samples: xr.Dataset, channel: str, amplitude: float, along=(0.0, 0.0, 1.0), lag_s: float = 0.0
) -> Injection:
    """A field that follows a channel, at once or slowly (first order, settled at the record's start).

    Parameters
    ----------
    samples : Dataset
        With the channel and evenly spaced `tt2000`.
    amplitude : float
        Standard deviation of the field over the record, nT, its sign that of the coefficient.
    along : tuple of float
        Direction in the axes of the reading; its length does not matter.
    lag_s : float
        Time constant, seconds.
    """
    cause = np.asarray(samples[channel].values, dtype=np.float64)
    assert np.isfinite(cause).all(), f"{channel} has gaps: a response to it is not known"
    if lag_s:
        step = float(np.median(np.diff(samples["tt2000"].values))) * 1e-9
        keep = np.exp(-step / lag_s)
        cause, _ = signal.lfilter([1.0 - keep], [1.0, -keep], cause, zi=[keep * cause[0]])
    assert cause.std() > 0.0, f"{channel} does not move"
    vector = amplitude / cause.std() * _unit(along)
    # Less its mean: a constant belongs to the offsets of the sensor.
    return Injection(
        (cause - cause.mean())[:, None] * vector,
        {"kind": "channel", "channel": channel, "vector": vector, "lag_s": lag_s},
    )


def step(samples: xr.Dataset, at: int, amplitude: float, along=(0.0, 0.0, 1.0)) -> Injection:
    """A field of `amplitude` nT that is there from TT2000 `at` on."""
    vector = amplitude * _unit(along)
    after = np.asarray(samples["tt2000"].values) >= at
    assert 0 < after.sum() < after.size, "the step lies outside the record"
    return Injection(after[:, None] * vector, {"kind": "step", "at": at, "vector": vector, "lag_s": 0.0})


def inject(samples: xr.Dataset, injection: Injection, role: str = "vector") -> xr.Dataset:
    """Return samples whose reading holds the field, too."""
    return samples.assign({role: samples[role] + injection.field})


def observatory() -> xr.Dataset:
    """Return the observatory's file as delivered: `vector`, `scalar`, both temperatures, `tt2000`."""
    file = cdflib.CDF(next(OBSERVATORY.glob("*.cdf")))
    held = {name: ("time", np.asarray(file.varget(variable))) for name, variable in _OTHERS.items()}
    held["vector"] = (("time", "axis"), np.stack([file.varget(name) for name in _ELEMENTS], axis=1))
    held["tt2000"] = ("time", np.asarray(file.varget("DataTimes"), dtype=np.int64))
    return xr.Dataset(held)


def observatory_with(root: Path, make: Callable[[xr.Dataset], list[Injection]]) -> tuple[Workspace, Path]:
    """Make a workspace of the observatory whose delivered file holds injected fields.

    Parameters
    ----------
    root : Path
        A folder that does not exist yet.
    make : callable
        From the record as delivered to what is added to its vector reading.

    Returns
    -------
    tuple of Workspace and Path
        Nothing is ingested yet; the second is the data folder.
    """
    record = observatory()
    for injection in make(record):
        record = inject(record, injection)
    text = (ROOT / "missions" / "conrad.yaml").read_text(encoding="utf-8")
    original = "wic_lemi036_gp20s3_1s_{start:%Y%m%d}_{end:%Y%m%d}.cdf"
    for old, new in ((original, "observatory.npz"), ("reader: cdf", "reader: npz\n      time_unit: tt2000")):
        assert text.count(old) == 1, f"missions/conrad.yaml no longer says {old!r} once"
        text = text.replace(old, new)
    source = root.parent / f"{root.name}-source"
    source.mkdir(parents=True)
    (source / "conrad.yaml").write_text(text, encoding="utf-8")
    columns = dict(zip(_ELEMENTS, record["vector"].values.T, strict=True))
    columns |= {variable: record[name].values for name, variable in _OTHERS.items()}
    np.savez(source / "observatory.npz", DataTimes=record["tt2000"].values, **columns)
    return Workspace.create(root, source / "conrad.yaml"), source


def _unit(along) -> np.ndarray:
    vector = np.asarray(along, dtype=np.float64)
    return vector / np.linalg.norm(vector)
