"""An equation as a graph of scalar operations: simplified, and evaluated by NumPy.

One table says of each operation how NumPy computes it and how C, Python and JavaScript write it, so that every export
means the same. Nodes that are equal are one node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayescal._core.errors import InputError


@dataclass(frozen=True)
class Operation:
    """How NumPy computes an operation, and how C, Python and JavaScript write it, of arguments {0}, {1}, …"""

    compute: Callable[..., Any]
    c: str
    python: str
    javascript: str
    boolean: bool = False


def _infix(compute: Callable[..., Any], sign: str, boolean: bool = False) -> Operation:
    written = f"{{0}} {sign} {{1}}"
    return Operation(compute, written, written, written, boolean)


def _function(name: str) -> Operation:
    """Called the same in NumPy, C, Python and JavaScript."""
    called = (f"BAYESCAL_CALL({name}, {{0}})", f"math.{name}({{0}})", f"Math.{name}({{0}})")
    return Operation(getattr(np, name), *called)


FUNCTIONS = "exp log expm1 log1p sqrt sin cos tan asin acos atan sinh cosh tanh floor ceil"


OPERATIONS: dict[str, Operation] = {
    "add": _infix(np.add, "+"),
    "sub": _infix(np.subtract, "-"),
    "mul": _infix(np.multiply, "*"),
    "div": _infix(np.divide, "/"),
    "neg": Operation(np.negative, "-{0}", "-{0}", "-{0}"),
    "abs": Operation(np.abs, "BAYESCAL_CALL(fabs, {0})", "abs({0})", "Math.abs({0})"),
    "sign": Operation(
        np.sign,
        "(BAYESCAL_REAL)(({0} > 0) - ({0} < 0))",
        "float({0} > 0) - float({0} < 0)",
        "({0} > 0) - ({0} < 0)",
    ),
    "max": Operation(np.maximum, "{0} > {1} ? {0} : {1}", "max({0}, {1})", "{0} > {1} ? {0} : {1}"),
    "min": Operation(np.minimum, "{0} < {1} ? {0} : {1}", "min({0}, {1})", "{0} < {1} ? {0} : {1}"),
    "pow": Operation(np.power, "BAYESCAL_CALL2(pow, {0}, {1})", "{0} ** {1}", "Math.pow({0}, {1})"),
    "atan2": Operation(
        np.arctan2,
        "BAYESCAL_CALL2(atan2, {0}, {1})",
        "math.atan2({0}, {1})",
        "Math.atan2({0}, {1})",
    ),
    "rem": Operation(np.fmod, "BAYESCAL_CALL2(fmod, {0}, {1})", "math.fmod({0}, {1})", "{0} % {1}"),
    **{name: _function(name) for name in FUNCTIONS.split()},
    "gt": _infix(np.greater, ">", True),
    "ge": _infix(np.greater_equal, ">=", True),
    "lt": _infix(np.less, "<", True),
    "le": _infix(np.less_equal, "<=", True),
    "eq": _infix(np.equal, "==", True),
    "ne": _infix(np.not_equal, "!=", True),
    "and": Operation(np.logical_and, "{0} && {1}", "{0} and {1}", "{0} && {1}", True),
    "or": Operation(np.logical_or, "{0} || {1}", "{0} or {1}", "{0} || {1}", True),
    "not": Operation(np.logical_not, "!{0}", "not {0}", "!{0}", True),
    "select": Operation(np.where, "{0} ? {1} : {2}", "{1} if {0} else {2}", "{0} ? {1} : {2}"),
    "real": Operation(
        lambda x: np.where(x, 1.0, 0.0),
        "{0} ? (BAYESCAL_REAL)1 : (BAYESCAL_REAL)0",
        "float({0})",
        "{0} ? 1 : 0",
    ),
}


@dataclass(frozen=True)
class GraphNode:
    """A constant ("const", value), an input ("input", name), or an operation on earlier nodes."""

    op: str
    args: tuple[int, ...] = ()
    value: float | bool | str = 0.0


@dataclass
class Graph:
    """Nodes, each after those that it is made of."""

    nodes: list[GraphNode] = field(default_factory=list)
    places: dict[Any, int] = field(default_factory=dict)

    def put(self, node: GraphNode) -> int:
        key = (node.op, node.args, type(node.value), repr(node.value))
        if key not in self.places:
            self.places[key] = len(self.nodes)
            self.nodes.append(node)
        return self.places[key]

    def constant(self, value: float | bool) -> int:
        value = bool(value) if isinstance(value, bool | np.bool_) else float(value)
        return self.put(GraphNode("const", value=value))

    def input(self, name: str) -> int:
        return self.put(GraphNode("input", value=name))

    def boolean(self, place: int) -> bool:
        node = self.nodes[place]
        if node.op == "const":
            return isinstance(node.value, bool)
        if node.op == "select":
            return self.boolean(node.args[1])
        return node.op != "input" and OPERATIONS[node.op].boolean

    def value(self, place: int) -> float | bool | None:
        """Of a constant; None of anything else."""
        node = self.nodes[place]
        return node.value if node.op == "const" else None  # pyright: ignore[reportReturnType]

    def apply(self, op: str, *args: int) -> int:
        """An operation, or what it comes to: constants are computed, x + 0, 1·x, 0·x are not written."""
        values = [self.value(a) for a in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                found = OPERATIONS[op].compute(*values)
            return self.constant(bool(found) if OPERATIONS[op].boolean else found.item())
        simpler = self._simpler(op, args, values)
        return simpler if simpler is not None else self.put(GraphNode(op, args))

    def _simpler(self, op: str, args: tuple[int, ...], values: list[Any]) -> int | None:
        if op == "add":
            if values[0] == 0:
                return args[1]
            if values[1] == 0:
                return args[0]
            if self.nodes[args[1]].op == "neg":
                return self.apply("sub", args[0], self.nodes[args[1]].args[0])
        if op == "sub":
            if values[1] == 0:
                return args[0]
            if values[0] == 0:
                return self.apply("neg", args[1])
        if op in ("mul", "and") and any(v is not None and not v for v in values):
            return self.constant(0.0 if op == "mul" else False)
        if op == "mul" and 1 in values:
            return args[1] if values[0] == 1 else args[0]
        if op == "mul" and -1 in values:
            return self.apply("neg", args[1] if values[0] == -1 else args[0])
        if op == "div":
            if values[0] == 0:
                return args[0]
            if values[1] in (1, -1):
                return args[0] if values[1] == 1 else self.apply("neg", args[0])
        if op == "neg" and self.nodes[args[0]].op == "neg":
            return self.nodes[args[0]].args[0]
        if op == "select":
            if values[0] is not None:
                return args[1] if values[0] else args[2]
            if args[1] == args[2]:
                return args[1]
        return None

    def needed(self, outputs: Sequence[int]) -> list[int]:
        """Nodes that these are made of, themselves included, in order."""
        found, waiting = set(), list(outputs)
        while waiting:
            place = waiting.pop()
            if place not in found:
                found.add(place)
                waiting += self.nodes[place].args
        return sorted(found)

    def inputs(self, outputs: Sequence[int]) -> set[str]:
        """Names of the inputs that these are made of."""
        nodes = (self.nodes[place] for place in self.needed(outputs))
        return {str(n.value) for n in nodes if n.op == "input"}

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
                node = self.nodes[place]
                if node.op == "const":
                    values[place] = node.value if isinstance(node.value, bool) else kind(node.value)
                elif node.op == "input":
                    if node.value not in inputs:
                        raise InputError(f"the input {node.value!r} is missing")
                    values[place] = inputs[str(node.value)]
                else:
                    found = OPERATIONS[node.op].compute(*(values[a] for a in node.args))
                    if (
                        not OPERATIONS[node.op].boolean
                        and found.dtype != kind
                        and found.dtype != bool
                    ):
                        found = found.astype(kind)
                    values[place] = found
        return [values[o] for o in outputs]

    def part(self, outputs: Sequence[int]) -> tuple[Graph, list[int]]:
        """A graph of what these outputs need and no more."""
        small, moved = Graph(), {}
        for place in self.needed(outputs):
            node = self.nodes[place]
            moved[place] = small.put(
                GraphNode(node.op, tuple(moved[a] for a in node.args), node.value)
            )
        return small, [moved[o] for o in outputs]

    def data(self) -> list[list[Any]]:
        """As JSON: ["const", value], ["input", name], [operation, place, …]."""
        return [
            [n.op, *n.args] if n.op not in ("const", "input") else [n.op, _plain(n.value)]
            for n in self.nodes
        ]

    @classmethod
    def from_data(cls, data: Any) -> Graph:
        """A graph from JSON; data only, nothing of it is run but the operations of the table above.

        Raises:
            InputError: it is none.
        """
        graph = cls()
        for place, row in enumerate(data if isinstance(data, list) else [None]):
            if not isinstance(row, list) or not row or not isinstance(row[0], str):
                raise InputError(f"its operation {place} is none: {str(row)[:60]}")
            op, rest = str(row[0]), list(row[1:])
            if op == "const" and rest in (["nan"], ["inf"], ["-inf"]):
                made = GraphNode(op, value=float(rest[0]))
            elif op == "const" and len(rest) == 1 and isinstance(rest[0], int | float):
                made = GraphNode(op, value=rest[0] if isinstance(rest[0], bool) else float(rest[0]))
            elif op == "input" and len(rest) == 1 and isinstance(rest[0], str):
                made = GraphNode(op, value=rest[0])
            elif op in OPERATIONS and all(type(a) is int and 0 <= a < place for a in rest):
                count = OPERATIONS[op].c.count
                arity = max(i + 1 for i in range(3) if count(f"{{{i}}}"))
                if len(rest) != arity:
                    raise InputError(f"its operation {place}, {op!r}, has {len(rest)} arguments")
                made = GraphNode(op, tuple(rest))
            else:
                raise InputError(f"its operation {place} is not known here: {str(row)[:60]}")
            graph.nodes.append(made)
        return graph


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers that are none become text."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
