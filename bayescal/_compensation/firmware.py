"""What firmware needs of a calibration, as one value; written as JSON, a C99 header or a Python function.

The equation in use is traced to a graph of scalar operations (`_export_trace.py`), its derivatives with it:

    expected(s), slope = d expected/ds, gradient = d expected/dθ,   at θ = the posterior mean.

The stimulus solves expected(s) = reading: one Newton step from 0 where the equation is a straight line in s, up to
`STEPS` otherwise. Its standard uncertainty is √(gᵀCg), g = −gradient/slope, C = LLᵀ the posterior covariance of θ;
√(gᵀCg + (noise/slope)²) with the noise of one reading (JCGM 100, 5.2.2).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._compensation.code_writer import STEPS, STIMULUS, printed
from bayescal._compensation.expression_graph import Graph
from bayescal._compensation.inversion import Inverse
from bayescal._compensation.jaxpr_to_graph import NotExportable, trace
from bayescal._compensation.operating_equation import Entry, Known
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError, ModelError

SCHEMA, VERSION = "bayescal.compensator", 1
FORMATS = {".h": "c", ".py": "python", ".json": "json"}


@dataclass(frozen=True)
class Input:
    """A covariate that compensation needs.

    Attributes:
        name, unit, meaning: for people and firmware.
        kind: "column"; or what is made of a record: "rate", "lag", "elapsed".
        column: the column that it is, or is made of.
        tau: time constant of a lag, s.
        low, high: range in the calibration, in `unit`.
    """

    name: str
    unit: str
    meaning: str
    kind: str
    column: str
    low: float
    high: float
    tau: float | None = None


@dataclass(frozen=True)
class Unknown:
    """A coefficient or shape: name, unit, posterior mean."""

    name: str
    unit: str
    mean: float


@dataclass(frozen=True)
class About:
    """Where an export comes from and what may be done with it.

    Attributes:
        instrument: its name; title: one line.
        stimulus, unit: what is compensated for; output_unit: of the reading.
        effects: (name, equation) of those that act.
        reference: constants of the bases, such as T0.
        sources: (file, sha256) of the readings.
        raw: how a raw output becomes the reading: unit, gain, offset; None if it is the reading.
        notes: what to know, each a sentence.
        made_by: program and version.
    """

    instrument: str
    title: str
    stimulus: str
    unit: str
    output_unit: str
    effects: tuple[tuple[str, str], ...]
    reference: dict[str, float]
    sources: tuple[tuple[str, str], ...]
    raw: tuple[str, float, float] | None
    notes: tuple[str, ...]
    made_by: str


@dataclass(frozen=True, eq=False)
class Program:
    """A compensation by mean and covariance, to first order.

    Attributes:
        about: what it is.
        inputs: covariates needed, beside the reading.
        stimulus_range: in the calibration; None where the stimulus was not varied or not a column.
        unknowns: whose covariance (p, p) it is, in reported units.
        covariance: their posterior covariance.
        noise: standard deviation of one reading, output unit.
        affine: whether the equation is a straight line in the stimulus.
        graph, expected, slope, gradient: the equation, and its nodes.
    """

    about: About
    inputs: tuple[Input, ...]
    stimulus_range: tuple[float, float] | None
    unknowns: tuple[Unknown, ...]
    covariance: np.ndarray
    noise: float
    affine: bool
    graph: Graph
    expected: int
    slope: int
    gradient: tuple[int, ...]

    @property
    def stimulus_limits(self) -> tuple[float, float] | None:
        """Beyond which a compensated value is flagged: the calibrated range and a hundredth of it."""
        if self.stimulus_range is None:
            return None
        low, high = self.stimulus_range
        return low - 0.01 * (high - low), high + 0.01 * (high - low)

    @property
    def factor(self) -> np.ndarray:
        """L of C = LLᵀ, lower triangular; by QR of a symmetric root, so that C may be singular."""
        sd = np.sqrt(np.diag(self.covariance))
        scale = np.where(sd > 0, sd, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        root = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        r = np.linalg.qr(root, mode="r") if len(sd) else root
        signs = np.where(np.diag(r) < 0, -1.0, 1.0)
        return scale[:, None] * (signs[:, None] * r).T + 0.0

    def run(
        self, output: np.ndarray, inputs: Mapping[str, np.ndarray], kind: Any = np.float64
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stimulus, its standard uncertainty without noise, and |d stimulus/d output|, (n,) each.

        Raises:
            InputError: an input is missing.
        """
        target = np.asarray(output, kind)
        given = {i.name: np.asarray(inputs[i.name], kind) for i in self.inputs if i.name in inputs}
        s, settled = np.zeros_like(target), self.affine
        for _ in range(1 if self.affine else STEPS):
            found, slope = self.graph.evaluate(
                (self.expected, self.slope), {**given, STIMULUS: s}, kind
            )
            with np.errstate(all="ignore"):
                s = s - (found - target) / slope
        if not settled:
            found, slope = self.graph.evaluate(
                (self.expected, self.slope), {**given, STIMULUS: s}, kind
            )
            near = 1e4 * np.finfo(kind).eps * (np.abs(target) + np.abs(found))
            s = np.where(np.abs(found - target) <= near, s, np.nan).astype(kind)
        slope, *gradient = self.graph.evaluate(
            (self.slope, *self.gradient), {**given, STIMULUS: s}, kind
        )
        factor = self.factor.astype(kind)
        square = np.zeros_like(target)
        for j in range(len(gradient)):
            total = np.zeros_like(target)
            for i in range(j, len(gradient)):
                total = total + gradient[i] * factor[i, j]
            square = square + total * total
        size = np.abs(np.broadcast_to(slope, target.shape))
        return s, np.sqrt(square) / size, 1 / size

    def export(self, path: str | Path, format: str | None = None) -> Path:
        """Write as .h (C99), .py (Python) or .json; beside and then renamed.

        Raises:
            InputError: another suffix or format, or a place that cannot be written to.
        """
        path = Path(path)
        format = format or FORMATS.get(path.suffix.lower(), "")
        if format not in FORMATS.values():
            raise InputError(
                f"a compensator cannot be written as {format or path.name!r}: choose json, c or python "
                "(.json, .h, .py)"
            )
        return write_text(self.text(format), path)

    def text(self, format: str) -> str:
        if format == "json":
            return json.dumps(self.data(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        return printed(self, format)

    def data(self) -> dict[str, Any]:
        """As JSON, with schema and version."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "about": asdict(self.about),
            "inputs": [asdict(i) for i in self.inputs],
            "stimulus_range": self.stimulus_range,
            "unknowns": [asdict(u) for u in self.unknowns],
            "covariance": self.covariance.tolist(),
            "noise": self.noise,
            "affine": self.affine,
            "equation": {
                "operations": self.graph.data(),
                "expected": self.expected,
                "slope": self.slope,
                "gradient": list(self.gradient),
            },
        }


def from_data(data: Any, file: str) -> Program:
    """A program from JSON. Nothing in it is evaluated as code.

    Raises:
        InputError: it is none, of another version, or damaged.
    """
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(
            f"{file} is no compensator: export one by `bayescal export CALIBRATION --format json`"
        )
    if data.get("version") != VERSION:
        raise InputError(
            f"{file} is a compensator of version {data.get('version')!r}, this bayescal reads {VERSION}: "
            "export it again"
        )
    try:
        about, equation = dict(data["about"]), data["equation"]
        for name in ("effects", "sources"):
            about[name] = tuple(tuple(row) for row in about[name])
        about["notes"] = tuple(about["notes"])
        about["raw"] = tuple(about["raw"]) if about["raw"] else None
        span, graph = data["stimulus_range"], Graph.from_data(equation["operations"])
        program = Program(
            About(**about),
            tuple(Input(**row) for row in data["inputs"]),
            (float(span[0]), float(span[1])) if span else None,
            tuple(Unknown(**row) for row in data["unknowns"]),
            np.array(data["covariance"], dtype=float).reshape(len(data["covariance"]), -1),
            float(data["noise"]),
            bool(data["affine"]),
            graph,
            _place(equation["expected"], graph),
            _place(equation["slope"], graph),
            tuple(_place(p, graph) for p in equation["gradient"]),
        )
        sizes = {len(program.unknowns), len(program.gradient), *program.covariance.shape}
        if len(sizes) > 1:
            raise ValueError("its covariance, unknowns and gradient are of different sizes")
    except InputError as error:
        raise InputError(f"{file} is damaged: {error}. Export it again") from None
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError(
            f"{file} is damaged ({type(error).__name__}: {error}). Export it again"
        ) from None
    return program


def _place(value: Any, graph: Graph) -> int:
    if type(value) is not int or not 0 <= value < len(graph.nodes):
        raise ValueError(f"{value!r} is no operation of it")
    return value


def program_of(
    inverse: Inverse,
    known: Known,
    inputs: Sequence[Input],
    stimulus_range: tuple[float, float] | None,
    noise: float,
    about: About,
) -> Program:
    """Trace an equation in use and its derivatives.

    Raises:
        ModelError: an effect is made of operations that firmware has no form of; named.
    """
    equation, graph = inverse.equation, Graph()
    entries, names = equation.entries(), inverse.inputs
    theta = {e.key: jnp.asarray(m) for e, m in zip(entries, known.mean, strict=True)}

    def at(s, given, theta):
        return equation.point(theta, s, given, inverse.reference)

    def all_of(s, given):
        # Forward, because the reverse of a slice is a padding, for which there is no scalar operation.
        expected, slope = jax.jvp(lambda s: at(s, given, theta), (s,), (jnp.ones(()),))
        gradient = [
            jax.jvp(
                lambda value, key=e.key: at(s, given, {**theta, key: value}),
                (theta[e.key],),
                (jnp.ones(()),),
            )[1]
            for e in entries
        ]
        return expected, slope, gradient

    ones = {n: jnp.ones(()) for n in names}
    places = [graph.input(STIMULUS), *(graph.input(n) for n in sorted(names))]
    try:
        expected, slope, *gradient = trace(graph, all_of, (jnp.ones(()), ones), places)
    except NotExportable as error:
        raise ModelError(_blame(inverse, theta, str(error))) from None
    acting = [i for i, node in enumerate(gradient) if graph.value(node) != 0]
    small, moved = graph.part([expected, slope, *(gradient[i] for i in acting)])
    needed = {n.value for n in small.nodes if n.op == "input"}
    affine = graph.input(STIMULUS) not in graph.needed([slope])
    return Program(
        about,
        tuple(i for i in inputs if i.name in needed),
        stimulus_range,
        tuple(_unknown(entries[i], known.mean[i]) for i in acting),
        known.covariance[np.ix_(acting, acting)],
        noise,
        affine,
        small,
        moved[0],
        moved[1],
        tuple(moved[2:]),
    )


def _unknown(entry: Entry, mean: float) -> Unknown:
    return Unknown(entry.name, entry.unit, float(mean))


def _blame(inverse: Inverse, theta: dict[str, Any], reason: str) -> str:
    """Which effect cannot be exported, and what to do."""
    equation = inverse.equation
    ones = {n: jnp.ones(()) for n in inverse.names}
    for effect in dict.fromkeys(b.effect for b in equation.blocks):

        def basis(s, given, effect=effect):
            frame = equation._frame(s, given, inverse.reference)
            shapes = {x.name: theta.get(effect.shape_name(x), jnp.ones(())) for x in effect.shapes}
            return [effect.evaluate(frame, shapes)[0, i] for i in range(len(effect.coefficients))]

        graph = Graph()
        places = [graph.input(STIMULUS), *(graph.input(n) for n in sorted(ones))]
        try:
            trace(graph, basis, (jnp.ones(()), ones), places)
        except NotExportable as error:
            return (
                f"effect {effect.name!r} cannot be exported: {error}. Write its basis with arithmetic, "
                "powers, exp, sin and jnp.where, take the effect out (model - name) and fit again, or "
                "compensate in Python: bayescal compensate"
            )
    return f"the equation cannot be exported: {reason}. Compensate in Python: bayescal compensate"
