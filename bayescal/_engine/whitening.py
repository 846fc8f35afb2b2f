"""Whitening on the host: what makes readings independent and of unit variance, for noise that is Gaussian."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dtbtrs

from bayescal._engine import pieces
from bayescal._engine.record import Record
from bayescal._model.noise_laws import UNCERTAINTY, Noise, OrnsteinUhlenbeck, White

Values = dict[str, float]


class Whitening(NamedTuple):
    """L⁻¹ of LLᵀ = Σ: a standard deviation for each reading, after a recursion where readings hang together.

    Attributes:
        sd: of each reading given those before it, in the order of time within runs where there is a recursion.
        order: that order; None for independent readings.
        band: the recursion, for LAPACK; None for independent readings.
        carry: what passes from one prediction to the next.
    """

    sd: Float[np.ndarray, "n"]
    order: np.ndarray | None = None
    band: np.ndarray | None = None
    push: np.ndarray | None = None

    @property
    def logdet(self) -> float:
        return 2.0 * float(np.sum(np.log(self.sd)))

    def __call__(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """L⁻¹ times a table, in the order of the readings (in that of time, where they hang together)."""
        if self.order is None:
            return table / self.sd[:, None]
        values = np.asfortranarray(table[self.order])
        # The prediction m obeys m[i] = leave[i−1]·m[i−1] + push[i−1]·y[i−1].
        right = np.zeros_like(values, order="F")
        right[1:] = self.push[:-1, None] * values[:-1]  # pyright: ignore[reportOptionalSubscript]
        predicted, _ = dtbtrs(self.band, right, uplo="L", diag="U")
        return (values - predicted) / self.sd[:, None]


def known_variance(record: Record) -> Float[np.ndarray, "n"] | float:
    """Variance of each reading that is known beforehand; zero for all where none is."""
    columns = record.frame.columns
    return np.asarray(columns[UNCERTAINTY]) ** 2 if UNCERTAINTY in columns else 0.0


def whitening(
    noise: Noise, values: Values, record: Record, extra: Float[np.ndarray, "n"] | float
) -> Whitening:
    """Of a noise law at its parameters, with the variance `extra` beside it."""
    if not isinstance(noise, (White, OrnsteinUhlenbeck)):  # as if Gaussian, of the same variance
        own = np.asarray(noise.variance(values, record.frame))  # pyright: ignore[reportArgumentType]
        return Whitening(np.sqrt(np.broadcast_to(own + extra, (record.size,))))
    white = np.broadcast_to(values["noise.white"] ** 2 + known_variance(record) + extra, (record.size,))
    if isinstance(noise, White):
        return Whitening(np.sqrt(white))
    order, step = np.asarray(record.frame.order), np.asarray(record.frame.step)
    tau, variance = values["noise.correlated.time"], _wander(values)
    first = step < 0
    carry = np.where(first, 0.0, np.exp(-np.where(first, 0.0, step) / tau))
    fresh = np.where(first, variance, variance * -np.expm1(-2 * np.where(first, 0.0, step) / tau))
    more = record.padded.size - record.size
    longer = [np.pad(a, (0, more), constant_values=1.0) for a in (carry, fresh, white[order])]
    total, gain = (np.asarray(a)[: record.size] for a in pieces.filter_gains(*longer))
    leave, push = carry[1:] * (1 - gain[:-1]), np.append(carry[1:] * gain[:-1], 0.0)
    band = np.zeros((2, record.size), order="F")
    band[0], band[1, :-1] = 1.0, -leave
    return Whitening(np.sqrt(total), order, band, push)


def _wander(values: Values) -> float:
    """Variance of the wandering part."""
    if "noise.correlated" in values:
        return values["noise.correlated"] ** 2
    return 0.5 * values["noise.diffusion"] ** 2 * values["noise.correlated.time"]
