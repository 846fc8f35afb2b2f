"""Files of corrections of three axes: JSON, which is read back, C99 and Python by templates; tables of a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypedDict, get_type_hints

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.vector_correction import (
    NEWTON_STEPS,
    SIZES,
    VectorCorrection,
    term_rows,
    terms_table,
)
from bayescal._annexes.imu.vector_parameters import kalibr_yaml_of, left_out, parameter_file

PACKAGE = "bayescal._annexes.imu"  # whose templates these are


_ARRAYS = dict.fromkeys(("terms", "covariance"), list[list[float]])
SavedCorrection = TypedDict(
    "SavedCorrection",
    {"made_by": str, "equation": str} | get_type_hints(VectorCorrection) | _ARRAYS,
)


def vector_from_data(data: Any, file: str) -> VectorCorrection:
    """Build a correction of three axes from JSON data; raise InputError where it is damaged."""
    try:
        saved = dict(ws.as_type(data, SavedCorrection))
        saved |= {n: np.array(saved[n], float) for n in _ARRAYS}
        terms, covariance = saved["terms"], saved["covariance"]
        fits = terms.ndim == 2 and terms.shape[1] - 9 * bool(saved["beside"]) in SIZES
        if not fits or covariance.shape != 2 * (terms.size,):
            shapes = f"{terms.shape} with a covariance of shape {covariance.shape}"
            raise ValueError(f"terms of shape {shapes}")
    except ValueError as error:
        raise bc.InputError(f"{file} is damaged: {error}. Export it again") from None
    return VectorCorrection(**{f.name: saved[f.name] for f in fields(VectorCorrection)})


def headers(named: Mapping[str, VectorCorrection], uncertainty: bool) -> str:
    """Generate corrections as C99, one after the other."""
    layout = ws.template(PACKAGE, "vector.h.jinja", {"comment": ws.c_comment})

    def header(name: str, c: VectorCorrection) -> str:
        guarded = (c.terms.tolist(), c.covariance.tolist(), c.reference, c.low, c.high, uncertainty)
        return layout.render(
            c=c,
            name=name,
            guard=ws.include_guard(name, *guarded),
            uncertainty=uncertainty,
            recorded=c.low is not None,
            thermal=len(c.terms) > 1,
            # Twelve numbers, and no equation to solve.
            plain=not uncertainty and c.terms.shape == (1, 12),
            inverse=np.linalg.inv(c.matrix).tolist(),
            newton=1 if c.order == 1 else NEWTON_STEPS,
        )

    return "\n".join(header(name, c) for name, c in named.items())


def module(named: Mapping[str, VectorCorrection], uncertainty: bool) -> str:
    """Generate corrections as one Python module."""
    data_by_name = {n: c.data() for n, c in named.items()}
    for data in () if uncertainty else data_by_name.values():
        del data["covariance"]
    return ws.template(PACKAGE, "vector.py.jinja", {"comment": ws.python_words}).render(
        named=named,
        data={n: repr(data) for n, data in data_by_name.items()},
        uncertainty=uncertainty,
        newton=NEWTON_STEPS,
    )


CAPTION = "Three axes: outputs = offset + matrix · what acts, each a polynomial of T − T0; ± one standard uncertainty"


def vector_data(
    calibration: bc.Calibration, average: bc.Calibration | None = None
) -> dict[str, Any] | None:
    """Return offset and 3 × 3 matrix over temperature with standard uncertainties; None for one output."""
    if calibration.model.instrument.vector is None:
        return None
    from bayescal._annexes.imu.vector_series import vector_correction  # loads JAX

    averaged = None if average is None else vector_data(average)
    try:
        correction = vector_correction(calibration)
    except bc.ModelError as error:
        return {"unavailable": str(error), "averaged": averaged}
    whole = {k: v for k, v in correction.data().items() if k != "made_by"}
    return {**whole, "uncertainty": correction.uncertainty.tolist(), "averaged": averaged}


def coefficient_tables(data: Mapping[str, Any]) -> list[tuple[str, ws.ResultTable]]:
    """Tabulate the terms of a correction of three axes, at T0 and by temperature, each ± u; none for one output."""
    last = data.get("vector") or {}
    averaged = last.get("averaged") or {}
    terms = averaged if "terms" in averaged else last
    if "terms" not in terms:
        return []
    rows = term_rows(terms["terms"], terms["uncertainty"], terms["unit"], terms["beside"])
    return [(CAPTION, terms_table(rows))]


THREE_AXES = ws.CorrectionKind(
    of=VectorCorrection,
    axes="three axes",
    writers={
        "json": ws.as_data,
        "c": headers,
        "python": module,
        "yaml": ws.in_form(kalibr_yaml_of),
        **{autopilot: ws.in_form(parameter_file, autopilot) for autopilot in AUTOPILOTS},
    },
    suffixes={".json": "json", ".h": "c", ".py": "python", ".yaml": "yaml", ".yml": "yaml"},
    read=vector_from_data,
    together=("c", "python", "yaml"),
    describe_omissions=left_out,
)


KINDS = (THREE_AXES,)


def export_vector(
    correction: VectorCorrection,
    path: str | Path,
    format: str | None = None,
    *,
    others: Sequence[VectorCorrection] = (),
    name: str | None = None,
    uncertainty: bool = True,
) -> Path:
    """Write a correction in the format of the path's suffix (.h, .py, .json, .yaml) or in `format`.

    Args:
        correction: to write.
        path: of the file.
        format: "json", "c", "python", "yaml" (Kalibr), "px4-params" or "ardupilot-params", whatever the suffix.
        others: beside it in one file of C, Python or Kalibr, in the same body axes: gyroscopes beside accelerometers.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        uncertainty: with the covariance; False for C and Python that give what acts alone: of a plain offset and matrix
            twelve numbers are left.

    Raises:
        InputError: another suffix or format, others or no uncertainty in a format that holds none such, two triads of
            one instrument, a name that is none in C, or a place that cannot be written to.
    """
    how = {"name": name, "others": others, "uncertainty": uncertainty}
    return ws.write_text(ws.as_text(correction, ws.format_of(path, format), **how), path)


def load_vector_correction(path: str | Path) -> VectorCorrection:
    """Load a correction of three axes from its JSON file.

    Raises:
        InputError: there is no such file, it is none, or damaged.
    """
    correction = ws.load_correction(path)
    assert isinstance(correction, VectorCorrection)
    return correction
