"""Records of HAPI: parameters described as its ``info`` has them, samples as CSV and binary.

Binary is little-endian: texts of a fixed length, doubles, 4-byte integers. CSV has the same numbers, with
the fewest digits that give it back exactly.

Reference: HAPI data access specification 3.2, sections 3.6.6 and 3.7.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from inflight.catalog import VariableDescription
from inflight.serve.times import LENGTH, time_texts

if TYPE_CHECKING:
    import pyarrow as pa

Array = npt.NDArray[Any]

TIME: Final = "Time"
#: In place of numbers that are not there: NaN, and for integers of days without the variable the smallest.
_NO_NUMBER, _NO_INTEGER = "NaN", -(2**31)
_FLAG_TEXT: Final = "quality bits, 0 is good"
#: Integers of HAPI have 4 bytes and a sign.
_INTEGERS: Final = ("b1", "i1", "i2", "i4", "u1", "u2")
_DTYPES: Final = {"double": "<f8", "integer": "<i4"}


@dataclass(frozen=True)
class Parameter:
    """One parameter of a dataset of HAPI; `kind` is its type there."""

    variable: VariableDescription
    kind: str

    @classmethod
    def of(cls, variable: VariableDescription) -> Parameter | None:
        """Return a variable as a parameter; None when the standard has no type for it."""
        dtype = variable.dtype
        if dtype.kind in "US":
            return cls(variable, "string")
        # A word of quality bits keeps its bits in four bytes.
        if dtype.str[1:] in _INTEGERS or (variable.flags and dtype.str[1:] == "u4"):
            return cls(variable, "integer")
        return cls(variable, "double") if dtype.kind in "fiu" else None

    @property
    def name(self) -> str:
        """Name in requests."""
        return self.variable.name

    @property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of one value of a binary record."""
        return np.dtype(_DTYPES.get(self.kind, f"S{max(1, self.variable.longest)}"))

    def info(self) -> dict[str, Any]:
        """Return the object that describes it in ``info``."""
        variable = self.variable
        fields: dict[str, Any] = {
            "name": variable.name,
            "type": self.kind,
            "units": variable.unit or None,
            "fill": self._fill(),
            "description": _FLAG_TEXT if variable.flags and variable.text == variable.name else variable.text,
            "label": variable.name,
        }
        if self.kind == "string":
            fields["length"] = self.dtype.itemsize
        if variable.shape:
            fields["size"] = list(variable.shape)
        if variable.components:
            fields["label"] = [f"{variable.name} {part}" for part in variable.components]
        if variable.frame and variable.shape == (3,):
            fields |= {"coordinateSystemName": variable.frame, "vectorComponents": ["x", "y", "z"]}
        if variable.flags:
            fields["x_flag_masks"] = [mask for mask, _ in variable.flags]
            fields["x_flag_meanings"] = [meaning for _, meaning in variable.flags]
        if variable.uncertainty:
            fields["x_uncertainty"] = variable.uncertainty
        return fields

    def _fill(self) -> str | None:
        if self.kind == "double":
            return _NO_NUMBER
        if not self.variable.absent:
            return None
        return str(_NO_INTEGER) if self.kind == "integer" else ""

    def values(self, stored: Array) -> Array:
        """Return the values of a day as records have them, shape ``(samples, ...)``."""
        if self.kind == "string":
            return np.char.encode(stored, "utf-8").astype(self.dtype)
        if self.kind == "integer" and stored.dtype.kind == "u":
            return stored.astype("<u4").view("<i4")
        return stored.astype(self.dtype, copy=False)

    def absent(self, count: int) -> Array:
        """Return the values of so many samples of a day without the variable."""
        fill = {"double": np.nan, "integer": _NO_INTEGER, "string": b""}[self.kind]
        return np.full((count, *self.variable.shape), fill, dtype=self.dtype)


def time_info() -> dict[str, Any]:
    """Return the object that describes the time of a record in ``info``."""
    return {
        "name": TIME,
        "type": "isotime",
        "units": "UTC",
        "fill": None,
        "length": LENGTH,
        "description": "Time of the sample, UTC to the nanosecond; second 60 in a leap second",
        "label": TIME,
    }


def binary_records(tt2000: npt.NDArray[np.int64], columns: Sequence[Array]) -> bytes:
    """Return samples of one day as binary records; `columns` are from `Parameter.values`."""
    fields: list[Any] = [("", f"S{LENGTH}"), *(("", item.dtype, item.shape[1:]) for item in columns)]
    records = np.empty(tt2000.size, dtype=fields)
    first, *others = records.dtype.names or ()
    records[first] = time_texts(tt2000).view(f"S{LENGTH}")[:, 0]
    for name, column in zip(others, columns, strict=True):
        records[name] = column
    return records.tobytes()


def csv_records(tt2000: npt.NDArray[np.int64], columns: Sequence[Array]) -> bytes:
    """Return samples of one day as lines of CSV; `columns` are from `Parameter.values`."""
    import pyarrow as pa
    import pyarrow.csv

    offsets = np.arange(0, LENGTH * (tt2000.size + 1), LENGTH, dtype=np.int32)
    texts = pa.py_buffer(time_texts(tt2000))
    cells = [pa.StringArray.from_buffers(tt2000.size, pa.py_buffer(offsets), texts)]
    for column in columns:
        flat = column.reshape(tt2000.size, -1)
        cells += [_cells(np.ascontiguousarray(flat[:, index])) for index in range(flat.shape[1])]
    if any(column.dtype.kind == "S" for column in columns):
        return _joined(cells)
    table = pa.Table.from_arrays(cells, names=[str(index) for index in range(len(cells))])
    sink = pa.BufferOutputStream()
    style = pyarrow.csv.WriteOptions(include_header=False, quoting_style="none")
    pyarrow.csv.write_csv(table, sink, style)
    return bytes(sink.getvalue())


def _cells(column: Array) -> pa.Array:
    """Return one column of CSV; what is not there as the text that the standard has for it."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if column.dtype.kind == "S":
        distinct, places = np.unique(column, return_inverse=True)
        return pa.array([_quoted(text) for text in distinct.tolist()]).take(pa.array(places))
    if column.dtype.kind == "f" and np.isnan(column).any():
        return pc.fill_null(pa.array(column, from_pandas=True).cast(pa.string()), _NO_NUMBER)
    return pa.array(column)


def _quoted(text: bytes) -> str:
    plain = text.decode()
    # RFC 4180: quotes around what has a comma, a quote or the end of a line; quotes in it are doubled.
    return '"' + plain.replace('"', '""') + '"' if any(c in plain for c in ',"\r\n') else plain


def _joined(cells: Sequence[pa.Array]) -> bytes:
    """Join cells that may be quoted already."""
    import pyarrow as pa
    import pyarrow.compute as pc

    lines = pc.binary_join_element_wise(*(cell.cast(pa.string()) for cell in cells), ",")
    return ("\n".join(lines.to_pylist()) + "\n").encode()
