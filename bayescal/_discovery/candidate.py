"""What the readings say of one candidate effect on its own, by the efficient score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp, ndtri
from scipy.stats import chi2, norm

from bayescal._diagnostics import efficient_score
from bayescal._discovery import candidate_columns, susie
from bayescal._model.unknown_effect import covariate_in

FINDING = 0.05  # P(nothing is missing) at or below which an effect is reported as found
POWER = 0.80
FINE = np.geomspace(1 / 30, 30, 61)  # amplitudes of a group, about the likeliest of its grid
ALIKE = 0.95  # cosine of fitted contributions from which two candidates are hard to tell apart


@dataclass(frozen=True)
class Candidate:
    """What the readings say of one effect that is not in the model.

    Attributes:
        effect: canonical name.
        probability: that it is missing from the model; None if it cannot be tested.
        log_bayes_factor: of the model with it against the model as it is, natural logarithm.
        source: "score", or "refit" where the model was fitted again with it.
        z: size over its uncertainty (a group's chi-square as the z of equal probability).
        size, size_sd: expected coefficient and its uncertainty, in `unit`; for a group effect its spread, for an
            unknown dependence its amplitude.
        shape: expected shape parameters, in their units.
        visibility: information left after the nuisances over information before them.
        minimum_detectable: size in `unit` that would be found with 80 % power.
        kind: "finding", "lead", "not visible", "not testable", or None: no evidence for it.
        indistinguishable_from: others that these readings cannot tell from it.
        reason: why it is not testable or not visible.
        prior: share of the prior probability that an effect is missing.
        conditional: log Bayes factor by score given the leading finding; None where there is none.
    """

    effect: str
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
    prior: float = 0.0
    conditional: float | None = None

    @property
    def unknown(self) -> bool:
        """Whether it is an unknown function of a covariate rather than an effect with a name."""
        return covariate_in(self.effect) is not None


@dataclass(frozen=True)
class _Grid:
    """A candidate's grid points, each with its score."""

    parts: tuple[efficient_score.Score, ...]
    log_weight: np.ndarray
    points: tuple[candidate_columns.GridPoint, ...]

    @property
    def log_factors(self) -> np.ndarray:
        return np.array(
            [susie.log_bayes_factor(p.u, p.information, np.ones(len(p.u))) for p in self.parts]
        )


def _grid(columns: candidate_columns.Columns, score: efficient_score.Score, index: int) -> _Grid:
    at = columns.of(index)
    return _Grid(
        tuple(score.part(list(columns.items[i].columns)) for i in at),
        np.log([columns.items[i].weight for i in at]),
        tuple(columns.points[i] for i in at),
    )


def judge(
    columns: candidate_columns.Columns, score: efficient_score.Score, index: int, probability: float
) -> Candidate:
    """One candidate on its own, its shapes and spreads averaged over their priors."""
    effect = columns.effects[index]
    first, unit = candidate_columns.reported(effect)
    grid = _grid(columns, score, index)
    log_weight = grid.log_weight + grid.log_factors
    total = float(np.asarray(logsumexp(log_weight)))
    share = np.exp(log_weight - total)
    top = int(np.argmax(share))
    sizes = [
        _size(part, point, first.size) for part, point in zip(grid.parts, grid.points, strict=True)
    ]
    means = np.array([mean for mean, _ in sizes])
    size = float(share @ means)
    spread = float(share @ (np.array([v for _, v in sizes]) + (means - size) ** 2))
    main, amplitude = grid.parts[top], grid.points[top].amplitude
    prior = columns.prior[index]
    return Candidate(
        effect=effect.name,
        probability=probability,
        log_bayes_factor=total,
        z=_z(main, amplitude is not None),
        size=size,
        size_sd=float(np.sqrt(spread)),
        unit=unit,
        shape={
            s.name: float(share @ [g.shapes[s.name] for g in grid.points]) for s in effect.shapes
        },
        visibility=_visibility(main),
        minimum_detectable=_minimum_detectable(main, first.size, prior, amplitude),
        prior=prior,
    )


def _size(
    part: efficient_score.Score, point: candidate_columns.GridPoint, prior: float
) -> tuple[float, float]:
    """Expected size and its variance at one grid point: of the first coefficient, or of a group's spread.

    A spread is averaged over a grid finer than that of the search, under its half-normal prior of scale `prior`. The
    amplitude of an unknown dependence is that of the grid point.
    """
    if point.amplitude is None:
        inverse = np.linalg.inv(np.eye(len(part.u)) + part.information)
        return float((inverse @ part.u)[0] * prior), float(inverse[0, 0] * prior**2)
    if not point.spread:
        return point.amplitude, 0.0
    values, vectors = np.linalg.eigh(part.information)
    values, along = np.maximum(values, 0.0), (vectors.T @ part.u) ** 2
    square = FINE[:, None] ** 2
    size = FINE * point.amplitude
    factor = 0.5 * np.sum(
        along * square / (1 + values * square) - np.log1p(values * square), axis=1
    )
    factor += np.log(size) - 0.5 * (size / prior) ** 2  # the prior, by the logarithm
    weight = np.exp(factor - logsumexp(factor))
    mean = float(weight @ size)
    return mean, float(weight @ (size - mean) ** 2)


def _main(part: efficient_score.Score, group: bool) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of what speaks for the effect: all members of a group, or the first coefficient
    with its companions marginalised."""
    if group or len(part.u) == 1:
        return part.u, part.information
    rest = part.information[1:, 1:] + np.eye(len(part.u) - 1)
    pull = np.linalg.solve(rest, np.column_stack([part.information[1:, :1], part.u[1:]]))
    cross = part.information[:1, 1:]
    return part.u[:1] - cross @ pull[:, 1], part.information[:1, :1] - cross @ pull[:, :1]


def _z(part: efficient_score.Score, group: bool) -> float:
    u, information = _main(part, group)
    if len(u) == 1:
        return float(u[0] / np.sqrt(information[0, 0])) if information[0, 0] > 0 else 0.0
    values, vectors = np.linalg.eigh(information)
    keep = values > 1e-10 * max(values.max(), 1e-300)
    square = float(np.sum((vectors.T @ u)[keep] ** 2 / values[keep]))
    return float(norm.isf(max(chi2.sf(square, keep.sum()), 1e-300)))


def _visibility(part: efficient_score.Score) -> float:
    before = float(np.sum(part.before))
    return float(np.trace(part.information)) / before if before > 0 else 0.0


def _minimum_detectable(
    part: efficient_score.Score, size: float, prior: float, amplitude: float | None
) -> float | None:
    """Size found with 80 % power: the log Bayes factor reaches what a finding needs under its share of the prior."""
    needed = np.log((1 - FINDING) / FINDING / prior)
    group = amplitude is not None
    _, information = _main(part, group)
    if group:
        return _detectable_amplitude(information, amplitude or size, needed)
    i = float(information[0, 0])
    if i <= 1e-12:
        return None
    threshold = np.sqrt(2 * (needed + 0.5 * np.log1p(i)) * (1 + i) / i)
    return float((threshold + ndtri(POWER)) / np.sqrt(i) * size)


def _detectable_amplitude(information: np.ndarray, amplitude: float, needed: float) -> float | None:
    """For a group: the amplitude whose members' draws reach the needed log Bayes factor in 80 % of cases."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    if values.max(initial=0.0) <= 1e-12:
        return None
    normal = np.random.default_rng(0).standard_normal((400, len(values)))
    for factor in np.geomspace(0.01, 1e4, 120):
        # u² along each axis has variance I + I²·factor² in units of the amplitude
        square = normal**2 * (values + values**2 * factor**2)
        weight = factor**2
        gain = 0.5 * square * weight / (1 + values * weight) - 0.5 * np.log1p(values * weight)
        if np.mean(gain.sum(axis=1) >= needed) >= POWER:
            return float(factor * amplitude)
    return None


def name_aliases(
    judged: Sequence[Candidate],
    columns: candidate_columns.Columns,
    score: efficient_score.Score,
    found: susie.SingleEffects,
) -> list[Candidate]:
    """Which candidates' fitted contributions are one and the same to these readings."""
    best = []
    for index in range(len(judged)):
        at = _likeliest(columns, score, index)
        part = score.part(at)
        vector = np.zeros(len(score.u))
        vector[at] = np.linalg.solve(np.eye(len(at)) + part.information, part.u)
        best.append(vector)
    stack = np.array(best)
    gram = stack @ score.information @ stack.T
    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    cosine = np.abs(gram / np.outer(norms, norms))
    names = [c.effect for c in judged]
    named = []
    for i, c in enumerate(judged):
        same = {names[j] for j in np.flatnonzero(cosine[i] > ALIKE) if j != i}
        for s in found.sets:
            if i in s.members:
                same |= {names[m] for m in s.members if m != i}
        named.append(replace(c, indistinguishable_from=tuple(sorted(same))))
    return named


def given(
    judged: Sequence[Candidate],
    columns: candidate_columns.Columns,
    score: efficient_score.Score,
    leading: int,
) -> list[Candidate]:
    """Every candidate's log Bayes factor once the leading one is in the model: the next step's view, by score."""
    held = _likeliest(columns, score, leading)
    after = score.given(held)
    updated = []
    for index, c in enumerate(judged):
        if index == leading:
            updated.append(c)
            continue
        grid = _grid(columns, after, index)
        updated.append(
            replace(c, conditional=float(np.asarray(logsumexp(grid.log_weight + grid.log_factors))))
        )
    return updated


def _likeliest(
    columns: candidate_columns.Columns, score: efficient_score.Score, index: int
) -> list[int]:
    """Columns of a candidate's likeliest grid point."""
    grid = _grid(columns, score, index)
    return list(grid.points[int(np.argmax(grid.log_weight + grid.log_factors))].columns)
