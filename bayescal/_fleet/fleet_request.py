"""What a run does to every partition, and the digest by which its results are known again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

from bayescal._calibration.description import stated
from bayescal._core.version import __version__
from bayescal._data.read_options import ReadOptions
from bayescal._fleet.find_devices import Find
from bayescal._fleet.fit_devices import CHUNK
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import Marginal
from bayescal._model.effect import Effect
from bayescal._model.formula import Formula
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._tables.open_table import MAX_BYTES


@dataclass(frozen=True)
class Request:
    """What is fitted to every device, and how its file is read.

    Attributes:
        model: what is fitted.
        method: of every fit.
        seed: of every random number.
        chunk: devices fitted at once at most.
        reference: constants of the bases.
        options: how columns are understood.
        max_bytes: most that a file may take in memory.
        find: what is looked for in each device, if anything is.
    """

    model: Model
    method: LeastSquares | Marginal
    seed: int = 0
    chunk: int = CHUNK
    reference: Reference = field(default_factory=dict)
    options: ReadOptions = field(default_factory=ReadOptions)
    max_bytes: int = MAX_BYTES
    find: Find | None = None

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Columns that the effects use."""
        return tuple(dict.fromkeys(c for e in self.model.effects for c in e.columns))

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all that results depend on, but the readings."""
        model, options = self.model, vars(self.options)
        said = {
            "version": __version__,
            "instrument": [model.instrument.name, repr(model.instrument.settings)],
            "columns": repr(model.instrument.columns),
            "effects": [_effect(e) for e in model.effects],
            "noise": repr(model.noise),
            "fixed": list(model.fixed),
            "method": repr(self.method),
            "seed": self.seed,
            "chunk": self.chunk,
            "reference": {k: repr(v) for k, v in sorted(self.reference.items())},
            "find": None if self.find is None else _find(self.find),
            "options": {k: _plain(v) for k, v in sorted(options.items())},
        }
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _find(find: Find) -> list[Any]:
    kept = "evidence of each structure"  # beside a device's own choice, since 0.3
    return [kept, [_effect(e) for e in find.effects], find.max_effects, find.widen_noise]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return sorted((str(k), str(v)) for k, v in value.items())
    return sorted(value) if isinstance(value, frozenset) else repr(value)


def _effect(effect: Effect) -> list[str]:
    functions = (effect.basis, effect.weights)
    return [effect.name, effect.slot, stated(effect), *(_code(f) for f in functions if f)]


def _code(function: Callable[..., Any] | Any) -> str:
    """What a function does, as its code: an effect changed in a user's file is another one."""
    if isinstance(function, partial):
        return f"{_code(function.func)} {function.args!r} {sorted(function.keywords.items())!r}"
    if isinstance(function, Formula):
        return function.text
    code = getattr(function, "__code__", None)
    if code is None:
        return f"{type(function).__module__}.{type(function).__qualname__}"
    return f"{function.__qualname__} {_code_of(code)}"


def _code_of(code: Any) -> str:
    inner = [_code_of(c) if hasattr(c, "co_code") else repr(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {inner}"
