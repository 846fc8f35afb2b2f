"""Detection of outlying devices by their reference temperatures, coefficients and noise standard deviations.

All devices are fitted with one model at one reference temperature. Each quantity of a device is compared with its
predictive distribution given the other devices: for a value x of standard uncertainty √v in a normal population,

    (x − μ)/√(τ² + v + Var μ)  ~  t of ν degrees of freedom,     ν = (τ² + v)²/(1/Σw² + v²/r),     w = 1/(τ² + v)

with μ and τ² estimated from the inliers by restricted likelihood, Var τ² = 2/Σw², and r the degrees of freedom of v.
The inliers are found by forward search: starting from the middle half, which outliers do not affect, devices within
the limits are added until the set is stable. For an inlier, μ and τ² are leave-one-out estimates (τ² by a Newton step).
A device that lacks, or alone has, an effect differs in the effect's coefficient, which is near zero without the effect.
A noise σ of r degrees of freedom is compared by σ^(2/3), nearly normal with the relative variance 2/(9r).

The family-wise false-alarm rate is 1 %: of fleets without outliers, one in 100 has an outlying device or more.
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

MIN_DEVICES = 4  # for a comparison
MAX_ITERATIONS = 50  # of the forward search
T0_SD_DEGC = 1.0  # standard deviation of reference temperatures that count as equal


def find_outlying_devices(
    results: Iterable[DeviceResult], t0: pd.Series, noise_names: Collection[str]
) -> dict[str, list[str]]:
    """Find the outlying devices; return name of each → messages, one per outlying quantity.

    Args:
        results: fits with one model at one reference temperature.
        t0: device → reference temperature of its own readings, °C.
        noise_names: names of the noise standard deviations.
    """
    reliable_fits = {fit.device: fit for fit in results if fit.ok}
    counts = Counter(name for fit in reliable_fits.values() for name in fit.names)
    names = [name for name, n in counts.items() if n == len(reliable_fits) and "[" not in name]
    alpha = FAMILY_WISE_ERROR / max(1, len(reliable_fits) * (len(names) + 1))
    outliers: dict[str, list[str]] = {}
    t0 = t0.loc[[*reliable_fits]].dropna()
    p, t0_mean = compute_p_values(t0.to_numpy(), np.full(len(t0), T0_SD_DEGC**2), np.inf, alpha)
    for device, temperature in t0.loc[p < alpha].items():
        text = f"{ws.number(temperature)} °C, other devices near {ws.number(t0_mean)} °C"
        outliers[str(device)] = [f"measured near {text}: its values are not compared"]
    fits = [fit for device, fit in reliable_fits.items() if device not in outliers]
    residual_dof = np.array([max(1.0, fit.reading_count - len(names) + 1) for fit in fits])
    for name in names:
        moments = np.array([fit[name] for fit in fits]).reshape(-1, 2)
        (mean, sd), dof, power = moments.T, residual_dof, 1.0
        variance = np.nan_to_num(sd) ** 2
        if name in noise_names:
            power, mean = 2 / 3, np.abs(mean)
            variance, dof = np.median(mean) ** (2 * power) * 2 / (9 * residual_dof), np.inf
        p, centre = compute_p_values(mean**power if power < 1 else mean, variance, dof, alpha)
        inlier_mean = ws.number(abs(centre) ** (1 / power) if power < 1 else centre)
        for i in np.flatnonzero(p < alpha).tolist():
            unit = ws.unit_label(fits[i].units[fits[i].names.index(name)])
            text = f"{name} {ws.number(mean[i])}, other devices {inlier_mean} {unit}"
            outliers.setdefault(fits[i].device, []).append(text.rstrip())
    return outliers


def compute_p_values(
    values: Float[np.ndarray, "n"],
    variance: Float[np.ndarray, "n"],
    dof: Float[np.ndarray, "n"] | float,
    alpha: float,
) -> tuple[Float[np.ndarray, "n"], float]:
    """Return the two-sided p-value of each value under the inliers' predictive distribution, and the inliers' mean.

    Args:
        values: one per device.
        variance: variance of each value.
        dof: degrees of freedom of each variance.
        alpha: significance level: a value with a lower p-value is an outlier.
    """
    p, mean = np.ones(len(values)), float("nan")
    if len(values) < MIN_DEVICES:
        return p, mean
    rounding_error = np.finfo(float).eps * float(np.max(np.abs(values)))
    variance = np.maximum(variance, max(rounding_error**2, 1e-200))
    deviation = np.abs(values - np.median(values))
    is_inlier = deviation <= np.sort(deviation)[max(MIN_DEVICES, len(values) // 2 + 1) - 1]
    for _ in range(MAX_ITERATIONS):
        mean, tau2, weights = estimate_population(values[is_inlier], variance[is_inlier])
        # Leave-one-out estimates: an inlier is removed from μ, and from τ² by one Newton step.
        weight = np.where(is_inlier, 1 / (tau2 + variance), 0.0)
        deviation = (values - mean) / (1 - weight / weights.sum())
        curvature = weights @ weights - weight**2
        score = weight**2 * (values - mean) ** 2 / (1 - weight / weights.sum()) - weight
        marginal_variance = np.maximum(tau2 - score / curvature, 0.0) + variance
        count = len(weights) - is_inlier
        squared_error = count / (count - 1) / curvature + variance**2 / dof  # of that variance
        t = np.abs(deviation) / np.sqrt(marginal_variance + 1 / (weights.sum() - weight))
        p = 2 * stats.t.sf(t, marginal_variance**2 / squared_error)
        is_new_inlier = p >= alpha
        if is_new_inlier.sum() < MIN_DEVICES or (is_new_inlier == is_inlier).all():
            break
        is_inlier = is_new_inlier
    return p, mean
