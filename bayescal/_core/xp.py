"""`xp`: array functions common to NumPy and JAX, dispatched by the type of their arguments.

A basis or response written with `xp` is evaluated by NumPy on NumPy arrays and traced by JAX in JAX programs. Searches
evaluate it by NumPy, in microseconds (tracing takes milliseconds); NUTS, nonlinear least squares and exports trace it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np

HOST_TYPES = frozenset((np.ndarray, np.float64, float, int, str, type(None)))  # not JAX arrays


def is_traced(values: Any) -> bool:
    """Return whether the values are a JAX array, or a list, tuple or dictionary that contains one."""
    jax = sys.modules.get("jax")  # if it was never imported, there are no JAX arrays
    if jax is None or type(values) in HOST_TYPES:
        return False
    if isinstance(values, dict):
        values = values.values()
    elif not isinstance(values, list | tuple):
        return isinstance(values, jax.Array)
    return any(map(is_traced, values))


def get_special_functions(values: Any) -> Any:
    """Return the module of special functions for the type of values: scipy.special or jax.scipy.special."""
    return import_module("jax.scipy.special" if is_traced(values) else "scipy.special")


class Namespace:
    """Array functions that dispatch to NumPy or JAX by their arguments: `xp.exp(x)`, `xp.linalg.norm(x)`."""

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
            function = _dispatch(path, function)
        setattr(self, name, function)
        return function

    def asarray(self, values: Any, dtype: Any = None) -> Any:
        """Convert values to an array; subclasses of `numpy.ndarray`, such as symbolic ones, are returned unchanged."""
        if isinstance(values, np.ndarray) and type(values) is not np.ndarray:
            return values
        return _dispatch("asarray", np.asarray)(values, dtype)

    def scatter(self, order: Any, values: Any) -> Any:
        """Return values (..., n) scattered by a permutation `order`: result[..., order] = values."""
        if is_traced((order, values)):
            return self.zeros_like(values).at[..., order].set(values)
        if len(order) and order[0] == 0 and np.all(order[1:] > order[:-1]):  # the identity
            return values
        scattered = np.empty_like(values)
        scattered[..., order] = values
        return scattered

    def scan(self, advance: Callable[[Any, Any], tuple[Any, Any]], start: Any, rows: Any) -> Any:
        """Apply `advance` to the rows (n, …), or tuples of rows, in turn, as `jax.lax.scan`; return the outputs.

        advance(state, row) returns (next state, output); the outputs are stacked along the first axis (n, …).
        """
        if is_traced((start, rows)):
            return import_module("jax").lax.scan(advance, start, rows)[1]
        state, outputs = start, []
        for row in zip(*rows, strict=True) if isinstance(rows, tuple) else rows:
            state, output = advance(state, row)
            outputs.append(output)
        return np.stack(outputs)


def _dispatch(path: str, numpy_function: Callable[..., Any]) -> Callable[..., Any]:
    get_jax_function = attrgetter(path)

    def dispatch(*args: Any, **kwargs: Any) -> Any:
        is_host = HOST_TYPES.issuperset(map(type, (*args, *kwargs.values())))
        if not is_host and (is_traced(args) or is_traced(kwargs)):
            return get_jax_function(sys.modules["jax"].numpy)(*args, **kwargs)
        return numpy_function(*args, **kwargs)

    if hasattr(numpy_function, "accumulate"):
        dispatch.accumulate = _dispatch(f"{path}.accumulate", numpy_function.accumulate)  # pyright: ignore[reportFunctionMemberAccess]
    return dispatch


xp: Any = Namespace()
