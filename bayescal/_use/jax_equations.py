"""Tracing of functions that only JAX can evaluate, such as a user's basis, to a graph of scalar operations.

A function's jaxpr is evaluated on symbols. Primitives that only move elements (reshape, broadcast, slice, gather,
concatenate) are evaluated by JAX on the elements' indices, and add no node to the graph; constants are folded. An
operation without a scalar form becomes a call of JAX: it can be evaluated and differentiated, but not exported.
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

_MOVE_NAMES = "broadcast_in_dim reshape squeeze expand_dims slice dynamic_slice gather transpose rev copy unstack split"
JOIN_PRIMITIVES = ("concatenate", "stack")  # move elements of all their arguments
MOVE_PRIMITIVES = (*_MOVE_NAMES.split(), *JOIN_PRIMITIVES)
CALLS = ["pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"]


def _build_reduction(combine: np.ufunc) -> Callable[..., Any]:
    return lambda p, x: combine.reduce(x, axis=tuple(p["axes"]))


def _build_elementwise(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda p, *arrays: function(*arrays)


def _multiply_arrays(p: Any, x: Any, y: Any) -> Any:
    """Multiply matrices or vectors, without batch dimensions."""
    (x_axes, y_axes), (batch_axes, _) = p["dimension_numbers"]
    if batch_axes:
        raise NotExportable("matrix products with batch dimensions cannot be exported")
    axes = range(-len(x_axes), 0)
    a, b = np.moveaxis(x, x_axes, axes), np.moveaxis(y, y_axes, axes)
    free_count = a.ndim - len(x_axes)
    a = a.reshape(*a.shape[:free_count], *(1,) * (b.ndim - len(y_axes)), *a.shape[free_count:])
    return np.sum(a * b, axis=tuple(axes))


# JAX primitive → function of its parameters and of arrays of symbols.
RULES: dict[str, Callable[..., Any]] = {
    **{n: _build_elementwise(o.compute) for n, o in OPERATIONS.items() if n != "select"},
    "add_any": _build_elementwise(np.add),
    "square": _build_elementwise(np.square),
    "rsqrt": _build_elementwise(lambda x: 1.0 / np.sqrt(x)),
    "logistic": _build_elementwise(lambda x: 1.0 / (1.0 + np.exp(-x))),
    "stop_gradient": _build_elementwise(lambda x: x),
    "clamp": _build_elementwise(lambda low, x, high: np.minimum(np.maximum(x, low), high)),
    "select_n": _build_elementwise(lambda which, no, yes: np.where(which, yes, no)),
    "integer_pow": lambda p, x: x ** p["y"],
    "convert_element_type": lambda p, x: x.astype(p["new_dtype"]),
    "reduce_sum": _build_reduction(np.add),
    "reduce_max": _build_reduction(np.maximum),
    "reduce_min": _build_reduction(np.minimum),
    "reduce_prod": _build_reduction(np.multiply),
    "dot_general": _multiply_arrays,
}


def trace_jax_function(
    graph: Graph, function: Callable[[Any, Any], Any], frame: Any, values: Mapping[str, Any]
) -> Symbols:
    """Return the symbols to which a JAX function of a frame (one reading) and named values evaluates."""
    fields = {name: getattr(frame, name) for name in ("columns", "rates", "record", "labels")}
    leaves, structure = jax.tree.flatten((fields, dict(values)))
    lag = import_module("jax.extend.core").Primitive("lag")
    lag.def_abstract_eval(lambda tau, column: jax.core.ShapedArray((1,), tau.dtype))

    def bind_lag(column: str, tau: Any) -> Any:
        return lag.bind(jnp.asarray(tau, float), column=column)

    def evaluate_leaves(*leaves: Any) -> Any:
        fields, values = jax.tree.unflatten(structure, leaves)
        return jnp.asarray(function(replace(frame, **fields, lagged=bind_lag), values))

    jaxpr = jax.make_jaxpr(evaluate_leaves)(*(np.ones(np.shape(leaf)) for leaf in leaves))
    rules = {**RULES, "lag": lambda p, tau: frame.lagged(p["column"], tau)}
    (output,) = _trace(jaxpr.jaxpr, jaxpr.consts, [graph.symbols(leaf) for leaf in leaves], rules)
    return graph.symbols(output)


def _trace(
    jaxpr: Any, constants: Sequence[Any], inputs: Sequence[Any], rules: Mapping[str, Any]
) -> list[Any]:
    """Evaluate a jaxpr on symbols and numbers; return its outputs."""
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
    values |= dict(zip(jaxpr.invars, inputs, strict=True))

    def get_value(atom: Any) -> Any:
        value = np.asarray(atom.val) if hasattr(atom, "val") else values[atom]
        if isinstance(value, Symbols) and not any(isinstance(e, Symbol) for e in value.flat):
            return np.array(value.tolist(), atom.aval.dtype)  # constants only
        return value

    for equation in jaxpr.eqns:
        arguments, p = [*map(get_value, equation.invars)], equation.params
        name = equation.primitive.name
        try:
            if name in CALLS:
                callee = next(p[n] for n in ("jaxpr", "call_jaxpr", "fun_jaxpr") if n in p)
                subprogram = getattr(callee, "jaxpr", callee), getattr(callee, "consts", ())
                outputs = _trace(*subprogram, arguments, rules)
            elif not any(isinstance(a, Symbols) for a in arguments) and name != "lag":
                outputs = [*map(np.asarray, _evaluate_primitive(equation, arguments))]
            elif name in MOVE_PRIMITIVES:
                outputs = _move_elements(equation, arguments)
            elif name in rules:
                outputs = [rules[name](p, *arguments)]
            else:
                raise NotExportable(f"the operation {name!r} cannot be exported to C or Python")
        except NotExportable as error:
            outputs = _replace_by_calls(equation, arguments, str(error))
        values |= dict(zip(equation.outvars, outputs, strict=True))
    return [get_value(v) for v in jaxpr.outvars]


def _evaluate_primitive(equation: Any, arguments: Sequence[Any], **parameters: Any) -> list[Any]:
    """Evaluate a primitive on numbers with JAX; return its results."""
    all_parameters = {**equation.params, **parameters}
    outputs = equation.primitive.bind(*map(jnp.asarray, arguments), **all_parameters)
    return [*outputs] if equation.primitive.multiple_results else [outputs]


def _move_elements(equation: Any, arguments: list[Any]) -> list[Symbols]:
    """Move elements by evaluating a primitive on their indices; arguments that are indices must be numbers."""
    arrays = arguments if equation.primitive.name in JOIN_PRIMITIVES else arguments[:1]
    if any(isinstance(a, Symbols) for a in arguments[len(arrays) :]):
        raise NotExportable("an array index that depends on a covariate cannot be exported")
    graph = next(a.graph for a in arrays if isinstance(a, Symbols))
    all_elements, indices = list[Any](), list[Any]()
    for argument in arrays:
        indices.append(len(all_elements) + np.arange(np.size(argument)).reshape(np.shape(argument)))
        all_elements += np.asarray(argument, dtype=object).reshape(-1).tolist()
    options = {} if equation.params.get("fill_value") is None else {"fill_value": 0}
    elements = np.empty(len(all_elements), dtype=object)
    elements[:] = all_elements
    results = _evaluate_primitive(equation, [*indices, *arguments[len(arrays) :]], **options)
    return [graph.symbols(elements[np.asarray(positions)]) for positions in results]


class Call:
    """A JAX function of scalars as an operation of a graph; `why_not` is why it cannot be exported."""

    def __init__(self, function: Callable[..., Any], why_not: str) -> None:
        self.function, self.why_not = function, why_not
        self._vectorised = jax.jit(jnp.vectorize(function))

    def add_to(self, graph: Graph, elements: Sequence[Any]) -> Symbol:
        """Add a call of this function on symbols and numbers to a graph; return its symbol."""
        return Symbol(graph.add(("call", self, *map(graph.node_of, elements))))

    def compute(self, *values: Any) -> np.ndarray:
        """Evaluate the function elementwise on arrays."""
        return np.asarray(self._vectorised(*values))

    def pullback(self, i: int, d: Any, *values: Symbols) -> Any:
        """Return the vector-Jacobian product of an adjoint d for argument i."""
        derivative = Call(jax.grad(self.function, i), self.why_not)
        return d * values[0].graph.symbols(derivative.add_to(values[0].graph, values))


def _replace_by_calls(equation: Any, arguments: list[Any], why_not: str) -> list[Symbols]:
    """Replace an operation by calls of JAX, one per element of its results; return these as symbols."""
    symbol_arguments = [a for a in arguments if isinstance(a, Symbols)]
    graph, splits = symbol_arguments[0].graph, np.cumsum([a.size for a in symbol_arguments])[:-1]
    elements = [element for a in symbol_arguments for element in np.asarray(a).flat]

    def evaluate_element(result: int, element: int, *scalars: Any) -> Any:
        values = iter(jnp.split(jnp.stack(scalars), splits))
        arrays = [
            next(values).reshape(v.aval.shape).astype(v.aval.dtype) if isinstance(a, Symbols) else a
            for a, v in zip(arguments, equation.invars, strict=True)
        ]
        return jnp.ravel(_evaluate_primitive(equation, arrays)[result])[element].astype(float)

    outputs = list[Symbols]()
    for result, variable in enumerate(equation.outvars):
        calls = np.empty(variable.aval.shape, dtype=object)
        for i in range(calls.size):
            call = Call(partial(evaluate_element, result, i), why_not)
            calls.flat[i] = call.add_to(graph, elements)
        outputs.append(graph.symbols(calls))
    return outputs
