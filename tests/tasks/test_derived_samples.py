"""Derived channels and geometry in samples: days join without a step, and what is missing is told."""

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.errors import SamplesError
from inflight.frames import GEOMETRY, add_geometry
from inflight.mission import Mission
from inflight.samples import slow_response
from inflight.samples.derived import play
from inflight.tasks.archive import ArchiveIndex, ChannelReader, channel_needs, load_samples, needs_of
from inflight.tasks.models import ideal_model
from inflight.time import SECOND, day_bounds

YAML = """\
mission: derived
instruments:
  turning:
    role: vector
    cadence: 60 s
    orientation: [0, 0, 0.7071067811865476, 0.7071067811865476]
    files: {pattern: "v_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variables: [x, y, z], unit: nT}}
  absolute:
    role: scalar
    cadence: 60 s
    files: {pattern: "s_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variable: f, unit: nT}}
  power:
    role: housekeeping
    cadence: 20 s
    files: {pattern: "h_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      current: {variable: i, unit: mA, kind: battery_current}
      warmth: {variable: t, unit: degC, kind: temperature}
      wheels: {variables: [a, b, c], unit: mA}
  orbit:
    role: orbit
    cadence: 30 s
    files: {pattern: "o_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      place: {variables: [px, py, pz], unit: km, kind: position, frame: itrf}
comparisons: {main: {kind: scalar, vector: turning, scalar: absolute}}
"""
DAYS = [np.datetime64("2016-12-29") + step for step in range(5)]
FIRST, LAST = day_bounds(DAYS[0])[0], day_bounds(DAYS[-1])[1]
UNITS = {"current": "mA", "warmth": "degC", "wheels": "mA", "place": "km", "field": "nT"}


def made(name, stamps):
    """Return the channels of an instrument as functions of time alone."""
    t = (stamps - FIRST) / SECOND
    turn = np.stack([np.sin(t / 900), np.cos(t / 900), 1 + 0 * t], axis=1)
    return {
        "turning": lambda: {"field": 3e4 * turn},
        "absolute": lambda: {"field": 3e4 * np.linalg.norm(turn, axis=1)},
        "power": lambda: {
            "current": 100.0 * (np.sin(t / 880) > 0.3) + 5 * np.sin(t / 300),
            "warmth": 10 + 8 * np.sin(t / 2000),
            "wheels": 30 * turn,
        },
        "orbit": lambda: {"place": 7000 * turn / np.linalg.norm(turn, axis=1)[:, None]},
    }[name]()


CADENCES = {"turning": 60, "absolute": 60, "power": 20, "orbit": 30}


def stamps_of(name):
    return np.arange(FIRST + (7 * SECOND if name == "power" else 0), LAST, CADENCES[name] * SECOND)


def write(cat, without=()):
    with cat.run("test") as run:
        for name in CADENCES:
            stamps = stamps_of(name)
            channels = made(name, stamps)
            for day in DAYS:
                start, end = day_bounds(day)
                inside = (stamps >= start) & (stamps < end)
                if (name, str(day)) in without:
                    continue
                told = {
                    "tt2000": ("time", stamps[inside]),
                    "flag": ("time", np.zeros(inside.sum(), np.uint32)),
                }
                for channel, values in channels.items():
                    attrs = {"units": UNITS[channel], "kind": "other"}
                    if channel == "place":
                        attrs |= {"kind": "position", "frame": "itrf"}
                    told[channel] = (("time", "axis")[: values.ndim], values[inside], attrs)
                run.stage(f"l1/{name}", xr.Dataset(told), day=day)
        run.publish()


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("derived")
    yaml = folder / "mission.yaml"
    yaml.write_text(YAML, encoding="utf-8")
    mission = Workspace.create(folder / "w", yaml).mission()
    cat = Catalog(folder / "w")
    write(cat)
    return cat, mission


def loaded(workspace, names, day, geometry=True):
    cat, mission = workspace
    model = ideal_model(mission)
    needs = needs_of(mission, model, names)
    return load_samples(cat, mission, model, day, needs, ArchiveIndex.of(cat, needs), geometry)


@pytest.mark.parametrize("lag", ["90s", "600s", "4h"])
def test_a_slow_response_runs_on_across_midnight(workspace, lag):
    """Cut from the archive it is what one unbroken series gives, to what eight lags leave of its start."""
    name = f"current@lag={lag}"
    stamps = stamps_of("power")
    series = made("power", stamps)["current"]
    seconds = {"90s": 90.0, "600s": 600.0, "4h": 14_400.0}[lag]
    whole = slow_response(series, 20.0, seconds)
    for day in DAYS[2:]:
        samples = loaded(workspace, [name], day)
        expected = np.interp(samples["tt2000"].values, stamps, whole)
        both = np.isfinite(samples[name].values)
        assert both[:-1].all()
        assert samples[name].values[both] == pytest.approx(expected[both], abs=100 * 4e-4)
        assert samples[name].attrs["units"] == "mA"
    assert np.ptp(whole) > 20, "the channel moves, so that a step would show"


def test_a_play_remembers_the_day_before(workspace):
    stamps = stamps_of("power")
    whole = play(made("power", stamps)["warmth"], 4.0)
    samples = loaded(workspace, ["warmth@width=4"], DAYS[2])
    expected = np.interp(samples["tt2000"].values, stamps, whole)
    assert samples["warmth@width=4"].values[:-1] == pytest.approx(expected[:-1], abs=1e-9)


def test_a_product_multiplies_what_the_samples_hold(workspace):
    name = "current@lag=600s*warmth"
    samples = loaded(workspace, [name, "warmth", "wheels*warmth", "sunlit*current"], DAYS[2])
    expected = samples["current@lag=600s"].values * samples["warmth"].values
    assert np.array_equal(samples[name].values, expected, equal_nan=True)
    assert "milliampere" in samples[name].attrs["units"]
    assert samples["wheels*warmth"].dims == ("time", "axis")
    lit = samples["sunlit"].values * samples["current"].values
    assert np.array_equal(samples["sunlit*current"].values, lit, equal_nan=True)


def test_sunlight_may_warm_slowly(workspace):
    stamps = stamps_of("orbit")
    place = (("time", "axis"), made("orbit", stamps)["place"], {"units": "km", "frame": "itrf"})
    lit = add_geometry(xr.Dataset({"position": place, "tt2000": ("time", stamps)}))["sunlit"].values
    samples = loaded(workspace, ["sunlit@lag=1200s"], DAYS[3])
    expected = np.interp(samples["tt2000"].values, stamps, slow_response(lit, 30.0, 1200.0))
    assert samples["sunlit@lag=1200s"].values[:-1] == pytest.approx(expected[:-1], abs=1e-3)
    assert np.std(samples["sunlit@lag=1200s"].values[:-1]) > 0.05
    with pytest.raises(SamplesError, match="orbit_phase"):
        loaded(workspace, ["orbit_phase@lag=60s"], DAYS[3])


def test_geometry_is_there_when_positions_are_and_left_out_on_demand(workspace):
    samples = loaded(workspace, ["place"], DAYS[1])
    assert set(samples) >= set(GEOMETRY) - {"sun_direction"}
    assert samples["vector"].attrs["orientation"] == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert "latitude" not in loaded(workspace, ["place"], DAYS[1], geometry=False)
    assert "latitude" not in loaded(workspace, ["warmth"], DAYS[1])
    # Asked for by name, it brings the positions along.
    assert np.isfinite(loaded(workspace, ["latitude"], DAYS[1])["latitude"].values).all()


def test_needs_say_how_far_back_they_reach(workspace):
    cat, mission = workspace
    model = ideal_model(mission)
    names = {"current": 1, "current@lag=600s": 1, "current@lag=4h": 2, "warmth@width=1": 2}
    for name, days in names.items():
        (need,) = (need for need in needs_of(mission, model, [name]) if need.name == name)
        assert need.days_before == days, name
    needs = needs_of(mission, model, ["current@lag=4h"])
    index = ArchiveIndex.of(cat, needs)
    assert {day for _, day in index.around([DAYS[3]]).days} == set(DAYS[1:5])
    base = next(need for need in needs if need.name == "vector")
    sources = index.sources(needs, DAYS[3], base)
    assert [day.day for day in sources if day.dataset == "l1/power"] == DAYS[1:5]


def test_without_the_day_before_a_response_starts_steady(workspace, tmp_path):
    yaml = tmp_path / "mission.yaml"
    yaml.write_text(YAML, encoding="utf-8")
    mission = Workspace.create(tmp_path / "w", yaml).mission()
    cat = Catalog(tmp_path / "w")
    write(cat, {("power", str(DAYS[1])), ("orbit", str(DAYS[2])), ("power", str(DAYS[3]))})
    name = "current@lag=600s"
    samples = loaded((cat, mission), [name, "current", "place"], DAYS[2])
    assert np.isfinite(samples[name].values[1:-1]).all()
    assert samples[name].values[1] == pytest.approx(samples["current"].values[1], abs=5)
    assert np.isnan(samples["sunlit"].values).all()
    missing = loaded((cat, mission), [name, "current*warmth"], DAYS[3])
    assert np.isnan(missing[name].values).all()
    assert np.isnan(missing["current*warmth"].values).all()


def test_names_the_mission_has_not_are_left_out_and_placebos_refused(workspace):
    _, mission = workspace
    model = ideal_model(mission)
    names = {need.name for need in needs_of(mission, model, ["nothing", "nothing@lag=3s", "current*nothing"])}
    assert names == {"vector", "scalar"}
    with pytest.raises(SamplesError, match="placebo"):
        needs_of(mission, model, ["current~2"])


def test_the_search_reads_a_channel_as_late_and_as_averaged_as_the_model_does(workspace):
    """A lag of 100 s moves the temperature by up to 0.4 K; columns of the model are made of both readings."""
    cat, _ = workspace
    delayed = Mission.parse(
        YAML.replace("kind: temperature}", "kind: temperature, lag: 100 s, smooth: 120 s}")
    )
    needs = channel_needs(delayed)
    index = ArchiveIndex.of(cat, needs)
    reader = ChannelReader(cat, delayed, needs, index, 10 * SECOND, (FIRST, LAST))
    for day in DAYS[1:4]:
        samples = loaded((cat, delayed), ["warmth", "current"], day)
        edges = reader.edges(day)
        centre = edges[:-1] + 5 * SECOND
        expected = np.interp(centre, samples["tt2000"].values, samples["warmth"].values)
        np.testing.assert_allclose(reader.day(day)["warmth"][6:-6], expected[6:-6], atol=2e-3)
        plain = 10 + 8 * np.sin((centre - FIRST) / SECOND / 2000)
        assert np.abs(reader.day(day)["warmth"] - plain).max() > 0.3
