"""Before the pass: where the residual is linearised, what each channel does, how the span is cut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import Reference, fit_block, split_chain, usable
from inflight.calibration.sensor import PARTS
from inflight.catalog import Catalog
from inflight.diagnosis.library import Term, Told
from inflight.effects.families import channels_of
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.effects.vector_sensor import VectorSensor
from inflight.errors import CalibrationError
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, make_effect
from inflight.sensors import sensors_of
from inflight.spin.fit import fit_spin, spinning_entry
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.channels import ChannelReader
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples
from inflight.time import DAY, SECOND, day_bounds

#: Channels that get a placebo.
_PLACEBOS = 16
#: Days looked at, evenly spread, and samples of each that enter the fit.
_DAYS, _SAMPLES = 12, 20_000
#: Blocks that are wanted of a record, and blocks of a long one at most.
WANTED_BLOCKS, MOST_BLOCKS = 96, 200
#: Correlation time the prewhitened form assumes, s; a fiftieth of the span when that is less.
MEMORY_S = 600.0
#: The library's cadence for spans of up to so many days, s.
_CADENCES = ((2.0, 10.0), (20.0, 10.0), (70.0, 20.0), (np.inf, 30.0))
#: A channel whose values spread by less than this part of their size does not change.
_STILL = 1e-9
#: Rows of a short record: it is not thinned below so many.
_ROWS = 5000


@dataclass(frozen=True)
class Survey:
    """What is known before the pass.

    Attributes
    ----------
    model : Model
        The present model at the values the residual is linearised at.
    base : tuple of Term
        What each calibration interval fits anew.
    fixed : tuple of Term
        Parameters of the vector sensor that the model holds fixed: candidates like any other.
    channels : dict of str to Told
        Every channel of one number a time that changes.
    still : tuple of str
        Channels that do not change in the span.
    """

    model: Model
    base: tuple[Term, ...]
    fixed: tuple[Term, ...]
    channels: Mapping[str, Told]
    still: tuple[str, ...]


def survey(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
    reader: ChannelReader,
) -> Survey:
    """Look at some days of the span.

    Raises
    ------
    CalibrationError
        When no day has enough usable samples.
    """
    some = _spread(days)
    fitted, base, fixed = _linearised(cat, mission, model, needs, index, some)
    told, still = _channels(reader, some)
    return Survey(fitted, base, fixed, told, still)


def _spread(days: Sequence[np.datetime64]) -> list[np.datetime64]:
    places = np.unique(np.linspace(0, len(days) - 1, min(_DAYS, len(days))).round().astype(int))
    return [days[place] for place in places]


def _linearised(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
) -> tuple[Model, tuple[Term, ...], tuple[Term, ...]]:
    """Return the model at its fitted nine parameters, and the terms of these."""
    kind = mission.comparisons[model.comparison].kind
    if kind == "spin":
        return _turning(cat, mission, model, needs, index, days)
    if kind == "platform":
        return model, (), ()
    if kind == "dual":
        return model, (_dual_base(mission, model),), ()
    own = [entry for entry in model.effects if isinstance(entry.effect, VectorSensor)]
    if not own:
        return model, (_extra_base(mission, model),), ()
    middle = sum(day_bounds(days[len(days) // 2])) // 2
    prior = prior_of(own[0], middle)
    parts = [_thinned(cat, mission, model, day, needs, index) for day in days]
    whole = [np.concatenate(one) for one in zip(*parts, strict=True)]
    if whole[3].sum() < 2 * prior.value.size:
        raise CalibrationError(
            f"{int(whole[3].sum())} usable samples on {len(days)} days looked at",
            remedy="see 'inflight catalog gaps' and the flags of the deliveries",
        )
    value = prior.value
    if np.any(prior.sigma > 0):
        value = fit_block(whole[0], whole[1], whole[2], whole[3], prior).value
    entry = _at(own[0], value)
    effects = tuple(entry if one is own[0] else one for one in model.effects)
    return replace(model, effects=effects), *_nine_terms(entry, prior)


def _turning(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
) -> tuple[Model, tuple[Term, ...], tuple[Term, ...]]:
    """Return the model at its fitted parameters of the spin, and their terms."""
    own = spinning_entry(model)
    if own is None:
        sensors = sensors_of(mission, model.comparison)
        vector = next(iter(sensors.values()))
        extra = {"effect": "spinning_sensor", "name": "calibration", "sensor": vector.name}
        model = model.add(make_effect(extra, sensors))
    folded = [load_samples(cat, mission, model, day, list(needs), index, geometry=False) for day in days]
    model = fit_spin(model, folded).model
    entry = spinning_entry(model)
    assert entry is not None
    base, fixed = [], []
    for name in SpinningSensor.SPIN_RELATED:
        told = entry.parameters[name]
        if told.free:
            kinds = SpinningSensor.parameters()[name]
            known = np.where(np.isfinite(told.sigma[:, 0]), told.sigma[:, 0], kinds.sigma)
            base.append(Term(entry.name, entry, (name,), tuple(known.tolist())))
        else:
            fixed.append(Term(entry.name, entry, (name,), (np.inf,) * told.parameter.size))
    return model, tuple(base), tuple(fixed)


def prior_of(entry: ModelEffect, tt2000: int) -> Reference:
    """Return values and prior sigmas of the nine parameters; 0 for those the model holds fixed."""
    timed = [entry.parameters[part] for part in PARTS]
    kinds = VectorSensor.parameters()
    sigma = [
        np.where(np.isfinite(one.sigma[:, 0]), one.sigma[:, 0], kinds[part].sigma)
        if one.free
        else np.zeros(3)
        for part, one in zip(PARTS, timed, strict=True)
    ]
    return Reference(np.concatenate([one.at(tt2000) for one in timed]), np.concatenate(sigma), entry.name)


def _at(entry: ModelEffect, value: Floats) -> ModelEffect:
    parameters = dict(entry.parameters)
    for place, part in enumerate(PARTS):
        numbers = value[3 * place : 3 * place + 3][:, None]
        sigma = entry.parameters[part].sigma[:, :1]
        parameters[part] = replace(parameters[part], time="constant", value=numbers, sigma=sigma, table=None)
    return replace(entry, parameters=parameters)


def _nine_terms(entry: ModelEffect, prior: Reference) -> tuple[tuple[Term, ...], tuple[Term, ...]]:
    base, fixed = [], []
    for place, part in enumerate(PARTS):
        sigma = prior.sigma[3 * place : 3 * place + 3]
        if np.any(sigma > 0):
            base.append(Term(entry.name, entry, (part,), tuple(sigma.tolist())))
        else:
            fixed.append(Term(entry.name, entry, (part,), (np.inf,) * 3))
    return tuple(base), tuple(fixed)


def _extra_base(mission: Mission, model: Model) -> Term:
    """Nine parameters around what a model without a `vector_sensor` leaves."""
    sensors = sensors_of(mission, model.comparison)
    vector = next(sensor for sensor in sensors.values() if sensor.role == "vector")
    entry = make_effect({"effect": "vector_sensor", "name": "calibration", "sensor": vector.name}, sensors)
    return Term("calibration", entry, PARTS, (np.inf,) * 9)


def _dual_base(mission: Mission, model: Model) -> Term:
    """A matrix and a shift between two vector sensors: what their difference leaves to calibration."""
    sensors = sensors_of(mission, model.comparison)
    inboard = next(sensor for sensor in sensors.values() if sensor.role == "inboard")
    entry = make_effect({"effect": "affine", "name": "calibration", "sensor": inboard.name}, sensors)
    return Term("calibration", entry, ("matrix", "shift"), (np.inf,) * 12)


def _thinned(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> tuple[Floats, Floats, Floats, np.ndarray]:
    samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
    reading, additive, scalar = split_chain(model, samples)
    good = usable(samples, reading, additive, scalar)
    step = max(1, len(reading) // _SAMPLES)
    additive = np.broadcast_to(additive, reading.shape)
    return reading[::step], additive[::step], scalar[::step], good[::step]


def _channels(
    reader: ChannelReader, days: Sequence[np.datetime64]
) -> tuple[dict[str, Told], tuple[str, ...]]:
    told, still, kinds = {}, [], channels_of(reader.mission)
    read = {day: reader.day(day) for day in days}
    for name in reader.scalars:
        values = np.concatenate([read[day][name] for day in days])
        finite = values[np.isfinite(values)]
        if finite.size < 2:
            still.append(name)
            continue
        low, high = np.quantile(finite, [0.05, 0.95])
        spread = float(high - low) or float(np.ptp(finite))
        if spread <= _STILL * max(float(np.abs(finite).max()), 1e-300):
            still.append(name)
            continue
        told[name] = Told(float(finite.mean()), spread, 1.0 - finite.size / values.size, kinds[name].kind)
    return told, tuple(still)


def cadence_for(span_ns: int, native_ns: int) -> int:
    """Return the library's cadence for a span: native when it is slow or the record short, nanoseconds."""
    wanted = next(seconds for days, seconds in _CADENCES if span_ns <= days * DAY) * SECOND
    wanted = min(wanted, span_ns / _ROWS)
    return native_ns * max(1, int(wanted // native_ns))


def block_parts(days: int, span_ns: int, orbit_ns: int | None) -> tuple[int, int]:
    """Return parts of a day and days of a block.

    A block of a short span is a part of a day, of an orbit or more where one is known; of a long one,
    some days.
    """
    if days > MOST_BLOCKS:
        return 1, -(-days // MOST_BLOCKS)
    day_ns = span_ns / days
    most = max(1, int(day_ns // orbit_ns)) if orbit_ns and day_ns > orbit_ns else 10**6
    return int(np.clip(-(-WANTED_BLOCKS // days), 1, most)), 1


def placebo_shifts(found: Survey, orbit: int | None, length: int) -> dict[str, float]:
    """Return the shift of each placebo, s: a day or more and part of an orbit, or part of the record."""
    generator = np.random.default_rng(20_000)
    names = sorted(found.channels)
    chosen = (
        [names[place] for place in np.unique(np.linspace(0, len(names) - 1, _PLACEBOS).round().astype(int))]
        if names
        else []
    )
    period = orbit or DAY
    out = {}
    for name in chosen:
        part = generator.uniform(0.15, 0.85)
        if length >= 4 * DAY and length >= 4 * period:
            shift = float((generator.integers(1, 3) * DAY + part * period) / SECOND)
        else:
            shift = generator.uniform(0.25, 0.75) * length / SECOND
        out[f"{name}~1"] = shift
    return out
