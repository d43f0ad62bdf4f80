"""Day files as a real mission delivers them: CDF with TT2000 and the attributes of the ISTP guidelines."""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from cdflib import cdfwrite
from cdflib.cdfwrite import CDF

from inflight.errors import StorageError
from inflight.simulate.defects import FILL
from inflight.time import TT2000_FILL, day_bounds

#: zlib level of the deliveries; higher ones save 3 % and cost twice the time.
_COMPRESSION = 1


@dataclass(frozen=True)
class Variable:
    """How one delivered variable is described (ISTP guidelines)."""

    description: str
    unit: str
    low: float
    high: float
    kind: int = CDF.CDF_DOUBLE
    labels: tuple[str, ...] = ()
    format: str = "F12.4"


@dataclass(frozen=True)
class Source:
    """Whose files they are.

    Attributes
    ----------
    name, description : str
        Of the spacecraft; the name begins every file.
    titles : mapping of str to str
        What each instrument is.
    variables : mapping of str to Variable
    """

    name: str
    description: str
    titles: Mapping[str, str]
    variables: Mapping[str, Variable]

    def path(self, destination: Path, instrument: str, day: np.datetime64) -> Path:
        """Return where a delivered file stands: ``fgm/champ_fgm_20050101_v01.cdf``."""
        return destination / instrument / f"{self.name}_{instrument}_{compact(day)}_v01.cdf"


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Give a temporary name in the same folder; rename it when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def storage(folder: Path, day: np.datetime64 | None) -> Iterator[None]:
    """Tell a refused write as an error of storage that names folder and day."""
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"cannot write: {error}",
            file=str(folder),
            day="" if day is None else str(day),
            remedy="make room or choose another folder, then run again",
        ) from error


def write_cdf(path: Path, source: Source, instrument: str, data: xr.Dataset, day: np.datetime64) -> None:
    """Write one delivery as CDF with TT2000 and the attributes of the ISTP guidelines."""
    specification = {"Compressed": 0, "Majority": 1}
    with _undated_compression(), CDF(path, cdf_spec=specification, delete=True) as file:
        file.write_globalattrs(_global_attributes(source, instrument, day))
        file.write_var(
            _specification("Epoch", CDF.CDF_TIME_TT2000, ()), _epoch_attributes(day), data["Epoch"].values
        )
        for name, series in data.drop_vars("Epoch").items():
            described = source.variables[str(name)]
            _write_labels(file, str(name), described)
            file.write_var(
                _specification(str(name), described.kind, series.shape[1:]),
                _variable_attributes(str(name), described),
                np.ascontiguousarray(series.values, dtype=_DTYPES[described.kind]),
            )


@contextmanager
def _undated_compression() -> Iterator[None]:
    """Keep the time of writing out of the compressed blocks, so equal days are equal files.

    cdflib lets gzip stamp each block with the clock and offers no option against it.
    """
    stamped = cdfwrite.gzip_deflate
    cdfwrite.gzip_deflate = lambda data, level: gzip.compress(data, compresslevel=level, mtime=0)
    try:
        yield
    finally:
        cdfwrite.gzip_deflate = stamped


_DTYPES: dict[int, type] = {
    CDF.CDF_DOUBLE: np.float64,
    CDF.CDF_REAL4: np.float32,
    CDF.CDF_UINT1: np.uint8,
}
_TYPE_NAMES = {CDF.CDF_DOUBLE: "CDF_DOUBLE", CDF.CDF_REAL4: "CDF_REAL4", CDF.CDF_UINT1: "CDF_UINT1"}


def _specification(name: str, kind: int, shape: Sequence[int]) -> dict[str, Any]:
    return {
        "Variable": name,
        "Data_Type": kind,
        "Num_Elements": 1,
        "Rec_Vary": True,
        "Dim_Sizes": list(shape),
        "Compress": _COMPRESSION,
    }


def _write_labels(file: CDF, name: str, described: Variable) -> None:
    if not described.labels:
        return
    labels = [f"{name}_{axis}" for axis in described.labels]
    width = max(len(label) for label in labels)
    file.write_var(
        {
            "Variable": f"{name}_LABEL",
            "Data_Type": CDF.CDF_CHAR,
            "Num_Elements": width,
            "Rec_Vary": False,
            "Dim_Sizes": [len(labels)],
        },
        {
            "CATDESC": f"Labels of {name}",
            "FIELDNAM": f"{name}_LABEL",
            "FORMAT": f"A{width}",
            "VAR_TYPE": "metadata",
        },
        labels,
    )


def _variable_attributes(name: str, described: Variable) -> dict[str, Any]:
    kind = _TYPE_NAMES[described.kind]
    fill = 255 if described.kind == CDF.CDF_UINT1 else FILL
    labels = {"LABL_PTR_1": f"{name}_LABEL"} if described.labels else {"LABLAXIS": name}
    return {
        "CATDESC": described.description,
        "FIELDNAM": name,
        "UNITS": described.unit,
        "FORMAT": described.format,
        "FILLVAL": [fill, kind],
        "VALIDMIN": [described.low, kind],
        "VALIDMAX": [described.high, kind],
        "DEPEND_0": "Epoch",
        "DISPLAY_TYPE": "time_series",
        "VAR_TYPE": "data",
    } | labels


def _epoch_attributes(day: np.datetime64) -> dict[str, Any]:
    low, high = day_bounds(day)
    kind = "CDF_TIME_TT2000"
    return {
        "CATDESC": "Time of the sample",
        "FIELDNAM": "Epoch",
        "UNITS": "ns",
        "LABLAXIS": "Epoch",
        "TIME_BASE": "J2000",
        "TIME_SCALE": "Terrestrial Time",
        "REFERENCE_POSITION": "Rotating Earth Geoid",
        "FORMAT": "I22",
        "FILLVAL": [int(TT2000_FILL), kind],
        "VALIDMIN": [low, kind],
        "VALIDMAX": [high, kind],
        "VAR_TYPE": "support_data",
        "MONOTON": "INCREASE",
    }


def _global_attributes(source: Source, instrument: str, day: np.datetime64) -> dict[str, dict[int, str]]:
    name = f"{source.name}_{instrument}_{compact(day)}_v01"
    attributes = {
        "Project": "Simulation",
        "Source_name": f"{source.name}>{source.description}",
        "Discipline": "Space Physics>Magnetospheric Science",
        "Data_type": f"{instrument}>{source.titles[instrument]}",
        "Descriptor": f"{instrument}>{source.titles[instrument]}",
        "Data_version": "01",
        "Logical_file_id": name,
        "Logical_source": f"{source.name}_{instrument}",
        "Logical_source_description": f"{source.titles[instrument]}, level 1, simulated",
        "PI_name": "none",
        "PI_affiliation": "none",
        "TEXT": "Simulated measurements; no spacecraft made them.",
        "Instrument_type": "Magnetic Fields (space)",
        "Mission_group": "Simulation",
    }
    return {key: {0: value} for key, value in attributes.items()}


def compact(day: np.datetime64) -> str:
    """Return a day as file names have it: 20050101."""
    return str(day).replace("-", "")
