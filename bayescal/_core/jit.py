"""Functions: compiled quickly where the data are few, well optimised where they are many; found again by value.

Most structures of a model are fitted a few times to some hundred readings, and compiling takes a hundred times as
long as computing. Without XLA's fusion emitters compiling takes half the time and computing no longer; without the
optimisations of its last stage too, a fifth, and computing at most three times as long (docs/decisions.md).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

from bayescal._core.lazy_jax import jax

# Numbers handed to a function, above which computing counts for more than compiling.
MANY_NUMBERS = 30_000
ALWAYS = {"xla_cpu_use_fusion_emitters": False}
QUICK = {**ALWAYS, "xla_backend_optimization_level": 0}

P = ParamSpec("P")
R = TypeVar("R", covariant=True)


class compiled(Generic[P, R]):
    """`equinox.filter_jit`, with options of the compiler after the number of numbers it is called with.

    Inside another compiled function it is the plain function: that one's options hold. `many` are the numbers in its
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
    """Those that the installed compiler knows: versions differ, and an unknown one is an error."""
    return {name: value for name, value in options.items() if _knows(name, value)}


@cache
def _knows(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value})(0.0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


class given(partial):
    """`functools.partial` that compares by value: made twice, or unpickled, it finds the same compiled programs."""

    def _key(self) -> tuple[Any, ...]:
        return self.func, self.args, tuple(sorted(self.keywords.items()))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, given) and self._key() == other._key())

    def __hash__(self) -> int:  # asked for at each call of a program
        if "_hash" not in vars(self):
            self._hash = hash(self._key())
        return self._hash

    def __reduce__(self) -> tuple[Any, ...]:  # another process hashes texts otherwise
        return partial(given, self.func, *self.args, **self.keywords), ()


def by_value(function: Any) -> Any:
    """A partial as `given`, where its arguments allow; any other function as it is."""
    if type(function) is not partial:
        return function
    args = map(by_value, function.args)  # a basis of a basis
    made = given(function.func, *args, **function.keywords)
    try:
        hash(made)
    except TypeError:  # an array among its arguments
        return function
    return made
