"""Headers as people write them: "Temp (°C)", "gyro_z_dps", 'angle/"' as a name and a unit.

A header has several possible readings; one counts only if the quantity that is expected there has a unit of its kind.
So "Temp_C" is a temperature in °C, since nothing else that is written C is a temperature.
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import lru_cache

from bayescal._data.unit_conversion import alike
from bayescal._data.unit_parsing import ANY, BASE, DERIVED, SPELLINGS
from bayescal._tables.raw_table import Header

# Spellings that are one thing only where a quantity of this kind is expected.
_SPELLINGS = {
    "degC": ("C", "deg C", "degrees C", "deg. C", "celcius", "Cel", "°", "º", "deg", "degree", "degrees"),
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
_WORDS = {  # may be others
    *("min", "day", "days", "bar", "rev", "count", "counts"),
    *("second", "minute", "hour", "degree"),
}
_BRACKETS = [
    re.compile(rf"(.+?)[\s_,:/]*\{a}\s*(.+?)\s*\{b}", re.DOTALL)
    for a, b in ("()", "[]", "{}", "<>")
]
_BEHIND_SLASH = re.compile(r"([^/]*?[^/\s])\s*/\s*(.+)", re.DOTALL)
_LONGEST = 80  # characters of a header, from its end, in which a unit is looked for
_BEHIND_COMMA = re.compile(r"(.+?)\s*[,:;]\s*(.+)", re.DOTALL)


@lru_cache(maxsize=4096)  # each is asked for by many columns
def readings_of(header: Header) -> tuple[Header, ...]:
    """Every way to part a header into a name and, if it has one, the text of a unit; the plainest first."""
    if header.unit:
        return (header,)
    found = [header]
    before, end = header.raw[:-_LONGEST], header.raw[-_LONGEST:]
    for pattern in (*_BRACKETS, _BEHIND_SLASH, _BEHIND_COMMA):
        if parts := pattern.fullmatch(end):
            unit = parts[2].strip()
            unit = unit[1:-1] if unit[:1] + unit[-1:] == "()" else unit
            found.append(Header(header.raw, (before + parts[1]).strip(), unit))
    for gap in re.finditer(r"[_\s.]+", end):
        name, unit = before + end[: gap.start()], end[gap.end() :]
        if name and unit and unit[0] not in "([{<":
            found.append(Header(header.raw, name, unit))
    return tuple(found)


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
    lower, spellings = text.lower(), _SPELLINGS.items()
    own = {u for u, texts in spellings if text in texts}
    loose = {u for u, texts in spellings if len(text) > 1 and lower in map(str.lower, texts)}
    folded = {u for u in (*BASE, *DERIVED) if u.lower() == lower}
    tried = ({u for u in some if _is(u, kinds)} for some in (own or loose, folded, {lower}))
    found = next((some for some in tried if some), set())
    return found.pop() if len(found) == 1 else None


def unit_behind(header: Header) -> Header | None:
    """The reading of a header that ends in a unit, whatever its quantity: in brackets, or of two letters behind _."""
    if header.unit:
        return None
    for reading in readings_of(header):
        unit = reading.unit or ""
        brackets = header.raw[-1:] in tuple(")]}>")
        if unit_in(unit, (ANY,)) and (brackets or (len(unit) > 1 and unit not in _WORDS)):
            return reading
    return None


def like_a_unit(header: Header) -> str | None:
    """What a header without a known unit ends in that may be meant as one; None if there is nothing of that kind.

    That is what stands in brackets, unless it is a number, and behind a gap what is written nearly as a unit is.
    """
    end = header.raw[-_LONGEST:]
    if found := next((f for p in _BRACKETS if (f := p.fullmatch(end))), None):
        return None if found[2].strip().isdigit() else found[2].strip()
    known = {text for texts in _SPELLINGS.values() for text in texts if text.isascii()}
    for reading in readings_of(header):
        unit = reading.unit or ""
        near = get_close_matches(unit.lower(), _LONG_UNITS, 1, 0.8) if len(unit) > 3 else []
        if (unit in known and unit != "G") or unit == "K" or near:
            return unit
    return None


_LONG_UNITS = [u.lower() for u in (*BASE, *DERIVED, *SPELLINGS) if len(u) > 3 and u not in _WORDS]


def spelled(text: str) -> str | None:
    """The one unit that a text is another spelling of, such as degC of C; None if there is none or several."""
    found = [unit for unit, texts in _SPELLINGS.items() if text in texts]
    return found[0] if len(found) == 1 else None


def _is(unit: str, kinds: tuple[str, ...]) -> bool:
    """Whether a text is a known unit of one of these kinds."""
    return any(alike(unit, unit if kind == ANY else kind) for kind in kinds)


def plain(name: str) -> str:
    """A name without what people write differently: case, spaces, "temp" for temperature."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)  # boardTemp as board_Temp
    words = re.sub(r"[^a-z0-9]+", "_", parted.lower()).strip("_").split("_")
    return "_".join("temperature" if word in ("temp", "tmp") else word for word in words)
