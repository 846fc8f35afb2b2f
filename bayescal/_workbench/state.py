"""A state: one model with its fit, where it came from, and what is missing from it. States form a tree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._search.discover import Discovery
from bayescal._search.search_path import Step

FOLDER = "state_{:03d}"  # that a state is kept in, by its number


@dataclass(frozen=True, eq=False)
class State:
    """One model of the tree. Nothing in it changes; a look gives the same state with its discovery.

    Attributes:
        number: of the state, from 0.
        parent: number of the state that it was made from; None for the first.
        step: its fit by least squares, where it fails, its errors.
        at: when it was made.
        discovery: what is missing from it; None until it was looked for.
    """

    number: int
    parent: int | None
    step: Step
    at: datetime
    discovery: Discovery | None = None

    @property
    def title(self) -> str:
        """What was done, in a few words: "baseline", "+ bias.thermal_lag"."""
        return self.step.title

    @property
    def calibration(self) -> Calibration:
        return self.step.calibration

    @property
    def model(self) -> Model:
        return self.step.calibration.model

    @property
    def sized(self) -> dict[str, Effect]:
        """What a look would add of the instrument's effects, by name, at the sizes likeliest beside each other."""
        known = {e.name for e in self.model.instrument.candidates}
        return {
            e.name: e for e in (self.discovery.best if self.discovery else ()) if e.name in known
        }


def path_to(states: Mapping[int, Any], number: int) -> list[int]:
    """Numbers of the states from the first to one."""
    path = [number]
    while (parent := states[path[0]].parent) is not None:
        path.insert(0, parent)
    return path
