"""The log density of φ with the coefficients integrated out, about a point, and its slopes.

From the structure's products where these are functions of φ (`Products`), else from the readings at each φ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bayescal._inference.gaussian import LOG_2PI, Conditional, Gram, Prior, condition
from bayescal._inference.noise_on_record import (
    Terms,
    Whitening,
    bends,
    density_terms,
    sloped_log_densities,
    total_log_density,
    variance,
)
from bayescal._inference.problem import SHIFT, Problem, Values, differences
from bayescal._inference.products import DEGREES, Axes, Polynomials, Products, basis_of
from bayescal._model.composition import Linearised

NOWHERE = -1e300  # log density where there is none
NEWTON_STEPS = 50  # to the mode of x at most
NEWTON_NATS = 1e-11  # that the last of them gains
DRAWS_TRIED = 12  # draws of a Gaussian fit of φ at which polynomials are tried,
ENOUGH_NATS = 0.3  # and the log density within which they will do there
# Times what a number costs in a product, that one costs in a pass over correlated readings.
PASS_COST = 60
CALL_COST = 1_000_000  # and such numbers that a pass by itself costs before it begins (0.4 ms)


@dataclass(eq=False)
class Density:
    """log p(y, φ) as a function of φ's coordinates, x integrated out of the structure linearised at a point.

    Attributes:
        problem: the structure on its record.
        x: where.
        flat: scales of the coefficients with flat priors.
        there: coordinates of φ at which a nonlinear structure is linearised in its shapes too; the middle of their
            priors if not given.
        held: variance that noise on inputs adds to each reading; that at x, if not given.
    """

    problem: Problem
    x: Float[np.ndarray, "p"]
    flat: Float[np.ndarray, "p"]
    there: Float[np.ndarray, "d"] | None = None
    held: Float[np.ndarray, "n"] | None = None

    def __post_init__(self) -> None:
        noise, record = self.problem.noise, self.problem.record
        # One variance for all readings: products over them do not depend on it.
        self.even = noise.even(record.frame) and not self.problem.noisy
        # Without a coefficient the density is the noise law's own.
        self.alone = not (self.even or self.problem.terms)
        self._lines: dict[tuple[float, ...], tuple[Linearised, Gram | None]] = {}
        self._kept: dict[bytes, tuple[float, Values, Prior, Conditional | None]] = {}
        self._mode = self.x  # of x, where it was sought
        self._last: tuple[Values, tuple[float, dict[str, float]]] | None = None

    @cached_property
    def products(self) -> Products | None:
        """The structure's products as functions of φ; None where φ moves them otherwise than by shapes."""
        problem = self.problem
        if not self.even or problem.corrected or any(t.place == "phi" for t in problem.terms):
            return None
        if any(basis_of(t, problem) is None for t in problem.terms):
            return None
        there = np.zeros(len(problem.hypers)) if self.there is None else self.there
        return Products(problem, self.x, np.clip(there, -4.0, 4.0))

    # from the readings ------------------------------------------------------------------------------------------

    def _line(self, v: np.ndarray, hyper: Values) -> tuple[Linearised, Gram | None]:
        # Only shapes and promoted coefficients move J; what else is in φ (noise, sizes) leaves it as it is.
        key = tuple(float(v[i]) for i in self.problem.moving)
        found = self._lines.get(key)
        if found is None:
            line = self.problem.linearise(self.x, hyper)
            gram = None
            if self.even:
                beside = self._beside(line)
                gram = Gram.of(beside.T @ beside, 0.0)
            if len(self._lines) > 64:
                self._lines.clear()
            found = self._lines[key] = (line, gram)
        return found

    def residual(self, line: Linearised) -> Float[np.ndarray, "n"]:
        """What the expected output leaves."""
        return self.problem.record.y - line.mean

    def _beside(self, line: Linearised) -> np.ndarray:
        """J and r in one table."""
        table = np.empty((len(line.mean), line.jacobian.shape[1] + 1), order="F")
        table[:, :-1], table[:, -1] = line.jacobian, self.residual(line)
        return table

    def extra(self, line: Linearised) -> Float[np.ndarray, "n"] | float:
        """Variance that noise on inputs adds to each reading."""
        return self.problem.extra(line) if self.held is None else self.held

    def _white(self, line: Linearised, hyper: Values) -> Whitening:
        return Whitening(self.problem.noise, hyper, self.problem.record, self.extra(line))

    def whitened(
        self, v: np.ndarray, x: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n q"], float]:
        """Residuals at φ and x, output unit; whitened Jacobian and these residuals beside each other; log|Σ|."""
        hyper = self.problem.hyper(v)
        line = self._line(v, hyper)[0]
        residual = self.residual(line) - line.jacobian @ (x - self.x)
        return residual, *self._white(line, hyper).both(np.column_stack([line.jacobian, residual]))

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Weighted products of the readings at φ."""
        line, gram = self._line(v, hyper)
        if gram is not None:
            # Σ = σ²·I: the products of the plain table, made once, over σ², and log|Σ| = n·log σ².
            shared, size = float(self.problem.noise.shared_variance(hyper)), len(line.mean)
            jtj, jtr, rtr = (part / shared for part in gram[:3])
            return Gram(jtj, jtr, rtr, size * math.log(shared))
        if self.alone:
            # What stands for squares and log|Σ| is twice the density.
            value = self._of_noise(hyper)[0]
            return Gram(np.zeros((0, 0)), np.zeros(0), -2 * value - len(line.mean) * LOG_2PI, 0.0)
        if not self.problem.noise.gaussian:
            return self._about_the_mode(line, hyper)
        return Gram.of(*self._white(line, hyper).gram(self._beside(line)))

    def _of_noise(self, hyper: Values) -> tuple[float, dict[str, float]]:
        """Log density of readings of which nothing is fitted, and its slopes by the parameters; the last is kept."""
        if self._last is None or self._last[0] != hyper:
            law, record = self.problem.noise, self.problem.record
            value, slopes = sloped_log_densities(law, record, record.y, hyper)
            self._last = hyper, (float(value[0]), {n: float(one[0]) for n, one in slopes.items()})
        return self._last[1]

    def _about_the_mode(self, line: Linearised, hyper: Values) -> Gram:
        """The products that stand for a law that is not Gaussian: of the quadratic about the mode of x given φ.

        Newton's steps with the law's own curvature; where one leads down, the step of a Gaussian scale mixture, which
        never does. With the mode's distance m from here, products there become JᵀWJ, JᵀWr + JᵀWJ·m, and so on.
        Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
        """
        noise, record = self.problem.noise, self.problem.record
        prior, jacobian = self.problem.prior(hyper, self.flat), line.jacobian
        residual, extra = self.residual(line), self.extra(line)
        x, move = self.x, self._mode - self.x

        def look(move: np.ndarray) -> tuple[float, Terms]:
            terms = density_terms(noise, hyper, record, residual - jacobian @ move, extra)
            z = prior.weight * (x + move - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            return terms.squares + float(z @ z), terms

        def products(terms: Terms, weight: np.ndarray) -> Gram:
            jtj = (jacobian * weight[:, None]).T @ jacobian
            return Gram(jtj, jacobian.T @ terms.slope, terms.squares, terms.logdet)

        value, terms = look(move)
        for _ in range(NEWTON_STEPS):
            for weight in (terms.curvature, terms.weight(residual - jacobian @ move)):
                found = condition(products(terms, weight), len(residual), prior, x + move)
                if found is None:
                    continue
                step = found.mean - x - move
                if value - found.rest < NEWTON_NATS:  # nothing is left to gain
                    step, there, further = 0.0 * step, value, terms
                else:
                    there, further = look(move + step)
                if there <= value:
                    break
            else:
                break
            move, gained, value, terms = move + step, value - there, there, further
            if gained < NEWTON_NATS:
                break
        self._mode = x + move
        gram = products(terms, terms.curvature)
        # The quadratic about the mode, rtr − 2·jtrᵀ(δ − m) + (δ − m)ᵀ·jtj·(δ − m), with its powers of δ collected:
        # these are the products at the point itself, where δ = x − x̂ is zero.
        across = gram.jtj @ move
        squares = gram.rtr + float(move @ (2 * gram.jtr + across))
        return Gram(gram.jtj, gram.jtr + across, squares, gram.logdet)

    def squares(self, hyper: Values, gram: Gram) -> float:
        """Of the whitened residuals at the point itself; under a heavy-tailed law what stands in their place."""
        noise, record = self.problem.noise, self.problem.record
        if noise.gaussian:
            return gram.rtr
        # For a law with outliers: −2·log of the density against that of no residual at all, zero at best as squares
        # are.
        line = self.problem.linearise(self.x, hyper)
        return density_terms(noise, hyper, record, self.residual(line), self.extra(line)).squares

    # the density ------------------------------------------------------------------------------------------------

    def _given(self, v: np.ndarray) -> tuple[float, Values, Prior, Conditional | None]:
        """The log density, φ by name, the prior of x and x itself; coefficients that products hold are among x.

        The last one is kept: where a climb ends, its value, slope and curvature are asked for in turn.
        """
        key = v.tobytes()
        if key not in self._kept:
            self._kept = {key: self._found(v)}
        return self._kept[key]

    def _found(self, v: np.ndarray) -> tuple[float, Values, Prior, Conditional | None]:
        hyper = self.problem.hyper(v)
        prior, at = self.problem.prior(hyper, self.flat), self.x
        products = self.products
        if products is not None and products.reaches(v):
            prior, at = products.prior(prior), products.at
            gram = products.gram(v, hyper)
        else:
            gram = self.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet) or not np.all(np.isfinite(prior.sd)):
            return NOWHERE, hyper, prior, None
        found = condition(gram, self.problem.record.size, prior, at)
        if found is None:
            return NOWHERE, hyper, prior, None
        return found.log_marginal + self.problem.log_prior(v), hyper, prior, found

    def at(self, v: np.ndarray) -> tuple[float, Conditional | None]:
        """The log density at a coordinate, and x given φ there; none where there is no density."""
        value, _, _, found = self._given(v)
        if found is None or not math.isfinite(value):
            return NOWHERE, None
        return value, found.first(self.problem.size)

    def values(self, vs: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k"]:
        """The log density at several coordinates."""
        if self.alone:
            problem = self.problem
            law, record, hyper = problem.noise, problem.record, problem.hyper(vs.T)
            if record.long and not law.independent:  # their slopes take longer than they do
                found = total_log_density(law, record, record.y[None], hyper)
            else:
                found = sloped_log_densities(law, record, record.y, hyper)[0]
            return np.nan_to_num(found + problem.log_priors(vs), nan=NOWHERE, neginf=NOWHERE)
        return np.array([self.at(v)[0] for v in vs])

    def slope(self, v: np.ndarray) -> tuple[float, np.ndarray]:
        """The log density and its gradient."""
        problem = self.problem
        value, hyper, prior, found = self._given(v)
        if found is None or not math.isfinite(value):
            return NOWHERE, np.zeros(len(v))
        made = problem.log_prior_slope(v)
        # Fisher's identity: the slope of log p(y|φ) is the posterior mean of that of log p(y, x|φ). By log s the
        # normal prior has the slope z² − 1, of which the mean is z̄² + var z − 1.
        excess = ((found.z**2 + found.variance_of_z - 1) * prior.weight)[: problem.size]
        for i, log_sd in problem.log_sd_slopes(v, hyper):
            made[i] += excess @ log_sd
        if self.products is not None and self.products.reaches(v):
            made += self.products.slopes(v, hyper, prior, found)
        elif self.alone:
            made += by_parameter(problem, v, self._of_noise(hyper)[1])
        elif problem.noise.gaussian:
            made += self._slopes_by_readings(v, hyper, prior, found)
        else:
            made += self._slopes_about_the_mode(v, hyper, prior, found)
        return value, made

    def _slopes_by_readings(
        self, v: np.ndarray, hyper: Values, prior: Prior, found: Conditional
    ) -> np.ndarray:
        """What moves the products moves the density by, x's posterior held (see `Products.slopes`)."""
        problem, made, p = self.problem, np.zeros(len(v)), len(found.z)
        line, move = self._line(v, hyper)[0], found.mean - self.x
        moved = problem.moved(self.x, v, hyper)
        left = self.residual(line) - line.jacobian @ move
        # [J·C^½ | e], C the covariance of x and e what its mean leaves; and Σ⁻¹ times it.
        table = np.column_stack([line.jacobian @ found.root, left])
        if self.even:
            # By log σ²: ½·(E[eᵀΣ⁻¹e] − n) over x's posterior. The expectation is the squares at the mean plus
            # tr C·JᵀΣ⁻¹J = p − tr W·var z, the degrees of freedom that x took.
            taken = found.squares + p - float(prior.weight @ found.variance_of_z)
            beyond = 0.5 * (taken - problem.record.size)
            for i in problem.layout.positions("noise"):
                made[i] = beyond * problem.log_variance_slope(v, i)
            pulled = table / float(problem.noise.shared_variance(hyper))
        else:
            by_name, pulled = self._white(line, hyper).slopes(table)
            made += by_parameter(problem, v, by_name)
        # −½·d(eᵀΣ⁻¹e + tr C·JᵀΣ⁻¹J) for a change dJ of the columns and −d(output) of e.
        for i, m in moved:
            output = m.mean + m.columns @ move[m.at]
            across = pulled[:, :-1].T @ m.columns
            made[i] += pulled[:, -1] @ output - np.sum(found.root[m.at].T * across)
            if np.any(m.inputs):  # and the variance that noise on inputs adds
                up, down = (line._replace(inputs=line.inputs + s * m.inputs) for s in (1, -1))
                more = 0.5 * (problem.extra(up) - problem.extra(down))  # exact of a square
                own = variance(problem.noise, hyper, problem.record) + self.extra(line)
                made[i] += 0.5 * np.sum((np.sum(pulled**2, axis=1) - 1 / own) * more)
        return made

    def _slopes_about_the_mode(
        self, v: np.ndarray, hyper: Values, prior: Prior, found: Conditional
    ) -> np.ndarray:
        """The same of a law that is not Gaussian, whose curvature at the mode of x moves with all of φ.

        The density is Σf(ρ) − ½z² − ½·log|A|, A = JᵀWJ + D, W = −f″, ρ what is left of the readings at the mode and
        C = A⁻¹. By ρᵢ the volume has the slope ½·hᵢ·f‴, h the diagonal of J·C·Jᵀ; the mode moves by C·∂G, G = −Jᵀf′ −
        D·(x − m), and so the volume by −qᵀ∂G with q = C·Jᵀ(½·h·f‴).
        """
        problem, made = self.problem, np.zeros(len(v))
        noise, record = problem.noise, problem.record
        line = self._line(v, hyper)[0]
        jacobian, move, extra = line.jacobian, found.mean - self.x, self.extra(line)
        left = self.residual(line) - jacobian @ move
        terms = density_terms(noise, hyper, record, left, extra)
        further = bends(noise, hyper, record, left, extra)
        # hᵢ = (J·C·Jᵀ)ᵢᵢ; q carries what the mode's own move does to the volume, by the implicit function theorem.
        across = jacobian @ found.covariance
        leverage = np.sum(across * jacobian, axis=1)
        of_volume = 0.5 * leverage * further.third
        q = across.T @ of_volume
        along = jacobian @ q
        for i, h in enumerate(problem.hypers):
            if h.kind == "noise":
                plain, first, second = further.by_parameter[h.name]
                slope = np.sum(plain + 0.5 * leverage * second + along * first)
                made[i] = slope * problem.value_change(v, i)
        tightness = np.where(prior.sd > 0, found.z / np.where(prior.sd > 0, prior.sd, 1.0), 0.0)
        for i, log_sd in problem.log_sd_slopes(v, hyper):
            made[i] -= q @ (2 * prior.weight * tightness * log_sd)
        for i, (at, by_j, mean, _) in problem.moved(self.x, v, hyper):
            output = mean + by_j @ move[at]
            weighted = terms.curvature * output
            made[i] += terms.slope @ output - np.sum(terms.curvature @ (across[:, at] * by_j))
            made[i] += along @ weighted - of_volume @ output - (by_j @ q[at]) @ terms.slope
            if np.ndim(extra):  # the variance that noise on inputs adds moves too
                one = differences(
                    lambda at, i=i: self.at(np.concatenate([v[:i], at, v[i + 1 :]]))[0],
                    v[[i]],
                    SHIFT,
                )
                made[i] = float(one[0]) - problem.log_prior_slope(v)[i]
        return made


def turn(root: Float[np.ndarray, "p p"], back: Float[np.ndarray, "p"]) -> np.ndarray:
    """What turns [J | r] into [J·C^½ | e]: C the covariance of x, e the residuals at its mean, a step `back` away."""
    q = len(back)
    made = np.zeros((q + 1, q + 1))
    made[:q, :q], made[:q, q], made[q, q] = root, back, 1.0
    return made


def by_parameter(
    problem: Problem, v: Float[np.ndarray, "d"], by_name: dict[str, float]
) -> Float[np.ndarray, "d"]:
    """Slopes by the law's parameters as slopes by coordinates of φ; zero by others."""
    made = np.zeros(len(v))
    for i, h in enumerate(problem.hypers):
        if h.kind == "noise":
            made[i] = by_name[h.name] * problem.value_change(v, i)
    return made


def about(
    density: Density, v: np.ndarray, covariance: np.ndarray, close: float, proposals: float
) -> Products | None:
    """Products as polynomials along the outer axes, good where a Gaussian fit of φ has its draws; None where none are.

    Args:
        density: of φ, computed from the readings.
        v: centre of the fit.
        covariance: of the fit.
        close: log density, within which polynomials are good; of others the best, if they will do.
        proposals: φ that will be asked for; none are made where it costs less to compute each from the readings.
    """
    problem = density.problem
    axes = Axes(problem)
    dim = len(axes.names)
    if dim not in DEGREES or not np.all(np.isfinite(covariance)):
        return None
    # They must hold where the importance sampler goes: draws of the Gaussian fit say how far that is along each axis.
    normal = np.random.default_rng(0).standard_normal((400, len(v)))
    draws = v + normal @ np.linalg.cholesky(covariance).T
    coordinates = axes.of(problem.hyper(draws.T), draws)
    if not np.all(np.isfinite(coordinates)):
        return None
    # Judged by what they are for: the largest error of the log density, at draws that they were not fitted to.
    tried = draws[:DRAWS_TRIED]
    products = Products(problem, density.x, v, axes)
    if not _pay(products, Polynomials(coordinates, DEGREES[dim][-2]), proposals):
        return None
    there = np.array([density.at(one)[0] for one in tried])
    best, apart, found, rows = ENOUGH_NATS, math.inf, None, list[np.ndarray]()
    for degree in DEGREES[dim]:
        polynomials = Polynomials(coordinates, degree)
        rows += [products.row(c) for c in polynomials.points[len(rows) :]]
        products.refit(polynomials, np.array(rows))
        here = [_log_density(products, density.flat, one) for one in tried]
        before, apart = apart, float(np.max(np.abs(here - there)))
        if apart < best:
            best, found = apart, (polynomials, len(rows))
        # What a higher degree does not describe better is no polynomial there.
        if best < close or apart >= before:
            break
    if found is None:
        return None
    products.refit(found[0], np.array(rows[: found[1]]))
    return products


def _pay(products: Products, polynomials: Polynomials, proposals: float) -> bool:
    """Whether products as polynomials of a usual degree cost less than so many passes over the readings."""
    # In numbers multiplied: to compute products at the points and use them, or to whiten and multiply each time.
    problem, n, width = products.problem, products.size, products.width
    # Each is then computed by itself, or the output linearised anew for it.
    if problem.corrected or problem.noisy or not problem.affine:
        return True
    points, terms = len(polynomials.points), polynomials.count
    fitting = points * (CALL_COST + PASS_COST * n * width)
    using = width**2 * terms * (proposals + 2 * points)
    return fitting + using < PASS_COST * proposals * n * (problem.size + 1)


def _log_density(products: Products, flat: np.ndarray, v: np.ndarray) -> float:
    """Of one φ, by products."""
    problem = products.problem
    hyper = problem.hyper(v)
    prior = products.prior(problem.prior(hyper, flat))
    found = condition(products.gram(v, hyper), products.size, prior, products.at)
    return NOWHERE if found is None else found.log_marginal + problem.log_prior(v)
