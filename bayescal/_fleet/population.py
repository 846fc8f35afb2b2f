"""A population of devices: each named coefficient's mean and spread over the devices, learned from all of them.

Each device has been fitted by itself and is summed up by a Gaussian N(x̂, C) of the named coefficients c. Its prior
N(m₀, s₀²) is taken out again, which leaves what the readings alone say, Λ = C⁻¹ − 1/s₀² and h = C⁻¹x̂ − m₀/s₀²; a
coefficient that a device's readings do not determine has Λ = 0 there and does no harm. Then

    c ~ N(m, diag(τ²)) over the devices,   m ~ N(m₀, s₀²),   τ ~ half-Cauchy(s₀), unless another prior is given.

m is integrated out in closed form; τ is sampled by importance sampling from its Laplace fit on

    log p(y | τ) = Σ_d ½ hᵀT(1 + ΛT)⁻¹h − ½ log|1 + TΛ| + ½ aᵀA⁻¹a − ½ log|A|,   T = diag(τ²),

    A = Σ_d (Λ⁻¹ + T)⁻¹ + 1/s₀²,   a = Σ_d (1 + ΛT)⁻¹h + m₀/s₀²

and each device's coefficients follow given τ and m, those that are not named by regression on them. So devices lend
each other strength, a device with few readings most of all.

Exact where the model is linear in its coefficients, Gaussian, and the noise known. Else two approximations stand: the
Gaussian summary of each device, and its noise, which stays at the device's own estimate.
Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 5.4, in several dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float
from scipy.optimize import minimize
from scipy.special import gammaln

from bayescal._core.errors import ModelError
from bayescal._core.importance_weights import smoothed
from bayescal._core.parallel import over
from bayescal._inference import trust
from bayescal._model.effect import Coefficient
from bayescal._model.model import Model
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal

FEWEST = 3  # devices from which a spread can be learned
DRAWS = 2000  # of τ, fewer for many devices: their posterior is narrow
CELLS = 1_000_000  # draws × devices at most
ENOUGH = 50  # effective draws of τ, from which its mean and spread are known well enough
FREEDOM = 5.0  # of the Student-t that τ's logarithms are proposed from
DEFENCE = 0.1  # share of proposals from the prior
TOGETHER = 16  # draws evaluated at once

Spread = HalfNormal | HalfCauchy | Flat
Named = Mapping[str, tuple[Coefficient, Spread]]  # a population's coefficients by name


@dataclass(frozen=True)
class Population:
    """What the devices have in common.

    Attributes:
        table: per coefficient: mean and its standard uncertainty, spread (standard deviation between devices) and its
            standard uncertainty, unit.
        ok: whether the spreads' weights can be trusted.
        reason: why not.
        devices: how many it was learned from.
        pareto_k: of the weights.
    """

    table: pd.DataFrame
    ok: bool
    reason: str
    devices: int
    pareto_k: float

    def __str__(self) -> str:
        head = f"population of {self.devices} devices"
        return f"{head}{'' if self.ok else ': ' + self.reason}\n{self.table.to_string(index=False)}"


class Pooled(NamedTuple):
    """The devices' named coefficients under the population, and the population."""

    mean: np.ndarray  # (b, k)
    covariance: np.ndarray  # (b, k, k)
    population: Population


def chosen(
    model: Model, asked: bool | Sequence[str] | Mapping[str, Spread]
) -> dict[str, tuple[Coefficient, Spread]]:
    """The coefficients of a population, each with the prior of its spread.

    Raises:
        ModelError: a name is none of the model's single coefficients.
    """
    known = {
        e.coefficient_name(i): c
        for e in model.effects
        for i, c in enumerate(e.coefficients)
        if c.per is None and e.coefficient_name(i) not in dict(model.fixed)
    }
    names = list(known) if asked is True else list(asked or ())
    given = asked if isinstance(asked, Mapping) else {}
    for name in names:
        if name not in known:
            raise ModelError(
                f"population: no coefficient that each device has one of is called {name!r}; there is: "
                f"{', '.join(known)}"
            )
    return {n: (known[n], given.get(n, HalfCauchy(known[n].size))) for n in names}


def pool(
    mean: Float[np.ndarray, "b k"],
    covariance: Float[np.ndarray, "b k k"],
    named: Named,
    seed: int,
) -> Pooled:
    """Learn the population, and each device's named coefficients anew under it.

    Args:
        mean, covariance: of the named coefficients, of each device by itself, in their units.
        named: the population's coefficients, in that order.
        seed: of every random number.
    """
    parts = [c for c, _ in named.values()]
    prior_mean = np.array([c.mean for c in parts])
    precision = np.array([0.0 if c.flat else c.size**-2 for c in parts])
    # In units of each coefficient's plausible size, so that all matrices are of order one.
    size = np.array([c.size for c in parts])
    units = np.outer(size, size)
    own = np.linalg.inv(covariance / units)
    weight = precision * size**2
    told = own - np.diag(weight)
    pull = np.einsum("bij,bj->bi", own, mean / size) - weight * prior_mean / size
    spreads = [spread for _, spread in named.values()]
    density = _SpreadDensity(told, pull, weight, prior_mean / size, size=size, spreads=spreads)
    draws, weights, k_hat = _draws_of_spread(density, seed)
    found = density.moments(draws, weights)
    table = pd.DataFrame(
        {
            "coefficient": list(named),
            "mean": found.mean * size,
            "mean_sd": found.mean_sd * size,
            "spread": found.spread * size,
            "spread_sd": found.spread_sd * size,
            "unit": [c.unit for c in parts],
        }
    )
    why = trust.unevenness(weights, k_hat, enough=ENOUGH)
    population = Population(
        table=table,
        ok=not why,
        reason=f"weights of the spreads were uneven ({why})" if why else "",
        devices=len(mean),
        pareto_k=k_hat,
    )
    return Pooled(found.devices * size, found.covariances * units, population)


class _Moments(NamedTuple):
    mean: np.ndarray
    mean_sd: np.ndarray
    spread: np.ndarray
    spread_sd: np.ndarray
    devices: np.ndarray  # (b, k)
    covariances: np.ndarray  # (b, k, k)


class _SpreadDensity:
    """The density of log τ, and the devices given it. Everything in units of the plausible sizes."""

    def __init__(self, told, pull, weight, prior_mean, size, spreads: list[Spread]) -> None:
        self.told, self.pull = jnp.asarray(told), jnp.asarray(pull)
        self.weight, self.prior_mean = jnp.asarray(weight), jnp.asarray(prior_mean)
        self.spreads = spreads
        # A prior's coordinate v is the logarithm of τ over its scale.
        self.scale = jnp.asarray([s.scale for s in spreads]) / jnp.asarray(size)

    @property
    def size(self) -> int:
        return len(self.spreads)

    def _solved(self, v: Float[Array, "k"]):
        """T, (1 + ΛT)⁻¹ of each device, and A, a."""
        t = (self.scale * jnp.exp(v)) ** 2
        eye = jnp.eye(self.size)
        inverse = jnp.linalg.inv(eye + self.told * t)
        a = jnp.einsum("bij,bj->i", inverse, self.pull) + self.weight * self.prior_mean
        matrix = jnp.sum(inverse @ self.told, axis=0) + jnp.diag(self.weight)
        return t, inverse, matrix, a

    def log_density(self, v: Float[Array, "k"]) -> Float[Array, ""]:
        t, inverse, matrix, a = self._solved(v)
        fit = jnp.einsum("bi,i,bij,bj->", self.pull, t, inverse, self.pull)
        volume = jnp.sum(jnp.linalg.slogdet(inverse)[1])
        total = 0.5 * (fit + volume + a @ jnp.linalg.solve(matrix, a))
        total = total - 0.5 * jnp.linalg.slogdet(matrix)[1]
        return total + self.log_prior(v)

    def log_prior(self, v: Float[Array, "k"]) -> Float[Array, ""]:
        return sum((s.log_density(v[i]) for i, s in enumerate(self.spreads)), jnp.zeros(()))

    def given(self, v: Float[Array, "k"]):
        """Mean and covariance of m, and of each device's coefficients, given τ."""
        t, inverse, matrix, a = self._solved(v)
        covariance = jnp.linalg.inv(matrix)
        mean = covariance @ a
        # c | m: covariance T(1 + ΛT)⁻¹, mean m + covariance·(h − Λm); m integrated over its own.
        inner = t[:, None] * inverse
        inner = 0.5 * (inner + jnp.swapaxes(inner, 1, 2))
        slope = jnp.eye(self.size) - inner @ self.told
        device = jnp.einsum("bij,bj->bi", inner, self.pull) + jnp.einsum("bij,j->bi", slope, mean)
        total = inner + slope @ covariance @ jnp.swapaxes(slope, 1, 2)
        return mean, covariance, device, total

    def moments(self, draws: np.ndarray, weights: np.ndarray) -> _Moments:
        """Means and covariances over the draws of τ."""

        # Second moments about the likeliest draw's means, which keeps their digits.
        about, _, devices, _ = self.given(jnp.asarray(draws[np.argmax(weights)]))

        @jax.jit
        def summed(v, w):
            def add(total, one):
                v, w = one
                mean, covariance, device, inner = self.given(v)
                mean, device = mean - about, device - devices
                second = inner + device[:, :, None] * device[:, None, :]
                spread = self.scale * jnp.exp(v)
                new = (mean, jnp.diag(covariance) + mean**2, device, second, spread, spread**2)
                return tuple(a + w * b for a, b in zip(total, new, strict=True)), None

            k, b = self.size, len(self.pull)
            shapes = ((k,), (k,), (b, k), (b, k, k), (k,), (k,))
            start = tuple(jnp.zeros(s) for s in shapes)
            return jax.lax.scan(add, start, (v, w))[0]

        made = summed(jnp.asarray(draws), jnp.asarray(weights))
        mean, mean2, device, second, spread, spread2 = (np.asarray(a) for a in made)
        return _Moments(
            mean=np.asarray(about) + mean,
            mean_sd=np.sqrt(np.maximum(mean2 - mean**2, 0)),
            spread=spread,
            spread_sd=np.sqrt(np.maximum(spread2 - spread**2, 0)),
            devices=np.asarray(devices) + device,
            covariances=second - device[:, :, None] * device[:, None, :],
        )


def _draws_of_spread(density: _SpreadDensity, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Draws of the logarithms of τ, with smoothed weights and k̂."""
    slope = jax.jit(jax.value_and_grad(lambda v: -density.log_density(v)))

    def negative(v: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = slope(v)
        return float(value), np.asarray(gradient)

    starts = [np.full(density.size, v) for v in (-6.0, -4.0, -2.0, -1.0, 0.0, 1.0)]
    start = min(starts, key=lambda v: np.nan_to_num(negative(v)[0], nan=np.inf))
    best = minimize(negative, start, jac=True, method="BFGS").x
    shifts = 1e-4 * np.eye(density.size)
    curvature = [(negative(best + s)[1] - negative(best - s)[1]) / 2e-4 for s in shifts]
    curvature = np.array(curvature)
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    # A spread that the devices do not show has a flat logarithm: no wider than a few units, its prior's width.
    root = vectors / np.sqrt(np.maximum(values, 0.1))
    count = int(np.clip(CELLS // max(1, len(density.pull)), 200, DRAWS))
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
    log_density = np.asarray(
        jax.jit(lambda v: over(density.log_density, v, TOGETHER))(jnp.asarray(v))
    )
    log_weight = np.where(np.isfinite(log_density), log_density, -1e300) - log_proposal
    weights, k_hat = smoothed(log_weight)
    return v, weights, k_hat


def _log_t(v: np.ndarray, centre: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Log density of a Student-t with this centre and root of its scale matrix."""
    dim = v.shape[1]
    z = np.linalg.solve(root, (v - centre).T)
    half = 0.5 * (FREEDOM + dim)
    norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * np.log(FREEDOM * np.pi)
    volume = np.linalg.slogdet(root)[1]
    return norm - volume - half * np.log1p(np.sum(z**2, axis=0) / FREEDOM)
