"""Proposals where each draw costs a pass over the readings: two-sided Student-t about the mode."""

import numpy as np
from scipy.stats import norm

from bayescal._core.importance_weights import effective_size
from bayescal._inference.sampling import Mixture


def test_two_sided_mixture_draws_its_own_density():
    """Weights against a two-sided normal density average one, and are even in ten dimensions."""
    dim, random = 10, np.random.default_rng(0)
    axes = np.linalg.qr(random.standard_normal((dim, dim)))[0] * np.linspace(0.1, 2, dim)
    down, up = np.full(dim, 0.3), np.linspace(0.5, 3, dim)
    middle = random.standard_normal(dim)
    wide = 1.7 * np.linalg.cholesky(axes @ axes.T)
    mixture = Mixture(middle[None], wide, middle, axes, 0.95, (down, up), 15.0)
    v = mixture.draw(random, 20_000)
    z = np.linalg.solve(axes, (v - middle).T).T
    inside = norm.logpdf(z / np.where(z < 0, down, up)) + np.log(2 / (down + up))
    log_target = inside.sum(axis=1) - np.linalg.slogdet(axes)[1]
    weights = np.exp(log_target - mixture.log_density(v))
    assert abs(weights.mean() - 1) < 4 * weights.std() / np.sqrt(len(v))
    assert effective_size(weights / weights.sum()) > 0.5 * len(v)
