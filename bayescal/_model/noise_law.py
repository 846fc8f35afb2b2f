"""Interface of noise models ("noise laws"), classes for the distribution of readings about the expected output.

A noise law defines its parameters with priors and units and, in JAX, differentiable by all parameters: the variance of
each reading, its log density, draws of readings and, if Gaussian given its parameters, the whitening L⁻¹ of residuals
to independent unit variance (`whiten`). Other code uses this interface only, so that user-defined laws work anywhere.

A law that is not Gaussian (Student-t, rounding) defines its density only; derivatives with respect to the expected
output, for the Laplace approximation about the conditional mode of the coefficients, are computed numerically.
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
from bayescal._core.renamed import renamed
from bayescal._core.xp import xp
from bayescal._data.column import UNCERTAINTY
from bayescal._model.frame import Frame, list_covariate_columns
from bayescal._model.noise_spectrum import SpectralTerm
from bayescal._model.prior import PRIORS, Positive
from bayescal._model.static import static

Parameters = Mapping[str, Any]  # values by name, in their units
WHITE = "noise.white"  # standard deviation of the white noise, output unit
LOG_2PI = math.log(2 * math.pi)
AVERAGING_TIME_RUN_FRACTIONS = np.geomspace(0.1, 0.5, 9)  # of the longest run, for Allan deviations


@renamed(known="registry", usual="default", followed="covariate", gaussian="is_gaussian")
@static
@dataclass_transform(frozen_default=True)
class Noise(abc.ABC):
    """Base class of noise models; derive a new law from this class, not from another law.

    A law with correlated readings gets them sorted by time within runs: `frame.step` is the time since the previous
    reading, −1 at the first of a run.

    Attributes:
        law: name in files and on the command line.
        is_gaussian: whether coefficients can be integrated out in closed form, by `whiten`; otherwise the class defines
            `log_density`.
        independent: whether the noise of readings is independent; otherwise the class defines `whiten` and `sample`.
        words: name in printed text, if not `law`.
        looks_like: description of the residuals under this law, for reports.
        first: whether a search begins with this law and compares all others with it.
        refines: name of the law that it generalises: a search evaluates it only where that law is probable.

    Raises:
        TypeError: a derived class lacks required attributes or methods, or has the name of another law.
    """

    is_gaussian: ClassVar[bool]
    law: ClassVar[str]
    independent: ClassVar[bool] = True
    first: ClassVar[bool] = False
    words: ClassVar[str] = ""
    looks_like: ClassVar[str] = ""
    refines: ClassVar[str] = ""

    # Class name, as saved in calibration files → class.
    registry: ClassVar[dict[str, type[Noise]]] = {}

    def __init_subclass__(cls, interface: bool = False, **options: Any) -> None:
        super().__init_subclass__(**options)
        if interface:  # an abstract base of several laws
            return
        if "gaussian" in vars(cls):  # former name
            cls.is_gaussian = vars(cls)["gaussian"]
        _check_noise_class(cls)
        Noise.registry[cls.__name__] = cls
        static(cls)

    @classmethod
    def default(cls) -> Noise:
        """Return the default noise law, with which a search begins."""
        return next(law_class() for law_class in Noise.registry.values() if law_class.first)

    @classmethod
    def correlates(cls, name: str) -> bool:
        """Return whether the law named `law` or `law(column)` has correlated readings."""
        law = name.partition("(")[0]
        return any(k.law == law and not k.independent for k in Noise.registry.values())

    @property
    def parts(self) -> tuple[Any, ...]:
        """Return the terms of correlated noise (`NoiseTerm`) that are added to independent noise."""
        return ()

    # names, parameters and required columns ---------------------------------------------------------------------

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the columns of the readings that the law depends on."""
        columns = (name for c in self.covariates for name in list_covariate_columns(c))
        return tuple(dict.fromkeys((*(() if self.independent else ("time",)), *columns)))

    @property
    def covariates(self) -> tuple[str, ...]:
        """Return the covariates of the law: numeric columns, "elapsed", or rates such as "temperature rate"."""
        return ()

    @property
    def name(self) -> str:
        """Return the name of the law, with its terms and covariates if it has any."""
        return self.law

    @property
    def in_words(self) -> str:
        """Return the description of the law, to be printed after "noise:"."""
        return self.words or self.law

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Return the prior of each parameter, by name."""

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Return the amplitude parameters: if all are multiplied by c, the covariance is multiplied by c²."""
        return ()

    def unit(self, name: str, output: str) -> str:
        """Return the unit of a parameter if the output has the unit `output`; by default that unit."""
        return output

    @property
    def plain(self) -> Noise:
        """Return the law with default priors; laws with equal `plain` share compiled programs."""
        return _replace_priors_by_defaults(self)

    def why_not(self, output: Float[np.ndarray, "n"]) -> str:
        """Return the reason why the output contradicts the law, as a message; empty if it does not."""
        return ""

    def derived(self, values: Parameters) -> dict[str, Any]:
        """Return quantities derived from the parameters, by name: standard deviations, output unit; times, s."""
        arrays = {n: np.asarray(v, float) for n, v in values.items() if n in self.parameters()}
        return {n: value for part in self.parts for n, value in part.derived(arrays).items()}

    # computations in JAX ----------------------------------------------------------------------------------------

    @abc.abstractmethod
    def variance(self, parameters: Parameters, frame: Frame) -> Float[Array, "*n"]:
        """Return the variance of each reading about the expected output, or one for all, output unit squared."""

    def log_density(
        self, y: Float[Array, "n"], mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Return the log density of each reading (n,), given the earlier ones of its run if not independent."""
        return _log_density_by_whitening(self, y - mean, 0.0, parameters, frame)

    def by_residual(
        self, residuals: Float[np.ndarray, "*b n"], parameters: Parameters, frame: Frame
    ) -> tuple[Any, Any] | None:
        """Return −∂/∂r and −∂²/∂r² of the log density of independent readings at residuals r; None: not implemented."""
        return None

    def sample(
        self, key: Array, mean: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Draw readings about the expected output (n,), output unit."""
        sd = jnp.sqrt(self.variance(parameters, frame))
        return mean + sd * jax.random.normal(key, mean.shape)

    def even(self, frame: Frame) -> bool:
        """Return whether readings are independent and of one common variance."""
        coordinate = self.variance_coordinate(frame)
        return coordinate is not None and coordinate.ndim == 0

    def variance_coordinate(self, frame: Frame) -> Float[np.ndarray, "*n"] | None:
        """Return a coordinate of each reading, of which its variance is a smooth function; shape () if common to all.

        For independent Gaussian noise only; None if there is none.
        """
        return None

    def variance_at(self, values: Parameters, coordinate: Float[np.ndarray, "j"]) -> Any:
        """Return the variance (s, j), output unit squared, at values of `variance_coordinate`; parameters: (s, 1)."""
        raise NotImplementedError(f"{self.name} noise has no variance coordinate")

    def whiten(
        self,
        columns: Float[Array, "n m"],
        added_variance: Float[Array, "n"] | float,
        parameters: Parameters,
        frame: Frame,
    ) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
        """Return L⁻¹·columns (n, m) and log Lᵢᵢ (n,), L the lower Cholesky factor of the total covariance."""
        variance = self.variance(parameters, frame) + added_variance
        sd = jnp.sqrt(jnp.broadcast_to(variance, (frame.size,)))
        return columns / sd[:, None], jnp.log(sd)

    def normal_scores(
        self, residuals: Float[Array, "n"], parameters: Parameters, frame: Frame
    ) -> Float[Array, "n"]:
        """Transform residuals to scores (n,) that are independent and standard normal under this law."""
        return self.whiten(residuals[:, None], 0.0, parameters, frame)[0][:, 0]

    def covariate(self, frame: Frame) -> Float[Array, "n"] | None:
        """Return the covariate of a tone's frequency (n,), scaled to −1 … 1 over its range at the fit; None if none."""
        return None

    def starts(self, frame: Frame, residuals: Float[np.ndarray, "n"]) -> list[dict[str, float]]:
        """Return starting points of an optimisation of the parameters, each name → value; a point may omit parameters.

        Readings and residuals (output unit) are sorted by time if the law is correlated.
        """
        return [{}]

    # time series ------------------------------------------------------------------------------------------------

    def allan_variance(
        self, values: Parameters, variance: Any, factors: Float[np.ndarray, "k"], step: float
    ) -> Float[np.ndarray, "... k"]:
        """Return the Allan variance of evenly spaced readings, output unit squared: σ²/m, plus that of each part.

        variance: of a reading about the expected output. factors: averaging factors m. step: time between readings, s.
        """
        phi = {n: np.asarray(values[n], float)[..., None] for n in self.parameters() if n in values}
        slow_variance = np.asarray(self.slow_variance(phi), float)
        white_var = np.maximum(np.asarray(variance)[..., None] - slow_variance, 0.0)
        return white_var / factors + sum(p.allan(phi, factors, step) for p in self.parts)

    def slow_variance(self, values: Parameters) -> Any:
        """Return the variance of the correlated part of the noise, output unit squared."""
        return sum((part.variance(values) for part in self.parts), 0.0)

    def lasting_deviation(self, values: Parameters) -> float:
        """Return the largest Allan deviation of the correlated part at averaging times of 0.1 to 0.5 longest runs."""
        if not self.parts:
            return 0.0
        step = self.parts[0].shortest
        factors = self.parts[0].longest / step * AVERAGING_TIME_RUN_FRACTIONS
        phi = {n: np.float64(v) for n, v in values.items() if n in self.parameters()}
        allan_variances = self.allan_variance(phi, self.slow_variance(phi), factors, step)
        return float(np.sqrt(np.max(allan_variances)))

    @property
    def stationary(self) -> bool:
        """Return whether the noise has a power spectrum on evenly spaced readings."""
        has_spectrum = bool(self.parts) and all(part.has_spectrum for part in self.parts)
        return has_spectrum and not self.covariates

    def spectrum(
        self, values: Parameters, step: float, lam: Float[np.ndarray, "j"]
    ) -> list[SpectralTerm]:
        """Return the cosine transforms of the parts' covariances, for readings `step` seconds apart; values (s, 1)."""
        return [t for p in self.parts for t in p.spectrum(values, step, lam)]

    def slow_part(
        self,
        values: Parameters,
        time: Float[np.ndarray, "n"],
        residuals: Float[np.ndarray, "n b"],
        white_var: Float[np.ndarray, "n"],
        new_time: Float[np.ndarray, "m"],
        covariates: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[Float[np.ndarray, "m b"], Float[np.ndarray, "m"]]:
        """Return the smoothed mean and variance of the correlated noise of a run at `new_time`, given its residuals.

        The mean is linear in residuals, output unit, one column per set of coefficients. white_var: variance of each
        reading's white noise. covariates: the tone's covariate at the readings and at `new_time`; None if it has none.
        """
        return np.zeros((len(new_time), residuals.shape[1])), np.zeros(len(new_time))


def compute_log_density(
    law: Noise,
    y: Float[Array, "n"],
    mean: Float[Array, "n"],
    added_variance: Float[Array, "n"] | None,
    parameters: Parameters,
    frame: Frame,
) -> Float[Array, "n"]:
    """Return the log density of each reading, with `added_variance` as additional variance of each (None: zero).

    If the law is not Gaussian, `added_variance` is added to each reading's known variance.
    """
    if law.is_gaussian and added_variance is not None:
        return _log_density_by_whitening(law, y - mean, added_variance, parameters, frame)
    return law.log_density(y, mean, parameters, add_variance(frame, added_variance))


def _log_density_by_whitening(
    law: Noise, residuals: Float[Array, "n"], extra: Any, parameters: Parameters, frame: Frame
) -> Float[Array, "n"]:
    # zₜ·Lₜₜ is the innovation of reading t and Lₜₜ its standard deviation given all earlier readings, so that each term
    # is a conditional log density.
    whitened, log_sd = law.whiten(residuals[:, None], extra, parameters, frame)
    return -0.5 * whitened[:, 0] ** 2 - log_sd - 0.5 * LOG_2PI


def add_variance(frame: Frame, extra: Float[Array, "n"] | None) -> Frame:
    """Return a frame with a variance added to each reading's known uncertainty; unchanged if `extra` is None."""
    if extra is None:
        return frame
    known_variance = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return replace(frame, columns={**frame.columns, UNCERTAINTY: xp.sqrt(known_variance + extra)})


def sort_by_time(
    law: Noise, frame: Frame, *arrays: Float[Array, "n ..."]
) -> tuple[Frame, *tuple[Array, ...]]:
    """Sort a frame and arrays of its readings by time within runs if the law is correlated."""
    if law.independent:
        return frame, *arrays
    return frame.sort_by_time(), *(a[frame.order] for a in arrays)


@cache
def _replace_priors_by_defaults(law: Noise) -> Noise:
    # A program is compiled per law; it does not use priors, which would otherwise cause needless compilations.
    defaults = {f.name: f.default for f in fields(law) if isinstance(getattr(law, f.name), PRIORS)}
    return replace(law, **{n: prior for n, prior in defaults.items() if prior is not MISSING})


def _check_noise_class(kind: type[Noise]) -> None:
    """Raise TypeError if a law lacks required attributes or methods, or has the name of a built-in law."""
    name = kind.__name__
    for base in kind.__mro__[1:]:
        if "law" in vars(base):
            raise TypeError(f"{name}: derive a noise law from Noise, not from {base.__name__}")
    attributes = vars(kind)
    if names := [n for n in ("law", "is_gaussian") if n not in attributes]:
        raise TypeError(f'{name}: a noise law needs {" and ".join(names)}, as in law = "my_law"')
    methods = [] if attributes["is_gaussian"] else ["log_density", "sample"]
    methods += [] if attributes.get("independent", True) else ["whiten", "sample"]
    if names := [n for n in dict.fromkeys(methods) if getattr(kind, n) is getattr(Noise, n)]:
        reason = "has correlated readings" if attributes["is_gaussian"] else "is not Gaussian"
        raise TypeError(f"{name} {reason}: it must define the method {' and '.join(names)}")
    for other in Noise.registry.values():
        built_in = other.__module__.startswith("bayescal.") and other.__module__ != kind.__module__
        if built_in and (other.__name__ == name or other.law == kind.law):
            raise TypeError(
                f"{name} ({kind.law!r}) has the name of bayescal's {other.__name__} ({other.law!r}): rename it"
            )


Offer = Callable[[Positive, Frame], "list[Noise]"]
OFFERS: list[Offer] = []


def offered(offer: Offer) -> Offer:
    """Register a function that returns noise laws for a search to evaluate on given readings.

        @bc.offered
        def where_it_was_recorded(scale, frame):
            return [Vibration(scale)] if "vibration" in frame.columns else []

    Args:
        offer: function of the prior of `noise.white` and of the readings' frame; it returns the laws that these
            readings can distinguish. It replaces a function of the same name, as when a notebook cell is run again.
    """
    key = (offer.__module__, offer.__qualname__)
    OFFERS[:] = [*(o for o in OFFERS if (o.__module__, o.__qualname__) != key), offer]
    return offer


def white_variance(parameters: Parameters, frame: Frame) -> Float[Array, "n"]:
    """Return the variance of each reading's white noise plus its known variance, output unit squared (n,)."""
    known_variance = frame.columns[UNCERTAINTY] ** 2 if UNCERTAINTY in frame.columns else 0.0
    return parameters[WHITE] ** 2 + known_variance + xp.zeros(frame.size)
