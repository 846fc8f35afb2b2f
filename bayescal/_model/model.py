"""A model: an instrument, a set of effects and a noise law. Adding an effect gives a new model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayescal._core.errors import ModelError
from bayescal._core.result_table import Printed, ResultTable
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY
from bayescal._model.effect import READING, Coefficient, Effect, tabulate_effects
from bayescal._model.formula import require_units
from bayescal._model.frame import GROUPS, list_covariates
from bayescal._model.instrument import Instrument, compute_factor
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.prior import Normal
from bayescal._model.static import static


@static
class Model(Printed):
    """An instrument, a set of effects and a noise law. Immutable; `+` and `-` return new models.

        model = instrument.baseline() + "bias.thermal_lag" - "bias.temperature"

    Attributes:
        instrument: columns, slots and measurement equation.
        effects: effects of the model, in order of addition.
        noise: noise law.
        fixed: unknowns fixed at a value, (name, value in its reported unit).
    """

    instrument: Instrument
    effects: tuple[Effect, ...]
    noise: Noise
    fixed: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        for effect in self.effects:
            for coefficient in effect.coefficients:
                if self.instrument.slot(coefficient.slot or effect.slot).unit != ANY:
                    compute_factor(self.instrument, effect, coefficient)
                _require_known_group(self.instrument, effect, coefficient.per)

    def _list_parts(self) -> list[str | ResultTable]:
        fixed = [f"{name} = {value:g}" for name, value in self.fixed]
        lines = [f"{self.instrument.name}, noise {self.noise.in_words}"]
        table = [tabulate_effects(self.effects)] if self.effects else []
        return [*lines, *table, *([f"fixed: {', '.join(fixed)}"] if fixed else [])]

    def _format_summary(self) -> str:
        return format_model(self)

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return the columns of a table, one row per coefficient; the plausible size is in the coefficient's unit."""
        rows = [(e, i, c) for e in self.effects for i, c in enumerate(e.coefficients)]
        return {
            "coefficient": [e.coefficient_name(i) for e, i, _ in rows],
            "effect": [e.name for e, _, _ in rows],
            "slot": [c.slot or e.slot for e, _, c in rows],
            "per": [c.per or "" for _, _, c in rows],
            "plausible size": [float("inf") if c.flat else c.size for _, _, c in rows],
            "unit": [c.unit for _, _, c in rows],
            "equation": [e.equation for e, _, _ in rows],
        }

    @property
    def groups(self) -> tuple[str, ...]:
        """Return the groups of the model's coefficients that have one per member, except "reading"."""
        group_names = (c.per for effect in self.effects for c in effect.coefficients if c.per)
        return tuple(dict.fromkeys(per for per in group_names if per != READING))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)

    def form_note(self, name: str) -> str:
        """Return the suffix " (basic form)" for an effect's name if the model has another form too, otherwise ""."""
        return " (basic form)" * any(effect.family == name for effect in self.effects)

    @property
    def columns(self) -> frozenset[str]:
        """Return the columns of the readings that the effects depend on."""
        return frozenset(n for e in self.effects for n in (*e.columns, *e.varies))

    def __add__(self, other: Effect | str | Iterable[Effect | str]) -> Model:
        """Add effects or their canonical names; raise ModelError if one is present, or has an unknown slot or name."""
        if not isinstance(other, (Effect, str)):
            model = self
            for item in other:
                model = model + item
            return model
        effect = self.instrument.effect(other) if isinstance(other, str) else other
        if effect.name in self.names:
            raise ModelError(
                f"effect {effect.name!r} is in the model already (it has: {', '.join(self.names)}); "
                f"to replace it, remove it first: model - {effect.name!r}"
            )
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, other: Effect | str) -> Model:
        """Remove an effect; raise ModelError if it is not in the model."""
        removed = self.effect(other if isinstance(other, str) else other.name)
        effects = tuple(e for e in self.effects if e.name != removed.name)
        fixed = tuple((n, v) for n, v in self.fixed if n not in removed.unknown_names)
        return replace(self, effects=effects, fixed=fixed)

    def with_nuisances(self, readings: Measurements) -> Model:
        """Return the model with the instrument's nuisance effects that these readings can test."""
        missing_effects = (e for e in self.instrument.nuisances if e.name not in self.names)
        return self + [e for e in missing_effects if why_untestable(e, readings) is None]

    def effect(self, name: str) -> Effect:
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise ModelError(f"effect {name!r} is not in the model; it has: {', '.join(self.names)}")

    def with_noise(self, noise: Noise) -> Model:
        return replace(self, noise=noise)

    def fix(self, values: Mapping[str, float]) -> Model:
        """Return the model with unknowns fixed at values: name → value, in the unit in which it is reported.

        To check a published calibration, fix all its coefficients and inspect the residuals. With noise.white at 0
        the only noise is each reading's known uncertainty, in the column `output_uncertainty`.

        Raises:
            ModelError: no unknown has that name, or the value is not finite, or not positive where it must be.
        """
        self._require_unknowns(values)
        positives = {n for n, p in self.noise.parameters().items() if not isinstance(p, Normal)}
        for e in self.effects:
            positives.update(e.group_sd_names)
            positives |= {e.shape_name(s) for s in e.shapes if s.scale != "linear"}
        for name, value in values.items():
            if not math.isfinite(value):
                raise ModelError(f"{name!r} cannot be fixed to {value}: give a finite number")
            if name == WHITE and value == 0:
                continue  # the known uncertainties of the readings are the only noise
            if name in positives and value <= 0:
                raise ModelError(f"{name!r} cannot be fixed to {value}: give a positive number")
        return replace(self, fixed=tuple({**dict(self.fixed), **values}.items()))

    def free(self, *names: str) -> Model:
        """Return the model with fixed unknowns estimated again, by name (default: all); raise ModelError for others."""
        self._require_unknowns(names)
        return replace(self, fixed=tuple((n, v) for n, v in self.fixed if names and n not in names))

    def resize(self, name: str, size: float) -> Model:
        """Return the model with `size` as plausible size of an effect's first coefficient; others scale.

        Raises:
            ModelError: the effect is not in the model, states no plausible size, or this one is not positive.
        """
        effect, coefficient = self.effect(name), self.effect(name).coefficients[0]
        if effect.is_placeholder or coefficient.flat or not 0 < size < math.inf:
            reason = "a size must be positive and finite; a placeholder or a flat prior has none"
            raise ModelError(f"the plausible size of {name!r} cannot be set to {size}: {reason}")
        # Rounded, so that a saved size gives the same priors again.
        ratios = ((c, float(f"{c.size / coefficient.size:.12g}")) for c in effect.coefficients)
        new_effect = replace(effect, coefficients=tuple(_resize(c, r * size) for c, r in ratios))
        return replace(self, effects=tuple(new_effect if e is effect else e for e in self.effects))

    @property
    def noise_as_stated(self) -> bool:
        """Return whether the known uncertainties of the readings are the only noise."""
        return dict(self.fixed).get(WHITE) == 0

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Return the names of all coefficients, shapes and noise parameters."""
        return (*(n for e in self.effects for n in e.unknown_names), *self.noise.parameters())

    def _require_unknowns(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self.unknowns:
                message = f"the model has no unknown {name!r}; it has: {', '.join(self.unknowns)}"
                raise ModelError(message)

    def require(self, readings: Measurements) -> None:
        """Raise ModelError if the model cannot be fitted to the readings: unit, columns, uncertainties, noise."""
        model_unit, unit = self.instrument.unit, readings.unit(readings.output)
        if model_unit == ANY:
            raise ModelError(
                f"Instrument {self.instrument.name!r} takes its unit and plausible sizes from readings: build "
                "the model from instrument.for_readings(readings)"
            )
        if unit != model_unit:
            raise ModelError(
                f"The output of {readings.file} is in [{unit}], the model's is in [{model_unit}]: read the file with "
                "the model's own instrument, or tailor the instrument to these readings"
            )
        for effect in self.effects:
            require_units(effect, readings, self.instrument)
            for column in effect.columns:
                if not readings.has(column):
                    raise ModelError(
                        f"Effect {effect.name!r} needs the column {column!r}, which {readings.file} lacks "
                        f"(it has: {', '.join(readings.columns)}). Record it, or remove the effect"
                    )
                if effect.is_placeholder and readings.unit(column) is None:
                    raise ModelError(
                        f"Effect {effect.name!r} needs a numeric column, and {column!r} of {readings.file} has labels: "
                        "for a deviation per label use an effect with coefficients per group, such as bias.run"
                    )
        for column in self.noise.needs:
            if not readings.has(column):
                raise ModelError(
                    f"{self.noise.law} noise needs the column {column!r}, which {readings.file} lacks: record it, "
                    "or use White() noise"
                )
        if reason := self.noise.why_not(readings[readings.output]):
            raise ModelError(
                f"{self.noise.name} noise cannot be used with {readings.file}: {reason}. Give the rounding step in "
                f"[{model_unit}], or use White() noise"
            )
        covariates = list_covariates(readings, include_all=True) if self.noise.covariates else {}
        for name in self.noise.covariates:
            if name not in covariates:
                raise ModelError(
                    f"{self.noise.name} noise depends on {name!r}, which is not a covariate of {readings.file} (it "
                    f"has: {', '.join(covariates)}). Name one of these (elapsed needs several runs)"
                )
        has_uncertainties = readings.has(UNCERTAINTY) and np.all(readings[UNCERTAINTY] > 0)
        if self.noise_as_stated and not has_uncertainties:
            raise ModelError(
                f"With {WHITE} fixed to 0 each reading needs a known uncertainty, a positive number in the column "
                f"{UNCERTAINTY!r}, which {readings.file} lacks: record it, or free {WHITE}"
            )


def format_model(model: Model) -> str:
    """Format a model as one line: instrument, effects, noise law."""
    fixed = f", {len(model.fixed)} fixed" if model.fixed else ""
    names = " + ".join(model.names) or "no effect"
    return f"{model.instrument.name}: {names}; noise {model.noise.law}{fixed}"


def baseline(self: Instrument) -> Model:
    """Return the model of the instrument with its baseline effects and noise law."""
    return Model(self, self.effects, self.noise)


Instrument.baseline = baseline  # attached here: `instrument` cannot import `model`


def _require_known_group(instrument: Instrument, effect: Effect, group: str | None) -> None:
    """Raise ModelError if an effect has a coefficient per member of a group that the instrument does not have."""
    if group is None or group in instrument.groups:
        return
    raise ModelError(
        f"effect {effect.name!r} has one coefficient for each {group!r}, and instrument {instrument.name!r} has no "
        f"such group; it has {', '.join(instrument.groups)}. Name one of these, or declare it as a label column of "
        f"the instrument: bayescal.Column({group!r}, None, required=False)"
    )


def _resize(c: Coefficient, size: float) -> Coefficient:
    if c.group_sd is not None:
        return replace(c, group_sd=replace(c.group_sd, scale=size))
    return replace(c, prior=Normal(c.mean, size)) if isinstance(c.prior, Normal) else c


def why_untestable(effect: Effect, readings: Measurements) -> str | None:
    """Return the reason why these readings cannot test the effect, as a message; None if they can."""
    if missing_columns := [c for c in effect.columns if not readings.has(c)]:
        return f"needs the column {', '.join(missing_columns)}"
    for column in effect.varies:
        column_values = readings[column]
        if (column_values == column_values[0]).all():
            return f"needs {column} to vary; it is {column_values[0]:g} throughout"
    # One member gives no standard deviation between members; an effect with other coefficients can still be fitted.
    has_only_deviations = all(c.group_sd is not None for c in effect.coefficients)
    for coefficient in effect.coefficients:
        is_label_group = coefficient.per not in (None, READING, *GROUPS)
        if is_label_group and not readings.has(str(coefficient.per)):
            return f"needs the column {coefficient.per}"
        if has_only_deviations and coefficient.per is not None:
            _, codes = readings.groups(coefficient.per)
            if len(set(codes[codes >= 0].tolist())) < 2:
                return f"needs more than one {coefficient.per}"
    return None if effect.untestable is None else effect.untestable(readings)
