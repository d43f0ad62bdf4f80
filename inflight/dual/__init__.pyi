from .assignment import SURE, process
from .candidates import Candidates, correction_by_both
from .change_points import Places
from .correction import (
    WHOLE,
    Correction,
    Part,
    leaves_slow_alone,
    no_correction,
    part_of_day,
    part_variables,
    partly,
)
from .do_no_harm import Judgement, judge
from .geometry import Body
from .gradiometer import (
    FORMS,
    correction_by_gradiometer,
    gradiometer_of,
    gradiometer_variables,
    has_gradiometer,
    quadratic,
)
from .product import dual_level2, readings_of
from .readings import Readings
from .tracking import Ageing, alone, continued, from_dataset, to_dataset
from .training import Training, train
from .unrecorded import (
    NamedUnit,
    Remaining,
    Switched,
    Switchings,
    by_state,
    name_units,
    quiet_steps,
    quietest_width,
    regressed,
    rms,
    steps_across,
    switched,
    switchings,
)

__all__ = [
    "FORMS",
    "SURE",
    "WHOLE",
    "Ageing",
    "Body",
    "Candidates",
    "Correction",
    "Judgement",
    "NamedUnit",
    "Part",
    "Places",
    "Readings",
    "Remaining",
    "Switched",
    "Switchings",
    "Training",
    "alone",
    "by_state",
    "continued",
    "correction_by_both",
    "correction_by_gradiometer",
    "dual_level2",
    "from_dataset",
    "gradiometer_of",
    "gradiometer_variables",
    "has_gradiometer",
    "judge",
    "leaves_slow_alone",
    "name_units",
    "no_correction",
    "part_of_day",
    "part_variables",
    "partly",
    "process",
    "quadratic",
    "quiet_steps",
    "quietest_width",
    "readings_of",
    "regressed",
    "rms",
    "steps_across",
    "switched",
    "switchings",
    "to_dataset",
    "train",
]
