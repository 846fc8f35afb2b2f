"""Noise laws that a record can tell, and what each is expected to gain: on residuals, coefficients held.

As with effects, what is computed here says only which refit to make.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.gaussian import LOG_2PI
from bayescal._inference.laplace import NOTHING_KNOWN, curvature
from bayescal._inference.noise_on_record import Whitening, total_log_density
from bayescal._inference.record import Record
from bayescal._model.frame import Frame
from bayescal._model.model import Model
from bayescal._model.noise_law import OFFERS, WHITE, Noise

# Readings from which a noise law can be told at all: a fourth moment is then known to a half.
FEWEST_FOR_NOISE = 30

LEVELS = (
    -2.0,
    0.0,
    1.0,
)  # coordinates of a law's further parameters, at which a maximum is looked for first
SHIFT = 1e-3  # of a coordinate, for slopes and curvatures
STEPS = 20  # of Newton's at most, none longer than this many prior standard deviations
LONGEST = 1.0
CURVED = 1e-2  # the same where slopes are exact
TOLERANCE = 1e-6  # relative, of a log density of thousands: a hundredth of a nat
FLAT = 0.05  # curvature of a coordinate below which its prior has taken over


def laws_over(model: Model, frame: Frame) -> dict[str, Noise]:
    """Further noise laws of a model on a record, by name; none where its own is not white, or readings are too few.

    Correlated, where there is time, and sums of such terms if asked for; heavy tails; scatter that follows a column.
    """
    # Coefficients of single readings are noise by another name: beside them, or with the noise held, no law is
    # weighed.
    together = any(c.per == "reading" for e in model.effects for c in e.coefficients)
    fixed = any(name.startswith("noise.") for name, _ in model.fixed)
    if together or fixed or frame.size < FEWEST_FOR_NOISE or not model.noise.first:
        return {}
    scale = model.noise.parameters()[WHITE]
    laws = [law for offer in OFFERS for law in offer(scale, frame)]
    laws = [law for law in laws if not law.refines or settings().finer_noise]
    return {law.name: law for law in (*laws, *model.instrument.noise_laws)}


def log_prior(laws: Mapping[str, Noise], name: str) -> float:
    """Of a law against the model's own, which is right with probability one half.

    The other kinds share the other half, columns that the scatter may follow one of these shares.
    """
    if name not in laws:
        return 0.0
    # P(own law) = ½, P(law) = ½/(kinds·laws of its kind): their ratio.
    kinds = [law.law for law in laws.values()]
    return -math.log(len(set(kinds)) * kinds.count(laws[name].law))


_Maximum = tuple[float, np.ndarray, np.ndarray]  # log density, where it is, minus its curvature


class OnResiduals(NamedTuple):
    """Log evidence of a noise law alone, and the coordinates of its parameters at the maximum, by name."""

    log_evidence: float
    hint: dict[str, float]


@on_one_thread
def on_residuals(
    law: Noise,
    record: Record,
    left: Float[np.ndarray, "n"],
    near: Mapping[str, float] = NOTHING_KNOWN,
) -> OnResiduals:
    """A law of known expected output, by Laplace; no evidence where nothing is left of the readings.

    Args:
        law: which.
        record: the readings.
        left: what the expected output leaves of them.
        near: coordinates of its parameters by name where the maximum may be, such as that of other residuals.
    """
    of_kind = _independent if law.independent else partial(_correlated, near=near)
    found = of_kind(law, record, left)
    if found is None:
        return OnResiduals(-math.inf, {})
    value, v, bent = found
    weights = np.maximum(np.linalg.eigvalsh(bent), FLAT)
    volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(weights)))
    return OnResiduals(value + volume, dict(zip(law.parameters(), v.tolist(), strict=True)))


def _correlated(
    law: Noise, record: Record, left: np.ndarray, near: Mapping[str, float]
) -> _Maximum | None:
    """Of a correlated Gaussian law, found along exact slopes."""
    priors = law.parameters()
    names, table = list(priors), left[:, None]

    def values(v: Float[np.ndarray, "... d"]) -> dict[str, Any]:
        return {name: prior.value(v[..., i]) for i, (name, prior) in enumerate(priors.items())}

    def of_priors(v: Float[np.ndarray, "... d"]) -> Float[np.ndarray, "..."]:
        return sum(np.asarray(p.log_density(v[..., i])) for i, p in enumerate(priors.values()))  # pyright: ignore[reportReturnType]

    def down(v: Float[np.ndarray, "d"]) -> tuple[float, np.ndarray]:
        whiten = Whitening(law, values(v), record)
        white, logdet = whiten.both(table)
        value = -0.5 * (float(np.sum(white**2)) + logdet + len(left) * LOG_2PI)
        # By coordinates: the slope by each parameter times that of the parameter by its coordinate, and the prior's.
        by = whiten.slopes(table)
        up, low = values(v + SHIFT), values(v - SHIFT)
        slope = np.array([by[n] * float(up[n] - low[n]) for n in names]) / (2 * SHIFT)
        each = SHIFT * np.eye(len(v))
        slope += (of_priors(v + each) - of_priors(v - each)) / (2 * SHIFT)
        return -(value + float(of_priors(v))), -slope

    # Slow noise hardly moves from one reading to the next: differences of neighbours are about the white part's.
    jumps = np.diff(left[record.in_time[0]])
    narrow = float(np.median(np.abs(jumps))) or float(np.sqrt(np.mean(left**2)))
    if not narrow > 0:
        return None
    stated = law.starts(record.frame.in_time(), left[record.in_time[0]])
    starts = np.array(
        [
            one
            for values in ({WHITE: narrow, **some} for some in stated)
            for one in itertools.product(
                *([p.coordinate(values[n])] if n in values else LEVELS for n, p in priors.items())
            )
        ]
        + ([[near[n] for n in names]] if near else [])
    )
    if not len(starts):
        return None
    hyper = {name: p.value(starts[:, i]) for i, (name, p) in enumerate(priors.items())}
    there = total_log_density(law, record, left[None], hyper) + of_priors(starts)
    found = minimize(
        down, starts[int(np.argmax(there))], jac=True, method="L-BFGS-B", tol=TOLERANCE
    )
    bends = curvature(lambda at: -down(at)[1], found.x, CURVED, -found.jac)
    return -float(found.fun), found.x, bends


def _independent(law: Noise, record: Record, left: np.ndarray) -> _Maximum | None:
    """Of an independent law, by Newton's steps on differences."""
    priors = law.parameters()

    def values(v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b"]:
        hyper = {name: p.value(v[:, i]) for i, (name, p) in enumerate(priors.items())}
        density = total_log_density(law, record, left[None], hyper)
        return density + sum(p.log_density(v[:, i]) for i, p in enumerate(priors.values()))

    white, scale = next(iter(priors.values())), float(np.sqrt(np.mean(left**2)))
    # 1.5 times the median absolute value is the standard deviation that outliers have not widened; the rms is that of
    # the law without outliers. One of them is near the maximum.
    narrow = 1.5 * float(np.median(np.abs(left)))
    scales = [white.coordinate(s) for s in (scale, narrow) if s > 0]
    if not scales:
        return None
    starts = np.array(list(itertools.product(scales, *[LEVELS] * (len(priors) - 1))))
    v = starts[int(np.argmax(values(starts)))]
    value, slope, bent = _quadratic(values, v)
    for _ in range(STEPS):
        weights, vectors = np.linalg.eigh(bent)
        # Newton with absolute eigenvalues: uphill also where the density bends up, between two maxima.
        step = vectors @ (vectors.T @ slope / np.maximum(np.abs(weights), FLAT))
        step *= min(1.0, LONGEST / max(float(np.max(np.abs(step))), 1e-300))
        trials = v + step * np.array([[1.0], [0.3], [0.1]])
        there = values(trials)
        if not there.max() > value + 1e-4:
            break
        v = trials[int(np.argmax(there))]
        value, slope, bent = _quadratic(values, v)
    return value, v, bent


def _quadratic(values, v: Float[np.ndarray, "d"]) -> tuple[float, np.ndarray, np.ndarray]:
    """Of a function of many points: its value, slope and negative curvature at one, by differences."""
    steps = SHIFT * np.eye(len(v))
    pairs = list(itertools.combinations(range(len(v)), 2))
    both = [steps[i] + steps[j] for i, j in pairs]
    points = v + np.array([0 * v, *steps, *-steps, *both, *(-b for b in both)])
    found = values(points)
    here, d = found[0], len(v)
    up, down = found[1 : d + 1], found[d + 1 : 2 * d + 1]
    second = np.diag(up + down - 2 * here)
    # f(v ± (sᵢ + sⱼ)) summed, less 2·f(v), is fᵢᵢ + fⱼⱼ + 2·fᵢⱼ in units of the step: the mixed derivative.
    for (i, j), b, c in zip(
        pairs, found[2 * d + 1 :], found[2 * d + 1 + len(pairs) :], strict=False
    ):
        second[i, j] = second[j, i] = 0.5 * (b + c - 2 * here - second[i, i] - second[j, j])
    return float(here), (up - down) / (2 * SHIFT), -second / SHIFT**2
