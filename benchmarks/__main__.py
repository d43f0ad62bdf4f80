"""Print all benchmarks, or those named, and keep them as JSON: see ``python -m benchmarks --help``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.measured import Row, keep, kept_file, kept_rows, table

_ALL = ["month", "growth", "fast", "ranking", "nine", "spin_fits", "spin_eight"]


def _keep_each(part: str, measured: Iterable[Row]) -> None:
    """Keep each row at once, and say it: hours of work may be interrupted, and go on with what is missing."""
    for row in measured:
        keep([replace(row, part=part)])
        told = f"{row.median:.3g} s" if row.seconds else f"{row.amount:.3g} {row.unit}"
        told += f", {row.MiB:.0f} MiB" if row.MiB > 0 else ""
        print(f"{part}: {row.what}: {told}", flush=True)


def _show_coverage(kept: Path | None, seeds: int, searched: int | None, only: str) -> None:
    from benchmarks.archive import simulated_workspace
    from benchmarks.coverage import Coverage, CoverageSettings, coverage, table
    from inflight.threads import one_thread

    settings = CoverageSettings() if searched is None else CoverageSettings(searched=searched)
    counts: list[Coverage] = []
    with tempfile.TemporaryDirectory() as scratch, one_thread():
        cat = simulated_workspace((kept or Path(scratch)) / "archive-30", 30)
        for one in coverage(cat, seeds, settings, only=only):
            counts.append(one)
            print("\n".join([*table([one])[2:3], f"  first: {one.others}"]), flush=True)
    print("\n".join(table(counts)), flush=True)


def _show_spin_coverage(seeds: int) -> None:
    from benchmarks.spin_coverage import bending_coverage, perigee_coverage, spin_coverage, table
    from inflight.threads import one_thread

    with one_thread():
        print("\n".join(table(spin_coverage(seeds) + bending_coverage(seeds))), flush=True)
        print("\n".join(table(perigee_coverage(seeds, 3) + perigee_coverage(seeds, 6))), flush=True)


def _show_table_coverage(seeds: int, only: str) -> None:
    from benchmarks.table_coverage import table, table_coverage
    from inflight.threads import one_thread

    with one_thread():
        print("\n".join(table(list(table_coverage(seeds, only)))), flush=True)


def _show_left_out(kept: Path | None, only: str) -> None:
    from benchmarks.archive import simulated_workspace
    from benchmarks.left_out import Answer, left_out, table
    from inflight.threads import one_thread

    answers: list[Answer] = []
    with tempfile.TemporaryDirectory() as scratch, one_thread():
        for one in left_out(simulated_workspace((kept or Path(scratch)) / "archive-30", 30), only=only):
            answers.append(one)
            case = one.case
            print(
                f"{one.kind:8} {case.group}: {case.name} | {'; '.join(one.told)} | left {one.part_left:.0%}",
                flush=True,
            )
    print("\n".join(table(answers)), flush=True)


def _show_real_cadence(real: Path) -> None:
    from benchmarks.real_cadence import Said, real_cadence, table
    from inflight.threads import one_thread

    said: list[Said] = []
    with one_thread():
        for one in real_cadence(real):
            said.append(one)
            print(
                f"{one.record}, {one.variant}: {one.found.verdict if one.found else one.problem}", flush=True
            )
            print(f"  {one.found.sentence if one.found else ''}", flush=True)
    print("\n".join(table(said)), flush=True)


def _show_answers(given: argparse.Namespace, which: Sequence[str]) -> None:
    """Show how right answers are: what is measured of the search's verdicts and sigmas."""
    if "coverage" in which or "table_coverage" in which:
        _show_table_coverage(given.seeds or 12, given.only if "table_coverage" in which else "")
    if "coverage" in which or "spin_coverage" in which:
        _show_spin_coverage(given.seeds or 100)
    if "coverage" in which:
        _show_coverage(given.keep, given.seeds or 200, given.searched, given.only)
    if "left_out" in which:
        _show_left_out(given.keep, given.only)
    if "real_cadence" in which:
        from benchmarks.coil_temperature import real_data

        _show_real_cadence(given.real or real_data())


def main() -> None:
    """Run the benchmarks named on the command line, or all."""
    parser = argparse.ArgumentParser(description="Speed and memory of Inflight")
    parser.add_argument(
        "which",
        nargs="*",
        choices=[
            *_ALL,
            "page",
            "table",
            "coverage",
            "table_coverage",
            "spin_coverage",
            "left_out",
            "real_cadence",
            [],
        ],
        help="when absent, all but page, coverage with its parts, left_out and real_cadence; "
        "table measures nothing and prints what is kept of this commit",
    )
    parser.add_argument("--keep", type=Path, help="folder of the simulated archives, made once and kept")
    parser.add_argument("--days", type=int, default=30, help="days of the month (30)")
    parser.add_argument(
        "--growth", type=int, nargs="*", default=[30, 100], help="lengths of growing records, days (30 100)"
    )
    parser.add_argument(
        "--one-process-up-to",
        type=int,
        default=100,
        metavar="DAYS",
        help="records of so many days are measured with one process, too (100)",
    )
    parser.add_argument("--candidates", type=int, nargs="*", default=[100, 300, 1000])
    parser.add_argument(
        "--seeds",
        type=int,
        help="missions of each pipeline (12), of a spinning sensor (100), residuals of each effect (200)",
    )
    parser.add_argument(
        "--searched", type=int, help="residuals of each effect in which the search looks for it (40)"
    )
    parser.add_argument(
        "--only",
        default="",
        help="cases of left_out, pipelines of table_coverage or effects of coverage whose name holds this",
    )
    parser.add_argument("--real", type=Path, help="folder of real measurements, for real_cadence")
    given = parser.parse_args()
    which = given.which or _ALL
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    for part, rows in _measurements(given).items():
        if part in which:
            _keep_each(part, rows())
    _show_answers(given, which)
    if set(which) & {*_ALL, "page", "table"}:
        print("\n".join(table(kept_rows(kept_file()))), flush=True)
        print(f"kept in {kept_file()}", flush=True)


def _measurements(given: argparse.Namespace) -> dict[str, Callable[[], Iterable[Row]]]:
    """Return what measures each part of the table."""
    from benchmarks.growth import growth
    from benchmarks.month import month
    from benchmarks.nine import nine_parameters
    from benchmarks.search import ranking
    from benchmarks.spin_eight import spin_eight_rows
    from benchmarks.spin_fits import spin_fit_rows

    def page() -> Iterable[Row]:
        from benchmarks.page import page

        return page(given.growth, given.keep)

    one = given.one_process_up_to
    return {
        "month": lambda: month(given.days),
        "growth": lambda: growth(given.growth, given.keep, one),
        "fast": lambda: growth([10], given.keep, one, vector_hz=50),
        "page": page,
        "ranking": lambda: (row for count in given.candidates for row in ranking(count)),
        "nine": lambda: nine_parameters(given.keep),
        "spin_fits": spin_fit_rows,
        "spin_eight": spin_eight_rows,
    }


if __name__ == "__main__":
    main()
