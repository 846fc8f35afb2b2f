"""Outlying devices of a fleet: their reference temperature, a coefficient or the noise differs from the others'.

All devices are fitted with one model at one reference temperature. Each quantity of a device is compared with its
predictive distribution given the other devices: for a value x of standard uncertainty √v in a normal population,

    (x − μ)/√(τ² + v + Var μ)  ~  t of ν degrees of freedom,     ν = (τ² + v)²/(1/Σw² + v²/r),     w = 1/(τ² + v)

with μ and τ² estimated from the inliers by restricted likelihood, Var τ² = 2/Σw², and r the degrees of freedom of v.
The inliers are found by forward search: starting from the middle half, which no outlier moves, devices within the
limits are added until the set is stable. For an inlier, μ and τ² are leave-one-out estimates (τ² by a Newton step).
A device that lacks an effect of the others has a coefficient near zero where theirs is not; one with a further effect,
the reverse. A noise σ of r degrees of freedom is compared by σ^(2/3), nearly normal with the relative variance 2/(9r).

The family-wise false-alarm rate is 1 %: over all devices and quantities, one fleet in 100 without outliers has one.
Sources: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood); F. E. Satterthwaite, Biometrics
Bull. 2 (1946) 110; E. B. Wilson and M. M. Hilferty, Proc. Natl. Acad. Sci. 17 (1931) 684.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from bayescal import workshop as ws
from bayescal._annexes.fleet.batch_result import FAMILY_WISE_ERROR, DeviceResult
from bayescal._annexes.fleet.population import estimate_population

FEWEST_DEVICES = 4  # devices, of fewer none is compared
ROUNDS = 50  # until nothing changes, at most
SAME_TEMPERATURE = 1.0  # °C, standard deviation of reference temperatures that are no different


def odd_devices(
    results: Iterable[DeviceResult], t0: pd.Series, of_noise: Collection[str]
) -> dict[str, list[str]]:
    """Return the devices of which a quantity is not like the others', and what is said of each.

    Args:
        results: fits by one model at one temperature.
        t0: reference temperatures of the devices' own readings by their names, °C.
        of_noise: names of the coefficients that are standard deviations of the noise.
    """
    good = {fit.device: fit for fit in results if fit.ok}
    count = Counter(name for fit in good.values() for name in fit.names)
    names = [name for name, n in count.items() if n == len(good) and "[" not in name]
    least = FAMILY_WISE_ERROR / max(1, len(good) * (len(names) + 1))
    odd: dict[str, list[str]] = {}
    t0 = t0.loc[[*good]].dropna()
    p, middle = predicted(t0.to_numpy(), np.full(len(t0), SAME_TEMPERATURE**2), np.inf, least)
    for device, at in t0.loc[p < least].items():
        text = f"measured about {ws.number(at)} °C, the others about {ws.number(middle)} °C"
        odd[str(device)] = [f"{text}: its values are not compared"]
    compared = [fit for device, fit in good.items() if device not in odd]
    freedom = np.array([max(1.0, fit.readings - len(names) + 1) for fit in compared])
    for name in names:
        values = np.array([fit[name] for fit in compared]).reshape(-1, 2)
        (mean, sd), known_by, power = values.T, freedom, 1.0
        variance = np.nan_to_num(sd) ** 2
        if name in of_noise:
            power, mean = 2 / 3, np.abs(mean)
            variance, known_by = np.median(mean) ** (2 * power) * 2 / (9 * freedom), np.inf
        p, middle = predicted(mean**power if power < 1 else mean, variance, known_by, least)
        usual = ws.number(abs(middle) ** (1 / power) if power < 1 else middle)
        for i in np.flatnonzero(p < least).tolist():
            unit = ws.unit_label(compared[i].units[compared[i].names.index(name)])
            text = f"{name} {ws.number(mean[i])}, of the others {usual} {unit}"
            odd.setdefault(compared[i].device, []).append(text.rstrip())
    return odd


def predicted(
    values: Float[np.ndarray, "n"],
    variance: Float[np.ndarray, "n"],
    freedom: Float[np.ndarray, "n"] | float,
    least: float,
) -> tuple[Float[np.ndarray, "n"], float]:
    """Return the two-sided p of each value in the predictive distribution of the usual ones, and their mean.

    Args:
        values: one of each device.
        variance: of each, as it is known by itself.
        freedom: degrees of freedom that these variances are known by.
        least: p below which a value is none of these.
    """
    p, mean = np.ones(len(values)), float("nan")
    if len(values) < FEWEST_DEVICES:
        return p, mean
    digits = np.finfo(float).eps * float(np.max(np.abs(values)))
    variance = np.maximum(variance, max(digits**2, 1e-200))
    away = np.abs(values - np.median(values))
    usual = away <= np.sort(away)[max(FEWEST_DEVICES, len(values) // 2 + 1) - 1]
    for _ in range(ROUNDS):
        mean, between, weight = estimate_population(values[usual], variance[usual])
        # Of one among them its own part is taken off: of the mean, and by a step of Newton of τ².
        own_weight = np.where(usual, 1 / (between + variance), 0.0)
        away = (values - mean) / (1 - own_weight / weight.sum())
        curvature = weight @ weight - own_weight**2
        pull = own_weight**2 * (values - mean) ** 2 / (1 - own_weight / weight.sum()) - own_weight
        total = np.maximum(between - pull / curvature, 0.0) + variance
        count = len(weight) - usual
        total_variance = count / (count - 1) / curvature + variance**2 / freedom
        t = np.abs(away) / np.sqrt(total + 1 / (weight.sum() - own_weight))
        p = 2 * stats.t.sf(t, total**2 / total_variance)
        now = p >= least
        if now.sum() < FEWEST_DEVICES or (now == usual).all():
            break
        usual = now
    return p, mean
