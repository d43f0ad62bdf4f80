from .assignment import ASSIGNMENT, correction_by_states
from .candidates import Candidates, correction_by_both
from .change_points import Rows
from .correction import (
    WHOLE,
    AppliedPart,
    Correction,
    no_correction,
    omits_slow_part,
    part_of_day,
    part_variables,
    partial_correction,
)
from .geometry import Body
from .gradiometer import (
    FORMS,
    correction_by_stored_gradiometer,
    covariance_of_product,
    gradiometer_from_table,
    gradiometer_variables,
    has_gradiometer,
)
from .held_out import HeldOutDecision, decide
from .product import dual_level2, readings_of
from .readings import Readings
from .switching_steps import (
    JumpAttribution,
    NamedUnit,
    ResidualStep,
    Switchings,
    attribute_jumps,
    name_units,
    quiet_steps,
    quietest_width,
    regress_steps,
    residual_steps_by_state,
    rms,
    steps_across,
    switchings,
)
from .tracking import (
    Ageing,
    continue_training,
    standalone_training,
    training_from_dataset,
    training_to_dataset,
)
from .training import Training, train

__all__ = [
    "ASSIGNMENT",
    "FORMS",
    "WHOLE",
    "Ageing",
    "AppliedPart",
    "Body",
    "Candidates",
    "Correction",
    "HeldOutDecision",
    "JumpAttribution",
    "NamedUnit",
    "Readings",
    "ResidualStep",
    "Rows",
    "Switchings",
    "Training",
    "attribute_jumps",
    "continue_training",
    "correction_by_both",
    "correction_by_states",
    "correction_by_stored_gradiometer",
    "covariance_of_product",
    "decide",
    "dual_level2",
    "gradiometer_from_table",
    "gradiometer_variables",
    "has_gradiometer",
    "name_units",
    "no_correction",
    "omits_slow_part",
    "part_of_day",
    "part_variables",
    "partial_correction",
    "quiet_steps",
    "quietest_width",
    "readings_of",
    "regress_steps",
    "residual_steps_by_state",
    "rms",
    "standalone_training",
    "steps_across",
    "switchings",
    "train",
    "training_from_dataset",
    "training_to_dataset",
]
