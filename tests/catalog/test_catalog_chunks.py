"""Chunks are the bytes Zarr would write, and one that reads back differently is an error."""

import numcodecs.blosc
import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec
from zarr.codecs.numcodecs import Delta

from inflight.catalog.layout import CHUNK_SEPARATOR, join_shard, split_shard
from inflight.catalog.segments import COMPRESSION_LEVEL, COMPRESSOR, ChunkWriter
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
        chunk_key_encoding={"name": "default", "separator": CHUNK_SEPARATOR},
    )
    array[...] = data
    place = (0,) * len(shape)
    (tmp_path / "own").mkdir()
    ChunkWriter(tmp_path / "own", delta).write(place, data)
    name = ".".join(("c", *map(str, place)))
    assert (tmp_path / "own" / name).read_bytes() == (tmp_path / "zarr" / name).read_bytes()


@pytest.mark.filterwarnings("ignore:Numcodecs codecs")
@pytest.mark.parametrize("components", [2, 3, 4])
def test_shards_are_the_bytes_that_zarr_writes(tmp_path, components):
    data = values("int32", (500, components))
    array = zarr.create_array(
        tmp_path / "zarr",
        shape=data.shape,
        dtype="int32",
        chunks=(500, 1),
        shards=data.shape,
        filters=[Delta(dtype="<i4")],
        compressors=[BloscCodec(cname=COMPRESSOR, clevel=COMPRESSION_LEVEL, shuffle="shuffle")],
        chunk_key_encoding={"name": "default", "separator": CHUNK_SEPARATOR},
    )
    array[...] = data
    (tmp_path / "own").mkdir()
    ChunkWriter(tmp_path / "own", True).write_shard((0, 0), np.hsplit(data, components))
    content = (tmp_path / "own" / "c.0.0").read_bytes()
    assert content == (tmp_path / "zarr" / "c.0.0").read_bytes()
    assert join_shard([bytes(part) for part in split_shard(content, components)]) == content


def test_a_shard_that_reads_back_differently_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("inflight.catalog.segments.split_shard", lambda content, count: [content] * count)
    with pytest.raises(IntegrityError, match="reads back differently"):
        ChunkWriter(tmp_path, False).write_shard((0, 0), [np.arange(50), np.arange(1, 51)])


def test_a_chunk_that_reads_back_differently_is_an_error(tmp_path, monkeypatch):
    honest = numcodecs.blosc.decompress
    monkeypatch.setattr(numcodecs.blosc, "decompress", lambda packed: honest(packed)[:-1] + b"\x7f")
    with pytest.raises(IntegrityError, match="reads back differently"):
        ChunkWriter(tmp_path, False).write((0,), np.arange(50))


def test_a_chunk_of_no_values_is_no_file(tmp_path):
    ChunkWriter(tmp_path, False).write((0, 0), np.empty((1, 0)))
    assert not list(tmp_path.iterdir())
