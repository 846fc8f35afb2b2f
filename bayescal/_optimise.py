"""Nonlinear least squares: Levenberg–Marquardt, a second try where it stalls, a Gauss–Newton polish.

One solver for optimistix, whose every step evaluates the residuals and their Jacobian once and factors them by
QR (never JᵀJ), so that it compiles as one small loop. A try ends in undamped Gauss–Newton steps, accepted while
the gradient falls: sums of squares agree to the last bit long before the unknowns do.
Sources: J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105 (damping by the columns' largest norms);
H. B. Nielsen, IMM-REP-1999-05 (damping factor); D. M. Bates and D. G. Watts, Technometrics 23 (1981) 179
(convergence by the share of the residuals that lies in the tangent plane).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

TRIES = 2  # by the columns' norms, then by the unknowns' own scales
STEPS = 1000  # of one try
NEAR = 1e-6  # share of the residuals in the tangent plane, at which polishing starts
GOOD = 1e-5  # and at which a point counts as the optimum
FIRST_DAMPING = (1e-3, 1.0)  # of each try


class Fitted(NamedTuple):
    """Where the sum of squares is least, and whether the optimum was reached."""

    value: Float[Array, "p"]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def least_squares(
    residuals: Callable[[Float[Array, "p"]], Float[Array, "n"]],
    start: Float[Array, "p"],
    scale: Float[Array, "p"] | None = None,
    *,
    max_steps: int = TRIES * STEPS,
) -> Fitted:
    """Minimise Σ residuals². Traceable: under `jit`, and mapped over data sets.

    Args:
        residuals: of the unknowns; whitened, for the covariance to be theirs.
        start: of the unknowns.
        scale: size of a plausible change of each unknown; one, if not given.
        max_steps: evaluations of the residuals and their Jacobian, at most.
    """
    if not start.size:
        return Fitted(start, jnp.asarray(True), jnp.asarray(0))
    scale = jnp.ones_like(start) if scale is None else scale
    solver = LevenbergMarquardt()
    found = optx.least_squares(
        lambda z, _: residuals(scale * z), solver, start / scale, max_steps=max_steps, throw=False
    )
    return Fitted(
        scale * found.value, found.result == optx.RESULTS.successful, found.stats["num_steps"]
    )


def covariance(jacobian: Float[Array, "n p"]) -> Float[Array, "p p"]:
    """(JᵀJ)⁻¹ by QR of J with its columns scaled: a condition number is not squared. For whitened residuals."""
    norm = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    norm = jnp.where(norm > 0, norm, 1.0)
    triangle = jnp.linalg.qr(jacobian / norm, mode="r")
    root = solve_triangular(triangle, jnp.eye(norm.size)) / norm[:, None]
    return root @ root.T


class _State(eqx.Module):
    """The accepted point's factors, and the point to be tried next."""

    trial: Float[Array, "p"]
    first: Bool[Array, ""]  # of this try
    cost: Float[Array, ""]  # Σ r²
    triangle: Float[Array, "p p"]  # R of J = QR
    inside: Float[Array, "p"]  # Qᵀr
    weight: Float[Array, "p"]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    predicted: Float[Array, ""]
    polishing: Bool[Array, ""]
    attempt: Int[Array, ""]
    spent: Int[Array, ""]
    start: Float[Array, "p"]
    best: Float[Array, "p"]
    best_cost: Float[Array, ""]
    done: Bool[Array, ""]
    success: Bool[Array, ""]


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    rtol: float = 1e-12
    atol: float = 1e-12
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        one, zero = jnp.ones(()), jnp.zeros_like(y)
        return _State(
            y, jnp.asarray(True), jnp.inf * one, jnp.eye(y.size), zero, zero,
            FIRST_DAMPING[0] * one, 2 * one, one, jnp.asarray(False), jnp.asarray(0), jnp.asarray(0),
            y, y, jnp.inf * one, jnp.asarray(False), jnp.asarray(False),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        size = y.size
        r, push = jax.linearize(lambda z: fn(z, args)[0], state.trial)
        jac = jax.vmap(push, out_axes=1)(jnp.eye(size))
        cost = r @ r
        finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(jac))
        table = jnp.where(finite, jnp.concatenate([jac, r[:, None]], 1), 0.0)
        upper = jnp.linalg.qr(table, mode="r")[:size]
        triangle, inside = upper[:, :size], upper[:, size]
        g_new, g_old = inside @ inside, state.inside @ state.inside

        gain = (state.cost - cost) / state.predicted
        accept = finite & (
            state.first | jnp.where(state.polishing, g_new < 0.8 * g_old, gain > 1e-4)
        )
        triangle = jnp.where(accept, triangle, state.triangle)
        inside = jnp.where(accept, inside, state.inside)
        y = jnp.where(accept, state.trial, y)
        new_cost = jnp.where(accept, cost, state.cost)
        columns = jnp.sqrt(jnp.sum(triangle**2, axis=0))
        by_columns = jnp.maximum(columns, jnp.where(state.first, 0.0, state.weight))
        same = jnp.full(size, jnp.max(columns))
        same = jnp.where(state.first, same, state.weight)
        weight = jnp.where(state.attempt == 0, by_columns, same)
        weight = jnp.where(weight > 0, weight, 1.0)

        shrink = jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
        damping = jnp.where(accept, state.damping * shrink, state.damping * state.growth)
        damping = jnp.where(state.first, state.damping, jnp.maximum(damping, 1e-20))
        growth = jnp.where(accept, 2.0, 2 * state.growth)

        near = inside @ inside <= NEAR**2 * new_cost
        stalled = (damping > 1e14) & ~accept
        was = state.polishing
        polishing = was | near | stalled | (state.spent > STEPS)
        used = jnp.maximum(jnp.where(polishing, 0.0, damping), 1e-31)
        stack = jnp.concatenate([triangle, jnp.sqrt(used) * jnp.diag(weight)])
        stack = jnp.concatenate([stack, jnp.concatenate([inside, jnp.zeros(size)])[:, None]], 1)
        upper = jnp.linalg.qr(stack, mode="r")[:size]
        step = -solve_triangular(upper[:, :size], upper[:, size])
        step = jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0)
        bent = inside + triangle @ step
        predicted = inside @ inside - bent @ bent
        predicted = jnp.maximum(predicted, 1e-300)

        tiny = jnp.all(jnp.abs(step) <= 1e-15 * jnp.abs(y))
        ended = was & (~accept | tiny) | ~finite & state.first
        good = (inside @ inside <= GOOD**2 * new_cost) | jnp.all(
            jnp.abs(step) <= 1e-9 * jnp.abs(y)
        )
        success = ended & good
        better = ended & (new_cost < state.best_cost)
        best = jnp.where(better, y, state.best)
        best_cost = jnp.where(better, new_cost, state.best_cost)
        last = state.attempt >= TRIES - 1
        done = ended & (success | last)
        again = ended & ~done
        y = jnp.where(done, jnp.where(success, y, best), y)
        attempt = state.attempt + again
        fresh = jnp.asarray(FIRST_DAMPING)[jnp.minimum(attempt, TRIES - 1)]
        return y, _State(
            jnp.where(again, state.start, y + step),
            again,
            jnp.where(again, jnp.inf, new_cost),
            triangle, inside, weight,
            jnp.where(again, fresh, damping),
            jnp.where(again, 2.0, growth),
            predicted,
            polishing & ~again,
            attempt,
            jnp.where(again, 0, state.spent + 1),
            state.start, best, best_cost, done, success,
        ), None

    def terminate(self, fn, y, args, options, state: _State, tags):
        result = optx.RESULTS.where(
            state.done & ~state.success, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return state.done, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}
