"""The Gaussian core on the host: coefficients integrated out in closed form, the log density of φ and its slope.

With y − μ(x̂) = r ≈ J(x − x̂) + noise and x ~ N(m, diag(s²)), everything follows from JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r. The
solve is in the whitened z = (x − m)/s, so that a spread of zero is no special case. The sum of squares is taken at the
posterior mean, as the small difference that it is, and not as the difference of two large sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayescal._core.gaussian_algebra import Conditional, Gram, condition
from bayescal._engine.assembly import Assembly, Line, Point, Values
from bayescal._engine.noise_slopes import even_slope, noise_slopes, spread_slope
from bayescal._engine.whitening import Robust, Whitening, known_variance, robust, whitening
from bayescal._model.noise_laws import White

STEP = 1e-6  # of a coordinate that moves products over the readings, for its slope
CAREFUL = 1e-4  # the same, where differences are taken on both sides
NOWHERE = -1e300  # log density where there is none
NEWTON = 50  # steps to the mode of x at most, and what the last of them gains, in nats
RESTS = 1e-11


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
        self._lines: dict[tuple[float, ...], tuple[Line, Gram | None]] = {}
        self._white: tuple[Whitening, np.ndarray, np.ndarray] | None = None  # of the last products
        self._mode = self.point.x  # of x, where it was sought

    def _line(self, v: np.ndarray, hyper: Values) -> tuple[Line, Gram | None]:
        key = tuple(float(v[i]) for i in self.assembly.moving)
        found = self._lines.get(key)
        if found is None:
            line = self.assembly.linearise(self.point, hyper)
            gram = None
            if self.even:
                gram = Gram.of(self._beside(line), 0.0)
            if len(self._lines) > 64:
                self._lines.clear()
            found = self._lines[key] = (line, gram)
        return found

    def residual(self, line: Line) -> Float[np.ndarray, "n"]:
        """What the expected output leaves, with the per-reading coefficients at zero."""
        return self.assembly.record.y - line.mean + np.sum(line.rows * self.point.rows, axis=1)

    def _beside(self, line: Line) -> np.ndarray:
        """J and r in one table."""
        table = np.empty((len(line.mean), line.jacobian.shape[1] + 1), order="F")
        table[:, :-1], table[:, -1] = line.jacobian, self.residual(line)
        return table

    def extra(self, line: Line) -> Float[np.ndarray, "n"] | float:
        """Variance that the per-reading coefficients add."""
        if not len(self.assembly.row_sd):
            return 0.0
        return np.sum((line.rows * self.assembly.row_sd) ** 2, axis=1)

    def whitened(
        self, v: np.ndarray, x: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n q"], float]:
        """Residuals at φ and x, output unit; whitened Jacobian and these residuals beside each other; log|Σ|."""
        hyper = self.assembly.hyper(v)
        line = self._line(v, hyper)[0]
        residual = self.residual(line) - line.jacobian @ (x - self.point.x)
        white = whitening(self.assembly.noise, hyper, self.assembly.record, self.extra(line))
        return residual, white(np.column_stack([line.jacobian, residual])), white.logdet

    def gram(self, v: np.ndarray, hyper: Values) -> Gram:
        """Weighted products of the readings at φ."""
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
        if not self.assembly.noise.gaussian:
            return self._about_the_mode(self._beside(line), hyper)
        white = whitening(self.assembly.noise, hyper, self.assembly.record, self.extra(line))
        table = self._beside(line)
        whitened = white(table)
        self._white = (white, table, whitened)
        return Gram.of(whitened, white.logdet)

    def _about_the_mode(self, table: Float[np.ndarray, "n q"], hyper: Values) -> Gram:
        """The products that stand for a law that is not Gaussian: of the quadratic about the mode of x given φ.

        Newton's steps with the law's own curvature; where one leads down, the step of a Gaussian scale mixture, which
        never does. With the mode's distance m from here, products there become JᵀWJ, JᵀWr + JᵀWJ·m, and so on.
        Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
        """
        noise, record = self.assembly.noise, self.assembly.record
        prior, jacobian, residual = (
            self.assembly.prior(hyper, self.flat),
            table[:, :-1],
            table[:, -1],
        )
        x, move = self.point.x, self._mode - self.point.x

        def look(move: np.ndarray) -> tuple[float, Robust]:
            terms = robust(noise, hyper, record, residual - jacobian @ move)
            z = prior.weight * (x + move - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            return terms.squares + float(z @ z), terms

        def products(terms: Robust, weight: np.ndarray) -> Gram:
            jtj = (jacobian * weight[:, None]).T @ jacobian
            return Gram(jtj, jacobian.T @ terms.slope, terms.squares, terms.logdet)

        value, terms = look(move)
        for _ in range(NEWTON):
            for weight in (terms.curvature, terms.weight):
                found = condition(products(terms, weight), len(residual), prior, x + move)
                if found is None:
                    continue
                step = found.mean - x - move
                there, further = look(move + step)
                if there <= value:
                    break
            else:
                break
            move, gained, value, terms = move + step, value - there, there, further
            if gained < RESTS:
                break
        self._mode = x + move
        gram = products(terms, terms.curvature)
        across = gram.jtj @ move
        squares = gram.rtr + float(move @ (2 * gram.jtr + across))
        return Gram(gram.jtj, gram.jtr + across, squares, gram.logdet)

    def squares(self, hyper: Values, gram: Gram) -> float:
        """Of the whitened residuals at the point itself; under a heavy-tailed law what stands in their place."""
        noise, record = self.assembly.noise, self.assembly.record
        if noise.gaussian:
            return gram.rtr
        line = self.assembly.linearise(self.point, hyper)
        return robust(noise, hyper, record, self.residual(line)).squares

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
        weight, of_z = assembly.weight_of_x, np.diag(covariance)
        excess = (z**2 + of_z - 1) * weight
        squares, spent = found.rest - float(weight @ z**2), z.size - float(of_z @ weight)
        exact = assembly.noise.gaussian  # else the curvature at the mode of x moves with all of φ
        known = (
            self._noise_slopes(v, found) | self._shape_slopes(v, found, covariance) if exact else {}
        )
        for i, kind in enumerate(assembly.kinds):
            if not exact:
                gradient[i] += self._difference(v, i, value, careful=True)
            elif kind == "spread" and i not in assembly.moving:
                gradient[i] += spread_slope(assembly, v, i, excess)
            elif kind == "noise" and self.even:
                gradient[i] += even_slope(assembly, v, squares, spent)
            elif i in known:
                gradient[i] += known[i]
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

    def _noise_slopes(self, v: np.ndarray, found: Conditional) -> dict[int, float]:
        """By the coordinates of the noise's parameters, where readings have no variance in common."""
        if self.even or self._white is None:
            return {}
        white, table, whitened = self._white
        q = len(found.mean)
        turn = np.zeros((q + 1, q + 1))  # [J | r] to [J·C^½ | e]
        turn[:q, :q], turn[:q, q], turn[q, q] = found.root, self.point.x - found.mean, 1.0
        return noise_slopes(self.assembly, v, white, table @ turn, whitened @ turn)

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
        white, table, scale = None, self._beside(line), hyper.get("noise.white", 1.0) ** 2
        if gram is None:
            assert self._white is not None
            (white, _, table), scale = self._white, 1.0
        mean, move = found.mean, found.mean - self.point.x
        spread = found.sd[:, None] * covariance * found.sd
        known = {i: assembly.jacobian_slopes(i, slopes, hyper) for i in shapes}
        known = {i: one for i, one in known.items() if one is not None}
        if not known:
            return {}
        columns = np.column_stack([moved for _, moved in known.values()])
        products = (columns if white is None else white(columns)).T @ table / scale
        made, row = {}, 0
        for i, (at, _) in known.items():
            own, row = products[row : row + len(at)], row + len(at)
            left = own[:, -1] - own[:, :-1] @ move
            made[i] = float(left @ mean[at] - np.sum(spread[at] * own[:, :-1]))
        return made
