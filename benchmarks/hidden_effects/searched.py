"""Search of one record as by `calibrate`, without its fits and checks; errors of structures on a second record."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._data.set_aside import exclude_faults
from bayescal._inference.density import Density
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from bayescal._search.discover import enumerate_structures
from bayescal._search.posterior import Finding, Posterior
from bayescal._search.scores import Library
from bayescal._search.structures import EvaluatedStructure, Structure, Structures
from bayescal._search.walk import explore

MOST = 5  # effects, as by default


@dataclass(eq=False)
class Searched:
    """A record and the result of its search.

    Attributes:
        model: the baseline.
        readings: readings without spikes.
        structures: the evaluated structures.
        library: its candidates.
    """

    model: bc.Model
    readings: bc.Measurements
    structures: Structures
    library: Library

    @classmethod
    def of(cls, model: bc.Model, readings: bc.Measurements, widen_noise: bool = True) -> Searched:
        """Search a record to the end."""
        readings = exclude_faults(readings)
        structures, _ = enumerate_structures(
            model, readings, reference_of(readings), widen_noise=widen_noise
        )
        library = Library(structures)
        explore(library, MOST)
        return cls(model, readings, structures, library)

    @property
    def base(self) -> EvaluatedStructure:
        return self.structures.evaluate(Structure())

    @cached_property
    def posterior(self) -> Posterior:
        """Return the posterior over the structures that the search evaluated, without those evaluated later."""
        return Posterior.from_structures(self.structures)

    @cached_property
    def chosen(self) -> Structure:
        return self.posterior.median_structure

    @property
    def sets(self) -> tuple[Finding, ...]:
        return self.posterior.findings

    @property
    def probabilities(self) -> dict[str, float]:
        """Return each candidate's probability of being missing."""
        return {name: self.posterior.probability_of_names(name) for name in self.structures.forms}

    def reported_names(self, structure: Structure) -> list[str]:
        """Return a structure's effects by the names of their families."""
        return sorted(self.structures.families(structure.effects))

    def error(self, structure: Structure, later: Later) -> float:
        """Return a structure's root mean square error on a second record of unseen runs."""
        weighed = self.structures.evaluate(structure)
        return later.error(weighed)


@dataclass(eq=False)
class Later:
    """A second record, in terms of the first: its group members are new, its axes are not.

    Attributes:
        record: the second record with its own members.
        known: the same, with members identified with those of the first record that have the same name.
    """

    record: Record
    known: Record

    @classmethod
    def of(cls, searched: Searched, readings: bc.Measurements) -> Later:
        first, remainder = searched.structures.record, exclude_faults(readings)
        levels = bind(searched.model, searched.readings)[1]
        frame = build_frame(remainder, reference_of(searched.readings), levels)
        new = {g: c if g == "axis" else -jnp.ones_like(c) for g, c in frame.codes.items()}
        unseen = eqx.tree_at(lambda f: f.codes, frame, new)
        y = np.asarray(remainder["output"])
        records = (Record(first.instrument, f, y) for f in (unseen, frame))
        return cls(*records)

    def expected(self, weighed: EvaluatedStructure) -> np.ndarray:
        """Return a structure's expected output on the record."""
        mode = weighed.mode
        _, posterior = Density(weighed.problem, mode.x, mode.flat).condition_at(mode.v)
        x = mode.x if posterior is None else posterior.mean
        later_problem = Problem(weighed.problem.layout, self.record, weighed.problem.size_factors)
        return later_problem.linearise(x, later_problem.hyper(mode.v)).mean

    def error(self, weighed: EvaluatedStructure) -> float:
        return float(np.sqrt(np.mean((self.record.y - self.expected(weighed)) ** 2)))


def noise_of(model: bc.Model, readings: bc.Measurements) -> float:
    """Return the standard deviation of the baseline's white noise."""
    structures, _ = enumerate_structures(model, readings, reference_of(readings), widen_noise=False)
    base = structures.evaluate(Structure())
    return base.problem.hyper(base.mode.v)["noise.white"]
