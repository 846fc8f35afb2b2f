"""What a correction is, of one output or of three axes: from readings to what acts, with covariance and notes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

NOT_RELIABLE = "RESULT NOT RELIABLE: "


class CorrectionInUse(ABC):
    """What turns readings into what acts, with its uncertainty, and leaves as a file (`correction_files.py`)."""

    @abstractmethod
    def about_it(self) -> tuple[str, tuple[str, ...]]:
        """The instrument's name, and what to know, each a sentence."""

    @abstractmethod
    def data(self) -> dict[str, Any]:
        """What its JSON file holds."""

    @property
    def why_not(self) -> str:
        """Why the result is not to be used, in words; empty where it may be."""
        told = (note for note in self.about_it()[1] if note.startswith(NOT_RELIABLE))
        return next(told, "").removeprefix(NOT_RELIABLE)

    @property
    def notes_on_use(self) -> tuple[str, ...]:
        """What to know but what stands against using it."""
        notes = self.about_it()[1]
        return tuple(note for note in notes if not note.startswith(NOT_RELIABLE))
