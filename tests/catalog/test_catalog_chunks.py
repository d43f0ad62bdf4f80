"""Stores are the bytes Zarr would write, and a chunk that reads back differently is an error."""

import numcodecs.blosc
import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec
from zarr.codecs.numcodecs import Delta

from inflight.catalog.segments import COMPRESSION_LEVEL, COMPRESSOR, ChunkWriter
from inflight.catalog.zarr_metadata import array_metadata, as_text, group_metadata
from inflight.errors import IntegrityError


def values(dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    random = np.random.default_rng(4)
    return (1000.0 * random.standard_normal(shape)).astype(dtype)


@pytest.mark.filterwarnings("ignore:Numcodecs codecs")
@pytest.mark.parametrize(
    ("dtype", "shape", "delta"),
    [
        ("int32", (500, 1), True),
        ("int64", (500,), True),
        ("float64", (1, 30, 7), False),
        ("uint32", (9,), False),
    ],
)
def test_chunks_are_the_bytes_that_zarr_writes(tmp_path, dtype, shape, delta):
    data = values(dtype, shape)
    array = zarr.create_array(
        tmp_path / "zarr",
        shape=shape,
        dtype=dtype,
        chunks=shape,
        filters=[Delta(dtype=np.dtype(dtype).str)] if delta else None,
        compressors=[BloscCodec(cname=COMPRESSOR, clevel=COMPRESSION_LEVEL, shuffle="shuffle")],
    )
    array[...] = data
    place = (0,) * len(shape)
    ChunkWriter(tmp_path / "own", delta).write(place, data)
    name = "/".join(("c", *map(str, place)))
    assert (tmp_path / "own" / name).read_bytes() == (tmp_path / "zarr" / name).read_bytes()


def test_a_chunk_that_reads_back_differently_is_an_error(tmp_path, monkeypatch):
    honest = numcodecs.blosc.decompress
    monkeypatch.setattr(numcodecs.blosc, "decompress", lambda packed: honest(packed)[:-1] + b"\x7f")
    with pytest.raises(IntegrityError, match="reads back differently"):
        ChunkWriter(tmp_path, False).write((0,), np.arange(50))


@pytest.mark.filterwarnings("ignore:Numcodecs codecs", "ignore:Consolidated metadata")
def test_metadata_are_the_bytes_that_zarr_writes(tmp_path):
    root = {"mission": "a", "inflight": {"layout": 1, "days": ["2005-01-01"], "part": np.nan}}
    attributes = {"units": "nT", "resolution": 0.01, "frame": "Größe"}
    group = zarr.open_group(tmp_path, mode="w-", zarr_format=3, attributes=root)
    cases = [
        ("float64", np.nan, False, (6, 3)),
        ("float32", np.nan, False, (6,)),
        ("complex128", np.nan, False, (6,)),
        ("int32", -(2**31), True, (6, 3)),
        ("int64", -(2**63), True, (6,)),
        ("uint32", 0, False, ()),
        ("uint8", 0, False, (0,)),
        ("bool", False, False, (4,)),
    ]
    own = {}
    for dtype, fill, delta, shape in cases:
        # Names whose order depends on how they are sorted.
        name, chunks = f"B_{dtype}" if delta else f"a_{dtype}", tuple(max(1, size) for size in shape)
        dims = ["time", "axis"][: len(shape)]
        group.create_array(
            name,
            shape=shape,
            dtype=dtype,
            chunks=chunks,
            filters=[Delta(dtype=np.dtype(dtype).str)] if delta else None,
            compressors=[BloscCodec(cname=COMPRESSOR, clevel=COMPRESSION_LEVEL, shuffle="shuffle")],
            fill_value=fill,
            attributes=attributes,
            dimension_names=dims,
        )
        own[name] = array_metadata(
            shape=shape,
            chunks=chunks,
            dtype=np.dtype(dtype),
            fill=fill,
            delta=delta,
            compression=(COMPRESSOR, COMPRESSION_LEVEL),
            attributes=attributes,
            dims=dims,
        )
        assert as_text(own[name]) == (tmp_path / name / "zarr.json").read_text()
    zarr.consolidate_metadata(tmp_path)
    assert as_text(group_metadata(root, own)) == (tmp_path / "zarr.json").read_text()
