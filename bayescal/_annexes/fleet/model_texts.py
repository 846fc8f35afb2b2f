"""What a model computes, as texts that are the same in every process: its numbers, and the code of its functions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from types import CodeType
from typing import Any

from bayescal import Effect, Model


def model_texts(model: Model, candidates: Sequence[Effect] = ()) -> list[str]:
    """The texts of a model.

    Args:
        model: the model.
        candidates: effects that may be added to it.
    """
    instrument = model.instrument
    return [
        shown((instrument.name, instrument.settings, instrument.columns, instrument.slots)),
        _code_of(instrument.response),
        shown((type(model.noise).__name__, model.noise, model.fixed)),
        *(
            shown((e.name, e.slot, e.coefficients, e.shapes))
            + "".join(_code_of(function) for function in (e.basis, e.weights) if function)
            for e in (*model.effects, *candidates)
        ),
    ]


def _code_of(function: Any, depth: int = 0) -> str:
    """What a function does, as text: its code, constants, defaults and what it closes over."""
    bound: tuple[Any, ...] = ()
    if isinstance(function, partial):
        function, bound = function.func, (*function.args, *function.keywords.values())
    # Byte code, not source: a comment or a blank line changes nothing, a constant does.
    code = getattr(function, "__code__", None)
    if code is None or depth > 8:
        return f"{type(function).__name__} {getattr(function, '__qualname__', shown(function))}"
    closed = [cell.cell_contents for cell in getattr(function, "__closure__", None) or ()]
    given = [*bound, *closed, *(getattr(function, "__defaults__", None) or ())]
    inner = [_code_of(v, depth + 1) if callable(v) else shown(v) for v in given]
    return f"{_bytes_of(code)} {inner}"


def _bytes_of(code: CodeType) -> str:
    constants = [_bytes_of(c) if isinstance(c, CodeType) else shown(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"


def shown(value: Any) -> str:
    """A value as text that is the same in every process: no addresses, sets in order."""
    if isinstance(value, frozenset | set):
        return repr(sorted(map(repr, value)))
    return re.sub(r" at 0x[0-9a-fA-F]+", "", " ".join(repr(value).split()))
