"""Compare the model with the measurements: how well the products agree, before and after calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflight.catalog import Catalog
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.analysis.kept_comparison import comparison_made_from, keep_comparison
from inflight.tasks.analysis.plumbing import check_plumbing
from inflight.tasks.report import write_page
from inflight.time import DayLike

if TYPE_CHECKING:
    from inflight.tasks.pipelines import CompareResult, Report


def compare(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    output: Path | None = None,
    progress: Progress | None = None,
    client: Any = None,
    against: int | None = None,
) -> Report:
    """Measure the residual of published products before and after calibration, and draw it.

    What the residual is, the pipeline of the comparison knows (`Pipeline.compare`): of a scalar comparison
    that of each sample, of a spin comparison what still goes with the spin, of two sensors on one boom the
    steps where the spacecraft switches.

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; all published days when absent.
    output : Path, optional
        Where to write the static page; none is written when absent.
    client : dask Client, optional
        On whose processes many days are read.
    against : int, optional
        Version of the model whose products are set beside the present ones; that of the products published
        before these when absent.

    Returns
    -------
    Report
        `inflight.tasks.pipelines.CompareReport`, or that of the pipeline.

    Raises
    ------
    CatalogError
        When no product of the comparison is published in the span.
    SettingsError
        When no product was made with the version `against`.
    """
    made_from = comparison_made_from(cat, mission, start, end, comparison, against) if output else ""
    found = measure_comparison(cat, mission, start, end, comparison, progress, client, against)
    try:
        found.report.plumbing = check_plumbing(cat, mission, start, end, comparison)
    except InflightError:
        # A workspace of products alone has no archive to ask. What cannot be read now is asked again.
        made_from = ""
    if output is not None:
        from inflight.figures import html_page

        sections = found.sections(progress or silent)
        page = html_page(found.title, sections, mission.acknowledgement)
        write_page(output, page)
        found.report.path = output
        keep_comparison(cat, found.report, page, comparison, made_from)
    report: Report = found.report
    return report


def measure_comparison(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    progress: Progress | None = None,
    client: Any = None,
    against: int | None = None,
) -> CompareResult[Any]:
    """Measure as `compare` does; return with the report what its figures are drawn from."""
    from inflight.tasks.pipelines import earlier_products, pipeline_of, published_products

    span = slice(str(start) if start is not None else None, str(end) if end is not None else None)
    days = published_products(cat, comparison, span)
    tell = progress or silent
    earlier = earlier_products(cat, comparison, days, against)
    pipeline = pipeline_of(mission, comparison)
    return pipeline.compare(cat, mission, comparison, days, span, tell, client, earlier)
