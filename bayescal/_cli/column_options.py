"""How the columns of files are to be understood: options, and the TOML file that keeps them for the next file.

TOML that is written here is strings, a number and two tables: `json.dumps` quotes strings as TOML does, so no library
is needed to write it; Python's own reads it.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from bayescal._cli.options import named_values
from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError
from bayescal._readings.unit_parsing import STANDARD_GRAVITY

_KINDS = {"columns": dict, "units": dict, "local_gravity": float, "missing": str, "decimal": str}

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
MappingFile = Annotated[
    Path | None,
    typer.Option("--mapping", help="TOML file that --save-mapping wrote; other options go first."),
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
    mapping: MappingFile = None
    save_mapping: SaveMapping = None

    def for_read(self) -> dict[str, Any]:
        """As the arguments of `read` that they are; those of the mapping where no option says otherwise.

        Raises:
            InputError: an option is not of its form, or the mapping cannot be used.
        """
        saved = {} if self.mapping is None else load_mapping(self.mapping)
        single = {name: getattr(self, name) for name in ("local_gravity", "missing", "decimal")}
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


def load_mapping(path: Path) -> dict[str, Any]:
    """A saved mapping, as arguments of `bayescal.read`.

    Raises:
        InputError: no such file, no TOML, or an entry that no mapping has.
    """
    try:
        found = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"--mapping {path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"--mapping {path}: is no TOML: {error}") from None
    for name, value in found.items():
        kind = _KINDS.get(name)
        if isinstance(value, int) and not isinstance(value, bool) and kind is float:
            value = found[name] = float(value)
        strings = not isinstance(value, dict) or all(isinstance(v, str) for v in value.values())
        if kind is None or not isinstance(value, kind) or not strings:
            raise InputError(
                f"--mapping {path}: {name} = {value!r} is none of its entries, which are columns and units (tables of "
                "strings), local_gravity (a number), missing and decimal (strings). Correct it"
            )
    return found


def save_mapping(path: Path, mapping: Mapping[str, Any]) -> None:
    """Write a mapping; what is empty is left out.

    Raises:
        InputError: the place cannot be written to.
    """
    single = [f"{n} = {_value(v)}" for n, v in mapping.items() if v and not isinstance(v, Mapping)]
    lines = ["# How the columns of these files are read: bayescal … --mapping FILE", *single]
    for name, table in mapping.items():
        if table and isinstance(table, Mapping):
            lines += ["", f"[{name}]", *(f"{_value(k)} = {_value(v)}" for k, v in table.items())]
    with replacing_for_user(path) as partial:
        partial.write_text("\n".join([*lines, ""]), encoding="utf-8")


def _value(value: str | float) -> str:
    """A string or a number as TOML has it. JSON leaves the character 7F as it is, TOML does not allow it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
