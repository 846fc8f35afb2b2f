"""Evidence on an effect that is not in a model: from a fit with the effect, or else from its score."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc, logsumexp, ndtri

from bayescal._calibration.claim import Claim
from bayescal._calibration.judgement import check_scale
from bayescal._core.null_space import UNDECIDED_RATIO
from bayescal._core.settings import settings
from bayescal._inference.linear_model import find_amplitude, linearise_model
from bayescal._model.effect import Effect, Role
from bayescal._search.library import Library
from bayescal._search.scores import ScoredPoint, Scores, log_mean_bayes_factor
from bayescal._search.structures import EvaluatedStructure, Structures

# Probability from which an effect that is not found is called a lead: odds of 1 to 4, worth a further run.
LEAD_PROBABILITY = 0.2
# Cosine of two fitted contributions above which readings cannot distinguish them: a tenth of the squares remains.
PARALLEL_COSINE = 0.95
# Minimum detectable size, in plausible sizes, above which an effect counts as not visible.
MAX_DETECTABLE_SIZES = 10.0

SPREAD_FACTORS = np.geomspace(1 / 30, 30, 61)  # a group's sd over that of the best grid point


@dataclass(frozen=True)
class Candidate:
    """Evidence of the readings on an effect that is not in the model.

    Attributes:
        effect: canonical name; for a family of forms, the family's name.
        form: the most probable form, if there are several.
        probability: probability that the effect is missing from the model; None if it cannot be tested.
        log_bayes_factor: log Bayes factor of the model with the effect against the model without it, natural logarithm.
        source: "refit" where the model was fitted with the effect, else "score".
        z: size over its standard uncertainty (for a group, the z with the tail probability of its chi-square).
        size, size_sd: posterior mean and standard deviation, in `unit`, of the coefficient; of the between-group
            standard deviation of a group effect; of the amplitude of an unknown dependence.
        shape: shape parameters, in their units.
        visibility: ratio of the information on the effect with nuisances marginalised to that with them known.
        minimum_detectable: size in `unit` that would be found with 80 % power.
        kind: "finding", "one of several" of a finding, "lead", "not visible", "not testable"; None for no evidence.
        indistinguishable_from: other candidates that these readings cannot distinguish from it.
        reason: why it is not testable or not visible.
        role: "named", "unnamed" for an unknown function of a covariate, or "freed" for an effect of the model (`frees`)
            with an estimate in place of its stated value.
    """

    effect: str
    form: str = ""
    probability: float | None = None
    log_bayes_factor: float | None = None
    source: str = "score"
    z: float | None = None
    size: float | None = None
    size_sd: float | None = None
    unit: str = ""
    shape: dict[str, float] = field(default_factory=dict)
    visibility: float | None = None
    minimum_detectable: float | None = None
    kind: str | None = None
    indistinguishable_from: tuple[str, ...] = ()
    reason: str = ""
    role: Role = "named"
    frees: str = ""

    @property
    def unseen(self) -> bool:
        """Return whether these readings have no information on the effect."""
        return self.kind in ("not visible", "not testable")


def select_forms(structures: Structures, points: Scores) -> Scores:
    """Return, by family, the scores of the form with the highest log Bayes factor."""
    forms: dict[str, Sequence[ScoredPoint]] = {}
    for name, scores in points.items():
        family = structures.family(name)
        forms[family] = max(forms.get(family, scores), scores, key=log_mean_bayes_factor)
    return forms


def summarise_candidate(
    library: Library,
    name: str,
    form: str,
    points: Sequence[ScoredPoint],
    fit: EvaluatedStructure,
    fit_with: EvaluatedStructure | None,
) -> Candidate:
    """Summarise the evidence on a family in its most probable form, by its scores and, if there is one, by a fit."""
    structures = library.structures
    scored_form, has_forms = points[0].name if points else form, len(structures.forms[name]) > 1
    effect = structures.candidates[scored_form]
    fields = {"unit": effect.coefficients[0].unit, "role": effect.role, "frees": effect.frees}
    candidate = Candidate(effect=name, form=form if has_forms else "", **fields)
    if points:
        best_point, trace = points[0], float(np.trace(points[0].gram))
        candidate = replace(
            candidate,
            log_bayes_factor=log_mean_bayes_factor(points),
            z=_compute_z_score(best_point, library.is_grouped(scored_form)),
            shape={**best_point.point.shapes, **best_point.prior_scale.shapes},
            visibility=float(np.trace(best_point.information)) / trace if trace > 0 else 0.0,
            minimum_detectable=_compute_minimum_detectable(library, best_point),
        )
    if fit_with is not None and math.isfinite(fit_with.log_evidence):
        # A fit averages over prior scales and optimises the shapes; a score has both on a grid.
        factor = fit_with.log_evidence - fit.log_evidence
        fitted_fields = _measure_fitted_size(structures.candidates[form], fit_with)
        return replace(candidate, log_bayes_factor=factor, source="refit", **fitted_fields)
    if not points:
        return candidate
    mean, variance = _average_size(library, points)
    return replace(candidate, size=mean, size_sd=math.sqrt(variance))


def flag_off_scale(library: Library, points: Scores, fit: EvaluatedStructure) -> tuple[Claim, ...]:
    """Return claims on candidates whose plausible contribution differs from the noise by orders of magnitude."""
    structures, claims = library.structures, []
    noise = math.sqrt(float(np.median(structures.linearise(fit).variance)))
    for top, *_ in points.values():
        effect = structures.candidates[top.name]
        maximum = float(np.max(np.abs(top.scorer.columns(top.scorer.linear, [top.point])[:, 0])))
        contribution = maximum * effect.coefficients[0].size
        claims += check_scale(effect, contribution, noise, structures.base.instrument.unit)
    return tuple(claims)


def _measure_fitted_size(effect: Effect, fit: EvaluatedStructure) -> dict[str, Any]:
    """Return an effect's size with its uncertainty, and its shapes, at the mode of a fit."""
    problem, mode = fit.problem, fit.mode
    hyper = problem.hyper(mode.v)
    shapes = {s.name: float(hyper[effect.shape_name(s)]) for s in effect.shapes}
    if effect.constant_indices:  # a body's temperature: its size is its time constant
        first_shape = effect.shapes[0]
        size, sd = problem.value_and_sd(effect.shape_name(first_shape), mode.v, mode.covariance)
        return {"size": size, "size_sd": sd, "shape": shapes, "unit": first_shape.unit}
    if amplitude := find_amplitude(effect, problem, mode):
        return {"size": amplitude[0], "size_sd": amplitude[1], "shape": shapes}
    # The uncertainty includes that of shapes, to first order.
    i = next(t.x_slice.start for t in problem.in_x if t.effect.name == effect.name)
    sd = linearise_model(problem, mode).uncertainty(i)
    return {"size": float(mode.x[i]), "size_sd": sd, "shape": shapes}


def _average_size(library: Library, points: Sequence[ScoredPoint]) -> tuple[float, float]:
    """Return posterior mean and variance of the first coefficient, group sd or amplitude, from scores over the grid."""
    log_factors = np.array([p.log_bayes_factor for p in points])
    # Law of total variance over the grid: variance of the points' means plus mean of their variances.
    weights = np.exp(log_factors - logsumexp(log_factors))
    moments = np.array([_estimate_size_at_point(library, p) for p in points])
    mean = float(weights @ moments[:, 0])
    return mean, float(weights @ (moments[:, 1] + (moments[:, 0] - mean) ** 2))


def _estimate_size_at_point(library: Library, point: ScoredPoint) -> tuple[float, float]:
    effect = library.structures.candidates[point.name]
    if effect.measure:
        return point.prior_scale.shapes[effect.measure], 0.0
    sd, (u, information) = point.prior_scale.sd, point.standardised
    if library.is_grouped(point.name):
        return _estimate_group_sd(information, u, float(sd[0]), effect.coefficients[0].size)
    # Posterior of standard normal coefficients with information K and score u: mean (I + K)⁻¹u, covariance (I + K)⁻¹.
    covariance = np.linalg.inv(np.eye(len(sd)) + information)
    return float((covariance @ u)[0] * sd[0]), float(covariance[0, 0] * sd[0] ** 2)


def _estimate_group_sd(
    information: np.ndarray, score: np.ndarray, scale: float, prior_size: float
) -> tuple[float, float]:
    """Return posterior mean and variance of a between-group standard deviation under its half-normal prior."""
    eigenvalues, eigenvectors = np.linalg.eigh(information)
    eigenvalues, squares = np.maximum(eigenvalues, 0.0), (eigenvectors.T @ score) ** 2
    variance, size = SPREAD_FACTORS[:, None] ** 2, SPREAD_FACTORS * scale
    # Along an eigenvector of the members' information K, eigenvalue λ, the score has variance λ + λ²τ² under spread τ.
    log_terms = squares * variance / (1 + eigenvalues * variance) - np.log1p(eigenvalues * variance)
    log_factors = 0.5 * np.sum(log_terms, axis=1)
    log_factors += np.log(size) - 0.5 * (size / prior_size) ** 2  # log prior density of log τ
    weights = np.exp(log_factors - logsumexp(log_factors))
    mean = float(weights @ size)
    return mean, float(weights @ (size - mean) ** 2)


def _compute_marginal_score(point: ScoredPoint, is_group: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return score and information, in prior sd, of a group's members, or marginal ones of the first coefficient."""
    score, information = point.standardised
    if is_group or len(score) == 1:
        return score, information
    # Schur complement: the other coefficients, of prior variance one, are integrated out of score and information.
    inner_matrix = information[1:, 1:] + np.eye(len(score) - 1)
    solution = np.linalg.solve(inner_matrix, np.column_stack([information[1:, :1], score[1:]]))
    cross = information[:1, 1:]
    return score[:1] - cross @ solution[:, 1], information[:1, :1] - cross @ solution[:, :1]


def _compute_z_score(point: ScoredPoint, is_group: bool) -> float:
    score, information = _compute_marginal_score(point, is_group)
    if len(score) == 1:
        return float(score[0] / np.sqrt(information[0, 0])) if information[0, 0] > 0 else 0.0
    # Without the effect uᵀK⁺u is χ² with rank(K) degrees of freedom; z has the same one-sided tail probability.
    eigenvalues, vectors = np.linalg.eigh(information)
    is_positive = eigenvalues > 1e-10 * max(eigenvalues.max(), 1e-300)
    chi_square = float(np.sum((vectors.T @ score)[is_positive] ** 2 / eigenvalues[is_positive]))
    return float(-ndtri(max(chdtrc(is_positive.sum(), chi_square), 1e-300)))


def _compute_minimum_detectable(library: Library, point: ScoredPoint) -> float | None:
    """Return the size that would be found with 80 % power under its prior odds; None if there is none."""
    probability, is_group = settings().found_probability, library.is_grouped(point.name)
    structures = library.structures
    forms = structures.forms[structures.family(point.name)]  # each form would be a finding
    log_odds = float(logsumexp([structures.log_odds[n] for n in forms]))
    nats = math.log(probability / (1 - probability)) - log_odds
    _, information = _compute_marginal_score(point, is_group)
    if is_group:
        measure = library.structures.candidates[point.name].measure
        amplitude = point.prior_scale.shapes[measure] if measure else float(point.prior_scale.sd[0])
        return _detectable_amplitude(information, amplitude, nats)
    i = float(information[0, 0])
    if i <= 1e-12:
        return None
    # With z = u/√i the log Bayes factor is ½·z²·i/(1 + i) − ½·log(1 + i): solved for z. A coefficient of c prior
    # standard deviations makes z normal about c·√i; the power sets by which quantile c·√i is beyond the threshold.
    threshold = np.sqrt(2 * (nats + 0.5 * np.log1p(i)) * (1 + i) / i)
    return float((threshold + ndtri(settings().power)) / np.sqrt(i) * point.prior_scale.sd[0])


def _detectable_amplitude(information: np.ndarray, amplitude: float, nats: float) -> float | None:
    """Return the amplitude of a group at which 80 % of draws reach `nats` of evidence; None if there is none."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    if values.max(initial=0.0) <= 1e-12:
        return None
    normal_draws = np.random.default_rng(0).standard_normal((400, len(values)))
    for factor in np.geomspace(0.01, 1e4, 120):
        # The score along each axis has variance λ + λ²·factor² in units of the amplitude.
        square, ratio = normal_draws**2 * (values + values**2 * factor**2), values * factor**2
        log_factor = 0.5 * square * factor**2 / (1 + ratio) - 0.5 * np.log1p(ratio)
        if np.mean(log_factor.sum(axis=1) >= nats) >= settings().power:
            return float(factor * amplitude)
    return None


def find_indistinguishable(points: Scores) -> dict[str, set[str]]:
    """Return for each candidate the other candidates whose fitted contributions are parallel to its own."""
    columns, projections, top_points = [], [], [scores[0] for scores in points.values()]
    rows = top_points[0].scorer.choose_linear_model([point.point for point in top_points])
    for p in top_points:
        sd = p.prior_scale.sd
        score, information = p.standardised
        # Fitted contributions, nuisances projected out: candidates are indistinguishable where these are parallel.
        coefficients = sd * np.linalg.solve(np.eye(len(sd)) + information, score)
        columns.append(rows.whiten(p.scorer.columns(rows, [p.point])) @ coefficients)
        projections.append(p.projection @ coefficients)
    names, whitened, projected_columns = list(points), np.array(columns), np.array(projections)
    gram = whitened @ whitened.T - projected_columns @ projected_columns.T
    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    cosine = np.abs(gram / np.outer(norms, norms))
    parallel = (cosine > PARALLEL_COSINE) & ~np.eye(len(names), dtype=bool)
    return {name: {names[j] for j in np.flatnonzero(parallel[i])} for i, name in enumerate(names)}


def classify_candidate(candidate: Candidate, finding: set[str], effect: Effect | None) -> Candidate:
    """Return the candidate with its kind, given the effects of its finding, if any, and the scored effect, if any."""
    if finding:
        is_likely = (candidate.probability or 0.0) >= settings().found_probability
        is_found = is_likely or len(finding) == 1
        return replace(candidate, kind="finding" if is_found else "one of several")
    if (candidate.probability or 0.0) >= LEAD_PROBABILITY:
        return replace(candidate, kind="lead")
    # A candidate with strong evidence is visible: another effect explains the readings.
    if effect is None or (candidate.log_bayes_factor or 0.0) > settings().strong_evidence:
        return candidate
    size_limits = (s.high for s in effect.shapes if s.name == effect.measure)
    plausible_size = next(size_limits, effect.coefficients[0].size)
    # Visible: ten plausible sizes would be found; one, where nuisances take all but a hundredth of the information.
    is_hidden = (candidate.visibility or 0.0) < UNDECIDED_RATIO
    max_size, detectable_size = MAX_DETECTABLE_SIZES * plausible_size, candidate.minimum_detectable
    if detectable_size is None or detectable_size > (plausible_size if is_hidden else max_size):
        return replace(candidate, kind="not visible", reason="not detectable in this experiment")
    return candidate
