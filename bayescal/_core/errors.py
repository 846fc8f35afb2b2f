"""Exceptions that bayescal raises.

BayescalError
├── InputError      a file, a column, a unit or an option is invalid                (exit status 2)
├── ModelError      a model cannot be composed, or not be used with these readings  (exit status 2)
├── NotConverged    a fit did not converge; carries the calibration                 (exit status 1)
└── NotDrawn        a figure or page could not be drawn; its result is written      (exit status 1)
"""

from __future__ import annotations

from typing import Any


class BayescalError(Exception):
    """Base class of all exceptions that bayescal raises deliberately."""


class InputError(BayescalError):
    """Raised when an input is invalid; the message states where, what is wrong, and the remedy.

    Attributes:
        problems: the problems found in files, of type `bayescal._tables.raw_table.Objection`; empty for other inputs.
    """

    def __init__(self, message: str, problems: tuple[Any, ...] = ()) -> None:
        super().__init__(message)
        self.problems = problems


class ModelError(BayescalError):
    """Raised when an instrument, effects and a noise law are incompatible with each other or with the readings."""


class NotConverged(BayescalError):
    """Raised when a fit does not converge.

    Attributes:
        calibration: the result at the last iteration, with a verdict; not reliable.
    """

    def __init__(self, message: str, calibration: Any = None) -> None:
        super().__init__(message)
        self.calibration = calibration


class NotDrawn(BayescalError):
    """Raised when a figure, or a page with figures, cannot be drawn after the result has been written."""

    def __init__(self, subject: str, cause: BaseException) -> None:
        first_line = next(iter(str(cause).splitlines()), "")
        reason = f"{type(cause).__name__}: {first_line}".removesuffix(": ")
        super().__init__(f"{subject} could not be drawn ({reason}); the result has been written")
