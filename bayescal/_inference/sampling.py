"""Adaptive importance sampling of φ, with coefficients x drawn from their conditional posterior.

φ is proposed from Student-t mixtures, first around its Laplace approximation, then around many weighted draws of the
previous round, since weakly identified deviations have densities far from elliptical. The mean weight estimates the
evidence. Nonlinearity is corrected by the same weights: exact joint density of (x, φ) over proposal density.
Source: A. Owen and Y. Zhou, JASA 95 (2000) 135 (defensive mixtures); M. West, J. R. Stat. Soc. B 55 (1993) 409
(mixtures around weighted draws).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln, logsumexp, ndtr, ndtri, softmax

from bayescal._core import deadline
from bayescal._core.importance_weights import Corrections, compute_ess, smooth
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.gaussian import XDraws
from bayescal._inference.joint import T_DOF, correct_weights, draw_normals
from bayescal._inference.laplace import Mode, find_mode
from bayescal._inference.newton import LOG_ZERO, GaussianFit, Values
from bayescal._inference.problem import Problem
from bayescal._inference.trust import MAX_K_HAT
from bayescal._model.prior import Flat, FlatLine, HalfCauchy, HalfNormal

# Excess over the mode's log density that reveals a higher mode; the error of polynomial columns is 0.02.
HIGHER_MODE_MARGIN_NATS = 1.0

K_HAT_ROUNDS = 3  # round of adaptation from which sound weights end it
MAX_ROUNDS = 4  # of `draw_by_importance`
KERNEL_COUNT = 256  # mixture components, around resampled draws
MIN_KERNEL_COUNT = 128  # in up to three dimensions
KERNEL_WIDTH = 0.7  # width of a component, in standard deviations of φ: the mixture has heavier tails than the target
# Limits of the ratio of the target's width along an axis to the Laplace approximation's.
AXIS_WIDTH_LIMITS = 0.25, 4.0  # per round
WIDTH_ROUNDS = 2  # in which the widths are adapted
AXIS_INFLATION = 1.15  # of the widths: weights of too narrow a proposal have heavy tails
WIDE_RATIO = 1.7  # width of the defensive component over the Laplace approximation's
PRIOR_WEIGHT = 0.2  # probability of proposals from the prior: no weight exceeds likelihood over 0.2 times evidence
# Weights of the prior and of the kernel at the mode if each proposal costs a pass over the readings.
COSTLY_PRIOR_WEIGHT, KERNEL_WEIGHT = 0.05, 0.05
# Ratio of effective to actual sample size at which adaptation ends.
ESS_RATIO = 0.5
MAX_ARRAY_ELEMENTS = 1_000_000  # per batch, to bound memory
CACHE_ELEMENTS = 150_000  # array elements per batch, to stay in the processor's cache
FIRST_BATCH_DRAWS = 256  # draws of a nonlinear model whose corrections are computed first, in case they are constant
DISTANCE_BATCH_DRAWS = 512  # draws per batch of distances to all components
# Array elements computed for φ outside the region of fitted polynomials, for a random subset of these.
FAR_ELEMENTS = 40_000
NEGLIGIBLE_NATS = 40.0  # distance below the largest log weight at which a draw is negligible
MIN_COSTLY_READINGS = 1000  # readings, from which a pass over them is expensive
MAX_PROPOSALS, MEDIUM_PROPOSALS, MIN_PROPOSALS = 8192, 4096, 2048  # from cheap to costly
# For a structure in a model average: if proposals are cheap; if each costs a pass over the readings.
MIN_PROPOSALS_PER_STRUCTURE = 128, 64
COSTLY_BATCHES = 4  # batches of costly proposals
# Posterior probability of a structure above which unreliable weights justify another search for its mode.
RESTART_PROBABILITY = 0.1


class WeightedDraws(NamedTuple):
    """Joint draws of coefficients x and coordinates v of φ with unnormalised, unsmoothed log importance weights."""

    x: Float[np.ndarray, "s p"]
    v: Float[np.ndarray, "s d"]
    log_weight: Float[np.ndarray, "s"]
    log_weight_phi: Float[np.ndarray, "s"]  # of φ alone, before the correction for nonlinearity
    log_evidence: Float[np.ndarray | np.float64, ""]
    log_evidence_error: Float[np.ndarray | np.float64, ""]
    mode: Mode  # around which the last round was proposed
    rounds: Rounds | None = None  # to be continued with further draws


class Mixture(NamedTuple):
    """Mixture of Student-t kernels with equal weights and scale matrices, and of a usually wider split-t component.

    The split-t component has two widths along each axis (split normal: G. Fechner 1897; multivariate: M. Villani
    and R. Larsson, Commun. Stat. 35 (2006) 1123).
    """

    centres: Float[np.ndarray, "m d"]  # of the kernels
    chol: Float[np.ndarray, "d d"]  # Cholesky factor of the kernels' scale matrix
    middle: Float[np.ndarray, "d"]  # centre of the split-t component
    axes: Float[np.ndarray, "d d"]  # axes of the split-t component, in columns
    split_weight: float  # weight of the split-t component
    widths: tuple[Any, Any] = (1.0, 1.0)  # its relative widths below and above the centre
    dof: float = T_DOF  # degrees of freedom

    def draw(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        dim = self.centres.shape[1]
        # Multivariate Student-t: a normal vector times √(ν/χ²_ν), one factor for all its coordinates.
        scale = np.sqrt(self.dof / rng.chisquare(self.dof, count))[:, None]
        deviates = rng.standard_normal((count, dim))
        component = rng.integers(len(self.centres), size=count)
        is_split = rng.random(count) < self.split_weight
        kernel_draws = self.centres[component] + scale * deviates @ self.chol.T
        # Split normal: the probability of a side is proportional to its width.
        down, up = self.widths
        below_centre = down * ndtri(np.minimum(ndtr(deviates) * (down + up) / (2 * down), 0.5))
        above_centre = -up * ndtri(np.minimum(ndtr(-deviates) * (down + up) / (2 * up), 0.5))
        wide_draws = self.middle + scale * (below_centre + above_centre) @ self.axes.T
        return np.where(is_split[:, None], wide_draws, kernel_draws)

    def log_density(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        dim = self.centres.shape[1]
        dof, half = self.dof, 0.5 * (self.dof + dim)
        # Density: Γ((ν+d)/2)/(Γ(ν/2)·(νπ)^(d/2)·|L|)·(1 + |L⁻¹(v − c)|²/ν)^(−(ν+d)/2), summed over the centres c.
        log_norm = gammaln(half) - gammaln(0.5 * dof) - 0.5 * dim * math.log(dof * math.pi)
        kernels, counts = np.unique(self.centres, axis=0, return_counts=True)
        # |z − c|² = |z|² − 2·zᵀc + |c|², without cancellation relative to the middle; resampled centres repeat.
        z, c = (_whiten(self.chol, v - self.middle), _whiten(self.chol, kernels - self.middle))
        c, offset = c.T * (-2 / dof), 1 + np.sum(c**2, axis=1) / dof
        kernel_sums = np.empty(len(v))
        for start in range(0, len(v), DISTANCE_BATCH_DRAWS):  # so many that they stay in the cache
            rows = z[start : start + DISTANCE_BATCH_DRAWS]
            terms = rows @ c
            terms += offset
            terms += np.sum(rows**2, axis=1)[:, None] / dof
            np.log(np.maximum(terms, 1.0, out=terms), out=terms)
            terms *= -half
            kernel_sums[start : start + DISTANCE_BATCH_DRAWS] = np.exp(terms, out=terms) @ counts
        # Far away the kernels underflow to zero: the defensive component dominates.
        volumes = np.linalg.slogdet(np.stack([self.chol, self.axes]))[1]  # logarithms
        log_kernels = np.log(kernel_sums / len(self.centres) + 1e-300) - volumes[0]
        down, up = self.widths
        z = _whiten(self.axes, v - self.middle)
        log_wide = -half * np.log1p(np.sum((z / np.where(z < 0, down, up)) ** 2, axis=1) / dof)
        log_wide -= volumes[1] + np.sum(np.log(0.5 * (down + up) * np.ones(dim)))
        return log_norm + np.logaddexp(
            log_kernels + math.log1p(-self.split_weight), log_wide + math.log(self.split_weight)
        )


def _whiten(chol: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.linalg.solve(chol, v.T).T if chol.size else v


class BatchedDensity:
    """Marginal log density of many φ at once, and draws of the coefficients x given each φ.

    table: Gram matrices as polynomials in φ about the mode; None if each φ requires new columns or a pass over the
    readings. is_exact: the noise is Gaussian, so that the marginal is exact for an affine output.
    """

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode, self.size = problem, mode, problem.record.size
        self.density = Density(problem, mode.x, mode.flat, mode.v)
        tabulated, self.table = self.density.tabulated, None
        if tabulated is not None and np.all(np.isfinite(mode.covariance)):
            self.table = tabulated.fit_polynomials(mode.v, mode.covariance, mode.flat)
        self.is_exact = problem.noise.is_gaussian
        self.batch_size = max(16, MAX_ARRAY_ELEMENTS // (problem.size + 1) ** 2)
        if self.table is None:  # small batches, between which the deadline is checked
            self.batch_size = min(self.batch_size, max(16, CACHE_ELEMENTS // self.size))
        self.max_log_density, self.max_v = float(mode.log_density), mode.v
        self.rng = np.random.default_rng(0)
        self.far_fraction = min(1.0, FAR_ELEMENTS / (PRIOR_WEIGHT * MAX_PROPOSALS * self.size))

    def draw_at(self, v: Float[np.ndarray, "b d"], z: np.ndarray) -> tuple[np.ndarray, XDraws]:
        """Return the log density of each φ (b,), and draws of x given φ from normal deviates z (b, p)."""
        log_prior = self.problem.log_priors(v)
        args = self.mode.flat, self.density.origin
        draws = self.problem.draw_x((self.table or self.density).grams(v), v, *args, z)
        is_computed = np.zeros(len(v), dtype=bool)
        if self.table is not None:
            # A random subset, reweighted: a distant mode is detected at bounded cost.
            is_outside = ~self.table.contains(v)
            is_computed = is_outside & (self.rng.random(len(v)) < self.far_fraction)
            draws.log_marginal[is_outside] = LOG_ZERO
            if is_computed.any():
                grams, z_computed = self.density.grams(v[is_computed]), z[is_computed]
                computed_draws = self.problem.draw_x(grams, v[is_computed], *args, z_computed)
                for target, source in zip(draws, computed_draws, strict=True):
                    target[is_computed] = source
        log_density = draws.log_marginal + log_prior
        is_finite = np.isfinite(log_density) & (draws.log_marginal > LOG_ZERO)
        log_density = np.where(is_finite, log_density, LOG_ZERO)
        if len(v) and log_density[index := int(np.argmax(log_density))] > self.max_log_density:
            self.max_log_density, self.max_v = float(log_density[index]), v[index]
        log_density[is_computed] -= math.log(self.far_fraction)
        return log_density, draws

    def values(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        size, parts = self.problem.size, []
        for part in np.array_split(v, -(-len(v) // self.batch_size)):
            deadline.current().raise_if_over()
            parts.append(self.draw_at(part, np.zeros((len(part), size)))[0])
        return np.concatenate(parts)


class PriorComponent(NamedTuple):
    """Proper prior of φ as a component of the proposal: sampler, log density and mixture weight."""

    draw: Callable[[np.random.Generator, int], Float[np.ndarray, "s d"]]
    log_density: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]]
    weight: float = PRIOR_WEIGHT


def adapt_proposal(
    mode: Mode,
    values: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]],
    prior: PriorComponent | None,
    rng: np.random.Generator,
    proposal_count: int,
    max_rounds: int,
    limit: float,
) -> Mixture:
    """Adapt a proposal distribution to a density that is cheap to evaluate.

    Draws of all rounds are weighted by the mixture of all proposals.
    Source: J.-M. Cornuet et al., Scand. J. Statist. 39 (2012) 798 (adaptive multiple importance sampling).

    Args:
        mode: mode of the density and Laplace approximation.
        values: function that returns the unnormalised log density at several points.
        prior: prior as a defensive proposal; None if it is improper.
        proposal_count: number of draws per round.
        max_rounds: largest number of rounds; fewer if the effective sample size is large, or k̂ sound after three.
        limit: log density above which a draw reveals a higher mode, and adaptation stops.
    """
    # Population Monte Carlo: O. Cappé et al., J. Comput. Graph. Stat. 13 (2004) 907.
    # A kernel at the mode, and a defensive one 1.7 times as wide.
    chol, rounds_pool = np.linalg.cholesky(mode.covariance), Rounds(prior)
    mixture = Mixture(mode.v[None], chol, mode.v, WIDE_RATIO * chol, 0.4)
    for k in range(max_rounds if len(mode.v) else 0):
        v, log_proposal = draw_proposals(mixture, prior, rng, proposal_count)
        log_density = values(v)
        log_weight = log_density - log_proposal
        if np.max(log_density) > limit or compute_ess(softmax(log_weight)) > ESS_RATIO * len(v):
            break
        sample = _Sample(v, log_density, np.zeros((len(v), 0)), log_density)
        rounds_pool.add(mixture, log_proposal, sample)
        mixture = _update_mixture(mixture, mode, rounds_pool.samples.v, rounds_pool.log_weight)
        if k + 1 >= K_HAT_ROUNDS and smooth(log_weight)[1] <= MAX_K_HAT:
            break
    return mixture


class Rounds:
    """Draws of all rounds of importance sampling, weighted by the mixture of their proposals.

    Each weight is the target over the mean density of all proposals (deterministic mixture: E. Veach and L. Guibas,
    SIGGRAPH 1995), which bounds the weights of draws that are improbable under their own proposal.
    """

    def __init__(self, prior: PriorComponent | None) -> None:
        self.prior, self.corrections = prior, Corrections()
        self.mixtures = list[Mixture]()
        self.log_q = np.zeros((0, 0))  # log proposal density of each mixture at all draws
        self.counts, self.sample_list = list[int](), list[_Sample]()

    def add(self, mixture: Mixture, log_proposal: np.ndarray, sample: _Sample) -> None:
        """Add the draws of one round, from one mixture, with their log proposal densities."""
        densities = (_mix_log_density(m, self.prior, sample.v) for m in self.mixtures)
        log_q = np.array([*densities, log_proposal])
        if self.mixtures:
            log_density = _mix_log_density(mixture, self.prior, self.samples.v)
            rows = np.vstack([self.log_q, log_density])
            log_q = np.concatenate([rows, log_q], axis=1)
        self.mixtures.append(mixture)
        self.log_q = log_q
        self.counts.append(len(sample.v))
        self.sample_list.append(sample)

    @property
    def samples(self) -> _Sample:
        if len(self.sample_list) > 1:
            self.sample_list = [_Sample(*map(np.concatenate, zip(*self.sample_list, strict=True)))]
        return self.sample_list[0]

    @property
    def log_weight(self) -> Float[np.ndarray, "s"]:
        log_terms = self.log_q + (np.log(self.counts) - math.log(sum(self.counts)))[:, None]
        return self.samples.log_density - np.asarray(logsumexp(log_terms, axis=0))

    def weigh_draws(self, mode: Mode) -> WeightedDraws:
        """Return the draws of all rounds with their importance weights, and the log evidence with its error."""
        v, _, x, corrections = self.samples
        log_weight_phi = self.log_weight
        is_weighted = corrections > LOG_ZERO
        log_weight = np.where(
            is_weighted, log_weight_phi + np.where(is_weighted, corrections, 0.0), LOG_ZERO
        )
        # The mean of the unnormalised weights estimates the evidence, with the relative standard error of a mean.
        evidence = logsumexp(log_weight) - math.log(len(v))  # pyright: ignore[reportOperatorIssue]
        error = np.std(np.exp(log_weight - evidence)) / math.sqrt(len(v))
        evidence, error = np.float64(evidence), np.float64(error)
        return WeightedDraws(x, v, log_weight, log_weight_phi, evidence, error, mode, self)


class _Sample(NamedTuple):
    """Draws of φ, and of x for each φ of non-negligible weight."""

    v: Float[np.ndarray, "s d"]
    log_density: Float[np.ndarray, "s"]  # marginal of φ
    x: Float[np.ndarray, "s p"]
    corrections: Float[np.ndarray, "s"]  # added to the log weight of φ; `LOG_ZERO` if negligible


@run_on_one_thread
def draw_weighted(
    problem: Problem,
    mode: Mode,
    seed: int,
    proposals: int | None,
    rounds: int,
    is_student_t: bool = False,
    earlier_draws: WeightedDraws | None = None,
    probability: float = 1.0,
) -> WeightedDraws:
    """Adapt a proposal distribution, then draw a weighted sample of (x, φ). Deterministic for a seed.

    Args:
        proposals: smallest number of final proposals, half of it per adaptation round; chosen by their cost if None. If
            each costs a pass over the readings, draws of adaptation rounds are included.
        rounds: largest number of adaptation rounds.
        is_student_t: propose coefficients from a Student-t distribution; always if the noise is not Gaussian.
        earlier_draws: weighted draws to extend.
        probability: posterior probability of the structure in a model average; scales the number of proposals.

    Raises:
        TimeIsUp: the deadline passed before the end.
    """
    # Further draws need a different random sequence.
    rng = np.random.default_rng(seed if earlier_draws is None else [seed, len(earlier_draws.v)])
    density, margin = BatchedDensity(problem, mode), HIGHER_MODE_MARGIN_NATS
    prior_component = make_prior_component([h.prior for h in problem.hypers], problem.log_priors)
    if prior_component is not None and density.table is None:
        prior_component = prior_component._replace(weight=COSTLY_PRIOR_WEIGHT)
    is_student_t = is_student_t or not problem.noise.is_gaussian
    earlier_rounds = None if earlier_draws is None else earlier_draws.rounds
    while True:
        min_count = MIN_PROPOSALS_PER_STRUCTURE[density.table is None]
        count = proposals or max(min_count, round(probability * choose_proposal_count(density)))
        threshold = float(density.mode.log_density) + margin
        pool = Rounds(prior_component) if earlier_rounds is None else earlier_rounds
        target = proposals or count // 2, probability * settings().effective_draws
        max_rounds = 0 if density.table is None and probability < RESTART_PROBABILITY else rounds
        _fill_pool(pool, density, rng, count, max_rounds, is_student_t, target, threshold)
        draws, start_v = None, density.max_v
        if density.max_log_density <= threshold:
            draws = pool.weigh_draws(density.mode)
            # For an improbable structure another search for the mode is not worth its cost.
            if probability < RESTART_PROBABILITY or not smooth(draws.log_weight)[1] > MAX_K_HAT:
                return draws
            start_v = draws.v[int(np.argmax(draws.log_weight_phi))]
        # A draw above the mode, or with a dominating weight, indicates another mode: search again from there.
        mode = find_mode(problem, [start_v], x=density.mode.x)
        if mode.log_density > threshold:
            density, earlier_rounds = BatchedDensity(problem, mode), None
        elif draws is not None:
            return draws
        else:  # an artefact of the linearisation about the old mode
            margin, earlier_rounds = math.inf, None


def _make_axis_mixture(density: BatchedDensity) -> Mixture:
    """Return a split-t proposal at the mode, with two widths along each axis: columns of a Cholesky factor.

    The coordinates of largest variance, whose densities are the most skewed, come first; the others follow by
    regression. The widths match the density two standard deviations from the mode, where a Gaussian is two nats lower.
    The degrees of freedom grow with the dimension, so that draws and target have similar distances from the mode.
    Source: H. Rue, S. Martino and N. Chopin, J. R. Stat. Soc. B 71 (2009) 319, §6.5 (axes explored for INLA).
    """
    mode, dim = density.mode, len(density.mode.v)
    order = np.argsort(-np.diag(mode.covariance), kind="stable")
    axes, widths = np.zeros((dim, dim)), np.ones((2, dim))
    axes[order] = np.linalg.cholesky(mode.covariance[np.ix_(order, order)])
    for _ in range(WIDTH_ROUNDS):
        ends = mode.v + np.concatenate([-2 * (axes * widths[0]).T, 2 * (axes * widths[1]).T])
        decrease = np.maximum(float(mode.log_density) - density.values(ends).reshape(2, dim), 1e-9)
        widths *= np.clip(np.sqrt(2 / decrease), *AXIS_WIDTH_LIMITS)
    root, (down, up) = WIDE_RATIO * np.linalg.cholesky(mode.covariance), AXIS_INFLATION * widths
    return Mixture(mode.v[None], root, mode.v, axes, 1 - KERNEL_WEIGHT, (down, up), T_DOF + dim)


def _fill_pool(
    pool: Rounds,
    density: BatchedDensity,
    rng: np.random.Generator,
    count: int,
    rounds: int,
    is_student_t: bool,
    targets: tuple[int, float],
    limit: float,
) -> None:
    """Add `count` draws to a pool; for a costly density in batches until k̂ and effective sample size are sufficient.

    targets: sufficient number of draws and effective sample size. limit: drawing stops at a log density above it.
    """
    mode, prior, is_first = density.mode, pool.prior, not pool.mixtures
    is_costly = density.table is None and len(mode.v) > 0
    if not is_first:
        mixture = _update_mixture(pool.mixtures[0], mode, pool.samples.v, pool.log_weight)
    elif is_costly:
        mixture = _make_axis_mixture(density)
    else:
        args = density.values, prior, rng, count // 2, rounds, limit
        mixture = adapt_proposal(mode, *args)
    batches = COSTLY_BATCHES if is_costly else 1
    max_rounds = max(batches, 2 * rounds if is_costly and is_first else 0)
    for k in range(1, max_rounds + 1):
        if density.max_log_density > limit:
            break
        v, log_proposal = draw_proposals(mixture, prior, rng, -(-count // batches))
        sample = _draw_coefficients(density, pool.corrections, v, log_proposal, is_student_t, rng)
        pool.add(mixture, log_proposal, sample)
        if k == max_rounds or len(pool.samples.v) < targets[0]:
            continue
        weights, k_hat = smooth(log_weight := pool.log_weight)
        if k_hat <= MAX_K_HAT and compute_ess(weights) >= targets[1]:
            break
        if k >= batches:
            mixture = _update_mixture(pool.mixtures[0], mode, pool.samples.v, log_weight)


def choose_proposal_count(density: BatchedDensity) -> int:
    """Return the number of proposals to draw; if each costs a pass over the readings, batches are added as needed."""
    problem = density.problem
    if density.table is None:
        return MIN_PROPOSALS
    is_long = problem.record.size > MIN_COSTLY_READINGS
    is_costly = is_long and not (density.is_exact and problem.is_affine)
    return MEDIUM_PROPOSALS if is_costly or problem.size > 100 else MAX_PROPOSALS


def _draw_coefficients(
    density: BatchedDensity,
    seen_corrections: Corrections,
    v: Float[np.ndarray, "s d"],
    log_proposal: Float[np.ndarray, "s"],
    is_student_t: bool,
    rng: np.random.Generator,
) -> _Sample:
    """Draw x for each φ of non-negligible weight; return the draws and the corrections of their weights."""
    mode, problem, is_exact, count = density.mode, density.problem, density.is_exact, len(v)
    x = np.array(np.broadcast_to(mode.x, (count, len(mode.x))))
    log_density, corrections, maximum = np.empty(count), np.full(count, LOG_ZERO), LOG_ZERO
    batch_size = max(32, min(density.batch_size, CACHE_ELEMENTS // problem.record.size))
    is_nonlinear = is_exact and not problem.is_affine and not seen_corrections.is_constant
    first_batch = FIRST_BATCH_DRAWS if is_nonlinear and count > FIRST_BATCH_DRAWS else 0
    parts = np.array_split(np.arange(first_batch, count), -(-(count - first_batch) // batch_size))
    for rows in ([np.arange(first_batch)] if first_batch else []) + parts:
        deadline.current().raise_if_over()
        normal = draw_normals(problem.size, len(rows), is_student_t, rng)
        log_density[rows], draws = density.draw_at(v[rows], normal)
        log_weight_phi = log_density[rows] - log_proposal[rows]
        maximum = max(maximum, float(np.max(log_weight_phi)))
        # Weights below e⁻⁴⁰ = 4·10⁻¹⁸ of the largest vanish in rounding: no x is needed.
        is_counted = (log_density[rows] > LOG_ZERO) & (log_weight_phi > maximum - NEGLIGIBLE_NATS)
        if not is_counted.any():
            continue
        counted_rows, draws, normal = rows[is_counted], draws.select(is_counted), normal[is_counted]
        if is_exact and seen_corrections.is_constant:  # a constant correction
            log_ratio = np.full(len(counted_rows), seen_corrections.mean)
        else:
            hyper = problem.hyper(v[counted_rows].T)
            log_ratio = correct_weights(problem, draws, normal, hyper, is_exact, is_student_t)
            if is_exact:
                seen_corrections.add(log_weight_phi[is_counted], log_ratio)
        is_finite = np.isfinite(log_ratio)
        x[counted_rows[is_finite]] = draws.x[is_finite]
        corrections[counted_rows[is_finite]] = log_ratio[is_finite]
    # Replace the first draws' corrections too: their scatter would look like a heavy tail.
    if seen_corrections.is_constant and is_exact:
        corrections = np.where(corrections > LOG_ZERO, seen_corrections.mean, LOG_ZERO)
    return _Sample(v, log_density, x, corrections)


def draw_proposals(
    mixture: Mixture, prior: PriorComponent | None, rng: np.random.Generator, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"]]:
    """Draw φ (s, d) from the mixture and, if proper, the prior; return draws and log proposal densities (s,)."""
    v = mixture.draw(rng, count)
    # Defensive mixture with the prior: weights are bounded by likelihood over its share (T. Hesterberg, Technometrics
    # 37 (1995) 185).
    if prior is not None:
        v = np.where(rng.random((count, 1)) < prior.weight, prior.draw(rng, count), v)
    return v, _mix_log_density(mixture, prior, v)


def _mix_log_density(
    mixture: Mixture, prior: PriorComponent | None, v: Float[np.ndarray, "s d"]
) -> Float[np.ndarray, "s"]:
    """Return the log density (s,) of the proposal of `draw_proposals`: mixture and prior."""
    if prior is None:
        return mixture.log_density(v)
    log_mixture, weight = mixture.log_density(v), prior.weight
    return np.logaddexp(math.log1p(-weight) + log_mixture, math.log(weight) + prior.log_density(v))


def make_prior_component(priors: Sequence[Any], log_density: Values) -> PriorComponent | None:
    """Return the prior as a defensive proposal component; None if it is improper or φ is empty."""
    if not priors or any(isinstance(p, (Flat, FlatLine)) for p in priors):
        return None

    def draw(rng: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        return np.stack([draw_prior(p, rng, count) for p in priors], axis=1)

    return PriorComponent(draw, log_density)


def draw_prior(prior, rng: np.random.Generator, count: int) -> Float[np.ndarray, "s"]:
    """Draw `count` values (s,) of one coordinate of φ from its proper prior."""
    if isinstance(prior, HalfCauchy):
        return np.log(np.abs(rng.standard_cauchy(count)))
    deviates = rng.standard_normal(count)
    return np.log(np.abs(deviates)) if isinstance(prior, HalfNormal) else deviates


def _update_mixture(mixture: Mixture, mode: Mode, v: np.ndarray, log_weight: np.ndarray) -> Mixture:
    """Return the next mixture: kernels at resampled draws, their covariance shrunk towards the Laplace approximation.

    The defensive component is kept; for costly proposals its weight decreases with the effective sample size.
    """
    weight = softmax(log_weight)
    weight = np.minimum(weight, 1 / math.sqrt(weight.size))  # truncation, Ionides 2008
    weight = weight / np.sum(weight)
    effective_draws = compute_ess(weight)
    # Shrinkage: at 20 effective draws per coordinate sample and Laplace covariance have equal weight.
    sample_weight = effective_draws / (effective_draws + 20.0 * v.shape[1])
    mean = weight @ v
    weighted_covariance = (weight[:, None] * (v - mean)).T @ (v - mean)
    covariance = sample_weight * weighted_covariance + (1 - sample_weight) * mode.covariance
    chol = KERNEL_WIDTH * np.linalg.cholesky(covariance + 1e-10 * np.eye(v.shape[1]))
    kernel_count = MIN_KERNEL_COUNT if v.shape[1] <= 3 else KERNEL_COUNT
    # Systematic resampling without its random offset: equal steps of the cumulative weights.
    probabilities = (np.arange(kernel_count) + 0.5) / kernel_count
    indices = np.minimum(np.searchsorted(np.cumsum(weight), probabilities), weight.size - 1)
    split_weight = max(0.1, 1 - sample_weight) if mixture.dof > T_DOF else 0.1
    return mixture._replace(centres=v[indices], chol=chol, split_weight=split_weight)


def draw_by_importance(
    values: Values, fit: GaussianFit, seed: int, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"], float]:
    """Draw from a density by adaptive importance sampling, in coordinates whitened by a Gaussian fit.

    Returns draws (s, d), their normalised Pareto-smoothed weights (s,), and the log evidence.
    """
    dim, rng = len(fit.v), np.random.default_rng(seed)
    origin, unit_matrix = np.zeros(dim), np.eye(dim)
    root = np.linalg.cholesky(fit.covariance)
    mode = Mode(origin[:0], origin, unit_matrix, fit.log_density, 0.0, 0.0, origin[:0], False)

    def evaluate(u: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        return values(fit.v + u @ root.T)

    mixture = adapt_proposal(mode, evaluate, None, rng, count // 2, MAX_ROUNDS, math.inf)
    u, log_proposal = draw_proposals(mixture, None, rng, count)
    log_weight = evaluate(u) - log_proposal
    evidence = float(np.asarray(logsumexp(log_weight))) - math.log(count)
    evidence += float(np.linalg.slogdet(root)[1])
    return fit.v + u @ root.T, smooth(log_weight)[0], evidence
