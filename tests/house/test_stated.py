"""Pages that are rendered say what the committed results say."""

from __future__ import annotations

from benchmarks.stated import differing


def test_pages_are_as_the_results_have_them() -> None:
    assert list(differing()) == []
