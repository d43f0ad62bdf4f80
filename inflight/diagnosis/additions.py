"""Additions to a model, and the joint fit of everything the model then holds.

Takes the Gram blocks of a pass (`FitSetup`) and candidates, options of a search, steps or drifts; makes an
`Addition` (`AdditionMaker`, `addition_of`, `step_of`, `drift_of`): its columns of the Gram blocks, and its
entries in the model's file. Columns are called as the model calls its values, so that a fit's result goes
into the model by name (`Addition.put_into`).

`FitSetup.fit` fits what the model holds free, what was added and what was dropped, all at once: a few
columns, so that it takes milliseconds whatever the library's size. A column of the model may be a
combination of the library's: a lag between two of the bank, or a parameter times a function of the block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.design import SENSOR_EQUATIONS, Candidate, Library, Term, sensor_matrices
from inflight.diagnosis.refine import dated_columns, dated_term, lag_weights
from inflight.diagnosis.scoring import ModelColumns, make_folds, project_out_of, score
from inflight.diagnosis.search import Option, prior_precision
from inflight.diagnosis.stepwise import joint_fit
from inflight.diagnosis.time_changes import TimeVariableColumns, lines_between_windows, time_text
from inflight.effects import ANGLES
from inflight.errors import ModelError, did_you_mean
from inflight.lsq import GramArrays, GramBlocks, inverse_square_root, solve_scaled
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, TimeDependence, make_effect
from inflight.samples import parse_channel
from inflight.time import DAY, to_utc


@dataclass(frozen=True)
class Column:
    """A column of the model, made from those of the Gram blocks.

    Attributes
    ----------
    name : str
    parts : tuple of (str, float)
        Columns of the Gram blocks, of one scale, and their weights.
    factor : ndarray, shape (block,), optional
        Function of the block it is multiplied by.
    """

    name: str
    parts: tuple[tuple[str, float], ...]
    factor: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class JointFit:
    """Values of everything a model lets data move, in one fit.

    Attributes
    ----------
    value, sigma : dict of str to float
        Change of each column from where the Gram blocks are linearised, physical units. The sigma allows
        for the residual's correlation between blocks; it is the prior's where data have no information.
    base_value, base_sigma : dict of str to float
        The same of the calibration's own columns, mean over its intervals.
    in_sample, held_out : float
        Sum of squares that is left over the sum of the weights, nT^2.
    """

    value: Mapping[str, float]
    sigma: Mapping[str, float]
    base_value: Mapping[str, float]
    base_sigma: Mapping[str, float]
    in_sample: float
    held_out: float


@dataclass(frozen=True)
class FitSetup:
    """What a joint fit needs: the Gram blocks as the library has them, and what the calibration marginalises.

    Attributes
    ----------
    raw : GramBlocks
    base, refined : tuple of Term
        What each interval fits anew; what the model lets data refine.
    intervals : sequence of sequence of int
        Blocks of each calibration interval.
    variance : float
        Of a row, nT^2; it weighs data against what is known beforehand.
    blocks : ndarray of int64, shape (block,), optional
        Those of `raw` that are fitted; `intervals` count them. All by default.
    """

    raw: GramBlocks
    base: tuple[Term, ...]
    refined: tuple[Term, ...]
    intervals: Sequence[Sequence[int]]
    variance: float
    blocks: npt.NDArray[np.int64] | None = None

    def where_told(self, model: Model) -> FitSetup:
        """Return the setup of the blocks in which the tables that a model takes have values of their own.

        A value that is held is nearer to the mean of all than the true one: the factor of it that a fit finds
        is too large, by ``cov(held, true) / var(held)``. All blocks without tables, and where none is left.
        """
        tables = [timed for entry in model.effects for timed in entry.tables.values()]
        middle = self.raw.start // 2 + self.raw.end // 2
        kept = np.logical_and.reduce(
            [np.ones(middle.size, dtype=bool), *(one.is_own_at(middle) for one in tables)]
        )
        if kept.all() or not kept.any():
            return self
        place = np.cumsum(kept) - 1
        intervals = [[int(place[one]) for one in group if kept[one]] for group in self.intervals]
        return replace(
            self,
            intervals=[group for group in intervals if group],
            blocks=np.flatnonzero(kept),
        )

    def fit(
        self,
        columns: Sequence[Column],
        fixed: Mapping[str, float] | None = None,
        *,
        interleaved: bool = False,
    ) -> JointFit:
        """Fit the model's own columns and more, all together.

        Parameters
        ----------
        columns : sequence of Column
            What was put into the model.
        fixed : mapping of str to float
            Columns of refined terms that are held at a change from where they are, physical units: an
            effect taken out of the model is one whose parameters are held at nothing.
        interleaved : bool
            Hold out every k-th block instead of runs: for effects that lie in few blocks.
        """
        whole, names, sigma = self._model_grams(columns, fixed or {})
        grams, present = self._marginalised(whole, names, sigma)
        value, covariance = self._solve_model(grams, present)
        # Days that taught a number are counted once: sigma is what they say beside what was known before any.
        before = self._known_before(names, sigma)
        if before != sigma:
            known = prior_precision(grams, names, np.array(before), self.variance)
            covariance = self._solve_model(grams, replace(present, precision=known))[1]
        base_value, base_sigma = self._calibration_shift(whole, names, value, covariance)
        y = grams.residuals[0]
        scale = grams.scale[present.columns]
        found = np.sqrt(np.clip(np.diag(covariance), 0.0, None)) * scale
        # A column of which the calibration leaves nothing is known as well as beforehand.
        found = np.where(np.diagonal(grams.total)[present.columns] > 0, found, np.asarray(before))
        remaining = grams.total[y, y] + 2.0 * grams.total[y, present.columns] @ value
        remaining += value @ grams.total[np.ix_(present.columns, present.columns)] @ value
        rows = max(float(grams.count.sum()), 1.0)
        held = score(grams, present, [], y, make_folds(len(grams), interleaved)).loss0.sum()
        return JointFit(
            value=dict(zip(names, (value * scale).tolist(), strict=True)),
            sigma=dict(zip(names, found.tolist(), strict=True)),
            base_value=base_value,
            base_sigma=base_sigma,
            in_sample=max(float(remaining), 0.0) / rows,
            held_out=max(float(held), 0.0) / rows,
        )

    def block_factors(
        self, columns: Sequence[Column], fixed: Mapping[str, float], fitted: JointFit
    ) -> dict[str, Floats]:
        """Return what a fit multiplies each column of the Gram blocks by, in their scaled units; (block,).

        Added to the residual, each column times its factor gives the residual after the fit.
        """
        whole, names, _ = self._model_grams(columns, fixed)
        made, factors = {one.name: one for one in columns}, dict[str, Floats]()

        def put(name: str, value: Any) -> None:
            known = factors.setdefault(name, np.zeros(len(self.raw)))
            known += np.asarray(value) / self.raw.scale[self.raw.index([name])[0]]

        for name in names:
            for part, weight in made[name].parts if name in made else [(name, 1.0)]:
                factor = made[name].factor if name in made else None
                put(part, weight * fitted.value[name] * (1.0 if factor is None else factor))
        for name, change in fixed.items():
            put(name, change)
        gone, others, y = self._base_names, whole.index(names), whole.residuals[0]
        at = whole.index(gone)
        value = np.array([fitted.value[name] for name in names]) / whole.scale[others]
        prior = np.diag(prior_precision(whole, gone, self._base_sigma, self.variance))
        for group in self.intervals if gone else ():
            total = whole.rows(at, blocks=np.asarray(group)).sum(axis=0)
            found = -solve_scaled(total[:, at] + prior, total[:, y] + total[:, others] @ value)
            for name, one in zip(gone, found, strict=True):
                factors.setdefault(name, np.zeros(len(self.raw)))[np.asarray(group)] += one
        return factors

    def marginalised(
        self, columns: Sequence[Column], fixed: Mapping[str, float]
    ) -> tuple[GramBlocks, ModelColumns]:
        """Return what the calibration leaves of the model's columns, and which they are with their priors.

        Those of `columns` come last.
        """
        return self._marginalised(*self._model_grams(columns, fixed))

    def retained(
        self, columns: Sequence[Column], added: Sequence[Column], fixed: Mapping[str, float]
    ) -> float:
        """Return the largest part of any combination of added columns that calibration and model leave.

        Parameters
        ----------
        columns : sequence of Column
            What the model holds beside its own.
        fixed : mapping of str to float
            As `fit` takes it.
        """
        whole, names, sigma = self._model_grams([*columns, *added], fixed)
        grams, present = self._marginalised(whole, names, sigma)
        count = len(present.columns) - len(added)
        model = ModelColumns(present.columns[:count], present.precision[:count])
        remaining = project_out_of(grams, model, present.columns[count:])
        own = whole.centred(whole.index(names[count:]), whole.index(self._base_names))
        half = inverse_square_root(own)
        return float(np.linalg.eigvalsh(half.T @ remaining @ half).max(initial=0.0))

    def _model_grams(
        self, columns: Sequence[Column], fixed: Mapping[str, float]
    ) -> tuple[GramArrays, list[str], list[float]]:
        """Return the Gram blocks of calibration and model, names of the model's columns, and their priors."""
        free = [
            (name, sigma)
            for term in self.refined
            for name, sigma in zip(term.columns, term.sigma, strict=True)
            if name not in fixed
        ]
        names = [name for name, _ in free] + [one.name for one in columns]
        sigma = [sigma for _, sigma in free] + [np.inf] * len(columns)
        whole = combine_columns(self.raw, [*self._base_names, *(n for n, _ in free)], columns, fixed)
        return whole if self.blocks is None else whole.of_blocks(self.blocks), names, sigma

    def _known_before(self, names: Sequence[str], sigma: Sequence[float]) -> list[float]:
        """Return the sigma that was known before any fit of the model's columns; `sigma` of all others."""
        terms = [term.before_any_fit() for term in self.refined]
        known = {name: one for term in terms for name, one in zip(term.columns, term.sigma, strict=True)}
        return [known.get(name, one) for name, one in zip(names, sigma, strict=True)]

    def _marginalised(
        self, whole: GramBlocks, names: Sequence[str], sigma: Sequence[float]
    ) -> tuple[GramBlocks, ModelColumns]:
        gone = self._base_names
        grams = whole.marginalise(
            gone, self.intervals, prior_precision(whole, gone, self._base_sigma, self.variance)
        )
        return grams, ModelColumns(
            grams.index(names), prior_precision(grams, names, np.array(sigma), self.variance), self.variance
        )

    @property
    def _base_names(self) -> list[str]:
        return [name for term in self.base for name in term.columns]

    @property
    def _base_sigma(self) -> Floats:
        return np.array([sigma for term in self.base for sigma in term.sigma])

    def _solve_model(self, grams: GramBlocks, present: ModelColumns) -> tuple[Floats, Floats]:
        """Return values and covariance of the model's columns, scaled."""
        p = present.columns
        if not p.size:
            return np.zeros(0), np.zeros((0, 0))
        return joint_fit(grams, present, grams.residuals[0])

    def _calibration_shift(
        self, whole: GramBlocks, names: Sequence[str], value: Floats, covariance: Floats
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Return the calibration's mean shift over its intervals and its error, physical units."""
        gone = self._base_names
        if not gone:
            return {}, {}
        at, others, y = whole.index(gone), whole.index(names), whole.residuals[0]
        prior = np.diag(prior_precision(whole, gone, self._base_sigma, self.variance))
        shift, mean_cross = np.zeros(len(gone)), np.zeros((len(gone), len(names)))
        error = np.zeros((len(gone), len(gone)))
        count = len(self.intervals)
        for group in self.intervals:
            total = whole.rows(at, blocks=np.asarray(group)).sum(axis=0)
            inverse = solve_scaled(total[:, at] + prior, np.eye(len(gone)))
            cross = inverse @ total[:, others]
            shift -= (inverse @ total[:, y] + cross @ value) / count
            mean_cross += cross / count
            error += self.variance * inverse / count**2
        both = error + mean_cross @ covariance @ mean_cross.T
        sigma = np.sqrt(np.clip(np.diag(both), 0.0, None))
        scale = whole.scale[at]
        return (
            dict(zip(gone, (shift * scale).tolist(), strict=True)),
            dict(zip(gone, (sigma * scale).tolist(), strict=True)),
        )


def combine_columns(
    grams: GramBlocks, plain: Sequence[str], columns: Sequence[Column], fixed: Mapping[str, float]
) -> GramArrays:
    """Return Gram blocks of some columns as they are, of combinations, and of the residual after a change.

    Parameters
    ----------
    plain : sequence of str
        Columns taken over.
    columns : sequence of Column
        Columns made.
    fixed : mapping of str to float
        Changes that join the residual, physical units.
    """
    needed = [*plain, *(name for one in columns for name, _ in one.parts), *fixed]
    small = grams.select(list(dict.fromkeys(needed)))
    names = [*plain, *(one.name for one in columns), "residual"]
    weights = np.zeros((len(small), len(names), len(small.names)))
    scale = np.ones(len(names))
    origin = small.index(plain)
    weights[:, np.arange(len(plain)), origin] = 1.0
    scale[: len(plain)] = small.scale[origin]
    for place, one in enumerate(columns, start=len(plain)):
        for name, weight in one.parts:
            index = int(small.index([name])[0])
            weights[:, place, index] += weight * (1.0 if one.factor is None else one.factor)
            scale[place] = small.scale[index]
    weights[:, -1, small.residuals[0]] = 1.0
    for name, change in fixed.items():
        index = int(small.index([name])[0])
        weights[:, -1, index] += change / small.scale[index]
    return small.combine(names, weights, scale)


@dataclass(frozen=True, kw_only=True)
class Addition:
    """Something put into the model.

    Attributes
    ----------
    name : str
        As a person calls it: a candidate's name.
    columns : tuple of Column
    entries : tuple of ModelEffect
        What the model's file gets; at values that do nothing, where the columns are linearised.
    needs : tuple of Term
        Terms whose columns the Gram blocks must hold.
    interleaved : bool
        It lies in few blocks.
    gains : dict of str to ((str, float), ...)
        Value of the model -> columns it is the sum of, and their weights; itself when it is not named.
    unit : str
        Of columns that are no values of the model by themselves.
    """

    name: str
    columns: tuple[Column, ...]
    entries: tuple[ModelEffect, ...]
    needs: tuple[Term, ...] = ()
    interleaved: bool = False
    gains: Mapping[str, tuple[tuple[str, float], ...]] | None = None
    unit: str = ""

    def as_empirical(self) -> Addition:
        """Return the addition of effects that are marked as there for what they look like."""
        return replace(self, entries=tuple(entry.as_empirical() for entry in self.entries))

    def put_into(self, model: Model, value: Mapping[str, float], sigma: Mapping[str, float]) -> Model:
        """Return the model with the effect at fitted values, which later fits may move.

        Parameters
        ----------
        value, sigma : mapping of str to float
            Change of each column, physical units, and its standard deviation.
        """
        for entry in self.entries:
            parameters = dict(entry.parameters)
            for key, timed in entry.parameters.items():
                changed, error = {}, {}
                for name, start in zip(timed.columns, timed.value.ravel(), strict=True):
                    gains = (self.gains or {}).get(name, ((name, 1.0),))
                    if all(column in value for column, _ in gains):
                        change = sum(weight * value[column] for column, weight in gains)
                        changed[name] = float(start) + change
                        errors = [weight * sigma[column] for column, weight in gains]
                        error[name] = float(np.hypot.reduce(errors))
                if changed:
                    zero = replace(timed, sigma=np.zeros_like(timed.sigma))
                    # A drift is held: what changes with time is no constant that a later fit could move.
                    free = timed.time in ("constant", "block")
                    parameters[key] = replace(zero.with_columns(changed, error), free=free)
            filled = entry.with_parameters(parameters)
            known = entry.name in [one.name for one in model.effects]
            model = model.replace(filled) if known else model.add(filled)
        return model


@dataclass(frozen=True, kw_only=True)
class AdditionMaker:
    """Makes additions of one mission, one model and one library.

    Attributes
    ----------
    model : Model
        At the values the Gram blocks are linearised at.
    raw : GramBlocks
        Its blocks say when things change.
    names : frozenset of str
        Names in the model that are not free any more.
    """

    mission: Mission
    model: Model
    library: Library
    time_variable: TimeVariableColumns
    raw: GramBlocks
    names: frozenset[str] = frozenset()

    def of_candidate(self, candidate: Candidate, name: str = "", lag_s: float | None = None) -> Addition:
        """Return the addition of a candidate, with another lag than the bank's if one is given."""
        sensor_term = self.own_term(candidate)
        if sensor_term is not None:
            return self.of_term(sensor_term, candidate.name)
        bank = self.bank(candidate)
        lag = candidate.lag_s if lag_s is None else lag_s
        weights = {candidate.name: 1.0}
        if bank and lag != candidate.lag_s:
            mixed = lag_weights(lag, tuple(bank))
            weights = {
                one.name: float(w) for one, w in zip(bank.values(), mixed, strict=True) if abs(w) > 1e-12
            }
        by_name = {one.name: one for one in self.library.candidates}
        columns: list[Column] = []
        entries: list[ModelEffect] = []
        for place, key in enumerate(candidate.terms):
            term = self.library.terms[key]
            title = name or self.title(term.entry)
            title += f"_{place + 1}" if place else ""
            entry = self.entry(term.entry, title, lag if bank else None)
            entries.append(entry)
            own = {one: self.library.terms[by_name[one].terms[place]].columns for one in weights}
            for index, column in enumerate(value_names(entry, term.parameters)):
                columns.append(Column(column, tuple((own[one][index], w) for one, w in weights.items())))
        others = list(bank.values()) or [candidate]
        needs = [self.library.terms[key] for one in others for key in one.terms]
        label = candidate.mechanism if bank else candidate.name
        label += f"@lag={float(f'{lag:.4g}'):g}s" if bank and lag else ""
        return Addition(name=label, columns=tuple(columns), entries=tuple(entries), needs=tuple(needs))

    def bank(self, candidate: Candidate) -> dict[float, Candidate]:
        """Return lag -> candidate of a mechanism that is tried with several lags; empty when it is not."""
        same = {
            one.lag_s: one
            for one in self.library.candidates
            if one.mechanism == candidate.mechanism and "@width=" not in one.name
        }
        return {lag: same[lag] for lag in sorted(same)} if len(same) > 1 else {}

    def own_term(self, candidate: Candidate) -> Term | None:
        """Return the term of a candidate that frees a parameter of the model's own sensor; else None."""
        term = self.library.terms[candidate.terms[0]]
        return term if isinstance(term.entry.effect, SENSOR_EQUATIONS) else None

    def of_term(self, term: Term, name: str = "") -> Addition:
        """Return the addition of an effect of no library; the Gram blocks may not have its columns yet."""
        names = value_names(term.entry, term.parameters)
        columns = [Column(one, ((own, 1.0),)) for one, own in zip(names, term.columns, strict=True)]
        return Addition(
            name=name or term.entry.name, columns=tuple(columns), entries=(term.entry,), needs=(term,)
        )

    def of_terms(self, name: str, terms: Sequence[Term]) -> Addition:
        """Return the addition of what a search made of a candidate: a lag, a width, a product of its own."""
        columns: list[Column] = []
        entries: list[ModelEffect] = []
        for place, term in enumerate(terms):
            title = self.title(term.entry) + (f"_{place + 1}" if place else "")
            entries.append(self.entry(term.entry, title))
            names = value_names(entries[-1], term.parameters)
            columns += [Column(one, ((own, 1.0),)) for one, own in zip(names, term.columns, strict=True)]
        return Addition(name=name, columns=tuple(columns), entries=tuple(entries), needs=tuple(terms))

    def entry(self, origin: ModelEffect, name: str, lag_s: float | None = None) -> ModelEffect:
        """Return an effect like another, with its own name and whole units, at values that do nothing."""
        given = {key: value for key, value in origin.effect.given.items() if key != "lag"}
        if lag_s is None and "lag" in origin.effect.given:
            given["lag"] = origin.effect.given["lag"]
        elif lag_s:
            given["lag"] = f"{lag_s:.6g} s"
        entry: dict[str, Any] = {"effect": origin.effect.label(), "name": name, "sensor": origin.sensor.name}
        sensors = sensors_of(self.mission, self.model.comparison)
        return make_effect(entry | given, sensors, self.model.own, self.mission)

    def title(self, origin: ModelEffect) -> str:
        """Return a free name for an effect: its label, and its channels where these decide."""
        parts = [origin.effect.label()]
        if "channel" in origin.effect.given:
            parts += [part.channel for part in parse_channel(origin.effect.channels[0]).parts]
        elif "formula" in origin.effect.given:
            parts += origin.effect.channels
        title = "_".join("".join(c if c.isalnum() else "_" for c in part) for part in parts)
        return self.free_name(title)

    def free_name(self, title: str) -> str:
        """Return a name, numbered when an effect of the model has it."""
        found, number = title, 2
        while found in self.names:
            found, number = f"{title}_{number}", number + 1
        return found

    def term_of(self, column: str) -> Term:
        """Return the term a column is of."""
        return next(term for term in self.library.all_terms if column in term.columns)


def value_names(entry: ModelEffect, parameters: Sequence[str]) -> list[str]:
    """Return the names the model calls the values of some parameters by."""
    return [name for key in parameters for name in entry.parameters[key].columns]


def values_of(entry: ModelEffect) -> dict[str, float]:
    """Return every value of an effect by its name in the model."""
    return {
        name: float(value)
        for timed in entry.parameters.values()
        for name, value in zip(timed.columns, timed.value.ravel(), strict=True)
    }


def neutral_changes(entry: ModelEffect, term: Term) -> dict[str, float] | None:
    """Return the changes of a term's columns that take its effect out; None when they are not all."""
    kinds = type(entry.effect).parameters()
    fitted = [key for key, kind in kinds.items() if np.isfinite(kind.sigma)]
    if not fitted or not set(fitted) <= set(term.parameters):
        return None
    nothing: list[Floats] = [kinds[key].default_values for key in term.parameters]
    start = [term.entry.parameters[key].value[:, 0] for key in term.parameters]
    changes = np.concatenate(nothing) - np.concatenate(start)
    return dict(zip(term.columns, changes.tolist(), strict=True))


#: Effect and parameter of a drift, its neutral values and unit, by what drifts.
_DRIFT_FORMS: dict[str, tuple[str, str, list[float], str]] = {
    "scale": ("affine", "matrix", np.eye(3).ravel().tolist(), "1/d"),
    "angle": ("affine", "matrix", np.eye(3).ravel().tolist(), "deg/d"),
    "offset": ("affine", "shift", [0.0, 0.0, 0.0], "nT/d"),
    "clock": ("time_shift", "seconds", [0.0], "s/d"),
    "bias": ("scalar_bias", "bias", [0.0], "nT/d"),
}


def addition_of(maker: AdditionMaker, option: Option) -> Addition:
    """Return the addition of what a search took."""
    if option.change is not None:
        if option.change.windows:
            times = lines_between_windows(maker.raw, option.change.windows)
            return wander_of(maker, option.mechanism.partition("(")[2].removesuffix(")"), times)
        if not option.change.at:
            return drift_of(maker, option.name)
        return step_of(maker, option.name.split("_")[0], option.change.at)
    if option.number:
        # What it changes is fitted with the others; no entry of the model is added for it.
        return Addition(
            name=option.name,
            columns=tuple(Column(one, ((one, 1.0),)) for one in option.columns),
            entries=(),
            needs=tuple(maker.library.terms[key] for key in option.terms),
        )
    candidates = {one.name: one for one in maker.library.candidates}
    if option.name in candidates:
        return maker.of_candidate(candidates[option.name])
    return maker.of_terms(option.name, [maker.library.terms[key] for key in option.terms])


def drift_of(maker: AdditionMaker, kind: str, name: str = "") -> Addition:
    """Return a drift linear in time: of scale factors, angles or offsets, of the scalar's clock or bias.

    It grows from nothing at the middle of the span; calibration intervals still have their own nine. Of
    the vector sensor's parameters it is an affine change of the reading before them.

    Raises
    ------
    ModelError
        When the comparison has no such parameters.
    """
    what = kind.removesuffix("_drift")
    columns = getattr(maker.time_variable, what)
    if not columns:
        raise ModelError(f"this comparison has nothing that '{kind}' could be of", remedy="try another")
    middle = maker.raw.start / 2 + maker.raw.end / 2
    origin = float(middle.mean())
    days = (middle - origin) / DAY
    term = maker.term_of(columns[0])
    effect, part, neutral, unit = _DRIFT_FORMS[what]
    timed = {
        "time": "linear",
        "t0": f"{to_utc(int(origin))}Z",
        "per": "1 d",
        "value": [[value, 0.0] for value in neutral],
        "free": False,
    }
    fields = {"effect": effect, "name": name or maker.free_name(kind), "sensor": term.entry.sensor.name}
    sensors = sensors_of(maker.mission, maker.model.comparison)
    entry = make_effect(fields | {part: timed}, sensors, mission=maker.mission)
    if len(columns) == 1:
        titles, matrix, values = [f"{entry.name}.{what}"], np.eye(1), [f"{entry.name}.{part}*b"]
    else:
        axes = ANGLES if what == "angle" else tuple("xyz")
        titles = [f"{entry.name}.{what}[{axis}]" for axis in axes]
        matrix = _before_sensor_matrix(maker, what, term) * (-np.deg2rad(1.0) if what == "angle" else 1.0)
        values = [f"{entry.name}.{part}[{2 * axis if what == 'scale' else axis}]*b" for axis in axes]
    made = tuple(Column(title, ((column, 1.0),), days) for title, column in zip(titles, columns, strict=True))
    gains = {value: _weights(titles, row) for value, row in zip(values, matrix, strict=True)}
    return Addition(name=kind, columns=made, entries=(entry,), needs=(term,), gains=gains, unit=unit)


def _before_sensor_matrix(maker: AdditionMaker, what: str, term: Term) -> Floats:
    """Return what changes of the sensor's own parameters are as changes of its reading; (3, 3).

    Rows are those of the reading: relative ones of its axes, or of angles of its own next to 90 deg. A
    change D of K (Yin 2010, eq. 2.5) is the reading's own change S before it, with ``K S = D``.
    """
    if what == "offset":
        return np.eye(3) * (1.0 if term.entry.effect.label() == "affine" else -1.0)
    own = term.entry.parameters
    kx, ky, _ = own["scale_factor"].value[:, 0]
    if what == "scale":
        return np.diag(1.0 / own["scale_factor"].value[:, 0])
    angles = np.deg2rad(own["misalignment"].value[:, 0])
    xy, xz, yz = np.sin(angles)
    across = -np.cos(angles[0]) * yz / (kx * ky)
    return np.array([[xy / kx, 0.0, 0.0], [0.0, xz / kx, across], [0.0, 0.0, yz / ky]])


def step_of(maker: AdditionMaker, kind: str, at: Sequence[int], name: str = "") -> Addition:
    """Return a step of a sensor's parameter, or an episode between two times.

    At edges of blocks its columns are the sensor's own times a function of the block, else columns of
    their own.

    Parameters
    ----------
    kind : str
        ``offset``, ``scale``, ``angle``, ``bias`` or ``clock``.
    at : sequence of int
        TT2000: when it begins, and when it ends if it does.

    Raises
    ------
    ModelError
        When the comparison has no such parameter.
    """
    found = tuple(getattr(maker.time_variable, kind))
    if not found:
        raise ModelError(f"this comparison has no {kind} that could change", remedy="try another")
    inside = maker.raw.start >= at[0]
    if len(at) == 2:
        inside = inside & (maker.raw.start < at[1])
    label = f"{kind}_{'episode' if len(at) == 2 else 'step'}"
    begin = "".join(c for c in str(to_utc(at[0]))[:16] if c.isalnum())
    title = name or maker.free_name(f"{label}_{begin}")
    entries = _step_entries(maker, kind, title, at, maker.term_of(found[0]))
    # Each of them has one parameter: by how much it steps.
    values = [value_names(entry, list(type(entry.effect).parameters())[:1]) for entry in entries]
    source, factor = maker.term_of(found[0]), inside.astype(np.float64)
    gains = _value_weights(maker, kind, values, source)
    dated = f"{label}@{'/'.join(time_text(when) for when in at)}"
    if set(at) <= {*maker.raw.start.tolist(), int(maker.raw.end[-1])}:
        parts = zip(values[0], found, strict=True)
        made = tuple(Column(one, ((column, 1.0),), factor) for one, column in parts)
        return Addition(
            name=dated, columns=made, entries=entries, needs=(source,), interleaved=True, gains=gains
        )
    parts = zip(values[0], dated_columns(source, found, dated), strict=True)
    made = tuple(Column(one, ((column, 1.0),)) for one, column in parts)
    term = dated_term(source, found, dated, tuple(at))
    return Addition(name=dated, columns=made, entries=entries, needs=(term,), interleaved=True, gains=gains)


def wander_of(maker: AdditionMaker, of: str, times: TimeDependence, name: str = "") -> Addition:
    """Return the addition of a parameter that has a value at each of some times, with lines between.

    Of a vector sensor it is the effect `wander`; of a scalar sensor's bias or clock, that effect with the
    same time dependence. Columns are the parameter's own times a function of the block.

    Parameters
    ----------
    of : str
        Such as ``scale_factor[z]``, ``bias`` or ``seconds``.
    times : TimeDependence
        A spline of lines.

    Raises
    ------
    ModelError
        When the comparison has no such parameter, or there are fewer than two times.
    """
    kinds = {kind: columns for kind, (_, columns) in maker.time_variable.kinds.items()}
    known = {one.rsplit(".", 1)[-1]: (kind, one) for kind, some in kinds.items() for one in some}
    if of not in known or maker.term_of(known[of][1]).entry.effect.label() == "affine":
        raise ModelError(
            f"this comparison has no {of!r} that could wander{did_you_mean(of, known)}",
            remedy=f"it has {', '.join(known) or 'none'}",
        )
    if times.count < 2:
        raise ModelError(f"the record has no two windows in which '{of}' could differ", remedy="shorten them")
    kind, column = known[of]
    term = maker.term_of(column)
    place = getattr(maker.time_variable, kind).index(column)
    given: dict[str, Any] = {"effect": term.entry.effect.label(), "empirical": True}
    part, size = of, 1.0
    if kind not in ("bias", "clock"):
        given, part = {"effect": "wander", "of": of}, "change"
        if kind != "offset":
            # The sensor's equation takes the offset off before it scales and turns.
            offset = term.entry.parameters["offset"].value[:, 0].tolist()
            given["about"] = {"value": offset, "free": False}
            size = float(_before_sensor_matrix(maker, kind, term)[place, place])
    title = name or maker.free_name(
        f"wander_{''.join(one if one.isalnum() else '_' for one in of).strip('_')}"
    )
    given |= {"name": title, "sensor": term.entry.sensor.name, part: times.as_yaml() | {"free": False}}
    entry = make_effect(given, sensors_of(maker.mission, maker.model.comparison), mission=maker.mission)
    basis = times.basis(maker.raw.start // 2 + maker.raw.end // 2).T
    names = entry.parameters[part].columns
    columns = [Column(one, ((column, 1.0 / size),), factor) for one, factor in zip(names, basis, strict=True)]
    days = np.median(np.diff(times.at)) / DAY
    label = f"wander({of}, {days:.6g} d)"
    return Addition(name=label, columns=tuple(columns), entries=(entry,), needs=(term,), interleaved=True)


def _step_entries(
    maker: AdditionMaker, kind: str, title: str, at: Sequence[int], term: Term
) -> tuple[ModelEffect, ...]:
    """Return the entries of a step or an episode; a bias that comes and goes is two steps."""
    sensors = sensors_of(maker.mission, maker.model.comparison)
    when = [f"{to_utc(one)}Z" for one in at]
    if kind != "bias" and len(at) == 2:
        entries = [{"effect": f"{kind}_episode", "name": title, "from": when[0], "to": when[1]}]
    else:
        names = [title, f"{title}_end"]
        entries = [
            {"effect": f"{kind}_step", "name": name, "at": one}
            for name, one in zip(names, when, strict=False)
        ]
    given: dict[str, Any] = {"sensor": term.entry.sensor.name}
    if kind in ("scale", "angle"):
        # The sensor's equation takes the offset off before it scales and turns.
        offset = term.entry.parameters["offset"].value[:, 0].tolist()
        given["about"] = {"value": offset, "free": False}
    return tuple(make_effect(one | given, sensors, mission=maker.mission) for one in entries)


def _value_weights(
    maker: AdditionMaker, kind: str, values: Sequence[Sequence[str]], term: Term
) -> dict[str, tuple[tuple[str, float], ...]]:
    """Return how the model's values follow from those of the columns that change."""
    first = values[0]
    matrix = np.eye(len(first))
    if kind == "offset":
        matrices = sensor_matrices(maker.model, int(maker.raw.start[0]))
        # Behind the sensor's equation a step of its offset is that step through K.
        affine = term.entry.effect.label() == "affine"
        own = matrices.get(term.entry.sensor.name, np.eye(3))
        matrix = -np.eye(3) if affine else np.reshape(own, (3, 3))
    elif kind in ("scale", "angle"):
        matrix = _before_sensor_matrix(maker, kind, term)
    gains = {}
    for sign, names in zip((1.0, -1.0), values, strict=False):
        for row, name in enumerate(names):
            gains[name] = _weights(first, sign * matrix[row])
    return gains


def _weights(names: Sequence[str], weights: Floats) -> tuple[tuple[str, float], ...]:
    return tuple((name, float(weight)) for name, weight in zip(names, weights, strict=True))
