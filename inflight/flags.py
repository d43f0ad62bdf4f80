"""The quality bitmask of samples and products: append-only, 0 means good.

A bit never changes its meaning; new ones are added at the end. Products write the mask with the
attributes `flag_masks` and `flag_meanings` (ISTP and CF conventions).
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
import numpy.typing as npt


class Flag(IntFlag):
    """What is wrong with, or was done to, one sample."""

    GOOD = 0
    #: The vector reading is missing or equals its fill value.
    VECTOR_MISSING = 1 << 0
    #: The scalar reading is missing or equals its fill value.
    SCALAR_MISSING = 1 << 1
    #: A housekeeping channel that the model uses is missing here.
    CHANNEL_MISSING = 1 << 2
    #: The sample lies inside an inserted leap second and carries the stamp of the second before it.
    LEAP_SECOND = 1 << 3
    #: The robust fit gave the sample less than half its weight.
    OUTLIER = 1 << 4
    #: The reading lies outside the range the mission YAML states.
    OUT_OF_RANGE = 1 << 5
    #: The delivered quality flag of the instrument marks the sample.
    INSTRUMENT_FLAG = 1 << 6
    #: No attitude: the field is given in sensor axes only.
    NO_ATTITUDE = 1 << 7
    #: The day's calibration kept at least one parameter at its prior.
    PRIOR_PARAMETERS = 1 << 8
    #: The time stamp was repaired (a clock that ran backwards or repeated itself).
    CLOCK_REPAIRED = 1 << 9
    #: No trustworthy phase of the spin: the field is given in turning axes only.
    NO_PHASE = 1 << 10
    #: The phase of the spin was carried over missing sun pulses.
    PHASE_BRIDGED = 1 << 11
    #: The sample lies where the phase of the spin jumps (then NO_PHASE, too), or a jump before or after
    #: it has shifted its phase or leaves it in doubt.
    PHASE_JUMP = 1 << 12
    #: The spacecraft is in a state that no training has seen: its stray field is not known from states.
    UNKNOWN_STATE = 1 << 13
    #: Two or more states fit about equally well, or the stretch is too short to decide.
    AMBIGUOUS_STATE = 1 << 14
    #: The sample lies in a passing disturbance or in the transition between two states.
    TRANSIENT = 1 << 15
    #: A flipper holds the sensors in the position that the day is not calibrated for.
    FLIPPED = 1 << 16
    #: The reading of a sensor lies at an end of the range the mission YAML states.
    SATURATED = 1 << 17
    #: Nothing is taken off the outboard reading of two sensors: no correction is known here, or the one that
    #: was learnt does not help.
    NOT_CORRECTED = 1 << 18
    #: An axis reads the very same for long while that of the boom's other sensor changes.
    STILL = 1 << 19
    #: The calibration was not learnt where the sample lies: outside the span of the table, where the
    #: uncertainty is wider, or in an eclipse of a spinning spacecraft, where it is not.
    EXTRAPOLATED = 1 << 20
    #: The mission YAML excludes the reading from every fit; it names author and reason.
    EXCLUDED = 1 << 21
    #: The vector instrument measured in another range than the one the table is for, or in one not known.
    OTHER_RANGE = 1 << 22


#: Flags that take a sample out of every fit.
UNUSABLE = Flag.VECTOR_MISSING | Flag.SCALAR_MISSING | Flag.CHANNEL_MISSING | Flag.OUT_OF_RANGE

UNUSABLE |= (
    Flag.INSTRUMENT_FLAG | Flag.FLIPPED | Flag.SATURATED | Flag.STILL | Flag.EXCLUDED | Flag.OTHER_RANGE
)


def flag_meanings() -> tuple[list[int], str]:
    """Return the masks and the space-separated meanings for product attributes."""
    bits = [bit for bit in Flag if bit]
    return [int(bit) for bit in bits], " ".join(str(bit.name).lower() for bit in bits)


def count_flags(flag: npt.NDArray[np.uint32]) -> str:
    """Say how many samples carry which flag: ``1200 scalar_missing, 30 outlier``; empty when none does."""
    counts = {bit: int(np.count_nonzero(flag & np.uint32(bit))) for bit in Flag if bit}
    return ", ".join(f"{count} {str(bit.name).lower()}" for bit, count in counts.items() if count)
