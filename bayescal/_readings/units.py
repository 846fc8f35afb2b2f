"""Units at the door: text in a header becomes a factor, a dimension and, at times, an offset.

Inside the library units are fixed, so nothing here is needed once readings are in. The registry is
our own: the customary one reads g as gram and Hz as an angle rate, while here g is the local
acceleration of gravity, angle and frequency are dimensions of their own, and dps is known. Base
units are s, K (written degC where it is a difference), rad, µg of local g, V, Hz and m.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from pint import UnitRegistry

STANDARD_GRAVITY = 9.80665  # m/s²
ANY = "any"  # in place of a unit: the column is kept in the fixed unit of whatever it is in
EARTH_GRAVITY = (9.7, 9.9)  # m/s²; nowhere on Earth is it outside

_BASE = {
    "s": "time",
    "K": "temperature",
    "rad": "angle",
    "ug": "acceleration in local g",
    "V": "voltage",
    "Hz": "frequency",
    "m": "length",
    "A": "current",
    "Pa": "pressure",
    "uT": "magnetic flux density",
    "count": "count",
}
_DEGREE = math.pi / 180
_DERIVED = {
    "ns": (1e-9, "s"), "us": (1e-6, "s"), "ms": (1e-3, "s"),
    "min": (60.0, "s"), "h": (3600.0, "s"), "day": (86400.0, "s"),
    "degC": (1.0, "K"), "delta_degC": (1.0, "K"), "mK": (1e-3, "K"),
    "degF": (5 / 9, "K"), "delta_degF": (5 / 9, "K"),
    "prad": (1e-12, "rad"), "nrad": (1e-9, "rad"), "urad": (1e-6, "rad"), "mrad": (1e-3, "rad"),
    "deg": (_DEGREE, "rad"), "mdeg": (_DEGREE / 1000, "rad"), "arcmin": (_DEGREE / 60, "rad"),
    "arcsec": (_DEGREE / 3600, "rad"), "mas": (_DEGREE / 3.6e6, "rad"), "rev": (2 * math.pi, "rad"),
    "ng": (1e-3, "ug"), "mg": (1e3, "ug"), "g": (1e6, "ug"),
    "nV": (1e-9, "V"), "uV": (1e-6, "V"), "mV": (1e-3, "V"), "kV": (1e3, "V"),
    "mHz": (1e-3, "Hz"), "kHz": (1e3, "Hz"), "MHz": (1e6, "Hz"),
    "nm": (1e-9, "m"), "um": (1e-6, "m"), "mm": (1e-3, "m"), "cm": (1e-2, "m"), "km": (1e3, "m"),
    "uA": (1e-6, "A"), "mA": (1e-3, "A"),
    "hPa": (1e2, "Pa"), "kPa": (1e3, "Pa"), "mbar": (1e2, "Pa"), "bar": (1e5, "Pa"),
    "nT": (1e-3, "uT"), "mT": (1e3, "uT"), "gauss": (1e2, "uT"),
    "dps": (_DEGREE, "rad/s"), "dph": (_DEGREE / 3600, "rad/s"), "rpm": (math.pi / 30, "rad/s"),
    "percent": (1e-2, ""), "ppm": (1e-6, ""), "ppb": (1e-9, ""),
}  # fmt: skip
_SPELLINGS = {
    "sec": "s", "second": "s", "seconds": "s", "minute": "min", "minutes": "min",
    "hr": "h", "hour": "h", "hours": "h", "days": "day", "kelvin": "K", "celsius": "degC",
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg",
    "volt": "V", "volts": "V", "hertz": "Hz", "counts": "count", "LSB": "count", "lsb": "count",
}  # fmt: skip
_OFFSETS = {"degC": 273.15, "K": 0.0, "degF": 459.67 * 5 / 9}  # K at the unit's zero
_PRETTY = {
    "degC": "°C", "delta_degC": "°C", "degF": "°F", "delta_degF": "°F", "deg": "°", "mdeg": "m°",
    "dps": "°/s", "dph": "°/h", "percent": "%",
}  # fmt: skip
_REWRITTEN = {
    "μ": "u", "µ": "u", "º": "°", "℃": "degC", "℉": "degF", "°C": "degC", "°F": "degF", "°": "deg",
    "″": "arcsec", "′": "arcmin", "%": "percent", "**": "^", "·": "*", "⋅": "*", "∙": "*", "×": "*",
    "−": "-",
}  # fmt: skip
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_EXPONENT = re.compile(r"\^(?:\((-?\d(?:\.\d)?)\)|(-?\d(?:\.\d)?))")
_NAME = re.compile(r"[A-Za-z_]+")


@dataclass(frozen=True)
class _Parsed:
    """A unit understood: `factor` base units, their powers, and the zero of a temperature scale."""

    factor: float
    powers: Mapping[str, float]
    offset: float | None


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
    old, new = _parse(from_unit), _parse(to_unit)
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
    _parse(text)


def same_dimension(a: str, b: str) -> bool:
    """Whether one unit converts to the other (m/s² and g do, by the local gravity).

    Raises:
        InputError: an unknown unit.
    """
    return _power_of_gravity(_parse(a).powers, _parse(b).powers) is not None


def needs_gravity(from_unit: str, to_unit: str) -> bool:
    """Whether the conversion between two units of one dimension uses the local gravity.

    Raises:
        InputError: an unknown unit.
    """
    return bool(_power_of_gravity(_parse(from_unit).powers, _parse(to_unit).powers))


def coefficient_factor(unit: str, slot_unit: str) -> float:
    """What turns a coefficient in its reported unit into internal units.

    That is unit ÷ slot unit in base units (s, K, rad, µg, …). degC is always a difference here.

    Raises:
        InputError: an unknown unit.
    """
    return _parse(unit).factor / _parse(slot_unit).factor


def base_unit(unit: str) -> str:
    """The unit in which a column that no instrument prescribes is kept: base units, or °C.

    Raises:
        InputError: an unknown unit.
    """
    parsed = _parse(unit)
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
    _parse(unit)
    text = _NAME.sub(lambda m: _pretty_name(m[0]), _normal(unit)).replace("*", "·")
    text = re.sub(r"(\w+)\^\(?0\.5\)?", r"√\1", text)
    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    return _EXPONENT.sub(
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


def _normal(text: str) -> str:
    """One spelling for each unit: plain ASCII, known names, ^ for powers.

    Raises:
        InputError: characters or names that no unit here has.
    """
    if not text.strip() or len(text) > 60:
        raise InputError(f"[{text[:60]}] is not a unit: write one such as [degC], [deg/s] or [1]")
    plain = re.sub(r"([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", r"^\1", text.strip()).translate(_SUPERSCRIPTS)
    for seen, meant in _REWRITTEN.items():
        plain = plain.replace(seen, meant)
    plain = re.sub(r"(?:√|sqrt)\(?([A-Za-z]+)\)?", r"\1^0.5", plain)
    plain = re.sub(r"([A-Za-z])([2-4])\b", r"\1^\2", plain)  # m/s2
    plain = "1" if plain == "-" else plain
    plain = _NAME.sub(lambda m: _SPELLINGS.get(m[0], m[0]), plain)
    names = _NAME.findall(plain)
    for name in names:
        if name not in _BASE and name not in _DERIVED:
            raise InputError(f"[{text}] is not a unit known here: {name!r} is none{_near(name)}")
    rest = _NAME.sub("u", _EXPONENT.sub("", plain))
    if re.search(r"[^u1*/() ]|11|1u", rest):
        raise InputError(
            f"[{text}] is not a unit: a unit is made of names, *, /, ^ and brackets, without "
            "numbers in front. Write one such as [ug/mg^2] or [deg/s/degC]"
        )
    return plain


def _near(name: str) -> str:
    known = [*_BASE, *_DERIVED]
    near = [k for k in known if k.lower() == name.lower()]
    near = near or difflib.get_close_matches(name, known, 3)
    return f" (is {' or '.join(near)} meant?)" if near else f" (known are {', '.join(known)})"


@lru_cache(maxsize=512)
def _parse(text: str) -> _Parsed:
    """Understand a unit.

    Raises:
        InputError: it is none.
    """
    plain = _normal(text)
    try:
        quantity = _registry().Quantity(1.0, "") * _registry().parse_expression(plain)
    except Exception as error:  # pint raises whatever its tokenizer and its operators raise
        raise InputError(
            f"[{text}] is not a unit: write one such as [ug/mg^2] or [deg/s/degC]"
        ) from error
    base: Any = quantity.to_base_units()
    powers = {str(name): float(power) for name, power in base.unit_items() if power}
    return _Parsed(float(base.magnitude), powers, _OFFSETS.get(plain))


@cache
def _registry() -> UnitRegistry:
    """The project's own registry; pint is loaded on first use, because `--help` needs none."""
    import pint

    registry = pint.UnitRegistry(None)  # pyright: ignore[reportArgumentType] (None: an empty one)
    for name, dimension in _BASE.items():
        registry.define(f"{name} = [{dimension.replace(' ', '_')}]")
    for name, (factor, unit) in _DERIVED.items():
        registry.define(f"{name} = {factor!r} {'* ' + unit if unit else ''}")
    return registry


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


def _dimension(parsed: _Parsed) -> str:
    if not parsed.powers:
        return "a plain number"
    return " × ".join(
        _BASE[name] if power == 1 else f"({_BASE[name]})^{power:g}"
        for name, power in sorted(parsed.powers.items(), key=lambda item: -item[1])
    )
