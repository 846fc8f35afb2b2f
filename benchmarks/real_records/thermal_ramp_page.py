"""The page `docs/thermal_ramp.md`, rendered from the results of `thermal_ramp.py` beside it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from bayescal._data.unit_conversion import pretty
from benchmarks.markdown import table
from benchmarks.real_records.ramp_recipes import RECIPES
from benchmarks.record import DOCS

CHANNELS = ("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z")
SPLITS = ("last fifth", "alternate blocks")
ERRORS = ("fitted", "held_out", "held_out_in_record")

TITLE = """\
# A real record: one inertial unit on a temperature ramp

Rendered by `python -m benchmarks thermal_ramp` from `benchmarks/results/thermal_ramp.json`.
"""

HEAD = """\
One MEMS inertial unit stood still in a chamber for 71 minutes while its temperature went from 52 to
−18, to 74 and to 36 °C (8,400 readings; public record of the repository tofupilot/examples, MIT
licence). Whatever moves in its six channels is the sensor's. Each channel is calibrated by itself
with the instrument `still_sensor` and nothing else said: one command,

    bayescal calibrate fitted.csv --holdout held_out.csv --instrument still_sensor \\
        --columns output=acc_x --columns time=t_s \\
        --unit acc_x=m/s^2 --unit t_s=s --unit temperature=degC

twice: once with the last fifth of the record held out (a cooling, after 57 minutes), and once with
every second block of five minutes held out. Held-out readings are read after the last step and
choose nothing. Accelerations are in µg of 9.80665 m/s². The record's owner labels the rates deg/s;
they are read as rad/s here, which suits their bias and noise better: slopes and errors of the three
gyro channels scale with that choice, what is found does not.

The record has spikes (its first row, and one row of acc_z). They are in the files that are read;
`calibrate` sets them aside and says so.

*Error* is the root mean square of the readings about the model's expectation, correlated noise not
subtracted, first for the baseline (a line in temperature), then for the last model. *Floor*: the
white noise that no smooth model could remove. *Evidence*: natural logarithm gained over the
baseline. *In the record*: the held-out readings predicted with the temperature's whole past, which
a lag or a rate needs, rather than from a file that begins in the middle of a ramp. *With the noise's state*: what
`predict` gives for readings that go on with the record, and of how many the 95 % interval holds the reading.

Where `unknown(time)` is added, no named effect describes a slow change of the record: a smooth curve in time
does. Within the record (alternate blocks) it predicts well; beyond it (last fifth) such a curve says nothing,
and the error may rise. It is a description, and no physics.
"""


REFERENCE = "cubic + lag"
BESIDE = """\
## Beside what is customary

The error of the held-out readings, rates in °/s and accelerations in µg, all predicted with the temperature's whole
past; the last column is the geometric mean over the six channels, in parts of the cubic with a lag. Recipes are fitted
by least squares to the same readings, spikes left out. They say nothing of their own uncertainty, nor whether a term is
needed. A recipe that was chosen for this record after the fact has an advantage that a calibration has not.

""" + "".join(f"- *{name}*: {what}.\n" for name, what in RECIPES.items())


def write(results: dict[str, Any]) -> Path:
    """Write the page.

    Args:
        results: of `thermal_ramp.py`: channels, name → split → summary; what is customary, split → recipe → channel.
    """
    channels = results["channels"]
    parts = [TITLE, *_incomplete(channels), HEAD]
    if "recipes" in results:
        parts += [
            BESIDE,
            *results.get("remarks", ()),
            *(_beside(results, split) for split in SPLITS),
            *(part for split in SPLITS for part in _of_unit(results, split)),
        ]
    for split in SPLITS:
        parts += [f"## {split.capitalize()} held out\n", _table(channels, split)]
    parts += [_channel(name, splits) for name, splits in channels.items()]
    path = DOCS / "thermal_ramp.md"
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _beside(results: dict[str, Any], split: str) -> str:
    """Held-out errors of bayescal and of each recipe, and their geometric mean over the best recipe's."""
    rows = {"bayescal, each channel alone": results["alone"].get(split, {})}
    rows |= {
        "the same, going on with the noise's state": results.get("going_on", {}).get(split, {})
    }
    unit = results.get("unit", {}).get(split, {})
    rows |= {"bayescal, as one unit": unit.get("errors", {})}
    rows |= {"the same, with correlated noise predicted inside the record": unit.get("inside", {})}
    rows |= results["recipes"][split]
    against = results["recipes"][split][REFERENCE]
    lines = []
    for name, found in rows.items():
        ratios = [found[c] / against[c] for c in CHANNELS if c in found]
        whole = len(ratios) == len(CHANNELS)
        mean = f"{math.exp(sum(map(math.log, ratios)) / len(ratios)):.2f}" if whole else "–"
        cells = (f"{found[c]:.3g}" if c in found else "–" for c in CHANNELS)
        lines.append([name, *cells, mean])
    head = ["held-out error", *CHANNELS, f"over {REFERENCE}"]
    return f"**{split.capitalize()} held out**\n\n" + table(head, lines)


def _of_unit(results: dict[str, Any], split: str) -> list[str]:
    """What the six channels together show of their body, and which effects each has."""
    unit = results.get("unit", {}).get(split)
    if unit is None:
        return []
    effects = list(dict.fromkeys(name for own in unit["added"].values() for name in own))
    rows = [
        [f"`{e}`", *("yes" if e in unit["added"][c] else "–" for c in CHANNELS)] for e in effects
    ]
    rows.append(["trusted", *("yes" if unit["gate"][c][0] else "no" for c in CHANNELS)])
    shared = [
        f"`{name}`: probability {probability:.2f}, {middle:.3g} ({low:.3g} to {high:.3g})"
        for name, probability, middle, low, high, _ in unit["shared"]
        if probability > 0.5
    ]
    head = [f"{split} held out, {unit['cpu_seconds']:.0f} CPU s", *CHANNELS]
    return [table(head, rows), f"Shared by the unit: {'; '.join(shared) or 'nothing found'}.\n"]


def _incomplete(channels: dict[str, Any]) -> list[str]:
    """What a reader must know where not every channel has been measured, or not alike."""
    missing = [name for name in CHANNELS if name not in channels]
    remarks = [
        s["remark"] for splits in channels.values() for s in splits.values() if "remark" in s
    ]
    said = [f"Not measured yet: {', '.join(missing)}."] if missing else []
    return [f"**Incomplete.** {' '.join([*said, *remarks])}\n"] if said or remarks else []


def _table(channels: dict[str, Any], split: str) -> str:
    head = [
        *("channel", "added, in order", "noise", "fitted error", "held-out error"),
        *("in the record", "with the noise's state", "in 95 % intervals", "floor", "evidence"),
        *("trusted", "time (of the processor)"),
    ]
    rows = []
    for name, splits in channels.items():
        found = splits[split]
        first, last = found["steps"][0], found["steps"][-1]
        rows.append(
            [
                f"{name} [{pretty(found['unit'])}]",
                ", ".join(s["added"] for s in found["steps"] if s["added"]) or "nothing",
                last["noise"].replace("_", " "),
                *(_fall(first[key], last[key]) for key in ERRORS),
                f"{found['going_on']:.4g}" if "going_on" in found else "–",
                f"{100 * found['covered']:.0f} %" if "covered" in found else "–",
                f"{last['noise_floor']:.3g}",
                _gain(first["log_evidence"], last["log_evidence"]),
                "yes" if found["ok"] else "no",
                f"{found['seconds']:.0f} s ({found['cpu_seconds']:.0f} s)",
            ]
        )
    return table(head, rows)


def _channel(name: str, splits: dict[str, Any]) -> str:
    lines = [
        f"## {name}\n",
        f"![{name}: where the first model fails, what is missing, the error]"
        f"(thermal_ramp_{name}.png)\n",
    ]
    for split, found in splits.items():
        unit = pretty(found["unit"])
        head = ["step", "noise", f"fitted error [{unit}]", "held out", "in the record"]
        lines += [
            f"**{split.capitalize()} held out.** Gate: {found['gate']}",
            *(f"Note: {flag}." for flag in found["flags"]),
            _raised(found["raised_held_out_error"]) + "\n",
            table([*head, "log evidence", "P(complete)"], map(_step, found["steps"])),
        ]
    return "\n".join(lines)


def _step(step: dict[str, Any]) -> list[str]:
    evidence, nothing = step["log_evidence"], step["nothing_missing"]
    return [
        step["step"],
        step["noise"].replace("_", " "),
        *(f"{step[key]:.4g}" for key in ERRORS),
        "–" if evidence is None else f"{evidence:.1f}",
        "–" if nothing is None else f"{nothing:.2f}",
    ]


def _raised(steps: list[str]) -> str:
    if not steps:
        return "No step raised the held-out error."
    return f"Raised the held-out error by more than 1 %: {', '.join(steps)}."


def _fall(first: float, last: float) -> str:
    return f"{first:.4g} → {last:.4g} ({100 * (last / first - 1):+.0f} %)"


def _gain(first: float | None, last: float | None) -> str:
    return "–" if first is None or last is None else f"{last - first:+.0f}"
