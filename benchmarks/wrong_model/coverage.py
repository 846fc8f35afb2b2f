"""Intervals, probabilities and completeness stated after a search, with hidden effects of all sizes.

Campaigns of three instruments whose laws are not in the catalogue, fitted by `calibrate`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import bayescal as bc
import bayescal_models.inclinometer
from bayescal._search.structures import MAX_UNNAMED_RMS
from bayescal_models import mems_gyro, quartz_beam_accelerometer
from benchmarks import pages
from benchmarks.bank import Bank
from benchmarks.hidden_effects.drawn import not_held
from benchmarks.pages import Claim, Rows, share, stated_and_true
from benchmarks.wrong_model.worlds import NO_FORMULA, World, gyro, inclinometer, quartz

COUNT = 200  # campaigns of each
SAMPLE = 10  # of each, that a release measures anew
WORLDS = {
    "mems_gyro": (mems_gyro.INSTRUMENT, gyro, {"bias": ("constant", "temperature")}),
    "quartz_beam_accelerometer": (
        quartz_beam_accelerometer.INSTRUMENT,
        quartz,
        {
            slot: ("constant_head", *(f"temperature_head{p}" for p in ("", "_quadratic", "_cubic")))
            for slot in ("bias", "scale")
        },
    ),
    "inclinometer": (
        bayescal_models.inclinometer.INSTRUMENT,
        inclinometer,
        {f"zero({axis})": ("constant", "placement") for axis in "xy"},
    ),
}
THERMOMETER = {"quartz_beam_accelerometer": "temperature_head_0"}  # others: T0
NOISE = {"mems_gyro": 0.05, "quartz_beam_accelerometer": 5.0, "inclinometer": 2.0}  # of the worlds
RADIAN = np.deg2rad(1.0)  # what a coefficient of sin ω adds to the slope, by degree
# What an average may hold beside a coefficient that is the same at ω = 0: their sum has the truth.
BESIDE = {
    "zero.constant": {
        "zero.projection[pendulum]": 1.0,
        "dividing.wobble[cos1]": 1.0,
        "dividing.wobble[cos2]": 1.0,
        "dividing.face": 1.0,
    },
    "zero.placement": {
        "zero.projection[door]": RADIAN,
        "zero.cross_axis": RADIAN,
        "dividing.wobble[sin1]": RADIAN,
        "dividing.wobble[sin2]": 2 * RADIAN,
    },
}
Z = 1.959964  # of a 95 % interval


def cases(name: str) -> Iterator[tuple[tuple[int], tuple[str, int]]]:
    """Yield the campaigns of an instrument, in turn with effects that resemble a formula and with others."""
    seeds = ((i // 2 + NO_FORMULA * (i % 2)) for i in range(COUNT))
    return (((seed,), (name, seed)) for seed in seeds)


def campaign(case: tuple[str, int]) -> dict[str, Any]:
    """Calibrate a campaign; return its row."""
    name, seed = case
    instrument, simulate, powers = WORLDS[name]
    world: World = simulate(seed)
    path = bc.calibrate(instrument.baseline(), world.readings, method=bc.Marginal())
    used, best = path.calibration, path.final.calibration
    discovery = path.final.discovery
    shares = {s.effects: s.probability for s in path.shares} or {
        tuple(n for n in best.model.names if n not in instrument.baseline().names): 1.0
    }
    inclusion: dict[str, float] = {}
    for effects, probability in shares.items():
        for effect in effects:
            inclusion[effect] = inclusion.get(effect, 0.0) + probability
    return {
        "hidden": world.hidden,
        "final": [n for n in best.model.names if n not in instrument.baseline().names],
        "shares": [[list(e), p] for e, p in shares.items()],
        "inclusion": inclusion,
        "stated": {name: p for name, p in path.added.items() if p is not None},
        "missing": {}
        if discovery is None
        else {c.effect: c.probability for c in discovery.candidates if c.probability},
        "unseen": [] if discovery is None else list(discovery.unseen),
        "complete": None if discovery is None else discovery.nothing_missing,
        "open": path.gate.ok,
        "reason": path.gate.reason,
        "used": _covered(used, world, powers),
        "best": _covered(best, world, powers),
        "adds": added(case, world, path.steps[0].calibration),
    }


def added(case: tuple[str, int], world: World, baseline: bc.Calibration) -> dict[str, float]:
    """Return the contribution of each hidden effect outside the span of the baseline: rms, relative to the noise."""
    (name, seed), rms, line = case, dict[str, float](), baseline.linear
    for effect in world.hidden:
        part = world.truth - WORLDS[name][1](seed, without=effect).truth
        # Beside the baseline the effect counts as noise: by the true noise, not by what a fit that lacks it finds.
        rms[effect] = (
            float(np.sqrt(np.mean(not_held(line, part) ** 2 * line.variance))) / NOISE[name]
        )
    return rms


def _covered(calibration: bc.Calibration, world: World, powers: Any) -> dict[str, Any]:
    """Return fractions of readings and coefficients whose 95 % interval contains the truth, and interval widths."""
    row: dict[str, Any] = {}
    for kind, readings, truth in (
        ("fitted", None, world.truth),
        ("later", world.later, world.later_truth),
        ("other", world.other, world.other_truth),
    ):
        if truth is None:
            continue
        p = bc.predict(calibration, readings)
        row[kind] = float(np.mean(np.abs(p.mean - truth) <= Z * p.model_sd))
        row[f"{kind}_sd"] = float(np.sqrt(np.mean(p.model_sd**2)))
        row[f"{kind}_error"] = float(np.sqrt(np.mean((p.mean - truth) ** 2)))
    reference = calibration.reference[THERMOMETER.get(calibration.model.instrument.name, "T0")]
    assert isinstance(reference, float)
    for slot, names in powers.items():
        for name, truth in zip(names, world.about(slot, reference, len(names)), strict=True):
            draws = _draws(calibration, slot, name)
            row[f"{slot}.{name}"] = [float(np.mean(draws)), float(np.std(draws)), float(truth)]
    return row


def _draws(calibration: bc.Calibration, slot: str, name: str) -> np.ndarray:
    """Return draws of a baseline coefficient; for "zero(x)" those of the axis x, with the terms equivalent to it."""
    base, _, axis = slot.rstrip(")").partition("(")
    samples = calibration.samples(f"{base}.{name}")
    for other, factor in BESIDE.get(f"{base}.{name}", {}).items():
        if other in calibration.posterior:
            values = factor * calibration.samples(other)
            samples = samples + (values if values.ndim == samples.ndim else values[:, None])
    return samples[:, calibration.levels["axis"].index(axis)] if axis else samples


BANKS = tuple(Bank(f"wrong_model_{name}", partial(cases, name), campaign) for name in WORLDS)
# Two names of one function to first order, and laws without a formula by the family that they are of: play and slow
# hysteresis turn round, creep and a stretched exponential warm up, a memory is of lags, a saturation of temperature.
ONE = {
    **{"rate": "thermal_lag", "rate_head": "thermal_lag", "thermal_lag_slow": "thermal_lag"},
    **{"play": "hysteresis", "slow_hysteresis": "hysteresis", "memory": "thermal_lag"},
    **{"creep": "warm_up", "stretched": "warm_up", "saturation": "temperature", "root": "drift"},
}
BANDS = ((0.05, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 0.95), (0.95, 1.0))


def _family(name: str) -> str:
    """Return the family of an effect in any form."""
    slot, *cause = name.split(".")
    return ".".join((slot, *(ONE.get(c, c) for c in cause[:1])))


def _output(rows: Rows, which: str, readings: str) -> str:
    values = [row[which][readings] for row in rows if readings in row[which]]
    return f"{np.mean(values):.3f}" if values else "–"


def _coefficients(rows: Rows) -> str:
    listed = (v for row in rows for v in row["used"].values() if isinstance(v, list))
    return share(abs(mean - true) <= Z * sd for mean, sd, true in listed)


def _effects(rows: Rows, low: float, high: float) -> str:
    """Return how often named effects of a stated probability were true."""
    pairs = []
    for row in rows:
        stated, hidden = dict[str, float](), set(map(_family, row["hidden"]))
        for name, p in row["inclusion"].items():
            stated[_family(name)] = min(1.0, stated.get(_family(name), 0.0) + p)
        # What is said of an effect that was added is the probability that its name is right.
        stated |= {_family(name): p for name, p in row.get("stated", {}).items()}
        for name, p in row["missing"].items():
            stated.setdefault(_family(name), p)
        pairs += [(p, e in hidden) for e, p in stated.items() if "(" not in e]
    return stated_and_true(pairs, low, high)


def _named_where_open(rows: Rows) -> str:
    """Return how often names with a probability of at least 0.95 were right, where the verdict is reliable."""
    return _effects([row for row in rows if row["open"]], *BANDS[-1])


def _complete(rows: Rows, low: float, high: float) -> str:
    """Return how often models of a stated completeness had all effects that are detectable and matter."""
    pairs = []
    for row in rows:
        counted = {e for e in row["hidden"] if row["adds"][e] > MAX_UNNAMED_RMS} - {*row["unseen"]}
        if row["complete"] is not None:
            has_all = {*map(_family, counted)} <= {*map(_family, row["final"])}
            pairs.append((row["complete"], has_all))
    return stated_and_true(pairs, low, high)


CLAIMS: tuple[Claim, ...] = (
    *(
        (
            f"95 % intervals of the expected output, {words}: {what}",
            partial(_output, which=w, readings=r),
        )
        for w, what in (("used", "average"), ("best", "best structure"))
        for r, words in (("fitted", "fitted"), ("later", "new runs"), ("other", "another profile"))
    ),
    ("95 % intervals of the baseline's coefficients: average", _coefficients),
    ("verdict fails", lambda rows: share(not row["open"] for row in rows)),
    *(
        (f"{what}, stated {low:g} to {high:g}, true", partial(say, low=low, high=high))
        for what, say in (("an effect is present", _effects), ("complete", _complete))
        for low, high in BANDS
    ),
    ("an effect is present, stated 0.95 to 1, verdict holds, true", _named_where_open),
)
ABOUT = """
Campaigns of three instruments whose laws are not in the catalogue (a lag of two stages, saturating gradients, a
hysteresis that reverses gradually); in half, *no formula*: peaks, ripples, kinks and sawteeth in temperature, play,
memory, creep. Zero to two effects are hidden, at 0.05 to 5 plausible sizes: many are too small to detect. *Another
profile* exceeds the range by a fifth. *Expected*: the central 95 % for calibrated statements. *Complete*: no detectable
effect is missing whose part outside the baseline's span is above a fifth of the noise, rms.
"""


def results() -> dict[str, Rows]:
    """Return the rows of each instrument, with those without a formula separate."""
    groups = dict[str, Rows]()
    for name, bank in zip(WORLDS, BANKS, strict=True):
        for words, odd in ((name, False), (f"{name}, no formula", True)):
            groups[words] = [row for row in bank.rows if (row["seed"] >= NO_FORMULA) == odd]
    return groups


def render() -> pages.Texts:
    """Render the page from the stored results."""
    groups = results()
    days = [row["day"] for rows in groups.values() for row in rows]
    title = "Model misspecification"
    return pages.page(
        "wrong_model", title, "wrong_model", days, ABOUT, pages.claims_table(groups, CLAIMS)
    )
