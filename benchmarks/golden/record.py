"""Making a record: the steps of each case run as commands of a checkout, and what they give written down.

A record is a folder with one folder a case:

```
case.json        what was run, in order; the compared record must have run the same
times.json       seconds of each command (not compared)
steps/           one JSON a command: exit code and what it printed
pages/           the HTML pages
data/<moment>/   products, archive and tables at a moment, as `export` writes them
log.txt          what the commands wrote to standard error (not compared)
```
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.golden.cases import Case, Keep, Run, Write, cases

_EXPORTER = Path(__file__).with_name("export.py")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: No command of a case takes as long, s.
_LIMIT = 900


def make_record(
    folder: Path, checkout: Path, only: Sequence[str] | None, jobs: int, *, keep: bool = False
) -> int:
    """Run the cases and keep what came out; return 1 when one could not be recorded, else 0.

    Parameters
    ----------
    folder : Path
        The record; cases that are made again replace what it held of them.
    checkout : Path
        The repository whose software runs.
    only : sequence of str or None
        Names of cases; None for all whose data are there.
    jobs : int
        Cases at a time.
    keep : bool
        Keep the workspaces under ``work``.
    """
    folder, checkout = folder.resolve(), checkout.resolve()
    chosen = [case for name, case in cases().items() if only is None or name in only]
    missing = [case for case in chosen if not case.available]
    for case in missing:
        print(f"{case.name:<16} left out: no real measurements at {case.data}")
    _check_checkout(checkout)
    begun, failed = time.monotonic(), 0
    with ThreadPoolExecutor(jobs) as pool:
        todo = [pool.submit(_record_case, folder, checkout, case, keep) for case in chosen if case.available]
        for done in as_completed(todo):
            line, fine = done.result()
            failed += not fine
            print(line, flush=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_time = f"{time.monotonic() - begun:.0f} s ({used.ru_utime + used.ru_stime:.0f} s of processors)"
    print(f"{len(todo)} cases in {used_time}, record in {folder}")
    return 1 if failed or (only and missing) else 0


def _check_checkout(checkout: Path) -> None:
    """Make sure that the commands run the software of the checkout and no other."""
    code = "import inflight; print(inflight.__file__)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env=_environment(checkout),
        capture_output=True,
        text=True,
        check=True,
    )
    found = Path(done.stdout.strip())
    if not found.is_relative_to(checkout):
        raise SystemExit(f"the software that runs is {found}, not that of {checkout}")


def _environment(checkout: Path, home: Path | None = None) -> dict[str, str]:
    """Return the environment of the commands: one thread, a Prefect of its own, no colours."""
    environment = dict(os.environ) | dict.fromkeys(_THREADS, "1")
    environment |= {"PYTHONPATH": str(checkout), "COLUMNS": "200", "NO_COLOR": "1", "TZ": "UTC"}
    if home is not None:
        environment |= {"PREFECT_HOME": str(home), "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
    return environment


def _record_case(folder: Path, checkout: Path, case: Case, keep: bool) -> tuple[str, bool]:
    target = folder / case.name
    shutil.rmtree(target, ignore_errors=True)
    begun = time.monotonic()
    if keep:
        work = folder / "work" / case.name
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        bench = _Bench(case, checkout, work, target)
        bench.run()
    else:
        with tempfile.TemporaryDirectory(prefix="golden-", ignore_cleanup_errors=True) as scratch:
            bench = _Bench(case, checkout, Path(scratch).resolve(), target)
            bench.run()
    seconds = time.monotonic() - begun
    ends = ", ".join(f"{label} ended with {code}" for label, code in bench.unexpected)
    return f"{case.name:<16} {seconds:6.1f} s  {ends or 'recorded'}", not bench.unexpected


@dataclass
class _Bench:
    """One case being recorded: where it works, and what has been run so far."""

    case: Case
    checkout: Path
    work: Path
    target: Path
    times: dict[str, float] = field(default_factory=dict)
    unexpected: list[tuple[str, int]] = field(default_factory=list)

    def run(self) -> None:
        """Carry out the steps in order, and write down what was run."""
        for name in ("steps", "pages"):
            (self.target / name).mkdir(parents=True)
        for step in self.case.steps:
            if isinstance(step, Write):
                step.write(self.work, self.checkout)
            elif isinstance(step, Keep):
                self._keep(step)
            else:
                self._run(step)
        _write_json(self.target / "case.json", {"steps": [step.describe() for step in self.case.steps]})
        _write_json(self.target / "times.json", self.times)

    def _run(self, step: Run) -> None:
        begun = time.monotonic()
        known = {"pages": self.target / "pages", "data": self.case.data, "workspace": self.work / "w"}
        words = [word.format(**known) for word in step.words]
        # `new` makes the folder that all others work in.
        where = [] if step.words[0] == "new" else ["--workspace", "w"]
        done = self._command([str(_program()), *words, "--json", *where])
        label = f"{len(self.times):02d}-{step.label}"
        self.times[label] = round(time.monotonic() - begun, 2)
        if done.returncode != step.ends:
            self.unexpected.append((label, done.returncode))
            print(f"{self.case.name}: {label} ended with {done.returncode}, not {step.ends}", flush=True)
        printed = _parsed(self._without_paths(done.stdout))
        _write_json(self.target / "steps" / f"{label}.json", {"exit": done.returncode, "printed": printed})
        self._log(label, done.stderr)

    def _command(self, words: Sequence[str]) -> subprocess.CompletedProcess[str]:
        environment = _environment(self.checkout, self.work / "prefect")
        return subprocess.run(
            words, cwd=self.work, env=environment, capture_output=True, text=True, timeout=_LIMIT, check=False
        )

    def _keep(self, step: Keep) -> None:
        begun = time.monotonic()
        done = self._command([str(_program()), "catalog", "list", "--json", "--workspace", "w"])
        listing, label = self.work / "listing.json", f"{len(self.times):02d}-keep-{step.moment}"
        listing.write_text(done.stdout, encoding="utf-8")
        _write_json(
            self.target / "steps" / f"{label}.json",
            {"exit": done.returncode, "printed": _parsed(done.stdout)},
        )
        folder = self.target / "data" / step.moment
        exporter = [sys.executable, "-P", str(_EXPORTER), "w", str(listing), str(folder), *step.prefixes]
        done = self._command(exporter)
        self.times[label] = round(time.monotonic() - begun, 2)
        if done.returncode:
            self.unexpected.append((label, done.returncode))
        self._log(label, done.stderr)

    def _log(self, label: str, text: str) -> None:
        if text:
            with (self.target / "log.txt").open("a", encoding="utf-8") as file:
                file.write(f"--- {label}\n{text}\n")

    def _without_paths(self, text: str) -> str:
        """Name the folders of this machine by what they are."""
        named = {
            self.target: "<record>",
            self.work: "<work>",
            self.case.data: "<data>",
            self.checkout: "<checkout>",
        }
        for path, name in named.items():
            text = text.replace(str(path), name)
        return text


def _program() -> Path:
    """Return the command line that was installed with this Python."""
    return Path(sys.executable).with_name("inflight")


def _parsed(text: str) -> Any:
    """Return what a command printed: an object, or its lines where it is none."""
    try:
        return json.loads(text)
    except ValueError:
        return text.splitlines()


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
