"""Known units, parsing of a unit to its factor, exponents of base units and offset, and conversion between units.

Unlike usual unit libraries, which read g as gram and Hz as an angular rate, g is the local acceleration of gravity
here, angle and frequency are dimensions of their own, and dps (°/s) is known; the gram is `gram`. Base units are s, K
(written degC for differences), rad, µg of local g, V, Hz, m, kg and others. Each unit is defined, with its other
spellings, by a row of `REGISTRY`.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError

STANDARD_GRAVITY = 9.80665  # m/s²
ANY = "any"  # placeholder for a unit: the column is stored in the fixed unit of its quantity


class Unit(NamedTuple):
    """A unit of the registry.

    Attributes:
        name: bayescal's spelling.
        size: one unit expressed in `base`; 0 for a row that only adds spellings of a product of units.
        base: product of base units; empty for a dimensionless unit.
        prefixes: SI prefixes that the unit may have.
        also: other spellings, always recognised; separated by spaces.
        in_context: other spellings, recognised where a unit of this dimension is expected; separated by commas.
        symbol: printed symbol, if it differs from the name.
        zero: zero of a temperature scale, K.
    """

    name: str
    size: float
    base: str = ""
    prefixes: str = ""
    also: str = ""
    in_context: str = ""
    symbol: str = ""
    zero: float | None = None


_DEGREE = math.pi / 180
_PREFIXES = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "h": 1e2, "k": 1e3, "M": 1e6}
REGISTRY = (
    Unit("s", 1, "s", "n", "sec second seconds Sec Seconds", "s., sec., seconds, Sek, Sek., Sekunden"),
    Unit("ms", 1e-3, "s", also="msec"),
    Unit("us", 1e-6, "s", also="usec"),
    Unit("min", 60, "s", also="minute minutes", in_context="Min, Min., min., Minuten"),
    Unit("h", 3600, "s", also="hr hour hours", in_context="Std, Std., Stunden, heures"),
    Unit("day", 86400, "s", also="days"),
    Unit("K", 1, "K", "m", "kelvin Kelvin", zero=0.0),
    Unit("degC", 1, "K", "", "celsius Celsius DegC DEGC deg_C degree_Celsius",
         "C, oC, deg C, degrees C, deg. C, celcius, Cel, Grad C, °, º, deg, degree, degrees, c", "°C", 273.15),
    Unit("delta_degC", 1, "K", also="delta_degree_Celsius", symbol="°C"),
    Unit("degF", 5 / 9, "K", "", "", "F, deg F, degrees F, fahrenheit, f", "°F", 459.67 * 5 / 9),
    Unit("delta_degF", 5 / 9, "K", symbol="°F"),
    Unit("rad", 1, "rad", "pnum", "radian radians"),
    Unit("deg", _DEGREE, "rad", "m", "degree degrees Degrees Grad", symbol="°"),
    Unit("gon", math.pi / 200, "rad"),
    Unit("arcmin", _DEGREE / 60, "rad", also="arcminutes"),
    Unit("arcsec", _DEGREE / 3600, "rad", "", "arcsecond arcseconds", "sec of arc, asec"),
    Unit("mas", _DEGREE / 3.6e6, "rad"),
    Unit("rev", 2 * math.pi, "rad"),
    Unit("rad/s", 0, in_context="rad_s, radps, rads, rad_sec, rad_per_s, rad_per_sec, rad per s"),
    Unit("deg/s", 0, in_context="deg_s, degs, deg_sec, deg_per_s, deg_per_sec, degps, deg per s, deg per sec"),
    Unit("deg/h", 0, in_context="deg_h, deg_hr, deg_per_h, deg_per_hr, deg per h, deg per hr"),
    Unit("dps", _DEGREE, "rad/s", "m", symbol="°/s"),
    Unit("dph", _DEGREE / 3600, "rad/s", symbol="°/h"),
    Unit("rpm", math.pi / 30, "rad/s", in_context="U/min, 1/min, tr/min"),
    Unit("ug", 1, "ug", in_context="micro_g, micro g"),
    Unit("g", 1e6, "ug", "nm", "", "G, gee, gn"),
    Unit("m/s^2", 0, in_context="m_s2, ms2, ms-2, ms^-2, mps2, m_per_s2, m_s_2, mss, m per s2"),
    Unit("Gal", 1e-2, "m/s**2", "u", "gal"),
    Unit("mGal", 1e-5, "m/s**2", also="mgal"),
    Unit("m", 1, "m", "numck"),
    Unit("V", 1, "V", "nk", "volt volts Volt Volts VOLT VDC Vdc VAC"),
    Unit("mV", 1e-3, "V", also="mVDC"),
    Unit("uV", 1e-6, "V", also="uVDC"),
    Unit("Hz", 1, "Hz", "mkM", "hertz"),
    Unit("A", 1, "A", "um"),
    Unit("ohm", 1, "ohm", "M", "ohms Ohm Ohms OHM"),
    Unit("kohm", 1e3, "ohm", also="kohms kOhm"),
    Unit("W", 1, "W", "m"),
    Unit("Pa", 1, "Pa", "hk"),
    Unit("bar", 1e5, "Pa", "m"),
    Unit("psi", 6894.757293168361, "Pa", "k"),
    Unit("Torr", 101325 / 760, "Pa", "m", "torr"),
    Unit("mmHg", 133.322387415, "Pa"),
    Unit("inHg", 3386.389, "Pa"),
    Unit("atm", 101325, "Pa"),
    Unit("kg", 1, "kg"),
    Unit("gram", 1e-3, "kg", "um", "grams gramme Gramm", "g"),
    Unit("tonne", 1e3, "kg", "", "tonnes"),
    Unit("lb", 0.45359237, "kg", "", "lbs lbm"),
    Unit("N", 1, "N", "umkM", "newton newtons Newton"),
    Unit("kgf", STANDARD_GRAVITY, "N", "", "kp"),
    Unit("gf", 1e-3 * STANDARD_GRAVITY, "N"),
    Unit("lbf", 4.4482216152605, "N"),
    Unit("N*m", 0, also="Nm"),
    Unit("mL", 1e-6, "m**3", also="ml"),
    Unit("L", 1e-3, "m**3", "nu", "l liter liters litre litres Liter"),
    Unit("cc", 1e-6, "m**3"),
    Unit("L/min", 0, also="lpm LPM"),
    Unit("slm", 1e-3 / 60, "m**3/s", "", "slpm SLPM SLM"),
    Unit("sccm", 1e-6 / 60, "m**3/s", "", "SCCM"),
    Unit("mol", 1, "mol", "num"),
    Unit("uT", 1, "uT"),
    Unit("nT", 1e-3, "uT"),
    Unit("mT", 1e3, "uT"),
    Unit("gauss", 1e2, "uT", also="Gauss", in_context="Gs"),
    Unit("mgauss", 1e-1, "uT", also="mGauss", in_context="mG"),
    Unit("count", 1, "count", also="counts LSB lsb"),
    Unit("percent", 1e-2, symbol="%"),
    Unit("ppm", 1e-6),
    Unit("ppb", 1e-9),
)  # fmt: skip
BASE_UNITS = [unit.name for unit in REGISTRY if unit.name == unit.base]
KNOWN_UNITS = {name: (1.0, name) for name in BASE_UNITS} | {
    prefix + unit.name: (_PREFIXES.get(prefix, 1.0) * unit.size, unit.base)
    for unit in REGISTRY
    for prefix in ("", *unit.prefixes)
    if unit.size
}
SPELLINGS = {text: unit.name for unit in REGISTRY for text in unit.also.split()}
CONTEXT_SPELLINGS = {unit.name: unit.in_context.split(", ") for unit in REGISTRY if unit.in_context}
# Spellings of products of units that are always unambiguous; "rads" and "degs" may be words.
_COMPOUND_SPELLINGS = {
    text: unit.name for unit in REGISTRY if not unit.size for text in unit.in_context.split(", ")
}
for _word in ("", "rads", "degs"):
    _COMPOUND_SPELLINGS.pop(_word)
_SCALE_ZEROS_K = {unit.name: unit.zero for unit in REGISTRY if unit.zero is not None}
_SYMBOLS = {unit.name: unit.symbol for unit in REGISTRY if unit.symbol} | {"mdeg": "m°"}
_REPLACEMENTS = {
    "μ": "u", "µ": "u", "º": "°", "℃": "degC", "℉": "degF", "°C": "degC", "°F": "degF", "°": "deg",
    "%RH": "%", "%rH": "%", "%rh": "%", "% RH": "%", "%rF": "%", "% r.F.": "%", "%r.F.": "%",
    "\u03a9": "ohm", "\u2126": "ohm",
    "″": "arcsec", "′": "arcmin", "”": "arcsec", "’": "arcmin",
    "''": "arcsec", '"': "arcsec", "'": "arcmin", "%": "percent", "**": "^", "·": "*", "⋅": "*", "∙": "*", "×": "*",
    "−": "-",
}  # fmt: skip
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
EXPONENT = re.compile(r"\^(?:\((-?\d(?:\.\d)?)\)|(-?\d(?:\.\d)?))")
NAME = re.compile(r"[A-Za-z_]+")


@dataclass(frozen=True)
class ParsedUnit:
    """Unit parsed into its conversion factor and exponents of base units.

    Attributes:
        factor: conversion factor to base units.
        powers: exponents of the base units.
        offset: zero of a temperature scale, K.
        names: unit names as written, each with its exponent, before cancellation.
    """

    factor: float
    powers: Mapping[str, float]
    offset: float | None = None
    names: tuple[tuple[str, float], ...] = ()

    def times(self, other: ParsedUnit, power: float = 1.0) -> ParsedUnit:
        """Multiply by another unit raised to a power."""
        powers = dict(self.powers)
        for name, exponent in other.powers.items():
            powers[name] = powers.get(name, 0.0) + power * exponent
        nonzero = {name: exponent for name, exponent in powers.items() if exponent}
        return ParsedUnit(self.factor * other.factor**power, nonzero)

    def __str__(self) -> str:
        """Format the dimension as a product of base units, for messages."""
        return f"[{_format_base(self.powers)}]" if self.powers else "a plain number"


UNITY = ParsedUnit(1.0, {})


@lru_cache(maxsize=512)
def parse(text: str) -> ParsedUnit:
    """Parse a unit; raise InputError if the text is not a unit."""
    spelling = normalise_unit(text)
    # Converted to a Python expression: adjacent factors are multiplied, ^ is a power.
    adjacent = r"(?<=[\w)])\s*(?=\()|(?<=\))\s*(?=\w)|(?<=\w)\s+(?=\w)|(?<=\d)(?=[A-Za-z])"
    expression = re.sub(adjacent, "*", spelling).replace("^", "**").strip()
    product = UNITY
    try:
        names = tuple(_list_factors(ast.parse(expression, mode="eval").body))
        for name, power in names:
            size, base = KNOWN_UNITS[name]
            factors = _list_factors(ast.parse(base, mode="eval").body) if base else ()
            product = product.times(ParsedUnit(size, dict(factors)), power)
    except (SyntaxError, ValueError, OverflowError) as error:
        raise InputError(
            f"[{text}] is not a unit: write one such as [ug/mg^2] or [deg/s/degC]"
        ) from error
    return ParsedUnit(product.factor, product.powers, _SCALE_ZEROS_K.get(spelling), names)


def _list_factors(part: ast.expr) -> list[tuple[str, float]]:
    """Return the unit names in a parsed product, quotient or power, each with its exponent."""
    match part:
        case ast.Name(id=name) if name in KNOWN_UNITS:
            return [(name, 1.0)]
        case ast.Constant(value=1):
            return []
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            sign = 1.0 if isinstance(op, ast.Mult) else -1.0
            return [*_list_factors(left), *((n, sign * p) for n, p in _list_factors(right))]
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            power = float(ast.literal_eval(right))
            return [(name, power * exponent) for name, exponent in _list_factors(left)]
    raise ValueError("not a product of units")


def normalise_unit(text: str) -> str:
    """Normalise a unit's spelling: plain ASCII, known names, ^ for powers; raise InputError for unknown names."""
    if not text.strip() or len(text) > 60:
        raise InputError(f"[{text[:60]}] is not a unit: write one such as [degC], [deg/s] or [1]")
    unit = re.sub(r"([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", r"^\1", text.strip()).translate(_SUPERSCRIPTS)  # m/s²
    for spelling, replacement in _REPLACEMENTS.items():
        unit = unit.replace(spelling, replacement)
    unit = re.sub(r"(?:√|sqrt)\(?([A-Za-z]+)\)?", r"\1^0.5", unit)  # deg/√h
    unit = re.sub(r"([A-Za-z])([2-4]|-[1-4])\b", r"\1^\2", unit)  # m/s2, m s-2
    if re.search(r"\bms\^-?2", unit):
        raise InputError(
            f"[{text}] is ambiguous, m/s² or square milliseconds: write [m/s^2] or [1/s^2]"
        )
    unit = re.sub(r"(?<=[A-Za-z)])\.(?=[A-Za-z(])", "*", unit)  # rad.s-1
    unit = "1" if unit == "-" else unit
    unit = NAME.sub(lambda m: SPELLINGS.get(m[0], m[0]), unit)
    names = NAME.findall(unit)
    for name in names:
        if name not in KNOWN_UNITS:
            raise InputError(f"[{text}] is not a known unit: {name!r}{_suggest_units(name)}")
    # Without its powers, each name as "u", a unit may hold operators and a lone 1, as in 1/degC.
    skeleton = NAME.sub("u", EXPONENT.sub("", unit))
    if re.search(r"[^u1*/() ]|11|1u", skeleton):
        raise InputError(
            f"[{text}] is not a unit: a unit consists of names, *, /, ^ and brackets, without a "
            "number in front. Write one such as [ug/mg^2] or [deg/s/degC]"
        )
    return unit


# symbols of unsupported units, and the units that may be intended
_NON_UNITS = {"C": ("the coulomb", "degC"), "F": ("the farad", "degF"), "S": ("the siemens", "s")}


def _suggest_units(name: str) -> str:
    if name in _NON_UNITS:
        quantity_name, unit = _NON_UNITS[name]
        return f" ({name!r} is {quantity_name}; do you mean {unit}?)"
    similar = [k for k in KNOWN_UNITS if k.lower() == name.lower()]
    similar = similar or difflib.get_close_matches(name, KNOWN_UNITS, 3)
    listing = f"do you mean {' or '.join(similar)}?" * bool(similar)
    return f" ({listing or 'known: ' + ', '.join(KNOWN_UNITS)})"


def unit_in(text: str, kinds: tuple[str, ...]) -> str | None:
    """Return the unit, convertible to one of `kinds` ("any": any), that a text denotes; None if none or several."""
    if _has_dimension(text, kinds):
        return text
    if ANY in kinds:
        return _COMPOUND_SPELLINGS.get(text.translate(_SUPERSCRIPTS))
    lower, spellings = text.lower(), CONTEXT_SPELLINGS.items()
    exact_matches = {u for u, texts in spellings if text in texts}
    any_case = {u for u, texts in spellings if len(text) > 1 and lower in map(str.lower, texts)}
    known_matches = {u for u in KNOWN_UNITS if u.lower() == lower}
    tiers = (exact_matches or any_case, known_matches, {lower})
    matches = ({u for u in tier if _has_dimension(u, kinds)} for tier in tiers)
    unique = next(filter(None, matches), set())
    return unique.pop() if len(unique) == 1 else None


def _has_dimension(unit: str, kinds: tuple[str, ...]) -> bool:
    """Return whether a text is a known unit with the dimension of one of these units ("any": of any dimension)."""
    return any(is_convertible(unit, unit if kind == ANY else kind) for kind in kinds)


EARTH_GRAVITY = (9.7, 9.9)  # m/s²; range that contains the gravity everywhere on Earth


def convert(
    values: ArrayLike,
    from_unit: str,
    to_unit: str,
    *,
    local_gravity: float = STANDARD_GRAVITY,
    difference: bool = False,
) -> np.ndarray:
    """Convert numbers (any shape) from one unit to another.

    Temperatures in degC, K and degF are absolute unless the unit begins with `delta_` or the values are differences
    (`difference`), as for an uncertainty. Accelerations convert between m/s² and g by the local gravity, m/s².

    Raises:
        InputError: an unknown unit, units of different dimensions, a temperature difference in place of a temperature,
            or a local gravity outside the range on Earth.
    """
    old, new = parse(from_unit), parse(to_unit)
    values = np.array(values, dtype=np.float64)
    power = _find_gravity_power(old.powers, new.powers)
    if power is None:
        raise InputError(
            f"[{from_unit}] cannot be converted to [{to_unit}], a unit of another dimension: correct the unit"
        )
    if new.offset is not None and not difference:
        if old.offset is None:
            raise InputError(
                f"[{from_unit}] is a temperature difference, [{to_unit}] a temperature: write [degC], [K] or [degF]"
            )
        is_same = old == new
        return values if is_same else (values * old.factor + old.offset - new.offset) / new.factor
    factor = old.factor / new.factor
    if power:
        low, high = EARTH_GRAVITY
        if not low <= local_gravity <= high:
            raise InputError(
                f"local gravity {local_gravity:g} m/s² is outside the range on Earth ({low} … {high} m/s²): give m/s², "
                "such as 9.80665"
            )
        factor *= (1e6 / local_gravity) ** power
    return values if factor == 1 else values * factor


_QUANTITY = re.compile(r"([+\-−]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\d\s.].*)")


def parse_quantity(text: str) -> tuple[float, str]:
    """Parse a number with a unit, such as "48.2 uT" or "2min"; raise InputError for any other text."""
    if not (match := _QUANTITY.fullmatch(text.strip())):
        raise InputError("it is not a number with a unit")
    parse(match[2])
    return float(match[1].replace("−", "-")), match[2]


def same_dimension(a: str, b: str) -> bool:
    """Return whether two units have the same dimension (m/s² and g do); raise InputError for an unknown unit."""
    return _find_gravity_power(parse(a).powers, parse(b).powers) is not None


def is_convertible(a: str, b: str) -> bool:
    """Return whether two texts are known units of the same dimension."""
    with contextlib.suppress(InputError):
        return same_dimension(a, b)
    return False


def needs_gravity(from_unit: str, to_unit: str) -> bool:
    """Return whether a conversion uses the local gravity; raise InputError for an unknown unit."""
    return bool(_find_gravity_power(parse(from_unit).powers, parse(to_unit).powers))


def coefficient_factor(unit: str, slot_unit: str) -> float:
    """Return the factor that converts `unit` to `slot_unit`; degC counts as a temperature difference."""
    return parse(unit).factor / parse(slot_unit).factor


@lru_cache(maxsize=4096)
def basis_factor(
    unit: str, slot_unit: str, column_units: tuple[str, ...], is_open: bool, others: tuple[str, ...]
) -> float:
    """Return the factor that converts coefficient × basis, in their own units, to the unit of the slot.

    The basis has the dimension slot unit ÷ coefficient unit. Its unit is the product of column units of this dimension:
    if the slot is in um/s^2 and the coefficient in um/s^2/hPa, the factor is 1 for a column in hPa, 0.01 for one in Pa.
    A percent in the denominator of the coefficient's unit refers to the columns that are dimensionless ratios.

    Args:
        unit, slot_unit: units of the coefficient and of the slot.
        column_units: units of the columns that the effect names.
        is_open: whether the effect names a column that no instrument declares (stored in base units).
        others: units of shape parameters and of further columns, used if the named ones are insufficient.

    Raises:
        InputError: an unknown unit, or columns of which no product, or more than one, has the required dimension.
    """
    coef, slot = parse(unit), parse(slot_unit)
    basis = {n: slot.powers.get(n, 0) - coef.powers.get(n, 0) for n in {*slot.powers, *coef.powers}}
    basis = {name: power for name, power in basis.items() if power}
    factor = coef.factor / slot.factor * _ratio_factor(unit, slot_unit, column_units, is_open)
    time_units = () if any(parse(u).powers == {"s": 1} for u in column_units) else ("s",)
    unit_sets = [column_units, (*column_units, *time_units)]
    # an undeclared column in m/s² is stored in local g: the coefficient must be per g
    if is_open and not ("m" in basis and basis.get("s") == -2 * basis["m"]):
        unit_sets.append((*column_units, *BASE_UNITS))
    unit_sets.append((*column_units, *time_units, *others))
    for units in unit_sets:
        product_factor = _parse_product(basis, tuple(dict.fromkeys(units)), unit, slot_unit)
        if product_factor is not None:
            return factor * product_factor
    raise InputError(
        f"a coefficient in [{unit}] on a slot in [{slot_unit}] needs a basis in [{_format_base(basis)}], but no "
        f"product of the units of its columns ({_list_units(column_units)}) has this dimension"
    )


def _ratio_factor(unit: str, slot_unit: str, column_units: tuple[str, ...], is_open: bool) -> float:
    """Return the factor of the units (%, ppm, ppb, 1) of dimensionless columns in the unit of a coefficient."""
    ratios = {parse(u).factor for u in column_units if not parse(u).powers}
    ratios |= {1.0} if is_open else set()
    exponents = [power for name, power in parse(unit).names if not parse(name).powers]
    numerator = sum(max(power, 0.0) for power in exponents)
    denominator = numerator - sum(exponents)
    # the numerator of the coefficient of a dimensionless output contains the output's own unit
    excess_exponent = numerator - (0.0 if parse(slot_unit).powers else min(numerator, 1.0))
    if not ratios or not (denominator or excess_exponent):
        return 1.0
    if len(ratios) == 1 and not (denominator and excess_exponent):
        return min(ratios) ** (denominator - excess_exponent)
    raise InputError(
        f"a coefficient in [{unit}] on a slot in [{slot_unit}] is ambiguous, because its columns in "
        f"{_list_units(column_units)} are all dimensionless: declare these columns in [1]"
    )


def _parse_product(
    basis: Mapping[str, float], units: Sequence[str], unit: str, slot_unit: str
) -> float | None:
    """Return the factor to base units of the product of `units` with the dimension `basis`; None if none exists."""
    numerator, denominator = Counter[str](), Counter[str]()
    for name, power in parse(unit).names:
        for base, exponent in parse(name).powers.items():
            (numerator if power > 0 else denominator)[base] += exponent * power  # pyright: ignore[reportArgumentType]
    slot = parse(slot_unit).powers
    of_output = {n for n in numerator if not denominator[n] and numerator[n] == slot.get(n, 0)}
    dimensions = {*numerator, *denominator, *basis} - of_output
    parts = {u: parse(u) for u in units if not dimensions.isdisjoint(parse(u).powers)}
    if not parts:
        return None if basis else 1.0
    names = sorted({*basis, *(n for part in parts.values() for n in part.powers)})
    matrix = np.array([[part.powers.get(n, 0.0) for part in parts.values()] for n in names])
    target = np.array([basis.get(n, 0.0) for n in names])
    sizes = np.log([part.factor for part in parts.values()])
    powers, _, rank, _ = np.linalg.lstsq(matrix, target)
    if np.abs(matrix @ powers - target).max() > 1e-9:
        return None
    kernel = np.linalg.svd(matrix)[2][rank:]
    is_ambiguous = np.abs(kernel[np.abs(kernel @ sizes) > 1e-9]).max(axis=0, initial=0.0) > 1e-9
    if is_ambiguous.any():
        labels = _list_units([u for u, flag in zip(parts, is_ambiguous, strict=True) if flag])
        raise InputError(
            f"the unit of its basis is ambiguous: columns in {labels} have one dimension. Declare them in the same unit"
        )
    return float(np.exp(powers @ sizes))


def _list_units(units: Sequence[str]) -> str:
    return ", ".join(f"[{u}]" for u in dict.fromkeys(units)) or "no column is named"


def base_unit(unit: str) -> str:
    """Return the stored unit of a column without a prescribed unit: base units, or °C; raise InputError if unknown."""
    parsed = parse(unit)
    if parsed.powers == {"m": 1, "s": -2}:
        return "ug"
    if parsed.powers == {"K": 1}:
        return "degC" if parsed.offset is not None else "delta_degC"
    return _format_base(parsed.powers)


def _format_base(powers: Mapping[str, float]) -> str:
    """Format exponents of base units as a unit; K as degC, a temperature difference."""
    exponents = sorted(("degC" if n == "K" else n, p) for n, p in powers.items())
    terms = [(n if abs(p) == 1 else f"{n}^{abs(p):g}", p > 0) for n, p in exponents]
    numerator = "*".join(term for term, is_numerator in terms if is_numerator)
    return "/".join([numerator or "1", *(term for term, is_numerator in terms if not is_numerator)])


def quotient(unit: str, divisor: str) -> str:
    """Return the quotient of two units with common names cancelled: "degC" for "deg/s" by "deg/s/degC"."""
    exponents = (*parse(unit).names, *((name, -power) for name, power in parse(divisor).names))
    powers = {name: sum(p for n, p in exponents if n == name) for name, _ in exponents}
    return _format_base({name: power for name, power in powers.items() if power})


def fixed_unit(unit: str) -> str:
    """Return the unit in which a quantity is stored: µg, °/s, rad, °C, s; ratios unchanged; else base units."""
    if not parse(unit).powers and parse(unit).factor != 1:
        return normalise_unit(unit)  # ppm, ppb, %: in base units it would print as 3e-07
    return "deg/s" if (base := base_unit(unit)) == "rad/s" else base


def format_unit(unit: str) -> str:
    """Format a unit with symbols: "deg/s/degC" as "°/s/°C", "ug/mg^2" as "µg/mg²"."""
    if unit == ANY:
        return unit
    parse(unit)

    def name(match: re.Match[str]) -> str:
        text = match[0]
        return _SYMBOLS.get(text) or ("µ" + text[1:] if text[0] == "u" else text)

    text = NAME.sub(name, normalise_unit(unit)).replace("*", "·")
    text = re.sub(r"(\w+)\^\(?0\.5\)?", r"√\1", text)  # °/√h
    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    return EXPONENT.sub(
        lambda m: m[0].strip("^()").translate(digits) if "." not in m[0] else m[0], text
    )


def unit_label(unit: str) -> str:
    """Format a unit with symbols; "" for a dimensionless unit."""
    return format_unit(unit) if unit not in ("", "1") else ""


def _find_gravity_power(source: Mapping[str, float], target: Mapping[str, float]) -> float | None:
    """Return the exponent of local gravity in a conversion between two dimensions; None if not convertible."""
    power, names = source.get("m", 0) - target.get("m", 0), {*source, *target}
    expected = {"m": power, "s": -2 * power, "ug": -power}
    matches = all(source.get(n, 0) - target.get(n, 0) == expected.get(n, 0) for n in names)
    return power if matches and (not power or {"s", "ug"} <= names) else None
