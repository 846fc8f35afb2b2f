"""Where to measure next: the campaign, and the readings of it, that shrink a stated uncertainty most.

What a further campaign would read and the quantity in question are jointly normal, as the posterior draws have them,
with the noise and the deviation of new runs beside. The variance that is left of the quantity when these readings are
known is then in closed form and needs no output: var(q) − C·K⁻¹·Cᵀ, with C the covariance of q with the readings and K
that of the readings. Over a range it is the mean over the range that is made small (I-optimal design). Readings of a
campaign are picked one after another, each the one that takes most of what is left.
Source: K. Chaloner and I. Verdinelli, Statistical Science 10 (1995) 273 (Bayesian designs of linear models).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.prior_influence import not_measured
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import number
from bayescal._core.progress import stage
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import ACROSS
from bayescal._data.unit_conversion import STANDARD_GRAVITY, unit_label
from bayescal._search.next_experiment import expected_readings
from bayescal._use.conformity import StatedLimit, limited_quantity, stated_limit

# Share of a standard uncertainty that a campaign must take off to be worth it: no printed digit moves below.
WORTH_SHARE = 0.05

AGAIN = "the same again"
OF_SCATTER = (
    "how much better noise or a group's standard deviation is known afterwards is not foreseen"
)


@dataclass(frozen=True)
class PlannedCampaign:
    """A campaign that can be made.

    Attributes:
        name: what is done, in words.
        readings: the plan; its outputs count for nothing.
        u: standard uncertainty that is expected after it, root mean square over the limit's range.
    """

    name: str
    readings: Measurements = field(repr=False)
    u: float


@dataclass(frozen=True)
class PickedReading:
    """A reading of the best campaign.

    Attributes:
        row: of the campaign, from zero.
        at: value of each column of the instrument that differs within the campaign, but the time.
        u: standard uncertainty that is expected with it and those picked before it.
    """

    row: int
    at: dict[str, float]
    u: float


@dataclass(frozen=True, repr=False)
class ReadingPlan(Printed):
    """What to measure next.

    Attributes:
        limit: on the quantity, as stated.
        u: standard uncertainty now, in `unit`, root mean square over the limit's range.
        tolerance: half the width between the limits, in `unit`; infinite where there is one limit only.
        unit: of the quantity.
        campaigns: the one that leaves least uncertainty first.
        picked: readings of the first, the one that takes most first.
        units: of the columns of picked readings.
        notes: what the limit asks for beyond what was calibrated, each a clause.
    """

    limit: StatedLimit
    u: float
    tolerance: float
    unit: str
    campaigns: tuple[PlannedCampaign, ...]
    picked: tuple[PickedReading, ...]
    units: dict[str, str]
    notes: tuple[str, ...] = ()

    @property
    def gain(self) -> float:
        """Share of the standard uncertainty that the best campaign is expected to take off."""
        return 1 - self.campaigns[0].u / self.u

    @property
    def enough(self) -> bool:
        """Whether no campaign is worth it."""
        return self.gain < WORTH_SHARE

    def _brief(self) -> str:
        best = self.campaigns[0]
        return f"{self.limit.text}: {best.name}, u {number(self.u)} → {number(best.u)} {unit_label(self.unit)}"

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each campaign."""
        return {
            "campaign": [c.name for c in self.campaigns],
            "readings": [len(c.readings) for c in self.campaigns],
            "u": [c.u for c in self.campaigns],
        }

    def _parts(self) -> list[str | ResultTable]:
        """Campaigns by what they leave, the readings of the best one, and whether any is worth it."""
        unit = unit_label(self.unit)
        rows = [
            [c.name, str(len(c.readings)), number(c.u), f"{100 * (1 - c.u / self.u):.0f} %"]
            for c in self.campaigns
        ]
        head = ["campaign", "readings", _with_unit("u after it", unit), "less by"]
        now = f"{self.limit.text}\nstandard uncertainty now: {number(self.u)} {unit}".rstrip()
        if np.isfinite(self.tolerance):
            now += f", {self.u / self.tolerance:.2g} of the tolerance"
        lines: list[str | ResultTable] = [now, *(f"Note: {note}." for note in self.notes)]
        lines.append(plain_table(head, rows, fold=30))
        if self.enough:
            lines.append(
                f"Enough: none of these is expected to take off {100 * WORTH_SHARE:.0f} %."
            )
            return lines
        best = self.campaigns[0]
        if self.picked:
            names = list(self.picked[0].at)
            head = ["#", *(_with_unit(n, unit_label(self.units[n])) for n in names)]
            rows = [
                [str(i), *(number(p.at[n]) for n in names), number(p.u)]
                for i, p in enumerate(self.picked, 1)
            ]
            share = (self.u - self.picked[-1].u) / (self.u - best.u)
            lines.append(
                f"{len(self.picked)} of the {len(best.readings)} readings of {best.name!r} give "
                f"{100 * share:.0f} % of that:"
            )
            lines.append(plain_table([*head, _with_unit("u with it", unit)], rows))
        return lines

    def data(self) -> dict[str, object]:
        """Everything as plain data, for JSON."""
        return {
            "limit": self.limit.text,
            "unit": self.unit,
            "standard_uncertainty": self.u,
            "tolerance": self.tolerance if np.isfinite(self.tolerance) else None,
            "gain": self.gain,
            "enough": self.enough,
            "notes": list(self.notes),
            "campaigns": [
                {"name": c.name, "readings": len(c.readings), "standard_uncertainty": c.u}
                for c in self.campaigns
            ],
            "readings": [
                {"row": p.row, "at": p.at, "standard_uncertainty": p.u} for p in self.picked
            ],
        }


def _with_unit(name: str, unit: str) -> str:
    return f"{name}, {unit}" if unit else name


def plan_readings(
    calibration: Calibration,
    limit: str | StatedLimit,
    experiments: Mapping[str, Measurements] | None = None,
    *,
    count: int = 12,
    members: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
) -> ReadingPlan:
    """Rank campaigns by the standard uncertainty that they would leave, and pick the readings that matter.

    The model is taken as it is: what would tell structures apart is `next_experiment`'s question.

    Args:
        calibration: a fit, or an average over structures.
        limit: on the quantity whose uncertainty is to shrink, as `decide` takes it, such as
            "corrected reading: ±0.1 °/s over -20..60 °C" or "bias.temperature: ±1e-3 °/s/°C".
        experiments: name → readings of a campaign as it would be recorded (outputs do not count); those that the
            instrument lists, if not given, and the calibration's own readings once more.
        count: readings of the best campaign to pick.
        members: which member of a group is used, as `decide` takes it.
        local_gravity: m/s², for limits in m/s² on accelerations in g.

    Raises:
        InputError: a limit that is none, or on what is known exactly.
        ModelError: a campaign lacks a column that an effect needs.
    """
    if count < 0:
        raise InputError(f"count {count}: pick no reading or more")
    stated = stated_limit(limit) if isinstance(limit, str) else limit
    quantity = limited_quantity(calibration, stated, members=members, local_gravity=local_gravity)
    values = quantity.values()
    untold = not_measured(calibration, values, of=stated.quantity)
    if not np.ptp(values, axis=0).max() > 0:
        raise InputError(f"limit {stated.text!r}: {stated.quantity} has no uncertainty to shrink")
    values = values - values.mean(axis=0)
    u = float(np.sqrt(np.mean(values**2)))
    scatter = {h.name for h in calibration.layout.hypers if h.kind in ("noise", "group_sd")}
    plans = dict(experiments) if experiments is not None else _listed(calibration)
    if not plans:
        raise ModelError("no campaign to choose from: give {'slower': readings, …}")
    found = []
    with stage("expecting what each campaign would leave"):
        for name, readings in plans.items():
            kept, means, noise = expected_readings(calibration, readings, None)
            joint = _Joint(values, means, noise)
            found.append((PlannedCampaign(name, readings, joint.left()), joint, kept))
    found.sort(key=lambda one: one[0].u)
    best, joint, kept = found[0]
    # Where to measure is said in the columns that the model's effects need and the instrument has, but for the time:
    # when a reading is taken is not chosen.
    acting = dict.fromkeys(c for effect in calibration.model.effects for c in effect.columns)
    acting.update(dict.fromkeys(c.name for c in calibration.model.instrument.columns))
    vector = calibration.model.instrument.vector
    made = {"time", *ACROSS, *(vector.outputs if vector is not None and vector.acting else ())}
    numbers = [c for c in acting if c not in made and _differs(best.readings, c)]
    picked = []
    for i, left in joint.picked(count):
        at = {c: float(best.readings[c][kept[i]]) for c in numbers}
        picked.append(PickedReading(int(kept[i]), at, float(left)))
    return ReadingPlan(
        limit=stated,
        u=u,
        tolerance=0.5 * (quantity.limits.high - quantity.limits.low),
        unit=quantity.unit,
        campaigns=tuple(campaign for campaign, _, _ in found),
        picked=tuple(picked),
        units={c: best.readings.unit(c) for c in numbers},
        notes=(
            *(f"{clause}; there the model is carried on" for clause in quantity.not_covered),
            *([] if untold is None else [str(untold)]),
            *([OF_SCATTER] if stated.quantity in scatter else []),
        ),
    )


def _listed(calibration: Calibration) -> dict[str, Measurements]:
    """The calibration's own campaign once more, and those of its instrument that have the columns of the model."""
    instrument, found = calibration.model.instrument, {AGAIN: calibration.readings}
    for name, made in instrument.experiments:
        readings = Measurements.from_arrays(instrument, **made())
        try:
            calibration.model.require(readings)
        except ModelError:
            continue
        found.setdefault(name, readings)
    return found


def _differs(readings: Measurements, column: str) -> bool:
    if not readings.has(column):
        return False
    values = np.asarray(readings[column])
    return column != readings.output and values.dtype.kind in "if" and float(np.ptp(values)) > 0


class _Joint:
    """The quantity at g places and n readings as jointly normal.

    Attributes:
        own: variance of the quantity (g,).
        across: covariance of quantity and readings (g, n).
        readings: covariance of the readings, noise included (n, n).
        inflation: of what is left: `across` is of a finite number of draws, and readings that say nothing of the
            quantity seem to say a little (as R² is adjusted for the number of regressors).
    """

    def __init__(self, values: np.ndarray, means: np.ndarray, noise: np.ndarray) -> None:
        centred, draws = means - means.mean(axis=0), len(values)
        signal = centred.T @ centred / draws
        self.own, self.across = np.mean(values**2, axis=0), values.T @ centred / draws
        self.readings = signal + noise
        # tr K⁻¹S, K with noise and S without: as many directions of the readings as the draws make look informative.
        # An empirical regression on so many explains (freedom/draws) of the variance by chance.
        freedom = float(np.trace(np.linalg.solve(self.readings, signal)))
        self.inflation = draws / max(draws - freedom, 1.0)

    def _u(self, left: np.ndarray) -> float:
        least = float(np.mean(self.own))
        return float(np.sqrt(min(max(float(np.mean(left)), 0.0) * self.inflation, least)))

    def left(self) -> float:
        """Standard uncertainty with all readings."""
        # Conditional variance of jointly normal quantities, C·K⁻¹·Cᵀ at each place of the range.
        taken = np.einsum("gn,ng->g", self.across, np.linalg.solve(self.readings, self.across.T))
        return self._u(self.own - taken)

    def picked(self, count: int) -> list[tuple[int, float]]:
        """Readings one after another, each the one that takes most of what is left, and what is left then."""
        left, across, readings = self.own.copy(), self.across.copy(), self.readings.copy()
        found, free = [], np.ones(len(readings), dtype=bool)
        for _ in range(min(count, len(readings))):
            variance = readings.diagonal()
            # A reading takes cᵢ²/kᵢᵢ of the variance at each place: the one with the greatest sum over the range.
            score = np.where(free, np.sum(across**2, axis=0) / np.where(free, variance, 1.0), -1.0)
            i = int(np.argmax(score))
            free[i] = False
            # What the reading says is taken off everything (one step of a Cholesky factorisation).
            column = readings[:, i] / variance[i]
            of_quantity = across[:, i].copy()
            left = left - of_quantity**2 / variance[i]
            across = across - np.outer(of_quantity, column)
            readings = readings - variance[i] * np.outer(column, column)
            found.append((i, self._u(left)))
        return found
