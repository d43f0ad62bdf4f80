from .check import find_faults
from .findings import Finding, Remedy
from .records import PLUMBING_SETTINGS, PlumbingSettings, Record, Survey

__all__ = [
    "PLUMBING_SETTINGS",
    "Finding",
    "PlumbingSettings",
    "Record",
    "Remedy",
    "Survey",
    "find_faults",
]
