"""A claim: something that the program says of readings or of a result, as data; its words are in `claim_words`."""

from __future__ import annotations

from typing import Any, Self

from bayescal._calibration.claim_words import WORDS, worded
from bayescal._core.flag import Flag


class Claim(Flag):
    """What is said and what to do, as text that knows its code, names and numbers: code asks these, never the words.

    Attributes:
        code: a key of `claim_words.WORDS`.
        of: names of the effects, coefficients, columns or groups that it is of, the most important first.
        numbers: what its words hold, by name: numbers, names (several in a tuple) and units.
    """

    numbers: dict[str, Any]

    def __new__(cls, code: str, *of: str, **numbers: Any) -> Self:
        made = super().__new__(cls, worded(code, {"of": of, **numbers}), code, *of)
        made.numbers = numbers
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[str, ...], dict[str, Any]]:
        return (self.code, *self.of), self.numbers

    def __repr__(self) -> str:
        return f"<Claim: {self.code} {', '.join(self.of)}>"

    @property
    def severity(self) -> str:
        """What it means for the result: "stop" and "doubt" shut the gate, a "note" does not."""
        return WORDS[self.code].severity

    def data(self) -> dict[str, Any]:
        """Return what result.json has of it."""
        return {
            **{"code": self.code, "of": list(self.of)},
            **{"severity": self.severity, "in_words": str(self)},
        }


def as_claim(words: str) -> Claim:
    """Return a claim as it is, and what a saved calibration says against itself as one of which only words are left."""
    return words if isinstance(words, Claim) else Claim("kept", words=words)
