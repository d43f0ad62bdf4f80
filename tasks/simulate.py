"""Write a simulated mission as day files like a real one delivers, and its truth apart."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from cdflib.cdfwrite import CDF
from ruamel.yaml import YAML

from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.delivered_cdf import Source, Variable
from inflight.tasks.simulated_days import DayWriter, Progress

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
    """Return where a delivered file stands: ``fgm/champ_fgm_20050101_v01.cdf``."""
    return _WRITER.source.path(destination, instrument, day)


def truth_path(destination: Path, day: np.datetime64) -> Path:
    """Return where the truth of a day stands, for tests and nobody else."""
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
