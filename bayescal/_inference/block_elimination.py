"""Elimination in two steps: deviations of a group's members first, each member by itself, then all else.

Readings of one cell know nothing of another cell's deviations, so that, with independent noise, the precision of x is
an arrow: small blocks on the diagonal, one for each member, and a border of what all share. Members are eliminated as
a batch of small Cholesky factors; the work grows with their number and no longer with its cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from bayescal._model.parameters import Layout

LEAST = 24  # coefficients of a group's members, from which splitting them off is worth it


@dataclass(frozen=True)
class Arrow:
    """Where in x the coefficients of each member stand, and the border."""

    of_members: tuple[tuple[int, ...], ...]
    of_border: tuple[int, ...]

    @cached_property
    def members(self) -> np.ndarray:
        """Positions (m, k)."""
        return np.array(self.of_members, dtype=int)

    @cached_property
    def border(self) -> np.ndarray:
        """Positions (b,)."""
        return np.array(self.of_border, dtype=int)

    @cached_property
    def inverse(self) -> np.ndarray:
        """Positions in (members in turn, border) of the entries of x in order."""
        return np.argsort(np.concatenate([self.members.ravel(), self.border]))

    def joined(self, members: Float[Array, "m k"], border: Float[Array, "b"]) -> Float[Array, "p"]:
        """A vector in the order of x."""
        return jnp.concatenate([members.reshape(-1), border])[self.inverse]


def arrow_of(layout: Layout) -> Arrow | None:
    """The largest group of members with deviations of their own; None where no elimination in steps is worth it."""
    if not layout.model.noise.independent:
        return None
    groups: dict[str, list[np.ndarray]] = {}
    for b in layout.x_blocks:
        if b.coefficient.per is not None:
            groups.setdefault(b.coefficient.per, []).append(np.arange(b.start, b.start + b.size))
    largest = max(groups.values(), key=lambda blocks: sum(len(b) for b in blocks), default=[])
    if sum(len(b) for b in largest) < LEAST:
        return None
    members = np.stack(largest, axis=1)
    border = np.setdiff1d(np.arange(layout.size), members)
    return Arrow(tuple(map(tuple, members.tolist())), tuple(border.tolist()))


class ArrowMatrix(eqx.Module):
    """The parts of a symmetric matrix (p, p) that an arrow has; times a vector with `@`."""

    arrow: Arrow = eqx.field(static=True)
    diagonal: Float[Array, "m k k"]
    cross: Float[Array, "m k b"]
    border: Float[Array, "b b"]

    def __matmul__(self, vector: Float[Array, "p"]) -> Float[Array, "p"]:
        own, shared = vector[self.arrow.members], vector[self.arrow.border]
        return self.arrow.joined(
            jnp.einsum("mij,mj->mi", self.diagonal, own) + self.cross @ shared,
            jnp.einsum("mib,mi->b", self.cross, own) + self.border @ shared,
        )


def cut(arrow: Arrow, matrix: Float[Array, "p p"]) -> ArrowMatrix:
    """The arrow's parts of a matrix."""
    at, border = arrow.members, arrow.border
    return ArrowMatrix(
        arrow,
        matrix[at[:, :, None], at[:, None, :]],
        matrix[at[:, :, None], border],
        matrix[np.ix_(border, border)],
    )


class ArrowFactor(eqx.Module):
    """L of LLᵀ, members before the border. It acts on vectors in the order of x."""

    arrow: Arrow = eqx.field(static=True)
    chol: Float[Array, "m k k"]
    cross: Float[Array, "m k b"]  # L⁻¹ of the members times what they share with the border
    border: Float[Array, "b b"]

    @property
    def log_diagonal(self) -> Float[Array, ""]:
        """Σ log Lᵢᵢ."""
        own = jnp.log(jnp.diagonal(self.chol, axis1=1, axis2=2))
        return jnp.sum(own) + jnp.sum(jnp.log(jnp.diag(self.border)))

    def forward(self, vector: Float[Array, "p"]) -> Float[Array, "p"]:
        """L⁻¹ times a vector."""
        own = _solve(self.chol, vector[self.arrow.members])
        rest = vector[self.arrow.border] - jnp.einsum("mib,mi->b", self.cross, own)
        return self.arrow.joined(own, solve_triangular(self.border, rest, lower=True))

    def back(self, vector: Float[Array, "p"]) -> Float[Array, "p"]:
        """Lᵀ⁻¹ times a vector."""
        shared = solve_triangular(self.border, vector[self.arrow.border], lower=True, trans=1)
        own = _solve(self.chol, vector[self.arrow.members] - self.cross @ shared, trans=1)
        return self.arrow.joined(own, shared)


def factor(matrix: ArrowMatrix, scale: Float[Array, "p"], weight: Float[Array, "p"]) -> ArrowFactor:
    """Factor of diag(scale)·matrix·diag(scale) + diag(weight)."""
    arrow = matrix.arrow
    own, shared = scale[arrow.members], scale[arrow.border]
    diagonal = own[:, :, None] * matrix.diagonal * own[:, None, :]
    diagonal = diagonal + weight[arrow.members][:, :, None] * jnp.eye(own.shape[1])
    chol = jnp.linalg.cholesky(diagonal)
    cross = _solve(chol, own[:, :, None] * matrix.cross * shared)
    border = shared[:, None] * matrix.border * shared + jnp.diag(weight[arrow.border])
    border = border - jnp.einsum("mib,mic->bc", cross, cross)
    return ArrowFactor(arrow, chol, cross, jnp.linalg.cholesky(border))


def _solve(chol: Float[Array, "m k k"], right: Array, trans: int = 0) -> Array:
    return jax.vmap(lambda c, r: solve_triangular(c, r, lower=True, trans=trans))(chol, right)
