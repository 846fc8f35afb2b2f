"""A result once more in another unit of the output: that of the file, for who compares it with a voltmeter."""

from __future__ import annotations

from itertools import chain

from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.formatting import number, with_error
from bayescal._data.column import NominalScale
from bayescal._data.unit_conversion import convert, same_dimension, unit_label
from bayescal._report.section import Chapter


def output_factor(unit: str, of: str, scale: NominalScale | None) -> float:
    """What one of the output's unit, in which a calibration keeps it, is in another; differences, all of them.

    Args:
        unit: asked for, of the output or of the raw one.
        of: that the output is kept in.
        scale: by which the raw output became the output; None where it did not.

    Raises:
        InputError: the unit is neither's.
    """
    if same_dimension(unit, of):
        return float(convert(1.0, of, unit, difference=True))
    if scale is not None and same_dimension(unit, scale.unit):
        return float(abs(scale.gain) * convert(1.0, scale.unit, unit, difference=True))
    raw = f", made of readings in {scale.unit}" if scale is not None else ""
    raise InputError(
        f"--output-unit {unit}: the output is in {of}{raw}. Give a unit of that dimension, or say by "
        '--nominal-scale what one unit of the output makes of the raw one, such as "2.44 mV/(deg/s)"'
    )


def exchanged(whole: str, of: str, unit: str) -> str | None:
    """A unit that is the output's, `of`, or per something else, with another in its place; None where it is neither."""
    rest = whole.removeprefix(of)
    return unit + rest if whole.startswith(of) and rest[:1] in ("", "/", "*") else None


def rows_in_output_unit(chapter: Chapter, unit: str) -> list[list[str]]:
    """The errors of every step, and the coefficients that are in the output's unit or per something, as cells.

    Returns:
        Name, value with its standard uncertainty, unit.

    Raises:
        InputError: the output is in no such unit.
    """
    c, rows = chapter.calibration, list[list[str]]()
    factor = output_factor(unit, c.unit, c.readings.scale or c.model.instrument.nominal_scale)
    for i, step in enumerate(chapter.data["steps"]):
        for key, what in (("rmse_fitted", "as fitted"), ("holdout_rmse", "of hold-out data")):
            if step[key] is not None:
                error = number(step[key] * factor, 2)
                name = f"rms error {what}, step {i} ({step['title']})"
                rows.append([name, error, unit_label(unit)])
    for one in chain(*summary(c)):
        if (shown := exchanged(one["unit"], c.unit, unit)) is not None:
            value = with_error(one["mean"] * factor, one["sd"] * factor)
            rows.append([one["name"], value, unit_label(shown)])
    return rows
