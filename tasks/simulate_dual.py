"""Write a simulated mission with two sensors on one boom as day files, and its truth apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cdflib.cdfwrite import CDF

from inflight.simulate.dual import DualSettings, simulate_dual_day
from inflight.tasks.delivered_cdf import Source, Variable
from inflight.tasks.simulated_days import DayWriter, Progress

_XYZ = ("x", "y", "z")
_VARIABLES = {
    "B_RAW": Variable("Raw vector field, sensor axes", "nT", -8000, 8000, labels=_XYZ),
    "B": Variable("Ambient field, spacecraft axes", "nT", -8000, 8000, labels=_XYZ),
    "FLAG": Variable("Quality flag, 0 is good", " ", 0, 254, CDF.CDF_UINT1, format="I3"),
    "I_TX": Variable("Current of the transmitter", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_SPEC": Variable("Current of the spectrometer", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_CAM": Variable("Current of the camera", "mA", 0, 5000, CDF.CDF_REAL4),
    "I_ARRAY": Variable("Current of the solar array", "mA", 0, 20000, CDF.CDF_REAL4),
    "T_BODY": Variable("Temperature of the body", "degC", -60, 80, CDF.CDF_REAL4),
}
_TITLES = {
    "ib": "Inboard fluxgate",
    "ob": "Outboard fluxgate",
    "hk": "Housekeeping currents",
    "slow": "Slow housekeeping",
    "mon": "Ambient field known from elsewhere",
}
#: Whose files they are.
SOURCE = Source("vex", "Venus-Express-like simulated spacecraft", _TITLES, _VARIABLES)
_WRITER = DayWriter(SOURCE, simulate_dual_day)


def truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return where the truth of a day stands, for tests and nobody else."""
    return _WRITER.truth_path(destination, day)


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
    return _WRITER.write(settings, Path(destination), tuple(_TITLES), progress=progress, workers=workers)
