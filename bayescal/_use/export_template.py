"""The templates of exports, and what the headers among them begin with."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from typing import Any

from bayescal._core import templates
from bayescal._core.quoting import number_text


def code_template(
    file: str,
    filters: Mapping[str, Callable[..., Any]],
    package: str = "bayescal._use",
) -> Any:
    """A template of a package, in which `number` writes a number with all its digits."""
    filters = {"number": number_text, **filters}
    return templates.template(package, file, filters, keep_trailing_newline=True)


def include_guard(name: str, *computed: Any) -> str:
    """The first lines of a header: it is taken once, and not at all where another of its name was.

    Else the second of two would be passed over without a word, and its sensor be corrected by the first.

    Args:
        name: of the sensor.
        computed: what the header computes, whose checksum is the guard's value.
    """
    stamp = f"0x{zlib.crc32(repr(computed).encode()):08x}UL"
    guard = f"BAYESCAL_{name.upper()}_H"
    return (
        f"#if defined({guard}) && {guard} != {stamp}\n"
        f"#error two sensors are called {name}: export one of them with another name\n"
        f"#endif\n#ifndef {guard}\n#define {guard} {stamp}"
    )
