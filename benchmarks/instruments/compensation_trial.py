"""One instrument's trial: campaigns drawn from its priors, each fitted, and verification readings compensated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from bayescal._use.operating_equation import first_order
from benchmarks.accuracy.chunks import PROPOSALS, ROUNDS, fingerprint_of, promoted, seed_of
from benchmarks.accuracy.ranks import draw_prior

CHUNK = 20  # campaigns a line of the file
DRAWS = 400


@dataclass(frozen=True)
class Trial:
    """An instrument's calibration campaign, and what verifies it.

    Attributes:
        name: of the instrument.
        model: all its priors proper.
        plan: readings whose columns every calibration data set shares.
        verification: readings, whose output is replaced.
        stimulus: true, of each verification reading, in the unit of use.
        added: the stimulus adds to what the composition gives (a sensor at rest has no column for it).
        members: of groups that the compensator is of.
        aside: coefficients that the campaign does not identify beyond a prior or spread: none, a constant, or a
            constant and one in proportion to the stimulus. Ratios are of errors without their like.
        proposals: of `Marginal`.
    """

    name: str
    model: bc.Model
    plan: bc.Measurements
    verification: bc.Measurements
    stimulus: np.ndarray
    added: bool = False
    members: tuple[tuple[str, str], ...] = ()
    aside: tuple[str, ...] = ()
    proposals: int = PROPOSALS
    chunk: int = CHUNK

    @cached_property
    def method(self) -> bc.Marginal:
        """As the compensator averages over so many draws; one number, so that all campaigns share programs."""
        return bc.Marginal(
            draws=DRAWS,
            proposals=self.proposals,
            rounds=ROUNDS,
            promote=promoted(self.model, self.plan),
        )

    @property
    def fingerprint(self) -> str:
        """Changes with the model, its priors, the plans or the method."""
        made, _ = self.drawn(1, seed_of(self.name, 0))
        outputs = [v for one in made for v in (*one[0]["output"], *one[1]["output"])]
        return fingerprint_of(self.model, outputs, repr(self.method))

    def drawn(
        self, count: int, seed: int
    ) -> tuple[list[tuple[bc.Measurements, bc.Measurements]], dict[str, np.ndarray]]:
        """Calibration and verification data sets, and the truth of every unknown, (count, …)."""
        layout, levels = bind(self.model, self.plan)
        later, new_levels = bind(self.model, self.verification)
        reference = reference_of(self.plan)
        frame = build_frame(self.plan, reference)
        there = build_frame(self.verification, reference)
        keep, come, act = _shared(layout, later, levels, new_levels)
        extra = jnp.asarray(self.stimulus if self.added else np.zeros_like(self.stimulus))

        def one(key):
            k = jax.random.split(key, 4)
            x, v = draw_prior(layout, k[0])
            hyper = forward.hyper_values(layout, v)
            z = jax.random.normal(k[1], (later.size,))
            new = forward.prior_mean(later) + forward.prior_sd(later, hyper) * z
            new = new.at[come].set(x[keep]) * act
            first = forward.draw_readings(layout, frame, x, v, k[2])
            second = forward.draw_readings(later, there, new, v, k[3]) + extra
            truth = {**hyper, **forward.coefficients(layout, x, hyper)}
            return first, second, truth

        keys = jax.random.split(jax.random.key(seed), count)
        first, second, truth = jax.jit(jax.vmap(one))(keys)
        pairs = [
            (
                self.plan.with_column("output", np.asarray(a)),
                self.verification.with_column("output", np.asarray(b)),
            )
            for a, b in zip(first, second, strict=True)
        ]
        return pairs, {name: np.asarray(value) for name, value in truth.items()}

    def run(self, index: int) -> dict[str, Any]:
        """One chunk of campaigns."""
        seed = seed_of(self.name, index)
        made, truth = self.drawn(self.chunk, seed)
        rows = [
            self.campaign(*pair, {n: t[i] for n, t in truth.items()}, seed + i)
            for i, pair in enumerate(made)
        ]
        return {name: [row[name] for row in rows] for name in rows[0]}

    def campaign(
        self,
        readings: bc.Measurements,
        verification: bc.Measurements,
        truth: dict[str, np.ndarray],
        seed: int,
    ) -> dict[str, Any]:
        """What compensation left of one campaign, beside what the true coefficients leave."""
        fit = bc.fit(self.model, readings, self.method, seed=seed, strict=False)
        compensate = bc.compensator(fit, members=dict(self.members))
        found = compensate(verification, warn=False)
        error = found.value - self.stimulus
        least = self.by_truth(compensate, verification, truth) - self.stimulus
        chosen = np.random.default_rng(seed).integers(len(error))
        row = {
            "ratio": round(self.rms(error) / self.rms(least), 5),
            "deviation": round(float(error[chosen] / found.uncertainty[chosen]), 5),
            "trusted": bool(fit.verdict.ok),
        }
        for name in self.aside:
            samples, actual = fit.samples(name), np.atleast_1d(truth[name])[0]
            samples = samples if samples.ndim == 1 else samples[:, 0]
            row[name] = round(float((samples.mean() - actual) / samples.std()), 5)
        return row

    def rms(self, error: np.ndarray) -> float:
        """Of the errors, without what the campaign does not identify."""
        if not self.aside:
            return float(np.sqrt(np.mean(error**2)))
        powers = np.vander(self.stimulus / np.abs(self.stimulus).max(), len(self.aside))
        left = error - powers @ np.linalg.lstsq(powers, error)[0]
        return float(np.sqrt(np.mean(left**2)))

    def by_truth(
        self,
        compensate: bc.Compensator,
        verification: bc.Measurements,
        truth: dict[str, np.ndarray],
    ) -> np.ndarray:
        """The stimulus by the true coefficients, deviations that are new in use zero."""
        assert compensate.equation is not None and compensate.calibration is not None
        levels, chosen = compensate.calibration.levels, dict(self.members)
        blocks = {b.name: b for b in compensate.equation.blocks}
        theta = []
        for entry in compensate.equation.unknowns():
            value = np.atleast_1d(truth[entry.key])
            per = blocks[entry.key].coefficient.per if entry.kind != "shape" else None
            place = levels[per].index(chosen[per]) if per and entry.kind != "new" else 0
            theta.append(0.0 if entry.kind == "new" else float(value[place]))
        own, size = compensate.equation, len(verification)
        inputs = {n: jnp.zeros(size) for n in own.names}
        inputs |= {n: jnp.asarray(verification[n]) for n in own.inputs}
        value, _, _ = first_order(
            *(own, jnp.asarray(theta), jnp.zeros((len(theta), len(theta)))),
            *(jnp.asarray(verification["output"]), inputs, None),
        )
        return np.asarray(value)


def _shared(layout, later, levels, new_levels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of what both data sets have in common in the one's x and in the other's, and what acts in the latter.

    Runs and cells are new; the test rig is perfect.
    """
    use = layout.model.instrument.use
    keep, come, act = [], [], np.ones(later.size)
    for a, b in zip(layout.x_blocks, later.x_blocks, strict=True):
        per = a.coefficient.per
        if use.slots and a.slot not in use.slots:
            act[b.start : b.start + b.size] = 0.0
        elif per is None:
            keep, come = [*keep, a.start], [*come, b.start]
        elif per not in ("run", "cell"):
            for i, member in enumerate(new_levels[per]):
                keep, come = [*keep, a.start + levels[per].index(member)], [*come, b.start + i]
    return np.array(keep, dtype=int), np.array(come, dtype=int), act
