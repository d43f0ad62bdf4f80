"""What a diagnosis and a revision of the model are printed as: `print_diagnosis`, `print_revision`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from math import floor, hypot, log10
from typing import TYPE_CHECKING, Any

from inflight.cli.command import TextTable, text_table

if TYPE_CHECKING:
    from rich.console import Console

Fields = Mapping[str, Any]
_COLOURS = {
    "FOUND": "green",
    "CONFOUNDED": "yellow",
    "NOT_IDENTIFIABLE": "yellow",
    "UNKNOWN_EFFECT": "red",
    "NOTHING_LEFT": "green",
}
#: Sigmas from which on a difference is told.
_SIGMAS = 3.0
#: Rows shown before the rest is only counted; --json has all.
_CANDIDATES, _PLACEBOS, _UNSCORABLE, _CHANGED, _COEFFICIENTS = 8, 3, 6, 10, 9
#: Part by which two sizes of one residual may differ before it is told why.
_SAME = 0.002
#: Part of the mean square below which nothing is left of a candidate: less than an addition must explain.
_NOTHING = 0.01
#: Heading of the part of an effect that no parameter of the calibration takes up.
_NOT_ABSORBED = "share not absorbed by the calibration"
#: Size from which on a number is written without a power of ten.
_PLAIN = 1e-3
#: Powers of ten up to which an error's digits are written out.
_WHOLE = 3
#: Where a coefficient acts, in plain words.
_AT = {"difference": "difference of both sensors"}
#: Columns set flush right.
_NUMERIC = (
    "value",
    "takes off, nT",
    "alone takes off, nT",
    "takes off what is left, nT",
    "t",
    "p",
    _NOT_ABSORBED,
    "beats placebo by t",
    "by",
)


def print_diagnosis(console: Console, fields: Fields, details: bool = False) -> None:
    """Print the verdict, what is in the residual, its rivals, what remains, and what to type next.

    Parameters
    ----------
    fields : mapping
        `Diagnosis.as_json`; of ``auto`` with ``versions``.
    details : bool
        With all coefficients, the candidates of the first round, and what could not be tried.
    """
    from rich.panel import Panel
    from rich.text import Text

    def line(text: str) -> None:
        console.print(text, soft_wrap=True, markup=False)

    sentence = Text(fields["sentence"], style="default")
    title, colour = _heading(fields)
    console.print(Panel(sentence, title=title, title_align="left", border_style=colour))
    if fields.get("unchanged"):
        line("data, model, settings and software are those of the last diagnosis: this is its answer")
    for text in _later_days(fields):
        line(text)
    if fields.get("entries"):
        _print_entries(console, fields["entries"])
    units = (unit["sentence"] for unit in fields.get("units", ()))
    left = fields["effects"] and fields["remaining"]["verdict"] == "NOTHING_LEFT"
    for text in (
        _sizes_text(fields["residual"]),
        made_from_text(fields),
        *(["what is left: only noise"] if left else []),
        *_at_edges(fields["residual"]),
        *_in_time(fields.get("in_time", ())),
        *_undecided(fields),
        *units,
    ):
        line(text)
    for step in fields.get("versions", ()):
        _print_step(console, step)
    if details:
        _print_details(console, fields)
    else:
        line("--details lists all coefficients and candidates; inflight report --open draws each entry")
    for one in fields.get("problems", ()):
        line(f"{one['message']}. What to do: {one['remedy']}")
    if step_text := _next_step(fields):
        line(step_text)


def _print_details(console: Console, fields: Fields) -> None:
    """Print all coefficients, the candidates of the first round, and what could not be tried."""
    if fields["effects"]:
        console.print(_effects_table(fields["effects"]))
    for one in fields["effects"]:
        if (one["cadence_shift"] or 0.0) > _SIGMAS:
            text = (
                f"{one['name']}: its values are those of samples {one['cadence_s']:.3g} s apart; the "
                f"search's own, of means, are up to {one['cadence_shift']:.1f} sigma from them"
            )
            console.print(text, soft_wrap=True, markup=False)
    residual = fields["residual"]
    sizes = residual["held_out_before_nT"], residual["held_out_after_nT"]
    console.print(_candidates_table(fields["candidates"], sizes))
    for text in _not_tried(fields["unscorable"]):
        console.print(text, soft_wrap=True, markup=False)
    if fields["stopped"]:
        console.print(f"why it stopped: {fields['stopped']}", soft_wrap=True, markup=False)


def _heading(fields: Fields) -> tuple[str, str]:
    """Return title and colour of the box: physics waits while the data are wrong."""
    if fields.get("plumbing"):
        return "MEND THE DATA FIRST", "red"
    from inflight.diagnosis import HEADING

    return dict(HEADING)[fields["verdict"]], _COLOURS[fields["verdict"]]


def made_from_text(fields: Fields) -> str:
    """Return of which model, days and samples all of it is."""
    model, blocks = fields["model"], fields["blocks"]
    span = ""
    if "start" in blocks:
        # A span up to midnight ends the day before.
        last = datetime.fromisoformat(blocks["end"][:19]) - timedelta(seconds=1)
        span = f"{blocks['start'][:10]} to {last.date()}, "
    count = f", {blocks['samples']} samples" if blocks.get("samples") else ""
    return f"{span}model {model['name']} version {model['version']}{count}"


def _sizes_text(residual: Fields) -> str:
    from inflight.diagnosis import fall_text

    names = ("noise_floor", "noise_floor_low", "noise_floor_high")
    size = {name: _number(residual[f"{name}_nT"], 3) for name in names}
    held_out, every = (
        fall_text(residual[f"{which}before_nT"], residual[f"{which}after_nT"]) for which in ("held_out_", "")
    )
    return (
        f"residual {held_out} nT on days not used in the fit ({every} nT on all days); noise floor "
        f"{size['noise_floor']} nT ({size['noise_floor_low']} to {size['noise_floor_high']})"
    )


def _at_edges(residual: Fields) -> Iterator[str]:
    """Yield what is fitted at the edges of the Earth's shadow, which no effect has."""
    if size := residual.get("shadow_edges_nT"):
        yield (
            f"{_number(size, 2)} nT rms more are at the edges of the Earth's shadow, which are known to some "
            "kilometres only: nothing to add"
        )


def _later_days(fields: Fields) -> Iterator[str]:
    """Yield what days that came after a search did to its verdict, and what was not done for them."""
    later = fields.get("later_days")
    if later is None:
        return
    span = later["start"] if later["days"] == 1 else f"{later['start']} to {later['end']}"
    if not later["stands"]:
        yield f"searched anew: {'; '.join(later['reasons'])}"
        return
    low, high = (_number(one, 3) for one in later["usual_nT"])
    sizes = [pick(later["residual_nT"].values()) for pick in (min, max)]
    left = " to ".join(dict.fromkeys(_number(one, 3) for one in sizes))
    yield (
        f"the verdict of the days up to {later['searched']} stands for {span}: it leaves {left} nT, "
        f"and of the days before {low} to {high} nT"
    )
    yield (
        "no candidate was tried on later days, and no value fitted to them: "
        "'inflight diagnose --search' does both"
    )


def _in_time(parameters: Sequence[Fields]) -> Iterator[str]:
    """Yield a line on what is not constant of the calibration; parameters that do the same share one."""
    alike: dict[str, list[str]] = {}
    for each in parameters:
        if each["form"] != "constant":
            times = f" at {', '.join(one[:16] for one in each['at'])}" if each["at"] else ""
            windows = f", windows of {each['window_s'] / 86_400:.3g} d" if each["window_s"] else ""
            gain, runs = _percent(each["gain"]), _percent(each["contiguous_gain"])
            taken = f": takes {gain} off days not used in the fit, one by one ({runs} off runs of them)"
            found = f"{each['form']}{times}{windows}" + (taken if each["gain"] else ", as found above")
            alike.setdefault(found, []).append(each["parameter"])
    for found, names in alike.items():
        yield f"in time: {', '.join(names)}: {found}"


def _print_entries(console: Console, entries: Sequence[Fields]) -> None:
    """Print everything that is in the residual, the largest first, one row each, and what to type.

    A name or a command is never broken, so that it can be copied: where the window is too narrow for a column
    of commands they come below.
    """
    columns = ("in the residual", "takes off, nT", "alone, nT", "how sure", "type")
    rows = [
        (
            each["name"],
            _number(each["takes_off_nT"], 2),
            _number(each["first_in_nT"], 2),
            each["how_sure"],
            each["command"],
        )
        for each in entries
    ]
    widths = (max(map(len, column)) for column in zip(columns, *rows, strict=True))
    fits = sum(widths) + 2 * (len(columns) - 1) <= console.width
    shown = slice(None if fits else -1)
    right = ("takes off, nT", "alone, nT")
    console.print(text_table(columns[shown], [row[shown] for row in rows], right=right, folded=("how sure",)))
    if not fits:
        for *_, command in rows:
            if command:
                console.print(f"  type: {command}", soft_wrap=True, markup=False)


def _effects_table(effects: Sequence[Fields]) -> TextTable:
    """One row a coefficient; effect, family and its scores stand in the first of its rows.

    Of more than `_COEFFICIENTS` coefficients, those beyond three sigma are shown.
    """
    rows = []
    for effect in effects:
        cells = [_number(effect["rms_nT"], 3), _number(effect["t"], 3), _number(effect["flip_p"], 2)]
        cells.append(_percent(effect["retained"]))
        name, family, shown = effect["name"], effect["family"], effect["coefficients"]
        if len(shown) > _COEFFICIENTS:
            shown = [each for each in shown if abs(each["value"]) > 3.0 * each["sigma"]] or shown[:1]
        for each in shown:
            value, sigma = with_error(each["value"], each["sigma"])
            rows.append(
                [
                    name,
                    family,
                    each["name"],
                    value,
                    f"± {sigma}",
                    each["unit"],
                    _AT.get(each["at"], each["at"]),
                    *cells,
                ]
            )
            name, family, cells = "", "", []
        if effect["lag_s"]:
            lag, sigma = with_error(effect["lag_s"], effect["lag_sigma_s"] or 0.0)
            rows.append(["", "", "lag", lag, f"± {sigma}" if effect["lag_sigma_s"] else "", "s"])
    columns = (
        "effect",
        "family",
        "coefficient",
        "value",
        "",
        "unit",
        "at",
        "takes off, nT",
        "t",
        "p",
        _NOT_ABSORBED,
    )
    return text_table(columns, rows, right=_NUMERIC, folded=("effect",))


def _size(gain: float | None, rms: float | None) -> str:
    """Return what takes a part of the mean square of this rms off, in nT: parts of it sum to nothing."""
    return "" if gain is None or rms is None else _number(rms * max(gain, 0.0) ** 0.5, 2)


def _candidates_table(candidates: Sequence[Fields], sizes: tuple[float | None, float | None]) -> TextTable:
    """The best candidates of the first round, and the best placebos; `sizes` are rms before and after, nT."""
    real = [each for each in candidates if not each["placebo"]]
    placebos = [each for each in candidates if each["placebo"]]
    rows = []
    # One row a candidate, best first; of placebos, what chance does.
    for each in [*real[:_CANDIDATES], *placebos[:_PLACEBOS]]:
        name, family, beats = f"{each['name']} (placebo: shifted in time)", "", ""
        if not each["placebo"]:
            name, family, beats = each["name"], each["family"], _number(each["placebo_t"], 3)
        scores = (_size(each["gain"], sizes[0]), _number(each["t"], 3), _number(each["p"], 2), beats)
        rows.append((name, family, *scores, _size(each["gain_now"], sizes[1])))
    columns = (
        "candidate, first round",
        "family",
        "alone takes off, nT",
        "t",
        "p",
        "beats placebo by t",
        "takes off what is left, nT",
    )
    return text_table(columns, rows, right=_NUMERIC, folded=columns[:1])


def _undecided(fields: Fields) -> Iterator[str]:
    """Yield which candidates cannot be told apart, where they differ, and which could not be tried."""
    names = []
    for rival in fields["confusion_set"]:
        behind = rival.get("behind_t")
        names.append(f"{rival['name']} (behind by t {behind:.1f})" if behind else str(rival["name"]))
    if names:
        yield f"cannot be told apart: {'; '.join(names)}"
        pairs: dict[str, list[Fields]] = {}
        for span in fields["separating"]:
            pairs.setdefault(" and ".join(span["rivals"]), []).append(span)
        for rivals, spans in pairs.items():
            times = ", ".join(f"{span['start'][:16].replace('T', ' ')}" for span in spans)
            hours = _hours(spans[0])
            most = _number(max(span["difference_nT"] for span in spans), 2)
            yield (
                f"  {rivals} differ most in the {hours} from {times} UTC, by up to {most} nT rms: more such "
                "times, or less noise, would tell them apart"
            )


def _hours(span: Fields) -> str:
    """Return how long a span is, in words."""
    start, end = (datetime.fromisoformat(span[edge][:19]) for edge in ("start", "end"))
    return f"{(end - start) / timedelta(hours=1):.3g} h"


def _not_tried(unscorable: Sequence[Fields]) -> Iterator[str]:
    """Yield which candidates could not be tried, and why."""
    for candidate in unscorable[:_UNSCORABLE]:
        yield f"not tried: {candidate['name']}: {candidate['reason']}"
    if len(unscorable) > _UNSCORABLE:
        yield f"  ... and {len(unscorable) - _UNSCORABLE} more; --json lists all"


def only_moves_with(found: Fields, coordinates: Sequence[str]) -> str:
    """Return why a diagnosis does not name coordinates that a comparison names; empty when it names all.

    Parameters
    ----------
    found : mapping
        `Diagnosis.as_json`.
    coordinates : sequence of str
        What the residual goes with, as a comparison calls it, strongest first.
    """
    named = {channel for one in found["effects"] for channel in one["channels"]}
    if not named:
        return ""
    now: dict[str, float] = {}
    for one in found["candidates"]:
        for channel in () if one["placebo"] else one["channels"]:
            now[channel] = max(now.get(channel, 0.0), one["gain_now"] or 0.0)
    clean = found["remaining"]["verdict"] == "NOTHING_LEFT"
    others = [one for one in coordinates if one not in named and one.replace(" ", "_") not in named]
    told = [one for one in others if clean or now.get(one.replace(" ", "_"), 1.0) < _NOTHING]
    if not told:
        return ""
    verb, them = ("moves", "it") if len(told) == 1 else ("move", "them")
    return (
        f"{' and '.join(told)} only {verb} with {' and '.join(sorted(named))}: with what was found in the "
        f"model, nothing that is left goes with {them}"
    )


#: Why the first effect may be another one, by how sure it is.
_DOUBTS = {
    "rivals": "causes look alike: it may be another of them",
    "stand-in": "it may be a part of another cause, as told above",
}


def _next_step(fields: Fields) -> str:
    """Return what a person may type next."""
    if fields.get("plumbing"):
        return "next: mend the mission file as told above, then inflight ingest and inflight diagnose"
    if fields["command"] == "auto" and fields.get("versions"):
        return "next: inflight reprocess, then inflight compare    (take the last one back: inflight undo)"
    entries = [each for each in fields.get("entries", ()) if not each["followed"]]
    followed = {each["name"] for each in fields.get("entries", ()) if each["followed"]}
    effects = [each for each in fields["effects"] if each["name"] not in followed]
    first = entries[0]["command"] if entries else ""
    unknown = [each["command"] for each in entries if each["status"] == "unknown"]
    what = ""
    if first.startswith(("inflight refit", "inflight set", "mission.yaml")):
        what = first
    elif effects:
        best = effects[0]
        doubt = _DOUBTS.get(best["status"], "")
        # The numbers are those of all of them together: one alone has others.
        numbers = ", with the numbers above" if len(effects) > 1 else ""
        every = f"all of them{numbers}: inflight auto"
        what = f'inflight add "{best["name"]}"    ({doubt or every})'
    elif unknown and unknown[0] != "inflight compare":
        what = f"{unknown[0]}    (its cause stays to be found)"
    if what:
        return f"next: {what}"
    if fields["verdict"] == "UNKNOWN_EFFECT":
        return "next: write the effect as a class of your own, and inflight add it"
    return "next: nothing to add; inflight compare, then inflight release VERSION"


def print_revision(console: Console, fields: Fields) -> None:
    """Print a new version of the model: its numbers, the residual before and after, and what changed.

    Parameters
    ----------
    fields : mapping
        `Revision.as_json`.
    """
    from inflight.diagnosis import WHY_MOVED, quantity

    _print_step(console, fields)
    rows: list[tuple[str, ...]] = []
    if fields["coefficients"]:
        for each in fields["coefficients"]:
            rows.append((each["name"], quantity(each["value"], each["sigma"], each["unit"])))
        columns = ("parameter", "value")
        console.print(text_table(columns, rows, right=_NUMERIC, folded=("parameter",)))
    names = ", ".join(fields["empirical"])
    empirical = f"empirical, causes not known: {names}" if names else ""
    for text in (fields.get("told_with_others"), empirical, fields["told_by_difference"]):
        if text:
            console.print(text, soft_wrap=True, markup=False)
    changed = fields["moved"]
    if changed:
        rows = []
        for each in changed[:_CHANGED]:
            by = quantity(each["by"], each["sigma"], each["unit"])
            rows.append((each["parameter"], by, WHY_MOVED.get(each["why"], each["why"])))
        heads = ("what else moved", "by", "")
        console.print(text_table(heads, rows, right=_NUMERIC, folded=heads[:1]))
    if len(changed) > _CHANGED:
        console.print(f"  ... and {len(changed) - _CHANGED} more; --json lists all", markup=False)
    if fields["not_justified"]:
        why = f"not justified: {fields['not_justified']}. next: inflight undo"
        console.print(why, style="yellow", soft_wrap=True, markup=False)
        return
    if fields["residual_rose"] and fields["command"] != "undo":
        why = "more is left with this than before. next: inflight undo"
        console.print(why, style="yellow", soft_wrap=True, markup=False)
        return
    line = "next: inflight reprocess, then inflight compare    (take it back: inflight undo)"
    console.print(line, soft_wrap=True, markup=False)


def _print_step(console: Console, fields: Fields) -> None:
    model = fields["model"]
    console.print(
        f"{model['name']} version {model['version']}: {fields['effect']}", soft_wrap=True, markup=False
    )
    console.print(f"  {change_text(fields['error'])}", soft_wrap=True, markup=False)
    told, now = fields["told_before_nT"], fields["error"]["held_out_nT"][0]
    if told and now and abs(told / now - 1.0) > _SAME:
        console.print(
            f"  (version {model['parent']} was told with {told:.4g} nT when it was made: its equations were "
            f"those about the version before; made about its own numbers it leaves {now:.4g} nT)",
            soft_wrap=True,
            markup=False,
        )


def change_text(change: Fields) -> str:
    """Return what a version did to the residual (`Revision.change`) in words."""
    held, above, floor = change["held_out_nT"], change["above_floor_nT"], change["noise_floor_nT"]
    inside = change["in_sample_nT"]
    text = f"residual {held[0]:.4g} -> {held[1]:.4g} nT on days not used in the fit"
    text += f" ({inside[0]:.4g} -> {inside[1]:.4g} nT on all days)"
    if floor is None:
        return text
    return f"{text}; above the noise floor of {floor:.4g} nT: {above[0]:.2g} -> {above[1]:.2g} nT"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100.0 * value:.1f} %"


def with_error(value: float, sigma: float) -> tuple[str, str]:
    """Return a value and its error, to the same digit: two of the error's."""
    if not 0.0 < sigma < float("inf"):
        return f"{value:.4g}", f"{sigma:.2g}"
    place = floor(log10(sigma)) - 1
    if -10 <= place <= _WHOLE and max(abs(value), sigma) >= _PLAIN:
        digits = max(-place, 0)
        return f"{round(value, -place) + 0.0:.{digits}f}", f"{round(sigma, -place):.{digits}f}"
    digits = max(1, floor(log10(max(abs(value), sigma))) - place)
    return f"{value:.{digits}e}", f"{sigma:.1e}"


def differences_from_diagnosis(found: Fields | None, fields: Fields) -> str:
    """Return how numbers of an effect that was added differ from those of the diagnosis that named it.

    A diagnosis fits all that it found together; an effect added alone stands for what of the others goes with
    it, too. Empty where the numbers agree, or the diagnosis is of another version.
    """
    from inflight.diagnosis import quantity

    effects = (found or {}).get("effects", ())
    own = next((one for one in effects if fields["effect"] == f"add {one['name']}"), None)
    if own is None or found is None or found["model"]["version"] != fields["model"]["parent"]:
        return ""
    others = [one["name"] for one in effects if one is not own]
    told = {one["name"]: one for one in own["coefficients"]}
    apart = []
    for now in fields["coefficients"]:
        was = told.get(now["name"].rpartition(".")[2])
        if was is None or was["unit"] != now["unit"]:
            continue
        if abs(now["value"] - was["value"]) > _SIGMAS * hypot(now["sigma"], was["sigma"]):
            apart.append(f"{was['name']} {quantity(was['value'], was['sigma'], was['unit'])}")
    if not (apart and others):
        return ""
    return (
        f"the diagnosis has {', '.join(apart)}: with {' and '.join(others)} beside it. Alone it stands for "
        "what of them goes with it, too; its own number is the one with all of them: inflight undo, then "
        "inflight auto"
    )
