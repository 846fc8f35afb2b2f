"""Adaptive importance sampling of φ on the host, with the coefficients drawn back.

φ is proposed from Student-t mixtures, first around its Laplace fit, then around many draws of the round before:
spreads that readings know only by their sum of squares have a density with arms, which one ellipse does not cover.
All proposals are evaluated at once, and the log evidence comes for free. What nonlinearity and interpolated products
leave is corrected by the same weights: each joint draw (x, φ) carries the true density over what it was drawn from.
Source: A. Owen and Y. Zhou, JASA 95 (2000) 135 (defensive mixtures); M. West, J. R. Stat. Soc. B 55 (1993) 409
(mixtures around weighted draws).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln, logsumexp, softmax

from bayescal._core.importance_weights import Corrections, effective_size
from bayescal._core.parallel import on_one_thread
from bayescal._engine.assembly import Assembly
from bayescal._engine.closed_form import NOWHERE
from bayescal._engine.joint import FREEDOM, Conditionals, conditionals, draw_joint
from bayescal._engine.mode import Mode
from bayescal._engine.products import LONG, Products
from bayescal._model.prior import Flat, FlatLine, HalfCauchy, HalfNormal

KERNELS = 256  # draws of the round before, around each of which the next one proposes;
FEW = 128  # in a few dimensions
KERNEL = 0.7  # width of each, in standard deviations of φ: so wide that the mixture is heavier than what it follows
WIDE = 1.7  # last component: wider than the Laplace fit, against tails that are heavier
PRIOR = 0.2  # share of proposals from the prior, so that no weight exceeds likelihood over 0.2 times evidence
ADAPTED = (
    0.5  # of the proposals, that their weights are worth where no further round would raise it
)
NUMBERS = 1_000_000  # in what is computed at once, to bound memory,
IN_CACHE = 150_000  # and to stay in the cache
TOGETHER = 512  # draws whose distances to all kernels are taken at once
NEGLIGIBLE = 40.0  # below the largest log weight, from which a draw counts nothing
FAR = 10.0  # below the largest log density, from which products need not be exact where polynomials end
PROPOSALS, FEWER, FEWEST = 8192, 4096, 2048  # by what each costs


class WeightedDraws(NamedTuple):
    """Joint draws with their log weights (not normalised, not smoothed)."""

    x: Float[np.ndarray, "s p"]
    rows: Float[np.ndarray, "s n k"]
    v: Float[np.ndarray, "s d"]
    log_weight: Float[np.ndarray, "s"]
    log_weight_phi: Float[np.ndarray, "s"]  # of φ alone, before the correction
    log_evidence: Float[np.ndarray | np.float64, ""]
    log_evidence_error: Float[np.ndarray | np.float64, ""]


class _Mixture(NamedTuple):
    """Student-t components: equally likely ones of one shape, and a wide one with the rest of the probability."""

    centre: Float[np.ndarray, "m d"]
    chol: Float[np.ndarray, "d d"]
    middle: Float[np.ndarray, "d"]
    wide: Float[np.ndarray, "d d"]
    share: float  # of the wide one

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "s d"]:
        dim = self.centre.shape[1]
        heavy = np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))
        normal = random.standard_normal((count, dim)) * heavy[:, None]
        which = random.integers(len(self.centre), size=count)
        apart = random.random(count) < self.share
        narrow = self.centre[which] + normal @ self.chol.T
        return np.where(apart[:, None], self.middle + normal @ self.wide.T, narrow)

    def log_density(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        dim = self.centre.shape[1]
        half = 0.5 * (FREEDOM + dim)
        norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * math.log(FREEDOM * math.pi)
        centres, counts = np.unique(self.centre, axis=0, return_counts=True)
        z, c = _whitened(self.chol, v - self.middle), _whitened(self.chol, centres - self.middle)
        c, beside = c.T * (-2 / FREEDOM), 1 + np.sum(c**2, axis=1) / FREEDOM
        near = np.empty(len(v))
        for start in range(0, len(v), TOGETHER):  # so many that they stay in the cache
            one = z[start : start + TOGETHER]
            heavy = one @ c
            heavy += beside
            heavy += np.sum(one**2, axis=1)[:, None] / FREEDOM
            np.log(np.maximum(heavy, 1.0, out=heavy), out=heavy)
            heavy *= -half
            near[start : start + TOGETHER] = np.exp(heavy, out=heavy) @ counts
        # Far away the sum may be zero: there the wide component counts.
        narrow = np.log(near / len(self.centre) + 1e-300) - _log_volume(self.chol)
        apart = np.sum(_whitened(self.wide, v - self.middle) ** 2, axis=1)
        wide = -half * np.log1p(apart / FREEDOM) - _log_volume(self.wide)
        return norm + np.logaddexp(narrow + math.log1p(-self.share), wide + math.log(self.share))


def _whitened(chol: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.linalg.solve(chol, v.T).T if chol.size else v


def _log_volume(chol: np.ndarray) -> float:
    return float(np.sum(np.log(np.diag(chol))))


class _Density:
    """The log density of many φ at once, x integrated out, and x given each."""

    def __init__(
        self, assembly: Assembly, products: Products, flat: Float[np.ndarray, "p"]
    ) -> None:
        self.assembly, self.products, self.flat = assembly, products, flat
        self.together = max(16, NUMBERS // (assembly.size + 1) ** 2)
        self.highest = float(products.mode.log_density)

    def at(self, v: Float[np.ndarray, "b d"]) -> tuple[np.ndarray, Conditionals]:
        assembly, products = self.assembly, self.products
        hyper = assembly.hyper(v.T)
        sd = assembly.sizes.at_several(assembly.hyper(v.T), len(v), self.flat)
        args = assembly.record.size, sd, assembly, products.mode.point.x
        found = conditionals(products.at(hyper, v), *args)
        prior = assembly.log_priors(v)
        total = _sum(found.log_marginal, prior)
        # Where polynomials end or have lost their definiteness, φ that may count are computed.
        outside = products.outside(hyper, v) & (total > self.highest - FAR)
        anew = outside | ((total <= NOWHERE) & (not products.exact))
        if np.any(anew):
            (pick,) = np.nonzero(anew)
            exact = conditionals(products.directly(v[pick]), args[0], sd[pick], *args[2:])
            found.log_marginal[pick], found.chol[pick] = exact.log_marginal, exact.chol
            found.u[pick] = exact.u
            total = _sum(found.log_marginal, prior)
        self.highest = max(self.highest, float(np.max(total)))
        return total, found

    def stretches(self, v: Float[np.ndarray, "s d"]) -> list[np.ndarray]:
        return np.array_split(v, -(-len(v) // self.together))

    def values(self, v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        return np.concatenate([self.at(part)[0] for part in self.stretches(v)])


def _sum(log_marginal: np.ndarray, prior: np.ndarray) -> np.ndarray:
    total = log_marginal + prior
    return np.where(np.isfinite(total) & (log_marginal > NOWHERE), total, NOWHERE)


@on_one_thread
def weighted_draws(
    assembly: Assembly, mode: Mode, seed: int, proposals: int | None, rounds: int
) -> WeightedDraws:
    """Adapt, then sample. The same numbers for the same seed.

    Args:
        assembly: the structure on its record.
        mode: its mode.
        seed: of every random number.
        proposals: of the final round, half as many in each round of adaptation; by their cost if not given.
        rounds: of adaptation at most.
    """
    random = np.random.default_rng(seed)
    products = Products(assembly, mode)
    if proposals is None:
        proposals = proposals_of(assembly, products)
    density = _Density(assembly, products, mode.flat)
    mixture = _around_mode(mode)
    for _ in range(rounds if len(mode.v) else 0):
        v, log_proposal = _propose(assembly, mixture, random, proposals // 2)
        log_weight = density.values(v) - log_proposal
        if effective_size(softmax(log_weight)) > ADAPTED * len(v):
            break
        mixture = _match(mode, v, log_weight)
    v, log_proposal = _propose(assembly, mixture, random, proposals)
    return _placed(density, v, log_proposal, random)


def proposals_of(assembly: Assembly, products: Products) -> int:
    """How many: fewer where each costs a pass over many readings, or a large matrix."""
    cost = assembly.record.size > LONG
    if products.direct and (cost or not assembly.noise.gaussian):
        return FEWEST
    if products.direct or assembly.size > 100:
        return FEWER
    return FEWER if cost and not (products.once and assembly.affine) else PROPOSALS


def _placed(density: _Density, v, log_proposal, random: np.random.Generator) -> WeightedDraws:
    """Coefficients drawn for each φ that counts, and the weights of both."""
    mode = density.products.mode
    count, (size, width) = len(v), mode.point.rows.shape
    x = np.tile(mode.point.x, (count, 1))
    rows = np.broadcast_to(mode.point.rows, (count, size, width))
    rows = np.array(rows) if width else rows
    log_weight_phi, log_weight = np.empty(count), np.full(count, NOWHERE)
    judged, highest = Corrections(), NOWHERE
    together = max(32, min(density.together, IN_CACHE // size))
    for stretch in np.array_split(np.arange(count), -(-count // together)):
        log_phi, found = density.at(v[stretch])
        log_weight_phi[stretch] = of_phi = log_phi - log_proposal[stretch]
        highest = max(highest, float(np.max(of_phi)))
        counting = (log_phi > NOWHERE) & (of_phi > highest - NEGLIGIBLE)
        if not counting.any():
            continue
        pick, found = stretch[counting], found.of(counting)
        of_phi = log_weight_phi[pick]
        drawn, own, correction = _drawn(density, v[pick], found, of_phi, judged, random)
        some = np.isfinite(correction)
        x[pick[some]] = drawn[some]
        if width:
            rows[pick[some]] = own[some]
        log_weight[pick[some]] = (of_phi + correction)[some]
    evidence = logsumexp(log_weight) - math.log(count)  # pyright: ignore[reportOperatorIssue]
    error = np.std(np.exp(log_weight - evidence)) / math.sqrt(count)
    return WeightedDraws(
        x, rows, v, log_weight, log_weight_phi, np.float64(evidence), np.float64(error)
    )


def _drawn(density: _Density, v, found: Conditionals, of_phi, judged: Corrections, random):
    """x, per-reading coefficients and corrections of draws, as `draw_joint`; the same correction where it is known.

    Where polynomials end it is not: there each draw has its own.
    """
    assembly, products = density.assembly, density.products
    hyper, exact = assembly.hyper(v.T), products.exact
    inside = ~products.outside(hyper, v) if assembly.record.size > LONG else np.zeros(len(v), bool)
    if exact or len(assembly.row_sd) or not judged.alike:
        made = draw_joint(assembly, products.mode, found, hyper, exact, random)
        judged.add(of_phi[inside], made[2][inside])
        return made
    x = found.place(random.standard_normal(found.u.shape))
    rows, correction = np.empty((len(v), assembly.record.size, 0)), np.full(len(v), judged.mean)
    if not inside.all():
        out = ~inside
        hyper = assembly.hyper(v[out].T)
        made = draw_joint(assembly, products.mode, found.of(out), hyper, exact, random)
        x[out], rows[out], correction[out] = made
    return x, rows, correction


def _propose(
    assembly: Assembly, mixture: _Mixture, random: np.random.Generator, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"]]:
    """Coordinates of φ with the log density that they are drawn from: near the mode and, where proper, the prior."""
    near, priors = mixture.draw(random, count), [h.prior for h in assembly.hypers]
    if not priors or any(isinstance(p, (Flat, FlatLine)) for p in priors):
        return near, mixture.log_density(near)
    far = np.stack([_prior_draws(p, random, count) for p in priors], axis=1)
    v = np.where(random.random((count, 1)) < PRIOR, far, near)
    parts = math.log1p(-PRIOR) + mixture.log_density(v), math.log(PRIOR) + assembly.log_priors(v)
    return v, np.logaddexp(*parts)


def _prior_draws(prior, random: np.random.Generator, count: int) -> Float[np.ndarray, "s"]:
    """Coordinates drawn from a proper prior."""
    if isinstance(prior, HalfCauchy):
        return np.log(np.abs(random.standard_cauchy(count)))
    normal = random.standard_normal(count)
    return np.log(np.abs(normal)) if isinstance(prior, HalfNormal) else normal


def _around_mode(mode: Mode) -> _Mixture:
    chol = np.linalg.cholesky(mode.covariance) if len(mode.v) else mode.covariance
    return _Mixture(mode.v[None], chol, mode.v, WIDE * chol, 0.4)


def _match(mode: Mode, v: np.ndarray, log_weight: np.ndarray) -> _Mixture:
    """The next mixture: around the weighted draws, as wide as the Laplace fit where few of them count."""
    weight = softmax(log_weight)
    weight = np.minimum(weight, 1 / math.sqrt(weight.size))  # truncation, Ionides 2008
    weight = weight / np.sum(weight)
    effective = 1 / np.sum(weight**2)
    trust = effective / (effective + 20.0 * v.shape[1])
    mean = weight @ v
    spread = (weight[:, None] * (v - mean)).T @ (v - mean)
    covariance = trust * spread + (1 - trust) * mode.covariance
    chol = np.linalg.cholesky(covariance + 1e-10 * np.eye(v.shape[1]))
    kernels = FEW if v.shape[1] <= 3 else KERNELS
    ladder = (np.arange(kernels) + 0.5) / kernels
    pick = np.minimum(np.searchsorted(np.cumsum(weight), ladder), weight.size - 1)
    wide = WIDE * np.linalg.cholesky(mode.covariance)
    return _Mixture(v[pick], KERNEL * chol, mode.v, wide, 0.1)
