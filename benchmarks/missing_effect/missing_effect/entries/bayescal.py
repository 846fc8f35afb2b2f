"""bayescal's search: the posterior over sets of candidates and noise laws, as `bayescal calibrate` computes it.

Terms become effects, with the stated sizes as prior standard deviations and the stated ranges as ranges of shapes.
Their columns are computed by the task's formulas at fifteen values of a shape and interpolated. Unknown dependences
count as "outside". Probabilities are those of the listed structures, summed over noise laws: the search's evidence with
the data sheet's prior (`missing_effect.prior`) in place of its own, which allows any number of effects. The sizes in
the data sheet start at a third of the plausible one, normal priors at zero: the evidence of a structure is multiplied
by the posterior over the prior probability that its sizes are in the stated range (I. Klugkist & H. Hoijtink, Comput.
Stat. Data Anal. 51 (2007) 6367); the posterior is that of least squares. Predictions are the search's model average.

For a fleet with its thousands of readings only the search is run, followed by a fit of its result; the checks of each
step and leave-one-device-out would take `calibrate` five times as long. The noise law is white unless neighbouring
residuals are correlated. The probability of a set is then the product of those of the search's findings, in each of
which one member is missing or none.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import partial
from math import exp
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

import bayescal as bc
from missing_effect import prior
from missing_effect.regression import NODES, Regression, grid
from missing_effect.task import OUTSIDE, Task, Term

NUMBER = "1"  # everything is a plain number: the task says no more than that units agree
LABELS = ("run", "device")
# Standard errors of the correlation of neighbouring residuals, from which they correlate.
CORRELATE = 4.0
UNKNOWN = "unknown("  # begins the names of the search's descriptions of what has no name
TONE = "unknown(time, cycle)"  # without other noise a law of noise, as the data sheet has it
# Of what the data sheet has outside.
PLACES = ("temperature", "temperature rate", "time", "elapsed")
CURVES = 30  # descriptions along these, about
FURTHER_PRIOR = 0.03  # prior of each further effect, absent from the data sheet
SELDOM = 0.01  # least probability of that, for a candidate's columns are not quite the effect
SMALLEST = 1e-5  # probability of a set that is stated
ALONG = {"power": "column", "rate": "", "warm_up": "elapsed"}


def solve(task: Task) -> dict[str, Any]:
    columns: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    base = [_effect(term, task, columns) for term in task.base]
    candidates = [_effect(term, task, columns) for term in task.candidates]
    regression = Regression(task)
    instrument = _instrument(task, tuple(base), float(np.std(regression.left)))
    train, later = (_readings(task, instrument, columns, at) for at in (0, 1))
    model = instrument.baseline()
    if "device" in task.train:
        correlate = regression.correlated() * np.sqrt(len(task.train)) > CORRELATE
        sets, calibration = _of_fleet(model, train, candidates, columns, correlate)
        # Devices held out are those fitted, runs are new ones.
        predicted = bc.predict(calibration, later, new_groups=False)
    else:
        path = bc.calibrate(model, train, effects=candidates, ignore=tuple(columns), covariates=())
        predicted = bc.predict(path.calibration, later)
        sets = _restated(task, regression, path.search.structures) if path.search else {}
    return {"sets": sets, "mean": predicted.mean, "sd": predicted.sd}


def _restated(
    task: Task, regression: Regression, structures: Sequence[Any]
) -> dict[tuple[str, ...], float]:
    """Return the sets with probabilities from the search's evidences and the data sheet's prior."""
    whitened = Regression(task, regression.correlated())
    pair, count = prior.rivals(task), len(task.candidates)
    top = max(s.log_evidence for s in structures)
    sets: dict[tuple[str, ...], float] = {}
    for s in structures:
        named = {n for n in s.effects if not n.startswith(UNKNOWN)}
        curves = set(s.effects) - named
        weight = exp(s.log_evidence - top)
        weight *= _of_range(whitened if s.noise else regression, named)
        if curves and (s.noise or curves != {TONE}):
            of_places = all(n[len(UNKNOWN) : -1].split(",")[0] in PLACES for n in curves)
            weight *= prior.weight("outside", 0, count) / CURVES * of_places
            weight *= FURTHER_PRIOR ** (len(curves) + len(named) - 1)
        elif curves or s.noise:
            weight *= prior.weight("coloured", len(named), count) / prior.LAWS
        else:
            weight *= prior.weight("white", len(named), count)
        if pair and (curves or s.noise or len(named) != 1 or not named <= {*pair}):
            weight *= prior.ELSE
        sets[_named(s.effects)] = sets.get(_named(s.effects), 0.0) + weight
    total = sum(sets.values())
    if total == 0.0:  # the search lists nothing that the data sheet has
        return {_named(s.effects): s.probability for s in structures[:1]}
    return {names: p / total for names, p in sets.items()}


def _of_range(regression: Regression, named: Collection[str]) -> float:
    """Return the posterior over the prior probability that the sizes of some candidates are in the data sheet's range.

    Candidates with one coefficient are used, each independently, at the shape that fits best.
    """
    if not named:
        return 1.0
    chosen = [i for i, c in enumerate(regression.candidates) if c.name in named]
    x = np.hstack([regression.projected[i] for i in chosen])
    inverse = np.linalg.pinv(x.T @ x)
    coefficients = inverse @ (x.T @ regression.left)
    free = regression.y.size - regression.parameters - x.shape[1]
    variance = float(np.sum((regression.left - x @ coefficients) ** 2)) / free
    ratio, begin = 1.0, 0
    for i in chosen:
        at, width = begin, regression.projected[i].shape[1]
        begin += width
        if width == 1:
            size = regression.task.candidates[i].size
            mean, sd = coefficients[at] / size, np.sqrt(variance * inverse[at, at]) / size
            ratio *= max(_inside(mean, sd), SELDOM) / _inside(0.0, 1.0)
    return ratio


def _inside(mean: float, sd: float) -> float:
    """Return the probability that a normal variate is in the data sheet's range of sizes, of either sign."""
    low, high = prior.SIZES
    ends = np.array([[-high, -low], [low, high]])
    return float(np.diff(ndtr((ends - mean) / sd), axis=1).sum())


def _of_fleet(
    model: bc.Model,
    train: bc.Measurements,
    candidates: Sequence[bc.Effect],
    columns: dict[str, tuple[np.ndarray, np.ndarray]],
    correlate: bool,
) -> tuple[dict[tuple[str, ...], float], bc.Calibration]:
    """Return the sets with their probabilities, and a fit of the most probable one."""
    method = bc.LeastSquares(draws=200)
    first = bc.fit(model, train, method=method, strict=False)
    discovery = bc.discover(
        first, effects=candidates, ignore=tuple(columns), covariates=(), widen_noise=correlate
    )
    # Columns between nodes of a shape are linear: where the best shape is a node, least squares ends at a kink.
    return _sets(discovery), bc.fit(model + discovery.best, train, method=method, strict=False)


def _sets(discovery: bc.Discovery) -> dict[tuple[str, ...], float]:
    """Return the probabilities of sets as products over findings (one member missing, or none) and all other effects.

    Only sets that the data sheet allows for fleets are included: at most two effects, nothing outside.
    """
    remaining = {c.effect: c.probability or 0.0 for c in discovery.candidates}
    choices = []
    for finding in discovery.findings:
        shares = {n: remaining.pop(n, 0.0) for n in finding.effects}
        choices.append(
            {n: finding.probability * p / sum(shares.values()) for n, p in shares.items()}
        )
    choices += [{n: p} for n, p in remaining.items()]
    sets: dict[frozenset[str], float] = {frozenset(): 1.0}
    for choice in choices:
        options = {**choice, "": 1.0 - sum(choice.values())}
        tried = {(s, n): p * q for s, p in sets.items() for n, q in options.items()}
        sets = {s | {n} - {""}: p for (s, n), p in tried.items() if p > SMALLEST}
    probabilities: dict[tuple[str, ...], float] = {}
    for s, p in sets.items():
        if len(s) <= prior.MOST and not any(n.startswith(UNKNOWN) for n in s):
            probabilities[_named(s)] = p
    whole = sum(probabilities.values())
    return {s: p / whole for s, p in probabilities.items()} if probabilities else {(): 1.0}


def _named(effects: Iterable[str]) -> tuple[str, ...]:
    """Return a structure's effects as a set of names of the task."""
    return tuple(sorted({OUTSIDE if n.startswith(UNKNOWN) else n for n in effects}))


def _instrument(task: Task, base: tuple[bc.Effect, ...], scatter: float) -> bc.Instrument:
    """Return the task's instrument; the scale of the noise prior is the residual scatter of the base."""
    names = [c for c in task.train if c != "output"]
    columns = [bc.Column(n, None if n in LABELS else _unit(n)) for n in names]
    return bc.Instrument(
        name="task",
        title=task.name,
        columns=(*columns, bc.Column("output", NUMBER)),
        slots=(bc.Slot("output", NUMBER),),
        response=_response,
        effects=base,
        noise=bc.White(bc.HalfCauchy(scatter)),
    )


def _response(slots: Any, readings: Any) -> Any:
    return slots["output"]


def _unit(name: str) -> str:
    return {"time": "s", "temperature": "degC"}.get(name, NUMBER)


def _readings(
    task: Task,
    instrument: bc.Instrument,
    columns: dict[str, tuple[np.ndarray, np.ndarray]],
    at: int,
) -> bc.Measurements:
    """Return one part of the task, 0 to fit and 1 to predict, with the recorded columns and those of the terms."""
    frame = (task.train, task.holdout.assign(output=0.0))[at]
    arrays: dict[str, Any] = {str(n): frame[n].to_numpy() for n in frame}
    arrays |= {n: arrays[n].astype(str) for n in LABELS if n in arrays}
    with_units: dict[str, Any] = {name: pair[at] for name, pair in columns.items()}
    units = dict.fromkeys(with_units, NUMBER)
    return bc.Measurements.from_arrays(instrument, units=units, **arrays, **with_units)


def _effect(term: Term, task: Task, columns: dict[str, tuple[np.ndarray, np.ndarray]]) -> bc.Effect:
    """Return a term as an effect, and add its columns to `columns`."""
    prior = bc.Normal(0.0, term.size)
    if term.group:
        coefficient = bc.Coefficient(
            NUMBER, prior, per=term.group, group_sd=bc.HalfNormal(term.size)
        )
        in_files = [term.columns(f).sum(axis=1)[:, None] for f in (task.train, task.holdout)]
        if not in_files[1].any():
            in_files[1] = np.ones_like(in_files[1])
        trials = [(in_files[0], in_files[1])]
        coefficients = (coefficient,)
    else:
        trials = [
            (term.columns(task.train, **s), term.columns(task.holdout, **s))
            for s in grid(term, NODES)
        ]
        width = trials[0][0].shape[1]
        parts = [""] if width == 1 else [str(i) for i in range(width)]
        coefficients = tuple(bc.Coefficient(NUMBER, prior, part=p) for p in parts)
    names = []
    for train, later in trials:
        for i in range(train.shape[1]):
            names.append(f"c{len(columns)}")
            columns[names[-1]] = (train[:, i], later[:, i])
    shapes = tuple(bc.Shape(n, NUMBER, low, high) for n, (low, high) in term.shapes.items())
    basis = partial(_plain, tuple(names))
    if shapes:
        (low, high) = next(iter(term.shapes.values()))
        basis = partial(_between, tuple(names), low, high)
        basis = _BY_SHAPE[shapes[0].name](basis)
    along = ALONG.get(term.formula, "")
    return bc.Effect(
        term.name,
        "output",
        basis=basis,
        coefficients=coefficients,
        shapes=shapes,
        columns=tuple(names),
        equation=term.words,
        along=term.arguments["column"] if along == "column" else along,
    )


def _plain(names: tuple[str, ...], r: Any) -> Any:
    return jnp.stack([r[n] for n in names], axis=1)


def _between(names: tuple[str, ...], low: float, high: float, r: Any, value: Any) -> Any:
    """Interpolate columns between the values of a shape, linearly in its logarithm."""
    at = jnp.log(value / low) / jnp.log(high / low) * (len(names) - 1)
    at = jnp.clip(at, 0.0, len(names) - 1.0)
    weights = jnp.maximum(0.0, 1.0 - jnp.abs(at - jnp.arange(len(names))))
    return jnp.stack([r[n] for n in names], axis=1) @ weights


def _of_tau(between: Any, r: Any, tau: Any) -> Any:
    return between(r, tau)


def _of_width(between: Any, r: Any, width: Any) -> Any:
    return between(r, width)


_BY_SHAPE = {
    "tau": lambda between: partial(_of_tau, between),
    "width": lambda between: partial(_of_width, between),
}
