"""Make docs/gallery.md with its pictures, from simulated campaigns: python docs/gallery.py."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

import bayescal as bc
from bayescal_models import mems_gyro

FOLDER = Path(__file__).parent
PICTURES = FOLDER / "gallery"
HIDDEN = {"bias.thermal_lag": 0.05}  # °/s/°C
SEED, SEED_KEPT_APART = 1, 2


class Entry(NamedTuple):
    """One picture: its name, the code that draws it, what to see in it, and how it is drawn."""

    name: str
    code: str
    see: str
    draw: Callable[[], Figure]


def campaign() -> bc.SearchPath:
    readings = mems_gyro.simulate(HIDDEN, seed=SEED)
    kept_apart = mems_gyro.simulate(HIDDEN, seed=SEED_KEPT_APART)
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, holdout=kept_apart)


def entries(trail: bc.SearchPath) -> list[Entry]:
    """What the first model misses, and that the last one does not."""
    first, last = trail.steps[0], trail.final
    assert first.discovery is not None
    found = first.discovery
    return [
        Entry(
            "residuals_before",
            "bc.plot.residuals(trail.steps[0].calibration)",
            "Where the first model fails: residuals against everything that was recorded, runs by colour, the noise in "
            "grey, the worst region in red.",
            lambda: bc.plot.residuals(first.calibration, first.check),
        ),
        Entry(
            "missing",
            "bc.plot.missing(trail.steps[0].discovery)",
            "Which effect is missing: the log Bayes factor of each candidate. Neighbours of the finding rise with it; "
            "given the finding, nothing is left of them.",
            lambda: bc.plot.missing(found),
        ),
        Entry(
            "trail",
            "bc.plot.trail(trail)",
            "The error falls to the noise floor, on the fitted readings, leave-one-run-out and on hold-out data.",
            lambda: bc.plot.trail(trail),
        ),
        Entry(
            "residuals_after",
            "bc.plot.residuals(trail.final.calibration)",
            "The same residuals with what was found in the model.",
            lambda: bc.plot.residuals(last.calibration, last.check),
        ),
    ]


def page(shown: list[Entry]) -> str:
    hidden = ", ".join(f"{name} = {size:g} °/s/°C" for name, size in HIDDEN.items())
    parts = [
        "# Gallery",
        "Made by `python docs/gallery.py`. Every picture is a function that returns a Matplotlib figure; "
        "`bc.plot.save(figure, path)` writes it. Colours are those that the colour-blind tell apart (Okabe and Ito). "
        "A posterior is drawn by ArviZ: `arviz_plots.plot_forest(calibration.tree)`, `plot_dist`, `plot_pair`, "
        "`plot_ppc_pit`.",
        f"The readings are simulated: a MEMS gyroscope over temperature (seed {SEED}), with {hidden} hidden in it.",
        "```python\nimport bayescal as bc\nfrom bayescal_models import mems_gyro\n\n"
        f"readings = mems_gyro.simulate({json.dumps(HIDDEN)}, seed={SEED})\n"
        "trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings)\n```",
    ]
    for e in shown:
        parts.append(f"## {e.name.replace('_', ' ').capitalize()}")
        parts.append(f"```python\n{e.code}\n```")
        parts.append(f"![{e.see}](gallery/{e.name}.png)")
        parts.append(e.see)
    return "\n\n".join(parts) + "\n"


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    shown = entries(campaign())
    for e in shown:
        print(bc.plot.save(e.draw(), PICTURES / f"{e.name}.png"))
    (FOLDER / "gallery.md").write_text(page(shown), "utf-8")


if __name__ == "__main__":
    main()
