"""What the variables of a dataset are, in words: for files of a day, and for who serves a release.

In go a day's Dataset (`described`), or the days of a collection (`describe_dataset`); out come units, names
of components, meanings of quality bits and which sigma belongs to which field.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from inflight.catalog.opening import read_variable
from inflight.catalog.records import Day
from inflight.catalog.spans import as_date
from inflight.catalog.stores import Store, open_store
from inflight.errors import CatalogError
from inflight.flags import flag_meanings
from inflight.time import usual_step

if TYPE_CHECKING:
    import xarray as xr

#: Names of the axes of frames whose axes are not x, y and z.
_COMPONENTS: Final = {"nec": ("north", "east", "centre")}


@dataclass(frozen=True, kw_only=True)
class VariableDescription:
    """One variable of a dataset.

    Attributes
    ----------
    name, text : str
        Its name, and what it is.
    unit, frame : str
        Empty when it has none.
    shape : tuple of int
        Of the value of one sample; ``()`` for a number.
    components : tuple of str
        Names of a vector's components.
    dtype : numpy dtype
        Of the values as they are read.
    flags : tuple of (int, str)
        Masks of a quality word and what each means.
    uncertainty : str
        The variable that holds its sigma.
    longest : int
        UTF-8 bytes of the longest text; 0 for numbers.
    absent : frozenset of str
        Stores of the collection that lack it.
    """

    name: str
    text: str
    unit: str = ""
    frame: str = ""
    shape: tuple[int, ...] = ()
    components: tuple[str, ...] = ()
    dtype: np.dtype[Any] = field(default_factory=lambda: np.dtype(np.float64))
    flags: tuple[tuple[int, str], ...] = ()
    uncertainty: str = ""
    longest: int = 0
    absent: frozenset[str] = frozenset()


@dataclass(frozen=True, kw_only=True)
class DatasetDescription:
    """What a collection holds of one dataset.

    Attributes
    ----------
    dataset : str
    variables : tuple of VariableDescription
        Those with a value for each sample, without ``tt2000``: fields, uncertainty, the others, corrections.
    left_out : mapping
        Variable -> why it has no one description.
    first, last : date
        First and last UTC day.
    days, samples : int
        How many.
    first_tt2000 : int
        Time of the first sample.
    cadence_ns : int
        Usual distance of samples, 0 when there is one alone.
    attributes : mapping
        Of the dataset, as its first day has them.
    """

    dataset: str
    variables: tuple[VariableDescription, ...]
    left_out: Mapping[str, str]
    first: dt.date
    last: dt.date
    days: int
    samples: int
    first_tt2000: int
    cadence_ns: int
    attributes: Mapping[str, Any]


def describe_dataset(workspace: Path, days: Sequence[Day]) -> DatasetDescription:
    """Describe the days of one dataset of a collection; see `Catalog.describe`.

    The metadata of every store is read, and the times of the first day.
    """
    name, known = days[0].dataset, _Known()
    for segment, (start, _) in {day.segment: day.rows for day in reversed(days)}.items():
        store = open_store(str(workspace / segment))
        if store.row_dim != "time":
            raise CatalogError(f"'{name}' has no samples in time", remedy="read it with Catalog.open")
        known.add(segment, store, start)
    filled = next((day for day in days if day.count), None)
    if filled is None:
        raise CatalogError(f"'{name}' has no samples", remedy="see 'inflight catalog gaps'")
    stamps, _ = read_variable(workspace, filled, "tt2000")
    cadence = known.attributes.get("cadence_ns") or usual_step(stamps, 0)
    return DatasetDescription(
        dataset=name,
        variables=known.variables(),
        left_out=known.left_out,
        first=as_date(days[0].day),
        last=as_date(days[-1].day),
        days=len(days),
        samples=sum(day.count for day in days),
        first_tt2000=int(stamps[0]),
        cadence_ns=int(cadence),
        attributes=known.attributes,
    )


class _Known:
    """The variables met in the stores of a collection, the newest store first."""

    def __init__(self) -> None:
        self.attributes: Mapping[str, Any] = {}
        self.left_out: dict[str, str] = {}
        self._described: dict[str, VariableDescription] = {}
        self._names: dict[str, frozenset[str]] = {}

    def add(self, segment: str, store: Store, start: int) -> None:
        """Take in the variables of a store, whose day begins at row `start`."""
        of_rows = frozenset(name for name in store.variables if store.in_rows(name)) - {"tt2000"}
        self._names[segment] = of_rows
        self.attributes = store.attributes
        for name in store.variables.keys() - of_rows - {"tt2000"} - store.coordinates:
            self.left_out.setdefault(name, "it is the same for all samples of a day")
        if of_rows - self._described.keys():
            found = described(_without_samples(store, start // store.chunk))
        else:
            found = {name: self._described[name] for name in of_rows}
        for name in of_rows:
            self._add(found[name], store)

    def _add(self, found: VariableDescription, store: Store) -> None:
        stored, before = store.variables[found.name], self._described.setdefault(found.name, found)
        dtype = stored.decoded_dtype()
        for what, here, there in (
            ("unit", _unit(str(stored.attributes.get("units", ""))), before.unit),
            ("frame", str(stored.attributes.get("frame", "")), before.frame),
            ("shape", stored.shape[1:], before.shape),
            ("kind", dtype.kind in "US", before.dtype.kind in "US"),
        ):
            if here != there:
                self.left_out[found.name] = f"its {what} changes between days"
                return
        longest = max(len(text.encode()) for text in ("", *stored.encoding.labels))
        self._described[found.name] = replace(
            before, dtype=np.result_type(before.dtype, dtype), longest=max(before.longest, longest)
        )

    def variables(self) -> tuple[VariableDescription, ...]:
        """Return the variables in the order of files, each with the stores that lack it."""
        return tuple(
            replace(
                self._described[name],
                absent=frozenset(item for item, names in self._names.items() if name not in names),
            )
            for name in sorted_names(self._described)
            if name not in self.left_out
        )


def _without_samples(store: Store, index: int) -> xr.Dataset:
    """Return a day of a store with its attributes and coordinates, for which no sample is read."""
    import xarray as xr

    variables = {}
    for name, stored in store.variables.items():
        if store.in_rows(name):
            values = np.empty((0, *stored.shape[1:]), dtype=stored.decoded_dtype())
        elif name in store.coordinates:
            values = store.whole(name)
        else:
            continue
        variables[name] = xr.Variable(stored.dims, values, store.attributes_on(name, index))
    return xr.Dataset(variables).set_coords(store.coordinates & variables.keys())


def described(dataset: xr.Dataset) -> dict[str, VariableDescription]:
    """Describe the variables of a day that have a value for each sample, by name."""
    dataset = with_flag_meanings(dataset)
    return {
        name: VariableDescription(
            name=name,
            text=text_of(name, dataset[name]),
            unit=_unit(str(dataset[name].attrs.get("units", ""))),
            frame=frame_of(dataset[name]),
            shape=dataset[name].shape[1:],
            components=tuple(components(dataset[name], dataset)) if dataset[name].ndim == 2 else (),
            dtype=dataset[name].dtype,
            flags=tuple(flags_of(dataset[name].attrs)),
            uncertainty="uncertainty" if takes_uncertainty(name, dataset) else "",
        )
        for name in map(str, dataset.data_vars)
        if name != "tt2000" and dataset[name].dims[:1] == ("time",)
    }


def with_flag_meanings(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the meanings of its quality bits, which are the same for all."""
    if "flag" not in dataset or "flag_meanings" in dataset["flag"].attrs:
        return dataset
    masks, names = flag_meanings()
    return dataset.assign(flag=dataset["flag"].assign_attrs(units="", flag_masks=masks, flag_meanings=names))


def text_of(name: str, array: xr.DataArray) -> str:
    """Return in words what a variable is, with its axes."""
    text, frame = str(array.attrs.get("long_name") or name), frame_of(array)
    return f"{text}, {frame} axes" if frame else text


def flags_of(attributes: Mapping[str, Any]) -> list[tuple[int, str]]:
    """Return the masks of a quality word and what each means."""
    if "flag_meanings" not in attributes:
        return []
    names = str(attributes["flag_meanings"]).split()
    return [(int(mask), name) for mask, name in zip(attributes["flag_masks"], names, strict=True)]


def components(array: xr.DataArray, dataset: xr.Dataset) -> list[str]:
    """Return the names of a vector's components."""
    dim, size = array.dims[-1], array.shape[-1]
    named = str(array.attrs.get("axes", "")).split()
    if dim in dataset.coords:
        named = dataset[dim].values.tolist()
    known = _COMPONENTS.get(frame_of(array), named)
    return [str(part) for part in (known if len(known) == size else range(size))]


def frame_of(array: xr.DataArray) -> str:
    """Return the frame of a vector's axes, empty when it states none."""
    return str(array.attrs.get("frame", ""))


def takes_uncertainty(name: str, dataset: xr.Dataset) -> bool:
    """Return True for the fields whose components `uncertainty` is given for."""
    if "uncertainty" not in dataset or not name.startswith("field_"):
        return False
    sigma, measured = dataset["uncertainty"], dataset[name]
    return sigma.dims == measured.dims and frame_of(sigma) == frame_of(measured)


def sorted_names(names: Iterable[object]) -> list[str]:
    """Return the variables of a file without its times: fields, uncertainty, the others, corrections."""

    def place(name: str) -> tuple[int, str]:
        first = (name.startswith("field"), name == "uncertainty", not name.startswith("correction_"), True)
        return first.index(True), name

    return sorted((str(name) for name in names if name != "tt2000"), key=place)


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit
