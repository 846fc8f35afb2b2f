"""An effect from one typed line: "supply: s * (supply_voltage - 5); s = 0.1 mV/V".

Python's parser reads the line, and of its tree only names, numbers and the functions in `_FUNCTIONS` are accepted. In
one pass each part becomes a linear form of the unknowns that the formula is linear in, its coefficients, with its
unit; the other unknowns are shapes.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayescal._core.errors import InputError, ModelError
from bayescal._core.xp import xp
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import (
    ANY,
    NUMBER,
    ParsedUnit,
    base_unit,
    coefficient_factor,
    convert,
    parse,
)
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame, build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.prior import Known, Normal

MAX_LENGTH = 500  # characters: no line nests deeper than Python recurses
TINY = float(np.finfo(float).tiny)  # below which numbers lose digits
RANGE_FACTOR = 10.0  # a shape given by one value lies between a tenth and ten times that
_ALIASES = {"T": "temperature", "t": "time"}
_UNITS = {"time": "s", "elapsed": "s", "temperature": "degC"}  # known without readings
_ATOM = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<function>[^\W\d]\w*(?=\s*\())|(?P<name>[^\W\d]\w*)"
    r"|`(?P<quoted>[^`]+)`|(?P<sign>\*\*|[-+*/^(),])|(?P<other>\S)"
)
_ASSIGNMENT = re.compile(r"\s*([^\W\d]\w*|`[^`]+`)\s*=\s*(.*\S)\s*")
_VALUE = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SIZE = re.compile(rf"({_VALUE})(?:\s*(?:±|\+-|\+/-)\s*({_VALUE}))?\s*(\D.*)?")
_RANGE = re.compile(rf"({_VALUE})\s*(?:…|\.\.\.?|to|-)\s*({_VALUE})\s*(\D.*)?")


def _power(base: Any, exponent: Any) -> Any:
    """Raise to a power; an integer one by multiplication, so that negative bases have a slope too."""
    whole = isinstance(exponent, float) and exponent.is_integer()
    return base ** (int(exponent) if whole else exponent)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{"exp": xp.exp, "log": xp.log, "sqrt": xp.sqrt, "abs": xp.abs, "sign": xp.sign},
    **{"sin": xp.sin, "cos": xp.cos, "tan": xp.tan, "tanh": xp.tanh},
    **{"min": xp.minimum, "max": xp.maximum, "step": lambda x: xp.where(x > 0, 1.0, 0.0)},
}
_OPERATORS: dict[str, Callable[..., Any]] = {
    **{"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv},
    **{"^": _power, "neg": operator.neg},
}
_COMPUTED = {**_FUNCTIONS, **_OPERATORS}
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}
# Functions of a column's past, and their numbers of arguments: dT/dt; T̃ and T̃ − T, with τ·dT̃/dt = T − T̃.
_PAST = {"rate": 1, "body": 2, "lag_difference": 2}
_OF_TWO = ("min", "max")
_COUNTS = {**dict.fromkeys(_FUNCTIONS, 1), **dict.fromkeys(_OF_TWO, 2), **_PAST}
_VALUES = ast.Name | ast.Constant | ast.BinOp | ast.UnaryOp | ast.Call
_PARTS = _VALUES | ast.operator | ast.unaryop | ast.Load


class FormulaPart(NamedTuple):
    """A part of a formula, its numbers in base units."""

    tree: Any  # a number, a name, or a function (an operator by its sign, "neg") with its arguments
    # its dimension; None of a literal, which takes that of what it is added to or compared with
    unit: ParsedUnit | None
    at: int  # where it begins in the line

    def like(self, other: FormulaPart) -> FormulaPart:
        """Return the part, a literal in the unit of another."""
        if self.unit is not None or other.unit is None or other.unit.factor == 1.0:
            return self
        return self._replace(tree=("*", self.tree, other.unit.factor))


Linear = dict[str, FormulaPart]  # factor of each coefficient; "" for a part without one


@dataclass(frozen=True)
class Formula:
    """The basis of a typed effect, in base units: called with readings and the shapes."""

    text: str  # the line that it was made of, with sizes and units
    parts: tuple[Any, ...]  # the factor of each coefficient, as `FormulaPart.tree`
    # name in the formula → the readings' column and its factor to base units
    columns: tuple[tuple[str, str, float], ...]
    shapes: tuple[str, ...] = ()  # names of the shapes

    @property
    def __signature__(self) -> inspect.Signature:
        kinds = inspect.Parameter
        keywords = [kinds(n, kinds.KEYWORD_ONLY) for n in self.shapes]
        return inspect.Signature([kinds("r", kinds.POSITIONAL_OR_KEYWORD), *keywords])

    def __call__(self, r: Frame, **shapes: Any) -> Any:
        values = {
            name: factor * (r.elapsed if column == "elapsed" else r[column])
            for name, column, factor in self.columns
        }
        columns = [self._value(tree, r, {**values, **shapes}) for tree in self.parts]
        return xp.stack([xp.broadcast_to(v, (r.size,)) for v in columns], axis=-1)

    def _value(self, tree: Any, r: Frame, values: Mapping[str, Any]) -> Any:
        if not isinstance(tree, tuple):
            return values[tree] if isinstance(tree, str) else tree
        function, *arguments = tree
        if function in _PAST:
            of, *tau = arguments
            column, factor = next((c, f) for n, c, f in self.columns if n == of)
            if function == "rate":
                return r.rate(column)
            behind = factor * r.lag(values[tau[0]], column)
            return behind if function == "lag_difference" else values[of] + behind
        operands = [self._value(argument, r, values) for argument in arguments]
        return _COMPUTED[function](*operands)


def effect(
    name: str,
    formula: str = "",
    *,
    readings: Measurements | None = None,
    instrument: Instrument | None = None,
    source: str = "the user's own",
    **stated: str,
) -> Effect:
    """Make an effect from a typed formula.

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
        readings: whose columns it uses: gives units, and sizes that are not stated. Without, units are checked when a
            model meets readings; they may be stated: V="supply_voltage [V]".
        instrument: whose slots it may add to.
        source: where the formula is from.
        stated: size of each coefficient ("0.1 mV/V", or "0.5 ± 0.1 mV/V" about another mean than zero); range of each
            shape ("100 to 2000 s", or one value for a tenth to ten times that); columns under other names.

    Raises:
        InputError: the formula is none, its units do not go together, or a size is missing; the place is marked with ▸.
    """
    return _TypedLine(name, formula, stated, readings, instrument).effect(source)


def _split(name: str, formula: str, stated: Mapping[str, str]) -> tuple[str, str, dict[str, str]]:
    """Split a line into name, formula and definitions, where all stand in one text.

    Raises:
        InputError: there is no formula, or something behind a semicolon is no assignment.
    """
    stated = {n: str(v).strip() for n, v in stated.items()}
    if not formula:
        name, colon, tail = name.partition(":")
        formula, *assignments = tail.split(";") if colon else ("",)
        for assignment in filter(str.strip, assignments):
            if not (match := _ASSIGNMENT.fullmatch(assignment)):
                why = f"effect {name!r}: {assignment.strip()!r} is not of the form s = 0.1 mV/V"
                raise InputError(why)
            stated[match[1].strip("`")] = match[2]
    name, formula = name.strip(), formula.strip()
    if not formula or not re.fullmatch(r"[^\W\d]\w*(?:\.\w+)?", name):
        raise InputError(
            f"effect {name[:60]!r} has no name and formula: write it as 'supply: s * (supply_voltage - 5); s = 1 mV/V'"
        )
    return name, formula, stated


class _TypedLine:
    """A formula with the definitions of its names, and the readings or instrument that it is for."""

    def __init__(
        self,
        name: str,
        formula: str,
        stated: Mapping[str, str],
        readings: Measurements | None,
        instrument: Instrument | None,
    ) -> None:
        self.name, self.text, self.stated = _split(name, formula, stated)
        self.readings, self.instrument = readings, instrument
        tree = self.parsed()
        self.first = dict[str, int]()  # where each name stands first
        for at, word in sorted(self.named(tree)):
            self.first.setdefault(word, at)
        # Name in the formula → column, and its fixed unit; empty where that is not known yet.
        self.columns = self._columns()
        if unused := sorted(set(self.stated) - set(self.first)):
            raise InputError(
                f"effect {self.name!r}: {', '.join(unused)} is given, and does not stand in {self.text!r}"
            )
        unknowns = set(self.first) - set(self.columns)
        nonlinear = {name for part in _nonlinear(tree) for _, name in self.named(part)} & unknowns
        self.shapes = {n: self._shape(n, tree) for n in sorted(nonlinear)}
        self.units = {n: parse(u) if u else None for n, (_, u) in self.columns.items()}
        self.units |= {n: parse(s.unit) for n, s in self.shapes.items()}
        self.coefficients = self.linear(tree)  # factor of each other unknown
        if "" in self.coefficients:
            near = "" if unknowns else ": write one in front, as s * (…)"
            why = f"this is multiplied by no coefficient, whose size would be found{near}"
            raise self.refusal(self.coefficients[""].at, why)

    def refusal(self, at: int, why: str) -> InputError:
        return InputError(f"effect {self.text[:at]!r} ▸ {self.text[at:]!r}: {why}")

    def parsed(self) -> ast.expr:
        """Parse the formula to Python's tree, its names by their key in `names`.

        Raises:
            InputError: it is none; the place is marked.
        """
        if len(self.text) > MAX_LENGTH:
            raise InputError(f"a formula of {len(self.text)} characters: {MAX_LENGTH} at most")
        # Python reads operators, numbers, functions that there are, and each other name as n0, n1, …: no keyword.
        self.names, self.places, source = dict[str, str](), list[int](), ""
        for token in _ATOM.finditer(self.text):
            kind = str(token.lastgroup)
            word, at = token[kind], token.start(kind)
            if kind == "other":
                raise self.refusal(at, f"{word!r} has no meaning in a formula")
            if kind == "function" and word not in _COUNTS:
                message = f"there is no function {word!r}; there are {', '.join(_COUNTS)}"
                raise self.refusal(at, message)
            if kind == "number":
                word = repr(_number(word, partial(self.refusal, at)))
            elif kind in ("name", "quoted"):
                key = f"n{len(self.names)}"
                self.names[key], word = word, key
            source += word.replace("^", "**") + " "
            self.places += [at] * (len(source) - len(self.places))
        try:
            tree = ast.parse(source, mode="eval").body
        except (SyntaxError, MemoryError, RecursionError) as error:
            column = (getattr(error, "offset", None) or 1) - 1
            at = self.places[column] if column < len(self.places) else len(self.text)
            why = "this makes no formula: is an operator, a number, a name or a bracket missing?"
            raise self.refusal(at, why) from None
        for node in ast.walk(tree):
            if not isinstance(node, _PARTS):
                raise self.refusal(self.at(node), "this has no meaning in a formula")
            if isinstance(node, ast.Call) and len(node.args) != (
                count := _COUNTS.get(_function(node), 0)
            ):
                why = f"{_function(node)} takes {count} argument{'s' * (count > 1)}"
                raise self.refusal(self.at(node), why)
        self.of_past = any(isinstance(n, ast.Name) and n.id in _PAST for n in ast.walk(tree))
        return tree

    def at(self, node: Any) -> int:
        """Return the position of a part in the line, without brackets around it."""
        while isinstance(node, ast.BinOp):
            node = node.left
        return self.places[node.col_offset]

    def named(self, *parts: ast.expr) -> list[tuple[int, str]]:
        """Return the names in parts of the formula, functions left out, each with its place."""
        nodes = [n for part in parts for n in ast.walk(part) if isinstance(n, ast.Name)]
        return [(self.at(n), self.names[n.id]) for n in nodes if n.id in self.names]

    def applied(self, function: str, unit: ParsedUnit | None, *parts: FormulaPart) -> FormulaPart:
        """Apply a function to parts; to literals alone, its value.

        Raises:
            InputError: it has none: a division by zero, the root of a negative number, a number too large or too small.
        """
        at, trees = parts[0].at, [part.tree for part in parts]
        if not all(isinstance(tree, float) for tree in trees):
            return FormulaPart((function, *trees), unit, at)
        try:
            with np.errstate(all="raise"):
                value = float(_COMPUTED[function](*map(np.float64, trees)))
        except FloatingPointError as error:
            raise self.refusal(at, f"this number has no value: {error}") from None
        return FormulaPart(value, None, at)

    def linear(self, node: ast.expr) -> Linear:
        """Return the factor of each coefficient of a part."""
        at = self.at(node)
        match node:
            case ast.Constant():
                return {"": FormulaPart(float(node.value), None, at)}
            case ast.Name():
                name = self.names[node.id]
                if name in self.units:
                    return {"": FormulaPart(name, self.units[name], at)}
                return {name: FormulaPart(1.0, None, at)}
            case ast.UnaryOp():
                negative = False
                while isinstance(node, ast.UnaryOp):
                    negative, node = negative ^ isinstance(node.op, ast.USub), node.operand
                parts = self.linear(node)
                if negative:
                    parts = {n: self._negative(part) for n, part in parts.items()}
                return {n: part._replace(at=at) for n, part in parts.items()}
            case ast.BinOp():
                sides = self.linear(node.left), self.linear(node.right)
                return self._joined(_SIGNS[type(node.op)], *sides)
        assert isinstance(node, ast.Call)
        return {"": self._called(_function(node), node.args)._replace(at=at)}

    def _negative(self, part: FormulaPart) -> FormulaPart:
        return self.applied("neg", part.unit, part)

    def _joined(self, sign: str, a: Linear, b: Linear) -> Linear:
        """Combine two linear forms by an operator."""
        if sign in "+-":
            for name, part in b.items():
                if name in a:
                    a[name] = self._compared(sign, a[name], part)
                else:
                    a[name] = part if sign == "+" else self._negative(part)
            return a
        if set(b) == {""}:
            return {n: self._multiplied(sign, part, b[""]) for n, part in a.items()}
        if set(a) == {""}:
            return {n: self._multiplied(sign, a[""], part) for n, part in b.items()}
        both = sorted({*a, *b} - {""})
        unsaid = [n for n in both if n not in self.stated]
        at = next(iter(a.values())).at
        if self.readings is not None and len(unsaid) == 1 < len(both):
            raise self.refusal(at, self._no_column(unsaid[0]))
        why = f"{' and '.join(both)} multiply each other: only their product could be told"
        if self.readings is not None and unsaid:
            why += f". {' and '.join(map(self._no_column, unsaid))}"
        raise self.refusal(at, why)

    def _compared(self, function: str, a: FormulaPart, b: FormulaPart) -> FormulaPart:
        """Apply a function that adds or compares to two parts, which have one unit."""
        if a.unit is not None and b.unit is not None and a.unit.powers != b.unit.powers:
            why = f"this is {b.unit}, what it is added to or compared with {a.unit}"
            raise self.refusal(b.at, why)
        return self.applied(function, a.unit or b.unit, a.like(b), b.like(a))

    def _multiplied(self, sign: str, a: FormulaPart, b: FormulaPart) -> FormulaPart:
        if sign != "^":
            plain = a.unit is None and b.unit is None
            whole = (a.unit or NUMBER).times(b.unit or NUMBER, 1.0 if sign == "*" else -1.0)
            return self.applied(sign, None if plain else whole, a, b)
        if b.unit is not None and b.unit.powers:
            raise self.refusal(b.at, f"an exponent is a plain number, this is {b.unit}")
        unit = a.unit
        if unit is not None and unit.powers:
            if not isinstance(b.tree, float) or abs(b.tree) > 10:
                raise self.refusal(b.at, f"of {unit} only a power such as 2 or 0.5 has a unit")
            unit = NUMBER.times(unit, b.tree)
        elif b.unit is not None:
            unit = NUMBER
        return self.applied(sign, unit, a, b)

    def _called(self, name: str, arguments: list[ast.expr]) -> FormulaPart:
        if name in _PAST:
            return self._of_past(name, *arguments)
        a, *others = (self.linear(argument)[""] for argument in arguments)
        if others:
            return self._compared(name, a, *others)
        unit = a.unit
        if name not in ("abs", "sqrt"):
            powers = {} if unit is None or name in ("step", "sign") else unit.powers
            if powers and not (name in ("sin", "cos", "tan") and powers == {"rad": 1.0}):
                why = f"{name} takes a plain number, this is {unit}: divide it by one"
                raise self.refusal(a.at, why)
            unit = NUMBER
        elif name == "sqrt":
            unit = unit and NUMBER.times(unit, 0.5)
        return self.applied(name, unit, a)

    def _of_past(self, function: str, of: ast.expr, *tau: ast.expr) -> FormulaPart:
        column, *times = (self.names.get(getattr(n, "id", "")) for n in (of, *tau))
        if column not in self.columns:
            raise self.refusal(self.at(of), f"{function} takes the name of a column")
        unit = self.units[column] or parse("degC")
        if function == "rate":
            if unit.powers != {"K": 1.0}:
                raise self.refusal(self.at(of), "rate is of a temperature")
            unit = unit.times(parse("s"), -1.0)
        elif times[0] not in self.shapes or self.units[times[0]].powers != {"s": 1.0}:
            why = f"the second argument of {function} is a time constant, such as tau"
            raise self.refusal(self.at(tau[0]), why)
        return FormulaPart((function, column, *times), unit, self.at(of))

    # definitions of its names -----------------------------------------------------------------------------------

    def _no_column(self, name: str) -> str:
        """Return the message that the readings have no column of a name, with those that they have."""
        assert self.readings is not None
        has = ", ".join(self.available)
        return f"{name!r} is not a column of numbers of {self.readings.file} (it has: {has})"

    def _columns(self) -> dict[str, tuple[str, str]]:
        """Match names to columns of the readings: name → column and unit.

        Raises:
            InputError: the readings have no such column of numbers, or its unit is not known.
        """
        readings, texts = self.readings, self.stated
        columns = self.instrument.columns if self.instrument else ()
        declared = {c.name: c.unit for c in columns if c.name != "output"}
        table = {**_UNITS, **{n: u for n, u in declared.items() if u not in (None, ANY)}}
        if readings is not None:
            units = {n: readings.unit(n) for n in readings.columns if n != readings.output}
            table = {n: unit for n, unit in units.items() if unit}
            table |= {"elapsed": "s"} if "time" in table else {}
        self.available = table
        renamed = {n: v for n, v in texts.items() if not re.match(r"[-+.\d]", v)}
        pairs: dict[str, tuple[str, str]] = {}
        for name, at in self.first.items():
            column, bracket, unit = renamed.get(name, name).partition("[")
            column = column.strip()
            column = column if column in table or name in renamed else _ALIASES.get(column, column)
            stated, unsaid = base_unit(unit.rstrip("] ")) if bracket else "", name not in texts
            if column in table:
                if stated and parse(stated).powers != parse(table[column]).powers:
                    raise self.refusal(
                        at, f"{column} is in [{table[column]}], and not in [{stated}]"
                    )
                pairs[name] = column, table[column]
            elif readings is None and (name in renamed or (texts and unsaid)):
                pairs[name] = column if name in renamed else name, stated  # looked at with readings
            elif readings is not None and (name in renamed or (unsaid and column in declared)):
                raise self.refusal(at, self._no_column(column))
            elif (
                unsaid
                and len(name) > 3
                and (near := difflib.get_close_matches(name, table, 1, 0.8))
            ):
                raise self.refusal(at, f"there is no column {name!r}: is {near[0]!r} meant?")
        return pairs

    def _shape(self, name: str, tree: ast.expr) -> Shape:
        text = self.stated.get(name)
        if text is None:
            why = f"how large {name!r} plausibly is, is not said: {name} = 100 to 2000 s"
            why = why if self.readings is None else f"{self._no_column(name)}, and {why}"
            raise self.refusal(self.first[name], why)
        if match := _RANGE.fullmatch(text):
            low, high, unit = _number(match[1]), _number(match[2]), match[3]
        elif (match := _SIZE.fullmatch(text)) and match[2] is None and float(match[1]) > 0:
            value, unit = _number(match[1]), match[3]
            low, high = value / RANGE_FACTOR, value * RANGE_FACTOR
        else:
            raise InputError(f"{name} = {text!r} is no plausible range: write it as 100 to 2000 s")
        unit = (unit or "1").strip()
        # What is added to a column or compared with it is a place along it: 50 degF is 10 °C, and may be negative.
        compared = (getattr(p, "id", "") for node in ast.walk(tree) for p in _compared(node))
        place = any(self.names.get(key) == name for key in compared)
        if not (low < high and (low > 0 or place)):
            why = f"{name} = {text!r}: a range goes from a positive number to a larger one"
            raise InputError(why)
        base = "1"
        if unit != "1":
            fixed = base_unit(unit)
            low, high = (float(convert(v, unit, fixed, difference=not place)) for v in (low, high))
            base = re.sub(r"(?<!delta_)degC", "delta_degC", fixed)
        return Shape(name, base, low, high, "log" if low > 0 else "linear")

    def effect(self, source: str) -> Effect:
        """Return the effect, with sizes as stated, or estimated from the readings."""
        slot, slot_unit, cause = self._slot()
        name, basis = f"{slot}.{cause}", self._basis("")
        sizes = [None] * len(basis.parts)
        if self.readings is not None:
            sizes = _scatter(basis, self.readings, self.shapes)
        pairs = zip(self.coefficients.items(), sizes, strict=True)
        coefficients = tuple(self._coefficient(n, p.unit, slot_unit, s) for (n, p), s in pairs)
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
        used = tuple((n, c, parse(u or "1").factor) for n, (c, u) in self.columns.items())
        parts = tuple(part.tree for part in self.coefficients.values())
        return Formula(text, parts, used, tuple(self.shapes))

    def _slot(self) -> tuple[str, str | None, str]:
        """Return the slot, its unit where it is known, and the cause."""
        slot, _, cause = self.name.rpartition(".")
        if self.instrument is None:
            return slot or "bias", None, cause
        if slot:
            return slot, self.instrument.slot(slot).unit, cause
        chosen = self.instrument.slots[0]
        for name, part in self.coefficients.items():
            size = _SIZE.fullmatch(self.stated.get(name, ""))
            if size and size[3]:
                whole = parse(size[3].strip()).times(part.unit or NUMBER).powers
                fitting = (s for s in self.instrument.slots if parse(s.unit).powers == whole)
                if slot_found := next(fitting, None):
                    chosen = slot_found
                    break
        return chosen.name, chosen.unit, cause

    def _coefficient(
        self, name: str, unit: ParsedUnit | None, slot_unit: str | None, size: float | None
    ) -> Coefficient:
        """Return a coefficient with its prior, its unit such that the product is in that of the slot."""
        basis_unit, stated = unit or NUMBER, self.stated.get(name)
        part = name if len(self.coefficients) > 1 else ""
        if stated is None:
            if size is None or slot_unit is None:
                raise InputError(
                    f"effect {self.text!r}: how large {name!r} plausibly is, is not said: {name} = 0.1 mV/V"
                )
            divided = (("degC" if n == "K" else n, p) for n, p in sorted(basis_unit.powers.items()))
            powers = (n if p == 1 else f"({n}^{p:g})" for n, p in divided)
            text = "/".join([slot_unit, *powers])
            rounded = _number(f"{size / coefficient_factor(text, slot_unit):.2g}")
            return Coefficient(text, Normal(0.0, rounded), part)
        if not (match := _SIZE.fullmatch(stated)):
            raise InputError(
                f"{name} = {stated!r} is no size with a unit: write it as 0.1 mV/V, or as 0.5 ± 0.1 mV/V"
            )
        text = (match[3] or "1").strip()
        sd, mean = abs(_number(match[2] or match[1])), _number(match[1]) if match[2] else 0.0
        prior = Normal(mean, sd) if sd > 0 else Known(mean)  # 1 ± 0: a number, and no unknown
        if not (sd > 0 or mean):
            raise InputError(f"{name} = {stated!r}: a size is not zero")
        whole = parse(text).times(basis_unit)
        if slot_unit is not None and whole.powers != (target := parse(slot_unit)).powers:
            raise InputError(
                f"effect {self.text!r}: {name} in {text} makes it {whole}, and it adds to what is {target}: correct "
                f"the unit of {name}"
            )
        return Coefficient(text, prior, part)

    def _canonical(self, name: str, coefficients: tuple[Coefficient, ...]) -> str:
        """Format the effect as one line, from which it can be made again without readings."""
        pieces = [f"{name}: {self.text}"]
        for n, c in zip(self.coefficients, coefficients, strict=True):
            pieces.append(f"{n} = {f'{c.mean!r} ± ' if c.mean else ''}{c.size!r} {c.unit}")
        pieces += [f"{n} = {s.low!r} to {s.high!r} {s.unit}" for n, s in self.shapes.items()]
        for n, (c, u) in self.columns.items():
            if n != c or n not in _UNITS:
                called = n if n.isidentifier() else f"`{n}`"
                pieces.append(f"{called} = {c}" + (f" [{u}]" if u else ""))
        return "; ".join(pieces)


def _function(node: ast.Call) -> str:
    return getattr(node.func, "id", "")


def _compared(node: ast.AST) -> list[ast.expr]:
    """Return the parts of a sum or a comparison."""
    match node:
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            return [node.left, node.right]
        case ast.Call() if _function(node) in _OF_TWO:
            return node.args
    return []


def _nonlinear(tree: ast.expr) -> Iterator[ast.expr]:
    """Yield the parts in which a formula is not linear: arguments, divisors, powers."""
    for node in ast.walk(tree):
        match node:
            case ast.Call():
                yield from node.args
            case ast.BinOp(op=ast.Pow()):
                yield node
            case ast.BinOp(op=ast.Div()):
                yield node.right


def _number(text: str, refusal: Callable[[str], InputError] = InputError) -> float:
    """Parse a number.

    Raises:
        InputError: by `refusal`: it is too large, or too small, for a computer's numbers.
    """
    value, is_zero = float(text), not re.search("[1-9]", text.lower().split("e")[0])
    if math.isfinite(value) and (abs(value) >= TINY or is_zero):
        return value
    raise refusal(f"{text} is a number too {'large' if abs(value) > 1 else 'small'}")


def _scatter(formula: Formula, readings: Measurements, shapes: Mapping[str, Shape]) -> list[float]:
    """Return the size of each coefficient at which its term varies as the output does, base units of the output."""
    frame = build_frame(readings, reference_of(readings))
    middle = {n: float(s.prior.value(np.float64(0.0))) for n, s in shapes.items()}
    with np.errstate(all="ignore"):  # what is not finite is refused where it meets the readings
        columns = np.asarray(formula(frame, **middle))
        sizes = np.std(columns, axis=0)
    spread = float(np.std(readings[readings.output]))
    sizes = np.where(sizes > 0, sizes, np.abs(columns).max(axis=0))
    return [spread / s if s > 0 and math.isfinite(s) else spread for s in sizes.tolist()]


def require_units(effect_: Effect, readings: Measurements, instrument: Instrument) -> None:
    """Raise ModelError for readings or a slot in other units than those that a typed effect was made for.

    Raises:
        ModelError: a column, or the whole, is in another unit.
    """
    basis = effect_.basis
    if not isinstance(basis, Formula):
        return
    try:
        again = effect(basis.text, readings=readings, instrument=instrument)
    except InputError as error:
        raise ModelError(str(error)) from None
    assert isinstance(again.basis, Formula)
    if (again.basis.parts, again.basis.columns) != (basis.parts, basis.columns):
        raise ModelError(
            f"Effect {effect_.name!r} was typed for columns in other units than these readings have: type it with "
            f"readings=, or say their units ({basis.text})"
        )
