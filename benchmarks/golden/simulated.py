"""Cases whose measurements are simulated, by ``inflight simulate`` or here."""

from __future__ import annotations

from benchmarks.golden import spun
from benchmarks.golden.cases import (
    Case,
    Keep,
    Run,
    Write,
    chain,
    change,
    compare,
    diagnose,
    ingest,
    look,
    new,
    replaced,
    report,
    reprocess,
    shipped_model,
    simulate,
)

_ARCHIVE = Keep("archive", ("l1/",))

DEMO = Case(
    "demo",
    "the demo, with Prefect and two processes; its release; then all days at once",
    (
        Run("demo", ("demo", "--days", "3", "--workers", "2")),
        Keep("end", ("l1/", "l2/")),
        compare(),
        look("model", "show"),
        look("catalog", "gaps"),
        look("catalog", "show", "l2/field"),
        look("catalog", "verify"),
        Run("backfill", ("backfill", "--start", "2005-01-01", "--end", "2005-01-05", "--dry-run")),
        Run("release", ("release", "1.0", "--no-prefect", "--notes", "golden")),
        reprocess("continuous", "--distribute"),
        Keep("continuous"),
        compare("continuous"),
    ),
)

_CAMERA = "channel_field(camera_current)"
SCALAR = Case(
    "scalar",
    "against a scalar instrument: days and windows, diagnosis, changes of the model",
    (
        new("champ"),
        simulate(4, "--seed", "7", "--without", "heater", start="2004-06-01"),
        ingest(),
        _ARCHIVE,
        reprocess("daily"),
        Keep("daily"),
        reprocess("window"),
        compare("window"),
        diagnose(),
        report(),
        change("add", _CAMERA),
        look("model", "show"),
        change("undo"),
        change("auto", "--no-prefect", "--rounds", "2"),
        look("model", "diff", "1"),
        change("drop", _CAMERA),
        look("model", "history"),
        reprocess("window"),
        Keep("changed"),
        compare("changed"),
        # A whole mission was never fitted.
        chain(ends=1),
    ),
)

MISSION = Case(
    "mission",
    "all days at once: trends, currents, temperature, day and night",
    (
        new("champ"),
        shipped_model("champ-chain.yaml"),
        replaced("mission.yaml", ("models/champ-preflight.yaml", "models/champ-chain.yaml")),
        simulate(8, "--seed", "3", start="2000-08-01"),
        ingest(),
        reprocess("continuous", "--trend", "linear"),
        Keep("continuous"),
        chain(),
        Run("cross-talk", ("chain", "--cross-talk", "time_shift.seconds")),
    ),
)


def _spin(name: str, title: str, table: str) -> Case:
    steps = (
        new(name),
        simulate(2, "--seed", "5", start="2012-03-01"),
        ingest(),
        _ARCHIVE,
        reprocess(table),
        Keep(table),
        compare(),
        chain(),
        diagnose(),
        report(),
    )
    return Case(name, title, steps)


STATES = Case(
    "states",
    "two sensors on a boom, told apart by the spacecraft's states",
    (
        new("venus-express"),
        simulate(2, "--seed", "102", start="2008-03-01"),
        ingest(),
        _ARCHIVE,
        reprocess(""),
        Keep("states"),
        compare(),
        diagnose("--rounds", "3"),
        report(),
        # Told by states: no table says how the sensors stand to each other.
        chain(ends=1),
    ),
)

FLUXGATES = Case(
    "two-fluxgates",
    "two fluxgates, each calibrated against a scalar instrument, and against each other",
    (
        new("champ-two-fluxgates"),
        simulate(3, "--without", "heater", "--without", "battery"),
        ingest(),
        reprocess("window"),
        reprocess("window", comparison="second"),
        reprocess("", comparison="between"),
        Keep("end"),
        compare(comparison="second"),
        # Nothing is calibrated between them, so there is no product to compare.
        compare(comparison="between", ends=1),
        chain("between"),
        diagnose("--rounds", "1", comparison="between"),
    ),
)

BOOM = Case(
    "boom",
    "two spinning sensors on a boom that bends",
    (
        Write("two spinning sensors", lambda work, checkout: spun.write_boom(work)),
        new("mission/boom.yaml"),
        ingest("delivered"),
        reprocess("span"),
        reprocess("span", comparison="inboard"),
        reprocess("", comparison="boom"),
        Keep("end"),
        chain(),
        chain("boom"),
        compare(),
    ),
)

CASES = (
    MISSION,
    SCALAR,
    STATES,
    FLUXGATES,
    _spin("themis", "a spinning spacecraft, a table a day", "daily"),
    _spin("imp8", "a spinning spacecraft in the solar wind, a table a month", "monthly"),
    BOOM,
    DEMO,
    Case("figures", "published figures against what the software obtains", (new("champ"), look("figures"))),
)
