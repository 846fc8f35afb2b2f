"""Effects: named physical terms of a measurement equation, each Σ coefficient × basis function, added to a slot.

An effect is linear in its coefficients and nonlinear in a few parameters, its *shapes*, such as a time constant.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._core.formatting import number
from bayescal._core.jit import to_value_partial
from bayescal._core.lazy_jax import Array
from bayescal._core.renamed import renamed
from bayescal._core.result_table import ResultTable, as_html, make_table
from bayescal._core.xp import xp
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._model import prior as priors
from bayescal._model.frame import Frame
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, Known, LogNormal, LogUniform, Normal
from bayescal._model.static import set_fields, static

Kind = Literal[
    "", "constant", "linear", "quadratic", "cubic", "quartic", "rate", "lag", "warm-up", "drift", "hysteresis",
    "curve", "line", "jump", "kink", "peak", "cycle",  # placeholders
]  # fmt: skip
Role = Literal["named", "unnamed", "freed"]
Group = str  # "run", "cell", "axis", "device", "reading", or a column of labels that the instrument declares
READING = "reading"  # the group in which each reading is a member of its own

CENTRAL_95 = 1.959963984540054  # standard deviations to either end of the central 95 % of a normal distribution
FUNCTION_FIELDS = ("basis", "weights", "untestable")  # fields of an effect that are callables
OPEN = (0.0, math.inf)  # low, high of a shape whose plausible range is estimated from the readings


@static
class Coefficient:
    """Coefficient of an effect, in which a slot is linear; unknown, unless its prior is `Known`.

    Attributes:
        unit: unit of its reported value and of its prior, such as "deg/s/degC" or "ppm/degC".
        prior: `Normal`, `Flat`, or `Known` for a constant; with `group_sd` only its mean is used.
        part: name within the effect, such as "parallel,M2,cos"; empty if the effect has just one.
        slot: slot that it adds to, if not the effect's slot.
        per: group with one coefficient per member: "run", "cell", "device", "axis", or a declared label column such as
            "station"; None for a single coefficient; "reading" for noise on an input, of known standard deviation.
        group_sd: prior of the standard deviation between members, if it is estimated; None: it is the sd of `prior`.
        initial: whether it is the contribution of the initial state of a run.
    """

    unit: str
    prior: Normal | Flat | Known = field(default_factory=Normal)
    part: str = ""
    slot: str | None = None
    per: Group | None = None
    group_sd: HalfNormal | HalfCauchy | Flat | None = None
    initial: bool = field(default=False, repr=False)

    def __post_init__(self) -> None:
        set_fields(self, prior=priors.convert(self.prior), group_sd=priors.convert(self.group_sd))
        if not isinstance(self.prior, Normal | Flat | Known):
            raise ModelError(
                f"a coefficient's prior must be Normal, Flat or Known, not {_name_type(self.prior)}, as coefficients "
                "are integrated out as Gaussian: give its mean and standard deviation, Normal(0.0, 0.05); a positive "
                'quantity is a shape, bayescal.Shape(…, scale="log")'
            )
        if not isinstance(self.group_sd, HalfNormal | HalfCauchy | Flat | None):
            raise ModelError(
                f"the prior of a standard deviation between groups must be HalfNormal, HalfCauchy or Flat, not "
                f"{_name_type(self.group_sd)}: give group_sd=HalfNormal(0.05)"
            )
        if self.group_sd is not None and self.per is None:
            raise ValueError("a `group_sd` needs a group of coefficients: give `per`")
        if self.per == READING and self.group_sd is not None:
            raise ValueError("a `group_sd` between readings is noise: give it to the noise law")
        if self.per == READING and not isinstance(self.prior, Normal):
            message = "noise on an input needs its standard deviation: prior=Normal(0.0, sd)"
            raise ValueError(message)

    @property
    def flat(self) -> bool:
        return isinstance(self.prior, Flat) and self.group_sd is None

    @property
    def known(self) -> bool:
        """Return whether the coefficient is a constant by definition in every structure, and not estimated."""
        return isinstance(self.prior, Known) and not self.prior.averaged

    @property
    def mean(self) -> float:
        return 0.0 if isinstance(self.prior, Flat) else self.prior.mean

    @property
    def size(self) -> float:
        """Return the plausible size, in `unit`: the prior's sd, or the scale of the group sd's prior."""
        if self.group_sd is not None:
            return self.group_sd.scale
        return self.prior.scale if isinstance(self.prior, Flat) else self.prior.sd


@static
class Shape:
    """Nonlinear parameter of an effect, such as a lag time, a period or a ratio of frequencies.

    Its prior has 95 % of its probability between `low` and `high` (100 % if `scale` is "bounded").

    Attributes:
        name: keyword under which the effect's basis receives it, such as "tau".
        unit: unit in which the basis receives it and in which it is reported.
        low, high: plausible range, in `unit`; `OPEN`: to be estimated from the readings.
        scale: "log" for a log-normal prior (positive quantities), "linear" for a normal one, "bounded" for a
            log-uniform one: `low` and `high` are then limits by definition, outside which it is another effect.
        ragged: whether the evidence has many local maxima, as for a period: its maximum is sought from more points.
        shared: whether all channels of a device share its value, as for the time constant of a common body.
        own_prior: prior in place of a range: LogNormal, Normal, or a NumPyro distribution such as TruncatedNormal.
    """

    name: str
    unit: str
    low: float = math.nan
    high: float = math.nan
    scale: Literal["log", "linear", "bounded"] = "log"
    ragged: bool = False
    shared: bool = field(default=False, repr=False)
    own_prior: Any = None

    def __post_init__(self) -> None:
        if self.own_prior is not None:
            prior = priors.convert(self.own_prior, is_shape=True)
            low, high = prior.value(np.array([-CENTRAL_95, CENTRAL_95])).tolist()
            scale = "linear" if isinstance(prior, Normal) else "log"
            set_fields(self, own_prior=prior, low=low, high=high, scale=scale)
        is_positive = self.low > 0 or self.open
        if not self.low < self.high or (self.scale != "linear" and not is_positive):
            raise ValueError(f"shape {self.name!r}: give low < high, and low > 0 unless linear")

    @property
    def open(self) -> bool:
        """Return whether the plausible range is to be estimated from the readings."""
        return (self.low, self.high) == OPEN

    @property
    def prior(self) -> LogNormal | LogUniform | Normal | priors.NumpyroPrior:
        """Return the prior of the value; raise ModelError if its range is still to be estimated from readings."""
        if self.own_prior is not None:
            return self.own_prior
        if self.open:
            raise ModelError(
                f"the plausible range of {self.name!r} is estimated from readings, and none are given: fit the model, "
                "or give low and high"
            )
        if self.scale == "bounded":
            return LogUniform(self.low, self.high)
        if self.scale == "log":
            sd = math.log(self.high / self.low) / (2 * CENTRAL_95)
            return LogNormal(math.sqrt(self.low * self.high), sd)
        return Normal((self.low + self.high) / 2, (self.high - self.low) / (2 * CENTRAL_95))


@renamed(held="constant_indices", ranging="with_ranges", sized="with_open_ranges")
@renamed(reported="family_name", of_reference="is_reference_error", spread_names="group_sd_names")
@static
class Effect:
    """One named physical term of a measurement equation.

    The author of an effect writes one small function of the readings:

        humidity = bc.Effect(
            "bias.humidity", slot="bias", columns=("humidity",),
            basis=lambda r: r["humidity"] - 0.5,  # a column that no instrument declares, in base units
            coefficients=(bc.Coefficient("deg/s/%", bc.Normal(0, 0.01)),),
            equation="c·(H − 50 %)",
        )

    Attributes:
        name: canonical name, `slot.cause`.
        slot: quantity that it adds to; if the slot is a column, the effect corrects that column (errors in variables).
        basis: function of a `Frame` and, as keywords, of the shapes; one column (n,) or several (n, p),
            one for each coefficient. It gets columns in the units that the instrument declares, others in base
            units; coefficient × basis is in the slot's unit, converted between the units declared.
        coefficients: coefficients, in the order of the basis columns.
        shapes: unknowns in which the basis is nonlinear.
        columns: columns that the readings must have.
        equation, source: text for reports; the source is a document, data sheet, standard or script.
        varies: columns that must take more than one value for the effect to be testable.
        weights: prior standard deviations over sizes of the coefficients, a function of the shapes not in the basis.
        measure: name of the shape that is the amplitude; None: the first coefficient is the amplitude.
        untestable: function of readings with these columns that returns why they cannot test the effect, or None.
        along: covariate, if not the first of `columns`: a column, "elapsed", or a rate ("temperature rate").
        forms: alternative forms of the effect; a search replaces the effect by each of them in turn.
        family: name of the effect of which this is a form; empty if none.
        general: name of the form of which this is a special case; a search does not evaluate both.
        kind: type of dependence on the covariate, for reports; empty if it is none of `Kind`.
        frees: name of the effect of which this is a copy with a wide prior, since its stated value may be wrong.
    """

    name: str
    slot: str
    basis: Callable[..., Float[Array, "n"] | Float[Array, "n p"] | float]
    coefficients: tuple[Coefficient, ...]
    shapes: tuple[Shape, ...] = ()
    columns: tuple[str, ...] = ()
    equation: str = ""
    source: str = "the user's own"
    varies: tuple[str, ...] = ()
    weights: Callable[..., Any] | None = None
    measure: str | None = None
    untestable: Callable[[Measurements], str | None] | None = None
    along: str | None = None
    forms: tuple[Effect, ...] = field(default=(), repr=False)
    family: str = field(default="", repr=False)
    general: str = field(default="", repr=False)
    kind: Kind = field(default="", repr=False)
    frees: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        set_fields(
            self,
            coefficients=tuple(self.coefficients),
            shapes=tuple(self.shapes),
            forms=tuple(replace(form, family=self.name) for form in self.forms),
            **{name: to_value_partial(getattr(self, name)) for name in FUNCTION_FIELDS},
        )
        if not self.coefficients:
            raise ModelError(f"effect {self.name!r} has no coefficient: give at least one")
        parts = [c.part for c in self.coefficients]
        if len(set(parts)) != len(parts):
            raise ModelError(f"effect {self.name!r}: coefficient parts must differ, not {parts}")
        params = inspect.signature(self.basis).parameters
        shapes = {s.name for s in self.shapes} - set(self.weight_shapes)
        required = {n for n, p in params.items() if p.default is p.empty}  # not `lambda r, k=k: …`
        if not shapes <= set(params) or len(required - shapes) != 1:
            raise ModelError(
                f"effect {self.name!r}: its basis must take the readings and then its shapes "
                f"{sorted(shapes)} by name; it takes {list(params)}"
            )

    def __repr__(self) -> str:
        label = f"{self.name} [{self.coefficients[0].unit}]"
        return f"<Effect: {label}: {self.equation}>" if self.equation else f"<Effect: {label}>"

    def _repr_html_(self) -> str:
        return as_html([tabulate_effects([self])])

    @property
    def family_name(self) -> str:
        """Return the name to print in a search report: the family's name if the effect is one of its forms."""
        return self.family or self.name

    @property
    def covariate(self) -> str:
        """Return the covariate of the basis: a column, "elapsed" or a rate; by default the first of `columns`."""
        return self.along or next(iter(self.columns), "")

    @property
    def is_placeholder(self) -> bool:
        """Return whether the effect is a placeholder: a generic dependence on a covariate, of unknown cause."""
        return self.measure is not None

    @property
    def is_reference_error(self) -> bool:
        """Return whether the effect is the error of the reference standard stated in its certificate; zero in use."""
        return self.name == f"{self.slot}.certificate"

    @property
    def unnamed(self) -> bool:
        """Return whether the form has no physical interpretation: a fourth power, or any placeholder but a line."""
        return self.kind == "quartic" or (self.is_placeholder and self.kind != "line")

    @property
    def role(self) -> Role:
        """Return the role: "named", "unnamed" (a placeholder), or "freed" (its stated value may be wrong)."""
        return "freed" if self.frees else "unnamed" if self.is_placeholder else "named"

    @property
    def open(self) -> bool:
        """Return whether the plausible range of a shape is to be estimated from the readings."""
        return any(s.open for s in self.shapes)

    @property
    def constant_indices(self) -> tuple[int, ...]:
        """Return the indices of the coefficients that are constants by definition."""
        return tuple(i for i, c in enumerate(self.coefficients) if isinstance(c.prior, Known))

    @property
    def averaged(self) -> Effect:
        """Return the effect for a model average: its known coefficients are zero in structures without the effect."""
        copies = list(self.coefficients)
        for i in self.constant_indices:
            copies[i] = replace(copies[i], prior=Known(copies[i].mean, averaged=True))
        return replace(self, coefficients=tuple(copies)) if self.constant_indices else self

    def with_open_ranges(self, low: float, high: float) -> Effect:
        """Return the effect with (low, high) as the plausible range of its shapes that have none."""
        return self.with_ranges({s.name: (low, high) for s in self.shapes if s.open})

    @cached_property
    def weight_shapes(self) -> tuple[str, ...]:
        """Return the names of the shapes that scale prior standard deviations, which are not arguments of the basis."""
        return () if self.weights is None else tuple(inspect.signature(self.weights).parameters)

    @cached_property
    def column_shapes(self) -> tuple[Shape, ...]:
        """Return the shapes that are arguments of the basis."""
        return tuple(s for s in self.shapes if s.name not in self.weight_shapes)

    @property
    def shared_shape(self) -> Shape | None:
        """Return the shape that all channels of a device share; None if each channel has its own."""
        return next((s for s in self.column_shapes if s.shared), None)

    def with_ranges(self, ranges: Mapping[str, tuple[float, float]]) -> Effect:
        """Return the effect with other plausible ranges of shapes, name → (low, high)."""
        ranges_by_name = {s.name: (s.low, s.high) for s in self.shapes} | dict(ranges)
        shapes = ((s, *ranges_by_name[s.name]) for s in self.shapes)
        return replace(self, shapes=tuple(replace(s, low=a, high=b) for s, a, b in shapes))

    def coefficient_name(self, index: int) -> str:
        part = self.coefficients[index].part
        return f"{self.name}[{part}]" if part else self.name

    def shape_name(self, shape: Shape) -> str:
        return f"{self.name}.{shape.name}"

    def group_sd_name(self, index: int) -> str:
        return f"{self.coefficient_name(index)}.group_sd"

    @property
    def measure_name(self) -> str:
        """Return the name of the shape that is the amplitude, "effect.shape"; "" if the first coefficient is."""
        return f"{self.name}.{self.measure}" if self.measure else ""

    @property
    def group_sd_names(self) -> tuple[str, ...]:
        """Return the names of the standard deviations between group members that are estimated."""
        learned_indices = (i for i, c in enumerate(self.coefficients) if c.group_sd is not None)
        return tuple(map(self.group_sd_name, learned_indices))

    @property
    def unknown_names(self) -> tuple[str, ...]:
        """Return the names of the effect's coefficients, estimated group standard deviations and shapes."""
        names = (self.coefficient_name(i) for i in range(len(self.coefficients)))
        return (*names, *self.group_sd_names, *map(self.shape_name, self.shapes))

    def evaluate(self, frame: Frame, shapes: dict[str, Float[Array, ""]]) -> Float[Array, "n p"]:
        """Evaluate the basis as a matrix (n, p); raise ModelError unless it has one column per coefficient."""
        values = {s.name: shapes[s.name] for s in self.column_shapes}
        return Basis(self.basis, len(self.coefficients), self.name).evaluate(frame, values)


def _name_type(prior: Any) -> str:
    return prior.__name__ if isinstance(prior, type) else type(prior).__name__


def tabulate_effects(effects: Iterable[Effect]) -> ResultTable:
    """Tabulate effects: number of coefficients, plausible size of the first, equation."""
    rows = []
    for effect in effects:
        first, count = effect.coefficients[0], len(effect.coefficients)
        size_text = "flat prior" if first.flat else f"{number(first.size)} {unit_label(first.unit)}"
        count_text = f"one per {first.per}" if first.per else "one" if count == 1 else f"{count}"
        rows.append([effect.name, count_text, size_text.rstrip(), effect.equation])
    return make_table(
        ["effect", "coefficients", "plausible size", "equation"], rows, left=2, width=30
    )


def list_forms(effects: Iterable[Effect]) -> Iterator[Effect]:
    """Yield each effect, followed by its alternative forms."""
    for effect in effects:
        yield from (effect, *effect.forms)


class Basis(NamedTuple):
    """An effect's basis function, with its number of columns and the effect's name."""

    function: Callable[..., Float[Array, "n"] | Float[Array, "n p"] | float]
    count: int
    effect: str

    def evaluate(
        self, frame: Frame, shapes: Mapping[str, Any], batch_shape: tuple[int, ...] = ()
    ) -> Float[Array, "*s n p"]:
        """Evaluate the basis as a matrix of `count` columns (*b, n, p); raise ModelError for another number.

        With NumPy, shapes may be arrays (*b, 1), `batch_shape` being *b: the leading axes of the result.
        """
        columns = xp.asarray(self.function(frame, **shapes), dtype=float)
        if columns.ndim < 2 + len(batch_shape):
            columns = xp.broadcast_to(columns, (*batch_shape, frame.size))[..., None]
        if columns.shape != (*batch_shape, frame.size, self.count):
            raise ModelError(
                f"effect {self.effect!r}: its basis returned shape {columns.shape}; with {self.count} coefficient(s) "
                f"and {frame.size} readings it must return {(frame.size, self.count)}"
            )
        return columns
