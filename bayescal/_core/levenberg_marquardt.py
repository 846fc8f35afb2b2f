"""Nonlinear least squares: Levenberg–Marquardt, a second try where it stalls, a last polish.

One solver for optimistix, whose every step evaluates the residuals and their Jacobian once and
factors them by QR (never JᵀJ), so that it compiles as one small loop. A try ends in undamped
Gauss–Newton steps, accepted while the gradient falls: sums of squares agree to the last bit long
before the unknowns do.
Sources: J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105 (damping by the largest norms of
the columns); H. B. Nielsen, IMM-REP-1999-05 (damping factor); D. M. Bates and D. G. Watts,
Technometrics 23 (1981) 179 (convergence by the share of the residuals in the tangent plane).
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

from bayescal._core.gaussian_algebra import triangle

TRIES = 2  # by the columns' norms, then by the unknowns' own scales
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
    steps: int = 1000,
    table: Callable[[Float[Array, "p"]], Float[Array, "n p1"]] | None = None,
) -> Fitted:
    """Minimise Σ residuals². Traceable: under `jit`, and mapped over data sets.

    Args:
        residuals: function of the unknowns, at least as many as these; in any common unit.
        start: of the unknowns, in their own units.
        scale: size of a plausible change of each unknown, in its unit; one, if not given. The
            first try does not depend on it, the second does.
        table: the Jacobian of the residuals with them as its last column, where that is quicker than by
            differentiation.
        steps: evaluations of the residuals and their Jacobian in one try (without the polish).

    Returns:
        The unknowns where the last try ended. `converged` says that a Gauss–Newton step would move
        the residuals by less than 1e-5 of their length (or the unknowns by less than 1e-9), and
        that every direction is determined. It may be a local optimum: only a try that reaches none
        is followed by another.
    """
    if not start.size:
        return Fitted(start, jnp.asarray(True), jnp.asarray(0))
    scale = jnp.ones_like(start) if scale is None else scale
    own = None if table is None else lambda z: table(scale * z) * jnp.append(scale, 1.0)
    solver = LevenbergMarquardt(steps=steps, table=own)
    found = optx.least_squares(
        lambda z, _: residuals(scale * z),
        solver,
        start / scale,
        max_steps=TRIES * (steps + 100),
        throw=False,
    )
    return Fitted(
        scale * found.value, found.result == optx.RESULTS.successful, found.stats["num_steps"]
    )


class _Evaluated(NamedTuple):
    """A point that was tried."""

    cost: Float[Array, ""]  # Σ r²
    upper: Float[Array, "p p1"]  # R beside Qᵀr, of J = QR; of zeros where anything is not finite
    finite: Bool[Array, ""]


class _State(eqx.Module):
    """The accepted point as its factors, the point to be evaluated next, and where tries stand."""

    start: Float[Array, "p"]
    trial: Float[Array, "p"]
    fresh: Bool[Array, ""]  # nothing accepted yet in this try
    cost: Float[Array, ""]  # Σ r²
    upper: Float[Array, "p p1"]  # R beside Qᵀr, of J = QR
    weight: Float[Array, "p"]
    damping: Float[Array, ""]
    growth: Float[Array, ""]  # of the damping at the next rejection
    predicted: Float[Array, ""]  # fall of the cost by the step to `trial`, of the linear model
    polishing: Bool[Array, ""]
    attempt: Int[Array, ""]
    count: Int[Array, ""]
    done: Bool[Array, ""]
    success: Bool[Array, ""]


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The tries and the polish of each, as one step that optimistix repeats.

    Attributes:
        steps: of one try, at most.
        table: Jacobian beside residuals; by differentiation if not given.
        rtol, atol, norm: of optimistix's interface, not used: the criteria here are scale-free.
    """

    steps: int = 1000
    table: Callable[[Array], Array] | None = None
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        no, zero, none = jnp.asarray(False), jnp.zeros(()), jnp.asarray(0)
        return _State(
            start=y,
            trial=y,
            fresh=~no,
            cost=zero,
            upper=jnp.zeros((y.size, y.size + 1)),
            weight=0 * y,
            damping=zero,
            growth=zero,
            predicted=zero,
            polishing=no,
            attempt=none,
            count=none,
            done=no,
            success=no,
        )

    def _evaluated(self, fn, args, trial: Float[Array, "p"]) -> _Evaluated:
        """Residuals and Jacobian at a point, as their factors."""
        if self.table is None:
            residual, slope = jax.linearize(lambda z: fn(z, args)[0], trial)
            table = jnp.column_stack([jax.vmap(slope, out_axes=1)(jnp.eye(trial.size)), residual])
        else:
            table = self.table(trial)
            residual = table[:, -1]
        finite = jnp.all(jnp.isfinite(table))
        return _Evaluated(residual @ residual, _triangle(jnp.where(finite, table, 0.0)), finite)

    def step(self, fn, y, args, options, state: _State, tags):
        new = self._evaluated(fn, args, state.trial)
        gain = (state.cost - new.cost) / state.predicted
        nearer = _inside(new.upper) < 0.8 * _inside(state.upper)
        accept = new.finite & (state.fresh | jnp.where(state.polishing, nearer, gain > 1e-4))
        upper = jnp.where(accept, new.upper, state.upper)
        cost = jnp.where(accept, new.cost, state.cost)
        y = jnp.where(accept, state.trial, y)

        weight = _weight(upper, state)
        factor = jnp.where(accept, jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3), state.growth)
        first = jnp.where(state.attempt == 0, *FIRST_DAMPING)
        damping = jnp.where(state.fresh, first, state.damping * factor)

        inside = _inside(upper)
        stalled = (damping > 1e16) | (state.count > self.steps)
        polishing = state.polishing | stalled | (inside <= NEAR**2 * cost)
        # A polishing step too is damped by rounding's worth, where nothing determines a direction.
        used = jnp.where(polishing, 1e-31, damping + 1e-31)
        step, damped = _damped_step(upper, used, weight)

        ended = (state.polishing | state.fresh) & ~accept
        rests = jnp.all(jnp.abs(step) <= 1e-9 * jnp.abs(y))
        # By the largest columns so far: on a plateau, where one has died away, nothing is found.
        regular = jnp.all(jnp.abs(jnp.diag(damped)) > 1e-14 * weight)
        success = ended & regular & ((inside <= GOOD**2 * cost) | rests) & ~state.fresh
        done = success | (ended & (state.attempt == TRIES - 1))
        again = ended & ~done
        state = _State(
            start=state.start,
            trial=jnp.where(again, state.start, y + step),
            fresh=again,
            cost=cost,
            upper=upper,
            weight=jnp.where(again, 0.0, weight),
            damping=damping,
            growth=jnp.where(accept, 2.0, 2 * state.growth),
            predicted=_inside(damped) + used * jnp.sum((weight * step) ** 2),
            polishing=polishing & ~again,
            attempt=state.attempt + again,
            count=jnp.where(again, 0, state.count + 1),
            done=done,
            success=success,
        )
        return y, state, None

    def terminate(self, fn, y, args, options, state: _State, tags):
        failed = state.done & ~state.success
        result = optx.RESULTS.where(
            failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return state.done, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _weight(upper: Float[Array, "p p1"], state: _State) -> Float[Array, "p"]:
    """The largest norm that each column has had in this try; in the second try, of all columns."""
    norms = jnp.sqrt(jnp.sum(upper[:, :-1] ** 2, axis=0))
    norms = jnp.where(state.attempt == 0, norms, jnp.max(norms))
    return jnp.maximum(jnp.maximum(norms, state.weight), 1e-150)


def _damped_step(
    upper: Float[Array, "p p1"], damping: Float[Array, ""], weight: Float[Array, "p"]
) -> tuple[Float[Array, "p"], Float[Array, "p p1"]]:
    """The step that minimises |R·s + Qᵀr|² + damping·|weight·s|², and the factors that it came from."""
    rows = jnp.column_stack([jnp.diag(jnp.sqrt(damping) * weight), jnp.zeros(weight.size)])
    damped = _triangle(jnp.concatenate([upper, rows]))
    return -solve_triangular(damped[:, :-1], damped[:, -1]), damped


def _triangle(table: Float[Array, "n p1"]) -> Float[Array, "p p1"]:
    """R of the QR factors of [J r]: R of J beside Qᵀr."""
    return triangle(table)[: table.shape[1] - 1]


def _inside(upper: Float[Array, "p p1"]) -> Float[Array, ""]:
    """‖Qᵀr‖², the part of Σ r² that the linear model can still remove."""
    return jnp.sum(upper[:, -1] ** 2)
