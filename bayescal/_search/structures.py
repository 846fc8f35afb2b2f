"""Structures, sets of added effects with a noise law: their prior probabilities and their evidence.

Candidates are included independently, with prior odds such that P(model complete) is one half: unknown dependences
take a tenth of −log P(complete), the named candidates the rest. A candidate is a family of forms, which share its odds;
a structure has one of them at most. Plausible sizes are known to an order of magnitude: evidence is averaged over 1, 3
and 10 times these. Effects that readings cannot distinguish from a structure's are latent in its model, with priors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from bayescal._calibration.judgement import may_hide_effect
from bayescal._core import deadline
from bayescal._core.null_space import Spans
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.laplace import FoundMode, Mode, find_mode
from bayescal._inference.linear_model import LinearModel, linearise_model
from bayescal._inference.means import Means
from bayescal._inference.newton import HessianGuess
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.effect import Effect, list_forms
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import Layout
from bayescal._model.terms import Correction
from bayescal._search.noise_laws import NO_FIT, ResidualFit, fit_to_residuals, log_prior

# Share of unnamed effects in the prior probability of missing effects: a known formula is likelier than an unknown one.
UNNAMED_PRIOR_SHARE = 0.1
# Largest rms of an unnamed effect, in units of the noise, with which a model is complete: the noise grows by 1/50.
MAX_UNNAMED_RMS = 0.2
# Nats behind the best up to which a structure is fitted (Occam's window: D. Madigan, A. Raftery, JASA 89 (1994) 1535).
OCCAM_WINDOW_NATS = 6.0
# Nats of log posterior behind the best, from which a structure under another noise law is not fitted.
LAW_WINDOW_NATS = 100.0
# Nats of log posterior behind the best, from which a mode is found coarsely: its effect on probabilities is below 1e-6.
COARSE_NATS = 10.0
# Factors on a candidate's plausible size, known to an order of magnitude, with their prior probabilities: coefficients
# of a real sensor in a chamber were 3 to 8 such sizes.
SIZE_FACTORS = {1.0: 0.6, 3.0: 0.3, 10.0: 0.1}
# Prior standard deviation of a coefficient averaged over these factors, in plausible sizes.
RMS_SCALE_FACTOR = math.sqrt(sum(p * factor**2 for factor, p in SIZE_FACTORS.items()))

FORM_ROWS = 700  # block means of a longer record, on which forms of an effect are compared
XTOL_SD = 0.03  # standard deviations to which a mode is found: its log evidence to 1e-3


@dataclass(frozen=True)
class Structure:
    """A set of added effects, and the name of a noise law; "" for the noise law of the given model."""

    effects: frozenset[str] = frozenset()
    noise: str = ""

    def with_effects(self, *names: str) -> Structure:
        return replace(self, effects=self.effects | set(names))

    def without_effects(self, *names: str) -> Structure:
        return replace(self, effects=self.effects - set(names))

    def with_noise(self, noise: str) -> Structure:
        return replace(self, noise=noise)


@dataclass(frozen=True, eq=False)
class EvaluatedStructure:
    """A structure with its evidence, its prior probability, and the posterior mode of its model."""

    structure: Structure
    log_evidence: float  # by the Laplace approximation, averaged over prior scales
    log_prior: float  # log prior odds of the structure against the base
    problem: Problem  # its model on the readings, at the most probable prior scales
    mode: Mode  # posterior mode of `problem`

    @property
    def log_posterior(self) -> float:
        """Return log evidence plus log prior: the unnormalised log posterior probability of the structure."""
        return self.log_evidence + self.log_prior

    def is_in_window_of(self, best: EvaluatedStructure) -> bool:
        return self.log_posterior > best.log_posterior - OCCAM_WINDOW_NATS

    @property
    def model(self) -> Model:
        return self.problem.layout.model

    @property
    def phi(self) -> FoundMode:
        """Return shape parameters, noise parameters and between-group standard deviations at the mode, by name."""
        return FoundMode(self.problem, self.mode)

    @property
    def has_unnamed_noise(self) -> bool:
        """Return whether the correlated noise is so slow and large that it represents an unnamed effect."""
        noise = self.problem.noise
        return not noise.independent and may_hide_effect(noise, self.phi)

    @cached_property
    def column_corrections(self) -> dict[Correction, tuple[float, ...]]:
        """Return the corrections of columns (such as a body's temperature) with their shape parameters at the mode."""
        phi, corrections = self.phi, (c for t in self.problem.terms for c in t.columns.corrections)
        return {c: tuple(phi[n] for n in c.spec.names) for c in corrections}

    def log_density_along(self, name: str, v: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """Return the log density of φ for coordinates v of the entry `name`, with all other entries at the mode."""
        points = np.tile(self.mode.v, (len(v), 1))
        points[:, self.problem.layout.index_in_phi[name]] = v
        return Density(self.problem, self.mode.x, self.mode.flat, self.mode.v).values(points)

    @property
    def sized_model(self) -> Model:
        """Return the model with the most probable prior scales of the instrument's own effects."""
        model = self.model
        candidates = {e.name for e in list_forms(model.instrument.candidates)}
        for name, factor in (self.problem.size_factors or {}).items():
            coefficient = model.effect(name).coefficients[0]
            if factor != 1.0 and name in candidates and not coefficient.flat:
                model = model.resize(name, factor * coefficient.size)
        return model


@dataclass(eq=False)
class Structures:
    """The candidate structures of one model on one record, and those evaluated so far."""

    base: Model  # the model that effects are added to
    layout: Layout  # of the base, with the numbers of group members
    record: Record  # the readings
    candidates: Mapping[str, Effect]  # effects that may be added, by name
    noise_laws: Mapping[str, Noise]  # further noise laws to evaluate, by name
    stated_log_odds: Mapping[str, float] = field(default_factory=dict)  # given for some candidates
    noise_floor: float = 0.0  # noise that no model removes, output unit
    spans: Spans = field(default_factory=Spans)  # candidates that these readings cannot separate
    # structures evaluated with other prior ranges of shapes: fits start at their modes
    previous_round: Mapping[Structure, EvaluatedStructure] = field(default_factory=dict)
    # whether forms without a score, and other noise laws, are evaluated near the best structure only
    near_best_only: bool = False
    visited: dict[Structure, EvaluatedStructure] = field(default_factory=dict)
    scores: dict[Structure, float] = field(default_factory=dict)  # log posteriors from scores
    experiments: dict[Any, Any] = field(default_factory=dict)  # that separate equivalent effects

    @cached_property
    def log_odds(self) -> dict[str, float]:
        """Return the prior log odds that each candidate, in its form, is missing."""
        forms = self.forms.values()
        unnamed = [f for f in forms if self.candidates[f[0]].is_placeholder]
        named = [f for f in forms if not self.candidates[f[0]].is_placeholder]
        share = UNNAMED_PRIOR_SHARE if named else 1.0
        log_odds = {}
        for families, portion in ((unnamed, share), (named, 1 - share if unnamed else 1.0)):
            for names in families:
                # k candidates of odds o are all out with probability (1 + o)⁻ᵏ: prior_complete to its power `portion`.
                odds = math.expm1(-math.log(settings().prior_complete) * portion / len(families))
                for name in names:
                    log_odds[name] = self.stated_log_odds.get(name, math.log(odds / len(names)))
        return log_odds

    @cached_property
    def forms(self) -> dict[str, tuple[str, ...]]:
        """Return the candidates of each family, by the name of the family."""
        forms: dict[str, tuple[str, ...]] = {}
        for name, effect in self.candidates.items():
            forms[effect.family_name] = (*forms.get(effect.family_name, ()), name)
        return forms

    def family(self, name: str) -> str:
        """Return the family's name, under which a candidate or an effect of the base is reported."""
        effect = self.candidates.get(name)
        return name if effect is None else effect.family_name

    def families(self, names: Iterable[str]) -> frozenset[str]:
        """Return the names of the families to which effects belong."""
        return frozenset(map(self.family, names))

    def corrects_column(self, name: str) -> bool:
        """Return whether a candidate corrects a column that effects depend on; it then cannot be scored."""
        return self.candidates[name].slot not in self.record.slots

    @cached_property
    def unscored_candidates(self) -> tuple[str, ...]:
        """Return the candidates of families none of whose forms can be scored, such as the temperature of a body."""
        families = (f for f in self.forms.values() if all(map(self.corrects_column, f)))
        return tuple(name for forms in families for name in forms)

    def other_forms(self, structure: Structure, name: str) -> list[Structure]:
        """Return structures that differ from a given one by another form of one of its effects."""
        reduced, forms = structure.without_effects(name), {*self.forms[self.family(name)]} - {name}
        return [reduced.with_effects(n) for n in self.candidates_for(reduced) if n in forms]

    def is_special_case(self, structure: Structure) -> bool:
        """Return whether the structure with a more general form of an effect, with a free shape, was evaluated."""
        for name in structure.effects:
            if general_name := self.candidates[name].general:
                fit = self.visited.get(structure.without_effects(name).with_effects(general_name))
                if fit is not None and math.isfinite(fit.log_posterior):
                    return True
        return False

    def log_prior(self, structure: Structure) -> float:
        """Return a structure's log prior odds relative to the base."""
        law_log_odds = log_prior(self.noise_laws, structure.noise)
        return law_log_odds + sum(map(self.log_odds.__getitem__, structure.effects))

    def latent_effects(self, structure: Structure) -> frozenset[str]:
        """Return the candidates that these readings cannot separate from the effects of a structure."""
        return self.spans.find_implied(structure.effects)

    def with_wide_priors(self, model: Model, names: Iterable[str]) -> Model:
        """Return a model with further candidates, under wide priors since readings do not determine their sizes."""
        for name in names:
            effect = self.candidates[name]
            model = model if name in model.names else model + effect
            model = model.resize(name, RMS_SCALE_FACTOR * effect.coefficients[0].size)
        return model

    def equivalents_by_effect(self, structure: Structure) -> dict[str, frozenset[str]]:
        """Return, for each effect of a structure, the candidates that could replace it on these readings."""
        effects = structure.effects
        sets = self.spans.find_minimal_sets(effects)
        return {n: frozenset().union(*(s - effects for s in sets if n not in s)) for n in effects}

    def reported_families(self, structure: Structure) -> frozenset[str]:
        """Return the families of a structure's effects and of their equivalents."""
        names = structure.effects.union(*self.equivalents_by_effect(structure).values())
        return self.families(names)

    def noise_law(self, structure: Structure) -> Noise:
        return self.noise_laws.get(structure.noise, self.base.noise)

    def excluded_candidates(self, structure: Structure) -> set[str]:
        """Return candidates not to add: other forms, second column corrections, time curves with correlated noise."""
        candidates, excluded = self.candidates.items(), set[str]()
        if not self.noise_law(structure).independent:
            excluded = {n for n, e in candidates if e.kind == "curve" and e.covariate == "time"}
        for name in structure.effects:
            excluded |= {n for n in self.forms[self.family(name)] if n != name}
            if self.corrects_column(name):
                slot = self.candidates[name].slot
                excluded |= {n for n, e in candidates if e.slot == slot} - structure.effects
        return excluded

    def candidates_for(self, structure: Structure) -> list[str]:
        """Return the candidates that may be added to a structure."""
        excluded_names = structure.effects | self.excluded_candidates(structure)
        return [n for n in self.candidates if n not in excluded_names]

    def build_model(self, structure: Structure) -> Model:
        """Return the model of a structure, its effects in the catalogue's order."""
        added_effects = [e for name, e in self.candidates.items() if name in structure.effects]
        effects = (*self.base.effects, *added_effects)
        return Model(self.base.instrument, effects, self.noise_law(structure), self.base.fixed)

    def evaluate(
        self,
        structure: Structure,
        neighbour: EvaluatedStructure | None = None,
        starts: Sequence[Mapping[str, float]] = (),
    ) -> EvaluatedStructure:
        """Return a structure's evidence; fit it, if new, from a neighbour's φ̂ and `starts` (name → coordinate)."""
        if structure not in self.visited:
            # Its own fit of the previous round, with another prior range of a shape, is nearer than any neighbour.
            neighbour = self.previous_round.get(structure, neighbour)
            self.visited[structure] = self._fit_structure(structure, neighbour, starts)
        return self.visited[structure]

    @cached_property
    def on_means(self) -> Structures | None:
        """Return the structures on block means of the readings, to compare forms; None if the record is short."""
        if (count := self.record.size // FORM_ROWS) < 2:
            return None
        record = Means.from_record(self.record, count).record
        return replace(self, record=record, visited={}, scores={}, previous_round={})

    def change_on_means(self, neighbour: Structure, fit: EvaluatedStructure) -> float:
        """Return the change of log posterior from a fit to a neighbour, both on block means; ∞ for a short record."""
        if self.on_means is None:
            return math.inf
        law = self.noise_law(neighbour).refines or neighbour.noise  # the plainer law has a spectrum
        current_fit = self.on_means.evaluate(fit.structure.with_noise(law), fit)
        neighbour_fit = self.on_means.evaluate(neighbour.with_noise(law), current_fit)
        return neighbour_fit.log_posterior - current_fit.log_posterior

    @cached_property
    def linearise(self) -> Callable[[EvaluatedStructure], LinearModel]:
        """Linearise a structure at its mode; the latest few linear models are cached."""
        return lru_cache(maxsize=4)(lambda fit: linearise_model(fit.problem, fit.mode))

    @cached_property
    def fit_law(self) -> Callable[[EvaluatedStructure, str], ResidualFit]:
        """Fit a noise law, by name, to a structure's residuals; cached."""
        laws, fits = {"": self.base.noise, **self.noise_laws}, dict[str, ResidualFit]()

        @cache
        def fit_law(fit: EvaluatedStructure, name: str) -> ResidualFit:
            deadline.current().raise_if_over()
            # Residuals of two structures are similar: the search from the other's maximum takes fewer steps.
            previous = fits.get(name, NO_FIT)
            fits[name] = fit_to_residuals(laws[name], self.linearise(fit).at_rest, previous)
            return fits[name]

        return fit_law

    def _fit_structure(self, structure, neighbour, known_starts) -> EvaluatedStructure:
        layout = replace(self.layout, model=self.build_model(structure))
        # A fit with the prior scales of its neighbour starts near its mode; `average_over_scales` tries the others.
        factors = (neighbour and neighbour.problem.size_factors) or {}
        factors = {n: factor for n, factor in factors.items() if n in structure.effects}
        problem, log_prior = Problem(layout, self.record, factors), self.log_prior(structure)
        # A structure that far behind needs no exact evidence.
        min_log_posterior = self.best.log_posterior - COARSE_NATS if self.visited else -math.inf
        coarse_below = min_log_posterior - log_prior
        if neighbour is None:
            first_mode = find_mode(problem, xtol=XTOL_SD, coarse_below=coarse_below)
        else:
            source, mode = neighbour.problem, neighbour.mode
            points = list_starts(problem, source, mode, known_starts)
            x, curvature = problem.map_x(source, mode.x), None
            if self.record.nodes(problem.noise) is None:
                # The neighbour's mode is exact if it was not found coarsely.
                is_exact = mode.log_density > min_log_posterior - neighbour.log_prior
                curvature = map_hessian(problem, source, mode, is_exact)
            options: dict[str, Any] = {"coarse_below": coarse_below, "guess": curvature}
            first_mode = find_mode(problem, points, x, XTOL_SD, **options)
        effects = (e for n, e in self.candidates.items() if n in structure.effects)
        scaled = [*filter(has_prior_scale, effects)]
        problem, mode, log_evidence = average_over_scales(problem, first_mode, scaled, coarse_below)
        fit = EvaluatedStructure(structure, log_evidence, log_prior, problem, mode)
        # Unnamed noise has the prior share of unnamed curves.
        if fit.has_unnamed_noise:
            fit = replace(fit, log_prior=log_prior + math.log(UNNAMED_PRIOR_SHARE))
        return fit

    def unnamed_effects(self, structure: Structure) -> frozenset[str]:
        """Return the unnamed effects of a structure, such as curves."""
        return frozenset(n for n in structure.effects if self.candidates[n].unnamed)

    @cached_property
    def substantial_unnamed(self) -> Callable[[EvaluatedStructure], frozenset[str]]:
        """Find the unnamed effects of a structure (curves) that are not negligible; cached.

        An unnamed effect is negligible if two ratios are small: of the rms that it alone explains to the noise, and of
        the shift of any named effect's coefficient without it to that coefficient's standard uncertainty.
        """
        return cache(self._find_substantial)

    def _find_substantial(self, fit: EvaluatedStructure) -> frozenset[str]:
        substantial_names = set[str]()
        for name in self.unnamed_effects(fit.structure):
            linear = self.linearise(fit)
            contribution = linear.whiten(linear.contribution(name)[:, None])[:, 0]
            # Ridge regression of the contribution c on the other columns: (AᵀA + W)⁻¹Aᵀc, prior standard deviations.
            is_other = np.array([owner != name for owner in linear.owners])
            columns, shift = linear.white_nuisance[:, is_other], np.zeros(is_other.size)
            precision = columns.T @ columns + np.diag(linear.weight[is_other])
            solution = np.linalg.lstsq(precision, columns.T @ contribution, 1e-12)[0]
            shift[is_other] = solution * linear.sd[is_other]
            residual = contribution - columns @ solution
            ratio = math.sqrt(float(residual @ residual) / linear.size)
            terms = (t for t in linear.problem.in_x if t.group_sd_name is None and t.per is None)
            indices = (t.x_slice.start for t in terms if t.effect.weights is None)
            if ratio > MAX_UNNAMED_RMS or any(
                abs(shift[i]) > linear.uncertainty(i) for i in indices
            ):
                substantial_names.add(name)
        return frozenset(substantial_names)

    def clear_cache(self) -> None:
        """Drop cached columns, Jacobians, linear models and structures over block means; recomputed on demand."""
        for fit in (*self.visited.values(), *self.previous_round.values()):
            fit.problem.clear_cache()
        for name in ("on_means", "linearise", "fit_law", "substantial_unnamed"):
            vars(self).pop(name, None)
        self.record.clear_cache()

    def store_score(self, structure: Structure, log_posterior: float) -> None:
        """Store the log posterior of a structure from its score; keep the highest if called again."""
        if math.isfinite(log_posterior):
            self.scores[structure] = max(log_posterior, self.scores.get(structure, -math.inf))

    def log_posterior(self, structure: Structure) -> float:
        """Return the log posterior of a structure: from its fit, or else from its score; −∞ if it has neither."""
        fit = self.visited.get(structure)
        return self.scores.get(structure, -math.inf) if fit is None else fit.log_posterior

    @property
    def window_nats(self) -> float:
        """Return the deficit of log posterior, nats, up to which a neighbour of the best structure is fitted."""
        return OCCAM_WINDOW_NATS / 2 if self.near_best_only else OCCAM_WINDOW_NATS

    def is_in_window(self, log_posterior: float, nats: float = OCCAM_WINDOW_NATS) -> bool:
        """Return whether a log posterior is at most `nats` below that of the best structure."""
        return log_posterior > self.best.log_posterior - nats

    @property
    def best(self) -> EvaluatedStructure:
        return max(self.visited.values(), key=lambda w: w.log_posterior)


def map_hessian(problem: Problem, source: Problem, mode: Mode, exact: bool) -> HessianGuess | None:
    """Map the Hessian at the mode of a source problem to a target problem, in the coordinates that they share."""
    if not np.all(np.isfinite(mode.covariance)):
        return None
    names, priors = problem.layout.index_in_phi, problem.priors
    shared = [(i, h.name) for i, h in enumerate(source.hypers) if priors.get(h.name) == h.prior]
    rows, columns = np.array([(i, names[n]) for i, n in shared], dtype=int).reshape(-1, 2).T
    count = len(names)
    v, curvature, is_exact = np.zeros(count), np.eye(count), np.zeros(count, dtype=bool)
    v[columns] = mode.v[rows]
    curvature[np.ix_(columns, columns)] = np.linalg.inv(mode.covariance)[np.ix_(rows, rows)]
    is_exact[columns] = exact and not mode.indefinite and problem.noise == source.noise
    return HessianGuess(v, curvature, is_exact)


def list_starts(
    problem: Problem, source: Problem, mode: Mode, starts: Sequence[Mapping[str, float]]
) -> list[Float[np.ndarray, "d"]]:
    """Return starting coordinates of φ: a source problem's mode, copies with given starts, and steps along shapes."""
    base, steps = dict[str, float](), dict[str, tuple[float, ...]]()
    for h in problem.hypers:
        # Shapes are tried to either side; a new spread or noise parameter below and above its scale.
        if (i := source.layout.index_in_phi.get(h.name)) is None:
            base[h.name] = 0.0
            steps[h.name] = (-1.5, 1.0) if h.kind in ("group_sd", "noise") else ()
        elif (prior := source.hypers[i].prior) == h.prior:
            v = base[h.name] = float(mode.v[i])
            steps[h.name] = (v - 1.0, v + 1.0) if h.kind == "shape" else ()
        else:
            base[h.name] = float(h.prior.coordinate(prior.value(mode.v[i])))
            steps[h.name] = (0.0,) if h.kind == "shape" else ()
    known_starts = ({n: v for n, v in start.items() if n in base} for start in starts)
    points = [base, *({**base, **start} for start in known_starts)]
    points += [{**base, name: v} for name, values in steps.items() for v in values]
    return [np.array([*point.values()]) for point in points]


def has_prior_scale(effect: Effect) -> bool:
    """Return whether an effect has a prior scale, that is, coefficients with a stated, informative prior."""
    scaled = (c for c in effect.coefficients if c.group_sd is None and not (c.flat or c.known))
    return not effect.is_placeholder and any(True for _ in scaled)


def average_over_scales(
    problem: Problem, mode: Mode, effects: Sequence[Effect], coarse_below: float = -math.inf
) -> tuple[Problem, Mode, float]:
    """Average a structure's log evidence over prior scales; return its problem and mode at the most probable ones, too.

    One effect's prior scale is varied at a time, the others fixed at their most probable values.

    Args:
        problem, mode: the structure's problem at starting prior scales, and its mode.
        effects: its effects with a prior scale.
        coarse_below: log density below which no new mode is found for other scales.
    """
    initial_factors = {e.name: (problem.size_factors or {}).get(e.name, 1.0) for e in effects}
    if (scales := ScaleEvidence.from_mode(problem, mode, initial_factors)) is None:
        return problem, mode, -math.inf
    factors = scales.most_probable_factors()
    is_coarse = mode.log_density + scales.evidence_change(factors) < coarse_below
    if factors != initial_factors and not is_coarse:
        problem = Problem(problem.layout, problem.record, factors)
        curvature = map_hessian(problem, problem, mode, True)
        mode = find_mode(problem, [mode.v], mode.x, XTOL_SD, guess=curvature)
        if (scales := ScaleEvidence.from_mode(problem, mode, factors)) is None:
            return problem, mode, -math.inf
    # Sum over the scales of one effect, the others at their most probable, as if ratios of evidence multiplied. They
    # do where effects do not overlap; where effects overlap, one of them mostly sets the scale of the other.
    log_change = scales.evidence_change(factors)
    log_evidence = mode.log_evidence + log_change
    for name in factors:
        log_changes = [*scales.changes_along(name, factors).values()]
        log_evidence += float(np.logaddexp.reduce(log_changes)) - log_change
    return problem, mode, log_evidence


class ScaleEvidence(NamedTuple):
    """Change of a structure's log evidence at a φ by other prior scales of its effects, in closed form.

    Coefficients z, in the standard deviations of their prior, have the posterior N(m, C). A prior f times as wide
    multiplies the density by exp(−½·δ·z²)/f, δ = 1/f² − 1, for each coefficient; the posterior mean of the product is
    |F|⁻¹·|I + ΔC|^(−½)·exp(−½·mᵀ(I + ΔC)⁻¹Δm).

    Attributes:
        initial: scale factors with which the posterior was computed, by effect.
        owner: index of the effect that each coefficient with a prior scale belongs to (k,).
        mean, covariance: posterior mean (k,) and covariance (k, k) of z.
    """

    initial: dict[str, float]
    owner: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def from_mode(cls, problem: Problem, mode: Mode, initial: Mapping[str, float]) -> Self | None:
        """Compute the posterior of the scaled coefficients at a mode; return None if its evidence is not finite."""
        gaussian = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)[1]
        if gaussian is None or not math.isfinite(mode.log_evidence):
            return None
        # Learned spreads are part of φ, and the evidence is averaged over them already.
        names, owner = [*initial], np.full(problem.size, -1)
        for t in problem.in_x:
            if t.effect.name in initial and t.group_sd_name is None:
                owner[t.x_slice] = names.index(t.effect.name)
        scaled_indices = np.flatnonzero(owner >= 0)
        root = gaussian.root_of_z[scaled_indices]
        return cls(dict(initial), owner[scaled_indices], gaussian.z[scaled_indices], root @ root.T)

    def evidence_change(self, factors: Mapping[str, float]) -> float:
        """Return the change of log evidence from the initial scale factors to given ones, priors not included."""
        if not self.initial:
            return 0.0
        ratio = np.array([factors[n] / f for n, f in self.initial.items()])[self.owner]
        delta = 1 / ratio**2 - 1
        inner = np.eye(len(delta)) + delta[:, None] * self.covariance
        squares = self.mean @ np.linalg.solve(inner, delta * self.mean)
        log_det = float(np.linalg.slogdet(inner)[1])
        return -float(np.sum(np.log(ratio))) - 0.5 * (log_det + float(squares))

    def changes_along(self, name: str, factors: Mapping[str, float]) -> dict[float, float]:
        """Return the change of log evidence plus log prior for each scale factor of an effect, other effects fixed."""
        scales = ((f, self.evidence_change({**factors, name: f})) for f in SIZE_FACTORS)
        return {f: change + math.log(SIZE_FACTORS[f]) for f, change in scales}

    def most_probable_factors(self) -> dict[str, float]:
        """Return the most probable scale factors, by coordinate ascent: two sweeps, since effects may overlap."""
        factors = dict(self.initial)
        for _ in range(2):
            previous = dict(factors)
            for name in factors:
                changes = self.changes_along(name, factors)
                factors[name] = max(changes, key=changes.__getitem__)
            if factors == previous:
                break
        return factors
