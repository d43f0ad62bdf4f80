"""Every registered pipeline, and the one to copy, keeps the contract; a wrong one is told what to mend."""

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from boom_mission import make_boom_workspace
from threadpoolctl import threadpool_info, threadpool_limits
from tiny_mission import (
    TINY_GAIN,
    TINY_OFFSET,
    TINY_START,
    TINY_YAML,
    make_tiny_workspace,
    tiny_readings,
)

from inflight.calibration import fit_difference, fit_squares
from inflight.catalog import Catalog, Workspace, shipped_missions
from inflight.errors import ConformanceError, MissionError
from inflight.mission import Mission
from inflight.simulate.dual import DualSettings
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import (
    PIPELINES,
    Pipeline,
    ReprocessSettings,
    Versions,
    check_pipeline,
    find_pipeline,
    pipeline_of,
    reprocess,
)
from inflight.tasks.pipelines.base import newest_table
from inflight.tasks.pipelines.scalar import ScalarPipeline

ROOT = Path(__file__).parents[2]
BY_TAG = {one.tag: one for one in PIPELINES}


@pytest.fixture
def template(monkeypatch) -> Pipeline:
    """The pipeline to copy, imported as a module of its own."""
    spec = importlib.util.spec_from_file_location("own_pipeline", ROOT / "docs" / "templates" / "pipeline.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "own_pipeline", module)
    spec.loader.exec_module(module)
    return module.GainPipeline()


@pytest.fixture(scope="module")
def ingested(tmp_path_factory) -> Workspace:
    """Two days of the tiny mission, nothing calibrated."""
    made = Workspace.open(make_tiny_workspace(tmp_path_factory.mktemp("tiny") / "w"))
    ingest(Catalog(made.root), made.mission(), made.data)
    return made


@pytest.fixture
def tiny(ingested, tmp_path) -> Workspace:
    shutil.copytree(ingested.root, tmp_path / "copy")
    return Workspace.open(tmp_path / "copy")


@pytest.mark.parametrize(("form", "fit"), [("difference", fit_difference), ("squares", fit_squares)])
def test_a_published_form_that_is_asked_for_makes_the_tables_and_is_named(tiny, form, fit):
    text = TINY_YAML.replace("scalar: absolute}}", f"scalar: absolute, estimate: {form}}}}}")
    (tiny.root / "mission.yaml").write_text(text, encoding="utf-8")
    cat = Catalog(tiny.root)
    assert reprocess(cat, tiny.mission(), settings=ReprocessSettings(window_days=2)).exit_code == 0
    days = [np.datetime64(TINY_START, "D") + one for one in range(2)]
    read = [[values.round(3) for values in tiny_readings(str(day))[1:]] for day in days]
    daily, window = (newest_table(cat, f"main-{name}") for name in ("daily", "window"))
    for row, both in zip(daily["value"].values, read, strict=True):
        np.testing.assert_allclose(row, fit(*both), rtol=1e-9, atol=1e-6)
    joined = fit(*(np.concatenate(one) for one in zip(*read, strict=True)))
    np.testing.assert_allclose(window["value"].values[0], joined, rtol=1e-9, atol=1e-6)
    # One pass misses the exact fit by more than noise does: that is stated, and the truth is covered.
    truth = np.concatenate([1.0 / TINY_GAIN, np.full(3, 90.0), TINY_OFFSET])
    pulls = (window["value"].values[0] - truth) / window["sigma"].values[0]
    assert np.abs(pulls).max() < 4.0
    assert daily["estimate"].values.tolist() == [form, form]
    method = cat.read_day("l2/field", days[0]).attrs["calibration_method"]
    assert method.endswith(f"estimate {form}")
    # The fit of all days has none: it is made all the same, and that is said.
    if form == "difference":
        report = reprocess(cat, tiny.mission(), settings=ReprocessSettings(table="continuous"))
        assert newest_table(cat, "main-continuous") is not None
        assert any(f"estimate: '{form}'" in one for one in report.extra["warnings"])


@pytest.fixture(scope="module")
def boom(tmp_path_factory) -> Workspace:
    """A quarter of a day of two spinning sensors."""
    return make_boom_workspace(tmp_path_factory.mktemp("boom"), days=1)


@pytest.mark.parametrize("pipeline", PIPELINES, ids=list(BY_TAG))
def test_every_pipeline_describes_itself(pipeline):
    check_pipeline(pipeline)


@pytest.mark.parametrize(("tag", "table"), [("scalar", "window"), ("mission", "continuous")])
def test_a_scalar_comparison_keeps_the_contract(tiny, tag, table):
    if tag == "mission":
        # What single days determine is shown beside the fit of all days.
        reprocess(Catalog(tiny.root), tiny.mission())
    check_pipeline(BY_TAG[tag], tiny, ReprocessSettings(table=table))


def test_two_spinning_sensors_keep_the_contract_each_and_against_each_other(boom):
    check_pipeline(BY_TAG["spin"], boom, ReprocessSettings(table="span"))
    reprocess(Catalog(boom.root), boom.mission(), settings=ReprocessSettings(comparison="inboard"))
    check_pipeline(BY_TAG["relation"], boom, ReprocessSettings(comparison="boom"))


def test_two_sensors_told_apart_by_states_keep_the_contract(tmp_path):
    text = shipped_missions()["venus-express"].read_text(encoding="utf-8")
    source = tmp_path / "boom.yaml"
    source.write_text(text.replace("cadence: 1 s", "cadence: 10 s"), encoding="utf-8")
    made = Workspace.create(tmp_path / "w", source)
    simulate(DualSettings(days=1, seed=31, overrides={"cadence": 10.0}), made.data, workers=1)
    ingest(Catalog(made.root), made.mission(), made.data)
    check_pipeline(BY_TAG["states"], made)


def test_a_zero_level_keeps_the_contract(tmp_path):
    text = (
        shipped_missions()["venus-express"]
        .read_text(encoding="utf-8")
        .replace("cadence: 1 s", "cadence: 30 s")
    )
    source = tmp_path / "boom.yaml"
    comparison = "  zero: {kind: zero_level, vector: outboard, step: 6 h}\n"
    source.write_text(text.replace("release:\n", f"{comparison}release:\n"), encoding="utf-8")
    made = Workspace.create(tmp_path / "w", source)
    simulate(DualSettings(days=1, seed=31, overrides={"cadence": 30.0}), made.data, workers=1)
    ingest(Catalog(made.root), made.mission(), made.data)
    check_pipeline(BY_TAG["zero_level"], made, ReprocessSettings(comparison="zero"))


def test_the_pipeline_to_copy_keeps_the_contract(tiny, template):
    check_pipeline(template, tiny)


class Wrong(ScalarPipeline):
    tag = "no word"
    versions = Versions(statistics=True, tables=0, products=4)
    note = "but it has products"

    def helper(self):
        pass


def test_a_wrong_class_is_told_everything_that_is_to_be_mended():
    with pytest.raises(ConformanceError) as told:
        check_pipeline(Wrong())
    for said in (
        "no docstring; say what is measured",
        "tag is 'no word'",
        "helper is no member of Pipeline",
        "versions.statistics is True",
        "versions.tables is 0",
        "note says what stands where a product would be",
    ):
        assert said in told.value.message


class Unstable(ScalarPipeline):
    """Its days have neither a span nor the same keys, and its products no units."""

    def make_plan(self, cat, mission, settings, span):
        Unstable.tried = getattr(Unstable, "tried", 0) + 1
        settings = settings.model_copy(update={"min_coverage": Unstable.tried * 1e-6})
        return super().make_plan(cat, mission, settings, span)

    def make_day(self, batch, day):
        made, report = super().make_day(batch, day)
        return made.drop_vars("start"), report


def test_a_wrong_day_and_unstable_keys_are_found(tiny):
    with pytest.raises(ConformanceError) as told:
        check_pipeline(Unstable(), tiny)
    assert "different keys" in told.value.message
    assert "make_day gives no start" in told.value.message


class WithoutUnits(ScalarPipeline):
    """Its products say nothing of their units."""

    def make_product(self, batch, day):
        product, report = super().make_product(batch, day)
        product["residual"].attrs.pop("units")
        return product, {key: value for key, value in report.items() if key != "coverage"}


def test_products_without_units_are_found(tiny):
    with pytest.raises(ConformanceError) as told:
        check_pipeline(WithoutUnits(), tiny)
    assert "variable 'residual' has no units" in told.value.message
    assert "no 'coverage'" in told.value.message


class WrongRows(ScalarPipeline):
    """The products of all batches get the values of the first row of the table."""

    def rows_for(self, table, job):
        return table.assign(value=table["value"][0].broadcast_like(table["value"]))


def test_rows_that_make_other_products_are_found(tiny):
    with pytest.raises(ConformanceError) as told:
        check_pipeline(WrongRows(), tiny, ReprocessSettings(table="daily"))
    assert "rows_for leaves out of the table what the product of 2024-03-02 takes" in told.value.message
    assert "2024-03-01" not in told.value.message


def test_the_table_says_which_pipeline_calibrates_a_comparison():
    tags = {}
    for name, path in shipped_missions().items():
        mission = Mission.parse(path.read_text(encoding="utf-8"))
        for comparison in mission.comparisons:
            found = find_pipeline(mission, comparison)
            tags[f"{name}/{comparison}"] = found.tag if found else ""
    assert tags["champ/main"] == tags["champ-two-fluxgates/second"] == "scalar"
    assert tags["champ-two-fluxgates/between"] == "relation"
    assert tags["themis/main"] == "spin"
    assert tags["venus-express/main"] == "states"
    champ = Mission.parse(shipped_missions()["champ"].read_text(encoding="utf-8"))
    assert pipeline_of(champ, "main", ReprocessSettings(table="continuous")).tag == "mission"


def test_a_comparison_in_which_nothing_is_calibrated_has_no_pipeline():
    mission = Mission.parse(shipped_missions()["conrad"].read_text(encoding="utf-8"))
    for comparison in [*mission.comparisons, "nothing"]:
        if find_pipeline(mission, comparison) is None:
            with pytest.raises(MissionError, match="is no scalar, spin, dual, field_model or zero_level"):
                pipeline_of(mission, comparison)


def test_tables_are_made_on_one_thread_wherever_they_are_made(ingested, tmp_path, monkeypatch):
    root = shutil.copytree(ingested.root, tmp_path / "w")
    seen = []

    def blas_threads() -> set[int]:
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    def watched(step):
        def watch(*arguments):
            seen.append(blas_threads())
            return step(*arguments)

        return watch

    for name in ("solve", "finish"):
        monkeypatch.setattr(ScalarPipeline, name, watched(getattr(ScalarPipeline, name)))
    with threadpool_limits(2):
        assert blas_threads() == {2}
        reprocess(Catalog(root), Workspace.open(root).mission())
    assert seen == [{1}, {1}]
