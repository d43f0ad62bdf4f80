"""Every effect of the library keeps what model, fit and search rely on; the suite finds what does not."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from effect_cases import PLACES

from inflight import Effect, Mission, Parameter
from inflight.effects import EffectSource, check_effect, known_effects
from inflight.effects.base import best_field
from inflight.errors import ConformanceError

TEMPLATE = Path(__file__).parents[2] / "docs" / "templates" / "effect.py"
AXES = ("x", "y", "z")


@pytest.mark.parametrize("name", sorted(PLACES))
def test_an_effect_of_the_library_conforms(name):
    check_effect(known_effects()[name], options=PLACES[name][1] or None)


@pytest.mark.parametrize("name", ["channel_field", "channel_rate", "offset_step", "sun_direction_field"])
def test_every_candidate_of_an_effect_conforms(name):
    check_effect(known_effects()[name])


def test_a_solar_array_by_the_orbit_conforms():
    check_effect(known_effects()["solar_array"], options={"since": "2003-11-05"})


def test_the_template_conforms():
    spec = importlib.util.spec_from_file_location("effect_template", TEMPLATE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    kind = EffectSource(str(TEMPLATE), TEMPLATE.read_text()).classes()["heater_field"]
    assert kind.label() == module.HeaterField.label()
    check_effect(kind)
    check_effect(kind, options={"threshold": 15.0})


def test_the_channels_of_a_mission_of_ones_own_are_known():
    mission = Mission.parse(
        """
mission: own
instruments:
  v:
    role: vector
    cadence: 1 s
    files: &files {pattern: x, reader: cdf, time: t}
    channels: {field: {variable: b, unit: nT, axes: [x, y, z]}, valve: {variable: w, unit: mA, kind: current}}
  f: {role: scalar, cadence: 1 s, files: *files, channels: {field: {variable: g, unit: nT}}}
comparisons: {main: {kind: scalar, vector: v, scalar: f}}
"""
    )
    source = """
from inflight import Effect, Parameter

class Valve(Effect):
    \"\"\"Field of a valve: ``strength * current``.\"\"\"
    family = "current"
    channels = ("valve",)
    strength = Parameter("nT/A", ("x", "y", "z"), sigma=10.0)

    def field(self, samples, values, sensor):
        \"\"\"Return the field; (time, axis) nT.\"\"\"
        return self.channel(samples, "A")[:, None] * values["strength"]
"""
    kind = EffectSource("valve.py", source).classes()["valve"]
    check_effect(kind, mission)
    with pytest.raises(ConformanceError, match=r"'valve'.*pass the 'mission'"):
        check_effect(kind)


class Sound(Effect):
    """A field proportional to a current: ``strength * current``."""

    family = "current"
    channels = ("heater_current",)
    strength = Parameter("nT/A", AXES, sigma=10.0)

    def field(self, samples, values, sensor):
        """Return the field; (time, axis) nT."""
        return self.channel(samples, "A")[:, None] * values["strength"]


def test_a_sound_effect_conforms():
    check_effect(Sound)


class NoSource(Sound):
    """A field."""


class BadFamily(Sound):
    """``strength * current``."""

    family = "gremlins"


class BadParameter(Sound):
    """``strength * current``."""

    strength = Parameter("nT/A", AXES, sigma=10.0, step=0.0)


class BadUnit(Sound):
    """``strength * current``."""

    strength = Parameter("flurbs", AXES, sigma=10.0)


class WrongShape(Sound):
    """``strength * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return self.channel(samples, "A") * values["strength"][0]


class Undeclared(Sound):
    """``strength * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return samples["bus_voltage"].values[:, None] * values["strength"]


class NoUnits(Sound):
    """``strength * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return samples["heater_current"].values[:, None] * values["strength"]


class StatedUnitIgnored(Sound):
    """``strength * current``."""

    strength = Parameter("nT", AXES, sigma=10.0, per_channel=1)

    def field(self, samples, values, sensor):
        """Return the field."""
        return self.series(samples)[:, None] * values["strength"]


class NotNothing(Sound):
    """``strength * current + 1``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return super().field(samples, values, sensor) + 1.0


class Changing(Sound):
    """``strength * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        values["strength"][...] *= 2.0
        return super().field(samples, values, sensor)


class Still(Sound):
    """``0 * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return 0.0 * super().field(samples, values, sensor)


class FirstOrderInverse(Sound):
    """``(1 + strength) E``."""

    channels = ()
    acts_on = ("vector",)
    strength = Parameter("1", AXES, sigma=1e-3, step=1e-4)

    def correct(self, reading, samples, values, sensor):
        """Return the corrected reading."""
        return reading * (1.0 + values["strength"])

    def disturb(self, reading, samples, values, sensor):
        """Return the reading."""
        return reading * (1.0 - values["strength"])


class MadeOfReading(Sound):
    """``strength * B``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return (best_field(samples) + 0.0 * self.channel(samples, "A")[:, None]) * values["strength"]


class Bent(Sound):
    """``strength^3 * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return self.channel(samples, "A")[:, None] * values["strength"] ** 3


class FilledGaps(Sound):
    """``strength * current``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        return np.nan_to_num(super().field(samples, values, sensor))


class SpreadGaps(Sound):
    """``strength * (current - mean)``."""

    def field(self, samples, values, sensor):
        """Return the field."""
        current = self.channel(samples, "A")
        return (current - current.mean())[:, None] * values["strength"]


class Greedy(Sound):
    """``strength * current``."""

    def __init__(self, name="", **options):
        options.pop("no_such_option", None)
        super().__init__(name, **options)


class Forgetful(Sound):
    """``factor * strength * current``."""

    options = ("factor",)

    def prepare(self):
        """Read the factor."""
        self._factor = float(self.given.pop("factor", 1.0))

    def field(self, samples, values, sensor):
        """Return the field."""
        return self._factor * super().field(samples, values, sensor)


class Unpicklable(Sound):
    """``strength * current``."""

    def prepare(self):
        """Keep a function."""
        self._double = lambda x: 2.0 * x


class StrangeCandidate(Sound):
    """``strength * current``."""

    @classmethod
    def candidates(cls, mission):
        """Return a candidate."""
        return [{"threshold": 3.0}]


class AlwaysThere(Sound):
    """``strength * current``."""

    @classmethod
    def candidates(cls, mission):
        """Return a candidate."""
        return [{"channel": mission.instruments["housekeeping"].channels["nothing"]}]


FAULTY = {
    NoSource: "names no source",
    BadFamily: "family 'gremlins' is unknown",
    BadParameter: "'strength' has step 0.0",
    BadUnit: "'strength' has a unit that is none",
    WrongShape: "shape",
    Undeclared: "bus_voltage.*add it to 'channels'",
    NoUnits: "in A gives another field than in mA",
    StatedUnitIgnored: r"gives another field; read its channel by self.drive",
    NotNothing: "with its defaults it changes the reading",
    Changing: "the values are changed",
    Still: "it changes nothing",
    FirstOrderInverse: "must undo 'correct' exactly",
    MadeOfReading: "set follows_field = True",
    Bent: "'strength' is not linear",
    FilledGaps: "is missing .NaN. the correction is not",
    SpreadGaps: "changes samples more than 25 s away",
    Greedy: "an unknown option is taken",
    Unpicklable: "cannot be pickled",
    StrangeCandidate: "no option of the class",
    AlwaysThere: "offers candidates.*raised KeyError",
}


@pytest.mark.parametrize("kind", FAULTY, ids=lambda kind: kind.__name__)
def test_what_is_wrong_with_an_effect_is_said(kind):
    with pytest.raises(ConformanceError, match=FAULTY[kind]):
        check_effect(kind)


def test_an_option_that_is_lost_on_the_way_through_the_yaml_is_said():
    with pytest.raises(ConformanceError, match="survives the model yaml"):
        check_effect(Forgetful, options={"factor": 3.0})
