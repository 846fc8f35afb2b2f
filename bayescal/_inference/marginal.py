"""The default method: integrate the coefficients out, sample φ alone, draw the coefficients back."""

from __future__ import annotations

from typing import ClassVar, Literal

import jax
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.batched_map import over
from bayescal._core.jit import compiled
from bayescal._core.progress import stage
from bayescal._inference import (
    checkpoint,
    importance_sampling,
    laplace,
    nuts_chains,
    sampled_products,
)
from bayescal._inference import gaussian as linear
from bayescal._inference.method import MODE, Draws, Method, Outcome, Verdict
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

K_HAT = 0.7  # above it, importance weights are not to be trusted (Vehtari et al. 2024)
# Where the model bends, coefficients are proposed with a Gaussian's tails, thinner than those that they may have;
# k̂ then shows too little: at 0.6 to 0.7, standard deviations came out up to a third too small, below 0.5 right.
K_BENT = 0.5
BENT = 0.3  # standard deviation of the log weights by bending, from which on that counts
ENOUGH = 400  # effective draws, below which chains are run instead
CHAINS = 4


class Marginal(Method):
    """Sampling of φ with all coefficients integrated out.

    Attributes:
        draws: joint draws returned.
        proposals: importance proposals of the final round; None for 8192, or 2048 where each costs a pass over
            many readings.
        rounds: of adaptation.
        sampler: "importance", which falls back to NUTS by itself where Pareto k̂ > 0.7 (0.5, if the model
            bends) or the weights are worth less than 400 draws; "nuts" for NUTS on φ.
        promote: names of coefficients to sample with φ because their product with another unknown matters;
            None chooses them by the size of the second-order term.
    """

    draws: int = 4000
    proposals: int | None = None
    rounds: int = 3
    sampler: Literal["importance", "nuts"] = "importance"
    promote: tuple[str, ...] | None = None
    name: ClassVar[str] = "marginal"

    def run(self, layout: Layout, frame: Frame, y: Float[Array, "n"], seed: int) -> Outcome:
        with stage("finding the mode"):
            layout, notes = self._promoted(layout, frame, y)
        key = jax.random.key(seed)
        if not layout.model.noise.gaussian:
            notes = (*notes, f"{layout.model.noise.law} noise is not Gaussian: sampled jointly.")
            return self._exact(layout, frame, y, key, kept_mode(layout, frame, y), notes)
        if self.sampler == "nuts" and layout.hypers:
            return self._nuts_on_phi(layout, frame, y, key, notes)
        with stage("sampling"):
            mode = kept_mode(layout, frame, y)
            proposals = self.proposals or _proposals(layout, frame)
            found = checkpoint.once(
                "weighted draws",
                importance_sampling.Weighted(MODE, *range(7)),  # pyright: ignore  # its structure alone
                lambda: importance_sampling.sample_jit(
                    layout, frame, y, mode, key, proposals, self.rounds
                ),
            )
            found = jax.tree.map(np.asarray, found)
        weights, k_hat = smoothed(found.log_weight)
        of_phi, k_phi = smoothed(found.log_weight_phi)
        limit = _limit(found.log_weight - found.log_weight_phi, of_phi)
        if k_hat <= limit and worth(weights) >= ENOUGH:
            return self._from_weights(layout, found, weights, k_hat, notes, seed)
        if k_phi > K_HAT or worth(of_phi) < ENOUGH:
            why = f"k̂ = {k_phi:.2f}, {worth(of_phi):.0f} effective draws"
            notes = (*notes, f"Importance weights of φ were uneven ({why}): NUTS on φ instead.")
            return self._nuts_on_phi(layout, frame, y, key, notes)
        why = f"k̂ = {k_hat:.2f}, {worth(weights):.0f} effective draws"
        notes = (*notes, f"The model bends too much for its linear form ({why}): exact NUTS.")
        return self._exact(layout, frame, y, key, found.mode, notes)

    def _promoted(self, layout, frame, y) -> tuple[Layout, tuple[str, ...]]:
        def choose():
            chosen, notes = sampled_products.choose(layout, frame, y, self.promote)
            return [chosen.promoted, notes]

        promoted, notes = checkpoint.noted("promotion", choose)
        return Layout(layout.model, layout.counts, tuple(promoted)), tuple(notes)

    def _from_weights(self, layout, found, weights, k_hat, notes, seed) -> Outcome:
        effective = worth(weights)
        # Never more draws than the weights are worth: repeated draws would pass for information.
        count = CHAINS * max(1, int(min(self.draws, effective)) // CHAINS)
        pick = resample(weights, count, seed)
        shaped = [by_chain(a[pick]) for a in (found.x, found.rows, found.v)]
        reasons = _mode_reasons(found.mode)
        verdict = Verdict(
            not reasons, tuple(reasons), notes, "importance sampling", float(k_hat), effective
        )
        evidence = (float(found.log_evidence), float(found.log_evidence_error))
        return Outcome(
            layout, Draws(*shaped), found.mode, verdict, None if layout.improper else evidence
        )

    def _nuts_on_phi(self, layout, frame, y, key, notes) -> Outcome:
        mode = kept_mode(layout, frame, y)
        k1, k2 = jax.random.split(key)
        density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)
        with stage("NUTS on φ"):
            ran = nuts_chains.run(
                lambda v: density(v)[0],
                mode.v,
                mode.covariance,
                k1,
                warmup=500,
                draws=self.draws // CHAINS,
                chains=CHAINS,
                name="NUTS on phi",
            )
            flat = ran.draws.reshape(-1, ran.draws.shape[-1])
            x, rows, correction = _draw_back(layout, frame, y, mode, flat, k2)
        weights, k_hat = smoothed(np.asarray(correction))
        limit = _limit(np.asarray(correction), np.full(len(weights), 1 / len(weights)))
        if k_hat > limit or worth(weights) < min(ENOUGH, 0.5 * len(weights)):
            why = f"k̂ = {k_hat:.2f}, {worth(weights):.0f} effective draws"
            notes = (*notes, f"The model bends too much for its linear form ({why}): exact NUTS.")
            return self._exact(layout, frame, y, key, mode, notes)
        pick = slice(None)
        if worth(weights) < 0.98 * len(weights):
            pick = _resample_within(weights)
        shaped = [by_chain(np.asarray(a)[pick]) for a in (x, rows, flat)]
        verdict = chain_verdict(ran, mode, "NUTS on φ", notes, float(k_hat))
        evidence = (float(mode.log_evidence), None)
        return Outcome(layout, Draws(*shaped), mode, verdict, None if layout.improper else evidence)

    def _exact(self, layout, frame, y, key, mode, notes) -> Outcome:
        log_density, unpack, start, covariance = nuts_chains.whitened(layout, frame, y, mode)
        with stage("NUTS on whitened unknowns"):
            ran = nuts_chains.run(
                log_density,
                start,
                covariance,
                key,
                warmup=800,
                draws=self.draws // CHAINS,
                chains=CHAINS,
                dense=start.size < 40,
                name="exact NUTS",
            )
            place = jax.jit(lambda q: over(lambda one: unpack(one)[:3], q, 64))
            x, rows, v = place(ran.draws.reshape(-1, start.size))
        shaped = [by_chain(np.asarray(a)) for a in (x, rows, v)]
        verdict = chain_verdict(ran, mode, "NUTS on whitened unknowns", notes, None)
        gaussian = layout.model.noise.gaussian and not layout.improper
        evidence = (float(mode.log_evidence), None) if gaussian else None
        return Outcome(layout, Draws(*shaped), mode, verdict, evidence)


def _proposals(layout: Layout, frame: Frame) -> int:
    return 2048 if frame.size > 1000 and not linear.needs_one_pass(layout, frame) else 8192


@compiled
def _draw_back(layout, frame, y, mode, v, key):
    density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)

    def one(args):
        v, key = args
        found = density(v)[1]
        return importance_sampling.draw_coefficients(layout, frame, y, mode.point, v, found, key)

    return over(one, (v, jax.random.split(key, len(v))), importance_sampling.BATCH)


def kept_mode(layout: Layout, frame: Frame, y: Array) -> laplace.Mode:
    """The mode, from the fit's checkpoint where it is there."""
    return checkpoint.once("mode", MODE, lambda: laplace.compiled_mode(layout, frame, y))


def smoothed(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto-smoothed weights, summing to one, and k̂, by ArviZ."""
    from arviz_stats.base import array_stats  # half a second that only sampling needs

    if np.ptp(log_weight) < 1e-9:
        return np.full(log_weight.size, 1 / log_weight.size), 0.0
    values, k_hat = array_stats.psislw(-np.asarray(log_weight, dtype=float))
    # psislw takes log likelihood and smooths its inverse: hence the sign.
    weights = np.exp(values - np.max(values))
    return weights / weights.sum(), float(k_hat)


def _limit(correction: np.ndarray, weights: np.ndarray) -> float:
    """The largest k̂ that is trusted, given what bending adds to the log weights of draws of φ."""
    correction = np.clip(correction, -1e3, 1e3)
    mean = weights @ correction
    return K_BENT if weights @ (correction - mean) ** 2 > BENT**2 else K_HAT


def worth(weights: np.ndarray) -> float:
    """How many independent draws these weights are worth (Kish)."""
    return float(1 / np.sum(weights**2))


def resample(weights: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Systematic resampling, then shuffled so that draws stand in no order."""
    random = np.random.default_rng(seed)
    ladder = (np.arange(count) + random.random()) / count
    pick = np.searchsorted(np.cumsum(weights) / np.sum(weights), ladder)
    return random.permutation(np.minimum(pick, weights.size - 1))


def _resample_within(weights: np.ndarray) -> np.ndarray:
    return resample(weights, weights.size, 0)


def by_chain(values: np.ndarray) -> np.ndarray:
    return values.reshape(CHAINS, len(values) // CHAINS, *values.shape[1:])


def _mode_reasons(mode: laplace.Mode) -> list[str]:
    reasons = []
    if not np.isfinite(mode.change) or mode.change > 0.05:
        reasons.append(
            f"The mode was still moving by {float(mode.change):.2g} standard deviations "
            "when the optimiser stopped."
        )
    return reasons


def chain_verdict(ran, mode, sampler: str, notes: tuple[str, ...], k_hat: float | None) -> Verdict:
    """R-hat, effective size and divergences of chains, in words."""
    from arviz_stats.base import array_stats  # as above

    draws = np.moveaxis(np.asarray(ran.draws), -1, 0)
    r_hat = max(float(array_stats.rhat(d, chain_axis=0, draw_axis=1)) for d in draws)
    ess = min(float(array_stats.ess(d, chain_axis=0, draw_axis=1)) for d in draws)
    reasons = []
    if not r_hat <= 1.02:
        reasons.append(f"Chains disagree (R-hat {r_hat:.3f}): run longer, or give tighter priors.")
    if ess < 200:
        reasons.append(f"Only {ess:.0f} effective draws: run longer.")
    if ran.divergences > 0.005 * draws[0].size:
        reasons.append(f"{ran.divergences} divergent transitions: the posterior has a corner.")
    return Verdict(not reasons, tuple(reasons), notes, sampler, k_hat, ess, r_hat, ran.divergences)
