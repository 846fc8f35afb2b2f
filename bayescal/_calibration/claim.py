"""Claims: messages about readings or a result, with a code, the names concerned and numbers.

`claims.toml` defines severity, thresholds and message template of each code.
"""

from __future__ import annotations

import string
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

from bayescal._core.flag import Flag
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label


class Criterion(NamedTuple):
    """Severity, message template, remedies and thresholds of a claim code, from `claims.toml`."""

    severity: str
    template: str  # of the message
    remedies: dict[str, str]  # by name; "" if there is only one
    limits: dict[str, float]  # thresholds, by name


def _parse_criteria(tables: dict[str, dict[str, Any]]) -> Iterator[tuple[str, Criterion]]:
    for code, table in tables.items():
        remedies = tables[table.get("cures_of", code)].get("cures", {})
        remedies = {"": table["cure"]} if "cure" in table else remedies
        remedies = {name: " ".join(remedy.split()) for name, remedy in remedies.items()}
        template = " ".join(table["says"].split())
        yield code, Criterion(table["severity"], template, remedies, table.get("limits", {}))


_CRITERIA_FILE = Path(__file__).with_name("claims.toml")
CRITERIA = dict(_parse_criteria(tomllib.loads(_CRITERIA_FILE.read_text("utf-8"))))


def limit(code: str, name: str) -> float:
    """Return a named threshold of a claim code."""
    return CRITERIA[code].limits[name]


class _TemplateFormatter(string.Formatter):
    """Formatter of the templates in `claims.toml`: labels units (`unit`), joins names by commas (`list`) or "and"."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "unit":
            return unit_label(value)
        if isinstance(value, tuple):
            return (", " if format_spec == "list" else " and ").join(map(str, value))
        if isinstance(value, float) and not format_spec:
            return number(value)
        return super().format_field(value, format_spec)


class Claim(Flag):
    """A message and its remedy, as a string, with code, names and numbers as attributes for programs.

    Attributes:
        code: a key of `CRITERIA`.
        subjects: names of the effects, coefficients, columns or groups concerned, the most important first.
        numbers: values of the template's fields, by name: numbers, names (several in a tuple) and units.
    """

    numbers: dict[str, Any]

    def __new__(cls, code: str, *subjects: str, **numbers: Any) -> Self:
        criterion, cure = CRITERIA[code], numbers.get("cure", "")
        template = f"{criterion.template} {criterion.remedies.get(cure, '')}".rstrip()
        text = _TemplateFormatter().vformat(template, (), {"of": subjects, **numbers})
        claim = super().__new__(cls, text, code, *subjects)
        claim.numbers = numbers
        return claim

    def __getnewargs_ex__(self) -> tuple[tuple[str, ...], dict[str, Any]]:
        return (self.code, *self.subjects), self.numbers

    @property
    def severity(self) -> str:
        """Return the severity: "stop" and "doubt" fail the acceptance checks, a "note" does not."""
        return CRITERIA[self.code].severity

    def to_json_data(self) -> dict[str, Any]:
        """Return the claim's record in result.json."""
        record = {"code": self.code, "of": list(self.subjects), "severity": self.severity}
        return {**record, "in_words": str(self)}


def as_claim(message: str) -> Claim:
    """Return a claim unchanged; wrap a plain message of a saved calibration as a claim with code "kept"."""
    return message if isinstance(message, Claim) else Claim("kept", words=message)
