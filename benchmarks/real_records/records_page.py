"""The page `docs/records_of_others.md`, of `records_of_others.py` and of the chamber ramp's results."""

from __future__ import annotations

import re
from typing import Any

from bayescal._core.formatting import number, with_error
from bayescal._data.unit_conversion import unit_label
from benchmarks.markdown import table
from benchmarks.record import DOCS, read

SPLIT = "alternate blocks"
OTHERS = ("line", "cubic", "cubic + lag", "boosted trees", "NIST's form")
HEAD = """\
# Records of others

Rendered by `python -m benchmarks records_of_others` from `benchmarks/results/`.

Public records of sensors that others have built and measured, calibrated as their owners would: an instrument of one's
own with a constant and a line, a parabola and a cubic as candidates, sizes from the range of the sensor, and nothing
else said. Every second of twenty blocks (on the ramp: of five minutes) is held out and chooses nothing. A method that
bends where it should not, or follows the noise, loses there.

The records are not part of bayescal. Where they come from, and under which licence:

- **[The chamber ramp](thermal_ramp.md)**: an inertial unit at rest, six channels, of the repository
  tofupilot/examples, MIT licence.
- **Load cell, ozone monitor, ultrasonic block, dilatometer, electron microscope**: [NIST's Statistical Reference
  Datasets](https://www.itl.nist.gov/div898/strd/), measured and in the public domain. NIST certifies a form and its
  constants for each.

## Held-out error

Root mean square of the held-out readings about the prediction, in the record's unit. The best of what the owner could
have used without knowing the form is **bold**. *NIST's form* is fitted to the same readings; its owner knew it from
physics. A lag needs time, which only the ramp has. There *bayescal* is of the six channels calibrated as one unit.

"""
FOUND = """\
## What was known, and what was found

"""
TRIADS = """\
## Three axes

Rendered by `python -m benchmarks triads_of_others`. An Xsens MTi in poses and in the moves between them, of
[Kyle-ak/imu_tk](https://github.com/Kyle-ak/imu_tk) (BSD licence), and magnetometers turned by hand, of
[tomisuarez2/MagnetometerCalibration](https://github.com/tomisuarez2/MagnetometerCalibration) (MIT licence).

"""
READ = """\
## How to read it

Against a cubic with a lag on the ramp, bayescal is better on {wins} and worse on {losses}.
{static}

Curves of no known form (`unknown(…)`) are found where no candidate describes the record: they say *that* something
bends, how much and where, and leave a name to who knows the sensor. Between held-out blocks such a curve is wider where
readings are few; a form from physics, where there is one, needs fewer readings and wins: give it as an
[effect of your own](own_effect.md) or an [instrument](own_instrument.md).

*Reliable* is what the command itself says, from the fitted readings alone, by its exit status. Where it says no, that
is the answer that a user gets, and the number beside it is shown for comparison.

On the electron microscope NIST's own form leaves 0.16 that is smooth from one reading to the next: the readings scatter
much less than they depart from the form, so a curve between them predicts better than it. The other way round, on the
dilatometer the form is right and knows what happens between the blocks.
"""


def write(records: dict[str, Any]) -> None:
    """The page."""
    rows, wins, losses, best = [], [], [], []
    ramp = read("thermal_ramp")
    for channel, error in ramp["unit"][SPLIT]["errors"].items():
        known = {name: ramp["recipes"][SPLIT][name][channel] for name in OTHERS[:4]}
        (wins if error < known["cubic + lag"] else losses).append(f"`{channel}`")
        rows.append(_row(f"ramp, {channel} [{_unit_of(channel)}]", {"bayescal": error, **known}))
    for title, found in records.items():
        errors, unit = found["errors"], unit_label(found["unit"])
        rows.append(_row(title + (f" [{unit}]" if unit and unit != "1" else ""), errors))
        blind = {n: e for n, e in errors.items() if n != "NIST's form"}
        if min(blind, key=lambda n: blind[n]) == "bayescal":
            best.append(f"the {title}")
    static = (
        f"Of the five records without time it is the best of the four on {_and(best)}."
        if best
        else "On none of the five records without time is it the best of the four."
    )
    found = [
        [
            title,
            f["known"],
            _found(f),
            _ended(f),
            f"{100 * f['inside']:.0f} %",
        ]
        for title, f in records.items()
    ]
    text = [
        HEAD + table(["record", "bayescal", *OTHERS], rows),
        FOUND
        + table(["record", "known", "found", "reliable", "held-out readings within 2 u"], found),
        *([TRIADS + _triads(triads)] if (triads := read("triads_of_others")) else []),
        READ.format(wins=_and(wins), losses=_and(losses), static=static),
    ]
    (DOCS / "records_of_others.md").write_text("\n".join(text), "utf-8")


def _triads(found: dict[str, Any]) -> str:
    """What is known of the triads, and what was found."""
    force, turns, field = (
        found[name] for name in ("accelerometers", "gyroscopes", "magnetometers")
    )
    offsets = ", ".join(
        f"{with_error(*own)} ({apart:+.1f})"
        for own, apart in zip(force["offsets"], force["from_sheet"], strict=True)
    )
    largest = sorted(turns["g_sensitivity"].items(), key=lambda one: -abs(one[1][0]))[:3]
    of_gravity = ", ".join(f"{name} {with_error(*own)}" for name, own in largest)
    rows = [
        [
            f"accelerometers, {force['poses']} poses",
            "offsets of the factory's sheet: 33123, 33276 and 32360 counts",
            f"{offsets} counts (from the sheet); noise of a pose {number(force['noise_ug'], 2)} µg",
            _ended(force),
        ],
        [
            f"gyroscopes, {turns['readings']} readings of moves and poses",
            "no sensitivity to gravity is stated",
            f"{_names(turns['added'])}, log Bayes factor {turns['log_bayes_factor']:.0f}; the largest three "
            f"[°/s/g]: {of_gravity}",
            _ended(turns),
        ],
        [
            f"magnetometers, {field['fitted']} of {field['corrected']} samples fitted",
            "published calibrations, in its files and in its README: their norms scatter by "
            + " and ".join(f"{100 * one:.1f} %" for one in field["scatter_published"]),
            f"norms of all samples scatter by {100 * field['scatter']:.1f} %",
            _ended(field),
        ],
    ]
    return table(["triad", "known", "found", "reliable"], rows)


def _ended(found: dict[str, Any]) -> str:
    return "yes" if found["ok"] else f"no: {re.split(r'[.:,] ', found['reason'])[0]}"


def _names(added: list[str]) -> str:
    return _and([f"`{name}`" for name in added])


def _found(found: dict[str, Any]) -> str:
    """Effects added, and the numbers of those that have a form."""
    unknown = [f"`{n}`" for n in found["added"] if n not in found["coefficients"]]
    known = [
        f"`{name}` {with_error(*of)}" for name, of in found["coefficients"].items() if not unknown
    ]
    return ", ".join([*known, *unknown])


def _unit_of(channel: str) -> str:
    return "°/s" if channel.startswith("gyro") else "µg"


def _row(title: str, errors: dict[str, float]) -> list[str]:
    blind = [e for n, e in errors.items() if n != "NIST's form"]
    cells = []
    for name in ("bayescal", *OTHERS):
        if name not in errors:
            cells.append("–")
            continue
        said = number(errors[name], 3)
        cells.append(
            f"**{said}**" if name != "NIST's form" and errors[name] == min(blind) else said
        )
    return [title, *cells]


def _and(words: list[str]) -> str:
    if not words:
        return "none"
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
