"""Frozen dataclasses that compare by their fields and are static arguments (pytree structure) for JAX."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

from typing_extensions import dataclass_transform

from bayescal._core.lazy_jax import jax, on_import

_T = TypeVar("_T")


@dataclass_transform(frozen_default=True)
def static(cls: type[_T]) -> type[_T]:
    """Make a frozen dataclass, registered as static in JAX: equal values share a compiled program."""
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = format_fields
    frozen_class = dataclass(frozen=True, repr=False)(cls)
    on_import(lambda: jax.tree_util.register_static(frozen_class))
    return frozen_class


def format_fields(self: Any) -> str:
    """Format the fields that differ from their defaults as a `repr`, which is reproducible after pickling."""
    values = {f.name: getattr(self, f.name) for f in fields(self) if f.repr}
    defaults = {f.name: f.default for f in fields(self)}
    arguments = (f"{name}={value!r}" for name, value in values.items() if value != defaults[name])
    return f"{type(self).__name__}({', '.join(arguments)})"


def set_fields(self: Any, **values: Any) -> None:
    """Set fields of a frozen instance to normalised values, in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(self, name, value)
