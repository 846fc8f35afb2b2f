"""The default method: integrate the coefficients out, sample φ alone, draw the coefficients back."""

from __future__ import annotations

from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.importance_weights import effective_size, resample, smoothed
from bayescal._core.jit import compiled
from bayescal._core.parallel import over
from bayescal._core.progress import stage
from bayescal._engine.assembly import Assembly
from bayescal._engine.mode import Mode, find_mode
from bayescal._engine.record import Record
from bayescal._engine.sampling import PROPOSALS, WeightedDraws, weighted_draws
from bayescal._inference import (
    checkpoint,
    importance_sampling,
    laplace,
    nuts_chains,
    sampled_products,
    trust,
)
from bayescal._inference.method import CHAINS, MODE, Draws, Method, Outcome, by_chain, by_engine
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

TOO_NONLINEAR = "Nonlinearity too strong for the linearised posterior ({}): exact NUTS."
TOO_HEAVY = "The posterior is not nearly Gaussian given φ ({}): exact NUTS."
WEIGHTED = WeightedDraws._make(range(7))  # for its structure alone
NEARLY_EVEN = (
    0.98  # effective sample size as a share of the draws, from which they stay as they are
)


class Marginal(Method):
    """Sampling of φ with all coefficients integrated out.

    Attributes:
        draws: joint draws returned.
        proposals: importance proposals of the final round; None for 8192, fewer where each costs a pass over many
            readings.
        rounds: of adaptation at most; none follows one whose weights are even.
        sampler: "importance", which falls back to NUTS by itself where Pareto k̂ > 0.7 (0.5, if the model
            is nonlinear) or the effective sample size is below 400; "nuts" for NUTS on φ.
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
        record = Record(layout.model.instrument, frame, np.asarray(y))
        with stage("finding the mode"):
            layout, notes = self._promoted(layout, record)
            mode = kept_mode(layout, record)
        key, noise = jax.random.key(seed), layout.model.noise
        if not (noise.gaussian or by_engine(layout)):
            notes = (*notes, f"{noise.law} noise is not Gaussian: sampled jointly.")
            return self._exact(layout, frame, y, key, mode, notes)
        if self.sampler == "nuts" and layout.hypers and noise.gaussian:
            return self._nuts_on_phi(layout, frame, y, key, mode, notes)
        if not mode.log_evidence > -np.inf:
            return self._exact(layout, frame, y, key, mode, notes)
        with stage("sampling"):
            found, weights, k_hat, why_not = self._sampled(layout, record, mode, seed)
        if not why_not:
            return self._from_weights(layout, found, mode, weights, k_hat, notes, seed)
        why = trust.unevenness(*smoothed(found.log_weight_phi))
        if why and noise.gaussian:
            notes = (*notes, f"Importance weights of φ were uneven ({why}): NUTS on φ instead.")
            return self._nuts_on_phi(layout, frame, y, key, mode, notes)
        words = TOO_NONLINEAR if noise.gaussian else TOO_HEAVY
        return self._exact(layout, frame, y, key, mode, (*notes, words.format(why_not)))

    def _promoted(self, layout: Layout, record: Record) -> tuple[Layout, tuple[str, ...]]:
        def choose():
            chosen, notes = sampled_products.choose_on(layout, record, self.promote)
            return [chosen.promoted, notes]

        promoted, notes = checkpoint.noted("promotion", choose)
        return Layout(layout.model, layout.counts, tuple(promoted)), tuple(notes)

    def _sampled(
        self, layout, record, mode, seed
    ) -> tuple[WeightedDraws, Float[np.ndarray, "s"], float, str]:
        """Joint draws, their weights smoothed, Pareto's k̂, and why these are not to be trusted.

        Where fewer proposals than usual do not suffice, twice as many are tried, up to the usual number.
        """
        found = self._weighted(layout, record, mode, seed, self.proposals)
        judged, tried = _judged(found), len(found.log_weight)
        while judged[-1] and self.proposals is None and tried < PROPOSALS:
            tried = min(2 * tried, PROPOSALS)
            found = self._weighted(layout, record, mode, seed, tried)
            judged = _judged(found)
        return found, *judged

    def _weighted(self, layout, record, mode, seed, proposals) -> WeightedDraws:
        """Joint draws with their weights, from the fit's checkpoint where they are there."""

        def draws() -> WeightedDraws:
            if by_engine(layout):
                assembly = Assembly(layout, record)
                return weighted_draws(assembly, mode, seed, proposals, self.rounds)
            key, count = jax.random.key(seed), proposals or PROPOSALS
            made = importance_sampling.sample_jit(
                layout, record.frame, jnp.asarray(record.y), mode, key, count, self.rounds
            )
            return WeightedDraws(*(getattr(made, name) for name in WeightedDraws._fields))

        found = checkpoint.once(f"weighted draws {proposals}", WEIGHTED, draws)
        return jax.tree.map(np.asarray, found)

    def _from_weights(self, layout, found, mode, weights, k_hat, notes, seed) -> Outcome:
        effective = effective_size(weights)
        # Never more draws than the effective sample size: repeated draws would pass for information.
        count = CHAINS * max(1, int(min(self.draws, effective)) // CHAINS)
        pick = resample(weights, count, seed)
        evidence = (float(found.log_evidence), float(found.log_evidence_error))
        return Outcome(
            layout=layout,
            draws=_by_chain(found.x[pick], found.rows[pick], found.v[pick]),
            mode=mode,
            verdict=trust.weights_verdict(weights, k_hat, notes, mode),
            log_evidence=None if layout.improper else evidence,
        )

    def _nuts_on_phi(self, layout, frame, y, key, mode, notes) -> Outcome:
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
        even = np.full(len(weights), 1 / len(weights))
        limit = trust.largest_k_hat(np.asarray(correction), even)
        enough = min(trust.ENOUGH, 0.5 * len(weights))
        if why := trust.unevenness(weights, k_hat, limit=limit, enough=enough):
            return self._exact(layout, frame, y, key, mode, (*notes, TOO_NONLINEAR.format(why)))
        pick = slice(None)
        if effective_size(weights) < NEARLY_EVEN * len(weights):
            pick = resample(weights, weights.size, 0)
        return Outcome(
            layout=layout,
            draws=_by_chain(*(np.asarray(a)[pick] for a in (x, rows, flat))),
            mode=mode,
            verdict=trust.chain_verdict(ran, "NUTS on φ", notes, k_hat),
            log_evidence=None if layout.improper else (float(mode.log_evidence), None),
        )

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
        known = (layout.model.noise.gaussian or by_engine(layout)) and not layout.improper
        return Outcome(
            layout=layout,
            draws=_by_chain(x, rows, v),
            mode=mode,
            verdict=trust.chain_verdict(ran, "NUTS on whitened unknowns", notes),
            log_evidence=(float(mode.log_evidence), None) if known else None,
        )


def _judged(found: WeightedDraws) -> tuple[Float[np.ndarray, "s"], float, str]:
    """Smoothed weights of joint draws, Pareto's k̂, and why they are not to be trusted; empty if they are."""
    weights, k_hat = smoothed(found.log_weight)
    of_phi, _ = smoothed(found.log_weight_phi)
    limit = trust.largest_k_hat(found.log_weight - found.log_weight_phi, of_phi)
    return weights, k_hat, trust.unevenness(weights, k_hat, limit=limit)


def _by_chain(x, rows, v) -> Draws:
    return Draws(x=by_chain(x), rows=by_chain(rows), v=by_chain(v))


@compiled
def _draw_back(layout, frame, y, mode, v, key):
    density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)

    def one(args):
        v, key = args
        found = density(v)[1]
        return importance_sampling.draw_coefficients(layout, frame, y, mode.point, v, found, key)

    return over(one, (v, jax.random.split(key, len(v))), importance_sampling.BATCH)


def kept_mode(layout: Layout, record: Record) -> Mode:
    """The mode, from the fit's checkpoint where it is there."""

    def found() -> Mode:
        if by_engine(layout):
            return find_mode(Assembly(layout, record))
        return laplace.compiled_mode(layout, record.frame, jnp.asarray(record.y))

    return jax.tree.map(np.asarray, checkpoint.once("mode", MODE, found))
