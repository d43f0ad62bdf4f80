"""Which settings a verdict depends on: each number that a search reads is halved and doubled.

One small flight with several residuals: causes of several kinds, an unknown line, a drift, noise alone. A
setting changes a mission when the verdict, an entry or how sure it is differs; lags and times may move.

``python tests/cases/settings_table.py`` prints the table, a line for each setting that was read.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import re
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from diagnosis_cases import POLAR, Case, case_of, flight_of, read

import inflight.diagnosis
import inflight.lsq
from inflight.diagnosis import Diagnosis, Rules
from inflight.samples.derived import play, slow_response

#: Rooms whose settings a search may read.
ROOMS = (inflight.diagnosis, inflight.lsq)

Outcome = tuple[str, tuple[tuple[str, str], ...]]


@lru_cache(maxsize=1)
def case() -> tuple[Case, tuple[str, ...]]:
    """Return a flight of twenty days with a residual for each mission, and what is hidden in each."""
    flight = flight_of(POLAR, 20)
    g = np.random.default_rng(1)
    along = np.array([0.8, -0.5, 0.6])
    axis_z = np.array([0.0, 0.0, 1.0])
    heater, boom, solar, battery = (
        (values - values.mean()) / values.std()
        for values in (
            flight[name]
            for name in ("heater_current", "boom_temperature", "solar_current", "battery_current")
        )
    )
    strength = np.linalg.norm(flight["field"], axis=1)
    count, seconds = strength.size, (flight.tt2000 - flight.tt2000[0]) / 1e9
    walk = np.cumsum(g.normal(size=count)) / np.sqrt(count)
    fields_of = {
        "a heater": heater[:, None] * along * 0.12,
        "a weak heater": heater[:, None] * along * 0.03,
        "a slow response": slow_response(solar, 120.0, 1500.0)[:, None] * along * 0.12,
        "a play": play(boom, 1.2)[:, None] * along * 0.15,
        "a step": (seconds > 0.55 * seconds[-1])[:, None] * along * 0.25,
        "a line": np.sign(np.sin(2 * np.pi * seconds / 2460.0))[:, None] * axis_z * 0.2,
        "two currents": solar[:, None] * along * 0.1 + battery[:, None] * along[::-1] * 0.08,
        "a drift": (walk * strength * 8e-6)[:, None] * flight.direction,
        "noise alone": np.zeros((count, 3)),
    }
    scalars = {"a bias by heat": 0.1 * boom, "a clock": 0.02 * np.gradient(strength, seconds)}
    hidden = [read(flight, seed, field=one) for seed, one in enumerate(fields_of.values())]
    hidden += [read(flight, 50 + seed, scalar=one) for seed, one in enumerate(scalars.values())]
    return case_of(flight, hidden), (*fields_of, *scalars)


def outcome(found: Diagnosis) -> Outcome:
    """Return what a reader would call the answer."""
    entries = tuple((one.name.partition("@")[0], one.status) for one in found.entries)
    return found.verdict, entries


def every_setting() -> Iterator[tuple[str, Any, str]]:
    """Yield name, object and field of each number of the settings."""
    seen = set()
    for room in ROOMS:
        for module in pkgutil.iter_modules(room.__path__):
            loaded = importlib.import_module(f"{room.__name__}.{module.name}")
            for name, value in sorted(vars(loaded).items()):
                if not name.endswith("_SETTINGS") or not is_dataclass(value) or id(value) in seen:
                    continue
                seen.add(id(value))
                for one in fields(value):
                    if type(getattr(value, one.name)) in (int, float, tuple):
                        yield f"{name}.{one.name}", value, one.name
    rules = Rules()
    for one in fields(rules):
        if type(getattr(rules, one.name)) in (int, float) and one.name != "seed":
            yield f"Rules.{one.name}", None, one.name


def times(value: Any, factor: float) -> Any:
    """Return a setting times a factor, of its own type."""
    if isinstance(value, tuple):
        return tuple(times(one, factor) for one in value)
    if isinstance(value, int):
        return max(1, round(value * factor))
    return value * factor


@contextmanager
def changed(owner: Any, field: str, value: Any) -> Iterator[None]:
    """Set a setting for a while."""
    if owner is None:
        yield
        return
    before = getattr(owner, field)
    object.__setattr__(owner, field, value)
    try:
        yield
    finally:
        object.__setattr__(owner, field, before)


def outcomes(name: str, factor: float) -> list[Outcome]:
    """Return the answer of every mission with one setting times a factor; an error is an answer, too."""
    every = every_setting() if name else ()
    owner, field = next(((o, f) for n, o, f in every if n == name), (None, ""))
    value = times(getattr(owner or Rules(), field), factor) if field else None
    rules = {field: value} if field and owner is None else {}
    flight, missions = case()
    out: list[Outcome] = []
    with changed(owner, field, value):
        for place in range(len(missions)):
            try:
                out.append(outcome(flight.diagnose(place, **rules)))
            except Exception as error:
                out.append((f"{type(error).__name__}: {error}"[:60], ()))
    return out


@contextmanager
def recording(read_names: set[str]) -> Iterator[None]:
    """Note which settings are read."""
    classes = {}
    for name, owner, _ in every_setting():
        if owner is not None:
            classes[type(owner)] = name.partition(".")[0]
    plain = object.__getattribute__

    def note(title: str) -> Any:
        def get(self: Any, name: str) -> Any:
            read_names.add(f"{title}.{name}")
            return plain(self, name)

        return get

    for kind, title in classes.items():
        kind.__getattribute__ = note(title)
    try:
        yield
    finally:
        for kind in classes:
            del kind.__getattribute__


def _pair(name: str) -> tuple[str, list[Outcome], list[Outcome]]:
    return name, outcomes(name, 0.5), outcomes(name, 2.0)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="settings in whose name this regular expression is found")
    given = parser.parse_args()
    read_names: set[str] = set()
    with recording(read_names):
        usual = outcomes("", 1.0)
    missions = case()[1]
    for mission, (verdict, entries) in zip(missions, usual, strict=True):
        print(f"{mission}: {verdict} {entries}", flush=True)
    known = {name: getattr(owner or Rules(), field) for name, owner, field in every_setting()}
    names = [name for name in known if name in read_names or name.startswith("Rules.")]
    print(f"{len(names)} of {len(known)} settings are read", flush=True)
    names = [name for name in names if re.search(given.only, name)]
    print("| setting | value | halved | doubled |\n|---|---|---|---|")
    with ProcessPoolExecutor(given.jobs) as pool:
        for name, half, double in pool.map(_pair, names):
            cells = [
                ", ".join(
                    f"{mission}: {after[0]}" if after[0] != before[0] else mission
                    for mission, before, after in zip(missions, usual, found, strict=True)
                    if before != after
                )
                for found in (half, double)
            ]
            print(f"| `{name}` | {known[name]} | {cells[0] or '-'} | {cells[1] or '-'} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
