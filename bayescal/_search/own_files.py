"""Python files of the user's own: effects and noise laws that they define, an instrument. Run where the user asks.

Light: commands load it before anything heavy.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from traceback import walk_tb
from types import ModuleType
from typing import TYPE_CHECKING

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from bayescal._model.effect import Effect
    from bayescal._model.instrument import Instrument

OWN_FILES: dict[str, str] = {}
"""Those that this process has run, with the SHA-256 that they had."""
_RAN: dict[tuple[str, str], ModuleType] = {}  # by path and SHA-256


def refuse_unnamed(files: Iterable[str], named: Iterable[str | Path], by: str | Path) -> None:
    """Refuse Python files that data name, where neither the user nor this process has named them before.

    Raises:
        InputError: one of them is not named; says which, with its SHA-256.
    """
    allowed = {Path(path).resolve() for path in named}
    for file in files:
        path = Path(file).resolve()
        digest = sha256_of(path) if path.is_file() else "none: it is not there"
        # By content: a file that was run and has been changed since is another one.
        ran = {own for origin, own in OWN_FILES.items() if Path(origin).resolve() == path}
        if path not in allowed and digest not in ran:
            raise InputError(
                f"{by} names the Python file {path} (SHA-256 {digest}), which this command does not: it would be run, "
                f"and was not. If you know what is in it, say so: --trust {path} (in Python: trust=[…])"
            )


def user_effects(path: Path | None) -> tuple[Effect, ...]:
    """The effects that a user's file defines: its EFFECTS, or every Effect in it; none, if it defines noise laws.

    A noise law needs no more than that its file is run: its class is known by its name from then on, and searches
    weigh it where the file offers it.

    Raises:
        InputError: no such file, it fails, or it defines neither.
    """
    if path is None:
        return ()
    from bayescal._model.effect import Effect
    from bayescal._model.noise_law import Noise

    module = run_file(path)
    own = [
        v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__
    ]
    with_law = any(issubclass(kind, Noise) for kind in own)
    effects = getattr(module, "EFFECTS", None)
    if effects is None:
        effects = tuple(v for v in vars(module).values() if isinstance(v, Effect))
    if isinstance(effects, Effect):
        effects = (effects,)
    if not (effects or with_law) or not all(isinstance(e, Effect) for e in effects):
        raise InputError(
            f"{path} defines no effect: write EFFECTS = (bayescal.Effect(…),), or a noise law, a class derived from "
            "bayescal.Noise"
        )
    return tuple(effects)


def instrument_named(name: str) -> Instrument:
    """An installed instrument, or one in a file: my.py:INSTRUMENT.

    Raises:
        InputError: there is none.
    """
    if in_a_file(name):
        from bayescal._model.instrument import Instrument

        file, _, attribute = name.rpartition(":")
        instrument = getattr(run_file(Path(file)), attribute, None)
        if not isinstance(instrument, Instrument):
            raise InputError(
                f"{file} defines no instrument called {attribute!r}: give FILE.py:NAME"
            )
        return instrument
    from bayescal._model.installed import installed_instrument

    return installed_instrument(name)


def in_a_file(name: str) -> bool:
    """Whether an instrument is one in a file: my.py:INSTRUMENT."""
    return name.rpartition(":")[0].endswith(".py")


def run_file(path: Path) -> ModuleType:
    """Run a user's Python file, once in a process as long as its bytes are the same; leave no compiled copy beside it.

    Raises:
        InputError: it is not there, or fails, or would end the program; says in which line.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    file, digest = str(path.absolute()), sha256_of(path)
    if done := _RAN.get((str(path.resolve()), digest)):
        return done
    module = ModuleType(path.stem)
    module.__file__ = file
    # So that what the file defines can be pickled by its module's name; a module of that name that is there stays.
    sys.modules.setdefault(path.stem, module)
    OWN_FILES[file] = digest
    try:
        exec(compile(path.read_bytes(), file, "exec", dont_inherit=True), vars(module))
    except BaseException as error:  # SystemExit too: what a user's file does wrong is said in words
        where = own_file_line(error).removeprefix(file)
        raise InputError(f"{path}{where} could not be run: {in_one_line(error)}") from None
    _RAN[str(path.resolve()), digest] = module
    return module


def own_file_line(error: BaseException) -> str:
    """Where in a file of the user's own that this process has run an error arose; empty if in none.

    For a syntax error the line that it names, else the last line in such a file before it.
    """
    if isinstance(error, SyntaxError) and error.filename in OWN_FILES and error.lineno:
        return f"{error.filename}, line {error.lineno}"
    lines = [
        f"{frame.f_code.co_filename}, line {line}"
        for frame, line in walk_tb(error.__traceback__)
        if frame.f_code.co_filename in OWN_FILES
    ]
    return lines[-1] if lines else ""


def in_one_line(error: BaseException) -> str:
    """An error of a user's own file: its kind and what it says."""
    said = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}{': ' if said else ''}{said}"
