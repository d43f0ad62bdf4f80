"""Whether the process of a run is still alive: host, pid and the moment the process began."""

from __future__ import annotations

import os
import socket
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True)
class ProcessMark:
    """Names one process for good: a pid alone is given out again."""

    host: str
    pid: int
    process: str

    def is_gone(self) -> bool:
        """Tell whether the process has surely ended; a process of another host may be alive."""
        return self.host == socket.gethostname() and _start_of(self.pid) != self.process


def this_process() -> ProcessMark:
    """Return the mark of the calling process."""
    return ProcessMark(socket.gethostname(), os.getpid(), _start_of(os.getpid()))


def _start_of(pid: int) -> str:
    """Return when a process began, in the system's own unit; empty when there is none."""
    if not Path("/proc/self/stat").exists():
        return _start_from_ps(pid)
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", errors="replace")
    except OSError:
        return ""
    fields = stat.rpartition(")")[2].split()
    # A killed process stays as a zombie until its parent asks for it.
    return "" if fields[0] in "ZX" else f"{_boot()}:{fields[19]}"


@cache
def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("utf-8").strip()
    except OSError:
        return ""


def _start_from_ps(pid: int) -> str:
    answer = subprocess.run(
        ["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
    )
    return answer.stdout.strip()
