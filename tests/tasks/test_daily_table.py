"""The table of days' own fits, from stored equations."""

import numpy as np

from inflight.calibration import NormalEquations, empty_block, reference_of
from inflight.catalog import Workspace
from inflight.tasks.models import ideal_model
from inflight.tasks.pipelines.scalar.tables import daily_table
from inflight.time import day_bounds


def test_where_no_day_has_data_every_day_keeps_the_models_values(tiny_workspace):
    model, days = ideal_model(Workspace.open(tiny_workspace).mission()), ["2005-01-01", "2005-01-02"]
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
    np.testing.assert_allclose(table["value"].values, [[1, 1, 1, 90, 90, 90, 0, 0, 0]] * 2)
    assert not table["determined"].values.any()
