"""What a JSON or TOML file may hold, said as a shape, and checked before anything of it is used.

A shape is one of

    str, bool, int, float, date   a value of that type; a float is finite, and a whole number is one too
    [shape]                       a list of such
    (shape, shape, …)             a list of exactly these
    {"key": shape, …}             exactly these keys; one that ends in "?" may be missing
    {str: shape}                  any keys
    OneOf(shape, …)               whichever fits; None for null
    ANY                           a plain value that nothing is made of but text: no deeper than 32, no whole number
                                  of more than 64 bits

What comes in is walked no deeper than its shape, so that no nesting ends the program.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

from bayescal._core.errors import InputError

LARGEST_FILE = 50_000_000  # bytes of a JSON file that is read
LARGEST_TOML = 100_000  # bytes of a mapping, a certificate's data
LONGEST_LINE = 2_000  # characters: dotted keys take a time that grows with their number's square
DEEPEST = 32  # of lists and tables in each other; what bayescal writes has at most 9
MOST_WHOLE = 2**64  # from which a whole number fits no type that one is turned into

_SURROGATE = re.compile("[\ud800-\udfff]")  # half a character, which no file can hold


class OneOf:
    """Any of several shapes."""

    def __init__(self, *shapes: Any) -> None:
        self.shapes = shapes


class _Any:
    pass


ANY = _Any()


def mismatch(value: Any, shape: Any, where: str = "") -> str:
    """Where a value is not of a shape, and what was expected there; empty if it is."""
    if isinstance(shape, OneOf):
        # Of several shapes, none of which fits, the complaint at the deepest place is of the shape that was meant.
        tried = [mismatch(value, one, where) for one in shape.shapes]
        return "" if "" in tried else max(tried, key=lambda said: len(said.partition(" is ")[0]))
    if shape is ANY:
        return _unusable(value, where)
    if shape is None:
        return "" if value is None else _expected(value, "null", where)
    if isinstance(shape, type):
        return _of_type(value, shape, where)
    if isinstance(shape, list):
        if not isinstance(value, list):
            return _expected(value, "a list", where)
        return _first(mismatch(v, shape[0], f"{where}[{i}]") for i, v in enumerate(value))
    if isinstance(shape, tuple):
        if not isinstance(value, list) or len(value) != len(shape):
            return _expected(value, f"a list of {len(shape)}", where)
        both = enumerate(zip(value, shape, strict=True))
        return _first(mismatch(v, s, f"{where}[{i}]") for i, (v, s) in both)
    if not isinstance(value, dict):
        return _expected(value, "a table", where)
    if str in shape:
        return _first(mismatch(v, shape[str], _key(where, k)) for k, v in value.items())
    shapes = {name.removesuffix("?"): one for name, one in shape.items()}
    for name in shape:
        if name not in value and not name.endswith("?"):
            return f"{_key(where, name)} is missing"
    for name in value:
        if name not in shapes:
            return f"{_key(where, name)} is not known here; there are: {', '.join(shapes)}"
    return _first(mismatch(v, shapes[k], _key(where, k)) for k, v in value.items())


def _of_type(value: Any, kind: type, where: str) -> str:
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        right = number and abs(value) < 1e308 and math.isfinite(value)
        return "" if right else _expected(value, "a finite number", where)
    if isinstance(value, str) and kind is str:
        return _expected(value, "text", where) if _SURROGATE.search(value) else ""
    named = {str: "text", bool: "true or false", int: "a whole number", date: "a date"}[kind]
    return "" if type(value) is kind else _expected(value, named, where)


def _expected(value: Any, what: str, where: str) -> str:
    kind = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    came = kind or repr(value)[:60]
    return f"{where or 'it'} is {came}, {what} was expected"


def _key(where: str, name: str) -> str:
    name = str(name)[:60]
    return f"{where}.{name}" if where else name


def _first(found: Any) -> str:
    return next((one for one in found if one), "")


def _unusable(value: Any, where: str) -> str:
    """Whether lists and tables stand in each other deeper than anything written here, or hold a larger number."""
    level = [value]
    for _ in range(DEEPEST):
        if any(type(one) is int and abs(one) >= MOST_WHOLE for one in level):
            return f"{where or 'it'} holds a whole number of more than 64 bits"
        level = [
            inner
            for one in level
            if isinstance(one, list | dict)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return ""
    return f"{where or 'it'} is nested deeper than {DEEPEST}"


def parsed_json(text: str | bytes) -> Any:
    """JSON as a value.

    Raises:
        ValueError: it is none, nested deeper than anything that is written here, or holds a larger whole number.
    """
    return _parsed(json.loads, text)


def _parsed(parse: Callable[[Any], Any], text: str | bytes) -> Any:
    try:
        found = parse(text)
    except RecursionError:
        raise ValueError(f"it is nested deeper than {DEEPEST}") from None
    if said := _unusable(found, ""):
        raise ValueError(said)
    return found


def read_json(path: Path, shape: Any = ANY) -> Any:
    """A JSON file of a shape.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than any that is written here, no JSON, or of another shape; says where.
    """
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"it is larger than {LARGEST_FILE / 1e6:.0f} MB")
    found = parsed_json(path.read_bytes())
    if said := mismatch(found, shape):
        raise ValueError(said)
    return found


def read_toml(path: Path, shape: Any, called: str, cure: str) -> dict[str, Any]:
    """A TOML file of a shape, that a person wrote.

    Args:
        path, called: where it is, and what messages call it.
        shape: what it may hold.
        cure: what to do where it holds something else.

    Raises:
        InputError: it cannot be read, is larger than any that a person writes, no TOML, nested deeper than any, or of
            another shape; names the place in it, what came and what was expected.
    """
    try:
        if path.stat().st_size > LARGEST_TOML:
            raise ValueError(f"it is larger than {LARGEST_TOML / 1e3:.0f} kB")
        text = path.read_text("utf-8-sig")
        longest = max(map(len, text.splitlines()), default=0)
        if longest > LONGEST_LINE:
            raise ValueError(
                f"it has a line of {longest:,} characters, longer than {LONGEST_LINE:,}"
            )
        found = _parsed(tomllib.loads, text)
    except OSError as error:
        raise InputError(
            f"{called} cannot be read: {error.strerror or error}. Check the name and the folder"
        ) from None
    except ValueError as error:
        raise InputError(f"{called} is not TOML: {error}") from None
    if said := mismatch(found, shape):
        raise InputError(f"{called}: {said}. {cure}")
    return found


def required(value: Any, shape: Any, file: str, instead: str) -> Any:
    """A value, if it is of a shape.

    Raises:
        InputError: it is not; names the file, the place in it, what came and what was expected.
    """
    if said := mismatch(value, shape):
        raise InputError(f"{file} is damaged: {said}. {instead}")
    return value
