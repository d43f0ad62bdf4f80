"""Days that came after a search, held against its verdict: a new day costs a day, not another search.

Takes the last diagnosis of a workspace and what the archive has gained since; says whether that verdict
stands for the new days (`check_later_days`). The model with all that the search took, at its values, is
calibrated on each of them, and what is left is compared with what it leaves of the last days searched; the
day's own nine parameters with those of the days before it. A day that differs, more new days than a small
part of those searched, or anything else that changed asks for a search. Candidates are not tried on the new
days, and values are not fitted to them: whoever prints the result has to say so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from inflight.catalog import Catalog, Workspace
from inflight.design import BURST_SETTINGS, Library
from inflight.diagnosis import Rules, prior_precision
from inflight.lsq import solve_scaled
from inflight.mission import Mission
from inflight.model import Model
from inflight.progress import Progress, tell_each
from inflight.tasks.analysis.gram_pass import Origin, PassPlan, day_grams, survey
from inflight.tasks.analysis.kept_diagnosis import (
    archive_of,
    asked_alike,
    last_diagnosis,
    made_from,
    product_inputs,
)
from inflight.tasks.analysis.settings import DiagnoseSettings
from inflight.tasks.archive import (
    INPUT_SETTINGS,
    ArchiveIndex,
    ChannelReader,
    DerivedChannels,
    needs_of,
    require_days,
)
from inflight.tasks.models import effect_sources
from inflight.time import day_bounds


@dataclass(frozen=True, kw_only=True)
class LaterDaysSettings:
    """When a verdict stands for days that came after its search.

    Attributes
    ----------
    share : float
        Later days at most, as a part of those searched; assumed.
    compared : int
        Days that a later one is compared with; assumed.
    chance : float
        Days like those before it of which one is called different; stated.
    """

    share: float = 0.05
    compared: int = 16
    chance: float = 1e-3


LATER_DAYS_SETTINGS = LaterDaysSettings()

_ONE_DAY = np.timedelta64(1, "D")


def standing_of(
    cat: Catalog, mission: Mission, plan: PassPlan, model: Model, variance: float, settings: DiagnoseSettings
) -> dict[str, Any] | None:
    """Return what a diagnosis keeps for `check_later_days`; None where later days cannot be held against it.

    Parameters
    ----------
    plan : PassPlan
        Of the search.
    model : Model
        With all that the search took, at its values.
    variance : float
        Of a row, nT^2.
    """
    if mission.comparisons[settings.comparison].kind != "scalar" or not plan.library.base:
        return None
    through = plan.days[-1]
    return {
        "model": model.text,
        "origin": plan.origin.as_json(),
        "cadence_ns": plan.cadence_ns,
        "keep_bursts": plan.keep_bursts,
        "variance": variance,
        "days": len(plan.days),
        "through": str(through),
        "made_from": made_from(cat, mission, settings, archive_of(cat, mission, settings), through=through),
        "numbers": {},
    }


def note_compared_days(cat: Catalog, mission: Mission, standing: dict[str, Any], progress: Progress) -> None:
    """Let `standing` hold the numbers of the days that a later one is compared with.

    Only where they are no larger a part of those searched than later days may be: beside a shorter search
    they would take long, and the first day that comes later takes them.
    """
    if LATER_DAYS_SETTINGS.compared > LATER_DAYS_SETTINGS.share * standing["days"]:
        return
    model, through = _model_found(cat, mission, standing), np.datetime64(standing["through"])
    days = [day for day in _compared_and_later(cat, mission, model, through) if day <= through]
    _numbers_of_days(cat, mission, model, standing, days, progress)


def check_later_days(
    workspace: Workspace, start: str | None, end: str | None, settings: DiagnoseSettings, progress: Progress
) -> dict[str, Any] | None:
    """Hold the days that came after the last search against its verdict.

    Parameters
    ----------
    start, end, settings
        As of `inflight.tasks.analysis.revise.diagnose_span`.
    progress : callable
        Called with (stage, done, total).

    Returns
    -------
    dict or None
        The last diagnosis, with ``later_days``: ``stands``, ``reasons`` (why a search is due), ``days``,
        ``start`` and ``end`` of the new days, ``residual_nT`` of each, the range ``usual_nT`` of the days
        searched that they were compared with, and ``searched``, the last day of the search. None where only a
        search can tell.
    """
    found = last_diagnosis(workspace, settings.comparison)
    if found is None or end is not None or not asked_alike(found["asked"], start, end, settings):
        return None
    standing = found["asked"].get("standing")
    cat, mission = Catalog(workspace.root), workspace.mission()
    if standing is None:
        return None
    through, archive = np.datetime64(standing["through"]), archive_of(cat, mission, settings)
    if made_from(cat, mission, settings, archive, through=through) != standing["made_from"]:
        return None
    model = _model_found(cat, mission, standing)
    days = _compared_and_later(cat, mission, model, through)
    later = [day for day in days if day > through]
    if not later or len(later) > LATER_DAYS_SETTINGS.share * standing["days"]:
        return None
    if len(days) - len(later) < LATER_DAYS_SETTINGS.compared:
        return None
    # Before the days are read, as the archive: what changes meanwhile makes another verdict.
    products = product_inputs(cat, mission, settings, start, end)
    numbers = _numbers_of_days(cat, mission, model, standing, days, progress)
    usual = [numbers[str(day)] for day in days if day <= through]
    reasons = []
    for place, day in enumerate(days):
        if day > through:
            before = [numbers[str(one)] for one in days[place - LATER_DAYS_SETTINGS.compared : place]]
            reasons += [f"{day}: {why}" for why in why_different(numbers[str(day)], usual, before)]
    found["asked"]["made_from"] = made_from(cat, mission, settings, archive, products)
    found["later_days"] = {
        "stands": not reasons,
        "reasons": reasons,
        "days": len(later),
        "start": str(later[0]),
        "end": str(later[-1]),
        "residual_nT": {str(day): numbers[str(day)]["residual_nT"] for day in later},
        "usual_nT": [pick(one["residual_nT"] for one in usual) for pick in (min, max)],
        "searched": str(through),
    }
    return found


def _model_found(cat: Catalog, mission: Mission, standing: Mapping[str, Any]) -> Model:
    """Return the model with all that the search took, at its values."""
    return Model.parse(standing["model"], mission, "the model found", effect_sources(cat, mission))


def why_different(
    day: Mapping[str, Any], usual: Sequence[Mapping[str, Any]], before: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return what tells a day from others, in words; nothing for one like them.

    A value is different that lies outside the interval that others, were they normally distributed, predict
    (`LaterDaysSettings.chance`, shared out over all values): ``mean + t sd sqrt(1 + 1/n)``.

    Parameters
    ----------
    day : mapping
        Its numbers, as kept of each day: ``residual_nT``, ``within_nT``, ``calibration``, ``burst_share``.
    usual : sequence of mapping
        Of days that were searched: its residual should be no larger than theirs.
    before : sequence of mapping
        Of the days before it: its calibration should go on from there.
    """
    out = []
    if day["burst_share"] > BURST_SETTINGS.largest_share:
        out.append(f"outliers are {100.0 * day['burst_share']:.0f} % of it")
    tests = 2 + 2 * len(day["calibration"])
    sizes = {"residual_nT": "left of it", "within_nT": "left of it within the samples of the search"}
    for name, what in sizes.items():
        # Of squares, what an effect has to take off to be kept is the least that counts.
        known = 2.0 * np.log([max(one[name], 1e-12) for one in usual])
        limit = _predicted(known, tests, Rules().keep_gain)[1]
        if 2.0 * np.log(max(day[name], 1e-12)) > limit:
            low, high = (pick(one[name] for one in usual) for pick in (min, max))
            out.append(f"{day[name]:.3g} nT are {what}, {low:.3g} to {high:.3g} nT of the days searched")
    values = np.array([one["calibration"] for one in before])
    for place, value in enumerate(day["calibration"]):
        low, high = _predicted(values[:, place], tests, 0.0)
        if not low <= value <= high:
            out.append(f"{day['names'][place]} is not where it was on the days before")
    return out


def _predicted(values: np.ndarray, tests: int, least: float) -> tuple[float, float]:
    """Return the interval in which one more value lies, but for the chance of one of so many tests."""
    count = len(values)
    t = float(stdtrit(count - 1, 1.0 - LATER_DAYS_SETTINGS.chance / tests))
    half = t * max(float(np.std(values, ddof=1)), least) * np.sqrt(1.0 + 1.0 / count)
    middle = float(np.mean(values))
    return middle - half, middle + half


def _compared_and_later(
    cat: Catalog, mission: Mission, model: Model, through: np.datetime64
) -> list[np.datetime64]:
    """Return the last days searched that others are compared with, then those that came later."""
    needs = needs_of(mission, model)
    # Of so many dates as many days are there, unless half of them are missing.
    since = through - 2 * LATER_DAYS_SETTINGS.compared * _ONE_DAY
    known = require_days(ArchiveIndex.of(cat, needs, slice(str(since), None)), needs, None, None)
    before = [day for day in known if day <= through][-LATER_DAYS_SETTINGS.compared :]
    return before + [day for day in known if day > through]


def _numbers_of_days(
    cat: Catalog,
    mission: Mission,
    model: Model,
    standing: dict[str, Any],
    days: Sequence[np.datetime64],
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """Return the numbers of days, those known taken as they are; `standing` keeps them all."""
    numbers: dict[str, dict[str, Any]] = standing["numbers"]
    needs = needs_of(mission, model)
    reach = max(need.days_before for need in needs) + INPUT_SETTINGS.typical_value_days
    index = ArchiveIndex.of(cat, needs, slice(str(days[0] - reach * _ONE_DAY), None))
    keys = {day: sorted(one.key for need in needs if (one := index.get(need, day))) for day in days}
    todo = [day for day in days if numbers.get(str(day), {}).get("inputs") != keys[day]]
    span = day_bounds(days[0])[0], day_bounds(days[-1])[1]
    cadence, origin = int(standing["cadence_ns"]), Origin.of_json(standing["origin"])
    reader = ChannelReader(cat, mission, (), index, cadence, span, model.comparison)
    found = survey(cat, mission, model, needs, index, days, reader, origin)
    plan = PassPlan(
        model=found.model,
        library=Library(list(found.base)),
        needs=tuple(needs),
        channel_needs=(),
        days=tuple(days),
        blocks=tuple((day,) for day in days),
        parts=1,
        cadence_ns=cadence,
        span=span,
        correlation_time_s=0.0,
        channel_summaries={},
        origin=origin,
        keep_bursts=bool(standing["keep_bursts"]),
        estimates=True,
    )
    derived = DerivedChannels(reader, plan.days, {}, {}, origin.days)
    for day in tell_each(progress, "later days", todo):
        own = _numbers(cat, mission, plan, index, derived, day, float(standing["variance"]))
        numbers[str(day)] = {**own, "inputs": keys[day]}
    return numbers


def _numbers(
    cat: Catalog,
    mission: Mission,
    plan: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    day: np.datetime64,
    variance: float,
) -> dict[str, Any]:
    """Return what is left of a day that is calibrated by itself, and its parameters."""
    raw, _, _, sums = day_grams(cat, mission, plan, index, derived, day)
    gram, count = raw.total, max(float(raw.count.sum()), 1.0)
    sigma = np.array([one for term in plan.library.base for one in term.sigma])
    prior = np.diag(prior_precision(raw, plan.base, sigma, variance))
    inner, right = gram[:-1, :-1], gram[:-1, -1]
    shift = -solve_scaled(inner + prior, right)
    square = gram[-1, -1] + 2.0 * shift @ right + shift @ inner @ shift
    samples = max(float(sums["count"]), 1.0)
    bursts = float(sums["burst_samples"])
    return {
        "residual_nT": float(np.sqrt(max(square, 0.0) / count)),
        "within_nT": float(np.sqrt(max(float(sums["inside"]), 0.0) / samples)),
        "calibration": (shift * raw.scale[:-1]).tolist(),
        "names": plan.base,
        "burst_share": bursts / (samples + (0.0 if plan.keep_bursts else bursts)),
    }
