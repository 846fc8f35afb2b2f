"""Spreads of a population, τ: the density of their logarithms from sums over the devices, its mode, weighted draws."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from bayescal._core.importance_weights import smoothed
from bayescal._fleet.device_sums import DeviceSource, Sums
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal

DRAWS = 2000  # of τ, fewer for many devices: their posterior is narrow
CELLS = 1_000_000  # draws × devices at most
FREEDOM = 5.0  # of the Student-t that τ's logarithms are proposed from
DEFENCE = 0.1  # share of proposals from the prior
STEPS = 10  # of Newton to the mode, at most

Spread = HalfNormal | HalfCauchy | Flat


class SpreadDensity:
    """The density of log τ, and of m given it. Everything in units of the plausible sizes."""

    def __init__(
        self,
        devices: DeviceSource,
        spreads: Sequence[Spread],
        size: np.ndarray,
        weight: np.ndarray,
        centre: np.ndarray,
    ) -> None:
        """`weight` and `centre` are those of the prior of m, from the devices' centre; `size` the units of sums."""
        self.devices, self.spreads = devices, spreads
        self.weight, self.centre = weight, centre
        # A prior's coordinate v is the logarithm of τ over its scale.
        self.scale = np.array([s.scale for s in spreads]) / size
        self._prior_slope = jax.jit(jax.value_and_grad(self.log_prior))

    @property
    def size(self) -> int:
        return len(self.spreads)

    def log_prior(self, v) -> jax.Array:
        return sum((s.log_density(v[i]) for i, s in enumerate(self.spreads)), jnp.zeros(()))

    def population_mean(self, given: Sums) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of m given each spread: A⁻¹a and A⁻¹."""
        covariance = np.linalg.inv(given.precision + np.diag(self.weight))
        pull = given.pull + self.weight * self.centre
        return np.einsum("sij,sj->si", covariance, pull), covariance

    def log_density(self, v: np.ndarray) -> tuple[np.ndarray, Sums]:
        """At several spreads (s, k), and the sums that it was made of."""
        given = self.devices.sums(self.scale, v)
        prior = np.asarray(jax.vmap(self.log_prior)(jnp.asarray(v)))
        return prior + self._of_sums(given), given

    def _of_sums(self, given: Sums) -> np.ndarray:
        mean, covariance = self.population_mean(given)
        pull = given.pull + self.weight * self.centre
        volume = np.linalg.slogdet(covariance)[1]
        return 0.5 * (given.level + np.einsum("si,si->s", pull, mean) + volume)

    def negative(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minus the density's logarithm at several spreads (s, k), and its slopes."""
        given, slopes = self.devices.sums_and_slopes(self.scale, v)
        mean, covariance = self.population_mean(given)
        slope = slopes.level + 2 * np.einsum("skj,sj->sk", slopes.pull, mean)
        slope -= np.einsum("si,skij,sj->sk", mean, slopes.precision, mean)
        slope -= np.einsum("sij,skji->sk", covariance, slopes.precision)
        prior, prior_slope = jax.vmap(self._prior_slope)(jnp.asarray(v))
        return -(np.asarray(prior) + self._of_sums(given)), -(np.asarray(prior_slope) + 0.5 * slope)


def _mode(density: SpreadDensity) -> tuple[np.ndarray, np.ndarray]:
    """Where the density of log τ is greatest, and a root of its covariance there."""

    def one(v: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = density.negative(v[None])
        return float(value[0]), slope[0]

    starts = np.array([np.full(density.size, v) for v in (-6.0, -4.0, -2.0, -1.0, 0.0, 1.0)])
    start = starts[np.argmin(np.nan_to_num(density.negative(starts)[0], nan=np.inf))]
    best = minimize(one, start, jac=True, method="BFGS").x
    for _ in range(2):
        inverse, root = _curvature(density, best)
        best = best - inverse @ one(best)[1]
    # To the last digits, so that neither the optimiser's end nor the order of summing shows in what is drawn.
    last = np.inf
    for _ in range(STEPS):
        step = inverse @ one(best)[1]
        if not (size := float(np.max(np.abs(step)))) < 0.5 * last:
            break
        best, last = best - step, size
    return best, root


def _curvature(density: SpreadDensity, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of the second derivatives of minus the density's logarithm, and a root of it."""
    shifts = 1e-4 * np.eye(density.size)
    up, down = np.split(density.negative(np.concatenate([at + shifts, at - shifts]))[1], 2)
    values, vectors = np.linalg.eigh(0.5 * ((up - down) + (up - down).T) / 2e-4)
    # A spread that the devices do not show has a flat logarithm: no wider than a few units, its prior's width.
    root = vectors / np.sqrt(np.maximum(values, 0.1))
    return root @ root.T, root


def draws_of_spread(
    density: SpreadDensity, seed: int
) -> tuple[np.ndarray, np.ndarray, float, Sums]:
    """Draws of the logarithms of τ, with smoothed weights and k̂, and the sums at each."""
    best, root = _mode(density)
    count = int(np.clip(CELLS // max(1, density.devices.count), 200, DRAWS))
    random = np.random.default_rng(seed)
    normal = random.standard_normal((count, density.size))
    heavy = np.sqrt(FREEDOM / random.chisquare(FREEDOM, (count, 1)))
    v = best + 1.1 * (normal * heavy) @ root.T
    proper = not any(isinstance(s, Flat) for s in density.spreads)
    if proper:
        keys = jax.random.split(jax.random.key(seed), (density.size, count))
        far = [jax.vmap(s.sample)(k) for s, k in zip(density.spreads, keys, strict=True)]
        pick = random.random((count, 1)) < DEFENCE
        v = np.where(pick, np.stack([np.asarray(f) for f in far], axis=1), v)
    log_proposal = _log_t(v, best, 1.1 * root)
    if proper:
        prior = np.asarray(jax.vmap(density.log_prior)(jnp.asarray(v)))
        log_proposal = np.logaddexp(np.log1p(-DEFENCE) + log_proposal, np.log(DEFENCE) + prior)
    log_density, given = density.log_density(v)
    log_weight = np.where(np.isfinite(log_density), log_density, -1e300) - log_proposal
    weights, k_hat = smoothed(log_weight)
    return v, weights, k_hat, given


def _log_t(v: np.ndarray, centre: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Log density of a Student-t with this centre and root of its scale matrix."""
    dim = v.shape[1]
    z = np.linalg.solve(root, (v - centre).T)
    half = 0.5 * (FREEDOM + dim)
    norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * np.log(FREEDOM * np.pi)
    volume = np.linalg.slogdet(root)[1]
    return norm - volume - half * np.log1p(np.sum(z**2, axis=0) / FREEDOM)
