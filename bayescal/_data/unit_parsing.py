"""The units that are known, and what the text of a unit means: a factor, powers of base units, an offset.

The units are our own: customary tables read g as gram and Hz as an angle rate, while here g is the local
acceleration of gravity, angle and frequency are dimensions of their own, and dps is known. Base units are
s, K (written degC where it is a difference), rad, µg of local g, V, Hz and m.
"""

from __future__ import annotations

import ast
import difflib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

from bayescal._core.errors import InputError

STANDARD_GRAVITY = 9.80665  # m/s²
ANY = "any"  # in place of a unit: the column is kept in the fixed unit of whatever it is in

BASE = {
    "s": "time",
    "K": "temperature",
    "rad": "angle",
    "ug": "acceleration in local g",
    "V": "voltage",
    "Hz": "frequency",
    "m": "length",
    "A": "current",
    "ohm": "resistance",
    "W": "power",
    "Pa": "pressure",
    "uT": "magnetic flux density",
    "count": "count",
}
_DEGREE = math.pi / 180
DERIVED = {
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
    "Gal": (1e-2, "m/s**2"), "mGal": (1e-5, "m/s**2"), "uGal": (1e-8, "m/s**2"),
    "nm": (1e-9, "m"), "um": (1e-6, "m"), "mm": (1e-3, "m"), "cm": (1e-2, "m"), "km": (1e3, "m"),
    "kohm": (1e3, "ohm"), "Mohm": (1e6, "ohm"), "mW": (1e-3, "W"),
    "uA": (1e-6, "A"), "mA": (1e-3, "A"),
    "hPa": (1e2, "Pa"), "kPa": (1e3, "Pa"), "mbar": (1e2, "Pa"), "bar": (1e5, "Pa"),
    "nT": (1e-3, "uT"), "mT": (1e3, "uT"), "gauss": (1e2, "uT"),
    "mdps": (_DEGREE / 1000, "rad/s"),
    "dps": (_DEGREE, "rad/s"), "dph": (_DEGREE / 3600, "rad/s"), "rpm": (math.pi / 30, "rad/s"),
    "percent": (1e-2, ""), "ppm": (1e-6, ""), "ppb": (1e-9, ""),
}  # fmt: skip
SPELLINGS = {
    "sec": "s", "second": "s", "seconds": "s", "minute": "min", "minutes": "min",
    "hr": "h", "hour": "h", "hours": "h", "days": "day", "kelvin": "K", "celsius": "degC",
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg",
    "arcseconds": "arcsec", "arcsecond": "arcsec", "arcminutes": "arcmin", "gal": "Gal", "mgal": "mGal",
    "msec": "ms", "usec": "us",
    "VDC": "V", "Vdc": "V", "VAC": "V", "mVDC": "mV", "uVDC": "uV", "ohms": "ohm", "kohms": "kohm", "Ohm": "ohm",
    "kOhm": "kohm", "Ohms": "ohm", "OHM": "ohm", "Volt": "V", "Volts": "V", "VOLT": "V", "Celsius": "degC",
    "DegC": "degC", "DEGC": "degC", "Degrees": "deg", "Seconds": "s", "Sec": "s", "Kelvin": "K",
    "volt": "V", "volts": "V", "hertz": "Hz", "counts": "count", "LSB": "count", "lsb": "count",
}  # fmt: skip
_OFFSETS = {"degC": 273.15, "K": 0.0, "degF": 459.67 * 5 / 9}  # K at the unit's zero
_REWRITTEN = {
    "μ": "u", "µ": "u", "º": "°", "℃": "degC", "℉": "degF", "°C": "degC", "°F": "degF", "°": "deg",
    "%RH": "%", "%rH": "%", "%rh": "%", "% RH": "%", "\u03a9": "ohm", "\u2126": "ohm",
    "″": "arcsec", "′": "arcmin", "”": "arcsec", "’": "arcmin",
    "''": "arcsec", '"': "arcsec", "'": "arcmin", "%": "percent", "**": "^", "·": "*", "⋅": "*", "∙": "*", "×": "*",
    "−": "-",
}  # fmt: skip
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
EXPONENT = re.compile(r"\^(?:\((-?\d(?:\.\d)?)\)|(-?\d(?:\.\d)?))")
NAME = re.compile(r"[A-Za-z_]+")


@dataclass(frozen=True)
class ParsedUnit:
    """A unit understood.

    Attributes:
        factor: in base units.
        powers: of the base units.
        offset: zero of a temperature scale, K.
        names: that it is written with, each with its power, whether or not they cancel.
    """

    factor: float
    powers: Mapping[str, float]
    offset: float | None
    names: tuple[tuple[str, float], ...]


@lru_cache(maxsize=512)
def parse(text: str) -> ParsedUnit:
    """Understand a unit.

    Raises:
        InputError: it is none.
    """
    plain = normalised(text)
    try:
        names = tuple(_factors(ast.parse(_as_python(plain), mode="eval").body))
        factor, powers = _in_base(names)
    except (SyntaxError, ValueError, OverflowError) as error:
        raise InputError(
            f"[{text}] is not a unit: write one such as [ug/mg^2] or [deg/s/degC]"
        ) from error
    return ParsedUnit(factor, powers, _OFFSETS.get(plain), names)


def _as_python(plain: str) -> str:
    """A unit as a Python expression: what stands side by side is multiplied, ^ is a power."""
    side_by_side = r"(?<=[\w)])\s*(?=\()|(?<=\))\s*(?=\w)|(?<=\w)\s+(?=\w)|(?<=\d)(?=[A-Za-z])"
    return re.sub(side_by_side, "*", plain).replace("^", "**").strip()


def _factors(part: ast.expr) -> list[tuple[str, float]]:
    """The names in a parsed product, quotient or power, each with its power."""
    match part:
        case ast.Name(id=name) if name in BASE or name in DERIVED:
            return [(name, 1.0)]
        case ast.Constant(value=1):
            return []
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            sign = 1.0 if isinstance(op, ast.Mult) else -1.0
            return [*_factors(left), *((name, sign * power) for name, power in _factors(right))]
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            power = float(ast.literal_eval(right))
            return [(name, power * own) for name, own in _factors(left)]
    raise ValueError("no product of units")


def _in_base(product: Iterable[tuple[str, float]]) -> tuple[float, dict[str, float]]:
    """A product of known names in base units: a factor, and their powers."""
    factor, powers = 1.0, dict[str, float]()
    for name, power in product:
        own, base = DERIVED.get(name, (1.0, name))
        factor *= own**power
        inner = _factors(ast.parse(base, mode="eval").body) if base else []
        for unit, base_power in inner:
            powers[unit] = powers.get(unit, 0.0) + power * base_power
    return factor, {name: power for name, power in powers.items() if power}


def normalised(text: str) -> str:
    """One spelling for each unit: plain ASCII, known names, ^ for powers.

    Raises:
        InputError: characters or names that no unit here has.
    """
    if not text.strip() or len(text) > 60:
        raise InputError(f"[{text[:60]}] is not a unit: write one such as [degC], [deg/s] or [1]")
    plain = re.sub(r"([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", r"^\1", text.strip()).translate(_SUPERSCRIPTS)  # m/s²
    for seen, meant in _REWRITTEN.items():
        plain = plain.replace(seen, meant)
    plain = re.sub(r"(?:√|sqrt)\(?([A-Za-z]+)\)?", r"\1^0.5", plain)  # deg/√h
    plain = re.sub(r"([A-Za-z])([2-4])\b", r"\1^\2", plain)  # m/s2
    plain = "1" if plain == "-" else plain
    plain = NAME.sub(lambda m: SPELLINGS.get(m[0], m[0]), plain)
    names = NAME.findall(plain)
    for name in names:
        if name not in BASE and name not in DERIVED:
            raise InputError(f"[{text}] is not a unit known here: {name!r} is none{_near(name)}")
    # Without its powers, each name as "u", a unit may hold operators and a lone 1, as in 1/degC.
    rest = NAME.sub("u", EXPONENT.sub("", plain))
    if re.search(r"[^u1*/() ]|11|1u", rest):
        raise InputError(
            f"[{text}] is not a unit: a unit is made of names, *, /, ^ and brackets, without "
            "numbers in front. Write one such as [ug/mg^2] or [deg/s/degC]"
        )
    return plain


_OTHERS = {"C": "the coulomb", "F": "the farad", "S": "the siemens"}  # no units here
_MEANT = {"C": "degC", "F": "degF", "S": "s"}


def _near(name: str) -> str:
    if name in _OTHERS:
        return f" ({name!r} is {_OTHERS[name]}; is {_MEANT[name]} meant?)"
    known = [*BASE, *DERIVED]
    near = [k for k in known if k.lower() == name.lower()]
    near = near or difflib.get_close_matches(name, known, 3)
    return f" (is {' or '.join(near)} meant?)" if near else f" (known are {', '.join(known)})"
