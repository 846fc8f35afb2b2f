"""A calibrated instrument in use: one reading's equation, what it needs, and what is known of it.

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
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import InputError, ModelError
from bayescal._model.frame import Frame
from bayescal._model.instrument import Use
from bayescal._model.parameters import CoefficientBlock, Layout, member_name

OUTPUT = "output"
NOT_INPUTS = (OUTPUT, "output_uncertainty", "temperature_point")
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


class _UseFrame(Frame):
    """One reading as a frame; lags come from outside, in the order in which bases ask for them."""

    lags: tuple[Float[Array, "n"], ...] = ()
    asked: list[tuple[str, Any]] = eqx.field(static=True, default_factory=list)

    def lag(self, tau, name="temperature"):
        self.asked.append((name, tau))
        place = len(self.asked) - 1
        given = self.lags[place] if place < len(self.lags) else jnp.zeros(self.size)
        return given + (self.record[name] - self.columns[name])


class Entry(NamedTuple):
    """One unknown that acts in use.

    Attributes:
        name: of the coefficient or shape; "(new run)" beside it for a deviation not measured.
        key: under which the equation finds it.
        unit: in which it is reported.
        effect: that it belongs to.
        kind: "coefficient", "shape", or "new" for one drawn anew in use.
    """

    name: str
    key: str
    unit: str
    effect: str
    kind: str


class InUse(eqx.Module):
    """The measurement equation of a bound model for one reading in use. It has no arrays.

    Attributes:
        layout: the model.
        members: (group, member) chosen by name, such as ("device", "A17"); others are new.
        levels: (group, members known to the fit).
        known: numeric columns and rates of the readings of the fit.
        lags: what the equation asks of the past.
    """

    layout: Layout
    members: tuple[tuple[str, str], ...] = eqx.field(static=True)
    levels: tuple[tuple[str, tuple[str, ...]], ...] = eqx.field(static=True)
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

    def entries(self) -> tuple[Entry, ...]:
        fixed, found, seen = dict(self.layout.model.fixed), [], []
        for b in self.blocks:
            if b.effect.name not in seen:
                seen.append(b.effect.name)
                for shape in b.effect.shapes:
                    name = b.effect.shape_name(shape)
                    if name not in fixed:
                        found.append(Entry(name, name, shape.unit, b.effect.name, "shape"))
            if b.place == "fixed":
                continue
            name, kind, per = b.name, "coefficient", b.coefficient.per
            if per is not None:
                member = dict(self.members).get(per)
                name = member_name(b.name, member or "new " + per)
                kind = "new" if member is None else kind
            found.append(Entry(name, b.name, b.coefficient.unit, b.effect.name, kind))
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
        theta = {**{name: jnp.asarray(value) for name, value in self.layout.model.fixed}, **theta}
        frame = self._frame(stimulus, inputs, reference)
        instrument = self.layout.model.instrument
        slots = {s.name: jnp.zeros(1) for s in instrument.slots}
        for name, shift in self._sums(theta, frame, correcting=True).items():
            frame = frame.with_column(name, frame[name] + shift)
        slots |= self._sums(theta, frame, correcting=False)
        if self.use.equation is None:
            found = instrument.response(slots, frame)
        else:
            found = self.use.equation(jnp.reshape(stimulus, (1,)), slots, frame)
        return jnp.reshape(found, ())

    def _frame(self, stimulus, inputs: Scalars, reference: Scalars) -> _UseFrame:
        one = {name: jnp.reshape(value, (1,)) for name, value in inputs.items()}
        columns = {n: one[n] for n in self.known if n in one}
        columns[self.use.stimulus] = jnp.reshape(stimulus, (1,))
        rates = {
            n.removesuffix("_rate"): v
            for n, v in one.items()
            if n.endswith("_rate") and n not in columns
        }
        labels = {f"{group}={member}": jnp.ones(1) for group, member in self.members}
        lags = tuple(one[lag.name] for lag in self.lags)
        still = jnp.zeros(1, int), -jnp.ones(1)
        groups: list[str] = ["run", "cell", "axis", "device"]
        codes = dict.fromkeys(groups, -jnp.ones(1, int))
        return _UseFrame(columns, labels, rates, codes, reference, *still, dict(columns), lags, [])

    def _sums(self, theta: Scalars, frame: Frame, correcting: bool) -> Scalars:
        own = [s.name for s in self.layout.model.instrument.slots]
        sums, basis = {}, None
        for b in self.blocks:
            if (b.slot not in own) != correcting or (correcting and b.slot not in frame.columns):
                continue
            if basis is None or basis[0] is not b.effect:
                shapes = {s.name: theta[b.effect.shape_name(s)] for s in b.effect.shapes}
                basis = (b.effect, b.effect.evaluate(frame, shapes))
            value = theta[b.name] if b.place != "fixed" else b.value
            sums[b.slot] = sums.get(b.slot, 0.0) + basis[1][:, b.index] * b.factor * value
        return sums


def in_use(calibration: Calibration, members: Mapping[str, str] | None = None) -> InUse:
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
    found = InUse(
        calibration.layout, tuple(sorted(members.items())), tuple(calibration.levels.items()), known
    )
    return replace(found, lags=_lags(found, calibration))


def _lags(found: InUse, calibration: Calibration) -> tuple[Lag, ...]:
    """Ask the equation once, at the posterior mean, which lags it needs."""
    theta = {
        e.key: jnp.asarray(m)
        for e, m in zip(found.entries(), _means(found, calibration), strict=True)
    }
    fixed = {name: jnp.asarray(value) for name, value in calibration.model.fixed}
    inputs = {n: jnp.ones(()) for n in input_names(found, calibration.frame)}
    frame = found._frame(jnp.zeros(()), inputs, calibration.frame.reference)
    for correcting in (True, False):
        found._sums({**fixed, **theta}, frame, correcting)
    lags: list[Lag] = []
    for column, tau in frame.asked:
        tau = float(tau)
        shape = next(
            (e.key for e in found.entries() if e.kind == "shape" and float(theta[e.key]) == tau),
            None,
        )
        same = sum(lag.column == column for lag in lags)
        lags.append(Lag(column, tau, shape, f"{column}_lag" + (f"_{same + 1}" if same else "")))
    return tuple(lags)


def input_names(found: InUse, frame: Frame) -> list[str]:
    return [*found.known, *(f"{n}_rate" for n in frame.rates), *(lag.name for lag in found.lags)]


def _samples(found: InUse, calibration: Calibration, entry: Entry) -> np.ndarray:
    """Draws of one entry that the posterior knows."""
    values = calibration.samples(entry.key)
    if values.ndim == 1:
        return values
    per = next(b.coefficient.per for b in found.blocks if b.name == entry.key)
    assert per is not None
    return values[:, calibration.levels[per].index(dict(found.members)[per])]


def _spread(calibration: Calibration, block: CoefficientBlock, draws: int) -> np.ndarray:
    """Draws of the standard deviation from which a new member is taken."""
    c, fixed = block.coefficient, dict(calibration.model.fixed)
    if c.spread is None:
        return np.full(draws, c.size)
    if block.spread_name in fixed:
        return np.full(draws, fixed[block.spread_name])
    return calibration.samples(block.spread_name)


def _means(found: InUse, calibration: Calibration) -> list[float]:
    blocks = {b.name: b for b in found.blocks}
    return [
        blocks[e.key].coefficient.mean
        if e.kind == "new"
        else float(_samples(found, calibration, e).mean())
        for e in found.entries()
    ]


class Known(NamedTuple):
    """What the posterior says of θ: draws (d, p), mean (p,), covariance (p, p), reported units."""

    draws: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def known(found: InUse, calibration: Calibration, draws: int, seed: int = 0) -> Known:
    """Draws of θ, at most `draws` of them evenly thinned; mean and covariance from all.

    A deviation that is new in use is independent of everything measured: its draws are standardised, so that
    they move no mean.
    """
    entries, blocks = found.entries(), {b.name: b for b in found.blocks}
    size = calibration.posterior.sizes
    total = size["chain"] * size["draw"]
    random = np.random.default_rng(seed)
    step = max(1, -(-total // draws))
    values, mean, extra = np.zeros((total, len(entries))), np.zeros(len(entries)), {}
    thin = values[::step].copy()
    for i, e in enumerate(entries):
        if e.kind == "new":
            block = blocks[e.key]
            spread, centre = _spread(calibration, block, total), block.coefficient.mean
            normal = random.standard_normal(len(thin))
            normal = (normal - normal.mean()) / (normal.std() or 1.0)
            mean[i], extra[i] = centre, float(np.mean(spread**2))
            thin[:, i] = centre + spread[::step] * normal
        else:
            values[:, i] = _samples(found, calibration, e)
            mean[i] = values[:, i].mean()
            thin[:, i] = values[::step, i]
    covariance = np.atleast_2d(np.cov(values.T)) if len(entries) else np.zeros((0, 0))
    for i, variance in extra.items():
        covariance[i, i] = variance
    return Known(thin, mean, covariance)
