"""Write a simulated mission as day files like a real one delivers, and its truth apart."""

from __future__ import annotations

import gzip
import io
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from cdflib import cdfwrite
from cdflib.cdfwrite import CDF
from ruamel.yaml import YAML
from threadpoolctl import threadpool_limits

from inflight.errors import CatalogError, StorageError
from inflight.simulate import SimulatedDay, SimulationSettings, simulate_day
from inflight.simulate.defects import FILL
from inflight.time import TT2000_FILL, day_bounds

#: Called with the number of days done and of all days.
Progress = Callable[[int, int], None]
INSTRUMENTS = ("fgm", "ovm", "tq", "hk", "att", "orb")
SECOND_FLUXGATE = "fgm2"
TRUTH = "truth"
#: zlib level of the deliveries; higher ones save 3 % and cost twice the time.
_COMPRESSION = 1
#: Settings that may differ between two runs into one folder: they only widen the span.
_SPAN = {"start", "days"}


@dataclass(frozen=True)
class _Variable:
    """How one delivered variable is described (ISTP guidelines)."""

    description: str
    unit: str
    low: float
    high: float
    kind: int = CDF.CDF_DOUBLE
    labels: tuple[str, ...] = ()
    format: str = "F12.4"


_XYZ = ("x", "y", "z")
_VARIABLES = {
    "FGM_RAW": _Variable("Raw vector field, sensor axes", "nT", -65000, 65000, labels=_XYZ, format="F10.2"),
    "T_CSC": _Variable("Temperature of the feedback coil", "degC", -60, 80, CDF.CDF_REAL4),
    "T_ADC": _Variable("Temperature of the converter", "degC", -60, 80, CDF.CDF_REAL4),
    "FGM_FLAG": _Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
    "F": _Variable("Raw field strength", "nT", 15000, 65000, format="F10.2"),
    "F_OSC_RATIO": _Variable("Oscillator frequency over nominal", " ", 0.999, 1.001, format="F14.10"),
    "I_TQ": _Variable("Torquer currents", "mA", -500, 500, CDF.CDF_REAL4, labels=_XYZ),
    "I_SOL": _Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
    "I_BAT": _Variable("Battery current, positive when charging", "mA", -20000, 20000, CDF.CDF_REAL4),
    "I_CAM": _Variable("Current of the boom star camera", "mA", 0, 2000, CDF.CDF_REAL4),
    "I_HTR": _Variable("Heater current", "mA", 0, 2000, CDF.CDF_REAL4),
    "Q": _Variable("Quaternion spacecraft to ITRF", " ", -1, 1, labels=("x", "y", "z", "w"), format="F11.7"),
    "POS_ITRF": _Variable("Position in ITRF", "km", -8000, 8000, labels=_XYZ, format="F13.5"),
}
_TITLES = {
    "fgm": "Fluxgate magnetometer",
    SECOND_FLUXGATE: "Second fluxgate magnetometer",
    "ovm": "Overhauser magnetometer",
    "tq": "Magneto-torquer currents",
    "hk": "Housekeeping currents",
    "att": "Attitude",
    "orb": "Orbit",
}


def instruments_of(settings: SimulationSettings) -> tuple[str, ...]:
    """Return the instruments a simulated mission delivers."""
    return (*INSTRUMENTS, SECOND_FLUXGATE) if settings.second_fluxgate else INSTRUMENTS


def delivered_path(destination: Path, instrument: str, day: np.datetime64) -> Path:
    """Return where a delivered file stands: ``fgm/champ_fgm_20050101_v01.cdf``."""
    return destination / instrument / f"champ_{instrument}_{_compact(day)}_v01.cdf"


def truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return where the truth of a day stands, for tests and nobody else."""
    return destination / TRUTH / f"champ_truth_{_compact(day)}.nc"


def simulate(
    settings: SimulationSettings,
    destination: Path | str,
    progress: Progress | None = None,
    workers: int = 2,
) -> list[Path]:
    """Write the day files of a simulated mission.

    Files appear whole under their names, so a run that was stopped is completed by the same call;
    days already there are kept.

    Parameters
    ----------
    settings : SimulationSettings
        What to simulate.
    destination : Path
        Folder for ``fgm/``, ``ovm/``, ``tq/``, ``hk/``, ``att/``, ``orb/``, for ``fgm2/`` when asked
        for, and, apart, ``truth/``.
    progress : callable, optional
        Called with (days done, days).
    workers : int
        Processes; 1 stays in this one. The files do not depend on it.

    Returns
    -------
    list of Path
        The delivered files of all days, in order of day and instrument; truth is not among them.

    Raises
    ------
    CatalogError
        When the folder holds files of other settings.
    StorageError
        When the disk refuses a write; days written before stay.
    """
    folder = Path(destination)
    _claim(settings, folder)
    days = settings.day_list
    missing = [day for day in days if not _is_complete(settings, folder, day)]
    for number, _ in enumerate(_written(settings, folder, missing, workers), start=1):
        if progress is not None:
            progress(len(days) - len(missing) + number, len(days))
    paths = (
        delivered_path(folder, instrument, day) for day in days for instrument in instruments_of(settings)
    )
    return [path for path in paths if path.exists()]


def write_day(settings: SimulationSettings, destination: Path, day: np.datetime64) -> list[Path]:
    """Simulate and write one day, the truth last; return the delivered files."""
    with threadpool_limits(limits=1), _storage(destination, day):
        simulated = simulate_day(settings, day)
        written = []
        for instrument, data in simulated.instruments.items():
            path = delivered_path(destination, instrument, day)
            with _atomic(path) as partial:
                _write_cdf(partial, instrument, data, day)
            written.append(path)
        _write_truth(truth_path(destination, day), simulated)
    return written


def preflight_model(text: str, settings: SimulationSettings) -> str:
    """Return the pre-flight model without the effects that are hidden or not in the data.

    Parameters
    ----------
    text : str
        The mission's pre-flight model YAML.
    settings : SimulationSettings
        Names the effects in `hide` and `without`.

    Returns
    -------
    str
        The model YAML a team would start from.
    """
    gone = {*settings.hide, *settings.without}
    yaml = YAML()
    yaml.width = 110
    tree = yaml.load(text)
    for index, entry in reversed(list(enumerate(tree["effects"]))):
        if entry["effect"] in gone:
            del tree["effects"][index]
    stream = io.StringIO()
    yaml.dump(tree, stream)
    return stream.getvalue()


def _written(
    settings: SimulationSettings, folder: Path, days: Sequence[np.datetime64], workers: int
) -> Iterator[list[Path]]:
    """Yield the files of each day as it is done."""
    if workers <= 1 or len(days) <= 1:
        for day in days:
            yield write_day(settings, folder, day)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        jobs = [pool.submit(write_day, settings, folder, day) for day in days]
        try:
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _claim(settings: SimulationSettings, folder: Path) -> None:
    """Write the settings into the truth folder, or check that those there are the same."""
    path = folder / TRUTH / "settings.json"
    wanted = settings.model_dump(mode="json")
    if path.exists():
        standard = SimulationSettings().model_dump(mode="json")
        found = standard | json.loads(path.read_text())
        differing = sorted(key for key in set(wanted) - _SPAN if found.get(key) != wanted.get(key))
        if differing:
            raise CatalogError(
                f"the folder holds a simulation with other {', '.join(differing)}",
                file=str(folder),
                remedy="choose an empty folder or the same settings",
            )
        return
    with _storage(folder, None), _atomic(path) as partial:
        truth = {"parameters": settings.parameters.as_dict(), "effects": sorted(settings.effects)}
        partial.write_text(json.dumps(wanted | {"truth": truth}, indent=1))


def _is_complete(settings: SimulationSettings, folder: Path, day: np.datetime64) -> bool:
    if not truth_path(folder, day).exists():
        return False
    there = [delivered_path(folder, instrument, day).exists() for instrument in instruments_of(settings)]
    return all(there) or "missing_days" in settings.defects


@contextmanager
def _atomic(path: Path) -> Iterator[Path]:
    """Give a temporary name in the same folder; rename it when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _storage(folder: Path, day: np.datetime64 | None) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"cannot write: {error}",
            file=str(folder),
            day="" if day is None else str(day),
            remedy="make room or choose another folder, then run again",
        ) from error


def _write_cdf(path: Path, instrument: str, data: xr.Dataset, day: np.datetime64) -> None:
    """Write one delivery as CDF with TT2000 and the attributes of the ISTP guidelines."""
    specification = {"Compressed": 0, "Majority": 1}
    with _undated_compression(), CDF(path, cdf_spec=specification, delete=True) as file:
        file.write_globalattrs(_global_attributes(instrument, day))
        file.write_var(
            _specification("Epoch", CDF.CDF_TIME_TT2000, ()), _epoch_attributes(day), data["Epoch"].values
        )
        for name, series in data.drop_vars("Epoch").items():
            described = _VARIABLES[str(name)]
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


def _write_labels(file: CDF, name: str, described: _Variable) -> None:
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


def _variable_attributes(name: str, described: _Variable) -> dict[str, Any]:
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


def _global_attributes(instrument: str, day: np.datetime64) -> dict[str, dict[int, str]]:
    name = f"champ_{instrument}_{_compact(day)}_v01"
    attributes = {
        "Project": "Simulation",
        "Source_name": "champ>CHAMP-like simulated spacecraft",
        "Discipline": "Space Physics>Magnetospheric Science",
        "Data_type": f"{instrument}>{_TITLES[instrument]}",
        "Descriptor": f"{instrument}>{_TITLES[instrument]}",
        "Data_version": "01",
        "Logical_file_id": name,
        "Logical_source": f"champ_{instrument}",
        "Logical_source_description": f"{_TITLES[instrument]}, level 1, simulated",
        "PI_name": "none",
        "PI_affiliation": "none",
        "TEXT": "Simulated measurements; no spacecraft made them.",
        "Instrument_type": "Magnetic Fields (space)",
        "Mission_group": "Simulation",
    }
    return {key: {0: value} for key, value in attributes.items()}


def _write_truth(path: Path, simulated: SimulatedDay) -> None:
    """Write every tenth sample of the truth: enough to judge by, and small."""
    step = max(1, round(10e9 / np.diff(simulated.truth["Epoch"].values[:2]).item()))
    thinned = simulated.truth.isel(record=slice(None, None, step))
    with _atomic(path) as partial:
        thinned.to_netcdf(partial, engine="h5netcdf")


def _compact(day: np.datetime64) -> str:
    return str(day).replace("-", "")
