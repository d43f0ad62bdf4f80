"""A diagnosis, and what a change of the model did, printed for a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Fields = Mapping[str, Any]
#: What each verdict means, and its colour.
VERDICTS = {
    "FOUND": ("beyond doubt, and nothing else explains it as well", "green"),
    "CONFOUNDED": ("something is there; these data cannot tell all rivals apart", "yellow"),
    "NOT_IDENTIFIABLE": ("something is there; the record is too short to say what", "yellow"),
    "UNKNOWN_EFFECT": ("something is there that no effect of the library explains", "red"),
    "NOTHING_LEFT": ("the residual is noise", "green"),
}
#: Rows shown before the rest is only counted; --json has all.
_CANDIDATES, _PLACEBOS, _UNSCORABLE, _MOVED, _COEFFICIENTS = 8, 3, 6, 10, 9


def print_diagnosis(console: Console, fields: Fields) -> None:
    """Print the verdict, what was found and its numbers, its rivals, what is left, and what to type next.

    Parameters
    ----------
    fields : mapping
        `Diagnosis.as_json`; of ``auto`` with ``versions``.
    """
    from rich.panel import Panel
    from rich.text import Text

    meaning, colour = VERDICTS[fields["verdict"]]
    told = Text(f"{fields['sentence']}\n", style="default")
    told.append(meaning, style="dim")
    console.print(Panel(told, title=fields["verdict"], title_align="left", border_style=colour))
    if fields["effects"]:
        console.print(_effects(fields["effects"]))
    _print_sizes(console, fields)
    console.print(_candidates(fields["candidates"]))
    _print_rivals(console, fields)
    _print_unscorable(console, fields["unscorable"])
    for unit in fields.get("units", ()):
        console.print(unit["sentence"], soft_wrap=True, markup=False)
    for step in fields.get("versions", ()):
        _print_step(console, step)
    if fields["stopped"]:
        console.print(f"why it stopped: {fields['stopped']}", soft_wrap=True, markup=False)
    for line in _next(fields):
        console.print(line, soft_wrap=True, markup=False)


def _effects(effects: Sequence[Fields]) -> Table:
    """One row a coefficient; effect, family and how it stands in the first of its rows."""
    table = _table("effect", "family", "coefficient", "value", "", "unit", "at", "gain", "t", "p", "retained")
    for effect in effects:
        stands = (_percent(effect["gain"]), _number(effect["t"], 3), _number(effect["flip_p"], 2))
        cells: tuple[str, ...] = (*stands, _percent(effect["retained"]))
        name, family = effect["name"], effect["family"]
        for one in _shown(effect["coefficients"]):
            value, sigma = _with_error(one["value"], one["sigma"])
            _row(table, name, family, one["name"], value, f"± {sigma}", one["unit"], one["at"], *cells)
            name, family, cells = "", "", ("",) * len(cells)
        if effect["lag_s"]:
            lag, sigma = _with_error(effect["lag_s"], effect["lag_sigma_s"] or 0.0)
            _row(table, "", "", "lag", lag, f"± {sigma}" if effect["lag_sigma_s"] else "", "s")
    return table


def _shown(coefficients: Sequence[Fields]) -> Sequence[Fields]:
    """Return the coefficients; of many, those that stand out by three sigma."""
    if len(coefficients) <= _COEFFICIENTS:
        return coefficients
    return [one for one in coefficients if abs(one["value"]) > 3.0 * one["sigma"]] or coefficients[:1]


def _candidates(candidates: Sequence[Fields]) -> Table:
    real = [one for one in candidates if not one["placebo"]]
    ghosts = [one for one in candidates if one["placebo"]]
    table = _table("candidate, first round", "family", "gain", "t", "p", "beats placebo by t", "gain now")
    for one in [*real[:_CANDIDATES], *ghosts[:_PLACEBOS]]:
        name = f"{one['name']} (ghost)" if one["placebo"] else one["name"]
        beats = "" if one["placebo"] else _number(one["placebo_t"], 3)
        numbers = (_percent(one["gain"]), _number(one["t"], 3), _number(one["p"], 2), beats)
        _row(table, name, "" if one["placebo"] else one["family"], *numbers, _percent(one["gain_now"]))
    return table


def _print_sizes(console: Console, fields: Fields) -> None:
    size = fields["residual"]
    floor = _number(size["noise_floor_nT"], 3)
    low, high = _number(size["noise_floor_low_nT"], 3), _number(size["noise_floor_high_nT"], 3)
    console.print(
        f"residual {_number(size['before_nT'], 3)} -> {_number(size['after_nT'], 3)} nT, held out "
        f"{_number(size['held_out_before_nT'], 3)} -> {_number(size['held_out_after_nT'], 3)} nT; "
        f"noise floor {floor} nT ({low} to {high})",
        soft_wrap=True,
        markup=False,
    )
    left = fields["remaining"]["verdict"]
    if left != fields["verdict"]:
        console.print(f"what is left: {left}, {VERDICTS[left][0]}", soft_wrap=True, markup=False)


def _print_rivals(console: Console, fields: Fields) -> None:
    if not fields["confusion_set"]:
        return
    names = []
    for one in fields["confusion_set"]:
        behind = one.get("behind_t")
        names.append(f"{one['name']} (behind by t {behind:.1f})" if behind else str(one["name"]))
    console.print(f"cannot be told apart: {'; '.join(names)}", soft_wrap=True, markup=False)
    for one in fields["separating"]:
        rivals = " and ".join(one["rivals"])
        console.print(
            f"  {one['start'][:16]} to {one['end'][:16]} would separate {rivals}: "
            f"they differ by {_number(one['difference_nT'], 2)} nT there",
            soft_wrap=True,
            markup=False,
        )


def _print_unscorable(console: Console, unscorable: Sequence[Fields]) -> None:
    for one in unscorable[:_UNSCORABLE]:
        console.print(f"not tried: {one['name']}: {one['reason']}", soft_wrap=True, markup=False)
    if len(unscorable) > _UNSCORABLE:
        console.print(f"  ... and {len(unscorable) - _UNSCORABLE} more; --json lists all", markup=False)


def _next(fields: Fields) -> Iterable[str]:
    """What a person may type next."""
    if fields["command"] == "auto":
        if fields.get("versions"):
            yield "next: inflight reprocess    (undo the last addition: inflight undo)"
    elif fields["effects"]:
        yield f'next: inflight add "{fields["effects"][0]["name"]}"    (all of them: inflight auto)'
    elif fields["verdict"] == "UNKNOWN_EFFECT":
        yield "next: write the effect as a class of your own, and inflight add it"
    else:
        yield "next: nothing to add; inflight reprocess uses the model as it is"


def print_revision(console: Console, fields: Fields) -> None:
    """Print a new version of the model: its numbers, the residual before and after, and what moved."""
    _print_step(console, fields)
    if fields["coefficients"]:
        table = _table("parameter", "value", "", "unit")
        for one in fields["coefficients"]:
            value, sigma = _with_error(one["value"], one["sigma"])
            _row(table, one["name"], value, f"± {sigma}", one["unit"])
        console.print(table)
    moved = fields["moved"]
    if moved:
        table = _table("what else moved", "by", "sigma before", "sigma", "unit", "")
        for one in moved[:_MOVED]:
            numbers = (_number(one[key], 3) for key in ("by", "sigma_before", "sigma"))
            _row(table, one["parameter"], *numbers, one["unit"], one["why"])
        console.print(table)
    if len(moved) > _MOVED:
        console.print(f"  ... and {len(moved) - _MOVED} more; --json lists all", markup=False)
    console.print("next: inflight reprocess    (take it back: inflight undo)", soft_wrap=True, markup=False)


def _print_step(console: Console, fields: Fields) -> None:
    model, error = fields["model"], fields["error"]
    inside, held = error["in_sample_nT"], error["held_out_nT"]
    console.print(
        f"{model['name']} version {model['version']}: {fields['effect']}: residual {inside[0]:.4g} -> "
        f"{inside[1]:.4g} nT, held out {held[0]:.4g} -> {held[1]:.4g} nT",
        soft_wrap=True,
        markup=False,
    )


def _table(*columns: str) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    numeric = {"value", "gain", "t", "p", "retained", "beats placebo by t", "gain now", "by", "sigma"}
    for name in columns:
        # A name is folded before a number is.
        folds = name in ("effect", "candidate, first round", "what else moved", "parameter")
        table.add_column(
            name, justify="right" if name in numeric else "left", overflow="fold", no_wrap=not folds
        )
    return table


def _row(table: Table, *cells: str) -> None:
    from rich.markup import escape

    table.add_row(*map(escape, cells))


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100.0 * value:.1f} %"


def _with_error(value: float, sigma: float) -> tuple[str, str]:
    """Return a value and its error, to the same digit: two of the error's."""
    from math import floor, log10

    if not 0.0 < sigma < float("inf"):
        return f"{value:.4g}", f"{sigma:.2g}"
    place = floor(log10(sigma)) - 1
    if -6 <= place <= 0:
        return f"{value:.{-place}f}", f"{sigma:.{-place}f}"
    digits = max(1, floor(log10(max(abs(value), sigma))) - place)
    return f"{value:.{digits}e}", f"{sigma:.1e}"
