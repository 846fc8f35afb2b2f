"""Files of corrections of three axes: JSON, C99 and Python by templates; tables of a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.vector_correction import (
    NEWTON_STEPS,
    VectorCorrection,
)
from bayescal._annexes.imu.vector_parameters import left_out, parameter_file

PACKAGE = "bayescal._annexes.imu"  # whose templates these are


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
    data = {
        name: repr({k: v for k, v in c.data().items() if uncertainty or k != "covariance"})
        for name, c in named.items()
    }
    return ws.template(PACKAGE, "vector.py.jinja", {"comment": ws.python_words}).render(
        named=named,
        data=data,
        uncertainty=uncertainty,
        newton=NEWTON_STEPS,
    )


KINDS = (
    ws.CorrectionKind(
        of=VectorCorrection,
        axes="three axes",
        writers={
            "json": ws.as_data,
            "c": headers,
            "python": module,
            **{autopilot: ws.in_form(parameter_file, autopilot) for autopilot in AUTOPILOTS},
        },
        suffixes={".json": "json", ".h": "c", ".py": "python"},
        together=("c", "python"),
        describe_omissions=left_out,
    ),
)


def export_vector(
    correction: VectorCorrection,
    path: str | Path,
    format: str | None = None,
    *,
    others: Sequence[VectorCorrection] = (),
    name: str | None = None,
    uncertainty: bool = True,
) -> Path:
    """Write a correction in the format of the path's suffix (.h, .py, .json) or in `format`.

    Args:
        correction: to write.
        path: of the file.
        format: "json", "c", "python", "px4-params" or "ardupilot-params", whatever the suffix.
        others: beside it in one file of C or Python, in the same body axes: gyroscopes beside accelerometers.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        uncertainty: with the covariance; False for C and Python that give what acts alone: of a plain offset and matrix
            twelve numbers are left.

    Raises:
        InputError: another suffix or format, others or no uncertainty in a format that holds none such, two triads of
            one instrument, a name that is none in C, or a place that cannot be written to.
    """
    how = {"name": name, "others": others, "uncertainty": uncertainty}
    return ws.write_text(ws.as_text(correction, ws.format_of(path, format), **how), path)
