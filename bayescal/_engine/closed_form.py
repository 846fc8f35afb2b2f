"""The Gaussian core on the host: coefficients integrated out in closed form, the log density of φ and its slope.

With y − μ(x̂) = r ≈ J(x − x̂) + noise and x ~ N(m, diag(s²)), everything follows from JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r. The
solve is in the whitened z = (x − m)/s, so that a spread of zero is no special case. The sum of squares is taken at the
posterior mean, as the small difference that it is, and not as the difference of two large sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs

from bayescal._engine.assembly import NUDGE, Assembly, Line, Point, Prior, Values
from bayescal._engine.whitening import Whitening, known_variance, whitening
from bayescal._model.noise_laws import White

LOG_2PI = math.log(2 * math.pi)
STEP = 1e-6  # of a coordinate that moves products over the readings, for its slope
CAREFUL = 1e-4  # the same, where differences are taken on both sides
NOWHERE = -1e300  # log density where there is none


class Gram(NamedTuple):
    """Weighted products of a matrix J and a vector r, and log|Σ|: all that a Gaussian likelihood needs."""

    jtj: Float[np.ndarray, "p p"]
    jtr: Float[np.ndarray, "p"]
    rtr: float
    logdet: float


class Conditional(NamedTuple):
    """x given φ and the readings, x = shift + sd·L⁻ᵀ(u + ε), and the log density of the readings given φ."""

    log_marginal: float
    shift: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]
    chol: Float[np.ndarray, "p p"]
    u: Float[np.ndarray, "p"]
    rest: float  # sum of squares at the mean, the prior's share included

    def place(self, normal: Float[np.ndarray, "p m"] | Float[np.ndarray, "p"]) -> np.ndarray:
        """The x that standard normal numbers stand for; one column a draw."""
        u = self.u if normal.ndim == 1 else self.u[:, None]
        z = dtrtrs(self.chol, u + normal, lower=1, trans=1)[0] if self.u.size else normal
        return (self.shift + self.sd * z.T).T

    @property
    def mean(self) -> Float[np.ndarray, "p"]:
        return self.place(np.zeros_like(self.u))

    @property
    def covariance_of_z(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the whitened z."""
        if not self.u.size:
            return np.zeros((0, 0))
        inverse, _ = dpotri(self.chol, lower=1)
        return np.tril(inverse) + np.tril(inverse, -1).T

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        return self.sd[:, None] * self.covariance_of_z * self.sd

    @property
    def log_jacobian(self) -> float:
        """Log volume of the map from standard normal numbers to x."""
        return float(np.sum(np.log(self.sd)) - np.sum(np.log(np.diag(self.chol))))


def condition(
    gram: Gram, size: int, prior: Prior, at: Float[np.ndarray, "p"]
) -> Conditional | None:
    """Integrate x out; None where the precision has no Cholesky factor.

    Args:
        gram: weighted products of J and r.
        size: number of readings.
        prior: prior of x.
        at: x̂, where r was taken.
    """
    sd, weight = prior.sd, prior.weight
    offset = weight * (prior.mean - at)
    if not sd.size:
        log_marginal = -0.5 * (size * LOG_2PI + gram.logdet + gram.rtr)
        return Conditional(log_marginal, at, sd, np.zeros((0, 0)), sd, gram.rtr)
    pulled = sd * (gram.jtr - gram.jtj @ offset)
    precision = sd[:, None] * gram.jtj * sd
    precision.flat[:: sd.size + 1] += weight
    chol, failed = dpotrf(precision.T, lower=1, clean=1, overwrite_a=1)
    if failed:
        return None
    pivots = chol.diagonal()
    u = dtrtrs(chol, pulled, lower=1)[0]
    z = dtrtrs(chol, u, lower=1, trans=1)[0]
    move = offset + sd * z
    rest = gram.rtr - move @ (2 * gram.jtr - gram.jtj @ move) + weight @ (z * z)
    if not rest > 0:  # no digits left: noise far below any residual
        return None
    flat = float((1 - weight) @ np.log(sd)) + float((1 - weight).sum()) * 0.5 * LOG_2PI
    volume = gram.logdet + 2 * float(np.log(pivots).sum())
    log_marginal = flat - 0.5 * (size * LOG_2PI + volume + rest)
    return Conditional(float(log_marginal), at + offset, sd, chol, u, float(rest))


@dataclass(eq=False)
class Density:
    """log p(y, φ) as a function of φ's coordinates, x integrated out of the structure linearised at a point.

    Attributes:
        assembly: the structure on its record.
        point: where.
        flat: scales of the coefficients with flat priors.
    """

    assembly: Assembly
    point: Point
    flat: Float[np.ndarray, "p"]

    def __post_init__(self) -> None:
        noise, record = self.assembly.noise, self.assembly.record
        known = known_variance(record)
        # One variance for all readings: products over them do not depend on it.
        self.even = (
            isinstance(noise, White) and not len(self.assembly.row_sd) and np.ndim(known) == 0
        )
        self.evaluations = 0
        self._lines: dict[tuple[float, ...], tuple[Line, Gram | None]] = {}
        self._white: tuple[Whitening, np.ndarray] | None = None  # of the last products

    def _line(self, v: np.ndarray, hyper: Values) -> tuple[Line, Gram | None]:
        key = tuple(float(v[i]) for i in self.assembly.moving)
        found = self._lines.get(key)
        if found is None:
            line = self.assembly.linearise(self.point, hyper)
            gram = None
            if self.even:
                table = self._beside(line)
                whole = table.T @ table
                gram = Gram(whole[:-1, :-1], whole[:-1, -1], float(whole[-1, -1]), 0.0)
            if len(self._lines) > 64:
                self._lines.clear()
            found = self._lines[key] = (line, gram)
        return found

    def _residual(self, line: Line) -> np.ndarray:
        return self.assembly.record.y - line.mean + np.sum(line.rows * self.point.rows, axis=1)

    def _beside(self, line: Line) -> np.ndarray:
        """J and r in one table."""
        table = np.empty((len(line.mean), line.jacobian.shape[1] + 1), order="F")
        table[:, :-1], table[:, -1] = line.jacobian, self._residual(line)
        return table

    def extra(self, line: Line) -> Float[np.ndarray, "n"] | float:
        """Variance that the per-reading coefficients add."""
        if not len(self.assembly.row_sd):
            return 0.0
        return np.sum((line.rows * self.assembly.row_sd) ** 2, axis=1)

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Weighted products of the readings at φ."""
        self.evaluations += 1
        line, gram = self._line(v, hyper)
        if gram is not None:
            variance = hyper["noise.white"] ** 2
            size = self.assembly.record.size
            return Gram(
                gram.jtj / variance,
                gram.jtr / variance,
                gram.rtr / variance,
                size * math.log(variance),
            )
        white = whitening(self.assembly.noise, hyper, self.assembly.record, self.extra(line))
        table = white(self._beside(line))
        self._white = (white, table)
        whole = table.T @ table
        return Gram(whole[:-1, :-1], whole[:-1, -1], float(whole[-1, -1]), white.logdet)

    def at(self, v: np.ndarray) -> tuple[float, Conditional | None]:
        """The log density at a coordinate, and x given φ there; none where there is no density."""
        hyper = self.assembly.hyper(v)
        prior = self.assembly.prior(hyper, self.flat)
        gram = self.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet) or not np.all(np.isfinite(prior.sd)):
            return NOWHERE, None
        found = condition(gram, self.assembly.record.size, prior, self.point.x)
        if found is None:
            return NOWHERE, None
        total = found.log_marginal + self.assembly.log_prior(v)
        return (total, found) if math.isfinite(total) else (NOWHERE, None)

    def slope(self, v: np.ndarray, careful: bool = False) -> tuple[float, np.ndarray]:
        """The log density and its gradient: in closed form where that is known, else by differences.

        Args:
            v: coordinate of φ.
            careful: take differences on both sides, so that slopes of slopes are good too.
        """
        value, found = self.at(v)
        gradient = np.zeros(len(v))
        if found is None:
            return value, gradient
        assembly = self.assembly
        gradient += assembly.log_prior_slope(v)
        covariance = found.covariance_of_z
        z = (found.mean - found.shift) / np.where(found.sd > 0, found.sd, 1.0)
        excess = (z**2 + np.diag(covariance) - 1) * assembly.weight_of_x
        by_shape = self._shape_slopes(v, found, covariance)
        for i, kind in enumerate(assembly.kinds):
            if kind == "spread" and i not in assembly.moving:
                gradient[i] += excess @ self._log_size_slope(v, i)
            elif kind == "noise" and self.even:
                gradient[i] += self._white_slope(v, found, z, covariance)
            elif kind == "shape" and i in by_shape:
                gradient[i] += by_shape[i]
            else:
                gradient[i] += self._difference(v, i, value, careful)
        return value, gradient

    def _difference(self, v: np.ndarray, i: int, value: float, careful: bool) -> float:
        """Slope of the log likelihood by one coordinate, by differences."""

        def likelihood(step: float) -> float:
            moved = v.copy()
            moved[i] += step
            return self.at(moved)[0] - self.assembly.log_prior(moved)

        if careful:
            found = (likelihood(CAREFUL) - likelihood(-CAREFUL)) / (2 * CAREFUL)
        else:
            found = (likelihood(STEP) - value + self.assembly.log_prior(v)) / STEP
        return found if abs(found) < 1e100 else 0.0  # beyond the edge of where there is a density

    def _shape_slopes(
        self, v: np.ndarray, found: Conditional, covariance: np.ndarray
    ) -> dict[int, float]:
        """By the coordinate of each shape whose columns' slopes are known."""
        assembly, hyper = self.assembly, self.assembly.hyper(v)
        shapes = [i for i, kind in enumerate(assembly.kinds) if kind == "shape"]
        if not shapes or not assembly.affine:
            return {}
        line, gram = self._line(v, hyper)
        slopes = assembly.slopes(self.point, hyper)
        if gram is None:
            assert self._white is not None
            white, table = self._white
        else:
            table = self._beside(line)
        mean, made = found.mean, {}
        move, spread = mean - self.point.x, found.sd[:, None] * covariance * found.sd
        for i in shapes:
            known = assembly.jacobian_slopes(i, slopes, hyper)
            if known is not None:
                at, columns = known
                if gram is None:
                    products = white(columns).T @ table
                else:
                    products = columns.T @ table / hyper["noise.white"] ** 2
                left = products[:, -1] - products[:, :-1] @ move
                made[i] = float(left @ mean[at] - np.sum(spread[at] * products[:, :-1]))
        return made

    def _log_size_slope(self, v: np.ndarray, i: int) -> np.ndarray:
        up, down = v.copy(), v.copy()
        up[i] += NUDGE
        down[i] -= NUDGE
        sizes = (
            self.assembly.sizes(self.assembly.hyper(up)),
            self.assembly.sizes(self.assembly.hyper(down)),
        )
        with np.errstate(all="ignore"):
            found = (np.log(sizes[0]) - np.log(sizes[1])) / (2 * NUDGE)
        return np.where(np.isfinite(found), found, 0.0)

    def _white_slope(
        self, v: np.ndarray, found: Conditional, z: np.ndarray, covariance: np.ndarray
    ) -> float:
        """By the coordinate of one white standard deviation s: −(n − squares/s² − tr C·JᵀJ/s²) times dlog s/dv."""
        weight = self.assembly.weight_of_x
        squares = found.rest - weight @ z**2
        spent = z.size - float(np.sum(np.diag(covariance) * weight))
        slope = self.assembly.value_slope(v, self.assembly.kinds.index("noise"))
        return -(self.assembly.record.size - squares - spent) * slope
