"""An instrument with two ranges: a table is learnt in each, and holds for its own samples alone."""

import numpy as np
import pytest
from tiny_mission import TINY_START, TINY_YAML, tiny_field, tiny_readings

from inflight.catalog import Catalog, Workspace
from inflight.errors import MissionError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import ReprocessSettings, reprocess

DAYS = np.datetime64(TINY_START, "D") + np.arange(2)
#: Offsets (nT) and gains of both ranges; the second holds for five hours of day 1 and all of day 2.
OFFSETS = np.array([[20.0, -10.0, 5.0], [-35.0, 60.0, 15.0]])
GAINS = np.array([[1.0002, 0.9999, 1.0001], [0.9985, 1.0012, 1.0004]])
RANGES = """\
comparisons:
  main: {kind: scalar, vector: turning, scalar: absolute, range: {channel: measuring_range, value: 1}}
  coarse: {kind: scalar, vector: turning, scalar: absolute, range: {channel: measuring_range, value: [2, 3]}}
"""
YAML = TINY_YAML.partition("comparisons:")[0].replace(
    "  absolute:\n",
    """\
  status:
    role: housekeeping
    cadence: 300 s
    files: {pattern: "status_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {measuring_range: {variable: range, unit: "1"}}
  absolute:
""",
)


def range_at(times):
    """The range (1 or 2) at UTC times; 3 is the second one's other code."""
    hours = (times - DAYS[0]) / np.timedelta64(1, "h")
    return np.where(hours >= 24, 3, np.where((hours >= 6.03) & (hours < 11), 2, 1))


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    root = tmp_path_factory.mktemp("ranges")
    (root / "tiny.yaml").write_text(YAML + RANGES, "utf-8")
    workspace = Workspace.create(root / "w", root / "tiny.yaml")
    for day in DAYS:
        stamp = str(day).replace("-", "")
        each = [tiny_readings(str(day), 0, *one) for one in zip(OFFSETS, GAINS, strict=True)]
        times, _, scalar = each[0]
        used = np.where((range_at(times) == 1)[:, None], each[0][1], each[1][1])
        rows = [f"{t}," + ",".join(f"{v:.3f}" for v in row) for t, row in zip(times, used, strict=True)]
        (workspace.data / f"turning_{stamp}.csv").write_text("time,x,y,z\n" + "\n".join(rows) + "\n", "utf-8")
        rows = [f"{t},{value:.3f}" for t, value in zip(times, scalar, strict=True)]
        (workspace.data / f"absolute_{stamp}.csv").write_text("time,f\n" + "\n".join(rows) + "\n", "utf-8")
        rows = [f"{t},{value}" for t, value in zip(times[::5], range_at(times[::5]), strict=True)]
        (workspace.data / f"status_{stamp}.csv").write_text("time,range\n" + "\n".join(rows) + "\n", "utf-8")
    cat, mission = Catalog(workspace.root), workspace.mission()
    assert ingest(cat, mission, workspace.data).exit_code == 0
    for comparison in ("main", "coarse"):
        assert reprocess(cat, mission, settings=ReprocessSettings(comparison=comparison)).exit_code == 0
    return cat


def test_each_range_has_a_table_of_its_own(calibrated):
    for name, offset, gain in zip(("main", "coarse"), OFFSETS, GAINS, strict=True):
        (record,) = calibrated.tables(f"{name}-window")
        row = calibrated.table_by_id(record.id).isel(interval=0)
        value, sigma = row["value"].values, row["sigma"].values
        # The scale factors of the equation multiply the reading.
        assert (np.abs(value[6:] - offset) < 4 * sigma[6:]).all(), name
        assert (np.abs(value[:3] - 1 / gain) < 4 * sigma[:3]).all(), name


def test_a_sample_is_calibrated_in_the_product_of_its_range_alone(calibrated):
    found = []
    for day in DAYS:
        products = [calibrated.read_day(name, day) for name in ("l2/field", "l2/field-coarse")]
        told = [one.attrs["calibration_range"] for one in products]
        assert told == ["measuring_range = 1", "measuring_range = 2 or 3"]
        other = [(one["flag"].values & np.uint32(Flag.OTHER_RANGE)) > 0 for one in products]
        field = [one["field_sensor"].values for one in products]
        for own, values in zip(other, field, strict=True):
            assert (np.isnan(values).all(axis=1) == own).all()
        assert not (~other[0] & ~other[1]).any()
        first = range_at(products[0]["time"].values) == 1
        assert not (~other[0] & ~first).any()
        assert not (~other[1] & first).any()
        # Between two readings of the range that differ nothing tells which it was.
        assert (other[0] & other[1]).sum() <= 12
        joined = np.where(other[0][:, None], field[1], field[0])
        found.append((joined - tiny_field())[~(other[0] & other[1])])
    apart = np.concatenate(found)
    assert np.sqrt(np.mean(apart**2)) < 0.1  # the noise is 0.05 nT


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("channel: measuring_range,", "channel: mesuring_range,", "did you mean 'measuring_range'"),
        ("value: 1}", "value: []}", "at least 1"),
    ],
)
def test_a_range_needs_a_channel_and_a_value(old, new, told):
    with pytest.raises(MissionError, match=told):
        Mission.parse((YAML + RANGES).replace(old, new, 1))
