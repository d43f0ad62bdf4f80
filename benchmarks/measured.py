"""What a benchmark measured: one row of the table, the machine it ran on, and the file both are kept in.

Times of the same thing on two machines say little; a ratio to the floor measured in the same run, and to the
naive way, does. A row therefore carries both where there are any.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    what : str
        What was done.
    seconds : list of float
        Wall time of each repeat.
    cpu_s, MiB : float
        Processor time of the last repeat, and the largest memory of all its processes together (shared pages
        counted once); NaN where they were not measured.
    floor_s, floor : float, str
        What the machine needs at least, measured in the same run, and what that is.
    naive_s, naive : float, str
        The same for the way one would write it first.
    aim : str
        What is asked for.
    """

    what: str
    seconds: list[float] = field(default_factory=list)
    cpu_s: float = np.nan
    MiB: float = np.nan
    floor_s: float = np.nan
    floor: str = ""
    naive_s: float = np.nan
    naive: str = ""
    aim: str = ""

    @property
    def median(self) -> float:
        """Median wall time, s."""
        return float(np.median(self.seconds))


def timed(work: Callable[[], object], repeats: int = 1) -> list[float]:
    """Return the wall time of each repeat of some work, s."""
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begun)
    return spent


def command(
    what: str, arguments: Sequence[str], folder: Path, repeats: int = 1, *, fails: bool = False
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

    Raises
    ------
    RuntimeError
        When the command does not end as it should.
    """
    seconds, cpu, most = [], np.nan, 0.0
    for _ in range(repeats):
        begun, before = time.perf_counter(), os.times()
        process = subprocess.Popen(
            [str(Path(sys.executable).with_name("inflight")), *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        watch = _Watch(process.pid)
        printed, _ = process.communicate()
        seconds.append(time.perf_counter() - begun)
        after = os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        most = max(most, watch.end())
        if (process.returncode != 0) is not fails:
            raise RuntimeError(
                f"'inflight {' '.join(arguments)}' ended with {process.returncode}:\n{printed}"
            )
    return Row(what=what, seconds=seconds, cpu_s=cpu, MiB=most)


class _Watch:
    """Looks twice a second how much memory a process and its children hold."""

    def __init__(self, pid: int) -> None:
        self._most, self._over = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._run, args=(pid,), daemon=True)
        self._thread.start()

    def _run(self, pid: int) -> None:
        while not self._over.wait(0.5):
            self._most = max(self._most, sum(_memory(one) for one in _family(pid)))

    def end(self) -> float:
        """Stop, and return the most there was, MiB; 0 where the system does not say."""
        self._over.set()
        self._thread.join()
        return self._most


def _family(pid: int) -> list[int]:
    """Return a process and all that came of it."""
    found = [pid]
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += _family(int(child))
    return found


def _memory(pid: int) -> float:
    """Return the memory of a process, shared pages divided among who shares them, MiB."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0


def table(rows: Sequence[Row]) -> list[str]:
    """Return the rows as text."""
    lines = [
        f"{'':44} {'median':>9} {'spread':>17} {'cpu':>7} {'MiB':>6}  "
        f"{'floor':>8} {'ratio':>6}  {'naive':>9} {'ratio':>8}  aim"
    ]
    for row in rows:
        low, high = min(row.seconds), max(row.seconds)
        spread = f"{low:.2f}-{high:.2f} ({len(row.seconds)})" if len(row.seconds) > 1 else "once"
        floor = f"{row.floor_s:7.2f}s {row.median / row.floor_s:6.1f}" if row.floor_s > 0 else " " * 15
        naive = f"{row.naive_s:8.1f}s {row.naive_s / row.median:7.1f}x" if row.naive_s > 0 else " " * 18
        cpu = f"{row.cpu_s:6.1f}s" if np.isfinite(row.cpu_s) else " " * 7
        memory = f"{row.MiB:6.0f}" if row.MiB > 0 else " " * 6
        lines.append(
            f"{row.what:44} {row.median:8.2f}s {spread:>17} {cpu} {memory}  {floor}  {naive}  {row.aim}"
        )
    notes = {text for row in rows for text in (row.floor, row.naive) if text}
    return [*lines, *(f"  {text}" for text in sorted(notes))]


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


def keep(name: str, rows: Sequence[Row], folder: Path = RESULTS) -> Path:
    """Write rows, machine and commit as JSON; return the file."""
    root = Path(__file__).parents[1]
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True, check=False
    ).stdout.strip()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{commit or 'unknown'}-{name}.json"
    content = {"commit": commit, "machine": machine(), "rows": [_plain(asdict(row)) for row in rows]}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


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
