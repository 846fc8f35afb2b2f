"""Columns that no instrument asked for: kept if sound, because a user's own effect may need them.

They are never a reason to refuse a file: what cannot be kept is left out, and a flag says why.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayescal._core.errors import InputError
from bayescal._readings import units
from bayescal._readings.column import MAY_BE_EMPTY, TAKEN, Admitted, Column
from bayescal._readings.column_matching import Wishes, unit_of
from bayescal._readings.raw_table import Cells, Header, Table


def extra_columns(
    table: Table,
    expected: Mapping[str, Column],
    places: Mapping[str, int],
    wishes: Wishes,
    result: Admitted,
) -> dict[str, str]:
    """Name → unit of columns beyond the instrument's; those without one are flagged."""
    kept: dict[str, str] = {}
    without: list[str] = []
    for name in (n for n in places if n not in expected):
        header = table.headers[places[name]]
        unit = unit_of(header, name, wishes)
        if unit is None:
            without.append(header.raw)
        elif name in TAKEN:
            result.flags.append(
                f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken"
            )
        else:
            try:
                units.check_unit(unit)
            except InputError:
                result.flags.append(
                    f"{table.file}: column {header.raw!r} ignored: [{unit}] is no unit known here"
                )
            else:
                kept[name] = unit
    without += [
        f"column {i + 1}, without a name" for i, h in enumerate(table.headers) if not h.name
    ]
    if without:
        result.flags.append(
            f"{table.file}: ignored, because they have no unit: {', '.join(without)} (to keep one, "
            "write 'name [unit]' or give units=)"
        )
    return kept


def keep(
    table: Table,
    header: Header,
    name: str,
    unit: str,
    local_gravity: float,
    cells: Cells,
    result: Admitted,
) -> None:
    """An extra column in its base unit, if every cell is a number."""
    base = units.base_unit(unit)
    values = units.convert(cells.values, unit, base, local_gravity=local_gravity)
    wrong = np.flatnonzero(~np.isfinite(values))
    if name == MAY_BE_EMPTY:
        wrong = np.flatnonzero(np.isinf(values))
    if cells.bad or wrong.size:
        index = cells.bad[0] if cells.bad else int(wrong[0])
        seen = f"reads {cells.bad[1]!r}" if cells.bad else shown(float(cells.values[index]))
        result.flags.append(
            f"{table.file}: column {header.raw!r} ignored: {table.place(index)} {seen}"
        )
        return
    if units.needs_gravity(unit, base):
        result.flags.append(
            f"{table.file}: column {header.raw!r} turned into local g by {local_gravity:g} m/s²"
        )
    result.values[name], result.units[name] = values, base


def shown(value: float) -> str:
    """What a number that is none reads."""
    return "is empty or NaN" if np.isnan(value) else f"reads {value:g}"
