"""Registration of the workbench's command; heavy modules load inside it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal import workshop as ws

if TYPE_CHECKING:
    from bayescal._annexes.workbench.serve import Opened


class WorkbenchCommand(ws.SearchRequest, ws.Command):
    """Run the same loop in a browser, step by step.

    It is served to this computer alone, under an address that nobody guesses, unless --address says otherwise.
    Channels of a unit have each a page of its own, with links to the others.
    """

    example = "bayescal workbench readings.csv --instrument mems_gyro"
    channels: str | None = ws.Shared.channels
    out: Path = ws.opt(
        "Folder that keeps every step; one that holds some is gone on with, as after a time limit.",
        Path("workbench_output"),
    )
    address: str = ws.opt("Of this computer, to serve at; others may then reach it.", "127.0.0.1")
    no_open: bool = ws.opt("Print the address, and open no browser.", False)

    def run(self) -> int:
        """Serve until it is ended: the time limit is of each search."""
        from bayescal._annexes.workbench import start

        start.refuse_without_panel()
        at = start.Address.new(self.address)
        ws.print_notes([at.exposed] if at.exposed else [])
        # A file that cannot be used is refused before a browser opens.
        names = ws.channel_names(self.channels)
        opened = ws.searched(names, self)
        with ws.result_folder(self.out) as folder:
            assert folder is not None
            folders = {n: folder / inner for n, inner in ws.folders_of(names).items()} or {
                "": folder
            }
            files = ", ".join(p.name for p in self.files)
            ws.tell("loading the workbench and fitting the first model …")
            text = f"bayescal workbench of {files}: {at.url}\n(Ctrl-C ends it; kept in {folder})"
            sessions = _sessions(self, opened, folders)
            from bayescal._annexes.workbench.serve import serve

            serve(sessions, at, text, None if self.no_open else folder)
        print("bayescal workbench: ended", flush=True)
        return 0


ANNEX = {"commands": (WorkbenchCommand,)}


def _sessions(
    command: ws.SearchRequest,
    opened: tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]],
    folders: Mapping[str, Path],
) -> dict[str, Opened]:
    """Return the sessions of a server, by channel ("" for one output), the first of them open."""
    names, (models, readings, held_out) = [n for n in folders if n], opened
    from bayescal._annexes.workbench.serve import Opened
    from bayescal._annexes.workbench.session import Session
    from bayescal._annexes.workbench.session_store import FIRST, Origin

    method = None if command.method == "marginal" else ws.method_named(command.method)
    settings = {**command.settings(), "method": method, "time_limit": command.time_limit}

    def of_channel(channel: str, folder: Path) -> Opened:
        own_files = [] if command.effects_file is None else [command.effects_file]
        effects = ws.own_effects(command, models[channel].instrument, readings[channel])
        reference = {**ws.named_numbers(command.reference, "--reference")} or None
        how = command.for_read() | ({"outputs": names} if channel else {})
        averaged = {"average": command.average, "keep_spikes": command.keep_spikes}
        files = (command.files, command.holdout, how, own_files)
        origin = Origin.of(command.instrument, *files, channel=channel, **averaged)
        call = {"holdout": held_out.get(channel), "effects": effects, **settings}
        call |= {"reference": reference, "folder": folder / FIRST, "origin": origin}
        return Opened(partial(Session.open, models[channel], readings[channel], **call))

    sessions = {channel: of_channel(channel, folder) for channel, folder in folders.items()}
    next(iter(sessions.values())).open()
    return sessions
