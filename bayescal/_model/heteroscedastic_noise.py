"""Independent Gaussian noise whose scatter follows a column."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from bayescal._model.frame import Frame
from bayescal._model.noise_law import WHITE, Noise, known_variance, offered
from bayescal._model.prior import HalfCauchy, Normal, Positive

SLOPE, CURVATURE = "noise.slope", "noise.curvature"


class Heteroscedastic(Noise):
    """Independent Gaussian noise whose standard deviation follows a column: log-linear, with a curvature.

    σᵢ = σ·exp(a·zᵢ + b·(3zᵢ² − 1)/2), beside each reading's known uncertainty, z the column scaled to −1 … 1 over its
    range at the fit; beyond that range σ stays as at its end. σ is `noise.white`, a `noise.slope`, b `noise.curvature`:
    with a = 1 the scatter grows by e² from one end to the other.
    Source: A. Harvey, Econometrica 44 (1976) 461 (multiplicative heteroscedasticity).

    Attributes:
        column: a numeric column, "elapsed", or a rate such as "temperature rate".
        scale: prior of σ, output unit.
        slope, curvature: priors of a and b.
    """

    column: str
    scale: Positive = HalfCauchy(1.0)
    slope: Normal = Normal(0.0, 1.0)
    curvature: Normal = Normal(0.0, 1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "heteroscedastic"

    @property
    def needs(self) -> tuple[str, ...]:
        if self.column == "elapsed":
            return ("time",)
        column = self.column.removesuffix(" rate")
        return (column,) if column == self.column else (column, "time")

    @property
    def name(self) -> str:
        return f"{self.law}({self.column})"

    @property
    def in_words(self) -> str:
        return f"scatter follows {self.column}"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE,)

    def parameters(self) -> dict[str, Positive | Normal]:
        return {WHITE: self.scale, SLOPE: self.slope, CURVATURE: self.curvature}

    def unit(self, name: str, output: str) -> str:
        return output if name == WHITE else "1"

    def variance(self, parameters, frame):
        z = jnp.clip(2 * frame.position(self.column) - 1, -1.0, 1.0)
        # Legendre's P₁ and P₂ of z have no mean over the range: log σ is the mean of the logarithm of the scatter,
        # and a and b change the form alone.
        growth = parameters[SLOPE] * z + parameters[CURVATURE] * (1.5 * z**2 - 0.5)
        return parameters[WHITE] ** 2 * jnp.exp(2 * growth) + known_variance(frame)


@offered
def _for_each_column(scale: Positive, frame: Frame) -> list[Noise]:
    """One law for each column or rate that varies."""
    reference = frame.reference
    ranged = [name.removesuffix("_low") for name in reference if name.endswith("_low")]
    varied = [n for n in ranged if float(reference[f"{n}_high"]) > float(reference[f"{n}_low"])]
    return [Heteroscedastic(column, scale) for column in varied]
