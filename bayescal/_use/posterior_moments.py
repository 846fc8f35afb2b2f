"""What the posterior says of the unknowns that act in use: draws, mean and covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.mixture import has_effect
from bayescal._model.parameters import CoefficientBlock
from bayescal._use.operating_equation import OperatingEquation, samples_in_use


class PosteriorMoments(NamedTuple):
    """What the posterior says of θ: draws (d, p), mean (p,), covariance (p, p), reported units."""

    draws: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def posterior_moments(
    equation: OperatingEquation, calibration: Calibration, draws: int, seed: int = 0
) -> PosteriorMoments:
    """Draws of θ, at most `draws` of them evenly thinned; mean and covariance from all.

    A deviation that is new in use is independent of everything measured: its draws are standardised, so that
    they move no mean.
    """
    unknowns, blocks = equation.unknowns(), {b.name: b for b in equation.blocks}
    size = calibration.posterior.sizes
    total = size["chain"] * size["draw"]
    random = np.random.default_rng(seed)
    step = max(1, -(-total // draws))
    values, mean, extra = np.zeros((total, len(unknowns))), np.zeros(len(unknowns)), {}
    thin = values[::step].copy()
    for i, unknown in enumerate(unknowns):
        if unknown.kind == "new":
            block = blocks[unknown.key]
            centre = block.coefficient.mean
            spread = _spread(calibration, block, total) * has_effect(calibration, block.effect.name)
            normal = random.standard_normal(len(thin))
            normal = (normal - normal.mean()) / (normal.std() or 1.0)
            mean[i], extra[i] = centre, float(np.mean(spread**2))
            thin[:, i] = centre + spread[::step] * normal
        else:
            values[:, i] = samples_in_use(equation, calibration, unknown)
            mean[i] = values[:, i].mean()
            thin[:, i] = values[::step, i]
    covariance = np.atleast_2d(np.cov(values.T)) if len(unknowns) else np.zeros((0, 0))
    for i, variance in extra.items():
        covariance[i, i] = variance
    return PosteriorMoments(thin, mean, covariance)


def _spread(calibration: Calibration, block: CoefficientBlock, draws: int) -> np.ndarray:
    """Draws of the standard deviation from which a new member is taken."""
    c, fixed = block.coefficient, dict(calibration.model.fixed)
    if c.group_sd is None:
        return np.full(draws, c.size)
    if block.group_sd_name in fixed:
        return np.full(draws, fixed[block.group_sd_name])
    return calibration.samples(block.group_sd_name)
