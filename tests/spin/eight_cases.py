"""Records of a disturbed sensor, and the fits of them, that several tests of the eight parameters share."""

import numpy as np
from orbit_fields import Record, steady

from inflight.spin import CalibrationParameters, calibrate_by_selection, cut_into_blocks, estimate_jointly

TRUTH = CalibrationParameters(
    1.0003, 1.0, 1.0, (1e-3, -2e-3), 5e-4, (1.2e-3, -0.8e-3), 0.0, (1.0, -2.0, 3.0)
)  # fmt: skip
#: The spin tells nothing of the third offset, but its part in the spin plane is seen: it is given.
PRESENT = CalibrationParameters(offset=(0.0, 0.0, 3.0))


def signed(seed):
    """The truth with signs of its own."""
    sign = np.random.default_rng(1000 + seed).choice([-1, 1], 12)
    values = PRESENT.values() + sign * (TRUTH.values() - PRESENT.values())
    return CalibrationParameters.from_values(values)


def axis_angles(matrix):
    """Angles of the sensor axes from the spin axis and in the spin plane, and gains, of a coupling matrix."""
    rows = np.linalg.inv(matrix)
    length = np.linalg.norm(rows, axis=1)
    unit = rows / length[:, None]
    return np.arccos(unit[:, 2]), np.arctan2(unit[:, 1], unit[:, 0]), 1.0 / length


def joined(first, second):
    """One record after another, the phase going on."""
    step = int(np.median(np.diff(first.stamps)))
    stamps = np.concatenate([first.stamps, second.stamps - second.stamps[0] + first.stamps[-1] + step])
    # Whole turns, so that the second field need not be turned.
    turns = np.ceil((first.phase[-1] - second.phase[0]) / (2 * np.pi))
    phase = np.concatenate([first.phase, second.phase + 2 * np.pi * turns])
    parts = [
        np.concatenate([getattr(one, name) for one in (first, second)])
        for name in ("field", "region", "distance")
    ]
    return Record(stamps, phase, *[parts[0], parts[1], parts[2]])


def two_fields(seed, hours=1.5):
    """Solar wind of 30 nT, then 1000 nT along the spin axis."""
    low = steady(seed, hours=hours, mean=(25.0, 10.0, 10.0))
    high = steady(seed + 500, hours=hours, mean=(300.0, 50.0, 1000.0), density=0.01)
    # Cut at a whole number of spins of both.
    return joined(low, high)


def by_joint(record, readings, present=PRESENT, **options):
    layout = cut_into_blocks(readings, record.phase, record.stamps, **options)
    return estimate_jointly(readings, record.phase, record.stamps, layout, present)


def by_selection(record, readings, present=PRESENT, **options):
    layout = cut_into_blocks(readings, record.phase, record.stamps)
    return calibrate_by_selection(readings, record.phase, record.stamps, layout, present, **options)
