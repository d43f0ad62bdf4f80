"""Writing simulated days as day files like a real mission delivers, and their truth apart."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from inflight.errors import CatalogError
from inflight.simulate.mission import MissionSettings, SimulatedDay
from inflight.tasks.delivered_cdf import Source, atomic, compact, storage, write_cdf

#: Called with the number of days done and of all days.
Progress = Callable[[int, int], None]
TRUTH = "truth"
#: What may differ between two runs into one folder where something counts from the first day: the end.
LATER_END = frozenset({"days"})


@dataclass(frozen=True)
class DayWriter:
    """How the days of a simulated spacecraft become files.

    Attributes
    ----------
    source : Source
        Whose files they are.
    simulate : callable
        Takes settings and a day; a function of a module, so that other processes find it.
    """

    source: Source
    simulate: Callable[[Any, np.datetime64], SimulatedDay]

    def truth_path(self, destination: Path, day: np.datetime64) -> Path:
        """Return where the truth of a day stands, for tests and nobody else."""
        return destination / TRUTH / f"{self.source.name}_truth_{compact(day)}.nc"

    def write(
        self,
        settings: MissionSettings,
        folder: Path,
        instruments: Sequence[str],
        *,
        needed: Collection[str] = (),
        free: Collection[str] = LATER_END,
        standard: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
        workers: int = 2,
    ) -> list[Path]:
        """Write the days that are not there yet.

        Parameters
        ----------
        settings : MissionSettings
            What to simulate.
        folder : Path
            For one folder an instrument and, apart, ``truth/``.
        instruments : sequence of str
            In the order of the paths returned; those that deliver nothing are passed over.
        needed : collection of str
            Instruments whose missing file has the whole day written again.
        free : collection of str
            Settings that may differ between two runs into one folder: they only widen the span.
        standard : mapping, optional
            Settings that older folders do not name.
        progress : callable, optional
            Called with (days done, days).
        workers : int
            Processes; 1 stays in this one. The files do not depend on it.

        Returns
        -------
        list of Path
            The delivered files of all days, in order of day and instrument; truth is not among them.

        Raises
        ------
        CatalogError
            When the folder holds files of other settings.
        StorageError
            When the disk refuses a write; days written before stay.
        """
        _claim(folder, settings, standard or {}, free)
        days = settings.day_list
        missing = [day for day in days if not self._is_complete(folder, needed, day)]
        for number, _ in enumerate(self._written(settings, folder, missing, workers), start=1):
            if progress is not None:
                progress(len(days) - len(missing) + number, len(days))
        paths = (self.source.path(folder, instrument, day) for day in days for instrument in instruments)
        return [path for path in paths if path.exists()]

    def write_day(self, settings: MissionSettings, folder: Path, day: np.datetime64) -> None:
        """Simulate and write one day, the truth last."""
        with threadpool_limits(limits=1), storage(folder, day):
            simulated = self.simulate(settings, day)
            for instrument, data in simulated.instruments.items():
                with atomic(self.source.path(folder, instrument, day)) as partial:
                    write_cdf(partial, self.source, instrument, data, day)
            _write_truth(self.truth_path(folder, day), simulated.truth)

    def _is_complete(self, folder: Path, needed: Collection[str], day: np.datetime64) -> bool:
        files = [self.truth_path(folder, day), *(self.source.path(folder, name, day) for name in needed)]
        return all(path.exists() for path in files)

    def _written(
        self, settings: MissionSettings, folder: Path, days: Sequence[np.datetime64], workers: int
    ) -> Iterator[None]:
        """Yield after each day that is written."""
        if workers <= 1 or len(days) <= 1:
            for day in days:
                self.write_day(settings, folder, day)
                yield
            return
        with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
            jobs = [pool.submit(self.write_day, settings, folder, day) for day in days]
            try:
                for job in as_completed(jobs):
                    job.result()
                    yield
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def _claim(
    folder: Path, settings: MissionSettings, standard: Mapping[str, Any], free: Collection[str]
) -> None:
    """Write the settings of a simulation into the truth folder, or check that those there are the same."""
    path, wanted = folder / TRUTH / "settings.json", settings.model_dump(mode="json")
    if path.exists():
        found = {**standard, **json.loads(path.read_text())}
        differing = sorted(key for key in set(wanted) - set(free) if found.get(key) != wanted.get(key))
        if differing:
            raise CatalogError(
                f"the folder holds a simulation with other {', '.join(differing)}",
                file=str(folder),
                remedy="choose an empty folder or the same settings",
            )
        return
    truth = {"parameters": settings.parameters.as_dict(), "effects": sorted(settings.effects)}
    with storage(folder, None), atomic(path) as partial:
        partial.write_text(json.dumps({**wanted, "truth": truth}, indent=1))


def _write_truth(path: Path, truth: xr.Dataset) -> None:
    """Write every tenth sample of the truth: enough to judge by, and small."""
    step = max(1, round(10e9 / np.diff(truth["Epoch"].values[:2]).item()))
    thinned = truth.isel(record=slice(None, None, step))
    with atomic(path) as partial:
        thinned.to_netcdf(partial, engine="h5netcdf")
