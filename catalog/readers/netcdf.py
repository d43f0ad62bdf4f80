"""NetCDF files: NetCDF-4 through h5py, classic ones through scipy; CF times, fill values and packing.

Opened without xarray on purpose: real products name a dimension and a scalar variable alike, which
`xarray.open_dataset` refuses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from inflight.catalog.readers.source import Array, Source, Variable, read_errors, require_content
from inflight.catalog.readers.times import from_cf, is_cf_unit
from inflight.instruments import Files


@contextmanager
def open_source(path: Path, files: Files) -> Iterator[Source]:
    """Open a NetCDF file; variables in groups are named ``group/variable``."""
    import h5py

    require_content(path)
    with path.open("rb") as stream:
        classic = stream.read(3) == b"CDF"
    with read_errors(path):
        handle: Any = scipy.io.netcdf_file(path, "r", mmap=False) if classic else h5py.File(path, "r")
    arrays: dict[str, Any] = {}

    def collect(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = item

    try:
        with read_errors(path):
            if classic:
                arrays.update(handle.variables)
            else:
                handle.visititems(collect)

        def read(name: str) -> Variable:
            found = arrays[name]
            if classic:
                return _variable(np.array(found.data), dict(found._attributes))
            return _variable(np.asarray(found[...]), dict(found.attrs))

        yield Source(path, tuple(arrays), read, tuple(files.drop))
    finally:
        handle.close()


def _variable(values: Array, attributes: Mapping[str, Any]) -> Variable:
    if not values.dtype.isnative:
        values = values.astype(values.dtype.newbyteorder("="))
    if values.ndim == 0:
        values = values[None]
    # A NetCDF-3 habit kept by products: unsigned integers stored as signed ones.
    if _text(attributes.get("_Unsigned")) == "true" and values.dtype.kind == "i":
        values = values.view(f"u{values.dtype.itemsize}")
    unit = _text(attributes.get("units"))
    fill = tuple(
        number
        for key in ("_FillValue", "missing_value")
        for number in _fills(attributes.get(key), values.dtype)
    )
    scale = (_number(attributes.get("scale_factor"), 1.0), _number(attributes.get("add_offset"), 0.0))
    times = None
    if unit is not None and is_cf_unit(unit) and values.dtype.kind in "iuf":
        counts = values if scale == (1.0, 0.0) else values * scale[0] + scale[1]
        times = from_cf(counts, unit, fill if scale == (1.0, 0.0) else ())
    return Variable(values, unit=unit, fill=fill, scale=scale, times=times)


def _text(value: Any) -> str | None:
    if value is None:
        return None
    item = np.asarray(value).ravel()[0] if np.size(value) else ""
    return (item.decode("utf-8", "replace") if isinstance(item, bytes) else str(item)).strip() or None


def _number(value: Any, default: float) -> float:
    return default if value is None else float(np.asarray(value).ravel()[0])


def _fills(value: Any, dtype: np.dtype[Any]) -> tuple[float, ...]:
    if value is None or dtype.kind not in "iuf":
        return ()
    found = np.asarray(value).ravel()
    if found.dtype.kind not in "iuf":
        return ()
    return tuple(map(float, found.astype(dtype)))
