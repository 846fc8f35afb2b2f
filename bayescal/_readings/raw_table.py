"""A file as it stands: columns by the names and units of its header, nothing understood yet.

Every format ends here, so that what follows (which column is which, what is refused) is one code.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bayescal._core.errors import InputError

FORMATS = (".csv", ".parquet", ".nc")
_WITH_UNIT = re.compile(r"(.*?)\s*\[([^\[\]]*)\]", re.DOTALL)


def bytes_text(size: float) -> str:
    """A number of bytes for people: 180 bytes, 2.1 GB."""
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size:,.0f} bytes"


@dataclass(frozen=True)
class Header:
    """A column as the file names it: `raw` is all of it, name and unit its parts."""

    raw: str
    name: str
    unit: str | None

    @classmethod
    def parse(cls, raw: str, unit: str | None = None) -> Header:
        """Split `name [unit]`; a unit given beside the name counts where the name carries none."""
        raw = raw.strip()
        match = _WITH_UNIT.fullmatch(raw)
        return cls(raw, match[1], match[2].strip()) if match else cls(raw, raw, unit)


@dataclass(frozen=True)
class Cells:
    """One column's content.

    Attributes:
        values: float64, NaN where empty; or text, stripped, "" where empty.
        bad: index and text of the first cell that should be a number and is not.
    """

    values: np.ndarray
    bad: tuple[int, str] | None = None


@dataclass(frozen=True)
class Table:
    """An opened file.

    Attributes:
        file: name for messages.
        headers: its columns, in order.
        rows: number of readings.
        sha256: of the bytes; "" for arrays.
        load: position of a wanted column → whether it is a number, to its cells.
        place: index of a reading → where it stands, "row 12".
        notes: what was done to make a table of it, each a sentence.
    """

    file: str
    headers: tuple[Header, ...]
    rows: int
    sha256: str
    load: Callable[[Mapping[int, bool]], dict[int, Cells]]
    place: Callable[[int], str]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what no format may hold.

        Raises:
            InputError: no readings, or one name for two columns.
        """
        if self.rows < 1:
            raise InputError(
                f"{self.file!r} holds no readings: give a file with at least one row of numbers"
            )
        names = [header.name for header in self.headers if header.name]
        for name in names:
            if names.count(name) > 1:
                raise InputError(
                    f"{self.file!r} has {names.count(name)} columns called {name!r}: which one is "
                    "meant cannot be told. Rename or remove all but one"
                )


def load_whole(table: Table, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    """The wanted columns, each as long as the file says it is.

    Raises:
        InputError: the file contradicts itself, or changed since it was opened.
    """
    found = table.load(wanted)
    for position, cells in found.items():
        if len(cells.values) != table.rows:
            raise InputError(
                f"{table.file!r} says that it holds {table.rows} rows, column "
                f"{table.headers[position].raw!r} has {len(cells.values)}: it is damaged, or "
                "changed while it was read. Export it again"
            )
    return found


def numbers_of(texts: Sequence[str]) -> Cells:
    """Text as numbers: empty and "nan" are NaN, the first that is no number is named."""
    together = "".join(texts)
    if (
        together.isascii() and "_" not in together
    ):  # else Python takes for a number what nobody writes as one
        with suppress(ValueError):
            return Cells(np.fromiter(map(float, texts), np.float64, len(texts)))
    values = np.fromiter(map(_number, texts), np.float64, len(texts))
    for index in np.flatnonzero(np.isnan(values)).tolist():
        seen = texts[index].strip()
        if seen.lower() not in ("", "nan"):
            return Cells(values, (index, seen))
    return Cells(values)


def _number(text: str) -> float:
    """A number as people write it, NaN if the text is none."""
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan


def cells_of(values: object, number: bool) -> Cells:
    """An array or a list as the cells of one column.

    Args:
        values: one entry per reading: numbers, text, or both.
        number: whether the column is one of numbers.
    """
    import pandas as pd  # half a second that a CSV file does without

    array = np.asarray(values)
    if array.dtype.kind in "OU" or isinstance(array.dtype, np.dtypes.StringDType):
        if not number and pd.api.types.infer_dtype(array, skipna=True) == "string":
            codes, levels = pd.factorize(array.astype(object))  # labels repeat: each is read once
            texts = np.array(
                [*(_text(v, pd.NA) for v in levels), ""], dtype=object
            )  # the last for −1, missing
            return Cells(texts[codes])
        texts = [_text(value, pd.NA) for value in array.tolist()]
        return numbers_of(texts) if number else Cells(np.array(texts, dtype=object))
    if not number:
        return Cells(np.array([_text(value, pd.NA) for value in array.tolist()], dtype=object))
    if array.dtype.kind in "iuf":
        return Cells(array.astype(np.float64))
    return Cells(np.full(len(array), np.nan), (0, str(array[0])) if len(array) else None)


def equally_long(columns: Mapping[str, object]) -> list[np.ndarray]:
    """The columns as vectors; a single value counts for every reading.

    Raises:
        InputError: lengths differ, or a column is no vector.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {len(array) for array in arrays.values() if array.ndim == 1}
    if len(lengths) > 1 or any(array.ndim > 1 for array in arrays.values()):
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise InputError(f"columns must be vectors of one length, these are: {shapes}")
    rows = lengths.pop() if lengths else 1
    return [np.broadcast_to(array, (rows,)) for array in arrays.values()]


def _text(value: object, missing: object) -> str:
    """A cell as a label: whole numbers without a point, nothing for what is `missing`."""
    if value is None or value is missing or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return str(value).strip()
