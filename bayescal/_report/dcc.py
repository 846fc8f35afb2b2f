"""A digital calibration certificate (DCC) of the PTB: XML, schema 3.2.1, numbers and units in D-SI.

Schema and meaning: Physikalisch-Technische Bundesanstalt, https://www.ptb.de/dcc (dcc.xsd 3.2.1) and
https://www.ptb.de/si (SI_Format.xsd 2.1.0); S. Hackel et al., The Digital Calibration Certificate,
PTB-Mitteilungen 127 (2017) 4, doi 10.7795/310.20170403.
The file is not signed: a seal is the laboratory's.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity, sources_of
from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.quoting import xml_text
from bayescal._core.version import __version__
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._report.certificate import Certificate, read_certificate
from bayescal._report.d_si import d_si
from bayescal._use.decision import ACCEPT, REJECT, Decisions, statement_lines

SCHEMA = "3.2.1"
DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
NEEDED = (
    *("certificate.number", "device.name", "device.serial", "calibration.begin", "calibration.end"),
    *("laboratory.name", "laboratory.country", "laboratory.responsible"),
    *("customer.name", "customer.country"),
)
# Of decisions; the schema has no word for one that was not made: then the declaration alone says so.
CONFORMITY = {ACCEPT: "pass", REJECT: "fail"}
NORMS = ("ISO/IEC 17025:2017, 7.8.6", "JCGM 106:2012")
K, PROBABILITY = 2.0, 0.9545  # coverage of k = 2 for a normal distribution (JCGM 100, table G.1)


def dcc_text(
    calibration: Calibration,
    certificate: Certificate | str | Path,
    local_gravity: float = STANDARD_GRAVITY,
    decisions: Decisions | None = None,
) -> str:
    """The certificate as XML.

    Args:
        calibration: a reliable fit.
        certificate: what it states beside the numbers, or the TOML file of it.
        local_gravity: m/s², that one g of the calibration is.
        decisions: statements of conformity, with their rule.

    Raises:
        InputError: the result is not reliable, or the certificate does not state what the schema needs.
    """
    stated = certificate if isinstance(certificate, Certificate) else read_certificate(certificate)
    stated.require(*NEEDED)
    for section in ("laboratory", "customer"):
        country = stated.get(section, "country")
        if not re.fullmatch("[A-Z]{2}", country):
            raise InputError(
                f"{stated.file}, [{section}] country = {country!r}: two capital letters of ISO 3166-1 were expected, "
                "such as DE"
            )
    if not calibration.verdict.reliable:
        raise InputError(
            f"no certificate is written of a result that is not reliable: {calibration.verdict.why_not}"
        )
    ET.register_namespace("dcc", DCC)
    ET.register_namespace("si", SI)
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion=SCHEMA)
    _administrative(root, calibration, stated)
    results = _add(root, "measurementResults")
    result = _add(results, "measurementResult")
    _results(result, calibration, stated, local_gravity)
    if decisions is not None:
        _statements(_add(result, "measurementMetaData"), decisions)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _add(parent: ET.Element, name: str, text: str | None = None, space: str = DCC) -> ET.Element:
    made = ET.SubElement(parent, f"{{{space}}}{name}")
    made.text = None if text is None else xml_text(text)
    return made


def _said(parent: ET.Element, name: str, *texts: str) -> ET.Element:
    """An element that holds text in a language."""
    made = _add(parent, name)
    for text in texts:
        ET.SubElement(made, f"{{{DCC}}}content", lang="en").text = xml_text(text)
    return made


def _identifications(parent: ET.Element, given: Mapping[tuple[str, str], str]) -> None:
    """Identifications: (who gave it, what it is) → it."""
    listed = _add(parent, "identifications")
    for (issuer, name), value in given.items():
        one = _add(listed, "identification")
        _add(one, "issuer", issuer)
        _add(one, "value", " ".join(value.split()))
        _said(one, "name", name)


def _contact(parent: ET.Element, name: str, stated: Certificate, section: str) -> None:
    contact = _add(parent, name)
    _said(contact, "name", stated.get(section, "name"))
    if email := stated.get(section, "email"):
        _add(contact, "eMail", email)
    location = _add(contact, "location")
    parts = {
        "city": "city",
        "countryCode": "country",
        "postCode": "postcode",
        "street": "street",
    }
    for element, key in parts.items():
        if text := stated.get(section, key):
            _add(location, element, text)


def _software(parent: ET.Element, name: str) -> None:
    one = _add(_add(parent, name), "software")
    _said(one, "name", "bayescal")
    _add(one, "release", __version__)


def _administrative(root: ET.Element, calibration: Calibration, stated: Certificate) -> None:
    data = _add(root, "administrativeData")
    _software(data, "dccSoftware")
    core = _add(data, "coreData")
    _add(core, "countryCodeISO3166_1", stated.get("laboratory", "country"))
    _add(core, "usedLangCodeISO639_1", "en")
    _add(core, "mandatoryLangCodeISO639_1", "en")
    _add(core, "uniqueIdentifier", stated.get("certificate", "number"))
    files = {("other", f"SHA-256 of {s.file}"): s.sha256 for s in sources_of(calibration.readings)}
    _identifications(core, {("other", "calibration, SHA-256"): identity(calibration), **files})
    _add(core, "beginPerformanceDate", stated.get("calibration", "begin"))
    _add(core, "endPerformanceDate", stated.get("calibration", "end"))
    _add(core, "performanceLocation", "laboratory")
    if issued := stated.get("certificate", "issued"):
        _add(core, "issueDate", issued)
    item = _add(_add(data, "items"), "item")
    _said(item, "name", stated.get("device", "name"))
    _maker(item, stated.stated.get("device", {}))
    numbers = {("manufacturer", "serial number"): stated.get("device", "serial")}
    if own := stated.get("device", "owner_number"):
        numbers["owner", "owner's number"] = own
    _identifications(item, numbers)
    laboratory = _add(data, "calibrationLaboratory")
    if code := stated.get("laboratory", "accreditation"):
        _add(laboratory, "calibrationLaboratoryCode", code)
    _contact(laboratory, "contact", stated, "laboratory")
    persons = _add(data, "respPersons")
    for role, name in (
        ("responsible", stated.get("laboratory", "responsible")),
        ("operator", stated.get("calibration", "operator")),
    ):
        if name:
            person = _add(persons, "respPerson")
            _said(_add(person, "person"), "name", name)
            _add(person, "role", role)
            _add(person, "mainSigner", "true" if role == "responsible" else "false")
    _contact(data, "customer", stated, "customer")


def _maker(parent: ET.Element, given: Mapping[str, str]) -> None:
    if "manufacturer" in given:
        _said(_add(parent, "manufacturer"), "name", given["manufacturer"])
    if "model" in given:
        _add(parent, "model", given["model"])


def _results(
    result: ET.Element, calibration: Calibration, stated: Certificate, local_gravity: float
) -> None:
    instrument = calibration.model.instrument
    _said(result, "name", f"Calibration of {instrument.title}")
    _said(
        result,
        "description",
        f"Coefficients of the measurement equation, with U = k*u, k = {K:g}; each effect adds its equation, times its "
        "coefficients, to a slot. Effects: "
        + "; ".join(f"{e.name} in {e.slot}: {e.equation}" for e in calibration.model.effects)
        + ". Coefficients are correlated; their covariance is in the calibration that the SHA-256 names. All holds "
        "within the influence conditions as covered.",
    )
    method = _add(_add(result, "usedMethods"), "usedMethod")
    _said(method, "name", stated.get("calibration", "procedure") or "Bayesian calibration")
    _said(method, "description", f"Posterior by {calibration.method}, seed {calibration.seed}.")
    _software(result, "usedSoftware")
    _equipment(result, stated)
    _conditions(result, calibration, stated, local_gravity)
    data = _add(_listed(_add(result, "results"), "result", "Coefficients"), "data")
    for name, value in calibration.reference.items():
        if isinstance(value, float) and name.endswith("0"):
            quantity = _listed(data, "quantity", f"{name}, at which constants hold")
            real(quantity, value, "degC", local_gravity)
    coefficients, hyperparameters = summary(calibration)
    for row in coefficients:
        quantity = _listed(data, "quantity", row["name"])
        real(quantity, row["mean"], row["unit"], local_gravity, row["sd"])
    for row in (
        hyperparameters
    ):  # positive quantities: their posterior is skewed, and no multiple of u covers
        quantity = _listed(data, "quantity", row["name"])
        real(quantity, row["mean"], row["unit"], local_gravity, row["sd"], row["interval95"])


def _statements(parent: ET.Element, decisions: Decisions) -> None:
    """A statement of conformity a limit, with its rule (ISO/IEC 17025:2017, 7.8.6.2)."""
    for one in decisions.decisions:
        made = _add(parent, "metaData")
        for norm in NORMS:
            _add(made, "norm", norm)
        _said(
            made,
            "declaration",
            f"Limit: {one.limit}. Decision rule: {decisions.rule_in_words}. Decision: {one.decision}; {one.why}.",
            *(line.strip() for line in statement_lines(one)[1:]),
            *one.notes,
        )
        if one.decision in CONFORMITY:
            _add(made, "conformity", CONFORMITY[one.decision])


def _listed(parent: ET.Element, element: str, name: str) -> ET.Element:
    made = _add(parent, element)
    _said(made, "name", name)
    return made


def real(
    parent: ET.Element,
    value: float,
    unit: str | None,
    gravity: float,
    sd: float = 0.0,
    ends: tuple[float, float] | None = None,
) -> None:
    """A number with its unit, and its expanded uncertainty where it has one, or the ends of its 95 % interval.

    The uncertainty has two significant digits, and the value as many decimals (JCGM 100, 7.2.6).
    """
    factor, text = d_si(unit, gravity)
    value, sd = float(value) * factor, float(sd) * factor
    made = _add(parent, "real", space=SI)
    _add(made, "value", _rounded(value, K * sd), SI)
    _add(made, "unit", text, SI)
    if sd > 0 and ends is not None:
        interval = _add(made, "coverageInterval", space=SI)
        _add(interval, "standardUnc", _rounded(sd, sd), SI)
        _add(interval, "intervalMin", _rounded(ends[0] * factor, sd), SI)
        _add(interval, "intervalMax", _rounded(ends[1] * factor, sd), SI)
        _add(interval, "coverageProbability", "0.95", SI)
    elif sd > 0:
        uncertainty = _add(made, "expandedUnc", space=SI)
        _add(uncertainty, "uncertainty", _rounded(K * sd, K * sd), SI)
        _add(uncertainty, "coverageFactor", f"{K:g}", SI)
        _add(uncertainty, "coverageProbability", f"{PROBABILITY:g}", SI)
        _add(uncertainty, "distribution", "normal", SI)


def _rounded(value: float, uncertainty: float) -> str:
    """A number to the second significant digit of an uncertainty; as it is where that is zero."""
    if not uncertainty > 0:
        return repr(value)
    place = Decimal(1).scaleb(math.floor(math.log10(uncertainty)) - 1)
    return str(Decimal(value).quantize(place))


def _equipment(result: ET.Element, stated: Certificate) -> None:
    """The standards used."""
    standards = [s for s in stated.stated.get("standards", []) if "name" in s]
    if not standards:
        return
    listed = _add(result, "measuringEquipments")
    for one in standards:
        equipment = _listed(listed, "measuringEquipment", one["name"])
        if "traceable_to" in one:
            _said(equipment, "description", f"traceable to {one['traceable_to']}")
        _maker(equipment, one)
        numbers = {
            ("manufacturer", "serial number"): one.get("serial", ""),
            ("calibrationLaboratory", "certificate"): one.get("certificate", ""),
        }
        if any(numbers.values()):
            _identifications(equipment, {k: v for k, v in numbers.items() if v})


def _conditions(
    result: ET.Element, calibration: Calibration, stated: Certificate, gravity: float
) -> None:
    """Ambient conditions as stated, and what the readings cover."""
    listed = _add(result, "influenceConditions")
    text = dict(stated.conditions)
    if place := stated.get("calibration", "place"):
        text["place"] = place
    for name, said in text.items():
        quantity = _add(_add(_listed(listed, "influenceCondition", name), "data"), "quantity")
        _said(quantity, "noQuantity", said)
    readings = calibration.readings
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is None or name.startswith("output"):
            continue
        data = _add(_listed(listed, "influenceCondition", f"{name}, as covered"), "data")
        for end, value in (("from", readings[name].min()), ("to", readings[name].max())):
            real(_listed(data, "quantity", end), float(value), unit, gravity)
