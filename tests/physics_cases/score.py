"""What a diagnosis is worth: its JSON against the truth of one case. Pure; nothing is read or run."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import pint

Json = Mapping[str, Any]

VERDICTS = ("FOUND", "CONFOUNDED", "NOT_IDENTIFIABLE", "UNKNOWN_EFFECT", "NOTHING_LEFT")
FAMILIES = (
    "sensor",
    "temperature",
    "ageing",
    "torquer",
    "solar",
    "battery",
    "camera",
    "current",
    "day_night",
    "sun_angle",
    "remanent",
    "induced",
    "eddy",
    "nonlinearity",
    "clock",
    "bias",
    "offset_step",
    "tone",
    "hysteresis",
    "unknown",
)
#: Sigmas a coefficient may be off; with more than three of them the largest is allowed a little more.
PULL, PULL_OF_MANY = 3.0, 3.5
#: Parts a lag and a period may be off, and the held-out error above the floor.
LAG, PERIOD, FLOOR = 0.20, 0.01, 0.05
#: Channels of the geometry: an effect that follows them may name no channel at all.
GEOMETRY = frozenset({"sunlit", "sun_direction", "sunlight", "sun_phase", "orbit_phase", "local_time"})


@dataclass(frozen=True)
class Score:
    """One line of the table; None where a question does not arise.

    Attributes
    ----------
    verdict_allowed : bool
        The verdict is one of those that are right about the case.
    family : bool or None
        Every hidden effect is named, or is in the confusion set; one the data cannot show is among the
        confused or the unscorable.
    channel : bool or None
        Every hidden effect that follows channels is named with them, or is in the confusion set.
    pull : float or None
        Largest deviation of a coefficient, in its own sigmas.
    coefficients, lag, period, floor : bool or None
        Within 3 sigma; within 20 % or 3 sigma; within 1 %; within 5 % of the noise.
    false_additions : tuple of str
        Effects that are neither true nor confused with a true one.
    confident_wrong : bool
        A cause is named, and an effect that is said to be sure is none of the true ones.
    """

    scenario: str
    seed: int
    verdict: str
    verdict_allowed: bool
    family: bool | None
    channel: bool | None
    pull: float | None
    coefficients: bool | None
    lag: bool | None
    period: bool | None
    floor_ratio: float | None
    floor: bool | None
    false_additions: tuple[str, ...]
    confident_wrong: bool

    @property
    def honest(self) -> bool:
        """True when nothing wrong is claimed and the truth is named, or named among rivals."""
        return not self.confident_wrong and self.family is not False

    @property
    def passed(self) -> bool:
        """True when every question that arises is answered rightly."""
        asked = (self.family, self.channel, self.coefficients, self.lag, self.period, self.floor)
        return self.verdict_allowed and self.honest and not self.false_additions and False not in asked

    def as_json(self) -> dict[str, Any]:
        """Return the score as plain JSON."""
        return asdict(self) | {"honest": self.honest, "passed": self.passed}


def score(truth: Json, told: Json) -> Score:
    """Return the score of a diagnosis.

    Parameters
    ----------
    truth : mapping
        As `orbiter.case` writes it.
    told : mapping
        The JSON of ``inflight diagnose --json``.
    """
    verdict, effects = str(told["verdict"]), list(told.get("effects") or [])
    hidden = [true for true in truth["effects"] if true["identifiable"]]
    named = [next((one for one in effects if is_named(true, one, told)), None) for true in hidden]
    pairs = [(true, one) for true, one in zip(hidden, named, strict=True) if one is not None]
    wrong = [one for one in effects if not any(is_named(true, one, told) for true in truth["effects"])]
    excused = _confused(truth, told) if any(_status(one, told) == "rivals" for one in effects) else 0
    pull = _largest_pull(pairs)
    ratio = _floor_ratio(truth, told) if hidden and verdict == "FOUND" else None
    return Score(
        scenario=str(truth["scenario"]),
        seed=int(truth["seed"]),
        verdict=verdict,
        verdict_allowed=verdict in truth["verdicts"],
        family=_family(truth, hidden, named, told),
        channel=_channel(hidden, effects, told),
        pull=pull[0] if pull else None,
        coefficients=pull[1] if pull else None,
        lag=_all(_lag(true, one) for true, one in pairs if "lag_s" in true),
        period=_all(_period(true, told) for true in hidden if true.get("unrecorded")),
        floor_ratio=ratio,
        floor=None if ratio is None else ratio <= 1 + FLOOR,
        false_additions=tuple(_label(one) for one in wrong[excused:]),
        confident_wrong=verdict in ("FOUND", "CONFOUNDED")
        and any(_status(one, told) == "sure" for one in wrong),
    )


def _status(effect: Json, told: Json) -> str:
    """Return how sure an effect of the diagnosis is, as its entry says."""
    for entry in told.get("entries") or []:
        if entry["name"] == effect["name"]:
            return str(entry["status"])
    return "sure" if told["verdict"] == "FOUND" else "rivals"


def base_channels(channels: Sequence[str] | str | None) -> set[str]:
    """Return the plain channels behind derived names such as ``a@lag=100s*b`` and ``c~3``."""
    listed = [channels] if isinstance(channels, str) else list(channels or [])
    parts = [part for name in listed for part in str(name).split("*")]
    return {re.split(r"[@~\[]", part)[0].rsplit(".", 1)[-1] for part in parts if part}


def is_named(true: Json, effect: Json, told: Json) -> bool:
    """Tell whether an effect of the diagnosis is a hidden one: its family and its channels."""
    own, family = base_channels(effect.get("channels")), effect.get("family")
    if true.get("number"):
        return _is_number(true, effect.get("name"))
    if true.get("held") and true["held"] in (effect.get("model_effects") or ()):
        return True
    if true.get("product"):
        # One factor alone is half an answer: right only where the rest is said to be unknown.
        rest = (told.get("remaining") or {}).get("verdict") == "UNKNOWN_EFFECT"
        return own == set(true["channels"]) or (rest and bool(own) and own <= set(true["channels"]))
    if true.get("unrecorded"):
        return family in ("unknown", "tone") and _period(true, told, effect)
    return family in true["families"] and _same_channels(true, own)


def _is_number(true: Json, name: Any) -> bool:
    """Tell whether something is called by the number of the model that is wrong."""
    return str(name).split("@", maxsplit=1)[0] == str(true["number"])


def _same_channels(true: Json, own: set[str]) -> bool:
    """Tell whether channels are the true ones, where the truth follows any."""
    wanted = set(true["channels"])
    return not wanted or own == wanted or (wanted <= GEOMETRY and own <= GEOMETRY)


def in_set(true: Json, entries: Sequence[Any], families_suffice: bool = False) -> bool:
    """Tell whether a hidden effect is among the entries of a confusion set or of the unscorable ones."""
    return any(_is_entry(true, entry, families_suffice) for entry in entries)


def _is_entry(true: Json, entry: Any, families_suffice: bool) -> bool:
    if true.get("number"):
        return _is_number(true, entry.get("name") if isinstance(entry, Mapping) else entry)
    if isinstance(entry, Mapping):
        family, own = entry.get("family"), base_channels(entry.get("channels") or entry.get("channel"))
        return family in true["families"] and (families_suffice or _same_channels(true, own))
    words = set(re.findall(r"\w+", str(entry)))
    if true["channels"] and not families_suffice:
        return set(true["channels"]) <= words
    return bool(words & {*true["families"], *true["channels"], *true["name"].split()})


def _confused(truth: Json, told: Json) -> int:
    """Return how many wrong effects are excused: as many as hidden ones stand in the confusion set."""
    return sum(in_set(true, told.get("confusion_set") or []) for true in truth["effects"])


def _family(truth: Json, hidden: Sequence[Json], named: Sequence[Any], told: Json) -> bool | None:
    if not truth["effects"]:
        return None
    rivals = told.get("confusion_set") or []
    silent = [*rivals, *(told.get("unscorable") or [])]
    seen = [
        one is not None
        or _is_wrong_number(true, told)
        or in_set(true, rivals)
        or (bool(set(true["families"]) & {"unknown"}) and _is_unknown(true, told))
        for true, one in zip(hidden, named, strict=True)
    ]
    blind = [in_set(true, silent, True) for true in truth["effects"] if not true["identifiable"]]
    return all([*seen, *blind])


def _is_wrong_number(true: Json, told: Json) -> bool:
    """Tell whether an entry says that the model's own number is wrong which is."""
    held = true.get("held")
    return bool(held) and any(one["name"].startswith(f"{held}.") for one in told.get("entries") or [])


def _is_unknown(true: Json, told: Json) -> bool:
    """Tell whether the diagnosis describes an effect of no library: a period, or one of its channels."""
    if told["verdict"] != "UNKNOWN_EFFECT":
        return False
    if true.get("unrecorded"):
        return _period(true, told)
    own = base_channels((told.get("signature") or {}).get("channel"))
    return not true["channels"] or not own or bool(own & set(true["channels"]))


def _channel(hidden: Sequence[Json], effects: Sequence[Json], told: Json) -> bool | None:
    following = [true for true in hidden if set(true["channels"]) - GEOMETRY]
    rivals = told.get("confusion_set") or []
    return _all(
        any(
            _is_number(true, one.get("name"))
            if true.get("number")
            else base_channels(one.get("channels")) & set(true["channels"])
            for one in effects
        )
        or in_set(true, rivals)
        or _is_wrong_number(true, told)
        or _is_unknown(true, told)
        for true in following
    )


def _all(answers: Any) -> bool | None:
    listed = list(answers)
    return all(listed) if listed else None


def _largest_pull(pairs: Sequence[tuple[Json, Json]]) -> tuple[float, bool] | None:
    """Return the largest deviation in sigmas, and whether it is allowed; None without comparable numbers."""
    worst: list[tuple[float, bool]] = []
    for true, effect in pairs:
        pulls = [p for one in true["coefficients"] if (p := _pull(one, effect)) is not None]
        if pulls:
            worst.append((max(pulls), max(pulls) <= (PULL if len(pulls) <= 3 else PULL_OF_MANY)))
    return (max(p for p, _ in worst), all(ok for _, ok in worst)) if worst else None


def _pull(true: Json, effect: Json) -> float | None:
    """Return by how many sigmas the diagnosis is off in one true coefficient; None when it has none such."""
    fitting = [
        (one, factor)
        for one in with_amplitudes(effect.get("coefficients") or [])
        if _axis(one["name"]) == true["axis"]
        and (factor := unit_factor(str(one["unit"]), true["unit"])) is not None
    ]
    named = [pair for pair in fitting if true["quantity"] in pair[0]["name"]] or fitting
    pulls = [
        _deviation(one["value"] * factor, one.get("sigma"), factor, true["value"]) for one, factor in named
    ]
    return min(pulls) if pulls else None


def with_amplitudes(coefficients: Sequence[Json]) -> list[Json]:
    """Return coefficients, and of each cosine ``[cx1]`` and sine ``[sx1]`` their amplitude ``[x]``."""
    cosines = {m[1]: one for one in coefficients if (m := re.search(r"\[c([xyz])1\]", one["name"]))}
    sines = {m[1]: one for one in coefficients if (m := re.search(r"\[s([xyz])1\]", one["name"]))}
    made = []
    for axis in sorted(set(cosines) & set(sines)):
        c, s = cosines[axis], sines[axis]
        size = math.hypot(c["value"], s["value"])
        spread = math.hypot(c["value"] * (c.get("sigma") or 0.0), s["value"] * (s.get("sigma") or 0.0))
        told = {"name": f"amplitude[{axis}]", "value": size, "sigma": spread / max(size, 1e-300)}
        made.append({**told, "unit": c["unit"], "at": c.get("at")})
    return [*coefficients, *made]


def _deviation(value: float, sigma: float | None, factor: float, true: float) -> float:
    """Return a deviation in sigmas; a number without sigma is infinitely sure of itself."""
    return abs(value - true) / (sigma * factor) if sigma else float("inf")


def _axis(name: str) -> str:
    found = re.search(r"\[(\w+)\]", name)
    return found[1] if found else ""


@lru_cache(maxsize=1)
def _units() -> pint.UnitRegistry:
    return pint.UnitRegistry()


def unit_factor(found: str, wanted: str) -> float | None:
    """Return what a number in one unit is multiplied by for the other; None when they do not convert."""
    units = _units()
    try:
        # A coefficient is per degree of difference, which is a kelvin.
        plain = [re.sub(r"\b(degC|celsius|°C)\b", "K", unit) for unit in (found, wanted)]
        return float(units.Quantity(1.0, plain[0]).to(plain[1]).magnitude)
    except (pint.PintError, AttributeError, TypeError, ValueError):
        return None


def _lag(true: Json, effect: Json) -> bool:
    lag = effect.get("lag_s")
    written = re.search(r"@lag=([\d.eE+-]+)\s*s", " ".join(map(str, effect.get("channels") or [])))
    lag = float(written[1]) if lag is None and written else lag
    sigma = float(effect.get("lag_sigma_s") or 0.0)
    return lag is not None and abs(float(lag) - true["lag_s"]) <= max(LAG * true["lag_s"], 3 * sigma)


def _period(true: Json, told: Json, effect: Json | None = None) -> bool:
    """Tell whether a period is told that is the true one."""
    signatures = [told.get("signature"), (told.get("remaining") or {}).get("signature"), effect]
    periods = [one["period_s"] for one in signatures if one and one.get("period_s")]
    return any(abs(period / true["period_s"] - 1) <= PERIOD for period in periods)


def _floor_ratio(truth: Json, told: Json) -> float | None:
    after = (told.get("residual") or {}).get("held_out_after_nT")
    # Where nature's own fluctuations are the floor, what they are is measured, not put in.
    floor = truth["floor_nT"] or told["residual"]["noise_floor_nT"]
    return None if after is None else float(after) / float(floor)


def _label(effect: Json) -> str:
    channels = "+".join(sorted(base_channels(effect.get("channels"))))
    return f"{effect.get('family')}:{channels or effect.get('name')}"
