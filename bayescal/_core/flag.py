"""A sentence about readings, with a code and the names that it is of: code asks these and never reads the words."""

from __future__ import annotations

from typing import Self


class Flag(str):
    """Words with a `code`, such as "column.ignored", and the names that they are `of`; plain text for people alone."""

    code: str
    of: tuple[str, ...]

    def __new__(cls, words: str, code: str = "", *of: str) -> Self:
        made = super().__new__(cls, words)
        made.code, made.of = code, of
        return made
