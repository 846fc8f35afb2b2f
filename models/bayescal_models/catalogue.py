"""Catalogue: factories of the effects that instruments share, and the table of effects of an instrument.

    EFFECTS = EffectTable.of(
        "data sheet of the sensor; size ours",
        baseline=(("bias.constant", constant, 50.0, "deg/s"), ("bias.temperature", linear, 0.05, "deg/s/degC")),
        candidates=(
            ("bias.warm_up", warm_up(2 * MINUTE, 40 * MINUTE), 0.5, "deg/s"),
            *recorded("bias", "deg/s", size=0.6, span=25.0, pace=1.0),
        ),
    )

A row has the canonical name, `slot.cause`; the family, a factory; the plausible size, a prior standard deviation
(for a learned standard deviation: its prior's scale), with its unit; and the source, if not that of the table.
`recorded` has the families of quantities that any test records: a thermometer, a clock, the supply voltage. A row
higher up in an instrument's table replaces the one of the same name there.
Effects of one instrument are built from a basis by `effect`, or by `family` for several slots with the same basis;
an effect whose coefficients have different sizes is in the table as an `Effect`.
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

SIGNS = ("", "²", "³", "⁴", "⁵")

Maker = Callable[[str, Any, str, str], bc.Effect]
Row = tuple[str, Maker, Any, str] | tuple[str, Maker, Any, str, str] | bc.Effect


@dataclass(frozen=True)
class EffectTable:
    """The effects of an instrument.

    Attributes:
        baseline: effects of a first calibration.
        candidates: effects that may be missing from it.
        others: effects of named models only.
    """

    baseline: tuple[bc.Effect, ...]
    candidates: tuple[bc.Effect, ...]
    others: tuple[bc.Effect, ...]

    @classmethod
    def of(
        cls,
        source: str,
        *,
        baseline: Iterable[Row] = (),
        candidates: Iterable[Row] = (),
        others: Iterable[Row] = (),
    ) -> EffectTable:
        """Build a table from rows; `source` is the default source. Of rows with the same name the first is used."""
        used_names: set[str] = set()

        def make(rows: Iterable[Row]) -> tuple[bc.Effect, ...]:
            by_name: dict[str, bc.Effect] = {}
            for row in rows:
                e = row if isinstance(row, bc.Effect) else _effect(source, *row)
                by_name.setdefault(e.name, e)
            effects = tuple(e for name, e in by_name.items() if name not in used_names)
            used_names.update(by_name)
            return effects

        return cls(make(baseline), make(candidates), make(others))

    def __getitem__(self, name: str) -> bc.Effect:
        return next(e for e in (*self.baseline, *self.candidates, *self.others) if e.name == name)


def _effect(
    source: str, name: str, maker: Maker, size: Any, unit: str, *source_of_row: str
) -> bc.Effect:
    return maker(name, size, unit, *(source_of_row or (source,)))


# The families of `bayescal.effects`.


def _general(maker: Callable[..., bc.Effect], **options: Any) -> Maker:
    def make(name: str, size: Any, unit: str, source: str) -> bc.Effect:
        return maker(name.partition(".")[0], size, unit, source=source, **options)

    return make


constant = _general(effects.constant)
linear, quadratic = _general(effects.linear), _general(effects.quadratic)
cubic, quartic = _general(effects.cubic), _general(effects.quartic)
hysteresis, drift = _general(effects.hysteresis), _general(effects.drift)


def deviation(name: str, size: float, unit: str, source: str) -> bc.Effect:
    """Build a deviation for each member of a group, such as `bias.run`, with a learned standard deviation."""
    slot, _, per = name.partition(".")
    return effects.deviation(slot, per, size, unit, source=source)


def warm_up(low: float, high: float) -> Maker:
    """Build the maker of a warm-up within a run, of time constant `low` to `high`, s."""
    return _general(effects.warm_up, low=low, high=high)


def temperature_x_lag(low: float, high: float, column: str = "temperature") -> Maker:
    """Build the maker of a lag proportional to temperature, of time constant `low` to `high`, s."""
    return _general(effects.temperature_x_lag, low=low, high=high, column=column)


def thermal_lag(
    low: float,
    high: float,
    start: float,
    start_unit: str,
    rate: tuple[Any, ...] = (),
    **further: Any,
) -> Maker:
    """Build the maker of a thermal lag of time constant `low` to `high`, s.

    Args:
        start, start_unit: plausible contribution of its state at the start of a run, and its unit.
        rate: size and unit of its form for short τ, a rate, and its source if another; none if empty.
        further: options of `effects.thermal_lag`.
    """

    def make(name: str, size: float, unit: str, source: str) -> bc.Effect:
        slot, _, cause = name.partition(".")
        body = {"name": cause, "low": low, "high": high, "start": start, "start_unit": start_unit}
        if rate:
            body["short"] = effects.rate(slot, *rate[:2], source=(*rate, source)[2])
        return effects.thermal_lag(slot, size, unit, source=source, **body, **further)

    return make


# Families of quantities that every test records, for a slot of any instrument.

SHORT, LONG = (MINUTE, 20 * MINUTE), (20 * MINUTE, 180 * MINUTE)  # s, ranges of lag times
LAG, SLOW = 5.0, 40.0  # min, lag times at which a lag of a quarter of the size is plausible


def recorded(
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
    """Build the families of a thermometer, a clock and a supply's voltage, sized by the slot's plausible change.

    Args:
        slot: slot that they add to.
        unit: unit of `size`, and of the coefficients.
        size: plausible change of the slot over a test.
        span: half the range of the temperature, °C.
        pace: plausible rate of the temperature, °C/min.
        column: column of the thermometer.
        order: highest power of the temperature; the fourth is nearly collinear with the second.
        causes: names of the families to build, without the slot; all if empty.
        per: group with one coefficient per member; None for a single one.
        source: source text with placeholders for the share of `size` and where it is reached; ours if empty.
    """
    source = source or f"ours: {{:g}} of {size:g} {unit}{{}}"
    half, q, of = 0.5 * size, 0.25 * size, f"{unit}/degC"
    at_end = ", from the middle to an end of the temperatures"
    at_pace = " at the mean rate of the temperature"
    lags, lags_slowly = (f"{at_pace} and a lag of {t:g} min" for t in (LAG, SLOW))
    rate = (q / pace, f"{unit}/(degC/min)", source.format(0.25, at_pace))
    short = thermal_lag(*SHORT, q, unit, rate=rate, column=column)
    power = partial(_general, column=column, name=column)
    slow, grows = thermal_lag(*LONG, q, unit, column=column), temperature_x_lag(*SHORT, column)
    turning = _general(effects.hysteresis, column=column, widths=(0.01 * span, 0.5 * span, "degC"))
    supplied = effect(_supply, "c·(V − V0),  V0 amid those of the fit", SUPPLY.name)
    product = effect(partial(_by_supply, column), "c·(T − T0)·(V − V0)", column, SUPPLY.name)
    powers: tuple[tuple[str, Maker, float, str, float, str], ...] = (
        (column, power(effects.linear), size / span, of, 1.0, at_end),
        (f"{column}_quadratic", power(effects.quadratic), half / span**2, f"{of}^2", 0.5, at_end),
        (f"{column}_cubic", power(effects.cubic), q / span**3, f"{of}^3", 0.25, at_end),
        (f"{column}_quartic", power(effects.quartic), q / span**4, f"{of}^4", 0.25, at_end),
    )
    rows = (
        *powers[:order],
        ("thermal_lag", short, q / (pace * LAG), of, 0.25, lags),
        ("thermal_lag_slow", slow, q / (pace * SLOW), of, 0.25, lags_slowly),
        ("temperature_x_lag", grows, q / (pace * LAG * span), f"{of}^2", 0.25, lags),
        ("hysteresis", turning, q, unit, 0.25, ""),
        ("warm_up", warm_up(2 * MINUTE, 40 * MINUTE), half, unit, 0.5, ""),
        ("drift", drift, half, unit, 0.5, ""),
        ("run", deviation, q, unit, 0.25, ""),
        ("supply", supplied, size, f"{unit}/V", 1.0, " at 1 V"),
        ("temperature_x_supply", product, half / span, f"{of}/V", 0.5, f" at 1 V{at_end}"),
    )
    return tuple(
        _per_member(maker(f"{slot}.{cause}", size_of_row, its, source.format(share, where)), per)
        for cause, maker, size_of_row, its, share, where in rows
        if not causes or cause in causes
    )


def _supply(r: bc.Frame) -> Any:
    low, high = (r.reference[f"{SUPPLY.name}_{end}"] for end in ("low", "high"))
    return r[SUPPLY.name] - 0.5 * (low + high)


def _by_supply(column: str, r: bc.Frame) -> Any:
    return r.centred(column) * _supply(r)


def _per_member(base: bc.Effect, group: str | None) -> bc.Effect:
    """Give an effect and its forms one coefficient per member of a group."""
    if group is None:
        return base
    coefficients = (c if c.per or c.known else replace(c, per=group) for c in base.coefficients)
    forms = tuple(_per_member(form, group) for form in base.forms)
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
    learned: Any = None,
    varies: tuple[str, ...] | None = None,
    **fields: Any,
) -> Maker:
    """Build the maker of an effect whose coefficients, one for each part, have one size.

    Args:
        basis: basis function with one column per part.
        equation: text for reports.
        columns: columns that readings must have.
        slot: slot, if not the one in the name.
        parts: names of the coefficients.
        slots: slot of each part, if they differ.
        per: group with one coefficient per member.
        learned: type of the prior of their standard deviation, of scale `size`; None if it is not learned.
        varies: columns that must vary; by default all columns except the time.
        fields: further fields of the effect.
    """

    def make(name: str, size: float, unit: str, source: str) -> bc.Effect:
        spread = None if learned is None else learned(size)
        return bc.Effect(
            name,
            slot or (slots[0] if slots else name.partition(".")[0]),
            basis,
            coefficients=tuple(
                bc.Coefficient(unit, bc.Normal(0.0, size), part, slot_of_part, per, spread)
                for part, slot_of_part in zip(parts, slots or [None] * len(parts), strict=True)
            ),
            columns=columns,
            varies=tuple(c for c in columns if c != "time") if varies is None else varies,
            equation=equation,
            source=source,
            **fields,
        )

    return make


def family(
    slots: Sequence[str], basis: Callable[..., Any], equation: str, *columns: str, **fields: Any
) -> Maker:
    """Build the maker of one effect on several slots, one coefficient each, included or excluded together.

    Args:
        slots: slots; a coefficient's part is the slot's name after the first underscore, unless `parts` is given.
        basis: basis of one column, the same for all.
        equation, columns, fields: as of `effect`.
    """
    parts = fields.pop("parts", None) or [s.partition("_")[2] for s in slots]
    shared = partial(_in_each, basis, len(slots))
    return effect(shared, equation, *columns, parts=parts, slots=slots, **fields)


def _in_each(basis: Callable[..., Any], count: int, r: bc.Frame) -> Any:
    column = xp.reshape(xp.asarray(basis(r), float), (-1, 1))
    return xp.broadcast_to(column, (r.size, count))


# Simple bases.


def progress(r: bc.Frame) -> Any:
    """Return (t − t̄)/(tmax − tmin)."""
    return r.progress


def centred(r: bc.Frame) -> Any:
    """Return T − T0, °C."""
    return r.centred()


def goes_one_way(column: str, dead_band: float, readings: bc.Measurements) -> str | None:
    """Return the reason why readings cannot identify a hysteresis: no rise, or no fall, above `dead_band`, °C."""
    rises = falls = False
    _, run = readings.groups("run")
    for k in np.unique(run):
        path = readings[column][run == k][np.argsort(readings["time"][run == k], kind="stable")]
        stood = path[0]
        for now in path:
            if abs(now - stood) > dead_band:
                rises, falls = rises or now > stood, falls or now < stood
                stood = now
    if rises and falls:
        return None
    way = "only rises" if rises else "only falls" if falls else "stands still"
    return f"needs {column} to rise and to fall within runs, by over {dead_band:g} °C; it {way}"
