"""A population of devices: each named coefficient's mean and standard deviation over the devices, from all of them.

Each device has been fitted by itself and is summed up by a Gaussian N(x̂, C) of the named coefficients c. Its prior
N(m₀, s₀²) is taken out again, which leaves what the readings alone say, Λ = C⁻¹ − 1/s₀² and h = C⁻¹x̂ − m₀/s₀²; a
coefficient that a device's readings do not determine has Λ = 0 there and does no harm. Then

    c ~ N(m, diag(τ²)) over the devices,   m ~ N(m₀, s₀²),   τ ~ half-Cauchy(s₀), unless another prior is given.

m is integrated out in closed form; τ is sampled by importance sampling from its Laplace fit on

    log p(y | τ) = Σ_d ½ hᵀT(1 + ΛT)⁻¹h − ½ log|1 + TΛ| + ½ aᵀA⁻¹a − ½ log|A|,   T = diag(τ²),

    A = Σ_d (Λ⁻¹ + T)⁻¹ + 1/s₀²,   a = Σ_d (1 + ΛT)⁻¹h + m₀/s₀²

and each device's coefficients follow given τ and m, those that are not named by regression on them. So devices lend
each other strength, a device with few readings most of all. The devices enter by sums over them alone, block by block.
A device is kept as its own estimate x̂ and e = h − Λx̂, which is small: it is what its own
prior pulled. With M = (1 + ΛT)⁻¹ the sums are

    Σ hᵀT·M·h + log|M|  =  Σ −xᵀM·Λx + 2eᵀ(1 − Mᵀ)x + eᵀT·M·e + log|M|  +  a constant,
    Σ M·h  =  Σ M·Λx + M·e,
    Σ M·Λ,

with x = x̂ − c, the coefficients counted from a common centre c. Written so, no term is larger than the scatter of the
devices in parts of τ asks for, and the order of summing does not show. Padded devices have Λ = 0, x = 0 and e = 0 and
add nothing.

Exact where the model is linear in its coefficients, Gaussian, and the noise known. Else two approximations stand: the
Gaussian summary of each device, and its noise, which stays at the device's own estimate.
Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 5.4, in several dimensions.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

from bayescal import Coefficient, Flat, HalfCauchy, HalfNormal, Model, ModelError
from bayescal._core.importance_weights import smoothed
from bayescal._core.jax_setup import configure_jax
from bayescal._core.parallel import over
from bayescal._inference import trust
from bayescal._inference.newton import ByValues, climb, gaussian_fit
from bayescal._inference.sampling import PriorShare, around_mode, propose

# Devices from which a standard deviation between them can be learned: of two, it is their distance.
FEWEST_DEVICES = 3
# Effective draws of a population's standard deviations, from which their means and standard uncertainties are known
# well enough: to 1/√(2·50), a tenth.
POPULATION_DRAWS = 50

configure_jax()

SPREADS_TOGETHER = 16  # standard deviations evaluated at once
LEAST_DEVICES = 64  # devices in a program; beyond it powers of two, so that few are compiled
BLOCK_DEVICES = (
    16_384  # summed at once: what the standard deviations evaluated together take, bounded
)


class DeviceEstimates(NamedTuple):
    """What the readings alone say of devices, in units of the coefficients' plausible sizes.

    Attributes:
        precision: Λ, (b, k, k).
        estimate: x̂, (b, k).
        rest: e, (b, k).
    """

    precision: np.ndarray
    estimate: np.ndarray
    rest: np.ndarray


class Sums(NamedTuple):
    """Sums over devices at each of several standard deviations τ, or their slopes along log τ (leaves (s, k, …)).

    Attributes:
        level: Σ hᵀTMh + log|M|, but for a constant, (s,).
        pull: Σ M·h, (s, k).
        precision: Σ M·Λ, (s, k, k).
    """

    level: np.ndarray
    pull: np.ndarray
    precision: np.ndarray


class DeviceMoments(NamedTuple):
    """Devices' coefficients under a population, in units of the plausible sizes: (b, k), (b, k, k)."""

    mean: np.ndarray
    covariance: np.ndarray


class PopulationDraws(NamedTuple):
    """Weighted draws of the standard deviations τ, and of the population's mean given each.

    Attributes:
        centre: from which coefficients are counted, (k,).
        scale, v: τ = scale·exp(v), (k,) and (s, k).
        weights: of the draws, adding up to one, (s,).
        mean, covariance: of the population's mean less the centre, given each draw, (s, k) and (s, k, k).
    """

    centre: np.ndarray
    scale: np.ndarray
    v: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def sums(devices: DeviceEstimates, centre: np.ndarray, scale: np.ndarray, v: np.ndarray) -> Sums:
    """Sums over devices, counted from a centre, at the standard deviations τ = scale·exp(v), v (s, k)."""
    return _total(_sums, devices, centre, scale, v)


def sums_and_slopes(
    devices: DeviceEstimates, centre: np.ndarray, scale: np.ndarray, v: np.ndarray
) -> tuple[Sums, Sums]:
    """The sums, and their derivatives along each of v, (s, k, …)."""
    return _total(_sums_and_slopes, devices, centre, scale, v)


def _total(
    function: Callable[..., Any], devices: DeviceEstimates, centre: np.ndarray, *at: np.ndarray
) -> Any:
    """What a function gives of blocks of devices, added up from the first to the last."""
    parts = (function(_padded(block, centre), *at) for block in _blocks(devices))
    return jax.tree.map(np.asarray, reduce(partial(jax.tree.map, operator.add), parts))


def _blocks(devices: DeviceEstimates) -> Iterator[DeviceEstimates]:
    for begin in range(0, len(devices.estimate), BLOCK_DEVICES):
        yield DeviceEstimates(*(a[begin : begin + BLOCK_DEVICES] for a in devices))


def _padded(devices: DeviceEstimates, centre: np.ndarray) -> DeviceEstimates:
    count = len(devices.estimate)
    spare = max(LEAST_DEVICES, 1 << max(count - 1, 0).bit_length()) - count
    return DeviceEstimates(
        np.pad(devices.precision, ((0, spare), (0, 0), (0, 0))),
        np.pad(devices.estimate - centre, ((0, spare), (0, 0))),
        np.pad(devices.rest, ((0, spare), (0, 0))),
    )


def _inverse(precision: Any, t: Any) -> Array:
    """M = (1 + ΛT)⁻¹ of each device."""
    return jnp.linalg.inv(jnp.eye(len(t)) + precision * t)


def _times(matrices: Any, vectors: Any) -> Array:
    return jnp.einsum("bij,bj->bi", matrices, vectors)


def _sums_at(devices: DeviceEstimates, scale: Array, v: Float[Array, "k"]):
    t = (scale * jnp.exp(v)) ** 2
    inverse = _inverse(devices.precision, t)
    x, rest, weighed = devices.estimate, devices.rest, inverse @ devices.precision
    pulled, pulled_rest = _times(weighed, x), _times(inverse, rest)
    level = jnp.sum(rest * (t * pulled_rest + 2 * x) - x * (pulled + 2 * pulled_rest))
    level = level + jnp.sum(jnp.linalg.slogdet(inverse)[1])
    return Sums(level, jnp.sum(pulled + pulled_rest, axis=0), jnp.sum(weighed, axis=0))


@jax.jit
def _sums(devices: DeviceEstimates, scale: Array, v: Array):
    return over(partial(_sums_at, devices, scale), v, SPREADS_TOGETHER)


@jax.jit
def _sums_and_slopes(devices: DeviceEstimates, scale: Array, v: Array):
    def one(v: Array):
        def both(v: Array):
            sums = _sums_at(devices, scale, v)
            return sums, sums

        slopes, values = jax.jacfwd(both, has_aux=True)(v)
        return values, jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), slopes)

    return over(one, v, SPREADS_TOGETHER)


@partial(jax.jit, static_argnames="likely")
def _moments(devices: DeviceEstimates, draws: PopulationDraws, likely: int):
    _, scale, v, weights, mean, covariance = draws

    def given(v, mean, covariance):
        """c | m has covariance T·M and mean m + T·M·(h − Λm); m is integrated over its own."""
        t = (scale * jnp.exp(v)) ** 2
        inner = t[:, None] * _inverse(devices.precision, t)
        inner = 0.5 * (inner + jnp.swapaxes(inner, 1, 2))
        share = inner @ devices.precision
        slope = jnp.eye(len(t)) - share
        device = _times(share, devices.estimate) + _times(inner, devices.rest)
        device = device + jnp.einsum("bij,j->bi", slope, mean)
        return device, inner + slope @ covariance @ jnp.swapaxes(slope, 1, 2)

    # Second moments about the likeliest draw's means, which keeps their digits.
    about, _ = given(v[likely], mean[likely], covariance[likely])

    def add(total, one):
        weight, *draw = one
        device, inner = given(*draw)
        device = device - about
        new = device, inner + device[:, :, None] * device[:, None, :]
        return tuple(a + weight * b for a, b in zip(total, new, strict=True)), None

    start = jnp.zeros_like(devices.estimate), jnp.zeros_like(devices.precision)
    first, second = jax.lax.scan(add, start, (weights, v, mean, covariance))[0]
    return about + first, second - first[:, :, None] * first[:, None, :]


DRAWS = 2000  # of τ, fewer for many devices: their posterior is narrow
CELLS = 1_000_000  # draws × devices at most
STARTS = (-6.0, -4.0, -2.0, -1.0, 0.0, 1.0)  # of log(τ/scale), where its mode is looked for first
NEWTON_STEPS = 3  # of Newton at the mode
NUDGE, SIDES = 1e-5, np.array([-1.0, 1.0])  # of v, for the slopes of priors

GroupSdPrior = HalfNormal | HalfCauchy | Flat  # prior of a standard deviation between devices
Named = Mapping[str, tuple[Coefficient, GroupSdPrior]]  # a population's coefficients by name
# Which those are: all, or some, or with priors.
AskedPopulation = bool | Sequence[str] | Mapping[str, GroupSdPrior]
COLUMNS = ("coefficient", "mean", "mean_sd", "group_sd", "group_sd_sd", "unit")
FORMER = {"spread": "group_sd", "spread_sd": "group_sd_sd"}  # names of columns; the old go in 0.3.0


@dataclass(frozen=True)
class Population:
    """What the devices have in common.

    Attributes:
        table: per coefficient: mean and its standard uncertainty, standard deviation between devices (`group_sd`) and
            its standard uncertainty, unit.
        ok: whether the weights of the between-group standard deviations are reliable.
        reason: why not.
        devices: how many it was learned from.
        pareto_k: of the weights.
    """

    table: pd.DataFrame
    ok: bool
    reason: str
    devices: int
    pareto_k: float

    def data(self) -> dict[str, Any]:
        """Plain JSON."""
        return {**vars(self), "table": self.table.to_dict("records")}

    @classmethod
    def of_data(cls, held: Mapping[str, Any]) -> Population:
        """From what `data` gave, or gave before 0.2.0."""
        table = pd.DataFrame(held["table"]).rename(columns=FORMER)
        return cls(**{**held, "table": table.reindex(columns=list(COLUMNS))})

    def __str__(self) -> str:
        head = f"population of {self.devices} devices"
        return f"{head}{'' if self.ok else ': ' + self.reason}\n{self.table.to_string(index=False)}"


def chosen(model: Model, asked: AskedPopulation) -> Named:
    """The coefficients of a population, each with the prior of its standard deviation between devices.

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


class Learned(NamedTuple):
    """A population as it is reported, and the draws that each device's coefficients follow from.

    Attributes:
        population: as it is reported.
        size: plausible sizes of the coefficients, the units of the draws: so all matrices are of order one, (k,).
        draws: of the standard deviations, and of the population's mean given each.
    """

    population: Population
    size: np.ndarray
    draws: PopulationDraws

    def moments(self, devices: DeviceEstimates) -> DeviceMoments:
        """The devices' coefficients under the population, averaged over the draws, in their units."""
        draws, size = self.draws, self.size
        made = _moments(_padded(devices, draws.centre), draws, int(np.argmax(draws.weights)))
        mean, covariance = (np.asarray(a)[: len(devices.estimate)] for a in made)
        return DeviceMoments((mean + draws.centre) * size, covariance * np.outer(size, size))


def estimates(
    mean: Float[np.ndarray, "b k"], covariance: Float[np.ndarray, "b k k"], named: Named
) -> DeviceEstimates:
    """What the readings alone say of devices fitted each by itself: their own priors taken out again.

    Args:
        mean, covariance: of the named coefficients, in their units.
        named: the population's coefficients, in that order.
    """
    size, weight, centre = _prior(named)
    own = np.linalg.inv(covariance / np.outer(size, size))
    estimate = mean / size
    return DeviceEstimates(own - np.diag(weight), estimate, weight * (estimate - centre))


def _prior(named: Named) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plausible size of each coefficient; in units of it, weight and mean of the coefficient's own prior."""
    parts = [c for c, _ in named.values()]
    size = np.array([c.size for c in parts])
    weight = np.array([0.0 if c.flat else 1.0 for c in parts])
    return size, weight, np.array([c.mean for c in parts]) / size


def learn(devices: DeviceEstimates, named: Named, seed: int) -> Learned:
    """Learn a population from its devices.

    Args:
        devices: what their readings alone say.
        named: the population's coefficients.
        seed: of every random number.

    Raises:
        ModelError: fewer than three devices that can be trusted.
    """
    if (count := len(devices.estimate)) < (fewest := FEWEST_DEVICES):
        raise ModelError(
            f"a population is learned from at least {fewest} devices that converge; here {count} did"
        )
    density = _Density(devices, named)
    v, weights, k_hat, given = _draws(density, seed)
    mean, covariance = density.population_mean(given)
    size, between = density.size, density.scale * np.exp(v)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    table = pd.DataFrame(
        {
            "coefficient": list(named),
            "mean": (weights @ mean + density.centre) * size,
            "mean_sd": np.sqrt(weights @ (variance + (mean - weights @ mean) ** 2)) * size,
            "group_sd": weights @ between * size,
            "group_sd_sd": np.sqrt(weights @ (between - weights @ between) ** 2) * size,
            "unit": [c.unit for c, _ in named.values()],
        }
    )
    why = trust.unevenness(weights, k_hat, enough=POPULATION_DRAWS)
    reason = why and f"weights of the between-group standard deviations were uneven ({why})"
    population = Population(table, not why, reason, count, k_hat)
    draws = PopulationDraws(density.centre, density.scale, v, weights, mean, covariance)
    return Learned(population, size, draws)


class _Density:
    """The density of v = log(τ/scale), and of m given it. Everything in units of the plausible sizes."""

    def __init__(self, devices: DeviceEstimates, named: Named) -> None:
        self.devices, self.centre = devices, devices.estimate.mean(axis=0)
        self.priors = [prior for _, prior in named.values()]
        self.size, self.weight, own = _prior(named)
        self.own = own - self.centre  # mean of the prior of m, counted from the centre
        self.scale = np.array([prior.scale for prior in self.priors]) / self.size

    def population_mean(self, given: Sums) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of m given each τ: A⁻¹a and A⁻¹."""
        covariance = np.linalg.inv(given.precision + np.diag(self.weight))
        pull = given.pull + self.weight * self.own
        return np.einsum("sij,sj->si", covariance, pull), covariance

    def log_density(self, v: np.ndarray) -> tuple[np.ndarray, Sums]:
        """At several v (s, k), and the sums that it was made of."""
        given = sums(self.devices, self.centre, self.scale, v)
        return self.log_prior(v) + self._of_sums(given), given

    def log_prior(self, v: np.ndarray) -> np.ndarray:
        return np.sum([p.log_density(v[:, i]) for i, p in enumerate(self.priors)], axis=0)

    def prior_draws(self, random: np.random.Generator, count: int) -> np.ndarray:
        key = jax.random.key(int(random.integers(1 << 31)))
        keys = jax.random.split(key, (len(self.priors), count))
        each = zip(self.priors, keys, strict=True)
        return np.stack([np.asarray(jax.vmap(p.sample)(own)) for p, own in each], axis=1)

    def _of_sums(self, given: Sums) -> np.ndarray:
        mean, covariance = self.population_mean(given)
        pull = given.pull + self.weight * self.own
        volume = np.linalg.slogdet(covariance)[1]
        return 0.5 * (given.level + np.einsum("si,si->s", pull, mean) + volume)

    def values(self, v: np.ndarray) -> np.ndarray:
        """Its logarithm at several v."""
        return np.nan_to_num(self.log_density(v)[0], nan=-np.inf)

    def slope(self, v: np.ndarray) -> tuple[float, np.ndarray]:
        """Its logarithm at one v (k,), and the slopes."""
        given, slopes = sums_and_slopes(self.devices, self.centre, self.scale, v[None])
        (mean,), (covariance,) = self.population_mean(given)
        level, pull, precision = (leaf[0] for leaf in slopes)
        # ∂(aᵀA⁻¹a − log|A|), where A⁻¹a and A⁻¹ are mean and covariance of m
        slope = level + 2 * pull @ mean - mean @ precision @ mean
        slope -= np.einsum("ij,kji->k", covariance, precision)
        ends = [p.log_density(v[i] + NUDGE * SIDES) for i, p in enumerate(self.priors)]
        value = self.log_prior(v[None]) + self._of_sums(given)
        return float(value[0]), 0.5 * slope + np.diff(ends)[:, 0] / (2 * NUDGE)


def _draws(density: Any, seed: int) -> tuple[np.ndarray, np.ndarray, float, Sums]:
    """Draws of the logarithms of τ, with smoothed weights and k̂, and the sums at each."""
    starts = [np.full(len(density.size), v) for v in STARTS]
    by_values = ByValues(density.values)
    best = climb(by_values, starts[int(np.argmax(density.values(np.array(starts))))])
    covariance = gaussian_fit(by_values, best).covariance
    # To the last digits, so that the order of summing does not show in what is drawn.
    for _ in range(NEWTON_STEPS):
        best = best + covariance @ density.slope(best)[1]
    count = int(np.clip(CELLS // len(density.devices.estimate), 200, DRAWS))
    improper = any(isinstance(s, Flat) for s in density.priors)
    prior = None if improper else PriorShare(density.prior_draws, density.log_prior)
    random = np.random.default_rng(seed)
    v, log_proposal = propose(around_mode(best, covariance), prior, random, count)
    log_density, given = density.log_density(v)
    log_weight = np.where(np.isfinite(log_density), log_density, -1e300) - log_proposal
    weights, k_hat = smoothed(log_weight)
    return v, weights, k_hat, given
