"""Tables of bias and scale factor per point, as readings.

Where a laboratory keeps only its results (bias b and scale factor K at each point), each row becomes two readings,
at +A and −A:

    E± = b ± (1 + κ)·A,   κ = K/Kn − 1,   A = u(b)/u(κ) in units of g

With independent standard uncertainties √2·u(b) of E+ and E−, their half sum and half difference have exactly the
stated u(b) and u(κ), uncorrelated: the readings say what the table says, no more. Without uncertainties A is 1 g.
These are not readings that anyone took: a² is one constant, so K2 is not to be told from bias.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer import SCALE_FACTOR
from bayescal_models.quartz_beam_accelerometer.model import INSTRUMENT


def from_tables(
    *,
    bias: ArrayLike,
    scale_factor: ArrayLike,
    nominal: float = SCALE_FACTOR,
    bias_uncertainty: float | None = None,
    scale_uncertainty: float | None = None,
    **columns: ArrayLike,
) -> bc.Measurements:
    """Readings that say what a table of bias and scale factor says.

    Args:
        bias: b of each point, µg, (n,).
        scale_factor: K of each point, Hz/g, (n,).
        nominal: Kn, Hz/g.
        bias_uncertainty, scale_uncertainty: standard uncertainties of a b (µg) and a K (Hz/g), both or neither.
        **columns: the instrument's other columns, one entry per point: temperature_circuit and temperature_head;
            run, temperature_point, time, frequency_sum where there are any.

    Returns:
        2n readings, each point's two one after the other.

    Raises:
        InputError: one uncertainty without the other, one that is not positive, a nominal scale factor of zero,
            tables of unequal length, or what the instrument refuses.
    """
    if (bias_uncertainty is None) != (scale_uncertainty is None):
        raise bc.InputError(
            "from_tables: bias_uncertainty and scale_uncertainty go together; give both, or neither"
        )
    for name, value in (
        ("nominal", nominal),
        ("bias_uncertainty", bias_uncertainty),
        ("scale_uncertainty", scale_uncertainty),
    ):
        if value is not None and not value > 0:
            raise bc.InputError(f"from_tables: {name} {value} must be a positive number")
    b, k = np.asarray(bias, dtype=float), np.asarray(scale_factor, dtype=float) / nominal
    lengths = {name: np.shape(c) for name, c in {"bias": b, "scale_factor": k, **columns}.items()}
    if len(set(lengths.values())) != 1 or b.ndim != 1:
        shown = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
        raise bc.InputError(f"from_tables: one entry per point is needed, these are: {shown}")
    reach = 1e6  # µg
    if bias_uncertainty is not None and scale_uncertainty is not None:
        reach = bias_uncertainty / (scale_uncertainty / nominal)
        columns["output_uncertainty"] = np.full(b.size, np.sqrt(2.0) * bias_uncertainty)
    sign = np.tile([1.0, -1.0], b.size)
    doubled: dict[str, Any] = {name: np.repeat(np.asarray(c), 2) for name, c in columns.items()}
    return bc.Measurements.from_arrays(
        INSTRUMENT,
        **doubled,
        acceleration=sign * reach,
        output=np.repeat(b, 2) + sign * np.repeat(k, 2) * reach,
    )
