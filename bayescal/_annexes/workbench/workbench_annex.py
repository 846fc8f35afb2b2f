"""What the workbench offers: its command. Heavy modules load inside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bayescal.workshop import (
    Commands,
    Early,
    SearchRequest,
    channel_names,
    folders_of,
    method_named,
    own_effects,
    print_notes,
    read_early,
    reference_of,
    result_folder,
    searched,
    tell,
    write_text,
)

if TYPE_CHECKING:
    from bayescal import Effect
    from bayescal._annexes.workbench.serve import Sessions
    from bayescal._annexes.workbench.session import Session

commands = Commands(
    {
        "address": "Address of this computer to serve at; others may then reach it.",
        "no_open": "Print the address, and open no browser.",
        "out": "Folder that keeps every step; one that holds some is gone on with, as after a time limit.",
        "trust": "Python file that a session kept in the folder may run, beside that of --effects; repeat for more.",
    }
)

ANNEX = {"commands": commands}


@commands.example(
    "bayescal workbench readings.csv --instrument mems_gyro", data=False, endless=True
)
def workbench(
    *,
    channels: str | None = None,
    asked: SearchRequest,
    out: Path = Path("workbench_output"),
    trust: list[Path] | None = None,
    address: str = "127.0.0.1",
    no_open: bool = False,
) -> None:
    """The same loop in a browser, step by step: look, add, compare, go back. Ctrl-C ends it.

    It is served to this computer alone, under an address that nobody guesses, unless --address says otherwise.
    Channels of a unit have each a page of its own, with links to the others.
    """
    from bayescal._annexes.workbench import start

    start.refuse_without_panel()
    at = start.Address.new(address)
    print_notes([at.exposed] if at.exposed else [])
    # A file that cannot be used is refused before a browser opens.
    names = channel_names(channels)
    early = read_early(asked, names)
    with result_folder(out) as folder:
        assert folder is not None
        folders = {n: folder / inner for n, inner in folders_of(names).items()} or {"": folder}
        name = [start.FIRST, *start.kept_sessions(next(iter(folders.values())))][-1]
        told = ", ".join(p.name for p in asked.files)
        tell("loading the workbench and fitting the first model …")
        said = f"bayescal workbench of {told}: {at.of(name)}\n(Ctrl-C ends it; kept in {folder})"
        sessions = _sessions(asked, early, folders, name, trust or [])
        from bayescal._annexes.workbench.serve import serve

        serve(sessions, at, said, None if no_open else folder)
    print("bayescal workbench: ended", flush=True)


def _sessions(
    asked: SearchRequest,
    early: Early,
    folders: Mapping[str, Path],
    name: str,
    trust: Sequence[Path],
) -> dict[str, Sessions]:
    """The sessions of a server, by channel ("" where there is one output); the first of them is open."""
    names = [n for n in folders if n]
    models, readings, kept = searched(names, asked, early)
    from bayescal._annexes.workbench.kept import Origin, SearchOptions
    from bayescal._annexes.workbench.serve import Sessions
    from bayescal._annexes.workbench.session import Session

    method = None if asked.method == "marginal" else method_named(asked.method)
    settings = {**asked.settings(), "method": method, "time_limit": asked.time_limit}

    def of_channel(channel: str, folder: Path) -> Sessions:
        own_files = [] if asked.choice.effects_file is None else [asked.choice.effects_file]
        own = own_effects(asked.choice, models[channel].instrument, readings[channel])
        if asked.choice.typed:
            own_files.append(_written(own, folder))
        reference = reference_of(asked.choice.reference, readings[channel]) or None
        how = asked.columns.for_read() | ({"outputs": names} if channel else {})
        averaged = {"average": asked.average, "keep_spikes": asked.keep_spikes}
        files = (asked.files, asked.holdout, how, own_files)
        origin = Origin.of(asked.instrument, *files, channel=channel, **averaged)
        given = {"holdout": kept.get(channel), "effects": own, "reference": reference, **settings}

        def begin(inner: Path) -> Session:
            one = models[channel], readings[channel]
            return Session.begin(*one, folder=inner, origin=origin, **given)

        now = SearchOptions(reference=reference, **settings)
        go_on = partial(Session.resume, of=origin, trust=trust, asked=now)
        return Sessions(folder, begin, go_on)

    found = {channel: of_channel(channel, folder) for channel, folder in folders.items()}
    begun = next(iter(found.values())).open(name)
    if begun.not_taken:
        print_notes([f"this session goes on with its own {begun.not_taken}"])
    return found


def _written(own: Sequence[Effect], folder: Path) -> Path:
    """The effects that were typed as a file in the workbench's folder, which its sessions and scripts read."""
    from bayescal._annexes.workbench.kept import typed_code

    folder.mkdir(exist_ok=True)  # of a channel
    return write_text(typed_code(own), folder / "typed_effects.py")
