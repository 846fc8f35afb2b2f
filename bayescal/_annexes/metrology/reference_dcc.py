"""Error of a reference standard from its digital calibration certificate (DCC), common to all readings.

Elements are those of dcc.xsd 3 and SI_Format.xsd 1 and 2, as in `certificate`; refType values, such as
basic_measurementError, those of the PTB's good practice. A DOCTYPE is rejected, so that no XML entity is ever resolved.
"""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.metrology.certificate import D_SI

DCC, ERROR = "{https://ptb.de/dcc}", "basic_measurementError"
ROOT = f"{DCC}digitalCalibrationCertificate"
REFERENCE, MEASURED = "basic_referenceValue", "basic_measuredValue"
REF_TYPES = ERROR, REFERENCE, MEASURED
EXPANDED_ELEMENTS = "uncertainty", "valueExpandedMU"
STANDARD_ELEMENTS = "standardUnc", "valueStandardMU"
MAX_BYTES = 50_000_000  # size of a certificate, with its pictures
MAX_POINTS = 14  # calibration points, limited by the length of a formula
_UNITS = {name: unit for unit, name in D_SI.items() if unit != "uT"}
_UNITS |= {"degreecelsius": "degC", "degree": "deg", "one": "1"}
_PREFIXES = {"milli": 1e-3, "micro": 1e-6, "nano": 1e-9, "kilo": 1e3}
_D_SI_PART = re.compile(r"\\(per\\)?(?:(milli|micro|nano|kilo)\\)?(\w+)(?:\\tothe\{([-+]?\d)\})?")


class _NoDoctype(ET.TreeBuilder):
    def doctype(self, name: str, *_: Any) -> NoReturn:
        raise ET.ParseError(f"it has a DOCTYPE declaration, {name}")


def read_dcc(path: str | Path, instrument: bc.Instrument, column: str = "temperature") -> bc.Effect:
    """Read the error of a column's reference standard from its digital calibration certificate, as an effect.

        model = instrument.baseline() + bc.read_dcc("thermometer.xml", instrument)

    The effect corrects the column by the stated errors. Their uncertainty is common to all readings and, because
    certificates do not state correlations, described by an offset with the largest stated u and by the slope between
    independent errors at the ends of the range. The effect applies to the calibration: compensation takes true values.

    Raises:
        InputError: the file is not a certificate, or has not exactly one table of errors in the column's dimension
            with uncertainty and coverage factor; the message names the element.
    """
    unit, path = instrument.column(column).unit or "1", Path(path)
    root, label = _parse_root(path), ws.unit_label(unit) or "plain numbers"
    elements = [e for result in root.iter(f"{DCC}result") for e in result.iter()]
    results = [_parse_errors(path, e, unit) for e in elements if _get_tag(e) in ("list", "data")]
    tables = [errors for errors in results if errors is not None]
    if len(tables) != 1:
        units = ", ".join(dict.fromkeys(e.text or "" for e in elements if _get_tag(e) == "unit"))
        fault = f"{len(tables)} tables of errors in {label}; units are {units or 'not stated'}"
        raise _make_error(path, "dcc:result", fault, f"one dcc:quantity of refType {ERROR}")
    x, error, sd = tables[0]
    points, u, low, high = np.unique(x), float(sd.max()), x.min(), x.max()
    corrections = np.array([0.0 - error[x == p].mean() for p in points])
    if len(points) > MAX_POINTS:
        raise _make_error(path, ERROR, f"{len(points)} points", f"at most {MAX_POINTS}")
    offset = f"{u!r} {'delta_degC' if unit == 'degC' else unit}"
    formula, arguments = "offset", {"offset": offset}
    if high > low:
        formula += f"+slope*(max(min(x,{high:.7g}),{low:.7g}){-0.5 * (low + high):+.7g})"
        arguments["slope"] = f"{2**0.5 * u / float(high - low)!r}"
    description = f"standard uncertainty {ws.number(u)} {label}, shared by all readings"
    if corrections.any():
        slope_changes = np.diff([0.0, *(np.diff(corrections) / np.diff(points)), 0.0])
        terms = (f"{k:+.5g}*max(x{-p:+.7g},0)" for k, p in zip(slope_changes, points, strict=True))
        formula += f"+correction*({corrections[0]:.7g}{''.join(terms)})"
        arguments["correction"] = "1 ± 0"
        range_text = f"{corrections.min():.4g} to {corrections.max():.4g} {label}"
        description = f"corrected by {range_text} at {low:.6g} to {high:.6g} {label}; {description}"
    identifier = root.findtext(f".//{DCC}uniqueIdentifier", "").strip()
    source = f"{path.name}{f', certificate {identifier}' * bool(identifier)}: {description}"
    arguments |= {"x": column, "source": source} if "x" in formula else {"source": source}
    effect = bc.effect(f"{column}.certificate", formula, instrument=instrument, **arguments)
    equation = "true = indicated + correction + e, e shared by all readings"
    return replace(effect, equation=equation, columns=(column,))


def _make_error(path: Path, element: str, fault: str, expected: str) -> bc.InputError:
    return bc.InputError(f"{str(path)!r}, {element}: {fault}; expected: {expected}")


def _parse_root(path: Path) -> ET.Element:
    try:
        content = path.read_bytes() if path.stat().st_size <= MAX_BYTES else b""
        root = ET.fromstring(content, ET.XMLParser(target=_NoDoctype()))
        if (fault := root.tag) == ROOT:
            return root
    except (OSError, ET.ParseError, ValueError, LookupError) as error:
        fault = f"not read as XML ({error})"
    raise _make_error(path, "the root", fault, f"{ROOT}, of {MAX_BYTES:,} bytes at most")


def _get_tag(element: ET.Element) -> str:
    """Return an element's name, without namespace and without the ending XMLList."""
    return element.tag.rpartition("}")[2].removesuffix("XMLList")


def _parse_errors(path: Path, table: ET.Element, unit: str) -> tuple[np.ndarray, ...] | None:
    """Return indications, errors and standard uncertainties of a table, (n,) in `unit`; None if it states no errors."""
    columns: dict[str, np.ndarray] = {}  # (2, n): values and standard uncertainties
    for quantity in table.findall(f"{DCC}quantity"):
        for kind in quantity.get("refType", "").split():
            name = kind.removesuffix("_error").removesuffix("_correction")
            try:
                values = _parse_values(quantity, unit, name == ERROR) if name in REF_TYPES else None
            except (ValueError, KeyError) as error:
                expected = "numbers, with one uncertainty or one for each"
                raise _make_error(path, f"dcc:quantity {kind}", str(error), expected) from None
            if values is not None:
                values[0] *= -1.0 if kind.endswith("_correction") else 1.0
                columns[name] = np.hstack([columns.get(name, values[:, :0]), values])
    if (error := columns.get(ERROR)) is None:
        return None
    if not np.all(error[1] > 0):
        fault = "no coverage factor" if np.isnan(error[1]).any() else "no uncertainty"
        expected = f"si:{' or si:'.join(EXPANDED_ELEMENTS)} with si:coverageFactor, or si:{STANDARD_ELEMENTS[0]}"
        raise _make_error(path, f"dcc:quantity {ERROR}", fault, expected)
    points = columns.get(MEASURED, columns.get(REFERENCE, np.zeros((2, 1))))[0]
    if len(points) != error.shape[1]:
        fault, expected = f"{error.shape[1]} errors at {len(points)} points", "equal numbers"
        raise _make_error(path, f"dcc:quantity {MEASURED} or {REFERENCE}", fault, expected)
    return points + (error[0] if MEASURED not in columns and REFERENCE in columns else 0.0), *error


def _parse_values(quantity: ET.Element, unit: str, is_difference: bool) -> np.ndarray | None:
    """Return values and standard uncertainties (2, n) in `unit`; None if no value has a unit that converts to it.

    The uncertainty is NaN if an expanded one lacks its coverage factor, 0 if none is stated.
    """
    children = (list(e) if _get_tag(e) in ("hybrid", "list") else [e] for e in quantity)
    for real in (e for group in children for e in group if _get_tag(e) in ("real", "realList")):
        texts = {_get_tag(e): (e.text or "").split() for e in real.iter()}
        factor, source_unit = _parse_unit(*dict.fromkeys(texts.get("unit", [""])))
        if not (source_unit and ws.same_dimension(source_unit, unit)):
            continue
        names = ("value", *EXPANDED_ELEMENTS, *STANDARD_ELEMENTS, "coverageFactor")
        numbers = {n: np.array(texts[n], float) for n in names if n in texts}
        if not all(np.all(np.isfinite(v)) for v in numbers.values()):
            raise ValueError("a number that is not finite")
        element = next((n for n in names[1:5] if n in numbers), "")
        k = numbers.get("coverageFactor", np.nan) if element in EXPANDED_ELEMENTS else 1.0
        sd = np.broadcast_to(numbers.get(element, 0.0) / k, numbers["value"].shape)
        pairs = (numbers["value"], is_difference), (sd, True)
        return np.array([ws.convert(v * factor, source_unit, unit, difference=d) for v, d in pairs])
    return None


def _parse_unit(text: str, *further_texts: str) -> tuple[float, str]:
    """Return the factor and the unit of bayescal for a D-SI unit; the unit is "" if unknown, or for several texts."""
    factor, names = 1.0, ["1"]
    if further_texts or _D_SI_PART.sub("", text):
        return 0.0, ""
    for per, prefix, word, power in _D_SI_PART.findall(text):
        p = int(power or 1) * (-1 if per else 1)
        factor *= _PREFIXES.get(prefix, 1.0) ** p
        names.append(_UNITS.get(word, "") + (f"^{p}" if p != 1 else ""))
    return (factor, "*".join(names[1:] or names)) if all(names) else (0.0, "")
