"""Draws up faults.md: what each missing effect looks like, how large it must be, what it is taken for.

    python docs/faults.py [INSTRUMENT …]

For every instrument and candidate: the standard campaign is simulated with that effect alone in it, at three times the
smallest size that would be found, and the baseline is fitted to it.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label

HERE = Path(__file__).parent
KEPT = HERE.parent / "benchmarks" / "results" / "faults.json"
INSTRUMENTS = (
    "mems_gyro",
    "ng_accelerometer",
    "quartz_beam_accelerometer",
    "differential_pair",
    "inclinometer",
    "still_sensor",
)
TIMES = 3.0  # the smallest size that would be found
SEED = 41
METHOD = bc.LeastSquares(draws=200)


def faults(name: str) -> list[dict[str, Any]]:
    """One entry for each candidate of an instrument."""
    plain = importlib.import_module(f"bayescal_models.{name}").INSTRUMENT
    readings = plain.simulate(seed=SEED)
    instrument = plain.for_readings(readings)
    empty = bc.discover(bc.fit(instrument.baseline(), readings, METHOD, strict=False))
    entries = []
    for seen in empty.candidates:
        if seen.effect.startswith("unknown("):
            continue
        effect = instrument.effect(seen.effect)
        entry: dict[str, Any] = {
            "effect": seen.effect,
            "unit": effect.coefficients[0].unit,
            "plausible": effect.coefficients[0].size,
            "needed": seen.minimum_detectable,
            "remark": seen.reason,
        }
        if seen.kind not in ("not testable", "not visible"):
            entry |= looks(plain, seen.effect, TIMES * (seen.minimum_detectable or 0.0))
        entries.append(entry)
        print(name, entry, flush=True)
    return entries


def looks(instrument: bc.Instrument, effect: str, size: float) -> dict[str, Any]:
    """What the baseline's residuals show of one hidden effect, and what it is taken for."""
    assert instrument.simulate is not None
    readings = instrument.simulate({effect: size}, seed=SEED)
    model = instrument.for_readings(readings).baseline()
    calibration = bc.fit(model, readings, METHOD, strict=False)
    checked = bc.check(calibration)
    found = bc.discover(calibration)
    own = next(c for c in found.candidates if c.effect == effect)
    named = [n for n in own.indistinguishable_from if not n.startswith("unknown(")]
    return {
        "size": size,
        "leans_on": [
            [e.covariate, e.log_bayes_factor] for e in checked.entries[:2] if e.log_bayes_factor > 3
        ],
        "autocorrelation": checked.autocorrelation[0],
        "rms": [checked.rms, checked.unit],
        "first": found.candidates[0].effect,
        "confused_with": named,
    }


def page(all_: dict[str, list[dict[str, Any]]]) -> str:
    """The gallery in Markdown."""
    parts = [
        "# Signatures of missing effects\n",
        "Drawn up by `python docs/faults.py`. Each effect alone "
        "was hidden in its instrument's standard campaign, at "
        "three times the size *needed* (the smallest that is found with 80 % power), and the baseline fitted. "
        "*Residuals depend on*: covariates with the strongest evidence of structure (natural logarithm). *Taken for*: "
        "effects that this campaign cannot tell from it; `bayescal discover --next-experiment` says which campaign "
        "could.\n",
    ]
    for name, entries in all_.items():
        parts += [
            f"## {name}\n",
            "| effect | plausible | needed | residuals depend on | neighbours | taken for |",
            "|---|---|---|---|---|---|",
            *(_row(entry) for entry in entries if "leans_on" in entry),
            "",
        ]
        remarks = dict.fromkeys(entry["remark"] for entry in entries if "leans_on" not in entry)
        for remark in remarks:
            alike = ", ".join(_with_size(e) for e in entries if e["remark"] == remark)
            parts += [f"{alike}: {remark}.", ""]
    return "\n".join(parts)


def _row(entry: dict[str, Any]) -> str:
    leans = ", ".join(f"{a} ({f:.0f})" for a, f in entry["leans_on"]) or "nothing clearly"
    confused = ", ".join(f"`{n}`" for n in entry["confused_with"]) or "–"
    cells = [f"`{entry['effect']}`", _size(entry, "plausible"), _size(entry, "needed")]
    return "| " + " | ".join([*cells, leans, f"{entry['autocorrelation']:.2f}", confused]) + " |"


def _with_size(entry: dict[str, Any]) -> str:
    """The effect that has no row, and the size that it would need."""
    needed = f" ({_size(entry, 'needed')} needed)" if entry["needed"] is not None else ""
    return f"`{entry['effect']}`{needed}"


def _size(entry: dict[str, Any], which: str) -> str:
    return f"{number(entry[which], 2)} {unit_label(entry['unit'])}"


def main(names: list[str]) -> None:
    """Measure the instruments named, keep the others' entries, write the page."""
    kept = json.loads(KEPT.read_text("utf-8")) if KEPT.is_file() else {}
    for name in names or INSTRUMENTS:
        kept[name] = faults(name)
        KEPT.write_text(json.dumps(kept, indent=1), "utf-8")
        ordered = {n: kept[n] for n in INSTRUMENTS if n in kept}
        (HERE / "faults.md").write_text(page(ordered), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
