"""What a benchmark measured: one row of the table, the machine it ran on, and the file both are kept in.

Times of the same thing on two machines say little; a ratio to the floor measured in the same run, and to the
naive way, does. A row therefore carries both where there are any. All rows of a commit are in one file: what
is measured again replaces its row, so that an interrupted run loses nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
import timeit
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from inflight.flows.cluster import environment_of

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    what : str
        What was done.
    seconds : list of float
        Wall time of each repeat; empty of a row that tells an amount.
    cpu_s : float
        Processor time of the last repeat; NaN where it was not measured.
    MiB, peaks : float
        The largest memory of all processes together that was seen (shared pages counted once), and the
        largest sum of what each that lived then had held at most: what is true is between them. NaN where
        they were not measured.
    floor_s, floor : float, str
        What the machine needs at least, measured in the same run, and what that is.
    naive_s, naive : float, str
        The same for the way one would write it first.
    aim : str
        What is asked for.
    amount, whole : float
        What is told instead of a time, and what it is a part of, in `unit`.
    unit : str
    part : str
        The part of the benchmarks that measured it.
    additions_s : float
        What three million additions in Python took then, s: one machine can be twice as slow on some days.
    """

    what: str
    seconds: list[float] = field(default_factory=list)
    cpu_s: float = np.nan
    MiB: float = np.nan
    peaks: float = np.nan
    floor_s: float = np.nan
    floor: str = ""
    naive_s: float = np.nan
    naive: str = ""
    aim: str = ""
    amount: float = np.nan
    whole: float = np.nan
    unit: str = ""
    part: str = ""
    additions_s: float = np.nan

    @property
    def median(self) -> float:
        """Median wall time, s; NaN of a row that tells an amount."""
        return float(np.median(self.seconds)) if self.seconds else np.nan


def timed(work: Callable[[], object], repeats: int = 1) -> list[float]:
    """Return the wall time of each repeat of some work, s."""
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begun)
    return spent


def command(
    what: str,
    arguments: Sequence[str],
    folder: Path,
    repeats: int = 1,
    *,
    fails: bool = False,
    fresh: Path | None = None,
) -> Row:
    """Return the row of a command of the command line, in processes of its own.

    Parameters
    ----------
    arguments : sequence of str
        After ``inflight``.
    folder : Path
        Where it runs.
    fails : bool
        It is to end with an error, which is what is measured.
    fresh : Path, optional
        A copy of this folder takes the place of `folder` before each repeat, which is not measured.

    Raises
    ------
    RuntimeError
        When the command does not end as it should.
    """
    seconds, cpu, most, peaks = [], np.nan, 0.0, 0.0
    for _ in range(repeats):
        if fresh is not None:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(fresh, folder, symlinks=True)
            os.sync()
        begun, before = time.perf_counter(), os.times()
        process = subprocess.Popen(
            [str(Path(sys.executable).with_name("inflight")), *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        watch = _Watch(process.pid)
        try:
            printed, _ = process.communicate()
        except BaseException:
            # Who interrupts a run of hours finds neither its processes nor its folders.
            process.terminate()
            process.wait()
            raise
        seconds.append(time.perf_counter() - begun)
        after = os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        watch.end()
        most, peaks = max(most, watch.most), max(peaks, watch.peaks)
        if (process.returncode != 0) is not fails:
            raise RuntimeError(
                f"'inflight {' '.join(arguments)}' ended with {process.returncode}:\n{printed}"
            )
    return Row(what=what, seconds=seconds, cpu_s=cpu, MiB=most, peaks=peaks)


def first_time(
    what: str, arguments: Sequence[str], folder: Path, repeats: int = 1, *, undone: bool = False
) -> Row:
    """Return the row of a command that changes its folder: each repeat finds the folder as it was.

    Parameters
    ----------
    what, arguments, folder, repeats
        As of `command`.
    undone : bool
        The folder is as it was afterwards, too.
    """
    if repeats == 1 and not undone:
        return command(what, arguments, folder)
    before = folder.with_name(f"{folder.name}-before")
    shutil.copytree(folder, before, symlinks=True)
    row = command(what, arguments, folder, repeats, fresh=before)
    if undone:
        shutil.rmtree(folder)
        before.rename(folder)
    else:
        shutil.rmtree(before)
    return row


def in_process(
    work: Callable[..., list[Row]], *arguments: Any, environment: Mapping[str, str] | None = None
) -> list[Row]:
    """Return the rows that some work in a process of its own measures, with the memory of that process.

    Parameters
    ----------
    work : callable
        Of a module, with the arguments that follow.
    environment : mapping, optional
        Variables of that process: what it reads when it starts, such as how it keeps memory.
    """
    with (
        environment_of(environment or {}),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        watch = _Watch(pool.submit(os.getpid).result())
        rows = pool.submit(work, *arguments).result()
        watch.end()
    return [replace(row, MiB=watch.most, peaks=watch.peaks) for row in rows]


class _Watch:
    """Looks up to ten times a second how much memory a process and its children hold.

    A look goes through all pages, some 10 ms a GiB: it takes no more than a twentieth of a core.

    Attributes
    ----------
    most, peaks : float
        As `MiB` and `peaks` of a row; 0 where the system does not say.
    """

    def __init__(self, pid: int) -> None:
        self.most, self.peaks, self._over = 0.0, 0.0, threading.Event()
        self._thread = threading.Thread(target=self._run, args=(pid,), daemon=True)
        self._thread.start()

    def _run(self, pid: int) -> None:
        over = False
        while not over:
            # What has ended by now is looked at once more, if it is still there.
            over, begun = self._over.is_set(), time.perf_counter()
            family = _family(pid)
            self.most = max(self.most, sum(_memory(one, "smaps_rollup", "Pss:") for one in family))
            # The system keeps the most that a process held: what was between two looks is in it.
            self.peaks = max(self.peaks, sum(_memory(one, "status", "VmHWM:") for one in family))
            self._over.wait(max(0.1, 20.0 * (time.perf_counter() - begun)))

    def end(self) -> None:
        """Stop looking."""
        self._over.set()
        self._thread.join()


def _family(pid: int) -> list[int]:
    """Return a process and all that came of it."""
    found = [pid]
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += _family(int(child))
    return found


def _memory(pid: int, file: str, word: str) -> float:
    """Return what the system tells of the memory of a process, MiB; ``Pss`` divides pages among sharers."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/{file}").read_text().splitlines():
            if line.startswith(word):
                return int(line.split()[1]) / 1024
    return 0.0


def table(rows: Sequence[Row]) -> list[str]:
    """Return the rows as text, under the names of their parts."""
    width = max([44, *(len(row.what) for row in rows)])
    lines = [
        f"{'':{width}} {'median':>9} {'spread':>17} {'cpu':>7} {'MiB':>6}  "
        f"{'floor':>9} {'ratio':>6}  {'naive':>9} {'ratio':>8}  aim"
    ]
    part = ""
    for row in rows:
        if row.part != part:
            part = row.part
            lines.append(f"-- {part}")
        if not row.seconds:
            share = f"{100.0 * row.amount / row.whole:.1f} % of {row.whole:.4g} {row.unit}"
            lines.append(f"{row.what:{width}} {row.amount:8.4g} {row.unit}, {share:56}  {row.aim}")
            continue
        low, high = min(row.seconds), max(row.seconds)
        spread = f"{_brief(low)}-{_brief(high)} ({len(row.seconds)})" if len(row.seconds) > 1 else "once"
        floor = f"{_brief(row.floor_s):>8}s {row.median / row.floor_s:6.1f}" if row.floor_s > 0 else " " * 16
        naive = f"{row.naive_s:8.1f}s {row.naive_s / row.median:7.1f}x" if row.naive_s > 0 else " " * 18
        cpu = f"{row.cpu_s:6.1f}s" if np.isfinite(row.cpu_s) else " " * 7
        memory = f"{row.MiB:6.0f}" if row.MiB > 0 else " " * 6
        time_s = f"{_brief(row.median):>8}s"
        lines.append(f"{row.what:{width}} {time_s} {spread:>17} {cpu} {memory}  {floor}  {naive}  {row.aim}")
    notes = {text for row in rows for text in (row.floor, row.naive) if text}
    return [*lines, *(f"  {text}" for text in sorted(notes))]


def _brief(seconds: float) -> str:
    """Return a time with two decimals, or as many as a shorter one needs."""
    return f"{seconds:.2f}" if seconds >= 0.1 else f"{seconds:.2g}"


def machine() -> dict[str, object]:
    """Return what the numbers were measured on."""
    info = Path("/proc/cpuinfo")
    text = info.read_text() if info.is_file() else ""
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_GiB": round(memory, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "blas": [f"{one['internal_api']} {one['version']}" for one in threadpool_info()],
    }


def keep(rows: Sequence[Row], folder: Path = RESULTS) -> Path:
    """Write rows, machine and commit as JSON, with the rows that are there of the commit; return the file.

    Rows of another machine stay in a file of their own.
    """
    path = kept_file(folder)
    now = min(timeit.repeat("for one in range(3_000_000): total += one", "total = 0", number=1, repeat=3))
    rows = [replace(row, additions_s=now) for row in rows]
    # A row that was measured again stays where it was, and a part's rows together.
    both = {(row.part, row.what): row for row in [*kept_rows(path), *rows]}
    parts = list(dict.fromkeys(part for part, _ in both))
    ordered = sorted(both.values(), key=lambda row: parts.index(row.part))
    content = {
        "commit": _commit(),
        "machine": machine(),
        "rows": [_plain(asdict(row)) for row in ordered],
    }
    folder.mkdir(parents=True, exist_ok=True)
    # An interrupted run leaves the file as it was.
    written = path.with_suffix(".part")
    written.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    written.replace(path)
    return path


def kept_file(folder: Path = RESULTS) -> Path:
    """Return the file of this commit and machine; it need not be there yet."""
    commit, own, number = _commit() or "unknown", _hardware(machine()), 1
    while True:
        path = folder / f"{commit}{f'-machine{number}' if number > 1 else ''}.json"
        if not path.is_file() or _hardware(json.loads(path.read_text(encoding="utf-8"))["machine"]) == own:
            return path
        number += 1


def _hardware(described: dict[str, object]) -> dict[str, object]:
    """Return a machine's description without the libraries, which are told once something has loaded them."""
    return {name: value for name, value in described.items() if name != "blas"}


def kept_rows(path: Path) -> list[Row]:
    """Return the rows of a file; none where there is no such file."""
    if not path.is_file():
        return []
    return [Row(**row) for row in json.loads(path.read_text(encoding="utf-8"))["rows"]]


@cache
def _commit() -> str:
    """Return the commit that was there when it was first asked for."""
    root = Path(__file__).parents[1]
    command = ["git", "describe", "--always", "--dirty"]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, check=False).stdout.strip()


def _plain(row: dict[str, object]) -> dict[str, object]:
    """Return a row without what was not measured, its numbers with sensible digits."""
    out: dict[str, object] = {}
    for name, value in row.items():
        if isinstance(value, float) and np.isfinite(value):
            out[name] = float(f"{value:.4g}")
        elif isinstance(value, list):
            out[name] = [float(f"{one:.4g}") for one in value]
        elif isinstance(value, str) and value:
            out[name] = value
    return out
