"""Parse an effect from one line of text: "supply: s * (supply_voltage - 5); s = 0.1 mV/V".

The line is parsed by Python's `ast`; only names, numbers and the functions in `_FUNCTIONS` are accepted. One recursive
pass converts each subexpression to a linear form Σ coefficient × factor with units; nonlinear unknowns are shapes.
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
from bayescal._data import unit_conversion as uc
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import UNITY, ParsedUnit, base_unit, convert, parse
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame, build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.prior import Known, Normal

MAX_FORMULA_LENGTH = 500  # characters: it cannot nest deeper than Python's recursion limit
MIN_NORMAL = float(np.finfo(float).tiny)  # smallest normal number
RANGE_FACTOR = 10.0  # plausible range of a shape given by one value: value/10 to 10·value
_ALIASES = {"T": "temperature", "t": "time"}
_UNITS = {"time": "s", "elapsed": "s", "temperature": "degC"}  # units without readings
_TOKEN_REGEX = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<function>[^\W\d]\w*(?=\s*\())|(?P<name>[^\W\d]\w*)"
    r"|`(?P<quoted>[^`]+)`|(?P<sign>\*\*|[-+*/^(),])|(?P<other>\S)"
)
_ASSIGNMENT_REGEX = re.compile(r"\s*([^\W\d]\w*|`[^`]+`)\s*=\s*(.*\S)\s*")
_NUMBER_REGEX = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SIZE_REGEX = re.compile(rf"({_NUMBER_REGEX})(?:\s*(?:±|\+-|\+/-)\s*({_NUMBER_REGEX}))?\s*(\D.*)?")
_RANGE_REGEX = re.compile(rf"({_NUMBER_REGEX})\s*(?:…|\.\.\.?|to|-)\s*({_NUMBER_REGEX})\s*(\D.*)?")


def _raise_to_power(base: Any, exponent: Any) -> Any:
    """Raise `base` to a power; integer exponents are passed as int, so that negative bases are differentiable."""
    is_integer = isinstance(exponent, float) and exponent.is_integer()
    return base ** (int(exponent) if is_integer else exponent)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{"exp": xp.exp, "log": xp.log, "sqrt": xp.sqrt, "abs": xp.abs, "sign": xp.sign},
    **{"sin": xp.sin, "cos": xp.cos, "tan": xp.tan, "tanh": xp.tanh},
    **{"min": xp.minimum, "max": xp.maximum, "step": lambda x: xp.where(x > 0, 1.0, 0.0)},
}
_OPERATORS: dict[str, Callable[..., Any]] = {
    **{"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv},
    **{"^": _raise_to_power, "neg": operator.neg},
}
_IMPLEMENTATIONS = {**_FUNCTIONS, **_OPERATORS}
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}
# Functions of a column's time series → number of arguments: dT/dt; T̃ and T̃ − T, with τ·dT̃/dt = T − T̃.
_HISTORY = {"rate": 1, "body": 2, "lag_difference": 2}
_BINARY = ("min", "max")
_ARGUMENT_COUNTS = {**dict.fromkeys(_FUNCTIONS, 1), **dict.fromkeys(_BINARY, 2), **_HISTORY}
_VALUE_NODES = ast.Name | ast.Constant | ast.BinOp | ast.UnaryOp | ast.Call
_ALLOWED_NODES = _VALUE_NODES | ast.operator | ast.unaryop | ast.Load


class FormulaPart(NamedTuple):
    """Subexpression of a formula, with its unit and position; numbers are in base units."""

    tree: Any  # a number, a name, or a tuple (function or operator sign, *arguments)
    unit: ParsedUnit | None  # None for a literal, which takes the unit of the other operand
    start: int  # index of its first character in the line

    def match_unit(self, other: FormulaPart) -> FormulaPart:
        """Return a literal converted to the unit of another operand; any other subexpression unchanged."""
        if self.unit is not None or other.unit is None or other.unit.factor == 1.0:
            return self
        return self._replace(tree=("*", self.tree, other.unit.factor))


LinearForm = dict[str, FormulaPart]  # coefficient → factor; "" → term without coefficient


@dataclass(frozen=True)
class Formula:
    """Basis function of an effect stated as a formula; its arguments are a frame and shapes, all in base units."""

    text: str  # the canonical line, with sizes and units
    parts: tuple[Any, ...]  # the factor of each coefficient, as `FormulaPart.tree`
    columns: tuple[tuple[str, str, float], ...]  # name in the formula, column, factor to base units
    shapes: tuple[str, ...] = ()  # names of the shapes

    @property
    def __signature__(self) -> inspect.Signature:
        parameter = inspect.Parameter
        keywords = [parameter(n, parameter.KEYWORD_ONLY) for n in self.shapes]
        return inspect.Signature([parameter("frame", parameter.POSITIONAL_OR_KEYWORD), *keywords])

    def __call__(self, frame: Frame, **shapes: Any) -> Any:
        values = {
            name: factor * (frame.elapsed if column == "elapsed" else frame[column])
            for name, column, factor in self.columns
        }
        columns = [self._evaluate_tree(tree, frame, {**values, **shapes}) for tree in self.parts]
        return xp.stack([xp.broadcast_to(v, (frame.size,)) for v in columns], axis=-1)

    def _evaluate_tree(self, tree: Any, frame: Frame, values: Mapping[str, Any]) -> Any:
        if not isinstance(tree, tuple):
            return values[tree] if isinstance(tree, str) else tree
        function, *arguments = tree
        if function in _HISTORY:
            name, *tau = arguments
            column, factor = next((c, f) for n, c, f in self.columns if n == name)
            if function == "rate":
                return frame.rate(column)
            lag = factor * frame.lag(values[tau[0]], column)
            return lag if function == "lag_difference" else values[name] + lag
        operands = [self._evaluate_tree(argument, frame, values) for argument in arguments]
        return _IMPLEMENTATIONS[function](*operands)


def effect(
    name: str,
    formula: str = "",
    *,
    readings: Measurements | None = None,
    instrument: Instrument | None = None,
    source: str = "the user's own",
    **definitions: str,
) -> Effect:
    """Parse an effect from a formula.

        bc.effect("supply", "s * (V - 5) / V", s="0.1 mV/V", V="supply_voltage [V]")
        bc.effect("bias.supply: s * (supply_voltage - 5); s = 0.1 mV/V", readings=readings)

    Names are columns of the readings, in their fixed units; any other name is an unknown. An unknown in which the
    formula is linear is a coefficient with the prior zero ± its size; any other is a shape with a plausible range.
    A number added to a column is in its unit. Operators and functions: + - * / ^, brackets, exp, log, sqrt, abs, sign,
    sin, cos, tan, tanh, min, max, step (1 above zero); `elapsed` is the time in the run. Functions of a column's
    history: rate(T) = dT/dt; body(T, tau) = T̃, the temperature of a body that follows T with τ·dT̃/dt = T − T̃, from T
    at a run's first reading; and lag_difference(T, tau) = T̃ − T.

    Args:
        name: name of the effect, `slot.cause`, or its cause alone: the slot is then the first whose unit fits. It may
            be the whole line instead: "name: formula; s = 0.1 mV/V".
        formula: expression, such as "s * (supply_voltage - 5)".
        readings: measurements with these columns; they give units, and sizes that are not stated. Without them, units
            are checked when a model is fitted; they may be stated: V="supply_voltage [V]".
        instrument: instrument to whose slots the effect may add.
        source: source of the formula.
        definitions: size of each coefficient, by name ("0.1 mV/V", or "0.5 ± 0.1 mV/V" with a nonzero mean); range of
            each shape ("100 to 2000 s"; one value means a tenth to ten times it); column of other names.

    Raises:
        InputError: the formula cannot be parsed, its units disagree, or a size is missing; the message states where.
    """
    return _EffectParser(name, formula, definitions, readings, instrument).build(source)


def _split(name: str, formula: str, values: Mapping[str, str]) -> tuple[str, str, dict[str, str]]:
    """Split a line into effect name, formula and definitions by name; raise InputError if it has another form."""
    values = {n: str(v).strip() for n, v in values.items()}
    if not formula:
        name, colon, tail = name.partition(":")
        formula, *assignments = tail.split(";") if colon else ("",)
        for assignment in filter(str.strip, assignments):
            if not (match := _ASSIGNMENT_REGEX.fullmatch(assignment)):
                reason = f"effect {name!r}: {assignment.strip()!r} is not of the form s = 0.1 mV/V"
                raise InputError(reason)
            values[match[1].strip("`")] = match[2]
    name, formula = name.strip(), formula.strip()
    if not formula or not re.fullmatch(r"[^\W\d]\w*(?:\.\w+)?", name):
        raise InputError(
            f"effect {name[:60]!r} needs a name and a formula: write 'supply: s * (supply_voltage - 5); s = 1 mV/V'"
        )
    return name, formula, values


class _EffectParser:
    """Parser of an effect: a formula, and definitions of its names; readings or instrument give the columns' units."""

    def __init__(
        self,
        name: str,
        formula: str,
        definitions: Mapping[str, str],
        readings: Measurements | None,
        instrument: Instrument | None,
    ) -> None:
        self.name, self.text, self.definitions = _split(name, formula, definitions)
        self.readings, self.instrument = readings, instrument
        tree = self.parse_tree()
        self.first_positions = dict[str, int]()  # name → index of its first occurrence
        for start, word in sorted(self.find_names(tree)):
            self.first_positions.setdefault(word, start)
        # Name in the formula → column and its fixed unit; the unit is empty if not known without readings.
        self.columns = self._match_columns()
        if unused_names := sorted(set(self.definitions) - set(self.first_positions)):
            raise InputError(
                f"effect {self.name!r}: not used in {self.text!r}, though defined: {', '.join(unused_names)}"
            )
        unknowns = set(self.first_positions) - set(self.columns)
        nonlinear_names = {name for _, name in self.find_names(*_find_nonlinear(tree))} & unknowns
        self.shapes = {n: self._parse_shape(n, tree) for n in sorted(nonlinear_names)}
        self.units = {n: parse(u) if u else None for n, (_, u) in self.columns.items()}
        self.units |= {n: parse(s.unit) for n, s in self.shapes.items()}
        self.coefficients = self.to_linear(tree)
        if "" in self.coefficients:
            advice = "" if unknowns else ": write one in front, as s * (…)"
            reason = f"this term has no coefficient to be estimated{advice}"
            raise self.make_error(self.coefficients[""].start, reason)

    def make_error(self, start: int, reason: str) -> InputError:
        position_text = f", at {self.text[start:]!r}" * (0 < start < len(self.text))
        return InputError(f"effect {self.text!r}{position_text}: {reason}")

    def parse_tree(self) -> ast.expr:
        """Parse the formula to an AST whose names are keys of `names`; raise InputError with an error's position."""
        if len(self.text) > MAX_FORMULA_LENGTH:
            raise InputError(f"formula of {len(self.text)} characters; limit: {MAX_FORMULA_LENGTH}")
        # Names are replaced by n0, n1, …, so that Python's keywords can be column names.
        self.names, self.positions, source = dict[str, str](), list[int](), ""
        for token in _TOKEN_REGEX.finditer(self.text):
            token_kind = str(token.lastgroup)
            word, start = token[token_kind], token.start(token_kind)
            if token_kind == "other":
                raise self.make_error(start, f"{word!r} is not allowed in a formula")
            if token_kind == "function" and word not in _ARGUMENT_COUNTS:
                message = f"{word!r} is not a function (available: {', '.join(_ARGUMENT_COUNTS)})"
                raise self.make_error(start, message)
            if token_kind == "number":
                word = repr(_to_float(word, partial(self.make_error, start)))
            elif token_kind in ("name", "quoted"):
                key = f"n{len(self.names)}"
                self.names[key], word = word, key
            source += word.replace("^", "**") + " "
            self.positions += [start] * (len(source) - len(self.positions))
        try:
            tree = ast.parse(source, mode="eval").body
        except (SyntaxError, MemoryError, RecursionError) as error:
            index = (getattr(error, "offset", None) or 1) - 1
            start = self.positions[index] if index < len(self.positions) else len(self.text)
            reason = "the formula cannot be parsed here: is an operator, number, name or bracket missing?"
            raise self.make_error(start, reason) from None
        for node in ast.walk(tree):
            if not isinstance(node, _ALLOWED_NODES):
                raise self.make_error(self.locate(node), "this is not allowed in a formula")
            if isinstance(node, ast.Call) and len(node.args) != (
                argument_count := _ARGUMENT_COUNTS.get(_get_function_name(node), 0)
            ):
                reason = f"{_get_function_name(node)} takes {argument_count} argument{'s' * (argument_count > 1)}"
                raise self.make_error(self.locate(node), reason)
        self.has_history = any(isinstance(n, ast.Name) and n.id in _HISTORY for n in ast.walk(tree))
        return tree

    def locate(self, node: Any) -> int:
        """Return the index of a node's first character in the formula, without enclosing brackets."""
        while isinstance(node, ast.BinOp):
            node = node.left
        return self.positions[node.col_offset]

    def find_names(self, *parts: ast.expr) -> list[tuple[int, str]]:
        """Return (position, name) of each name in subexpressions, except names of functions."""
        nodes = [n for part in parts for n in ast.walk(part) if isinstance(n, ast.Name)]
        return [(self.locate(n), self.names[n.id]) for n in nodes if n.id in self.names]

    def apply(self, function: str, unit: ParsedUnit | None, *parts: FormulaPart) -> FormulaPart:
        """Apply a function to subexpressions; evaluate it if all are literals; raise InputError if it is undefined."""
        start, trees = parts[0].start, [part.tree for part in parts]
        if not all(isinstance(tree, float) for tree in trees):
            return FormulaPart((function, *trees), unit, start)
        try:
            with np.errstate(all="raise"):
                value = float(_IMPLEMENTATIONS[function](*map(np.float64, trees)))
        except FloatingPointError as error:
            reason = str(error).partition(" encountered")[0].replace("divide", "division")
            raise self.make_error(start, f"undefined: {reason}") from None
        return FormulaPart(value, None, start)

    def to_linear(self, node: ast.expr) -> LinearForm:
        """Convert an AST (syntax tree) node to a linear form; raise InputError if units disagree."""
        start = self.locate(node)
        match node:
            case ast.Constant():
                return {"": FormulaPart(float(node.value), None, start)}
            case ast.Name():
                name = self.names[node.id]
                if name in self.units:
                    return {"": FormulaPart(name, self.units[name], start)}
                return {name: FormulaPart(1.0, None, start)}
            case ast.UnaryOp():
                is_negative = False
                while isinstance(node, ast.UnaryOp):
                    is_negative, node = is_negative ^ isinstance(node.op, ast.USub), node.operand
                parts = self.to_linear(node)
                if is_negative:
                    parts = {n: self._negate(part) for n, part in parts.items()}
                return {n: part._replace(start=start) for n, part in parts.items()}
            case ast.BinOp():
                operands = self.to_linear(node.left), self.to_linear(node.right)
                return self._combine(_SIGNS[type(node.op)], *operands)
        assert isinstance(node, ast.Call)
        return {"": self._parse_call(_get_function_name(node), node.args)._replace(start=start)}

    def _negate(self, part: FormulaPart) -> FormulaPart:
        return self.apply("neg", part.unit, part)

    def _combine(self, sign: str, left: LinearForm, right: LinearForm) -> LinearForm:
        """Combine two linear forms by an arithmetic operator; raise InputError if coefficients multiply."""
        if sign in "+-":
            for name, part in right.items():
                if name in left:
                    left[name] = self._add_or_compare(sign, left[name], part)
                else:
                    left[name] = part if sign == "+" else self._negate(part)
            return left
        if set(right) == {""}:
            return {n: self._multiply(sign, part, right[""]) for n, part in left.items()}
        if set(left) == {""}:
            return {n: self._multiply(sign, left[""], part) for n, part in right.items()}
        coefficients = sorted({*left, *right} - {""})
        undefined_names = [n for n in coefficients if n not in self.definitions]
        start = next(iter(left.values())).start
        if self.readings is not None and len(undefined_names) == 1 < len(coefficients):
            raise self.make_error(start, self._format_missing_column(undefined_names[0]))
        reason = f"{' and '.join(coefficients)} are multiplied: only their product is identifiable"
        if self.readings is not None and undefined_names:
            reason += f". {' and '.join(map(self._format_missing_column, undefined_names))}"
        raise self.make_error(start, reason)

    def _add_or_compare(self, function: str, a: FormulaPart, b: FormulaPart) -> FormulaPart:
        """Apply a sum or comparison to two subexpressions, which must have the same dimension."""
        if a.unit is not None and b.unit is not None and a.unit.powers != b.unit.powers:
            reason = f"this is {b.unit}, but is added to or compared with {a.unit}"
            raise self.make_error(b.start, reason)
        return self.apply(function, a.unit or b.unit, a.match_unit(b), b.match_unit(a))

    def _multiply(self, sign: str, a: FormulaPart, b: FormulaPart) -> FormulaPart:
        if sign != "^":
            is_unitless = a.unit is None and b.unit is None
            product_unit = (a.unit or UNITY).times(b.unit or UNITY, 1.0 if sign == "*" else -1.0)
            return self.apply(sign, None if is_unitless else product_unit, a, b)
        if b.unit is not None and b.unit.powers:
            raise self.make_error(b.start, f"an exponent must be dimensionless; this is {b.unit}")
        unit = a.unit
        if unit is not None and unit.powers:
            if not isinstance(b.tree, float) or abs(b.tree) > 10:
                reason = (
                    f"a quantity in {unit} can only be raised to a constant power from -10 to 10"
                )
                raise self.make_error(b.start, reason)
            unit = UNITY.times(unit, b.tree)
        elif b.unit is not None:
            unit = UNITY
        return self.apply(sign, unit, a, b)

    def _parse_call(self, name: str, arguments: list[ast.expr]) -> FormulaPart:
        if name in _HISTORY:
            return self._parse_history(name, *arguments)
        a, *other_operands = (self.to_linear(argument)[""] for argument in arguments)
        if other_operands:
            return self._add_or_compare(name, a, *other_operands)
        unit = a.unit
        if name not in ("abs", "sqrt"):
            powers = {} if unit is None or name in ("step", "sign") else unit.powers
            if powers and not (name in ("sin", "cos", "tan") and powers == {"rad": 1.0}):
                reason = f"{name} takes a dimensionless number; this is {unit}: divide it by {unit}"
                raise self.make_error(a.start, reason)
            unit = UNITY
        elif name == "sqrt":
            unit = unit and UNITY.times(unit, 0.5)
        return self.apply(name, unit, a)

    def _parse_history(self, function: str, column_node: ast.expr, *tau: ast.expr) -> FormulaPart:
        column, *tau_names = (self.names.get(getattr(n, "id", "")) for n in (column_node, *tau))
        if column not in self.columns:
            raise self.make_error(self.locate(column_node), f"{function} takes a column name")
        unit = self.units[column] or parse("degC")
        if function == "rate":
            if unit.powers != {"K": 1.0}:
                raise self.make_error(self.locate(column_node), "rate takes a temperature column")
            unit = unit.times(parse("s"), -1.0)
        elif tau_names[0] not in self.shapes or self.units[tau_names[0]].powers != {"s": 1.0}:
            reason = f"the second argument of {function} must be a time constant (a shape in s), such as tau"
            raise self.make_error(self.locate(tau[0]), reason)
        return FormulaPart((function, column, *tau_names), unit, self.locate(column_node))

    def _format_missing_column(self, name: str) -> str:
        """Format the message that the readings have no numeric column of this name."""
        assert self.readings is not None
        available = ", ".join(self.available)
        return f"{name!r} is not a column of numbers of {self.readings.file} (it has: {available})"

    def _match_columns(self) -> dict[str, tuple[str, str]]:
        """Return (column, unit) by name; raise InputError if a column is absent or its unit disagrees."""
        readings, texts = self.readings, self.definitions
        columns = self.instrument.columns if self.instrument else ()
        defaults = {c.name: c.unit for c in columns if c.name != "output"}
        units = {**_UNITS, **{n: u for n, u in defaults.items() if u not in (None, uc.ANY)}}
        if readings is not None:
            column_units = {n: readings.unit(n) for n in readings.columns if n != readings.output}
            units = {n: unit for n, unit in column_units.items() if unit}
            units |= {"elapsed": "s"} if "time" in units else {}
        self.available = units
        aliases = {n: v for n, v in texts.items() if not re.match(r"[-+.\d]", v)}
        pairs: dict[str, tuple[str, str]] = {}
        for name, start in self.first_positions.items():
            column, bracket, unit = aliases.get(name, name).partition("[")
            column = column.strip()
            column = column if column in units or name in aliases else _ALIASES.get(column, column)
            own_unit, undefined = base_unit(unit.rstrip("] ")) if bracket else "", name not in texts
            if column in units:
                if own_unit and parse(own_unit).powers != parse(units[column]).powers:
                    raise self.make_error(
                        start, f"{column} is in [{units[column]}], and not in [{own_unit}]"
                    )
                pairs[name] = column, units[column]
            elif readings is None and (name in aliases or (texts and undefined)):
                pairs[name] = column if name in aliases else name, own_unit  # checked with readings
            elif readings is not None and (name in aliases or (undefined and column in defaults)):
                raise self.make_error(start, self._format_missing_column(column))
            elif (
                undefined
                and len(name) > 3
                and (matches := difflib.get_close_matches(name, units, 1, 0.8))
            ):
                raise self.make_error(start, f"{name!r} is not a column: is {matches[0]!r} meant?")
        return pairs

    def _parse_shape(self, name: str, tree: ast.expr) -> Shape:
        text = self.definitions.get(name)
        if text is None:
            reason = f"{name!r} has no plausible range: give one, as {name} = 100 to 2000 s"
            prefix = "" if self.readings is None else f"{self._format_missing_column(name)}, and "
            raise self.make_error(self.first_positions[name], prefix + reason)
        if match := _RANGE_REGEX.fullmatch(text):
            low, high, unit = _to_float(match[1]), _to_float(match[2]), match[3]
        elif (match := _SIZE_REGEX.fullmatch(text)) and match[2] is None and float(match[1]) > 0:
            value, unit = _to_float(match[1]), match[3]
            low, high = value / RANGE_FACTOR, value * RANGE_FACTOR
        else:
            raise InputError(f"{name} = {text!r} is not a range: write it as 100 to 2000 s")
        unit = (unit or "1").strip()
        # A shape added to or compared with a column is a location on its scale: 50 degF is 10 °C, negative is allowed.
        operands = (getattr(p, "id", "") for node in ast.walk(tree) for p in _list_operands(node))
        is_location = any(self.names.get(key) == name for key in operands)
        if not (low < high and (low > 0 or is_location)):
            reason = f"{name} = {text!r}: a range needs positive, increasing limits"
            raise InputError(reason)
        shape_unit = "1"
        if unit != "1":
            fixed_unit = base_unit(unit)
            to_fixed_unit = partial(convert, difference=not is_location)
            low, high = (float(to_fixed_unit(v, unit, fixed_unit)) for v in (low, high))
            shape_unit = re.sub(r"(?<!delta_)degC", "delta_degC", fixed_unit)
        return Shape(name, shape_unit, low, high, "log" if low > 0 else "linear")

    def build(self, source: str) -> Effect:
        """Build the effect; prior standard deviations that are not given are estimated from the readings."""
        slot, slot_unit, cause = self._resolve_slot()
        name, basis = f"{slot}.{cause}", self._build_formula("")
        sizes = [None] * len(basis.parts)
        if self.readings is not None:
            sizes = _find_sizes(basis, self.readings, self.shapes)
        pairs = zip(self.coefficients.items(), sizes, strict=True)
        coefficients = tuple(self._make_coefficient(n, p.unit, slot_unit, s) for (n, p), s in pairs)
        column_names = ["time" if c == "elapsed" else c for c, _ in self.columns.values()]
        return Effect(
            name,
            slot,
            basis=self._build_formula(self._format_canonical(name, coefficients)),
            coefficients=coefficients,
            shapes=tuple(self.shapes.values()),
            columns=tuple(dict.fromkeys([*column_names, *["time"] * self.has_history])),
            equation=self.text,
            source=source,
        )

    def _build_formula(self, text: str) -> Formula:
        columns = tuple((n, c, parse(u or "1").factor) for n, (c, u) in self.columns.items())
        parts = tuple(part.tree for part in self.coefficients.values())
        return Formula(text, parts, columns, tuple(self.shapes))

    def _resolve_slot(self) -> tuple[str, str | None, str]:
        """Return the slot's name, its unit (None if unknown), and the cause, from the effect's name `slot.cause`."""
        slot, _, cause = self.name.rpartition(".")
        if self.instrument is None:
            return slot or "bias", None, cause
        if slot:
            return slot, self.instrument.slot(slot).unit, cause
        chosen_slot = self.instrument.slots[0]
        for name, part in self.coefficients.items():
            size = _SIZE_REGEX.fullmatch(self.definitions.get(name, ""))
            if size and size[3]:
                product = parse(size[3].strip()).times(part.unit or UNITY).powers
                candidates = (s for s in self.instrument.slots if parse(s.unit).powers == product)
                if matching_slot := next(candidates, None):
                    chosen_slot = matching_slot
                    break
        return chosen_slot.name, chosen_slot.unit, cause

    def _make_coefficient(
        self, name: str, unit: ParsedUnit | None, slot_unit: str | None, size: float | None
    ) -> Coefficient:
        """Build a coefficient with its prior; an undefined one is in the slot's unit divided by that of its factor."""
        basis_unit, definition = unit or UNITY, self.definitions.get(name)
        part = name if len(self.coefficients) > 1 else ""
        if definition is None:
            if size is None or slot_unit is None:
                raise InputError(
                    f"effect {self.text!r}: {name!r} has no plausible size: give one, as {name} = 0.1 mV/V"
                )
            powers = sorted(basis_unit.powers.items())
            divisors = (("degC" if n == "K" else n, p) for n, p in powers)
            divisors = (n if p == 1 else f"({n}^{p:g})" for n, p in divisors)
            text = "/".join([slot_unit, *divisors])
            rounded_size = _to_float(f"{size / uc.coefficient_factor(text, slot_unit):.2g}")
            return Coefficient(text, Normal(0.0, rounded_size), part)
        if not (match := _SIZE_REGEX.fullmatch(definition)):
            raise InputError(
                f"{name} = {definition!r} is not a size with a unit: write it as 0.1 mV/V, or as 0.5 ± 0.1 mV/V"
            )
        text = (match[3] or "1").strip()
        sd, mean = (abs(_to_float(match[2] or match[1])), _to_float(match[1]) if match[2] else 0.0)
        prior = Normal(mean, sd) if sd > 0 else Known(mean)  # 1 ± 0: a constant
        if not (sd > 0 or mean):
            raise InputError(f"{name} = {definition!r}: a size must not be zero")
        product = parse(text).times(basis_unit)
        if slot_unit is not None and product.powers != (required := parse(slot_unit)).powers:
            raise InputError(
                f"effect {self.text!r}: with {name} in {text} the effect is in {product}, but its slot is in "
                f"{required}: correct the unit of {name}"
            )
        return Coefficient(text, prior, part)

    def _format_canonical(self, name: str, coefficients: tuple[Coefficient, ...]) -> str:
        """Format the effect as one line with all sizes and units, which can be parsed without readings."""
        parts = [f"{name}: {self.text}"]
        for n, c in zip(self.coefficients, coefficients, strict=True):
            parts.append(f"{n} = {f'{c.mean!r} ± ' if c.mean else ''}{c.size!r} {c.unit}")
        parts += [f"{n} = {s.low!r} to {s.high!r} {s.unit}" for n, s in self.shapes.items()]
        for n, (c, u) in self.columns.items():
            if n != c or n not in _UNITS:
                quoted_name = n if n.isidentifier() else f"`{n}`"
                parts.append(f"{quoted_name} = {c}" + (f" [{u}]" if u else ""))
        return "; ".join(parts)


def _get_function_name(node: ast.Call) -> str:
    return getattr(node.func, "id", "")


def _list_operands(node: ast.AST) -> list[ast.expr]:
    """Return the operands of a sum or a comparison; [] for any other node."""
    match node:
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            return [node.left, node.right]
        case ast.Call() if _get_function_name(node) in _BINARY:
            return node.args
    return []


def _find_nonlinear(tree: ast.expr) -> Iterator[ast.expr]:
    """Yield the subexpressions in which a formula is nonlinear: function arguments, divisors, powers."""
    for node in ast.walk(tree):
        match node:
            case ast.Call():
                yield from node.args
            case ast.BinOp(op=ast.Pow()):
                yield node
            case ast.BinOp(op=ast.Div()):
                yield node.right


def _to_float(text: str, make_error: Callable[[str], InputError] = InputError) -> float:
    """Parse a number; raise the error made by `make_error` if it overflows or underflows."""
    value, is_zero = float(text), not re.search("[1-9]", text.lower().split("e")[0])
    if math.isfinite(value) and (abs(value) >= MIN_NORMAL or is_zero):
        return value
    raise make_error(f"the number {text} is too {'large' if abs(value) > 1 else 'small'}")


def _find_sizes(basis: Formula, readings: Measurements, shapes: Mapping[str, Shape]) -> list[float]:
    """Return each basis column's coefficient at which its term has the output's standard deviation, in base units."""
    frame = build_frame(readings, reference_of(readings))
    midpoints = {n: float(s.prior.value(np.float64(0.0))) for n, s in shapes.items()}
    with np.errstate(all="ignore"):  # non-finite columns are refused by `Record.require_finite`
        columns = np.asarray(basis(frame, **midpoints))
        spreads = np.std(columns, axis=0)
    output_sd = float(np.std(readings[readings.output]))
    spreads = np.where(spreads > 0, spreads, np.abs(columns).max(axis=0))
    return [output_sd / s if s > 0 and math.isfinite(s) else output_sd for s in spreads.tolist()]


def require_units(parsed_effect: Effect, readings: Measurements, instrument: Instrument) -> None:
    """Raise ModelError if an effect's formula was parsed for other units than those of the readings or the slot."""
    basis = parsed_effect.basis
    if not isinstance(basis, Formula):
        return
    try:
        reparsed = effect(basis.text, readings=readings, instrument=instrument)
    except InputError as error:
        raise ModelError(str(error)) from None
    assert isinstance(reparsed.basis, Formula)
    if (reparsed.basis.parts, reparsed.basis.columns) != (basis.parts, basis.columns):
        raise ModelError(
            f"Effect {parsed_effect.name!r} was defined for columns in other units than those readings have: define "
            f"it with readings=…, or state the units ({basis.text})"
        )
