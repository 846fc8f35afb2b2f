"""Interface of fitting methods, implemented by `LeastSquares`, `Marginal` and `NUTS`; their results and verdict."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from bayescal._inference.laplace import NO_START, Mode
from bayescal._inference.problem import Problem
from bayescal._model.parameters import Layout
from bayescal._model.static import static

CHAINS = 4  # number of chains into which independent draws are split, for tools that expect chains


@dataclass(frozen=True)
class Verdict:
    """Verdict on a fit: convergence, diagnostics of the sampler, and failed acceptance checks.

    Attributes:
        ok: whether the fit converged.
        reasons: reasons why it did not, each a sentence.
        notes: remarks on method and result, each a sentence.
        sampler: name of the sampling method.
        pareto_k: Pareto k̂ of the joint weights; None for chains.
        ess: smallest effective sample size over the unknowns.
        r_hat: largest R-hat; None for independent draws.
        divergences: number of divergent transitions of NUTS.
        against: failed acceptance checks of `calibrate`, reasons why a converged fit must not be used.
        checked: whether the acceptance checks were run.
    """

    ok: bool
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    sampler: str = ""
    pareto_k: float | None = None
    ess: float | None = None
    r_hat: float | None = None
    divergences: int | None = None
    against: tuple[str, ...] = ()
    checked: bool = False

    @property
    def reliable(self) -> bool:
        """Return whether the fit converged and passed all checks."""
        return self.ok and not self.against

    @property
    def why_not(self) -> str:
        """Return the reasons why the result must not be used, as sentences; "" if there are none."""
        return " ".join(self.reasons if not self.ok else self.against)

    @classmethod
    def read(cls, fields_read: dict[str, Any]) -> Verdict:
        """Restore a verdict from its fields as read from JSON.

        Raises:
            KeyError: a field is missing.
        """
        fields_read = {"against": (), "checked": False, **fields_read}
        values = {f.name: fields_read[f.name] for f in fields(cls)}
        return cls(**{n: tuple(v) if isinstance(v, list) else v for n, v in values.items()})

    @property
    def sentences(self) -> list[str]:
        """Return the statement on convergence, and the notes."""
        reasons = "." if self.ok else ": " + " ".join(self.reasons)
        return [f"{'NOT ' * (not self.ok)}converged ({self.sampler}){reasons}", *self.notes]

    def __str__(self) -> str:
        return " ".join(self.sentences)


@dataclass(frozen=True)
class Draws:
    """Equally weighted joint draws of coefficients x and coordinates v of φ, (chains, draws, …) each."""

    x: np.ndarray
    v: np.ndarray

    @classmethod
    def of(cls, x: ArrayLike, v: ArrayLike) -> Draws:
        """Split a sequence of draws into `CHAINS` chains of equal length; its length must be a multiple of `CHAINS`."""
        arrays = (np.asarray(a) for a in (x, v))
        return cls(*(a.reshape(CHAINS, len(a) // CHAINS, *a.shape[1:]) for a in arrays))


@dataclass(frozen=True)
class Outcome:
    """Result of a fitting method, in vectors x and v without names and units."""

    layout: Layout  # with the promotions that the method chose
    draws: Draws
    mode: Mode
    verdict: Verdict
    log_evidence: tuple[float, float | None] | None


@static
class Method(abc.ABC):
    """Base class of fitting methods, from which a user-defined method is derived."""

    name: ClassVar[str]

    def __init_subclass__(cls) -> None:
        static(cls)

    @abc.abstractmethod
    def run(self, problem: Problem, seed: int, start: Mapping[str, float] = NO_START) -> Outcome:
        """Fit the model; a fit that does not converge raises no error, its verdict says so.

        Args:
            problem: model bound to readings.
            seed: seed of the random-number generator.
            start: starting point of the search for the mode, φ by name.
        """
