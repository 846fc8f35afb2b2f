"""Units converted, compared and printed.

A file's units become fixed ones when it is read: inside the library nothing is converted. What a unit
means stands in `unit_parsing`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError
from bayescal._readings.unit_parsing import (
    ANY,
    BASE,
    EXPONENT,
    NAME,
    STANDARD_GRAVITY,
    ParsedUnit,
    normalised,
    parse,
)

EARTH_GRAVITY = (9.7, 9.9)  # m/s²; nowhere on Earth is it outside
_PRETTY = {
    "degC": "°C", "delta_degC": "°C", "degF": "°F", "delta_degF": "°F", "deg": "°", "mdeg": "m°",
    "dps": "°/s", "dph": "°/h", "percent": "%",
}  # fmt: skip


def convert(
    values: ArrayLike,
    from_unit: str,
    to_unit: str,
    *,
    local_gravity: float = STANDARD_GRAVITY,
    difference: bool = False,
) -> np.ndarray:
    """Numbers in one unit as numbers in another.

    Temperatures in degC, K and degF are absolute unless a `delta_` unit or `difference` says
    otherwise. Accelerations in m/s² become g (and the reverse) by the local gravity.

    Args:
        values: numbers, any shape.
        from_unit: their unit.
        to_unit: the unit wanted.
        local_gravity: m/s².
        difference: take bare temperatures as differences, as an uncertainty is.

    Raises:
        InputError: an unknown unit, units of different dimensions, a difference of temperatures
            where a temperature is wanted, or a gravity not found on Earth.
    """
    old, new = parse(from_unit), parse(to_unit)
    values = np.array(values, dtype=np.float64)
    power = _power_of_gravity(old.powers, new.powers)
    if power is None:
        raise InputError(
            f"[{from_unit}] cannot be converted to [{to_unit}]: the one is {_dimension(old)}, "
            f"the other {_dimension(new)}. Correct the unit"
        )
    if new.offset is not None and old.offset is None and not difference:
        raise InputError(
            f"[{from_unit}] is a difference of temperatures, [{to_unit}] a temperature: write "
            "[degC], [K] or [degF]"
        )
    if old.offset is not None and new.offset is not None and not difference:
        if old != new:
            values = (values * old.factor + old.offset - new.offset) / new.factor
        return values
    factor = old.factor / new.factor
    if power:
        _check_gravity(local_gravity)
        factor *= (1e6 / local_gravity) ** power
    return values if factor == 1 else values * factor


def check_unit(text: str) -> None:
    """Let a unit pass, or say what is wrong with it.

    Raises:
        InputError: the text is no unit known here.
    """
    parse(text)


def same_dimension(a: str, b: str) -> bool:
    """Whether one unit converts to the other (m/s² and g do, by the local gravity).

    Raises:
        InputError: an unknown unit.
    """
    return _power_of_gravity(parse(a).powers, parse(b).powers) is not None


def needs_gravity(from_unit: str, to_unit: str) -> bool:
    """Whether the conversion between two units of one dimension uses the local gravity.

    Raises:
        InputError: an unknown unit.
    """
    return bool(_power_of_gravity(parse(from_unit).powers, parse(to_unit).powers))


def coefficient_factor(unit: str, slot_unit: str) -> float:
    """What turns a coefficient in its reported unit into internal units.

    That is unit ÷ slot unit in base units (s, K, rad, µg, …). degC is always a difference here.

    Raises:
        InputError: an unknown unit.
    """
    return parse(unit).factor / parse(slot_unit).factor


def base_unit(unit: str) -> str:
    """The unit in which a column that no instrument prescribes is kept: base units, or °C.

    Raises:
        InputError: an unknown unit.
    """
    parsed = parse(unit)
    if parsed.powers == {"m": 1, "s": -2}:
        return "ug"
    if parsed.powers == {"K": 1}:
        return "degC" if parsed.offset is not None else "delta_degC"
    shown = {"degC" if name == "K" else name: power for name, power in parsed.powers.items()}
    above = [_raised(n, p) for n, p in sorted(shown.items()) if p > 0]
    below = [_raised(n, -p) for n, p in sorted(shown.items()) if p < 0]
    return "/".join(["*".join(above) or "1", *below])


def fixed_unit(unit: str) -> str:
    """The unit in which the library keeps a quantity: µg, °/s, rad, °C, s; else base units.

    Raises:
        InputError: an unknown unit.
    """
    base = base_unit(unit)
    return "deg/s" if base == "rad/s" else base


def pretty(unit: str) -> str:
    """A unit as people write it: "deg/s/degC" is "°/s/°C", "ug/mg^2" is "µg/mg²".

    Raises:
        InputError: an unknown unit.
    """
    if unit == ANY:
        return unit
    parse(unit)
    text = NAME.sub(lambda m: _pretty_name(m[0]), normalised(unit)).replace("*", "·")
    text = re.sub(r"(\w+)\^\(?0\.5\)?", r"√\1", text)  # °/√h
    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    return EXPONENT.sub(
        lambda m: m[0].strip("^()").translate(digits) if "." not in m[0] else m[0], text
    )


def unit_label(unit: str) -> str:
    """A unit for people; nothing for a number without one."""
    return pretty(unit) if unit not in ("", "1") else ""


def _pretty_name(name: str) -> str:
    if name in _PRETTY:
        return _PRETTY[name]
    return "µ" + name[1:] if name[0] == "u" else name


def _raised(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:g}"


def _power_of_gravity(old: Mapping[str, float], new: Mapping[str, float]) -> float | None:
    """How often m/s² must become local g to get from one to the other; None if nothing helps."""
    power = old.get("m", 0) - new.get("m", 0)
    for name in {*old, *new}:
        expected = {"m": power, "s": -2 * power, "ug": -power}.get(name, 0)
        if old.get(name, 0) - new.get(name, 0) != expected:
            return None
    if power and not {"s", "ug"} <= {*old, *new}:
        return None
    return power


def _check_gravity(local_gravity: float) -> None:
    low, high = EARTH_GRAVITY
    if not low <= local_gravity <= high:
        raise InputError(
            f"local gravity {local_gravity:g} m/s² is not found on Earth ({low} … {high} m/s²): "
            "give it in m/s², such as 9.80665"
        )


def _dimension(parsed: ParsedUnit) -> str:
    if not parsed.powers:
        return "a plain number"
    return " × ".join(
        BASE[name] if power == 1 else f"({BASE[name]})^{power:g}"
        for name, power in sorted(parsed.powers.items(), key=lambda item: -item[1])
    )
