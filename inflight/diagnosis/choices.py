"""Every effect that was taken, again with other choices of numbers: blocks, folds, cadence.

Takes the last state of a search, the checks of its effects and the coarse series; makes what turns an effect
over (`turned_over`). Nothing physical depends on where blocks begin, how they are divided into folds, or how
wide the bins are. Where one of these choices gives another answer, neither is sure.

The same scores are made again (`inflight.diagnosis.scoring`) of few columns: those of the model, of what was
taken, and of what came nearest to it. Blocks are merged in pairs, from the first and from the second one;
folds are runs or every so-many-th block; rows of the series are averaged, three and ten of them; and the
data's own cadence, at which all columns are made anew, rates and lags among them, is that of the estimates.

Longer blocks and wider bins know less: an effect that is merely less clear there does not turn over. It does
in two cases only. Another effect leaves clearly less in its place, by what the rounds themselves exchange
effects by (`inflight.diagnosis.stepwise.better_option`). Or its values move beyond the errors of both, and by
as much as an effect of its own would be taken for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.attenuation import ATTENUATION_SETTINGS, Freed, Told
from inflight.diagnosis.residual import DiagnosisData, Native
from inflight.diagnosis.result import Turn
from inflight.diagnosis.scoring import SCORING_SETTINGS, Index, make_folds, project_out_of, score
from inflight.diagnosis.search import Option, ScoreTable, Search
from inflight.diagnosis.stepwise import Estimate, RivalCheck, better_option, estimate, estimate_in
from inflight.diagnosis.wide_bins import Means, gram_of_means, has_means, is_on_series, mean_columns
from inflight.lsq import GramArrays, GramBlocks


@dataclass(frozen=True, kw_only=True)
class ChoiceSettings:
    """The other choices.

    Attributes
    ----------
    times : tuple of int
        Rows of the series in a mean: of three and ten times the cadence of the search.
    merged : int
        Blocks that become one.
    folds : int
        Folds at most, of another division: about half of the usual number.
    sigmas : float
        A value has moved when it is so many of its sigmas away.
    rows : int
        Rows for every column at least: fewer means say nothing; assumed.
    native : int
        Rivals of each effect that get columns at the samples' own cadence; a bound on time, assumed.
    """

    times: tuple[int, ...] = (3, 10)
    merged: int = 2
    folds: int = 6
    sigmas: float = 3.0
    rows: int = 20
    native: int = 2


CHOICE_SETTINGS = ChoiceSettings()


@dataclass(frozen=True)
class _Trial:
    """Gram blocks of one choice, for one effect, and the blocks of its folds."""

    choice: str
    grams: GramBlocks
    folds: Sequence[Index]


def turned_over(
    search: Search,
    data: DiagnosisData,
    checks: Sequence[RivalCheck],
    told: Mapping[str, Floats],
    native: Native | None = None,
    freed: Mapping[str, Freed] | None = None,
    told_of: Mapping[str, Told] | None = None,
) -> dict[str, list[Turn]]:
    """Return what turns each effect over, by its name; those that nothing turns over have an empty list.

    Parameters
    ----------
    told : mapping of str to ndarray
        Errors of an effect's values as they are told, by its name; physical units.
    native : Native, optional
        What was taken at the samples' own cadence.
    freed : mapping of str to Freed, optional
        Values without what noise takes off them: it takes less off those of wider bins, and more off those
        of the samples, which is no other answer.
    told_of : mapping of str to Told, optional
        Values from the samples, without what noise takes off these.
    """
    # What has a value in each window of some blocks has none in longer ones.
    some = [one for one in checks if one.option.change is None or not one.option.change.windows]
    out: dict[str, list[Turn]] = {one.option.name: [] for one in checks}
    for check in some:
        grams = _grams_of(search, check.form, [check.option, *check.near])
        for trial in _other_blocks_and_folds(grams, check.option):
            out[check.option.name] += _overtaken(search, check, trial)
    if native is not None:
        for check in some:
            name = check.option.name
            free = freed.get(name) if freed else None
            samples = told_of.get(name) if told_of else None
            if samples is not None or free is None or free.at_native <= ATTENUATION_SETTINGS.native:
                there = samples.estimate if samples is not None else None
                here = free.estimate if free is not None and samples is not None else None
                out[name] += _at_native(native, check, search, there, here)
    for check, trial, form in _at_cadence(search, data, some) if some else ():
        found = _overtaken(search, check, trial)
        if not found:
            there = estimate_in(search, check.option, trial.grams)
            here = estimate(search, check.option, form)
            if freed is not None and check.option.name in freed:
                there = there.between(here, freed[check.option.name].estimate)
            found = _moved(search, check.option, trial.choice, there, here, told[check.option.name], form)
        out[check.option.name] += found
    return out


def nearest_rivals(checks: Sequence[RivalCheck]) -> list[Option]:
    """Return the options that effects are held against at the samples' own cadence."""
    return [option for check in checks for option in check.near[: CHOICE_SETTINGS.native]]


def _overtaken(search: Search, check: RivalCheck, trial: _Trial) -> list[Turn]:
    """Return that another effect leaves clearly less in the place of one that was taken, if it does."""
    known = set(trial.grams.names)
    options = [check.option, *(one for one in check.near if set(one.columns) <= known)]
    if len(options) == 1 or not set(check.option.columns) <= known:
        return []
    columns = [trial.grams.index(option.columns) for option in options]
    present = search.present_in(trial.grams, check.option)
    scores = score(trial.grams, present, columns, trial.grams.residuals[search.residual], trial.folds)
    nothing = np.zeros(len(options))
    # The effect was beyond doubt among all options: the few left here are held against each other alone.
    table = ScoreTable(options, {"raw": scores}, {"raw": nothing}, {"raw": nothing + np.inf})
    better = better_option(search, check.option, table)
    if better is None:
        return []
    t = scores.t_worse_than(0, next(at for at, one in enumerate(options) if one is better))
    return [Turn(choice=trial.choice, rival=better.mechanism, t=t)]


def _moved(
    search: Search,
    option: Option,
    choice: str,
    there: Estimate,
    here: Estimate,
    told: Floats | float = 0.0,
    form: str = "raw",
) -> list[Turn]:
    """Return that the values of an effect are elsewhere with another choice, if they are.

    They are where the difference is beyond the errors, and would itself be taken for an effect.
    """
    sigma = np.maximum(np.maximum(there.sigma, here.sigma), told)
    moved = there.value - here.value
    away = float(np.max(np.divide(np.abs(moved), sigma, out=np.zeros_like(moved), where=sigma > 0)))
    if not away > CHOICE_SETTINGS.sigmas:
        return []
    grams, present = search.forms[form], search.present(form, option)
    own = grams.index(option.columns)
    gram = project_out_of(grams, present, np.append(own, search.y(form)))
    step = moved / grams.scale[own]
    large = float(step @ gram[:-1, :-1] @ step) > search.rules.gain * float(gram[-1, -1])
    return [Turn(choice=choice, t=away)] if large else []


# Other blocks and folds.


def _grams_of(search: Search, form: str, options: Sequence[Option]) -> GramArrays:
    """Return one form of the model's columns and those of some options, in memory."""
    grams = search.forms[form]
    names = dict.fromkeys([*search.model_columns(), *(name for one in options for name in one.columns)])
    known = set(grams.names)
    if set(names) <= known:
        return _in_memory(grams.select(list(names)))
    # Steps that were no more than tried have no columns yet.
    raw = search.white if form == "white" else search.raw
    functions = {
        name: source
        for one in options
        if one.change is not None
        for name, source in one.change.functions.items()
        if name not in raw.names
    }
    base, sigma = search.base()
    sources = {column for column, _ in functions.values()}
    every = dict.fromkeys([*base, *(name for name in (*names, *sources) if name in raw.names)])
    small = _in_memory(raw.select(list(every))).expand(functions) if functions else raw.select(list(every))
    groups = search.intervals if form != "within" else search.shared.days
    return _in_memory(small.marginalise(base, groups, search.precision(small, base, sigma)))


def _in_memory(grams: GramBlocks) -> GramArrays:
    assert isinstance(grams, GramArrays)
    return grams


def _other_blocks_and_folds(grams: GramArrays, option: Option) -> Iterator[_Trial]:
    """Yield the trials of blocks and folds of an effect."""
    count, width = len(grams), CHOICE_SETTINGS.merged
    for first, words in ((0, ""), (width // 2, ", begun half of one later")):
        groups = [range(0, first), *(range(at, min(at + width, count)) for at in range(first, count, width))]
        merged = grams.merge_groups([list(group) for group in groups])
        folds = make_folds(len(merged), option.interleaved)
        yield _Trial(f"with blocks of twice the length{words}", merged, folds)
    if not option.interleaved:
        every = min(SCORING_SETTINGS.folds, count)
        yield _Trial(f"with every {every}th block held out", grams, make_folds(count, interleaved=True))
    fewer = make_folds(count, option.interleaved, CHOICE_SETTINGS.folds)
    yield _Trial(f"with {len(fewer)} folds", grams, fewer)


# Other cadences.


def _at_native(
    native: Native,
    check: RivalCheck,
    search: Search,
    there: Estimate | None = None,
    here: Estimate | None = None,
) -> list[Turn]:
    """Return what turns an effect over at the samples' own cadence.

    Parameters
    ----------
    there, here : Estimate, optional
        Values from the samples and from the search's rows; those of least squares when absent.
    """
    own, choice = native.search, f"at the samples' own cadence of {native.cadence_s:.3g} s"
    grams = _grams_of(own, "raw", [check.option, *_there(own, check.near)])
    trial = _Trial(choice, grams, make_folds(len(grams), check.option.interleaved))
    if check.form == "raw" and (found := _overtaken(own, check, trial)):
        return found
    there, here = there or estimate(own, check.option), here or estimate(search, check.option)
    # Sigmas that are told cover the difference; those of the two estimates need not.
    return _moved(search, check.option, choice, there, here)


def _there(search: Search, options: Sequence[Option]) -> list[Option]:
    """Return those of some options whose columns Gram blocks hold."""
    return [one for one in options if one.sources <= set(search.raw.names)]


def _at_cadence(
    search: Search, data: DiagnosisData, checks: Sequence[RivalCheck]
) -> Iterator[tuple[RivalCheck, _Trial, str]]:
    """Yield each effect with Gram blocks of wider bins, and the form they have.

    Their columns are means of those of the search, of which the mean residual is the same function: what
    differs is not how well a wide bin shows a rate or a lag.
    """
    if not has_means(search, data):
        return
    series = data.series
    near = {one.name: one for check in checks for one in check.near if is_on_series(search, data, one)}
    options = list((near | {one.name: one for one in search.accepted}).values())
    means = [Means.of(series, times) for times in CHOICE_SETTINGS.times]
    names, columns = mean_columns(search, data, options, means)
    for some, mean in zip(columns, means, strict=True):
        if int((mean.weight > 0).sum()) < CHOICE_SETTINGS.rows * len(names):
            continue
        made: dict[str, GramArrays] = {}
        for check in checks:
            form = check.form if search.raw.fits == 1 else "raw"
            if form not in made:
                made[form] = gram_of_means(search, data, form, mean, names, some)
            choice = f"in means of {mean.times * series.step_s:.4g} s"
            folds = make_folds(len(made[form]), check.option.interleaved)
            yield check, _Trial(choice, made[form], folds), form
