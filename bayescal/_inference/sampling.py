"""Adaptive importance sampling of φ on the host, with the coefficients drawn back.

φ is proposed from Student-t mixtures, first around its Laplace fit, then around many draws of the round before:
spreads that readings know only by their sum of squares have a density with arms, which one ellipse does not cover.
All proposals are evaluated at once, and the log evidence comes for free. What nonlinearity
leave is corrected by the same weights: each joint draw (x, φ) has as importance weight the true density over its own.
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
from bayescal._inference.joint import FREEDOM, correction, normal_numbers
from bayescal._inference.laplace import Mode, find_mode
from bayescal._inference.newton import NOWHERE, GaussianFit, Values
from bayescal._inference.problem import Problem
from bayescal._inference.trust import K_HAT
from bayescal._model.prior import Flat, FlatLine, HalfCauchy, HalfNormal

# Log density above the mode's, from which on a draw shows that it was not the highest: more than what columns as
# polynomials put it off by (0.02), less than would matter.
HIGHER_NATS = 1.0

USUAL_ROUNDS = 3  # rounds of adaptation; more only where the last one's weights are unsound
ROUNDS_OF_FEW = 4  # at most, of a density that costs little
KERNELS = 256  # draws of the round before, around each of which the next one proposes;
FEWEST_KERNELS = 128  # in a few dimensions
KERNEL = 0.7  # width of each, in standard deviations of φ: so wide that the mixture is heavier than what it follows
# Times the Laplace fit's, that the density is wide along an axis to either side, at least and at most.
AXIS_RATIOS = 0.25, 4.0
WIDE_RATIO = 1.7  # last component: wider than the Laplace fit, against tails that are heavier
PRIOR = 0.2  # share of proposals from the prior, so that no weight exceeds likelihood over 0.2 times evidence
# Where each costs a pass over the readings: the same, and the share of the wide component. Of φ with ten entries no
# draw of either counts.
COSTLY_PRIOR, COSTLY_WIDE = 0.05, 0.05
# Share of the proposals that their weights are worth where no further round would raise it.
ADAPTED = 0.5
NUMBERS = 1_000_000  # in what is computed at once, to bound memory,
IN_CACHE = 150_000  # and to stay in the cache
FIRST_DRAWS = 256  # draws of a nonlinear model whose corrections are looked at before those of the others are computed
DISTANCES_TOGETHER = 512  # draws whose distances to all kernels are taken at once
# Numbers in columns of draws beyond where polynomials were fitted, of which a random share is computed where more are.
FAR_NUMBERS = 40_000
NEGLIGIBLE = 40.0  # below the largest log weight, from which a draw counts nothing
COSTLY_READINGS = 1000  # readings, from which on a pass over them costs
PROPOSALS, FEWER_PROPOSALS, FEWEST_PROPOSALS = 8192, 4096, 2048  # by what each costs,
# And at least where a structure is part of an average, if each costs little; if each costs a pass.
MIN_PROPOSALS_PER_STRUCTURE = 128, 64
COSTLY_STEPS = 4  # in which costly proposals are drawn; half of them at least
# Share of an average from which on uneven weights of a structure are worth another climb.
LARGE_SHARE = 0.1


class WeightedDraws(NamedTuple):
    """Joint draws with their log weights (not normalised, not smoothed)."""

    x: Float[np.ndarray, "s p"]
    v: Float[np.ndarray, "s d"]
    log_weight: Float[np.ndarray, "s"]
    log_weight_phi: Float[np.ndarray, "s"]  # of φ alone, before the correction
    log_evidence: Float[np.ndarray | np.float64, ""]
    log_evidence_error: Float[np.ndarray | np.float64, ""]
    mode: Mode  # that they were proposed around, in the end
    rounds: Rounds | None = None  # what they were drawn in, where further ones may join them


class Mixture(NamedTuple):
    """Student-t components: equally likely ones of one shape, and one beside them with the rest of the probability.

    That one has, along each of its axes, a width for either side (split normal: G. Fechner 1897; in as many dimensions
    M. Villani and R. Larsson, Commun. Stat. 35 (2006) 1123).
    """

    centre: Float[np.ndarray, "m d"]
    chol: Float[np.ndarray, "d d"]
    middle: Float[np.ndarray, "d"]
    axes: Float[np.ndarray, "d d"]  # of the one beside, in columns
    share: float  # of the one beside
    sides: tuple[Any, Any] = (1.0, 1.0)  # widths down and up each axis, of the axes
    freedom: float = FREEDOM

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        dim = self.centre.shape[1]
        # Multivariate Student-t: a normal vector times √(ν/χ²_ν), one factor for all its coordinates.
        heavy = np.sqrt(self.freedom / random.chisquare(self.freedom, count))[:, None]
        normal = random.standard_normal((count, dim))
        which = random.integers(len(self.centre), size=count)
        from_wide = random.random(count) < self.share
        narrow = self.centre[which] + heavy * normal @ self.chol.T
        # A side is as likely as it is wide: by the quantiles of a normal number.
        down, up = self.sides
        below = down * ndtri(np.minimum(ndtr(normal) * (down + up) / (2 * down), 0.5))
        above = -up * ndtri(np.minimum(ndtr(-normal) * (down + up) / (2 * up), 0.5))
        side_draws = self.middle + heavy * (below + above) @ self.axes.T
        return np.where(from_wide[:, None], side_draws, narrow)

    def log_density(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        dim = self.centre.shape[1]
        freedom, half = self.freedom, 0.5 * (self.freedom + dim)
        # Its density: Γ((ν+d)/2)/(Γ(ν/2)·(νπ)^(d/2)·|L|)·(1 + |L⁻¹(v − c)|²/ν)^(−(ν+d)/2), summed over the centres c.
        norm = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * dim * math.log(freedom * math.pi)
        centres, counts = np.unique(self.centre, axis=0, return_counts=True)
        # |z − c|² = |z|² − 2·zᵀc + |c|²: distances to all centres are one product of matrices. Counted from the
        # middle these are numbers of order one, and no digits cancel. Resampled centres repeat.
        z, c = _whitened(self.chol, v - self.middle), _whitened(self.chol, centres - self.middle)
        c, offset = c.T * (-2 / freedom), 1 + np.sum(c**2, axis=1) / freedom
        near = np.empty(len(v))
        for start in range(0, len(v), DISTANCES_TOGETHER):  # so many that they stay in the cache
            block = z[start : start + DISTANCES_TOGETHER]
            heavy = block @ c
            heavy += offset
            heavy += np.sum(block**2, axis=1)[:, None] / freedom
            np.log(np.maximum(heavy, 1.0, out=heavy), out=heavy)
            heavy *= -half
            near[start : start + DISTANCES_TOGETHER] = np.exp(heavy, out=heavy) @ counts
        # Far away the sum may be zero: there the component beside counts.
        narrow = np.log(near / len(self.centre) + 1e-300) - _log_volume(self.chol)
        down, up = self.sides
        z = _whitened(self.axes, v - self.middle)
        log_beside = -half * np.log1p(
            np.sum((z / np.where(z < 0, down, up)) ** 2, axis=1) / freedom
        )
        log_beside -= _log_volume(self.axes) + np.sum(np.log(0.5 * (down + up) * np.ones(dim)))
        return norm + np.logaddexp(
            narrow + math.log1p(-self.share), log_beside + math.log(self.share)
        )


def _whitened(chol: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.linalg.solve(chol, v.T).T if chol.size else v


def _log_volume(axes: np.ndarray) -> float:
    return float(np.linalg.slogdet(axes)[1])


class BatchedDensity:
    """The log density of many φ at once, x integrated out, and x given each.

    Its `table` of products about the mode is None where each φ costs columns, or a pass over the readings; `exact`:
    whether the closed form is that of φ itself.
    """

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode, self.size = problem, mode, problem.record.size
        self.density = Density(problem, mode.x, mode.flat, mode.v)
        whole, self.table = self.density.tabulated, None
        if whole is not None and np.all(np.isfinite(mode.covariance)):
            self.table = whole.about(mode.v, mode.covariance, mode.flat)
        self.exact = problem.noise.gaussian
        self.together = max(16, NUMBERS // (problem.size + 1) ** 2)
        if self.table is None:  # few at a time, so that the deadline is asked
            self.together = min(self.together, max(16, IN_CACHE // self.size))
        self.highest, self.top = float(mode.log_density), mode.v
        self.random = np.random.default_rng(0)
        self.far_share = min(1.0, FAR_NUMBERS / (PRIOR * PROPOSALS * self.size))

    def at(self, v: Float[np.ndarray, "b d"], normal: np.ndarray) -> tuple[np.ndarray, Drawn]:
        """Return the log density of each φ, and the x that standard normal numbers stand for given it."""
        prior = self.problem.log_priors(v)
        args = self.mode.flat, self.density.origin
        drawn = self.problem.drawn((self.table or self.density).grams(v), v, *args, normal)
        computed = np.zeros(len(v), dtype=bool)
        if self.table is not None:
            # A random share of these stands for all: a hill far from the mode is seen, at a bounded cost.
            beyond = ~self.table.reaches(v)
            computed = beyond & (self.random.random(len(v)) < self.far_share)
            drawn.log_marginal[beyond] = NOWHERE
            if computed.any():
                grams, some = self.density.grams(v[computed]), normal[computed]
                exact = self.problem.drawn(grams, v[computed], *args, some)
                for all_of_it, new in zip(drawn, exact, strict=True):
                    all_of_it[computed] = new
        total = drawn.log_marginal + prior
        is_finite = np.isfinite(total) & (drawn.log_marginal > NOWHERE)
        total = np.where(is_finite, total, NOWHERE)
        if len(v) and total[best := int(np.argmax(total))] > self.highest:
            self.highest, self.top = float(total[best]), v[best]
        total[computed] -= math.log(self.far_share)
        return total, drawn

    def values(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        size, parts = self.problem.size, []
        for part in np.array_split(v, -(-len(v) // self.together)):
            deadline.current().ask()
            parts.append(self.at(part, np.zeros((len(part), size)))[0])
        return np.concatenate(parts)


class PriorShare(NamedTuple):
    """Proper prior of the coordinates, and the share of the proposals that is drawn from it."""

    draw: Callable[[np.random.Generator, int], Float[np.ndarray, "s d"]]
    log_density: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]]
    share: float = PRIOR


def adapted(
    mode: Mode,
    values: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]],
    prior: PriorShare | None,
    random: np.random.Generator,
    proposals: int,
    rounds: int,
    higher: float,
) -> Mixture:
    """Adapt a proposal to a density that costs little.

    Draws of a round are weighed with those of the rounds before, each by what all rounds together propose there:
    of a density that bends away from its Laplace fit every round sees a further part.
    Source: J.-M. Cornuet et al., Scand. J. Statist. 39 (2012) 798 (adaptive multiple importance sampling).

    Args:
        mode, values: of the density, and its logarithm at several points, not normalised.
        prior: None where it is improper or cannot be drawn from.
        proposals: in each round.
        rounds: at most; none follows one whose weights are even, nor a later one whose weights are sound.
        higher: log density above which nothing more is adapted: the mode was another.
    """
    # The Laplace fit proposes first; then, as often as weights are uneven, kernels about the weighted draws of all
    # rounds before (population Monte Carlo: O. Cappé et al., J. Comput. Graph. Stat. 13 (2004) 907).
    mixture, tried = around_mode(mode.v, mode.covariance), Rounds(prior)
    for k in range(rounds if len(mode.v) else 0):
        v, log_proposal = propose(mixture, prior, random, proposals)
        log_density = values(v)
        log_weight = log_density - log_proposal
        if np.max(log_density) > higher or effective_size(softmax(log_weight)) > ADAPTED * len(v):
            break
        new = _Placed(v, log_density, np.zeros((len(v), 0)), log_density)
        tried.add(mixture, v, log_proposal, new)
        mixture = _match(mixture, mode, tried.all.v, tried.log_weight)
        if k + 1 >= USUAL_ROUNDS and smoothed(log_weight)[1] <= K_HAT:
            break
    return mixture


class Rounds:
    """Draws of all rounds, each weighed by the mixture of what was drawn from.

    Each draw is weighed by the mean density of all mixtures, whichever it came from (deterministic mixture: E. Veach
    and L. Guibas, SIGGRAPH 1995): a draw that its own mixture hardly proposes cannot count for thousands.
    """

    def __init__(self, prior: PriorShare | None) -> None:
        self.prior, self.judged = prior, Corrections()
        self.mixtures = list[Mixture]()
        self.proposed = np.zeros((0, 0))  # each mixture's density of all draws
        self.counts, self.parts = list[int](), list[_Placed]()

    def add(
        self, mixture: Mixture, v: Float[np.ndarray, "s d"], log_proposal: np.ndarray, new: _Placed
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
    def all(self) -> _Placed:
        if len(self.parts) > 1:
            self.parts = [_Placed(*map(np.concatenate, zip(*self.parts, strict=True)))]
        return self.parts[0]

    @property
    def log_weight(self) -> Float[np.ndarray, "s"]:
        share = np.log(self.counts) - math.log(sum(self.counts))
        return self.all.log_density - np.asarray(logsumexp(self.proposed + share[:, None], axis=0))

    def drawn(self, mode: Mode) -> WeightedDraws:
        """Return all draws, weighed."""
        v, _, x, corrections = self.all
        log_weight_phi = self.log_weight
        counting = corrections > NOWHERE
        log_weight = np.where(
            counting, log_weight_phi + np.where(counting, corrections, 0.0), NOWHERE
        )
        # The mean of the unnormalised weights is the evidence; its relative error is that of a mean of so many.
        evidence = logsumexp(log_weight) - math.log(len(v))  # pyright: ignore[reportOperatorIssue]
        error = np.std(np.exp(log_weight - evidence)) / math.sqrt(len(v))
        evidence, error = np.float64(evidence), np.float64(error)
        return WeightedDraws(x, v, log_weight, log_weight_phi, evidence, error, mode, self)


class _Placed(NamedTuple):
    """Draws of φ with coefficients drawn for each that counts."""

    v: Float[np.ndarray, "s d"]
    log_density: Float[np.ndarray, "s"]  # of φ, x integrated out
    x: Float[np.ndarray, "s p"]
    corrections: Float[np.ndarray, "s"]  # of the joint log weight; `NOWHERE` where none counts


@on_one_thread
def weighted_draws(
    problem: Problem,
    mode: Mode,
    seed: int,
    proposals: int | None,
    rounds: int,
    heavy: bool = False,
    earlier: WeightedDraws | None = None,
    part: float = 1.0,
) -> WeightedDraws:
    """Adapt a proposal, then sample. The same numbers for the same seed.

    Args:
        proposals: at least, half as many in each round of adaptation; by their cost if not given. Where each costs a
            pass over the readings, rounds of adaptation count among them.
        rounds: of adaptation at most.
        heavy: whether coefficients are proposed with the tails of Student-t; always where the noise is not Gaussian.
        earlier: draws that were too few: those made now join them.
        part: of an average that the structure is: its proposals are that part of what they would be, so that the
            average has as many as one structure alone.

    Raises:
        TimeIsUp: the deadline came first.
    """
    # Further draws have random numbers of their own: the same ones again would tell nothing.
    random = np.random.default_rng(seed if earlier is None else [seed, len(earlier.v)])
    density, above = BatchedDensity(problem, mode), HIGHER_NATS
    share = prior_share([h.prior for h in problem.hypers], problem.log_priors)
    if share is not None and density.table is None:
        share = share._replace(share=COSTLY_PRIOR)
    heavy = heavy or not problem.noise.gaussian
    earlier_rounds = None if earlier is None else earlier.rounds
    while True:
        least = MIN_PROPOSALS_PER_STRUCTURE[density.table is None]
        count = proposals or max(least, round(part * proposals_of(density)))
        higher = float(density.mode.log_density) + above
        pool = Rounds(share) if earlier_rounds is None else earlier_rounds
        enough = proposals or count // 2, part * settings().effective_draws
        _fill(pool, density, random, count, rounds, heavy, enough, higher)
        draws, start = None, density.top
        if density.highest <= higher:
            draws = pool.drawn(density.mode)
            # A climb costs what all draws of a small part cost.
            if part < LARGE_SHARE or not smoothed(draws.log_weight)[1] > K_HAT:
                return draws
            start = draws.v[int(np.argmax(draws.log_weight_phi))]
        # No draw of a posterior lies above its mode, and one that counts for many more is on a hill that is not
        # proposed: the climb may have ended on a lower one, and begins anew there.
        mode = find_mode(problem, [start], x=density.mode.x)
        if mode.log_density > higher:
            density, earlier_rounds = BatchedDensity(problem, mode), None
        elif draws is not None:
            return draws
        else:  # higher in the linear form about the old mode alone
            above, earlier_rounds = math.inf, None


def _axis_mixture(density: BatchedDensity) -> Mixture:
    """Return the Gaussian fit at the mode, each half of each principal axis as wide as the density falls along it.

    A curvature tells of the top alone. Two standard deviations away a Gaussian has lost two nats; where the density has
    lost less or more, that side is as much longer or shorter. In many dimensions draws of few degrees of freedom would
    mostly lie off the shell that the density has: there are as many more as dimensions.
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


def _fill(
    pool: Rounds,
    density: BatchedDensity,
    random: np.random.Generator,
    count: int,
    rounds: int,
    heavy: bool,
    enough: tuple[int, float],
    higher: float,
) -> None:
    """Add so many draws to a pool; more, as long as they are unsound, where none is thrown away.

    Where each costs a pass over the readings, `enough` in the pool will do: so many, and so many effective. Ends early
    where a draw lies higher than the mode may.
    """
    mode, prior, first = density.mode, pool.prior, not pool.mixtures
    direct = density.table is None and len(mode.v) > 0
    if not first:
        mixture = _match(pool.mixtures[0], mode, pool.all.v, pool.log_weight)
    elif direct:
        mixture = _axis_mixture(density)
    else:
        args = density.values, prior, random, count // 2, rounds, higher
        mixture = adapted(mode, *args)
    steps = COSTLY_STEPS if direct else 1
    # What is drawn while adapting counts too.
    most = max(steps, 2 * rounds if direct and first else 0)
    for k in range(1, most + 1):
        if density.highest > higher:
            break
        v, log_proposal = propose(mixture, prior, random, -(-count // steps))
        new = _placed(density, pool.judged, v, log_proposal, heavy, random)
        pool.add(mixture, v, log_proposal, new)
        if k == most or len(pool.all.v) < enough[0]:
            continue
        weights, k_hat = smoothed(log_weight := pool.log_weight)
        if k_hat <= K_HAT and effective_size(weights) >= enough[1]:
            break
        if k >= steps:
            mixture = _match(pool.mixtures[0], mode, pool.all.v, log_weight)


def proposals_of(density: BatchedDensity) -> int:
    """Return the number of proposals: fewer where each costs a pass over many readings."""
    # A pass over many readings for each φ buys fewer proposals in the same time.
    problem, direct = density.problem, density.table is None
    long = problem.record.size > COSTLY_READINGS
    if direct and (long or not problem.noise.gaussian):
        return FEWEST_PROPOSALS
    if direct or problem.size > 100:
        return FEWER_PROPOSALS
    return FEWER_PROPOSALS if long and not (density.exact and problem.affine) else PROPOSALS


def _placed(
    density: BatchedDensity,
    judged: Corrections,
    v: Float[np.ndarray, "s d"],
    log_proposal: Float[np.ndarray, "s"],
    heavy: bool,
    random: np.random.Generator,
) -> _Placed:
    """Draw coefficients for each φ that counts, and correct their weights."""
    mode = density.mode
    count, size = len(v), density.problem.record.size
    x = np.array(np.broadcast_to(mode.x, (count, len(mode.x))))
    log_density, corrections, highest = np.empty(count), np.full(count, NOWHERE), NOWHERE
    together = max(32, min(density.together, IN_CACHE // size))
    bends = density.exact and not density.problem.affine and not judged.alike
    first = FIRST_DRAWS if bends and count > FIRST_DRAWS else 0
    parts = np.array_split(np.arange(first, count), -(-(count - first) // together))
    for stretch in ([np.arange(first)] if first else []) + parts:
        deadline.current().ask()
        normal = normal_numbers(density.problem.size, len(stretch), heavy, random)
        log_density[stretch], drawn = density.at(v[stretch], normal)
        of_phi = log_density[stretch] - log_proposal[stretch]
        highest = max(highest, float(np.max(of_phi)))
        # e⁻⁴⁰ = 4·10⁻¹⁸ of the largest weight is lost in the rounding of their sum: such a φ needs no x.
        counting = (log_density[stretch] > NOWHERE) & (of_phi > highest - NEGLIGIBLE)
        if not counting.any():
            continue
        pick, drawn, normal = stretch[counting], drawn.of(counting), normal[counting]
        if density.exact and judged.alike:  # known, and the same for all
            corrected = np.full(len(pick), judged.mean)
        else:
            hyper = density.problem.hyper(v[pick].T)
            corrected = correction(density.problem, drawn, normal, hyper, density.exact, heavy)
            if density.exact:
                judged.add(of_phi[counting], corrected)
        some = np.isfinite(corrected)
        x[pick[some]] = drawn.x[some]
        corrections[pick[some]] = corrected[some]
    # Of those that were looked at too: their scatter would pass for a tail.
    if judged.alike and density.exact:
        corrections = np.where(corrections > NOWHERE, judged.mean, NOWHERE)
    return _Placed(v, log_density, x, corrections)


def propose(
    mixture: Mixture, prior: PriorShare | None, random: np.random.Generator, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"]]:
    """Draw coordinates of φ with their log density: near the mode and, where proper, from the prior."""
    v = mixture.draw(random, count)
    # A defensive share of the prior: no weight exceeds the likelihood over that share, however narrow the rest has
    # become (T. Hesterberg, Technometrics 37 (1995) 185).
    if prior is not None:
        v = np.where(random.random((count, 1)) < prior.share, prior.draw(random, count), v)
    return v, _log_proposal(mixture, prior, v)


def _log_proposal(
    mixture: Mixture, prior: PriorShare | None, v: Float[np.ndarray, "s d"]
) -> Float[np.ndarray, "s"]:
    """Return the log density of what `propose` draws."""
    if prior is None:
        return mixture.log_density(v)
    near, share = mixture.log_density(v), prior.share
    return np.logaddexp(math.log1p(-share) + near, math.log(share) + prior.log_density(v))


def prior_share(priors: Sequence[Any], log_density: Values) -> PriorShare | None:
    """Return the prior of coordinates to propose from; None where it is improper, or of none."""
    if not priors or any(isinstance(p, (Flat, FlatLine)) for p in priors):
        return None

    def draw(random: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        return np.stack([_prior_draws(p, random, count) for p in priors], axis=1)

    return PriorShare(draw, log_density)


def _prior_draws(prior, random: np.random.Generator, count: int) -> Float[np.ndarray, "s"]:
    """Draw coordinates from a proper prior."""
    if isinstance(prior, HalfCauchy):
        return np.log(np.abs(random.standard_cauchy(count)))
    normal = random.standard_normal(count)
    return np.log(np.abs(normal)) if isinstance(prior, HalfNormal) else normal


def around_mode(v: Float[np.ndarray, "d"], covariance: Float[np.ndarray, "d d"]) -> Mixture:
    """Return the first proposal: about a mode, as wide as its Gaussian fit and wider."""
    chol = np.linalg.cholesky(covariance) if len(v) else covariance
    return Mixture(v[None], chol, v, WIDE_RATIO * chol, 0.4)


def _match(before: Mixture, mode: Mode, v: np.ndarray, log_weight: np.ndarray) -> Mixture:
    """Return the next mixture: around the weighted draws, as wide as the Laplace fit if few count.

    Beside costly ones the first mixture stays, with a share that is as large as few of them count.
    """
    weight = softmax(log_weight)
    weight = np.minimum(weight, 1 / math.sqrt(weight.size))  # truncation, Ionides 2008
    weight = weight / np.sum(weight)
    effective = effective_size(weight)
    # Few draws know a covariance badly: at 20 effective ones a coordinate it counts as much as the Laplace fit's.
    trust = effective / (effective + 20.0 * v.shape[1])
    mean = weight @ v
    spread = (weight[:, None] * (v - mean)).T @ (v - mean)
    covariance = trust * spread + (1 - trust) * mode.covariance
    chol = KERNEL * np.linalg.cholesky(covariance + 1e-10 * np.eye(v.shape[1]))
    kernels = FEWEST_KERNELS if v.shape[1] <= 3 else KERNELS
    # Systematic resampling without its random number: the centres stand at equal steps of the cumulated weights.
    ladder = (np.arange(kernels) + 0.5) / kernels
    pick = np.minimum(np.searchsorted(np.cumsum(weight), ladder), weight.size - 1)
    share = max(0.1, 1 - trust) if before.freedom > FREEDOM else 0.1
    return before._replace(centre=v[pick], chol=chol, share=share)


def importance_draws(
    values: Values, fit: GaussianFit, seed: int, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"], float]:
    """Return draws (s, d), their smoothed weights, summing to one, and the log evidence.

    Proposals are adapted in the coordinates of the Gaussian fit.
    """
    dim, random = len(fit.v), np.random.default_rng(seed)
    origin, identity = np.zeros(dim), np.eye(dim)
    root = np.linalg.cholesky(fit.covariance)
    mode = Mode(origin[:0], origin, identity, fit.log_density, 0.0, 0.0, origin[:0], False)

    def centred(u: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        return values(fit.v + u @ root.T)

    mixture = adapted(mode, centred, None, random, count // 2, ROUNDS_OF_FEW, math.inf)
    u, log_proposal = propose(mixture, None, random, count)
    log_weight = centred(u) - log_proposal
    evidence = float(np.asarray(logsumexp(log_weight))) - math.log(count)
    evidence += float(np.linalg.slogdet(root)[1])
    return fit.v + u @ root.T, smoothed(log_weight)[0], evidence
