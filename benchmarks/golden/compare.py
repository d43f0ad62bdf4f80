"""Comparing two records: identical, within tolerance, or different.

Parameters may move by a part of their stated sigma, fields by a part of a nanotesla, other numbers by a
relative part; words, names, order, whole numbers, flags and exit codes must be equal. A key of a printed
object that only the second record has is new, and allowed. The last digit of a number in a page's text may
differ by one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.golden.reading import Figure, Page, Table, read_json, read_page, read_table

IDENTICAL, WITHIN, DIFFERENT = "identical", "within tolerance", "DIFFERENT"
#: Differences of one item that are listed; ``--all`` lists all.
_LISTED = 8
#: A limit written in decimals is met by a difference of exactly that size.
_ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True)
class Tolerances:
    """How far numbers may move.

    Attributes
    ----------
    sigma : float
        Parameters, in their stated sigma.
    field : float
        Fields, nT.
    relative : float
        All other numbers, relative to the larger of both.
    """

    sigma: float = 1e-3
    field: float = 1e-4
    relative: float = 1e-6


@dataclass
class Item:
    """One thing compared: how many values, and what differs."""

    case: str
    what: str
    values: int = 0
    differences: list[tuple[float, str]] = field(default_factory=list)
    allowed: list[tuple[float, str]] = field(default_factory=list)
    largest: tuple[float, str] = (0.0, "")

    @property
    def level(self) -> str:
        """Which of the three levels it is on."""
        return DIFFERENT if self.differences else WITHIN if self.allowed else IDENTICAL

    def differ(self, what: str) -> None:
        """Note a difference that no tolerance covers."""
        self.differences.append((np.inf, what))

    def number(self, part: float, what: str, size: str) -> None:
        """Note a difference of numbers that is so large a part of its tolerance."""
        (self.differences if part > _ROUNDING else self.allowed).append((part, f"{what}: {size}"))
        self.largest = max(self.largest, (part, size))


def compare_records(
    before: Path, after: Path, only: Sequence[str] | None, tolerances: Tolerances, *, every: bool = False
) -> int:
    """Print what differs between two records; return 1 when anything is out of tolerance, else 0."""
    names = [_cases_of(before), _cases_of(after)]
    common = [name for name in names[0] if name in names[1] and (only is None or name in only)]
    for folder, here, there in ((before, names[0], names[1]), (after, names[1], names[0])):
        alone = [name for name in here if name not in there and (only is None or name in only)]
        if alone:
            print(f"only in {folder}, not compared: {', '.join(alone)}")
    lost = sorted(set(only or ()) - set(common))
    if lost or not common:
        print(f"not in both records: {', '.join(lost) or 'any case'}")
    items = [item for name in common for item in compare_case(before / name, after / name, tolerances)]
    _print_items(items, every)
    return int(bool(lost) or not common or any(item.level == DIFFERENT for item in items))


def _cases_of(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("*/case.json"))


def compare_case(before: Path, after: Path, tolerances: Tolerances) -> list[Item]:
    """Compare all that two records hold of one case."""
    kinds: dict[str, Callable[[Item, Path, Path, Tolerances], None]] = {
        "case.json": _compare_recipe,
        "steps/*.json": _compare_json,
        "pages/*.html": _compare_page,
        "data/*/*.npz": _compare_table,
    }
    items = []
    for pattern, compare in kinds.items():
        found = [{str(path.relative_to(root)) for path in root.glob(pattern)} for root in (before, after)]
        for name in sorted(found[0] | found[1]):
            item = Item(before.name, name)
            if name in found[0] & found[1]:
                compare(item, before / name, after / name, tolerances)
            else:
                item.differ(f"only in {before if name in found[0] else after}")
            items.append(item)
    return items


def _compare_recipe(item: Item, before: Path, after: Path, tolerances: Tolerances) -> None:
    recipes = [json.loads(path.read_text(encoding="utf-8"))["steps"] for path in (before, after)]
    item.values = len(recipes[0])
    if recipes[0] != recipes[1]:
        item.differ("not the same commands were run: record both with the same benchmarks/golden")


# --- printed objects ----------------------------------------------------------------------------------


def _compare_json(item: Item, before: Path, after: Path, tolerances: Tolerances) -> None:
    compare_values(item, "", read_json(before), read_json(after), tolerances)


def compare_values(
    item: Item, where: str, old: Any, fresh: Any, tolerances: Tolerances, sigma: Any = None
) -> None:
    """Compare two printed objects; `sigma` is what is stated beside a number."""
    if isinstance(old, dict) and isinstance(fresh, dict):
        _compare_objects(item, where, old, fresh, tolerances, sigma)
    elif isinstance(old, list) and isinstance(fresh, list):
        if len(old) != len(fresh):
            item.differ(f"{where}: {len(old)} entries, now {len(fresh)}")
        for place, (one, other) in enumerate(zip(old, fresh, strict=False)):
            own_sigma = sigma[place] if isinstance(sigma, list) and place < len(sigma) else sigma
            compare_values(item, f"{where}[{place}]", one, other, tolerances, own_sigma)
    else:
        _compare_leaves(item, where, old, fresh, tolerances, sigma)


def _compare_objects(
    item: Item, where: str, old: dict[str, Any], fresh: dict[str, Any], tolerances: Tolerances, sigma: Any
) -> None:
    for key, held in old.items():
        inside = f"{where}.{key}".lstrip(".")
        if key not in fresh:
            item.differ(f"{inside} is gone")
            continue
        own_sigma = sigma.get(key) if isinstance(sigma, dict) else stated_sigma(old, key)
        compare_values(item, inside, held, fresh[key], tolerances, own_sigma)
    for key in fresh.keys() - old.keys():
        item.allowed.append((0.0, f"{where}.{key} is new".lstrip(".")))


def stated_sigma(held: dict[str, Any], key: str) -> Any:
    """Return what an object states as the sigma of one of its entries, or None.

    The entry ``value`` (or ``by``, a shift) has its error in ``sigma``, ``amplitude_nT`` in ``sigma_nT``.
    """
    if key.startswith("sigma"):
        return held[key]
    if key in ("value", "by"):
        return held.get("sigma")
    _, underscore, unit = key.rpartition("_")
    return held.get(f"sigma_{unit}") if underscore else None


def _compare_leaves(item: Item, where: str, old: Any, fresh: Any, tolerances: Tolerances, sigma: Any) -> None:
    item.values += 1
    if old == fresh and type(old) is type(fresh):
        return
    if not _are_measured(old, fresh):
        item.differ(f"{where}: {_short(old)} is now {_short(fresh)}")
        return
    if np.isnan(old) and np.isnan(fresh):
        return
    apart = abs(old - fresh)
    limit = tolerances.relative * max(abs(old), abs(fresh))
    if isinstance(sigma, float) and np.isfinite(sigma) and tolerances.sigma * sigma > limit:
        item.number(apart / (tolerances.sigma * sigma), where, f"{apart / sigma:.2g} sigma")
    else:
        item.number(_part(apart, limit), where, f"{_part(apart, max(abs(old), abs(fresh))):.2g} relative")


def _are_measured(*values: Any) -> bool:
    """Tell whether all are numbers and one at least has decimals; two whole numbers count something."""
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
    return numbers and any(isinstance(one, float) for one in values)


def _part(apart: float, limit: float) -> float:
    """Return a ratio; infinite where the numbers are not both finite."""
    return float(apart / limit) if np.isfinite(apart) and limit > 0.0 else np.inf


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False) if not isinstance(value, str) else repr(value)
    return text if len(text) <= 300 else text[:297] + "..."


# --- datasets -------------------------------------------------------------------------------------------


def _compare_table(item: Item, before: Path, after: Path, tolerances: Tolerances) -> None:
    compare_tables(item, read_table(before), read_table(after), tolerances)


def compare_tables(item: Item, old: Table, fresh: Table, tolerances: Tolerances) -> None:
    """Compare two datasets variable by variable."""
    compare_values(item, "attributes", old.attributes, fresh.attributes, tolerances)
    for name in sorted(old.values.keys() | fresh.values.keys()):
        if name not in old.values or name not in fresh.values:
            item.differ(f"{name} is {'new' if name in fresh.values else 'gone'}")
        elif old.dims[name] != fresh.dims[name] or old.values[name].shape != fresh.values[name].shape:
            shapes = [f"{one.dims[name]} {one.values[name].shape}" for one in (old, fresh)]
            item.differ(f"{name}: {shapes[0]} is now {shapes[1]}")
        elif old.values[name].dtype.kind != fresh.values[name].dtype.kind:
            item.differ(f"{name}: {old.values[name].dtype} is now {fresh.values[name].dtype}")
        else:
            _compare_variable(item, name, old, fresh, tolerances)


def _compare_variable(item: Item, name: str, old: Table, fresh: Table, tolerances: Tolerances) -> None:
    one, other = old.values[name], fresh.values[name]
    if one.dtype.kind != "f":
        compare_exactly(item, name, one, other)
        return
    if (sigma := parameter_sigma(old, name)) is not None:
        compare_floats(item, name, one, other, (tolerances.sigma, sigma, "sigma"))
    elif old.unit(name) == "nT":
        compare_floats(item, name, one, other, (tolerances.field, np.float64(1.0), "nT"))
    else:
        size = np.maximum(np.abs(one), np.abs(other))
        compare_floats(item, name, one, other, (tolerances.relative, size, "relative"))


def parameter_sigma(table: Table, name: str) -> np.ndarray | None:
    """Return the stated sigma of each value of a variable, or None where none is stated.

    ``value`` and ``sigma`` have theirs in ``sigma``; ``own`` in ``own_sigma``, ``method_value`` in
    ``method_sigma``; an element of ``covariance`` in the root of the product of its two variances.
    """
    held = table.values
    if name == "covariance" and held[name].ndim >= 2 and held[name].shape[-1] == held[name].shape[-2]:
        root = np.sqrt(np.abs(np.diagonal(held[name], axis1=-2, axis2=-1)))
        return np.asarray(root[..., :, None] * root[..., None, :])
    partner = name if name.endswith("sigma") else f"{name}_sigma"
    if name == "value" or name.endswith("_value"):
        partner = name.removesuffix("value") + "sigma"
    found = held.get(partner)
    return found if found is not None and found.shape == held[name].shape else None


def compare_exactly(item: Item, name: str, old: np.ndarray, fresh: np.ndarray) -> None:
    """Compare arrays that allow no difference."""
    item.values += old.size
    bad = np.flatnonzero((old != fresh).ravel())
    if bad.size:
        one, other = old.ravel()[bad[0]], fresh.ravel()[bad[0]]
        item.differ(f"{name}: {bad.size} of {old.size} differ, the first {one!s} is now {other!s}")


def compare_floats(
    item: Item, name: str, old: np.ndarray, fresh: np.ndarray, allowed: tuple[float, np.ndarray, str]
) -> None:
    """Compare arrays of numbers; allowed are a tolerance, in which scale (an array), and its name."""
    item.values += old.size
    same = (old == fresh) | (np.isnan(old) & np.isnan(fresh))
    if same.all():
        return
    tolerance, scale, unit = allowed
    scale = np.broadcast_to(scale, old.shape)[~same]
    apart = np.abs(old - fresh)[~same]
    known = np.isfinite(apart) & np.isfinite(scale) & (scale > 0.0)
    sizes = np.where(known, apart / np.where(known, scale, 1.0), np.inf)
    beyond = int(np.sum(sizes > tolerance * _ROUNDING))
    worst = np.unravel_index(np.flatnonzero(~same.ravel())[np.argmax(sizes)], old.shape)
    place = f"most at {[int(one) for one in worst]}"
    text = f"{sizes.max():.2g} {unit} ({apart.size} of {old.size} differ, {beyond} beyond, {place})"
    item.number(float(sizes.max() / tolerance), name, text)


# --- pages -----------------------------------------------------------------------------------------------

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def _compare_page(item: Item, before: Path, after: Path, tolerances: Tolerances) -> None:
    compare_pages(item, read_page(before), read_page(after), tolerances)


def compare_pages(item: Item, old: Page, fresh: Page, tolerances: Tolerances) -> None:
    """Compare the text of two pages line by line, and their figures one by one."""
    _compare_lines(item, "text", old.lines, fresh.lines)
    if len(old.figures) != len(fresh.figures):
        item.differ(f"{len(old.figures)} figures, now {len(fresh.figures)}")
    for place, (one, other) in enumerate(zip(old.figures, fresh.figures, strict=False)):
        _compare_figures(item, f"figure {place + 1}", one, other, tolerances)


def _compare_lines(item: Item, where: str, old: Sequence[str], fresh: Sequence[str]) -> None:
    if len(old) != len(fresh):
        gone, come = (
            [one for one in these if one not in others] for these, others in ((old, fresh), (fresh, old))
        )
        item.differ(f"{where}: {len(old)} lines, now {len(fresh)}; gone {_short(gone)}, new {_short(come)}")
        return
    item.values += len(old)
    for one, other in zip(old, fresh, strict=True):
        if one != other and differs_in_last_digits(one, other):
            item.number(1.0, f"{where}: {_short(one)} is now {_short(other)}", "last digit")
        elif one != other:
            item.differ(f"{where}: {_short(one)} is now {_short(other)}")


def differs_in_last_digits(old: str, fresh: str) -> bool:
    """Return True when two texts differ by one in the last digit of some numbers and in nothing else."""
    if _NUMBER.sub("#", old) != _NUMBER.sub("#", fresh):
        return False
    pairs = zip(_NUMBER.findall(old), _NUMBER.findall(fresh), strict=True)
    return all(one == other or _is_next(one, other) for one, other in pairs)


def _is_next(old: str, fresh: str) -> bool:
    # A whole number counts something, or is a day.
    if "." not in old or "." not in fresh:
        return False
    digits = [len(text.partition("e")[0].partition(".")[2]) for text in (old, fresh)]
    power = [int(text.partition("e")[2] or 0) for text in (old, fresh)]
    # Another number of digits is another format.
    if digits[0] != digits[1] or power[0] != power[1]:
        return False
    return abs(float(old) - float(fresh)) <= 10.0 ** (power[0] - digits[0]) * _ROUNDING


def _compare_figures(item: Item, where: str, old: Figure, fresh: Figure, tolerances: Tolerances) -> None:
    _compare_lines(item, where, old.words, fresh.words)
    if len(old.numbers) != len(fresh.numbers):
        item.differ(f"{where}: {len(old.numbers)} columns, now {len(fresh.numbers)}")
        return
    for place, (one, other) in enumerate(zip(old.numbers, fresh.numbers, strict=True)):
        name = f"{where}, column {place + 1}"
        if one.shape != other.shape:
            item.differ(f"{name}: shape {one.shape} is now {other.shape}")
        elif one.dtype.kind != "f" or other.dtype.kind != "f":
            compare_exactly(item, name, one, other)
        else:
            # What is drawn near zero is as sure as the rest of its column.
            finite = np.abs(one[np.isfinite(one)])
            size = np.float64(finite.max() if finite.size else 1.0)
            compare_floats(item, name, one, other, (tolerances.relative, size, "of the column"))


# --- telling ----------------------------------------------------------------------------------------------


def _print_items(items: Sequence[Item], every: bool) -> None:
    rows = [("case", "what", "values", "largest difference", "level")]
    for name in dict.fromkeys(item.case for item in items):
        own = [item for item in items if item.case == name]
        rows += [_row(item) for item in own if every or item.level != IDENTICAL]
        rows.append(_total(name, own))
    widths = [max(len(row[place]) for row in rows) for place in range(5)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    for item in items:
        for line in _details(item, every):
            print(line)
    counts = [
        f"{sum(one.level == level for one in items)} {level}" for level in (IDENTICAL, WITHIN, DIFFERENT)
    ]
    print(f"{len(items)} things, {sum(one.values for one in items)} values: {', '.join(counts)}")


def _row(item: Item) -> tuple[str, str, str, str, str]:
    return item.case, item.what, str(item.values), item.largest[1] or "-", item.level


def _total(name: str, items: Sequence[Item]) -> tuple[str, str, str, str, str]:
    worst = max((item.largest for item in items), default=(0.0, ""))
    levels = [item.level for item in items]
    level = next(one for one in (DIFFERENT, WITHIN, IDENTICAL) if one in levels)
    return name, f"all {len(items)}", str(sum(item.values for item in items)), worst[1] or "-", level


def _details(item: Item, every: bool) -> Iterable[str]:
    if item.level == IDENTICAL:
        return
    listed = sorted(item.differences, key=lambda one: -one[0]) + sorted(item.allowed, key=lambda one: -one[0])
    shown = listed if every else listed[:_LISTED]
    yield f"\n{item.case} {item.what}: {item.level}"
    yield from (f"  {text}" for _, text in shown)
    if len(listed) > len(shown):
        yield f"  ... and {len(listed) - len(shown)} more (--all lists them)"
