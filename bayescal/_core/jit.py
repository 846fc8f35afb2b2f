"""Just-in-time compilation with options chosen by the amount of data, and partial functions compared by value.

Most models are fitted a few times to some hundred readings, and compilation takes a hundred times as long as running.
Without XLA's fusion emitters, compile time is halved at the same run time; also without backend optimisation, it is a
fifth, at up to three times the run time (docs/decisions.md).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

from bayescal._core.lazy_jax import jax

# Number of array elements in the arguments above which run time exceeds compile time.
MANY_NUMBERS = 30_000
ALWAYS = {"xla_cpu_use_fusion_emitters": False}  # compiler options
QUICK = {**ALWAYS, "xla_backend_optimization_level": 0}

P = ParamSpec("P")
R = TypeVar("R", covariant=True)


class compiled(Generic[P, R]):
    """`equinox.filter_jit` with compiler options chosen by the number of array elements in the arguments.

    Within another compiled function, the undecorated function is called. `many`: number of elements from which it is
    compiled with full optimisation.
    """

    def __init__(self, function: Callable[P, R], many: int = MANY_NUMBERS):
        self.function = function
        self.many = many
        self._jitted = cache(self._compiler)
        update_wrapper(self, function)

    def _compiler(self, few: bool) -> Any:
        import equinox as eqx

        return eqx.filter_jit(self.function, compiler_options=supported(QUICK if few else ALWAYS))

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        arrays = [a for a in jax.tree.leaves((args, kwargs)) if isinstance(a, jax.Array)]
        # Traced within another compiled function: JAX accepts compiler options at the outermost `jit` only.
        if any(isinstance(a, jax.core.Tracer) for a in arrays):
            return self.function(*args, **kwargs)
        return self._jitted(sum(a.size for a in arrays) < self.many)(*args, **kwargs)


def supported(options: dict[str, Any]) -> dict[str, Any]:
    """Select the compiler options that the installed version supports; unsupported ones would raise."""
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


def by_value(function: Any) -> Any:
    """Convert a `functools.partial` with hashable arguments to `value_partial`; return anything else unchanged."""
    if type(function) is not partial:
        return function
    args = map(by_value, function.args)  # a basis of a basis
    converted = value_partial(function.func, *args, **function.keywords)
    try:
        hash(converted)
    except TypeError:  # an array among its arguments
        return function
    return converted
