"""Files that tests deliver, written with the format libraries themselves, and missions that describe them."""

from pathlib import Path

import cdflib.cdfwrite
import numpy as np

from inflight.mission import Mission
from inflight.time import day_bounds

TT2000, EPOCH, EPOCH16 = 33, 31, 32
DOUBLE, FLOAT, INT4, CHAR = 45, 44, 4, 51

MISSION = """
mission: probe
instruments:
  fgm:
    role: vector
    cadence: 60 s
    files: {pattern: "fgm_{day:%Y%m%d}_v*.cdf", reader: cdf, time: Epoch}
    channels:
      field: {variable: B, unit: nT, axes: [x, y, z]}
      temperature: {variable: T, unit: degC, kind: temperature}
comparisons:
  main: {kind: spin, vector: fgm}
"""


def mission_with(*pairs: tuple[str, str]) -> Mission:
    """Return the mission above with pieces of its text replaced."""
    text = MISSION
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return Mission.parse(text)


def day_times(day: str, cadence_s: int = 60) -> np.ndarray:
    start, end = day_bounds(day)
    return np.arange(start, end, cadence_s * 10**9, dtype=np.int64)


def field_of(times: np.ndarray) -> np.ndarray:
    """A field that is a function of time alone, so that overlapping files agree."""
    phase = (times % (5580 * 10**9)) / 5580e9 * 2 * np.pi
    return np.stack([20000 * np.sin(phase), 20000 * np.cos(phase), 30000 + 1000 * np.sin(2 * phase)], axis=1)


class CdfWriter(cdflib.cdfwrite.CDF):
    """cdflib's writer, which gives each EPOCH16 two records: one for the seconds, one for the picoseconds."""

    def _convert_data(self, data_type, num_elems, num_values, indata):
        if data_type == EPOCH16:
            pairs = np.asarray(indata, dtype=f"{self._convert_option()}f8")
            return pairs.size // 2, pairs.tobytes()
        return super()._convert_data(data_type, num_elems, num_values, indata)


def write_cdf(path: Path, variables: dict, *, compress: bool = False) -> Path:
    """Write a CDF: name -> (values, CDF type, attributes)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    target = CdfWriter(path, cdf_spec={"Compressed": 6 if compress else 0}, delete=True)
    for name, (given, kind, attributes) in variables.items():
        values = np.asarray(given)
        description = {
            "Variable": name,
            "Data_Type": kind,
            "Num_Elements": 1,
            "Rec_Vary": True,
            "Dim_Sizes": list(values.shape[1:]),
            "Compress": 0,
        }
        target.write_var(description, var_attrs=attributes, var_data=values)
    target.close()
    return path


def write_fgm(folder: Path, day: str, times=None, field=None, version: str = "01", **extra) -> Path:
    """Write the day file the mission above expects; `extra` overrides or adds variables."""
    times = day_times(day) if times is None else np.asarray(times, dtype=np.int64)
    field = field_of(times) if field is None else field
    variables = {
        "Epoch": (times, TT2000, {}),
        "B": (field, DOUBLE, {"UNITS": "nT", "FILLVAL": -1e31}),
        "T": (np.full(times.size, 20.5), DOUBLE, {"UNITS": "degC"}),
    }
    for name, replacement in extra.items():
        if replacement is None:
            del variables[name]
        else:
            variables[name] = replacement
    return write_cdf(folder / f"fgm_{day.replace('-', '')}_v{version}.cdf", variables)
