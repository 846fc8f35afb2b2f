"""A trail as data: `result.json`, schema bayescal.result/2. Numbers that are not finite become null."""

from __future__ import annotations

import math
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from bayescal._calibration.check_result import Check
from bayescal._calibration.leave_group_out import groups_of
from bayescal._calibration.storage import identity
from bayescal._calibration.summary import directions_data, summary
from bayescal._core.annex import offered
from bayescal._core.as_json import as_json
from bayescal._core.settings import unusual
from bayescal._data.measurements import Measurements
from bayescal._model.frame import GROUPS
from bayescal._model.noise_law import Noise
from bayescal._search.discover import Discovery
from bayescal._search.next_experiment import NextExperiment
from bayescal._search.search_path import SearchPath, Step

RESULT = "result.json"
SCHEMA = "bayescal.result/2"
# A step's key of the noise → the unknown of a law, where it has it.
OF_NOISE = {
    **{"white": "white", "correlated": "correlated", "diffusion": "diffusion"},
    **{"tau": "correlated.time", "slope": "slope", "curvature": "curvature"},
    **{"proportional": "proportional", "freedom": "freedom"},
}
AVERAGED = ("mean", "sd", "interval95", "probability", "given")  # of an unknown, over structures
FORMER = "bayescal.result/1"  # of 0.2.0, where `hyperparameters` were `spreads`
PACKAGES = [
    "bayescal",
    "jax",
    "numpyro",
    "optimistix",
    "arviz-base",
    "arviz-stats",
    "numpy",
    "scipy",
]


def result(trail: SearchPath) -> dict[str, Any]:
    """Everything that a calibration found, as plain data."""
    final = trail.final.calibration
    further = {*trail.calibration.model.names} - {*final.model.names}
    coefficients, hyperparameters = (
        [row for row in rows if row["effect"] not in further] for rows in summary(trail.calibration)
    )
    for row in (*coefficients, *hyperparameters):
        averaged = {k: row[k] for k in AVERAGED}
        row["averaged"] = None if trail.average is None else averaged
        del row["probability"], row["given"]  # of a single structure: one, and the same
    found: dict[str, list[dict[str, Any]]] = {k: [] for k in ("check", "pairs", "allan", "missing")}
    for i, step in enumerate(trail.steps):
        found["check"] += [{"step": i, **row} for row in step.check.data()]
        found["pairs"] += [{"step": i, **as_json(pair)} for pair in step.check.pairs]
        if step.check.allan is not None:
            found["allan"].append({"step": i, **step.check.allan.data()})
        if step.discovery is not None:
            found["missing"].append(missing_data(step.discovery, i, step.check))
    verdict = final.verdict
    reasons = [*verdict.reasons, *([] if trail.gate.ok else [trail.gate.reason])]
    return as_json(
        {
            "schema": SCHEMA,
            "complete": trail.complete,
            "calibration": identity(final),
            "instrument": final.model.instrument.name,
            "method": final.method,
            "seed": final.seed,
            "versions": versions(),
            "reference": {**final.reference, **final.hold_at},
            "fixed": dict(final.model.fixed),
            "settings": unusual(),
            "readings": {**_source(final.readings), "groups": _groups(final.readings)},
            "holdout": None if trail.holdout is None else _source(trail.holdout),
            "flags": list(final.readings.flags),
            "gate": {
                "ok": trail.gate.ok,
                "reason": trail.gate.reason,
                "claims": [one.data() for one in trail.gate.claims],
            },
            "other_path": None
            if trail.other_path is None
            else {
                **{k: v for k, v in as_json(trail.other_path).items() if k != "correlated"},
                "in_words": str(trail.other_path),
            },
            "search": search_data(trail),
            "steps": [step_data(s) for s in trail.steps],
            **found,
            "coefficients": coefficients,
            "hyperparameters": hyperparameters,
            **{k: v for add in offered("result") for k, v in add(final, trail.average).items()},
            "identifiability": {"null_directions": directions_data(final)},
            "verdict": {
                "ok": trail.ok,
                "reasons": list(dict.fromkeys(reasons)),
                "notes": list(verdict.notes),
            },
        }
    )


def search_data(trail: SearchPath) -> dict[str, Any] | None:
    """The structures that were weighed, and why the search ended."""
    search = trail.search
    if search is None:
        return None

    def structure(s: Any) -> dict[str, Any]:
        noise = {"noise": s.noise, "correlated_noise": Noise.correlates(s.noise)}
        weight = {"log_evidence": s.log_evidence, "probability": s.probability}
        return {"effects": list(s.effects), **noise, **weight}

    return {
        "weighed": search.weighed,
        "complete": search.complete,
        "stopped": search.stopped,
        "ending": trail.ending,
        "seconds": search.seconds,
        "structures": [structure(s) for s in search.structures],
        "averaged_over": [
            {"effects": list(s.effects), "probability": s.probability} for s in trail.shares
        ],
    }


@cache
def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _source(readings: Measurements) -> dict[str, Any]:
    files = [s.file for s in readings.sources]
    return {
        "file": files[0] if len(files) == 1 else files,
        "sha256": hashes(readings),
        "rows": len(readings),
    }


def hashes(readings: Measurements) -> str | list[str]:
    """Of the bytes of the file, or of each."""
    found = [s.sha256 for s in readings.sources]
    return found[0] if len(found) == 1 else found


def _groups(readings: Measurements) -> dict[str, Any]:
    kind, members, _ = groups_of(readings)
    counted = {g: len(readings.groups(g)[0]) for g in GROUPS}
    several = {k: n for k, n in counted.items() if n}
    return {**several, "left_out": kind, "left_out_count": len(members)}


def step_data(step: Step) -> dict[str, Any]:
    calibration = step.calibration
    evidence = calibration.log_evidence
    law = set(calibration.model.noise.parameters())
    held = {k: np.asarray(v) for k, v in calibration.model.fixed if k in law}
    names = (u.name for u in calibration.unknowns if u.kind == "noise")
    noise = {**{n: calibration.samples(n) for n in names}, **held}
    noise |= calibration.model.noise.derived(noise)
    mean = {n: float(values.mean()) for n, values in noise.items()}
    return {
        "effects": list(calibration.model.names),
        "added": step.added,
        "dropped": [],  # a search adds; the key is of the schema
        **step.errors(),
        "log_evidence": None if evidence is None else {"value": evidence[0], "se": evidence[1]},
        "noise": {
            "law": calibration.model.noise.name,
            **{key: mean.get(f"noise.{name}") for key, name in OF_NOISE.items()},
        },
        "verdict": calibration.verdict,
    }


def missing_data(found: Discovery, step: int, check: Check) -> dict[str, Any]:
    return {
        "step": step,
        "nothing_missing_probability": found.nothing_missing,
        "unnamed": list(found.unnamed),
        "latent": list(found.latent),
        "equivalent": [one.data() for one in found.equivalent],
        "unstated": found.unstated,
        "correlated_noise": found.correlated_noise,
        "noise_laws": found.noise,
        "sets": found.sets,
        "candidates": found.candidates,
        "unknown": [
            {
                "column": e.against,
                "size": abs(e.worst.size),
                "unit": check.unit,
                "log_bayes_factor": e.log_bayes_factor,
                "probability": 1 / (1 + math.exp(-min(max(e.log_bayes_factor, -700), 700))),
            }
            for e in check.entries
            if e.log_bayes_factor > 0
        ],
    }


def experiment_data(found: NextExperiment) -> dict[str, Any]:
    def expected(e: Any) -> list[dict[str, Any]]:
        each = e.expected.items()
        return [{"truth": truth, "rival": rival, "value": value} for (truth, rival), value in each]

    return {
        "members": list(found.members),
        "experiments": [
            {
                "name": e.name,
                "least_expected_log_bayes_factor": e.worst,
                "expected_log_bayes_factors": expected(e),
            }
            for e in found.experiments
        ],
    }
