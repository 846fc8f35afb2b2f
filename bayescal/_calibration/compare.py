"""Model comparison: leave-one-group-out (leave_group_out.py), leave-one-out, evidence (laplace.py), stacking.

Sources: Vehtari et al., Stat. Comput. 27 (2017) 1413 (PSIS-LOO, by ArviZ); Yao et al., Bayesian Anal. 13 (2018) 917
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.leave_group_out import LeaveOneGroupOut, leave_one_group_out, scheme
from bayescal._calibration.predict import predict
from bayescal._core.errors import InputError
from bayescal._core.formatting import number, wrap
from bayescal._core.importance_weights import stack_models
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.trust import MAX_K_HAT

MIN_GROUPS = limit("compare.few_groups", "groups")
GROUP_SCORE, EVIDENCE = "leave-one-group-out", "log evidence"
LOO_SCORE = "pointwise leave-one-out"
NOTE = "elpd: expected log predictive density; stacking weight: share in the mixture of largest leave-one-out elpd."


@dataclass(frozen=True)
class ComparisonRow:
    """Scores of one model."""

    name: str  # given by the user
    effects: str  # canonical names, with commas between
    rmse: float  # of the readings with group deviations at zero, output unit
    group_score: float | None  # sum over left-out groups of the joint log predictive density
    group_difference: float | None  # group_score less that of the best model
    group_error: float | None  # standard error of the difference; None with fewer than ten groups
    group_rmse: float | None  # of readings predicted from the other groups, output unit
    loo: float  # expected log pointwise predictive density by PSIS-LOO
    loo_difference: float  # loo less that of the best model
    loo_error: float  # standard error of the difference
    pareto_k: float  # largest Pareto k of the readings
    log_evidence: float | None  # None where a prior is flat
    weight: float  # stacking weight


@dataclass(frozen=True, repr=False)
class Comparison(Printed):
    """A comparison of fitted models, the best first.

    Attributes:
        rows: scores, one row per model.
        group, groups: kind of the left-out groups (device, run, cell, block or reading), and their number.
        unit: output unit.
        chosen_by: ranking criterion: "leave-one-group-out", "log evidence" or "pointwise leave-one-out".
        warnings: undecided rankings, disagreement of criteria, unreliable PSIS-LOO.
    """

    rows: tuple[ComparisonRow, ...]
    group: str
    groups: int
    unit: str
    chosen_by: str
    warnings: tuple[Claim, ...]

    def _list_parts(self) -> list[str | ResultTable]:
        """Return the table, its heading and the warnings."""
        is_grouped, unit = self.chosen_by != LOO_SCORE, unit_label(self.unit)
        scheme_name, format_score = scheme(self.group), lambda v: "–" if v is None else f"{v:.1f}"
        group_columns = (
            TableColumn(f"{scheme_name} rms error", "group_rmse", number, unit),
            TableColumn(f"{scheme_name} elpd", "group_score", format_score),
            TableColumn("difference", lambda r: (r["group_difference"], r["group_error"]), _gap),
        )
        columns = (
            TableColumn("model", "name"),
            TableColumn("rms error", "rmse", number, unit),
            *(group_columns if is_grouped else ()),
            TableColumn("leave-one-reading-out elpd", "loo", "{:.1f}".format),
            TableColumn("difference", lambda r: (r["loo_difference"], r["loo_error"]), _gap),
            TableColumn("log evidence", "log_evidence", format_score),
            TableColumn("stacking weight", "weight", "{:.2f}".format),
        )
        count = f" ({self.groups} groups)" if self.chosen_by == GROUP_SCORE else ""
        table = ResultTable(columns, [vars(r) for r in self.rows])
        heading = f"ranked by {self.chosen_by}{count}; differences are from the best elpd. {NOTE}"
        return [table, *(wrap(line, "") for line in (heading, *self.warnings))]

    def _format_summary(self) -> str:
        return f"{', '.join(repr(r.name) for r in self.rows)}, the best first by {self.chosen_by}"

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return the fields of `ComparisonRow` by name, an entry per model; errors in the output's unit."""
        return {f.name: [getattr(r, f.name) for r in self.rows] for f in fields(ComparisonRow)}


def _gap(difference: tuple[float | None, float | None]) -> str:
    value, error = difference
    if value is None or value == 0:
        return "–" if value is None else "0"
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"


def compare(calibrations: Mapping[str, Calibration] | Sequence[Calibration]) -> Comparison:
    """Compare fitted models by cross-validation, log evidence and stacking weight.

    Models are ranked by their leave-one-group-out log score if there are at least ten groups; by log evidence if there
    are fewer, too few for a standard error; by pointwise leave-one-out if the noise is not Gaussian.

    Args:
        calibrations: fits to the same readings, by name; those of a sequence are named after effects that not all have.

    Raises:
        InputError: there are fewer than two fits, or they are to different readings.
    """
    if not isinstance(calibrations, Mapping):
        calibrations = _name_by_effects(calibrations)
    if len(calibrations) < 2:
        raise InputError(f"compare needs at least two calibrations, not {len(calibrations)}")
    (first_name, first_fit), *other_fits = calibrations.items()
    output = first_fit.readings["output"]
    for name, c in other_fits:
        if len(c.readings) != len(output) or not np.allclose(c.readings["output"], output):
            raise InputError(
                f"{first_name!r} and {name!r} were fitted to different readings ({first_fit.readings.file}, "
                f"{c.readings.file}): fit both to the same readings"
            )
    loo = {name: compute_loo(c) for name, c in calibrations.items()}
    best_loo = max((densities for densities, _ in loo.values()), key=np.sum)
    weights = stack_models(np.stack([densities for densities, _ in loo.values()], axis=1))
    validations = {name: leave_one_group_out(c) for name, c in calibrations.items()}
    validation_list = [f for f in validations.values() if f is not None]
    groups, is_grouped = next(iter(validation_list), None), len(validation_list) == len(validations)
    best_scores = max((f.log_score for f in validation_list), key=np.sum) if is_grouped else None
    rows = list[ComparisonRow]()
    for (name, c), weight in zip(calibrations.items(), weights, strict=True):
        (densities, pareto_k), scores = loo[name], validations[name]
        gaps = None if scores is None or best_scores is None else scores.log_score - best_scores
        row = ComparisonRow(
            name=name,
            effects=", ".join(c.model.names),
            rmse=predict(c).rmse,
            group_score=scores and float(scores.log_score.sum()),
            group_difference=None if gaps is None else float(gaps.sum()),
            group_error=None if gaps is None or len(gaps) < MIN_GROUPS else _sum_error(gaps),
            group_rmse=scores and scores.rmse,
            loo=float(densities.sum()),
            loo_difference=float((densities - best_loo).sum()),
            loo_error=_sum_error(densities - best_loo),
            pareto_k=pareto_k,
            log_evidence=c.log_evidence and c.log_evidence[0],
            weight=float(weight),
        )
        rows.append(row)
    ranking, ranking_field = (GROUP_SCORE, "group_score") if is_grouped else (LOO_SCORE, "loo")
    has_few_groups = is_grouped and groups is not None and groups.count < MIN_GROUPS
    if has_few_groups and all(r.log_evidence is not None for r in rows):
        ranking, ranking_field = EVIDENCE, "log_evidence"
    rows.sort(key=lambda r: -getattr(r, ranking_field))
    return Comparison(
        rows=tuple(rows),
        group=groups.group if groups else "reading",
        groups=groups.count if groups else len(output),
        unit=first_fit.unit,
        chosen_by=ranking,
        warnings=tuple(_warn(rows, ranking, groups)),
    )


def compute_loo(calibration: Calibration) -> tuple[np.ndarray, float]:
    """Return the PSIS leave-one-out log predictive density of each reading, and the largest Pareto k."""
    import arviz_stats  # loading takes a second
    import xarray as xr

    parts = {"log_likelihood": calibration.log_likelihood(), "posterior": calibration.posterior}
    tree = xr.DataTree.from_dict(parts)
    with warnings.catch_warnings():  # high Pareto k: reported as a claim, by model
        warnings.simplefilter("ignore", UserWarning)
        elpd: Any = arviz_stats.loo(tree, pointwise=True)  # pyright: ignore[reportPrivateImportUsage]
    return np.asarray(elpd.elpd_i).ravel(), float(np.max(np.asarray(elpd.pareto_k)))


def _sum_error(differences: np.ndarray) -> float:
    """Return the standard error of a sum of differences over the left-out readings or groups."""
    if differences.size < 2:
        return float("nan")
    return float(np.sqrt(differences.size * differences.var(ddof=1)))


def _warn(rows: list[ComparisonRow], rule: str, groups: LeaveOneGroupOut | None) -> Iterator[Claim]:
    """Yield claims on too few groups, an undecided ranking, one that group scores contradict, unreliable PSIS-LOO."""
    best, runner_up = rows[:2]
    if groups and groups.count < MIN_GROUPS:
        yield Claim("compare.few_groups", groups.group, count=groups.count)
    undecided_claim = partial(Claim, "compare.undecided", best.name, runner_up.name)
    if rule == EVIDENCE:
        difference = (best.log_evidence or 0.0) - (runner_up.log_evidence or 0.0)
        if difference < settings().strong_evidence:
            yield undecided_claim(gap=f"{difference:.1f}", measure=rule)
        if (best_by_groups := max(rows, key=lambda r: r.group_score or -np.inf)) is not best:
            yield Claim("compare.other_first", best_by_groups.name)
    elif rule == GROUP_SCORE and runner_up.group_error:
        difference, error = -(runner_up.group_difference or 0.0), runner_up.group_error
        if difference < limit("compare.undecided", "errors") * error:
            yield undecided_claim(gap=f"{difference:.1f} ± {error:.1f}", measure=f"{rule} score")
    for row in (r for r in rows if r.pareto_k > MAX_K_HAT):
        yield Claim("compare.pointwise_unreliable", row.name, pareto_k=row.pareto_k)


def _name_by_effects(calibrations: Sequence[Calibration]) -> dict[str, Calibration]:
    """Name each fit after its effects that not all fits have, or "model 1" … if that name is empty or a duplicate."""
    common = set.intersection(*(set(c.model.names) for c in calibrations)) if calibrations else ()
    named_fits: dict[str, Calibration] = {}
    for i, c in enumerate(calibrations, start=1):
        name = " ".join(f"+ {n}" for n in c.model.names if n not in common)
        named_fits[name if name and name not in named_fits else f"model {i}"] = c
    return named_fits
