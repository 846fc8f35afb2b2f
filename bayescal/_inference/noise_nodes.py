"""Products of columns at nodes of one variable, from which they follow at every setting of a noise law.

After an orthonormal transform of the columns a covariance is Σ(θ) = D(θ) − U·M·Uᵀ, D diagonal and a smooth function of
one variable z of each row. With ℓ_c Lagrange's polynomials at nodes z_c, 1/D(z) = Σ_c ℓ_c(z)/D(z_c), so that

    B_c = Σ_rows ℓ_c(z)·t·tᵀ,

give TᵀΣ(θ)⁻¹T = Σ_c B_c/D(z_c) and log|Σ(θ)| = Σ_c n_c·log D(z_c), both with the ends of runs, for every θ.

| noise | variable | transform |
|---|---|---|
| one variance | one node | none |
| scatter along a column | the column's place, 25 nodes or more | none |
| stationary, even steps | λ = 2 − 2·cos(πk/n), about 50 nodes | cosine transform of each run |

Weights at the nodes are right to 2e-8, with Matérn's process to 4e-6.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct
from scipy.linalg import block_diag

from bayescal._data.records import EVEN_STEPS
from bayescal._inference.chebyshev import nodes_and_shares
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.noise_spectrum import eigenvalues, end_transform

WRITTEN_STEPS = 0.5  # of a step, by which times of an even clock may scatter where they are written to few digits
SINGLE_FREQUENCIES = 16  # the lowest of a run, each a node of its own
SEGMENT_RATIO = 30.0  # of λ from end to end of a segment of the others,
FINE_RATIO = 10**0.5  # the same about all singular points, of distances from them,
SEGMENT_NODES = 12  # which has so many nodes
CHUNK_NUMBERS = 2_000_000  # of what is computed at once for several settings
SIGNS = (1, -1)  # of the two combinations of a run's ends
COLUMN_NODES = 25  # along a column that the scatter follows, at least,
NODES_PER_UNIT = 6  # and of its place, which may be the logarithm of a size that spans decades

Columns = Float[np.ndarray, "n k"]
Values = Mapping[str, Any]  # parameters of a law by name: a number, or (s,) of several settings


class Weights(NamedTuple):
    """A law at s settings; two of its parts by (length of a run, sign)."""

    inverse: Float[np.ndarray, "s j"]  # 1/D at the nodes
    log_det: Float[np.ndarray, "s"]  # log|Σ|
    # 1/D times the end functions at the nodes of each length of run
    ends: dict[tuple[int, int], Float[np.ndarray, "s q i"]]
    inner: dict[tuple[int, int], Float[np.ndarray, "s q q"]]  # (I − M·Z)⁻¹·M


class OneNode:
    """Independent noise of one variance."""

    count = 1

    def __init__(self, size: int) -> None:
        self.size = size

    def transform(self, columns: Columns) -> list[Columns]:
        """Return the columns as products are made of them, one array for each run."""
        return [columns]

    def products(self, a: list[Columns], b: list[Columns]) -> Float[np.ndarray, "j ka kb"]:
        """Return products of transformed columns at the nodes."""
        return (a[0].T @ b[0])[None]

    def end_products(self, a: list[Columns]) -> dict[tuple[int, int], Float[np.ndarray, "r i k"]]:
        """Return products of transformed columns with the ends of each run, by (length, sign)."""
        return {}

    def weights(self, law: Noise, values: Values) -> Weights:
        """Return the law at some settings of its parameters."""
        variance = np.asarray(law.shared_variance(values), float).reshape(-1, 1)
        return Weights(1 / variance, self.size * np.log(variance[:, 0]), {}, {})


class AlongColumn(OneNode):
    """Independent noise whose variance is a smooth function of a place z (`Noise.variance_place`)."""

    def __init__(self, z: Float[np.ndarray, "n"]) -> None:
        super().__init__(len(z))
        low, high = float(np.min(z)), float(np.max(z))
        high = high if high > low else low + 1.0
        self.count = max(COLUMN_NODES, math.ceil(NODES_PER_UNIT * (high - low)))
        self.nodes, self.share = nodes_and_shares(low, high, self.count, z)
        self.rows = self.share.sum(axis=0)

    def products(self, a, b):
        weighted = (self.share.T[:, :, None] * a[0]).transpose(0, 2, 1).reshape(-1, self.size)
        return (weighted @ b[0]).reshape(self.count, a[0].shape[1], b[0].shape[1])

    def weights(self, law, values):
        settings = {name: np.reshape(np.asarray(v, float), (-1, 1)) for name, v in values.items()}
        variance = law.variance_along(settings, self.nodes)
        return Weights(1 / variance, np.log(variance) @ self.rows, {}, {})


class Segment(NamedTuple):
    """A stretch of a run's frequencies."""

    rows: slice
    places: Float[np.ndarray, "c"]  # of its nodes, in frequencies
    share: Float[np.ndarray, "k c"]  # Lagrange's polynomials of the nodes at the frequencies


class InFrequency(OneNode):
    """Stationary noise within runs of even steps, of any lengths.

    Attributes:
        runs: rows of each run, in the order of time.
        step: between readings, s.
        lam: λ of each node (j,); those of runs of one length stand together.
    """

    def __init__(
        self,
        runs: Sequence[Int[np.ndarray, "r"]],
        step: float,
        segments: Callable[[int], Iterator[Segment]] | None = None,
    ) -> None:
        """Set up nodes; `segments` of a run's frequencies by its length, the usual ones if not given."""
        super().__init__(sum(map(len, runs)))
        self.runs, self.step = list(runs), step
        lengths = [len(run) for run in runs]
        self.times = {n: lengths.count(n) for n in sorted(set(lengths))}
        self.segments, self.at, lam = dict[int, list[Segment]](), dict[int, slice](), []
        for n in self.times:
            first = sum(map(len, lam))
            self.segments[n] = [*(segments or _segments)(n)]
            lam += [eigenvalues(n, s.places) for s in self.segments[n]]
            self.at[n] = slice(first, sum(map(len, lam)))
        self.lam = np.concatenate(lam)
        self.count = len(self.lam)
        self.rows = np.zeros(self.count)
        self.end_squares = {}
        for n, times in self.times.items():
            self.rows[self.at[n]] = times * self._onto_nodes(n, np.ones((n, 1)))[:, 0]
            for sign in SIGNS:
                squares = end_transform(n, sign)[:, None] ** 2
                self.end_squares[n, sign] = self._onto_nodes(n, squares)[:, 0]

    def _onto_nodes(self, n: int, values: Columns) -> Float[np.ndarray, "i k"]:
        """Return Σ_rows ℓ_c·values at the nodes of a run of n readings."""
        return np.concatenate([s.share.T @ values[s.rows] for s in self.segments[n]])

    def transform(self, columns):
        return [np.asfortranarray(dct(columns[r], axis=0, norm="ortho")) for r in self.runs]

    def products(self, a, b):
        products = np.zeros((self.count, a[0].shape[1], b[0].shape[1]))
        for run, first, second in zip(self.runs, a, b, strict=True):
            node = self.at[len(run)].start
            for rows, places, share in self.segments[len(run)]:
                nodes, node = range(node, node + len(places)), node + len(places)
                if share.shape[0] == share.shape[1]:  # each frequency is a node
                    products[nodes.start : nodes.stop] += first[rows, :, None] * second[rows, None]
                    continue
                count = max(1, CHUNK_NUMBERS // first[rows].size)  # nodes side by side
                for c in range(0, len(nodes), count):
                    some = share[:, c : c + count].T
                    weighted = (some[:, None] * first[rows].T).reshape(-1, len(share))
                    at = slice(nodes[c], nodes[c] + len(some))
                    products[at] += (weighted @ second[rows]).reshape(len(some), first.shape[1], -1)
        return products

    def end_products(self, a):
        products = {}
        for n, sign in self.end_squares:
            end = end_transform(n, sign)[:, None]
            columns = [t for run, t in zip(self.runs, a, strict=True) if len(run) == n]
            products[n, sign] = np.array([self._onto_nodes(n, end * t) for t in columns])
        return products

    def weights(self, law, values):
        settings = {name: np.reshape(np.asarray(v, float), (-1, 1)) for name, v in values.items()}
        terms = law.spectrum(settings, self.step, self.lam)
        diagonal = settings[WHITE] ** 2 + sum((t.symbol for t in terms), np.zeros_like(self.lam))
        inverse, count = 1 / diagonal, len(diagonal)
        log_det = np.log(diagonal) @ self.rows
        ends, inner = {}, {}
        functions = [np.broadcast_to(u, diagonal.shape) for t in terms for u in t.ends]
        if not functions:
            return Weights(inverse, log_det, ends, inner)
        u = np.stack(functions, axis=1)  # (s, q, j)
        whitened = u * inverse[:, None]
        for (n, sign), squares in self.end_squares.items():
            nodes = self.at[n]
            m = _block_diagonal([t.correction(n, sign) for t in terms], count)
            z = (whitened[:, :, nodes] * squares) @ u[:, :, nodes].transpose(0, 2, 1)
            core = np.eye(u.shape[1]) - m @ z
            positive, log_core = np.linalg.slogdet(core)
            log_det = log_det + self.times[n] * np.where(positive > 0, log_core, np.inf)
            core = np.where(np.isfinite(core), core, np.eye(len(core[0])))
            inner[n, sign] = np.linalg.solve(core, m)
            ends[n, sign] = whitened[:, :, nodes]
        return Weights(inverse, log_det, ends, inner)

    def whitened(self, law: Noise, values: Values, columns: Columns) -> Columns:
        """Return Σ^(−½) times columns at one setting, in frequency, run after run: their products are whitened ones.

        A run's Σ⁻¹ is E·(I + V·K·Vᵀ)·E with E = D^(−½); I + V·K·Vᵀ, of few columns V, has a root of the same form.
        """
        settings = {name: np.reshape(np.asarray(v, float), (1, 1)) for name, v in values.items()}
        weights, roots, parts = self.weights(law, values), dict[int, Any](), []
        for run in self.runs:
            n = len(run)
            if n not in roots:
                terms = law.spectrum(settings, self.step, eigenvalues(n, np.arange(n)))
                scale = 1 / np.sqrt(settings[WHITE] ** 2 + sum(t.symbol for t in terms))[0]
                u = np.array([np.broadcast_to(e, (1, n))[0] for t in terms for e in t.ends])
                ends = np.concatenate([scale * u * end_transform(n, sign) for sign in SIGNS])
                base, r = np.linalg.qr(ends.T)
                inner = block_diag(*(weights.inner[n, sign][0] for sign in SIGNS))
                size, vectors = np.linalg.eigh(r @ inner @ r.T)
                roots[n] = scale[:, None], base @ vectors, np.sqrt(1 + size)[:, None] - 1
            scale, base, gain = roots[n]
            whitened = scale * dct(columns[run], axis=0, norm="ortho")
            parts.append(whitened + base @ (gain * (base.T @ whitened)))
        return np.concatenate(parts)


def in_frequency(order: Int[np.ndarray, "n"], step: Float[np.ndarray, "n"]) -> InFrequency | None:
    """Return the nodes of stationary noise; None where steps are uneven or a run has fewer than 3 readings.

    Even are those of a clock that jitters little, and those of times that are written to a few digits: neither adds up.
    `step`: since the reading before in the order of time, s; −1 at a run's first.
    """
    first, inside = np.flatnonzero(step < 0), step[step >= 0]
    runs = np.split(order, first[1:])
    if min(map(len, runs)) < 3 or (usual := float(np.mean(inside))) <= 0:
        return None
    if np.max(np.abs(inside - np.median(inside))) <= EVEN_STEPS * usual:
        return InFrequency(runs, usual)
    # Each run's times as a line through their indices, about its middle.
    clocks = [t - t.mean() for t in np.split(np.cumsum(np.maximum(step, 0.0)), first[1:])]
    places = [np.arange(len(t)) - 0.5 * (len(t) - 1) for t in clocks]
    period = sum(map(np.dot, places, clocks)) / sum(i @ i for i in places)
    late = max(float(np.ptp(t - period * i)) for t, i in zip(clocks, places, strict=True))
    return InFrequency(runs, period) if late <= WRITTEN_STEPS * period else None


class Products:
    """Products of `width` columns at the nodes, and with the ends of runs: TᵀΣ⁻¹T at any setting."""

    def __init__(
        self,
        at_nodes: Float[np.ndarray, "j r r"],
        ends: Mapping[tuple[int, int], Float[np.ndarray, "u i r"]],
    ) -> None:
        self.width = at_nodes.shape[1]
        self._runs = {k: e.transpose(1, 0, 2).reshape(e.shape[1], -1) for k, e in ends.items()}
        self._flat = np.ascontiguousarray(at_nodes).reshape(len(at_nodes), -1)

    @classmethod
    def of(cls, nodes: OneNode, columns: Columns) -> Products:
        """Return the products of columns (n, r) with each other."""
        transformed = nodes.transform(columns)
        return cls(nodes.products(transformed, transformed), nodes.end_products(transformed))

    def _at_ends(
        self, weights: Weights, settings: slice
    ) -> Iterator[tuple[Float[np.ndarray, "s q x"], Float[np.ndarray, "s q x"]]]:
        """Yield what columns have at the ends of all runs of a length (s, q, runs·r), and (I − M·Z)⁻¹·M times it."""
        for key, runs in self._runs.items():
            if key in weights.inner:
                ends, inner = weights.ends[key][settings], weights.inner[key][settings]
                # One product: of small ones each costs a call.
                at_ends = (ends.reshape(-1, ends.shape[2]) @ runs).reshape(*ends.shape[:2], -1)
                yield at_ends, inner @ at_ends

    def gram(self, weights: Weights, settings: slice = slice(None)) -> Float[np.ndarray, "s r r"]:
        """Return TᵀΣ⁻¹T at some of the settings."""
        gram = (weights.inverse[settings] @ self._flat).reshape(-1, self.width, self.width)
        both = [*self._at_ends(weights, settings)]
        if both:
            first, second = (
                np.concatenate([a.reshape(len(a), -1, self.width) for a in arrays], axis=1)
                for arrays in zip(*both, strict=True)
            )
            gram += first.transpose(0, 2, 1) @ second
        return gram

    def traces(self, weights: Weights, e: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "s"]:
        """Return tr(E·TᵀΣ⁻¹T) at all settings."""
        traces = weights.inverse @ (self._flat @ e.ravel())
        for at_ends, by in self._at_ends(weights, slice(None)):
            product = at_ends.reshape(*at_ends.shape[:2], -1, self.width) @ e
            traces = traces + np.sum(by * product.reshape(by.shape), axis=(1, 2))
        return traces


def _segments(n: int) -> Iterator[Segment]:
    """Yield segments of a run's frequencies: the lowest alone, decades of the others."""
    symbol, start = eigenvalues(n, np.arange(n)), 0
    while start < n:
        if start == 0:
            stop = min(SINGLE_FREQUENCIES, n)
        else:
            stop = max(start + 1, int(np.searchsorted(symbol, symbol[start] * SEGMENT_RATIO)))
            stop = n if stop > 0.8 * n else stop
        rows, places = slice(start, stop), np.arange(start, stop)
        if start == 0 or len(places) <= SEGMENT_NODES + 2:
            yield Segment(rows, places, np.eye(len(places)))
        else:
            x = np.log(symbol[rows])
            nodes, share = nodes_and_shares(x[0], x[-1], SEGMENT_NODES, x)
            angle = np.arcsin(0.5 * np.exp(0.5 * nodes))
            yield Segment(rows, 2 * n / np.pi * angle, share)
        start = stop


def _fine_segments(n: int, lines: Sequence[float]) -> Iterator[Segment]:
    """Yield segments of the frequencies 1 … n − 1 of a run.

    A spectrum has singular points near λ = 0 (a random walk), λ = 4 (averages of neighbours) and narrow lines. Around
    each of them single frequencies are nodes, then Chebyshev's points in the logarithm of the distance.
    """
    singular = sorted({0, n, *(round(k) for k in lines if 0 < round(k) < n)})
    graded = [0, *_graded(n)]
    for low, high in itertools.pairwise(singular):
        half = (high - low) // 2
        for point, sign, reach in ((low, 1, half), (high, -1, high - low - half)):
            cuts = [d for d in graded if d < reach] + [reach]
            for near, far in itertools.pairwise(cuts):
                begin, end = sorted((point + sign * near, point + sign * far))
                begin = max(begin, 1)
                places = np.arange(begin, end)
                if near == 0 or len(places) <= SEGMENT_NODES + 2:
                    yield Segment(slice(begin, end), places, np.eye(len(places)))
                    continue
                x = np.log(np.abs(places - point))
                nodes, share = nodes_and_shares(x.min(), x.max(), SEGMENT_NODES, x)
                yield Segment(slice(begin, end), point + sign * np.exp(nodes), share)


def _graded(n: int) -> Iterator[int]:
    """Yield distances from a singular point at which segments begin."""
    distance: float = SINGLE_FREQUENCIES
    while distance < n:
        yield round(distance)
        distance *= FINE_RATIO


def _block_diagonal(parts: Sequence[Any], count: int) -> Float[np.ndarray, "s q q"]:
    """Return blocks (k, k, s) along the diagonal."""
    size, at = sum(map(len, parts)), 0
    matrices = np.zeros((count, size, size))
    for part in parts:
        k = at + len(part)
        matrices[:, at:k, at:k], at = np.moveaxis(part, -1, 0), k
    return matrices


class EvenSpectrum:
    """Columns of runs of even steps, their levels and all columns but the last taken out under flat priors.

    A level of each run is an infinite D at k = 0, which is left out: this is the restricted likelihood.

    Attributes:
        step: between readings, s.
    """

    def __init__(
        self, runs: Sequence[Float[np.ndarray, "n r"]], step: float, lines: Sequence[float] = ()
    ) -> None:
        """Transform the runs' columns, the last of them the output; `lines`: frequencies of narrow lines, Hz."""

        def segments(n: int) -> Iterator[Segment]:
            return _fine_segments(n, [2 * f * step * n for f in lines])

        self.step, self._width = step, runs[0].shape[1]
        rows = np.split(np.arange(sum(map(len, runs))), np.cumsum([*map(len, runs)])[:-1])
        self._nodes = InFrequency(rows, step, segments)
        self._products = Products.of(self._nodes, np.concatenate(runs))

    def log_likelihood(self, law: Noise, values: Values) -> Float[np.ndarray, "s"]:
        """Return the restricted log likelihood of a stationary law at settings (s,), but for a constant."""
        settings = {name: np.reshape(np.asarray(v, float), -1) for name, v in values.items()}
        chunk = max(1, CHUNK_NUMBERS // (12 * self._nodes.count))
        chunks = [slice(at, at + chunk) for at in range(0, len(settings[WHITE]), chunk)]
        with np.errstate(all="ignore"):
            parts = [self._of_chunk(law, {n: v[c] for n, v in settings.items()}) for c in chunks]
        return np.concatenate(parts)

    def _of_chunk(self, law: Noise, values: Values) -> Float[np.ndarray, "s"]:
        weights = self._nodes.weights(law, values)
        gram, log_det = self._products.gram(weights), weights.log_det
        rss = gram[:, -1, -1]
        if self._width > 1:
            inner, cross = gram[:, :-1, :-1], gram[:, :-1, -1:]
            inner = np.where(np.isfinite(inner), inner, np.eye(self._width - 1))
            log_det = log_det + np.linalg.slogdet(inner)[1]
            rss = rss - (cross.swapaxes(1, 2) @ np.linalg.solve(inner, cross))[:, 0, 0]
        return -0.5 * (log_det + rss)
