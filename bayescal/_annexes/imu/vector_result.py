"""Three axes in a result: what result.json holds of them, and the table that a report makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayescal import Calibration, ModelError
from bayescal._annexes.imu.vector_correction import term_rows, terms_table
from bayescal._annexes.imu.vector_series import vector_correction
from bayescal.workshop import ResultTable

CAPTION = "Three axes: outputs = offset + matrix · what acts, each a polynomial of T − T0; ± one standard uncertainty"


def vector_data(
    calibration: Calibration, average: Calibration | None = None
) -> dict[str, Any] | None:
    """Offset and 3 × 3 matrix over temperature, with standard uncertainties, of three axes; None of one output."""
    if calibration.model.instrument.vector is None:
        return None
    averaged = None if average is None else vector_data(average)
    try:
        correction = vector_correction(calibration)
    except ModelError as error:
        return {"unavailable": str(error), "averaged": averaged}
    whole = {k: v for k, v in correction.data().items() if k != "made_by"}
    return {**whole, "uncertainty": correction.uncertainty.tolist(), "averaged": averaged}


def matrix_table(data: Mapping[str, Any]) -> ResultTable | None:
    """Of three axes, terms of the correction at T0 and by temperature, each ± u; None of one output."""
    found = data.get("vector")
    if found and "terms" in (averaged := found.get("averaged") or {}):
        found = averaged
    if not found or "terms" not in found:
        return None
    return terms_table(
        term_rows(found["terms"], found["uncertainty"], found["unit"], found["beside"])
    )
