"""The TOML file that keeps how the columns of files are understood, for the next file.

TOML that is written here is strings, a number and two tables: `json.dumps` quotes strings as TOML does, so no library
is needed to write it; Python's own reads it.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError

_KINDS = {"columns": dict, "units": dict, "local_gravity": float, "missing": str, "decimal": str}


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
