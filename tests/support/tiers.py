"""Tests in tiers: which cases of a test are slow, and which tests beyond the fast ones have their turn on a day."""

from __future__ import annotations

from collections.abc import Container, Iterable
from datetime import date
from typing import Any
from zlib import crc32

import pytest

DAYS = 14  # in which each test beyond the fast ones has its turn


def slow_but(fast: Container[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases of a test, those that are not among the fast ones marked as slow."""
    return [c if c in fast else pytest.param(c, marks=pytest.mark.slow) for c in cases]


def has_its_turn(test: str, day: date) -> bool:
    """Whether it is the day of a test, named by its node id."""
    return crc32(test.encode()) % DAYS == day.toordinal() % DAYS


def place(file: str, day: date) -> int:
    """What to sort files by: in another order each day, what there was no time for is not always the same."""
    return crc32(f"{day} {file}".encode())
