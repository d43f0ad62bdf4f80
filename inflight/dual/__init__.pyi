from .assignment import ASSIGNMENT_SETTINGS, correction_by_states
from .candidates import Candidates, correction_by_states_and_gradiometer
from .change_points import Rows
from .correction import (
    WHOLE,
    AppliedPart,
    Correction,
    applied_part_to_dataset,
    no_correction,
    omits_slow_part,
    partial_correction,
    slow_part_of_day,
)
from .geometry import Body
from .gradiometer import (
    FORMS,
    correction_by_stored_gradiometer,
    covariance_of_product,
    gradiometer_from_dataset,
    gradiometer_to_dataset,
    has_gradiometer,
)
from .held_out import HeldOutDecision, choose_correction
from .product import dual_level2, readings_of
from .readings import Readings
from .switching_steps import (
    JumpAttribution,
    ResidualStep,
    Switchings,
    UnitChannels,
    attribute_jumps,
    match_channels_to_units,
    quiet_steps,
    quietest_width,
    regress_steps,
    residual_steps_by_state,
    rms_of_steps,
    steps_across,
    switchings,
)
from .tracking import (
    ContinuedTraining,
    continue_training,
    standalone_training,
    training_from_dataset,
    training_to_dataset,
)
from .training import Training, train

__all__ = [
    "ASSIGNMENT_SETTINGS",
    "FORMS",
    "WHOLE",
    "AppliedPart",
    "Body",
    "Candidates",
    "ContinuedTraining",
    "Correction",
    "HeldOutDecision",
    "JumpAttribution",
    "Readings",
    "ResidualStep",
    "Rows",
    "Switchings",
    "Training",
    "UnitChannels",
    "applied_part_to_dataset",
    "attribute_jumps",
    "choose_correction",
    "continue_training",
    "correction_by_states",
    "correction_by_states_and_gradiometer",
    "correction_by_stored_gradiometer",
    "covariance_of_product",
    "dual_level2",
    "gradiometer_from_dataset",
    "gradiometer_to_dataset",
    "has_gradiometer",
    "match_channels_to_units",
    "no_correction",
    "omits_slow_part",
    "partial_correction",
    "quiet_steps",
    "quietest_width",
    "readings_of",
    "regress_steps",
    "residual_steps_by_state",
    "rms_of_steps",
    "slow_part_of_day",
    "standalone_training",
    "steps_across",
    "switchings",
    "train",
    "training_from_dataset",
    "training_to_dataset",
]
