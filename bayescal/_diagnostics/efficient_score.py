"""The efficient score: what the readings say of a column that is not in the model.

At the fitted model, with every nuisance marginalised under its prior (V = Σ + J·D·Jᵀ, spreads and noise at their
marginal-likelihood estimates), a column X has the score u = XᵀV⁻¹r and the information I = XᵀV⁻¹X. No refit per
candidate. Columns are scaled by their prior standard deviation, so that every prior here is standard normal.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.jit import compiled
from bayescal._inference.laplace import linearised
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

RANK = 1e-12  # of the largest eigenvalue, below which a direction was not fitted


class Score(NamedTuple):
    """Score and information of P columns.

    u (P,), information (P, P) after the nuisances; `before` (P,): information with every nuisance known.
    """

    u: np.ndarray
    information: np.ndarray
    before: np.ndarray

    def part(self, columns: list[int]) -> Score:
        at = np.ix_(columns, columns)
        return Score(self.u[columns], self.information[at], self.before[columns])

    def given(self, columns: list[int]) -> Score:
        """What the readings say of every column once these, under their unit priors, are nuisances too."""
        inner = self.information[np.ix_(columns, columns)] + np.eye(len(columns))
        cross = self.information[columns]
        pull = np.linalg.solve(inner, np.column_stack([cross, self.u[columns]]))
        left = self.information - cross.T @ pull[:, :-1]
        return Score(self.u - cross.T @ pull[:, -1], left, self.before)


@compiled
def _score(layout: Layout, frame: Frame, y: Array, mode, columns: Float[Array, "n m"]):
    line = linearised(layout, frame, y, mode)
    q = line.nuisance.shape[1]
    stacked = jnp.concatenate([line.nuisance * line.prior.sd, columns], axis=1)
    gram = layout.model.noise.gram(stacked, line.residual, line.extra, line.hyper, frame)
    inner = gram.jtj[:q, :q] + jnp.diag(line.prior.weight)
    cross, own = gram.jtj[:q, q:], gram.jtj[q:, q:]
    if q == 0:
        return gram.jtr, own, jnp.diag(own)
    solved = jnp.linalg.solve(inner, jnp.concatenate([cross, gram.jtr[:q, None]], axis=1))
    u = gram.jtr[q:] - cross.T @ solved[:, -1]
    return u, own - cross.T @ solved[:, :-1], jnp.diag(own)


def score(calibration: Calibration, columns: np.ndarray) -> Score:
    """Score and information of columns (n, P) at a fitted model, output unit per prior sd."""
    y = jnp.asarray(calibration.readings["output"])
    found = _score(calibration.layout, calibration.frame, y, calibration.mode, jnp.asarray(columns))
    u, information, before = (np.asarray(a) for a in found)
    return Score(u, 0.5 * (information + information.T), before)


@compiled
def _residuals(layout: Layout, frame: Frame, y: Array, mode):
    line = linearised(layout, frame, y, mode)
    noise = layout.model.noise
    q = line.nuisance.shape[1]
    scaled = line.nuisance * line.prior.sd
    gram = noise.gram(scaled, line.residual, line.extra, line.hyper, frame)
    fitted = jnp.zeros(frame.size)
    if q:
        fitted = scaled @ jnp.linalg.solve(gram.jtj + jnp.diag(line.prior.weight), gram.jtr)
    residual = line.residual - fitted
    white, _ = noise.whiten(residual[:, None], line.extra, line.hyper, frame)
    sd = jnp.sqrt(noise.variance(line.hyper, frame) + line.extra)
    return residual, white[:, 0], sd


class Residuals(NamedTuple):
    """Residuals at the fit (n,): in the output unit; whitened, so that sd is one and neighbours are independent if
    the noise law is right; and the standard deviation of the noise of each reading, output unit."""

    raw: np.ndarray
    white: np.ndarray
    sd: np.ndarray


def residuals(calibration: Calibration) -> Residuals:
    """Residuals of the fitted readings, group deviations as fitted."""
    y = jnp.asarray(calibration.readings["output"])
    found = _residuals(calibration.layout, calibration.frame, y, calibration.mode)
    return Residuals(*(np.asarray(a) for a in found))


@compiled
def _fitted_directions(layout: Layout, frame: Frame, y: Array, mode):
    line = linearised(layout, frame, y, mode)
    if not line.nuisance.shape[1]:
        return jnp.zeros((frame.size, 0))
    noise = layout.model.noise
    white, _ = noise.whiten(line.nuisance * line.prior.sd, line.extra, line.hyper, frame)
    inner = white.T @ white + jnp.diag(line.prior.weight)
    size = jnp.sqrt(jnp.diag(inner))
    size = jnp.where(size > 0, size, 1.0)
    weights, vectors = jnp.linalg.eigh(inner / size / size[:, None])
    known = weights > RANK * weights[-1]
    root = jnp.where(known, 1 / jnp.sqrt(jnp.where(known, weights, 1.0)), 0.0)
    return (white / size) @ (vectors * root)


def fitted_directions(calibration: Calibration) -> np.ndarray:
    """G (n, q): the whitened residuals at the fit have the covariance I − G·Gᵀ if the model is right.

    With A the whitened columns of the nuisances, per prior sd, and W their prior weights (0 where flat), whitened
    readings have the covariance I + A·W⁻¹·Aᵀ, and the residuals are (I − H) times them, H = A·(AᵀA + W)⁻¹·Aᵀ = G·Gᵀ,
    the leverage matrix; so (I − H)·(I + A·W⁻¹·Aᵀ)·(I − H) = I − H.
    """
    y = jnp.asarray(calibration.readings["output"])
    found = _fitted_directions(calibration.layout, calibration.frame, y, calibration.mode)
    return np.asarray(found)


@compiled
def _projections(layout: Layout, frame: Frame, y: Array, mode, residual: Array, columns: Array):
    line = linearised(layout, frame, y, mode)
    gram = layout.model.noise.gram(columns, residual, line.extra, line.hyper, frame)
    return gram.jtr, gram.jtj


def projections(
    calibration: Calibration, residual: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """CᵀΣ⁻¹r and CᵀΣ⁻¹C of columns (n, P) and the residuals at the fit: no nuisance is taken out again."""
    y = jnp.asarray(calibration.readings["output"])
    args = (y, calibration.mode, jnp.asarray(residual), jnp.asarray(columns))
    found = _projections(calibration.layout, calibration.frame, *args)
    return np.asarray(found[0]), np.asarray(found[1])
