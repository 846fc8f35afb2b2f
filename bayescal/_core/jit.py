"""Just-in-time compilation with options chosen by the length of a run, and partial functions compared by value.

Most models are fitted a few times to some hundred readings, and compilation takes a hundred times as long as running.
Without XLA's fusion emitters, compilation takes half the time, at the same run time; without backend optimisation
either, it takes a fifth, at up to three times the run time (docs/decisions.md).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, TypeVar

from bayescal._core.lazy_jax import jax

R = TypeVar("R")


def compile_lazily(
    function: Callable[..., R], is_long: Callable[..., bool] = lambda *_: False
) -> Callable[..., R]:
    """Return a function that compiles `function(static argument, *arrays)` at its first call, and calls it.

    `is_long`, of the same arguments, chooses fully optimised code if true, else fast compilation.
    """

    @cache
    def compile_once(is_optimised: bool) -> Callable[..., R]:
        return jax.jit(function, static_argnums=0, compiler_options=compiler_options(is_optimised))

    @wraps(function)
    def call(*args: Any) -> R:
        return compile_once(is_long(*args))(*args)

    return call


def compiler_options(is_optimised: bool) -> dict[str, Any]:
    """Return XLA compiler options, backend optimisation off unless `is_optimised`, without those that XLA rejects."""
    options: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
    options |= {} if is_optimised else {"xla_backend_optimization_level": 0}
    return {name: value for name, value in options.items() if _is_supported(name, value)}


@cache
def _is_supported(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value})(0.0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


class value_partial(partial):
    """`functools.partial` that compares by value, so that equal or unpickled partials share compiled programs."""

    def _key(self) -> tuple[Any, ...]:
        return self.func, self.args, tuple(sorted(self.keywords.items()))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, value_partial) and self._key() == other._key())

    def __hash__(self) -> int:  # at each call of a program
        if "_hash" not in vars(self):
            self._hash = hash(self._key())
        return self._hash

    def __reduce__(self) -> tuple[Any, ...]:  # hashes of text differ between processes
        return partial(value_partial, self.func, *self.args, **self.keywords), ()


def to_value_partial(function: Any) -> Any:
    """Convert a `functools.partial` with hashable arguments to a `value_partial`; return any other value unchanged."""
    if type(function) is not partial:
        return function
    args = map(to_value_partial, function.args)  # a basis of a basis
    converted = value_partial(function.func, *args, **function.keywords)
    try:
        hash(converted)
    except TypeError:  # an array among its arguments
        return function
    return converted
