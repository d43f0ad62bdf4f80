"""A platform's own field from 50 s of flight, judged on the other 50 s.

``python -m benchmarks.tolles_lawson`` prints it. The record is the aircraft's of
``missions/magnav-tl.yaml``. Each half is filtered on its own, everything is chosen inside the half that is
fitted, and the other half is looked at once. The published coefficients were fitted on both halves (ridge of
strength 0.001 on the published arrays gives them to 1e-12): what they leave is in-sample, a mark to come near
and no held-out rival.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.io
import xarray as xr

from benchmarks.ridge import Fold, block_folds, cautious_ridge, least_squares, retained
from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.mission import Mission, sensors_of
from inflight.model import (
    Band,
    Model,
    ModelEffect,
    ResidualDefinition,
    ResidualRows,
    filter_rows,
    make_effect,
    rows_of,
)
from inflight.tasks.archive import ArchiveIndex, ingest, load_samples, needs_of

ROOT = Path(__file__).parents[1]
#: Columns by mechanism, in the order of the effect's parameters.
GROUPS = {"permanent": list(range(3)), "induced": list(range(3, 9)), "eddy": list(range(9, 18))}
#: Seconds at the ends of a record that the filter has not settled in; the published arrays leave out as many.
EDGE_S = 2.0
#: Reference field of the published columns, nT, and their time step, s: coefficients are in these units.
_PUBLISHED_FIELD, _PUBLISHED_STEP = 5e4, 0.1


@dataclass(frozen=True)
class Half:
    """One part of the record in the band: eighteen columns (time, column), nT a unit, and F (time,), nT."""

    columns: Floats
    total: Floats

    def remaining(self, coefficient: Floats) -> float:
        """Return the std that a set of coefficients leaves, nT."""
        return float((self.total - self.columns @ coefficient).std())


@dataclass(frozen=True)
class Record:
    """The flight as samples, its band, and the published coefficients in the effect's units; (18,)."""

    columns: Floats
    rows: ResidualRows
    total: Floats
    band: Band
    published: Floats

    def part(self, first: int, last: int) -> Half:
        """Return samples first to last, filtered on their own, without the ends."""
        step = self.rows.step_s
        both = np.column_stack([self.total, self.columns])[first:last]
        edge = round(EDGE_S / step)
        seen = filter_rows(both, step, self.band)[edge:-edge]
        return Half(seen[:, 1:], seen[:, 0])

    def halves(self) -> tuple[Half, Half]:
        """Return the first and the second half."""
        middle = len(self.total) // 2
        return self.part(0, middle), self.part(middle, len(self.total))


@dataclass
class Score:
    """What estimators fitted on one part leave in another, nT, and how much they were held back."""

    remaining: dict[str, float] = field(default_factory=dict)
    amount: float = float("nan")


def real_data() -> Path:
    """Return the folder of real measurements."""
    return Path(os.environ.get("INFLIGHT_REAL_DATA", ROOT.parent / "shared" / "data"))


def load(workspace: Path, data: Path | None = None) -> Record:
    """Take the file in by the mission's YAML and make the columns by the effect of the library."""
    data = data or real_data() / "magnav-tl"
    mission = Mission.parse((ROOT / "missions" / "magnav-tl.yaml").read_text(encoding="utf-8"))
    cat = Catalog(workspace)
    ingest(cat, mission, data)
    layout = ResidualDefinition.of(mission)
    model = Model("as delivered", mission.mission, "main", (), layout=layout)
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    samples = load_samples(cat, mission, model, index.complete_days(needs)[0], needs, index)
    rows = rows_of(model, samples)
    entry = make_effect({"effect": "tolles_lawson", "sensor": "mag_1"}, sensors_of(mission))
    columns = unit_columns(entry, rows, model.correct(samples))
    band = layout.band or Band(0.1, 0.9)
    total = np.asarray(samples["scalar"].values, dtype=np.float64)
    return Record(columns, rows, total, band, published_coefficients(data))


def unit_columns(entry: ModelEffect, rows: ResidualRows, corrected: xr.Dataset) -> Floats:
    """Return what one unit of each coefficient adds to the scalar reading; (time, 18), before the band."""
    values = {name: np.zeros(part.size) for name, part in entry.effect.parameters().items()}
    columns = []
    for name, value in values.items():
        for index in range(value.size):
            one = {**values, name: np.eye(value.size)[index]}
            added = entry.effect.field(corrected, one, entry.sensor)
            columns.append(np.einsum("ta,ta->t", rows.directions[entry.sensor.name][:, 0], added))
    return np.stack(columns, axis=1)


def published_coefficients(data: Path) -> Floats:
    """Return the published coefficients in the order and the units of the effect; (18,).

    Published columns are direction cosines, products of two with the field in units of 50 uT (so a
    coefficient off the diagonal is twice the matrix entry), and cosine times change per sample of the
    field in units of 50 uT.
    """
    held = scipy.io.loadmat(data / "test_data_TL.mat")["TL_data"][0, 0]["TL_a_1"][:, 0]
    xx, xy, xz, yy, yz, zz = held[3:9] / _PUBLISHED_FIELD
    induced = [xx, yy, zz, xy / 2, xz / 2, yz / 2]
    return np.concatenate([held[:3], induced, held[9:] * _PUBLISHED_STEP / _PUBLISHED_FIELD])


def published_halves(data: Path) -> tuple[tuple[Half, Half], Floats]:
    """Return the halves of the published filtered arrays, and the coefficients in their units."""
    held = scipy.io.loadmat(data / "test_data_TL.mat")["TL_data"][0, 0]
    columns, total = held["A_a_f_t"], held["mag_1_uc_f_t"][:, 0]
    middle = len(total) // 2
    halves = Half(columns[:middle], total[:middle]), Half(columns[middle:], total[middle:])
    return halves, held["TL_a_1"][:, 0]


def judge(fitted: Half, held_out: Half, published: Floats, step_s: float, band: Band) -> Score:
    """Fit on one part with everything chosen inside it, and look at the other."""
    margin = round(EDGE_S / step_s)
    folds = block_folds(len(fitted.total), round(1.0 / (band.low_hz * step_s)), margin)
    score = Score()
    score.remaining["untouched"] = float(held_out.total.std())
    score.remaining["published, fitted on both"] = held_out.remaining(published)
    score.remaining["least squares"] = held_out.remaining(least_squares(fitted.columns, fitted.total))
    least = cautious_ridge(fitted.columns, fitted.total, GROUPS, folds, by_error=False)
    score.remaining["ridge, least loss"] = held_out.remaining(least.coefficient)
    together = {"all": list(range(fitted.columns.shape[1]))}
    unscaled = cautious_ridge(fitted.columns, fitted.total, together, folds)
    score.remaining["ridge, one size for all, one error"] = held_out.remaining(unscaled.coefficient)
    score.remaining["groups one by one"] = held_out.remaining(forward(fitted, folds))
    cautious = cautious_ridge(fitted.columns, fitted.total, GROUPS, folds)
    score.remaining["ridge, one error"] = held_out.remaining(cautious.coefficient)
    score.amount = cautious.amount
    return score


def forward(fitted: Half, folds: Sequence[Fold]) -> Floats:
    """Add permanent, induced, eddy in turn while what is left out gains by more than its error."""
    taken: list[int] = []
    coefficient = np.zeros(fitted.columns.shape[1])
    before = None
    for columns in GROUPS.values():
        trial = taken + columns
        groups = {name: own for name, own in GROUPS.items() if set(own) <= set(trial)}
        found = cautious_ridge(fitted.columns[:, trial], fitted.total, groups, folds)
        before = found.loss[:, -1] if before is None else before
        gain = before - found.loss[:, found.chosen]
        if gain.mean() <= gain.std(ddof=1) / np.sqrt(len(gain)):
            break
        taken, before = trial, found.loss[:, found.chosen]
        coefficient = np.zeros(fitted.columns.shape[1])
        coefficient[taken] = found.coefficient
    return coefficient


def windows(record: Record, step: int = 50) -> list[tuple[float, float]]:
    """Return (untouched, cautious ridge) of the longer rest of the record for every fitted window of 50 s."""
    count, length = len(record.total), len(record.total) // 2
    found = []
    for first in range(0, count - length + 1, step):
        rests = [(0, first), (first + length, count)]
        low, high = max(rests, key=lambda rest: rest[1] - rest[0])
        score = judge(
            record.part(first, first + length),
            record.part(low, high),
            record.published,
            record.rows.step_s,
            record.band,
        )
        found.append((score.remaining["untouched"], score.remaining["ridge, one error"]))
    return found


def separation(halves: Mapping[str, Half]) -> list[str]:
    """Say what each group keeps when the others are taken out."""
    lines = [f"  {'':12s}" + "".join(f"{name:>22s}" for name in GROUPS)]
    for label, half in halves.items():
        parts = retained(half.columns, GROUPS)
        lines.append(
            f"  {label:12s}" + "".join(f"{parts[g].min():12.4f} to {parts[g].max():6.4f}" for g in GROUPS)
        )
    return lines


def _table(title: str, both: tuple[Half, Half], published: Floats, step_s: float, band: Band) -> list[str]:
    first, second = both
    scores = [judge(first, second, published, step_s, band), judge(second, first, published, step_s, band)]
    lines = [f"{title}: nT left in the half not fitted", f"  {'fitted':36s}{'first':>8s}{'second':>8s}"]
    first, second = scores[0].remaining, scores[1].remaining
    lines += [f"  {name:36s}{first[name]:8.3f}{second[name]:8.3f}" for name in first]
    return [*lines, f"  strength chosen inside{'':14s}{scores[0].amount:8.3g}{scores[1].amount:8.3g}"]


def report(record: Record, data: Path) -> list[str]:
    """Return the lines to print."""
    step, (first, second) = record.rows.step_s, record.halves()
    lines = _table("each half filtered on its own", (first, second), record.published, step, record.band)
    theirs, coefficients = published_halves(data)
    lines += ["", *_table("published arrays, filtered together", theirs, coefficients, step, record.band)]
    whole = record.part(0, len(record.total))
    lines += ["", "what a column keeps when the other groups' columns are taken out (1 free, 0 lost)"]
    lines += separation({"first half": first, "second half": second, "both": whole})
    ratio = [after / before for before, after in windows(record)]
    lines += [
        "",
        f"any 50 s fitted, the longer rest judged: ratio to untouched {min(ratio):.2f} to {max(ratio):.2f}",
    ]
    return lines


def main() -> None:
    """Print the study."""
    with tempfile.TemporaryDirectory() as scratch:
        print("\n".join(report(load(Path(scratch)), real_data() / "magnav-tl")))


if __name__ == "__main__":
    main()
