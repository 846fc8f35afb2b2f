"""JSON and TOML read as values of a type, checked before anything of it is used.

What comes in is walked no deeper than its type, so that no nesting ends the program.
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

from bayescal._core.errors import InputError

LARGEST_FILE = 50_000_000  # bytes of a JSON file that is read
LARGEST_TOML = 100_000  # bytes of a mapping, a certificate's data
LONGEST_LINE = 2_000  # characters: dotted keys take a time that grows with their number's square
DEEPEST = 32  # of lists and tables in each other; what bayescal writes has at most 9
MOST_WHOLE = 2**64  # from which a whole number fits no type that one is turned into

_SURROGATE = re.compile("[\ud800-\udfff]")  # half a character, which no file can hold
_NAMES = {str: "text", bool: "true or false", int: "a whole number", date: "a date"}
_NAMES |= {float: "a finite number", NoneType: "null"}


def as_type(value: Any, kind: Any, where: str = "") -> Any:
    """Return a parsed JSON or TOML value as one of a type.

    Args:
        value: of lists, tables, text, numbers, truth values and dates.
        kind: str, bool, int, float (finite), date, None, Any; list[…], tuple[…], dict[str, …]; a union of such; a data
            class or TypedDict, of whose keys those without a default have to be there, and no others.
        where: the place of the value, for messages.

    Raises:
        ValueError: it is none; names the place in it, what came and what was expected.
    """
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        for one in args:
            with suppress(ValueError):
                return as_type(value, one, where)
        meant = [one for one in args if get_origin(one) is type(value)]
        return as_type(value, (*meant, *args)[0], where)  # which refuses it
    if origin in (list, tuple):
        each = args if origin is tuple and args[-1] is not ... else None
        if not isinstance(value, list) or (each and len(value) != len(each)):
            raise _unexpected(value, f"a list of {len(each)}" if each else "a list", where)
        pairs = zip(value, each or args[:1] * len(value), strict=True)
        return origin(as_type(*one, f"{where}[{i}]") for i, one in enumerate(pairs))
    if origin is dict or is_dataclass(kind) or is_typeddict(kind):
        return _as_table(value, kind, where)
    kind = NoneType if kind is None else kind
    number = type(value) in (int, float) and abs(value) < 1e308 and math.isfinite(value)
    right = number if kind is float else type(value) is kind
    if not right or (kind is str and _SURROGATE.search(value)):
        raise _unexpected(value, _NAMES[kind], where)
    return float(value) if kind is float else value


def _as_table(value: Any, kind: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _unexpected(value, "a table", where)
    made: Any = kind
    if get_origin(kind) is dict:
        made, known, required = dict, dict.fromkeys(value, get_args(kind)[1]), ()
    elif is_dataclass(kind):
        known = get_type_hints(kind)
        required = [f.name for f in fields(kind) if f.default is f.default_factory is MISSING]
    else:
        known, required = get_type_hints(kind), kind.__required_keys__
    for name in (n for n in known if n in required and n not in value):
        raise ValueError(f"{where}.{name}".lstrip(".") + " is missing")
    at = {name: f"{where}.{str(name)[:60]}".lstrip(".") for name in value}
    for name in (n for n in value if n not in known):
        raise ValueError(f"{at[name]} is not known here; there are: {', '.join(known)}")
    return made(**{name: as_type(one, known[name], at[name]) for name, one in value.items()})


def _unexpected(value: Any, what: str, where: str) -> ValueError:
    kind = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    return ValueError(f"{where or 'it'} is {kind or repr(value)[:60]}, {what} was expected")


def parsed_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: it is none, nested deeper than anything that is written here, or holds a larger whole number.
    """
    return _parsed(json.loads, text, "JSON")


def _parsed(parse: Callable[[Any], Any], text: str | bytes, language: str) -> Any:
    try:
        found = parse(text)
    except RecursionError:
        raise ValueError(f"it is nested deeper than {DEEPEST}") from None
    except ValueError as error:
        raise ValueError(f"it is not {language}: {error}") from None
    level = [found]
    for _ in range(DEEPEST):
        if any(type(one) is int and abs(one) >= MOST_WHOLE for one in level):
            raise ValueError("it holds a whole number of more than 64 bits")
        held = [list(one.values()) if isinstance(one, dict) else one for one in level]
        level = [inner for one in held if isinstance(one, list) for inner in one]
    if level:
        raise ValueError(f"it is nested deeper than {DEEPEST}")
    return found


def read_json(path: Path, kind: Any = Any) -> Any:
    """Read a JSON file as a value of a type; see `as_type`.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than any that is written here, no JSON, or of another type; says where.
    """
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"it is larger than {LARGEST_FILE / 1e6:.0f} MB")
    return as_type(parsed_json(path.read_bytes()), kind)


def read_toml(path: Path, kind: Any, called: str, cure: str) -> Any:
    """Read a TOML file that a person wrote as a value of a type; see `as_type`.

    Args:
        path, called: where it is, and what messages call it.
        kind: of the whole file.
        cure: what to do where it holds something else.

    Raises:
        InputError: it cannot be read, is larger than any that a person writes, no TOML, nested deeper than any, or of
            another type; names the place in it, what came and what was expected.
    """
    try:
        if path.stat().st_size > LARGEST_TOML:
            raise ValueError(f"it is larger than {LARGEST_TOML / 1e3:.0f} kB")
        text = path.read_text("utf-8-sig")
        if max(map(len, text.splitlines()), default=0) > LONGEST_LINE:
            raise ValueError(f"it has a line of more than {LONGEST_LINE:,} characters")
        return as_type(_parsed(tomllib.loads, text, "TOML"), kind)
    except OSError as error:
        said = f"cannot be read: {error.strerror or error}. Check the name and the folder"
        raise InputError(f"{called} {said}") from None
    except ValueError as error:
        raise InputError(f"{called}: {error}. {cure}") from None
