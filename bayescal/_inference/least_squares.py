"""Least squares: the maximum a posteriori point by Levenberg–Marquardt, its covariance by Laplace.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Noise and learned
spreads are set by marginal (restricted) likelihood with everything else integrated out, so that the noise is
divided by the degrees of freedom that the coefficients leave.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bayescal._core.jit import compiled
from bayescal._core.levenberg_marquardt import least_squares
from bayescal._core.parallel import on_one_thread
from bayescal._core.progress import stage
from bayescal._engine import refinement
from bayescal._engine.assembly import Assembly
from bayescal._engine.mode import find_mode
from bayescal._engine.record import Record
from bayescal._inference import gaussian, laplace, trust
from bayescal._inference.method import (
    CHAINS,
    Draws,
    Method,
    Outcome,
    Verdict,
    by_chain,
    by_engine,
)
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

STILL = 1e-6  # standard deviations: a further step smaller than this is none
RESTS = 1e-9  # change of φ's coordinates in a round, below which it rests
ROUNDS = 30  # at most


class Solution(NamedTuple):
    """x̂ and shapes at the maximum, scales by restricted likelihood, and the covariance of (x, shapes).

    Its arrays are NumPy's, or JAX's in a program.
    """

    mode: laplace.Mode
    covariance: Float[Any, "q q"]
    converged: Any


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
            found = self._solution(layout, frame, y)
        reasons = [] if found.converged else [trust.NOT_CONVERGED]
        reasons += [] if np.all(np.isfinite(found.covariance)) else [trust.SINGULAR]
        kind = "Gauss–Newton" if self.curvature == "gauss-newton" else "full-Hessian"
        notes = [
            f"Covariance is the {kind} Laplace approximation; noise and between-group standard deviations by "
            "restricted likelihood, held at their estimate (so intervals do not carry the uncertainty of the noise)."
        ]
        if not (layout.model.noise.gaussian or by_engine(layout)):
            notes.append(
                f"{layout.model.noise.law} noise was taken as Gaussian of the same variance: "
                "use Marginal() for its own likelihood."
            )
        return Outcome(
            layout=layout,
            draws=gaussian_draws(layout, found, self.draws, seed),
            mode=found.mode,
            verdict=Verdict(not reasons, tuple(reasons), tuple(notes), "least squares"),
            log_evidence=None if layout.improper else (float(found.mode.log_evidence), None),
        )

    def _solution(self, layout: Layout, frame: Frame, y: Float[Array, "n"]) -> Solution:
        hessian = self.curvature == "hessian"
        if layout.model.noise.independent or by_engine(layout):
            assembly = Assembly(layout, Record(layout.model.instrument, frame, np.asarray(y)))
            return solution_on(assembly, hessian)
        return jax.tree.map(np.asarray, compiled(solve)(layout, frame, y, hessian))


def solution_on(assembly: Assembly, hessian: bool = False) -> Solution:
    """The fit of a structure whose noise the engine whitens by, on a record that others may share."""
    return Solution(*refinement.refine(assembly, find_mode(assembly), hessian))


def split_hypers(layout: Layout) -> tuple[list[int], list[int]]:
    """Positions in φ of scales (noise, spreads) and of locations (shapes, promoted coefficients).

    An unknown function's amplitude and length are neither: fitted together with the function, the amplitude would run
    away and its coefficients to zero. They stay where the marginal likelihood has its maximum.
    """
    return layout.positions("noise", "spread"), layout.positions("shape", "promoted")


def solve(layout: Layout, frame: Frame, y: Float[Array, "n"], full_hessian: bool) -> Solution:
    """The whole fit, from nothing. Traceable; can be mapped over data."""
    return _refine(layout, frame, y, laplace.find_mode(layout, frame, y), full_hessian)


def _refine(
    layout: Layout, frame: Frame, y: Float[Array, "n"], mode: laplace.Mode, full_hessian: bool
) -> Solution:
    """From the mode: (x, shapes) by least squares and scales by restricted likelihood in turn, until both rest."""
    fit = _Refinement(layout, frame, y, mode)
    theta, v, converged = fit.at_rest()
    found = fit.conditional(theta, v)(v)
    # Started at the optimum, Levenberg–Marquardt may refuse every step for its rounding and report failure:
    # what counts is whether a Gauss–Newton step would still move anything.
    sd = jnp.sqrt(jnp.diag(found.covariance))
    still = jnp.max(jnp.abs(found.mean - theta) / sd, initial=0.0) < STILL
    covariance = jnp.linalg.inv(fit.hessian(theta, v)) if full_hessian else found.covariance
    point = gaussian.Point(theta[: layout.size], mode.point.rows)
    return Solution(mode._replace(point=point, v=v), covariance, converged | still)


class _Refinement(NamedTuple):
    """One fit. θ = (x, w) with w the coordinates of shapes and promoted coefficients; v are the coordinates of all φ.

    In v the entries of w may be older than those in θ, which count.
    """

    layout: Layout
    frame: Frame
    y: Float[Array, "n"]
    mode: laplace.Mode

    @property
    def scales(self) -> Int[Array, "s"]:
        """Where in φ the noise and the spreads stand."""
        return jnp.asarray(split_hypers(self.layout)[0], int)

    @property
    def places(self) -> Int[Array, "w"]:
        """Where in φ the entries of w stand."""
        return jnp.asarray(split_hypers(self.layout)[1], int)

    def prior(self, v: Float[Array, "d"]) -> gaussian.Prior:
        """Of θ: that of x given φ, and the standard normal one of w."""
        own = gaussian.prior_of(self.layout, forward.hyper_values(self.layout, v), self.mode.flat)
        further = self.places.size
        return gaussian.Prior(
            jnp.concatenate([own.mean, jnp.zeros(further)]),
            jnp.concatenate([own.sd, jnp.ones(further)]),
            jnp.concatenate([own.weight, jnp.ones(further)]),
        )

    def table(
        self, theta: Float[Array, "q"], v: Float[Array, "d"]
    ) -> tuple[Float[Array, "n q1"], Float[Array, "n"]]:
        """Slopes by θ beside what the expected output leaves, and the variance that the rows add."""
        layout, frame, rows = self.layout, self.frame, self.mode.point.rows
        x, w = theta[: layout.size], theta[layout.size :]

        def values(w: Float[Array, "w"]) -> forward.Values:
            return forward.hyper_values(layout, v.at[self.places].set(w))

        line = forward.linearise(layout, frame, x, rows, values(w))
        slopes = line.jacobian
        if w.size:
            by_w = jax.jacfwd(lambda w: forward.mean(layout, frame, x, rows, values(w)))(w)
            slopes = jnp.column_stack([slopes, by_w])
        rest = self.y - line.mean + jnp.sum(line.rows * rows, axis=1)
        return jnp.column_stack([slopes, rest]), gaussian.row_variance(layout, line)

    def fit_theta(
        self, theta: Float[Array, "q"], v: Float[Array, "d"]
    ) -> tuple[Float[Array, "q"], Bool[Array, ""]]:
        """θ by least squares of the whitened residuals and the prior's, given the scales in v."""
        prior = self.prior(v)
        centre = jnp.where(prior.weight > 0, prior.mean, theta)
        size = jnp.append(-prior.sd, 1.0)
        hyper, extra = forward.hyper_values(self.layout, v), self.table(theta, v)[1]

        def table(z: Float[Array, "q"]) -> Float[Array, "m q1"]:
            at = self.table(centre + prior.sd * z, v)[0]
            white, _ = gaussian.whitener(self.layout, self.frame, at, extra)(hyper)
            own = jnp.column_stack([jnp.diag(prior.weight), prior.weight * z])
            return jnp.concatenate([white * size, own])

        start = (theta - centre) / jnp.where(prior.sd > 0, prior.sd, 1.0)
        found = least_squares(lambda z: table(z)[:, -1], start, table=table)
        return centre + prior.sd * found.value, found.converged

    def conditional(
        self, theta: Float[Array, "q"], v: Float[Array, "d"]
    ) -> Callable[[Float[Array, "d"]], gaussian.Conditional]:
        """A function of φ's coordinates: θ integrated out of the model linearised here."""
        table, extra = self.table(theta, v)
        whiten = gaussian.whitener(self.layout, self.frame, table, extra)

        def given(v: Float[Array, "d"]) -> gaussian.Conditional:
            white, logdet = whiten(forward.hyper_values(self.layout, v))
            return gaussian.condition_white(
                white[:, :-1], white[:, -1], logdet, prior=self.prior(v), at=theta
            )

        return given

    def fit_scales(self, theta: Float[Array, "q"], v: Float[Array, "d"]) -> Float[Array, "d"]:
        """v with its scales where the restricted likelihood, times the prior of the spreads, is greatest."""
        if not self.scales.size:
            return v
        conditional = self.conditional(theta, v)
        spreads = [(i, self.layout.hypers[i].prior) for i in self.layout.positions("spread")]

        def negative(scales, _):
            moved = v.at[self.scales].set(scales)
            prior = [p.log_density(moved[i]) for i, p in spreads]
            return -(conditional(moved).log_marginal + sum(prior, jnp.zeros(())))

        solver = optx.BFGS(rtol=1e-11, atol=1e-11)
        best = optx.minimise(negative, solver, v[self.scales], max_steps=256, throw=False)
        return v.at[self.scales].set(best.value)

    def at_rest(self) -> tuple[Float[Array, "q"], Float[Array, "d"], Bool[Array, ""]]:
        """θ and v after rounds of both until the scales rest, and whether the last fit of θ converged."""

        def one_round(state):
            theta, v, _, _, count = state
            new, converged = self.fit_theta(theta, v)
            new_v = self.fit_scales(new, v.at[self.places].set(new[self.layout.size :]))
            change = jnp.max(jnp.abs(new_v - v), initial=0.0)
            return new, new_v, change, converged, count + 1

        def going(state):
            return (state[2] > RESTS) & (state[4] < ROUNDS)

        # Where JᵀJ has no Cholesky factor the mode is NaN; from the prior's centre, QR may find it.
        found = self.mode
        x = jnp.where(jnp.isfinite(found.point.x), found.point.x, forward.prior_mean(self.layout))
        v = jnp.where(jnp.isfinite(found.v), found.v, 0.0)
        theta = jnp.concatenate([x, v[self.places]])
        state = (theta, v, jnp.asarray(jnp.inf), jnp.asarray(False), jnp.asarray(0))
        theta, v, _, converged, _ = jax.lax.while_loop(going, one_round, state)
        return theta, v, converged

    def hessian(self, theta: Float[Array, "q"], v: Float[Array, "d"]) -> Float[Array, "q q"]:
        """Curvature of the negative log density of θ, second derivatives of the expected output included."""
        prior, hyper = self.prior(v), forward.hyper_values(self.layout, v)

        def negative_log(theta):
            table, extra = self.table(theta, v)
            r, _ = self.layout.model.noise.whiten(table[:, -1:], extra, hyper, self.frame)
            z = (theta - prior.mean) / prior.sd
            return 0.5 * (jnp.sum(r**2) + jnp.sum(prior.weight * z**2))

        return jax.hessian(negative_log)(theta)


@on_one_thread  # else the last digits would hang on how many cores there are
def gaussian_draws(layout: Layout, found: Solution, count: int, seed: int) -> Draws:
    """Draws of the Gaussian approximation about a solution."""
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
    return Draws(by_chain(theta[:, : layout.size]), by_chain(rows), by_chain(v))


def _exact_moments(normal: np.ndarray) -> np.ndarray:
    """Normal draws moved linearly so that their mean is exactly 0 and their covariance exactly 1."""
    own = np.linalg.svd(normal - normal.mean(axis=0), full_matrices=False)
    return own.U @ own.Vh * np.sqrt(len(normal) - 1)
