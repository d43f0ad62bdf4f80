"""The corrections that are tried on readings: gradiometers of every form, states, and both together."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.bands import gradiometer_correction
from inflight.dual.combined import combined_correction
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import FORMS, LEAK_SIGMA, Gradiometer, fit_forms
from inflight.dual.harm import Corrector
from inflight.dual.outboard import OutboardSteps, outboard_steps
from inflight.dual.processing import process
from inflight.dual.readings import Readings
from inflight.dual.segments import Segments, segments_of
from inflight.dual.states import States, find_states
from inflight.dual.training import Training, trained_from
from inflight.dual.units import Units, find_units
from inflight.errors import InflightError

#: A spacecraft that switches more often than this in one record has no states worth the name: a torquer
#: in pulses is the gradiometer's.
MOST_SEGMENTS = 150


class Candidates:
    """Fits every correction to some of the readings, and to all of them in the end.

    Jumps and states are told from the difference alone, once and for all readings: that uses nothing of the
    outboard readings that are held out. What a state adds to the outboard sensor is fitted anew each time.

    Parameters
    ----------
    readings : Readings
    positions, leak_sigma
        See `gradiometer.fit_forms`.
    """

    def __init__(
        self, readings: Readings, positions: Floats | None = None, leak_sigma: float = LEAK_SIGMA
    ) -> None:
        self.readings, self.positions, self.leak_sigma = readings, positions, leak_sigma

    def fit(self, use: npt.NDArray[np.bool_]) -> Mapping[str, Corrector]:
        """Fit to the rows in use; what cannot be fitted is left out.

        Returns
        -------
        dict
            By name: the forms of the gradiometer, ``states`` and ``combined``.
        """
        forms = [form for form in FORMS if form != "dipole" or self.positions is not None]
        try:
            gradiometers = fit_forms(self.readings.part(use), forms, self.positions, self.leak_sigma)
        except InflightError:
            return {}
        found: dict[str, Corrector] = {
            name: partial(gradiometer_correction, one) for name, one in gradiometers.items()
        }
        training = self._training(use)
        if training is not None:
            found["states"] = partial(process, training=training)
            found["combined"] = partial(_combined, training=training, gradiometer=gradiometers["matrix"])
        return found

    @cached_property
    def _states(self) -> tuple[Segments, States, Units, OutboardSteps] | None:
        segments = segments_of(self.readings)
        if not 2 <= np.count_nonzero(~segments.transient) <= MOST_SEGMENTS:
            return None
        states = find_states(segments)
        # A centre far outside of all differences is a clustering that has lost itself.
        reach = float(np.abs(self.readings.difference[self.readings.good]).max())
        if len(states) < 2 or float(np.abs(states.centre).max()) > 2.0 * reach:
            return None
        return segments, states, find_units(states), outboard_steps(self.readings, segments)

    def _training(self, use: npt.NDArray[np.bool_]) -> Training | None:
        """Return the training by the steps whose both sides are in use."""
        if self._states is None:
            return None
        segments, states, units, steps = self._states
        unused = np.concatenate([[0], np.cumsum(~use)])
        whole = unused[segments.last[steps.after]] == unused[segments.first[steps.before]]
        if not whole.any():
            return None
        kept = OutboardSteps(
            steps.before[whole], steps.after[whole], steps.step[whole], steps.covariance[whole]
        )
        return trained_from(segments, states, units, kept, None)


def _combined(readings: Readings, training: Training, gradiometer: Gradiometer) -> Correction:
    return combined_correction(readings, training, process(readings, training), gradiometer)
