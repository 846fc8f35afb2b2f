"""Quartz resonant beam accelerometer with two thermometers: bias and scale factor over temperature (source 2).

Measurement equation, a the known input in local g, Kn the nominal scale factor, b in µg, κ relative, K2 in µg/g²:

    f = Kn·[ b + (1 + κ)·a + K2·a² ]

The output is the difference of the two beams' frequencies in Hz; it becomes µg by Kn = 100 Hz/g (ours; another with
a nominal scale of your own). Thermometers: t1 at the drive circuit, t2 in the head; δt = t1 − t2.

Both b and κ are, after source 2, sums of 15 columns (its `b_com = b0 − [ … ]`, here the bracket itself):

    c01 + c11·t1 + c21·t1² + c31·t1³ + c02 + c12·t2 + c22·t2² + c32·t2³ + cδ1·δt + cδ2·δt² + cδ3·δt³
        + ċ1·dt1/dt + ċ2·dt2/dt + c×rate·t2·dt2/dt + c×grad·t2·δt

with t1 and t2 about one T0 (mean of t2, rounded, stored with the calibration as temperature_head_0). The
columns have rank 12: c01 − c02, c11 − c12 − cδ1 and c21 − c22 − cδ2 − 2·c×grad leave no trace in any readings; all
15 are kept, their priors hold these three, and every calibration names them. On soaked points the rank is 4.

| effect, as `bias.…` and `scale.…` | form | plausible size: bias, scale |
|---|---|---|
| `constant_circuit`, `constant_head` | 1 | 20 000 µg, 5000 ppm |
| `temperature_circuit`, `_quadratic`, `_cubic` | (t1 − T0)ⁿ | 50 µg/°C, 0.5, 0.005; a tenth in ppm |
| (`temperature_circuit_quartic`, `_quintic`) | (t1 − T0)⁴, ⁵ | 5·10⁻⁵, 5·10⁻⁷; a tenth in ppm |
| `temperature_head`, `_quadratic`, `_cubic` | (t2 − T0)ⁿ | 50 µg/°C, 0.5, 0.005; a tenth in ppm |
| `gradient`, `_quadratic`, `_cubic` | δtⁿ | 20 µg/°C, 1, 0.1; a tenth in ppm |
| `rate_circuit`, `rate_head` | dt1/dt, dt2/dt | 10 µg per °C/min; 1 ppm |
| `temperature_x_rate` (`…_circuit`) | (t2 − T0)·dt2/dt (t1) | 0.2 µg/°C per °C/min; 0.02 ppm |
| `temperature_x_gradient` (`…_circuit`) | (t2 − T0)·δt (t1) | 0.5 µg/°C²; 0.05 ppm/°C² |
| `thermal_lag` | t̃2 − t2, τ 1–60 min | 20 µg/°C; 2 ppm/°C |
| `hysteresis` | direction of the last change of t2 | 20 µg; 2 ppm |
| `warm_up` | exp(−(t − t_start)/τ), τ 2–60 min | 50 µg; 5 ppm |
| `drift` | (t − t̄)/(tmax − tmin) | 10 µg; 1 ppm |
| `run`, `cell` | one deviation each, spread learned | 20, 5 µg; 2, 0.5 ppm |
| `frequency_sum`, `_quadratic`, `_cubic` | apparent temperatureⁿ | 50 µg/°C, 0.5, 0.005; a tenth in ppm |
| `second_order` (one, slot of its own) | K2 | 10 µg/g² |

*Baseline*: a constant and a cubic of the head's temperature for b and for κ, which is what a soaked four-position
tumble can tell (rank 4); what ramps show beyond it is for `discover` to find, or for the structure "two
thermometers" to hold all at once. What stands in brackets above, and `frequency_sum`, belong to the
document's other methods: polynomials of t1 of order 1, 3 and 5; t1 with its rate and their product; the sum of the
beams' frequencies. `*.constant_circuit` stands in structures alone: beside `*.constant_head` it measures nothing.

Noise: white, of unknown size. Sizes are prior standard deviations for a first calibration, ours where no source is
named; a user replaces them with data-sheet values.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer import COLUMNS, NOMINAL_SCALE, PER_G, effects
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.simulator import simulated_columns
from bayescal_models.simulated import experiments, readings_of


def _response(slots, r):
    a = r["acceleration"]
    return slots["bias"] + (1 + slots["scale"]) * a + slots["second_order"] * (PER_G * a) ** 2


def of_circuit(order: int) -> bc.Model:
    """Bias and scale factor as polynomials of t1: the document's first prior method."""
    made = _bare()
    for slot in effects.SLOTS:
        made = made + effects.constant(slot, "circuit")
        made = made + effects.polynomial(slot, "temperature_circuit", range(1, order + 1))
    return made


def with_rate() -> bc.Model:
    """A cubic of t1, its rate and their product: the document's second prior method."""
    made = of_circuit(3)
    for slot in effects.SLOTS:
        made = made + effects.rates(slot)[0] + effects.crossed(slot, "circuit")[0]
    return made


def of_frequency_sum(order: int = 3) -> bc.Model:
    """Polynomials of the temperature that the beams' frequency sum shows: the document's third prior method."""
    made = _bare()
    for slot in effects.SLOTS:
        made = made + effects.constant(slot, "head")
        made = made + effects.frequency_sum(slot, range(1, order + 1))
    return made


def two_thermometers(crossed_by: str = "head") -> bc.Model:
    """The document's own model, 15 columns each for bias and scale factor.

    Args:
        crossed_by: which thermometer is t in t·dt/dt and t·δt, "head" or "circuit".
    """
    made = _bare()
    for slot in effects.SLOTS:
        made = made + effects.two_thermometers(slot, crossed_by)
    return made


def _bare() -> bc.Model:
    return bc.Model(INSTRUMENT, (), INSTRUMENT.noise)


INSTRUMENT = bc.Instrument(
    name="quartz_beam_accelerometer",
    title="quartz resonant beam accelerometer with two thermometers",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "output at zero input"),
        bc.Slot("scale", "1", "relative deviation of the scale factor from nominal"),
        bc.Slot("second_order", "ug/g^2", "K2"),
    ),
    response=_response,
    effects=effects.BASELINE,
    candidates=effects.CANDIDATES,
    noise=bc.White(bc.HalfCauchy(20.0)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("cubic of t2", lambda: INSTRUMENT.baseline()),
        ("t1, order 1", lambda: of_circuit(1)),
        ("t1, order 3", lambda: of_circuit(3)),
        ("t1, order 5", lambda: of_circuit(5)),
        ("t1, rate and product", with_rate),
        ("frequency sum, order 3", of_frequency_sum),
        ("two thermometers", two_thermometers),
        ("two thermometers, t1 in the products", lambda: two_thermometers("circuit")),
    ),
    simulator=simulated_columns,
    experiments=experiments(
        simulated_columns,
        {
            "the same again": Campaign(),
            "ramps of 0.5 and 4 °C/min": Campaign(
                ramp_speeds=(0.5, 4.0), interval=120.0, average=120.0
            ),
            "four tumbles": Campaign(repeats=4),
            "ramps at five attitudes": Campaign(attitudes=(1.0, 0.5, 0.0, -0.5, -1.0)),
            "held for two hours at each end of a ramp": Campaign(
                hold=7200.0, interval=120.0, average=120.0
            ),
            "a minute without power between runs": Campaign(pause=60.0),
        },
    ),
    use=bc.Use("acceleration", "ug"),
    source="source 2",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
