"""Export of three-axis corrections as JSON, C99, Python and parameter files of autopilots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.vector_correction import NEWTON_STEPS, VectorCorrection
from bayescal._annexes.imu.vector_parameters import describe_omissions, format_parameter_file

PACKAGE = "bayescal._annexes.imu"  # with the templates


def render_headers(corrections: Mapping[str, VectorCorrection], with_uncertainty: bool) -> str:
    """Render corrections, by sensor name, as C99 headers in one text."""
    template = ws.load_template(PACKAGE, "vector.h.jinja", {"comment": ws.quote_c_comment})

    def render_header(name: str, c: VectorCorrection) -> str:
        content = (c.terms.tolist(), c.covariance.tolist(), c.reference, c.low, c.high)
        fields = {"c": c, "name": name, "guard": ws.format_guard(name, *content, with_uncertainty)}
        fields |= {"uncertainty": with_uncertainty, "recorded": c.low is not None}
        fields["plain"] = not with_uncertainty and c.terms.shape == (1, 12)  # no equation to solve
        fields |= {"thermal": len(c.terms) > 1, "inverse": np.linalg.inv(c.matrix).tolist()}
        return template.render(fields, newton=1 if c.order == 1 else NEWTON_STEPS)

    return "\n".join(render_header(name, c) for name, c in corrections.items())


def render_module(corrections: Mapping[str, VectorCorrection], with_uncertainty: bool) -> str:
    """Render corrections, by sensor name, as one Python module."""
    keys = () if with_uncertainty else ("covariance",)  # omitted
    entries = {name: c.to_json_data().items() for name, c in corrections.items()}
    data = {name: repr({k: v for k, v in e if k not in keys}) for name, e in entries.items()}
    return ws.load_template(
        PACKAGE, "vector.py.jinja", {"comment": ws.quote_python_comment}
    ).render(named=corrections, data=data, uncertainty=with_uncertainty, newton=NEWTON_STEPS)


CORRECTION_KINDS = (
    ws.CorrectionKind(
        correction_class=VectorCorrection,
        axes="three axes",
        writers={
            "json": ws.render_json,
            "c": render_headers,
            "python": render_module,
            **{n: ws.wrap_writer(format_parameter_file, n) for n in AUTOPILOTS},
        },
        suffixes={".json": "json", ".h": "c", ".py": "python"},
        shared_formats=("c", "python"),
        describe_omissions=describe_omissions,
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
    """Write a correction in the format of the path's suffix (.h, .py, .json) or in `format`; return the path.

    Args:
        correction: correction to write.
        path: file to write.
        format: "json", "c", "python", "px4-params" or "ardupilot-params"; overrides the suffix.
        others: corrections for the same C or Python file, in the same body axes: gyroscopes with accelerometers.
        name: name of the sensor in C and Python; default: the instrument's. With `others`, name of the unit.
        uncertainty: include the covariance; False for C and Python that compute the input vector alone.

    Raises:
        InputError: an unknown suffix or format, a format that cannot contain `others` or omit the uncertainty, two
            triads of one instrument, an invalid C name, or a file that cannot be written.
    """
    options = {"name": name, "others": others, "uncertainty": uncertainty}
    return ws.write_text(ws.as_text(correction, ws.choose_format(path, format), **options), path)
