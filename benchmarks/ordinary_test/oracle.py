"""The oracle, which knows all true columns: exact evidences of linear-Gaussian models, and least squares.

y = X·c + e, c ~ N(0, S) with known S, e white of unknown standard deviation σ with p(σ) ∝ 1/σ. Given σ the coefficients
are integrated out in closed form; σ is integrated on a grid. Independent of the library.
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

# Of log σ about the residuals' own, refined about its maximum.
GRID = np.linspace(-12.0, 12.0, 4001)


def log_evidence(y: np.ndarray, columns: np.ndarray, sd: np.ndarray) -> float:
    """Compute the log evidence of a model, in nats.

    Args:
        y: readings, (n,).
        columns: columns of the coefficients, (n, k).
        sd: prior standard deviations of the coefficients, (k,).
    """
    u, singular, _ = np.linalg.svd(columns * sd, full_matrices=False)
    inside = u.T @ y
    beyond = max(float(y @ y - inside @ inside), 0.0)

    def log_density(log_sigma: np.ndarray) -> np.ndarray:
        """Compute log p(y | σ) for each σ."""
        variance = np.exp(2 * log_sigma)[:, None]
        of = singular**2 + variance
        quadratic = (inside**2 / of).sum(axis=1) + beyond / variance[:, 0]
        logdet = np.log(of).sum(axis=1) + (len(y) - len(singular)) * np.log(variance[:, 0])
        return -0.5 * (quadratic + logdet + len(y) * np.log(2 * np.pi))

    middle = 0.5 * np.log(max(beyond, 1e-300) / len(y))
    rough = GRID + middle
    top = rough[int(np.argmax(log_density(rough)))]
    fine = top + np.linspace(-1.0, 1.0, 4001) * min(6.0, 20 / np.sqrt(len(y)))
    return float(logsumexp(log_density(fine)) + np.log(fine[1] - fine[0]))


def least_squares(y: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the coefficients of ordinary least squares (k,)."""
    scale = np.sqrt(np.mean(columns**2, axis=0))
    return np.linalg.lstsq(columns / scale, y, rcond=None)[0] / scale
