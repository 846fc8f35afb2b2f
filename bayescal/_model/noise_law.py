"""What a noise law is: how readings scatter about the expected output. One class each; this is their interface.

A law owns its mathematics. It says its parameters with their priors and units, and in JAX, differentiable by all of
them: the variance of each reading, its log density, how readings are drawn and, where it is Gaussian given its
parameters, what makes readings independent and of unit variance (`whiten`). Nothing outside asks of which class a law
is, so that a law of one's own is a law like any other: it takes part in fits, searches, files and batches.

A law that is not Gaussian (Student-t, rounding) offers its density alone; slopes and curvatures by the expected output
are taken by automatic differentiation, and a Gaussian stands for it about the mode of the coefficients (Laplace).
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from typing_extensions import dataclass_transform

from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._core.xp import xp
from bayescal._data.column import UNCERTAINTY
from bayescal._model.frame import Frame
from bayescal._model.prior import KINDS, Positive
from bayescal._model.static import static

Parameters = Mapping[str, Any]  # values by name, in their units
WHITE = "noise.white"  # of each reading by itself, in the unit of the output
LOG_2PI = math.log(2 * math.pi)


@static
@dataclass_transform(frozen_default=True)
class Noise(abc.ABC):
    """A noise law. A law of one's own is a subclass of this class, not of a law that is there.

    A law that takes readings as correlated gets them in the order of time within runs (`in_time`), as the frame that is
    handed to it has them: `frame.step` is the time since the reading before, −1 at a run's first.

    Attributes:
        law: its name in files and on the command line.
        gaussian: whether coefficients can be integrated out in closed form, by `whiten`; else it has a `log_density` of
            its own.
        independent: whether one reading's noise says nothing of another's; else it has a `whiten` and a `sample` of
            its own.
        words: the law as a person reads it, where that is not its name.
        looks_like: what is left of readings under it, as a report says it.
        first: whether a search begins with it, and weighs the others against it.
        refines: the name of a law that it is a finer form of: a search weighs it where that one is probable.

    Raises:
        TypeError: a class derived from it lacks what it must have, or is named as another law is.
    """

    gaussian: ClassVar[bool]
    law: ClassVar[str]
    independent: ClassVar[bool] = True
    first: ClassVar[bool] = False
    words: ClassVar[str] = ""
    looks_like: ClassVar[str] = ""
    refines: ClassVar[str] = ""
    several_states: ClassVar[bool] = False  # whether it is computed by a filter of several states
    stationary: ClassVar[bool] = False  # a function of frequency on readings of even steps

    # By its class's name, which a saved calibration keeps.
    known: ClassVar[dict[str, type[Noise]]] = {}

    def __init_subclass__(cls, interface: bool = False, **options: Any) -> None:
        super().__init_subclass__(**options)
        if interface:  # what several laws share, and none itself
            return
        _refuse_unfit(cls)
        Noise.known[cls.__name__] = cls
        static(cls)

    @classmethod
    def usual(cls) -> Noise:
        """The law that a search begins with."""
        return next(kind() for kind in Noise.known.values() if kind.first)

    @classmethod
    def correlates(cls, name: str) -> bool:
        """Whether the law of a name takes readings as correlated; a name begins with its law, as in law(column)."""
        law = name.partition("(")[0]
        return any(k.law == law and not k.independent for k in Noise.known.values())

    # what it is called, and what it needs -----------------------------------------------------------------------

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns that it hangs on."""
        return () if self.independent else ("time",)

    @property
    def covariates(self) -> tuple[str, ...]:
        """What it follows: numeric columns, "elapsed", or rates such as "temperature rate"."""
        return ()

    @property
    def name(self) -> str:
        """The law, with the column that it follows."""
        return self.law

    @property
    def in_words(self) -> str:
        """The law as a person reads it, after "noise:"."""
        return self.words or self.law

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Names and priors of its unknowns."""

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Parameters that make the covariance c² times as large where all of them are c times as large."""
        return ()

    def unit(self, name: str, output: str) -> str:
        """Unit of one of its parameters, where the output is in `output`; that of the output, if not said here."""
        return output

    @property
    def plain(self) -> Noise:
        """The law with the priors that it has if none is given: laws of one `plain` share compiled programs."""
        return _with_usual_priors(self)

    def why_not(self, output: Float[np.ndarray, "n"]) -> str:
        """Return why readings cannot scatter so, in words; empty where they can."""
        return ""

    def derived(self, values: Parameters) -> dict[str, Any]:
        """Further numbers that its parameters come to, by name, output unit."""
        return {}

    # what it computes, in JAX -----------------------------------------------------------------------------------

    @abc.abstractmethod
    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "*n"]:
        """Variance of each reading about the expected output, or one for all, output unit squared."""

    def log_density(
        self, y: Float[Array, "n"], mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Log density of each reading; given those before it in its run, where they are not independent."""
        return _by_whitening(self, y - mean, 0.0, parameters, frame)

    def by_residual(
        self, left: Float[np.ndarray, "*b n"], parameters: Parameters, frame: Frame
    ) -> tuple[Any, Any] | None:
        """Return −∂/∂left and −∂²/∂left² of the log density of independent readings; None: by differences."""
        return None

    def sample(
        self, key: Array, mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Readings drawn about the expected output."""
        sd = jnp.sqrt(self.variance(parameters, frame))
        return mean + sd * jax.random.normal(key, mean.shape)

    def even(self, frame: Frame) -> bool:
        """Whether all readings are independent and share one variance: then products over them are needed once."""
        return False

    def shared_variance(self, values: Parameters) -> Any:
        """Of every reading where they are `even`, output unit squared."""
        raise NotImplementedError(f"readings under {self.name} noise share no variance")

    def variance_place(self, frame: Frame) -> Float[np.ndarray, "n"] | None:
        """Return the place of each reading that its variance is a smooth function of; None where it is of none.

        Only of independent Gaussian noise: `variance_along` is that function.
        """
        return None

    def variance_along(self, values: Parameters, place: Float[np.ndarray, "j"]) -> Any:
        """Return the variance at some places, output unit squared; values are (s, 1)."""
        raise NotImplementedError(f"the variance of {self.name} noise follows no place")

    def whiten(
        self,
        columns: Float[Array, "n m"],
        extra: Float[Array, "n"] | float,
        parameters: Parameters,
        frame: Frame,
    ) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
        """L⁻¹ times columns, and log Lᵢᵢ, where L·Lᵀ = Σ + diag(extra); row i belongs to reading i."""
        variance = self.variance(parameters, frame) + extra
        sd = jnp.sqrt(jnp.broadcast_to(variance, (frame.size,)))
        return columns / sd[:, None], jnp.log(sd)

    def normal_scores(
        self, left: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """What the expected output leaves of readings, as independent standard normal numbers if the law is right."""
        return self.whiten(left[:, None], 0.0, parameters, frame)[0][:, 0]

    def followed(self, frame: Frame) -> Float[Array, "n"] | None:
        """The column that its correlated part follows, −1 to 1 over the readings of the fit; None if it does none."""
        return None

    def starts(self, frame: Frame, left: Float[np.ndarray, "n"]) -> list[dict[str, float]]:
        """Values at which a maximum may lie, given what a model leaves of readings; those not named may be anything.

        Args:
            frame: of the readings, in the order that the law takes them in.
            left: of them, in this order.
        """
        return [{}]

    # what it says of a record -----------------------------------------------------------------------------------

    def allan_variance(
        self, values: Parameters, variance: Any, factors: Float[np.ndarray, "k"], step: float
    ) -> Float[np.ndarray, "... k"]:
        """Allan variance of evenly spaced readings, output unit squared; σ²/m where they are independent.

        Args:
            values: its parameters; numbers, or (draws,).
            variance: of a reading about the expected output, all parts included.
            factors: readings averaged, m.
            step: between readings, s.
        """
        return np.asarray(variance)[..., None] / factors

    def slow_variance(self, values: Parameters) -> Any:
        """Part of a reading's variance that it shares with its neighbours, output unit squared."""
        return 0.0

    def lasting_deviation(self, values: Parameters) -> float:
        """Allan deviation of the correlated part over a tenth to a half of the longest run, at most, output unit."""
        return 0.0

    def slow_part(
        self,
        values: Parameters,
        time: Float[np.ndarray, "n"],
        left: Float[np.ndarray, "n b"],
        white: Float[np.ndarray, "n"],
        at: Float[np.ndarray, "m"],
        along: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[Float[np.ndarray, "m b"], Float[np.ndarray, "m"]]:
        """Mean and variance of the correlated part at some times of a run, given what a model leaves of its readings.

        Args:
            values: its parameters.
            time: of the readings, s.
            left: of the readings, output unit; a column for each set of coefficients. The mean is linear in it.
            white: variance of each reading's own noise.
            at: where it is asked for, s.
            along: what it follows, at these times and at those.
        """
        return np.zeros((len(at), left.shape[1])), np.zeros(len(at))


def log_density_beside(
    law: Noise,
    y: Float[Array, "n"],
    mean: Float[Array, "n"],
    extra: Float[Array, "n"] | None,
    parameters: Parameters,
    frame: Frame,
) -> Float[Array, "n"]:
    """`law.log_density` of readings with a Gaussian part of known variance beside the law's; None: without.

    A law that is not Gaussian takes that part as it takes a known uncertainty of each reading.
    """
    if law.gaussian and extra is not None:
        return _by_whitening(law, y - mean, extra, parameters, frame)
    return law.log_density(y, mean, parameters, widened(frame, extra))


def _by_whitening(
    law: Noise, left: Float[Array, "n"], extra: Any, parameters: Parameters, frame: Frame
) -> Float[Array, "n"]:
    # The Cholesky factor takes readings in turn: zₜ is what is new in one, Lₜₜ its standard deviation given those
    # before, and so each term is the log density of one reading given those before it.
    white, log_sd = law.whiten(left[:, None], extra, parameters, frame)
    return -0.5 * white[:, 0] ** 2 - log_sd - 0.5 * LOG_2PI


def widened(frame: Frame, extra: Float[Array, "n"] | None) -> Frame:
    """A frame in which each reading is uncertain by so much variance more; None: by none."""
    if extra is None:
        return frame
    known = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return replace(frame, columns={**frame.columns, UNCERTAINTY: xp.sqrt(known + extra)})


def in_time(
    law: Noise, frame: Frame, *arrays: Float[Array, "n ..."]
) -> tuple[Frame, *tuple[Array, ...]]:
    """A frame and arrays of its readings as a law takes them: in the order of time, where that matters to it."""
    if law.independent:
        return frame, *arrays
    return frame.in_time(), *(a[frame.order] for a in arrays)


@cache
def _with_usual_priors(law: Noise) -> Noise:
    # Programs are compiled for a law as a value: priors, which they do not compute with, would make each one anew.
    usual = {f.name: f.default for f in fields(law) if isinstance(getattr(law, f.name), KINDS)}
    return replace(law, **{n: prior for n, prior in usual.items() if prior is not MISSING})


def _refuse_unfit(kind: type[Noise]) -> None:
    """Refuse a class that would be computed as another law than it is, or found under another's name."""
    name = kind.__name__
    for base in kind.__mro__[1:]:
        if "law" in vars(base):
            raise TypeError(f"{name}: derive a noise law from Noise, not from {base.__name__}")
    own = vars(kind)
    if missing := [n for n in ("law", "gaussian") if n not in own]:
        raise TypeError(f'{name}: a noise law says {" and ".join(missing)}, as in law = "my_law"')
    needed = [] if own["gaussian"] else ["log_density", "sample"]
    needed += [] if own.get("independent", True) else ["whiten", "sample"]
    if missing := [n for n in dict.fromkeys(needed) if getattr(kind, n) is getattr(Noise, n)]:
        why = "is not Gaussian" if not own["gaussian"] else "does not take readings as independent"
        raise TypeError(f"{name} {why}: it must have a method {' and '.join(missing)} of its own")
    for other in Noise.known.values():
        given = other.__module__.startswith("bayescal.") and other.__module__ != kind.__module__
        if given and (other.__name__ == name or other.law == kind.law):
            raise TypeError(
                f"{name} ({kind.law!r}): bayescal has a law {other.__name__} ({other.law!r}): rename it"
            )


Offer = Callable[[Positive, Frame], "list[Noise]"]
OFFERS: list[Offer] = []


def offered(offer: Offer) -> Offer:
    """Let a search weigh laws: from the prior of the white part and a record, those that this record can tell.

        @bc.offered
        def where_it_was_recorded(scale, frame):
            return [Vibration(scale)] if "vibration" in frame.columns else []

    Args:
        offer: a function of the prior of `noise.white` and of the readings' frame. Defined again, as a cell of a
            notebook that is run again does, it takes the place of the one of its name.
    """
    name = (offer.__module__, offer.__qualname__)
    OFFERS[:] = [*(o for o in OFFERS if (o.__module__, o.__qualname__) != name), offer]
    return offer


def own_variance(parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
    """Variance of each reading by itself: that of the white part, and what is known beforehand."""
    known = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return parameters[WHITE] ** 2 + known + xp.zeros(frame.size)
