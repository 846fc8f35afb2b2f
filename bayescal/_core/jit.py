"""Compiled functions: compiled quickly for few data, well optimised for many; cached by value.

Most structures of a model are fitted a few times to some hundred readings, and compiling takes a hundred times as
long as computing. Without XLA's fusion emitters compiling takes half the time and computing no longer; without the
optimisations of its last stage too, a fifth, and computing at most three times as long (docs/decisions.md).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

from bayescal._core.lazy_jax import jax

# Numbers in a function's arguments, from which computing takes longer than compiling.
MANY_NUMBERS = 30_000
ALWAYS = {"xla_cpu_use_fusion_emitters": False}
QUICK = {**ALWAYS, "xla_backend_optimization_level": 0}

P = ParamSpec("P")
R = TypeVar("R", covariant=True)


class compiled(Generic[P, R]):
    """`equinox.filter_jit`, with compiler options chosen by the number of numbers in the arguments.

    Inside another compiled function it is the plain function, under that one's options. `many` is the size of the
    arguments from which on it is well optimised.
    """

    def __init__(self, function: Callable[P, R], many: int = MANY_NUMBERS):
        self.function = function
        self.many = many
        self._jitted = cache(self._compiler)
        update_wrapper(self, function)

    def _compiler(self, few: bool) -> Any:
        import equinox as eqx

        return eqx.filter_jit(self.function, compiler_options=known(QUICK if few else ALWAYS))

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        numbers = [a for a in jax.tree.leaves((args, kwargs)) if isinstance(a, jax.Array)]
        # Traced within another compiled function: JAX takes options of the compiler at the outermost `jit` alone.
        if any(isinstance(a, jax.core.Tracer) for a in numbers):
            return self.function(*args, **kwargs)
        return self._jitted(sum(a.size for a in numbers) < self.many)(*args, **kwargs)


def known(options: dict[str, Any]) -> dict[str, Any]:
    """Select the options that the installed compiler supports: versions differ, and an unknown one is an error."""
    return {name: value for name, value in options.items() if _is_supported(name, value)}


@cache
def _is_supported(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value})(0.0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


class value_partial(partial):
    """`functools.partial` that compares by value, so that an equal or unpickled one uses the same compiled programs."""

    def _key(self) -> tuple[Any, ...]:
        return self.func, self.args, tuple(sorted(self.keywords.items()))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, value_partial) and self._key() == other._key())

    def __hash__(self) -> int:  # at each call of a program
        if "_hash" not in vars(self):
            self._hash = hash(self._key())
        return self._hash

    def __reduce__(self) -> tuple[Any, ...]:  # another process hashes texts otherwise
        return partial(value_partial, self.func, *self.args, **self.keywords), ()


def by_value(function: Any) -> Any:
    """Convert a partial to one that compares by value, where its arguments are hashable; return others as they are."""
    if type(function) is not partial:
        return function
    args = map(by_value, function.args)  # a basis of a basis
    converted = value_partial(function.func, *args, **function.keywords)
    try:
        hash(converted)
    except TypeError:  # an array among its arguments
        return function
    return converted
