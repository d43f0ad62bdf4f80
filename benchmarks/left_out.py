"""Leave one form out: what the search says of an effect whose form, or whose family, its library lacks.

The design is that of a simulated mission's own pass (`benchmarks.coverage.Design`). Each case hides one
effect in noise: one of the library that is then taken out of it, with every other of its form; or with its
family, whose channels stay in the table *acts on* x *follows*; or with all that follows its channel; or one
that no library has (a delay, a threshold, a bias that follows a channel, ...). The search must name the
channel that drives it, alone or among rivals, or say that what is there is unknown; a cause that is called
sure and has nothing to do with it is wrong. Where nobody recorded the channel, another one that moves with it
is all that can be named.

In other cases a number of the model is wrong: one component of each with a stated sigma, by three and by ten
of these, and each that has none by as much as leaves half the noise, at most half of the way to the end of
its plausible range.

``python -m benchmarks left_out`` prints the table.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.coverage import Design, search_over
from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.design import Candidate, DesignRows, HeldNumber, Library, design_matrix
from inflight.diagnosis import Diagnosis, DiagnosisData, Search, forms, run_search
from inflight.diagnosis.forms import Followed
from inflight.diagnosis.model_numbers import difference_of
from inflight.diagnosis.residual import derived_channels
from inflight.diagnosis.series import Series
from inflight.diagnosis.stepwise import channels_under
from inflight.lsq import GramArrays
from inflight.model import Model
from inflight.residual import NoiseFloor
from inflight.tasks.analysis import DiagnoseSettings
from inflight.tasks.analysis.diagnosis import diagnosis_data, make_pass


@dataclass(frozen=True, kw_only=True)
class LeftOutSettings:
    """What is hidden.

    Attributes
    ----------
    noise_nT : float
        Of a row, all of whose samples are there.
    size : float
        Rms of what the calibration leaves of the effect, in noises of a row.
    each, family, outside : int
        Cases of each form, of each family, and of each shape that no library has.
    sigmas : tuple of float
        Of its own by which a number of the model is wrong.
    """

    noise_nT: float = 0.1  # noqa: N815 (a unit)
    size: float = 0.5
    each: int = 5
    family: int = 1
    outside: int = 3
    sigmas: tuple[float, ...] = (3.0, 10.0)
    seed: int = 1


@dataclass(frozen=True, kw_only=True)
class Case:
    """One hidden effect: what it is called, what drives it, what of the library is left out.

    `number` is the column of a number of the model that is wrong, `off` by how much, in units of the column;
    of one without a sigma, `held` is it.
    """

    group: str
    name: str
    channels: frozenset[str]
    family: str
    candidate: Candidate | None = None
    shape: Callable[[DesignRows, Floats], Floats] | None = None
    left_out: frozenset[str] = frozenset()
    number: str = ""
    off: float = 0.0
    held: HeldNumber | None = None


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the search said of a case: ``named``, ``unknown``, ``other`` (with doubts), or ``wrong``."""

    case: Case
    kind: str
    verdict: str
    told: tuple[str, ...] = ()
    part_left: float = np.nan
    sentence: str = field(default="", repr=False)


#: Parts of the way to the farther end of a number's plausible range that are tried, until enough is left.
WAY = np.geomspace(0.001, 0.5, 25)

#: Cases in which nothing of the library follows the channel, as if nobody had recorded it.
UNRECORDED = "a channel nobody recorded"


def form_of(candidate: Candidate) -> str:
    """Return what a candidate acts on, and how it follows its channel: ``channel_field, lag``."""
    label = candidate.mechanism.partition("(")[0]
    return f"{label}, lag" if candidate.lag_s else label


def cases(design: Design, search: Search, settings: LeftOutSettings) -> list[Case]:
    """Return what is hidden, in a fixed order; only what the calibration leaves visible."""
    generator = np.random.default_rng(settings.seed)
    library = design.made.plan.library
    seen = {one.name for one in search.options if not one.placebo}
    real = [one for one in library.candidates if one.name in seen and not one.agnostic]
    out = []
    for kind, count in (("form", settings.each), ("family", settings.family)):
        groups: dict[str, list[Candidate]] = {}
        for one in real:
            groups.setdefault(form_of(one) if kind == "form" else one.family, []).append(one)
        for key, some in groups.items():
            gone = frozenset(one.name for one in some)
            for at in generator.permutation(len(some))[:count]:
                one = some[int(at)]
                out.append(
                    Case(
                        group=f"{kind} {key}",
                        name=one.name,
                        channels=frozenset(one.channels),
                        family=one.family,
                        candidate=one,
                        left_out=gone,
                    )
                )
    fields_of = [one for one in real if one.mechanism.startswith("channel_field(") and not one.lag_s]
    for one in fields_of:
        gone = frozenset(
            other.name for other in library.candidates if set(one.channels) & set(other.channels)
        )
        out.append(
            Case(
                group=UNRECORDED,
                name=one.name,
                channels=frozenset(one.channels),
                family=one.family,
                candidate=one,
                left_out=gone,
            )
        )
    driving = sorted({one.channels[0] for one in real if one.mechanism.startswith("channel_field(")})
    for name, shape in OUTSIDE.items():
        for at in generator.permutation(len(driving))[: settings.outside]:
            channel = driving[int(at)]
            out.append(
                Case(
                    group="outside the library",
                    name=f"{name} of {channel}",
                    channels=frozenset([channel]),
                    family="",
                    shape=shape,
                )
            )
    return out


def wrong_numbers(design: Design, model: Model, search: Search, settings: LeftOutSettings) -> list[Case]:
    """Return cases in which a number of the model is wrong, those with a stated sigma first."""
    generator = np.random.default_rng([settings.seed, 1])
    library = design.made.plan.library
    channels = {one.name: channels_under(one.effect.channels) for one in model.effects}
    out = []
    for term in library.refined:
        groups: dict[str, list[int]] = {}
        for place, name in enumerate(term.columns):
            groups.setdefault(name.partition("[")[0], []).append(place)
        for name, places in groups.items():
            effect = name.removeprefix("model:").partition(".")[0]
            place = int(generator.choice(places))
            for sigmas in settings.sigmas:
                off = sigmas * term.sigma[place] / term.scale[place] * generator.choice([-1.0, 1.0])
                out.append(
                    Case(
                        group=f"a number wrong by {sigmas:g} sigma",
                        name=term.columns[place].removeprefix("model:"),
                        channels=frozenset(channels.get(effect, ())),
                        family="",
                        number=term.columns[place],
                        off=float(off),
                    )
                )
    seen = {one.name for one in search.options if one.number}
    for candidate in library.candidates:
        held = held_by(candidate, library)
        if candidate.name in seen and held is not None:
            # One that the mission file states of a channel is that of all effects that follow it.
            effects = {channel for name, _ in held.effects for channel in channels.get(name, ())}
            out.append(
                Case(
                    group="a number without a sigma wrong",
                    name=candidate.name,
                    channels=frozenset(channels_under(candidate.channels)) | effects,
                    family=candidate.family,
                    number=candidate.name,
                    held=held,
                )
            )
    return out


def held_by(candidate: Candidate, library: Library) -> HeldNumber | None:
    """Return the number of the model's form that a candidate is, if it is one."""
    terms = [library.terms[key] for key in candidate.terms]
    return terms[0].difference.number if len(terms) == 1 and terms[0].difference else None


def _channel(rows: DesignRows, case: Case) -> Floats:
    (name,) = case.channels
    return np.asarray(rows.samples[name].values, dtype=np.float64)


def _delayed(rows: DesignRows, values: Floats) -> Floats:
    step = float(np.median(np.diff(rows.samples["tt2000"].values))) / 1e9
    late = max(1, round(900.0 / step))
    return np.concatenate([np.repeat(values[:1], late), values[:-late]])


def _threshold(_: DesignRows, values: Floats) -> Floats:
    return (values > np.nanmedian(values)).astype(np.float64)


def _saturating(_: DesignRows, values: Floats) -> Floats:
    centre, spread = np.nanmedian(values), max(float(np.nanstd(values)), 1e-12)
    return np.asarray(np.tanh(2.0 * (values - centre) / spread))


def _folded(_: DesignRows, values: Floats) -> Floats:
    return np.asarray(np.abs(values - np.nanmedian(values)))


def _rate(rows: DesignRows, values: Floats) -> Floats:
    return np.asarray(np.gradient(values, rows.samples["tt2000"].values / 1e9))


#: Functions of a channel that no effect of the library is: a dead time of 900 s, a threshold, a saturation, a
#: field on both sides of a mean alike, a rate.
FUNCTIONS = {
    "delay": _delayed,
    "threshold": _threshold,
    "saturation": _saturating,
    "absolute value": _folded,
    "rate": _rate,
}


def _field_of(function: Callable[[DesignRows, Floats], Floats]) -> Callable[[DesignRows, Floats], Floats]:
    def shape(rows: DesignRows, values: Floats) -> Floats:
        (direction,) = list(rows.directions.values())[:1]
        return np.asarray(direction[:, 0] * function(rows, values)[:, None])

    return shape


def _bias(_: DesignRows, values: Floats) -> Floats:
    return np.asarray(values[:, None] - np.nanmean(values))


def _clock(rows: DesignRows, values: Floats) -> Floats:
    strength = np.linalg.norm(rows.samples["field"].values, axis=1)
    return _bias(rows, values) * _rate(rows, strength)[:, None]


#: Effects that no library has: columns (time, column) of the channel's values (time,).
OUTSIDE: dict[str, Callable[[DesignRows, Floats], Floats]] = {
    **{f"field, {name}": _field_of(one) for name, one in FUNCTIONS.items()},
    "bias": _bias,
    "clock": _clock,
}


class Missions:
    """Residuals of all cases on one design, and the search over each."""

    def __init__(self, cat: Catalog, settings: LeftOutSettings) -> None:
        self.settings = settings
        self.design = Design(cat)
        self.data = diagnosis_data(
            make_pass(cat, self.design.mission, None, None, DiagnoseSettings()), self.design.mission
        )
        self.weights = [rows.weight for rows, _ in self.design.rows()]
        zeros = [np.zeros((len(one), 1)) for one in self.weights]
        first = self.design.search(zeros)
        hidden = cases(self.design, first, settings)
        wrong = wrong_numbers(self.design, self.data.model, first, settings)
        self.cases = [*hidden, *wrong]
        # Each with draws of its own: more cases of one change nothing of the other.
        both = zip(self._drawn(hidden, settings.seed), self._drawn(wrong, settings.seed + 1), strict=True)
        self.residuals = [np.concatenate(one, axis=1) for one in both]
        self.grams = self.design.grams(self.residuals)

    def _drawn(self, some: Sequence[Case], seed: int) -> list[Floats]:
        """Return the residuals of each day; (time, case)."""
        generator = np.random.default_rng(seed)
        library = self.design.made.plan.library
        noise, columns = [], [list[Floats]() for _ in some]
        for rows, _ in self.design.rows():
            with np.errstate(divide="ignore"):
                spread = np.where(rows.weight > 0, self.settings.noise_nT / np.sqrt(rows.weight), 0.0)
            noise.append(generator.normal(size=(len(rows.weight), len(some))) * spread[:, None])
            for case, out in zip(some, columns, strict=True):
                if case.held is not None:
                    continue
                if case.number:
                    own = [term for term in library.refined if case.number in term.columns]
                    place = own[0].columns.index(case.number)
                    out.append(case.off * design_matrix(own, rows)[:, 0, [place]])
                elif case.candidate is not None:
                    terms = [library.terms[key] for key in case.candidate.terms]
                    out.append(design_matrix(terms, rows)[:, 0])
                else:
                    assert case.shape is not None
                    out.append(np.nan_to_num(case.shape(rows, np.nan_to_num(_channel(rows, case)))))
        base = [design_matrix(library.base, rows)[:, 0] for rows, _ in self.design.rows()]
        edges = np.cumsum([0, *map(len, self.weights)])
        root = np.sqrt(np.concatenate(self.weights))
        basis = np.linalg.qr(np.concatenate(base) * root[:, None])[0]
        for place, (case, parts) in enumerate(zip(some, columns, strict=True)):
            whole = self._of_value(case.held, basis, root) if case.held else np.concatenate(parts)
            if case.number:
                for day, out in enumerate(noise):
                    out[:, place] -= whole[edges[day] : edges[day + 1], 0]
                continue
            whole = whole / np.maximum(np.sqrt(np.mean(whole**2, axis=0)), 1e-30)
            effect = whole @ generator.normal(size=whole.shape[1])
            left = effect * root - basis @ (basis.T @ (effect * root))
            effect *= self.settings.size * self.settings.noise_nT / np.sqrt(np.sum(left**2) / np.sum(root**2))
            for day, out in enumerate(noise):
                out[:, place] -= effect[edges[day] : edges[day + 1]]
        return noise

    def _of_value(self, number: HeldNumber, basis: Floats, root: Floats) -> Floats:
        """Return what a wrong value of a number changes of the residual; (row, 1)."""
        data, wanted = self.data, self.settings.size * self.settings.noise_nT
        far = max(number.bounds, key=lambda end: abs(end - number.value))
        change = np.zeros((len(root), 1))
        for part in WAY:
            value = number.value + part * (far - number.value)
            term = difference_of(number, data.linearised, data.mission, value, "wrong")
            rows = data.series.rows(data.sensor_matrices, derived_channels(data.series, term.channels))
            change = np.nan_to_num(design_matrix([term], rows)[:, 0])
            seen = change[:, 0] * root
            seen -= basis @ (basis.T @ seen)
            if np.sqrt(np.sum(seen**2) / np.sum(root**2)) >= wanted:
                break
        return change

    def answer(self, place: int) -> Answer:
        """Return what the search says of a case."""
        case = self.cases[place]
        search, data = self._search(place)
        with cells_without(case):
            found, last = run_search(search, data)
        return judged(case, found, last, data.model, self.settings)

    def _search(self, place: int) -> tuple[Search, DiagnosisData]:
        case, library = self.cases[place], self.design.made.plan.library
        kept = [one for one in library.candidates if one.name not in case.left_out]
        keys = {key for one in kept for key in one.terms}
        own = replace(
            library,
            candidates=kept,
            terms={key: term for key, term in library.terms.items() if key in keys},
        )
        names = [*own.columns, f"residual~{place}" if place else "residual"]
        search = search_over(*(with_columns(one, names) for one in self.grams), own)
        noise = self.settings.noise_nT
        data = replace(
            self.data,
            series=with_residual(self.data.series, [one[:, place] for one in self.residuals], self.weights),
            sums={"count": float(search.raw.count.sum()), "inside": 0.0},
            floor=NoiseFloor(noise, 0.99 * noise, 1.01 * noise),
            columns={},
        )
        return search, data


#: Forms of the library's core that are cells of the table `acts on` x `follows`.
CELLS = {
    "channel_power": ("channel_field", "square"),
    "hysteresis": ("channel_field", "play"),
    **{label: (label, "value") for label in ("channel_field", "channel_scale", "channel_angle")},
    **{f"{label}, lag": (label, "response") for label in ("channel_field", "channel_scale", "channel_angle")},
}


@contextmanager
def cells_without(case: Case) -> Iterator[None]:
    """Leave out of the library's second tier, too, what a case leaves out of its core."""
    gone = CELLS.get(form_of(case.candidate)) if case.group.startswith("form") and case.candidate else None
    every, every_channel = forms._cells, forms.driving_channels

    def cells(
        search: Search, data: DiagnosisData, label: str, channels: Sequence[str], held: bool = False
    ) -> list[Followed]:
        found = every(search, data, label, channels, held)
        if case.group == UNRECORDED:
            return [one for one in found if one.channel not in case.channels]
        return [one for one in found if (label, one.how) != gone]

    def driving(data: DiagnosisData) -> list[str]:
        recorded = every_channel(data)
        return [one for one in recorded if case.group != UNRECORDED or one not in case.channels]

    forms._cells, forms.driving_channels = cells, driving
    try:
        yield
    finally:
        forms._cells, forms.driving_channels = every, every_channel


def with_columns(grams: GramArrays, names: list[str]) -> GramArrays:
    """Return some columns and one residual of Gram blocks, which comes last."""
    known = {name: place for place, name in enumerate(grams.names)}
    at = np.array([known[name] for name in names])
    kept = np.ascontiguousarray(grams.gram[:, at[:, None], at])
    return replace(grams, names=(*names[:-1], "residual"), gram=kept, scale=grams.scale[at])


def with_residual(series: Series, residuals: list[Floats], weights: list[Floats]) -> Series:
    """Return a series with another residual: weighted means of so many rows as it joined."""
    step = round(sum(map(len, weights)) / len(series.tt2000))
    values = series.values.copy(order="K")
    joined = []
    for residual, weight in zip(residuals, weights, strict=True):
        count = len(weight) // step * step
        own, rows = (one[:count].reshape(-1, step) for one in (weight, residual))
        total = own.sum(axis=1)
        joined.append(np.divide((own * rows).sum(axis=1), total, out=np.zeros_like(total), where=total > 0))
    values[:, series.features.place("residual").start] = np.concatenate(joined)
    return replace(series, values=values)


def judged(case: Case, found: Diagnosis, last: Search, model: Model, settings: LeftOutSettings) -> Answer:
    """Return how a diagnosis stands against what was hidden."""
    channels = {one.name: set(one.channels) for one in found.effects}
    families = {one.name: one.family for one in found.effects}
    instead = {one.name: one.instead for one in found.effects}
    options = {one.mechanism: one for one in [*last.options, *last.accepted]}
    mechanism = case.candidate.mechanism if case.candidate else ""

    def is_it(name: str, own: set[str], family: str) -> bool:
        under = channels_under(list(own)) if own else own
        if case.channels:
            return bool(under & case.channels)
        if case.number:
            return False
        return family == case.family or name.partition("(")[0] == mechanism.partition("(")[0]

    # A number of the model is named by its effect, which follows a channel.
    numbers = {one.name: channels_under(one.effect.channels) for one in model.effects}
    effects = {name for name, _ in case.held.effects} if case.held else set()
    if case.number:
        effects.add(case.number.removeprefix("model:").partition(".")[0])
    named, wrong, told = False, False, []
    for entry in found.entries:
        own, family = channels.get(entry.name, set()), families.get(entry.name, "")
        rivals = [options[one] for one in entry.rivals if one in options]
        right = is_it(entry.name, own, family) or any(
            is_it(one.mechanism, set(one.channels), one.family) for one in rivals
        )
        right |= bool(numbers.get(entry.name.partition(".")[0], set()) & case.channels)
        # Of an effect without a channel its own name is what drives it.
        told_of = {one.removeprefix("model:").partition(".")[0] for one in (entry.name, *entry.rivals)}
        right |= bool(effects & told_of)
        # What a stand-in may be a part of names its cause.
        named |= right or bool(set(instead.get(entry.name, "").split()) & case.channels)
        wrong |= entry.status == "sure" and not right
        told.append(f"{entry.status}: {entry.name} {entry.takes_off_nT:.3f}")
    left = found.remaining.get("signature")
    named |= (
        left is not None and left.channel is not None and bool(set(left.channel.split("*")) & case.channels)
    )
    kind = "wrong" if wrong else "named" if named else "other"
    if kind == "other" and all(one.status == "unknown" for one in found.entries):
        kind = "unknown" if found.entries else "nothing"
    before, after = (found.residual[f"held_out_{when}_nT"] for when in ("before", "after"))
    hidden = (settings.size * settings.noise_nT) ** 2
    return Answer(
        case=case,
        kind=kind,
        verdict=found.verdict,
        told=tuple(told),
        part_left=float(
            max(after**2 - settings.noise_nT**2, 0.0) / max(before**2 - settings.noise_nT**2, hidden)
        ),
        sentence=found.sentence,
    )


def left_out(cat: Catalog, settings: LeftOutSettings | None = None, only: str = "") -> Iterator[Answer]:
    """Yield what the search says of each case whose group or name holds `only`."""
    missions = Missions(cat, settings or LeftOutSettings())
    library = missions.design.made.plan.library
    for place, case in enumerate(missions.cases):
        # Of a number half the noise may be more than is plausible: these have cases of their own.
        if case.candidate is not None and held_by(case.candidate, library) is not None:
            continue
        if only in f"{case.group} {case.name}":
            yield missions.answer(place)


def table(answers: list[Answer]) -> list[str]:
    """Return the lines of the table, as Markdown: how many cases of each group were answered how."""
    kinds = ("named", "unknown", "other", "nothing", "wrong")
    out = ["| left out | cases | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 2) + "|"]
    groups = list(dict.fromkeys(one.case.group for one in answers))
    for group in [*groups, "all"]:
        some = [one.kind for one in answers if group in (one.case.group, "all")]
        count = Counter(some)
        out.append(
            f"| {group} | {len(some)} | " + " | ".join(str(count[kind] or "") for kind in kinds) + " |"
        )
    return out
