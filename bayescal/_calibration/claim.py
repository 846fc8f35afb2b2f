"""A claim: something that the program says of readings or of a result, as data. Its words are in `claim_words`.

Code asks what a claim is by its code, of what by its names, and how large by its numbers; it never reads its words.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from bayescal._calibration.claim_words import WORDS, worded


class Claim:
    """One of them; two of the same code, names and numbers are equal.

    Attributes:
        code: what is said; a key of `claim_words.WORDS`.
        of: names of the effects, coefficients, columns or groups that it is of, the most important first.
        numbers: what its words hold, by name: numbers, names (several in a tuple) and units.
    """

    def __init__(self, code: str, *of: str, **numbers: Any) -> None:
        self.code, self.of, self.numbers = code, of, numbers

    @property
    def severity(self) -> str:
        """What it means for the result: "stop" and "doubt" shut the gate, a "note" does not."""
        return WORDS[self.code].severity

    def __str__(self) -> str:
        """What is said, and what to do."""
        return worded(self.code, {"of": self.of, **self.numbers})

    def __repr__(self) -> str:
        return f"<Claim: {self.code} {', '.join(self.of)}>"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Claim) and self._all == other._all

    def __hash__(self) -> int:
        return hash((self.code, self.of))

    @property
    def _all(self) -> tuple[Any, ...]:
        return self.code, self.of, self.numbers

    def data(self) -> dict[str, Any]:
        """As in result.json."""
        return {
            "code": self.code,
            "of": list(self.of),
            "severity": self.severity,
            "in_words": str(self),
        }


def as_kept(words: str) -> Claim:
    """What a saved calibration says against itself, of which the words alone were kept."""
    return Claim("kept", words=words)


def distinct(claims: Iterable[Claim]) -> tuple[Claim, ...]:
    """Each that says something else than those before it."""
    found: dict[str, Claim] = {}
    for one in claims:
        found.setdefault(str(one), one)
    return tuple(found.values())
