"""The efficient score: what the readings say of a column that is not in the model.

At the fitted model, with every nuisance marginalised under its prior (V = Σ + J·D·Jᵀ, spreads and noise at their
marginal-likelihood estimates), a column X has the score u = XᵀV⁻¹r and the information I = XᵀV⁻¹X. No refit per
candidate. Columns are scaled by their prior standard deviation, so that every prior here is standard normal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._inference.noise_on_record import normal_scores


class Score(NamedTuple):
    """Score and information of P columns.

    u (P,), information (P, P) after the nuisances; `before` (P,): information with every nuisance known.
    """

    u: np.ndarray
    information: np.ndarray
    before: np.ndarray

    def part(self, columns: list[int]) -> Score:
        at = np.ix_(columns, columns)
        return Score(self.u[columns], self.information[at], self.before[columns])

    def given(self, columns: list[int]) -> Score:
        """What the readings say of every column once these, under their unit priors, are nuisances too."""
        inner = self.information[np.ix_(columns, columns)] + np.eye(len(columns))
        cross = self.information[columns]
        pull = np.linalg.solve(inner, np.column_stack([cross, self.u[columns]]))
        left = self.information - cross.T @ pull[:, :-1]
        return Score(self.u - cross.T @ pull[:, -1], left, self.before)


def score(calibration: Calibration, columns: np.ndarray) -> Score:
    """Score and information of columns (n, P) at a fitted model, output unit per prior sd."""
    linear = calibration.linear
    white = linear.whiten(np.asarray(columns, float))
    taken = linear.directions.T @ white
    own = white.T @ white
    # V⁻¹r is Σ⁻¹ times the residuals at the fit.
    return Score(white.T @ linear.white_settled, own - taken.T @ taken, np.diag(own).copy())


class Residuals(NamedTuple):
    """Residuals at the fit (n,): in the output unit; whitened; and the noise's standard deviations, output unit.

    Whitened they are standard normal and independent if the noise law is right: by their probabilities, where it is not
    Gaussian.
    """

    raw: np.ndarray
    white: np.ndarray
    sd: np.ndarray


def residuals(calibration: Calibration) -> Residuals:
    """Residuals of the fitted readings, group deviations as fitted."""
    linear = calibration.linear
    white = linear.white_settled
    noise, assembly = calibration.model.noise, calibration.assembly
    if not noise.gaussian:
        values = assembly.hyper(calibration.mode.v)
        white = normal_scores(noise, values, assembly.record, linear.settled)
    return Residuals(linear.settled, white, np.sqrt(linear.variance))


def fitted_directions(calibration: Calibration) -> np.ndarray:
    """G (n, q): the whitened residuals at the fit have the covariance I − G·Gᵀ if the model is right."""
    return calibration.linear.directions


def projections(
    calibration: Calibration, residual: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """CᵀΣ⁻¹r and CᵀΣ⁻¹C of columns (n, P) and the residuals at the fit: no nuisance is taken out again."""
    white = calibration.linear.whiten(np.column_stack([columns, residual]))
    return white[:, :-1].T @ white[:, -1], white[:, :-1].T @ white[:, :-1]
