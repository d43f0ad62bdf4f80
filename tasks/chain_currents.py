"""Sections of a chain's report on currents that step: superposed epochs, dipole, panels by local time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.layouts import column

from inflight.errors import SamplesError, SettingsError
from inflight.estimators.dipole import dipole_split
from inflight.estimators.epoch_fits import stack
from inflight.estimators.panels import against_local_time, choose_panels
from inflight.figures.epochs import local_time_figure, stack_figures
from inflight.figures.page import html_table
from inflight.tasks.chain_daily import node_times
from inflight.tasks.chain_results import ChainResults
from inflight.tasks.chain_sections import Part, matrix_table, with_error

_AXES = ("x", "y", "z")
#: Rough directions that are drawn apart.
_DIRECTIONS = ((-1, "drops"), (1, "rises"))


def current_steps(found: ChainResults) -> Part:
    """The field of the current that steps, from superposed epochs."""
    part = Part("current_steps", "Currents that step")
    table, epochs = found.tables.get("current-steps"), found.epochs
    if table is None or epochs is None:
        part.lack("Field of a current from its steps", found.why("current-steps"))
        return part
    names = [str(name) for name in table["current"].values]
    told = " and ".join(name.replace("_", " ") for name in names)
    value, sigma = table["value"].values, table["sigma"].values
    part.fields = {
        "currents": names,
        "epochs": int(table.attrs["epochs"]),
        "days": int(table.attrs["days"]),
        "value": value,
        "sigma": sigma,
        "determined": table["determined"].values,
        "unit": "nT/A",
        "at": "difference",
        "placebo": float(table.attrs["placebo"]),
    }
    count, days = table.attrs["epochs"], table.attrs["days"]
    part.say(
        f"{count} steps of the {told} on {days} days. The residual's own steps tell the field per ampere at "
        "the vector sensor less that at the scalar sensor; what follows the orbit does not enter. Where "
        f"nothing steps the same contrasts scatter by {table.attrs['placebo']:.2f} of their white noise."
    )
    part.text.append(matrix_table("nT/A, difference", names, _AXES, value, sigma))
    _confounding(part, table)
    part.attempt("Split into both sensors' fields", lambda: _split(part, found, table))
    for direction, name in _DIRECTIONS:
        chosen = epochs.isel(epoch=np.flatnonzero(np.sign(epochs["step"].values[:, 0]) == direction))
        if not chosen.sizes["epoch"]:
            part.lack(f"Mean curve of {name}", f"no epoch is one of {name}")
            continue
        part.attempt(f"Mean curve of {name}", lambda chosen=chosen: _stacked(part, chosen, value[0], told))  # type: ignore[misc]
    return part


def _confounding(part: Part, table: xr.Dataset) -> None:
    names = [str(name) for name in table["confounder"].values]
    numbers = zip(table["correlation"].values, table["slope"].values, strict=True)
    rows = [(name, float(one), float(slope)) for name, (one, slope) in zip(names, numbers, strict=True)]
    part.fields["confounding"] = [
        {"channel": name, "correlation": one, "slope": slope} for name, one, slope in rows
    ]
    if not rows:
        return
    cells = [(name, f"{one:+.3f}", f"{slope:+.3g}") for name, one, slope in rows]
    part.say("Channels that step with it: the coefficient holds their field times the last column.")
    part.text.append(html_table(("channel", "correlation of steps", "its step for 1 A"), cells))


def _split(part: Part, found: ChainResults, table: xr.Dataset) -> None:
    """Tell both sensors' shares where they stand on one line through the dipole."""
    entry = found.mission.comparisons[found.comparison]
    instruments = entry.instruments()
    places = [found.mission.instruments[instruments[role]].position for role in ("vector", "scalar")]
    if any(place is None for place in places):
        raise SettingsError("the mission does not say where both sensors stand", remedy="state 'position'")
    if table.sizes["current"] != 1:
        raise SettingsError("several currents were fitted together", remedy="fit one")
    made = dipole_split(
        table["value"].values[0],
        np.array(places[0], dtype=np.float64),
        np.array(places[1], dtype=np.float64),
        covariance=table["covariance"].values[0, :, 0, :],
    )
    part.fields["dipole"] = {
        "vector": made.vector,
        "sigma_vector": made.sigma_vector,
        "scalar": made.scalar,
        "sigma_scalar": made.sigma_scalar,
        "factors": list(made.factor),
    }
    part.say(
        f"If it is one dipole at the origin of the positions, the vector sensor has {made.factor[0]:.4f} of "
        f"the difference, the scalar sensor {made.factor[1]:.4f}."
    )
    rows = (made.vector, made.scalar), (made.sigma_vector, made.sigma_scalar)
    part.text.append(matrix_table("nT/A, dipole", ("vector sensor", "scalar sensor"), _AXES, *rows))


def _stacked(part: Part, epochs: xr.Dataset, value: np.ndarray, name: str) -> None:
    # Both share their axis of time, so they are one figure of the page.
    part.plots.append(column(*stack_figures(stack(epochs, value), name)))


def panels(found: ChainResults) -> Part:
    """How the solar current's field turns with local time, and which model of panels foretells it."""
    part = Part("panels", "Solar panels")
    epochs = found.epochs
    if epochs is None:
        part.lack("Field by local time", found.why("panels"))
        return part
    part.attempt("Choice of the panels' model", lambda: _choice(part, found, epochs))
    part.attempt("Field by local time", lambda: _by_local_time(part, epochs))
    return part


def _choice(part: Part, found: ChainResults, epochs: xr.Dataset) -> None:
    table = found.tables.get("panels")
    if table is None:
        raise SamplesError(found.why("panels"))
    names = [str(name) for name in table["model"].values]
    scores = {name: table[name].values for name in ("score", "behind", "behind_sigma", "ties")}
    chosen = str(table.attrs["chosen"])
    value, sigma = table["value"].values, table["sigma"].values
    sentence = str(table.attrs["sentence"]).replace("_", " ")
    part.fields |= {
        "chosen": chosen,
        "sentence": sentence,
        "value": value,
        "sigma": sigma,
        "unit": "nT/A",
        "models": [
            {"model": name, **{key: one[index].item() for key, one in scores.items()}}
            for index, name in enumerate(names)
        ],
    }
    part.say(f"{sentence}. Taken: {chosen.replace('_', ' ')}, the simplest that is as good.")
    cells = [
        (
            name.replace("_", " "),
            f"{scores['score'][index]:.4f}",
            "best" if index == 0 else with_error(scores["behind"][index], scores["behind_sigma"][index]),
            "yes" if scores["ties"][index] else "no",
        )
        for index, name in enumerate(names)
    ]
    head = ("model", "held-out square over variance", "behind the best", "as good")
    part.text.append(html_table(head, cells))
    rows = [chosen if len(value) == 1 else f"panel {index + 1}" for index in range(len(value))]
    part.text.append(matrix_table("nT/A, difference", rows, _AXES, value, sigma))


def _by_local_time(part: Part, epochs: xr.Dataset) -> None:
    local_time = node_times(epochs)
    if local_time is None:
        raise SamplesError(
            "epochs do not know the orbit's local time", remedy="give the mission the orbit's positions"
        )
    course = against_local_time(epochs, local_time)
    known = np.isfinite(course.value).all(axis=1)
    if known.sum() < 2:
        hours = np.nanmin(local_time), np.nanmax(local_time)
        raise SamplesError(
            f"the steps lie at {hours[0]:.1f} to {hours[1]:.1f} h of local time, in {int(known.sum())} of "
            f"{known.size} bins with days enough",
            remedy="a turn of local time takes 260.5 days",
        )
    part.fields["by_local_time"] = [
        {"local_time_h": hour, "value": value, "sigma": sigma, "epochs": int(count)}
        for hour, value, sigma, count in zip(
            course.local_time[known],
            course.value[known],
            course.sigma[known],
            course.epochs[known],
            strict=True,
        )
    ]
    part.plots.append(local_time_figure(course, choose_panels(epochs, local_time).chosen))
