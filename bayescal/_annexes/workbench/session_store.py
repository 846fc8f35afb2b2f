"""Checkpoint of a session, written atomically, from which the session is resumed even after a crash.

session.json               tree of states, number of the current one
state_000.nc               fit of state 0, and so on, in the format of `bayescal calibrate`
script.py                  Python that fits the models of the states up to the current one, with identical numbers
result_000/                requested reports and exports of state 0, and so on
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal import workshop as ws


@dataclass(frozen=True)
class Origin:
    """Inputs of a session, from which its script is written: instrument, files and read options."""

    instrument: str  # name of an installed one, or my.py:INSTRUMENT; empty if made in Python
    files: tuple[str, ...] = ()  # files, holdout: absolute paths of readings; empty if in memory
    holdout: tuple[str, ...] = ()
    # Arguments of `bayescal.read` that differ from their defaults.
    read_options: Mapping[str, Any] = field(default_factory=dict)
    average: str | None = None  # averaging time; None for single readings
    effect_files: tuple[str, ...] = ()  # absolute paths of Python files with user-defined effects

    @classmethod
    def of(
        cls,
        instrument: str,
        files: Sequence[Path | str],
        holdout: Sequence[Path | str] | None = None,
        read_options: Mapping[str, Any] | None = None,
        effect_files: Sequence[Path | str] = (),
        **settings: Any,
    ) -> Origin:
        """Build an origin with absolute paths, without arguments that equal their defaults."""
        if ws.is_file_reference(instrument):
            file, _, name = instrument.rpartition(":")
            instrument = f"{Path(file).resolve()}:{name}"

        def resolve(paths: Sequence[Path | str] | None) -> tuple[str, ...]:
            return tuple(str(Path(p).resolve()) for p in paths or ())

        defaults = vars(ws.ReadOptions())
        changed_options = {k: v for k, v in (read_options or {}).items() if v != defaults.get(k)}
        settings |= {"read_options": changed_options, "effect_files": resolve(effect_files)}
        return cls(instrument, resolve(files), resolve(holdout), **settings)


@dataclass(frozen=True)
class SearchOptions:
    """Options of `calibrate`, without model and readings; see its docstring."""

    method: bc.LeastSquares | bc.Marginal | bc.NUTS | None = None
    max_effects: int = 5
    widen_noise: bool = True
    keep_spikes: bool = False
    seed: int = 0
    reference: dict[str, Any] | None = None
    time_limit: float | None = None
    accept_conflicts: Collection[str] = ()


@dataclass(frozen=True, eq=False)
class State:
    """Fitted model of a session's tree, immutable; a search replaces it by a copy with a discovery."""

    number: int  # of the state, from 0
    parent: int | None  # number of the state that was changed; None for the first
    step: ws.Step  # least-squares fit, residual check and errors
    discovery: bc.Discovery | None = None  # missing effects; None before a search

    @property
    def title(self) -> str:
        """Return the change of the model in short: "baseline", "+ bias.thermal_lag"."""
        return self.step.title

    @property
    def calibration(self) -> bc.Calibration:
        return self.step.calibration

    @property
    def model(self) -> bc.Model:
        return self.step.calibration.model


def list_path(states: Mapping[int, Any], number: int) -> list[int]:
    """Return the numbers of the states on the branch from the first one to state `number`."""
    path = [number]
    while (parent := states[path[0]].parent) is not None:
        path.insert(0, parent)
    return path


SESSION_FILE, SCRIPT_FILE = "session.json", "script.py"
SCHEMA = "bayescal.workbench/3"
FIRST_FOLDER = "session_1"  # folder of a session, in that of --out


@dataclass(frozen=True)
class SavedState:
    """One state in session.json, numbered by its index; its calibration is a separate file."""

    parent: int | None
    added: str | None
    description: str


@dataclass(frozen=True)
class SavedSession:
    """Content of session.json; invalid content raises ValueError."""

    schema: str
    states: list[SavedState]
    current: int

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"its schema is {self.schema!r}, expected {SCHEMA!r}")
        for number, state in enumerate(self.states):
            if state.parent not in (range(number) if number else (None,)):
                raise ValueError(f"the parent of step {number} is not an earlier step")
        if self.current not in range(len(self.states)):
            raise ValueError(f"there is no step {self.current}")


def locate_calibration(folder: Path, number: int) -> Path:
    """Return the path of the calibration of state `number` in a session's folder."""
    return folder / f"state_{number:03d}.nc"


def save_session(folder: Path, states: Mapping[int, State], current: int, script: str) -> None:
    """Write session.json and the script; calibrations are saved separately.

    Raises:
        InputError: a file cannot be written.
    """
    ordered_states = (state for _, state in sorted(states.items()))
    saved_states = [SavedState(s.parent, s.step.added, s.step.description) for s in ordered_states]
    ws.write_json(ws.as_json(SavedSession(SCHEMA, saved_states, current)), folder / SESSION_FILE)
    ws.write_text(script, folder / SCRIPT_FILE)


def load_session(folder: Path) -> SavedSession:
    """Load session.json.

    Raises:
        InputError: the file does not exist, or cannot be read.
    """
    try:
        return ws.read_json(folder / SESSION_FILE, SavedSession)
    except (OSError, ValueError) as error:
        raise bc.InputError(
            f"{folder} has no session that can be resumed ({error}): start one in another folder"
        ) from None


def generate_script(
    path: Sequence[State], origin: Origin, settings: SearchOptions, folder: Path
) -> str:
    """Generate a Python script that fits the models of a path of states.

    Args:
        path: states, each the parent of the next.
        origin: sources of readings and effects.
        settings: options of the fits.
        folder: folder with the states' calibrations, from which the script loads the models.
    """
    steps = []
    for state in path:
        c, is_gaussian = state.calibration, state.model.noise.is_gaussian
        step = {
            "title": ws.to_printable(f"{state.number} {state.title}"),
            "file": str(locate_calibration(folder, state.number)),
            "method": format_method(ws.QUICK if is_gaussian else settings.method),
            "how": {"seed": c.seed} | ({"start": c.start} if c.start else {}),
        }
        steps.append(step)
    file, _, name = origin.instrument.rpartition(":")
    entry_points = metadata.entry_points(group="bayescal.instruments")
    arguments = {"repr": repr, "arguments": _format_arguments}
    return ws.load_template("bayescal._annexes.workbench", "script.py.jinja", arguments).render(
        version=bc.__version__,
        file=file,
        name=name,
        entry=None if file or not origin.instrument else entry_points[name],
        own_files=list(origin.effect_files),
        parts={"readings": list(origin.files), "holdout": list(origin.holdout)},
        first=steps[0]["file"],
        read=origin.read_options,
        average=origin.average,
        spikes={"keep_spikes": True} if settings.keep_spikes else {},
        reference={"reference": dict(settings.reference)} if settings.reference else {},
        steps=steps,
        method=format_method(settings.method),
        seed=settings.seed,
    )


def _format_arguments(values: Mapping[str, Any]) -> str:
    return "".join(f", {name}={value!r}" for name, value in values.items())


def format_method(method: Any) -> str:
    return "bc.Marginal()" if method is None else f"bc.{method!r}"
