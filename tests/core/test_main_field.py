"""The main field: against ppigrf point by point, from a file, along an orbit; files that are wrong."""

import datetime as dt
from pathlib import Path

import numpy as np
import ppigrf
import pytest
from ppigrf.ppigrf import shc_fn

from inflight.errors import MissionError
from inflight.main_field import IGRF, MainField
from inflight.time import SECOND, day_bounds

NOON = day_bounds(np.datetime64("2012-05-04"))[0] + 43_200 * SECOND


def orbit(seconds, radius=6820.0):
    """A circular polar orbit, Earth-fixed axes, km."""
    angle, turned = 2 * np.pi * seconds / 5580.0, -2 * np.pi * seconds / 86_164.0
    along, up = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack([along * np.cos(turned), along * np.sin(turned), up], axis=1)


def test_the_field_is_that_of_ppigrf_at_any_place_and_time():
    position = orbit(np.array([0.0, 700.0, 2000.0, 3400.0, 5000.0]))
    found = MainField.of(IGRF).at(position, np.full(5, NOON))
    for place, field in zip(position, found, strict=True):
        radius = np.linalg.norm(place)
        theta, phi = np.arccos(place[2] / radius), np.arctan2(place[1], place[0])
        up, south, east = (
            float(one.ravel()[0])
            for one in ppigrf.igrf_gc(radius, np.degrees(theta), np.degrees(phi), dt.datetime(2012, 5, 4, 12))
        )
        axes = np.array(
            [
                [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)],
                [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)],
                [-np.sin(phi), np.cos(phi), 0.0],
            ]
        )
        # ppigrf takes the coefficients of the date, to the day.
        np.testing.assert_allclose(axes @ field, [up, south, east], atol=0.2)


def test_a_file_of_coefficients_gives_the_same(tmp_path):
    (tmp_path / "core.shc").write_bytes(Path(shc_fn).read_bytes())
    position, stamps = orbit(np.arange(0.0, 5000.0, 900.0)), NOON + np.arange(6) * 900 * SECOND
    own = MainField.of("core.shc", tmp_path)
    assert own.name == "core.shc"
    np.testing.assert_array_equal(own.at(position, stamps), MainField.of(IGRF).at(position, stamps))


def test_along_an_orbit_file_of_minutes_it_is_the_field_at_every_second():
    seconds = np.arange(0.0, 5600.0)
    stamps, places = NOON + (seconds * SECOND).astype(np.int64), slice(None, None, 60)
    field = MainField.of(IGRF)
    found = field.along_orbit(orbit(seconds)[places], stamps[places], stamps)
    known = np.isfinite(found).all(axis=1)
    assert known.sum() == 5581  # what lies after the last position is not known
    np.testing.assert_allclose(found[known][::97], field.at(orbit(seconds), stamps)[known][::97], atol=0.03)


def test_a_gap_of_the_orbit_is_not_bridged():
    seconds = np.arange(0.0, 5600.0)
    stamps = NOON + (seconds * SECOND).astype(np.int64)
    there = (seconds % 10 == 0) & ((seconds < 2000) | (seconds > 3000))
    found = MainField.of(IGRF).along_orbit(orbit(seconds)[there], stamps[there], stamps)
    np.testing.assert_array_equal(
        np.isfinite(found[:, 0]), (seconds <= 1990) | (seconds >= 3010) & (seconds <= 5590)
    )


def test_a_file_that_is_not_there_or_no_model_is_named(tmp_path):
    with pytest.raises(MissionError, match=r"no file 'chaos.shc'"):
        MainField.of("chaos.shc", tmp_path)
    (tmp_path / "wrong.shc").write_text("1,2,3\n", encoding="utf-8")
    with pytest.raises(MissionError, match="is no file of spherical harmonic coefficients") as caught:
        MainField.of("wrong.shc", tmp_path)
    assert "wrong.shc" in str(caught.value.file)
