"""Lazy import of JAX at its first use: `from bayescal._core.lazy_jax import jax, jnp`.

JAX is set up as soon as any code imports it: double precision, and bayescal's types registered as pytrees. A command
that uses NumPy only does not import it, and starts in half the time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from bayescal._core.jax_setup import configure_jax


class _LazyModule:
    """A module that is imported when an attribute of it is first accessed."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        value = getattr(import_module(self._name), attribute)
        setattr(self, attribute, value)
        return value


class _JaxFinder(MetaPathFinder):
    """Import finder that sets JAX up once it is loaded."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if fullname != "jax":
            return None
        sys.meta_path.remove(self)
        try:
            spec = find_spec("jax")
        finally:
            sys.meta_path.insert(0, self)  # the module may be found, but not loaded
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def loaded(module: Any) -> None:
                load(module)
                sys.meta_path.remove(self)
                _set_up()

            spec.loader.exec_module = loaded
        return spec


_waiting: list[Callable[[], object]] | None = []  # None once JAX is set up


def when_imported(callback: Callable[[], object]) -> None:
    """Call a function when JAX is imported: now, if it already is."""
    if _waiting is None:
        callback()
    else:
        _waiting.append(callback)


def _set_up() -> None:
    global _waiting
    configure_jax()
    waiting, _waiting = _waiting or [], None
    for callback in waiting:
        callback()


if "jax" in sys.modules:
    _set_up()
else:
    sys.meta_path.insert(0, _JaxFinder())

if TYPE_CHECKING:
    import jax as jax
    import jax.numpy as jnp
    from jaxtyping import Array as Array
else:
    jax, jnp, Array = _LazyModule("jax"), _LazyModule("jax.numpy"), Any
