"""Lazy import of JAX at its first use, `from bayescal._core.lazy_jax import jax, jnp`, and its set-up.

JAX is set up as soon as any code imports it: double precision, a cache of compiled programs, and bayescal's types
registered as pytrees. A command that uses NumPy only does not import it, and starts in half the time.

Environment variables:
    BAYESCAL_CACHE: folder of bayescal's persistent cache, limited to 512 MiB at each start; empty for no cache.
    JAX_COMPILATION_CACHE_DIR: JAX's own variable; if set (or configured from Python), bayescal sets up no cache.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

MAX_CACHE_BYTES = 512 * 1024**2  # size of the cache on disk; a first calibration adds some 5 MB
MAX_MEMORY_MAPS = 30_000  # per process; Linux allows 65,530 by default


def find_cache_folder() -> Path | None:
    """Return the folder of the persistent cache, which need not exist; None for no cache."""
    user_folder = os.environ.get("BAYESCAL_CACHE")
    if user_folder == "":
        return None
    xdg = os.environ.get("XDG_CACHE_HOME", "")  # ignored if relative, as its specification requires
    try:
        cache_root = Path(xdg) if os.path.isabs(xdg) else Path.home() / ".cache"
        return Path(user_folder).expanduser() if user_folder else cache_root / "bayescal"
    except RuntimeError:  # no home folder, as in some containers
        return None


@cache
def configure_jax() -> None:
    """Switch JAX to double precision and configure its cache of compiled programs on disk, once per process.

    Double precision applies to the whole process. Calibration needs it for biases of 1e-9 of full scale, and for normal
    equations, which square the condition number.

    All programs are cached; JAX's default threshold, one second of compilation, would exclude almost all. An unwritable
    folder disables the cache without an error; a folder above `MAX_CACHE_BYTES` is emptied.
    """
    import jax  # slow to import

    jax.config.update("jax_enable_x64", True)
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:  # the user's own choice
        return
    folder = (find_cache_folder() or Path(os.devnull)) / "jax"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):  # JAX would warn each time
        return
    empty_if_large(folder, MAX_CACHE_BYTES)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def empty_if_large(folder: Path, max_bytes: int) -> None:
    """Delete the compiled programs in a folder if they exceed `max_bytes` in total.

    JAX's own size limit is not used: for each added program, it reads a file of every cached one, 0.1 s for 2,000.
    """
    with suppress(OSError), os.scandir(folder) as entries:  # another process may delete them too
        if sum(entry.stat().st_size for entry in entries) > max_bytes:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()


class _LazyModule:
    """A module that is imported when an attribute of it is first accessed."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        value = getattr(import_module(self._name), attribute)
        setattr(self, attribute, value)
        return value


class _JaxFinder(MetaPathFinder):
    """Meta-path finder that configures JAX and calls the pending callbacks once JAX is imported."""

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

            def load_and_set_up(module: Any) -> None:
                load(module)
                sys.meta_path.remove(self)
                _set_up()

            spec.loader.exec_module = load_and_set_up
        return spec


_pending_callbacks: list[Callable[[], object]] | None = []  # None once JAX is set up


def on_import(callback: Callable[[], object]) -> None:
    """Call a function once JAX is imported, or immediately if it already is."""
    if _pending_callbacks is None:
        callback()
    else:
        _pending_callbacks.append(callback)


def _set_up() -> None:
    global _pending_callbacks
    configure_jax()
    pending_callbacks, _pending_callbacks = _pending_callbacks or [], None
    for callback in pending_callbacks:
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


def free_memory_maps() -> None:
    """Clear JAX's compiled programs before the process exceeds the kernel's limit of memory maps (Linux only).

    A program uses about ten of the default 65,530 maps, beyond which Linux aborts the process; it is cached on disk.
    """
    try:
        count = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return
    if count > MAX_MEMORY_MAPS:
        jax.clear_caches()


# Configuration file that a library reads from the current folder at import → this library.
CONFIGURATION_FILES = {"matplotlibrc": "matplotlib", "arvizrc": "arviz_base"}


def ignore_local_configuration() -> None:
    """Import libraries from another folder, so that they ignore configuration files in the current folder.

    Only libraries whose configuration file is in the current folder are imported. Must be called before threads start,
    since the current folder is a property of the process.
    """
    libraries = [library for file, library in CONFIGURATION_FILES.items() if os.path.lexists(file)]
    if libraries:
        folder = os.getcwd()
        os.chdir(os.path.dirname(__file__))
        try:
            for library in libraries:
                with suppress(ImportError):  # reported where the library is needed
                    import_module(library)
        finally:
            os.chdir(folder)
