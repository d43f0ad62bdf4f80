"""How values become stored arrays and come back: packed integers, labels, plain arrays.

A channel that states its instrument's resolution is stored as integers of that step: smaller and
faster to decode than compressed floats, and exact. It is done only when it loses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from inflight.time import TT2000_FILL

Array = npt.NDArray[Any]

#: Attribute of a stored array that describes its encoding.
ENCODING_ATTRIBUTE: Final = "inflight"

#: Values that are packed at once: what is made of them on the way stays near the processor.
_AT_ONCE: Final = 16384


@dataclass(frozen=True, kw_only=True)
class PackingSettings:
    """When a channel may be stored as multiples of its resolution; both must hold.

    Attributes
    ----------
    step_tolerance : float
        A value may differ from a multiple of the resolution by this part of the resolution (assumed).
    value_tolerance : float
        A decoded value may differ from the given one by this part of it: rounding of float32 (derived).
    """

    step_tolerance: float = 1e-6
    value_tolerance: float = 1e-9


PACKING_SETTINGS = PackingSettings()


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """How one variable is stored.

    `kind` is ``plain`` (as it is), ``packed`` (integers times `resolution`, `missing` is NaN),
    ``labels`` (unsigned integers that index `labels`) or ``stamps`` (datetime64 as int64).
    `dtype` is that of the decoded values, `stored` that of the array on disk.
    """

    kind: str
    dtype: str
    stored: str
    fill: int | float | bool | complex
    delta: bool = False
    resolution: float = 0.0
    missing: int = 0
    labels: tuple[str, ...] = ()
    note: str = ""

    def attributes(self) -> dict[str, Any]:
        """Return the attributes to store; packed arrays carry the CF ones too, for other readers."""
        described: dict[str, Any] = {"kind": self.kind, "dtype": self.dtype}
        if self.kind == "labels":
            described["labels"] = list(self.labels)
        if self.kind != "packed":
            return {ENCODING_ATTRIBUTE: described}
        described |= {"resolution": self.resolution, "missing": self.missing}
        return {ENCODING_ATTRIBUTE: described, "scale_factor": self.resolution, "_FillValue": self.missing}

    @classmethod
    def from_attributes(cls, attributes: dict[str, Any], stored: str) -> Encoding:
        """Rebuild the encoding and take its own attributes out of `attributes`."""
        described = dict(attributes.pop(ENCODING_ATTRIBUTE))
        if described["kind"] == "packed":
            attributes.pop("scale_factor")
            attributes.pop("_FillValue")
        labels = tuple(described.pop("labels", ()))
        return cls(stored=stored, fill=0, labels=labels, **described)

    def decode(self, stored: Array) -> Array:
        """Return the values of a stored array, same shape."""
        if self.kind == "packed":
            return _values(stored, self.resolution, self.missing, np.dtype(self.dtype))
        if self.kind == "labels":
            return np.array(self.labels or ("",))[stored]
        if self.kind == "stamps":
            return stored.view(self.dtype)
        return stored


def encode(name: str, pieces: Sequence[Array], attributes: dict[str, Any]) -> tuple[Encoding, list[Array]]:
    """Choose how a variable is stored, from all its values, and return them so.

    Parameters
    ----------
    name : str
        Of the variable; ``tt2000`` is stored as differences.
    pieces : sequence of ndarray
        The variable's values, one array for each day; all of one dtype and inner shape.
    attributes : dict
        Of the variable; ``resolution`` (> 0, in its unit) asks for packing.

    Returns
    -------
    Encoding
        With a `note` when packing was asked for and would have lost something.
    list of ndarray
        The stored form of each piece, same shape.
    """
    dtype = pieces[0].dtype
    if dtype.kind in "UOT":
        labels = sorted({str(value) for piece in pieces for value in piece.ravel()})
        number = {label: place for place, label in enumerate(labels)}
        codes = [[number[str(value)] for value in piece.ravel()] for piece in pieces]
        encoding = Encoding(kind="labels", dtype="str", stored="uint32", fill=0, labels=tuple(labels))
        shaped = zip(codes, pieces, strict=True)
        return encoding, [np.array(one, dtype=encoding.stored).reshape(piece.shape) for one, piece in shaped]
    if dtype.kind in "mM":
        unit = "datetime64[ns]" if dtype.kind == "M" else "timedelta64[ns]"
        encoding = Encoding(kind="stamps", dtype=unit, stored="int64", fill=int(TT2000_FILL), delta=True)
        return encoding, [piece.astype(unit).view(np.int64) for piece in pieces]
    fill: int | float | bool = np.nan if dtype.kind in "fc" else False if dtype.kind == "b" else 0
    plain = Encoding(kind="plain", dtype=dtype.name, stored=dtype.name, fill=fill)
    if name == "tt2000":
        return replace(plain, fill=int(TT2000_FILL), delta=True), list(pieces)
    resolution = attributes.get("resolution")
    if resolution is None or dtype.kind != "f" or not float(resolution) > 0:
        return plain, list(pieces)
    packed = _packed(pieces, float(resolution))
    if packed is not None:
        return packed
    note = f"{name}: stored as {dtype.name}: its values are no multiples of the resolution {resolution:g}"
    return replace(plain, note=note), list(pieces)


# Without warnings of overflow and infinities: the look at `largest` refuses them.
@np.errstate(over="ignore", invalid="ignore")
def _packed(pieces: Sequence[Array], resolution: float) -> tuple[Encoding, list[Array]] | None:
    """Return the encoding as multiples of the resolution, and these; None unless it keeps all values."""
    largest, packed = 0.0, []
    for piece in pieces:
        absent = None
        # Whole numbers of steps are what is stored, whatever their type: as floats they need no copy.
        steps = _exact_steps(piece, resolution)
        if steps is None:
            absent = None if np.isfinite(piece).all() else np.isnan(piece)
            finite = piece if absent is None else np.where(absent, 0.0, piece).astype(piece.dtype, copy=False)
            steps = _steps(finite, resolution)
            decoded = _values(steps, resolution, None, finite.dtype)
            error, allowed = np.abs(decoded - finite), PACKING_SETTINGS.value_tolerance * np.abs(finite)
            if np.any((error > PACKING_SETTINGS.step_tolerance * resolution) | (error > allowed)):
                return None
        # Rounded as what is stored is: a quotient may lie just below the last integer that has room.
        largest = max(largest, float(steps.max(initial=0.0)), -float(steps.min(initial=0.0)))
        if not largest < 2**53:
            return None
        packed.append((steps, absent))
    stored, missing = ("int32", -(2**31)) if largest < 2**31 - 1 else ("int64", -(2**63))
    encoding = Encoding(
        kind="packed",
        dtype=pieces[0].dtype.name,
        stored=stored,
        fill=missing,
        delta=True,
        resolution=resolution,
        missing=missing,
    )
    whole = [steps.astype(stored) for steps, _ in packed]
    for values, (_, absent) in zip(whole, packed, strict=True):
        if absent is not None:
            values[absent] = missing
    return encoding, whole


def _exact_steps(piece: Array, resolution: float) -> npt.NDArray[np.float64] | None:
    """Return how many steps each value is; None unless all are there and come back to the last bit."""
    flat = piece.ravel()
    steps = np.empty(flat.size)
    for begin in range(0, flat.size, _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        steps[some] = _steps(flat[some], resolution)
        if not np.array_equal(_values(steps[some], resolution, None, flat.dtype), flat[some]):
            return None
    return steps.reshape(piece.shape)


def _steps(values: Array, resolution: float) -> npt.NDArray[np.float64]:
    steps = np.asarray(values, dtype=np.float64) / resolution
    return np.rint(steps, out=steps)


def _values(quanta: Array, resolution: float, missing: int | None, dtype: np.dtype[Any]) -> Array:
    # 7 / 100 is the float nearest to 0.07 and 7 * 0.01 is not: divide where the steps per unit are whole.
    steps_per_unit = round(1 / resolution) if resolution <= 1 else 0
    whole = steps_per_unit >= 1 and abs(steps_per_unit * resolution - 1) < 1e-12
    values: Array = quanta / steps_per_unit if whole else quanta * resolution
    if missing is not None:
        absent = quanta == missing
        if absent.any():
            values[absent] = np.nan
    return values.astype(dtype, copy=False)
