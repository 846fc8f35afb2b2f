"""What a user says beside a file, and which columns an instrument expects in it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from bayescal._core.errors import InputError
from bayescal._data.column import Column, NominalScale
from bayescal._data.unit_conversion import alike, convert, same_dimension
from bayescal._data.unit_parsing import STANDARD_GRAVITY, parse
from bayescal._tables.dates import LATEST, ORDERS
from bayescal._tables.raw_table import Header

MISSING_READINGS = ("refuse", "drop")


class InstrumentLike(Protocol):
    """What reading a file asks of an instrument. (It may also name its `output`.)"""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


@dataclass(frozen=True)
class ReadOptions:
    """What the user says beside the file.

    Attributes:
        columns: our name → the file's.
        units: the file's name, or ours → unit.
        local_gravity: m/s².
        nominal_scale: in place of the instrument's.
        missing: "refuse" rows with a missing reading, or "drop" them.
        decimal: between the whole and its parts in text files; empty where the file shows it.
        date_order: of month, day and year in dates such as 05/06/2026: "mdy", "dmy" or "ymd"; empty where the dates
            show it.
        ignore: columns of the file that are left out.
        only: whether all columns beside the instrument's are.
        others: columns of the file that are outputs of other channels, and left out.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float = STANDARD_GRAVITY
    nominal_scale: NominalScale | None = None
    missing: str = "refuse"
    decimal: str = ""
    date_order: str = ""
    ignore: tuple[str, ...] = ()
    only: bool = False
    others: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuse what is no option.

        Raises:
            InputError: `missing`, `decimal` or `date_order` is another word.
        """
        if self.missing not in MISSING_READINGS:
            raise InputError(f"missing={self.missing!r} (--missing) is not one of refuse, drop")
        if self.decimal not in ("", ".", ","):
            raise InputError(f"decimal={self.decimal!r} (--decimal) is neither a point nor a comma")
        if self.date_order not in ("", *ORDERS):
            raise InputError(
                f"date_order={self.date_order!r} (--date-order) is not one of {', '.join(ORDERS)}: the order of month, "
                "day and year"
            )

    @classmethod
    def of(
        cls,
        instrument: InstrumentLike,
        *,
        nominal_scale: NominalScale | str | None = None,
        nominal_zero: str | None = None,
        ignore: Sequence[str] = (),
        **given: Any,
    ) -> ReadOptions:
        """As a user gives them: the nominal scale and zero as text, what is not said left out.

        Raises:
            InputError: `nominal_scale` or `nominal_zero` is not of its form, or not in a unit of this instrument.
        """
        made = cls(**given, ignore=tuple(ignore))
        scale = _scale_in_words(instrument, nominal_scale, nominal_zero, made.local_gravity)
        return replace(made, nominal_scale=scale)

    def leaves_out(self, header: Header) -> bool:
        """Whether a column is left out, as the user says, or as it is another channel's output."""
        return any(name in (header.raw, header.name) for name in (*self.ignore, *self.others))


_NUMBER_AND_UNIT = re.compile(r"([+\-−]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.].*)")


def _scale_in_words(
    instrument: InstrumentLike,
    scale: NominalScale | str | None,
    zero: str | None,
    local_gravity: float,
) -> NominalScale | None:
    """The nominal scale that is said: its gain as "250 V/g" (or "61 ug/count"), its zero as "1.21 V"."""
    if isinstance(scale, str):
        scale = _scale_from(instrument, scale, local_gravity)
    if zero is None:
        return scale
    scale = scale or instrument.nominal_scale
    if scale is None:
        raise InputError(
            f"nominal_zero={zero!r} (--nominal-zero) and no scale: {instrument.name!r} has none of its own. Say how "
            "the raw output becomes the instrument's: --nominal-scale '250 V/g'"
        )
    value, unit = _number_and_unit(zero, "nominal_zero", "--nominal-zero", f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"nominal_zero={zero!r} (--nominal-zero) is in {unit}, the nominal scale is of a raw output in "
            f"{scale.unit}: give the raw output at zero in that unit"
        )
    return replace(scale, offset=float(convert(value, unit, scale.unit)))


def _scale_from(instrument: InstrumentLike, text: str, local_gravity: float) -> NominalScale:
    """A nominal scale from a number in raw units per output unit, or the other way round."""
    unit = expected_columns(instrument)[output_name(instrument)].unit or "1"
    example = f"250 mV/({unit})" if "/" in unit else f"250 mV/{unit}"
    gain, said = _number_and_unit(text, "nominal_scale", "--nominal-scale", example)
    above, _, below = (part.strip() for part in said.partition("/"))
    for raw, inverse in ((above, False), (below, True)):
        wanted = f"({unit})/{raw}" if inverse else f"{raw}/({unit})"
        for whole in (said, f"{above}/({below})"):  # as it stands, and "mV/°/s" as it is meant
            if alike(whole, wanted) and not alike(raw, unit):
                per = float(convert(gain, whole, wanted, local_gravity=local_gravity))
                return NominalScale(raw, 1 / per if inverse and per else per)
    raise InputError(
        f"nominal_scale={text!r} (--nominal-scale) is not a raw unit per {unit}: give what one unit of output is of "
        f"the raw output, such as {example!r}"
    )


def _number_and_unit(text: str, name: str, option: str, example: str) -> tuple[float, str]:
    found = _NUMBER_AND_UNIT.fullmatch(text.strip())
    if not found:
        raise InputError(
            f"{name}={text!r} ({option}) is no number with a unit: write it such as {example!r}"
        )
    try:
        parse(found[2])
    except InputError as error:
        raise InputError(f"{name}={text!r} ({option}): {error}") from None
    return float(found[1].replace("−", "-")), found[2]


def output_name(instrument: InstrumentLike) -> str:
    """Name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """The instrument's columns, and those that every instrument may have."""
    expected = {column.name: column for column in instrument.columns}
    output = expected.get(output_name(instrument))
    time = expected.get("time")
    if time is not None and time.high is None:
        expected["time"] = replace(time, high=LATEST)
    for name in ("run", "device", "axis"):
        expected.setdefault(name, Column(name, None, required=False))
    if output is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column("output_uncertainty", output.unit, meaning, required=False, low=0.0)
        expected.setdefault("output_uncertainty", uncertainty)
    return expected


def unit_of(header: Header, ours: str, options: ReadOptions) -> str | None:
    """The unit of a column: what the user says, else its header; None if neither."""
    for name in (header.raw, header.name, ours):
        if name in options.units:
            return options.units[name]
    return header.unit or None
