"""What a limit is on: the error of a corrected reading, a slot of the instrument in use, or an unknown of the model.

- "corrected reading": corrected reading minus what acts, with the noise of one reading; "corrected mean": the same
  without, as the mean of many readings has it. The correction is made with the posterior mean, as exports make it.
- A slot, such as "bias": what all effects on it come to in use, for a run, cell or device that is new unless it is
  named, so that its deviation counts.
- An unknown, such as "bias.temperature", "bias.run.group_sd" or "noise.white", by the name that a calibration prints.

The first two are values at an operating point: covariates at the middle of their calibrated range, rates and lags
zero, the time that of the last reading, unless the limit says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import InputError
from bayescal._data.unit_conversion import convert, same_dimension, unit_label
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._use import inversion
from bayescal._use.budget import notes_on
from bayescal._use.compensator import Compensator
from bayescal._use.conformity import DrawnQuantity, Limits
from bayescal._use.inputs import PAST
from bayescal._use.inputs import limits as calibrated_limits
from bayescal._use.limit import LimitedRange, SpreadOfDevices, StatedLimit
from bayescal._use.operating_equation import equation_in_use
from bayescal._use.provenance import bias_only

READING, MEAN = "corrected reading", "corrected mean"
ALL = 10**9  # draws: every one there is
# Along each of so many ranges. Between 33 places a parabola rises by less than 1/1000 of what it rises over the range
# ((1/32)²); with two and three ranges 81 and 125 places keep the draws in memory.
PLACES = {1: 33, 2: 9, 3: 5}

HELD = "{} was held at its estimate, so that its uncertainty is not known: fit with --method marginal or nuts"


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedQuantity:
    """A quantity that is limited, evaluated on draws.

    Attributes:
        limit: that it is of.
        limits: in `unit`.
        unit: of the quantity, fixed.
        notes: what to know, each a sentence.
        not_covered: what the limit asks for and the calibration does not know, each a clause; then nothing is decided.
    """

    limit: StatedLimit
    limits: Limits
    unit: str
    notes: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()

    @property
    def place(self) -> dict[str, tuple[float, float, str]]:
        """Where it is evaluated: name → lowest value, highest value, unit; nothing for an unknown."""
        return {}

    @property
    def follows_time(self) -> bool:
        """Whether it changes with the time of the record."""
        return False

    @property
    def is_error(self) -> bool:
        """Whether it is what a correction leaves: then it is estimated as zero, whichever the device."""
        return self.limit.quantity in (READING, MEAN)

    def drawn(self, later: float = 0.0) -> DrawnQuantity:
        """What the posterior says of it, s after the last reading of the calibration."""
        raise NotImplementedError

    def values(self) -> Float[np.ndarray, "d g"]:
        """Its value in each draw, in the calibration's order, at each place of the limit's range."""
        raise NotImplementedError

    def over_devices(self, table: Mapping[str, tuple[float, float]]) -> tuple[float, float] | None:
        """Mean and standard deviation over devices whose coefficients have these; None where that cannot be said."""
        raise NotImplementedError

    def curves(
        self, table: Mapping[str, tuple[float, float]], count: int
    ) -> tuple[Float[np.ndarray, "n g"], Float[np.ndarray, "d g"]] | None:
        """At each place of a range: `count` devices, whose coefficients have these means and standard deviations, drawn
        anew; and the errors of a measurement of one, by draw.

        None where it has a single place, or none of its coefficients is named.
        """
        return None


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedUnknown(LimitedQuantity):
    """An unknown of the model: draws (d,)."""

    draws: np.ndarray

    def drawn(self, later: float = 0.0) -> DrawnQuantity:
        mean = float(self.draws.mean())
        return DrawnQuantity(self.draws, self.draws, (mean, mean))

    def values(self) -> Float[np.ndarray, "d g"]:
        return np.asarray(self.draws)[:, None]

    def over_devices(self, table: Mapping[str, tuple[float, float]]) -> tuple[float, float] | None:
        return table.get(self.limit.quantity)


@dataclass(frozen=True, eq=False, kw_only=True)
class QuantityInUse(LimitedQuantity):
    """A slot, or the error of a corrected reading, at the places of a grid.

    Attributes:
        chosen: compensator with all draws.
        places: the stimulus and every input by name, (g,) each.
    """

    chosen: Compensator
    places: Mapping[str, np.ndarray]

    @property
    def place(self) -> dict[str, tuple[float, float, str]]:
        units = {self.chosen.stimulus: self.chosen.unit}
        units |= {i.name: i.unit for i in self.chosen.inputs if i.kind != "lag slope"}
        shown = self._acting | ({self.chosen.stimulus} if self.is_error else set())
        return {
            n: (float(self.places[n].min()), float(self.places[n].max()), unit)
            for n, unit in units.items()
            if n in shown
        }

    @cached_property
    def _acting(self) -> set[str]:
        """Inputs, and the stimulus, that it depends on."""
        if self.is_error:
            return set(self.chosen._inverse.inputs)
        equation, reference = self.chosen._equation, self.chosen._inverse.reference
        theta, inputs = self.chosen._inverse.ones()

        def value(s, inputs):
            return equation.slot(self.limit.quantity, theta, s, inputs, reference)

        live = inversion.live(value, jnp.ones(()), inputs)
        names = (self.chosen.stimulus, *sorted(inputs))
        return {n for n, acts in zip(names, live, strict=True) if acts}

    @property
    def follows_time(self) -> bool:
        return "time" in self._acting

    def drawn(self, later: float = 0.0) -> DrawnQuantity:
        values, scatter = self._values(self.chosen._moments.draws, later)
        middle = values.mean(axis=0)
        return DrawnQuantity(
            values.min(axis=1),
            values.max(axis=1),
            (float(middle.min()), float(middle.max())),
            scatter,
        )

    def values(self) -> Float[np.ndarray, "d g"]:
        return self._values(self.chosen._moments.draws, 0.0)[0]

    def over_devices(self, table: Mapping[str, tuple[float, float]]) -> tuple[float, float] | None:
        if self._size > 1:
            return None
        values = self._drawn_anew(table, len(self.chosen._moments.draws))
        return None if values is None else (float(values.mean()), float(values.std()))

    def curves(
        self, table: Mapping[str, tuple[float, float]], count: int
    ) -> tuple[Float[np.ndarray, "n g"], Float[np.ndarray, "d g"]] | None:
        devices = None if self._size == 1 else self._drawn_anew(table, count)
        if devices is None:
            return None
        values = self.values()
        return devices, values - values.mean(axis=0)

    def _drawn_anew(
        self, table: Mapping[str, tuple[float, float]], count: int
    ) -> Float[np.ndarray, "n g"] | None:
        chosen = self.chosen
        known = [i for i, u in enumerate(chosen._equation.unknowns()) if u.name in table]
        if not known or self.is_error:
            return None
        theta = np.tile(chosen._moments.mean, (count, 1))
        random = np.random.default_rng(chosen._calibration.seed)
        for i in known:
            mean, sd = table[chosen._equation.unknowns()[i].name]
            theta[:, i] = mean + sd * random.standard_normal(count)
        return self._values(theta, 0.0)[0]

    @property
    def _size(self) -> int:
        return len(self.places[self.chosen.stimulus])

    def _values(
        self, theta: Float[np.ndarray, "d p"], later: float
    ) -> tuple[Float[np.ndarray, "d g"], float]:
        """Values for θ at the places, and by how much single readings scatter."""
        chosen = self.chosen
        inverse, moments = chosen._inverse, chosen._moments
        zero = np.zeros(self._size)
        inputs = {n: jnp.asarray(self.places.get(n, zero)) for n in inverse.names}
        if "time" in inputs:
            inputs["time"] = inputs["time"] + later
        stimulus, draws = jnp.asarray(self.places[chosen.stimulus]), jnp.asarray(theta)
        start = inverse.equation, inverse.reference
        if not self.is_error:
            name = self.limit.quantity
            found = inversion.slots_over_draws(*start, name, draws, stimulus, inputs)
            return np.asarray(found), 0.0
        mean = jnp.asarray(moments.mean)
        found, inclination = inversion.errors_over_draws(*start, draws, mean, stimulus, inputs)
        noise = chosen.noise * float(np.max(inclination)) if self.limit.quantity == READING else 0.0
        return np.asarray(found), noise


def limited_quantity(
    calibration: Calibration,
    limit: StatedLimit,
    *,
    members: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
) -> LimitedQuantity:
    """The quantity that a limit is on.

    Args:
        calibration: a fit, or an average over structures.
        limit: on what.
        members: which member of a group is used, as `compensator` takes it.
        local_gravity: m/s², for limits in m/s² on accelerations in g.

    Raises:
        InputError: nothing is called so, the unit is of another dimension, or a range is of no column.
        ModelError: the instrument does not say what it measures, and the limit is on something in use.
    """
    instrument = calibration.model.instrument
    slots = {s.name: s.unit for s in instrument.slots}
    if limit.quantity not in (READING, MEAN, *slots):
        return _unknown(calibration, limit, local_gravity)
    # All structures: what the less probable ones need is no reason to leave them out, as it is for firmware.
    equation = equation_in_use(calibration, members)
    chosen = Compensator(calibration, equation, ALL)
    if limit.quantity in slots and limit.quantity not in {b.slot for b in equation.blocks}:
        raise InputError(
            f"limit {limit.text!r}: no effect of the model acts on {limit.quantity!r} in use, so that nothing is known "
            "of it"
        )
    unit = slots.get(limit.quantity, chosen.unit)
    point = chosen.middle | {i.name: i.high for i in chosen.inputs if i.name == "time"}
    spans, not_covered, notes = [], [], []
    for span in limit.over:
        name, low, high = _resolved(chosen, span, limit, local_gravity)
        not_covered += _beyond(chosen, name, low, high)
        if name not in point:
            notes.append(f"{limit.quantity} does not depend on {name}.")
        spans.append((name, low, high))
    ranges = [(n, low, high) for n, low, high in spans if high > low and n in point]
    if len(ranges) > max(PLACES):
        raise InputError(
            f"limit {limit.text!r}: at most {max(PLACES)} ranges, it has {len(ranges)}"
        )
    point |= {n: low for n, low, high in spans if high == low and n in point}
    grid = np.meshgrid(
        *(np.linspace(low, high, PLACES[len(ranges)]) for _, low, high in ranges), indexing="ij"
    )
    size = grid[0].size if grid else 1
    places = {n: np.full(size, v) for n, v in point.items()}
    places |= {n: g.ravel() for (n, _, _), g in zip(ranges, grid, strict=True)}
    # Where a range leaves what was calibrated is said by `not_covered`, in its own words.
    beside = bias_only(chosen.stimulus) if limit.quantity in slots else ""  # is of a correction
    said = notes_on(chosen, point)
    notes += [n for n in said if "outside its calibrated range" not in n and n != beside]
    notes += _of_the_noise(calibration, limit.quantity)
    return QuantityInUse(
        limit=limit,
        limits=_limits(limit, unit, local_gravity),
        unit=unit,
        notes=tuple(notes),
        not_covered=tuple(not_covered),
        chosen=chosen,
        places=places,
    )


def _of_the_noise(calibration: Calibration, quantity: str) -> list[str]:
    """What a limit on a corrected reading, or on the mean of many, takes the noise for, where that is not all of it."""
    noise = calibration.model.noise
    if quantity == MEAN and not noise.independent:
        return [
            f"{MEAN!r} is without the correlated noise, which readings close in time share: a mean keeps it."
        ]
    if quantity == READING and noise.independent and noise.needs:
        return [
            f"The noise follows {', '.join(noise.needs)}; its mean over the calibration is taken."
        ]
    if quantity == READING and not noise.gaussian:
        return ["The noise is taken as normal, with the standard deviation that it has."]
    return []


def _limits(limit: StatedLimit, unit: str, local_gravity: float) -> Limits:
    """The tolerance limits in the unit of the quantity."""
    if not limit.unit and unit_label(unit):
        raise InputError(
            f"limit {limit.text!r} has no unit: {limit.quantity} is in {unit_label(unit)}"
        )
    if not same_dimension(limit.unit or "1", unit or "1"):
        raise InputError(
            f"limit {limit.text!r}: {limit.quantity} is in {unit_label(unit) or 'plain numbers'}, not in "
            f"{unit_label(limit.unit) or 'plain numbers'}"
        )
    ends, own = np.array([limit.low, limit.high]), unit or "1"
    found = convert(ends, limit.unit or "1", own, local_gravity=local_gravity, difference=True)
    return Limits(*found.tolist())


def _unknown(calibration: Calibration, limit: StatedLimit, local_gravity: float) -> LimitedUnknown:
    draws = _draws_by_name(calibration)
    if limit.quantity not in draws:
        slots = ", ".join(s.name for s in calibration.model.instrument.slots)
        raise InputError(
            f"limit {limit.text!r}: nothing is called {limit.quantity!r}. A limit is on {READING!r}, {MEAN!r}, what "
            f"acts ({slots}), or an unknown of the calibration: {', '.join(draws)}"
        )
    if limit.over:
        raise InputError(
            f"limit {limit.text!r}: {limit.quantity} is one number, the same everywhere; leave the range out, or limit "
            "what acts"
        )
    values, unit = draws[limit.quantity]
    not_covered = () if np.ptp(values) > 0 else (HELD.format(limit.quantity),)
    limits = _limits(limit, unit, local_gravity)
    return LimitedUnknown(
        limit=limit, limits=limits, unit=unit, not_covered=not_covered, draws=values
    )


def _draws_by_name(calibration: Calibration) -> dict[str, tuple[np.ndarray, str]]:
    """Every unknown under the name that a calibration prints: draws (d,) and unit."""
    found: dict[str, tuple[np.ndarray, str]] = {}
    names = {
        b.name: b.member_names(calibration.levels)
        for b in calibration.layout.blocks
        if b.place != "row"
    }
    for name in map(str, calibration.posterior):
        values = calibration.samples(name)
        unit = str(calibration.posterior[name].attrs.get("units", "1"))
        if values.ndim == 1:
            found[name] = values, unit
        else:
            members = names.get(name, [])
            found |= {m: (values[:, i], unit) for i, m in enumerate(members) if values.ndim == 2}
    return found


def _resolved(
    chosen: Compensator, span: LimitedRange, limit: StatedLimit, local_gravity: float
) -> tuple[str, float, float]:
    """The column of a range, and its ends in that column's unit."""
    readings = chosen._calibration.readings
    inputs = {i.name: i.unit for i in chosen.inputs if i.kind != "lag slope"}
    acting = {chosen.stimulus: chosen.unit, **inputs}
    known = acting | {n: u for n in readings.columns if (u := readings.unit(n)) and n not in acting}
    known.pop("output", None)
    if span.name:
        if span.name not in known:
            raise InputError(
                f"limit {limit.text!r}: {span.name!r} is no column of this calibration; there is: {', '.join(known)}"
            )
        name = span.name
    else:
        unit = span.unit or "1"
        past = {i.name for i in chosen.inputs if i.kind in PAST}
        meant = [n for n, u in acting.items() if same_dimension(u, unit) and n not in past]
        meant = meant or [n for n, u in known.items() if same_dimension(u, unit)]
        if len(meant) != 1:
            several = f"several could be meant: {', '.join(meant)}"
            could = several if meant else "no column is in that unit"
            raise InputError(
                f"limit {limit.text!r}: of which column is the range in {unit_label(unit) or 'plain numbers'}? "
                f"{could}. Name it: over temperature -20..60 °C"
            )
        name = meant[0]
    unit = known[name]
    if not same_dimension(span.unit or "1", unit):
        raise InputError(
            f"limit {limit.text!r}: {name} is in {unit_label(unit)}, not in {unit_label(span.unit) or 'plain numbers'}"
        )
    ends = np.array([span.low, span.high])
    low, high = convert(ends, span.unit or "1", unit, local_gravity=local_gravity).tolist()
    return name, low, high


def _beyond(chosen: Compensator, name: str, low: float, high: float) -> list[str]:
    """What of a range was not calibrated, in words."""
    readings = chosen._calibration.readings
    if name in chosen.calibrated:
        span = chosen.calibrated[name]
    elif name == chosen.stimulus:
        return [f"{name} was not varied in the calibration"] if high > low else []
    else:
        values, unit = readings[name], readings.unit(name) or "1"
        span = (float(values.min()), float(values.max()), unit)
    first, last = calibrated_limits(span[:2])
    if first <= low and high <= last:
        return []
    asked = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return [
        f"{name} was calibrated from {span[0]:.6g} to {span[1]:.6g} {unit_label(span[2])}, not at {asked}"
    ]


def with_population(
    quantity: LimitedQuantity, given: SpreadOfDevices | Mapping[str, tuple[float, float]]
) -> tuple[float, float] | None:
    """Mean and standard deviation of the quantity over devices, in its unit; None where the population says nothing.

    Args:
        quantity: a limited one.
        given: devices as a user states them, or coefficient → (mean, standard deviation) of a fleet.
    """
    if not isinstance(given, SpreadOfDevices):
        return quantity.over_devices(given)
    limit = quantity.limit
    if quantity.is_error or any(r.high > r.low for r in limit.over):
        return None
    unit, own = given.unit or "1", quantity.unit or "1"
    if given.quantity not in ("", limit.quantity) or not same_dimension(unit, own):
        return None
    sd = float(convert(given.sd, unit, own, difference=True))
    if given.mean is not None:
        return float(convert(given.mean, unit, own, difference=True)), sd
    low, high = quantity.limits
    ends = [end for end in (low, high) if np.isfinite(end)]
    return (float(np.mean(ends)), sd) if len(ends) == 2 else None
