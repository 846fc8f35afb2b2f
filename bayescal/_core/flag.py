"""A sentence about readings, with a code and the names that it is of: code asks these and never reads the words."""

from __future__ import annotations


class Flag(str):
    """An input warning that something asks for; those that are for people alone are plain text.

    Attributes:
        code: what is said, such as "column.ignored"; empty in plain text.
        of: names of the columns that it is of.
    """

    code: str
    of: tuple[str, ...]

    def __new__(cls, words: str, code: str = "", *of: str) -> Flag:
        made = super().__new__(cls, words)
        made.code, made.of = code, of
        return made


def code_of(flag: str) -> str:
    """What a flag says, as a code; empty where it has none."""
    return flag.code if isinstance(flag, Flag) else ""
