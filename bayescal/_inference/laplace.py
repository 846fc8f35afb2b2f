"""The mode of a model: x̂ given φ̂ by Levenberg–Marquardt, φ̂ by marginal likelihood, in turn.

The joint mode of coefficients and spreads would run to a spread of zero; the mode of φ with x integrated out
does not. Both optimisers are optimistix's.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from bayescal._core.jit import compiled
from bayescal._core.levenberg_marquardt import least_squares
from bayescal._core.parallel import over
from bayescal._engine.mode import Mode
from bayescal._inference import gaussian
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

STILL = 1e-4  # standard deviations that a round moves anything by, below which the mode is found
ROUNDS = 12  # alternations of x̂ and φ̂ at most
STARTS = 64  # prior draws of φ among which the start is chosen,
RAGGED = 4  # times as many where a shape's evidence has many maxima


def column_scale(jacobian: Float[Array, "n p"]) -> Float[Array, "p"]:
    """A scale for coefficients with a flat prior: the change that moves the output by one unit."""
    norm = jnp.sqrt(jnp.mean(jacobian**2, axis=0))
    return jnp.where(norm > 0, 1 / jnp.where(norm > 0, norm, 1.0), 1.0)


def density_of_phi(layout: Layout, frame: Frame, y: Array, point: gaussian.Point, flat: Array):
    """log p(y, φ) as a function of φ's coordinates, x integrated out of the model linearised at `point`."""
    grams = gaussian.gram_function(layout, frame, y, point)

    def density(v: Float[Array, "d"]) -> tuple[Float[Array, ""], gaussian.Conditional]:
        hyper = forward.hyper_values(layout, v)
        prior = gaussian.prior_of(layout, hyper, flat)
        found = gaussian.condition(grams(hyper, v), frame.size, prior, point.x)
        total = found.log_marginal + forward.hyper_log_prior(layout, v)
        return jnp.where(jnp.isfinite(total), total, -1e300), found

    return density


def mode_of_x(
    layout: Layout, frame: Frame, y: Array, point: gaussian.Point, v: Array, flat: Array
) -> gaussian.Point:
    """x̂ given φ: least squares of the residuals augmented by the prior; then the per-reading coefficients."""
    hyper = forward.hyper_values(layout, v)
    prior = gaussian.prior_of(layout, hyper, flat)
    line = forward.linearise(layout, frame, point.x, point.rows, hyper)
    noise = layout.model.noise
    extra = gaussian.row_variance(layout, line)
    back = jnp.sum(line.rows * point.rows, axis=1)
    centre = jnp.where(prior.weight > 0, prior.mean, point.x)

    def table(z: Array) -> Array:
        at = forward.linearise(layout, frame, centre + prior.sd * z, point.rows, hyper)
        both = jnp.column_stack([at.jacobian, y - at.mean + back])
        white, _ = gaussian.whitener(layout, frame, both, extra)(hyper)
        own = jnp.column_stack([jnp.diag(prior.weight), prior.weight * z])
        return jnp.concatenate([white * jnp.append(-prior.sd, 1.0), own])

    start = (point.x - centre) / jnp.where(prior.sd > 0, prior.sd, 1.0)
    x = (
        centre
        + prior.sd * least_squares(lambda z: table(z)[:, -1], start, steps=100, table=table).value
    )
    if not layout.row_blocks:
        return gaussian.Point(x, point.rows)
    line = forward.linearise(layout, frame, x, point.rows, hyper)
    rest = y - line.mean + jnp.sum(line.rows * point.rows, axis=1)
    zero = jnp.zeros_like(point.rows)
    return gaussian.Point(
        x, gaussian.draw_rows(layout, line, rest, noise.variance(hyper, frame), zero)[0]
    )


def start_point(layout: Layout, frame: Frame) -> gaussian.Point:
    return gaussian.Point(
        forward.prior_mean(layout), jnp.zeros((frame.size, len(layout.row_blocks)))
    )


def find_mode(layout: Layout, frame: Frame, y: Float[Array, "n"]) -> Mode:
    """The mode, from the best of some prior draws of φ. Deterministic; traceable; can be mapped over data."""
    point = start_point(layout, frame)
    dim = len(layout.hypers)
    zero = jnp.zeros(dim)
    line = forward.linearise(layout, frame, point.x, point.rows, forward.hyper_values(layout, zero))
    flat = column_scale(line.jacobian)
    v = _best_start(layout, frame, y, point, flat)

    def one_round(state):
        point, v, _, count = state
        new = mode_of_x(layout, frame, y, point, v, flat)
        density = density_of_phi(layout, frame, y, new, flat)
        best, found = v, None
        if dim:
            solver = optx.BFGS(rtol=1e-8, atol=1e-8)
            best = optx.minimise(
                lambda v, _: -density(v)[0], solver, v, max_steps=256, throw=False
            ).value
        found = density(best)[1]
        moved = jnp.max(jnp.abs((found.mean - new.x) / _width(found)), initial=0.0)
        change = jnp.maximum(moved, jnp.max(jnp.abs(best - v), initial=0.0))
        return gaussian.Point(found.mean, new.rows), best, change, count + 1

    def going(state):
        return (state[2] > STILL) & (state[3] < ROUNDS)

    first = (point, v, jnp.asarray(jnp.inf), jnp.asarray(0))
    point, v, change, _ = jax.lax.while_loop(going, one_round, first)
    return _at_mode(layout, frame, y, point, v, change, flat)


# One compiled program for a layout, whoever asks: methods, evidence, batches of one.
compiled_mode = compiled(find_mode)


def _width(found: gaussian.Conditional) -> Float[Array, "p"]:
    return jnp.sqrt(jnp.diag(found.covariance)) + 1e-300


def _best_start(
    layout: Layout, frame: Frame, y: Array, point: gaussian.Point, flat: Array
) -> Array:
    """The prior draw of φ under which the readings are most probable; proper or not, v = 0 is among them."""
    dim = len(layout.hypers)
    if not dim:
        return jnp.zeros(0)
    ragged = any(s.ragged for e in layout.model.effects for s in e.shapes)
    count = STARTS * (RAGGED if ragged else 1)
    draws = 1.5 * jax.random.normal(jax.random.key(0), (count, dim))
    density = density_of_phi(layout, frame, y, point, flat)
    starts = jnp.concatenate([jnp.zeros((1, dim)), draws])
    if layout.promoted:
        starts = jnp.concatenate([starts, _with_least_squares(layout, frame, y, starts)])
    values = over(lambda v: density(v)[0], starts, 16)
    return starts[jnp.argmax(values)]


def _with_least_squares(
    layout: Layout, frame: Frame, y: Array, starts: Float[Array, "s d"]
) -> Float[Array, "s d"]:
    """Starts whose promoted coefficients stand where least squares puts them, together with all others.

    A product of unknowns has another mode where both factors change sign; prior draws of one factor may start there.
    """
    own = Layout(layout.model, layout.counts)
    zero = jnp.zeros(len(own.hypers))
    hyper = forward.hyper_values(own, zero)
    point = start_point(own, frame)
    flat = column_scale(forward.linearise(own, frame, point.x, point.rows, hyper).jacobian)
    x = mode_of_x(own, frame, y, point, zero, flat).x
    sd = forward.prior_sd(own, hyper, jnp.ones(own.size))
    at = {h.name: i for i, h in enumerate(layout.hypers)}
    for block in own.x_blocks:
        if block.name in layout.promoted:
            members = slice(block.start, block.start + block.size)
            mean = 0.0 if block.coefficient.flat else block.coefficient.mean
            scale = block.coefficient.size if block.coefficient.flat else sd[members]
            places = jnp.asarray([at[name] for name in block.member_names()])
            starts = starts.at[:, places].set((x[members] - mean) / scale)
    return starts


def _at_mode(layout, frame, y, point, v, change, flat) -> Mode:
    density = density_of_phi(layout, frame, y, point, flat)
    dim = len(layout.hypers)
    value = density(v)[0]
    found = partial(Mode, point=point, v=v, log_density=value, change=change, flat=flat)
    if not dim:
        return found(
            covariance=jnp.zeros((0, 0)), log_evidence=value, indefinite=jnp.zeros((), bool)
        )
    covariance, volume, indefinite = gaussian_fit(lambda v: density(v)[0], v)
    return found(covariance=covariance, log_evidence=value + volume, indefinite=indefinite)


def gaussian_fit(log_density, v: Float[Array, "d"]) -> tuple[Array, Array, Array]:
    """Covariance of the Gaussian fit at a mode, its log volume, and whether the curvature had to be mended."""
    precision = _curvature(lambda v: -log_density(v), v)
    weights, vectors = jnp.linalg.eigh(0.5 * (precision + precision.T))
    # A coordinate is never known worse than a few units before its prior takes over.
    mended = jnp.maximum(weights, 0.05)
    covariance = (vectors / mended) @ vectors.T
    volume = 0.5 * v.size * jnp.log(2 * jnp.pi) - 0.5 * jnp.sum(jnp.log(mended))
    return covariance, volume, jnp.any(weights < 0.05)


def _curvature(function, v: Float[Array, "d"], step: float = 1e-4) -> Float[Array, "d d"]:
    """Hessian by central differences of the gradient: as good as needed here, and far quicker to compile."""
    shifts = step * jnp.concatenate([jnp.eye(v.size), -jnp.eye(v.size)])
    slopes = jax.lax.map(jax.grad(function), v + shifts)
    return (slopes[: v.size] - slopes[v.size :]) / (2 * step)
