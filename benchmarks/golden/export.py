"""Copy products and tables of a workspace into plain files; a script, run under the recorded checkout.

``python -P export.py WORKSPACE LISTING FOLDER PREFIX...`` reads what ``inflight catalog list --json`` printed
and writes one ``.npz`` a dataset and one a table that holds. Of the software, only `Catalog.open` and
`Catalog.table` are used.
"""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import xarray as xr

#: Deflate's level: higher ones save a tenth and cost three times as long.
_COMPRESSION = 1


def main(workspace: Path, listing: Path, folder: Path, prefixes: tuple[str, ...]) -> None:
    """Write the datasets whose names begin with one of the prefixes, and all tables."""
    from inflight.catalog import Catalog

    catalog = Catalog(workspace)
    there = json.loads(listing.read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    for item in there["items"]:
        name = item["dataset"]
        if name.startswith(prefixes) and item["samples"]:
            write(folder / f"{file_name(name)}.npz", catalog.open(name))
    for table in there["tables"]:
        for context, start, _ in table["certified"]:
            name = file_name(f"tables/{table['name']}")
            number = len(list(folder.glob(f"{name}.*.npz")))
            write(folder / f"{name}.{number}.npz", catalog.table(table["name"], at=start, context=context))


def file_name(name: str) -> str:
    """Return a name without slashes."""
    return name.replace("/", "_")


def write(path: Path, data: xr.Dataset) -> None:
    """Write a Dataset: each variable by its name, and dimensions and attributes as JSON under ``about``."""
    about = {
        "attributes": {str(name): plain(value) for name, value in data.attrs.items()},
        "variables": {
            str(name): {
                "dims": [str(one) for one in held.dims],
                "attributes": {str(key): plain(value) for key, value in held.attrs.items()},
            }
            for name, held in data.variables.items()
        },
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
        archive.writestr("about.json", json.dumps(about))
        for name, held in data.variables.items():
            # UTC follows from tt2000, which is there.
            if str(name) != "time":
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, simple(held.values), allow_pickle=False)


def simple(values: np.ndarray) -> np.ndarray:
    """Return an array without Python objects: strings of one length instead."""
    return values.astype(str) if values.dtype.kind in "OT" else values


def plain(value: object) -> object:
    """Return a value that JSON knows."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), tuple(sys.argv[4:]))
