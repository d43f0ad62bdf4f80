"""A formula of channels typed in: tried without a trace, then added."""

import pytest
from heated_mission import HEATER_FIELD, housekeeping, make_heated_workspace

from inflight.errors import ModelError, SettingsError
from inflight.explorer.session import ExplorerSession

FORMULA = "= heater_current / 1000 * (boom_temperature < 8)"


def cold_heater(day, reading):
    """The heater's field, while the boom is cold: no channel of the mission alone is that."""
    heater, boom = housekeeping(day)
    return (heater / 1000 * (boom < 8))[:, None] * HEATER_FIELD


def test_a_formula_is_tried_added_and_has_the_hidden_coefficients(tmp_path):
    session = ExplorerSession(make_heated_workspace(tmp_path / "cold", cold_heater), workers=1)

    def nobody(stage, done, total):
        """Take progress that nobody watches."""

    try:
        before, after = session.preview("main", FORMULA, nobody)["error"]["held_out_nT"]
        assert after < 0.3 * before
        assert session.preview("main", "heater_current", nobody)["error"]["held_out_nT"][1] > 2 * after
        assert len(session.versions("main")[0]) == 1
        added = session.change("main", "add", FORMULA, nobody)
        assert added["error"]["held_out_nT"] == pytest.approx([before, after])
        for one, true in zip(added["coefficients"], HEATER_FIELD, strict=True):
            assert abs(one["value"] - true) < 5 * one["sigma"] < 0.5
        assert session.versions("main")[1][-1] == "formula_field_heater_current_boom_temperature"
        # The file is what 'inflight add FILE' takes, and so does the page: the same residual.
        (saved,) = (session.workspace.root / "effects").iterdir()
        session.change("main", "undo", "", nobody)
        again = session.preview("main", f"effects/{saved.name}", nobody)
        assert again["error"]["held_out_nT"] == pytest.approx([before, after])
        with pytest.raises(SettingsError, match="no such file"):
            session.preview("main", "effects/../mission.yaml", nobody)
        with pytest.raises(ModelError, match="has not"):
            session.preview("main", "= heater_curent", nobody)
        with pytest.raises(ModelError, match="is not allowed"):
            session.preview("main", "= open(heater_current, 2)", nobody)
    finally:
        session.close()
