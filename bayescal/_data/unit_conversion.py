"""Units converted, compared and printed.

A file's units become fixed ones when it is read: inside the library nothing is converted but coefficients, between the
units that are declared for them, their slot and the columns that their basis takes. What a unit means stands in
`unit_parsing`.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError
from bayescal._data.unit_parsing import (
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


def same_dimension(a: str, b: str) -> bool:
    """Whether one unit converts to the other (m/s² and g do, by the local gravity).

    Raises:
        InputError: an unknown unit.
    """
    return _power_of_gravity(parse(a).powers, parse(b).powers) is not None


def alike(a: str, b: str) -> bool:
    """Whether both texts are units, of one dimension."""
    with contextlib.suppress(InputError):
        return same_dimension(a, b)
    return False


def needs_gravity(from_unit: str, to_unit: str) -> bool:
    """Whether the conversion between two units of one dimension uses the local gravity.

    Raises:
        InputError: an unknown unit.
    """
    return bool(_power_of_gravity(parse(from_unit).powers, parse(to_unit).powers))


def coefficient_factor(unit: str, slot_unit: str) -> float:
    """What turns a number in one unit into another of its dimension, or into base units times the other.

    That is unit ÷ slot unit in base units (s, K, rad, µg, …). degC is always a difference here.

    Raises:
        InputError: an unknown unit.
    """
    return parse(unit).factor / parse(slot_unit).factor


@lru_cache(maxsize=4096)
def basis_factor(
    unit: str, slot_unit: str, named: tuple[str, ...], open_: bool, others: tuple[str, ...]
) -> float:
    """What a coefficient in its reported unit, times a basis of columns in their own units, is in the slot's unit.

    The basis has the dimension of slot unit ÷ unit, and is in the product of column units that has this dimension:
    where the slot is in um/s^2, a coefficient in um/s^2/hPa on a column in hPa has the factor 1, on one in Pa 0.01. A
    ratio has no dimension: a percent below the coefficient's stroke stands for the columns that are ratios.

    Args:
        unit: of the coefficient.
        slot_unit: of the slot.
        named: units of the columns that the effect names.
        open_: whether it names a column that no instrument declares: such a one is in base units.
        others: units of shapes and of further columns, for an effect that names too few.

    Raises:
        InputError: an unknown unit; columns that make no such product, or several products of different size.
    """
    own, slot = parse(unit), parse(slot_unit)
    wanted = {n: slot.powers.get(n, 0) - own.powers.get(n, 0) for n in {*slot.powers, *own.powers}}
    wanted = {name: power for name, power in wanted.items() if power}
    factor = own.factor / slot.factor * _ratios(unit, slot_unit, named, open_)
    clock = () if any(parse(u).powers == {"s": 1} for u in named) else ("s",)
    tried = [named, (*named, *clock)]
    # m/s² of a column that no instrument declares is kept as local g
    as_gravity = open_ and "m" in wanted and wanted.get("s") == -2 * wanted["m"]
    if open_ and not as_gravity:
        tried.append((*named, *BASE))
    tried.append((*named, *clock, *others))
    for units in tried:
        size = _product(wanted, tuple(dict.fromkeys(units)), unit, slot_unit)
        if size is not None:
            return factor * size
    raise InputError(
        f"a coefficient in [{unit}] on a slot in [{slot_unit}] needs a basis in [{_shown(wanted)}], and no product of "
        f"its columns' units ({_listed(named)}) is that"
        + "; a column in m/s² that no instrument declares is kept in ug: write the coefficient per ug, mg or g"
        * as_gravity
    )


def _ratios(unit: str, slot_unit: str, named: tuple[str, ...], open_: bool) -> float:
    """Units of ratio columns (%, ppm, ppb, 1) to the powers to which the coefficient is per ratio."""
    ratios = {parse(u).factor for u in named if not parse(u).powers} | ({1.0} if open_ else set())
    written = [(parse(n).factor, p) for n, p in parse(unit).names if not parse(n).powers]
    if not ratios or not written:
        return 1.0
    below, above = Counter[float](), 0.0
    for size, power in written:
        below[size] -= min(power, 0.0)  # pyright: ignore[reportArgumentType]
        above += max(power, 0.0)
    # a ratio's own coefficient has one above its stroke: what the output is counted in
    beyond = above - (0.0 if parse(slot_unit).powers else min(above, 1.0))
    below = {size: power for size, power in below.items() if power}
    if len(ratios) == 1 and not (below and beyond):
        return min(ratios) ** (sum(below.values()) - beyond)
    if (
        beyond
        or (below and set(below) != ratios - {1.0})
        or (1.0 in ratios and max(below.values(), default=0) > 1)
    ):
        raise InputError(
            f"a coefficient in [{unit}] on a slot in [{slot_unit}] does not say which of its columns, ratios in "
            f"{_listed(named)}, it is per: declare them in [1]"
        )
    return math.prod(size**power for size, power in below.items())


def _product(
    wanted: Mapping[str, float], units: Sequence[str], unit: str, slot_unit: str
) -> float | None:
    """The size, in base units, of the product of these units that has a dimension; None where there is none."""
    above, below = Counter[str](), Counter[str]()
    for name, power in parse(unit).names:
        for base, own in parse(name).powers.items():
            (above if power > 0 else below)[base] += own * power  # pyright: ignore[reportArgumentType]
    slot = parse(slot_unit).powers
    involved = {n for n in {*above, *below} if below[n] or above[n] != slot.get(n, 0)} | {*wanted}
    parts = {u: parse(u) for u in units if not involved.isdisjoint(parse(u).powers)}
    if not parts:
        return None if wanted else 1.0
    names = sorted({*wanted, *(n for part in parts.values() for n in part.powers)})
    matrix = np.array([[part.powers.get(n, 0.0) for part in parts.values()] for n in names])
    aim = np.array([wanted.get(n, 0.0) for n in names])
    sizes = np.log([part.factor for part in parts.values()])
    powers, _, rank, _ = np.linalg.lstsq(matrix, aim)
    if np.abs(matrix @ powers - aim).max() > 1e-9:
        return None
    free = np.linalg.svd(matrix)[2][rank:]
    free = free[np.abs(free @ sizes) > 1e-9]
    if len(free):
        by_name = Counter[str]()
        for name, power in (*((n, -p) for n, p in parse(unit).names), *parse(slot_unit).names):
            by_name[name] += power  # pyright: ignore[reportArgumentType]
        powers = np.array([by_name[normalised(u)] for u in parts], dtype=float)
        doubtful = np.abs(free).max(axis=0) > 1e-9
        if not powers[doubtful].all() or np.abs(matrix @ powers - aim).max() > 1e-9:
            listed = _listed([u for u, odd in zip(parts, doubtful, strict=True) if odd])
            raise InputError(
                f"of columns in {listed} its basis may be made in several ways, of different size: declare them in one "
                "unit"
            )
    return float(np.exp(powers @ sizes))


def _listed(units: Sequence[str]) -> str:
    return ", ".join(f"[{u}]" for u in dict.fromkeys(units)) or "none is named"


def _shown(powers: Mapping[str, float]) -> str:
    return "*".join(_raised("degC" if n == "K" else n, p) for n, p in sorted(powers.items()))


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
    """The unit in which the library keeps a quantity: µg, °/s, rad, °C, s; a ratio in its own; else base units.

    Raises:
        InputError: an unknown unit.
    """
    if not parse(unit).powers and parse(unit).factor != 1:
        return normalised(unit)  # ppm, ppb, %: as a plain number it would be shown as 3e-07
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
