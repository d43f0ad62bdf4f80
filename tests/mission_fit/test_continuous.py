"""The scalar chain, term by term: put into the simulation, found by the fit of all days, and in its model.

A mission is simulated twice with the same noise, with a term as it is and with more of it. By what was put in
the fits differ: in the term itself where nothing else looks like it, else in the sum that is told.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from ruamel.yaml import YAML

from inflight.lsq import marginalise
from inflight.mission import Mission
from inflight.mission_fit import MissionFit, fit_mission, free_terms, joint_cross_talk, with_nine_parameters
from inflight.mission_fit.daily_equations import wide_and_auxiliary_equations
from inflight.model import Model, rows_of
from inflight.simulate import Parameters, SimulationSettings, simulate_day
from inflight.simulate.stray import remanent_fields
from inflight.tasks.pipelines.mission_fit.day import equations_of_days
from inflight.time import SECOND, day_bounds

ROOT = Path(__file__).parents[2] / "missions"
MISSION = Mission.parse((ROOT / "champ.yaml").read_text(encoding="utf-8"))
CHAIN = (ROOT / "models" / "champ-chain.yaml").read_text(encoding="utf-8")
#: Six days at all local times.
DAYS = [np.datetime64("2005-01-01") + 43 * step for step in range(6)]
#: What is no part of the scalar chain, in the simulation and in the model; and what a constant cannot follow.
WITHOUT = ("ageing", "solar_array", "battery", "star_camera", "heater", "scalar_filter")
DROPPED = ("solar_array", "battery", "camera", "heater", "scalar_response")
MATRIX = ((8.785, -2.466, -2.238), (-0.402, -9.248, -0.199), (-0.163, 0.053, -11.368))

#: Changed settings by term, what of the fit tells it (with signs), and by how much that grows.
TERMS = {
    "time shift": ({"time_shift": Parameters().time_shift + 0.005}, {"time_shift.seconds": 1}, 0.005),
    "bias": ({"scalar_bias": 0.1}, {"scalar_bias.bias": 1}, 0.1),
    "heading": (
        {"heading": (0.022, -0.138, 0.035)},
        {"heading.vector[x]": 1, "remanent.vector[x]": 1, "vector_sensor.offset[x]": -1},
        0.2,
    ),
    "torquer": (
        {"torquer_scalar": MATRIX},
        {"torquer_ovm.matrix[xx]": 1, "torquer_fgm.matrix[xx]": -1},
        1.0,
    ),
    "multiplicative": (
        {"induced_first": (1.6e-5, -6.0e-6, -5.0e-6)},
        {
            "induced_first.diagonal[x]": 1,
            "induced_second.diagonal[x]": 1,
            "vector_sensor.scale_factor[x]": 1,
        },
        2e-6,
    ),
}
#: Changes of two values that no scalar calibration sees, with their signs.
UNSEEN = (
    {"heading.vector[x]": 1, "remanent.vector[x]": -1},
    {"remanent.vector[z]": 1, "vector_sensor.offset[z]": 1},
    {"heading.vector[y]": 1, "vector_sensor.offset[y]": 1},
    {"induced_first.diagonal[y]": 1, "induced_second.diagonal[y]": -1},
    {"induced_first.diagonal[z]": 1, "vector_sensor.scale_factor[z]": -1},
    {"torquer_ovm.matrix[zz]": 1, "torquer_fgm.matrix[zz]": 1},
)


def samples_of(day) -> xr.Dataset:
    """Samples as the archive aligns them, the coil's temperature with its lag."""
    fgm, ovm, tq = (day.instruments[name] for name in ("fgm", "ovm", "tq"))
    epoch = fgm["Epoch"].values
    late = np.interp(epoch - 100 * SECOND, epoch, fgm["T_CSC"].values)
    return xr.Dataset(
        {
            "vector": (("time", "axis"), fgm["FGM_RAW"].values, {"units": "nT"}),
            "scalar": ("time", ovm["F"].values, {"units": "nT"}),
            "coil_temperature": ("time", late, {"units": "degC"}),
            "torquer_current": (("time", "axis"), tq["I_TQ"].values, {"units": "mA"}),
            "frequency_ratio": ("time", ovm["F_OSC_RATIO"].values, {"units": "1"}),
            "flag": ("time", np.zeros(epoch.size, dtype=np.uint32)),
            "tt2000": ("time", epoch),
        }
    )


def model_of(*dropped: str) -> Model:
    model = Model.parse(CHAIN, MISSION)
    for name in (*DROPPED, *dropped):
        model = model.drop(name)
    return model


@cache
def fitted(term: str = "", dropped: str = "", equations: bool = False):
    """Fit six days with more of a term; without an effect of the model when one is named."""
    changes = TERMS[term][0] if term in TERMS else {"oscillator_offset": 6.2e-6} if term else {}
    if term == "remanent":
        changes = {"remanent_per_current": 14.2}
    include = ("scalar_bias",)
    settings = SimulationSettings(
        cadence=10,
        defects=(),
        without=WITHOUT,
        include=include,
        overrides={"scalar_bias": 0.0} | changes,
    )
    model, blocks = model_of(*filter(None, [dropped])), []
    for day in DAYS:
        made = simulate_day(settings, str(day))
        told = YAML(typ="safe").load(made.truth.attrs["nine_parameters"])
        nine = np.concatenate([np.ravel(one) for one in told.values()])
        attributes = {"comparison": "main", "model": "", "filter": "raw"}
        own, samples = with_nine_parameters(model, nine), samples_of(made)
        blocks.append(
            wide_and_auxiliary_equations(own, samples, rows_of(own, samples), day_bounds(day), attributes)[0]
        )
    whole, _ = equations_of_days(blocks)
    return (whole, model) if equations else fit_mission(whole, model, "constant")


def grown(term: str, signs: dict[str, int]) -> float:
    return sum(
        sign * (value_of(fitted(term), name) - value_of(fitted(), name)) for name, sign in signs.items()
    )


def value_of(found: MissionFit, name: str) -> float:
    return float(found.fit.value[found.fit.index(name)][0])


@pytest.mark.parametrize("term", TERMS)
def test_a_term_of_the_scalar_chain_comes_back(term):
    _, signs, size = TERMS[term]
    assert grown(term, signs) == pytest.approx(size, rel=0.03)


def test_the_remanent_field_comes_back_as_the_difference_of_both_sensors():
    signs = {"remanent.vector[y]": 1, "heading.vector[y]": 1, "vector_sensor.offset[y]": -1}
    at = np.array([day_bounds(day)[0] / SECOND + 43200 for day in DAYS])
    whole, usual = (
        np.mean(scalar - vector, axis=0)
        for vector, scalar in (
            remanent_fields(at, Parameters().changed({"remanent_per_current": size}))
            for size in (14.2, Parameters().remanent_per_current)
        )
    )
    assert grown("remanent", signs) == pytest.approx((whole - usual)[1], rel=0.05)


def test_the_oscillator_is_corrected_by_its_measured_frequency_and_else_goes_into_the_scale_factors():
    assert grown("oscillator", {"vector_sensor.scale_factor[z]": 1}) == pytest.approx(0.0, abs=2e-8)
    pair = [
        value_of(fitted(term, "oscillator"), "vector_sensor.scale_factor[z]") for term in ("oscillator", "")
    ]
    assert pair[0] - pair[1] == pytest.approx(-5e-6, rel=0.03)


@pytest.mark.parametrize("pair", UNSEEN, ids=" and ".join)
def test_what_cannot_be_told_apart_says_so_in_the_covariance(pair):
    equations, model = fitted("", "", True)
    fit, sigma = fitted().fit, dict(zip(equations.columns, priors(model), strict=True))
    data, places = equations.dataset, [equations.columns.index(name) for name in pair]
    direction = np.array(list(pair.values())) / data["scale"].values[places]
    others = np.setdiff1d(np.arange(len(equations.columns)), places)
    beside = marginalise(data["gram"].values.sum(axis=0)[:-1, :-1], others, np.array(places))
    told = direction @ beside @ direction / fit.rms**2
    tighter = min(pair, key=lambda name: sigma[name])
    # Of the change itself, all others free, the data know next to nothing ...
    assert told * sigma[tighter] ** 2 < 0.1
    # ... so that what was known best is known no better, and is said not to be determined.
    assert fit.sigma[fit.index(tighter)][0] > 0.9 * sigma[tighter]
    assert not fit.determined[fit.index(tighter)][0]


def test_offset_and_remanent_field_go_together_in_the_covariance():
    equations, model = fitted("", "", True)
    related = joint_cross_talk(equations, {}, model)["correlation"]
    assert float(related.sel(ignored="remanent.vector[z]", parameter="vector_sensor.offset[z]")) > 0.9


def priors(model: Model) -> list[float]:
    return [one for term in free_terms(model) for one in term.sigma]


def test_every_term_of_the_scalar_chain_is_in_the_fitted_model():
    found = fitted("time shift")
    again = Model.parse(found.model.text, MISSION)
    names = {
        "time_shift",
        "scalar_bias",
        "torquer_ovm",
        "heading",
        "remanent",
        "induced_first",
        "induced_second",
    }
    held = {entry.name: entry for entry in again.effects}
    assert names | {"oscillator"} <= set(held)
    for name in names:
        for value in held[name].parameters.values():
            for column, one, sigma in zip(value.columns, value.value[:, 0], value.sigma[:, 0], strict=True):
                assert one == pytest.approx(value_of(found, column), rel=1e-6), column
                assert sigma == pytest.approx(float(found.fit.sigma[found.fit.index(column)][0]), rel=1e-6)
