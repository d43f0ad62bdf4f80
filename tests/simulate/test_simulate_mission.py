"""The shipped mission and pre-flight model fit the simulated files, and two physics agree.

The simulator and the model were written apart: where the model with the true numbers corrects the
simulated readings down to their noise, both are right or both are wrong in the same way.
"""

from pathlib import Path

import cdflib
import numpy as np
import pytest
import xarray as xr
from ruamel.yaml import YAML

from inflight.mission import Mission
from inflight.model import Model
from inflight.simulate import Parameters, SimulationSettings, simulate_day
from inflight.simulate.stray import remanent_fields
from inflight.tasks.archive import simulate

MISSIONS = Path(__file__).parents[2] / "missions"
#: Recorded currents that no pre-flight effect describes.
UNDESCRIBED = ("solar_array", "battery", "star_camera", "heater")


@pytest.fixture(scope="module")
def mission():
    return Mission.parse((MISSIONS / "champ.yaml").read_text(), "champ.yaml")


@pytest.fixture(scope="module")
def preflight(mission):
    return YAML(typ="safe").load((MISSIONS / mission.preflight).read_text())


def samples_of(day):
    """Samples on the common stamps; the coil temperature with the lag of the mission YAML."""
    fgm, ovm, tq = (day.instruments[name] for name in ("fgm", "ovm", "tq"))
    epoch = fgm["Epoch"].values
    late = np.interp(epoch - 100 * 10**9, epoch, fgm["T_CSC"].values)
    return xr.Dataset(
        {
            "vector": (("time", "axis"), fgm["FGM_RAW"].values, {"units": "nT"}),
            "scalar": ("time", ovm["F"].values, {"units": "nT"}),
            "coil_temperature": ("time", late, {"units": "degC"}),
            "torquer_current": (("time", "axis"), tq["I_TQ"].values, {"units": "mA"}),
            "frequency_ratio": ("time", ovm["F_OSC_RATIO"].values, {"units": "1"}),
            "tt2000": ("time", epoch),
        }
    )


def with_truth(tree, day):
    """The pre-flight model with true values in place of those of the ground tests."""
    p = Parameters()
    seconds = day.truth["Epoch"].values[43200:43201] / 1e9
    at_vector, at_scalar = (field[0] for field in remanent_fields(seconds, p))
    scale = YAML(typ="safe").load(day.truth.attrs["nine_parameters"])
    values = {
        "nonlinearity": {
            "quadratic": np.array(p.quadratic) / scale["scale_factor"],
            "cubic": np.array(p.cubic) / scale["scale_factor"],
            "about": p.offset,
        },
        "temperature": {"linear": p.temperature_linear, "about": p.offset},
        "vector_sensor": scale,
        "torquer_fgm": {"matrix": np.ravel(p.torquer_vector)},
        "torquer_ovm": {"matrix": np.ravel(p.torquer_scalar)},
        "time_shift": {"seconds": p.time_shift},
        "remanent": {"vector": at_scalar},
    }
    for entry in tree["effects"]:
        for key, value in values.get(entry.get("name", entry["effect"]), {}).items():
            entry[key]["value"] = np.asarray(value, dtype=float).tolist()
    tree["effects"].append(
        {
            "effect": "remanent",
            "name": "remanent_fgm",
            "sensor": "fgm",
            "vector": {"value": at_vector.tolist()},
        }
    )
    return tree


def as_model(tree, mission, tmp_path):
    path = tmp_path / "model.yaml"
    with path.open("w") as stream:
        YAML().dump(tree, stream)
    return Model.parse(path.read_text(), mission, "model.yaml")


@pytest.mark.parametrize(("name", "second"), [("champ", False), ("champ-two-fluxgates", True)])
def test_every_channel_of_the_mission_is_in_the_files_with_its_unit(name, second, tmp_path):
    mission = Mission.parse((MISSIONS / f"{name}.yaml").read_text(), name)
    wanted = SimulationSettings(days=1, cadence=10, second_fluxgate=second)
    simulate(wanted, tmp_path, workers=1)
    for name, instrument in mission.instruments.items():
        (pattern,) = mission.files(name).pattern
        (path,) = tmp_path.glob(pattern.replace("{day:%Y%m%d}", "20050101"))
        file = cdflib.CDF(path)
        for channel in instrument.channels.values():
            values = file.varget(channel.variable)
            assert values.shape[1:] == ((len(channel.axis_names),) if channel.axis_names else ())
            unit = file.varattsget(channel.variable)["UNITS"].strip() or "1"
            assert unit == channel.unit


def test_preflight_model_leaves_the_ageing_of_years(mission):
    text = (MISSIONS / mission.preflight).read_text()
    model = Model.parse(text, mission, mission.preflight)
    residual = model.residual(samples_of(simulate_day(SimulationSettings(defects=()), "2005-01-01")))[:, 0]
    assert 20.0 < -np.nanmean(residual) < 60.0
    assert 5.0 < np.nanstd(residual) < 20.0


def test_model_with_the_truth_corrects_to_the_noise(mission, preflight, tmp_path):
    wanted = SimulationSettings(defects=(), without=UNDESCRIBED)
    day = simulate_day(wanted, "2005-01-01")
    model = as_model(with_truth(preflight, day), mission, tmp_path)
    residual = model.residual(samples_of(day))[2:-2, 0]
    assert residual.std() == pytest.approx(np.hypot(wanted.vector_noise, wanted.scalar_noise), rel=0.03)
    assert abs(residual.mean()) < 0.02
    field = model.correct(samples_of(day))["field"].values
    assert np.abs((field - day.truth["FIELD"].values).mean(axis=0)).max() < 0.01
