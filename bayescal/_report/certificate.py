"""What a certificate states beside the numbers: device, place, people, conditions, standards, dates; from a TOML file.

ISO/IEC 17025:2017, 7.8.2 and 7.8.4, say what belongs on a calibration certificate. Nothing of it is asked for by
anyone who wants none: a report without such a file is as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from bayescal._core.errors import InputError
from bayescal._core.json_shape import OneOf, read_toml

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
# What is written as a number (a serial number) is taken as it stands.
_TEXT = OneOf(str, int, float)
_KEYS = {s: {f"{k}?": date if k in DATES else _TEXT for k in keys} for s, keys in SECTIONS.items()}
SHAPE = {
    **{f"{s}?": [keys] if s in LISTS else keys for s, keys in _KEYS.items()},
    "conditions?": {str: _TEXT},
}
CURE = "It has sections such as [device], and [[standards]], once for each; texts in quotes, and dates as 2026-11-22"


@dataclass(frozen=True)
class Certificate:
    """What a certificate states.

    Attributes:
        stated: section → key → value; `standards` is a list of such; `conditions`: ambient condition → its value, with
            unit and uncertainty.
        file: where it was read, for messages.
    """

    stated: dict[str, Any]
    file: str = "the certificate"

    def get(self, section: str, key: str) -> str:
        """What is stated, as text; "" if nothing is."""
        return str(self.stated.get(section, {}).get(key, "")).strip()

    @property
    def conditions(self) -> dict[str, str]:
        """Ambient condition → its value, as text."""
        return {name: str(value) for name, value in self.stated.get("conditions", {}).items()}

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
                texts = {label: str(one.get(key, "")).strip() for key, label in keys.items()}
                said = [(label, text) for label, text in texts.items() if text]
                found += [(section, said)] * bool(said)
            if section == "calibration" and self.conditions:
                found.append(("ambient conditions", list(self.conditions.items())))
        return found


def read_certificate(path: str | Path) -> Certificate:
    """What a certificate states, from a TOML file.

    Raises:
        InputError: there is no such file, it is not TOML, it states nothing, or something in it is not known, no
            text, or no date; names section and key, what came and what was expected.
    """
    path = Path(path)
    stated = read_toml(path, SHAPE, f"{str(path)!r}", CURE)
    if not stated:
        raise InputError(f"{str(path)!r} states nothing: write [device], name = and serial =")
    begin, end = (stated.get("calibration", {}).get(k) for k in ("begin", "end"))
    if begin and end and end < begin:
        raise InputError(
            f"{str(path)!r}, [calibration]: it ends ({end}) before it begins ({begin})"
        )
    return Certificate(stated, path.name)
