"""A correction of three axes reduced to an offset and a matrix, and the error of that.

With ⟨·⟩ the mean over the calibrated temperatures, and over all directions of what acts, as large as it was at most in
the calibration (r), least squares of h on an offset and a matrix gives

    offset_i = ⟨offset_i⟩ + r²/3·Σ_a ⟨second_i,aa⟩,     matrix_ij = ⟨matrix_ij⟩ + 3/5·r²·⟨cube_i⟩·δ_ij,

as ⟨x²⟩ = r²/3 and ⟨x⁴⟩ = r⁴/5 on a sphere. Of gyroscopes the offset is that at rest, where it is used: no square adds
to it. All of it is linear in the terms, and so the covariance follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float

from bayescal import workshop as ws
from bayescal._annexes.imu.vector_correction import (
    PAIRS,
    ROUNDING,
    VectorCorrection,
    slopes_by_terms,
)

# Means of polynomials up to the seventh degree: over a range by G. Lobatto's five points, over a sphere by V. Lebedev's
# 26 (Zh. Vychisl. Mat. Mat. Fiz. 16 (1976) 293), the directions of axes, edges and corners of a cube.
RANGE_NODES = np.array([-1.0, -((3 / 7) ** 0.5), 0.0, (3 / 7) ** 0.5, 1.0])
RANGE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180
CORNERS = np.array([c for c in product((-1.0, 0.0, 1.0), repeat=3) if any(c)])
DIRECTION_WEIGHTS = np.array([1 / 21, 4 / 105, 9 / 280])[np.count_nonzero(CORNERS, axis=1) - 1]
DIRECTIONS = CORNERS / np.linalg.norm(CORNERS, axis=1)[:, None]


@dataclass(frozen=True)
class LeftOut:
    """Terms that a form cannot hold, in the unit of the outputs: root mean square on the worst axis, and largest.

    Both over the posterior too: the uncertainty of a poorly known term counts.
    """

    what: str
    rms: float
    largest: float


@dataclass(frozen=True)
class PlainCorrection:
    """Offset, matrix and sensitivity to the secondary input, without temperature and higher orders."""

    # offset (3), matrix by rows (9), what acts beside by rows (9) or none (p)
    terms: Float[np.ndarray, "p"]
    covariance: Float[np.ndarray, "p p"]  # of them (p, p)
    omissions: tuple[LeftOut, ...]  # what has no place in it
    over: str  # of what that is a mean, in words
    unit: str  # of the outputs

    @property
    def offset(self) -> Float[np.ndarray, "3"]:
        return self.terms[:3]

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return self.terms[3:12].reshape(3, 3)

    @property
    def uncertainty(self) -> Float[np.ndarray, "p"]:
        """Return the standard uncertainty of each term."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def omitted(self) -> str:
        """State what is left out, in a sentence; empty for nothing."""
        unit = ws.unit_label(self.unit)
        parts = (
            f"{o.what}, {ws.number(o.rms, 2)} {unit} rms and up to {ws.number(o.largest, 2)} {unit}"
            for o in self.omissions
        )
        text = "; ".join(parts)
        return text and f"Left out, for want of a place: {text} ({self.over})."


def plain_correction(
    correction: VectorCorrection,
    matrix: Literal["full", "diagonal", "none"] = "full",
    with_secondary: bool = True,
) -> PlainCorrection:
    """Project a correction on a form by least squares.

    Args:
        correction: to project.
        matrix: entries in the form; "none" takes the identity.
        with_secondary: whether the form has the secondary input, such as gravity on gyroscopes.
    """
    (k, p), radius, order = correction.terms.shape, correction.reach, correction.order
    warm, shares = np.array([correction.assumed]), np.ones(1)
    if correction.low is not None and correction.high is not None:
        half = 0.5 * (correction.high - correction.low)
        warm, shares = correction.low + half * (1 + RANGE_NODES), RANGE_WEIGHTS
    powers = correction.powers(warm)  # of T − T0
    first = np.r_[0:12, p - 9 * bool(correction.beside) : p]  # terms of first order
    to_plain = np.eye(p)[first]
    for i in range(3):
        if order > 1 and not ws.same_dimension(correction.unit, "rad/s"):
            to_plain[i, [12 + 6 * i + PAIRS.index((a, a)) for a in range(3)]] = radius**2 / 3
        if order > 2:
            to_plain[3 + 4 * i, 30 + i] = 0.6 * radius**2
    has = np.ones(len(first), bool)
    has[3:12] = {"full": np.ones(9, bool), "diagonal": np.eye(3).ravel() > 0, "none": False}[matrix]
    has[12:] = with_secondary
    to_form = np.kron(shares @ powers, to_plain) * has[:, None]
    acts = DIRECTIONS if correction.beside else None
    slopes = slopes_by_terms(radius * DIRECTIONS, order, acts)
    # Of outputs by the terms at each temperature and direction, less what the form has of them.
    residual_slopes = np.einsum("tk,dip->tdikp", powers, slopes)
    residual_slopes -= (slopes[..., first] @ to_form).reshape(len(DIRECTIONS), 3, k, p)
    causes = np.full((k, p), "dependence on temperature", dtype=object)
    causes[0] = of_matrix = (
        "scale factors and misalignments" if matrix == "none" else "misalignments"
    )
    causes[:, 12:30], causes[:, 30:33] = "second order", "third order"
    causes[: 1 if with_secondary else k, first[12:]] = "what acts beside (of size 1)"
    omissions = []
    for cause in dict.fromkeys(causes.ravel()):
        slope = residual_slopes * (causes == cause)
        mean = np.einsum("tdikp,kp->tdi", slope, correction.terms)
        if matrix == "none" and cause == of_matrix:
            mean = mean - radius * DIRECTIONS
        slope = slope.reshape(*mean.shape, -1)
        square = mean**2 + np.sum((slope @ correction.covariance) * slope, axis=-1)
        rms = np.sqrt(np.max(np.einsum("t,d,tdi->i", shares, DIRECTION_WEIGHTS, square)))
        if rms > ROUNDING * radius:
            omissions.append(LeftOut(cause, float(rms), float(np.sqrt(np.max(square)))))
    taken_as_one = np.zeros(len(first))
    taken_as_one[[3, 7, 11]] = matrix == "none"
    return PlainCorrection(
        terms=to_form @ correction.terms.ravel() + taken_as_one,
        covariance=to_form @ correction.covariance @ to_form.T,
        omissions=tuple(omissions),
        over=f"over all directions of {ws.number(radius)} {ws.unit_label(correction.unit)}, {correction.calibrated_at}",
        unit=correction.unit,
    )
