"""Least squares on the host: coefficients and shapes by Gauss–Newton, scales by restricted likelihood, in turn.

All solves are by QR of whitened tables, never by JᵀJ, so that no condition number is squared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgeqrf, dtrtri  # pyright: ignore[reportAttributeAccessIssue]
from scipy.optimize import minimize, root

from bayescal._core.gaussian_algebra import LOG_2PI, QR, Prior, qr
from bayescal._core.parallel import on_one_thread
from bayescal._engine.assembly import Assembly, Line, Point
from bayescal._engine.closed_form import Density
from bayescal._engine.mode import Mode
from bayescal._engine.noise_slopes import even_slope, noise_slopes, spread_slope
from bayescal._engine.whitening import Whitening, whitening
from bayescal._model.correlated_noise import CORRELATION_TIME, DIFFUSION

SCALES = ("noise.white", DIFFUSION, CORRELATION_TIME)  # whose priors do not count
STILL = 1e-6  # standard deviations: a further step smaller than this is none
GOOD = 1e-5  # share of the residuals in the tangent plane, at which a point counts as the optimum
RESTS = 1e-9  # change of φ's coordinates in a round, below which it rests
ROUNDS = 30  # at most
STEPS = 200  # of θ in a round
SHIFT = 1e-4  # of a coordinate, for slopes by differences
EDGE = (
    5.0  # coordinate of a time between bounds, from which it stands at one: nothing stops it beyond
)


class Solution(NamedTuple):
    """x̂ and shapes at the maximum, scales by restricted likelihood, and the covariance of (x, shapes)."""

    mode: Mode
    covariance: Float[np.ndarray, "q q"]
    converged: bool


class _Given(NamedTuple):
    """θ integrated out of the model linearised somewhere, given φ."""

    log_marginal: float
    theta: Float[np.ndarray, "q"]
    covariance: Float[np.ndarray, "q q"]
    squares: float  # of the whitened residuals at the mean, without the prior's
    spent: float  # degrees of freedom
    slopes: dict[int, float]  # of log_marginal by the scales' coordinates


@on_one_thread
def refine(assembly: Assembly, mode: Mode, full_hessian: bool) -> Solution:
    """From the mode: (x, shapes) by least squares and scales by restricted likelihood in turn, until both rest.

    Args:
        assembly: the structure on its record.
        mode: its mode.
        full_hessian: whether the covariance takes second derivatives of the expected output.
    """
    fit = _Refinement(assembly, mode)
    # Where JᵀJ has no Cholesky factor the mode is nowhere; from the prior's centre, QR may find it.
    found = np.all(np.isfinite(mode.point.x)) and math.isfinite(mode.log_evidence)
    x = mode.point.x if found else assembly.mean_of_x
    v = np.where(np.isfinite(mode.v), mode.v, 0.0)
    theta, converged = np.concatenate([x, v[fit.places]]), False
    for _ in range(ROUNDS):
        theta, converged = fit.fit_theta(theta, v)
        moved = fit.fit_scales(theta, _put(theta[assembly.size :], fit.places, v))
        change = float(np.max(np.abs(moved - v), initial=0.0))
        v = moved
        if not change > RESTS:
            break
    given = fit.conditional(theta, v)(v)
    # What counts is whether a Gauss–Newton step would still move anything.
    sd = np.sqrt(np.diag(given.covariance))
    converged = converged or bool(np.max(np.abs(given.theta - theta) / sd, initial=0.0) < STILL)
    covariance = given.covariance
    if (full_hessian or not fit.gaussian) and np.all(np.isfinite(covariance)):
        covariance = np.linalg.inv(fit.hessian(theta, v, sd))
    point = Point(theta[: assembly.size], mode.point.rows)
    return Solution(mode._replace(point=point, v=v), covariance, converged)


class _Refinement:
    """One fit of θ = (x, w), w the shapes' coordinates, and v, those of all φ; where both have w, that in θ counts."""

    def __init__(self, assembly: Assembly, mode: Mode) -> None:
        self.assembly, self.mode = assembly, mode
        self.density = Density(assembly, mode.point, mode.flat)
        kinds, self.gaussian = assembly.kinds, assembly.noise.gaussian
        # Of a law that is not Gaussian they stay where the marginal likelihood of the mode has them.
        self.scales = [i for i, k in enumerate(kinds) if k in ("noise", "spread") and self.gaussian]
        self.places = [i for i, k in enumerate(kinds) if k in ("shape", "promoted")]

    def prior(self, v: Float[np.ndarray, "d"]) -> Prior:
        """Of θ: that of x given φ, and the standard normal one of w."""
        own = self.assembly.prior(self.assembly.hyper(v), self.mode.flat)
        further = np.ones(len(self.places))
        return Prior(
            np.append(own.mean, 0 * further),
            np.append(own.sd, further),
            np.append(own.weight, further),
        )

    def table(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        """Slopes by θ beside what the expected output leaves, and the variance that the rows add."""
        size = self.assembly.size
        point = Point(theta[:size], self.mode.point.rows)

        def linearised(located: np.ndarray) -> Line:
            return self.assembly.linearise(
                point, self.assembly.hyper(_put(located, self.places, v))
            )

        line = linearised(theta[size:])
        moved = _differences(lambda w: linearised(w).mean, theta[size:], SHIFT)
        rest = self.assembly.record.y - line.mean + np.sum(line.rows * point.rows, axis=1)
        return np.column_stack([line.jacobian, *moved, rest]), self.density.extra(line)

    def whiten(self, v: np.ndarray, extra: np.ndarray | float, left: np.ndarray) -> Whitening:
        assembly = self.assembly
        return whitening(assembly.noise, assembly.hyper(v), assembly.record, extra, left)

    def fit_theta(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, bool]:
        """θ by least squares of the whitened residuals and the prior's, given the scales in v."""
        if not theta.size:
            return theta, True
        prior, (first, extra) = self.prior(v), self.table(theta, v)
        own = np.diag(prior.weight)

        def look(at: np.ndarray, made: np.ndarray | None = None) -> tuple[float, QR]:
            plain = self.table(at, v)[0] if made is None else made
            white = self.whiten(v, extra, plain[:, -1])
            table = white(plain)
            z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            whole = np.concatenate([table * np.append(prior.sd, 1.0), np.column_stack([own, -z])])
            if not np.all(np.isfinite(whole)):
                return math.inf, qr(np.zeros_like(whole))
            return float(whole[:, -1] @ whole[:, -1]) + white.beyond, qr(whole)

        cost, found = look(theta, first)
        damping, best = 0.0, float(np.linalg.norm(found.inside))
        for _ in range(STEPS):
            if not found.determined:
                return theta, False
            trial = theta + prior.sd * found.damped(damping)
            there, further = look(trial)
            left = float(np.linalg.norm(further.inside))
            near = best <= GOOD * math.sqrt(cost)
            # With thermometer errors J is not quite the residuals' slope: a step that settles may cost a little.
            settles = left < 0.8 * best and there < cost * (1 + (1e-6 if near else 1e-3))
            if settles or (not near and there < cost):
                theta, cost, found, best = trial, there, further, left
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                continue
            if near or damping > 1e12:
                break
            damping = max(10 * damping, 1e-3)
        return theta, best <= GOOD * math.sqrt(cost)

    def conditional(self, theta: np.ndarray, v: np.ndarray) -> Callable[..., _Given]:
        """A function of φ's coordinates: θ integrated out of the model linearised here, by QR; with slopes if asked."""
        table, extra = self.table(theta, v)
        size, even = len(table), self.density.even
        upper = np.triu(dgeqrf(table)[0][: table.shape[1]]) if even else table
        lost = np.full((theta.size, theta.size), np.nan)
        nowhere = _Given(-math.inf, np.full(theta.size, np.nan), lost, math.nan, math.nan, {})

        def given(v: np.ndarray, sloped: bool = False) -> _Given:
            prior, white = self.prior(v), None
            if even:
                sd = self.assembly.hyper(v)["noise.white"]
                if not sd > np.finfo(float).tiny:
                    return nowhere
                made, logdet = upper / sd, 2 * size * math.log(sd)
            else:
                white = self.whiten(v, extra, table[:, -1])
                made, logdet = white(upper), white.logdet
            offset = prior.weight * (prior.mean - theta)
            own = np.column_stack([made[:, :-1] * prior.sd, made[:, -1] - made[:, :-1] @ offset])
            rows = np.column_stack([np.diag(prior.weight), 0 * offset])
            found = qr(np.concatenate([own, rows]))
            if not found.determined:
                return nowhere
            z = found.solution
            inverse = dtrtri(found.root)[0] if z.size else found.root
            of_z = inverse @ inverse.T
            root = prior.sd[:, None] * inverse
            log_sd = np.log(np.where(prior.weight > 0, 1.0, prior.sd))
            flat = (1 - prior.weight) @ (log_sd + 0.5 * LOG_2PI)
            volume = logdet + 2 * float(np.sum(np.log(np.abs(np.diag(found.root)))))
            rest = found.outside**2
            total = float(flat) - 0.5 * (size * LOG_2PI + volume + rest)
            mean = theta + offset + prior.sd * z
            squares = rest - float(prior.weight @ z**2)
            spent, slopes = z.size - float(np.diag(of_z) @ prior.weight), {}
            if sloped:
                excess = (z**2 + np.diag(of_z) - 1) * prior.weight
                slopes = self._slopes(v, excess, (squares, spent))
            if sloped and white is not None:
                turn = np.block([[root, (theta - mean)[:, None]], [0 * offset, np.ones(1)]])
                slopes |= noise_slopes(self.assembly, v, white, table @ turn, made @ turn)
            return _Given(total, mean, root @ root.T, squares, spent, slopes)

        return given

    def fit_scales(self, theta: np.ndarray, v: np.ndarray) -> np.ndarray:
        """v with its scales where the restricted likelihood, times the prior of the spreads, is greatest."""
        if not self.scales:
            return v
        given, assembly = self.conditional(theta, v), self.assembly
        if self.density.even and [assembly.kinds[i] for i in self.scales] == ["noise"]:
            return self._noise(given, v)
        hypers = [(i, assembly.hypers[i]) for i in self.scales]
        priors = [i for i, h in hypers if h.name not in SCALES]
        if not math.isfinite(given(v).log_marginal):
            return v

        def value(scales: np.ndarray) -> tuple[float, np.ndarray]:
            """Minus the log density, and its slopes."""
            there = _put(scales, self.scales, v)
            found = given(there, sloped=True)
            slopes = np.array([found.slopes.get(i, math.nan) for i in self.scales])
            counts = np.isin(self.scales, priors)
            slopes += counts * assembly.log_prior_slope(there)[self.scales]
            own = sum(float(assembly.hypers[i].prior.log_density(there[i])) for i in priors)
            return -found.log_marginal - own, -slopes

        def slope(scales: np.ndarray) -> np.ndarray:
            return value(scales)[1]

        best = v[self.scales]
        if np.max(np.abs(slope(best))) > 1e-3:
            found = minimize(value, best, jac=True)
            best = found.x if found.fun <= value(best)[0] else best
        sharper = root(slope, best, jac=partial(_differences, slope, step=SHIFT)).x
        best = min(best, sharper, key=lambda v: np.linalg.norm(slope(v)))
        bounded = [h.name == CORRELATION_TIME for _, h in hypers]
        return _put(np.where(bounded, np.clip(best, -EDGE, EDGE), best), self.scales, v)

    def _slopes(
        self, v: np.ndarray, excess: np.ndarray, spent: tuple[float, float]
    ) -> dict[int, float]:
        """By the spreads' coordinates, and by that of one white standard deviation for all readings."""
        found = {}
        for i in self.scales:
            if self.assembly.kinds[i] == "spread":
                found[i] = spread_slope(self.assembly, v, i, excess[: self.assembly.size])
            elif self.density.even:
                found[i] = even_slope(self.assembly, v, *spent)
        return found

    def _noise(self, given: Callable[[np.ndarray], _Given], v: np.ndarray) -> np.ndarray:
        """The one standard deviation of independent noise: squares over the degrees of freedom left."""
        (place,), y = self.scales, self.assembly.record.y
        least = (np.finfo(float).eps * float(np.max(np.abs(y)))) ** 2  # what the digits can tell
        for _ in range(100):
            found = given(v)
            if not (left := len(y) - found.spent) > 0:
                return v
            variance = max(found.squares / left, least)
            step = 0.5 * math.log(variance) / self.assembly.value_slope(v, place)
            v = _put(v[place] + step, [place], v)
            if abs(step) < 1e-12:
                break
        return v

    def hessian(self, theta: np.ndarray, v: np.ndarray, sd: np.ndarray) -> Float[np.ndarray, "q q"]:
        """Curvature of the negative log density of θ, second derivatives of the expected output included."""
        prior, extra = self.prior(v), self.table(theta, v)[1]
        tightness = prior.weight / prior.sd**2

        def slope(at: np.ndarray) -> np.ndarray:
            table = self.table(at, v)[0]
            table = self.whiten(v, extra, table[:, -1])(table)
            return tightness * (at - prior.mean) - table[:, :-1].T @ table[:, -1]

        rows = _differences(slope, theta, 1e-3 * sd)
        return 0.5 * (rows + rows.T)


def _put(values: np.ndarray, places: list[int], v: np.ndarray) -> np.ndarray:
    """v with other values in some places."""
    found = v.copy()
    found[places] = values
    return found


def _differences(f: Callable[[np.ndarray], Any], at: np.ndarray, step: Any) -> np.ndarray:
    """Slopes of a function by each coordinate; one step, or one each."""
    shifts = np.diag(np.broadcast_to(step, at.shape))
    return np.array([(f(at + s) - f(at - s)) / (2 * s.sum()) for s in shifts])
