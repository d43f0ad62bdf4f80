"""Zero levels of real fields through the pipeline: told where nature tells them, and not elsewhere."""

import numpy as np
import pytest
from injections import REAL, ROOT

from inflight.catalog import Catalog, Workspace
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import ReprocessSettings, reprocess

#: Folder of the measurements, comparison, axes that are told.
CASES = {
    "ace": ("ace-mfi-h0-20230102", "{kind: zero_level, vector: mag}", "xyz"),
    "goes16": (
        "goes16-mag-ib-ob",
        "{kind: zero_level, vector: outboard, interval: 60 s, average: 2 s}",
        "",
    ),
}


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize("name", list(CASES))
def test_a_day_of_wind_tells_its_zero_level_and_a_quiet_magnetosphere_none(name, tmp_path):
    folder, comparison, told = CASES[name]
    if not (REAL / folder).is_dir():
        pytest.skip(f"real measurements are absent: {REAL / folder}")
    text = (ROOT / "missions" / f"{name}.yaml").read_text(encoding="utf-8")
    source = tmp_path / "mission.yaml"
    source.write_text(text.replace("\ncomparisons:\n", f"\ncomparisons:\n  zero: {comparison}\n"), "utf-8")
    made = Workspace.create(tmp_path / "w", source)
    cat, mission = Catalog(made.root), made.mission()
    ingest(cat, mission, REAL / folder)
    report = reprocess(cat, mission, settings=ReprocessSettings(comparison="zero", table="span"))
    (level,) = report.extra["zero_levels"]
    assert [axis for axis in "xyz" if axis not in level["not_determined"]] == list(told)
    sigma = np.array(level["sigma_nT"])
    if told:
        assert np.all(np.abs(level["value_nT"]) < 0.2)
        assert sigma.max() < 0.1
    else:
        assert level["reason"]
        np.testing.assert_allclose(sigma, 10.0 / np.sqrt(3.0))
