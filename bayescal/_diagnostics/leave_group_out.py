"""Leave one group out: the left-out group predicted as new, φ estimated again in each fold, x in closed form.

The model is linearised once, at the full fit; a fold is the same linear model with the group's readings at zero
weight. Deviations of the left-out group then come from their prior, as those of any group not yet seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.jit import compiled
from bayescal._inference import gaussian
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.noise_laws import Gram
from bayescal._model.parameters import Layout
from bayescal._readings.measurements import Measurements

SILENT = 1e10  # variance of a reading that is left out, in noise variances
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
    found = _folds(
        calibration.layout, calibration.frame, y, calibration.mode, jnp.asarray(keep, float)
    )
    scores, residual = (np.asarray(a) for a in found)
    return LeaveOneGroupOut(kind, members, scores, residual.sum(axis=0))


@compiled
def _folds(layout: Layout, frame: Frame, y: Array, mode, keep: Float[Array, "g n"]):
    return jax.lax.map(lambda k: _fold(layout, frame, y, mode, k), keep)


def _fold(layout: Layout, frame: Frame, y: Array, mode, keep: Float[Array, "n"]):
    point = mode.point
    noise = layout.model.noise

    def gram_at(hyper, kept: Float[Array, "n"]):
        """Products over the kept readings: the others are given a variance so large that they say nothing."""
        line = forward.linearise(layout, frame, point.x, point.rows, hyper)
        residual = y - line.mean + jnp.sum(line.rows * point.rows, axis=1)
        extra = gaussian.row_variance(layout, line)
        silent = SILENT * (jnp.mean(noise.variance(hyper, frame)) + jnp.mean(extra))
        gram = noise.gram(line.jacobian, residual, extra + (1 - kept) * silent, hyper, frame)
        gram = gram._replace(logdet=gram.logdet - jnp.sum(1 - kept) * jnp.log(silent))
        return gram, line.jacobian, residual

    def density(v):
        hyper = forward.hyper_values(layout, v)
        prior = gaussian.prior_of(layout, hyper, mode.flat)
        found = gaussian.condition(gram_at(hyper, keep)[0], jnp.sum(keep), prior, point.x)
        return found.log_marginal + forward.hyper_log_prior(layout, v), found

    v = mode.v
    if len(layout.hypers):
        solver = optx.BFGS(rtol=1e-6, atol=1e-6)
        found = optx.minimise(lambda v, _: -density(v)[0], solver, v, max_steps=64, throw=False)
        v = jnp.where(jnp.all(jnp.isfinite(found.value)), found.value, v)
    hyper = forward.hyper_values(layout, v)
    fitted = density(v)[1]
    out = 1 - keep
    gram, jacobian, residual = gram_at(hyper, out)
    # The left-out readings under the posterior of x from the kept ones, its covariance as a prior of unit normals.
    centred = residual - jacobian @ (fitted.mean - point.x)
    root = jnp.linalg.cholesky(fitted.covariance + 1e-14 * jnp.diag(jnp.diag(fitted.covariance)))
    shift = fitted.mean - point.x
    spread = gaussian.Prior(jnp.zeros(layout.size), jnp.ones(layout.size), jnp.ones(layout.size))
    turned = Gram(
        root.T @ gram.jtj @ root,
        root.T @ (gram.jtr - gram.jtj @ shift),
        gram.rtr - 2 * shift @ gram.jtr + shift @ gram.jtj @ shift,
        gram.logdet,
    )
    score = gaussian.condition(turned, jnp.sum(out), spread, jnp.zeros(layout.size)).log_marginal
    return score, out * centred
