"""What firmware needs of a calibration, as one value that can be run.

The equation in use is traced to a graph of scalar operations (`jaxpr_to_graph.py`), its derivatives with it:

    expected(s), slope = d expected/ds, gradient = d expected/dθ,   at θ = the posterior mean.

The stimulus solves expected(s) = reading: one Newton step from 0 where the equation is a straight line in s, up to
`STEPS` otherwise. Its standard uncertainty is √(gᵀCg), g = −gradient/slope, C = LLᵀ the posterior covariance of θ;
√(gᵀCg + (noise/slope)²) with the noise of one reading (JCGM 100, 5.2.2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.as_json import as_json
from bayescal._core.errors import InputError, ModelError
from bayescal._core.json_shape import OneOf, required
from bayescal._use.expression_graph import Graph
from bayescal._use.inputs import PAST, Input, limits
from bayescal._use.inversion import Inverse
from bayescal._use.jaxpr_to_graph import NotExportable, trace
from bayescal._use.operating_equation import Scalars
from bayescal._use.posterior_moments import PosteriorMoments
from bayescal._use.provenance import Provenance

SCHEMA, VERSION = "bayescal.compensator", 2
READ = (1, 2)  # 1 knew no lag slopes, and left the uncertainty of a time constant out of its lag
STIMULUS = "(stimulus)"  # its name as an input of the graph
STEPS = 20  # of Newton
AGAIN = "Export it again"
KINDS = ("column", "elapsed", *PAST)
SHAPE = {
    "schema": str,
    "version": int,
    "about": {
        **dict.fromkeys(("instrument", "title", "stimulus", "unit", "output_unit"), str),
        "effects": [(str, str)],
        "reference": {str: float},
        "sources": [(str, str)],
        "raw": OneOf(None, (str, float, float)),
        "notes": [str],
        "made_by": str,
        "calibration?": str,
    },
    "inputs": [
        {
            **dict.fromkeys(("name", "unit", "meaning", "kind", "column"), str),
            **{
                "low": float,
                "high": float,
                "tau?": OneOf(None, float),
                "silence?": OneOf(None, float),
            },
        }
    ],
    "stimulus_range": OneOf(None, (float, float)),
    "unknowns": [{"name": str, "unit": str, "mean": float}],
    "covariance": [[float]],
    "noise": float,
    "affine": bool,
    "equation": {
        "operations": [[OneOf(str, bool, int, float)]],
        "expected": int,
        "slope": int,
        "gradient": [int],
    },
}


@dataclass(frozen=True)
class Unknown:
    """A coefficient or shape: name, unit, posterior mean."""

    name: str
    unit: str
    mean: float


@dataclass(frozen=True, eq=False)
class CompensationProgram:
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

    about: Provenance
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
        """Beyond which a compensated value is flagged."""
        return None if self.stimulus_range is None else limits(self.stimulus_range)

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

        def at(s: np.ndarray, *outputs: int) -> list[Any]:
            return self.graph.evaluate(outputs, {**given, STIMULUS: s}, kind)

        s = np.zeros_like(target)
        for _ in range(1 if self.affine else STEPS):
            found, slope = at(s, self.expected, self.slope)
            with np.errstate(all="ignore"):
                s = s - (found - target) / slope
        if not self.affine:
            (found,) = at(s, self.expected)
            near = 1e4 * np.finfo(kind).eps * (np.abs(target) + np.abs(found))
            s = np.where(np.abs(found - target) <= near, s, np.nan).astype(kind)
        slope, *gradient = at(s, self.slope, *self.gradient)
        factor = self.factor.astype(kind)
        square = np.zeros_like(target)
        for j in range(len(gradient)):
            total = np.zeros_like(target)
            for i in range(j, len(gradient)):
                total = total + gradient[i] * factor[i, j]
            square = square + total * total
        size = np.abs(np.broadcast_to(slope, target.shape))
        return s, np.sqrt(square) / size, 1 / size

    def data(self) -> dict[str, Any]:
        """As JSON, with schema and version."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "about": as_json(self.about),
            "inputs": as_json(self.inputs),
            "stimulus_range": self.stimulus_range,
            "unknowns": as_json(self.unknowns),
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


def from_data(data: Any, file: str) -> CompensationProgram:
    """A program from JSON. Nothing in it is evaluated as code.

    Raises:
        InputError: it is none, of another version, or damaged.
    """
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(
            f"{file} is no compensator: export one by `bayescal export CALIBRATION --format json`"
        )
    if data.get("version") not in READ:
        raise InputError(
            f"{file} is a compensator of version {data.get('version')!r}, this bayescal reads "
            f"{' and '.join(map(str, READ))}: "
            "export it again"
        )
    required(data, SHAPE, file, AGAIN)
    about, equation = dict(data["about"]), data["equation"]
    for name in ("effects", "sources"):
        about[name] = tuple(tuple(row) for row in about[name])
    about["notes"] = tuple(about["notes"])
    about["raw"] = tuple(about["raw"]) if about["raw"] else None
    try:
        span, graph = data["stimulus_range"], Graph.from_data(equation["operations"])
        program = CompensationProgram(
            about=Provenance(**about),
            inputs=tuple(Input(**row) for row in data["inputs"]),
            stimulus_range=(float(span[0]), float(span[1])) if span else None,
            unknowns=tuple(Unknown(**row) for row in data["unknowns"]),
            covariance=np.array(data["covariance"], dtype=float).reshape(
                len(data["covariance"]), len(data["unknowns"])
            ),
            noise=float(data["noise"]),
            affine=data["affine"],
            graph=graph,
            expected=_place(equation["expected"], graph),
            slope=_place(equation["slope"], graph),
            gradient=tuple(_place(p, graph) for p in equation["gradient"]),
        )
        _refuse_torn(program)
    except (InputError, ValueError) as error:
        raise InputError(f"{file} is damaged: {error}. {AGAIN}") from None
    return program


def _refuse_torn(program: CompensationProgram) -> None:
    """Refuse parts that are each right and do not go together, by a `ValueError`."""
    sizes = {len(program.unknowns), len(program.gradient), *program.covariance.shape}
    if len(sizes) > 1:
        raise ValueError("its covariance, unknowns and gradient are of different sizes")
    names = [i.name for i in program.inputs]
    if len(set(names)) < len(names):
        raise ValueError("two of its inputs have one name")
    used = program.graph.inputs(range(len(program.graph.nodes)))
    if strange := used - {*names, STIMULUS}:
        raise ValueError(f"its equation needs {sorted(strange)[0]!r}, which is none of its inputs")
    for i in program.inputs:
        if i.kind not in KINDS or (i.kind.startswith("lag") and not (i.tau or 0) > 0):
            raise ValueError(f"its input {i.name!r} is of the kind {i.kind!r}, tau = {i.tau!r}")
    if program.about.raw and not program.about.raw[1]:
        raise ValueError("about.raw has a gain of zero")


def _place(value: Any, graph: Graph) -> int:
    if type(value) is not int or not 0 <= value < len(graph.nodes):
        raise ValueError(f"{value!r} is no operation of it")
    return value


def program_of(
    inverse: Inverse,
    moments: PosteriorMoments,
    inputs: Sequence[Input],
    *,
    stimulus_range: tuple[float, float] | None,
    noise: float,
    about: Provenance,
) -> CompensationProgram:
    """Trace an equation in use and its derivatives.

    Raises:
        ModelError: an effect is made of operations that firmware has no form of; named.
    """
    graph, unknowns = Graph(), inverse.equation.unknowns()
    theta = {u.key: jnp.asarray(m) for u, m in zip(unknowns, moments.mean, strict=True)}
    names = sorted(inverse.inputs)
    ones = {n: jnp.ones(()) for n in names}
    places = [graph.input(STIMULUS), *(graph.input(n) for n in names)]
    derivatives = _with_derivatives(inverse, theta)
    try:
        expected, slope, *gradient = trace(graph, derivatives, (jnp.ones(()), ones), places)
    except NotExportable as error:
        raise ModelError(_blame(inverse, theta, str(error))) from None
    acting = [i for i, node in enumerate(gradient) if graph.value(node) != 0]
    small, moved = graph.part([expected, slope, *(gradient[i] for i in acting)])
    needed = {n.value for n in small.nodes if n.op == "input"}
    return CompensationProgram(
        about=about,
        inputs=tuple(i for i in inputs if i.name in needed),
        stimulus_range=stimulus_range,
        unknowns=tuple(
            Unknown(unknowns[i].name, unknowns[i].unit, float(moments.mean[i])) for i in acting
        ),
        covariance=moments.covariance[np.ix_(acting, acting)],
        noise=noise,
        affine=graph.input(STIMULUS) not in graph.needed([slope]),
        graph=small,
        expected=moved[0],
        slope=moved[1],
        gradient=tuple(moved[2:]),
    )


def _with_derivatives(inverse: Inverse, theta: Scalars) -> Callable[..., Any]:
    """A function of stimulus and inputs: expected output, its slope, its gradient by each unknown."""

    def at(s, given, theta):
        return inverse.equation.point(theta, s, given, inverse.reference)

    def expected_slope_gradient(s, given):
        # Forward, because the reverse of a slice is a padding, for which there is no scalar operation.
        one = jnp.ones(())
        expected, slope = jax.jvp(lambda s: at(s, given, theta), (s,), (one,))
        gradient = [
            jax.jvp(lambda v, key=key: at(s, given, {**theta, key: v}), (value,), (one,))[1]
            for key, value in theta.items()
        ]
        return expected, slope, gradient

    return expected_slope_gradient


def _blame(inverse: Inverse, theta: Scalars, reason: str) -> str:
    """Which effect cannot be exported, and what to do."""
    equation = inverse.equation
    ones = {n: jnp.ones(()) for n in inverse.names}
    for effect in dict.fromkeys(b.effect for b in equation.blocks):

        def basis(s, given, effect=effect):
            frame = equation.one_reading(s, given, inverse.reference)
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
