"""Sums over devices of which a population is learned, at given standard deviations τ; their coefficients under it.

A device is summed up by Λ and h (`population.py`), kept as its own estimate x̂ and e = h − Λx̂, which is small: it is
what its own prior pulled. With T = diag(τ²) and M = (1 + ΛT)⁻¹, all that the population's hyper-parameters depend on
are three sums over the devices,

    Σ hᵀT·M·h + log|M|  =  Σ −xᵀM·Λx + 2eᵀ(1 − Mᵀ)x + eᵀT·M·e + log|M|  +  a constant,
    Σ M·h  =  Σ M·Λx + M·e,
    Σ M·Λ,

with x = x̂ − c, the coefficients counted from a common centre c. Written so, no term is larger than the scatter of the
devices in parts of τ asks for, and the order of summing does not show. Padded devices have Λ = 0, x = 0 and e = 0 and
add nothing. The sums add up over any parts of a fleet.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.errors import InputError
from bayescal._core.jax_setup import configure_jax
from bayescal._core.parallel import over

configure_jax()

TOGETHER = 16  # standard deviations evaluated at once
LEAST = 64  # devices in a program; beyond it powers of two, so that few are compiled


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

    def save(self, path: Path) -> None:
        """Keep them as numbers (b, k, k + 2), which workers map into memory."""
        columns = self.precision, self.estimate[:, :, None], self.rest[:, :, None]
        with path.open("wb") as file:
            np.save(file, np.concatenate(columns, axis=2))


Part = DeviceEstimates | Path  # of a fleet: its devices, or the file that they were saved to


def loaded(part: Part) -> DeviceEstimates:
    """Estimates, from their file if they stand in one.

    Raises:
        InputError: it cannot be read.
    """
    if isinstance(part, DeviceEstimates):
        return part
    try:
        held = np.load(part, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{part} cannot be read: {error}. Run the same command again") from None
    return DeviceEstimates(held[:, :, :-2], held[:, :, -2], held[:, :, -1])


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


def count(part: Part) -> tuple[int, np.ndarray]:
    """How many devices, and the sum of their estimates, (k,)."""
    own = loaded(part).estimate
    return len(own), own.sum(axis=0)


def sums(part: Part, centre: np.ndarray, scale: np.ndarray, v: np.ndarray) -> Sums:
    """Sums over devices, counted from a centre, at the standard deviations τ = scale·exp(v), v (s, k)."""
    return Sums(*map(np.asarray, _sums(_padded(loaded(part), centre), scale, v)))


def sums_and_slopes(
    part: Part, centre: np.ndarray, scale: np.ndarray, v: np.ndarray
) -> tuple[Sums, Sums]:
    """The sums, and their derivatives along each of v, (s, k, …)."""
    values, slopes = _sums_and_slopes(_padded(loaded(part), centre), scale, v)
    return Sums(*map(np.asarray, values)), Sums(*map(np.asarray, slopes))


def device_moments(devices: DeviceEstimates, draws: PopulationDraws) -> DeviceMoments:
    """Devices' own coefficients, averaged over the draws."""
    count, likely = len(devices.estimate), int(np.argmax(draws.weights))
    made = _moments(_padded(devices, draws.centre), draws, likely)
    moments = DeviceMoments(*(np.asarray(a)[:count] for a in made))
    return moments._replace(mean=moments.mean + draws.centre)


def _padded(devices: DeviceEstimates, centre: np.ndarray) -> DeviceEstimates:
    count = len(devices.estimate)
    spare = max(LEAST, 1 << max(count - 1, 0).bit_length()) - count
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


def _at(devices: DeviceEstimates, scale: Array, v: Float[Array, "k"]):
    t = (scale * jnp.exp(v)) ** 2
    inverse = _inverse(devices.precision, t)
    x, rest, weighed = devices.estimate, devices.rest, inverse @ devices.precision
    pulled, pulled_rest = _times(weighed, x), _times(inverse, rest)
    level = jnp.sum(rest * (t * pulled_rest + 2 * x) - x * (pulled + 2 * pulled_rest))
    level = level + jnp.sum(jnp.linalg.slogdet(inverse)[1])
    return level, jnp.sum(pulled + pulled_rest, axis=0), jnp.sum(weighed, axis=0)


@jax.jit
def _sums(devices: DeviceEstimates, scale: Array, v: Array):
    return over(partial(_at, devices, scale), v, TOGETHER)


@jax.jit
def _sums_and_slopes(devices: DeviceEstimates, scale: Array, v: Array):
    def one(v: Array):
        def both(v: Array):
            sums = _at(devices, scale, v)
            return sums, sums

        slopes, values = jax.jacfwd(both, has_aux=True)(v)
        return values, jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), slopes)

    return over(one, v, TOGETHER)


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
