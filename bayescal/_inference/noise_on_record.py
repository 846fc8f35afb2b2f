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
from bayescal._model.noise_law import LOG_2PI, Noise, log_density_beside, widened

Values = Mapping[str, Any]  # φ by name, one number each
Each = Mapping[str, Any]  # φ by name, one number a draw, or one for all
WIDTH = 8  # columns that a table is padded to at least, else to twice as many, and so on
CELLS = 2_000_000  # numbers in the tables of several draws that are held at once
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
        """L⁻¹ times a table; row i belongs to reading i."""
        return self.both(table)[0]

    def both(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "n m"], float]:
        """L⁻¹ times a table, and log|Σ|."""
        ((made, logdet),) = _filtered([(self, table)])
        return _back(self.law, self.record, made), logdet


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
    left: Float[np.ndarray, "n"] | None = None,
) -> Whitening | Independent:
    """What makes readings independent and of unit variance under a law at its parameters, φ by name.

    Under a law that is not Gaussian each has the precision that it shows by what the expected output has `left` of it
    (Gaussian scale mixture); None whitens by the variance.
    """
    if not law.independent:
        return Whitening(law, values, record, extra)
    if law.gaussian or left is None:
        return Independent(np.sqrt(variance(law, values, record) + extra))
    terms = density_terms(law, values, record, left, extra)
    # Under a scale mixture a reading with the residual e has the expected precision −f′(e)/e (K. Lange, R. Little and
    # J. Taylor, JASA 84 (1989) 881): what lowers the weighted squares lowers −2·log density too.
    weight = np.maximum(terms.weight(left), np.finfo(float).tiny)
    total = terms.squares + terms.logdet
    logdet = -float(np.sum(np.log(weight)))
    # `beyond` is what makes squares, log volume and itself −2·log density whatever the weights are.
    return Independent(1 / np.sqrt(weight), total - logdet - float(left @ (weight * left)))


def _forth(law: Noise, record: Record, array: np.ndarray, axis: int) -> np.ndarray:
    """What belongs to readings, in the order in which a law takes these."""
    if law.independent or record.ordered:
        return array
    return np.take(array, record.in_time[0], axis=axis)


def _back(law: Noise, record: Record, array: Float[np.ndarray, "n ..."]) -> np.ndarray:
    """The other way round."""
    if law.independent or record.ordered:
        return array
    found = np.empty_like(array)
    found[record.in_time[0]] = array
    return found


def _padded(law: Noise, record: Record, table: np.ndarray) -> np.ndarray:
    """A table as a law takes it, with rows and columns of zeros up to the padded numbers."""
    n, m = table.shape
    found = np.zeros((record.padded_size, _width(table)))
    found[:n, :m] = _forth(law, record, table, 0)
    return found


def _width(table: np.ndarray) -> int:
    """The padded number of columns."""
    width = WIDTH
    while width < table.shape[1]:
        width *= 2
    return width


@program
def _whitened(law: Noise, frame: Frame, tables, extras, values):
    """Tables, or one table under several settings, and the log standard deviations of their innovations."""
    each = 0 if tables.ndim == 3 else None
    return jax.vmap(lambda *one: law.whiten(*one, frame), (each, 0, 0))(tables, extras, values)


def products_of_several(
    pairs: Iterable[tuple[Whitening | Independent, Float[np.ndarray, "n m"]]],
) -> Iterator[tuple[Float[np.ndarray, "m m"], float]]:
    """Yield the products of each whitened table with itself, and log|Σ|; tables of one law.

    By a filter of several states some at once, as in `_densities`.
    """
    for _, group in groupby(pairs, lambda pair: _width(pair[1])):
        for white, table in (alike := iter(group)):
            if isinstance(white, Independent):
                made, logdet = white.both(table)
                yield made.T @ made, logdet
                continue
            part: list[Any] = [(white, table)]
            if white.law.several_states and FEWEST_DRAWS_TOGETHER * table.size <= CELLS:
                part += islice(alike, FEWEST_DRAWS_TOGETHER - 1)
            yield from ((made.T @ made, logdet) for made, logdet in _filtered(part))


def _filtered(part: list[tuple[Whitening, np.ndarray]]) -> Iterator[tuple[np.ndarray, float]]:
    """Each whitened table in the order in which the law takes readings, and log|Σ|, of tables of one width."""
    (white, first), record = part[0], part[0][0].record
    # Of one setting or of so many: two programs to compile.
    more = FEWEST_DRAWS_TOGETHER - len(part) if len(part) > 1 else 0
    law, each = white.law, part + part[-1:] * more
    one = all(table is first for _, table in part)
    tables = [_padded(law, record, table) for _, table in (part[:1] if one else each)]
    extras = [np.asarray(w.extra, float) for w, _ in each]
    if np.ndim(white.extra):
        extras = [record.longer(_forth(law, record, extra, 0)) for extra in extras]
    values = {n: np.array([float(w.values[n]) for w, _ in each]) for n in law.parameters()}
    found = tables[0] if one else np.stack(tables), np.stack(extras), values
    made, log_sd = map(np.asarray, _whitened(*record.for_law(law), *found))
    for (_, table), own, each_sd in zip(part, made, log_sd, strict=False):
        yield own[: record.size, : table.shape[1]], 2.0 * float(np.sum(each_sd[: record.size]))


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
        """What stands for the sum of squares of whitened residuals: twice what the log density lost to them."""
        return 2 * np.sum(self.highest - self.log_density, axis=-1)

    @property
    def logdet(self) -> Any:
        """What stands for log|Σ|."""
        return -2 * np.sum(self.highest, axis=-1) - self.highest.shape[-1] * LOG_2PI

    def weight(self, left: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """The precision of each reading; at no residual its limit, the curvature."""
        near = np.abs(left) < 1e-12 * np.max(np.abs(left), axis=-1, keepdims=True, initial=0.0)
        made = np.where(near, self.curvature, self.slope / np.where(near, 1.0, left))
        return np.maximum(made, 0.0)


def density_terms(
    law: Noise, values: Values, record: Record, left: Float[np.ndarray, "*b n"], extra: Any = 0.0
) -> Terms:
    """Of what the expected output leaves of the readings, independent of each other given it; at one φ or at several
    (values (b,) each). `extra`: variance of each reading beside the law's, or a single zero."""
    beside = None if not np.ndim(extra) else np.asarray(extra)
    frame, own = widened(record.frame, beside), {n: _row(values[n]) for n in law.parameters()}
    if (known := law.by_residual(left, own, frame)) is not None:
        density, highest = (law.log_density(e, 0.0 * e, own, frame) for e in (left, 0.0 * left))
        return Terms(density, highest, *known)
    h = RESIDUAL_DIFFERENCE * np.sqrt(np.asarray(law.variance(own, frame)))
    ends = np.stack([left - h, left, left + h, 0.0 * left])
    low, here, high, highest = np.asarray(law.log_density(record.y, record.y - ends, own, frame))
    return Terms(here, highest, (low - high) / (2 * h), (2 * here - low - high) / h**2)


@program
def _densities(law: Noise, frame: Frame, y, left, extra, values):
    def of(one):
        left, extra, own = one
        return log_density_beside(law, y, y - left, extra, own, frame)

    # A step of several states is a few small products, which do for several settings at once.
    some = FEWEST_DRAWS_TOGETHER if law.several_states else None
    return jax.lax.map(of, (left, extra, values), batch_size=some)


@partial(program, costly=True)  # a random number costs as much as hundreds of sums
def _samples(law: Noise, frame: Frame, means, keys, values):
    def one(given):
        mean, key, own = given
        return law.sample(jax.random.wrap_key_data(key), mean, own, frame)

    return jax.lax.map(one, (means, keys, values))


def variance(law: Noise, values: Values, record: Record) -> Float[np.ndarray, "n"]:
    """Of each reading about the expected output, output unit squared."""
    if law.even(record.frame):
        return np.full(record.size, float(law.shared_variance(values)))
    return variances(law, values, record)[0]


def variances(law: Noise, hyper: Each, record: Record) -> Float[np.ndarray, "b n"]:
    """The same for several draws."""
    own = {n: _row(np.atleast_1d(hyper[n])) for n in law.parameters()}
    found = np.asarray(law.variance(own, record.frame))
    return np.broadcast_to(found, (*np.broadcast_shapes(found.shape[:-1], (1,)), record.size))


def log_densities(
    law: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Each, extra: Any = 0.0
) -> Float[np.ndarray, "b n"]:
    """Log density of each reading, given those before it, at what the expected output leaves of it in each draw;
    `extra`: variance of each reading beside the law's (b, n), or a single zero."""
    if law.independent:
        return _on_host(law, record, left, hyper, extra)
    y = record.longer(_forth(law, record, record.y, 0))
    beside = extra if np.ndim(extra) else None
    return _by_draws(_densities, law, record, hyper, left, beside, fixed=(y,))


def _row(values: Any) -> Any:
    """One number a draw as a column, beside readings in a row."""
    values = np.asarray(values, float)
    return values[..., None] if values.ndim else values


def _on_host(
    law: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Each, extra: Any
) -> Float[np.ndarray, "b n"]:
    """`log_densities` of independent readings, without a program."""
    if law.gaussian:
        variance = variances(law, hyper, record) + extra
        return -0.5 * (left**2 / variance + np.log(variance) + LOG_2PI)
    frame = widened(record.frame, np.asarray(extra) if np.ndim(extra) else None)
    own = {n: _row(np.atleast_1d(hyper[n])) for n in law.parameters()}
    return np.asarray(law.log_density(record.y, record.y - left, own, frame))


def samples(
    law: Noise, record: Record, means: Float[np.ndarray, "b n"], hyper: Each, seed: int
) -> Float[np.ndarray, "b n"]:
    """Readings drawn about expected outputs."""
    if law.independent and law.gaussian:
        normal = np.random.default_rng(seed).standard_normal(means.shape)
        return means + np.sqrt(variances(law, hyper, record)) * normal
    # A key does not hang on the number of keys: one program makes those of most numbers of draws.
    count = -(-len(means) // KEYS_TOGETHER) * KEYS_TOGETHER
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(seed), count)))
    return _by_draws(_samples, law, record, hyper, means, plain=(keys[: len(means)],))


def normal_scores(
    law: Noise, values: Values, record: Record, left: Float[np.ndarray, "n"], extra: Any = 0.0
) -> Float[np.ndarray, "n"]:
    """What is left of readings as independent standard normal numbers, if the law, which is not Gaussian, is right."""
    frame = record.frame if law.independent else record.frame.in_time()
    beside = _forth(law, record, np.asarray(extra), 0) if np.ndim(extra) else None
    found = law.normal_scores(_forth(law, record, left, 0), values, widened(frame, beside))
    return _back(law, record, np.asarray(found))


def _by_draws(
    what, law: Noise, record: Record, hyper: Each, *arrays, fixed: tuple = (), plain: tuple = ()
) -> Float[np.ndarray, "b n"]:
    """A program of several draws, some at once; the last draw stands in for missing ones."""
    names = list(law.parameters())
    there = [a for a in arrays if a is not None]
    count = max([*(np.size(hyper[n]) for n in names), *map(len, there), 1])
    own = {n: np.broadcast_to(np.asarray(hyper[n], float), (count,)) for n in names}
    arrays = tuple(a if a is None else _forth(law, record, np.asarray(a), 1) for a in arrays)
    found = np.empty((record.size, count))
    # One, eight or many at once: three lengths, so that no program is compiled for each number of draws.
    most = max(1, CELLS // record.padded_size)
    few = count <= 8 * FEWEST_DRAWS_TOGETHER
    together = 1 if count == 1 else FEWEST_DRAWS_TOGETHER if few else min(256, most)
    for start in range(0, count, together):
        pick = np.minimum(start + np.arange(together), count - 1)
        some: list[Any] = [
            a if a is None else record.longer(a[pick if len(a) > 1 else 0 * pick]) for a in arrays
        ]
        some += [p[pick] for p in plain]
        values = {n: v[pick] for n, v in own.items()}
        made = np.asarray(what(*record.for_law(law), *fixed, *some, values))
        stop = min(start + together, count)
        found[:, start:stop] = made[: stop - start, : record.size].T
    return _back(law, record, found).T


def total_log_density(
    law: Noise, record: Record, left: Float[np.ndarray, "b n"], hyper: Each, extra: Any = 0.0
) -> Float[np.ndarray, "b"]:
    """The sum of `log_densities` over readings; what is left may be one for all draws (1, n)."""
    names = list(law.parameters())
    count = max([*(np.size(hyper[n]) for n in names), len(left)])
    own, found = {n: np.broadcast_to(hyper[n], (count,)) for n in names}, []
    for some in np.array_split(np.arange(count), -(-count * record.size // CELLS)):
        beside = extra[some] if np.ndim(extra) else extra
        here, values = left[some] if len(left) > 1 else left, {n: v[some] for n, v in own.items()}
        found.append(log_densities(law, record, here, values, beside).sum(axis=1))
    return np.concatenate(found)
