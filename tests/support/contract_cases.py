"""What the contract suite asks of an instrument, compiled and fitted once for all its checks."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
import bayescal_models
from bayescal._model import forward
from bayescal._model.model import why_untestable
from bayescal._model.parameters import Layout, bind
from benchmarks.accuracy import reference_posteriors
from tests.support import references
from tests.support.inside import frame_of

STEP = 1e-3  # of the finite differences, prior standard deviations
SEED = 17


@dataclass(eq=False)
class Bound:
    """A model bound to readings at a point drawn from its priors, φ at its prior medians."""

    layout: Layout
    frame: bc.Frame
    x: jax.Array
    v: jax.Array

    @classmethod
    def of(cls, model: bc.Model, readings: bc.Measurements) -> Bound:
        layout, _ = bind(model, readings)
        frame = frame_of(readings)
        random, v = np.random.default_rng(SEED), jnp.zeros(len(layout.hypers))
        sd = forward.prior_sd(layout, layout.hyper(v))
        x = layout.mean_of_x + sd * random.standard_normal(layout.size)
        return cls(layout, frame, x, v)

    @property
    def hyper(self) -> forward.Values:
        return self.layout.hyper(self.v)


@eqx.filter_jit
def differences(layout: Layout, frame, x, v) -> tuple[Any, jax.Array, jax.Array]:
    """Linearised form, prior sd of x, and central differences by x."""
    hyper = layout.hyper(v)
    sd = forward.prior_sd(layout, hyper)

    def by(push):
        return forward.predict_moments(layout, frame, x + STEP * push * sd, hyper)[0]

    def along(one):
        return (by(one) - by(-one)) / (2 * STEP)

    columns = jax.lax.map(along, jnp.eye(layout.size)).T
    return forward.linearise(layout, frame, x, hyper), sd, columns


class Case:
    """One instrument: its folder, its reference problem, and the fits that several checks share."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.module: ModuleType = import_module(f"bayescal_models.{name}")
        self.offered: bc.Instrument = self.module.INSTRUMENT

    def __repr__(self) -> str:
        return self.name

    @property
    def folder(self) -> Path:
        return Path(bayescal_models.__file__).parent / self.name

    @cached_property
    def problem(self) -> ModuleType:
        return import_module(f"bayescal_models.{self.name}").reference_problem

    @cached_property
    def model(self) -> bc.Model:
        return self.problem.model()

    @cached_property
    def readings(self) -> bc.Measurements:
        return self.problem.readings(seed=0)

    @property
    def instrument(self) -> bc.Instrument:
        """The instrument of the reference problem: where it has to be tailored, it is."""
        return self.model.instrument

    @cached_property
    def structural(self) -> tuple[bc.Effect, ...]:
        """Effects that only the instrument's further model structures hold."""
        own = {e.name for e in self.own_effects}
        made = [effect for _, make in self.instrument.structures for effect in make().effects]
        return tuple({e.name: e for e in made if e.name not in own}.values())

    @property
    def own_effects(self) -> tuple[bc.Effect, ...]:
        """Baseline, candidates, and of their forms those that have a name of their own."""
        known = self.instrument.known.items()
        return tuple(e for name, e in known if not name.startswith(f"{e.family}."))

    @cached_property
    def wide(self) -> bc.Model:
        """The problem's model with every candidate that its readings can test."""
        return self.model + [
            e
            for e in self.instrument.candidates
            if e.name not in self.model.names and why_untestable(e, self.readings) is None
        ]

    @cached_property
    def bound(self) -> Bound:
        return Bound.of(self.wide, self.readings)

    @cached_property
    def differences(self):
        b = self.bound
        return jax.tree.map(np.asarray, differences(b.layout, b.frame, b.x, b.v))

    @cached_property
    def reference(self) -> dict[str, Any]:
        """The reference posterior of the reference problem."""
        return json.loads((self.folder / "reference_posterior.json").read_text("utf-8"))

    @cached_property
    def marginal(self) -> bc.Calibration:
        return references.marginal(self.name)

    @cached_property
    def least_squares(self) -> bc.Calibration:
        return references.calibration(self.name)

    @property
    def hide(self) -> Callable[..., bc.Measurements]:
        """`hide(effects, seed=…)`: a campaign in which each candidate can show itself."""
        return getattr(self.problem, "simulate_effects", None) or self.instrument.simulate


def columns_of(calibration: bc.Calibration) -> dict[str, np.ndarray]:
    """Draws (chains, draws) of every unknown; members of a group each by number, as in reference_posterior.json."""
    found = reference_posteriors.columns_of(calibration.layout, calibration.values)
    return {name: draws for name, (draws, _) in found.items()}
