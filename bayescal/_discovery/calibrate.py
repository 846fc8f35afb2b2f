"""The loop: compare with the readings, see where it fails, add what is missing, watch the error fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from bayescal._calibration.evidence import laplace_evidence
from bayescal._calibration.fit import fit
from bayescal._calibration.predict import predict
from bayescal._core.progress import stage
from bayescal._diagnostics.check import check
from bayescal._diagnostics.evidence_scale import STRONG
from bayescal._diagnostics.leave_group_out import leave_one_group_out
from bayescal._diagnostics.noise_floor import noise_floor
from bayescal._discovery.discover import discover
from bayescal._discovery.outliers import without_spikes
from bayescal._discovery.search_path import OtherPath, Step, Trail, gate
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference, build_frame, reference_of
from bayescal._model.model import Model
from bayescal._model.noise_laws import White, over_record
from bayescal._model.unknown_effect import free_curve
from bayescal._readings.measurements import Measurements

WIDER = 1.0  # log evidence that correlated noise must gain over white before it is believed
SHORT = (
    2000  # readings up to which white noise is followed to its end before correlated noise is tried
)
FEWEST = 30  # readings from which the noise law can be told at all


def calibrate(
    model: Model,
    readings: Measurements,
    *,
    holdout: Measurements | None = None,
    effects: Sequence[Effect] = (),
    method: Method | None = None,
    max_effects: int = 5,
    widen_noise: bool = True,
    keep_spikes: bool = False,
    seed: int = 0,
    reference: Reference | None = None,
) -> Trail:
    """Fit, check, discover, add and fit again, until nothing more is found.

    White noise is widened to an Ornstein–Uhlenbeck process per run where that is more probable, before any effect
    is believed: a screen that takes wandering noise for white reports effects that are not there. On short
    records white noise with effects and wandering noise with effects are both followed to their ends, and the
    more probable end is kept; the other one is named where it is nearly as probable.

    Args:
        model: to begin with.
        readings: to fit.
        holdout: readings kept apart: read after the last step, and never used to choose an effect.
        effects: further candidates of the user's own.
        method: of every fit; `Marginal()` if not given.
        max_effects: most effects to add.
        widen_noise: False leaves the noise law as given, whatever the residuals look like.
        keep_spikes: False sets single readings far from both neighbours aside, and flags them.
        seed: of every random number.
        reference: constants of the bases to use in place of the readings' own.

    Raises:
        ModelError: the readings lack what the model needs.
    """
    if holdout is not None:
        model.require(holdout)
    if not keep_spikes:
        readings = without_spikes(readings)
        holdout = None if holdout is None else without_spikes(holdout)
    loop = _Loop(
        readings=readings,
        effects=tuple(effects),
        method=method,
        max_effects=max_effects,
        seed=seed,
        reference=reference,
        start=frozenset(model.names),
    )
    steps, other = loop.follow(model, widen_noise)
    if holdout is not None:
        steps = [replace(s, holdout_rmse=predict(s.calibration, holdout).rmse) for s in steps]
    return Trail(tuple(steps), gate(steps[-1]), holdout, other)


@dataclass(frozen=True)
class _Loop:
    """What stays the same from step to step."""

    readings: Measurements
    effects: tuple[Effect, ...]
    method: Method | None
    max_effects: int
    seed: int
    reference: Reference | None
    start: frozenset[str]

    def follow(self, model: Model, widen_noise: bool) -> tuple[list[Step], OtherPath | None]:
        """The steps from a model to the end, the noise law chosen on the way; and the end nearly chosen."""
        first = self.step(model)
        wide = self._wide(model) if widen_noise and first.calibration.verdict.ok else None
        if wide is None:
            return self.forward([first]), None
        wanders = self._gain(first, wide) > WIDER
        if not wanders or len(self.readings) <= SHORT:
            white = self.forward([first])
            behind = -np.inf
            if wanders:
                behind = laplace_evidence(wide, first.calibration) - _evidence(white[-1])
            if self._gain(white[-1], wide) <= WIDER and behind <= 0:
                return white, _other_path(white, wide.noise.law, [], behind)
            paths = [white, self._correlated(first, wide)]
            chosen, other = sorted(paths, key=lambda steps: -_evidence(steps[-1]))
            behind = _evidence(other[-1]) - _evidence(chosen[-1])
            law = other[-1].calibration.model.noise.law
            return chosen, _other_path(chosen, law, other, behind)
        return self._correlated(first, wide), None

    def _correlated(self, first: Step, wide: Model) -> list[Step]:
        """The path under correlated noise; white noise again at its end, if that then suffices."""
        widened = self.step(wide, noise_changed="noise widened: wandering")
        steps = self.forward([first, widened])
        final = steps[-1].calibration
        narrow = final.model.with_noise(first.calibration.model.noise)
        with stage("trying white noise again"):
            suffices = laplace_evidence(narrow, final) >= _evidence(steps[-1])
        if not suffices or len(steps) == 2:
            return steps
        return self.forward([*steps, self.step(narrow, noise_changed="noise white again")])

    def forward(self, steps: list[Step]) -> list[Step]:
        """Add what is found until nothing is, dropping what an addition makes superfluous."""
        steps = list(steps)
        while sum(s.added is not None for s in steps) < self.max_effects:
            last = steps[-1]
            if last.discovery is None or not last.discovery.best:
                break
            if last.check.fixed is not None and last.check.fixed.wrong:
                break  # a published calibration is on trial: nothing is added to make it look right
            added = last.discovery.best[0]
            if any(added.name in s.dropped for s in steps):
                break  # it was dropped before: adding it again would go in a circle
            model = last.calibration.model + added
            model, dropped = self._look_back(model, steps, added.name)
            steps.append(self.step(model, added.name, dropped))
        turn = _wrong_turn(steps)
        if turn is None:
            return steps
        index, name = turn
        model = steps[index].calibration.model + name
        return self.forward([*steps[: index + 1], self.step(model, name)])

    def _look_back(
        self, model: Model, steps: list[Step], newest: str
    ) -> tuple[Model, tuple[str, ...]]:
        """Drop what was added before and is superfluous now: the model is more probable without it.

        A free curve can stand in for any effect, so what has a name gives way to it only at odds of twenty to one.
        """
        dropped: list[str] = []
        earlier = [n for n in model.names if n not in self.start and n != newest]
        if not earlier:
            return model, ()
        calibration = steps[-1].calibration
        with stage("looking back"):
            best = laplace_evidence(model, calibration)
            for name in earlier:
                without = laplace_evidence(model - name, calibration)
                if without >= best + (STRONG if free_curve(newest) and not free_curve(name) else 0):
                    model, best = model - name, without
                    dropped.append(name)
        return model, tuple(dropped)

    def step(
        self,
        model: Model,
        added: str | None = None,
        dropped: tuple[str, ...] = (),
        noise_changed: str = "",
    ) -> Step:
        """Fit a model, check it, and ask what is missing from it."""
        calibration = fit(
            model,
            self.readings,
            self.method,
            seed=self.seed,
            strict=False,
            reference=self.reference,
        )
        with stage("checking"):
            checked = check(calibration)
            left_out = leave_one_group_out(calibration)
        discovery = None
        if calibration.verdict.ok:
            discovery = discover(calibration, effects=self.effects, max_effects=self.max_effects)
        return Step(
            calibration=calibration,
            added=added,
            dropped=dropped,
            rmse=predict(calibration).rmse,
            rmse_fitted=float(np.sqrt(np.mean(checked.residuals**2))),
            holdout_rmse=None,
            left_out=left_out,
            noise_floor=noise_floor(calibration),
            check=checked,
            discovery=discovery,
            noise_changed=noise_changed,
        )

    def _wide(self, model: Model) -> Model | None:
        """The model under correlated noise; None where the readings cannot tell, or noise is not white."""
        together = any(c.per == "reading" for e in model.effects for c in e.coefficients)
        fixed = any(name.startswith("noise.") for name, _ in model.fixed)
        if not self.readings.has("time") or len(self.readings) < FEWEST or together or fixed:
            return None
        if not isinstance(model.noise, White):
            return None
        frame = build_frame(
            self.readings, {**reference_of(self.readings), **(self.reference or {})}
        )
        steps = np.asarray(frame.step)
        if not (steps > 0).any():
            return None
        span = float(np.max(np.asarray(frame.columns["elapsed"])))
        return model.with_noise(over_record(model.noise, jnp.asarray(steps[steps > 0]), span))

    def _gain(self, step: Step, wide: Model) -> float:
        """Log evidence that correlated noise gains over white for a step's model."""
        with stage("asking whether the noise wanders"):
            widened = step.calibration.model.with_noise(wide.noise)
            return laplace_evidence(widened, step.calibration) - _evidence(step)


def _wrong_turn(steps: list[Step]) -> tuple[int, str] | None:
    """Where an effect with a name was preferred to an unknown function that explains more than all added since.

    One effect alone keeps its preference: real physics departs a little from the catalogue's form. Where several are
    needed and do not suffice, they only imitate.

    Returns:
        The step after which it was, and the function; None if there is none.
    """
    end = _evidence(steps[-1]) + STRONG
    for i, (step, following) in enumerate(pairwise(steps)):
        if step.discovery is None or following.added is None or i + 2 == len(steps):
            continue
        unknown = {c.effect for c in step.discovery.candidates if c.unknown}
        gains = {n: g for n, g in step.discovery.verified.items() if n in unknown}
        best = max(gains, key=gains.__getitem__, default=following.added)
        if best != following.added and _evidence(step) + gains[best] > end:
            return i, best
    return None


def _other_path(
    chosen: list[Step], noise: str, other: list[Step], behind: float
) -> OtherPath | None:
    """The path that was not chosen, if it ends elsewhere and is nearly as probable.

    Args:
        chosen, other: the paths' steps.
        noise: the other one's law.
        behind: log Bayes factor of its end against the chosen one.
    """
    here, there = (tuple(s.added for s in steps if s.added) for steps in (chosen, other))
    same = noise == chosen[-1].calibration.model.noise.law and set(here) == set(there)
    if same or behind < -STRONG:
        return None
    return OtherPath(noise, there, behind)


def _evidence(step: Step) -> float:
    return float(step.calibration.mode.log_evidence)
