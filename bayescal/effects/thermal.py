"""Thermal effects: temperature rate, thermal hysteresis (direction of change), thermal lag behind the thermometer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from bayescal._core.xp import xp
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame, build_frame, reference_of
from bayescal._model.prior import HalfNormal, Known, Normal

MIN_DIRECTION_FRACTION = 0.02  # of readings, rising and falling, that identify a hysteresis
WINDOW_RANGE_S = (2.0, 120.0)  # smoothing window of a rate: from two readings to a lag's times
# Two bodies in series: second time constant over the first; above 0.8 indistinguishable from equal ones.
RATIO_RANGE = (0.1, 0.8)
# Two bodies in parallel: time constant of the fast over the slow one; weight of the slow one.
PATH_RATIO_RANGE, PATH_WEIGHT_RANGE = (0.02, 0.6), (0.1, 0.9)
Modes = tuple[tuple[Any, Any], ...]  # exponential modes: (time constant over τ, weight)


class Body(NamedTuple):
    """Thermal response of a body: the step response 1 − Σ wₖ·exp(−t/(mₖ·τ)), Σ wₖ = Σ wₖ·mₖ = 1.

    τ is the delay behind a steady ramp. modes: function of the values of `shapes`, the shapes other than τ, that
    returns the pairs (mₖ, wₖ). equation: text for reports. general: name of the body of which this is a special case.
    """

    modes: Callable[..., Modes]
    equation: str
    shapes: tuple[Shape, ...] = ()
    general: str = ""


def _make_single_mode() -> Modes:
    return ((1.0, 1.0),)


def _make_stage_modes(ratio: Any) -> Modes:
    return (1 / (1 + ratio), 1 / (1 - ratio)), (ratio / (1 + ratio), -ratio / (1 - ratio))


def _make_path_modes(ratio: Any, share: Any) -> Modes:
    slow_tau = 1 / (share + (1 - share) * ratio)
    return (slow_tau, share), (ratio * slow_tau, 1 - share)


def make_slab_modes() -> Modes:
    """Return the first three modes (mₖ, wₖ) of a slab's mean temperature, k = 1, 3, 5, normalised as for `Body`.

    Source: H. Carslaw and J. Jaeger, Conduction of Heat in Solids, 2nd ed. (1959), section 3.3.
    """
    modes = [(k**-2.0, k**-2.0) for k in (1, 3, 5)]
    weight_sum = sum(w for _, w in modes)
    mean_lag = sum(m * w for m, w in modes) / weight_sum
    return tuple((m / mean_lag, w / weight_sum) for m, w in modes)


_SLAB_EQUATION = "T → " + " + ".join(f"{w:.3g}·T̃({m:.3g}·τ)" for m, w in make_slab_modes())
BODIES: Mapping[str, Body] = MappingProxyType(
    {
        "body": Body(_make_single_mode, "T → T̃(τ)"),
        # Two bodies in series: the inner one, of time constant r·τ₁, follows the outer one, of τ₁.
        "two_stages": Body(
            partial(_make_stage_modes, 0.5), "T → 2·T̃(τ₁) − T̃(τ₁/2),  τ₁ = τ/1.5", general="stages"
        ),
        "stages": Body(
            _make_stage_modes,
            "T → (T̃(τ₁) − r·T̃(r·τ₁))/(1 − r),  τ₁ = τ/(1 + r)",
            (Shape("ratio", "1", *RATIO_RANGE, scale="bounded"),),
        ),
        # Two bodies in parallel with weights w (slow, time constant τ₁) and 1 − w (fast, r·τ₁).
        "paths": Body(
            _make_path_modes,
            "T → w·T̃(τ₁) + (1 − w)·T̃(r·τ₁),  τ₁ = τ/(w + (1 − w)·r)",
            (
                Shape("ratio", "1", *PATH_RATIO_RANGE, scale="bounded"),
                Shape("share", "1", *PATH_WEIGHT_RANGE, scale="bounded"),
            ),
        ),
        "diffusion": Body(make_slab_modes, _SLAB_EQUATION),
    }
)
# Plausible width w of a hysteresis loop's reversal: above the fluctuations of a stabilised chamber.
WIDTH_RANGE = (0.2, 5.0, "degC")


def rate(slot: str, size: float, unit: str, *, source: str, column: str = "temperature") -> Effect:
    """Return an effect of the temperature rate, c·dT/dt; `size`: prior standard deviation of c, in `unit`.

    The rate is (T − T̃)/w. T̃ is a first-order low-pass of T, whose time constant w is estimated from the data.
    """
    return Effect(
        f"{slot}.rate",
        slot,
        basis=partial(_evaluate_rate, column),
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        shapes=(Shape("window", "s", *WINDOW_RANGE_S, scale="bounded"),),
        columns=("time", column),
        varies=(column,),
        equation="c·(T − T̃)/w,  w·dT̃/dt = T − T̃",
        source=source,
        along=f"{column} rate",
        kind="rate",
    )


def hysteresis(
    slot: str,
    size: float,
    unit: str,
    *,
    source: str,
    column: str = "temperature",
    widths: tuple[float, float, str] = WIDTH_RANGE,
) -> Effect:
    """Return an effect of hysteresis, c·D: +c while T rises, −c while it falls; D reverses within a change w of T.

    D follows Dahl's hysteresis model, at the lagging body's temperature if the model has one. The unknown initial state
    of a run decays as exp(−∫|dT|/w): one coefficient per run.

    Args:
        size: prior standard deviation of c, in `unit`.
        column: input of the hysteresis.
        widths: plausible range of w and its unit, (low, high, unit); the unit is that of the column.
    """
    return Effect(
        f"{slot}.hysteresis",
        slot,
        basis=partial(_evaluate_hysteresis, column),
        coefficients=(Coefficient(unit, Normal(0.0, size)), _make_initial_state(unit, size)),
        shapes=(Shape("width", widths[2], *widths[:2]),),
        columns=("time", column),
        varies=(column,),
        untestable=partial(_explain_monotonic, column, widths),
        equation="c·D + d[run]·exp(−∫|dT|/w),  dD/dT = (sign(dT) − D)/w",
        source=source,
        kind="hysteresis",
    )


def thermal_lag(
    slot: str,
    size: float,
    unit: str,
    *,
    low: float,
    high: float,
    start: float,
    start_unit: str,
    source: str,
    column: str = "temperature",
    name: str = "thermal_lag",
    bodies: Mapping[str, Body] | None = None,
    short: Effect | None = None,
) -> Effect:
    """Return an effect of thermal lag, c·(T̃ − T), and its forms; T̃ is the temperature of a first-order body.

    It describes a lagging part other than the sensor, such as electronics. In the alternative forms the sensor is at T̃,
    and all effects of temperature use T̃ in place of T; the body is of first order, two bodies in series, two in
    parallel, or heat diffusion. An initial difference from T decays as exp(−t/τ): one coefficient per run, whose
    standard deviation is estimated, with the plausible size `start`.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
        start: plausible standard deviation, between runs, of the initial state's effect, in `start_unit`.
        name: name of the effect after the slot; give another for a second lag.
        bodies: alternative forms with T̃ in place of T, by name; all of `BODIES` if not given.
        short: alternative form if τ is too short to be resolved: the effect returned by `rate`.
    """
    options: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    forms = list[Effect]()
    for form, response in (BODIES if bodies is None else bodies).items():
        lag = body(slot, start, start_unit, behind=response, name=f"{name}.{form}", **options)
        forms.append(replace(lag, general=response.general and f"{slot}.{name}.{response.general}"))
    coefficients = Coefficient(unit, Normal(0.0, size)), _make_initial_state(start_unit, start)
    equation = "c·(T̃ − T) + d[run]·exp(−(t − t_start)/τ),  τ·dT̃/dt = T − T̃"
    lag = _make_lag_effect(slot, name, _evaluate_lag, coefficients, equation, **options)
    return replace(lag, kind="lag", forms=(*forms, *(() if short is None else (short,))))


def body(
    slot: str,
    start: float,
    start_unit: str,
    *,
    low: float,
    high: float,
    source: str,
    behind: Body = BODIES["body"],
    column: str = "temperature",
    name: str = "body",
) -> Effect:
    """Return an effect that replaces the temperature T in all other effects by T̃ of a body that lags T by τ.

    T̃ = Σ wₖ·T̃ₖ with mₖ·τ·dT̃ₖ/dt = T − T̃ₖ: one mode for a first-order body, two for bodies in series or in parallel, a
    series for heat diffusion. Σ wₖ = Σ wₖ·mₖ = 1: τ is the delay behind a ramp. An initial difference from T decays as
    Σ wₖ·exp(−t/(mₖ·τ)): one coefficient per run.

    Args:
        slot: slot that the initial state adds to.
        start: plausible standard deviation, between runs, of the initial state's effect, in `start_unit`.
        low, high: plausible range of τ, s.
        behind: thermal response of the body, of `BODIES`.
        name: name of the effect after the slot.
    """
    coefficients = _make_initial_state(start_unit, start, slot), Coefficient("1", Known(1.0))
    decay_text = behind.equation.removeprefix("T → ").partition(",")[0].replace("T̃", "e")
    equation = f"{behind.equation},  τ·dT̃/dt = T − T̃;  {slot} + d[run]·[{decay_text}],  e(τ) = exp(−(t − t_start)/τ)"
    options: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    basis = partial(_evaluate_body, behind.modes)
    effect = _make_lag_effect(slot, name, basis, coefficients, equation, behind.shapes, **options)
    return replace(effect, slot=column)


def temperature_x_lag(
    slot: str,
    size: float,
    unit: str,
    *,
    low: float,
    high: float,
    source: str,
    column: str = "temperature",
) -> Effect:
    """Return an effect c·(T − T0)·(T̃ − T): a thermal lag whose amplitude is proportional to T − T0.

    Args:
        size: prior standard deviation of c, in `unit`, such as "deg/s/degC^2".
        low, high: plausible range of τ, s.
    """
    coefficients = (Coefficient(unit, Normal(0.0, size)),)
    equation, name = "c·(T − T0)·(T̃ − T),  τ·dT̃/dt = T − T̃", "temperature_x_lag"
    options: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    return _make_lag_effect(slot, name, _evaluate_product, coefficients, equation, **options)


def _make_lag_effect(
    slot: str,
    name: str,
    basis: Callable[[str, Frame, Any], Any],
    coefficients: tuple[Coefficient, ...],
    equation: str,
    shapes: tuple[Shape, ...] = (),
    *,
    low: float,
    high: float,
    source: str,
    column: str,
) -> Effect:
    """Return an effect with a lag time τ, plausibly `low` to `high`, s, which all channels of a device share."""
    return Effect(
        f"{slot}.{name}",
        slot,
        basis=partial(basis, column),
        coefficients=coefficients,
        shapes=(Shape("tau", "s", low, high, shared=True), *shapes),
        columns=("time", column),
        varies=(column,),
        untestable=partial(_explain_too_short, low),
        equation=equation,
        source=source,
    )


def _make_initial_state(unit: str, size: float, slot: str | None = None) -> Coefficient:
    """Return the coefficient of a run's initial state: one per run, with a learned standard deviation."""
    options = {"per": "run", "group_sd": HalfNormal(size), "initial": True}
    return Coefficient(unit, Normal(0.0, size), part="start", slot=slot, **options)


def _evaluate_rate(column: str, frame: Frame, window: Any) -> Any:
    return -frame.recorded_lag(window, column) / window


def _evaluate_hysteresis(column: str, frame: Frame, width: Any) -> Any:
    return xp.stack(frame.direction(width, column), axis=-1)


def _evaluate_body(
    modes: Callable[..., Modes],
    column: str,
    frame: Frame,
    tau: Any,
    ratio: Any = None,
    share: Any = None,
) -> Any:
    """Return two basis columns of a body, the decay of its initial state and T̃ − T (n, 2), for given shapes."""
    pairs = modes(*(value for value in (ratio, share) if value is not None))
    lag = sum(w * frame.recorded_lag(m * tau, column) for m, w in pairs)
    return xp.stack([sum(w * xp.exp(-frame.elapsed / (m * tau)) for m, w in pairs), lag], axis=-1)


def _evaluate_lag(column: str, frame: Frame, tau: Any) -> Any:
    return xp.stack([frame.lag(tau, column), xp.exp(-frame.elapsed / tau)], axis=-1)


def _evaluate_product(column: str, frame: Frame, tau: Any) -> Any:
    return frame.centred(column) * frame.lag(tau, column)


def _explain_monotonic(column: str, widths: Any, readings: Measurements) -> str | None:
    """Return why a hysteresis is unidentified: the column does not both rise and fall within runs; None if it does."""
    frame = build_frame(readings, reference_of(readings))
    direction = np.asarray(frame.direction(math.sqrt(math.prod(widths[:2])), column)[0])
    fractions = (direction > 0.5).mean(), (direction < -0.5).mean()
    does_rise, does_fall = (fraction >= MIN_DIRECTION_FRACTION for fraction in fractions)
    if does_rise and does_fall:
        return None
    change = "only rises" if does_rise else "only falls" if does_fall else "is constant"
    return f"needs {column} to rise and to fall within runs, by over {widths[0]:g} {unit_label(widths[2])}; it {change}"


def _explain_too_short(low: float, readings: Measurements) -> str | None:
    """Return a message if no run is longer than the shortest plausible lag `low`, s; otherwise None."""
    longest_duration = max(float(np.ptp(readings["time"][rows])) for rows in readings.records.rows)
    if longest_duration >= low:
        return None
    return f"needs a run longer than {low:g} s, the shortest plausible lag; the longest lasts {longest_duration:g} s"
