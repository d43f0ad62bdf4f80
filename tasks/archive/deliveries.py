"""Simulated deliveries: day files as a real mission delivers them, and their truth apart.

CDF with TT2000 and the attributes of the ISTP guidelines, from `inflight.simulate`: of a mission with a
vector and a scalar sensor (`simulate`), with two sensors on one boom (`simulate_dual`), of a spinning one
(`simulate_spinning`). Files appear whole under their names, so that a run that was stopped is completed by
the same call.
"""

from __future__ import annotations

import gzip
import io
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
from ruamel.yaml import YAML
from threadpoolctl import threadpool_limits

from inflight.errors import CatalogError, StorageError
from inflight.simulate import FILL, MissionSettings, SimulatedDay, SimulationSettings, simulate_day
from inflight.simulate.dual import DualSettings, simulate_dual_day
from inflight.simulate.spinning import CRAFT, SpinningSettings, simulate_spinning_day
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
        """Return the path of a delivered file: ``fgm/champ_fgm_20050101_v01.cdf``."""
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


#: Called with the number of days done and of all days.
Progress = Callable[[int, int], None]

TRUTH = "truth"

#: What may differ between two runs into one folder where something counts from the first day: the end.
LATER_END = frozenset({"days"})


@dataclass(frozen=True)
class DayWriter:
    """How the days of a simulated spacecraft become files.

    Attributes
    ----------
    source : Source
        Whose files they are.
    simulate : callable
        Takes settings and a day; a function of a module, so that other processes find it.
    """

    source: Source
    simulate: Callable[[Any, np.datetime64], SimulatedDay]

    def truth_path(self, destination: Path, day: np.datetime64) -> Path:
        """Return the path of the truth of a day, which only tests read."""
        return destination / TRUTH / f"{self.source.name}_truth_{compact(day)}.nc"

    def write(
        self,
        settings: MissionSettings,
        folder: Path,
        instruments: Sequence[str],
        *,
        needed: Collection[str] = (),
        free: Collection[str] = LATER_END,
        standard: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
        workers: int = 2,
    ) -> list[Path]:
        """Write the days that are not there yet.

        Parameters
        ----------
        settings : MissionSettings
            What to simulate.
        folder : Path
            For one folder an instrument and, apart, ``truth/``.
        instruments : sequence of str
            In the order of the paths returned; those that deliver nothing are passed over.
        needed : collection of str
            Instruments whose missing file has the whole day written again.
        free : collection of str
            Settings that may differ between two runs into one folder: they only widen the span.
        standard : mapping, optional
            Settings that older folders do not name.
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
        _claim(folder, settings, standard or {}, free)
        days = settings.day_list
        missing = [day for day in days if not self._is_complete(folder, needed, day)]
        for number, _ in enumerate(self._written(settings, folder, missing, workers), start=1):
            if progress is not None:
                progress(len(days) - len(missing) + number, len(days))
        paths = (self.source.path(folder, instrument, day) for day in days for instrument in instruments)
        return [path for path in paths if path.exists()]

    def write_day(self, settings: MissionSettings, folder: Path, day: np.datetime64) -> None:
        """Simulate and write one day, the truth last."""
        with threadpool_limits(limits=1), storage(folder, day):
            simulated = self.simulate(settings, day)
            for instrument, data in simulated.instruments.items():
                with atomic(self.source.path(folder, instrument, day)) as partial:
                    write_cdf(partial, self.source, instrument, data, day)
            _write_truth(self.truth_path(folder, day), simulated.truth)

    def _is_complete(self, folder: Path, needed: Collection[str], day: np.datetime64) -> bool:
        files = [self.truth_path(folder, day), *(self.source.path(folder, name, day) for name in needed)]
        return all(path.exists() for path in files)

    def _written(
        self, settings: MissionSettings, folder: Path, days: Sequence[np.datetime64], workers: int
    ) -> Iterator[None]:
        """Yield after each day that is written."""
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


def _claim(
    folder: Path, settings: MissionSettings, standard: Mapping[str, Any], free: Collection[str]
) -> None:
    """Write the settings of a simulation into the truth folder, or check that those there are the same."""
    path, own = folder / TRUTH / "settings.json", settings.model_dump(mode="json")
    if path.exists():
        found = {**standard, **json.loads(path.read_text())}
        differing = sorted(key for key in set(own) - set(free) if found.get(key) != own.get(key))
        if differing:
            raise CatalogError(
                f"the folder holds a simulation with other {', '.join(differing)}",
                file=str(folder),
                remedy="choose an empty folder or the same settings",
            )
        return
    truth = {"parameters": settings.parameters.as_dict(), "effects": sorted(settings.effects)}
    with storage(folder, None), atomic(path) as partial:
        partial.write_text(json.dumps({**own, "truth": truth}, indent=1))


def _write_truth(path: Path, truth: xr.Dataset) -> None:
    """Write every tenth sample of the truth: enough to judge by, and small."""
    step = max(1, round(10e9 / np.diff(truth["Epoch"].values[:2]).item()))
    thinned = truth.isel(record=slice(None, None, step))
    with atomic(path) as partial:
        thinned.to_netcdf(partial, engine="h5netcdf")


INSTRUMENTS = ("fgm", "ovm", "tq", "hk", "att", "orb")

SECOND_FLUXGATE = "fgm2"

#: Settings that may differ between two runs into one folder: they only widen the span.
_SPAN = frozenset({"start", "days"})

_XYZ = ("x", "y", "z")

_VARIABLES = {
    "FGM_RAW": Variable("Raw vector field, sensor axes", "nT", -65000, 65000, labels=_XYZ, format="F10.2"),
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
    "Q": Variable("Quaternion spacecraft to ITRF", " ", -1, 1, labels=("x", "y", "z", "w"), format="F11.7"),
    "POS_ITRF": Variable("Position in ITRF", "km", -8000, 8000, labels=_XYZ, format="F13.5"),
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

_WRITER = DayWriter(Source("champ", "CHAMP-like simulated spacecraft", _TITLES, _VARIABLES), simulate_day)


def instruments_of(settings: SimulationSettings) -> tuple[str, ...]:
    """Return the instruments a simulated mission delivers."""
    return (*INSTRUMENTS, SECOND_FLUXGATE) if settings.second_fluxgate else INSTRUMENTS


def delivered_path(destination: Path, instrument: str, day: np.datetime64) -> Path:
    """Return the path of a delivered file: ``fgm/champ_fgm_20050101_v01.cdf``."""
    return _WRITER.source.path(destination, instrument, day)


def truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return the path of the truth of a day, which only tests read."""
    return _WRITER.truth_path(destination, day)


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
    instruments = instruments_of(settings)
    return _WRITER.write(
        settings,
        Path(destination),
        instruments,
        needed=() if "missing_days" in settings.defects else instruments,
        free=_SPAN,
        standard=SimulationSettings().model_dump(mode="json"),
        progress=progress,
        workers=workers,
    )


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


_DUAL_VARIABLES = {
    "B_RAW": Variable("Raw vector field, sensor axes", "nT", -8000, 8000, labels=_XYZ),
    "B": Variable("Ambient field, spacecraft axes", "nT", -8000, 8000, labels=_XYZ),
    "FLAG": Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
    "I_TX": Variable("Current of the transmitter", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_SPEC": Variable("Current of the spectrometer", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_CAM": Variable("Current of the camera", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_ARRAY": Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
    "T_BODY": Variable("Temperature of the body", "degC", -60, 80, CDF.CDF_REAL4),
}

_DUAL_TITLES = {
    "ib": "Inboard fluxgate",
    "ob": "Outboard fluxgate",
    "hk": "Housekeeping currents",
    "slow": "Slow housekeeping",
    "mon": "Ambient field known from elsewhere",
}

#: Whose files they are.
SOURCE = Source("vex", "Venus-Express-like simulated spacecraft", _DUAL_TITLES, _DUAL_VARIABLES)

_DUAL_WRITER = DayWriter(SOURCE, simulate_dual_day)


def dual_truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return the path of the truth of a day, which only tests read."""
    return _DUAL_WRITER.truth_path(destination, day)


def simulate_dual(
    settings: DualSettings, destination: Path | str, progress: Progress | None = None, workers: int = 2
) -> list[Path]:
    """Write the day files of a simulated mission with two sensors; days already there are kept.

    Parameters
    ----------
    destination : Path
        Folder for ``ib/``, ``ob/``, ``hk/``, ``slow/``, ``mon/`` and, apart, ``truth/``.
    progress : callable, optional
        Called with (days done, days).
    workers : int
        Processes; 1 stays in this one.

    Returns
    -------
    list of Path
        The delivered files of all days.

    Raises
    ------
    CatalogError
        When the folder holds files of other settings.
    StorageError
        When the disk refuses a write.
    """
    return _DUAL_WRITER.write(
        settings, Path(destination), tuple(_DUAL_TITLES), progress=progress, workers=workers
    )


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

_SPINNING_TITLES = {
    "fgm": "Fluxgate magnetometer",
    "sun": "Sun sensor",
    "hk": "Housekeeping currents",
    "slow": "Slow housekeeping",
    "orb": "Orbit",
    "att": "Attitude",
}

SOURCES = {
    name: Source(name, f"{name.upper()}-like simulated spacecraft", _SPINNING_TITLES, _SPINNING_VARIABLES)
    for name in CRAFT
}


def _writer(settings: SpinningSettings) -> DayWriter:
    return DayWriter(SOURCES[settings.craft], simulate_spinning_day)


def spinning_truth_path(settings: SpinningSettings, destination: Path, day: np.datetime64) -> Path:
    """Return the path of the truth of a day, which only tests read."""
    return _writer(settings).truth_path(destination, day)


def simulate_spinning(
    settings: SpinningSettings,
    destination: Path | str,
    progress: Progress | None = None,
    workers: int = 2,
) -> list[Path]:
    """Write the day files of a simulated spinning mission; days already there are kept.

    Parameters
    ----------
    settings : SpinningSettings
        What to simulate.
    destination : Path
        Folder for one folder an instrument and, apart, ``truth/``.
    progress : callable, optional
        Called with (days done, days).
    workers : int
        Processes; 1 stays in this one.

    Returns
    -------
    list of Path
        The delivered files of all days.

    Raises
    ------
    CatalogError
        When the folder holds files of other settings.
    StorageError
        When the disk refuses a write.
    """
    return _writer(settings).write(
        settings, Path(destination), tuple(_SPINNING_TITLES), progress=progress, workers=workers
    )
