"""The Gaussian core: integrate the coefficients out in closed form, and draw them back.

With y − μ(x̂) = r ≈ J(x − x̂) + noise and x ~ N(m, diag(s²)), everything follows from JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r.
The solve is in the whitened z = (x − m)/s, so that a spread of zero is no special case.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from bayescal import _composition as composition
from bayescal._frame import Frame
from bayescal._layout import Layout
from bayescal._noise import Gram


class Prior(NamedTuple):
    """Prior of a Gaussian vector: mean, scale, and weight (1 proper, 0 flat)."""

    mean: Float[Array, "p"]
    sd: Float[Array, "p"]
    weight: Float[Array, "p"]


class Point(NamedTuple):
    """Where the expected output is linearised: x̂ and the per-reading coefficients."""

    x: Float[Array, "p"]
    rows: Float[Array, "n k"]


class Conditional(NamedTuple):
    """x given φ and the readings, x = shift + sd·L⁻ᵀ(u + ε), and the log density of the readings given φ."""

    log_marginal: Float[Array, ""]
    shift: Float[Array, "p"]
    sd: Float[Array, "p"]
    chol: Float[Array, "p p"]
    u: Float[Array, "p"]

    @property
    def mean(self) -> Float[Array, "p"]:
        return self.place(jnp.zeros_like(self.u))

    def place(self, normal: Float[Array, "p"]) -> Float[Array, "p"]:
        """The x that standard normal numbers stand for."""
        return self.shift + self.sd * solve_triangular(
            self.chol, self.u + normal, lower=True, trans=1
        )

    @property
    def covariance(self) -> Float[Array, "p p"]:
        root = self.sd[:, None] * solve_triangular(
            self.chol, jnp.eye(self.u.size), lower=True, trans=1
        )
        return root @ root.T


def prior_of(layout: Layout, hyper: composition.Values, flat: Float[Array, "p"]) -> Prior:
    return Prior(
        composition.prior_mean(layout),
        composition.prior_sd(layout, hyper, flat),
        composition.prior_weight(layout),
    )


def condition(gram: Gram, size: int, prior: Prior, at: Float[Array, "p"]) -> Conditional:
    """Integrate x out.

    Args:
        gram: weighted products of J and r.
        size: number of readings.
        prior: prior of x.
        at: x̂, where r was taken.
    """
    offset = jnp.where(prior.weight > 0, prior.mean - at, 0.0)
    jtr = gram.jtr - gram.jtj @ offset
    rtr = gram.rtr - 2 * offset @ gram.jtr + offset @ gram.jtj @ offset
    precision = prior.sd[:, None] * gram.jtj * prior.sd + jnp.diag(prior.weight)
    chol = jnp.linalg.cholesky(precision)
    u = solve_triangular(chol, prior.sd * jtr, lower=True)
    rest = rtr - u @ u
    flat_volume = jnp.sum((1 - prior.weight) * (jnp.log(prior.sd) + 0.5 * jnp.log(2 * jnp.pi)))
    log_marginal = flat_volume - 0.5 * (
        size * jnp.log(2 * jnp.pi) + gram.logdet + 2 * jnp.sum(jnp.log(jnp.diag(chol))) + rest
    )
    # A sum of squares that came out negative has no digits left (noise far below any residual): no density there.
    log_marginal = jnp.where(rest > 0, log_marginal, -jnp.inf)
    return Conditional(log_marginal, at + offset, prior.sd, chol, u)


def condition_white(
    jacobian: Float[Array, "n p"],
    residual: Float[Array, "n"],
    logdet: Float[Array, ""],
    prior: Prior,
    at: Float[Array, "p"],
) -> Conditional:
    """`condition` from whitened J and r by QR: without JᵀJ, no condition number is squared.

    A direction that neither readings nor priors determine makes everything NaN.

    Args:
        jacobian, residual: whitened.
        logdet: log |Σ| of the readings.
        prior: prior of x.
        at: x̂, where r was taken.
    """
    size = prior.sd.size
    offset = jnp.where(prior.weight > 0, prior.mean - at, 0.0)
    own = jnp.column_stack([jacobian * prior.sd, residual - jacobian @ offset])
    table = jnp.concatenate([own, jnp.eye(size, size + 1) * prior.weight[:, None]])
    upper = jnp.linalg.qr(table, mode="r")
    upper = upper * jnp.where(jnp.diag(upper) < 0, -1.0, 1.0)[:, None]
    root, u, rest = upper[:size, :size], upper[:size, size], upper[size, size]
    scale = jnp.sqrt(jnp.sum(root**2, axis=0))
    determined = jnp.all(jnp.diag(root) > 1e-14 * scale)
    root = jnp.where(determined, root, jnp.nan)
    flat_volume = jnp.sum((1 - prior.weight) * (jnp.log(prior.sd) + 0.5 * jnp.log(2 * jnp.pi)))
    volume = logdet + 2 * jnp.sum(jnp.log(jnp.diag(root)))
    log_marginal = flat_volume - 0.5 * (len(residual) * jnp.log(2 * jnp.pi) + volume + rest**2)
    return Conditional(log_marginal, at + offset, prior.sd, root.T, u)


def needs_one_pass(layout: Layout, frame: Frame) -> bool:
    """Whether products over the readings can be computed once: J does not move with φ, and one variance."""
    moving = any(h.moves for h in layout.hypers)
    return not moving and not layout.row_blocks and layout.model.noise.constant(frame)


def gram_function(layout: Layout, frame: Frame, y: Float[Array, "n"], point: Point):
    """A function of φ that gives the weighted products of the readings linearised at `point`."""
    noise = layout.model.noise
    if needs_one_pass(layout, frame):
        hyper = composition.hyper_values(layout, jnp.zeros(len(layout.hypers)))
        line = composition.linearise(layout, frame, point.x, point.rows, hyper)
        r = y - line.mean
        jtj, jtr, rtr = line.jacobian.T @ line.jacobian, line.jacobian.T @ r, r @ r

        def scaled(hyper: composition.Values) -> Gram:
            variance = noise.variance(hyper, frame)[0]
            return Gram(
                jtj / variance, jtr / variance, rtr / variance, frame.size * jnp.log(variance)
            )

        return scaled

    def full(hyper: composition.Values) -> Gram:
        line = composition.linearise(layout, frame, point.x, point.rows, hyper)
        r = y - line.mean + jnp.sum(line.rows * point.rows, axis=1)
        return noise.gram(line.jacobian, r, row_variance(layout, line), hyper, frame)

    return full


def row_variance(layout: Layout, line: composition.Linearised) -> Float[Array, "n"]:
    """Variance that the per-reading coefficients add to each reading."""
    return jnp.sum((line.rows * composition.row_sd(layout)) ** 2, axis=1)


def draw_rows(
    layout: Layout,
    line: composition.Linearised,
    residual: Float[Array, "n"],
    variance: Float[Array, "n"],
    normal: Float[Array, "n k"],
) -> tuple[Float[Array, "n k"], Float[Array, ""]]:
    """Per-reading coefficients given all else, reading by reading.

    Args:
        residual: y − μ with the per-reading coefficients at zero.
        variance: of the noise alone.
        normal: standard normal numbers (zeros give the mean).

    Returns:
        The coefficients, and the log volume of the map from `normal` to them.
    """
    precision = line.rows[:, :, None] * line.rows[:, None, :] / variance[:, None, None]
    precision = precision + jnp.diag(1 / composition.row_sd(layout) ** 2)
    chol = jnp.linalg.cholesky(precision)
    pull = line.rows * (residual / variance)[:, None]

    def solve(root, b, e):
        return solve_triangular(
            root, solve_triangular(root, b, lower=True) + e, lower=True, trans=1
        )

    volume = -jnp.sum(jnp.log(jnp.diagonal(chol, axis1=1, axis2=2)))
    return jax.vmap(solve)(chol, pull, normal), volume
