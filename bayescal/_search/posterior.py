"""The posterior over structures: inclusion probabilities, findings with their substitutes, the structure to use."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import softmax

from bayescal._calibration.claim import Claim
from bayescal._core.settings import settings
from bayescal._search.structures import Structure, Structures, Weighed

SHOWN_STRUCTURES = 20  # structures kept of a search
NEXT_TO_NOTHING = 1e-3  # probability of a structure, which moves no digit of what is printed
# Probability that a name is right beside a description without a name that is needed (docs/wrong_model.md).
NAME_BESIDE_DESCRIPTION = 0.55


@dataclass(frozen=True)
class Finding:
    """One of these effects, each in some form, is missing; the readings cannot tell which."""

    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Structures that hold the effects given, the most probable first: refitted ones, and others by what was expected.

    An effect that is asked for is asked for in all forms of its family. `total` is log evidence and log prior.
    """

    space: Structures
    condition: frozenset[str]
    structures: tuple[Structure, ...]
    total: np.ndarray
    probability: np.ndarray
    refitted: dict[Structure, Weighed]

    @classmethod
    def of(cls, structures: Structures, condition: Iterable[str] = ()) -> Posterior:
        required = frozenset(condition)
        refitted = {s: w for s, w in structures.visited.items() if math.isfinite(w.total)}
        refitted = {s: w for s, w in refitted.items() if not structures.is_special_case(s)}
        most = max((w.total for s, w in refitted.items() if required <= s.effects))
        # What was only expected may not lead: it would have been refitted.
        expected = structures.expected.items()
        totals = {s: min(t, most) for s, t in expected if not structures.is_special_case(s)}
        totals |= {s: w.total for s, w in refitted.items()}
        inside = [s for s in totals if required <= s.effects]
        inside = sorted(inside, key=lambda s: (-totals[s], s not in refitted))
        total = np.array([totals[s] for s in inside])
        # What was never weighed nor expected has no probability: the walk looks wherever there could be any.
        weight = np.exp(total - total[0])
        return cls(structures, required, tuple(inside), total, weight / weight.sum(), refitted)

    @cached_property
    def reported(self) -> tuple[frozenset[str], ...]:
        """Return, of each structure, the families of its effects and of their equivalents."""
        return tuple(map(self.space.reported, self.structures))

    @cached_property
    def shares(self) -> tuple[dict[str, float], ...]:
        """Return the probability of each family given each structure: of its equivalents, by their prior odds."""

        def shares_in(s: Structure) -> dict[str, float]:
            sets, odds = self.space.spans.generators(s.effects), self.space.log_odds
            weights = softmax([sum(odds[n] for n in names) for names in sets])
            return _mass(map(self.space.families, sets), weights)

        return tuple(map(shares_in, self.structures))

    @property
    def best(self) -> Structure:
        """Return the most probable refitted structure."""
        # A structure that was only expected has no mode, and cannot be used.
        return next(s for s in self.structures if s in self.refitted)

    def complete(self, unseen: Iterable[str] = ()) -> float:
        """Return the probability that the given effects are all that is there, under any noise law.

        A structure is not complete where a description, given, added or of the noise, carries more than a small part.
        """
        structures, conditioned = self.space, Structure(self.condition)
        further = {*unseen, *structures.latent(conditioned)}
        reported = structures.reported(conditioned) | structures.families(further)
        triples = zip(self.structures, self.reported, self.described, strict=True)
        laws = [s in self.refitted and self.refitted[s].noise_describes for s in self.structures]
        named = [not d and f - structures.unnamed(s) <= reported for s, f, d in triples]
        return self._of_any([n and not law for n, law in zip(named, laws, strict=True)])

    @cached_property
    def described(self) -> list[bool]:
        """Return whether each structure needs a description of something without a name."""

        def needed(s: Structure, probability: float) -> bool:
            weighed = self.refitted.get(s)
            unknown = weighed is None or probability < NEXT_TO_NOTHING
            return bool(self.space.unnamed(s)) and (unknown or bool(self.space.matters(weighed)))

        return [needed(*pairs) for pairs in zip(self.structures, self.probability, strict=True)]

    def noise(self, name: str) -> float:
        """Return the probability of a noise law."""
        return self._of_any([s.noise == name for s in self.structures])

    def inclusion(self, *names: str) -> float:
        """Return the probability that at least one of these effects is missing."""
        # At least one: probabilities of structures are added, not those of effects, which are not independent.
        return self._of_any(self._has_any(self.space.families(names)))

    def _has_any(self, families: frozenset[str]) -> list[bool]:
        return [not families.isdisjoint(reported) for reported in self.reported]

    def probability_of_names(self, *names: str) -> float:
        """Return the probability that at least one of these effects is missing, and is what its name says.

        Of one alone only its share among equivalents counts: readings cannot tell which of them it is.
        """
        families = self.space.families(names)
        family, *others = families
        alone = (shares.get(family, 0.0) for shares in self.shares)
        parts = np.array(self._has_any(families) if others else [*alone], dtype=float)
        if not any(self.space.candidates[n].unnamed for n in names if n in self.space.candidates):
            parts = np.where(self.described, NAME_BESIDE_DESCRIPTION, 1.0) * parts
        return float(min(1.0, self.probability @ parts))

    @cached_property
    def _of_forms(self) -> dict[str, float]:
        """Return the probability of each candidate."""
        return _mass([s.effects for s in self.structures], self.probability)

    def form(self, name: str) -> str:
        """Return the most probable form of a family; its own name where no structure has any."""
        mass = self._of_forms
        forms = [n for n in mass if self.space.family(n) == name]
        return max(forms, key=mass.__getitem__, default=name)

    def _of_any(self, inside: Sequence[bool]) -> float:
        return float(min(1.0, self.probability[np.array(inside, dtype=bool)].sum()))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return the smallest sets of effects of which one is missing with `found_probability`.

        Each begins with an effect of the most probable structure and goes on with what can take its place.
        """
        findings, rivals = [], self.space.rivals(self.best)
        # Greedy: each step takes the effect with the most probability of structures without any member so far.
        for effect in self.best.effects - self.condition:
            name = self.space.family(effect)
            members = [name, *sorted(self.space.families(rivals[effect]) - {name})]
            while self.inclusion(*members) < settings().found_probability:
                further = self._substitute(members)
                if further is None:
                    break
                members.append(further)
            if self.inclusion(*members) >= settings().found_probability:
                by_structure = [self.space.families(s.effects) for s in self.structures]
                share = {n: self._of_any([n in f for f in by_structure]) for n in members}
                order = sorted(members, key=lambda n: -share[n])
                findings.append(Finding(tuple(order), self.probability_of_names(*members)))
        findings.sort(key=lambda f: (-self.inclusion(f.effects[0]), len(f.effects)))
        return tuple(findings)

    def _substitute(self, members: list[str]) -> str | None:
        """Return the most probable effect of structures that have none of the members."""
        # Effects that are in for other reasons are nobody's substitutes.
        best, condition = map(self.space.families, (self.best.effects, self.condition))
        settled = (best - {members[0]}) | condition
        others = [r - settled if r.isdisjoint(members) else frozenset() for r in self.reported]
        mass = _mass(others, self.probability)
        return max(mass, key=mass.__getitem__, default=None)

    @property
    def chosen(self) -> Structure:
        """Return the structure to use: effects more probable in than out, given those chosen before.

        Of effects that one of is found, and none is in so, the most probable structure's is. What is used need not be
        found: that is for the word "missing". The noise law is that of the most probable structure that has all of it.
        Source: M. Barbieri and J. Berger, Ann. Statist. 32 (2004) 870 (the median probability model predicts best).
        """
        effects = frozenset(self.condition)
        inside = list(zip(self.structures, self.probability.tolist(), strict=True))
        while True:
            # Conditional inclusion: of the structures that hold what was chosen so far, the effect that most of them
            # have, then its form. Without the condition two substitutes of one half each would both be out.
            further, masses = [s.effects - effects for s, _ in inside], [p for _, p in inside]
            of_form = _mass(further, masses)
            share = _mass(map(self.space.families, further), masses)
            likely = max(share, key=lambda n: (share[n], n), default="")
            if not likely or share[likely] <= 0.5 * sum(masses):
                break
            forms = [n for n in of_form if self.space.family(n) == likely]
            likeliest = max(forms, key=lambda n: (of_form[n], n))
            effects |= {likeliest}
            inside = [(s, p) for s, p in inside if likeliest in s.effects]
        for finding in self.findings:
            if not self.space.families(effects).intersection(finding.effects):
                effects |= {n for n in self.best.effects if self.space.family(n) in finding.effects}
        law = next((s for s in self.structures if s.effects >= effects), self.best).noise
        return Structure(effects, law)


def _mass(sets: Iterable[frozenset[str]], probability: Iterable[float]) -> dict[str, float]:
    """Return the probability of the sets that each name is in."""
    mass = dict[str, float]()
    for names, p in zip(sets, probability, strict=True):
        for name in names:
            mass[name] = mass.get(name, 0.0) + float(p)
    return mass


@dataclass(frozen=True)
class OtherPath:
    """The runner-up model: where the search ends under another noise law, if these readings do not decide."""

    noise: str  # that law
    added: tuple[str, ...]  # what was added under it
    log_bayes_factor: float  # of that end against the trail's own, natural logarithm; negative
    in_words: str  # that law, in words
    correlated: bool = False  # whether one of the two laws alone is correlated in time

    def __str__(self) -> str:
        details = {"law": self.in_words, "added": self.added or ("nothing",)}
        cure = "correlated" if self.correlated else "other"
        return str(Claim("path.other", **details, nats=self.log_bayes_factor, cure=cure))


@dataclass(frozen=True)
class ShownStructure:
    """A structure as a search leaves it: what it adds, its noise law ("" for the one given), how probable it is.

    The error as fitted, output unit, is said of the most probable one alone.
    """

    effects: tuple[str, ...]
    noise: str
    log_evidence: float
    probability: float
    rms: float | None = None

    def __str__(self) -> str:
        parts = [*([f"{self.noise} noise"] if self.noise else []), *self.effects]
        return "+ " + " + ".join(parts) if parts else "nothing to add"


@dataclass(frozen=True)
class Search:
    """How a search stands, or how it ended."""

    structures: tuple[ShownStructure, ...]  # the most probable ones
    weighed: int  # how many were
    complete: bool  # whether it came to its end
    stopped: str = ""  # why it did not, in words; empty where it did, or goes on
    seconds: float = 0.0  # since it began
    max_effects: int | None = None  # most effects that it may add

    @classmethod
    def of(cls, structures: Structures, *, complete: bool, **counts: Any) -> Search:
        """Summarise the structures evaluated so far; `counts` are the other fields."""
        weighed, summaries = structures.visited.values(), ()
        if any(math.isfinite(w.total) for w in weighed):
            posterior = Posterior.of(structures)
            pairs = zip(posterior.structures, posterior.probability, strict=True)
            refitted = [(posterior.refitted[s], p) for s, p in pairs if s in posterior.refitted]
            rms = float(np.sqrt(np.mean(structures.line(refitted[0][0]).residual ** 2)))
            summaries = tuple(
                ShownStructure(
                    effects=tuple(sorted(w.structure.effects)),
                    noise=w.structure.noise,
                    log_evidence=w.log_evidence,
                    probability=float(p),
                    rms=None if i else rms,
                )
                for i, (w, p) in enumerate(refitted[:SHOWN_STRUCTURES])
            )
        return cls(summaries, len(weighed), complete, **counts)
