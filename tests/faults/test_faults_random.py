"""kill -9 at random moments of the verbs that write, on both databases; what readers see is counted."""

import itertools
import os
import signal
import time
from collections import Counter

import numpy as np
import pytest
from fault_cases import ARCHIVE, BATCH, DAYS, deliver
from sqlalchemy import update

from inflight.catalog import Catalog, move_catalog
from inflight.catalog.schema import RunRow

#: Moments a database; the hundred of the reference: INFLIGHT_KILLS=100.
MOMENTS = int(os.environ.get("INFLIGHT_KILLS", "8"))
#: Times that a moment is tried whose verb had ended before: each waits less long than the one before.
ATTEMPTS = 10
NAMES = (*ARCHIVE, "l2/field")


@pytest.fixture(params=["sqlite", "postgresql"])
def workspace(request, fresh):
    """The redelivered mission, its catalog in either database."""
    folder = fresh("redelivered")
    if request.param == "sqlite":
        yield folder
        return
    server = request.getfixturevalue("postgres_server")
    with server.database() as name:
        move_catalog(folder, server.url(name))
        yield folder


def reopened(workspace):
    """Open the catalog as after the time in which a killed process would have given a sign of life."""
    catalog = Catalog(workspace)
    catalog._database.write(lambda session: session.execute(update(RunRow).values(lease=0.0 * RunRow.lease)))
    return Catalog(workspace)


def faults_seen(catalog):
    """Count days that are lost, doubled, or of several generations among those that a reader sees."""
    found = Counter()
    parents = {}
    for name in NAMES:
        days = catalog.days(name, states=["published"])
        found["lost"] += len(set(DAYS) - {str(day.day) for day in days})
        found["mixed"] += len({day.version for day in days}) > 1
        revisions = catalog.revisions(name)
        found["doubled"] += len(revisions) - len({(day.day, day.version) for day in revisions})
        found["doubled"] += len(days) - len({day.day for day in days})
        for day in days:
            parents[day.id] = {edge.parent for edge in catalog.lineage(day) if edge.child == day.id}
    # A product's day is made of the archive of one generation.
    archive = {one.id: one.version for name in ARCHIVE for one in catalog.revisions(name)}
    made_of = {
        archive.get(p) for day in catalog.days("l2/field") for p in parents[day.id] if p.startswith("day:")
    }
    found["mixed"] += len(made_of - {None}) > 1
    found["damaged"] += len(catalog.verify())
    found["running"] += sum(run.state == "running" for run in catalog.runs())
    for release in catalog.releases():
        folder = catalog.workspace / "releases" / release.version
        found["lost"] += not (folder / "MANIFEST.sha256").is_file()
    return +found


class Killer:
    """Runs verbs on a workspace, and kills them at random moments of the time that each took last."""

    #: In the order in which each has something to do.
    verbs = ("ingest", "reprocess", "release", "gc")

    def __init__(self, stage, workspace, random):
        self.stage, self.workspace, self.random = stage, workspace, random
        self.numbers, self.seeds = itertools.count(1), itertools.count(2)
        self.lasts = {}

    def options(self, verb):
        batches = {"batch_days": BATCH} if verb in ("ingest", "reprocess") else {}
        return batches | ({"version": f"{next(self.numbers)}.0"} if verb == "release" else {})

    def prepare(self, verb, again):
        """Give a verb something to do, which what runs before it does not."""
        if verb == "ingest" or (verb == "reprocess" and again):
            deliver(self.workspace, next(self.seeds))
        if verb == "reprocess" and again:
            self.complete("ingest")

    def complete(self, verb):
        begun = time.monotonic()
        done = self.stage.run(verb, self.workspace, **self.options(verb))
        assert done.code == 0, done.error
        self.lasts[verb] = time.monotonic() - begun

    def strikes(self, verb):
        """Begin a verb, kill it, and return whether it had not ended before."""
        pid = self.stage.begin(verb, self.workspace, **self.options(verb))
        waited = self.random.uniform(0, self.lasts[verb])
        time.sleep(waited)
        if self.stage.kill(pid).code == -signal.SIGKILL:
            return True
        self.lasts[verb] = waited  # it takes less than that by now: the machine has less to do
        return False


@pytest.mark.slow
def test_kills_at_random_moments_lose_double_and_mix_no_day(stage, workspace):
    killer = Killer(stage, workspace, np.random.default_rng([21, MOMENTS]))
    counts, faults = Counter(), Counter()
    for verb in killer.verbs:  # once undisturbed, to know how long each takes
        killer.complete(verb)
    for number in range(MOMENTS):
        verb = killer.verbs[number % len(killer.verbs)]
        for attempt in range(ATTEMPTS):
            killer.prepare(verb, again=attempt > 0)
            before = [day.id for name in NAMES for day in Catalog(workspace).days(name)]
            killed = killer.strikes(verb)
            catalog = reopened(workspace)
            after = [day.id for name in NAMES for day in catalog.days(name)]
            how, what = "killed" if killed else "ended before", "new" if after != before else "as before"
            counts[verb, how, what] += 1
            faults.update(faults_seen(catalog))
            if killed:
                break
        killer.complete(verb)
        faults.update(faults_seen(reopened(workspace)))
    for (verb, how, what), count in sorted(counts.items()):
        print(f"{verb:<10} {how:<13} readers see {what:<10} {count}")
    print(
        f"{sum(counts.values())} moments: {faults['lost']} days lost, {faults['doubled']} doubled, "
        f"{faults['mixed']} mixed; {faults['damaged']} stores damaged"
    )
    assert sum(count for (_, how, _), count in counts.items() if how == "killed") == MOMENTS
    assert faults == Counter()
