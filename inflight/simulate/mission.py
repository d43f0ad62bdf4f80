"""What every simulated mission has: settings, the numbers behind its effects, and the days it delivers."""

from __future__ import annotations

import datetime as dt
import json
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import xarray as xr
from pydantic import BaseModel, ConfigDict, Field, model_validator

from inflight.errors import SettingsError
from inflight.simulate.grid import Int64


@dataclass(frozen=True)
class SimulatedDay:
    """Deliveries and truth of one day; the function that simulates it documents their variables.

    Attributes
    ----------
    day : datetime64[D]
        UTC.
    instruments : dict of Dataset
        What each instrument delivers, along ``record``; ``Epoch`` is TT2000.
    truth : Dataset
        Undamaged, along ``record`` at the cadence of the magnetometers; attributes hold effects, hidden
        ones and parameters as JSON.
    """

    day: np.datetime64
    instruments: dict[str, xr.Dataset]
    truth: xr.Dataset


def delivery(stamps: Int64, **variables: np.ndarray) -> xr.Dataset:
    """Return variables (record,) or (record, component) along ``record``; ``Epoch`` holds the stamps."""
    named = {
        name: (("record", "quaternion" if values.shape[1:] == (4,) else "axis")[: values.ndim], values)
        for name, values in variables.items()
    }
    return xr.Dataset({"Epoch": ("record", stamps), **named})


@dataclass(frozen=True)
class MissionParameters:
    """Numbers behind the effects of a simulated mission; each kind of mission adds its own."""

    def changed(self, overrides: Mapping[str, Any]) -> Self:
        """Return the same with some numbers replaced.

        Raises
        ------
        SettingsError
            When there is no such number.
        ValueError
            When a value does not fit.
        """
        known = {one.name for one in fields(self)}
        if unknown := sorted(set(overrides) - known):
            raise SettingsError(
                f"no parameter {', '.join(map(repr, unknown))}",
                remedy=f"there are {', '.join(sorted(known))}",
            )
        return replace(self, **{name: self.check_override(name, given) for name, given in overrides.items()})

    def check_override(self, name: str, given: Any) -> Any:
        """Return a value in the form in which the number of that name is kept."""
        return tuple(given) if isinstance(given, list) else given

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers by name."""
        return asdict(self)


class MissionSettings(BaseModel):
    """A simulated mission; the same settings always give the same files.

    An effect named in `hide` is in the data, but only the truth names it. One named in `without`
    is not in the data at all, and one of `include` is added to the standard ones.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    #: Effects present unless removed, and those that must be requested: name -> what it is.
    standard_effects: ClassVar[Mapping[str, str]]
    extra_effects: ClassVar[Mapping[str, str]]

    start: dt.date
    #: Number of UTC days.
    days: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)] = 1
    hide: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    #: Values of `parameters` that differ from the usual ones, by name.
    overrides: dict[str, Any] = {}

    @model_validator(mode="after")
    def _known_names(self) -> Self:
        known = self.describe_effects()
        for key in ("hide", "without", "include"):
            if unknown := sorted(set(getattr(self, key)) - set(known)):
                raise ValueError(f"{key}: no effect {unknown}; there are {', '.join(known)}")
        if both := sorted(set(self.without) & {*self.hide, *self.include}):
            raise ValueError(f"{both} cannot be both in the data and without")
        # The numbers are made where they are read, so that an override that does not fit is refused here.
        _ = self.parameters
        return self

    @classmethod
    def describe_effects(cls) -> dict[str, str]:
        """Return effect name -> one line of description."""
        return {**cls.standard_effects, **cls.extra_effects}

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects present in the data."""
        return frozenset({*self.standard_effects, *self.include, *self.hide} - set(self.without))

    @property
    @abstractmethod
    def parameters(self) -> MissionParameters:
        """The numbers behind the effects."""

    def truth_attributes(self, day: np.datetime64) -> dict[str, str]:
        """Return the attributes of a day's truth: effects, hidden ones and parameters, each as JSON."""
        return {
            "day": str(day),
            "effects": json.dumps(sorted(self.effects)),
            "hidden": json.dumps(sorted(self.hide)),
            "parameters": json.dumps(self.parameters.as_dict()),
        }

    @property
    def day_list(self) -> list[np.datetime64]:
        """The UTC days asked for, datetime64[D]."""
        first = np.datetime64(self.start, "D")
        return [first + offset for offset in range(self.days)]
