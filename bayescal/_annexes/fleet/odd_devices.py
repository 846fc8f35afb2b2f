"""Which devices of a fleet are not like the others, and in what: in a value, its noise, or an effect that few have.

A value is compared with the median of all and their scatter about it, which no odd device moves: the variance between
devices is that at which half of all |z| are below 0.674. It is known as well as that of 0.37·n values is (P. J. Huber,
Robust Statistics (1981), section 5.1), and whether a value is beyond chance a t distribution of so many degrees of
freedom says, over all devices and values that are compared. A noise σ of ν degrees of freedom is compared by σ^(2/3),
nearly normal with the relative variance 2/(9ν) (E. B. Wilson and M. M. Hilferty, Proc. Natl. Acad. Sci. 17 (1931) 684).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats
from scipy.optimize import brentq

from bayescal._core.settings import settings
from bayescal.workshop import number, unit_label

# Devices of so small a posterior predictive p, expected by chance in the whole fleet, below which a device is said not
# to be like the others: one fleet in a hundred has such a device by chance.
STANDS_OUT_EXPECTED = 0.01
# Share of the devices up to which those that have an effect, or lack one, are named one by one.
FEW_SHARE = 0.1

NORMAL, EFFICIENCY = (
    0.67449,
    0.37,
)  # median |z| of a normal distribution, and how much as a scale it says
NOISE = "noise."  # what begins so is a standard deviation
ROUNDED = 1.0  # °C, to which reference temperatures agree that are no different


def beyond(
    values: Float[np.ndarray, "n"], variance: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], float]:
    """Two-sided p of each value as one of the others', and their median.

    Args:
        values: one of each device.
        variance: of each, as it is known by itself.
    """
    if not len(values):
        return np.ones(0), math.nan
    middle = float(np.median(values))
    away = np.abs(values - middle)

    def excess(between: float) -> float:
        """Of the median |z| over that of a standard normal distribution."""
        return float(np.median(away / np.sqrt(between + variance))) - NORMAL

    # What the devices differ by beside what each is uncertain by: none where that alone explains their scatter.
    between, most = 0.0, float(np.median(away) / NORMAL) ** 2
    if most > 0 and (np.median(variance) <= 0 or excess(0.0) > 0):
        least = 1e-12 * most
        between = brentq(excess, least, most) if excess(least) > 0 > excess(most) else most
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num(away / np.sqrt(between + variance), nan=0.0)
    return 2 * stats.t.sf(z, EFFICIENCY * (len(values) - 1)), middle


class Values(NamedTuple):
    """One unknown of several devices.

    Attributes:
        devices: their names.
        mean, sd: of the unknown, in `unit`; sd is NaN where it was held at its estimate.
        unit: of both.
    """

    devices: Sequence[str]
    mean: np.ndarray
    sd: np.ndarray
    unit: str


def odd_values(
    names: Sequence[str], values: Callable[[str], Values], facts: pd.DataFrame
) -> dict[str, list[str]]:
    """Devices of which a value is not like the others', and what is said of each.

    Args:
        names: of unknowns that all devices have.
        values: gives them by name.
        facts: one row a device, by its name: how many readings it has, and its reference temperature T0, °C.
    """
    least = STANDS_OUT_EXPECTED / max(1, len(facts) * (len(names) + 1))
    odd: dict[str, list[str]] = {}
    known = facts.loc[:, "T0"].dropna()
    p, middle = beyond(known.to_numpy(), np.full(len(known), ROUNDED**2))
    elsewhere = {str(known.index[i]): float(known.iloc[i]) for i in np.flatnonzero(p < least)}
    for device, t0 in elsewhere.items():
        said = f"measured about {number(t0)} °C, the others about {number(middle)} °C"
        odd[device] = [f"{said}: its values are not compared"]
    for name in names:
        own, noise = values(name), name.startswith(NOISE)
        here = [i for i, device in enumerate(own.devices) if device not in elsewhere]
        devices, mean = [own.devices[i] for i in here], own.mean[here]
        variance, power = np.nan_to_num(own.sd[here]) ** 2, 1.0
        if noise:
            power, mean = 2 / 3, np.abs(mean)
            free = np.maximum(facts["readings"].loc[devices].to_numpy() - len(names), 1)
            variance = np.median(mean) ** (2 * power) * 2 / (9 * free)
        p, middle = beyond(mean**power if noise else mean, variance)
        usual = number(middle ** (1 / power) if noise else middle)
        for i in np.flatnonzero(p < least).tolist():
            said = f"{name} {number(mean[i])}, of the others {usual} {unit_label(own.unit)}"
            odd.setdefault(devices[i], []).append(said.rstrip())
    return odd


def odd_effects(names: Sequence[str], shares: Mapping[str, Any]) -> dict[str, list[str]]:
    """Devices that have an effect which few have, or lack one which most have.

    Args:
        names: of the devices.
        shares: of each effect: `share` of the devices that have it, and the probability that `each` does.
    """
    odd: dict[str, list[str]] = {}
    few, found = FEW_SHARE, settings().found_probability
    for effect, one in shares.items():
        has, about = np.asarray(one.each), f"{one.expected:.0f} of {len(names)} devices"
        if one.share <= few:
            for i in np.flatnonzero(has >= found).tolist():
                odd.setdefault(names[i], []).append(f"has {effect}, as about {about}")
        elif one.share >= 1 - few:
            for i in np.flatnonzero(has <= 1 - found).tolist():
                odd.setdefault(names[i], []).append(f"lacks {effect}, which about {about} have")
    return odd
