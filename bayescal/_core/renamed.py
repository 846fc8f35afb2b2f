"""Aliases of renamed public attributes and arguments, which issue a DeprecationWarning, for one release."""

import warnings
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T", bound=Callable[..., Any])
NOTICE = "{} is now called {}; the former name will be removed in 0.4"
_warn = partial(warnings.warn, category=DeprecationWarning, stacklevel=2)


class _Former(NamedTuple):
    name: str
    new: str

    def __get__(self, instance: Any, owner: type) -> Any:
        _warn(NOTICE.format(f"{owner.__name__}.{self.name}", self.new))
        return getattr(owner if instance is None else instance, self.new)


def renamed(**names: str) -> Callable[[T], T]:
    """Decorate a class with aliases of attributes and fields, or a function with those of arguments: former="new"."""

    def add_aliases(target: Any) -> Any:
        if isinstance(target, type):
            for name, new_name in names.items():
                setattr(target, name, _Former(name, new_name))
            if {*names.values()} & vars(target).get("__dataclass_fields__", {}).keys():
                target.__init__ = renamed(**names)(target.__init__)
            return target

        @wraps(target)
        def call(*args: Any, **kwargs: Any) -> Any:
            for name in names.keys() & kwargs.keys():
                _warn(NOTICE.format(f"{target.__qualname__}({name}=)", names[name]))
                kwargs[names[name]] = kwargs.pop(name)
            return target(*args, **kwargs)

        return call

    return add_aliases
