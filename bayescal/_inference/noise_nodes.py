"""Products of evenly spaced runs at nodes of frequency: the likelihood of every stationary law without its readings.

After a cosine transform of each run a covariance is Σ(θ) = D(θ) − U·M·Uᵀ (`noise_spectrum`), D a smooth function of
λ = 2 − 2·cos(πk/n). With ℓ_c Lagrange's polynomials at nodes λ_c, 1/D(λ) = Σ_c ℓ_c(λ)/D(λ_c), so that, made once,

    B_c = Σ_k ℓ_c(λ_k)·t_k·t_kᵀ,   n_c = Σ_k ℓ_c(λ_k),

give TᵀΣ(θ)⁻¹T = Σ_c B_c/D(λ_c) and log|Σ(θ)| = Σ_c n_c·log D(λ_c), both with the ends of runs, for every θ. A level of
each run under a flat prior is an infinite D at k = 0, which is left out: this is the restricted likelihood.

D has singular points near λ = 0 (a random walk), λ = 4 (averages of neighbours) and narrow lines. Around each of them
single frequencies are nodes, then Chebyshev's points in the logarithm of the distance, to a half decade.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import dct

from bayescal._inference.chebyshev import lagrange, points
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import eigenvalues, end_transform
from bayescal._model.summed_noise import SumOfTerms

SINGLE_FREQUENCIES = 16  # on either side of a singular point, each a node of its own
SEGMENT_RATIO = (
    10**0.5
)  # of distances from a singular point from end to end of a segment of the others,
SEGMENT_NODES = 12  # which has so many nodes
CHUNK_NUMBERS = 2_000_000  # of what is computed at once for several settings
SIGNS = (1, -1)  # of the two combinations of a run's ends


class EqualRuns(NamedTuple):
    """Runs of one length.

    Attributes:
        length, count: readings in each; how many runs.
        nodes: their place among all nodes.
        end_squares: of the transform of e± at the nodes (2, i).
        ends: products of e± with the columns of each run (2, u, i, r).
    """

    length: int
    count: int
    nodes: slice
    end_squares: Float[np.ndarray, "2 i"]
    ends: Float[np.ndarray, "2 u i r"]


class EvenSpectrum:
    """Columns of runs of even steps, as products at nodes of frequency.

    Attributes:
        step: between readings, s.
        lam: λ of each node (j,).
    """

    def __init__(
        self, runs: Sequence[Float[np.ndarray, "n r"]], step: float, lines: Sequence[float] = ()
    ) -> None:
        """Transform the runs.

        Args:
            runs: columns of each; the last column is the output, others are taken out under a flat prior.
            step: between readings, s.
            lines: frequencies of narrow lines, Hz.
        """
        self.step, self.groups = step, list[EqualRuns]()
        lam, rows, products = [], [], []
        self.width = runs[0].shape[1]
        for n in sorted({len(run) for run in runs}):
            own = np.stack([np.asarray(dct(r, axis=0, norm="ortho")) for r in runs if len(r) == n])
            e = np.stack([end_transform(n, sign) for sign in SIGNS])
            squares, ends, first = [], [], sum(map(len, lam))
            for part, places, share in _segments(n, [2 * f * step * n for f in lines]):
                t = own[:, part]
                lam.append(eigenvalues(n, places))
                rows.append(len(own) * share.sum(axis=0))
                pairs = np.einsum("ukr,uks->krs", t, t).reshape(t.shape[1], -1)
                products.append(share.T @ pairs)
                squares.append(e[:, part] ** 2 @ share)
                ends.append(np.einsum("kc,ek,ukr->eucr", share, e[:, part], t, optimize=True))
            here = slice(first, sum(map(len, lam)))
            made = np.concatenate(squares, axis=1), np.concatenate(ends, axis=2)
            self.groups.append(EqualRuns(n, len(own), here, *made))
        self.lam, self.rows = np.concatenate(lam), np.concatenate(rows)
        self._products = np.concatenate(products)

    def log_likelihood(self, law: SumOfTerms, values: Mapping[str, Any]) -> Float[np.ndarray, "s"]:
        """Return the restricted log likelihood of a law at s settings, but for a constant.

        Args:
            law: stationary.
            values: its parameters by name (s,).
        """
        own = {name: np.reshape(np.asarray(v, float), (-1, 1)) for name, v in values.items()}
        count = len(own[WHITE])
        each = max(1, CHUNK_NUMBERS // (12 * len(self.lam)))
        chunks = [slice(at, at + each) for at in range(0, count, each)]
        with np.errstate(all="ignore"):
            found = [self._of_chunk(law, {n: v[c] for n, v in own.items()}) for c in chunks]
        return np.concatenate(found)

    def _of_chunk(
        self, law: SumOfTerms, values: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "s"]:
        terms = law.spectrum(values, self.step, self.lam)
        diagonal = values[WHITE] ** 2 + sum((t.symbol for t in terms), np.zeros_like(self.lam))
        inverse, count = 1 / diagonal, len(diagonal)
        log_det = np.log(diagonal) @ self.rows
        gram = (inverse @ self._products).reshape(count, self.width, self.width)
        functions = [np.broadcast_to(u, diagonal.shape) for t in terms for u in t.ends]
        u = np.stack(functions, axis=1) if functions else np.zeros((count, 0, len(self.lam)))
        whitened = u * inverse[:, None]
        for group, (k, sign) in itertools.product(self.groups, enumerate(SIGNS) if terms else ()):
            m = _block_diagonal([t.correction(group.length, sign) for t in terms], count)
            here = whitened[:, :, group.nodes]
            z = (here * group.end_squares[k]) @ u[:, :, group.nodes].transpose(0, 2, 1)
            core = np.eye(u.shape[1]) - m @ z
            positive, log_core = np.linalg.slogdet(core)
            log_det = log_det + group.count * np.where(positive > 0, log_core, np.inf)
            inner = np.linalg.solve(np.where(np.isfinite(core), core, np.eye(len(core[0]))), m)
            at_ends = here[:, None] @ group.ends[k]  # (s, runs, q, r)
            gram = gram + np.sum(at_ends.swapaxes(2, 3) @ (inner[:, None] @ at_ends), axis=1)
        rss = gram[:, -1, -1]
        if self.width > 1:
            known, cross = gram[:, :-1, :-1], gram[:, :-1, -1:]
            known = np.where(np.isfinite(known), known, np.eye(self.width - 1))
            log_det = log_det + np.linalg.slogdet(known)[1]
            rss = rss - (cross.swapaxes(1, 2) @ np.linalg.solve(known, cross))[:, 0, 0]
        return -0.5 * (log_det + rss)


def _block_diagonal(parts: Sequence[Any], count: int) -> Float[np.ndarray, "s q q"]:
    """Return blocks (k, k, s) along the diagonal."""
    size, at = sum(map(len, parts)), 0
    found = np.zeros((count, size, size))
    for part in parts:
        k = at + len(part)
        found[:, at:k, at:k], at = np.moveaxis(part, -1, 0), k
    return found


def _segments(
    n: int, lines: Sequence[float]
) -> Iterator[tuple[slice, Float[np.ndarray, "c"], Float[np.ndarray, "k c"]]]:
    """Cut the frequencies 1 … n − 1 of a run into segments: which; places of nodes; Lagrange's polynomials there."""
    singular = sorted({0, n, *(round(k) for k in lines if 0 < round(k) < n)})
    graded = [0, *_graded(n)]
    for low, high in itertools.pairwise(singular):
        half = (high - low) // 2
        for point, sign, length in ((low, 1, half), (high, -1, high - low - half)):
            cuts = [d for d in graded if d < length] + [length]
            for near, far in itertools.pairwise(cuts):
                begin, end = sorted((point + sign * near, point + sign * far))
                begin = max(begin, 1)
                places = np.arange(begin, end)
                if near == 0 or len(places) <= SEGMENT_NODES + 2:
                    yield slice(begin, end), places, np.eye(len(places))
                    continue
                x = np.log(np.abs(places - point))
                middle, reach = 0.5 * (x.min() + x.max()), 0.5 * np.ptp(x)
                nodes = point + sign * np.exp(middle + reach * points(SEGMENT_NODES))
                yield slice(begin, end), nodes, lagrange((x - middle) / reach, SEGMENT_NODES)


def _graded(n: int) -> Iterator[int]:
    """Yield distances from a singular point at which segments begin."""
    distance: float = SINGLE_FREQUENCIES
    while distance < n:
        yield round(distance)
        distance *= SEGMENT_RATIO
