"""Print the coverage of zero levels in simulated natures: `python tests/zero_level/coverage_table.py`.

A record of each seed with an offset of its own, three axes: the part of the errors within one and two stated
sigmas, their rms, and the part of the records that tell a level at all (docs/science/zero-level.md).
"""

import argparse
from functools import partial

import numpy as np
from nature import magnetosheath, solar_wind
from weather import sheath, wind

from inflight.zero_level import Intervals, combine_methods


def kind(nature, seed, **settings):
    return nature(np.random.default_rng([seed, 80]), **settings)


#: Records by name, and the length of their intervals, s.
NATURES = {
    "kind wind, compression 3 %": (partial(kind, solar_wind, compressed=0.03), 1800.0),
    "kind wind, 10 %": (partial(kind, solar_wind, compressed=0.10), 1800.0),
    "kind wind, 20 %": (partial(kind, solar_wind, compressed=0.20), 1800.0),
    "kind sheath, 25 %": (partial(kind, magnetosheath), 300.0),
    "wind": (wind, 1800.0),
    "wind, compressed 15 %": (partial(wind, compressed=0.15), 1800.0),
    "sheath": (sheath, 300.0),
}


def main() -> None:
    """Print a row of each method and of the combined level, nature by nature."""
    parser = argparse.ArgumentParser(description="Coverage of zero levels")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=9000)
    given = parser.parse_args()
    print("| nature | method | told | 1 sigma | 2 sigma | rms, nT |\n|---|---|---|---|---|---|")
    for name, (nature, length) in NATURES.items():
        errors: dict[str, list[np.ndarray]] = {}
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            offset = np.random.default_rng([seed, 79]).normal(size=3)
            times, field = nature(seed)
            found = combine_methods(Intervals.of(times, field + offset, length))
            for one in (*found.methods, found.estimate):
                off = np.where(one.determined, one.solution - offset, np.nan)
                errors.setdefault(one.method.partition(" (")[0], []).append(np.stack([off, one.sigma]))
        for method, each in errors.items():
            off, sigma = np.concatenate(each, axis=1)
            told = np.isfinite(off)
            size = np.abs(off[told] / sigma[told])
            shares = f"{np.mean(size < 1):.2f} | {np.mean(size < 2):.2f}" if told.any() else "- | -"
            rms = np.sqrt(np.mean(off[told] ** 2)) if told.any() else np.nan
            part = told.sum() / (3 * given.seeds)
            print(f"| {name} | {method} | {part:.2f} | {shares} | {rms:.3f} |", flush=True)


if __name__ == "__main__":
    main()
