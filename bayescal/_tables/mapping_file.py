"""Mapping files: TOML files with the arguments of `bayescal.read`, for reuse with further files of readings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

from bayescal._core.atomic_file import replace_user_file
from bayescal._core.json_data import read_toml


class ReadMapping(TypedDict, total=False):
    """Content of a mapping file: keyword arguments of `bayescal.read`."""

    columns: dict[str, str | list[str]]
    units: dict[str, str]
    unwrap: dict[str, str]
    begin: dict[str, str]
    ignore: list[str]
    local_gravity: float
    local_field: str
    missing: str
    decimal: str
    date_order: str
    nominal_scale: str
    nominal_zero: str


def load_mapping(path: Path) -> dict[str, Any]:
    """Load a saved mapping; return it as keyword arguments of `bayescal.read`.

    Raises:
        InputError: the file does not exist, is not TOML, or has an unknown or invalid entry.
    """
    return read_toml(path, ReadMapping, f"--mapping {path}", "Correct or remove it")


def save_mapping(path: Path, mapping: Mapping[str, Any]) -> None:
    """Write a mapping without its empty entries; raise InputError if the file cannot be written."""
    scalars = [f"{n} = {_quote(v)}" for n, v in mapping.items() if v and not isinstance(v, Mapping)]
    lines = ["# Column mapping; to read files with it: bayescal … --mapping FILE", *scalars]
    for name, table in mapping.items():
        if table and isinstance(table, Mapping):
            lines += ["", f"[{name}]", *(f"{_quote(k)} = {_quote(v)}" for k, v in table.items())]
    with replace_user_file(path) as partial:
        partial.write_text("\n".join([*lines, ""]), encoding="utf-8")


def _quote(value: str | float | Sequence[str]) -> str:
    """Format a value as TOML: as JSON, with the character 7F escaped, which TOML requires."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
