"""ng accelerometer on a tilted, turning table, at several temperatures (source 0).

Measurement equation, output in µg of nominal scale (volts become µg by the nominal scale factor):

    output = K0 + (1 + κ)·a + K2·a² + K3·a³ + Kip·a·ap

The table's face is tilted by γ (column `tilt`) and turned to θ (column `position_angle`), nominally a = g·sin γ·sin θ;
a in µg (mg under K2 and K3), ap in g. K0 is not multiplied by 1 + κ. The direction of gravity is exact, without small-
angle approximation: in the tilted frame that does not rotate (e0 along θ = 0, e90 along θ = 90°, n normal to the face)
the unit vector "up" and the input axis are

    u = ( sin γ2∥,  cos γ2∥·sin(γ + γ2⊥),  cos γ2∥·cos(γ + γ2⊥) )
    s = ( cos γ1·cos θ,  cos γ1·sin θ,  sin γ1 )

so that a = g·u·s along the input axis, and ap = g·u·n along the normal, the pendulous axis (source 0, sections 2
and 3; the exact form is derived here).

Slots: `bias` = K0, µg; `scale` = κ; `fixture_tilt` = γ1, rad; `base_tilt_parallel` = γ2∥ and `base_tilt_perp` =
γ2⊥, rad; `second_order` = K2, µg/mg²; `third_order` = K3, µg/mg³; `cross_coupling` = Kip, 1/g; `rotation`, added
to θ, rad; `gravity`, relative, which scales a and ap. A *cell* is one temperature point of one run.

An error of the set tilt γ enters only as γ + γ2⊥, so `tilt.setting` is an exact alias of `base_tilt.constant[perp]`;
both are kept, with a line each in the uncertainty budget, and together contribute √2·617 ppm to the uncertainty of the
scale factor at 0.45°. Further aliases in a cell: bias with the fixture tilt, scale factor with γ2⊥ and with Kip, γ2∥
with `rotation`. Only priors, changes with time or laboratory temperature, or other set-ups separate them.

`base_tilt.temperature[perp]` is an exact alias of `scale.temperature`, `fixture_tilt.temperature` nearly one of
`bias.temperature`: with them the uncertainty of these tempcos is that of their priors, for any number of readings.

`temperature.reading` is the error of the thermometer (2 mK, assumed by us; errors in variables), 0.09 µg of a reading
at 44 µg/°C; in a model without it the slope of the fitted line is biased towards zero.

Noise: white, of unknown size (0.05 to 5 µg; source 0 gives 3 ng/√Hz for the sensor alone).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

from jaxtyping import Float

import bayescal as bc
from bayescal import effects, xp
from bayescal_models import catalogue, local_gravity
from bayescal_models.catalogue import (
    HOUR,
    MINUTE,
    EffectTable,
    Factory,
    centred,
    effect,
    family,
    one,
    progress,
)
from bayescal_models.ng_accelerometer import COLUMNS, NOMINAL_SCALE
from bayescal_models.ng_accelerometer.campaign import Campaign
from bayescal_models.ng_accelerometer.simulator import simulate_columns
from bayescal_models.simulated import DEGREE, list_experiments, make_readings_simulator

G = 1e6  # µg
HARMONICS = (2, 3)  # orders of rotation harmonics; the first is a base tilt
HARMONIC_PARTS = tuple(f"{wave}{m}" for m in HARMONICS for wave in ("cos", "sin"))
DEAD_BAND_DEGC = 1.0  # °C: a chamber that holds its temperature wanders by 0.1 °C (source 0)
CONSTITUENTS = {  # of the tide: period, h, and amplitude relative to M2
    "M2": (12.4206012, 1.0),
    "S2": (12.0, 0.5),
    "N2": (12.6583475, 0.2),
    "K1": (23.9344721, 0.6),
    "O1": (25.8193387, 0.4),
}
TILT = 0.45 * DEGREE
INVERTED_TILT = 180 * DEGREE - TILT


class Accelerations(NamedTuple):
    """Specific force on the accelerometer: along the input axis, µg, and along the table's normal, g."""

    input_axis: Float[Any, "n"]
    normal: Float[Any, "n"]


def resolve_gravity(
    tilt: Float[Any, "n"],
    angle: Float[Any, "n"],
    fixture_tilt: Float[Any, "n"],
    parallel: Float[Any, "n"],
    perp: Float[Any, "n"],
) -> Accelerations:
    """Return the specific force of gravity in the axes of the accelerometer, from angles in rad.

    Args:
        tilt: γ, tilt of the table's face.
        angle: θ, rotation angle of the face, including the azimuth of the input axis.
        fixture_tilt: γ1, tilt of the input axis out of the face.
        parallel, perp: γ2∥ and γ2⊥, tilts of the base along θ = 0 and along θ = 90°.
    """
    e0, e90 = xp.sin(parallel), xp.cos(parallel) * xp.sin(tilt + perp)
    n = xp.cos(parallel) * xp.cos(tilt + perp)
    in_face = e0 * xp.cos(angle) + e90 * xp.sin(angle)
    return Accelerations(G * (xp.cos(fixture_tilt) * in_face + xp.sin(fixture_tilt) * n), n)


def _evaluate_response(slots, r):
    a, ap = resolve_gravity(
        r["tilt"],
        r["position_angle"] + slots["rotation"],
        slots["fixture_tilt"],
        slots["base_tilt_parallel"],
        slots["base_tilt_perp"],
    )
    a, ap = a * (1 + slots["gravity"]), ap * (1 + slots["gravity"])
    a_mg = a / 1e3
    return (
        slots["bias"]
        + (1 + slots["scale"]) * a
        + slots["second_order"] * a_mg**2
        + slots["third_order"] * a_mg**3
        + slots["cross_coupling"] * a * ap
    )


def _use_output(a, slots, r):
    """Return the output, µg, of the instrument without the rotary table, for an acceleration `a`, µg."""
    a_mg = a / 1e3
    nonlinear_terms = slots["second_order"] * a_mg**2 + slots["third_order"] * a_mg**3
    return slots["bias"] + (1 + slots["scale"]) * a + nonlinear_terms


# Basis functions.


def evaluate_harmonics(r: bc.Frame, factor: Float[Any, "n"] | float = 1.0) -> Float[Any, "n 4"]:
    """Return cos mθ and sin mθ of the table's rotation angle θ, m = 2 and 3, times `factor`."""
    angle = r["position_angle"]
    waves = [wave(m * angle) for m in HARMONICS for wave in (xp.cos, xp.sin)]
    return xp.stack(waves, axis=-1) * xp.reshape(xp.asarray(factor), (-1, 1))


def evaluate_tidal_waves(r: bc.Frame) -> Float[Any, "n 20"]:
    """Return the cosine and sine of each tidal constituent, first for one base tilt component, then for the other."""
    phase = [2 * xp.pi * r["time"] / (period_h * HOUR) for period_h, _ in CONSTITUENTS.values()]
    waves = [wave(p) for p in phase for wave in (xp.cos, xp.sin)]
    return xp.stack([*waves, *waves], axis=-1)


def evaluate_temperature_direction(r: bc.Frame) -> Float[Any, "n"]:
    """Return the sign of the last temperature change in the run that exceeded the dead band; 0 before the first one.

    For readings at soaked temperature points this is the sign of the temperature difference from the previous cell.
    """
    temperature, is_run_start = r.record["temperature"][r.order], r.step < 0

    def advance(state, row):
        reference, sign = state
        value, is_first = row
        has_changed = xp.abs(value - reference) > DEAD_BAND_DEGC
        sign = xp.where(is_first, 0.0, xp.where(has_changed, xp.sign(value - reference), sign))
        return (xp.where(is_first | has_changed, value, reference), sign), sign

    start = (temperature[0], xp.zeros(()))
    return xp.scatter(r.order, xp.scan(advance, start, (temperature, is_run_start)))


def _centre_lab(r: bc.Frame) -> Float[Any, "n"]:
    return r.centred("lab_temperature")


def _evaluate_thermal_harmonics(r: bc.Frame) -> Float[Any, "n 4"]:
    return evaluate_harmonics(r, r.centred())


def _evaluate_harmonic(r: bc.Frame) -> Float[Any, "n 2"]:
    return xp.stack([xp.cos(r["position_angle"]), xp.sin(r["position_angle"])], axis=-1)


# Factories and effects of this instrument.

TILT_COMPONENTS = ("parallel", "perp")


def _base(basis: Any, equation: str, *columns: str, **fields: Any) -> Factory:
    """Return a factory that creates an effect on both components of the base tilt, included together."""
    slots = [f"base_tilt_{component}" for component in TILT_COMPONENTS]
    return family(slots, basis, equation, *columns, parts=TILT_COMPONENTS, **fields)


def _build_tide(name: str, size: float, unit: str, source: str) -> bc.Effect:
    """Build the tidal effect: cosine and sine of each constituent and tilt component; `size` is that of M2."""
    return bc.Effect(
        name,
        "base_tilt_parallel",
        basis=evaluate_tidal_waves,
        coefficients=tuple(
            bc.Coefficient(
                unit,
                bc.Normal(0.0, size * factor),
                part=f"{component},{constituent},{wave}",
                slot=f"base_tilt_{component}",
            )
            for component in TILT_COMPONENTS
            for constituent, (_, factor) in CONSTITUENTS.items()
            for wave in ("cos", "sin")
        ),
        columns=("time",),
        varies=("time",),
        equation="Σ c·cos(2πt/P) + s·sin(2πt/P) over M2, S2, N2, K1, O1, for each component",
        source=source,
    )


# The standard deviation between cells is known a priori to within one or two orders of magnitude.
CELL_TERMS = ("d[cell],  d ~ N(0, s²)", "temperature_point")
CELL_OPTIONS: dict[str, Any] = {"per": "cell", "group_sd_prior": bc.HalfCauchy, "varies": ()}
CELL_EFFECT = effect(one, *CELL_TERMS, **CELL_OPTIONS)
BASE_CELL_EFFECT = _base(one, *CELL_TERMS, **CELL_OPTIONS)
SETTING = effect(one, "c, added to γ like γ2⊥", "tilt", slot="base_tilt_perp", varies=())
LAG_EFFECT = catalogue.thermal_lag(MINUTE, 3 * HOUR, 5.0, "ug", rate=(2.0, "ug/(degC/h)"))
HYSTERESIS_EFFECT = effect(
    evaluate_temperature_direction,
    f"c·sign(T − T of the previous cell),  0 in the first; dead band {DEAD_BAND_DEGC:g} °C",
    *("time", "temperature"),
    untestable=partial(catalogue.explain_missing_reversal, "temperature", DEAD_BAND_DEGC),
    kind="hysteresis",
)
RUN_TEMPCO = effect(
    centred,
    "d[run]·(T − T0),  d ~ N(0, s²)",
    *("run", "temperature"),
    per="run",
    group_sd_prior=bc.HalfNormal,
    varies=("temperature",),
)
POSITION_TEMPCO = effect(
    _evaluate_thermal_harmonics,
    "(T − T0)·Σ(c·cos mθ + s·sin mθ),  m = 2, 3",
    *("position_angle", "temperature"),
    parts=HARMONIC_PARTS,
)
BASE_CONSTANT = _base(one, "c, one for each component", kind="constant")
BASE_LABORATORY = _base(_centre_lab, "c·(L − L0), one c for each component", "lab_temperature")
BASE_TEMPCO = _base(centred, "c·(T − T0), one c for each component", "temperature", kind="linear")
BASE_DRIFT = _base(
    progress,
    "c·(t − t̄)/(tmax − tmin), one c for each component",
    "time",
    varies=("time",),
    kind="drift",
)
K2, K3, KIP = (effect(one, symbol, "position_angle") for symbol in ("K2", "K3", "Kip"))
KIP_TEMPCO = effect(centred, "c·(T − T0)", "position_angle", "temperature")
DIVIDING_ERROR = effect(
    _evaluate_harmonic,
    "c·cos θ + s·sin θ, dividing error of the table",
    "position_angle",
    parts=("cos", "sin"),
)
WOBBLE = effect(
    evaluate_harmonics,
    "Σ(c·cos mθ + s·sin mθ),  m = 2, 3, wobble of the spindle",
    "position_angle",
    slot="fixture_tilt",
    parts=HARMONIC_PARTS,
)
FIXTURE_SOURCE = "source 0: within 2′, taken as 95 %"
TIDE_SOURCE = "periods: astronomical; ±200 nrad in total: source 0; relative amplitudes assumed"
ANGLE_SOURCE = "source 0: the table's angle is good to 1″"

EFFECTS = EffectTable.from_rows(
    "after source 0; size assumed by us",
    baseline=(
        ("bias.constant", catalogue.constant, 5000.0, "ug"),
        ("bias.temperature", catalogue.linear, 50.0, "ug/degC"),
        ("bias.cell", CELL_EFFECT, 10.0, "ug"),
        ("scale.constant", catalogue.constant, 10000.0, "ppm"),
        ("scale.temperature", catalogue.linear, 1000.0, "ppm/degC"),
        ("scale.cell", CELL_EFFECT, 100.0, "ppm"),
        ("fixture_tilt.constant", catalogue.constant, 291.0, "urad", FIXTURE_SOURCE),
        ("fixture_tilt.cell", CELL_EFFECT, 5.0, "urad"),
        ("base_tilt.constant", BASE_CONSTANT, 1.0, "arcsec"),
        ("base_tilt.cell", BASE_CELL_EFFECT, 1.0, "urad"),
        ("rotation.constant", catalogue.constant, 0.1, "deg"),
        ("tilt.setting", SETTING, 1.0, "arcsec", "source 0: the table's angles are good to 1″"),
    ),
    candidates=(
        ("bias.temperature_quadratic", catalogue.quadratic, 0.05, "ug/degC^2"),
        ("bias.temperature_cubic", catalogue.cubic, 0.003, "ug/degC^3"),
        ("scale.temperature_quadratic", catalogue.quadratic, 1.0, "ppm/degC^2"),
        ("scale.temperature_cubic", catalogue.cubic, 0.1, "ppm/degC^3"),
        ("bias.drift", catalogue.drift, 10.0, "ug"),
        ("bias.warm_up", catalogue.warm_up(2 * MINUTE, 3 * HOUR), 10.0, "ug"),
        ("bias.run", catalogue.deviation, 10.0, "ug"),
        ("scale.run", catalogue.deviation, 100.0, "ppm"),
        ("bias.thermal_lag", LAG_EFFECT, 10.0, "ug/degC"),
        ("bias.hysteresis", HYSTERESIS_EFFECT, 10.0, "ug"),
        ("fixture_tilt.temperature", catalogue.linear, 5.0, "urad/degC"),
        ("fixture_tilt.run", catalogue.deviation, 20.0, "urad"),
        ("fixture_tilt.run_temperature", RUN_TEMPCO, 2.0, "urad/degC"),
        ("fixture_tilt.position", POSITION_TEMPCO, 0.3, "urad/degC"),
        ("base_tilt.lab_temperature", BASE_LABORATORY, 5.0, "urad/degC"),  # source 0: below 47
        ("base_tilt.temperature", BASE_TEMPCO, 1.0, "urad/degC"),
        ("base_tilt.tide", _build_tide, 50.0, "nrad", TIDE_SOURCE),
        ("base_tilt.drift", BASE_DRIFT, 5.0, "urad"),
        ("second_order", K2, 0.05, "ug/mg^2"),
        ("third_order", K3, 0.01, "ug/mg^3"),
        ("cross_coupling", KIP, 1e-4, "1/g"),
        ("cross_coupling.temperature", KIP_TEMPCO, 1e-5, "1/g/degC"),
        ("rotation.harmonic", DIVIDING_ERROR, 1.0, "arcsec", ANGLE_SOURCE),
        ("rotation.wobble", WOBBLE, 1.0, "arcsec"),
        # The lag may itself be slow.
        *catalogue.make_common_effects(
            *("bias", "ug"),
            size=20.0,
            span=10.0,
            pace=0.2,
            causes=("temperature_x_lag", "supply", "temperature_x_supply"),
        ),
    ),
)
THERMOMETER = effects.thermometer(0.002, source="assumed: 2 mK of an averaged temperature")


def _build_quadratic() -> bc.Model:
    return INSTRUMENT.baseline() + "bias.temperature_quadratic" + "scale.temperature_quadratic"


INSTRUMENT = bc.Instrument(
    name="ng_accelerometer",
    title="ng accelerometer on a tilted table: bias and scale factor over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "K0"),
        bc.Slot("scale", "1", "κ, relative deviation of the scale factor"),
        bc.Slot("fixture_tilt", "rad", "γ1, tilt of the input axis out of the face"),
        bc.Slot("base_tilt_parallel", "rad", "γ2∥, tilt of the base along θ = 0"),
        bc.Slot("base_tilt_perp", "rad", "γ2⊥, tilt of the base along θ = 90°"),
        bc.Slot("second_order", "ug/mg^2", "K2"),
        bc.Slot("third_order", "ug/mg^3", "K3"),
        bc.Slot("cross_coupling", "1/g", "Kip, cross-coupling with the pendulous axis"),
        bc.Slot("rotation", "rad", "added to θ"),
        bc.Slot("gravity", "1", "relative deviation of local gravity from the assumed value"),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    nuisances=(local_gravity.make_nuisance_effect("gravity"),),
    noise=bc.White(bc.HalfCauchy(1.0)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", _build_quadratic),
        ("line, fixture warms", lambda: INSTRUMENT.baseline() + "fixture_tilt.temperature"),
        ("line, thermometer error", lambda: INSTRUMENT.baseline() + THERMOMETER),
        (
            "line, base follows the laboratory",
            lambda: INSTRUMENT.baseline() + "base_tilt.lab_temperature",
        ),
    ),
    simulator=simulate_columns,
    experiments=list_experiments(
        simulate_columns,
        {
            "the same again": Campaign(),
            "twice as many runs": Campaign(runs=6),
            "every second run downwards": Campaign(alternate=True),
            "each cell at two tilts, 0.45° and 0.30°": Campaign(tilts=(TILT, 0.30 * DEGREE)),
            "each cell at 0.45° and −0.45°": Campaign(tilts=(TILT, -TILT)),
            "the face turned over in each cell": Campaign(tilts=(TILT, INVERTED_TILT)),
            "24 positions": Campaign(positions=24),
            "three hours' soak": Campaign(soak=3 * HOUR),
            "ten days between runs": Campaign(pause=240 * HOUR),
            "the laboratory's temperature varied by 3 °C": Campaign(laboratory_daily=3.0),
        },
    ),
    use=bc.Use("acceleration", "ug", _use_output, ("bias", "scale", "second_order", "third_order")),
    source="source 0",
)
simulate = make_readings_simulator(INSTRUMENT)
