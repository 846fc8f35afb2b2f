"""Set-up of JAX: double precision, a cache of compiled programs.

Importing this module is cheap and does not import JAX. `bayescal/__init__.py` imports it first; `lazy_jax.py` has
`configure_jax()` called once JAX is imported, by whoever imports it.

Environment variables:
    BAYESCAL_CACHE: folder for bayescal's cache between runs, limited to 512 MiB at each start; empty for no
        cache.
    JAX_COMPILATION_CACHE_DIR: JAX's own; where set (or configured from Python), bayescal leaves the
        cache alone.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path

MAX_CACHE_BYTES = 512 * 1024**2  # of programs on disk; a first calibration leaves some 5 MB
MAX_MEMORY_MAPS = 30_000  # of 65,530 that Linux allows a process by default


def cache_folder() -> Path | None:
    """Return the folder of the cache between runs, which need not exist; None for no cache."""
    user_folder = os.environ.get("BAYESCAL_CACHE")
    if user_folder == "":
        return None
    xdg = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # XDG Base Directory Specification, which has relative folders ignored
        caches = Path(xdg) if os.path.isabs(xdg) else Path.home() / ".cache"
        return Path(user_folder).expanduser() if user_folder else caches / "bayescal"
    except RuntimeError:  # no home folder, as in some containers
        return None


@cache
def configure_jax() -> None:
    """Switch JAX to double precision and let it keep compiled programs on disk. Once per process.

    Double precision is a setting of the whole process. Calibration needs it: biases of 1e-9 of full scale beside
    readings of order one, normal equations that square a condition number.

    Every program is kept, however small: JAX's own threshold of one second of compilation would keep almost none of
    ours. A folder that cannot be written means no cache, never an error; one beyond `MAX_CACHE_BYTES` is emptied.
    """
    import jax  # heavy: not before something computes

    jax.config.update("jax_enable_x64", True)
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:  # the user's own choice
        return
    folder = (cache_folder() or Path(os.devnull)) / "jax"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):  # JAX would warn each time
        return
    drop_if_large(folder, MAX_CACHE_BYTES)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def drop_if_large(folder: Path, most: int) -> None:
    """Delete the programs in a folder once they take more than `most` bytes.

    JAX can bound its cache itself, but then reads a file for every program kept whenever it keeps one more: 0.1 s
    each time with 2,000 of them.
    """
    with suppress(OSError), os.scandir(folder) as entries:  # another process may delete them too
        if sum(entry.stat().st_size for entry in entries) > most:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()


def spare_memory_maps() -> None:
    """Drop compiled programs before they use up the maps that the kernel allows a process.

    Every program holds some ten; beyond 65,530, by default, Linux aborts the process, which a loop over many models
    meets. Programs that are needed again come back from the cache on disk. Does nothing on other systems.
    """
    try:
        with open("/proc/self/maps", "rb") as maps:
            count = sum(1 for _ in maps)
    except OSError:
        return
    if count > MAX_MEMORY_MAPS:
        import jax

        jax.clear_caches()


# Two libraries read a file of the current folder when they are loaded: file → library.
READERS = {"matplotlibrc": "matplotlib", "arvizrc": "arviz_base"}


def obey_no_folder() -> None:
    """Load libraries that would read a file of the current folder while another folder is the current one.

    To be called before other threads are begun: a process has one current folder. Costs nothing where there is no such
    file.
    """
    readers = [library for file, library in READERS.items() if os.path.lexists(file)]
    if readers:
        folder = os.getcwd()
        os.chdir(os.path.dirname(__file__))
        try:
            for library in readers:
                with suppress(ImportError):  # what needs it says so
                    import_module(library)
        finally:
            os.chdir(folder)
