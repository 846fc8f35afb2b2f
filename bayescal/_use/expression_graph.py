"""Expression graphs of scalar operations: traced, simplified, differentiated, evaluated, written as code.

One table gives each operation's NumPy function, its text in C and Python, and its pullbacks, so that the computed and
the exported program are the same. Equal nodes are shared.

An equation is traced by calling it with `Symbols`, arrays of nodes instead of numbers: NumPy's functions of them create
nodes, and functions that only move elements (reshape, stack, take) move them. So a user's effect is exported like any
other, if firmware has its operations. Functions written for JAX alone are traced by JAX (`jax_equations.py`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np

from bayescal._core.errors import InputError, ModelError
from bayescal._core.quoting import c_comment, python_words


class NotExportable(ModelError):
    """An operation that cannot be exported."""


@dataclass(frozen=True)
class Operation:
    """An operation's NumPy function, and its text in C and Python, with arguments {0}, {1}, …"""

    compute: Callable[..., Any]
    c: str
    python: str
    boolean: bool = False


def _infix(compute: np.ufunc, sign: str, boolean: bool = False) -> Operation:
    written = f"{{0}} {sign} {{1}}"
    return Operation(compute, written, written, boolean)


def _function(compute: np.ufunc, name: str) -> Operation:
    """Build an operation that has the same function name in C and Python."""
    return Operation(compute, f"BAYESCAL_CALL({name}, {{0}})", f"math.{name}({{0}})")


_SAME = "exp log expm1 log1p sqrt sin cos tan sinh cosh tanh floor ceil"
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
    **{name: _function(getattr(np, name), name) for name in _SAME.split()},
    **{f"a{n}": _function(getattr(np, f"arc{n}"), f"a{n}") for n in ("sin", "cos", "tan")},
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
# Pullbacks of a slope d by operation and argument; zero for operations that are not listed.
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
    "exp": (lambda d, x: d * np.exp(x),),
    "log": (lambda d, x: d / x,),
    "expm1": (lambda d, x: d * np.exp(x),),
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


# ("const", value), ("input", name), ("call", function, *places), or an operation and the places of its arguments, which
# precede it.
Node = tuple[Any, ...]


@dataclass
class Graph:
    """A list of nodes, each after its arguments."""

    nodes: list[Node] = field(default_factory=list)
    places: dict[str, int] = field(default_factory=dict)

    def put(self, node: Node) -> int:
        key = repr(node)
        if key not in self.places:
            self.places[key] = len(self.nodes)
            self.nodes.append(node)
        return self.places[key]

    def constant(self, value: float | bool) -> int:
        is_boolean = isinstance(value, bool | np.bool_)
        return self.put(("const", bool(value) if is_boolean else float(value)))

    def input(self, name: str) -> int:
        return self.put(("input", name))

    def boolean(self, place: int) -> bool:
        op, *args = self.nodes[place]
        if op == "const":
            return isinstance(args[0], bool)
        if op == "select":
            return self.boolean(args[1])
        return op in OPERATIONS and OPERATIONS[op].boolean

    def value(self, place: int) -> float | bool | None:
        """Return a constant's value; None for any other node."""
        op, *args = self.nodes[place]
        return args[0] if op == "const" else None

    def apply(self, op: str, *args: int) -> int:
        """Add an operation, simplified: constants are folded; x + 0, 1·x and 0·x are reduced."""
        values = [self.value(a) for a in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                value = OPERATIONS[op].compute(*values)
            return self.constant(bool(value) if OPERATIONS[op].boolean else value.item())
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
        for sign in (1, -1):  # as a factor or divisor
            if (op in ("mul", "div") and values[1] == sign) or (op == "mul" and values[0] == sign):
                other = second if op == "mul" and values[0] == sign else first
                return other if sign == 1 else self.apply("neg", other)
        return None

    def needed(self, outputs: Sequence[int]) -> list[int]:
        """Return the nodes that the outputs depend on, themselves included, in order."""
        places, waiting = set(), list(outputs)
        while waiting:
            place = waiting.pop()
            if place not in places:
                places.add(place)
                waiting += [arg for arg in self.nodes[place][1:] if type(arg) is int]
        return sorted(places)

    def inputs(self, outputs: Sequence[int]) -> set[str]:
        """Return the names of the inputs that the outputs depend on."""
        nodes = (self.nodes[place] for place in self.needed(outputs))
        return {name for op, name, *_ in nodes if op == "input"}

    def evaluate(self, outputs: Sequence[int], inputs: Mapping[str, Any]) -> list[Any]:
        """Return the outputs for arrays of inputs."""
        values, needed = dict[int, Any](), self.needed(outputs)
        last = {a: place for place in needed for a in self.nodes[place][1:] if type(a) is int}
        last |= dict.fromkeys(outputs, len(self.nodes))
        with np.errstate(all="ignore"):
            for place in needed:
                op, *args = self.nodes[place]
                if op == "const":
                    values[place] = args[0]
                elif op == "input":
                    values[place] = inputs[args[0]]
                else:
                    operation = args.pop(0) if op == "call" else OPERATIONS[op]
                    values[place] = operation.compute(*(values[a] for a in args))
                    for a in (a for a in args if last[a] == place):  # no longer needed
                        values.pop(a, None)
        return [values[o] for o in outputs]

    def gradient(self, output: int, names: Collection[str]) -> dict[str, int]:
        """Return the nodes of a node's derivatives by some inputs, by reverse-mode differentiation."""
        needed, dependent = self.needed([output]), set[int]()  # on these inputs
        for place in needed:
            op, *args = self.nodes[place]
            acts = args[0] in names if op == "input" else not dependent.isdisjoint(args)
            if op != "const" and acts:
                dependent.add(place)
        slopes, gradients = dict[int, Any]({output: 1.0}), dict[str, int]()
        for place in (p for p in reversed(needed) if p in dependent and p in slopes):
            op, *args = self.nodes[place]
            slope = slopes.pop(place)
            if op == "input":
                gradients[args[0]] = self.place_of(slope)
                continue
            pullbacks = args.pop(0).pullbacks if op == "call" else PULLBACKS.get(op, ())
            values = [self.symbols(self._element(a)) for a in args]
            for a, pullback in zip(args, pullbacks, strict=False):
                if a in dependent:
                    share = pullback(slope, *values)
                    slopes[a] = slopes[a] + share if a in slopes else share
        return gradients

    def part(
        self, outputs: Sequence[int], constants: Mapping[str, float]
    ) -> tuple[Graph, list[int]]:
        """Extract the subgraph that outputs need, with some inputs replaced by constants."""
        subgraph, places = Graph(), dict[int, int]()
        for place in self.needed(outputs):
            op, *args = self.nodes[place]
            if op in OPERATIONS:
                places[place] = subgraph.apply(op, *(places[a] for a in args))
            elif op == "input" and args[0] in constants:
                places[place] = subgraph.constant(constants[args[0]])
            else:
                args = [places[a] if type(a) is int else a for a in args]
                places[place] = subgraph.put((op, *args))
        return subgraph, [places[o] for o in outputs]

    def symbols(self, elements: Any) -> Symbols:
        """Return symbols and numbers as an array."""
        array = np.asarray(elements, dtype=object).view(Symbols)
        array.graph = self
        return array

    def elementwise(self, op: str, *arrays: Any) -> Symbols:
        """Apply an operation to arrays of symbols and numbers, broadcast."""
        function = np.frompyfunc(partial(self.applied, op), len(arrays), 1)
        return self.symbols(function(*(np.asarray(a, dtype=object) for a in arrays)))

    def place_of(self, element: Any) -> int:
        """Return the node of a symbol or a number."""
        element = element.item() if isinstance(element, np.ndarray) else element
        return element.place if isinstance(element, Symbol) else self.constant(element)

    def _element(self, place: int) -> Symbol | float | bool:
        value = self.value(place)
        return Symbol(place) if value is None else value

    def applied(self, op: str, *elements: Any) -> Symbol | float | bool:
        """Apply an operation to symbols and numbers; booleans become 0 or 1 where a number is needed."""
        places = [self.place_of(element) for element in elements]
        if op not in ("and", "or", "not", "real", "select"):
            places = [self.apply("real", p) if self.boolean(p) else p for p in places]
        return self._element(self.apply(op, *places))

    def data(self) -> list[list[Any]]:
        """Return the nodes as JSON lists; non-finite numbers as text."""

        def plain(value: Any) -> Any:
            return str(value) if isinstance(value, float) and not math.isfinite(value) else value

        return [[*map(plain, node)] for node in self.nodes]

    @classmethod
    def from_data(cls, data: Sequence[Sequence[Any]]) -> Graph:
        """Parse a graph from JSON data; only operations of the table above are accepted.

        Raises:
            InputError: it is no graph.
        """
        graph = cls()
        for place, row in enumerate(data):
            op, args = (row or [None])[0], tuple(row[1:])
            value = args[0] if len(args) == 1 else None
            is_number = isinstance(value, int | float) or value in ("nan", "inf", "-inf")
            if op == "const" and is_number:
                args = (value if isinstance(value, bool) else float(value),)
            elif op in OPERATIONS:
                arity = len(set(re.findall(r"{\d}", OPERATIONS[op].c)))
                if len(args) != arity or not all(type(a) is int and 0 <= a < place for a in args):
                    raise InputError(f"its operation {place}, {op!r}, cannot take {str(args)[:60]}")
            elif op == "call" and hasattr(args[0], "compute"):
                pass  # a function computed by JAX; never in a file
            elif op != "input" or not isinstance(value, str):
                raise InputError(f"its operation {place} is not known here: {str(row)[:60]}")
            graph.nodes.append((op, *args))
        return graph


class Symbol:
    """A node as an element of an array, without a value: branching on it raises NotExportable."""

    __slots__ = ("place",)
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, place: int) -> None:
        self.place = place

    def __bool__(self) -> bool:
        raise NotExportable("a branch that depends on a covariate has no form in an export")

    def __eq__(self, other: object) -> bool:
        return bool(self)


class Symbols(np.ndarray):
    """An array of symbols and numbers: NumPy's functions of it add nodes to its graph, or move elements."""

    graph: Graph

    def __array_finalize__(self, other: Any) -> None:
        if isinstance(other, Symbols):
            self.graph = other.graph

    def __getitem__(self, place: Any) -> Any:
        return self.graph.symbols(super().__getitem__(place))

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def astype(self, dtype: Any, *args: Any, **how: Any) -> Any:
        """Convert between booleans and numbers."""
        if np.dtype(dtype).kind not in "fb":
            raise NotExportable("a covariate turned into a whole number has no form in an export")
        return self != 0 if np.dtype(dtype).kind == "b" else self + 0.0

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **how: Any) -> Any:
        name, graph = ufunc.__name__, self.graph
        if method == "__call__" and name in COMPOSED:
            return COMPOSED[name](*map(graph.symbols, inputs))
        if name not in BY_FUNCTION or method not in ("__call__", "reduce"):
            raise NotExportable(f"the operation {name!r} has no form in C or plain Python here")
        if method == "__call__":
            return graph.elementwise(BY_FUNCTION[name], *inputs)
        reduced, axes = np.asarray(inputs[0]), how.get("axis", 0)
        combine = np.frompyfunc(partial(graph.applied, BY_FUNCTION[name]), 2, 1)
        axes = range(reduced.ndim) if axes is None else np.atleast_1d(axes) % reduced.ndim
        for axis in sorted(axes, reverse=True):
            reduced = np.asarray(combine.reduce(reduced, axis=axis), dtype=object)
        shaped = np.expand_dims(reduced, tuple(axes)) if how.get("keepdims") is True else reduced
        return graph.symbols(shaped)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.where and len(args) == 3:
            return self.graph.elementwise("select", *args)
        if func is np.dot:
            return np.matmul(*args)

        def symbols(outputs: Any) -> Any:
            if isinstance(outputs, list | tuple):
                return [*map(symbols, outputs)]
            is_object = isinstance(outputs, np.ndarray) and outputs.dtype == object
            return self.graph.symbols(outputs) if is_object else outputs

        return symbols(super().__array_function__(func, types, args, kwargs))


BY_FUNCTION = {o.compute.__name__: n for n, o in OPERATIONS.items() if n not in ("select", "real")}
BY_FUNCTION |= {"bitwise_and": "and", "bitwise_or": "or", "invert": "not"}


def _power(x: Symbols, y: Symbols) -> Symbols:
    """Raise to a power: by products for a small integer exponent, else by the operation."""
    exponent = y.item() if y.ndim == 0 else None
    if isinstance(exponent, Symbol | None) or exponent % 1 or abs(exponent) > 64:
        return x.graph.elementwise("pow", x, y)
    if exponent < 0:
        return 1.0 / x**-exponent
    half = x ** (exponent // 2) if exponent > 1 else x.graph.symbols(np.ones(x.shape))
    return half * half * x if exponent % 2 else half * half


def _product(x: Symbols, y: Symbols) -> Symbols:
    """Multiply an array by a matrix or a vector."""
    if y.ndim > 2:
        raise NotExportable("products with batch dimensions have no form in an export")
    return np.sum(x * y, axis=-1) if y.ndim == 1 else np.sum(x[..., None] * y, axis=-2)


# NumPy functions composed of several operations; others are left to JAX.
COMPOSED: dict[str, Callable[..., Symbols]] = {
    "power": _power,
    "matmul": _product,
    "square": lambda x: x * x,
    "clip": lambda x, low, high: np.minimum(np.maximum(x, low), high),
}


@dataclass(frozen=True)
class Language:
    """A language of exports."""

    name: Literal["c", "python"]  # its field of `Operation`
    cast: str  # before a constant
    nan: str  # nan, infinity: constants of these
    infinity: str
    truths: tuple[str, str]  # false and true
    statement: str  # assignment of an expression to a name; that of a boolean
    statement_boolean: str
    input: str = "{}"  # format of an input's field
    template: str = ""  # template file of the program
    words: Callable[[Any], str] = str  # escapes text for a comment

    def number(self, value: float | bool) -> str:
        """Return a constant's text, as an operand."""
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
    """Return statements, one per operation, and the expressions of the outputs."""
    text, written = dict[int, str](), list[str]()
    for place in graph.needed(outputs):
        op, *args = graph.nodes[place]
        if op == "const":
            text[place] = language.number(args[0])
        elif op == "input":
            text[place] = names[args[0]]
        else:
            expression = getattr(OPERATIONS[op], language.name).format(*(text[a] for a in args))
            form = language.statement_boolean if graph.boolean(place) else language.statement
            text[place] = f"t{len(written)}"
            written.append(form.format(text[place], expression))
    return written, [text[o] for o in outputs]
