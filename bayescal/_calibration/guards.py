"""Guards: what a fit may not be, however well its optimiser converged."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from scipy.special import stdtr

from bayescal._calibration.claim import Claim
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.mixture import inclusion
from bayescal._calibration.summary import summary
from bayescal._core.formatting import number
from bayescal._core.parallel import on_one_thread
from bayescal._inference.density import Density
from bayescal._inference.laplace import across, find_mode, prior_draws
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, testable
from bayescal._model.parameters import bind
from bayescal._model.prior import LogUniform
from bayescal._model.terms import ColumnsOf

# p-value of a test that asks once for each covariate and in every step: hundreds in one session.
RARE_P = 1e-5
# Prior standard deviations from the prior's mean, beyond which readings and prior contradict each other.
CONFLICT_SD = 4.0
# Times the noise: what contributes less or more at a plausible size is in a wrong unit.
SCALE_RANGE = (1e-6, 1e6)
FREE_SIZES = 1e3  # times a plausible size, which is none any more
# Times a candidate's plausible size, which is known to an order of magnitude.
CANDIDATE_SIZES = 10.0
WIDER_CONTRACTION = -1.0  # contraction below which the posterior is wider than the prior can be
# Standard deviations between two modes, from which one does not describe the other.
MODES_APART_SD = 3.0
MODES_NEARLY_NATS = 3.0  # nats between two modes, below which one does not stand for both
LONGEST_RECORDS = 10.0  # lengths of the record, beyond which no time constant can be told
# Coefficients of an effect whose sizes are judged; more of them stand for a function, whose values are not sizes of a
# law.
LAW_COEFFICIENTS = 2

FEWEST_FREEDOM = 3  # degrees of freedom, below which the noise cannot be told
STARTS_TRIED = 3  # starts of the search for another mode
PRIOR = "prior.contradicted"


def conflicts(calibration: Fitted, accepted: Collection[str] = ()) -> list[Claim]:
    """Why the result of a fit is not reliable although it converged; empty for most.

    Args:
        calibration: the fit.
        accepted: names of coefficients, effects or hyperparameters that may contradict their priors.
    """
    coefficients, hyperparameters = summary(calibration)
    stands = {row["name"]: (row["mean"], 0.0) for row in coefficients}
    found = _against_priors(calibration, stands, accepted)
    coefficients, hyperparameters = (
        [row for row in rows if row["name"] not in accepted and row["effect"] not in accepted]
        for rows in (coefficients, hyperparameters)
    )
    keys = {name for one in calibration.confounders for name in one.coefficients}
    wider = {u.name for u in calibration.unknowns if u.key in keys}
    for row in coefficients:  # what is positive may well be larger than thought, and then wider
        if row["name"] in wider:
            continue
        if row["contraction"] is not None and row["contraction"] < WIDER_CONTRACTION:
            found.append(Claim("prior.widened", row["name"], contraction=row["contraction"]))
    return [
        *found,
        *_too_large(calibration, hyperparameters),
        *_beyond_the_known(calibration, accepted),
    ]


def off_scale(effect: Effect, contribution: float, noise: float, unit: str) -> list[Claim]:
    """What to look at where an effect at its plausible size is far too small or large for these readings.

    Args:
        effect: with a fixed plausible size and a basis of columns; nothing is said of others.
        contribution: prior size times basis, the largest over the readings, in `unit`.
        noise: standard deviation, likewise.
    """
    first = effect.coefficients[0]
    if not effect.columns or effect.is_placeholder or first.group_sd is not None or first.flat:
        return []
    low, high = SCALE_RANGE
    if contribution == 0 or noise == 0 or low <= contribution / noise <= high:
        return []
    sizes = {"contribution": float(contribution), "noise": float(noise)}
    return [Claim("effect.off_scale", effect.name, **sizes, unit=unit, own=first.unit)]


def effects_off_scale(calibration: Fitted) -> list[Claim]:
    """`off_scale` of the effects of a fitted model."""
    line, found = calibration.linear, []
    noise = math.sqrt(float(np.median(line.variance)))
    for effect in calibration.model.effects:
        own = [i for i in range(calibration.layout.size) if line.owners[i] == effect.name]
        if own:
            most = float(np.max(np.abs(line.nuisance[:, own])))
            found += off_scale(effect, most, noise, calibration.unit)
    return found


def without_priors(calibration: Fitted, accepted: Collection[str] = ()) -> list[Claim]:
    """Where the readings by themselves would put the first model's coefficients, if that is far from their priors.

    A prior that the readings contradict strongly enough wins: the noise takes up what the coefficient may not, and the
    fit shows nothing. So biases and scale factors of the instrument's own effects get a thousand times their widths.

    Args:
        calibration: the fit.
        accepted: names of coefficients or effects that may contradict their priors.
    """
    instrument = calibration.model.instrument
    own = {
        e.name
        for e in instrument.effects
        if len(e.coefficients) == 1 and instrument.slot(e.slot).unit in (instrument.unit, "1")
    }
    problem = Problem(
        calibration.layout, calibration.problem.record, dict.fromkeys(own, FREE_SIZES)
    )
    there = calibration.mode
    starts = [there.v, np.zeros_like(there.v)]
    mode = find_mode(problem, starts, there.covariance, there.x, still=0.01)
    _, found = Density(problem, mode.x, mode.flat, mode.v).at(mode.v)
    if found is None:
        return []
    mean, sd = found.mean, np.sqrt(np.diag(found.covariance))
    stands = {}
    for u in (u for u in calibration.unknowns if u.x is not None and u.effect in own):
        where = u.block.origin + float(mean[u.x])
        stands[u.name] = where, CONFLICT_SD * float(sd[u.x])
    return _against_priors(calibration, stands, accepted)


@on_one_thread
def doubts_of_the_mode(calibration: Fitted) -> list[Claim]:
    """Why the Gaussian fit about a mode, on which the evidence stands, does not describe the posterior.

    The curvature is not positive definite; or shapes far from the mode's explain the readings nearly as well, which is
    looked for from the best of some prior draws, and along shapes whose evidence has many maxima.
    """
    problem, mode = calibration.problem, calibration.mode
    if not math.isfinite(mode.log_evidence):
        return []
    if mode.indefinite:
        return [Claim("mode.indefinite")]
    shapes = [i for i, h in enumerate(problem.hypers) if h.kind == "shape"]
    sd = np.sqrt(np.diag(mode.covariance))

    def far(v: np.ndarray) -> np.ndarray:
        return np.abs(v - mode.v)[shapes] > MODES_APART_SD * sd[shapes]

    density = Density(problem, mode.x, mode.flat, mode.v)
    tried = np.concatenate([prior_draws(problem), *across(problem, mode.v)])
    starts = [v for v in tried if far(v).any()] if shapes else []
    for start in np.array(starts)[np.argsort(-density.values(np.array(starts)))[:STARTS_TRIED]]:
        other = find_mode(problem, [start], None, mode.x, still=0.01)
        behind = mode.log_evidence - other.log_evidence
        if far(other.v).any() and behind < MODES_NEARLY_NATS:
            apart = (problem.hypers[i] for i in np.array(shapes)[far(other.v)])
            here, there = problem.hyper(mode.v), problem.hyper(other.v)
            values = {
                h.name: f"{h.name} {number(here[h.name])} or {number(there[h.name])} {h.unit}"
                for h in apart
            }
            return [Claim("mode.two", *values, behind=behind, values=tuple(values.values()))]
    return []


def _against_priors(
    calibration: Fitted, stands: Mapping[str, tuple[float, float]], accepted: Collection[str]
) -> list[Claim]:
    """Coefficients that stand far from their priors' means, each (where, standard deviation)."""
    found = []
    baseline = {e.name for e in calibration.model.instrument.effects}
    for u in (u for u in calibration.unknowns if u.block is not None and u.prior_sd is not None):
        effect, c = u.block.effect, u.block.coefficient
        law = len(effect.coefficients) <= LAW_COEFFICIENTS
        if u.held or not law or not {effect.name, u.name}.isdisjoint(accepted):
            continue
        most = CONFLICT_SD * (1 if effect.name in baseline else CANDIDATE_SIZES)
        where, give = stands.get(u.name, (c.mean, 0.0))
        away = abs(where - c.mean) / c.size
        if away - give / c.size > most:
            sizes = {"where": where, "mean": c.mean, "size": c.size, "unit": c.unit}
            sizes |= {"away": away, "fall": 0.5 * away**2}
            found.append(Claim(PRIOR, u.name, effect.name, **sizes, cure=_look_at(effect)))
    return found


def _look_at(effect: Effect) -> str:
    """Which number may be wrong where a coefficient of this effect contradicts its prior."""
    if effect.kind != "constant":
        return "units"
    return "scale" if effect.quantity == "scale" else "zero and scale"


def _beyond_the_known(calibration: Fitted, accepted: Collection[str]) -> list[Claim]:
    """Dependences without a name that are larger than all that is known of the instrument could make together.

    A wrong sign or unit of an input is no missing effect, though a free curve along that input follows it.
    """
    unnamed = [e for e in calibration.model.effects if e.is_placeholder and e.name not in accepted]
    known, found = _known_effects(calibration) if unnamed else 0.0, []
    for effect in unnamed:
        here = float(np.std(calibration.linear.contribution(effect.name)))
        if known and here > CONFLICT_SD * known:
            sizes = {"here": here, "known": known, "unit": calibration.unit}
            found.append(Claim("curve.beyond_known", effect.name, **sizes))
    return found


def _known_effects(calibration: Fitted) -> float:
    """How much the instrument's own effects plausibly change the output over these readings, rms, output unit."""
    model, readings = calibration.model, calibration.readings
    own = (*model.instrument.effects, *model.instrument.candidates)
    effects = tuple(e for e in own if testable(e, readings) is None)
    layout = bind(Model(model.instrument, effects, model.noise), readings)[0]
    problem = Problem(layout, calibration.problem.record)
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    prior = problem.prior(hyper, np.ones(problem.size))
    slopes = problem.linearise(problem.start, hyper).jacobian * (prior.sd * prior.weight)
    return float(np.sqrt(np.sum(np.var(slopes, axis=0))))


def too_few(calibration: Fitted) -> list[Claim]:
    """Return the claim that the readings are too few to tell a noise that nobody stated from the unknowns."""
    layout, there = calibration.layout, inclusion(calibration)
    # Of an average over structures as many as there are on average.
    nuisances = {e.name for e in calibration.model.instrument.nuisances}
    names = [b.effect.name for b in layout.blocks if b.place in ("x", "phi")]
    free = round(sum(there[name] for name in names if name not in nuisances))
    size = len(calibration.readings)
    if size >= free + FEWEST_FREEDOM or not layout.positions("noise"):
        return []
    return [Claim("readings.too_few", count=size, free=free)]


def too_different(calibration: Fitted, accepted: Collection[str] = ()) -> list[Claim]:
    """Members of a group that differ far more than is plausible: the worst of each group.

    A spread that is learned takes up any difference, so that a sign or a unit that is another in one of them shows
    nowhere else. Its plausible size is known to an order of magnitude. Of a model that lacks an effect it says nothing:
    members take up what is missing.

    Args:
        calibration: the fit.
        accepted: names of coefficients or effects that may differ so.
    """
    rows, found = summary(calibration)[0], list[Claim]()
    stands = {
        row["name"]: row["mean"]
        for row in rows
        if row["name"] not in accepted and row["effect"] not in accepted
    }
    for b in calibration.layout.blocks:
        c = b.coefficient
        own = [n for n in b.member_names(calibration.levels) if n in stands]
        if c.group_sd is None or b.effect.weights is not None or not own:
            continue
        name = max(own, key=lambda n: abs(stands[n] - c.mean))
        away = abs(stands[name] - c.mean) / c.size
        if away > CONFLICT_SD * CANDIDATE_SIZES:
            sizes = {"where": stands[name], "mean": c.mean, "size": c.size, "unit": c.unit}
            whose = {"member": name, "group": c.per, "away": away}
            found.append(Claim("group.too_different", b.effect.name, **whose, **sizes))
    return found


def following_members(calibration: Fitted, accepted: Collection[str] = ()) -> list[Claim]:
    """Deviations of a group's members that follow what a term of the same slot follows.

    A term has one coefficient, within members as between them. Where a thermometer is late or noisy, the readings of
    a member deny what the members' means show, and their deviations take it up: the coefficient is of within alone,
    small and with a small uncertainty, and no residual is left. Deviations that are by chance follow nothing.
    Source: Y. Mundlak, Econometrica 46 (1978) 69.

    Args:
        calibration: the fit.
        accepted: names of coefficients or effects whose members may follow something.
    """
    means = {row["name"]: row["mean"] for row in summary(calibration)[0]}
    codes, found = calibration.problem.record.codes, list[Claim]()
    blocks = [b for b in calibration.layout.blocks if b.coefficient.per in codes]
    for b in blocks:
        names = b.member_names(calibration.levels)
        plain = b.coefficient.group_sd is not None and b.effect.weights is None
        if not plain or b.effect.name in accepted or not means.keys() >= {*names}:
            continue
        own, values = codes[str(b.coefficient.per)], np.array([means[name] for name in names])
        for term in calibration.model.effects:
            one = len(term.coefficients) == 1 and not (term.shapes or term.coefficients[0].per)
            if not (one and term.varies) or term.slot != b.effect.slot or term.name in accepted:
                continue
            column = calibration.problem.record.columns(ColumnsOf.of(term), ())[:, 0]
            count = np.bincount(own[own >= 0], minlength=len(values))
            total = np.bincount(own[own >= 0], column[own >= 0], minlength=len(values))
            there = count > 0
            mean, own_values = total[there] / count[there], values[there]
            if (p := uncorrelated(mean, own_values)) < RARE_P:
                r = float(np.corrcoef(mean, own_values)[0, 1])
                told = {"term": term.name, "along": term.varies, "group": b.coefficient.per}
                told |= {"r": r, "p": p, "members": int(there.sum())}
                found.append(Claim("group.follows_column", b.effect.name, term.name, **told))
    return found


def uncorrelated(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of two columns that know nothing of each other, by Student's t; not a number where one is constant."""
    free = len(one) - 2
    if np.ptp(one) == 0 or np.ptp(other) == 0 or free < 1:
        return float("nan")
    r = float(np.clip(np.corrcoef(one, other)[0, 1], -1, 1))
    with np.errstate(divide="ignore"):
        return float(2 * stdtr(free, -abs(r) * np.sqrt(free / np.float64((1 - r) * (1 + r)))))


def _too_large(calibration: Fitted, hyperparameters: list[dict[str, Any]]) -> list[Claim]:
    """Sizes of the output's quantity beyond its whole range, times of the model beyond ten records."""
    found, unit = [], calibration.unit
    reach = float(np.ptp(calibration.readings["output"]))
    sizes = _sizes_of_output(calibration)
    # An amplitude is a scale of coefficients, hardly told where there is one; what it makes of the output is judged.
    amplitudes = {e.measure_name for e in calibration.model.effects}
    for row in hyperparameters:
        if row["name"] in sizes - amplitudes and row["unit"] == unit and row["mean"] > reach > 0:
            told = {"mean": row["mean"], "reach": reach, "unit": unit}
            found.append(Claim("size.beyond_output", row["name"], **told))
    if calibration.readings.has("time"):
        record = float(np.ptp(calibration.readings["time"]))
        hypers = calibration.layout.hypers
        bounded = {h.name for h in hypers if isinstance(h.prior, LogUniform)}  # by the longest run
        found += [
            Claim(
                "time.beyond_record",
                row["name"],
                mean=row["mean"],
                records=LONGEST_RECORDS,
            )
            for row in hyperparameters
            if row["name"] not in sizes | bounded
            and row["unit"] == "s"
            and record > 0
            and row["mean"] > LONGEST_RECORDS * record
        ]
    return found


def _sizes_of_output(calibration: Fitted) -> set[str]:
    """Names of standard deviations and amplitudes of the output itself: no lengths, places, times or relative ones."""
    model = calibration.model
    sizes = set(model.noise.amplitudes)
    for effect in model.effects:
        for i, c in enumerate(effect.coefficients):
            if model.instrument.slot(c.slot or effect.slot).unit == calibration.unit:
                sizes |= {effect.group_sd_name(i), effect.measure_name}
    return sizes
