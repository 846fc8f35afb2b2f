"""What the readings say of one effect that is not in a model: by refit where there was one, else by the score."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc, logsumexp, ndtri

from bayescal._calibration.claim import Claim
from bayescal._calibration.judgement import implausible_scale
from bayescal._core.null_space import UNDECIDED_SHARE
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.linear_model import learned_amplitude
from bayescal._model.effect import Effect, Role
from bayescal._search.library import Library
from bayescal._search.scores import ScoredPoint, gain_of
from bayescal._search.structures import Structures, Weighed

# Probability from which what is not found is named as a lead: odds of 1 to 4, worth a further run.
LEAD_PROBABILITY = 0.2
# Cosine of two fitted contributions from which readings cannot tell them apart: 0.95 leaves a tenth of the squares.
ALIKE_COSINE = 0.95
# Plausible sizes that an effect would need to be seen, beyond which this experiment cannot test it; a plausible size
# is known to an order of magnitude.
DETECTABLE_SIZES = 10.0

FINE = np.geomspace(1 / 30, 30, 61)  # amplitudes of a group, about the likeliest of its grid


@dataclass(frozen=True)
class Candidate:
    """What the readings say of one effect that is not in the model.

    Attributes:
        effect: canonical name, of a family of forms that of the family.
        form: the most probable form, where there are several.
        probability: that it is missing from the model; None if it cannot be tested.
        log_bayes_factor: of the model with it against the model as it is, natural logarithm.
        source: "refit" where the model was fitted again with it, else "score".
        z: size over its uncertainty (a group's chi-square as the z of equal probability).
        size, size_sd: expected coefficient and its uncertainty, in `unit`; for a group effect its spread, for an
            unknown dependence its amplitude.
        shape: expected shape parameters, in their units.
        visibility: information left after the nuisances over information before them.
        minimum_detectable: size in `unit` that would be found with 80 % power.
        kind: "finding", "lead", "not visible", "not testable", or None: no evidence for it.
        indistinguishable_from: others that these readings cannot tell from it.
        reason: why it is not testable or not visible.
        role: "named", "unnamed" for an unknown function of a covariate, "freed" for an effect freed of its stated
            value: `frees` is then its name.
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
        """Return whether these readings say nothing of it."""
        return self.kind in ("not visible", "not testable")


def best_form(
    structures: Structures, points: Mapping[str, Sequence[ScoredPoint]]
) -> dict[str, Sequence[ScoredPoint]]:
    """Return, by family, the scores of the form that gains most."""
    best: dict[str, Sequence[ScoredPoint]] = {}
    for name, scores in points.items():
        family = structures.family(name)
        if family not in best or gain_of(scores) > gain_of(best[family]):
            best[family] = scores
    return best


def judge(
    library: Library,
    name: str,
    form: str,
    points: Sequence[ScoredPoint],
    at: Weighed,
    with_it: Weighed | None,
) -> Candidate:
    """Return one candidate, a family in its most probable form, by its scores and, if evaluated, by the refit."""
    structures = library.structures
    scored, several = points[0].effect if points else form, len(structures.forms[name]) > 1
    effect = structures.candidates[scored]
    labels = {"unit": effect.coefficients[0].unit, "role": effect.role, "frees": effect.frees}
    candidate = Candidate(effect=name, form=form if several else "", **labels)
    if points:
        top, before = points[0], float(np.trace(points[0].products))
        candidate = replace(
            candidate,
            log_bayes_factor=gain_of(points),
            z=_z(top, library.grouped(scored)),
            shape={**top.point.shapes, **top.size.scales},
            visibility=float(np.trace(top.information)) / before if before > 0 else 0.0,
            minimum_detectable=_minimum_detectable(library, top),
        )
    if with_it is not None and math.isfinite(with_it.log_evidence):
        # A refit averages over sizes and finds its shapes, where a score says where it began.
        factor = with_it.log_evidence - at.log_evidence
        refitted = _by_refit(structures.candidates[form], with_it)
        return replace(candidate, log_bayes_factor=factor, source="refit", **refitted)
    if not points:
        return candidate
    mean, variance = _size(library, points)
    return replace(candidate, size=mean, size_sd=math.sqrt(variance))


def off_scale_claims(
    library: Library, points: Mapping[str, Sequence[ScoredPoint]], at: Weighed
) -> tuple[Claim, ...]:
    """Return claims on candidates whose plausible size is far off the scale of these readings."""
    structures, claims = library.structures, []
    noise = math.sqrt(float(np.median(structures.line(at).variance)))
    for top, *_ in points.values():
        effect = structures.candidates[top.effect]
        largest = float(np.max(np.abs(top.view.columns(top.view.line, [top.point])[:, 0])))
        most = largest * effect.coefficients[0].size
        claims += implausible_scale(effect, most, noise, structures.base.instrument.unit)
    return tuple(claims)


def _by_refit(effect, with_it: Weighed) -> dict:
    """Return the size with its uncertainty, and the shapes, at the refit's mode."""
    problem, mode = with_it.problem, with_it.mode
    hyper = problem.hyper(mode.v)
    shapes = {s.name: float(hyper[effect.shape_name(s)]) for s in effect.shapes}
    if effect.held:  # a body: what is to be known of it is its time
        first_shape = effect.shapes[0]
        size, sd = problem.value_and_sd(effect.shape_name(first_shape), mode.v, mode.covariance)
        return {"size": size, "size_sd": sd, "shape": shapes, "unit": first_shape.unit}
    if learned := learned_amplitude(effect, problem, mode):
        return {"size": learned[0], "size_sd": learned[1], "shape": shapes}
    term = next(t for t in problem.in_x if t.effect.name == effect.name)
    _, got = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)
    # Given φ̂: the noise and the shapes are held, as in a score.
    sd = 0.0 if got is None else math.sqrt(got.covariance[term.x_slice.start, term.x_slice.start])
    return {"size": float(mode.x[term.x_slice.start]), "size_sd": sd, "shape": shapes}


def _size(library: Library, points: Sequence[ScoredPoint]) -> tuple[float, float]:
    """Return mean and variance of the first coefficient, spread or amplitude by score, over the grid."""
    gains = np.array([p.gain for p in points])
    # Mean and variance over the grid: variance of a point's mean plus mean of its variance (law of total variance).
    share = np.exp(gains - logsumexp(gains))
    moments = np.array([_at_point(library, p) for p in points])
    mean = float(share @ moments[:, 0])
    return mean, float(share @ (moments[:, 1] + (moments[:, 0] - mean) ** 2))


def _at_point(library: Library, point: ScoredPoint) -> tuple[float, float]:
    effect = library.structures.candidates[point.effect]
    if effect.measure:
        return point.size.scales[effect.measure], 0.0
    sd, (u, information) = point.size.sd, point.standard
    if library.grouped(point.effect):
        return _spread(information, u, float(sd[0]), effect.coefficients[0].size)
    # Posterior of standard normal coefficients with information K and score u: mean (I + K)⁻¹u, covariance (I + K)⁻¹.
    inverse = np.linalg.inv(np.eye(len(sd)) + information)
    return float((inverse @ u)[0] * sd[0]), float(inverse[0, 0] * sd[0] ** 2)


def _spread(
    information: np.ndarray, u: np.ndarray, scale: float, prior: float
) -> tuple[float, float]:
    """Return mean and variance of a group's spread under its half-normal prior."""
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0.0), (vectors.T @ u) ** 2
    square, size = FINE[:, None] ** 2, FINE * scale
    # Along an eigenvector of the members' information K a spread τ makes the score one of variance λ + λ²τ²: the log
    # Bayes factor of τ is a sum over eigenvectors.
    logs = along * square / (1 + values * square) - np.log1p(values * square)
    factor = 0.5 * np.sum(logs, axis=1)
    factor += np.log(size) - 0.5 * (size / prior) ** 2  # the prior, by the logarithm
    weight = np.exp(factor - logsumexp(factor))
    mean = float(weight @ size)
    return mean, float(weight @ (size - mean) ** 2)


def _main(point: ScoredPoint, group: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return score and information, in plausible sizes, of a group's members or of the first coefficient, marginal."""
    u, information = point.standard
    if group or len(u) == 1:
        return u, information
    # Schur complement: companions, of prior variance one, are integrated out of score and information.
    companions = information[1:, 1:] + np.eye(len(u) - 1)
    pull = np.linalg.solve(companions, np.column_stack([information[1:, :1], u[1:]]))
    cross = information[:1, 1:]
    return u[:1] - cross @ pull[:, 1], information[:1, :1] - cross @ pull[:, :1]


def _z(point: ScoredPoint, group: bool) -> float:
    u, information = _main(point, group)
    if len(u) == 1:
        return float(u[0] / np.sqrt(information[0, 0])) if information[0, 0] > 0 else 0.0
    # uᵀK⁺u is χ² of the rank of K if nothing is there; z has the same tail probability on one side.
    values, vectors = np.linalg.eigh(information)
    keep = values > 1e-10 * max(values.max(), 1e-300)
    square = float(np.sum((vectors.T @ u)[keep] ** 2 / values[keep]))
    return float(-ndtri(max(chdtrc(keep.sum(), square), 1e-300)))


def _minimum_detectable(library: Library, point: ScoredPoint) -> float | None:
    """Return the size that is found with 80 % power under its prior odds; None where none is."""
    probability, group = settings().found_probability, library.grouped(point.effect)
    structures = library.structures
    forms = structures.forms[structures.family(point.effect)]  # by any of which it is found
    odds = float(logsumexp([structures.log_odds[n] for n in forms]))
    needed = math.log(probability / (1 - probability)) - odds
    _, information = _main(point, group)
    if group:
        measure = library.structures.candidates[point.effect].measure
        amplitude = point.size.scales[measure] if measure else float(point.size.sd[0])
        return _detectable_amplitude(information, amplitude, needed)
    i = float(information[0, 0])
    if i <= 1e-12:
        return None
    # With z = u/√i the log Bayes factor is ½·z²·i/(1 + i) − ½·log(1 + i): solved for z. A coefficient of c sizes
    # makes z normal about c·√i, which passes the threshold with that power when it stands its quantile beyond.
    threshold = np.sqrt(2 * (needed + 0.5 * np.log1p(i)) * (1 + i) / i)
    return float((threshold + ndtri(settings().power)) / np.sqrt(i) * point.size.sd[0])


def _detectable_amplitude(information: np.ndarray, amplitude: float, needed: float) -> float | None:
    """Return the amplitude of a group that reaches the needed log Bayes factor in 80 % of draws."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    if values.max(initial=0.0) <= 1e-12:
        return None
    normal = np.random.default_rng(0).standard_normal((400, len(values)))
    for factor in np.geomspace(0.01, 1e4, 120):
        # u² along each axis has variance I + I²·factor² in units of the amplitude
        square = normal**2 * (values + values**2 * factor**2)
        weight = factor**2
        gain = 0.5 * square * weight / (1 + values * weight) - 0.5 * np.log1p(values * weight)
        if np.mean(gain.sum(axis=1) >= needed) >= settings().power:
            return float(factor * amplitude)
    return None


def indistinguishable(points: Mapping[str, Sequence[ScoredPoint]]) -> dict[str, set[str]]:
    """Return, for each candidate, those whose fitted contributions are parallel to its own."""
    outside, inside = [], []
    tops = [scores[0] for scores in points.values()]
    rows = tops[0].view.rows([p.point for p in tops])
    for p in tops:
        sd = p.size.sd
        u, information = p.standard
        # What is fitted of each, at its likeliest grid point, and of this what the nuisances leave: two candidates
        # are one where these two vectors are parallel, whatever their columns look like.
        fitted = sd * np.linalg.solve(np.eye(len(sd)) + information, u)
        outside.append(rows.whiten(p.view.columns(rows, [p.point])) @ fitted)
        inside.append(p.inside @ fitted)
    names, c, p = list(points), np.array(outside), np.array(inside)
    gram = c @ c.T - p @ p.T
    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    cosine = np.abs(gram / np.outer(norms, norms))
    return {
        name: {names[j] for j in np.flatnonzero(cosine[i] > ALIKE_COSINE) if j != i}
        for i, name in enumerate(names)
    }


def kind_of(candidate: Candidate, is_found: bool, effect: Effect | None) -> Candidate:
    """Return the candidate with its kind: whether it is found, a lead, or not to be seen by the effect of its score."""
    if is_found:
        return replace(candidate, kind="finding")
    if (candidate.probability or 0.0) >= LEAD_PROBABILITY:
        return replace(candidate, kind="lead")
    # What is to be seen well enough is explained by what was found.
    if effect is None or (candidate.log_bayes_factor or 0.0) > settings().strong_evidence:
        return candidate
    scales = (s.high for s in effect.shapes if s.name == effect.measure)
    plausible = next(scales, effect.coefficients[0].size)
    # Visible means: a plausible size would be found. Where nuisances take all but a hundredth, what is left hangs on
    # their exact form, and the plausible size must be enough by itself.
    least, hidden = candidate.minimum_detectable, (candidate.visibility or 0.0) < UNDECIDED_SHARE
    most = plausible * (1.0 if hidden else DETECTABLE_SIZES)
    if least is None or least > most:
        return replace(candidate, kind="not visible", reason="not detectable in this experiment")
    return candidate
