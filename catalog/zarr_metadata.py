"""The metadata of a Zarr store as text: arrays, and a group with those of its arrays (Zarr v3 specification).

Each is the text that zarr-python writes, key by key; tests compare the bytes.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

#: File of a node's metadata.
METADATA: Final = "zarr.json"

#: Name of the filter that stores differences; the specification does not know it.
_DELTA: Final = "numcodecs.delta"


def array_metadata(
    *,
    shape: Sequence[int],
    chunks: Sequence[int],
    dtype: np.dtype[Any],
    fill: complex,
    delta: bool,
    compression: tuple[str, int],
    attributes: Mapping[str, Any],
    dims: Sequence[str],
) -> dict[str, Any]:
    """Return the metadata of an array that is compressed by blosc with shuffled bytes.

    Parameters
    ----------
    fill : number
        Of chunks that are not there.
    delta : bool
        Whether differences of neighbours are stored.
    compression : tuple of (name, level)
    """
    blosc = {
        "typesize": dtype.itemsize,
        "cname": compression[0],
        "clevel": compression[1],
        "shuffle": "shuffle",
        "blocksize": 0,
    }
    order = {"configuration": {"endian": "little"}} if dtype.itemsize > 1 else {}
    difference = {"name": _DELTA, "configuration": {"dtype": dtype.newbyteorder("<").str}}
    return {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunks)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": _fill(dtype, fill),
        "codecs": [
            *([difference] if delta else []),
            {"name": "bytes", **order},
            {"name": "blosc", "configuration": blosc},
        ],
        "attributes": dict(attributes),
        **({"dimension_names": list(dims)} if dims else {}),
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def group_metadata(attributes: Mapping[str, Any], arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of a group, with those of its arrays by name: one read is enough for all."""
    names = sorted(arrays, key=lambda name: unicodedata.normalize("NFKC", name).casefold())
    return {
        "attributes": dict(attributes),
        "zarr_format": 3,
        "consolidated_metadata": {
            "kind": "inline",
            "must_understand": False,
            "metadata": {name: arrays[name] for name in names},
        },
        "node_type": "group",
    }


def as_text(metadata: Mapping[str, Any]) -> str:
    """Return metadata as the text of its file."""
    return json.dumps(metadata, indent=2)


def has_delta(metadata: Mapping[str, Any]) -> bool:
    """Return True for an array of which differences are stored."""
    return any(codec["name"] == _DELTA for codec in metadata["codecs"])


def _fill(dtype: np.dtype[Any], fill: complex) -> Any:
    """Return a fill value as JSON has it: no number, and the parts of complex ones, are text and lists."""
    value = dtype.type(fill)
    if dtype.kind == "c":
        return [_fill(value.real.dtype, value.real), _fill(value.imag.dtype, value.imag)]
    if dtype.kind == "f":
        return "NaN" if np.isnan(value) else float(value)
    return value.item()
