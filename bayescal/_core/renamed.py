"""Aliases of renamed public attributes, which issue a DeprecationWarning, for one release."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

C = TypeVar("C", bound=type)


class _Former(NamedTuple):
    name: str
    new: str

    def __get__(self, instance: Any, owner: type) -> Any:
        message = f"{owner.__name__}.{self.name} is now called {self.new}; the former name will be removed in 0.4"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(owner if instance is None else instance, self.new)


def renamed(**names: str) -> Callable[[C], C]:
    """Decorate a class with aliases of renamed attributes: former="new"."""

    def add_aliases(cls: C) -> C:
        for name, new_name in names.items():
            setattr(cls, name, _Former(name, new_name))
        return cls

    return add_aliases
