"""Does compensation lose nothing that the campaign has told? Campaigns drawn from the priors, and verification data.

    python -m benchmarks compensation                               1000 campaigns of each instrument
    python -m benchmarks.instruments.compensation mems_gyro --replicates 100

For each campaign the truth of every unknown is drawn from the model's own priors (all proper), and from that truth a
calibration and a verification data set, by the model's own composition and noise: the same device, new runs and
cells, a perfect test rig. The calibration is fitted by `Marginal`; `bayescal.compensator` turns the verification
readings back into the stimulus, by draws. Measured:

- *ratio*: rms error of the compensated stimulus over that of compensating with the true coefficients (a deviation
  that is new in use is zero for both). What the campaign does not identify is left aside, that is, errors are taken
  without what is constant (inclinometer: two mountings of an axis, each with its own zero; ng: the fixture's tilt is
  an alias of the bias) or in proportion to the stimulus (ng: the 1″ of the table's tilt is one of the scale factor).
- *covered*: how often value ± 2u holds the stimulus, u with the noise of the reading, by one verification reading a
  campaign, chosen at random, so that counts are independent; against 95.45 %, what k = 2 means for a Gaussian.
- of what is left aside: how often the coefficient's own mean ± 2u holds the truth.

Campaigns whose fit is not to be trusted are counted as the others are, and their share is stated. A differential pair
has no compensator: what it measures is no function of one reading (`differential_pair.py`).

Resumable: results/compensation_NAME.jsonl holds a line for each chunk. Writes results/compensation.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import bayescal as bc
from bayescal._compensation.inversion import first_order
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from bayescal_models import (
    inclinometer,
    mems_gyro,
    ng_accelerometer,
    quartz_beam_accelerometer,
)
from bayescal_models.mems_gyro.reference_problem import TURNING
from bayescal_models.ng_accelerometer import reference_problem as ng_problem
from bayescal_models.ng_accelerometer.geometry import accelerations
from bayescal_models.still_sensor import reference_problem as still_problem
from benchmarks.accuracy.coverage import PROPOSALS, RESULTS, Ground, collect
from benchmarks.record import write

REPLICATES = 1000
CHUNK = 20  # campaigns a line of the file
K, NOMINAL = 2.0, float(2 * stats.norm.cdf(2.0) - 1)
LEVEL = 0.001  # chance that right programs fail, of one instrument's coverage
CLOSE = 1.05  # what the median ratio must not exceed
VERIFIED = 60  # readings of a verification
DRAWS = 400


@dataclass(frozen=True)
class Trial(Ground):
    """An instrument's calibration campaign, and what verifies it.

    Attributes:
        verification: readings, whose output is replaced.
        stimulus: true, of each verification reading, in the unit of use.
        added: the stimulus adds to what the composition gives (a sensor at rest has no column for it).
        members: of groups that the compensator is of.
        aside: coefficients that the campaign does not identify beyond a prior or spread: none, a constant, or a
            constant and one in proportion to the stimulus. Ratios are of errors without their like.
        proposals: of `Marginal`.
    """

    verification: bc.Measurements
    stimulus: np.ndarray
    added: bool = False
    members: tuple[tuple[str, str], ...] = ()
    aside: tuple[str, ...] = ()
    proposals: int = PROPOSALS

    @cached_property
    def method(self) -> bc.Marginal:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As the compensator averages over so many draws; one number, so that all campaigns share programs."""
        return replace(super().method, draws=DRAWS, proposals=self.proposals)

    @property
    def chunk(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return CHUNK

    @cached_property
    def fingerprint(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Changes with the model, its priors, the plans or the method."""
        made, _ = self.drawn(1, self.seed(0))
        numbers = [f"{v:.6e}" for one in made for v in (*one[0]["output"], *one[1]["output"])]
        parts = [*self.model.unknowns, *numbers, repr(self.method)]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def drawn(
        self, count: int, seed: int
    ) -> tuple[list[tuple[bc.Measurements, bc.Measurements]], dict[str, np.ndarray]]:
        """Calibration and verification data sets, and the truth of every unknown, (count, …)."""
        layout, levels = bind(self.model, self.plan)
        later, new_levels = bind(self.model, self.verification)
        reference = reference_of(self.plan)
        frame = build_frame(self.plan, reference)
        there = build_frame(self.verification, {"run_starts": {}, **reference})
        keep, come, act = _shared(layout, later, levels, new_levels)
        extra = jnp.asarray(self.stimulus if self.added else np.zeros_like(self.stimulus))

        def one(key):
            k = jax.random.split(key, 4)
            x, rows, v = forward.draw_prior(layout, frame, k[0])
            hyper = forward.hyper_values(layout, v)
            z = jax.random.normal(k[1], (later.size,))
            new = forward.prior_mean(later) + forward.prior_sd(later, hyper) * z
            new = new.at[come].set(x[keep]) * act
            no_rows = jnp.zeros((there.size, 0))
            first = forward.draw_readings(layout, frame, x, rows, v, k[2])
            second = forward.draw_readings(later, there, new, no_rows, v, k[3]) + extra
            truth = {**hyper, **forward.coefficients(layout, x, rows, hyper)}
            return first, second, truth

        keys = jax.random.split(jax.random.key(seed), count)
        first, second, truth = jax.jit(jax.vmap(one))(keys)
        pairs = [
            (
                self.plan.with_column("output", np.asarray(a)),
                self.verification.with_column("output", np.asarray(b)),
            )
            for a, b in zip(first, second, strict=True)
        ]
        return pairs, {name: np.asarray(value) for name, value in truth.items()}

    def run(self, index: int) -> dict[str, Any]:
        """One chunk of campaigns."""
        begun, seed = time.perf_counter(), self.seed(index)
        made, truth = self.drawn(self.chunk, seed)
        rows = [
            self.campaign(*pair, {n: t[i] for n, t in truth.items()}, seed + i)
            for i, pair in enumerate(made)
        ]
        found = {name: [row[name] for row in rows] for name in rows[0]}
        seconds = round(time.perf_counter() - begun, 1)
        head = {"fingerprint": self.fingerprint, "chunk": index, "seed": seed}
        return {**head, **found, "seconds": seconds}

    def campaign(
        self,
        readings: bc.Measurements,
        verification: bc.Measurements,
        truth: dict[str, np.ndarray],
        seed: int,
    ) -> dict[str, Any]:
        """What compensation left of one campaign, beside what the true coefficients leave."""
        fit = bc.fit(self.model, readings, self.method, seed=seed, strict=False)
        compensate = bc.compensator(fit, members=dict(self.members))
        found = compensate(verification, warn=False)
        error = found.value - self.stimulus
        least = self.by_truth(compensate, verification, truth) - self.stimulus
        chosen = np.random.default_rng(seed).integers(len(error))
        row = {
            "ratio": round(self.rms(error) / self.rms(least), 5),
            "deviation": round(float(error[chosen] / found.uncertainty[chosen]), 5),
            "trusted": bool(fit.verdict.ok),
        }
        for name in self.aside:
            samples, actual = fit.samples(name), np.atleast_1d(truth[name])[0]
            samples = samples if samples.ndim == 1 else samples[:, 0]
            row[name] = round(float((samples.mean() - actual) / samples.std()), 5)
        return row

    def rms(self, error: np.ndarray) -> float:
        """Of the errors, without what the campaign does not identify."""
        if not self.aside:
            return float(np.sqrt(np.mean(error**2)))
        powers = np.vander(self.stimulus / np.abs(self.stimulus).max(), len(self.aside))
        left = error - powers @ np.linalg.lstsq(powers, error)[0]
        return float(np.sqrt(np.mean(left**2)))

    def by_truth(
        self,
        compensate: bc.Compensator,
        verification: bc.Measurements,
        truth: dict[str, np.ndarray],
    ) -> np.ndarray:
        """The stimulus by the true coefficients, deviations that are new in use zero."""
        assert compensate.equation is not None and compensate.calibration is not None
        levels, chosen = compensate.calibration.levels, dict(self.members)
        blocks = {b.name: b for b in compensate.equation.blocks}
        theta = []
        for entry in compensate.equation.unknowns():
            value = np.atleast_1d(truth[entry.key])
            per = blocks[entry.key].coefficient.per if entry.kind != "shape" else None
            place = levels[per].index(chosen[per]) if per and entry.kind != "new" else 0
            theta.append(0.0 if entry.kind == "new" else float(value[place]))
        own, size = compensate._inverse, len(verification)
        inputs = {n: jnp.zeros(size) for n in own.names}
        inputs |= {n: jnp.asarray(verification[n]) for n in own.inputs}
        value, _, _ = first_order(
            *(compensate.equation, own.reference, own.affine),
            *(jnp.asarray(theta), jnp.zeros((len(theta), len(theta)))),
            *(jnp.asarray(verification["output"]), inputs, None),
        )
        return np.asarray(value)


def _shared(layout, later, levels, new_levels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of what both data sets have in common in the one's x and in the other's, and what acts in the latter.

    Runs and cells are new; the test rig is perfect.
    """
    use = layout.model.instrument.use
    keep, come, act = [], [], np.ones(later.size)
    for a, b in zip(layout.x_blocks, later.x_blocks, strict=True):
        per = a.coefficient.per
        if use.slots and a.slot not in use.slots:
            act[b.start : b.start + b.size] = 0.0
        elif per is None:
            keep, come = [*keep, a.start], [*come, b.start]
        elif per not in ("run", "cell"):
            for i, member in enumerate(new_levels[per]):
                keep, come = [*keep, a.start + levels[per].index(member)], [*come, b.start + i]
    return np.array(keep, dtype=int), np.array(come, dtype=int), act


def _made(instrument: bc.Instrument, **columns: Any) -> bc.Measurements:
    return bc.Measurements.from_arrays(instrument, output=np.zeros(VERIFIED), **columns)


def _gyro(random: np.random.Generator) -> Trial:
    """The instrument's own campaign, 30 … 80 °C in three runs, turning, so that the scale factor shows."""
    plan = mems_gyro.simulate(seed=0, campaign=mems_gyro.Campaign(rate_input=TURNING))
    rate = random.uniform(-100, 100, VERIFIED)
    temperature = random.uniform(30, 80, VERIFIED)
    made = _made(mems_gyro.INSTRUMENT, temperature=temperature, rate_input=rate)
    model = mems_gyro.INSTRUMENT.baseline() + "scale.constant"
    return Trial("mems_gyro", model, plan, made, rate)


def _inclinometer(random: np.random.Generator) -> Trial:
    """Source 4's own zero test, and a grid of tilts of axis x in a new mounting."""
    plan = inclinometer.simulate(seed=0)
    tilt, other = np.deg2rad(random.uniform(-40, 40, (2, VERIFIED)))
    made = _made(
        inclinometer.INSTRUMENT,
        axis=np.full(VERIFIED, "x"),
        run=np.full(VERIFIED, "x new"),
        placement_angle=other,
        true_angle=tilt,
    )
    members, aside = (("axis", "x"),), ("zero.constant",)
    model = inclinometer.INSTRUMENT.baseline()
    return Trial("inclinometer", model, plan, made, tilt, False, members, aside)


def _still(random: np.random.Generator) -> Trial:
    """The reference problem's two runs of ramps; whatever is then added to the output is the stimulus."""
    plan = still_problem.readings()
    low, high = plan["temperature"].min(), plan["temperature"].max()
    temperature = random.uniform(low, high, VERIFIED)
    sensor, hours = still_problem.SENSOR, 60.0 * np.arange(VERIFIED)
    made = _made(sensor, temperature=temperature, time=hours)
    stimulus = random.uniform(-1e3, 1e3, VERIFIED)
    return Trial("still_sensor", still_problem.model(), plan, made, stimulus, added=True)


def _quartz(random: np.random.Generator) -> Trial:
    """The instrument's own campaign: tumbles and ramps over −40 … 70 °C."""
    plan = quartz_beam_accelerometer.simulate(seed=0)
    head = random.uniform(plan["temperature_head"].min(), plan["temperature_head"].max(), VERIFIED)
    acceleration = random.uniform(-1e6, 1e6, VERIFIED)
    made = _made(
        quartz_beam_accelerometer.INSTRUMENT,
        temperature_circuit=head,
        temperature_head=head,
        acceleration=acceleration,
    )
    model = quartz_beam_accelerometer.INSTRUMENT.baseline()
    return Trial("quartz_beam_accelerometer", model, plan, made, acceleration)


def _ng(random: np.random.Generator) -> Trial:
    """Source 0's test of instrument A, 180 readings; the reference problem's priors, since those of a first calibration
    are flat in effect. Verified at its positions and temperatures anew, the face and the base without tilt errors.

    Cell by cell the fixture tilts by its own spread, an alias of the bias' own; where its spread is the larger one, it
    costs the tempco more than the verification, which is without it, shows of the least error: ratios rise.
    """
    campaign = replace(ng_problem.CAMPAIGN, temperatures=(20.0, 25.0, 30.0, 35.0, 40.0), runs=3)
    plan = ng_accelerometer.simulate(seed=0, campaign=campaign)
    made = ng_accelerometer.simulate(seed=1, campaign=campaign)
    none = jnp.zeros(len(made))
    tilt, angle = jnp.asarray(made["tilt"]), jnp.asarray(made["position_angle"])
    along = np.asarray(accelerations(tilt, angle, none, none, none).along)
    model, aside = ng_problem.model(), ("bias.constant", "scale.constant")
    return Trial("ng_accelerometer", model, plan, made, along, aside=aside, proposals=8192)


TRIALS: dict[str, Callable[[np.random.Generator], Trial]] = {
    "mems_gyro": _gyro,
    "still_sensor": _still,
    "inclinometer": _inclinometer,
    "quartz_beam_accelerometer": _quartz,
    "ng_accelerometer": _ng,
}


def trial(name: str) -> Trial:
    """The trial of an instrument; its verification readings are the same every time."""
    return TRIALS[name](np.random.default_rng(sorted(TRIALS).index(name)))


def band(count: int) -> tuple[int, int]:
    """Least and most of `count` that cover, with probability 99.9 % if each does with the nominal one."""
    low = stats.binom.ppf(LEVEL / 2, count, NOMINAL)
    return int(low), int(stats.binom.isf(LEVEL / 2, count, NOMINAL))


def summary(own: Trial, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What is written of one instrument."""
    names = ("ratio", "deviation", "trusted", *own.aside)
    every = {name: np.concatenate([row[name] for row in rows]) for name in names}
    count = len(every["ratio"])
    low, high = band(count)
    covered = {n: int(np.sum(np.abs(every[n]) <= K)) for n in ("deviation", *own.aside)}
    ratio = every["ratio"]
    fails = [n for n, hits in covered.items() if not low <= hits <= high]
    return {
        "campaigns": count,
        "readings": len(own.plan),
        "verified": len(own.stimulus),
        "ratio": {
            "median": float(np.median(ratio)),
            "quantile95": float(np.quantile(ratio, 0.95)),
            "within": float(np.mean(ratio <= CLOSE)),
            "without": list(own.aside),
        },
        "covered": covered.pop("deviation"),
        "band": [low, high],
        "aside_covered": covered,
        "not_trusted": int(np.sum(~every["trusted"])),
        "seconds": round(sum(row["seconds"] for row in rows), 1),
        "fails": (["ratio"] if np.median(ratio) > CLOSE else []) + fails,
    }


HEAD = (
    f"{'instrument':26} {'campaigns':>9} {'ratio':>7} {'95 %':>7} {'covered':>7} {'band':>11} "
    f"{'untrusted':>9}  fails; what is left aside"
)


def line(name: str, s: dict[str, Any]) -> str:
    ratio, limits = s["ratio"], f"{s['band'][0]} … {s['band'][1]}"
    aside = ", ".join(f"{n} covered {hits}" for n, hits in s["aside_covered"].items())
    return (
        f"{name:26} {s['campaigns']:9} {ratio['median']:7.3f} {ratio['quantile95']:7.3f} {s['covered']:7} "
        f"{limits:>11} {s['not_trusted']:9}  {', '.join(s['fails']) or 'none'}; {aside or 'nothing'}"
    )


def main(argv: list[str] | None = None) -> None:
    """Compute what is missing, print the table, write results."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.instruments.compensation", description=__doc__
    )
    parser.add_argument("names", nargs="*", default=[], help="instruments; all if none is named")
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    asked = parser.parse_args(argv if argv is not None else [])
    if unknown := set(asked.names) - set(TRIALS):
        parser.error(f"no trial is called {', '.join(unknown)}: {', '.join(TRIALS)}")
    file = RESULTS / "compensation.json"
    summaries = json.loads(file.read_text("utf-8"))["instruments"] if file.is_file() else {}
    print(HEAD)
    for name in asked.names or TRIALS:
        own = trial(name)
        rows = collect(own, asked.replicates, RESULTS / f"compensation_{name}.jsonl")
        summaries[name] = summary(own, rows)
        print(line(name, summaries[name]), flush=True)
        write("compensation", {"nominal": NOMINAL, "level": LEVEL, "instruments": summaries})


if __name__ == "__main__":
    main(sys.argv[1:])
