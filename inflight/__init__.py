"""In-flight calibration of magnetometers: pure physics over numpy and xarray.

The package itself opens no file. Storage lives in :mod:`inflight.catalog`, pipeline steps in
:mod:`inflight.tasks`, Prefect flows in :mod:`inflight.flows`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from inflight.calibration import NormalEquations
    from inflight.effects import Effect, Parameter
    from inflight.flags import Flag
    from inflight.mission import Mission, Sensor
    from inflight.model import Model
    from inflight.samples.alignment import align

#: Where the public names are defined; they are imported when they are first asked for.
_HOMES = {
    "align": "alignment",
    "NormalEquations": "calibration",
    "Effect": "effects",
    "Parameter": "effects",
    "Flag": "flags",
    "Mission": "mission",
    "Model": "model",
    "Sensor": "sensors",
}
__all__ = ["Effect", "Flag", "Mission", "Model", "NormalEquations", "Parameter", "Sensor", "align"]


def __getattr__(name: str) -> Any:
    """Import a public name: the command line must not wait for numpy to print its help."""
    if name not in _HOMES:
        raise AttributeError(f"module 'inflight' has no attribute {name!r}")
    return getattr(import_module(f"inflight.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
