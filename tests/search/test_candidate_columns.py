"""Candidate effects as columns: each coefficient over the grid of its own prior."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._discovery.candidate_columns import columns_at, lay_out
from bayescal_models import mems_gyro

SPREADS = (bc.HalfNormal(0.3), bc.HalfNormal(0.004))  # deg/s and deg/s/degC
LINE_OF_A_RUN = bc.Effect(
    "bias.run_line",
    "bias",
    basis=lambda r: jnp.stack([jnp.ones(r.size), r.centred()], axis=1),
    coefficients=tuple(
        bc.Coefficient(unit, bc.Normal(0.0, 1.0), part=part, per="run", spread=spread)
        for part, unit, spread in zip(
            ("offset", "slope"), ("deg/s", "deg/s/degC"), SPREADS, strict=True
        )
    ),
    columns=("run", "temperature"),
    equation="a[run] + b[run]*(T - T0)",
    source="none",
)


def test_coefficients_of_unlike_units_have_spreads_of_their_own() -> None:
    rng = np.random.default_rng(1)
    temperature = np.tile(np.linspace(-20.0, 60.0, 9), 3)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        run=np.repeat(["a", "b", "c"], 9),
        temperature=temperature,
        output=1.0 + 0.03 * temperature + rng.normal(0.0, 0.2, 27),
    )
    fitted = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=100))
    laid = lay_out(fitted, [LINE_OF_A_RUN])
    slopes = [columns for columns, _ in columns_at(fitted, LINE_OF_A_RUN, [])]
    assert len(laid.points) > 1
    for point in laid.points:
        assert point.amplitude is not None
        relative = point.amplitude / SPREADS[0].scale
        wanted = [c * relative * s.scale for c, s in zip(slopes, SPREADS, strict=True)]
        np.testing.assert_allclose(laid.matrix[:, point.columns], np.hstack(wanted), rtol=1e-9)
