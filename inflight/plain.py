"""Samples as plain variables: what an effect reads of a Dataset, without the cost of its indexing."""

from __future__ import annotations

from typing import Any

import xarray as xr


class PlainSamples(dict[str, xr.Variable]):
    """Variables by name, with as much of a Dataset's interface as effects and sensor chains use."""

    @classmethod
    def of(cls, dataset: xr.Dataset) -> PlainSamples:
        """Return the variables of a Dataset."""
        return cls({str(name): variable for name, variable in dataset.variables.items()})

    @property
    def sizes(self) -> dict[str, int]:
        """Length of each dimension."""
        return {"time": int(self["tt2000"].size)}

    def assign(self, variables: dict[str, Any] | None = None, **more: Any) -> PlainSamples:
        """Return the samples with some variables added: (dims, values, attributes) each."""
        told = (variables or {}) | more
        return PlainSamples(self | {name: xr.Variable(*one) for name, one in told.items()})

    def drop_vars(self, names: list[str], errors: str = "raise") -> PlainSamples:
        """Return the samples without some variables."""
        return PlainSamples({name: variable for name, variable in self.items() if name not in names})
