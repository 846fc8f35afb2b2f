"""One model for all devices, where an instrument takes its unit and plausible sizes from readings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._model.effect import Effect
from bayescal._model.model import Model


def tailored(model: Model, readings: Measurements) -> Model:
    """The model with its instrument tailored to one device's readings; the same where nothing has to be.

    What it has of the instrument's own (effects, the noise law) is that of the tailored one; what was changed stays. A
    size that was changed is one in parts of what a record shows, as all of the general instrument's are.
    """
    general = model.instrument
    own = general.for_readings(readings)
    if own is general:
        return model
    stated = {e.name: e for e in (*general.effects, *general.candidates)}
    sized = {e.name: e for e in (*own.effects, *own.candidates)}
    parts = {
        e.name: e.coefficients[0].size / stated[e.name].coefficients[0].size
        for e in model.effects
        if e.name in stated and e == _sized_as(e, stated[e.name])
    }
    effects = tuple(sized.get(e.name, e) if e.name in parts else e for e in model.effects)
    noise = own.noise if model.noise == general.noise else model.noise
    made = Model(own, effects, noise, model.fixed)
    for name, part in parts.items():
        if part != 1:
            made = made.resize(name, part * made.effect(name).coefficients[0].size)
    return made


def _sized_as(effect: Effect, stated: Effect) -> Effect:
    """An effect as it is stated, of the sizes that this one has."""
    return replace(stated, coefficients=effect.coefficients)


def tailored_to_first(
    model: Model, devices: Iterable[Measurements]
) -> tuple[Model, Measurements | None]:
    """The model tailored to the first device that it can be tailored to, and that device; None where there is none.

    Raises:
        InputError: no device has what the instrument takes from readings: why, of the first.
    """
    refusals: list[InputError] = []
    for readings in devices:
        try:
            return tailored(model, readings), readings
        except InputError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]
    return model, None
