"""Aliases of renamed public attributes and arguments, which issue a DeprecationWarning, for one release."""

import warnings
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T", bound=Callable[..., Any])
NOTICE = "{} is now called {}; the former name will be removed in 0.4"
_warn = partial(warnings.warn, category=DeprecationWarning, stacklevel=2)


class _Alias(NamedTuple):
    alias: str
    name: str

    def __get__(self, instance: Any, owner: type) -> Any:
        _warn(NOTICE.format(f"{owner.__name__}.{self.alias}", self.name))
        return getattr(owner if instance is None else instance, self.name)


def renamed(**names: str) -> Callable[[T], T]:
    """Return a decorator that adds aliases of attributes to a class, of arguments to a function: alias="name"."""

    def add_aliases(target: Any) -> Any:
        if isinstance(target, type):
            for alias, name in names.items():
                setattr(target, alias, _Alias(alias, name))
            if {*names.values()} & vars(target).get("__dataclass_fields__", {}).keys():
                target.__init__ = renamed(**names)(target.__init__)
            return target

        @wraps(target)
        def call(*args: Any, **kwargs: Any) -> Any:
            for alias in names.keys() & kwargs.keys():
                _warn(NOTICE.format(f"{target.__qualname__}({alias}=)", names[alias]))
                kwargs[names[alias]] = kwargs.pop(alias)
            return target(*args, **kwargs)

        return call

    return add_aliases
