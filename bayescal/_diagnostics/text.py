"""The tables of an uncertainty budget as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bayescal._core.formatting import number, table, with_error
from bayescal._readings.units import unit_label

if TYPE_CHECKING:
    from bayescal._compensation.budget import Budget


def budget_text(found: Budget) -> str:
    """Both tables of an uncertainty budget; k and the kind of each interval said."""
    unit = unit_label(found.unit)
    at = ", ".join(
        f"{name} = {number(value, 4)} {unit_label(found.at_units[name])}".strip()
        for name, value in found.at.items()
    )
    parts = [
        f"Uncertainty budget of {found.stimulus} at {at}",
        table(
            ["coefficient", "estimate", "sensitivity", f"contribution {unit}".strip(), "share"],
            [
                [
                    c.name,
                    f"{with_error(c.value, c.uncertainty)} {unit_label(c.unit)}".strip(),
                    number(c.sensitivity),
                    number(c.contribution),
                    f"{100 * c.share:.1f} %",
                ]
                for c in found.coefficients
            ],
        ),
        "Shares count correlations and add up to 100 %; one below zero takes away.",
        table(
            ["the same by where it comes from", "type", f"contribution {unit}".strip(), "share"],
            [
                [s.name, s.kind, number(s.contribution), f"{100 * s.share:.1f} %"]
                for s in found.sources
            ],
        ),
        f"Combined standard uncertainty {number(found.uncertainty)} {unit}; with the noise of one reading "
        f"({number(found.noise)} {unit}): {number(found.expanded_reading / found.k)} {unit}.",
        f"Expanded uncertainty (k = {found.k:g}): {number(found.expanded)} {unit}; with the noise of one reading: "
        f"{number(found.expanded_reading)} {unit}.",
    ]
    return "\n\n".join(parts)
