"""Products over the readings for many φ at once, and x given each of them.

Where nothing but a shared variance moves them they are computed once. Where they move with a few shapes, promoted
coefficients or parameters of the noise, polynomials in these stand for them, fitted about the Laplace fit; joint draws
are weighted by what they were drawn from, so that this costs no exactness. Else they are computed for each φ.
Source: G. Migliorati et al., Found. Comput. Math. 14 (2014) 419 (polynomials by least squares at Chebyshev's density).
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float

from bayescal._core.gaussian_algebra import Gram, condition
from bayescal._engine.assembly import Assembly, Values
from bayescal._engine.closed_form import NOWHERE, Density
from bayescal._engine.joint import Grams, linearise_draws
from bayescal._engine.mode import Mode
from bayescal._engine.whitening import Batch, gram_matrices, known_variance, variance_of, whitening
from bayescal._model.correlated_noise import CORRELATION_TIME, DIFFUSION, OrnsteinUhlenbeck
from bayescal._model.noise_laws import CURVATURE, SLOPE

LINEAR = (SLOPE, CURVATURE)  # parameters of the noise that are no scales
REACH = 5.0  # standard deviations of the Laplace fit, up to which polynomials are fitted
FEW = {1: (6, 12, 20), 2: (4, 8, 12, 17), 3: (3, 5, 7, 9)}
DEGREES = FEW | {4: (2, 4, 6), 5: (2, 4), 6: (2, 3, 4)}
NUMBERS = 2_000_000  # in the tables that are computed at once
TRIED = 12  # draws of the Laplace fit at which polynomials are tried
CLOSE = 0.03  # log density, within which they are good there,
CLOSER = 0.001  # and of a long record, where a draw's own correction costs more than many products;
LONG = 1000  # readings, from which on a pass over them costs
ENOUGH = 0.3  # and within which they will do


class Products:
    """Products of a structure linearised at a mode, as functions of φ.

    Attributes:
        exact: whether they are those at φ itself.
        direct: whether each φ costs a pass over the readings.
    """

    def __init__(self, assembly: Assembly, mode: Mode) -> None:
        self.assembly, self.mode = assembly, mode
        self.density = Density(assembly, mode.point, mode.flat)
        self.size = assembly.record.size
        self._axes = _Axes(assembly)
        gaussian = assembly.noise.gaussian
        self.once = gaussian and not self._axes.names
        self._fit: _Polynomials | None = None
        if gaussian and not self.once and np.all(np.isfinite(mode.covariance)):
            self._fit = self._fitted()
        self.direct = not self.once and self._fit is None
        self.exact = gaussian and self._fit is None

    @cached_property
    def _shared(self) -> Gram:
        hyper = self.assembly.hyper(self.mode.v)
        if self.density.even:
            hyper = {**hyper, "noise.white": 1.0}
        return self.density.gram(self.mode.v, hyper)

    def at(self, hyper: Batch, v: Float[np.ndarray, "b d"]) -> Grams:
        """Products at each φ."""
        if self.once:
            one, even = self._shared, self.density.even
            variance = np.broadcast_to(hyper["noise.white"] ** 2 if even else 1.0, len(v))
            return Grams(
                one.jtj[None] / variance[:, None, None],
                one.jtr / variance[:, None],
                one.rtr / variance,
                one.logdet + self.size * np.log(variance),
            )
        if self._fit is None:
            return self.directly(v)
        return self._with_noise(self._fit, hyper, v)

    def outside(self, hyper: Batch, v: Float[np.ndarray, "b d"]) -> np.ndarray:
        """Which φ lie where the polynomials were not fitted."""
        if self._fit is None:
            return np.zeros(len(v), dtype=bool)
        return self._fit.outside(self._axes.of(hyper, v))

    def directly(self, v: Float[np.ndarray, "b d"]) -> Grams:
        """Products computed for each φ."""
        assembly = self.assembly
        if assembly.corrected or len(assembly.row_sd) or not assembly.noise.gaussian:
            made = [self.density.gram(one, assembly.hyper(one)) for one in v]
            return Grams(*(np.stack([np.asarray(g[i]) for g in made]) for i in range(4)))
        together = max(8, NUMBERS // (self.size * (assembly.size + 1)))
        parts = [self._computed(part) for part in np.array_split(v, -(-len(v) // together))]
        return Grams(*(np.concatenate([part[i] for part in parts]) for i in range(4)))

    def _computed(self, v: Float[np.ndarray, "b d"]) -> Grams:
        assembly, record = self.assembly, self.assembly.record
        hyper, count = assembly.hyper(v.T), len(v) if assembly.moving else 1
        table = linearise_draws(assembly, self.density.point, hyper, count)
        each = {name: np.broadcast_to(value, len(v)) for name, value in hyper.items()}
        if isinstance(assembly.noise, OrnsteinUhlenbeck):
            whole, logdet = gram_matrices(assembly.noise, record, table, each)
        else:
            columns = {name: value[:, None] for name, value in each.items()}
            variance = variance_of(assembly.noise, columns, record, 0.0)
            variance = np.broadcast_to(variance, (len(v), self.size))
            table, logdet = table / np.sqrt(variance)[:, :, None], np.sum(np.log(variance), axis=1)
            whole = table.transpose(0, 2, 1) @ table
        return Grams(whole[:, :-1, :-1], whole[:, :-1, -1], whole[:, -1, -1], logdet)

    def _fitted(self) -> _Polynomials | None:
        """Polynomials that are good where the Laplace fit has its draws; None where none are."""
        axes, random = self._axes, np.random.default_rng(0)
        if len(axes.names) not in DEGREES:
            return None
        root = np.linalg.cholesky(self.mode.covariance)
        draws = self.mode.v + random.standard_normal((400, len(root))) @ root.T
        coordinates = axes.of(self.assembly.hyper(draws.T), draws)
        if not np.all(np.isfinite(coordinates)):
            return None
        tried = draws[:TRIED]
        there = [self.density.at(v)[0] for v in tried]
        best, found = ENOUGH, None
        made: list[np.ndarray] = []
        dim = len(axes.names)
        for degree in DEGREES[dim]:
            count = 2 * math.comb(dim + degree, dim) + 4
            polynomials = _Polynomials(coordinates, degree)
            points = polynomials.points(count)
            made += [self._row(c) for c in points[len(made) :]]
            polynomials.fit(points, np.array(made), self.assembly.size)
            here = [self._log_density(polynomials, v) for v in tried]
            apart = float(np.max(np.abs(np.subtract(here, there))))
            if apart < best:
                best, found = apart, polynomials
            if best < (CLOSE if self.size <= LONG else CLOSER):
                break
        return found

    def _log_density(self, polynomials: _Polynomials, v: np.ndarray) -> float:
        """Of one φ, by polynomials."""
        assembly, batch = self.assembly, self.assembly.hyper(v[:, None])
        made = self._with_noise(polynomials, batch, v[None])
        gram = Gram(made.jtj[0], made.jtr[0], float(made.rtr[0]), float(made.logdet[0]))
        prior = assembly.prior(assembly.hyper(v), self.mode.flat)
        found = condition(gram, self.size, prior, self.mode.point.x)
        return NOWHERE if found is None else found.log_marginal + assembly.log_prior(v)

    def _with_noise(self, polynomials: _Polynomials, hyper: Batch, v: np.ndarray) -> Grams:
        unit = np.broadcast_to(self._axes.unit(hyper), len(v))
        jtj, jtr, rtr, logdet = polynomials.at(self._axes.of(hyper, v))
        return Grams(
            jtj / unit[:, None, None],
            jtr / unit[:, None],
            rtr / unit,
            logdet + self.size * np.log(unit),
        )

    def _row(self, coordinates: np.ndarray) -> np.ndarray:
        """Products at one point of the axes, in units of the noise there, as one row of numbers."""
        hyper = self._axes.values(coordinates)
        unit = float(self._axes.unit(hyper))
        density, assembly = self.density, self.assembly
        line = assembly.linearise(density.point, hyper)
        white = whitening(assembly.noise, hyper, assembly.record, density.extra(line))
        table = white(np.column_stack([line.jacobian, density.residual(line)]))
        whole = np.sqrt(unit) * table
        whole = whole.T @ whole
        logdet = white.logdet - self.size * math.log(unit)
        return np.append(whole[np.triu_indices(len(whole))], logdet)


class _Axes:
    """What products move with: coordinates of shapes, values of promoted coefficients, and the noise's parameters."""

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        hypers, noise = assembly.hypers, assembly.noise
        free = {h.name for h in hypers}
        self.spreads = {
            name: t.spread_name
            for t in assembly.terms
            if t.place == "phi" and t.spread_name is not None
            for name in t.members
        }
        self.shapes = {h.name: i for i, h in enumerate(hypers) if h.kind == "shape"}
        self.promoted = [h.name for h in hypers if h.kind == "promoted"]
        known = known_variance(assembly.record)
        self.absolute = np.ndim(known) > 0 or len(assembly.row_sd) > 0
        self.noise: list[str] = []
        self.ratio, self.step = False, 0.0
        if isinstance(noise, OrnsteinUhlenbeck):
            steps = assembly.record.in_time[1]
            self.step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
            names = ("noise.white", DIFFUSION, CORRELATION_TIME)
            # Where no variance is known beforehand, all scales by the one unit.
            self.ratio = not self.absolute and {"noise.white", DIFFUSION} <= free
            self.noise = [n for n in names if n in free and not (self.ratio and n == "noise.white")]
        else:
            names = [n for n in noise.parameters() if n in free]
            self.noise = [n for n in names if self.absolute or n != "noise.white"]
        extra = np.median(known) if np.ndim(known) else 0.0
        self.floor = float(extra)
        self.names = (*self.shapes, *self.promoted, *self.noise)

    def unit(self, hyper: Batch) -> Float[np.ndarray, "b"] | float:
        """A variance that the products are about inversely proportional to."""
        found = hyper["noise.white"] ** 2 + self.floor
        return found + hyper[DIFFUSION] ** 2 * self.step if self.step else found

    def of(self, hyper: Batch, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b m"]:
        """Coordinates along the axes."""
        found: list[np.ndarray | float] = [v[:, i] for i in self.shapes.values()]
        for name in self.promoted:
            spread = self.spreads.get(name)
            found.append(hyper[name] * (hyper[spread] if spread else 1.0))
        for name in self.noise:
            value = hyper[name] / hyper["noise.white"] if self._relative(name) else hyper[name]
            found.append(value if name in LINEAR else np.log(value))
        return np.stack(np.broadcast_arrays(*found), axis=1)

    def _relative(self, name: str) -> bool:
        return self.ratio and name == DIFFUSION

    def values(self, coordinates: Float[np.ndarray, "m"]) -> Values:
        """φ by name at a point of the axes; what products do not move with is one."""
        hyper = {h.name: 1.0 for h in self.assembly.hypers}
        hyper.update(self.assembly.fixed_values)
        along = iter(coordinates)
        for name, i in self.shapes.items():
            hyper[name] = float(self.assembly.hypers[i].prior.value(next(along)))
        for name in self.promoted:
            hyper[name] = float(next(along))
        for name in self.noise:
            hyper[name] = next(along) if name in LINEAR else math.exp(next(along))
        return hyper


class _Polynomials:
    """Chebyshev's polynomials up to a total degree, in coordinates that the Laplace fit is round in."""

    def __init__(self, draws: Float[np.ndarray, "s m"], degree: int) -> None:
        self.centre = draws.mean(axis=0)
        spread = np.atleast_2d(np.cov(draws.T))
        self.root = REACH * np.linalg.cholesky(spread + 1e-12 * np.diag(np.diag(spread)))
        self.degree, self.dim = degree, len(self.centre)
        chosen = range(self.dim + 1)
        powers = list(combinations_with_replacement(chosen, degree))
        self.powers = np.array([[c.count(j + 1) for j in range(self.dim)] for c in powers])

    def points(self, count: int) -> Float[np.ndarray, "s m"]:
        """Where to compute the products: a sequence, dense at the ends where there are few axes."""
        ratio = _golden(self.dim)
        steps = (np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1, self.dim + 1) + 0.5) % 1
        t = np.cos(np.pi * steps)
        if self.dim > 3:  # corners of a cube are far out
            t = t / np.maximum(1.0, np.linalg.norm(t, axis=1))[:, None]
        return self.centre + t @ self.root.T

    def _t(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b m"]:
        return np.linalg.solve(self.root, (coordinates - self.centre).T).T

    def outside(self, coordinates: Float[np.ndarray, "b m"]) -> np.ndarray:
        return np.max(np.abs(self._t(coordinates)), axis=1) > 1

    def _terms(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b t"]:
        t = self._t(coordinates)
        t = t / np.maximum(1.0, np.max(np.abs(t), axis=1))[:, None]
        angle = np.arccos(np.clip(t, -1.0, 1.0))
        one = np.cos(angle[:, :, None] * np.arange(self.degree + 1))
        found = np.ones((len(t), len(self.powers)))
        for j in range(self.dim):
            found *= one[:, j, self.powers[:, j]]
        return found

    def fit(self, points: np.ndarray, rows: np.ndarray, size: int) -> None:
        self.size = size
        self.table = np.linalg.lstsq(self._terms(points), rows, rcond=None)[0]

    def at(self, coordinates: Float[np.ndarray, "b m"]) -> Grams:
        """Products in units of the noise."""
        rows = self._terms(coordinates) @ self.table
        count = self.size + 1
        upper = np.zeros((len(rows), count, count))
        i, j = np.triu_indices(count)
        upper[:, i, j] = rows[:, :-1]
        upper[:, j, i] = rows[:, :-1]
        return Grams(upper[:, :-1, :-1], upper[:, :-1, -1], upper[:, -1, -1], rows[:, -1])


def _golden(dim: int) -> float:
    """The root of x^(d+1) = x + 1, whose powers make an even sequence in d dimensions."""
    x = 2.0
    for _ in range(40):
        x = (1 + x) ** (1 / (dim + 1))
    return x
