"""Search path: the sequence of models from the first to the last, with the errors of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import Check
from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.judgement import multimodality
from bayescal._calibration.leave_group_out import LeaveOneGroupOut, scheme
from bayescal._calibration.predict import HoldoutTest
from bayescal._core.formatting import number, probability, wrap
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._search.discover import P_COMPLETE, Discovery
from bayescal._search.posterior import OtherPath, Search
from bayescal._search.structure_average import StructureShare

WORSE_RATIO = limit("step.predicts_worse", "ratio")
RISE_MARK = " ↑"  # after a hold-out error above that of the step before
FLOOR_NOTE = "noise floor: from neighbouring residuals; rms as fitted: ≈ √(1 − {0}/{1}) of it ({0} effective unknowns)"
LAPLACE_NOTE = "steps before the last: least squares, log evidence by Laplace's approximation"
NEW_RUN_NOTE = "new run: rms error with the fitted deviations of runs and cells at zero; leave-one-…-out: after a refit"
COMPLETE_NOTE = f"P(complete): {P_COMPLETE}"
LATENT_NOTE = "also in the last model, not found but inseparable from effects in it: "


@renamed(against="failures", different="outlying_groups", changed="description", noted="with_notes")
@renamed(left_out="leave_one_group_out", doubts="multimodality", judged="with_reasons")
@dataclass(frozen=True)
class Step:
    """One model of the sequence, with its errors in the output unit."""

    calibration: Calibration  # the fit
    added: str | None  # effect or effects; None for the first step and a change of noise
    rmse: float  # error of the fitted readings, group deviations at zero, as for an unseen group
    rmse_fitted: float  # error of the fitted readings, with the fitted group deviations
    holdout_rmse: float | None  # error of the hold-out data; None without them
    leave_one_group_out: LeaveOneGroupOut | None  # each group predicted from the others
    noise_floor: float  # estimated from neighbouring readings alone, independent of the model
    check: Check  # tests of the residuals
    discovery: Discovery | None  # missing effects; None where probabilities would be wrong
    description: str = ""  # other changes of the model, in words; empty if there are none
    holdout_test: HoldoutTest | None = None  # test of the model by the hold-out data
    failures: tuple[Claim, ...] = ()  # why no search can start from this model; mostly empty
    outlying_groups: tuple[Claim, ...] = ()  # claims of implausible deviations of group members

    def with_reasons(self, reasons: Sequence[str]) -> Step:
        """Return a copy of the step whose verdict states these reasons against the use of its calibration."""
        verdict = {"against": tuple(reasons), "checked": True}
        return replace(self, calibration=self.calibration.with_verdict(**verdict))

    def with_notes(self, notes: Sequence[str]) -> Step:
        """Return the step with further notes in its calibration's verdict."""
        all_notes = (*dict.fromkeys((*self.calibration.verdict.notes, *notes)),)
        return replace(self, calibration=self.calibration.with_verdict(notes=all_notes))

    @cached_property
    def multimodality(self) -> tuple[Claim, ...]:
        """Return claims that the posterior has several modes or is not Gaussian about its mode; usually empty."""
        return tuple(multimodality(self.calibration))

    @property
    def title(self) -> str:
        """Return the step's title, such as "baseline" or "+ bias.drift"."""
        return self.description or "baseline" if self.added is None else f"+ {self.added}"

    def row(self, previous: Step | None) -> dict[str, Any]:
        """Return the step's table row: errors, whether the hold-out error rises, log evidence, P(complete)."""
        evidence, discovery = self.calibration.log_evidence, self.discovery
        return {
            **self.errors(),
            "rises": previous is not None and is_rise(self.holdout_rmse, previous.holdout_rmse),
            "log_evidence": evidence and {"value": evidence[0], "se": evidence[1]},
            "nothing_missing": discovery and discovery.nothing_missing,
        }

    def errors(self) -> dict[str, Any]:
        """Return title and errors (output unit) as plain data, for result.json and plots."""
        out = self.leave_one_group_out
        return {
            "title": self.title,
            "unit": self.calibration.unit,
            "rmse_fitted": self.rmse_fitted,
            "rmse": self.rmse,
            "leave_one_group_out": out and {"group": out.group, "n": out.count, "rmse": out.rmse},
            "holdout_rmse": self.holdout_rmse,
            "noise_floor": self.noise_floor,
        }


@dataclass(frozen=True)
class Gate:
    """Outcome of a model's acceptance checks: whether it is fit for use, and why or why not."""

    ok: bool
    reason: str
    claims: tuple[Claim, ...] = ()

    def __str__(self) -> str:
        head = "fit for use; acceptance checks" if self.ok else "NOT fit for use"
        return f"{head}: {self.reason}"


@dataclass(frozen=True, repr=False)
class SearchPath(Printed):
    """Result of a stepwise search: the models from the first to the last, and the acceptance checks of the last."""

    steps: tuple[Step, ...]  # from the first model to the last
    gate: Gate  # acceptance checks of the last model
    holdout: Measurements | None  # hold-out data
    other_path: OtherPath | None = None  # runner-up model under another noise law, if there is one
    search: Search | None = None  # the evaluated structures; None without a search
    # the last model's calibration averaged over the structures; None where one has nearly all probability
    average: Calibration | None = None
    shares: tuple[StructureShare, ...] = ()  # weights of the structures in the average

    @property
    def final(self) -> Step:
        return self.steps[-1]

    @property
    def calibration(self) -> Calibration:
        """Return the calibration to use: averaged over structures if several are probable."""
        return self.final.calibration if self.average is None else self.average

    @property
    def ok(self) -> bool:
        return self.gate.ok and self.final.calibration.verdict.ok

    @property
    def complete(self) -> bool:
        """Return whether the search was completed, not ended early."""
        return self.search is None or self.search.complete

    @property
    def progress(self) -> str:
        """Return the progress of the search as text: time, structures, the best one; empty before the first."""
        search, unit = self.search, unit_label(self.final.calibration.unit)
        if search is None or not search.structures:
            return ""
        if len(self.steps) > 1:
            error_text = f"rms residual {number(self.final.rmse_fitted)} {unit}"
            return f"{search.seconds:.0f} s, fitted: {self.final.title}, {error_text}"
        best = search.structures[0]
        text = f"rms residual {number(best.rms)} {unit}"
        if search.weighed == 1:
            return f"{search.seconds:.0f} s, first model: {text}"
        return f"{search.seconds:.0f} s, best so far: {best}, {text}, probability {probability(best.probability)}"

    @property
    def ending(self) -> str:
        """Return why the search ended: the time limit, the number of effects, or no further effect probable enough."""
        search, discovery = self.search, self.final.discovery
        if search is None or not (search.complete or search.stopped):
            return ""
        if discovery is None:
            is_reliable = self.steps[0].calibration.verdict.ok
            reason = "no effect may be added" if is_reliable else "the fit is not reliable"
            return search.stopped or f"The search was not run: {reason}."
        lines = [search.stopped] if search.stopped else []
        added_count, allowed = sum(s.added is not None for s in self.steps), search.max_effects or 0
        if not lines and added_count >= allowed > 0:
            lines.append(f"The search added its maximum of {allowed} effects (--max-effects).")
        # The most probable candidate that these readings can test shows how close the search was to adding another one.
        tested = {c.effect: p for c in discovery.candidates if (p := c.probability) is not None}
        name = max(tested, key=tested.__getitem__, default="")
        level = settings().found_probability
        if not name:
            lines += [] if lines else ["These readings can test no further candidate."]
        elif tested[name] >= level:
            lines.append(f"Still missing: {name}, probability {probability(tested[name])}.")
        else:
            best_text = f"{name}, {probability(tested[name])}"
            lines.append(f"No further effect reaches probability {level:g} (highest: {best_text}).")
        return " ".join(lines)

    if TYPE_CHECKING:

        @property
        def in_short(self) -> str:
            """Return the result in one paragraph; `save_search` attaches it."""
            ...

        def save(self, folder: Path) -> None:
            """Write result.json, calibration.nc (of the last step) and loop.png; `save_search` attaches it."""

    def _list_parts(self) -> list[str | ResultTable]:
        """Return the table of errors by step, and the effects found."""
        rows = self.rows
        note = f"{RISE_MARK.strip()} held-out error more than 5 % above that of the previous step"
        lines = [steps_table(rows), COMPLETE_NOTE, *[note] * any(r["rises"] for r in rows)]
        lines += [NEW_RUN_NOTE] * differs_in_new_run(rows)
        if rows[-1]["rmse_fitted"] < rows[-1]["noise_floor"]:
            directions = self.final.calibration.linear.directions  # of each effective unknown
            lines.append(FLOOR_NOTE.format(round((directions**2).sum()), len(directions)))
        methods = {s.calibration.method for s in self.steps[:-1]}
        lines += [LAPLACE_NOTE] * (LeastSquares.name in methods)
        shares = [(s.effects, s.probability) for s in self.shares]
        heads, texts = list_headings(self.complete), dict[str, list[str]]()
        for name, p in ((n, p) for n, p in self.added.items() if p is not None):
            family = self.final.calibration.model.effect(name).family_name
            text = f"{format_forms(name, family, shares)}, probability {probability(p)}"
            texts.setdefault(next(h for least, h in heads.items() if p >= least), []).append(text)
        lines += [wrap(f"{h}: {'; '.join(texts[h])}") for h in heads.values() if h in texts]
        latent = self.final.discovery.latent if self.final.discovery else ()
        names = [n for n in latent if n in self.final.calibration.model.names]
        return lines + [wrap(LATENT_NOTE + ", ".join(names))] * bool(names)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return each step's table row (`Step.row`) with its number."""
        steps = enumerate(pairwise([None, *self.steps]))
        return [{"number": i, **step.row(previous)} for i, (previous, step) in steps]

    @property
    def added(self) -> dict[str, float | None]:
        """Return the effects added to the first model: name → probability in any form, or None if unknown."""
        first_model, model = self.steps[0], self.final.calibration.model
        names, discovery = set(first_model.calibration.model.names), first_model.discovery
        names |= {*self.final.discovery.latent} if self.final.discovery else set()
        by_family = {c.effect: c.probability for c in discovery.candidates} if discovery else {}
        return {e.name: by_family.get(e.family_name) for e in model.effects if e.name not in names}

    def _format_summary(self) -> str:
        unit = unit_label(self.final.calibration.unit)
        first, last = self.steps[0].rmse_fitted, self.final.rmse_fitted
        return f"{', '.join(s.title for s in self.steps)}; rms residual {number(first)} → {number(last)} {unit}"


def list_headings(complete: bool) -> dict[float, str]:
    """Return the headings of added effects by their lowest probability, the highest first."""
    found = "found" if complete else "best when the search ended"
    other_headings = {0.5: "more probable than not", 0.0: "in the last model, one of several"}
    return {settings().found_probability: found, **other_headings}


def format_forms(name: str, family: str, shares: Iterable[tuple[Sequence[str], float]]) -> str:
    """Format an effect's family with its forms in an average: "bias.thermal_lag (form, if present: paths 0.4, …)"."""
    forms = Counter[str]()
    for effects, share in shares:
        for n in effects:
            if n == family or n.startswith(f"{family}."):
                forms[n.removeprefix(family).removeprefix(".") or "basic"] += share
    if not {*forms} - {"basic"}:
        return name
    texts = [f"{n} {probability(p / forms.total())}" for n, p in forms.most_common()]
    return f"{family} (form, if present: {', '.join(texts)})"


def is_rise(error: float | None, previous: float | None) -> bool:
    """Return whether a hold-out error is more than 5 % above the previous one."""
    return error is not None and previous is not None and error > WORSE_RATIO * previous


def differs_in_new_run(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the printed error of a new run differs from the error as fitted at any step."""
    return any(number(r["rmse"]) != number(r["rmse_fitted"]) for r in rows)


def steps_table(rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Tabulate errors by step; `rows`: those of `SearchPath.rows`, or the steps of a result.json."""
    unit = unit_label(rows[-1]["unit"])
    group = next((r["leave_one_group_out"]["group"] for r in rows if r["leave_one_group_out"]), "")

    def format_holdout(row: Mapping[str, Any]) -> str:
        return f"{number(row['holdout_rmse'])}{RISE_MARK * row['rises']}"

    holdout_columns = [TableColumn("held-out", format_holdout, unit=unit, name="")]
    columns = (
        TableColumn("step", lambda r: r["title"], None),
        TableColumn("step", lambda r: f"{r['number']} {r['title']}", name=""),
        TableColumn("rms as fitted", "rmse_fitted", number, unit, name="as fitted"),
        TableColumn("new run", "rmse", number if differs_in_new_run(rows) else None, unit),
        TableColumn(
            scheme(group or "group"),
            lambda r: out["rmse"] if (out := r["leave_one_group_out"]) else None,
            number,
            unit,
            name="left-out",
        ),
        *(holdout_columns if any(r["holdout_rmse"] is not None for r in rows) else []),
        TableColumn("held-out", "holdout_rmse", None),
        TableColumn("noise floor", "noise_floor", number, unit),
        TableColumn("unit", "unit", None),
        TableColumn(
            "log evidence",
            lambda r: e["value"] if (e := r["log_evidence"]) else None,
            lambda v: "–" if v is None else f"{v:z.1f}",
        ),
        TableColumn("P(complete)", "nothing_missing", probability, name="nothing missing"),
    )
    return ResultTable(columns, rows)
