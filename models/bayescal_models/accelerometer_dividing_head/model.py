"""Pendulous accelerometer on a dividing head, at several temperatures (IEEE Std 1293).

Measurement equation, output in µg of nominal scale (volts become µg by the nominal scale factor):

    output = K0 + (1 + κ)·g·aᵢ + K2·aᵢ² + K3·aᵢ³ + Kip·aᵢ·aₚ,      aᵢ = sin(θ + ψ),  aₚ = cos(θ + ψ), in g

θ is the set angle of the head (column `position_angle`), whose axis is level. ψ is the sum of the head's zero error and
the tilts of fixture and input axis about the head's axis, which one mounting does not separate. A tilt η of the head's
axis together with a tilt β of the input axis along it adds g·sin β·sin η, 1 µg for 1 mrad each, an exact alias of K0;
the factor cos β is an alias of κ. K0 is not multiplied by 1 + κ.

Slots: `bias` = K0, µg; `scale` = κ; `zero` = ψ, rad; `second_order` = K2 and `cross_coupling` = Kip, µg/g²;
`third_order` = K3, µg/g³; `gravity`, a relative deviation of aᵢ and aₚ. Plausible sizes are those of a quartz-flexure
accelerometer (Q-flex): bias 4 mg, 30 µg/°C, 180 ppm/°C, misalignment 2 mrad. K2 contributes cos 2θ and a constant, Kip
sin 2θ, K3 sin 3θ: eight or more positions separate them from K0, κ and ψ, four do not. A dividing error of one period
per turn is an exact alias of K2 and Kip for any number of positions; a head of known error, or an inverted device,
separates them.

`zero.temperature` is a fixture tilt that depends on temperature, `zero.harmonic` the head's dividing error.

Noise: white, of unknown size.
"""

from __future__ import annotations

import bayescal as bc
from bayescal import xp
from bayescal_models import catalogue, local_gravity
from bayescal_models.accelerometer_dividing_head import COLUMNS, NOMINAL_SCALE
from bayescal_models.accelerometer_dividing_head.campaign import Campaign
from bayescal_models.accelerometer_dividing_head.simulator import simulate_columns
from bayescal_models.catalogue import HOUR, MINUTE, EffectTable, centred, effect, one
from bayescal_models.simulated import ReferenceProblem, list_experiments, make_readings_simulator

G = 1e6  # µg


def _evaluate_response(slots, r):
    angle = r["position_angle"] + slots["zero"]
    gravity = 1 + slots["gravity"]
    a, a_cross = gravity * xp.sin(angle), gravity * xp.cos(angle)
    return _evaluate_axial_output(a, slots) + slots["cross_coupling"] * a * a_cross


def _evaluate_axial_output(a, slots):
    nonlinear_terms = slots["second_order"] * a**2 + slots["third_order"] * a**3
    return slots["bias"] + (1 + slots["scale"]) * G * a + nonlinear_terms


def _use_output(acceleration, slots, r):
    """Return the output, µg, of the instrument without the dividing head, for an acceleration in µg."""
    return _evaluate_axial_output(acceleration / G, slots)


def _evaluate_harmonic(r):
    return xp.stack([xp.cos(r["position_angle"]), xp.sin(r["position_angle"])], axis=-1)


CONSTANT_EFFECT = effect(one, "c", "position_angle", kind="constant")
TEMPCO_EFFECT = effect(centred, "c·(T − T0)", "position_angle", "temperature")
DIVIDING = effect(_evaluate_harmonic, "c·cos θ + s·sin θ", "position_angle", parts=("cos", "sin"))

EFFECTS = EffectTable.from_rows(
    "data sheets of quartz-flexure accelerometers (Q-flex); size assumed by us",
    baseline=(
        ("bias.constant", catalogue.constant, 4000.0, "ug"),
        ("bias.temperature", catalogue.linear, 30.0, "ug/degC"),
        ("scale.constant", catalogue.constant, 20000.0, "ppm"),
        ("scale.temperature", catalogue.linear, 180.0, "ppm/degC"),
        ("zero.constant", catalogue.constant, 2000.0, "urad"),
    ),
    candidates=(
        ("second_order.constant", CONSTANT_EFFECT, 20.0, "ug/g^2"),
        ("second_order.temperature", TEMPCO_EFFECT, 0.2, "ug/g^2/degC"),
        ("third_order.constant", CONSTANT_EFFECT, 20.0, "ug/g^3"),
        ("cross_coupling.constant", CONSTANT_EFFECT, 20.0, "ug/g^2"),
        ("zero.temperature", catalogue.linear, 5.0, "urad/degC"),
        ("zero.run", catalogue.deviation, 50.0, "urad"),
        ("zero.harmonic", DIVIDING, 10.0, "urad"),
        ("bias.temperature_quadratic", catalogue.quadratic, 0.2, "ug/degC^2"),
        ("bias.hysteresis", catalogue.hysteresis, 50.0, "ug"),
        ("bias.warm_up", catalogue.warm_up(2 * MINUTE, 3 * HOUR), 50.0, "ug"),
        ("bias.drift", catalogue.drift, 50.0, "ug"),
        ("bias.run", catalogue.deviation, 50.0, "ug"),
        ("scale.temperature_quadratic", catalogue.quadratic, 1.0, "ppm/degC^2"),
        ("scale.run", catalogue.deviation, 50.0, "ppm"),
    ),
)
INSTRUMENT = bc.Instrument(
    name="accelerometer_dividing_head",
    title="accelerometer on a dividing head: K0, K1, K2, K3 and zero over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "K0"),
        bc.Slot("scale", "1", "κ, relative deviation of the scale factor K1"),
        bc.Slot("zero", "rad", "ψ, added to θ: zero of the head, tilts of fixture and input axis"),
        bc.Slot("second_order", "ug/g^2", "K2"),
        bc.Slot("third_order", "ug/g^3", "K3"),
        bc.Slot("cross_coupling", "ug/g^2", "Kip, cross-coupling with the pendulous axis"),
        bc.Slot("gravity", "1", "relative deviation of local gravity from the assumed value"),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    nuisances=(local_gravity.make_nuisance_effect("gravity"),),
    noise=bc.White(bc.HalfCauchy(10.0)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        (
            "with K2 and K3",
            lambda: INSTRUMENT.baseline() + ["second_order.constant", "third_order.constant"],
        ),
    ),
    simulator=simulate_columns,
    experiments=list_experiments(
        simulate_columns,
        {
            "the same again": Campaign(),
            "three mountings": Campaign(runs=3),
            "down as well as up": Campaign(temperatures=(-20.0, 25.0, 70.0, 25.0, -20.0)),
        },
    ),
    use=bc.Use("acceleration", "ug", _use_output, ("bias", "scale", "second_order", "third_order")),
    source="IEEE Std 1293",
)
simulate = make_readings_simulator(INSTRUMENT)
# 36 readings; with hidden effects 360, with temperatures up and down in three mountings.
SMALL_CAMPAIGN = Campaign(positions=12, temperatures=(0.0, 25.0, 50.0))
EFFECT_CAMPAIGN = Campaign(temperatures=(-20.0, 25.0, 70.0, 25.0, -20.0), runs=3)
reference_problem = ReferenceProblem(INSTRUMENT, SMALL_CAMPAIGN, EFFECT_CAMPAIGN)
