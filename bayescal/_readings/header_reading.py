"""Headers as people write them: "Temp (°C)", "gyro_z_dps", 'angle/"' as a name and a unit.

A header has several possible readings; one counts only if the quantity that is expected there has a unit of its kind.
So "Temp_C" is a temperature in °C, since nothing else that is written C is a temperature.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from bayescal._core.errors import InputError
from bayescal._readings.unit_conversion import same_dimension
from bayescal._readings.unit_parsing import ANY, BASE, DERIVED
from bayescal._tables.raw_table import Header

# Spellings that are one thing only where a quantity of this kind is expected.
_SPELLINGS = {
    "degC": ("C", "deg C", "degrees C", "deg. C", "celcius"),
    "degF": ("F", "deg F", "degrees F", "fahrenheit"),
    "deg/s": ("deg_s", "degs", "deg_sec", "deg_per_s", "deg_per_sec", "degps", "deg per s", "deg per sec"),
    "deg/h": ("deg_h", "deg_hr", "deg_per_h", "deg_per_hr", "deg per h", "deg per hr"),
    "rad/s": ("rad_s", "radps", "rads", "rad_sec", "rad_per_s", "rad_per_sec", "rad per s"),
    "m/s^2": ("m_s2", "ms2", "mps2", "m_per_s2", "m_s_2", "mss", "m per s2", "m/s/s"),
    "g": ("G", "gee", "gn"),
    "ug": ("micro_g", "micro g"),
    "arcsec": ("sec of arc", "asec"),
    "s": ("s.", "sec.", "seconds"),
}  # fmt: skip
_IN_BRACKETS = re.compile(r"(.+?)[\s_,:/]*[(\[{<]\s*(.+?)\s*[)\]}>]", re.DOTALL)
_BEHIND_SLASH = re.compile(r"([^/]*?[^/\s])\s*/\s*(.+)", re.DOTALL)
_BEHIND_COMMA = re.compile(r"(.+?)\s*[,:;]\s*(.+)", re.DOTALL)


class Reading(NamedTuple):
    """A header as a name and, if it has one, the text of a unit."""

    name: str
    unit: str | None


def readings_of(header: Header) -> Iterator[Reading]:
    """Every way to part a header into a name and a unit, the plainest first."""
    yield Reading(header.name, header.unit)
    if header.unit:
        return
    for pattern in (_IN_BRACKETS, _BEHIND_SLASH, _BEHIND_COMMA):
        if found := pattern.fullmatch(header.raw):
            unit = found[2].strip()
            yield Reading(found[1].strip(), unit[1:-1] if unit[:1] + unit[-1:] == "()" else unit)
    for gap in re.finditer(r"[_\s.]+", header.raw):
        name, unit = header.raw[: gap.start()], header.raw[gap.end() :]
        if name and unit and unit[0] not in "([{<":
            yield Reading(name, unit)


def unit_in(text: str, kinds: tuple[str, ...]) -> str | None:
    """A text as a unit of one of these kinds; None if it is none, or could be two.

    Args:
        text: as it stands in a header.
        kinds: units whose dimension is expected; "any" expects none.
    """
    if _is(text, kinds):
        return text
    if ANY in kinds:
        return None
    meant = {u for u, spelled in _SPELLINGS.items() if text in spelled and _is(u, kinds)}
    folded = {u for u in (*BASE, *DERIVED) if u.lower() == text.lower() and _is(u, kinds)}
    lower = text.lower()
    found = meant or folded or ({lower} if _is(lower, kinds) else set())
    return found.pop() if len(found) == 1 else None


def _is(unit: str, kinds: tuple[str, ...]) -> bool:
    """Whether a text is a known unit of one of these kinds."""
    try:
        return any(same_dimension(unit, unit if kind == ANY else kind) for kind in kinds)
    except InputError:
        return False


def plain(name: str) -> str:
    """A name without what people write differently: case, spaces, "temp" for temperature."""
    words = re.sub(r"[^a-z0-9]+", "_", _parted(name).lower()).strip("_").split("_")
    return "_".join("temperature" if word in ("temp", "tmp") else word for word in words)


def _parted(name: str) -> str:
    """boardTemp as board_Temp."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
