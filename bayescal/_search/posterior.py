"""Posterior over structures: inclusion probabilities, sets of effects found to be missing, the structure to use."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import softmax

from bayescal._calibration.claim import Claim
from bayescal._core.settings import settings
from bayescal._search.structures import EvaluatedStructure, Structure, Structures

MAX_LISTED_STRUCTURES = 20  # number of structures in the summary of a search
NEGLIGIBLE_PROBABILITY = 1e-3  # probability of a structure below which no printed digit changes
# Probability that a named effect is the true one in a structure with a substantial unnamed effect.
NAME_PROBABILITY = 0.55


@dataclass(frozen=True)
class Finding:
    """A set of effects of which at least one, in some form, is missing with this probability."""

    effects: tuple[str, ...]
    probability: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior probabilities of the structures that have given effects; an effect has that of its family."""

    space: Structures
    condition: frozenset[str]  # effects that all structures have
    structures: tuple[Structure, ...]  # the most probable first
    log_posterior: np.ndarray  # log evidence plus log prior, unnormalised
    probability: np.ndarray
    evaluated: dict[Structure, EvaluatedStructure]

    @classmethod
    def from_structures(cls, structures: Structures, condition: Iterable[str] = ()) -> Posterior:
        """Compute the posterior over the structures that have the effects of a condition."""
        required = frozenset(condition)
        evaluated = {s: w for s, w in structures.visited.items() if math.isfinite(w.log_posterior)}
        evaluated = {s: w for s, w in evaluated.items() if not structures.is_special_case(s)}
        fitted = {s: w.log_posterior for s, w in evaluated.items()}
        max_total = max(total for s, total in fitted.items() if required <= s.effects)
        # A log posterior from a score may not exceed all fitted ones: the structure would have been fitted.
        scored = structures.scores.items()
        totals = {s: min(t, max_total) for s, t in scored if not structures.is_special_case(s)}
        totals |= fitted
        selected = [s for s in totals if required <= s.effects]
        selected = sorted(selected, key=lambda s: (-totals[s], s not in evaluated))
        total = np.array([totals[s] for s in selected])
        # Structures without fit or score have probability zero: the search covers all that could have any.
        weight = np.exp(total - total[0])
        return cls(structures, required, tuple(selected), total, weight / weight.sum(), evaluated)

    @cached_property
    def reported_families(self) -> tuple[frozenset[str], ...]:
        """Return, for each structure, the families of its effects and of their equivalents."""
        return tuple(map(self.space.reported_families, self.structures))

    @cached_property
    def family_shares(self) -> tuple[dict[str, float], ...]:
        """Return, for each structure, each family's share of its probability: equivalents share by their prior odds."""

        def compute_shares(s: Structure) -> dict[str, float]:
            sets, odds = self.space.spans.find_minimal_sets(s.effects), self.space.log_odds
            weights = softmax([sum(odds[n] for n in names) for names in sets])
            return _sum_by_name(map(self.space.families, sets), weights)

        return tuple(map(compute_shares, self.structures))

    @property
    def best(self) -> Structure:
        """Return the most probable structure that was fitted."""
        # A structure evaluated only by its score has no mode and cannot be used.
        return next(s for s in self.structures if s in self.evaluated)

    def completeness(self, unseen: Iterable[str] = ()) -> float:
        """Return the probability that no effect is missing except `unseen` ones and those of the condition.

        A structure is incomplete if an unnamed effect is not negligible, be it given, added, or correlated noise.
        """
        space, base_structure = self.space, Structure(self.condition)
        other_effects = {*unseen, *space.latent_effects(base_structure)}
        reported = space.reported_families(base_structure) | space.families(other_effects)
        triples = zip(self.structures, self.reported_families, self.has_unnamed, strict=True)
        is_named = [not has and f - space.unnamed_effects(s) <= reported for s, f, has in triples]
        fits = map(self.evaluated.get, self.structures)
        has_unnamed_noise = [fit is not None and fit.has_unnamed_noise for fit in fits]
        return self._sum_probability(np.array(is_named) & ~np.array(has_unnamed_noise))

    @cached_property
    def has_unnamed(self) -> list[bool]:
        """Return, for each structure, whether it has an unnamed effect that is not negligible."""

        def is_needed(s: Structure, probability: float) -> bool:
            fit, is_unnamed = self.evaluated.get(s), bool(self.space.unnamed_effects(s))
            is_unknown = fit is None or probability < NEGLIGIBLE_PROBABILITY
            return is_unnamed and (is_unknown or bool(self.space.substantial_unnamed(fit)))

        return [is_needed(*pairs) for pairs in zip(self.structures, self.probability, strict=True)]

    def law_probability(self, name: str) -> float:
        """Return the probability of a noise law."""
        return self._sum_probability([s.noise == name for s in self.structures])

    def inclusion_probability(self, *names: str) -> float:
        """Return the posterior inclusion probability: that the structure has at least one of these effects."""
        # At least one: probabilities of structures are added, not those of effects, which are not independent.
        return self._sum_probability(self._has_any(self.space.families(names)))

    def _has_any(self, families: frozenset[str]) -> list[bool]:
        return [not families.isdisjoint(reported) for reported in self.reported_families]

    def probability_of_names(self, *names: str) -> float:
        """Return the probability that at least one of these effects is missing, and that its name is the right one.

        A single effect has only its share of the probability of its equivalents, which readings cannot tell apart.
        """
        families = self.space.families(names)
        family, *others = families
        single_shares = (shares.get(family, 0.0) for shares in self.family_shares)
        name_shares = np.array(self._has_any(families) if others else [*single_shares], dtype=float)
        if not any(self.space.candidates[n].unnamed for n in names if n in self.space.candidates):
            name_shares = np.where(self.has_unnamed, NAME_PROBABILITY, 1.0) * name_shares
        return float(min(1.0, self.probability @ name_shares))

    @cached_property
    def _form_probability(self) -> dict[str, float]:
        """Return the inclusion probability of each form, by name."""
        return _sum_by_name([s.effects for s in self.structures], self.probability)

    def most_probable_form(self, name: str) -> str:
        """Return the most probable form of a family; the family's name if no structure has a form of it."""
        probabilities = self._form_probability
        forms = [n for n in probabilities if self.space.family(n) == name]
        return max(forms, key=probabilities.__getitem__, default=name)

    def _sum_probability(self, mask: Sequence[bool] | np.ndarray) -> float:
        return float(min(1.0, self.probability[np.array(mask, dtype=bool)].sum()))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return the smallest sets of effects of which at least one is missing with `found_probability`.

        Each set has an effect of the most probable structure and its substitutes, in order of probability.
        """
        findings, equivalents = [], self.space.equivalents_by_effect(self.best)
        # Greedy: each step adds the effect with the highest probability in structures without any member so far.
        for effect in self.best.effects - self.condition:
            name = self.space.family(effect)
            members = [name, *sorted(self.space.families(equivalents[effect]) - {name})]
            while self.inclusion_probability(*members) < settings().found_probability:
                substitute = self._find_next_substitute(members)
                if substitute is None:
                    break
                members.append(substitute)
            if self.inclusion_probability(*members) >= settings().found_probability:
                sets = [self.space.families(s.effects) for s in self.structures]
                shares = {n: self._sum_probability([n in f for f in sets]) for n in members}
                order = sorted(members, key=lambda n: -shares[n])
                findings.append(Finding(tuple(order), self.probability_of_names(*members)))
        findings.sort(key=lambda f: (-self.inclusion_probability(f.effects[0]), len(f.effects)))
        return tuple(findings)

    def _find_next_substitute(self, members: list[str]) -> str | None:
        """Return the most probable effect in structures with none of a finding's `members`; None if there is none."""
        # Effects of the condition, effects latent in it and the other effects of the best structure are excluded.
        given_effects = self.condition | self.space.latent_effects(Structure(self.condition))
        best_families, condition = map(self.space.families, (self.best.effects, given_effects))
        excluded_families, sets = (best_families - {members[0]}) | condition, self.reported_families
        others = [s - excluded_families if s.isdisjoint(members) else frozenset() for s in sets]
        probabilities = _sum_by_name(others, self.probability)
        return max(probabilities, key=probabilities.__getitem__, default=None)

    @property
    def median_structure(self) -> Structure:
        """Return the median probability model, with effects selected one after another.

        An effect is chosen if its inclusion probability, given the effects chosen before, is above one half. If none of
        a finding is chosen, its effect in the most probable structure is added. The noise law is that of the most
        probable structure with all chosen effects. A chosen effect need not reach the probability to be called missing.
        Source: M. Barbieri and J. Berger, Ann. Statist. 32 (2004) 870 (the median probability model predicts best).
        """
        effects = frozenset(self.condition)
        candidates = list(zip(self.structures, self.probability.tolist(), strict=True))
        while True:
            # Inclusion given the chosen effects: else two substitutes of one half each would both be out.
            sets, masses = [s.effects - effects for s, _ in candidates], [p for _, p in candidates]
            form_mass = _sum_by_name(sets, masses)
            family_mass = _sum_by_name(map(self.space.families, sets), masses)
            family = max(family_mass, key=lambda n: (family_mass[n], n), default="")
            if not family or family_mass[family] <= 0.5 * sum(masses):
                break
            forms = [n for n in form_mass if self.space.family(n) == family]
            form = max(forms, key=lambda n: (form_mass[n], n))
            effects |= {form}
            candidates = [(s, p) for s, p in candidates if form in s.effects]
        for finding in self.findings:
            if not self.space.families(effects).intersection(finding.effects):
                effects |= {n for n in self.best.effects if self.space.family(n) in finding.effects}
        law = next((s for s in self.structures if s.effects >= effects), self.best).noise
        return Structure(effects, law)


def _sum_by_name(sets: Iterable[frozenset[str]], probability: Iterable[float]) -> dict[str, float]:
    """Return, for each name, the total probability of the sets that contain it."""
    sums = dict[str, float]()
    for names, p in zip(sets, probability, strict=True):
        for name in names:
            sums[name] = sums.get(name, 0.0) + float(p)
    return sums


@dataclass(frozen=True)
class OtherPath:
    """The runner-up model: the best under another noise law, if these readings do not decide between the laws."""

    noise: str  # name of the other law
    added: tuple[str, ...]  # effects added under the other law
    log_bayes_factor: float  # runner-up over best model, natural logarithm; negative
    in_words: str  # the other law, in words
    correlated: bool = False  # whether exactly one of the two laws is correlated in time

    def __str__(self) -> str:
        details = {"law": self.in_words, "added": self.added or ("nothing",)}
        cure = "correlated" if self.correlated else "other"
        return str(Claim("path.other", **details, nats=self.log_bayes_factor, cure=cure))


@dataclass(frozen=True)
class StructureSummary:
    """A structure in the summary of a search: added effects, noise law ("" for the given one), and probability.

    `rms`, the rms residual in the output unit, is given for the most probable structure only.
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
    """State of a search, running or ended."""

    structures: tuple[StructureSummary, ...]  # the most probable ones
    weighed: int  # number of evaluated structures
    complete: bool  # whether the search was completed
    stopped: str = ""  # why it ended early; empty while it is running and if it was completed
    seconds: float = 0.0  # time since it began, s
    max_effects: int | None = None  # largest number of effects that it may add

    @classmethod
    def summarise(cls, structures: Structures, *, complete: bool, **fields: Any) -> Search:
        """Summarise the structures evaluated so far; `fields` are the other fields."""
        fits, summaries = structures.visited.values(), list[StructureSummary]()
        if any(math.isfinite(w.log_posterior) for w in fits):
            posterior = Posterior.from_structures(structures)
            pairs = zip(posterior.structures, posterior.probability, strict=True)
            fitted = [(posterior.evaluated[s], p) for s, p in pairs if s in posterior.evaluated]
            rms = float(np.sqrt(np.mean(structures.linearise(fitted[0][0]).residual ** 2)))
            for w, p in fitted[:MAX_LISTED_STRUCTURES]:
                effects, noise = tuple(sorted(w.structure.effects)), w.structure.noise
                summaries.append(StructureSummary(effects, noise, w.log_evidence, float(p)))
            summaries[0] = replace(summaries[0], rms=rms)
        return cls(tuple(summaries), len(fits), complete, **fields)
