"""A sentence about readings, with a code and the names concerned: programs use these and never parse the words."""

from __future__ import annotations

from typing import Self

from bayescal._core.renamed import renamed


@renamed(of="subjects")
class Flag(str):
    """Words with a `code`, such as "column.ignored", and the names of its `subjects`; plain text for people alone."""

    code: str
    subjects: tuple[str, ...]

    def __new__(cls, words: str, code: str = "", *of: str) -> Self:
        flag = super().__new__(cls, words)
        flag.code, flag.subjects = code, of
        return flag
