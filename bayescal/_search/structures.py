"""Structures: which effects and which noise law may make up a model, how probable each is, before and after.

Each candidate is in or out, independently, with odds such that P(model complete) is one half; placeholders share a
tenth of the prior. A candidate is a family of forms, of which a structure has one at most and which share its odds. A
plausible size is known to an order of magnitude: evidence is averaged over it times 1, 3 and 10.
What readings cannot tell from the effects of a structure is latent in its model, with its prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._calibration.judgement import stands_in_for_effect
from bayescal._core import deadline
from bayescal._core.null_space import Spans
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.laplace import Mode, find_mode
from bayescal._inference.linear_model import LinearModel, linear_model
from bayescal._inference.newton import Nearby
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.effect import Effect, with_forms
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import Layout
from bayescal._model.terms import Correction
from bayescal._search.noise_laws import NO_FIT, OnResiduals, log_prior, on_residuals

# Share of the prior weight of what is missing, for what no named effect describes: a formula that is known beforehand
# is likelier than one that is not.
UNKNOWN_SHARE = 0.1
# Share of the noise, rms, that a description without a name may explain, and the model still count as complete: it
# makes the noise by a fiftieth larger.
NAMELESS_RMS = 0.2
# Nats behind the best, up to which a structure is refitted: e⁻⁶ = 0.0025, a quarter of a hundredth.
NEAR_NATS = 6.0
# Nats behind the best, from which a structure under another noise law is not refitted.
OTHER_LAW_NATS = 100.0
# The same, from which the mode of any is found roughly: what it adds to a probability is below 1e-6.
ROUGHLY_NATS = 10.0
# Factors on a candidate's plausible size, which is known to an order of magnitude, and their prior probabilities: real
# coefficients on the chamber ramp stood 3 to 8 such sizes out.
SIZE_FACTORS = {1.0: 0.6, 3.0: 0.3, 10.0: 0.1}
# Standard deviation of a coefficient whose size the readings do not tell, in plausible sizes.
RMS_SIZE = math.sqrt(sum(p * factor**2 for factor, p in SIZE_FACTORS.items()))

XTOL_SD = 0.03  # standard deviations to which a mode is found: its log evidence to 1e-3


@dataclass(frozen=True)
class Structure:
    """A set of added effects, and the name of a noise law; "" for the law of the model given."""

    effects: frozenset[str] = frozenset()
    noise: str = ""

    def plus(self, *names: str) -> Structure:
        return replace(self, effects=self.effects | set(names))

    def minus(self, *names: str) -> Structure:
        return replace(self, effects=self.effects - set(names))

    def under(self, noise: str) -> Structure:
        return replace(self, noise=noise)


@dataclass(frozen=True, eq=False)
class Weighed:
    """A structure with its evidence, its prior, and its mode."""

    structure: Structure  # which
    log_evidence: float  # by Laplace, averaged over the sizes
    log_prior: float  # of the structure
    problem: Problem  # problem, mode: at the likeliest sizes
    mode: Mode

    @property
    def total(self) -> float:
        return self.log_evidence + self.log_prior

    @property
    def model(self) -> Model:
        return self.problem.layout.model

    @property
    def phi(self) -> dict[str, float]:
        """Return shapes, noise parameters and spreads at the mode, by name."""
        return {name: float(value) for name, value in self.problem.hyper(self.mode.v).items()}

    @property
    def noise_describes(self) -> bool:
        """Return whether its noise stands for something without a name."""
        noise = self.problem.noise
        return not noise.independent and stands_in_for_effect(noise, self.phi)

    @cached_property
    def acting(self) -> dict[Correction, tuple[float, ...]]:
        """Return the corrections of columns, as by a body's temperature, with their shapes at the mode."""
        phi = self.phi
        corrections = (c for t in self.problem.terms for c in t.columns.corrections)
        return {c: tuple(phi[n] for n in c.shape_names) for c in corrections}

    @property
    def sized_model(self) -> Model:
        """Return the model with the most probable sizes of the instrument's own effects."""
        model = self.model
        candidates = {e.name for e in with_forms(model.instrument.candidates)}
        for name, factor in (self.problem.size_factors or {}).items():
            first = model.effect(name).coefficients[0]
            if factor != 1.0 and name in candidates and not first.flat:
                model = model.resize(name, factor * first.size)
        return model


@dataclass(eq=False)
class Structures:
    """All structures over one model on one record."""

    base: Model  # the model that effects are added to
    layout: Layout  # its own, for the groups' sizes
    record: Record  # the readings
    candidates: Mapping[str, Effect]  # effects that may be added, by name
    laws: Mapping[str, Noise]  # further noise laws that the readings can tell, by name
    # prior log odds of candidates of which more is known than their number
    odds: Mapping[str, float] = field(default_factory=dict)
    floor: float = 0.0  # noise that no model removes, output unit
    # which candidates these readings cannot tell from which
    spans: Spans = field(default_factory=Spans)
    # structures weighed with other ranges of shapes: where refits begin
    earlier: Mapping[Structure, Weighed] = field(default_factory=dict)
    # whether forms without a score, and other noise laws, are weighed near the best structure alone
    thrifty: bool = False
    visited: dict[Structure, Weighed] = field(default_factory=dict)
    expected: dict[Structure, float] = field(default_factory=dict)  # totals of others, by score
    experiments: dict[Any, Any] = field(default_factory=dict)  # which tell equivalent effects apart

    @cached_property
    def log_odds(self) -> dict[str, float]:
        """Return prior log odds of each candidate to be missing, in this form."""
        forms = self.forms.values()
        unknown = [f for f in forms if self.candidates[f[0]].is_placeholder]
        named = [f for f in forms if not self.candidates[f[0]].is_placeholder]
        share = UNKNOWN_SHARE if named else 1.0
        log_odds = {}
        for families, part in ((unknown, share), (named, 1 - share if unknown else 1.0)):
            for names in families:
                # k candidates of odds o are all out with probability (1 + o)⁻ᵏ: prior_complete to the power of the
                # group's part, so that the product over both groups is prior_complete.
                odds = math.expm1(-math.log(settings().prior_complete) * part / len(families))
                for name in names:
                    log_odds[name] = self.odds.get(name, math.log(odds / len(names)))
        return log_odds

    @cached_property
    def forms(self) -> dict[str, tuple[str, ...]]:
        """Return the candidates of each family, by the name under which it is reported."""
        forms: dict[str, tuple[str, ...]] = {}
        for name, effect in self.candidates.items():
            forms[effect.reported] = (*forms.get(effect.reported, ()), name)
        return forms

    def family(self, name: str) -> str:
        """Return the name under which a candidate, or an effect of the base, is reported."""
        effect = self.candidates.get(name)
        return name if effect is None else effect.reported

    def families(self, names: Iterable[str]) -> frozenset[str]:
        """Return the names under which effects are reported."""
        return frozenset(map(self.family, names))

    def have_same_effects(self, first: Structure, second: Structure) -> bool:
        """Return whether two structures have the same families of effects and noise law."""
        same = self.families(first.effects) == self.families(second.effects)
        return same and first.noise == second.noise

    def moves_a_column(self, name: str) -> bool:
        """Return whether a candidate corrects a column on which others depend (a body's temperature): no score."""
        return self.candidates[name].slot not in self.record.slots

    @cached_property
    def unscored(self) -> tuple[str, ...]:
        """Return candidates of families without a score in any form: a body by itself."""
        families = (f for f in self.forms.values() if all(map(self.moves_a_column, f)))
        return tuple(name for forms in families for name in forms)

    def other_forms(self, structure: Structure, name: str) -> list[Structure]:
        """Return the structures with other forms of one of its effects."""
        reduced, forms = structure.minus(name), self.forms[self.family(name)]
        return [reduced.plus(n) for n in forms if n != name and n in self.open_to(reduced)]

    def is_special_case(self, structure: Structure) -> bool:
        """Return whether an effect's general form, its shape free, was evaluated in its place."""
        for name in structure.effects:
            general = self.candidates[name].general
            evaluated = self.visited.get(structure.minus(name).plus(general)) if general else None
            if evaluated is not None and math.isfinite(evaluated.total):
                return True
        return False

    def log_prior(self, structure: Structure) -> float:
        """Return a structure's log prior odds against the base."""
        of_law = log_prior(self.laws, structure.noise)
        return of_law + sum(self.log_odds[name] for name in structure.effects)

    def latent(self, structure: Structure) -> frozenset[str]:
        """Return candidates that these readings cannot tell from the effects of a structure."""
        return self.spans.implied(structure.effects)

    def unsized(self, model: Model, names: Iterable[str]) -> Model:
        """Return a model with these candidates, their priors wide since readings tell no size."""
        for name in names:
            effect = self.candidates[name]
            model = model if name in model.names else model + effect
            model = model.resize(name, RMS_SIZE * effect.coefficients[0].size)
        return model

    def rivals(self, structure: Structure) -> dict[str, frozenset[str]]:
        """Return, for each effect of a structure, its equivalents on these readings, alone or together."""
        effects = structure.effects
        sets = self.spans.generators(effects)
        return {n: frozenset().union(*(s - effects for s in sets if n not in s)) for n in effects}

    def reported(self, structure: Structure) -> frozenset[str]:
        """Return the families of a structure's effects and of their equivalents."""
        named = structure.effects.union(*self.rivals(structure).values())
        return self.families(named)

    def noise(self, structure: Structure) -> Noise:
        return self.laws.get(structure.noise, self.base.noise)

    def barred(self, structure: Structure) -> set[str]:
        """Return candidates barred: other forms, a second body, and beside correlated noise a curve in time."""
        candidates, barred = self.candidates.items(), set[str]()
        if not self.noise(structure).independent:
            barred = {n for n, e in candidates if e.kind == "curve" and e.covariate == "time"}
        moved = {self.candidates[n].slot for n in structure.effects if self.moves_a_column(n)}
        for name in structure.effects:
            barred |= {n for n in self.forms[self.family(name)] if n != name}
        return barred | {n for n, e in candidates if e.slot in moved} - structure.effects

    def open_to(self, structure: Structure) -> list[str]:
        """Return candidates that may be added to a structure."""
        barred = structure.effects | self.barred(structure)
        return [n for n in self.candidates if n not in barred]

    def model(self, structure: Structure) -> Model:
        """Return a structure as a model, effects in the catalogue's order."""
        added = [e for name, e in self.candidates.items() if name in structure.effects]
        effects = (*self.base.effects, *added)
        return Model(self.base.instrument, effects, self.noise(structure), self.base.fixed)

    def weigh(
        self,
        structure: Structure,
        near: Weighed | None = None,
        hints: Sequence[Mapping[str, float]] = (),
    ) -> Weighed:
        """Return a structure's evidence by a refit, cached; from the φ̂ of one near and from `hints`."""
        evaluated = self.visited.get(structure)
        if evaluated is None:
            # A structure of an earlier round, weighed with another range of a shape, is nearer than any neighbour.
            near = self.earlier.get(structure, near)
            evaluated = self.visited[structure] = self._refitted(structure, near, hints)
        return evaluated

    @cached_property
    def line(self) -> Callable[[Weighed], LinearModel]:
        """Return a structure linearised at its mode; the latest few are cached."""
        return lru_cache(maxsize=4)(lambda weighed: linear_model(weighed.problem, weighed.mode))

    @cached_property
    def law_on_residuals(self) -> Callable[[Weighed, str], OnResiduals]:
        """Return a fit of a noise law, by name, to a structure's residuals; cached."""
        laws, latest = {"": self.base.noise, **self.laws}, dict[str, OnResiduals]()

        @cache
        def fit_law(weighed: Weighed, name: str) -> OnResiduals:
            deadline.current().ask()
            # Residuals of another structure are much alike: where their maximum is, the climb is shorter.
            near = latest.get(name, NO_FIT)
            latest[name] = on_residuals(laws[name], self.line(weighed).at_rest, near)
            return latest[name]

        return fit_law

    def _refitted(self, structure, near, hints) -> Weighed:
        problem = self._bound(structure, near)
        log_prior = self.log_prior(structure)
        # Of what is that far behind nothing is asked but that it is.
        coarse_below = self.best.total - log_prior - ROUGHLY_NATS if self.visited else -math.inf
        if near is None:
            first_mode = find_mode(problem, xtol=XTOL_SD, coarse_below=coarse_below)
        else:
            coordinates = carried(problem, near.problem, near.mode)
            begin = starts(problem, near.problem, coordinates, hints)
            x, curvature = problem.x_of(near.problem, near.mode.x), None
            if self.record.nodes(problem.noise) is None:
                # As near to the best as that its own curvature was found.
                exact = near.mode.log_density > self.best.total - near.log_prior - ROUGHLY_NATS
                curvature = nearby(problem, near.problem, near.mode, exact)
            how: dict[str, Any] = {"coarse_below": coarse_below, "near": curvature}
            first_mode = find_mode(problem, begin, x, XTOL_SD, **how)
        sized = [e for n, e in self.candidates.items() if n in structure.effects and has_size(e)]
        problem, mode, log_evidence = averaged(problem, first_mode, sized, coarse_below)
        weighed = Weighed(structure, log_evidence, log_prior, problem, mode)
        # Something without a name, whose share of the prior is that of curves.
        if weighed.noise_describes:
            weighed = replace(weighed, log_prior=log_prior + math.log(UNKNOWN_SHARE))
        return weighed

    def _bound(self, structure, near: Weighed | None) -> Problem:
        """Bind a structure to the record, its effects' sizes as in another structure."""
        factors = near.problem.size_factors if near is not None else None
        # A refit at the sizes of its neighbour begins nearly at its mode; `averaged` then tries the others.
        sizes = {n: factor for n, factor in (factors or {}).items() if n in structure.effects}
        layout = replace(self.layout, model=self.model(structure))
        return Problem(layout, self.record, sizes)

    def unnamed(self, structure: Structure) -> frozenset[str]:
        """Return a structure's descriptions without a name."""
        return frozenset(n for n in structure.effects if self.candidates[n].unnamed)

    @cached_property
    def matters(self) -> Callable[[Weighed], frozenset[str]]:
        """Return a structure's descriptions without a name (curves) that carry more than a small part; cached.

        What one explains that the rest of the structure cannot, rms over the noise; or what it moves a coefficient of a
        named effect by, over its standard uncertainty: where both are small, all that has a name is there.
        """
        return cache(self._substantial)

    def _substantial(self, weighed: Weighed) -> frozenset[str]:
        substantial = set[str]()
        for name in self.unnamed(weighed.structure):
            line = self.line(weighed)
            is_own = np.array([owner == name for owner in line.owners])
            white = line.whiten(line.contribution(name)[:, None])[:, 0]
            residual = line.deflate(white, ~is_own)
            share = math.sqrt(float(residual @ residual) / line.size)
            if share > NAMELESS_RMS or self._moves_coefficients(line, is_own, white):
                substantial.add(name)
        return frozenset(substantial)

    def _moves_coefficients(
        self, line: LinearModel, is_own: np.ndarray, white: Float[np.ndarray, "n"]
    ) -> bool:
        """Return whether a named effect's coefficient would move beyond its uncertainty without a contribution."""
        others = np.flatnonzero(~is_own)
        columns = line.white_nuisance[:, others]
        inner = columns.T @ columns + np.diag(line.weight[others])
        # Without it the others would take up what they can of it: (AᵀA + W)⁻¹Aᵀc, prior standard deviations.
        moved = np.zeros(len(is_own))
        moved[others] = np.linalg.lstsq(inner, columns.T @ white, rcond=1e-12)[0] * line.sd[others]
        plain = (
            t.x_slice.start
            for t in line.problem.in_x
            if t.group_sd_name is None and t.effect.weights is None and t.per is None
        )
        return any(abs(moved[i]) > line.uncertainty(i) for i in plain)

    def expect(self, structure: Structure, total: float) -> None:
        """Keep what the score expects of a structure: it counts where that was not refitted."""
        if math.isfinite(total):
            self.expected[structure] = max(total, self.expected.get(structure, -math.inf))

    def total(self, structure: Structure) -> float:
        """Return a structure's total by refit, else the expected one."""
        evaluated = self.visited.get(structure)
        return self.expected.get(structure, -math.inf) if evaluated is None else evaluated.total

    @property
    def near(self) -> float:
        """Return the nats behind the best up to which a structure is refitted."""
        return NEAR_NATS / 2 if self.thrifty else NEAR_NATS

    @property
    def best(self) -> Weighed:
        return max(self.visited.values(), key=lambda w: w.total)


def carried(problem: Problem, near: Problem, mode: Mode) -> dict[str, float]:
    """Return another structure's φ̂ by name, in coordinates of this one's priors."""
    coordinates, places = {}, near.layout.index_in_phi
    for hyper in problem.hypers:
        if (j := places.get(hyper.name)) is not None:
            prior, other, v = hyper.prior, near.hypers[j].prior, mode.v[j]
            v = v if prior == other else prior.coordinate(other.value(v))
            coordinates[hyper.name] = float(v)
    return coordinates


def nearby(problem: Problem, near: Problem, mode: Mode, exact: bool) -> Nearby | None:
    """Return another structure's curvature at its mode, in the coordinates that both have."""
    if not np.all(np.isfinite(mode.covariance)):
        return None
    names, priors = problem.layout.index_in_phi, {h.name: h.prior for h in problem.hypers}
    shared = [(i, h.name) for i, h in enumerate(near.hypers) if priors.get(h.name) == h.prior]
    source, target = np.array([(i, names[n]) for i, n in shared], dtype=int).reshape(-1, 2).T
    count = len(names)
    v, curvature, is_exact = np.zeros(count), np.eye(count), np.zeros(count, dtype=bool)
    v[target] = mode.v[source]
    curvature[np.ix_(target, target)] = np.linalg.inv(mode.covariance)[np.ix_(source, source)]
    is_exact[target] = exact and not mode.indefinite and problem.noise == near.noise
    return Nearby(v, curvature, is_exact)


def starts(
    problem: Problem,
    near: Problem,
    coordinates: Mapping[str, float],
    hints: Sequence[Mapping[str, float]],
) -> list[Float[np.ndarray, "d"]]:
    """Return coordinates to begin at: the neighbour's (`carried`), the hints, and others along each shape."""
    names, priors = problem.layout.index_in_phi, {h.name: h.prior for h in near.hypers}
    first = {n: coordinates.get(n, 0.0) for n in names}
    inside = ({n: v for n, v in hint.items() if n in names} for hint in hints)
    points = [first, *({**first, **hint} for hint in inside)]
    for h in problem.hypers:
        # Shapes are tried to either side, as a neighbour's effects may have shifted them; a spread or a parameter of
        # the noise that is new, below and above its scale.
        further: tuple[float, ...] = ()
        if h.kind == "shape" and h.name in coordinates:
            same = h.prior == priors[h.name]
            further = (first[h.name] - 1.0, first[h.name] + 1.0) if same else (0.0,)
        elif h.kind in ("group_sd", "noise") and h.name not in coordinates:
            further = (-1.5, 1.0)
        points += [{**first, h.name: v} for v in further]
    return [np.array([start[n] for n in names]) for start in points]


def has_size(effect: Effect) -> bool:
    """Return whether an effect's size is a prior's standard deviation, and not learned."""
    return not effect.is_placeholder and any(
        c.group_sd is None and not (c.flat or c.known) for c in effect.coefficients
    )


def averaged(
    problem: Problem, mode: Mode, sized: Sequence[Effect], coarse_below: float = -math.inf
) -> tuple[Problem, Mode, float]:
    """Return the structure at its likeliest sizes, its mode there, and its log evidence averaged over all.

    One effect's size at a time, the others' at their likeliest.

    Args:
        problem, mode: the structure, its sizes those of a start, and where it has its mode.
        sized: effects with a plausible size.
        coarse_below: log density, below which the fit that the climb left will do.
    """
    initial = {e.name: (problem.size_factors or {}).get(e.name, 1.0) for e in sized}
    gains = SizeGains.of(problem, mode, initial)
    if gains is None:
        return problem, mode, -math.inf
    chosen = gains.likeliest()
    gain = gains.at(chosen)
    if mode.log_density + gain < coarse_below:
        log_evidence = mode.log_evidence + gain
    else:
        if chosen != initial:
            problem = Problem(problem.layout, problem.record, dict(chosen))
            curvature = nearby(problem, problem, mode, True)
            mode = find_mode(problem, [mode.v], mode.x, XTOL_SD, near=curvature)
            gains = SizeGains.of(problem, mode, chosen)
            if gains is None:
                return problem, mode, -math.inf
            gain = gains.at(chosen)
        log_evidence = mode.log_evidence
    # Σ over the sizes of one effect, the others at their likeliest: as if ratios of evidence multiplied. They do
    # where effects do not overlap; where they do, one of them mostly has its size by the other's.
    for name in chosen:
        log_evidence += float(np.logaddexp.reduce([*gains.along(name, chosen).values()])) - gain
    return problem, mode, log_evidence


class SizeGains(NamedTuple):
    """What other sizes of a structure's effects add to its log density at a φ, in closed form.

    Coefficients z, in the standard deviations of their prior, have the posterior N(m, C). A prior f times as wide is a
    factor exp(−½·δ·z²)/f, δ = 1/f² − 1, on each, of which the posterior mean is
    |F|⁻¹·|I + ΔC|^(−½)·exp(−½·mᵀ(I + ΔC)⁻¹Δm).

    Attributes:
        begun: the factors that the posterior is of, by effect.
        owner: of each coefficient that has a size, which of these effects has it (k,).
        mean, covariance: of their z.
    """

    initial: dict[str, float]
    owner: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, problem: Problem, mode: Mode, initial: Mapping[str, float]) -> SizeGains | None:
        """Return those at a mode; None where there is no density."""
        gaussian = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)[1]
        if gaussian is None or not math.isfinite(mode.log_evidence):
            return None
        # Learned spreads are no plausible sizes: φ has them, and the evidence is averaged over them already.
        names, owner = [*initial], np.full(problem.size, -1)
        for t in problem.in_x:
            if t.effect.name in initial and t.group_sd_name is None:
                owner[t.x_slice] = names.index(t.effect.name)
        sized = np.flatnonzero(owner >= 0)
        root = gaussian.root_of_z[sized]
        return cls(dict(initial), owner[sized], gaussian.z[sized], root @ root.T)

    def at(self, factors: Mapping[str, float]) -> float:
        """Return the gain at some sizes, against those begun at, without their probabilities."""
        if not self.initial:
            return 0.0
        ratio = np.array([factors[n] / f for n, f in self.initial.items()])[self.owner]
        delta = 1 / ratio**2 - 1
        inner = np.eye(len(delta)) + delta[:, None] * self.covariance
        squares = self.mean @ np.linalg.solve(inner, delta * self.mean)
        volume = float(np.linalg.slogdet(inner)[1])
        return -float(np.sum(np.log(ratio))) - 0.5 * (volume + float(squares))

    def along(self, name: str, chosen: Mapping[str, float]) -> dict[float, float]:
        """Return the gain with its log probability for each size of one effect, the others as chosen."""
        return {
            factor: self.at({**chosen, name: factor}) + math.log(probability)
            for factor, probability in SIZE_FACTORS.items()
        }

    def likeliest(self) -> dict[str, float]:
        """Return the likeliest sizes, by coordinate ascent: one that overlaps another may take its size back."""
        chosen = dict(self.initial)
        for _ in range(2):
            before = dict(chosen)
            for name in chosen:
                gains = self.along(name, chosen)
                chosen[name] = max(gains, key=gains.__getitem__)
            if chosen == before:
                break
        return chosen
