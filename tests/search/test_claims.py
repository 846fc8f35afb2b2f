"""Claims: each code can be said; a threshold has its reason; of saved ones words are kept; equal ones count once."""

from __future__ import annotations

import pickle
import string
from pathlib import Path

import pytest

import bayescal as bc
from tests.support.inside import CRITERIA, Claim, as_claim

FILE = Path(bc.__file__).with_name("_calibration") / "claims.toml"
WHOLE = ("count", "free", "members")  # numbers that are whole
SEVERAL = ("values", "named", "columns", "taus", "times", "places")  # names, or numbers in words


@pytest.mark.parametrize("code", CRITERIA)
def test_a_claim_is_said_with_each_of_its_cures(code: str) -> None:
    criterion = CRITERIA[code]
    assert criterion.severity in ("stop", "doubt", "note")
    for cure in criterion.remedies or [""]:
        text = f"{criterion.template} {criterion.remedies.get(cure, '')}"
        held = {n for _, n, _, _ in string.Formatter().parse(text) if n and not n.startswith("of")}
        numbers = {n: 7 if n in WHOLE else 12.34567 for n in held} | {"unit": "deg/s"}
        numbers |= dict.fromkeys(held.intersection(SEVERAL), ("a", "b"))
        said = Claim(code, "bias.a", "bias.b", cure=cure, **numbers)
        assert said.code == code
        assert "{" not in said


def test_every_threshold_has_its_reason_beside_it() -> None:
    lines = FILE.read_text("utf-8").splitlines()
    assert not [line for line in lines if line.startswith("limits.") and "#" not in line]


def test_equal_claims_count_once_and_those_of_a_saved_calibration_too() -> None:
    one, other = (Claim("prior.widened", "x", contraction=c) for c in (-2.0, -3.0))
    assert one == Claim("prior.widened", "x", contraction=-2.0) != other
    assert {one, other, as_claim(one), as_claim(str(other))} == {one, other}
    assert pickle.loads(pickle.dumps(one)).numbers == one.numbers
    told = {"code": "prior.widened", "of": ["x"], "severity": "stop"}
    assert one.to_json_data() == {**told, "in_words": str(one)}
