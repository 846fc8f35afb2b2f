"""Least squares: the maximum a posteriori point by Levenberg–Marquardt, its covariance by Laplace.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Noise and learned
spreads are set by marginal (restricted) likelihood with everything else integrated out, so that the noise is
divided by the degrees of freedom that the coefficients leave.
"""

from __future__ import annotations

from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from bayescal._core.jit import compiled
from bayescal._core.levenberg_marquardt import least_squares
from bayescal._core.progress import stage
from bayescal._inference import gaussian, laplace
from bayescal._inference.method import Draws, Method, Outcome, Verdict
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

CHAINS = 4
STILL = 1e-6  # standard deviations: a further step smaller than this is none


class Solution(NamedTuple):
    """x̂ and shapes at the maximum, scales by restricted likelihood, and the covariance of (x, shapes)."""

    mode: laplace.Mode
    covariance: Float[Array, "q q"]
    converged: Array


class LeastSquares(Method):
    """Maximum a posteriori by optimistix, with a Laplace covariance.

    Attributes:
        curvature: "gauss-newton" leaves out second derivatives of the expected output; "hessian" keeps them.
        draws: from the Gaussian approximation, for the data tree.
    """

    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    draws: int = 4000
    name: ClassVar[str] = "least-squares"

    def run(self, layout: Layout, frame: Frame, y: Float[Array, "n"], seed: int) -> Outcome:
        with stage("least squares"):
            mode = laplace.compiled_mode(layout, frame, y)
            made = refine(layout, frame, y, mode, self.curvature == "hessian")
            found = jax.tree.map(np.asarray, made)
        reasons = []
        if not bool(found.converged):
            reasons.append("Levenberg–Marquardt stopped before its tolerance was met.")
        if not np.all(np.isfinite(found.covariance)):
            reasons.append(
                "The curvature is singular: some direction is not determined by readings or priors."
            )
        kind = "Gauss–Newton" if self.curvature == "gauss-newton" else "full-Hessian"
        notes = [
            f"Covariance is the {kind} Laplace approximation; noise and spreads by restricted likelihood, "
            "held at their estimate (so intervals do not carry the uncertainty of the noise)."
        ]
        if not layout.model.noise.gaussian:
            notes.append(
                f"{layout.model.noise.law} noise was taken as Gaussian of the same variance: "
                "use Marginal() for its own likelihood."
            )
        draws = _gaussian_draws(layout, found, self.draws, seed)
        verdict = Verdict(not reasons, tuple(reasons), tuple(notes), "least squares")
        evidence = None if layout.improper else (float(found.mode.log_evidence), None)
        return Outcome(layout, draws, found.mode, verdict, evidence)


def split_hypers(layout: Layout) -> tuple[list[int], list[int]]:
    """Positions in φ of scales (noise, spreads) and of locations (shapes, promoted coefficients).

    An unknown function's amplitude and length are neither: fitted together with the function, the amplitude would run
    away and its coefficients to zero. They stay where the marginal likelihood has its maximum.
    """
    return layout.positions("noise", "spread"), layout.positions("shape", "promoted")


def solve(layout: Layout, frame: Frame, y: Float[Array, "n"], full_hessian: bool) -> Solution:
    """The whole fit, from nothing. Traceable; can be mapped over data."""
    return refine(layout, frame, y, laplace.find_mode(layout, frame, y), full_hessian)


@compiled
def refine(
    layout: Layout, frame: Frame, y: Float[Array, "n"], mode: laplace.Mode, full_hessian: bool
) -> Solution:
    """From the mode: (x, shapes) by least squares and scales by restricted likelihood in turn, until both rest."""
    scales, places = split_hypers(layout)
    scale_at, place_at = jnp.asarray(scales, int), jnp.asarray(places, int)
    rows, noise = mode.point.rows, layout.model.noise
    prior_weight = jnp.concatenate([forward.prior_weight(layout), jnp.ones(len(places))])

    def joined(v):
        hyper = forward.hyper_values(layout, v)
        p = gaussian.prior_of(layout, hyper, mode.flat)
        pad = len(places)
        return gaussian.Prior(
            jnp.concatenate([p.mean, jnp.zeros(pad)]),
            jnp.concatenate([p.sd, jnp.ones(pad)]),
            prior_weight,
        )

    def output(theta, v):
        x, w = theta[: layout.size], theta[layout.size :]
        hyper = forward.hyper_values(layout, v.at[place_at].set(w))
        return forward.mean(layout, frame, x, rows, hyper)

    def table_at(theta, v):
        """Slopes of (x, shapes) beside what the expected output leaves, and the variance that the rows add."""
        x, w = theta[: layout.size], theta[layout.size :]
        hyper = forward.hyper_values(layout, v.at[place_at].set(w))
        line = forward.linearise(layout, frame, x, rows, hyper)
        slopes = line.jacobian
        if places:
            bent = jax.jacfwd(lambda w: output(jnp.concatenate([x, w]), v))(w)
            slopes = jnp.column_stack([slopes, bent])
        rest = y - line.mean + jnp.sum(line.rows * rows, axis=1)
        return jnp.column_stack([slopes, rest]), gaussian.row_variance(layout, line)

    def fit_places(theta, v):
        prior = joined(v)
        centre = jnp.where(prior.weight > 0, prior.mean, theta)
        size = jnp.append(-prior.sd, 1.0)
        hyper, extra = forward.hyper_values(layout, v), table_at(theta, v)[1]

        def table(z):
            at = centre + prior.sd * z
            white, _ = gaussian.whitener(layout, frame, table_at(at, v)[0], extra)(hyper)
            own = jnp.column_stack([jnp.diag(prior.weight), prior.weight * z])
            return jnp.concatenate([white * size, own])

        start = (theta - centre) / jnp.where(prior.sd > 0, prior.sd, 1.0)
        found = least_squares(lambda z: table(z)[:, -1], start, table=table)
        return centre + prior.sd * found.value, found.converged

    def conditional_at(theta, v):
        table, extra = table_at(theta, v)
        whiten = gaussian.whitener(layout, frame, table, extra)

        def conditional(v) -> gaussian.Conditional:
            white, logdet = whiten(forward.hyper_values(layout, v))
            return gaussian.condition_white(white[:, :-1], white[:, -1], logdet, joined(v), theta)

        return conditional

    def restricted(theta, v):
        conditional = conditional_at(theta, v)

        def negative(s, _):
            full = v.at[scale_at].set(s)
            found = conditional(full)
            prior = [
                h.prior.log_density(full[i])
                for i, h in enumerate(layout.hypers)
                if h.kind == "spread"
            ]
            return -(found.log_marginal + sum(prior, jnp.zeros(())))

        if not scales:
            return v
        solver = optx.BFGS(rtol=1e-11, atol=1e-11)
        best = optx.minimise(negative, solver, v[scale_at], max_steps=256, throw=False).value
        return v.at[scale_at].set(best)

    def one_round(state):
        theta, v, _, _, count = state
        new, converged = fit_places(theta, v)
        new_v = restricted(new, v.at[place_at].set(new[layout.size :]))
        change = jnp.max(jnp.abs(new_v - v), initial=0.0)
        return new, new_v, change, converged, count + 1

    def going(state):
        return (state[2] > 1e-9) & (state[4] < 30)

    # Where JᵀJ has no Cholesky factor the mode is NaN; from the prior's centre, QR may find it.
    x = jnp.where(jnp.isfinite(mode.point.x), mode.point.x, forward.prior_mean(layout))
    start = jnp.where(jnp.isfinite(mode.v), mode.v, 0.0)
    theta = jnp.concatenate([x, start[place_at]])
    state = (theta, start, jnp.asarray(jnp.inf), jnp.asarray(False), jnp.asarray(0))
    theta, v, _, converged, _ = jax.lax.while_loop(going, one_round, state)

    found = conditional_at(theta, v)(v)
    covariance = found.covariance
    # Started at the optimum, Levenberg–Marquardt may refuse every step for its rounding and report failure:
    # what counts is whether a Gauss–Newton step would still move anything.
    still = jnp.max(jnp.abs(found.mean - theta) / jnp.sqrt(jnp.diag(covariance)), initial=0.0)
    converged = converged | (still < STILL)
    if full_hessian:
        prior = joined(v)

        def negative_log(theta):
            bent, extra = table_at(theta, v)
            r, _ = noise.whiten(bent[:, -1:], extra, forward.hyper_values(layout, v), frame)
            z = (theta - prior.mean) / prior.sd
            return 0.5 * (jnp.sum(r**2) + jnp.sum(prior.weight * z**2))

        covariance = jnp.linalg.inv(jax.hessian(negative_log)(theta))
    point = gaussian.Point(theta[: layout.size], rows)
    return Solution(mode._replace(point=point, v=v), covariance, converged)


def _gaussian_draws(layout: Layout, found: Solution, count: int, seed: int) -> Draws:
    _, places = split_hypers(layout)
    random = np.random.default_rng(seed)
    covariance = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    sd = np.sqrt(np.diag(covariance))
    sd = np.where(sd > 0, sd, 1.0)  # scaled by it, so that a small variance beside a large counts
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / np.outer(sd, sd))
    root = sd[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    centre = np.concatenate([found.mode.point.x, found.mode.v[places]])
    count = CHAINS * max(1, count // CHAINS)
    normal = random.standard_normal((count, len(centre)))
    # So that means and covariances read from the draws are those of the fit, not of the draws' luck:
    if count > 4 * len(centre) and len(centre):
        normal = _exact_moments(normal)
    theta = centre + normal @ root.T
    v = np.tile(found.mode.v, (count, 1)).copy()  # of an empty v, tile gives a view
    v[:, places] = theta[:, layout.size :]
    rows = np.broadcast_to(found.mode.point.rows, (count, *found.mode.point.rows.shape))

    def shaped(a: np.ndarray) -> np.ndarray:
        return a.reshape(CHAINS, len(a) // CHAINS, *a.shape[1:])

    return Draws(shaped(theta[:, : layout.size]), shaped(rows), shaped(v))


def _exact_moments(normal: np.ndarray) -> np.ndarray:
    """Normal draws moved linearly so that their mean is exactly 0 and their covariance exactly 1."""
    own = np.linalg.svd(normal - normal.mean(axis=0), full_matrices=False)
    return own.U @ own.Vh * np.sqrt(len(normal) - 1)
