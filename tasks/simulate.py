"""Write a simulated mission as day files like a real one delivers, and its truth apart."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from cdflib.cdfwrite import CDF
from ruamel.yaml import YAML
from threadpoolctl import threadpool_limits

from inflight.errors import CatalogError
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.delivered_cdf import Source, Variable, atomic, compact, storage, write_cdf

#: Called with the number of days done and of all days.
Progress = Callable[[int, int], None]
INSTRUMENTS = ("fgm", "ovm", "tq", "hk", "att", "orb")
SECOND_FLUXGATE = "fgm2"
TRUTH = "truth"
#: Settings that may differ between two runs into one folder: they only widen the span.
_SPAN = {"start", "days"}


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
_SOURCE = Source("champ", "CHAMP-like simulated spacecraft", _TITLES, _VARIABLES)


def instruments_of(settings: SimulationSettings) -> tuple[str, ...]:
    """Return the instruments a simulated mission delivers."""
    return (*INSTRUMENTS, SECOND_FLUXGATE) if settings.second_fluxgate else INSTRUMENTS


def delivered_path(destination: Path, instrument: str, day: np.datetime64) -> Path:
    """Return where a delivered file stands: ``fgm/champ_fgm_20050101_v01.cdf``."""
    return _SOURCE.path(destination, instrument, day)


def truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return where the truth of a day stands, for tests and nobody else."""
    return destination / TRUTH / f"champ_truth_{compact(day)}.nc"


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
    truth = {"parameters": settings.parameters.as_dict(), "effects": sorted(settings.effects)}
    claim(
        folder, settings.model_dump(mode="json"), truth, SimulationSettings().model_dump(mode="json"), _SPAN
    )
    days = settings.day_list
    missing = [day for day in days if not _is_complete(settings, folder, day)]
    for number, _ in enumerate(written(write_day, settings, folder, missing, workers), start=1):
        if progress is not None:
            progress(len(days) - len(missing) + number, len(days))
    paths = (
        delivered_path(folder, instrument, day) for day in days for instrument in instruments_of(settings)
    )
    return [path for path in paths if path.exists()]


def write_day(settings: SimulationSettings, destination: Path, day: np.datetime64) -> list[Path]:
    """Simulate and write one day, the truth last; return the delivered files."""
    with threadpool_limits(limits=1), storage(destination, day):
        simulated = simulate_day(settings, day)
        paths = []
        for instrument, data in simulated.instruments.items():
            path = delivered_path(destination, instrument, day)
            with atomic(path) as partial:
                write_cdf(partial, _SOURCE, instrument, data, day)
            paths.append(path)
        write_truth(truth_path(destination, day), simulated.truth)
    return paths


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


def written(
    write: Callable[..., list[Path]],
    settings: Any,
    folder: Path,
    days: Sequence[np.datetime64],
    workers: int,
) -> Iterator[list[Path]]:
    """Yield the files of each day as `write(settings, folder, day)` has made them."""
    if workers <= 1 or len(days) <= 1:
        for day in days:
            yield write(settings, folder, day)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        jobs = [pool.submit(write, settings, folder, day) for day in days]
        try:
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def claim(
    folder: Path,
    wanted: Mapping[str, Any],
    truth: Mapping[str, Any],
    standard: Mapping[str, Any],
    span: set[str],
) -> None:
    """Write the settings of a simulation into the truth folder, or check that those there are the same.

    Parameters
    ----------
    wanted, truth : mapping
        Settings, and what they make of the simulation.
    standard : mapping
        Settings that older folders do not name.
    span : set of str
        Settings that may differ between two runs into one folder: they only widen the span.
    """
    path = folder / TRUTH / "settings.json"
    if path.exists():
        found = {**standard, **json.loads(path.read_text())}
        differing = sorted(key for key in set(wanted) - span if found.get(key) != wanted.get(key))
        if differing:
            raise CatalogError(
                f"the folder holds a simulation with other {', '.join(differing)}",
                file=str(folder),
                remedy="choose an empty folder or the same settings",
            )
        return
    with storage(folder, None), atomic(path) as partial:
        partial.write_text(json.dumps({**wanted, "truth": dict(truth)}, indent=1))


def _is_complete(settings: SimulationSettings, folder: Path, day: np.datetime64) -> bool:
    if not truth_path(folder, day).exists():
        return False
    there = [delivered_path(folder, instrument, day).exists() for instrument in instruments_of(settings)]
    return all(there) or "missing_days" in settings.defects


def write_truth(path: Path, truth: xr.Dataset) -> None:
    """Write every tenth sample of the truth: enough to judge by, and small."""
    step = max(1, round(10e9 / np.diff(truth["Epoch"].values[:2]).item()))
    thinned = truth.isel(record=slice(None, None, step))
    with atomic(path) as partial:
        thinned.to_netcdf(partial, engine="h5netcdf")
