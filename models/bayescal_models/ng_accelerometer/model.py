"""ng accelerometer on a tilted, turning table over temperature (source 0).

Measurement equation, output in µg of nominal scale (volts become µg by the nominal scale factor):

    output = K0 + (1 + κ)·a + K2·a² + K3·a³ + Kip·a·ap

with a and ap from the exact geometry of `rig/geometry.py`: the table's face is tilted by γ (column `tilt`) and turned
to θ (column `position_angle`), nominally a = g·sin γ·sin θ; a in µg (mg under K2 and K3), ap in g. K0 is not
multiplied by 1 + κ.

Slots: `bias` = K0, µg; `scale` = κ; `fixture_tilt` = γ1, rad; `base_tilt_parallel` = γ2∥ and `base_tilt_perp` =
γ2⊥, rad; `second_order` = K2, µg/mg²; `third_order` = K3, µg/mg³; `cross_coupling` = Kip, 1/g; `rotation`, added
to θ, rad. A *cell* is a run × temperature point. Prior standard deviations, ours unless said:

Baseline                      slot            form                              size
`bias.constant`               bias            c                                 5 mg
`bias.temperature`            bias            b0·(T−T0)                         50 µg/°C
`bias.cell`                   bias            one for each cell, spread learned 10 µg
`scale.constant`              scale           c                                 1 %
`scale.temperature`           scale           b1·(T−T0)                         1000 ppm/°C
`scale.cell`                  scale           one for each cell, spread learned 100 ppm
`fixture_tilt.constant`       fixture_tilt    c                                 1′ = 291 µrad (source 0: 2′ at most)
`fixture_tilt.cell`           fixture_tilt    one for each cell, spread learned 5 µrad
`base_tilt.constant`          base_tilt ∥, ⊥  c                                 1″ (source 0: the table's angles)
`base_tilt.cell`              base_tilt ∥, ⊥  one for each cell, spread learned 1 µrad
`rotation.constant`           rotation        azimuth δ of the input axis       0.1°
`tilt.setting`                base_tilt ⊥     error of the tilt that was set    1″ (source 0)

An error of the set tilt γ enters only as γ + γ2⊥, so `tilt.setting` is an exact alias of
`base_tilt.constant[perp]`; both are kept, because they are two causes with a budget line each and together leave
the scale factor √2·617 ppm at 0.45°. Within a cell are aliases too: bias with the fixture tilt, scale factor with
γ2⊥ and with Kip, γ2∥ with δ. Their priors, time, laboratory temperature and other set-ups are all that parts them.

Candidates                    slot            form                              size
`bias.temperature_quadratic`  bias            c·(T−T0)²                         0.05 µg/°C²
`bias.temperature_cubic`      bias            c·(T−T0)³                         0.003 µg/°C³
`scale.temperature_quadratic` scale           c·(T−T0)²                         1 ppm/°C²
`scale.temperature_cubic`     scale           c·(T−T0)³                         0.1 ppm/°C³
`bias.drift`                  bias            c·(t−t̄)/(tmax−tmin)               10 µg
`bias.warm_up`                bias            c·exp(−t/τ) in a run, 2 min…3 h   10 µg
`bias.run`                    bias            one for each run, spread learned  10 µg
`scale.run`                   scale           one for each run, spread learned  100 ppm
`bias.rate`                   bias            c·dT/dt                           2 µg per °C/h
`bias.thermal_lag`            bias            c·(T̃−T), τ 1 min…3 h              10 µg/°C; start of a run 5 µg
`bias.hysteresis`             bias            c·sign(T − previous cell's)       10 µg
`fixture_tilt.temperature`    fixture_tilt    c·(T−T0)                          5 µrad/°C
`fixture_tilt.run`            fixture_tilt    one for each run (set-up)         20 µrad
`fixture_tilt.run_temperature` fixture_tilt   d[run]·(T−T0), spread learned     2 µrad/°C
`fixture_tilt.position`       fixture_tilt    (T−T0)·(cos, sin of 2θ, 3θ)       0.3 µrad/°C
`base_tilt.lab_temperature`   base_tilt ∥, ⊥  c·(L−L0)                          5 µrad/°C (source 0: below 47)
`base_tilt.temperature`       base_tilt ∥, ⊥  c·(T−T0)                          1 µrad/°C
`base_tilt.tide`              base_tilt ∥, ⊥  cos, sin of M2 S2 N2 K1 O1        50, 25, 10, 30, 20 nrad
`base_tilt.drift`             base_tilt ∥, ⊥  c·(t−t̄)/(tmax−tmin)               5 µrad
`second_order`                second_order    K2                                0.05 µg/mg²
`third_order`                 third_order     K3                                0.01 µg/mg³
`cross_coupling`              cross_coupling  Kip                               1e-4 /g
`cross_coupling.temperature`  cross_coupling  c·(T−T0)                          1e-5 /g/°C
`rotation.harmonic`           rotation        cos, sin of θ                     1″ (source 0)
`rotation.wobble`             fixture_tilt    cos, sin of 2θ, 3θ                1″

`base_tilt.temperature[perp]` is an exact alias of b1, `fixture_tilt.temperature` all but one of b0: to add them
widens those tempcos to what their priors leave, which no number of readings of the same kind narrows.

`temperature`, °C: `temperature.reading`, the thermometer's own error (2 mK, ours; errors in variables). At 44 µg/°C
it is half the noise of a reading, and a line fitted without it is pulled towards zero.

Noise: white, of unknown size (0.05 to 5 µg; source 0 gives 3 ng/√Hz for the sensor alone).
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.ng_accelerometer import COLUMNS, NOMINAL_SCALE, effects
from bayescal_models.ng_accelerometer.campaign import Campaign
from bayescal_models.ng_accelerometer.rig.geometry import accelerations
from bayescal_models.ng_accelerometer.simulator import simulated_columns
from bayescal_models.ng_accelerometer.sizes import DEGREE, HOUR
from bayescal_models.simulated import experiments, readings_of

TILT = 0.45 * DEGREE
OVER = 180 * DEGREE - TILT


def _response(slots, r):
    a, ap = accelerations(
        r["tilt"],
        r["position_angle"] + slots["rotation"],
        slots["fixture_tilt"],
        slots["base_tilt_parallel"],
        slots["base_tilt_perp"],
    )
    mg = a / 1e3
    return (
        slots["bias"]
        + (1 + slots["scale"]) * a
        + slots["second_order"] * mg**2
        + slots["third_order"] * mg**3
        + slots["cross_coupling"] * a * ap
    )


def _in_use(a, slots, r):
    """Without the table: the acceleration along the input axis is what is asked for, none across it is known."""
    mg = a / 1e3
    bent = slots["second_order"] * mg**2 + slots["third_order"] * mg**3
    return slots["bias"] + (1 + slots["scale"]) * a + bent


INSTRUMENT = bc.Instrument(
    name="ng_accelerometer",
    title="ng accelerometer on a tilted table: bias and scale factor over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "K0"),
        bc.Slot("scale", "1", "κ, relative deviation of the scale factor"),
        bc.Slot("fixture_tilt", "rad", "γ1, of the input axis out of the face"),
        bc.Slot("base_tilt_parallel", "rad", "γ2∥, of the base along θ = 0"),
        bc.Slot("base_tilt_perp", "rad", "γ2⊥, of the base along θ = 90°"),
        bc.Slot("second_order", "ug/mg^2", "K2"),
        bc.Slot("third_order", "ug/mg^3", "K3"),
        bc.Slot("cross_coupling", "1/g", "Kip, the pendulous axis along the face's normal"),
        bc.Slot("rotation", "rad", "added to θ"),
    ),
    response=_response,
    effects=effects.BASELINE,
    candidates=effects.CANDIDATES,
    noise=bc.White(bc.HalfCauchy(1.0)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        (
            "quadratic",
            lambda: (
                INSTRUMENT.baseline() + "bias.temperature_quadratic" + "scale.temperature_quadratic"
            ),
        ),
        ("line, fixture warms", lambda: INSTRUMENT.baseline() + "fixture_tilt.temperature"),
        ("line, thermometer error", lambda: INSTRUMENT.baseline() + effects.THERMOMETER),
        (
            "line, base follows the laboratory",
            lambda: INSTRUMENT.baseline() + "base_tilt.lab_temperature",
        ),
    ),
    simulator=simulated_columns,
    experiments=experiments(
        simulated_columns,
        {
            "the same again": Campaign(),
            "twice as many runs": Campaign(runs=6),
            "every second run downwards": Campaign(alternate=True),
            "each cell at two tilts, 0.45° and 0.30°": Campaign(tilts=(TILT, 0.30 * DEGREE)),
            "each cell at 0.45° and −0.45°": Campaign(tilts=(TILT, -TILT)),
            "the face turned over in each cell": Campaign(tilts=(TILT, OVER)),
            "24 positions": Campaign(positions=24),
            "three hours' soak": Campaign(soak=3 * HOUR),
            "ten days between runs": Campaign(pause=240 * HOUR),
            "the laboratory's temperature varied by 3 °C": Campaign(laboratory_daily=3.0),
        },
    ),
    use=bc.Use("acceleration", "ug", _in_use, ("bias", "scale", "second_order", "third_order")),
    source="source 0",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
