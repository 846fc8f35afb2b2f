"""The inverse of the equation in use: the stimulus of each reading, for draws of θ or to first order.

A straight line in the stimulus is solved in closed form, anything else by optimistix' Newton, reading by reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.jit import compiled
from bayescal._data.column import UNCERTAINTY
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._use.operating_equation import OperatingEquation, Scalars
from bayescal._use.posterior_moments import PosteriorMoments

TIGHT = 1e-13  # of Newton's last step, relative
NOISE_READINGS = 1000  # over which a noise that follows a column is averaged; the mean is known far better than it


def live(function, *arguments: Any) -> list[bool]:
    """Which leaves of the arguments the value of a function depends on, by its traced operations."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    wanted = {id(v) for v in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(v) in wanted for v in equation.outvars):
            wanted |= {id(v) for v in equation.invars}
    return [id(v) in wanted for v in jaxpr.invars]


class AtPoint(NamedTuple):
    """The equation at one operating point: expected output, its slope by the stimulus, its gradient by θ."""

    expected: float
    slope: float
    gradient: np.ndarray


@dataclass(frozen=True)
class Inverse:
    """The inverse of an equation in use.

    Attributes:
        equation: in use.
        reference: constants of the bases.
        names: all inputs that there could be.
    """

    equation: OperatingEquation
    reference: Scalars
    names: tuple[str, ...]

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Inputs that the output depends on."""
        theta, inputs = self.ones()
        keep = live(
            lambda inputs: self.equation.point(theta, jnp.ones(()), inputs, self.reference), inputs
        )
        return tuple(n for n, k in zip(sorted(inputs), keep, strict=True) if k)

    @cached_property
    def affine(self) -> bool:
        """Whether the output is a straight line in the stimulus, by its traced derivative."""
        theta, inputs = self.ones()
        return not live(lambda s: jax.grad(self._at(theta, inputs))(s), jnp.ones(()))[0]

    def ones(self) -> tuple[Scalars, Scalars]:
        """θ by key, and the inputs by name, to trace the equation with."""
        theta = {u.key: jnp.ones(()) for u in self.equation.unknowns()}
        return theta, {n: jnp.ones(()) for n in self.names}

    def at_point(self, mean: np.ndarray, point: Mapping[str, float]) -> AtPoint:
        """The equation with its derivatives at θ = `mean` and one operating point: stimulus and inputs by name.

        Inputs that are not in `point` are zero, since the equation makes no use of them.
        """
        stimulus, zeros = self.equation.use.stimulus, dict.fromkeys(self.names, jnp.zeros(()))
        inputs = zeros | {n: jnp.asarray(v) for n, v in point.items() if n != stimulus}

        def expected(theta, s):
            return self._at(_named(self.equation, theta), inputs)(s)

        at = jnp.asarray(mean), jnp.asarray(float(point[stimulus]))
        value, (gradient, slope) = jax.value_and_grad(expected, argnums=(0, 1))(*at)
        return AtPoint(float(value), float(slope), np.asarray(gradient))

    def _at(self, theta: Scalars, inputs: Scalars):
        return lambda s: self.equation.point(theta, s, inputs, self.reference)


@compiled
def over_draws(equation: OperatingEquation, reference, affine: bool, theta, output, inputs, record):
    """Mean and variance of the stimulus over draws of θ, and the mean square of its slope, (n,) each."""

    def add(state, one):
        count, mean, square, slope = state
        own = _with_lags(equation, one, inputs, record)
        found, inclination = _invert(equation, reference, affine, one, output, own)
        count = count + 1
        step = found - mean
        mean = mean + step / count
        return (count, mean, square + step * (found - mean), slope + inclination**-2), None

    zero = jnp.zeros_like(output)
    (count, mean, square, slope), _ = jax.lax.scan(add, (0.0, zero, zero, zero), theta)
    return mean, square / jnp.maximum(count - 1, 1), slope / count


@compiled
def first_order(
    equation: OperatingEquation, reference, affine: bool, theta, covariance, output, inputs, record
):
    """Stimulus at θ, its variance by first-order propagation, and its squared slope by the output, (n,) each."""
    own = _with_lags(equation, theta, inputs, record)
    found, inclination = _invert(equation, reference, affine, theta, output, own)

    def expected(theta):
        own = _with_lags(equation, theta, inputs, record)
        return jax.vmap(lambda s, i: equation.point(_named(equation, theta), s, i, reference))(
            found, own
        )

    gradient = -jax.jacfwd(expected)(theta) / inclination[:, None]
    return found, jnp.einsum("ni,ij,nj->n", gradient, covariance, gradient), inclination**-2


@compiled
def errors_over_draws(equation: OperatingEquation, reference, theta, mean, stimulus, inputs):
    """Corrected reading minus stimulus where θ is what a draw says and the correction is made with its mean, (d, n).

    With them 1/|slope| of the output by the stimulus, (n,). A reading has no noise here. Two of Newton's steps from the
    stimulus itself: exact where the output is a straight line in it, else to the fourth order in the error.
    """
    middle = _named(equation, mean)

    def error(one):
        named = _named(equation, one)

        def at(s, inputs):
            target = equation.point(named, s, inputs, reference)
            found = s
            for _ in range(2):
                value, slope = jax.value_and_grad(equation.point, argnums=1)(
                    middle, found, inputs, reference
                )
                found = found - (value - target) / slope
            return found - s

        return jax.vmap(at)(stimulus, inputs)

    slope = jax.vmap(jax.grad(lambda s, i: equation.point(middle, s, i, reference)))(
        stimulus, inputs
    )
    return jax.vmap(error)(theta), 1 / jnp.abs(slope)


@compiled
def slots_over_draws(equation: OperatingEquation, reference, name: str, theta, stimulus, inputs):
    """What a slot comes to at each place, for draws of θ, (d, n)."""

    def values(one):
        named = _named(equation, one)
        return jax.vmap(lambda s, i: equation.slot(name, named, s, i, reference))(stimulus, inputs)

    return jax.vmap(values)(theta)


def _named(equation: OperatingEquation, theta: Float[Array, "p"]) -> Scalars:
    return {u.key: theta[i] for i, u in enumerate(equation.unknowns())}


def _with_lags(
    equation: OperatingEquation, theta, inputs: Scalars, record: Frame | None
) -> Scalars:
    """The inputs with the lags of a record, for the time constants in θ."""
    if record is None:
        return inputs
    named, found = _named(equation, theta), dict(inputs)
    for lag in equation.lags:
        if lag.name not in found:
            tau = named[lag.shape] if lag.shape else jnp.asarray(lag.tau)
            found[lag.name] = record.lag(tau, lag.column)
            if lag.slope:
                found[lag.slope] = jnp.zeros_like(found[lag.name])  # it is at this τ already
    return found


def _invert(equation: OperatingEquation, reference, affine: bool, theta, output, inputs):
    """Stimulus and the slope of the output by it, reading by reading; NaN where Newton finds none."""
    named = _named(equation, theta)

    def one(target, inputs):
        def miss(s, _):
            return equation.point(named, s, inputs, reference) - target

        at_zero, slope = jax.value_and_grad(miss)(0.0, None)
        first = -at_zero / slope
        if affine:
            return first, slope
        solver = optx.Newton(rtol=TIGHT, atol=1e-300)
        found = optx.root_find(miss, solver, first, max_steps=40, throw=False)
        _, slope = jax.value_and_grad(miss)(found.value, None)
        settled = jnp.abs(miss(found.value, None)) <= 1e-9 * (jnp.abs(target) + jnp.abs(at_zero))
        return jnp.where(settled, found.value, jnp.nan), slope

    return jax.vmap(one)(output, inputs)


def solved(
    inverse: Inverse,
    moments: PosteriorMoments,
    given: Mapping[str, np.ndarray],
    record: Frame | None,
    *,
    by_draws: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stimulus, its variance from the calibration, and its squared slope by the output, (n,) each.

    Args:
        inverse, moments: the equation, and what the posterior says of θ.
        given: output and inputs by name, (n,) each.
        record: that lags follow from; None where they are given.
        by_draws: over draws of θ; else to first order.
    """
    equation = inverse.equation
    lags = [] if record is None else [lag.name for lag in equation.lags]
    output = jnp.asarray(given["output"])
    unused = jnp.zeros(len(given["output"]))
    inputs = {
        name: jnp.asarray(given[name]) if name in inverse.inputs else unused
        for name in inverse.names
        if name not in lags
    }
    start = equation, inverse.reference, inverse.affine
    if by_draws:
        found = over_draws(*start, jnp.asarray(moments.draws), output, inputs, record)
    else:
        mean, covariance = jnp.asarray(moments.mean), jnp.asarray(moments.covariance)
        found = first_order(*start, mean, covariance, output, inputs, record)
    value, variance, inclination = (np.asarray(f) for f in found)
    return value, variance, inclination


def noise_variance(calibration: Calibration) -> float:
    """Mean over the posterior of the variance of one reading's noise, output unit squared.

    Where it follows a column, it is also the mean over the readings of the calibration. What is known of the
    uncertainty of each is not in it.
    """
    _, _, v = calibration.draws(2000)
    layout, frame = calibration.layout, _seen_by_noise(calibration)

    def variance(v):
        parameters = forward.hyper_values(layout, v)
        return jnp.mean(layout.model.noise.variance(parameters, frame))

    return float(jnp.mean(jax.vmap(variance)(jnp.asarray(v))))


def _seen_by_noise(calibration: Calibration) -> Frame:
    """As many readings as a mean over them takes; a single one without columns where the noise needs none."""
    whole, follows = calibration.frame, bool(calibration.layout.model.noise.needs)
    rows = np.arange(whole.size)[:: -(-whole.size // NOISE_READINGS)]
    columns = {n: c[rows] for n, c in whole.columns.items() if follows and n != UNCERTAINTY}
    one = jnp.zeros(len(rows) if follows else 1)
    return Frame(
        columns=columns,
        labels={},
        rates={n: r[rows] for n, r in whole.rates.items() if follows},
        codes={},
        reference=whole.reference if follows else {},
        order=one.astype(int),
        step=one,
        record={},
        silence=whole.silence,
    )
