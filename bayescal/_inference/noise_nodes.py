"""Inner products TᵀΣ(θ)⁻¹T of columns T for any parameters θ of a noise law, interpolated in one variable.

After an orthonormal transform of the rows the noise covariance is Σ(θ) = D(θ) − U·M·Uᵀ, with D diagonal and a smooth
function of one variable z of each row. With Lagrange polynomials ℓ_c at nodes z_c, 1/D(z) = Σ_c ℓ_c(z)/D(z_c), so that

    B_c = Σ_rows ℓ_c(z)·t·tᵀ,   n_c = Σ_rows ℓ_c(z)   (t a transformed row of T)

give TᵀΣ(θ)⁻¹T = Σ_c B_c/D(z_c) and log|Σ(θ)| = Σ_c n_c·log D(z_c), plus corrections at the ends of runs, for all θ.

| noise | variable | transform |
|---|---|---|
| one variance | one node | none |
| heteroscedastic | position along the covariate, 25 nodes or more | none |
| stationary, even steps | λ = 2 − 2·cos(πk/n), about 50 nodes | cosine transform of each run |

The relative interpolation error is 2e-8, for a Matérn process 4e-6.
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
from bayescal._inference.expansion import lagrange_at_nodes
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.noise_spectrum import compute_eigenvalues, transform_end

MAX_JITTER_STEPS = 0.5  # tolerated rounding of evenly spaced times, in steps
LOWEST_NODE_COUNT = 16  # number of lowest frequencies of a run that are nodes
SEGMENT_RATIO = 30.0  # ratio of λ across an interpolated segment of frequencies
FINE_RATIO = 10**0.5  # ratio of distances from a singular point across a segment
SEGMENT_NODES = 12  # Chebyshev nodes of a segment
MAX_ELEMENTS = 2_000_000  # array elements per batch
SIGNS = (1, -1)  # of e± = (e₁ ± eₙ)/√2, the ends of a run of n readings
MIN_COLUMN_NODES = 25  # Chebyshev nodes along a covariate
NODES_PER_UNIT = 6  # Chebyshev nodes per unit of a (possibly logarithmic) covariate

Columns = Float[np.ndarray, "n k"]
Values = Mapping[str, Any]  # parameters of a law by name: a number, or (s,) for s parameter sets


class Weights(NamedTuple):
    """Weights of interpolation nodes for s parameter sets of a noise law; `ends` and `inner` by (run length, sign)."""

    inverse: Float[np.ndarray, "s j"]  # 1/D at the nodes
    log_det: Float[np.ndarray, "s"]  # log|Σ|
    # 1/D times the end functions (`SpectralTerm.ends`) at the nodes of each run length
    ends: dict[tuple[int, int], Float[np.ndarray, "s q i"]]
    inner: dict[tuple[int, int], Float[np.ndarray, "s q q"]]  # (I − M·Z)⁻¹·M


class SingleNode:
    """A single node, for homoscedastic independent noise; base class of all sets of interpolation nodes."""

    count = 1

    def __init__(self, size: int, node: float | np.ndarray = math.nan) -> None:
        self.size, self.nodes, self.rows = size, np.reshape(node, 1), np.array([size])

    def transform(self, columns: Columns) -> list[Columns]:
        """Transform columns (n, k) orthonormally, so that the noise covariance is diagonal; one array per run."""
        return [columns]

    def products(self, a: list[Columns], b: list[Columns]) -> Float[np.ndarray, "j ka kb"]:
        """Return the inner products B_c of transformed columns at each node c (j, ka, kb)."""
        return (a[0].T @ b[0])[None]

    def end_products(self, a: list[Columns]) -> dict[tuple[int, int], Float[np.ndarray, "r i k"]]:
        """Return the inner products of transformed columns with the end vectors of each run, by (run length, sign)."""
        return {}

    def weights(self, law: Noise, values: Values) -> Weights:
        """Return the weights of the nodes at s parameter sets of the noise law."""
        parameters = {name: np.reshape(np.asarray(v, float), (-1, 1)) for name, v in values.items()}
        variance = law.variance_at(parameters, self.nodes)
        return Weights(1 / variance, np.log(variance) @ self.rows, {}, {})


class ColumnNodes(SingleNode):
    """Interpolation nodes for independent noise, its variance a smooth function of z (`Noise.variance_coordinate`)."""

    def __init__(self, z: Float[np.ndarray, "n"]) -> None:
        super().__init__(len(z))
        low, high = float(np.min(z)), float(np.max(z))
        high = high if high > low else low + 1.0
        self.count = max(MIN_COLUMN_NODES, math.ceil(NODES_PER_UNIT * (high - low)))
        self.nodes, self.lagrange = lagrange_at_nodes(low, high, self.count, z)
        self.rows = self.lagrange.sum(axis=0)

    def products(self, a, b):
        weighted_a = (self.lagrange.T[:, :, None] * a[0]).transpose(0, 2, 1).reshape(-1, self.size)
        return (weighted_a @ b[0]).reshape(self.count, a[0].shape[1], b[0].shape[1])


class Segment(NamedTuple):
    """A segment of a run's frequencies (rows of its cosine transform), with its interpolation nodes."""

    rows: slice
    frequencies: Float[np.ndarray, "c"]  # real frequency indices of the nodes
    lagrange: Float[np.ndarray, "k c"]  # Lagrange polynomials of the nodes at the frequencies


class DCTNodes(SingleNode):
    """Interpolation nodes in frequency (cosine transform) for stationary noise on evenly spaced runs of any lengths.

    Attributes:
        runs: rows of each run, in time order.
        step: sampling interval, s.
        lam: Laplacian eigenvalue λ of each node (j,), grouped by run length.
    """

    def __init__(
        self,
        runs: Sequence[Int[np.ndarray, "r"]],
        step: float,
        segments: Callable[[int], Iterator[Segment]] | None = None,
    ) -> None:
        """Set up the nodes; `segments`: function that maps a run length to its frequency segments."""
        super().__init__(sum(map(len, runs)))
        self.runs, self.step = list(runs), step
        lengths = [len(run) for run in runs]
        self.run_counts = {n: lengths.count(n) for n in sorted(set(lengths))}
        self.segments, self.node_slices, lam = dict[int, list[Segment]](), dict[int, slice](), []
        for n in self.run_counts:
            first = sum(map(len, lam))
            self.segments[n] = [*(segments or _list_segments)(n)]
            lam += [compute_eigenvalues(n, s.frequencies) for s in self.segments[n]]
            self.node_slices[n] = slice(first, sum(map(len, lam)))
        self.lam = np.concatenate(lam)
        self.count = len(self.lam)
        self.rows = np.zeros(self.count)
        self.end_squares = {}
        for n, times in self.run_counts.items():
            self.rows[self.node_slices[n]] = times * self._project(n, np.ones((n, 1)))[:, 0]
            for sign in SIGNS:
                squares = transform_end(n, sign)[:, None] ** 2
                self.end_squares[n, sign] = self._project(n, squares)[:, 0]

    def _project(self, n: int, values: Columns) -> Float[np.ndarray, "i k"]:
        """Return Σ_rows ℓ_c·values (i, k), ℓ_c the Lagrange polynomials of the nodes of a run of n readings."""
        return np.concatenate([s.lagrange.T @ values[s.rows] for s in self.segments[n]])

    def transform(self, columns):
        return [np.asfortranarray(dct(columns[r], axis=0, norm="ortho")) for r in self.runs]

    def products(self, a, b):
        products = np.zeros((self.count, a[0].shape[1], b[0].shape[1]))
        for run, run_a, run_b in zip(self.runs, a, b, strict=True):
            next_node = self.node_slices[len(run)].start
            for rows, frequencies, lagrange in self.segments[len(run)]:
                nodes = range(next_node, next_node + len(frequencies))
                next_node = nodes.stop
                if lagrange.shape[0] == lagrange.shape[1]:  # each frequency is a node
                    products[nodes.start : nodes.stop] += run_a[rows, :, None] * run_b[rows, None]
                    continue
                batch_size = max(1, MAX_ELEMENTS // run_a[rows].size)  # nodes side by side
                for c in range(0, len(nodes), batch_size):
                    weights = lagrange[:, c : c + batch_size].T
                    weighted = (weights[:, None] * run_a[rows].T).reshape(-1, len(lagrange))
                    part = (weighted @ run_b[rows]).reshape(len(weights), run_a.shape[1], -1)
                    products[nodes[c] : nodes[c] + len(weights)] += part
        return products

    def end_products(self, a):
        products = {}
        for n, sign in self.end_squares:
            end = transform_end(n, sign)[:, None]
            columns = [t for run, t in zip(self.runs, a, strict=True) if len(run) == n]
            products[n, sign] = np.array([self._project(n, end * t) for t in columns])
        return products

    def weights(self, law, values):
        parameters = {name: np.reshape(np.asarray(v, float), (-1, 1)) for name, v in values.items()}
        terms = law.spectrum(parameters, self.step, self.lam)
        diagonal = parameters[WHITE] ** 2 + sum((t.symbol for t in terms), np.zeros_like(self.lam))
        inverse, count = 1 / diagonal, len(diagonal)
        log_det = np.log(diagonal) @ self.rows
        ends, inner = {}, {}
        functions = [np.broadcast_to(u, diagonal.shape) for t in terms for u in t.ends]
        if not functions:
            return Weights(inverse, log_det, ends, inner)
        u = np.stack(functions, axis=1)  # (s, q, j)
        whiten = u * inverse[:, None]
        for (n, sign), squares in self.end_squares.items():
            nodes = self.node_slices[n]
            m = _assemble_blocks([t.correction(n, sign) for t in terms], count)
            z = (whiten[:, :, nodes] * squares) @ u[:, :, nodes].transpose(0, 2, 1)
            factor = np.eye(u.shape[1]) - m @ z
            sign_det, log_core = np.linalg.slogdet(factor)
            log_det = log_det + self.run_counts[n] * np.where(sign_det > 0, log_core, np.inf)
            factor = np.where(np.isfinite(factor), factor, np.eye(len(factor[0])))
            inner[n, sign] = np.linalg.solve(factor, m)
            ends[n, sign] = whiten[:, :, nodes]
        return Weights(inverse, log_det, ends, inner)

    def whiten(self, law: Noise, values: Values, columns: Columns) -> Columns:
        """Multiply columns (n, k) by a square root of Σ⁻¹ for one parameter set; rows are frequencies, run by run.

        A run's Σ⁻¹ is E·(I + V·K·Vᵀ)·E with E = D^(−½); I + V·K·Vᵀ, of few columns V, has a root of the same form.
        """
        parameters = {name: np.reshape(np.asarray(v, float), (1, 1)) for name, v in values.items()}
        weights, roots, whitened_runs = self.weights(law, values), dict[int, Any](), []
        for run in self.runs:
            n = len(run)
            if n not in roots:
                terms = law.spectrum(parameters, self.step, compute_eigenvalues(n, np.arange(n)))
                scale = 1 / np.sqrt(parameters[WHITE] ** 2 + sum(t.symbol for t in terms))[0]
                u = np.array([np.broadcast_to(e, (1, n))[0] for t in terms for e in t.ends])
                ends = np.concatenate([scale * u * transform_end(n, sign) for sign in SIGNS])
                basis, r = np.linalg.qr(ends.T)
                inner_matrix = block_diag(*(weights.inner[n, sign][0] for sign in SIGNS))
                eigenvalues, vectors = np.linalg.eigh(r @ inner_matrix @ r.T)
                roots[n] = scale[:, None], basis @ vectors, np.sqrt(1 + eigenvalues)[:, None] - 1
            scale, basis, root_factor = roots[n]
            whitened = scale * dct(columns[run], axis=0, norm="ortho")
            whitened_runs.append(whitened + basis @ (root_factor * (basis.T @ whitened)))
        return np.concatenate(whitened_runs)


def dct_nodes(time_order: Int[np.ndarray, "n"], step: Float[np.ndarray, "n"]) -> DCTNodes | None:
    """Return frequency nodes for stationary noise; None if time steps are uneven or a run has fewer than 3 readings.

    Small jitter, and rounding of times that does not accumulate, are tolerated. step: time since the previous reading,
    s; −1 at the first of a run.
    """
    run_starts, steps = np.flatnonzero(step < 0), step[step >= 0]
    runs = np.split(time_order, run_starts[1:])
    if min(map(len, runs)) < 3 or (mean_step := float(np.mean(steps))) <= 0:
        return None
    if np.max(np.abs(steps - np.median(steps))) <= EVEN_STEPS * mean_step:
        return DCTNodes(runs, mean_step)
    # Regression of each run's times on their indices, both centred.
    times = [t - t.mean() for t in np.split(np.cumsum(np.maximum(step, 0.0)), run_starts[1:])]
    indices = [np.arange(len(t)) - 0.5 * (len(t) - 1) for t in times]
    period = sum(map(np.dot, indices, times)) / sum(i @ i for i in indices)
    max_deviation = max(float(np.ptp(t - period * i)) for t, i in zip(times, indices, strict=True))
    return DCTNodes(runs, period) if max_deviation <= MAX_JITTER_STEPS * period else None


class Products:
    """Cached inner products of `width` columns at spectral nodes and run ends: TᵀΣ⁻¹T for any noise parameters."""

    def __init__(
        self,
        node_products: Float[np.ndarray, "j r r"],
        ends: Mapping[tuple[int, int], Float[np.ndarray, "u i r"]],
    ) -> None:
        self.width = node_products.shape[1]
        self._end_table = {k: e.transpose(1, 0, 2).reshape(e.shape[1], -1) for k, e in ends.items()}
        self._node_table = np.ascontiguousarray(node_products).reshape(len(node_products), -1)

    @classmethod
    def from_columns(cls, nodes: SingleNode, columns: Columns) -> Products:
        """Compute the inner products of columns (n, r) at the nodes and run ends."""
        transformed = nodes.transform(columns)
        return cls(nodes.products(transformed, transformed), nodes.end_products(transformed))

    def _multiply_ends(
        self, weights: Weights, settings: slice
    ) -> Iterator[tuple[Float[np.ndarray, "s q x"], Float[np.ndarray, "s q x"]]]:
        """Yield UᵀD⁻¹T of all runs of one length (s, q, runs·r), and (I − M·Z)⁻¹·M times that."""
        for key, runs in self._end_table.items():
            if key in weights.inner:
                ends, inner = weights.ends[key][settings], weights.inner[key][settings]
                columns = (ends.reshape(-1, ends.shape[2]) @ runs).reshape(*ends.shape[:2], -1)
                yield columns, inner @ columns

    def gram(self, weights: Weights, settings: slice = slice(None)) -> Float[np.ndarray, "s r r"]:
        """Return TᵀΣ⁻¹T for the selected parameter sets (s, r, r)."""
        gram = (weights.inverse[settings] @ self._node_table).reshape(-1, self.width, self.width)
        pairs = [*self._multiply_ends(weights, settings)]
        if pairs:
            left, right = (
                np.concatenate([a.reshape(len(a), -1, self.width) for a in arrays], axis=1)
                for arrays in zip(*pairs, strict=True)
            )
            gram += left.transpose(0, 2, 1) @ right
        return gram

    def traces(self, weights: Weights, e: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "s"]:
        """Return tr(E·TᵀΣ⁻¹T) for all parameter sets (s,), E a symmetric matrix (r, r)."""
        traces = weights.inverse @ (self._node_table @ e.ravel())
        for columns, weighted in self._multiply_ends(weights, slice(None)):
            product = columns.reshape(*columns.shape[:2], -1, self.width) @ e
            traces = traces + np.sum(weighted * product.reshape(weighted.shape), axis=(1, 2))
        return traces


def _list_segments(n: int) -> Iterator[Segment]:
    """Yield segments of a run's frequencies: the 16 lowest, each a node, then one per factor of 30 in λ."""
    lam, start = compute_eigenvalues(n, np.arange(n)), 0
    while start < n:
        if start == 0:
            stop = min(LOWEST_NODE_COUNT, n)
        else:
            stop = max(start + 1, int(np.searchsorted(lam, lam[start] * SEGMENT_RATIO)))
            stop = n if stop > 0.8 * n else stop
        rows, frequencies = slice(start, stop), np.arange(start, stop)
        if start == 0 or len(frequencies) <= SEGMENT_NODES + 2:
            yield Segment(rows, frequencies, np.eye(len(frequencies)))
        else:
            x = np.log(lam[rows])
            nodes, lagrange = lagrange_at_nodes(x[0], x[-1], SEGMENT_NODES, x)
            angle = np.arcsin(0.5 * np.exp(0.5 * nodes))
            yield Segment(rows, 2 * n / np.pi * angle, lagrange)
        start = stop


def _refine_segments(n: int, lines: Sequence[float]) -> Iterator[Segment]:
    """Yield segments of the frequencies 1 … n − 1 of a run, refined near narrow lines (frequency indices `lines`).

    A spectrum is singular near λ = 0 (random walk), λ = 4 (moving average) and narrow lines. Frequencies next to these
    points are nodes; others are interpolated at Chebyshev nodes in the logarithm of the distance.
    """
    singular_points = sorted({0, n, *(round(k) for k in lines if 0 < round(k) < n)})
    distances = [0, *_list_distances(n)]
    for low, high in itertools.pairwise(singular_points):
        midpoint = (high - low) // 2
        for point, sign, limit in ((low, 1, midpoint), (high, -1, high - low - midpoint)):
            bounds = [d for d in distances if d < limit] + [limit]
            for start, stop in itertools.pairwise(bounds):
                first, last = sorted((point + sign * start, point + sign * stop))
                first = max(first, 1)
                frequencies = np.arange(first, last)
                if start == 0 or len(frequencies) <= SEGMENT_NODES + 2:
                    yield Segment(slice(first, last), frequencies, np.eye(len(frequencies)))
                    continue
                x = np.log(np.abs(frequencies - point))
                nodes, lagrange = lagrange_at_nodes(x.min(), x.max(), SEGMENT_NODES, x)
                yield Segment(slice(first, last), point + sign * np.exp(nodes), lagrange)


def _list_distances(n: int) -> Iterator[int]:
    """Yield the distances from a singular point at which frequency segments begin, in frequency indices."""
    distance: float = LOWEST_NODE_COUNT
    while distance < n:
        yield round(distance)
        distance *= FINE_RATIO


def _assemble_blocks(blocks: Sequence[Any], count: int) -> Float[np.ndarray, "s q q"]:
    """Assemble blocks (k, k, s) into block-diagonal matrices (s, q, q)."""
    size, start = sum(map(len, blocks)), 0
    matrices = np.zeros((count, size, size))
    for block in blocks:
        stop = start + len(block)
        matrices[:, start:stop, start:stop], start = np.moveaxis(block, -1, 0), stop
    return matrices


class EvenSpectrum:
    """Restricted likelihood of stationary noise laws on evenly sampled runs, with levels and columns integrated out.

    The frequency k = 0 is omitted, which marginalises the level of each run under a flat prior.

    Attributes:
        step: sampling interval, s.
    """

    def __init__(
        self, runs: Sequence[Float[np.ndarray, "n r"]], step: float, lines: Sequence[float] = ()
    ) -> None:
        """Transform each run's columns, the last of which is the output; `lines`: frequencies of narrow lines, Hz."""

        def segments(n: int) -> Iterator[Segment]:
            return _refine_segments(n, [2 * f * step * n for f in lines])

        self.step, self._width = step, runs[0].shape[1]
        rows = np.split(np.arange(sum(map(len, runs))), np.cumsum([*map(len, runs)])[:-1])
        self._nodes = DCTNodes(rows, step, segments)
        self._products = Products.from_columns(self._nodes, np.concatenate(runs))

    def log_likelihood(self, law: Noise, values: Values) -> Float[np.ndarray, "s"]:
        """Return the restricted log likelihood of a stationary law for s parameter sets (s,), up to a constant."""
        parameters = {name: np.reshape(np.asarray(v, float), -1) for name, v in values.items()}
        chunk = max(1, MAX_ELEMENTS // (12 * self._nodes.count))
        chunks = [slice(start, start + chunk) for start in range(0, len(parameters[WHITE]), chunk)]
        with np.errstate(all="ignore"):
            parts = [self._evaluate(law, {n: v[c] for n, v in parameters.items()}) for c in chunks]
        return np.concatenate(parts)

    def regress(self, law: Noise, values: Values) -> Float[np.ndarray, "k"]:
        """Regress the output on the other columns by generalised least squares under a law with one parameter set."""
        gram = self._products.gram(self._nodes.weights(law, values))[0]
        return np.linalg.solve(gram[:-1, :-1], gram[:-1, -1])

    def _evaluate(self, law: Noise, values: Values) -> Float[np.ndarray, "s"]:
        weights = self._nodes.weights(law, values)
        gram, log_det = self._products.gram(weights), weights.log_det
        rss = gram[:, -1, -1]
        if self._width > 1:
            inner, cross = gram[:, :-1, :-1], gram[:, :-1, -1:]
            inner = np.where(np.isfinite(inner), inner, np.eye(self._width - 1))
            log_det = log_det + np.linalg.slogdet(inner)[1]
            rss = rss - (cross.swapaxes(1, 2) @ np.linalg.solve(inner, cross))[:, 0, 0]
        return -0.5 * (log_det + rss)
