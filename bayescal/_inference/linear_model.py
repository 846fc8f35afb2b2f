"""A fitted model linearised about its mode: whitened residuals and nuisance columns, for score tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._data.measurements import Measurements
from bayescal._inference.density import Density
from bayescal._inference.gaussian import cholesky, compute_column_scales
from bayescal._inference.laplace import Mode, compute_flat_scales
from bayescal._inference.noise_nodes import DCTNodes
from bayescal._inference.noise_on_record import (
    SdWhitening,
    Whitening,
    normal_scores,
    variance,
    whitening,
)
from bayescal._inference.problem import Problem, differentiate, overwrite
from bayescal._inference.record import Record
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_law import WHITE
from bayescal._model.parameters import bind

DIFF_STEP = 1e-4  # central-difference step of a shape's coordinate
RANK_TOLERANCE = 1e-12  # smallest eigenvalue of an identified direction, relative to the largest
GAUSS_NEWTON_STEPS = 4  # sufficient for an order of magnitude


def find_amplitude(effect: Effect, problem: Problem, mode: Mode) -> tuple[float, float] | None:
    """Return the estimate and standard uncertainty of an effect's amplitude or between-group sd; None if not in φ."""
    name = effect.measure_name or effect.group_sd_name(0)
    is_in_phi = name in problem.layout.index_in_phi
    return problem.value_and_sd(name, mode.v, mode.covariance) if is_in_phi else None


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linear model of the readings about a mode θ̂, y = μ + nuisance·(θ − θ̂)/sd + noise, θ = (x, shapes)."""

    problem: Problem  # the model on its readings
    mode: Mode
    mean: Float[np.ndarray, "n"]  # the expected output at the mode
    residual: Float[np.ndarray, "n"]  # at the posterior mean of θ, output unit (n,)
    # Jacobian with respect to x and shapes, times prior standard deviations.
    nuisance: Float[np.ndarray, "n q"]
    weight: Float[np.ndarray, "q"]  # 1 where the prior is proper, 0 where it is flat (q,)
    sd: Float[np.ndarray, "q"]
    owners: tuple[str, ...]  # effect of each nuisance column (q,)
    # θ minus its prior mean, in prior standard deviations; 0 where the prior is flat (q,)
    z: Float[np.ndarray, "q"]
    whiten: Whitening | SdWhitening  # of the readings
    extra: Float[np.ndarray, "n"] | float  # variance from noisy inputs (n,), or 0

    @property
    def size(self) -> int:
        return len(self.residual)

    @cached_property
    def at_rest(self) -> Record:
        """Return the residuals as a record of a channel at constant input, to fit noise laws."""
        return self.problem.record.residual_record(self.residual)

    def decorrelate(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Whiten columns up to a common rotation, which preserves inner products; its rows are not readings."""
        law = self.whiten
        if isinstance(law, Whitening) and not self.problem.is_noisy:
            nodes = law.record.nodes(law.law)
            if isinstance(nodes, DCTNodes):
                return nodes.whiten(law.law, law.values, columns)
        return law(columns)

    @cached_property
    def white_nuisance(self) -> Float[np.ndarray, "n q"]:
        return self.whiten(self.nuisance)

    def contribution(self, name: str) -> Float[np.ndarray, "n"]:
        """Return an effect's contribution to the expected output, relative to that at prior means, output unit (n,)."""
        is_of_effect = np.array([owner == name for owner in self.owners])
        indices = np.flatnonzero(is_of_effect[: self.problem.size])
        return self.nuisance[:, indices] @ self.z[indices]

    @cached_property
    def _decomposition(self) -> tuple[np.ndarray, np.ndarray]:
        """Return R with R·Rᵀ the pseudo-inverse of AᵀA + W, A the whitened nuisances, W the weights; and A·R."""
        whitened = self.white_nuisance
        precision = whitened.T @ whitened + np.diag(self.weight)
        # Scaled to a unit diagonal, so that `RANK_TOLERANCE` is independent of units.
        norms = np.sqrt(np.diag(precision))
        norms = np.where(norms > 0, norms, 1.0)
        eigenvalues, vectors = np.linalg.eigh(precision / norms / norms[:, None])
        is_identified = eigenvalues > RANK_TOLERANCE * eigenvalues[-1:]
        root = np.where(is_identified, 1 / np.sqrt(np.where(is_identified, eigenvalues, 1.0)), 0.0)
        root = vectors * root / norms[:, None]
        return root, whitened @ root

    @property
    def root(self) -> Float[np.ndarray, "q q"]:
        """Return R with R·Rᵀ the posterior covariance of θ, in prior standard deviations (q, q)."""
        return self._decomposition[0]

    def uncertainty(self, i: int) -> float:
        """Return the posterior standard uncertainty of the unknown of nuisance column i, in its unit."""
        return float(np.linalg.norm(self.root[i]) * self.sd[i])

    @property
    def directions(self) -> Float[np.ndarray, "n q"]:
        """Return G with the hat matrix H = G·Gᵀ: whitened residuals have the covariance I − H under the model.

        H = A·(AᵀA + W)⁻¹·Aᵀ, A the whitened nuisances and W their prior weights (0 where flat). Whitened readings have
        the covariance I + A·W⁻¹·Aᵀ, and (I − H)·(I + A·W⁻¹·Aᵀ)·(I − H) = I − H.
        """
        return self._decomposition[1]

    @cached_property
    def conditional_residuals(self) -> Float[np.ndarray, "n"]:
        """Return the residuals after one Gauss–Newton step of all coefficients and shapes, output unit (n,)."""
        # The step is (AᵀA + W)⁻¹(Aᵀr − W·z).
        rhs = (
            self.white_nuisance.T @ self.whiten(self.residual[:, None])[:, 0] - self.weight * self.z
        )
        return self.residual - self.nuisance @ (self.root @ (self.root.T @ rhs))

    @cached_property
    def white_conditional(self) -> Float[np.ndarray, "n"]:
        return self.whiten(self.conditional_residuals[:, None])[:, 0]

    @cached_property
    def scores(self) -> Float[np.ndarray, "n"]:
        """Return the conditional residuals as scores that are standard normal under the noise law (n,)."""
        problem = self.problem
        if problem.noise.is_gaussian:
            return self.white_conditional
        values, residuals = problem.hyper(self.mode.v), self.conditional_residuals
        return normal_scores(problem.noise, values, problem.record, residuals, self.extra)

    def normal_eqs(
        self, columns: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return CᵀΣ⁻¹r and CᵀΣ⁻¹C of columns C and conditional residuals r, without projecting nuisances out."""
        table = self.whiten(np.column_stack([columns, self.conditional_residuals]))
        return table[:, :-1].T @ table[:, -1], table[:, :-1].T @ table[:, :-1]

    @cached_property
    def variance(self) -> Float[np.ndarray, "n"]:
        """Return the variance of each reading about its expected output, output unit squared (n,)."""
        hyper, extra = self.problem.hyper(self.mode.v), self.extra
        return variance(self.problem.noise, hyper, self.problem.record) + extra

    @cached_property
    def rss(self) -> float:
        """Return the whitened residual sum of squares plus the prior's penalty Σ z² (proper priors only)."""
        whitened = self.decorrelate(self.residual[:, None])
        return float(np.sum(whitened**2)) + float(self.weight @ self.z**2)

    def project_on_nuisance(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "q k"]:
        """Return P = Gᵀ·C of whitened columns C: their information given the nuisances is CᵀC − PᵀP."""
        return self.directions.T @ columns

    def deflate(self, column: Float[np.ndarray, "n"], mask: np.ndarray) -> Float[np.ndarray, "n"]:
        """Project masked nuisances out of a whitened column, by ridge regression under their priors."""
        nuisances = self.white_nuisance[:, mask]
        precision = nuisances.T @ nuisances + np.diag(self.weight[mask])
        return column - nuisances @ np.linalg.lstsq(precision, nuisances.T @ column, rcond=1e-12)[0]

    def score(
        self, columns: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return the score u = XᵀV⁻¹r and information XᵀV⁻¹X of candidate columns X, output unit per prior sd.

        V = Σ + J·D·Jᵀ: all nuisances are integrated out under their priors, hyper-parameters fixed at their estimates.
        """
        table = self.whiten(columns)
        projection = self.project_on_nuisance(table)
        # V⁻¹r is Σ⁻¹ times the residuals at the fit.
        return table.T @ self.white_conditional, table.T @ table - projection.T @ projection

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Return the derivatives of the expected output with respect to each slot, at the mode (n,) each."""
        return self.problem.slopes(self.mode.x, self.problem.hyper(self.mode.v))


def explained_sum_of_squares(
    u: Float[np.ndarray, "*b k"], information: Float[np.ndarray, "*b k k"]
) -> tuple[Float[np.ndarray, "*b"], Float[np.ndarray, "*b"]]:
    """Return ½·log|I + K| and uᵀ(I + K)⁻¹u of score u and information K of columns with standard normal coefficients.

    Returns:
        Half log determinant (infinite if not positive definite), and explained sum of squares, of each set of columns.
    """
    # The log Bayes factor is ½·uᵀ(I + K)⁻¹u − ½·log|I + K|; the determinant from the Cholesky factor L·Lᵀ = I + K.
    chol = cholesky(information + np.eye(u.shape[-1]))
    is_nan = np.isnan(chol).any(axis=(-2, -1))
    chol = np.where(is_nan[..., None, None], np.eye(u.shape[-1]), chol)
    scores = np.linalg.solve(chol, u[..., None])[..., 0]
    half_logdet = np.log(np.diagonal(chol, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.where(is_nan, np.inf, half_logdet), np.where(is_nan, 0.0, np.sum(scores**2, axis=-1))


def linearise_model(problem: Problem, mode: Mode) -> LinearModel:
    """Return a fitted model linearised about its mode."""
    density = Density(problem, mode.x, mode.flat, mode.v)
    hyper = problem.hyper(mode.v)
    line = problem.linearise(mode.x, hyper)
    prior = problem.prior(hyper, mode.flat)
    _, conditional = density.condition_at(mode.v)
    # The variance from noisy inputs depends on x, which the conditional mean ignores: keep x̂ there.
    x = mode.x if conditional is None or problem.is_noisy else conditional.mean
    residual = problem.record.y - line.mean - line.jacobian @ (x - mode.x)

    def mean(shapes: np.ndarray) -> np.ndarray:
        hyper = problem.hyper(overwrite(shapes, problem.nonlinear_phi, mode.v))
        return problem.linearise(x, hyper).mean

    # To first order a shape is one more coefficient of prior sd 1; its column is ∂output/∂coordinate.
    slopes = differentiate(mean, mode.v[problem.nonlinear_phi], DIFF_STEP)
    nuisance = np.empty((len(residual), problem.size + len(slopes)))
    np.multiply(line.jacobian, prior.sd, out=nuisance[:, : problem.size])
    nuisance.T[problem.size :] = slopes if len(slopes) else 0.0
    # Standardised x; zero if the prior has zero width.
    z = np.where(prior.sd > 0, (x - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0), 0.0)
    owners = [t.effect.name for t in problem.in_x for _ in range(t.x_slice.start, t.x_slice.stop)]
    extra = problem.extra(line)
    return LinearModel(
        problem=problem,
        mode=mode,
        mean=line.mean,
        residual=residual,
        nuisance=nuisance,
        weight=np.append(prior.weight, np.ones(len(slopes))),
        sd=np.append(prior.sd, np.ones(len(slopes))),
        owners=(*owners, *(problem.hypers[i].effect for i in problem.nonlinear_phi)),
        z=np.append(prior.weight * z, mode.v[problem.nonlinear_phi]),
        whiten=whitening(problem.noise, hyper, problem.record, extra, residual),
        extra=extra,
    )


def linearise_at_priors(problem: Problem, noise: float | None = None) -> LinearModel:
    """Return a model linearised about its prior means; noise: standard deviation of the white noise, output unit."""
    v, x = np.zeros(len(problem.hypers)), problem.start
    for i, h in enumerate(problem.hypers):
        if h.name == WHITE and noise is not None:
            v[i] = float(h.prior.coordinate(noise))
    flat = compute_flat_scales(problem, x, v)
    return linearise_model(problem, Mode(x, v, np.eye(len(v)), 0.0, 0.0, 0.0, flat, False))


def fill_amplitudes(model: Model, readings: Measurements, record: Record) -> Model:
    """Return the model with plausible amplitude ranges of placeholder effects, estimated from the readings.

    A range extends from the detection limit, noise over √n, to ten times half the range of the residuals of a fit of
    the other effects, which may have absorbed a part.

    Raises:
        ModelError: a placeholder adds to a slot that is not in the output's unit.
    """
    if not (placeholders := [e for e in model.effects if e.open]):
        return model
    for e in placeholders:
        if model.instrument.slot(e.slot).unit != model.instrument.unit:
            raise ModelError(
                f"Effect {e.name!r} adds to {e.slot!r}, which is not in the output's unit [{model.instrument.unit}]: "
                "give its plausible amplitudes, low and high"
            )
    reduced_model = replace(model, effects=tuple(e for e in model.effects if not e.open))
    amplitude_range = guess_amplitudes(reduced_model, readings, record)
    effects = tuple(e.with_open_ranges(*amplitude_range) if e.open else e for e in model.effects)
    return replace(model, effects=effects)


def guess_amplitudes(model: Model, readings: Measurements, record: Record) -> tuple[float, float]:
    """Return the plausible range (low, high) of the amplitude of effects that a model lacks, output unit."""
    frame, y = record.frame, record.y
    residual = _fit_residual(Problem(bind(model, readings)[0], record.with_frame()))
    # Robust noise estimate: 1.4826·median|difference of neighbours|/√2; missing effects change little between readings.
    diffs, step = np.diff(residual[np.asarray(frame.order)]), np.asarray(frame.step)[1:]
    diffs = diffs[step > 0] if np.any(step > 0) else diffs
    noise_sd = 1.4826 * float(np.median(np.abs(diffs))) / math.sqrt(2) if len(diffs) else 0.0
    half_range = _compute_half_range(residual) or _compute_half_range(y) or 1.0
    low = (noise_sd or half_range) / math.sqrt(len(residual))
    return tuple(float(f"{v:.2g}") for v in (min(low, half_range), 10 * half_range))  # pyright: ignore


def _compute_half_range(values: Float[np.ndarray, "n"]) -> float:
    """Return half of the difference between the 99.5 % and 0.5 % quantiles."""
    low, high = np.quantile(values, [0.005, 0.995])
    return 0.5 * float(high - low)


def _fit_residual(problem: Problem) -> Float[np.ndarray, "n"]:
    """Return the residuals of a least-squares fit of ungrouped coefficients, hyper-parameters at the prior median."""
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    x, y = problem.start, problem.record.y
    indices = [t.x_slice.start for t in problem.in_x if t.per is None and t.group_sd_name is None]
    residual = y - np.mean(y)
    for _ in range(GAUSS_NEWTON_STEPS):
        line = problem.linearise(x, hyper)
        if not np.all(np.isfinite(line.mean)):
            break
        residual = y - line.mean
        columns = line.jacobian[:, indices]
        # Columns of unit rms, so that `RANK_TOLERANCE` is independent of units and priors.
        scale = compute_column_scales(columns)
        x[indices] += scale * np.linalg.lstsq(columns * scale, residual, rcond=RANK_TOLERANCE)[0]
    return residual
