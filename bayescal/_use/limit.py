"""A limit as a person writes it: "bias: ±0.5 °/s", "corrected reading: ±0.1 °/s over -20..60 °C"."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from bayescal._core.errors import InputError
from bayescal._data.unit_parsing import normalised, parse

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = rf"(?P<low>{_NUMBER})\s*(?:\.\.|…|to\b)\s*(?P<high>{_NUMBER})"
_TOLERANCE = re.compile(
    rf"(?:(?P<centre>{_NUMBER})?\s*±\s*(?P<half>{_NUMBER})|≤\s*(?P<most>{_NUMBER})|≥\s*(?P<least>{_NUMBER})|{_RANGE})"
    r"(?P<unit>.*)"
)
_OVER = re.compile(rf"(?P<name>.*?)\s*{_RANGE}(?P<unit>.*)")
_AT = re.compile(rf"(?P<name>.+?)\s*=\s*(?P<value>{_NUMBER})(?P<unit>.*)")
_WRITTEN = {"+/-": "±", "+-": "±", "<=": "≤", ">=": "≥", "−": "-", "–": "-"}
FORM = (
    'write "bias: ±0.5 °/s", "noise.white: ≤ 0.1 °/s", "scale: -300..300 ppm" or "corrected reading: ±0.1 °/s over '
    '-20..60 °C"'
)


@dataclass(frozen=True)
class LimitedRange:
    """A range over which a limit holds, or one value: `low` to `high` of the column `name`, "" where it is not said."""

    name: str
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class StatedLimit:
    """A limit on a quantity, as it was written.

    Attributes:
        quantity: "corrected reading", "corrected mean", a slot of the instrument such as "bias", or an unknown.
        low, high: the tolerance limits, in `unit`; infinite where there is none.
        unit: as written; "" for a number without one.
        over: where it holds.
        text: as written.
    """

    quantity: str
    low: float
    high: float
    unit: str
    over: tuple[LimitedRange, ...] = ()
    text: str = ""


def stated_limit(text: str) -> StatedLimit:
    """Understand a limit.

    A quantity, a colon, limits (±A, C ± A, ≤ B, ≥ A, A..B) and their unit; then, if need be, "over" a range of a
    column, "at" a value of one, and more of these after "and": "over temperature -20..60 °C and rate_input
    -90..90 °/s".

    Raises:
        InputError: the text is none; says what is wrong with it.
    """
    quantity, colon, rest = text.rpartition(":")
    if not (colon and quantity.strip() and rest.strip()):
        raise InputError(f"limit {text!r} names no quantity: {FORM}")
    for written, sign in _WRITTEN.items():
        rest = rest.replace(written, sign)
    said, *places = re.split(r"\b(over|at)\b", rest)
    low, high, unit = _tolerance(said.strip(), text)
    over: list[LimitedRange] = []
    for kind, place in zip(places[::2], places[1::2], strict=True):
        over += [_span(kind, one.strip(), text) for one in re.split(r"\band\b", place)]
    if not low < high or (math.isinf(low) and math.isinf(high)):
        raise InputError(f"limit {text!r}: the lower limit {low:g} is not below the upper {high:g}")
    return StatedLimit(quantity.strip(), low, high, unit, tuple(over), text.strip())


def _tolerance(said: str, text: str) -> tuple[float, float, str]:
    found = _TOLERANCE.fullmatch(said)
    if found is None:
        raise InputError(f"limit {text!r}: {said!r} are no limits: {FORM}")
    unit = _unit(found["unit"], text)
    if found["half"]:
        centre, half = float(found["centre"] or 0.0), float(found["half"])
        return centre - half, centre + half, unit
    low, high = found["low"] or found["least"], found["high"] or found["most"]
    return float(low or -math.inf), float(high or math.inf), unit


def _span(kind: str, place: str, text: str) -> LimitedRange:
    if kind == "at":
        if found := _AT.fullmatch(place):
            value = float(found["value"])
            return LimitedRange(found["name"], value, value, _unit(found["unit"], text))
        raise InputError(f"limit {text!r}: write at temperature = 25 °C, not at {place!r}")
    found = _OVER.fullmatch(place)
    if found is None or not -math.inf < float(found["low"]) < float(found["high"]) < math.inf:
        raise InputError(
            f"limit {text!r}: {place!r} is no range: write over -20..60 °C, or over temperature -20..60 °C"
        )
    return LimitedRange(
        found["name"], float(found["low"]), float(found["high"]), _unit(found["unit"], text)
    )


def _unit(said: str, text: str) -> str:
    unit = said.strip().strip("[]").strip()
    if not unit:
        return ""
    try:
        parse(unit)
    except InputError as error:
        raise InputError(f"limit {text!r}: {error}") from None
    return normalised(unit)


@dataclass(frozen=True)
class SpreadOfDevices:
    """Devices of one kind, for one quantity: mean and standard deviation, in `unit`.

    Attributes:
        quantity: whose it is; "" for every limit whose unit it has.
        mean: None for the middle of the limits, which is where a maker aims.
        sd, unit: of the devices.
        text: as written.
    """

    quantity: str
    mean: float | None
    sd: float
    unit: str
    text: str = ""


_DEVICES = re.compile(
    rf"(?:(?P<quantity>.+):)?\s*(?:mean\s+(?P<mean>{_NUMBER})\s*,?\s*)?sd\s+(?P<sd>{_NUMBER})(?P<unit>.*)"
)


def spread_of_devices(text: str) -> SpreadOfDevices:
    """Understand a population as it is written: "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s", "bias: sd 0.2 °/s".

    Raises:
        InputError: the text is none, or its standard deviation is not positive.
    """
    found = _DEVICES.fullmatch(text.strip().replace("−", "-"))
    if found is None:
        raise InputError(
            f'population {text!r}: write "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s" or "bias: sd 0.2 °/s", or give the folder '
            "of a fleet that has a population"
        )
    sd = float(found["sd"])
    if not 0 < sd < math.inf:
        raise InputError(f"population {text!r}: a standard deviation is positive and finite")
    mean = float(found["mean"]) if found["mean"] else None
    return SpreadOfDevices(
        (found["quantity"] or "").strip(), mean, sd, _unit(found["unit"], text), text
    )
