"""What a correction is, of one output or of three axes: from readings to what acts, with covariance and notes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

NOT_RELIABLE = "RESULT NOT RELIABLE: "


class CorrectionInUse(ABC):
    """What turns readings into what acts, with its uncertainty, and leaves as a file (`correction_files.py`)."""

    @abstractmethod
    def about_it(self) -> tuple[str, tuple[str, ...], str]:
        """The instrument's name; what to know, each a sentence; why it is not to be used, empty where it may be."""

    @abstractmethod
    def data(self) -> dict[str, Any]:
        """What its JSON file holds."""

    @property
    def why_not(self) -> str:
        """Why the result is not to be used, in words; empty where it may be."""
        return self.about_it()[2]

    @property
    def notes_on_use(self) -> tuple[str, ...]:
        """What to know but what stands against using it."""
        _, notes, why_not = self.about_it()
        return tuple(note for note in notes if note != f"{NOT_RELIABLE}{why_not}")


def kept_why(data: Mapping[str, Any]) -> str:
    """Why a result is not to be used, of a correction's JSON: `why_not`, or the note that older files mark."""
    marked = (
        n[len(NOT_RELIABLE) :] for n in data["notes"] if n[: len(NOT_RELIABLE)] == NOT_RELIABLE
    )
    return data["why_not"] if "why_not" in data else next(marked, "")
