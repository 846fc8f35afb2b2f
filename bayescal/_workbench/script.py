"""What was clicked, as Python: a script that fits the same models to the same readings, and gives the same numbers.

A state is a model; the script is the differences from each model to the next, in the words of the public functions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import bayescal
from bayescal._core.quoting import one_line
from bayescal._core.version import __version__
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise
from bayescal._search.calibrate import QUICK
from bayescal._workbench.kept import FOLDER, Origin, Settings, State

HEAD = '''"""What was done in the bayescal workbench, up to step {number}. It needs bayescal {version} or later."""

{imports}
'''
FITTED = '''
calibrations = []


def fitted(title, model, method, **start):
    """Fit a model, and print its errors: as fitted, and of the hold-out data."""
    calibration = bc.fit(model, readings, method, {settings}, **start)
    calibrations.append(calibration)
    errors = {{"as fitted": bc.check(calibration).rms}}
    if holdout is not None:
        errors["held out"] = bc.predict(calibration, holdout).rmse
    print(title, errors, calibration.unit)
    return calibration

'''
LAST = """
print(calibration)
print(bc.check(calibration))

# The fit that the report and exports are of.
final = bc.fit(model, readings, {method}, {settings})
print(final)
"""


def script(path: Sequence[State], origin: Origin, settings: Settings, folder: Path) -> str:
    """The script that leads from the first state of a path to its last.

    Args:
        path: states, each the parent of the next.
        origin: of readings and effects.
        settings: of the fits.
        folder: that keeps the states' calibrations, for a model that no public function composes (departures of
            effects from their forms).
    """
    how = f"seed={settings.seed}, strict=False"
    how += f", reference={dict(settings.reference)!r}" if settings.reference else ""
    runs = "runpy" if origin.effect_files or ".py:" in origin.instrument else ""
    imports = "\n".join([*(["import runpy", ""] if runs else []), "import bayescal as bc"])
    instrument = path[0].model.instrument
    lines = [
        HEAD.format(number=path[-1].number, version=__version__, imports=imports).rstrip("\n"),
        *origin.code(tailored=instrument.tailor is not None),
        FITTED.format(settings=how),
    ]
    line, before = _beginning(path[0].model)
    lines.append(line)
    for state in path:
        lines += ["", f"# {state.number}: {one_line(state.title)}"] if state.number else []
        changed = code_of(before, state.model)
        lines += [_loaded(state, origin, folder)] if changed is None else changed
        quick = method_code(QUICK if state.model.noise.gaussian else settings.method)
        title = f"{state.number} {state.title}"
        start = state.calibration.start
        begun = f", start={start!r}" if start else ""
        lines.append(f"calibration = fitted({title!r}, model, {quick}{begun})")
        before = state.model
    return "\n".join([*lines, LAST.format(method=method_code(settings.method), settings=how)])


def _beginning(model: Model) -> tuple[str, Model]:
    """The baseline, or the instrument's structure that a model is, or was made of."""
    instrument = model.instrument
    ways = [("model = instrument.baseline()", instrument.baseline())]
    for name, make in instrument.structures:
        ways.append((f"model = dict(instrument.structures)[{name!r}]()", make()))
    able = [(way, edits) for way in ways if (edits := code_of(way[1], model)) is not None]
    return min(able, key=lambda one: len(one[1]), default=(ways[0], []))[0]


def method_code(method: Any) -> str:
    return "bc.Marginal()" if method is None else f"bc.{method!r}"


def _loaded(state: State, origin: Origin, folder: Path) -> str:
    own = ", effects=tuple(own.values())" if origin.effect_files else ""
    path = str(folder / FOLDER.format(state.number) / "calibration.nc")
    return f"model = bc.load({path!r}{own}).model  # with departures of effects from their forms"


def code_of(before: Model, after: Model) -> list[str] | None:
    """Lines of Python that make one model of another; None where no public function does.

    Each line is tried on the model itself: what comes of them all must be the other model.
    """
    edits = [("", before), *_edits(before, after)]
    return [line for line, _ in edits[1:]] if edits[-1][1] == after else None


def _edits(model: Model, after: Model) -> Iterator[tuple[str, Model]]:
    """Each change with what it makes."""
    for name in reversed(model.names[_shared(model, after) :]):
        model = model - name
        yield f"model = model - {name!r}", model
    for effect in after.effects[len(model.effects) :]:
        said, made = _effect_code(effect, after)
        if made is None:
            return
        model = model + made
        yield f"model = model + {said}", model
    for now in after.effects:
        size = now.coefficients[0].size
        if model.effect(now.name) != now and not (now.is_placeholder or now.coefficients[0].flat):
            model = model.resize(now.name, size)
            yield f"model = model.resize({now.name!r}, {size!r})", model
    if model.noise != after.noise:
        said = noise_code(after.noise, after)
        if said is None:
            return
        model = model.with_noise(after.noise)
        yield f"model = model.with_noise({said})", model
    if model.fixed != after.fixed:
        if model.fixed:
            model = model.free()
            yield "model = model.free()", model
        if after.fixed:
            model = model.fix(dict(after.fixed))
            yield f"model = model.fix({dict(after.fixed)!r})", model


def _shared(before: Model, after: Model) -> int:
    """How many effects at the beginning the two have in common; of other plausible sizes, they still are."""

    def alike(both: tuple[Effect, Effect]) -> bool:
        one, other = both
        return one == other or (one.name == other.name and not one.is_placeholder)

    return len(list(takewhile(alike, zip(before.effects, after.effects, strict=False))))


def _effect_code(effect: Effect, model: Model) -> tuple[str, Effect | None]:
    """An effect as it is added, at its own plausible size."""
    name, instrument = effect.name, model.instrument
    known = {e.name: e for e in (*instrument.effects, *instrument.candidates)}
    if name in known:
        return repr(name), known[name]
    if name.startswith("unknown("):
        made = instrument.effect(name)
        ranges = {
            s.name: (s.low, s.high)
            for s, open_ in zip(effect.shapes, made.shapes, strict=True)
            if open_ != s
        }
        if not ranges:
            return repr(name), made
        return f"instrument.effect({name!r}).ranging({ranges!r})", made.ranging(ranges)
    if name.startswith("departure("):
        return "", None
    return f"own[{name!r}]", effect


def noise_code(noise: Noise, model: Model) -> str | None:
    """A noise law as Python; None where the public names do not make it."""
    if noise == model.instrument.noise:
        return "instrument.noise"
    said = re.sub(r"\b(?=[A-Z]\w*\()", "bc.", repr(noise))
    names = set(re.findall(r"bc\.(\w+)", said))
    return said if names <= set(bayescal.__all__) else None
