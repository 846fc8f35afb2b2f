"""Exceptions that bayescal raises.

BayescalError
├── InputError      a file, a column, a unit or an option cannot be used as it is   (exit status 2)
├── ModelError      a model cannot be composed, or not with these readings          (exit status 2)
├── NotConverged    a fit did not converge; carries the calibration                 (exit status 1)
└── NotDrawn        a figure or a page failed; its result has been written          (exit status 1)
"""

from __future__ import annotations

from typing import Any


class BayescalError(Exception):
    """The root: catching it catches everything that bayescal refuses."""


class InputError(BayescalError):
    """An input cannot be used; the message says where, what and what to do.

    Attributes:
        problems: of files, one by one (`bayescal._tables.raw_table.Objection`); empty for other errors.
    """

    def __init__(self, message: str, problems: tuple[Any, ...] = ()) -> None:
        super().__init__(message)
        self.problems = problems


class ModelError(BayescalError):
    """An instrument, effects and a noise law do not go together, or not with these readings."""


class NotConverged(BayescalError):
    """A fit ended without converging.

    Attributes:
        calibration: the result at the last iteration, with its verdict; use it at your own risk.
    """

    def __init__(self, message: str, calibration: Any = None) -> None:
        super().__init__(message)
        self.calibration = calibration


class NotDrawn(BayescalError):
    """A picture, or a page with pictures, could not be made; the result that it was to show is written all the same."""

    def __init__(self, what: str, why: BaseException) -> None:
        first = next(iter(str(why).splitlines()), "")
        reason = f"{type(why).__name__}: {first}".removesuffix(": ")
        super().__init__(
            f"{what} could not be drawn ({reason}); the result is kept, and stands as it is"
        )
