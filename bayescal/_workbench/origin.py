"""What a session was asked: where instrument, readings and effects come from, and the settings of `calibrate`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import bayescal
from bayescal._core.errors import InputError
from bayescal._core.json_shape import ANY, OneOf
from bayescal._data.measurements import Measurements
from bayescal._data.read import read
from bayescal._data.read_options import ReadOptions
from bayescal._data.set_aside import set_aside
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.installed import GROUP, installed_names
from bayescal._model.instrument import Instrument
from bayescal._search.own_files import in_a_file, instrument_named, user_effects

METHODS = ("LeastSquares", "Marginal", "NUTS")
READ = {
    **{"columns?": {str: str}, "units?": {str: str}, "ignore?": [str]},
    **{"local_gravity?": float, "nominal_scale?": str, "nominal_zero?": str},
    "outputs?": [str],
    **{"missing?": str, "decimal?": str, "date_order?": str},
}
SHAPE = {  # of an `Origin`
    "instrument": str,
    **{"files": [str], "holdout": [str], "effect_files": [str], "channel?": str},
    "read": READ,
    "average": OneOf(None, str),
    "keep_spikes": bool,
}
SETTINGS_SHAPE = {  # of `Settings.data`
    "method": OneOf(None, {str: ANY}),
    **{"max_effects": int, "seed": int, "widen_noise": bool, "keep_spikes": bool},
    "reference": OneOf(None, {str: OneOf(float, {str: float})}),
    "time_limit": OneOf(None, float),
    "accept_conflicts": [str],
}


@dataclass(frozen=True)
class Origin:
    """What was opened. All of it is data: names of files are quoted where they stand in a script.

    Attributes:
        instrument: name of an installed one, or my.py:INSTRUMENT; empty where it was made in Python.
        files, holdout: of readings, in full.
        read: arguments of `bayescal.read` that are not its usual ones.
        average: time over which means are taken; None for single readings.
        keep_spikes: whether single readings far from both neighbours stay.
        effect_files: Python files with effects of the user's own, in full.
        channel: which of the outputs that `read` names; empty where there is one.
    """

    instrument: str
    files: tuple[str, ...]
    holdout: tuple[str, ...] = ()
    read: Mapping[str, Any] = field(default_factory=dict)
    average: str | None = None
    keep_spikes: bool = False
    effect_files: tuple[str, ...] = ()
    channel: str = ""

    @classmethod
    def of(
        cls,
        instrument: str,
        files: Sequence[Path | str],
        holdout: Sequence[Path | str] | None = None,
        read: Mapping[str, Any] | None = None,
        effect_files: Sequence[Path | str] = (),
        **more: Any,
    ) -> Origin:
        """With paths in full, and no argument that is the usual one."""
        if in_a_file(instrument):
            file, _, name = instrument.rpartition(":")
            instrument = f"{Path(file).resolve()}:{name}"
        full = [tuple(str(Path(p).resolve()) for p in some) for some in (files, holdout or ())]
        usual = vars(ReadOptions())
        given = {k: v for k, v in (read or {}).items() if v != usual.get(k)}
        given = {k: list(v) if isinstance(v, tuple) else v for k, v in given.items()}  # as JSON
        own = tuple(str(Path(p).resolve()) for p in effect_files)
        return cls(instrument, *full, read=given, effect_files=own, **more)

    @classmethod
    def kept(
        cls,
        instrument: Instrument,
        readings: Measurements,
        holdout: Measurements | None,
        folder: Path,
        keep_spikes: bool,
    ) -> Origin:
        """Of readings in memory, which are written to a folder.

        Raises:
            InputError: it cannot be written to.
        """
        files = [readings.write(folder / "readings.nc")]
        apart = [] if holdout is None else [holdout.write(folder / "holdout.nc")]
        name = instrument.name if instrument.name in installed_names() else ""
        return cls.of(name, files, apart, keep_spikes=keep_spikes)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Origin:
        """From plain JSON of its fields."""
        lists = {n: tuple(data[n]) for n in ("files", "holdout", "effect_files")}
        return cls(**{**data, **lists})

    @property
    def python_files(self) -> tuple[str, ...]:
        """Those that are run where this is opened."""
        file = self.instrument.rpartition(":")[0] if in_a_file(self.instrument) else ""
        return (*([file] if file else []), *self.effect_files)

    def open_holdout(self, instrument: Instrument) -> Measurements | None:
        """The hold-out data as they were; None without."""
        if not self.holdout:
            return None
        found = read(list(self.holdout), instrument, **self.read)
        kept = found[self.channel] if self.channel else found
        if self.average is not None:
            kept = set_aside(kept, self.keep_spikes).average(self.average)
        return kept

    def open_instrument(self) -> Instrument | None:
        """The instrument, not yet tailored; None where it was made in Python.

        Raises:
            InputError: it is no longer there.
        """
        return instrument_named(self.instrument) if self.instrument else None

    def open_effects(self) -> dict[str, Effect]:
        """Effects of the user's own, by name: their files are run.

        Raises:
            InputError: a file is gone, or fails.
        """
        return {e.name: e for path in self.effect_files for e in user_effects(Path(path))}

    def code(self, tailored: bool) -> list[str]:
        """Lines of Python that open the same: `instrument`, `readings`, `holdout`, `own`.

        Args:
            tailored: whether the instrument is made for the readings.
        """
        spikes = ", keep_spikes=True" if self.keep_spikes else ""
        options = "".join(f", {name}={value!r}" for name, value in self.read.items())
        lines = [*self._code_of_instrument(), *self._code_of_effects(), ""]
        channel = f"[{self.channel!r}]" if self.channel else ""
        parts = {"readings": self.files, "holdout": self.holdout}
        for name, files in parts.items():
            if not files:
                lines.append(f"{name} = None")
                continue
            lines.append(f"{name} = bc.read({list(files)!r}, instrument{options}){channel}")
            if self.average is not None:
                lines.append(f"{name} = bc.set_aside({name}{spikes}).average({self.average!r})")
        if tailored:
            lines.append("instrument = instrument.for_readings(readings)")
        done = [name for name, files in parts.items() if files]
        return [*lines, *(f"{name} = bc.set_aside({name}{spikes})" for name in done)]

    def _code_of_instrument(self) -> list[str]:
        if not self.instrument:
            return ["instrument = ...  # yours, made in Python: give it here"]
        if in_a_file(self.instrument):
            file, _, name = self.instrument.rpartition(":")
            return [f"instrument = runpy.run_path({file!r})[{name!r}]"]
        found = entry_points(group=GROUP)[self.instrument]
        return [f"from {found.module} import {found.attr} as instrument"]

    def _code_of_effects(self) -> list[str]:
        if not self.effect_files:
            return []
        return [
            "own = {}  # effects of your own, by name",
            f"for path in {list(self.effect_files)!r}:",
            "    defined = runpy.run_path(path)",
            '    effects = defined.get("EFFECTS", tuple(defined.values()))',
            "    effects = effects if isinstance(effects, tuple | list) else (effects,)",
            "    own |= {e.name: e for e in effects if isinstance(e, bc.Effect)}",
        ]


@dataclass(frozen=True)
class Settings:
    """What `calibrate` is asked with, apart from model and readings; see there."""

    method: Method | None = None
    max_effects: int = 5
    widen_noise: bool = True
    keep_spikes: bool = False
    seed: int = 0
    reference: Reference | None = None
    time_limit: float | None = None
    accept_conflicts: Collection[str] = ()

    @classmethod
    def of(cls, **given: Any) -> Settings:
        """Of keywords as `calibrate` takes them.

        Raises:
            InputError: there is no such setting.
        """
        known = cls.__dataclass_fields__
        if strange := sorted(set(given) - set(known)):
            raise InputError(
                f"no setting is called {', '.join(strange)}: there are {', '.join(known)}"
            )
        return cls(**given)

    def data(self) -> dict[str, Any]:
        """As JSON has them; the method by its name and arguments."""
        method = self.method and {"name": type(self.method).__name__, **vars(self.method)}
        conflicts = sorted(self.accept_conflicts)
        return {**vars(self), "method": method, "accept_conflicts": conflicts}

    @classmethod
    def from_data(cls, told: Mapping[str, Any]) -> Settings:
        """What `data` gave.

        Raises:
            ValueError, TypeError: it did not give this.
        """
        method = told["method"]
        if method is not None:
            given = {k: tuple(v) if isinstance(v, list) else v for k, v in method.items()}
            name = str(given.pop("name", ""))
            if name not in METHODS:
                raise ValueError(f"its method {name!r} is not one of {', '.join(METHODS)}")
            method = getattr(bayescal, name)(**given)
        return cls(**{**told, "method": method})
