"""The page *The ordinary test*: hidden effects, effects outside all families, and records without faults."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from benchmarks import pages
from benchmarks.ordinary_test import naming
from benchmarks.pages import Claim, Rows, share
from benchmarks.record import RESULTS, read_lines

CLEAR = 15.0  # nats, from which what is hidden must be said
WORSE = 1.05  # hold-out error over the true model's, up to which it is as good
RIGHT = {"column": "fan_speed", "resonance": "temperature", "step": "jump", "elapsed": "elapsed"}
ABOUT = """
Three to five runs in a chamber, a thermometer on the package, and a body behind it: a die of one time constant, two
stages, a slab with heat diffusion, or electronics that lag beside a sensor that does not. Chamber, package, body and
self-heating are integrated numerically; no formula is shared with the catalogue. In each campaign a random subset of
run offsets, warm-up, a quadratic and the supply voltage is hidden, from hardly detectable to obvious; `mems_gyro` or
`still_sensor` reads the file. *Clear*: the exact log evidence of all true columns exceeds that without the family's by
15. *Coefficients*: of effects in the final model, by the averaged posterior. *A wrong name*: a family in the final
model, or a set, without any true cause; an unknown function or a noise law is not a name.
"""
STRANGE = "Effects outside all families, in the same test: a column, resonance, step, oscillation after power-on."
GOOD = "Records without faults, of six instruments, in chambers that step, ramp and hold."


def lost(row: dict[str, Any], least: float = CLEAR) -> list[str]:
    """Return the hidden families with an oracle above `least` that are neither in the model nor in a set."""
    named_effects = naming.found_families(row["final"], [members for members, _ in row["sets"]])
    return [h for h in row["hidden"] if row["oracle"][h] >= least and h not in named_effects]


def invented(row: dict[str, Any]) -> list[str]:
    """Return the named effects and sets that contain no true cause."""
    return naming.invented(row["final"], [members for members, _ in row["sets"]], row["hidden"])


def whole(name: str) -> Rows:
    """Return the rows of a file that did not end in an error."""
    return [r for r in read_lines(RESULTS / f"{name}.jsonl") if "crash" not in r]


def named(rows: Rows, family: str = "") -> str:
    pairs = [(r, h) for r in rows for h in r["hidden"] if family in ("", h)]
    return share(h not in lost(r) for r, h in pairs if r["oracle"][h] >= CLEAR)


def inside(rows: Rows, repeats: bool) -> str:
    coefficients = (c for r in rows if r["repeats"] == repeats for c in r["coefficients"].values())
    return share(c["inside"] for c in coefficients if c["stated"])


def _held_out(rows: Rows, kind: str) -> str:
    ratios = [r["holdout"][kind]["tool"] / r["holdout"][kind]["true"] for r in rows]
    if not ratios:
        return "–"
    middle, high = np.quantile(ratios, [0.5, 0.9])
    within = sum(ratio <= WORSE for ratio in ratios)
    return f"{middle:.2f}; {within}/{len(ratios)}; {high:.2f}"


def described(row: dict[str, Any]) -> list[str]:
    """Return the descriptions in the final model: unknown dependences, and a noise law that is not white."""
    noise = [] if row["noise_law"] == "white" else [f"{row['noise_law']} noise"]
    return [n for n in row["final"] if naming.family(n) == "description"] + noise


def shut(rows: Rows) -> str:
    return share(r["status"] == 1 for r in rows)


def wrong_name(rows: Rows) -> str:
    return share(map(bool, map(invented, rows)))


def _seconds(rows: Rows) -> str:
    times = [r["seconds"] for r in rows if r["readings"] == 1600]
    return f"{np.median(times):.1f}, at most {max(times):.0f}" if times else "–"


CLAIMS: tuple[Claim, ...] = (
    ("a hidden family, clear: in the model or in a set", named),
    *((f"the same, {family}", partial(named, family=family)) for family in naming.HIDDEN),
    ("a wrong name", wrong_name),
    ("a description in the final model", lambda rows: share(map(bool, map(described, rows)))),
    ("status 1", shut),
    ("coefficients inside their 95 % interval, different profiles", partial(inside, repeats=False)),
    ("the same, one profile repeated", partial(inside, repeats=True)),
    *(
        (
            f"hold-out error over the true model's, {words}: median; within {WORSE:g}; 90 % quantile",
            partial(_held_out, kind=kind),
        )
        for kind, words in (("same", "same kind of profile"), ("other", "another kind"))
    ),
    ("processor time, 1,600 readings, s", _seconds),
)


def strange(rows: Rows) -> Rows:
    """Return the campaigns whose effect outside all families is clear."""
    return [r for r in rows if r["oracle"]["further"] >= CLEAR]


def _called_right(row: dict[str, Any]) -> bool:
    names = [*row["final"], *(n for members, _ in row["sets"] for n in members)]
    return any(RIGHT[row["shape"]] in n for n in names if naming.family(n) == "description")


STRANGE_CLAIMS: tuple[Claim, ...] = (
    (
        "clear: described by an unknown function of the right column",
        lambda rows: share(map(_called_right, strange(rows))),
    ),
    ("clear: a wrong name", lambda rows: wrong_name(strange(rows))),
    ("clear: status 1", lambda rows: shut(strange(rows))),
)
GOOD_CLAIMS: tuple[Claim, ...] = (
    ("status 1", shut),
    *(
        (
            f"a thermometer questioned in a {where}",
            lambda rows, w=key: share(w in r["doubted"] for r in rows),
        )
        for where, key in (("failed check", "reason"), ("flag", "flags"), ("note", "notes"))
    ),
)


def by(rows: Iterable[dict[str, Any]], field: str) -> dict[str, Rows]:
    """Group rows by the value of a field."""
    groups: dict[str, Rows] = {}
    for row in sorted(rows, key=lambda r: r[field]):
        groups.setdefault(row[field], []).append(row)
    return groups


def render() -> pages.Texts:
    """Render the page from the stored results."""
    ordinary, odd, good = map(whole, ("ordinary_test", "no_family", "good_records"))
    days = [row["day"] for row in (*ordinary, *odd, *good)]
    again = "ordinary_test no_family good_records"
    parts = (
        pages.claims_table(by(ordinary, "structure"), CLAIMS),
        STRANGE,
        pages.claims_table(by(odd, "shape"), STRANGE_CLAIMS),
        GOOD,
        pages.claims_table(by(good, "instrument"), GOOD_CLAIMS, "records"),
    )
    return pages.page("ordinary_test", "Simulated chamber tests", again, days, ABOUT, *parts)
