"""Each instrument in turn, for the checks of the contract."""

from __future__ import annotations

from functools import cache

import pytest

from bayescal_models import INSTRUMENTS
from tests.support.contract_cases import Case


@cache
def case_of(name: str) -> Case:
    return Case(name)


@pytest.fixture(scope="module", params=INSTRUMENTS)
def case(request) -> Case:
    return case_of(request.param)
