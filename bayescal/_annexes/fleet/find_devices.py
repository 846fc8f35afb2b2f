"""Each device's structure searched by itself; then which share of the fleet has each effect.

The search is that of `calibrate`: the same structures, the same walk, the same posterior; what a fleet does without
are the checks and pictures of every step.

All devices together separate substitutes that no single device can. The fleet has an effect or not; if it has, any
share of its devices is as probable as another. Given the shares, devices are independent. What is known of one device
is the evidence of its structures; shares and structures are drawn in turn (Gibbs sampling: S. Geman and D. Geman, IEEE
Trans. Pattern Anal. 6 (1984) 721). Of one device alone, an effect is as probable as its search finds it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.special import expit

import bayescal as bc
from bayescal import workshop as ws

# Columns of the table of effects.
EFFECTS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]
# Probability from which an effect of a device is kept, and printed of the whole: as that of a noise law.
KEPT_PROBABILITY = 0.01
# Nats behind a device's best structure, up to which others are kept: D devices know the odds of a share up to about D,
# and ln 10⁶ = 13.8: no fleet of a million brings back what is farther behind.
BEHIND_NATS = 15.0

KEPT_STRUCTURES = 50  # structures of a device
MAX_EFFECTS = 3  # added to a device at most


@dataclass(frozen=True)
class Evidence:
    """Evidence of one device's readings on its structures."""

    # effect → probability, before the readings, that a device lacks it; what it cannot show is not named
    prior: Mapping[str, float]
    # sets of effects, all noise laws together → natural logarithm, up to a constant
    log_evidence: Mapping[tuple[str, ...], float]


@dataclass(frozen=True)
class DeviceStructure:
    """Effects missing from one device's model."""

    # effects, families: of the structure to use: forms, and what they are of
    effects: tuple[str, ...]
    families: frozenset[str]
    possible: frozenset[str]  # effects of which one is missing, with probability 0.95
    evidence: Evidence  # of its structures


def search_device(
    model: bc.Model,
    readings: bc.Measurements,
    candidates: tuple[bc.Effect, ...],
    reference: Mapping[str, Any],
) -> tuple[DeviceStructure, bc.Model, Mapping[str, float]]:
    """Search one device's structures; return the one to use, its model, and its φ by name at the mode.

    Raises:
        BayescalError: the readings lack what the model needs.
        TimeIsUp: the walk was ended early.
    """
    model.require(readings)
    constants = {**ws.reference_of(readings), **reference}
    structures, _ = ws.enumerate_structures(
        model, readings, constants, effects=candidates, widen_noise=True
    )
    structures = replace(structures, near_best_only=True)
    if stopped := ws.explore(ws.Library(structures), MAX_EFFECTS):
        raise ws.deadline.TimeIsUp(stopped)
    posterior = ws.Posterior.from_structures(structures)
    chosen = posterior.median_structure
    weighed = structures.evaluate(chosen)
    odds = {
        n: float(np.logaddexp.reduce([structures.log_odds[f] for f in forms]))
        for n, forms in structures.forms.items()
    }
    prior = {n: float(expit(of_family)) for n, of_family in odds.items()}
    structure = DeviceStructure(
        tuple(sorted(chosen.effects)),
        frozenset(posterior.space.families(chosen.effects)),
        frozenset(name for finding in posterior.findings for name in finding.effects),
        Evidence(prior, _weighed(posterior, odds)),
    )
    return structure, weighed.model, weighed.phi


def _weighed(
    posterior: ws.Posterior, log_odds: Mapping[str, float]
) -> dict[tuple[str, ...], float]:
    """Return log evidence of sets of effects, in whatever form, less that of the best."""
    total: dict[tuple[str, ...], float] = {}
    for structure, log_posterior in zip(posterior.structures, posterior.log_posterior, strict=True):
        effects = tuple(sorted(posterior.space.families(structure.effects)))
        log_evidence = log_posterior - sum(log_odds[name] for name in effects)
        total[effects] = float(np.logaddexp(total.get(effects, -np.inf), log_evidence))
    best = max(total.values())
    order = sorted(total, key=lambda effects: -total[effects])[:KEPT_STRUCTURES]
    return {e: round(total[e] - best, 6) for e in order if total[e] > best - BEHIND_NATS}


# Of Gibbs sampling: until shares are at rest, and those that are averaged.
BURN_IN, ROUNDS = 200, 1000
NONE, ALL = 1e-12, 1 - 1e-12  # shares, as far as their log odds are taken


def shares(devices: Sequence[Evidence], seed: int = 0, rounds: int = ROUNDS) -> pd.DataFrame:
    """Estimate the share of each effect, from all devices.

    Args:
        devices: what each of them says.
        seed, rounds: of the draws, and how many count.

    Returns:
        By effect: probability that any device has it (`in fleet`), mean of the number of devices that have it
        (`expected`) and of their share, and its 95 % interval if any device has it (`low`, `high`).
    """
    names = sorted({name for device in devices for name in device.prior})
    if not names:
        return pd.DataFrame(columns=EFFECTS[3:])
    # All devices' structures, one below the other, each with the effects that it has.
    sets = [effects for device in devices for effects in device.log_evidence]
    has_effect = np.array([[n in effects for n in names] for effects in sets], dtype=float)
    log_evidence = np.array([v for device in devices for v in device.log_evidence.values()])
    lengths = np.array([len(device.log_evidence) for device in devices])
    begins = np.cumsum(lengths) - lengths
    priors = [[d.prior[n] for d in devices if n in d.prior] for n in names]
    able, prior = np.array([*map(len, priors)]), np.array([np.mean(p) for p in priors])
    of_any = np.minimum(2 * prior, 0.5)  # half of it is then that of one device
    nowhere = of_any / (able + 1)  # the less probable, the more devices could show it and do not
    rng = np.random.default_rng(seed)

    def drawn(share: Float[np.ndarray, "e"]) -> Float[np.ndarray, "d e"]:
        """Draw a structure for each device, and return which effects each has."""
        inside = np.clip(share, NONE, ALL)
        weight = log_evidence + has_effect @ (np.log(inside) - np.log1p(-inside))
        weight += rng.gumbel(size=len(weight))  # the largest is a draw by weight
        picks = weight == np.repeat(np.maximum.reduceat(weight, begins), lengths)
        return has_effect[picks]

    share, has = prior, np.ones(len(names), dtype=bool)
    visible, counts, present = [], [], []
    for i in range(BURN_IN + rounds):
        each_has = drawn(np.where(has, share, 0.0))
        count = each_has.sum(axis=0).astype(int)
        share = rng.beta(1.0 + count, 1.0 + able - count)
        if i >= BURN_IN // 2:  # before, every effect may find its devices
            # The fleet has an effect surely where a device has.
            has = (count > 0) | (rng.random(len(count)) < nowhere / (nowhere + 1 - of_any))
        if i >= BURN_IN:
            visible.append(share)
            counts.append(count)
            present.append(has)
    low, high = np.quantile(visible, (0.025, 0.975), axis=0)
    columns = {
        "in fleet": np.mean(present, axis=0),
        "expected": np.mean(counts, axis=0),
        "share": np.mean(np.where(present, visible, 0.0), axis=0),
        "low": low,
        "high": high,
    }
    return pd.DataFrame(columns, index=names)


def common_model(
    model: bc.Model,
    structures: Sequence[DeviceStructure],
    table: pd.DataFrame,
    candidates: Sequence[bc.Effect],
) -> bc.Model:
    """Return the model that all devices of a fleet are compared by: with the named effects that any of them has.

    `table` is that of `effects_table`; `candidates` are the user's own.
    """
    in_fleet = {*table.loc[table["in fleet"] >= ws.settings().found_probability, "effect"]}
    named = {e.name: e for candidate in candidates for e in (candidate, *candidate.forms)}
    count = Counter(name for structure in structures for name in structure.effects)
    for name, _ in count.most_common():  # of a family its most frequent form
        effect = named.get(name) or model.instrument.effect(name)
        effects = {e.family or e.name for e in model.effects}
        family = effect.family or name
        if family in in_fleet and family not in effects and not effect.is_placeholder:
            model = model + effect
    return model


def effects_table(structures: Sequence[DeviceStructure], seed: int = 0) -> pd.DataFrame:
    """Return one row an effect, the most probable first.

    Columns: effect; devices whose own structure has it; in how many it is one of the effects of which one is missing.
    Then of all devices together: probability that any has it, how many are expected to, their share, and its 95 %
    interval if any device has it.
    """
    named = Counter(name for structure in structures for name in structure.families)
    possible = Counter(name for structure in structures for name in structure.possible)
    table = shares([structure.evidence for structure in structures], seed)
    table["effect"] = table.index
    table["devices"] = [named[name] for name in table.index]
    table["possible"] = [possible[name] for name in table.index]
    counted = (table["devices"] > 0) | (table["possible"] > 0)
    table = table[counted | (table["expected"] > KEPT_PROBABILITY)]
    order = {"by": ["expected", "devices"], "ascending": False, "ignore_index": True}
    return table.sort_values(**order)[EFFECTS]
