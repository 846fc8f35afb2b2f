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
from bayescal._core.importance_weights import Corrections, effective_size, smoothed
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.gaussian import Drawn
from bayescal._inference.joint import FREEDOM, draw_normals, log_correction
from bayescal._inference.laplace import Mode, find_mode
from bayescal._inference.newton import NOWHERE, GaussianFit, Values
from bayescal._inference.problem import Problem
from bayescal._inference.trust import K_HAT
from bayescal._model.prior import Flat, FlatLine, HalfCauchy, HalfNormal

# Log density above the mode's that shows a higher mode; the error of polynomial columns is 0.02.
HIGHER_NATS = 1.0

USUAL_ROUNDS = 3  # rounds of adaptation; more only if the latest weights are unsound
MAX_CHEAP_ROUNDS = 4  # of `draw_by_importance`
KERNELS = 256  # mixture components, around resampled draws
MIN_KERNELS = 128  # in up to three dimensions
KERNEL = 0.7  # width of a component, in standard deviations of φ: the mixture has heavier tails than the target
# Limits of the target's width along an axis, to either side, over the Laplace approximation's.
AXIS_RATIOS = 0.25, 4.0
WIDE_RATIO = 1.7  # width of the defensive component over the Laplace approximation's
PRIOR = 0.2  # probability of proposals from the prior: no weight exceeds likelihood over 0.2 times evidence
# Probabilities of prior and defensive component if each proposal costs a pass over the readings.
COSTLY_PRIOR, COSTLY_WIDE = 0.05, 0.05
# Effective over actual sample size, from which adaptation ends.
ADAPTED = 0.5
MAX_NUMBERS = 1_000_000  # array elements per batch, to bound memory,
IN_CACHE = 150_000  # and to stay in the processor's cache
FIRST_DRAWS = 256  # draws of a nonlinear model whose corrections are computed first, in case they are constant
DISTANCE_BATCH = 512  # draws per batch of distances to all components
# Array elements of columns outside the region of fitted polynomials; of more, a random subset is computed.
FAR_NUMBERS = 40_000
NEGLIGIBLE = 40.0  # log weight below the largest, from which a draw is negligible
COSTLY_READINGS = 1000  # readings, from which a pass over them is expensive
PROPOSALS, FEWER_PROPOSALS, FEWEST_PROPOSALS = 8192, 4096, 2048  # by their cost
# At least, for a structure in a model average: if cheap; if each costs a pass over the readings.
MIN_PROPOSALS_PER_STRUCTURE = 128, 64
COSTLY_STEPS = 4  # batches of costly proposals; half of them at least
# Posterior probability of a structure, from which uneven weights justify another search for its mode.
LARGE_SHARE = 0.1


class WeightedDraws(NamedTuple):
    """Joint draws with log weights, neither normalised nor smoothed."""

    x: Float[np.ndarray, "s p"]
    v: Float[np.ndarray, "s d"]
    log_weight: Float[np.ndarray, "s"]
    log_weight_phi: Float[np.ndarray, "s"]  # of φ alone, before the correction
    log_evidence: Float[np.ndarray | np.float64, ""]
    log_evidence_error: Float[np.ndarray | np.float64, ""]
    mode: Mode  # around which the last round was proposed
    rounds: Rounds | None = None  # to be continued with further draws


class Mixture(NamedTuple):
    """Mixture of Student-t kernels of equal weight and shape, and one defensive component of weight `share`.

    The defensive component has a width for either side of each axis (split normal: G. Fechner 1897; multivariate:
    M. Villani and R. Larsson, Commun. Stat. 35 (2006) 1123).
    """

    centre: Float[np.ndarray, "m d"]  # of the kernels
    chol: Float[np.ndarray, "d d"]  # Cholesky factor of their scale matrix
    middle: Float[np.ndarray, "d"]  # of the defensive component
    axes: Float[np.ndarray, "d d"]  # of the defensive component, in columns
    share: float  # weight of the defensive component
    sides: tuple[Any, Any] = (1.0, 1.0)  # its relative widths below and above, along each axis
    freedom: float = FREEDOM

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        dim = self.centre.shape[1]
        # Multivariate Student-t: a normal vector times √(ν/χ²_ν), one factor for all its coordinates.
        scale = np.sqrt(self.freedom / random.chisquare(self.freedom, count))[:, None]
        normal = random.standard_normal((count, dim))
        component = random.integers(len(self.centre), size=count)
        from_wide = random.random(count) < self.share
        kernel_draws = self.centre[component] + scale * normal @ self.chol.T
        # Split normal: the probability of a side is proportional to its width.
        down, up = self.sides
        below = down * ndtri(np.minimum(ndtr(normal) * (down + up) / (2 * down), 0.5))
        above = -up * ndtri(np.minimum(ndtr(-normal) * (down + up) / (2 * up), 0.5))
        side_draws = self.middle + scale * (below + above) @ self.axes.T
        return np.where(from_wide[:, None], side_draws, kernel_draws)

    def log_density(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        dim = self.centre.shape[1]
        freedom, half = self.freedom, 0.5 * (self.freedom + dim)
        # Density: Γ((ν+d)/2)/(Γ(ν/2)·(νπ)^(d/2)·|L|)·(1 + |L⁻¹(v − c)|²/ν)^(−(ν+d)/2), summed over the centres c.
        norm = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * dim * math.log(freedom * math.pi)
        centres, counts = np.unique(self.centre, axis=0, return_counts=True)
        # |z − c|² = |z|² − 2·zᵀc + |c|², without cancellation relative to the middle; resampled centres repeat.
        z, c = (_whiten(self.chol, v - self.middle), _whiten(self.chol, centres - self.middle))
        c, offset = c.T * (-2 / freedom), 1 + np.sum(c**2, axis=1) / freedom
        kernel_sums = np.empty(len(v))
        for start in range(0, len(v), DISTANCE_BATCH):  # so many that they stay in the cache
            block = z[start : start + DISTANCE_BATCH]
            terms = block @ c
            terms += offset
            terms += np.sum(block**2, axis=1)[:, None] / freedom
            np.log(np.maximum(terms, 1.0, out=terms), out=terms)
            terms *= -half
            kernel_sums[start : start + DISTANCE_BATCH] = np.exp(terms, out=terms) @ counts
        # Far away the kernels underflow to zero: the defensive component dominates.
        log_kernels = np.log(kernel_sums / len(self.centre) + 1e-300) - _log_volume(self.chol)
        down, up = self.sides
        z = _whiten(self.axes, v - self.middle)
        log_beside = -half * np.log1p(
            np.sum((z / np.where(z < 0, down, up)) ** 2, axis=1) / freedom
        )
        log_beside -= _log_volume(self.axes) + np.sum(np.log(0.5 * (down + up) * np.ones(dim)))
        return norm + np.logaddexp(
            log_kernels + math.log1p(-self.share), log_beside + math.log(self.share)
        )


def _whiten(chol: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.linalg.solve(chol, v.T).T if chol.size else v


def _log_volume(axes: np.ndarray) -> float:
    return float(np.linalg.slogdet(axes)[1])


class BatchedDensity:
    """Marginal log density of many φ at once, and draws of x given each.

    `table`: Gram matrices by polynomials about the mode; None if each φ needs its own columns or a pass over the
    readings. `exact`: the noise is Gaussian, so that the marginal is exact for an affine output.
    """

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode, self.size = problem, mode, problem.record.size
        self.density = Density(problem, mode.x, mode.flat, mode.v)
        tabulated, self.table = self.density.tabulated, None
        if tabulated is not None and np.all(np.isfinite(mode.covariance)):
            self.table = tabulated.fit_polynomials(mode.v, mode.covariance, mode.flat)
        self.exact = problem.noise.gaussian
        self.batch_size = max(16, MAX_NUMBERS // (problem.size + 1) ** 2)
        if self.table is None:  # small batches, between which the deadline is checked
            self.batch_size = min(self.batch_size, max(16, IN_CACHE // self.size))
        self.highest, self.highest_v = float(mode.log_density), mode.v
        self.random = np.random.default_rng(0)
        self.far_share = min(1.0, FAR_NUMBERS / (PRIOR * PROPOSALS * self.size))

    def draw_at(self, v: Float[np.ndarray, "b d"], normal: np.ndarray) -> tuple[np.ndarray, Drawn]:
        """Return the log density of each φ (b,), and x drawn given φ by standard normal numbers (b, p)."""
        prior = self.problem.log_priors(v)
        args = self.mode.flat, self.density.origin
        drawn = self.problem.drawn((self.table or self.density).grams(v), v, *args, normal)
        is_computed = np.zeros(len(v), dtype=bool)
        if self.table is not None:
            # A random subset, reweighted: a distant mode is detected at bounded cost.
            is_outside = ~self.table.contains(v)
            is_computed = is_outside & (self.random.random(len(v)) < self.far_share)
            drawn.log_marginal[is_outside] = NOWHERE
            if is_computed.any():
                grams, normals = self.density.grams(v[is_computed]), normal[is_computed]
                exact = self.problem.drawn(grams, v[is_computed], *args, normals)
                for all_of_it, new in zip(drawn, exact, strict=True):
                    all_of_it[is_computed] = new
        total = drawn.log_marginal + prior
        is_finite = np.isfinite(total) & (drawn.log_marginal > NOWHERE)
        total = np.where(is_finite, total, NOWHERE)
        if len(v) and total[best := int(np.argmax(total))] > self.highest:
            self.highest, self.highest_v = float(total[best]), v[best]
        total[is_computed] -= math.log(self.far_share)
        return total, drawn

    def values(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        size, parts = self.problem.size, []
        for part in np.array_split(v, -(-len(v) // self.batch_size)):
            deadline.current().ask()
            parts.append(self.draw_at(part, np.zeros((len(part), size)))[0])
        return np.concatenate(parts)


class PriorShare(NamedTuple):
    """Proper prior of the coordinates, and the fraction of the proposals drawn from it."""

    draw: Callable[[np.random.Generator, int], Float[np.ndarray, "s d"]]
    log_density: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]]
    share: float = PRIOR


def adapt_proposal(
    mode: Mode,
    values: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]],
    prior: PriorShare | None,
    random: np.random.Generator,
    proposals: int,
    rounds: int,
    limit: float,
) -> Mixture:
    """Adapt a proposal to a density that is cheap to evaluate.

    Draws of all rounds are weighted by the mixture of all proposals, so that each round extends the explored region.
    Source: J.-M. Cornuet et al., Scand. J. Statist. 39 (2012) 798 (adaptive multiple importance sampling).

    Args:
        mode: of the density, with its Gaussian fit.
        values: the log density at several points, not normalised.
        prior: defensive proposal; None if the prior is improper.
        proposals: in each round.
        rounds: at most; fewer if the weights are even, or sound after the third round.
        higher: log density above which adaptation stops, since there is a higher mode.
    """
    # First the Laplace approximation, then kernels about the weighted draws of all rounds (population Monte Carlo:
    # O. Cappé et al., J. Comput. Graph. Stat. 13 (2004) 907).
    mixture, pool = propose_at_mode(mode.v, mode.covariance), Rounds(prior)
    for k in range(rounds if len(mode.v) else 0):
        v, log_proposal = propose(mixture, prior, random, proposals)
        log_density = values(v)
        log_weight = log_density - log_proposal
        if np.max(log_density) > limit or effective_size(softmax(log_weight)) > ADAPTED * len(v):
            break
        sample = _Sample(v, log_density, np.zeros((len(v), 0)), log_density)
        pool.add(mixture, v, log_proposal, sample)
        mixture = _update_mixture(mixture, mode, pool.all.v, pool.log_weight)
        if k + 1 >= USUAL_ROUNDS and smoothed(log_weight)[1] <= K_HAT:
            break
    return mixture


class Rounds:
    """Draws of all rounds, weighted by the mixture of their proposals.

    Each weight is the target over the mean density of all proposals (deterministic mixture: E. Veach and L. Guibas,
    SIGGRAPH 1995), which bounds the weights of draws that are improbable under their own proposal.
    """

    def __init__(self, prior: PriorShare | None) -> None:
        self.prior, self.corrections = prior, Corrections()
        self.mixtures = list[Mixture]()
        self.proposed = np.zeros((0, 0))  # each mixture's density of all draws
        self.counts, self.parts = list[int](), list[_Sample]()

    def add(
        self, mixture: Mixture, v: Float[np.ndarray, "s d"], log_proposal: np.ndarray, new: _Sample
    ) -> None:
        """Add a round's draws of a mixture with their log proposal density."""
        densities = (_log_proposal(m, self.prior, v) for m in self.mixtures)
        proposed = np.array([*densities, log_proposal])
        if self.mixtures:
            before = np.vstack([self.proposed, _log_proposal(mixture, self.prior, self.all.v)])
            proposed = np.concatenate([before, proposed], axis=1)
        self.mixtures.append(mixture)
        self.proposed = proposed
        self.counts.append(len(v))
        self.parts.append(new)

    @property
    def all(self) -> _Sample:
        if len(self.parts) > 1:
            self.parts = [_Sample(*map(np.concatenate, zip(*self.parts, strict=True)))]
        return self.parts[0]

    @property
    def log_weight(self) -> Float[np.ndarray, "s"]:
        share = np.log(self.counts) - math.log(sum(self.counts))
        return self.all.log_density - np.asarray(logsumexp(self.proposed + share[:, None], axis=0))

    def weigh_draws(self, mode: Mode) -> WeightedDraws:
        """Return all draws with their weights, and the evidence."""
        v, _, x, corrections = self.all
        log_weight_phi = self.log_weight
        is_counted = corrections > NOWHERE
        log_weight = np.where(
            is_counted, log_weight_phi + np.where(is_counted, corrections, 0.0), NOWHERE
        )
        # The mean of the unnormalised weights estimates the evidence, with the relative standard error of a mean.
        evidence = logsumexp(log_weight) - math.log(len(v))  # pyright: ignore[reportOperatorIssue]
        error = np.std(np.exp(log_weight - evidence)) / math.sqrt(len(v))
        evidence, error = np.float64(evidence), np.float64(error)
        return WeightedDraws(x, v, log_weight, log_weight_phi, evidence, error, mode, self)


class _Sample(NamedTuple):
    """Draws of φ, with x drawn for each of non-negligible weight."""

    v: Float[np.ndarray, "s d"]
    log_density: Float[np.ndarray, "s"]  # of φ, x integrated out
    x: Float[np.ndarray, "s p"]
    corrections: Float[np.ndarray, "s"]  # of the joint log weight; `NOWHERE` if negligible


@on_one_thread
def draw_weighted(
    problem: Problem,
    mode: Mode,
    seed: int,
    proposals: int | None,
    rounds: int,
    heavy: bool = False,
    earlier: WeightedDraws | None = None,
    probability: float = 1.0,
) -> WeightedDraws:
    """Adapt a proposal, then draw a weighted sample. Deterministic for a seed.

    Args:
        proposals: at least, half as many in each round of adaptation; by their cost if None. If each costs a pass over
            the readings, rounds of adaptation are included.
        rounds: of adaptation, at most.
        heavy: propose coefficients from a Student-t distribution; always if the noise is not Gaussian.
        earlier: draws to be extended.
        probability: of the structure in a model average, which scales the number of proposals.

    Raises:
        TimeIsUp: the deadline came first.
    """
    # Further draws need a different random sequence.
    random = np.random.default_rng(seed if earlier is None else [seed, len(earlier.v)])
    density, margin = BatchedDensity(problem, mode), HIGHER_NATS
    share = share_prior([h.prior for h in problem.hypers], problem.log_priors)
    if share is not None and density.table is None:
        share = share._replace(share=COSTLY_PRIOR)
    heavy = heavy or not problem.noise.gaussian
    earlier_rounds = None if earlier is None else earlier.rounds
    while True:
        min_count = MIN_PROPOSALS_PER_STRUCTURE[density.table is None]
        count = proposals or max(min_count, round(probability * count_proposals(density)))
        threshold = float(density.mode.log_density) + margin
        pool = Rounds(share) if earlier_rounds is None else earlier_rounds
        target = proposals or count // 2, probability * settings().effective_draws
        adapted = 0 if density.table is None and probability < LARGE_SHARE else rounds
        _fill_pool(pool, density, random, count, adapted, heavy, target, threshold)
        draws, start = None, density.highest_v
        if density.highest <= threshold:
            draws = pool.weigh_draws(density.mode)
            # For an improbable structure another search for the mode is not worth its cost.
            if probability < LARGE_SHARE or not smoothed(draws.log_weight)[1] > K_HAT:
                return draws
            start = draws.v[int(np.argmax(draws.log_weight_phi))]
        # A draw above the mode, or with a dominating weight, indicates another mode: search again from there.
        mode = find_mode(problem, [start], x=density.mode.x)
        if mode.log_density > threshold:
            density, earlier_rounds = BatchedDensity(problem, mode), None
        elif draws is not None:
            return draws
        else:  # an artefact of the linearisation about the old mode
            margin, earlier_rounds = math.inf, None


def _axis_mixture(density: BatchedDensity) -> Mixture:
    """Return a split-t proposal at the mode, with a width for either side of each principal axis.

    The widths match the density two Laplace standard deviations from the mode, where a Gaussian is two nats lower. The
    degrees of freedom grow with the dimension, so that radii of draws match those of the target.
    Source: H. Rue, S. Martino and N. Chopin, J. R. Stat. Soc. B 71 (2009) 319, §6.5 (axes explored for INLA).
    """
    mode, dim = density.mode, len(density.mode.v)
    weights, vectors = np.linalg.eigh(mode.covariance)
    axes = vectors * np.sqrt(weights)
    ends = mode.v + np.concatenate([-2 * axes.T, 2 * axes.T])
    lost = np.maximum(float(mode.log_density) - density.values(ends).reshape(2, dim), 1e-9)
    down, up = np.clip(np.sqrt(2 / lost), *AXIS_RATIOS)
    root = WIDE_RATIO * np.linalg.cholesky(mode.covariance)
    return Mixture(mode.v[None], root, mode.v, axes, 1 - COSTLY_WIDE, (down, up), FREEDOM + dim)


def _fill_pool(
    pool: Rounds,
    density: BatchedDensity,
    random: np.random.Generator,
    count: int,
    rounds: int,
    heavy: bool,
    targets: tuple[int, float],
    limit: float,
) -> None:
    """Add `count` draws to a pool; if costly, in batches until the weights are sound.

    `targets`: sufficient number of draws and effective sample size. Stops early if a draw is above `limit`.
    """
    mode, prior, is_first = density.mode, pool.prior, not pool.mixtures
    is_costly = density.table is None and len(mode.v) > 0
    if not is_first:
        mixture = _update_mixture(pool.mixtures[0], mode, pool.all.v, pool.log_weight)
    elif is_costly:
        mixture = _axis_mixture(density)
    else:
        args = density.values, prior, random, count // 2, rounds, limit
        mixture = adapt_proposal(mode, *args)
    steps = COSTLY_STEPS if is_costly else 1
    # Draws of adaptation rounds are kept.
    max_rounds = max(steps, 2 * rounds if is_costly and is_first else 0)
    for k in range(1, max_rounds + 1):
        if density.highest > limit:
            break
        v, log_proposal = propose(mixture, prior, random, -(-count // steps))
        sample = _draw_coefficients(density, pool.corrections, v, log_proposal, heavy, random)
        pool.add(mixture, v, log_proposal, sample)
        if k == max_rounds or len(pool.all.v) < targets[0]:
            continue
        weights, k_hat = smoothed(log_weight := pool.log_weight)
        if k_hat <= K_HAT and effective_size(weights) >= targets[1]:
            break
        if k >= steps:
            mixture = _update_mixture(pool.mixtures[0], mode, pool.all.v, log_weight)


def count_proposals(density: BatchedDensity) -> int:
    """Return the number of proposals: fewer if each costs a pass over many readings."""
    problem, is_costly = density.problem, density.table is None
    is_long = problem.record.size > COSTLY_READINGS
    if is_costly and (is_long or not problem.noise.gaussian):
        return FEWEST_PROPOSALS
    if is_costly or problem.size > 100:
        return FEWER_PROPOSALS
    return FEWER_PROPOSALS if is_long and not (density.exact and problem.affine) else PROPOSALS


def _draw_coefficients(
    density: BatchedDensity,
    seen_corrections: Corrections,
    v: Float[np.ndarray, "s d"],
    log_proposal: Float[np.ndarray, "s"],
    heavy: bool,
    random: np.random.Generator,
) -> _Sample:
    """Draw coefficients for each φ of non-negligible weight, and compute the corrections of the weights."""
    mode = density.mode
    count, size = len(v), density.problem.record.size
    x = np.array(np.broadcast_to(mode.x, (count, len(mode.x))))
    log_density, corrections, highest = np.empty(count), np.full(count, NOWHERE), NOWHERE
    batch_size = max(32, min(density.batch_size, IN_CACHE // size))
    is_nonlinear = density.exact and not density.problem.affine and not seen_corrections.alike
    first_count = FIRST_DRAWS if is_nonlinear and count > FIRST_DRAWS else 0
    parts = np.array_split(np.arange(first_count, count), -(-(count - first_count) // batch_size))
    for rows in ([np.arange(first_count)] if first_count else []) + parts:
        deadline.current().ask()
        normal = draw_normals(density.problem.size, len(rows), heavy, random)
        log_density[rows], drawn = density.draw_at(v[rows], normal)
        log_weight_phi = log_density[rows] - log_proposal[rows]
        highest = max(highest, float(np.max(log_weight_phi)))
        # Weights below e⁻⁴⁰ = 4·10⁻¹⁸ of the largest vanish in rounding: no x is needed.
        is_counted = (log_density[rows] > NOWHERE) & (log_weight_phi > highest - NEGLIGIBLE)
        if not is_counted.any():
            continue
        counted_rows, drawn, normal = rows[is_counted], drawn.select(is_counted), normal[is_counted]
        if density.exact and seen_corrections.alike:  # a constant correction
            log_ratio = np.full(len(counted_rows), seen_corrections.mean)
        else:
            hyper = density.problem.hyper(v[counted_rows].T)
            log_ratio = log_correction(density.problem, drawn, normal, hyper, density.exact, heavy)
            if density.exact:
                seen_corrections.add(log_weight_phi[is_counted], log_ratio)
        is_finite = np.isfinite(log_ratio)
        x[counted_rows[is_finite]] = drawn.x[is_finite]
        corrections[counted_rows[is_finite]] = log_ratio[is_finite]
    # The constant for the first draws too: their scatter would look like a heavy tail.
    if seen_corrections.alike and density.exact:
        corrections = np.where(corrections > NOWHERE, seen_corrections.mean, NOWHERE)
    return _Sample(v, log_density, x, corrections)


def propose(
    mixture: Mixture, prior: PriorShare | None, random: np.random.Generator, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"]]:
    """Draw coordinates of φ from the mixture and, if proper, the prior; return them with their log density."""
    v = mixture.draw(random, count)
    # Defensive mixture with the prior: weights are bounded by likelihood over its share (T. Hesterberg, Technometrics
    # 37 (1995) 185).
    if prior is not None:
        v = np.where(random.random((count, 1)) < prior.share, prior.draw(random, count), v)
    return v, _log_proposal(mixture, prior, v)


def _log_proposal(
    mixture: Mixture, prior: PriorShare | None, v: Float[np.ndarray, "s d"]
) -> Float[np.ndarray, "s"]:
    """Return the log density of the proposals of `propose` (s,)."""
    if prior is None:
        return mixture.log_density(v)
    near, share = mixture.log_density(v), prior.share
    return np.logaddexp(math.log1p(-share) + near, math.log(share) + prior.log_density(v))


def share_prior(priors: Sequence[Any], log_density: Values) -> PriorShare | None:
    """Return the prior as a defensive proposal; None if it is improper or there are no coordinates."""
    if not priors or any(isinstance(p, (Flat, FlatLine)) for p in priors):
        return None

    def draw(random: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        return np.stack([draw_prior(p, random, count) for p in priors], axis=1)

    return PriorShare(draw, log_density)


def draw_prior(prior, random: np.random.Generator, count: int) -> Float[np.ndarray, "s"]:
    """Draw coordinates from a proper prior."""
    if isinstance(prior, HalfCauchy):
        return np.log(np.abs(random.standard_cauchy(count)))
    normal = random.standard_normal(count)
    return np.log(np.abs(normal)) if isinstance(prior, HalfNormal) else normal


def propose_at_mode(v: Float[np.ndarray, "d"], covariance: Float[np.ndarray, "d d"]) -> Mixture:
    """Return the first proposal: Student-t kernels of the Laplace approximation, and of 1.7 times its width."""
    chol = np.linalg.cholesky(covariance) if len(v) else covariance
    return Mixture(v[None], chol, v, WIDE_RATIO * chol, 0.4)


def _update_mixture(mixture: Mixture, mode: Mode, v: np.ndarray, log_weight: np.ndarray) -> Mixture:
    """Return the next mixture: kernels around resampled draws, their covariance shrunk to the Laplace approximation.

    The defensive component stays; for costly proposals its weight is larger the fewer draws are effective.
    """
    weight = softmax(log_weight)
    weight = np.minimum(weight, 1 / math.sqrt(weight.size))  # truncation, Ionides 2008
    weight = weight / np.sum(weight)
    effective = effective_size(weight)
    # Shrinkage: at 20 effective draws per coordinate sample and Laplace covariance have equal weight.
    confidence = effective / (effective + 20.0 * v.shape[1])
    mean = weight @ v
    weighted_covariance = (weight[:, None] * (v - mean)).T @ (v - mean)
    covariance = confidence * weighted_covariance + (1 - confidence) * mode.covariance
    chol = KERNEL * np.linalg.cholesky(covariance + 1e-10 * np.eye(v.shape[1]))
    kernels = MIN_KERNELS if v.shape[1] <= 3 else KERNELS
    # Systematic resampling without its random offset: equal steps of the cumulative weights.
    quantiles = (np.arange(kernels) + 0.5) / kernels
    indices = np.minimum(np.searchsorted(np.cumsum(weight), quantiles), weight.size - 1)
    share = max(0.1, 1 - confidence) if mixture.freedom > FREEDOM else 0.1
    return mixture._replace(centre=v[indices], chol=chol, share=share)


def draw_by_importance(
    values: Values, fit: GaussianFit, seed: int, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"], float]:
    """Draw from a density by adaptive importance sampling; return draws (s, d), normalised smoothed weights, evidence.

    Proposals are adapted in coordinates whitened by the Gaussian fit; the evidence is logarithmic.
    """
    dim, random = len(fit.v), np.random.default_rng(seed)
    origin, identity = np.zeros(dim), np.eye(dim)
    root = np.linalg.cholesky(fit.covariance)
    mode = Mode(origin[:0], origin, identity, fit.log_density, 0.0, 0.0, origin[:0], False)

    def centred(u: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        return values(fit.v + u @ root.T)

    mixture = adapt_proposal(mode, centred, None, random, count // 2, MAX_CHEAP_ROUNDS, math.inf)
    u, log_proposal = propose(mixture, None, random, count)
    log_weight = centred(u) - log_proposal
    evidence = float(np.asarray(logsumexp(log_weight))) - math.log(count)
    evidence += float(np.linalg.slogdet(root)[1])
    return fit.v + u @ root.T, smoothed(log_weight)[0], evidence
