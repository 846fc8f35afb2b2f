"""An equation as a graph of scalar operations: traced from JAX, simplified, evaluated by NumPy, written as code.

One table says of each operation how NumPy computes it and how C and Python write it, so that every export means the
same. Nodes that are equal are one node.

A JAX function of scalars comes to a graph through its jaxpr, which is run with arrays of graph nodes in place of
numbers. Arithmetic makes nodes; what only moves elements about (reshape, broadcast, slice, gather, concatenate) is run
by JAX itself on the *places* of the elements, so that none of it is left in the graph; constants are computed. So an
effect of the user's own is exported like any other, as long as it is made of operations that firmware has.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np

from bayescal._core.errors import InputError, ModelError
from bayescal._core.lazy_jax import jax, jnp
from bayescal._core.quoting import c_comment, python_words


@dataclass(frozen=True)
class Operation:
    """How NumPy computes an operation, and how C and Python write it, of arguments {0}, {1}, …"""

    compute: Callable[..., Any]
    c: str
    python: str
    boolean: bool = False


def _infix(compute: Callable[..., Any], sign: str, boolean: bool = False) -> Operation:
    written = f"{{0}} {sign} {{1}}"
    return Operation(compute, written, written, boolean)


def _function(name: str) -> Operation:
    """Called the same in NumPy, C and Python."""
    return Operation(getattr(np, name), f"BAYESCAL_CALL({name}, {{0}})", f"math.{name}({{0}})")


FUNCTIONS = "exp log expm1 log1p sqrt sin cos tan asin acos atan sinh cosh tanh floor ceil"


OPERATIONS: dict[str, Operation] = {
    "add": _infix(np.add, "+"),
    "sub": _infix(np.subtract, "-"),
    "mul": _infix(np.multiply, "*"),
    "div": _infix(np.divide, "/"),
    "neg": Operation(np.negative, "-{0}", "-{0}"),
    "abs": Operation(np.abs, "BAYESCAL_CALL(fabs, {0})", "abs({0})"),
    "sign": Operation(
        np.sign, "(BAYESCAL_REAL)(({0} > 0) - ({0} < 0))", "float({0} > 0) - float({0} < 0)"
    ),
    "max": Operation(np.maximum, "{0} > {1} ? {0} : {1}", "max({0}, {1})"),
    "min": Operation(np.minimum, "{0} < {1} ? {0} : {1}", "min({0}, {1})"),
    "pow": Operation(np.power, "BAYESCAL_CALL2(pow, {0}, {1})", "{0} ** {1}"),
    "atan2": Operation(np.arctan2, "BAYESCAL_CALL2(atan2, {0}, {1})", "math.atan2({0}, {1})"),
    "rem": Operation(np.fmod, "BAYESCAL_CALL2(fmod, {0}, {1})", "math.fmod({0}, {1})"),
    **{name: _function(name) for name in FUNCTIONS.split()},
    "gt": _infix(np.greater, ">", True),
    "ge": _infix(np.greater_equal, ">=", True),
    "lt": _infix(np.less, "<", True),
    "le": _infix(np.less_equal, "<=", True),
    "eq": _infix(np.equal, "==", True),
    "ne": _infix(np.not_equal, "!=", True),
    "and": Operation(np.logical_and, "{0} && {1}", "{0} and {1}", True),
    "or": Operation(np.logical_or, "{0} || {1}", "{0} or {1}", True),
    "not": Operation(np.logical_not, "!{0}", "not {0}", True),
    "select": Operation(np.where, "{0} ? {1} : {2}", "{1} if {0} else {2}"),
    "real": Operation(
        lambda x: np.where(x, 1.0, 0.0), "{0} ? (BAYESCAL_REAL)1 : (BAYESCAL_REAL)0", "float({0})"
    ),
}


# ("const", value), ("input", name), or an operation and the places of what it is of, each before its own.
Node = tuple[Any, ...]


@dataclass
class Graph:
    """Nodes, each after those that it is made of."""

    nodes: list[Node] = field(default_factory=list)
    places: dict[str, int] = field(default_factory=dict)

    def put(self, node: Node) -> int:
        key = repr(node)
        if key not in self.places:
            self.places[key] = len(self.nodes)
            self.nodes.append(node)
        return self.places[key]

    def constant(self, value: float | bool) -> int:
        return self.put(
            ("const", bool(value) if isinstance(value, bool | np.bool_) else float(value))
        )

    def input(self, name: str) -> int:
        return self.put(("input", name))

    def boolean(self, place: int) -> bool:
        op, *args = self.nodes[place]
        if op == "const":
            return isinstance(args[0], bool)
        if op == "select":
            return self.boolean(args[1])
        return op != "input" and OPERATIONS[op].boolean

    def value(self, place: int) -> float | bool | None:
        """Of a constant; None of anything else."""
        op, *args = self.nodes[place]
        return args[0] if op == "const" else None

    def apply(self, op: str, *args: int) -> int:
        """An operation, or what it comes to: constants are computed, x + 0, 1·x, 0·x are not written."""
        values = [self.value(a) for a in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                found = OPERATIONS[op].compute(*values)
            return self.constant(bool(found) if OPERATIONS[op].boolean else found.item())
        simpler = self._simpler(op, args, values)
        return simpler if simpler is not None else self.put((op, *args))

    def _simpler(self, op: str, args: tuple[int, ...], values: list[Any]) -> int | None:
        if op == "select":
            if values[0] is not None:
                return args[1] if values[0] else args[2]
            return args[1] if args[1] == args[2] else None
        first, second = args[0], args[-1]
        zero = [v is not None and v == 0 for v in values]
        negated = self.nodes[second][1] if self.nodes[second][0] == "neg" else None
        if op == "neg":
            return negated
        if op in ("add", "sub") and zero[-1]:
            return first
        if op in ("add", "sub") and zero[0]:
            return second if op == "add" else self.apply("neg", second)
        if op == "add" and negated is not None:
            return self.apply("sub", first, negated)
        if op in ("mul", "and") and any(zero):
            return self.constant(0.0 if op == "mul" else False)
        if op == "div" and zero[0]:
            return first
        for sign in (1, -1):  # as a factor, or what is divided by
            if (op in ("mul", "div") and values[1] == sign) or (op == "mul" and values[0] == sign):
                other = second if op == "mul" and values[0] == sign else first
                return other if sign == 1 else self.apply("neg", other)
        return None

    def needed(self, outputs: Sequence[int]) -> list[int]:
        """Nodes that these are made of, themselves included, in order."""
        found, waiting = set(), list(outputs)
        while waiting:
            place = waiting.pop()
            if place not in found:
                found.add(place)
                waiting += [arg for arg in self.nodes[place][1:] if type(arg) is int]
        return sorted(found)

    def inputs(self, outputs: Sequence[int]) -> set[str]:
        """Names of the inputs that these are made of."""
        nodes = (self.nodes[place] for place in self.needed(outputs))
        return {name for op, name, *_ in nodes if op == "input"}

    def evaluate(
        self, outputs: Sequence[int], inputs: Mapping[str, Any], kind: Any = np.float64
    ) -> list[Any]:
        """The outputs for arrays of inputs, in double or (kind=np.float32) single precision.

        Raises:
            InputError: an input is missing.
        """
        values: dict[int, Any] = {}
        with np.errstate(all="ignore"):
            for place in self.needed(outputs):
                op, *args = self.nodes[place]
                if op == "const":
                    values[place] = args[0] if isinstance(args[0], bool) else kind(args[0])
                elif op == "input":
                    if args[0] not in inputs:
                        raise InputError(f"the input {args[0]!r} is missing")
                    values[place] = inputs[args[0]]
                else:
                    found = OPERATIONS[op].compute(*(values[a] for a in args))
                    own = OPERATIONS[op].boolean or found.dtype in (kind, bool)
                    values[place] = found if own else found.astype(kind)
        return [values[o] for o in outputs]

    def part(self, outputs: Sequence[int]) -> tuple[Graph, list[int]]:
        """A graph of what these outputs need and no more."""
        small, moved = Graph(), dict[int, int]()
        for place in self.needed(outputs):
            op, *args = self.nodes[place]
            own = [moved[a] for a in args] if op in OPERATIONS else args
            moved[place] = small.put((op, *own))
        return small, [moved[o] for o in outputs]

    def data(self) -> list[list[Any]]:
        """As JSON, a list for each node; numbers that are not finite as text."""

        def plain(value: Any) -> Any:
            return str(value) if isinstance(value, float) and not math.isfinite(value) else value

        return [[*map(plain, node)] for node in self.nodes]

    @classmethod
    def from_data(cls, data: Sequence[Sequence[Any]]) -> Graph:
        """A graph from JSON; data only, nothing of it is run but the operations of the table above.

        Raises:
            InputError: it is none.
        """
        graph = cls()
        for place, row in enumerate(data):
            op, rest = (row or [None])[0], tuple(row[1:])
            value = rest[0] if len(rest) == 1 else None
            if op == "const" and (
                isinstance(value, int | float) or value in ("nan", "inf", "-inf")
            ):
                rest = (value if isinstance(value, bool) else float(value),)
            elif op in OPERATIONS:
                arity = len(set(re.findall(r"{\d}", OPERATIONS[op].c)))
                if len(rest) != arity or not all(type(a) is int and 0 <= a < place for a in rest):
                    raise InputError(f"its operation {place}, {op!r}, cannot take {str(rest)[:60]}")
            elif op != "input" or not isinstance(value, str):
                raise InputError(f"its operation {place} is not known here: {str(row)[:60]}")
            graph.nodes.append((op, *rest))
        return graph


# primitive → operation
SAME = {name: name for name in OPERATIONS.keys() - {"select", "real"}} | {"add_any": "add"}
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
    return _elementwise(graph.constant, array.astype(object))


def _elementwise(function: Callable[..., int], *arguments: Any) -> np.ndarray:
    """A function of nodes on arrays of them, of one shape once they are broadcast."""
    found = np.frompyfunc(function, len(arguments), 1)(*arguments)
    return np.array(found, dtype=object) if np.ndim(found) == 0 else found


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
        return [_elementwise(partial(graph.apply, SAME[name]), *arguments)]
    made = _others(graph, name, parameters, arguments)
    if made is None:
        raise NotExportable(f"the operation {name!r} has no form in C or plain Python here")
    return [made]


def _numbers(graph: Graph, array: np.ndarray, aval: Any) -> np.ndarray | None:
    """The numbers of an array of constants; None if one element is none."""
    flat = [graph.value(p) for p in array.reshape(-1)]
    return None if None in flat else np.array(flat).reshape(array.shape).astype(aval.dtype)


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
        _elementwise(pool.__getitem__, np.asarray(index).astype(object))
        for index in (found if equation.primitive.multiple_results else [found])
    ]


def _others(graph: Graph, name: str, parameters: Any, arguments: list[np.ndarray]):
    """Operations made of several of ours; None if there is no such thing."""
    apply, first = graph.apply, arguments[0]
    one = graph.constant(1.0)
    each: dict[str, Callable[..., int]] = {
        "square": lambda x: apply("mul", x, x),
        "one_minus_square": lambda x: apply("sub", one, apply("mul", x, x)),  # JAX 0.12
        "integer_pow": lambda x: _power(graph, x, parameters["y"]),
        "rsqrt": lambda x: apply("div", one, apply("sqrt", x)),
        "logistic": lambda x: apply("div", one, apply("add", one, apply("exp", apply("neg", x)))),
        "exp2": lambda x: apply("pow", graph.constant(2.0), x),
        "stop_gradient": lambda x: x,
        "reduce_precision": lambda x: x,
        "clamp": lambda a, x, b: apply("min", apply("max", x, a), b),
    }
    if name == "select_n" and len(arguments) == 3:
        return _elementwise(lambda p, no, yes: apply("select", p, yes, no), *arguments)
    if name in each:
        return _elementwise(each[name], *arguments)
    if name == "convert_element_type":
        return _converted(graph, first, np.dtype(parameters["new_dtype"]))
    if name in REDUCTIONS:
        return _reduced(graph, REDUCTIONS[name], first, parameters["axes"])
    if name == "dot_general":
        return _dot(graph, arguments, parameters["dimension_numbers"])
    return None


REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul"}


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
        return _elementwise(lambda x: graph.apply("real", x) if graph.boolean(x) else x, array)
    if kind.kind == "b":
        zero = graph.constant(0.0)
        return _elementwise(lambda x: x if graph.boolean(x) else graph.apply("ne", x, zero), array)
    raise NotExportable("a covariate turned into a whole number has no form in an export")


def _reduced(graph: Graph, op: str, array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    kept = [i for i in range(array.ndim) if i not in axes]
    rows = np.transpose(array, [*kept, *axes]).reshape(*(array.shape[i] for i in kept), -1)
    found = np.frompyfunc(partial(graph.apply, op), 2, 1).reduce(rows, axis=-1)
    return np.array(found, dtype=object)


def _dot(graph: Graph, arguments: list[np.ndarray], numbers: Any) -> np.ndarray:
    """A product of matrices or vectors, without batch dimensions."""
    (left, right), (batch, _) = numbers
    if batch:
        raise NotExportable("products with batch dimensions have no form in an export")
    a, b = (
        np.moveaxis(one, axes, range(-len(axes), 0))
        for one, axes in zip(arguments, (left, right), strict=True)
    )
    a = a.reshape(
        *a.shape[: a.ndim - len(left)],
        *(1,) * (b.ndim - len(right)),
        *a.shape[a.ndim - len(left) :],
    )
    products = _elementwise(partial(graph.apply, "mul"), a, b)
    return _reduced(graph, "add", products, range(products.ndim - len(left), products.ndim))


@dataclass(frozen=True)
class Language:
    """A language that exports are written in."""

    name: Literal["c", "python"]  # its form in the table of operations
    cast: str  # before a constant
    nan: str  # nan, infinity: constants of these
    infinity: str
    truths: tuple[str, str]  # what is false, and what is true
    statement: str  # of a name and an expression; the same of one that is true or false
    statement_boolean: str
    input: str = "{}"  # an input as it is written, of its field
    template: str = ""  # file beside this one that writes the program
    words: Callable[[Any], str] = str  # text within a comment

    def number(self, value: float | bool) -> str:
        """A constant, as an operand."""
        if isinstance(value, bool):
            return self.truths[value]
        if math.isnan(value):
            return self.cast + self.nan
        text = repr(abs(value)) if math.isfinite(value) else self.infinity
        return self.cast + (text if math.copysign(1.0, value) > 0 else f"(-{text})")


PYTHON = Language(
    *("python", "", "math.nan", "math.inf", ("False", "True"), "{} = {}", "{} = {}"),
    template="compensator.py.jinja",
    words=python_words,
)
C = Language(
    *("c", "(BAYESCAL_REAL)", "NAN", "INFINITY", ("0", "1")),
    *("const BAYESCAL_REAL {} = {};", "const int {} = {};"),
    input="in->{}",
    template="compensator.h.jinja",
    words=c_comment,
)
LANGUAGES = {"c": C, "python": PYTHON}


def statements(
    graph: Graph, outputs: Sequence[int], names: Mapping[str, str], language: Language
) -> tuple[list[str], list[str]]:
    """Statements, one for each operation, and the expressions of the outputs."""
    text, written = dict[int, str](), list[str]()
    for place in graph.needed(outputs):
        op, *args = graph.nodes[place]
        if op == "const":
            text[place] = language.number(args[0])
        elif op == "input":
            text[place] = names[args[0]]
        else:
            made = getattr(OPERATIONS[op], language.name).format(*(text[a] for a in args))
            form = language.statement_boolean if graph.boolean(place) else language.statement
            text[place] = f"t{len(written)}"
            written.append(form.format(text[place], made))
    return written, [text[o] for o in outputs]
