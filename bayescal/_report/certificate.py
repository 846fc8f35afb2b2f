"""What a certificate states beside the numbers: device, place, people, conditions, standards, dates; from a TOML file.

ISO/IEC 17025:2017, 7.8.2 and 7.8.4, say what belongs on a calibration certificate. Nothing of it is asked for by
anyone who wants none: a report without such a file is as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_toml

# Section → key → what a person reads. A section in lists may stand several times.
_PLACE = {"street": "street", "city": "city", "postcode": "postcode", "country": "country"}
_MADE = {"manufacturer": "manufacturer", "model": "type", "serial": "serial number"}
SECTIONS: dict[str, dict[str, str]] = {
    "certificate": {"number": "certificate", "issued": "issued", "remarks": "remarks"},
    "device": {"name": "device", **_MADE, "owner_number": "owner's number"},
    "calibration": {
        **{"begin": "calibrated from", "end": "calibrated to", "place": "place"},
        **{"operator": "operator", "procedure": "procedure"},
    },
    "laboratory": {
        **{"name": "laboratory", **_PLACE, "email": "e-mail"},
        **{"accreditation": "accreditation", "responsible": "responsible person"},
    },
    "customer": {"name": "customer", **_PLACE, "email": "e-mail"},
    "standards": {
        **{"name": "standard", **_MADE, "certificate": "its certificate"},
        **{"traceable_to": "traceable to", "valid_until": "valid until"},
    },
}
DATES = ("issued", "begin", "end", "valid_until")
LISTS = ("standards",)
CONDITIONS = "conditions"  # free: name → text


@dataclass(frozen=True)
class Certificate:
    """What a certificate states.

    Attributes:
        stated: section → key → value; `standards` is a list of such.
        conditions: ambient condition → its value, as text with unit and uncertainty.
        file: where it was read, for messages.
    """

    stated: dict[str, Any]
    conditions: dict[str, str] = field(default_factory=dict)
    file: str = "the certificate"

    def get(self, section: str, key: str) -> str:
        """What is stated, as text; "" if nothing is."""
        value = self.stated.get(section, {}).get(key, "")
        return value.isoformat() if isinstance(value, date) else value

    def require(self, *needed: str) -> None:
        """Refuse a certificate that does not state all that is needed, such as "device.serial".

        Raises:
            InputError: something is missing; all of it is named.
        """
        missing = [n for n in needed if not self.get(*n.split("."))]
        if missing:
            raise InputError(
                f"{self.file} does not state {', '.join(missing)}, which a digital calibration certificate needs: "
                "add " + "; ".join(f"[{s}] {k} = …" for s, k in (n.split(".") for n in missing))
            )

    def rows(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """Section → (label, text) of what is stated, for people."""
        found = []
        for section, keys in SECTIONS.items():
            given = self.stated.get(section, {})
            for one in given if section in LISTS else [given]:
                said = [
                    (label, one[key].isoformat() if isinstance(one[key], date) else one[key])
                    for key, label in keys.items()
                    if key in one
                ]
                found += [(section, said)] * bool(said)
            if section == "calibration" and self.conditions:
                found.append(("ambient conditions", list(self.conditions.items())))
        return found


def read_certificate(path: str | Path) -> Certificate:
    """What a certificate states, from a TOML file.

    Raises:
        InputError: there is no such file, it is not TOML, it states nothing, or something in it is not known, no
            text, or no date; names section and key.
    """
    path = Path(path)
    try:
        data = read_toml(path)
    except OSError as error:
        raise InputError(
            f"{str(path)!r} cannot be read: {error.strerror or error}. Check the name and the folder"
        ) from None
    except ValueError as error:
        raise InputError(f"{path.name!r} is not TOML: {error}") from None
    known = [*SECTIONS, CONDITIONS]
    stated: dict[str, Any] = {}
    for section, given in data.items():
        where = f"{path.name!r}, [{section}]"
        if section not in known:
            raise InputError(f"{where}: no such section; there are: {', '.join(known)}")
        if section in LISTS:
            if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
                raise InputError(f"{where}: write [[{section}]], once for each")
            stated[section] = [_checked(one, section, where) for one in given]
        elif not isinstance(given, dict):
            raise InputError(f"{where}: a section was expected, with keys below it")
        elif section != CONDITIONS:
            stated[section] = _checked(given, section, where)
    if not data:
        raise InputError(f"{path.name!r} states nothing: write [device], name = and serial =")
    conditions = {
        k: _text(v, f"{path.name!r}, [{CONDITIONS}] {k}")
        for k, v in data.get(CONDITIONS, {}).items()
    }
    begin, end = (stated.get("calibration", {}).get(k) for k in ("begin", "end"))
    if begin and end and end < begin:
        raise InputError(
            f"{path.name!r}, [calibration]: it ends ({end}) before it begins ({begin})"
        )
    return Certificate(stated, conditions, path.name)


def _checked(given: dict[str, Any], section: str, where: str) -> dict[str, Any]:
    keys = SECTIONS[section]
    found: dict[str, Any] = {}
    for key, value in given.items():
        if key not in keys:
            raise InputError(f"{where}: no such key {key!r}; there are: {', '.join(keys)}")
        if key in DATES:
            if type(value) is not date:
                raise InputError(
                    f"{where} {key} = {value!r}: a date was expected, {key} = 2026-11-22"
                )
            found[key] = value
        else:
            found[key] = _text(value, f"{where} {key}")
    return found


def _text(value: Any, where: str) -> str:
    """A value as text: what is written as a number (a serial number) is taken as it stands."""
    if (
        isinstance(value, bool)
        or not isinstance(value, str | int | float)
        or not str(value).strip()
    ):
        raise InputError(f"{where} = {value!r}: text was expected, in quotes")
    return str(value).strip()
