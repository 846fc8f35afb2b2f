"""Whitening, log densities and draws of a noise law on a record, by compiled programs with NumPy input and output.

A program is compiled per law (without priors), padded number of readings and padded number of columns, independent of
the model. Padding readings are separate runs of zeros: they whiten to zero, and their log determinant or density is
discarded.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import jax
from bayescal._inference.programs import compile_on_call
from bayescal._inference.record import Record
from bayescal._model.frame import Frame
from bayescal._model.noise_law import LOG_2PI, Noise, add_variance, compute_log_density

Values = Mapping[str, Any]  # φ by name, one number each
Batch = Mapping[str, Any]  # φ by name, one number per draw, or one for all
MIN_TABLE_COLUMNS = 8  # of a padded table; doubled until sufficient
MAX_BATCH_ELEMENTS = 2_000_000  # array elements per batch
BATCH_DRAWS = 8  # draws of a small batch
DIFF_STEP_SD = 1e-4  # difference step of a residual, standard deviations of a reading
KEY_BATCH_SIZE = 4096  # PRNG keys generated at once


class Whitening(NamedTuple):
    """Whitening by L⁻¹, L the Cholesky factor of the noise covariance Σ = L·Lᵀ, at one φ."""

    law: Noise
    values: Values  # its parameters
    record: Record
    extra: Float[np.ndarray, "n"] | float = 0.0  # additional variance of each reading

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Return L⁻¹·table, with rows in the order of the readings."""
        return self.whiten(table)[0]

    def whiten(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "n m"], float]:
        """Return the whitened table L⁻¹·table, rows in the order of the readings, and log|Σ|."""
        whitened, logdet = self._whiten_in_time(table)
        return _unsort_rows(self.law, self.record, whitened), logdet

    def gram(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "m m"], float]:
        """Return the Gram matrix of the whitened table, and log|Σ|."""
        whitened, logdet = self._whiten_in_time(table)
        return whitened.T @ whitened, logdet

    def _whiten_in_time(self, table: Float[np.ndarray, "n m"]) -> tuple[np.ndarray, float]:
        """Return the whitened table, rows in time order for a correlated law, and log|Σ|."""
        law, record, (n, m) = self.law, self.record, table.shape
        width = MIN_TABLE_COLUMNS
        while width < m:
            width *= 2
        padded_table = np.zeros((record.padded_size, width))
        padded_table[:n, :m] = _sort_by_time(law, record, table, 0)
        added_variance = np.asarray(self.extra, float)
        if added_variance.ndim:
            added_variance = record.pad(_sort_by_time(law, record, added_variance, 0))
        values = {name: np.float64(self.values[name]) for name in law.parameters()}
        results = _run_whitening(*record.prepare_for_law(law), padded_table, added_variance, values)
        whitened, log_sd = map(np.asarray, results)
        return whitened[:n, :m], 2.0 * float(np.sum(log_sd[:n]))


class SdWhitening(NamedTuple):
    """Whitening of independent readings: division by their standard deviations."""

    sd: Float[np.ndarray, "n"]
    excess: float = 0.0  # −2·log density minus whitened squares minus log|Σ|; not 0 if not Gaussian

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        return table / self.sd[:, None]

    def whiten(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "n m"], float]:
        return self(table), 2.0 * float(np.sum(np.log(self.sd)))

    def gram(self, table: Float[np.ndarray, "n m"]) -> tuple[Float[np.ndarray, "m m"], float]:
        """Return the Gram matrix of the whitened table, and log|Σ|."""
        whitened, logdet = self.whiten(table)
        return whitened.T @ whitened, logdet


def whitening(
    law: Noise,
    values: Values,
    record: Record,
    added_variance: Float[np.ndarray, "n"] | float = 0.0,
    residual: Float[np.ndarray, "n"] | None = None,
) -> Whitening | SdWhitening:
    """Return the whitening of readings under a noise law at given parameters.

    Under a non-Gaussian law a reading's precision is that of the Gaussian scale mixture at its `residual`, or the
    inverse variance if `residual` is None. added_variance: additional variance of each reading.
    """
    if not law.independent:
        return Whitening(law, values, record, added_variance)
    if law.is_gaussian or residual is None:
        return SdWhitening(np.sqrt(variance(law, values, record) + added_variance))
    terms = density_terms(law, values, record, residual, added_variance)
    # Under a scale mixture of log density f a residual e has the expected precision −f′(e)/e (K. Lange, R. Little and
    # J. Taylor, JASA 84 (1989) 881): EM, so that reducing the weighted squares reduces −2·log density.
    weight = np.maximum(terms.weight(residual), np.finfo(float).tiny)
    total = terms.squares + terms.logdet
    logdet = -float(np.sum(np.log(weight)))
    return SdWhitening(1 / np.sqrt(weight), total - logdet - float(residual @ (weight * residual)))


def _sort_by_time(law: Noise, record: Record, array: np.ndarray, axis: int) -> np.ndarray:
    """Sort an array by time of the readings along an axis, if the noise law is correlated."""
    if law.independent or record.is_time_ordered:
        return array
    return np.take(array, record.time_order[0], axis=axis)


def _unsort_rows(law: Noise, record: Record, array: Float[np.ndarray, "n ..."]) -> np.ndarray:
    """Restore the order of the readings in an array sorted by time; inverse of `_sort_by_time`."""
    if law.independent or record.is_time_ordered:
        return array
    original_rows = np.empty_like(array)
    original_rows[record.time_order[0]] = array
    return original_rows


@compile_on_call
def _run_whitening(law: Noise, frame: Frame, table, extra, values):
    return law.whiten(table, extra, values, frame)


class DensityTerms(NamedTuple):
    """Log density of readings under independent noise, and its derivatives in the residual e of each reading.

    As a Gaussian scale mixture a reading has the precision slope/e (`weight`); `curvature` = −∂²/∂e² may be smaller,
    and is negative for an outlier.
    """

    log_density: Float[np.ndarray, "*b n"]
    highest: Float[np.ndarray, "*b n"]  # log density at zero residual
    slope: Float[np.ndarray, "*b n"]  # −∂/∂e
    curvature: Float[np.ndarray, "*b n"]

    @property
    def squares(self) -> Any:
        """Return the deviance: the equivalent of the whitened residual sum of squares."""
        return 2 * np.sum(self.highest - self.log_density, axis=-1)

    @property
    def logdet(self) -> Any:
        """Return −2·log density at zero residuals minus n·log 2π: the equivalent of log|Σ|."""
        return -2 * np.sum(self.highest, axis=-1) - self.highest.shape[-1] * LOG_2PI

    def weight(self, residual: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the scale-mixture precision of each reading; at zero residual its limit, the curvature."""
        magnitude = np.abs(residual)
        is_zero = magnitude < 1e-12 * np.max(magnitude, axis=-1, keepdims=True, initial=0.0)
        weight = np.where(is_zero, self.curvature, self.slope / np.where(is_zero, 1.0, residual))
        return np.maximum(weight, 0.0)


def density_terms(
    law: Noise, values: Values, record: Record, r: Float[np.ndarray, "*b n"], extra: Any = 0.0
) -> DensityTerms:
    """Return log density terms of independent residuals, at one φ or several (values (b,) each).

    `extra`: additional variance of each reading, or 0.
    """
    variance = None if not np.ndim(extra) else np.asarray(extra)
    frame = add_variance(record.frame, variance)
    phi = {n: _reshape_to_column(values[n]) for n in law.parameters()}
    if (slopes := law.by_residual(r, phi, frame)) is not None:
        density, highest = (law.log_density(e, 0.0 * e, phi, frame) for e in (r, 0.0 * r))
        return DensityTerms(density, highest, *slopes)
    h = DIFF_STEP_SD * np.sqrt(np.asarray(law.variance(phi, frame)))
    ends = np.stack([r - h, r, r + h, 0.0 * r])
    low, middle, high, highest = np.asarray(law.log_density(record.y, record.y - ends, phi, frame))
    return DensityTerms(middle, highest, (low - high) / (2 * h), (2 * middle - low - high) / h**2)


@compile_on_call
def _run_densities(law: Noise, frame: Frame, y, residuals, extra, values):
    def log_density(args):
        residual, extra, phi = args
        return compute_log_density(law, y, y - residual, extra, phi, frame)

    return jax.lax.map(log_density, (residuals, extra, values))


@partial(compile_on_call, is_costly=True)  # random numbers are expensive
def _draw_in_program(law: Noise, frame: Frame, means, keys, values):
    def draw(args):
        mean, key, phi = args
        return law.sample(jax.random.wrap_key_data(key), mean, phi, frame)

    return jax.lax.map(draw, (means, keys, values))


def variance(law: Noise, values: Values, record: Record) -> Float[np.ndarray, "n"]:
    """Return the variance of each reading about the expected output, output unit squared (n,)."""
    return variances(law, values, record)[0]


def variances(law: Noise, hyper: Batch, record: Record) -> Float[np.ndarray, "b n"]:
    """Return the variance of each reading for several draws of φ, output unit squared (b, n)."""
    phi = {n: _reshape_to_column(np.atleast_1d(hyper[n])) for n in law.parameters()}
    variance = np.asarray(law.variance(phi, record.frame))
    return np.broadcast_to(variance, (*np.broadcast_shapes(variance.shape[:-1], (1,)), record.size))


def log_densities(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any = 0.0
) -> Float[np.ndarray, "b n"]:
    """Return the log density of each reading in each draw, given the earlier readings of its run.

    `extra`: additional variance of each reading (b, n), or 0.
    """
    if law.independent:
        return _compute_log_densities(law, record, residuals, hyper, extra)
    y = record.pad(_sort_by_time(law, record, record.y, 0))
    variance = extra if np.ndim(extra) else None
    return _run_batches(_run_densities, law, record, hyper, residuals, variance, shared=(y,))


def _reshape_to_column(values: Any) -> Any:
    """Reshape one number per draw to a column, to broadcast against readings in rows."""
    values = np.asarray(values, float)
    return values[..., None] if values.ndim else values


def _compute_log_densities(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any
) -> Float[np.ndarray, "b n"]:
    """Return the log densities of independent readings, by NumPy."""
    if law.is_gaussian:
        variance = variances(law, hyper, record) + extra
        return -0.5 * (residuals**2 / variance + np.log(variance) + LOG_2PI)
    frame = add_variance(record.frame, np.asarray(extra) if np.ndim(extra) else None)
    phi = {n: _reshape_to_column(np.atleast_1d(hyper[n])) for n in law.parameters()}
    return np.asarray(law.log_density(record.y, record.y - residuals, phi, frame))


def draw_samples(
    law: Noise, record: Record, means: Float[np.ndarray, "b n"], hyper: Batch, seed: int
) -> Float[np.ndarray, "b n"]:
    """Draw readings (b, n) about expected outputs `means` (b, n), output unit, for b draws of φ."""
    if law.independent and law.is_gaussian:
        deviates = np.random.default_rng(seed).standard_normal(means.shape)
        return means + np.sqrt(variances(law, hyper, record)) * deviates
    # A key is independent of the number of keys: generate them in fixed batches, by one program.
    count = -(-len(means) // KEY_BATCH_SIZE) * KEY_BATCH_SIZE
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(seed), count)))
    return _run_batches(_draw_in_program, law, record, hyper, means, keys=(keys[: len(means)],))


def normal_scores(
    law: Noise, values: Values, record: Record, residual: Float[np.ndarray, "n"], extra: Any = 0.0
) -> Float[np.ndarray, "n"]:
    """Transform residuals to scores (n,) that are independent and standard normal under the law."""
    frame = record.frame if law.independent else record.frame.sort_by_time()
    variance = _sort_by_time(law, record, np.asarray(extra), 0) if np.ndim(extra) else None
    frame = add_variance(frame, variance)
    scores = law.normal_scores(_sort_by_time(law, record, residual, 0), values, frame)
    return _unsort_rows(law, record, np.asarray(scores))


def _run_batches(
    run, law: Noise, record: Record, hyper: Batch, *arrays, shared: tuple = (), keys: tuple = ()
) -> Float[np.ndarray, "b n"]:
    """Run a compiled function on batches of draws; the last batch is padded with its last draw."""
    names = list(law.parameters())
    given_arrays = [a for a in arrays if a is not None]
    count = max([*(np.size(hyper[n]) for n in names), *map(len, given_arrays), 1])
    phi = {n: np.broadcast_to(np.asarray(hyper[n], float), (count,)) for n in names}
    arrays = tuple(a if a is None else _sort_by_time(law, record, np.asarray(a), 1) for a in arrays)
    output = np.empty((record.size, count))
    max_batch_size = max(1, MAX_BATCH_ELEMENTS // record.padded_size)
    is_small = count <= 8 * BATCH_DRAWS
    batch_size = 1 if count == 1 else BATCH_DRAWS if is_small else min(256, max_batch_size)
    for start in range(0, count, batch_size):
        draws = np.minimum(start + np.arange(batch_size), count - 1)
        inputs: list[Any] = [
            a if a is None else record.pad(a[draws if len(a) > 1 else 0 * draws]) for a in arrays
        ]
        inputs += [p[draws] for p in keys]
        values = {n: v[draws] for n, v in phi.items()}
        outputs = np.asarray(run(*record.prepare_for_law(law), *shared, *inputs, values))
        stop = min(start + batch_size, count)
        output[:, start:stop] = outputs[: stop - start, : record.size].T
    return _unsort_rows(law, record, output).T


def total_log_density(
    law: Noise, record: Record, residuals: Float[np.ndarray, "b n"], hyper: Batch, extra: Any = 0.0
) -> Float[np.ndarray, "b"]:
    """Return the log density of all readings in each draw (b,); residuals (b, n), or (1, n) for all draws."""
    names = list(law.parameters())
    count = max([*(np.size(hyper[n]) for n in names), len(residuals)])
    phi, totals = {n: np.broadcast_to(hyper[n], (count,)) for n in names}, []
    for draws in np.array_split(np.arange(count), -(-count * record.size // MAX_BATCH_ELEMENTS)):
        variance = extra[draws] if np.ndim(extra) else extra
        part = residuals[draws] if len(residuals) > 1 else residuals
        values = {n: v[draws] for n, v in phi.items()}
        totals.append(log_densities(law, record, part, values, variance).sum(axis=1))
    return np.concatenate(totals)
