"""Table of the physical family of each of the library's effect names, and comparisons by family."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

# Parts of a name by family; the first family that has one of them counts.
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "line": (
        ".freed",
    ),  # the instrument's own slope, its stated size set aside: it is always there
    "supply": ("supply",),  # a column that only it can stand for: unknown(supply) names it too
    "warm-up": ("warm_up",),
    "lag": ("thermal_lag", "body", "rate", "die_temperature", "_x_lag"),
    "curve": ("_quadratic", "_cubic", "_quartic", "curve"),
    "run": (".run",),
    "hysteresis": ("hysteresis",),
    "drift": ("drift",),
    "step": ("step",),
}
DESCRIPTION = ("unknown(", "departure(")
HIDDEN = ("lag", "run", "warm-up", "curve", "supply")  # what the ordinary test hides


def family(name: str) -> str:
    """Return an effect's family; "description" of an unnamed dependence."""
    if name.startswith(DESCRIPTION) and "supply" not in name:
        return "description"
    return next((f for f, parts in FAMILIES.items() if any(p in name for p in parts)), name)


def found_families(names: Iterable[str], sets: Iterable[Sequence[str]]) -> set[str]:
    """Return the families in the model or in a set."""
    return {family(n) for n in (*names, *(n for members in sets for n in members))}


def invented(
    names: Collection[str], sets: Sequence[Sequence[str]], true: Collection[str]
) -> list[str]:
    """Return effects and sets that contain no true cause; descriptions do not count."""

    allowed = {*true, "line"}

    def right(members: Iterable[str]) -> bool:
        return any(family(n) in allowed for n in members)

    excused = {n for members in sets if right(members) for n in members}
    false = [n for n in names if n not in excused and family(n) not in {*allowed, "description"}]
    for members in sets:
        named = [n for n in members if family(n) != "description"]
        if named and not right(members) and not set(named) & set(false):
            false.append(" or ".join(members))
    return false
