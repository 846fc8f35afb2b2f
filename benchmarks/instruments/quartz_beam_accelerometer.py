"""What each structure leaves of a quartz beam accelerometer's bias on ramps of speeds that it has not seen.

    python -m benchmarks quartz_beam_accelerometer

A simulated device of two beams (its truth no polynomial) is calibrated over −40 … +70 °C on soaked four-position
tumbles and on ramps of 1 and 3 °C/min at +1, 0 and −1 g. Then come ramps of 0.5, 2 and 4 °C/min, another seed. The
bias left is the *true* bias (known to the simulator) minus the one that the fitted model says. Checked: uncompensated,
bias changes by more than 5 mg and scale factor by more than 500 ppm (source 2); the two-thermometer model leaves the
least, and better than half of what temperature alone, temperature with rate, and the frequency sum leave.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

import bayescal as bc
from bayescal._calibration.summary import null_directions
from bayescal_models import quartz_beam_accelerometer as quartz
from benchmarks.record import write

SEED = 11
DEVICE = {"device": "beams", "frequency_sum": True}
FITTED = quartz.Campaign(ramp_speeds=(1.0, 3.0), interval=120.0, **DEVICE)
SPEEDS = (0.5, 2.0, 4.0)  # °C/min, held out
HELD = {
    speed: quartz.Campaign(repeats=0, ramp_speeds=(speed,), attitudes=(0.0, 1.0), **DEVICE)
    for speed in SPEEDS
}
MODELS = {
    "t1, order 1": lambda: quartz.of_circuit(1),
    "t1, order 3": lambda: quartz.of_circuit(3),
    "t1, order 5": lambda: quartz.of_circuit(5),
    "t2, order 3 (baseline)": quartz.INSTRUMENT.baseline,
    "t1, rate and product": quartz.with_rate,
    "frequency sum, order 3": quartz.of_frequency_sum,
    "two thermometers": quartz.two_thermometers,
}
RIVALS = tuple(name for name in MODELS if name != "two thermometers")


@dataclass(frozen=True)
class Left:
    """What compensation leaves: root mean square and largest size; bias in µg, scale factor in ppm."""

    bias_rms: float
    bias_max: float
    scale_rms: float
    scale_max: float


def said(calibration: bc.Calibration, readings: bc.Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Bias (µg) and scale factor (ppm) that a calibrated model says at these readings: outputs at 0 and at 1 g."""
    zero = readings.with_column("acceleration", np.zeros(len(readings)))
    one = readings.with_column("acceleration", np.full(len(readings), 1e6))
    at_zero, at_one = (bc.predict(calibration, r, draws=200).mean for r in (zero, one))
    return at_zero, at_one - at_zero - 1e6


def left(calibration: bc.Calibration | None, campaign: quartz.Campaign) -> Left:
    """What a calibration leaves on a campaign; None for no compensation but a constant."""
    readings = quartz.simulate(seed=SEED + 1, campaign=campaign)
    true = quartz.true_values(campaign)
    if calibration is None:
        bias, scale = true.bias - true.bias.mean(), true.scale - true.scale.mean()
    else:
        bias, scale = (
            a - b for a, b in zip((true.bias, true.scale), said(calibration, readings), strict=True)
        )
    sizes = [float(f(e)) for e in (bias, scale) for f in (_rms, _largest)]
    return Left(*sizes)


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _largest(error: np.ndarray) -> float:
    return float(np.max(np.abs(error)))


def main() -> None:
    """Calibrate every structure, hold the ramps against it, check, print and write."""
    begun = time.perf_counter()
    readings = quartz.simulate(seed=SEED, campaign=FITTED)
    true = quartz.true_values(FITTED)
    spread = {"bias_ug": float(np.ptp(true.bias)), "scale_ppm": float(np.ptp(true.scale))}
    print(f"{len(readings)} readings fitted; uncompensated, bias changes by {spread['bias_ug']:.0f} µg, "
          f"scale factor by {spread['scale_ppm']:.0f} ppm\n")  # fmt: skip
    rows = {"none": {str(s): left(None, c) for s, c in HELD.items()}}
    named: list[str] = []
    for name, make in MODELS.items():
        calibration = bc.fit(make(), readings, bc.LeastSquares(), seed=SEED)
        rows[name] = {str(s): left(calibration, c) for s, c in HELD.items()}
        if name == "two thermometers":
            found = null_directions(calibration)
            named = [c.numbers["combination"] for c in found if c.code.endswith("_exactly")]
    print(table(rows))
    worst = {n: max(r.bias_rms for r in by.values()) for n, by in rows.items()}
    best = worst["two thermometers"]
    checks = {
        "uncompensated bias changes by more than 5 mg": spread["bias_ug"] > 5000,
        "uncompensated scale factor changes by more than 500 ppm": spread["scale_ppm"] > 500,
        "the six null combinations are named": len(named) == 6,
        "two thermometers leave less than half of every rival": all(
            2 * best < worst[n] for n in RIVALS
        ),
    }
    for claim, holds in checks.items():
        print(f"{'yes' if holds else 'NO '}  {claim}")
    results = {
        "seed": SEED,
        "fitted": {"speeds": FITTED.ramp_speeds, "readings": len(readings)},
        "spread": spread,
        "left": {n: {s: vars(r) for s, r in by.items()} for n, by in rows.items()},
        "not_measured": named,
        "checks": checks,
        "seconds": time.perf_counter() - begun,
    }
    write("quartz_beam_accelerometer", results)
    if not all(checks.values()):
        raise SystemExit("a claim does not hold: see NO above")


def table(rows: dict[str, dict[str, Left]]) -> str:
    """One line per structure: bias left, µg rms (max), and scale factor, ppm rms, at each held-out speed."""
    head = [f"{'structure':<24}", *(f"{s + ' °C/min':>22}" for s in map(str, SPEEDS))]
    lines = [
        "bias left, µg rms (max), and scale factor left, ppm rms; ramps held out",
        " ".join(head),
    ]
    for name, by in rows.items():
        cells = [
            f"{f'{r.bias_rms:.1f} ({r.bias_max:.0f}), {r.scale_rms:.2f}':>22}" for r in by.values()
        ]
        lines.append(" ".join([f"{name:<24}", *cells]))
    return "\n".join(lines)
