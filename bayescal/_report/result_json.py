"""Data of a trail, `result.json`, and chapters of a report: of trails in memory, or read back from a folder.

The schema is bayescal.result/2; numbers that are not finite become null. A chapter is of one
calibration, or of the search that led to it.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import Check, check
from bayescal._calibration.fit import load
from bayescal._calibration.leave_group_out import choose_groups
from bayescal._calibration.storage import current_name, identity
from bayescal._calibration.summary import directions_data, summary
from bayescal._core.annex import offered
from bayescal._core.as_json import as_json
from bayescal._core.errors import InputError, NotConverged
from bayescal._core.json_shape import read_json
from bayescal._core.result_table import ResultTable
from bayescal._core.settings import unusual
from bayescal._data.measurements import Measurements
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS
from bayescal._model.instrument import Instrument
from bayescal._model.noise_law import Noise
from bayescal._model.unknown_effect import covariate_in
from bayescal._report.whole_folder import AVERAGED, CALIBRATION, files_of, refuse_mixed
from bayescal._search.calibrate import step_of
from bayescal._search.discover import Discovery, discover
from bayescal._search.gate import gate
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
OVER_STRUCTURES = ("mean", "sd", "interval95", "probability", "given")  # of an unknown, averaged
FORMER = "bayescal.result/1"  # of 0.2.0, where `hyperparameters` were `spreads`
PACKAGES = (
    *("bayescal", "jax", "numpyro", "optimistix"),
    *("arviz-base", "arviz-stats", "numpy", "scipy"),
)


def result(trail: SearchPath) -> dict[str, Any]:
    """Convert all results of a calibration to plain data."""
    final = trail.final.calibration
    further = {*trail.calibration.model.names} - {*final.model.names}
    coefficients, hyperparameters = (
        [row for row in rows if row["effect"] not in further] for rows in summary(trail.calibration)
    )
    for row in (*coefficients, *hyperparameters):
        averaged = {k: row[k] for k in OVER_STRUCTURES}
        row["averaged"] = None if trail.average is None else averaged
        del row["probability"], row["given"]  # of a single structure: one, and the same
    tables: dict[str, list[dict[str, Any]]] = {k: [] for k in ("check", "pairs", "missing")}
    for i, step in enumerate(trail.steps):
        tables["check"] += [{"step": i, **row} for row in step.check.data()]
        tables["pairs"] += [{"step": i, **as_json(pair)} for pair in step.check.pairs]
        if step.discovery is not None:
            tables["missing"].append(missing_data(step.discovery, i, step.check))
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
                "claims": [claim.data() for claim in trail.gate.claims],
            },
            "other_path": None
            if trail.other_path is None
            else {
                **{k: v for k, v in as_json(trail.other_path).items() if k != "correlated"},
                "in_words": str(trail.other_path),
            },
            "search": search_data(trail),
            "steps": [step_data(s) for s in trail.steps],
            **tables,
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
    """Convert the structures that were compared, and the end of the search, to plain data."""
    search = trail.search
    if search is None:
        return None
    return {
        **{k: getattr(search, k) for k in ("weighed", "complete", "stopped")},
        "ending": trail.ending,
        "seconds": search.seconds,
        "structures": [
            {
                **{k: getattr(s, k) for k in ("effects", "noise", "log_evidence", "probability")},
                "correlated_noise": Noise.correlates(s.noise),
            }
            for s in search.structures
        ],
        "averaged_over": [
            {"effects": list(s.effects), "probability": s.probability} for s in trail.shares
        ],
    }


@cache
def versions(*further: str) -> dict[str, str]:
    numbers = {"python": platform.python_version()}
    for name in (*PACKAGES, *further):
        try:
            numbers[name] = version(name)
        except PackageNotFoundError:
            numbers[name] = "not installed"
    return numbers


def _source(readings: Measurements) -> dict[str, Any]:
    """Return the files of readings and the hashes of their bytes: one each, or lists where there are several."""
    files, sums = [s.file for s in readings.sources], [s.sha256 for s in readings.sources]
    file, sha256 = (names[0] if len(names) == 1 else names for names in (files, sums))
    return {"file": file, "sha256": sha256, "rows": len(readings)}


def _groups(readings: Measurements) -> dict[str, Any]:
    kind, members, _ = choose_groups(readings)
    counted = {g: len(readings.groups(g)[0]) for g in GROUPS}
    several = {k: n for k, n in counted.items() if n}
    return {**several, "left_out": kind, "left_out_count": len(members)}


def step_data(step: Step) -> dict[str, Any]:
    calibration = step.calibration
    evidence = calibration.log_evidence
    law = set(calibration.model.noise.parameters())
    fixed = {k: np.asarray(v) for k, v in calibration.model.fixed if k in law}
    names = (u.name for u in calibration.unknowns if u.kind == "noise")
    noise = {**{n: calibration.samples(n) for n in names}, **fixed}
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


def missing_data(discovery: Discovery, step: int, check: Check) -> dict[str, Any]:
    return {
        "step": step,
        "nothing_missing_probability": discovery.nothing_missing,
        "unnamed": list(discovery.unnamed),
        "latent": list(discovery.latent),
        "equivalent": [claim.data() for claim in discovery.equivalent],
        "unstated": discovery.unstated,
        "correlated_noise": discovery.correlated_noise,
        "noise_laws": discovery.noise,
        "sets": discovery.findings,
        "candidates": discovery.candidates,
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


def experiment_data(ranking: NextExperiment) -> dict[str, Any]:
    def expected(e: Any) -> list[dict[str, Any]]:
        pairs = e.expected.items()
        return [{"truth": truth, "rival": rival, "value": value} for (truth, rival), value in pairs]

    return {
        "members": list(ranking.members),
        "experiments": [
            {
                "name": e.name,
                "least_expected_log_bayes_factor": e.worst,
                "expected_log_bayes_factors": expected(e),
            }
            for e in ranking.experiments
        ],
    }


PICTURE = "loop.png"


@dataclass(frozen=True)
class Foreword:
    """A section before all chapters."""

    name: str  # its id in the page
    title: str  # above it
    note: str  # in small print below it
    verdict: str = ""  # its conclusion, in a box; empty for none
    bad: bool = False  # whether that is negative
    why: str = ""  # the reason of the verdict
    # headings, with labels and texts below each
    lists: tuple[tuple[str, list[tuple[str, str]]], ...] = ()
    table: tuple[str, ResultTable] | None = None  # with its caption


class Foreworded(Protocol):
    """Source of a section before a report: a laboratory's statements, decisions about limits."""

    def foreword(self, chapters: Sequence[Chapter]) -> Foreword: ...


@dataclass(frozen=True)
class Chapter:
    """One set of readings."""

    calibration: Calibration  # the last model's
    check: Check  # of its residuals
    data: dict[str, Any]  # all results, as in result.json
    folder: Path | None = None  # that it was read from; None for a result in memory
    # the last model's calibration averaged over structures; None where one has nearly all probability
    average: Calibration | None = None

    @property
    def used(self) -> Calibration:
        """Return calibration of all numbers of the report: the average over structures, where several are probable."""
        return self.calibration if self.average is None else self.average


def chapters(results: Iterable[Any], effects: Iterable[Effect] = ()) -> list[Chapter]:
    """Make a report's chapters of calibrations, trails, chapters or failed fits; raise InputError for others."""
    own_effects, accepted = tuple(effects), (Calibration, SearchPath, Chapter)
    ended = ((g, g.calibration if isinstance(g, NotConverged) else None) for g in results)
    several = [g if calibration is None else calibration for g, calibration in ended]
    wrong = [type(g).__name__ for g in several if not isinstance(g, accepted)]
    if wrong or not several:
        raise InputError(
            f"a report is of calibrations or trails, not of {', '.join(wrong) or 'nothing'}: give what bc.fit, "
            "bc.calibrate or bc.load returned"
        )
    trails = (trail_of(g, own_effects) if isinstance(g, Calibration) else g for g in several)
    return [t if isinstance(t, Chapter) else of_trail(t) for t in trails]


def of_trail(trail: SearchPath) -> Chapter:
    """Make the chapter of a trail in memory."""
    final = trail.final
    return Chapter(final.calibration, final.check, result(trail), average=trail.average)


def of_folder(
    folder: Path, effects: Iterable[Effect] = (), instruments: Iterable[Instrument] = ()
) -> Chapter:
    """Read a result folder's chapter; raise InputError if files are missing, unreadable or of two results."""
    missing = [n for n in (RESULT, CALIBRATION) if not (folder / n).is_file()]
    if missing:
        raise InputError(
            f"The folder {folder} has no {' and no '.join(missing)}: give a folder that `bayescal calibrate --out` "
            "wrote, or a saved calibration (…nc)"
        )
    data = _read_result(folder / RESULT)
    refuse_mixed(folder)
    parts = {"effects": tuple(effects), "instruments": tuple(instruments)}
    calibration = load(folder / CALIBRATION, **parts)
    fitted, stated, listed = identity(calibration), data.get("calibration"), files_of(folder)
    if not {RESULT, CALIBRATION} <= listed.keys() and stated != fitted:  # no manifest of one run
        raise InputError(
            f"{RESULT} and {CALIBRATION} in {folder} are of different fits: identity {stated} and {fitted}. Calibrate "
            f"again, or give {CALIBRATION} alone"
        )
    return Chapter(
        calibration,
        check(calibration),
        data,
        folder=folder,
        average=load(folder / AVERAGED, **parts) if AVERAGED in listed else None,
    )


def _read_result(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path)
        schema = data.get("schema")
        if schema == FORMER:
            rows = [{**r, "name": current_name(r["name"])} for r in data.pop("spreads", [])]
            schema, data = SCHEMA, {**data, "hyperparameters": rows}
        if schema != SCHEMA:
            raise ValueError(f"its schema is {schema!r}, not {SCHEMA!r}")
        for candidate in (c for step in data["missing"] for c in step["candidates"]):
            unnamed = covariate_in(candidate["effect"])
            candidate.setdefault("role", "unnamed" if unnamed else "named")  # since 0.2.1
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is no result of this version ({error}): calibrate again"
        ) from None
    return data


def trail_of(calibration: Calibration, effects: tuple[Effect, ...] = ()) -> SearchPath:
    """Make the trail of one calibration, with its check and missing effects; the user's own effects are candidates."""
    own_names = calibration.model.instrument.known
    candidates = (*(e for e in calibration.model.effects if e.name not in own_names), *effects)
    discovery = discover(calibration, effects=candidates) if calibration.verdict.ok else None
    step = replace(step_of(calibration), discovery=discovery)
    return SearchPath((step,), gate([step]), None)
