"""Instruments: the columns, slots and measurement equation of a sensor, as values.

Instruments are not subclasses. A new one is a set of columns, slots and one function of slots and readings.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, replace
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from jaxtyping import Float

import bayescal._model.independent_noise  # registers the built-in noise laws
import bayescal._model.summed_noise  # noqa: F401
from bayescal._core.errors import InputError, ModelError
from bayescal._core.lazy_jax import Array
from bayescal._core.result_table import as_html, make_table
from bayescal._data.column import Column, NominalScale
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY, basis_factor, unit_label
from bayescal._model.effect import READING, Coefficient, Effect, list_forms, tabulate_effects
from bayescal._model.frame import GROUPS, Frame
from bayescal._model.noise_law import Noise
from bayescal._model.static import static
from bayescal._model.unknown_effect import FREED_SUFFIX, freed, make_placeholder, parse_covariate
from bayescal._model.vector import Vector

Slots = Mapping[str, Float[Array, "n"]]
Columns = Mapping[str, Any]  # arrays by name, as a simulator gives them


@static
class Slot:
    """Quantity in a measurement equation to which effects add: a sum of effects, zero if there are none."""

    name: str
    unit: str
    meaning: str = ""


@static
class Use:
    """Measurand of a calibrated instrument in use: the quantity that is computed from a reading.

        use=bc.Use("rate_input", "deg/s")                  # a column that the response is a function of
        use=bc.Use("acceleration", "ug", equation=lambda a, slots, r: slots["bias"] + (1 + slots["scale"]) * a)

    Attributes:
        stimulus: name of the quantity; a column, if there is no equation.
        unit: its fixed unit.
        equation: the expected output in use, a function of (stimulus, slots, frame), output unit. None: the
            instrument's response with the stimulus in place of its column.
        slots: slots that act in use; empty for all. Those of a test rig (fixture tilt, base tilt) do not.
    """

    stimulus: str
    unit: str
    equation: Callable[[Float[Array, "n"], Slots, Frame], Float[Array, "n"]] | None = None
    slots: tuple[str, ...] = ()


@static
class Instrument:
    """A type of sensor: its columns, measurement equation, effects and noise laws.

    Attributes:
        name: folder and command-line name, such as "mems_gyro".
        title: description of the instrument in one line.
        columns: columns of a file of readings, "output" among them.
        slots: quantities that effects add to.
        response: function of slots and frame that returns the expected output (n,); element i depends only on the
            slots of reading i.
        effects: effects of the baseline model.
        candidates: further effects that a search, `discover`, may add.
        nuisances: effects of the test that are added to every fit whose readings can identify them, such as an
            unstated local gravity; they contribute to the coefficients' uncertainty.
        noise: noise law of the baseline model.
        noise_laws: further laws that a search evaluates, besides those offered for every record (`offered`).
        nominal_scale: conversion of raw outputs (V, Hz) to the unit of the output.
        structures: further models to compare, (name, function that builds the model).
        simulator: `simulator(effects, seed=…, **options)` returns the columns of a simulated campaign, by name; an
            undeclared column is named with its unit, `humidity [%]`. `simulate` converts them to measurements.
        experiments: feasible further campaigns: description, and function that returns the columns it would record;
            `next_experiment` ranks them.
        vector: three outputs and their equation, for an instrument of three axes: its files hold these outputs,
            `output` is computed from them, and `response` is `vector.response`.
        use: measurand in use; None if a single reading does not determine it.
        source: document with the equations.
        tailor: for an instrument of any output unit: `tailor(readings, **settings)` returns the instrument in the unit
            of these readings, with plausible sizes estimated from them unless given as settings.
        settings: settings of a tailored instrument: name, value; saved with its calibrations.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    slots: tuple[Slot, ...]
    response: Callable[[Slots, Frame], Float[Array, "n"]]
    effects: tuple[Effect, ...]
    candidates: tuple[Effect, ...] = ()
    nuisances: tuple[Effect, ...] = ()
    noise: Noise = field(default_factory=Noise.default)
    noise_laws: tuple[Noise, ...] = ()
    nominal_scale: NominalScale | None = None
    structures: tuple[tuple[str, Callable[[], Any]], ...] = ()
    simulator: Callable[..., Columns] | None = None
    experiments: tuple[tuple[str, Callable[[], Columns]], ...] = ()
    vector: Vector | None = None
    use: Use | None = None
    source: str = ""
    tailor: Callable[..., Instrument] | None = None
    settings: tuple[tuple[str, str | float], ...] = ()

    def __post_init__(self) -> None:
        """Raise ModelError if units disagree, or `use` names a slot or column that is missing."""
        time_column = next((c for c in self.columns if c.name == "time"), None)
        if time_column is not None and time_column.unit != "s":
            raise ModelError(
                f"instrument {self.name!r}: its column 'time' is in [{time_column.unit}]: declare it in [s], the unit "
                "of lags and times (a file may have its time in any unit)"
            )
        names = [s.name for s in self.slots]
        for effect in (*self.effects, *self.candidates):
            for coefficient in effect.coefficients:
                if (coefficient.slot or effect.slot) in names:
                    compute_factor(self, effect, coefficient)
        if self.use is None:
            return
        for slot in self.use.slots:
            if slot not in names:
                raise ModelError(
                    f"instrument {self.name!r}: use names the slot {slot!r}, which it does not have "
                    f"(it has {', '.join(names)})"
                )
        if self.use.equation is None:
            self.column(self.use.stimulus)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Reduce to the module and name of the instrument's definition, and the fields that differ from it."""
        module_name = self.response.__module__
        module_object = sys.modules.get(module_name)
        for name, value in vars(module_object).items() if module_object else ():
            if isinstance(value, Instrument) and value.name == self.name:
                if self.settings and value.tailor is not None:
                    return _unpickle, (module_name, name, None, dict(self.settings))
                fields, defaults = vars(self), vars(value)
                changed_fields = {f: fields[f] for f in fields if fields[f] is not defaults[f]}
                return _unpickle, (module_name, name, changed_fields, {})
        return object.__reduce_ex__(self, protocol)

    def __repr__(self) -> str:
        return f"<Instrument: {self.name}, {self.title}>"

    def _repr_html_(self) -> str:
        columns = [
            [c.name, unit_label(c.unit) if c.unit else "label", c.meaning] for c in self.columns
        ]
        table = make_table(["column", "unit", "meaning"], columns, left=3)
        effects = self.known.values()
        return as_html([f"{self.name}: {self.title}", table, tabulate_effects(effects)])

    def for_readings(self, readings: Measurements) -> Instrument:
        """Tailor the instrument to readings if it has a `tailor`; otherwise return it unchanged."""
        return self if self.tailor is None else self.tailor(readings)

    def simulate(
        self, effects: Mapping[str, float] | None = None, *, seed: int, **options: Any
    ) -> Measurements:
        """Simulate the readings of a campaign with given effects.

        Args:
            effects: canonical name → true size, in the unit of the effect's coefficient.
            seed: seed of the random-number generator.
            options: options of the instrument's simulator, such as its campaign.

        Raises:
            ModelError: the instrument has no simulator.
            ValueError: an argument is invalid for the simulator, such as an unknown effect.
        """
        if self.simulator is None:
            raise ModelError(f"instrument {self.name!r} has no `simulator`: define one")
        return Measurements.from_arrays(self, **self.simulator(effects, seed=seed, **options))

    if TYPE_CHECKING:

        def baseline(self) -> Any:
            """Return the `Model` with the baseline effects and noise law; `model.py` attaches it."""

    @property
    def groups(self) -> tuple[str, ...]:
        """Return the groups of coefficients: run, cell, axis, device, reading, and the instrument's label columns."""
        labels = (column.name for column in self.columns if column.unit is None)
        return tuple(dict.fromkeys((*GROUPS, READING, *labels)))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Return the three columns from which the output is computed; () if files hold the output itself."""
        return () if self.vector is None else self.vector.outputs

    @property
    def unit(self) -> str:
        """Return the unit of the output, or "any" until the instrument is tailored to readings."""
        unit = self.column("output").unit
        assert unit is not None
        return unit

    def column(self, name: str) -> Column:
        for column in self.columns:
            if column.name == name:
                return column
        raise ModelError(
            f"instrument {self.name!r} has no column {name!r}; it has "
            f"{', '.join(c.name for c in self.columns)}"
        )

    def slot(self, name: str) -> Slot:
        """Return a slot by name; a numeric column is also a slot, in its unit; raise ModelError if there is none."""
        for slot in self.slots:
            if slot.name == name:
                return slot
        for c in self.columns:
            if c.name == name and c.unit is not None and name != "output":
                return Slot(name, "delta_degC" if c.unit == "degC" else c.unit, c.meaning)
        raise ModelError(
            f"instrument {self.name!r} has no slot {name!r}; an effect can add to "
            f"{', '.join(s.name for s in self.slots)}, or correct a numeric column"
        )

    @property
    def known(self) -> dict[str, Effect]:
        """Return the instrument's effects by name, each followed by its forms."""
        return {e.name: e for e in list_forms((*self.effects, *self.candidates, *self.nuisances))}

    def effect(self, name: str, more: Mapping[str, Effect] = MappingProxyType({})) -> Effect:
        """Return an effect of the instrument by canonical name, or the placeholder "unknown(covariate)".

        Args:
            more: further effects by name, which take precedence.

        Raises:
            ModelError: no effect has that name.
        """
        if (effect := {**self.known, **more}.get(name)) is not None:
            return effect
        if covariate := parse_covariate(name):
            return self.unknown(covariate)
        if name.endswith(FREED_SUFFIX):
            return freed(self.effect(name.removesuffix(FREED_SUFFIX), more))
        raise ModelError(
            f"instrument {self.name!r} has no effect {name!r}; it has {', '.join(self.known)}. "
            "Define one of your own with --effects or --effect (in Python: a bayescal.Effect)"
        )

    def shown_by(self, frame: Frame, more: Iterable[Effect] = ()) -> tuple[Effect, ...]:
        """Return the effects of the instrument and in `more` whose columns are all in the frame."""
        effects = {**self.known, **{e.name: e for e in more}}
        labels = (label.split("=")[0] for label in frame.labels)
        available = {*frame.columns, *frame.codes, *labels, "temperature_point"}
        return tuple(e for e in effects.values() if available.issuperset(e.columns))

    def unknown(self, covariate: str) -> Effect:
        """Return a placeholder effect: an unknown dependence of the output on a covariate, smooth or of another form.

        Its plausible amplitudes are estimated from the readings to which the model is fitted.

        Args:
            covariate: a numeric column, "elapsed" (time within the run), or a temperature's rate such as
                "temperature rate". Other forms: "humidity, line" (or jump, kink, peak), "time, cycle".

        Raises:
            ModelError: no slot has the output's unit.
        """
        output_slot = next((s for s in self.slots if s.unit == self.unit != ANY), None)
        if output_slot is None:
            raise ModelError(
                f"An unknown dependence is added to the output, and instrument {self.name!r} has no slot in the unit "
                f"of its output, [{self.unit}]: declare one among its `slots`, as a term of its `response`"
            )
        return make_placeholder(covariate, output_slot.name, output_slot.unit)


def _unpickle(
    module: str, name: str, changed_fields: dict[str, Any] | None, settings: dict[str, Any]
) -> Instrument:
    """Restore a pickled instrument from its definition in a module, tailored with `settings` or with changed fields."""
    instrument: Any = getattr(import_module(module), name)
    if settings:
        return instrument.tailor(None, **settings)
    return replace(instrument, **changed_fields) if changed_fields else instrument


def compute_factor(instrument: Instrument, effect: Effect, coefficient: Coefficient) -> float:
    """Return the factor that converts coefficient × basis column to the slot's unit.

    The coefficient is in its reported unit; basis inputs are in declared units, or base units if undeclared.

    Raises:
        ModelError: the units of coefficient, columns and slot do not agree.
    """
    all_units = {c.name: str(c.unit) for c in instrument.columns if c.unit not in (None, ANY)}
    slot = instrument.slot(coefficient.slot or effect.slot)
    names = {*GROUPS, "temperature_point", "time", "elapsed", *(c.name for c in instrument.columns)}
    used_units = {name: all_units[name] for name in effect.columns if name in all_units}
    unused_units = {unit for name, unit in all_units.items() if name not in (*used_units, "output")}
    units, has_unknown = tuple(sorted({*used_units.values()})), not names.issuperset(effect.columns)
    other_units = (*(s.unit for s in effect.shapes), *sorted(unused_units))
    try:
        return basis_factor(coefficient.unit, slot.unit, units, has_unknown, other_units)
    except InputError as error:
        columns = ", ".join(f"{name} [{unit}]" for name, unit in used_units.items()) or "none"
        raise ModelError(
            f"effect {effect.name!r}: {error}. Its columns: {columns}. A basis gets each column in the unit that the "
            "instrument declares, and coefficient × basis is in the unit of the slot: correct the unit of the "
            f"coefficient or of the column, or list in `columns` all that the basis uses (columns={effect.columns})"
        ) from None
