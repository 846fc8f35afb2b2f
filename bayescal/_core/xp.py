"""`xp`: functions of arrays by the names that NumPy and JAX share, computed by the library of their arguments.

A basis or a response that is written with `xp` is computed by NumPy on the host and traced by JAX within a program:
one text, both namespaces. In a search an array operation on the host costs microseconds, where a program costs
milliseconds to trace; NUTS, nonlinear least squares and exports trace the same text.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np

HOST_TYPES = frozenset((np.ndarray, np.float64, float, int, str, type(None)))  # the most frequent


def is_traced(values: Any) -> bool:
    """Return whether an array of JAX's is among some values, or in a list, tuple or dictionary of them."""
    jax = sys.modules.get("jax")  # where it was never imported, there is none of its arrays
    if jax is None or type(values) in HOST_TYPES:
        return False
    if isinstance(values, dict):
        values = values.values()
    elif not isinstance(values, list | tuple):
        return isinstance(values, jax.Array)
    return any(map(is_traced, values))


def special_of(values: Any) -> Any:
    """Return the module of special functions for some values: scipy's, or JAX's of the same names."""
    return import_module("jax.scipy.special" if is_traced(values) else "scipy.special")


class Namespace:
    """Functions of arrays, dispatched by their arguments: `xp.exp(x)`, `xp.linalg.norm(x)`."""

    def __init__(self, path: str = "") -> None:
        self._path = path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        path = f"{self._path}.{name}".lstrip(".")
        function: Any = attrgetter(path)(np)
        if isinstance(function, type(np)):
            function = Namespace(path)
        elif callable(function):
            function = _dispatched(path, function)
        setattr(self, name, function)
        return function

    def asarray(self, values: Any, dtype: Any = None) -> Any:
        """Return values as an array; one of a class of its own, such as of symbols, as it is."""
        if isinstance(values, np.ndarray) and type(values) is not np.ndarray:
            return values
        return _dispatched("asarray", np.asarray)(values, dtype)

    def placed(self, order: Any, values: Any) -> Any:
        """Place values by an order: placed[..., order] = values (..., n)."""
        if is_traced((order, values)):
            return self.zeros_like(values).at[..., order].set(values)
        if len(order) and order[0] == 0 and np.all(order[1:] > order[:-1]):  # as they stand
            return values
        placed = np.empty_like(values)
        placed[..., order] = values
        return placed

    def scan(self, advance: Callable[[Any, Any], tuple[Any, Any]], start: Any, rows: Any) -> Any:
        """Run a recursion over rows (n, …), or a tuple of such, as `jax.lax.scan`: state, out = advance(state, row)."""
        if is_traced((start, rows)):
            return import_module("jax").lax.scan(advance, start, rows)[1]
        state, outputs = start, []
        for row in zip(*rows, strict=True) if isinstance(rows, tuple) else rows:
            state, output = advance(state, row)
            outputs.append(output)
        return np.stack(outputs)


def _dispatched(path: str, on_host: Callable[..., Any]) -> Callable[..., Any]:
    of_jax = attrgetter(path)

    def function(*args: Any, **kwargs: Any) -> Any:
        if is_traced(args) or is_traced(kwargs):
            return of_jax(sys.modules["jax"].numpy)(*args, **kwargs)
        return on_host(*args, **kwargs)

    if hasattr(on_host, "accumulate"):
        function.accumulate = _dispatched(f"{path}.accumulate", on_host.accumulate)  # pyright: ignore[reportFunctionMemberAccess]
    return function


xp: Any = Namespace()
