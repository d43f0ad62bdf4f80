"""Surveys of delivered files as a mission YAML reads them, without a catalog; and YAMLs with wrong lines."""

from pathlib import Path

import numpy as np

from inflight.catalog.readers import find_files, read_file
from inflight.mission import Mission
from inflight.plumbing import Record, Remedy, Survey
from inflight.tasks.archive import channel_needs


def survey_of(text: str, folder: Path, comparison: str = "main", without: tuple[str, ...] = ()) -> Survey:
    """Return the survey of files below a folder, read as a mission's text says; some instruments left out."""
    mission = Mission.parse(text)
    tables = {}
    for name, instrument in mission.instruments.items():
        files = mission.files(name)
        found, _ = find_files(folder, files)
        if name not in without and found:
            tables[name] = [read_file(folder / one.name, files, instrument, one.span) for one in found]

    def record(name: str, instrument: str, channel: str) -> Record:
        parts = tables[instrument]
        stamps = np.concatenate([part.times for part in parts])
        # Deliveries need not be in order, and may repeat a row.
        stamps, order = np.unique(stamps, return_index=True)
        return Record(
            name=name,
            instrument=instrument,
            channel=channel,
            entry=mission.instruments[instrument].channels[channel],
            cadence_ns=mission.instruments[instrument].cadence,
            stamps=stamps,
            values=np.concatenate([part.channels[channel] for part in parts]).astype(np.float64)[order],
        )

    roles = mission.comparisons[comparison].instruments()
    return Survey(
        mission=mission,
        comparison=comparison,
        fields={role: record(role, name, "field") for role, name in roles.items()},
        channels={
            need.name: record(need.name, need.instrument, need.channel)
            for need in channel_needs(mission)
            if need.instrument in tables
        },
    )


def wrong(text: str, path: str, value: str) -> str:
    """Return a mission's text with one line changed."""
    return Remedy("", ((tuple(path.split(".")), value),)).applied(text)
