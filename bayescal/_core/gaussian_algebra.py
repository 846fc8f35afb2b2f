"""Gaussian vectors by triangular factors: of a tall table, of many small matrices; and a vector given readings."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg.lapack import dgeqrf, dpotrf, dpotri, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

STRETCH = 8192  # rows
LOG_2PI = math.log(2 * math.pi)


def triangle(table: Float[Array, "n p"]) -> Float[Array, "q p"]:
    """R of the QR factors up to the signs of its rows; q is the smaller of n and p.

    A stretch of rows at a time: little memory, and each stretch stays in cache.
    """
    whole, columns = len(table) // STRETCH, table.shape[1]
    if whole < 2 or columns > STRETCH:
        return jnp.linalg.qr(table, mode="r")

    def further(i: Array, upper: Float[Array, "p p"]) -> Float[Array, "p p"]:
        rows = jax.lax.dynamic_slice_in_dim(table, i * STRETCH, STRETCH)
        return jnp.linalg.qr(jnp.concatenate([upper, rows]), mode="r")

    upper = jax.lax.fori_loop(1, whole, further, jnp.linalg.qr(table[:STRETCH], mode="r"))
    rest = table[whole * STRETCH :]
    return jnp.linalg.qr(jnp.concatenate([upper, rest]), mode="r") if len(rest) else upper


class QR(NamedTuple):
    """QR of a whitened table [A r]: R, Qᵀr, and what of r lies outside."""

    root: Float[np.ndarray, "q q"]
    inside: Float[np.ndarray, "q"]
    outside: float

    @property
    def determined(self) -> bool:
        scale = np.sqrt(np.sum(self.root**2, axis=0))
        return bool(np.all(np.abs(np.diag(self.root)) > 1e-14 * scale))

    @property
    def solution(self) -> Float[np.ndarray, "q"]:
        return dtrtrs(self.root, self.inside)[0] if self.inside.size else self.inside

    def damped(self, damping: float) -> Float[np.ndarray, "q"]:
        """The step that minimises |R·s − Qᵀr|² + damping·|weight·s|², weight the norms of R's columns."""
        if not damping:
            return self.solution
        weight = np.sqrt(np.sum(self.root**2, axis=0))
        rows = np.column_stack([np.diag(math.sqrt(damping) * weight), 0 * weight])
        return qr(np.concatenate([np.column_stack([self.root, self.inside]), rows])).solution


def qr(table: Float[np.ndarray, "m q1"]) -> QR:
    """Of a table whose last column is r."""
    upper, size = np.triu(dgeqrf(table)[0][: table.shape[1]]), table.shape[1] - 1
    last = float(upper[size, size]) if len(upper) > size else 0.0
    return QR(upper[:size, :size], upper[:size, size], last)


def factors(matrices: Float[np.ndarray, "b p p"]) -> Float[np.ndarray, "b p p"]:
    """Lower factors; NaN where there is none."""
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        pass
    found = np.full_like(matrices, np.nan)
    for one, into in zip(matrices, found, strict=True):
        try:
            into[...] = np.linalg.cholesky(one)
        except np.linalg.LinAlgError:
            continue
    return found


def solve_lower(chol: Float[np.ndarray, "b p p"], right: Float[np.ndarray, "b p"]) -> np.ndarray:
    """L⁻¹ times vectors."""
    z = np.empty_like(right)
    for i in range(right.shape[1]):
        known = np.einsum("bj,bj->b", chol[:, i, :i], z[:, :i])
        z[:, i] = (right[:, i] - known) / chol[:, i, i]
    return z


def solve_upper(chol: Float[np.ndarray, "b p p"], right: Float[np.ndarray, "b p"]) -> np.ndarray:
    """Lᵀ⁻¹ times vectors."""
    z = np.empty_like(right)
    for i in reversed(range(right.shape[1])):
        known = np.einsum("bj,bj->b", chol[:, i + 1 :, i], z[:, i + 1 :])
        z[:, i] = (right[:, i] - known) / chol[:, i, i]
    return z


class Prior(NamedTuple):
    """Prior of a Gaussian vector: mean, scale, and weight (1 proper, 0 flat)."""

    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]
    weight: Float[np.ndarray, "p"]


class Gram(NamedTuple):
    """Weighted products of a matrix J and a vector r, and log|Σ|: all that a Gaussian likelihood needs."""

    jtj: Float[np.ndarray, "p p"]
    jtr: Float[np.ndarray, "p"]
    rtr: float
    logdet: float

    @classmethod
    def of(cls, table: Float[np.ndarray, "n q"], logdet: float) -> Gram:
        """Of J and r in one whitened table."""
        whole = table.T @ table
        return cls(whole[:-1, :-1], whole[:-1, -1], float(whole[-1, -1]), logdet)


class Conditional(NamedTuple):
    """x given φ and the readings, x = shift + sd·L⁻ᵀ(u + ε), and the log density of the readings given φ."""

    log_marginal: float
    shift: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]
    chol: Float[np.ndarray, "p p"]
    u: Float[np.ndarray, "p"]
    rest: float  # sum of squares at the mean, the prior's share included

    def place(self, normal: Float[np.ndarray, "p m"] | Float[np.ndarray, "p"]) -> np.ndarray:
        """The x that standard normal numbers stand for; one column a draw."""
        u = self.u if normal.ndim == 1 else self.u[:, None]
        z = dtrtrs(self.chol, u + normal, lower=1, trans=1)[0] if self.u.size else normal
        return (self.shift + self.sd * z.T).T

    @property
    def mean(self) -> Float[np.ndarray, "p"]:
        return self.place(np.zeros_like(self.u))

    @property
    def covariance_of_z(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the whitened z."""
        if not self.u.size:
            return np.zeros((0, 0))
        inverse, _ = dpotri(self.chol, lower=1)
        return np.tril(inverse) + np.tril(inverse, -1).T

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        return self.sd[:, None] * self.covariance_of_z * self.sd

    @property
    def root(self) -> Float[np.ndarray, "p p"]:
        """A square root of the covariance of x."""
        return self.place(np.eye(self.u.size)) - self.mean[:, None]

    @property
    def log_jacobian(self) -> float:
        """Log volume of the map from standard normal numbers to x."""
        return float(np.sum(np.log(self.sd)) - np.sum(np.log(np.diag(self.chol))))


def condition(
    gram: Gram, size: int, prior: Prior, at: Float[np.ndarray, "p"]
) -> Conditional | None:
    """Integrate x out; None where the precision has no Cholesky factor.

    Args:
        gram: weighted products of J and r.
        size: number of readings.
        prior: prior of x.
        at: x̂, where r was taken.
    """
    sd, weight = prior.sd, prior.weight
    offset = weight * (prior.mean - at)
    if not sd.size:
        log_marginal = -0.5 * (size * LOG_2PI + gram.logdet + gram.rtr)
        return Conditional(log_marginal, at, sd, np.zeros((0, 0)), sd, gram.rtr)
    pulled = sd * (gram.jtr - gram.jtj @ offset)
    precision = sd[:, None] * gram.jtj * sd
    precision.flat[:: sd.size + 1] += weight
    chol, failed = dpotrf(precision.T, lower=1, clean=1, overwrite_a=1)
    if failed:
        return None
    pivots = chol.diagonal()
    u = dtrtrs(chol, pulled, lower=1)[0]
    z = dtrtrs(chol, u, lower=1, trans=1)[0]
    move = offset + sd * z
    rest = gram.rtr - move @ (2 * gram.jtr - gram.jtj @ move) + weight @ (z * z)
    if not rest > 0:  # no digits left: noise far below any residual
        return None
    flat = float((1 - weight) @ np.log(sd)) + float((1 - weight).sum()) * 0.5 * LOG_2PI
    volume = gram.logdet + 2 * float(np.log(pivots).sum())
    log_marginal = flat - 0.5 * (size * LOG_2PI + volume + rest)
    return Conditional(float(log_marginal), at + offset, sd, chol, u, float(rest))


def column_scale(jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p"]:
    """A scale for coefficients with a flat prior: the change that moves the output by one unit."""
    norm = np.sqrt(np.mean(jacobian**2, axis=0))
    return np.where(norm > 0, 1 / np.where(norm > 0, norm, 1.0), 1.0)
