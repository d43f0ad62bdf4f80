"""The cases: which missions, and which verbs on them, in order.

Each is small (minutes at most) and together they go through every way a comparison is calibrated: a scalar
instrument by days, windows and all days at once; the spin; the states of a spacecraft; two calibrated
fluxgates and two spinning sensors against each other; and what was measured, where those data are there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Run:
    """A command: the words behind ``inflight``, the name it is kept under, and the exit code it should have.

    ``{pages}``, ``{data}`` and ``{workspace}`` in the words are filled in.
    """

    label: str
    words: tuple[str, ...]
    ends: int = 0

    def describe(self) -> str:
        """Return the command as it is typed."""
        return " ".join(self.words)


@dataclass(frozen=True)
class Keep:
    """Keep the tables and the datasets that begin with a prefix as they are now."""

    moment: str
    prefixes: tuple[str, ...] = ("l2/",)

    def describe(self) -> str:
        """Return what is kept."""
        return f"keep {self.moment}: {' '.join(self.prefixes)}"


@dataclass(frozen=True)
class Write:
    """Write or change files by a function of the case's folder and the checkout."""

    label: str
    write: Callable[[Path, Path], None]

    def describe(self) -> str:
        """Return the name of what is written."""
        return f"write {self.label}"


Step = Run | Keep | Write


@dataclass(frozen=True)
class Case:
    """A mission and what is done with it."""

    name: str
    title: str
    steps: tuple[Step, ...]
    folder: str = ""

    @property
    def data(self) -> Path:
        """Folder of real measurements."""
        return real_data(self.folder)

    @property
    def available(self) -> bool:
        """Tell whether what it reads is there."""
        return not self.folder or self.data.is_dir()


def real_data(folder: str = "") -> Path:
    """Return a folder of real measurements, or the one that holds them all."""
    return Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data")) / folder


def cases() -> dict[str, Case]:
    """Return all cases by name, long ones first, so that two at a time end together."""
    from benchmarks.golden import measured, simulated

    return {case.name: case for case in (*simulated.CASES, *measured.CASES)}


# --- the verbs, as every case types them -----------------------------------------------------------------

#: One process and no flow: results must not depend on either, and a server takes its time to start.
_PLAIN = ("--no-prefect", "--workers", "1")


def new(mission: str) -> Run:
    """Make the workspace."""
    return Run("new", ("new", mission, "w"))


def simulate(days: int, *more: str, start: str = "2005-01-01") -> Run:
    """Simulate deliveries."""
    return Run("simulate", ("simulate", "--days", str(days), "--start", start, "--workers", "1", *more))


def ingest(*more: str) -> Run:
    """Take in what was delivered."""
    return Run("ingest", ("ingest", *more, *_PLAIN))


def reprocess(table: str, *more: str, comparison: str = "main", ends: int = 0) -> Run:
    """Calibrate; an empty table is the verb's own choice."""
    chosen = ("--table", table) if table else ()
    label = "-".join(one for one in ("reprocess", table, comparison) if one)
    return Run(label, ("reprocess", *chosen, "--comparison", comparison, *more, *_PLAIN), ends)


def compare(moment: str = "end", comparison: str = "main", ends: int = 0) -> Run:
    """Compare, and keep the page."""
    page = f"{{pages}}/compare-{comparison}-{moment}.html"
    return Run(
        f"compare-{comparison}-{moment}", ("compare", "--comparison", comparison, "--output", page), ends
    )


def chain(comparison: str = "main", ends: int = 0) -> Run:
    """Tell what the tables of all days hold, and keep the page."""
    page = f"{{pages}}/chain-{comparison}.html"
    return Run(f"chain-{comparison}", ("chain", "--comparison", comparison, "--html", page), ends)


def diagnose(*more: str, comparison: str = "main", ends: int = 0) -> Run:
    """Diagnose."""
    return Run(f"diagnose-{comparison}", ("diagnose", "--comparison", comparison, *more, *_PLAIN), ends)


def report(comparison: str = "main") -> Run:
    """Keep the page of the diagnosis."""
    page = f"{{pages}}/report-{comparison}.html"
    return Run(
        f"report-{comparison}", ("report", "--comparison", comparison, "--output", page, "--workers", "1")
    )


def change(verb: str, *words: str, ends: int = 0) -> Run:
    """Add an effect, drop it, or take the last change back."""
    return Run(verb, (verb, *words, "--workers", "1"), ends)


def look(*words: str, ends: int = 0) -> Run:
    """Look into the model or the catalog."""
    return Run("-".join(words).replace("/", "_"), words, ends)


# --- changes of a mission's files -------------------------------------------------------------------------


def replaced(file: str, *pairs: tuple[str, str]) -> Write:
    """Replace passages of a file of the workspace; each must be there once."""

    def write(work: Path, checkout: Path) -> None:
        path = work / "w" / file
        text = path.read_text(encoding="utf-8")
        for old, fresh in pairs:
            if text.count(old) != 1:
                raise SystemExit(f"{file} says {old!r} {text.count(old)} times, not once")
            text = text.replace(old, fresh)
        path.write_text(text, encoding="utf-8")

    return Write(f"{file}: {pairs}", write)


def shipped_model(name: str) -> Write:
    """Copy a model that comes with the software into the workspace."""

    def write(work: Path, checkout: Path) -> None:
        shutil.copyfile(checkout / "missions" / "models" / name, work / "w" / "models" / name)

    return Write(f"models/{name}", write)
