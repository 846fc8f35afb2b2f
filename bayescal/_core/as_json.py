"""Conversion of results to plain JSON data and files."""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from bayescal._core.atomic_file import write_text


def as_json(value: Any) -> Any:
    """Convert to plain data for JSON: data classes as dictionaries, arrays as lists, non-finite numbers as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: as_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    if plain := getattr(value, "tolist", None):
        return as_json(plain())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(data: Any, indent: int = 2) -> str:
    """Format plain data as JSON, with a final line end; raise ValueError for a non-finite number."""
    return json.dumps(data, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(data: Any, path: Path, indent: int = 2) -> Path:
    """Write plain data as JSON to a path chosen by the user; see `write_text`."""
    return write_text(json_text(data, indent), path)
