"""An effect from one typed line: "supply: s * (supply_voltage - 5); s = 0.1 mV/V".

The line is parsed by the grammar below and by nothing else: what it can do is what `_FUNCTIONS` lists. Units are
checked before anything is computed. Unknowns that the formula is linear in become coefficients, the others shapes.
"""

from __future__ import annotations

import difflib
import inspect
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from bayescal._core.errors import InputError, ModelError
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import base_unit, coefficient_factor
from bayescal._data.unit_parsing import ANY, parse
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame, build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.prior import Normal

LONGEST, DEEPEST = 500, 40  # characters of a line, brackets in each other
MAGNITUDE = 10.0  # a shape of which one value is said lies between a tenth and ten times that
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{"exp": jnp.exp, "log": jnp.log, "sqrt": jnp.sqrt, "abs": jnp.abs, "sign": jnp.sign},
    **{"sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "tanh": jnp.tanh},
    **{"min": jnp.minimum, "max": jnp.maximum, "step": lambda x: jnp.where(x > 0, 1.0, 0.0)},
}
_OF_TWO = ("min", "max")
_OF_COLUMNS = ("rate", "lag")  # of a column's past
_ALIASES = {"T": "temperature", "t": "time"}
_UNITS = {"time": "s", "elapsed": "s", "temperature": "degC"}  # known without readings
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[^\W\d]\w*)|`(?P<quoted>[^`]+)`"
    r"|(?P<sign>\*\*|[-+*/^(),]))"
)
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

    def __str__(self) -> str:
        words = "*".join(f"{n}^{p:g}" for n, p in self.powers)
        return f"[{base_unit(words).removeprefix('delta_')}]" if words else "a plain number"


NUMBER = Dimension((), 1.0)


def refuse(text: str, at: int, why: str) -> InputError:
    """The refusal of a formula, with the place marked."""
    return InputError(f"effect {text[:at]!r} ▸ {text[at:]!r}: {why}")


class _Parser:
    """sum = product (± product)*, product = factor (× or ÷ factor)*, factor = ± atom, or ± atom ^ factor."""

    def __init__(self, text: str) -> None:
        self.text, self.at, self.depth = text, 0, 0
        if len(text) > LONGEST:
            raise InputError(f"a formula of {len(text)} characters: {LONGEST} at most")
        self.kind, self.value, self.begins = "", "", 0
        self._next()

    def whole(self) -> FormulaNode:
        found = self._sum()
        if self.kind != "end":
            raise refuse(self.text, self.begins, "an operator or the end was expected")
        return found

    def _next(self) -> None:
        rest = self.text[self.at :]
        if not rest.strip():
            self.kind, self.value, self.begins = "end", "", len(self.text)
            return
        found = _TOKEN.match(rest)
        if not found:
            at = self.at + len(rest) - len(rest.lstrip())
            raise refuse(self.text, at, f"{self.text[at]!r} has no meaning in a formula")
        self.kind = str(found.lastgroup)
        self.value, self.begins = found[self.kind], self.at + found.start(self.kind)
        self.at += found.end()

    def _taken(self, *signs: str) -> str:
        if self.kind == "sign" and self.value in signs:
            value = self.value
            self._next()
            return value
        return ""

    def _sum(self) -> FormulaNode:
        self.depth += 1
        if self.depth > DEEPEST:
            raise refuse(self.text, self.begins, f"brackets deeper than {DEEPEST}")
        found = self._product()
        while sign := self._taken("+", "-"):
            found = FormulaNode(sign, (found, self._product()), found.at)
        self.depth -= 1
        return found

    def _product(self) -> FormulaNode:
        found = self._factor()
        while sign := self._taken("*", "/"):
            found = FormulaNode(sign, (found, self._factor()), found.at)
        return found

    def _factor(self) -> FormulaNode:
        at = self.begins
        signs = 0
        while sign := self._taken("+", "-"):
            signs += sign == "-"
        base = self._atom()
        if self._taken("^", "**"):
            self.depth += 1
            if self.depth > DEEPEST:
                raise refuse(self.text, self.begins, f"powers deeper than {DEEPEST}")
            base = FormulaNode("^", (base, self._factor()), base.at)
            self.depth -= 1
        return FormulaNode("neg", (base,), at) if signs % 2 else base

    def _atom(self) -> FormulaNode:
        kind, value, at = self.kind, self.value, self.begins
        if self._taken("("):
            found = self._sum()
            self._close()
            return found
        if kind not in ("number", "name", "quoted"):
            raise refuse(self.text, at, "a number, a name or a bracket was expected")
        self._next()
        if kind == "number":
            if not math.isfinite(float(value)):
                raise refuse(self.text, at, f"{value} is too large")
            return FormulaNode("number", (float(value),), at)
        if kind == "name" and self.kind == "sign" and self.value == "(":
            return self._call(value, at)
        return FormulaNode("name", (value,), at)

    def _call(self, name: str, at: int) -> FormulaNode:
        if name not in _FUNCTIONS and name not in _OF_COLUMNS:
            known = ", ".join((*_FUNCTIONS, *_OF_COLUMNS))
            raise refuse(self.text, at, f"there is no function {name!r}; there are {known}")
        self._next()
        arguments = [self._sum()]
        while self._taken(","):
            arguments.append(self._sum())
        self._close()
        count = 2 if name in (*_OF_TWO, "lag") else 1
        if len(arguments) != count:
            raise refuse(self.text, at, f"{name} takes {count} argument{'s' * (count > 1)}")
        return FormulaNode("call", (name, *arguments), at)

    def _close(self) -> None:
        if not self._taken(")"):
            raise refuse(self.text, self.begins, "a closing bracket was expected")


def _inside(node: FormulaNode) -> Iterator[FormulaNode]:
    yield node
    for part in node.parts:
        if isinstance(part, FormulaNode):
            yield from _inside(part)


def _names(node: FormulaNode) -> set[str]:
    return {n.parts[0] for n in _inside(node) if n.kind == "name"}


def _bent(node: FormulaNode, unknowns: set[str]) -> Iterator[str]:
    """Unknowns that a formula is not linear in: in a function, below a division, in a power."""
    for n in _inside(node):
        if n.kind == "call":
            yield from _names(n) & unknowns
        elif n.kind == "/":
            yield from _names(n.parts[1]) & unknowns
        elif n.kind == "^":
            yield from _names(n) & unknowns


def _linear(text: str, node: FormulaNode, unknowns: set[str]) -> dict[str, FormulaNode]:
    """What each unknown is multiplied by; "" for what is multiplied by none."""
    if not _names(node) & unknowns:
        return {"": node}
    if node.kind == "name":
        return {node.parts[0]: FormulaNode("number", (1.0,), node.at)}
    if node.kind == "neg":
        inner = _linear(text, node.parts[0], unknowns)
        return {n: FormulaNode("neg", (part,), part.at) for n, part in inner.items()}
    a, b = (_linear(text, part, unknowns) for part in node.parts)
    if node.kind in "+-":
        found = dict(a)
        for name, part in b.items():
            signed = part if node.kind == "+" else FormulaNode("neg", (part,), part.at)
            found[name] = (
                FormulaNode("+", (found[name], signed), part.at) if name in found else signed
            )
        return found
    if set(b) != {""} and set(a) != {""}:
        both = sorted({*a, *b} - {""})
        raise refuse(
            text,
            node.at,
            f"{' and '.join(both)} multiply each other: only their product could be told",
        )
    held, free = (a, b) if set(b) == {""} else (b, a)
    pair = {n: (part, free[""]) if held is a else (free[""], part) for n, part in held.items()}
    return {n: FormulaNode(node.kind, parts, node.at) for n, parts in pair.items()}


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
        return jnp.stack([jnp.broadcast_to(v, (r.size,)) for v in found], axis=-1)

    def _value(self, node: FormulaNode, r: Frame, values: Mapping[str, Any]) -> Any:
        if node.kind == "number":
            return node.parts[0]
        if node.kind == "name":
            return values[node.parts[0]]
        if node.kind == "call" and node.parts[0] in _OF_COLUMNS:
            column = next(c for n, c, _ in self.columns if n == node.parts[1].parts[0])
            if node.parts[0] == "rate":
                return r.rate(column)
            return r.lag(self._value(node.parts[2], r, values), column)
        own = [self._value(part, r, values) for part in node.parts if isinstance(part, FormulaNode)]
        if node.kind == "call":
            return _FUNCTIONS[node.parts[0]](*own)
        if node.kind == "neg":
            return -own[0]
        return _OPERATORS[node.kind](*own)


def _power(base: Any, exponent: Any) -> Any:
    """A whole power by multiplying, of which negative bases have a slope too."""
    whole = isinstance(exponent, float) and exponent.is_integer()
    return base ** (int(exponent) if whole else exponent)


_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    **{"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv},
    "^": _power,
}


def _column(r: Frame, name: str) -> Any:
    return r.elapsed if name == "elapsed" else r[name]


class _CheckedFormula:
    """Units of a formula's parts: literals take the unit that they are added to or compared with."""

    def __init__(
        self, text: str, units: Mapping[str, Dimension | None], shapes: frozenset[str]
    ) -> None:
        self.text, self.units, self.shapes = text, units, shapes

    def of(self, node: FormulaNode) -> tuple[FormulaNode, Dimension | None]:
        """The part with its literals in base units, and its dimension; None for a plain literal."""
        if node.kind == "number":
            return node, None
        if node.kind == "name":
            return node, self.units[node.parts[0]]
        if node.kind == "call":
            return self._call(node)
        if node.kind == "neg":
            inner, unit = self.of(node.parts[0])
            return node._replace(parts=(inner,)), unit
        if node.kind == "^":
            return self._raised(node)
        (a, left), (b, right) = (self.of(part) for part in node.parts)
        if node.kind in "*/":
            sign = 1.0 if node.kind == "*" else -1.0
            unit = (
                None
                if left is None and right is None
                else (left or NUMBER).times(right or NUMBER, sign)
            )
            return node._replace(parts=(a, b)), unit
        a, b, unit = self._alike(a, left, b, right, node.parts[1].at)
        return node._replace(parts=(a, b)), unit

    def _alike(
        self,
        a: FormulaNode,
        left: Dimension | None,
        b: FormulaNode,
        right: Dimension | None,
        at: int,
    ) -> tuple[FormulaNode, FormulaNode, Dimension | None]:
        if left is None or right is None:
            unit = left or right
            factor = 1.0 if unit is None else unit.factor
            a = _times(a, factor) if left is None else a
            b = _times(b, factor) if right is None else b
            return a, b, unit
        if left.powers != right.powers:
            raise refuse(
                self.text, at, f"this is {right}, what it is added to or compared with {left}"
            )
        return a, b, left

    def _raised(self, node: FormulaNode) -> tuple[FormulaNode, Dimension | None]:
        base, unit = self.of(node.parts[0])
        exponent, of = self.of(node.parts[1])
        if of is not None and of.powers:
            raise refuse(
                self.text, node.parts[1].at, f"an exponent is a plain number, this is {of}"
            )
        if unit is None or not unit.powers:
            return node._replace(parts=(base, exponent)), unit if of is None else NUMBER
        value = _literal(exponent)
        if value is None or abs(value) > 10:
            raise refuse(
                self.text, node.parts[1].at, f"of {unit} only a power such as 2 or 0.5 has a unit"
            )
        raised = Dimension(
            tuple((n, p * value) for n, p in unit.powers if value), unit.factor**value
        )
        return node._replace(parts=(base, exponent)), raised

    def _call(self, node: FormulaNode) -> tuple[FormulaNode, Dimension | None]:
        name, *arguments = node.parts
        if name in _OF_COLUMNS:
            column, *rest = arguments
            unit = self.units[column.parts[0]] or Dimension.of("degC")
            if name == "rate":
                if unit.powers != (("K", 1.0),):
                    raise refuse(self.text, column.at, "rate is of a temperature")
                return node, unit.times(Dimension.of("s"), -1.0)
            tau = self.units.get(rest[0].parts[0]) if rest[0].kind == "name" else None
            if tau is None or rest[0].parts[0] not in self.shapes or tau.powers != (("s", 1.0),):
                raise refuse(
                    self.text,
                    rest[0].at,
                    "the second argument of lag is a time constant, such as tau",
                )
            return node, unit
        made = [self.of(argument) for argument in arguments]
        if name in _OF_TWO:
            (a, left), (b, right) = made
            a, b, unit = self._alike(a, left, b, right, arguments[1].at)
            return node._replace(parts=(name, a, b)), unit
        inner, unit = made[0]
        node = node._replace(parts=(name, inner))
        if name == "abs":
            return node, unit
        if name in ("step", "sign"):
            return node, NUMBER
        if name == "sqrt":
            half = (
                None
                if unit is None
                else Dimension(tuple((n, p / 2) for n, p in unit.powers), unit.factor**0.5)
            )
            return node, half
        angle = (
            name in ("sin", "cos", "tan") and unit is not None and unit.powers == (("rad", 1.0),)
        )
        if unit is not None and unit.powers and not angle:
            raise refuse(
                self.text,
                arguments[0].at,
                f"{name} takes a plain number, this is {unit}: divide it by one",
            )
        return node, NUMBER


def _times(node: FormulaNode, factor: float) -> FormulaNode:
    return (
        node
        if factor == 1.0
        else FormulaNode("*", (node, FormulaNode("number", (factor,), node.at)), node.at)
    )


def _literal(node: FormulaNode) -> float | None:
    """The value of a part that is a number, with a sign perhaps."""
    if node.kind == "neg":
        value = _literal(node.parts[0])
        return None if value is None else -value
    if node.kind == "^":
        base, exponent = (_literal(part) for part in node.parts)
        return None if base is None or exponent is None or abs(exponent) > 10 else base**exponent
    return node.parts[0] if node.kind == "number" else None


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
    cos, tan, tanh, min, max, step (1 above zero), rate(column), lag(column, tau); `elapsed` is the time in the run.

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
    name, formula, given = _apart(name, formula, given)
    tree = _Parser(formula).whole()
    own = {n: v for n, v in given.items() if not re.match(r"[-+.\d]", v)}
    columns = _columns(formula, tree, own, given, readings, instrument)
    for node in _inside(tree):
        if node.kind == "call" and node.parts[0] in _OF_COLUMNS:
            of = node.parts[1]
            if of.kind != "name" or of.parts[0] not in columns:
                raise refuse(formula, of.at, f"{node.parts[0]} takes the name of a column")
    unknowns = _names(tree) - set(columns)
    if unused := sorted(set(given) - _names(tree)):
        raise InputError(
            f"effect {name!r}: {', '.join(unused)} is given, and does not stand in {formula!r}"
        )
    bent = set(_bent(tree, unknowns))
    linear = _linear(formula, tree, unknowns - bent)
    if "" in linear:
        near = "" if unknowns else ": write one in front, as s * (…)"
        raise refuse(
            formula,
            linear[""].at,
            f"this is multiplied by no coefficient, whose size would be found{near}",
        )
    shapes = {n: _shape(formula, tree, n, given.get(n)) for n in sorted(bent)}
    units = {n: Dimension.of(unit) if unit else None for n, (_, unit) in columns.items()}
    units |= {n: Dimension.of(s.unit) for n, s in shapes.items()}
    checked = _CheckedFormula(formula, units, frozenset(shapes))
    parts = {n: checked.of(part) for n, part in linear.items()}
    slot, slot_unit, cause = _slot(name, instrument, parts, given)
    used = tuple((n, c, Dimension.of(u or "1").factor) for n, (c, u) in columns.items())
    bases = tuple(part for part, _ in parts.values())
    made = Formula("", bases, used, tuple(shapes))
    scatter = None if readings is None else _scatter(made, readings, shapes)
    coefficients = [
        _coefficient(
            formula,
            n,
            unit,
            slot_unit,
            given.get(n),
            len(parts) > 1,
            None if scatter is None else scatter[i],
        )
        for i, (n, (_, unit)) in enumerate(parts.items())
    ]
    text = _canonical(f"{slot}.{cause}", formula, parts, coefficients, shapes, columns)
    needs = [c if c != "elapsed" else "time" for c, _ in columns.values()]
    past = any(n.kind == "call" and n.parts[0] in _OF_COLUMNS for n in _inside(tree))
    return Effect(
        f"{slot}.{cause}",
        slot,
        basis=Formula(text, bases, used, tuple(shapes)),
        coefficients=tuple(coefficients),
        shapes=tuple(shapes.values()),
        columns=tuple(dict.fromkeys([*needs, *["time"] * past])),
        equation=formula,
        source=source,
    )


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


def _columns(
    formula: str,
    tree: FormulaNode,
    own: Mapping[str, str],
    given: Mapping[str, str],
    readings: Measurements | None,
    instrument: Instrument | None,
) -> dict[str, tuple[str, str]]:
    """Name in the formula → column, and its fixed unit; empty where that is not known yet.

    Raises:
        InputError: the readings have no such column of numbers, or its unit is not known.
    """
    there = dict(_UNITS)
    for column in instrument.columns if instrument else ():
        if column.unit not in (None, ANY) and column.name != "output":
            there[column.name] = str(column.unit)
    if readings is not None:
        there = {
            n: str(readings.unit(n))
            for n in readings.columns
            if readings.unit(n) and n != readings.output
        }
        there |= {"elapsed": "s"} if "time" in there else {}
    found: dict[str, tuple[str, str]] = {}
    for node in (n for n in _inside(tree) if n.kind == "name"):
        called = node.parts[0]
        said = own.get(called, called)
        column, bracket, unit = said.partition("[")
        column = column.strip()
        column = column if column in there or called in own else _ALIASES.get(column, column)
        stated = base_unit(unit.rstrip("] ")) if bracket else ""
        if column in there:
            if stated and Dimension.of(stated).powers != Dimension.of(there[column]).powers:
                raise refuse(
                    formula, node.at, f"{column} is in [{there[column]}], and not in [{stated}]"
                )
            found[called] = column, there[column]
        elif called in own and readings is None:
            found[called] = column, stated
        elif called in own:
            raise refuse(
                formula,
                node.at,
                f"{column!r} is no column of numbers; there are {', '.join(there)}",
            )
        elif called not in given and readings is None and given:
            found[called] = called, ""  # a column, whose unit is looked at with the readings
        elif called not in given and len(called) > 3:
            near = difflib.get_close_matches(called, there, 1, 0.8)
            said = f"there is no column {called!r}"
            if near:
                raise refuse(formula, node.at, f"{said}: is {near[0]!r} meant?")
    return found


def _shape(formula: str, tree: FormulaNode, name: str, said: str | None) -> Shape:
    at = next(n.at for n in _inside(tree) if n.kind == "name" and n.parts[0] == name)
    if said is None:
        raise refuse(
            formula, at, f"how large {name!r} plausibly is, is not said: {name} = 100 to 2000 s"
        )
    if found := _RANGE.fullmatch(said):
        low, high, unit = float(found[1]), float(found[2]), found[3]
    elif (found := _SIZE.fullmatch(said)) and found[2] is None and float(found[1]) > 0:
        low, high, unit = float(found[1]) / MAGNITUDE, float(found[1]) * MAGNITUDE, found[3]
    else:
        raise InputError(f"{name} = {said!r} is no plausible range: write it as 100 to 2000 s")
    factor = parse(unit.strip()).factor if unit else 1.0
    if not 0 < low < high:
        raise InputError(f"{name} = {said!r}: a range goes from a positive number to a larger one")
    return Shape(
        name,
        base_unit(unit.strip()).replace("degC", "delta_degC") if unit else "1",
        low * factor,
        high * factor,
    )


def _slot(
    name: str,
    instrument: Instrument | None,
    parts: Mapping[str, tuple[FormulaNode, Dimension | None]],
    given: Mapping[str, str],
) -> tuple[str, str | None, str]:
    """The slot, its unit where it is known, and the cause."""
    slot, _, cause = name.rpartition(".")
    if instrument is None:
        return slot or "bias", None, cause
    if slot:
        return slot, instrument.slot(slot).unit, cause
    for coefficient, (_, unit) in parts.items():
        size = _SIZE.fullmatch(given.get(coefficient, ""))
        if size and size[3]:
            whole = Dimension.of(size[3].strip()).times(unit or NUMBER)
            for one in instrument.slots:
                if Dimension.of(one.unit).powers == whole.powers:
                    return one.name, one.unit, cause
    first = instrument.slots[0]
    return first.name, first.unit, cause


def _coefficient(
    formula: str,
    name: str,
    unit: Dimension | None,
    slot_unit: str | None,
    said: str | None,
    several: bool,
    size: float | None,
) -> Coefficient:
    """A coefficient with its prior, its unit such that the product is in that of the slot."""
    own = unit or NUMBER
    part = name if several else ""
    if said is None:
        if size is None or slot_unit is None:
            raise InputError(
                f"effect {formula!r}: how large {name!r} plausibly is, is not said: {name} = 0.1 mV/V"
            )
        text = "/".join([slot_unit, *(_raised(n, p) for n, p in own.powers)])
        return Coefficient(
            text, Normal(0.0, float(f"{size / coefficient_factor(text, slot_unit):.2g}")), part
        )
    found = _SIZE.fullmatch(said)
    if not found:
        raise InputError(
            f"{name} = {said!r} is no size with a unit: write it as 0.1 mV/V, or as 0.5 ± 0.1 mV/V"
        )
    text = (found[3] or "1").strip()
    mean, sd = (float(found[1]), float(found[2])) if found[2] else (0.0, abs(float(found[1])))
    if not sd > 0:
        raise InputError(f"{name} = {said!r}: a size is not zero")
    if slot_unit is not None:
        whole = Dimension.of(text).times(own)
        wanted = Dimension.of(slot_unit)
        if whole.powers != wanted.powers:
            raise InputError(
                f"effect {formula!r}: {name} in {text} makes it {whole}, and it adds to what is {wanted}: correct "
                f"the unit of {name}"
            )
    return Coefficient(text, Normal(mean, sd), part)


def _raised(name: str, power: float) -> str:
    name = "degC" if name == "K" else name
    return name if power == 1 else f"({name}^{power:g})"


def _scatter(made: Formula, readings: Measurements, shapes: Mapping[str, Shape]) -> list[float]:
    """Size of each coefficient at which its term varies as much as the output does, base units of the output."""
    frame = build_frame(readings, reference_of(readings))
    middle = {n: math.sqrt(s.low * s.high) for n, s in shapes.items()}
    columns = np.asarray(made(frame, **middle))
    spread = float(np.std(readings[readings.output]))
    sizes = np.std(columns, axis=0)
    sizes = np.where(sizes > 0, sizes, np.abs(columns).max(axis=0))
    return [spread / s if s > 0 and math.isfinite(s) else spread for s in sizes.tolist()]


def _canonical(
    name: str,
    formula: str,
    parts: Mapping[str, Any],
    coefficients: list[Coefficient],
    shapes: Mapping[str, Shape],
    columns: Mapping[str, tuple[str, str]],
) -> str:
    """The whole in one line, from which it can be made again without readings."""
    pieces = [
        f"{n} = {f'{c.mean!r} ± ' if c.mean else ''}{c.size!r} {c.unit}"
        for n, c in zip(parts, coefficients, strict=True)
    ]
    pieces += [f"{n} = {s.low!r} to {s.high!r} {s.unit}" for n, s in shapes.items()]
    for n, (c, u) in columns.items():
        if n != c or n not in _UNITS:
            called = n if n.isidentifier() else f"`{n}`"
            pieces.append(f"{called} = {c}" + (f" [{u}]" if u else ""))
    return "; ".join([f"{name}: {formula}", *pieces])


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
