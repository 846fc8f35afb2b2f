"""Two steps side by side, as text: how they compare, and each coefficient of the one beside the other's."""

from __future__ import annotations

from bayescal._calibration.compare import compare
from bayescal._calibration.summary import summary
from bayescal._core.formatting import table, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._workbench.state import State


def side_by_side(one: State, other: State) -> str:
    """`bc.compare` of two states, then their coefficients, noise and shapes with standard uncertainties.

    Raises:
        InputError: they were fitted to other readings.
    """
    names = [f"{s.number} {s.title}" for s in (one, other)]
    compared = compare(dict(zip(names, (one.calibration, other.calibration), strict=True)))
    told = [_values(one), _values(other)]
    rows = [
        [name, *(t.get(name, ("–", ""))[0] for t in told), (told[0] | told[1])[name][1]]
        for name in dict.fromkeys([*told[0], *told[1]])
    ]
    return f"{compared}\n\n{table(['', *names, 'unit'], rows)}"


def _values(state: State) -> dict[str, tuple[str, str]]:
    """Value with its standard uncertainty, and unit, by name."""
    coefficients, others = summary(state.calibration)
    return {
        t["name"]: (with_error(t["mean"], t["sd"]), unit_label(t["unit"]))
        for t in (*coefficients, *others)
    }
