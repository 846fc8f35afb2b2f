"""What the workbench offers: its command. Heavy modules load inside it."""

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
            told = ", ".join(p.name for p in self.files)
            ws.tell("loading the workbench and fitting the first model …")
            said = f"bayescal workbench of {told}: {at.url}\n(Ctrl-C ends it; kept in {folder})"
            sessions = _sessions(self, opened, folders)
            from bayescal._annexes.workbench.serve import serve

            serve(sessions, at, said, None if self.no_open else folder)
        print("bayescal workbench: ended", flush=True)
        return 0


ANNEX = {"commands": (WorkbenchCommand,)}


def _sessions(
    asked: ws.SearchRequest,
    opened: tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]],
    folders: Mapping[str, Path],
) -> dict[str, Opened]:
    """The sessions of a server, by channel ("" where there is one output); the first of them is open."""
    names, (models, readings, kept) = [n for n in folders if n], opened
    from bayescal._annexes.workbench.kept import FIRST, Origin
    from bayescal._annexes.workbench.serve import Opened
    from bayescal._annexes.workbench.session import Session

    method = None if asked.method == "marginal" else ws.method_named(asked.method)
    settings = {**asked.settings(), "method": method, "time_limit": asked.time_limit}

    def of_channel(channel: str, folder: Path) -> Opened:
        own_files = [] if asked.effects_file is None else [asked.effects_file]
        own = ws.own_effects(asked, models[channel].instrument, readings[channel])
        reference = {**ws.named_numbers(asked.reference, "--reference")} or None
        how = asked.for_read() | ({"outputs": names} if channel else {})
        averaged = {"average": asked.average, "keep_spikes": asked.keep_spikes}
        files = (asked.files, asked.holdout, how, own_files)
        origin = Origin.of(asked.instrument, *files, channel=channel, **averaged)
        given = {"holdout": kept.get(channel), "effects": own, "reference": reference, **settings}
        given |= {"folder": folder / FIRST, "origin": origin}
        return Opened(partial(Session.open, models[channel], readings[channel], **given))

    found = {channel: of_channel(channel, folder) for channel, folder in folders.items()}
    next(iter(found.values())).open()
    return found
