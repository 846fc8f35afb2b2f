"""Load the user's own Python files, which define effects, noise laws or an instrument, on request.

The module imports nothing heavy at the top: commands load it at start.
"""

from __future__ import annotations

import sys
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import TYPE_CHECKING

from bayescal._core.atomic_file import compute_sha256
from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from bayescal._model.effect import Effect
    from bayescal._model.instrument import Instrument

_MODULES: dict[tuple[str, str], ModuleType] = {}  # run in this process, by path and SHA-256


def load_user_effects(path: Path | None) -> tuple[Effect, ...]:
    """Run a user's file and return its effects: EFFECTS, or every Effect in it; none if it defines only noise laws.

    A noise law is registered by its class name when the file is run; searches evaluate it if the file offers it.

    Raises:
        InputError: the file does not exist, fails, or defines neither effects nor noise laws.
    """
    if path is None:
        return ()
    from bayescal._model.effect import Effect
    from bayescal._model.noise_law import Noise

    module = run_file(path)
    namespace = vars(module)
    effects = namespace.get("EFFECTS", [v for v in namespace.values() if isinstance(v, Effect)])
    effects = (effects,) if isinstance(effects, Effect) else tuple(effects)
    laws = (v for v in namespace.values() if isinstance(v, type) and issubclass(v, Noise))
    has_law = any(law.__module__ == module.__name__ for law in laws)
    if not (effects or has_law) or not all(isinstance(e, Effect) for e in effects):
        raise InputError(
            f"{path} defines no effect: write EFFECTS = (bayescal.Effect(…),), or a noise law, a class derived from "
            "bayescal.Noise"
        )
    return effects


def instrument_named(name: str) -> Instrument:
    """Return an installed instrument, or one in a file (my.py:INSTRUMENT); raise InputError if it does not exist."""
    if not is_file_reference(name):
        from bayescal._model.installed import load_instrument

        return load_instrument(name)
    from bayescal._model.instrument import Instrument

    file, _, attribute = name.rpartition(":")
    instrument = getattr(run_file(Path(file)), attribute, None)
    if not isinstance(instrument, Instrument):
        raise InputError(f"{file} defines no instrument called {attribute!r}: give FILE.py:NAME")
    return instrument


def is_file_reference(name: str) -> bool:
    """Return whether an instrument's name refers to a file: my.py:INSTRUMENT."""
    return name.rpartition(":")[0].endswith(".py")


def run_file(path: Path) -> ModuleType:
    """Run a user's Python file, once per process and content, without writing a compiled copy.

    Raises:
        InputError: the file does not exist, fails, or calls exit; its message has the line number.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    key = file, _ = str(path.resolve()), compute_sha256(path)
    if key not in _MODULES:
        module = _MODULES[key] = ModuleType(path.stem)
        module.__file__ = file
        # Objects defined in the file can then be pickled by the module's name; a loaded module is not replaced.
        sys.modules.setdefault(path.stem, module)
        try:
            exec(compile(path.read_bytes(), file, "exec", dont_inherit=True), vars(module))
        except BaseException as error:  # SystemExit, too, is reported as an error of the file
            location = f", line {line}" if (line := find_file_line(error)[1]) else ""
            del _MODULES[key]
            raise InputError(f"{path}{location} could not be run: {format_error(error)}") from None
    return _MODULES[key]


def find_file_line(error: BaseException) -> tuple[str, int]:
    """Return file and line of the innermost frame of an error's traceback in a user's file that was run; or ("", 0)."""
    lines = [(f.filename, f.lineno) for f in extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError):
        lines.append((error.filename or "", error.lineno))
    user_files = {file for file, _ in _MODULES}
    return next(((file, n) for file, n in reversed(lines) if file in user_files and n), ("", 0))


def format_error(error: BaseException) -> str:
    """Format an exception raised by a user's file as its type and message."""
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}{': ' if message else ''}{message}"
