"""Interface of noise laws: the distribution of readings about the expected output. Each law is a class.

A law defines its parameters with their priors and units, and in JAX, differentiable by all of them: the variance of
each reading, its log density, draws of readings and, where it is Gaussian given its parameters, the whitening that
makes readings independent and of unit variance (`whiten`). No code outside depends on the class of a law, so that a
law of one's own takes part in fits, searches, files and batches like any other.

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
    several_states: ClassVar[bool] = False  # whether its Kalman filter has several states
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
        """Return the law that a search begins with."""
        return next(kind() for kind in Noise.known.values() if kind.first)

    @classmethod
    def correlates(cls, name: str) -> bool:
        """Return whether law of a name takes readings as correlated; a name begins with its law, as in law(column)."""
        law = name.partition("(")[0]
        return any(k.law == law and not k.independent for k in Noise.known.values())

    # what it is called, and what it needs -----------------------------------------------------------------------

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the columns that it depends on."""
        return () if self.independent else ("time",)

    @property
    def covariates(self) -> tuple[str, ...]:
        """Return its covariates: numeric columns, "elapsed", or rates such as "temperature rate"."""
        return ()

    @property
    def name(self) -> str:
        """Return the name of the law, with the column that it follows."""
        return self.law

    @property
    def in_words(self) -> str:
        """Return the law in words, to stand after "noise:"."""
        return self.words or self.law

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Return the names and priors of its unknowns."""

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Return the parameters that scale the covariance by c² where all of them are scaled by c."""
        return ()

    def unit(self, name: str, output: str) -> str:
        """Return the unit of one of its parameters, where the output is in `output`; by default that of the output."""
        return output

    @property
    def plain(self) -> Noise:
        """Return the law with its default priors: laws of one `plain` share compiled programs."""
        return _with_usual_priors(self)

    def why_not(self, output: Float[np.ndarray, "n"]) -> str:
        """Return why readings cannot scatter so, in words; empty where they can."""
        return ""

    def derived(self, values: Parameters) -> dict[str, Any]:
        """Return further quantities derived from its parameters, by name, output unit."""
        return {}

    # what it computes, in JAX -----------------------------------------------------------------------------------

    @abc.abstractmethod
    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "*n"]:
        """Return the variance of each reading about the expected output, or one for all, output unit squared."""

    def log_density(
        self, y: Float[Array, "n"], mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Return the log density of each reading; given those before it in its run, where they are not independent."""
        return _by_whitening(self, y - mean, 0.0, parameters, frame)

    def by_residual(
        self, residuals: Float[np.ndarray, "*b n"], parameters: Parameters, frame: Frame
    ) -> tuple[Any, Any] | None:
        """Return −∂/∂r and −∂²/∂r² of the log density of independent readings at residuals r; None: by differences."""
        return None

    def sample(
        self, key: Array, mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Draw readings about the expected output."""
        sd = jnp.sqrt(self.variance(parameters, frame))
        return mean + sd * jax.random.normal(key, mean.shape)

    def even(self, frame: Frame) -> bool:
        """Return whether readings are independent and share one variance: products over them are then needed once."""
        return False

    def shared_variance(self, values: Parameters) -> Any:
        """Return the one variance of all readings where they are `even`, output unit squared."""
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
        """Return L⁻¹ times columns, and log Lᵢᵢ, where L·Lᵀ = Σ + diag(extra); row i belongs to reading i."""
        variance = self.variance(parameters, frame) + extra
        sd = jnp.sqrt(jnp.broadcast_to(variance, (frame.size,)))
        return columns / sd[:, None], jnp.log(sd)

    def normal_scores(
        self, residuals: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Return the residuals as independent standard normal scores, if the law is right."""
        return self.whiten(residuals[:, None], 0.0, parameters, frame)[0][:, 0]

    def followed(self, frame: Frame) -> Float[Array, "n"] | None:
        """Return the column that its correlated part follows, −1 to 1 over the readings of the fit; None for none."""
        return None

    def starts(self, frame: Frame, residuals: Float[np.ndarray, "n"]) -> list[dict[str, float]]:
        """Return starting values of parameters for the residuals of a model; those not named may be anything.

        Args:
            frame: of the readings, in the order that the law takes them in.
            residuals: of them, in this order.
        """
        return [{}]

    # properties over a record -----------------------------------------------------------------------------------

    def allan_variance(
        self, values: Parameters, variance: Any, factors: Float[np.ndarray, "k"], step: float
    ) -> Float[np.ndarray, "... k"]:
        """Return the Allan variance of evenly spaced readings, output unit squared; σ²/m where they are independent.

        Args:
            values: its parameters; numbers, or (draws,).
            variance: of a reading about the expected output, all parts included.
            factors: readings averaged, m.
            step: between readings, s.
        """
        return np.asarray(variance)[..., None] / factors

    def slow_variance(self, values: Parameters) -> Any:
        """Return the part of a reading's variance that it shares with its neighbours, output unit squared."""
        return 0.0

    def lasting_deviation(self, values: Parameters) -> float:
        """Return the largest Allan deviation of the correlated part over 0.1 to 0.5 of the longest run, output unit."""
        return 0.0

    def slow_part(
        self,
        values: Parameters,
        time: Float[np.ndarray, "n"],
        residuals: Float[np.ndarray, "n b"],
        white: Float[np.ndarray, "n"],
        at: Float[np.ndarray, "m"],
        along: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[Float[np.ndarray, "m b"], Float[np.ndarray, "m"]]:
        """Return mean and variance of the correlated part at some times of a run, given the residuals of its readings.

        Args:
            values: its parameters.
            time: of the readings, s.
            residuals: output unit; a column for each set of coefficients. The mean is linear in it.
            white: variance of each reading's white noise.
            at: times of the result, s.
            along: the column that it follows, at the readings and at those times.
        """
        return np.zeros((len(at), residuals.shape[1])), np.zeros(len(at))


def log_density_beside(
    law: Noise,
    y: Float[Array, "n"],
    mean: Float[Array, "n"],
    extra: Float[Array, "n"] | None,
    parameters: Parameters,
    frame: Frame,
) -> Float[Array, "n"]:
    """Return `law.log_density` with a further Gaussian part of variance `extra`; None: without.

    A law that is not Gaussian takes that part as it takes a known uncertainty of each reading.
    """
    if law.gaussian and extra is not None:
        return _by_whitening(law, y - mean, extra, parameters, frame)
    return law.log_density(y, mean, parameters, widened(frame, extra))


def _by_whitening(
    law: Noise, residuals: Float[Array, "n"], extra: Any, parameters: Parameters, frame: Frame
) -> Float[Array, "n"]:
    # The Cholesky factor takes readings in turn: zₜ is the innovation of one, Lₜₜ its standard deviation given those
    # before, and so each term is the log density of one reading given those before it.
    white, log_sd = law.whiten(residuals[:, None], extra, parameters, frame)
    return -0.5 * white[:, 0] ** 2 - log_sd - 0.5 * LOG_2PI


def widened(frame: Frame, extra: Float[Array, "n"] | None) -> Frame:
    """Add a variance to each reading's known uncertainty; None: none."""
    if extra is None:
        return frame
    variance = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return replace(frame, columns={**frame.columns, UNCERTAINTY: xp.sqrt(variance + extra)})


def in_time(
    law: Noise, frame: Frame, *arrays: Float[Array, "n ..."]
) -> tuple[Frame, *tuple[Array, ...]]:
    """Return a frame and arrays of its readings as a law takes them: in the order of time for correlated noise."""
    if law.independent:
        return frame, *arrays
    return frame.in_time(), *(a[frame.order] for a in arrays)


@cache
def _with_usual_priors(law: Noise) -> Noise:
    # Programs are compiled for a law as a value: priors, which they do not use, would compile each one anew.
    usual = {f.name: f.default for f in fields(law) if isinstance(getattr(law, f.name), KINDS)}
    return replace(law, **{n: prior for n, prior in usual.items() if prior is not MISSING})


def _refuse_unfit(kind: type[Noise]) -> None:
    """Raise TypeError for a class without its own required methods, or with the name of another law."""
    name = kind.__name__
    for base in kind.__mro__[1:]:
        if "law" in vars(base):
            raise TypeError(f"{name}: derive a noise law from Noise, not from {base.__name__}")
    attrs = vars(kind)
    if missing := [n for n in ("law", "gaussian") if n not in attrs]:
        raise TypeError(f'{name}: a noise law says {" and ".join(missing)}, as in law = "my_law"')
    needed = [] if attrs["gaussian"] else ["log_density", "sample"]
    needed += [] if attrs.get("independent", True) else ["whiten", "sample"]
    if missing := [n for n in dict.fromkeys(needed) if getattr(kind, n) is getattr(Noise, n)]:
        why = "does not take readings as independent" if attrs["gaussian"] else "is not Gaussian"
        raise TypeError(f"{name} {why}: it must have a method {' and '.join(missing)} of its own")
    for other in Noise.known.values():
        built_in = other.__module__.startswith("bayescal.") and other.__module__ != kind.__module__
        if built_in and (other.__name__ == name or other.law == kind.law):
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
    """Return the variance of each reading's white part and its known uncertainty."""
    known_variance = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return parameters[WHITE] ** 2 + known_variance + xp.zeros(frame.size)
