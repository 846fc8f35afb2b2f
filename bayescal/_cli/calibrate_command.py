"""The whole loop as a command: `calibrate`, of one output or of several channels of one unit; `workbench`, by hand."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._calibration.settings import SearchSettings
from bayescal._cli import options
from bayescal._cli.console import exit_unless, print_notes, print_result, result_folder
from bayescal._cli.options import Commands, SearchRequest
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.settings_in_force import use_settings

if TYPE_CHECKING:
    from bayescal._cli.request import Early
    from bayescal._data.measurements import Measurements
    from bayescal._model.effect import Effect
    from bayescal._model.model import Model
    from bayescal._workbench.serve import Sessions
    from bayescal._workbench.start import Waiting

commands = Commands()


@commands.example("bayescal calibrate readings.csv --instrument mems_gyro --out result")
def calibrate(
    *,
    channels: str | None = None,
    asked: SearchRequest,
    simple_noise: bool = False,
    covariates: str | None = None,
    out: Path | None = None,
    verbose: bool = False,
    output_unit: str | None = None,
    json_: bool = False,
) -> None:
    """The whole loop: fit, see where it fails, find what is missing, add it, see the error fall.

    The first table stands as soon as the first fit does; Ctrl-C then ends the search with the best so far. Channels of
    one unit are searched together: structures and noise of their own, one body for all.
    """
    settings = asked.settings() | options.causes(None, covariates)
    of_search = SearchSettings(finer_noise=not simple_noise)
    with use_settings(of_search), deadline.until(asked.time_limit, apart=True):
        if channels is None:
            _one(asked, out, json_, settings, verbose, output_unit)
        elif output_unit is not None:
            raise InputError("--output-unit is of one output: leave it out, or --channels")
        else:
            _several(options.channel_names(channels), asked, out, json_, settings)


@commands.example("bayescal workbench readings.csv --instrument mems_gyro")
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
    from bayescal._cli import request
    from bayescal._report.whole_folder import folders_of
    from bayescal._workbench import start

    start.refuse_without_panel()
    at = start.Address.new(address)
    print_notes([at.exposed] if at.exposed else [])
    # A file that cannot be used is refused before a browser opens.
    names = [] if channels is None else options.channel_names(channels)
    early = request.read_early(asked, names)
    method = None if asked.method == "marginal" else request.method_named(asked.method)
    settings = {**asked.settings(), "method": method, "time_limit": asked.time_limit}
    with result_folder(out) as folder:
        assert folder is not None
        folders = {n: folder / inner for n, inner in folders_of(names).items()} or {"": folder}
        name = [start.FIRST, *start.kept_sessions(next(iter(folders.values())))][-1]
        told = ", ".join(p.name for p in asked.files)
        said = f"bayescal workbench of {told}: {at.of(name)}\n(Ctrl-C ends it; kept in {folder})"
        with start.Waiting(at, told, "Loading the instrument …") as waiting:
            print(said, flush=True)
            if not no_open:
                webbrowser.open(at.of(name))
            sessions = _sessions(asked, early, folders, name, settings, waiting, trust or [])
        from bayescal._workbench.serve import serve

        serve(sessions, at)
    print("bayescal workbench: ended", flush=True)


def _sessions(
    asked: SearchRequest,
    early: Early,
    folders: Mapping[str, Path],
    name: str,
    settings: dict[str, Any],
    waiting: Waiting,
    trust: Sequence[Path],
) -> dict[str, Sessions]:
    """The sessions of a server, by channel ("" where there is one output); the first of them is open."""
    from bayescal._cli import request

    names = [n for n in folders if n]
    models, readings, kept = _opened(names, asked, early)
    waiting.doing = "Loading the page …"
    from bayescal._workbench.kept import Origin
    from bayescal._workbench.serve import Sessions
    from bayescal._workbench.session import Session

    def of_channel(channel: str, folder: Path) -> Sessions:
        own_files = [] if asked.choice.effects_file is None else [asked.choice.effects_file]
        own = request.own_effects(asked.choice, models[channel].instrument, readings[channel])
        if asked.choice.typed:
            own_files.append(_written(own, folder))
        reference = request.reference_of(asked.choice.reference, readings[channel]) or None
        how = asked.columns.for_read() | ({"outputs": names} if channel else {})
        averaged = {"average": asked.average, "keep_spikes": asked.keep_spikes}
        files = (asked.files, asked.holdout, how, own_files)
        origin = Origin.of(asked.instrument, *files, channel=channel, **averaged)
        given = {"holdout": kept.get(channel), "effects": own, "reference": reference, **settings}

        def begin(inner: Path) -> Session:
            one = models[channel], readings[channel]
            return Session.begin(*one, folder=inner, origin=origin, **given)

        return Sessions(folder, begin, partial(Session.resume, of=origin, trust=trust))

    found = {channel: of_channel(channel, folder) for channel, folder in folders.items()}
    waiting.doing = "Fitting the first model …"
    next(iter(found.values())).open(name)
    return found


def _written(own: Sequence[Effect], folder: Path) -> Path:
    """The effects that were typed as a file in the workbench's folder, which its sessions and scripts read."""
    from bayescal._core.atomic_file import write_text
    from bayescal._model.formula import Formula

    lines = [f"    bc.effect({e.basis.text!r})," for e in own if isinstance(e.basis, Formula)]
    code = ["import bayescal as bc", "", "EFFECTS = (", *lines, ")", ""]
    folder.mkdir(exist_ok=True)  # of a channel
    return write_text("\n".join(code), folder / "typed_effects.py")


def _one(
    asked: SearchRequest,
    out: Path | None,
    json_: bool,
    settings: dict[str, Any],
    verbose: bool,
    output_unit: str | None,
) -> None:
    """One output."""
    from bayescal._cli import request
    from bayescal._report.whole_folder import CHANNELS

    if out is not None and (out / CHANNELS).is_file():
        raise InputError(
            f"{out} holds the channels of a unit ({CHANNELS}), of which reports and parameters would still be made: "
            "give another folder, or remove it"
        )
    models, all_readings, kept = _opened([], asked)
    model, readings = models[""], all_readings[""]
    own = request.own_effects(asked.choice, model.instrument, readings)
    if output_unit is not None:
        from bayescal._report.tables import output_factor

        scale = readings.scale or model.instrument.nominal_scale
        output_factor(output_unit, readings.unit("output") or "1", scale)
    with result_folder(out) as folder:
        from bayescal._cli.output import ConsoleReporter, loop_text
        from bayescal._report.result_json import earlier

        told = ConsoleReporter(folder, json_, verbose)
        seeds = earlier(folder, model, readings) if folder else ()
        if seeds:
            print_notes([f"goes on with the search in {folder}, which was ended early"])
        trail = bc.calibrate(
            model,
            readings,
            holdout=kept.get(""),
            effects=own,
            **_how(asked, readings, settings),
            seeds=seeds,
            follow=told,
        )
        from bayescal._report.result_json import result
        from bayescal._report.whole_folder import AVERAGED, files_of

        def write() -> None:
            if folder is not None:
                trail.save(folder)
            flags = trail.final.calibration.readings.flags
            print_notes(f for f in flags if f not in readings.flags)
            print_result(
                result(trail) if json_ else loop_text(trail, own, told.begun, verbose, output_unit)
            )
            if folder is not None and not json_:
                there = files_of(folder)
                usual = ("result.json", "calibration.nc", AVERAGED, "loop.png")
                names = (n for n in usual if n in there)
                print(f"\nwritten: {folder}/{', '.join(names)}, manifest.json")

        deadline.finish(write)
    exit_unless(trail.ok, trail.gate.reason)


def _several(
    names: Sequence[str],
    asked: SearchRequest,
    out: Path | None,
    json_: bool,
    settings: dict[str, Any],
) -> None:
    """Channels of one unit."""
    from bayescal._cli import request

    models, readings, kept = _opened(names, asked)
    name, first = next(iter(readings.items()))
    own = request.own_effects(asked.choice, models[name].instrument, first)
    with result_folder(out) as folder:
        found = bc.calibrate_channels(
            models,
            readings,
            holdout=kept or None,
            effects=own,
            **_how(asked, first, settings),
        )
        from bayescal._cli.output import channels_in_short
        from bayescal._report.save_search import channels_data

        def write() -> None:
            if folder is not None:
                found.save(folder)
            fitted = {n: t.final.calibration.readings for n, t in found.trails.items()}
            print_notes(flag for flag in _flags(fitted) if flag not in _flags(readings))
            print_result(channels_data(found) if json_ else found)
            if not json_:
                print(f"\nIN SHORT\n\n{channels_in_short(found)}")
            if folder is not None and not json_:
                print(f"\nwritten: {folder}/channels.json, and a folder for each channel")

        deadline.finish(write)
    exit_unless(found.ok, found.reason)


def _opened(
    names: Sequence[str], asked: SearchRequest, early: Early | None = None
) -> tuple[dict[str, Model], dict[str, Measurements], dict[str, Measurements]]:
    """Models, readings and hold-out data by channel ("" where there is one output); what is to be noted is said."""
    from bayescal._cli import request

    general, models, readings = request.open_channels(names, asked, early)
    kept = request.open_kept(general if names else models[""].instrument, asked, names)
    print_notes(_flags(readings))
    return models, readings, kept


def _how(asked: SearchRequest, readings: Measurements, settings: dict[str, Any]) -> dict[str, Any]:
    """How `calibrate` and `calibrate_channels` are to search."""
    from bayescal._cli import request

    method = request.method_named(asked.method)
    reference = request.reference_of(asked.choice.reference, readings)
    return {"method": method, "reference": reference, **settings}


def _flags(readings: Mapping[str, Measurements]) -> list[str]:
    """Notes on the readings of channels: what holds for all once, the others with the channel's name."""
    said = {
        flag: [n for n, one in readings.items() if flag in one.flags]
        for r in readings.values()
        for flag in r.flags
    }
    return [
        flag if len(names) == len(readings) else f"{', '.join(names)}: {flag}"
        for flag, names in said.items()
    ]
