"""Wide equations of a day: the nine parameters and everything else that a model lets data refine.

Takes a day's samples and the model at the day's own fit; makes the Gram matrix of its columns, of the drift
within the day and, apart from it, of auxiliary columns: causes that the model does not hold.

- The nine are linearised at the day's own fit, all others at the model's values. Rows are means over bins,
  which keep every linear statement: the mean residual is the same function of the mean columns.
- Drift: a scale factor that ages by 5e-6 a day moves the residual by 0.1 nT at both ends of it. Each day
  keeps the products of the columns by which its residual would follow a drift; the fit of all days
  determines the rate, which is then removed from the equations without reading a sample (`DayDrift`).
- Auxiliary columns: temperatures with their lag, and the field of day and night. `split_auxiliary` keeps
  their products of a day apart, `with_auxiliary_columns` puts some of them after the model's, for all days.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import PARAMETER_GROUPS, NormalEquations, vector_sensor_of
from inflight.design import (
    DesignRows,
    Term,
    bin_edges,
    bin_means,
    bridge_gaps,
    coarsen,
    design_matrix,
    sensor_matrices,
    term_of,
)
from inflight.errors import CalibrationError
from inflight.frames import add_geometry
from inflight.lsq import MAD_TO_SIGMA, RESIDUAL, gram_of
from inflight.mission_fit.day_night import series_columns, switched_columns
from inflight.mission_fit.temperature import KINDS, coil_columns
from inflight.mission_fit.trends import TrendFit
from inflight.model import Model, ModelEffect, ResidualRows
from inflight.time import DAY, SECOND, Int64, usual_step


@dataclass(frozen=True, kw_only=True)
class DayEquationSettings:
    """How samples of a day become rows.

    Attributes
    ----------
    bin_s : float
        Seconds of a bin: short against the orbit, and long enough that a day is a small matrix.
    reference : float
        degC, where a rival temperature's change is 0 when the model states none; assumed.
    series_order : int
        Order of the day/night series; a day holds fifteen orbits, all of them alike.
    rate_step_ns : int
        Step over which a trend's rate is taken: shorter than what separates a logarithm from its origin.
    usual_differences : float
        Two readings are far apart when they differ by so many usual differences; assumed.
    resolutions : float
        And by so many resolutions; assumed.
    """

    bin_s: float = 10.0
    reference: float = 20.0
    series_order: int = 4
    rate_step_ns: int = DAY // 20
    usual_differences: float = 8.0
    resolutions: float = 4.0


DAY_EQUATION_SETTINGS = DayEquationSettings()

#: Scale factors are the first columns.
SCALES = 3

#: Physical size of one unit of an auxiliary column of a temperature, by its kind; of a field, nT.
_SCALE = dict(zip(KINDS, (1e-6, 1e-8, 1e-6, 1e-8), strict=True))
_FIELD = 0.1

#: Variables of samples that are no channel.
_NO_CHANNELS = ("vector", "scalar", "field", "field_direction", "flag", "weight", "tt2000")


def temperature_entry(model: Model) -> ModelEffect | None:
    """Return the effect by which data may move how the vector sensor follows a temperature; None without."""
    own = vector_sensor_of(model)
    for entry in model.effects:
        same = entry.effect.name == "temperature" and entry.sensor == own.sensor
        if same and all(entry.parameters[name].free for name in KINDS[:2]):
            return entry
    return None


def reference_of(entry: ModelEffect | None) -> float:
    """Return where the change of a temperature is 0, degC."""
    return (
        DAY_EQUATION_SETTINGS.reference if entry is None else float(entry.parameters["reference"].value[0, 0])
    )


@dataclass(frozen=True)
class AuxiliaryColumns:
    """Columns of causes that the model does not hold, the same for every day of a mission.

    Attributes
    ----------
    temperatures : tuple of str
        Channels, degC. Of the model's own only the columns of its lag are needed.
    orbit : bool
        Whether the mission delivers positions, from which day and night follow.
    """

    temperatures: tuple[str, ...] = ()
    orbit: bool = False

    def columns(self, model: Model, samples: xr.Dataset, edges: Int64, rows: DesignRows) -> dict[str, Floats]:
        """Return the columns on the bins, physical units, (bin,) each; NaN where they are not known.

        Parameters
        ----------
        samples : xarray.Dataset
            Native ones.
        edges : ndarray of int64, shape (bin + 1,)
            TT2000.
        rows : DesignRows
            On these bins.
        """
        field = np.asarray(rows.samples["field"].values)
        centre = edges[:-1] // 2 + edges[1:] // 2
        entry = temperature_entry(model)
        own = "" if entry is None else entry.effect.channels[0]
        found: dict[str, Floats] = {}
        for name in self.temperatures:
            values = _bridged_means(samples, name, edges)
            columns = coil_columns(name, field, centre, values, 0.0, reference_of(entry))
            kinds = KINDS[2:] if name == own else KINDS
            found |= {key: column for key, column in columns.items() if _kind_of(key) in kinds}
        if self.orbit and not holds_day_night(model):
            sunlit = phase = np.full(centre.size, np.nan)
            if "position" in samples:
                means = _bridged_means(samples, "position", edges)
                position = xr.Variable(samples["position"].dims, means, samples["position"].attrs)
                geometry = add_geometry(xr.Dataset({"position": position, "tt2000": ("time", centre)}))
                sunlit, phase = (np.asarray(geometry[name].values) for name in ("sunlit", "sun_phase"))
            along = np.asarray(rows.samples["field_direction"].values)
            found |= switched_columns(along, sunlit) | series_columns(
                along, phase, DAY_EQUATION_SETTINGS.series_order
            )
        return found


def holds_day_night(model: Model) -> bool:
    """Return True when the model itself has a field of day and night."""
    return any(entry.effect.name in ("day_night", "day_night_series") for entry in model.effects)


def scale_of(name: str) -> float:
    """Return the physical size of one unit of a column."""
    return _SCALE.get(_kind_of(name), _FIELD)


def _kind_of(name: str) -> str:
    return name.rpartition(".")[2].partition("[")[0]


def _means_on_bins(samples: xr.Dataset, name: str, edges: Int64) -> Floats:
    """Return means of a channel on the bins; (bin, ...)."""
    values = np.asarray(samples[name].values, dtype=np.float64)
    known = np.asarray(np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    return bin_means(values, np.asarray(samples["tt2000"].values, dtype=np.int64), edges, known)[0]


def _bridged_means(samples: xr.Dataset, name: str, edges: Int64) -> Floats:
    """Return means of a channel on the bins, (bin, ...), short gaps bridged; NaN for one that is missing."""
    return (
        bridge_gaps(_means_on_bins(samples, name, edges))
        if name in samples
        else np.full(edges.size - 1, np.nan)
    )


def split_auxiliary(
    equations: xr.Dataset, model_columns: Sequence[str], known: Mapping[str, bool]
) -> xr.Dataset:
    """Return the auxiliary part of one block's equations: the columns that are none of the model's.

    Parameters
    ----------
    equations : Dataset
        One block of `NormalEquations`, the model's columns before all others.
    model_columns : sequence of str
    known : mapping of str to bool
        Whether a column could be formed; the products of one that could not are 0.

    Returns
    -------
    xarray.Dataset
        dims beside, column (the model's and the residual), other (= beside): `cross`, `own` nT^2 scaled;
        `scale`, `known` (beside).
    """
    wide = [*model_columns, RESIDUAL]
    names = [name for name in equations["column"].values.tolist() if name not in set(wide)]
    gram = equations["gram"].isel(block=0)
    return xr.Dataset(
        {
            "cross": (("beside", "column"), gram.sel(column=names, other=wide).values, {"units": "nT2"}),
            "own": (("beside", "other"), gram.sel(column=names, other=names).values, {"units": "nT2"}),
            "scale": ("beside", equations["scale"].sel(column=names).values),
            "known": ("beside", np.array([known[name] for name in names], dtype=np.int64)),
        },
        coords={"beside": names, "column": wide, "other": names},
    )


def with_auxiliary_columns(
    equations: NormalEquations, auxiliary: Sequence[xr.Dataset | None], names: Sequence[str]
) -> NormalEquations:
    """Return the equations with some auxiliary columns after the model's, of the days that know them.

    Parameters
    ----------
    equations : NormalEquations
        Of the days.
    auxiliary : sequence of Dataset or None
        As `split_auxiliary` makes them, one a block.
    names : sequence of str
        Auxiliary columns.

    Raises
    ------
    CalibrationError
        When no day has all of the columns.
    """
    blocks, across, inner, scale = list[int](), list[Floats](), list[Floats](), np.zeros(0)
    for block, part in enumerate(auxiliary):
        if part is None:
            continue
        known = part["known"].values != 0
        place = {name: row for row, name in enumerate(part["beside"].values.tolist()) if known[row]}
        if not set(names) <= place.keys():
            continue
        rows = [place[name] for name in names]
        # By number: xarray's selection by name takes milliseconds, and there are thousands of days.
        across.append(part["cross"].values[rows].T)
        inner.append(part["own"].values[np.ix_(rows, rows)])
        if not blocks:
            scale = part["scale"].values[rows]
        blocks.append(block)
    if not blocks:
        raise CalibrationError(
            f"no day knows the columns of {', '.join(sorted({name.partition('.')[0] for name in names}))}",
            remedy="see the missing days of the channels, and of the orbit",
        )
    return equations.of_blocks(np.array(blocks)).bordered(
        list(names), scale, np.stack(across), np.stack(inner)
    )


@dataclass(frozen=True)
class DayDrift:
    """How the residual of days follows scale factors that drift within the day.

    Attributes
    ----------
    gram : ndarray, shape (block, rate, column + 1 + rate)
        nT^2; products of the drifts' columns, scaled change of the residual for one step of the scale
        factor a day, with the equations' columns, the residual and each other.
    """

    gram: Floats

    def of_blocks(self, index: np.ndarray) -> DayDrift:
        """Return the drift of some blocks."""
        return DayDrift(self.gram[index])

    def remove_drift(self, equations: NormalEquations, rate: Floats) -> NormalEquations:
        """Return the equations with a known drift in their residual.

        Parameters
        ----------
        equations : NormalEquations
            Of the same blocks, their residual as it was made: before `NormalEquations.at`.
        rate : ndarray, shape (block, rate)
            Change of each scale factor a day.
        """
        width = equations.scale.size
        step = rate / equations.scale[:SCALES]
        along = np.einsum("bd,bdj->bj", step, self.gram)
        square = np.einsum("bd,bd->b", along[:, width:], step)
        return equations.with_added_residual(along[:, :width], square)


def scale_factor_rates(fit: TrendFit, equations: NormalEquations) -> Floats:
    """Return how fast the scale factors change in the middles of blocks; (block, rate), a day."""
    times, step, out = equations.middle, DAY_EQUATION_SETTINGS.rate_step_ns, []
    for name in equations.columns[:SCALES]:
        trend, value = fit.trends[name], fit.value[fit.index(name)]
        later, earlier = (trend.basis(times + shift, name) @ value for shift in (step, -step))
        out.append((later - earlier) * (DAY / (2 * step)))
    return np.stack(out, axis=1)


def free_terms(model: Model) -> tuple[Term, ...]:
    """Return the terms of everything a model lets data move: the nine first, then constants with a sigma.

    Columns are called as the model calls its values. Their sigma is what was known before any fit: days that
    taught a number are counted once.
    """
    own = vector_sensor_of(model)
    sigma = np.concatenate([own.parameters[group].prior_sigma[:, 0] for group in PARAMETER_GROUPS])
    terms = [Term(own.name, own, PARAMETER_GROUPS, tuple(sigma.tolist()))]
    for entry in model.effects:
        if entry is not own:
            term = term_of(entry, entry.name, free_only=True)
            terms += [term.before_any_fit()] if term.parameters else []
    return tuple(terms)


def prior_sigma_of(model: Model) -> Floats:
    """Return what is known beforehand of the columns of `free_terms`, physical units; (column,)."""
    return np.array([sigma for term in free_terms(model) for sigma in term.sigma])


def with_nine_parameters(model: Model, value: Floats) -> Model:
    """Return the model with nine values (9,), physical units, in its vector sensor."""
    own = vector_sensor_of(model)
    columns = [name for group in PARAMETER_GROUPS for name in own.parameters[group].columns]
    values = dict(zip(columns, value.tolist(), strict=True))
    return about_offsets(model.replace(own.with_columns(values, {})), value[6:])


def about_offsets(model: Model, offset: Floats) -> Model:
    """Return the model whose other effects of the vector sensor's equation count from these offsets (3,), nT.

    Non-linearity and temperature act on what the sensor reads less its offset (Yin 2010, section 2.4); a
    pre-flight offset that is 5 nT off leaves 2 pT of 30 ppm/K and 15 K.
    """
    own = vector_sensor_of(model)
    for entry in model.effects:
        if entry.sensor == own.sensor and "about" in entry.parameters:
            values = dict(zip(entry.parameters["about"].columns, offset.tolist(), strict=True))
            model = model.replace(entry.with_columns(values, {}))
    return model


def wide_and_auxiliary_equations(
    fitted: Model,
    samples: xr.Dataset,
    rows: ResidualRows,
    span: tuple[int, int],
    attributes: dict[str, Any],
    bin_s: float = DAY_EQUATION_SETTINGS.bin_s,
    auxiliary: AuxiliaryColumns | None = None,
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Return the wide equations of one block, and those of its auxiliary columns.

    The equations also hold how the residual follows a drift of the scale factors.

    Parameters
    ----------
    fitted : Model
        With the block's own nine: see `with_nine_parameters`.
    samples : xarray.Dataset
        Aligned raw samples with the channels of the model.
    rows : inflight.model.rows.ResidualRows
        Of this model and these samples.
    span : tuple of int
        TT2000, half-open.
    attributes : dict
        Comparison, model, cadence_ns and filter, as `NormalEquations` holds them.
    bin_s : float
        Seconds.
    auxiliary : AuxiliaryColumns, optional
        Causes that are none of the model's.

    Returns
    -------
    equations : Dataset
        One block of `NormalEquations`, without `scatter`: nT^2, columns scaled by the step of their
        parameters; and `drift`, see `inflight.mission_fit.daily_equations.DayDrift`.
    auxiliary : Dataset or None
        As `inflight.mission_fit.daily_equations.split_auxiliary` makes it; None without causes.
    """
    terms = free_terms(fitted)
    edges = bin_edges(*span, round(bin_s * SECOND))
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    channels = {name for term in terms for name in term.entry.effect.channels} - set(_NO_CHANNELS)
    used = sorted(channels & set(map(str, samples.variables)))
    for name in used:
        rows = replace(rows, good=rows.good & ~between_levels(stamps, samples[name]))
    on_bins = {
        name: xr.Variable(samples[name].dims, _means_on_bins(samples, name, edges), samples[name].attrs)
        for name in used
    }
    binned, _ = coarsen(samples, rows, edges, on_bins, sensor_matrices(fitted, sum(span) // 2))
    columns = np.moveaxis(design_matrix(terms, binned), -1, 0)
    days = (binned.samples["tt2000"].values - sum(span) // 2) / DAY
    drifts = columns[:SCALES] * days[:, None]
    causes = auxiliary.columns(fitted, samples, edges, binned) if auxiliary is not None else {}
    scaled = [np.nan_to_num(one)[None, :, None] * scale_of(name) for name, one in causes.items()]
    wide = np.moveaxis(np.concatenate([columns, drifts, *scaled]), 0, -1)
    gram = gram_of(wide, binned.residual[:, :, None], binned.weight, [slice(0, len(binned.weight))])[0]
    drift = len(columns) + np.arange(SCALES)
    own = np.append(np.arange(len(columns) + SCALES), len(gram) - 1)
    equations = _block_dataset(terms, gram[np.ix_(own, own)], float(binned.weight.sum()), span, attributes)
    if not causes:
        return equations, None
    seen = binned.weight > 0
    known = {name: bool(np.isfinite(one[seen]).all()) for name, one in causes.items()}
    without_drift = np.delete(np.delete(gram, drift, axis=0), drift, axis=1)
    model_columns = [name for term in terms for name in term.columns]
    names = [*model_columns, *causes, RESIDUAL]
    scale = [*(size for term in terms for size in term.scale), *map(scale_of, causes), 1.0]
    whole = xr.Dataset(
        {"gram": (("block", "column", "other"), without_drift[None]), "scale": ("column", scale)},
        coords={"column": names, "other": names},
    )
    return equations, split_auxiliary(whole, model_columns, known)


def empty_equations(model: Model, span: tuple[int, int], attributes: dict[str, Any]) -> xr.Dataset:
    """Return the equations of a block without data; as `wide_and_auxiliary_equations` makes them."""
    terms = free_terms(model)
    width = sum(len(term.columns) for term in terms) + SCALES + 1
    return _block_dataset(terms, np.zeros((width, width)), 0.0, span, attributes)


def between_levels(stamps: Int64, channel: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Return which samples lie between two readings of a slower channel that are far apart; (time,).

    When the channel changed between them is not known, and a straight line is wrong in the same way at
    every step: three amperes that are five seconds off, thirty times a day, bias every effect of day and
    night.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    channel : xarray.DataArray
        Aligned to the samples, with attributes `cadence_ns` and `resolution`.
    """
    out = np.zeros(stamps.size, dtype=bool)
    cadence = int(channel.attrs.get("cadence_ns", 0))
    usual = usual_step(stamps, cadence)
    values = np.asarray(channel.values, dtype=np.float64)
    if cadence <= usual or values.ndim > 1:
        return out
    # Whatever stamps the readings have, two samples one cadence apart hold one reading between them.
    reach = max(1, round(cadence / usual))
    change = np.abs(values[reach:] - values[:-reach])
    known = np.isfinite(change)
    if not known.any():
        return out
    least = DAY_EQUATION_SETTINGS.usual_differences * MAD_TO_SIGMA * float(np.median(change[known]))
    far = known & (
        change > max(least, DAY_EQUATION_SETTINGS.resolutions * float(channel.attrs.get("resolution") or 0.0))
    )
    for shift in range(reach + 1):
        out[shift : shift + far.size] |= far
    return out


def _block_dataset(
    terms: tuple[Term, ...], gram: Floats, count: float, span: tuple[int, int], attributes: dict[str, Any]
) -> xr.Dataset:
    """Return a block's equations; gram is that of [columns | drifts | residual]."""
    names = [name for term in terms for name in term.columns]
    scale = np.array([*(size for term in terms for size in term.scale), 1.0])
    value = [term.entry.parameters[name].value[:, 0] for term in terms for name in term.parameters]
    own = np.append(np.arange(len(names)), len(gram) - 1)
    drifts = len(names) + np.arange(SCALES)
    start, end = (np.array([bound], dtype=np.int64) for bound in span)
    time = {"units": "ns", "scale": "TT2000"}
    return xr.Dataset(
        {
            "gram": (("block", "column", "other"), gram[np.ix_(own, own)][None], {"units": "nT2"}),
            "drift": (
                ("block", "rate", "rate_column"),
                gram[np.ix_(drifts, np.append(own, drifts))][None],
                {"units": "nT2"},
            ),
            "reference": (("block", "column"), np.concatenate([*value, np.zeros(1)])[None]),
            "start": ("block", start, time),
            "end": ("block", end, time),
            "count": ("block", np.array([count])),
            "scale": ("column", scale),
        },
        coords={"column": [*names, RESIDUAL], "other": [*names, RESIDUAL]},
        attrs=attributes,
    )
