"""The checkpoint of a session: each state as a saved calibration, written atomically, so that a killed server resumes.

session.json               the tree of states, which one is current
state_000.nc               the fit of the first state, and so on, as `bayescal calibrate` saves one
script.py                  Python that fits the models of the states up to the current one, with the same numbers
result_000/                reports and exports of a state, when they were asked for
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
    """Sources of a session for its script: instrument, files and options of reading."""

    instrument: str  # name of an installed one, or my.py:INSTRUMENT; empty where made in Python
    files: tuple[str, ...] = ()  # files, holdout: of readings, in full; none of those in memory
    holdout: tuple[str, ...] = ()
    # Arguments of `bayescal.read` that are not its usual ones.
    read: Mapping[str, Any] = field(default_factory=dict)
    average: str | None = None  # time over which means are taken; None for single readings
    effect_files: tuple[str, ...] = ()  # Python files with effects of the user's own, in full

    @classmethod
    def of(
        cls,
        instrument: str,
        files: Sequence[Path | str],
        holdout: Sequence[Path | str] | None = None,
        read: Mapping[str, Any] | None = None,
        effect_files: Sequence[Path | str] = (),
        **settings: Any,
    ) -> Origin:
        """Build with absolute paths, without arguments that equal their defaults."""
        if ws.is_file_reference(instrument):
            file, _, name = instrument.rpartition(":")
            instrument = f"{Path(file).resolve()}:{name}"
        full = [tuple(str(Path(p).resolve()) for p in some) for some in (files, holdout or ())]
        usual = vars(ws.ReadOptions())
        changed = {k: v for k, v in (read or {}).items() if v != usual.get(k)}
        effects = tuple(str(Path(p).resolve()) for p in effect_files)
        return cls(instrument, *full, read=changed, effect_files=effects, **settings)


@dataclass(frozen=True)
class SearchOptions:
    """Options of `calibrate` apart from model and readings; see there."""

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
    """One model of the tree, immutable; a search returns the same state with its discovery."""

    number: int  # of the state, from 0
    parent: int | None  # number of the state that it was made from; None for the first
    step: ws.Step  # its fit by least squares, where it fails, its errors
    discovery: bc.Discovery | None = None  # what is missing from it; None until it was looked for

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


def path_to(states: Mapping[int, Any], number: int) -> list[int]:
    """Return the numbers of the states from the first to one."""
    path = [number]
    while (parent := states[path[0]].parent) is not None:
        path.insert(0, parent)
    return path


SESSION, SCRIPT = "session.json", "script.py"
SCHEMA = "bayescal.workbench/3"
FIRST = "session_1"  # the folder of a session, in that of --out


@dataclass(frozen=True)
class SavedState:
    """One state in session.json, whose index is its number; its calibration is a file of its own."""

    parent: int | None
    added: str | None
    description: str


@dataclass(frozen=True)
class SavedSession:
    """Content of session.json; raises ValueError where it is invalid."""

    schema: str
    states: list[SavedState]
    current: int

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"its schema is {self.schema!r}, expected {SCHEMA!r}")
        for number, state in enumerate(self.states):
            if state.parent not in (range(number) if number else (None,)):
                raise ValueError(f"the parent of step {number} is none before it")
        if self.current not in range(len(self.states)):
            raise ValueError(f"there is no step {self.current}")


def fit_path(folder: Path, number: int) -> Path:
    """Return the path of a state's calibration."""
    return folder / f"state_{number:03d}.nc"


def save_session(folder: Path, states: Mapping[int, State], current: int, script: str) -> None:
    """Write session.json and the script to disk; calibrations are saved apart.

    Raises:
        InputError: it cannot be written.
    """
    ordered = (state for _, state in sorted(states.items()))
    saved = [SavedState(s.parent, s.step.added, s.step.description) for s in ordered]
    ws.write_json(ws.as_json(SavedSession(SCHEMA, saved, current)), folder / SESSION)
    ws.write_text(script, folder / SCRIPT)


def load_session(folder: Path) -> SavedSession:
    """Load session.json.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    try:
        return ws.read_json(folder / SESSION, SavedSession)
    except (OSError, ValueError) as error:
        raise bc.InputError(
            f"{folder} holds no session that can be gone on with ({error}): begin one in another folder"
        ) from None


def script(path: Sequence[State], origin: Origin, settings: SearchOptions, folder: Path) -> str:
    """Generate the script that fits the models of a path of states.

    Args:
        path: states, each the parent of the next.
        origin: of readings and effects.
        settings: of the fits.
        folder: that keeps the states' calibrations, whose models are loaded.
    """
    steps = []
    for state in path:
        c, quick = state.calibration, state.model.noise.gaussian
        step = {
            "title": ws.one_line(f"{state.number} {state.title}"),
            "file": str(fit_path(folder, state.number)),
            "method": method_code(ws.QUICK if quick else settings.method),
            "how": {"seed": c.seed} | ({"start": c.start} if c.start else {}),
        }
        steps.append(step)
    file, _, name = origin.instrument.rpartition(":")
    installed = metadata.entry_points(group="bayescal.instruments")
    arguments = {"repr": repr, "arguments": _arguments}
    return ws.template("bayescal._annexes.workbench", "script.py.jinja", arguments).render(
        version=bc.__version__,
        file=file,
        name=name,
        entry=None if file or not origin.instrument else installed[name],
        own_files=list(origin.effect_files),
        parts={"readings": list(origin.files), "holdout": list(origin.holdout)},
        first=steps[0]["file"],
        read=origin.read,
        average=origin.average,
        spikes={"keep_spikes": True} if settings.keep_spikes else {},
        reference={"reference": dict(settings.reference)} if settings.reference else {},
        steps=steps,
        method=method_code(settings.method),
        seed=settings.seed,
    )


def _arguments(values: Mapping[str, Any]) -> str:
    return "".join(f", {name}={value!r}" for name, value in values.items())


def method_code(method: Any) -> str:
    return "bc.Marginal()" if method is None else f"bc.{method!r}"
