"""Certificate data from a TOML file, and the PTB's digital calibration certificate (DCC).

ISO/IEC 17025:2017, 7.8.2 and 7.8.4, list the contents of a calibration certificate: device, place, people, conditions,
standards and dates. The TOML file is optional: a report without it lacks only these data.

The DCC is XML of schema 3.2.1, with numbers and units in D-SI. Its units are coherent SI: an acceleration in local g is
converted to m/s². Schema and meaning: Physikalisch-Technische Bundesanstalt, https://www.ptb.de/dcc (dcc.xsd 3.2.1) and
https://www.ptb.de/si (SI_Format.xsd 2.1.0); S. Hackel et al., The Digital Calibration Certificate,
PTB-Mitteilungen 127 (2017) 4, doi 10.7795/310.20170403; D. Hutzschenreuter et al., SmartCom Digital System of Units
(D-SI) Guide, doi 10.5281/zenodo.3522631. The DCC is not signed; sealing it is left to the laboratory.
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
from bayescal._annexes.metrology.decide import Decisions, format_statement

# Section → key → label for readers.
SECTIONS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("sections.toml").read_text("utf-8")
)
DATE_KEYS = ("issued", "begin", "end", "valid_until")
LIST_SECTIONS = ("standards",)
# Numbers such as a serial number are taken verbatim.
_TEXT = str | int | float
_KEYS = {
    s: TypedDict(s, {k: date if k in DATE_KEYS else _TEXT for k in keys}, total=False)
    for s, keys in SECTIONS.items()
}
CertificateStatement = TypedDict(
    "CertificateStatement",
    {s: list[keys] if s in LIST_SECTIONS else keys for s, keys in _KEYS.items()}
    | {"conditions": dict[str, _TEXT]},
    total=False,
)
REMEDY = "Write sections such as [device], and [[standards]] for each standard, texts in quotes, dates as 2026-11-22"


@dataclass(frozen=True)
class Certificate:
    """Data for a calibration certificate, as stated by the laboratory."""

    data: dict[str, Any]  # section → key → value; `standards`: a list; `conditions`: by name
    file: str = "the certificate"  # name of its file, for messages

    def entries(self, section: str) -> list[dict[str, str]]:
        """Return a section as a list of key → text: one entry, one per item of a list, or none if it is absent."""
        section_data = self.data.get(section, [])
        entries = section_data if isinstance(section_data, list) else [section_data]
        return [{key: str(value).strip() for key, value in entry.items()} for entry in entries]

    def get(self, section: str, key: str) -> str:
        """Return a stated value as text; "" if there is none."""
        return next((entry.get(key, "") for entry in self.entries(section)), "")

    @property
    def conditions(self) -> dict[str, str]:
        """Return the values of the ambient conditions as text, by condition."""
        return next(iter(self.entries("conditions")), {})

    def require(self, *keys: str) -> None:
        """Require keys such as "device.serial"; raise InputError with all missing keys."""
        if absent_keys := [n for n in keys if not self.get(*n.split("."))]:
            raise bc.InputError(
                f"{self.file} does not state {', '.join(absent_keys)}, which a digital calibration certificate needs: "
                "add " + "; ".join(f"[{s}] {k} = …" for s, k in (n.split(".") for n in absent_keys))
            )

    def foreword(self, chapters: Sequence[ws.Chapter]) -> ws.Foreword:
        """Build a report's foreword with the certificate data."""
        return ws.Foreword(
            "certificate",
            "Certificate data",
            "Stated by the laboratory; bayescal has neither measured nor checked the data of this section.",
            lists=tuple(self.rows()),
        )

    def rows(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """Return the stated data by section: its name, and pairs of label and text."""
        rows = []
        for section, keys in SECTIONS.items():
            for entry in self.entries(section):
                items = [(label, entry[key]) for key, label in keys.items() if entry.get(key)]
                rows += [(section, items)] * bool(items)
            if section == "calibration" and self.conditions:
                rows.append(("ambient conditions", list(self.conditions.items())))
        return rows


def read_certificate(path: str | Path) -> Certificate:
    """Read certificate data from a TOML file.

    Raises:
        InputError: the file does not exist, is empty or is not TOML; a key is unknown; a value is not the expected text
            or date; or the calibration ends before it begins. The message names section and key.
    """
    path = Path(path)
    data = ws.read_toml(path, CertificateStatement, f"{str(path)!r}", REMEDY)
    if not data:
        raise bc.InputError(f"{str(path)!r} is empty: write [device], name = and serial =")
    begin, end = (data.get("calibration", {}).get(k) for k in ("begin", "end"))
    if begin and end and end < begin:
        raise bc.InputError(f"{str(path)!r}, [calibration]: end ({end}) is before begin ({begin})")
    return Certificate(data, path.name)


SCHEMA_VERSION = "3.2.1"
REQUIRED_KEYS = (
    *("certificate.number", "device.name", "device.serial", "calibration.begin", "calibration.end"),
    *("laboratory.name", "laboratory.country", "laboratory.responsible"),
    *("customer.name", "customer.country"),
)
IntervalEnds = tuple[float, float] | None  # of a 95 % interval
COVERAGE_FACTOR, COVERAGE = 2.0, 0.9545  # for a normal distribution (JCGM 100, table G.1)


class DsiReal(NamedTuple):
    """A number in D-SI with its uncertainty."""

    value: str
    unit: str
    form: str  # of the uncertainty: "expandedUnc", "coverageInterval", or empty for none
    elements: dict[str, str]  # of the uncertainty: element → text


_NOT_XML = "[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]"  # XML 1.0, 2.2


def _to_xml_text(value: Any) -> str:
    """Convert a value to text; replace characters that XML forbids by their code points, such as <U+0000>."""
    return re.sub(_NOT_XML, lambda match: f"<U+{ord(match[0]):04X}>", str(value))


def generate_dcc(
    calibration: bc.Calibration,
    certificate: Certificate | str | Path,
    local_gravity: float = ws.STANDARD_GRAVITY,
    decisions: Decisions | None = None,
) -> str:
    """Generate the digital calibration certificate (DCC) of a reliable fit as XML, with decisions on conformity.

    Raises:
        InputError: the result is not reliable, or the certificate data lack keys that the schema requires.
    """
    stated = certificate if isinstance(certificate, Certificate) else read_certificate(certificate)
    stated.require(*REQUIRED_KEYS)
    for section in ("laboratory", "customer"):
        country = stated.get(section, "country")
        if not re.fullmatch("[A-Z]{2}", country):
            raise bc.InputError(
                f"{stated.file}, [{section}] country = {country!r}: expected two letters of ISO 3166-1, such as DE"
            )
    if reason := ws.why_not(calibration):
        raise bc.InputError(f"no certificate can be written for an unreliable result: {reason}")
    conditions = {**stated.conditions, "place": stated.get("calibration", "place")}
    layout = ws.load_template(
        "bayescal._annexes.metrology",
        "dcc.xml.jinja",
        {"statement_lines": format_statement},
        autoescape=True,
        finalize=lambda value: value if isinstance(value, Markup) else _to_xml_text(value),
    )
    xml = layout.render(
        schema=SCHEMA_VERSION,
        version=bc.__version__,
        stated=stated,
        conditions={name: value for name, value in conditions.items() if value},
        identity=ws.identity(calibration),
        sources=ws.list_sources(calibration.readings),
        calibration=calibration,
        k=f"{COVERAGE_FACTOR:g}",
        covered=list(_find_ranges(calibration, local_gravity)),
        quantities=list(_list_quantities(calibration, local_gravity)),
        decisions=decisions,
    )
    for prefix, space in (("dcc", "https://ptb.de/dcc"), ("si", "https://ptb.de/si")):
        ET.register_namespace(prefix, space)
    root = ET.fromstring(xml)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _find_ranges(fit: bc.Calibration, gravity: float) -> Iterator[tuple[str, DsiReal, DsiReal]]:
    """Yield the range of each numeric column of the readings but the output: name, lowest and highest value."""
    readings = fit.readings
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is not None and not name.startswith("output"):
            low, high = float(readings[name].min()), float(readings[name].max())
            yield name, format_dsi(low, unit, gravity), format_dsi(high, unit, gravity)


def _list_quantities(fit: bc.Calibration, gravity: float) -> Iterator[tuple[str, DsiReal]]:
    for name, (value, unit) in fit.reference_constants.items():
        yield f"{name}, to which coefficients refer", format_dsi(value, unit, gravity)
    coefficients, hyperparameters = ws.summary(fit)
    not_measured = ws.find_prior_dominated_coefficients(fit)
    for row in coefficients:
        name = row["name"] + ", determined by its prior" * (row["name"] in not_measured)
        yield name, format_dsi(row["mean"], row["unit"], gravity, row["sd"])
    for row in hyperparameters:  # positive and skewed: an interval instead of a multiple of u
        interval = row["interval95"]
        yield row["name"], format_dsi(row["mean"], row["unit"], gravity, row["sd"], interval)


def format_dsi(
    value: float, unit: str | None, gravity: float, sd: float = 0, ends: IntervalEnds = None
) -> DsiReal:
    """Format a number in D-SI with its expanded uncertainty, or, if given, with the `ends` of its 95 % interval.

    The uncertainty has two significant digits, and the value as many decimals (JCGM 100, 7.2.6).
    """
    factor, text = find_d_si(unit, gravity)
    value, sd, k = float(value) * factor, float(sd) * factor, COVERAGE_FACTOR
    number = DsiReal(_round_value(value, k * sd), text, "", {})
    if not sd > 0:
        return number
    if ends is not None:
        low, high = (_round_value(end * factor, sd) for end in ends)
        interval = {"standardUnc": _round_value(sd, sd), "intervalMin": low, "intervalMax": high}
        interval["coverageProbability"] = "0.95"
        return number._replace(form="coverageInterval", elements=interval)
    elements = {"uncertainty": _round_value(k * sd, k * sd), "coverageFactor": f"{k:g}"}
    elements |= {"coverageProbability": f"{COVERAGE:g}", "distribution": "normal"}
    return number._replace(form="expandedUnc", elements=elements)


D_SI = {  # unit → unit in D-SI
    **{"s": "second", "K": "kelvin", "rad": "radian", "V": "volt", "Hz": "hertz", "m": "metre"},
    **{"A": "ampere", "Pa": "pascal", "uT": "tesla", "count": "one", "kg": "kilogram"},
    **{"N": "newton", "ohm": "ohm", "W": "watt", "mol": "mole"},
}


def find_d_si(unit: str | None, local_gravity: float = ws.STANDARD_GRAVITY) -> tuple[float, str]:
    """Return a unit's factor to D-SI and its text, such as \\radian\\second\\tothe{-1}; raise InputError if invalid."""
    if unit in (None, "", "1"):
        return 1.0, "\\one"
    if unit == "degC":
        return 1.0, "\\degreecelsius"
    parsed = ws.parse(unit)
    factor, powers = parsed.factor, dict[str, float]()
    for base, power in parsed.powers.items():
        if base == "ug":
            factor *= (1e-6 * local_gravity) ** power
            si_powers = {"metre": power, "second": -2 * power}
        else:
            factor *= 1e-6**power if base == "uT" else 1.0
            si_powers = {D_SI[base]: power}
        for name, p in si_powers.items():
            powers[name] = powers.get(name, 0.0) + p
    texts = (f"\\{name}" + f"\\tothe{{{p:g}}}" * (p != 1) for name, p in powers.items() if p)
    return factor, "".join(texts) or "\\one"


def _round_value(value: float, uncertainty: float) -> str:
    """Round a number to the second significant digit of its uncertainty; keep it if the uncertainty is zero."""
    if not uncertainty > 0:
        return repr(value)
    last_digit = Decimal(1).scaleb(math.floor(math.log10(uncertainty)) - 1)
    return str(Decimal(value).quantize(last_digit))
