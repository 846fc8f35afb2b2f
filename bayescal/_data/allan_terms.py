"""The terms of an Allan curve, white noise N, bias instability B and random walk K, as data sheets give them.

Names and units: IEEE Std 952 (gyroscopes), IEEE Std 1293 (accelerometers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from bayescal._core.formatting import with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._data.unit_parsing import parse

SYMBOLS = "NBK"


class Habit(NamedTuple):
    """How the terms of one kind of output are called and given on data sheets: N, B, K; `rounded` is the unit of Q."""

    names: tuple[str, str, str]
    units: tuple[str, str, str]
    rounded: str


@dataclass(frozen=True)
class AllanTerm:
    """One term of an Allan curve.

    Attributes:
        symbol: N, B or K.
        name: as IEEE 952 and 1293 call it.
        unit: of data sheets.
        value: None where the curve of this record has no such slope.
        uncertainty: standard uncertainty of the value.
    """

    symbol: str
    name: str
    unit: str
    value: float | None = None
    uncertainty: float | None = None

    def __str__(self) -> str:
        if self.value is None or self.uncertainty is None:
            return "not seen in this record"
        return f"{with_error(self.value, self.uncertainty)} {unit_label(self.unit)}".strip()


def habit(unit: str) -> Habit:
    """Names and units of the terms for an output in `unit`.

    Noise densities are of the spectrum on both sides of zero frequency, as in IEEE 952, so that N per √Hz is N·√s;
    a data sheet with a one-sided spectrum prints √2 times as much.
    """
    powers = dict(parse(unit or "1").powers)
    if powers == {"rad": 1, "s": -1}:
        names = ("angle random walk", "bias instability", "rate random walk")
        return Habit(names, ("deg/h^0.5", "deg/h", "deg/h/h^0.5"), "arcsec")
    walks = ("velocity random walk", "bias instability", "acceleration random walk")
    if powers == {"ug": 1}:
        return Habit(walks, ("ug/Hz^0.5", "ug", "ug/h^0.5"), "ug*s")
    if powers == {"m": 1, "s": -2}:
        return Habit(walks, ("m/s/h^0.5", "m/s^2", "m/s^2/h^0.5"), "m/s")
    own = unit or "1"
    names = ("white noise", "bias instability", "random walk")
    return Habit(names, (f"{own}/Hz^0.5", own, f"{own}/s^0.5"), f"{own}*s")


def term(symbol: str, unit: str, value: float | None, uncertainty: float | None) -> AllanTerm:
    """A term in its data-sheet unit.

    Args:
        symbol: N, B or K.
        unit: of the output.
        value, uncertainty: in that unit times √s (N), as it is (B), or per √s (K); None where not seen.
    """
    i, names = SYMBOLS.index(symbol), habit(unit)
    if value is None or uncertainty is None:
        return AllanTerm(symbol, names.names[i], names.units[i])
    # Both in base units, of which the second is one and the hertz its inverse.
    factor = parse(unit or "1").factor / parse(names.units[i]).factor
    return AllanTerm(symbol, names.names[i], names.units[i], value * factor, uncertainty * factor)
