"""The posterior over structures: inclusion probabilities, findings with their substitutes, the structure to use."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bayescal._discovery.structures import Structure, Structures, Weighed

FOUND = 0.95  # probability from which something is reported as found
RIVAL = math.log(20)  # log odds within which exchanging one effect for another keeps a structure


@dataclass(frozen=True)
class Found:
    """One of these effects is missing; the readings cannot tell which."""

    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Structures that hold some effects, with their probabilities: refitted ones, and others by what was expected.

    Attributes:
        given: effects that all of them hold.
        structures: the most probable first.
        total: log evidence and log prior of each.
        probability: of each.
        refitted: those of them that were refitted.
    """

    given: frozenset[str]
    structures: tuple[Structure, ...]
    total: np.ndarray
    probability: np.ndarray
    refitted: dict[Structure, Weighed]

    @classmethod
    def of(cls, structures: Structures, given: Iterable[str] = ()) -> Posterior:
        held = frozenset(given)
        refitted = {s: w for s, w in structures.visited.items() if math.isfinite(w.total)}
        best = max((w.total for s, w in refitted.items() if held <= s.effects))
        # What was only expected may not lead: it would have been refitted.
        totals = {s: min(t, best) for s, t in structures.expected.items()}
        totals |= {s: w.total for s, w in refitted.items()}
        inside = [s for s in totals if held <= s.effects]
        inside = sorted(inside, key=lambda s: (-totals[s], s not in refitted))
        total = np.array([totals[s] for s in inside])
        weight = np.exp(total - total[0])
        return cls(held, tuple(inside), total, weight / weight.sum(), refitted)

    @property
    def best(self) -> Structure:
        """The most probable of those refitted."""
        return next(s for s in self.structures if s in self.refitted)

    @property
    def nothing(self) -> float:
        """Probability that nothing beyond the given is missing, under either noise law."""
        return self.of_any(lambda s: s.effects == self.given)

    @property
    def wanders(self) -> float:
        """Probability that the noise wanders."""
        return self.of_any(lambda s: s.wanders)

    def inclusion(self, *names: str) -> float:
        """Probability that at least one of these effects is missing."""
        wanted = set(names)
        return self.of_any(lambda s: not wanted.isdisjoint(s.effects))

    def of_any(self, holds) -> float:
        inside = [bool(holds(s)) for s in self.structures]
        return float(min(1.0, self.probability[inside].sum()))

    @property
    def findings(self) -> tuple[Found, ...]:
        """Smallest sets of effects of which at least one is missing, with probability `FOUND`, the most probable first.

        Each begins with an effect of the most probable structure and goes on with what can take its place.
        """
        best = self.best
        found = []
        for name in best.effects - self.given:
            members = [name]
            for other in self._substitutes(best, name):
                if self.inclusion(*members) >= FOUND:
                    break
                members.append(other)
            if self.inclusion(*members) >= FOUND:
                order = sorted(members, key=lambda n: -self.inclusion(n))
                found.append(Found(tuple(order), self.inclusion(*members)))
        return tuple(sorted(found, key=lambda f: (-self.inclusion(f.effects[0]), len(f.effects))))

    def _substitutes(self, best: Structure, name: str) -> list[str]:
        """Effects that may stand in an effect's place, the most probable first."""
        rest, least = best.effects - {name}, self.refitted[best].total - RIVAL
        totals: dict[str, float] = {}
        for s, total in zip(self.structures, self.total, strict=True):
            other = s.effects - rest
            if rest <= s.effects and len(other) == 1 and total > least:
                (own,) = other
                totals[own] = max(float(total), totals.get(own, -math.inf))
        totals.pop(name, None)
        return sorted(totals, key=lambda n: -totals[n])

    @property
    def chosen(self) -> Structure:
        """The structure to use: the most probable, without what is not found."""
        best = self.best
        kept = {n for n in best.effects if any(n in f.effects for f in self.findings)}
        return Structure(frozenset(kept) | self.given, best.wanders)
