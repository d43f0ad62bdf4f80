"""Records too short or too smooth to tell causes apart: the honest answer is that."""

import pytest
from injections import REAL
from real_workspaces import diagnosed, workspace

FOLDERS = {"magnav-tl": "magnav-tl", "usgs-bou": "usgs-bou-201601"}
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not REAL.is_dir(), reason=f"the folder of real measurements {REAL} is absent"),
]


@pytest.fixture(scope="module")
def say(tmp_path_factory):
    done = {}

    def make(mission, comparison="main", cadence_s=None):
        first = mission not in done
        if first:
            done[mission] = workspace(tmp_path_factory.mktemp(mission) / "w", mission)
        return diagnosed(
            done[mission], REAL / FOLDERS[mission] if first else None, comparison, cadence_s=cadence_s
        )

    return make


@pytest.mark.parametrize(("mission", "comparison"), [("magnav-tl", "main"), ("usgs-bou", "main")])
def test_nothing_is_named_that_the_record_cannot_show(say, mission, comparison):
    """What a parameter does in time is no cause."""
    said = say(mission, comparison)
    causes = [one for one in said.names if not one.startswith("wander(")]
    assert said.diagnosis.verdict in ("NOT_IDENTIFIABLE", "UNKNOWN_EFFECT", "CONFOUNDED")
    assert said.diagnosis.verdict == "CONFOUNDED" or causes == []
    assert said.ratio <= 1.0


def test_raw_and_published_values_of_one_observatory_leave_the_same(say):
    """The published values are a linear map of the raw ones, which the nine parameters take up."""
    raw, published = say("usgs-bou"), say("usgs-bou", "published")
    before = [one.diagnosis.residual["held_out_before_nT"] for one in (raw, published)]
    assert before[0] == pytest.approx(before[1], rel=0.01)
    assert raw.diagnosis.verdict == published.diagnosis.verdict


def test_parameters_that_one_direction_of_field_cannot_tell_apart_are_named_together_at_every_cadence(say):
    """Which of them comes first is chance, and differs."""
    told = []
    for cadence_s in (60.0, 180.0, 600.0):
        irregular = [
            one
            for one in say("usgs-bou", cadence_s=cadence_s).diagnosis.in_time
            if one["form"] == "irregular"
        ]
        assert len(irregular) == 1
        told.append({irregular[0]["parameter"], *irregular[0]["alike"]})
    assert told[0] == told[1] == told[2]
    assert {"offset[x]", "offset[z]", "scale_factor[x]", "scale_factor[z]", "bias"} <= told[0]
