"""A fitted structure as a linear model: whitened residual and nuisance columns, shapes among them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._data.measurements import Measurements
from bayescal._inference.density import Density
from bayescal._inference.gaussian import column_scale, factors
from bayescal._inference.laplace import Mode, flat_scales
from bayescal._inference.noise_nodes import InFrequency
from bayescal._inference.noise_on_record import (
    Independent,
    Whitening,
    normal_scores,
    variance,
    whitening,
)
from bayescal._inference.problem import Problem, differences, put
from bayescal._inference.record import Record
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_law import WHITE
from bayescal._model.parameters import bind

STEP = 1e-4  # of a shape's coordinate, for the slope of the output by it
RANK = 1e-12  # of the largest eigenvalue, below which a direction was not fitted

GAUSS_NEWTON = 4  # linearisations of the expected output: enough for an order of magnitude


def learned_size(effect: Effect, problem: Problem, mode: Mode) -> tuple[float, float] | None:
    """Return the spread or amplitude that an effect's size is, with its uncertainty, or None."""
    learned = effect.measure_name or effect.group_sd_name(0)
    names = learned in problem.layout.index_in_phi
    return problem.value_and_sd(learned, mode.v, mode.covariance) if names else None


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The readings as y = μ + columns·θ + noise about a mode."""

    problem: Problem  # of the structure
    mode: Mode
    mean: Float[np.ndarray, "n"]  # the expected output at the mode
    residual: Float[np.ndarray, "n"]  # at the posterior mean of θ, output unit (n,)
    # slopes by x and by the moving entries of φ, times their prior's standard deviations (n, q)
    nuisance: Float[np.ndarray, "n q"]
    weight: Float[np.ndarray, "q"]  # 1 where the prior is proper, 0 where it is flat (q,)
    sd: Float[np.ndarray, "q"]
    owners: tuple[str, ...]  # of each of these columns, the effect (q,)
    # where θ stands, in standard deviations from its prior mean; 0 where the prior is flat (q,)
    z: Float[np.ndarray, "q"]
    whiten: Whitening | Independent  # of the readings
    extra: Float[np.ndarray, "n"] | float  # variance that noise on inputs adds (n,), or 0

    @property
    def size(self) -> int:
        return len(self.residual)

    @cached_property
    def at_rest(self) -> Record:
        """Return the residuals as a record of a channel at rest, on which noise laws are tried."""
        return self.problem.record.of_noise(self.residual)

    def decorrelate(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Return columns whitened and turned by a matrix that is the same for all: for products, not row by row."""
        law = self.whiten
        if isinstance(law, Whitening) and not self.problem.noisy:
            nodes = law.record.nodes(law.law)
            if isinstance(nodes, InFrequency):
                return nodes.whitened(law.law, law.values, columns)
        return law(columns)

    @cached_property
    def white_residual(self) -> Float[np.ndarray, "n"]:
        return self.whiten(self.residual[:, None])[:, 0]

    @cached_property
    def white_nuisance(self) -> Float[np.ndarray, "n q"]:
        return self.whiten(self.nuisance)

    def contribution(self, name: str) -> Float[np.ndarray, "n"]:
        """Return what an effect adds to the expected output against its priors' means, output unit."""
        is_own = np.array([owner == name for owner in self.owners])
        x = np.flatnonzero(is_own[: self.problem.size])
        return self.nuisance[:, x] @ self.z[x]

    @cached_property
    def _eigen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return R with R·Rᵀ the inverse of AᵀA + W, A whitened and W the weights, where this has one; and A·R."""
        white = self.white_nuisance
        inner = white.T @ white + np.diag(self.weight)
        # Scaled to a unit diagonal, so that `RANK` is of numbers without units.
        size = np.sqrt(np.diag(inner))
        size = np.where(size > 0, size, 1.0)
        weights, vectors = np.linalg.eigh(inner / size / size[:, None])
        is_known = weights > RANK * weights[-1:]
        root = np.where(is_known, 1 / np.sqrt(np.where(is_known, weights, 1.0)), 0.0)
        root = vectors * root / size[:, None]
        return root, white @ root

    @property
    def root(self) -> Float[np.ndarray, "q q"]:
        """Return R, with R·Rᵀ the covariance of all unknowns in units of their priors."""
        return self._eigen[0]

    def uncertainty(self, i: int) -> float:
        """Return the standard uncertainty of a column's unknown, its prior counted, in its unit."""
        return float(np.linalg.norm(self.root[i]) * self.sd[i])

    @property
    def directions(self) -> Float[np.ndarray, "n q"]:
        """Return G: whitened residuals have the covariance I − G·Gᵀ.

        That is if the model is right. With A the whitened nuisances and W their weights (0 where flat), whitened
        readings have the covariance I + A·W⁻¹·Aᵀ, and the residuals are (I − H) times them, with the leverages
        H = A·(AᵀA + W)⁻¹·Aᵀ = G·Gᵀ; so (I − H)·(I + A·W⁻¹·Aᵀ)·(I − H) = I − H.
        """
        return self._eigen[1]

    @cached_property
    def conditional_residuals(self) -> Float[np.ndarray, "n"]:
        """Return the residuals once all of θ is fitted together, shapes too, output unit."""
        # One Gauss–Newton step of all θ from where they stand: (AᵀA + W)⁻¹(Aᵀr − W·z).
        pull = self.white_nuisance.T @ self.white_residual - self.weight * self.z
        return self.residual - self.nuisance @ (self.root @ (self.root.T @ pull))

    @cached_property
    def white_conditional(self) -> Float[np.ndarray, "n"]:
        return self.whiten(self.conditional_residuals[:, None])[:, 0]

    @cached_property
    def scores(self) -> Float[np.ndarray, "n"]:
        """Return conditional residuals as independent standard normal numbers if the noise law is right."""
        problem = self.problem
        if problem.noise.gaussian:
            return self.white_conditional
        values, residuals = problem.hyper(self.mode.v), self.conditional_residuals
        return normal_scores(problem.noise, values, problem.record, residuals, self.extra)

    def along(
        self, columns: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return CᵀΣ⁻¹r and CᵀΣ⁻¹C of columns and conditional residuals: no nuisance is taken out again."""
        white = self.whiten(np.column_stack([columns, self.conditional_residuals]))
        return white[:, :-1].T @ white[:, -1], white[:, :-1].T @ white[:, :-1]

    @cached_property
    def variance(self) -> Float[np.ndarray, "n"]:
        """Return the variance of each reading about its expected output."""
        hyper, extra = self.problem.hyper(self.mode.v), self.extra
        return variance(self.problem.noise, hyper, self.problem.record) + extra

    @cached_property
    def rss(self) -> float:
        """Return the residual sum of squares, the prior's share included."""
        white = self.decorrelate(self.residual[:, None])
        return float(np.sum(white**2)) + float(self.weight @ self.z**2)

    def projected(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "q k"]:
        """Return the nuisances' part of whitened columns, P = Gᵀ·C: the information left is CᵀC − PᵀP."""
        return self.directions.T @ columns

    def beyond(self, column: Float[np.ndarray, "n"], mask: np.ndarray) -> Float[np.ndarray, "n"]:
        """Project some nuisances (a mask) out of a whitened column, as far as their priors allow."""
        others = self.white_nuisance[:, mask]
        inner = others.T @ others + np.diag(self.weight[mask])
        return column - others @ np.linalg.lstsq(inner, others.T @ column, rcond=1e-12)[0]

    def score(
        self, columns: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Return score and information of columns that are not in the model, output unit per prior sd.

        With every nuisance integrated out under its prior (V = Σ + J·D·Jᵀ, spreads and noise at their estimates) the
        score u = XᵀV⁻¹r and the information XᵀV⁻¹X.
        """
        white = self.whiten(columns)
        projection = self.projected(white)
        # V⁻¹r is Σ⁻¹ times the residuals at the fit.
        return white.T @ self.white_conditional, white.T @ white - projection.T @ projection

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Return the slopes of the expected output by each slot, at the mode."""
        return self.problem.slopes(self.mode.x, self.problem.hyper(self.mode.v))


def explained_sum_of_squares(
    u: Float[np.ndarray, "*b k"], information: Float[np.ndarray, "*b k k"]
) -> tuple[Float[np.ndarray, "*b"], Float[np.ndarray, "*b"]]:
    """Return what columns of standard normal coefficients explain, by score and information.

    Returns:
        Of each set of columns half a log volume, infinite where there is none, and what of the sum of squares.
    """
    # With columns of standard normal coefficients the log Bayes factor is ½·uᵀ(I + K)⁻¹u − ½·log|I + K|, K the
    # information: these are its two parts, the second by L·Lᵀ = I + K.
    chol = factors(information + np.eye(u.shape[-1]))
    failed = np.isnan(chol).any(axis=(-2, -1))
    chol = np.where(failed[..., None, None], np.eye(u.shape[-1]), chol)
    half = np.linalg.solve(chol, u[..., None])[..., 0]
    volume = np.log(np.diagonal(chol, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.where(failed, np.inf, volume), np.where(failed, 0.0, np.sum(half**2, axis=-1))


def linear_model(problem: Problem, mode: Mode) -> LinearModel:
    """Linearise a structure about its mode."""
    density = Density(problem, mode.x, mode.flat, mode.v)
    hyper = problem.hyper(mode.v)
    line = problem.linearise(mode.x, hyper)
    prior = problem.prior(hyper, mode.flat)
    _, conditional = density.at(mode.v)
    # The variance that noise on inputs adds moves with x, which a step of Gauss–Newton does not know.
    x = mode.x if conditional is None or problem.noisy else conditional.mean
    residual = problem.record.y - line.mean - line.jacobian @ (x - mode.x)

    def mean(shapes: np.ndarray) -> np.ndarray:
        return problem.linearise(x, problem.hyper(put(shapes, problem.moving, mode.v))).mean

    # To first order a shape is one more unknown: its column is the slope by its coordinate, of prior width one.
    slopes = differences(mean, mode.v[problem.moving], STEP)
    nuisance = np.empty((len(residual), problem.size + len(slopes)))
    np.multiply(line.jacobian, prior.sd, out=nuisance[:, : problem.size])
    nuisance.T[problem.size :] = slopes if len(slopes) else 0.0
    # Where x stands in units of its prior: a prior of no width has its coefficient at the mean.
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
        owners=(*owners, *(problem.hypers[i].effect for i in problem.moving)),
        z=np.append(prior.weight * z, mode.v[problem.moving]),
        whiten=whitening(problem.noise, hyper, problem.record, extra, residual),
        extra=extra,
    )


def about_priors(problem: Problem, noise: float | None = None) -> LinearModel:
    """Linearise a structure about its priors' means; `noise`: standard deviation of the white part."""
    v, x = np.zeros(len(problem.hypers)), problem.start
    for i, h in enumerate(problem.hypers):
        if h.name == WHITE and noise is not None:
            v[i] = float(h.prior.coordinate(noise))
    flat = flat_scales(problem, x, v)
    return linear_model(problem, Mode(x, v, np.eye(len(v)), 0.0, 0.0, 0.0, flat, False))


def sized(model: Model, readings: Measurements, record: Record) -> Model:
    """Return the model with the open amplitudes of unknown dependences filled in.

    They plausibly lie between what the readings could just show, their noise over √n, and an order of magnitude more
    than the other effects leave of the output: these may have taken up a part.

    Raises:
        ModelError: one adds to a slot that is not in the output's unit.
    """
    if not (open_ := [e for e in model.effects if e.open]):
        return model
    for e in open_:
        if model.instrument.slot(e.slot).unit != model.instrument.unit:
            raise ModelError(
                f"Effect {e.name!r} adds to {e.slot!r}, which is not in the output's unit [{model.instrument.unit}]: "
                "give its plausible amplitudes, low and high"
            )
    named = replace(model, effects=tuple(e for e in model.effects if not e.open))
    plausible = amplitudes(named, readings, record)
    effects = tuple(e.sized(*plausible) if e.open else e for e in model.effects)
    return replace(model, effects=effects)


def amplitudes(model: Model, readings: Measurements, record: Record) -> tuple[float, float]:
    """Return plausible amplitudes of what a model lacks, output unit: see `sized`."""
    frame, y = record.frame, record.y
    residual = _least_squares_residual(Problem(bind(model, readings)[0], record.with_frame()))
    # Neighbours differ by √2 of white noise's standard deviation, which is 1.4826 times its median absolute value;
    # what the model lacks hardly changes from one reading to the next.
    change, step = np.diff(residual[np.asarray(frame.order)]), np.asarray(frame.step)[1:]
    change = change[step > 0] if np.any(step > 0) else change
    noise = 1.4826 * float(np.median(np.abs(change))) / math.sqrt(2) if len(change) else 0.0
    half_range = _half_range(residual) or _half_range(y) or 1.0
    low = (noise or half_range) / math.sqrt(len(residual))
    return tuple(float(f"{v:.2g}") for v in (min(low, half_range), 10 * half_range))  # pyright: ignore


def _half_range(values: Float[np.ndarray, "n"]) -> float:
    """Return half of the range, without the outermost hundredth of the values."""
    low, high = np.quantile(values, [0.005, 0.995])
    return 0.5 * float(high - low)


def _least_squares_residual(problem: Problem) -> Float[np.ndarray, "n"]:
    """Return the residuals of a least-squares fit of the plain coefficients, all else at the prior's middle."""
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    x, y = problem.start, problem.record.y
    plain = [t.x_slice.start for t in problem.in_x if t.per is None and t.group_sd_name is None]
    residual = y - np.mean(y)
    for _ in range(GAUSS_NEWTON):
        line = problem.linearise(x, hyper)
        if not np.all(np.isfinite(line.mean)):
            break
        residual = y - line.mean
        columns = line.jacobian[:, plain]
        # Columns of unit size: `RANK` is then of directions, not of units or of how wide a prior is.
        size = column_scale(columns)
        x[plain] += size * np.linalg.lstsq(columns * size, residual, rcond=RANK)[0]
    return residual
