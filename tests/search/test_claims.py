"""Claims: each code has words, which one page holds; of a saved one the words are kept; equal ones count once."""

from __future__ import annotations

import pickle
import string
from pathlib import Path

import pytest

from tests.support.inside import WORDS, Claim, Words, as_claim

PAGE = Path(__file__).with_name("claims.txt")
NAMES = ("by", "column", "columns", "along", "values", "named", "taus")  # that may be several
TEXTS = ("said", "reasons", "how", "what", "before", "outside", "another", "words", "scheme")
TEXTS = (*TEXTS, "combination")
TEXTS = (*TEXTS, "group", "member", "step", "term", "lead")


def filled(code: str, cure: str = "") -> Claim:
    """A claim with something for everything that its words hold."""
    words = WORDS[code]
    text = f"{words.says} {words.cures.get(cure, '')}"
    held = {n for _, n, _, _ in string.Formatter().parse(text) if n and not n.startswith("of")}
    numbers: dict[str, object] = dict.fromkeys(held, 12.34567)
    numbers |= dict.fromkeys(held & {"unit", "own"}, "deg/s")
    numbers |= dict.fromkeys(held & {"count", "free", "members"}, 7)
    numbers |= {n: (f"<{n} 1>", f"<{n} 2>") for n in held & {*NAMES}}
    numbers |= {n: f"<{n}>" for n in held & {*TEXTS}}
    return Claim(code, "bias.a", "bias.b", cure=cure, **numbers)


def every() -> list[Claim]:
    return [filled(code, cure) for code, words in WORDS.items() for cure in words.cures or [""]]


def test_the_words_of_every_claim() -> None:
    """The golden text; `python -m tests.search.test_claims` writes it anew, to be read before it is kept."""
    assert page() == PAGE.read_text("utf-8")


def page() -> str:
    return "".join(f"{one.code} ({one.severity})\n    {one}\n" for one in every())


@pytest.mark.parametrize("words", WORDS.values(), ids=WORDS)
def test_a_severity_is_one_of_three(words: Words) -> None:
    assert words.severity in ("stop", "doubt", "note")


def test_equal_claims_count_once_and_those_of_a_saved_calibration_too() -> None:
    one, other = (Claim("prior.widened", "x", contraction=c) for c in (-2.0, -3.0))
    assert one == Claim("prior.widened", "x", contraction=-2.0) != other
    assert {one, other, as_claim(one), as_claim(str(other))} == {one, other}
    assert pickle.loads(pickle.dumps(one)).numbers == one.numbers
    told = {"code": "prior.widened", "of": ["x"], "severity": "stop"}
    assert one.data() == {**told, "in_words": str(one)}


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
