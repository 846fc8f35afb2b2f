"""Search for the structure of each device, and estimation of the share of the fleet that has each effect.

The search is that of `calibrate`, without the checks and figures of each step.

Several devices can distinguish alternative effects that one device cannot. The model is hierarchical: the fleet has
an effect or not; if it has, the share of devices with it has a uniform prior; given the shares, devices are
independent, each with the evidences of its structures. Shares and structures are sampled in turn (Gibbs sampling: S.
Geman and D. Geman, IEEE Trans. Pattern Anal. 6 (1984) 721). For a single device, they agree with its search.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.special import expit, logit

import bayescal as bc
from bayescal import workshop as ws

EFFECT_COLUMNS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]
MIN_EXPECTED_DEVICES = 0.01  # expected number of devices above which an effect is tabulated
# Log evidence below that of a device's best structure, up to which others are stored. D devices determine the odds of a
# share up to about D, and ln 10⁶ = 13.8: structures further below are negligible even in a fleet of a million.
MAX_DEFICIT_NATS = 15.0
MAX_STRUCTURES_PER_DEVICE = 50  # stored
MAX_EFFECTS_PER_DEVICE = 3  # added by the search


@dataclass(frozen=True)
class DeviceStructure:
    """Result of one device's search: log evidences of its structures, effects' prior probabilities, effects found."""

    # effect → prior probability that a device has it; without effects that the readings cannot show
    prior: Mapping[str, float]
    # set of effects → natural logarithm of the evidence, summed over noise laws, up to a constant
    log_evidence: Mapping[tuple[str, ...], float]
    # effects, families: forms of effects in the median-probability structure, and the families of these forms
    effects: tuple[str, ...] = ()
    families: frozenset[str] = frozenset()
    possible: frozenset[str] = frozenset()  # in findings: sets of which one at least is missing


def search_device(
    model: bc.Model,
    readings: bc.Measurements,
    candidates: tuple[bc.Effect, ...],
    reference: Mapping[str, Any],
) -> tuple[DeviceStructure, bc.Model, Mapping[str, float]]:
    """Search one device's structures; return the result, the median-probability model, and its φ by name at the mode.

    Raises:
        BayescalError: the readings lack a column that the model needs.
        TimeIsUp: the deadline ended the search.
    """
    model.require(readings)
    constants = {**ws.reference_of(readings), **reference}
    structures, _ = ws.enumerate_structures(
        model, readings, constants, effects=candidates, widen_noise=True
    )
    structures = replace(structures, near_best_only=True)
    if stop_reason := ws.explore(ws.Library(structures), MAX_EFFECTS_PER_DEVICE):
        raise ws.deadline.TimeIsUp(stop_reason)
    posterior = ws.Posterior.from_structures(structures)
    median_structure = posterior.median_structure
    evaluated_structure = structures.evaluate(median_structure)
    log_odds = {
        n: float(np.logaddexp.reduce([structures.log_odds[f] for f in forms]))
        for n, forms in structures.forms.items()
    }
    prior = {name: float(expit(family_odds)) for name, family_odds in log_odds.items()}
    structure = DeviceStructure(
        prior,
        _sum_log_evidences(posterior, log_odds),
        tuple(sorted(median_structure.effects)),
        frozenset(posterior.space.families(median_structure.effects)),
        frozenset(name for finding in posterior.findings for name in finding.effects),
    )
    return structure, evaluated_structure.model, evaluated_structure.phi


def _sum_log_evidences(
    posterior: ws.Posterior, log_odds: Mapping[str, float]
) -> dict[tuple[str, ...], float]:
    """Return the log evidence of each set of effects, summed over their forms, relative to the largest."""
    sums: dict[tuple[str, ...], float] = {}
    for structure, log_posterior in zip(posterior.structures, posterior.log_posterior, strict=True):
        effects = tuple(sorted(posterior.space.families(structure.effects)))
        log_evidence = log_posterior - sum(log_odds[name] for name in effects)
        sums[effects] = float(np.logaddexp(sums.get(effects, -np.inf), log_evidence))
    peak = max(sums.values())
    best_sets = sorted(sums, key=lambda effects: -sums[effects])[:MAX_STRUCTURES_PER_DEVICE]
    return {e: round(sums[e] - peak, 6) for e in best_sets if sums[e] > peak - MAX_DEFICIT_NATS}


BURN_IN, SIZE = 200, 1000  # numbers of Gibbs samples: discarded, and averaged
MIN_SHARE, MAX_SHARE = 1e-12, 1 - 1e-12  # limits of a share, so that its log odds are finite


def estimate_shares(
    devices: Sequence[DeviceStructure], seed: int = 0, size: int = SIZE
) -> pd.DataFrame:
    """Estimate the share of the fleet that has each effect, from all devices jointly.

    Args:
        devices: search result of each device.
        seed: seed of the random numbers.
        size: number of Gibbs samples, without burn-in.

    Returns:
        Table by effect: probability that any device has it (`in fleet`), posterior mean of the number of devices with
        it (`expected`) and of their `share`, and the share's 95 % interval if any device has it (`low`, `high`).
    """
    names = sorted({name for device in devices for name in device.prior})
    if not names:
        return pd.DataFrame(columns=EFFECT_COLUMNS[3:])
    # Rows: the structures of all devices in turn.
    effect_sets = [effects for device in devices for effects in device.log_evidence]
    has_effect = np.array([[n in effects for n in names] for effects in effect_sets], dtype=float)
    log_evidence = np.array([v for device in devices for v in device.log_evidence.values()])
    lengths = np.array([len(device.log_evidence) for device in devices])
    starts = np.cumsum(lengths) - lengths
    priors = [[d.prior[n] for d in devices if n in d.prior] for n in names]
    # n_observable: number of devices whose readings could show the effect.
    n_observable, prior = np.array([*map(len, priors)]), np.array([np.mean(p) for p in priors])
    in_fleet_prior = np.minimum(2 * prior, 0.5)  # one device then has half of it
    unseen_prior = in_fleet_prior / (n_observable + 1)  # in the fleet, but in none of its devices
    unseen_probability = unseen_prior / (unseen_prior + 1 - in_fleet_prior)
    rng = np.random.default_rng(seed)

    def draw_effects(share: Float[np.ndarray, "e"]) -> Float[np.ndarray, "d e"]:
        """Draw a structure for each device; return a mask of the effects that it has."""
        clipped_share = np.clip(share, MIN_SHARE, MAX_SHARE)
        log_weight = log_evidence + has_effect @ (np.log(clipped_share) - np.log1p(-clipped_share))
        log_weight += rng.gumbel(size=len(log_weight))  # the largest is then a draw by weight
        is_drawn = log_weight == np.repeat(np.maximum.reduceat(log_weight, starts), lengths)
        return has_effect[is_drawn]

    share, in_fleet = prior, np.ones(len(names), dtype=bool)
    samples = []
    for i in range(BURN_IN + size):
        counts = draw_effects(np.where(in_fleet, share, 0.0)).sum(axis=0).astype(int)
        share = rng.beta(1.0 + counts, 1.0 + n_observable - counts)
        if i >= BURN_IN // 2:  # before, all effects are in the fleet, to reach devices
            in_fleet = (counts > 0) | (rng.random(len(counts)) < unseen_probability)
        if i >= BURN_IN:
            samples.append((in_fleet, counts, np.where(in_fleet, share, 0.0), share))
    *means, share_draws = map(np.array, zip(*samples, strict=True))
    limits = np.quantile(share_draws, (0.025, 0.975), axis=0)
    columns = (*(np.mean(draws, axis=0) for draws in means), *limits)
    return pd.DataFrame(dict(zip(EFFECT_COLUMNS[3:], columns, strict=True)), index=names)


def find_favoured_effects(structure: DeviceStructure, table: pd.DataFrame) -> tuple[str, ...]:
    """Return a device's most probable set of effects, given the fleet's expected shares in the table of effects."""
    share = table.set_index("effect")["share"].clip(MIN_SHARE, MAX_SHARE)
    odds, log_evidence = dict(logit(share)), structure.log_evidence
    prior = {s: sum(odds.get(n, logit(MIN_SHARE)) for n in s) for s in log_evidence}
    return max(log_evidence, key=lambda effects: log_evidence[effects] + prior[effects])


def add_effects(
    model: bc.Model,
    structures: Sequence[DeviceStructure],
    candidates: Sequence[bc.Effect],
    families: Collection[str],
) -> bc.Model:
    """Add the families of effects named `families` to a model, each in the form that most devices' structures have.

    Placeholders are not added; `candidates` are user-defined effects.
    """
    by_name = {e.name: e for candidate in candidates for e in (candidate, *candidate.forms)}
    effect_counts = Counter(name for structure in structures for name in structure.effects)
    for name, _ in effect_counts.most_common():  # of a family its most frequent form
        effect = by_name.get(name) or model.instrument.effect(name)
        effects = {e.family or e.name for e in model.effects}
        family = effect.family or name
        if family in families and family not in effects and not effect.is_placeholder:
            model = model + effect
    return model


def tabulate_effects(structures: Sequence[DeviceStructure], seed: int = 0) -> pd.DataFrame:
    """Tabulate the effects found in a fleet, one row per effect, in decreasing order of expected number.

    Columns: `effect`; `devices`: number whose structure has it; `possible`: number where it is in a set of effects of
    which at least one is missing. From all devices jointly: `in fleet`: probability that any has it; `expected`:
    expected number with it; `share`: their share, with its 95 % interval `low`, `high` if any device has it.
    """
    table = estimate_shares(structures, seed).rename_axis("effect").reset_index()
    for column, attribute in (("devices", "families"), ("possible", "possible")):
        counts = Counter(name for structure in structures for name in getattr(structure, attribute))
        table[column] = [counts[name] for name in table["effect"]]
    is_found = (table[["devices", "possible"]] > 0).any(axis=1)
    table = table[is_found | (table["expected"] > MIN_EXPECTED_DEVICES)]
    sort_options = {"by": ["expected", "devices"], "ascending": False, "ignore_index": True}
    return table.sort_values(**sort_options)[EFFECT_COLUMNS]
