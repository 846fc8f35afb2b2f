"""Instruments that installed packages offer, through the entry-point group `bayescal.instruments`."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from bayescal._model.instrument import Instrument

GROUP = "bayescal.instruments"


def installed_names() -> list[str]:
    """Names of the installed instruments, none of which is loaded."""
    return sorted(entry_points(group=GROUP).names)


def installed_instrument(name: str) -> Instrument:
    """An installed instrument, the others not loaded.

    Raises:
        InputError: none is installed under that name.
    """
    if name not in (known := installed_names()):
        raise InputError(
            f"no instrument is called {name!r}; installed: {', '.join(known) or 'none'}. "
            "For one of your own give my.py:INSTRUMENT"
        )
    return entry_points(group=GROUP)[name].load()


def installed_instruments() -> dict[str, Instrument]:
    """Every installed instrument, by name."""
    return {name: installed_instrument(name) for name in installed_names()}
