"""The page on a mission of one's own begins with a whole one: its YAML, two days of CSV, and its verbs."""

import re
from pathlib import Path

import numpy as np
import pytest

from inflight.mission import Mission

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "own-mission.md"
YAML = re.search(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
NOISE = 0.1


def deliver(folder: Path, late: int = 0) -> None:
    """Write two days of a sensor with an offset that turns in a field of all directions, as the page says.

    The absolute instrument's stamps are so many seconds late.
    """
    generator = np.random.default_rng(5)
    folder.mkdir()
    for day in ("2024-03-01", "2024-03-02"):
        times, turn = np.datetime64(day, "s") + 60 * np.arange(1440), 2 * np.pi * np.arange(1440)
        field = np.stack(
            [25_000 * np.cos(turn / 95), 18_000 * np.sin(turn / 73 + 0.3), 30_000 * np.cos(turn / 257 + 1)],
            axis=1,
        )
        reading = 1.001 * field + [12.0, -7.0, 3.0] + generator.normal(0, NOISE, field.shape)
        strength = np.linalg.norm(field, axis=1)
        stamp = day.replace("-", "")
        rows = [f"{t},{x:.2f},{y:.2f},{z:.2f}" for t, (x, y, z) in zip(times, reading, strict=True)]
        (folder / f"mag_{stamp}.csv").write_text("\n".join(["time,BX,BY,BZ", *rows]) + "\n", encoding="utf-8")
        rows = [f"{t + late},{value:.2f}" for t, value in zip(times, strength, strict=True)]
        (folder / f"abs_{stamp}.csv").write_text("\n".join(["time,F", *rows]) + "\n", encoding="utf-8")


@pytest.fixture
def mine(inflight, tmp_path):
    (tmp_path / "mine.yaml").write_text(YAML, encoding="utf-8")
    deliver(tmp_path / "files")
    assert inflight("new", tmp_path / "mine.yaml", tmp_path / "mine").code == 0
    return tmp_path / "mine"


@pytest.mark.usefixtures("own_cluster")
def test_it_goes_from_a_csv_to_a_verdict_with_twenty_lines_of_yaml(inflight, mine):
    assert len(YAML.strip().splitlines()) <= 20
    assert inflight("ingest", mine.parent / "files", "--no-prefect", "-w", mine).code == 0
    assert inflight("reprocess", "--no-prefect", "-w", mine).code == 0
    compared = inflight("compare", "--json", "-w", mine).json
    assert compared["residual"]["before_nT"] > 10
    assert compared["residual"]["after_nT"] == pytest.approx(NOISE, rel=0.1)
    assert compared["at_noise_floor"]
    assert inflight("diagnose", "--no-prefect", "--json", "-w", mine).json["verdict"] == "NOTHING_LEFT"


def test_a_wrong_column_is_answered_with_the_right_one(inflight, mine):
    path = mine / "mission.yaml"
    path.write_text(path.read_text(encoding="utf-8").replace("BX, BY", "bx, BY"), encoding="utf-8")
    told = inflight("ingest", mine.parent / "files", "--no-prefect", "--json", "-w", mine).json
    assert "did you mean 'BX'?" in told["problems"][0]["message"]


def test_a_cadence_that_is_stated_wrongly_is_told_with_the_right_one(inflight, mine):
    path = mine / "mission.yaml"
    path.write_text(path.read_text(encoding="utf-8").replace("60 s", "10 s"), encoding="utf-8")
    deliver(mine.parent / "late", late=7)
    taken = inflight("ingest", mine.parent / "late", "--no-prefect", "-w", mine)
    assert taken.code == 0
    answer = "samples are 60 s apart, but the mission file states 10 s: write 'cadence: 60 s'"
    assert answer in taken.out
    failed = inflight("reprocess", "--no-prefect", "--json", "-w", mine).json["problems"]
    assert answer in failed[0]["remedy"]


@pytest.mark.parametrize(
    ("right", "wrong", "answer"),
    [
        (
            "cadence",
            "cadance",
            "line 5: instruments.mag.cadance: there is no key 'cadance' here; did you mean",
        ),
        (
            "variables: [BX, BY, BZ]",
            "variable: [BX, BY, BZ]",
            "several are written as variables: [BX, BY, BZ]",
        ),
        ("unit: nT}", "units: nT}", "did you mean 'unit'?"),
    ],
)
def test_a_wrong_key_is_answered_with_the_right_one(right, wrong, answer):
    with pytest.raises(Exception, match=re.escape(answer)):
        Mission.parse(YAML.replace(right, wrong, 1), "mine.yaml")
