"""Conversion of a search path to `result.json`, and chapters of a report from search paths or result folders.

The schema is bayescal.result/2; non-finite numbers become null. A chapter is of one calibration, or of its search.
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
from bayescal._calibration.storage import identity
from bayescal._calibration.summary import list_directions, summary
from bayescal._core.annex import load_entries
from bayescal._core.errors import InputError
from bayescal._core.json_data import as_json, read_json
from bayescal._core.result_table import ResultTable
from bayescal._core.settings import list_changed_settings
from bayescal._data.measurements import Measurements
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS
from bayescal._model.instrument import Instrument
from bayescal._model.noise_law import Noise
from bayescal._report.whole_folder import AVERAGED, CALIBRATION, read_hashes, refuse_mixed
from bayescal._search.calibrate import check_step
from bayescal._search.discover import Discovery, discover
from bayescal._search.gate import assess_last
from bayescal._search.next_experiment import NextExperiment
from bayescal._search.search_path import SearchPath, Step

RESULT = "result.json"
SCHEMA = "bayescal.result/2"
# Key of a step's noise in result.json → parameter of the noise law.
NOISE_KEYS = {
    **{"white": "white", "correlated": "correlated", "diffusion": "diffusion"},
    **{"tau": "correlated.time", "slope": "slope", "curvature": "curvature"},
    **{"proportional": "proportional", "freedom": "freedom"},
}
AVERAGED_KEYS = ("mean", "sd", "interval95", "probability", "given")  # of an averaged unknown
PACKAGES = (
    *("bayescal", "jax", "numpyro", "optimistix"),
    *("arviz-base", "arviz-stats", "numpy", "scipy"),
)


def result(path: SearchPath) -> dict[str, Any]:
    """Convert all results of a search path to plain data."""
    final = path.final.calibration
    excluded = {*path.calibration.model.names} - {*final.model.names}
    coefficients, hyperparameters = (
        [row for row in rows if row["effect"] not in excluded] for rows in summary(path.calibration)
    )
    for row in (*coefficients, *hyperparameters):
        row["averaged"] = None if path.average is None else {k: row[k] for k in AVERAGED_KEYS}
        del row["probability"], row["given"]  # trivial for a single structure
    tables: dict[str, list[dict[str, Any]]] = {k: [] for k in ("check", "pairs", "missing")}
    for i, step in enumerate(path.steps):
        tables["check"] += [{"step": i, **row} for row in step.check.to_json_data()]
        pairs = ((p.covariates, p.log_bayes_factor) for p in step.check.pairs)
        tables["pairs"] += [{"step": i, "against": c, "log_bayes_factor": f} for c, f in pairs]
        if step.discovery is not None:
            tables["missing"].append(convert_missing(step.discovery, i, step.check))
    verdict = final.verdict
    reasons = [*verdict.reasons, *([] if path.gate.ok else [path.gate.reason])]
    return as_json(
        {
            "schema": SCHEMA,
            "complete": path.complete,
            "calibration": identity(final),
            "instrument": final.model.instrument.name,
            "method": final.method,
            "seed": final.seed,
            "versions": versions(),
            "reference": {**final.reference, **final.hold_at},
            "fixed": dict(final.model.fixed),
            "settings": list_changed_settings(),
            "readings": {**_describe_source(final.readings), "groups": _group_data(final.readings)},
            "holdout": None if path.holdout is None else _describe_source(path.holdout),
            "flags": list(final.readings.flags),
            "gate": {
                "ok": path.gate.ok,
                "reason": path.gate.reason,
                "claims": [claim.to_json_data() for claim in path.gate.claims],
            },
            "other_path": None
            if path.other_path is None
            else {
                **{k: v for k, v in as_json(path.other_path).items() if k != "correlated"},
                "in_words": str(path.other_path),
            },
            "search": convert_search(path),
            "steps": [convert_step(s) for s in path.steps],
            **tables,
            "coefficients": coefficients,
            "hyperparameters": hyperparameters,
            **{k: v for add in load_entries("result") for k, v in add(final, path.average).items()},
            "identifiability": {"null_directions": list_directions(final)},
            "verdict": {
                "ok": path.ok,
                "reasons": list(dict.fromkeys(reasons)),
                "notes": list(verdict.notes),
            },
        }
    )


def convert_search(path: SearchPath) -> dict[str, Any] | None:
    """Convert the evaluated structures, and why the search ended, to plain data; None without a search."""
    search = path.search
    if search is None:
        return None
    return {
        **{k: getattr(search, k) for k in ("weighed", "complete", "stopped")},
        "ending": path.ending,
        "seconds": search.seconds,
        "structures": [
            {
                **{k: getattr(s, k) for k in ("effects", "noise", "log_evidence", "probability")},
                "correlated_noise": Noise.correlates(s.noise),
            }
            for s in search.structures
        ],
        "averaged_over": [
            {"effects": list(s.effects), "probability": s.probability} for s in path.shares
        ],
    }


@cache
def versions(*further: str) -> dict[str, str]:
    texts = {"python": platform.python_version()}
    for name in (*PACKAGES, *further):
        try:
            texts[name] = version(name)
        except PackageNotFoundError:
            texts[name] = "not installed"
    return texts


def _describe_source(readings: Measurements) -> dict[str, Any]:
    """Return the name and SHA-256 of the file of readings (lists if several), and the number of readings."""
    files, hashes = [s.file for s in readings.sources], [s.sha256 for s in readings.sources]
    file, sha256 = (texts[0] if len(texts) == 1 else texts for texts in (files, hashes))
    return {"file": file, "sha256": sha256, "rows": len(readings)}


def _group_data(readings: Measurements) -> dict[str, Any]:
    kind, members, _ = choose_groups(readings)
    nonzero = {g: n for g in GROUPS if (n := len(readings.groups(g)[0]))}
    return {**nonzero, "left_out": kind, "left_out_count": len(members)}


def convert_step(step: Step) -> dict[str, Any]:
    calibration = step.calibration
    evidence = calibration.log_evidence
    noise_parameters = set(calibration.model.noise.parameters())
    fixed_noise = {k: np.asarray(v) for k, v in calibration.model.fixed if k in noise_parameters}
    names = (u.name for u in calibration.unknowns if u.kind == "noise")
    noise = {**{n: calibration.samples(n) for n in names}, **fixed_noise}
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
            **{key: mean.get(f"noise.{name}") for key, name in NOISE_KEYS.items()},
        },
        "verdict": calibration.verdict,
    }


def convert_missing(discovery: Discovery, step: int, check: Check) -> dict[str, Any]:
    return {
        "step": step,
        "nothing_missing_probability": discovery.nothing_missing,
        "unnamed": list(discovery.unnamed),
        "latent": list(discovery.latent),
        "equivalent": [claim.to_json_data() for claim in discovery.equivalent],
        "unstated": discovery.unstated,
        "correlated_noise": discovery.correlated_noise,
        "noise_laws": discovery.noise,
        "sets": discovery.findings,
        "candidates": discovery.candidates,
        "unknown": [
            {
                "column": e.covariate,
                "size": abs(e.worst.size),
                "unit": check.unit,
                "log_bayes_factor": e.log_bayes_factor,
                "probability": 1 / (1 + math.exp(-min(max(e.log_bayes_factor, -700), 700))),
            }
            for e in check.entries
            if e.log_bayes_factor > 0
        ],
    }


def convert_ranking(ranking: NextExperiment) -> dict[str, Any]:
    def expected_rows(e: Any) -> list[dict[str, Any]]:
        pairs = e.expected.items()
        return [{"truth": truth, "rival": rival, "value": value} for (truth, rival), value in pairs]

    return {
        "members": list(ranking.members),
        "experiments": [
            {
                "name": e.name,
                "least_expected_log_bayes_factor": e.minimum,
                "expected_log_bayes_factors": expected_rows(e),
            }
            for e in ranking.experiments
        ],
    }


PICTURE = "loop.png"


@dataclass(frozen=True)
class Foreword:
    """A section of a report before its chapters."""

    name: str  # id of the section in the page
    title: str  # heading
    note: str  # small print below the section
    verdict: str = ""  # conclusion, in a box; empty for none
    is_negative: bool = False  # whether the verdict is negative
    reason: str = ""  # reason of the verdict
    # headings, with labels and texts below each
    lists: tuple[tuple[str, list[tuple[str, str]]], ...] = ()
    table: tuple[str, ResultTable] | None = None  # with its caption


class ForewordSource(Protocol):
    """Interface of objects that supply a foreword: a certificate's statements, conformity decisions."""

    def foreword(self, chapters: Sequence[Chapter]) -> Foreword: ...


@dataclass(frozen=True)
class Chapter:
    """The results of a calibration, or of the search that led to it, as a chapter of a report."""

    calibration: Calibration  # of the last model
    check: Check  # residual checks of the last model
    data: dict[str, Any]  # all results, as in result.json
    # the last model's calibration averaged over structures; None if one has nearly all probability
    average: Calibration | None = None

    @property
    def used(self) -> Calibration:
        """Return the calibration whose values the report states: the average over structures, if there is one."""
        return self.calibration if self.average is None else self.average


def chapters(results: Iterable[Any], effects: Iterable[Effect] = ()) -> list[Chapter]:
    """Build report chapters from calibrations, search paths or chapters; raise InputError for others or none."""
    user_effects, types, items = tuple(effects), (Calibration, SearchPath, Chapter), [*results]
    wrong_types = [type(g).__name__ for g in items if not isinstance(g, types)]
    if wrong_types or not items:
        raise InputError(
            f"a report needs calibrations or search paths, not {', '.join(wrong_types) or 'an empty list'}: give the "
            "results of bc.fit, bc.calibrate or bc.load"
        )
    paths = (to_search_path(g, user_effects) if isinstance(g, Calibration) else g for g in items)
    return [t if isinstance(t, Chapter) else build_chapter(t) for t in paths]


def build_chapter(path: SearchPath) -> Chapter:
    """Build the chapter of a search path in memory."""
    final = path.final
    return Chapter(final.calibration, final.check, result(path), average=path.average)


def read_chapter(
    folder: Path, effects: Iterable[Effect] = (), instruments: Iterable[Instrument] = ()
) -> Chapter:
    """Read the chapter of a result folder; raise InputError if files are missing, unreadable or of different fits."""
    missing = [n for n in (RESULT, CALIBRATION) if not (folder / n).is_file()]
    if missing:
        raise InputError(
            f"The folder {folder} lacks {' and '.join(missing)}: give a folder that `bayescal calibrate --out` "
            "wrote, or a saved calibration (.nc)"
        )
    try:
        data = read_json(folder / RESULT)
        if (schema := data.get("schema")) != SCHEMA:
            raise ValueError(f"its schema is {schema!r}, not {SCHEMA!r}")
    except (OSError, ValueError, AttributeError) as error:
        message = f"{folder / RESULT} is not a result of this version ({error}): calibrate again"
        raise InputError(message) from None
    refuse_mixed(folder)
    user_parts = {"effects": tuple(effects), "instruments": tuple(instruments)}
    calibration = load(folder / CALIBRATION, **user_parts)
    if (loaded_hash := identity(calibration)) != (stated_hash := data.get("calibration")):
        raise InputError(
            f"{RESULT} and {CALIBRATION} in {folder} are of different fits (SHA-256 {stated_hash} and {loaded_hash}): "
            f"calibrate again, or give {CALIBRATION} alone"
        )
    average = load(folder / AVERAGED, **user_parts) if AVERAGED in read_hashes(folder) else None
    return Chapter(calibration, check(calibration), data, average)


def to_search_path(calibration: Calibration, effects: tuple[Effect, ...] = ()) -> SearchPath:
    """Build a search path of one step from a calibration, checked; `effects` are further candidates."""
    catalogue = calibration.model.instrument.known
    candidates = (*(e for e in calibration.model.effects if e.name not in catalogue), *effects)
    discovery = discover(calibration, effects=candidates) if calibration.verdict.ok else None
    step = replace(check_step(calibration), discovery=discovery)
    return SearchPath((step,), assess_last([step]), None)
