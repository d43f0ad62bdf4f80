"""The table of sensors in trouble: ``python -m tests.dual.hard_table --first-seed 600 --seeds 12``."""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.dual.hard_cases import MAKERS, WORSE, make, outcome


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.dual.hard_table", description=__doc__)
    parser.add_argument("--first-seed", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=12, help="cases of each kind")
    given = parser.parse_args()
    table = Table("kind", "applied", "median ratio", "largest", "worse > 2 %")
    worse = 0
    for kind in MAKERS:
        found = [outcome(make(kind, given.first_seed + one)) for one in range(given.seeds)]
        ratio = np.array([one.ratio for one in found])
        applied, made_worse = sum(one.applied for one in found), int(np.sum(ratio > WORSE))
        worse += made_worse
        table.add_row(kind, str(applied), f"{np.median(ratio):.2f}", f"{ratio.max():.2f}", str(made_worse))
    console = Console()
    console.print(table)
    console.print(f"{worse} of {given.seeds * len(MAKERS)} made worse by more than 2 %")


if __name__ == "__main__":
    main()
