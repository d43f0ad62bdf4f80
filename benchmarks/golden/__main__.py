"""``python -m benchmarks.golden``: make a golden record, or compare two."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.golden.cases import cases
from benchmarks.golden.compare import Tolerances, compare_records
from benchmarks.golden.record import make_record

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Do what the command line says; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.golden", description="What the software gives, kept and compared"
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    _describe_make(verbs.add_parser("make", help="run the cases and keep what came out"))
    _describe_compare(verbs.add_parser("compare", help="compare two records; exit 1 when they differ"))
    verbs.add_parser("list", help="list the cases")
    given = parser.parse_args()
    if given.verb == "list":
        for case in cases().values():
            print(f"{case.name:<16} {case.title}")
        return 0
    if given.verb == "make":
        return make_record(given.folder, given.checkout, given.only, given.jobs, keep=given.keep)
    tolerances = Tolerances(given.sigma, given.field, given.relative)
    return compare_records(given.before, given.after, given.only, tolerances, every=given.all)


def _describe_make(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="where the record goes; cases in it are made anew")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=sorted(cases()), help="only these cases")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time (default: 2)")
    parser.add_argument("--checkout", type=Path, default=ROOT, help="repository to run (default: this)")
    parser.add_argument("--keep", action="store_true", help="keep the workspaces, under DIR/work")


def _describe_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("before", type=Path, help="the record to hold against")
    parser.add_argument("after", type=Path, help="the record that is judged")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these cases")
    parser.add_argument("--all", action="store_true", help="print a line for everything compared")
    default = Tolerances()
    parser.add_argument("--sigma", type=float, default=default.sigma, help="parameters, in their sigma")
    parser.add_argument("--field", type=float, default=default.field, help="fields, nT")
    parser.add_argument("--relative", type=float, default=default.relative, help="all else, relative")


if __name__ == "__main__":
    sys.exit(main())
