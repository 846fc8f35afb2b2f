"""Certificate data from a TOML file, and the PTB's digital calibration certificate (DCC).

Device, place, people, conditions, standards, dates: ISO/IEC 17025:2017, 7.8.2 and 7.8.4, say what belongs on a
calibration certificate. The file is optional: a report without it lacks only these data.

The DCC is XML, schema 3.2.1, numbers and units in D-SI. Units of D-SI are coherent SI: an acceleration in local g is in
m/s². Schema and meaning: Physikalisch-Technische Bundesanstalt, https://www.ptb.de/dcc (dcc.xsd 3.2.1) and
https://www.ptb.de/si (SI_Format.xsd 2.1.0); S. Hackel et al., The Digital Calibration Certificate,
PTB-Mitteilungen 127 (2017) 4, doi 10.7795/310.20170403; D. Hutzschenreuter et al., SmartCom Digital System of Units
(D-SI) Guide, doi 10.5281/zenodo.3522631.
The file is not signed: a seal is the laboratory's.
"""

from __future__ import annotations

import math
import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

from markupsafe import Markup

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.metrology.decide import Decisions, statement_lines

# Section → key → what a person reads.
SECTIONS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("sections.toml").read_text("utf-8")
)
DATES = ("issued", "begin", "end", "valid_until")
LISTS = ("standards",)
# Numbers such as a serial number are taken verbatim.
_TEXT = str | int | float
_KEYS = {
    s: TypedDict(s, {k: date if k in DATES else _TEXT for k in keys}, total=False)
    for s, keys in SECTIONS.items()
}
Stated = TypedDict(
    "Stated",
    {s: list[keys] if s in LISTS else keys for s, keys in _KEYS.items()}
    | {"conditions": dict[str, _TEXT]},
    total=False,
)
CURE = "It has sections such as [device], and [[standards]], once for each; texts in quotes, and dates as 2026-11-22"


@dataclass(frozen=True)
class Certificate:
    """Data that a certificate states."""

    stated: dict[str, Any]  # section → key → value; `standards`: a list; `conditions`: by name
    file: str = "the certificate"  # where it was read, for messages

    def get(self, section: str, key: str) -> str:
        """Return a stated value as text; "" if there is none."""
        return str(self.stated.get(section, {}).get(key, "")).strip()

    @property
    def conditions(self) -> dict[str, str]:
        """Return ambient condition → its value, as text."""
        return {name: str(value) for name, value in self.stated.get("conditions", {}).items()}

    def require(self, *needed: str) -> None:
        """Require keys such as "device.serial"; raise InputError that names all that are missing."""
        missing = [n for n in needed if not self.get(*n.split("."))]
        if missing:
            raise bc.InputError(
                f"{self.file} does not state {', '.join(missing)}, which a digital calibration certificate needs: "
                "add " + "; ".join(f"[{s}] {k} = …" for s, k in (n.split(".") for n in missing))
            )

    def foreword(self, chapters: Sequence[ws.Chapter]) -> ws.Foreword:
        """Return the certificate data as the foreword of a report."""
        return ws.Foreword(
            "certificate",
            "Certificate data",
            "Stated by the laboratory; nothing of this section was measured or checked by bayescal.",
            lists=tuple(self.rows()),
        )

    def rows(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """Return section → (label, text) of the stated data, for people."""
        rows = []
        for section, keys in SECTIONS.items():
            fields = self.stated.get(section, {})
            for entry in fields if section in LISTS else [fields]:
                texts = {label: str(entry.get(key, "")).strip() for key, label in keys.items()}
                filled = [(label, text) for label, text in texts.items() if text]
                rows += [(section, filled)] * bool(filled)
            if section == "calibration" and self.conditions:
                rows.append(("ambient conditions", list(self.conditions.items())))
        return rows


def read_certificate(path: str | Path) -> Certificate:
    """Read certificate data from a TOML file.

    Raises:
        InputError: there is no such file, it is not TOML, it states nothing, or something in it is not known, no
            text, or no date; names section and key, what came and what was expected.
    """
    path = Path(path)
    stated = ws.read_toml(path, Stated, f"{str(path)!r}", CURE)
    if not stated:
        raise bc.InputError(f"{str(path)!r} states nothing: write [device], name = and serial =")
    begin, end = (stated.get("calibration", {}).get(k) for k in ("begin", "end"))
    if begin and end and end < begin:
        why = f"{str(path)!r}, [calibration]: it ends ({end}) before it begins ({begin})"
        raise bc.InputError(why)
    return Certificate(stated, path.name)


SCHEMA = "3.2.1"
NEEDED = (
    *("certificate.number", "device.name", "device.serial", "calibration.begin", "calibration.end"),
    *("laboratory.name", "laboratory.country", "laboratory.responsible"),
    *("customer.name", "customer.country"),
)
K, PROBABILITY = 2.0, 0.9545  # coverage of k = 2 for a normal distribution (JCGM 100, table G.1)


class Real(NamedTuple):
    """A number in D-SI: value, unit, and the elements of its uncertainty in the form `form`."""

    value: str
    unit: str
    form: str
    spread: dict[str, str]


_NOT_XML = "[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]"  # XML 1.0, 2.2


def _xml_text(value: Any) -> str:
    """Return text with characters that XML forbids, even escaped, replaced by <U+0000>."""
    return re.sub(_NOT_XML, lambda match: f"<U+{ord(match[0]):04X}>", str(value))


def dcc_text(
    calibration: bc.Calibration,
    certificate: Certificate | str | Path,
    local_gravity: float = ws.STANDARD_GRAVITY,
    decisions: Decisions | None = None,
) -> str:
    """Generate the certificate as XML: of a reliable fit, what is stated beside it, and decisions on conformity.

    Raises:
        InputError: the result is not reliable, or the certificate does not state what the schema needs.
    """
    stated = certificate if isinstance(certificate, Certificate) else read_certificate(certificate)
    stated.require(*NEEDED)
    for section in ("laboratory", "customer"):
        country = stated.get(section, "country")
        if not re.fullmatch("[A-Z]{2}", country):
            raise bc.InputError(
                f"{stated.file}, [{section}] country = {country!r}: two capital letters of ISO 3166-1 were expected, "
                "such as DE"
            )
    if reason := ws.why_not(calibration):
        raise bc.InputError(f"no certificate is written of a result that is not reliable: {reason}")
    conditions = {**stated.conditions, "place": stated.get("calibration", "place")}
    layout = ws.template(
        "bayescal._annexes.metrology",
        "dcc.xml.jinja",
        {"statement_lines": statement_lines},
        autoescape=True,
        finalize=lambda value: value if isinstance(value, Markup) else _xml_text(value),
    )
    read = ws.sources_of(calibration.readings)
    files = (("other", f"SHA-256 of {s.file}", s.sha256) for s in read)
    written = layout.render(
        schema=SCHEMA,
        version=bc.__version__,
        stated=stated,
        standards=[
            {key: entry.get(key, "") for key in SECTIONS["standards"]}
            for entry in stated.stated.get("standards", [])
            if "name" in entry
        ],
        conditions={name: reason for name, reason in conditions.items() if reason},
        hashes=[("other", "calibration, SHA-256", ws.identity(calibration)), *files],
        model=calibration.model,
        description="Coefficients of the measurement equation, with U = k*u, k = "
        f"{K:g}; each effect adds its equation, times its coefficients, to a slot. Effects: "
        + "; ".join(f"{e.name} in {e.slot}: {e.equation}" for e in calibration.model.effects)
        + ". Coefficients are correlated; their covariance is in the calibration that the SHA-256 names. All holds "
        "within the influence conditions as covered.",
        method=f"{calibration.method}, seed {calibration.seed}",
        covered=list(_covered(calibration, local_gravity)),
        quantities=list(_quantities(calibration, local_gravity)),
        decisions=decisions,
    )
    for prefix, space in (("dcc", "https://ptb.de/dcc"), ("si", "https://ptb.de/si")):
        ET.register_namespace(prefix, space)
    root = ET.fromstring(written)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _covered(calibration: bc.Calibration, local_gravity: float) -> Iterator[tuple[str, Real, Real]]:
    """Yield the range of each column of the readings: name, lowest and highest value."""
    readings = calibration.readings
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is not None and not name.startswith("output"):
            low, high = float(readings[name].min()), float(readings[name].max())
            yield name, real(low, unit, local_gravity), real(high, unit, local_gravity)


def _quantities(calibration: bc.Calibration, local_gravity: float) -> Iterator[tuple[str, Real]]:
    for name, (value, unit) in calibration.reference_constants.items():
        yield f"{name}, at which constants hold", real(value, unit, local_gravity)
    coefficients, hyperparameters = ws.summary(calibration)
    untold = ws.find_coefficients_not_measured(calibration)
    for row in coefficients:
        name = row["name"] + ", by its prior more than by the readings" * (row["name"] in untold)
        yield name, real(row["mean"], row["unit"], local_gravity, row["sd"])
    for row in hyperparameters:  # positive and skewed: no multiple of u covers
        ends = row["interval95"]
        yield row["name"], real(row["mean"], row["unit"], local_gravity, row["sd"], ends)


Ends = tuple[float, float] | None  # of a 95 % interval


def real(value: float, unit: str | None, gravity: float, sd: float = 0, ends: Ends = None) -> Real:
    """Return a number with its unit, and its expanded uncertainty or the ends of its 95 % interval, if it has one.

    The uncertainty has two significant digits, and the value as many decimals (JCGM 100, 7.2.6).
    """
    factor, text = d_si(unit, gravity)
    value, sd = float(value) * factor, float(sd) * factor
    number = Real(_round(value, K * sd), text, "", {})
    if not sd > 0:
        return number
    if ends is not None:
        low, high = (_round(end * factor, sd) for end in ends)
        interval = {"standardUnc": _round(sd, sd), "intervalMin": low, "intervalMax": high}
        interval["coverageProbability"] = "0.95"
        return number._replace(form="coverageInterval", spread=interval)
    expanded = {"uncertainty": _round(K * sd, K * sd), "coverageFactor": f"{K:g}"}
    expanded |= {"coverageProbability": f"{PROBABILITY:g}", "distribution": "normal"}
    return number._replace(form="expandedUnc", spread=expanded)


D_SI = {
    **{"s": "second", "K": "kelvin", "rad": "radian", "V": "volt", "Hz": "hertz", "m": "metre"},
    **{"A": "ampere", "Pa": "pascal", "uT": "tesla", "count": "one", "kg": "kilogram"},
    **{"N": "newton", "ohm": "ohm", "W": "watt", "mol": "mole"},
}


def d_si(unit: str | None, local_gravity: float = ws.STANDARD_GRAVITY) -> tuple[float, str]:
    """Return a unit's factor and D-SI text, such as \\radian\\second\\tothe{-1}; raise InputError if it is none."""
    if unit in (None, "", "1"):
        return 1.0, "\\one"
    if unit == "degC":
        return 1.0, "\\degreecelsius"
    parsed = ws.parse(unit)
    factor, powers = parsed.factor, dict[str, float]()
    for base, power in parsed.powers.items():
        if base == "ug":
            factor *= (1e-6 * local_gravity) ** power
            parts = {"metre": power, "second": -2 * power}
        else:
            factor *= 1e-6**power if base == "uT" else 1.0
            parts = {D_SI[base]: power}
        for name, p in parts.items():
            powers[name] = powers.get(name, 0.0) + p
    text = "".join(
        f"\\{name}" + ("" if p == 1 else f"\\tothe{{{p:g}}}") for name, p in powers.items() if p
    )
    return factor, text or "\\one"


def _round(value: float, uncertainty: float) -> str:
    """Round a number to the second significant digit of its uncertainty; not at all where that is zero."""
    if not uncertainty > 0:
        return repr(value)
    place = Decimal(1).scaleb(math.floor(math.log10(uncertainty)) - 1)
    return str(Decimal(value).quantize(place))
