"""A task as given to an entry: readings to fit, rows to predict, the known model, and the candidate effects."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from missing_effect.formulas import FORMULAS

OUTSIDE = "outside"  # in a stated set: something is missing that no candidate describes


@dataclass(frozen=True)
class Term:
    """One term of a measurement equation: a sum of coefficients times columns.

    Attributes:
        name: name of the term, used in the sets of an answer.
        words: the formula, for readers.
        formula: name of the function in `missing_effect.formulas` that computes the columns.
        arguments: arguments of that function, besides the data and the shapes.
        unit: unit of the coefficients.
        size: plausible size of a coefficient, in that unit: standard deviation about zero, known to a factor of three;
            for a group's members, the standard deviation between them.
        shapes: plausible range of each nonlinear parameter of the term, name → (low, high).
        nuisance: whether the term describes a disturbance of the test and not the instrument.
    """

    name: str
    words: str
    formula: str
    arguments: dict[str, Any]
    unit: str
    size: float
    shapes: dict[str, tuple[float, float]] = field(default_factory=dict)
    nuisance: bool = False

    def columns(self, data: pd.DataFrame, **shapes: float) -> np.ndarray:
        """Return the term's columns on readings, (n, k); shapes default to the geometric middle of their range."""
        middle = {n: (low * high) ** 0.5 for n, (low, high) in self.shapes.items()}
        return FORMULAS[self.formula](data, **self.arguments, **{**middle, **shapes})

    @property
    def group(self) -> str:
        """Return the group whose members have one coefficient each; empty if there is none."""
        return self.arguments["group"] if self.formula.startswith("each") else ""


@dataclass(frozen=True)
class Task:
    """The argument of `solve`.

    Attributes:
        name: name of the task.
        unit: unit of the output.
        units: units of the columns, by name.
        train: readings to fit, with the column `output`.
        holdout: later readings of the same instrument, without output, for which `mean` and `sd` are predicted.
        base: terms of the known model.
        candidates: terms of which some, or none, are missing from the model.
    """

    name: str
    unit: str
    units: dict[str, str]
    train: pd.DataFrame
    holdout: pd.DataFrame
    base: tuple[Term, ...]
    candidates: tuple[Term, ...]

    @classmethod
    def read(cls, folder: Path) -> Task:
        """Read a task from its folder.

        Raises:
            FileNotFoundError: the folder contains no task.
        """
        json_data = json.loads((folder / "task.json").read_text("utf-8"))
        base, candidates = (
            tuple(_term(t) for t in json_data[which]) for which in ("base", "candidates")
        )
        train, holdout = (pd.read_csv(folder / f"{n}.csv") for n in ("train", "holdout"))
        names = (json_data[key] for key in ("name", "unit", "units"))
        return cls(*names, train, holdout, base, candidates)

    def description(self) -> dict[str, Any]:
        """Return the content of task.json."""
        return {
            "name": self.name,
            "unit": self.unit,
            "units": self.units,
            "base": [asdict(t) for t in self.base],
            "candidates": [asdict(t) for t in self.candidates],
        }


def _term(entry: dict[str, Any]) -> Term:
    shapes = {name: (low, high) for name, (low, high) in entry["shapes"].items()}
    return Term(**{**entry, "shapes": shapes})
