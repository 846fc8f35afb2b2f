"""Instruments that installed packages offer, through the entry-point group `bayescal.instruments`.

Light until an instrument is asked for. The module that an entry point names may hold beside its `INSTRUMENT` the
`COLUMNS` of its files and, where it has them, its `NOMINAL_SCALE` and `OUTPUTS` (of three axes): if they are there
before anything heavy is imported, a file is refused at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from bayescal._core.errors import InputError
from bayescal._data.column import Column, NominalScale
from bayescal._data.read_options import InstrumentLike

if TYPE_CHECKING:
    from bayescal._model.instrument import Instrument

GROUP = "bayescal.instruments"


@dataclass(frozen=True)
class FileColumns:
    """What the files of an instrument hold: as much of it as reading them takes."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None = None
    outputs: tuple[str, ...] = ()

    @classmethod
    def of(cls, instrument: InstrumentLike) -> FileColumns:
        """As the instrument itself says."""
        outputs = getattr(instrument, "outputs", ())
        return cls(instrument.name, instrument.columns, instrument.nominal_scale, outputs)


def installed_names() -> list[str]:
    """Names of the installed instruments, none of which is loaded."""
    return sorted(entry_points(group=GROUP).names)


def _entry(name: str) -> EntryPoint:
    if name not in (known := installed_names()):
        raise InputError(
            f"no instrument is called {name!r}; installed: {', '.join(known) or 'none'}. "
            "For one of your own give my.py:INSTRUMENT"
        )
    return entry_points(group=GROUP)[name]


def installed_instrument(name: str) -> Instrument:
    """An installed instrument, the others not loaded.

    Raises:
        InputError: none is installed under that name.
    """
    return _entry(name).load()


def file_columns(name: str) -> FileColumns | None:
    """What the files of an installed instrument hold, where its module says so without the instrument.

    Raises:
        InputError: none is installed under that name.
    """
    module = import_module(_entry(name).module)
    columns = getattr(module, "COLUMNS", None)
    more = getattr(module, "NOMINAL_SCALE", None), getattr(module, "OUTPUTS", ())
    return columns and FileColumns(name, columns, *more)


def installed_instruments() -> dict[str, Instrument]:
    """Every installed instrument, by name."""
    return {e.name: e.load() for e in sorted(entry_points(group=GROUP), key=lambda e: e.name)}
