"""Manifests: the sha256 of every file of a store, and the proof that it is still whole."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final

from inflight.errors import IntegrityError
from inflight.progress import Progress, silent, tell_each, with_progress

#: Name of the manifest inside a store or a release; lines as ``sha256sum`` writes them.
MANIFEST: Final = "MANIFEST.sha256"
#: Files flushed at once.
_FLUSHES: Final = 8
#: Files that a thread flushes before progress is told; those of a store are fewer for each thread.
_FLUSHED_TOGETHER: Final = 100


def write_manifest(folder: Path, progress: Progress = silent, known: Mapping[Path, str] | None = None) -> str:
    """Hash every file below `folder`, write its manifest; return the manifest's sha256.

    `known` are hashes of files that were read back when they were written: they are not read again.
    """
    hashes = {} if known is None else known
    manifest = folder / MANIFEST
    with manifest.open("w", encoding="utf-8", newline="\n") as stream:
        names = tell_each(progress, "manifest", _files(folder))
        stream.writelines(f"{hashes.get(folder / name) or _hash(folder / name)}  {name}\n" for name in names)
    return _hash(manifest)


def flush_files(folder: Path, progress: Progress = silent) -> None:
    """Put everything below `folder` on the disk: files and folders."""
    paths = [folder, *folder.rglob("*")]
    # Flushes wait for the disk, not for the processor: together they wait once. All are waited for: the first
    # failure is raised here.
    parts = max(_FLUSHES, len(paths) // _FLUSHED_TOGETHER)
    flushed = _flushing().map(_flush_all, (paths[place::parts] for place in range(parts)))
    list(with_progress(progress, "flush", flushed, parts))


def _flush_all(paths: Iterable[Path]) -> None:
    for path in paths:
        flush(path)


@cache
def _flushing() -> ThreadPoolExecutor:
    """Return the threads that flush files; they stay, for there are thousands of small stores."""
    return ThreadPoolExecutor(_FLUSHES, thread_name_prefix="flush")


# A forked process has none of its parent's threads.
os.register_at_fork(after_in_child=_flushing.cache_clear)


def manifest_sha256(folder: Path) -> str:
    """Return the sha256 of a store's manifest file.

    Raises
    ------
    IntegrityError
        When there is none.
    """
    try:
        return _hash(folder / MANIFEST)
    except OSError:
        raise IntegrityError(
            "the store or its manifest is missing", file=str(folder), remedy="run again"
        ) from None


def stated_hashes(folder: Path) -> dict[str, str]:
    """Return file name -> sha256 as a folder's manifest states them.

    Raises
    ------
    OSError
        When there is none.
    """
    text = (folder / MANIFEST).read_text("utf-8", errors="replace")
    lines = (line.partition("  ") for line in text.splitlines())
    return {name: digest for digest, _, name in lines}


def manifest_faults(folder: Path, sha256: str) -> list[tuple[str, str]]:
    """Compare a folder with its manifest, and the manifest with `sha256` (skipped when empty).

    Returns
    -------
    list of (file, fault)
        Empty when every byte is as it was written.
    """
    try:
        found = manifest_sha256(folder)
    except IntegrityError as error:
        return [(MANIFEST, error.message)]
    if sha256 and found != sha256:
        return [(MANIFEST, f"manifest has sha256 {found[:12]}, expected {sha256[:12]}")]
    stated = stated_hashes(folder)
    present = set(_files(folder))
    faults = [(name, "file is missing") for name in sorted(stated.keys() - present)]
    faults += [(name, "file is not in the manifest") for name in sorted(present - stated.keys())]
    changed = (name for name in sorted(present & stated.keys()) if _hash(folder / name) != stated[name])
    return faults + [(name, "content is not what was written") for name in changed]


def flush(path: Path) -> None:
    """Put a file on the disk; of a folder its entries, so that a rename in it survives a power failure."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def folder_bytes(folder: Path) -> int:
    """Return the size of all files below a folder."""
    return sum(entry.stat().st_size for _, entry in _entries(folder))


def _files(folder: Path) -> list[str]:
    return sorted(name for name, _ in _entries(folder) if name != MANIFEST)


def _entries(folder: Path | str, above: str = "") -> Iterator[tuple[str, os.DirEntry[str]]]:
    """Yield the files below a folder with their names there; nothing where nobody may look, or none is there.

    `Path.rglob` asks the disk of each file what it is.
    """
    with suppress(FileNotFoundError, NotADirectoryError, PermissionError), os.scandir(folder) as found:
        for entry in found:
            if entry.is_dir(follow_symlinks=False):
                yield from _entries(entry.path, f"{above}{entry.name}/")
            elif entry.is_file():
                yield f"{above}{entry.name}", entry


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
