"""Conversion of results to JSON; parsing of JSON and TOML, and validation of the values against a type.

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

MAX_JSON_BYTES = 50_000_000  # larger JSON files are refused
MAX_TOML_BYTES = 100_000  # larger TOML files (mappings, a certificate's data) are refused

_SURROGATE = re.compile("[\ud800-\udfff]")  # half of a surrogate pair, which UTF-8 cannot encode
_TYPE_NAMES = {str: "text", bool: "true or false", int: "a whole number", date: "a date"}
_TYPE_NAMES |= {float: "a finite number", NoneType: "null"}


def as_json(value: Any) -> Any:
    """Convert a value to plain data for JSON: data classes to dictionaries, arrays to lists, NaN and ±inf to None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: as_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    if to_list := getattr(value, "tolist", None):
        return as_json(to_list())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def format_json(data: Any, indent: int = 2) -> str:
    """Format plain data as JSON text that ends in a line feed; raise ValueError for a non-finite number."""
    return json.dumps(data, indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(data: Any, path: Path, indent: int = 2) -> Path:
    """Write plain data as JSON to a path chosen by the user, and return it; raise InputError as `write_text` does."""
    return write_text(format_json(data, indent), path)


def validate(value: Any, schema: Any, path: str = "") -> Any:
    """Return a parsed JSON or TOML value as a type; raise ValueError with the path of an invalid entry, below `path`.

    Types: str, bool, int, float (finite), date, None, Any; list[…], tuple[…], dict[str, …]; unions; data classes and
    TypedDicts, whose keys without a default are required, and which allow no other keys.
    """
    origin, args = get_origin(schema), get_args(schema)
    if schema is Any:
        return value
    if origin in (Union, UnionType):
        for option in args:
            with suppress(ValueError):
                return validate(value, option, path)
        matching_types = [option for option in args if get_origin(option) is type(value)]
        return validate(value, (*matching_types, *args)[0], path)  # raises ValueError
    if origin in (list, tuple):
        types = args if origin is tuple and args[-1] is not ... else None
        if not isinstance(value, list) or (types and len(value) != len(types)):
            raise _build_error(value, f"a list of {len(types)}" if types else "a list", path)
        pairs = zip(value, types or args[:1] * len(value), strict=True)
        return origin(validate(*pair, f"{path}[{i}]") for i, pair in enumerate(pairs))
    if origin is dict or is_dataclass(schema) or is_typeddict(schema):
        return _validate_table(value, schema, path)
    schema = NoneType if schema is None else schema
    is_finite_number = type(value) in (int, float) and abs(value) < 1e308 and math.isfinite(value)
    is_valid = is_finite_number if schema is float else type(value) is schema
    if not is_valid or (schema is str and _SURROGATE.search(value)):
        raise _build_error(value, _TYPE_NAMES[schema], path)
    return float(value) if schema is float else value


def _validate_table(value: Any, schema: Any, path: str) -> Any:
    if not isinstance(value, dict):
        raise _build_error(value, "a table", path)
    constructor: Any = schema
    if get_origin(schema) is dict:
        constructor, types, required = dict, dict.fromkeys(value, get_args(schema)[1]), ()
    elif is_dataclass(schema):
        types = get_type_hints(schema)
        required = [f.name for f in fields(schema) if f.default is f.default_factory is MISSING]
    else:
        types, required = get_type_hints(schema), schema.__required_keys__
    for name in (n for n in types if n in required and n not in value):
        raise ValueError(f"{path}.{name}".lstrip(".") + " is missing")
    paths = {name: f"{path}.{str(name)[:60]}".lstrip(".") for name in value}
    for name in (n for n in value if n not in types):
        raise ValueError(f"{paths[name]} is unknown; known keys: {', '.join(types)}")
    return constructor(**{n: validate(entry, types[n], paths[n]) for n, entry in value.items()})


def _build_error(value: Any, expected: str, path: str) -> ValueError:
    kind = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    return ValueError(f"{path or 'it'} is {kind or repr(value)[:60]}, but {expected} was expected")


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError if it is invalid, or nested too deeply."""
    return _parse(json.loads, text, "JSON")


def _parse(parse: Callable[[Any], Any], text: str | bytes, format_name: str) -> Any:
    try:
        return parse(text)
    except (RecursionError, ValueError) as error:
        raise ValueError(f"it is not {format_name}: {error}") from None


def read_json(path: Path, schema: Any = Any) -> Any:
    """Read a JSON file and validate it against a type; raise OSError, or ValueError that names the invalid entry."""
    if path.stat().st_size > MAX_JSON_BYTES:
        raise ValueError(f"it is larger than {MAX_JSON_BYTES / 1e6:.0f} MB")
    return validate(parse_json(path.read_bytes()), schema)


def read_toml(path: Path, schema: Any, subject: str, remedy: str) -> Any:
    """Read a TOML file and validate it against a type; raise InputError: `subject`, the fault, `remedy`."""
    try:
        if path.stat().st_size > MAX_TOML_BYTES:
            raise ValueError(f"it is larger than {MAX_TOML_BYTES / 1e3:.0f} kB")
        return validate(_parse(tomllib.loads, path.read_text("utf-8-sig"), "TOML"), schema)
    except OSError as error:
        reason = f"cannot be read: {error.strerror or error}. Check the name and the folder"
        raise InputError(f"{subject} {reason}") from None
    except ValueError as error:
        raise InputError(f"{subject}: {error}. {remedy}") from None
