"""A session's folder: each state as a calibration and a script, whole or not at all, so that a killed server goes on.

session.json               where the readings come from, the settings, which state is current
state_000/                 the first state, and so on:
    calibration.nc         its fit, as `bayescal calibrate` saves one
    script.py              Python that leads to it, with the same numbers
    state.json             title, parent, time
    manifest.json          what belongs together
drafts/                    effects of the user's own that were loaded, as code
result_000/                reports and exports of a state, when they were asked for
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity
from bayescal._calibration.fit import load
from bayescal._calibration.posterior_tree import build_tree
from bayescal._calibration.storage import save
from bayescal._core.atomic_file import to_disk, write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import OneOf, mismatch, read_json
from bayescal._model.effect import Effect
from bayescal._model.instrument import Instrument
from bayescal._report.whole_folder import AGAIN, MANIFEST, refuse_mixed, whole_folder
from bayescal._workbench import origin
from bayescal._workbench.origin import Origin, Settings
from bayescal._workbench.state import FOLDER, State

SESSION, STATE, CALIBRATION, SCRIPT = "session.json", "state.json", "calibration.nc", "script.py"
SCHEMA = "bayescal.workbench/1"
SESSION_SHAPE = {
    "schema": str,
    "origin": origin.SHAPE,
    "settings": origin.SETTINGS_SHAPE,
    "current": int,
}
STATE_SHAPE = {
    **{"number": int, "parent": OneOf(None, int), "title": str, "at": str},
    **{"added": OneOf(None, str), "changed": str},
}
# Replicated readings that a step keeps, in draws: of 500 at 2,000 readings they took half the time of *Add*.
REPLICATED = 20
_NUMBERED = re.compile(r"session_(\d+)")
_STATE = re.compile(r"\.?state_(\d{3,})(\..*)?")


def begun_folder(folder: str | Path | None) -> Path:
    """The folder of a new session, made if need be; None: a temporary one.

    Raises:
        InputError: it cannot be made, or holds a session.
    """
    folder = Path(tempfile.mkdtemp(prefix="bayescal-") if folder is None else folder)
    if (folder / SESSION).is_file():
        raise InputError(f"{folder} holds a session already: resume it, or give another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to the folder {folder}: {error.strerror}") from None
    return folder


def keep_state(folder: Path, state: State, script: str) -> None:
    """Keep one state; when this returns, it is on the disk.

    Raises:
        InputError: it cannot be written.
    """
    own = folder / FOLDER.format(state.number)
    if (own / MANIFEST).is_file():
        raise InputError(
            f"{own} was made meanwhile: another workbench goes on in {folder}. End one"
        )
    try:
        own.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to the folder {folder}: {error.strerror}") from None
    told = {
        "number": state.number,
        "parent": state.parent,
        "title": state.title,
        "at": state.at.isoformat(),
        "added": state.step.added,
        "changed": state.step.changed,
    }
    with whole_folder(own, identity(state.calibration)) as hidden:
        cells = REPLICATED * len(state.calibration.readings)
        save(state.calibration, build_tree(state.calibration, cells), hidden / CALIBRATION)
        write_text(script, hidden / SCRIPT)
        write_text(json.dumps(told, indent=2, ensure_ascii=False) + "\n", hidden / STATE)
    to_disk(folder)


def keep_session(folder: Path, of: Origin, settings: Settings, current: int) -> None:
    """Keep what the session is about, and which state is current.

    Raises:
        InputError: it cannot be written.
    """
    about = {"origin": asdict(of), "settings": settings.data()}
    told = {"schema": SCHEMA, **about, "current": current}
    write_text(json.dumps(told, indent=2, ensure_ascii=False) + "\n", folder / SESSION)


def keep_draft(folder: Path, code: str) -> Path:
    """Keep code that defines effects of the user's own.

    Raises:
        InputError: it cannot be written.
    """
    drafts = folder / "drafts"
    drafts.mkdir(exist_ok=True)
    numbers = (p.stem.rpartition("_")[2] for p in drafts.glob("draft_*.py"))
    taken = [int(n) for n in numbers if n.isdecimal()]
    return write_text(code, drafts / f"draft_{max(taken, default=0) + 1}.py")


def session_in(folder: Path) -> dict[str, Any]:
    """What session.json says.

    Raises:
        InputError: there is none, or none that can be read.
    """
    try:
        told = read_json(folder / SESSION)
        if isinstance(told, dict) and told.get("schema") != SCHEMA:
            raise ValueError(f"its schema is {told.get('schema')!r}, expected {SCHEMA!r}")
        if said := mismatch(told, SESSION_SHAPE):
            raise ValueError(said)
        settings = Settings.from_data(told["settings"])
        return {**told, "origin": Origin.from_data(told["origin"]), "settings": settings}
    except (OSError, ValueError, TypeError, InputError) as error:
        raise InputError(
            f"{folder} holds no session that can be gone on with ({error}): begin one in another folder"
        ) from None


def last_step(folder: Path) -> str:
    """What was done last in a session that is not open, in words; empty where its folder does not say."""
    try:
        own = folder / FOLDER.format(session_in(folder)["current"])
        told = read_json(own / STATE, STATE_SHAPE)
        return f"step {told['number']}: {told['title']}"
    except (OSError, ValueError, InputError):
        return ""


def states_in(
    folder: Path, effects: Mapping[str, Effect], instrument: Instrument | None
) -> Iterator[tuple[dict[str, Any], Calibration]]:
    """The states that were kept whole, in order: what state.json says, and the calibration.

    Raises:
        InputError: one of them was changed since.
    """
    numbers = {int(m[1]) for path in folder.iterdir() if (m := _STATE.fullmatch(path.name))}
    seen: list[int] = []
    for number in sorted(numbers):
        own = folder / FOLDER.format(number)
        if not (own / MANIFEST).is_file():  # killed before it was whole
            continue
        refuse_mixed(own)
        try:
            told = read_json(own / STATE, STATE_SHAPE)
            told["at"] = datetime.fromisoformat(told["at"])
            if told["number"] != number or told["parent"] not in (*seen, *([] if seen else [None])):
                raise ValueError("its number or its parent is none of this session's")
        except (OSError, ValueError) as error:
            raise InputError(f"{own / STATE} is not as it was written ({error}). {AGAIN}") from None
        seen.append(number)
        given = () if instrument is None else (instrument,)
        yield told, load(own / CALIBRATION, effects=tuple(effects.values()), instruments=given)


def fresh_folder(parent: Path) -> Path:
    """A new folder session_1, session_2 … in another; two callers never get the same.

    Raises:
        InputError: it cannot be written to.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        while True:
            there = (m for p in parent.iterdir() if (m := _NUMBERED.fullmatch(p.name)))
            folder = parent / f"session_{max((int(m[1]) for m in there), default=0) + 1}"
            try:
                folder.mkdir()
                return folder
            except FileExistsError:
                continue
    except OSError as error:
        raise InputError(f"cannot write to the folder {parent}: {error.strerror}") from None
