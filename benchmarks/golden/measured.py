"""Cases of what was measured, for whoever has the folder of real data (``INFLIGHT_REAL_DATA``)."""

from __future__ import annotations

from benchmarks.golden import spun
from benchmarks.golden.cases import (
    Case,
    Keep,
    Write,
    chain,
    change,
    compare,
    diagnose,
    ingest,
    look,
    new,
    real_data,
    replaced,
    report,
    reprocess,
    shipped_model,
)

_ARCHIVE = Keep("archive", ("l1/",))
_DELIVERED = "{data}"
_BOULDER_MODEL = "usgs-bou-published.yaml"
_MMS = "mms1-fgm-srvy-20190601"

CONRAD = Case(
    "conrad",
    "an observatory in a storm: daily tables, and what a diagnosis says of a field that hardly turns",
    (
        new("conrad"),
        ingest(_DELIVERED, "--end", "2024-05-12"),
        reprocess("span"),
        Keep("end", ("l1/", "l2/")),
        compare(),
        diagnose(),
        report(),
        change("add", "time_shift"),
        look("model", "show"),
    ),
    folder="conrad-wic-storm-may2024",
)

WIK = Case(
    "wik",
    "an old observatory: unequal cadences, clocks, two vector instruments",
    (
        new("wik-cobenzl"),
        ingest(_DELIVERED, "--start", "2011-09-14", "--end", "2011-09-27"),
        _ARCHIVE,
        reprocess("window"),
        reprocess("span", comparison="variometer"),
        Keep("end"),
        compare(),
        diagnose("--start", "2011-09-20"),
        report(),
        diagnose("--start", "2011-09-20", comparison="dependent"),
    ),
    folder="wik-cobenzl-2011",
)

BOULDER = Case(
    "boulder",
    "a month of an observatory against its total field",
    (
        new("usgs-bou"),
        ingest(_DELIVERED),
        reprocess("span"),
        Keep("end", ("l1/", "l2/")),
        compare(),
        diagnose("--end", "2016-01-15"),
    ),
    folder="usgs-bou-201601",
)

PUBLISHED = Case(
    "published",
    "the calibration that observatory published, as the model",
    (
        new("usgs-bou"),
        shipped_model(_BOULDER_MODEL),
        replaced(
            "mission.yaml", ("comparisons:\n", "preflight: models/usgs-bou-published.yaml\ncomparisons:\n")
        ),
        ingest(_DELIVERED, "--end", "2016-01-08"),
        # It has no sensor that a scalar calibration could fit.
        reprocess("daily", ends=1),
        diagnose(),
        look("model", "show"),
    ),
    folder="usgs-bou-201601",
)


def _goes(name: str, mission: str, title: str) -> Case:
    steps = (
        new(mission),
        ingest(_DELIVERED),
        _ARCHIVE,
        reprocess(""),
        Keep("states"),
        compare(),
        diagnose(),
        report(),
    )
    return Case(name, title, steps, folder="goes16-mag-ib-ob")


MMS = Case(
    "mms-spun",
    "the field of MMS 1, spun again by hand and read with known errors",
    (
        Write("the spun field", lambda work, checkout: spun.write_mms(real_data(_MMS), work)),
        new("mission/mms1-spun.yaml"),
        ingest("delivered"),
        reprocess("span"),
        Keep("end", ("l1/", "l2/")),
        compare(),
        chain(),
        diagnose(),
    ),
    folder=_MMS,
)


def _as_delivered(name: str, mission: str, title: str, folder: str) -> Case:
    """Return a case of a delivery nothing calibrates: the archive, and how the verbs say so."""
    steps = (new(mission), ingest(_DELIVERED), _ARCHIVE, reprocess("span", ends=1), compare(ends=1))
    return Case(name, title, steps, folder=folder)


ACE = _as_delivered("ace", "ace", "solar wind as delivered: nothing turns it", "ace-mfi-h0-20230102")
DESPUN = _as_delivered("mms", "mms1", "a despun field as delivered", _MMS)
AIRCRAFT = Case(
    "aircraft",
    "the field of an aircraft's own platform",
    (
        new("magnav-tl"),
        ingest(_DELIVERED),
        _ARCHIVE,
        # A platform comparison has no tables of its own.
        reprocess("span", ends=1),
        compare(ends=1),
        diagnose(),
        report(),
    ),
    folder="magnav-tl",
)

CASES = (
    WIK,
    _goes("goes", "goes16", "two sensors on a boom in orbit, an hour"),
    MMS,
    BOULDER,
    CONRAD,
    _goes("goes-minutes", "goes16-l2", "the same two sensors, minutes weeks apart"),
    AIRCRAFT,
    PUBLISHED,
    ACE,
    DESPUN,
)
