"""An effect from one typed line: "supply: s * (supply_voltage - 5); s = 0.1 mV/V".

Python's parser reads the line, and of its tree nothing is taken but what `_FUNCTIONS` and `_OPERATORS` list. Units are
checked before anything is computed. Unknowns that the formula is linear in become coefficients, the others shapes.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayescal._core.errors import InputError, ModelError
from bayescal._core.xp import xp
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY, base_unit, coefficient_factor, convert, parse
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame, build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.prior import Normal

LONGEST_LINE, DEEPEST = 500, 40  # characters of a line; powers and arguments in each other
TINY = float(np.finfo(float).tiny)  # below which numbers lose digits
MAGNITUDE = 10.0  # a shape of which one value is said lies between a tenth and ten times that
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{"exp": xp.exp, "log": xp.log, "sqrt": xp.sqrt, "abs": xp.abs, "sign": xp.sign},
    **{"sin": xp.sin, "cos": xp.cos, "tan": xp.tan, "tanh": xp.tanh},
    **{"min": xp.minimum, "max": xp.maximum, "step": lambda x: xp.where(x > 0, 1.0, 0.0)},
}
_OF_TWO = ("min", "max")
_OF_A_BODY = ("body", "lag_difference")  # T̃ and T̃ − T, with τ·dT̃/dt = T − T̃
_OF_COLUMNS = ("rate", *_OF_A_BODY)  # of a column's past
_LAG = "lag was T̃ − T, and read as T̃: write lag_difference(T, tau) for T̃ − T, or body(T, tau) for T̃"
_ALIASES = {"T": "temperature", "t": "time"}
_UNITS = {"time": "s", "elapsed": "s", "temperature": "degC"}  # known without readings
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[^\W\d]\w*)|`(?P<quoted>[^`]+)`"
    r"|(?P<sign>\*\*|[-+*/^(),])|(?P<other>\S))"
)
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}
_GIVEN = re.compile(r"\s*([^\W\d]\w*|`[^`]+`)\s*=\s*(.*\S)\s*")
_VALUE = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SIZE = re.compile(rf"({_VALUE})(?:\s*(?:±|\+-|\+/-)\s*({_VALUE}))?\s*(\D.*)?")
_RANGE = re.compile(rf"({_VALUE})\s*(?:…|\.\.\.?|to|-)\s*({_VALUE})\s*(\D.*)?")


class FormulaNode(NamedTuple):
    """A part of a formula: its kind, what it holds, and where it begins."""

    kind: str
    parts: tuple[Any, ...]
    at: int


class Dimension(NamedTuple):
    """Powers of base units, and how many of these the unit is in which its numbers are written."""

    powers: tuple[tuple[str, float], ...]
    factor: float

    @classmethod
    def of(cls, unit: str) -> Dimension:
        parsed = parse(unit)
        return cls(tuple(sorted(parsed.powers.items())), parsed.factor)

    def times(self, other: Dimension, sign: float = 1.0) -> Dimension:
        powers = dict(self.powers)
        for name, power in other.powers:
            powers[name] = powers.get(name, 0.0) + sign * power
        kept = tuple(sorted((n, p) for n, p in powers.items() if p))
        return Dimension(kept, self.factor * other.factor**sign)

    def raised(self, power: float) -> Dimension:
        kept = tuple((n, p * power) for n, p in self.powers if power)
        return Dimension(kept, self.factor**power)

    def __str__(self) -> str:
        words = "*".join(f"{n}^{p:g}" for n, p in self.powers)
        return f"[{base_unit(words).removeprefix('delta_')}]" if words else "a plain number"


NUMBER = Dimension((), 1.0)
Checked = tuple[
    FormulaNode, Dimension | None
]  # a part, and its dimension; None for a plain literal


def _number(text: str, refusal: Callable[[str], InputError] = InputError) -> float:
    """Return a number as it is written.

    Raises:
        InputError: by `refusal`: it is too large, or too small, for a computer's numbers.
    """
    value = float(text)
    if math.isfinite(value) and (
        abs(value) >= TINY or not re.search("[1-9]", text.lower().split("e")[0])
    ):
        return value
    raise refusal(f"{text} is a number too {'large' if abs(value) > 1 else 'small'}")


class _Text:
    """What is typed, of which a place is marked where it is refused."""

    def __init__(self, text: str) -> None:
        self.text = text

    def refusal(self, at: int, why: str) -> InputError:
        return InputError(f"effect {self.text[:at]!r} ▸ {self.text[at:]!r}: {why}")

    def node(self, kind: str, *parts: FormulaNode, name: str = "") -> FormulaNode:
        """Return a node of these parts: a function's, an operator's; of numbers alone, their value.

        Raises:
            InputError: it has none: a division by zero, the root of a negative number, a number too large or too small.
        """
        at = parts[0].at
        if name in _OF_COLUMNS or any(part.kind != "number" for part in parts):
            return FormulaNode(kind, (name, *parts) if name else parts, at)
        of = _FUNCTIONS[name] if name else _OPERATORS[kind]
        try:
            with np.errstate(all="raise"):
                value = float(of(*(np.float64(part.parts[0]) for part in parts)))
        except FloatingPointError as error:
            raise self.refusal(at, f"this number has no value: {error}") from None
        if not math.isfinite(value):
            raise self.refusal(at, f"this number has no value: it is {value}")
        return FormulaNode("number", (value,), at)

    def parsed(self) -> FormulaNode:
        """Return the formula as a tree.

        Raises:
            InputError: it is none.
        """
        if len(self.text) > LONGEST_LINE:
            raise InputError(f"a formula of {len(self.text)} characters: {LONGEST_LINE} at most")
        # To Python go operators and brackets alone, each name and number as n0, n1, …: no keyword, no other literal.
        self.atoms, self.places, source = dict[str, FormulaNode](), list[int](), ""
        for token in _TOKEN.finditer(self.text):
            kind = str(token.lastgroup)
            value, at = token[kind], token.start(kind)
            if kind == "other":
                raise self.refusal(at, f"{value!r} has no meaning in a formula")
            word = value.replace("^", "**") if kind == "sign" else f"n{len(self.atoms)}"
            if kind == "number":
                number = _number(value, partial(self.refusal, at))
                self.atoms[word] = FormulaNode("number", (number,), at)
            elif kind != "sign":
                self.atoms[word] = FormulaNode("name", (value,), at)
            source += word + " "
            self.places += [at] * (len(word) + 1)
        try:
            return self._tree(ast.parse(source, mode="eval").body)
        except (SyntaxError, MemoryError, RecursionError) as error:
            column = (getattr(error, "offset", None) or 1) - 1
            at = self.places[column] if column < len(self.places) else len(self.text)
            why = "this makes no formula: is an operator, a number, a name or a bracket missing?"
            raise self.refusal(at, why) from None

    def _tree(self, part: ast.expr, depth: int = 0) -> FormulaNode:
        at = self.places[part.col_offset]
        if depth > DEEPEST:
            raise self.refusal(at, f"powers and brackets deeper than {DEEPEST}")
        match part:
            case ast.Name():
                return self.atoms[part.id]
            case ast.BinOp() if sign := _SIGNS.get(type(part.op)):
                return self.node(
                    sign, self._tree(part.left, depth), self._tree(part.right, depth + 1)
                )
            case ast.UnaryOp():
                negative = False
                while isinstance(part, ast.UnaryOp):
                    negative, part = negative ^ isinstance(part.op, ast.USub), part.operand
                base = self._tree(part, depth)
                return self.node("neg", base)._replace(at=at) if negative else base
            case ast.Call(func=ast.Name()):
                return self._call(self.atoms[part.func.id].parts[0], part.args, at, depth)
        raise self.refusal(at, "this has no meaning in a formula")

    def _call(self, name: str, given: Sequence[ast.expr], at: int, depth: int) -> FormulaNode:
        known = (*_FUNCTIONS, *_OF_COLUMNS)
        if name == "lag":
            raise self.refusal(at, _LAG)
        if name not in known:
            raise self.refusal(at, f"there is no function {name!r}; there are {', '.join(known)}")
        count = 2 if name in (*_OF_TWO, *_OF_A_BODY) else 1
        if len(given) != count:
            raise self.refusal(at, f"{name} takes {count} argument{'s' * (count > 1)}")
        arguments = (self._tree(one, depth + 1) for one in given)
        return self.node("call", *arguments, name=name)._replace(at=at)


def _inside(node: FormulaNode) -> Iterator[FormulaNode]:
    yield node
    for part in node.parts:
        if isinstance(part, FormulaNode):
            yield from _inside(part)


def _names(node: FormulaNode) -> set[str]:
    return {n.parts[0] for n in _inside(node) if n.kind == "name"}


def _bent(node: FormulaNode) -> set[str]:
    """Names that a formula is not linear in: in a function, below a division, in a power."""
    within = [n.parts[1] if n.kind == "/" else n for n in _inside(node) if n.kind in "call/^"]
    return set().union(*map(_names, within))


@dataclass(frozen=True)
class Formula:
    """The basis of a typed effect, in base units: called with readings and the shapes.

    Attributes:
        text: the line that it was made of, with sizes and units.
        parts: for each coefficient, what it is multiplied by.
        columns: name in the formula → the readings' column and its factor to base units.
        shapes: names of the shapes.
    """

    text: str
    parts: tuple[FormulaNode, ...]
    columns: tuple[tuple[str, str, float], ...]
    shapes: tuple[str, ...] = ()

    @property
    def __signature__(self) -> inspect.Signature:
        kinds = inspect.Parameter
        own = [kinds(n, kinds.KEYWORD_ONLY) for n in self.shapes]
        return inspect.Signature([kinds("r", kinds.POSITIONAL_OR_KEYWORD), *own])

    def __call__(self, r: Frame, **shapes: Any) -> Any:
        values = {n: factor * _column(r, column) for n, column, factor in self.columns}
        found = [self._value(part, r, {**values, **shapes}) for part in self.parts]
        return xp.stack([xp.broadcast_to(v, (r.size,)) for v in found], axis=-1)

    def _value(self, node: FormulaNode, r: Frame, values: Mapping[str, Any]) -> Any:
        if node.kind == "number":
            return node.parts[0]
        if node.kind == "name":
            return values[node.parts[0]]
        if node.kind == "call" and node.parts[0] in _OF_COLUMNS:
            what, of, *rest = node.parts
            column, factor = next((c, f) for n, c, f in self.columns if n == of.parts[0])
            if what == "rate":
                return r.rate(column)
            behind = factor * r.lag(self._value(rest[0], r, values), column)
            return behind if what == "lag_difference" else values[of.parts[0]] + behind
        own = [self._value(part, r, values) for part in node.parts if isinstance(part, FormulaNode)]
        if node.kind == "call":
            return _FUNCTIONS[node.parts[0]](*own)
        return _OPERATORS[node.kind](*own)


def _power(base: Any, exponent: Any) -> Any:
    """A whole power by multiplying, of which negative bases have a slope too."""
    whole = isinstance(exponent, float) and exponent.is_integer()
    return base ** (int(exponent) if whole else exponent)


_OPERATORS: dict[str, Callable[..., Any]] = {
    **{"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv},
    **{"^": _power, "neg": operator.neg},
}


def _column(r: Frame, name: str) -> Any:
    return r.elapsed if name == "elapsed" else r[name]


def _times(node: FormulaNode, factor: float) -> FormulaNode:
    if factor == 1.0:
        return node
    return FormulaNode("*", (node, FormulaNode("number", (factor,), node.at)), node.at)


def effect(
    name: str,
    formula: str = "",
    *,
    readings: Measurements | None = None,
    instrument: Instrument | None = None,
    source: str = "the user's own",
    **given: str,
) -> Effect:
    """An effect from a formula, as it is typed.

        bc.effect("supply", "s * (V - 5) / V", s="0.1 mV/V", V="supply_voltage [V]")
        bc.effect("bias.supply: s * (supply_voltage - 5); s = 0.1 mV/V", readings=readings)

    Names are columns of the readings, in their fixed units; a name that is none is an unknown. An unknown that the
    formula is linear in is a coefficient, and its prior is zero ± its size; another is a shape with a plausible range.
    Numbers that are added to a column are in its unit. There are + - * / ^, brackets, exp, log, sqrt, abs, sign, sin,
    cos, tan, tanh, min, max, step (1 above zero); `elapsed` is the time in the run. Of a column's past there are
    rate(T) = dT/dt, body(T, tau) = T̃, the temperature of a body that follows T with τ·dT̃/dt = T − T̃, from T at a
    run's first reading, and lag_difference(T, tau) = T̃ − T.

    Args:
        name: of the effect, `slot.cause`, or its cause alone: the slot is then the first that the units fit. The
            whole may stand here too: "name: formula; s = 0.1 mV/V".
        formula: such as "s * (supply_voltage - 5)".
        readings: whose columns it uses: gives units, and sizes that are not said. Without, units are looked at when a
            model meets readings; they may be said: V="supply_voltage [V]".
        instrument: whose slots it may add to.
        source: where the formula is from.
        given: size of each coefficient ("0.1 mV/V", or "0.5 ± 0.1 mV/V" about another mean than zero); range of each
            shape ("100 to 2000 s", or one value for a tenth to ten times that); columns under other names.

    Raises:
        InputError: the formula is none, its units do not go together, or a size is missing; the place is marked with ▸.
    """
    return _TypedLine(name, formula, given, readings, instrument).effect(source)


def _apart(name: str, formula: str, given: Mapping[str, str]) -> tuple[str, str, dict[str, str]]:
    """Name, formula and what is given, where all stand in one text.

    Raises:
        InputError: there is no formula, or something behind a semicolon is no assignment.
    """
    given = {n: str(v).strip() for n, v in given.items()}
    if not formula:
        name, colon, rest = name.partition(":")
        formula, *more = rest.split(";") if colon else ("",)
        for one in filter(str.strip, more):
            if not (found := _GIVEN.fullmatch(one)):
                raise InputError(
                    f"effect {name!r}: {one.strip()!r} is not of the form s = 0.1 mV/V"
                )
            given[found[1].strip("`")] = found[2]
    name, formula = name.strip(), formula.strip()
    if not formula or not re.fullmatch(r"[^\W\d]\w*(?:\.\w+)?", name):
        raise InputError(
            f"effect {name[:60]!r} has no name and formula: write it as 'supply: s * (supply_voltage - 5); s = 1 mV/V'"
        )
    return name, formula, given


class _TypedLine(_Text):
    """A formula with what is said of its names, and the readings or instrument that it is for.

    Attributes:
        name: of the effect.
        given: what is said, by name.
        tree: the formula.
        columns: name in the formula → column, and its fixed unit; empty where that is not known yet.
        coefficients: for each unknown that the formula is linear in, what it is multiplied by, and its dimension.
        shapes: the other unknowns.
    """

    def __init__(
        self,
        name: str,
        formula: str,
        given: Mapping[str, str],
        readings: Measurements | None,
        instrument: Instrument | None,
    ) -> None:
        self.name, formula, self.given = _apart(name, formula, given)
        super().__init__(formula)
        self.readings, self.instrument = readings, instrument
        self.tree = self.parsed()
        self.columns = self._columns()
        past = [
            n.parts for n in _inside(self.tree) if n.kind == "call" and n.parts[0] in _OF_COLUMNS
        ]
        for function, of, *_ in past:
            if of.kind != "name" or of.parts[0] not in self.columns:
                raise self.refusal(of.at, f"{function} takes the name of a column")
        self.of_past = bool(past)
        named = _names(self.tree)
        if unused := sorted(set(self.given) - named):
            raise InputError(
                f"effect {self.name!r}: {', '.join(unused)} is given, and does not stand in {formula!r}"
            )
        unknowns = named - set(self.columns)
        bent = _bent(self.tree) & unknowns
        linear = self._linear(self.tree, unknowns - bent)
        if "" in linear:
            near = "" if unknowns else ": write one in front, as s * (…)"
            why = f"this is multiplied by no coefficient, whose size would be found{near}"
            raise self.refusal(linear[""].at, why)
        self.shapes = {n: self._shape(n) for n in sorted(bent)}
        self.units = {n: Dimension.of(u) if u else None for n, (_, u) in self.columns.items()}
        self.units |= {n: Dimension.of(s.unit) for n, s in self.shapes.items()}
        self.coefficients = {n: self._checked(part) for n, part in linear.items()}

    def effect(self, source: str) -> Effect:
        slot, slot_unit, cause = self._slot()
        name, basis = f"{slot}.{cause}", self._basis("")
        scatter = None if self.readings is None else _scatter(basis, self.readings, self.shapes)
        coefficients = tuple(
            self._coefficient(n, unit, slot_unit, None if scatter is None else scatter[i])
            for i, (n, (_, unit)) in enumerate(self.coefficients.items())
        )
        needs = ["time" if c == "elapsed" else c for c, _ in self.columns.values()]
        return Effect(
            name,
            slot,
            basis=self._basis(self._canonical(name, coefficients)),
            coefficients=coefficients,
            shapes=tuple(self.shapes.values()),
            columns=tuple(dict.fromkeys([*needs, *["time"] * self.of_past])),
            equation=self.text,
            source=source,
        )

    def _basis(self, text: str) -> Formula:
        used = tuple((n, c, Dimension.of(u or "1").factor) for n, (c, u) in self.columns.items())
        parts = tuple(part for part, _ in self.coefficients.values())
        return Formula(text, parts, used, tuple(self.shapes))

    def _linear(self, node: FormulaNode, unknowns: set[str]) -> dict[str, FormulaNode]:
        """What each unknown is multiplied by; "" for what is multiplied by none."""
        if not _names(node) & unknowns:
            return {"": node}
        if node.kind == "name":
            return {node.parts[0]: FormulaNode("number", (1.0,), node.at)}
        a, *more = (self._linear(part, unknowns) for part in node.parts)
        if node.kind == "neg":
            return {n: self.node("neg", part) for n, part in a.items()}
        (b,) = more
        if node.kind in "+-":
            for name, part in b.items():
                signed = part if node.kind == "+" else self.node("neg", part)
                a[name] = self.node("+", a[name], signed) if name in a else signed
            return a
        if set(b) == {""}:
            return {n: self.node(node.kind, part, b[""]) for n, part in a.items()}
        if set(a) == {""}:
            return {n: self.node(node.kind, a[""], part) for n, part in b.items()}
        both = sorted({*a, *b} - {""})
        unsaid = [n for n in both if n not in self.given]
        if self.readings is not None and len(unsaid) == 1 < len(both):
            raise self.refusal(node.at, self._no_column(unsaid[0]))
        why = f"{' and '.join(both)} multiply each other: only their product could be told"
        if self.readings is not None and unsaid:
            why += f". {' and '.join(map(self._no_column, unsaid))}"
        raise self.refusal(node.at, why)

    def _checked(self, node: FormulaNode) -> Checked:
        """Return a part with its literals in base units, and its dimension; None for a plain literal.

        Literals take the unit that they are added to or compared with.
        """
        if node.kind == "number":
            return node, None
        if node.kind == "name":
            return node, self.units[node.parts[0]]
        if node.kind == "call":
            return self._checked_call(node, *node.parts)
        (a, left), *more = (self._checked(part) for part in node.parts)
        if node.kind == "neg":
            return node._replace(parts=(a,)), left
        ((b, right),) = more
        if node.kind == "^":
            unit = self._raised(left, right, b, node.parts[1].at)
        elif node.kind in "+-":
            a, b, unit = self._alike(a, left, b, right, node.parts[1].at)
        else:
            sign, plain = (1.0 if node.kind == "*" else -1.0), left is None and right is None
            unit = None if plain else (left or NUMBER).times(right or NUMBER, sign)
        return node._replace(parts=(a, b)), unit

    def _alike(
        self,
        a: FormulaNode,
        left: Dimension | None,
        b: FormulaNode,
        right: Dimension | None,
        at: int,
    ) -> tuple[FormulaNode, FormulaNode, Dimension | None]:
        """Two parts that are added or compared, plain literals in the unit of the other."""
        if left is not None and right is not None and left.powers != right.powers:
            why = f"this is {right}, what it is added to or compared with {left}"
            raise self.refusal(at, why)
        unit = left or right
        factor = 1.0 if unit is None else unit.factor
        return (
            _times(a, factor) if left is None else a,
            _times(b, factor) if right is None else b,
            unit,
        )

    def _raised(
        self, unit: Dimension | None, of: Dimension | None, exponent: FormulaNode, at: int
    ) -> Dimension | None:
        if of is not None and of.powers:
            raise self.refusal(at, f"an exponent is a plain number, this is {of}")
        if unit is None or not unit.powers:
            return unit if of is None else NUMBER
        if exponent.kind != "number" or abs(exponent.parts[0]) > 10:
            raise self.refusal(at, f"of {unit} only a power such as 2 or 0.5 has a unit")
        return unit.raised(exponent.parts[0])

    def _checked_call(
        self, node: FormulaNode, name: str, first: FormulaNode, *rest: FormulaNode
    ) -> Checked:
        if name in _OF_COLUMNS:
            return node, self._of_past(name, first, *rest)
        (a, unit), *more = (self._checked(argument) for argument in (first, *rest))
        if name in _OF_TWO:
            ((b, right),) = more
            a, b, unit = self._alike(a, unit, b, right, rest[0].at)
            return node._replace(parts=(name, a, b)), unit
        node = node._replace(parts=(name, a))
        if name == "abs" or (name == "sqrt" and unit is None):
            return node, unit
        if name == "sqrt":
            return node, unit and unit.raised(0.5)
        angle = (
            name in ("sin", "cos", "tan") and unit is not None and unit.powers == (("rad", 1.0),)
        )
        if name not in ("step", "sign") and unit is not None and unit.powers and not angle:
            why = f"{name} takes a plain number, this is {unit}: divide it by one"
            raise self.refusal(first.at, why)
        return node, NUMBER

    def _of_past(self, name: str, column: FormulaNode, *rest: FormulaNode) -> Dimension:
        unit = self.units[column.parts[0]] or Dimension.of("degC")
        if name == "rate":
            if unit.powers != (("K", 1.0),):
                raise self.refusal(column.at, "rate is of a temperature")
            return unit.times(Dimension.of("s"), -1.0)
        (time,) = rest
        tau = str(time.parts[0])
        of = self.units.get(tau) if time.kind == "name" and tau in self.shapes else None
        if of is None or of.powers != (("s", 1.0),):
            raise self.refusal(
                time.at, f"the second argument of {name} is a time constant, such as tau"
            )
        return unit

    def _no_column(self, name: str) -> str:
        """Return that the readings have no column of a name, and which they have."""
        assert self.readings is not None
        has = ", ".join(self.there)
        return f"{name!r} is not a column of numbers of {self.readings.file} (it has: {has})"

    def _columns(self) -> dict[str, tuple[str, str]]:
        """Names that are columns.

        Raises:
            InputError: the readings have no such column of numbers, or its unit is not known.
        """
        readings, given, there = self.readings, self.given, dict(_UNITS)
        for c in self.instrument.columns if self.instrument else ():
            if c.unit not in (None, ANY) and c.name != "output":
                there[c.name] = str(c.unit)
        if readings is not None:
            units = {n: readings.unit(n) for n in readings.columns if n != readings.output}
            there = {n: str(unit) for n, unit in units.items() if unit}
            there |= {"elapsed": "s"} if "time" in there else {}
        self.there = there
        declared = (
            {c.name for c in self.instrument.columns if c.name != "output"}
            if self.instrument
            else {}
        )
        own = {n: v for n, v in given.items() if not re.match(r"[-+.\d]", v)}
        found: dict[str, tuple[str, str]] = {}
        for node in (n for n in _inside(self.tree) if n.kind == "name"):
            called = node.parts[0]
            column, bracket, unit = str(own.get(called, called)).partition("[")
            column = column.strip()
            column = column if column in there or called in own else _ALIASES.get(column, column)
            stated = base_unit(unit.rstrip("] ")) if bracket else ""
            if column in there:
                if stated and Dimension.of(stated).powers != Dimension.of(there[column]).powers:
                    why = f"{column} is in [{there[column]}], and not in [{stated}]"
                    raise self.refusal(node.at, why)
                found[called] = column, there[column]
            elif called in own and readings is None:
                found[called] = column, stated
            elif readings is not None and (
                called in own or (column in declared and called not in given)
            ):
                raise self.refusal(node.at, self._no_column(column))
            elif called not in given and readings is None and given:
                found[called] = called, ""  # a column, whose unit is looked at with the readings
            elif called not in given and len(called) > 3 and (near := _near(called, there)):
                raise self.refusal(node.at, f"there is no column {called!r}: is {near!r} meant?")
        return found

    def _shape(self, name: str) -> Shape:
        said = self.given.get(name)
        if said is None:
            at = next(n.at for n in _inside(self.tree) if n.kind == "name" and n.parts[0] == name)
            why = f"how large {name!r} plausibly is, is not said: {name} = 100 to 2000 s"
            why = why if self.readings is None else f"{self._no_column(name)}, and {why}"
            raise self.refusal(at, why)
        if found := _RANGE.fullmatch(said):
            low, high, unit = _number(found[1]), _number(found[2]), found[3]
        elif (found := _SIZE.fullmatch(said)) and found[2] is None and float(found[1]) > 0:
            value, unit = _number(found[1]), found[3]
            low, high = value / MAGNITUDE, value * MAGNITUDE
        else:
            raise InputError(f"{name} = {said!r} is no plausible range: write it as 100 to 2000 s")
        unit = (unit or "1").strip()
        # What is added to a column or compared with it is a place along it: 50 degF is 10 °C, and may be negative.
        place = any(
            part.kind == "name" and part.parts[0] == name
            for n in _inside(self.tree)
            if n.kind in "+-" or n.parts[0] in _OF_TWO
            for part in n.parts
            if isinstance(part, FormulaNode)
        )
        if not (low < high and (low > 0 or place)):
            raise InputError(
                f"{name} = {said!r}: a range goes from a positive number to a larger one"
            )
        base = "1"
        if unit != "1":
            own = base_unit(unit)
            low, high = (float(convert(v, unit, own, difference=not place)) for v in (low, high))
            base = re.sub(r"(?<!delta_)degC", "delta_degC", own)
        return Shape(name, base, low, high, "log" if low > 0 else "linear")

    def _slot(self) -> tuple[str, str | None, str]:
        """The slot, its unit where it is known, and the cause."""
        slot, _, cause = self.name.rpartition(".")
        if self.instrument is None:
            return slot or "bias", None, cause
        if slot:
            return slot, self.instrument.slot(slot).unit, cause
        chosen = self.instrument.slots[0]
        for name, (_, unit) in self.coefficients.items():
            size = _SIZE.fullmatch(self.given.get(name, ""))
            if size and size[3]:
                whole = Dimension.of(size[3].strip()).times(unit or NUMBER).powers
                fitting = (s for s in self.instrument.slots if Dimension.of(s.unit).powers == whole)
                if found := next(fitting, None):
                    chosen = found
                    break
        return chosen.name, chosen.unit, cause

    def _coefficient(
        self, name: str, unit: Dimension | None, slot_unit: str | None, size: float | None
    ) -> Coefficient:
        """A coefficient with its prior, its unit such that the product is in that of the slot."""
        own, said = unit or NUMBER, self.given.get(name)
        part = name if len(self.coefficients) > 1 else ""
        if said is None:
            if size is None or slot_unit is None:
                raise InputError(
                    f"effect {self.text!r}: how large {name!r} plausibly is, is not said: {name} = 0.1 mV/V"
                )
            text = "/".join([slot_unit, *(_power_of(n, p) for n, p in own.powers)])
            rounded = _number(f"{size / coefficient_factor(text, slot_unit):.2g}")
            return Coefficient(text, Normal(0.0, rounded), part)
        if not (found := _SIZE.fullmatch(said)):
            raise InputError(
                f"{name} = {said!r} is no size with a unit: write it as 0.1 mV/V, or as 0.5 ± 0.1 mV/V"
            )
        text = (found[3] or "1").strip()
        sd, mean = abs(_number(found[2] or found[1])), _number(found[1]) if found[2] else 0.0
        if not sd > 0:
            raise InputError(f"{name} = {said!r}: a size is not zero")
        whole = Dimension.of(text).times(own)
        if slot_unit is not None and whole.powers != (wanted := Dimension.of(slot_unit)).powers:
            raise InputError(
                f"effect {self.text!r}: {name} in {text} makes it {whole}, and it adds to what is {wanted}: correct "
                f"the unit of {name}"
            )
        return Coefficient(text, Normal(mean, sd), part)

    def _canonical(self, name: str, coefficients: Sequence[Coefficient]) -> str:
        """The whole in one line, from which it can be made again without readings."""
        pieces = [f"{name}: {self.text}"]
        for n, c in zip(self.coefficients, coefficients, strict=True):
            pieces.append(f"{n} = {f'{c.mean!r} ± ' if c.mean else ''}{c.size!r} {c.unit}")
        pieces += [f"{n} = {s.low!r} to {s.high!r} {s.unit}" for n, s in self.shapes.items()]
        for n, (c, u) in self.columns.items():
            if n != c or n not in _UNITS:
                called = n if n.isidentifier() else f"`{n}`"
                pieces.append(f"{called} = {c}" + (f" [{u}]" if u else ""))
        return "; ".join(pieces)


def line_of_today(line: str) -> str:
    """A line that was saved when `lag` was a word of formulas, of which it meant `lag_difference`."""
    return re.sub(r"\blag(?=\s*\()", "lag_difference", line)


def _near(name: str, known: Iterable[str]) -> str:
    return next(iter(difflib.get_close_matches(name, known, 1, 0.8)), "")


def _power_of(name: str, power: float) -> str:
    name = "degC" if name == "K" else name
    return name if power == 1 else f"({name}^{power:g})"


def _scatter(made: Formula, readings: Measurements, shapes: Mapping[str, Shape]) -> list[float]:
    """Size of each coefficient at which its term varies as much as the output does, base units of the output."""
    frame = build_frame(readings, reference_of(readings))
    middle = {n: float(s.prior.value(np.float64(0.0))) for n, s in shapes.items()}
    with np.errstate(all="ignore"):  # what is not finite is refused where it meets the readings
        columns = np.asarray(made(frame, **middle))
        sizes = np.std(columns, axis=0)
    spread = float(np.std(readings[readings.output]))
    sizes = np.where(sizes > 0, sizes, np.abs(columns).max(axis=0))
    return [spread / s if s > 0 and math.isfinite(s) else spread for s in sizes.tolist()]


def require_units(effect_: Effect, readings: Measurements, instrument: Instrument) -> None:
    """Refuse readings or a slot whose units are others than those that a typed effect was made for.

    Raises:
        ModelError: a column, or the whole, is in another unit.
    """
    made = effect_.basis
    if not isinstance(made, Formula):
        return
    try:
        again = effect(made.text, readings=readings, instrument=instrument)
    except InputError as error:
        raise ModelError(str(error)) from None
    assert isinstance(again.basis, Formula)
    if (again.basis.parts, again.basis.columns) != (made.parts, made.columns):
        raise ModelError(
            f"Effect {effect_.name!r} was typed for columns in other units than these readings have: type it with "
            f"readings=, or say their units ({made.text})"
        )
