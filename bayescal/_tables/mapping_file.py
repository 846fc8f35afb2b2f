"""The TOML file that keeps how the columns of files are understood, for the next file.

TOML that is written here is strings, a number and two tables: `json.dumps` quotes strings as TOML does, so no library
is needed to write it; Python's own reads it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.json_shape import OneOf, read_toml

MAPPING = {  # its shape: how `read` is asked, as keywords
    "columns?": {str: OneOf(str, [str])},
    "units?": {str: str},
    "unwrap?": {str: str},
    "begin?": {str: str},
    "ignore?": [str],
    "local_gravity?": float,
    **{
        f"{name}?": str
        for name in (
            "local_field",
            "missing",
            "decimal",
            "date_order",
            "nominal_scale",
            "nominal_zero",
        )
    },
}


def load_mapping(path: Path) -> dict[str, Any]:
    """A saved mapping, as arguments of `bayescal.read`.

    Raises:
        InputError: no such file, no TOML, or an entry that no mapping has; names the entries that there are.
    """
    found = read_toml(path, MAPPING, f"--mapping {path}", "Correct or remove it")
    return {n: float(v) if n == "local_gravity" else v for n, v in found.items()}


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


def _value(value: str | float | Sequence[str]) -> str:
    """A string, a number or a list of strings as TOML has it. JSON leaves the character 7F, TOML does not allow it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
