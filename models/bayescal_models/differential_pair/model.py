"""Differential pair: MEMS accelerometers in two groups on a centrifuge arm, outer and inner (source 3).

Input axes point outward in the outer group and inward in the inner one, so that the devices of a pair see opposite
accelerations and the same environment. Measurement equation, output in µg, s = +1 outer, −1 inner, a the
commanded acceleration along the arm (µg, outward):

    output = s·(1 + κ)·[a·(1 + ρ) − δ·da/dt] + bias + ε·(g + r·dΩ/dt) + λd·u + v,       a = Ω²·r

| coefficient | slot, its unit | plausible size (ours; the equation is source 3's) |
|---|---|---|
| `scale.device`, baseline | `scale` κ, 1 | 5000 ppm: one per device, spread learned |
| `environment.shared[order 0]` … `[order 5]`, baseline | `environment` u, µg | 1 mg rms together |
| `environment.shared[sensitivity]`, baseline | `sensitivity` λd, 1 | 0.2 about 1: one per device, spread learned |
| `departure.device[order 0]` … `[order 5]`, baseline | `departure` v, µg | 0.05 of u; size and spectrum learned |
| `environment.temperature` | `environment` | 100 µg/°C |
| `scale.second_order` | `scale`: K2·s·a + K3·a² + K2'·s·var(a)/a, of a reading | 1000 ppm/g, 1 ppm/g², per device |
| `misalignment.device` | `misalignment` ε, rad | 5 mrad per device; its g is an alias of a bias, r·dΩ/dt is not |
| `input.radius` | `input` ρ = δr/r, 1 | 10⁻² per device; an exact alias of `scale.device`, hence untestable |
| `timing.skew` | `timing` δ, s | 10 ms per device |
| `bias.device`, `bias.drift` | `bias`, µg | 10 mg; 100 µg over the record; both per device |

The radius of the arm, where dΩ/dt is needed, is 1 m (`RADIUS`). Noise: white, 100 µg; or, where the readings say so,
larger while the arm changes its speed (`noise.py`).

λd·u is a product of unknowns: one factor is sampled with the hyper-parameters. The framework takes the orders of u,
which stay six however many devices there are; λd, whose spread is learned, would make a funnel with it. A constant
acceleration leaves each device's scale and the constant part of its environment indistinguishable: record steps.

Pairs are chosen by `pairing/selection.py` (`bayescal pairs FILE`), and used by `pairing/measure.py`.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.differential_pair import COLUMNS, NOMINAL_SCALE
from bayescal_models.differential_pair.campaign import G
from bayescal_models.differential_pair.effects import (
    BASELINE,
    BIAS,
    CANDIDATES,
    direction,
    slope,
    tangential,
)
from bayescal_models.differential_pair.environment import DEPARTURE
from bayescal_models.differential_pair.noise import NoiseWhileChanging
from bayescal_models.differential_pair.simulator import simulated_columns
from bayescal_models.simulated import readings_of


def _response(slots, r):
    a, sign = r["acceleration"], direction(r)
    seen = a * (1.0 + slots["input"]) - slots["timing"] * slope(r, a)
    return (
        sign * (1.0 + slots["scale"]) * seen
        + slots["bias"]
        + slots["misalignment"] * (G + tangential(r))
        + slots["sensitivity"] * slots["environment"]
        + slots["departure"]
    )


INSTRUMENT = bc.Instrument(
    name="differential_pair",
    title="accelerometers in two opposed groups on a centrifuge: which two make a differential pair",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "output at no acceleration"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
        bc.Slot("environment", "ug", "shared disturbance u(t)"),
        bc.Slot("sensitivity", "1", "sensitivity to the shared disturbance"),
        bc.Slot("departure", "ug", "a device's own environment"),
        bc.Slot("input", "1", "relative deviation of the acceleration at the device"),
        bc.Slot("timing", "s", "delay of the device"),
        bc.Slot("misalignment", "rad", "tilt of the input axis"),
    ),
    response=_response,
    effects=BASELINE,
    candidates=CANDIDATES,
    noise=bc.White(bc.HalfCauchy(100.0)),
    noise_laws=(NoiseWhileChanging(),),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("shared", lambda: INSTRUMENT.baseline()),
        ("shared, biases", lambda: INSTRUMENT.baseline() + BIAS),
        ("no departures", lambda: INSTRUMENT.baseline() - DEPARTURE),
    ),
    simulator=simulated_columns,
    source="source 3",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
