"""Leave one group out: the left-out group predicted as new, φ estimated again in each fold, x in closed form.

The model is linearised once, at the full fit; a fold is the same linear model with the group's readings at zero
weight. Deviations of the left-out group then come from their prior, as those of any group not yet seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from bayescal import _composition as composition
from bayescal import _linear as linear
from bayescal._calibration import Calibration
from bayescal._frame import Frame
from bayescal._layout import Layout
from bayescal._measurements import Measurements
from bayescal._noise import Gram

BLOCKS = 5  # of neighbouring readings, where there is no group to leave out


@dataclass(frozen=True)
class LeaveOneGroupOut:
    """Predictions of each group from the others.

    Attributes:
        group: what a group is: device, run, cell, "time block" or "block of rows".
        members: names of the groups.
        log_score: joint log predictive density of each group, (g,); NaN where the noise is not Gaussian.
        residual: of each reading, predicted from the other groups, output unit.
    """

    group: str
    members: tuple[str, ...]
    log_score: np.ndarray
    residual: np.ndarray

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def count(self) -> int:
        return len(self.members)


def groups_of(readings: Measurements) -> tuple[str, tuple[str, ...], np.ndarray]:
    """What to leave out: device if there are two, else run, else cell, else blocks in time or in order."""
    for name in ("device", "run", "cell"):
        levels, codes = readings.groups(name)
        if len(levels) >= 2 and (codes >= 0).all():
            return name, levels, codes
    position = readings["time"] if readings.has("time") else np.arange(len(readings))
    rank = np.argsort(np.argsort(position, kind="stable"))
    count = min(BLOCKS, len(readings))
    codes = rank * count // len(readings)
    kind = "time block" if readings.has("time") else "block of rows"
    return kind, tuple(str(i + 1) for i in range(count)), codes


def leave_one_group_out(calibration: Calibration) -> LeaveOneGroupOut | None:
    """Predict every group from the others; None where the noise is not Gaussian."""
    if not calibration.model.noise.gaussian:
        return None
    kind, members, codes = groups_of(calibration.readings)
    keep = codes[None, :] != np.arange(len(members))[:, None]
    y = jnp.asarray(calibration.readings["output"])
    found = _folds(calibration.layout, calibration.frame, y, calibration.mode, jnp.asarray(keep, float))
    scores, residual = (np.asarray(a) for a in found)
    return LeaveOneGroupOut(kind, members, scores, residual.sum(axis=0))


@eqx.filter_jit
def _folds(layout: Layout, frame: Frame, y: Array, mode, keep: Float[Array, "g n"]):
    return jax.lax.map(lambda k: _fold(layout, frame, y, mode, k), keep)


def _fold(layout: Layout, frame: Frame, y: Array, mode, keep: Float[Array, "n"]):
    point = mode.point
    noise = layout.model.noise

    def line_at(hyper):
        line = composition.linearise(layout, frame, point.x, point.rows, hyper)
        return line, y - line.mean + jnp.sum(line.rows * point.rows, axis=1)

    def density(v):
        hyper = composition.hyper_values(layout, v)
        line, residual = line_at(hyper)
        variance = noise.variance(hyper, frame) + linear.row_variance(layout, line)
        weight = keep / variance
        weighted = line.jacobian * weight[:, None]
        gram = Gram(
            weighted.T @ line.jacobian,
            weighted.T @ residual,
            residual @ (weight * residual),
            jnp.sum(keep * jnp.log(variance)),
        )
        prior = linear.prior_of(layout, hyper, mode.flat)
        found = linear.condition(gram, jnp.sum(keep), prior, point.x)
        return found.log_marginal + composition.hyper_log_prior(layout, v), found

    v = mode.v
    if len(layout.hypers):
        solver = optx.BFGS(rtol=1e-6, atol=1e-6)
        found = optx.minimise(lambda v, _: -density(v)[0], solver, v, max_steps=64, throw=False)
        v = jnp.where(jnp.all(jnp.isfinite(found.value)), found.value, v)
    hyper = composition.hyper_values(layout, v)
    line, residual = line_at(hyper)
    x = density(v)[1]
    left = residual - line.jacobian @ (x.mean - point.x)
    variance = noise.variance(hyper, frame) + linear.row_variance(layout, line)
    out = 1 - keep
    # The joint density of the readings left out: rows of the kept ones are made trivial (variance one, value 0).
    jacobian = line.jacobian * out[:, None]
    cover = jacobian @ x.covariance @ jacobian.T + jnp.diag(jnp.where(out > 0, variance, 1.0))
    root = jnp.linalg.cholesky(cover)
    z = jax.scipy.linalg.solve_triangular(root, out * left, lower=True)
    score = -0.5 * z @ z - jnp.sum(jnp.log(jnp.diag(root))) - 0.5 * jnp.sum(out) * jnp.log(2 * jnp.pi)
    return score, out * left
