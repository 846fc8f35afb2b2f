"""Expression graphs of scalar operations: tracing, simplification, differentiation, evaluation, code generation.

One table defines each operation's NumPy function, its text in C and Python, and its vector-Jacobian products, so that
evaluated and exported programs are the same. Equal nodes are stored once; logical operations give 0 or 1.

An equation is traced by calling it with `Symbols`, arrays of nodes instead of numbers: NumPy functions of them create
nodes, and functions that only move elements (reshape, stack, take) move them. A user's effect is exported like any
other, if its operations are in the table. Functions written for JAX alone are traced by JAX (`jax_equations.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np

from bayescal._core.errors import ModelError
from bayescal._core.quoting import quote_c_comment, quote_python_comment


class NotExportable(ModelError):
    """An operation of the model cannot be exported to C or Python."""


@dataclass(frozen=True)
class Operation:
    """An operation's NumPy function, and its text in C and Python, with arguments {0}, {1}, …"""

    compute: Callable[..., Any]
    c: str
    python: str


def _build_infix(compute: np.ufunc, sign: str) -> Operation:
    text = f"{{0}} {sign} {{1}}"
    return Operation(compute, text, text)


def _build_logical(compute: np.ufunc, c: str, python: str = "") -> Operation:
    """Build an operation with a Boolean result; `python` is its text in Python where it differs from that in C."""
    return Operation(compute, f"(BAYESCAL_REAL)({c})", f"float({python or c})")


def _build_function(compute: np.ufunc, name: str) -> Operation:
    """Build an operation that has the same function name in C and Python."""
    return Operation(compute, f"BAYESCAL_CALL({name}, {{0}})", f"math.{name}({{0}})")


_COMMON_NAMES = "exp log expm1 log1p sqrt sin cos tan sinh cosh tanh floor ceil"
OPERATIONS: dict[str, Operation] = {
    "add": _build_infix(np.add, "+"),
    "sub": _build_infix(np.subtract, "-"),
    "mul": _build_infix(np.multiply, "*"),
    "div": _build_infix(np.divide, "/"),
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
    **{name: _build_function(getattr(np, name), name) for name in _COMMON_NAMES.split()},
    **{f"a{n}": _build_function(getattr(np, f"arc{n}"), f"a{n}") for n in ("sin", "cos", "tan")},
    "gt": _build_logical(np.greater, "{0} > {1}"),
    "ge": _build_logical(np.greater_equal, "{0} >= {1}"),
    "lt": _build_logical(np.less, "{0} < {1}"),
    "le": _build_logical(np.less_equal, "{0} <= {1}"),
    "eq": _build_logical(np.equal, "{0} == {1}"),
    "ne": _build_logical(np.not_equal, "{0} != {1}"),
    "and": _build_logical(np.logical_and, "{0} && {1}", "{0} != 0 and {1} != 0"),
    "or": _build_logical(np.logical_or, "{0} || {1}", "{0} != 0 or {1} != 0"),
    "not": _build_logical(np.logical_not, "!{0}", "not {0}"),
    "select": Operation(np.where, "{0} ? {1} : {2}", "{1} if {0} else {2}"),
}
# Pullbacks of an adjoint d by operation and argument; zero for operations that are not listed.
PULLBACKS: dict[str, tuple[Callable[..., Any], ...]] = {
    "add": (lambda d, x, y: d, lambda d, x, y: d),
    "sub": (lambda d, x, y: d, lambda d, x, y: -d),
    "mul": (lambda d, x, y: d * y, lambda d, x, y: d * x),
    "div": (lambda d, x, y: d / y, lambda d, x, y: -(d * x / (y * y))),
    "neg": (lambda d, x: -d,),
    "abs": (lambda d, x: d * np.sign(x),),
    "max": (lambda d, x, y: np.where(x > y, d, 0.0), lambda d, x, y: np.where(x > y, 0.0, d)),
    "min": (lambda d, x, y: np.where(x < y, d, 0.0), lambda d, x, y: np.where(x < y, 0.0, d)),
    "pow": (lambda d, x, y: d * y * x ** (y - 1), lambda d, x, y: d * np.log(x) * x**y),
    "atan2": (lambda d, y, x: d * x / (x * x + y * y), lambda d, y, x: -(d * y / (x * x + y * y))),
    "rem": (lambda d, x, y: d, lambda d, x, y: d * (np.fmod(x, y) - x) / y),
    **dict.fromkeys(("exp", "expm1"), (lambda d, x: d * np.exp(x),)),
    "log": (lambda d, x: d / x,),
    "log1p": (lambda d, x: d / (1 + x),),
    "sqrt": (lambda d, x: 0.5 * d / np.sqrt(x),),
    "sin": (lambda d, x: d * np.cos(x),),
    "cos": (lambda d, x: -(d * np.sin(x)),),
    "tan": (lambda d, x: d * (1 + np.tan(x) * np.tan(x)),),
    "asin": (lambda d, x: d / np.sqrt(1 - x * x),),
    "acos": (lambda d, x: -(d / np.sqrt(1 - x * x)),),
    "atan": (lambda d, x: d / (1 + x * x),),
    "sinh": (lambda d, x: d * np.cosh(x),),
    "cosh": (lambda d, x: d * np.sinh(x),),
    "tanh": (lambda d, x: d * (1 - np.tanh(x) * np.tanh(x)),),
    "select": (
        *(lambda d, p, x, y: 0.0, lambda d, p, x, y: np.where(p, d, 0.0)),
        lambda d, p, x, y: np.where(p, 0.0, d),
    ),
}


# ("const", value), ("input", name), ("call", function, *nodes), or (operation, *nodes) with preceding nodes.
Node = tuple[Any, ...]


@dataclass
class Graph:
    """An expression graph: a list of nodes, each after its arguments, and the index of each node by its `repr`."""

    nodes: list[Node] = field(default_factory=list)
    index: dict[str, int] = field(default_factory=dict)

    def add(self, node: Node) -> int:
        text = repr(node)
        if text not in self.index:
            self.index[text] = len(self.nodes)
            self.nodes.append(node)
        return self.index[text]

    def constant(self, value: float) -> int:
        return self.add(("const", float(value)))

    def input(self, name: str) -> int:
        return self.add(("input", name))

    def constant_value(self, node: int) -> float | None:
        """Return a constant's value; None for any other node."""
        op, *args = self.nodes[node]
        return args[0] if op == "const" else None

    def apply(self, op: str, *args: int) -> int:
        """Add an operation, simplified (constants are folded; x + 0, 1·x, 0·x are reduced); return its node."""
        values = [self.constant_value(a) for a in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                return self.constant(OPERATIONS[op].compute(*values))
        simplified_node = self._simplify(op, args, values)
        return simplified_node if simplified_node is not None else self.add((op, *args))

    def _simplify(self, op: str, args: tuple[int, ...], values: list[Any]) -> int | None:
        if op == "select":
            if values[0] is not None:
                return args[1] if values[0] else args[2]
            return args[1] if args[1] == args[2] else None
        first_node, second_node = args[0], args[-1]
        is_zero = [v is not None and v == 0 for v in values]
        negated_node = self.nodes[second_node][1] if self.nodes[second_node][0] == "neg" else None
        if op == "neg":
            return negated_node
        if op in ("add", "sub") and is_zero[-1]:
            return first_node
        if op in ("add", "sub") and is_zero[0]:
            return second_node if op == "add" else self.apply("neg", second_node)
        if op == "add" and negated_node is not None:
            return self.apply("sub", first_node, negated_node)
        if op in ("mul", "and") and any(is_zero):
            return self.constant(0.0)
        if op == "div" and is_zero[0]:
            return first_node
        for sign in (1, -1):  # as a factor or divisor
            if (op in ("mul", "div") and values[1] == sign) or (op == "mul" and values[0] == sign):
                operand = second_node if op == "mul" and values[0] == sign else first_node
                return operand if sign == 1 else self.apply("neg", operand)
        return None

    def dependencies(self, outputs: Sequence[int]) -> list[int]:
        """Return the indices of the outputs and of all nodes that they depend on, in order of evaluation."""
        nodes, stack = set(), list(outputs)
        while stack:
            node = stack.pop()
            if node not in nodes:
                nodes.add(node)
                stack += [arg for arg in self.nodes[node][1:] if type(arg) is int]
        return sorted(nodes)

    def inputs(self, outputs: Sequence[int]) -> set[str]:
        """Return the names of the inputs that the outputs depend on."""
        nodes = (self.nodes[node] for node in self.dependencies(outputs))
        return {name for op, name, *_ in nodes if op == "input"}

    def evaluate(self, outputs: Sequence[int], inputs: Mapping[str, Any]) -> list[Any]:
        """Return the values of nodes for arrays of inputs, by name."""
        values, nodes = dict[int, Any](), self.dependencies(outputs)
        last_use = {a: node for node in nodes for a in self.nodes[node][1:] if type(a) is int}
        last_use |= dict.fromkeys(outputs, len(self.nodes))
        with np.errstate(all="ignore"):
            for node in nodes:
                op, *args = self.nodes[node]
                if op == "const":
                    values[node] = args[0]
                elif op == "input":
                    values[node] = inputs[args[0]]
                else:
                    operation = args.pop(0) if op == "call" else OPERATIONS[op]
                    value = operation.compute(*(values[a] for a in args))
                    values[node] = value.astype(float) if value.dtype == bool else value
                    for a in (a for a in args if last_use[a] == node):  # frees its memory
                        values.pop(a, None)
        return [values[o] for o in outputs]

    def gradient(self, output: int, names: Collection[str]) -> dict[str, int]:
        """Add a node's derivatives in the inputs `names`, by reverse-mode differentiation; return their nodes."""
        nodes, dependent = self.dependencies([output]), set[int]()  # nodes that depend on `names`
        for node in nodes:
            op, *args = self.nodes[node]
            is_dependent = args[0] in names if op == "input" else not dependent.isdisjoint(args)
            if op != "const" and is_dependent:
                dependent.add(node)
        adjoints, gradients = dict[int, Any]({output: 1.0}), dict[str, int]()
        for node in (p for p in reversed(nodes) if p in dependent and p in adjoints):
            op, *args = self.nodes[node]
            adjoint = adjoints.pop(node)
            if op == "input":
                gradients[args[0]] = self.node_of(adjoint)
                continue
            call = args.pop(0) if op == "call" else None
            pullbacks = PULLBACKS.get(op, ())
            if call is not None:
                pullbacks = [partial(call.pullback, i) for i in range(len(args))]
            values = [self.symbols(self._element(a)) for a in args]
            for a, pullback in zip(args, pullbacks, strict=False):
                if a in dependent:
                    contribution = pullback(adjoint, *values)
                    adjoints[a] = adjoints[a] + contribution if a in adjoints else contribution
        return gradients

    def subgraph(
        self, outputs: Sequence[int], constants: Mapping[str, float]
    ) -> tuple[Graph, list[int]]:
        """Return a copy of the graph of some outputs, with constants for some inputs, and its output nodes."""
        subgraph, copies = Graph(), dict[int, int]()
        for node in self.dependencies(outputs):
            op, *args = self.nodes[node]
            if op in OPERATIONS:
                copies[node] = subgraph.apply(op, *(copies[a] for a in args))
            elif op == "input" and args[0] in constants:
                copies[node] = subgraph.constant(constants[args[0]])
            else:
                args = [copies[a] if type(a) is int else a for a in args]
                copies[node] = subgraph.add((op, *args))
        return subgraph, [copies[o] for o in outputs]

    def symbols(self, elements: Any) -> Symbols:
        """Return symbols and numbers as an array of type `Symbols` of this graph."""
        array = np.asarray(elements, dtype=object).view(Symbols)
        array.graph = self
        return array

    def elementwise(self, op: str, *arrays: Any) -> Symbols:
        """Apply an operation elementwise to broadcast arrays of symbols and numbers."""
        function = np.frompyfunc(partial(self.apply_scalar, op), len(arrays), 1)
        return self.symbols(function(*(np.asarray(a, dtype=object) for a in arrays)))

    def node_of(self, element: Any) -> int:
        """Return the node of a symbol, or that of a constant added for a number."""
        element = element.item() if isinstance(element, np.ndarray) else element
        return element.node if isinstance(element, Symbol) else self.constant(element)

    def _element(self, node: int) -> Symbol | float:
        value = self.constant_value(node)
        return Symbol(node) if value is None else value

    def apply_scalar(self, op: str, *elements: Any) -> Symbol | float:
        """Apply an operation to symbols and numbers."""
        return self._element(self.apply(op, *map(self.node_of, elements)))

    def to_json_data(self) -> list[list[Any]]:
        """Return the nodes as lists for JSON, with non-finite numbers as text."""

        def to_json(value: Any) -> Any:
            return str(value) if isinstance(value, float) and not math.isfinite(value) else value

        return [[*map(to_json, node)] for node in self.nodes]


class Symbol:
    """A node index as an element of an array: it has no value, and branching on it raises NotExportable."""

    __slots__ = ("node",)
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, node: int) -> None:
        self.node = node

    def __bool__(self) -> bool:
        raise NotExportable("a branch on a covariate cannot be exported: use jnp.where")

    def __eq__(self, other: object) -> bool:
        return bool(self)


class Symbols(np.ndarray):
    """An array of symbols and numbers; NumPy functions of it add nodes to its graph, or move elements."""

    graph: Graph

    def __array_finalize__(self, other: Any) -> None:
        if isinstance(other, Symbols):
            self.graph = other.graph

    def __getitem__(self, index: Any) -> Any:
        return self.graph.symbols(super().__getitem__(index))

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def astype(self, dtype: Any, *args: Any, **options: Any) -> Any:
        """Convert Boolean symbols to numbers, or numbers to Boolean symbols."""
        if np.dtype(dtype).kind not in "fb":
            raise NotExportable("a covariate converted to an integer cannot be exported")
        return self != 0 if np.dtype(dtype).kind == "b" else self + 0.0

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        name, graph = ufunc.__name__, self.graph
        if method == "__call__" and name in COMPOSED_FUNCTIONS:
            return COMPOSED_FUNCTIONS[name](*map(graph.symbols, inputs))
        if name not in UFUNC_NAMES or method not in ("__call__", "reduce"):
            raise NotExportable(f"the operation {name!r} cannot be exported to C or Python")
        if method == "__call__":
            return graph.elementwise(UFUNC_NAMES[name], *inputs)
        elements, axes = np.asarray(inputs[0]), options.get("axis", 0)
        operator = np.frompyfunc(partial(graph.apply_scalar, UFUNC_NAMES[name]), 2, 1)
        axes = range(elements.ndim) if axes is None else np.atleast_1d(axes) % elements.ndim
        for axis in sorted(axes, reverse=True):
            elements = np.asarray(operator.reduce(elements, axis=axis), dtype=object)
        if options.get("keepdims") is True:
            elements = np.expand_dims(elements, tuple(axes))
        return graph.symbols(elements)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.where and len(args) == 3:
            return self.graph.elementwise("select", *args)
        if func is np.dot:
            return np.matmul(*args)

        def to_symbols(outputs: Any) -> Any:
            if isinstance(outputs, list | tuple):
                return [*map(to_symbols, outputs)]
            is_object = isinstance(outputs, np.ndarray) and outputs.dtype == object
            return self.graph.symbols(outputs) if is_object else outputs

        return to_symbols(super().__array_function__(func, types, args, kwargs))


UFUNC_NAMES = {o.compute.__name__: n for n, o in OPERATIONS.items() if n != "select"}
UFUNC_NAMES |= {"bitwise_and": "and", "bitwise_or": "or", "invert": "not"}


def _raise_to_power(x: Symbols, y: Symbols) -> Symbols:
    """Return x to the power y: by repeated multiplication if y is a small integer, else by the operation "pow"."""
    exponent = y.item() if y.ndim == 0 else None
    if isinstance(exponent, Symbol | None) or exponent % 1 or abs(exponent) > 64:
        return x.graph.elementwise("pow", x, y)
    if exponent < 0:
        return 1.0 / x**-exponent
    root = x ** (exponent // 2) if exponent > 1 else x.graph.symbols(np.ones(x.shape))
    return root * root * x if exponent % 2 else root * root


def _multiply_matrices(x: Symbols, y: Symbols) -> Symbols:
    """Return the product of an array and a matrix or a vector."""
    if y.ndim > 2:
        raise NotExportable("matrix products with batch dimensions cannot be exported")
    return np.sum(x * y, axis=-1) if y.ndim == 1 else np.sum(x[..., None] * y, axis=-2)


# NumPy functions composed of several operations.
COMPOSED_FUNCTIONS: dict[str, Callable[..., Symbols]] = {
    "power": _raise_to_power,
    "matmul": _multiply_matrices,
    "square": lambda x: x * x,
    "clip": lambda x, low, high: np.minimum(np.maximum(x, low), high),
}


@dataclass(frozen=True)
class Language:
    """Syntax of a programming language to which equations are exported."""

    name: Literal["c", "python"]  # a field of `Operation`
    cast: str  # prefix of a constant
    nan: str  # constant NaN
    infinity: str  # constant infinity
    statement: str  # assignment of an expression to a name
    input: str = "{}"  # format of the field that contains an input
    template: str = ""  # template file of the program
    escape_comment: Callable[[Any], str] = str  # escapes text for a comment

    def number(self, value: float) -> str:
        """Return the text of a constant as an operand."""
        if math.isnan(value):
            return self.cast + self.nan
        text = repr(abs(value)) if math.isfinite(value) else self.infinity
        return self.cast + (text if math.copysign(1.0, value) > 0 else f"(-{text})")


PYTHON = Language(
    *("python", "", "math.nan", "math.inf", "{} = {}"),
    template="compensator.py.jinja",
    escape_comment=quote_python_comment,
)
C = Language(
    *("c", "(BAYESCAL_REAL)", "NAN", "INFINITY", "const BAYESCAL_REAL {} = {};"),
    input="in->{}",
    template="compensator.h.jinja",
    escape_comment=quote_c_comment,
)
LANGUAGES = {"c": C, "python": PYTHON}


def generate_statements(
    graph: Graph, outputs: Sequence[int], names: Mapping[str, str], language: Language
) -> tuple[list[str], list[str]]:
    """Return statements that compute the outputs, one per operation, and the expression of each output."""
    texts, statements = dict[int, str](), list[str]()
    for node in graph.dependencies(outputs):
        op, *args = graph.nodes[node]
        if op == "const":
            texts[node] = language.number(args[0])
        elif op == "input":
            texts[node] = names[args[0]]
        else:
            expression = getattr(OPERATIONS[op], language.name).format(*(texts[a] for a in args))
            texts[node] = f"t{len(statements)}"
            statements.append(language.statement.format(texts[node], expression))
    return statements, [texts[o] for o in outputs]
