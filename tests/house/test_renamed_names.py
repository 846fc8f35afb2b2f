"""Public names that were renamed: the old one still leads to the new one, and says so."""

from __future__ import annotations

import pytest

import bayescal as bc

RENAMED = vars(bc)["_RENAMED"]


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_name_warns_and_leads_to_the_new_one(old: str) -> None:
    new = RENAMED[old]
    with pytest.warns(DeprecationWarning, match=f"bayescal.{old} is called bayescal.{new} now"):
        found = getattr(bc, old)
    assert found is getattr(bc, new)
    assert old not in bc.__all__
    assert new in bc.__all__


def test_a_name_that_never_was_is_refused() -> None:
    with pytest.raises(AttributeError, match="Trial"):
        vars(bc)["__getattr__"]("Trial")


def test_the_old_name_of_a_groups_standard_deviation_warns_and_leads_to_the_new_one() -> None:
    prior = bc.HalfNormal(1.0)
    with pytest.warns(DeprecationWarning, match="group_sd"):
        old = bc.Coefficient("deg/s", per="run", spread=prior)  # pyright: ignore[reportCallIssue]
    assert old == bc.Coefficient("deg/s", per="run", group_sd=prior)
