"""A calibrated instrument in use: the equation of one reading, and what it needs.

In use there is no test rig: slots that `Use.slots` leaves out do not act, and every run, cell or (unless it is
named) device is a new one, whose deviation is drawn from its spread. What is left is one function of numbers,

    output = point(θ, stimulus, inputs),

θ the coefficients and shapes that act, `inputs` the covariates of that reading; the past of a record enters as
inputs too (`temperature_rate`, `temperature_lag`, `elapsed`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import InputError, ModelError
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.instrument import Use
from bayescal._model.parameters import CoefficientBlock, Layout, member_name

NOT_INPUTS = ("output", "output_uncertainty", "temperature_point")
Scalars = dict[str, Float[Array, ""]]


class Lag(NamedTuple):
    """One T̃ − T that the equation asks for.

    Attributes:
        column: the temperature that is lagged.
        tau: time constant, s, at the posterior mean.
        shape: name of the unknown that tau is; None for a constant.
        name: of the input that carries it.
    """

    column: str
    tau: float
    shape: str | None
    name: str

    @property
    def slope(self) -> str | None:
        """Name of the input that carries ∂(T̃ − T)/∂τ, °C/s; None where τ is no unknown."""
        return None if self.shape is None else f"{self.name}_by_tau"


class OneReading(Frame):
    """One reading as a frame; lags come from outside, in the order in which bases ask for them."""

    lags: tuple[Float[Array, "n"], ...] = ()
    asked: list[tuple[str, Any]] = eqx.field(static=True, default_factory=list)

    def lag(self, tau, name="temperature"):
        self.asked.append((name, tau))
        place = len(self.asked) - 1
        given = self.lags[place] if place < len(self.lags) else jnp.zeros(self.size)
        return given + (self.record[name] - self.columns[name])


class UnknownInUse(NamedTuple):
    """One unknown that acts in use.

    Attributes:
        name: of the coefficient or shape; "(new run)" beside it for a deviation not measured.
        key: under which the equation finds it.
        unit: in which it is reported.
        kind: "coefficient", "shape", or "new" for one drawn anew in use.
    """

    name: str
    key: str
    unit: str
    kind: str


class OperatingEquation(eqx.Module):
    """The measurement equation of a bound model for one reading in use. It has no arrays.

    Attributes:
        layout: the model, with one member of every group: that which is in use.
        members: (group, member) chosen by name, such as ("device", "A17"); others are new.
        known: numeric columns and rates of the readings of the fit.
        lags: what the equation asks of the past.
    """

    layout: Layout
    members: tuple[tuple[str, str], ...] = eqx.field(static=True)
    known: tuple[str, ...] = eqx.field(static=True)
    lags: tuple[Lag, ...] = eqx.field(static=True, default=())

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

    def point(
        self, theta: Scalars, stimulus: Float[Array, ""], inputs: Scalars, reference: Scalars
    ):
        """Expected output of one reading, output unit.

        Args:
            theta: unknowns by their key, in reported units.
            stimulus: in its unit.
            inputs: by name, in fixed units.
            reference: constants of the bases.
        """
        frame = self.one_reading(stimulus, self._with_moved_lags(theta, inputs), reference)
        slots, corrected = self._composed(theta, frame)
        if self.use.equation is None:
            found = self.layout.model.instrument.response(slots, corrected)
        else:
            found = self.use.equation(jnp.reshape(stimulus, (1,)), slots, corrected)
        return jnp.reshape(found, ())

    def slot(
        self,
        name: str,
        theta: Scalars,
        stimulus: Float[Array, ""],
        inputs: Scalars,
        reference: Scalars,
    ) -> Float[Array, ""]:
        """What one slot comes to in one reading, in the slot's unit; the other arguments are those of `point`."""
        frame = self.one_reading(stimulus, self._with_moved_lags(theta, inputs), reference)
        return jnp.reshape(self._composed(theta, frame)[0][name], ())

    def _with_moved_lags(self, theta: Scalars, inputs: Scalars) -> Scalars:
        """The inputs with each lag, given at the mean of its τ, at the τ of θ, to first order."""
        moved = dict(inputs)
        for lag in self.lags:
            if lag.shape is not None and lag.slope in inputs:
                moved[lag.name] = inputs[lag.name] + inputs[lag.slope] * (
                    theta[lag.shape] - lag.tau
                )
        return moved

    def one_reading(
        self, stimulus: Float[Array, ""], inputs: Scalars, reference: Scalars
    ) -> OneReading:
        """One reading as bases see it; arguments as of `point`."""
        one = {name: jnp.reshape(value, (1,)) for name, value in inputs.items()}
        columns = {n: one[n] for n in self.known if n in one}
        columns[self.use.stimulus] = jnp.reshape(stimulus, (1,))
        rates = {
            n.removesuffix("_rate"): v
            for n, v in one.items()
            if n.endswith("_rate") and n not in columns
        }
        return OneReading(
            columns=columns,
            labels={f"{group}={member}": jnp.ones(1) for group, member in self.members},
            rates=rates,
            codes={group: jnp.zeros(1, int) for group, _ in self.layout.counts},
            reference=reference,
            order=jnp.zeros(1, int),
            step=-jnp.ones(1),
            record=dict(columns),
            silence=jnp.asarray(jnp.inf),
            lags=tuple(one[lag.name] for lag in self.lags),
        )

    def slope_calibrated(self, calibration: Calibration) -> bool:
        """Whether an unknown acts on how the output follows the stimulus."""
        names = input_names(self, calibration.frame)
        inputs = {n: jnp.ones(()) for n in names}
        slope = jax.grad(self.point, argnums=1)
        found = jax.grad(slope)(
            _theta(self, calibration), jnp.ones(()), inputs, calibration.frame.reference
        )
        return any(bool(value != 0) for value in found.values())

    def asked_of_the_past(
        self, theta: Scalars, inputs: Scalars, reference: Scalars
    ) -> list[tuple[str, Any]]:
        """The (column, time constant) of every lag that a basis asks for, in order."""
        frame = self.one_reading(jnp.zeros(()), inputs, reference)
        self._composed(theta, frame)
        return frame.asked

    def _composed(self, theta: Scalars, frame: OneReading) -> tuple[forward.Values, Frame]:
        """Slots and corrected readings; corrections of columns that do not exist in use are left out."""
        fixed = {name: jnp.asarray(value) for name, value in self.layout.model.fixed}
        known = {**fixed, **theta}
        own = [s.name for s in self.layout.model.instrument.slots]
        acting = [b for b in self.blocks if b.slot in own or b.slot in frame.columns]
        values = {b.name: jnp.reshape(known[b.name], (1,)) for b in acting}
        slots, corrected, _ = forward.compose(self.layout, frame, values, known, {}, acting)
        return slots, corrected


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
        layout=replace(calibration.layout, counts=one_each),
        members=tuple(sorted(members.items())),
        known=known,
    )
    return replace(found, lags=_lags(found, calibration))


def _lags(found: OperatingEquation, calibration: Calibration) -> tuple[Lag, ...]:
    """Ask the equation once, at the posterior mean, which lags it needs."""
    theta = _theta(found, calibration)
    inputs = {n: jnp.ones(()) for n in input_names(found, calibration.frame)}
    lags: list[Lag] = []
    for column, tau in found.asked_of_the_past(theta, inputs, calibration.frame.reference):
        tau = float(tau)
        shape = next(
            (u.key for u in found.unknowns() if u.kind == "shape" and float(theta[u.key]) == tau),
            None,
        )
        same = sum(lag.column == column for lag in lags)
        lags.append(Lag(column, tau, shape, f"{column}_lag" + (f"_{same + 1}" if same else "")))
    return tuple(lags)


def input_names(equation: OperatingEquation, frame: Frame) -> list[str]:
    """Every input that there could be."""
    return [
        *equation.known,
        *(f"{n}_rate" for n in frame.rates),
        *(lag.name for lag in equation.lags),
        *(lag.slope for lag in equation.lags if lag.slope),
    ]


def samples_in_use(
    equation: OperatingEquation, calibration: Calibration, unknown: UnknownInUse
) -> np.ndarray:
    """Draws of one unknown in use that the posterior knows, (d,), reported unit."""
    values = calibration.samples(unknown.key)
    if values.ndim == 1:
        return values
    per = next(b.coefficient.per for b in equation.blocks if b.name == unknown.key)
    assert per is not None
    return values[:, calibration.levels[per].index(dict(equation.members)[per])]


def _theta(equation: OperatingEquation, calibration: Calibration) -> dict[str, Array]:
    """Posterior means of the unknowns in use, by their key; of a new member, that of its prior."""
    blocks = {b.name: b for b in equation.blocks}
    return {
        u.key: jnp.asarray(
            float(blocks[u.key].coefficient.mean)
            if u.kind == "new"
            else samples_in_use(equation, calibration, u).mean()
        )
        for u in equation.unknowns()
    }
