"""One model for all devices, where an instrument takes its unit and plausible sizes from readings."""

from __future__ import annotations

from collections.abc import Iterable

from bayescal._core.errors import InputError
from bayescal._model.model import Model
from bayescal._readings.measurements import Measurements


def tailored(model: Model, readings: Measurements) -> Model:
    """The model with its instrument tailored to one device's readings; the same where nothing has to be.

    What it has of the instrument's own (effects, the noise law) is that of the tailored one; what was changed stays.
    """
    general = model.instrument
    own = general.for_readings(readings)
    if own is general:
        return model
    stated = {e.name: e for e in (*general.effects, *general.candidates)}
    sized = {e.name: e for e in (*own.effects, *own.candidates)}
    effects = tuple(sized.get(e.name, e) if e == stated.get(e.name) else e for e in model.effects)
    noise = own.noise if model.noise == general.noise else model.noise
    return Model(own, effects, noise, model.fixed)


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
