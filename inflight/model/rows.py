"""What a comparison compares: from corrected sensors to the rows of a residual, nT.

A comparison of kind

scalar
    one row a sample, ``|B_vector| - F``;
dual
    three rows, ``R_in B_in - R_out B_out``, spacecraft axes;
platform
    one row, F in a band of frequencies; the vector sensor gives the direction only;
field_model
    three rows, ``R B_vector`` less a model's field, spacecraft axes;
spin
    two rows of folded samples (`inflight.samples.spin_folding`), the field along the spin axis and the
    modulus of the field across it, each less its interval's mean: what turns with the spin.

A new kind is one more function from corrected samples to rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, cast

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.effects import field_direction
from inflight.errors import ModelError, SamplesError
from inflight.flags import UNUSABLE
from inflight.mission import Sensor, sensors_of
from inflight.samples import Folding
from inflight.time import SECOND, Int64, usual_step

if TYPE_CHECKING:
    import xarray as xr

    from inflight.mission import Mission


@dataclass(frozen=True, kw_only=True)
class BandFilterSettings:
    """The filter of a band of frequencies.

    Attributes
    ----------
    order : int
        Of the Butterworth filter, which runs forwards and backwards; that doubles it (assumed).
    shortest_periods : float
        A run of samples is filtered when it is longer than this many periods of the band's lower edge
        (assumed).
    """

    order: int = 4
    shortest_periods: float = 1.0


BAND_FILTER_SETTINGS = BandFilterSettings()


#: Name of the model's field in samples: (time, axis) nT, spacecraft axes.
REFERENCE = "reference"


class RowFilter(Protocol):
    """A linear filter of rows in time: residuals and columns must go through the same one."""

    def keep(self, values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return what is kept of values (time, ...) at TT2000 stamps; NaN where they are not good."""


class Band(NamedTuple):
    """A band of frequencies, Hz."""

    low_hz: float
    high_hz: float

    def keep(self, values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return what lies in the band: see `filter_rows`."""
        flat = values.reshape(len(values), -1)
        return filter_rows(flat, usual_step(stamps, SECOND) / SECOND, self, good).reshape(values.shape)


@dataclass(frozen=True)
class ResidualDefinition:
    """Kind, sensors and filter of a comparison.

    Attributes
    ----------
    kind : str
        ``scalar``, ``dual``, ``platform``, ``field_model`` or ``spin``.
    sensors : mapping of str to Sensor
        By role in the comparison.
    band : Band, optional
        Of a platform comparison.
    folding : Folding, optional
        Of a spin comparison: how its samples were folded.
    """

    kind: str
    sensors: Mapping[str, Sensor]
    band: Band | None = None
    folding: Folding | None = None

    @classmethod
    def of(cls, mission: Mission, comparison: str = "main") -> ResidualDefinition:
        """Return the layout of a mission's comparison.

        Raises
        ------
        KeyError
            When the mission has no such comparison.
        """
        entry = mission.comparisons[comparison]
        sensors = {sensor.role: sensor for sensor in sensors_of(mission, comparison).values()}
        band = Band(*entry.band) if entry.kind == "platform" else None
        return cls(entry.kind, sensors, band, folding_of(mission, comparison))

    @classmethod
    def of_sensors(cls, sensors: Iterable[Sensor]) -> ResidualDefinition:
        """Return the layout of a dual or scalar comparison that knows only some of its sensors."""
        by_role = {sensor.role: sensor for sensor in sensors}
        dual = bool({"inboard", "outboard"} & set(by_role))
        roles = ("inboard", "outboard") if dual else ("vector", "scalar")
        known = {role: by_role.get(role, Sensor(role, role)) for role in roles}
        return cls("dual" if dual else "scalar", known)

    def sensor(self, role: str) -> Sensor:
        """Return the sensor of a role."""
        return self.sensors[role]


@dataclass(frozen=True, kw_only=True)
class ResidualRows:
    """Residual of a comparison and how a field at each of its sensors changes it.

    Attributes
    ----------
    residual : ndarray, shape (time, row)
        nT; NaN where a reading is missing.
    directions : mapping of str to ndarray, shape (time, row, axis)
        By sensor name: a field f (time, axis), nT, orthogonal axes of the vector sensor (of two, of that
        sensor itself), changes row r by ``directions[name][:, r] @ f``, before the band's filter.
    fields : mapping of str to ndarray, shape (time, axis)
        By sensor name: the best present field there, nT, in the axes of the directions.
    field : ndarray, shape (time, axis)
        The best one of all: that of the vector sensor, of two that of the outboard one.
    good : ndarray of bool, shape (time,)
        Whether a sample may enter a fit.
    step_s : float
        Usual spacing of the samples, seconds.
    kept : RowFilter, optional
        The residual went through it: columns made from the directions must, too.
    """

    residual: Floats
    directions: Mapping[str, Floats]
    fields: Mapping[str, Floats]
    field: Floats
    good: npt.NDArray[np.bool_]
    step_s: float
    kept: RowFilter | None = None


class Correction(Protocol):
    """What `rows_of` needs of a model: its comparison, the comparison's layout, and the correction."""

    @property
    def comparison(self) -> str:
        """Name of the comparison, for errors."""

    @property
    def known_layout(self) -> ResidualDefinition:
        """Kind and sensors of the comparison."""

    def corrected(self, samples: xr.Dataset) -> Mapping[str, xr.Variable]:
        """Return the corrected readings, and `field`, by name."""


def rows_of(model: Correction, samples: xr.Dataset) -> ResidualRows:
    """Return the rows of a model's comparison.

    Parameters
    ----------
    model : Model
        The readings are corrected for its effects first; its layout states what is compared.
    samples : xarray.Dataset
        Aligned raw samples with the comparison's roles, `flag` and `tt2000`.

    Raises
    ------
    ModelError
        When the comparison's kind has no rows here.
    SamplesError
        When a reading is missing.
    """
    layout = model.known_layout
    if layout.kind not in _KINDS:
        raise ModelError(
            f"comparison '{model.comparison}' is of kind '{layout.kind}', which has no rows a sample",
            remedy=f"choose a comparison of kind {', '.join(_KINDS)}",
        )
    if missing := [role for role in layout.sensors if role not in samples]:
        raise SamplesError(
            f"the samples have no {' and no '.join(repr(role) for role in missing)} reading",
            remedy="align the comparison's sensors",
        )
    return _KINDS[layout.kind](layout, cast("xr.Dataset", model.corrected(samples)))


def filter_rows(
    values: Floats, step_s: float, band: Band | None, good: npt.NDArray[np.bool_] | None = None
) -> Floats:
    """Keep a band of frequencies: a linear filter without delay, the same for residuals and columns.

    Butterworth of order 4 forwards and backwards, each run of samples on its own. Runs break where a
    value of any column is missing or a sample is not good, so give the residual and its columns together,
    or with the same `good`; runs shorter than a period of the band's lower edge become NaN.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, column)
        Evenly spaced, in any unit.
    step_s : float
        Spacing, seconds. A band that reaches the Nyquist frequency is open above.
    band : Band or None
        None returns the values as they are.
    good : ndarray of bool, shape (time,), optional
        Samples to be used.

    Returns
    -------
    ndarray
        Of the same shape.
    """
    if band is None:
        return values
    wide = values.reshape(len(values), -1)
    finite = np.asarray(np.isfinite(wide).all(axis=1))
    usable = finite if good is None else finite & good
    if band.high_hz >= 0.5 / step_s:
        sections = scipy.signal.butter(
            BAND_FILTER_SETTINGS.order, band.low_hz, "highpass", fs=1.0 / step_s, output="sos"
        )
    else:
        sections = scipy.signal.butter(
            BAND_FILTER_SETTINGS.order, tuple(band), "bandpass", fs=1.0 / step_s, output="sos"
        )
    shortest = int(BAND_FILTER_SETTINGS.shortest_periods / (band.low_hz * step_s))
    out = np.full(wide.shape, np.nan)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(np.int8), [0]])))
    for first, last in edges.reshape(-1, 2).tolist():
        if last - first > shortest:
            # Odd reflection about the ends is linear in the values, too.
            out[first:last] = scipy.signal.sosfiltfilt(sections, wide[first:last], axis=0, padlen=shortest)
    return out.reshape(values.shape)


def _scalar(layout: ResidualDefinition, corrected: xr.Dataset) -> ResidualRows:
    """Return ``|B_vector| - F``."""
    field, total = _values(corrected, "field"), _values(corrected, "scalar")
    along = field_direction(corrected)[:, None, :]
    vector, scalar = layout.sensor("vector").name, layout.sensor("scalar").name
    residual = (np.linalg.norm(field, axis=1) - total)[:, None]
    return ResidualRows(
        residual=residual,
        directions={vector: along, scalar: -along},
        fields={vector: field, scalar: field},
        field=field,
        good=_good(corrected, residual) & (total > 0),
        step_s=_step(corrected),
    )


def _dual(layout: ResidualDefinition, corrected: xr.Dataset) -> ResidualRows:
    """Return ``R_in B_in - R_out B_out``."""
    inboard, outboard = layout.sensor("inboard"), layout.sensor("outboard")
    fields = {one.name: _values(corrected, one.role) for one in (inboard, outboard)}
    residual = inboard.rotation.apply(fields[inboard.name]) - outboard.rotation.apply(fields[outboard.name])
    shape = (len(residual), 3, 3)
    directions = {
        inboard.name: np.broadcast_to(inboard.rotation.as_matrix(), shape),
        outboard.name: np.broadcast_to(-outboard.rotation.as_matrix(), shape),
    }
    return ResidualRows(
        residual=residual,
        directions=directions,
        fields=fields,
        field=fields[outboard.name],
        good=_good(corrected, residual),
        step_s=_step(corrected),
    )


def _platform(layout: ResidualDefinition, corrected: xr.Dataset) -> ResidualRows:
    """Return F in the layout's band; a field at the vector sensor only rotates a direction a little."""
    field, total = _values(corrected, "field"), _values(corrected, "scalar")
    along = field_direction(corrected)[:, None, :]
    vector, scalar = layout.sensor("vector").name, layout.sensor("scalar").name
    step = _step(corrected)
    good = _good(corrected, np.column_stack([total, field])) & (total > 0)
    residual = filter_rows(total[:, None], step, layout.band, good)
    return ResidualRows(
        residual=residual,
        directions={vector: np.zeros_like(along), scalar: along},
        fields={vector: field, scalar: field},
        field=field,
        good=good & np.isfinite(residual[:, 0]),
        step_s=step,
        kept=layout.band,
    )


def _field_model(layout: ResidualDefinition, corrected: xr.Dataset) -> ResidualRows:
    """Return ``R B_vector`` less the model's field, in spacecraft axes."""
    if REFERENCE not in corrected:
        raise SamplesError(
            "the samples have no field of a model",
            channel=REFERENCE,
            remedy="give the mission positions over the Earth and an attitude",
        )
    sensor, field = layout.sensor("vector"), _values(corrected, "field")
    residual = sensor.rotation.apply(field) - _values(corrected, REFERENCE)
    return ResidualRows(
        residual=residual,
        directions={sensor.name: np.broadcast_to(sensor.rotation.as_matrix(), (len(residual), 3, 3))},
        fields={sensor.name: field},
        field=field,
        good=_good(corrected, residual),
        step_s=_step(corrected),
    )


def _spin(layout: ResidualDefinition, corrected: xr.Dataset) -> ResidualRows:
    """Return what rotates with the spin: along the axis, and of the modulus across it.

    Directions are those of a steady field outside, and so is the field that effects are given: with the
    measured field the residual itself would be a cause, the field scaled to nothing.
    """
    if layout.folding is None:
        raise ModelError(
            "the mission does not say how fast it spins", remedy="state 'spin' under the mission's periods"
        )
    sensor = layout.sensor("vector").name
    field = _values(corrected, "field")
    residual, good = spin_residual(layout.folding, field, corrected)
    stamps = corrected["tt2000"].values
    steady = layout.folding.steady(field, _values(corrected, "spin_phase"), stamps, good)
    directions = np.zeros((len(field), 2, 3))
    directions[:, 0, 2] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        directions[:, 1, :2] = steady[:, :2] / np.hypot(steady[:, 0], steady[:, 1])[:, None]
    return ResidualRows(
        residual=residual,
        directions={sensor: directions},
        fields={sensor: steady},
        field=steady,
        good=good & np.isfinite(residual).all(axis=1),
        step_s=_step(corrected),
        kept=layout.folding,
    )


def spin_residual(
    folding: Folding, field: Floats, folded: xr.Dataset
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return what rotates with the spin in a calibrated field, and which samples are good.

    Parameters
    ----------
    folding : Folding
    field : ndarray, shape (time, 3)
        nT, folded, axes that turn with the spacecraft, z along the spin axis.
    folded : xarray.Dataset
        With `tt2000` and `flag` of the folded samples.

    Returns
    -------
    residual : ndarray, shape (time, 2)
        Field along the spin axis and modulus across it, less their interval's means, nT.
    good : ndarray of bool, shape (time,)
    """
    across = np.hypot(field[:, 0], field[:, 1])
    both = np.column_stack([field[:, 2], across])
    good = _good(folded, both) & (across > 0)
    return folding.keep(both, np.asarray(folded["tt2000"].values), good), good


_KINDS = {
    "scalar": _scalar,
    "dual": _dual,
    "platform": _platform,
    "field_model": _field_model,
    "spin": _spin,
}


def folding_of(mission: Mission, comparison: str = "main") -> Folding | None:
    """Return how a comparison's samples are folded; None of a kind that folds nothing.

    None, too, where the mission states no spin period: `rows_of` then refuses.
    """
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or "spin" not in mission.periods:
        return None
    return Folding.of_period(mission.periods["spin"], entry.turns)


def _values(samples: xr.Dataset, name: str) -> Floats:
    return np.asarray(samples[name].values, dtype=np.float64)


def _good(samples: xr.Dataset, residual: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples have a finite residual (time, row) and no flag that forbids their use; (time,)."""
    finite = np.isfinite(residual).all(axis=1)
    if "flag" not in samples:
        return np.asarray(finite)
    return np.asarray(finite & ((samples["flag"].values & np.uint32(UNUSABLE)) == 0))


def _step(samples: xr.Dataset) -> float:
    """Return the usual spacing of samples, s."""
    return usual_step(samples["tt2000"].values, SECOND) / SECOND
