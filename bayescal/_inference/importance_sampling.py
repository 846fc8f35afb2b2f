"""Adaptive importance sampling of φ, with the coefficients drawn back exactly.

φ is proposed from Student-t mixtures, first around its Laplace fit, then around many draws of the round before:
spreads that readings know only by their sum of squares have a density with arms, which one ellipse does not cover.
All proposals are evaluated in batches; no draw waits for the one before, and the log evidence comes for free. What
nonlinearity the closed form left is corrected by the same weights: each joint draw (x, φ) carries true over
linearised likelihood.
Source: A. Owen and Y. Zhou, JASA 95 (2000) 135 (defensive mixtures); M. West, J. R. Stat. Soc. B 55 (1993) 409
(mixtures around weighted draws); Vehtari et al., JMLR 25 (2024) 72 (k̂).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import gammaln, logsumexp
from jaxtyping import Array, Float

from bayescal._core.jit import compiled
from bayescal._core.parallel import over
from bayescal._inference import gaussian, laplace
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout
from bayescal._model.prior import Flat, FlatLine

FREEDOM = 5  # of the Student-t proposals
KERNELS = 256  # draws of the round before, around each of which the next one proposes
KERNEL = 0.7  # width of each, in standard deviations of φ: so wide that the mixture is heavier than what it follows
WIDE = 1.7  # last component: wider than the Laplace fit, against tails that are heavier
PRIOR = 0.2  # share of proposals from the prior, so that no weight exceeds likelihood over 0.2 times evidence
BATCH = 256  # proposals evaluated at once, to bound memory


class WeightedDraws(NamedTuple):
    """Joint draws with their log weights (not normalised, not smoothed)."""

    mode: laplace.Mode
    x: Float[Array, "s p"]
    rows: Float[Array, "s n k"]
    v: Float[Array, "s d"]
    log_weight: Float[Array, "s"]
    log_weight_phi: Float[Array, "s"]  # of φ alone, before the correction for nonlinearity
    log_evidence: Float[Array, ""]
    log_evidence_error: Float[Array, ""]


class _Proposal(NamedTuple):
    """Student-t components: equally likely ones of one shape, and a wide one with the rest of the probability."""

    centre: Float[Array, "m d"]
    chol: Float[Array, "d d"]
    middle: Float[Array, "d"]
    wide: Float[Array, "d d"]
    share: Float[Array, ""]  # of the wide one

    def draw(self, key: Array, count: int) -> Float[Array, "s d"]:
        k1, k2, k3, k4 = jax.random.split(key, 4)
        dim = self.centre.shape[1]
        squares = jnp.sum(jax.random.normal(k2, (count, FREEDOM)) ** 2, axis=1)
        heavy = jnp.sqrt(FREEDOM / squares)
        normal = jax.random.normal(k3, (count, dim)) * heavy[:, None]
        which = jax.random.randint(k4, (count,), 0, len(self.centre))
        narrow = self.centre[which] + normal @ self.chol.T
        apart = jax.random.bernoulli(k1, self.share, (count, 1))
        return jnp.where(apart, self.middle + normal @ self.wide.T, narrow)

    def log_density(self, v: Float[Array, "s d"]) -> Float[Array, "s"]:
        dim = self.centre.shape[1]
        half = 0.5 * (FREEDOM + dim)
        norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * jnp.log(FREEDOM * jnp.pi)

        def whitened(chol, v):
            return solve_triangular(chol, v.T, lower=True).T if dim else v

        def log_t(chol, distance):
            return -jnp.sum(jnp.log(jnp.diag(chol))) - half * jnp.log1p(distance / FREEDOM)

        centre = whitened(self.chol, self.centre)

        def one(z):  # one draw at a time, so that memory does not grow with draws times components
            distance = jnp.sum((z - centre) ** 2, axis=1)
            return logsumexp(log_t(self.chol, distance)) - jnp.log(len(centre))

        narrow = over(one, whitened(self.chol, v), BATCH)
        wide = log_t(self.wide, jnp.sum(whitened(self.wide, v - self.middle) ** 2, axis=1))
        parts = narrow + jnp.log1p(-self.share), wide + jnp.log(self.share)
        return norm + jnp.logaddexp(*parts)


class PriorShare(NamedTuple):
    """Proper prior of φ's coordinates, that a share of the proposals is drawn from."""

    draw: Callable[[Array, int], Array]  # key, count → (s, d)
    log_density: Callable[[Array], Array]  # (s, d) → (s,)


def explore(
    mode,
    log_density: Callable[[Array], Array],
    prior: PriorShare | None,
    keys: tuple[Array, Array],
    proposals: int,
    rounds: int,
) -> tuple[Float[Array, "s d"], Float[Array, "s"]]:
    """Adapt to a density of φ's coordinates, then propose.

    Args:
        mode: anything with the density's mode `v` and the `covariance` of its Gaussian fit there.
        log_density: of one point, not normalised.
        prior: None where it is improper or cannot be drawn from.
        keys: of the adaptation and of the final proposals.
        proposals: of the final round; half as many in each round of adaptation.
        rounds: of adaptation.

    Returns:
        The proposals, and the log density that they are drawn from.
    """

    def adapt(proposal, key):
        v, log_proposal = _propose(prior, proposal, key, proposals // 2)
        log_phi = over(log_density, v, BATCH)
        return _match(mode, v, log_phi - log_proposal), None

    proposal, _ = jax.lax.scan(adapt, _around_mode(mode), jax.random.split(keys[0], rounds))
    return _propose(prior, proposal, keys[1], proposals)


def sample(
    layout: Layout,
    frame: Frame,
    y: Float[Array, "n"],
    mode: laplace.Mode,
    key: Array,
    proposals: int,
    rounds: int,
) -> WeightedDraws:
    """Adapt, then sample. Traceable as a whole, so that it can be mapped over data sets."""
    density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)
    adapt_key, draw_key, place_key = jax.random.split(key, 3)

    keys, share = (adapt_key, draw_key), _prior_share(layout)
    v, log_proposal = explore(mode, lambda v: density(v)[0], share, keys, proposals, rounds)

    def finish(args):
        one, key = args
        log_phi, found = density(one)
        x, rows, correction = draw_coefficients(layout, frame, y, mode.point, one, found, key)
        # Where there is no density there are no coefficients: a finite stand-in, for weight zero times NaN is NaN.
        some = jnp.isfinite(correction)
        x, rows = jnp.where(some, x, mode.point.x), jnp.where(some, rows, mode.point.rows)
        return log_phi, correction, x, rows

    extra_keys = jax.random.split(place_key, proposals)
    log_phi, correction, x, rows = over(finish, (v, extra_keys), BATCH)
    log_weight_phi = log_phi - log_proposal
    log_weight = log_weight_phi + jnp.where(jnp.isfinite(correction), correction, -1e300)
    evidence = logsumexp(log_weight) - jnp.log(proposals)
    relative = jnp.exp(log_weight - evidence)
    error = jnp.std(relative) / jnp.sqrt(proposals)
    return WeightedDraws(
        mode=mode,
        x=x,
        rows=rows,
        v=v,
        log_weight=log_weight,
        log_weight_phi=log_weight_phi,
        log_evidence=evidence,
        log_evidence_error=error,
    )


sample_jit = compiled(sample, many=0)  # thousands of proposals


@partial(compiled, many=0)
def sample_batch(
    layout: Layout, frames: Frame, ys: Float[Array, "b n"], keys: Array, proposals: int, rounds: int
) -> WeightedDraws:
    """Mode and `sample` over data sets of one shape, in one compiled program."""

    def one(frame, y, key):
        mode = laplace.find_mode(layout, frame, y)
        return sample(layout, frame, y, mode, key, proposals, rounds)

    return jax.vmap(one)(frames, ys, keys)


def _propose(
    prior: PriorShare | None, proposal: _Proposal, key: Array, count: int
) -> tuple[Float[Array, "s d"], Float[Array, "s"]]:
    """Coordinates of φ with the log density that they are drawn from: near the mode and, where proper, the prior."""
    k1, k2, k3 = jax.random.split(key, 3)
    near = proposal.draw(k1, count)
    if prior is None:
        return near, proposal.log_density(near)
    v = jnp.where(jax.random.bernoulli(k3, PRIOR, (count, 1)), prior.draw(k2, count), near)
    parts = jnp.log1p(-PRIOR) + proposal.log_density(v), jnp.log(PRIOR) + prior.log_density(v)
    return v, jnp.logaddexp(*parts)


def _prior_share(layout: Layout) -> PriorShare | None:
    if not layout.hypers or any(isinstance(h.prior, (Flat, FlatLine)) for h in layout.hypers):
        return None

    def draw(key, count):
        keys = jax.random.split(key, (len(layout.hypers), count))
        far = [jax.vmap(h.prior.sample)(k) for h, k in zip(layout.hypers, keys, strict=True)]
        return jnp.stack(far, axis=1)

    return PriorShare(draw, jax.vmap(lambda v: forward.hyper_log_prior(layout, v)))


def draw_coefficients(layout, frame, y, point, v, found: gaussian.Conditional, key):
    """x and the per-reading coefficients given φ, and the log ratio of the true joint density to what they are drawn
    from times the closed form: that of true to linearised likelihood."""
    hyper = forward.hyper_values(layout, v)
    k1, k2 = jax.random.split(key)
    normal = jax.random.normal(k1, found.u.shape)
    x, log_jacobian, rows = found.place(normal), found.log_jacobian, point.rows
    squares = jnp.sum(normal**2)
    if layout.row_blocks:
        line = forward.linearise(layout, frame, point.x, point.rows, hyper)
        straight = line.mean + line.jacobian @ (x - point.x)
        back = jnp.sum(line.rows * point.rows, axis=1)
        variance = layout.model.noise.variance(hyper, frame)
        own = jax.random.normal(k2, point.rows.shape)
        rows, volume = gaussian.draw_rows(layout, line, y - straight + back, variance, own)
        log_jacobian, squares = log_jacobian + volume, squares + jnp.sum(own**2)
    size = normal.size + rows.size
    log_drawn = -0.5 * (squares + size * jnp.log(2 * jnp.pi)) - log_jacobian
    true = jnp.sum(forward.log_likelihood(layout, frame, y, x, rows, hyper))
    prior = forward.log_prior_x(layout, x, rows, hyper)
    return x, rows, true + prior - log_drawn - found.log_marginal


def _around_mode(mode: laplace.Mode) -> _Proposal:
    dim = mode.v.shape[0]
    chol = jnp.linalg.cholesky(mode.covariance) if dim else mode.covariance
    centre = jnp.broadcast_to(mode.v, (KERNELS, dim))
    return _Proposal(
        centre=centre, chol=chol, middle=mode.v, wide=WIDE * chol, share=jnp.asarray(0.4)
    )


def _match(mode: laplace.Mode, v: Array, log_weight: Array) -> _Proposal:
    """The next proposal: around the weighted draws, as wide as the Laplace fit where few of them count."""
    if not v.shape[1]:
        return _around_mode(mode)
    weight = jax.nn.softmax(log_weight)
    weight = jnp.minimum(weight, 1 / jnp.sqrt(weight.size))  # truncation, Ionides 2008
    weight = weight / jnp.sum(weight)
    effective = 1 / jnp.sum(weight**2)
    trust = effective / (effective + 20.0 * v.shape[1])
    mean = weight @ v
    spread = (weight[:, None] * (v - mean)).T @ (v - mean)
    covariance = trust * spread + (1 - trust) * mode.covariance
    chol = jnp.linalg.cholesky(covariance + 1e-10 * jnp.eye(v.shape[1]))
    ladder = (jnp.arange(KERNELS) + 0.5) / KERNELS
    pick = jnp.minimum(jnp.searchsorted(jnp.cumsum(weight), ladder), weight.size - 1)
    wide = WIDE * jnp.linalg.cholesky(mode.covariance)
    return _Proposal(
        centre=v[pick], chol=KERNEL * chol, middle=mode.v, wide=wide, share=jnp.asarray(0.1)
    )
