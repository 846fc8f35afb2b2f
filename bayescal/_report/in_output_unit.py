"""A result once more in another unit of the output: that of the file, for who compares it with a voltmeter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.formatting import number, table, with_error
from bayescal._data.column import NominalScale
from bayescal._data.unit_conversion import convert, same_dimension, unit_label
from bayescal._report.section import Chapter


@dataclass(frozen=True)
class OutputUnit:
    """A unit in which numbers in the output's unit are shown, differences all of them.

    Attributes:
        unit: as it was asked for.
        of: the unit that the calibration keeps the output in.
        factor: of `unit` in one of `of`.
    """

    unit: str
    of: str
    factor: float

    @classmethod
    def new(cls, unit: str, of: str, scale: NominalScale | None) -> OutputUnit:
        """Of the output, which is kept in `of`; or of the raw one, by the nominal scale.

        Raises:
            InputError: it is neither's.
        """
        if same_dimension(unit, of):
            return cls(unit, of, float(convert(1.0, of, unit, difference=True)))
        if scale is not None and same_dimension(unit, scale.unit):
            factor = abs(scale.gain) * convert(1.0, scale.unit, unit, difference=True)
            return cls(unit, of, float(factor))
        raw = f", made of readings in {scale.unit}" if scale is not None else ""
        raise InputError(
            f"--output-unit {unit}: the output is in {of}{raw}. Give a unit of that dimension, or say by "
            '--nominal-scale what one unit of the output makes of the raw one, such as "2.44 mV/(deg/s)"'
        )

    def shown(self, value: float, unit: str) -> tuple[float, str] | None:
        """A number in the output's unit, or per something else; None where it is neither."""
        rest = unit.removeprefix(self.of)
        if unit.startswith(self.of) and rest[:1] in ("", "/", "*"):
            return value * self.factor, self.unit + rest
        return None


def in_output_unit(chapter: Chapter, unit: str) -> str:
    """The errors of every step, and the coefficients that are in the output's unit or per something.

    Raises:
        InputError: the output is in no such unit.
    """
    rows = rows_in_output_unit(chapter, unit)
    head = ["", "value", "unit"]
    return table(head, rows, left=1, fold=40)


def rows_in_output_unit(chapter: Chapter, unit: str) -> list[list[str]]:
    """Name, value with its standard uncertainty, unit: as cells.

    Raises:
        InputError: the output is in no such unit.
    """
    c = chapter.calibration
    scale = c.readings.scale or c.model.instrument.nominal_scale
    asked = OutputUnit.new(unit, c.unit, scale)
    label, rows = unit_label(asked.unit), list[list[str]]()
    for i, step in enumerate(chapter.data["steps"]):
        for key, what in (("rmse_fitted", "as fitted"), ("holdout_rmse", "of hold-out data")):
            if step[key] is not None:
                error = number(step[key] * asked.factor, 2)
                rows.append([f"rms error {what}, step {i} ({step['title']})", error, label])
    for part in summary(c):
        rows += [row for one in part if (row := _row(one, asked)) is not None]
    return rows


def _row(one: dict[str, Any], asked: OutputUnit) -> list[str] | None:
    mean, sd = asked.shown(one["mean"], one["unit"]), asked.shown(one["sd"], one["unit"])
    if mean is None or sd is None:
        return None
    return [one["name"], with_error(mean[0], sd[0]), unit_label(mean[1])]
