"""What two Dask processes make has the bytes of what this process makes alone."""

import shutil
from pathlib import Path

import pytest
from heated_mission import make_heated_workspace

from benchmarks.archive import simulated_workspace
from inflight.catalog import Catalog, Workspace
from inflight.flows import dask_client
from inflight.simulate import SimulationSettings
from inflight.tasks.analysis import DiagnoseSettings, diagnose
from inflight.tasks.pipelines import ReprocessSettings, reprocess

#: Coarser than the data, so that what is found is estimated again at their own cadence, in blocks of its own.
SEARCH = DiagnoseSettings(cadence_s=120, draws=100, rounds=1, batch_blocks=1)
CONTINUOUS = ReprocessSettings(table="continuous", trend="linear", batch_days=1)
SIMULATION, DAYS = SimulationSettings(seed=5, cadence=10), 3


@pytest.fixture(scope="module")
def two_processes():
    """A client of two processes."""
    with dask_client(2) as client:
        yield client


def work_of_each(client) -> list[int]:
    """Return how many batches each process has done."""
    return list(client.run(lambda dask_worker: dask_worker.state.executed_count).values())


def manifest(cat: Catalog, store: str) -> str:
    """Return the sha256 of every file of a store."""
    return (cat.workspace / store / "MANIFEST.sha256").read_text(encoding="utf-8")


def stores(cat: Catalog, *names: str) -> dict[tuple[str, str], str]:
    """Return the manifests of the published stores of datasets, by dataset and day."""
    days = [day for name in names for day in cat.days(name, states=("published",))]
    return {(day.dataset, str(day.day)): manifest(cat, day.segment) for day in days}


def beside(root: Path) -> Path:
    """Return a copy of a workspace."""
    return Path(shutil.copytree(root, root.with_name("parallel")))


def test_a_diagnosis_makes_the_same_blocks_and_says_the_same_on_two_processes(two_processes, tmp_path):
    serial = make_heated_workspace(tmp_path / "serial").root
    parallel, before = beside(serial), work_of_each(two_processes)
    made, said = [], []
    for root, client in ((serial, None), (parallel, two_processes)):
        cat, mission = Catalog(root), Workspace.open(root).mission()
        said.append(diagnose(cat, mission, settings=SEARCH, client=client).as_json() | {"run": ""})
        made.append(stores(cat, "equations/main/library", "equations/main/native"))
    assert all(now > then for now, then in zip(work_of_each(two_processes), before, strict=True))
    assert made[0] == made[1]
    assert len(made[0]) == 2 * 4
    assert said[0] == said[1]


def test_a_fit_of_all_days_makes_the_same_tables_and_products_on_two_processes(two_processes, tmp_path):
    serial, model = tmp_path / "serial", "champ-chain.yaml"
    simulated_workspace(serial, DAYS, settings=SIMULATION, model=model, workers=1)
    parallel, before = beside(serial), work_of_each(two_processes)
    made, tables = [], []
    for root, client in ((serial, None), (parallel, two_processes)):
        cat, mission = Catalog(root), Workspace.open(root).mission()
        assert reprocess(cat, mission, settings=CONTINUOUS, client=client).days["done"] == DAYS
        made.append(stores(cat, "equations/main/chain", "l2/field"))
        tables.append([(one.name, manifest(cat, one.segment)) for one in cat.tables()])
    assert all(now > then for now, then in zip(work_of_each(two_processes), before, strict=True))
    assert made[0] == made[1]
    assert len(made[0]) == 2 * DAYS
    assert tables[0] == tables[1]
    assert {"main-continuous", "main-trend"} <= {name for name, _ in tables[0]}
