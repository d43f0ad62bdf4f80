"""What could be missing: terms, candidates, and the library of them.

A *term* is one effect with its columns of the residual; a *candidate* is one or several terms that
are accepted or refused together. Candidates of one *mechanism* (the same cause with another lag or width) are
rivals in form only; candidates of different mechanisms are rivals in cause.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from inflight.model import ModelEffect


@dataclass(frozen=True, kw_only=True)
class HeldNumber:
    """A number that the model holds and no fit may move, which its effects depend on not only in proportion.

    Attributes
    ----------
    name : str
        ``temperature.lag`` of an effect of the model, ``coil_temperature.lag`` of a channel of the mission.
    key : str
        What it is: ``lag``, ``delay``, ``width``, ``about``, ``turn_x`` (of panels), or a parameter.
    effects : tuple of (str, int)
        Effects of the model that it is in, and which factor of their channel it belongs to.
    channel : str
        Whose lag, width or value it is; empty when it is no channel's.
    value, unit : float, str
        As it is held.
    step : float
        Half of the difference that its derivative is made of.
    bounds : tuple of float
        Least and largest value that it may plausibly have.
    path : str
        Its place in the mission file; empty for a number of the model.
    """

    name: str
    key: str
    effects: tuple[tuple[str, int], ...]
    channel: str
    value: float
    unit: str
    step: float
    bounds: tuple[float, float]
    path: str = ""


@dataclass(frozen=True)
class Difference:
    """The effects of a model with a number at two values: their difference is a column.

    Attributes
    ----------
    number : HeldNumber
    low, high : tuple of ModelEffect
        The same effects at both values.
    between : tuple of float
        The two values.
    """

    number: HeldNumber
    low: tuple[ModelEffect, ...]
    high: tuple[ModelEffect, ...]
    between: tuple[float, float]

    @property
    def apart(self) -> float:
        """By how much the values differ: the physical size of one unit of the column."""
        return self.between[1] - self.between[0]


@dataclass(frozen=True)
class Term:
    """One effect, the parameters a fit may move, and their columns.

    Attributes
    ----------
    key : str
        Unique name.
    entry : ModelEffect
        The effect at the values it is linearised at.
    parameters : tuple of str
        Its parameters that have columns.
    sigma : tuple of float
        What is known beforehand of each column, physical units; inf when nothing.
    span : tuple of int
        TT2000 from when, and until when if it ends, the columns hold, 0 otherwise; always when empty.
    difference : Difference, optional
        Its one column is what a number that is held does to the model's effects; it has no parameters then.
    """

    key: str
    entry: ModelEffect
    parameters: tuple[str, ...]
    sigma: tuple[float, ...] = ()
    span: tuple[int, ...] = ()
    difference: Difference | None = None

    def before_any_fit(self) -> Term:
        """Return the term with the sigma that was known before any fit; what is free of it stays so."""
        if not self.sigma:
            return self
        known = [one for name in self.parameters for one in self.entry.parameters[name].prior_sigma[:, 0]]
        both = zip(self.sigma, known, strict=True)
        return replace(self, sigma=tuple(max(one, float(before)) for one, before in both))

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels, derived ones among them, that the columns are made from."""
        entries = (*self.difference.low, *self.difference.high) if self.difference else (self.entry,)
        return tuple(dict.fromkeys(name for entry in entries for name in entry.effect.channels if name))

    @property
    def columns(self) -> list[str]:
        """Names of the columns, ``key.parameter[axis]``."""
        if self.difference is not None:
            return [f"{self.key}.{self.difference.number.key}"]
        kinds = self.entry.effect.parameters()
        return [
            f"{self.key}.{name}[{axis}]" if axis else f"{self.key}.{name}"
            for name in self.parameters
            for axis in (kinds[name].axes or ("",))
        ]

    @property
    def usual(self) -> list[float]:
        """Usual size of each column's parameter, as its effect states it, in units of the column."""
        if self.difference is not None:
            low, high = self.difference.number.bounds
            return [abs((high - low) / self.difference.apart)]
        kinds = self.entry.effect.parameters()
        sizes = [(kinds[name].sigma / kinds[name].step, kinds[name].size) for name in self.parameters]
        return [size if np.isfinite(size) else 1e3 for size, count in sizes for _ in range(count)]

    @property
    def scale(self) -> list[float]:
        """Physical size of one unit of each column."""
        if self.difference is not None:
            return [self.difference.apart]
        kinds = self.entry.effect.parameters()
        return [kinds[name].step for name in self.parameters for _ in range(kinds[name].size)]


def within_span(stamps: npt.NDArray[np.int64], span: Sequence[int]) -> npt.NDArray[np.bool_]:
    """Return which stamps are at or after a time, and before the second one if there is one."""
    inside = stamps >= span[0]
    return inside & (stamps < span[1]) if len(span) == 2 else inside


@dataclass(frozen=True)
class Candidate:
    """Something that may be missing.

    Attributes
    ----------
    name, mechanism : str
        ``channel_field(heater)@lag=360s`` is of the mechanism ``channel_field(heater)``.
    family : str
        One of the families of `diagnose`.
    channels : tuple of str
        Base channels it is made from.
    terms : tuple of str
        Keys of its terms.
    lag_s : float
        Time constant of its response.
    agnostic : bool
        It describes a shape and names no cause.
    placebo : bool
        Made from a channel of another time: whatever it explains, it explains by chance.
    number : str
        Name of the number of the model that it changes; empty of an effect.
    """

    name: str
    mechanism: str
    family: str
    channels: tuple[str, ...]
    terms: tuple[str, ...]
    lag_s: float = 0.0
    agnostic: bool = False
    placebo: bool = False
    number: str = ""


@dataclass(frozen=True)
class ChannelSummary:
    """What is known of a channel before the pass.

    Attributes
    ----------
    mean, spread : float
        Over the span, channel units; `spread` is the range of nine tenths of its values.
    missing : float
        Part of the span it is missing.
    kind : str
        Of the mission's channel.
    """

    mean: float
    spread: float
    missing: float = 0.0
    kind: str = "other"


@dataclass
class Library:
    """Terms and candidates of one comparison.

    Attributes
    ----------
    base : list of Term
        What every calibration interval fits anew: the nine parameters.
    refined : list of Term
        Other parameters of the model that data may refine within their stated sigma.
    terms : dict of str to Term
        Terms of candidates.
    candidates : list of Candidate
        In a fixed order.
    placebos : dict of str to float
        Placebo channel -> seconds by which its channel is shifted.
    unscorable : list of dict
        What cannot be tried, and why.
    unlagged : frozenset of str
        Channels that go with the spin: between the samples of a synthetic turn there is no time.
    edges : list of Term
        What is fitted beside everything that follows the Earth's shadow: a field where light fades and one
        where it returns. The shadow's width is known to some kilometres only, and what a wrong one leaves
        of a field in sunlight others would explain.
    edged : bool
        The model itself has something that follows the shadow: `edges` are always fitted.
    """

    base: list[Term] = field(default_factory=list)
    refined: list[Term] = field(default_factory=list)
    terms: dict[str, Term] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    placebos: dict[str, float] = field(default_factory=dict)
    unscorable: list[dict[str, str]] = field(default_factory=list)
    unlagged: frozenset[str] = frozenset()
    edges: list[Term] = field(default_factory=list)
    edged: bool = False

    @property
    def all_terms(self) -> list[Term]:
        """Terms in the order of their columns: base, refined, edges, candidates'."""
        return [*self.base, *self.refined, *self.edges, *self.terms.values()]

    @property
    def by_key(self) -> dict[str, Term]:
        """Every term by its key; of several with one key the last."""
        return {term.key: term for term in self.all_terms}

    @property
    def columns(self) -> list[str]:
        """Names of all columns, the residual not among them."""
        return [name for term in self.all_terms for name in term.columns]

    @property
    def channels(self) -> list[str]:
        """Every channel the terms need, derived ones and placebos included."""
        return sorted({name for term in self.all_terms for name in term.channels})

    def columns_of(self, candidate: Candidate) -> list[str]:
        """Names of a candidate's columns."""
        return [name for key in candidate.terms for name in self.terms[key].columns]

    def add(self, candidate: Candidate, terms: Iterable[Term]) -> None:
        """Take in a candidate; terms that are there already are shared."""
        for term in terms:
            self.terms.setdefault(term.key, term)
        self.candidates.append(candidate)


def term_of(entry: ModelEffect, key: str, free_only: bool = False) -> Term:
    """Return the term of an effect: its parameters that a fit may move.

    Parameters
    ----------
    free_only : bool
        Only parameters the model leaves free, with their stated sigma; else all that have a prior.
    """
    kinds = entry.effect.parameters()
    names, sigma = [], []
    for name, kind in kinds.items():
        timed = entry.parameters[name]
        known = timed.sigma[:, 0]
        if free_only and not (timed.free and timed.time == "constant" and np.all(known > 0)):
            continue
        if not free_only and not np.isfinite(kind.sigma):
            continue
        names.append(name)
        sigma += list(known) if free_only else [np.inf] * kind.size
    return Term(key, entry, tuple(names), tuple(float(one) for one in sigma))
