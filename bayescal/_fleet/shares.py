"""Which share of a fleet has each effect: all devices together separate substitutes that no single device can.

The fleet has an effect or not; if it has, any share of its devices is as probable as another. Given the shares, devices
are independent. What is known of one device is the evidence of its structures; shares and structures are drawn in turn
(Gibbs sampling: S. Geman and D. Geman, IEEE Trans. Pattern Anal. 6 (1984) 721). Of one device alone, an effect is as
probable as its search finds it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from bayescal._fleet.find_devices import DeviceStructure
from bayescal._fleet.fleet_settings import fleet_settings

BURN_IN, ROUNDS = 200, 1000
NONE, ALL = 1e-12, 1 - 1e-12  # shares, as far as their log odds are taken
COLUMNS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]


@dataclass(frozen=True)
class Evidence:
    """What one device's readings say of its structures.

    Attributes:
        prior: effect → probability, before the readings, that a device lacks it; what it cannot show is not named.
        log_evidence: sets of effects → natural logarithm, up to a constant.
    """

    prior: Mapping[str, float]
    log_evidence: Mapping[tuple[str, ...], float]


class Share(NamedTuple):
    """Of one effect.

    Attributes:
        in_fleet: probability that any device has it.
        share: of the devices that have it, its mean.
        low, high: of its 95 % interval, if any device has it.
        expected: number of devices that have it, its mean.
    """

    in_fleet: float
    share: float
    low: float
    high: float
    expected: float


def shares(devices: Sequence[Evidence], seed: int = 0, rounds: int = ROUNDS) -> dict[str, Share]:
    """The share of each effect, from all devices.

    Args:
        devices: what each of them says.
        seed, rounds: of the draws, and how many count.
    """
    names = sorted({name for device in devices for name in device.prior})
    if not names:
        return {}
    # All devices' structures, one below the other, each with the effects that it has.
    sets = [effects for device in devices for effects in device.log_evidence]
    has_effect = np.array([[n in effects for n in names] for effects in sets], dtype=float)
    log_evidence = np.array([v for device in devices for v in device.log_evidence.values()])
    lengths = np.array([len(device.log_evidence) for device in devices])
    begins = np.cumsum(lengths) - lengths
    priors = [[d.prior[n] for d in devices if n in d.prior] for n in names]
    able, prior = np.array([len(own) for own in priors]), np.array([np.mean(p) for p in priors])
    of_any = np.minimum(2 * prior, 0.5)  # half of it is then that of one device
    nowhere = of_any / (able + 1)  # the less probable, the more devices could show it and do not
    rng = np.random.default_rng(seed)

    def drawn(share: Float[np.ndarray, "e"]) -> Int[np.ndarray, "e"]:
        """How many devices have each effect, with a structure drawn for each device."""
        inside = np.clip(share, NONE, ALL)
        weight = log_evidence + has_effect @ (np.log(inside) - np.log1p(-inside))
        weight += rng.gumbel(size=len(weight))  # the largest is a draw by weight
        taken = weight == np.repeat(np.maximum.reduceat(weight, begins), lengths)
        return has_effect[taken].sum(axis=0).astype(int)

    share, has = prior, np.ones(len(names), dtype=bool)
    shown, counts, there = [], [], []
    for i in range(BURN_IN + rounds):
        count = drawn(np.where(has, share, 0.0))
        share = rng.beta(1.0 + count, 1.0 + able - count)
        if i >= BURN_IN // 2:  # before, every effect may find its devices
            # The fleet has an effect surely where a device has.
            has = (count > 0) | (rng.random(len(count)) < nowhere / (nowhere + 1 - of_any))
        if i >= BURN_IN:
            shown.append(share)
            counts.append(count)
            there.append(has)
    low, high = np.quantile(shown, (0.025, 0.975), axis=0)
    expected, in_fleet = np.mean(counts, axis=0), np.mean(there, axis=0)
    mean = np.mean(np.where(there, shown, 0.0), axis=0)
    columns = (in_fleet, mean, low, high, expected)
    return {n: Share(*(float(c[i]) for c in columns)) for i, n in enumerate(names)}


def effects_table(structures: Sequence[DeviceStructure], seed: int = 0) -> pd.DataFrame:
    """One row an effect, the most probable first.

    Columns: effect; devices whose own structure has it; in how many it is one of the effects of which one is missing.
    Then of all devices together: probability that any has it, how many are expected to, their share, and its 95 %
    interval if any device has it.
    """
    named = Counter(name for one in structures for name in one.effects)
    possible = Counter(name for one in structures for name in {n for s in one.sets for n in s})
    known = [Evidence(one.prior, {tuple(e): v for e, v in one.weighed}) for one in structures]
    rows = [
        [name, named[name], possible[name], one.in_fleet, one.expected, *one[1:4]]
        for name, one in shares(known, seed).items()
        if named[name] or possible[name] or one.expected > fleet_settings().kept
    ]
    rows.sort(key=lambda row: (-row[4], -row[1]))
    return pd.DataFrame(rows, columns=COLUMNS)
