"""The default method: integrate the coefficients out, sample φ alone, draw the coefficients back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core import deadline
from bayescal._core.importance_weights import effective_size, resample, smoothed
from bayescal._core.lazy_jax import jax
from bayescal._core.progress import stage
from bayescal._core.settings import settings
from bayescal._inference import nuts_chains, sampled_products, trust
from bayescal._inference.laplace import NOTHING_KNOWN, Mode, find_mode
from bayescal._inference.least_squares import LeastSquares, refine
from bayescal._inference.method import CHAINS, Draws, Method, Outcome
from bayescal._inference.problem import Problem
from bayescal._inference.sampling import PROPOSALS, WeightedDraws, draw_weighted
from bayescal._inference.trust import FEWEST_DRAWS, K_HAT

TOO_NONLINEAR = "Nonlinearity too strong for the linearised posterior ({}): exact NUTS."
TOO_HEAVY = "The posterior is not nearly Gaussian given φ ({}): exact NUTS."
UNEVEN = "Importance weights of φ are uneven ({}): exact NUTS."
NOT_SAMPLED = (
    "The posterior was not sampled ({}): this is the Gaussian approximation about its mode."
)
NO_MORE = "Importance weights are uneven ({}), and chains, which would be exact, were not run to their end ({})."
FEW = "{:.0f} effective draws, and no more ({})."
TOO_FEW = "{:g} s were too few; a time limit gives them more"
# Largest number of proposals if k̂ is sound but effective draws are too few: NUTS would need more evaluations, 1,500
# iterations of four chains with seven or more gradients each.
MOST_DRAWS = 65_536


class Marginal(Method):
    """Sampling of φ with all coefficients integrated out.

    Attributes:
        draws: joint draws returned.
        proposals: importance proposals of the final round; None for 8192, fewer where each costs a pass over many
            readings.
        rounds: of adaptation at most; none follows one whose weights are even, nor the third or a later one whose
            weights are sound.
        sampler: "importance", which falls back to NUTS by itself where Pareto k̂ > 0.7 (if the model is nonlinear,
            above 0.5 coefficients are first proposed anew with heavier tails), for five minutes at most where no time
            limit says otherwise; "nuts" for NUTS on all unknowns, coefficients whitened.
        chains: whether it falls back to these; where not, draws by uneven weights are what there is, and said to be so.
        promote: names of coefficients to sample with φ because their product with another unknown matters;
            None chooses them by the size of the second-order term.
    """

    draws: int = 4000
    proposals: int | None = None
    rounds: int = 12
    sampler: Literal["importance", "nuts"] = "importance"
    promote: tuple[str, ...] | None = None
    chains: bool = True
    name: ClassVar[str] = "marginal"

    def run(self, problem: Problem, seed: int, start: Any = NOTHING_KNOWN) -> Outcome:
        with stage("finding the mode"), deadline.finishing():
            problem, notes, mode = sampled_products.promote_products(problem, self.promote, start)
            mode = find_mode(problem, start=start) if mode is None else mode
        layout, finish = problem.layout, partial(self.approximate, problem, mode, seed, notes)
        deadline.current().defer_interrupt()
        try:
            if self.sampler == "nuts" or not mode.log_evidence > -np.inf:
                return self._run_nuts(problem, mode, seed, notes)
            with stage("sampling"):
                for weighted in self._sample_until_sound(problem, mode, seed):
                    why_not = weighted.why_not
                    finish = partial(self._from_weights, layout, weighted, notes, seed)
            if not (why_not and self.chains):
                return finish("chains=False" if why_not else "")
            linear = UNEVEN if problem.affine else TOO_NONLINEAR
            reason = linear if problem.noise.gaussian else TOO_HEAVY
            return self._run_nuts(problem, mode, seed, (*notes, reason.format(why_not)))
        except deadline.TimeIsUp as early:
            return finish(str(early))

    def approximate(
        self, problem: Problem, mode: Mode, seed: int, notes: tuple[str, ...], why: str
    ) -> Outcome:
        """Return the Gaussian approximation about the mode, if sampling was stopped."""
        outcome = LeastSquares(draws=self.draws).outcome(
            problem.layout, refine(problem, mode, False), seed
        )
        notes = (*notes, NOT_SAMPLED.format(why), *outcome.verdict.notes)
        return replace(outcome, verdict=replace(outcome.verdict, notes=notes))

    def _sample_until_sound(
        self, problem: Problem, mode: Mode, seed: int, heavy: bool = False
    ) -> Iterator[_SmoothedDraws]:
        """Yield weighted joint draws with their diagnostics until these are sound; the last are the best.

        Proposals are doubled up to the usual number, and beyond it while k̂ is sound. `heavy`: propose coefficients from
        a Student-t distribution, whose tails suffice for a nonlinear model.
        """
        proposals, cap = self.proposals, MOST_DRAWS
        draws = None
        while True:
            draws = draw_weighted(problem, mode, seed, proposals, self.rounds, heavy, draws)
            weighted = _weigh_draws(draws, heavy)
            count = len(weighted.weights)
            limit = PROPOSALS if self.proposals is None else 0
            expected = effective_size(weighted.weights) / count * cap
            if weighted.k_hat <= weighted.limit and expected >= settings().effective_draws:
                limit = max(limit, cap)
            yield weighted
            if not weighted.why_not or count >= limit:
                break
            proposals = min(2 * count, limit) - count  # in addition to the earlier ones
        if not heavy and weighted.limit < weighted.k_hat <= K_HAT:
            yield from self._sample_until_sound(problem, mode, seed, heavy=True)

    def _from_weights(self, layout, weighted: _SmoothedDraws, notes, seed, why: str) -> Outcome:
        """Resample draws by their weights; `why`: the reason for accepting unsound ones, such as a deadline."""
        draws, weights, k_hat = weighted.draws, weighted.weights, weighted.k_hat
        effective, reasons = effective_size(weights), ()
        if why and trust.check_weights(weights, k_hat, limit=weighted.limit, min_ess=FEWEST_DRAWS):
            reasons = (NO_MORE.format(weighted.why_not, why),)
        elif why:
            notes = (*notes, FEW.format(effective, why))
        # At most as many draws as the effective sample size: repeated draws would look like information.
        count = CHAINS * max(1, int(min(self.draws, effective)) // CHAINS)
        indices = resample(weights, count, seed)
        evidence = (float(draws.log_evidence), float(draws.log_evidence_error))
        return Outcome(
            layout=layout,
            draws=Draws.of(draws.x[indices], draws.v[indices]),
            mode=draws.mode,
            verdict=trust.weights_verdict(weights, k_hat, notes, draws.mode, reasons),
            log_evidence=None if layout.is_improper else evidence,
        )

    def _run_nuts(self, problem: Problem, mode: Mode, seed: int, notes) -> Outcome:
        """Run NUTS; limited to `nuts_chains.TIME_LIMIT` unless it or a time limit was requested."""
        layout, is_unlimited = problem.layout, self.sampler == "nuts"
        log_density, unpack, start, covariance = nuts_chains.whiten_posterior(problem, mode)
        plan = nuts_chains.Plan(800, self.draws // CHAINS, CHAINS, start.size < 40)
        is_unlimited = is_unlimited or deadline.current().ends_at < math.inf
        with stage("NUTS on whitened unknowns"):
            with deadline.until(None if is_unlimited else nuts_chains.TIME_LIMIT, words=TOO_FEW):
                chains = nuts_chains.run(log_density, start, covariance, jax.random.key(seed), plan)
            to_unknowns = jax.jit(lambda q: jax.lax.map(lambda u: unpack(u)[:2], q, batch_size=64))
            x, v = to_unknowns(chains.draws.reshape(-1, start.size))
        has_evidence = not layout.is_improper and np.isfinite(mode.log_evidence)
        return Outcome(
            layout=layout,
            draws=Draws.of(x, v),
            mode=mode,
            verdict=trust.chain_verdict(chains, "NUTS on whitened unknowns", notes),
            log_evidence=(float(mode.log_evidence), None) if has_evidence else None,
        )


class _SmoothedDraws(NamedTuple):
    """Joint draws, Pareto-smoothed weights, k̂ and its limit, and the reason why the weights are unsound, if any."""

    draws: WeightedDraws
    weights: Float[np.ndarray, "s"]
    k_hat: float
    limit: float
    why_not: str


def _weigh_draws(draws: WeightedDraws, heavy: bool = False) -> _SmoothedDraws:
    weights, k_hat = smoothed(draws.log_weight)
    weights_of_phi, _ = smoothed(draws.log_weight_phi)
    correction = draws.log_weight - draws.log_weight_phi
    limit = K_HAT if heavy else trust.largest_k_hat(correction, weights_of_phi)
    why_not = trust.check_weights(weights, k_hat, limit=limit)
    return _SmoothedDraws(draws, weights, k_hat, limit, why_not)
