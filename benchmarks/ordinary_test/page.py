"""The page *The ordinary test*: each goal beside what was measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.ordinary_test import naming
from benchmarks.record import DOCS, RESULTS, cores_of, read_lines

Rows = list[dict[str, Any]]
CLEAR = 15.0  # nats, from which what is hidden must be said
WORSE = 1.05  # hold-out error over the true model's, up to which it is as good
HEAD = """# The ordinary test

Rendered by `python -m benchmarks ordinary_test no_family own_unit good_records` from `benchmarks/results`.

Three to five runs through a chamber, a thermometer on the package, and a body behind it: a die of one time, two
stages, a slab through which heat diffuses, or an electronics that lags beside a sensor that does not. Chamber,
package, body and self-heating are integrated numerically; no formula is shared with the catalogue. In each campaign a
random subset of run offsets, warm-up (two times, or diffusive), a quadratic and the supply's voltage is hidden, from
hardly visible to obvious and within the gyroscope's plausible sizes; one of two instruments, `mems_gyro` or
`still_sensor`, reads the file. *Oracle*: exact log evidence of all true columns less that without the family's own,
white noise of unknown size, each coefficient's prior standard deviation the size at which it was drawn; without the
lag all temperature terms act at the thermometer. *Hold-out*: two further runs of the same kind of profile and two of
another, a constant of each run removed; beside them the true model fitted by least squares. *Coefficients*: those of
effects in the final model, by the averaged posterior; their truth is the settled output as a power series about the
tool's own T0. *Named, and not there*: a family in the final model, or a set, of which nothing is true; what is
unknown, a departure or a noise law is a description and no name. *Status 1*: the gate is shut by the readings
themselves.
"""


def write() -> None:
    """The page, from what was measured so far."""
    named = ("ordinary_test", "no_family", "own_unit", "good_records")
    rows = {name: read_lines(RESULTS / f"{name}.jsonl") for name in named}
    parts = [HEAD]
    for name, chapter in (
        ("ordinary_test", ordinary),
        ("no_family", no_family),
        ("own_unit", own_unit),
        ("good_records", good_records),
    ):
        if rows[name]:
            parts += [chapter(rows[name]), cores_of(rows[name])]
    (DOCS / "ordinary_test.md").write_text("\n".join(parts), "utf-8")


def tables(path: Path) -> str:
    """The tables of the ordinary test from a file of rows, such as those of a part of it."""
    return ordinary(read_lines(path))


def lost(row: dict[str, Any], least: float = CLEAR) -> list[str]:
    """Hidden families of an oracle above `least` that are neither in the model nor in a set."""
    said = naming.said(row["final"], [members for members, _ in row["sets"]])
    return [h for h in row["hidden"] if row["oracle"][h] >= least and h not in said]


def invented(row: dict[str, Any]) -> list[str]:
    """Named effects, and sets, of which nothing is there."""
    return naming.invented(row["final"], [members for members, _ in row["sets"]], row["hidden"])


def described(row: dict[str, Any]) -> list[str]:
    """Descriptions in the final model: unknown functions, departures, a noise law that is not white."""
    noise = [] if row["noise_law"] == "white" else [f"{row['noise_law']} noise"]
    return [n for n in row["final"] if naming.family(n) == "description"] + noise


def ordinary(rows: Rows) -> str:
    """Goals, and where they are missed."""
    crashed, rows = _whole(rows)
    parts = [
        f"## What was hidden\n\n{len(rows)} campaigns; ended in an error: {crashed}.\n",
        table(["", "goal", "measured"], [[n, g, f(rows)] for n, g, f in GOALS]),
        "By what is hidden, of an oracle above 15 nats:\n",
        _by_family(rows),
        "By structure of the body, profile, length and instrument:\n",
        _by_cell(rows),
        "What stands where it should not, and why results are shut:\n",
        _what(rows),
    ]
    return "\n".join(parts)


def _whole(rows: Rows) -> tuple[int, Rows]:
    kept = [r for r in rows if "crash" not in r]
    return len(rows) - len(kept), kept


def _share(flags: Iterable[bool]) -> str:
    found = list(flags)
    return proportion(sum(found), len(found))


def _clear(rows: Rows) -> list[tuple[dict[str, Any], str]]:
    return [(r, h) for r in rows for h in r["hidden"] if r["oracle"][h] >= CLEAR]


def _named(rows: Rows) -> str:
    return _share(h not in lost(r) for r, h in _clear(rows))


def _status(rows: Rows) -> str:
    return _share(r["status"] == 0 for r in rows)


def _inside(rows: Rows) -> str:
    return _share(c["inside"] for r in rows for c in r["coefficients"].values() if c["stated"])


def _ratios(rows: Rows, kind: str) -> np.ndarray:
    return np.array([r["holdout"][kind]["tool"] / r["holdout"][kind]["true"] for r in rows])


def _held(kind: str) -> Callable[[Rows], str]:
    def told(rows: Rows) -> str:
        found = _ratios(rows, kind)
        if not len(found):
            return "–"
        middle, high = np.quantile(found, [0.5, 0.9])
        within = _share((found <= WORSE).tolist())
        return f"{middle:.2f}, nine of ten below {high:.2f}; {within} within {WORSE:g}"

    return told


def _clean(rows: Rows) -> str:
    return _share(not invented(r) for r in rows)


def _plain(rows: Rows) -> str:
    return _share(not described(r) for r in rows)


def _seconds(rows: Rows) -> str:
    found = [r["seconds"] for r in rows if r["readings"] == 1600]
    return f"{np.median(found):.1f} s, at most {max(found):.0f} s" if found else "–"


GOALS: list[tuple[str, str, Callable[[Rows], str]]] = [
    ("a hidden family above 15 nats: in the model or in a set", "≥ 95 %", _named),
    ("status 0", "≥ 90 %", _status),
    ("coefficients inside their 95 % interval", "93–97 %", _inside),
    ("hold-out error over the true model's, same kind of profile", "≤ 1.05", _held("same")),
    ("the same, another kind of profile", "≤ 1.05", _held("other")),
    ("nothing named that is not there", "≥ 98 %", _clean),
    ("no description in the final model", "", _plain),
    ("processor, 1,600 readings: median", "≤ 12 s", _seconds),
]


def _by_family(rows: Rows) -> str:
    body = []
    for name in naming.HIDDEN:
        own = [r for r, h in _clear(rows) if h == name]
        names = Counter(n for r in own for n in r["final"] if naming.family(n) == name)
        alone = _share(any(naming.family(n) == name for n in r["final"]) for r in own)
        said = ", ".join(f"{n} {c}" for n, c in names.most_common(5))
        body.append([name, _share(name not in lost(r) for r in own), alone, said])
    return table(["hidden", "in the model or a set", "in the model", "as"], body)


def _by_cell(rows: Rows) -> str:
    body = []
    for key in ("structure", "repeats", "readings", "instrument"):
        for value in sorted({r[key] for r in rows}, key=str):
            own = [r for r in rows if r[key] == value]
            label = {"repeats": {True: "profile repeats", False: "profiles differ"}}.get(key, {})
            words = label.get(value, f"{value:,} readings" if key == "readings" else value)
            body.append([words, len(own), *(f(own) for _, _, f in GOALS[:3]), _clean(own)])
            body[-1] += [f"{np.median(_ratios(own, k)):.2f}" for k in ("same", "other")]
    head = ["", "campaigns", "named", "status 0", "coefficients", "nothing invented"]
    return table([*head, "hold-out", "other profile"], body)


def _what(rows: Rows) -> str:
    found = {
        "lost": Counter(h for r in rows for h in lost(r)),
        "named, and not there": Counter(n for r in rows for n in invented(r)),
        "description": Counter(n for r in rows for n in described(r)),
        "shut by": Counter(_begins(r["reason"]) for r in rows if r["status"]),
        "coefficient outside": Counter(
            what
            for r in rows
            for what, c in r["coefficients"].items()
            if c["stated"] and not c["inside"]
        ),
    }
    body = [[kind, what, count] for kind, c in found.items() for what, count in c.most_common(8)]
    return table(["", "what", "campaigns"], body)


def _begins(reason: str) -> str:
    """The first words of a reason, by which it is known."""
    return " ".join(reason.replace("|", "/").split()[:12])


def no_family(rows: Rows) -> str:
    """What no family describes."""
    crashed, rows = _whole(rows)
    body = []
    for shape in sorted({r["shape"] for r in rows}):
        own = [r for r in rows if r["shape"] == shape and r["oracle"]["further"] >= CLEAR]
        own_words = [shape, len(own), _share(_called_right(r) for r in own)]
        body.append([*own_words, _share(bool(described(r)) for r in own)])
        body[-1] += [_share(bool(invented(r)) for r in own), _status(own)]
    every = [r for r in rows if r["oracle"]["further"] >= CLEAR]
    wrong = Counter(n for r in every for n in invented(r))
    words = ", ".join(f"{n} {c}" for n, c in wrong.most_common(8))
    head = ["", "campaigns", "unknown of the right thing", "any description"]
    return (
        f"## What no family describes\n\nOracle above {CLEAR:g} nats; {len(rows)} campaigns in all, ended in an "
        f"error: {crashed}. A wrong name in {_share(bool(invented(r)) for r in every)} (goal ≤ 2 %): "
        f"{words or 'none'}.\n\n" + table([*head, "a wrong name", "status 0"], body)
    )


# A part of a description's name by which what is there is called what it is.
RIGHT = {"column": "fan_speed", "resonance": "temperature", "step": "jump", "elapsed": "elapsed"}


def _called_right(row: dict[str, Any]) -> bool:
    names = [*row["final"], *(n for members, _ in row["sets"] for n in members)]
    return any(RIGHT[row["shape"]] in n for n in names if naming.family(n) == "description")


def own_unit(rows: Rows) -> str:
    """The gate with hold-out data."""
    crashed, rows = _whole(rows)
    right = [r for r in rows if r["status"] == 0 and not lost(r) and not invented(r)]
    body = []
    for kind, words, goal in (
        ("same", "the same unit, the same kind of profile", "≤ 3 %"),
        ("other", "the same unit, another profile", "≤ 3 %"),
        ("unit", "another unit", "≥ 95 %"),
    ):
        shut = [[not r[f"held_{kind}"]["open"] for r in some] for some in (right, rows)]
        body.append([words, goal, *map(_share, shut)])
    return (
        f"## Hold-out data\n\nRun offsets of 0.1 to 1 times the noise; {len(rows)} campaigns, ended in an error: "
        f"{crashed}. *Right*: status 0 without hold-out data, nothing lost, nothing invented.\n\n"
        + table(["hold-out data of", "gate shut: goal", "of right results", "of all"], body)
    )


def good_records(rows: Rows) -> str:
    """Records with nothing wrong in them."""
    crashed, rows = _whole(rows)
    body = []
    for name in [*sorted({r["instrument"] for r in rows}), ""]:
        own = [r for r in rows if name in ("", r["instrument"])]
        shut = _share(r["status"] == 1 for r in own)
        doubted = [_share(w in r["doubted"] for r in own) for w in ("reason", "flags", "notes")]
        body.append([name or "all", len(own), shut, *doubted])
    words = Counter(_begins(r["reason"]) for r in rows if r["status"])
    why = table(["shut by", "records"], words.most_common(12)) if words else ""
    head = ["instrument", "records", "status 1 (≤ 2 %)", "thermometer doubted: shut (≤ 1 %)"]
    return (
        f"## Good records\n\nEnded in an error: {crashed}.\n\n"
        + table([*head, "in a flag", "in a note"], body)
        + f"\n{why}"
    )
