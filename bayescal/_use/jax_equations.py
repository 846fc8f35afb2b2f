"""Functions that are written for JAX alone, as a basis of a user's own may be: traced by it, to a graph of scalars.

A function comes to a graph through its jaxpr, which is run on symbols. What only moves elements about (reshape,
broadcast, slice, gather, concatenate) is run by JAX itself on the *places* of the elements, so that none of it is left
in the graph; constants are computed. An operation that has no scalar form stays a call of JAX's, with its derivatives:
it is computed here, and cannot be exported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from bayescal._core.lazy_jax import jax, jnp
from bayescal._use.expression_graph import OPERATIONS, Graph, NotExportable, Symbol, Symbols

_MOVES = "broadcast_in_dim reshape squeeze expand_dims slice dynamic_slice gather transpose rev copy unstack split"
TOGETHER = ("concatenate", "stack")  # move elements of all their arguments
MOVES = (*_MOVES.split(), *TOGETHER)
CALLS = ["pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"]


def _reduction(combine: np.ufunc) -> Callable[..., Any]:
    return lambda p, x: combine.reduce(x, axis=tuple(p["axes"]))


def _elementwise(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda p, *arrays: function(*arrays)


def _dot(p: Any, left: Any, right: Any) -> Any:
    """A product of matrices or vectors, without batch dimensions."""
    (of_left, of_right), (batch, _) = p["dimension_numbers"]
    if batch:
        raise NotExportable("products with batch dimensions have no form in an export")
    axes = range(-len(of_left), 0)
    a, b = np.moveaxis(left, of_left, axes), np.moveaxis(right, of_right, axes)
    free = a.ndim - len(of_left)
    a = a.reshape(*a.shape[:free], *(1,) * (b.ndim - len(of_right)), *a.shape[free:])
    return np.sum(a * b, axis=tuple(axes))


# Primitives as NumPy's functions of symbols, each of its parameters and arrays.
RULES: dict[str, Callable[..., Any]] = {
    **{n: _elementwise(o.compute) for n, o in OPERATIONS.items() if n not in ("select", "real")},
    "add_any": _elementwise(np.add),
    "square": _elementwise(np.square),
    "rsqrt": _elementwise(lambda x: 1.0 / np.sqrt(x)),
    "logistic": _elementwise(lambda x: 1.0 / (1.0 + np.exp(-x))),
    "stop_gradient": _elementwise(lambda x: x),
    "clamp": _elementwise(lambda low, x, high: np.minimum(np.maximum(x, low), high)),
    "select_n": _elementwise(lambda which, no, yes: np.where(which, yes, no)),
    "integer_pow": lambda p, x: x ** p["y"],
    "convert_element_type": lambda p, x: x.astype(p["new_dtype"]),
    "reduce_sum": _reduction(np.add),
    "reduce_max": _reduction(np.maximum),
    "reduce_min": _reduction(np.minimum),
    "reduce_prod": _reduction(np.multiply),
    "dot_general": _dot,
}


def traced_by_jax(
    graph: Graph, function: Callable[[Any, Any], Any], frame: Any, values: Mapping[str, Any]
) -> Symbols:
    """What a function, written for JAX's arrays, returns of one reading and values by name, of symbols and numbers."""
    parts = {name: getattr(frame, name) for name in ("columns", "rates", "record", "labels")}
    leaves, structure = jax.tree.flatten((parts, dict(values)))
    lag = import_module("jax.extend.core").Primitive("lag")
    lag.def_abstract_eval(lambda tau, column: jax.core.ShapedArray((1,), tau.dtype))

    def lagged(column: str, tau: Any) -> Any:
        return lag.bind(jnp.asarray(tau, float), column=column)

    def of_leaves(*leaves: Any) -> Any:
        parts, values = jax.tree.unflatten(structure, leaves)
        return jnp.asarray(function(replace(frame, **parts, lagged=lagged), values))

    closed = jax.make_jaxpr(of_leaves)(*(np.ones(np.shape(leaf)) for leaf in leaves))
    rules = {**RULES, "lag": lambda p, tau: frame.lagged(p["column"], tau)}
    (found,) = _run(closed.jaxpr, closed.consts, [graph.symbols(leaf) for leaf in leaves], rules)
    return graph.symbols(found)


def _run(
    jaxpr: Any, constants: Sequence[Any], inputs: Sequence[Any], rules: Mapping[str, Any]
) -> list[Any]:
    """What a jaxpr gives of symbols and numbers."""
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
    values |= dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> Any:
        value = np.asarray(atom.val) if hasattr(atom, "val") else values[atom]
        constant = isinstance(value, Symbols) and not any(isinstance(e, Symbol) for e in value.flat)
        return np.array(value.tolist(), atom.aval.dtype) if constant else value

    for equation in jaxpr.eqns:
        arguments, p = [*map(read, equation.invars)], equation.params
        name = equation.primitive.name
        try:
            if name in CALLS:
                inner = next(p[n] for n in ("jaxpr", "call_jaxpr", "fun_jaxpr") if n in p)
                own = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
                found = _run(*own, arguments, rules)
            elif not any(isinstance(a, Symbols) for a in arguments) and name != "lag":
                found = [*map(np.asarray, _bound(equation, arguments))]
            elif name in MOVES:
                found = _moved(equation, arguments)
            elif name in rules:
                found = [rules[name](p, *arguments)]
            else:
                raise NotExportable(f"the operation {name!r} has no form in C or plain Python here")
        except NotExportable as error:
            found = _called(equation, arguments, str(error))
        values |= dict(zip(equation.outvars, found, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _bound(equation: Any, arguments: Sequence[Any], **parameters: Any) -> list[Any]:
    """What JAX makes of numbers."""
    whole = {**equation.params, **parameters}
    found = equation.primitive.bind(*map(jnp.asarray, arguments), **whole)
    return [*found] if equation.primitive.multiple_results else [found]


def _moved(equation: Any, arguments: list[Any]) -> list[Symbols]:
    """What only moves elements, run on the numbers of their places; indices stay what they are."""
    moving = arguments if equation.primitive.name in TOGETHER else arguments[:1]
    if any(isinstance(a, Symbols) for a in arguments[len(moving) :]):
        raise NotExportable(
            "an element whose place depends on a covariate has no form in an export"
        )
    graph = next(a.graph for a in moving if isinstance(a, Symbols))
    pool, placed = list[Any](), list[Any]()
    for argument in moving:
        placed.append(len(pool) + np.arange(np.size(argument)).reshape(np.shape(argument)))
        pool += np.asarray(argument, dtype=object).reshape(-1).tolist()
    filled = {} if equation.params.get("fill_value") is None else {"fill_value": 0}
    elements = np.empty(len(pool), dtype=object)
    elements[:] = pool
    found = _bound(equation, [*placed, *arguments[len(moving) :]], **filled)
    return [graph.symbols(elements[np.asarray(places)]) for places in found]


class Call:
    """A function of `count` scalars that JAX computes, as an operation of a graph; why it cannot be exported."""

    boolean = False

    def __init__(self, function: Callable[..., Any], count: int, why_not: str) -> None:
        self.function, self.count, self.why_not = function, count, why_not
        self._together = jax.jit(jax.vmap(function))

    def of(self, graph: Graph, elements: Sequence[Any]) -> Symbol:
        """This function of some symbols and numbers."""
        return Symbol(graph.put(("call", self, *map(graph.place_of, elements))))

    def compute(self, *values: Any) -> np.ndarray:
        """Its values, element by element."""
        values = np.broadcast_arrays(*values)
        return np.asarray(self._together(*map(np.ravel, values))).reshape(values[0].shape)

    @property
    def pullbacks(self) -> list[Callable[..., Any]]:
        """By argument, what of a slope d passes back to it."""

        def pullback(i: int, d: Any, *values: Symbols) -> Any:
            slope = Call(jax.grad(self.function, i), self.count, self.why_not)
            return d * values[0].graph.symbols(slope.of(values[0].graph, values))

        return [partial(pullback, i) for i in range(self.count)]


def _called(equation: Any, arguments: list[Any], why_not: str) -> list[Symbols]:
    """An operation as calls of JAX, one for each element of its results."""
    own = [a for a in arguments if isinstance(a, Symbols)]
    graph, ends = own[0].graph, np.cumsum([a.size for a in own])[:-1]
    elements = [element for a in own for element in np.asarray(a).flat]

    def of_scalars(result: int, element: int, *scalars: Any) -> Any:
        parts = iter(jnp.split(jnp.stack(scalars), ends))
        whole = [
            next(parts).reshape(v.aval.shape).astype(v.aval.dtype) if isinstance(a, Symbols) else a
            for a, v in zip(arguments, equation.invars, strict=True)
        ]
        return jnp.ravel(_bound(equation, whole)[result])[element].astype(float)

    found = list[Symbols]()
    for result, variable in enumerate(equation.outvars):
        made = np.empty(variable.aval.shape, dtype=object)
        for i in range(made.size):
            one = Call(partial(of_scalars, result, i), len(elements), why_not)
            made.flat[i] = one.of(graph, elements)
        found.append(graph.symbols(made))
    return found
