"""What a population asks of its devices: sums over them at given spreads, and their own coefficients in the end.

A device is summed up by Λ and h (`population.py`). With T = diag(τ²) and M = (1 + ΛT)⁻¹, all that the population's
hyper-parameters depend on are three sums over the devices,

    Σ (hᵀT·M·h + log|M|),   Σ M·h,   Σ M·Λ,

which add up over any parts of a fleet. Padded devices have Λ = 0 and h = 0 and add nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.jax_setup import configure_jax
from bayescal._core.parallel import over

configure_jax()

TOGETHER = 16  # spreads evaluated at once
LEAST = (
    64  # devices in a program at least; beyond it powers of two, so that few programs are compiled
)


class Told(NamedTuple):
    """What the readings alone say of devices, in units of the coefficients' plausible sizes.

    Attributes:
        precision: Λ, (b, k, k).
        pull: h, (b, k).
    """

    precision: np.ndarray
    pull: np.ndarray


class Sums(NamedTuple):
    """Sums over devices at each of several spreads, or their slopes along log τ (leaves (s, k, …)).

    Attributes:
        level: Σ hᵀTMh + log|M|, (s,).
        pull: Σ M·h, (s, k).
        precision: Σ M·Λ, (s, k, k).
    """

    level: np.ndarray
    pull: np.ndarray
    precision: np.ndarray

    def __add__(self, other: Sums) -> Sums:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Sums(*(a + b for a, b in zip(self, other, strict=True)))


class DeviceMoments(NamedTuple):
    """Devices' coefficients under a population, in units of the plausible sizes: (b, k), (b, k, k)."""

    mean: np.ndarray
    covariance: np.ndarray


def sums(told: Told, scale: np.ndarray, v: np.ndarray) -> Sums:
    """Sums over devices at the spreads τ = scale·exp(v), v (s, k)."""
    return Sums(*map(np.asarray, _sums(*_padded(told), scale, v)))


def sums_and_slopes(told: Told, scale: np.ndarray, v: np.ndarray) -> tuple[Sums, Sums]:
    """The sums, and their derivatives along each of v, (s, k, …)."""
    values, slopes = _sums_and_slopes(*_padded(told), scale, v)
    return Sums(*map(np.asarray, values)), Sums(*map(np.asarray, slopes))


class Devices(Protocol):
    """Devices that stand somewhere, here or in parts on many machines, and add up their sums."""

    @property
    def count(self) -> int: ...

    def sums(self, scale: np.ndarray, v: np.ndarray) -> Sums: ...

    def sums_and_slopes(self, scale: np.ndarray, v: np.ndarray) -> tuple[Sums, Sums]: ...


@dataclass(frozen=True)
class Here:
    """Devices in this process."""

    told: Told

    @property
    def count(self) -> int:
        return len(self.told.pull)

    def sums(self, scale: np.ndarray, v: np.ndarray) -> Sums:
        return sums(self.told, scale, v)

    def sums_and_slopes(self, scale: np.ndarray, v: np.ndarray) -> tuple[Sums, Sums]:
        return sums_and_slopes(self.told, scale, v)


def device_moments(
    told: Told,
    scale: np.ndarray,
    v: np.ndarray,
    weights: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
) -> DeviceMoments:
    """Devices' own coefficients, averaged over weighted draws of the spreads.

    Args:
        told: the devices.
        scale, v: the draws, as of `sums`.
        weights: of the draws, adding up to one, (s,).
        mean, covariance: of the population's mean given each draw, (s, k) and (s, k, k).
    """
    count, likely = len(told.pull), int(np.argmax(weights))
    made = _moments(*_padded(told), scale, v, weights, mean, covariance, likely)
    return DeviceMoments(*(np.asarray(a)[:count] for a in made))


def _padded(told: Told) -> tuple[np.ndarray, np.ndarray]:
    count = len(told.pull)
    spare = max(LEAST, 1 << max(count - 1, 0).bit_length()) - count
    return (
        np.pad(told.precision, ((0, spare), (0, 0), (0, 0))),
        np.pad(told.pull, ((0, spare), (0, 0))),
    )


def _inverse(precision: Array, t: Float[Array, "k"]) -> Array:
    """M = (1 + ΛT)⁻¹ of each device."""
    return jnp.linalg.inv(jnp.eye(len(t)) + precision * t)


def _at(precision: Array, pull: Array, scale: Array, v: Float[Array, "k"]):
    t = (scale * jnp.exp(v)) ** 2
    inverse = _inverse(precision, t)
    pulled = jnp.einsum("bij,bj->bi", inverse, pull)
    level = jnp.sum(pull * t * pulled) + jnp.sum(jnp.linalg.slogdet(inverse)[1])
    return level, jnp.sum(pulled, axis=0), jnp.sum(inverse @ precision, axis=0)


@jax.jit
def _sums(precision: Array, pull: Array, scale: Array, v: Array):
    return over(partial(_at, precision, pull, scale), v, TOGETHER)


@jax.jit
def _sums_and_slopes(precision: Array, pull: Array, scale: Array, v: Array):
    def one(v: Array):
        def both(v: Array):
            found = _at(precision, pull, scale, v)
            return found, found

        slopes, values = jax.jacfwd(both, has_aux=True)(v)
        return values, jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), slopes)

    return over(one, v, TOGETHER)


@partial(jax.jit, static_argnames="likely")
def _moments(precision, pull, scale, v, weights, mean, covariance, likely):
    def given(v, mean, covariance):
        """c | m has covariance T·M and mean m + T·M·(h − Λm); m is integrated over its own."""
        t = (scale * jnp.exp(v)) ** 2
        inner = t[:, None] * _inverse(precision, t)
        inner = 0.5 * (inner + jnp.swapaxes(inner, 1, 2))
        slope = jnp.eye(len(t)) - inner @ precision
        device = jnp.einsum("bij,bj->bi", inner, pull) + jnp.einsum("bij,j->bi", slope, mean)
        return device, inner + slope @ covariance @ jnp.swapaxes(slope, 1, 2)

    # Second moments about the likeliest draw's means, which keeps their digits.
    about, _ = given(v[likely], mean[likely], covariance[likely])

    def add(total, one):
        weight, *draw = one
        device, inner = given(*draw)
        device = device - about
        new = device, inner + device[:, :, None] * device[:, None, :]
        return tuple(a + weight * b for a, b in zip(total, new, strict=True)), None

    start = jnp.zeros_like(pull), jnp.zeros_like(precision)
    first, second = jax.lax.scan(add, start, (weights, v, mean, covariance))[0]
    return about + first, second - first[:, :, None] * first[:, None, :]
