"""The table of days' own fits, from stored equations."""

import numpy as np

from inflight.calibration import NormalEquations, empty_block, reference_of
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.pipelines.scalar.tables import daily_table
from inflight.time import day_bounds

MISSION = Mission.parse(
    """
mission: daily
instruments:
  fgm:
    role: vector
    cadence: 40 s
    files: {pattern: "a", reader: table, time: t}
    channels: {field: {variables: [x, y, z], unit: nT}}
  ovm:
    role: scalar
    cadence: 40 s
    files: {pattern: "b", reader: table, time: t}
    channels: {field: {variable: f, unit: nT}}
comparisons: {main: {kind: scalar, vector: fgm, scalar: ovm}}
"""
)
MODEL = """
model: daily
mission: daily
comparison: main
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block, unit: "1", value: [1, 1, 1], sigma: [0.005, 0.005, 0.005]}
    misalignment: {time: block, unit: deg, value: [90, 90, 90], sigma: [0.5, 0.5, 0.5]}
    offset: {time: block, unit: nT, value: [1, 2, 3], sigma: [100, 100, 100]}
"""


def test_where_no_day_has_data_every_day_keeps_the_models_values():
    model, days = Model.parse(MODEL, MISSION), ["2005-01-01", "2005-01-02"]
    parts = []
    for start, end in map(day_bounds, days):
        prior = reference_of(model, start)
        one = NormalEquations.from_fit(empty_block(prior, prior), prior, (start, end), {"comparison": "main"})
        width = len(one.names)
        nothing = {name: ("block", np.zeros(1)) for name in ("used", "before", "after")}
        fit = {
            "fit": (("block", "column"), np.zeros((1, width))),
            "fit_covariance": (("block", "column", "other"), np.zeros((1, width, width))),
        }
        parts.append(NormalEquations(one.dataset.assign(nothing | fit)))
    table = daily_table(parts[0] + parts[1], model)
    assert table.sizes["interval"] == 2
    np.testing.assert_allclose(table["value"].values, [[1, 1, 1, 90, 90, 90, 1, 2, 3]] * 2)
    assert not table["determined"].values.any()
