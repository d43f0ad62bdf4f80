"""The cases: what is hidden, on which orbit, in what company, and which verdicts are right about it."""

from __future__ import annotations

from .orbiter.scenario import Scenario
from .turning import TurningScenario

FOUND, CONFOUNDED, NOT_IDENTIFIABLE = "FOUND", "CONFOUNDED", "NOT_IDENTIFIABLE"
UNKNOWN_EFFECT, NOTHING_LEFT = "UNKNOWN_EFFECT", "NOTHING_LEFT"
#: An effect the data can tell: found, or named among rivals.
NAMED = (FOUND, CONFOUNDED)
#: Nothing the data could show.
SILENT = (NOTHING_LEFT, NOT_IDENTIFIABLE)
#: Too little data: anything but a wrong name.
SHY = (FOUND, CONFOUNDED, NOT_IDENTIFIABLE, UNKNOWN_EFFECT)


def _alone() -> list[Scenario]:
    """Return each family by itself."""
    return [
        Scenario("nonlinearity", ("nonlinearity",)),
        Scenario("temperature_scale", ("temperature_scale",)),
        Scenario("temperature_offset", ("temperature_offset",)),
        Scenario("ageing", ("ageing",), days=50),
        Scenario("torquer", ("torquer",)),
        Scenario("solar", ("solar",), orbit="eclipses", opaque=True),
        Scenario("battery", ("battery",), orbit="eclipses", red=0.03),
        Scenario("camera", ("camera",)),
        Scenario("other_current", ("other_current",)),
        Scenario("day_night", ("day_night",), orbit="eclipses", days=40),
        Scenario("sun_angle", ("sun_angle",), days=40),
        Scenario("eddy", ("eddy",), orbit="polar"),
        Scenario("clock", ("clock",), orbit="polar"),
        Scenario("clock_drift", ("clock_drift",), orbit="polar"),
        Scenario("clock_episode", ("clock_episode",), orbit="polar"),
        Scenario("scalar_bias", ("scalar_bias",), orbit="polar", days=40),
        Scenario("offset_step", ("offset_step",)),
        Scenario("angle_step", ("angle_step",), orbit="polar"),
        Scenario("tone", ("tone",)),
        Scenario("hysteresis", ("hysteresis",), orbit="eclipses"),
    ]


def _together() -> list[Scenario]:
    """Return several at once."""
    return [
        Scenario("two_currents", ("battery", "camera"), orbit="eclipses"),
        Scenario("temperature_and_clock", ("temperature_scale", "clock"), orbit="polar", days=40),
        Scenario("three_at_once", ("torquer", "temperature_offset", "scalar_bias"), orbit="polar", days=40),
    ]


def _beyond() -> list[Scenario]:
    """Return effects that no library of plain channels holds."""
    beyond = (FOUND, CONFOUNDED, UNKNOWN_EFFECT)
    return [
        Scenario("eclipse_warmth", ("eclipse_warmth",), orbit="eclipses"),
        Scenario("slow_response", ("slow",), orbit="eclipses"),
        Scenario("product", ("product",), verdicts=beyond),
        Scenario("unrecorded_switch", ("switch",), verdicts=(UNKNOWN_EFFECT,), size=(4.0, 20.0)),
    ]


def _wrong_numbers() -> list[Scenario]:
    """Return models that hold a right effect by wrong numbers: with a stated sigma, and without."""
    names = ("torquer", "temperature_scale", "nonlinearity", "clock")
    return [
        Scenario(f"wrong_{name}{'_held' if held else ''}", wrong=name, held=held, orbit="polar", known=3)
        for name in names
        for held in (False, True)
    ]


def _wrong_forms() -> list[Scenario]:
    """Return models that hold a right effect by a wrong number of its form."""
    return [
        Scenario("wrong_lag", number="lag", known=1),
        Scenario("wrong_scale_lag", number="scale_lag", orbit="eclipses", known=0),
        Scenario("wrong_delay", number="delay", orbit="eclipses", known=1),
        Scenario("wrong_width", number="width", orbit="eclipses", known=1),
        Scenario("wrong_reference", number="reference", orbit="eclipses", known=1),
    ]


def _nothing() -> list[Scenario]:
    """Return missions with nothing to be found, on different orbits."""
    return [
        Scenario("null_polar", orbit="polar", verdicts=SILENT, known=3),
        Scenario("null_elliptical", orbit="elliptical", verdicts=SILENT, decoys=30),
        Scenario("null_dawn_dusk", orbit="dawn_dusk", verdicts=SILENT, decoys=12),
        Scenario("null_red", verdicts=(*SILENT, UNKNOWN_EFFECT), red=0.04, decoys=12),
    ]


def _inseparable() -> list[Scenario]:
    """Return what the data cannot tell, or cannot tell apart."""
    return [
        Scenario("near_copies", ("solar",), orbit="eclipses", near_copy=True, verdicts=(CONFOUNDED,)),
        Scenario("induced_or_scale", ("induced",), verdicts=SILENT, days=20),
        Scenario("remanent_or_offset", ("remanent",), verdicts=SILENT, days=20),
        Scenario(
            "bias_or_scale", ("scalar_bias",), orbit="uniform", attitude="tumble", verdicts=SILENT, days=20
        ),
        Scenario("steady_in_full_sun", ("day_night",), orbit="dawn_dusk", verdicts=SILENT, days=20),
    ]


def _hard_data() -> list[Scenario]:
    """Return data as they come: short, gappy, spoilt, crowded, nameless."""
    return [
        Scenario("two_days", ("battery",), orbit="eclipses", days=2, verdicts=SHY, size=(8.0, 20.0)),
        Scenario("seven_days", ("temperature_scale",), days=7, verdicts=SHY, size=(5.0, 20.0)),
        Scenario("seven_days_full_sun", ("camera",), orbit="dawn_dusk", days=7, verdicts=SHY),
        Scenario("thirty_decoys", ("temperature_offset",), decoys=30, opaque=True),
        Scenario("gaps", ("torquer",), gaps=0.10),
        Scenario("outliers", ("camera",), outliers=0.004),
        Scenario("unequal_cadences", ("temperature_offset",), cadences=True),
        Scenario("no_kind", ("other_current",), opaque=True, kinds=False, decoys=12),
        Scenario("from_files", ("other_current",), days=20, files=True),
    ]


def _turning() -> list[TurningScenario]:
    """Return spinning spacecraft, whose only witness is their spin."""
    return [
        TurningScenario("turning_gain_ratio", "gain_ratio"),
        TurningScenario("turning_torquer", "torquer"),
        TurningScenario("turning_eclipse_shift", "eclipse_shift", "themis", 4),
        TurningScenario("turning_null", verdicts=SILENT),
    ]


def scenarios() -> dict[str, Scenario | TurningScenario]:
    """Return every scenario by name."""
    groups = (
        _alone(),
        _together(),
        _beyond(),
        _wrong_numbers(),
        _wrong_forms(),
        _nothing(),
        _inseparable(),
        _hard_data(),
        _turning(),
    )
    return {scenario.name: scenario for group in groups for scenario in group}
