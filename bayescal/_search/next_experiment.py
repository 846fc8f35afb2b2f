"""Design of the next experiment: the campaign that would best distinguish effects that present readings do not.

Each member of a credible set is fitted to the present readings and predicts a normal distribution of a campaign's
readings (posterior draws, new group members and noise). The expected log Bayes factor between two members, if one of
them is the truth, is the Kullback–Leibler divergence of the two distributions, in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._core.errors import ModelError
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.progress import track
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.measurements import Measurements
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.noise_on_record import whitening
from bayescal._model.effect import Effect
from bayescal._model.frame import build_frame

# Log Bayes factor that settles a question: odds of 150 (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773).
VERY_STRONG_NATS = 5.0

POSTERIOR_DRAWS = 300  # draws of each member: enough to rank campaigns, as noise is in closed form
# Largest number of readings of a campaign that are predicted, evenly spread: their covariances are n × n.
MAX_READINGS = 1500


@dataclass(frozen=True)
class Experiment:
    """A feasible campaign, with the evidence expected from it."""

    name: str  # description of the campaign
    # (true effect, rival effect) → expected log Bayes factor for the true one
    expected: dict[tuple[str, str], float]
    readings: Measurements = field(repr=False)  # planned readings; their outputs are not used

    @property
    def minimum(self) -> float:
        """Return the smallest expected log Bayes factor of a true effect against a rival: the ranking criterion."""
        return self.expected[self.hardest_pair]

    @property
    def hardest_pair(self) -> tuple[str, str]:
        """Return the pair (true effect, rival effect) with the smallest expected log Bayes factor."""
        return min(self.expected, key=lambda pair: self.expected[pair])


@dataclass(frozen=True, repr=False)
class NextExperiment(Printed):
    """Feasible campaigns to distinguish `members`, effects; ranked by the smallest expected log Bayes factor."""

    members: tuple[str, ...]
    experiments: tuple[Experiment, ...]

    def _format_summary(self) -> str:
        return f"to tell apart {', '.join(self.members)}: {self.experiments[0].name}"

    def _list_parts(self) -> list[str | ResultTable]:
        """Return the feasible experiments, the most informative first."""
        columns = (
            TableColumn("experiment", lambda e: e.name),
            TableColumn("log Bayes factor", lambda e: e.minimum, "{:.1f}".format),
            TableColumn("least expected for", lambda e: " against ".join(e.hardest_pair)),
        )
        lines: list[str | ResultTable] = [
            f"to tell apart: {', '.join(self.members)}",
            ResultTable(columns, self.experiments, width=25),
        ]
        if self.experiments[0].minimum < VERY_STRONG_NATS:
            lines.append(
                "No experiment is expected to distinguish them by a log Bayes factor of "
                f"{VERY_STRONG_NATS:g}."
            )
        return lines


def next_experiment(
    calibration: Calibration,
    effects: Sequence[Effect | str],
    experiments: Mapping[str, Measurements] | None = None,
) -> NextExperiment:
    """Rank feasible campaigns by the evidence with which they would distinguish effects.

    Args:
        calibration: fit of a model that lacks one of the effects.
        effects: two or more effects that its readings cannot distinguish, such as a finding of `discover`.
        experiments: name → readings of a campaign as recorded (outputs are not used); default: the instrument's.

    Raises:
        ModelError: fewer than two effects, no feasible campaign, or one that lacks a column that an effect needs.
    """
    instrument = calibration.model.instrument
    candidates = [instrument.effect(e) if isinstance(e, str) else e for e in effects]
    if len(candidates) < 2:
        raise ModelError(f"next_experiment needs at least two effects, not {len(candidates)}")
    plans = experiments
    if plans is None:
        listed = instrument.experiments
        plans = {n: Measurements.from_arrays(instrument, **record()) for n, record in listed}
    if not plans:
        raise ModelError(
            f"Instrument {instrument.name!r} lists no experiment: give readings of feasible campaigns, "
            "next_experiment(calibration, effects, {'slower': readings, …})"
        )
    with track("fitting the model with each effect"):
        method = LeastSquares(draws=POSTERIOR_DRAWS)
        options: dict[str, Any] = {"reference": calibration.reference, "strict": False}
        model, fitted_readings = calibration.model, calibration.readings
        fits = {e.name: fit(model + e, fitted_readings, method, **options) for e in candidates}
    with track("predicting each experiment"):
        campaigns = list[Experiment]()
        for name, readings in plans.items():
            predictions = {n: predict_campaign(c, readings) for n, c in fits.items()}
            pairs = permutations(fits, 2)
            factors = {pair: compute_divergence(*(predictions[n] for n in pair)) for pair in pairs}
            campaigns.append(Experiment(name, factors, readings))
    return NextExperiment(tuple(fits), tuple(sorted(campaigns, key=lambda e: -e.minimum)))


@dataclass(frozen=True)
class CampaignPrediction:
    """Predictive distribution of a campaign's readings: mean (n,) and covariance (n, n), output unit."""

    mean: np.ndarray
    covariance: np.ndarray


def compute_divergence(truth: CampaignPrediction, rival: CampaignPrediction) -> float:
    """Return the Kullback–Leibler divergence of two normals, nats: the expected log density ratio."""
    # ½·(tr Σ₂⁻¹Σ₁ + dᵀΣ₂⁻¹d − n + log|Σ₂|/|Σ₁|) by Cholesky factors: W = L₂⁻¹L₁ has the trace as its sum of squares
    # and half of −log|Σ₂|/|Σ₁| as the logarithms of its diagonal.
    cholesky = np.linalg.cholesky(rival.covariance)
    product = np.linalg.solve(cholesky, np.linalg.cholesky(truth.covariance))
    difference = np.linalg.solve(cholesky, rival.mean - truth.mean)
    log_sum = np.sum(np.log(np.abs(np.diag(product))))  # both factors are triangular: so is W
    return float(0.5 * (np.sum(product**2) + difference @ difference - difference.size) - log_sum)


@run_on_one_thread
def predict_campaign(calibration: Calibration, readings: Measurements) -> CampaignPrediction:
    """Predict the readings of a campaign by a fitted model, at most `MAX_READINGS`, evenly spread.

    Expected outputs are computed from posterior draws, for new group members; noise and the deviations of new members
    in closed form, since a covariance matrix from draws alone has at most their number as rank.
    """
    calibration.model.require(readings)
    readings = readings.select(np.arange(0, len(readings), -(-len(readings) // MAX_READINGS)))
    frame = build_frame(readings, calibration.reference)
    # Group members of a planned campaign are new ones: their deviations become covariance between their readings.
    codes = {group: np.asarray(code) for group, code in frame.codes.items()}
    design = replace(frame, codes={group: np.full_like(code, -1) for group, code in codes.items()})
    problem = calibration.problem_on(design)
    record, (x, v) = problem.record, calibration.draws(POSTERIOR_DRAWS)
    means = problem.expected(x, problem.hyper(v.T))
    centred = means - means.mean(axis=0)
    # Noise and inputs at the median of the draws. Whitening the unit matrix gives L⁻¹; Σ = (L⁻ᵀL⁻¹)⁻¹, for any law.
    hyper = problem.hyper(np.median(v, axis=0))
    whitening_matrix = whitening(problem.noise, hyper, record)(np.eye(record.size))
    mean_x = x.mean(axis=0)[None]
    variance = np.broadcast_to(problem.expected_and_extra(mean_x, hyper)[1], (1, record.size))[0]
    covariance = np.linalg.inv(whitening_matrix.T @ whitening_matrix) + np.diag(variance)
    grouped_terms = [t for t in problem.terms if t.per is not None and t.place != "fixed"]
    _, slopes = problem.expected_with_slopes(mean_x, hyper, grouped_terms)
    for t, slope in zip(grouped_terms, slopes, strict=True):
        sd = t.prior_sd if t.group_sd_name is None else hyper[t.group_sd_name]
        column, member = np.reshape(slope, -1) * sd, codes[str(t.per)]
        is_same = (member[:, None] == member) & (member[:, None] >= 0)
        covariance += is_same * np.outer(column, column)
    return CampaignPrediction(means.mean(axis=0), centred.T @ centred / len(means) + covariance)
