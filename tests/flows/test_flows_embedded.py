"""Flows on the embedded server: they do what the plain functions do, and try again only what can pass."""

import datetime as dt
from pathlib import Path

import pytest
import xarray as xr
from tiny_mission import make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.errors import CatalogError, ContentError, SettingsError, StorageError
from inflight.flows import run_with_prefect, run_without_prefect, runner
from inflight.flows.span import month_span

pytestmark = pytest.mark.usefixtures("shared_cluster")


@pytest.fixture(scope="module")
def by_flow(embedded, shared_cluster, tmp_path_factory) -> Workspace:
    """A workspace taken through the chain by flows; the told progress lies beside it."""
    return taken_through(tmp_path_factory.mktemp("flow") / "tiny", run_with_prefect)


@pytest.fixture(scope="module")
def by_hand(shared_cluster, tmp_path_factory) -> Workspace:
    """The same by the plain functions."""
    return taken_through(tmp_path_factory.mktemp("hand") / "tiny", run_without_prefect)


def taken_through(root: Path, run) -> Workspace:
    workspace = Workspace.open(make_tiny_workspace(root, days=3))
    told = []
    for name in ("ingest", "reprocess"):
        settings = {"settings": {"batch_days": 1}} if name == "reprocess" else {}
        report = run(
            name, workspace, settings, workers=2, progress=lambda *step, name=name: told.append((name, *step))
        )
        assert report.exit_code == 0
    (root / "told.txt").write_text("\n".join(" ".join(map(str, step)) for step in told), encoding="utf-8")
    return workspace


def loaded(workspace: Workspace, name: str) -> xr.Dataset:
    return Catalog(workspace.root).open(name).load()


@pytest.mark.parametrize("name", ["l1/turning", "equations/main/base", "l2/field"])
def test_a_flow_publishes_what_the_plain_functions_publish(by_flow, by_hand, name):
    xr.testing.assert_identical(loaded(by_flow, name).drop_attrs(), loaded(by_hand, name).drop_attrs())


def test_the_calibration_removes_what_the_tiny_instrument_adds(by_flow):
    product = loaded(by_flow, "l2/field")
    assert float(abs(product["residual"]).median()) < 0.1
    assert float(abs(product["residual_preflight"]).median()) > 5


def test_progress_is_told_for_every_stage_to_its_end(by_flow):
    told = [line.split() for line in (by_flow.root / "told.txt").read_text(encoding="utf-8").splitlines()]
    for stage in ("ingest", "calibrate", "tables", "produce"):
        steps = [(int(done), int(total)) for _, name, done, total in told if name == stage]
        assert steps, f"nothing was told of {stage}"
        assert steps[0][0] == 0
        assert steps[-1][0] == steps[-1][1]


def test_a_second_run_changes_nothing(by_flow):
    before = [day.version for day in Catalog(by_flow.root).days("l2/field")]
    settings = {"settings": {"batch_days": 1}}
    report = run_with_prefect("backfill", by_flow, {"start": "2024-03-01", "end": "2024-03-04", **settings})
    assert report.days["unchanged"] == 3
    assert report.days["done"] == 0
    assert [day.version for day in Catalog(by_flow.root).days("l2/field")] == before


def test_a_late_delivery_costs_only_its_own_day(embedded, tmp_path):
    workspace = taken_through(tmp_path / "late", run_without_prefect)
    late = workspace.data / "turning_20240302.csv"
    lines = late.read_text(encoding="utf-8").splitlines()
    late.write_text("\n".join([*lines[:700], *lines[703:]]) + "\n", encoding="utf-8")
    settings = {"settings": {"batch_days": 1, "table": "daily"}}
    run_without_prefect("reprocess", workspace, settings)
    span = {"start": "2024-03-02", "end": "2024-03-03"}
    report = run_with_prefect("backfill", workspace, {**span, **settings})
    assert report.extra["ingest"]["days"]["done"] == 1
    assert report.days["done"] == 1


def test_a_month_is_closed_by_its_flow_and_no_other_day_is_touched(embedded, tmp_path):
    workspace = Workspace.open(make_tiny_workspace(tmp_path / "month", days=2))
    settings = {"settings": {"table": "monthly", "batch_days": 1}}
    report = run_with_prefect("monthly", workspace, {"month": "2024-03", **settings}, workers=1)
    assert report.command == "monthly"
    assert report.days["done"] == 2
    table = Catalog(workspace.root).table("main-monthly", "2024-03-02")
    assert table.sizes["interval"] == 1
    with pytest.raises(CatalogError, match="no day of the span"):
        run_with_prefect("monthly", workspace, {"month": "2024-02", **settings}, workers=1)


@pytest.mark.parametrize(("month", "expected"), [("2024-02", "2024-02"), (None, "2023-12")])
def test_a_month_is_the_named_one_or_the_last_that_is_over(month, expected):
    span = month_span(month, dt.date(2024, 1, 31))
    assert f"{span.start:%Y-%m}" == expected
    assert span.start.day == span.end.day == 1
    with pytest.raises(SettingsError, match="YYYY-MM"):
        month_span("March", dt.date(2024, 1, 31))


@pytest.mark.parametrize(
    "parameters",
    [{"start": "soon"}, {"settings": {"batch_days": 0}}, {"settings": {"bogus": 1}}, {"bogus": 1}],
)
def test_wrong_parameters_are_refused_before_anything_runs(by_flow, parameters):
    with pytest.raises(SettingsError, match=r"soon|batch_days|bogus"):
        run_with_prefect("reprocess", by_flow, parameters)


def test_a_release_by_flow_is_copied_out_and_its_version_is_never_used_again(by_flow):
    report = run_with_prefect("release", by_flow, {"version": "1.0", "notes": "First."})
    folder = by_flow.root / report.outputs[0]
    assert (folder / "MANIFEST.sha256").is_file()
    assert "First." in (folder / "RELEASE_NOTES.md").read_text(encoding="utf-8")
    with pytest.raises(CatalogError):
        run_with_prefect("release", by_flow, {"version": "1.0"})


def tries_of(monkeypatch, error: Exception, fails: int) -> int:
    """Run a flow of one step that fails so many times; return how often it was tried."""
    from prefect import flow

    monkeypatch.setattr(runner, "RETRY_DELAYS", [0.0, 0.0, 0.0])
    tries = []

    def fragile() -> int:
        tries.append(1)
        if len(tries) <= fails:
            raise error
        return len(tries)

    @flow(name="fragile", persist_result=False)
    def run() -> int:
        return runner.PrefectRunner().run("fragile", fragile)

    try:
        run()
    except type(error):
        assert len(tries) <= fails
    return len(tries)


def test_a_failure_that_can_pass_is_tried_again(embedded, monkeypatch):
    assert tries_of(monkeypatch, StorageError("disk full"), fails=2) == 3
    assert tries_of(monkeypatch, ConnectionError("reset"), fails=9) == 4


def test_a_failure_that_would_repeat_is_not_tried_again(embedded, monkeypatch):
    assert tries_of(monkeypatch, ContentError("wrong unit"), fails=1) == 1
    assert tries_of(monkeypatch, ZeroDivisionError("defect"), fails=1) == 1
