"""How the columns of files are to be understood: options of the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from bayescal._cli.options import named_values
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._tables.mapping_file import load_mapping, save_mapping

Columns = Annotated[
    list[str] | None,
    typer.Option("--columns", help="output=gyro_x: our column = the file's; repeat for more."),
]
Units = Annotated[
    list[str] | None,
    typer.Option("--unit", help="gyro_x=rad/s: unit of a column; repeat for more."),
]
Gravity = Annotated[
    float | None,
    typer.Option(min=1.0, help="Local gravity, m/s², for files in m/s²; 9.80665 if not given."),
]
Missing = Annotated[
    str | None,
    typer.Option(
        "--missing",
        metavar="refuse|drop",
        help="Rows with a missing reading: refuse the file, or drop them (a gap).",
    ),
]
Decimal = Annotated[
    str | None,
    typer.Option(
        "--decimal", metavar=".|,", help="In numbers of text files, where they do not show it."
    ),
]
Scale = Annotated[
    str | None,
    typer.Option(
        "--nominal-scale",
        metavar="'250 V/g'",
        help="Raw output per unit of output, in place of the instrument's own: turns V, mV, Hz, counts into it.",
    ),
]
Zero = Annotated[
    str | None,
    typer.Option("--nominal-zero", metavar="'1.21 V'", help="Raw output at zero; 0 if not given."),
]
DateOrder = Annotated[
    str | None,
    typer.Option(
        "--date-order",
        metavar="mdy|dmy|ymd",
        help="Of dates such as 05/06/2026, where no day above 12 shows it.",
    ),
]
Ignore = Annotated[
    list[str] | None,
    typer.Option("--ignore", metavar="HEADER", help="Column to leave out; repeat for more."),
]
MappingFile = Annotated[
    Path | None,
    typer.Option(
        "--mapping",
        help="TOML file that --save-mapping wrote; options on the command line take precedence.",
    ),
]
SaveMapping = Annotated[
    Path | None,
    typer.Option("--save-mapping", help="TOML file to keep these options in, for --mapping."),
]


@dataclass(frozen=True)
class ColumnOptions:
    """How the columns of the files are to be understood."""

    columns: Columns = None
    unit: Units = None
    local_gravity: Gravity = None
    missing: Missing = None
    decimal: Decimal = None
    date_order: DateOrder = None
    nominal_scale: Scale = None
    nominal_zero: Zero = None
    ignore: Ignore = None
    mapping: MappingFile = None
    save_mapping: SaveMapping = None

    def for_read(self) -> dict[str, Any]:
        """As the arguments of `read` that they are; those of the mapping where no option says otherwise.

        Raises:
            InputError: an option is not of its form, or the mapping cannot be used.
        """
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        names = ("local_gravity", "missing", "decimal", "date_order", "nominal_scale")
        single = {name: getattr(self, name) for name in (*names, "nominal_zero", "ignore")}
        usual = {"local_gravity": STANDARD_GRAVITY, "missing": "refuse", "decimal": ""}
        given = {name: value for name, value in single.items() if value is not None}
        return {
            "columns": saved.pop("columns", {}) | named_values(self.columns, "--columns"),
            "units": saved.pop("units", {}) | named_values(self.unit, "--unit"),
            **usual,
            **saved,
            **given,
        }

    def keep(self) -> None:
        """Save the mapping, where that is asked for, once the files have been read with it.

        Raises:
            InputError: the place cannot be written to.
        """
        if self.save_mapping is not None:
            save_mapping(self.save_mapping, self.for_read())
