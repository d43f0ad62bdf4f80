"""Making cases, having them diagnosed, and scoring what is said; in processes of their own when asked."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from inflight.catalog import Catalog, Workspace
from inflight.tasks.archive import ingest

from .orbiter.case import make_case
from .scenarios import scenarios
from .score import Score, score
from .turning import TurningScenario, make_turning_case


@dataclass(frozen=True)
class Outcome:
    """What became of one case; `error` when the diagnosis raised, `told` None then."""

    name: str
    seed: int
    days: int
    simulate_s: float
    write_s: float
    diagnose_s: float
    truth: dict[str, Any]
    told: dict[str, Any] | None = None
    score: Score | None = None
    error: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain JSON."""
        return {
            "name": self.name,
            "seed": self.seed,
            "days": self.days,
            "seconds": {"simulate": self.simulate_s, "write": self.write_s, "diagnose": self.diagnose_s},
            "truth": self.truth,
            "told": self.told,
            "score": self.score.as_json() if self.score else None,
            "error": self.error,
        }


def run_case(name: str, seed: int, root: Path, diagnose: bool = True, keep: bool = False) -> Outcome:
    """Make one case below a folder, diagnose it, score it; the workspace is removed unless kept."""
    scenario, times = scenarios()[name], [time.perf_counter()]
    with threadpool_limits(1):
        turning = isinstance(scenario, TurningScenario)
        case = make_turning_case(scenario, seed) if turning else make_case(scenario, seed)
        times.append(time.perf_counter())
        workspace, truth_file = case.write(root)
        if scenario.files:
            ingest(Catalog(workspace), Workspace.open(workspace).mission(), workspace / "data")
        times.append(time.perf_counter())
        told, error = _diagnosed(workspace) if diagnose else (None, "")
        times.append(time.perf_counter())
    truth = json.loads(truth_file.read_text(encoding="utf-8"))
    if not keep:
        shutil.rmtree(workspace, ignore_errors=True)
        shutil.rmtree(workspace.parent / f"{workspace.name}-delivered", ignore_errors=True)
    spent = [later - earlier for earlier, later in pairwise(times)]
    made = score(truth, told) if told is not None else None
    return Outcome(name, seed, scenario.days, *spent, truth, told, made, error)


def _diagnosed(workspace: Path) -> tuple[dict[str, Any] | None, str]:
    """Return the diagnosis as its JSON, or the error it ended with: one case must not end all others."""
    from inflight.tasks.analysis.diagnosis import diagnose

    try:
        found = diagnose(Catalog(workspace), Workspace.open(workspace).mission())
        told = found.as_json()
        # What a person gets is text: what is no JSON is an error here, not a surprise later.
        return json.loads(json.dumps(told)), ""
    except Exception:  # the table shows its last line
        return None, traceback.format_exc().strip()


def run_cases(
    names: list[str], seeds: list[int], jobs: int, diagnose: bool = True, keep: Path | None = None
) -> Iterator[Outcome]:
    """Run every case, on so many processes; outcomes come in the order of the cases."""
    work = [(name, seed) for name in names for seed in seeds]
    with tempfile.TemporaryDirectory(prefix="physics-cases-") as scratch:
        root = keep or Path(scratch)
        if jobs == 1:
            yield from (run_case(name, seed, root, diagnose, keep is not None) for name, seed in work)
            return
        with ProcessPoolExecutor(jobs, mp_context=get_context("forkserver")) as pool:
            running = [
                pool.submit(run_case, name, seed, root, diagnose, keep is not None) for name, seed in work
            ]
            yield from (future.result() for future in running)
