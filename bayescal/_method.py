"""What a method of fitting is: a value with one verb. `LeastSquares`, `Marginal` and `NUTS` are the three."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from bayescal._calibration import Draws, Verdict
from bayescal._frame import Frame
from bayescal._laplace import Mode
from bayescal._layout import Layout


@dataclass(frozen=True)
class Outcome:
    """What a method hands back, before names and units are put to it."""

    layout: Layout  # with the promotions that the method chose
    draws: Draws
    mode: Mode
    verdict: Verdict
    log_evidence: tuple[float, float | None] | None


class Method(eqx.Module):
    """A way of fitting. The third extension point, beside effects and noise laws."""

    name: ClassVar[str]

    @abc.abstractmethod
    def run(self, layout: Layout, frame: Frame, y: Float[Array, "n"], seed: int) -> Outcome:
        """Fit. Never raises for lack of convergence: the verdict says it."""
