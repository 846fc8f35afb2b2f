"""The inclinometer of source 4: its two lines, line against projection, and what compensation leaves.

1. *Lines*: zero tests are simulated from the document's two lines and fitted; the lines must come back, with
   intervals that cover.
2. *Laws*: a zero that follows the projections is told from a line, by log evidence, at the table's 2″, for several
   sizes of S_p; and where it cannot be told, that is shown too.
3. *Compensation*: two-axis verification data of the exact equation (S_e not tilted, a scale factor error, exact
   placement angle), compensated by zeros calibrated on the dividing table, as the document did, and by the whole
   equation; beside the published figures.

Results go to `benchmarks/results/inclinometer.json`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import inclinometer
from bayescal_models.inclinometer.campaign import VERIFICATION, Accelerometer, Campaign
from benchmarks.accuracy.coverage import drawn_one_by_one
from benchmarks.intervals import credible_interval
from benchmarks.record import write

LINES = {"x": (62.6211, 0.72105), "y": (96.3284, 0.06818)}  # source 4: arcsec, arcsec/deg
PUBLISHED = {"x": (0.039, 0.0087), "y": (0.0254, 0.0093)}  # deg, largest error before and after
DOCUMENT = "line, document's law"
REPEATS = 40
PENDULUM = (0.0, 3.0, 10.0, 30.0, 100.0, 600.0)  # arcsec
LAWS = ("line", "quadratic", "projection", "spline table")
COVERED = (0.88, 0.995)  # of 160 intervals at 95 %, the share that 99.9 % of correct ones have
TOLD = 5.0  # log Bayes factor
# Its lines as projections (S_d of 41 and 4″); S_e of 60″ and κ of 100 ppm after PHYSICS: 25″ and 21″ at 45°.
DEVICE = (
    ("x", Accelerometer(electrical=60.0, pendulum=2.6, door=41.3, scale=100.0)),
    ("y", Accelerometer(electrical=60.0, pendulum=36.3, door=3.9, scale=100.0)),
)


def main() -> None:
    """Measure, check, print and write."""
    started = time.perf_counter()
    results = {"lines": lines(), "laws": laws(), "compensation": compensation()}
    results["seconds"] = time.perf_counter() - started
    write("inclinometer", results)
    failed = failures(results)
    print("inclinometer: " + ("every check holds" if not failed else "; ".join(failed)), flush=True)
    if failed:
        raise SystemExit(1)


def failures(results: dict[str, Any]) -> list[str]:
    """What does not hold, a sentence each."""
    low, high = COVERED
    share, found = results["lines"]["covered"], []
    if not low <= share <= high:
        found.append(f"95 % intervals of the lines cover {share:.3f}, expected {low} to {high}")
    for row in results["laws"]:
        factor = row["log_evidence"]["projection"] - row["log_evidence"]["line"]
        if row["pendulum"] >= 30 and factor < TOLD:
            found.append(f"S_p = {row['pendulum']:g}″ is not told from a line ({factor:.1f})")
    rows = results["compensation"]["largest_error_deg"]
    for axis in "xy":
        if not rows[DOCUMENT][axis] < 0.6 * rows["as read"][axis]:
            found.append(f"compensation of {axis} leaves {rows[DOCUMENT][axis]:.4f}°")
        if not rows["whole equation"][axis] < 0.0093:
            found.append(f"the whole equation leaves {rows['whole equation'][axis]:.4f}° of {axis}")
    return found


def lines() -> dict[str, Any]:
    """The document's lines from simulated zero tests: one in full, many for the coverage of intervals."""
    model = inclinometer.INSTRUMENT.baseline()
    one = bc.fit(model, inclinometer.simulate(seed=0))
    estimates = {}
    print("inclinometer: source 4's lines from a simulated zero test")
    for place, axis in enumerate(one.levels["axis"]):
        for name, true in zip(("zero.constant", "zero.placement"), LINES[axis], strict=True):
            values = one.samples(name)[:, place]
            estimates[f"{name}({axis})"] = {
                "true": true,
                "mean": float(values.mean()),
                "sd": float(values.std()),
                "interval": credible_interval(values),
            }
            print(f"  {name}({axis})  {values.mean():9.4f} ± {values.std():.4f}   true {true}")
    many = [inclinometer.simulate(seed=s) for s in range(1, REPEATS + 1)]
    made, k_hats = drawn_one_by_one(model, many, bc.Marginal(), 0)
    covered = []
    for found in made:
        for place, axis in enumerate(one.levels["axis"]):
            for name, true in zip(("zero.constant", "zero.placement"), LINES[axis], strict=True):
                below = float(np.sum(found.weights * (found.samples[name][:, place] < true)))
                covered.append(0.025 <= below <= 0.975)
    share = float(np.mean(covered))
    print(f"  95 % intervals cover {share:.3f} of {len(covered)}; largest k̂ {max(k_hats):.2f}")
    return {"estimates": estimates, "covered": share, "intervals": len(covered)}


def laws() -> list[dict[str, Any]]:
    """Log evidence of each law where the zero follows projections, or the document's lines."""
    models = dict(inclinometer.INSTRUMENT.structures)
    rows = []
    print("inclinometer: log evidence against the line's; noise 2″, 152 readings")
    print("  truth                   " + "".join(f"{law:>14}" for law in LAWS[1:]))
    for pendulum in (None, *PENDULUM):
        campaign = Campaign() if pendulum is None else Campaign(axes=_projections(pendulum))
        readings = inclinometer.simulate(seed=7, campaign=campaign)
        fits = {law: bc.fit(models[law](), readings) for law in LAWS}
        evidence = {law: c.log_evidence[0] for law, c in fits.items() if c.log_evidence}
        title = "two lines" if pendulum is None else f"projection, S_p = {pendulum:g}″"
        gains = "".join(f"{evidence[law] - evidence['line']:14.1f}" for law in LAWS[1:])
        print(f"  {title:<24}{gains}", flush=True)
        rows.append({"truth": title, "pendulum": pendulum or 0.0, "log_evidence": evidence})
    return rows


def _projections(pendulum: float) -> tuple[tuple[str, Accelerometer], ...]:
    """Source 4's two lines as projections, with this S_p (of y, the opposite); at ω = 0 the zeros are its own."""
    return (
        ("x", Accelerometer(constant=62.6 - pendulum, pendulum=pendulum, door=41.3)),
        ("y", Accelerometer(constant=96.3 + pendulum, pendulum=-pendulum, door=3.9)),
    )


def compensation() -> dict[str, Any]:
    """Largest error of two-axis readings before and after, and by cause."""
    models = dict(inclinometer.INSTRUMENT.structures)
    zero_test = inclinometer.simulate(seed=11, campaign=Campaign(axes=DEVICE))
    grid = replace(VERIFICATION, axes=DEVICE, exact=True)
    known = inclinometer.simulate(seed=12, campaign=grid)  # on which the whole equation is fitted
    held = inclinometer.Verification.of(inclinometer.simulate(seed=13, campaign=grid))
    line = bc.fit(models["line"](), zero_test)
    projection = bc.fit(models["projection"](), zero_test)
    whole = bc.fit(models["projection, exact geometry"](), known)
    print("inclinometer: largest angle error, °, over ±45°")
    errors = {
        "published, as read": {a: PUBLISHED[a][0] for a in "xy"},
        "published, compensated": {a: PUBLISHED[a][1] for a in "xy"},
        "as read": _largest(held.errors),
        DOCUMENT: _left(line, held, law="document"),
        "line, both axes solved": _left(line, held),
        "projection, both axes solved": _left(projection, held),
        "whole equation": _left(whole, held),
    }
    for title, row in errors.items():
        print(f"  {title:<30} x {row['x']:.4f}   y {row['y']:.4f}")
    causes = {}
    for title, change in (
        ("S_e is not tilted", {"scale": 0.0}),
        ("scale factor", {"electrical": 0.0, "constant": 60.0}),
    ):
        axes = tuple((label, replace(one, **change)) for label, one in DEVICE)
        quiet = replace(grid, axes=axes, noise=0.0, repeatability=0.0, exact=False)
        table = inclinometer.Verification.of(inclinometer.simulate(seed=14, campaign=quiet))
        causes[title] = _left(line, table, law="document")
    for title, row in causes.items():
        print(f"  of which, {title:<20} x {row['x']:.4f}   y {row['y']:.4f}  (no noise, ω = y)")
    scale = whole.samples("scale.constant")
    print(
        f"  scale factors found: {scale.mean(axis=0).round(1)} ± {scale.std(axis=0).round(1)} ppm, true 100"
    )
    return {
        "largest_error_deg": errors,
        "causes_deg": causes,
        "scale_ppm": {
            "mean": scale.mean(axis=0).tolist(),
            "sd": scale.std(axis=0).tolist(),
            "true": 100.0,
        },
        "standard_uncertainty_arcsec": _coverage(whole, held),
    }


def _left(
    calibration: bc.Calibration, table: inclinometer.Verification, **how: Any
) -> dict[str, float]:
    made = inclinometer.compensate(calibration, table.reading_x, table.reading_y, **how)
    return _largest((made.x - table.true_x, made.y - table.true_y))


def _coverage(calibration: bc.Calibration, table: inclinometer.Verification) -> dict[str, float]:
    """Stated standard uncertainty, rms of what is left, and the share within two of the stated."""
    made = inclinometer.compensate(calibration, table.reading_x, table.reading_y)
    left = np.concatenate([made.x - table.true_x, made.y - table.true_y])
    stated = np.concatenate([made.sd_x, made.sd_y])
    arcsec = 3600 * np.rad2deg(1.0)
    found = {
        "stated": float(arcsec * np.sqrt(np.mean(stated**2))),
        "rms": float(arcsec * np.sqrt(np.mean(left**2))),
        "within_two": float(np.mean(np.abs(left) < 2 * stated)),
    }
    print(f"  whole equation: stated {found['stated']:.2f}″, found {found['rms']:.2f}″ rms")
    return found


def _largest(errors: tuple[np.ndarray, np.ndarray]) -> dict[str, float]:
    return {a: float(np.abs(np.rad2deg(e)).max()) for a, e in zip("xy", errors, strict=True)}
