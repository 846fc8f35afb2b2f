"""The checkpoint of a session: each state as a saved calibration, written atomically, so that a killed server resumes.

session.json               the tree of states, which one is current, formulas that were typed
state_000.nc               the fit of the first state, and so on, as `bayescal calibrate` saves one
script.py                  Python that leads to the current state, with the same numbers
result_000/                reports and exports of a state, when they were asked for

A state is a model; its script is the differences from each model to the next, in the words of the public functions.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from itertools import takewhile
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal import workshop as ws


@dataclass(frozen=True)
class Origin:
    """Sources of a session for its script: instrument, files and options of reading."""

    instrument: str  # name of an installed one, or my.py:INSTRUMENT; empty where made in Python
    files: tuple[str, ...]  # files, holdout: of readings, in full
    holdout: tuple[str, ...] = ()
    # Arguments of `bayescal.read` that are not its usual ones.
    read: Mapping[str, Any] = field(default_factory=dict)
    average: str | None = None  # time over which means are taken; None for single readings
    keep_spikes: bool = False  # whether single readings far from both neighbours stay
    effect_files: tuple[str, ...] = ()  # Python files with effects of the user's own, in full
    channel: str = ""  # which of the outputs that `read` names; empty where there is one

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
        if ws.in_a_file(instrument):
            file, _, name = instrument.rpartition(":")
            instrument = f"{Path(file).resolve()}:{name}"
        full = [tuple(str(Path(p).resolve()) for p in some) for some in (files, holdout or ())]
        usual = vars(ws.ReadOptions())
        changed = {k: v for k, v in (read or {}).items() if v != usual.get(k)}
        effects = tuple(str(Path(p).resolve()) for p in effect_files)
        return cls(instrument, *full, read=changed, effect_files=effects, **settings)

    @classmethod
    def write(
        cls,
        instrument: bc.Instrument,
        readings: bc.Measurements,
        holdout: bc.Measurements | None,
        folder: Path,
        keep_spikes: bool,
    ) -> Origin:
        """Write readings in memory to a folder, and return them as sources.

        Raises:
            InputError: it cannot be written to.
        """
        files = [readings.write(folder / "readings.csv")]
        held_out = [] if holdout is None else [holdout.write(folder / "holdout.csv")]
        name = instrument.name if instrument.name in ws.installed_names() else ""
        return cls.of(name, files, held_out, keep_spikes=keep_spikes)


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
    at: datetime  # when it was made
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
SCHEMA = "bayescal.workbench/2"
FIRST = "session_1"  # the folder of a session, in that of --out


@dataclass(frozen=True)
class SavedState:
    """One state in session.json, whose index is its number; its calibration is a file of its own."""

    parent: int | None
    at: str
    added: str | None
    changed: str
    identity: str

    @classmethod
    def of(cls, state: State) -> SavedState:
        step = state.step
        fields = state.at.isoformat(), step.added, step.description, ws.identity(state.calibration)
        return cls(state.parent, *fields)


@dataclass(frozen=True)
class SavedSession:
    """Content of session.json; raises ValueError where it is invalid."""

    schema: str
    states: list[SavedState]
    current: int
    typed: list[str]

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"its schema is {self.schema!r}, expected {SCHEMA!r}")
        for number, state in enumerate(self.states):
            datetime.fromisoformat(state.at)
            if state.parent not in (range(number) if number else (None,)):
                raise ValueError(f"the parent of step {number} is none before it")
        if self.current not in range(len(self.states)):
            raise ValueError(f"there is no step {self.current}")


def make_folder(folder: str | Path | None) -> Path:
    """Create the folder of a session if need be, a temporary one for None.

    Raises:
        InputError: it cannot be made.
    """
    folder = Path(tempfile.mkdtemp(prefix="bayescal-") if folder is None else folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise bc.InputError(f"cannot write to the folder {folder}: {error.strerror}") from None
    return folder


def fit_path(folder: Path, number: int) -> Path:
    """Return the path of a state's calibration."""
    return folder / f"state_{number:03d}.nc"


def save_session(
    folder: Path, states: Mapping[int, State], current: int, typed: Sequence[str], script: str
) -> None:
    """Write session.json and the script to disk; calibrations are saved apart.

    Raises:
        InputError: it cannot be written.
    """
    saved = [SavedState.of(s) for _, s in sorted(states.items())]
    session = SavedSession(SCHEMA, saved, current, [*typed])
    ws.write_json(ws.as_json(session), folder / SESSION)
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


def load_states(
    folder: Path, saved: SavedSession, effects: Sequence[bc.Effect], instrument: bc.Instrument
) -> Iterator[tuple[SavedState, bc.Calibration]]:
    """Load the states in session.json with their calibrations.

    Raises:
        InputError: a calibration is missing or was changed.
    """
    extra = () if instrument.name in ws.installed_names() else (instrument,)
    for number, state in enumerate(saved.states):
        file = fit_path(folder, number)
        calibration = bc.load(file, effects=effects, instruments=extra)
        if ws.identity(calibration) != state.identity:
            raise bc.InputError(
                f"{file} is not the one that {SESSION} tells of: begin in another folder"
            )
        yield state, calibration


def script(path: Sequence[State], origin: Origin, settings: SearchOptions, folder: Path) -> str:
    """Generate the script that leads from the first state of a path to its last.

    Args:
        path: states, each the parent of the next.
        origin: of readings and effects.
        settings: of the fits.
        folder: that keeps the states' calibrations, for a model that no public function composes.
    """
    beginning, before = _beginning(path[0].model)
    steps = []
    for state in path:
        edits = code_of(before, state.model)
        c, quick = state.calibration, state.model.noise.gaussian
        step = {
            **{"number": state.number, "title": ws.one_line(state.title)},
            "name": f"{state.number} {state.title}",
            "lines": [_load_line(state, origin, folder)] if edits is None else edits,
            "method": method_code(ws.QUICK if quick else settings.method),
            "how": {"seed": c.seed} | ({"start": c.start} if c.start else {}),
        }
        steps.append(step)
        before = state.model
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
        read=origin.read,
        channel=f"[{origin.channel!r}]" if origin.channel else "",
        average=origin.average,
        spikes={"keep_spikes": True} if origin.keep_spikes else {},
        tailored=path[0].model.instrument.tailor is not None,
        reference={"reference": dict(settings.reference)} if settings.reference else {},
        beginning=beginning,
        steps=steps,
        method=method_code(settings.method),
        seed=settings.seed,
    )


def _arguments(values: Mapping[str, Any]) -> str:
    return "".join(f", {name}={value!r}" for name, value in values.items())


def _beginning(model: bc.Model) -> tuple[str, bc.Model]:
    """Return the instrument's structure that needs the fewest edits to make a model, as code and model."""
    instrument = model.instrument
    ways = [("model = instrument.baseline()", instrument.baseline())]
    for name, make in instrument.structures:
        ways.append((f"model = dict(instrument.structures)[{name!r}]()", make()))
    able = [(way, edits) for way in ways if (edits := code_of(way[1], model)) is not None]
    return min(able, key=lambda pair: len(pair[1]), default=(ways[0], []))[0]


def method_code(method: Any) -> str:
    return "bc.Marginal()" if method is None else f"bc.{method!r}"


def _load_line(state: State, origin: Origin, folder: Path) -> str:
    effects = ", effects=tuple(own.values())" if origin.effect_files else ""
    return f"model = bc.load({str(fit_path(folder, state.number))!r}{effects}).model"


def code_of(before: bc.Model, after: bc.Model) -> list[str] | None:
    """Generate lines of Python that change one model to another; None where no public function does.

    Each line is applied to the model itself: the result must equal the other model.
    """
    edits = [("", before), *_edits(before, after)]
    return [line for line, _ in edits[1:]] if edits[-1][1] == after else None


def _edits(model: bc.Model, after: bc.Model) -> Iterator[tuple[str, bc.Model]]:
    """Yield the code of each edit with the edited model."""
    for name in reversed(model.names[_n_common(model, after) :]):
        model = model - name
        yield f"model = model - {name!r}", model
    for effect in after.effects[len(model.effects) :]:
        code, added = _effect_code(effect, after)
        if added is None:
            return
        model = model + added
        yield f"model = model + {code}", model
    for now in after.effects:
        size = now.coefficients[0].size
        if model.effect(now.name) != now and not (now.is_placeholder or now.coefficients[0].flat):
            model = model.resize(now.name, size)
            yield f"model = model.resize({now.name!r}, {size!r})", model
    if model.noise != after.noise:
        code = noise_code(after.noise, after)
        if code is None:
            return
        model = model.with_noise(after.noise)
        yield f"model = model.with_noise({code})", model
    if model.fixed != after.fixed:
        if model.fixed:
            model = model.free()
            yield "model = model.free()", model
        if after.fixed:
            model = model.fix(dict(after.fixed))
            yield f"model = model.fix({dict(after.fixed)!r})", model


def _n_common(before: bc.Model, after: bc.Model) -> int:
    """Count the leading effects that two models share, whatever their plausible sizes."""

    def is_same(both: tuple[bc.Effect, bc.Effect]) -> bool:
        first, second = both
        return first == second or (first.name == second.name and not first.is_placeholder)

    return len(list(takewhile(is_same, zip(before.effects, after.effects, strict=False))))


def _effect_code(effect: bc.Effect, model: bc.Model) -> tuple[str, bc.Effect | None]:
    """Return the code that adds an effect, and the effect at its own plausible size."""
    name, instrument = effect.name, model.instrument
    library = instrument.known
    if isinstance(effect.basis, ws.Formula):
        return f"bc.effect({effect.basis.text!r}, readings=readings, instrument=instrument)", effect
    if name in library:
        return repr(name), library[name]
    base = None
    if effect.is_placeholder:
        with suppress(bc.ModelError):  # one under a name of its own is the user's
            base = instrument.effect(name)
    if base is None:
        return f"own[{name!r}]", effect
    ranges = {
        s.name: (s.low, s.high)
        for s, open_ in zip(effect.shapes, base.shapes, strict=True)
        if open_ != s
    }
    if not ranges:
        return repr(name), base
    return f"instrument.effect({name!r}).ranging({ranges!r})", base.ranging(ranges)


def noise_code(noise: bc.Noise, model: bc.Model) -> str | None:
    """Return a noise law as Python; None where the public names do not make it."""
    if noise == model.instrument.noise:
        return "instrument.noise"
    code = re.sub(r"\b(?=[A-Z]\w*\()", "bc.", repr(noise))
    names = set(re.findall(r"bc\.(\w+)", code))
    return code if names <= set(bc.__all__) else None
