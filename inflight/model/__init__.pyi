from .apply import (
    ModelEffect,
    at_all_sensors,
    correct_plain,
    delay_number,
    instrument_variance,
    number_fields,
    place_variance,
    table_variance,
)
from .diff import changes, parse_tree
from .model import Model, make_effect, with_dipole
from .rows import (
    REFERENCE,
    Band,
    ResidualDefinition,
    ResidualRows,
    RowFilter,
    filter_rows,
    folding_of,
    rows_of,
    spin_residual,
)
from .substitution import EffectSubstitution, SubstitutedSamples, TypicalValue, missing_rows, substitute
from .time_dependence import TimeDependence, TimedValue, component_names

__all__ = [
    "REFERENCE",
    "Band",
    "EffectSubstitution",
    "Model",
    "ModelEffect",
    "ResidualDefinition",
    "ResidualRows",
    "RowFilter",
    "SubstitutedSamples",
    "TimeDependence",
    "TimedValue",
    "TypicalValue",
    "at_all_sensors",
    "changes",
    "component_names",
    "correct_plain",
    "delay_number",
    "filter_rows",
    "folding_of",
    "instrument_variance",
    "make_effect",
    "missing_rows",
    "number_fields",
    "parse_tree",
    "place_variance",
    "rows_of",
    "spin_residual",
    "substitute",
    "table_variance",
    "with_dipole",
]
