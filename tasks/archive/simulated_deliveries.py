"""Simulated deliveries: day files as a real mission delivers them, and their truth in a folder of its own.

`simulate` takes the settings of a mission and writes CDF files with TT2000 and the attributes of the ISTP
guidelines. The measurements come from `inflight.simulate`: a vector and a scalar sensor (`CHAMP`), two
sensors on one boom (`VENUS_EXPRESS`), or a spinning spacecraft (`SPINNING`). A file appears under its name
only when it is complete, so that the same call completes a run that was stopped.
"""

from __future__ import annotations

import gzip
import json
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
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

from inflight.errors import CatalogError, StorageError
from inflight.simulate import FILL, MissionSettings, SimulatedDay, SimulationSettings, simulate_day
from inflight.simulate.dual import simulate_dual_day
from inflight.simulate.spinning import SPACECRAFT_PRESETS, SpinningSettings, simulate_spinning_day
from inflight.threads import one_thread
from inflight.time import TT2000_FILL, day_bounds

#: zlib level of the deliveries; higher ones save 3 % and cost twice the time.
_COMPRESSION = 1

#: Folder of the truth.
TRUTH = "truth"

_DTYPES: dict[int, type] = {
    CDF.CDF_DOUBLE: np.float64,
    CDF.CDF_REAL4: np.float32,
    CDF.CDF_UINT1: np.uint8,
}
_TYPE_NAMES = {CDF.CDF_DOUBLE: "CDF_DOUBLE", CDF.CDF_REAL4: "CDF_REAL4", CDF.CDF_UINT1: "CDF_UINT1"}


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

    def attributes(self, name: str) -> dict[str, Any]:
        """Return the attributes of the variable in a file."""
        kind = _TYPE_NAMES[self.kind]
        return {
            "CATDESC": self.description,
            "FIELDNAM": name,
            "UNITS": self.unit,
            "FORMAT": self.format,
            "FILLVAL": [255 if self.kind == CDF.CDF_UINT1 else FILL, kind],
            "VALIDMIN": [self.low, kind],
            "VALIDMAX": [self.high, kind],
            "DEPEND_0": "Epoch",
            "DISPLAY_TYPE": "time_series",
            "VAR_TYPE": "data",
        } | ({"LABL_PTR_1": f"{name}_LABEL"} if self.labels else {"LABLAXIS": name})


@dataclass(frozen=True)
class Spacecraft:
    """A simulated spacecraft and how its days become files.

    Attributes
    ----------
    name, description : str
        The name begins every file.
    titles : mapping of str to str
        What each instrument is.
    variables : mapping of str to Variable
    simulate : callable
        Takes settings and a day; a function of a module, so that other processes find it.
    """

    name: str
    description: str
    titles: Mapping[str, str]
    variables: Mapping[str, Variable]
    simulate: Callable[[Any, np.datetime64], SimulatedDay]

    def path(self, folder: Path, instrument: str, day: np.datetime64) -> Path:
        """Return the path of a delivered file: ``fgm/champ_fgm_20050101_v01.cdf``."""
        return folder / instrument / f"{self.name}_{instrument}_{str(day).replace('-', '')}_v01.cdf"

    def truth_path(self, folder: Path, day: np.datetime64) -> Path:
        """Return the path of the truth of a day, which only tests read."""
        return folder / TRUTH / f"{self.name}_truth_{str(day).replace('-', '')}.nc"

    def write_day(self, settings: MissionSettings, folder: Path, day: np.datetime64) -> None:
        """Simulate and write one day, the truth last, thinned to a sample every 10 s."""
        with one_thread(), storage_errors(folder, day):
            simulated = self.simulate(settings, day)
            for instrument, data in simulated.instruments.items():
                with atomic_write(self.path(folder, instrument, day)) as partial:
                    write_cdf(partial, self, instrument, data, day)
            truth = simulated.truth
            step = max(1, round(10e9 / np.diff(truth["Epoch"].values[:2]).item()))
            with atomic_write(self.truth_path(folder, day)) as partial:
                truth.isel(record=slice(None, None, step)).to_netcdf(partial, engine="h5netcdf")

    def write_days(
        self, settings: MissionSettings, folder: Path, days: Sequence[np.datetime64], workers: int
    ) -> Iterator[None]:
        """Write days in `workers` processes (1 stays in this one); yield after each."""
        if workers <= 1 or len(days) <= 1:
            for day in days:
                self.write_day(settings, folder, day)
                yield
            return
        with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
            jobs = [pool.submit(self.write_day, settings, folder, day) for day in days]
            try:
                for job in as_completed(jobs):
                    job.result()
                    yield
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary name in the same folder; rename it when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def storage_errors(folder: Path, day: np.datetime64 | None) -> Iterator[None]:
    """Turn a refused write into a `StorageError` that names folder and day."""
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"cannot write: {error}",
            file=str(folder),
            day="" if day is None else str(day),
            remedy="make room or choose another folder, then run again",
        ) from error


def write_cdf(path: Path, craft: Spacecraft, instrument: str, data: xr.Dataset, day: np.datetime64) -> None:
    """Write one delivery as CDF with TT2000 and the attributes of the ISTP guidelines."""
    with _undated_compression(), CDF(path, cdf_spec={"Compressed": 0, "Majority": 1}, delete=True) as file:
        file.write_globalattrs(_global_attributes(craft, instrument, day))
        (low, high), kind = day_bounds(day), "CDF_TIME_TT2000"
        bounds = {"FILLVAL": [int(TT2000_FILL), kind], "VALIDMIN": [low, kind], "VALIDMAX": [high, kind]}
        specification = _specification("Epoch", CDF.CDF_TIME_TT2000, ())
        file.write_var(specification, {**_EPOCH_ATTRIBUTES, **bounds, **_EPOCH_ROLE}, data["Epoch"].values)
        for name, series in data.drop_vars("Epoch").items():
            described = craft.variables[str(name)]
            if described.labels:
                _write_labels(file, str(name), described.labels)
            file.write_var(
                _specification(str(name), described.kind, series.shape[1:]),
                described.attributes(str(name)),
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


def _specification(name: str, kind: int, shape: Sequence[int]) -> dict[str, Any]:
    return {
        "Variable": name,
        "Data_Type": kind,
        "Num_Elements": 1,
        "Rec_Vary": True,
        "Dim_Sizes": list(shape),
        "Compress": _COMPRESSION,
    }


def _write_labels(file: CDF, name: str, axes: Sequence[str]) -> None:
    """Write the variable that names the components of another one."""
    labels = [f"{name}_{axis}" for axis in axes]
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


_EPOCH_ATTRIBUTES = {
    "CATDESC": "Time of the sample",
    "FIELDNAM": "Epoch",
    "UNITS": "ns",
    "LABLAXIS": "Epoch",
    "TIME_BASE": "J2000",
    "TIME_SCALE": "Terrestrial Time",
    "REFERENCE_POSITION": "Rotating Earth Geoid",
    "FORMAT": "I22",
}
_EPOCH_ROLE = {"VAR_TYPE": "support_data", "MONOTON": "INCREASE"}


def _global_attributes(craft: Spacecraft, instrument: str, day: np.datetime64) -> dict[str, dict[int, str]]:
    attributes = {
        "Project": "Simulation",
        "Source_name": f"{craft.name}>{craft.description}",
        "Discipline": "Space Physics>Magnetospheric Science",
        "Data_type": f"{instrument}>{craft.titles[instrument]}",
        "Descriptor": f"{instrument}>{craft.titles[instrument]}",
        "Data_version": "01",
        "Logical_file_id": craft.path(Path(), instrument, day).stem,
        "Logical_source": f"{craft.name}_{instrument}",
        "Logical_source_description": f"{craft.titles[instrument]}, level 1, simulated",
        "PI_name": "none",
        "PI_affiliation": "none",
        "TEXT": "Simulated measurements; no spacecraft made them.",
        "Instrument_type": "Magnetic Fields (space)",
        "Mission_group": "Simulation",
    }
    return {key: {0: value} for key, value in attributes.items()}


INSTRUMENTS = ("fgm", "ovm", "tq", "hk", "att", "orb")

SECOND_FLUXGATE = "fgm2"

_XYZ = ("x", "y", "z")

CHAMP = Spacecraft(
    "champ",
    "CHAMP-like simulated spacecraft",
    {
        "fgm": "Fluxgate magnetometer",
        SECOND_FLUXGATE: "Second fluxgate magnetometer",
        "ovm": "Overhauser magnetometer",
        "tq": "Magneto-torquer currents",
        "hk": "Housekeeping currents",
        "att": "Attitude",
        "orb": "Orbit",
    },
    {
        "FGM_RAW": Variable("Raw vector field, sensor axes", "nT", -65e3, 65e3, labels=_XYZ, format="F10.2"),
        "T_CSC": Variable("Temperature of the feedback coil", "degC", -60, 80, CDF.CDF_REAL4),
        "T_ADC": Variable("Temperature of the converter", "degC", -60, 80, CDF.CDF_REAL4),
        "FGM_FLAG": Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
        "F": Variable("Raw field strength", "nT", 15000, 65000, format="F10.2"),
        "F_OSC_RATIO": Variable("Oscillator frequency over nominal", " ", 0.999, 1.001, format="F14.10"),
        "I_TQ": Variable("Torquer currents", "mA", -500, 500, CDF.CDF_REAL4, labels=_XYZ),
        "I_SOL": Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
        "I_BAT": Variable("Battery current, positive when charging", "mA", -20000, 20000, CDF.CDF_REAL4),
        "I_CAM": Variable("Current of the boom star camera", "mA", 0, 2000, CDF.CDF_REAL4),
        "I_HTR": Variable("Heater current", "mA", 0, 2000, CDF.CDF_REAL4),
        "Q": Variable("Quaternion spacecraft to ITRF", " ", -1, 1, labels=(*_XYZ, "w"), format="F11.7"),
        "POS_ITRF": Variable("Position in ITRF", "km", -8000, 8000, labels=_XYZ, format="F13.5"),
    },
    simulate_day,
)

VENUS_EXPRESS = Spacecraft(
    "vex",
    "Venus-Express-like simulated spacecraft",
    {
        "ib": "Inboard fluxgate",
        "ob": "Outboard fluxgate",
        "hk": "Housekeeping currents",
        "slow": "Slow housekeeping",
        "mon": "Ambient field known from elsewhere",
    },
    {
        "B_RAW": Variable("Raw vector field, sensor axes", "nT", -8000, 8000, labels=_XYZ),
        "B": Variable("Ambient field, spacecraft axes", "nT", -8000, 8000, labels=_XYZ),
        "FLAG": Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
        "I_TX": Variable("Current of the transmitter", "mA", 0, 5000, CDF.CDF_REAL4),
        "I_SPEC": Variable("Current of the spectrometer", "mA", 0, 5000, CDF.CDF_REAL4),
        "I_CAM": Variable("Current of the camera", "mA", 0, 5000, CDF.CDF_REAL4),
        "I_ARRAY": Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
        "T_BODY": Variable("Temperature of the body", "degC", -60, 80, CDF.CDF_REAL4),
    },
    simulate_dual_day,
)

_SPINNING_TITLES = {
    "fgm": "Fluxgate magnetometer",
    "sun": "Sun sensor",
    "hk": "Housekeeping currents",
    "slow": "Slow housekeeping",
    "orb": "Orbit",
    "att": "Attitude",
}
_SPINNING_VARIABLES = {
    "FGM_RAW": Variable("Raw vector field, sensor axes", "nT", -65000, 65000, labels=_XYZ, format="F12.4"),
    "T_SENSOR": Variable("Temperature of the sensor", "degC", -120, 80, CDF.CDF_REAL4),
    "FGM_FLAG": Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
    "SPIN_PERIOD": Variable("Time since the last sun pulse", "s", 0, 100, format="F10.5"),
    "I_COIL": Variable("Current of the torquer coil", "mA", -500, 500, CDF.CDF_REAL4),
    "I_SOL": Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
    "T_ELECTRONICS": Variable("Temperature of the electronics", "degC", -60, 80, CDF.CDF_REAL4),
    "SHADOW": Variable("1 in the shadow of the Earth", " ", 0, 1, CDF.CDF_UINT1, format="I3"),
    "SPIN_AXIS": Variable(
        "Right ascension and declination of the spin axis",
        "deg",
        -90,
        360,
        labels=("ra", "dec"),
        format="F11.5",
    ),
    "POS_GSE": Variable("Position in GSE", "km", -200000, 200000, labels=_XYZ, format="F13.3"),
}

#: Spinning spacecraft by name.
SPINNING = {
    name: Spacecraft(
        name,
        f"{name.upper()}-like simulated spacecraft",
        _SPINNING_TITLES,
        _SPINNING_VARIABLES,
        simulate_spinning_day,
    )
    for name in SPACECRAFT_PRESETS
}


def simulate(
    settings: MissionSettings,
    destination: Path | str,
    progress: Callable[[int, int], None] | None = None,
    workers: int = 2,
) -> list[Path]:
    """Write the day files of a simulated mission that are not there yet.

    Files appear whole under their names, so a run that was stopped is completed by the same call;
    days already there are kept.

    Parameters
    ----------
    settings : SimulationSettings, DualSettings or SpinningSettings
        What to simulate.
    destination : Path
        For one folder an instrument (``fgm/``, ``ovm/``, ...) and, apart, ``truth/``.
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
    # Settings that may differ between two runs into one folder: effects may count from the first day.
    free: set[str] = {"days"}
    required: tuple[str, ...] = ()
    instruments: tuple[str, ...] = INSTRUMENTS
    if isinstance(settings, SimulationSettings):
        craft, free = CHAMP, {"days", "start"}
        if settings.second_fluxgate:
            instruments = (*INSTRUMENTS, SECOND_FLUXGATE)
        required = () if "missing_days" in settings.defects else instruments
    else:
        craft = SPINNING[settings.craft] if isinstance(settings, SpinningSettings) else VENUS_EXPRESS
        instruments = tuple(craft.titles)
    _claim(folder, settings, free)
    days = settings.day_list
    missing = [
        day
        for day in days
        if not all(
            path.exists()
            for path in (craft.truth_path(folder, day), *(craft.path(folder, name, day) for name in required))
        )
    ]
    there = len(days) - len(missing)
    if progress is not None:
        progress(there, len(days))
    for done, _ in enumerate(craft.write_days(settings, folder, missing, workers), start=there + 1):
        if progress is not None:
            progress(done, len(days))
    paths = (craft.path(folder, instrument, day) for day in days for instrument in instruments)
    return [path for path in paths if path.exists()]


def _claim(folder: Path, settings: MissionSettings, free: Collection[str]) -> None:
    """Write the settings of a simulation into the truth folder, or check that those there are the same."""
    path, own = folder / TRUTH / "settings.json", settings.model_dump(mode="json")
    if path.exists():
        # Folders of older versions do not name the settings that are new since.
        found = {**type(settings).model_validate({}).model_dump(mode="json"), **json.loads(path.read_text())}
        differing = sorted(key for key in set(own) - set(free) if found.get(key) != own.get(key))
        if differing:
            raise CatalogError(
                f"the folder holds a simulation with other {', '.join(differing)}",
                file=str(folder),
                remedy="choose an empty folder or the same settings",
            )
        return
    truth = {"parameters": settings.parameters.as_dict(), "effects": sorted(settings.effects)}
    with storage_errors(folder, None), atomic_write(path) as partial:
        partial.write_text(json.dumps({**own, "truth": truth}, indent=1))
