"""A batch of products gets the rows of the table that it needs: products are those of the whole table."""

import shutil

import pytest
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.tasks import ingest, reprocess
from inflight.tasks.pipelines import ReprocessSettings
from inflight.tasks.pipelines.base import Pipeline, product_of
from inflight.tasks.pipelines.mission_fit import MissionPipeline
from inflight.tasks.pipelines.scalar import ScalarPipeline

PIPELINES = (ScalarPipeline, MissionPipeline)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Five days, the third of which has no scalar: no data tell what noise it has."""
    root = make_tiny_workspace(tmp_path_factory.mktemp("rows") / "tiny", 5)
    workspace = Workspace.open(root)
    (file,) = workspace.data.glob("absolute_20240303.csv")
    head, *rows = file.read_text("utf-8").splitlines()
    file.write_text("\n".join([head, *(f"{row.split(',')[0]}," for row in rows)]) + "\n", encoding="utf-8")
    ingest(Catalog(root), workspace.mission(), workspace.data)
    return root


def products(archive, folder, settings):
    """Reprocess a copy of the archive; return datasets and reports of the products by day."""
    shutil.copytree(archive, folder)
    cat = Catalog(folder)
    reprocess(cat, Workspace.open(folder).mission(), settings=settings)
    days = cat.days(product_of("main"), states=("published",))
    return {str(day.day): (cat.read(day, with_time=False).load(), day.key, day.report) for day in days}


@pytest.mark.parametrize("reach_s", [0.0, 320.0], ids=["within a day", "into the neighbours"])
@pytest.mark.parametrize("table", ["window", "continuous"])
def test_products_are_those_of_the_whole_table(archive, tmp_path, monkeypatch, table, reach_s):
    settings = ReprocessSettings(table=table, window_days=2, batch_days=1)
    taken = []
    for pipeline in PIPELINES:
        monkeypatch.setattr(pipeline, "reach_s", reach_s)
        own = pipeline.rows_for

        def rows_for(self, whole, job, own=own):
            rows = own(self, whole, job)
            taken.append((rows.sizes["interval"], whole.sizes["interval"]))
            return rows

        monkeypatch.setattr(pipeline, "rows_for", rows_for)
    some = products(archive, tmp_path / "some", settings)
    assert any(rows < whole for rows, whole in taken)
    for pipeline in PIPELINES:
        monkeypatch.setattr(pipeline, "rows_for", Pipeline.rows_for)
    every = products(archive, tmp_path / "every", settings)
    assert some.keys() == every.keys()
    assert len(some) >= 4
    for day, (dataset, key, report) in some.items():
        assert dataset.identical(every[day][0])
        assert (key, report) == every[day][1:]
