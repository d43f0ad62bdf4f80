"""Training and processing: the ambient field recovered, the error stated, what is unknown said."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from switching_cases import ADDED_INBOARD, ADDED_OUTBOARD, OUT_LESS_IN, Case, case, six_states, switched

from inflight.dual import (
    Correction,
    Readings,
    continue_training,
    correction_by_states,
    train,
    training_from_dataset,
    training_to_dataset,
)
from inflight.dual.segments import segments_of
from inflight.errors import CalibrationError
from inflight.flags import Flag
from inflight.time import SECOND

UNKNOWN, AMBIGUOUS, TRANSIENT = (
    np.uint32(one) for one in (Flag.UNKNOWN_STATE, Flag.AMBIGUOUS_STATE, Flag.TRANSIENT)
)


def split(made: Case, share: float = 0.6) -> tuple[Case, Case]:
    at = int(share * len(made.readings))
    return made.part(slice(0, at)), made.part(slice(at, None))


def relative(training, commissioning: Case, cruise: Case) -> np.ndarray:
    """Return the true stray field of the cruise beside that of the state the corrections are relative to."""
    segments = segments_of(commissioning.readings)
    middle = (segments.first + segments.last) // 2
    place = int(np.flatnonzero(training.number == training.reference)[0])
    far = np.linalg.norm(segments.level - training.centre[place], axis=1)
    own = middle[np.argmin(np.where(segments.transient, np.inf, far))]
    return cruise.stray - commissioning.stray[own]


def test_the_papers_table_is_consistent():
    # The inboard correction is the outboard one and the difference; the printed figures are rounded.
    assert_allclose(ADDED_INBOARD, OUT_LESS_IN + ADDED_OUTBOARD, atol=0.01001)


@pytest.mark.parametrize("seed", [501, 502])
def test_the_papers_six_states_are_recovered_with_the_ambient_field_known(seed):
    made, _ = six_states(seed)
    training = train(made.readings, ambient=made.ambient)
    assert training.constant_known
    assert np.count_nonzero(training.observed) == 6
    for state in range(6):
        nearest = np.argmin(np.abs(training.centre[:6, 0] + OUT_LESS_IN[state]))
        assert_allclose(training.centre[nearest, 0], -OUT_LESS_IN[state], atol=0.02)
        assert_allclose(-training.correction[nearest, 0], ADDED_OUTBOARD[state], atol=0.02)
    later, true = six_states(seed + 50, ambient=3.0)
    found = correction_by_states(later.readings, training)
    assert len(set(zip(found.state.tolist(), true.tolist(), strict=True))) == 6
    left = found.corrected(later.readings.outboard) - later.ambient
    assert np.sqrt(np.mean(left**2)) < 0.03


def test_the_papers_six_states_are_recovered_from_steps_alone():
    # A quiet ambient field: each state is met four times.
    made, _ = six_states(503, ambient=0.3)
    training = train(made.readings)
    assert not training.constant_known
    order = [int(np.argmin(np.abs(training.centre[:, 0] + one))) for one in OUT_LESS_IN]
    steps = -training.correction[order, 0] + training.correction[order[0], 0]
    sigma = np.sqrt(training.covariance[order, 0, 0] + training.covariance[order[0], 0, 0])
    assert_allclose(steps, ADDED_OUTBOARD - ADDED_OUTBOARD[0], atol=4.0 * max(sigma.max(), 0.01))
    assert sigma.max() < 0.3


def test_the_stated_errors_of_the_units_cover():
    pulls = []
    for seed in range(600, 616):
        made = case(seed, count=20_000, switches=60, ambient=1.0 + seed % 4)
        training = train(made.readings)
        for inside, outside in zip(made.unit_difference, made.unit_outboard, strict=True):
            for sign in (1.0, -1.0):
                near = np.flatnonzero(np.abs(training.unit - sign * inside).max(axis=1) < 0.05)
                for unit in near:
                    sigma = np.sqrt(np.diag(training.unit_covariance[unit]))
                    pulls.append((training.unit_correction[unit] - sign * outside) / sigma)
    pull = np.array(pulls)
    assert len(pull) > 50
    assert 0.8 < np.sqrt(np.mean(pull**2)) < 1.2
    assert 0.60 < np.mean(np.abs(pull) < 1.0) < 0.78


@pytest.mark.parametrize(
    "options", [{}, {"rate": 10.0}, {"gaps": 8}, {"drift": 1.0}, {"noise": 0.2}, {"together": 0.5}], ids=str
)
def test_states_are_right_and_the_stray_field_is_gone_in_cruise(options):
    commissioning, cruise = split(case(521, switches=120, count=50_000, **options))
    training = train(commissioning.readings)
    found = correction_by_states(cruise.readings, training)
    known = found.state >= 0
    assert known.mean() > 0.98
    pairs = set(zip(found.state[known].tolist(), cruise.code[known].tolist(), strict=True))
    # A sample misplaced at an edge makes a pair of its own; whole segments do not.
    wrong = _wrong(found.state[known], cruise.code[known])
    assert wrong < 2e-3, pairs
    left = (found.field - relative(training, commissioning, cruise))[known]
    raw = np.sqrt(np.mean((cruise.stray - cruise.stray.mean(axis=0)) ** 2))
    assert np.sqrt(np.mean(left**2)) < 0.1 * raw


def _wrong(state: np.ndarray, true: np.ndarray) -> float:
    """Return the part of samples whose true state is not the usual one of the state they were given."""
    table = np.zeros((state.max() + 1, true.max() + 1), dtype=int)
    np.add.at(table, (state, true), 1)
    return float(1.0 - table.max(axis=1).sum() / state.size)


def test_the_stated_error_of_the_correction_covers():
    pulls = []
    for seed in range(640, 652):
        commissioning, cruise = split(case(seed, count=30_000, switches=90, ambient=2.0))
        training = train(commissioning.readings)
        found = correction_by_states(cruise.readings, training)
        left = found.field - relative(training, commissioning, cruise)
        for number in np.unique(found.state[found.state >= 0]):
            own = np.flatnonzero(found.state == number)
            if number == training.reference:
                continue
            pulls.append(np.median(left[own], axis=0) / np.median(found.sigma[own], axis=0))
    assert len(pulls) > 60
    # Errors of states in one training share units: few are independent.
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.35


def test_a_combination_never_trained_is_corrected_all_the_same():
    on = switched(np.random.default_rng(81), 50_000, 3, 120, 0.2)
    on[:30_000, 2] *= ~(on[:30_000, 0] & on[:30_000, 1]).astype(bool)
    commissioning, cruise = split(case(531, count=50_000, on=on, units=3, ambient=1.0))
    unseen = cruise.code == 7
    assert unseen.any()
    training = train(commissioning.readings)
    found = correction_by_states(cruise.readings, training)
    assert not training.observed[found.state[unseen].max()]
    left = (found.field - relative(training, commissioning, cruise))[unseen]
    assert np.sqrt(np.nanmedian(left**2)) < 3.0 * np.nanmedian(found.sigma[unseen])


@pytest.mark.parametrize("seed", range(541, 545))
def test_a_unit_never_trained_is_unknown_and_never_forced(seed):
    on = switched(np.random.default_rng(seed), 50_000, 4, 120, 0.1)
    on[:30_000, 3] = 0
    commissioning, cruise = split(case(seed, count=50_000, on=on))
    training = train(commissioning.readings)
    found = correction_by_states(cruise.readings, training)
    new = cruise.on[:, 3] == 1
    assert np.mean(found.state[new] == -1) > 0.95
    assert (found.flag[found.state == -1] & UNKNOWN).all()
    assert not np.isfinite(found.field[found.state == -1]).any()
    assert np.mean(found.state[~new] >= 0) > 0.95


def test_an_unknown_state_takes_the_fallback_with_a_wider_error():
    on = switched(np.random.default_rng(5), 50_000, 4, 120, 0.1)
    on[:30_000, 3] = 0
    commissioning, cruise = split(case(545, count=50_000, on=on))
    training = train(commissioning.readings)
    alone = correction_by_states(cruise.readings, training)
    count = len(cruise.readings)
    # Such as a gradiometer's: right but for a constant of its own and an error of 0.3 nT.
    wrong = 0.3 * np.sin(np.arange(count) / 900.0)[:, None] * np.ones(3)
    estimate = Correction(
        field=cruise.stray + np.array([5.0, 0.0, -5.0]) + wrong,
        covariance=np.tile(0.01 * np.eye(3), (count, 1, 1)),
        state=np.full(count, -1),
        probability=np.full(count, np.nan),
        flag=np.zeros(count, dtype=np.uint32),
        method="gradiometer",
    )
    both = correction_by_states(cruise.readings, training, fallback=estimate)
    lost = alone.state == -1
    left = (both.field - relative(training, commissioning, cruise))[lost]
    assert np.abs(left.mean(axis=0)).max() < 0.3
    assert (both.sigma[lost] > 0.1).all()
    assert (both.flag[lost] & UNKNOWN).all()
    assert_array_equal(both.field[~lost], alone.field[~lost])


def test_passing_disturbances_are_flagged_and_leave_the_state():
    commissioning, cruise = split(case(551, switches=60))
    training = train(commissioning.readings)
    inboard = cruise.readings.inboard.copy()
    segments = segments_of(cruise.readings)
    long = np.flatnonzero(segments.count > 100)[:5]
    at = segments.first[long] + 50
    for place in at:
        inboard[place : place + 4] += [8.0, -5.0, 3.0]
    inboard[at[0] - 25] += 9.0
    found = correction_by_states(
        Readings(cruise.readings.stamps, inboard, cruise.readings.outboard), training
    )
    undisturbed = correction_by_states(cruise.readings, training)
    for place in at:
        assert (found.flag[place : place + 4] & TRANSIENT).all()
        assert_array_equal(found.state[place : place + 4], -2)
        assert found.state[place - 5] == found.state[place + 9] == undisturbed.state[place]
        assert (found.sigma[place] > undisturbed.sigma[place] + 1.0).any()
    assert found.flag[at[0] - 25] & TRANSIENT
    assert found.sigma[at[0] - 25].max() > 5.0


def test_two_states_at_one_point_are_ambiguous_and_their_spread_is_the_error():
    commissioning, cruise = split(case(561, units=2, switches=60))
    training = train(commissioning.readings)
    # The same difference, another stray field: such as two units that only the outboard sensor tells apart.
    twin = replace(
        training,
        number=np.append(training.number, training.number.max() + 1),
        centre=np.vstack([training.centre, training.centre[1]]),
        centre_covariance=np.concatenate([training.centre_covariance, training.centre_covariance[1:2]]),
        correction=np.vstack([training.correction, training.correction[1] + 4.0]),
        covariance=np.concatenate([training.covariance, training.covariance[1:2]]),
        segments=np.append(training.segments, 5),
        seconds=np.append(training.seconds, 100.0),
        transitions=np.pad(training.transitions, (0, 1)) + 1.0,
        occupancy=np.vstack([training.occupancy, training.occupancy[1]]),
    )
    found = correction_by_states(cruise.readings, twin)
    alone = correction_by_states(cruise.readings, training)
    same = alone.state == 1
    assert (found.flag[same] & AMBIGUOUS).all()
    assert (found.sigma[same] > 1.0).all()
    assert not (found.flag[alone.state == 0] & AMBIGUOUS).any()


def test_without_switching_nothing_is_corrected():
    quiet = case(571, units=1, switches=0)
    training = train(quiet.readings)
    found = correction_by_states(quiet.readings, training)
    assert len(training) == 1
    assert_allclose(found.field, 0.0, atol=1e-12)


def test_long_losses_of_a_sensor_are_unknown_and_short_ones_are_bridged():
    commissioning, cruise = split(case(572))
    inboard = cruise.readings.inboard.copy()
    inboard[3_000:3_004] = np.nan
    inboard[5_000:5_200] = np.nan
    found = correction_by_states(
        Readings(cruise.readings.stamps, inboard, cruise.readings.outboard), train(commissioning.readings)
    )
    assert (found.state[3_000:3_004] == found.state[2_999]).all()
    assert (found.state[5_050:5_150] == -1).all()
    assert (found.flag[5_050:5_150] & UNKNOWN).all()


def test_a_training_survives_its_table():
    training = train(case(581).readings)
    again = training_from_dataset(training_to_dataset(training))
    for name in ("centre", "covariance", "correction", "occupancy", "transitions", "number"):
        assert_array_equal(getattr(again, name), getattr(training, name))
    assert again.drift_rate.slope_walk.tolist() == training.drift_rate.slope_walk.tolist()
    assert (again.start, again.end, again.reference) == (training.start, training.end, training.reference)
    with pytest.raises(CalibrationError, match="train anew"):
        training_from_dataset(training_to_dataset(training).assign_attrs(dual_training=9))


def test_states_keep_their_numbers_through_a_later_training():
    made = case(591, count=60_000, switches=160, ambient=1.0)
    early, late = made.part(slice(0, 30_000)), made.part(slice(30_000, None))
    # In the meantime the difference has moved as a whole.
    shifted = late.readings.inboard + np.array([0.7, -0.4, 0.2])
    moved = Readings(late.readings.stamps, shifted, late.readings.outboard)
    first, second = train(early.readings), train(moved)
    going = continue_training(first, second)
    assert_allclose(going.shift, [0.7, -0.4, 0.2], atol=0.05)
    one, other = going.matched.T
    assert_array_equal(going.training.number[other], first.number[one])
    assert len(one) == 16
    assert np.unique(going.training.number).size == len(going.training)
    assert not going.aged.any()
    # Both are relative to one state: the field goes on without a step where the next training begins.
    assert going.training.reference == first.reference
    apart = going.training.correction[other] - first.correction[one]
    sigma = np.sqrt(np.einsum("sii->si", going.training.covariance[other] + first.covariance[one]))
    assert np.abs(apart).max() < 5.0 * sigma.max()
    assert_array_equal(apart[first.number[one] == first.reference], 0.0)


def test_a_unit_that_aged_is_told():
    early, late = case(592, ambient=0.5), case(593, ambient=0.5)
    on = late.on
    read = [
        late.ambient + on @ (early.unit_difference + early.unit_outboard),
        late.ambient + on @ early.unit_outboard,
    ]
    # The first unit now reaches the outboard sensor with 1.5 nT more, and the inboard one as well.
    noise = np.random.default_rng(3).normal(0.0, 0.05, (2, *late.ambient.shape))
    read = [one + 1.5 * on[:, :1] + more for one, more in zip(read, noise, strict=True)]
    going = continue_training(train(early.readings), train(Readings(late.readings.stamps, *read)))
    assert going.aged.any()


def test_one_state_alone_that_moved_far_is_not_taken_for_any():
    first = train(case(594, count=30_000, switches=60, ambient=1.0).readings)
    quiet = case(595, count=5_000, units=1, switches=0)
    places = first.centre[first.observed]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    one, other = np.unravel_index(np.argmin(np.where(apart > 0, apart, np.inf)), apart.shape)
    ambient = quiet.readings.outboard

    def later(share):
        level = places[one] + share * (places[other] - places[one])
        return train(Readings(quiet.readings.stamps, ambient + level, quiet.ambient))

    near = continue_training(first, later(0.1))
    assert near.training.number.tolist() == [int(first.number[first.observed][one])]
    half = continue_training(first, later(0.45))
    assert not len(half.matched)
    assert half.training.number.min() >= first.next_number


def one_unit(ambient, noise, strength=np.ones):
    """Return the stray field at the outboard sensor, and readings, of a unit that switches often."""
    random, time = np.random.default_rng(6), np.arange(20_000)
    number = np.searchsorted(np.cumsum(random.exponential(200.0, 200)), time)
    on = (number % 2) * strength(int(number[-1]) + 1)[number]
    walk = np.cumsum(ambient * random.normal(size=(time.size, 3)), axis=0)
    stray = on[:, None] * [2.0, -1.0, 1.5]
    outboard = walk + stray + noise * random.normal(size=walk.shape)
    inboard = walk + stray + on[:, None] * [6.0, 3.0, -4.0] + noise * random.normal(size=walk.shape)
    return stray, Readings(time * SECOND, inboard, outboard)


def test_a_unit_has_its_whole_field_where_resampling_blurs_its_jumps():
    _, sharp = one_unit(0.3, 0.02)
    between = 0.5 * (sharp.outboard[:-1] + sharp.outboard[1:])
    training = train(Readings(sharp.stamps[:-1], sharp.inboard[:-1], between))
    size = np.linalg.norm(training.unit_correction, axis=1)
    strongest = int(np.argmax(size))
    assert size[strongest] == pytest.approx(np.linalg.norm([2.0, -1.0, 1.5]), rel=0.1)


def test_a_field_that_is_not_the_same_each_time_has_the_error_of_one_time():
    random = np.random.default_rng(9)
    stray, readings = one_unit(0.002, 0.1, lambda count: 1.0 + 0.03 * random.normal(size=count))
    found = correction_by_states(readings, train(readings))
    error = found.field - stray - np.median((found.field - stray)[stray[:, 0] == 0.0], axis=0)
    on = stray[:, 0] > 0.0
    assert np.mean(np.abs(error[on]) < 2.0 * found.sigma[on]) > 0.9
