"""Effects of an inclinometer's zero and of its test rig; sizes are prior standard deviations.

Every accelerometer has coefficients of its own, so that effects on the instrument have one for each axis; the
dividing table is one and the same for all.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

import bayescal as bc
from bayescal_models.inclinometer.geometry import exact_placement
from bayescal_models.terms import centred, one, progress, term

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
    "zero.mean": (1000.0, "arcsec"),
    "zero.placement_mean": (2.0, "arcsec/deg"),
    "zero.axis": (100.0, "arcsec"),
    "zero.placement_axis": (1.0, "arcsec/deg"),
    "zero.device": (100.0, "arcsec"),
    "zero.placement_device": (1.0, "arcsec/deg"),
}


def _effect(name: str, basis: Callable[..., Any], equation: str, **more: Any) -> bc.Effect:
    """An effect of its plausible size, for each axis unless said otherwise."""
    own = {"per": "axis", "equation": equation, "source": SOURCE}
    return term(name, basis, *SIZES[name], **{**own, **more})


def _placement(name: str, power: int, **more: Any) -> bc.Effect:
    basis, sign = partial(_angle_to, power), {1: "", 2: "²", 3: "³"}[power]
    return _effect(name, basis, f"c·ω{sign}", columns=("placement_angle",), **more)


def _angle_to(power: int, r: bc.Frame) -> Any:
    return r["placement_angle"] ** power


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


ZERO, FACE_SOURCE = "source 4: 3 to 5 mg of bias", "source 4: face vertical within 2″"
LEARNED: dict[str, Any] = {"group_sd": bc.HalfNormal, "varies": ()}

CONSTANT = _effect("zero.constant", one, "c[axis]", source=ZERO)
LINE = _placement("zero.placement", 1, source="source 4: its two lines have 0.72 and 0.07″/deg")
RUN = _effect("zero.run", one, "d[run],  d ~ N(0, s²)", per="run", columns=("run",), **LEARNED)
QUADRATIC = _placement("zero.placement_quadratic", 2)
CUBIC = _placement("zero.placement_cubic", 3)
PROJECTION = _effect(
    "zero.projection",
    partial(_waves, (1,)),
    "S_p·cos ω + S_d·sin ω",
    parts=("pendulum", "door"),
    columns=("placement_angle",),
)
TABLE = _effect(
    "zero.table",
    _spline,
    "natural cubic spline through departures from the line at −45°, −30° … 45°",
    parts=tuple(f"{k:g}" for k in np.rad2deg(KNOTS).round()),
    columns=("placement_angle",),
)
TEMPERATURE = _effect("zero.temperature", centred, "c·(T − T0)", columns=("temperature",))
HYSTERESIS = _effect(
    "zero.hysteresis",
    _sweep,
    "+c in forward sweeps, −c in backward ones",
    columns=("direction",),
    varies=(),
    untestable=_one_way,
)
CROSS_AXIS = _effect(
    "zero.cross_axis", one, "m·sin ω", slot="cross_axis", columns=("placement_angle",)
)
ELECTRICAL = _effect(
    "zero.electrical_tilt", _of_tilt_from_level, "S_e·(1/cos x − 1)", columns=("true_angle",)
)
EXACT = _effect(
    "zero.exact_placement",
    _exact_less_linear,
    "c·(atan2(sin y, √(1 − sin²x − sin²y)) − y)",
    columns=("true_angle", "placement_angle"),
)
ELECTRICAL_ZERO = _effect(
    "zero.electrical", _of_tilt, "S_e/cos x", columns=("true_angle",), varies=()
)
EXACT_PROJECTION = _effect(
    "zero.projection_exact",
    _exact_waves,
    "S_p·cos ω + S_d·sin ω,  ω = atan2(sin y, √(1 − sin²x − sin²y))",
    parts=("pendulum", "door"),
    columns=("true_angle", "placement_angle"),
)
SCALE = _effect("scale.constant", one, "κ", columns=("true_angle",))
WOBBLE = _effect(
    "dividing.wobble",
    partial(_waves, (1, 2)),
    "Σ_m a_m·cos mω + b_m·sin mω,  m = 1, 2",
    per=None,
    parts=("cos1", "sin1", "cos2", "sin2"),
    columns=("placement_angle",),
    source=FACE_SOURCE,
)
FACE = _effect("dividing.face", one, "c", per=None, source=FACE_SOURCE)
DRIFT = _effect("base_tilt.drift", progress, "c·(t − t̄)/(tmax − tmin)", columns=("time",))

# Populations: accelerometers ("axis") and devices as draws from one, with learned spreads.
MEAN = _effect("zero.mean", one, "c", per=None, source=ZERO)
MEAN_LINE = _placement("zero.placement_mean", 1, per=None)
AXIS = _effect("zero.axis", one, "d[axis],  d ~ N(0, s²)", columns=("axis",), **LEARNED)
AXIS_LINE = _placement("zero.placement_axis", 1, group_sd=bc.HalfNormal)
DEVICE = _effect("zero.device", one, "d[device]", per="device", columns=("device",), **LEARNED)
DEVICE_LINE = _placement("zero.placement_device", 1, per="device", group_sd=bc.HalfNormal)
