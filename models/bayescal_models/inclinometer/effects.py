"""Effects of an inclinometer's zero and of its test rig; sizes are prior standard deviations.

Every accelerometer has coefficients of its own, so that effects on the instrument have one for each axis; the
dividing table is one and the same for all.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

import bayescal as bc
from bayescal_models.inclinometer.geometry import exact_placement

SOURCE = "source 4; size ours"
KNOTS = np.deg2rad(np.arange(-45.0, 46.0, 15.0))  # of the spline table
ARCSEC_PER = {  # what a coefficient of 1 adds to its slot: arcsec (per rad, rad², rad³), or 1
    "arcsec": 1.0,
    "arcsec/degC": 1.0,
    "arcsec/deg": np.rad2deg(1.0),
    "arcsec/deg^2": np.rad2deg(1.0) ** 2,
    "arcsec/deg^3": np.rad2deg(1.0) ** 3,
    "ppm": 1e-6,
}
# Canonical name → plausible size and unit. Document: a bias of 3 to 5 mg is 619 to 1031″; table 2″.
SIZES = {
    "zero.constant": (1000.0, "arcsec"),
    "zero.placement": (2.0, "arcsec/deg"),
    "zero.run": (2.0, "arcsec"),
    "zero.placement_quadratic": (0.005, "arcsec/deg^2"),
    "zero.placement_cubic": (1e-4, "arcsec/deg^3"),
    "zero.projection": (100.0, "arcsec"),
    "zero.table": (20.0, "arcsec"),
    "zero.electrical": (1000.0, "arcsec"),
    "zero.projection_exact": (100.0, "arcsec"),
    "zero.temperature": (2.0, "arcsec/degC"),
    "zero.hysteresis": (2.0, "arcsec"),
    "zero.cross_axis": (100.0, "arcsec"),
    "zero.electrical_tilt": (100.0, "arcsec"),
    "zero.exact_placement": (2.0, "arcsec/deg"),
    "scale.constant": (100.0, "ppm"),
    "dividing.wobble": (2.0, "arcsec"),
    "dividing.face": (2.0, "arcsec"),
    "base_tilt.drift": (2.0, "arcsec"),
    "zero.axis": (100.0, "arcsec"),
    "zero.placement_axis": (1.0, "arcsec/deg"),
    "zero.device": (100.0, "arcsec"),
    "zero.placement_device": (1.0, "arcsec/deg"),
}


def _effect(
    name: str,
    basis: Callable[..., Any],
    equation: str,
    *,
    slot: str | None = None,
    parts: tuple[str, ...] = ("",),
    per: Literal["axis", "run", "device"] | None = "axis",
    learned: bool = False,
    source: str = SOURCE,
    **more: Any,
) -> bc.Effect:
    """An effect of one size, for each axis unless said otherwise, its spread learned or not."""
    size, unit = SIZES[name]
    spread = bc.HalfNormal(size) if learned else None
    return bc.Effect(
        name,
        slot or name.split(".")[0],
        basis,
        coefficients=tuple(
            bc.Coefficient(unit, bc.Normal(0.0, size), part=part, per=per, group_sd=spread)
            for part in parts
        ),
        equation=equation,
        source=source,
        **more,
    )


def _placement(name: str, power: int, **more: Any) -> bc.Effect:
    return _effect(
        name,
        partial(_angle_to, power),
        "c·ω" + {1: "", 2: "²", 3: "³"}[power],
        columns=("placement_angle",),
        varies=("placement_angle",),
        **more,
    )


def _one(r: bc.Frame) -> float:
    return 1.0


def _progress(r: bc.Frame) -> Any:
    return r.progress


def _angle_to(power: int, r: bc.Frame) -> Any:
    return r["placement_angle"] ** power


def _centred(r: bc.Frame) -> Any:
    return r.centred("temperature")


def _sweep(r: bc.Frame) -> Any:
    return r.has_label("direction", "forward") - r.has_label("direction", "backward")


def _of_tilt(r: bc.Frame) -> Any:
    return 1 / jnp.cos(r["true_angle"])


def _of_tilt_from_level(r: bc.Frame) -> Any:
    return _of_tilt(r) - 1


def _exact_less_linear(r: bc.Frame) -> Any:
    return exact_placement(r["true_angle"], r["placement_angle"], jnp) - r["placement_angle"]


def _waves(orders: tuple[int, ...], r: bc.Frame) -> Any:
    angle = r["placement_angle"]
    return jnp.stack([f(m * angle) for m in orders for f in (jnp.cos, jnp.sin)], axis=1)


def _exact_waves(r: bc.Frame) -> Any:
    angle = exact_placement(r["true_angle"], r["placement_angle"], jnp)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)


def _spline(r: bc.Frame) -> Any:
    """Values of the natural cubic splines that are 1 at one knot and 0 at the others; straight lines beyond."""
    angle = r["placement_angle"]
    spline = CubicSpline(KNOTS, np.eye(KNOTS.size), bc_type="natural")
    low, high = KNOTS[0], KNOTS[-1]
    inside = jnp.clip(angle, low, high)
    step = KNOTS[1] - KNOTS[0]
    piece = jnp.clip(jnp.floor((inside - low) / step).astype(int), 0, KNOTS.size - 2)
    h = (inside - low - piece * step)[:, None]
    c = jnp.asarray(spline.c)[:, piece]
    slope = jnp.where((angle < low)[:, None], spline(low, 1), spline(high, 1))
    return c[3] + h * (c[2] + h * (c[1] + h * c[0])) + (angle - inside)[:, None] * slope


def _one_way(readings: bc.Measurements) -> str | None:
    """Why the directions of these readings show no hysteresis, if so."""
    found = set(readings.groups("direction")[0])
    if {"forward", "backward"} <= found:
        return None
    return f"needs sweeps forward and backward; these readings have {', '.join(sorted(found))} only"


CONSTANT = _effect("zero.constant", _one, "c[axis]", source="source 4: 3 to 5 mg of bias")
LINE = _placement("zero.placement", 1, source="source 4: its two lines have 0.72 and 0.07″/deg")
RUN = _effect("zero.run", _one, "d[run],  d ~ N(0, s²)", per="run", learned=True, columns=("run",))
QUADRATIC = _placement("zero.placement_quadratic", 2)
CUBIC = _placement("zero.placement_cubic", 3)
PROJECTION = _effect(
    "zero.projection",
    partial(_waves, (1,)),
    "S_p·cos ω + S_d·sin ω",
    parts=("pendulum", "door"),
    columns=("placement_angle",),
    varies=("placement_angle",),
)
TABLE = _effect(
    "zero.table",
    _spline,
    "natural cubic spline through departures from the line at −45°, −30° … 45°",
    parts=tuple(f"{k:g}" for k in np.rad2deg(KNOTS).round()),
    columns=("placement_angle",),
    varies=("placement_angle",),
)
TEMPERATURE = _effect(
    "zero.temperature",
    _centred,
    "c·(T − T0)",
    columns=("temperature",),
    varies=("temperature",),
)
HYSTERESIS = _effect(
    "zero.hysteresis",
    _sweep,
    "+c in forward sweeps, −c in backward ones",
    columns=("direction",),
    untestable=_one_way,
)
CROSS_AXIS = _effect(
    "zero.cross_axis",
    _one,
    "m·sin ω",
    slot="cross_axis",
    columns=("placement_angle",),
    varies=("placement_angle",),
)
ELECTRICAL = _effect(
    "zero.electrical_tilt",
    _of_tilt_from_level,
    "S_e·(1/cos x − 1)",
    columns=("true_angle",),
    varies=("true_angle",),
)
EXACT = _effect(
    "zero.exact_placement",
    _exact_less_linear,
    "c·(atan2(sin y, √(1 − sin²x − sin²y)) − y)",
    columns=("true_angle", "placement_angle"),
    varies=("true_angle", "placement_angle"),
)
ELECTRICAL_ZERO = _effect(
    "zero.electrical",
    _of_tilt,
    "S_e/cos x",
    columns=("true_angle",),
)
EXACT_PROJECTION = _effect(
    "zero.projection_exact",
    _exact_waves,
    "S_p·cos ω + S_d·sin ω,  ω = atan2(sin y, √(1 − sin²x − sin²y))",
    parts=("pendulum", "door"),
    columns=("true_angle", "placement_angle"),
    varies=("true_angle", "placement_angle"),
)
SCALE = _effect("scale.constant", _one, "κ", columns=("true_angle",), varies=("true_angle",))
WOBBLE = _effect(
    "dividing.wobble",
    partial(_waves, (1, 2)),
    "Σ_m a_m·cos mω + b_m·sin mω,  m = 1, 2",
    per=None,
    parts=("cos1", "sin1", "cos2", "sin2"),
    columns=("placement_angle",),
    varies=("placement_angle",),
    source="source 4: face vertical within 2″",
)
FACE = _effect("dividing.face", _one, "c", per=None, source="source 4: face vertical within 2″")
DRIFT = _effect("base_tilt.drift", _progress, "c·(t − t̄)/(tmax − tmin)", columns=("time",))

# Populations: accelerometers ("axis") and devices as draws from one, with learned spreads.
MEAN = bc.Effect(
    "zero.mean",
    "zero",
    _one,
    coefficients=(bc.Coefficient("arcsec", bc.Normal(0.0, 1000.0)),),
    equation="c",
    source="source 4: 3 to 5 mg of bias",
)
MEAN_LINE = bc.Effect(
    "zero.placement_mean",
    "zero",
    partial(_angle_to, 1),
    coefficients=(bc.Coefficient("arcsec/deg", bc.Normal(0.0, 2.0)),),
    columns=("placement_angle",),
    varies=("placement_angle",),
    equation="c·ω",
    source=SOURCE,
)
AXIS = _effect("zero.axis", _one, "d[axis],  d ~ N(0, s²)", learned=True, columns=("axis",))
AXIS_LINE = _placement("zero.placement_axis", 1, learned=True)
DEVICE = _effect("zero.device", _one, "d[device]", per="device", learned=True, columns=("device",))
DEVICE_LINE = _placement("zero.placement_device", 1, per="device", learned=True)
