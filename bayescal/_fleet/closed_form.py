"""Least squares of one device in closed form but for one number, the noise: the quick way through a batch.

Where the expected output is affine in the coefficients, their priors are fixed and the noise is white, the readings
enter through R of the QR factors of [J_flat, J·s, r] alone (s: prior standard deviations), and through the singular
values d of its block of proper columns. The restricted likelihood of the noise σ is then a sum of p terms,

    −2 log L(σ) = (n − f) log σ² + ρ²/σ² + Σ log(1 + d²/σ²) + c²/(σ² + d²)

with ρ what no column explains, c the readings along the singular vectors and f the number of flat coefficients. Its
maximum is that of `LeastSquares`, and so are the coefficients at it and their covariance.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from bayescal._core.jit import compiled
from bayescal._data.column import UNCERTAINTY
from bayescal._inference import sampled_products
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

GRID = 32  # starts for log σ², among which the best one's neighbours bracket the maximum
STEPS = 10  # safeguarded Newton steps in the bracket, to the last digits
LEAST = 1e-24  # share of the readings' variance, below which the noise counts as none
NOISE = "noise.white"


class ClosedFormFit(NamedTuple):
    """What least squares finds of one device: x̂, its covariance, σ, and whether all of it was determined."""

    x: Float[Array, "p"]
    covariance: Float[Array, "p p"]
    noise: Float[Array, ""]
    determined: Array
    scatter: Array  # whether the readings left any


def applies(layout: Layout, frame: Frame) -> bool:
    """Whether the model is of this kind for readings like these."""
    noise = layout.model.noise
    only_noise = all(h.kind == "noise" for h in layout.hypers)
    return (
        noise.first
        and only_noise
        and layout.size > 0
        and not layout.row_blocks
        and UNCERTAINTY not in frame.columns
        and not sampled_products.is_nonlinear(layout, frame)
    )


@compiled
def solve(
    layout: Layout, frames: Frame, ys: Float[Array, "b n"], real: Float[Array, "b n"]
) -> ClosedFormFit:
    """All devices of a stack; `real` is 0 where a reading is padding."""
    return jax.vmap(lambda *device: _solve(layout, *device))(frames, ys, real)


def _solve(
    layout: Layout, frame: Frame, y: Float[Array, "n"], real: Float[Array, "n"]
) -> ClosedFormFit:
    flat = np.concatenate([np.full(b.size, b.coefficient.flat) for b in layout.x_blocks])
    places, f, p = np.argsort(~flat, kind="stable"), int(flat.sum()), layout.size
    centre = forward.prior_mean(layout)
    hyper = forward.hyper_values(layout, jnp.zeros(len(layout.hypers)))
    line = forward.linearise(layout, frame, centre, jnp.zeros((frame.size, 0)), hyper)
    norm = jnp.sqrt(jnp.sum((line.jacobian * real[:, None]) ** 2, axis=0))
    scale = forward.prior_sd(layout, hyper, 1 / jnp.where(norm > 0, norm, 1.0))
    table = jnp.column_stack([(line.jacobian * scale)[:, places], y - line.mean])
    # R, flat columns first, then the proper ones, then the readings.
    upper = _triangle(table * real[:, None])
    u, d, vt = jnp.linalg.svd(upper[f:p, f:p])
    c, rest, d2 = u.T @ upper[f:p, p], upper[p, p] ** 2, d**2
    if NOISE in dict(layout.model.fixed):
        variance = jnp.asarray(dict(layout.model.fixed)[NOISE]) ** 2
    else:
        variance = jnp.exp(_log_variance(jnp.sum(real) - f, rest, c**2, d2))
    # The proper coefficients z, in parts of their prior standard deviations, given the noise.
    z = vt.T @ (d * c / (variance + d2))
    covariance_z = (vt.T * (variance / (variance + d2))) @ vt
    # The flat ones given these: R11·x = first − R12·z + noise.
    left = upper[:f, :f]
    right = jnp.column_stack([upper[:f, f:p], upper[:f, p], jnp.eye(f)])
    back = solve_triangular(left, right, lower=False)
    slope, free, root = back[:, : p - f], back[:, p - f], back[:, p - f + 1 :]
    cross = -slope @ covariance_z
    inner = variance * root @ root.T - cross @ slope.T
    undo = np.argsort(places)
    value = jnp.concatenate([free - slope @ z, z])[undo]
    covariance = jnp.block([[inner, cross], [cross.T, covariance_z]])[undo][:, undo]
    # Flat columns have length one: a diagonal of R near zero is a direction that nothing determines.
    determined = jnp.all(jnp.abs(jnp.diag(left)) > 1e-10) & jnp.all(jnp.isfinite(value))
    return ClosedFormFit(
        x=centre + scale * value,
        covariance=scale[:, None] * covariance * scale,
        noise=jnp.sqrt(variance),
        determined=determined,
        scatter=rest > LEAST * jnp.sum(upper[:, p] ** 2),
    )


def _triangle(table: Float[Array, "n q"]) -> Float[Array, "q q"]:
    """R of the QR factors up to the signs of its rows, square however few rows there are."""
    upper = jnp.linalg.qr(table, mode="r")
    return jnp.pad(upper, ((0, table.shape[1] - upper.shape[0]), (0, 0)))


def _log_variance(count: Array, rest: Array, c2: Float[Array, "m"], d2: Float[Array, "m"]) -> Array:
    """Where the restricted likelihood of t = log σ² is greatest.

    Args:
        count: readings less flat coefficients.
        rest: sum of squares that no column explains, positive.
        c2, d2: squares along the singular vectors, and of the singular values.
    """

    def value(t):
        s = jnp.exp(t)
        return -(count * t + rest / s + jnp.sum(jnp.log1p(d2 / s) + c2 / (s + d2)))

    def slopes(t):
        s = jnp.exp(t)
        share = s / (s + d2)
        pull = c2 * share / (s + d2)
        first = -count + rest / s + jnp.sum(1 - share + pull)
        second = -rest / s + jnp.sum(-share * (1 - share) + pull * (1 - 2 * share))
        return first, second

    # From none of it explained by noise to all of it.
    least = jnp.log(rest / count + 1e-300) - 0.5
    most = jnp.log((rest + jnp.sum(c2)) / count + 1e-300) + 4.0
    grid = least + (most - least) * jnp.linspace(0.0, 1.0, GRID) ** 2
    best = jnp.argmax(jax.vmap(value)(grid))
    low, high = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, GRID - 1)]

    def closer(_, state):
        t, low, high = state
        first, second = slopes(t)
        low, high = jnp.where(first > 0, t, low), jnp.where(first > 0, high, t)
        step = t - first / jnp.where(second < 0, second, -1.0)
        inside = (step >= low) & (step <= high) & (second < 0)
        return jnp.where(inside, step, 0.5 * (low + high)), low, high

    return jax.lax.fori_loop(0, STEPS, closer, (grid[best], low, high))[0]
