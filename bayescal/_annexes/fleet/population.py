"""A population of devices: each named coefficient's mean and standard deviation over the devices, from all of them.

Each device has been fitted by itself and is summed up by a Gaussian N(x̂, C) of the named coefficients c. Its prior
N(m₀, s₀²) is taken out again, which leaves what the readings alone say, Λ = C⁻¹ − 1/s₀² and h = C⁻¹x̂ − m₀/s₀²; a
coefficient that a device's readings do not determine has Λ = 0 there and does no harm. Then

    c ~ N(m, diag(τ²)) over the devices,   m ~ N(m₀, s₀²),   τ ~ half-Cauchy(s₀), unless another prior is given.

m is integrated out in closed form; τ is sampled by importance sampling from its Laplace fit on

    log p(y | τ) = Σ_d ½ hᵀT(1 + ΛT)⁻¹h − ½ log|1 + TΛ| + ½ aᵀA⁻¹a − ½ log|A|,   T = diag(τ²),

    A = Σ_d (Λ⁻¹ + T)⁻¹ + 1/s₀²,   a = Σ_d (1 + ΛT)⁻¹h + m₀/s₀²

and each device's coefficients follow given τ and m, those that are not named by regression on them. So devices lend
each other strength, a device with few readings most of all. A device is kept as its own estimate x̂ and e = h − Λx̂,
which is small: it is what its own prior pulled. With M = (1 + ΛT)⁻¹ the sums are

    Σ hᵀT·M·h + log|M|  =  Σ −xᵀM·Λx + 2eᵀ(1 − Mᵀ)x + eᵀT·M·e + log|M|  +  a constant,
    Σ M·h  =  Σ M·Λx + M·e,
    Σ M·Λ,

with x = x̂ − c, the coefficients counted from a common centre c. Written so, no term is larger than the scatter of the
devices in parts of τ asks for.

Exact where the model is linear in its coefficients, Gaussian, and the noise known. Else two approximations stand: the
Gaussian summary of each device, and its noise, which stays at the device's own estimate.
Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 5.4, in several dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

import bayescal as bc
from bayescal import workshop as ws

# Devices from which a standard deviation between them can be learned: of two, it is their distance.
FEWEST_DEVICES = 3
# Effective draws of a population's standard deviations, from which their means and standard uncertainties are known
# well enough: to 1/√(2·50), a tenth.
POPULATION_DRAWS = 50
DRAWS = 2000  # of τ, fewer for many devices: their posterior is narrow
CELLS = 1_000_000  # draws × devices at most
STARTS = (-6.0, -4.0, -2.0, -1.0, 0.0, 1.0)  # of log(τ/scale), where its mode is looked for first

GroupSdPrior = (
    bc.HalfNormal | bc.HalfCauchy | bc.Flat
)  # prior of a standard deviation between devices
Named = Mapping[str, tuple[bc.Coefficient, GroupSdPrior]]  # a population's coefficients by name
# Which those are: all, or some, or with priors.
AskedPopulation = bool | Sequence[str] | Mapping[str, GroupSdPrior]


@dataclass(frozen=True)
class Population:
    """What the devices have in common."""

    # per coefficient: mean, standard deviation between devices (`group_sd`), their uncertainties, unit
    table: pd.DataFrame
    ok: bool  # whether the weights of the between-group standard deviations are reliable
    reason: str  # why not
    devices: int  # how many it was learned from
    pareto_k: float  # of the weights

    def data(self) -> dict[str, Any]:
        """Return plain JSON."""
        return {**vars(self), "table": self.table.to_dict("records")}

    def __str__(self) -> str:
        head = f"population that {self.devices} devices are drawn from"
        pairs = {
            "mean ± standard uncertainty": ("mean", "mean_sd"),
            "sd between devices ± standard uncertainty": ("group_sd", "group_sd_sd"),
        }
        columns = {h: map(ws.with_error, *(self.table[n] for n in p)) for h, p in pairs.items()}
        columns |= {"unit": map(ws.unit_label, self.table["unit"])}
        rows = zip(self.table["coefficient"], *columns.values(), strict=True)
        return f"{head}{'' if self.ok else ': ' + self.reason}\n{ws.plain_table(['coefficient', *columns], rows)}"


def chosen(model: bc.Model, requested: AskedPopulation) -> Named:
    """Return a population's coefficients, each with the prior of its standard deviation between devices.

    Raises:
        ModelError: a name is none of the model's single coefficients.
    """
    coefficients = {
        e.coefficient_name(i): c
        for e in model.effects
        for i, c in enumerate(e.coefficients)
        if c.per is None and e.coefficient_name(i) not in dict(model.fixed)
    }
    names = list(coefficients) if requested is True else list(requested or ())
    priors = requested if isinstance(requested, Mapping) else {}
    for name in names:
        if name not in coefficients:
            raise bc.ModelError(
                f"population: no coefficient that each device has one of is called {name!r}; there is: "
                f"{', '.join(coefficients)}"
            )
    return {n: (coefficients[n], priors.get(n, bc.HalfCauchy(coefficients[n].size))) for n in names}


class Pooled:
    """Devices and the population that they are of; all in units of the coefficients' plausible sizes.

    Args:
        mean, covariance: of the named coefficients of devices fitted each by itself, in their units.
        named: the population's coefficients, in that order.
    """

    def __init__(
        self,
        mean: Float[np.ndarray, "b k"],
        covariance: Float[np.ndarray, "b k k"],
        named: Named,
    ) -> None:
        parts, self.priors = zip(*named.values(), strict=True)
        self.size = np.array([c.size for c in parts])
        self.weight = np.array([0.0 if c.flat else 1.0 for c in parts])
        prior_mean = np.array([c.mean for c in parts]) / self.size
        scaled = mean / self.size
        self.centre = scaled.mean(axis=0)
        self.own = prior_mean - self.centre  # mean of the prior of m, from the centre
        self.scale = np.array([prior.scale for prior in self.priors]) / self.size
        # What the readings alone say: the device's own prior is taken out again.
        inverse = np.linalg.inv(covariance / np.outer(self.size, self.size))
        self.precision = inverse - np.diag(self.weight)
        self.estimate, self.rest = scaled - self.centre, self.weight * (scaled - prior_mean)

    def condition_on(self, v: Float[np.ndarray, "k"]) -> tuple[float, *tuple[np.ndarray, ...]]:
        """Return what follows from τ = scale·exp(v).

        Returns:
            Its log density; mean and covariance of m, from the centre; those of each device's coefficients, m
            integrated out: c | m has covariance T·M and mean m + T·M·(h − Λm).
        """
        t, x, e = (self.scale * np.exp(v)) ** 2, self.estimate, self.rest
        inverse = np.linalg.inv(np.eye(len(t)) + self.precision * t)
        weighed = inverse @ self.precision
        by_x, by_e = (weighed @ x[:, :, None])[:, :, 0], (inverse @ e[:, :, None])[:, :, 0]
        level = np.sum(e * (t * by_e + 2 * x) - x * (by_x + 2 * by_e))
        level += np.sum(np.linalg.slogdet(inverse)[1])
        covariance = np.linalg.inv(weighed.sum(axis=0) + np.diag(self.weight))
        pull = np.sum(by_x + by_e, axis=0) + self.weight * self.own
        mean = covariance @ pull
        value = 0.5 * (level + pull @ mean + np.linalg.slogdet(covariance)[1])
        value += self.log_prior(v[None])[0]
        inner = t[:, None] * inverse
        inner = 0.5 * (inner + inner.mT)
        slope = np.eye(len(t)) - inner @ self.precision
        device = x + (inner @ e[:, :, None])[:, :, 0] + (slope @ (mean - x)[:, :, None])[:, :, 0]
        return float(value), mean, covariance, device, inner + slope @ covariance @ slope.mT

    def log_prior(self, v: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "s"]:
        return np.sum([p.log_density(v[:, i]) for i, p in enumerate(self.priors)], axis=0)

    def values(self, v: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "s"]:
        """Return log densities."""
        return np.nan_to_num([self.condition_on(point)[0] for point in v], nan=-np.inf)

    def draws(self, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return draws of v, with smoothed weights and k̂."""
        starts = [np.full(len(self.size), v) for v in STARTS]
        density = ws.ByValues(self.values)
        best = ws.climb(density, starts[int(np.argmax(self.values(np.array(starts))))])
        covariance = ws.gaussian_fit(density, best).covariance
        count = int(np.clip(CELLS // len(self.estimate), 200, DRAWS))
        prior, random = ws.share_prior(self.priors, self.log_prior), np.random.default_rng(seed)
        v, log_proposal = ws.propose(ws.propose_at_mode(best, covariance), prior, random, count)
        log_density = self.values(v)
        log_weight = np.where(np.isfinite(log_density), log_density, -1e300) - log_proposal
        return v, *ws.smoothed(log_weight)


def learn(
    mean: Float[np.ndarray, "b k"], covariance: Float[np.ndarray, "b k k"], named: Named, seed: int
) -> tuple[Population, Float[np.ndarray, "b k"], Float[np.ndarray, "b k k"]]:
    """Learn a population from its devices; return it with their means and covariances under it.

    Args:
        mean, covariance: of the named coefficients of devices fitted each by itself, in their units.
        named: the population's coefficients, in that order.
        seed: of every random number.

    Raises:
        ModelError: fewer than three devices that can be trusted.
    """
    if (count := len(mean)) < FEWEST_DEVICES:
        raise bc.ModelError(
            f"a population is learned from at least {FEWEST_DEVICES} devices that converge; here {count} did"
        )
    pooled = Pooled(mean, covariance, named)
    v, weights, k_hat = pooled.draws(seed)
    about = pooled.condition_on(v[np.argmax(weights)])[3]  # keeps the digits of second moments
    centres, squares = np.zeros((len(v), len(named))), np.zeros((len(v), len(named)))
    first, second = np.zeros_like(mean), np.zeros_like(covariance)
    for i, (point, weight) in enumerate(zip(v, weights, strict=True)):
        _, centres[i], variance, device, inner = pooled.condition_on(point)
        squares[i], distance = np.diag(variance), device - about
        first += weight * distance
        second += weight * (inner + distance[:, :, None] * distance[:, None])
    second -= first[:, :, None] * first[:, None]
    size, between = pooled.size, pooled.scale * np.exp(v)
    middle = weights @ centres
    table = pd.DataFrame(
        {
            "coefficient": list(named),
            "mean": (middle + pooled.centre) * size,
            "mean_sd": np.sqrt(weights @ (squares + (centres - middle) ** 2)) * size,
            "group_sd": weights @ between * size,
            "group_sd_sd": np.sqrt(weights @ (between - weights @ between) ** 2) * size,
            "unit": [c.unit for c, _ in named.values()],
        }
    )
    why = ws.check_weights(weights, k_hat, min_ess=POPULATION_DRAWS)
    reason = why and f"weights of the between-group standard deviations were uneven ({why})"
    population = Population(table, not why, reason, count, k_hat)
    return population, (about + first + pooled.centre) * size, second * np.outer(size, size)


def follow(
    mean: Float[np.ndarray, "q"],
    covariance: Float[np.ndarray, "q q"],
    of: np.ndarray,
    new_mean: Float[np.ndarray, "k"],
    new: Float[np.ndarray, "k k"],
) -> tuple[Float[np.ndarray, "q"], Float[np.ndarray, "q q"]]:
    """Return all unknowns of a device, where those `of` have a new mean and covariance: by regression on them."""
    free = np.flatnonzero(np.isfinite(np.diag(covariance)))
    inner = covariance[np.ix_(of, of)]
    gain = covariance[np.ix_(free, of)] @ np.linalg.inv(inner)
    mean, covariance = mean.copy(), covariance.copy()
    mean[free] += gain @ (new_mean - mean[of])
    covariance[np.ix_(free, free)] += gain @ (new - inner) @ gain.T
    return mean, covariance
