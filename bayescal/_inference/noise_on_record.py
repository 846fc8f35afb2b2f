"""A noise law's own functions on a record, as compiled programs: arrays in, NumPy's arrays out.

A program is compiled for a law without its priors, a padded number of readings and a padded number of columns, and
knows nothing of a structure. Readings that pad a record are runs of their own whose rows are zero: they whiten to zero,
and their share of a log determinant or density is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from itertools import groupby, islice
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import jax
from bayescal._inference.programs import program
from bayescal._inference.record import Record
from bayescal._model.frame import Frame
from bayescal._model.noise_law import LOG_2PI, Noise, add_variance, log_density_with_extra

Values = Mapping[str, Any]  # φ by name, one number each
Batch = Mapping[str, Any]  # φ by name, one number a draw, or one for all
MIN_TABLE_COLUMNS = 8  # columns that a table is padded to, else to twice as many, and so on
MAX_CELLS = 2_000_000  # numbers in the tables of several draws that are held at once
FEWEST_DRAWS_TOGETHER = 8  # draws that are worked out together where there are few
RESIDUAL_DIFFERENCE = 1e-4  # of a reading's standard deviation
KEYS_TOGETHER = 4096  # of draws, made by one program


class Whitening(NamedTuple):
    """L⁻¹ of LLᵀ = Σ, at one φ."""

    law: Noise
    values: Values  # its parameters
    record: Record
    extra: Float[np.ndarray, "n"] | float = 0.0  # variance of each reading beside the law's

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Return L⁻¹ times a table; row i belongs to reading i."""
        return self.both(table)[0]

    def both(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "n m"], float]:
        """Return L⁻¹ times a table, and log|Σ|."""
        ((white, logdet),) = _filtered([(self, table)])
        return _back(self.law, self.record, white), logdet


class Independent(NamedTuple):
    """The same where readings are independent of each other and their standard deviations known."""

    sd: Float[np.ndarray, "n"]
    beyond: float = 0.0  # what a law that is not Gaussian counts beside the squares

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        return table / self.sd[:, None]

    def both(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "n m"], float]:
        return self(table), 2.0 * float(np.sum(np.log(self.sd)))


def whitening(
    law: Noise,
    values: Values,
    record: Record,
    extra: Float[np.ndarray, "n"] | float = 0.0,
    residual: Float[np.ndarray, "n"] | None = None,
) -> Whitening | Independent:
    """Return what makes readings independent and of unit variance under a law at its parameters.

    Under a non-Gaussian law each has the precision of its `residual` (scale mixture); None whitens by the variance.
    """
    if not law.independent:
        return Whitening(law, values, record, extra)
    if law.gaussian or residual is None:
        return Independent(np.sqrt(variance(law, values, record) + extra))
    terms = density_terms(law, values, record, residual, extra)
    # Under a scale mixture a reading with the residual e has the expected precision −f′(e)/e (K. Lange, R. Little and
    # J. Taylor, JASA 84 (1989) 881): what lowers the weighted squares lowers −2·log density too.
    weight = np.maximum(terms.weight(residual), np.finfo(float).tiny)
    total = terms.squares + terms.logdet
    logdet = -float(np.sum(np.log(weight)))
    # `beyond` is what makes squares, log volume and itself −2·log density whatever the weights are.
    return Independent(1 / np.sqrt(weight), total - logdet - float(residual @ (weight * residual)))


def _forth(law: Noise, record: Record, array: np.ndarray, axis: int) -> np.ndarray:
    """Return an array of readings in the order in which a law takes these."""
    if law.independent or record.ordered:
        return array
    return np.take(array, record.in_time[0], axis=axis)


def _back(law: Noise, record: Record, array: Float[np.ndarray, "n ..."]) -> np.ndarray:
    """Return an array in a law's order in that of the readings."""
    if law.independent or record.ordered:
        return array
    ordered = np.empty_like(array)
    ordered[record.in_time[0]] = array
    return ordered


def _padded(law: Noise, record: Record, table: np.ndarray) -> np.ndarray:
    """Return a table in a law's order, padded with rows and columns of zeros."""
    n, m = table.shape
    padded = np.zeros((record.padded_size, _width(table)))
    padded[:n, :m] = _forth(law, record, table, 0)
    return padded


def _width(table: np.ndarray) -> int:
    """Return the padded number of columns."""
    width = MIN_TABLE_COLUMNS
    while width < table.shape[1]:
        width *= 2
    return width


@program
def _whitened(law: Noise, frame: Frame, tables, extras, values):
    """Whiten tables, or one table under several settings; return log sds of innovations too."""
    axis = 0 if tables.ndim == 3 else None
    return jax.vmap(lambda *args: law.whiten(*args, frame), (axis, 0, 0))(tables, extras, values)


def products_of_several(
    pairs: Iterable[tuple[Whitening | Independent, Float[np.ndarray, "n m"]]],
) -> Iterator[tuple[Float[np.ndarray, "m m"], float]]:
    """Yield the products of each whitened table with itself, and log|Σ|; tables of one law.

    By a filter of several states some at once, as in `_densities`.
    """
    for _, group in groupby(pairs, lambda pair: _width(pair[1])):
        for white, table in (members := iter(group)):
            if isinstance(white, Independent):
                whitened, logdet = white.both(table)
                yield whitened.T @ whitened, logdet
                continue
            part: list[Any] = [(white, table)]
            if white.law.several_states and FEWEST_DRAWS_TOGETHER * table.size <= MAX_CELLS:
                part += islice(members, FEWEST_DRAWS_TOGETHER - 1)
            yield from ((whitened.T @ whitened, logdet) for whitened, logdet in _filtered(part))


def _filtered(part: list[tuple[Whitening, np.ndarray]]) -> Iterator[tuple[np.ndarray, float]]:
    """Yield each whitened table in the law's order, and log|Σ|, of tables of one width."""
    (white, first), record = part[0], part[0][0].record
    # Of one setting or of so many: two programs to compile.
    padding = FEWEST_DRAWS_TOGETHER - len(part) if len(part) > 1 else 0
    law, pairs = white.law, part + part[-1:] * padding
    is_one = all(table is first for _, table in part)
    tables = [_padded(law, record, table) for _, table in (part[:1] if is_one else pairs)]
    extras = [np.asarray(w.extra, float) for w, _ in pairs]
    if np.ndim(white.extra):
        extras = [record.longer(_forth(law, record, extra, 0)) for extra in extras]
    values = {n: np.array([float(w.values[n]) for w, _ in pairs]) for n in law.parameters()}
    args = tables[0] if is_one else np.stack(tables), np.stack(extras), values
    whitened, log_sd = map(np.asarray, _whitened(*record.for_law(law), *args))
    for (_, table), result, each_sd in zip(part, whitened, log_sd, strict=False):
        yield result[: record.size, : table.shape[1]], 2.0 * float(np.sum(each_sd[: record.size]))


class Terms(NamedTuple):
    """The log density of readings under independent noise, with its derivatives by what is left of each reading.

    As a Gaussian scale mixture a reading has the precision `weight` = −slope/left; `curvature`, −∂²/∂left², may be
    less, and negative for an outlier.
    """

    log_density: Float[np.ndarray, "*b n"]
    highest: Float[np.ndarray, "*b n"]  # log density where nothing is left of a reading
    slope: Float[np.ndarray, "*b n"]  # −∂/∂left: what pulls the expected output toward the reading
    curvature: Float[np.ndarray, "*b n"]

    @property
    def squares(self) -> Any:
        """Return what stands for the sum of squares of whitened residuals: twice the lost log density."""
        return 2 * np.sum(self.highest - self.log_density, axis=-1)

    @property
    def logdet(self) -> Any:
        """Return what stands for log|Σ|."""
        return -2 * np.sum(self.highest, axis=-1) - self.highest.shape[-1] * LOG_2PI

    def weight(self, residual: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the precision of each reading; at no residual its limit, the curvature."""
        size = np.abs(residual)
        near = size < 1e-12 * np.max(size, axis=-1, keepdims=True, initial=0.0)
        weight = np.where(near, self.curvature, self.slope / np.where(near, 1.0, residual))
        return np.maximum(weight, 0.0)


def density_terms(
    law: Noise, values: Values, record: Record, r: Float[np.ndarray, "*b n"], extra: Any = 0.0
) -> Terms:
    """Return log density terms of independent residuals, at one φ or several (values (b,) each).

    `extra`: variance of each reading beside the law's, or a single zero.
    """
    variance = None if not np.ndim(extra) else np.asarray(extra)
    frame = add_variance(record.frame, variance)
    phi = {n: _row(values[n]) for n in law.parameters()}
    if (slopes := law.by_residual(r, phi, frame)) is not None:
        density, highest = (law.log_density(e, 0.0 * e, phi, frame) for e in (r, 0.0 * r))
        return Terms(density, highest, *slopes)
    h = RESIDUAL_DIFFERENCE * np.sqrt(np.asarray(law.variance(phi, frame)))
    ends = np.stack([r - h, r, r + h, 0.0 * r])
    low, middle, high, highest = np.asarray(law.log_density(record.y, record.y - ends, phi, frame))
    return Terms(middle, highest, (low - high) / (2 * h), (2 * middle - low - high) / h**2)


@program
def _densities(law: Noise, frame: Frame, y, residuals, extra, values):
    def of(args):
        residual, extra, phi = args
        return log_density_with_extra(law, y, y - residual, extra, phi, frame)

    # A step of several states is a few small products, which do for several settings at once.
    some = FEWEST_DRAWS_TOGETHER if law.several_states else None
    return jax.lax.map(of, (residuals, extra, values), batch_size=some)


@partial(program, costly=True)  # a random number costs as much as hundreds of sums
def _samples(law: Noise, frame: Frame, means, keys, values):
    def draw(args):
        mean, key, phi = args
        return law.sample(jax.random.wrap_key_data(key), mean, phi, frame)

    return jax.lax.map(draw, (means, keys, values))


def variance(law: Noise, values: Values, record: Record) -> Float[np.ndarray, "n"]:
    """Return the variance of each reading about the expected output, output unit squared."""
    if law.even(record.frame):
        return np.full(record.size, float(law.shared_variance(values)))
    return variances(law, values, record)[0]


def variances(law: Noise, hyper: Batch, record: Record) -> Float[np.ndarray, "b n"]:
    """Return the variance of each reading for several draws, output unit squared."""
    phi = {n: _row(np.atleast_1d(hyper[n])) for n in law.parameters()}
    variance = np.asarray(law.variance(phi, record.frame))
    return np.broadcast_to(variance, (*np.broadcast_shapes(variance.shape[:-1], (1,)), record.size))


def log_densities(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any = 0.0
) -> Float[np.ndarray, "b n"]:
    """Return the log density of each reading's residual in each draw, given those before it.

    `extra`: variance of each reading beside the law's (b, n), or a single zero.
    """
    if law.independent:
        return _on_host(law, record, residuals, hyper, extra)
    y = record.longer(_forth(law, record, record.y, 0))
    variance = extra if np.ndim(extra) else None
    return _by_draws(_densities, law, record, hyper, residuals, variance, fixed=(y,))


def _row(values: Any) -> Any:
    """Return one number a draw as a column, beside readings in a row."""
    values = np.asarray(values, float)
    return values[..., None] if values.ndim else values


def _on_host(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any
) -> Float[np.ndarray, "b n"]:
    """Return `log_densities` of independent readings, without a program."""
    if law.gaussian:
        variance = variances(law, hyper, record) + extra
        return -0.5 * (residuals**2 / variance + np.log(variance) + LOG_2PI)
    frame = add_variance(record.frame, np.asarray(extra) if np.ndim(extra) else None)
    phi = {n: _row(np.atleast_1d(hyper[n])) for n in law.parameters()}
    return np.asarray(law.log_density(record.y, record.y - residuals, phi, frame))


def samples(
    law: Noise, record: Record, means: Float[np.ndarray, "b n"], hyper: Batch, seed: int
) -> Float[np.ndarray, "b n"]:
    """Draw readings about expected outputs."""
    if law.independent and law.gaussian:
        normal = np.random.default_rng(seed).standard_normal(means.shape)
        return means + np.sqrt(variances(law, hyper, record)) * normal
    # A key does not hang on the number of keys: one program makes those of most numbers of draws.
    count = -(-len(means) // KEYS_TOGETHER) * KEYS_TOGETHER
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(seed), count)))
    return _by_draws(_samples, law, record, hyper, means, plain=(keys[: len(means)],))


def normal_scores(
    law: Noise, values: Values, record: Record, residual: Float[np.ndarray, "n"], extra: Any = 0.0
) -> Float[np.ndarray, "n"]:
    """Return residuals as independent standard normal numbers, if the non-Gaussian law is right."""
    frame = record.frame if law.independent else record.frame.in_time()
    variance = _forth(law, record, np.asarray(extra), 0) if np.ndim(extra) else None
    frame = add_variance(frame, variance)
    scores = law.normal_scores(_forth(law, record, residual, 0), values, frame)
    return _back(law, record, np.asarray(scores))


def _by_draws(
    what, law: Noise, record: Record, hyper: Batch, *arrays, fixed: tuple = (), plain: tuple = ()
) -> Float[np.ndarray, "b n"]:
    """Run a program for several draws, some at once; the last draw stands in for missing ones."""
    names = list(law.parameters())
    present = [a for a in arrays if a is not None]
    count = max([*(np.size(hyper[n]) for n in names), *map(len, present), 1])
    phi = {n: np.broadcast_to(np.asarray(hyper[n], float), (count,)) for n in names}
    arrays = tuple(a if a is None else _forth(law, record, np.asarray(a), 1) for a in arrays)
    output = np.empty((record.size, count))
    # One, eight or many at once: three lengths, so that no program is compiled for each number of draws.
    most = max(1, MAX_CELLS // record.padded_size)
    few = count <= 8 * FEWEST_DRAWS_TOGETHER
    together = 1 if count == 1 else FEWEST_DRAWS_TOGETHER if few else min(256, most)
    for start in range(0, count, together):
        pick = np.minimum(start + np.arange(together), count - 1)
        some: list[Any] = [
            a if a is None else record.longer(a[pick if len(a) > 1 else 0 * pick]) for a in arrays
        ]
        some += [p[pick] for p in plain]
        values = {n: v[pick] for n, v in phi.items()}
        part = np.asarray(what(*record.for_law(law), *fixed, *some, values))
        stop = min(start + together, count)
        output[:, start:stop] = part[: stop - start, : record.size].T
    return _back(law, record, output).T


def total_log_density(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any = 0.0
) -> Float[np.ndarray, "b"]:
    """Return the sum of `log_densities` over readings; residuals may be one for all draws (1, n)."""
    names = list(law.parameters())
    count = max([*(np.size(hyper[n]) for n in names), len(residuals)])
    phi, totals = {n: np.broadcast_to(hyper[n], (count,)) for n in names}, []
    for some in np.array_split(np.arange(count), -(-count * record.size // MAX_CELLS)):
        variance = extra[some] if np.ndim(extra) else extra
        part = residuals[some] if len(residuals) > 1 else residuals
        values = {n: v[some] for n, v in phi.items()}
        totals.append(log_densities(law, record, part, values, variance).sum(axis=1))
    return np.concatenate(totals)
