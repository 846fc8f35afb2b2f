"""A calibrated instrument in use: the equation of one reading, what the posterior says of it, and its inverse.

In use there is no test rig: slots that `Use.slots` leaves out do not act, and every run, cell or (unless it is
named) device is a new one, whose deviation is drawn from its spread. What is left is one function of numbers,

    output = point(θ, stimulus, inputs),

θ the coefficients and shapes that act, `inputs` the covariates of that reading; the past of a record enters as
inputs too (`temperature_rate`, `temperature_lag`, `elapsed`).

It is solved for the stimulus of each reading, for draws of θ or to first order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import InputError, ModelError
from bayescal._core.inverse import settled
from bayescal._core.jit import compiled
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._model import forward
from bayescal._model.composition import Traced, compose, live
from bayescal._model.frame import Frame
from bayescal._model.instrument import Use
from bayescal._model.noise_law import scores_of_tails
from bayescal._model.parameters import CoefficientBlock, Layout, member_name
from bayescal._model.terms import terms_of

NOT_INPUTS = ("output", "output_uncertainty", "temperature_point")
Scalars = dict[str, Float[Array, ""]]


class Lag(NamedTuple):
    """One T̃ − T that the equation asks for."""

    column: str  # the temperature that is lagged
    tau: float  # time constant, s, at the posterior mean
    shape: str | None  # name of the unknown that tau is a multiple of; None for a constant
    name: str  # of the input that carries it
    multiple: float = 1.0  # τ over that unknown

    @property
    def slope(self) -> str | None:
        """Name of the input that carries ∂(T̃ − T)/∂τ, °C/s; None where τ is no unknown."""
        return None if self.shape is None else f"{self.name}_by_tau"


@dataclass(frozen=True, eq=False)
class OneReading(Frame):
    """One reading as a frame; lags come from outside, in the order in which bases ask for them."""

    lags: tuple[Float[Array, "n"], ...] = ()
    asked: list[tuple[str, Any]] = field(default_factory=list)

    def behind(self, tau, name="temperature"):
        self.asked.append((name, tau))
        place = len(self.asked) - 1
        return self.lags[place] if place < len(self.lags) else jnp.zeros(self.size)


class UnknownInUse(NamedTuple):
    """One unknown that acts in use."""

    name: str  # of the coefficient or shape; "(new run)" beside it for a deviation not measured
    key: str  # under which the equation finds it
    unit: str  # in which it is reported
    kind: str  # "coefficient", "shape", or "new" for one drawn anew in use


class OperatingEquation(eqx.Module):
    """The measurement equation of a bound model for one reading in use, and its inverse."""

    reference: Scalars  # constants of the bases
    layout: Layout  # the model, with one member of every group: that which is in use
    # (group, member) chosen by name, such as ("device", "A17"); others are new
    members: tuple[tuple[str, str], ...] = eqx.field(static=True)
    known: tuple[str, ...] = eqx.field(static=True)  # numeric columns of the readings of the fit
    rated: tuple[tuple[str, str], ...] = eqx.field(static=True)  # (rate's input, temperature)
    lags: tuple[Lag, ...] = eqx.field(static=True, default=())  # what the equation asks of the past
    # which of them, in the order in which bases ask; one may be asked for by several
    asked: tuple[int, ...] = eqx.field(static=True, default=())
    # (name, value, unit) of inputs that only improbable effects need: they are held at one place
    held_inputs: tuple[tuple[str, float, str], ...] = eqx.field(static=True, default=())

    @property
    def use(self) -> Use:
        use = self.layout.model.instrument.use
        assert use is not None
        return use

    @property
    def blocks(self) -> tuple[CoefficientBlock, ...]:
        """Coefficients that act in use."""
        own = [s.name for s in self.layout.model.instrument.slots]
        acting = self.use.slots or tuple(own)
        return tuple(b for b in self.layout.blocks if b.slot in acting or b.slot not in own)

    def unknowns(self) -> tuple[UnknownInUse, ...]:
        """What the equation is a function of beside stimulus and inputs, effect by effect."""
        fixed, found, seen = dict(self.layout.model.fixed), [], []
        for b in self.blocks:
            if b.effect.name not in seen:
                seen.append(b.effect.name)
                for shape in b.effect.shapes:
                    name = b.effect.shape_name(shape)
                    if name not in fixed:
                        found.append(UnknownInUse(name, name, shape.unit, "shape"))
            if b.place == "fixed":
                continue
            name, kind, per = b.name, "coefficient", b.coefficient.per
            if per is not None:
                member = dict(self.members).get(per)
                name = member_name(b.name, member or "new " + per)
                kind = "new" if member is None else kind
            found.append(UnknownInUse(name, b.name, b.coefficient.unit, kind))
        return tuple(found)

    @property
    def names(self) -> tuple[str, ...]:
        """Every input that there could be."""
        return (
            *self.known,
            *(n for n, _ in self.rated),
            *(lag.name for lag in self.lags),
            *(lag.slope for lag in self.lags if lag.slope),
        )

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Inputs that the output, or its noise, depends on."""
        (theta, inputs), one = self.ones(), jnp.ones(())
        law = dict.fromkeys(self.layout.model.noise.parameters(), one)
        keep = live(lambda i: (self.point(theta, one, i), self.noise_variance(law, one, i)), inputs)
        return tuple(n for n, k in zip(sorted(inputs), keep, strict=True) if k)

    @cached_property
    def affine(self) -> bool:
        """Whether the output is a straight line in the stimulus, by its traced derivative."""
        theta, inputs = self.ones()
        return not live(jax.grad(lambda s: self.point(theta, s, inputs)), jnp.ones(()))[0]

    def ones(self) -> tuple[Scalars, Scalars]:
        """θ by key, and the inputs by name, to trace the equation with."""
        theta = {u.key: jnp.ones(()) for u in self.unknowns()}
        return theta, {n: jnp.ones(()) for n in self.names}

    def named(self, theta: Float[Array, "p"]) -> Scalars:
        """θ by key."""
        return {u.key: theta[i] for i, u in enumerate(self.unknowns())}

    def point(
        self, theta: Scalars, stimulus: Float[Array, ""], inputs: Scalars, slot: str | None = None
    ) -> Float[Array, ""]:
        """Return the expected output of one reading, output unit, or what one slot comes to, in the slot's unit.

        Args:
            theta: unknowns by their key, in reported units.
            stimulus: in its unit.
            inputs: by name, in fixed units.
            slot: by name; None for the output.
        """
        moved = {**inputs, **{name: jnp.asarray(value) for name, value, _ in self.held_inputs}}
        for lag in self.lags:  # given at the mean of its τ, taken at the τ of θ to first order
            if lag.shape is not None and lag.slope in moved:
                away = lag.multiple * theta[lag.shape] - lag.tau
                moved[lag.name] = moved[lag.name] + moved[lag.slope] * away
        slots, corrected = self._composed(theta, self.one_reading(stimulus, moved))
        if slot is not None:
            found = slots[slot]
        elif self.use.equation is None:
            found = self.layout.model.instrument.response(slots, corrected)
        else:
            found = self.use.equation(jnp.reshape(stimulus, (1,)), slots, corrected)
        return jnp.reshape(found, ())

    def noise_variance(
        self, law: Scalars, stimulus: Float[Array, ""], inputs: Scalars
    ) -> Float[Array, ""]:
        """Return the variance of one reading's noise by the noise law, whose parameters are `law`, output unit squared.

        What is known of the uncertainty of a single reading is not in it.
        """
        frame = self.one_reading(stimulus, inputs)
        return jnp.reshape(self.layout.model.noise.variance(law, frame), ())

    def one_reading(self, stimulus: Float[Array, ""], inputs: Scalars) -> OneReading:
        """One reading as bases see it; arguments as of `point`."""
        one = {name: jnp.reshape(value, (1,)) for name, value in inputs.items()}
        columns = {n: one[n] for n in self.known if n in one}
        columns[self.use.stimulus] = jnp.reshape(stimulus, (1,))
        rates = {c: one[n] for n, c in self.rated if n in one and n not in columns}
        return OneReading(
            columns=columns,
            labels={f"{group}={member}": jnp.ones(1) for group, member in self.members},
            rates=rates,
            codes={group: jnp.zeros(1, int) for group, _ in self.layout.counts},
            reference=self.reference,
            order=jnp.zeros(1, int),
            step=-jnp.ones(1),
            record=dict(columns),
            silence=jnp.asarray(jnp.inf),
            lags=tuple(one[self.lags[i].name] for i in self.asked),
        )

    def slope_calibrated(self, calibration: Calibration) -> bool:
        """Whether an unknown acts on how the output follows the stimulus."""
        inputs = {n: jnp.ones(()) for n in self.names}
        slope = jax.grad(self.point, argnums=1)
        found = jax.grad(slope)(_theta(self, calibration), jnp.ones(()), inputs)
        return any(bool(value != 0) for value in found.values())

    def asked_of_the_past(self, theta: Scalars) -> list[tuple[str, float]]:
        """The (column, time constant) of every lag that a basis asks for, in order."""
        frame = self.one_reading(jnp.zeros(()), {n: jnp.ones(()) for n in self.names})
        self._composed(theta, frame)
        return [(column, float(tau)) for column, tau in frame.asked]

    def _composed(self, theta: Scalars, frame: OneReading) -> tuple[forward.Values, Frame]:
        """Slots and corrected readings; corrections of columns that do not exist in use are left out."""
        fixed = {name: jnp.asarray(value) for name, value in self.layout.model.fixed}
        held = {b.name: jnp.asarray(b.value) for b in self.blocks if b.place == "fixed"}
        known = {**held, **fixed, **theta}
        source = Traced(self.layout.model.instrument, frame)
        acting = [b for b in self.blocks if b.slot in source.slots or b.slot in frame.columns]
        values = [jnp.reshape(known[b.name], (1,)) for b in acting]
        made = compose(source, terms_of(acting)[0], values, known)
        slots = {name: made.slots.get(name, jnp.zeros(1)) for name in source.slots}
        return slots, source.moved(made.moves)


def equation_in_use(
    calibration: Calibration, members: Mapping[str, str] | None = None
) -> OperatingEquation:
    """A calibrated model in use.

    Raises:
        ModelError: the instrument does not say what it measures.
        InputError: a member that the fit did not see.
    """
    instrument, members = calibration.model.instrument, dict(members or {})
    if instrument.use is None:
        raise ModelError(
            f"instrument {instrument.name!r} does not say which quantity it measures in use, so that no "
            "reading can be compensated: give it use=bayescal.Use(stimulus, unit)"
        )
    for group, member in members.items():
        known = calibration.levels.get(group) or (
            calibration.readings.groups(group)[0] if calibration.readings.has(group) else ()
        )
        if member not in known:
            raise InputError(
                f"{group} {member!r} was not in the calibration; it has: {', '.join(known) or 'none'}"
            )
    frame = calibration.frame
    not_inputs = (*NOT_INPUTS, instrument.use.stimulus)
    known = tuple(sorted(n for n in frame.columns if n not in not_inputs))
    one_each = tuple((group, 1) for group, _ in calibration.layout.counts)
    found = OperatingEquation(
        reference=frame.reference,
        layout=replace(calibration.layout, counts=one_each, origin=()),
        members=tuple(sorted(members.items())),
        known=known,
        rated=tuple((f"{n}_rate", n) for n in frame.rates),
    )
    return _with_lags_of(found, calibration)


def _with_lags_of(found: OperatingEquation, calibration: Calibration) -> OperatingEquation:
    """Ask the equation, at the posterior mean, which lags it needs: one state for each column and time."""
    theta = _theta(found, calibration)
    lags, order = dict[tuple[str, float], Lag](), found.asked_of_the_past(theta)
    # Which unknown a time is a multiple of is told by moving it: times are proportional to the shapes they hang on.
    moved = {
        u.key: found.asked_of_the_past({**theta, u.key: 2.0 * theta[u.key]})
        for u in found.unknowns()
        if order and u.kind == "shape"
    }
    for i, (column, tau) in enumerate(order):
        if (column, tau) in lags:
            continue
        shape = next((key for key, then in moved.items() if then[i][1] != tau), None)
        same = sum(lag.column == column for lag in lags.values())
        name = f"{column}_lag" + (f"_{same + 1}" if same else "")
        multiple = 1.0 if shape is None else tau / float(theta[shape])
        lags[column, tau] = Lag(column, tau, shape, name, multiple)
    places = [*lags]
    return replace(found, lags=(*lags.values(),), asked=tuple(places.index(one) for one in order))


def _theta(equation: OperatingEquation, calibration: Calibration) -> dict[str, Array]:
    """Posterior means of the unknowns in use, by their key; of a new member, that of its prior."""
    prior = {b.name: float(b.coefficient.mean) for b in equation.blocks}

    def mean(u: UnknownInUse) -> float:
        return prior[u.key] if u.kind == "new" else calibration.samples(u.name).mean()

    return {u.key: jnp.asarray(mean(u)) for u in equation.unknowns()}


ALL_DRAWS = 10**9  # draws: every one there is


class PosteriorMoments(NamedTuple):
    """What the posterior says of θ: draws (d, p), mean (p,), covariance (p, p), reported units."""

    draws: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def posterior_moments(
    equation: OperatingEquation, calibration: Calibration, draws: int
) -> PosteriorMoments:
    """Draws of θ, at most `draws` of them evenly thinned; mean and covariance from all, which coefficients' draws have.

    A deviation that is new in use is independent of everything measured, and so are its draws: they move no mean and no
    covariance, so that what is computed from draws and from moments agrees.
    """
    unknowns, blocks = equation.unknowns(), {b.name: b for b in equation.blocks}
    total, random = len(calibration.draws().x), np.random.default_rng(calibration.seed)
    step = max(1, -(-total // draws))
    values, mean = np.zeros((total, len(unknowns))), np.zeros(len(unknowns))
    new = [i for i, u in enumerate(unknowns) if u.kind == "new"]
    for i, u in ((i, u) for i, u in enumerate(unknowns) if i not in new):
        values[:, i] = calibration.samples(u.name)
        mean[i] = values[:, i].mean()
    thin = values[::step].copy()
    covariance = np.atleast_2d(np.cov(values.T)) if len(unknowns) else np.zeros((0, 0))
    for i in new:
        block = blocks[unknowns[i].key]
        spread = _spread(calibration, block) * calibration.having[block.effect.name]
        mean[i], covariance[i, i] = block.coefficient.mean, float(np.mean(spread**2))
        thin[:, i] = mean[i] + _independent(thin - mean, spread[::step], covariance[i, i], random)
    # A shape moved so may leave its range.
    linear = [i for i, u in enumerate(unknowns) if u.kind != "shape"]
    if step > 1:
        own = mean[linear], covariance[np.ix_(linear, linear)]
        thin[:, linear] = _with_moments(thin[:, linear], *own)
    return PosteriorMoments(thin, mean, covariance)


# Draws, and readings, over which the size of what is left out is known well enough.
SIZE_DRAWS = 200


def left_out(
    equation: OperatingEquation, calibration: Calibration, inputs: Mapping[str, np.ndarray]
) -> float:
    """Return what the output lacks where inputs are held at one place, rms over draws and readings of the fit.

    Args:
        equation, calibration: in use, and that it is of.
        inputs: at the readings of the fit, those that are held among them, (n,) each.
    """
    rows = slice(None, None, -(-len(calibration.readings) // SIZE_DRAWS))
    acting = {**inputs, equation.use.stimulus: _stimulus(equation, calibration)}
    at = _places(equation, {n: v[rows] for n, v in acting.items()})
    theta = jnp.asarray(posterior_moments(equation, calibration, SIZE_DRAWS).draws)
    each = (
        points_over_draws(one, theta, *at) for one in (replace(equation, held_inputs=()), equation)
    )
    return float(np.sqrt(np.mean(np.subtract(*each) ** 2)))


def _stimulus(equation: OperatingEquation, calibration: Calibration) -> Float[np.ndarray, "n"]:
    """Return the stimulus of each reading of the fit; zero where it is no column."""
    readings, name = calibration.readings, equation.use.stimulus
    return readings[name] if readings.has(name) else np.zeros(len(readings))


def _independent(
    others: Float[np.ndarray, "d p"],
    spread: Float[np.ndarray, "d"],
    variance: float,
    random: np.random.Generator,
) -> Float[np.ndarray, "d"]:
    """Draws of mean zero, of a standard deviation each and a variance of all, that are correlated with no others."""
    size = others.std(axis=0)
    others = others[:, size > 0] / size[size > 0]
    others = others[:, : len(spread) // 2]  # of a handful of draws few
    beside = spread[:, None] * np.column_stack([np.ones(len(spread)), others])
    normal = random.standard_normal(len(spread))
    drawn = spread * (normal - beside @ np.linalg.lstsq(beside, normal, rcond=None)[0])
    square = float(drawn @ drawn) / (len(drawn) - 1)
    return drawn * (variance / square) ** 0.5 if square > 0 else drawn


def _with_moments(
    draws: Float[np.ndarray, "d p"],
    mean: Float[np.ndarray, "p"],
    covariance: Float[np.ndarray, "p p"],
) -> Float[np.ndarray, "d p"]:
    """Draws moved, linearly and by what thinning has changed, so that mean and covariance are those of all.

    What is computed from draws and by propagation is then the same where the equation is linear.
    """
    sd = np.sqrt(np.diag(covariance))
    moving = np.flatnonzero(sd > 0)
    if len(draws) <= 2 * len(moving):
        return draws
    away = (draws - draws.mean(axis=0))[:, moving] / sd[moving]
    there = covariance[np.ix_(moving, moving)] / np.outer(sd[moving], sd[moving])
    roots = []
    for matrix in (away.T @ away / (len(draws) - 1), there):
        values, vectors = np.linalg.eigh(matrix)
        roots.append((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    moved = np.tile(mean, (len(draws), 1))
    moved[:, moving] += away @ np.linalg.pinv(roots[0], hermitian=True) @ roots[1] * sd[moving]
    return moved


def _spread(calibration: Calibration, block: CoefficientBlock) -> Float[np.ndarray, "d"]:
    """Draws of the standard deviation from which a new member is taken."""
    problem, (_, v) = calibration.problem, calibration.draws()
    own = (block.effect.name, block.index)
    term = next(t for t in problem.terms if (t.effect.name, t.index) == own)
    return problem.member_sd(term, problem.hyper(v.T), len(v))


@compiled
def over_draws(equation: OperatingEquation, theta, output, inputs, record):
    """Mean and variance of the stimulus over draws of θ, and the mean square of its slope, (n,) each."""

    def add(state, one):
        count, mean, square, slope = state
        found, inclination = _inverted(equation, one, output, inputs, record)
        count = count + 1
        step = found - mean
        mean = mean + step / count
        return (count, mean, square + step * (found - mean), slope + inclination**-2), None

    zero = jnp.zeros_like(output)
    (count, mean, square, slope), _ = jax.lax.scan(add, (0.0, zero, zero, zero), theta)
    return mean, square / jnp.maximum(count - 1, 1), slope / count


@compiled
def linearised(equation: OperatingEquation, theta, stimulus, inputs):
    """Expected output at each place and its slope by the stimulus, (n,) each; its gradient by θ, (n, p)."""

    def at(s, i):
        value, (gradient, slope) = jax.value_and_grad(
            lambda theta, s: equation.point(equation.named(theta), s, i), argnums=(0, 1)
        )(theta, s)
        return value, slope, gradient

    return jax.vmap(at)(stimulus, inputs)


@compiled
def first_order(equation: OperatingEquation, theta, covariance, output, inputs):
    """Stimulus at θ, its variance by first-order propagation, and its squared slope by the output, (n,) each."""
    found, inclination = _inverted(equation, theta, output, inputs, None)
    *_, gradient = linearised(equation, theta, found, inputs)
    variance = jnp.einsum("ni,ij,nj->n", gradient, covariance, gradient)
    return found, variance / inclination**2, inclination**-2


@compiled
def errors_over_draws(equation: OperatingEquation, theta, mean, stimulus, inputs):
    """Corrected reading minus stimulus where θ is what a draw says and the correction is made with its mean, (d, n).

    With them 1/|slope| of the output by the stimulus, (n,). A reading has no noise here.
    """

    def error(one):
        output = _points(equation, one, stimulus, inputs)
        return _inverted(equation, mean, output, inputs, None)[0] - stimulus

    _, slope, _ = linearised(equation, mean, stimulus, inputs)
    return jax.vmap(error)(theta), 1 / jnp.abs(slope)


@compiled
def points_over_draws(equation: OperatingEquation, theta, stimulus, inputs, slot=None):
    """The expected output, or what a slot comes to, at each place, for draws of θ, (d, n)."""
    return jax.vmap(lambda one: _points(equation, one, stimulus, inputs, slot))(theta)


def _points(equation: OperatingEquation, theta, stimulus, inputs, slot=None):
    named = equation.named(theta)
    return jax.vmap(lambda s, i: equation.point(named, s, i, slot))(stimulus, inputs)


def _inverted(equation: OperatingEquation, theta, output, inputs: Scalars, record: Frame | None):
    """Stimulus and the slope of the output by it, reading by reading, NaN where there is none; lags of the record."""
    named, own = equation.named(theta), _with_lags(equation, theta, inputs, record)

    def one(y, i):
        return settled(lambda s: equation.point(named, s, i), y, equation.affine)

    return jax.vmap(one)(output, own)


def _with_lags(
    equation: OperatingEquation, theta, inputs: Scalars, record: Frame | None
) -> Scalars:
    """The inputs with the lags of a record, for the time constants in θ."""
    if record is None:
        return inputs
    named, found = equation.named(theta), dict(inputs)
    for lag in equation.lags:
        if lag.name not in found:
            tau = lag.multiple * named[lag.shape] if lag.shape else jnp.asarray(lag.tau)
            found[lag.name] = record.lag(tau, lag.column)
            if lag.slope:
                found[lag.slope] = jnp.zeros_like(found[lag.name])  # it is at this τ already
    return found


def solved(
    equation: OperatingEquation,
    moments: PosteriorMoments,
    given: Mapping[str, np.ndarray],
    record: Frame | None,
    *,
    by_draws: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stimulus, its variance from the calibration, and its squared slope by the output, (n,) each.

    Args:
        equation, moments: in use, and what the posterior says of θ.
        given: output and inputs by name, (n,) each.
        record: that lags follow from; None where they are given.
        by_draws: over draws of θ; else to first order.
    """
    output = jnp.asarray(given["output"])
    inputs = {
        n: jnp.asarray(given[n]) if n in equation.inputs else jnp.zeros(len(output))
        for n in equation.names
    }
    if by_draws:
        if record is not None:  # lags at the time constants of each draw
            for lag in (lag for lag in equation.lags if lag.name in equation.inputs):
                del inputs[lag.name]
        found = over_draws(equation, jnp.asarray(moments.draws), output, inputs, record)
    else:
        mean, covariance = jnp.asarray(moments.mean), jnp.asarray(moments.covariance)
        found = first_order(equation, mean, covariance, output, inputs)
    value, variance, inclination = map(np.asarray, found)
    return value, variance, inclination


class NoiseInUse(NamedTuple):
    """What the posterior says of the noise law in use."""

    law: dict[str, Any]  # its parameters by name, at the posterior mean of their coordinates
    level: float  # posterior mean of the variance over the readings of the fit, over the variance by `law` there


NOISE_READINGS, NOISE_DRAWS = 200, 2000  # over which the level of the noise is averaged
SCORE_DRAWS = 100  # over which the distribution of one reading is


def noise_in_use(
    equation: OperatingEquation, calibration: Calibration, inputs: Mapping[str, np.ndarray]
) -> NoiseInUse:
    """Return the noise law of a calibration as it is used; `inputs` are those of the readings of the fit, (n,) each."""
    layout, (_, v) = calibration.layout, calibration.draws(NOISE_DRAWS)
    rows = slice(None, None, -(-len(calibration.readings) // NOISE_READINGS))
    acting = {equation.use.stimulus: _stimulus(equation, calibration)}
    places = _places(equation, {n: x[rows] for n, x in (acting | dict(inputs)).items()})
    law = forward.hyper_values(layout, jnp.asarray(v.mean(axis=0)))
    each = jax.vmap(lambda v: forward.hyper_values(layout, v))(jnp.asarray(v))
    over_draws = jax.vmap(lambda law: jnp.mean(_over_places(equation, law, *places)))(each)
    there = jnp.mean(_over_places(equation, law, *places))
    level = float(jnp.mean(over_draws) / there) if there > 0 else 1.0  # 0: noise as stated
    return NoiseInUse({n: float(x) for n, x in law.items()}, level)


def noise_variances(
    equation: OperatingEquation, noise: NoiseInUse, places: Mapping[str, np.ndarray]
) -> Float[np.ndarray, "n"]:
    """Return the variance of one reading's noise, output unit squared; `places` are stimulus and inputs, (n,) each."""
    at = _places(equation, places)
    return noise.level * np.asarray(_over_places(equation, noise.law, *at))


def noise_scores(
    equation: OperatingEquation,
    calibration: Calibration,
    places: Mapping[str, np.ndarray],
    deviations: Float[np.ndarray, "n m"],
) -> Float[np.ndarray, "n m"]:
    """Return standard normal scores of the predictive probability that one reading's noise is below a deviation."""
    at, (_, v) = _places(equation, places), calibration.draws(SCORE_DRAWS)
    return np.asarray(_scores_over_draws(equation, jnp.asarray(v), jnp.asarray(deviations), *at))


def _places(equation: OperatingEquation, places: Mapping[str, np.ndarray]) -> tuple[Array, Scalars]:
    stimulus = places[equation.use.stimulus]
    inputs = {n: jnp.asarray(places.get(n, 0.0 * stimulus)) for n in equation.names}
    return jnp.asarray(stimulus), inputs


@compiled
def _over_places(equation: OperatingEquation, law: Scalars, stimulus, inputs):
    return jax.vmap(lambda s, i: equation.noise_variance(law, s, i))(stimulus, inputs)


@compiled
def _scores_over_draws(equation: OperatingEquation, v, deviations, stimulus, inputs):
    noise = equation.layout.model.noise

    def scores(law: Scalars, s, i, left):
        frame = equation.one_reading(s, i)
        return jax.vmap(lambda e: noise.normal_scores(e[None], law, frame)[0])(left)

    def of_draw(v):
        law = forward.hyper_values(equation.layout, v)
        return jax.vmap(lambda *at: scores(law, *at))(stimulus, inputs, deviations)

    # Of the smaller tail, which keeps its digits far out.
    tails = jnp.mean(jax.vmap(lambda v: ndtr(-jnp.abs(of_draw(v))))(v), axis=0)
    return scores_of_tails(tails, deviations)
