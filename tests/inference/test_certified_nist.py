"""Regression data certified by NIST are met: 8 digits of parameters, 6 of standard deviations."""

from __future__ import annotations

import pytest

from tests.support.inside import nist_strd
from tests.support.tiers import slow_but

PARAMETERS, DEVIATIONS = 8.0, 6.0  # digits
# The hard ones; the others are slow only by their number.
FAST = ("MGH10", "MGH17", "Bennett5", "BoxBOD", "filip")
LINEAR, NONLINEAR = (nist_strd.load_certificates(kind) for kind in ("linear", "nonlinear"))


@pytest.mark.parametrize("name", slow_but(FAST, (*LINEAR, *NONLINEAR)))
def test_certified_values_are_reproduced_from_every_start(name) -> None:
    found = nist_strd.fit_data_set(name)
    assert len(found) == (1 if name in LINEAR else 2)
    for one in found:
        parameters, sd, residual_sd = map(nist_strd.count_digits, one.errors)
        assert parameters >= PARAMETERS, one
        if name not in nist_strd.NOISELESS_DATA_SETS:
            assert one.converged and min(sd, residual_sd) >= DEVIATIONS, one


def test_all_nist_data_sets_are_present() -> None:
    assert (len(LINEAR), len(NONLINEAR)) == (11, 27)
