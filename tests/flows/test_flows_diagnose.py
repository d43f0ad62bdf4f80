"""The flow that finds the missing effect does what its plain function does."""

import shutil

import pytest
from heated_mission import make_heated_workspace

from inflight.catalog import Catalog, Workspace
from inflight.errors import SettingsError
from inflight.flows import run_with_prefect, run_without_prefect

pytestmark = pytest.mark.usefixtures("shared_cluster")


def test_a_diagnosis_by_flow_is_that_of_the_plain_functions(embedded, tmp_path):
    first = make_heated_workspace(tmp_path / "flow")
    shutil.copytree(first.root, tmp_path / "plain")
    told = []
    found = run_with_prefect("diagnose", first, {}, progress=lambda *step: told.append(step)).extra
    same = run_without_prefect("diagnose", Workspace.open(tmp_path / "plain"), {}).extra
    assert found["effects"] == same["effects"]
    assert found["residual"] == same["residual"]
    ended = list(dict.fromkeys(name for name, done, total in told if done == total))
    assert set(ended) == {name for name, _, _ in told}
    assert ended[:4] == ["survey", "pass", "blocks", "search"]
    assert {"rivals", "verdict"} <= set(ended)
    assert len(Catalog(first.root).days("equations/main/library", states=("published",))) == 4
    with pytest.raises(SettingsError, match="rounds"):
        run_with_prefect("diagnose", first, {"settings": {"rounds": -1}})
