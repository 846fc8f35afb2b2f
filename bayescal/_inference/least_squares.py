"""Least squares: the maximum a posteriori point by Levenberg–Marquardt, its covariance by Laplace.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Noise and learned
spreads are set by marginal (restricted) likelihood with everything else integrated out, so that the noise is
divided by the degrees of freedom that the coefficients leave.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from bayescal._core.parallel import on_one_thread
from bayescal._core.progress import stage
from bayescal._inference import refinement, trust
from bayescal._inference.assembly import Assembly
from bayescal._inference.method import CHAINS, Draws, Method, Outcome, Verdict
from bayescal._inference.mode import NOTHING_KNOWN, find_mode
from bayescal._inference.record import Record
from bayescal._inference.refinement import Solution
from bayescal._model.parameters import Layout


class LeastSquares(Method):
    """Maximum a posteriori, with a Laplace covariance: by Gauss–Newton; where that stalls, by optimistix.

    Attributes:
        curvature: "gauss-newton" leaves out second derivatives of the expected output; "hessian" keeps them.
        draws: from the Gaussian approximation, for the data tree.
    """

    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    draws: int = 4000
    name: ClassVar[str] = "least-squares"

    def run(self, layout, frame, y, seed, start=NOTHING_KNOWN):
        with stage("least squares"):
            assembly = Assembly(layout, Record(layout.model.instrument, frame, np.asarray(y)))
            found = solution_on(assembly, self.curvature == "hessian", start)
        return self.outcome(layout, found, seed)

    def outcome(self, layout: Layout, found: Solution, seed: int) -> Outcome:
        """What a solution comes to: draws of the Gaussian approximation about it, and whether to trust it."""
        reasons = [] if found.converged else [trust.NOT_CONVERGED]
        reasons += [] if np.all(np.isfinite(found.covariance)) else [trust.SINGULAR]
        kind = "Gauss–Newton" if self.curvature == "gauss-newton" else "full-Hessian"
        notes = [
            f"Covariance is the {kind} Laplace approximation; noise and between-group standard deviations by "
            "restricted likelihood, held at their estimate (so intervals do not carry the uncertainty of the noise)."
        ]
        if not layout.model.noise.gaussian and layout.row_blocks:
            notes.append(
                f"{layout.model.noise.law} noise was taken without the coefficients of single readings: "
                "use Marginal() for its own likelihood."
            )
        return Outcome(
            layout=layout,
            draws=gaussian_draws(layout, found, self.draws, seed),
            mode=found.mode,
            verdict=Verdict(not reasons, tuple(reasons), tuple(notes), "least squares"),
            log_evidence=None if layout.improper else (float(found.mode.log_evidence), None),
        )


def solution_on(
    assembly: Assembly, hessian: bool = False, start: Mapping[str, float] = NOTHING_KNOWN
) -> Solution:
    """The fit of a structure whose noise the engine whitens by, on a record that others may share."""
    return refinement.refine(assembly, find_mode(assembly, start=start), hessian)


@on_one_thread  # else the last digits would hang on how many cores there are
def gaussian_draws(layout: Layout, found: Solution, count: int, seed: int) -> Draws:
    """Draws of the Gaussian approximation about a solution."""
    # An unknown function's amplitude and length are not among these: fitted together with the function, the amplitude
    # would run away and its coefficients to zero. They stay where the marginal likelihood has its maximum.
    places = layout.positions("shape", "promoted")
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
    return Draws.of(theta[:, : layout.size], rows, v)


def _exact_moments(normal: np.ndarray) -> np.ndarray:
    """Normal draws moved linearly so that their mean is exactly 0 and their covariance exactly 1."""
    # With Z − mean = U·s·Vᵀ the matrix U·Vᵀ is the nearest to it with orthonormal columns (polar decomposition).
    own = np.linalg.svd(normal - normal.mean(axis=0), full_matrices=False)
    return own.U @ own.Vh * np.sqrt(len(normal) - 1)
