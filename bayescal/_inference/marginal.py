"""The default method: sample φ with the coefficients x integrated out, then draw x given φ."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core import deadline
from bayescal._core.importance_weights import compute_ess, resample, smooth
from bayescal._core.lazy_jax import jax
from bayescal._core.progress import track
from bayescal._core.settings import settings
from bayescal._inference import nuts_chains, sampled_products, trust
from bayescal._inference.laplace import NO_START, Mode, find_mode
from bayescal._inference.least_squares import LeastSquares, refine
from bayescal._inference.method import CHAINS, Draws, Method, Outcome
from bayescal._inference.problem import Problem
from bayescal._inference.sampling import MAX_PROPOSALS, WeightedDraws, draw_weighted
from bayescal._inference.trust import MAX_K_HAT, MIN_DEADLINE_ESS

TOO_NONLINEAR = "The model is too nonlinear for importance weights ({}): exact NUTS is run instead."
NOT_GAUSSIAN = "The posterior given φ is far from Gaussian ({}): exact NUTS is run instead."
UNRELIABLE_WEIGHTS = "Importance weights of φ are unreliable ({}): exact NUTS is run instead."
SAMPLING_STOPPED = (
    "The posterior was not sampled ({}): this is the Gaussian approximation about its mode."
)
NUTS_UNFINISHED = "Importance weights are unreliable ({}), and NUTS was not run to its end ({})."
FEW_EFFECTIVE_DRAWS = "Only {:.0f} effective draws ({})."
TOO_SHORT = "the limit of {:g} s was too short; give a longer time limit"
# Largest number of proposals if k̂ is acceptable but the effective sample size too small: NUTS would be slower.
MAX_EXTENDED_PROPOSALS = 65_536


class Marginal(Method):
    """Method that samples φ with all coefficients integrated out, then draws the coefficients given φ.

    Attributes:
        draws: number of joint draws to return.
        proposals: number of importance proposals in the final round; None: 8192, or fewer if each costs a pass over
            many readings.
        rounds: largest number of adaptation rounds; adaptation ends earlier when half of the draws are effective, or
            when Pareto k̂ is below 0.7 after the third round.
        sampler: "importance" for importance sampling, with a fallback to NUTS if k̂ > 0.7, limited to five minutes
            unless a time limit is given; at k̂ > 0.5, coefficients of a nonlinear model are first proposed again with
            heavier tails. "nuts" for NUTS on all unknowns, with whitened coefficients.
        chains: whether to fall back to NUTS chains; if not, unreliable weighted draws are returned with a note.
        promote: names of coefficients to sample with φ because the output depends on their product with another
            unknown; None: chosen by the size of the second-order term.
    """

    draws: int = 4000
    proposals: int | None = None
    rounds: int = 12
    sampler: Literal["importance", "nuts"] = "importance"
    promote: tuple[str, ...] | None = None
    chains: bool = True
    name: ClassVar[str] = "marginal"

    def run(self, problem: Problem, seed: int, start: Any = NO_START) -> Outcome:
        with track("finding the mode"), deadline.suspend():
            problem, notes, mode = sampled_products.promote_products(problem, self.promote, start)
            mode = find_mode(problem, start=start) if mode is None else mode
        layout, finish = problem.layout, partial(self.approximate, problem, mode, seed, notes)
        deadline.current().defer_interrupt()
        try:
            if self.sampler == "nuts" or not mode.log_evidence > -np.inf:
                return self._run_nuts(problem, mode, seed, notes)
            with track("sampling"):
                for weighted in self._sample_until_reliable(problem, mode, seed):
                    fault = weighted.fault
                    finish = partial(self._resample_draws, layout, weighted, notes, seed)
            if not (fault and self.chains):
                return finish("chains=False" if fault else "")
            fallback = UNRELIABLE_WEIGHTS if problem.is_affine else TOO_NONLINEAR
            reason = fallback if problem.noise.is_gaussian else NOT_GAUSSIAN
            return self._run_nuts(problem, mode, seed, (*notes, reason.format(fault)))
        except deadline.TimeIsUp as interrupt:
            return finish(str(interrupt))

    def approximate(
        self, problem: Problem, mode: Mode, seed: int, notes: tuple[str, ...], reason: str
    ) -> Outcome:
        """Return the Gaussian approximation about the mode; `reason`: reason why sampling ended, for a note."""
        outcome = LeastSquares(draws=self.draws).outcome(
            problem.layout, refine(problem, mode, False), seed
        )
        notes = (*notes, SAMPLING_STOPPED.format(reason), *outcome.verdict.notes)
        return replace(outcome, verdict=replace(outcome.verdict, notes=notes))

    def _sample_until_reliable(
        self, problem: Problem, mode: Mode, seed: int, is_student_t: bool = False
    ) -> Iterator[_SmoothedDraws]:
        """Yield weighted joint draws with their diagnostics until the weights are reliable; the last are the best.

        Proposals are doubled up to 8192, and beyond it while k̂ is acceptable. is_student_t: propose coefficients from a
        Student-t distribution, whose tails suffice for a nonlinear model.
        """
        proposals, max_proposals = self.proposals, MAX_EXTENDED_PROPOSALS
        draws = None
        while True:
            draws = draw_weighted(problem, mode, seed, proposals, self.rounds, is_student_t, draws)
            weighted = _smooth_weights(draws, is_student_t)
            count = len(weighted.weights)
            limit = MAX_PROPOSALS if self.proposals is None else 0
            expected_ess = compute_ess(weighted.weights) / count * max_proposals
            if weighted.k_hat <= weighted.limit and expected_ess >= settings().effective_draws:
                limit = max(limit, max_proposals)
            yield weighted
            if not weighted.fault or count >= limit:
                break
            proposals = min(2 * count, limit) - count  # in addition to the earlier ones
        if not is_student_t and weighted.limit < weighted.k_hat <= MAX_K_HAT:
            yield from self._sample_until_reliable(problem, mode, seed, is_student_t=True)

    def _resample_draws(self, layout, weighted: _SmoothedDraws, notes, seed, why: str) -> Outcome:
        """Resample draws by their weights; `why`: reason to accept unreliable weights, such as a deadline, or ""."""
        draws, weights, k_hat = weighted.draws, weighted.weights, weighted.k_hat
        ess, reasons = compute_ess(weights), ()
        limit = weighted.limit
        if why and trust.check_weights(weights, k_hat, limit=limit, min_ess=MIN_DEADLINE_ESS):
            reasons = (NUTS_UNFINISHED.format(weighted.fault, why),)
        elif why:
            notes = (*notes, FEW_EFFECTIVE_DRAWS.format(ess, why))
        # At most as many draws as the effective sample size: repeated draws would look like information.
        count = CHAINS * max(1, int(min(self.draws, ess)) // CHAINS)
        indices = resample(weights, count, seed)
        evidence = (float(draws.log_evidence), float(draws.log_evidence_error))
        return Outcome(
            layout=layout,
            draws=Draws.of(draws.x[indices], draws.v[indices]),
            mode=draws.mode,
            verdict=trust.assess_weights(weights, k_hat, notes, draws.mode, reasons),
            log_evidence=None if layout.is_improper else evidence,
        )

    def _run_nuts(self, problem: Problem, mode: Mode, seed: int, notes) -> Outcome:
        """Run NUTS; as a fallback for five minutes at most, unless a time limit is given."""
        layout, is_unlimited = problem.layout, self.sampler == "nuts"
        log_density, unpack, start, covariance = nuts_chains.whiten_posterior(problem, mode)
        plan = nuts_chains.Plan(800, self.draws // CHAINS, CHAINS, start.size < 40)
        is_unlimited = is_unlimited or deadline.current().ends_at < math.inf
        with track("NUTS on whitened unknowns"):
            with deadline.limit(None if is_unlimited else nuts_chains.MAX_TIME_S, words=TOO_SHORT):
                chains = nuts_chains.run(log_density, start, covariance, jax.random.key(seed), plan)
            to_unknowns = jax.jit(lambda q: jax.lax.map(lambda u: unpack(u)[:2], q, batch_size=64))
            x, v = to_unknowns(chains.draws.reshape(-1, start.size))
        has_evidence = not layout.is_improper and np.isfinite(mode.log_evidence)
        return Outcome(
            layout=layout,
            draws=Draws.of(x, v),
            mode=mode,
            verdict=trust.assess_chains(chains, "NUTS on whitened unknowns", notes),
            log_evidence=(float(mode.log_evidence), None) if has_evidence else None,
        )


class _SmoothedDraws(NamedTuple):
    """Joint draws with Pareto-smoothed weights, k̂ and its limit, and the weights' fault (empty if reliable)."""

    draws: WeightedDraws
    weights: Float[np.ndarray, "s"]
    k_hat: float
    limit: float
    fault: str


def _smooth_weights(draws: WeightedDraws, is_student_t: bool = False) -> _SmoothedDraws:
    weights, k_hat = smooth(draws.log_weight)
    phi_weights, _ = smooth(draws.log_weight_phi)
    correction = draws.log_weight - draws.log_weight_phi
    limit = MAX_K_HAT if is_student_t else trust.select_k_hat(correction, phi_weights)
    fault = trust.check_weights(weights, k_hat, limit=limit)
    return _SmoothedDraws(draws, weights, k_hat, limit, fault)
