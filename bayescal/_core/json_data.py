"""Conversion of results to JSON, and JSON and TOML parsed and validated as values of a type.

A parsed value is traversed no deeper than its type, so that no nesting exhausts the stack.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from datetime import date
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints, is_typeddict

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError

MAX_JSON_BYTES = 50_000_000  # size of a JSON file
MAX_TOML_BYTES = 100_000  # size of a TOML file: a mapping, a certificate's data

_SURROGATE = re.compile("[\ud800-\udfff]")  # half of a character, which no file can contain
_TYPE_NAMES = {str: "text", bool: "true or false", int: "a whole number", date: "a date"}
_TYPE_NAMES |= {float: "a finite number", NoneType: "null"}


def as_json(value: Any) -> Any:
    """Convert to plain data for JSON: data classes to dictionaries, arrays to lists, non-finite numbers to None."""
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


def as_type(value: Any, kind: Any, where: str = "") -> Any:
    """Validate a parsed JSON or TOML value against a type; raise ValueError with the value's path, below `where`.

    Types: str, bool, int, float (finite), date, None, Any; list[…], tuple[…], dict[str, …]; unions; data classes and
    TypedDicts, whose keys without a default are required, and which allow no other keys.
    """
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        for option in args:
            with suppress(ValueError):
                return as_type(value, option, where)
        matching_types = [option for option in args if get_origin(option) is type(value)]
        return as_type(value, (*matching_types, *args)[0], where)  # raises ValueError
    if origin in (list, tuple):
        types = args if origin is tuple and args[-1] is not ... else None
        if not isinstance(value, list) or (types and len(value) != len(types)):
            raise _unexpected(value, f"a list of {len(types)}" if types else "a list", where)
        pairs = zip(value, types or args[:1] * len(value), strict=True)
        return origin(as_type(*pair, f"{where}[{i}]") for i, pair in enumerate(pairs))
    if origin is dict or is_dataclass(kind) or is_typeddict(kind):
        return _as_table(value, kind, where)
    kind = NoneType if kind is None else kind
    number = type(value) in (int, float) and abs(value) < 1e308 and math.isfinite(value)
    is_valid = number if kind is float else type(value) is kind
    if not is_valid or (kind is str and _SURROGATE.search(value)):
        raise _unexpected(value, _TYPE_NAMES[kind], where)
    return float(value) if kind is float else value


def _as_table(value: Any, kind: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _unexpected(value, "a table", where)
    constructor: Any = kind
    if get_origin(kind) is dict:
        constructor, types, required = dict, dict.fromkeys(value, get_args(kind)[1]), ()
    elif is_dataclass(kind):
        types = get_type_hints(kind)
        required = [f.name for f in fields(kind) if f.default is f.default_factory is MISSING]
    else:
        types, required = get_type_hints(kind), kind.__required_keys__
    for name in (n for n in types if n in required and n not in value):
        raise ValueError(f"{where}.{name}".lstrip(".") + " is missing")
    paths = {name: f"{where}.{str(name)[:60]}".lstrip(".") for name in value}
    for name in (n for n in value if n not in types):
        raise ValueError(f"{paths[name]} is unknown; known keys: {', '.join(types)}")
    return constructor(**{n: as_type(entry, types[n], paths[n]) for n, entry in value.items()})


def _unexpected(value: Any, expected: str, where: str) -> ValueError:
    kind = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    return ValueError(f"{where or 'it'} is {kind or repr(value)[:60]}, but {expected} was expected")


def parsed_json(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError if it is invalid, or nested too deeply."""
    return _parse(json.loads, text, "JSON")


def _parse(parse: Callable[[Any], Any], text: str | bytes, language: str) -> Any:
    try:
        return parse(text)
    except (RecursionError, ValueError) as error:
        raise ValueError(f"it is not {language}: {error}") from None


def read_json(path: Path, kind: Any = Any) -> Any:
    """Read a JSON file and validate it against a type; raise OSError, or ValueError with the path of an entry."""
    if path.stat().st_size > MAX_JSON_BYTES:
        raise ValueError(f"it is larger than {MAX_JSON_BYTES / 1e6:.0f} MB")
    return as_type(parsed_json(path.read_bytes()), kind)


def read_toml(path: Path, kind: Any, called: str, cure: str) -> Any:
    """Read a TOML file and validate it against a type; raise InputError that begins with `called`, ends with `cure`."""
    try:
        if path.stat().st_size > MAX_TOML_BYTES:
            raise ValueError(f"it is larger than {MAX_TOML_BYTES / 1e3:.0f} kB")
        return as_type(_parse(tomllib.loads, path.read_text("utf-8-sig"), "TOML"), kind)
    except OSError as error:
        reason = f"cannot be read: {error.strerror or error}. Check the name and the folder"
        raise InputError(f"{called} {reason}") from None
    except ValueError as error:
        raise InputError(f"{called}: {error}. {cure}") from None
