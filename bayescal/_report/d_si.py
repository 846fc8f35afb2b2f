"""Units as the Digital System of Units (D-SI) writes them: coherent SI, an acceleration in local g as m/s².

Source: D. Hutzschenreuter et al., SmartCom Digital System of Units (D-SI) Guide, doi 10.5281/zenodo.3522631.
"""

from __future__ import annotations

from bayescal._data.unit_parsing import STANDARD_GRAVITY, parse

_D_SI = {
    "s": "second",
    "K": "kelvin",
    "rad": "radian",
    "V": "volt",
    "Hz": "hertz",
    "m": "metre",
    "A": "ampere",
    "Pa": "pascal",
    "uT": "tesla",
    "count": "one",
}


def d_si(unit: str | None, local_gravity: float = STANDARD_GRAVITY) -> tuple[float, str]:
    """A unit in D-SI: the factor from the one to the other, and its text, such as \\radian\\second\\tothe{-1}.

    Args:
        unit: ours; a temperature in degC stays one.
        local_gravity: m/s², that one g is.

    Raises:
        InputError: it is no unit.
    """
    if unit in (None, "", "1"):
        return 1.0, "\\one"
    if unit == "degC":
        return 1.0, "\\degreecelsius"
    found = parse(unit)
    factor, powers = found.factor, dict[str, float]()
    for base, power in found.powers.items():
        if base == "ug":
            factor *= (1e-6 * local_gravity) ** power
            parts = {"metre": power, "second": -2 * power}
        else:
            factor *= 1e-6**power if base == "uT" else 1.0
            parts = {_D_SI[base]: power}
        for name, p in parts.items():
            powers[name] = powers.get(name, 0.0) + p
    text = "".join(
        f"\\{name}" + ("" if p == 1 else f"\\tothe{{{p:g}}}") for name, p in powers.items() if p
    )
    return factor, text or "\\one"
