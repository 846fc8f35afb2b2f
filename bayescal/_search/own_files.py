"""Python files of the user's own: effects and noise laws that they define, an instrument. Run where the user asks.

Light: commands load it before anything heavy.
"""

from __future__ import annotations

import sys
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import TYPE_CHECKING

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from bayescal._model.effect import Effect
    from bayescal._model.instrument import Instrument

_RAN: dict[tuple[str, str], ModuleType] = {}  # in this process, by path and SHA-256


def load_user_effects(path: Path | None) -> tuple[Effect, ...]:
    """Return the effects that a user's file defines: its EFFECTS, or every Effect in it; none of one of noise laws.

    A noise law is known by its class's name once its file was run, and searches weigh it where the file offers it.

    Raises:
        InputError: no such file, it fails, or it defines neither.
    """
    if path is None:
        return ()
    from bayescal._model.effect import Effect
    from bayescal._model.noise_law import Noise

    module = run_file(path)
    defined = vars(module)
    effects = defined.get("EFFECTS", [v for v in defined.values() if isinstance(v, Effect)])
    effects = (effects,) if isinstance(effects, Effect) else tuple(effects)
    laws = (v for v in defined.values() if isinstance(v, type) and issubclass(v, Noise))
    with_law = any(law.__module__ == module.__name__ for law in laws)
    if not (effects or with_law) or not all(isinstance(e, Effect) for e in effects):
        raise InputError(
            f"{path} defines no effect: write EFFECTS = (bayescal.Effect(…),), or a noise law, a class derived from "
            "bayescal.Noise"
        )
    return effects


def instrument_named(name: str) -> Instrument:
    """Return an installed instrument, or one in a file, my.py:INSTRUMENT; raise InputError where there is none."""
    if not in_a_file(name):
        from bayescal._model.installed import installed_instrument

        return installed_instrument(name)
    from bayescal._model.instrument import Instrument

    file, _, attribute = name.rpartition(":")
    instrument = getattr(run_file(Path(file)), attribute, None)
    if not isinstance(instrument, Instrument):
        raise InputError(f"{file} defines no instrument called {attribute!r}: give FILE.py:NAME")
    return instrument


def in_a_file(name: str) -> bool:
    """Return whether an instrument is one in a file: my.py:INSTRUMENT."""
    return name.rpartition(":")[0].endswith(".py")


def run_file(path: Path) -> ModuleType:
    """Run a user's Python file, once in a process as long as its bytes are the same; leave no compiled copy beside it.

    Raises:
        InputError: it is not there, or fails, or would end the program; says in which line.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    ran = file, _ = str(path.resolve()), sha256_of(path)
    if ran not in _RAN:
        module = _RAN[ran] = ModuleType(path.stem)
        module.__file__ = file
        # So that what the file defines can be pickled by its module's name; a module that is there stays.
        sys.modules.setdefault(path.stem, module)
        try:
            exec(compile(path.read_bytes(), file, "exec", dont_inherit=True), vars(module))
        except BaseException as error:  # SystemExit too: what a file does wrong is said in words
            where = f", line {line}" if (line := own_file_line(error)[1]) else ""
            del _RAN[ran]
            raise InputError(f"{path}{where} could not be run: {format_error(error)}") from None
    return _RAN[ran]


def own_file_line(error: BaseException) -> tuple[str, int]:
    """Return the last line of a user's file, which this process has run, in an error: file and line, or ("", 0)."""
    lines = [(f.filename, f.lineno) for f in extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError):
        lines.append((error.filename or "", error.lineno))
    user_files = {file for file, _ in _RAN}
    return next(((file, n) for file, n in reversed(lines) if file in user_files and n), ("", 0))


def format_error(error: BaseException) -> str:
    """Return an error of a user's own file as text: its kind and what it says."""
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}{': ' if message else ''}{message}"
