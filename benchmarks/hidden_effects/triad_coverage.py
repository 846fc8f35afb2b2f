"""Do intervals of three axes hold the truth, and are they no wider than they need be? In kinds of logs as they come.

    python -m benchmarks triad_coverage

Of each kind 40 campaigns: logs of an inertial unit turned by hand between 24 rests, with the noise of an Xsens MTi and
of an MPU-9150 (data sheets), and with rests of 1.4 to 3.4 s; accelerometers in 14 poses at each of five temperatures,
their bias and scale following it; a log of accelerometers in six positions that are off by 2°, which tells of no
misalignment: once with the unit of the other kinds, whose misalignments are a fifth of what data sheets allow, and once
with units whose misalignments are drawn as data sheets have them. Each is calibrated as `calibrate` does; what is
judged is what is delivered, the posterior averaged over structures. One JSON line a campaign in
results/triad_coverage.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import accelerometer_triad, gyro_triad
from bayescal_models.accelerometer_triad.campaign import Campaign
from bayescal_models.accelerometer_triad.simulator import BASELINE as FORCES
from bayescal_models.gyro_triad.campaign import MovesByHand
from bayescal_models.gyro_triad.log_simulator import simulate_log
from bayescal_models.gyro_triad.simulator import BASELINE as RATES
from bayescal_models.triad.simulator import beside, directions, matrix_of
from benchmarks.hidden_effects.resume import go_on
from benchmarks.hidden_effects.triads import TEMPERATURES
from benchmarks.intervals import credible_interval, proportion
from benchmarks.record import RESULTS, read_lines, write

CAMPAIGNS = 40  # of each kind
FORCE, TURNS = accelerometer_triad.INSTRUMENT, gyro_triad.INSTRUMENT
MPU = {"force_noise": 4e-4, "gyro_noise": 5e-3}  # g/√Hz, °/s/√Hz
LOGS = {
    "MTi": {"force_noise": 2e-4, "gyro_noise": 5e-2},
    "MPU-9150": MPU,
    "short rests": MPU,
}
SHORT = 1.4, 3.4  # s, of rests
ACCEL = ("accel_x", "accel_y", "accel_z")
WARM = {"bias.temperature": (0.2, -0.1, 0.3), "scale.temperature": (60.0, -40.0, 80.0)}
OFF = np.deg2rad(2.0)
SIX, DRAWN = "six positions", "six positions, misalignments drawn"
MISALIGNED = 20.0  # mrad, as data sheets have it: the plausible size of the instrument
KINDS = (*LOGS, "ramp of temperature", SIX, DRAWN)
MEMBERS = {"misalignment.constant": ("xy", "xz", "yz", "yx", "zx", "zy")}

Judged = tuple[bc.Calibration, Mapping[str, Any]]  # with what is true, by effect


def main() -> None:
    """Run what is missing of the campaigns, then write and print the counts."""
    every = ((kind, seed) for seed in range(CAMPAIGNS) for kind in KINDS)
    path = RESULTS / "triad_coverage.jsonl"
    go_on(path, ("kind", "seed"), ((one, one) for one in every), measure)
    summarise()


def measure(one: tuple[str, int]) -> tuple[dict[str, Any], str]:
    """One campaign: of each coefficient whether its interval holds the truth, and how far off its mean is."""
    kind, seed = one
    begun = time.process_time()
    covered, off = {}, {}
    for calibration, truth in _calibrated(kind, seed):
        for name, true in _by_name(truth):
            if name in calibration.posterior:
                draws = calibration.samples(name)
                key = f"{calibration.model.instrument.name} {name}"
                low, high = credible_interval(draws)
                covered[key] = low < true < high
                off[key] = float((draws.mean() - true) / draws.std())
    seconds = time.process_time() - begun
    row = {"kind": kind, "seed": seed, "covered": covered, "off": off, "seconds": seconds}
    return row, f"{kind} {seed} {seconds:.0f} s: {sum(covered.values())}/{len(covered)}"


def _calibrated(kind: str, seed: int) -> Iterator[Judged]:
    if kind in LOGS:
        still = np.random.default_rng([seed, 3]).uniform(*SHORT) if kind == "short rests" else 4.0
        log = simulate_log(seed=seed, campaign=MovesByHand(still=still, **LOGS[kind]))
        forces, turns = (_read(of, log, n) for of, n in ((FORCE, "accel"), (TURNS, "gyro")))
        found = _in_poses(forces, seed)
        yield found, FORCES
        rows = bc.moves(turns, TURNS, forces, bc.vector_correction(found))
        yield bc.calibrate(gyro_triad.moved(), rows, seed=seed).calibration, RATES
        return
    if kind in (SIX, DRAWN):
        told = {name: FORCES[name] for name in ("bias.constant", "scale.constant")}
        yield _in_poses(_read(FORCE, _six(seed, drawn=kind == DRAWN), "accel"), seed), told
        return
    plan = Campaign(poses=14, temperatures=TEMPERATURES)
    readings = accelerometer_triad.simulate(WARM, seed=seed, campaign=plan)
    yield bc.calibrate(FORCE.baseline(), readings, seed=seed).calibration, {**FORCES, **WARM}


def _in_poses(log: bc.Measurements, seed: int) -> bc.Calibration:
    poses = bc.poses(log, FORCE)
    return bc.calibrate(FORCE.for_readings(poses).baseline(), poses, seed=seed).calibration


def _six(seed: int, *, drawn: bool) -> dict[str, np.ndarray]:
    """A log, g, of accelerometers put down on each of their six sides for 4 s, and turned over in a second between."""
    rng, rate = np.random.default_rng(seed), 100
    sides = beside(directions("six", 6, rng), OFF, rng)
    parts = []
    for here, there in pairwise([*sides, sides[0]]):
        across = np.cross(here, rng.standard_normal(3))  # by way of which it is turned
        done = np.linspace(0, np.pi / 2, rate)[:, None]
        half = across / np.linalg.norm(across)
        parts += [np.tile(here, (4 * rate, 1)), np.cos(done) * here + np.sin(done) * half]
        parts.append(np.cos(done) * half + np.sin(done) * there)
    force = np.concatenate(parts)
    scale, angles = np.array(FORCES["scale.constant"]), np.array(FORCES["misalignment.constant"])
    if drawn:
        angles = MISALIGNED * np.random.default_rng([seed, 5]).standard_normal(len(angles))
    matrix = matrix_of(1e-6 * scale, 1e-3 * angles)
    noise = MPU["force_noise"] * np.sqrt(rate) * rng.standard_normal(force.shape)
    output = force @ matrix.T + 1e-3 * np.array(FORCES["bias.constant"]) + noise
    return {"time": np.arange(len(force)) / rate, **dict(zip(ACCEL, output.T, strict=True))}


def _read(instrument: bc.Instrument, log: Mapping[str, np.ndarray], name: str) -> bc.Measurements:
    outputs = {f"output_{a}": log[f"{name}_{a}"] for a in "xyz"}
    return bc.Measurements.from_arrays(instrument, time=log["time"], **outputs)


def _by_name(truth: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for effect, values in truth.items():
        for part, value in zip(MEMBERS.get(effect, "xyz"), values, strict=False):
            yield f"{effect}[{part}]", float(value)


def summarise() -> None:
    """Write and print the counts of the campaigns that stand: coverage, and widths over what is realised."""
    rows, found = read_lines(RESULTS / "triad_coverage.jsonl"), {}
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind]
        inside = [held for row in own for held in row["covered"].values()]
        off = np.array([z for row in own for z in row["off"].values()])
        found[kind] = {
            "campaigns": len(own),
            "intervals that hold the truth": proportion(sum(inside), len(inside)),
            "standard uncertainty over error": float(1 / np.sqrt(np.mean(off**2))) if own else None,
        }
        print(f"{kind:20s} {found[kind]}")
    write("triad_coverage", found)
