"""A task as an entry sees it: readings to learn from, rows to predict, the model that is known, what may be missing."""

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
    """One term of a measurement equation: coefficients times columns.

    Attributes:
        name: by which sets are stated.
        words: the formula, for people.
        formula: name of the function of `missing_effect.formulas` that makes its columns.
        arguments: of that function, beside the data and the shapes.
        unit: of its coefficients.
        size: plausible size of a coefficient, in that unit: a standard deviation about zero, known to a factor of
            three. Of a group's members: the standard deviation between them.
        shapes: plausible range of each quantity that the term is not linear in, name → (low, high).
        nuisance: whether it stands for a disturbance of the test, not for the instrument.
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
        """Return a term's columns on readings, (n, k), at the geometric middle of a shape's range by default."""
        middle = {n: (low * high) ** 0.5 for n, (low, high) in self.shapes.items()}
        return FORMULAS[self.formula](data, **self.arguments, **{**middle, **shapes})

    @property
    def group(self) -> str:
        """Return the group whose members have a coefficient each; empty if there is none."""
        return self.arguments["group"] if self.formula.startswith("each") else ""


@dataclass(frozen=True)
class Task:
    """What `solve` gets.

    Attributes:
        name: of the task.
        unit: of the output.
        units: of the columns.
        train: readings, `output` among the columns.
        holdout: later readings of the same instrument, without the output: `mean` and `sd` are asked for.
        base: terms that the model has.
        candidates: terms of which some, or none, are missing.
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
            FileNotFoundError: the folder is not one of a task.
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
