"""Candidates: the corrections that are tried on readings, and the one by states and gradiometer together.

Takes readings; makes the correctors by name that `held_out.choose_correction` scores: gradiometers of every
form, ``states``, and ``combined``.

The combined correction takes the field of a state where the state is known, and the gradiometer for what the
difference does in addition, such as a current that follows the load; while the state is not known it takes
everything. A state's field at the outboard sensor is estimated twice: by the outboard steps of its own units,
each with what the ambient field did at that moment, and by the gradiometer's matrix, which all units have
fitted together but which is not quite that of any of them. Both are averaged by their covariances.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.assignment import correction_by_states
from inflight.dual.correction import Correction
from inflight.dual.geometry import Body, matrices_near_inboard, matrices_of_any_boom
from inflight.dual.gradiometer import (
    FORMS,
    GRADIOMETER_SETTINGS,
    Gradiometer,
    correction_by_gradiometer,
    covariance_of_product,
    fit_forms,
    wiener_shrink,
)
from inflight.dual.held_out import Corrector, GeometryPrior
from inflight.dual.mixing import DifferenceNoise
from inflight.dual.readings import Readings
from inflight.dual.segments import Segments, segments_of
from inflight.dual.states import States, Units, find_states, find_units
from inflight.dual.training import (
    OutboardSteps,
    Training,
    empty_training,
    levels_of,
    outboard_steps,
    training_from_steps,
)
from inflight.errors import InflightError


@dataclass(frozen=True, kw_only=True)
class CandidateSettings:
    """Numbers that decide whether states are searched for.

    Attributes
    ----------
    most_segments : int
        With more segments than this in a record a spacecraft has no states, unless each is long. Assumed: a
        torquer in pulses is the gradiometer's.
    usual_dwell : int
        Samples of a segment, in the mean, from which more are allowed. Assumed.
    bearable_segments : int
        With more segments than this states are never searched for. Assumed, for speed: more take minutes.
    centre_reach : float
        A state's centre farther out than so many times the largest difference shows that the clustering
        failed. Assumed.
    """

    most_segments: int = 150
    usual_dwell: int = 120
    bearable_segments: int = 10_000
    centre_reach: float = 2.0


CANDIDATE_SETTINGS = CandidateSettings()


class Candidates:
    """Fits every correction to some of the readings, and to all of them in the end.

    Jumps and states are found in the difference alone, once and for all readings: that uses nothing of the
    outboard readings that are held out. What a state adds to the outboard sensor is fitted anew each time.

    Parameters
    ----------
    readings : Readings
    body, leak_sigma
        See `gradiometer.fit_forms`.
    ambient : ndarray, shape (time, axis), optional
        See `training.train`; NaN everywhere is the same as none.
    """

    def __init__(
        self,
        readings: Readings,
        body: Body | None = None,
        leak_sigma: float = GRADIOMETER_SETTINGS.leak_sigma,
        ambient: Floats | None = None,
    ) -> None:
        self.readings, self.ambient = readings, ambient
        self.body, self.leak_sigma = body, leak_sigma

    def fit(self, use: npt.NDArray[np.bool_]) -> Mapping[str, Corrector]:
        """Fit to the rows in use (time,); what cannot be fitted is missing.

        Returns
        -------
        dict
            By name: the forms of the gradiometer, ``states`` and ``combined``.
        """
        whole = bool(use.all())
        gradiometers = self.gradiometers if whole else self._gradiometers(use)
        if not gradiometers:
            return {}
        found: dict[str, Corrector] = {
            form: partial(correction_by_gradiometer, gradiometer)
            for form, gradiometer in gradiometers.items()
        }
        training = self.training if whole else self._training(use)
        if training is not None and len(training) > 1:
            found["states"] = partial(correction_by_states, training=training)
            found["combined"] = partial(
                correction_by_states_and_gradiometer, training=training, gradiometer=gradiometers["matrix"]
            )
        return found

    @cached_property
    def gradiometers(self) -> Mapping[str, Gradiometer]:
        """By form, fitted to all readings; empty where there are too few."""
        return self._gradiometers(np.ones(len(self.readings), dtype=bool))

    @cached_property
    def priors(self) -> list[GeometryPrior]:
        """Priors by geometry: of the body and of all around it, or of any boom; the likelier first."""
        full = self.gradiometers.get("matrix")
        if full is None:
            return []
        stray = full.stray(self.readings)
        noise = DifferenceNoise(full.noise, full.mixing.share, 0.0)
        nearer = "units nearer to the inboard sensor"
        if self.body is None:
            places = {nearer: matrices_of_any_boom()}
        else:
            places = {"all units in the body": self.body.matrices, nearer: matrices_near_inboard(self.body)}
        return [
            GeometryPrior(
                readings=self.readings,
                matrices=matrices,
                stray=stray,
                noise=noise,
                leak_covariance=full.mixing.leak_covariance,
                units=units,
            )
            for units, matrices in places.items()
        ]

    @cached_property
    def training(self) -> Training:
        """States learnt from all readings; one or none where these show no more."""
        training = self._training(np.ones(len(self.readings), dtype=bool))
        if training is not None:
            return training
        reason = self._no_states_reason or "the stretches between jumps do not form states"
        return empty_training(self.readings, reason)

    def _gradiometers(self, use: npt.NDArray[np.bool_]) -> Mapping[str, Gradiometer]:
        if self.readings.defect:
            return {}
        forms = [form for form in FORMS if form != "dipole" or self.body is not None]
        try:
            return fit_forms(self.readings.select(use), forms, self.body, self.leak_sigma)
        except InflightError:
            return {}

    @cached_property
    def _segments(self) -> Segments | None:
        return segments_of(self.readings) if self.readings.good.any() else None

    @property
    def _no_states_reason(self) -> str:
        """Why no states are searched for; empty where they are."""
        if self.readings.defect:
            return self.readings.defect
        steady = 0 if self._segments is None else int(np.count_nonzero(~self._segments.transient))
        if not steady:
            return "no stretch is long enough for a state"
        most = max(CANDIDATE_SETTINGS.most_segments, len(self.readings) // CANDIDATE_SETTINGS.usual_dwell)
        most = min(most, CANDIDATE_SETTINGS.bearable_segments)
        if steady > most:
            return f"{steady} stretches without a jump, more than {most}: too many for states"
        return ""

    @cached_property
    def _states(self) -> tuple[Segments, States, Units, OutboardSteps] | None:
        if self._no_states_reason or self._segments is None:
            return None
        states = find_states(self._segments)
        # A centre far outside of all differences shows that the clustering failed.
        reach = float(np.abs(self.readings.difference[self.readings.good]).max())
        if float(np.abs(states.centre).max(initial=0.0)) > CANDIDATE_SETTINGS.centre_reach * reach:
            return None
        return self._segments, states, find_units(states), outboard_steps(self.readings, self._segments)

    def _training(self, use: npt.NDArray[np.bool_]) -> Training | None:
        """Return the training by the steps whose both sides are in use."""
        if self._states is None:
            return None
        segments, states, units, steps = self._states
        unused = np.concatenate([[0], np.cumsum(~use)])
        whole = unused[segments.last[steps.after]] == unused[segments.first[steps.before]]
        levels = None
        if self.ambient is not None:
            ambient = np.where(use[:, None], self.ambient, np.nan)
            if (self.readings.good & np.isfinite(ambient).all(axis=1)).any():
                levels = levels_of(self.readings, segments, ambient)
        if not whole.any() and levels is None and len(states) > 1:
            return None
        kept = OutboardSteps(
            steps.before[whole], steps.after[whole], steps.step[whole], steps.covariance[whole]
        )
        return training_from_steps(segments, states, units, kept, levels)


def correction_by_states_and_gradiometer(
    readings: Readings, training: Training, gradiometer: Gradiometer
) -> Correction:
    """Return the correction by states and gradiometer together, the states found in the readings."""
    return combined_correction(readings, training, correction_by_states(readings, training), gradiometer)


def combined_correction(
    readings: Readings, training: Training, states: Correction, gradiometer: Gradiometer
) -> Correction:
    """Return the correction of both methods together.

    Parameters
    ----------
    readings : Readings
    training : Training
        The states with their places in the difference and their outboard fields.
    states : Correction
        By states, of these readings and from this training: which state each sample is in.
    gradiometer : Gradiometer

    Returns
    -------
    Correction
        Relative to the training's reference state, unless the constant part is known.
    """
    good = readings.good
    field = np.full((len(readings), 3), np.nan)
    covariance = np.full((len(readings), 3, 3), np.nan)
    if good.any():
        value, spread = state_fields(training, gradiometer)
        place = state_rows(training, states.state)[good]
        stray = gradiometer.stray(readings)[good]
        # What leaks of the mean ambient field is as constant as an offset.
        stray += np.median(readings.difference[good] - stray, axis=0)
        base, reference = _reference(training)
        here = np.where(place[:, None] >= 0, training.centre[place], base)
        kept, variance = wiener_shrink(stray - here, gradiometer.noise)
        matrix = gradiometer.matrix
        field[good] = np.where(place[:, None] >= 0, value[place], reference) + kept @ matrix.T
        noise = matrix @ gradiometer.noise @ matrix.T
        error = variance[:, None, None] * noise + covariance_of_product(gradiometer.covariance, kept)
        covariance[good] = error + np.where(place[:, None, None] >= 0, spread[place], 0.0)
    return Correction(
        field=field,
        covariance=covariance,
        state=states.state,
        probability=states.probability,
        flag=states.flag,
        method="combined",
        reason="states, and the gradiometer for what is left",
        constant_known=training.constant_known,
    )


def state_fields(training: Training, gradiometer: Gradiometer) -> tuple[Floats, Floats]:
    """Return the outboard field of each state, the mean of both methods by their covariances.

    Returns
    -------
    value : ndarray, shape (state, axis)
        nT.
    covariance : ndarray, shape (state, axis, axis)
        nT^2.
    """
    base, reference = _reference(training)
    away = training.centre - base
    matrix = gradiometer.matrix
    noise = matrix @ (gradiometer.noise + training.scatter**2 * np.eye(3)) @ matrix.T
    count = np.maximum(training.segments, 1)[:, None, None]
    scaled = reference + away @ matrix.T
    spread = covariance_of_product(gradiometer.covariance, away) + noise / count
    total = spread + training.covariance
    gain = np.einsum("sij,sjk->sik", spread, np.linalg.pinv(total, hermitian=True))
    value = scaled + np.einsum("sij,sj->si", gain, training.correction - scaled)
    covariance = spread - gain @ spread
    at_zero = training.number == training.reference
    # Zero by definition, whatever the matrix.
    value[at_zero], covariance[at_zero] = training.correction[at_zero], training.covariance[at_zero]
    return value, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def state_rows(training: Training, state: np.ndarray) -> np.ndarray:
    """Return the row of the training's tables of each state's number; -1 where it is unknown."""
    order = np.argsort(training.number)
    found = np.clip(np.searchsorted(training.number[order], state), 0, max(len(training) - 1, 0))
    place = order[found]
    return np.asarray(np.where(training.number[place] == state, place, -1))


def _reference(training: Training) -> tuple[Floats, Floats]:
    """Return difference and outboard field of the state that the others are relative to."""
    own = int(np.argmax(training.seconds))
    if training.reference >= 0:
        own = int(np.flatnonzero(training.number == training.reference)[0])
    return training.centre[own], training.correction[own]
