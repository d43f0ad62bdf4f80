"""Which of a library's columns may change in time."""

from __future__ import annotations

from inflight.diagnosis.changes import Carriers
from inflight.diagnosis.library import Library
from inflight.effects.scalar_sensor import ScalarBias, TimeShift
from inflight.effects.vector_sensor import Affine, VectorSensor


def carriers_of(library: Library) -> Carriers:
    """Return the library's columns that may change in time."""

    def columns(kind: type, parameter: str) -> tuple[str, ...]:
        for term in library.all_terms:
            if isinstance(term.entry.effect, kind) and parameter in term.parameters:
                return tuple(name for name in term.columns if f".{parameter}" in name)
        return ()

    return Carriers(
        offset=columns(VectorSensor, "offset") or columns(Affine, "shift"),
        scale=columns(VectorSensor, "scale_factor"),
        clock=columns(TimeShift, "seconds"),
        bias=columns(ScalarBias, "bias"),
        angle=columns(VectorSensor, "misalignment"),
    )
