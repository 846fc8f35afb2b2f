"""Reading and search of one faulty record, and the verdict: right, said (reported), or silently wrong.

*Right*: the readings are accepted; each true coefficient in the final model is within 3.3 posterior standard deviations
of its mean (0.1 % of correct answers are not, for each); and the error of a second campaign is at most 1.2 times the
expected one. That is the root sum of squares of the oracle's error (the true structure fitted to the remaining rows of
the record before the fault) and of the final model's own standard uncertainty of the output: a model that knows little
and says so is right. Of that uncertainty at most 30 times the oracle's counts, for a model can be so uncertain that it
is of no use.

*Said*: the file is refused, or the search refuses it and the reason, or a flag, names the cause; or `trail.ok` is
False; or a flag of the readings, a note that terms are confounded, or an added effect names the cause. *Wrong*:
neither. A right answer that is also said counts as right; if a sentence is required, as for hold-out data that are
training data, only with that sentence. *Crash*: the search ends in an error that is not a refusal, or in one whose
sentence is about something else.
"""

from __future__ import annotations

import re
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal._calibration.summary import summary
from benchmarks.spoilt_records import of_clock, of_columns, of_output, of_rows  # noqa: F401  they enter their kinds
from benchmarks.spoilt_records.kinds import Kind
from benchmarks.spoilt_records.subject import LATER, Campaign, Columns, Subject

METHOD = bc.LeastSquares(draws=1000)
MOST = 3  # effects to add
LIMIT = 120.0  # s of search
AWAY = 3.3  # posterior standard deviations
WORSE = 1.2  # times the error that there should be
# In notes that the result carries, of what these readings cannot tell.
OPEN = re.compile("are confounded in these readings|^Not decidable from these readings")
MAX_SD = 30.0  # largest counted ratio of a model's standard uncertainty to the oracle's


def judged(subject: Subject, kind: Kind, seed: int) -> dict[str, Any]:
    """Judge one record of a kind; return its outcome and verdict."""
    hides = None if kind.hides is None else kind.hides(subject)
    campaign = subject.campaign(seed, hides)
    start = time.perf_counter()
    row: dict[str, Any] = {"kind": kind.name, "seed": seed, "hidden": campaign.hidden}
    try:
        files = _files(subject, kind, campaign, seed)
    except bc.BayescalError as refusal:
        row |= {"verdict": "said", "refused": type(refusal).__name__, "says": [str(refusal)]}
        return row | {"seconds": time.perf_counter() - start}
    try:
        trail = _calibrated(*files)
    except bc.BayescalError as refusal:
        # What is odd in a file is said when it is read, before a search refuses it.
        messages = [s for s in (str(refusal), *files[0].flags) if re.search(kind.says, s)]
        row |= {"verdict": "said" if messages else "crash", "refused": type(refusal).__name__}
        return row | {"says": messages or [str(refusal)], "seconds": time.perf_counter() - start}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, {place.name}"
        row |= {
            "verdict": "crash",
            "refused": "",
            "says": [f"{type(error).__name__}: {error} ({where})"],
        }
        return row | {"seconds": time.perf_counter() - start}
    row["seconds"] = time.perf_counter() - start
    return row | _verdict(subject, kind, campaign, seed, trail)


def _files(
    subject: Subject, kind: Kind, campaign: Campaign, seed: int
) -> tuple[bc.Measurements, bc.Measurements | None, bc.Model]:
    """Return the file and the hold-out data given with it, as they are read, and the initial model."""
    record, further = campaign.record, None
    if kind.of_holdout:
        source = campaign.record if kind.of_training else campaign.holdout
        spoilt = kind.spoil(source, subject, _generator(kind, seed + LATER))
        further = read(subject, spoilt, campaign.units)
    else:
        record = kind.spoil(record, subject, _generator(kind, seed))
    readings = read(subject, record, campaign.units)
    return readings, further, subject.instrument.for_readings(readings).baseline()


def _calibrated(
    readings: bc.Measurements, further: bc.Measurements | None, model: bc.Model
) -> bc.SearchPath:
    """Run the search on a file."""
    return bc.calibrate(
        model, readings, holdout=further, method=METHOD, max_effects=MOST, time_limit=LIMIT
    )


def _generator(kind: Kind, seed: int) -> np.random.Generator:
    return np.random.default_rng([crc32(kind.name.encode()), seed])


def read(
    subject: Subject, columns: Columns, units: dict[str, str], *, anything: bool = False
) -> bc.Measurements:
    """Write a file as a user would, and read it.

    Args:
        subject: subject of the readings.
        columns: columns of the file.
        units: units of its numeric columns.
        anything: accept readings at a single temperature.
    """
    units = {"case_temperature": "degC", **units}
    headers = {f"{n} [{units[n]}]" if n in units else n: cells for n, cells in columns.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        pd.DataFrame(headers).to_csv(path, index=False)
        return bc.read(path, subject.instrument, allow_one_temperature=anything)


def _verdict(
    subject: Subject, kind: Kind, campaign: Campaign, seed: int, trail: bc.SearchPath
) -> dict[str, Any]:
    """Compare the outcome with the truth."""
    final = trail.final.calibration
    base = {e.name for e in trail.steps[0].calibration.model.effects}
    added = [n for n in final.model.names if n not in base]
    named = [s for s in final.readings.flags if re.search(kind.says, s)]
    named += [s for s in final.verdict.notes if OPEN.search(s) and re.search(kind.says, s)]
    named += [f"found: {n}" for n in added if re.search(kind.finds, n)]
    sentences = [*([] if trail.ok else [trail.gate.reason]), *named]
    away = _away(subject, kind, campaign, seed, final)
    later = campaign.holdout
    if kind.alike:
        later = kind.spoil(later, subject, _generator(kind, seed + LATER))
    error, stated = error_of(subject, final, read(subject, later, campaign.units, anything=True))
    due, oracle = ORACLES.of(subject, kind, campaign, seed)
    carried = kind.noise(subject) * subject.noise
    due = float(np.sqrt(due**2 + carried**2 + min(stated, MAX_SD * np.hypot(oracle, carried)) ** 2))
    right = all(abs(z) < AWAY for z in away.values()) and error <= WORSE * due
    right &= bool(named) or not kind.must_say
    verdict = "right" if right else "said" if sentences else "wrong"
    return {
        "verdict": verdict,
        "refused": "",
        "says": sentences,
        "ok": trail.ok,
        "names_cause": bool(named) or any(re.search(kind.says, s) for s in sentences),
        "added": added,
        "noise": final.model.noise.law,
        "away": away,
        "error": error,
        "stated": stated,
        "due": due,
        "unit": final.unit,
    }


def _away(
    subject: Subject, kind: Kind, campaign: Campaign, seed: int, final: bc.Calibration
) -> dict[str, float]:
    """Return the distance of each true coefficient in the model from its mean, in posterior standard deviations."""
    if kind.renamed:
        return {}
    true = subject.truth(campaign.hidden, final.hold_at, seed, kind.changed(subject))
    rows = {row["name"]: row for row in summary(final)[0]}
    return {
        name: (rows[name]["mean"] - value) / max(rows[name]["sd"], 1e-12 * abs(value), 1e-300)
        for name, value in true.items()
        if name in rows
    }


def error_of(
    subject: Subject, calibration: bc.Calibration, later: bc.Measurements
) -> tuple[float, float]:
    """Return the rms error of the expected output of a second campaign, and its stated standard uncertainty."""
    expected = bc.predict(calibration, later, new_groups=not subject.one_unit)
    return expected.rmse, float(np.sqrt(np.mean(expected.model_sd**2)))


class Oracles:
    """Errors of the true structure fitted to records before their faults; one is used for many kinds."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, ...], tuple[float, float]] = {}

    def of(
        self, subject: Subject, kind: Kind, campaign: Campaign, seed: int
    ) -> tuple[float, float]:
        """Return the error of the second campaign and its stated uncertainty, from the rows that a kind keeps."""
        cut = "" if kind.keeps_rows else kind.name
        at = (subject.name, seed, tuple(campaign.hidden.items()), cut)
        if at not in self.known:
            record = campaign.record
            if cut:
                record = kind.spoil(record, subject, _generator(kind, seed))
            readings = read(subject, record, campaign.units, anything=True)
            model = subject.instrument.for_readings(readings).baseline() + list(campaign.hidden)
            calibration = bc.fit(model, readings, METHOD, strict=False)
            later = read(subject, campaign.holdout, campaign.units, anything=True)
            self.known[at] = error_of(subject, calibration, later)
        return self.known[at]


ORACLES = Oracles()
