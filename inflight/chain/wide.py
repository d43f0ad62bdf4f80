"""Wide normal equations of a day: the nine parameters and everything else a model lets data refine.

The nine are linearised at the day's own fit, all others at the model's values. Rows are means over bins,
which keep every linear statement: the mean residual is the same function of the mean columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.equations import RESIDUAL
from inflight.calibration.robust import TO_SIGMA
from inflight.calibration.sensor import PARTS, vector_sensor_of
from inflight.chain.beside import Beside, scale_of, split
from inflight.chain.within import SCALES
from inflight.comparison import Rows as NativeRows
from inflight.diagnosis.coarse import bin_means, coarsen, grid
from inflight.diagnosis.columns import design, turns_of
from inflight.diagnosis.gram import gram_of
from inflight.diagnosis.library import Term, term_of
from inflight.model import Model
from inflight.time import DAY, SECOND, Int64, usual_step

#: Seconds of a bin: short beside the orbit, and long enough that a day is a small matrix.
BIN_S = 10.0
#: Two readings are far apart when they differ by so many usual differences, and by so many resolutions.
_FAST, _STEPS = 8.0, 4.0
#: Variables of samples that are no channel.
_NO_CHANNELS = ("vector", "scalar", "field", "field_direction", "flag", "weight", "tt2000")


def terms_of(model: Model) -> tuple[Term, ...]:
    """Return the terms of everything a model lets data move: the nine first, then constants with a sigma.

    Columns are called as the model calls its values.
    """
    own = vector_sensor_of(model)
    sigma = [float(one) for part in PARTS for one in own.parameters[part].sigma[:, 0]]
    terms = [Term(own.name, own, PARTS, tuple(sigma))]
    for entry in model.effects:
        if entry is not own:
            term = term_of(entry, entry.name, free_only=True)
            terms += [term] if term.parameters else []
    return tuple(terms)


def with_nine(model: Model, value: Floats) -> Model:
    """Return the model with nine values (9,), physical units, in its vector sensor."""
    own = vector_sensor_of(model)
    named = [name for part in PARTS for name in own.parameters[part].columns]
    return about_offsets(
        model.replace(own.with_columns(dict(zip(named, value.tolist(), strict=True)), {})), value[6:]
    )


def about_offsets(model: Model, offset: Floats) -> Model:
    """Return the model whose other effects of the vector sensor's equation count from these offsets (3,), nT.

    Non-linearity and temperature act on what the sensor reads less its offset (Yin 2010, section 2.4); a
    pre-flight offset that is 5 nT off leaves 2 pT of 30 ppm/K and 15 K.
    """
    own = vector_sensor_of(model)
    for entry in model.effects:
        if entry.sensor == own.sensor and "about" in entry.parameters:
            named = entry.parameters["about"].columns
            model = model.replace(entry.with_columns(dict(zip(named, offset.tolist(), strict=True)), {}))
    return model


def wide_equations(
    fitted: Model,
    samples: xr.Dataset,
    rows: NativeRows,
    span: tuple[int, int],
    attributes: dict[str, Any],
    bin_s: float = BIN_S,
) -> xr.Dataset:
    """Return the wide equations of one block; parameters and result as `wide_and_beside`."""
    return wide_and_beside(fitted, samples, rows, span, attributes, bin_s)[0]


def wide_and_beside(
    fitted: Model,
    samples: xr.Dataset,
    rows: NativeRows,
    span: tuple[int, int],
    attributes: dict[str, Any],
    bin_s: float = BIN_S,
    beside: Beside | None = None,
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Return the wide equations of one block, and the strip of what is looked at beside the model.

    The equations tell, too, how the residual follows a drift of the scale factors.

    Parameters
    ----------
    fitted : Model
        With the block's own nine: see `with_nine`.
    samples : xarray.Dataset
        Aligned raw samples with the channels of the model.
    rows : inflight.comparison.Rows
        Of this model and these samples.
    span : tuple of int
        TT2000, half-open.
    attributes : dict
        Comparison, model, cadence_ns and filter, as `NormalEquations` holds them.
    bin_s : float
        Seconds.
    beside : Beside, optional
        Causes that are none of the model's.

    Returns
    -------
    equations : Dataset
        One block of `NormalEquations`, without `scatter`: nT^2, columns scaled by the step of their
        parameters; and `drift`, see `inflight.chain.within.DayDrift`.
    strip : Dataset or None
        As `inflight.chain.beside.split` makes it; None without causes.
    """
    terms = terms_of(fitted)
    edges = grid(*span, round(bin_s * SECOND))
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    used = {name for term in terms for name in term.entry.effect.channels} - set(_NO_CHANNELS)
    for name in sorted(used & set(map(str, samples.variables))):
        rows = replace(rows, good=rows.good & ~between_levels(stamps, samples[name]))
    binned, _ = coarsen(
        samples, rows, edges, _channels(samples, used, stamps, edges), turns_of(fitted, sum(span) // 2)
    )
    columns = np.moveaxis(design(terms, binned), -1, 0)
    days = (binned.samples["tt2000"].values - sum(span) // 2) / DAY
    drifting = columns[:SCALES] * days[:, None]
    more = beside.columns(fitted, samples, edges, binned) if beside is not None else {}
    every = np.moveaxis(np.concatenate([columns, drifting, *_scaled(more)]), 0, -1)
    block = slice(0, len(binned.weight))
    gram = gram_of(every, binned.residual[:, :, None], binned.weight, [block])[0]
    own = np.append(np.arange(len(columns) + SCALES), len(gram) - 1)
    count = float(binned.weight.sum())
    whole = _packed(terms, gram[np.ix_(own, own)], count, span, attributes)
    if not more:
        return whole, None
    return whole, _strip(gram, terms, more, binned.weight > 0)


def _strip(
    gram: Floats, terms: Sequence[Term], more: Mapping[str, Floats], seen: npt.NDArray[np.bool_]
) -> xr.Dataset:
    """Return the strip of the causes `more` from the Gram matrix of everything; `seen` (bin,)."""
    known = {name: bool(np.isfinite(one[seen]).all()) for name, one in more.items()}
    told = [name for term in terms for name in term.columns]
    kept = np.delete(np.arange(len(gram)), len(told) + np.arange(SCALES))
    named = [*told, *more, RESIDUAL]
    scale = [*(size for term in terms for size in term.scale), *map(scale_of, more), 1.0]
    both = xr.Dataset(
        {"gram": (("block", "column", "other"), gram[np.ix_(kept, kept)][None]), "scale": ("column", scale)},
        coords={"column": named, "other": named},
    )
    return split(both, told, known)


def _scaled(more: Mapping[str, Floats]) -> list[Floats]:
    """Return columns beside the model's, each (1, bin, row), those unknown somewhere as 0."""
    return [np.nan_to_num(one)[None, :, None] * scale_of(name) for name, one in more.items()]


def empty_equations(model: Model, span: tuple[int, int], attributes: dict[str, Any]) -> xr.Dataset:
    """Return the equations of a block that tells nothing; as `wide_equations` makes them."""
    terms = terms_of(model)
    width = sum(len(term.columns) for term in terms) + SCALES + 1
    return _packed(terms, np.zeros((width, width)), 0.0, span, attributes)


def between_levels(stamps: Int64, channel: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Return which samples lie between two readings of a slower channel that are far apart; (time,).

    When the channel changed there nobody knows, and a straight line between the readings is wrong in the
    same way at every step: three amperes that are five seconds off, thirty times a day, bias everything
    that goes with day and night.

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
    least = _FAST * TO_SIGMA * float(np.median(change[known]))
    far = known & (change > max(least, _STEPS * float(channel.attrs.get("resolution") or 0.0)))
    for place in range(reach + 1):
        out[place : place + far.size] |= far
    return out


def _channels(
    samples: xr.Dataset, names: set[str], stamps: np.ndarray, edges: np.ndarray
) -> dict[str, xr.Variable]:
    """Return channels on the bins: means of what there is."""
    out = {}
    for name in sorted(names & set(map(str, samples.variables))):
        variable = samples[name]
        values = np.asarray(variable.values, dtype=np.float64)
        known = np.asarray(np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        out[name] = xr.Variable(variable.dims, bin_means(values, stamps, edges, known)[0], variable.attrs)
    return out


def _packed(
    terms: tuple[Term, ...], gram: Floats, count: float, span: tuple[int, int], attributes: dict[str, Any]
) -> xr.Dataset:
    """Return a block's equations; gram is that of [columns | drifts | residual]."""
    names = [name for term in terms for name in term.columns]
    scale = np.array([*(size for term in terms for size in term.scale), 1.0])
    value = np.concatenate([_values(term) for term in terms] + [np.zeros(1)])
    own = np.append(np.arange(len(names)), len(gram) - 1)
    drifts = len(names) + np.arange(SCALES)
    return xr.Dataset(
        {
            "gram": (("block", "column", "other"), gram[np.ix_(own, own)][None], {"units": "nT2"}),
            "drift": (
                ("block", "rate", "rate_column"),
                gram[np.ix_(drifts, np.append(own, drifts))][None],
                {"units": "nT2"},
            ),
            "reference": (("block", "column"), value[None]),
            "start": ("block", np.array([span[0]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "end": ("block", np.array([span[1]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "count": ("block", np.array([count])),
            "scale": ("column", scale),
        },
        coords={"column": [*names, RESIDUAL], "other": [*names, RESIDUAL]},
        attrs=attributes,
    )


def _values(term: Term) -> Floats:
    return np.concatenate([term.entry.parameters[name].value[:, 0] for name in term.parameters])
