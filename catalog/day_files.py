"""Files of one day for a release: ISTP CDF and CF NetCDF, made from a day as it stands in the catalog.

In go the day's Dataset and a `DayHeader` (what the file says of itself, from the mission YAML and the
catalog); out comes one file. Its bytes follow from these and from the software alone: no clock, no names of
this machine.

References: ISTP/IACG guidelines of NASA's Space Physics Data Facility for global and variable attributes; CF
conventions 1.11 with the attributes for discovery (ACDD 1.3).
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from inflight import __version__
from inflight.catalog.descriptions import (
    components,
    flags_of,
    frame_of,
    sorted_names,
    takes_uncertainty,
    text_of,
    with_flag_meanings,
)
from inflight.errors import CatalogError, IntegrityError
from inflight.mission import Mission
from inflight.time import SECOND, usual_step

if TYPE_CHECKING:
    import xarray as xr

Array = npt.NDArray[Any]

#: ISTP's fill of real numbers.
CDF_FILL: Final = -1.0e31
#: The largest valid field where the mission states no range, nT: ten times that of any planet but Jupiter.
WIDEST_FIELD: Final = 1.0e6
#: gzip; higher levels take twice the time for 1 %.
_CDF_LEVEL, _NETCDF_LEVEL = 4, 4

_LEVELS: Final = {"l1": "L1>Level 1, as delivered", "l2": "L2>Level 2, calibrated"}
#: Unit -> factor and SI unit, where a factor is all there is between them.
_SI: Final = {
    "nT": "1.0e-9>T",
    "ns": "1.0e-9>s",
    "s": "1.0>s",
    "deg": "1.745329252e-2>rad",
    "rad": "1.0>rad",
    "km": "1.0e3>m",
    "m": "1.0>m",
    "A": "1.0>A",
    "mA": "1.0e-3>A",
    "V": "1.0>V",
    "K": "1.0>K",
}
#: Unit -> smallest and largest valid value, where the unit alone says them.
_LIMITS: Final = {
    "deg": (-360.0, 360.0),
    "rad": (-2.0 * math.pi, 2.0 * math.pi),
    "degC": (-273.15, 1.0e4),
    "K": (0.0, 1.0e4),
}
#: Attributes of a product that say what it was made with; in a CDF their names begin with a capital.
_MADE_WITH: Final = (
    "calibration_method",
    "calibration_model",
    "calibration_table",
    "calibration_range",
    "calibration_context",
    "calibration_coefficients",
    "typical_values",
    "exclusions",
)
_CF_UNITS: Final = {"deg": "degree", "latitude": "degrees_north", "longitude": "degrees_east"}


class _CdfType(NamedTuple):
    """How values of a numpy dtype are stored in a CDF."""

    name: str
    number: int
    fill: float | int
    form: str


_CDF_TYPES: Final = {
    "f4": _CdfType("CDF_REAL4", 21, CDF_FILL, "E14.6"),
    "f8": _CdfType("CDF_REAL8", 22, CDF_FILL, "E23.15"),
    "i1": _CdfType("CDF_INT1", 1, -(2**7), "I4"),
    "i2": _CdfType("CDF_INT2", 2, -(2**15), "I6"),
    "i4": _CdfType("CDF_INT4", 4, -(2**31), "I11"),
    "i8": _CdfType("CDF_INT8", 8, -(2**63), "I20"),
    "u1": _CdfType("CDF_UINT1", 11, 2**8 - 1, "I3"),
    "u2": _CdfType("CDF_UINT2", 12, 2**16 - 1, "I5"),
    "u4": _CdfType("CDF_UINT4", 14, 2**32 - 1, "I10"),
    "b1": _CdfType("CDF_UINT1", 11, 2**8 - 1, "I1"),
}
_TT2000_FILL: Final = -(2**63)


@dataclass(frozen=True, kw_only=True)
class DayHeader:
    """What a day's file says of itself.

    Attributes
    ----------
    mission : Mission
        Its key ``release`` states discipline, people and rules.
    dataset, day_version : str
        In the catalog.
    day : datetime64[D]
    version : str
        ``vXX.YY`` of the release.
    generated : str
        ``yyyymmdd``; see `inflight.catalog.release`.
    parents : tuple of str
        ``CDF>logical_file_id`` of files of the release, or ``kind>name`` of what is none.
    maturity : str
        Of the products of the release.
    """

    mission: Mission
    dataset: str
    day: np.datetime64
    version: str
    day_version: str
    generated: str
    parents: tuple[str, ...] = ()
    maturity: str = "preliminary"

    @property
    def source(self) -> str:
        """ISTP's Logical_source, such as ``champ_l2_field-definitive``."""
        return logical_source(self.mission, self.dataset, self.maturity)

    @property
    def stem(self) -> str:
        """ISTP's Logical_file_id: the file's name without its ending."""
        return logical_file_id(self.mission, self.dataset, self.day, self.version, self.maturity)


def file_version(version: str) -> str:
    """Return ``v01.00`` of release 1.0: two numbers below 100, written without leading zeros.

    Raises
    ------
    CatalogError
        When the version is no such pair, so that no two releases share a file name.
    """
    found = re.fullmatch(r"(0|[1-9]\d?)\.(0|[1-9]\d?)", version)
    if found is None:
        raise CatalogError(
            f"release version {version!r} gives no vXX.YY for the names of files",
            remedy="use two numbers below 100 without leading zeros, as in '1.0'",
        )
    return f"v{int(found[1]):02d}.{int(found[2]):02d}"


def logical_source(mission: Mission, dataset: str, maturity: str) -> str:
    """Return source, data type and descriptor of a dataset, such as ``champ_l2_field-definitive``.

    What was delivered, ``champ_l1_fgm``, has no maturity.
    """
    short = mission.release.source_name.partition(">")[0]
    return f"{short}_{dataset.replace('/', '_')}{_checked(dataset, maturity)}".lower()


def _checked(dataset: str, maturity: str) -> str:
    """Return what a descriptor tells of the maturity."""
    return f"-{maturity}" if dataset.startswith("l2/") else ""


def logical_file_id(
    mission: Mission, dataset: str, day: np.datetime64, version: str, maturity: str = "preliminary"
) -> str:
    """Return a file's name without its ending, such as ``champ_l2_field-definitive_20050101_v01.00``."""
    return f"{logical_source(mission, dataset, maturity)}_{str(day).replace('-', '')}_{version}"


def write_cdf(path: Path, dataset: xr.Dataset, header: DayHeader) -> None:
    """Write a day as an ISTP CDF, and compare every value with what was written.

    Parameters
    ----------
    path : Path
        Ends in ``.cdf``.
    dataset : xarray.Dataset
        With int64 `tt2000` (time).
    header : DayHeader

    Raises
    ------
    IntegrityError
        When what is read back is not what was written.
    OSError
        When the disk refuses it.
    """
    content = with_flag_meanings(dataset)
    _write_cdf(path, content, header)
    _check_cdf(path, content, header)


def write_netcdf(path: Path, dataset: xr.Dataset, header: DayHeader) -> None:
    """Write a day as a CF NetCDF-4 file; parameters and errors are those of `write_cdf`.

    `time` counts seconds of UTC since the day began, as CF has it: stamps in a leap second repeat the second
    before. `tt2000` is exact.
    """
    import xarray as xr

    content = _cf_dataset(with_flag_meanings(dataset), header)
    encoding = {
        name: {"zlib": True, "complevel": _NETCDF_LEVEL, "shuffle": True}
        | {"_FillValue": np.nan if array.dtype.kind == "f" and name != "time" else None}
        for name, array in content.variables.items()
        if array.dtype.kind in "fiu" and array.ndim
    }
    # In memory first: on a full disk the HDF5 library ends the process.
    path.write_bytes(content.to_netcdf(engine="h5netcdf", format="NETCDF4", encoding=encoding))
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as found:
        for name, array in content.variables.items():
            _require_equal(np.asarray(found[name].values), array.values, path, header, str(name))


def _require_equal(found: Array, expected: Array, path: Path, header: DayHeader, name: str) -> None:
    same = found.size == expected.size and np.array_equal(
        found.reshape(expected.shape), expected, equal_nan=expected.dtype.kind == "f"
    )
    if not same:
        raise IntegrityError(
            f"the file of {header.dataset} reads back differently from what was written",
            file=path.name,
            channel=name,
            day=str(header.day),
            remedy="check the disk, then run again",
        )


def _valid_range(name: str, array: xr.DataArray, mission: Mission) -> tuple[float, float]:
    """Return the smallest and largest valid value, by unit; of fields by the mission's own ranges."""
    unit = str(array.attrs.get("units", ""))
    if name in {"latitude", "longitude"}:
        return (-90.0, 90.0) if name == "latitude" else (-180.0, 360.0)
    if unit == "nT":
        # Readings end at the range; turned into other axes and scaled, a component stays below twice that.
        ranges = [
            item.channels["field"].range
            for item in mission.instruments.values()
            if item.channels.get("field")
        ]
        stated = [abs(end) for pair in ranges if pair for end in pair]
        widest = 2.0 * max(stated) if len(stated) == 2 * len(ranges) else WIDEST_FIELD
        return (0.0 if name == "uncertainty" else -widest, widest)
    if "flag_masks" in array.attrs:
        return 0, int(np.bitwise_or.reduce(np.asarray(array.attrs["flag_masks"], dtype=np.int64)))
    return _LIMITS.get(unit, (-1.0e30, 1.0e30))


def _flag_notes(attributes: Mapping[str, Any]) -> str:
    pairs = (f"{mask} {meaning}" for mask, meaning in flags_of(attributes))
    return "Quality bits, 0 is good: " + ", ".join(pairs)


# --- CDF ---------------------------------------------------------------------------------------------


def cdf_writer(path: Path) -> Any:
    """Return cdflib's writer of a new file, as a context manager; its bytes do not tell when it was made."""
    import cdflib.cdfwrite

    class Writer(cdflib.cdfwrite.CDF):  # type: ignore[misc]
        """cdflib's writer without the time of day that gzip puts into the head of each block."""

        def _write_cvvr(self, f: Any, data: bytes) -> int:
            # RFC 1952: MTIME is bytes 4 to 7; the tenth names the machine's system, 255 is unknown.
            return int(super()._write_cvvr(f, data[:4] + bytes(4) + data[8:9] + b"\xff" + data[10:]))

    # Little-endian whatever the machine.
    return Writer(path, {"Majority": "row_major", "Encoding": 6, "Checksum": True})


def _write_cdf(path: Path, dataset: xr.Dataset, header: DayHeader) -> None:
    with cdf_writer(path) as writer:
        writer.write_globalattrs(
            {key: dict(enumerate(map(_ascii, values))) for key, values in _istp(dataset, header).items()}
        )
        stamps = np.asarray(dataset["tt2000"].values, dtype=np.int64)
        put_numbers(writer, "Epoch", 33, stamps, _epoch_attributes(stamps, header), rows=True)
        for name in sorted_names(dataset.data_vars):
            array = dataset[name]
            rows = array.dims[:1] == ("time",)
            inner = array.shape[1:] if rows else array.shape
            attributes = _variable_attributes(name, array, dataset, header)
            if array.dtype.kind not in "fiub":
                put_text(writer, name, np.asarray(array.values), attributes, rows=rows)
                continue
            if len(inner) == 1:
                attributes["LABL_PTR_1"] = f"{name}_label"
                _put_labels(writer, name, array, dataset)
            put_numbers(writer, name, cdf_type(array).number, filled(array), attributes, rows=rows)


def put_numbers(
    writer: Any, name: str, number: int, values: Array, attributes: dict[str, Any], *, rows: bool
) -> None:
    """Write a variable of numbers of a CDF type: values of each record, or of all."""
    inner = list(values.shape[1:] if rows else values.shape)
    specification = {
        "Variable": name,
        "Data_Type": number,
        "Num_Elements": 1,
        "Rec_Vary": rows,
        "Dim_Sizes": inner,
        "Compress": _CDF_LEVEL if rows else 0,
    }
    writer.write_var(specification, var_attrs=attributes, var_data=np.ascontiguousarray(values))


def put_text(writer: Any, name: str, values: Array, attributes: dict[str, Any], *, rows: bool) -> None:
    """Write a variable of texts, padded to the longest."""
    texts = [_ascii(text) for text in values.ravel().tolist()]
    width = max(1, *map(len, texts))
    specification = {
        "Variable": name,
        "Data_Type": 51,
        "Num_Elements": width,
        "Rec_Vary": rows,
        "Dim_Sizes": list(values.shape[1:] if rows else values.shape),
        "Compress": 0,
    }
    attributes = {**attributes, "FORMAT": f"A{width}"}
    writer.write_var(specification, var_attrs=attributes, var_data=[text.ljust(width) for text in texts])


def _put_labels(writer: Any, name: str, array: xr.DataArray, dataset: xr.Dataset) -> None:
    labels = np.array([f"{name} {part}" for part in components(array, dataset)])
    attributes = {"CATDESC": f"Labels of {name}", "FIELDNAM": f"{name}_label", "VAR_TYPE": "metadata"}
    put_text(writer, f"{name}_label", labels, {**attributes, "FILLVAL": " "}, rows=False)


def cdf_type(array: xr.DataArray) -> _CdfType:
    """Return how an array's values are stored in a CDF."""
    return _CDF_TYPES[array.dtype.str[1:]]


def filled(array: xr.DataArray) -> Array:
    """Return an array's values as a CDF holds them: ISTP's fill for NaN, small integers for booleans."""
    values = np.asarray(array.values)
    if values.dtype.kind == "f":
        return np.where(np.isnan(values), values.dtype.type(CDF_FILL), values)
    return values.astype(np.uint8) if values.dtype.kind == "b" else values


def _epoch_attributes(stamps: Array, header: DayHeader) -> dict[str, Any]:
    from inflight.time import to_tt2000

    first, last = (int(to_tt2000(header.day + np.timedelta64(days, "D"))) for days in (0, 1))
    return {
        "CATDESC": "Time of the sample, TT2000",
        "FIELDNAM": "Epoch",
        "LABLAXIS": "Epoch",
        "UNITS": "ns",
        "SI_CONVERSION": _SI["ns"],
        "FILLVAL": [_TT2000_FILL, "CDF_TIME_TT2000"],
        "VALIDMIN": [first, "CDF_TIME_TT2000"],
        "VALIDMAX": [last, "CDF_TIME_TT2000"],
        "SCALETYP": "linear",
        "VAR_TYPE": "support_data",
        "MONOTON": "INCREASE",
        "TIME_BASE": "J2000",
        "TIME_SCALE": "Terrestrial Time",
        "REFERENCE_POSITION": "Rotating Earth Geoid",
        "FORMAT": "I20",
        "RESOLUTION": f"{usual_step(stamps, 0) / SECOND:g}s",
    }


def _variable_attributes(
    name: str, array: xr.DataArray, dataset: xr.Dataset, header: DayHeader
) -> dict[str, Any]:
    """Return ISTP's attributes of a variable; LABL_PTR_1 is added with the labels."""
    unit, frame = str(array.attrs.get("units", "")), frame_of(array)
    out: dict[str, Any] = {
        "CATDESC": _ascii(text_of(name, array)),
        "FIELDNAM": name,
        "VAR_TYPE": "data" if unit == "nT" else "support_data",
    }
    if array.dims[:1] == ("time",):
        out |= {"DEPEND_0": "Epoch", "DISPLAY_TYPE": "time_series"}
    if array.dtype.kind not in "fiub":
        return out | {"FILLVAL": " "}
    kind, (low, high) = cdf_type(array), _valid_range(name, array, header.mission)
    if array.dtype.kind in "iub":
        limits = (0, 1) if array.dtype.kind == "b" else (np.iinfo(array.dtype).min, np.iinfo(array.dtype).max)
        low, high = max(int(low), int(limits[0])), min(int(high), int(limits[1]))
    out |= {
        "UNITS": " " if unit in {"", "1"} else _ascii(unit),
        "FILLVAL": [kind.fill, kind.name],
        "VALIDMIN": [low, kind.name],
        "VALIDMAX": [high, kind.name],
        "SCALETYP": "linear",
        "FORMAT": kind.form,
    }
    if array.ndim == 1:
        out["LABLAXIS"] = name
    if unit in _SI:
        out["SI_CONVERSION"] = _SI[unit]
    if frame:
        out["COORDINATE_SYSTEM"] = _ascii(frame)
    if "flag_masks" in array.attrs:
        masks = [int(mask) for mask in array.attrs["flag_masks"]]
        out |= {
            "VAR_NOTES": _flag_notes(array.attrs),
            "FLAG_MASKS": [masks, kind.name],
            "FLAG_MEANINGS": str(array.attrs["flag_meanings"]),
        }
    if takes_uncertainty(name, dataset):
        out |= {"DELTA_PLUS_VAR": "uncertainty", "DELTA_MINUS_VAR": "uncertainty"}
    return out


def _istp(dataset: xr.Dataset, header: DayHeader) -> dict[str, list[str]]:
    """Return ISTP's global attributes, each with its entries."""
    mission, keys = header.mission, header.mission.release
    level, _, descriptor = header.dataset.partition("/")
    title = f"{keys.source_name.partition('>')[0]} {header.dataset}: {mission.description}"
    step = usual_step(np.asarray(dataset["tt2000"].values), 0) / SECOND
    out = {
        "Project": [keys.project],
        "Source_name": [keys.source_name],
        "Discipline": [keys.discipline],
        "Data_type": [_LEVELS.get(level, f"{level.upper()}>{level}")],
        "Descriptor": [
            f"{(descriptor + _checked(header.dataset, header.maturity)).upper()}>"
            f"{_descriptor(descriptor, level, mission)}"
        ],
        "Data_version": [header.version.removeprefix("v")],
        "Logical_source": [header.source],
        "Logical_source_description": [title],
        "Logical_file_id": [header.stem],
        "File_naming_convention": ["source_type_descriptor_yyyyMMdd"],
        "TITLE": [title],
        "TEXT": [mission.description, _described(dataset, level)],
        "PI_name": [keys.pi_name],
        "PI_affiliation": [keys.pi_affiliation],
        "Instrument_type": [keys.instrument_type],
        "Mission_group": [keys.mission_group or keys.source_name.partition(">")[0]],
        "Rules_of_use": [keys.rules_of_use],
        "Acknowledgement": [mission.acknowledgement],
        "Generated_by": [keys.pi_affiliation],
        "Generation_date": [header.generated],
        "MODS": [f"{header.version}: made from {header.dataset} {header.day_version} of the catalog"],
        "Parents": list(header.parents),
        "Software_version": [f"inflight {__version__}"],
        "Skeleton_version": ["1.0"],
        "Time_resolution": [f"{step:g} s"],
    }
    if level == "l2":
        out["Maturity"] = [header.maturity]
    for name in _MADE_WITH:
        told = dataset.attrs.get(name, [])
        out[name.capitalize()] = [told] if isinstance(told, str) else list(told)
    if keys.doi:
        out["DOI"] = [keys.doi]
    if keys.link:
        out |= {"HTTP_LINK": [keys.link], "LINK_TEXT": ["About the data:"], "LINK_TITLE": ["Home page"]}
    # CDF's tools take an empty text for a missing one.
    return {key: [value or " " for value in values] for key, values in out.items() if values}


def _descriptor(name: str, level: str, mission: Mission) -> str:
    if level == "l1" and name in mission.instruments:
        return f"{mission.instruments[name].role} {name}"
    return "calibrated field with its corrections, uncertainty and quality"


def _described(dataset: xr.Dataset, level: str) -> str:
    if level != "l2":
        return "Measurements as delivered, on exact times; flag tells the quality of each sample."
    corrections = [str(name) for name in dataset.data_vars if str(name).startswith("correction_")]
    told = f" The corrections taken out stand apart: {', '.join(sorted(corrections))}." if corrections else ""
    return (
        "Calibrated in flight: field_* is the corrected field by frame, uncertainty one sigma of each "
        "component, flag the quality of each sample." + told
    )


def _ascii(text: object) -> str:
    """Return a text in ASCII, which every CDF library reads: accents are dropped."""
    plain = unicodedata.normalize("NFKD", str(text))
    return "".join(c for c in plain if not unicodedata.combining(c)).encode("ascii", "replace").decode()


def _check_cdf(path: Path, dataset: xr.Dataset, header: DayHeader) -> None:
    import cdflib

    found = cdflib.CDF(path)
    stamps = np.asarray(dataset["tt2000"].values)
    _require_equal(np.asarray(found.varget("Epoch")), stamps, path, header, "Epoch")
    for name in sorted_names(dataset.data_vars):
        array = dataset[name]
        values = np.asarray(found.varget(name))
        if array.dtype.kind in "fiub":
            _require_equal(values, filled(array), path, header, name)


# --- NetCDF ------------------------------------------------------------------------------------------


def _cf_dataset(dataset: xr.Dataset, header: DayHeader) -> xr.Dataset:
    import xarray as xr

    from inflight.time import to_utc

    variables: dict[str, tuple[tuple[Any, ...], Array, dict[str, Any]]] = {}
    for name in ["tt2000", *sorted_names(dataset.data_vars)]:
        array = dataset[name]
        variables[name] = (array.dims, np.asarray(array.values), _cf_attributes(name, array, dataset, header))
    seconds = (to_utc(dataset["tt2000"].values) - header.day) / np.timedelta64(1, "ns") / SECOND
    time = {
        "standard_name": "time",
        "long_name": "UTC",
        "units": f"seconds since {header.day} 00:00:00",
        "calendar": "standard",
        "axis": "T",
    }
    coordinates = {
        str(dim): dataset[dim].values for dim in dataset.dims if dim != "time" and dim in dataset.coords
    }
    return xr.Dataset(
        variables, {"time": ("time", np.asarray(seconds), time), **coordinates}, _cf_header(dataset, header)
    )


def _cf_attributes(name: str, array: xr.DataArray, dataset: xr.Dataset, header: DayHeader) -> dict[str, Any]:
    unit = str(array.attrs.get("units", ""))
    out: dict[str, Any] = {"long_name": str(array.attrs.get("long_name") or name).replace("_", " ")}
    if name == "tt2000":
        return out | {"long_name": "TT2000: nanoseconds since 2000-01-01T12:00:00 Terrestrial Time"}
    if array.dtype.kind in "fiu" and "flag_masks" not in array.attrs:
        out["units"] = _CF_UNITS.get(name) or _CF_UNITS.get(unit) or unit or "1"
    if name in {"latitude", "longitude"}:
        out["standard_name"] = name
    if array.dtype.kind == "f":
        low, high = _valid_range(name, array, header.mission)
        out |= {"valid_min": array.dtype.type(low), "valid_max": array.dtype.type(high)}
    if "flag_masks" in array.attrs:
        masks = np.asarray(array.attrs["flag_masks"], dtype=array.dtype)
        out |= {"standard_name": "quality_flag", "flag_masks": masks}
        out |= {"flag_meanings": str(array.attrs["flag_meanings"])}
    if name.startswith("field") and "flag" in dataset:
        out["ancillary_variables"] = "flag uncertainty" if takes_uncertainty(name, dataset) else "flag"
    if array.ndim == 2:
        out["axes"] = " ".join(components(array, dataset))
    return out | {key: array.attrs[key] for key in ("frame", "applied") if array.attrs.get(key)}


def _cf_header(dataset: xr.Dataset, header: DayHeader) -> dict[str, Any]:
    istp = _istp(dataset, header)
    first = {key: values[0] for key, values in istp.items()}
    out = {
        "Conventions": "CF-1.11, ACDD-1.3",
        "title": first["TITLE"],
        "summary": " ".join(istp["TEXT"]),
        "id": header.stem,
        "source": first["Source_name"],
        "institution": first["PI_affiliation"],
        "creator_name": first["PI_name"],
        "project": first["Project"],
        "license": first["Rules_of_use"],
        "acknowledgement": first["Acknowledgement"],
        "product_version": header.version,
        "date_created": first["Generation_date"],
        "history": "; ".join([*istp["MODS"], *istp.get("Parents", [])]),
        "references": header.mission.release.doi or header.mission.release.link,
    }
    if "Maturity" in istp:
        out["maturity"] = first["Maturity"]
    told = {name: "; ".join(istp.get(name.capitalize(), [])) for name in _MADE_WITH}
    own = told | {
        key: str(value) for key, value in dataset.attrs.items() if isinstance(value, str | int | float)
    }
    extra = {key: value for key, value in own.items() if key not in {*out, "version", "day"}}
    return {key: value for key, value in (out | extra).items() if value}
