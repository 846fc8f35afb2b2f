"""Frozen dataclasses that are equal by their fields, and static structure to JAX."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

from typing_extensions import dataclass_transform

from bayescal._core.lazy_jax import jax, when_imported

_T = TypeVar("_T")


@dataclass_transform(frozen_default=True)
def static(cls: type[_T]) -> type[_T]:
    """Make a frozen dataclass that JAX takes as structure and not as data: equal values share a compiled program."""
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = in_full
    frozen_class = dataclass(frozen=True, repr=False)(cls)
    when_imported(lambda: jax.tree_util.register_static(frozen_class))
    return frozen_class


def in_full(self: Any) -> str:
    """Return a `repr` by the values of the fields, those at their defaults left out: the same after pickling."""
    values = {f.name: getattr(self, f.name) for f in fields(self) if f.repr}
    plain = {f.name: f.default for f in fields(self)}
    parts = (f"{name}={value!r}" for name, value in values.items() if value != plain[name])
    return f"{type(self).__name__}({', '.join(parts)})"


def set_once(self: Any, **values: Any) -> None:
    """Set normalised fields of a frozen value, in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(self, name, value)
