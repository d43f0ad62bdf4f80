from .calibration import NormalEquations
from .effects import Effect, Parameter
from .flags import Flag
from .mission import Mission, Sensor
from .model import Model
from .samples import align

__version__: str

__all__ = [
    "Effect",
    "Flag",
    "Mission",
    "Model",
    "NormalEquations",
    "Parameter",
    "Sensor",
    "align",
]
