"""A month of an old observatory: what is real, what is its instruments' own noise, and steps put in."""

import shutil

import numpy as np
import pytest
from injections import REAL
from real_workspaces import diagnosed, workspace

FOLDER = REAL / "wik-cobenzl-2011"
MONTH, WEEK = ("2011-09-01", "2011-10-01"), ("2011-09-20", "2011-09-27")
#: The LEMI is left out: only the main comparison and the one with its own F are looked at.
USED = ("didd", "didd_total_field", "pmag", "vault", "variometer_room")
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"real measurements are absent: {FOLDER}"),
]


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """A workspace with the month taken in, and what is said of its main comparison."""
    made = workspace(tmp_path_factory.mktemp("wik") / "w", "wik-cobenzl")
    return made, diagnosed(made, FOLDER, days=MONTH, instruments=USED)


def test_one_instrument_held_against_itself_leaves_nothing(known):
    """F of the dIdD is the length of its own vector, but for rounding to 0.1 nT."""
    said = diagnosed(known[0], None, "dependent", WEEK)
    assert said.diagnosis.verdict == "NOTHING_LEFT"
    assert said.diagnosis.residual["noise_floor_nT"] < 0.06


def test_temperatures_that_stand_still_are_listed_as_unscorable(known):
    told = {one["name"] for one in known[1].diagnosis.unscorable}
    assert {"vault.temperature", "variometer_room.temperature"} <= told
    assert not {"temperature", "current"} & known[1].families


def test_the_month_not_fitted_is_never_worse(known):
    assert known[1].ratio <= 1.0


def test_what_is_said_of_the_rate_of_the_field_is_a_clock(known):
    """The dIdD's |B| is its own F: a delay that differs by axis cannot be. A regression of one's own on dF/dt
    gives -5.1 to -6.9 s in five parts of the month; the delays by axis change threefold with activity.
    """
    assert "clock" in known[1].families


def test_a_step_of_one_nanotesla_is_found(tmp_path_factory):
    """An observatory sees one direction of field: its moment is told, and that offset, bias, scale and angle
    make the same step there.
    """
    folder = tmp_path_factory.mktemp("wik-with-step")
    shutil.copytree(FOLDER, folder / "data", copy_function=shutil.copyfile)
    at = np.datetime64("2011-09-19T07:40")
    for file in sorted((folder / "data" / "didd").iterdir()):
        file.chmod(0o644)
        file.write_text(_raised(file.read_text(encoding="ascii"), file.name, at), encoding="ascii")
    said = diagnosed(
        workspace(folder / "w", "wik-cobenzl"), folder / "data", days=MONTH, instruments=("didd", "pmag")
    )
    steps = [one for one in said.diagnosis.effects if "_step@" in one.name]
    assert len(steps) == 1
    when = np.datetime64(steps[0].at[0].rstrip("Z"))
    assert abs(when - at) <= np.timedelta64(1, "h")
    told = {steps[0].name, *(one["name"] for one in said.diagnosis.confusion_set)}
    assert {"bias_step", "offset_step"} <= {name.partition("@")[0] for name in told}


def _raised(text: str, name: str, at: np.datetime64) -> str:
    """Return a day's table with Z raised by one nanotesla from a time on."""
    lines = text.splitlines()
    for place, line in enumerate(lines[1:], 1):
        hour, minute, x, y, z, total = line.split()
        when = np.datetime64(f"2011-09-{name[3:5]}T{hour}:{minute}")
        if when >= at and float(z) < 90_000.0:
            lines[place] = f"{hour} {minute} {x:>8} {y:>8} {float(z) + 1.0:8.1f} {total:>8}"
    return "\n".join(lines) + "\n"
