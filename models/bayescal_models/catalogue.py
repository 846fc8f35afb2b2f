"""Catalogue: factories of effects that instruments have in common, and the table of an instrument's effects.

    EFFECTS = EffectTable.from_rows(
        "data sheet of the sensor; size assumed by us",
        baseline=(("bias.constant", constant, 50.0, "deg/s"), ("bias.temperature", linear, 0.05, "deg/s/degC")),
        candidates=(
            ("bias.warm_up", warm_up(2 * MINUTE, 40 * MINUTE), 0.5, "deg/s"),
            *make_common_effects("bias", "deg/s", size=0.6, span=25.0, pace=1.0),
        ),
    )

A row is (canonical name `slot.cause`, factory, plausible size, unit), optionally with a source in place of the table's.
The plausible size is the standard deviation of the prior or, for a group standard deviation, the scale of its prior.
`make_common_effects` builds the effects of quantities that every test records: temperature, time, supply voltage. If
two rows have the same name, the first is used. `effect` makes the factory of an effect of one instrument from a basis,
`family` that of an effect on several slots with the same basis. An effect whose coefficients have different sizes
stands in the table as an `Effect`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import bayescal as bc
from bayescal import effects, xp
from bayescal.effects.constant import one as one
from bayescal_models.simulated import HOUR as HOUR
from bayescal_models.simulated import MINUTE as MINUTE
from bayescal_models.supply import SUPPLY

POWERS = ("", "²", "³", "⁴", "⁵")

Factory = Callable[[str, Any, str, str], bc.Effect]
Row = tuple[str, Factory, Any, str] | tuple[str, Factory, Any, str, str] | bc.Effect


@dataclass(frozen=True)
class EffectTable:
    """Table of the effects of an instrument.

    Attributes:
        baseline: effects of a first calibration.
        candidates: effects that may be missing from it.
        others: effects that only the instrument's named models contain.
    """

    baseline: tuple[bc.Effect, ...]
    candidates: tuple[bc.Effect, ...]
    others: tuple[bc.Effect, ...]

    @classmethod
    def from_rows(
        cls,
        source: str,
        *,
        baseline: Iterable[Row] = (),
        candidates: Iterable[Row] = (),
        others: Iterable[Row] = (),
    ) -> EffectTable:
        """Build a table from rows with a default source; if rows have the same name, use the first."""
        used_names: set[str] = set()

        def build_effects(rows: Iterable[Row]) -> tuple[bc.Effect, ...]:
            by_name: dict[str, bc.Effect] = {}
            for row in rows:
                e = row if isinstance(row, bc.Effect) else _make_effect(source, *row)
                by_name.setdefault(e.name, e)
            built = tuple(e for name, e in by_name.items() if name not in used_names)
            used_names.update(by_name)
            return built

        return cls(build_effects(baseline), build_effects(candidates), build_effects(others))

    def __getitem__(self, name: str) -> bc.Effect:
        return next(e for e in (*self.baseline, *self.candidates, *self.others) if e.name == name)


def _make_effect(
    source: str, name: str, factory: Factory, size: Any, unit: str, *row_source: str
) -> bc.Effect:
    return factory(name, size, unit, *(row_source or (source,)))


# Factories that wrap those of `bayescal.effects`.


def _adapt(factory: Callable[..., bc.Effect], **options: Any) -> Factory:
    def make_effect(name: str, size: Any, unit: str, source: str) -> bc.Effect:
        return factory(name.partition(".")[0], size, unit, source=source, **options)

    return make_effect


constant = _adapt(effects.constant)
linear, quadratic = _adapt(effects.linear), _adapt(effects.quadratic)
cubic, quartic = _adapt(effects.cubic), _adapt(effects.quartic)
hysteresis, drift = _adapt(effects.hysteresis), _adapt(effects.drift)


def deviation(name: str, size: float, unit: str, source: str) -> bc.Effect:
    """Build a random effect such as `bias.run`: a deviation per member, with estimated sd of the prior scale `size`."""
    slot, _, per = name.partition(".")
    return effects.deviation(slot, per, size, unit, source=source)


def warm_up(low: float, high: float) -> Factory:
    """Return a factory that creates a warm-up effect after power-on, with a time constant from `low` to `high`, s."""
    return _adapt(effects.warm_up, low=low, high=high)


def temperature_x_lag(low: float, high: float, column: str = "temperature") -> Factory:
    """Return a factory that creates c·(T − T0)·(T̃ − T) with a lag time constant from `low` to `high`, s."""
    return _adapt(effects.temperature_x_lag, low=low, high=high, column=column)


def thermal_lag(
    low: float,
    high: float,
    start: float,
    start_unit: str,
    rate: tuple[Any, ...] = (),
    **options: Any,
) -> Factory:
    """Return a factory that creates a thermal lag.

    Args:
        low, high: limits of the time constant τ, s.
        start, start_unit: plausible contribution of the lag at the start of a run, and its unit.
        rate: size, unit and, optionally, source of the alternative form for short τ, c·dT/dt; empty: no such form.
        options: further options of `effects.thermal_lag`.
    """

    def make_effect(name: str, size: float, unit: str, source: str) -> bc.Effect:
        slot, _, cause = name.partition(".")
        fields = {"name": cause, "low": low, "high": high, "start": start, "start_unit": start_unit}
        if rate:
            fields["short"] = effects.rate(slot, *rate[:2], source=(*rate, source)[2])
        return effects.thermal_lag(slot, size, unit, source=source, **fields, **options)

    return make_effect


# Effects of quantities that every test records, for a slot of any instrument.

# Ranges of time constants of a lag, s.
SHORT_LAG_S, LONG_LAG_S = (MINUTE, 20 * MINUTE), (20 * MINUTE, 180 * MINUTE)
LAG_MIN, SLOW_MIN = 5.0, 40.0  # min, time constants at which a lag is plausibly size/4


def make_common_effects(
    slot: str,
    unit: str,
    *,
    size: float,
    span: float,
    pace: float,
    column: str = "temperature",
    order: int = 3,
    causes: Collection[str] = (),
    per: str | None = None,
    source: str = "",
) -> tuple[bc.Effect, ...]:
    """Build the effects of temperature, time and supply voltage on a slot; `size`, `span`, `pace` give their sizes.

    Args:
        slot: slot that the effects contribute to.
        unit: unit of `size`; the units of the coefficients derive from it.
        size: plausible change of the slot over a test.
        span: half the temperature range, °C.
        pace: plausible temperature rate, °C/min.
        column: column of the thermometer.
        order: highest power of the temperature; the fourth is nearly collinear with the second.
        causes: effects to build, named without the slot; empty: all.
        per: group with one coefficient per member; None: one coefficient.
        source: template of the source text, with two fields: `{:g}` for the fraction of `size` that an effect
            plausibly contributes, `{}` for the condition of this contribution; empty: "assumed: …".
    """
    source = source or f"assumed: {{:g}} of {size:g} {unit}{{}}"
    half, q, slope = 0.5 * size, 0.25 * size, f"{unit}/degC"
    end = ", from the middle to an end of the temperatures"
    pace_text = " at the mean rate of the temperature"
    lag_text, slow_text = (f"{pace_text} and a lag of {t:g} min" for t in (LAG_MIN, SLOW_MIN))
    rate = (q / pace, f"{unit}/(degC/min)", source.format(0.25, pace_text))
    short_lag = thermal_lag(*SHORT_LAG_S, q, unit, rate=rate, column=column)
    power = partial(_adapt, column=column, name=column)
    slow_lag = thermal_lag(*LONG_LAG_S, q, unit, column=column)
    cross_lag = temperature_x_lag(*SHORT_LAG_S, column)
    backlash = _adapt(effects.hysteresis, column=column, widths=(0.01 * span, 0.5 * span, "degC"))
    supply_factory = effect(_evaluate_supply, "c·(V − V0),  V0 amid those of the fit", SUPPLY.name)
    product = effect(partial(_evaluate_product, column), "c·(T − T0)·(V − V0)", column, SUPPLY.name)
    power_rows: tuple[tuple[str, Factory, float, str, float, str], ...] = (
        (column, power(effects.linear), size / span, slope, 1.0, end),
        (f"{column}_quadratic", power(effects.quadratic), half / span**2, f"{slope}^2", 0.5, end),
        (f"{column}_cubic", power(effects.cubic), q / span**3, f"{slope}^3", 0.25, end),
        (f"{column}_quartic", power(effects.quartic), q / span**4, f"{slope}^4", 0.25, end),
    )
    rows = (
        *power_rows[:order],
        ("thermal_lag", short_lag, q / (pace * LAG_MIN), slope, 0.25, lag_text),
        ("thermal_lag_slow", slow_lag, q / (pace * SLOW_MIN), slope, 0.25, slow_text),
        ("temperature_x_lag", cross_lag, q / (pace * LAG_MIN * span), f"{slope}^2", 0.25, lag_text),
        ("hysteresis", backlash, q, unit, 0.25, ""),
        ("warm_up", warm_up(2 * MINUTE, 40 * MINUTE), half, unit, 0.5, ""),
        ("drift", drift, half, unit, 0.5, ""),
        ("run", deviation, q, unit, 0.25, ""),
        ("supply", supply_factory, size, f"{unit}/V", 1.0, " at 1 V"),
        ("temperature_x_supply", product, half / span, f"{slope}/V", 0.5, f" at 1 V{end}"),
    )
    return tuple(
        _expand(factory(f"{slot}.{cause}", row_size, row_unit, source.format(fraction, text)), per)
        for cause, factory, row_size, row_unit, fraction, text in rows
        if not causes or cause in causes
    )


def _evaluate_supply(r: bc.Frame) -> Any:
    low, high = (r.reference[f"{SUPPLY.name}_{limit}"] for limit in ("low", "high"))
    return r[SUPPLY.name] - 0.5 * (low + high)


def _evaluate_product(column: str, r: bc.Frame) -> Any:
    return r.centred(column) * _evaluate_supply(r)


def _expand(base: bc.Effect, group: str | None) -> bc.Effect:
    """Return an effect whose forms have one set of coefficients per member of a group; None: the effect unchanged."""
    if group is None:
        return base
    coefficients = (c if c.per or c.known else replace(c, per=group) for c in base.coefficients)
    forms = tuple(_expand(form, group) for form in base.forms)
    return replace(base, coefficients=tuple(coefficients), forms=forms)


# Effects of a single instrument.


def effect(
    basis: Callable[..., Any],
    equation: str,
    *columns: str,
    slot: str = "",
    parts: Sequence[str] = ("",),
    slots: Sequence[str] = (),
    per: str | None = None,
    group_sd_prior: Any = None,
    varies: tuple[str, ...] | None = None,
    **fields: Any,
) -> Factory:
    """Return a factory that creates an effect with one coefficient per basis column, all of the same size.

    Args:
        basis: basis function, one column per coefficient.
        equation: equation of the contribution, for reports.
        columns: columns that the readings must have.
        slot: slot of the effect; by default the one in its name.
        parts: name of each coefficient.
        slots: slot of each coefficient; empty: that of the effect.
        per: group with one set of coefficients per member.
        group_sd_prior: type of the prior of the standard deviation between members, whose scale is the effect's size;
            None: this standard deviation is not estimated.
        varies: columns that must vary; by default all of `columns` except the time.
        fields: further fields of `bc.Effect`.
    """

    def make_effect(name: str, size: float, unit: str, source: str) -> bc.Effect:
        group_sd = None if group_sd_prior is None else group_sd_prior(size)
        return bc.Effect(
            name,
            slot or (slots[0] if slots else name.partition(".")[0]),
            basis,
            coefficients=tuple(
                bc.Coefficient(unit, bc.Normal(0.0, size), part, slot_of_part, per, group_sd)
                for part, slot_of_part in zip(parts, slots or [None] * len(parts), strict=True)
            ),
            columns=columns,
            varies=tuple(c for c in columns if c != "time") if varies is None else varies,
            equation=equation,
            source=source,
            **fields,
        )

    return make_effect


def family(
    slots: Sequence[str], basis: Callable[..., Any], equation: str, *columns: str, **fields: Any
) -> Factory:
    """Return a factory that creates an effect with one coefficient on each of several slots, included together.

    Args:
        slots: slots; a coefficient is named by its slot's name after the first underscore, unless `parts` is given.
        basis: basis function of one column, the same for all slots.
        equation, columns, fields: see `effect`.
    """
    parts = fields.pop("parts", None) or [s.partition("_")[2] for s in slots]
    repeated = partial(_repeat_column, basis, len(slots))
    return effect(repeated, equation, *columns, parts=parts, slots=slots, **fields)


def _repeat_column(basis: Callable[..., Any], count: int, r: bc.Frame) -> Any:
    column = xp.reshape(xp.asarray(basis(r), float), (-1, 1))
    return xp.broadcast_to(column, (r.size, count))


def progress(r: bc.Frame) -> Any:
    """Return the normalised time (t − t̄)/(tmax − tmin) of the readings, (n,)."""
    return r.progress


def centred(r: bc.Frame) -> Any:
    """Return the temperature minus the reference temperature, T − T0, °C, (n,)."""
    return r.centred()


def explain_missing_reversal(
    column: str, dead_band: float, readings: bc.Measurements
) -> str | None:
    """Return why readings do not identify a hysteresis: no rise or no fall by over `dead_band`, °C; None if they do."""
    has_rise = has_fall = False
    _, run = readings.groups("run")
    for k in np.unique(run):
        values = readings[column][run == k][np.argsort(readings["time"][run == k], kind="stable")]
        reference = values[0]
        for value in values:
            if abs(value - reference) > dead_band:
                has_rise, has_fall = has_rise or value > reference, has_fall or value < reference
                reference = value
    if has_rise and has_fall:
        return None
    motion = "only rises" if has_rise else "only falls" if has_fall else "stands still"
    return f"needs {column} to rise and to fall within runs, by over {dead_band:g} °C; it {motion}"
