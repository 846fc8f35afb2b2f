"""How a marginal likelihood moves with the parameters of Gaussian noise and with learned spreads, in closed form.

With M = [J | r], x integrated out, C the covariance of x and e the residuals at its mean, a parameter t of the noise
moves −½·(log|Σ| + log|A| + squares) by

    −½·tr(Σ⁻¹·∂Σ) + ½·Σ_c w_cᵀ·∂Σ·w_c,    w = Σ⁻¹·[J·C^½ | e],

so that one further solve serves all parameters. Correlated noise is B⁻¹·T·B⁻ᵀ, B y what is new in each reading and T
tridiagonal; then the same is said of T, and of B by its only entries beside the diagonal.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from bayescal._engine.assembly import NUDGE, Assembly, Values
from bayescal._engine.whitening import Recursion, Whitening, correlated_variance, variance_of
from bayescal._model.correlated_noise import CORRELATION_TIME, DIFFUSION


def noise_slopes(
    assembly: Assembly,
    v: Float[np.ndarray, "d"],
    white: Whitening,
    table: Float[np.ndarray, "n m"],
    whitened: Float[np.ndarray, "n m"],
) -> dict[int, float]:
    """Slopes of the log marginal likelihood by the coordinates of a Gaussian law's parameters.

    Args:
        assembly: the structure on its record.
        v: coordinates of φ.
        white: of the noise there.
        table: [J·C^½ | e], output unit.
        whitened: the same, whitened.
    """
    own = [i for i, kind in enumerate(assembly.kinds) if kind == "noise"]
    if white.recursion is None:
        by_variance = 0.5 * (np.einsum("nm,nm->n", whitened, whitened) - 1) / white.sd**2
        return {i: float(by_variance @ _variance_slope(assembly, v, i)) for i in own}
    by_name = _of_correlated(white.recursion, white, table, whitened, assembly.hyper(v))
    return {i: by_name[assembly.hypers[i].name] * assembly.value_slope(v, i) for i in own}


def even_slope(
    assembly: Assembly, v: Float[np.ndarray, "d"], squares: float, spent: float
) -> float:
    """By the coordinate of one white standard deviation: −(n − squares − tr C·JᵀJ) times the slope of its logarithm.

    Args:
        assembly: the structure on its record.
        v: coordinates of φ.
        squares: of the whitened residuals at the mean of x.
        spent: degrees of freedom that x took.
    """
    slope = assembly.value_slope(v, assembly.kinds.index("noise"))
    return float(-(assembly.record.size - squares - spent) * slope)


def spread_slope(
    assembly: Assembly, v: Float[np.ndarray, "d"], i: int, excess: Float[np.ndarray, "p"]
) -> float:
    """By the coordinate of a learned spread.

    Args:
        assembly: the structure on its record.
        v: coordinates of φ.
        i: where in φ the spread stands.
        excess: of each coefficient, (mean² + variance − 1) in units of its prior; 0 under a flat one.
    """
    up, down = v.copy(), v.copy()
    up[i] += NUDGE
    down[i] -= NUDGE
    sizes = [assembly.sizes.at(assembly.hyper(one)) for one in (up, down)]
    with np.errstate(all="ignore"):
        found = (np.log(sizes[0]) - np.log(sizes[1])) / (2 * NUDGE)
    return float(excess @ np.where(np.isfinite(found), found, 0.0))


def _variance_slope(assembly: Assembly, v: np.ndarray, i: int) -> Float[np.ndarray, "n"]:
    """Of each independent reading's variance, by differences: no product over the readings is asked for."""
    up, down = v.copy(), v.copy()
    up[i] += NUDGE
    down[i] -= NUDGE
    noise, record = assembly.noise, assembly.record
    at = [variance_of(noise, assembly.hyper(one), record, 0.0) for one in (up, down)]
    return (at[0] - at[1]) / (2 * NUDGE)


def _of_correlated(
    parts: Recursion,
    white: Whitening,
    table: Float[np.ndarray, "n m"],
    whitened: Float[np.ndarray, "n m"],
    hyper: Values,
) -> dict[str, float]:
    """By the logarithm of each parameter."""
    tau = hyper[CORRELATION_TIME]
    variance = correlated_variance(hyper)
    w = parts.factor.back(np.asfortranarray(whitened / white.sd[:, None]))
    inverse, inverse_beside = parts.factor.inverse()
    by_diagonal = 0.5 * (np.einsum("nm,nm->n", w, w) - inverse)
    by_beside = np.einsum("nm,nm->n", w[1:], w[:-1]) - inverse_beside  # both sides of it
    carry, before = parts.carry[1:], parts.white[:-1]
    by_white = by_diagonal.sum() + carry @ (by_diagonal[1:] * carry - by_beside)
    by_size = float(parts.fresh @ by_diagonal) * variance
    # A longer time carries more: B's entries, what is fresh (1 − carry²), what T has of the white noise before.
    carried = np.einsum("nm,nm->n", w[1:], table[parts.order][:-1])
    by_carry = carried - before * by_beside + 2 * carry * (before - variance) * by_diagonal[1:]
    longer = np.where(parts.step[1:] < 0, 0.0, carry * parts.step[1:] / tau)
    return {
        "noise.white": 2 * hyper["noise.white"] ** 2 * float(by_white),
        DIFFUSION: 2 * by_size,
        CORRELATION_TIME: by_size + float(longer @ by_carry),
    }
