"""Start of the workbench without heavy imports: address of its server, and the workbench in a notebook."""

from __future__ import annotations

import importlib.util
import secrets
import socket
import tempfile
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal import workshop as ws

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Address:
    """Address of the workbench on the loopback interface, under a secret path.

    Attributes:
        port: port that was free when it was chosen.
        path: secret path, beginning with "/".
    """

    port: int
    path: str

    @classmethod
    def new(cls) -> Address:
        """Choose a free port, and a path of 256 random bits."""
        with socket.socket() as probe:
            probe.bind((LOOPBACK, 0))
            return cls(probe.getsockname()[1], f"/{secrets.token_urlsafe(32)}")

    @property
    def hosts(self) -> list[str]:
        """Return the accepted Host headers."""
        return [f"{name}:{self.port}" for name in (LOOPBACK, "localhost")]

    @property
    def url(self) -> str:
        """Return the URL for a browser."""
        return f"http://{LOOPBACK}:{self.port}{self.path}/"


FORWARD = '<!DOCTYPE html><meta http-equiv="refresh" content="0; url={0}"><a href="{0}">bayescal workbench</a>'


@contextmanager
def opened_in_browser(url: str, folder: Path) -> Iterator[None]:
    """Open an address in the browser through a forwarding file that only this user can read.

    An address among the browser's arguments would be visible to all users of the computer. The file is in `folder`,
    since a sandboxed browser cannot read temporary files, and is removed on exit.
    """
    with tempfile.TemporaryDirectory(prefix="open_", dir=folder.resolve()) as private:  # mode 700
        page = Path(private) / "workbench.html"
        page.touch(0o600)
        page.write_text(FORWARD.format(ws.html_text(url)), "utf-8")
        webbrowser.open(page.as_uri())
        yield


def refuse_without_panel() -> None:
    """Raise InputError if Panel is not installed."""
    if importlib.util.find_spec("panel") is None:
        raise bc.InputError(
            "the workbench needs Panel, which is not installed: pip install 'bayescal[workbench]'"
        )


def workbench(
    readings: bc.Measurements,
    instrument: bc.Instrument | bc.Model,
    *,
    holdout: bc.Measurements | None = None,
    effects: Sequence[bc.Effect] = (),
    folder: str | Path | None = None,
    **settings: Any,
) -> Any:
    """Open the workbench in a notebook; for a browser, use the command `bayescal workbench`.

    Args:
        readings: readings to calibrate with.
        instrument: instrument whose baseline is the first model, or the first model.
        holdout, effects: as in `calibrate`.
        folder: folder for the states; default a temporary one. A session in the folder is resumed.
        settings: options of `calibrate`: method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit,
            accept_conflicts.

    Returns:
        A Panel view, shown if it is the last value of a cell.

    Raises:
        InputError: the folder cannot be written to, or Panel is not installed.
        ModelError: the readings lack a column that the model needs.
    """
    refuse_without_panel()
    import panel  # heavy, as are the imports below

    from bayescal._annexes.workbench.app import Workbench
    from bayescal._annexes.workbench.session import Session

    panel.extension(inline=True)
    start = instrument
    model = start if isinstance(start, bc.Model) else start.for_readings(readings).baseline()
    options = {"holdout": holdout, "effects": effects, "folder": folder, **settings}
    session = Session.open(model, readings, **options)
    return Workbench(session, framed=True).view
