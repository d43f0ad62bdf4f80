"""Two real sensors on one boom: how the published field was made, and what both tell without it."""

import numpy as np
import pytest
from injections import REAL
from real_workspaces import workspace
from scipy.spatial.transform import Rotation

from inflight.catalog import Catalog
from inflight.dual.published import relation_to_published
from inflight.tasks.ingest import ingest

FOLDER = REAL / "goes16-mag-ib-ob"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"real measurements are absent: {FOLDER}"),
]


@pytest.fixture(scope="module")
def hour(tmp_path_factory):
    """The hour of February 2017 in an archive."""
    made = workspace(tmp_path_factory.mktemp("goes") / "w", "goes16")
    cat, mission = Catalog(made.root), made.mission()
    assert ingest(cat, mission, FOLDER).days["failed"] == 0
    return cat, mission


def delivered(cat, name):
    day = cat.days(f"l1/{name}", states=("published",))[0]
    return cat.read(day, dated=False)


@pytest.fixture(scope="module")
def relation(hour):
    cat, _ = hour
    days = [delivered(cat, name) for name in ("inboard", "outboard", "product")]
    stamps = days[2]["tt2000"].values
    # Some reports stamp the sensors a millisecond apart.
    assert all(np.abs(day["tt2000"].values - stamps).max() < 2_000_000 for day in days)
    fields = [np.asarray(day["field"].values, dtype=np.float64) for day in days]
    return relation_to_published(stamps, *fields)


def test_the_coefficient_of_the_published_field_is_recovered(relation):
    """1.0729 +- 0.0005 was found from the same hour in another way; the rest is 0.011 nT."""
    assert abs(relation.coefficient - 1.0729) < 2 * np.hypot(0.0005, relation.coefficient_sigma)
    assert 1e-4 < relation.coefficient_sigma < 1e-3
    assert relation.rms == pytest.approx(0.011, abs=0.001)


def test_the_rotations_are_those_of_the_missions_file(hour, relation):
    _, mission = hour
    for name, sigma in (("outboard", relation.outboard_sigma), ("inboard", relation.inboard_sigma)):
        stated = Rotation.from_quat(mission.instruments[name].orientation).as_matrix()
        turn = Rotation.from_matrix(getattr(relation, name) @ stated.T).as_rotvec()
        assert np.all(np.abs(turn) < 4 * sigma + 1e-5)
