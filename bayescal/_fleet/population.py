"""A population of devices: each named coefficient's mean and spread over the devices, learned from all of them.

Each device has been fitted by itself and is summed up by a Gaussian N(x̂, C) of the named coefficients c. Its prior
N(m₀, s₀²) is taken out again, which leaves what the readings alone say, Λ = C⁻¹ − 1/s₀² and h = C⁻¹x̂ − m₀/s₀²; a
coefficient that a device's readings do not determine has Λ = 0 there and does no harm. Then

    c ~ N(m, diag(τ²)) over the devices,   m ~ N(m₀, s₀²),   τ ~ half-Cauchy(s₀), unless another prior is given.

m is integrated out in closed form; τ is sampled by importance sampling from its Laplace fit on

    log p(y | τ) = Σ_d ½ hᵀT(1 + ΛT)⁻¹h − ½ log|1 + TΛ| + ½ aᵀA⁻¹a − ½ log|A|,   T = diag(τ²),

    A = Σ_d (Λ⁻¹ + T)⁻¹ + 1/s₀²,   a = Σ_d (1 + ΛT)⁻¹h + m₀/s₀²

and each device's coefficients follow given τ and m, those that are not named by regression on them. So devices lend
each other strength, a device with few readings most of all. The devices enter by sums over them alone
(`device_sums.py`), which parts of a fleet add up for themselves.

Exact where the model is linear in its coefficients, Gaussian, and the noise known. Else two approximations stand: the
Gaussian summary of each device, and its noise, which stays at the device's own estimate.
Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 5.4, in several dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._fleet import device_sums
from bayescal._fleet.device_sums import DeviceEstimates, DeviceSource, LocalDevices
from bayescal._fleet.spread_draws import Spread, SpreadDensity, draws_of_spread
from bayescal._inference import trust
from bayescal._model.effect import Coefficient
from bayescal._model.model import Model
from bayescal._model.prior import HalfCauchy

FEWEST = 3  # devices from which a spread can be learned
ENOUGH = 50  # effective draws of τ, from which its mean and spread are known well enough

Named = Mapping[str, tuple[Coefficient, Spread]]  # a population's coefficients by name
AskedPopulation = (
    bool | Sequence[str] | Mapping[str, Spread]
)  # which those are: all, or some, or with priors


@dataclass(frozen=True)
class Population:
    """What the devices have in common.

    Attributes:
        table: per coefficient: mean and its standard uncertainty, spread (standard deviation between devices) and its
            standard uncertainty, unit.
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

    def __str__(self) -> str:
        head = f"population of {self.devices} devices"
        return f"{head}{'' if self.ok else ': ' + self.reason}\n{self.table.to_string(index=False)}"


def chosen(model: Model, asked: AskedPopulation) -> dict[str, tuple[Coefficient, Spread]]:
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


class Learned(NamedTuple):
    """A population, and what each device's coefficients follow from (arguments of `device_sums.device_moments`)."""

    population: Population
    centre: np.ndarray
    scale: np.ndarray
    v: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


class Pooled(NamedTuple):
    """The devices' named coefficients under the population, and the population."""

    mean: np.ndarray  # (b, k)
    covariance: np.ndarray  # (b, k, k)
    population: Population


def sizes(named: Named) -> np.ndarray:
    """Plausible sizes of the coefficients, the units of all sums: so all matrices are of order one."""
    return np.array([c.size for c, _ in named.values()])


def told(
    mean: Float[np.ndarray, "b k"], covariance: Float[np.ndarray, "b k k"], named: Named
) -> DeviceEstimates:
    """What the readings alone say of devices fitted each by itself: their own priors taken out again.

    Args:
        mean, covariance: of the named coefficients, in their units.
        named: the population's coefficients, in that order.
    """
    size, (weight, centre) = sizes(named), _prior(named)
    own = np.linalg.inv(covariance / np.outer(size, size))
    estimate = mean / size
    return DeviceEstimates(own - np.diag(weight), estimate, weight * (estimate - centre))


def _prior(named: Named) -> tuple[np.ndarray, np.ndarray]:
    """Weight and mean of each coefficient's own prior, in units of the plausible sizes."""
    parts = [c for c, _ in named.values()]
    weight = np.array([0.0 if c.flat else 1.0 for c in parts])
    return weight, np.array([c.mean / c.size for c in parts])


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
    devices = LocalDevices(told(mean, covariance, named))
    learned, size = learn(devices, named, seed), sizes(named)
    found = device_sums.device_moments(devices.told, *learned[1:])
    return Pooled(found.mean * size, found.covariance * np.outer(size, size), learned.population)


def learn(devices: DeviceSource, named: Named, seed: int) -> Learned:
    """Learn a population from sums over its devices.

    Args:
        devices: where they stand.
        named: the population's coefficients.
        seed: of every random number.
    """
    size, spreads = sizes(named), [spread for _, spread in named.values()]
    weight, centre = _prior(named)
    density = SpreadDensity(devices, spreads, size, weight, centre - devices.centre)
    draws, weights, k_hat, given = draws_of_spread(density, seed)
    mean, covariance = density.population_mean(given)
    spread = density.scale * np.exp(draws)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    table = pd.DataFrame(
        {
            "coefficient": list(named),
            "mean": (weights @ mean + devices.centre) * size,
            "mean_sd": np.sqrt(weights @ (variance + (mean - weights @ mean) ** 2)) * size,
            "spread": weights @ spread * size,
            "spread_sd": np.sqrt(weights @ (spread - weights @ spread) ** 2) * size,
            "unit": [c.unit for c, _ in named.values()],
        }
    )
    why = trust.unevenness(weights, k_hat, enough=ENOUGH)
    population = Population(
        table=table,
        ok=not why,
        reason=f"weights of the between-group standard deviations were uneven ({why})"
        if why
        else "",
        devices=devices.count,
        pareto_k=k_hat,
    )
    return Learned(population, devices.centre, density.scale, draws, weights, mean, covariance)
