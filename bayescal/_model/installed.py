"""Instruments that installed packages offer, through the entry-point group `bayescal.instruments`."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from bayescal._model.instrument import Instrument

GROUP = "bayescal.instruments"


def list_installed() -> list[str]:
    """Return the names of the installed instruments, without loading one."""
    return sorted(entry_points(group=GROUP).names)


def load_instrument(name: str) -> Instrument:
    """Load an installed instrument by name; raise InputError if there is none."""
    if name not in (names := list_installed()):
        raise InputError(
            f"no instrument is called {name!r}; installed: {', '.join(names) or 'none'}. "
            "For one of your own give my.py:INSTRUMENT"
        )
    return entry_points(group=GROUP)[name].load()


def load_instruments() -> dict[str, Instrument]:
    """Load every installed instrument, by name."""
    return {name: load_instrument(name) for name in list_installed()}
