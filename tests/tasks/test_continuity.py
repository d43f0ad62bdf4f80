"""Products go on from day to day as one unbroken record would; what a day takes of others is in its key."""

import numpy as np
import pytest
from heated_mission import HEATED_DAYS, HOUSEKEEPING, deliver_heated_day, heater_field, housekeeping, nothing
from tiny_mission import TINY_YAML

from inflight.calibration.product import distribute_residual
from inflight.catalog import Catalog, Workspace
from inflight.effects import time_derivative
from inflight.samples import slow_response
from inflight.tasks.archive import ArchiveIndex, Need, ingest
from inflight.tasks.archive.inputs import SPIN_PHASE
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.mission_fit.pipeline import MissionPipeline
from inflight.time import SECOND

SHIFT_S, LAG_S = 0.5, 4000.0
MODEL = f"""\
model: start
mission: tiny
effects:
  - effect: vector_sensor
    sensor: turning
    scale_factor: {{time: block, sigma: 0.01}}
    misalignment: {{time: block, sigma: 1.0}}
    offset: {{time: block, sigma: 200.0}}
  - effect: channel_field
    name: heater
    sensor: turning
    channel: heater_current
    lag: {LAG_S:.0f} s
    coefficient: {{unit: nT/A, value: [200.0, 0.0, -150.0]}}
  - {{effect: time_shift, sensor: absolute, seconds: {{time: constant, value: {SHIFT_S}}}}}
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Three days of a heater whose field is late, and of a scalar instrument whose clock is."""
    folder = tmp_path_factory.mktemp("continuity")
    (folder / "start.yaml").write_text(MODEL, encoding="utf-8")
    yaml = folder / "mission.yaml"
    yaml.write_text(
        TINY_YAML.replace("comparisons:", HOUSEKEEPING) + "preflight: start.yaml\n", encoding="utf-8"
    )
    made = Workspace.create(folder / "w", yaml)
    for day in HEATED_DAYS[:3]:
        deliver_heated_day(made.data, day, heater_field)
    cat = Catalog(made.root)
    ingest(cat, made.mission(), made.data)
    assert reprocess(cat, made.mission(), settings=ReprocessSettings(table="daily")).days["done"] == 3
    return made


def test_lags_and_rates_leave_no_trace_of_midnight(place):
    products = Catalog(place.root).open("l2/field").load()
    stamps = products["tt2000"].values
    current = np.concatenate([housekeeping(day)[0] for day in HEATED_DAYS[:3]]) / 1000.0
    slow = slow_response(current, 60.0, LAG_S)
    for axis, coefficient in enumerate([200.0, 0.0, -150.0]):
        found = products["correction_heater"].values[1440:, axis]
        # Eight lags before the first of them nothing is known.
        assert found == pytest.approx(coefficient * slow[1440:], abs=200 * 0.5 * np.exp(-8) + 2e-4)
    assert np.ptp(slow) > 0.3, "it moves, so that a step would show"
    # The rate of the field at midnight is that across it.
    rate = time_derivative(np.linalg.norm(products["field_sensor"].values, axis=1), stamps)
    measured = np.concatenate(
        [
            one["field"].values
            for one in (Catalog(place.root).open("l1/absolute", day) for day in HEATED_DAYS[:3])
        ]
    )
    shift = products["scalar"].values - measured
    assert shift[1400:1480] == pytest.approx(SHIFT_S * rate[1400:1480], abs=0.02)
    assert np.abs(rate[1438:1442]).max() > 5.0, "the delivered field jumps there, so that it would show"


def test_the_whole_mission_fit_takes_as_much_of_its_neighbours_as_its_filter_sees():
    count, middle, reach = 6000, 3000, round(MissionPipeline.reach_s)
    stamps = np.arange(count) * SECOND
    residual = np.random.default_rng(0).normal(0, 0.1, count) + 0.2 * np.sin(np.arange(count) / 900)
    field = np.tile([3e4, 0.0, 3e4], (count, 1))

    def slow(first: int, last: int) -> np.ndarray:
        part = slice(first, last)
        return distribute_residual(field[part], residual[part], stamps[part]).slow

    unbroken = slow(0, count)
    assert slow(0, middle + reach)[:middle] == pytest.approx(unbroken[:middle], abs=1e-5)
    assert slow(middle - reach, count)[reach:] == pytest.approx(unbroken[middle:], abs=1e-5)
    alone = slow(middle, count)[0] - slow(0, middle)[-1]
    assert abs(alone) > 10 * np.abs(np.diff(unbroken)).max()


def test_the_field_before_the_correction_is_the_sum(place):
    product = Catalog(place.root).open("l2/field", HEATED_DAYS[1]).load()
    found = product["field_sensor"] + product["correction_heater"]
    assert product["before_stray_field"].attrs["frame"] == "spacecraft"
    assert product["before_stray_field"].values == pytest.approx(found.values, abs=2e-4)


def test_a_revision_of_the_day_before_makes_the_next_product_stale(place):
    cat = Catalog(place.root)
    before = {name: cat.current(name, HEATED_DAYS[1]) for name in ("l2/field", "equations/main/base")}
    taken = {day.dataset: [] for day in cat.days_by_id([before["l2/field"].id])}
    for day in cat.days_by_id(edge.parent for edge in cat.lineage(before["l2/field"])):
        taken.setdefault(day.dataset, []).append(str(day.day))
    assert set(taken["l1/turning"]) >= set(HEATED_DAYS[:3])
    deliver_heated_day(place.data, HEATED_DAYS[0], nothing)
    ingest(cat, place.mission(), place.data)
    report = reprocess(cat, place.mission(), settings=ReprocessSettings(table="daily"))
    after = {name: cat.current(name, HEATED_DAYS[1]) for name in before}
    assert after["l2/field"].version > before["l2/field"].version
    assert after["equations/main/base"].key == before["equations/main/base"].key
    # The third day takes nothing of the first one.
    assert (report.days["done"], report.days["unchanged"]) == (2, 1)


def test_the_phase_of_the_spin_comes_from_the_days_around_at_whatever_cadence():
    """An angle that is read with the field has its stamps, and is unwrapped across midnight all the same."""
    base = Need(name="vector", instrument="fgm", channel="field", cadence_ns=SECOND)
    phase = Need(name=SPIN_PHASE, instrument="fgm", channel="angle", cadence_ns=SECOND)
    day = np.datetime64("2024-03-02")
    index = ArchiveIndex({("l1/fgm", day + step): Known(str(day + step)) for step in (-1, 0, 1)})
    assert [one.id for one in index.sources([base], day, base)] == ["2024-03-02"]
    assert [one.id for one in index.sources([base, phase], day, base)] == [
        str(day + one) for one in (-1, 0, 1)
    ]


class Known:
    first_tt2000 = 0

    def __init__(self, id: str) -> None:
        self.id = id
