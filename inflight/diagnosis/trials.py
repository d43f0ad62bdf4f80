"""Forms of one effect tried on the coarse series: what each leaves beside everything else of the model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.columns import Rows, design
from inflight.diagnosis.evidence import solve_scaled
from inflight.diagnosis.left import made_channels
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.search import Option, Search
from inflight.model import make_effect
from inflight.sensors import sensors_of


class Trials:
    """Trials of forms of an option that the model holds; the option itself is taken off the model."""

    def __init__(self, search: Search, material: Material, option: Option) -> None:
        self.search, self.material = search, material
        self.series = material.series
        others = [one for one in search.accepted if one is not option and one.terms]
        keys = sorted({key for one in others for key in one.terms})
        kept = [*search.library.refined, *(material.terms[key] for key in keys)]
        self.rows = self._rows([*search.library.base, *kept])
        self.block = np.repeat(self.series.block, self.rows.residual.shape[1])
        self.root = np.sqrt(np.repeat(self.rows.weight, self.rows.residual.shape[1]))
        base = self._flat(search.library.base, self.rows)
        self.groups = [np.isin(self.block, np.asarray(group)) for group in search.intervals]
        self.basis = [np.linalg.qr(base[group])[0] for group in self.groups] if base.shape[1] else []
        self.y = self._absorbed((self.rows.residual.reshape(-1) * self.root)[:, None])[:, 0]
        self.model = self._absorbed(self._flat(kept, self.rows))
        self._known: dict[str, Floats] = {}

    def left(self, terms: Sequence[Term]) -> Floats:
        """Return what the terms together leave in each block; (block,) nT^2."""
        columns = np.concatenate([self.model, *(self._columns(term) for term in terms)], axis=1)
        value = solve_scaled(columns.T @ columns, columns.T @ self.y)
        rest = self.y - columns @ value
        return np.asarray(
            np.bincount(self.block, weights=rest**2, minlength=len(self.search.raw)), dtype=np.float64
        )

    def contribution(self, option: Option, terms: Sequence[Term]) -> tuple[Floats, Floats]:
        """Return the residual beside the rest of the model, without and with an option; (row,) nT, weighted.

        Parameters
        ----------
        option : Option
            Of the library, or a change in time: then `terms` are those whose columns change.
        """
        flat = self._flat(terms, self._rows(terms))
        if option.change is not None and option.change.functions:
            names = [name for term in terms for name in term.columns]
            flat = np.stack(
                [
                    flat[:, names.index(column)] * np.asarray(factor)[self.block]
                    for column, factor in option.change.functions.values()
                ],
                axis=1,
            )
        own = self._absorbed(flat)
        if self.model.shape[1]:
            inner = self.model.T @ self.model
            own -= self.model @ solve_scaled(inner, self.model.T @ own)
            before = self.y - self.model @ solve_scaled(inner, self.model.T @ self.y)
        else:
            before = self.y
        return before, before - own @ solve_scaled(own.T @ own, own.T @ before)

    def _columns(self, term: Term) -> Floats:
        if term.key not in self.material.terms:
            return self._absorbed(self._flat([term], self._rows([term])))
        if term.key not in self._known:
            self._known[term.key] = self._absorbed(self._flat([term], self._rows([term])))
        return self._known[term.key]

    def _rows(self, terms: Sequence[Term]) -> Rows:
        channels = {name for term in terms for name in term.entry.effect.channels if name}
        return self.series.rows(self.material.turn, made_channels(self.series, channels))

    def _flat(self, terms: Sequence[Term], rows: Rows) -> Floats:
        columns = design(terms, rows)
        return np.asarray(columns.reshape(len(self.root), columns.shape[2]) * self.root[:, None])

    def _absorbed(self, values: Floats) -> Floats:
        out = values.copy()
        for group, basis in zip(self.groups, self.basis, strict=False):
            out[group] -= basis @ (basis.T @ values[group])
        return out


def like(
    search: Search,
    material: Material,
    source: Term,
    key: str,
    options: dict[str, Any],
    parameters: Sequence[str],
) -> Term:
    """Return a term like another one with other options; everything of it is free."""
    given = {name: value for name, value in source.entry.effect.given.items() if name not in ("lag", "width")}
    wanted = {
        "effect": type(source.entry.effect).label(),
        "sensor": source.entry.sensor.name,
        **given,
        **options,
    }
    made = make_effect(
        wanted, sensors_of(material.mission, material.model.comparison), material.model.own, material.mission
    )
    size = sum(made.effect.parameters()[name].size for name in parameters)
    return Term(key, made, tuple(parameters), (np.inf,) * size)
