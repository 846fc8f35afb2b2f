"""Flags: sentences about readings, each with a code and the names concerned, so that programs need not parse it."""

from __future__ import annotations

from typing import Self

from bayescal._core.renamed import renamed


@renamed(of="subjects", data="to_json_data")
class Flag(str):
    """Text with a `code`, such as "column.ignored" ("" for none), and `subjects`, the names that it concerns."""

    code: str
    subjects: tuple[str, ...]

    def __new__(cls, text: str, code: str = "", *subjects: str) -> Self:
        flag = super().__new__(cls, text)
        flag.code, flag.subjects = code, subjects
        return flag
