"""What a check has found, and how it prints: a table that a person reads from top to bottom."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayescal._core.formatting import WIDTH, number
from bayescal._core.result_table import Printed, ResultTable, TableColumn, plain_table
from bayescal._core.settings import settings
from bayescal._data.allan_deviation import AllanDeviation, AllanTerm
from bayescal._data.unit_conversion import unit_label
from bayescal._model.noise_law import Noise

SIGNIFICANT_P = 1e-3  # p-value of the tests without a Bayes factor
IN_TIME = ("time", "elapsed", "order", "run")  # what correlated noise seems to follow


@dataclass(frozen=True)
class Region:
    """A part of a covariate where the residuals are systematically positive or negative."""

    low: float  # of the covariate, in `covariate_unit`
    high: float
    group: str | None  # the run, of one run alone; the member, where the covariate is a group
    size: float  # mean residual there (weighted by the noise law), output unit
    z: float  # size over its standard uncertainty
    covariate_unit: str


@dataclass(frozen=True)
class Entry:
    """One covariate, or group of readings (`by_group`): a run, a cell, an axis, a device."""

    against: str
    log_bayes_factor: float
    worst: Region
    by_group: bool = False

    def data(self, unit: str) -> dict[str, Any]:
        """As in result.json; sizes in the output's unit, places in the covariate's."""
        worst = dict(vars(self.worst))
        place = {"from": worst.pop("low"), "to": worst.pop("high"), "unit": unit}
        return {**vars(self), "worst": {**place, **worst}}


@dataclass(frozen=True)
class Pair:
    """Two covariates: evidence of an interaction not explained by additive terms."""

    against: tuple[str, str]
    log_bayes_factor: float


@dataclass(frozen=True)
class FixedComparison:
    """What residuals of a model with fixed coefficients are judged against, output unit."""

    noise: float  # standard deviation used as the measure
    rms: float  # of the residuals
    free_fit: float  # noise of the same model with free coefficients
    known: dict[str, float]  # contributions known before any fit, by name

    @property
    def wrong(self) -> bool:
        """Whether the fixed coefficients leave clearly more than the noise of the same model with free coefficients."""
        return self.rms > 2 * self.noise


@dataclass(frozen=True)
class AllanCheck:
    """The Allan deviation of residuals beside that which the fitted noise law lets one expect of them."""

    measured: AllanDeviation  # of the residuals
    law: str  # name of the noise law
    expected: np.ndarray = field(repr=False)  # under it, of the residuals of such a fit (k,)
    low: np.ndarray = field(repr=False)  # between which it puts 95 % of such estimates (k,)
    high: np.ndarray = field(repr=False)
    law_terms: tuple[AllanTerm, ...]  # N, and K where the noise is correlated, as the law has them
    apart: int | None  # averaging time at which the two differ the most; None where they agree

    def __str__(self) -> str:
        return f"{self.table()}\n{self.sentence()}"

    def table(self) -> ResultTable:
        """The terms of the noise law in the units of data sheets."""
        rows = [[f"{t.name} {t.symbol}", str(t)] for t in self.law_terms]
        return plain_table([f"noise law ({self.law_name})", "value"], rows)

    @property
    def law_name(self) -> str:
        """As a person reads it."""
        named = (law for law in Noise.known.values() if law.law == self.law)
        return next((law.words for law in named if law.words), self.law)

    def sentence(self) -> str:
        """Where the two differ the most, or over which times they agree."""
        m, unit, k = self.measured, unit_label(self.measured.unit), self.apart
        if k is None:
            times = f"{number(m.tau[0])} to {number(m.tau[-1])} s"
            return f"Allan deviation and noise law ({self.law_name}) agree from {times}"
        more = "more" if m.deviation[k] > self.expected[k] else "less"
        return (
            f"at {number(m.tau[k])} s the Allan deviation is {number(m.deviation[k])} {unit}, the noise law "
            f"({self.law_name}) says {number(self.low[k])} to {number(self.high[k])} {unit} (95 %): the residuals "
            f"change {more} over this time than such noise would"
        )

    def data(self) -> dict[str, Any]:
        """As in result.json."""
        return {
            "unit": self.measured.unit,
            "runs": self.measured.runs,
            "curve": allan_rows(self.measured, self.expected, self.low, self.high),
            "terms": [vars(t) for t in self.law_terms],
            "agrees": self.apart is None,
            "in_words": self.sentence(),
        }


def allan_rows(
    measured: AllanDeviation, law: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[dict[str, float]]:
    """An Allan deviation beside that of a noise law, time by time, as in JSON."""
    m, names = measured, ("tau", "deviation", "low", "high", "law", "law_low", "law_high")
    rows = zip(m.tau, m.deviation, m.low, m.high, law, low, high, strict=True)
    return [dict(zip(names, map(float, row), strict=True)) for row in rows]


@dataclass(frozen=True, repr=False)
class Check(Printed):
    """Where a model fails.

    Attributes:
        entries: a covariate each, the strongest evidence first.
        pairs: of covariates, likewise.
        unit: of the output.
        rms: of the residuals, output unit.
        noise: standard deviation that they are judged against.
        autocorrelation: (lag-1 coefficient within runs beyond what the fit itself leaves, its z).
        scatter_with: covariates with which the scatter changes, and the p-value of each.
        outliers: (row, leave-one-out standard deviations).
        pit_p: p-value of uniform leave-one-out probability integral transforms.
        one_sided: p-value of as many readings far above the model as far below it.
        fixed: only for models with fixed coefficients.
        residuals: (n,), output unit.
        allan: Allan deviation of the residuals beside the noise law; None where readings are not evenly spaced in time.
    """

    entries: tuple[Entry, ...]
    pairs: tuple[Pair, ...]
    unit: str
    rms: float
    noise: float
    autocorrelation: tuple[float, float]
    scatter_with: dict[str, float]
    outliers: tuple[tuple[int, float], ...]
    pit_p: float
    fixed: FixedComparison | None
    residuals: np.ndarray = field(repr=False)
    allan: AllanCheck | None = None
    one_sided: float = 1.0

    def _parts(self) -> list[str | ResultTable]:
        return check_parts(self)

    def data(self) -> list[dict[str, Any]]:
        """Each covariate, as in result.json."""
        return [e.data(self.unit) for e in self.entries]

    def _brief(self) -> str:
        unit = unit_label(self.unit)
        said = f"residuals {self.rms:.3g} {unit} rms, noise {self.noise:.3g} {unit}"
        for most in self.entries[:1]:
            said += f"; most against {most.against}, log Bayes factor {most.log_bayes_factor:z.1f}"
        return said

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each covariate or group; sizes in the output's unit, places in the covariate's."""
        return check_table(self.data()).data()


def check_table(rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Residuals against each covariate; of its rows as they stand in result.json."""

    def signed(places: str) -> Callable[[float | None], str]:
        return lambda value: "–" if value is None else f"{value:{places}}"

    def worst_mean(row: Any) -> str:
        return f"{signed('+.3g')(row['worst']['size'])} {unit_label(row['worst']['unit'])}"

    columns = (
        TableColumn("residuals against", "against"),
        TableColumn("log Bayes factor", "log_bayes_factor", signed("z.1f")),
        TableColumn("worst mean", worst_mean, name=""),
        TableColumn("worst mean", lambda r: r["worst"]["size"], None),
        TableColumn("z", lambda r: r["worst"]["z"], signed("+.1f")),
        TableColumn("where", place_in_words, name=""),
        TableColumn("from", lambda r: r["worst"]["from"], None),
        TableColumn("to", lambda r: r["worst"]["to"], None),
        TableColumn("group", lambda r: r["worst"]["group"] or "", None),
        TableColumn("unit", lambda r: r["worst"]["unit"], None),
    )
    return ResultTable(columns, rows, fold=25)


def check_parts(check: Check, most: int | None = None) -> list[str | ResultTable]:
    """Where a model fails, the worst covariate first.

    Of `most` covariates alone, what always stands below them (neighbours in time, probabilities of single readings,
    Allan deviation) is left out too.
    """
    unit, rows = unit_label(check.unit), check.data()[:most]
    noise = f"judged against noise of {check.noise:.3g} {unit}"
    lines: list[str | ResultTable] = [f"residuals {check.rms:.3g} {unit} rms, {noise}"]
    if check.fixed:
        lines += [_fixed_text(check.fixed, check.residuals, unit), ""]
    lines.append(check_table(rows) if rows else "no covariate varies")
    strong = settings().strong_evidence
    strongest = max(strong, *(e.log_bayes_factor for e in check.entries), -math.inf)
    lines += [
        f"{' and '.join(p.against)} together: interaction not explained by additive terms (log Bayes factor "
        f"{p.log_bayes_factor:.1f})"
        for p in check.pairs[:2]
        if p.log_bayes_factor > strongest
    ]
    if most is None:
        coefficient, z = check.autocorrelation
        lines.append(f"neighbours in time: correlation {coefficient:.2f} (z = {z:.1f})")
    lines += [
        f"scatter changes with {name} (p = {p:.1g})" for name, p in check.scatter_with.items()
    ]
    if check.outliers:
        shown = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers: {shown}{' …' if len(check.outliers) > 5 else ''}")
    if most is None:
        lines.append(f"leave-one-out probabilities uniform: p = {check.pit_p:.2g}")
    if check.one_sided < SIGNIFICANT_P:
        lines.append(f"readings far from the model stand on one side (p = {check.one_sided:.1g})")
    if (found := check.allan) is None or most is not None:
        return lines
    # Where the noise law is contradicted; else its terms as data sheets give them: what a covariate explains is no
    # noise, and has no such terms.
    known = (e.log_bayes_factor for e in check.entries if e.against not in IN_TIME)
    if found.apart is not None:
        lines.append(textwrap.fill(found.sentence(), WIDTH, subsequent_indent="  "))
    elif max(known, default=0.0) <= strong:
        lines += ["", found.table()]
    return lines


def place_in_words(row: Mapping[str, Any]) -> str:
    """Where the worst region of a covariate is: "48.7 to 79.74 °C in run 2", "run 2", "rows 3 to 8"."""
    against, region = row["against"], row["worst"]
    low, high, group = region["from"], region["to"], region["group"]
    if row.get("by_group", against == "run"):  # which results of before 0.4 do not say
        return f"{against} {group}"
    if against == "order":
        return f"row {low:.0f}" if low == high else f"rows {low:.0f} to {high:.0f}"
    unit = unit_label(region["covariate_unit"])
    place = f"at {number(low, 4)}" if low == high else f"{number(low, 4)} to {number(high, 4)}"
    return f"{place} {unit}".rstrip() + (f" in run {group}" if group else "")


def _fixed_text(f: FixedComparison, residuals: np.ndarray, unit: str) -> str:
    known = sum(v**2 for v in f.known.values()) ** 0.5
    lines = [
        f"with the fixed coefficients: {np.sum(residuals > 0)} of {residuals.size} residuals are positive, mean "
        f"{residuals.mean():.2f} ({residuals.min():.2f} to {residuals.max():.2f}) {unit}, rms {f.rms:.2f}",
        f"the same model with free coefficients leaves {f.free_fit:.3g} {unit}: "
        f"the rms is {f.rms / f.noise:.1f} times that",
    ]
    if known > 0:
        parts = ", ".join(f"{k} {v:.2g}" for k, v in f.known.items())
        lines.append(f"known beforehand: {known:.2g} {unit} ({parts}):")
        lines.append(f"  the rms is {f.rms / known:.0f} times that")
    return "\n".join(lines)
