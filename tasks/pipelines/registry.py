"""The table of pipelines, which of them calibrates a comparison, and the verbs that use it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflight.catalog import Catalog
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.batches import Mapper, batch_mapper
from inflight.tasks.pipelines.base import (
    Pipeline,
    ReprocessSettings,
    report_if_unchanged,
    run_plan,
    settings_of_context,
)
from inflight.tasks.pipelines.field_model import FieldModelPipeline
from inflight.tasks.pipelines.intercalibration import RelationPipeline
from inflight.tasks.pipelines.mission_fit import MissionPipeline
from inflight.tasks.pipelines.scalar import ScalarPipeline
from inflight.tasks.pipelines.spin import SpinPipeline
from inflight.tasks.pipelines.two_sensor import StatesPipeline
from inflight.tasks.pipelines.zero_level import ZeroLevelPipeline
from inflight.tasks.report import RunReport
from inflight.threads import one_thread
from inflight.time import DayLike

if TYPE_CHECKING:
    from inflight.figures import Section
    from inflight.tasks.pipelines.base import Report

#: In order: the first that handles a comparison calibrates it.
PIPELINES: tuple[Pipeline, ...] = (
    ScalarPipeline(),
    MissionPipeline(),
    SpinPipeline(),
    FieldModelPipeline(),
    RelationPipeline(),
    StatesPipeline(),
    ZeroLevelPipeline(),
)

#: Chooses the pipeline that makes tables of all days together.
ALL_DAYS = ReprocessSettings(table="continuous")


def find_pipeline(
    mission: Mission, comparison: str, settings: ReprocessSettings | None = None
) -> Pipeline | None:
    """Return the pipeline of a comparison; None where nothing is calibrated, or there is no such comparison.

    Parameters
    ----------
    settings : ReprocessSettings, optional
        The table they name may choose between pipelines of one comparison; its usual table when absent.
    """
    if comparison not in mission.comparisons:
        return None
    settings = (settings or ReprocessSettings()).model_copy(update={"comparison": comparison})
    return next((pipeline for pipeline in PIPELINES if pipeline.handles(mission, settings)), None)


def pipeline_of(mission: Mission, comparison: str, settings: ReprocessSettings | None = None) -> Pipeline:
    """Return the pipeline of a comparison; parameters as `find_pipeline`.

    Raises
    ------
    MissionError
        When the mission has no such comparison, or nothing is calibrated in it.
    """
    found = find_pipeline(mission, comparison, settings)
    if found is None:
        known = [name for name in mission.comparisons if find_pipeline(mission, name) is not None]
        raise MissionError(
            f"'{comparison}' is no scalar, spin, dual, field_model or zero_level comparison of mission"
            f" '{mission.mission}'",
            remedy=f"choose one of {', '.join(known) or 'none: the mission has none'}",
        )
    return found


def reprocess(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: ReprocessSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
    mapper: Mapper | None = None,
) -> RunReport:
    """Calibrate the half-open span of UTC days; publish statistics, tables and products, or nothing.

    Days whose inputs, model and table did not change are not made anew.

    Parameters
    ----------
    cat : Catalog
        The workspace's catalog.
    mission : Mission
        What was measured and what is held against what.
    start, end : UTC date, optional
        The archive's own span when absent.
    settings : ReprocessSettings, optional
        Choices; the defaults when absent.
    client : distributed.Client, optional
        Batches run on it; the result is the same byte for byte as without.
    progress : callable, optional
        Called with (stage, done, total).
    mapper : Mapper, optional
        Runs the batches, on `client` if on any; the plain one when absent.

    Returns
    -------
    RunReport
        Days by outcome; extra field ``residual`` with `before_nT` and `after_nT` over the span, and the other
        fields of `Pipeline.results`.

    Raises
    ------
    MissionError, ModelError, CatalogError
        When there is nothing to work on or the model does not fit the mission.
    """
    mission, settings = settings_of_context(cat, mission, settings or ReprocessSettings())
    pipeline = pipeline_of(mission, settings.comparison, settings)
    planned = pipeline.make_plan(cat, mission, settings, (start, end))
    unchanged = report_if_unchanged(pipeline, cat, planned)
    mapper = mapper or batch_mapper(client, progress)
    return unchanged or run_plan(pipeline, cat, mission, planned, mapper, progress or silent, client)


def reprocess_if_unchanged(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: ReprocessSettings | None = None,
) -> RunReport | None:
    """Return the report of a reprocessing that has nothing to do; None when there is work.

    Parameters and errors are those of `reprocess`.
    """
    mission, settings = settings_of_context(cat, mission, settings or ReprocessSettings())
    pipeline = pipeline_of(mission, settings.comparison, settings)
    return report_if_unchanged(pipeline, cat, pipeline.make_plan(cat, mission, settings, (start, end)))


def table_sections(cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
    """Return sections of the newest published tables of a comparison; none when there are no tables.

    Raises
    ------
    CatalogError, SettingsError
        When tables are damaged or not whole.
    """
    found = (find_pipeline(mission, comparison), find_pipeline(mission, comparison, ALL_DAYS))
    pipelines = dict.fromkeys(pipeline for pipeline in found if pipeline is not None)
    return [section for pipeline in pipelines for section in pipeline.sections(cat, mission, comparison)]


def tables_report(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    output: Path | None = None,
    cause: str = "",
    progress: Progress = silent,
) -> Report:
    """Return the report of the tables of all days together, and write its page when a path is given.

    Parameters
    ----------
    cause : str
        A parameter or cause whose cross-talk with all others is to be in the report.
    progress : callable, optional
        Called with (stage, done, total) while the report of a long mission is made.

    Raises
    ------
    MissionError
        When nothing is calibrated in the comparison.
    CatalogError
        When no table is published.
    """
    with one_thread():
        pipeline = pipeline_of(mission, comparison, ALL_DAYS)
        return pipeline.report(cat, mission, comparison, output, cause, progress)


def learns_states(mission: Mission, comparison: str) -> bool:
    """Return True for a comparison whose pipeline finds states of the spacecraft."""
    found = find_pipeline(mission, comparison)
    return found is not None and found.learns_states


def spacecraft_units_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    start: DayLike | None = None,
    end: DayLike | None = None,
) -> list[dict[str, Any]] | None:
    """Return the units of the spacecraft that switch, as plain fields; None where no states are learnt."""
    found = find_pipeline(mission, comparison)
    return None if found is None else found.units(cat, mission, comparison, start, end)
