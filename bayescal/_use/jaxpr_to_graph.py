"""From a JAX function of scalars to a graph of scalar operations, through its jaxpr.

The jaxpr is run with arrays of graph nodes in place of numbers. Arithmetic makes nodes; what only moves elements
about (reshape, broadcast, slice, gather, concatenate) is run by JAX itself on the *places* of the elements, so
that none of it is left in the graph; constants are computed. So an effect of the user's own is exported like any
other, as long as it is made of operations that firmware has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.errors import ModelError
from bayescal._use.expression_graph import Graph

_SAME = (
    "add sub mul div neg abs sign max min pow atan2 rem exp log expm1 log1p sqrt sin cos tan asin acos atan sinh "
    "cosh tanh floor ceil gt ge lt le eq ne and or not"
)
SAME = {**{name: name for name in _SAME.split()}, "add_any": "add"}  # primitive → operation
_MOVES = (
    "broadcast_in_dim reshape squeeze expand_dims slice dynamic_slice gather concatenate transpose rev copy stack "
    "unstack split"
)
MOVES = tuple(_MOVES.split())
_CALLS = "pjit jit closed_call custom_jvp_call custom_vjp_call remat checkpoint"
CALLS = tuple(_CALLS.split())


class NotExportable(ModelError):
    """An operation that the export does not have."""


def trace(
    graph: Graph, function: Callable[..., Any], arguments: Sequence[Any], places: Sequence[int]
) -> list[int]:
    """The nodes of a function's scalar results.

    Args:
        graph: that they are put in.
        function: of JAX scalars; returns a pytree of scalars.
        arguments: examples of its arguments (a sequence of pytrees).
        places: nodes of the arguments' leaves, in order.

    Raises:
        NotExportable: the function is made of operations that have no scalar form here.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    inputs = [np.array(p, dtype=object) for p in places]
    results = _run(graph, closed.jaxpr, closed.consts, inputs)
    return [int(r.reshape(-1)[0]) for r in results]


def _nodes(graph: Graph, value: Any) -> np.ndarray:
    """An array of numbers as an array of constant nodes."""
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise NotExportable(f"values of type {array.dtype} have no place in an export")
    flat = [
        graph.constant(v if array.dtype.kind == "b" else float(v))
        for v in array.reshape(-1).tolist()
    ]
    return _object(flat, array.shape)


def _object(flat: Sequence[int], shape: tuple[int, ...]) -> np.ndarray:
    made = np.empty(len(flat), dtype=object)
    made[:] = flat
    return made.reshape(shape)


def _run(
    graph: Graph, jaxpr: Any, constants: Sequence[Any], inputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    values: dict[Any, np.ndarray] = {}

    def read(atom: Any) -> np.ndarray:
        return _nodes(graph, atom.val) if hasattr(atom, "val") else values[atom]

    for variable, constant in zip(jaxpr.constvars, constants, strict=True):
        values[variable] = _nodes(graph, constant)
    for variable, given in zip(jaxpr.invars, inputs, strict=True):
        values[variable] = given
    for equation in jaxpr.eqns:
        arguments = [read(a) for a in equation.invars]
        results = _apply(graph, equation, arguments)
        for variable, result in zip(equation.outvars, results, strict=True):
            values[variable] = result
    return [read(v) for v in jaxpr.outvars]


def _apply(graph: Graph, equation: Any, arguments: list[np.ndarray]) -> list[np.ndarray]:
    name, parameters = equation.primitive.name, equation.params
    if name in CALLS:
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr", parameters.get("fun_jaxpr")))
        if hasattr(inner, "jaxpr"):
            return _run(graph, inner.jaxpr, inner.consts, arguments)
        return _run(graph, inner, (), arguments)
    constants = [
        _numbers(graph, a, v.aval) for a, v in zip(arguments, equation.invars, strict=True)
    ]
    if all(c is not None for c in constants):
        found = equation.primitive.bind(*(jnp.asarray(c) for c in constants), **parameters)
        return [
            _nodes(graph, f) for f in (found if equation.primitive.multiple_results else [found])
        ]
    if name in MOVES:
        return _moved(equation, arguments, constants)
    if name in SAME:
        return [_elementwise(lambda *a: graph.apply(SAME[name], *a), arguments)]
    made = _others(graph, name, parameters, arguments, equation)
    if made is None:
        raise NotExportable(f"the operation {name!r} has no form in C or plain Python here")
    return [made]


def _elementwise(function: Callable[..., int], arguments: list[np.ndarray]) -> np.ndarray:
    spread = np.broadcast_arrays(*arguments)
    flat = [function(*row) for row in zip(*(a.reshape(-1) for a in spread), strict=True)]
    return _object(flat, spread[0].shape)


def _numbers(graph: Graph, array: np.ndarray, aval: Any) -> np.ndarray | None:
    """The numbers of an array of constants; None if one element is none."""
    flat = [graph.value(p) for p in array.reshape(-1)]
    if any(v is None for v in flat):
        return None
    return np.array(flat).reshape(array.shape).astype(aval.dtype)


def _moved(
    equation: Any, arguments: list[np.ndarray], constants: list[np.ndarray | None]
) -> list[np.ndarray]:
    """What only moves elements, run on the numbers of their places; indices stay what they are."""
    many = equation.primitive.name in ("concatenate", "stack")
    pool: list[Any] = []
    placed = []
    for i, (argument, constant) in enumerate(zip(arguments, constants, strict=True)):
        if i and not many:
            if constant is None:
                raise NotExportable(
                    "an element whose place depends on a covariate has no form in an export"
                )
            placed.append(jnp.asarray(constant))
            continue
        placed.append(jnp.arange(len(pool), len(pool) + argument.size).reshape(argument.shape))
        pool += argument.reshape(-1).tolist()
    parameters = dict(equation.params)
    if "fill_value" in parameters:
        parameters["fill_value"] = None if parameters["fill_value"] is None else 0
    found = equation.primitive.bind(*placed, **parameters)
    return [
        _object([pool[i] for i in np.asarray(index).reshape(-1)], np.shape(index))
        for index in (found if equation.primitive.multiple_results else [found])
    ]


def _others(graph: Graph, name: str, parameters: Any, arguments: list[np.ndarray], equation: Any):
    """Operations made of several of ours; None if there is no such thing."""
    apply, first = graph.apply, arguments[0]
    one = graph.constant(1.0)
    each: dict[str, Callable[[int], int]] = {
        "square": lambda x: apply("mul", x, x),
        "one_minus_square": lambda x: apply("sub", one, apply("mul", x, x)),  # JAX 0.12
        "integer_pow": lambda x: _power(graph, x, parameters["y"]),
        "rsqrt": lambda x: apply("div", one, apply("sqrt", x)),
        "logistic": lambda x: apply("div", one, apply("add", one, apply("exp", apply("neg", x)))),
        "exp2": lambda x: apply("pow", graph.constant(2.0), x),
        "stop_gradient": lambda x: x,
        "reduce_precision": lambda x: x,
    }
    if name in each:
        return _elementwise(each[name], [first])
    if name == "convert_element_type":
        return _converted(graph, first, np.dtype(parameters["new_dtype"]))
    if name == "select_n":
        predicate, *cases = arguments
        if len(cases) == 2:
            chosen = np.broadcast_to(predicate, cases[0].shape)
            return _elementwise(lambda p, no, yes: apply("select", p, yes, no), [chosen, *cases])
    if name == "clamp":
        low, x, high = arguments
        return _elementwise(lambda a, x, b: apply("min", apply("max", x, a), b), [low, x, high])
    reductions = {
        "reduce_sum": "add",
        "reduce_max": "max",
        "reduce_min": "min",
        "reduce_prod": "mul",
    }
    if name in reductions:
        return _reduced(graph, reductions[name], first, parameters["axes"])
    if name == "dot_general":
        return _dot(graph, arguments, parameters["dimension_numbers"])
    return None


def _power(graph: Graph, x: int, exponent: int) -> int:
    if exponent < 0:
        return graph.apply("div", graph.constant(1.0), _power(graph, x, -exponent))
    made, square = graph.constant(1.0), x
    while exponent:
        if exponent & 1:
            made = graph.apply("mul", made, square)
        exponent >>= 1
        if exponent:
            square = graph.apply("mul", square, square)
    return made


def _converted(graph: Graph, array: np.ndarray, kind: np.dtype) -> np.ndarray:
    if kind.kind == "f":
        return _elementwise(lambda x: graph.apply("real", x) if graph.boolean(x) else x, [array])
    if kind.kind == "b":
        zero = graph.constant(0.0)
        return _elementwise(
            lambda x: x if graph.boolean(x) else graph.apply("ne", x, zero), [array]
        )
    raise NotExportable("a covariate turned into a whole number has no form in an export")


def _reduced(graph: Graph, op: str, array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    kept = [i for i in range(array.ndim) if i not in axes]
    rows = np.transpose(array, [*kept, *axes]).reshape(*(array.shape[i] for i in kept), -1)
    flat = []
    for row in rows.reshape(-1, rows.shape[-1]):
        total = row[0]
        for x in row[1:]:
            total = graph.apply(op, total, x)
        flat.append(total)
    return _object(flat, tuple(array.shape[i] for i in kept))


def _dot(graph: Graph, arguments: list[np.ndarray], numbers: Any) -> np.ndarray:
    """A product of matrices or vectors, without batch dimensions."""
    (left, right), (batch, _) = numbers
    if batch:
        raise NotExportable("products with batch dimensions have no form in an export")
    a, b = arguments
    rest = [i for i in range(a.ndim) if i not in left], [i for i in range(b.ndim) if i not in right]
    shapes = tuple(a.shape[i] for i in rest[0]), tuple(b.shape[i] for i in rest[1])
    rows = np.transpose(a, [*rest[0], *left]).reshape(int(np.prod(shapes[0])), -1)
    columns = np.transpose(b, [*rest[1], *right]).reshape(int(np.prod(shapes[1])), -1)
    flat = []
    for row in rows:
        for column in columns:
            total = graph.constant(0.0)
            for x, y in zip(row, column, strict=True):
                total = graph.apply("add", total, graph.apply("mul", x, y))
            flat.append(total)
    return _object(flat, shapes[0] + shapes[1])
