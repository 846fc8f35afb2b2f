"""What may be done to a model: each change by its name, in words, and what comes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise

KINDS = {"add": 1, "take_out": 1, "fix": 2, "free": 1, "resize": 2, "noise": 1}


@dataclass(frozen=True)
class Change:
    """A model, and how it differs from the one before.

    Attributes:
        model: what comes of it.
        added: effect that was added; None where something else was done.
        in_words: that, in words; empty where an effect was added.
    """

    model: Model
    added: str | None = None
    in_words: str = ""


def changed(
    model: Model,
    kind: str,
    arguments: Sequence[Any],
    own: Mapping[str, Effect],
    laws: Mapping[str, Noise],
) -> Change:
    """A model with a change.

    Args:
        model: before it.
        kind: one of `KINDS`.
        arguments: as many as that says.
        own: effects that are not as the instrument states them, by name.
        laws: noise laws, by name.

    Raises:
        ModelError: the model cannot be changed so.
        InputError: there is no such change, or it takes other arguments.
    """
    if KINDS.get(kind) != len(arguments):
        takes = ", ".join(f"{name} ({count})" for name, count in KINDS.items())
        raise InputError(f"{kind!r} with {len(arguments)} argument(s) is none of: {takes}")
    name = str(arguments[0])
    if kind == "add":
        return Change(model + own.get(name, name), added=name)
    if kind == "take_out":
        return Change(model - name, in_words=f"− {name}")
    if kind == "free":
        return Change(model.free(name), in_words=f"{name} estimated again")
    if kind == "noise":
        if name not in laws:
            raise ModelError(f"no noise law is called {name!r} here; there are: {', '.join(laws)}")
        law = laws[name]
        return Change(model.with_noise(law), in_words=f"noise: {law.in_words}")
    value = float(arguments[1])
    if kind == "fix":
        return Change(model.fix({name: value}), in_words=f"{name} = {number(value, 6)} fixed")
    unit = unit_label(model.effect(name).coefficients[0].unit)
    size = f"{number(value)} {unit}".rstrip()
    return Change(model.resize(name, value), in_words=f"{name} of plausible size {size}")
