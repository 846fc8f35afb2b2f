"""Which model predicts better: left-out groups, pointwise leave-one-out, evidence, stacking weights.

Sources: Vehtari, Gelman & Gabry, Stat. Comput. 27 (2017) 1413 (PSIS-LOO); Yao et al., Bayesian Analysis 13 (2018)
917 (stacking). PSIS-LOO is ArviZ's.
"""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import minimize

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.predict import predict
from bayescal._core.errors import InputError
from bayescal._core.formatting import WIDTH, Printed, number, table
from bayescal._diagnostics.leave_group_out import LeaveOneGroupOut, leave_one_group_out
from bayescal._inference.trust import K_HAT
from bayescal._readings.unit_conversion import unit_label

SAME_CURVE = (
    0.15  # largest difference, in noise standard deviations, of curves that count as the same
)


@dataclass(frozen=True)
class Row:
    """One model.

    Attributes:
        name: given by the user.
        effects: canonical names.
        rmse: of the readings with group deviations at zero, output unit.
        group_score: sum of the joint log predictive densities of left-out groups.
        group_difference, group_error: to the best, and its standard error over groups.
        group_rmse: of readings predicted from the other groups, output unit.
        loo: expected log pointwise predictive density by PSIS-LOO; its difference and error; worst Pareto k.
        log_evidence: None where a prior is flat.
        weight: stacking weight.
    """

    name: str
    effects: tuple[str, ...]
    rmse: float
    group_score: float | None
    group_difference: float | None
    group_error: float | None
    group_rmse: float | None
    loo: float
    loo_difference: float
    loo_error: float
    pareto_k: float
    log_evidence: float | None
    weight: float


@dataclass(frozen=True, repr=False)
class Comparison(Printed):
    """Models side by side, the best first.

    Attributes:
        rows: one each.
        group: what was left out, and of how many.
        groups: number of groups.
        chosen_by: "left-out groups" or "pointwise leave-one-out".
        warnings: what the reader must know, each a sentence.
    """

    rows: tuple[Row, ...]
    group: str
    groups: int
    unit: str
    chosen_by: str
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        return comparison_text(self)

    def _brief(self) -> str:
        return f"{', '.join(repr(r.name) for r in self.rows)}, the best first by {self.chosen_by}"

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each model, with the fields of `Row`; errors in the output's unit."""
        return {f.name: [getattr(r, f.name) for r in self.rows] for f in fields(Row)}


def comparison_text(found: Comparison) -> str:
    """Models side by side, the best first."""
    unit = unit_label(found.unit)
    grouped = found.chosen_by == "left-out groups"
    head = ["model", f"rmse [{unit}]"]
    head += [f"left-out {found.group}", "score", "difference"] if grouped else []
    head += ["LOO", "difference", "log evidence", "weight"]
    rows = []
    for r in found.rows:
        cells = [r.name, number(r.rmse)]
        if grouped:
            score = "–" if r.group_score is None else f"{r.group_score:.1f}"
            cells += [number(r.group_rmse), score, _gap(r.group_difference, r.group_error)]
        evidence = "null" if r.log_evidence is None else f"{r.log_evidence:.1f}"
        loo = _gap(r.loo_difference, r.loo_error)
        rows.append([*cells, f"{r.loo:.1f}", loo, evidence, f"{r.weight:.2f}"])
    count = f" ({found.groups} of them)" if grouped else ""
    lines = [table(head, rows), f"chosen by {found.chosen_by}{count}"]
    return "\n".join([*lines, *(textwrap.fill(w, WIDTH) for w in found.warnings)])


def _gap(value: float | None, error: float | None) -> str:
    if value is None or error is None or (value == 0 and error == 0):
        return "0" if value == 0 else "–"
    return f"{value:.1f} ± {error:.1f}"


def compare(calibrations: Mapping[str, Calibration]) -> Comparison:
    """Set fitted models side by side.

    Args:
        calibrations: name → fit, of the same readings.

    Raises:
        InputError: fewer than two, or fits of different readings.
    """
    names = list(calibrations)
    _refuse_different_readings(calibrations)
    loo = {name: pointwise_loo(c) for name, c in calibrations.items()}
    folds = {name: leave_one_group_out(c) for name, c in calibrations.items()}
    grouped = all(f is not None for f in folds.values())
    fold = next((f for f in folds.values() if f is not None), None)
    best_loo = loo[max(names, key=lambda n: loo[n][0].sum())][0]
    left_out = [f for f in folds.values() if f is not None]
    best_fold = max(left_out, key=lambda f: f.log_score.sum()) if grouped else None
    weights = stacking(np.stack([loo[n][0] for n in names], axis=1))
    rows = [
        _row(name, calibrations[name], loo[name], best_loo, folds[name], best_fold, float(weight))
        for name, weight in zip(names, weights, strict=True)
    ]
    rows.sort(key=lambda r: -(r.group_score if grouped and r.group_score is not None else r.loo))
    first = calibrations[names[0]]
    return Comparison(
        rows=tuple(rows),
        group=fold.group if fold else "reading",
        groups=fold.count if fold else len(first.readings),
        unit=first.unit,
        chosen_by="left-out groups" if grouped else "pointwise leave-one-out",
        warnings=(
            *_warnings(rows, fold.count if fold else 0, grouped),
            *_alike(calibrations),
        ),
    )


def _refuse_different_readings(calibrations: Mapping[str, Calibration]) -> None:
    names = list(calibrations)
    if len(names) < 2:
        raise InputError(f"compare needs at least two calibrations, not {len(names)}")
    first = calibrations[names[0]]
    for name in names[1:]:
        other = calibrations[name].readings["output"]
        if other.shape != first.readings["output"].shape or not np.allclose(
            other, first.readings["output"]
        ):
            raise InputError(
                f"{names[0]!r} and {name!r} were fitted to different readings "
                f"({first.readings.file}, {calibrations[name].readings.file}): fit both to the same"
            )


def _row(
    name: str,
    calibration: Calibration,
    loo: tuple[np.ndarray, float],
    best_loo: np.ndarray,
    fold: LeaveOneGroupOut | None,
    best_fold: LeaveOneGroupOut | None,
    weight: float,
) -> Row:
    points, pareto_k = loo
    gap = fold.log_score - best_fold.log_score if fold and best_fold else None
    return Row(
        name=name,
        effects=calibration.model.names,
        rmse=predict(calibration).rmse,
        group_score=float(fold.log_score.sum()) if fold else None,
        group_difference=None if gap is None else float(gap.sum()),
        group_error=None if gap is None else _error(gap),
        group_rmse=fold.rmse if fold else None,
        loo=float(points.sum()),
        loo_difference=float((points - best_loo).sum()),
        loo_error=_error(points - best_loo),
        pareto_k=pareto_k,
        log_evidence=calibration.log_evidence[0] if calibration.log_evidence else None,
        weight=weight,
    )


def _error(differences: np.ndarray) -> float:
    """Standard error of a sum of differences, over what was left out."""
    return (
        float(np.sqrt(differences.size * differences.var(ddof=1)))
        if differences.size > 1
        else float("nan")
    )


def pointwise_loo(calibration: Calibration) -> tuple[np.ndarray, float]:
    """Expected log predictive density of each reading left out, by PSIS, and the largest Pareto k."""
    import arviz_stats  # a second that only a comparison needs

    tree = xr.DataTree.from_dict(
        {
            "log_likelihood": calibration.log_likelihood(),
            "posterior": calibration.posterior,
        }
    )
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", UserWarning
        )  # high Pareto k: said in our own words, by model
        found: Any = arviz_stats.loo(tree, pointwise=True)  # pyright: ignore[reportPrivateImportUsage]
    return np.asarray(found.elpd_i).ravel(), float(np.max(np.asarray(found.pareto_k)))


def stacking(log_densities: np.ndarray) -> np.ndarray:
    """Weights on models (m,) that maximise the log score of their mixture, from (n, m) log densities."""
    count = log_densities.shape[1]
    density = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))

    def loss(free: np.ndarray) -> tuple[float, np.ndarray]:
        weight = np.exp(free - free.max())
        weight /= weight.sum()
        mixed = density @ weight
        slope = (density / mixed[:, None]).sum(axis=0)
        return -float(np.log(mixed).sum()), -weight * (slope - slope @ weight)

    found = minimize(loss, np.zeros(count), jac=True, method="BFGS")
    weight = np.exp(found.x - found.x.max())
    return weight / weight.sum()


def _warnings(rows: list[Row], groups: int, grouped: bool) -> list[str]:
    said = []
    if grouped and len(rows) > 1:
        second = rows[1]
        gap, error = second.group_difference, second.group_error
        if gap is not None and error is not None and abs(gap) < 2 * error:
            said.append(
                f"{rows[0].name!r} and {second.name!r} differ by {abs(gap):.1f} ± {error:.1f} in left-out "
                "score: these readings do not tell them apart."
            )
        if groups < 10:
            said.append(
                f"Only {groups} groups: the error over groups is itself uncertain; no test is made."
            )
    for row in rows:
        if row.pareto_k > K_HAT:
            said.append(
                f"{row.name!r}: Pareto k up to {row.pareto_k:.2f}, so its pointwise leave-one-out is not "
                "reliable."
            )
    return said


def _alike(calibrations: Mapping[str, Calibration]) -> list[str]:
    """Models whose fitted curves are one and the same against the noise, said pair by pair with the first."""
    curves = {name: predict(c) for name, c in calibrations.items()}
    said, told = [], set()
    for name, curve in curves.items():
        if name in told:
            continue
        noise = float(np.sqrt(np.mean(curve.sd**2)))
        gaps = {
            n: float(np.max(np.abs(c.mean - curve.mean)))
            for n, c in curves.items()
            if n not in told
        }
        same = [n for n, gap in gaps.items() if n != name and gap < SAME_CURVE * noise]
        if same:
            told |= {name, *same}
            unit = calibrations[name].unit
            said.append(
                f"{', '.join(map(repr, [name, *same]))} are the same curve to within "
                f"{max(gaps[n] for n in same):.2g} {unit} (noise {noise:.2g}): these readings cannot tell them apart."
            )
    return said
