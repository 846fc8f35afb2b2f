"""The Gaussian core: integrate the coefficients out in closed form, and draw them back.

With y − μ(x̂) = r ≈ J(x − x̂) + noise and x ~ N(m, diag(s²)), everything follows from JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r.
The solve is in the whitened z = (x − m)/s, so that a spread of zero is no special case.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from bayescal._core.gaussian_algebra import triangle
from bayescal._engine.assembly import Point
from bayescal._inference import block_elimination
from bayescal._model import forward as composition
from bayescal._model.frame import Frame
from bayescal._model.noise_laws import Gram
from bayescal._model.parameters import Layout
from bayescal._model.prior import Normal

NODES = 7  # of each promoted coefficient
REACH = 6.0  # prior standard deviations, up to which they stand
MOST_BETWEEN = 2  # promoted coefficients, with whose number the nodes' number grows as a power


class Prior(NamedTuple):
    """Prior of a Gaussian vector: mean, scale, and weight (1 proper, 0 flat)."""

    mean: Float[Array, "p"]
    sd: Float[Array, "p"]
    weight: Float[Array, "p"]


class DenseFactor(NamedTuple):
    """A lower Cholesky factor."""

    chol: Float[Array, "p p"]

    @property
    def log_diagonal(self) -> Float[Array, ""]:
        """Σ log Lᵢᵢ."""
        return jnp.sum(jnp.log(jnp.diag(self.chol)))

    def forward(self, vector: Float[Array, "p"]) -> Float[Array, "p"]:
        """L⁻¹ times a vector."""
        return solve_triangular(self.chol, vector, lower=True)

    def back(self, vector: Float[Array, "p"]) -> Float[Array, "p"]:
        """Lᵀ⁻¹ times a vector."""
        return solve_triangular(self.chol, vector, lower=True, trans=1)


class Conditional(NamedTuple):
    """x given φ and the readings, x = shift + sd·L⁻ᵀ(u + ε), and the log density of the readings given φ."""

    log_marginal: Float[Array, ""]
    shift: Float[Array, "p"]
    sd: Float[Array, "p"]
    factor: DenseFactor | block_elimination.ArrowFactor
    u: Float[Array, "p"]

    @property
    def mean(self) -> Float[Array, "p"]:
        return self.place(jnp.zeros_like(self.u))

    def place(self, normal: Float[Array, "p"]) -> Float[Array, "p"]:
        """The x that standard normal numbers stand for."""
        return self.shift + self.sd * self.factor.back(self.u + normal)

    @property
    def log_jacobian(self) -> Float[Array, ""]:
        """Log volume of the map from standard normal numbers to x."""
        return jnp.sum(jnp.log(self.sd)) - self.factor.log_diagonal

    @property
    def covariance(self) -> Float[Array, "p p"]:
        columns = jax.vmap(self.factor.back, out_axes=1)(jnp.eye(self.u.size))
        root = self.sd[:, None] * columns
        return root @ root.T


def prior_of(layout: Layout, hyper: composition.Values, flat: Float[Array, "p"]) -> Prior:
    return Prior(
        composition.prior_mean(layout),
        composition.prior_sd(layout, hyper, flat),
        composition.prior_weight(layout),
    )


def condition(
    gram: Gram, size: int | Float[Array, ""], prior: Prior, at: Float[Array, "p"]
) -> Conditional:
    """Integrate x out.

    Args:
        gram: weighted products of J and r.
        size: number of readings.
        prior: prior of x.
        at: x̂, where r was taken.
    """
    offset = jnp.where(prior.weight > 0, prior.mean - at, 0.0)
    pulled = gram.jtj @ offset
    jtr = gram.jtr - pulled
    rtr = gram.rtr - offset @ (2 * gram.jtr - pulled)
    if isinstance(gram.jtj, block_elimination.ArrowMatrix):
        factor = block_elimination.factor(gram.jtj, prior.sd, prior.weight)
    else:
        precision = prior.sd[:, None] * gram.jtj * prior.sd + jnp.diag(prior.weight)
        factor = DenseFactor(jnp.linalg.cholesky(precision))
    u = factor.forward(prior.sd * jtr)
    rest = rtr - u @ u
    flat_volume = jnp.sum((1 - prior.weight) * (jnp.log(prior.sd) + 0.5 * jnp.log(2 * jnp.pi)))
    log_marginal = flat_volume - 0.5 * (
        size * jnp.log(2 * jnp.pi) + gram.logdet + 2 * factor.log_diagonal + rest
    )
    # A sum of squares that came out negative has no digits left (noise far below any residual): no density there.
    log_marginal = jnp.where(rest > 0, log_marginal, -jnp.inf)
    return Conditional(
        log_marginal=log_marginal, shift=at + offset, sd=prior.sd, factor=factor, u=u
    )


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
    upper = triangle(table)
    upper = upper * jnp.where(jnp.diag(upper) < 0, -1.0, 1.0)[:, None]
    root, u, rest = upper[:size, :size], upper[:size, size], upper[size, size]
    scale = jnp.sqrt(jnp.sum(root**2, axis=0))
    determined = jnp.all(jnp.diag(root) > 1e-14 * scale)
    root = jnp.where(determined, root, jnp.nan)
    flat_volume = jnp.sum((1 - prior.weight) * (jnp.log(prior.sd) + 0.5 * jnp.log(2 * jnp.pi)))
    volume = logdet + 2 * jnp.sum(jnp.log(jnp.diag(root)))
    log_marginal = flat_volume - 0.5 * (len(residual) * jnp.log(2 * jnp.pi) + volume + rest**2)
    return Conditional(
        log_marginal=log_marginal, shift=at + offset, sd=prior.sd, factor=DenseFactor(root.T), u=u
    )


def whitener(
    layout: Layout, frame: Frame, table: Float[Array, "n m"], extra: Float[Array, "n"]
) -> Callable[[composition.Values], tuple[Float[Array, "k m"], Float[Array, ""]]]:
    """A function of φ's values: rows with the products of the whitened table, and log|Σ| for `condition_white`.

    Where one variance holds for all readings it needs the table once, and its triangle stands for it.

    Args:
        table: J and r beside each other.
        extra: variance that the per-reading coefficients add.
    """
    noise = layout.model.noise
    if layout.row_blocks or not noise.constant(frame):
        return lambda hyper: noise.whiten(table, extra, hyper, frame)
    upper = triangle(table)
    lost = frame.size - len(
        upper
    )  # readings without a row of their own, which are counted all the same

    def scaled(hyper: composition.Values) -> tuple[Float[Array, "k m"], Float[Array, ""]]:
        variance = noise.shared_variance(hyper, frame)
        volume = frame.size * jnp.log(variance) + lost * jnp.log(2 * jnp.pi)
        return upper / jnp.sqrt(variance), volume

    return scaled


def gram_function(layout: Layout, frame: Frame, y: Float[Array, "n"], point: Point):
    """A function of φ that gives the weighted products of the readings linearised at `point`.

    Where one variance holds for all readings, the products are computed once; where J moves with a few promoted
    coefficients, at a few values of each, with Chebyshev polynomials between them (the draws' weights hold for the
    products that they were made with, so that this costs no exactness).
    """
    noise, split = layout.model.noise, block_elimination.arrow_of(layout)

    def shaped(gram: Gram) -> Gram:
        return gram if split is None else gram._replace(jtj=block_elimination.cut(split, gram.jtj))

    def products(hyper: composition.Values, white: bool) -> Gram:
        line = composition.linearise(layout, frame, point.x, point.rows, hyper)
        r = y - line.mean + jnp.sum(line.rows * point.rows, axis=1)
        if not white:
            return shaped(noise.gram(line.jacobian, r, row_variance(layout, line), hyper, frame))
        j = line.jacobian
        return shaped(Gram(j.T @ j, j.T @ r, r @ r, jnp.zeros(())))

    moving = layout.moving
    once = not layout.row_blocks and noise.constant(frame)
    if not once or not _interpolates(layout, moving):
        return lambda hyper, v: products(hyper, white=False)
    places = jnp.asarray(_nodes(len(moving)))
    at = jnp.zeros((len(places), len(layout.hypers))).at[:, jnp.asarray(moving, int)].set(places)
    grams = jax.lax.map(lambda v: products(composition.hyper_values(layout, v), white=True), at)

    def between(hyper: composition.Values, v: Float[Array, "d"]) -> Gram:
        share = _shares(v[jnp.asarray(moving, int)])
        variance = noise.shared_variance(hyper, frame)
        made = jax.tree.map(lambda g: jnp.tensordot(share, g, 1) / variance, grams)
        return made._replace(logdet=frame.size * jnp.log(variance))

    return between


def _interpolates(layout: Layout, moving: list[int]) -> bool:
    """Whether J moves with nothing but one or two promoted coefficients of proper prior."""
    hypers = [layout.hypers[i] for i in moving]
    return len(hypers) <= MOST_BETWEEN and all(
        h.kind == "promoted" and isinstance(h.prior, Normal) for h in hypers
    )


def _nodes(count: int) -> np.ndarray:
    """Values of the promoted coefficients' coordinates, (nodes, count), where products are computed."""
    angles = (np.arange(NODES) + 0.5) * np.pi / NODES
    return np.array(list(itertools.product(REACH * np.cos(angles), repeat=count)))


def _shares(v: Float[Array, "m"]) -> Float[Array, "nodes"]:
    """Weight of each node's products at these coordinates (Lagrange's polynomials on Chebyshev's points)."""
    line = _nodes(1)[:, 0]
    share = jnp.ones(1)
    for one in v:
        apart = [
            jnp.prod((one - np.delete(line, i)) / (x - np.delete(line, i)))
            for i, x in enumerate(line)
        ]
        share = (share[:, None] * jnp.stack(apart)).reshape(-1)
    return share


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
