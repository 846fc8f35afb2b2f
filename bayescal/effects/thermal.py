"""Effects of a changing temperature: its rate, its direction, and a body that lags behind the thermometer."""

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

# Share of the readings during which a temperature must rise, and fall, for a hysteresis to show.
DIRECTION_SHARE = 0.02

# Of a rate, s: from a reading or two to the times of a lag; -lag/w is the same function.
WINDOWS_SECONDS = (2.0, 120.0)
RATIOS = (0.1, 0.8)  # of a second stage's time to the first's: at 1 the two cannot be told from 0.8
# Of two bodies side by side: the fast one's time to the slow one's, and what the slow one has of the sensor.
PATH_RATIOS, PATH_SHARES = (0.02, 0.6), (0.1, 0.9)
Modes = tuple[tuple[Any, Any], ...]  # of a body: multiples of τ, and their weights


class Body(NamedTuple):
    """Response of a body to the temperature around it: its modes, by the shapes that they depend on beside τ.

    The weights are one in sum, and τ is the time by which the body is behind a steady ramp. `general` is the body of
    which it is one at a value of a shape.
    """

    modes: Callable[..., Modes]
    equation: str
    shapes: tuple[Shape, ...] = ()
    general: str = ""


def _first_order() -> Modes:
    return ((1.0, 1.0),)


def _two_stages(ratio: Any) -> Modes:
    return (1 / (1 + ratio), 1 / (1 - ratio)), (ratio / (1 + ratio), -ratio / (1 - ratio))


def _two_paths(ratio: Any, share: Any) -> Modes:
    slow = 1 / (share + (1 - share) * ratio)
    return (slow, share), (ratio * slow, 1 - share)


def slab() -> Modes:
    """Return the modes of the mean temperature of a slab: times as 1/k², weights as 1/k², k odd, cut after three.

    Source: H. Carslaw and J. Jaeger, Conduction of Heat in Solids, 2nd ed. (1959), section 3.3.
    """
    modes = [(k**-2.0, k**-2.0) for k in (1, 3, 5)]
    whole = sum(w for _, w in modes)
    behind = sum(m * w for m, w in modes) / whole
    return tuple((m / behind, w / whole) for m, w in modes)


BODIES: Mapping[str, Body] = MappingProxyType(
    {
        "body": Body(_first_order, "T → T̃(τ)"),
        # One body behind another: what the outer one of τ₁ has is the inner one's outside, of r·τ₁.
        "two_stages": Body(
            partial(_two_stages, 0.5), "T → 2·T̃(τ₁) − T̃(τ₁/2),  τ₁ = τ/1.5", general="stages"
        ),
        "stages": Body(
            _two_stages,
            "T → (T̃(τ₁) − r·T̃(r·τ₁))/(1 − r),  τ₁ = τ/(1 + r)",
            (Shape("ratio", "1", *RATIOS, scale="bounded"),),
        ),
        # Two bodies side by side, each with a share of the sensor: w of the slow one, of τ₁.
        "paths": Body(
            _two_paths,
            "T → w·T̃(τ₁) + (1 − w)·T̃(r·τ₁),  τ₁ = τ/(w + (1 − w)·r)",
            (
                Shape("ratio", "1", *PATH_RATIOS, scale="bounded"),
                Shape("share", "1", *PATH_SHARES, scale="bounded"),
            ),
        ),
        "diffusion": Body(slab, "T → " + " + ".join(f"{w:.3g}·T̃({m:.3g}·τ)" for m, w in slab())),
    }
)
# Within which hysteresis turns round: a chamber that holds wanders by less.
WIDTHS = (0.2, 5.0, "degC")


def rate(slot: str, size: float, unit: str, *, source: str, column: str = "temperature") -> Effect:
    """Return c·dT/dt with a window estimated from the data.

    The rate is that of a body close behind the thermometer, (T − T̃)/w: noise of the thermometer is smoothed over the
    window w, and what changes within seconds is not blurred to a minute.
    """
    return Effect(
        f"{slot}.rate",
        slot,
        basis=partial(_smoothed_rate, column),
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        shapes=(Shape("window", "s", *WINDOWS_SECONDS, scale="bounded"),),
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
    widths: tuple[float, float, str] = WIDTHS,
) -> Effect:
    """Return c·D in a continuous record: +c while warming, −c while cooling, reversed within w of the temperature.

    D is Dahl's hysteresis, of the body where one lags behind the thermometer. Of the state in which a run began
    exp(−travel/w) is left: one coefficient a run.

    Args:
        size: prior standard deviation of c, in `unit`.
        column: that it follows.
        widths: plausible range of w, and its unit: that of the column.
    """

    return Effect(
        f"{slot}.hysteresis",
        slot,
        basis=partial(_directions, column),
        coefficients=(Coefficient(unit, Normal(0.0, size)), _start(unit, size)),
        shapes=(Shape("width", widths[2], *widths[:2]),),
        columns=("time", column),
        varies=(column,),
        untestable=partial(_one_way, column, widths),
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
    """Return a thermal lag: c·(T̃ − T), T̃ a first-order body that lags T by τ; or all that depends on T acts at T̃.

    In the first form something of its own lags, such as electronics beside a sensor that does not. In the others the
    sensor is itself at T̃, so that its line, its curve and its scale factor follow that in place of T: the body is of
    first order, of two stages, two side by side with a share of the sensor each, or heat diffuses into it. Where it was
    not at T when a run began, exp(−t/τ) remains: one coefficient a run, whose standard deviation is learned and has the
    plausible size `start`.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
        start: plausible standard deviation, between runs, of the initial state's effect, in `start_unit`.
        name: of the effect, after the slot; another for a second lag.
        bodies: forms in which all that depends on T lags, by name; all if not given, empty where it does not.
        short: the form that it takes where τ is too short to be seen: a rate.
    """
    how: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    forms = list[Effect]()
    for form, behind in (BODIES if bodies is None else bodies).items():
        variant = body(slot, start, start_unit, behind=behind, name=f"{name}.{form}", **how)
        forms.append(replace(variant, general=behind.general and f"{slot}.{name}.{behind.general}"))
    coefficients = Coefficient(unit, Normal(0.0, size)), _start(start_unit, start)
    equation = "c·(T̃ − T) + d[run]·exp(−(t − t_start)/τ),  τ·dT̃/dt = T − T̃"
    lag = _lag_effect(slot, name, _lagging, coefficients, equation, **how)
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
    """Let every effect that depends on the temperature T act at T̃, that of a body which lags T by τ.

    T̃ = Σ wₖ·T̃ₖ with mₖ·τ·dT̃ₖ/dt = T − T̃ₖ: one mode for a body of first order, two for one behind or beside another,
    a series for heat that diffuses into a slab. Σ wₖ = Σ wₖ·mₖ = 1: τ is in each the time by which it is behind a ramp.
    Where the body was not at T when a run began, Σ wₖ·exp(−t/(mₖ·τ)) remains: one coefficient a run.

    Args:
        slot: that the initial state adds to.
        start: plausible standard deviation, between runs, of what it adds, in `start_unit`.
        low, high: plausible range of τ, s.
        behind: how it follows, of `BODIES`.
        name: of the effect, after the slot.
    """
    coefficients = _start(start_unit, start, slot), Coefficient("1", Known(1.0))
    equation = f"{behind.equation},  τ·dT̃/dt = T − T̃;  + d[run]·exp(−(t − t_start)/τ)"
    how: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    basis = partial(_body_columns, behind.modes)
    effect = _lag_effect(slot, name, basis, coefficients, equation, behind.shapes, **how)
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
    """Return c·(T − T0)·(T̃ − T): a lag that grows with the temperature, or shrinks.

    Args:
        size: prior standard deviation of c, in `unit`, such as "deg/s/degC^2".
        low, high: plausible range of τ, s.
    """
    terms = (Coefficient(unit, Normal(0.0, size)),)
    equation = "c·(T − T0)·(T̃ − T),  τ·dT̃/dt = T − T̃"
    how: dict[str, Any] = {"low": low, "high": high, "source": source, "column": column}
    return _lag_effect(slot, "temperature_x_lag", _lag_by_temperature, terms, equation, **how)


def _lag_effect(
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
    """Return an effect of a body that lags a column by τ, `low` to `high`, s; one τ for all channels of a unit."""
    return Effect(
        f"{slot}.{name}",
        slot,
        basis=partial(basis, column),
        coefficients=coefficients,
        shapes=(Shape("tau", "s", low, high, shared=True), *shapes),
        columns=("time", column),
        varies=(column,),
        untestable=partial(_too_short, low),
        equation=equation,
        source=source,
    )


def _start(unit: str, size: float, slot: str | None = None) -> Coefficient:
    """Return the coefficient of a run's initial state: one per run, of learned spread."""
    of_runs = {"per": "run", "group_sd": HalfNormal(size), "initial": True}
    return Coefficient(unit, Normal(0.0, size), part="start", slot=slot, **of_runs)


def _smoothed_rate(column: str, r: Frame, window: Any) -> Any:
    return -r.behind(window, column) / window


def _directions(column: str, r: Frame, width: Any) -> Any:
    return xp.stack(r.direction(width, column), axis=-1)


def _body_columns(
    modes: Callable[..., Modes],
    column: str,
    r: Frame,
    tau: Any,
    ratio: Any = None,
    share: Any = None,
) -> Any:
    """Return the decay of a run's first state, and T̃ − T, of a body of modes with up to two shapes beside τ (n, 2)."""
    pairs = modes(*(shape for shape in (ratio, share) if shape is not None))
    behind = sum(w * r.behind(m * tau, column) for m, w in pairs)
    return xp.stack([sum(w * xp.exp(-r.elapsed / (m * tau)) for m, w in pairs), behind], axis=-1)


def _lagging(column: str, r: Frame, tau: Any) -> Any:
    return xp.stack([r.lag(tau, column), xp.exp(-r.elapsed / tau)], axis=-1)


def _lag_by_temperature(column: str, r: Frame, tau: Any) -> Any:
    return r.centred(column) * r.lag(tau, column)


def _one_way(column: str, widths: tuple[float, float, str], readings: Measurements) -> str | None:
    """Return why a column that does not change in both directions cannot test hysteresis; None if it does."""
    frame = build_frame(readings, reference_of(readings))
    turned = np.asarray(frame.direction(math.sqrt(math.prod(widths[:2])), column)[0])
    least = DIRECTION_SHARE
    warmed, cooled = (turned > 0.5).mean() >= least, (turned < -0.5).mean() >= least
    if warmed and cooled:
        return None
    motion = "only rises" if warmed else "only falls" if cooled else "stands still"
    return f"needs {column} to rise and to fall within runs, by over {widths[0]:g} {unit_label(widths[2])}; it {motion}"


def _too_short(low: float, readings: Measurements) -> str | None:
    """Return why no run is long enough to test a lag of at least `low`, s; None if one is."""
    longest = max(float(np.ptp(readings["time"][rows])) for rows in readings.records.rows)
    if longest >= low:
        return None
    return f"needs a run longer than {low:g} s, the shortest plausible lag; the longest has {longest:g} s"
