"""Write a simulated spinning mission as day files like a real one delivers, and its truth apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cdflib.cdfwrite import CDF

from inflight.simulate.spinning import CRAFT, SpinningSettings, simulate_spinning_day
from inflight.tasks.delivered_cdf import Source, Variable
from inflight.tasks.simulated_days import DayWriter, Progress

_XYZ = ("x", "y", "z")
_VARIABLES = {
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
_TITLES = {
    "fgm": "Fluxgate magnetometer",
    "sun": "Sun sensor",
    "hk": "Housekeeping currents",
    "slow": "Slow housekeeping",
    "orb": "Orbit",
    "att": "Attitude",
}
SOURCES = {
    name: Source(name, f"{name.upper()}-like simulated spacecraft", _TITLES, _VARIABLES) for name in CRAFT
}


def _writer(settings: SpinningSettings) -> DayWriter:
    return DayWriter(SOURCES[settings.craft], simulate_spinning_day)


def truth_path(settings: SpinningSettings, destination: Path, day: np.datetime64) -> Path:
    """Return where the truth of a day stands, for tests and nobody else."""
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
        settings, Path(destination), tuple(_TITLES), progress=progress, workers=workers
    )
