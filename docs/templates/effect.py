"""An effect to copy: the field of a heater that leaks while it is cold.

Copy this file into the folder ``effects`` of your workspace, name it in the mission YAML
(``effects: [effects/heater.py]``), rename the class and change what it does. Then run it:
``python effects/heater.py``. It says nothing when the effect keeps what the product relies on, and what
to mend when it does not.
"""

import numpy as np

from inflight import Effect, Parameter
from inflight.effects import check_effect


class HeaterField(Effect):
    """Field of a heater below a temperature: ``strength * current`` where ``temperature < threshold``.

    Give the formula as above, or the publication and equation it is taken from.
    """

    #: The cause a search reports: one of `inflight.effects.families.FAMILIES`.
    family = "current"
    #: Roles of the sensors it makes sense at.
    acts_on = ("vector", "inboard", "outboard", "scalar")
    #: Names of channels in the mission YAML, in the order `self.channel(samples, unit, index)` counts them.
    channels = ("heater_current", "boom_temperature")
    #: Keys of the model's entry beside the parameters.
    options = ("threshold",)
    #: A number to be fitted: unit, components, what is known of it beforehand, and its typical size.
    strength = Parameter("nT/A", axes=("x", "y", "z"), sigma=20.0, step=1.0)

    def prepare(self):
        """Read the options; called once, when the effect is made."""
        self._threshold = float(self.given.get("threshold", 10.0))  # degC

    def field(self, samples, values, sensor):
        """Return what the heater adds at `sensor`; (time, axis) nT, axes of the vector sensor."""
        current = self.channel(samples, "A")
        temperature = self.channel(samples, "degC", 1)
        # A comparison with NaN is False: a missing temperature must give a missing field.
        cold = np.where(np.isnan(temperature), np.nan, temperature < self._threshold)
        return (current * cold)[:, None] * values["strength"]

    @classmethod
    def candidates(cls, mission):
        """Return the options a search for a missing effect should try: here, as it stands."""
        named = {name for _, name, _ in mission.channel_instruments()}
        return [{}] if set(cls.channels) <= named else []


if __name__ == "__main__":
    # With channels of your own: check_effect(HeaterField, Mission.parse(Path("mission.yaml").read_text()))
    check_effect(HeaterField)
