"""What a correction is, of one output or of three axes: from readings to what acts, with covariance and notes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

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


Writer = Callable[[Mapping[str, Any], bool], str]
"""Writes corrections by the names of their sensors, with or without uncertainty."""


class CorrectionKind(NamedTuple):
    """A kind of corrections: how they are told, written, read back and made."""

    of: type[CorrectionInUse]  # their class
    axes: str  # what they are of, in words, such as "three axes"
    writers: Mapping[str, Writer]  # by format
    suffixes: Mapping[str, str]  # formats by the suffix of a file
    is_data: Callable[[Mapping[str, Any]], bool]  # whether JSON is one of them
    # one from JSON and the name of its file, for messages; `InputError` if it is damaged
    read: Callable[[Any, str], CorrectionInUse]
    loader: str  # the public function that does
    together: tuple[str, ...] = ()  # formats that hold several
    # what a format has no place for, in a sentence; empty for nothing
    left_out: Callable[[Any, str], str] = lambda correction, format: ""
